"""`ptsmc map`: axes, cells and stability limits."""

import csv
import json
import re
import tomllib
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.campaigns import montecarlo
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.simulation import rollout
from ptsmc_jax.simulation.catalogues import CATALOGUE
from ptsmc_jax.simulation.metrics import Metrics
from ptsmc_jax.theory import covariance, linear, margins, run_margins
from tests.helpers import ROOT, refused, tree
from tests.output.pages import checked
from tuning.errors import UsageError
from tuning.studies import mapping

SHORT = """
loop = { mode = "sampled", period = 0.1, t_end = 7.0, clock = "flight" }
controller = { t_f = 5.0, delta = 0.5 }
hardware = { attitude_noise = 2e-5, rate_noise = 1e-6 }
dispersion.attitude = { kind = "axis_angle", min_deg = 20.0, max_deg = 60.0 }
"""
CHAIN = """
plant = { kind = "chain", x0 = [1.0, 0.0] }
observer = { kind = "nonlinear", gain = [10.0] }
loop = { mode = "sampled", period = 0.1, t_end = 7.0, clock = "flight" }
controller = { t_f = 5.0, delta = 0.5 }
hardware.state_noise = [2e-5, 1e-6]
dispersion.x0 = { kind = "uniform", half_width = [0.5, 0.1] }
"""


@pytest.fixture(autouse=True, scope="module")
def few_together():
    """Compile the margin programs for few loops: a cell has only two, at the hand-over and in the hold phase."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(linear, "PERIODS_PER_CALL", 4)
        yield


def parse_map(x, y, text=SHORT):
    """Return the scenario and the two axes of a map; x, y: texts of the options, text: of the scenario."""
    loaded = scenario.from_tables(tomllib.loads(text))
    return loaded, mapping.parse_axis(x, "--x", loaded), mapping.parse_axis(y, "--y", loaded)


def simulated(x, y, text=SHORT, trials=6):
    """Simulate a map with few trials in each cell; return its scenario, its two axes and its cells.

    x, y: texts of the options. text: of the scenario.
    """
    loaded, across, up = parse_map(x, y, text)
    return loaded, across, up, mapping.simulate(loaded, across, up, 3, trials, lambda done, total: None).cells


@pytest.mark.parametrize(
    ("controller", "period", "ends"),
    [
        ({"t_f": 35.0, "delta": 0.5}, 0.05, [(0.02, 0.5), (0.05, 5.0)]),
        ({"t_f": 3500.0, "delta": 50.0}, 5.0, [(2.0, 50.0), (5.0, 500.0)]),
        ({"t_f": 35.0, "delta": 4.0}, 0.05, [(0.02, 0.5), (0.05, 8.0)]),  # up to twice the scenario's delta
    ],
)
def test_the_default_axes_of_a_map_follow_the_period_and_t_f_of_the_scenario(controller, period, ends):
    made = scenario.from_tables({"controller": controller, "loop": {"mode": "sampled", "period": period}})
    axes = (
        mapping.parse_axis(mapping.default_period_axis(made), "--x", made),
        mapping.parse_axis(mapping.default_gain_axis(made), "--y", made),
    )
    assert [axis.key for axis in axes] == ["loop.period", "controller.delta"]
    assert [(axis.values[0], axis.values[-1]) for axis in axes] == ends
    assert [len(axis.values) for axis in axes] == [9, 9]


def test_the_default_y_axis_of_a_map_is_the_first_gain_of_a_law_without_delta():
    law = {"kind": "time_base_sliding", "t_f": 35.0}
    made = scenario.from_tables({"controller": law, "loop": {"mode": "sampled"}, "observer": {"kind": "none"}})
    axis = mapping.parse_axis(mapping.default_gain_axis(made), "--y", made)
    assert axis.key == "controller.surface_rate"
    bounds = scenario.replace(made, tune={}).search.bounds["surface_rate"]
    np.testing.assert_allclose((axis.values[0], axis.values[-1]), bounds, rtol=1e-3)


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("loop.period=0.1:0.4:3", [0.1, 0.25, 0.4]),
        ("controller.delta=0.05:5:3", [0.05, 0.5, 5.0]),
        ("controller.delta=1:2:2", [1.0, 2.0]),
        ("hardware.delay=0:2:5", [0.0, 1.0, 2.0]),
        ("hardware.delay=1:6:5", [1.0, 2.0, 4.0, 6.0]),
        ("hardware.delay=0.6:8.4:9", [1.0, 2.0, 3.0, 4.0, 6.0, 8.0]),
        ("controller.delta=0.05:5:9", np.geomspace(0.05, 5.0, 9)),
        ("loop.t_end=100:100.001:5", [100.0, 100.001]),
        ("loop.period=100ms:0.4 s:3", [0.1, 0.25, 0.4]),
        ("hardware.attitude_noise=10arcsec:20arcsec:2", np.deg2rad([10 / 3600, 20 / 3600])),
        ("observer.gain[0]=20mNms:40mNms:2", [0.02, 0.04]),
        ("requirements.peak_torque=1:2:2", [1.0, 2.0]),
    ],
)
def test_an_axis_of_a_map_has_the_values_of_its_text(text, values):
    """The text that results store gives the same values again. An earlier text gave other delays."""
    made = scenario.from_tables({})
    axis = mapping.parse_axis(text, "--x", made)
    assert mapping.parse_axis(axis.text, "--x", made).values == axis.values
    np.testing.assert_allclose(axis.values, values, rtol=5e-6)  # six digits


def test_labels_of_map_axes_have_the_units_of_their_keys():
    """The label of a key without a unit is the key, and so is the label of a gain of a custom class."""
    loaded = scenario.from_tables(tomllib.loads(SHORT))
    shown = {"controller.delta": "[s]", "observer.gain[0]": "[N m s]", "hardware.rate_noise": "[rad/s]"}
    for key, unit in shown.items():
        assert mapping.label_with_unit(loaded, key) == f"{key} {unit}"
    assert mapping.label_with_unit(loaded, "controller.eta") == "controller.eta"
    assert (
        mapping.label_with_unit(scenario.from_tables({}), "hardware.delay") == "hardware.delay"
    )  # no table [hardware]
    suite = [{"kind": "star_tracker", "noise_across": 1e-5, "noise_about": 1e-4}, {"kind": "gyro", "rate_noise": 1e-5}]
    with_suite = scenario.from_tables({"loop": {"mode": "sampled"}, "sensors": suite})
    assert mapping.label_with_unit(with_suite, "sensors.rate_noise") == "sensors.rate_noise"
    custom = scenario.read(ROOT / "scenarios" / "own_parts.toml")
    assert mapping.label_with_unit(custom, "controller.t_f") == "controller.t_f [s]"
    assert mapping.label_with_unit(custom, "controller.k1") == "controller.k1"  # a custom class states no unit


@pytest.mark.parametrize(
    "text", ["", "delta=1:2:3", "controller.delta", "controller.delta=1:2", "controller.delta=2:1:3", "a.b=1:2:1",
             "a.b=1:nan:3", "a.b=x:2:3", "a.b=1:2:101", "a.b.c=1:2:3",
             "a.b[x]=1:2:3", "a.b[-1]=1:2:3", "a.b[0=1:2:3",
             "hardware.delay=0:0.4:2", "hardware.star_tracker_every=0.6:1.4:9", "a.b=1:1.0000001:5"]
)  # fmt: skip
def test_invalid_axes_of_a_map_are_refused(text):
    with pytest.raises(UsageError, match=r"--y is .*KEY=LOW:HIGH:COUNT"):
        mapping.parse_axis(text, "--y", scenario.from_tables({}))


@pytest.mark.parametrize("key", ["sensors[0].noise_across", "dispersion.inertia.std", "flexible.coupling[0][0]"])
def test_keys_that_a_map_cannot_vary_are_refused_with_the_possible_form(key):
    with pytest.raises(UsageError, match=r"KEY must be TABLE\.KEY or TABLE\.KEY\[0\]"):
        mapping.parse_axis(f"{key}=1:2:3", "--x", scenario.from_tables({}))


def test_error_for_an_invalid_range_of_a_map_names_the_unit_of_its_key():
    with pytest.raises(UsageError, match='in s or with a unit such as "200 ms"'):
        mapping.parse_axis("loop.period=1m:2m:3", "--x", scenario.from_tables({}))


@pytest.mark.parametrize(("plant", "key", "nearest"), [
    ("spacecraft", "torque_limit", "the nearest known keys are hardware.torque_limit, wheels.torque_limit"),
    ("chain", "etta", "the nearest known key is controller.eta"),
])  # fmt: skip
def test_error_for_a_key_of_a_map_without_its_table_names_the_nearest_keys(plant, key, nearest):
    with pytest.raises(UsageError, match=re.escape(nearest)):
        mapping.parse_axis(f"{key}=1:2:3", "--x", scenario.from_tables({"plant": {"kind": plant}}))


@pytest.fixture(scope="module")
def mapped():
    """Return scenario, axes and cells of the map of a chain with two periods and two values of delta."""
    return simulated("loop.period=0.05:0.2:2", "controller.delta=0.1:0.5:2", CHAIN)


def test_cells_of_a_map_agree_with_separate_simulations_of_their_pair(mapped, monkeypatch):
    """The linear error, torque and margins of a cell agree too. A delta shorter than one period is refused."""
    loaded, x, y, cells = mapped
    assert [(c.x, c.y) for c in cells] == [(a, b) for b in y.values for a in x.values]
    refused = [c for c in cells if c.status != "simulated"]
    assert [(c.x, c.y) for c in refused] == [(0.2, 0.1)]  # delta is shorter than one period
    assert all("at least one control period" in c.status for c in refused)
    for cell in cells:
        if (cell.x, cell.y) == (0.2, 0.5):  # only one pair, because each compiles another program
            alone = scenario.study(scenario.replace(loaded, loop__period=cell.x, controller__delta=cell.y))
            trials = montecarlo.run(alone.parts, alone.dispersion, 3, np.arange(6))
            np.testing.assert_allclose(cell.window_error, np.sqrt(np.mean(trials.metrics.window_error**2)), rtol=1e-9)
            np.testing.assert_allclose(cell.largest_peak_torque, trials.metrics.peak_torque.max(), rtol=1e-9)
            noise = covariance.propagate_noise(alone.parts)
            np.testing.assert_allclose(cell.linear_window_error, noise.window_error, rtol=1e-9)
            np.testing.assert_allclose(cell.linear_torque, noise.torque, rtol=1e-9)
            at, seen = run_margins.margins_at, []
            monkeypatch.setattr(
                run_margins, "margins_at", lambda *asked, at=at, seen=seen: seen.append(at(*asked)) or seen[0]
            )
            ends = run_margins.margins_at_ends(alone.parts)
            for name, hold in (("hand_over", False), ("hold", True)):
                np.testing.assert_array_equal(ends[name][0].phase, seen[0].margins.phase[seen[0].hold == hold][0])
            for name, (left, radius) in zip(("", "hold_"), ends.values(), strict=True):
                np.testing.assert_allclose(getattr(cell, f"{name}radius"), radius, rtol=1e-9)
                np.testing.assert_allclose(getattr(cell, f"{name}delay_margin"), left.delay.min(), rtol=1e-6)
                gain_margin = min(left.gain_up.min(), left.gain_down.min())  # [dB]
                np.testing.assert_allclose(getattr(cell, f"{name}gain_margin"), gain_margin, rtol=1e-6)
        if cell.status == "simulated":
            assert (cell.trials, cell.failures) == (6, 0)
            assert np.isfinite(cell.linear_window_error) == (cell.radius < 1.0)
    assert any(cell.radius < 1.0 for cell in cells)


def test_a_map_reports_which_pairs_keep_every_requirement(monkeypatch):
    """Earlier, the best pair of a map was the most accurate one, whatever its torque."""
    text = (
        CHAIN
        + "requirements = { peak_torque = { limit = 2.0, quantile = 0.5, confidence = 0.9 }, gain_margin = 3.0 }\n"
    )
    asked = []

    def record_and_judge(parts, required, *, finished):
        """Record the call, and return the verdict on a margin of 9 dB."""
        asked.append(([one.metric for one in required], finished))
        return [required[0].verdict(np.asarray(9.0), np.asarray(finished))]

    def run(parts, *_):
        peaks = np.asarray([0.0, 0.0, 0.0, 9.0]) if parts.controller.eta < 3.5 else np.asarray([0.0, 9.0, 9.0, 9.0])
        metrics = Metrics(dict.fromkeys(CATALOGUE, np.zeros(4)) | {"peak_torque": peaks})
        return montecarlo.Trials(np.arange(4), metrics, np.full(4, rollout.OK), np.full(4, np.nan), {})

    monkeypatch.setattr(mapping.margin_verdicts, "judge_loop", record_and_judge)
    monkeypatch.setattr(montecarlo, "run", run)
    _, _, _, cells = simulated("controller.eta=3:4:2", "controller.delta=0.4:0.5:2", text, trials=4)
    assert [cell.meets for cell in cells] == [1, 0, 1, 0]
    assert [cell.not_met for cell in cells] == ["", "peak_torque", "", "peak_torque"]
    assert asked == [(["gain_margin"], True)] * 4


@pytest.fixture
def not_simulated(monkeypatch):
    """Replace the simulation, which takes longest to compile, for tests that do not use trials."""
    zeros = Metrics(dict.fromkeys(CATALOGUE, np.zeros(1)))
    trials = montecarlo.Trials(np.arange(1), zeros, np.full(1, rollout.OK), np.full(1, np.nan), {})
    monkeypatch.setattr(montecarlo, "run", lambda *_: trials)


@pytest.mark.usefixtures("not_simulated")
def test_margins_of_a_pd_law_in_a_map_agree_with_the_closed_form():
    """The loop is a PD law, a zero-order hold and a double integrator. Earlier, maps had margins of one law only."""
    text = CHAIN.replace("t_f = 5.0, delta = 0.5", 'kind = "pd", t_f = 5.0')
    text = text.replace('{ kind = "nonlinear", gain = [10.0] }', '{ kind = "none" }')
    _, _, _, cells = simulated("controller.k_p=1:2:2", "controller.k_d=2:3:2", text, trials=1)
    h = 0.1
    for cell in cells:
        moved, pushed = np.array([[1.0, h], [0.0, 1.0]]), np.array([[h * h / 2.0], [h]])

        def radius(factor, cell=cell, moved=moved, pushed=pushed):
            return np.abs(np.linalg.eigvals(moved - factor * pushed @ np.array([[cell.x, cell.y]]))).max()

        assert cell.hold_radius == pytest.approx(radius(1.0), rel=1e-9)
        factor = 10.0 ** (cell.hold_gain_margin / 20.0)
        assert radius(0.999 * factor) < 1.0 < radius(1.001 * factor)
        assert 0.0 < cell.hold_delay_margin < 10.0
        assert np.isnan(cell.linear_window_error)  # the prediction is validated for the prescribed-time law only


def test_gain_factor_below_one_gives_the_distance_to_the_nearest_stability_limit():
    """The input gain of the plant is 0.001 times the design model, so that the loop needs a larger gain."""
    parts = scenario.study(scenario.from_tables(tomllib.loads(CHAIN))).parts
    loops = run_margins.margins_at(parts, jnp.asarray([1.0]), linear.simulate_nominal_jit(parts)).loops
    weak = replace(loops, new=1e-3 * loops.new, old=1e-3 * loops.old)
    factor = float(10.0 ** (margins.compute_each(weak).gain_up[-1, 0] / 20.0))
    weak = jax.tree.map(lambda v: v[-1], weak)
    assert factor < 1.0 < linear.spectral_radius(weak, factor)
    assert linear.spectral_radius(weak, 0.999 / factor) > 1.0 > linear.spectral_radius(weak, 1.001 / factor)


@pytest.mark.parametrize(
    ("inertia", "key", "refused"),
    [
        ([10.0, 12.0, 14.0], "spacecraft.inertia", "but a map changes only one; allowed are spacecraft.inertia[0], sp"),
        ([[10.0, 0, 0], [0, 12.0, 0], [0, 0, 14.0]], "spacecraft.inertia", "such as three principal moments"),
        ([[10.0, 0, 0], [0, 12.0, 0], [0, 0, 14.0]], "spacecraft.inertia[0]", "such as three principal moments"),
    ],
)
def test_a_map_does_not_replace_an_inertia_by_one_number(inertia, key, refused):
    loaded = scenario.from_tables({"spacecraft": {"inertia": inertia}})
    with pytest.raises(ScenarioError, match=re.escape(refused)):
        mapping.simulate(
            loaded, mapping.parse_axis(f"{key}=9:11:2", "--x", loaded),
            mapping.parse_axis("controller.eta=3:4:2", "--y", loaded), 0, 1, lambda done, total: None,
        )  # fmt: skip


def test_a_map_sets_a_value_on_all_axes_and_in_keys_that_the_scenario_omits():
    loaded, _, _ = parse_map("hardware.torque_lag=0.01:0.1:2", "controller.delta=1:2:2")
    changed: Any = mapping._with_keys(loaded, {"observer.gain": 7.0, "hardware.torque_lag": 0.2, "hardware.delay": 1.0})
    assert changed.observer.gain == (7.0, 7.0, 7.0)
    assert (changed.hardware.torque_lag, changed.hardware.delay) == (0.2, 1)
    changed: Any = mapping._with_keys(loaded, {"spacecraft.inertia[1]": 13.0})
    assert changed.spacecraft.inertia == (10.0, 13.0, 14.0)


def test_map_without_a_valid_pair_is_refused():
    with pytest.raises(ScenarioError, match=r"controller.eta is 1.0"):
        simulated("controller.eta=1:2:2", "controller.delta=0.2:0.3:2")


def test_time_after_t_f_is_constant_if_t_f_is_mapped():
    loaded, x, y = parse_map("controller.t_f=4:12:2", "loop.window=0.5:3:2")
    ends = [mapping._with_keys(loaded, {x.key: a, y.key: b}).loop.t_end for a in x.values for b in y.values]
    assert ends == [6.0, 7.0, 14.0, 15.0]  # 2 s after t_f, or the window if it is longer


def test_trials_of_a_map_are_random_with_a_random_walk_disturbance():
    text = 'loop = { mode = "sampled", period = 0.1 }\ncontroller = { t_f = 5.0, delta = 0.5 }\n'
    still, walking = (parse_map("controller.eta=3:4:2", "controller.delta=0.5:0.6:2", text + kind)[0]
                      for kind in ("", "disturbance.kind = 'random_walk'"))  # fmt: skip
    assert [scenario.study(one).drawn for one in (still, walking)] == [False, True]


def test_period_axis_needs_the_sampled_loop():
    with pytest.raises(ScenarioError, match=r"loop\.period needs the sampled loop"):
        simulated("loop.period=0.1:0.2:2", "controller.delta=0.2:0.3:2", "controller.t_f = 5.0")


def test_stability_limits_are_drawn_over_period_and_delta_only():
    """The formula is drawn only for plants of order 2 without a lag and without a filter."""
    loaded, x, y = parse_map("controller.delta=0.2:0.9:2", "loop.period=0.05:0.1:2")
    for clock, factor, label in (("anchored", 1.5, "3/2"), ("flight", 2.5, "1/2")):
        lines = mapping.stability_limit_formulas(scenario.replace(loaded, loop__clock=clock), x, y)
        delta, period = lines[f"stability limit $\\delta = (\\eta - {label}) h$"]
        np.testing.assert_allclose(delta, factor * np.asarray(period))
    lines = mapping.stability_limit_formulas(
        scenario.replace(loaded, controller__sampling="implicit"), x, y
    )  # the limit of explicit sampling for comparison
    np.testing.assert_allclose(
        lines["stability limit $\\delta = (\\eta - 1/2) h$, of explicit sampling only"][0], 2.5 * np.asarray(y.values)
    )
    delta, period = lines["stability limit with a period of delay"]
    assert np.all(delta < mapping.stability_limit_formulas(loaded, x, y)["stability limit with a period of delay"][0])
    assert not mapping.stability_limit_formulas(loaded, x, mapping.parse_axis("controller.eta=3:4:2", "--y", loaded))
    third = scenario.from_tables({"plant": {"kind": "chain", "order": 3}, "loop": {"mode": "sampled"}})
    assert not mapping.stability_limit_formulas(third, x, y)  # the formula is for plants of order 2
    # earlier, the formula was drawn for a loop with a lag or a filter, which it ignores
    for device in ({"torque_lag": 0.1}, {"command_filter": {"kind": "first_order", "corner": 5.0}}):
        lagging = {f"hardware__{name}": value for name, value in device.items()}
        assert not mapping.stability_limit_formulas(scenario.replace(loaded, **lagging), x, y)
    assert not mapping.stability_limit_formulas(scenario.replace(loaded, filter={"kind": "steady_state"}), x, y)


def test_map_command_writes_its_result_folder(command, mapped, tmp_path):
    """Output, CSV file and page agree with the cells. Invalid axes and numbers of trials are refused."""
    loaded, _, _, cells = mapped
    (tmp_path / "c.toml").write_text(CHAIN)
    asked = ("map", "c.toml", "--x", "loop.period=0.05:0.2:2", "--y", "controller.delta=0.1:0.5:2")
    status, out, _ = command(*asked, "--trials", 6, "--seed", 3)
    assert status == 0
    assert "3 of 4 pairs simulated" in out
    assert "1 of 4 pairs are not allowed, the first one because controller.delta is 0.1, but must be at least" in out
    folder = tmp_path / "out" / "map-c"
    assert set(tree(folder)) == {"map.csv", "scenario.toml", "versions.json", "figures/map.png"}
    with (folder / "map.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [float(row["loop.period [s]"]) for row in rows] == [c.x for c in cells]
    assert [row["status"] for row in rows] == [c.status for c in cells]
    for name in ("window_error", "linear_window_error", "hold_delay_margin"):
        values = [float(row[name] or "nan") for row in rows]
        np.testing.assert_array_equal(values, [getattr(c, name) for c in cells], name)
    assert rows[1]["window_error"] == ""  # refused
    assert (folder / "figures" / "map.png").stat().st_size > 10_000
    assert json.loads((folder / "versions.json").read_text())["command"] == "map"
    assert scenario.read(folder / "scenario.toml") == loaded
    read = checked(folder)
    assert f"ptsmc {' '.join(asked)} --trials 6 --seed 3" in read.text
    assert "linear_torque [u]" in read.text
    assert "hold_gain_margin [dB]" in read.text
    first = out.splitlines()[0]
    assert first.startswith("the smallest RMS error is ")
    assert read.text.index(first[1:]) < read.text.index("Pairs")
    for bad in (("--x", "loop.period"), ("--trials", "0"), ("--x", "controller.delta=0.1:0.5:2"),
                ("--x", "loop.perod=0.05:0.1:2")):  # fmt: skip
        assert refused(command, tmp_path, *asked, "--out", "bad", *bad).startswith("ptsmc: ")


FLEXIBLE = """
loop = { mode = "sampled", period = 0.2, t_end = 9.0, clock = "flight" }
controller = { t_f = 6.0, delta = 2.0, disturbance_bound = 0.0, k1 = 2.0, error = "multiplicative" }
observer.kind = "none"
disturbance.kind = "none"
hardware.delay = 1
initial.rotvec_deg = [10.0, 0.0, 0.0]
flexible = { frequency = [3.0, 9.0], damping = [0.002, 0.02], coupling = [[1.0, 0.0, 0.0], [0.0, 0.1, 0.0]] }
"""


MODES = ("flexible.frequency[0]=2.0:8.0:3", "controller.delta=1.0:2.0:2", FLEXIBLE, 1)


@pytest.mark.usefixtures("not_simulated")
def test_stability_limit_contour_separates_stable_and_unstable_pairs(monkeypatch):
    """The logarithm of the poles is linear in frequency and delta, so that the stability limit is a straight line.

    A sentence reports that all pairs or no pairs are stable. A map can change one number of a list.
    """

    def at_ends(parts):
        law, frequency = parts.controller, np.asarray(parts.plant.frequency)
        assert frequency[1] == 9.0
        none = margins.Margins(*(jnp.zeros(3) for _ in margins.Margins._fields))
        in_hold = np.exp((frequency[0] - 6.0 + 1.6 * (law.delta - 1.5)) / 10.0)
        return {"hand_over": (none, 1.1), "hold": (none, float(in_hold))}

    monkeypatch.setattr(mapping.run_margins, "margins_at_ends", at_ends)
    loaded, x, y, cells = simulated(*MODES)
    # all pairs are unstable at the hand-over, so that the only limit is in the hold phase
    ((label, (across, up)),) = mapping.stability_limit_contours(mapping.Map(loaded, x, y, cells)).items()
    assert label == "stability limit in the hold phase, linear theory"
    assert mapping.describe_equal_stability(mapping.Map(loaded, x, y, cells)).startswith("no simulated pair is stable")
    stable = [replace(cell, radius=1.0, hold_radius=0.9) for cell in cells]
    assert mapping.describe_equal_stability(mapping.Map(loaded, x, y, stable)).startswith("all simulated pairs are st")
    assert not mapping.describe_equal_stability(mapping.Map(loaded, x, y, [*stable[1:], cells[0]]))
    drawn = np.isfinite(across)
    np.testing.assert_allclose(across[drawn], 6.0 - 1.6 * (up[drawn] - 1.5), atol=1e-4)
    assert (up[drawn].min(), up[drawn].max()) == (1.0, 2.0)
    changed: Any = mapping._with_keys(loaded, {"flexible.frequency[0]": 5.0})
    assert changed.flexible is not None
    assert changed.flexible.frequency == (5.0, 9.0)
    with pytest.raises(ScenarioError, match=r"flexible.frequency\[2\] does not exist: flexible.frequency is"):
        mapping._with_keys(loaded, {"flexible.frequency[2]": 5.0})
    with pytest.raises(ScenarioError, match=r"controller.eta\[0\] does not exist: controller.eta is 3.0"):
        mapping._with_keys(loaded, {"controller.eta[0]": 5.0})
    with pytest.raises(ScenarioError, match=r"hardware.gyro_scale\[0\] does not exist: hardware.gyro_scale is absent"):
        mapping._with_keys(loaded, {"hardware.gyro_scale[0]": 5.0})
    with pytest.raises(ScenarioError, match=r"flexible.coupling has rows of numbers, but a map changes only a number"):
        mapping._with_keys(loaded, {"flexible.coupling": 5.0})
