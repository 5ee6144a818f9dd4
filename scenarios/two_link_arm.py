"""A two-link arm in a vertical plane, as a custom plant: M(q) q'' + C(q, q') q' + g(q) = u + d.

The Pelican arm of R. Kelly, V. Santibanez, A. Loria, Control of Robot Manipulators in Joint Space (2005), Table 5.1 and
eqs. (5.3) to (5.8); angles from the downward vertical, the second one relative to the first link. It follows
q_d(t) = (0.6 sin 0.8 t, 0.9 + 0.5 cos t) [rad]: x_1 = q - q_d is the error, x_2 = q' the joint rates.
"""

import jax
import jax.numpy as jnp

from ptsmc_jax.numerics.matrices import solve
from ptsmc_jax.plants import system

L1, LC1, LC2 = 0.26, 0.0983, 0.0229  # length of link 1, distances to the centres of mass [m]
M1, M2, I1, I2, GRAVITY = 6.5225, 2.0458, 0.1213, 0.0116, 9.81  # [kg], [kg m^2], [m/s^2]


def desired(t):
    """Desired joint angles (2,) [rad]."""
    return jnp.stack([0.6 * jnp.sin(0.8 * t), 0.9 + 0.5 * jnp.cos(t)])


def mass(q):
    """M(q) (2, 2) [kg m^2]."""
    coupled = M2 * (LC2**2 + L1 * LC2 * jnp.cos(q[1])) + I2
    both = M1 * LC1**2 + M2 * (L1**2 + LC2**2 + 2.0 * L1 * LC2 * jnp.cos(q[1])) + I1 + I2
    return jnp.stack([jnp.stack([both, coupled]), jnp.stack([coupled, jnp.full_like(coupled, M2 * LC2**2 + I2)])])


def load(q, rate):
    """C(q, q') q' + g(q) (2,) [N m]."""
    h = M2 * L1 * LC2 * jnp.sin(q[1])
    centrifugal = jnp.stack([-h * (2.0 * rate[0] + rate[1]) * rate[1], h * rate[0] ** 2])
    down = M2 * LC2 * GRAVITY * jnp.sin(q[0] + q[1])
    return centrifugal + jnp.stack([(M1 * LC1 + M2 * L1) * GRAVITY * jnp.sin(q[0]) + down, down])


def F(t, x_1, x_2):  # noqa: N802
    """x_1' = q' - q_d'."""
    return x_2 - jax.jvp(desired, (t,), (jnp.ones_like(t),))[1]


def H(t, x_1, x_2):  # noqa: N802
    """The joints' acceleration without input and disturbance."""
    q = x_1 + desired(t)
    return -solve(mass(q), load(q, x_2))


def G(t, x_1, x_2):  # noqa: N802
    """Return the input matrix M^-1 of q'', which also multiplies disturbing torques."""
    return solve(mass(x_1 + desired(t)), jnp.eye(2))


arm = system(2, F, H, G, D=G)
