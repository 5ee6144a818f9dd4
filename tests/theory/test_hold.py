"""The hold phase: runs of every order and both error definitions against the closed form, and its derivatives."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import formulas
from ptsmc_jax.laws.kinematics import AdditiveKinematics, MultiplicativeKinematics
from ptsmc_jax.signals import disturbances, references
from ptsmc_jax.simulation import clock, rollout
from ptsmc_jax.theory import envelopes, solutions
from tests.helpers import FULL_INERTIA, chain_parts, fly, parts, short, vector
from tests.theory import hold_phase

QUIET = disturbances.Sinusoid(*[jnp.zeros(3)] * 4)
AWAY = vector(0.4, -0.3, 0.2, np.sqrt(1 - 0.29))
SPIN = references.Spin(vector(0.1, -0.2, 0.1, np.sqrt(1 - 0.06)), vector(0.02, -0.05, 0.03))
# surface rate c and reaching rate k: slower, equal (repeated root), faster
RATES = [(0.3, 1.1), (1.0, 1.0), (1.0, 0.5), (2.5, 2.5), (2.5, 0.7)]
GRID = (4000, 800)


def simulated(law, c, k):
    """Return the parts of a run without disturbance or switching.

    law: order of a chain, or the kinematics of a spacecraft. c: coefficient of the surface s = v' + c v. k: reaching
    rate. The hand-over is 2 s before t_f = 10 s, so that a large error remains.
    """
    t_end = 12.0
    grid = clock.Graded(vector(t_end), vector(1.0), vector(1.5 * 10.0 / GRID[0]), jnp.zeros(0), *GRID)
    if isinstance(law, int):
        run = chain_parts([1.0, -0.5, 0.3][:law], 10.0, law + 1.0, 2.0, k1=k, surface_rate=c)
    else:  # the reaching rate is K1/2; the grid is that of laws/test_controllers.py, to share its compiled program
        grid = replace(grid, before=1024, after=1024, max_step=vector(1.5 * 10.0 / 1024))
        run = parts(10.0, 3.0, 2.0, inertia=FULL_INERTIA, q=AWAY, reference=SPIN, disturbance=QUIET, rate_bound=0.0,
                    k1=2 * k, surface_rate=c, kinematics=law, t_end=t_end)  # fmt: skip
    return replace(run, clock=grid)


@jax.jit
def exact(run, t):
    """Return error, s and acceleration, (times, m) each, of the closed forms at times t in the hold phase."""
    law = run.controller

    def component(x0):
        at = solutions.exact_chain(law.hand_over, law.t_f, law.eta, x0).x
        moved = jax.vmap(lambda time: hold_phase.exact_hold(time, law.surface(), law.reaching_rate, at))(
            t - law.hand_over
        )
        return moved.x[:, 0], moved.s, moved.acceleration

    return jax.vmap(component, out_axes=1)(solutions.initial_errors(run))


LAWS = {
    "additive": AdditiveKinematics,
    "multiplicative": MultiplicativeKinematics,
    "chain of order 2": 2,
    "chain of order 3": 3,
}


@pytest.mark.parametrize(("c", "k"), short(RATES, RATES[:1]))
@pytest.mark.parametrize("law", short(LAWS, list(LAWS)[1::2]))
def test_runs_follow_the_closed_form_in_the_hold_phase(law, c, k):
    """The closed form begins at t = 0. The error of RK4 is below 1e-11, with half of the default step or less."""
    law = LAWS[law]
    run = simulated(law, c, k)
    result = fly(run)
    after = result.log.t >= 8.0
    error = result.log.x[:, :1] if isinstance(law, int) else result.log.error
    wanted, s, acceleration = (np.asarray(v) for v in exact(run, vector(result.log.t[after])))
    assert np.abs(wanted[0]).max() > 5e-3  # something is left at the hand-over
    np.testing.assert_allclose(error[after], wanted, rtol=0, atol=1e-10)
    np.testing.assert_allclose(result.log.s[after], s, rtol=0, atol=1e-10)
    if isinstance(law, int):
        np.testing.assert_allclose(result.log.u[after], acceleration, rtol=0, atol=1e-9)  # gains of up to 20


def test_surface_rate_scales_the_surface_poles_of_a_chain():
    a = [2.0, 3.0, 1.7]
    law = chain_parts([1.0] * 4, a=a, surface_rate=2.5).controller
    found = np.sort_complex(formulas.surface_roots(law.surface()))
    np.testing.assert_allclose(found, np.sort_complex(2.5 * formulas.surface_roots(a)), rtol=1e-12)
    np.testing.assert_array_equal(chain_parts([1.0] * 4, a=a).controller.surface(), a)  # the paper's, to the last bit
    assert envelopes.hold_rates(law)["surface_rate"] == pytest.approx(np.abs(found).max())


def test_gradient_by_the_surface_rate_equals_the_closed_form():
    """The function is the RMS of a chain's error over the window, also with equal surface and reaching rates."""
    late = np.linspace(10.0, 11.0, 401)

    def expected(run, c):
        run = replace(run, controller=replace(run.controller, surface_rate=c))
        square = jnp.sum(exact(run, vector(late))[0] ** 2, axis=1)
        return jnp.sqrt(jnp.trapezoid(square, vector(late)))

    def measured(run, c):
        run = replace(run, controller=replace(run.controller, surface_rate=c))
        return rollout.simulate(run).metrics.window_error

    with_gradients = jax.jit(lambda run, c: jax.jvp(lambda c: measured(run, c), (c,), (jnp.ones_like(c),)))
    for c, k in ((1.0, 1.0), (2.5, 0.7)):
        run, at, h = simulated(2, c, k), vector(c), 1e-3
        forward = float(with_gradients(run, at)[1])
        # the error of the trapezium rule is (1/400)^2 / 12 times a second derivative of about 10
        np.testing.assert_allclose(forward, jax.jacfwd(expected, 1)(run, at), rtol=1e-5)
        two_back, back, ahead, two_ahead = (float(with_gradients(run, at + step * h)[0]) for step in (-2, -1, 1, 2))
        difference = (two_back - 8 * back + 8 * ahead - two_ahead) / (12 * h)
        np.testing.assert_allclose(forward, difference, rtol=1e-8)  # errors of order h^4 and 1e-15 / h
