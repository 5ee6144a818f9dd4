"""The sampled loop of many trials against diffrax under vmap, one step of the same tableau a period."""

import jax

from ptsmc_jax.configure import configure

configure()

import diffrax  # noqa: E402  # pyright: ignore[reportMissingImports]
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from common import machine, medians, row, say, steps, study  # noqa: E402

from ptsmc_jax.campaigns import montecarlo  # noqa: E402
from ptsmc_jax.devices.ticks import Ticks  # noqa: E402
from ptsmc_jax.laws.base import Sample  # noqa: E402
from ptsmc_jax.plants.rigid_body import AttitudeState  # noqa: E402

TRIALS = 1024
CLASSICAL = diffrax.ButcherTableau(
    a_lower=(np.array([0.5]), np.array([0.0, 0.5]), np.array([0.0, 0.0, 1.0])),
    b_sol=np.array([1, 2, 2, 1]) / 6,
    b_error=np.zeros(4),
    c=np.array([0.5, 0.5, 1.0]),
)


class RK4(diffrax.AbstractERK):
    """The classical method of order 4."""

    tableau = CLASSICAL
    interpolation_cls = diffrax.LocalLinearInterpolation

    def order(self, terms):
        """Order of the method."""
        return 4


def loop(parts, x0):
    """Return the largest torque of one run: law and observer of the library, plant by diffrax."""
    law, watch, plant = parts.controller, parts.observer, parts.plant
    ticks = parts.clock.ticks(law.t_f, law.delta)
    k2, matrix, solver = watch.error_bound(), watch.update_matrix(parts.clock.period), RK4()
    term = diffrax.ODETerm(lambda t, y, u: plant.rate(t, y, u, parts.disturbance(t, y)))

    def period(carry, now: Ticks):
        x, seen, d_hat, u, dt_before, most = carry
        impulse = watch.model.implied_disturbance_impulse(now.t, seen, x, u, dt_before)
        updated = watch.update(matrix, d_hat, impulse, now.t, dt_before)
        d_hat = jnp.where(dt_before > 0.0, updated, d_hat)
        u, *_ = law(Sample(now.t, now.hold, parts.period), x, parts.reference(now.t), d_hat, k2(now.t))
        state = solver.init(term, now.t, now.t_next, x, u)
        x_next, *_ = solver.step(term, now.t, now.t_next, x, u, state, made_jump=False)
        dt = now.t_next - now.t
        most = jnp.where(dt > 0.0, jnp.maximum(most, jnp.max(jnp.abs(u))), most)
        return (plant.normalise(x_next), x, d_hat, u, dt, most), None

    zero = jnp.zeros(())
    start = (x0, x0, jnp.zeros(3), jnp.zeros(3), zero, zero)
    return jax.lax.scan(period, start, ticks)[0][-1]


def main() -> None:
    """Print both rates and their ratio."""
    ready = study()
    numbers = np.arange(TRIALS)
    simulated = montecarlo.run(ready.parts, ready.dispersion, 0, numbers)
    aligned = jax.vmap(lambda x: ready.parts.controller.kinematics.align(x, ready.parts.reference(jnp.zeros(()))))(
        AttitudeState(jnp.asarray(simulated.vectors("initial_q")), jnp.asarray(simulated.vectors("initial_w")))
    )
    by_diffrax = jax.jit(lambda x0: jax.vmap(lambda x: loop(ready.parts, x))(x0))
    found = np.asarray(by_diffrax(aligned))
    # its observer treats the partial first period as a whole one
    say(f"largest torques differ by at most {np.max(np.abs(found / simulated.metrics.peak_torque - 1)):.1e}")
    seconds = medians({
        "diffrax, vmap": lambda: by_diffrax(aligned),
        "ptsmc_jax": lambda: montecarlo.run(ready.parts, ready.dispersion, 0, numbers).metrics,
    })  # fmt: skip
    total = TRIALS * steps(ready.parts)
    row("diffrax 0.7.2, vmap, the same law and observer; ours with all metrics",
        *(total / seconds[name] / 1e6 for name in ("diffrax, vmap", "ptsmc_jax")))  # fmt: skip


if __name__ == "__main__":
    say(machine())
    main()
