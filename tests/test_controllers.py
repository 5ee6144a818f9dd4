import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import attitude, plants, signals
from ptsmc_jax.plants import AttitudeState
from tests.helpers import FULL_INERTIA, REFERENCE, parts, vector, with_controller

SPIN = signals.Spin(vector(0.1, -0.2, 0.1, np.sqrt(1 - 0.06)), vector(0.02, -0.05, 0.03))


def state(seed: int) -> AttitudeState:
    rng = np.random.default_rng(seed)
    q = rng.normal(size=4)
    q[3] = abs(q[3]) + 0.5
    return AttitudeState(vector(q / np.linalg.norm(q)), vector(0.1 * rng.normal(size=3)))


@pytest.mark.parametrize("hold", [False, True])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_closed_loop_error_obeys_the_equation_that_the_law_is_made_from(hold, seed):
    """s' with the true dynamics, by automatic differentiation along the motion, against (31) and (34) by hand."""
    run = parts(20.0, 3.5, 0.5, inertia=FULL_INERTIA, reference=SPIN, k1=1.7, sign_width=0.1)
    law, x, t = run.controller, state(seed), vector(4.0)
    d, d_hat, k2 = vector(0.3, -0.1, 0.2), vector(0.1, 0.1, -0.2), vector(0.05)
    u, s = law.torque(t, jnp.asarray(hold), x, SPIN(t), d_hat, k2)

    def surface(time, y):
        return law.torque(time, jnp.asarray(hold), y, SPIN(time), d_hat, k2)[1]

    _, s_dot = jax.jvp(surface, (t, x), (jnp.ones_like(t), run.plant.rate(t, x, u, d)))
    error, error_rate = law.errors(x, SPIN(t))
    tau, tanh = 16.0, np.tanh(np.asarray(s) / 0.1)
    inverse = np.linalg.inv(np.asarray(FULL_INERTIA))
    push = np.asarray(attitude.t_matrix(x.q)) @ inverse
    switching = np.linalg.norm(push) * 0.05  # Frobenius
    unseen = push @ np.asarray(d - d_hat)
    if hold:
        np.testing.assert_allclose(s, error_rate + error, atol=1e-14)
        expected = 0.5 * (unseen - switching * tanh - 1.7 * np.asarray(s))  # the effective gain is K1/2
    else:
        np.testing.assert_allclose(s, tau * error_rate + 3.5 * error, atol=1e-13)
        expected = -3.5 / tau * np.asarray(s) + tau / 2 * (unseen - switching * tanh)
    np.testing.assert_allclose(s_dot, expected, atol=1e-12)  # sums of terms up to 1, rounding


@pytest.mark.parametrize("case", REFERENCE["cases"], ids=lambda case: case["name"])
def test_first_torque_of_the_reference_data_and_its_closed_form(case):
    run = parts(case["t_f"], case["eta"], case["delta"])
    first = case["trajectory"][0]
    x = AttitudeState(vector(first["q"]), vector(first["omega"]))
    zero = jnp.zeros(3)
    u, s = run.controller.torque(vector(0.0), jnp.asarray(False), x, run.reference(vector(0.0)), zero, vector(0.0))
    np.testing.assert_allclose(u, first["torque"], rtol=1e-13)
    np.testing.assert_allclose(s, first["s"], rtol=1e-13)


def test_smooth_sign_width_zero_is_the_exact_sign():
    run = parts(20.0, 3.0, 0.5)
    x, target, d_hat = state(5), run.reference(vector(0.0)), jnp.zeros(3)
    exact, s = with_controller(run, sign_width=vector(0.0)).controller.torque(
        vector(1.0), jnp.asarray(False), x, target, d_hat, vector(0.3)
    )
    sharp, _ = with_controller(run, sign_width=vector(1e-12)).controller.torque(
        vector(1.0), jnp.asarray(False), x, target, d_hat, vector(0.3)
    )
    assert np.all(np.abs(s) > 1e-6)
    np.testing.assert_array_equal(exact, sharp)


def test_align_chooses_the_sign_of_the_reference_and_clearance_counts_from_its_side():
    law = parts().controller
    x = state(4)
    for flip_x in (1.0, -1.0):
        for flip_f in (1.0, -1.0):
            target = signals.Fixed(flip_f * vector(0.0, 0.6, 0.0, 0.8))(vector(0.0))
            aligned = law.align(AttitudeState(flip_x * x.q, x.w), target)
            assert float(aligned.q[3] * target.q[3]) > 0
            np.testing.assert_allclose(law.clearance(aligned, target), x.q[3])
            assert float(law.clearance(AttitudeState(-aligned.q, x.w), target)) < 0


@pytest.mark.parametrize("hold", [False, True])
def test_gradients_are_finite_at_the_awkward_points(hold):
    run = parts(20.0, 3.0, 0.5)
    rest = AttitudeState(vector(0.0, 0.0, 0.0, 1.0), jnp.zeros(3))  # s = 0, no error, no rate

    def u(law, t, width):
        law = with_controller(run, sign_width=width).controller if law is None else law
        return law.torque(t, jnp.asarray(hold), rest, run.reference(t), jnp.zeros(3), vector(0.1))[0]

    for width in (0.0, 1e-3):
        sharp = with_controller(run, sign_width=vector(width)).controller
        for t in (0.0, 19.5, 20.0, 25.0) if hold else (0.0, 19.5):
            slopes = jax.jacfwd(u)(sharp, vector(t), None)
            assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(slopes))


def test_the_norm_in_the_switching_term_is_not_below_the_spectral_one():
    body = plants.spacecraft(FULL_INERTIA)
    for seed in range(20):
        matrix = np.asarray(attitude.t_matrix(state(seed).q) @ body.inertia_inverse)
        assert np.linalg.norm(matrix) >= np.linalg.norm(matrix, 2)
