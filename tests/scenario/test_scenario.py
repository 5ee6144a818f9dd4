import contextlib
import copy
import pickle
import re
import tomllib
from typing import Any

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ptsmc_jax.campaigns import store
from ptsmc_jax.devices import sensors
from ptsmc_jax.scenario import from_tables, parsing, read, reference_tables, replace, study, timing
from ptsmc_jax.scenario.attitude_keys import quaternion
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.timing import reach_of
from ptsmc_jax.signals import references
from ptsmc_jax.simulation import clock
from tests.helpers import PAPER_ATTITUDE, ticks_of, vector
from tests.scenario.bad_scenarios import BAD, ONE_KEY, SAMPLED, check_sentence
from tests.scenario.every_key import complete


@pytest.mark.parametrize(("text", "of_what", "allowed"), BAD, ids=[text[:60] for text, _, _ in BAD])
def test_a_configuration_error_is_one_sentence(text, of_what, allowed):
    with pytest.raises(ScenarioError) as caught:
        study(from_tables(tomllib.loads(text)))
    check_sentence(str(caught.value), of_what, allowed)


@pytest.mark.parametrize(
    "form", ["controller.eta = %s1%s|[|]", "eta = %s1%s|{ a = |}", "[%sa%s]|a.|", "a%s = 1%s|.a|", "a%s = 1%s| . 'b'|"]
)
@pytest.mark.parametrize("levels", [9, 300, 100_000])
def test_too_deep_nesting_is_refused(tmp_path, form, levels):
    """The parser would need 40 GB for a key with 100 000 dots."""
    path = tmp_path / "s.toml"
    text, opens, closes = form.split("|")
    path.write_text(text % (opens * levels, closes * levels))
    with pytest.raises(ScenarioError) as caught:
        read(path)
    check_sentence(str(caught.value), "tables or arrays in each other", "at most 8 levels are allowed")


def test_an_error_has_the_key_the_value_and_the_allowed_values():
    with pytest.raises(ScenarioError) as caught:
        from_tables({"hardware": {"attitude_noise": "-8 arcsec"}, "loop": {"mode": "sampled"}})
    error = pickle.loads(pickle.dumps(caught.value))  # as between processes of a cluster
    assert error.key == "hardware.attitude_noise"
    assert error.value == "-8 arcsec"
    assert error.allowed.startswith("a number, at least 0")
    assert str(error).startswith('hardware.attitude_noise is "-8 arcsec", but must be a number')


def test_a_chain_is_not_offered_disturbances_of_a_spacecraft():
    text = "plant.kind = 'chain'\ndisturbance.kind = 'constant'\ndispersion.disturbance_phase = {}"
    with pytest.raises(ScenarioError, match=r'allowed is "sinusoid"$'):
        from_tables(tomllib.loads(text))


@pytest.mark.parametrize(
    "key",
    """controller.t_f controller.eta controller.delta controller.k1 controller.sign_width loop.t_end loop.window
    controller.disturbance_rate_bound controller.initial_estimate_error loop.period loop.settling_angle
    controller.surface_rate spacecraft.inertia observer.gain disturbance.amplitude disturbance.frequency
    disturbance.phase initial.rate initial.rotvec_deg initial.mrp""".split(),
)
@pytest.mark.parametrize("mode", ["continuous", "sampled"])
@pytest.mark.parametrize("size", ["1e300", "1e-300"])
def test_extreme_numbers_never_crash_a_study(key, mode, size):
    three = key.split(".")[0] in ("spacecraft", "observer", "disturbance", "initial")
    tables = tomllib.loads(f"loop.mode = '{mode}'\n{key} = {[float(size)] * 3 if three else size}")
    with contextlib.suppress(ScenarioError):
        study(from_tables(tables))


@pytest.mark.parametrize(
    "text",
    [
        "controller.eta = 2.001",
        "controller.delta = 29.9",
        "loop = { t_end = 31.0 }",
        "controller.t_f = 20.1\nloop = { t_end = 21.2, window = 1.1 }",  # in binary 20.1 + 1.1 is above 21.2
        SAMPLED + "controller = { delta = 0.3, t_f = 20 }\nloop.period = 0.3",
        "spacecraft.inertia = [1, 2, 3]",  # a flat plate
        "initial.quat_xyzw = [0, 0, 0, 1.0000009]",
        "initial.quat_xyzw = [0, 0, 0, -1]",
        "initial.rotvec_deg = [0, 0, 179.8]",  # q4 = 1.7e-3
        "initial = { mrp = [0, 0, 0], rate = [0.5, 0, 0] }",  # |v| peaks at 0.92
        "reference = { kind = 'spin', rate = [0, 0.078, 0] }",  # q_f4 = cos(1.56) = 0.011 at t_end
        "dispersion.attitude = { min_deg = 9, max_deg = 9 }",
        "orbit = { semi_major_axis = 1.84e6, gravitational_parameter = 4.9e12 }",  # of the Moon
        "orbit = { inclination = '180 deg', perigee = '-360 deg', ascending_node = '360 deg' }",
        "pointing = { window = 6.0, after = 9.0 }",  # the default t_end is 51 s
        "requirements.effort = { limit = 9.0 }",
        "controller.sign_width = 0",
        SAMPLED + "wheels = { momentum_limit = 1, momentum = [1, 0, -1, 0] }",
        SAMPLED + "filter.bandwidth = 0.1\nhardware.star_tracker_period = 0.05",
        SAMPLED + "loop.period = 1\ncontroller.delta = 1\nfilter.bandwidth = 0.1\nhardware.star_tracker_every = 40",
        "hardware = {}\nrequirements = {}\ndispersion = {}\ntune.bounds = {}",
    ],
)
def test_values_at_the_limits_are_accepted(text):
    study(from_tables(tomllib.loads(text)))


@pytest.mark.parametrize(
    "text", ["period = 6.0\nwindow = 6.0\n[controller]\ndelta = 6.0", "[controller]\nt_f = 0.15\ndelta = 0.05"]
)
def test_tune_without_bounds_is_accepted_for_every_valid_scenario(text):
    tables = tomllib.loads(f"[loop]\nmode = 'sampled'\n{text}")
    from_tables(tables)
    bounds = from_tables({**tables, "tune": {}}).tune
    assert bounds is not None


@pytest.mark.parametrize(
    ("text", "t_end"),
    [
        ("", 40.0),
        ("controller.t_f = 36.0", 46.0),  # a published case, with its 10 s after t_f
        ("controller.t_f = 12.5", 12.5 * 4.0 / 3.0),
        ("controller.t_f = 1200.0", 1600.0),
        ("controller.t_f = 1200.0\nloop.window = 500.0", 1700.0),
        ("loop.t_end = 33.0", 33.0),
        ('plant.kind = "chain"', 15.0),
        ('plant.kind = "chain"\ncontroller.t_f = 20.0', 60.0),
    ],
    ids=str,
)
def test_a_run_ends_a_third_of_t_f_or_the_window_after_t_f_by_default(text, t_end):
    """The run of a chain ends at 3 t_f."""
    assert from_tables(tomllib.loads(text)).loop.t_end == pytest.approx(t_end, rel=1e-12)


@pytest.mark.parametrize(("period", "window", "t_end"), [(0.5, 1.0, 40.0), (2.5, 2.5, 40.0), (12.0, 12.0, 42.0)])
def test_the_default_window_is_a_second_or_a_longer_period(period, window, t_end):
    slow = from_tables({"loop": {"mode": "sampled", "period": period}})
    assert (slow.loop.window, slow.controller.delta, slow.loop.t_end) == (window, max(0.05, period), t_end)
    again = replace(slow, loop__period=0.5)  # a default stays a default
    assert (again.loop.window, again.loop.t_end) == (1.0, 40.0)
    assert from_tables({"loop": {"period": period}}).loop.window == 1.0  # the continuous loop has no period


# Attitudes, computed by hand. "ZYX" rotates by 90 deg about z, then about the new x: q = q_z q_x. "zyx" rotates about
# the fixed axes: q = q_x q_z. The permutation x -> y -> z -> x is a rotation of 120 deg about (1, 1, 1), with the MRP
# tan(30 deg) / sqrt(3). Its matrix has the body axes as columns.
BY_HAND = [
    ({"quat_xyzw": [0.6, 0.0, 0.0, 0.8]}, [0.6, 0.0, 0.0, 0.8]),
    ({"quat_wxyz": [0.8, 0.6, 0.0, 0.0]}, [0.6, 0.0, 0.0, 0.8]),
    ({"rotvec_deg": [0.0, 0.0, 90.0]}, [0.0, 0.0, 0.5**0.5, 0.5**0.5]),
    ({"mrp": [1 / 3, 1 / 3, 1 / 3]}, [0.5, 0.5, 0.5, 0.5]),
    ({"dcm_body_to_inertial": [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]}, [0.5, 0.5, 0.5, 0.5]),
    ({"euler_deg": [90.0, 0.0, 90.0], "sequence": "ZYX"}, [0.5, 0.5, 0.5, 0.5]),
    ({"euler_deg": [90.0, 0.0, 90.0], "sequence": "zyx"}, [0.5, -0.5, 0.5, 0.5]),
]
# some dozen rounding errors of numbers of order one
ROUNDING = 1e-14


def attitude_of(scenario, table):
    """Return the quaternion (4,), scalar last, of the attitude in the table "initial" or "reference"."""
    return quaternion(getattr(scenario, table), table)


@pytest.mark.parametrize("table", ["initial", "reference"])
@pytest.mark.parametrize(("said", "expected"), BY_HAND, ids=[str(said) for said, _ in BY_HAND])
def test_attitude_keys_give_the_quaternions_computed_by_hand(table, said, expected):
    scenario = from_tables({table: said})
    np.testing.assert_allclose(attitude_of(scenario, table), expected, atol=ROUNDING)
    parts = study(scenario).parts
    q = parts.initial.q if table == "initial" else parts.reference(parts.t_end).q
    np.testing.assert_allclose(q, expected, atol=ROUNDING)


def every_parametrisation(rotation):
    """Yield a table with the keys of each parametrisation of an attitude, computed by NumPy.

    rotation: from body to inertial vectors, a `Rotation`.
    """
    matrix = rotation.as_matrix()
    vector = rotation.as_rotvec()
    angle = np.linalg.norm(vector)
    axis = vector / angle
    v, s = axis * np.sin(angle / 2), np.cos(angle / 2)
    yield {"quat_xyzw": [*v, s]}
    yield {"quat_xyzw": [*-v, -s]}
    yield {"quat_wxyz": [s, *v]}
    yield {"rotvec_deg": list(np.rad2deg(vector))}
    yield {"mrp": list(axis * np.tan(angle / 4))}
    yield {"dcm_body_to_inertial": matrix.tolist()}
    for sequence in ("ZYX", "zyx", "XYZ", "ZXZ", "zxz", "YXY"):
        yield {"euler_deg": list(rotation.as_euler(sequence, degrees=True)), "sequence": sequence}


@pytest.mark.parametrize("seed", range(8))
def test_every_attitude_key_gives_the_same_attitude(seed):
    rotation = Rotation.random(rng=seed)
    for said in every_parametrisation(rotation):
        for table in ("initial", "reference"):
            q = attitude_of(from_tables({table: {key: plain(value) for key, value in said.items()}}), table)
            # the body axes in inertial axes; Euler angles near their own singularity lose a digit or two
            np.testing.assert_allclose(Rotation.from_quat(q).as_matrix(), rotation.as_matrix(), atol=1e-12)
            assert abs(np.linalg.norm(q) - 1.0) < ROUNDING


def plain(value):
    """Return an array as a list, nested like the array."""
    return np.asarray(value).tolist()


def test_a_table_without_an_attitude_keeps_the_default_one():
    scenario: Any = from_tables({"initial": {"rate": [0.0, 0.0, 0.1]}, "reference": {"kind": "spin"}})
    np.testing.assert_allclose(attitude_of(scenario, "initial"), PAPER_ATTITUDE, atol=ROUNDING)
    np.testing.assert_array_equal(attitude_of(scenario, "reference"), [0.0, 0.0, 0.0, 1.0])
    assert scenario.initial.rate == (0.0, 0.0, 0.1)


# Parts
EVERYTHING = """
[spacecraft]
inertia = [[11.0, 1.5, -0.7], [1.5, 9.0, 0.4], [-0.7, 0.4, 14.0]]
[initial]
rotvec_deg = [0.0, 0.0, 90.0]
rate = [0.01, 0.02, 0.03]
[reference]
kind = "spin"
rotvec_deg = [90.0, 0.0, 0.0]
rate = [0.001, 0.002, 0.003]
[disturbance]
amplitude = [1e-3, 2e-3, 3e-3]
frequency = [0.1, 0.2, 0.3]
phase = [1.0, 2.0, 3.0]
bias = [4e-3, 5e-3, 6e-3]
[controller]
t_f = 20.0
eta = 4.0
delta = 0.5
k1 = 1.5
surface_rate = 2.5
sign_width = 2e-3
disturbance_rate_bound = 3e-3
initial_estimate_error = 4e-3
[observer]
gain = [10.0, 20.0, 30.0]
[loop]
mode = "sampled"
period = 0.25
t_end = 33.0
window = 2.0
settling_angle = 5e-3
[hardware]
attitude_noise = 2e-5
rate_noise = 1e-6
[dispersion]
attitude = { kind = "axis_angle", min_deg = 90.0, max_deg = 180.0 }
[requirements]
effort = 6.0
peak_torque = { limit = 0.5 }
"""


def test_every_key_sets_a_field_of_its_part():
    """The dispersion of the attitude and the requirements are compared too."""
    scenario: Any = from_tables(tomllib.loads(EVERYTHING))
    ready = study(scenario)
    parts = ready.parts
    half = 0.5**0.5
    expected = [
        (parts.plant.inertia, scenario.spacecraft.inertia),
        (parts.controller.model.inertia, scenario.spacecraft.inertia),
        (parts.observer.model.inertia, scenario.spacecraft.inertia),
        (parts.plant.inertia @ parts.plant.inertia_inverse, np.eye(3)),
        (parts.initial.q, [0.0, 0.0, half, half]),
        (parts.initial.w, [0.01, 0.02, 0.03]),
        (parts.reference.q, [half, 0.0, 0.0, half]),
        (parts.reference.rate, [0.001, 0.002, 0.003]),
        (parts.disturbance.amplitude, [1e-3, 2e-3, 3e-3]),
        (parts.disturbance.frequency, [0.1, 0.2, 0.3]),
        (parts.disturbance.phase, [1.0, 2.0, 3.0]),
        (parts.disturbance.bias, [4e-3, 5e-3, 6e-3]),
        (parts.controller.t_f, 20.0),
        (parts.controller.eta, 4.0),
        (parts.controller.delta, 0.5),
        (parts.controller.k1, 1.5),
        (parts.controller.surface_rate, 2.5),
        (parts.controller.sign_width, 2e-3),
        (parts.observer.disturbance_rate_bound, 3e-3),
        (parts.observer.initial_error, 4e-3),
        (parts.observer.gain, [10.0, 20.0, 30.0]),
        (parts.t_end, 33.0),
        (parts.window, 2.0),
        (parts.settling_angle, 5e-3),
    ]
    for value, wanted in expected:
        np.testing.assert_allclose(value, wanted, atol=ROUNDING)
    assert isinstance(parts.sensors, sensors.Sensors)
    assert (float(parts.sensors.attitude_noise), float(parts.sensors.rate_noise)) == (2e-5, 1e-6)
    assert parts.clock.anchored == 1.0
    assert (float(parts.clock.period), float(parts.clock.t_end)) == (0.25, 33.0)
    angle: Any = ready.dispersion.numbers["initial_attitude"]
    assert angle.distribution == "axis_angle"
    np.testing.assert_allclose(angle.at(vector([0.5, 0.5, 0.0]))[2], np.pi / 2, rtol=ROUNDING)
    np.testing.assert_allclose(angle.at(vector([0.5, 0.5, 1.0]))[2], np.pi, rtol=ROUNDING)
    assert [(r.metric, r.limit) for r in ready.requirements] == [("effort", 6.0), ("peak_torque", 0.5)]


def test_kinds_in_a_scenario_choose_the_parts_of_a_run():
    def parts_of(text):
        return study(from_tables(tomllib.loads(text))).parts

    assert isinstance(parts_of("").clock, clock.Graded)
    assert parts_of(SAMPLED + "loop.clock = 'flight'").clock.anchored == 0.0
    assert isinstance(parts_of("").reference, references.Fixed)
    assert parts_of(SAMPLED).sensors.perfect
    steady = parts_of("disturbance = { kind = 'constant', amplitude = [1.0, 2.0, 3.0] }")
    np.testing.assert_array_equal(steady.disturbance(steady.t_end), [1.0, 2.0, 3.0])
    still = parts_of("disturbance.kind = 'none'")
    np.testing.assert_array_equal(still.disturbance(still.t_end), [0.0, 0.0, 0.0])
    one = parts_of(SAMPLED + "hardware.rate_noise = 1e-6").sensors
    assert one is not None
    assert (float(one.attitude_noise), float(one.rate_noise)) == (0.0, 1e-6)


def test_kind_of_an_attitude_dispersion_sets_its_distribution():
    def drawn(text) -> Any:
        return study(from_tables(tomllib.loads(text))).dispersion.numbers.get("initial_attitude")

    assert drawn("") is None
    assert drawn("dispersion.attitude.kind = 'uniform'").distribution == "any_attitude"
    normal = drawn("dispersion.attitude = { kind = 'normal', std_deg = 90.0 }")
    assert normal.distribution == "normal"
    np.testing.assert_allclose(normal.spread, [np.pi / 2] * 3, rtol=ROUNDING)


@pytest.mark.parametrize("mode", ["anchored", "flight"])
def test_the_clock_covers_the_reach_of_the_gains(mode):
    """The reach is the range of t_f, delta and period in a search. Every run within it has samples until t_end."""
    scenario = from_tables(tomllib.loads(SAMPLED + f"loop.clock = '{mode}'"))
    parts = study(scenario, reach=reach_of(scenario, t_f=35.0)).parts
    for t_f, delta in ((30.0, 0.05), (30.0, 4.0)):
        ticks = ticks_of(parts.clock, vector(t_f), vector(delta))
        assert (float(ticks.t[0]), float(ticks.t_next[-1])) == (0.0, 40.0)
        assert float((ticks.t_next - ticks.t).max()) <= 0.05 * (1 + ROUNDING) + 40 * np.finfo(float).eps
    with pytest.raises(ValueError, match="smallest_delta is -3, but must be a finite number of at least 0"):
        reach_of(scenario, smallest_delta=-3)


@pytest.mark.parametrize(
    ("farther", "refused"),
    [
        ({"smallest_t_f": 0.0}, "smallest_t_f is 0.0, but must be a finite number greater than 0"),
        ({"smallest_period": 0}, "smallest_period is 0, but must be a finite number greater than 0"),
        ({"t_f": 20.0}, "smallest_t_f is 30, but must be at most t_f, 20"),
        ({"smallest_period": 1e9}, "smallest_period is 1e+09, but must be at most period, 0.05"),
    ],
    ids=str,
)
def test_a_reach_with_an_impossible_range_is_refused(farther, refused):
    """The reach is the range of t_f, delta and period in a search."""
    with pytest.raises(ValueError, match=f"^{re.escape(refused)}$"):
        reach_of(from_tables({"loop": {"mode": "sampled"}}), **farther)


@pytest.mark.parametrize("mode", ["anchored", "flight"])
def test_periods_within_a_reach_share_a_structure_and_each_has_samples_to_the_end(mode):
    """The reach is the range of the period in a map. With one structure, all periods share a compiled program."""
    found = []
    for period in (0.02, 0.05, 0.2):
        scenario = from_tables(
            tomllib.loads(SAMPLED + f"loop.clock = '{mode}'\nloop.period = {period}\ncontroller.delta = 0.4")
        )
        parts = study(scenario, reach=reach_of(scenario, smallest_period=0.02, period=0.2)).parts
        ticks = ticks_of(parts.clock, parts.controller.t_f, parts.controller.delta)
        assert (float(ticks.t[0]), float(ticks.t_next[-1])) == (0.0, 40.0)
        lasts = np.asarray(ticks.t_next - ticks.t)
        assert np.median(lasts[lasts > 1e-9]) == pytest.approx(period, rel=1e-9)
        assert parts.substeps >= study(scenario).parts.substeps
        found.append(jax.tree.structure(parts))
    assert found[0] == found[1] == found[2]


def test_the_longest_run_of_a_search_must_not_have_too_many_steps():
    loop = {"mode": "sampled", "period": 0.5, "t_end": 60_010.0, "window": 1.0}
    scenario = from_tables({"loop": loop, "controller": {"t_f": 6e4, "delta": 1.0}})
    reach = reach_of(scenario, t_f=12e4)
    assert 120_020 <= timing.count_steps(study(scenario).parts) <= 120_025  # (6e4 + 10) / 0.5, and some at the ends
    with pytest.raises(ScenarioError) as caught:
        study(scenario, reach=reach)
    check_sentence(str(caught.value), "tune.bounds.t_f asks for runs of 120010 s", "take 240020 steps, 1 a period")


# replace
def test_replace_changes_only_the_given_keys():
    before = from_tables(tomllib.loads(EVERYTHING))
    kept = parsing.dump(before)
    after = parsing.dump(
        replace(before, controller__eta=5.0, observer__gain=[1.0, 2.0, 3.0], requirements={"effort": 7.0})
    )
    expected = copy.deepcopy(kept)
    expected["controller"]["eta"] = 5.0
    expected["observer"]["gain"] = [1.0, 2.0, 3.0]
    expected["requirements"] = {"effort": 7.0}
    assert after == expected
    assert parsing.dump(before) == kept


def test_replace_with_none_restores_a_default():
    scenario = replace(from_tables({}), controller__t_f=20.0, loop__t_end=None)
    assert scenario.loop.t_end == pytest.approx(20.0 * 4.0 / 3.0, rel=1e-12)
    turned: Any = replace(scenario, initial__quat_xyzw=None, initial__rotvec_deg=[0.0, 0.0, 90.0])
    assert turned.initial == reference_tables.Initial(rotvec_deg=(0.0, 0.0, 90.0))


@pytest.mark.parametrize(
    "whole", [{"controller__kind": "pd"}, {"controller": {"kind": "pd"}}], ids=["a kind", "a whole table"]
)
def test_replace_does_not_depend_on_the_order_of_changes(whole):
    sampled = from_tables({"loop": {"mode": "sampled"}})
    law: Any = replace(sampled, controller__k_p=0.5, **whole).controller
    assert (law.kind, law.k_p) == ("pd", 0.5)


@pytest.mark.parametrize(
    ("table", "given"),
    [
        ("reference", {"kind": "spin", "rate": [0.0, 0.0, 0.01]}),
        ("disturbance", {"kind": "random_walk", "density": [0.01] * 3}),
        ("observer", {"kind": "prescribed_time", "t_o": 1.0}),
        ("plant", {"kind": "chain", "order": 3}),
        ("requirements", {}),  # has no kinds
    ],
)
def test_restoring_the_default_kind_discards_the_keys_of_the_old_kind(table, given):
    sampled = {"loop": {"mode": "sampled"}}
    back = replace(from_tables({**sampled, table: given}), **{f"{table}__kind": None})
    assert back == from_tables(sampled)
    kept = replace(from_tables({"controller": {"kind": "prescribed_time", "t_f": 20.0}}), controller__kind=None)
    assert kept.controller.t_f == 20.0  # it was the default one


def test_replace_does_not_change_its_arguments():
    given = {"t_f": 20.0, "eta": 4.0}
    assert replace(from_tables({}), controller=given, controller__eta=None).controller.eta == 3.0
    assert given == {"t_f": 20.0, "eta": 4.0}


def test_replace_takes_a_table_of_another_scenario():
    drawn = {"attitude": {"kind": "axis_angle", "min_deg": 10.0, "max_deg": 20.0}}
    hardware = {"attitude_noise": "2 arcsec", "rate_noise": 1e-6}
    loop = {"mode": "sampled", "period": 0.1}
    other = from_tables({"dispersion": drawn, "hardware": hardware, "loop": loop})
    one = replace(from_tables({"loop": loop}), dispersion=other.dispersion, hardware=other.hardware)
    assert (one.dispersion, one.hardware) == (other.dispersion, other.hardware)


def test_replace_adds_a_table():
    tune = replace(from_tables({}), tune__steps=5).tune
    assert tune is not None
    assert (tune.steps, tune.trials) == (5, 256)


@pytest.mark.parametrize(
    ("changes", "of_what", "allowed"),
    [
        ({"controller__eta": 2.0}, "controller.eta is 2.0", "greater than 2"),
        ({"controller__delta": 40.0}, "controller.delta is 40.0", "less than controller.t_f, 30.0"),
        ({"controller__etta": 3.0}, "controller.etta is not a known key", "controller.eta"),
        ({"contrller__eta": 3.0}, "[contrller] is not a known table", "[controller]"),
        ({"controller__etta": None}, "controller.etta is not a known key", "controller.eta"),
        ({"contrller__eta": None}, "[contrller] is not a known table", "[controller]"),
        ({"controller__t_f": 45.0, "loop__t_end": 40.0}, "loop.t_end is 40.0", "at least controller.t_f + loop.window"),
        (
            {"initial__mrp": [0.0] * 3, "initial__quat_xyzw": [0.0, 0.0, 0.0, 1.0]},
            "initial has the attitude keys quat_xyzw and mrp",
            ONE_KEY,
        ),
        (
            {"hardware__rate_noise": 1e-6, "loop__mode": "continuous"},
            "hardware.rate_noise needs the sampled loop",
            'loop.mode is "continuous"',
        ),
        ({"controller": 5, "controller__eta": 3.0}, "controller is 5", "a table"),
        ({"controller": 5, "controller__eta": None}, "controller is 5", "a table"),
    ],
    ids=str,
)
def test_replace_validates_the_new_values(changes, of_what, allowed):
    with pytest.raises(ScenarioError) as caught:
        replace(from_tables({}), **changes)
    check_sentence(str(caught.value), of_what, allowed)


@pytest.mark.parametrize(
    ("changes", "plain_changes"),
    [
        ({"controller__eta": np.float64(4.0)}, {"controller__eta": 4.0}),
        ({"controller__eta": np.int64(4)}, {"controller__eta": 4.0}),
        ({"initial__rate": np.array([0.0, 0.0, 0.1])}, {"initial__rate": [0.0, 0.0, 0.1]}),
        ({"spacecraft__inertia": np.array([8.0, 9.0, 10.0])}, {"spacecraft__inertia": [8.0, 9.0, 10.0]}),
    ],
    ids=str,
)
def test_replace_takes_numpy_numbers_as_numbers(changes, plain_changes):
    scenario = from_tables({})
    assert parsing.dump(replace(scenario, **changes)) == parsing.dump(replace(scenario, **plain_changes))


# Round trip
def test_a_dumped_scenario_loads_to_the_same_scenario(tmp_path):
    """The scenarios have every key of every kind, and the first one has numbers that need all digits."""
    law = {"eta": 2.0 + 0.1 * 3.0**0.5, "delta": 1.0 / 3.0}
    every = [made for name, made in complete("spacecraft") if "code" not in str(made[name])]
    for tables in ({"controller": law, "initial": {"mrp": [1e-300, 0.1, 1 / 7]}}, *every):
        scenario = from_tables(tables)
        store.write_toml(tmp_path / "scenario.toml", parsing.dump(scenario))
        assert parsing.dump(read(tmp_path / "scenario.toml")) == parsing.dump(scenario)  # to the last bit


@pytest.mark.parametrize(
    ("text", "table", "keys"),
    [
        ("observer.kind = 'prescribed_time'", "observer", ("t_o", "delta_o")),
        (SAMPLED + "hardware = { attitude_noise = 2e-5, rate_noise = 1e-6 }\nfilter.kind = 'steady_state'",
         "filter", ("bandwidth",)),
    ],
)  # fmt: skip
def test_written_files_have_every_default_and_give_the_same_run(text, table, keys):
    """In memory a default t_o follows t_f. A t_o that was written to a file does not."""
    said = from_tables(tomllib.loads(text))
    written = parsing.dump(said)
    assert set(keys) <= written[table].keys()
    assert not set(keys) & parsing.stated_tables(said)[table].keys()
    again = from_tables(written)
    assert parsing.dump(again) == written
    ours, theirs = (jax.tree.leaves(study(one).parts) for one in (said, again))
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(one, other)
    moved = [parsing.dump(replace(one, controller__t_f=21.0))["observer"].get("t_o") for one in (said, again)]
    assert moved == ([7.0, 10.0] if table == "observer" else [None, None])
