"""Results of an identification: identified scenario, summary, and verdict in words. Start with `summary`."""

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from ptsmc_jax.dispersions.numbers import pseudo_root
from ptsmc_jax.dispersions.quantities import PAIRS
from ptsmc_jax.identification import parameters
from ptsmc_jax.identification.estimation import LAGS, Fit, Identification
from ptsmc_jax.scenario import parsing, reading
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.signals import disturbances

FAR_FROM_PRIOR = 5.0  # distance of an estimate from its prior value that the verdict names, in sigmas of the prior
MAX_STD = 0.3  # largest 1 sigma of a relative dispersion in a scenario


def identified_scenario(identification: Identification) -> Scenario:
    """Return the scenario with the estimated parameters, and with their covariance in [dispersion].

    The design model of law and observer gets the estimated inertia. Correlations are kept inside the inertia only. Each
    other quantity gets the largest 1 sigma of its numbers. Parameters without a key in a scenario, such as the numbers
    of a custom plant, are left out.
    """
    tables, begin = parsing.stated_tables(identification.scenario), 0
    dispersion = dict(tables.get("dispersion", {}))
    for parameter in identification.problem.parameters:
        block = slice(begin, begin + len(parameter.labels))
        values, std = identification.estimate[block], identification.std[block]
        begin += len(parameter.labels)
        _write_estimate(tables, dispersion, parameter.name, values, std, identification)
    if dispersion:
        tables["dispersion"] = dispersion
    return reading.from_tables(tables, run=True)


def _write_estimate(
    tables: dict[str, Any],
    dispersion: dict[str, object],
    name: str,
    values: np.ndarray,
    std: np.ndarray,
    identification: Identification,
) -> None:
    """Write the estimate of one parameter into the tables, and its uncertainty into [dispersion]."""
    hardware = dict(tables.get("hardware", {}))
    relative = _relative_dispersion(std, values)
    numbers = [float(value) for value in values]
    if name == "inertia":
        entries = dict(zip(PAIRS, numbers, strict=True))
        tensor = [[entries[min(i, j), max(i, j)] for j in range(3)] for i in range(3)]
        body = {key: value for key, value in tables.get("spacecraft", {}).items() if key != "true_inertia"}
        tables["spacecraft"] = {**body, "inertia": tensor}
        dispersion["inertia"] = {"kind": "correlated", "factor": _inertia_factor(identification, np.array(tensor))}
    elif name in ("actuator_scale", "gyro_scale"):
        hardware[name], dispersion[name] = numbers, relative
    elif name in ("actuator_misalignment", "star_tracker_misalignment"):
        rotations = _misalignment_vectors(identification) if name == "actuator_misalignment" else values
        hardware[f"{name}_deg"] = np.rad2deg(rotations).tolist()
        dispersion[name] = {"kind": "normal", "std_deg": float(np.rad2deg(np.max(std)))}
    elif name == "delay":
        hardware["delay"] = max(0, round(numbers[0] / identification.scenario.loop.period))
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
            sizes = values if key == "frequency" else np.repeat(np.linalg.norm(modes, axis=1), 3)
            dispersion[name] = _relative_dispersion(std, sizes)
    elif name.startswith("disturbance_"):
        _write_disturbance(tables, dispersion, name, numbers, std, relative, identification)
    if hardware:
        tables["hardware"] = hardware


def _relative_dispersion(std: np.ndarray, values: np.ndarray) -> dict[str, object]:
    """Return the table of a relative dispersion: largest ratio of 1 sigma to the value, at most `MAX_STD`."""
    is_uncertain = std > 0.0  # a value of zero may be fixed
    largest = min(np.max(std[is_uncertain] / np.abs(values[is_uncertain]), initial=0.0), MAX_STD)
    return {"kind": "relative_normal", "std": float(largest)}


def _write_disturbance(
    tables: dict[str, Any],
    dispersion: dict[str, object],
    name: str,
    numbers: list[float],
    std: np.ndarray,
    relative: dict[str, object],
    identification: Identification,
) -> None:
    """Write the estimate of a disturbance into [disturbance], and its spread into [dispersion].

    Args:
        tables: tables of the scenario; [disturbance] changes. An estimated bias becomes an additional constant term.
        dispersion: table [dispersion], which changes.
        name: estimated parameter, such as "disturbance_amplitude".
        numbers: the estimates.
        std: 1 sigma of the estimates.
        relative: entry of [dispersion] if the parameter is an amplitude, see `_relative_dispersion`.
        identification: its scenario has the number of phases and amplitudes of each term.
    """
    table = dict(tables.get("disturbance", {}))
    terms = [dict(term) for term in table.get("terms", [])] or [table]
    if name == "disturbance_bias":
        terms = [*(term for term in terms if term.get("kind") != "none"), {"kind": "constant", "amplitude": numbers}]
        dispersion[name] = {"kind": "normal", "std": float(np.max(std))}
    else:
        quantity: Any = name.removeprefix("disturbance_")
        begin = 0
        scenario: Any = identification.scenario
        inertia = getattr(identification.problem.model.plant, "inertia", None)
        for term, part in zip(terms, scenario.terms, strict=False):  # an estimated bias may follow
            signal: Any = part.build(inertia, scenario)
            size = disturbances.values(signal, quantity).size
            if size:  # the key may be absent, with a default value
                is_list = size > 1 or isinstance(term.get(quantity), list)
                term[quantity] = numbers[begin : begin + size] if is_list else numbers[begin]
            begin += size
        if quantity == "amplitude":
            dispersion[name] = relative
        elif np.max(std) < 1.0 and not any(name in sentence for sentence in identification.undetermined):
            dispersion.pop(name, None)  # the phase is no longer random
    tables["disturbance"] = terms[0] if len(terms) == 1 else {"kind": "sum", "terms": terms}


def _inertia_factor(identification: Identification, tensor: np.ndarray) -> list[list[float]]:
    """Return the rows of a lower triangular factor of the covariance of the inertia's log-Cholesky coordinates."""
    first = identification.problem.labels.index("inertia_11")
    entry_covariance = identification.covariance[first : first + 6, first : first + 6]
    inverse = np.linalg.inv(parameters.inertia_derivatives(pseudo_root(tensor)))
    sizes, directions = np.linalg.eigh(inverse @ entry_covariance @ inverse.T)
    upper: Any = np.linalg.qr((directions * np.sqrt(np.maximum(sizes, 0.0))).T, mode="r")
    lower = upper.T * np.where(np.diag(upper) < 0.0, -1.0, 1.0)
    return [row[: k + 1].tolist() for k, row in enumerate(lower)]


def _misalignment_vectors(identification: Identification) -> np.ndarray:
    """Return the rotation vector of each channel (channels, 3) [rad] from its axis in the design model."""
    actuators = identification.problem.model_at(jnp.asarray(identification.z)).actuators
    axes = np.eye(3) if actuators.wheels is None else np.asarray(actuators.wheels.axes)
    cross = np.cross(axes.T, np.asarray(actuators.directions).T)
    sine = np.linalg.norm(cross, axis=1, keepdims=True)
    return cross * np.where(sine > 1e-12, np.arcsin(np.minimum(sine, 1.0)) / np.maximum(sine, 1e-12), 1.0)


def summary(identification: Identification) -> dict[str, Any]:
    """Return the content of `summary.json`."""
    return {
        "status": "identified" if identification.is_identified else "doubtful",
        "verdict": verdict(identification),
        "converged": identification.converged,
        "steps": identification.steps,
        "log_likelihood": identification.log_likelihood,
        "acceleration_noise": max(fit.acceleration_noise for fit in identification.fits),
        "variance_factor": identification.variance_factor,
        "parameters": list(identification.table().iter_rows(named=True)),
        "undetermined": identification.undetermined,
        "gyro_bias": [
            {"log": fit.log.name, "estimate": bias.tolist(), "std": std.tolist()}
            for fit, (bias, std) in zip(identification.fits, identification.gyro_bias(), strict=False)
        ],
        "logs": [_summarise_fit(fit) for fit in identification.fits],
        "validation": [_summarise_fit(fit) for fit in identification.validation],
    }


def _summarise_fit(fit: Fit) -> dict[str, object]:
    """Return the entry of `summary.json` about the fit of one log."""
    names = component_names(fit)
    rms = np.sqrt(np.nanmean(np.where(fit.innovations.accepted, fit.innovations.value, np.nan) ** 2, axis=0))
    largest = np.max(np.abs(fit.autocorrelation()), axis=0)
    return {
        "log": fit.log.name,
        "rows": len(fit.log.t),
        "duration": float(fit.log.t[-1]),
        "readings": fit.reading_count,
        "outliers": fit.outlier_count,
        "mean_square": fit.mean_square,
        "moved": fit.distance,
        "white": fit.is_white,
        "prediction_rms": dict(zip(names, map(float, rms), strict=True)),
        "largest_autocorrelation": dict(zip(names, map(float, largest), strict=True)),
    }


def component_names(fit: Fit) -> list[str]:
    """Return the name of each component of the innovations."""
    readings: Mapping[str, np.ndarray] = fit.log.readings
    if "x" in readings:
        return [f"x{k + 1}" for k in range(readings["x"].shape[1])]
    return [f"{name}_{axis}" for name in ("attitude", "rate") if name in readings for axis in "xyz"]


def innovations(fit: Fit) -> tuple[np.ndarray, np.ndarray]:
    """Return the innovations and their 1 sigma at all rows of the log except the first.

    They are NaN for missing readings and for outliers.
    """
    sampled = fit.rows.log_row[1:] >= 0
    value, variance, accepted = (part[sampled] for part in fit.innovations)
    return np.where(accepted, value, np.nan), np.where(accepted, np.sqrt(variance), np.nan)


def verdict(identification: Identification) -> list[str]:
    """Return sentences that state whether the model explains each log, and which parameters are not determined."""
    lines, problem = [], identification.problem
    dispersed = ", ".join(problem.dispersed)
    steps = [f"free {dispersed}, which [dispersion] varies" if dispersed else "free more parameters"]
    if any(parameter.name == "inertia" and parameter.size == 3 for parameter in problem.parameters):
        steps.append("set dispersion.inertia.axes_deg, without which the principal axes are those of the scenario")
    advice = ", ".join(steps)
    for fit in [*identification.fits, *identification.validation]:
        name = f"{fit.log.name} (validation)" if fit in identification.validation else fit.log.name
        details = f"mean square {fit.mean_square:.3g} of its expected value"
        if fit.adjusted is not None:
            details += f", for parameters {fit.distance:.2g} sigma from the estimates"
        if fit.is_white:
            lines.append(f"the model explains {name}: its innovations are white, with {details}")
        elif fit.acceleration_noise > 0.0:
            lines.append(
                f"the model does NOT explain {name}: estimates and intervals allow for a random acceleration; "
                f"{advice}, or add torque_walk to [identify]"
            )
        else:
            largest = float(np.max(np.abs(fit.autocorrelation())))
            lines.append(
                f"the model does NOT explain {name}: innovations with {details} and an autocorrelation of "
                f"{largest:.2g} within {LAGS} readings; {advice}, or add torque_walk to [identify]"
            )
        if fit.outlier_count:
            lines.append(f"{fit.outlier_count} readings of {name} are outliers and were not used")
    if identification.variance_factor > 1.0:
        widening = float(np.sqrt(identification.variance_factor))
        lines.append(f"the intervals are up to {widening:.3g} times as wide as for white innovations")
    lines += [*_noise_ratios(identification), *_far_estimates(identification)]
    if not identification.converged:
        lines.append("the search did NOT converge or was interrupted; its estimates are preliminary")
    return [*lines, *identification.undetermined]


def _noise_ratios(identification: Identification) -> list[str]:
    """Return a sentence with the ratio of each estimated noise to its value in the scenario.

    Innovations always fit an estimated noise. The verdict therefore does not detect a wrong value in the scenario.
    """
    problem = identification.problem
    names = [one.name for one in problem.parameters for _ in one.labels]
    ratios = [
        f"{label} {estimate / start:.3g}"
        for name, label, estimate, start in zip(
            names, problem.labels, identification.estimate, identification.start, strict=True
        )
        if name.endswith("_noise") and name not in problem.unknown_noises
    ]
    return [f"ratio of the estimated noise to its value in the scenario: {', '.join(ratios)}"] if ratios else []


def _far_estimates(identification: Identification) -> list[str]:
    """Return a sentence on the estimates that are more than `FAR_FROM_PRIOR` sigmas of the prior from the scenario.

    Phases are not compared, because every phase is equally likely.
    """
    changes, prior_std = np.abs(identification.estimate - identification.start), identification.prior_std
    distances = np.divide(changes, prior_std, out=np.zeros_like(changes), where=prior_std > 0.0)
    far = [
        f"{label} ({distance:.3g})"
        for label, distance in zip(identification.problem.labels, distances, strict=True)
        if distance > FAR_FROM_PRIOR and not label.startswith(parameters.PHASE)
    ]
    if not far:
        return []
    return [
        f"estimates are far from the scenario, in sigmas of [dispersion]: {', '.join(far)}; check the units and "
        "columns in [telemetry], the units of the scenario, and its model"
    ]
