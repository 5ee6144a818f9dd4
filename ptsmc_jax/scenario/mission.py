"""Defaults that follow from the mission: published numbers, scaled, and gains designed for the sampled loop.

Every default with a unit scales with t_f and with the mean moment of inertia of the body. A scenario that is stated in
other units of time and inertia therefore gets the same defaults in those units. The published cases keep the published
numbers (`is_published_case`). Start with `scales` and `design`.
"""

import math
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import msgspec
import numpy as np

from ptsmc_jax.declare import Scaled
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.values import Table, rounded

if TYPE_CHECKING:
    from ptsmc_jax.scenario.tables import Scenario

_Table = TypeVar("_Table", bound=Table)

PAPER_INERTIA = (10.0, 12.0, 14.0)  # principal moments of the published spacecraft [kg m^2]
PAPER_TIMES = (30.0, 40.0)  # range of t_f in the published cases of a spacecraft [s]
CHAIN_TIME = 5.0  # t_f of the published integrator chains [s]

# Largest p T, with p the rate of both hold poles and T the dead time. With an observer of l / J = p / 2 the loop then
# has a phase margin of 35 deg and a gain margin of 7 dB.
MAX_POLE_TIMES_DEAD_TIME = 0.25
OBSERVER_TO_POLE = 0.5  # observer rate l / J, relative to the pole rate p
# Modes with w T below this are phase stabilised: the resonance circle in the Nyquist plot stays 30 deg away from -1.
MAX_MODE_PHASE = math.pi / 3
NOISE_SIGMAS = 5.0  # largest noise sample assumed, in standard deviations
NOISE_FRACTION = 0.5  # fraction of the torque limit that noise may use
MIN_POLE_TIMES_T_F = 20.0  # smallest product p t_f: the error then decays for five time constants within t_f / 4
MIN_OBSERVER_TIMES_T_F = 1.5  # smallest product of t_f and the observer rate l / J
SMALLEST_USEFUL_ETA = 2.4  # below 2.386 the braking peak exceeds the first torque, see `theory.rules.later_peak_ratio`
POLE_CANDIDATES = 256  # rates p among which the most accurate one is chosen


class Scales(NamedTuple):
    """Ratios of a mission to the published case, which scale the published numbers to the mission."""

    inertia: float  # mean moment of inertia / published mean moment
    time: float  # t_f / published t_f
    order: int = 2  # order n of the plant
    inputs: int = 3  # number of inputs of the plant

    def scaled_value(self, scaled: Scaled, table: Table | None = None) -> Any:
        """Return a published number, or a tuple of numbers, in these units.

        Args:
            scaled: the number and its powers of inertia and time.
            table: the table of the key, for numbers whose power of time depends on other keys.

        Raises:
            ScenarioError: the factor overflows or underflows.
        """
        power = scaled.time(table) if callable(scaled.time) else scaled.time
        with np.errstate(all="ignore"):
            time = np.float64(self.time) ** (power + scaled.order * self.order)
            factor = float(np.float64(self.inertia) ** scaled.inertia * time)
        if not 0.0 < factor < math.inf:
            raise ScenarioError(
                f"controller.t_f is {self.time:g} times and the body's inertia {self.inertia:g} times the published "
                "one, so default gains overflow or underflow; allowed are numbers nearer to the published ones",
                key="controller.t_f",
            )
        return _multiply((scaled.value,) * self.inputs if scaled.each else scaled.value, factor)


def _multiply(value: Any, factor: float) -> Any:
    """Return a number, or each number of nested tuples, times a factor, rounded."""
    return tuple(_multiply(one, factor) for one in value) if isinstance(value, tuple) else rounded(factor * value)


def is_published_case(scenario: Any) -> bool:
    """Whether the scenario is one of the published cases, which keep the published numbers."""
    t_f = scenario.controller.t_f
    if scenario.moments[0] is None:
        return t_f == CHAIN_TIME
    return tuple(np.ravel(scenario.spacecraft.inertia)) == PAPER_INERTIA and PAPER_TIMES[0] <= t_f <= PAPER_TIMES[1]


def scales(scenario: "Scenario") -> Scales:
    """Return the ratios of inertia and t_f to the published case.

    Both are 1 for a published case. The inertia is 1 for a plant without a body.
    """
    plant, mean, t_f = (scenario.order, scenario.inputs), scenario.moments[0], scenario.controller.t_f
    if is_published_case(scenario):
        return Scales(1.0, 1.0, *plant)
    if mean is None:
        return Scales(1.0, t_f / CHAIN_TIME, *plant)
    return Scales(mean / PAPER_INERTIA[1], t_f / PAPER_TIMES[0], *plant)


def fill_scaled_defaults(table: _Table, ratios: Scales) -> _Table:
    """Fill absent keys with published numbers in the mission's units, in this table and in the tables inside it."""
    changes: dict[str, object] = {}
    for key in table.__struct_fields__:
        value = getattr(table, key)
        if value is None and key in table.scaled:
            changes[key] = ratios.scaled_value(table.scaled[key], table)
        elif isinstance(value, Table):
            changes[key] = fill_scaled_defaults(value, ratios)
        elif isinstance(value, tuple) and value and isinstance(value[0], Table):
            changes[key] = tuple(fill_scaled_defaults(one, ratios) for one in value)
    return msgspec.structs.replace(table, **changes) if changes else table


class Design(NamedTuple):
    """Gains of the sampled loop in terms of the mission, for any law.

    After the hand-over the closed loop is (s + p)^2. Before it the rate gain is (2 eta - 1) / tau, with tau the time
    left until t_f. It reaches its value in the hold phase, 2 p, at tau = delta.
    """

    eta: float  # exponent of the law [-]
    pole: float  # p, rate of the closed loop in the hold phase [1/s]
    observer: float  # gain l of the observer [N m s], or [1/s] without a body
    width: float  # designed thickness of the boundary layer, in units of s
    reaching: float  # K1 / p: 2 for a spacecraft, otherwise 1
    time: float  # t_f / published t_f

    @property
    def delta(self) -> float:
        """Time from the hand-over to t_f [s]."""
        return (2.0 * self.eta - 1.0) / (2.0 * self.pole)

    @property
    def rate_factor(self) -> float:
        """Factor on published gains that scale with 1 / t_f: 1 / `time`, but at most the number 2 p in 1/s."""
        return min(1.0 / self.time, 2.0 * self.pole)


def design(scenario: "Scenario") -> Design:
    """Return the design whose predicted error in the hold phase is the smallest."""
    _, most_accurate, _ = _pole_range(scenario)
    return _design(scenario, most_accurate, _default_eta(scenario), OBSERVER_TO_POLE)


def starting_designs(scenario: "Scenario") -> list[Design]:
    """Return starting points of a search: slow to fast hold phases, slow and fast observers, the default first."""
    (slowest, most_accurate, fastest), eta = _pole_range(scenario), _default_eta(scenario)
    stable_pole = MAX_POLE_TIMES_DEAD_TIME / dead_time(scenario)
    pole_rates = [most_accurate, fastest, math.sqrt(slowest * fastest), slowest]
    pole_rates += [max(rate, slowest) for rate in (stable_pole, math.sqrt(fastest * stable_pole))]
    pole_rates = [*dict.fromkeys(pole_rates)]
    designs = [_design(scenario, rate, eta, observer) for observer in (OBSERVER_TO_POLE, 0.1) for rate in pole_rates]
    return [*designs, _design(scenario, most_accurate, _smallest_eta(scenario), 0.3)]


def dead_time(scenario: "Scenario") -> float:
    """Return the dead time of the loop [s]: delay, half a control period for the hold, lag and command filter."""
    devices, period = scenario.devices, scenario.loop.period
    filtering = devices.command_filter
    return (
        (devices.delay_periods + 0.5) * period
        + (devices.torque_lag or 0.0)
        + (0.0 if filtering is None else filtering.part_class.dead_time(filtering))
    )


def fastest_pole(scenario: "Scenario") -> float:
    """Return the largest p [1/s] that dead time, flexible modes, and noise against the torque limit allow."""
    return min(_pole_limits(scenario).values())


def _pole_limits(scenario: "Scenario") -> dict[str, float]:
    """Return the upper limits of p [1/s], by their cause in words."""
    stable = MAX_POLE_TIMES_DEAD_TIME * 2.0 / scenario.order  # n poles at -p put the crossover near n p
    return {
        "the dead time of the loop": stable / dead_time(scenario),
        "the damping of a flexible mode": _pole_limit_of_modes(scenario),
        "the torque limit and the noise of the sensors": _pole_limit_of_noise(scenario),
    }


def describe_default_gains(scenario: "Scenario") -> str | None:
    """Return in words that the law has default gains and what sets their bandwidth; None if the file states a gain."""
    law = scenario.controller
    names = [name for name in law.gains if name != "t_f" and getattr(law, name) is not None]
    if not names or not all(("controller", name) in scenario.defaulted for name in names):
        return None
    text = "the scenario states no gains of the law, so these are default gains"
    if law.kind == "custom":
        return "the scenario states no gains of the law, so these are the defaults of its class"
    if law.kind != "prescribed_time" or not scenario.sampled or is_published_case(scenario):
        return text
    limits, (slowest, pole, _) = _pole_limits(scenario), _pole_range(scenario)
    cause = min(limits, key=lambda name: limits[name])
    if not math.isclose(pole, limits[cause]):
        needs_speed = pole > limits[cause] or math.isclose(pole, slowest)
        cause = "controller.t_f" if needs_speed else "the noise of the sensors"
    return f"{text} with a bandwidth set by {cause}"


def _design(scenario: "Scenario", pole: float, eta: float, observer: float) -> Design:
    """Return the design for a pole rate p [1/s], an eta, and an observer rate relative to p."""
    law, period = scenario.controller, scenario.loop.period
    largest_delta = 0.5 * (law.t_f + period)  # [s]
    eta = min(eta, max(0.5 + pole * largest_delta, _smallest_eta(scenario)))
    rate = min(observer * pole, 1.0 / period)
    position, velocity = scenario.devices.noise_of_error(scenario)
    disturbance, disturbance_rate = _disturbance_bounds(scenario)
    if velocity > 0.0:  # the noise of the estimate, l sigma_w, stays below half of the disturbance
        rate = min(rate, max(0.5 * disturbance / velocity, MIN_OBSERVER_TIMES_T_F / law.t_f))
    # on three axes N K2 / 2 = 3 residual: the boundary layer adds a quarter to the gain p; it is thicker than the noise
    residual = disturbance_rate / rate
    width = max(12.0 * residual / pole, 2.0 * math.hypot(velocity, pole * position)) or 1e-3 * pole
    return Design(eta, pole, rate * scenario.mean_inertia, width, scenario.reaching, scales(scenario).time)


def _pole_range(scenario: "Scenario") -> tuple[float, float, float]:
    """Return the slowest, the most accurate and the fastest pole rate p [1/s].

    Dead time, flexible modes, and noise against the torque limit bound p from above. The most accurate p minimises the
    sum of the squares of three errors:

    - c p / (l / J) / p^3, the lag behind a disturbance of the rate c;
    - sigma (p h)^(1/2), from the position noise;
    - sigma (h / p)^(1/2), from the rate noise.
    """
    t_f, period = scenario.controller.t_f, scenario.loop.period
    slowest, fastest = MIN_POLE_TIMES_T_F / t_f, fastest_pole(scenario)
    if fastest <= slowest:  # use the larger of `fastest` and the p with delta = t_f / 2
        slow_pole = max(fastest, (2.0 * _smallest_eta(scenario) - 1.0) / t_f)
        return max(fastest, 0.1 * slow_pole), slow_pole, slow_pole
    position, velocity = scenario.devices.noise_of_error(scenario)
    position = 0.0 if scenario.estimator.on else position  # an attitude filter passes slow errors only
    # descending, so that argmin returns the fastest of rates with equal errors
    rates = slowest * (fastest / slowest) ** np.linspace(1.0, 0.0, POLE_CANDIDATES)
    with np.errstate(all="ignore"):
        lag = _disturbance_bounds(scenario)[1] / (OBSERVER_TO_POLE * rates**3)
        error = lag**2 + position**2 * rates * period + velocity**2 * period / rates
    return slowest, float(rates[int(np.argmin(error))]), fastest


def _pole_limit_of_modes(scenario: "Scenario") -> float:
    """Return the largest p [1/s] that keeps the resonance of every late mode 6 dB below 1.

    The loop gain at the resonance w of a mode is 2 p / w times k / (2 z). Here z is its damping, f its fraction of the
    inertia, and k = f / (1 - f). A mode is late if w T exceeds `MAX_MODE_PHASE`.
    """
    largest_pole = math.inf
    for frequency, damping, fraction in scenario.modes():
        if frequency * dead_time(scenario) > MAX_MODE_PHASE and fraction > 0.0:
            largest_pole = min(largest_pole, 0.5 * damping * frequency / fraction)
    return largest_pole


def _pole_limit_of_noise(scenario: "Scenario") -> float:
    """Return the largest p [1/s] at which noise uses at most `NOISE_FRACTION` of the torque limit.

    A noise sample (x, v) commands the acceleration (2 p + l / J) v + p^2 x of the error.
    """
    limit = scenario.largest_acceleration()
    position, velocity = scenario.devices.noise_of_error(scenario)
    position *= scenario.estimator.immediate_noise_fraction(scenario)
    if limit is None or not (position or velocity):
        return math.inf
    allowed, velocity_square = NOISE_FRACTION * limit / NOISE_SIGMAS, ((2.0 + OBSERVER_TO_POLE) * velocity) ** 2
    root = math.sqrt(velocity_square**2 + 4.0 * (position * allowed) ** 2)
    return math.sqrt(2.0 * allowed**2 / (velocity_square + root))


def _disturbance_bounds(scenario: "Scenario") -> tuple[float, ...]:
    """Return the bounds on the disturbing acceleration of the error and on its rate, zeros if they are unknown."""
    law = scenario.controller
    return tuple((value or 0.0) * scenario.influence for value in (law.disturbance_bound, law.disturbance_rate_bound))


def _smallest_eta(scenario: "Scenario") -> float:
    """Return the smallest eta that a design uses."""
    return scenario.least_eta + (SMALLEST_USEFUL_ETA - 2.0)


def _default_eta(scenario: "Scenario") -> float:
    """Return the published eta, or a smaller one if the first torque would exceed the limit."""
    published_eta, limit, angle = scenario.least_eta + 1.0, scenario.largest_acceleration(), scenario.start_tangent()
    if limit is None or angle == 0.0:
        return published_eta
    # the error's first acceleration is eta^2 tan(angle / 2) / t_f^2; a tenth of the limit remains for other torques
    return min(published_eta, max(scenario.controller.t_f * math.sqrt(0.9 * limit / angle), _smallest_eta(scenario)))
