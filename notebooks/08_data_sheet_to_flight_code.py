# ---
# jupyter:
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # From a data sheet to C code
#
# **You will learn** how to turn the data sheets of a CubeSat into a scenario. You will tune its gains for requirements on
# pointing and margins, verify them by Monte Carlo, and export the flight software as C.
#
# **Time:** 30 minutes. The cells run for about ten minutes on two cores.
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
# The spacecraft is a 3U CubeSat with a telescope along its z axis. Replace the numbers by those of your spacecraft.
#
# | component | data | in the scenario |
# |---|---|---|
# | body | 4 kg, 10 x 10 x 34 cm, homogeneous | $J_x = J_y = \frac{m}{12}(0.10^2 + 0.34^2)$, $J_z = \frac{m}{12}\,2\cdot0.10^2$ |
# | three wheels, one on each axis | 4 mN m, 15 mN m s | `torque_limit`, `momentum_limit` |
# | star tracker | 1 sigma: 6 arcsec across the boresight, 40 arcsec about it | `noise_across`, `noise_about` |
# | gyro | angle random walk 0.10 deg/sqrt(h), bias walk 1e-6 rad/s/sqrt(s) | `rate_noise_density`, `rate_bias_walk` |
# | computer (assumption) | 5 Hz, one period from measurement to torque | `period`, `delay` |
# | drag, solar pressure, residual dipole (assumption) | 1 µN m at most about each axis, varying once in an orbit | `[disturbance]` |
#
# The values are typical of parts for CubeSats, and belong to no single product. NASA's [State-of-the-Art Small Spacecraft
# Technology](https://www.nasa.gov/smallsat-institute/sst-soa/guidance-navigation-and-control/) lists what is on the market.
# Many data sheets state 3 sigma, and a scenario has 1 sigma. A value in another unit is a string, such as `"6 arcsec"`.
#
# The star tracker looks along the telescope. Its large noise about the boresight then hardly moves the line of sight.
#
# ## The requirements
#
# From 5 s after a slew on, the telescope must point within 60 arcsec. The wheels keep a quarter of their torque and a fifth
# of their momentum in reserve. The loop needs a gain margin of 6 dB and a phase margin of 30 degrees. The 3U CubeSat MinXSS-1
# reached 15 to 42 arcsec in orbit, 3 sigma ([Mason et al.](https://arxiv.org/abs/1706.06967)).
#
# The file has only the keys that differ from the defaults. `ptsmc new mine.toml` writes a file with every key and its
# meaning. Gains and their bounds may be absent, because they follow from the mission. `[tune]` makes the search smaller than
# usual, to save time.

# %%
folder = Path(tempfile.mkdtemp())
(folder / "telescope.toml").write_text("""
[spacecraft]
inertia = [0.0419, 0.0419, 0.0067]   # kg m^2

[disturbance]
kind = "sinusoid"
amplitude = [5e-7, 5e-7, 5e-7]       # N m
frequency = [1.1e-3, 1.1e-3, 1.1e-3] # rad/s
bias = [5e-7, 5e-7, 5e-7]

[controller]
error = "multiplicative"
t_f = 40.0                           # duration of a slew [s]

[loop]
mode = "sampled"
clock = "flight"                     # samples at whole periods, as the C code has
period = 0.2
t_end = 60.0
window = 2.0

[hardware]
delay = 1

[[sensors]]
kind = "star_tracker"
boresight = [0.0, 0.0, 1.0]
noise_across = "6 arcsec"
noise_about = "40 arcsec"

[[sensors]]
kind = "gyro"
rate_noise_density = "0.1 deg/sqrt(h)"
rate_bias_walk = 1e-6                # rad/s/sqrt(s)

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

[tune]
trials = 16
starts = 2
""")
telescope = ptsmc.read(folder / "telescope.toml")

# %% [markdown]
# ## A first run
#
# Without gains in the file, the simulator uses gains designed for this mission. One trial shows whether the description is
# plausible: the duration of the slew, the torque and the momentum of the wheels.

# %%
run = ptsmc.simulate(telescope, trial=7)
for verdict in run.verdicts:
    print(verdict)
run.plot("error", "wheels")

# %% [markdown]
# ## Tune
#
# The search minimises the RMS pointing error in the two seconds after $t_f$, and keeps every requirement. A Kalman filter
# combines the sensors, and the search differentiates through it.

# %%
tuned = tuning.tune(telescope)
tuned

# %% [markdown]
# ## Verify
#
# A campaign simulates 2 000 slews with another seed. The attitude, the rate, the inertia and the noise are random. Every
# requirement has a verdict. The pointing budget lists the angles that 99.73 % of the slews keep, with 95 % confidence.

# %%
campaign = tuning.montecarlo(tuned.scenario, 2_000, folder=folder / "campaign")
campaign

# %%
campaign.plot("fan", "distributions")

# %% [markdown]
# The Nichols chart has the nominal loop in the hold phase. The verdict above is on the worst of 256 loops with different
# inertias.

# %%
tuning.margins(tuned.scenario).plot("nichols")

# %% [markdown]
# ## Export C code
#
# `ptsmc.export` writes the flight software as C99: attitude filter, observer, law and wheel allocation. It allocates no memory
# and needs only `math.h` and `stdint.h`. `make check` compiles it and replays trials of the simulator, sample by sample.

# %%
code = ptsmc.export(tuned.scenario, folder / "controller", name="telescope")
print(*sorted(path.name for path in code.iterdir()))
checked = subprocess.run(["make", "-s", "-C", code, "check"], capture_output=True, text=True, check=True)
print(checked.stdout.strip())

# %% [markdown]
# ## Simulate with the C code
#
# The simulator can call the compiled C code at every sample. The first 100 trials of the campaign have the same metrics, up
# to rounding.

# %%
with_code = tuning.montecarlo(tuned.scenario, 100, folder=folder / "campaign_with_code", controller=code)
for metric in ("window_error", "ape_boresight", "peak_wheel_torque"):
    difference = (with_code.rows[metric] / campaign.rows[metric].head(100) - 1.0).abs().max()
    print(f"{metric:18s} largest relative difference {difference:.1e}")

# %% [markdown]
# ## The same in commands
#
# ```
# ptsmc tune telescope.toml
# ptsmc montecarlo out/tune-telescope/tuned.toml --trials 2000
# ptsmc margins out/tune-telescope/tuned.toml
# ptsmc report out/montecarlo-tuned
# ptsmc export out/tune-telescope/tuned.toml --out out/controller
# make -C out/controller check
# ```
#
# ## Exercises
#
# 1. Mount the star tracker across the telescope, with `boresight = [1.0, 0.0, 0.0]`. How much accuracy does it cost?
# 2. Require `ape_boresight` of 10 arcsec. Which requirement conflicts with it?
# 3. Use a pyramid of four wheels, and let one fail with `wheel_failure` in `[dispersion]`.
#
# **Next:** describe your spacecraft. [Guide by task](../docs/guide.md) and [scenario files](../docs/scenarios.md) have all
# keys.
