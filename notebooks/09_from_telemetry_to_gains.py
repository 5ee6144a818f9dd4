# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # From telemetry to gains
#
# **You will learn** how to estimate the inertia of a satellite from the telemetry of three slews. You will also see whether
# the model is good enough, and the effect of a wrong inertia on tuned gains.
#
# **Time:** 20 minutes. The cells run for about six minutes on two cores.
#
# **Before you start:** read [From requirements to gains](03_tuning.ipynb).

# %%
from ptsmc_jax.configure import configure

configure()

import ptsmc_jax as ptsmc
import tuning

# %% [markdown]
# ## The satellite that was designed, and the one in orbit
#
# The design has the inertia of a CAD model. Its uncertainty is 10 % (1 sigma), which `[dispersion]` states.

# %%
flight = ptsmc.replace(
    ptsmc.read("../scenarios/first_flight.toml"),
    requirements={"peak_torque": 0.5, "gain_margin": 6.0, "phase_margin": 30.0},
    tune={"trials": 16, "starts": 2},
)
cad = ptsmc.replace(flight, dispersion__inertia={"kind": "relative_normal", "std": 0.1})

# %% [markdown]
# The satellite in orbit has moments of inertia that are about 20 % larger, and its principal axes are not the body axes. This
# tutorial simulates it: `true_inertia` is the inertia of the plant, and the law still uses that of the CAD model. With a real
# satellite you skip this cell, read your telemetry by `polars.read_csv`, and name its columns in `[telemetry]`.

# %%
true_inertia = [[12.1, 0.3, -0.2], [0.3, 14.2, 0.4], [-0.2, 0.4, 16.9]]  # kg m^2
orbit = ptsmc.replace(flight, spacecraft__true_inertia=true_inertia)
logs = [ptsmc.simulate(orbit, trial=trial).to_polars() for trial in range(3)]
logs[0].select("t", "measured_q1", "measured_w1", "sent1").head()  # some of its columns

# %% [markdown]
# ## Identify
#
# `identify` maximises the likelihood of the prediction errors of an extended Kalman filter. Two slews determine the
# inertia. The third one is not used for the estimate, and shows whether the model predicts it.

# %%
found = ptsmc.identify(cad, logs[:2], validate=logs[2:])
found

# %%
found.plot("estimates")

# %% [markdown]
# Compare the table with `true_inertia`: the errors should be below 2 sigma for most entries, and below 3 sigma for nearly all.
# If the model is right, the prediction errors (innovations) are white. The next figure has their autocorrelation in the third
# slew. One bar of twenty may leave the grey band. If something is missing in the model, such as a torque lag, many do.

# %%
found.plot("autocorrelation_3")

# %% [markdown]
# ## Tune with both models
#
# `identified_scenario` has the estimates, and a `[dispersion]` that draws from their covariance. It can be simulated, tuned
# and exported like any other scenario.

# %%
tuned = {
    "CAD": tuning.tune(flight),
    "identified": tuning.tune(found.identified_scenario),
}
for name, result in tuned.items():
    print(f"{name}: {result.report.headline}")

# %% [markdown]
# Both searches report gains that keep every requirement of their model. Only the satellite in orbit shows which model was right.
# The next cell simulates 1 000 slews of it with each design: its gains, and its inertia in the law.

# %%
for name, result in tuned.items():
    in_orbit = ptsmc.replace(result.scenario, spacecraft__true_inertia=true_inertia, dispersion=flight.dispersion)
    print(name, *ptsmc.verdicts(in_orbit, ptsmc.trials(in_orbit, 1_000)), sep="\n  ")

# %% [markdown]
# The gains that were tuned and verified with the CAD model break the torque limit in some slews. A campaign on the wrong model
# cannot show that.

# %% [markdown]
# ## The same in commands
#
# ```
# ptsmc identify cad.toml slew_1.csv slew_2.csv --validate slew_3.csv
# ptsmc tune out/identify-cad/identified.toml
# ptsmc montecarlo out/tune-identified/tuned.toml
# ```
#
# ## Exercises
#
# 1. Identify from one slew of 20 degrees. Which entries of the inertia become uncertain?
# 2. Add `torque_lag = 0.1` to `[hardware]` of `orbit` only. Which line of the verdict changes?
# 3. `ptsmc identify cad.toml --design` proposes a manoeuvre. How much smaller are the standard deviations?
#
# **Next:** [identify a model from telemetry](../docs/identification.md) has all parameters and the format of logs.
