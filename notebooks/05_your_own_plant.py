# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A custom plant
#
# **You will learn** how to describe a plant by a few JAX functions, and how to simulate and differentiate it. The true
# plant may differ from the design model.
#
# **Time:** 15 minutes. The cells run for about a minute.
#
# **Before you start:** read [The control law](01_paper.ipynb). You know `jax.numpy`.

# %%
from ptsmc_jax.configure import configure

configure()

import dataclasses

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import ptsmc_jax as ptsmc

plt.style.use("ptsmc_jax.figures.ptsmc")

# %% [markdown]
# ## The plant
#
# The law controls any system of the form
#
# $$
# \dot x_1 = F(t, x), \qquad \dot x_2 = H(t, x) + G(t, x)\,u + D(t, x)\,d .
# $$
#
# Here $u$ is the input and $d$ is the disturbance. The state $x_1$ is the error, which the law brings to zero at $t_f$.
#
# Our example is a pendulum. Its angle $\varphi$ must follow $\sin t$:
#
# $$
# J\,\ddot\varphi = -J\,g\,\sin\varphi - J\,b\,\dot\varphi + u + d, \qquad J = 0.5,\; g = 9.81,\; b = 0.1 .
# $$
#
# The error is $x_1 = \varphi - \sin t$, so $F = x_2 - \cos t$. The rate is $x_2 = \dot\varphi$. The law needs Jacobians of
# these functions. Automatic differentiation computes them.

# %%
pendulum = ptsmc.system(
    1,
    F=lambda t, x_1, x_2: x_2 - jnp.cos(t),
    H=lambda t, x_1, x_2: -9.81 * jnp.sin(x_1 + jnp.sin(t)) - 0.1 * x_2,
    G=lambda t, x_1, x_2: jnp.eye(1) / 0.5,
    D=lambda t, x_1, x_2: jnp.eye(1) / 0.5,
)
swing = ptsmc.from_tables(
    {
        "plant": {"kind": "system", "system": pendulum, "x0": [1.0, 0.0]},
        "controller": {"t_f": 4.0, "eta": 3.0, "delta": 0.2, "disturbance_rate_bound": 0.6},
        "observer": {"kind": "nonlinear", "gain": [40.0]},
        "disturbance": {"kind": "sinusoid", "amplitude": [0.3], "frequency": [2.0]},
    }
)
run = ptsmc.simulate(swing)
print(f"status {run.status}; RMS error in the window after t_f: {run.metrics['window_error']:.2e} rad")

# %% [markdown]
# The pendulum starts 1 rad away from the reference and follows it from $t_f = 4$ s on.

# %%
history = run.to_polars()
figure, axes = plt.subplots()
axes.plot(history["t"], history["error1"] + np.sin(history["t"]), label=r"angle $\varphi$")
axes.plot(history["t"], np.sin(history["t"]), color="0.4", ls="--", label=r"reference $\sin t$")
axes.axvline(4.0, color="0.3", ls="--", lw=1)
axes.set(xlabel="time [s]", ylabel="angle [rad]", title="The pendulum follows its reference from $t_f$ on")
_ = axes.legend()

# %% [markdown]
# The error stays below the bound of the theory (dashed). This bound holds for a continuous loop without noise.

# %%
run.plot("error")

# %% [markdown]
# ## The time does not depend on the start
#
# Five starts have errors from 0.1 to 3 rad. Just before $t_f$ all errors are below 1e-3 rad. This is the meaning of
# *prescribed* time. Each start arrives with another small rate, which the constant gains remove within three seconds. The
# remaining error is the lag of the observer behind the disturbance. It is the same for every start.

# %%
figure, axes = plt.subplots()
for angle in (0.1, 0.5, 1.0, 2.0, 3.0):
    history = ptsmc.simulate(ptsmc.replace(swing, plant__x0=[angle, 0.0])).to_polars()
    axes.semilogy(history["t"], np.abs(history["error1"]) + 1e-9, label=f"from {angle:g} rad")
axes.axvline(4.0, color="0.3", ls="--", lw=1)
axes.set(xlabel="time [s]", ylabel="|error| [rad]", title="Every start arrives at the same time")
_ = axes.legend()

# %% [markdown]
# ## Another true plant
#
# The simulated plant may differ from the model of law and observer. With `plant__truth` the true pendulum has a tenth more
# inertia at the same weight, so all its accelerations are smaller. The observer estimates the difference as a disturbance.

# %%
heavier = ptsmc.system(
    1,
    F=pendulum.F,
    H=lambda t, x_1, x_2: (-9.81 * jnp.sin(x_1 + jnp.sin(t)) - 0.1 * x_2) / 1.1,
    G=lambda t, x_1, x_2: jnp.eye(1) / 0.55,
    D=lambda t, x_1, x_2: jnp.eye(1) / 0.55,
)
for name, truth in {"as modelled": pendulum, "a tenth more inertia": heavier}.items():
    error = ptsmc.simulate(ptsmc.replace(swing, plant__truth=truth)).metrics["window_error"]
    print(f"{name:21s} {error:.2e} rad")

# %% [markdown]
# The error increases by a tenth. The feedback and the observer compensate the rest of the difference.
#
# ## Gradients
#
# `ptsmc.study` returns the parts of a run, and `ptsmc.simulate_parts` is a pure function of them. This cell differentiates
# the largest input by $\eta$, and compares the derivative with a finite difference.

# %%
parts = ptsmc.study(swing).parts


@jax.jit
def peak(eta):
    changed = dataclasses.replace(parts, controller=dataclasses.replace(parts.controller, eta=eta))
    return ptsmc.simulate_parts(changed).metrics.peak_torque


derivative = jax.jacfwd(peak)(jnp.asarray(3.0))
difference = (peak(3.0001) - peak(2.9999)) / 2e-4
print(f"derivative {derivative:.6f}, finite difference {difference:.6f}")

# %% [markdown]
# ## Errors of configuration
#
# An invalid value raises one sentence with the key, the value, and the allowed values. Nothing is simulated.

# %%
try:
    ptsmc.replace(swing, controller__eta=1.5)
except ptsmc.ScenarioError as error:
    print(error)

# %% [markdown]
# ## In a scenario file
#
# The commands accept a custom plant, too. Write `system = "my_plant.py:pendulum"` into the table `[plant]`, and run
# `ptsmc tune` on the file. `scenarios/two_link_arm.toml` is an example with its equations beside it.
#
# ## Exercises
#
# 1. Let the pendulum swing up: start it at $\varphi = \pi$.
# 2. Sample the loop with `loop={"mode": "sampled", "period": 0.02}`. Is `delta` = 0.2 s still a good choice?
# 3. Add a damping that is quadratic in the rate to the true pendulum only.
#
# **Next:** [A custom law](06_your_own_law.ipynb).
