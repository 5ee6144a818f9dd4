"""The base of all control laws, and the base of laws to compare with and of custom laws."""

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool

from ptsmc_jax.laws.kinematics import Kinematics
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector


class Sample(NamedTuple):
    """A sample at which a law is evaluated."""

    t: Scalar  # [s]
    hold: Bool[Array, ""]  # after the hand-over
    dt: Scalar  # length of the control period that begins, over which the input is held [s]
    memory: Any = None  # the law's, from the sample before; from `Law.begin` at the first sample


class Law:
    """A control law: gains, and one call. Its error and the plant's model are in the field `kinematics`.

    Most laws define `acceleration`, the eps'' that they command. Others override `__call__`. Errors, accelerations and
    inputs are (m,), in the units of the kinematics: for a spacecraft [-], [1/s^2] and [N m]. Some laws use other gains
    from the hand-over at t_f - delta on (Remark 1).
    """

    kinematics: Kinematics  # of the error that the law drives to zero
    t_f: Leaf  # prescribed time, or when the error is judged [s]
    delta: Leaf  # hand-over this long before t_f [s]
    tunable: ClassVar[tuple[str, ...]] = ()  # gains that tuning may move
    prescribed: ClassVar[bool] = False  # one of the paper's: its exact solution and its bounds are known

    @property
    def model(self) -> Any:
        """The nominal plant."""
        return self.kinematics.model

    @property
    def order(self) -> int:
        """Order n of the error's differential equation."""
        return self.kinematics.order

    @property
    def hand_over(self) -> Scalar:
        """t_s = t_f - delta [s]."""
        return self.t_f - self.delta

    @property
    def continuous(self) -> bool:
        """Whether the continuous loop can simulate the law: it has no memory and does not use `Sample.dt`."""
        return False

    def begin(self) -> Any:
        """Return the law's memory before its first sample, a pytree of arrays; None: the law has no memory."""
        return None

    def acceleration(self, now: Sample, error: Vector, error_rate: Vector, bound: Scalar) -> tuple[Any, ...]:
        """Return the acceleration a of eps'' = a + d, and the sliding variable; a law with a memory also returns that.

        Args:
            now: the sample; `now.t` [s], `now.hold`, `now.dt` [s], `now.memory`.
            error: eps, (m,).
            error_rate: eps' [1/s], (m,).
            bound: on the 2-norm of the disturbance d that is not estimated, in the units of a.

        Returns:
            a (m,), s (m,), and the memory for the next sample if `begin` returns one, of the same shapes and types.
        """
        raise NotImplementedError

    def __call__(self, now: Sample, x: Any, target: Any, d_hat: Vector, k2: Scalar) -> tuple[Vector, Vector, Any]:
        """Return the commanded input (m,), the sliding variable (m,) and the memory for the next sample.

        Args:
            now: the sample, with the law's memory.
            x: measured state.
            target: of the reference at `now.t`.
            d_hat: estimated disturbance, (m,).
            k2: K2, bound on the 2-norm of its error.
        """
        error, error_rate = self.kinematics.errors(x, target)
        bound = self.kinematics.influence(x, target) * k2
        acceleration, s, *memory = self.acceleration(now, error, error_rate, bound)
        u = self.kinematics.invert(x, target, acceleration, d_hat)
        return u, s, memory[0] if memory else now.memory

    def clearance(self, x: Any, target: Any) -> Scalar:
        """Distance to the law's singularity: the clearance of its kinematics, or 1 if it does not invert them."""
        if type(self).__call__ is not Law.__call__:
            return jnp.ones(())
        return self.kinematics.clearance(x, target)

    def in_hold(self, t: Array, t_next: Array, hold: Bool[Array, "..."]) -> Bool[Array, "..."]:
        """Return which periods, from t to t_next [s], use the gains of the hold phase.

        hold: which periods begin after the hand-over.
        """
        return hold


@dataclass(frozen=True)
class AccelerationLaw(Law):
    """The base of laws to compare with and of custom laws, for any kinematics of order 2 and the sampled loop only."""

    kinematics: Kinematics
    t_f: Leaf  # prescribed time, or when the error is judged [s]
    delta: Leaf  # a sample of the anchored clock falls on t_f - delta [s]
