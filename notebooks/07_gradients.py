# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Derivatives of a simulation
#
# **You will learn** how to use the simulation as a pure JAX function. You will batch it over initial attitudes, compute
# sensitivities, and minimise a custom loss with an optimiser of your choice.
#
# **Time:** 20 minutes. The cells run for about two minutes.
#
# **Before you start:** read [The control law](01_paper.ipynb). You know `jax.jit`, `jax.vmap` and `jax.jacfwd`.

# %%
from ptsmc_jax.configure import configure

configure()

import dataclasses

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax

import ptsmc_jax as ptsmc

plt.style.use("ptsmc_jax.figures.ptsmc")


def arcsec(v):
    """Return the angle 2 asin |v| of an error vector in arcsec."""
    return np.degrees(2.0 * np.arcsin(v)) * 3600.0


# %% [markdown]
# ## The pure function
#
# `ptsmc.study` turns a scenario into `parts`, a pytree. Every number of the scenario is a leaf. `ptsmc.simulate_parts`
# maps parts, a seed and a trial number to a result with metrics.

# %%
flight = ptsmc.read("../scenarios/first_flight.toml")
parts = ptsmc.study(flight).parts
print(ptsmc.gains_of(parts))

# %% [markdown]
# ## Many initial attitudes
#
# A run from another attitude has another leaf `parts.initial.q`. `jax.vmap` simulates 200 of them, turned by 20 to 140
# degrees about random axes. With the published hand-over the largest torque is caused by noise, whatever the angle. With
# `delta` = 0.52 s the largest torque is the first torque of the slew, and it grows with the angle.


# %%
def simulate(parts, q, trial):
    initial = parts.initial._replace(q=q)
    return ptsmc.simulate_parts(dataclasses.replace(parts, initial=initial), 0, trial)


def turned(key, angle):
    axis = jax.random.normal(key, (3,))
    return jnp.append(axis / jnp.linalg.norm(axis) * jnp.sin(angle / 2), jnp.cos(angle / 2))


count = 200
angles = jnp.deg2rad(jnp.linspace(20.0, 140.0, count))
attitudes = jax.vmap(turned)(jax.random.split(jax.random.key(0), count), angles)
figure, axes = plt.subplots()
for delta in (0.05, 0.52):
    moved = ptsmc.with_gains(parts, {"delta": delta})
    found = jax.vmap(simulate, (None, 0, 0))(moved, attitudes, jnp.arange(count, dtype=jnp.uint32)).metrics
    axes.plot(np.rad2deg(angles), found.peak_torque, ".", label=f"delta = {delta:g} s")
axes.set(
    xlabel="initial angle [deg]",
    ylabel="peak torque [N m]",
    title="With a late hand-over, sensor noise sets the peak torque",
)
_ = axes.legend()

# %% [markdown]
# ## Sensitivities
#
# `jax.jacfwd` differentiates metrics by gains through every sample of the simulation. The table has the change of each
# metric in per cent for one per cent of each gain,
#
# $$
# \frac{\partial \ln m}{\partial \ln g} = \frac{g}{m}\,\frac{\partial m}{\partial g} .
# $$


# %%
@jax.jit
def outcome(gains):
    metrics = ptsmc.simulate_parts(ptsmc.with_gains(parts, gains), 0, 1).metrics
    return {"pointing error": jnp.log(metrics.window_error), "peak torque": jnp.log(metrics.peak_torque)}


gains = {"eta": 3.0, "delta": 0.52, "observer_gain": 10.0, "k1": 1.0}
gains = {name: jnp.asarray(value, jnp.float64) for name, value in gains.items()}  # one type, so one compilation
for metric, row in jax.jacfwd(outcome)(gains).items():
    print(f"{metric:15s}", {name: f"{float(value * gains[name]):+.2f} %" for name, value in row.items()})

# %% [markdown]
# One per cent more of $\eta$ reduces the error by 4 % and increases the torque by 2 %. One per cent more of $\delta$
# increases the error by 1 % and has no effect on the torque. The other two gains matter less at this point.
#
# ## A custom loss
#
# Any function of the metrics is a loss. This loss weighs the RMS error of 16 slews against the mean effort
# $\int |u|\,\mathrm{d}t$,
#
# $$
# \ln \sqrt{\tfrac1{16} \textstyle\sum_i J_i^2} \;+\; 0.5\ \overline{\int |u_i|\,\mathrm{d}t} .
# $$
#
# Adam minimises it over the logarithms of four gains. A traced run raises no error. If a run does not reach its end, for
# example because it diverged, `ptsmc.has_finished` of its status is false, and the loss is set to NaN. A run that has not
# converged at $t_f$ has finished, and its metrics count.

# %%
some = jnp.linspace(0, count - 1, 16).astype(int)


def loss(logs):
    moved = ptsmc.with_gains(parts, {name: jnp.exp(value) for name, value in logs.items()})
    run = jax.vmap(simulate, (None, 0, 0))(moved, attitudes[some], some.astype(jnp.uint32))
    rms, effort = jnp.sqrt(jnp.mean(run.metrics.window_error**2)), jnp.mean(run.metrics.effort)
    finished = jnp.all(ptsmc.has_finished(run.status))
    value = jnp.where(finished, jnp.log(rms) + 0.5 * effort, jnp.nan)
    return value, (value, rms, effort)


optimiser = optax.adam(0.1)
logs = {name: jnp.log(value) for name, value in gains.items()}
state, course = optimiser.init(logs), []
step = jax.jit(jax.jacfwd(loss, has_aux=True))
for _ in range(40):
    gradient, seen = step(logs)
    updates, state = optimiser.update(gradient, state)
    logs = optax.apply_updates(logs, updates)
    course.append([float(value) for value in seen])
print({name: f"{float(jnp.exp(value)):.3g}" for name, value in logs.items()})
for place, (_, rms, effort) in {"first": course[0], "last": course[-1]}.items():
    print(f"{place} step: {arcsec(rms):.2f} arcsec, effort {effort:.3f} N m s")

# %% [markdown]
# The pointing error falls by a factor of nine, for 14 % more effort. It rises for a step if a step of Adam is too long.
# `ptsmc tune` uses sequential quadratic programming instead, which also keeps hard limits.

# %%
figure, axes = plt.subplots()
axes.semilogy([arcsec(rms) for _, rms, _ in course])
_ = axes.set(xlabel="step of Adam", ylabel="RMS pointing error [arcsec]", title="Forty steps of Adam")

# %% [markdown]
# Use forward mode (`jacfwd`), because there are few gains. Reverse mode stores every sample of a long run.
# [Python](../docs/python.md) lists what else to know, such as the one-sided derivatives by $\delta$.
#
# ## Exercises
#
# 1. Weigh the largest torque of the 16 slews instead of the effort. Is the gradient still useful?
# 2. Add $t_f$ to the gains. Which term of the loss prevents a very long slew?
# 3. Differentiate the pointing error by the *initial attitude*, and find the worst axis of rotation.
#
# **Next:** the [guide by task](../docs/guide.md) uses all steps for one CubeSat.
