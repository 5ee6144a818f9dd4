"""Prescribed time by scaling."""

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp

from ptsmc_jax.laws.acceleration import AccelerationLaw
from ptsmc_jax.laws.base import Sample
from ptsmc_jax.numerics.pytrees import Leaf, Scalar, Vector


@dataclass(frozen=True)
class Scaling(AccelerationLaw):
    """a = -2 p eps'/r - p (p+1) eps/r^2 - k1 (eps' + p eps/r) - k z, p = 2 + m, r = t_f - t, from r = delta on held.

    z = mu (eps' + (p/r + k1) eps) with mu = (t_f/r)^p is xi' + k1 xi of the scaled error xi = mu eps, and the law is
    z' = mu (-k z + d): |z| stays below the larger of |d|/k and what it began with, while eps falls like r^p. Song,
    Wang, Holloway, Krstic, Time-varying feedback for regulation of normal-form nonlinear systems in prescribed finite
    time, Automatica 83, 2017. Its gains grow without bound toward t_f: those of r = delta are held, which makes a PD.
    """

    m: Leaf  # >= 1 [-]
    k1: Leaf  # [1/s]
    k: Leaf  # [1/s]
    tunable: ClassVar[tuple[str, ...]] = ("m", "k1", "k", "delta", "t_f")

    def acceleration(self, now: Sample, error: Vector, error_rate: Vector, bound: Scalar) -> tuple[Vector, Vector]:
        """As the class says, with z / mu for a sliding variable [1/s], (m,) each."""
        p, r = 2.0 + self.m, jnp.where(now.hold, self.delta, self.t_f - now.t)
        s = error_rate + (p / r + self.k1) * error
        steady = 2.0 * p / r * error_rate + p * (p + 1.0) / r**2 * error + self.k1 * (error_rate + p / r * error)
        return -steady - self.k * (self.t_f / r) ** p * s, s
