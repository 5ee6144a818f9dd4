import inspect
import re
import tomllib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
import pytest
from scipy.spatial.transform import Rotation

import ptsmc_jax
import tuning
import tuning.explore
from ptsmc_jax import explore, scenario
from ptsmc_jax.campaigns import campaign, runs, store
from ptsmc_jax.figures import animation
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.simulation import catalogues
from tests.helpers import SHORT, SHORT_CHAIN, small_search, untuned
from tuning.output.report import Chart, Report, Section, Table, Text

TABLES, CHAIN = untuned(SHORT), untuned(SHORT_CHAIN)


@pytest.fixture(scope="module")
def flight():
    """Return the result of `ptsmc_jax.simulate` of trial 7 of a short spacecraft scenario."""
    return ptsmc_jax.simulate(scenario.from_tables(TABLES), seed=3, trial=7)


def test_simulate_returns_metrics_verdicts_and_history_of_a_trial(flight):
    """They equal those of `runs.simulate`."""
    run = runs.simulate(scenario.study(flight.scenario), 3, 7)
    assert list(flight.metrics) == list(run.metrics)
    np.testing.assert_array_equal(list(flight.metrics.values()), list(run.metrics.values()))
    assert flight.status == run.status == "ok"
    assert [str(v) for v in flight.verdicts] == [str(v) for v in run.verdicts]
    frame = flight.to_polars()
    assert frame.columns[:8] == ["t", *(f"q{k}" for k in range(1, 5)), *(f"w{k}" for k in range(1, 4))]
    np.testing.assert_array_equal(frame["u2"], run.log.u[:, 1])
    error = np.sqrt(sum(frame[f"error{k}"].to_numpy() ** 2 for k in (1, 2, 3)))
    assert flight.metrics["hold_error"] == pytest.approx(error[frame["t"].to_numpy() >= 5.0].max(), rel=0.05)


def test_simulate_reads_a_file_and_raises_the_errors_of_the_command(tmp_path):
    (tmp_path / "s.toml").write_text(SHORT)
    assert ptsmc_jax.simulate(tmp_path / "s.toml").status == "ok"
    with pytest.raises(ScenarioError, match="does not exist"):
        ptsmc_jax.simulate(tmp_path / "none.toml")
    with pytest.raises(ScenarioError, match=r"controller\.eta is 1\.5, but must be a number greater than 2") as caught:
        ptsmc_jax.replace(scenario.from_tables(TABLES), controller__eta=1.5)
    # IPython shows this instead of a traceback
    assert caught.value._render_traceback_() == [f"ScenarioError: {caught.value}"]


def test_a_scenario_with_other_gains_can_be_written_and_read(flight, tmp_path):
    """An existing file is refused without `force`. Gains that are not allowed are refused in one sentence."""
    gains = {**ptsmc_jax.gains_of(scenario.study(flight.scenario).parts), "eta": 3.5, "delta": np.float64(0.4)}
    other = ptsmc_jax.in_scenario(flight.scenario, gains)
    ptsmc_jax.write(other, tmp_path / "s.toml")
    again = ptsmc_jax.read(tmp_path / "s.toml")
    assert ptsmc_jax.gains_of(scenario.study(again).parts) == gains
    for one, two in zip(*(jax.tree.leaves(scenario.study(s).parts) for s in (other, again)), strict=True):
        np.testing.assert_array_equal(one, two)
    with pytest.raises(store.RefusedError, match="exists already"):
        ptsmc_jax.write(other, tmp_path / "s.toml")
    ptsmc_jax.write(flight.scenario, tmp_path / "s.toml", force=True)
    assert ptsmc_jax.read(tmp_path / "s.toml").controller.eta == 3.0
    with pytest.raises(ScenarioError, match=r"controller\.eta is 1\.5"):
        ptsmc_jax.in_scenario(flight.scenario, {"eta": 1.5})
    searched = scenario.replace(flight.scenario, controller__t_f=20.0, loop__t_end=21.0, tune={})
    with pytest.raises(ScenarioError, match=r"^tune\.bounds\.delta is .* and below 0\.9$") as short:
        ptsmc_jax.in_scenario(searched, {"t_f": 0.9})
    assert "\n" not in str(short.value)
    for gains, said in (({"t_f": "9 s"}, "t_f is '9 s', but must be a number"), ({"eta": None}, "eta is None, but")):
        with pytest.raises(ScenarioError, match=said):
            ptsmc_jax.in_scenario(flight.scenario, gains)
    with pytest.raises(TypeError, match=r"gains are needed by name, such as .*, but this is a float"):
        ptsmc_jax.in_scenario(flight.scenario, 3.0)  # type: ignore[arg-type]


def test_a_new_inertia_changes_the_design_model_or_only_the_true_plant(flight):
    """The function can be traced by JAX."""
    inertia = np.array([[11.0, 0.5, 0.0], [0.5, 12.0, -0.3], [0.0, -0.3, 9.0]])
    parts = scenario.study(flight.scenario).parts
    wanted = scenario.study(scenario.replace(flight.scenario, spacecraft__inertia=inertia.tolist())).parts
    moved, traced = parts.with_inertia(inertia), jax.jit(parts.with_inertia)(inertia)
    for part in (lambda p: p.plant, lambda p: p.controller.model, lambda p: p.observer.model):
        np.testing.assert_array_equal(part(moved).inertia, part(wanted).inertia)
        np.testing.assert_array_equal(part(moved).inertia_inverse, part(wanted).inertia_inverse)
        # elimination and LAPACK differ by some rounding
        np.testing.assert_allclose(part(traced).inertia_inverse, np.linalg.inv(inertia), rtol=1e-14, atol=1e-17)
    unknown = parts.with_inertia([9.0, 8.0, 7.0], known=False)
    np.testing.assert_array_equal(unknown.plant.inertia, np.diag([9.0, 8.0, 7.0]))
    np.testing.assert_array_equal(unknown.controller.model.inertia, parts.controller.model.inertia)
    np.testing.assert_array_equal(unknown.observer.model.inertia, parts.observer.model.inertia)


@pytest.mark.parametrize("known", [True, False])
def test_the_gravity_gradient_uses_the_new_inertia_of_the_true_plant(flight, known):
    orbit = {"kind": "gravity_gradient", "orbit_rate": 0.001, "quat_xyzw": [0.6, 0.0, 0.0, 0.8]}
    pushed = scenario.replace(flight.scenario, disturbance={"kind": "sum", "terms": [orbit, {"kind": "constant"}]})
    body = {"spacecraft__inertia" if known else "spacecraft__true_inertia": [4.0, 12.0, 14.0]}
    wanted = scenario.study(scenario.replace(pushed, **body)).parts
    moved = scenario.study(pushed).parts.with_inertia([4.0, 12.0, 14.0], known=known)
    torque, expected = (run.disturbance(jnp.asarray(3.0), run.initial) for run in (moved, wanted))
    np.testing.assert_array_equal(torque, expected)


def test_simulate_refuses_a_nominal_initial_attitude_at_the_singularity_of_the_law():
    turned = scenario.from_tables({**TABLES, "initial": {"rotvec_deg": [180.0, 0.0, 0.0]}})
    with pytest.raises(ScenarioError, match="q4 = 0"):
        ptsmc_jax.simulate(turned)
    assert ptsmc_jax.simulate(turned, trial=0).status in ("ok", "not_converged")


def test_html_tables_of_a_run_show_units_and_escape_their_texts(flight):
    """The texts for a terminal show status and units too."""
    shown = flight._repr_html_()
    for name, entry in flight.run.catalogue.items():
        assert f"<td>{name}</td>" in shown
        assert f"<td>{entry.unit}</td>" in shown
        assert entry.meaning.replace("'", "&#x27;") in shown
    assert "status: ok" in repr(flight)
    assert re.search(r"peak_torque +[\d.]+ N m", repr(flight.metrics))
    hostile = explore.Quantities({"<b>": 1.0}, {"<b>": catalogues.Entry("<script>", "&")})
    assert "<b>" not in hostile._repr_html_()
    assert "<script>" not in hostile._repr_html_()
    assert "&lt;script&gt;" in hostile._repr_html_()
    assert explore.units()["effort"] == catalogues.CATALOGUE["effort"][0]


def test_plot_returns_and_displays_the_figures_with_the_given_names(flight, monkeypatch):
    assert set(flight.plot()) == {"attitude", "rate", "error", "sliding", "torque", "convergence", "disturbance"}
    two = flight.plot("error", "torque")
    assert list(two) == ["error", "torque"]
    images: list[Any] = []
    monkeypatch.setattr("IPython.display.display", images.append)
    two._ipython_display_()
    assert [image.data[:4] for image in images] == [b"\x89PNG", b"\x89PNG"]
    with pytest.raises(ValueError, match="there is no figure 'eror'; allowed are"):
        flight.plot("eror")


def test_trials_returns_the_rows_of_a_campaign_and_verdicts_judges_them(flight):
    """A diverged trial counts as a failure."""
    rows = ptsmc_jax.trials(flight.scenario, 70, seed=3)
    made = campaign.Campaign(scenario.study(flight.scenario), 3)
    assert rows.equals(made.simulate(range(70)))
    assert rows["window_error"][7] == pytest.approx(flight.metrics["window_error"], rel=1e-12)
    (verdict,) = ptsmc_jax.verdicts(flight.scenario, rows)
    assert verdict.met
    assert verdict.worst == rows["peak_torque"].max()
    broken = rows.with_columns(status=pl.when(pl.col("trial") == 3).then(pl.lit("diverged")).otherwise("status"))
    assert ptsmc_jax.verdicts(flight.scenario, broken)[0].failures == 1


def test_verdicts_accepts_all_kinds_of_scenarios_and_validates_rows(flight, tmp_path):
    """A scenario is a file, a scenario object or a study. Rows need a status and the required metrics."""
    rows = ptsmc_jax.trials(flight.scenario, 3)
    (tmp_path / "s.toml").write_text(SHORT)
    (expected,) = ptsmc_jax.verdicts(flight.scenario, rows)
    for what in (tmp_path / "s.toml", scenario.study(flight.scenario)):
        assert ptsmc_jax.verdicts(what, rows) == [expected]
    for other, said in ((rows.head(0), "there are no rows"), (rows.drop("peak_torque"), "have no peak_torque"),
                        (rows.drop("status"), "have no status")):  # fmt: skip
        with pytest.raises(ValueError, match=said):
            ptsmc_jax.verdicts(flight.scenario, other)


def test_an_animation_is_one_page_without_external_files(flight, tmp_path):
    """It needs at least two frames and a spacecraft."""
    made = flight.animate(frames=4)
    content = made._repr_html_()
    assert content.count("data:image/png;base64") == 4
    assert "http" not in re.sub(r"data:image/png;base64,[^\"]*", "", content)
    assert not re.search(r"<i class", content)
    made.save(tmp_path / "a.html")
    assert (tmp_path / "a.html").read_text().startswith("<!doctype html>")
    with pytest.raises(ValueError, match="at least 2"):
        flight.animate(frames=1)
    chain = ptsmc_jax.simulate(scenario.from_tables(CHAIN))
    with pytest.raises(ValueError, match="only a spacecraft"):
        chain.animate()
    assert "x2" in chain.to_polars().columns
    assert "states" in chain.plot()


def test_rotated_axes_of_an_animation_match_scipy():
    turn, vectors = Rotation.from_rotvec([0.4, -1.2, 0.7]), np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(animation.rotate_to_inertial(turn.as_quat(), vectors), turn.apply(vectors), atol=1e-14)


def peak(result, parts):
    """Return the custom metric {"mine": twice the peak torque}."""
    return {"mine": 2.0 * result.metrics.peak_torque}


def test_trials_validates_numbers_and_returns_custom_metrics():
    flight = scenario.from_tables(tomllib.loads(SHORT_CHAIN))
    rows = ptsmc_jax.trials(flight, 2, custom_metrics=peak)
    np.testing.assert_allclose(rows["mine"], 2.0 * rows["peak_torque"], rtol=1e-14)
    for asked in (lambda: ptsmc_jax.trials(flight, -1), lambda: ptsmc_jax.simulate(flight, seed=2**32),
                  lambda: ptsmc_jax.simulate(flight, trial=-1)):  # fmt: skip
        with pytest.raises(ValueError, match="but must be a whole number from"):
            asked()


def test_the_error_of_invalid_custom_metrics_names_their_function():
    """See `test_campaign.py` for the other errors."""
    with pytest.raises(
        ValueError, match=r"^custom_metrics is <lambda>: it returns an empty dict, but must return named numbers"
    ):
        ptsmc_jax.trials(scenario.from_tables(tomllib.loads(SHORT_CHAIN)), 2, custom_metrics=lambda result, parts: {})


def test_an_incomplete_run_shows_its_reason_and_dashes_for_missing_metrics():
    slow = scenario.replace(scenario.from_tables(CHAIN), hardware__torque_limit=1e-3)
    run = ptsmc_jax.simulate(slow)
    assert repr(run).startswith("status: not_converged, at t_f more than 5 % of the initial error is left, at 5 s")
    assert "<td>settling_time</td><td>-</td><td>s</td>" in run.metrics._repr_html_()
    assert explore.units("chain")["peak_torque"] == "u"
    with pytest.raises(ValueError, match="no kind of plant 'boat'; allowed are spacecraft, chain, system"):
        explore.units("boat")
    assert repr(ptsmc_jax.simulate(scenario.study(slow))) == repr(run)


def test_an_animation_draws_body_and_reference_at_even_times(monkeypatch):
    """The edges of the body and the axes of body and reference are compared with the attitudes of the history."""
    drawn = []

    class Watched:
        def __init__(self, figure, draw, frames, interval):
            for k in range(frames):
                lines = [np.stack(line.get_data_3d()).T for line in draw(k)[:-1]]
                drawn.append((float(draw(k)[-1].get_text().split()[2]), lines))

        def to_jshtml(self, default_mode):
            return ""

    monkeypatch.setattr(animation, "FuncAnimation", Watched)
    tables = TABLES | {"reference": {"rotvec_deg": [0.0, 0.0, 40.0]}}
    flight = ptsmc_jax.simulate(scenario.from_tables(tables), trial=1)
    flight.animate(frames=4)
    np.testing.assert_allclose([t for t, _ in drawn], [0.0, 6.5 / 3, 13.0 / 3, 6.5], atol=0.11)
    log, edges = flight.run.log, np.sort([1.0, 0.7, 0.5] * 4)
    for q, lines in ((log.x.q[0], drawn[0][1]), (log.x.q[-1], drawn[-1][1])):
        np.testing.assert_allclose(np.sort([np.linalg.norm(b - a) for a, b in lines[:12]]), edges, rtol=1e-12)
        corners = np.unique(np.round(np.concatenate(lines[:12]), 9), axis=0)
        back = animation.rotate_to_inertial(np.append(-q[:3], q[3]), corners)
        np.testing.assert_allclose(np.abs(back), np.tile(animation.SIDES, (8, 1)), atol=1e-8)
        for at, three in ((q, lines[12:15]), (log.reference.q[0], lines[15:])):
            np.testing.assert_allclose(
                [end for _, end in three], animation.rotate_to_inertial(np.asarray(at), np.eye(3)), atol=1e-12
            )


# --- the functions of `tuning` ---


class Reported(tuning.explore.Outcome):
    """An outcome with a fixed report of two sections, and two named figures."""

    @property
    def report(self):
        """Return a report with a table of gains, texts, and letters that HTML needs escaped."""
        table = Table(("gain", "tuned"), [("eta", "2.9"), ("observer_gain", "3 & 4")])
        blocks = [Text(["one", "two"]), Chart("none", {}, "")]
        return Report(
            "RMS <error> 1 arcsec", "good", ["a line"], [Section("Gains", [table]), Section("Remarks", blocks)]
        )

    def _figures(self):
        """Return a dict of two figures by name."""
        return dict.fromkeys("ab")


def test_outcome_shows_its_report_as_text_and_as_escaped_tables():
    """Figures can be selected by name, and unknown names are refused."""
    shown = Reported()
    assert repr(shown).splitlines() == [
        "RMS <error> 1 arcsec",
        "a line",
        "",
        "Gains",
        "gain           tuned",
        "eta            2.9",
        "observer_gain  3 & 4",
        "",
        "Remarks",
        "one",
        "two",
    ]
    page = shown._repr_html_()
    assert "RMS &lt;error&gt; 1 arcsec" in page
    assert "<tr><td>observer_gain</td><td>3 &amp; 4</td></tr>" in page
    assert "<ul><li>one</li><li>two</li></ul>" in page
    assert list(shown.plot()) == ["a", "b"]
    assert list(shown.plot("b")) == ["b"]
    with pytest.raises(ValueError, match="there is no figure 'c'; allowed are a, b"):
        shown.plot("c")


def test_montecarlo_simulates_the_same_rows_as_trials(flight, tmp_path):
    """A second call in the same folder reads the rows."""
    found = tuning.montecarlo(flight.scenario, 20, seed=3, folder=tmp_path / "c")
    rows = ptsmc_jax.trials(flight.scenario, 20, seed=3)
    assert found.rows.select(rows.columns).equals(rows)
    assert found.met == all(v.met for v in ptsmc_jax.verdicts(flight.scenario, rows))
    largest = rows.sort("peak_torque", descending=True)["trial"][0]
    assert found.worst("peak_torque", 1)["trial"].to_list() == [largest]
    assert "peak_torque at most 30 N m" in repr(found)
    assert list(found.plot("distributions")) == ["distributions"]
    again = tuning.montecarlo(flight.scenario, 20, seed=3, folder=tmp_path / "c")  # nothing is missing
    assert again.rows.equals(found.rows)


def test_a_campaign_is_refused_before_anything_is_written(tmp_path):
    turned = scenario.from_tables({"loop": {"mode": "sampled"}, "initial": {"rotvec_deg": [180.0, 0.0, 0.0]}})
    with pytest.raises(ScenarioError, match="q4 = 0"):
        tuning.montecarlo(turned, 2, folder=tmp_path / "c")
    chain = scenario.from_tables(CHAIN)
    for count, seed in ((2, -1), (0, 1000)):
        with pytest.raises(ValueError, match="but must be a whole number from"):
            tuning.montecarlo(chain, count, seed=seed, folder=tmp_path / "c")
    for search in (tuning.tune, tuning.pareto):
        with pytest.raises(ValueError, match="seed is -1, but must be a whole number from 0"):
            search(chain, seed=-1)
    with store.lock_folder(tmp_path / "c"), pytest.raises(store.InUseError, match="is in use by another"):
        tuning.montecarlo(chain, 2, folder=tmp_path / "c")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
def test_tuned_gains_meet_the_requirements_in_other_trials(monkeypatch):
    """The margins agree with those in the summary of the tuning."""
    small_search(monkeypatch)
    tuned = tuning.tune(scenario.from_tables(tomllib.loads(SHORT)))
    assert tuned.met
    assert tuned.gains.items() <= ptsmc_jax.gains_of(scenario.study(tuned.scenario).parts).items()
    trials = ptsmc_jax.trials(tuned.scenario, 20, seed=99)
    assert all(v.met for v in ptsmc_jax.verdicts(tuned.scenario, trials))
    assert repr(tuned).startswith("RMS pointing error")
    left = tuning.margins(tuned.scenario)
    assert left.worst["gain_margin"] == min(
        v["gain_margin"] for v in tuned.summary["trust"]["margins"].values() if v["gain_margin"] is not None
    )
    assert {"history", "tradeoff"} <= set(tuned.plot())


def test_tuning_exports_every_function_of_its_module_explore():
    """An unknown name raises an AttributeError."""
    made = inspect.getmembers(tuning.explore, inspect.isfunction)
    functions = {name for name, one in made if one.__module__ == "tuning.explore" and not name.startswith("_")}
    assert functions <= set(dir(tuning))
    assert all(getattr(tuning, name) is getattr(tuning.explore, name) for name in functions)
    with pytest.raises(AttributeError, match="module 'tuning' has no attribute 'nothing'"):
        tuning.nothing  # noqa: B018
