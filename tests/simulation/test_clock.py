"""Clocks of the sampled loop: sample times, start of the hold phase, and derivatives by t_f and delta."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ptsmc_jax import scenario
from ptsmc_jax.simulation import clock, rollout
from ptsmc_jax.simulation.control_period import schedule, start
from tests.helpers import ticks_of, vector


@settings(max_examples=60, deadline=None)
@given(t_f=st.floats(5.0, 40.0), share=st.floats(0.01, 0.4), coast=st.floats(1.0, 12.0))
def test_periods_of_an_anchored_clock_cover_the_run_with_a_sample_at_the_hand_over(t_f, share, coast):
    """All periods except the first and the last have the full length. The sample at the hand-over has the number 0."""
    period, delta = 0.1, max(share * t_f, 0.1)
    times = clock.anchored_clock(period, t_f + coast)
    ticks = ticks_of(times, vector(t_f), vector(delta))
    t, t_next = np.asarray(ticks.t), np.asarray(ticks.t_next)
    assert np.all(t_next >= t)
    assert t[0] == 0.0
    assert t_next[-1] == t_f + coast
    np.testing.assert_array_equal(t[1:], t_next[:-1])  # no gap, no overlap
    first = int(np.argmax(ticks.hold))
    np.testing.assert_allclose(t[first], t_f - delta, atol=1e-12)
    assert int(ticks.sample[first]) == 0
    whole = (t > 0) & (t_next < t_f + coast)
    np.testing.assert_allclose((t_next - t)[whole], period, atol=1e-12)
    np.testing.assert_allclose(np.asarray(ticks.noise_weight)[t > 0], 1.0)


@pytest.mark.parametrize(("period", "t_f", "delta", "after"), [(0.3, 7.3, 1.1, 10.0), (0.01, 12.1, 0.05, 2.0)])
def test_rounding_does_not_move_the_end_of_an_anchored_clock(period, t_f, delta, after):
    """The sum of the periods from the hand-over on is 4e-15 s less than t_end."""
    t_end = t_f + after
    whole = round((t_end - t_f + delta) / period)
    assert 0.0 < t_end - (t_f - delta + whole * period) < 1e-14
    ticks = ticks_of(clock.anchored_clock(period, t_end), vector(t_f), vector(delta))
    assert float(ticks.t_next[-1]) == t_end


@pytest.mark.parametrize("periods", [10, 20])
def test_sample_times_of_an_anchored_clock_are_continuous_in_delta_at_multiples_of_the_period(periods):
    """The anchored clock has a sample at the hand-over t_f - delta. Its partial first period vanishes at such delta."""
    anchored = clock.anchored_clock(0.1, 15.0)

    def ends(delta):
        ticks = ticks_of(anchored, vector(10.0), delta)
        return ticks.t, ticks.t_next

    def ends_by_sample(delta):
        samples = np.asarray(ticks_of(anchored, vector(10.0), delta).sample).tolist()
        return dict(zip(samples, np.stack(ends(delta), axis=1), strict=True))

    at = vector(periods * 0.1)
    present = ends_by_sample(at)
    for nearby in (at - 1e-9, at + 1e-9):
        others = ends_by_sample(nearby)
        assert len(present.keys() & others.keys()) >= 150
        for sample in present.keys() | others.keys():  # a sample of only one of them has a period of length zero
            found = [one[sample] for one in (present, others) if sample in one]
            np.testing.assert_allclose(*(found if len(found) == 2 else found[0]), atol=1.1e-9)
    # the derivatives of the lengths add up to zero, since t_end is constant
    slopes = jax.jvp(ends, (at,), (vector(1.0),))[1]
    np.testing.assert_allclose(np.sum(np.asarray(slopes[1] - slopes[0])), 0.0, atol=1e-12)


@pytest.mark.parametrize(("t_f", "delta"), [(12.0, 0.7), (30.3, 0.9), (12.0, 0.8), (30.0, 0.7)])
def test_rounding_adds_no_sample_just_after_the_first_sample(t_f, delta):
    """12.0 - 0.7 is 8e-17 s beyond 113 periods. An earlier version had two samples at t = 0 and wrong gradients."""
    anchored = clock.anchored_clock(0.1, t_f + 4.03)

    @jax.jit  # has other rounding errors
    def starts(delta):
        return ticks_of(anchored, vector(t_f), delta).t

    @jax.jit
    def lengths(delta):
        ticks = ticks_of(anchored, vector(t_f), delta)
        return ticks.t_next - ticks.t

    at = vector(delta)
    simulated = np.asarray(lengths(at))[np.asarray(lengths(at)) > 0]
    np.testing.assert_allclose(simulated, [0.1] * round((t_f + 4.0) / 0.1) + [0.03], atol=1e-12)
    for function in (starts, lengths):  # derivatives of a slightly larger delta
        np.testing.assert_array_equal(jax.jacfwd(function)(at), jax.jacfwd(function)(at + 1e-6))


@pytest.mark.parametrize(("delta", "t_end"), [(0.6, 8.3), (0.9, 8.3), (0.6, 10.3), (0.8, 8.3)])
def test_rounding_adds_no_sample_just_before_the_end(delta, t_end):
    """7.3 - 0.6 s and 16 periods are 2e-15 s before 8.3 s. Earlier, this added a sample and changed gradients."""
    anchored = clock.anchored_clock(0.1, t_end)

    def lengths(delta):
        ticks = ticks_of(anchored, vector(7.3), delta)
        return ticks.t_next - ticks.t

    at = vector(delta)
    for function in (lengths, jax.jit(lengths)):  # has other rounding errors
        simulated = np.asarray(function(at))
        np.testing.assert_allclose(simulated[simulated > 0.0], [0.1] * round(t_end / 0.1), atol=1e-12)
        np.testing.assert_array_equal(
            jax.jacfwd(function)(at)[simulated > 0.0], [-1.0, *[0.0] * (sum(simulated > 0.0) - 2), 1.0]
        )


@pytest.mark.parametrize(("t_f", "delta"), [(35.0, 1.0), (35.0, 0.6), (30.0, 0.7), (12.0, 0.8)])
def test_a_whole_first_period_has_the_derivatives_of_a_slightly_larger_delta(t_f, delta):
    """35 - 1 s are 340 periods and 1e-14 s. An earlier version passed a constant length of the first period."""
    tables = {"controller": {"t_f": t_f, "delta": delta}, "loop": {"mode": "sampled", "period": 0.1}}
    parts = scenario.study(scenario.from_tables(tables)).parts

    @jax.jit
    def computed(delta):
        ticks = parts.clock.ticks(parts.controller.t_f, delta)
        vehicle, _ = start(parts, ticks, parts.initial, 0, 0)
        first, second = (jax.tree.map(lambda v, k=k: v[k], schedule(ticks)) for k in starts)
        return vehicle.period(first).assumed_length, vehicle.period(second).matrix

    at = vector(delta)
    starts = np.flatnonzero(np.asarray(ticks_of(parts.clock, vector(t_f), at).t_next) > 0.0)[:2]
    slopes = [jax.jacfwd(computed)(delta) for delta in (at, at + 1e-6)]
    assert float(slopes[0][0]) == -1.0
    for one, other in zip(*slopes, strict=True):
        assert np.any(np.asarray(one) != 0.0)
        np.testing.assert_allclose(one, other, rtol=1e-4)


def test_the_noise_of_a_partial_first_period_includes_noise_of_the_next_sample():
    ticks = ticks_of(clock.anchored_clock(0.1, 15.0), vector(10.0), vector(1.07))
    first = int(np.flatnonzero(np.asarray(ticks.t_next) > 0)[0])
    np.testing.assert_allclose(ticks.t_next[first] - ticks.t[first], 0.03, atol=1e-12)
    np.testing.assert_allclose(ticks.noise_weight[first], 0.3, atol=1e-10)


def test_the_flight_clock_starts_at_zero_and_its_hold_phase_at_the_first_sample_from_t_f_minus_delta_on():
    flight = clock.flight_clock(0.1, 15.04)
    ticks = ticks_of(flight, vector(10.0), vector(1.07))
    np.testing.assert_allclose(ticks.t[:150], 0.1 * np.arange(150), rtol=1e-15)
    assert float(ticks.t_next[-1]) == 15.04
    assert float(ticks.t[np.argmax(ticks.hold)]) == pytest.approx(9.0)
    on_sample = ticks_of(flight, vector(10.0), vector(1.0))  # 10 - 1 = 90 periods, rounding or not
    assert float(on_sample.t[np.argmax(on_sample.hold)]) == pytest.approx(9.0)


def test_a_longer_clock_has_the_same_periods_and_further_ones_of_length_zero():
    flight, anchored, long = (
        clock.flight_clock(0.1, 15.04),
        clock.anchored_clock(0.1, 15.04),
        clock.flight_clock(0.1, 17.0),
    )
    assert jax.tree.structure(flight) == jax.tree.structure(anchored)
    for one in (flight, anchored):
        ticks, longer = (
            ticks_of(sized, vector(10.0), vector(1.07)) for sized in (one, one.long_enough_for([one, long]))
        )
        for short, values in zip(ticks, longer, strict=True):
            np.testing.assert_array_equal(values[: one.count], short)
        np.testing.assert_array_equal(longer.t_next[one.count :], longer.t[one.count :])


@pytest.mark.parametrize(
    ("t_f", "delta"), [(10.0, 1.07), (10.0, 1.0), (10.0, 9.999), (10.0, 12.34), (7.3, 0.6), (11.3, 0.1)]
)
def test_an_anchored_clock_covers_the_run_for_any_hand_over(t_f, delta):
    """One sample more than t_end / period is enough for partial periods at both ends."""
    ticks = ticks_of(clock.anchored_clock(0.1, 15.0), vector(t_f), vector(delta))
    assert (float(ticks.t[0]), float(ticks.t_next[-1])) == (0.0, 15.0)
    if delta < t_f:
        np.testing.assert_allclose(ticks.t[int(np.argmax(ticks.hold))], t_f - delta, atol=1e-12)
    assert int(ticks.sample[int(np.argmax(ticks.hold))]) == max(0, -int(np.ceil((t_f - delta) / 0.1)))


@pytest.mark.parametrize(("t_f", "delta"), [(30.0, 0.05), (0.5, 0.001), (3000.0, 2.0), (10.0, 5.0)])
def test_time_grid_of_the_continuous_loop_has_the_documented_nodes_and_steps(t_f, delta):
    """Nodes are the hand-over, t_f, the end of the window and the save times.

    Steps are at most proportional to the time to go. Away from these nodes, they are not much shorter than allowed.
    """
    saves = [0.3 * t_f, t_f - delta, t_f + 0.5]
    grid = clock.graded_clock(t_f, delta, t_f + 10.0, 1.0, 1.0, 0.1, (1e-3 * t_f, 1e-3), saves)
    ticks = ticks_of(grid, vector(t_f), vector(delta))
    t, t_next = np.asarray(ticks.t), np.asarray(ticks.t_next)
    assert np.all(t_next >= t)
    assert t[0] == 0.0
    assert t_next[-1] == t_f + 10.0
    for node in (t_f - delta, t_f, t_f + 1.0, *saves):
        assert node in t_next
    lasts = t_next > t  # save times at other nodes give intervals of length zero
    before = lasts & (t_next <= t_f - delta)
    np.testing.assert_array_equal(np.asarray(ticks.hold)[lasts], ~before[lasts])
    steps = (t_next - t)[before]
    assert steps.max() <= float(grid.max_step) * (1 + 1e-9)
    tau = t_f - t[before]
    # each step has a d(ln tau) + d(tau)/max_step = 1, so it is at most tau/a
    a = (grid.before - (t_f - delta) / float(grid.max_step)) / np.log(t_f / delta)
    assert np.all(steps <= tau / a * (1 + 1e-9) + 1e-12)
    # away from inserted nodes, no step is much smaller than both limits allow
    allowed = 1 / (a / tau + 1 / float(grid.max_step))
    assert np.median(steps / allowed) > 0.8


def test_time_grid_of_the_continuous_loop_has_exact_derivatives_in_t_f_and_delta():
    grid = clock.graded_clock(30.0, 0.05, 45.0, 1.0, 1.0, 0.1, (3.0, 0.1))

    def nodes(t_f, delta):
        return ticks_of(grid, t_f, delta).t

    point = (vector(30.0), vector(0.5))
    slopes = jax.jit(jax.jacfwd(nodes, (0, 1)))(*point)
    h = 1e-5
    for k, slope in enumerate(slopes):
        moved = [list(point), list(point)]
        moved[0][k], moved[1][k] = point[k] - h, point[k] + h
        central = (nodes(*moved[1]) - nodes(*moved[0])) / (2 * h)
        np.testing.assert_allclose(slope, central, atol=1e-6)  # error h^2 times third derivatives of up to 1e3


@pytest.mark.parametrize("bits", [64, 32])
def test_rounding_removes_no_period_in_32_or_64_bits(bits):
    """An earlier version with 32 bits handed over a period late, or ended before t_end, in a tenth of such runs."""
    count, before = 1200, np.arange(1, 40)
    period = np.array([0.01, 0.02, 0.05, 0.1, 0.25, 0.3])[:, None]
    t_end, t_f, delta = np.broadcast_arrays(count * period, (count - 100) * period, before * period)

    def handed_over(period, t_end, t_f, delta):
        ticks = clock.Sampled(period, t_end, vector(0.0), count).ticks(t_f, delta)
        return (
            jnp.argmax(ticks.hold),
            rollout._first_time_without_samples(ticks, t_end),
            rollout._first_time_without_samples(ticks, t_end + 0.5 * period),
        )

    with jax.enable_x64(bits == 64):
        many = jax.jit(jax.vmap(jax.vmap(handed_over)))
        first, gap, real_gap = many(*(vector(np.broadcast_to(v, t_f.shape)) for v in (period, t_end, t_f, delta)))
    np.testing.assert_array_equal(first, np.broadcast_to(count - 100 - before, t_f.shape))
    assert np.isnan(gap).all()
    assert np.isfinite(real_gap).all()
