"""Results of an identification: identified scenario, summary, and verdict in words. Start with `summary`."""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from ptsmc_jax.dispersions.quantities import PAIRS
from ptsmc_jax.identification import parameters
from ptsmc_jax.identification.estimation import LAGS, Fit, Identification
from ptsmc_jax.scenario import parsing, reading
from ptsmc_jax.scenario.tables import Scenario

LARGEST_STD = 0.3  # largest 1 sigma of a relative dispersion in a scenario


def identified(found: Identification) -> Scenario:
    """Return the scenario with the estimates, whose [dispersion] has their covariance.

    The design model of law and observer gets the estimated inertia. Correlations are kept inside the inertia only; each
    other quantity gets the largest 1 sigma of its numbers. Parameters that no key of a scenario holds, such as the
    numbers of a custom plant, are not in it.
    """
    tables, at = parsing.stated_tables(found.scenario), 0
    dispersion = dict(tables.get("dispersion", {}))
    for one in found.problem.parameters:
        block = slice(at, at + len(one.labels))
        values, std = found.estimate[block], found.std[block]
        at += len(one.labels)
        _put(tables, dispersion, one.name, values, std, found)
    if dispersion:
        tables["dispersion"] = dispersion
    return reading.from_tables(tables, run=True)


def _put(
    tables: dict[str, Any], dispersion: dict[str, Any], name: str, values: np.ndarray, std: np.ndarray, found: Any
) -> None:
    """Write the estimate of one parameter into the tables, and its uncertainty into [dispersion]."""
    hardware = dict(tables.get("hardware", {}))
    relative = _relative(std, values)
    numbers = [float(value) for value in values]
    if name == "inertia":
        entries = dict(zip(PAIRS, numbers, strict=True))
        tensor = [[entries[min(i, j), max(i, j)] for j in range(3)] for i in range(3)]
        body = {key: value for key, value in tables.get("spacecraft", {}).items() if key != "true_inertia"}
        tables["spacecraft"] = {**body, "inertia": tensor}
        dispersion["inertia"] = {"kind": "correlated", "factor": _inertia_factor(found, np.array(tensor))}
    elif name in ("actuator_scale", "gyro_scale"):
        hardware[name], dispersion[name] = numbers, relative
    elif name in ("actuator_misalignment", "star_tracker_misalignment"):
        turns = _turns(found) if name == "actuator_misalignment" else values
        hardware[f"{name}_deg"] = np.rad2deg(turns).tolist()
        dispersion[name] = {"kind": "normal", "std_deg": float(np.rad2deg(np.max(std)))}
    elif name == "delay":
        hardware["delay"] = round(numbers[0] / found.scenario.loop.period)
    elif name in ("torque_lag", "attitude_noise", "rate_noise"):
        hardware[name] = numbers[0]
        if name == "rate_noise":
            hardware.pop("rate_noise_density", None)
    elif name == "state_noise":
        hardware["state_noise"] = numbers
    elif name.startswith("mode_"):
        key = name.removeprefix("mode_")
        modes = np.array(numbers).reshape(-1, 3).tolist() if key == "coupling" else np.maximum(numbers, 0.0).tolist()
        tables["flexible"] = {**tables.get("flexible", {}), key: modes}
        if key != "damping":
            size = values if key == "frequency" else np.repeat(np.linalg.norm(modes, axis=1), 3)
            dispersion[name] = _relative(std, size)
    elif name.startswith("disturbance_"):
        _put_disturbance(tables, dispersion, name, numbers, std, relative)
    if hardware:
        tables["hardware"] = hardware


def _relative(std: np.ndarray, values: np.ndarray) -> dict[str, Any]:
    largest = min(np.max(std / np.abs(values), initial=0.0), LARGEST_STD)
    return {"kind": "relative_normal", "std": float(largest)}


def _put_disturbance(
    tables: dict[str, Any], dispersion: dict[str, Any], name: str, numbers: list[float], std: np.ndarray, relative: Any
) -> None:
    """Write the estimate of a disturbance into its terms; an added constant becomes an additional term."""
    table = dict(tables.get("disturbance", {}))
    terms = [dict(term) for term in table.get("terms", [])] or [table]
    if name == "disturbance_bias":
        terms = [*(term for term in terms if term.get("kind") != "none"), {"kind": "constant", "amplitude": numbers}]
        dispersion[name] = {"kind": "normal", "std": float(np.max(std))}
    else:
        key, at = name.removeprefix("disturbance_"), 0
        for term in terms:
            if key in term:
                size = len(term[key]) if isinstance(term[key], list) else 1
                term[key] = numbers[at : at + size] if isinstance(term[key], list) else numbers[at]
                at += size
        if key == "amplitude":
            dispersion[name] = relative
        else:
            dispersion.pop(name, None)  # the phase is no longer random
    tables["disturbance"] = terms[0] if len(terms) == 1 else {"kind": "sum", "terms": terms}


def _inertia_factor(found: Identification, tensor: np.ndarray) -> list[list[float]]:
    """Return the rows of a lower triangular factor of the covariance of the inertia's log-Cholesky coordinates."""
    at = found.problem.labels.index("inertia_11")
    of_entries = found.covariance[at : at + 6, at : at + 6]
    inverse = np.linalg.inv(parameters.by_coordinates(tensor))
    sizes, directions = np.linalg.eigh(inverse @ of_entries @ inverse.T)
    upper: Any = np.linalg.qr((directions * np.sqrt(np.maximum(sizes, 0.0))).T, mode="r")
    lower = upper.T * np.where(np.diag(upper) < 0.0, -1.0, 1.0)
    return [row[: k + 1].tolist() for k, row in enumerate(lower)]


def _turns(found: Identification) -> np.ndarray:
    """Return the rotation vector of each channel (channels, 3) [rad] from its axis in the design model."""
    actuators = found.problem.at(jnp.asarray(found.z)).actuators
    axes = np.eye(3) if actuators.wheels is None else np.asarray(actuators.wheels.axes)
    cross = np.cross(axes.T, np.asarray(actuators.directions).T)
    sine = np.linalg.norm(cross, axis=1, keepdims=True)
    return cross * np.where(sine > 1e-12, np.arcsin(np.minimum(sine, 1.0)) / np.maximum(sine, 1e-12), 1.0)


def summary(found: Identification) -> dict[str, Any]:
    """Return the content of `summary.json`."""
    return {
        "status": "identified" if found.good else "doubtful",
        "verdict": verdict(found),
        "converged": found.converged,
        "steps": found.steps,
        "log_likelihood": found.log_likelihood,
        "parameters": [
            {name: None if isinstance(v, float) and not np.isfinite(v) else v for name, v in row.items()}
            for row in found.table().iter_rows(named=True)
        ],
        "undetermined": found.undetermined,
        "gyro_bias": [
            {"log": fit.log.name, "estimate": bias.tolist(), "std": std.tolist()}
            for fit, (bias, std) in zip(found.fits, found.gyro_bias(), strict=False)
        ],
        "logs": [_fit(fit) for fit in found.fits],
        "validation": [_fit(fit) for fit in found.validation],
    }


def _fit(fit: Fit) -> dict[str, Any]:
    names = components(fit)
    rms = np.sqrt(np.nanmean(np.where(fit.innovations.accepted, fit.innovations.value, np.nan) ** 2, axis=0))
    largest = np.max(np.abs(fit.autocorrelation()), axis=0)
    return {
        "log": fit.log.name,
        "rows": len(fit.log.t),
        "duration": float(fit.log.t[-1]),
        "readings": fit.samples,
        "outliers": fit.outliers,
        "mean_square": fit.square,
        "moved": fit.moved,
        "white": fit.white,
        "prediction_rms": dict(zip(names, map(float, rms), strict=True)),
        "largest_autocorrelation": dict(zip(names, map(float, largest), strict=True)),
    }


def components(fit: Fit) -> list[str]:
    """Return the name of each component of the innovations."""
    readings: Mapping[str, np.ndarray] = fit.log.readings
    if "x" in readings:
        return [f"x{k + 1}" for k in range(readings["x"].shape[1])]
    return [f"{name}_{axis}" for name in ("attitude", "rate") if name in readings for axis in "xyz"]


def innovations(fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Return the innovations and their 1 sigma at all rows of the log except the first.

    They are NaN for missing readings and for outliers.
    """
    sampled = fit.rows.source[1:] >= 0
    value, variance, accepted = (part[sampled] for part in fit.innovations)
    return np.where(accepted, value, np.nan), np.where(accepted, np.sqrt(variance), np.nan)


def verdict(found: Identification) -> list[str]:
    """Return in words whether the model explains the logs, and how well each parameter is known."""
    lines = []
    for fit in [*found.fits, *found.validation]:
        name = f"{fit.log.name} (validation)" if fit in found.validation else fit.log.name
        ends = f"mean square {fit.square:.3g} of its expected value"
        if fit.adjusted is not None:
            ends += f", for parameters {fit.moved:.2g} sigma from the estimates"
        if fit.white:
            lines.append(f"the model explains {name}: its innovations are white, with {ends}")
        else:
            largest = float(np.max(np.abs(fit.autocorrelation())))
            lines.append(
                f"the model does NOT explain {name}: innovations with {ends} and an autocorrelation of "
                f"{largest:.2g} within {LAGS} readings; free more parameters, or add torque_walk to [identify]"
            )
        if fit.outliers:
            lines.append(f"{fit.outliers} readings of {name} are outliers and were not used")
    if not found.converged:
        lines.append("the search did NOT converge; its estimates are preliminary")
    return [*lines, *found.undetermined]
