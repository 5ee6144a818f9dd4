"""`ptsmc map`: accuracy, peak torque and stability margins over a grid of values for two scenario keys.

Each pair of values is simulated. Linear covariance analysis and the poles of the frozen loop give the predictions of
linear theory. Read `simulate` first.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from contourpy import contour_generator

from ptsmc_jax import units
from ptsmc_jax.campaigns import margin_verdicts, montecarlo, store
from ptsmc_jax.figures import study_plots, style
from ptsmc_jax.scenario import Study, custom, errors, keys, parsing, study, tables
from ptsmc_jax.scenario import replace as replace_keys
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.sensor_tables import SensorSuite
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation import requirements
from ptsmc_jax.simulation.rollout import Parts
from ptsmc_jax.theory import covariance, margins, run_margins, stability_limits
from tuning.errors import UsageError
from tuning.search import trust
from tuning.studies import judging

PERIOD, DELTA = "loop.period", "controller.delta"
WHOLE_NUMBERS = ("hardware.delay", "hardware.star_tracker_every")
LOGARITHMIC_SPAN = 5.0  # axes that span more than this factor are logarithmic


@dataclass(frozen=True)
class Axis:
    """A key of the scenario and the values that it takes."""

    key: str
    values: tuple[float, ...]
    text: str  # the value of the option, see `parse_axis`

    @property
    def logarithmic(self) -> bool:
        """Whether the axis is logarithmic."""
        return self.values[0] > 0 and self.values[-1] > LOGARITHMIC_SPAN * self.values[0]


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
    gain_margin: float = np.nan  # gain margin at the hand-over [dB]
    delay_margin: float = np.nan  # delay margin at the hand-over [s]
    hold_gain_margin: float = np.nan  # gain margin in the hold phase [dB]
    hold_delay_margin: float = np.nan  # delay margin in the hold phase [s]
    hold_radius: float = np.nan  # spectral radius of the frozen loop in the hold phase [-]
    meets: float = np.nan  # whether the pair keeps every requirement, 1 or 0; NaN without requirements
    not_met: str = ""  # names of the requirements that the pair does not keep, separated by spaces


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


def parse_axis(text: str, option: str, scenario: Scenario) -> Axis:
    """Parse an axis from KEY=LOW:HIGH:COUNT, such as controller.delta=0.05:3:9.

    The values have equal ratios if HIGH exceeds `LOGARITHMIC_SPAN` times LOW, otherwise equal differences. KEY[0]
    selects one element of a key with several numbers. LOW and HIGH are in the unit of the key, or have another unit.
    Raises UsageError if the text is invalid.

    Args:
        text: value of the option.
        option: name of the option in error messages, "--x" or "--y".
        scenario: the scenario of the map, which has the units of the keys.
    """
    key, _, span = text.partition("=")
    parts = span.split(":")
    examples = "controller.delta=0.05:3:9 or observer.gain[0]=5:10:3"
    message = f"{option} is {text}, but must be KEY=LOW:HIGH:COUNT, such as {examples}"
    if re.fullmatch(r"\w+", key):
        message += f"; {parsing.nearest_keys_hint(key, scenario.plant.kind)}"
    is_possible = re.fullmatch(r"\w+\.\w+(\[\d+\])?", key)
    if "." in key and not is_possible:
        message += ". KEY must be TABLE.KEY or TABLE.KEY[0]: a map cannot vary [[sensors]], [dispersion] or matrices"
    if len(parts) != 3 or not is_possible:
        raise UsageError(message)
    unit = unit_of(scenario, key)
    if unit in units.EXAMPLES:
        message += f", with numbers in {unit} or with a unit such as {units.EXAMPLES[unit]}"
    try:
        low, high, count = units.to_number(parts[0], unit), units.to_number(parts[1], unit), int(parts[2])
    except ValueError:
        raise UsageError(message) from None
    if not (np.isfinite(low) and np.isfinite(high) and low < high and 2 <= count <= 100):
        raise UsageError(f"{message}, with LOW below HIGH and COUNT from 2 to 100")
    spacing = np.geomspace if Axis(key, (low, high), text).logarithmic else np.linspace
    values = spacing(low, high, count)
    if key in WHOLE_NUMBERS:
        values = np.round(values)
    distinct = tuple(dict.fromkeys(float(f"{v:.6g}") for v in values))
    if len(distinct) < 2:  # a map needs at least two values
        needed = "two whole numbers" if key in WHOLE_NUMBERS else "two values that differ in six digits"
        raise UsageError(f"{message}, with {needed} between LOW and HIGH at least")
    return Axis(key, distinct, text)


def default_period_axis(scenario: Scenario) -> str:
    """Return the default x axis: control periods from 0.4 to 10 times the scenario's period."""
    period = scenario.loop.period
    return f"{PERIOD}={0.4 * period:.4g}:{10.0 * period:.4g}:9"


def default_gain_axis(scenario: Scenario) -> str:
    """Return the default y axis: delta from one period to t_f / 7.

    The range is extended to include the scenario's delta, and up to twice this delta. For a law without delta, the axis
    is the law's first gain over its default bounds.
    """
    if not hasattr(scenario.controller, "delta"):
        bounds = replace_keys(scenario, tune={}).search.bounds
        gain = next(name for name in scenario.controller.gains if name in bounds)
        low, high = bounds[gain]
        return f"controller.{gain}={low:.4g}:{high:.4g}:9"
    delta, shortest = scenario.hand_over, scenario.loop.period
    longest = max(scenario.controller.t_f / 7.0, 2.0 * delta)
    return f"{DELTA}={min(delta, shortest):.4g}:{longest:.4g}:9"


def simulate(scenario: Scenario, x: Axis, y: Axis, seed: int, trials: int, report: Callable[[int, int], None]) -> Map:
    """Simulate the scenario's trials for every pair of values.

    Args:
        scenario: the scenario.
        x: the horizontal axis.
        y: the vertical axis.
        seed: seed of dispersions and noise.
        trials: number of trials for each pair; 1 is used if all trials are equal.
        report: called with the number of finished cells and the number of all cells.

    Returns:
        The map. A pair that is not a valid scenario has the error message as its status.

    Raises:
        ScenarioError: no pair is a valid scenario.
    """
    if PERIOD in (x.key, y.key):
        scenario.require_sampled_loop(PERIOD)
    base = _with_explicit_gains(replace_keys(scenario, tune=None))  # the bounds in [tune] may be invalid for some pairs
    pairs = [(a, b) for b in y.values for a in x.values]
    studies: list[Study | str] = []
    for a, b in pairs:
        try:
            studies.append(study(_with_keys(base, {x.key: a, y.key: b})))
        except ScenarioError as error:
            studies.append(str(error))
    valid = [candidate for candidate in studies if isinstance(candidate, Study)]
    if not valid:
        raise ScenarioError(str(studies[0]))
    # one compiled program simulates all pairs, with clocks of equal size and equally many substeps
    substeps = max(candidate.parts.substeps for candidate in valid)
    clocks = [candidate.parts.clock for candidate in valid]
    cells = []
    for k, ((a, b), candidate) in enumerate(zip(pairs, studies, strict=True)):
        if isinstance(candidate, str):
            cells.append(Cell(a, b, candidate))
        else:
            clock = candidate.parts.clock.long_enough_for(clocks)
            parts = replace(candidate.parts, clock=clock, substeps=substeps)
            cells.append(_simulate_pair(a, b, candidate, parts, seed, trials))
        report(k + 1, len(pairs))
    return Map(scenario, x, y, cells)


def _with_explicit_gains(scenario: Scenario) -> Scenario:
    """Return the scenario with explicit values of its default gains, so that other keys do not change them.

    t_f and the corner of the command filter are left out: their defaults are constants.
    """
    stated = {
        f"{where}__{name.removeprefix(table.prefix)}": getattr(table, name.removeprefix(table.prefix))
        for where, table in scenario.tuned_tables.items()
        for name in table.gains
        if "." not in where and name != "t_f"
    }
    return replace_keys(scenario, **{key: value for key, value in stated.items() if value is not None})


def _with_keys(scenario: Scenario, values: dict[str, float]) -> Scenario:
    """Return the scenario with new values of some keys.

    If a key has a number for each axis or mode, all of them get the value. A key with an index, such as
    flexible.frequency[0], changes one of them.

    Raises:
        ScenarioError: the scenario is not valid, the key has rows of numbers, or all moments of inertia would be equal.
    """
    changes: dict[str, object] = {}
    for key, value in values.items():
        table, _, name = key.partition(".")
        name, _, index = name.partition("[")
        current = changes.get(f"{table}__{name}", getattr(getattr(scenario, table, None), name, None))
        new_value: object = int(value) if key in WHOLE_NUMBERS else value
        number = index.removesuffix("]")
        if number and int(number) >= (len(current) if isinstance(current, tuple | list) else 0):
            shown = "absent" if current is None else errors.brief(current)
            raise ScenarioError(f"{key} does not exist: {table}.{name} is {shown}")
        if isinstance(current, tuple | list):
            is_inertia = f"{table}.{name}" in ("spacecraft.inertia", "spacecraft.true_inertia")
            if any(isinstance(element, tuple | list) for element in current):
                allowed = "a number or a list of numbers" + ", such as three principal moments" * is_inertia
                raise ScenarioError(f"{table}.{name} has rows of numbers, but a map changes only {allowed}")
            if is_inertia and not number:
                allowed = ", ".join(f"{key}[{k}]" for k in range(len(current)))
                raise ScenarioError(f"{key} has three moments, but a map changes only one; allowed are {allowed}")
            new_value = [value if not number or k == int(number) else element for k, element in enumerate(current)]
        changes[f"{table}__{name}"] = new_value
    if "loop.t_end" not in values and {"controller.t_f", "loop.window"} & set(values):  # keep t_end - t_f
        t_f = values.get("controller.t_f", scenario.controller.t_f)
        after = max(scenario.end - scenario.controller.t_f, values.get("loop.window", scenario.window))
        changes["loop__t_end"] = t_f + after
    return replace_keys(scenario, **changes)


def _simulate_pair(x: float, y: float, ready: Study, parts: Parts, seed: int, trials: int) -> Cell:
    """Return the results of a pair of values; parts: the parts of `ready` on the clock of all pairs."""
    count = judging.count_needed_trials(ready, trials)
    simulated = montecarlo.run(parts, ready.dispersion, seed, np.arange(count))
    finished, counts = simulated.finished, simulated.counts()
    errors, peaks = simulated.metrics.window_error[finished], simulated.metrics.peak_torque[finished]
    results: dict[str, Any] = {}
    if finished.any():
        results = {
            "window_error": float(trust.rms(errors)),
            "peak_torque": float(np.mean(peaks)),
            "largest_peak_torque": float(peaks.max()),
        }
    # substeps rounded up to a power of two, so that the cells share few compiled programs of the margins
    parts = replace(parts, substeps=1 << (ready.parts.substeps - 1).bit_length())
    if ready.requirements or ready.margins:
        # the trials are too few for a confidence
        on_trials = [replace(requirement, confidence=None) for requirement in ready.requirements]
        verdicts = requirements.verdicts(on_trials, lambda name: getattr(simulated.metrics, name), finished)
        verdicts += margin_verdicts.judge_loop(parts, ready.margins, finished=bool(finished.all()))
        results["meets"] = int(judging.meets_requirements(verdicts, simulated))
        results["not_met"] = " ".join(verdict.metric for verdict in verdicts if not verdict.met)
    if ready.scenario.sampled:
        ends = run_margins.margins_at_ends(parts)
        for prefix, (axis_margins, radius) in (("", ends["hand_over"]), ("hold_", ends["hold"])):
            worst = axis_margins.worst()
            results |= {f"{prefix}{name}": float(worst[name]) for name in ("gain_margin", "delay_margin")}
            results[f"{prefix}radius"] = radius
        # the prediction has been compared with simulated trials for the prescribed-time law only
        if (
            parts.controller.prescribed
            and covariance.is_applicable(parts)
            and results["radius"] < 1.0 + margins.CIRCLE_TOLERANCE
        ):
            prediction = covariance.propagate_noise(parts)
            if prediction.converged:
                results |= {"linear_window_error": prediction.window_error, "linear_torque": prediction.torque}
    return Cell(x, y, "simulated", count, int(np.sum(~finished)), counts["not_converged"], **results)


def stability_limit_formulas(scenario: Scenario, x: Axis, y: Axis) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the stability limits of the frozen loop at the hand-over in a map of period and delta, by label.

    Args:
        scenario: the scenario of the map.
        x: the horizontal axis.
        y: the vertical axis.

    Returns:
        Coordinates x (points,) and y (points,) of each curve [s], see `stability_limits.smallest_delta`. The result is
        empty for other keys, for other laws, and for plants whose order is not 2. It is also empty for a loop with a
        lag, a filter or flexible modes, which the formula ignores.
    """
    devices = scenario.devices
    has_lag = devices.torque_lag or devices.command_filter or scenario.estimator.on
    is_ideal = not has_lag and getattr(scenario, "flexible", None) is None
    has_formula = scenario.sampled and scenario.controller.law.prescribed and scenario.order == 2 and is_ideal
    if {x.key, y.key} != {PERIOD, DELTA} or not has_formula:
        return {}
    eta, delay = scenario.controller.eta, scenario.devices.delay_periods
    h = np.asarray(x.values if x.key == PERIOD else y.values)
    anchored = scenario.loop.clock == "anchored"
    implicit = scenario.controller.implicit
    formula = f"stability limit $\\delta = (\\eta - {3 if anchored else 1}/2) h$" + ", without delay" * (delay > 0)
    # without delay, implicit sampling has no stability limit; the limit of explicit sampling is drawn instead
    label_without_delay = f"{formula}, of explicit sampling only" if implicit else formula
    label_with_delay = "stability limit with {} of delay"
    delays = {label_without_delay: 0.0, label_with_delay.format("a period"): 1.0}
    if delay > 1:
        delays[label_with_delay.format(f"{delay} periods")] = float(delay)
    curves = {}
    for label, periods in delays.items():
        options = {"anchored": anchored, "implicit": implicit and periods > 0.0}
        delta = np.array([stability_limits.smallest_delta(eta, float(period), periods, **options) for period in h])
        curves[label] = (h, delta) if x.key == PERIOD else (delta, h)
    return curves


def stability_limit_contours(simulated: Map) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return the stability limits of the linearised loop, with all of its devices and modes, by label.

    Each curve is the contour where the spectral radius of the frozen loop is 1, in the hold phase or, for a
    prescribed-time law, at the hand-over.

    Returns:
        Coordinates x (points,) and y (points,) of each curve; NaN separates its pieces.
    """
    axes = simulated.x, simulated.y
    x_values, y_values = (np.log(axis.values) if axis.logarithmic else np.asarray(axis.values) for axis in axes)
    curves = {}
    for name, phase in _radii(simulated.scenario).items():
        grid = simulated.grid(name)
        log_radius = np.ma.masked_invalid(np.log(np.where(grid > 0.0, grid, np.nan)))
        pieces: Any = contour_generator(x_values, y_values, log_radius).lines(margins.CIRCLE_TOLERANCE)
        if pieces:
            points = np.concatenate([np.vstack([piece, [[np.nan, np.nan]]]) for piece in pieces])
            curves[f"stability limit {phase}, linear theory"] = tuple(
                np.exp(v) if axis.logarithmic else v for axis, v in zip(axes, points.T, strict=True)
            )
    return curves


def describe_equal_stability(simulated: Map) -> str:
    """Return a text if all pairs of a map are stable, or all unstable; empty if both exist."""
    radius = np.max([simulated.grid(name) for name in _radii(simulated.scenario)], axis=0)
    stable = radius[np.isfinite(radius)] < 1.0 + margins.CIRCLE_TOLERANCE
    if not stable.size or (stable.any() and not stable.all()):
        return ""
    return f"{'all simulated pairs are' if stable.all() else 'no simulated pair is'} stable by linear theory"


def _radii(scenario: Scenario) -> dict[str, str]:
    """Return the fields of a cell with the spectral radii that decide the stability of a pair, a dict.

    Its values are the phases of these radii in words.
    """
    phases = {"radius": "at the hand-over"} if scenario.controller.law.prescribed else {}
    return phases | {"hold_radius": "in the hold phase"}


def label_with_unit(scenario: Scenario, key: str) -> str:
    """Return a key with its unit in brackets, if it has one."""
    unit = unit_of(scenario, key)
    return f"{key} [{unit}]" if unit else key


def unit_of(scenario: Scenario, key: str) -> str:
    """Return the unit of a key; empty if it has none, or if it is in a table whose kind the scenario does not state."""
    table, _, name = key.partition(".")
    declared, kinds = getattr(scenario, table, None), scenario.TABLES.get(table)
    struct = type(declared) if declared is not None else kinds
    if kinds is None or not isinstance(struct, type) or struct is SensorSuite:  # such as [requirements]
        return ""
    known_keys = keys.list_keys(struct, scenario.unit_of_d)
    return next((entry.unit for entry in known_keys if entry.name == name.partition("[")[0]), "")


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
    store.write_run_files(folder, parsing.dump(scenario), made_by)
    fields = [name for name in Cell.__dataclass_fields__ if name not in ("x", "y")]
    cells_of = ((cell.x, cell.y, *(getattr(cell, name) for name in fields)) for cell in cells)
    rows = [["" if value != value else value for value in row] for row in cells_of]
    keys_with_units = [label_with_unit(scenario, axis.key) for axis in (x, y)]
    store.write_csv(folder / "map.csv", [*keys_with_units, *fields], rows)
    if figures:
        names = ("window_error", "linear_window_error", "peak_torque", "largest_peak_torque")
        grids = {name: simulated.grid(name) for name in names}
        if not any(np.isfinite(grid).any() for grid in grids.values()):
            return  # every trial of every pair failed, so that there is nothing to plot
        x_axis, y_axis = (
            study_plots.MapAxis(label, axis.values, axis.logarithmic)
            for label, axis in zip(keys_with_units, (x, y), strict=True)
        )
        limit = tables.limit_of(scenario, "peak_torque")
        failed = simulated.grid("failures") + simulated.grid("not_converged") > 0
        figure = study_plots.accuracy_map(
            x_axis,
            y_axis,
            grids,
            failed,
            stability_limit_formulas(scenario, x, y) or stability_limit_contours(simulated),
            scenario.plant.kind,
            limit,
            (simulated.grid("meets") == 0) & ~failed,
            describe_equal_stability(simulated),
        )
        style.save({"map": figure}, folder / "figures")
