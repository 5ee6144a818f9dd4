"""Limit cycles in the hold phase of nominal runs: their closed form, and motions that are not limit cycles."""

from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.theory import limit_cycles, linear, margins
from tests.helpers import short

K, C, H = 0.02, 1.0, 0.05  # bound on the disturbance [1/s^2], surface rate [1/s], period [s]
CHAIN = {
    "plant": {"kind": "chain", "order": 2},
    "controller": {"t_f": 4.0, "delta": 0.5, "disturbance_bound": K, "surface_rate": C, "k1": 1.0},
    "observer": {"kind": "none"},
    "loop": {"mode": "sampled", "period": H, "t_end": 24.0},
}


def find_limit_cycle(**changes):
    """Return the `LimitCycle` of the chain, or None if it has none; changes: of keys, as for `scenario.replace`."""
    return limit_cycles.find(scenario.study(scenario.replace(scenario.from_tables(CHAIN), **changes)).parts)


@pytest.mark.parametrize("k1", short([1.0, 4.0, 8.0], [1.0, 8.0]))
def test_limit_cycle_of_a_narrow_sign_has_the_closed_form(k1):
    """With s+ = s + h (c v + u) and u = -c v - K1 s - K sign(s), s alternates between a and -a.

    Here a = h K / (2 - h K1). The peak-to-peak command is 2 (K + K1 a), with a relative error of about c h / 2, because
    v changes within a period.
    """
    found = find_limit_cycle(controller__k1=k1, controller__sign_width=1e-7)
    assert found is not None
    a = H * K / (2.0 - H * k1)
    np.testing.assert_allclose(found.size, 2.0 * (K + k1 * a), rtol=C * H)
    assert found.periods == 2.0  # the command reverses at every sample


@pytest.mark.parametrize("delay", short([1, 3, 8], [8]))
def test_size_of_a_slow_limit_cycle_is_peak_to_peak(delay):
    """The command changes between two samples by much less than from peak to peak."""
    delayed = {"controller__sign_width": 1e-7, "hardware__delay": delay}
    parts = scenario.study(scenario.replace(scenario.from_tables(CHAIN), **delayed)).parts
    seen = limit_cycles.command_history(parts, linear.simulate_nominal_jit(parts))
    found = limit_cycles.find(parts, seen)
    assert found is not None
    assert found.periods > 4 * delay
    last = np.asarray(seen.command)[np.flatnonzero(seen.in_hold)][-100:]
    np.testing.assert_allclose(found.size, np.ptp(last), rtol=0.05)


@pytest.mark.parametrize(("share", "swings"), [(0.5, True), (0.9, True), (1.2, False), (50.0, False)])
def test_limit_cycle_begins_at_the_width_of_an_unstable_boundary_layer(share, swings):
    """The pole 1 - h (K1 + K / width), neglecting c h, is -1 for width = h K / (2 - h K1)."""
    border = H * K / (2.0 - H)
    assert (find_limit_cycle(controller__sign_width=share * border) is not None) == swings


def test_a_linear_oscillation_is_not_a_limit_cycle():
    """With K1 h = 1.98 the sign of s alternates and |s| decays by 2 % per period, inside a wide boundary layer."""
    assert find_limit_cycle(controller__k1=1.98 / H, controller__sign_width=10.0) is None


def test_no_limit_cycle_for_a_discontinuous_sign_or_a_short_hold_phase():
    assert find_limit_cycle(controller__sign_width=0.0) is None
    assert find_limit_cycle(controller__sign_width=1e-7, loop__t_end=4.2, loop__window=0.1) is None


@pytest.mark.parametrize(("whole", "judged"), [(15, False), (16, True)])
def test_limit_cycle_detection_needs_sixteen_full_periods(whole, judged):
    """The run has a limit cycle throughout. The test marks only the last periods as hold phase."""
    parts = scenario.study(scenario.replace(scenario.from_tables(CHAIN), controller__sign_width=1e-7)).parts
    seen = limit_cycles.command_history(parts, linear.simulate_nominal_jit(parts))
    in_hold = np.flatnonzero(seen.in_hold)
    told = np.isin(np.arange(len(seen.in_hold)), in_hold[-whole:])
    assert (limit_cycles.find(parts, seen._replace(in_hold=told)) is not None) == judged


def test_zero_margins_replaces_positive_margins_and_keeps_negative_ones():
    stable = np.array([[True], [True], [False]])
    values: Any = {name: np.array([[3.0], [3.0], [-3.0]]) for name in margins.Margins._fields} | {"stable": stable}
    left = limit_cycles.zero_margins(margins.Margins(**values), [False, True, True])
    for name, of in left._asdict().items():
        none = {"peak_sensitivity": 100.0, "stable": False, "crossover": np.nan}.get(
            name, 0.0
        )  # values of an unstable loop
        np.testing.assert_array_equal(of, [values[name][0], [none], values[name][2]], err_msg=name)


REFERENCES = {
    "moving": {"reference": {"kind": "sinusoid", "amplitude": [0.3, 0.2, 0.1], "frequency": [0.5, 0.3, 0.2]}},
    "moving fast": {"reference": {"kind": "sinusoid", "amplitude": [0.03, 0.02, 0.01], "frequency": [3.0, 2.0, 2.5]}},
    "quantised": {"hardware": {"torque_step": 2e-2}},  # larger than all commands in the hold phase
}


@pytest.mark.parametrize("kind", short(REFERENCES, ["moving fast", "quantised"]))
def test_a_moving_reference_or_quantisation_is_not_a_limit_cycle(kind):
    tables = {
        "controller": {"t_f": 10.0, "delta": 0.5, "eta": 3.0, "k1": 1.0, "surface_rate": 1.0, "sign_width": 1e-3},
        "observer": {"gain": [10.0] * 3},
        "disturbance": {"amplitude": [0.01] * 3, "frequency": [0.1] * 3},
        "loop": {"mode": "sampled", "period": 0.05, "t_end": 20.0, "window": 1.0},
        **REFERENCES[kind],
    }
    assert limit_cycles.find(scenario.study(scenario.from_tables(tables)).parts) is None


def test_limit_cycle_of_a_law_without_sign_width_is_detected(monkeypatch):
    """The command of a custom law reverses at every sample. The linearisation explains a tenth or all of it."""
    turning = np.where(np.arange(40) % 2, 0.5, -0.5)[:, None]
    law: Any = SimpleNamespace(controller=SimpleNamespace())
    run = SimpleNamespace(command=turning)
    monkeypatch.setattr(linear, "simulate_nominal_jit", lambda _: run)
    seen = limit_cycles.History(jnp.asarray(turning), jnp.ones(40, bool))
    for left, found in ((0.9, limit_cycles.LimitCycle(1.0, 2.0)), (0.0, None)):
        monkeypatch.setattr(limit_cycles, "_nonlinear_residual", lambda *_, left=left: (left * turning, turning))
        assert limit_cycles.find(law, seen) == found
