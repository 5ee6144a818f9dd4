"""Propose the torque profile whose log determines the free parameters best. Start with `design`.

The momentum about each axis is a sum of sines that are zero at both ends, so that the manoeuvre goes from rest to rest.
Its amplitudes maximise log det of the Fisher information, within the limits of torque, rate and wheel momentum.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np
import polars as pl

from ptsmc_jax.campaigns import runs
from ptsmc_jax.identification import estimation, parameters
from ptsmc_jax.identification.estimation import Search
from ptsmc_jax.identification.parameters import Problem
from ptsmc_jax.identification.telemetry import Measurements
from ptsmc_jax.scenario import reading
from ptsmc_jax.scenario.errors import ScenarioError, show
from ptsmc_jax.scenario.tables import Scenario

HALF_WAVES = (1, 2, 3, 4, 6, 8)  # numbers of half waves of the sines in the manoeuvre
CANDIDATES, REFINEMENTS = 24, 40  # random profiles, and changes of the best one
# by default the manoeuvre lasts 5 t_f, and the largest rate is 3 rad / t_f, as in a slew of about 90 deg within t_f
DURATION_IN_TIMES, RATE_TIMES_TIME = 5.0, 3.0


@dataclass(frozen=True)
class Design:
    """A proposed manoeuvre and the expected accuracy."""

    problem: Problem
    duration: float  # [s]
    rate: float  # limit of the rate about an axis [rad/s]
    torque: float  # limit of the torque about an axis [N m]
    frame: pl.DataFrame  # t [s], sent1.. [N m] and the expected readings, with the columns of `trajectory.csv`
    std: np.ndarray  # expected 1 sigma of each number (k,)
    plain_std: np.ndarray  # expected 1 sigma (k,) after one slew about each axis in turn, within the same limits
    undetermined: list[str]

    def table(self) -> pl.DataFrame:
        """Return a row for each number: value, expected 1 sigma, 1 sigma after one slew about each axis, unit."""
        numbers = self.problem.numbers(np.zeros(self.problem.size))
        return pl.DataFrame({
            "parameter": self.problem.labels, "value": numbers, "expected_std": self.std, "plain_std": self.plain_std,
            "unit": self.problem.units,
        })  # fmt: skip


def design(
    what: Scenario | str | Path,
    duration: float | None = None,
    *,
    rate: float | None = None,
    torque: float | None = None,
    report: Callable[[str], None] = lambda text: None,
) -> Design:
    """Return the profile of commanded torque that determines the free parameters best.

    Args:
        what: a scenario, or the path of its file. [identify] names the parameters, [hardware] the noises.
        duration: duration of the manoeuvre [s]; by default 5 t_f.
        rate: largest rate about an axis [rad/s]; for other plants, the largest velocity; by default 3 / t_f.
        torque: largest torque about an axis [N m]; by default the limit of the actuators.
        report: function that is called with a line of progress.

    Raises:
        ScenarioError: no limit of the torque is known, or the manoeuvre is shorter than 20 control periods.
    """
    loaded = reading.complete(reading.to_scenario(what))
    period, t_f = loaded.loop.period, float(loaded.controller.t_f)
    length = DURATION_IN_TIMES * t_f if duration is None else duration
    largest_rate = RATE_TIMES_TIME / t_f if rate is None else rate
    if not loaded.sampled:
        raise ScenarioError(f"loop.mode is {show(loaded.loop.mode)}, but a design needs the sampled loop")
    if length < 20.0 * period:
        raise ScenarioError(
            f"the duration is {length:g} s, but must be at least 20 control periods, {20.0 * period:g} s"
        )
    t = period * np.arange(round(length / period) + 1)
    shapes = np.stack([np.sin(np.pi * k * t / t[-1]) for k in HALF_WAVES])  # (waves, rows) for unit amplitudes
    log = _log_at_rest(loaded, t)
    problem = parameters.build(loaded, [log])
    largest_torque = _smallest_torque_limit(loaded, torque)
    scale_momentum = _momentum_scaler(loaded, problem, largest_rate, largest_torque)
    search = Search(problem, [], np.inf, lambda text: None)

    def information(momentum: np.ndarray) -> tuple[np.ndarray, Measurements]:
        command = np.append(np.diff(momentum, axis=0) / period, np.zeros((1, momentum.shape[1])), axis=0)
        expected = _predict_readings(problem, search, log._replace(command=command))
        return search.derivatives(np.zeros(problem.size), [estimation.prepare_log(problem, expected)])[2], expected

    def log_determinant(momentum: np.ndarray) -> float:
        eigenvalues = np.linalg.eigvalsh(information(momentum)[0])
        return float(np.sum(np.log(np.maximum(eigenvalues, 1e-12))))

    inputs = log.command.shape[1]
    plain_momentum = scale_momentum(_slew_each_axis(t, inputs))
    best, amplitudes = log_determinant(plain_momentum), None
    chosen, random = plain_momentum, np.random.default_rng(0)
    for k in range(CANDIDATES + REFINEMENTS):
        if amplitudes is None or k < CANDIDATES:
            candidate = random.standard_normal((inputs, len(HALF_WAVES)))
        else:
            candidate = amplitudes + 0.5 * np.std(amplitudes) * random.standard_normal(amplitudes.shape)
        momentum = scale_momentum((candidate @ shapes).T)
        value = log_determinant(momentum)
        if value > best:
            best, amplitudes, chosen = value, candidate, momentum
        report(f"profile {k + 1} of {CANDIDATES + REFINEMENTS}: log det of the information {best:.5g}")
    by_z = problem.derivatives(np.zeros(problem.size))

    def number_std(information: np.ndarray) -> np.ndarray:
        return np.sqrt(np.diag(by_z @ estimation.covariance(information) @ by_z.T))

    best_information, expected = information(chosen)
    return Design(
        problem,
        length,
        largest_rate,
        largest_torque,
        _to_frame(expected),
        number_std(best_information),
        number_std(information(plain_momentum)[0]),
        estimation.describe_undetermined(problem, best_information - np.diag(search.prior_weight), by_z),
    )


def _smallest_torque_limit(loaded: Scenario, torque: float | None) -> float:
    """Return the smallest of a limit and those of the actuators [N m]; raise ScenarioError if there is none."""
    wheels = loaded.reaction_wheels
    limits = [torque, loaded.devices.torque_limit, None if wheels is None else wheels.torque_limit]
    known = [limit for limit in limits if limit is not None]
    if not known:
        raise ScenarioError(
            "hardware.torque_limit is absent, but a design needs the largest torque; allowed is --torque too"
        )
    return min(known)


def _momentum_scaler(
    loaded: Scenario, problem: Problem, rate: float, torque: float
) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that scales a momentum profile (rows, m) [N m s] to 95 % of the tightest limit.

    The limits are those of torque, rate and wheel momentum.
    """
    wheels, plant, actuators = loaded.reaction_wheels, problem.model.plant, problem.model.actuators
    allocation = np.eye(plant.inputs) if actuators.wheels is None else np.asarray(actuators.wheels.allocation)
    wheel_limit = np.inf if wheels is None or wheels.momentum_limit is None else wheels.momentum_limit

    def scale(momentum: np.ndarray) -> np.ndarray:
        command = np.diff(momentum, axis=0) / loaded.loop.period
        ratios = [
            np.max(np.abs(command)) / torque,
            np.max(np.abs(command @ allocation.T)) / torque,
            np.max(np.abs(momentum @ np.asarray(plant.inertia_inverse).T)) / rate,
            np.max(np.abs(momentum @ allocation.T)) / wheel_limit,
        ]
        return momentum * (0.95 / max(ratios))

    return scale


def _slew_each_axis(t: np.ndarray, inputs: int) -> np.ndarray:
    """Return the momentum of one slew about each axis, one after another."""
    slew_time = t[-1] / inputs
    momentum = np.zeros((len(t), inputs))
    for k in range(inputs):
        is_slew = (t >= k * slew_time) & (t < (k + 1) * slew_time)
        momentum[is_slew, k] = np.sin(np.pi * (t[is_slew] - k * slew_time) / slew_time) ** 2
    return momentum


def _log_at_rest(loaded: Scenario, t: np.ndarray) -> Measurements:
    """Return a synthetic log of a plant at rest, with readings at the sample times of the scenario's sensors."""
    if loaded.plant.kind != "spacecraft":
        x = np.tile(np.asarray(loaded.plant.x0, float), (len(t), 1))
        return Measurements("design", t, {"x": x}, np.zeros((len(t), loaded.inputs)))
    q = np.tile([0.0, 0.0, 0.0, 1.0], (len(t), 1))
    reading_interval = max(1, round(loaded.devices.interval(loaded.loop.period) / loaded.loop.period))
    q[np.arange(len(t)) % reading_interval != 0] = np.nan
    return Measurements("design", t, {"attitude": q, "rate": np.zeros((len(t), 3))}, np.zeros((len(t), 3)))


def _predict_readings(problem: Problem, search: Search, log: Measurements) -> Measurements:
    """Return the log with readings without noise, predicted from the first row with the scenario's parameters.

    Args:
        problem: the model and its parameters.
        search: runs the filter, without readings after the first row.
        log: times, commands, first readings, and which readings exist.
    """
    rows, kind = estimation.prepare_log(problem, log)
    without_readings = rows._replace(valid=np.concatenate([rows.valid[:1], np.zeros_like(rows.valid[1:])]))
    _, track = search.run_filter(np.zeros(problem.size), (without_readings, kind))
    sampled = rows.log_row[1:] >= 0
    x = jax.tree.map(lambda v: v[sampled], track.x)
    readings = dict(log.readings)
    if "x" in readings:
        readings["x"] = np.concatenate([readings["x"][:1], np.asarray(jax.vmap(problem.model.plant.visible)(x))])
    else:
        has_attitude = ~np.isnan(readings["attitude"][:, :1])
        q = np.concatenate([readings["attitude"][:1], x.q])
        readings = {"attitude": np.where(has_attitude, q, np.nan), "rate": np.concatenate([readings["rate"][:1], x.w])}
    return log._replace(readings=readings)


def _to_frame(log: Measurements) -> pl.DataFrame:
    """Return a simulated log as a table of telemetry: t, measured_.. and sent."""
    names = {"attitude": "measured_q", "rate": "measured_w", "x": "measured_x"}
    blocks = {**{names[name]: values for name, values in log.readings.items()}, "sent": log.command}
    return pl.DataFrame({"t": log.t, **runs.numbered_columns(blocks)})
