"""Compare pointing error indices with brute force, for synthetic errors and for the history of a run."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation

from ptsmc_jax import programs, scenario
from ptsmc_jax.numerics import attitude
from ptsmc_jax.simulation import catalogues, pointing
from tests.helpers import SHORT, drawn, fly, untuned, vector

SLACK = 1.0 / np.cos(0.5 * np.pi / pointing.DIRECTIONS)  # upper bound of computed over exact half-cones of deviations


def brute_force(t, error, mean_of, begins, window, t_end, limits: Any = None) -> Any:
    """Return {index: values (4,) about x, y, z and of the half-cone} from errors (n, 5) at times t (n,).

    `mean_of` returns the mean error between two times. begins, window, t_end [s]. With limits (4,), the result is an
    array (4,), the fraction of windows whose means are within the limits.
    """
    count = int((t_end - begins) / window + 1e-9)
    interpolated = mean_of("at")

    def sizes(e):
        return np.concatenate([np.abs(e[..., :3]), np.linalg.norm(e[..., 3:], axis=-1)[..., None]], axis=-1)

    seen = t >= begins - 1e-12
    largest = sizes(np.concatenate([error[seen], interpolated(np.array([begins]))])).max(axis=0)
    means, relative = [], []
    for k in range(count):
        low, high = begins + k * window, begins + (k + 1) * window
        inside = (t > low) & (t < high)
        points = np.concatenate([error[inside], interpolated(np.array([low, high]))])
        means.append(mean_of(low, high))
        relative.append(sizes(points - means[-1]).max(axis=0))
    means = np.stack(means)
    apart = sizes(means[:, None] - means[None]).max(axis=(0, 1))
    if limits is not None:
        return np.mean(sizes(means) <= limits, axis=0)
    return {"ape": largest, "mpe": sizes(means).max(axis=0), "rpe": np.max(relative, axis=0), "pde": apart}


def of_spline(spline):
    """Return a function for the exact mean of a piecewise cubic between two times; its attribute `at` is the cubic."""
    integral = spline.antiderivative()
    return lambda low, high=0.0: spline if isinstance(low, str) else (integral(high) - integral(low)) / (high - low)


def close(found, expected, rel):
    """Assert that found indices equal the expected ones.

    Half-cones of deviations may be up to 0.5 % too large. rel: relative tolerance.
    """
    for index, values in expected.items():
        np.testing.assert_allclose(found[index][:3], values[:3], rtol=rel, atol=1e-15, err_msg=index)
        ratio = found[index][3] / values[3]
        slack = SLACK if index in ("rpe", "pde", "rke") else 1.0
        assert 1.0 - rel <= ratio <= slack * (1.0 + rel), index


def relative_share(t, error, mean_of, begins, window, t_end, limits) -> Any:
    """Return the fraction (4,) of the time in whole windows while the error minus its mean is within limits (4,).

    Magnitudes are linear between nodes, and the ends of windows count as nodes. The other arguments are those of
    `brute_force`.
    """
    count, shares = int((t_end - begins) / window + 1e-9), []
    for k in range(count):
        low, high = begins + k * window, begins + (k + 1) * window
        inside = (t > low) & (t < high)
        nodes = np.concatenate([[low], t[inside], [high]])
        off = np.concatenate([mean_of("at")([low]), error[inside], mean_of("at")([high])]) - mean_of(low, high)
        sizes = np.concatenate([np.abs(off[:, :3]), np.linalg.norm(off[:, 3:], axis=1)[:, None]], axis=1)
        fine = np.linspace(low, high, 20_001)
        shares.append([np.mean(np.interp(fine, nodes, sizes[:, i]) <= limits[i]) for i in range(4)])
    return np.mean(shares, axis=0)


@programs.jit(static_argnames="segments")
def tallied(nodes, error, rate, begins, window, limits, segments=33):
    """Return the tally of pointing indices of errors (n, 5) with their rates at nodes (n,) [s].

    begins: start of the observation [s]. window: length of a window [s]. limits (3, 4): of error, mean and relative
    error, by axis and half-cone [rad]. segments: see `pointing.begin`; too few for a window give NaN.
    """

    def step(tally, row):
        t, t_next, start, start_rate, end, end_rate = row
        path = pointing.hermite_path(start, start_rate, end, end_rate, t_next - t)
        return pointing.update(tally, path, t, t_next, begins, window, limits), None

    rows = nodes[:-1], nodes[1:], error[:-1], rate[:-1], error[1:], rate[1:]
    return jax.lax.scan(step, pointing.begin(jnp.zeros(()), segments), rows)[0]


def indices(tally):
    """Return the pointing indices of a tally by name, each (4,) about x, y, z and of the half-cone."""
    return {"ape": tally.largest, "mpe": tally.mean, "rpe": tally.relative, "pde": pointing.drift(tally)}


NODES = 0.1 * np.arange(101)
# windows that end at nodes or between nodes, and an observation that begins between nodes with a partial last window
OBSERVED = [(4.0, 1.0), (4.0, 0.37), (4.03, 0.1), (0.0, 2.5), (3.999, 3.0)]


@pytest.mark.parametrize(("begins", "window"), OBSERVED)
def test_pointing_indices_match_a_brute_force_evaluation(begins, window):
    """The fractions of time within limits are compared too, for errors, means and deviations from means."""

    def check(seed):
        rng = np.random.default_rng(seed)
        error, rate = rng.normal(size=(NODES.size, 5)), 10.0 * rng.normal(size=(NODES.size, 5))
        spline = CubicHermiteSpline(NODES, error, rate)
        expected = brute_force(NODES, error, of_spline(spline), begins, window, NODES[-1])
        limits = np.array([0.5, 1.0, 1.5, 2.0])
        of_means = 0.9 * expected["mpe"]  # some windows are within this limit
        deviations = np.array([0.6, 0.9, 1.2, 1.6])
        asked = np.stack([limits, of_means, deviations])
        tally = tallied(*map(jnp.asarray, (NODES, error, rate, begins, window, asked)))
        close(indices(tally), expected, 1e-10)  # rounding of sums of a hundred numbers
        assert float(tally.windows) == int((NODES[-1] - begins) / window + 1e-9)
        kept = brute_force(NODES, error, of_spline(spline), begins, window, NODES[-1], of_means)
        np.testing.assert_allclose(1.0 - tally.means_beyond / (tally.windows * window), kept, rtol=1e-12)
        off = relative_share(NODES, error, of_spline(spline), begins, window, NODES[-1], deviations)
        np.testing.assert_allclose(1.0 - tally.relative_beyond / (tally.windows * window), off, atol=2e-4)
        assert np.all((off > 0.0) & (off < 1.0))
        # the time within a limit, with magnitudes that are linear between nodes
        sizes = np.concatenate([np.abs(error[:, :3]), np.linalg.norm(error[:, 3:], axis=1)[:, None]], axis=1)
        fine = np.linspace(begins, NODES[-1], 200_001)
        at_first = spline(begins)
        opened = np.append(np.abs(at_first[:3]), np.linalg.norm(at_first[3:]))
        later = begins < NODES
        for k, limit in enumerate(limits):
            shown = np.interp(fine, np.append(begins, NODES[later]), np.append(opened[k], sizes[later, k]))
            share = np.mean(shown <= limit)
            assert 1.0 - float(tally.beyond[k]) / (NODES[-1] - begins) == pytest.approx(share, abs=1e-4)

    for seed in range(3):
        check(seed)


def test_relative_error_is_zero_for_a_constant_error_and_half_the_rise_of_a_ramp():
    """The relative error is the error minus its mean over a window."""
    error = np.tile([1.0, -2.0, 3.0, 0.6, 0.8], (NODES.size, 1))
    tally = tallied(*map(jnp.asarray, (NODES, error, 0.0 * error, 2.0, 1.0, np.full((3, 4), np.inf))))
    np.testing.assert_allclose(tally.largest, [1.0, 2.0, 3.0, 1.0], rtol=1e-14)
    np.testing.assert_allclose(tally.mean, [1.0, 2.0, 3.0, 1.0], rtol=1e-13)
    np.testing.assert_allclose(tally.relative, 0.0, atol=1e-13)
    ramp, slope = NODES[:, None] * np.ones(5), np.ones((NODES.size, 5))
    tally = tallied(*map(jnp.asarray, (NODES, ramp, slope, 2.0, 1.0, np.full((3, 4), np.inf))))
    np.testing.assert_allclose(tally.relative[:3], 0.5, rtol=1e-12)
    np.testing.assert_allclose(pointing.drift(tally)[:3], 7.0, rtol=1e-12)  # eight windows of 1 s
    np.testing.assert_allclose(tally.mean[:3], 9.5, rtol=1e-12)


@programs.jit
def held(nodes, error, begins, window):
    """Return the tally of pointing indices of errors (n - 1, 5), each held from a node to the next of nodes (n,)."""

    def step(tally, row):
        t, t_next, value = row
        path, never = pointing.ConstantPath(value, t_next - t), jnp.full((3, 4), jnp.inf)
        return pointing.update(tally, path, t, t_next, begins, window, never), None

    return jax.lax.scan(step, pointing.begin(jnp.zeros(())), (nodes[:-1], nodes[1:], error))[0]


@pytest.mark.parametrize(("begins", "window"), [*OBSERVED, (3.0 * 0.1, 0.2), (4.0, 0.1)])
def test_a_held_error_counts_in_the_windows_that_it_is_held_in(begins, window):
    """An error that ends when a window begins does not count in it. With one sample per window, no error deviates."""
    error = np.random.default_rng(3).normal(size=(NODES.size - 1, 5))
    tally, relative = held(*map(jnp.asarray, (NODES, error, begins, window))), []
    for k in range(int((NODES[-1] - begins) / window + 1e-9)):
        low, high = begins + k * window, begins + (k + 1) * window
        lasts = np.clip(np.minimum(NODES[1:], high) - np.maximum(NODES[:-1], low), 0.0, None)
        off = np.abs(error - lasts @ error / window)[lasts > 1e-9]
        relative.append(off[:, :3].max(axis=0))
    np.testing.assert_allclose(tally.relative[:3], np.max(relative, axis=0), rtol=1e-9, atol=1e-12)
    seen = np.abs(error[NODES[1:] > begins + 1e-9])
    np.testing.assert_allclose(tally.largest[:3], seen[:, :3].max(axis=0), rtol=1e-14)


def check_the_cone(seed):
    """Compare the half-cone with the angle between both boresights, and the error with the rotation vector of SciPy.

    seed: of a random boresight, target and error.
    """
    rng = np.random.default_rng(seed)
    b = rng.normal(size=3)
    frame = pointing.boresight_frame(b)
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-14)
    target = Rotation.from_rotvec(rng.normal(size=3))
    off = Rotation.from_rotvec(rng.normal(size=3) * 10.0 ** rng.uniform(-9, -0.5))
    error = pointing.attitude_error(vector((target * off).as_quat()), vector(target.as_quat()), vector(frame))
    np.testing.assert_allclose(error[:3], off.as_rotvec(), rtol=1e-9, atol=1e-15)  # rounding of quaternions
    unit = b / np.linalg.norm(b)
    turned = off.apply(unit)
    angle = np.arctan2(np.linalg.norm(np.cross(unit, turned)), unit @ turned)
    assert float(jnp.linalg.norm(error[3:])) == pytest.approx(angle, rel=1e-6, abs=1e-15)


test_the_half_cone_is_the_angle_of_the_boresight = drawn(check_the_cone, 20, seed=st.integers(0, 2**32 - 1))


@pytest.mark.parametrize("angle", [1.0, 2.0, 2.5, 3.0, 3.14, np.pi - 2e-6, np.pi])
def test_boresight_errors_can_exceed_a_right_angle(angle):
    """The rotation is up to 180 deg about an axis across the boresight. At 180 deg any axis is right."""
    frame = pointing.boresight_frame([1.0, -2.0, 0.5])
    off = Rotation.from_rotvec(angle * (0.6 * frame[1] + 0.8 * frame[2]))
    error = pointing.attitude_error(vector(off.as_quat()), vector([0.0, 0.0, 0.0, 1.0]), vector(frame))
    assert float(jnp.linalg.norm(error[3:])) == pytest.approx(angle, rel=1e-9)
    if angle < 3.1:
        np.testing.assert_allclose(error[3:], angle * np.array([0.8, -0.6]), rtol=1e-9)


KNOWN_WITHIN = 1e-5  # rad
POINTED = (
    SHORT.replace("[requirements]\npeak_torque = 30.0\n", "")
    + """
[pointing]
boresight = [1.0, 2.0, -0.5]
window = 0.33
after = 0.25
[reference]
kind = "spin"
rate = [0.01, -0.02, 0.03]
[requirements]
ape_boresight = { limit = 0.016, probability = 0.95, interpretation = "mixed" }
rpe_boresight = { limit = 5e-4, probability = 0.95, interpretation = "temporal" }
rke_x = { limit = 1e-5, probability = 0.95, interpretation = "mixed" }
"""
)


@pytest.fixture(scope="module")
def simulated():
    """Return the study of a run with pointing requirements, and its result with its history."""
    tables = untuned(POINTED)
    tables["loop"] |= {"clock": "flight"}
    ready = scenario.study(scenario.from_tables(tables))
    return ready, fly(ready.parts, 3, 5)


def test_pointing_indices_of_a_run_match_its_history(simulated):
    """The fractions of time within a limit are compared too. A fraction is exactly 1 if there is no limit."""
    ready, result = simulated
    frame = np.array(ready.parts.pointing.frame)
    log = result.log
    kept = log.has_length
    t, q, w = log.t[kept], log.x.q[kept], log.x.w[kept]
    target, rate = log.reference.q[kept], log.reference.w[kept]

    def errors(step):
        """Return the errors a step [s] after each row, along the tangent of the motion."""
        body = Rotation.from_quat(q) * Rotation.from_rotvec(step * w)
        wanted = Rotation.from_quat(target) * Rotation.from_rotvec(step * rate)
        off = wanted.inv() * body
        side = off.apply(frame[0]) @ frame[1:].T
        size = np.linalg.norm(side, axis=1, keepdims=True)
        return np.concatenate([off.as_rotvec(), side * np.arcsin(size) / size], axis=1)

    late = t > 4.0  # errors are small then, so that angle and sine agree
    spline = CubicHermiteSpline(t[late], errors(0.0)[late], ((errors(1e-5) - errors(-1e-5)) / 2e-5)[late])
    begins = 5.25
    expected = brute_force(t[late], errors(0.0)[late], of_spline(spline), begins, 0.33, 6.5)
    found = {
        index: np.array([getattr(result.metrics, f"{index}_{axis}") for axis in catalogues.AXES]) for index in expected
    }
    close(found, expected, 1e-7)  # rates by finite differences
    assert 1e-3 < found["ape"][3] < 0.1
    fine = np.linspace(begins, 6.5, 100_001)
    nodes = np.append(begins, t[t > begins])
    seen = np.concatenate([spline([begins]), errors(0.0)[t > begins]])
    share = np.mean(np.interp(fine, nodes, np.linalg.norm(seen[:, 3:], axis=1)) <= 0.016)  # linear between nodes
    assert float(result.metrics.within_ape_boresight) == pytest.approx(share, abs=1e-4)
    assert 0.0 < share < 1.0
    # without a limit the fraction is exactly 1; rounding must not count as time beyond a limit
    assert [float(getattr(result.metrics, f"within_{name}_x")) for name in ("ape", "mpe", "rpe")] == [1.0, 1.0, 1.0]
    limits = np.array([np.inf, np.inf, np.inf, 5e-4])
    relative = relative_share(t[late], errors(0.0)[late], of_spline(spline), begins, 0.33, 6.5, limits)[3]
    assert float(result.metrics.within_rpe_boresight) == pytest.approx(relative, abs=2e-4)
    assert 0.1 < relative < 0.9


def test_a_run_that_never_meets_a_limit_has_a_fraction_of_0(simulated):
    """Times beyond the limit add up to the observation only within rounding, which differs between programs."""
    observed = simulated[0].parts.pointing
    observed = dataclasses.replace(observed, limits={name: vector(1e-12) for name in observed.limits})
    for after in (0.2, 0.25, 0.3, 0.31, 0.37):
        run = dataclasses.replace(
            simulated[0].parts, pointing=dataclasses.replace(observed, after=vector(after), window=vector(0.11))
        )
        found = fly(run, 3, 5).metrics
        for share in (found.within_ape_boresight, found.within_rke_x):
            assert float(share) == 0.0


def test_pointing_knowledge_errors_without_a_filter_are_the_measurement_noise(simulated):
    """The fraction of time within a limit is compared too."""
    ready, result = simulated
    keys = ready.parts.sensors.keys(jnp.uint32(3), jnp.uint32(5))
    samples = np.arange(50, 65)
    turns = np.stack([np.asarray(ready.parts.sensors.noise(keys, jnp.int32(k))[0]) for k in samples])
    began, found = 0.1 * samples, result.metrics
    in_view = began + 0.1 > 5.25 + 1e-9  # the last sample before the observation is held into it
    for k, axis in enumerate("xyz"):
        assert float(getattr(found, f"ake_{axis}")) == pytest.approx(np.abs(turns[in_view, k]).max(), rel=1e-6)
    frame = np.asarray(ready.parts.pointing.frame)
    cones = np.linalg.norm(np.cross(turns, frame[0]), axis=1)
    assert float(found.ake_boresight) == pytest.approx(cones[in_view].max(), rel=1e-6)
    means, within = [], 0.0
    for k in range(3):
        low, high = 5.25 + 0.33 * k, 5.25 + 0.33 * (k + 1)
        lasts = np.clip(np.minimum(began + 0.1, high) - np.maximum(began, low), 0.0, None)
        means.append(lasts @ turns / 0.33)
        within += lasts @ (np.abs(turns - means[-1])[:, 0] <= KNOWN_WITHIN)
    assert float(found.within_rke_x) == pytest.approx(within / 0.99, rel=1e-9)
    assert 0.1 < within / 0.99 < 0.9
    for k, axis in enumerate("xyz"):
        assert float(getattr(found, f"mke_{axis}")) == pytest.approx(np.abs(means)[:, k].max(), rel=1e-6)


def test_fraction_of_time_of_the_relative_error_is_nan_with_too_many_samples_in_a_window():
    error = np.zeros((NODES.size, 5))
    asked = [jnp.asarray(given) for given in (NODES, error, error, 4.0, 1.0, np.ones((3, 4)))]
    np.testing.assert_array_equal(tallied(*asked).relative_beyond, 0.0)
    assert np.all(np.isnan(tallied(*asked, segments=9).relative_beyond))


def test_pointing_indices_of_a_continuous_run_allow_for_all_its_steps_in_a_window():
    frame = pointing.boresight_frame((0.0, 0.0, 1.0))
    zero, one = jnp.zeros(()), jnp.ones(())
    asked = pointing.Pointing(jnp.asarray(frame), zero, one, {"rpe_z": one})
    assert asked.for_run(700).segment_count("rpe") == 702
    assert asked.for_run(700).segment_count("rke") == 0
    assert dataclasses.replace(asked, samples=12).for_run(700).segment_count("rpe") == 14


def test_gradients_of_pointing_indices_match_finite_differences():
    """The direction changes attitudes, rates, times of nodes and the begin of the observation together."""
    rng, frame = np.random.default_rng(5), vector(pointing.boresight_frame((1.0, 2.0, -0.5)))
    decay = np.exp(-0.3 * NODES)[:, None]  # so that the first window and its first moment are among the largest
    turns, aside = (vector(0.01 * decay * (1.0 + 0.1 * rng.normal(size=(NODES.size, 3)))) for _ in range(2))
    rates, none = 0.01 * rng.normal(size=(NODES.size, 5)), np.full((3, 4), np.inf)

    def of(size):
        q = jax.vmap(lambda turn, side: attitude.from_rotation_vector(turn + size * side))(turns, aside)
        error = jax.vmap(lambda q: pointing.attitude_error(q, vector([0.0, 0.0, 0.0, 1.0]), frame))(q)
        tally = tallied(NODES * (1.0 + 0.01 * size), error, rates * (0.1 + size), 4.03 + 0.02 * size, 0.37, none)
        return jnp.stack(list(indices(tally).values()))

    with_gradients, at, step = jax.jit(lambda size: jax.jvp(of, (size,), (vector(1.0),))), 0.3, 1e-6
    slopes = with_gradients(vector(at))[1]
    differences = (with_gradients(vector(at + step))[0] - with_gradients(vector(at - step))[0]) / (2 * step)
    np.testing.assert_allclose(slopes, differences, rtol=1e-6, atol=1e-9)
    assert np.all(np.abs(slopes) > 1e-6)


def test_every_pointing_index_is_a_metric_of_a_scenario_with_pointing(simulated):
    ready, _ = simulated
    named = {f"{index}_{axis}" for index in catalogues.INDICES for axis in catalogues.AXES}
    assert named | {"within_ape_boresight", "within_rpe_boresight", "within_rke_x"} <= set(ready.catalogue)
    assert not {"within_ape_x", "within_ake_boresight"} & set(ready.catalogue)
    quiet = scenario.replace(ready.scenario, hardware=None, requirements=None)
    assert {name for name in named if "ke_" in name} & set(scenario.catalogue(quiet)) == set()
    assert not named & set(scenario.catalogue(scenario.replace(quiet, pointing=None)))
