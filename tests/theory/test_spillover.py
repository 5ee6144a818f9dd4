"""What a mode that the law does not know does to the loop: linear theory."""

import numpy as np

from ptsmc_jax import scenario
from ptsmc_jax.theory import covariance, margins

# one mode about x that a late loop of some bandwidth drives; no noise, no switching term, small angles: it is linear
SPILLS = {
    "flexible": {"frequency": [6.0], "damping": [0.02], "coupling": [[1.6, 0.0, 0.0]]},
    "controller": {
        "t_f": 6.0, "delta": 2.0, "k1": 2.0, "surface_rate": 1.0, "disturbance_bound": 0.0, "error": "multiplicative",
    },
    "initial": {"rotvec_deg": [0.2, 0.1, -0.1]},
    "disturbance": {"kind": "none"},
    "observer": {"kind": "none"},
    "loop": {"mode": "sampled", "period": 0.2, "t_end": 32.0},
    "hardware": {"delay": 1},
}  # fmt: skip


def test_margins_see_the_mode_and_sensors_see_the_body_alone():
    parts = scenario.study(
        scenario.from_tables({**SPILLS, "controller": {**SPILLS["controller"], "k1": 0.2, "surface_rate": 0.2}})
    ).parts
    course = margins.along(parts)
    loop, hold = course.hold
    assert loop.seen.shape[1] == 6
    assert course.at_sensors.gain_up.shape == (6,)
    assert hold.gain_up[0] < hold.gain_up[1] - 3.0  # the mode rings about x


def test_noise_by_linear_covariance_is_that_of_flown_trials():
    from ptsmc_jax.campaigns import montecarlo

    tables = {
        **SPILLS,
        "controller": {**SPILLS["controller"], "k1": 0.2, "surface_rate": 0.2},
        "hardware": {"attitude_noise": 1e-4, "rate_noise": 1e-4},
        "loop": {"mode": "sampled", "period": 0.2, "t_end": 12.0, "window": 4.0},
        "initial": {"quat_xyzw": [0.0, 0.0, 0.0, 1.0]},
    }
    ready = scenario.study(scenario.from_tables(tables))
    flown = montecarlo.run(ready.parts, ready.dispersion, 0, np.arange(512))
    measured = np.sqrt(np.mean(flown.metrics.window_error**2))
    np.testing.assert_allclose(covariance.noise(ready.parts).window_error, measured, rtol=0.1)
