# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # What can be done with the derivative of a flight?
#
# `ptsmc tune` is one way to use it. Below the commands stands a pure function, from the parts of a flight to its metrics,
# that composes with `jax.vmap`, `jax.jacfwd` and `jax.jit` like any other: this notebook uses it as it is.

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

flight = ptsmc.read("../scenarios/first_flight.toml")
parts = ptsmc.study(flight, reach=ptsmc.reach_of(flight, delta=3.0)).parts  # a pytree; delta may move as far

# %% [markdown]
# ## Many initial attitudes
#
# A run from another attitude is the same parts with another leaf. `jax.vmap` flies two hundred of them, turned by 20 to
# 140 degrees about random axes, with two hand-overs. With the paper's, 0.05 s before t_f, noise asks for the most torque,
# however far there is to go; half a second before t_f it is the first torque that is largest, and it grows with the angle.


# %%
def fly(parts, q, trial):
    initial = parts.initial._replace(q=q)
    return ptsmc.simulate_parts(dataclasses.replace(parts, initial=initial), 0, trial)


def turned(key, angle):
    axis = jax.random.normal(key, (3,))
    return jnp.append(axis / jnp.linalg.norm(axis) * jnp.sin(angle / 2), jnp.cos(angle / 2))


count = 200
angles = jnp.deg2rad(jnp.linspace(20.0, 140.0, count))
attitudes = jax.vmap(turned)(jax.random.split(jax.random.key(0), count), angles)
figure, axes = plt.subplots(figsize=(8, 3.5))
for delta in (0.05, 0.52):
    moved = ptsmc.with_gains(parts, {"delta": delta})
    found = jax.vmap(fly, (None, 0, 0))(moved, attitudes, jnp.arange(count, dtype=jnp.uint32)).metrics
    axes.plot(np.rad2deg(angles), found.peak_torque, ".", label=f"delta = {delta:g} s")
axes.set(xlabel="initial angle [deg]", ylabel="peak torque [N m]")
_ = axes.legend()

# %% [markdown]
# ## What each gain does
#
# `jax.jacfwd` differentiates a metric by the gains through every sample of the flight. Here is the change of the window
# error and of the peak torque, in percent, for one percent of each gain. With this hand-over, half a second before t_f, a
# larger eta buys accuracy with torque, and a larger delta costs accuracy and nothing else.


# %%
@jax.jit
def outcome(gains):
    run = ptsmc.simulate_parts(ptsmc.with_gains(parts, gains), 0, 1).metrics
    return {"window error": jnp.log(run.window_error), "peak torque": jnp.log(run.peak_torque)}


gains = {"eta": 3.0, "delta": 0.52, "observer_gain": 10.0, "k1": 1.0}
gains = {name: jnp.asarray(value, jnp.float64) for name, value in gains.items()}  # not weakly typed: compiled once
slopes = jax.jacfwd(outcome)(gains)
for metric, row in slopes.items():
    print(metric, {name: f"{float(slope * gains[name]):+.2f} %" for name, slope in row.items()})

# %% [markdown]
# ## A loss of one's own
#
# Remark 1 of the paper weighs accuracy against torque. Any function of the metrics will do: here the logarithm of the
# error over sixteen attitudes with a price on the effort, which no command offers, and Adam on the logarithms of the
# gains, in fifteen lines. A traced run does not raise: one that did not arrive makes the loss not a number.

# %%
some = jnp.linspace(0, count - 1, 16).astype(int)


def loss(logs):
    moved = ptsmc.with_gains(parts, {name: jnp.exp(value) for name, value in logs.items()})
    run = jax.vmap(fly, (None, 0, 0))(moved, attitudes[some], some.astype(jnp.uint32))
    value = jnp.log(jnp.sqrt(jnp.mean(run.metrics.window_error**2))) + 0.5 * jnp.mean(run.metrics.effort)
    value = jnp.where(jnp.all(run.status == 0), value, jnp.nan)
    return value, value


optimiser = optax.adam(0.1)
logs = {name: jnp.log(value) for name, value in gains.items()}
state, course = optimiser.init(logs), []
step = jax.jit(jax.jacfwd(loss, has_aux=True))
for _ in range(40):
    slope, value = step(logs)
    updates, state = optimiser.update(slope, state)
    logs = optax.apply_updates(logs, updates)
    course.append(float(value))
print({name: f"{float(jnp.exp(value)):.3g}" for name, value in logs.items()})

# %% [markdown]
# The error falls by a factor of nine, for 15 % more effort: the price at which that pays. The loss rises for a few steps where a
# step of Adam is too long for the valley it has come to; `ptsmc tune` follows the valley by sequential quadratic
# programming, with its limits in view.

# %%
figure, axes = plt.subplots(figsize=(8, 3))
axes.plot(course)
_ = axes.set(xlabel="step of Adam", ylabel="ln error + 0.5 effort/(N m s)")

# %% [markdown]
# Derivatives go forward, in the few gains; a long run differentiated backward would keep all of its samples. What the
# commands make of them stands in [the method](../docs/theory/index.md) and in the notebook on tuning.
