"""Laws written for the error's acceleration, eps'' = a + d: the error's motion turns a into the plant's input.

Each is written once, whatever the plant: `law_on_error` makes it the law of a spacecraft's error quaternion, of a chain
or of a system of one's own. They fly in the sampled loop.
"""

import functools
from dataclasses import dataclass, fields
from typing import Any

from ptsmc_jax.laws.base import Law, Sample
from ptsmc_jax.laws.error_motions import ErrorMotion
from ptsmc_jax.numerics import guards
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector, pytree


@dataclass(frozen=True)
class AccelerationLaw(Law):
    """A law for the error's motion eps'' = a + d, all (m,), which chooses a.

    `bound` limits the 2-norm of what is not estimated of d. It is N K2 / 2 of `base.SecondOrderLaw`: what the
    disturbance observer leaves, or the whole disturbance where there is none.
    """

    model: Any  # the nominal plant
    t_f: Leaf  # prescribed time, or when the error is judged [s]
    delta: Leaf  # a sample of the anchored clock falls on t_f - delta [s]

    def acceleration(self, now: Sample, error: Vector, error_rate: Vector, bound: Scalar) -> tuple[Vector, Vector]:
        """The acceleration a and the sliding variable, (m,) each, of a law that remembers nothing.

        Args:
            now: when; `now.t` [s], `now.hold`, `now.dt` [s].
            error: eps, (m,).
            error_rate: eps' [1/s], (m,).
            bound: on the disturbance that is not estimated, in the units of a.
        """
        raise NotImplementedError

    def step(
        self, memory: Any, now: Sample, error: Vector, error_rate: Vector, bound: Scalar
    ) -> tuple[Vector, Vector, Any]:
        """The same for a law that remembers something, with its memory for the next sample.

        memory: from `begin`, or from the sample before; it keeps its shapes and types.
        """
        a, s = self.acceleration(now, error, error_rate, bound)
        return a, s, memory

    def command(
        self, memory: Any, now: Sample, x: Any, target: Any, d_hat: Vector, k2: Scalar
    ) -> tuple[Vector, Vector, Any]:
        """Input (m,) that brings the law's acceleration about, its sliding variable and its memory."""
        error, error_rate = self.errors(x, target)
        a, s, memory = self.step(memory, now, error, error_rate, 0.5 * self.influence(x, target) * k2)
        return self.invert(x, target, 2.0 * a, d_hat), s, memory


@dataclass(frozen=True)
class SlidingLaw(AccelerationLaw):
    """A law that switches against the disturbance that is not estimated: a = equivalent - bound sign(s)."""

    def surface(self, error: Vector, error_rate: Vector) -> tuple[Vector, Vector]:
        """Sliding variable s, and the equivalent acceleration, a without its switching term, (m,) each."""
        raise NotImplementedError

    def acceleration(self, now: Sample, error: Vector, error_rate: Vector, bound: Scalar) -> tuple[Vector, Vector]:
        """As the class says."""
        s, equivalent = self.surface(error, error_rate)
        return equivalent - bound * self.sign(s), s

    def sign(self, s: Vector) -> Vector:
        """Smooth sign tanh(s / sign_width) [-]; the exact one for a width of 0."""
        return guards.smooth_sign(s, self.sign_width)  # pyright: ignore[reportAttributeAccessIssue]


@functools.cache
def law_on_error(motion: type[ErrorMotion], law: type[Law]) -> type[Law]:
    """The law on an error: a class with the law's fields and the error's motion."""

    def reduced(self: Any) -> tuple:
        return _restored, (motion, law, {f.name: getattr(self, f.name) for f in fields(self)})

    inside = {"__module__": law.__module__, "__doc__": law.__doc__, "__reduce__": reduced}
    if law.command is not AccelerationLaw.command and law.clearance is ErrorMotion.clearance:
        # a law with its own `command` does not invert the error kinematics, whose singularity does not apply to it
        inside["clearance"], inside["clearance_unit"] = ErrorMotion.clearance, ErrorMotion.clearance_unit
    inside["__qualname__"] = f"{law.__name__}On{motion.__name__}"  # which tells programs; errors name the law's class
    return pytree(dataclass(frozen=True)(type(law.__name__, (law, motion), inside)))


def _restored(motion: type[ErrorMotion], law: type[Law], values: dict[str, Any]) -> Law:
    """A law on an error from a pickle, which finds no class of that name in the law's module."""
    return law_on_error(motion, law)(**values)
