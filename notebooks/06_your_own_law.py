# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # A custom law
#
# **You will learn** how to write a control law as a class, how to compare it with a built-in law, and how to tune its
# gains.
#
# **Time:** 20 minutes. The cells run for about a minute.
#
# **Before you start:** read [From requirements to gains](03_tuning.ipynb).

# %%
from ptsmc_jax.configure import configure

configure()

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import ptsmc_jax as ptsmc

plt.style.use("ptsmc_jax.figures.ptsmc")


def arcsec(v):
    """Return the angle 2 asin |v| of an error vector in arcsec."""
    return np.degrees(2.0 * np.arcsin(v)) * 3600.0


# %% [markdown]
# ## The law
#
# A law is a class with the method `acceleration`. It returns the commanded acceleration $a$ of the error, with
# $\ddot\varepsilon = a + d$, and a sliding variable. The simulator turns $a$ into a torque and subtracts the estimated
# disturbance.
#
# The example is prescribed time by scaling (Song, Wang, Holloway and Krstic, Automatica 83, 2017). Let $\tau = t_f - t$
# and $\mu = (t_f/\tau)^p$. The law keeps the scaled error $\xi = \mu\,\varepsilon$ bounded, so $\varepsilon$ falls like
# $\tau^p$. With $z = \dot\xi + k_1\,\xi = \mu\,s$ it is
#
# $$
# s = \dot\varepsilon + \Bigl(\frac{p}{\tau} + k_1\Bigr)\varepsilon, \qquad
# a = -\frac{2p}{\tau}\,\dot\varepsilon - \frac{p\,(p+1)}{\tau^2}\,\varepsilon
# - k_1\Bigl(\dot\varepsilon + \frac{p}{\tau}\,\varepsilon\Bigr) - k\,\mu\,s .
# $$
#
# Each gain is a field. `ptsmc.gain` declares its default value, its bounds for tuning, and its unit. A bound may be a
# function of $t_f$ and the control period $h$. From `delta` before $t_f$ on, `now.hold` is true and the gains are constant.


# %%
class Scaling(ptsmc.AccelerationLaw):
    """Prescribed time by scaling with the power p = 2 + m."""

    delta: float = ptsmc.gain(3.0, (0.2, 5.0), unit="s")
    m: float = ptsmc.gain(1.0, (1.0, 4.0), above=0.0)
    k1: float = ptsmc.gain(1.0, lambda t_f, h: (0.3 / t_f, 0.5 / h), unit="1/s")
    k: float = ptsmc.gain(1e-3, lambda t_f, h: (1e-5 / t_f, 1.0 / t_f), unit="1/s")

    def acceleration(self, now, error, error_rate, bound):
        p, tau = 2.0 + self.m, jnp.where(now.hold, self.delta, self.t_f - now.t)
        s = error_rate + (p / tau + self.k1) * error
        a = -2.0 * p / tau * error_rate - p * (p + 1.0) / tau**2 * error - self.k1 * (error_rate + p / tau * error)
        return a - self.k * (self.t_f / tau) ** p * s, s


# %% [markdown]
# ## Compare with the built-in law
#
# `kind = "scaling"` is the same law in the package. Both have the same error with the same noise.

# %%
flight = ptsmc.replace(ptsmc.read("../scenarios/first_flight.toml"), tune=None)
laws = {
    "custom": {"kind": "custom", "code": Scaling, "t_f": 35.0, "delta": 3.5},
    "built in": {"kind": "scaling", "t_f": 35.0, "delta": 3.5},
}
runs = {name: ptsmc.simulate(ptsmc.replace(flight, controller=law), trial=7) for name, law in laws.items()}
for name, run in runs.items():
    print(f"{name:9s} {arcsec(run.metrics['window_error']):.6f} arcsec")

# %% [markdown]
# The next plot has both laws, and the prescribed-time law with the published gains. The curves of the two classes coincide.

# %%
runs["published gains"] = ptsmc.simulate(flight, trial=7)
figure, axes = plt.subplots()
for width, (name, run) in zip((4.0, 1.5, 1.5), runs.items(), strict=True):
    history = run.to_polars()
    error = np.linalg.norm([history[f"error{k}"] for k in (1, 2, 3)], axis=0)
    axes.semilogy(history["t"], arcsec(error), lw=width, label=name)
axes.axvline(35.0, color="0.3", ls="--", lw=1)
axes.set(xlabel="time [s]", ylabel="pointing error [arcsec]", title="The custom law equals the built-in law")
_ = axes.legend()

# %% [markdown]
# The torque of the custom law is largest at the start, 0.63 N m. This is above the limit of 0.5 N m (dashed), so the default
# gains need tuning.

# %%
runs["custom"].plot("torque")

# %% [markdown]
# ## Tune it
#
# The tuner takes the gains and their bounds from the class. The next lines tune it for a torque limit and margins. They
# run for several minutes, because the law is compiled with its derivatives.
#
# ```python
# import tuning
#
# requirements = {"peak_torque": 1.0, "gain_margin": 6.0, "phase_margin": 30.0}
# tuned = tuning.tune(ptsmc.replace(flight, controller=laws["custom"], requirements=requirements, tune={}))
# ```
#
# The same class controls the pendulum of the previous notebook, because a law only sees the error and its rate.
#
# ## In a scenario file
#
# Write the class into a Python file and name it in the scenario: `kind = "custom"` and `code = "FILE.py:NAME"` in the table
# `[controller]`. Then run `ptsmc tune` on the scenario. `ptsmc compare SCENARIO.toml --law FILE.py:NAME` tunes the custom
# law and the built-in laws for the same requirements. `scenarios/own_parts.toml` has a custom observer, disturbance,
# reference and sensor, too. [Custom parts](../docs/custom_parts.md) describes them.
#
# ## Exercises
#
# 1. Remove the last term of the law ($k = 0$). Which metric changes most?
# 2. Write a PD law with the gains `k_p` and `k_d`, and tune it for the same requirements.
# 3. Replace $\mu$ by an exponential of $\tau$. Is the error at $t_f$ still independent of the initial attitude?
#
# **Next:** [Derivatives of a simulation](07_gradients.ipynb).
