# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # Why the published gains fail in a digital loop
#
# **You will learn** why gains that are accurate in continuous time amplify noise in a sampled loop. You will see how large
# the torque becomes, and how the hand-over time $\delta$ changes both.
#
# **Time:** 20 minutes. The cells run for about two minutes.
#
# **Before you start:** read [The control law](01_paper.ipynb).

# %%
from ptsmc_jax.configure import configure

configure()

import matplotlib.pyplot as plt
import numpy as np

import ptsmc_jax as ptsmc

plt.style.use("ptsmc_jax.figures.ptsmc")


def arcsec(v):
    """Return the angle 2 asin |v| of an error vector in arcsec."""
    return np.degrees(2.0 * np.arcsin(v)) * 3600.0


# %% [markdown]
# ## The same law with real sensors
#
# The scenario `first_flight` has a control period $h = 0.05$ s. Its star tracker has a noise of $2\cdot10^{-5}$ rad
# (4 arcsec), its gyro has $10^{-6}$ rad/s. The gains are the published ones, with a hand-over one period before $t_f$.

# %%
noisy = ptsmc.replace(ptsmc.read("../scenarios/first_flight.toml"), loop__clock="flight")  # samples at whole periods
quiet = ptsmc.replace(noisy, hardware=None)
runs = {"without noise": ptsmc.simulate(quiet), "with noise": ptsmc.simulate(noisy)}
for label, run in runs.items():
    print(f"{label:15s} {arcsec(run.metrics['window_error']):6.1f} arcsec, {run.metrics['peak_torque']:.2f} N m")

# %% [markdown]
# The noise of 4 arcsec becomes a much larger pointing error after $t_f$. The left plot shows the whole slew. The right
# plot shows the last second before $t_f$ and the hold phase. The noise enters in the last samples of the approach, and the
# slow constant gains need seconds to remove the error.

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 4))
for label, run in runs.items():
    history = run.to_polars()
    error = np.sqrt(sum(history[f"error{k}"].to_numpy() ** 2 for k in (1, 2, 3)))
    for axes in (left, right):
        axes.semilogy(history["t"], arcsec(error), label=label)
for axes in (left, right):
    axes.axvline(35.0, color="0.3", ls="--", lw=1)
    axes.set(xlabel="time [s]")
left.set(ylabel="pointing error [arcsec]", ylim=(0.1, 1e6), title="Both runs arrive at $t_f$ = 35 s")
right.set(xlim=(34, 45), ylim=(0.1, 1e4), title="Noise enters just before $t_f$")
_ = left.legend()

# %% [markdown]
# ## The torque grows with the gains
#
# The law multiplies the attitude by $\eta^2/\tau^2$. Attitude noise $\sigma$ (angle, rad) therefore causes a torque of
# about
#
# $$
# u \approx J\,\frac{\eta^2}{\tau^2}\,\sigma .
# $$
#
# The plot shows the torque over the time to go, and this estimate. For $\eta = 5$ the torque exceeds the estimate by far
# in the last samples. The reason follows in the next section.

# %%
figure, axes = plt.subplots()
for color, eta in (("C0", 3.0), ("C1", 5.0)):
    history = ptsmc.simulate(ptsmc.replace(noisy, controller__eta=eta)).to_polars()
    tau = 35.0 - history["t"].to_numpy()
    torque = np.abs(history.select("u1", "u2", "u3").to_numpy()).max(axis=1)
    approach = tau > 0.051  # before the hand-over
    axes.loglog(tau[approach], torque[approach], color=color, label=rf"simulated, $\eta$ = {eta:g}")
    axes.loglog(tau[approach], 12.0 * (eta / tau[approach]) ** 2 * 2e-5, color=color, lw=1, ls=":")
axes.plot([], [], color="0.3", lw=1, ls=":", label=r"$J\,\eta^2\sigma/\tau^2$")
axes.axhline(0.5, color="0.3", ls="--", lw=1, label="required: below 0.5 N m")
axes.set(xlabel=r"time to go $\tau$ [s]", ylabel="largest torque of an axis [N m]", xlim=(35, 0.04), ylim=(1e-3, 20))
axes.set_title("In the last second, noise needs more torque than the slew")
_ = axes.legend()

# %% [markdown]
# ## The natural frequency reaches the sampling limit
#
# The law is a PD controller with the natural frequency $\eta/\tau$. At $\tau = \delta = 0.05$ s it is 60 rad/s for
# $\eta = 3$. The Nyquist frequency of the loop is $\pi/h = 63$ rad/s. A sampled loop is unstable well before this limit.
# With the gains of one moment held constant it is stable only if
#
# $$
# \frac{(2\eta - 1)\,h}{\tau} < 2 , \qquad\text{that is}\qquad \tau > (\eta - \tfrac12)\,h .
# $$
#
# For $\eta = 3$ this is 0.125 s, for $\eta = 5$ it is 0.225 s. The published hand-over at 0.05 s is too late for both.
# The markers show where each loop becomes unstable. [Theory](../docs/theory/sampling.md) derives this limit.

# %%
period, tau = 0.05, np.geomspace(0.05, 35.0, 300)
figure, axes = plt.subplots()
for color, eta in (("C0", 3.0), ("C1", 5.0)):
    limit = (eta - 0.5) * period
    axes.loglog(tau, eta / tau, color=color, label=rf"$\eta/\tau$, $\eta$ = {eta:g}")
    axes.loglog(limit, eta / limit, "o", color=color, label=f"unstable below {limit:g} s")
axes.axhline(np.pi / period, color="0.3", ls="--", lw=1, label=r"Nyquist frequency $\pi/h$")
axes.set(xlabel=r"time to go $\tau$ [s]", ylabel="natural frequency [rad/s]", xlim=(35, 0.04))
axes.set_title("The gains are too large for the period before the hand-over")
_ = axes.legend()

# %% [markdown]
# ## Three hundred slews
#
# `ptsmc.trials` simulates slews from random attitudes, 20 to 140 degrees away. The table has the RMS pointing error after
# $t_f$ and the mean of the peak torque, for both values of $\eta$ in the paper.


# %%
def measured(case, count=300):
    rows = ptsmc.trials(case, count)
    return arcsec(np.sqrt((rows["window_error"] ** 2).mean())), rows["peak_torque"].mean()


for eta in (3.0, 5.0):
    for label, case in {"without noise": quiet, "with noise": noisy}.items():
        error, peak = measured(ptsmc.replace(case, controller__eta=eta))
        print(f"eta {eta:g}, {label:14s} {error:7.1f} arcsec, {peak:.2f} N m")

# %% [markdown]
# ## An earlier hand-over
#
# A larger $\delta$ limits the gains, so less noise reaches the torque. If $\delta$ is too large, the slow constant gains
# must remove a larger error. The noisy curve therefore has a minimum.

# %%
deltas = np.geomspace(0.05, 4.0, 9)
errors = {
    label: [measured(ptsmc.replace(case, controller__delta=float(delta)))[0] for delta in deltas]
    for label, case in {"without noise": quiet, "with noise": noisy}.items()
}
figure, axes = plt.subplots()
for label, values in errors.items():
    axes.loglog(deltas, values, "o-", label=label)
axes.set(xlabel=r"hand-over before $t_f$, $\delta$ [s]", ylabel="RMS pointing error [arcsec]")
axes.set_title("The best hand-over with noise is earlier")
_ = axes.legend()
best = int(np.argmin(errors["with noise"]))
print(f"smallest error with noise: {errors['with noise'][best]:.1f} arcsec at delta = {deltas[best]:.2f} s")

# %% [markdown]
# One gain alone reduces the error by more than a factor of ten. The remaining error is still larger than the noise of one
# star tracker sample. All gains together do better, and the observer and the constant gains matter most.
#
# ## Exercises
#
# 1. Set `loop__period=0.1`. Where is the stability limit now? Check it with the torque plot.
# 2. Add an attitude filter with `filter={"kind": "steady_state"}`. Which of the two errors changes?
# 3. Run the last cell with $\eta = 5$. Does the best $\delta$ move as the stability limit does?
#
# **Next:** [From requirements to gains](03_tuning.ipynb) finds all gains at once, within limits on torque and margins.
