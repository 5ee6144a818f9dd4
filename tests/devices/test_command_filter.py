"""Command filters: SciPy's bilinear transform, periods of any length, and the filter in the linearised loop."""

import jax
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
from scipy import signal

from ptsmc_jax import scenario
from ptsmc_jax.campaigns import runs
from ptsmc_jax.devices import command_filter
from ptsmc_jax.theory import crossings, linear
from tests.helpers import vector

W, Z, H = 2.0, 0.4, 0.1
KINDS = {
    "first_order": (command_filter.FirstOrder(vector(W)), [W], [1.0, W]),
    "second_order": (command_filter.SecondOrder(vector(W), vector(Z)), [W**2], [1.0, 2 * Z * W, W**2]),
    "notch": (command_filter.Notch(vector(W), vector(Z)), [1.0, 0.0, W**2], [1.0, 2 * Z * W, W**2]),
}


def digital(kind):
    """Return numerator and denominator in z by the bilinear transform, prewarped at W; kind: key of `KINDS`."""
    _, b, a = KINDS[kind]
    return signal.bilinear(b, a, fs=W / (2.0 * np.tan(W * H / 2.0)))


def filtered(device, u, lengths):
    """Return the outputs (samples,) of a filter from rest for inputs u (samples,).

    lengths: of the periods between the samples, (samples - 1,) [s].
    """
    kept, out = device.begin(1), []
    for value, before, after in zip(u, [0.0, *lengths], [*lengths, H], strict=True):
        y, kept = device.step(kept, vector([value]), vector(before), vector(after))
        out.append(float(y[0]))
    return np.array(out)


@pytest.mark.parametrize("kind", KINDS)
def test_command_filter_equals_the_bilinear_transform(kind):
    device, _, _ = KINDS[kind]
    u = np.append(0.0, np.random.default_rng(0).normal(size=40))  # begins with a period at rest
    b, a = digital(kind)
    np.testing.assert_allclose(filtered(device, u, [H] * 40), signal.lfilter(b, a, u), rtol=0, atol=1e-13)


@pytest.mark.parametrize("kind", KINDS)
def test_state_of_a_command_filter_has_only_the_poles_of_the_filter(kind):
    """An unused constant state would add a pole at 1, which the margin analysis would use as spectral radius."""
    device, _, _ = KINDS[kind]
    start, tree = ravel_pytree(device.begin(1))
    moved = jax.jacfwd(lambda kept: ravel_pytree(device.step(tree(kept), vector([0.0]), H, H)[1])[0])(start)
    _, a = digital(kind)
    np.testing.assert_allclose(
        np.sort_complex(np.linalg.eigvals(moved)), np.sort_complex(np.roots(np.asarray(a))), atol=1e-14
    )


@pytest.mark.parametrize("kind", KINDS)
def test_command_filter_is_accurate_for_periods_of_any_length(kind):
    """The response to an unevenly sampled sine has second-order accuracy, and a period of length 0 has no effect."""
    device, b, a = KINDS[kind]
    rng, errors = np.random.default_rng(1), []
    for count in (100, 200):
        t = np.append(0.0, np.cumsum(rng.uniform(0.5, 1.5, count)))
        t *= 4.0 / t[-1]
        y = filtered(device, np.sin(3.0 * t), np.diff(t))
        _, exact, _ = signal.lsim((b, a), np.sin(3.0 * np.linspace(0, 4, 40_001)), np.linspace(0, 4, 40_001))
        errors.append(np.abs(y - np.interp(t, np.linspace(0, 4, 40_001), exact)).max())
    assert errors[1] < 2e-3
    assert errors[1] < 0.4 * errors[0]
    again = filtered(device, [0.3, 0.5, 0.5, 0.2], [H, 0.0, H])
    np.testing.assert_allclose(np.delete(again, 1), filtered(device, [0.3, 0.5, 0.2], [H, H]), rtol=0, atol=1e-15)


# no observer uses the command, so that L with the filter equals the filter's response times L without it
ALONE = {
    "plant": {"kind": "chain", "order": 2, "x0": [0.01, 0.0]},
    "controller": {"t_f": 4.0, "delta": 1.0, "eta": 3.0, "k1": 1.0, "surface_rate": 1.0, "disturbance_bound": 0.0},
    "disturbance": {"kind": "none"},
    "observer": {"kind": "none"},
    "loop": {"mode": "sampled", "period": H, "t_end": 20.0},
}


def test_linearised_loop_includes_the_command_filter():
    """The loops are linearised at the end of both runs, where only 3e-4 of the small initial angle remains."""
    found, tones = [], (0.3, 2.0, 6.0, 15.0)
    for hardware in ({}, {"hardware": {"command_filter": {"kind": "second_order", "corner": 6.0, "damping": 0.7}}}):
        parts = scenario.study(scenario.from_tables({**ALONE, **hardware})).parts
        run = linear.simulate_nominal_jit(parts)
        loops = linear.open_loops(parts, run, linear.full_periods(parts, run, hold=True)[-1:])
        opening = linear.open_at_input(jax.tree.map(lambda v: v[0], loops))
        found.append(jax.jit(crossings.in_schur_coordinates(opening).response)(np.exp(1j * H * np.array(tones)))[0])
    b, a = signal.bilinear([36.0], [1.0, 2 * 0.7 * 6.0, 36.0], fs=6.0 / (2 * np.tan(6.0 * H / 2)))
    for w, without, behind in zip(tones, *found, strict=True):
        _, factor = signal.freqz(np.asarray(b), np.asarray(a), worN=np.array([w * H]))
        np.testing.assert_allclose(behind, factor[0] * without, rtol=0, atol=1e-4 * np.abs(without).max())


def test_commanded_torque_is_the_filtered_torque():
    ready = scenario.study(
        scenario.from_tables(
            {**ALONE, "hardware": {"command_filter": {"kind": "notch", "corner": 3.0, "damping": 0.5}}}
        )
    )
    run = runs.simulate(ready)
    assert run.status == "ok"
    np.testing.assert_array_equal(run.log.commanded, run.log.u)  # the actuators are ideal
    assert run.metrics["peak_torque"] == np.abs(run.log.commanded).max()
