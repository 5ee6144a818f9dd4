# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A campaign, its verdict, its worst case, again
#
# A review board asks: in how many cases, with what confidence, and show me the worst. Every trial is a pure function of
# the seed and its number, so each can be flown again, alone and in full.

# %%
from ptsmc_jax.configure import configure

configure()

import tempfile
from pathlib import Path

import ptsmc_jax as ptsmc
from tuning import campaign_folder, campaign_summary, show_campaign

# %% [markdown]
# Tuned gains, and more that varies than attitudes: rates, a body known to 5 %, the disturbance's phase and size, a gyro
# with a bias. The requirement is the field's: in 99.73 % of the trials, with 90 % confidence.

# %%
flight = ptsmc.replace(
    ptsmc.read("../scenarios/first_flight.toml"),
    controller__eta=2.861,
    controller__delta=0.384,
    observer__gain=[7.25] * 3,
    hardware__rate_bias=1e-6,
    dispersion__rate={"kind": "normal", "std": 0.002},
    dispersion__inertia={"kind": "relative_normal", "std": 0.05, "axes_deg": 1.0},
    dispersion__disturbance_phase={},
    dispersion__disturbance_amplitude={"kind": "relative_uniform", "half_width": 0.3},
    requirements={
        "peak_torque": {"limit": 0.6, "quantile": 0.9973, "confidence": 0.9},
        "window_error": {"limit": 5e-5, "quantile": 0.9973, "confidence": 0.9},
    },
)

# %% [markdown]
# From the command line: `ptsmc montecarlo S.toml --trials 20000`. The rows are kept in a folder, in parts that are whole
# or not there; an interrupted campaign goes on where it was.

# %%
place = Path(tempfile.mkdtemp()) / "campaign"
folder = campaign_folder.Folder(place, flight, seed=1, trials=20_000)
campaign_folder.begin(folder, force=False)
campaign_folder.fly(folder, (1, 1), lambda standing: None)
found = campaign_summary.summarise(folder)
show_campaign.campaign(found, Path("campaign"))

# %% [markdown]
# The fan shows where 50, 90 and 99.7 % of a thousand trials lie at each time, with the run of the largest window error;
# the distributions put the limits beside all trials, on a scale on which 99.9 % is as far from 99 % as 1 % from 10 %.

# %%
from ptsmc_jax.explore import Figures

figures = campaign_summary.figures_of(folder, found)
Figures({name: figures[name] for name in ("fan", "distributions")})

# %% [markdown]
# Peak torque goes with the initial angle: it is the first torque, 2 η² tan(θ/2)/t_f² times the inertia, as theory says.
# Points of another colour are trials beyond a limit, however rare: all of them are drawn.

# %%
Figures({"torque_by_angle": figures["torque_by_angle"]})

# %% [markdown]
# The five worst trials, and the worst of them flown again. Its metrics are those of its row, to the last digits.

# %%
worst = campaign_summary.worst(folder, "window_error", 5)
worst.select(
    "trial", "status", "window_error", "peak_torque", "initial_angle", "inertia_11", "inertia_22", "inertia_33"
)

# %%
found = campaign_summary.replay(folder, worst["trial"][0])
print(f"off its row by {found.off:.0e}, relative; the run with its history by {found.rounding:.0e}, by rounding")
again = ptsmc.simulate(flight, seed=1, trial=worst["trial"][0])
again.plot("error", "torque")
