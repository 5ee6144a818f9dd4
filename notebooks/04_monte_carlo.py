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
from tuning.output import campaign_report, summaries, terminal
from tuning.studies import campaign_figures, campaign_folder, campaign_summary

# %% [markdown]
# The gains of `ptsmc tune scenarios/first_flight.toml` (its `tuned.toml`, so with the flight clock on which they were
# judged), and more that varies than attitudes: rates, a body known to 5 %, the disturbance's phase and
# size, a gyro with a bias. The requirements are put as the field puts them: in 99.73 % of all trials that could be flown,
# with 90 % confidence.

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
# This is `ptsmc montecarlo S.toml --trials 20000`, which one would use outside a notebook. The rows are kept in a folder,
# in parts that are whole or not there; an interrupted campaign goes on where it was. Each verdict says how many trials
# are beyond the limit, the share that keeps it with its interval, and how many trials would have been enough to show it.
# (The shares of the variance that inputs explain do not add up to one where the inputs hang together, as the angle and
# the quaternion of the same attitude do.)

# %%
place = Path(tempfile.mkdtemp()) / "campaign"
folder = campaign_folder.Folder(place, flight, seed=1, trials=20_000)
campaign_folder.begin(folder, force=False)
campaign_folder.fly(folder, (1, 1), lambda standing: None)
found = campaign_summary.summarise(folder)
terminal.show(campaign_report.of(summaries.read(summaries.Campaign, found)), Path("campaign"))

# %% [markdown]
# The fan shows where 50, 90 and 99.7 % of a thousand trials lie at each time, with the run of the largest window error;
# the distributions put the limits beside all trials, on a scale on which 99.9 % is as far from 99 % as 1 % from 10 %.

# %%
from ptsmc_jax.explore import Figures

figures = campaign_figures.of(folder, found)
Figures({name: figures[name] for name in ("fan", "distributions")})

# %% [markdown]
# Peak torque goes with the initial angle: it is the first torque, 2 η² tan(θ/2)/t_f² times the inertia, as theory says.
# Points of another colour are trials beyond a limit, of the torque or of the error, however rare: they are drawn first and
# the others thinned, so colours say where they lie, and not how many they are.

# %%
Figures({"torque_by_angle": figures["torque_by_angle"]})

# %% [markdown]
# The five worst trials by window error, with what they flew with: initial angle in rad, true inertia in kg m². As the
# drivers above say, the angle explains little of it (4 % of the variance): what makes them bad is their noise.

# %%
worst = campaign_summary.worst(folder, "window_error", 5)
worst.select(
    "trial", "status", "window_error", "peak_torque", "initial_angle", "inertia_11", "inertia_22", "inertia_33"
)

# %% [markdown]
# The worst of them flown again: its metrics are those of its row, to the last digit. The error bounces after t_f, where
# the constant gains take over, and the torque is largest at the start, where theory (dotted) has it.

# %%
found = campaign_summary.replay(folder, worst["trial"][0])
print(f"off its row by {found.off:.0e}, relative; the run with its history by {found.rounding:.0e}, by rounding")
again = ptsmc.simulate(flight, seed=1, trial=worst["trial"][0])
again.plot("error", "torque")

# %% [markdown]
# The verdict, its confidence and the worst case, all from one folder that anyone can fly again: `ptsmc report` makes a
# page of it. The next notebook is for plants that are no spacecraft.
