"""Second-order systems (25) of one's own."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax.numerics import guards, matrices
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, pytree
from ptsmc_jax.plants.base import Plant, as_pytree, check_indices


@pytree
@dataclass(frozen=True)
class System(Plant):
    """Second-order system (25) of one's own: x_1' = F, x_2' = H + G u + D d; all are functions of (t, x_1, x_2).

    x_1, x_2, u and d are (n,), the state (2n,) is x_1 followed by x_2. Time is an argument, since x_1 is an error:
    where the reference moves, F knows it. Its M is D^-1. Build it with `system`.
    """

    F: Any  # -> (n,)
    H: Any  # -> (n,)
    G: Any  # -> (n, n)
    D: Any  # -> (n, n), or None for the identity
    of_own_functions: ClassVar[bool] = True
    inertia: Leaf  # (n, n) that observers read their gains against, the identity if nothing else is said
    inertia_inverse: Leaf  # (n, n)

    @property
    def states(self) -> int:
        """The length of x_1 and x_2 together."""
        return 2 * self.inputs

    def split(self, x: Float[Array, " twice"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """x_1 and x_2."""
        n = self.inputs
        return x[:n], x[n : 2 * n]

    def position(self, x: Float[Array, " twice"]) -> Float[Array, " n"]:
        """x_1."""
        return x[: self.inputs]

    def velocity(self, x: Float[Array, " twice"]) -> Float[Array, " n"]:
        """x_2."""
        return x[self.inputs : 2 * self.inputs]

    def position_rate(self, t: Scalar, x: Float[Array, " twice"]) -> Float[Array, " n"]:
        """x_1' = F."""
        return self.F(t, *self.split(x))

    def slope(self, t: Scalar, x: Float[Array, " twice"]) -> Float[Array, "n n"]:
        """dF/dx2."""
        return jax.jacfwd(self.F, argnums=2)(t, *self.split(x))

    def coasting_acceleration(self, t: Scalar, x: Float[Array, " twice"]) -> Float[Array, " n"]:
        """The x_1'' where x_2' = 0: dF/dt + dF/dx1 F."""
        x_1, x_2 = self.split(x)
        rates = (jnp.ones_like(t), self.F(t, x_1, x_2))
        return jax.jvp(lambda t, x_1: self.F(t, x_1, x_2), (t, x_1), rates)[1]

    def drift(self, t: Scalar, x: Float[Array, " twice"]) -> Float[Array, " n"]:
        """H."""
        return self.H(t, *self.split(x))

    def input_gain(self, t: Scalar, x: Float[Array, " twice"]) -> Float[Array, "n n"]:
        """G."""
        return self.G(t, *self.split(x))

    def disturbance_gain(self, t: Scalar, x: Float[Array, " twice"]) -> Float[Array, "n n"]:
        """D."""
        return jnp.eye(self.inputs) if self.D is None else self.D(t, *self.split(x))

    def mass(self, t: Scalar, x: Float[Array, " twice"]) -> Float[Array, "n n"]:
        """D^-1."""
        one = jnp.eye(self.inputs)
        return one if self.D is None else matrices.solve(self.disturbance_gain(t, x), one)

    def driven(self, t: Scalar, x: Float[Array, " twice"], u: Float[Array, " n"]) -> Float[Array, " n"]:
        """H + G u, the x_2' without a disturbance."""
        return self.drift(t, x) + self.input_gain(t, x) @ u

    def generalised_force(self, t: Scalar, x: Float[Array, " twice"], u: Float[Array, " n"]) -> Float[Array, " n"]:
        """D^-1 (H + G u)."""
        driven = self.driven(t, x, u)
        return driven if self.D is None else matrices.solve(self.disturbance_gain(t, x), driven)

    def rate(
        self, t: Scalar, x: Float[Array, " twice"], u: Float[Array, " n"], disturbance: Float[Array, " n"]
    ) -> Float[Array, " twice"]:
        """Time derivative of the state, (25)."""
        x_2_dot = self.driven(t, x, u) + self.disturbance_gain(t, x) @ disturbance
        return jnp.concatenate([self.position_rate(t, x), x_2_dot, *self.hidden_rates(t, x, u)])

    def hidden_rates(self, t: Scalar, x: Float[Array, " twice"], u: Float[Array, " n"]) -> tuple[Array, ...]:
        """Derivatives of the states that follow x_2: there are none."""
        return ()

    def input_for(
        self, t: Scalar, x: Float[Array, " twice"], w_dot: Float[Array, " n"], d: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """G^-1 (x_2' - H - D d)."""
        from_input = w_dot - self.drift(t, x) - self.disturbance_gain(t, x) @ d
        return matrices.solve(self.input_gain(t, x), from_input)

    def speed(self, x: Float[Array, " twice"]) -> Scalar:
        """|x_2|."""
        return guards.norm(self.velocity(x))

    def jacobian(self, t: Scalar, x: Float[Array, " twice"], u: Float[Array, " n"]) -> Float[Array, "twice twice"]:
        """The matrix dx'/dx at an input that is held: its eigenvalues are what integration steps must follow [1/s]."""
        return jax.jacfwd(lambda x: self.rate(t, x, u, jnp.zeros(self.inputs)))(x)

    def columns(self, x: Any) -> dict[str, Any]:
        """The states x_1 and x_2, one after the other."""
        return {"x": x[..., : 2 * self.inputs]}


@pytree
@dataclass(frozen=True)
class HiddenSystem(System):
    """A truth with states z (k,) that no sensor sees and no law knows: a lag, a tank, a mode. Build it with `system`.

    x_1' = F, x_2' = H(t, x_1, x_2, z) + G u + D d and z' = Z(t, x_1, x_2, z, u); F, G and D as of any system. The state
    (2n + k,) is x_1, x_2, z; z is z0 at t = 0.
    """

    Z: Any  # -> (k,)
    z0: Leaf  # (k,)

    @property
    def states(self) -> int:
        """The length of x_1, x_2 and z together."""
        return 2 * self.inputs + self.z0.shape[-1]

    def drift(self, t: Scalar, x: Float[Array, " whole"]) -> Float[Array, " n"]:
        """H."""
        return self.H(t, *self.split(x), x[2 * self.inputs :])

    def hidden_rates(self, t: Scalar, x: Float[Array, " whole"], u: Float[Array, " n"]) -> tuple[Array, ...]:
        """The derivative Z of z."""
        return (self.Z(t, *self.split(x), x[2 * self.inputs :], u),)

    def visible(self, x: Float[Array, " whole"]) -> Float[Array, " twice"]:
        """x_1 and x_2."""
        return x[: 2 * self.inputs]

    def to_plan_by(self, model: Any) -> Any:
        """The model: an input that acts through z alone is none for x_2' at once."""
        return model

    def with_hidden_at_rest(self, visible: Float[Array, " twice"]) -> Float[Array, " whole"]:
        """The state of these x_1 and x_2, with z at z0."""
        return jnp.append(visible, self.z0)

    def hidden_columns(self, x: Any) -> dict[str, Any]:
        """The states z."""
        return {"z": x[..., 2 * self.inputs :]}


def system(
    n: int,
    F: Callable,
    H: Callable,
    G: Callable,
    D: Callable | None = None,
    inertia: object = None,
    *,
    Z: Callable | None = None,
    z0: object = (),
) -> System:
    """Second-order system (25) from JAX functions of (t, x_1, x_2), t [s] and x_1, x_2 (n,); see `System`.

    Args:
        n: number of inputs.
        F: x_1', (n,).
        H: x_2' without input and disturbance, (n,); with Z it takes the hidden states z as a fourth argument.
        G: input matrix, (n, n).
        D: the disturbance's input matrix, (n, n), which must be invertible for any observer; None: the identity.
        inertia: (n, n), symmetric and positive definite, that observers read their gains against, A = l inertia^-1;
            None: the identity, gains are then in 1/s.
        Z: derivative of hidden states z (k,), of (t, x_1, x_2, z, u): a truth to fly, see `HiddenSystem`.
        z0: z at t = 0, (k,).

    Raises:
        ValueError: a function does not take such arguments, or returns another shape; or the numbers do not fit.
    """
    if not isinstance(n, int) or isinstance(n, bool) or n < 1:
        raise ValueError(f"n is {n!r}, but must be a whole number of at least 1")
    number = jax.ShapeDtypeStruct((), jnp.result_type(float))
    vector = jax.ShapeDtypeStruct((n,), number.dtype)
    z = _hidden(z0, Z)
    signatures: list[tuple[str, Any, tuple, tuple]] = [
        ("F(t, x_1, x_2)", F, (vector, vector), (n,)),
        ("H(t, x_1, x_2)", H, (vector, vector), (n,))
        if Z is None
        else ("H(t, x_1, x_2, z)", H, (vector, vector, z), (n,)),
        ("G(t, x_1, x_2)", G, (vector, vector), (n, n)),
        ("D(t, x_1, x_2)", D, (vector, vector), (n, n)),
        ("Z(t, x_1, x_2, z, u)", Z, (vector, vector, z, vector), z.shape),
    ]
    for name, function, arguments, shape in signatures:
        if function is not None:
            _check(name, function, (number, *arguments), shape)
    scale = np.eye(n) if inertia is None else np.asarray(inertia, dtype=float)
    symmetric = scale.shape == (n, n) and np.abs(scale - scale.T).max() <= 1e-9 * np.abs(scale).max()
    if not symmetric or np.linalg.eigvalsh(scale)[0] <= 0:
        raise ValueError(f"inertia must be a symmetric, positive definite ({n}, {n}) matrix")
    functions = as_pytree(F), as_pytree(H), as_pytree(G), as_pytree(D)
    fields = *functions, jnp.asarray(scale, dtype=float), jnp.asarray(np.linalg.inv(scale), dtype=float)
    return System(*fields) if Z is None else HiddenSystem(*fields, as_pytree(Z), z)


# what JAX raises where a traced number is asked for its value, and what stands in place of that
TRACED = (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError)
INSTEAD = "allowed are jax.numpy.where in place of if, and jax.numpy in place of numpy and float()"


def _check(name: str, function: Callable, arguments: tuple, shape: tuple[int, ...]) -> None:
    """Raise ValueError where a function fails, has no slopes, or returns what is no array of this shape and type."""
    n, exact = arguments[1].shape[0], arguments[0].dtype

    def traced(what: str, of: Callable) -> Any:
        try:
            check_indices(of, *arguments)
            return jax.eval_shape(of, *arguments)
        except (Exception, SystemExit) as error:
            first_line = (str(error).splitlines() or [""])[0]
            told = f"{first_line.rstrip('.')}; {INSTEAD}" if isinstance(error, TRACED) else first_line
            failure = f"{type(error).__name__}: {told}"
            raise ValueError(f"{name} {what} for x_1 and x_2 of shape ({n},): {failure}") from error

    returned = traced("fails", function)
    returned_shape = getattr(returned, "shape", type(returned).__name__)
    if returned_shape != shape:
        raise ValueError(f"{name} returns {returned_shape}, but for n = {n} must return an array {shape}")
    # F alone is differentiated before anything is added to it
    if (returned.dtype if name[0] == "F" else jnp.result_type(returned.dtype, exact)) != exact:
        raise ValueError(f"{name} returns {returned.dtype} numbers, but must return {exact} ones")
    traced("cannot be differentiated", lambda *at: jax.jvp(function, at, at))


def _hidden(z0: object, Z: Callable | None) -> Float[Array, " k"]:
    """The initial hidden states (k,). Raises ValueError where they are no list of numbers, or Z is missing."""
    try:
        z = np.atleast_1d(np.asarray(z0, dtype=float))
    except (TypeError, ValueError):
        z = np.full((1, 1), np.nan)
    if z.ndim != 1 or not np.all(np.isfinite(z)):
        raise ValueError(f"z0 is {z0}, but must be a list of finite numbers")
    if (Z is None) != (z.size == 0):
        raise ValueError("Z and z0 go together: a hidden state needs its derivative and where it begins")
    return jnp.asarray(z)
