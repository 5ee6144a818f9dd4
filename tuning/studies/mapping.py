"""`ptsmc map`: accuracy, peak torque and stability margins over a grid of values for two scenario keys.

Each pair of values is simulated. Linear covariance analysis and the poles of the frozen loop give the predictions of
linear theory. Read `simulate` first.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from contourpy import contour_generator

from ptsmc_jax.campaigns import montecarlo, store
from ptsmc_jax.figures import study_plots, style
from ptsmc_jax.scenario import Study, custom, errors, keys, parsing, study
from ptsmc_jax.scenario import replace as changed
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation.rollout import Parts
from ptsmc_jax.theory import covariance, margins, run_margins, stability_limits
from tuning.errors import UsageError
from tuning.search import trust
from tuning.studies import judging

PERIOD, DELTA = "loop.period", "controller.delta"
WHOLE_NUMBERS = ("hardware.delay", "hardware.star_tracker_every")
WIDE = 5.0  # axes that span more than this factor are logarithmic


@dataclass(frozen=True)
class Axis:
    """A key of the scenario and the values that it takes."""

    key: str
    values: tuple[float, ...]
    span: str = ""  # LOW:HIGH:COUNT of the option, if it cannot be derived from the values

    @property
    def text(self) -> str:
        """The axis in the format of the option, which `axis` parses."""
        return f"{self.key}={self.span or f'{self.values[0]:g}:{self.values[-1]:g}:{len(self.values)}'}"

    @property
    def logarithmic(self) -> bool:
        """Whether the axis is logarithmic."""
        return self.values[0] > 0 and self.values[-1] > WIDE * self.values[0]


@dataclass(frozen=True)
class Cell:
    """The results for one pair of values. A number is NaN if it does not exist."""

    x: float
    y: float
    status: str  # "simulated", or the reason why the pair was not simulated
    trials: int = 0
    failures: int = 0  # trials that did not reach their end
    not_converged: int = 0  # trials that did not converge by t_f
    window_error: float = np.nan  # RMS over the trials
    peak_torque: float = np.nan  # mean over the trials [N m]
    largest_peak_torque: float = np.nan  # largest over the trials [N m]
    linear_window_error: float = np.nan  # error due to noise alone, by linear covariance analysis
    linear_torque: float = np.nan  # torque due to noise alone, by linear covariance analysis [N m]
    radius: float = np.nan  # spectral radius of the frozen loop at the hand-over [-]
    gain_margin: float = np.nan  # gain margin at the hand-over, as a factor [-]
    delay_margin: float = np.nan  # delay margin at the hand-over [s]
    hold_gain_margin: float = np.nan  # gain margin in the hold phase, as a factor [-]
    hold_delay_margin: float = np.nan  # delay margin in the hold phase [s]
    hold_radius: float = np.nan  # spectral radius of the frozen loop in the hold phase [-]


@dataclass(frozen=True)
class Map:
    """The results for all pairs of values of two scenario keys."""

    scenario: Scenario
    x: Axis
    y: Axis
    cells: list[Cell]  # x varies fastest

    def grid(self, name: str) -> np.ndarray:
        """Return a field of the cells as an array (y, x)."""
        return np.array([getattr(cell, name) for cell in self.cells]).reshape(len(self.y.values), len(self.x.values))


def axis(text: str, option: str) -> Axis:
    """Parse an axis from KEY=LOW:HIGH:COUNT, such as controller.delta=0.05:3:9.

    KEY[0] selects one element of a key with several numbers. Raises UsageError if the text is invalid.

    Args:
        text: value of the option.
        option: name of the option in error messages, "--x" or "--y".
    """
    key, _, span = text.partition("=")
    parts = span.split(":")
    message = f"{option} is {text}, but must be KEY=LOW:HIGH:COUNT, such as controller.delta=0.05:3:9"
    if len(parts) != 3 or key.count(".") != 1:
        raise UsageError(message)
    try:
        low, high, count = float(parts[0]), float(parts[1]), int(parts[2])
    except ValueError:
        raise UsageError(message) from None
    if not (np.isfinite(low) and np.isfinite(high) and low < high and 2 <= count <= 100):
        raise UsageError(f"{message}, with LOW below HIGH and COUNT from 2 to 100")
    spaced = np.geomspace if Axis(key, (low, high)).logarithmic else np.linspace
    values = spaced(low, high, count)
    if key in WHOLE_NUMBERS:
        values = np.round(values)
    different = tuple(dict.fromkeys(float(f"{v:.6g}") for v in values))
    if len(different) < 2:  # a map needs at least two values
        those = "two whole numbers" if key in WHOLE_NUMBERS else "two values that differ in six digits"
        raise UsageError(f"{message}, with {those} between LOW and HIGH at least")
    return Axis(key, different, span if len(different) < count or key in WHOLE_NUMBERS else "")


def usual_periods(scenario: Scenario) -> str:
    """Return the default x axis: control periods from 0.4 to 10 times the scenario's period."""
    period = scenario.loop.period
    return f"{PERIOD}={0.4 * period:.4g}:{10.0 * period:.4g}:9"


def usual_deltas(scenario: Scenario) -> str:
    """Return the default y axis: delta from one period to t_f / 7.

    The range is extended to include the scenario's delta, and up to twice this delta.
    """
    delta, shortest = scenario.hand_over, scenario.loop.period
    longest = max(scenario.controller.t_f / 7.0, 2.0 * delta)
    return f"{DELTA}={min(delta, shortest):.4g}:{longest:.4g}:9"


def simulate(scenario: Scenario, x: Axis, y: Axis, seed: int, trials: int, tell: Callable[[int, int], None]) -> Map:
    """Simulate the scenario's trials for every pair of values.

    Args:
        scenario: the scenario.
        x: the horizontal axis.
        y: the vertical axis.
        seed: seed of dispersions and noise.
        trials: number of trials for each pair; 1 is used if all trials are equal.
        tell: called with the number of finished cells and the number of all cells.

    Returns:
        The map. A pair that is not a valid scenario has the error message as its status.

    Raises:
        ScenarioError: no pair is a valid scenario.
    """
    if PERIOD in (x.key, y.key):
        scenario.need_samples(PERIOD)
    base = _with_explicit_gains(changed(scenario, tune=None))  # the bounds in [tune] may be invalid for some pairs
    pairs = [(a, b) for b in y.values for a in x.values]
    studies: list[Study | str] = []
    for a, b in pairs:
        try:
            studies.append(study(_with_keys(base, {x.key: a, y.key: b})))
        except ScenarioError as error:
            studies.append(str(error))
    allowed = [one for one in studies if isinstance(one, Study)]
    if not allowed:
        raise ScenarioError(str(studies[0]))
    common = _with_common_clock([one.parts for one in allowed])
    cells = []
    for k, ((a, b), one) in enumerate(zip(pairs, studies, strict=True)):
        cells.append(Cell(a, b, one) if isinstance(one, str) else _cell(a, b, one, common, seed, trials))
        tell(k + 1, len(pairs))
    return Map(scenario, x, y, cells)


def _with_explicit_gains(scenario: Scenario) -> Scenario:
    """Return the scenario with explicit values of its default gains, so that other keys do not change them."""
    stated = {
        f"{where}__{name.removeprefix(table.prefix)}": getattr(table, name.removeprefix(table.prefix))
        for where, table in scenario.tuned_tables.items()
        for name in table.gains
        if "." not in where and name != "t_f"
    }
    return changed(scenario, **{key: value for key, value in stated.items() if value is not None})


def _with_keys(scenario: Scenario, values: dict[str, float]) -> Scenario:
    """Return the scenario with new values of some keys.

    If a key has a number for each axis or mode, all of them get the value. A key with an index, such as
    flexible.frequency[0], changes one of them.
    """
    changes: dict[str, Any] = {}
    for key, value in values.items():
        table, _, name = key.partition(".")
        name, _, place = name.partition("[")
        current = changes.get(f"{table}__{name}", getattr(getattr(scenario, table, None), name, None))
        number: Any = int(value) if key in WHOLE_NUMBERS else value
        if isinstance(current, tuple | list):
            one = place.removesuffix("]")
            chosen = {int(one)} if one.isdecimal() else set(range(len(current)))
            if not chosen <= set(range(len(current))):
                raise ScenarioError(f"{key} does not exist: {table}.{name} is {errors.brief(current)}")
            number = [value if k in chosen else old for k, old in enumerate(current)]
        changes[f"{table}__{name}"] = number
    if "loop.t_end" not in values and {"controller.t_f", "loop.window"} & set(values):  # keep t_end - t_f
        t_f = values.get("controller.t_f", scenario.controller.t_f)
        after = max(scenario.end - scenario.controller.t_f, values.get("loop.window", scenario.window))
        changes["loop__t_end"] = t_f + after
    return changed(scenario, **changes)


def _with_common_clock(parts: list[Parts]) -> Callable[[Parts], Parts]:
    """Return a function that gives all parts clocks of equal size and equally many substeps.

    One compiled program then simulates all of them.
    """
    substeps, clocks = max(p.substeps for p in parts), [p.clock for p in parts]
    return lambda one: replace(one, clock=one.clock.long_enough_for(clocks), substeps=substeps)


def _cell(x: float, y: float, ready: Study, common: Callable[[Parts], Parts], seed: int, trials: int) -> Cell:
    count = judging.trials_of(ready, trials)
    parts = common(ready.parts)
    simulated = montecarlo.run(parts, ready.dispersion, seed, np.arange(count))
    done, counts = simulated.finished, simulated.counts()
    errors, peaks = simulated.metrics.window_error[done], simulated.metrics.peak_torque[done]
    figures: dict[str, float] = {}
    if done.any():
        figures = {
            "window_error": float(trust.rms(errors)),
            "peak_torque": float(np.mean(peaks)),
            "largest_peak_torque": float(peaks.max()),
        }
    # substeps rounded up to a power of two, so that the cells share few compiled programs of the margins
    parts = replace(parts, substeps=1 << (ready.parts.substeps - 1).bit_length())
    if ready.scenario.sampled:
        ends = run_margins.at_ends(parts)
        for prefix, (left, radius) in (("", ends["hand_over"]), ("hold_", ends["hold"])):
            # Gain margin of the worst axis as a factor. If the loop is unstable, the factor is below 1. The nearest
            # stability limit is then at this gain factor or at its inverse.
            figures[f"{prefix}gain_margin"] = float(10.0 ** (left.gain_up.min() / 20.0))
            figures[f"{prefix}delay_margin"] = float(left.delay.min())
            figures[f"{prefix}radius"] = radius
        # the prediction has been compared with simulated trials for the prescribed-time law only
        if parts.controller.prescribed and covariance.predicts(parts) and figures["radius"] < 1.0 + margins.NEUTRAL:
            expected = covariance.noise(parts)
            if expected.converged:
                figures |= {"linear_window_error": expected.window_error, "linear_torque": expected.torque}
    return Cell(x, y, "simulated", count, int(np.sum(~done)), counts["not_converged"], **figures)


def lines(scenario: Scenario, x: Axis, y: Axis) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the stability limits of the frozen loop at the hand-over in a map of period and delta, by label.

    Args:
        scenario: the scenario of the map.
        x: the horizontal axis.
        y: the vertical axis.

    Returns:
        Coordinates x (points,) and y (points,) of each curve [s], see `stability_limits.smallest_delta`. The result is
        empty for other keys, for other laws, and for plants whose order is not 2.
    """
    papers_loop = scenario.sampled and scenario.controller.law.prescribed and scenario.order == 2
    if {x.key, y.key} != {PERIOD, DELTA} or not papers_loop:
        return {}
    eta, delay = scenario.controller.eta, scenario.devices.delay_periods
    h = np.asarray(x.values if x.key == PERIOD else y.values)
    anchored = scenario.loop.clock == "anchored"
    implicit, formula = scenario.controller.implicit, f"$\\delta = (\\eta - {3 if anchored else 1}/2) h$"
    # without delay, implicit sampling has no stability limit; the limit of explicit sampling is drawn instead
    without = f"{formula}, of explicit sampling only" if implicit else formula
    delayed = "with {} of delay" if implicit else "the same with {} of delay"
    delays = {without: 0.0, delayed.format("a period"): 1.0}
    if delay > 1:
        delays[delayed.format(f"{delay} periods")] = float(delay)
    drawn = {}
    for label, periods in delays.items():
        how = {"anchored": anchored, "implicit": implicit and periods > 0.0}
        delta = np.array([stability_limits.smallest_delta(eta, float(period), periods, **how) for period in h])
        drawn[label] = (h, delta) if x.key == PERIOD else (delta, h)
    return drawn


def spillover(simulated: Map) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the stability limits of a loop with flexible modes, which the law does not model, by label.

    Each curve is the contour where the spectral radius of the frozen loop is 1, at the hand-over or in the hold phase.

    Returns:
        Coordinates x (points,) and y (points,) of each curve; NaN separates its pieces. Empty without flexible modes.
    """
    if getattr(simulated.scenario, "flexible", None) is None:
        return {}
    axes = simulated.x, simulated.y
    across, up = (np.log(one.values) if one.logarithmic else np.asarray(one.values) for one in axes)
    drawn = {}
    labels = {"radius": "stability limit by linear theory, at the hand-over", "hold_radius": "the same in hold"}
    for name, label in labels.items():
        grid = simulated.grid(name)
        off = np.ma.masked_invalid(np.log(np.where(grid > 0.0, grid, np.nan)))
        pieces: Any = contour_generator(across, up, off).lines(margins.NEUTRAL)
        if pieces:
            points = np.concatenate([np.vstack([piece, [[np.nan, np.nan]]]) for piece in pieces])
            drawn[label] = tuple(np.exp(v) if one.logarithmic else v for one, v in zip(axes, points.T, strict=True))
    return drawn


def _label(scenario: Scenario, key: str) -> str:
    """Return a key with its unit from the schema of its table; without a unit if the scenario has no such table."""
    table, _, name = key.partition(".")
    found = getattr(scenario, table, None)
    known = [] if found is None else keys.list_keys(type(found), scenario.unit_of_d)
    unit = next((one.unit for one in known if one.name == name.partition("[")[0]), "")
    return f"{key} [{unit}]" if unit else key


def write(folder: Path, simulated: Map, seed: int, figures: bool) -> None:
    """Write a result folder: `map.csv` and figures.

    Args:
        folder: an empty folder.
        simulated: the results.
        seed: seed of dispersions and noise.
        figures: write figures too.
    """
    scenario, x, y, cells = simulated.scenario, simulated.x, simulated.y, simulated.cells
    trials = max((cell.trials for cell in cells), default=0)
    made_by = {"command": "map", "seed": seed, "x": x.text, "y": y.text, "trials": trials, **custom.checksums(scenario)}
    store.record(folder, parsing.dump(scenario), made_by)
    fields = [name for name in Cell.__dataclass_fields__ if name not in ("x", "y")]
    cells_of = ((cell.x, cell.y, *(getattr(cell, name) for name in fields)) for cell in cells)
    rows = [["" if value != value else value for value in row] for row in cells_of]
    store.write_csv(folder / "map.csv", [x.key, y.key, *fields], rows)
    if figures:
        names = ("window_error", "linear_window_error", "peak_torque", "largest_peak_torque")
        grids = {name: simulated.grid(name) for name in names}
        if not any(np.isfinite(grid).any() for grid in grids.values()):
            return  # every trial of every pair failed, so that there is nothing to plot
        across, up = (study_plots.MapAxis(_label(scenario, one.key), one.values, one.logarithmic) for one in (x, y))
        drawn = study_plots.accuracy_map(
            across,
            up,
            grids,
            simulated.grid("failures") + simulated.grid("not_converged") > 0,
            lines(scenario, x, y) | spillover(simulated),
            scenario.plant.kind,
        )
        style.save({"map": drawn}, folder / "figures")
