"""Custom second-order systems (25)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from ptsmc_jax.numerics import guards, matrices
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, pytree
from ptsmc_jax.plants.base import Plant, as_pytree, check_indices


@pytree
@dataclass(frozen=True)
class System(Plant):
    """Custom second-order system (25): x_1' = F, x_2' = H + G u + D d, with functions of (t, x_1, x_2).

    x_1, x_2, u and d are (n,). The state (2n,) is x_1 followed by x_2. F depends on time if the reference moves, since
    x_1 is an error. M is D^-1. Build it with `system`.
    """

    F: Any  # function that returns x_1', (n,)
    H: Any  # function that returns x_2' without input and disturbance, (n,)
    G: Any  # function that returns the matrix of the input u, (n, n)
    D: Any  # function that returns the matrix of the disturbance d, (n, n); None: the identity
    custom_functions: ClassVar[bool] = True
    inertia: Leaf  # (n, n) matrix that scales observer gains, by default the identity
    inertia_inverse: Leaf  # (n, n) inverse of `inertia`

    @property
    def state_shapes(self) -> dict[str, tuple[int, ...]]:
        """One array (2n,)."""
        return {"": (2 * self.inputs,)}

    def split(self, x: Float[Array, " twice"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
        """Return x_1 and x_2, (n,) each."""
        n = self.inputs
        return x[:n], x[n : 2 * n]

    def position(self, x: Float[Array, " twice"]) -> Float[Array, " n"]:
        """Return x_1."""
        return x[: self.inputs]

    def velocity(self, x: Float[Array, " twice"]) -> Float[Array, " n"]:
        """Return x_2."""
        return x[self.inputs : 2 * self.inputs]

    def position_rate(self, t: Scalar, x: Float[Array, " twice"]) -> Float[Array, " n"]:
        """Return x_1' = F."""
        return self.F(t, *self.split(x))

    def rate_jacobian(self, t: Scalar, x: Float[Array, " twice"]) -> Float[Array, "n n"]:
        """Return the Jacobian dF/dx2 of x_1'."""
        return jax.jacfwd(self.F, argnums=2)(t, *self.split(x))

    def coasting_acceleration(self, t: Scalar, x: Float[Array, " twice"]) -> Float[Array, " n"]:
        """Return x_1'' for x_2' = 0, which is dF/dt + dF/dx1 F."""
        x_1, x_2 = self.split(x)
        rates = (jnp.ones_like(t), self.F(t, x_1, x_2))
        return jax.jvp(lambda t, x_1: self.F(t, x_1, x_2), (t, x_1), rates)[1]

    def drift(self, t: Scalar, x: Float[Array, " twice"]) -> Float[Array, " n"]:
        """Return H, which is x_2' without input and disturbance."""
        return self.H(t, *self.split(x))

    def input_gain(self, t: Scalar, x: Float[Array, " twice"]) -> Float[Array, "n n"]:
        """Return G, the matrix of the input in x_2'."""
        return self.G(t, *self.split(x))

    def disturbance_gain(self, t: Scalar, x: Float[Array, " twice"]) -> Float[Array, "n n"]:
        """Return D, the matrix of the disturbance in x_2'."""
        return jnp.eye(self.inputs) if self.D is None else self.D(t, *self.split(x))

    def mass(self, t: Scalar, x: Float[Array, " twice"]) -> Float[Array, "n n"]:
        """Return the matrix M of `Plant`, which is D^-1."""
        one = jnp.eye(self.inputs)
        return one if self.D is None else matrices.solve(self.disturbance_gain(t, x), one)

    def undisturbed_rate(self, t: Scalar, x: Float[Array, " twice"], u: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return H + G u (n,), which is x_2' without the disturbance.

        Args:
            t: time [s].
            x: state (2n,), or with hidden states (2n + k,).
            u: input (n,).
        """
        return self.drift(t, x) + self.input_gain(t, x) @ u

    def generalised_force(self, t: Scalar, x: Float[Array, " twice"], u: Float[Array, " n"]) -> Float[Array, " n"]:
        """Return the force f of `Plant`, which is D^-1 (H + G u)."""
        rate = self.undisturbed_rate(t, x, u)
        return rate if self.D is None else matrices.solve(self.disturbance_gain(t, x), rate)

    def rate(
        self, t: Scalar, x: Float[Array, " twice"], u: Float[Array, " n"], disturbance: Float[Array, " n"]
    ) -> Float[Array, " twice"]:
        """Return the time derivative of the state, (25)."""
        x_2_dot = self.undisturbed_rate(t, x, u) + self.disturbance_gain(t, x) @ disturbance
        return jnp.concatenate([self.position_rate(t, x), x_2_dot, *self.hidden_rates(t, x, u)])

    def hidden_rates(self, t: Scalar, x: Float[Array, " twice"], u: Float[Array, " n"]) -> tuple[Array, ...]:
        """Return the derivatives of the hidden states, which this plant does not have.

        Args:
            t: time [s].
            x: state (2n,), or with hidden states (2n + k,).
            u: input (n,).

        Returns:
            A tuple with the array z' (k,), empty without hidden states.
        """
        return ()

    def input_for(
        self, t: Scalar, x: Float[Array, " twice"], w_dot: Float[Array, " n"], d: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """Return the input G^-1 (x_2' - H - D d)."""
        from_input = w_dot - self.drift(t, x) - self.disturbance_gain(t, x) @ d
        return matrices.solve(self.input_gain(t, x), from_input)

    def speed(self, x: Float[Array, " twice"]) -> Scalar:
        """Return |x_2|."""
        return guards.norm(self.velocity(x))

    def jacobian(self, t: Scalar, x: Float[Array, " twice"], u: Float[Array, " n"]) -> Float[Array, "twice twice"]:
        """Return dx'/dx at a constant input. Integration steps must resolve its eigenvalues [1/s].

        Args:
            t: time [s].
            x: state (2n,), or with hidden states (2n + k,).
            u: input (n,).

        Returns:
            The matrix (2n, 2n), or (2n + k, 2n + k) with hidden states.
        """
        return jax.jacfwd(lambda x: self.rate(t, x, u, jnp.zeros(self.inputs)))(x)

    def columns(self, x: Array | np.ndarray) -> dict[str, ArrayLike]:
        """Return the states x_1 and x_2, one after the other."""
        return {"x": x[..., : 2 * self.inputs]}


@pytree
@dataclass(frozen=True)
class HiddenSystem(System):
    """A true plant with hidden states z (k,), such as a lag, a tank or a mode. Build it with `system`.

    x_1' = F, x_2' = H(t, x_1, x_2, z) + G u + D d and z' = Z(t, x_1, x_2, z, u), with F, G and D as in `System`. The
    state (2n + k,) is x_1, x_2, z. At t = 0 z is z0.
    """

    Z: Any  # function that returns z', (k,)
    z0: Leaf  # (k,) hidden states at t = 0

    @property
    def state_shapes(self) -> dict[str, tuple[int, ...]]:
        """One array (2n + k,): x_1, x_2 and the k hidden states z."""
        return {"": (2 * self.inputs + self.z0.shape[-1],)}

    def drift(self, t: Scalar, x: Float[Array, " whole"]) -> Float[Array, " n"]:
        """Return H, which is x_2' without input and disturbance."""
        return self.H(t, *self.split(x), x[2 * self.inputs :])

    def hidden_rates(self, t: Scalar, x: Float[Array, " whole"], u: Float[Array, " n"]) -> tuple[Array, ...]:
        """Return the time derivative Z of the hidden states z."""
        return (self.Z(t, *self.split(x), x[2 * self.inputs :], u),)

    def visible(self, x: Float[Array, " whole"]) -> Float[Array, " twice"]:
        """Return x_1 and x_2."""
        return x[: 2 * self.inputs]

    def planning_plant(self, model: Plant) -> Plant:
        """Return the model, because an input that acts through z only does not change x_2' immediately."""
        return model

    def with_hidden_at_rest(self, visible: Float[Array, " twice"]) -> Float[Array, " whole"]:
        """Return the state of these x_1 and x_2, with z = z0."""
        return jnp.append(visible, self.z0)

    def hidden_columns(self, x: Array | np.ndarray) -> dict[str, ArrayLike]:
        """Return the hidden states z."""
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
    """Return a second-order system (25) from JAX functions of (t, x_1, x_2), t [s] and x_1, x_2 (n,); see `System`.

    Args:
        n: number of inputs.
        F: x_1', (n,).
        H: x_2' without input and disturbance, (n,); with Z it takes the hidden states z as a fourth argument.
        G: input matrix, (n, n).
        D: the disturbance's input matrix, (n, n), which must be invertible for any observer; None: the identity.
        inertia: (n, n), symmetric and positive definite, scale of observer gains, A = l inertia^-1; None: the identity,
            with gains in 1/s.
        Z: derivative of hidden states z (k,), of (t, x_1, x_2, z, u), for a true plant, see `HiddenSystem`.
        z0: z at t = 0, (k,).

    Raises:
        ValueError: a function fails for such arguments or returns another shape, or n, inertia or z0 is not valid.
    """
    if not isinstance(n, int) or isinstance(n, bool) or n < 1:
        raise ValueError(f"n is {n!r}, but must be a whole number of at least 1")
    number = jax.ShapeDtypeStruct((), jnp.result_type(float))
    vector = jax.ShapeDtypeStruct((n,), number.dtype)
    z = _check_hidden_states(z0, Z)
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
            _check_function(name, function, (number, *arguments), shape)
    scale = np.eye(n) if inertia is None else np.asarray(inertia, dtype=float)
    symmetric = scale.shape == (n, n) and np.abs(scale - scale.T).max() <= 1e-9 * np.abs(scale).max()
    if not symmetric or np.linalg.eigvalsh(scale)[0] <= 0:
        raise ValueError(f"inertia must be a symmetric, positive definite ({n}, {n}) matrix")
    functions = as_pytree(F), as_pytree(H), as_pytree(G), as_pytree(D)
    fields = *functions, jnp.asarray(scale, dtype=float), jnp.asarray(np.linalg.inv(scale), dtype=float)
    return System(*fields) if Z is None else HiddenSystem(*fields, as_pytree(Z), z)


# errors that JAX raises if a function needs the value of a traced number, and the advice that is printed
TRACING_ERRORS = (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError)
TRACING_ADVICE = "use jax.numpy.where instead of if, and jax.numpy instead of numpy and float()"


def _check_function(name: str, function: Callable, arguments: tuple, shape: tuple[int, ...]) -> None:
    """Raise ValueError if a function fails, has no derivative, or returns another shape or type."""
    n, dtype = arguments[1].shape[0], arguments[0].dtype

    def trace(failure_text: str, traced_function: Callable) -> Any:
        try:
            check_indices(traced_function, *arguments)
            return jax.eval_shape(traced_function, *arguments)
        except (Exception, SystemExit) as error:
            first_line = (str(error).splitlines() or [""])[0]
            reason = f"{first_line.rstrip('.')}; {TRACING_ADVICE}" if isinstance(error, TRACING_ERRORS) else first_line
            failure = f"{type(error).__name__}: {reason}"
            raise ValueError(f"{name} {failure_text} for x_1 and x_2 of shape ({n},): {failure}") from error

    returned = trace("fails", function)
    returned_shape = getattr(returned, "shape", type(returned).__name__)
    if returned_shape != shape:
        raise ValueError(f"{name} returns {returned_shape}, but for n = {n} must return an array {shape}")
    # F is differentiated directly, so its type must be exact; other values are first added to floating-point numbers
    if (returned.dtype if name[0] == "F" else jnp.result_type(returned.dtype, dtype)) != dtype:
        raise ValueError(f"{name} returns {returned.dtype} numbers, but must return {dtype} ones")
    trace("cannot be differentiated", lambda *arguments: jax.jvp(function, arguments, arguments))


def _check_hidden_states(z0: object, Z: Callable | None) -> Float[Array, " k"]:
    """Return the initial hidden states (k,). Raises ValueError if they are not a list of numbers, or Z is missing."""
    try:
        z = np.atleast_1d(np.asarray(z0, dtype=float))
    except (TypeError, ValueError):
        z = np.full((1, 1), np.nan)
    if z.ndim != 1 or not np.all(np.isfinite(z)):
        raise ValueError(f"z0 is {z0}, but must be a list of finite numbers")
    if (Z is None) != (z.size == 0):
        raise ValueError("Z and z0 go together: a hidden state needs a derivative and an initial value")
    return jnp.asarray(z)
