"""The base of every plant."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.numerics.pytrees import Scalar


class Plant(ABC):
    """A plant whose velocity w, the state that input u and disturbance d act on, obeys M w' = f(t, x, u) + d.

    u, d and w are (m,), of a spacecraft in N m and rad/s, of others in the states' own units. M is (m, m) and, unless
    `mass` says otherwise, the constant `inertia`, against which observers read their gains. A time t is in s; a state x
    is a pytree of the plant's own kind, and so is its derivative. The rollout, the observers and the metrics need no
    more.
    """

    inertia: Any  # (m, m)
    inertia_inverse: Any  # (m, m)
    of_own_functions: ClassVar[bool] = False  # how large they are is not known, and only a run shows how fast it is
    attitude: ClassVar[bool] = False  # its state holds a quaternion q and a body rate w

    @property
    def inputs(self) -> int:
        """How many inputs m there are."""
        return self.inertia.shape[-1]

    @property
    def states(self) -> int | None:
        """How many numbers its state has; None: it is no single array."""
        return None

    @abstractmethod
    def velocity(self, x: Any) -> Float[Array, " m"]:
        """The velocity w of a state; of a state's derivative, w'."""

    def mass(self, t: Scalar, x: Any) -> Float[Array, "m m"]:
        """The matrix M."""
        return self.inertia

    @abstractmethod
    def generalised_force(self, t: Scalar, x: Any, u: Float[Array, " m"]) -> Float[Array, " m"]:
        """The force f(t, x, u) that drives w besides the disturbance."""

    @abstractmethod
    def rate(self, t: Scalar, x: Any, u: Float[Array, " m"], disturbance: Float[Array, " m"]) -> Any:
        """Time derivative of the state."""

    @abstractmethod
    def input_for(self, t: Scalar, x: Any, w_dot: Float[Array, " m"], d: Float[Array, " m"]) -> Float[Array, " m"]:
        """The input with which w' is this under a disturbance d."""

    def unexplained(self, t: Scalar, x: Any, x_dot: Any, u: Float[Array, " m"]) -> Float[Array, " m"]:
        """The disturbance that explains the motion, M w' - f(t, x, u)."""
        return self.mass(t, x) @ self.velocity(x_dot) - self.generalised_force(t, x, u)

    def unexplained_impulse(
        self, t: Scalar, x: Any, x_next: Any, u: Float[Array, " m"], dt: Scalar
    ) -> Float[Array, " m"]:
        """Its integral over a period dt [s] that ends at t, by the trapezium rule from the states at both ends."""
        before = t - dt
        force = 0.5 * (self.generalised_force(before, x, u) + self.generalised_force(t, x_next, u))
        mass = 0.5 * (self.mass(before, x) + self.mass(t, x_next))
        return mass @ (self.velocity(x_next) - self.velocity(x)) - dt * force

    def normalise(self, x: Any) -> Any:
        """The state with its constraints met exactly, such as |q| = 1, which integration meets to its error."""
        return x

    def visible(self, x: Any) -> Any:
        """The part of a state that sensors can see: the state of the nominal model, of most plants all of it."""
        return x

    def to_plan_by(self, model: Any) -> Any:
        """The plant by whose input a motion is planned: the law's model where states that it does not know act."""
        return self

    def with_hidden_at_rest(self, visible: Any) -> Any:
        """The state with this visible part, and the rest of it at rest."""
        return visible

    def retract(self, x: Any, by: Float[Array, " n"]) -> Any:
        """The state near x at local coordinates (n,), as many as x has degrees of freedom.

        Those of what sensors see come first.
        """
        return x + by

    def local_coordinates(self, x: Any, other: Any) -> Float[Array, " n"]:
        """Local coordinates (n,) of a state near x, to first order: the inverse of `retract`."""
        return other - x

    @abstractmethod
    def speed(self, x: Any) -> Scalar:
        """The scalar speed, whose largest value is the metric peak_rate."""

    def momentum(self, x: Any) -> Float[Array, " m"] | None:
        """Return the momentum, whose largest 2-norm is the metric peak_momentum; None: the plant has none."""
        return None

    def too_fast(self, x: Any, dt: Scalar) -> Array:
        """Whether the state changes more in an integration step of dt [s] than the step can follow."""
        return jnp.zeros_like(dt, dtype=bool)

    def modal_amplitude(self, x: Any) -> Scalar | None:
        """Size of the modes' motion, for the metrics peak_modal and residual_modal; None without modes."""
        return None

    @abstractmethod
    def columns(self, x: Any) -> dict[str, Any]:
        """A history of states (time, ..) as columns of a table: name -> (time, components)."""

    def hidden_columns(self, x: Any) -> dict[str, Any]:
        """The columns of the part that sensors do not see, such as flexible modes."""
        return {}


def as_pytree(function: Callable | None) -> Any:
    """A callable that may be a field of a plant: a plain function is wrapped, a pytree and None are that already."""
    plain = function is not None and jax.tree.leaves(function) == [function]
    return jax.tree_util.Partial(function) if plain else function


def check_indices(function: Callable, *arguments: Any) -> None:
    """Raise IndexError where a function of one's own takes an element that none of its arguments has.

    JAX would take the last one in its place, and say nothing. arguments: pytrees of arrays, or of their shapes, and of
    plain numbers.
    """
    try:
        # NumPy looks
        known = jax.tree.map(lambda v: np.zeros(v.shape, v.dtype) if hasattr(v, "shape") else v, arguments)
        jax.eval_shape(lambda: function(*known))
    except IndexError:
        raise
    except (Exception, SystemExit):  # what works with JAX's arrays alone
        return
