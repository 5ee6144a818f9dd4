"""Short functions for notebooks: tune gains, compare laws, find margins, run a campaign. Start with `tune`.

Each result has the report of the command of the same name. Notebooks show the report as tables, `print` as text.
"""

import html
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import polars as pl

from ptsmc_jax.campaigns import rows, store
from ptsmc_jax.explore import Figures, html_list, html_table
from ptsmc_jax.numerics import draws
from ptsmc_jax.onboard.folder import on_flight_clock
from ptsmc_jax.scenario import Study, reading
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.theory.run_margins import Course
from tuning.output import front_report, reports
from tuning.output.report import Report, Table
from tuning.studies import (
    campaign_figures,
    campaign_folder,
    campaign_summary,
    posing,
    reproduction,
    stability,
    trades,
    tune_files,
    tuner,
)
from tuning.studies import compare as comparing
from tuning.studies import pareto as fronts
from tuning.studies.campaign_folder import Folder
from tuning.studies.front import KINDS, Front, Point
from tuning.studies.reproduction import Reproduction
from tuning.studies.tuner import Tuning

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Outcome:
    """The result of a study. It prints as the report of the command, and notebooks show it as tables."""

    @property
    def report(self) -> Report:
        """The content of the report."""
        raise NotImplementedError

    def _figures(self) -> dict[str, Any]:
        """Return the Matplotlib figures of the result, a dict by name."""
        raise NotImplementedError

    def plot(self, *names: str) -> Figures:
        """Return all figures of the result, or the named ones; raise ValueError for an unknown name."""
        return Figures(self._figures()).only(names)

    def __repr__(self) -> str:
        report = self.report
        lines = [report.headline, *report.lines]
        for title, content in report.printed():
            lines += ["", title] if title else []
            lines += _aligned_lines(content) if isinstance(content, Table) else content
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        report = self.report
        text = f"<p><b>{html.escape(report.headline)}</b></p>{html_list(report.lines)}"
        for title, content in report.printed():
            text += f"<p><b>{html.escape(title)}</b></p>" if title else ""
            text += html_table(content.head, content.rows) if isinstance(content, Table) else html_list(content)
        return text


def _aligned_lines(table: Table) -> list[str]:
    """Return the lines of a table with aligned columns."""
    cells = [table.head, *table.rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in cells]


@dataclass(frozen=True, repr=False)
class Tuned(Outcome):
    """Gains that a search found, verified on held-out trials. Its figures are those of `ptsmc tune`."""

    original: Scenario  # before the search
    tuning: Tuning

    @property
    def scenario(self) -> Scenario:
        """The scenario with the tuned gains, on the flight clock."""
        return self.tuning.tuned

    @property
    def gains(self) -> dict[str, float]:
        """The tuned gains by name."""
        return self.tuning.gains

    @property
    def met(self) -> bool:
        """Whether the held-out trials meet every requirement."""
        return self.tuning.met

    @cached_property
    def summary(self) -> dict[str, Any]:
        """The content of `summary.json`."""
        return tune_files.summary(self.tuning)

    @property
    def report(self) -> Report:
        """The report of `ptsmc tune`."""
        return reports.build("tune", self.summary, self.original.plant.kind)

    def _figures(self) -> dict[str, "Figure"]:
        return tune_files.figures_of(self.original, self.tuning)


def tune(what: Scenario | Study | str | Path, *, seed: int = 0) -> Tuned:
    """Find the gains with the smallest error that meet every requirement, as `ptsmc tune` does.

    Args:
        what: a scenario, the path of its file, or a study. Its table `tune` has the settings of the search.
        seed: seed of the search and its trials.

    Raises:
        ScenarioError: the scenario is not valid, or no gain is free.
        ValueError: `seed` is not a whole number from 0 to 2^32 - 1.
    """
    draws.check_whole_number("seed", seed)
    original = posing.with_tune(_to_scenario(what))
    return Tuned(original, tuner.tune(original, seed))


@dataclass(frozen=True, repr=False)
class Traced(Outcome):
    """A Pareto front, verified on held-out trials. Its figure is the one of `ptsmc pareto`."""

    trade: trades.Trade
    front: Front

    @property
    def points(self) -> list[Point]:
        """The points that no other point dominates, in the order of the traded quantity."""
        return self.front.non_dominated

    @property
    def report(self) -> Report:
        """The report of `ptsmc pareto`."""
        return front_report.build(self.front)

    def _figures(self) -> dict[str, "Figure"]:
        return {KINDS[self.front.against].file: fronts.figure_of(self.trade, self.front)}


def pareto(
    what: Scenario | Study | str | Path,
    *,
    against: Literal["torque", "margins", "t_f"] = "torque",
    points: int | None = None,
    values: tuple[float, ...] = (),
    seed: int = 0,
) -> Traced:
    """Trace the smallest error over another quantity, as `ptsmc pareto` does.

    Args:
        what: a scenario, the path of its file, or a study.
        against: the peak torque, the peak sensitivity (margins), or the prescribed time t_f.
        points: number of limits on the peak torque; None: 20.
        values: limits on the peak sensitivity [dB], or prescribed times [s]; empty: the defaults of the command.
        seed: seed of the search and its trials.

    Raises:
        ScenarioError: the scenario is not valid, or the study does not apply to it.
        ValueError: `seed` is not a whole number from 0 to 2^32 - 1.
    """
    draws.check_whole_number("seed", seed)
    trade = trades.build(against, posing.with_tune(_to_scenario(what)), points, values)
    return Traced(trade, fronts.trace(trade, seed))


@dataclass(frozen=True, repr=False)
class Compared(Outcome):
    """Several laws, tuned to the same requirements. Its figures are those of `ptsmc compare`."""

    comparison: comparing.Comparison

    @cached_property
    def summary(self) -> dict[str, Any]:
        """The content of `summary.json`."""
        return comparing.summary(self.comparison)

    @property
    def report(self) -> Report:
        """The report of `ptsmc compare`."""
        return reports.build("compare", self.summary, "spacecraft")

    def _figures(self) -> dict[str, "Figure"]:
        return dict(comparing.plot_figures(self.comparison))


def compare(what: Scenario | Study | str | Path, *, against: Sequence[str] | None = None, seed: int = 0) -> Compared:
    """Tune several laws to the same requirements and compare them, as `ptsmc compare` does.

    Args:
        what: a scenario, the path of its file, or a study. If its law is custom, it is compared, too.
        against: kinds of the built-in laws, such as "pd", beside the prescribed-time law; None: all of them.
        seed: seed of the searches and their trials.

    Raises:
        ScenarioError: the scenario is not valid, or a law cannot be used in it.
        ValueError: a kind is unknown, or `seed` is not a whole number from 0 to 2^32 - 1.
    """
    draws.check_whole_number("seed", seed)
    rivals = comparing.Rivals(None if against is None else tuple(against))
    rivals.check()
    loaded = posing.with_tune(_to_scenario(what))
    comparing.check(loaded)
    contenders = comparing.validated_contenders(loaded, rivals)
    return Compared(comparing.compare(loaded, seed, lambda *_: None, None, contenders))


@dataclass(frozen=True, repr=False)
class Margins(Outcome):
    """Stability margins of the nominal loop. Its figures are those of `ptsmc margins`."""

    ready: Study
    course: Course

    @property
    def worst(self) -> dict[str, float]:
        """The smallest margins of any input in both phases [dB], [deg], [s], and the peak sensitivity [dB]."""
        return {name: float(value) for name, value in self.course.worst().items()}

    @property
    def report(self) -> Report:
        """The report of `ptsmc margins`."""
        return reports.build("margins", stability.summary(self.ready, self.course), self.ready.scenario.plant.kind)

    def _figures(self) -> dict[str, "Figure"]:
        return stability.figures_of(self.ready, self.course)


def margins(what: Scenario | Study | str | Path) -> Margins:
    """Linearise the nominal loop and find its margins, as `ptsmc margins` does.

    Args:
        what: a scenario, the path of its file, or a study.

    Raises:
        ScenarioError: the loop is continuous, or it has no finite derivatives.
    """
    return Margins(*stability.find_margins(_to_scenario(what)))


@dataclass(frozen=True, repr=False)
class Campaign(Outcome):
    """A Monte Carlo campaign. Its figures are those of `ptsmc montecarlo`."""

    folder: Folder

    @cached_property
    def summary(self) -> dict[str, Any]:
        """The content of `summary.json`."""
        return campaign_summary.summarise(self.folder)

    @property
    def met(self) -> bool:
        """Whether every requirement is met."""
        return self.summary["status"] == "met"

    @property
    def report(self) -> Report:
        """The report of `ptsmc montecarlo`."""
        return reports.build("montecarlo", self.summary, self.folder.scenario.plant.kind)

    @property
    def rows(self) -> pl.DataFrame:
        """One row for each trial, see `ptsmc_jax.trials`."""
        return rows.read(self.folder.intact_parts())

    def worst(self, by: str = "window_error", count: int = 5) -> pl.DataFrame:
        """Return the rows of the worst trials, failed trials first.

        Args:
            by: column that orders the trials.
            count: number of rows.
        """
        return campaign_summary.worst_trials(self.folder, by, count)

    def _figures(self) -> dict[str, "Figure"]:
        return campaign_figures.build(self.folder, self.summary)


def montecarlo(
    what: Scenario | Study | str | Path,
    trials: int = 10_000,
    *,
    seed: int = 1000,
    folder: str | Path | None = None,
    controller: str | Path | None = None,
) -> Campaign:
    """Simulate a campaign and keep its rows in a folder, as `ptsmc montecarlo` does.

    The same call again resumes an interrupted campaign.

    Args:
        what: a scenario, the path of its file, or a study.
        trials: number of trials.
        seed: seed of the dispersions and the noise. It must differ from the seed of the tuning.
        folder: folder of the campaign; None: a temporary folder, which is not deleted.
        controller: a folder that `ptsmc_jax.export` wrote. Its C code then computes the torque.

    Raises:
        RefusedError: the folder has another campaign, or another process writes into it.
        ScenarioError: the scenario is not valid, or the controller does not belong to it.
        ValueError: `seed` or `trials` is not a whole number from 0, or from 1, to 2^32 - 1.
    """
    draws.check_whole_number("seed", seed)
    draws.check_whole_number("trials", trials, 1)
    path = Path(tempfile.mkdtemp()) / "campaign" if folder is None else Path(folder)
    loaded = _to_scenario(what) if controller is None else on_flight_clock(_to_scenario(what))
    target = Folder(path, loaded, seed, trials, controller=None if controller is None else Path(controller))
    _ = target.campaign  # raises ScenarioError before anything is written
    with store.lock_folder(path):
        campaign_folder.begin(target, force=False)
        campaign_folder.simulate(target, (1, 1), lambda tally: None)
    return Campaign(target)


@dataclass(frozen=True, repr=False)
class Reproduced(Outcome):
    """The claims of the paper beside the measurements. Its figures are those of `ptsmc reproduce`."""

    reproduction: Reproduction

    @property
    def report(self) -> Report:
        """The report of `ptsmc reproduce`."""
        return reports.build("reproduce", reproduction.summary(self.reproduction), "spacecraft")

    def _figures(self) -> dict[str, "Figure"]:
        return reproduction.figures_of(self.reproduction)


def reproduce() -> Reproduced:
    """Simulate the cases of the paper and compare its claims with the measurements, as `ptsmc reproduce` does."""
    return Reproduced(reproduction.reproduce())


def _to_scenario(what: Scenario | Study | str | Path) -> Scenario:
    """Return a scenario: itself, that of a study, or that of a file."""
    return reading.to_scenario(what.scenario if isinstance(what, Study) else what)
