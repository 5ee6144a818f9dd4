# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A plant of your own
#
# The method is for any system x₁' = F(t, x), x₂' = H(t, x) + G(t, x) u + D(t, x) d, the paper's (25): a few JAX functions,
# and the Jacobians that its law needs come from automatic differentiation. Here a pendulum that is to follow sin t.

# %%
from ptsmc_jax.configure import configure

configure()

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import ptsmc_jax as ptsmc
from ptsmc_jax import scenario
from ptsmc_jax.plants import system

# %% [markdown]
# x₁ is the error, angle minus sin t in rad, so F knows the time; x₂ is the rate. The torque u acts through 1/0.5 kg m², and
# so does the disturbance, a sine of 0.3 N m that an observer estimates.

# %%
pendulum = system(
    1,
    F=lambda t, x_1, x_2: x_2 - jnp.cos(t),
    H=lambda t, x_1, x_2: -9.81 * jnp.sin(x_1 + jnp.sin(t)) - 0.1 * x_2,
    G=lambda t, x_1, x_2: jnp.eye(1) / 0.5,
    D=lambda t, x_1, x_2: jnp.eye(1) / 0.5,
)
swing = scenario.from_tables(
    {
        "plant": {"kind": "system", "system": pendulum, "x0": [1.0, 0.0]},
        "controller": {"t_f": 4.0, "eta": 3.0, "delta": 0.2, "disturbance_rate_bound": 0.6},
        "observer": {"kind": "nonlinear", "gain": [40.0]},
        "disturbance": {"kind": "sinusoid", "amplitude": [0.3], "frequency": [2.0]},
    }
)
run = ptsmc.simulate(swing)
run

# %% [markdown]
# It arrives at t_f = 4 s and follows from then on. The dashed bound is theory's, for a continuous loop such as this one.

# %%
run.plot("states", "error")

# %% [markdown]
# Five starts, one time: until the hand-over (dotted) the law brings every error down to its share of the same small number,
# whatever it was at first, which is what "prescribed" means. What is left after it is what the observer had not yet
# learned, and that does depend on the start; it fades with the constant gains, in seconds.

# %%
figure, axes = plt.subplots(figsize=(8, 4))
for angle in (0.1, 0.5, 1.0, 2.0, 3.0):
    history = ptsmc.simulate(ptsmc.replace(swing, plant__x0=[angle, 0.0])).to_polars()
    axes.semilogy(history["t"], np.abs(history["error1"]) + 1e-9, label=f"from {angle:g}")
axes.axvline(4.0 - 0.2, color="0.4", ls=":")
axes.set(xlabel="time [s]", ylabel="|error| [rad]")
axes.legend()

# %% [markdown]
# For your own jit, vmap and grad there is the pure core: `rollout.simulate(parts, seed, trial)`, with every number of the
# scenario a leaf of `parts`. The slope of the largest input in η, by automatic differentiation and by a difference:

# %%
from dataclasses import replace

from ptsmc_jax.simulation import rollout

parts = scenario.study(swing).parts


@jax.jit
def peak(eta):
    return rollout.simulate(replace(parts, controller=replace(parts.controller, eta=eta))).metrics.peak_torque


slope = jax.jacfwd(peak)(jnp.asarray(3.0))
print(f"{slope:.6f} and {(peak(3.0001) - peak(2.9999)) / 2e-4:.6f} u for a unit of eta")

# %% [markdown]
# Errors say what is wrong and what is allowed, in a sentence. In a notebook that sentence stands in the place of a
# traceback.

# %%
try:
    ptsmc.replace(swing, controller__eta=1.5)
except ptsmc.ScenarioError as error:
    print(error)

# %% [markdown]
# A plant of your own goes through every command: `plant.system = "FILE.py:NAME"` in a scenario file, then
# `ptsmc tune` and `ptsmc montecarlo` as for a spacecraft. `scenarios/two_link_arm.toml` is one, with its equations beside.
