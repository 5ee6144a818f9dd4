"""`ptsmc margins`: files, report and errors."""

import csv
import dataclasses
import json
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import explore, scenario
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.theory import limit_cycles, linear, margins, run_margins
from tests.helpers import SHORT, SHORT_CHAIN, refused, short, untuned
from tests.theory.loops import held
from tuning.output import margins_report, page, summaries
from tuning.studies import stability

# the flight clock, so that judging of tuned gains uses the same compiled program
CHAIN = SHORT_CHAIN.replace('mode = "sampled"', 'mode = "sampled"\nclock = "flight"')


def tables(path):
    """Return the rows of a CSV file as a list of dicts of texts."""
    with path.open() as file:
        return list(csv.DictReader(file))


SCENARIOS = {"body": (SHORT, list("xyz"), 6), "chain": (CHAIN, ["u1"], 2)}  # axes, number of measured signals


@pytest.mark.parametrize("plant", short(SCENARIOS, ["chain"]))
def test_margins_command_writes_table_figures_and_page(command, tmp_path, plant):
    """The margin of one axis is at least the margin of all axes together."""
    text, names, seen = SCENARIOS[plant]
    (tmp_path / "s.toml").write_text(text)
    status, out, _ = command("margins", "s.toml")
    folder = tmp_path / "out" / "margins-s"
    assert status == 0
    assert "gain up [dB]  gain down [dB]" in out
    assert out.startswith("The nominal loop is stable; smallest margins at one input in both phases: gain ")
    assert {p.name for p in (folder / "figures").iterdir()} == {"nichols.png", "sensitivity.png", "margins.png"}
    found = json.loads((folder / "summary.json").read_text())
    check_axes(tables(folder / "margins.csv"), found, names, seen)
    # the table has the margins of the headline
    rows = margins_report.margin_table(summaries.read(summaries.Margins, found)).rows
    at_inputs = [row for row in rows if row[0].removeprefix("worst ").startswith("input")]
    assert {row[1] for row in at_inputs} == {"hold", "approach"}
    assert min(float(row[5]) for row in at_inputs) == pytest.approx(found["worst"]["delay_margin"], rel=1e-2)
    # the gain margin of one axis is at least the margin of all axes together
    alone = min(one["gain_up"] for one in found["hold"].values())
    assert found["together"]["gain_up"] <= alone * (1 + 1e-6)
    if len(names) == 1:
        np.testing.assert_allclose(found["together"]["gain_up"], alone, rtol=1e-6)
    made = page.build(folder)
    assert "all inputs" in made
    for text in (out, made):  # CHAIN has dispersions, and required margins are judged with them
        assert "by the worst of 256 dispersed loops" in text
    (folder / "margins.csv").unlink()
    assert "margins.csv does not exist: " in refused(command, tmp_path, "report", folder)


def check_axes(rows, found, names, seen):
    """Check the values of each axis and of the worst axis in the table and the summary.

    rows: of the table. found: the summary. names: of the axes. seen: number of sensors in the summary.
    """
    hold = [row for row in rows if row["t"] == rows[-1]["t"]]
    assert [row["axis"] for row in hold] == names
    for row in hold:
        said = found["hold"][row["axis"]]
        for column, name in (("gain_up_dB", "gain_up"), ("phase_deg", "phase"), ("delay_s", "delay")):
            np.testing.assert_allclose(float(row[column]), said[name], rtol=1e-12)
    assert len(found["before"]) == len(rows) / len(names) - 1
    for one in found["before"]:  # worst axis
        axes = [row for row in rows if float(row["time_to_go"]) == one["time_to_go"]]
        assert len({row["peak_sensitivity_dB"] for row in axes}) == len(names)
        assert one["peak_sensitivity"] == max(float(row["peak_sensitivity_dB"]) for row in axes)
        assert one["phase"] == min(float(row["phase_deg"]) for row in axes)
        assert one["delay"] == min(float(row["delay_s"]) for row in axes)
        assert {row["judged"] for row in axes} == {str(int(one["judged"]))}
    assert all(row["judged"] == "1" for row in hold)
    judged = [one["phase"] for one in found["before"] if one["judged"]]
    in_hold = [one["phase"] for one in found["hold"].values()]
    np.testing.assert_allclose(found["worst"]["phase_margin"], min([*in_hold, *judged]))
    assert judged
    assert len(found["sensors"]) == seen
    assert all(
        {"gain_up", "phase", "peak_sensitivity"} <= set(one) and "delay" not in one for one in found["sensors"].values()
    )
    assert all(float(row["time_to_go"]) > 0.0 for row in rows if row not in hold)


def test_margin_table_has_every_axis_and_its_summary_has_the_worst_axis(tmp_path):
    """The margins are random numbers."""
    ready, rng = scenario.study(scenario.from_tables(untuned(SHORT))), np.random.default_rng(3)

    def left(*shape):
        each = margins.Margins(*rng.uniform(1.0, 9.0, (7, *shape)))
        return each._replace(stable=each.stable > 0.0)

    three = np.eye(6, k=3), np.eye(6)[:, 3:], -np.tile(np.eye(3), 2)
    loops = jax.tree.map(lambda v: np.stack([v] * 5), held(*three, 0.1))
    t, together = np.array([3.0, 3.5, 4.0, 4.5, 6.4]), dict.fromkeys(margins.FIELDS, 0.5)
    judged = np.array([False, True, False, True, True])
    course = run_margins.Course(t, judged, loops, left(5, 3), left(6), together, 1.0, not_converged=False)
    (tmp_path / "made").mkdir()
    stability.write(tmp_path / "made", ready, course, figures=False)
    found = json.loads((tmp_path / "made" / "summary.json").read_text())
    check_axes(tables(tmp_path / "made" / "margins.csv"), found, list("xyz"), 6)


ASKS = CHAIN.split("[requirements]")[0] + "[requirements]\ngain_margin = 1.0\nphase_margin = 89.0\n"


def test_simulate_checks_required_margins(command, tmp_path):
    (tmp_path / "asks.toml").write_text(ASKS)
    status, out, _ = command("simulate", "asks.toml", "--no-figures")
    assert status == 1
    assert "gain_margin at least 1 dB" in out
    assert "phase_margin at least 89 deg" in out
    gain, phase = json.loads((tmp_path / "out" / "simulate-asks" / "summary.json").read_text())["verdicts"]
    assert (gain["metric"], gain["met"], phase["metric"], phase["met"]) == ("gain_margin", True, "phase_margin", False)
    _, course = stability.find_margins(scenario.read(tmp_path / "asks.toml"))
    np.testing.assert_allclose(phase["worst"], course.worst()["phase_margin"], rtol=1e-9)


def test_run_with_a_limit_cycle_has_no_margins(command, tmp_path, monkeypatch):
    """`theory/test_limit_cycles.py` tests the detection of limit cycles.

    Required margins count as broken, also in `ptsmc simulate`.
    """
    (tmp_path / "asks.toml").write_text(ASKS)
    monkeypatch.setattr(limit_cycles, "find", lambda *_: limit_cycles.LimitCycle(0.04, 2.0))
    status, said, _ = command("margins", "asks.toml", "--no-figures")
    assert status == 1
    assert "the nominal run does NOT come to rest in the hold phase" in said
    found = json.loads((tmp_path / "out" / "margins-asks" / "summary.json").read_text())
    assert found["worst"]["gain_margin"] == found["worst"]["delay_margin"] == 0.0
    assert found["limit_cycle"] == {"size": 0.04, "periods": 2.0, "unit": "u"}
    assert not found["stable"]
    status, said, _ = command("simulate", "asks.toml", "--no-figures")
    assert status == 1
    assert "gain_margin" in said
    verdict, _ = json.loads((tmp_path / "out" / "simulate-asks" / "summary.json").read_text())["verdicts"]
    assert (verdict["met"], verdict["worst"]) == (False, 0.0)


def test_unstable_hold_phase_is_reported_with_negative_margins(command, tmp_path):
    (tmp_path / "wild.toml").write_text(CHAIN.replace("[controller]", "[controller]\nk1 = 60.0"))
    loaded = scenario.read(tmp_path / "wild.toml")
    assert loaded.controller.k1 * loaded.loop.period > 4.0  # stability limit without delay: K1 h / 2 = 2
    status, out, _ = command("margins", "wild.toml", "--no-figures")
    assert status == 1
    assert "NOT stable" in out
    found = json.loads((tmp_path / "out" / "margins-wild" / "summary.json").read_text())
    assert not found["stable"]
    assert found["worst"]["gain_margin"] < 0.0


def reported(summary):
    """Return the report of `ptsmc margins` for a summary, a dict."""
    return margins_report.build(summaries.read(summaries.Margins, summary))


def test_margins_need_the_sampled_loop(command, tmp_path):
    (tmp_path / "smooth.toml").write_text("[controller]\nt_f = 5.0\n")
    said = refused(command, tmp_path, "margins", "smooth.toml")
    assert 'margins need the sampled loop, but loop.mode is "continuous"' in said


def test_inputs_and_measured_signals_of_a_chain_have_names():
    loaded = scenario.from_tables({"plant": {"kind": "chain", "order": 3}, "loop": {"mode": "sampled"}})
    assert stability.signal_names(scenario.study(loaded)) == (["u1"], ["x1", "x2", "x3"])


def at_hand_over(period):
    """Return the study of a chain whose hand-over is half a period after t = 0, with a sample at this time."""
    tables = {**tomllib.loads(CHAIN), "controller": {"t_f": 5.0, "delta": 5.0 - 0.5 * period}, "tune": {}}
    tables["loop"] |= {"period": period, "clock": "anchored"}
    return scenario.study(scenario.from_tables(tables))


def test_diverged_nominal_run_has_nan_margins_in_maps_and_is_refused_by_margins(monkeypatch):
    """Earlier, one such pair ended a whole map, and `margins` reported an error of the law."""
    ready = at_hand_over(0.1)
    initial = jax.tree.map(lambda v: jnp.nan * v, ready.parts.initial)
    lost = dataclasses.replace(ready, parts=dataclasses.replace(ready.parts, initial=initial))
    for left, radius in run_margins.margins_at_ends(lost.parts).values():
        assert np.isnan([radius, *left.gain_up, *left.delay]).all()
    monkeypatch.setattr(stability, "study", lambda _: lost)
    with pytest.raises(
        ScenarioError, match="nominal run that reaches its end, but it ends diverged: the state, the torque"
    ):
        stability.find_margins(lost.scenario)


def test_nominal_run_near_the_singularity_is_refused(monkeypatch):
    """Earlier, `margins` reported a stable loop."""
    ready = at_hand_over(0.1)
    course = run_margins.margins_along_run(ready.parts)
    assert course.singularity_distance == 1.0  # a chain's law has no singularity
    stability.find_margins(ready.scenario)
    monkeypatch.setattr(run_margins, "margins_along_run", lambda _: course._replace(singularity_distance=0.9e-3))
    with pytest.raises(ScenarioError, match="but it ends singular: the law's singularity came nearer than 1e-3"):
        stability.find_margins(ready.scenario)


@pytest.mark.parametrize("period", short([0.1, 0.5], [0.1]))
def test_margins_at_a_hand_over_in_the_first_period_are_those_of_the_hold_phase(period):
    """No sample before the hand-over lasts a whole period."""
    parts = at_hand_over(period).parts
    ends = run_margins.margins_at_ends(parts)
    for one, other in zip(ends["hand_over"][0], ends["hold"][0], strict=True):
        np.testing.assert_array_equal(one, other)
    course = run_margins.margins_along_run(parts)
    assert course.t.size == 1
    assert course.worst()["phase_margin"] == course.hold[1].phase.min()
    assert np.isnan(course.at_sensors.delay).all()  # delay margins are defined at the command only


def test_radius_at_the_ends_ignores_states_that_the_controller_cannot_move():
    """An estimated bias stays at its value: earlier, its pole at 1 hid the stability limit in maps."""
    loop = jax.tree.map(np.asarray, run_margins.margins_along_run(at_hand_over(0.1).parts).hold[0])
    expected = run_margins.controlled_radius(loop)
    assert linear.spectral_radius(loop) == pytest.approx(1.0)
    assert expected == pytest.approx(np.exp(-0.1), rel=1e-3)  # surface rate 1 1/s, period 0.1 s

    def with_state(pole):
        a = np.pad(loop.a, (0, 1))
        a[-1, -1] = pole
        new, old = (np.pad(v, ((0, 0), (0, 1), (0, 0))) for v in (loop.new, loop.old))
        command, seen = np.pad(loop.command, ((0, 0), (0, 1))), np.pad(loop.seen, ((0, 1), (0, 0)))
        return dataclasses.replace(loop, a=a, new=new, old=old, command=command, seen=seen)

    for pole, radius in ((1.0, expected), (0.9999, expected), (1.01, 1.01)):
        assert run_margins.controlled_radius(with_state(pole)) == pytest.approx(radius, rel=1e-9)


LIMITED = {
    "plant": {"kind": "chain", "x0": [1.0, 0.0]}, "disturbance": {"kind": "none"},
    "controller": {"t_f": 3.0, "delta": 1.0, "sign_width": 0.1},
    "loop": {"mode": "sampled", "period": 0.1, "window": 1.0},
    "hardware": {"torque_limit": 0.02, "state_noise": [2e-5, 1e-5]},  # noise: as many loop states as in `CHAIN`
}  # fmt: skip


def with_torque_limit(limit):
    """Return the scenario `LIMITED` with another torque limit."""
    return scenario.from_tables(LIMITED | {"hardware": LIMITED["hardware"] | {"torque_limit": limit}})


def test_saturated_command_is_reported_as_an_open_loop():
    """The loop transfer L is zero, so that the margins are infinite, whatever the gains are.

    With a larger torque limit, no loop is open. The loop is reported as open also if another axis makes it unstable.
    """
    ready, course = stability.find_margins(scenario.from_tables(LIMITED))
    found = stability.summary(ready, course)
    cut = [one for one in found["before"] if one["open"]]
    assert cut
    assert all((one["open"], one["gain_up"], one["delay"]) == (["u1"], None, None) for one in cut)
    report = reported(found)
    held, before = (line for line in report.lines if "limit of the actuators" in line)
    assert held.startswith("the loop is open at input u1 in the hold phase: a limit of the actuators cuts")
    assert before.startswith("the loop is open at input u1 in the approach phase, at ")
    assert not any("judged" in line for line in report.lines)
    assert found["not_converged"]  # with this limit, the state 1 decreases to 0.91 in 3 s at best
    assert any(line.startswith("the nominal run has not converged at t_f") for line in report.lines)
    assert report.headline == "The nominal loop is open in the hold phase"
    found = stability.summary(*stability.find_margins(with_torque_limit(50.0)))
    assert not any(one["open"] for one in (found, *found["before"]))
    assert "not_converged" not in found
    lines = reported(found).lines
    assert not any(word in line for line in lines for word in ("dispersed", "misses", "limit of the actuators"))
    (judged,) = [one["time_to_go"] for one in found["before"] if one["judged"]]
    assert f"at {judged:.3g} s to go; " in lines[0]
    # margins at all inputs together and at the sensors may be smaller; the table has them
    assert lines[1].startswith("margins at all inputs together and at the sensors are not judged")
    # margins of an axis if another axis makes the loop unstable
    least = np.full_like(course.at_input.peak_sensitivity, -100.0)
    lost = {"gain_up": least, "gain_down": least, "peak_sensitivity": np.copysign(0.0, least), "stable": least > 0.0}
    found = stability.summary(ready, course._replace(at_input=course.at_input._replace(**lost)))
    assert found["open"] == ["u1"]
    assert str(found["hold"]["u1"]["peak_sensitivity"]) == "0.0"  # not -0.0


def test_simulate_does_not_meet_a_required_margin_of_an_open_loop_or_a_failed_run():
    """Earlier, the margins of an open loop counted as unlimited, and those of a failed run as the linearised ones."""
    disturbance = {"amplitude": [1e300], "frequency": [1.0]}  # the linearised loop has no disturbance
    opened = with_torque_limit(0.02), {}, "not_converged", "the loop is open in the hold phase"
    failing = with_torque_limit(50.0), {"disturbance": disturbance}, "diverged", "the run failed"
    for base, changes, status, reason in (opened, failing):
        run = explore.simulate(scenario.replace(base, requirements={"gain_margin": 0.1}, **changes)).run
        (verdict,) = run.verdicts
        assert (run.status, verdict.met) == (status, False)
        assert str(verdict).startswith(f"gain_margin at least 0.1 dB: no value, as {reason}: NOT met")


def check_report_of_open_loop(found, first, limited):
    """Check the report of a sample that the law ignores.

    found: the summary. first: its entry of the sample. limited: whether the command saturates at other samples.
    """
    assert (first["open"], first["cut"]) == (["u1"], [])
    assert any(loop["cut"] for loop in (found, *found["before"])) == limited
    lines, left = reported(found).lines, f"{first['time_to_go']:.3g} s to go"
    place = f"at input u1 in the approach phase, at {left}: the controller does not react to the state"
    assert sum(place in line for line in lines) == 1
    assert any("limit of the actuators" in line for line in lines) == limited


@pytest.mark.parametrize("limit", [50.0, 0.5])
def test_sample_that_the_law_ignores_is_not_reported_as_saturation(limit):
    """Earlier, `margins` reported saturation."""
    ready, course = stability.find_margins(with_torque_limit(limit))
    k = np.flatnonzero(course.loops.new[:-1, 0].any(axis=(1, 2)))[0]  # a sample without saturation
    nothing = {"gain_up": np.inf, "gain_down": np.inf, "phase": 180.0, "peak_sensitivity": 0.0, "crossover": np.nan}
    each = {name: getattr(course.at_input, name).copy() for name in nothing}
    for name, value in nothing.items():
        each[name][k] = value
    found = stability.summary(ready, course._replace(at_input=course.at_input._replace(**each)))
    check_report_of_open_loop(found, found["before"][k], limit < 1.0)
