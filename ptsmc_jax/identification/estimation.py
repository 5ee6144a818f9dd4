"""Maximum-likelihood estimates of the free parameters of a scenario from telemetry. Start with `estimate_parameters`.

The likelihood is that of the innovations of the filter. Fisher scoring finds its maximum, with the step control of
Levenberg and Marquardt. Each step solves (I + damping) step = gradient. The gradient is exact, and I is the Fisher
information of the innovations and their variances (Gupta and Mehra, IEEE Trans. Automatic Control 19(6), 1974). Both
come from the derivatives of the innovations in forward mode.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
from jaxtyping import Array
from scipy import stats

from ptsmc_jax import configure
from ptsmc_jax.campaigns import montecarlo
from ptsmc_jax.identification import filtering, parameters
from ptsmc_jax.identification.filtering import FilterState, Innovations, LogKind, Model, Rows
from ptsmc_jax.identification.parameters import Problem
from ptsmc_jax.identification.telemetry import Measurements
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.identify_tables import Identify
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.signals import disturbances

ROW_MULTIPLE = 256  # rows of a log are padded to a multiple of it, so that similar logs share compiled programs
MAX_EVALUATIONS = 100  # largest number of evaluations of a local search
MAX_COARSE_EVALUATIONS = 30  # largest number of evaluations of a preliminary search
STRAIGHTENING_STEPS = 4  # Newton steps that find the coordinates of given numbers
MAX_DAMPING = 1e12  # largest damping of a step
MAX_STEP_LENGTH = 3.0  # longest step of a local search, in sigmas of the prior
COARSE_TOLERANCE = 0.3  # largest next step that ends a preliminary search, in sigmas of the estimate
STEP_TOLERANCE = 1e-2  # largest next step of a converged search, in sigmas of the estimate
ACCELERATION_NOISES = (0.3, 0.03, 0.003, 0.0003)  # noise in a search, relative to the usual acceleration [s^0.5]
NOISE_GAIN = 8.0  # smallest gain of the log-likelihood for which noise on the acceleration is kept: 4 sigma
MIRROR_GAIN = 8.0  # smallest gain of the log-likelihood that tells a phase from its mirrored value
MAX_SCREENINGS = 4  # largest number of searches for outliers, each followed by a search for the parameters
MAX_OUTLIER_FRACTION = 0.2  # largest fraction of the readings of a component that are rejected as outliers
MIN_OUTLIERS = 3  # number of outliers of a component that are allowed in a short log
GATE_GROWTHS = (*np.logspace(0.0, 8.0, 9), np.inf)  # factors of the limit of outliers, if it rejects more readings
POOR_FIT = 1.5  # median normalised square of innovations above which a search begins with noise
LAGS = 25  # number of lags of the autocorrelation
MAX_AUTOCORRELATION = 0.05  # largest autocorrelation that counts as white in a long log
MEAN_SQUARE_RANGE = (0.8, 1.25)  # mean normalised square of innovations that fit their variance, in a long log
MISFIT_SIGMAS = 4.0  # in a short log, an autocorrelation or a mean square beyond this number of sigmas is a misfit
MAX_DISTANCE = 3.0  # largest distance of the most likely parameters of a validation log, RMS in sigmas of the estimates
ROUNDING_ERROR = 1e-3  # of the smallest eigenvalue of an information, which is 1 for prior knowledge alone
CONFIDENCE = 0.95  # of the intervals of the estimates
MIN_COMPONENT = 0.3  # smallest component of an undetermined direction whose parameter is named
PreparedLog = tuple[Rows, LogKind]  # a log for the filter


def _mean_square_range(count: int) -> tuple[float, float]:
    """Return the range of the mean square of `count` innovations of a good fit [-]."""
    spread = MISFIT_SIGMAS * np.sqrt(2.0 / max(count, 1))  # of the mean square of normal random numbers
    return min(MEAN_SQUARE_RANGE[0], 1.0 - spread), max(MEAN_SQUARE_RANGE[1], 1.0 + spread)


def _sum_autocovariance(values: np.ndarray) -> float:
    """Return the sum of the autocovariance of values (n,) with mean zero over all lags.

    The sum ends before the first negative sum of two successive lags, because noise dominates later lags (initial
    positive sequence, Geyer, Statistical Science 7(4), 1992).
    """
    spectrum = np.abs(np.fft.rfft(values, 2 * values.size)) ** 2
    autocovariance = np.fft.irfft(spectrum)[: values.size] / values.size
    pairs = autocovariance[: values.size // 2 * 2].reshape(-1, 2).sum(axis=1)
    count = int(np.argmax(pairs < 0.0)) if np.any(pairs < 0.0) else pairs.size
    return float(2.0 * np.sum(pairs[:count]) - autocovariance[0])


@dataclass(frozen=True, eq=False)
class Fit:
    """Innovations of a log for estimated parameters.

    The estimates have errors that change the predictions of a validation log. A validation log therefore also has
    adjusted parameters, computed by one Newton step. They are the most likely parameters for this log, with the
    estimates and their covariance as the prior. `adjusted` are the innovations for the adjusted parameters.
    """

    log: Measurements
    rows: Rows
    innovations: Innovations  # arrays (rows - 1, components)
    track: FilterState  # estimates at each row but the first
    adjusted: Innovations | None = None
    acceleration_noise: float = 0.0  # of the filter [rad/s^1.5]; above 0 if the model does not explain the logs
    distance: float = 0.0  # distance of the adjusted parameters from the estimates, RMS in sigmas of the estimates

    @property
    def whitened(self) -> np.ndarray:
        """Innovations over their 1 sigma, (samples, components) [-]; `adjusted` if given.

        They are NaN for missing readings and for outliers.
        """
        value, variance, accepted = self.innovations if self.adjusted is None else self.adjusted
        sampled = self.rows.log_row[1:] >= 0
        return np.where(accepted, value / np.sqrt(variance), np.nan)[sampled]

    @property
    def mean_square(self) -> float:
        """Mean square of the whitened innovations [-]; 1 if they fit their variance."""
        return float(np.nanmean(self.whitened**2))

    @property
    def outlier_count(self) -> int:
        """Number of readings that are rejected as outliers, each component counted."""
        return int(np.sum(self.rows.valid[1:] & ~self.innovations.accepted))

    @property
    def reading_count(self) -> int:
        """Number of readings that are used, each component counted."""
        return int(np.sum(self.innovations.accepted))

    @property
    def variance_factor(self) -> float:
        """Ratio of the variance of the estimates to their Cramer-Rao bound for innovations like these [-], at least 1.

        The estimates add up innovations in time. The variance of a sum of innovations is the sum of their
        autocovariance over all lags (Morelli and Klein, JGCD 20(1), 1997). The component with the largest
        ratio counts. The ratio is 1 if the model explains the log.
        """
        if self.is_white:
            return 1.0
        columns = [column[np.isfinite(column)] for column in self.whitened.T]
        return max(1.0, *(_sum_autocovariance(column) for column in columns if column.size))

    def autocorrelation(self) -> np.ndarray:
        """Return the autocorrelation (LAGS, components) [-] of the whitened innovations at the lags 1, 2, ..

        Lags are counted in readings of the component.
        """

        def autocorrelate(values: np.ndarray) -> np.ndarray:
            if values.size <= LAGS:
                return np.zeros(LAGS)
            products = [np.sum(values[lag:] * values[:-lag]) for lag in range(1, LAGS + 1)]
            return np.array(products) / np.sum(values**2)

        return np.stack([autocorrelate(column[np.isfinite(column)]) for column in self.whitened.T], axis=1)

    @property
    def autocorrelation_limits(self) -> np.ndarray:
        """The largest autocorrelation of each component that counts as white, (components,) [-]."""
        readings = np.maximum(np.sum(np.isfinite(self.whitened), axis=0), 1)
        return np.maximum(MAX_AUTOCORRELATION, MISFIT_SIGMAS / np.sqrt(readings))

    @property
    def is_white(self) -> bool:
        """Whether the innovations fit their variance and are uncorrelated in time.

        The filter must have no noise on the acceleration. The adjusted parameters of a validation log must also be near
        the estimates, see `MAX_DISTANCE`. About 1 % of logs fail even with a correct model, because LAGS
        autocorrelations of each component are tested.
        """
        low, high = _mean_square_range(int(np.sum(np.isfinite(self.whitened))))
        is_consistent = low < self.mean_square < high and self.acceleration_noise == 0.0
        is_uncorrelated = np.all(np.abs(self.autocorrelation()) < self.autocorrelation_limits)
        return is_consistent and self.distance < MAX_DISTANCE and bool(is_uncorrelated)


@dataclass(frozen=True, eq=False)
class Identification:
    """Estimated parameters of a scenario, with the fit of each log."""

    scenario: Scenario  # the scenario before the identification
    problem: Problem
    z: np.ndarray  # estimated coordinates (n,)
    start: np.ndarray  # numbers of the scenario (k,)
    prior_std: np.ndarray  # prior 1 sigma of the numbers (k,), infinite without prior knowledge
    estimate: np.ndarray  # estimated numbers (k,), in their units
    covariance: np.ndarray  # covariance of the estimated numbers (k, k)
    undetermined: list[str]  # sentences on combinations that the data do not determine
    is_determined: bool  # whether data and prior knowledge together determine every parameter
    variance_factor: float  # largest ratio of the covariance to the Cramer-Rao bound, see `Fit.variance_factor`
    fits: list[Fit]  # fits of the logs
    validation: list[Fit]  # fits of the validation logs
    converged: bool  # whether the search that ended at z converged
    steps: int  # number of steps of this search
    log_likelihood: float  # with the prior

    @property
    def std(self) -> np.ndarray:
        """1 sigma of the estimates (k,), in their units."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def is_identified(self) -> bool:
        """Whether the model explains the logs, and data and prior knowledge determine every free parameter."""
        explains_logs = all(fit.is_white for fit in [*self.fits, *self.validation])
        return self.converged and explains_logs and self.is_determined

    def table(self) -> pl.DataFrame:
        """Return a row for each number: estimate, 1 sigma, 95 % interval, start, prior 1 sigma and unit."""
        problem, half_width = self.problem, float(stats.norm.ppf(0.5 + CONFIDENCE / 2.0))
        return pl.DataFrame({
            "parameter": problem.labels, "estimate": self.estimate, "std": self.std,
            "lower": self.estimate - half_width * self.std, "upper": self.estimate + half_width * self.std,
            "start": self.start, "prior_std": self.prior_std, "unit": problem.units,
        })  # fmt: skip

    def gyro_bias(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the gyro bias at the end of each log and its 1 sigma, (3,) each [rad/s]."""
        if not self.problem.has_gyro_bias:
            return []
        biases = []
        for fit in self.fits:
            variances = np.diag(fit.track.covariance[-1])
            first = len(variances) - fit.track.walk.shape[1] - 3
            biases.append((fit.track.bias[-1], np.sqrt(variances[first : first + 3])))
        return biases

    def __repr__(self) -> str:
        lines = [
            f"{row['parameter']:28s} {row['estimate']:12.6g} +- {row['std']:.2g} {row['unit']}"
            for row in self.table().iter_rows(named=True)
        ]
        return "\n".join([*lines, *self.undetermined])


def estimate_parameters(
    loaded: Scenario,
    logs: Sequence[Measurements],
    validation_logs: Sequence[Measurements] = (),
    free: Sequence[str] | None = None,
    report: Callable[[str], None] = lambda text: None,
) -> Identification:
    """Estimate the free parameters of a scenario from logs.

    Args:
        loaded: a complete scenario.
        logs: the logs.
        validation_logs: further logs, which are predicted but not used for the estimate.
        free: names of the free parameters; by default those of [identify].
        report: called with the progress in words.
    """
    first = logs[0]
    for log in [*logs, *validation_logs]:
        if (set(log.readings), _log_kind(log)) != (set(first.readings), _log_kind(first)):
            raise ScenarioError(f"{log.name} has other readings than {first.name}, but all logs must have the same")
    problem, table = parameters.build(loaded, logs, free), loaded.identify or Identify()
    search = Search(
        problem,
        [prepare_log(problem, log) for log in logs],
        innovation_gate(table.outliers, 1 if "x" in first.readings else 3),
        report,
    )
    largest_acceleration = max(parameters.commanded_acceleration(problem.model, log) for log in logs)
    best = search.find_best(np.zeros(problem.size), largest_acceleration, table.starts)
    return _build_result(loaded, problem, search, best, logs, validation_logs)


def _log_kind(log: Measurements) -> LogKind:
    """Return the properties of a log that select the compiled filter."""
    return LogKind(log.by_channel, log.wheel_inertia)


def prepare_log(problem: Problem, log: Measurements) -> PreparedLog:
    """Return the rows of a log for the filter, and their structure."""
    return filtering.make_rows(log, problem.max_step, ROW_MULTIPLE), _log_kind(log)


def innovation_gate(rate: float, size: int = 3) -> float:
    """Return the mean normalised square [-] that a correct group of readings exceeds with this probability.

    Args:
        rate: the probability; the limit is infinite for 0.
        size: number of readings of a group, which are rejected together.
    """
    return float(stats.chi2.isf(rate, size) / size) if rate > 0.0 else np.inf


class SearchResult(NamedTuple):
    """Result of a local search."""

    z: np.ndarray  # coordinates (n,) at the end of the search
    log_likelihood: float  # with the prior
    information: np.ndarray  # Fisher information (n, n), with the prior
    mean_square: float  # of the innovations, relative to their variance
    converged: bool
    steps: int
    acceleration_noise: float  # of the filter [rad/s^1.5]
    ambiguities: Sequence[str] = ()  # a sentence for each phase whose mirrored value is about as likely


class Search:
    """Local searches for the most likely parameters of some logs. Logs of the same length share compiled programs."""

    def __init__(self, problem: Problem, logs: Sequence[PreparedLog], gate: float, report: Callable[[str], None]):
        """Args: problem, logs, progress function; gate: mean normalised square above which readings are outliers."""
        self.problem, self.logs, self.gate, self.report = problem, list(logs), gate, report
        self.prior_weight = problem.has_prior().astype(float)
        self._noise_is_free = any(parameter.name.endswith("_noise") for parameter in problem.parameters)
        self.acceleration_noise = 0.0  # of the filter [rad/s^1.5]
        self._start = self._round = ""  # the current part of the search, for the progress
        self._evaluations = 0  # number of evaluations of the likelihood
        self._jitted_filter = jax.jit(
            lambda z, noise, rows, kind: filtering.run_filter(self._model_at(z, noise), rows, kind),
            static_argnames="kind",
        )
        self._jitted_innovations = jax.jit(
            lambda z, noise, rows, gate, kind: filtering.run_filter(
                self._model_at(z, noise), rows, kind, gate, with_track=False
            )[0],
            static_argnames="kind",
        )
        self._jitted_derivatives = jax.jit(self._differentiate, static_argnames=("kind", "exact"))

    def _model_at(self, z: Array, acceleration_noise: Array) -> Model:
        """Return the model at coordinates (n,), with noise on the acceleration in the filter [rad/s^1.5]."""
        return replace(self.problem.model_at(z), acceleration_noise=acceleration_noise)

    def _differentiate(
        self, z: Array, noise: Array, rows: Rows, kind: LogKind, exact: bool
    ) -> tuple[Array, Array, Array, Array]:
        """Return log-likelihood, gradient, Fisher information and mean normalised square of one log."""

        def innovations_at(z: Array) -> tuple[tuple[Array, Array], Innovations]:
            innovations, _ = filtering.run_filter(
                self._model_at(z, noise), rows, kind, with_track=False, covariance_derivatives=exact
            )
            return (innovations.value, innovations.variance), innovations

        def differentiate_along(directions: Array) -> tuple:  # the part of one device
            derive = jax.vmap(lambda d: jax.jvp(innovations_at, (z,), (d,), has_aux=True)[1:], out_axes=(-1, None))
            return jax.tree.map(lambda v: v[None], derive(directions[0]))

        devices = min(len(configure.devices()), z.size)
        per_device = -(-z.size // devices)  # number of directions of each device
        directions = jnp.eye(devices * per_device, z.size).reshape(devices, per_device, z.size)
        derivatives, innovations = montecarlo.map_over_devices(differentiate_along, directions, devices)
        by_value, by_variance = (jnp.concatenate([*v], axis=-1)[..., : z.size] for v in derivatives)
        value, variance, accepted = (v[0] for v in innovations)
        by_value = by_value / jnp.sqrt(variance)[..., None]
        by_variance = by_variance / variance[..., None]
        whitened = value / jnp.sqrt(variance)
        gradient = jnp.einsum("kmi,km->i", by_variance, 0.5 * (whitened**2 - 1.0))
        gradient = gradient - jnp.einsum("kmi,km->i", by_value, whitened)
        information = jnp.einsum("kmi,kmj->ij", by_value, by_value)
        information = information + 0.5 * jnp.einsum("kmi,kmj->ij", by_variance, by_variance)
        count = jnp.maximum(jnp.sum(accepted), 1)
        # without the constant
        log_likelihood = -0.5 * jnp.sum(jnp.where(accepted, value**2 / variance + jnp.log(variance), 0.0))
        return log_likelihood, gradient, information, jnp.sum(whitened**2) / count

    def run_filter(self, z: np.ndarray, log: PreparedLog) -> tuple[Innovations, FilterState]:
        """Return innovations and estimates of the filter for a log, as NumPy arrays."""
        rows, kind = log
        computed = self._jitted_filter(jnp.asarray(z), jnp.asarray(self.acceleration_noise), _to_jax(rows), kind=kind)
        return jax.tree.map(np.asarray, computed)

    def innovations(self, z: np.ndarray, log: PreparedLog, gate: float = np.inf) -> Innovations:
        """Return the innovations of a log.

        Args:
            z: coordinates of the parameters (n,) [-].
            log: rows and structure of the log.
            gate: a group of readings whose normalised square exceeds this number times its size is rejected as an
                outlier.

        Returns:
            The innovations, NumPy arrays (rows - 1, components).
        """
        rows, kind = log
        noise = jnp.asarray(self.acceleration_noise)
        computed = self._jitted_innovations(jnp.asarray(z), noise, _to_jax(rows), gate, kind=kind)
        return jax.tree.map(np.asarray, computed)

    def derivatives(
        self, z: np.ndarray, logs: Sequence[PreparedLog], *, exact: bool = True
    ) -> tuple[float, np.ndarray, np.ndarray, float]:
        """Return the log-likelihood of logs and prior, its derivatives, and the fit of the logs.

        Args:
            z: coordinates (n,) [-].
            logs: the logs.
            exact: whether gradient and information include the derivatives of the predicted covariance. Without them
                they take half of the time, and are accurate enough for a first search if no noise level is free.

        Returns:
            Log-likelihood, its gradient (n,), and the information (n, n) of logs and prior. Then the mean square of the
            innovations relative to their 1 sigma, averaged over the logs.
        """
        self._evaluations += 1
        weight, noise, squares = self.prior_weight, jnp.asarray(self.acceleration_noise), []
        value, gradient, information = -0.5 * float(weight @ z**2), -weight * z, np.diag(weight)
        for rows, kind in logs:
            terms = self._jitted_derivatives(jnp.asarray(z), noise, _to_jax(rows), kind, exact)
            terms = jax.tree.map(np.asarray, terms)
            value, gradient, information = value + float(terms[0]), gradient + terms[1], information + terms[2]
            squares.append(float(terms[3]))
        return value, gradient, information, float(np.mean(squares))

    def find_best(self, z: np.ndarray, acceleration: float, max_starts: int) -> SearchResult:
        """Return the best of the local searches from z and, while the fit is poor, from random starting points.

        KeyboardInterrupt after the first local search returns the best completed result, marked as not converged.

        Args:
            z: first starting point (n,).
            acceleration: see `search_locally`.
            max_starts: largest number of starting points.
        """
        self._start = f"starting point 1 of at most {max_starts}"
        best, draws = self.search_locally(z, acceleration), np.random.default_rng(0)
        try:
            best = self._mirror_phases(best)
            for k in range(1, max_starts):
                if best.acceleration_noise == 0.0 and best.mean_square < self.largest_mean_square:
                    break
                self._start = f"starting point {k + 1} of at most {max_starts}"
                other = self.search_locally(draws.standard_normal(self.problem.size), acceleration)
                is_as_likely = abs(other.log_likelihood - best.log_likelihood) < NOISE_GAIN
                if _more_likely(best, other) is other:
                    best = self._mirror_phases(other)
                if is_as_likely:  # the model is wrong, but not the starting point
                    break
        except KeyboardInterrupt:
            best = best._replace(converged=False)
        self.acceleration_noise = best.acceleration_noise
        return best

    def _begin_round(self, text: str) -> None:
        """Report that a round of the search begins; text: its name."""
        self._round = text
        self.report(f"{self._start}, {text}")

    def _mirror_phases(self, best: SearchResult) -> SearchResult:
        """Return the best of a search result and of searches from its mirrored phases, see `Problem.mirror_phase`."""
        phases = self.problem.phases
        while phases:
            others = []
            for k in phases:
                self._begin_round(f"mirrored {self.problem.labels[k]}")
                mirrored = self.problem.mirror_phase(best.z, k)
                others.append(self._screen_and_maximise(mirrored, 2, COARSE_TOLERANCE))
            if _more_likely(*others).log_likelihood < best.log_likelihood + 1.0:
                ambiguities = [
                    f"the data do not tell {self.problem.labels[k]} from its mirrored value"
                    for k, other in zip(phases, others, strict=True)
                    if other.log_likelihood > best.log_likelihood - MIRROR_GAIN
                    and abs(parameters.wrap_angle((self.problem.numbers(other.z) - self.problem.numbers(best.z))[k]))
                    > 0.1
                ]
                return best._replace(ambiguities=ambiguities)
            best = self._screen_and_maximise(_more_likely(*others).z)
            if self.acceleration_noise > 0.0:  # the phase may have been the only error of the model
                self.acceleration_noise = 0.0
                best = _more_likely(best, self._screen_and_maximise(best.z))
                self.acceleration_noise = best.acceleration_noise
        return best

    @property
    def largest_mean_square(self) -> float:
        """The largest mean square of the innovations of a good fit [-]."""
        return _mean_square_range(sum(int(np.sum(rows.valid[1:])) for rows, _ in self.logs))[1]

    def search_locally(self, z: np.ndarray, acceleration: float) -> SearchResult:
        """Return the result of the local search from coordinates (n,), with outliers rejected.

        A model that is far off predicts a long log badly, and its likelihood has many maxima. If the fit is poor, the
        search therefore begins with noise on the acceleration, so that the filter follows the log, and reduces it. A
        model that does not explain the log keeps the noise that makes it likely, so that the information allows for the
        errors of the model.

        Args:
            z: starting point.
            acceleration: usual acceleration in the logs, which scales the noise [rad/s^2]; 0: no noise is added.
        """
        self.acceleration_noise = 0.0
        self._begin_round("without acceleration noise")
        if acceleration == 0.0 or max(self._relative_median(self.innovations(z, log)) for log in self.logs) < POOR_FIT:
            result = self._screen_and_maximise(z)
            if acceleration == 0.0 or result.mean_square < self.largest_mean_square:
                return result
        accepted, highest = None, -np.inf
        for k, factor in enumerate((*ACCELERATION_NOISES, 0.0), 1):
            self.acceleration_noise = factor * acceleration
            self._begin_round(f"acceleration noise {k} of {len(ACCELERATION_NOISES) + 1}")
            result = self._screen_and_maximise(z, 1, COARSE_TOLERANCE) if factor else self._screen_and_maximise(z)
            highest = max(highest, result.log_likelihood)
            if accepted is not None and result.log_likelihood < highest - NOISE_GAIN:
                self.acceleration_noise = accepted.acceleration_noise
                return self._screen_and_maximise(accepted.z)
            z, accepted = result.z, result
        assert accepted is not None
        return accepted

    def _screen_and_maximise(
        self, z: np.ndarray, screenings: int = MAX_SCREENINGS, tolerance: float = STEP_TOLERANCE
    ) -> SearchResult:
        """Reject outliers and maximise the likelihood in turn, until the same readings are rejected.

        Args:
            z: (n,) starting point.
            screenings: largest number of rounds.
            tolerance: largest next step of a converged maximisation, in sigmas of the estimate.
        """
        previous_masks, result = None, None
        for _ in range(screenings):
            logs = [self.reject_outliers(z, log) for log in self.logs]
            masks = np.concatenate([log[0].valid.ravel() for log in logs])
            if previous_masks is not None and np.array_equal(masks, previous_masks):
                break
            previous_masks, result = masks, self.maximise_likelihood(z, logs, tolerance)
            z = result.z
        assert result is not None
        if not np.isfinite(result.log_likelihood):
            return result
        return result._replace(log_likelihood=self.log_likelihood(z))

    def log_likelihood(self, z: np.ndarray) -> float:
        """Return the log-likelihood of all readings and the prior, with a limited cost of outliers.

        A rejected reading counts as one at the limit of its screening. Results that reject different readings are
        therefore comparable.
        """
        log_likelihood = -0.5 * float(np.sum(self.prior_weight * z**2))
        for log in self.logs:
            innovations, limit = self._screen(z, log)
            squares = np.where(innovations.accepted, innovations.value**2 / innovations.variance, limit)
            squares = np.where(log[0].valid[1:], squares, 0.0)
            log_likelihood -= 0.5 * float(np.sum(squares + np.log(innovations.variance)))
        return log_likelihood

    @staticmethod
    def _relative_median(innovations: Innovations) -> float:
        """Return the median of the normalised squares of the innovations relative to the median of a good fit."""
        squares = (innovations.value**2 / innovations.variance)[innovations.accepted]
        return float(np.median(squares)) / float(stats.chi2.median(1))

    def reject_outliers(self, z: np.ndarray, log: PreparedLog) -> PreparedLog:
        """Return the log without its outliers at these coordinates.

        The limit grows until at most `MAX_OUTLIER_FRACTION` of the readings of each component exceed it, so that a poor
        model cannot reject most of the correct readings.
        """
        rows, kind = log
        return rows._replace(valid=np.concatenate([rows.valid[:1], self._screen(z, log)[0].accepted])), kind

    def _screen(self, z: np.ndarray, log: PreparedLog) -> tuple[Innovations, float]:
        """Return the innovations of a log, and the limit of the mean normalised square of accepted readings.

        See `reject_outliers`.
        """
        valid = log[0].valid[1:]
        largest_count = np.maximum(MIN_OUTLIERS, MAX_OUTLIER_FRACTION * np.sum(valid, axis=0))
        limit, innovations = np.inf, None
        for limit in self.gate * np.array(GATE_GROWTHS):
            innovations = self.innovations(z, log, limit)
            if np.all(np.sum(valid & ~innovations.accepted, axis=0) <= largest_count):
                break
        assert innovations is not None
        return innovations, limit

    def _straighten(self, z: np.ndarray, step: np.ndarray) -> np.ndarray:
        """Return the step (n,) whose change of the numbers is the first-order change by the given step from z (n,).

        Predicted readings are nearly linear in numbers such as an inertia, but not in its coordinates. If the data
        hardly determine a combination, the likelihood is therefore a straight ridge of the numbers only. If no
        coordinates near the step have these numbers, the step itself is returned.
        """
        target, straight = self.problem.numbers(z) + self.problem.derivatives(z) @ step, step
        for _ in range(STRAIGHTENING_STEPS):
            missing = target - self.problem.numbers(z + straight)
            straight = straight + np.linalg.pinv(self.problem.derivatives(z + straight)) @ missing
            if not np.linalg.norm(straight - step) <= 0.5 * np.linalg.norm(step):
                return step
        return straight

    def maximise_likelihood(self, z: np.ndarray, logs: Sequence[PreparedLog], tolerance: float) -> SearchResult:
        """Return the result of a local search from z for the most likely parameters of these logs and the prior.

        Args:
            z: starting point (n,).
            logs: the logs, without outliers.
            tolerance: length of the undamped step that ends the search, in sigmas of the estimates.
        """
        exact = tolerance <= STEP_TOLERANCE or self._noise_is_free
        value, gradient, information, mean_square = start = self.derivatives(z, logs, exact=exact)
        if not _is_finite(start):  # such as an inertia that is too small for the modes, after a random start
            return SearchResult(z, -np.inf, np.zeros_like(information), np.inf, False, 0, self.acceleration_noise)
        damping, steps = 0.0, 0
        end = self._evaluations + (MAX_COARSE_EVALUATIONS if tolerance > STEP_TOLERANCE else MAX_EVALUATIONS)
        while not (converged := float(gradient @ _newton_step(gradient, information)) < tolerance**2):
            while damping < MAX_DAMPING and self._evaluations < end:
                step = self._straighten(z, _newton_step(gradient, information, damping))
                candidate = self.derivatives(z + step, logs, exact=exact)
                if _is_finite(candidate) and candidate[0] >= value - 1e-9 * abs(value):
                    break
                damping = max(10.0 * damping, 1.0)
            else:
                break
            z, damping, steps = z + step, damping / 100.0, steps + 1
            value, gradient, information, mean_square = candidate
            self.report(
                f"{self._start}, {self._round}, step {steps}, {self._evaluations} evaluations: mean square of the "
                f"innovations {mean_square:.4g}"
            )
        return SearchResult(z, value, information, mean_square, converged, steps, self.acceleration_noise)


def _newton_step(gradient: np.ndarray, information: np.ndarray, damping: float = 0.0) -> np.ndarray:
    """Return the damped step of Fisher scoring (n,). It is zero in directions that the data do not determine."""
    sizes, directions = np.linalg.eigh(information)
    is_determined = sizes >= 1.0
    directions = directions[:, is_determined]
    step = directions @ ((directions.T @ gradient) / (sizes[is_determined] + damping))
    return step * min(1.0, MAX_STEP_LENGTH / max(float(np.linalg.norm(step)), 1e-300))


def _more_likely(*results: SearchResult) -> SearchResult:
    """Return the most likely result. Noise on the acceleration is kept only for a gain of `NOISE_GAIN`."""
    return max(results, key=lambda result: result.log_likelihood - NOISE_GAIN * (result.acceleration_noise > 0.0))


def _is_finite(derivatives: tuple[float, np.ndarray, np.ndarray, float]) -> bool:
    """Return whether a likelihood and its derivatives are finite. They overflow for a body that is not physical."""
    return all(bool(np.all(np.isfinite(one))) for one in derivatives)


def _to_jax(rows: Rows) -> Rows:
    """Return the rows as JAX arrays, with an empty `log_row`, which the filter does not use."""
    return jax.tree.map(jnp.asarray, rows._replace(log_row=np.zeros(0)))


def covariance(information: np.ndarray) -> np.ndarray:
    """Return the covariance (n, n) of the coordinates; 1 in directions that are not determined."""
    sizes, directions = np.linalg.eigh(information)
    return (directions / np.maximum(sizes, 1.0)) @ directions.T


def inflated_covariance(information: np.ndarray, prior: np.ndarray, variance_factor: float) -> np.ndarray:
    """Return the covariance (n, n) of the coordinates if the innovations are not white.

    Args:
        information: Fisher information (n, n) of data and prior knowledge.
        prior: information (n, n) of the prior knowledge, whose errors are not larger than expected.
        variance_factor: ratio of the variance of the gradient of the data's log-likelihood to its expected value [-].
    """
    white = covariance(information)
    return white + (variance_factor - 1.0) * white @ (information - prior) @ white


def determines_all(information: np.ndarray) -> bool:
    """Return whether the Fisher information (n, n) of data and prior knowledge determines every combination."""
    return bool(np.min(np.linalg.eigvalsh(information)) >= 1.0 - ROUNDING_ERROR)


def describe_undetermined(problem: Problem, information: np.ndarray, by_z: np.ndarray) -> list[str]:
    """Return a sentence for each combination of parameters that the data do not determine.

    These are the eigenvectors of the information with an eigenvalue below 1: their 1 sigma from the data alone is
    larger than the 1 sigma of the prior.

    Args:
        problem: the problem.
        information: Fisher information (n, n) of the data alone, for coordinates in sigmas of the prior.
        by_z: derivatives of the numbers (k, n) by the coordinates.
    """
    sizes, directions = np.linalg.eigh(information)
    usual_change, has_prior, sentences = np.linalg.norm(by_z, axis=1), problem.has_prior(), []
    for direction in directions[:, sizes < 1.0].T:
        change = (by_z @ direction) / np.where(usual_change > 0.0, usual_change, 1.0)
        is_large = np.abs(change) > MIN_COMPONENT * np.max(np.abs(change))
        names, common = [], []
        parts = np.split(direction, np.cumsum([parameter.size for parameter in problem.parameters])[:-1])
        large_labels = np.split(is_large, np.cumsum([len(parameter.labels) for parameter in problem.parameters])[:-1])
        for parameter, part, is_label_large in zip(problem.parameters, parts, large_labels, strict=True):
            if np.linalg.norm(part) < MIN_COMPONENT:
                continue
            factor = parameter.common
            is_factor = factor is not None and abs(part @ factor) > 0.9 * np.linalg.norm(part) * np.linalg.norm(factor)
            common.append(parameter.name if is_factor else None)
            names += [label for label, is_included in zip(parameter.labels, is_label_large, strict=True) if is_included]
        is_prior_kept = np.all(has_prior[np.abs(direction) > MIN_COMPONENT])
        kept_value = "the prior knowledge is kept" if is_prior_kept else "the start is kept"
        if len(common) == 2 and all(common):
            sentences.append(
                f"the data determine only the ratio of {common[0]} to {common[1]}; {kept_value} for their product"
            )
        elif len(names) == 1:
            sentences.append(f"the data do not determine {names[0]}; {kept_value}")
        else:
            sentences.append(f"the data do not determine a combination of {', '.join(names)}; {kept_value}")
    return list(dict.fromkeys(sentences))


def _describe_slow_sinusoids(problem: Problem, logs: Sequence[Measurements]) -> list[str]:
    """Return a sentence if an estimated constant may replace a fixed sinusoid with a period longer than the logs."""
    names = {parameter.name for parameter in problem.parameters}
    largest_frequency = 2.0 * np.pi / max(float(log.t[-1]) for log in logs)
    is_slow = any(
        bool(np.any((np.asarray(term.amplitude) != 0.0) & (np.abs(term.frequency) < largest_frequency)))
        for term in disturbances.terms(problem.model.disturbance)
        if isinstance(term, disturbances.Sinusoid)
    )
    if not is_slow or "disturbance_bias" not in names or names & {parameters.PHASE, "disturbance_amplitude"}:
        return []
    return [
        "the data do not tell disturbance_bias from the sinusoid of [disturbance], whose period is longer than the "
        "log: identified.toml has both, and their sum may be too large; free disturbance_phase instead"
    ]


def _build_result(
    loaded: Scenario,
    problem: Problem,
    search: Search,
    best: SearchResult,
    logs: Sequence[Measurements],
    validation_logs: Sequence[Measurements],
) -> Identification:
    """Return the identification with covariances, fits and warnings.

    Args:
        loaded: the scenario.
        problem: the parameters.
        search: the search, which rejects outliers.
        best: its best result.
        logs: the logs of the estimate.
        validation_logs: logs that are only predicted.
    """
    z, zero = best.z, np.zeros(problem.size)
    by_z, by_start = problem.derivatives(z), problem.derivatives(zero)
    has_prior = [parameter.has_prior for parameter in problem.parameters for _ in parameter.labels]
    prior_std = np.where(has_prior, np.linalg.norm(by_start, axis=1), np.inf)

    def fit_log(log: Measurements, is_validation: bool = False) -> Fit:
        prepared = prepare_log(problem, log)
        screened = search.reject_outliers(z, prepared)
        fit = Fit(log, prepared[0], *search.run_filter(z, screened), acceleration_noise=best.acceleration_noise)
        if not is_validation:
            return fit
        _, gradient, information, _ = search.derivatives(z, [screened])
        weight, prior_information = search.prior_weight, np.linalg.pinv(z_covariance)  # the estimate is the prior
        step = np.linalg.solve(information - np.diag(weight) + prior_information, gradient + weight * z)
        distance = float(np.sqrt(step @ prior_information @ step / step.size))
        return replace(fit, adjusted=search.innovations(z + step, screened), distance=distance)

    fits = [fit_log(log) for log in logs]
    variance_factor = max(fit.variance_factor for fit in fits)
    z_covariance = inflated_covariance(best.information, np.diag(search.prior_weight), variance_factor)
    return Identification(
        scenario=loaded,
        problem=problem,
        z=z,
        start=problem.numbers(zero),
        prior_std=prior_std,
        estimate=problem.numbers(z),
        covariance=by_z @ z_covariance @ by_z.T,
        undetermined=[
            *describe_undetermined(problem, best.information - np.diag(search.prior_weight), by_start),
            *best.ambiguities,
            *_describe_slow_sinusoids(problem, logs),
        ],
        is_determined=determines_all(best.information) and not best.ambiguities,
        variance_factor=variance_factor,
        fits=fits,
        validation=[fit_log(log, is_validation=True) for log in validation_logs],
        converged=best.converged,
        steps=best.steps,
        log_likelihood=best.log_likelihood,
    )
