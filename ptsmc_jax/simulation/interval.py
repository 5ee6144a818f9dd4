"""The data of one interval of a run from which metrics are computed: both ends, the torques, and the criteria."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ptsmc_jax.simulation.pointing import ConstantPath, ErrorPath, Pointing


class Criteria(NamedTuple):
    """Times that the metrics refer to [s], the settling angle [rad], and the observation of pointing errors."""

    t_f: Array
    t_end: Array
    window: Array
    settling_angle: Array
    pointing: Pointing | None = None


class Snapshot(NamedTuple):
    """The true state at one time, as far as the metrics need it."""

    angle: Array  # angle to the reference [rad]; for other plants |x_1|
    rate: Array  # `Plant.speed`, |w| [rad/s]
    momentum: Array | None  # |J w| [N m s]; None: the plant has no momentum
    modal_amplitude: Array | None = None  # `Plant.modal_amplitude` of a flexible body [sqrt(kg) m]


class Start(NamedTuple):
    """Data at t = 0 from which the metrics are initialised."""

    snapshot: Snapshot
    inputs: int  # number of inputs of the plant
    wheel_momentum: Array | None  # (wheels,) [N m s]; None: no wheels
    measured: bool = False  # whether the law gets a measured state instead of the true state


class Arrival(NamedTuple):
    """Error and angle of the true state at t_f; zero until t_f is reached."""

    error: Array  # (m,) error that the law drives to zero [-]; for other plants x_1
    angle: Array  # angle to the reference [rad]


class Errors(NamedTuple):
    """The error that the law drives to zero at both ends of an interval, (m,) [-], and its rate [1/s]."""

    start: Array
    start_rate: Array
    end: Array
    end_rate: Array


class Torques(NamedTuple):
    """Torques of an interval at its quadrature nodes: the start, or both ends, or both ends and the middle."""

    commanded: tuple[Array, ...]  # (m,) each [N m]
    delivered: tuple[Array, ...]  # (m,) each [N m]
    weights: tuple[float, ...]  # quadrature weights of the nodes; they sum to 1
    limited: Array  # bool: a limit of the actuators cuts the command
    wheel_momentum: Array | None  # (times, wheels) in the middle and at the end [N m s]
    wheel_torque: Array | None = None  # (times, wheels) at both ends [N m]


class Interval(NamedTuple):
    """A control period, or a step of the continuous loop."""

    t: Array  # start [s]
    t_next: Array  # end [s]
    start: Snapshot  # true state at the start
    end: Snapshot  # true state at the end
    errors: Callable[[], Errors]  # called only for intervals that end at t_f or later
    # angle in the middle [rad], from the cubic Hermite polynomial of the error; called like `errors`
    middle_angle: Callable[[], Array]
    arrival: Callable[[], Arrival]  # called only for the interval that contains t_f
    last_torque: Array  # (m,) torque delivered at the end of the previous interval [N m]
    torques: Torques
    attitude_error: Callable[[], ErrorPath] | None = None  # pointing error; None: the run has no pointing metrics
    # error of the attitude that is measured at the start; None: the law gets the true attitude
    knowledge_error: Callable[[], ConstantPath] | None = None

    @property
    def length(self) -> Array:
        """The length of the interval [s]."""
        return self.t_next - self.t


def integral_in_window(t: Any, t_next: Any, squares: tuple[Any, Any, Any], criteria: Criteria) -> Any:
    """Integrate a squared error over the part of an interval that is inside the window after t_f.

    The squared error is replaced by the parabola through its values at the start, the middle and the end. The parabola
    may become negative in between, which a square cannot. The integral over a fraction L of the interval is therefore
    at least L^3 / 4 of the whole integral, as for an error that passes linearly through zero.

    Args:
        t: start of the interval [s], an array of JAX or NumPy.
        t_next: end of the interval [s].
        squares: squared error at the start, in the middle and at the end.
        criteria: criteria of the run, with t_f and the window [s].

    Returns:
        The integral [unit of the squares times s].
    """
    dt, (g0, g1, g2) = t_next - t, squares

    def fraction(time: Any) -> Any:
        return ((time - t) / dt).clip(0.0, 1.0)

    def primitive(x: Any) -> Any:
        return x * (g0 + x * ((-3 * g0 + 4 * g1 - g2) / 2 + x * (2 * g0 - 4 * g1 + 2 * g2) / 3))

    begin, end = fraction(criteria.t_f), fraction(criteria.t_f + criteria.window)
    smallest_integral = (end - begin) ** 3 / 4 * (g0 + 4 * g1 + g2) / 6
    window_integral = primitive(end) - primitive(begin)
    xp: Any = np if isinstance(window_integral, np.ndarray) else jnp
    # `maximum` would have another gradient at the ends of the window, where both integrals are zero
    return dt * xp.where(window_integral < smallest_integral, smallest_integral, window_integral)
