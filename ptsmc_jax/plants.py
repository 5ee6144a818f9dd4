"""What is controlled: the rigid spacecraft of (1) and (2), and the integrator chain of (6) and (35)."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax import attitude, numerics
from ptsmc_jax.numerics import Leaf

Scalar = Float[Array, ""]


class Plant(ABC):
    """A plant whose velocity w, the state that input u and disturbance d act on, obeys M w' = known(x, u) + d.

    M is `inertia`, constant, (m, m); u, d and w are (m,). The rollout, the observers and the metrics need no more.
    """

    inertia: Any  # (m, m)
    inertia_inverse: Any  # (m, m)

    @property
    def inputs(self) -> int:
        """How many inputs m there are."""
        return self.inertia.shape[-1]

    @abstractmethod
    def velocity(self, x: Any) -> Float[Array, " m"]:
        """W of a state; of a state's derivative, w'."""

    @abstractmethod
    def known(self, x: Any, u: Float[Array, " m"]) -> Float[Array, " m"]:
        """What drives w besides the disturbance."""

    @abstractmethod
    def rate(self, x: Any, u: Float[Array, " m"], disturbance: Float[Array, " m"]) -> Any:
        """Time derivative of the state."""

    def normalise(self, x: Any) -> Any:
        """The state with its constraints met again, which integration meets but for its error."""
        return x

    @abstractmethod
    def speed(self, x: Any) -> Scalar:
        """What the metric peak_rate is the largest of."""

    def momentum(self, x: Any) -> Float[Array, " m"]:
        """Whose 2-norm the metric peak_momentum is the largest of; NaN where a plant has none."""
        return jnp.full_like(self.velocity(x), jnp.nan)

    def too_fast(self, x: Any, dt: Scalar) -> Array:
        """Whether more happens in an integration step of dt [s] than it can follow."""
        return jnp.zeros_like(dt, dtype=bool)

    @abstractmethod
    def columns(self, x: Any) -> dict[str, Any]:
        """A history of states by the names of its columns: name -> (time, components)."""


class AttitudeState(NamedTuple):
    """State of a rigid spacecraft."""

    q: Array  # (4,) unit quaternion, scalar last, body relative to inertial [-]
    w: Array  # (3,) body rate in body axes [rad/s]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Spacecraft(Plant):
    """Rigid spacecraft, J w' = -w x J w + u + d (2); build it with `spacecraft`, which checks the inertia."""

    inertia: Leaf  # (3, 3) J [kg m^2]
    inertia_inverse: Leaf  # (3, 3) [1/(kg m^2)], factored once: no solve in the loop

    def gyroscopic(self, w: Float[Array, "3"]) -> Float[Array, "3"]:
        """W x J w [N m]."""
        return jnp.cross(w, self.inertia @ w)

    def velocity(self, x: AttitudeState) -> Float[Array, "3"]:
        """W [rad/s]; of a derivative, w' [rad/s^2]."""
        return x.w

    def known(self, x: AttitudeState, u: Float[Array, "3"]) -> Float[Array, "3"]:
        """J w' without the disturbance, u - w x J w [N m]."""
        return u - self.gyroscopic(x.w)

    def rate(self, x: AttitudeState, u: Float[Array, "3"], disturbance: Float[Array, "3"]) -> AttitudeState:
        """Time derivative of the state under torque and disturbance [N m], (1) and (2)."""
        w_dot = self.inertia_inverse @ (u + disturbance - self.gyroscopic(x.w))
        return AttitudeState(attitude.derivative(x.q, x.w), w_dot)

    def normalise(self, x: AttitudeState) -> AttitudeState:
        """The state with |q| = 1 again."""
        return AttitudeState(attitude.normalise(x.q), x.w)

    def speed(self, x: AttitudeState) -> Scalar:
        """|w| [rad/s]."""
        return numerics.norm(x.w)

    def momentum(self, x: AttitudeState) -> Float[Array, "3"]:
        """Angular momentum in body axes, J w [N m s]."""
        return self.inertia @ x.w

    def too_fast(self, x: AttitudeState, dt: Scalar) -> Array:
        """Whether the body turns more than 1 rad in a step of dt [s]."""
        return jnp.sum(x.w * x.w) * dt * dt > 1.0

    def columns(self, x: AttitudeState) -> dict[str, Any]:
        """Quaternion q1..q4 and body rate w1..w3 [rad/s]."""
        return {"q": x.q, "w": x.w}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Chain(Plant):
    """Integrator chain (35) of any order n >= 2: x_i' = x_(i+1), x_n' = f(x) + g(x) u + d; order 2 is (6).

    Its state is (n,). f and g are pytrees that are called, such as `jax.tree_util.Partial(function, parameters)`,
    x (n,) -> scalar; None: f = 0, g = 1. Build it with `chain`.
    """

    order: int = field(metadata={"static": True})
    f: Any = None
    g: Any = None

    @property
    def inertia(self) -> Float[Array, "1 1"]:
        """1: the disturbance of (35) is an acceleration of x_n."""
        return jnp.ones((1, 1))

    inertia_inverse = inertia

    def drift(self, x: Float[Array, " n"]) -> Float[Array, "1"]:
        """f(x), (1,)."""
        return jnp.zeros(1) if self.f is None else jnp.reshape(self.f(x), 1)

    def input_gain(self, x: Float[Array, " n"]) -> Float[Array, "1"]:
        """g(x), (1,)."""
        return jnp.ones(1) if self.g is None else jnp.reshape(self.g(x), 1)

    def velocity(self, x: Float[Array, " n"]) -> Float[Array, "1"]:
        """x_n, (1,)."""
        return x[-1:]

    def known(self, x: Float[Array, " n"], u: Float[Array, "1"]) -> Float[Array, "1"]:
        """f(x) + g(x) u, (1,)."""
        return self.drift(x) + self.input_gain(x) * u

    def rate(self, x: Float[Array, " n"], u: Float[Array, "1"], disturbance: Float[Array, "1"]) -> Float[Array, " n"]:
        """Time derivative of the state, (35)."""
        return jnp.concatenate([x[1:], self.known(x, u) + disturbance])

    def speed(self, x: Float[Array, " n"]) -> Scalar:
        """|x_2| = |x_1'|."""
        return jnp.abs(x[1])

    def columns(self, x: Any) -> dict[str, Any]:
        """The states x1..xn."""
        return {"x": x}


def chain(order: int, f: Callable | None = None, g: Callable | None = None) -> Chain:
    """Integrator chain; f, g: see `Chain`, plain functions are wrapped. Raises ValueError where order is below 2."""
    if order < 2:
        raise ValueError(f"order is {order}, but must be at least 2")

    def wrapped(function: Callable | None) -> Any:
        plain = function is not None and jax.tree.leaves(function) == [function]  # no pytree itself
        return jax.tree_util.Partial(function) if plain else function

    return Chain(order, wrapped(f), wrapped(g))


def spacecraft(inertia: object) -> Spacecraft:
    """Spacecraft from three principal moments or a symmetric (3, 3) tensor [kg m^2].

    Raises ValueError where no rigid body can have it: not symmetric, not positive definite, or one principal moment
    larger than the sum of the other two.
    """
    tensor = check_inertia(inertia)
    return Spacecraft(jnp.asarray(tensor), jnp.asarray(np.linalg.inv(tensor)))


def check_inertia(inertia: object) -> np.ndarray:
    """The (3, 3) inertia tensor [kg m^2] that `spacecraft` would use; raises ValueError as it does."""
    try:
        tensor = np.asarray(inertia)
        if not np.issubdtype(tensor.dtype, np.number):
            raise TypeError
        tensor = tensor.astype(float)
    except (ValueError, TypeError):  # rows of different lengths, or no numbers
        tensor = np.zeros(0)
    if tensor.shape == (3,):
        tensor = np.diag(tensor)
    if tensor.shape != (3, 3):
        raise ValueError("allowed are three principal moments or a symmetric 3x3 tensor [kg m^2]")
    if not np.all(np.isfinite(tensor)):
        raise ValueError("every entry must be a finite number")
    scale = np.abs(tensor).max()
    if np.abs(tensor - tensor.T).max() > 1e-9 * scale:
        raise ValueError("the tensor must be symmetric")
    tensor = (tensor + tensor.T) / 2
    moments = np.linalg.eigvalsh(tensor)
    if moments[0] <= 1e-12 * scale:
        raise ValueError(f"the tensor must be positive definite (its smallest principal moment is {moments[0]:.6g})")
    if moments[2] > (moments[0] + moments[1]) * (1 + 1e-9):
        raise ValueError(
            "no rigid body has these principal moments: the largest, "
            f"{moments[2]:.6g}, must not exceed the sum of the other two, {moments[0] + moments[1]:.6g}"
        )
    return tensor
