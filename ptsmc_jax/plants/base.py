"""What every plant has."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Scalar = Float[Array, ""]


class Plant(ABC):
    """A plant whose velocity w, the state that input u and disturbance d act on, obeys M w' = known(t, x, u) + d.

    u, d and w are (m,), of a spacecraft in N m and rad/s, of others in the states' own units. M is (m, m) and, unless
    `mass` says otherwise, the constant `inertia`, against which observers read their gains. The rollout, the observers
    and the metrics need no more.
    """

    inertia: Any  # (m, m)
    inertia_inverse: Any  # (m, m)
    unknown_pace: ClassVar[bool] = False  # made of functions of one's own: how fast it is, is seen along a run only
    attitude: ClassVar[bool] = False  # its state holds a quaternion q and a body rate w

    @property
    def inputs(self) -> int:
        """How many inputs m there are."""
        return self.inertia.shape[-1]

    @abstractmethod
    def velocity(self, x: Any) -> Float[Array, " m"]:
        """The velocity w of a state; of a state's derivative, w'."""

    def mass(self, t: Scalar, x: Any) -> Float[Array, "m m"]:
        """The matrix M."""
        return self.inertia

    @abstractmethod
    def known(self, t: Scalar, x: Any, u: Float[Array, " m"]) -> Float[Array, " m"]:
        """What drives w besides the disturbance."""

    @abstractmethod
    def rate(self, t: Scalar, x: Any, u: Float[Array, " m"], disturbance: Float[Array, " m"]) -> Any:
        """Time derivative of the state."""

    @abstractmethod
    def input_for(self, t: Scalar, x: Any, w_dot: Float[Array, " m"], d: Float[Array, " m"]) -> Float[Array, " m"]:
        """The input with which w' is this under a disturbance d."""

    def unexplained(self, t: Scalar, x: Any, x_dot: Any, u: Float[Array, " m"]) -> Float[Array, " m"]:
        """The disturbance that explains the motion, M w' - known(t, x, u)."""
        return self.mass(t, x) @ self.velocity(x_dot) - self.known(t, x, u)

    def unexplained_impulse(
        self, t: Scalar, x: Any, x_next: Any, u: Float[Array, " m"], dt: Scalar
    ) -> Float[Array, " m"]:
        """Its integral over a period dt [s] that ends at t, by the trapezium rule from the states at both ends."""
        before = t - dt
        known = 0.5 * (self.known(before, x, u) + self.known(t, x_next, u))
        mass = 0.5 * (self.mass(before, x) + self.mass(t, x_next))
        return mass @ (self.velocity(x_next) - self.velocity(x)) - dt * known

    def normalise(self, x: Any) -> Any:
        """The state with its constraints met again, which integration meets but for its error."""
        return x

    def seen(self, x: Any) -> Any:
        """What sensors see of a state: that of the model which law and observer know. Of most plants all of it."""
        return x

    def at_rest(self, seen: Any) -> Any:
        """The state of which sensors see this, with what they do not see at rest."""
        return seen

    def moved(self, x: Any, by: Float[Array, " n"]) -> Any:
        """A state near another one: local coordinates (n,), as many as it has degrees of freedom.

        Those of what sensors see come first.
        """
        return x + by

    def apart(self, x: Any, other: Any) -> Float[Array, " n"]:
        """Local coordinates (n,) of a state near x, to first order."""
        return other - x

    @abstractmethod
    def speed(self, x: Any) -> Scalar:
        """What the metric peak_rate is the largest of."""

    def momentum(self, x: Any) -> Float[Array, " m"]:
        """Whose 2-norm the metric peak_momentum is the largest of; NaN where a plant has none."""
        return jnp.full_like(self.velocity(x), jnp.nan)

    def too_fast(self, x: Any, dt: Scalar) -> Array:
        """Whether more happens in an integration step of dt [s] than it can follow."""
        return jnp.zeros_like(dt, dtype=bool)

    def ringing(self, x: Any) -> Scalar | None:
        """What the metrics peak_modal and residual_modal are the largest of; None where nothing rings."""
        return None

    @abstractmethod
    def columns(self, x: Any) -> dict[str, Any]:
        """A history of states by the names of its columns: name -> (time, components)."""

    def hidden_columns(self, x: Any) -> dict[str, Any]:
        """The columns of what sensors do not see, such as flexible modes."""
        return {}


def called(function: Callable | None) -> Any:
    """A function as a pytree that can be called."""
    plain = function is not None and jax.tree.leaves(function) == [function]  # no pytree itself
    return jax.tree_util.Partial(function) if plain else function
