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
# **You will learn** how to state requirements, how to tune all gains of a law at once, and how to read the result.
#
# **Time:** 30 minutes. The cells run for about five minutes on two cores.
#
# **Before you start:** read [Why the published gains fail in a digital loop](02_sampling_and_noise.ipynb).

# %%
from ptsmc_jax.configure import configure

configure()

import matplotlib.pyplot as plt

import ptsmc_jax as ptsmc
import tuning

plt.style.use("ptsmc_jax.figures.ptsmc")

# %% [markdown]
# ## State the requirements
#
# No trial may need more than 0.5 N m. The loop must have a gain margin of 6 dB and a phase margin of 30 degrees. These
# margins are usual in practice: they cover errors of the model, such as a wrong inertia or an unknown delay. The objective
# is the smallest RMS pointing error in the second after $t_f$.

# %%
flight = ptsmc.replace(
    ptsmc.read("../scenarios/first_flight.toml"),
    requirements={"peak_torque": 0.5, "gain_margin": 6.0, "phase_margin": 30.0},
)

# %% [markdown]
# ## Tune
#
# `tuning.tune` runs the same search as the command `ptsmc tune`. It solves
#
# $$
# \min_\theta\ \ln\sqrt{\tfrac1N \textstyle\sum_i J_i(\theta)^2}
# $$
#
# such that every trial and every dispersed loop keeps its limits. $J_i$ is the error of trial $i$, and $\theta$ are the
# gains. The search differentiates all simulated trials by all gains. It
# then verifies the gains on 1 000 *held-out* trials that it has not used.

# %%
tuned = tuning.tune(flight)
tuned

# %% [markdown]
# The headline has the pointing error and says whether every requirement is met. The table compares the published gains and
# the tuned gains on the same held-out trials. The *lower bound* is the smallest error that these sensors and disturbances
# allow. The last list states how far you can trust the result. [Troubleshooting](../docs/troubleshooting.md) explains each
# line.
#
# ## Error and torque
#
# Every point of this figure is a held-out trial. With the published gains many trials are above the torque limit. With the
# tuned gains every trial is below it, and the errors are smaller by two orders of magnitude.

# %%
tuned.plot("tradeoff")

# %% [markdown]
# The next figure compares the torque of one trial. With the published gains, noise causes the largest torque shortly before
# $t_f$. With the tuned gains, the largest torque is at the start, where the slew needs it. In the hold phase the tuned gains
# are larger than the published ones. There the noise changes the torque by about 0.002 N m in each period.

# %%
figure, axes = plt.subplots()
for label, case in {"published": flight, "tuned": tuned.scenario}.items():
    history = ptsmc.simulate(case, trial=7).to_polars()
    axes.step(history["t"], history["u1"], where="post", lw=1.2, label=f"{label} gains")
for sign in (-1.0, 1.0):
    axes.axhline(0.5 * sign, color="0.3", ls="--", lw=1)
axes.set(xlabel="time [s]", ylabel="torque $u_1$ [N m]")
axes.set_title("Tuned gains remove the torque peak that noise causes")
_ = axes.legend(loc="lower left")

# %% [markdown]
# ## Margins
#
# `tuning.margins` linearises the simulated loop. The figure has the sensitivity $S = 1/(1 + L)$, with $L$ the open loop.
# A peak of $|S|$ below 6 dB means that the loop stays away from the point $-1$ by more than one half.

# %%
margins = tuning.margins(tuned.scenario)
print({name: round(value, 3) for name, value in margins.worst.items()})
margins.plot("sensitivity")

# %% [markdown]
# ## Which gain matters
#
# The bars state by how many per cent a metric changes if a gain increases by one per cent. A gain with short bars needs
# no accurate value. Here one per cent of $\eta$ reduces the window error by 1.5 % and increases the peak torque by 2 %. The
# torque limit therefore determines $\eta$. The thickness of the boundary layer, `sign_width`, has almost no effect.

# %%
tuned.plot("sensitivities")

# %% [markdown]
# Each line of the next figure is a local search from one starting point. Grey points violate a limit. Blue points meet all
# limits. Several searches end at the same error, which makes a better minimum elsewhere less likely.

# %%
tuned.plot("history")

# %% [markdown]
# ## The price of torque
#
# The Pareto front shows how much accuracy more torque buys. This cell traces few points with fewer trials, to save time.
# The margins are still required. `ptsmc pareto` traces 20 points.

# %%
quick = ptsmc.replace(flight, tune={"trials": 16, "starts": 2})
front = tuning.pareto(quick, points=4)
front.plot()

# %% [markdown]
# The report lists the gains of every point. Four times the torque reduces the error only from 1.55 to 1.05 arcsec. With half
# of the torque the error is about 240 arcsec, because $\eta$ reaches its lower bound. The limit of 0.5 N m is at the knee.

# %%
front

# %% [markdown]
# ## Save the result
#
# A scenario with the tuned gains is a file for all other commands.

# %%
import tempfile
from pathlib import Path

file = Path(tempfile.mkdtemp()) / "tuned.toml"
ptsmc.write(tuned.scenario, file)
print(file.name, {name: float(f"{value:.4g}") for name, value in tuned.gains.items()})

# %% [markdown]
# ## Exercises
#
# 1. Require a gain margin of 12 dB. How much accuracy does it cost?
# 2. Remove both margins, and compare the margins that the tuner then reaches.
# 3. Trace `tuning.pareto(quick, against="t_f", values=(25.0, 35.0, 50.0))`. Which torque does a faster slew need?
#
# **Next:** [Verify by Monte Carlo](04_monte_carlo.ipynb) tests gains with uncertain inertia, rate and disturbance.
