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
def test_anchored_periods_fill_the_time_and_meet_the_hand_over(t_f, share, coast):
    period, delta = 0.1, max(share * t_f, 0.1)
    ticks = ticks_of(clock.Anchored(vector(period), vector(t_f + coast), 401, 400), vector(t_f), vector(delta))
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
def test_the_last_period_of_an_anchored_clock_ends_with_the_run_whatever_rounding_does(period, t_f, delta, after):
    """As many periods as there are from the hand-over on end 4e-15 s before it."""
    t_end = t_f + after
    whole = round((t_end - t_f + delta) / period)
    assert 0.0 < t_end - (t_f - delta + whole * period) < 1e-14
    ticks = ticks_of(clock.anchored(period, t_end, t_f, t_end - t_f + delta), vector(t_f), vector(delta))
    assert float(ticks.t_next[-1]) == t_end


@pytest.mark.parametrize("periods", [10, 20])
def test_anchored_ticks_are_continuous_where_delta_is_a_multiple_of_the_period(periods):
    anchored = clock.anchored(0.1, 15.0, 10.0, 8.0)

    def ends(delta):
        ticks = ticks_of(anchored, vector(10.0), delta)
        return ticks.t, ticks.t_next

    at = vector(periods * 0.1)
    for nearby in (at - 1e-9, at + 1e-9):
        for a, b in zip(ends(at), ends(nearby), strict=True):
            np.testing.assert_allclose(a, b, atol=1.1e-9)
    # the lengths' derivatives add up to none: t_end does not move
    slopes = jax.jvp(ends, (at,), (vector(1.0),))[1]
    np.testing.assert_allclose(np.sum(np.asarray(slopes[1] - slopes[0])), 0.0, atol=1e-12)


@pytest.mark.parametrize(("t_f", "delta"), [(12.0, 0.7), (30.3, 0.9), (12.0, 0.8), (30.0, 0.7)])
def test_rounding_makes_no_sample_just_after_the_first_one(t_f, delta):
    """12.0 - 0.7 is 8e-17 s beyond 113 periods: a run had two samples at t = 0, slopes of its peak half of each."""
    anchored = clock.anchored(0.1, t_f + 4.03, t_f, 6.0)

    @jax.jit  # whose rounding is another one
    def starts(delta):
        return ticks_of(anchored, vector(t_f), delta).t

    @jax.jit
    def lengths(delta):
        ticks = ticks_of(anchored, vector(t_f), delta)
        return ticks.t_next - ticks.t

    at = vector(delta)
    flown = np.asarray(lengths(at))[np.asarray(lengths(at)) > 0]
    np.testing.assert_allclose(flown, [0.1] * round((t_f + 4.0) / 0.1) + [0.03], atol=1e-12)
    for function in (starts, lengths):  # slopes are those of a slightly larger delta
        np.testing.assert_array_equal(jax.jacfwd(function)(at), jax.jacfwd(function)(at + 1e-6))


@pytest.mark.parametrize(("delta", "t_end"), [(0.6, 8.3), (0.9, 8.3), (0.6, 10.3), (0.8, 8.3)])
def test_rounding_makes_no_sample_just_before_the_end(delta, t_end):
    """7.3 - 0.6 s and 16 periods are 2e-15 s before 8.3: a sample more, and slopes of the effort those of another."""
    anchored = clock.anchored(0.1, t_end, 7.3, 5.0)

    def lengths(delta):
        ticks = ticks_of(anchored, vector(7.3), delta)
        return ticks.t_next - ticks.t

    at = vector(delta)
    for function in (lengths, jax.jit(lengths)):  # whose rounding is another one
        flown = np.asarray(function(at))
        np.testing.assert_allclose(flown[flown > 0.0], [0.1] * round(t_end / 0.1), atol=1e-12)
        np.testing.assert_array_equal(
            jax.jacfwd(function)(at)[flown > 0.0], [-1.0, *[0.0] * (sum(flown > 0.0) - 2), 1.0]
        )


@pytest.mark.parametrize(("t_f", "delta"), [(35.0, 1.0), (35.0, 0.6), (30.0, 0.7), (12.0, 0.8)])
def test_what_is_computed_in_a_first_period_that_is_a_whole_one_has_the_slopes_of_a_slightly_larger_delta(t_f, delta):
    """35 - 1 s are 340 periods and 1e-14 s: observer and law were told of a whole period, whose length is constant."""
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


def test_a_partial_first_period_takes_part_of_its_noise_from_the_next_sample():
    ticks = ticks_of(clock.anchored(0.1, 15.0, 10.0, 8.0), vector(10.0), vector(1.07))
    first = int(np.flatnonzero(np.asarray(ticks.t_next) > 0)[0])
    np.testing.assert_allclose(ticks.t_next[first] - ticks.t[first], 0.03, atol=1e-12)
    np.testing.assert_allclose(ticks.noise_weight[first], 0.3, atol=1e-10)


def test_flight_clock_counts_from_zero_and_hands_over_at_the_first_sample_not_before_t_s():
    flight = clock.flight(0.1, 15.04)
    ticks = ticks_of(flight, vector(10.0), vector(1.07))
    np.testing.assert_allclose(ticks.t[:150], 0.1 * np.arange(150), rtol=1e-15)
    assert float(ticks.t_next[-1]) == 15.04
    assert float(ticks.t[np.argmax(ticks.hold)]) == pytest.approx(9.0)
    on_sample = ticks_of(flight, vector(10.0), vector(1.0))  # 10 - 1 = 90 periods, rounding or not
    assert float(on_sample.t[np.argmax(on_sample.hold)]) == pytest.approx(9.0)


@pytest.mark.parametrize(("t_f", "delta"), [(30.0, 0.05), (0.5, 0.001), (3000.0, 2.0), (10.0, 5.0)])
def test_graded_grid_has_its_nodes_and_steps_as_promised(t_f, delta):
    saves = [0.3 * t_f, t_f - delta, t_f + 0.5]
    grid = clock.graded(t_f, delta, t_f + 10.0, 1.0, 1.0, 0.1, (1e-3 * t_f, 1e-3), saves)
    ticks = ticks_of(grid, vector(t_f), vector(delta))
    t, t_next = np.asarray(ticks.t), np.asarray(ticks.t_next)
    assert np.all(t_next >= t)
    assert t[0] == 0.0
    assert t_next[-1] == t_f + 10.0
    for node in (t_f - delta, t_f, t_f + 1.0, *saves):
        assert node in t_next
    lasts = t_next > t  # saves on other nodes make intervals of length zero
    before = lasts & (t_next <= t_f - delta)
    np.testing.assert_array_equal(np.asarray(ticks.hold)[lasts], ~before[lasts])
    steps = (t_next - t)[before]
    assert steps.max() <= float(grid.max_step) * (1 + 1e-9)
    tau = t_f - t[before]
    # a d(ln tau) + d(tau)/max_step = 1 a step: each is at most tau/a of what remains
    a = (grid.before - (t_f - delta) / float(grid.max_step)) / np.log(t_f / delta)
    assert np.all(steps <= tau / a * (1 + 1e-9) + 1e-12)
    # and nowhere much smaller than both allow, away from inserted nodes
    allowed = 1 / (a / tau + 1 / float(grid.max_step))
    assert np.median(steps / allowed) > 0.8


def test_graded_nodes_move_with_t_f_and_delta_by_their_exact_derivative():
    grid = clock.graded(30.0, 0.05, 45.0, 1.0, 1.0, 0.1, (3.0, 0.1))

    def nodes(t_f, delta):
        return ticks_of(grid, t_f, delta).t

    point = (vector(30.0), vector(0.5))
    slopes = jax.jit(jax.jacfwd(nodes, (0, 1)))(*point)
    h = 1e-5
    for k, slope in enumerate(slopes):
        moved = [list(point), list(point)]
        moved[0][k], moved[1][k] = point[k] - h, point[k] + h
        central = (nodes(*moved[1]) - nodes(*moved[0])) / (2 * h)
        np.testing.assert_allclose(slope, central, atol=1e-6)  # h^2 times third derivatives of up to 1e3


@pytest.mark.parametrize("bits", [64, 32])
def test_rounding_costs_no_period_whatever_the_precision(bits):
    """With 32 bits a tenth of such flights handed over a period late, and as many were said to end before t_end."""
    count, before = 1200, np.arange(1, 40)
    period = np.array([0.01, 0.02, 0.05, 0.1, 0.25, 0.3])[:, None]
    t_end, t_f, delta = np.broadcast_arrays(count * period, (count - 100) * period, before * period)

    def handed_over(period, t_end, t_f, delta):
        ticks = clock.Flight(period, t_end, count).ticks(t_f, delta)
        return jnp.argmax(ticks.hold), rollout._gap(ticks, t_end), rollout._gap(ticks, t_end + 0.5 * period)

    with jax.enable_x64(bits == 64):
        many = jax.jit(jax.vmap(jax.vmap(handed_over)))
        first, gap, real_gap = many(*(vector(np.broadcast_to(v, t_f.shape)) for v in (period, t_end, t_f, delta)))
    np.testing.assert_array_equal(first, np.broadcast_to(count - 100 - before, t_f.shape))
    assert np.isnan(gap).all()
    assert np.isfinite(real_gap).all()
