"""Linear theory of sensor suites: lower bound against an independent Kalman filter, covariance against trials."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from ptsmc_jax.signals import disturbances
from ptsmc_jax.simulation import rollout
from ptsmc_jax.theory import covariance, lower_bound
from tests import suites
from tests.helpers import parts, vector
from tests.theory.test_lower_bound import AT_REST, PERIOD, delayed, rms_in_window, simulated_at, still


def history(moments, walks):
    """Return a function of (period, time in it [s]) with the derivatives of the state by all unknowns, (12, 12 + 6 N).

    moments: of inertia (3,). walks: a sequence of length N. The state is angle, rate, bias and torque, 3 components
    each. The unknowns are the state at t = 0, and in each period the drift of the bias and the step of the torque.
    """
    a = np.zeros((12, 12))
    a[0:3, 3:6], a[3:6, 9:12] = np.eye(3), np.diag(1.0 / moments)
    steps, total = np.zeros((12, 6)), 12 + 6 * len(walks)
    steps[6:9, :3], steps[9:12, 3:] = np.eye(3), np.eye(3)
    starts = [np.eye(12, total)]

    def state(k, t=0.0, kicked=True):
        while len(starts) <= k:
            starts.append(expm(a * PERIOD) @ (starts[-1] + steps @ np.eye(6, total, 12 + 6 * (len(starts) - 1))))
        if not kicked:
            return starts[k]
        return expm(a * t) @ (starts[k] + steps @ np.eye(6, total, 12 + 6 * k))

    return state


CASES = {
    "in step": ((2.0, 3.0), (0.0, 2.0)),
    "latency": ((2.0, 1.0), (1.0, 1.3)),
    "own clocks": ((2.5, 1.6), (0.7, 1.0)),
}


@pytest.mark.parametrize("case", CASES)
def test_lower_bound_with_two_star_trackers_equals_an_independent_kalman_filter(case):
    intervals, latencies = CASES[case]
    suite = suites.two_star_trackers(PERIOD, intervals, latencies)
    walk = np.array([1e-3, 2e-3, 0.0])
    made = parts(**AT_REST, delta=2 * PERIOD, disturbance=disturbances.Constant(jnp.zeros(3)))
    made = simulated_at(made, sensors=suite, walk_rate=vector(walk), actuators=delayed(1))
    found = lower_bound.bound_along_run(made, still(made))
    periods = len(found.t)
    state = history(np.diag(np.asarray(made.plant.inertia)), range(periods))
    factor, bias = np.asarray(suite.filter.first_factor(0, 1.0)), np.asarray(suite.rate_bias)
    known = np.linalg.inv(factor @ factor.T) + np.diag([0.0] * 3 + [*bias**-2])
    sizes = np.concatenate([np.asarray(suite.bias_rate) * PERIOD, walk * PERIOD])
    p = np.zeros((12 + 6 * periods,) * 2, np.longdouble)
    p[np.ix_([0, 1, 2, 6, 7, 8], [0, 1, 2, 6, 7, 8])] = np.linalg.inv(known)
    p[3:6, 3:6] = np.diag(np.full(3, 1.0))  # the rate is practically unknown before the first gyro sample
    p[range(12, len(p)), range(12, len(p))] = np.tile(sizes**2, periods)
    squares = np.full((periods, 3), np.nan)
    axes = [Rotation.from_rotvec(v).as_matrix().T for v in suites.MOUNTINGS]
    used = [0, 0]
    for k in range(periods):
        now = state(k, kicked=False)
        rows, sigmas = [*(now[3:6] + now[6:9])], [*suite.rate_noise]
        for j in range(2):
            taken = used[j] * intervals[j]  # in periods
            if taken + latencies[j] <= k + 1e-9:
                whole = int(taken + 1e-9)
                seen = state(whole, (taken - whole) * PERIOD) if taken > whole + 1e-9 else state(whole, kicked=False)
                rows += [*(axes[j] @ seen[:3])]
                sigmas += [*(suites.ARCSEC * np.array(suites.NOISES[j]))]
                used[j] += 1
        for row, sigma in zip(rows, sigmas, strict=True):
            with_all = p @ row.astype(np.longdouble)
            p = p - np.outer(with_all, with_all) / (row @ with_all + np.longdouble(sigma) ** 2)
        if k + 1 < periods:  # the torque of the next period uses the samples up to this one
            for i, t in enumerate((0.0, PERIOD / 2, PERIOD)):
                asked = state(k + 1, t)[:3] / 2
                squares[k + 1, i] = np.trace(asked @ p @ asked.T)
    np.testing.assert_allclose(found.error[1:], np.sqrt(squares[1:, 2]), rtol=1e-9)
    np.testing.assert_allclose(found.window_error, rms_in_window(made, squares), rtol=1e-9)


def test_covariance_predicts_the_error_of_simulated_trials_with_a_suite():
    """The run begins at rest on the target, so that noise causes the whole error. 400 trials determine it to 2 %."""
    made = parts(q=[0.0, 0.0, 0.0, 1.0], t_f=6.0, t_end=7.0, period=PERIOD, flight=True, delta=1.0, eta=4.0, gain=20.0,
                 sign_width=1e-2, disturbance=disturbances.Constant(jnp.zeros(3)))  # fmt: skip
    made = dataclasses.replace(made, sensors=suites.two_star_trackers(PERIOD, (2.0, 3.0), (1.0, 2.0)))
    run = jax.jit(jax.vmap(lambda k: rollout.simulate(made, np.uint32(1), k).metrics.window_error))
    errors = np.asarray(run(np.arange(400, dtype=np.uint32)))
    np.testing.assert_allclose(covariance.propagate_noise(made).window_error, np.sqrt(np.mean(errors**2)), rtol=0.05)
