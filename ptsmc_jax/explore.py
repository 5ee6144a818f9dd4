"""Short functions for notebooks: simulate, plot, run trials, compute verdicts, identify. Start with `simulate`.

The pure function of JAX underneath is `rollout.simulate`.
"""

import html
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import polars as pl
from matplotlib.figure import Figure

from ptsmc_jax import scenario
from ptsmc_jax.campaigns import campaign, margin_verdicts, run_tables, runs, store
from ptsmc_jax.campaigns.montecarlo import CustomMetrics
from ptsmc_jax.campaigns.runs import Run
from ptsmc_jax.figures import animation, identification_plots, run_plots
from ptsmc_jax.identification import estimation, results, telemetry
from ptsmc_jax.numerics import draws
from ptsmc_jax.onboard import folder
from ptsmc_jax.onboard.library import InTheLoop, Library
from ptsmc_jax.scenario import Study, parsing, reading
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.computer import PYTHON_SOFTWARE, Software
from ptsmc_jax.simulation.requirements import Verdict
from ptsmc_jax.theory.lower_bound import LowerBound


class Quantities(dict[str, float]):
    """Numbers by name. Notebooks show them with units and meanings."""

    def __init__(self, values: Mapping[str, float], catalogue: Mapping[str, catalogues.Entry]):
        super().__init__(values)
        self._catalogue = catalogue

    def __missing__(self, name: str) -> float:
        raise KeyError(f"this run has no metric {name!r}, but it has {', '.join(self)}")

    def __repr__(self) -> str:
        return "\n".join(f"{name:24s} {value:12.5g} {self._catalogue[name].unit}" for name, value in self.items())

    def _repr_html_(self) -> str:
        entries = [(name, value, self._catalogue[name]) for name, value in self.items()]
        rows = [(name, "-" if value != value else f"{value:.5g}", e.unit, e.meaning) for name, value, e in entries]
        return html_table(("metric", "value", "unit", "meaning"), rows)


def html_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return an HTML table with these cells, which are escaped."""

    def html_row(cells: Sequence[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    body = "".join(html_row(cells, "td") for cells in rows)
    return f"<table><thead>{html_row(head, 'th')}</thead><tbody>{body}</tbody></table>"


def html_list(lines: Iterable[object]) -> str:
    """Return an HTML list of these lines, which are escaped; empty without lines."""
    items = "".join(f"<li>{html.escape(str(line))}</li>" for line in lines)
    return f"<ul>{items}</ul>" if items else ""


def write(scenario: Scenario, file: str | Path, *, force: bool = False) -> None:
    """Write a scenario to a TOML file with all keys, for the commands of `ptsmc`.

    Args:
        scenario: a scenario.
        file: path of the file.
        force: whether an existing file is overwritten.

    Raises:
        RefusedError: the file exists and `force` is False, or it cannot be written.
        ScenarioError: the scenario contains an object that was made in Python, such as the class of a custom law.

    >>> write(scenario.replace(scenario.from_tables({}), controller__eta=4.0), "mine.toml")  # doctest: +SKIP
    """
    tables = parsing.dump(reading.to_scenario(scenario))
    store.check_names_code(tables)
    store.check_file(Path(file), force, "force=True")
    store.write_toml(Path(file), tables)


@dataclass(frozen=True)
class Simulation:
    """A simulated run of a scenario, with its metrics, verdicts and plots."""

    scenario: Scenario
    run: Run

    @property
    def status(self) -> str:
        """Status of the run: ok, not_converged (at t_f), singular or diverged."""
        return self.run.status

    @property
    def metrics(self) -> Quantities:
        """Metrics of the run, see `catalogues`. The settling time is NaN if the run never settles."""
        return Quantities(self.run.metrics, self.run.catalogue)

    @property
    def verdicts(self) -> list[Verdict]:
        """One verdict for each requirement of the scenario."""
        return self.run.verdicts

    @property
    def lower_bound(self) -> LowerBound | None:
        """Lower bound of the error along this run (posterior Cramer-Rao bound), over time.

        It is None if the run is incomplete or if its sensors are custom, since their measurement model is unknown.
        """
        return self.run.lower_bound

    def plot(self, *names: str) -> "Figures":
        """Return all figures of the run, or the named ones; raise ValueError for an unknown name."""
        figures = run_plots.run_figures(self.run.parts, self.run.log, self.run.limits, self.run.lower_bound)
        return Figures(figures).only(names)

    def animate(self, frames: int = 40) -> "animation.Animation":
        """Animate the rotation of the body to its reference in 3D; raise ValueError if the plant is no spacecraft."""
        return animation.animate_run(self.run.parts, self.run.log, frames)

    def to_polars(self) -> pl.DataFrame:
        """Return the history, one row per sample: t [s], state, estimate, delivered torque, sliding variable, error."""
        return pl.DataFrame({**self.run.columns(), **runs.numbered_columns({"error": self.run.log.error})})

    def __repr__(self) -> str:
        return "\n".join([self._ending(), repr(self.metrics), *map(str, self.verdicts)])

    def _repr_html_(self) -> str:
        return f"<p>{html.escape(self._ending())}</p>{self.metrics._repr_html_()}{html_list(self.verdicts)}"

    def _ending(self) -> str:
        """Return the status in words, with reason and time [s] of a failure."""
        failure = f", {self.run.reason}, at {self.run.bad_time:.4g} s" if self.run.reason else ""
        return f"status: {self.status}{failure}"


@dataclass(frozen=True)
class Identified(estimation.Identification):
    """Parameters of a scenario, estimated from telemetry, with a verdict and figures."""

    @property
    def identified_scenario(self) -> Scenario:
        """The scenario with the estimates, and with their covariance in [dispersion]."""
        return results.identified_scenario(self)

    @property
    def verdict(self) -> list[str]:
        """Sentences on whether the model explains the logs, and on combinations of parameters that they leave open."""
        return results.verdict(self)

    def plot(self, *names: str) -> "Figures":
        """Return all figures of the identification, or the named ones; raise ValueError for an unknown name."""
        return Figures(identification_plots.identification_figures(self)).only(names)

    def __repr__(self) -> str:
        return "\n".join([*self.verdict, super().__repr__()])

    def _repr_html_(self) -> str:
        head = ("parameter", "estimate", "1 sigma", "start", "unit")
        rows = [
            (row["parameter"], f"{row['estimate']:.6g}", f"{row['std']:.2g}", f"{row['start']:.6g}", row["unit"])
            for row in self.table().iter_rows(named=True)
        ]
        return html_list(self.verdict) + html_table(head, rows)


class Figures(dict[str, Figure]):
    """Figures by name. Notebooks show them one below the other, as PNG images."""

    def only(self, names: Sequence[str]) -> "Figures":
        """Return the named figures, all of them without names; raise ValueError for an unknown name."""
        unknown = [name for name in names if name not in self]
        if unknown:
            raise ValueError(f"there is no figure {unknown[0]!r}; allowed are {', '.join(self)}")
        return Figures({name: self[name] for name in names or self})

    def _ipython_display_(self) -> None:
        import io

        from IPython.display import Image, display  # a notebook has it

        for figure in self.values():
            buffer = io.BytesIO()
            figure.savefig(buffer, dpi=90)
            display(Image(buffer.getvalue()))


def simulate(
    what: Scenario | Study | str | Path,
    *,
    seed: int = 0,
    trial: int | None = None,
    controller: str | Path | None = None,
) -> Simulation:
    """Simulate a scenario once.

    Args:
        what: a scenario, the path of its file, or a study.
        seed: seed of the dispersions and the noise.
        trial: number of a trial with random dispersions and noise; None: the nominal run.
        controller: a folder that `export` wrote. Its C code then computes the torque, on the flight clock.

    Raises:
        ScenarioError: the scenario is not valid or cannot be simulated; the message is one sentence.
        ValueError: `seed` or `trial` is not a whole number of at least 0.
    """
    draws.check_whole_number("seed", seed)
    draws.check_whole_number("trial", 0 if trial is None else trial)
    loaded = _to_scenario(what) if controller is None else folder.on_flight_clock(_to_scenario(what))
    ready = scenario.study(loaded, drawn=trial is not None)
    return Simulation(loaded, runs.simulate(ready, seed, trial, _flight_software(controller, ready)))


def trials(
    what: Scenario | Study | str | Path,
    count: int | pl.DataFrame = 1000,
    *,
    seed: int = 0,
    custom_metrics: CustomMetrics | None = None,
    controller: str | Path | None = None,
) -> pl.DataFrame:
    """Run trials of a scenario, the same trials as `ptsmc montecarlo` runs.

    Args:
        what: a scenario, the path of its file, or a study.
        count: number of trials, or a run table with one row for each trial, see `run_tables`.
        seed: seed of the dispersions and the noise.
        custom_metrics: function that returns custom metrics, see `montecarlo.one`.
        controller: a folder that `export` wrote. Its C code then computes the torque, on the flight clock. If `what` is
            a study, its scenario is simulated.

    Returns:
        One row for each trial: number, status, reason, bad_time [s], the metrics in the units of
        `catalogues.CATALOGUE`, the dispersed values, and custom metrics. With a controller, also the number of samples
        by the status that its C code returned.

    Raises:
        RefusedError: the run table cannot be simulated.
        ScenarioError: the controller does not belong to the scenario.
        ValueError: custom metrics are not named numbers or have the name of a column, or `count` is neither a whole
            number nor a table.
    """
    draws.check_whole_number("seed", seed)
    ready = _to_study(what if controller is None else folder.on_flight_clock(_to_scenario(what)))
    software = _flight_software(controller, ready)
    trial_campaign = campaign.Campaign(ready, seed, custom_metrics, software=software)
    try:
        metric_names = trial_campaign.custom_metric_names()
    except ValueError as error:
        raise ValueError(
            f"custom_metrics is {getattr(custom_metrics, '__name__', type(custom_metrics).__name__)}: {error}"
        ) from None
    if isinstance(count, pl.DataFrame):
        table = run_tables.check_table(
            count, ready.parts, custom_metrics=metric_names, drawn=ready.dispersion.custom_names()
        )
        trial_campaign = replace(campaign.from_run_table(ready, seed, table, custom_metrics), software=software)
        count = table.count
    if np.ndim(count) or np.asarray(count).dtype == object:
        allowed = "a whole number, or a polars table with a row for each trial"
        raise ValueError(f"count is a {type(count).__name__}, but must be {allowed}")
    draws.check_whole_number("count", count, 1)
    return trial_campaign.simulate(range(count))


def _flight_software(controller: str | Path | None, ready: Study) -> Software:
    """Return the flight software: the C code of a folder, or the code of the parts.

    Warn about differences between the C code and the scenario.
    """
    if controller is None:
        return PYTHON_SOFTWARE
    computer = InTheLoop(Library(controller), ready.parts, ready.dispersion)
    if computer.parameter_differences:
        warnings.warn(computer.parameter_differences, RuntimeWarning, stacklevel=3)
    return computer.software


def lower_bound(what: Scenario | Study | str | Path, *, seed: int = 0) -> float | None:
    """Return the lower bound of the RMS window error of a scenario, in the unit of the metric.

    It is the posterior Cramer-Rao bound of a few trials, pooled by `runs.rms_lower_bound`. The module
    `theory.lower_bound` lists the assumptions.
    The bound is 0 if nothing is unknown, and None if no trial is complete or if the sensors are custom.
    """
    draws.check_whole_number("seed", seed)
    return runs.rms_lower_bound(_to_study(what), seed)


def _to_scenario(what: Scenario | Study | str | Path) -> Scenario:
    """Return a scenario: itself, that of a study, or that of a file."""
    return reading.to_scenario(what.scenario if isinstance(what, Study) else what)


def _to_study(what: Scenario | Study | str | Path) -> Study:
    """Return a study: itself, or that of a scenario or of its file."""
    return what if isinstance(what, Study) else scenario.study(_to_scenario(what))


def verdicts(what: Scenario | Study | str | Path, rows: pl.DataFrame, *, seed: int = 0) -> list[Verdict]:
    """Return one verdict for each requirement of a scenario over the rows of trials.

    A failed trial violates all requirements. Margins come from the linearised loop, see `margin_verdicts`. If loops
    differ between trials, they come from the trials of this seed.

    Args:
        what: a scenario, the path of its file, or a study.
        rows: rows as `trials` returns them.
        seed: seed of the trials whose loops are linearised.

    Raises:
        ValueError: there are no rows, or a required column is missing.
        TypeError: `rows` is not a polars DataFrame.
    """
    draws.check_whole_number("seed", seed)
    if not isinstance(rows, pl.DataFrame):
        raise TypeError(
            f"rows are needed in a polars DataFrame, as trials returns them, but this is a {type(rows).__name__}"
        )
    loaded = _to_scenario(what)
    required = scenario.requirements(loaded)
    needed = ["status", *(name for r in required for name in (r.metric, r.timed) if name is not None)]
    missing = [name for name in needed if name not in rows.columns]
    if missing or not rows.height:
        raise ValueError(f"the rows have no {missing[0]}" if missing else "there are no rows, but must be one at least")
    on_margins = list[Verdict]()
    if scenario.margin_requirements(loaded):
        numbers = rows["trial"].to_numpy() if "trial" in rows.columns else np.arange(rows.height)
        finished = np.ones(numbers.max() + 1, bool)
        finished[numbers] = campaign.has_finished(rows)
        on_margins = margin_verdicts.judge_trials(_to_study(what), seed, None, finished)
    return [*campaign.verdicts(required, rows), *on_margins]


def identify(
    what: Scenario | str | Path,
    log: pl.DataFrame | Sequence[pl.DataFrame],
    *,
    validate: Sequence[pl.DataFrame] = (),
    free: Sequence[str] | None = None,
    report: Callable[[str], None] = lambda text: None,
) -> Identified:
    """Estimate parameters of a scenario's true plant from telemetry.

    Args:
        what: a scenario, or the path of its file. [telemetry] names the columns and [identify] the parameters.
        log: a table with a row for each time, or several tables of separate runs.
        validate: logs that are predicted with the estimates and not used for them.
        free: names of the parameters; by default those of the scenario.
        report: called with the progress in words.

    Returns:
        The estimates, their covariance and the innovations.

    Raises:
        ScenarioError: a parameter is unknown.
        RefusedError: a log cannot be used; the sentence names row and column.
    """
    loaded = reading.complete(_to_scenario(what))
    frames = [*([log] if isinstance(log, pl.DataFrame) else log), *validate]
    logs = [telemetry.measurements(loaded, frame, f"log {k + 1}") for k, frame in enumerate(frames)]
    used = len(logs) - len(validate)
    estimated = estimation.estimate_parameters(loaded, logs[:used], logs[used:], free, report)
    return Identified(**vars(estimated))


def units(kind: str = "spacecraft") -> dict[str, str]:
    """Return the unit of each metric for a kind of plant; raise ValueError for an unknown kind."""
    if kind not in catalogues.CATALOGUES:
        raise ValueError(f"there is no kind of plant {kind!r}; allowed are {', '.join(catalogues.CATALOGUES)}")
    return catalogues.units(kind)
