# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # From requirements to gains
#
# An engineer says what must hold, here no torque above 0.5 N m from any attitude 20 to 140 degrees away, and asks for
# the smallest error after t_f. The search differentiates through the flown trials; the proof is on trials it never saw.

# %%
from ptsmc_jax.configure import configure

configure()

import ptsmc_jax as ptsmc
from ptsmc_jax import study_plots
from ptsmc_jax.explore import Figures
from tuning import pareto, report, results, show

flight = ptsmc.read("../scenarios/first_flight.toml")
small = ptsmc.replace(flight, tune={"trials": 16, "starts": 3, "steps": 40})  # less than the default, for a quick look

# %% [markdown]
# `ptsmc tune scenarios/first_flight.toml` is this with 64 trials and 8 starts. The table sets the tuned gains beside the
# paper's on 1 000 fresh trials, with the flight clock and the exact sign.

# %%
tuned = report.tune(small, seed=0)
show.tuning(results.summary(tuned), "out/tune-first_flight", "done")

# %% [markdown]
# Each line is a start. Grey is beyond a limit, blue keeps it; the gains below the goal show how the starts come together,
# or into which valley they went.

# %%
made = results.figures_of(small, tuned)
Figures({"history": made["history"]})

# %% [markdown]
# What each gain does: by how many percent a metric changes for one percent of the gain. η moves the torque and hardly the
# accuracy, which is why the limit decides it.

# %%
Figures({"sensitivities": made["sensitivities"]})

# %% [markdown]
# Every trial is a point. The paper's gains lie above the limit and far to the right; the tuned ones below and to the left.

# %%
Figures({"tradeoff": made["tradeoff"]})

# %% [markdown]
# How much accuracy does torque buy? The front, here of a few points, each judged on fresh trials. Left of the knee a
# little torque buys much accuracy, right of it little.

# %%
front = pareto.trace(small, 0, 3, lambda *told: None, None)
Figures({"front": study_plots.front(front.points, front.others, 0.5, ("-", "N m"))})
