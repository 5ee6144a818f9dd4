"""Maximum-likelihood estimates of the free parameters of a scenario from telemetry. Start with `identify`.

The likelihood is that of the innovations of the filter. Fisher scoring finds its maximum, with the step control of
Levenberg and Marquardt. Each step solves (I + damping) step = gradient. The gradient is exact, and I is the Fisher
information of the innovations and their variances (Gupta and Mehra, IEEE Trans. Automatic Control 19(6), 1974). Both
come from the derivatives of the innovations in forward mode.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
from jaxtyping import Array
from scipy import stats

from ptsmc_jax import configure
from ptsmc_jax.campaigns import montecarlo
from ptsmc_jax.identification import filtering, parameters
from ptsmc_jax.identification.filtering import Innovations, Kind, Model, Rows, Track
from ptsmc_jax.identification.parameters import Problem
from ptsmc_jax.identification.telemetry import Measurements
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.tables import Scenario

BUCKET = 256  # rows of a log are padded to a multiple of it, so that similar logs share compiled programs
STEPS = 40  # largest number of steps of a local search
LONGEST_STEP = 3.0  # longest step of a local search, in sigmas of the prior
CONVERGED_WITH_NOISE = 0.3  # largest step that ends a search with noise on the acceleration, in sigmas of the estimate
CONVERGED = 1e-3  # largest step of a converged search, in sigmas of the estimate
SLACK = (0.3, 0.03, 0.003, 0.0003)  # noise of the acceleration in a search, relative to the acceleration [s^0.5]
SCREENINGS = 4  # largest number of times that outliers are determined again
POOR_FIT = 1.5  # median normalised square of innovations above which a search begins with noise
LAGS = 25  # number of lags of the autocorrelation
WHITE = 0.05  # largest autocorrelation that counts as white in a long log
CONSISTENT = (0.8, 1.25)  # mean normalised square of innovations that fit their variance, in a long log
RARE = 4.0  # in a short log, an autocorrelation or a mean square beyond this number of sigmas is a misfit
FARTHEST = 3.0  # distance of the most likely parameters of a validation log, RMS in sigmas of the estimates
CONFIDENCE = 0.95
CLEAR = 0.3  # smallest component of an undetermined direction that is named
Prepared = tuple[Rows, Kind]  # a log for the filter


@dataclass(frozen=True, eq=False)
class Fit:
    """Innovations of a log for estimated parameters.

    The estimates have errors that change the predictions of a validation log. `adjusted` are its innovations for the
    most likely parameters within the uncertainty of the estimates, and `moved` is their distance from the estimates.
    """

    log: Measurements
    rows: Rows
    innovations: Innovations  # arrays (rows - 1, components)
    track: Track
    adjusted: Innovations | None = None
    moved: float = 0.0  # distance of the most likely parameters from the estimates, RMS in sigmas

    @property
    def whitened(self) -> np.ndarray:
        """`adjusted` innovations, if available, divided by their 1 sigma (samples, components) [-]; NaN: no reading."""
        value, variance, accepted = self.innovations if self.adjusted is None else self.adjusted
        sampled = self.rows.source[1:] >= 0
        return np.where(accepted, value / np.sqrt(variance), np.nan)[sampled]

    @property
    def square(self) -> float:
        """Mean square of the whitened innovations [-]; 1 if they fit their variance."""
        return float(np.nanmean(self.whitened**2))

    @property
    def outliers(self) -> int:
        """The number of rejected components."""
        return int(np.sum(self.rows.valid[1:] & ~self.innovations.accepted))

    @property
    def samples(self) -> int:
        """The number of accepted components."""
        return int(np.sum(self.innovations.accepted))

    def autocorrelation(self) -> np.ndarray:
        """Return the autocorrelation (LAGS, components) [-] of the whitened innovations at the lags 1, 2, ..

        Lags are counted in readings of the component.
        """
        return np.stack([_autocorrelation(column[np.isfinite(column)]) for column in self.whitened.T], axis=1)

    @property
    def white(self) -> bool:
        """Whether the innovations fit their variance and are uncorrelated in time.

        A correct model fails in about 1 % of logs, since the LAGS autocorrelations of each component are compared.
        """
        readings = np.maximum(np.sum(np.isfinite(self.whitened), axis=0), 1)
        bound = np.maximum(WHITE, RARE / np.sqrt(readings))
        spread = RARE * np.sqrt(2.0 / np.sum(readings))  # of the mean square of normal random numbers
        consistent = min(CONSISTENT[0], 1.0 - spread) < self.square < max(CONSISTENT[1], 1.0 + spread)
        return consistent and self.moved < FARTHEST and bool(np.all(np.abs(self.autocorrelation()) < bound))


def _autocorrelation(values: np.ndarray) -> np.ndarray:
    if values.size <= LAGS:
        return np.zeros(LAGS)
    total = np.sum(values**2)
    return np.array([np.sum(values[lag:] * values[:-lag]) for lag in range(1, LAGS + 1)]) / total


@dataclass(frozen=True, eq=False)
class Identification:
    """Estimated parameters of a scenario."""

    scenario: Scenario
    problem: Problem
    z: np.ndarray  # estimated coordinates (n,)
    start: np.ndarray  # numbers of the scenario (k,)
    prior: np.ndarray  # prior 1 sigma of the numbers (k,), infinite without prior knowledge
    estimate: np.ndarray  # estimated numbers (k,), in their units
    covariance: np.ndarray  # covariance of the estimated numbers (k, k)
    undetermined: list[str]  # sentences on combinations that the data do not determine
    complete: bool  # whether data and prior knowledge together determine every combination
    fits: list[Fit]
    validation: list[Fit]
    converged: bool
    steps: int
    log_likelihood: float

    @property
    def std(self) -> np.ndarray:
        """1 sigma of the estimates (k,), in their units."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def white(self) -> bool:
        """Whether the innovations of all logs are consistent and white."""
        return all(fit.white for fit in [*self.fits, *self.validation])

    @property
    def good(self) -> bool:
        """Whether the model explains the logs, and data and prior knowledge determine every free parameter."""
        return self.converged and self.white and self.complete

    def table(self) -> pl.DataFrame:
        """Return a row for each number: estimate, 1 sigma, 95 % interval, start, prior 1 sigma and unit."""
        problem, reach = self.problem, float(stats.norm.ppf(0.5 + CONFIDENCE / 2.0))
        return pl.DataFrame({
            "parameter": problem.labels, "estimate": self.estimate, "std": self.std,
            "lower": self.estimate - reach * self.std, "upper": self.estimate + reach * self.std,
            "start": self.start, "prior_std": self.prior, "unit": problem.units,
        })  # fmt: skip

    def gyro_bias(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the gyro bias at the end of each log and its 1 sigma, (3,) each [rad/s]."""
        if not self.problem.bias:
            return []
        size = self.problem.model.walk.size if self.problem.model.walk is not None else 0
        found = []
        for fit in self.fits:
            p = np.diag(fit.track.covariance[-1])
            at = len(p) - size - 3
            found.append((fit.track.bias[-1], np.sqrt(p[at : at + 3])))
        return found

    def __repr__(self) -> str:
        lines = [
            f"{row['parameter']:28s} {row['estimate']:12.6g} +- {row['std']:.2g} {row['unit']}"
            for row in self.table().iter_rows(named=True)
        ]
        return "\n".join([*lines, *self.undetermined])


def of_logs(
    loaded: Scenario,
    logs: Sequence[Measurements],
    others: Sequence[Measurements] = (),
    free: Sequence[str] | None = None,
    report: Callable[[str], None] = lambda text: None,
) -> Identification:
    """Estimate parameters from logs that are already read.

    Args:
        loaded: a complete scenario.
        logs: the logs.
        others: logs that are only predicted.
        free: names of the parameters.
        report: called with the progress in words.
    """
    _check_alike([*logs, *others])
    problem = parameters.build(loaded, logs, free)
    search = Search(problem, [prepared(problem, one) for one in logs], _gate(loaded), report)
    usual = max(parameters.acceleration(problem.model, log) for log in logs)
    starts = 3 if loaded.identify is None else loaded.identify.starts
    best = search.best(np.zeros(problem.size), usual, starts)
    return _result(loaded, problem, search, best, logs, others)


def _check_alike(logs: Sequence[Measurements]) -> None:
    """Raise ScenarioError if logs have different readings or commands."""
    first = logs[0]
    for log in logs[1:]:
        same = (set(log.readings), log.by_channel, log.wheel_inertia) == (
            set(first.readings), first.by_channel, first.wheel_inertia
        )  # fmt: skip
        if not same:
            raise ScenarioError(f"{log.name} has other readings than {first.name}, but all logs must have the same")


def prepared(problem: Problem, log: Measurements) -> Prepared:
    """Return the rows of a log for the filter, and their structure."""
    return filtering.rows_of(log, problem.step, BUCKET), Kind.of(log)


def _gate(loaded: Scenario) -> float:
    """Return the largest accepted mean normalised square of the innovations of a group of readings [-]."""
    rate = 1e-6 if loaded.identify is None else loaded.identify.outliers
    return float(stats.chi2.isf(rate, 3) / 3.0) if rate > 0.0 else np.inf


class Found(NamedTuple):
    """Result of a local search."""

    z: np.ndarray
    value: float  # log-likelihood with the prior
    information: np.ndarray
    square: float
    converged: bool
    steps: int


class Search:
    """Local searches for the estimates from some logs; programs are compiled once for logs of the same length."""

    def __init__(self, problem: Problem, logs: Sequence[Prepared], gate: float, report: Callable[[str], None]):
        """Args: the problem, the logs, the normalised square of outliers, and a function that reports progress."""
        self.problem, self.logs, self.gate, self.report = problem, list(logs), gate, report
        self.known = problem.known().astype(float)
        self._noise_is_free = any(one.name.endswith("_noise") for one in problem.parameters)
        self.slack = jnp.zeros(())
        self._filter = jax.jit(self._filtered, static_argnames="kind")
        self._errors = jax.jit(self._innovations, static_argnames="kind")
        self._derivatives = jax.jit(self._differentiated, static_argnames=("kind", "exact"))

    def _at(self, z: Array, slack: Array) -> Model:
        return replace(self.problem.at(z), slack=slack)

    def _filtered(self, z: Array, rows: Rows, kind: Kind) -> tuple[Innovations, Any]:
        return filtering.filtered(self.problem.at(z), rows, kind)

    def _innovations(self, z: Array, slack: Array, rows: Rows, gate: Any, kind: Kind) -> Innovations:
        return filtering.innovations(self._at(z, slack), rows, kind, gate)

    def _differentiated(
        self, z: Array, slack: Array, rows: Rows, kind: Kind, exact: bool
    ) -> tuple[Array, Array, Array, Array]:
        """Return log-likelihood, gradient, Fisher information and mean normalised square of one log."""

        def of(z: Array) -> tuple[tuple[Array, Array], Innovations]:
            found = filtering.innovations(self._at(z, slack), rows, kind, covariance_derivatives=exact)
            return (found.value, found.variance), found

        def along(directions: Array) -> Any:  # derivatives that one device computes
            one = jax.vmap(lambda d: jax.jvp(of, (z,), (d,), has_aux=True)[1:], out_axes=(-1, None))(directions[0])
            return jax.tree.map(lambda v: v[None], one)

        devices = min(len(configure.devices()), z.size)
        each = -(-z.size // devices)  # number of directions that each device computes
        directions = jnp.eye(devices * each, z.size).reshape(devices, each, z.size)
        slopes, found = montecarlo.map_over_devices(along, directions, devices)
        by_value, by_variance = (jnp.concatenate([*v], axis=-1)[..., : z.size] for v in slopes)
        value, variance, accepted = (v[0] for v in found)
        by_value = by_value / jnp.sqrt(variance)[..., None]
        by_variance = by_variance / variance[..., None]
        whitened = value / jnp.sqrt(variance)
        gradient = jnp.einsum("kmi,km->i", by_variance, 0.5 * (whitened**2 - 1.0))
        gradient = gradient - jnp.einsum("kmi,km->i", by_value, whitened)
        information = jnp.einsum("kmi,kmj->ij", by_value, by_value)
        information = information + 0.5 * jnp.einsum("kmi,kmj->ij", by_variance, by_variance)
        count = jnp.maximum(jnp.sum(accepted), 1)
        return _log_likelihood(value, variance, accepted), gradient, information, jnp.sum(whitened**2) / count

    def filtered(self, z: np.ndarray, log: Prepared) -> tuple[Innovations, Track]:
        """Return innovations and estimates of the filter for a log, as NumPy arrays."""
        rows, kind = log
        return jax.tree.map(np.asarray, self._filter(jnp.asarray(z), _numbers(rows), kind=kind))

    def innovations(self, z: np.ndarray, log: Prepared, gate: float = np.inf) -> Innovations:
        """Return the innovations of a log, as NumPy arrays."""
        rows, kind = log
        return jax.tree.map(np.asarray, self._errors(jnp.asarray(z), self.slack, _numbers(rows), gate, kind=kind))

    def derivatives(
        self, z: np.ndarray, logs: Sequence[Prepared], *, exact: bool = True
    ) -> tuple[float, np.ndarray, np.ndarray, float]:
        """Return the log-likelihood of logs and prior, its derivatives, and the fit of the logs.

        Args:
            z: coordinates (n,) [-].
            logs: the logs.
            exact: whether gradient and information include the derivatives of the predicted covariance. Without them
                they take half of the time, and are good enough for a first search if no noise level is free.

        Returns:
            Log-likelihood, its gradient (n,), and the information (n, n) of logs and prior. Then the mean square of the
            innovations relative to their 1 sigma, averaged over the logs.
        """
        value, gradient, information = -0.5 * float(self.known @ z**2), -self.known * z, np.diag(self.known)
        squares = []
        for rows, kind in logs:
            one = jax.tree.map(np.asarray, self._derivatives(jnp.asarray(z), self.slack, _numbers(rows), kind, exact))
            value, gradient, information = value + float(one[0]), gradient + one[1], information + one[2]
            squares.append(float(one[3]))
        return value, gradient, information, float(np.mean(squares))

    def best(self, z: np.ndarray, acceleration: float, starts: int) -> Found:
        """Return the best of the local searches from z and, while the fit is poor, from random starting points.

        Args:
            z: first starting point (n,).
            acceleration: see `run`.
            starts: largest number of starting points.
        """
        best, draws = self.run(z, acceleration), np.random.default_rng(0)
        for k in range(1, starts):
            if best.square < CONSISTENT[1]:
                break
            self.report(f"the fit is poor; starting point {k + 1}")
            other = self.run(draws.standard_normal(self.problem.size), acceleration)
            best = max(best, other, key=lambda found: found.value)
        return best

    def run(self, z: np.ndarray, acceleration: float) -> Found:
        """Return the result of the local search from coordinates (n,), with outliers rejected.

        A model that is far off predicts a long log badly, and its likelihood has many maxima. If the fit is poor, the
        search therefore begins with noise on the acceleration, so that the filter follows the log, and reduces it.

        Args:
            z: starting point.
            acceleration: usual acceleration in the logs [rad/s^2]; 0: no noise is added.
        """
        if acceleration > 0.0 and max(self._scale(self.innovations(z, log)) for log in self.logs) > POOR_FIT:
            for factor in SLACK:
                self.slack = jnp.asarray(factor * acceleration)
                self.report(f"the fit is poor: a filter with noise of {float(self.slack):.2g} rad/s^1.5")
                z = self._run(z, 1, CONVERGED_WITH_NOISE).z
            self.slack = jnp.zeros(())
        return self._run(z, SCREENINGS, CONVERGED)

    def _run(self, z: np.ndarray, screenings: int, enough: float) -> Found:
        before, found = None, None
        for _ in range(screenings):
            logs = [self.screened(z, log) for log in self.logs]
            masks = np.concatenate([log[0].valid.ravel() for log in logs])
            if before is not None and np.array_equal(masks, before):
                break
            before, found = masks, self.maximise(z, logs, enough)
            z = found.z
        assert found is not None
        return found

    @staticmethod
    def _scale(found: Innovations) -> float:
        """Return the median of the normalised squares of the innovations over the median of a good fit."""
        squares = (found.value**2 / found.variance)[found.accepted]
        return float(np.median(squares)) / float(stats.chi2.median(1))

    def screened(self, z: np.ndarray, log: Prepared) -> Prepared:
        """Return the log without its outliers at these coordinates.

        The limit is relative to the median of the squares, so that good samples stay while the model is still poor.
        """
        if not np.isfinite(self.gate):
            return log
        scale = 1.0
        for gate in (np.inf, self.gate):
            found = self.innovations(z, log, gate * scale)
            scale = max(scale, self._scale(found))
        rows, kind = log
        return rows._replace(valid=np.concatenate([rows.valid[:1], found.accepted])), kind

    def maximise(self, z: np.ndarray, logs: Sequence[Prepared], enough: float) -> Found:
        """Return the nearest maximum of the likelihood of these logs; it ends after a step below `enough` sigma."""
        exact = enough <= CONVERGED or self._noise_is_free
        value, gradient, information, square = here = self.derivatives(z, logs, exact=exact)
        if not _finite(here):  # such as an inertia that is too small for the modes, after a random start
            return Found(z, -np.inf, np.zeros_like(information), np.inf, False, 0)
        damping, converged, steps = 0.0, False, 0
        for steps in range(1, STEPS + 1):
            sizes, directions = np.linalg.eigh(information)
            directions = directions[:, sizes >= 1.0]  # other directions keep their prior
            sizes = sizes[sizes >= 1.0]
            while True:
                step = directions @ ((directions.T @ gradient) / (sizes + damping))
                step = step * min(1.0, LONGEST_STEP / max(float(np.linalg.norm(step)), 1e-300))
                size = float(np.sqrt(step @ information @ step))
                there = self.derivatives(z + step, logs, exact=exact)
                if _finite(there) and there[0] >= value - 1e-9 * abs(value):
                    break
                damping = max(10.0 * damping, float(np.min(sizes, initial=1.0)))
                if damping > 1e12:
                    return Found(z, value, information, square, size < enough, steps)
            z, damping = z + step, damping / 100.0
            value, gradient, information, square = there
            self.report(f"step {steps}: mean square of the innovations {square:.4g}")
            if size < enough:
                converged = True
                break
        return Found(z, value, information, square, converged, steps)


def _finite(derivatives: tuple[float, np.ndarray, np.ndarray, float]) -> bool:
    """Return whether a likelihood and its derivatives are numbers; the motion of an impossible body overflows."""
    return all(bool(np.all(np.isfinite(one))) for one in derivatives)


def _log_likelihood(value: Any, variance: Any, accepted: Any) -> Any:
    """Return the log-likelihood of the innovations, without the constant."""
    return -0.5 * jnp.sum(jnp.where(accepted, value**2 / variance + jnp.log(variance), 0.0))


def _numbers(rows: Rows) -> Rows:
    """Return the rows as arrays for JAX; `source` is not used there."""
    return jax.tree.map(jnp.asarray, rows._replace(source=np.zeros(0)))


def covariance(information: np.ndarray) -> np.ndarray:
    """Return the covariance (n, n) of the coordinates; 1 in directions that are not determined."""
    sizes, directions = np.linalg.eigh(information)
    return (directions / np.maximum(sizes, 1.0)) @ directions.T


def undetermined(problem: Problem, information: np.ndarray, by_z: np.ndarray) -> list[str]:
    """Return a sentence for each combination of parameters that the data do not determine.

    Args:
        problem: the problem.
        information: Fisher information (n, n) of the data alone, in sigmas of the prior.
        by_z: derivatives of the numbers (k, n) by the coordinates.
    """
    sizes, directions = np.linalg.eigh(information)
    usual, known, sentences = np.linalg.norm(by_z, axis=1), problem.known(), []
    for direction in directions[:, sizes < 1.0].T:
        change = (by_z @ direction) / np.where(usual > 0.0, usual, 1.0)
        clear = np.abs(change) > CLEAR * np.max(np.abs(change))
        names, common, at, row = [], [], 0, 0
        for one in problem.parameters:
            part, here = direction[at : at + one.size], clear[row : row + len(one.labels)]
            at, row = at + one.size, row + len(one.labels)
            if np.linalg.norm(part) < CLEAR:
                continue
            factor = one.common
            alike = factor is not None and abs(part @ factor) > 0.9 * np.linalg.norm(part) * np.linalg.norm(factor)
            common.append(one.name if alike else None)
            names += [label for label, is_clear in zip(one.labels, here, strict=True) if is_clear]
        kept = "the prior knowledge is kept" if np.all(known[np.abs(direction) > CLEAR]) else "the start is kept"
        if len(common) == 2 and all(common):
            sentences.append(
                f"the data determine only the ratio of {common[0]} to {common[1]}; {kept} for their product"
            )
        elif len(names) == 1:
            sentences.append(f"the data do not determine {names[0]}; {kept}")
        else:
            sentences.append(f"the data do not determine a combination of {', '.join(names)}; {kept}")
    return list(dict.fromkeys(sentences))


def _result(
    loaded: Scenario, problem: Problem, search: Search, best: Found, logs: Sequence[Any], others: Sequence[Any]
) -> Identification:
    z, zero, known = best.z, np.zeros(problem.size), problem.known()
    of_z, by_z, by_start = covariance(best.information), problem.derivatives(z), problem.derivatives(zero)
    prior = np.sqrt(np.sum(by_start[:, known] ** 2, axis=1))
    prior = np.where(np.any(by_start[:, ~known] != 0.0, axis=1) | (prior == 0.0), np.inf, prior)

    def fitted(log: Measurements) -> tuple[Fit, Prepared]:
        one = prepared(problem, log)
        good = search.screened(z, one)
        return Fit(log, one[0], *search.filtered(z, good)), good

    def predicted(log: Measurements) -> Fit:
        fit, good = fitted(log)
        _, gradient, information, _ = search.derivatives(z, [good])
        kept = np.linalg.pinv(of_z)  # information of the estimate, which includes the prior
        step = np.linalg.solve(information - np.diag(search.known) + kept, gradient + search.known * z)
        moved = float(np.sqrt(step @ kept @ step / step.size))
        return replace(fit, adjusted=search.innovations(z + step, good), moved=moved)

    return Identification(
        scenario=loaded,
        problem=problem,
        z=z,
        start=problem.numbers(zero),
        prior=prior,
        estimate=problem.numbers(z),
        covariance=by_z @ of_z @ by_z.T,
        undetermined=undetermined(problem, best.information - np.diag(search.known), by_start),
        complete=bool(np.min(np.linalg.eigvalsh(best.information)) >= 1.0),
        fits=[fitted(log)[0] for log in logs],
        validation=[predicted(log) for log in others],
        converged=best.converged,
        steps=best.steps,
        log_likelihood=best.value,
    )
