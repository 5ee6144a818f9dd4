import jax
import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.campaigns import montecarlo
from ptsmc_jax.simulation import rollout
from tests.helpers import FIRST_FLIGHT, SHORT_CHAIN, assert_prepared, short, untuned

# eta, delta [s], observer gain: RMS window error and mean peak torque [N m], without and with noise (theory notes, 6)
TABLE = (
    (3.0, 0.05, 10.0, (1.2e-5, 0.16), (4.6e-4, 0.60)),
    (5.0, 0.05, 10.0, (1.4e-5, 0.45), (5.5e-3, 6.8)),
    (3.0, 0.5, 10.0, (3.1e-5, 0.16), (3.4e-5, 0.16)),
    (5.0, 0.5, 10.0, (2.7e-5, 0.45), (4.3e-5, 0.45)),
    (4.0, 1.0, 40.0, (1.3e-5, 0.29), (1.5e-5, 0.29)),
)


# on the flight clock, one compiled program simulates all gains
FIRST = scenario.replace(scenario.read(FIRST_FLIGHT), controller__delta=0.5, loop__clock="flight")


@pytest.fixture(scope="module")
def chain():
    """Return the study of an integrator chain. Trials are distributed over devices and blocks for any plant alike."""
    return scenario.study(scenario.from_tables(untuned(SHORT_CHAIN)))


@pytest.fixture(scope="module")
def simulated(chain):
    """Return the `Trials` of the first 256 trials of the chain with seed 5."""
    return montecarlo.run(chain.parts, chain.dispersion, 5, np.arange(256))


def test_batched_trials_equal_single_simulations(chain, simulated):
    """The test simulates every fifth trial alone, and the first and the last trial of each device."""
    draw = jax.jit(lambda trial: chain.dispersion.apply(chain.parts, np.uint32(5), trial))
    for k in {*range(0, 256, 5), 127, 128, 255}:
        drawn = draw(np.uint32(k))
        alone = rollout.simulate_parts(drawn, np.uint32(5), np.uint32(k), record=True)
        assert int(alone.status) == simulated.status[k]
        np.testing.assert_allclose(drawn.initial, simulated.vectors("initial_x")[k], atol=1e-15)
        for name in alone.metrics:
            a, b = float(alone.metrics[name]), float(simulated.metrics[name][k])
            assert a == pytest.approx(b, rel=1e-12, abs=1e-12, nan_ok=True), (k, name)


@pytest.mark.parametrize("count", [1, 3, 63, 64, 65, 129, 255])
def test_any_number_of_trials_can_be_simulated(chain, simulated, count):
    """Trials are distributed over two devices, in blocks of 128 or fewer. No trial is lost or repeated."""
    some = montecarlo.run(chain.parts, chain.dispersion, 5, np.arange(count))
    assert some.status.shape == some.metrics.window_error.shape == (count,)
    # fewer than `FEW` trials use another compiled program with other rounding errors
    np.testing.assert_allclose(some.vectors("initial_x"), simulated.vectors("initial_x")[:count], rtol=0, atol=1e-15)
    np.testing.assert_allclose(some.metrics.window_error, simulated.metrics.window_error[:count], rtol=1e-12)


@pytest.mark.parametrize("count", [1, 63, 64, 1000])
def test_prepared_program_is_the_program_of_the_simulation(chain, count, monkeypatch):
    """A program with other shapes or types would be compiled in vain."""
    ready, trials = (chain.parts, chain.dispersion), np.arange(count)
    prepare, run = (lambda: montecarlo.prepare(*ready, count)), (lambda: montecarlo.run(*ready, 5, trials))
    assert_prepared(monkeypatch, montecarlo, "_simulate_rows", prepare, run)


@pytest.mark.parametrize(
    ("trials", "said"),
    [
        (100, r"of shape \(\), but must be the numbers of one trial or more, \(N,\)"),
        ([], r"of shape \(0,\)"),
        ([[0, 1]], r"of shape \(1, 2\)"),
        (np.array([3, -1]), "between -1 and 3, but must be whole numbers from 0 to 4294967295"),
        ([2**32], "between 4294967296 and 4294967296"),
        ([1.7], "of type float64"),
        ([True, False], "of type bool"),
    ],
)
def test_invalid_trial_numbers_are_refused(chain, trials, said):
    """Fractions are not truncated, and negative numbers do not count from the end."""
    with pytest.raises(ValueError, match=said):
        montecarlo.run(chain.parts, chain.dispersion, 5, trials)


def test_a_trial_does_not_depend_on_the_others(chain, simulated):
    some = np.array([200, 3, 3, 77])
    again = montecarlo.run(chain.parts, chain.dispersion, 5, some)
    np.testing.assert_allclose(again.metrics.window_error, simulated.metrics.window_error[some], rtol=1e-12)
    np.testing.assert_allclose(again.vectors("initial_x"), simulated.vectors("initial_x")[some], atol=1e-15)
    other = montecarlo.run(chain.parts, chain.dispersion, 6, some)
    assert not np.any(other.metrics.window_error == again.metrics.window_error)


@pytest.mark.parametrize(("eta", "delta", "gain", "quiet", "noisy"), short(TABLE, TABLE[::4]))
def test_rms_errors_and_peak_torques_agree_with_the_theory_notes(eta, delta, gain, quiet, noisy):
    gains = {"controller__eta": eta, "controller__delta": delta, "observer__gain": [gain] * 3}
    base = scenario.replace(FIRST, **gains)
    silent = scenario.replace(base, hardware={"attitude_noise": 0.0, "rate_noise": 0.0})
    for case, (rms, peak) in ((silent, quiet), (base, noisy)):
        ready = scenario.study(case)
        trials = montecarlo.run(ready.parts, ready.dispersion, 0, np.arange(500))
        assert np.all(trials.ok)
        # tolerance 15 %: the values in the theory notes are from 64 trials
        np.testing.assert_allclose(np.sqrt(np.mean(trials.metrics.window_error**2)), rms, rtol=0.15)
        np.testing.assert_allclose(np.mean(trials.metrics.peak_torque), peak, rtol=0.15)


@pytest.mark.long
def test_single_precision_has_the_documented_accuracy():
    """Accuracy in `docs/python.md`: equal statuses, RMS errors and torques to 0.1 %, no resolution below 1e-7."""
    flight = scenario.replace(scenario.read(FIRST_FLIGHT), tune=None, controller__delta=0.5)
    away = scenario.replace(
        flight, hardware=None, reference={"quat_xyzw": [0.5, 0.5, 0.5, 0.5]}, controller__error="multiplicative"
    )
    for one, floor in ((flight, 0.0), (away, 1e-7)):
        found = []
        for bits in (64, 32):
            with jax.enable_x64(bits == 64):
                ready = scenario.study(one)
                found.append(montecarlo.run(ready.parts, ready.dispersion, 3, np.arange(256)))
        double, single = found
        assert single.metrics.window_error.dtype == np.float32
        np.testing.assert_array_equal(single.status, double.status)
        rms = [np.sqrt(np.mean(np.square(t.metrics.window_error, dtype=float))) for t in found]
        assert abs(rms[1] / rms[0] - 1.0) < 1e-3 + floor / rms[0]
        np.testing.assert_allclose(single.metrics.peak_torque, double.metrics.peak_torque, rtol=1e-3)
        off = np.abs(single.metrics.terminal_error - double.metrics.terminal_error).max()
        assert off > 6e-8 if floor else off < 1e-7
