"""For notebooks: a scenario flown, looked at and plotted in a line each. The pure core is `rollout.simulate`."""

import html
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import polars as pl
from matplotlib.figure import Figure

from ptsmc_jax import scenario
from ptsmc_jax.campaigns import campaign, margin_verdicts, plans, runs, store
from ptsmc_jax.campaigns.montecarlo import OwnMetrics
from ptsmc_jax.campaigns.runs import Run
from ptsmc_jax.figures import animation, run_plots
from ptsmc_jax.numerics import draws
from ptsmc_jax.onboard import folder
from ptsmc_jax.onboard.library import InTheLoop, Library
from ptsmc_jax.scenario import Study, parsing, reading
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.computer import OURS, Software
from ptsmc_jax.simulation.requirements import Verdict
from ptsmc_jax.theory.error_floor import Floor


class Quantities(Mapping[str, float]):
    """Numbers by name, shown with their units and meanings."""

    def __init__(self, values: Mapping[str, float], catalogue: Mapping[str, catalogues.Entry]):
        self._values, self._catalogue = dict(values), catalogue

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __repr__(self) -> str:
        return "\n".join(f"{name:24s} {value:12.5g} {self._catalogue[name].unit}" for name, value in self.items())

    def _repr_html_(self) -> str:
        head = "".join(f"<th>{heading}</th>" for heading in ("metric", "value", "unit", "meaning"))
        body = ""
        for name, value in self.items():
            entry = self._catalogue[name]
            cells = (name, "-" if value != value else f"{value:.5g}", entry.unit, entry.meaning)
            body += "<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in cells) + "</tr>"
        return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def write(scenario: Scenario, file: str | Path, *, force: bool = False) -> None:
    """Write a scenario as a file that every command takes, with every key; force: over one that is there.

    Raises RefusedError where the file must not be written. What was made in Python is named there, and refused when it
    is read: only code in files can stand in one.

    >>> write(scenario.replace(scenario.from_tables({}), controller__eta=4.0), "mine.toml")  # doctest: +SKIP
    """
    store.check_file(Path(file), force, "force=True")
    store.write_toml(Path(file), parsing.dump(reading.of(scenario)))


@dataclass(frozen=True)
class Flight:
    """A run of a scenario."""

    scenario: Scenario
    run: Run

    @property
    def status(self) -> str:
        """Ok, missed, singular or diverged."""
        return self.run.status

    @property
    def metrics(self) -> Quantities:
        """What the run is judged by, see `catalogues`; settling_time is NaN where it never settles."""
        return Quantities(self.run.metrics, self.run.catalogue)

    @property
    def verdicts(self) -> list[Verdict]:
        """One for each requirement of the scenario."""
        return self.run.verdicts

    @property
    def floor(self) -> Floor | None:
        """What no controller can beat along this run, and its course over time.

        None: not flown to the end, or with sensors of one's own, of which it is not known what they say.
        """
        return self.run.floor

    def plot(self, *names: str) -> "Figures":
        """Figures of the run, all of them or those named; raises ValueError for a name that there is not."""
        figures = run_plots.run_figures(self.run.parts, self.run.log, self.run.torque_limit, self.run.floor)
        unknown = [name for name in names if name not in figures]
        if unknown:
            raise ValueError(f"there is no figure {unknown[0]!r}; allowed are {', '.join(figures)}")
        return Figures({name: figures[name] for name in names or figures})

    def animate(self, frames: int = 40) -> "animation.Animation":
        """The body turning toward its reference, in three dimensions; spacecraft only, else raises ValueError."""
        return animation.of_run(self.run.parts, self.run.log, frames)

    def to_polars(self) -> pl.DataFrame:
        """The history, a row a sample: t [s], state, estimate, delivered torque, sliding variable, error."""
        return pl.DataFrame({**self.run.columns(), **runs.numbered("error", self.run.log.error)})

    def __repr__(self) -> str:
        return "\n".join([self._ending(), repr(self.metrics), *map(str, self.verdicts)])

    def _repr_html_(self) -> str:
        verdicts = "".join(f"<li>{html.escape(str(v))}</li>" for v in self.verdicts)
        return f"<p>{html.escape(self._ending())}</p>{self.metrics._repr_html_()}<ul>{verdicts}</ul>"

    def _ending(self) -> str:
        why = f", {self.run.reason}, at {self.run.bad_time:.4g} s" if self.run.reason else ""
        return f"status: {self.status}{why}"


class Figures(dict[str, Figure]):
    """Figures by name, shown one below the other."""

    def _repr_html_(self) -> str:
        import base64
        import io

        images = []
        for figure in self.values():
            buffer = io.BytesIO()
            figure.savefig(buffer, dpi=90)
            images.append(f'<img src="data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}">')
        return "".join(images)


def simulate(
    what: Scenario | Study | str | Path,
    *,
    seed: int = 0,
    trial: int | None = None,
    controller: str | Path | None = None,
) -> Flight:
    """Fly a scenario, that of a file or of a study, once: nominal, or a trial with its dispersions and noise.

    controller: folder that `export` left, whose C then decides in the loop, on the flight clock.

    Raises ScenarioError, with one sentence, where it cannot be flown.
    """
    draws.check_whole_number("seed", seed)
    draws.check_whole_number("trial", 0 if trial is None else trial)
    loaded = _read(what) if controller is None else folder.flown(_read(what))
    ready = scenario.study(loaded, drawn=trial is not None)
    return Flight(loaded, runs.fly(ready, seed, trial, _software(controller, ready)))


def trials(
    what: Scenario | Study | str | Path,
    count: int | pl.DataFrame = 1000,
    *,
    seed: int = 0,
    own: OwnMetrics | None = None,
    controller: str | Path | None = None,
) -> pl.DataFrame:
    """Rows of the first so many trials of a scenario, or of a plan's, as `ptsmc montecarlo` keeps them.

    Number, status, reason, bad_time [s], the metrics in the units of `catalogues.CATALOGUE`, what each trial flew with,
    and metrics of one's own; of a controller's C how many samples of each trial ended with which status of its own.

    Args:
        what: a scenario, its file, or one made ready to fly.
        count: how many trials, or a plan: a table with a row for each, see `plans`.
        seed: of the draws and the noise.
        own: metrics of one's own, see `montecarlo.one`.
        controller: folder that `export` left, whose C then decides in the loop, on the flight clock; a study is flown
            as its scenario says.

    Raises RefusedError, with one sentence, where a plan cannot be flown, ScenarioError where the controller is none of
    the scenario, and ValueError where metrics of one's own are no named numbers, or have the name of a column, and
    where `count` is neither a whole number nor such a table.
    """
    draws.check_whole_number("seed", seed)
    ready = _ready(what if controller is None else folder.flown(_read(what)))
    software = _software(controller, ready)
    drawn = campaign.Campaign(ready, seed, own, software=software)
    try:
        names = drawn.own_names()
    except ValueError as error:
        raise ValueError(f"own is {getattr(own, '__name__', type(own).__name__)}: {error}") from None
    if isinstance(count, pl.DataFrame):
        plan = plans.checked(count, ready.parts, own=names, drawn=ready.dispersion.own_names())
        drawn, count = replace(campaign.of_plan(ready, seed, plan, own), software=software), plan.count
    if np.ndim(count) or np.asarray(count).dtype == object:
        raise ValueError(f"count is a {type(count).__name__}, but must be a whole number, or a plan as a polars table")
    draws.check_whole_number("count", count, 1)
    return drawn.fly(range(count))


def _software(controller: str | Path | None, ready: Study) -> Software:
    """The flight computer that a folder's C is, or the parts' own code; what C has otherwise is warned of."""
    if controller is None:
        return OURS
    computer = InTheLoop(Library(controller), ready.parts, ready.dispersion)
    if computer.otherwise:
        warnings.warn(computer.otherwise, RuntimeWarning, stacklevel=3)
    return computer.software


def floor(what: Scenario | Study | str | Path, *, seed: int = 0) -> float | None:
    """RMS window error that no controller can beat in a scenario, in the unit of the metric; 0: nothing is unknown.

    Pooled over a few trials, see `runs.floor`; what is taken as known: `error_floor`. None: none of them flies, or with
    sensors of one's own, of which it is not known what they say.
    """
    draws.check_whole_number("seed", seed)
    return runs.floor(_ready(what), seed)


def _read(what: Scenario | Study | str | Path) -> Scenario:
    return reading.of(what.scenario if isinstance(what, Study) else what)


def _ready(what: Scenario | Study | str | Path) -> Study:
    return what if isinstance(what, Study) else scenario.study(_read(what))


def verdicts(what: Scenario | Study | str | Path, rows: pl.DataFrame, *, seed: int = 0) -> list[Verdict]:
    """One for each requirement of the scenario over these rows; a failed trial breaks every one of its runs.

    Margins are those of its loop, see `margin_verdicts`; where loops differ, of those of this seed's trials.

    Raises ValueError where there are no rows, or a column that is asked for is missing; TypeError where they are no
    polars table.
    """
    draws.check_whole_number("seed", seed)
    if not isinstance(rows, pl.DataFrame):
        raise TypeError(
            f"rows are needed in a polars DataFrame, as trials returns them, but this is a {type(rows).__name__}"
        )
    loaded = _read(what)
    asked = scenario.requirements(loaded)
    needed = ["status", *(name for r in asked for name in (r.metric, r.timed) if name is not None)]
    missing = [name for name in needed if name not in rows.columns]
    if missing or not rows.height:
        raise ValueError(f"the rows have no {missing[0]}" if missing else "there are no rows, but must be one at least")
    of_margins = margin_verdicts.over_trials(_ready(what), seed) if scenario.margin_requirements(loaded) else []
    return [*campaign.verdicts(asked, rows), *of_margins]


def units(kind: str = "spacecraft") -> dict[str, str]:
    """The unit of each metric of this kind of plant; raises ValueError where there is no such kind."""
    if kind not in catalogues.CATALOGUES:
        raise ValueError(f"there is no kind of plant {kind!r}; allowed are {', '.join(catalogues.CATALOGUES)}")
    return catalogues.units(kind)
