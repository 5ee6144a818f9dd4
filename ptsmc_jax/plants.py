"""What is controlled: the rigid spacecraft of (1), (2), the chain of (6), (35), and systems (25) of one's own."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax import attitude, numerics
from ptsmc_jax.formulas import check_inertia
from ptsmc_jax.numerics import Leaf, pytree

Scalar = Float[Array, ""]


class Plant(ABC):
    """A plant whose velocity w, the state that input u and disturbance d act on, obeys M w' = known(t, x, u) + d.

    u, d and w are (m,), of a spacecraft in N m and rad/s, of others in the states' own units. M is (m, m) and, unless
    `mass` says otherwise, the constant `inertia`, against which observers read their gains. The rollout, the observers
    and the metrics need no more.
    """

    inertia: Any  # (m, m)
    inertia_inverse: Any  # (m, m)

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

    def moved(self, x: Any, by: Float[Array, " n"]) -> Any:
        """A state near another one: local coordinates (n,), as many as it has degrees of freedom."""
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

    @abstractmethod
    def columns(self, x: Any) -> dict[str, Any]:
        """A history of states by the names of its columns: name -> (time, components)."""


class AttitudeState(NamedTuple):
    """State of a rigid spacecraft."""

    q: Array  # (4,) unit quaternion, scalar last, body relative to inertial [-]
    w: Array  # (3,) body rate in body axes [rad/s]


@pytree
@dataclass(frozen=True)
class Spacecraft(Plant):
    """Rigid spacecraft, J w' = -w x J w + u + d (2); build it with `spacecraft`, which checks the inertia."""

    inertia: Leaf  # (3, 3) J [kg m^2]
    inertia_inverse: Leaf  # (3, 3) [1/(kg m^2)], factored once: no solve in the loop

    def gyroscopic(self, w: Float[Array, "3"]) -> Float[Array, "3"]:
        """The torque w x J w [N m]."""
        return jnp.cross(w, self.inertia @ w)

    def velocity(self, x: AttitudeState) -> Float[Array, "3"]:
        """The rate w [rad/s]; of a derivative, w' [rad/s^2]."""
        return x.w

    def known(self, t: Scalar, x: AttitudeState, u: Float[Array, "3"]) -> Float[Array, "3"]:
        """J w' without the disturbance, u - w x J w [N m]."""
        return u - self.gyroscopic(x.w)

    def rate(self, t: Scalar, x: AttitudeState, u: Float[Array, "3"], disturbance: Float[Array, "3"]) -> AttitudeState:
        """Time derivative of the state under torque and disturbance [N m], (1) and (2)."""
        w_dot = self.inertia_inverse @ (u + disturbance - self.gyroscopic(x.w))
        return AttitudeState(attitude.derivative(x.q, x.w), w_dot)

    def input_for(
        self, t: Scalar, x: AttitudeState, w_dot: Float[Array, "3"], d: Float[Array, "3"]
    ) -> Float[Array, "3"]:
        """J w' + w x J w - d [N m]."""
        return self.inertia @ w_dot + self.gyroscopic(x.w) - d

    def normalise(self, x: AttitudeState) -> AttitudeState:
        """The state with |q| = 1 again."""
        return AttitudeState(attitude.normalise(x.q), x.w)

    def moved(self, x: AttitudeState, by: Float[Array, "6"]) -> AttitudeState:
        """The state turned by a small rotation in body axes [rad], its rate changed [rad/s]."""
        return AttitudeState(attitude.multiply(x.q, attitude.from_rotation_vector(by[:3])), x.w + by[3:])

    def apart(self, x: AttitudeState, other: AttitudeState) -> Float[Array, "6"]:
        """Small rotation in body axes [rad] and change of the rate [rad/s]."""
        return jnp.concatenate([2.0 * attitude.multiply(attitude.conjugate(x.q), other.q)[:3], other.w - x.w])

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


@pytree
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

    def known(self, t: Scalar, x: Float[Array, " n"], u: Float[Array, "1"]) -> Float[Array, "1"]:
        """f(x) + g(x) u, (1,)."""
        return self.drift(x) + self.input_gain(x) * u

    def rate(
        self, t: Scalar, x: Float[Array, " n"], u: Float[Array, "1"], disturbance: Float[Array, "1"]
    ) -> Float[Array, " n"]:
        """Time derivative of the state, (35)."""
        return jnp.concatenate([x[1:], self.known(t, x, u) + disturbance])

    def input_for(
        self, t: Scalar, x: Float[Array, " n"], w_dot: Float[Array, "1"], d: Float[Array, "1"]
    ) -> Float[Array, "1"]:
        """(x_n' - f(x) - d) / g(x)."""
        return (w_dot - d - self.drift(x)) / self.input_gain(x)

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
    return Chain(order, _called(f), _called(g))


def _called(function: Callable | None) -> Any:
    """A function as a pytree that can be called."""
    plain = function is not None and jax.tree.leaves(function) == [function]  # no pytree itself
    return jax.tree_util.Partial(function) if plain else function


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
    inertia: Leaf  # (n, n) that observers read their gains against, the identity if nothing else is said
    inertia_inverse: Leaf  # (n, n)

    def _at(self, function: Any, t: Scalar, x: Float[Array, " twice"]) -> Array:
        n = self.inputs
        return function(t, x[:n], x[n:])

    def position(self, x: Float[Array, " twice"]) -> Float[Array, " n"]:
        """x_1."""
        return x[: self.inputs]

    def velocity(self, x: Float[Array, " twice"]) -> Float[Array, " n"]:
        """x_2."""
        return x[self.inputs :]

    def position_rate(self, t: Scalar, x: Float[Array, " twice"]) -> Float[Array, " n"]:
        """x_1' = F."""
        return self._at(self.F, t, x)

    def slope(self, t: Scalar, x: Float[Array, " twice"]) -> Float[Array, "n n"]:
        """dF/dx2."""
        n = self.inputs
        return jax.jacfwd(self.F, argnums=2)(t, x[:n], x[n:])

    def carried(self, t: Scalar, x: Float[Array, " twice"]) -> Float[Array, " n"]:
        """What of x_1'' no acceleration makes: dF/dt + dF/dx1 F."""
        n = self.inputs
        x_1, x_2 = x[:n], x[n:]
        moved = (jnp.ones_like(t), self.F(t, x_1, x_2))
        return jax.jvp(lambda t, x_1: self.F(t, x_1, x_2), (t, x_1), moved)[1]

    def drift(self, t: Scalar, x: Float[Array, " twice"]) -> Float[Array, " n"]:
        """H."""
        return self._at(self.H, t, x)

    def input_gain(self, t: Scalar, x: Float[Array, " twice"]) -> Float[Array, "n n"]:
        """G."""
        return self._at(self.G, t, x)

    def disturbance_gain(self, t: Scalar, x: Float[Array, " twice"]) -> Float[Array, "n n"]:
        """D."""
        return jnp.eye(self.inputs) if self.D is None else self._at(self.D, t, x)

    def mass(self, t: Scalar, x: Float[Array, " twice"]) -> Float[Array, "n n"]:
        """D^-1."""
        one = jnp.eye(self.inputs)
        return one if self.D is None else numerics.solve(self.disturbance_gain(t, x), one)

    def known(self, t: Scalar, x: Float[Array, " twice"], u: Float[Array, " n"]) -> Float[Array, " n"]:
        """D^-1 (H + G u)."""
        driven = self.drift(t, x) + self.input_gain(t, x) @ u
        return driven if self.D is None else numerics.solve(self.disturbance_gain(t, x), driven)

    def rate(
        self, t: Scalar, x: Float[Array, " twice"], u: Float[Array, " n"], disturbance: Float[Array, " n"]
    ) -> Float[Array, " twice"]:
        """Time derivative of the state, (25)."""
        driven = self.drift(t, x) + self.input_gain(t, x) @ u + self.disturbance_gain(t, x) @ disturbance
        return jnp.concatenate([self.position_rate(t, x), driven])

    def input_for(
        self, t: Scalar, x: Float[Array, " twice"], w_dot: Float[Array, " n"], d: Float[Array, " n"]
    ) -> Float[Array, " n"]:
        """G^-1 (x_2' - H - D d)."""
        driven = w_dot - self.drift(t, x) - self.disturbance_gain(t, x) @ d
        return numerics.solve(self.input_gain(t, x), driven)

    def speed(self, x: Float[Array, " twice"]) -> Scalar:
        """|x_2|."""
        return numerics.norm(self.velocity(x))

    def jacobian(self, t: Scalar, x: Float[Array, " twice"], u: Float[Array, " n"]) -> Float[Array, "twice twice"]:
        """The matrix dx'/dx at an input that is held: its eigenvalues are what integration steps must follow [1/s]."""
        return jax.jacfwd(lambda x: self.rate(t, x, u, jnp.zeros(self.inputs)))(x)

    def columns(self, x: Any) -> dict[str, Any]:
        """The states x_1 and x_2, one after the other."""
        return {"x": x}


def system(
    n: int,
    F: Callable,
    H: Callable,
    G: Callable,
    D: Callable | None = None,
    inertia: object = None,
) -> System:
    """Second-order system (25) with n inputs from JAX functions of (t, x_1, x_2); see `System`.

    F and H return (n,), G and D (n, n); D, the disturbance's input matrix, is the identity if None, and must be
    invertible for any observer. inertia: (n, n), symmetric and positive definite, that observers read their gains
    against (A = l inertia^-1), the identity if None: gains are then in 1/s. Raises ValueError where a function does not
    take such arguments or returns another shape.
    """
    if not isinstance(n, int) or n < 1:
        raise ValueError(f"n is {n}, but must be a whole number of at least 1")
    one = jax.ShapeDtypeStruct((), jnp.result_type(float))
    vector = jax.ShapeDtypeStruct((n,), one.dtype)
    for name, function, shape in (("F", F, (n,)), ("H", H, (n,)), ("G", G, (n, n)), ("D", D, (n, n))):
        if function is None:
            continue
        try:
            returned = jax.eval_shape(function, one, vector, vector)
        except Exception as error:
            said = f"{type(error).__name__}: {(str(error).splitlines() or [''])[0]}"
            raise ValueError(f"{name}(t, x_1, x_2) fails for x_1 and x_2 of shape ({n},): {said}") from error
        got = getattr(returned, "shape", type(returned).__name__)
        if got != shape:
            raise ValueError(f"{name}(t, x_1, x_2) returns {got}, but for n = {n} must return an array {shape}")
    scale = np.eye(n) if inertia is None else np.asarray(inertia, dtype=float)
    definite = scale.shape == (n, n) and np.allclose(scale, scale.T, rtol=1e-9) and np.linalg.eigvalsh(scale)[0] > 0
    if not definite:
        raise ValueError(f"inertia must be a symmetric, positive definite ({n}, {n}) matrix")
    return System(_called(F), _called(H), _called(G), _called(D), jnp.asarray(scale), jnp.asarray(np.linalg.inv(scale)))


def spacecraft(inertia: object) -> Spacecraft:
    """Spacecraft from three principal moments or a symmetric (3, 3) tensor [kg m^2].

    Raises ValueError where no rigid body can have it: not symmetric, not positive definite, or one principal moment
    larger than the sum of the other two.
    """
    tensor = check_inertia(inertia)
    return Spacecraft(jnp.asarray(tensor), jnp.asarray(np.linalg.inv(tensor)))
