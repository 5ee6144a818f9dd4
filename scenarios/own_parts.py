"""Custom parts for own_parts.toml, one of each kind. See docs/custom_parts.md."""

import dataclasses

import jax.numpy as jnp

import ptsmc_jax as ptsmc


class Scaling(ptsmc.AccelerationLaw):
    """Prescribed time by scaling (Song, Wang, Holloway, Krstic, Automatica 83, 2017)."""

    delta: float = ptsmc.gain(2.0, (0.2, 5.0), unit="s", meaning="time before t_f at which the gains become constant")
    m: float = ptsmc.gain(1.0, (1.0, 4.0), above=0.0, meaning="m of the scaling exponent 2 + m")
    k1: float = ptsmc.gain(1.0, lambda t_f, h: (0.3 / t_f, 0.5 / h), unit="1/s", meaning="rate of the scaled error")
    k: float = ptsmc.gain(1e-3, lambda t_f, h: (1e-5 / t_f, 1.0 / t_f), unit="1/s", meaning="rate of its surface")

    def acceleration(self, now, error, error_rate, bound):
        """Return the commanded second derivative of the error, and the sliding variable, (3,) each."""
        p, left = 2.0 + self.m, jnp.where(now.hold, self.delta, self.t_f - now.t)
        s = error_rate + (p / left + self.k1) * error
        a = -2.0 * p / left * error_rate - p * (p + 1.0) / left**2 * error
        a = a - self.k1 * (error_rate + p / left * error)
        return a - self.k * (self.t_f / left) ** p * s, s


class LowPass(ptsmc.SampledObserver):
    """A first-order low pass of the disturbance that the measured motion implies."""

    rate: float = ptsmc.gain(1.0, lambda t_f, h: (1.0 / t_f, 1.0 / h), unit="1/s", meaning="bandwidth")

    def step(self, memory, d_mean, t, dt):
        """Return the estimate (3,) [N m] at the end of a period."""
        return d_mean + jnp.exp(-self.rate * dt) * (memory - d_mean)


class SolarPressure(ptsmc.Disturbance):
    """Radiation pressure on a panel: a torque about one body axis that depends on the angle to the sun."""

    torque: float = 0.01
    sun: tuple = (1.0, 0.0, 0.0)  # in inertial axes

    def __call__(self, t, x):
        """Return the torque (3,) [N m] in the state x: attitude x.q (scalar last), rate x.w."""
        v, s = x.q[:3], x.q[3]
        sun = self.sun + 2.0 * jnp.cross(jnp.cross(self.sun, v) + s * self.sun, v)  # in body axes
        return self.torque * sun[0] * jnp.abs(sun[0]) * jnp.asarray([0.0, 1.0, 0.0])


class Nodding(ptsmc.Reference):
    """An oscillation about the x axis of the attitude in [reference]."""

    angle: float = 0.05  # rad
    frequency: float = 0.2  # rad/s

    def attitude(self, t):
        """Return the unit quaternion (4,), scalar last."""
        half = 0.5 * self.angle * jnp.sin(self.frequency * t)
        return jnp.stack([jnp.sin(half), 0.0 * half, 0.0 * half, jnp.cos(half)])

    def fastest(self):
        """Return the largest angular frequency of the reference [rad/s]."""
        return float(self.frequency)


class StarTracker(ptsmc.SampledSensor):
    """A gyro, and a star tracker whose noise grows with the body rate."""

    draws = 6
    attitude_noise: float = 2e-5  # rad, 1 sigma of each axis for a body at rest
    smear: float = 20.0  # s: relative growth of the noise over the body rate
    rate_noise: float = 1e-6  # rad/s

    def see(self, memory, x, noise, t, dt):
        """Return the measured state and the memory, which is empty."""
        spread = self.attitude_noise * (1.0 + self.smear * jnp.sqrt(x.w @ x.w + 1e-20))
        half = 0.5 * spread * noise[:3]
        v, s = x.q[:3], x.q[3]
        turned = jnp.concatenate([v + s * half + jnp.cross(v, half), jnp.stack([s - v @ half])])  # to first order
        return x._replace(q=turned / jnp.sqrt(turned @ turned), w=x.w + self.rate_noise * noise[3:]), memory


class LateStarTracker(ptsmc.SampledSensor):
    """A star tracker whose samples arrive some control periods late, and a gyro without delay."""

    draws = 6
    late = 2  # control periods
    attitude_noise: float = 2e-5  # rad, 1 sigma of each axis
    rate_noise: float = 1e-6  # rad/s

    def begin(self, x):
        """Return the samples that have not arrived yet, oldest first: `late` copies of the initial attitude."""
        return jnp.tile(x.q, (self.late, 1))

    def see(self, memory, x, noise, t, dt):
        """Return the attitude that arrives with the current rate, and the samples that have not arrived yet."""
        half = 0.5 * self.attitude_noise * noise[:3]
        v, s = x.q[:3], x.q[3]
        taken = jnp.concatenate([v + s * half + jnp.cross(v, half), jnp.stack([s - v @ half])])  # to first order
        coming = jnp.concatenate([memory, taken[None]])
        q = coming[0] / jnp.sqrt(coming[0] @ coming[0])
        return x._replace(q=q, w=x.w + self.rate_noise * noise[3:]), coming[1:]


class SunDirection(ptsmc.Draw):
    """A random direction of the sun in `SolarPressure` in each trial."""

    count = 3

    def at(self, c, parts):
        """Return the parts with another direction of the sun, from three standard normal numbers c (3,)."""
        *others, solar = parts.disturbance.terms
        solar = dataclasses.replace(solar, sun=c / jnp.sqrt(c @ c))
        return dataclasses.replace(parts, disturbance=dataclasses.replace(parts.disturbance, terms=(*others, solar)))


def slowest_turn(result, parts):
    """Custom metrics for `montecarlo --metrics`, computed from the history of a run."""
    turning = jnp.linalg.norm(result.log.x.w, axis=1)
    return {"mean_rate": jnp.mean(turning), "last_rate": turning[-1]}
