# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # From a data sheet to flight code
#
# **You will learn** how to turn the data sheets of a CubeSat into a scenario with requirements on pointing and margins. You
# will verify the designed gains by Monte Carlo, and export C code for a flight computer.
#
# **Time:** 30 minutes. The cells run for about three minutes.
#
# **Before you start:** read [From requirements to gains](03_tuning.ipynb) and [Verify by Monte
# Carlo](04_monte_carlo.ipynb). You need a C compiler and make.

# %%
from ptsmc_jax.configure import configure

configure()

import subprocess
import tempfile
from pathlib import Path

import ptsmc_jax as ptsmc
import tuning

# %% [markdown]
# ## The data sheets
#
# The spacecraft is a 3U CubeSat with a telescope. Replace the numbers by those of your spacecraft.
#
# | component | data | in the scenario |
# |---|---|---|
# | body | 4 kg, 10 x 10 x 34 cm, homogeneous | $J_x = J_y = \frac{m}{12}(0.10^2 + 0.34^2)$, $J_z = \frac{m}{12}\,2\cdot0.10^2$ |
# | three wheels (Blue Canyon RWP015) | 4 mN m, 15 mN m s | `torque_limit`, `momentum_limit` |
# | star tracker | 6 arcsec across and 40 arcsec about its boresight, 1 sigma | `attitude_noise`, the larger value for all axes |
# | gyro (Sensonor STIM210) | angle random walk 0.10 deg/sqrt(h) | `rate_noise_density` |
# | computer | 5 Hz, one period from measurement to torque | `period`, `delay` |
#
# Data sheets often state 3 sigma. Divide such values by 3, because a scenario has 1 sigma. Values with another unit are
# strings, such as `"40 arcsec"`. The tables `[[sensors]]` describe each sensor in more detail: mounting, rate, latency, and
# noise across and about the boresight. The short form of this tutorial is on the safe side.
#
# ## The requirements
#
# From 5 s after a slew on, the telescope (z axis) must point within 60 arcsec. The wheels have to keep a quarter of their
# torque and a fifth of their momentum in reserve. The loop needs a gain margin of 6 dB and a phase margin of 30 degrees.
# For comparison, the 3U CubeSat MinXSS reached 15 to 42 arcsec in orbit, 3 sigma, depending on the axis
# ([Mason et al.](https://arxiv.org/abs/1706.06967)).
#
# The command `ptsmc new mine.toml` writes a scenario with every key and its meaning. Only the keys that differ from the
# default are needed. Gains and their bounds may be left out. They follow from the mission.

# %%
folder = Path(tempfile.mkdtemp())
(folder / "telescope.toml").write_text("""
[spacecraft]
inertia = [0.0419, 0.0419, 0.0067]   # kg m^2

[disturbance]                        # drag, solar pressure, residual dipole
kind = "sinusoid"
amplitude = [5e-7, 5e-7, 5e-7]       # N m
frequency = [1.1e-3, 1.1e-3, 1.1e-3] # rad/s, once in an orbit
bias = [5e-7, 5e-7, 5e-7]

[controller]
error = "multiplicative"
t_f = 40.0                           # duration of a slew [s]

[loop]
mode = "sampled"
clock = "flight"                     # samples at whole periods, as the C code has
period = 0.2                         # 5 Hz
t_end = 60.0
window = 2.0

[hardware]
delay = 1                            # period from measurement to torque
attitude_noise = "40 arcsec"
rate_noise_density = "0.1 deg/sqrt(h)"
rate_bias_walk = 1e-6                # rad/s/sqrt(s)

[filter]
kind = "steady_state"

[wheels]
kind = "axes"
torque_limit = "4 mN m"
momentum_limit = "15 mN m s"

[dispersion]
attitude = { kind = "axis_angle", min_deg = 20.0, max_deg = 90.0 }
rate = { kind = "normal", std = 1e-3 }
inertia = { kind = "relative_normal", std = 0.05, axes_deg = 2.0 }
disturbance_phase = { kind = "uniform" }

[pointing]
boresight = [0.0, 0.0, 1.0]
window = 2.0
after = 5.0

[requirements]
ape_boresight = "60 arcsec"
peak_wheel_torque = "3 mN m"
peak_wheel_momentum = "12 mN m s"
gain_margin = 6.0
phase_margin = 30.0
""")
telescope = ptsmc.read(folder / "telescope.toml")

# %% [markdown]
# ## A first run
#
# The scenario has no gains, so the simulator uses gains designed for this mission. One trial shows whether the description
# is plausible: the duration of the slew, the torque and the momentum of the wheels.

# %%
run = ptsmc.simulate(telescope, trial=7)
for verdict in run.verdicts:
    print(verdict)
run.plot("error", "wheels", "wheel_torque")

# %% [markdown]
# ## Verify
#
# Are the designed gains good enough? A campaign simulates 1 000 slews from random attitudes, with uncertain inertia and
# rate. Every requirement has a verdict. The pointing budget lists the angle that 99.73 % of the slews keep, with 95 %
# confidence.

# %%
campaign = tuning.montecarlo(telescope, 1000, folder=folder / "campaign")
campaign

# %% [markdown]
# The fan has the pointing error over time, with its median and its quantiles. The distributions have all trials beside the
# limits.

# %%
campaign.plot("fan", "distributions")

# %% [markdown]
# The nominal loop has these margins in the hold phase. The verdict above has the worst of 256 loops with different
# inertias.

# %%
tuning.margins(telescope).plot("nichols")

# %% [markdown]
# ## Tune
#
# The designed gains are a start. `tuning.tune(telescope)` searches for the gains with the smallest error that keep all
# requirements, and verifies them on new trials. It takes many minutes for a loop with an attitude filter, so this notebook
# does not run it. The commands at the end of the page do.
#
# ## Export C code
#
# `ptsmc.export` writes the flight software as C99: attitude filter, observer, law and wheel allocation. It allocates no memory
# and needs only `math.h` and `stdint.h`. `make check` compiles it and replays trials of the simulator, sample by sample.

# %%
ptsmc.export(telescope, folder / "controller", name="telescope")
print(*sorted(path.name for path in (folder / "controller").iterdir()))
checked = subprocess.run(
    ["make", "-s", "-C", folder / "controller", "check"], capture_output=True, text=True, check=True
)
print(checked.stdout.strip())

# %% [markdown]
# ## Replay with the C code in the loop
#
# The simulator can call the compiled C code at every sample. The metrics of 100 trials agree with those of the simulator
# to rounding.

# %%
ours = ptsmc.trials(telescope, 100, seed=1000)
theirs = ptsmc.trials(telescope, 100, seed=1000, controller=folder / "controller")
for metric in ("window_error", "ape_boresight", "peak_wheel_torque"):
    difference = (theirs[metric] / ours[metric] - 1.0).abs().max()
    print(f"{metric:18s} largest relative difference {difference:.1e}")

# %% [markdown]
# ## The same in commands
#
# ```
# ptsmc tune telescope.toml
# ptsmc montecarlo out/tune-telescope/tuned.toml --trials 1000
# ptsmc margins out/tune-telescope/tuned.toml
# ptsmc report out/montecarlo-tuned
# ptsmc export out/tune-telescope/tuned.toml --out out/controller
# make -C out/controller check
# ```
#
# ## Exercises
#
# 1. Replace `[hardware]` and `[filter]` by `[[sensors]]` with both noises of the star tracker. Which mounting is best?
# 2. Require `ape_boresight` of 30 arcsec. Which requirement conflicts with it?
# 3. Let one wheel fail with `wheel_failure` in `[dispersion]`, and use a pyramid of four wheels.
#
# **Next:** describe your spacecraft. [Guide by task](../docs/guide.md) and [scenario files](../docs/scenarios.md) have all
# keys.
