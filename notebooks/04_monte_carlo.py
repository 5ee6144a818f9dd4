# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A campaign, its verdict and its worst case
#
# A review board asks for the fraction of good cases, the confidence, and the worst case. Every trial is a pure function of
# the seed and its number, so you can simulate each of them again with its whole history.

# %%
from ptsmc_jax.configure import configure

configure()

import tempfile
from pathlib import Path

import ptsmc_jax as ptsmc
from tuning.output import campaign_report, summaries, terminal
from tuning.studies import campaign_figures, campaign_folder, campaign_summary

# %% [markdown]
# The scenario has gains of `ptsmc tune scenarios/first_flight.toml` and the flight clock. It has more dispersions than the
# initial attitude: rate, inertia, the phase and amplitude of the disturbance, and a gyro bias. The requirements are on
# 99.73 % of all possible trials, with 90 % confidence.

# %%
flight = ptsmc.replace(
    ptsmc.read("../scenarios/first_flight.toml"),
    controller__eta=2.861,
    controller__delta=0.65,
    controller__k1=6.626,
    loop__clock="flight",
    observer__gain=[902.5] * 3,
    hardware__rate_bias=1e-6,
    dispersion__rate={"kind": "normal", "std": 0.002},
    dispersion__inertia={"kind": "relative_normal", "std": 0.05, "axes_deg": 1.0},
    dispersion__disturbance_phase={},
    dispersion__disturbance_amplitude={"kind": "relative_uniform", "half_width": 0.3},
    requirements={
        "peak_torque": {"limit": 0.5, "quantile": 0.9973, "confidence": 0.9},
        "window_error": {"limit": 3e-5, "quantile": 0.9973, "confidence": 0.9},
    },
)

# %% [markdown]
# The command for this campaign is `ptsmc montecarlo S.toml --trials 20000`. The rows are stored in complete files, so an
# interrupted campaign can be resumed. Each verdict has the number of trials beyond the limit, the fraction that keeps it
# with its interval, and the number of trials that would be enough. The fractions of the variance that inputs explain do
# not add up to one if inputs are correlated, such as the angle and the quaternion of an attitude.

# %%
place = Path(tempfile.mkdtemp()) / "campaign"
folder = campaign_folder.Folder(place, flight, seed=1, trials=20_000)
campaign_folder.begin(folder, force=False)
campaign_folder.simulate(folder, (1, 1), lambda standing: None)
found = campaign_summary.summarise(folder)
terminal.show(campaign_report.of(summaries.read(summaries.Campaign, found)), Path("campaign"))

# %% [markdown]
# The fan shows quantiles of the error over time, and the run with the largest window error. The distributions show all
# trials beside the limits. Their scale spreads both tails, so that rare values are visible.

# %%
from ptsmc_jax.explore import Figures

figures = campaign_figures.of(folder, found)
Figures({name: figures[name] for name in ("fan", "distributions")})

# %% [markdown]
# The peak torque is the first torque, 2 η² tan(θ/2)/t_f² times the inertia, so it grows with the initial angle. Points of
# another colour are trials beyond a limit of torque or error. All of them are drawn, but only a part of the others.

# %%
Figures({"torque_by_angle": figures["torque_by_angle"]})

# %% [markdown]
# These are the five worst trials by window error, with their initial angle in rad and true inertia in kg m². The angle
# explains only a small part of the variance, as the table of inputs above shows. The noise is the main cause.

# %%
worst = campaign_summary.worst(folder, "window_error", 5)
worst.select(
    "trial", "status", "window_error", "peak_torque", "initial_angle", "inertia_11", "inertia_22", "inertia_33"
)

# %% [markdown]
# The worst trial is simulated again. Its metrics are equal to its row, to the last digit. The error oscillates after t_f
# under the constant gains. The torque is largest at the start, as in theory (dotted).

# %%
found = campaign_summary.replay(folder, worst["trial"][0])
print(f"off its row by {found.off:.0e}, relative; the run with its history by {found.rounding:.0e}, by rounding")
again = ptsmc.simulate(flight, seed=1, trial=worst["trial"][0])
again.plot("error", "torque")

# %% [markdown]
# One folder has the verdict, its confidence and the worst case. `ptsmc report` makes a page of it. The next notebook is
# about plants other than a spacecraft.
