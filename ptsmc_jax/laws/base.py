"""Base classes of the control laws.

Read `Law` first. Most laws override `Law.acceleration` only. `AccelerationLaw` is the base of the laws for comparison
and of custom laws.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, PyTree

from ptsmc_jax import declare
from ptsmc_jax.laws.kinematics import Kinematics
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector
from ptsmc_jax.plants.base import Plant


def boundary_layer(default: Any, unit: str = "") -> Any:
    """Declare the field `sign_width`, the thickness of the boundary layer of tanh(s / sign_width).

    Args:
        default: default value, see `declare.gain`.
        unit: unit of s.
    """
    meaning = "thickness of the boundary layer; 0 is the discontinuous sign"
    return declare.gain(default, "sign_width", at_least=0.0, free="sampled", unit=unit, meaning=meaning)


class Sample(NamedTuple):
    """A sample time at which a law is evaluated."""

    t: Scalar  # [s]
    hold: Bool[Array, ""]  # whether the sample is in the hold phase, at or after the hand-over
    dt: Scalar  # length of the control period that begins here; the input is constant in it [s]
    memory: PyTree = None  # memory of the law from the previous sample; at the first sample from `Law.begin`


class Law(declare.Tunable):
    """Base class of the control laws. A law is called at each sample, and its gains are fields.

    The field `kinematics` defines the error eps and contains the design model of the plant. Most laws define
    `acceleration`, the commanded eps''. Others override `__call__`. Errors, accelerations and inputs are (m,), in the
    units of the kinematics: for a spacecraft [-], [1/s^2] and [N m]. At the hand-over time t_f - delta the approach
    phase ends and the hold phase begins. Some laws use other gains in the hold phase (Remark 1).
    """

    kinematics: Kinematics  # definition of the error that the law drives to zero
    t_f: Leaf  # prescribed time; for a law without it, the start of the evaluation of the error [s]
    delta: Leaf  # time between the hand-over and t_f [s]
    # names of the fields that tuning may change; fields that are declared by `gain` are added
    tunable: ClassVar[tuple[str, ...]] = ("t_f",)
    prescribed: ClassVar[bool] = False  # whether the law is from the paper, with known exact solution and bounds
    switches: ClassVar[bool] = True  # whether its switching term uses the bound on the estimation error

    @property
    def model(self) -> Plant:
        """Design model of the plant."""
        return self.kinematics.model

    @property
    def order(self) -> int:
        """Order n of the error's differential equation."""
        return self.kinematics.order

    @property
    def hand_over(self) -> Scalar:
        """Hand-over time t_f - delta [s]."""
        return self.t_f - self.delta

    @property
    def continuous(self) -> bool:
        """Whether the continuous loop can simulate the law, which needs no memory and no `Sample.dt`."""
        return False

    def begin(self) -> PyTree:
        """Return the memory of the law before its first sample, a pytree of arrays, or None for a law without it."""
        return None

    def acceleration(self, now: Sample, error: Vector, error_rate: Vector, bound: Scalar) -> tuple[PyTree, ...]:
        """Return the commanded acceleration a, and the sliding variable. The error obeys eps'' = a + d.

        Args:
            now: the sample.
            error: eps, (m,).
            error_rate: eps' [1/s], (m,).
            bound: bound on the 2-norm of d, the part of the disturbance that is not estimated, in the units of a.

        Returns:
            a (m,) and the sliding variable s (m,). If `begin` returns a memory, also the memory for the next sample,
            with the same shapes and dtypes.
        """
        raise NotImplementedError

    def __call__(
        self, now: Sample, x: PyTree, target: PyTree, d_hat: Vector, k2: Scalar
    ) -> tuple[Vector, Vector, PyTree]:
        """Return the input for a measured state.

        Args:
            now: the sample, with the memory of the law.
            x: measured state.
            target: target of the reference at `now.t`.
            d_hat: estimated disturbance, (m,).
            k2: K2, bound on the 2-norm of the estimation error.

        Returns:
            Commanded input (m,), sliding variable (m,), and the memory for the next sample.
        """
        error, error_rate = self.kinematics.errors(x, target)
        bound = self.kinematics.influence(x, target) * k2
        acceleration, s, *memory = self.acceleration(now, error, error_rate, bound)
        u = self.kinematics.invert(x, target, acceleration, d_hat)
        return u, s, memory[0] if memory else now.memory

    def singularity_distance(self, x: PyTree, target: PyTree) -> Scalar:
        """Return the signed distance to the singularity of the kinematics; 1 if the law does not invert them."""
        if type(self).__call__ is not Law.__call__:
            return jnp.ones(())
        return self.kinematics.singularity_distance(x, target)

    def in_hold(self, t: Array, t_next: Array, hold: Bool[Array, "..."]) -> Bool[Array, "..."]:
        """Return which periods use the gains of the hold phase.

        Args:
            t: times at which the periods begin [s].
            t_next: times at which they end [s].
            hold: whether each period begins in the hold phase.

        Returns:
            A bool for each period, in the shape of `t`.
        """
        return hold

    # A scenario calls the methods below with its table instead of a law. They use only the numbers in the fields.

    def half_turn_rate(self, t_f: float) -> tuple[str, Scalar | float]:
        """Return the field that sets how fast the law turns a body, and the largest body rate of a half turn [rad/s].

        A half turn has the initial error |v| = 1. The default rate is twice the mean rate of a half turn in t_f.

        Args:
            t_f: prescribed time [s].
        """
        return "t_f", 2.0 * math.pi / t_f

    def noise_of_s(self, position: float, velocity: float) -> float:
        """Return the noise of the sliding variable (1 sigma) for noise of the error [-] and of its rate [1/s].

        The default is for s = eps' + c eps, with c = 1 / t_f if the law has no `surface_rate`.
        """
        return math.hypot(velocity, (getattr(self, "surface_rate", None) or 1.0 / float(self.t_f)) * position)

    @staticmethod
    def designed(design: Any, published: Mapping[str, float]) -> Mapping[str, float]:
        """Return the gains for a design of the sampled loop, by field name.

        Args:
            design: a `scenario.mission.Design`, with rates in [1/s].
            published: the published gains, limited to the bandwidth of the design.
        """
        return published

    def refusal(self, order: int) -> tuple[str, str] | None:
        """Return a field whose value conflicts with other fields or the plant's order, and its allowed values, or None.

        Args:
            order: order of the plant.
        """
        return None


@dataclass(frozen=True)
class AccelerationLaw(Law):
    """Base of comparison and custom laws, which command the acceleration eps'' of an error in the sampled loop."""

    kinematics: Kinematics
    t_f: Leaf  # prescribed time; for a law without it, the start of the evaluation of the error [s]
    delta: Leaf  # time between the hand-over and t_f [s]; the anchored clock has a sample at the hand-over
    tunable: ClassVar[tuple[str, ...]] = ("delta", "t_f")


@dataclass(frozen=True)
class ComparisonLaw(AccelerationLaw):
    """Base of the laws for comparison. Their hand-over has no effect, unless they declare the gain `delta`."""

    tunable: ClassVar[tuple[str, ...]] = ("t_f",)
