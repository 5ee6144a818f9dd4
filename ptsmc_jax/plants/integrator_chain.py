"""The chain of integrators of (6), (35)."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from ptsmc_jax.numerics.pytrees import Scalar, pytree
from ptsmc_jax.plants.base import Plant, as_pytree, check_indices


@pytree
@dataclass(frozen=True)
class Chain(Plant):
    """Integrator chain (35) of any order n >= 2: x_i' = x_(i+1), x_n' = f(x) + g(x) u + d; order 2 is (6).

    Its state is (n,). f and g are functions of the state that return a scalar. They are pytrees, such as
    `jax.tree_util.Partial(function, parameters)`. None: f = 0, g = 1. Build it with `chain`.
    """

    order: int = field(metadata={"static": True})
    f: Any = None
    g: Any = None

    @property
    def inertia(self) -> Float[Array, "1 1"]:
        """The scalar 1, because the disturbance of (35) is an acceleration of x_n."""
        return jnp.ones((1, 1))

    inertia_inverse = inertia

    @property
    def state_shapes(self) -> dict[str, tuple[int, ...]]:
        """One array (n,)."""
        return {"": (self.order,)}

    def drift(self, x: Float[Array, " n"]) -> Float[Array, "1"]:
        """Return f(x), (1,)."""
        return jnp.zeros(1) if self.f is None else jnp.reshape(self.f(x), 1)

    def input_gain(self, x: Float[Array, " n"]) -> Float[Array, "1"]:
        """Return g(x), (1,)."""
        return jnp.ones(1) if self.g is None else jnp.reshape(self.g(x), 1)

    def velocity(self, x: Float[Array, " n"]) -> Float[Array, "1"]:
        """Return x_n, (1,)."""
        return x[-1:]

    def generalised_force(self, t: Scalar, x: Float[Array, " n"], u: Float[Array, "1"]) -> Float[Array, "1"]:
        """Return f(x) + g(x) u, (1,)."""
        return self.drift(x) + self.input_gain(x) * u

    def rate(
        self, t: Scalar, x: Float[Array, " n"], u: Float[Array, "1"], disturbance: Float[Array, "1"]
    ) -> Float[Array, " n"]:
        """Return the time derivative of the state, (35)."""
        return jnp.concatenate([x[1:], self.generalised_force(t, x, u) + disturbance])

    def input_for(
        self, t: Scalar, x: Float[Array, " n"], w_dot: Float[Array, "1"], d: Float[Array, "1"]
    ) -> Float[Array, "1"]:
        """Return the input (x_n' - f(x) - d) / g(x)."""
        return (w_dot - d - self.drift(x)) / self.input_gain(x)

    def speed(self, x: Float[Array, " n"]) -> Scalar:
        """Return |x_2| = |x_1'|."""
        return jnp.abs(x[1])

    def columns(self, x: Array | np.ndarray) -> dict[str, ArrayLike]:
        """Return the states x1..xn."""
        return {"x": x}


def chain(order: int, f: Callable | None = None, g: Callable | None = None) -> Chain:
    """Return an integrator chain.

    Args:
        order: order n of the chain.
        f: function of the state (n,), see `Chain`.
        g: function of the state (n,), see `Chain`.

    Raises:
        ValueError: n is below 2, or a function uses an element that the state does not have.
    """
    if not isinstance(order, int) or isinstance(order, bool) or order < 2:
        raise ValueError(f"order is {order!r}, but must be a whole number of at least 2")
    for name, function in (("f", f), ("g", g)):
        try:
            if function is not None:
                check_indices(function, jax.ShapeDtypeStruct((order,), float))
        except IndexError as error:
            raise ValueError(f"{name}(x) fails for x of shape ({order},): {error}") from error
    return Chain(order, as_pytree(f), as_pytree(g))
