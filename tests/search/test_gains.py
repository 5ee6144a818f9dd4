"""Tests of gains by name: set in parts and in scenarios, for single axes, and their default bounds."""

import math
from dataclasses import dataclass, fields, replace
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.devices import attitude_filter
from ptsmc_jax.laws import prescribed_time
from ptsmc_jax.numerics.pytrees import pytree
from ptsmc_jax.scenario import free_gains, from_tables, gain_bounds, study, timing
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.gain_bounds import BoundsContext
from ptsmc_jax.scenario.law_tables import LAWS, OBSERVERS
from ptsmc_jax.simulation import rollout
from tests.helpers import FIRST_FLIGHT, finer, short, ticks_of, vector
from tuning.search import gains, normalisation
from tuning.studies import judging, posing

BASE = {
    "spacecraft": {"inertia": [[11.0, 1.5, -0.7], [1.5, 9.0, 0.4], [-0.7, 0.4, 14.0]]},
    "controller": {"t_f": 8.0, "eta": 3.0, "delta": 0.5, "k1": 1.0, "sign_width": 1e-3, "surface_rate": 1.0},
    "observer": {"gain": [9.0] * 3},
    "disturbance": {"amplitude": [0.01] * 3, "frequency": [0.1] * 3},
    "loop": {"mode": "sampled", "period": 0.1, "t_end": 10.0, "window": 1.0},
    "hardware": {"attitude_noise": 2e-5, "rate_noise": 1e-6, "rate_bias_walk": 1e-5, "star_tracker_every": 2},
    "filter": {"kind": "steady_state", "bandwidth": 0.5},
    "dispersion": {"attitude": {"kind": "normal", "std_deg": 10.0}},
}
TUNED = {
    "free": ["eta", "delta", "observer_gain", "k1", "sign_width", "surface_rate", "t_f", "filter_bandwidth"],
    "bounds": {"t_f": [6.0, 12.0], "delta": [0.2, 3.0], "filter_bandwidth": [0.05, 4.0]},
}
OTHERS = {
    "t_f": {"t_f": 10.5},
    "filter_bandwidth": {"filter_bandwidth": 1.25},
    "one axis": {"observer_gain_2": 35.0},
    "all axes": {"observer_gain": 35.0},
    "each axis": {"observer_gain_1": 5.0, "observer_gain_2": 35.0, "observer_gain_3": 70.0},
    "all": {
        "t_f": 7.0,
        "delta": 1.3,
        "eta": 3.7,
        "k1": 2.0,
        "sign_width": 1e-2,
        "surface_rate": 2.4,
        "filter_bandwidth": 2.0,
        "observer_gain": 4.0,
    },
}


def wide(tables=None):
    """Return a scenario and its study, with a clock that has samples for all gains within their bounds.

    tables: of the scenario, beside `BASE`.
    """
    scenario = from_tables({**BASE, "tune": TUNED, **(tables or {})})
    return scenario, posing.set_up_tuning(scenario, 0).ready


@pytest.mark.parametrize("name", OTHERS)
def test_gains_set_in_parts_equal_gains_set_in_the_scenario(name):
    """All numbers of law, observer, sensors, actuators and times agree with parts built from the changed scenario."""
    scenario, ready = wide()
    moved = gains.with_gains(ready.parts, OTHERS[name])
    changed = study(gains.in_scenario(scenario, OTHERS[name])).parts
    for what in ("controller", "observer", "sensors", "actuators", "t_end", "window"):
        one, other = (jax.tree.leaves_with_path(getattr(parts, what)) for parts in (moved, changed))
        for (path, value), (place, expected) in zip(one, other, strict=True):
            assert path == place
            np.testing.assert_allclose(value, expected, rtol=1e-12, atol=1e-18, err_msg=f"{what}{path}")
    assert float(moved.clock.t_end) == float(changed.clock.t_end)
    known = gains.gains_of(moved)
    for gain, value in OTHERS[name].items():
        np.testing.assert_allclose(known[gain], value, rtol=1e-12)


def test_setting_t_f_keeps_the_time_from_t_f_to_t_end():
    scenario, ready = wide()
    changed = gains.in_scenario(scenario, {"t_f": 11.0})
    assert changed.loop.t_end == 13.0
    np.testing.assert_allclose(gains.with_gains(ready.parts, {"t_f": 11.0}).t_end, 13.0)
    assert gains.in_scenario(scenario, {"eta": 4.0}).loop.t_end == 10.0


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("filter_bandwidth", "filter.bandwidth"),
        ("command_corner", "hardware.command_filter.corner"),
        ("k1", "controller.k1"),
    ],
)
def test_an_invalid_gain_is_named_in_the_error_also_if_t_f_is_set_too(name, key):
    hardware = {"attitude_noise": 1e-5, "rate_noise": 1e-6, "command_filter": {"kind": "notch"}}
    ready = from_tables({"loop": {"mode": "sampled"}, "hardware": hardware, "filter": {}})
    with pytest.raises(ScenarioError, match=rf"^{key} is -1.0, but must be a number greater than 0"):
        gains.in_scenario(ready, {"t_f": 20.0, name: -1.0})


def test_gains_of_single_axes_have_names_and_bounds():
    """The gain without a number is the mean of the axes. Gains of single axes take precedence over it."""
    tables = {"free": ["eta", "observer_gain"], "per_axis": True, "bounds": {"observer_gain": [1.0, 50.0]}}
    scenario, ready = wide({"tune": tables, "observer": {"gain": [3.0, 4.0, 5.0]}})
    names = gains.free_gain_names(scenario)
    assert names == ("eta", "observer_gain_1", "observer_gain_2", "observer_gain_3")
    assert gains.present_values(ready.parts, names) == [3.0, 3.0, 4.0, 5.0]
    some = normalisation.bounds_of_scenario(scenario, ready.parts)
    assert some.names == names
    assert (some.lower[1:], some.upper[1:]) == ((1.0,) * 3, (50.0,) * 3)
    assert gains.gains_of(ready.parts)["observer_gain"] == 4.0
    again = gains.with_gains(ready.parts, gains.gains_of(ready.parts))  # single axes take precedence over the mean
    np.testing.assert_array_equal(again.observer.gain, [3.0, 4.0, 5.0])
    assert [gains.base(name) for name in names] == ["eta", "observer_gain", "observer_gain", "observer_gain"]


def test_filter_gains_are_differentiable_with_respect_to_the_bandwidth():
    def sizes(bandwidth):
        found = attitude_filter.attitude_filter(bandwidth, 2e-5, 1e-6, 1e-8, 0.1, 2)
        spread = found.spread.reshape(-1, 4)[:, jnp.array([0, 2, 3])]  # lower triangle of the factors
        return jnp.log(jnp.abs(jnp.append(spread, jnp.stack([found.attitude_gain, found.bias_gain]))))

    at = vector(0.4)
    exact, step = jax.jit(jax.jacfwd(sizes))(at), 1e-4
    numeric = (sizes(at + step) - sizes(at - step)) / (2 * step)
    np.testing.assert_allclose(exact, numeric, rtol=1e-6)  # error: step^2 times a third derivative of about 10
    for star, gyro in ((2e-5, 0.0), (0.0, 1e-6), (0.0, 0.0)):
        spread = jax.jit(
            jax.jacfwd(
                lambda b, star=star, gyro=gyro: attitude_filter.attitude_filter(b, star, gyro, 0.0, 0.1, 2).spread
            )
        )
        assert np.all(np.isfinite(spread(at)))


def test_bounds_of_the_command_filter_corner_must_be_below_the_nyquist_frequency():
    device, free = {"kind": "first_order", "corner": 0.5}, {"free": ["command_corner"]}
    tables = {"loop": {"mode": "sampled", "period": 0.1}, "hardware": {"command_filter": device}}
    wide = {**free, "bounds": {"command_corner": [1e-3, 31.4]}}
    assert from_tables({**tables, "tune": wide}).search.bounds == {"command_corner": (1e-3, 31.4)}
    for bounds in ([0.0, 3.0], [0.5, 31.5]):
        with pytest.raises(ScenarioError, match=r"must be two numbers above 0\.0 and below 31\.4"):
            from_tables({**tables, "tune": {**free, "bounds": {"command_corner": bounds}}})


@pytest.mark.parametrize("tables", [{}, {"plant": {"kind": "chain", "order": 2}}], ids=["spacecraft", "chain"])
@pytest.mark.parametrize("name", ["filter_bandwidth", "command_corner"])
def test_gains_of_absent_filters_are_rejected(tables, name):
    sampled = from_tables({"loop": {"mode": "sampled"}, **tables})
    with pytest.raises(ScenarioError, match=f"{name} is no gain of this scenario; allowed is some of"):
        gains.in_scenario(sampled, {name: 2.0})


def test_observer_gain_must_be_a_scalar():
    """An array would cause an obscure shape error of JAX in the simulation."""
    parts = study(from_tables(BASE)).parts
    with pytest.raises(
        ValueError,
        match=r"must be a number, but has shape \(3,\); observer_gain_1, observer_gain_2, .. set single axes",
    ):
        gains.with_gains(parts, {"observer_gain": vector(10.0, 10.0, 10.0)})
    many = jax.vmap(lambda gain: gains.with_gains(parts, {"observer_gain": gain}).observer.gain)(vector(3.0, 4.0))
    np.testing.assert_array_equal(many, [[3.0] * 3, [4.0] * 3])


@pytest.mark.parametrize("kind", short(["nonlinear", "finite_time", "prescribed_time"], ["prescribed_time"]))
def test_gains_of_a_chain_and_its_observer_are_set_in_parts(kind):
    tables = {
        "plant": {"kind": "chain", "order": 2},
        "observer": {"kind": kind, **({"t_o": 2.0} if kind == "prescribed_time" else {})},
        "controller": {"t_f": 6.0},
        "disturbance": {"kind": "sinusoid"},
        "tune": {"free": ["t_f", "eta", "observer_gain"]},
    }
    scenario = from_tables(tables)
    ready = posing.set_up_tuning(scenario, 0).ready
    wanted = {"t_f": 9.0, "eta": 3.4, "observer_gain": gains.gains_of(ready.parts)["observer_gain"] * 1.5}
    moved = gains.with_gains(ready.parts, wanted)
    changed = study(gains.in_scenario(scenario, wanted))
    # the grids differ: refined four times, the error of 2e-3 from the boundary layer falls by a factor of 4^4
    one, other = (rollout.simulate_parts(finer(p, 4)).metrics for p in (moved, changed.parts))
    np.testing.assert_allclose(one.peak_torque, other.peak_torque, rtol=1e-6)
    np.testing.assert_allclose(one.window_error, other.window_error, rtol=1e-4)


SAMPLED = {"mode": "sampled"}


def filtered(interval):
    """Return the tables of a scenario with an attitude filter and this period of the star tracker [s]."""
    hardware = {"attitude_noise": 2e-5, "rate_noise": 1e-6, "star_tracker_period": interval}
    return {"loop": {**SAMPLED, "period": 0.1}, "hardware": hardware, "filter": {"bandwidth": 0.5}}


def timed(t_f, **gains):
    """Return the tables of a scenario with this t_f [s] and these gains of the law."""
    return {"controller": {"t_f": t_f, **gains}}


INERTIA = [[1e7, 3e6, -2e6], [3e6, 2e7, 1e6], [-2e6, 1e6, 1.5e7]]
DEFAULT_BOUNDS = {
    "observer_gain": [  # 1.5 / t_f and 900 / t_f times the mean moment of inertia, including the scenario's gain
        (timed(30.0), (0.6, 360.0)),
        (timed(60.0), (0.3, 180.0)),
        ({**timed(30.0), "spacecraft": {"inertia": INERTIA}, "observer": {"gain": [1e7] * 3}}, (7.5e5, 4.5e8)),
        ({**timed(30.0), "observer": {"gain": [0.1] * 3}}, (0.05, 360.0)),
        ({**timed(30.0), "observer": {"gain": [500.0] * 3}}, (0.6, 1000.0)),
    ],
    "delta": [  # t_f / 600 to t_f / 4, including the scenario's delta
        (timed(3.5, delta=0.0035), (0.00175, 3.5 / 4.0)),
        (timed(35.0, delta=0.35), (35.0 / 600.0, 35.0 / 4.0)),
        (timed(4000.0, delta=40.0), (4000.0 / 600.0, 1000.0)),
    ],
    "k1": [  # 3.5 / t_f to 350 / t_f, including the scenario's K1
        (timed(3.5, k1=8.0), (1.0, 100.0)),
        (timed(35.0, k1=1.0), (0.1, 10.0)),
        (timed(4000.0, k1=1.0), (3.5 / 4000.0, 2.0)),
    ],
    "surface_rate": [  # 1.75 / t_f to half of the stability limit
        ({**timed(35.0, delta=0.5), "loop": {**SAMPLED, "period": 0.05}}, (0.05, 20.0)),
        ({**timed(35.0, delta=0.5), "loop": {**SAMPLED, "period": 0.5}}, (0.05, 2.0)),
        ({**timed(3500.0, delta=0.5), "loop": {**SAMPLED, "period": 0.05}}, (0.0005, 20.0)),
        (timed(35.0, delta=0.5), (0.05, 10.0)),
    ],
    "eta": [  # which must exceed 2: a bound beyond the scenario's eta is at twice or half its distance from 2
        ({"controller": {"eta": 12.0}}, (2.05, 22.0)),
        ({"controller": {"eta": 2.03}}, (2.015, 8.0)),
    ],
    "t_f": [  # t_f / 2 to 2 t_f, but at least 1.05 times the convergence time t_o of the observer
        ({**timed(30.0), "observer": {"kind": "prescribed_time", "t_o": 1.0}}, (15.0, 60.0)),
        ({**timed(30.0), "observer": {"kind": "prescribed_time", "t_o": 20.0}}, (21.0, 60.0)),
    ],
    "filter_bandwidth": [  # to ten times the bandwidth, at most a correction of 99 %, but at least twice the bandwidth
        (filtered(0.1), (0.05, 5.0)),
        (filtered(1.0), (0.05, math.log(10.0))),  # 1 - exp(-2 bandwidth interval) = 0.99
        (filtered(8.0), (0.05, 1.0)),
    ],
    "command_corner": [
        ({"loop": SAMPLED, "hardware": {"command_filter": {"kind": "first_order", "corner": 0.5}}}, (0.05, 5.0))
    ],
}


@pytest.mark.parametrize("name", DEFAULT_BOUNDS)
def test_default_bounds_of_a_gain_follow_from_t_f_and_the_gain_of_the_scenario(name):
    for tables, expected in DEFAULT_BOUNDS[name]:
        made = from_tables({**tables, "tune": {"free": [name]}})
        np.testing.assert_allclose(made.search.bounds[name], expected, rtol=1e-12, err_msg=str(tables))


@pytest.mark.parametrize(
    ("law", "gain", "value"),
    [
        ({"eta": 12.0}, "eta", 12.0),
        ({"eta": 2.03}, "eta", 2.03),
        ({"delta": 9.0}, "delta", 9.0),
        ({"delta": 0.02}, "delta", 0.02),
        ({"sign_width": 0.5, "delta": 0.5}, "sign_width", 0.5),
        ({"surface_rate": 130.0}, "surface_rate", 130.0),
        ({"kind": "pd", "k_d": 40.0}, "k_d", 40.0),
        ({"kind": "terminal", "p": 1.98}, "p", 1.98),
        ({"kind": "fixed_time", "n": 0.97}, "n", 0.97),
    ],
)
def test_default_bounds_contain_the_gain_of_the_scenario(law, gain, value):
    made = from_tables({"controller": law, "loop": {"mode": "sampled", "period": 0.01}, "tune": {"free": [gain]}})
    assert made.tune is not None
    low, high = made.tune.bounds[gain]
    assert low < value < high


@pytest.mark.parametrize("delta", [0.02, 0.05])
def test_the_lower_bound_of_delta_is_one_period_and_a_message_names_it_if_delta_ends_there(delta):
    made = from_tables({"controller": {"delta": delta}, "loop": {"mode": "sampled", "period": 0.02}, "tune": {}})
    assert made.tune is not None
    assert made.tune.bounds["delta"] == (0.02, 7.5)  # t_f / 4
    assert "one period" in str(free_gains.reason_of_bound(made, "delta", "lower", 0.02))
    assert free_gains.reason_of_bound(made, "delta", "lower", 0.05) is None


def test_default_bounds_are_widened_on_the_side_where_a_gain_ended():
    """They grow tenfold on a log scale, else by half of the interval, but only halfway to an invalid value.

    Bounds from the scenario file do not change. Bounds at a stability limit of the sampled loop or of a deadbeat
    observer do not change either.
    """
    free = ["eta", "delta", "observer_gain", "k1", "surface_rate"]
    tune = {"free": free, "bounds": {"surface_rate": [0.1, 1.0]}}
    sides = dict.fromkeys(free, "upper")
    for mode, moved in (("continuous", ["eta", "observer_gain", "k1"]), ("sampled", ["eta"])):
        made = from_tables({"controller": {"t_f": 30.0}, "loop": {"mode": mode}, "tune": tune})
        found, bounds = free_gains.widen_bounds(made, sides, made.defaulted), made.search.bounds
        assert list(found) == moved
        for name, (low, high) in found.items():
            least, most = bounds[name]
            farther = most + 0.5 * (most - least) if name == "eta" else 10.0 * most
            assert (low, high) == (least, pytest.approx(farther, rel=1e-12))
    found = free_gains.widen_bounds(made, {"eta": "lower"}, made.defaulted)
    assert found["eta"] == (pytest.approx(0.5 * (2.0 + bounds["eta"][0])), bounds["eta"][1])  # eta exceeds 2
    assert free_gains.widen_bounds(made, sides, set()) == {}


@pytest.mark.parametrize(("t_f", "needed"), [(40.0, "50 s"), (35.1, "45.1 s")])
def test_gains_that_need_more_samples_than_the_clock_has_are_rejected(t_f, needed):
    """The number of samples is fixed. With too few samples, a run would end before t_end without a message."""
    ready = scenario.study(scenario.replace(scenario.read(FIRST_FLIGHT), tune=None))
    other = {"t_f": t_f, "delta": 1.0}
    with pytest.raises(ValueError, match=rf"t_f = {t_f:g} s needs {needed} of samples, but the parts' clock has 45"):
        gains.with_gains(ready.parts, other)
    assert float(gains.with_gains(ready.parts, {"delta": 1.0}).controller.delta) == 1.0
    with pytest.raises(ValueError, match="model is no gain of these parts; allowed are delta, eta"):
        gains.with_gains(ready.parts, {"model": 1.0})  # an attribute of the law
    roomy = scenario.study(ready.scenario, reach=replace(timing.reach_of(ready.scenario), t_f=40.0))
    moved = gains.with_gains(roomy.parts, other)
    law = moved.controller
    assert float(ticks_of(moved.clock, law.t_f, law.delta).t_next[-1]) == pytest.approx(float(moved.t_end))


def test_gains_are_compared_with_the_published_ones_only_if_these_can_be_simulated():
    """At a rate of 0.6 rad/s the published eta of 3 overshoots past 180 deg, and an eta of 6 does not."""
    fast = {"initial": {"rotvec_deg": [0.0, 0.0, 0.0], "rate": [0.6, 0.0, 0.0]}, "loop": {"mode": "sampled"}}
    law = {"t_f": 30.0, "delta": 0.5, "error": "multiplicative"}
    before = from_tables({**fast, "controller": {**law, "eta": 6.0}})
    found, refused = judging.reference_scenarios(before)
    assert found == {"before": before}
    assert refused is not None
    assert refused.startswith("initial.rotvec_deg is")
    quick = {"t_f": 0.04, "delta": 0.01}  # t_f is shorter than the published delta
    tiny = from_tables(
        {"controller": quick, "loop": {"mode": "sampled", "period": 0.001, "t_end": 0.05, "window": 0.01}}
    )
    found, refused = judging.reference_scenarios(tiny)
    assert refused is None
    assert found["published"].controller.delta == 0.001  # one period, longer than the scaled delta
    assert list(judging.reference_scenarios(found["published"])[0]) == ["published"]


PLANTS = {
    "spacecraft": {"loop": {"mode": "sampled"}},
    "chain": {"plant": {"kind": "chain"}, "loop": {"mode": "sampled"}},
}


@pytest.mark.parametrize(
    ("plant", "table", "kind"),
    [
        (plant, table, kind)
        for plant in PLANTS
        for table, kinds in (("controller", LAWS), ("observer", OBSERVERS))
        for kind in kinds[plant]
        if kind != "custom" and kinds[plant][kind].gains
    ],
)
def test_default_bounds_of_every_gain_are_valid_and_contain_the_scenarios_gain(plant, table, kind):
    """Each gain is free alone and with all other gains, because its valid values can depend on other free gains."""
    tables = {**PLANTS[plant], table: {"kind": kind}}
    law = from_tables(tables)
    names = list(getattr(law, table).gains)
    for free in (*([name] for name in names), names):
        loaded = from_tables({**tables, "tune": {"free": free}})
        choice = BoundsContext(loaded, loaded.search.gains, loaded.search.bounds)
        for name in free:
            (low, high), (least, most, closed) = (
                loaded.search.bounds[name],
                gain_bounds.rules_of(loaded, name).allowed(choice),
            )
            assert least <= low if closed else least < low, name
            assert low < high < most, name
            present_values = free_gains._present_values(loaded, name)
            assert all(low <= value <= high for value in present_values), name


@pytest.mark.parametrize("order", [2, 4])
def test_the_published_gains_scale_with_the_mission_and_follow_the_order_of_a_chain(order):
    """The published t_f is 30 s for a spacecraft and 5 s for a chain; delta is at least one period."""
    tables = {"controller": {"t_f": 5.0}, "loop": {"mode": "sampled", "period": 0.1}}
    known = {"eta": 3.0, "delta": 0.1, "k1": 1.0, "sign_width": 1e-3, "surface_rate": 1.0, "observer_gain": 10.0}
    six_times = ("k1", "sign_width", "surface_rate", "observer_gain")
    expected = {name: value * (6.0 if name in six_times else 1.0) for name, value in known.items()}
    assert gains.published_gains(from_tables(tables)) == pytest.approx(expected, rel=1e-12)
    known |= {"eta": order + 1.0}
    of_chain = gains.published_gains(from_tables({**tables, "plant": {"kind": "chain", "order": order}}))
    assert of_chain == {name: known[name] for name in of_chain}
    assert {"eta", "delta", "k1"} <= set(of_chain)


@pytree
@dataclass(frozen=True, kw_only=True)
class Shared(prescribed_time.PrescribedTime):
    """A custom law with a gain whose name begins like the gains of an observer."""

    observer_share: float = 0.5
    tunable: ClassVar[tuple[str, ...]] = (*prescribed_time.PrescribedTime.tunable, "observer_share")


def shared(parts):
    """Return the parts with a law of the class `Shared` that has the gains of their law."""
    law = parts.controller
    return replace(parts, controller=Shared(**{f.name: getattr(law, f.name) for f in fields(law)}))


def test_a_gain_of_a_custom_law_is_set_in_the_law_whatever_its_name_begins_with():
    parts = shared(study(from_tables(BASE)).parts)
    moved = gains.with_gains(parts, {"observer_share": 0.25, "observer_gain": 4.0})
    assert (float(moved.controller.observer_share), gains.gains_of(moved)["observer_share"]) == (0.25, 0.25)
    np.testing.assert_array_equal(moved.observer.gain, [4.0] * 3)


def test_column_of_the_published_gains_is_named_after_their_source():
    paper = scenario.from_tables({"loop": {"mode": "sampled"}})
    assert gains.published_label(paper) == "published gains"
    assert (
        gains.published_label(scenario.replace(paper, loop__period=0.5)) == "published gains, scaled"
    )  # a hand-over of a period
    assert (
        gains.published_label(scenario.replace(paper, spacecraft={"inertia": [0.1, 0.1, 0.1]}))
        == "published gains, scaled"
    )
    assert (
        gains.published_label(scenario.replace(paper, controller={"kind": "pd"}))
        == "published gains, prescribed-time law"
    )


@pytest.mark.parametrize("kind", ["chain", "spacecraft"])
def test_published_scenario_has_the_papers_law_on_every_plant(kind):
    order = {"order": 2} if kind == "chain" else {}
    simulated = scenario.from_tables(
        {"plant": {"kind": kind, **order}, "loop": {"mode": "sampled"}, "controller": {"kind": "pd", "t_f": 12.0}}
    )
    published_scenario = gains.published_scenario(simulated)
    assert (
        published_scenario.controller.kind,
        published_scenario.controller.t_f,
        published_scenario.controller.eta,
    ) == ("prescribed_time", 12.0, 3.0)
    assert getattr(published_scenario.controller, "error", "multiplicative") == "multiplicative"
