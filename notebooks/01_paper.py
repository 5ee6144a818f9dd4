# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # The control law
#
# **You will learn** how prescribed-time sliding mode control turns a spacecraft, how large its error and its
# torque are, and how the sign function affects both. The law is the one of Chen, Ju, Wang and Li.
#
# **Time:** 20 minutes. The cells run for about two minutes.
#
# **Before you start:** you know quaternions and PD control. Install the software with `make setup`, and open the notebooks
# with `make notebooks`.

# %%
from ptsmc_jax.configure import configure

configure()  # 64 bit and a compile cache; call it before anything else runs on JAX

import matplotlib.pyplot as plt
import numpy as np

import ptsmc_jax as ptsmc
import tuning

plt.style.use("ptsmc_jax.figures.ptsmc")


def arcsec(v):
    """Return the angle 2 asin |v| of an error vector in arcsec."""
    return np.degrees(2.0 * np.arcsin(v)) * 3600.0


# %% [markdown]
# ## Simulate one slew
#
# An empty scenario is the paper's Case I. The body has moments of inertia of 10, 12 and 14 kg m². It turns by 110 degrees in
# $t_f = 30$ s, while a disturbance of 0.01 N m acts about each axis. The loop is continuous and has no noise.

# %%
case_one = ptsmc.from_tables({})
run = ptsmc.simulate(case_one)
print(f"RMS pointing error in the second after t_f: {arcsec(run.metrics['window_error']):.2f} arcsec")
print(f"largest torque: {run.metrics['peak_torque']:.3f} N m")

# %% [markdown]
# A run has many more metrics. This table lists each of them with its unit and its meaning.

# %%
run.metrics

# %% [markdown]
# ## The law
#
# The error $\varepsilon$ is the vector part of a quaternion, so an error angle $\theta$ has $|\varepsilon| = \sin(\theta/2)$.
# Let $\tau = t_f - t$ be the time to go. Until the *hand-over* at $\tau = \delta$ the law commands
#
# $$
# \ddot\varepsilon = -\frac{2\eta - 1}{\tau}\,\dot\varepsilon - \frac{\eta^2}{\tau^2}\,\varepsilon
# - \tfrac12 N K_2\,\mathrm{sign}(s), \qquad s = \tau\,\dot\varepsilon + \eta\,\varepsilon .
# $$
#
# This is a PD controller whose natural frequency $\eta/\tau$ grows as the time to go shrinks. After the hand-over the gains
# are constant. That part is the *hold phase*. An observer with the gain $l$ estimates the disturbance.
#
# The error falls like $\tau^\eta$, up to a logarithm, from every initial attitude. The next plot shows this fall, with the
# upper bound of Theorem 2 (dashed). After $t_f$ the error rises to the residual error of the observer. The error does not
# stay at zero, because the disturbance keeps changing. An error $|\varepsilon|$ of $10^{-5}$ is an angle of 4.1 arcsec.

# %%
run.plot("error")

# %% [markdown]
# The torque is largest at the start. The exact solution (dotted) assumes a perfect estimate of the disturbance. The first
# torque is proportional to $\eta^2 / t_f^2$, so a smaller $\eta$ needs less torque. This is Remark 1 of the paper.

# %%
run.plot("torque")

# %% [markdown]
# On logarithmic axes both curves are almost straight lines, because they fall like $\tau^\eta$. In the last 10 s the
# sliding variable $s$ leaves its line. There the error of the observer is larger than the motion that the law controls.

# %%
run.plot("convergence")

# %% [markdown]
# ## Discontinuous sign or boundary layer
#
# The theorems assume $\mathrm{sign}(s)$, which is discontinuous. A digital controller cannot switch infinitely fast. It
# switches once in a control period, and the state crosses $s = 0$ again and again. That is *chattering*. The usual remedy
# is a boundary layer, $\tanh(s/w)$, whose thickness $w$ is the key `sign_width`. We compare both at 20 Hz, without noise.

# %%
sampled = ptsmc.replace(case_one, loop={"mode": "sampled", "period": 0.05})
runs = {
    width: ptsmc.simulate(ptsmc.replace(sampled, controller__sign_width=width)) for width in (0.0, 1e-5, 1e-3, 1e-1)
}
print("width    pointing error [arcsec]    chattering in the hold phase [N m/s]")
for width, one in runs.items():
    print(f"{width:<8g} {arcsec(one.metrics['window_error']):<26.2f} {one.metrics['chattering']:.2g}")

# %% [markdown]
# The metric `chattering` is the total variation of the torque in each second. The plot shows the first component of the
# torque around the hand-over.

# %%
figure, axes = plt.subplots()
for width in (0.0, 1e-3):
    history = runs[width].to_polars()
    label = "discontinuous sign" if width == 0.0 else f"boundary layer, w = {width:g}"
    axes.step(history["t"], history["u1"], where="post", lw=1.0, label=label)
axes.axvline(30.0, color="0.3", ls="--", lw=1)
axes.set(xlim=(28, 34), ylim=(-0.03, 0.03), xlabel="time [s]", ylabel="torque $u_1$ [N m]")
axes.set_title("With the discontinuous sign the torque chatters")
_ = axes.legend()

# %% [markdown]
# The discontinuous sign is more accurate than the layer of the paper ($w = 10^{-3}$), because it rejects the disturbance
# that the observer misses. The price is chattering, 160 times as much torque variation. Wheels would wear and excite the
# structure.
#
# A thin layer of $10^{-5}$ is better than both here: it has the smallest error and no chattering. A thick layer rejects less of
# the disturbance. This comparison has no sensor noise. With noise, the layer must be thicker than the noise of $s$, or
# the noise switches the sign. The tuner chooses the thickness. *Implicit sampling* is another remedy, which needs no layer
# ([theory](../docs/theory/law.md)).

# %% [markdown]
# ## The claims of the paper
#
# `ptsmc reproduce` simulates every figure of the paper and checks every claim. The function `tuning.reproduce` returns the
# same report. Most claims hold. The last column has the measured value.

# %%
tuning.reproduce()

# %% [markdown]
# ## Exercises
#
# 1. Change $\eta$ to 5 with `ptsmc.replace(case_one, controller__eta=5.0)`. Predict the largest torque before you run it.
# 2. Start from another attitude, such as `initial={"rotvec_deg": [0.0, 0.0, 30.0]}`. Does the error at $t_f$ change?
# 3. Give the loop a period of 0.5 s. Does the slew still end at the reference?
#
# **Next:** [Sampling and noise](02_sampling_and_noise.ipynb) shows why the published gains fail in a digital loop.
