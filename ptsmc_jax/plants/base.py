"""The base of every plant."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float, PyTree

from ptsmc_jax.numerics.pytrees import Scalar

State = PyTree  # state of a plant, or the time derivative of a state


class Chart(NamedTuple):
    """A figure of a run's state over time."""

    name: str
    title: str
    label: str  # label of the axis, with the unit
    column: str  # name in `Plant.columns`
    with_reference: bool = False  # whether the target has a field of this name, which is plotted, too


class Plant(ABC):
    """A plant with the equation of motion M w' = f(t, x, u) + d for its velocity w.

    Input u, disturbance d and velocity w are (m,): for a spacecraft in N m and rad/s, for other plants in the units of
    their states. M is (m, m), by default the constant `inertia`; observers scale their gains by `inertia`. Times are in
    s. A state x is a pytree, and so is its derivative. The simulation, observers, metrics and figures use a plant by
    these methods and fields only.
    """

    inertia: Any  # (m, m) scale of observer gains, and M unless `mass` is overridden
    inertia_inverse: Any  # (m, m) inverse of `inertia`
    custom_functions: ClassVar[bool] = False  # whether users define its equations, so that its time scales are unknown
    input_name: ClassVar[str] = "control"
    input_unit: ClassVar[str] = ""  # unit of inputs and disturbances; empty: custom units
    # names and meanings of the parts of a state that sensors measure
    signals: ClassVar[dict[str, str]] = {"x": "the measured state, in its own units"}
    largest_measurement: ClassVar[float] = 1e12  # exported flight software rejects larger measured numbers
    # rounding error of an error near zero, which is a difference of measured numbers, in units of the resolution
    error_rounding: ClassVar[float] = 0.0
    charts: ClassVar[tuple[Chart, ...]] = (Chart("states", "States", "state", "x"),)

    @property
    def inputs(self) -> int:
        """The number of inputs m."""
        return self.inertia.shape[-1]

    @property
    def input_labels(self) -> list[str]:
        """The name of each input."""
        return [f"u{k + 1}" for k in range(self.inputs)]

    def signal_labels(self, x: State) -> list[str]:
        """Return the name of each local coordinate of a visible state."""
        return [f"x{k + 1}" for k in range(np.size(x))]

    @property
    @abstractmethod
    def state_shapes(self) -> dict[str, tuple[int, ...]]:
        """The shapes of the arrays in a state, by field; the name of a state that is one array is empty."""

    @abstractmethod
    def velocity(self, x: State) -> Float[Array, " m"]:
        """Return the velocity w of a state, or w' of a state's derivative."""

    def mass(self, t: Scalar, x: State) -> Float[Array, "m m"]:
        """Return the matrix M."""
        return self.inertia

    @abstractmethod
    def generalised_force(self, t: Scalar, x: State, u: Float[Array, " m"]) -> Float[Array, " m"]:
        """Return the force f(t, x, u).

        Args:
            t: time [s].
            x: state.
            u: input (m,).

        Returns:
            The force (m,), in the unit of the inputs.
        """

    @abstractmethod
    def rate(self, t: Scalar, x: State, u: Float[Array, " m"], disturbance: Float[Array, " m"]) -> State:
        """Return the time derivative of the state.

        Args:
            t: time [s].
            x: state.
            u: input (m,).
            disturbance: disturbance d (m,).

        Returns:
            A pytree like `x`, with the unit of each state per second.
        """

    @abstractmethod
    def input_for(self, t: Scalar, x: State, w_dot: Float[Array, " m"], d: Float[Array, " m"]) -> Float[Array, " m"]:
        """Return the input for this w' and disturbance d.

        Args:
            t: time [s].
            x: state.
            w_dot: derivative w' of the velocity (m,), [rad/s^2] for a spacecraft.
            d: disturbance (m,).

        Returns:
            The input (m,).
        """

    def implied_disturbance(self, t: Scalar, x: State, x_dot: State, u: Float[Array, " m"]) -> Float[Array, " m"]:
        """Return the disturbance M w' - f(t, x, u) that explains a motion with the state derivative `x_dot`.

        Args:
            t: time [s].
            x: state.
            x_dot: time derivative of the state, a pytree like `x`.
            u: input (m,).

        Returns:
            The disturbance (m,), in the unit of the inputs.
        """
        return self.mass(t, x) @ self.velocity(x_dot) - self.generalised_force(t, x, u)

    def implied_disturbance_impulse(
        self, t: Scalar, x: State, x_next: State, u: Float[Array, " m"], dt: Scalar
    ) -> Float[Array, " m"]:
        """Return the integral of `implied_disturbance` over a period, by the trapezium rule.

        Args:
            t: time at the end of the period [s].
            x: state at the start of the period.
            x_next: state at the end of the period.
            u: input (m,), constant in the period.
            dt: length of the period [s].

        Returns:
            The impulse (m,), in the unit of the inputs times s.
        """
        before = t - dt
        force = 0.5 * (self.generalised_force(before, x, u) + self.generalised_force(t, x_next, u))
        mass = 0.5 * (self.mass(before, x) + self.mass(t, x_next))
        return mass @ (self.velocity(x_next) - self.velocity(x)) - dt * force

    def normalise(self, x: State) -> State:
        """Return the state with its constraints met exactly, such as |q| = 1, after an integration step."""
        return x

    def signals_of(self, x: State) -> dict[str, PyTree]:
        """Return the visible part of a state by the names of `signals`."""
        return {"x": x}

    def state_of(self, signals: Mapping[str, PyTree]) -> State:
        """Return the visible state from its signals, the inverse of `signals_of`."""
        return signals["x"]

    def normalise_measurement(self, measured: State) -> State:
        """Return a measured state with its constraints met. A state that meets them up to rounding is not changed."""
        return measured

    def nearest_representation(self, x: State, other: State) -> State:
        """Return the representation of a state that is nearest to another state: q and -q are the same attitude."""
        return x

    def visible(self, x: State) -> State:
        """Return the part of a state that sensors measure, which is the state of the design model."""
        return x

    def planning_plant(self, model: "Plant") -> "Plant":
        """Return the plant for planning a motion: the law's `model` if the input acts through hidden states."""
        return self

    def with_hidden_at_rest(self, visible: State) -> State:
        """Return the state with this visible part and hidden states at rest."""
        return visible

    def retract(self, x: State, by: Float[Array, " n"]) -> State:
        """Return the state near x at local coordinates (n,), one for each degree of freedom, visible ones first."""
        return x + by

    def local_coordinates(self, x: State, other: State) -> Float[Array, " n"]:
        """Return the local coordinates (n,) of a state near x, to first order: the inverse of `retract`."""
        return other - x

    @abstractmethod
    def speed(self, x: State) -> Scalar:
        """Return the scalar speed; its largest value is the metric peak_rate."""

    def momentum(self, x: State) -> Float[Array, " m"] | None:
        """Return the momentum, or None; its largest 2-norm is the metric peak_momentum."""
        return None

    def is_too_fast(self, x: State, dt: Scalar) -> Array:
        """Return whether the state changes too much for an integration step of dt [s]."""
        return jnp.zeros_like(dt, dtype=bool)

    def modal_amplitude(self, x: State) -> Scalar | None:
        """Return the amplitude of the modes for the metrics peak_modal and residual_modal; None without modes."""
        return None

    @abstractmethod
    def columns(self, x: State) -> dict[str, ArrayLike]:
        """Return the columns of a history of states (time, ..): name -> (time, components)."""

    def hidden_columns(self, x: State) -> dict[str, ArrayLike]:
        """Return the columns of the hidden states, such as flexible modes."""
        return {}


def as_pytree(function: Callable | None) -> Any:
    """Return a function as a pytree, for a field of a plant; pytrees and None are returned unchanged."""
    is_plain_function = function is not None and jax.tree.leaves(function) == [function]
    return jax.tree_util.Partial(function) if is_plain_function else function


def check_indices(function: Callable, *arguments: Any) -> None:
    """Raise IndexError if a custom function takes an element that its arguments do not have.

    JAX would silently take the last element.

    Args:
        function: the custom function.
        arguments: its arguments, as pytrees of arrays, of their shapes, or of plain numbers.
    """
    try:
        # NumPy raises IndexError, and JAX does not
        numeric_arguments = jax.tree.map(lambda v: np.zeros(v.shape, v.dtype) if hasattr(v, "shape") else v, arguments)
        jax.eval_shape(lambda: function(*numeric_arguments))
    except IndexError:
        raise
    except (Exception, SystemExit):  # the function accepts JAX arrays only
        return
