"""Filters of the command: SciPy's bilinear transform, periods of any length, and what the loop makes of them."""

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
    """Numerator and denominator in z by the bilinear transform, prewarped at W."""
    _, b, a = KINDS[kind]
    return signal.bilinear(b, a, fs=W / (2.0 * np.tan(W * H / 2.0)))


def filtered(device, u, lengths):
    """Outputs for inputs (samples,), the periods between them `lengths` (samples - 1,) long [s], from rest."""
    kept, out = device.begin(1), []
    for value, before, after in zip(u, [0.0, *lengths], [*lengths, H], strict=True):
        y, kept = device.step(kept, vector([value]), vector(before), vector(after))
        out.append(float(y[0]))
    return np.array(out)


@pytest.mark.parametrize("kind", KINDS)
def test_it_is_the_bilinear_transform(kind):
    device, _, _ = KINDS[kind]
    u = np.append(0.0, np.random.default_rng(0).normal(size=40))  # rest has gone on for a period
    b, a = digital(kind)
    np.testing.assert_allclose(filtered(device, u, [H] * 40), signal.lfilter(b, a, u), rtol=0, atol=1e-13)


@pytest.mark.parametrize("kind", KINDS)
def test_what_it_remembers_has_the_poles_of_the_filter_and_no_others(kind):
    """A state that nothing uses stayed as it was: a pole at 1, which margins took for the loop's radius."""
    device, _, _ = KINDS[kind]
    start, tree = ravel_pytree(device.begin(1))
    moved = jax.jacfwd(lambda kept: ravel_pytree(device.step(tree(kept), vector([0.0]), H, H)[1])[0])(start)
    _, a = digital(kind)
    np.testing.assert_allclose(
        np.sort_complex(np.linalg.eigvals(moved)), np.sort_complex(np.roots(np.asarray(a))), atol=1e-14
    )


@pytest.mark.parametrize("kind", KINDS)
def test_periods_of_any_length_integrate_the_same_filter(kind):
    """A sine from rest, sampled unevenly: that of continuous time to second order, and a period of no length does
    nothing."""
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


# a law alone, that nothing tells of what it commands: L of the loop is that of the filter times that without it
ALONE = {
    "plant": {"kind": "chain", "order": 2, "x0": [0.01, 0.0]},
    "controller": {"t_f": 4.0, "delta": 1.0, "eta": 3.0, "k1": 1.0, "surface_rate": 1.0, "disturbance_bound": 0.0},
    "disturbance": {"kind": "none"},
    "observer": {"kind": "none"},
    "loop": {"mode": "sampled", "period": H, "t_end": 20.0},
}


def test_the_loop_of_linear_theory_has_the_filter_in_it():
    """Frozen at the end of both runs, where they are at the target: 16 s at 0.5 1/s leave 3e-4 of a small angle."""
    found, tones = [], (0.3, 2.0, 6.0, 15.0)
    for hardware in ({}, {"hardware": {"command_filter": {"kind": "second_order", "corner": 6.0, "damping": 0.7}}}):
        parts = scenario.study(scenario.from_tables({**ALONE, **hardware})).parts
        run = linear.nominal_jit(parts)
        loops = linear.loops_in(parts, run, linear.full_periods(parts, run, hold=True)[-1:])
        opening = linear.at_input(jax.tree.map(lambda v: v[0], loops))
        found.append(jax.jit(crossings.in_triangles(opening).response)(np.exp(1j * H * np.array(tones)))[0])
    b, a = signal.bilinear([36.0], [1.0, 2 * 0.7 * 6.0, 36.0], fs=6.0 / (2 * np.tan(6.0 * H / 2)))
    for w, without, behind in zip(tones, *found, strict=True):
        _, factor = signal.freqz(np.asarray(b), np.asarray(a), worN=np.array([w * H]))
        np.testing.assert_allclose(behind, factor[0] * without, rtol=0, atol=1e-4 * np.abs(without).max())


def test_what_is_commanded_is_what_the_filter_lets_through():
    ready = scenario.study(
        scenario.from_tables(
            {**ALONE, "hardware": {"command_filter": {"kind": "notch", "corner": 3.0, "damping": 0.5}}}
        )
    )
    run = runs.fly(ready)
    assert run.status == "ok"
    np.testing.assert_array_equal(run.log.commanded, run.log.u)  # nothing is behind it
    assert run.metrics["peak_torque"] == np.abs(run.log.commanded).max()
