"""Laws that say which acceleration of the error they want; what input brings it about, the error's motion knows.

Each is written once, for eps'' = a + d, whatever the plant: `on` makes it the law of a spacecraft's error quaternion,
of a chain or of a system of one's own. They fly in the sampled loop.
"""

import functools
from dataclasses import dataclass
from typing import Any

from jaxtyping import Array, Float

from ptsmc_jax.laws.base import Law, Sample
from ptsmc_jax.laws.error_motions import ErrorMotion
from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.pytrees import Leaf, pytree

Scalar = Float[Array, ""]
Vector = Float[Array, " m"]


@dataclass(frozen=True)
class AccelerationLaw(Law):
    """A law of the error's motion eps'' = a + d, all (m,), where what is left of d is at most `bound` in 2-norm.

    bound is N K2 / 2 of `base.SecondOrder`: what the disturbance observer leaves, or the whole disturbance.
    """

    model: Any  # the nominal plant
    t_f: Leaf  # prescribed time, or when the error is judged [s]
    delta: Leaf  # a sample of the anchored clock falls on t_f - delta [s]

    def acceleration(self, now: Sample, error: Vector, error_rate: Vector, bound: Scalar) -> tuple[Vector, Vector]:
        """The acceleration a that it wants and its sliding variable, (m,) each; of a law without a memory."""
        raise NotImplementedError

    def step(
        self, memory: Any, now: Sample, error: Vector, error_rate: Vector, bound: Scalar
    ) -> tuple[Vector, Vector, Any]:
        """The same, (m,) each, with what the law remembers: from `begin`, or from the sample before; and from then on.

        The memory keeps its shapes and types.
        """
        a, s = self.acceleration(now, error, error_rate, bound)
        return a, s, memory

    def command(
        self, memory: Any, now: Sample, x: Any, target: Any, d_hat: Vector, k2: Scalar
    ) -> tuple[Vector, Vector, Any]:
        """Input (m,) for the acceleration that the law wants, its sliding variable and its memory."""
        error, error_rate = self.errors(x, target)
        a, s, memory = self.step(memory, now, error, error_rate, 0.5 * self.influence(x, target) * k2)
        return self.invert(x, target, 2.0 * a, d_hat), s, memory


@dataclass(frozen=True)
class SlidingLaw(AccelerationLaw):
    """One that switches against what is left of the disturbance: a = equivalent - bound sign(s)."""

    def surface(self, error: Vector, error_rate: Vector) -> tuple[Vector, Vector]:
        """Sliding variable s, and what the law wants of eps'' but for what switches, (m,) each."""
        raise NotImplementedError

    def acceleration(self, now: Sample, error: Vector, error_rate: Vector, bound: Scalar) -> tuple[Vector, Vector]:
        """As the class says."""
        s, equivalent = self.surface(error, error_rate)
        return equivalent - bound * self.sign(s), s

    def sign(self, s: Vector) -> Vector:
        """Smooth sign tanh(s / sign_width) [-]; the exact one for a width of 0."""
        return guards.smooth_sign(s, self.sign_width)  # pyright: ignore[reportAttributeAccessIssue]


@functools.cache
def on(motion: type[ErrorMotion], law: type[Law]) -> type[Law]:
    """The law on this error: a class with the law's fields."""
    made = type(f"{law.__name__}On{motion.__name__}", (law, motion), {"__module__": law.__module__})
    made.__doc__ = law.__doc__
    return pytree(dataclass(frozen=True)(made))
