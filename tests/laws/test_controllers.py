"""The law of the paper for a spacecraft, with the additive and the multiplicative attitude error."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ptsmc_jax.laws.kinematics import AdditiveKinematics, MultiplicativeKinematics
from ptsmc_jax.numerics import attitude
from ptsmc_jax.plants.rigid_body import AttitudeState
from ptsmc_jax.signals import disturbances, references
from ptsmc_jax.simulation import rollout
from ptsmc_jax.theory.envelopes import switching_rate
from tests.helpers import (
    FULL_INERTIA,
    REFERENCE,
    commanded,
    errors_along,
    finer,
    fly,
    inputs_along,
    parts,
    short,
    vector,
    with_controller,
)

SWING = references.Swing(
    vector(0.5, -0.2, 0.4, np.sqrt(1 - 0.45)), vector(0.3, -0.5, 0.2), vector(0.2, 0.1, 0.3), vector(0.1, 0.5, 0.2)
)
KINEMATICS = [AdditiveKinematics, MultiplicativeKinematics]
SPIN = references.Spin(vector(0.1, -0.2, 0.1, np.sqrt(1 - 0.06)), vector(0.02, -0.05, 0.03))


def state(seed: int) -> AttitudeState:
    """Return a random attitude with q4 > 0 and a body rate of about 0.1 rad/s."""
    rng = np.random.default_rng(seed)
    q = rng.normal(size=4)
    q[3] = abs(q[3]) + 0.5
    return AttitudeState(vector(q / np.linalg.norm(q)), vector(0.1 * rng.normal(size=3)))


@pytest.mark.parametrize("kind", KINEMATICS)
@pytest.mark.parametrize("hold", [False, True])
@pytest.mark.parametrize("seed", short([1, 2, 3], [1]))
def test_sliding_variable_obeys_its_reaching_law(kind, hold, seed):
    """s' along the motion of the plant, by automatic differentiation, equals (31) or (34)."""
    moving = SWING if kind is KINEMATICS[1] else SPIN  # with w_f' for the multiplicative error
    run = parts(
        20.0,
        3.5,
        0.5,
        inertia=FULL_INERTIA,
        reference=moving,
        k1=1.7,
        sign_width=0.1,
        kinematics=kind,
        surface_rate=1.3,
    )
    law, x, t = run.controller, state(seed), vector(4.0)
    d, d_hat, k2 = vector(0.3, -0.1, 0.2), vector(0.1, 0.1, -0.2), vector(0.05)
    u, s = commanded(law, t, jnp.asarray(hold), x, moving(t), d_hat, k2)

    def surface(time, y):
        return commanded(law, time, jnp.asarray(hold), y, moving(time), d_hat, k2)[1]

    _, s_dot = jax.jvp(surface, (t, x), (jnp.ones_like(t), run.plant.rate(t, x, u, d)))
    error, error_rate = law.kinematics.errors(x, moving(t))
    tau, tanh = 16.0, np.tanh(np.asarray(s) / 0.1)
    inverse = np.linalg.inv(np.asarray(FULL_INERTIA))
    q_e = attitude.multiply(attitude.conjugate(moving(t).q), x.q)
    gain = np.asarray(attitude.t_matrix(q_e if kind is KINEMATICS[1] else x.q)) @ inverse
    switching = np.linalg.norm(gain) * 0.05  # Frobenius
    estimation_error = gain @ np.asarray(d - d_hat)
    if hold:
        np.testing.assert_allclose(s, error_rate + 1.3 * error, atol=1e-14)
        expected = 0.5 * (estimation_error - switching * tanh - 1.7 * np.asarray(s))  # the effective gain is K1/2
    else:
        np.testing.assert_allclose(s, tau * error_rate + 3.5 * error, atol=1e-13)
        expected = -3.5 / tau * np.asarray(s) + tau / 2 * (estimation_error - switching * tanh)
    np.testing.assert_allclose(s_dot, expected, atol=1e-12)  # rounding errors of terms up to 1


@pytest.mark.parametrize("case", REFERENCE["cases"], ids=lambda case: case["name"])
def test_first_torque_and_s_equal_the_reference_data(case):
    run = parts(case["t_f"], case["eta"], case["delta"])
    first = case["trajectory"][0]
    x = AttitudeState(vector(first["q"]), vector(first["omega"]))
    zero = jnp.zeros(3)
    u, s = commanded(run.controller, vector(0.0), jnp.asarray(False), x, run.reference(vector(0.0)), zero, vector(0.0))
    np.testing.assert_allclose(u, first["torque"], rtol=1e-13)
    np.testing.assert_allclose(s, first["s"], rtol=1e-13)


def test_sign_width_0_is_the_discontinuous_sign():
    run = parts(20.0, 3.0, 0.5)
    others = vector(1.0), jnp.asarray(False), state(5), run.reference(vector(0.0)), jnp.zeros(3), vector(0.3)
    (discontinuous, s), (thin_layer, _) = (
        commanded(with_controller(run, sign_width=vector(width)).controller, *others) for width in (0.0, 1e-12)
    )
    assert np.all(np.abs(s) > 1e-6)
    np.testing.assert_array_equal(discontinuous, thin_layer)


def test_align_chooses_the_sign_of_q_with_a_positive_distance_to_the_singularity():
    law = parts().controller
    x = state(4)
    for flip_x in (1.0, -1.0):
        for flip_f in (1.0, -1.0):
            target = references.Fixed(flip_f * vector(0.0, 0.6, 0.0, 0.8))(vector(0.0))
            aligned = law.kinematics.align(AttitudeState(flip_x * x.q, x.w), target)
            assert float(aligned.q[3] * target.q[3]) > 0
            np.testing.assert_allclose(law.singularity_distance(aligned, target), x.q[3])
            assert float(law.singularity_distance(AttitudeState(-aligned.q, x.w), target)) < 0


@pytest.mark.parametrize("hold", [False, True])
def test_gradients_are_finite_at_zero_error_and_rate(hold):
    run = parts(20.0, 3.0, 0.5)
    rest = AttitudeState(vector(0.0, 0.0, 0.0, 1.0), jnp.zeros(3))  # s = 0, no error, no rate

    def u(law, t, width):
        law = with_controller(run, sign_width=width).controller if law is None else law
        return commanded(law, t, jnp.asarray(hold), rest, run.reference(t), jnp.zeros(3), vector(0.1))[0]

    for width in (0.0, 1e-3):
        law = with_controller(run, sign_width=vector(width)).controller
        for t in (0.0, 19.5, 20.0, 25.0) if hold else (0.0, 19.5):
            gradients = jax.jacfwd(u)(law, vector(t), None)
            assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradients))


def test_multiplicative_error_and_rate_equal_vector_part_of_scipy_error_quaternion():
    law = parts(kinematics=KINEMATICS[1]).controller
    for seed in range(5):
        x, t = state(seed), vector(3.0 + seed)
        error, error_rate = law.kinematics.errors(x, SWING(t))
        found = Rotation.from_quat(np.asarray(SWING(t).q)).inv() * Rotation.from_quat(np.asarray(x.q))
        q_e = found.as_quat()
        np.testing.assert_allclose(
            error * np.sign(law.singularity_distance(x, SWING(t))), q_e[:3] * np.sign(q_e[3]), atol=1e-15
        )

        def error_at(time, x=x, t=t):
            body = AttitudeState(x.q + (time - t) * attitude.derivative(x.q, x.w), x.w)
            return law.kinematics.errors(body, SWING(time))[0]

        np.testing.assert_allclose(jax.jvp(error_at, (t,), (jnp.ones_like(t),))[1], error_rate, atol=1e-14)


def slew(kinematics, reference, start, rate=(0.0, 0.0, 0.0), undisturbed=True, **others):
    """Return the parts of a run to a reference, without a disturbance or with the default one.

    start, rate: initial attitude (4,) and body rate (3,) [rad/s]. others: of `helpers.parts`. The disturbance of zero
    has the same type as the default one, so that both runs use one compiled program. With the multiplicative error the
    time steps are halved.
    """
    none = {"disturbance": disturbances.Sinusoid(*[jnp.zeros(3)] * 4), "rate_bound": 0.0} if undisturbed else {}
    run = parts(
        20.0,
        3.5,
        0.1,
        inertia=FULL_INERTIA,
        q=start,
        rate=rate,
        reference=reference,
        kinematics=kinematics,
        **none,
        **others,
    )
    return finer(run, 2) if kinematics is KINEMATICS[1] else run


def fixed(q):
    """Return a reference at rest with attitude q (4,).

    It has the type of rotating references, so that both use one compiled program.
    """
    return references.Spin(vector(q), jnp.zeros(3))


# this reference passes 180 degrees from the inertial frame, where q_f4 changes its sign
CROSSING = references.Spin(vector(Rotation.from_rotvec([2.9, 0.2, 0.1]).as_quat()), vector(0.04, 0.01, -0.02))
AWAY = vector((Rotation.from_rotvec([2.9, 0.2, 0.1]) * Rotation.from_rotvec([0.5, -1.2, 0.8])).as_quat())


def test_multiplicative_error_follows_exact_solution_1_while_reference_crosses_additive_singularity():
    """The simulated torque is that of the exact motion."""
    run = slew(KINEMATICS[1], CROSSING, AWAY, (0.03, 0.0, -0.02))
    result = fly(run)
    before = result.log.t < 19.89
    assert result.status == rollout.OK
    assert np.ptp(np.sign(result.log.reference.q[before, 3])) == 2  # the reference crosses the singularity
    target = run.reference(vector(0.0))
    start = run.controller.kinematics.errors(run.controller.kinematics.align(run.initial, target), target)
    exact = errors_along(result.log.t, vector(20.0), vector(3.5), *start)
    np.testing.assert_allclose(result.log.error[before], exact.error[before], rtol=0, atol=1e-10)
    # the simulated torque equals the torque of the exact motion, from the inverse dynamics of `theory`
    u = inputs_along(run, result.log.t)[before]
    feedback = 2 * 14 * 3.5**2 / (20.0 - result.log.t[before]) ** 2  # torque for an error of 1e-10 is 1e-10 times this
    assert np.all(np.abs(u - result.log.u[before]).max(axis=1) < 1e-9 * np.maximum(feedback, 1.0))


@pytest.mark.parametrize("seed", [1, 2])
def test_multiplicative_loop_does_not_depend_on_the_inertial_frame(seed):
    """With the additive error, the motion depends on the frame."""
    turn = vector(Rotation.random(rng=np.random.default_rng(seed)).as_quat())
    run = slew(KINEMATICS[1], CROSSING, AWAY, (0.01, 0.02, 0.0), undisturbed=False)
    turned = replace(
        run,
        initial=AttitudeState(attitude.multiply(turn, run.initial.q), run.initial.w),
        reference=replace(run.reference, q=attitude.multiply(turn, run.reference.q)),
    )
    one, other = fly(run), fly(turned)
    for name in ("w", "error", "d_hat"):
        a, b = (getattr(r.log.x if name == "w" else r.log, name) for r in (one, other))
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12, err_msg=name)
    early = one.log.t < 19.0  # later the feedback gain 2 J eta^2 / tau^2 amplifies rounding errors by more than 300
    np.testing.assert_allclose(one.log.u[early], other.log.u[early], rtol=0, atol=1e-12)
    expected = np.asarray(jax.jit(jax.vmap(lambda q: attitude.multiply(turn, q)))(jnp.asarray(one.log.x.q)))
    signs = np.sign(np.sum(expected * other.log.x.q, axis=1, keepdims=True))
    np.testing.assert_allclose(other.log.x.q * signs, expected, rtol=0, atol=1e-12)
    # with the additive error the motion depends on the frame
    additive = slew(KINEMATICS[0], CROSSING, AWAY, (0.01, 0.02, 0.0), undisturbed=False)
    a, b = (fly(replace(additive, initial=r.initial, reference=r.reference)) for r in (run, turned))
    assert np.abs(a.log.x.w[: len(a.log.t) // 4] - b.log.x.w[: len(b.log.t) // 4]).max() > 1e-3


def test_sign_of_q_does_not_change_the_path_and_additive_error_takes_the_longer_one():
    """With the additive error the path passes the inertial frame, here the longer way."""
    axis = np.array([0.6, 0.0, 0.8])
    start, end = (vector(Rotation.from_rotvec(np.deg2rad(a) * axis).as_quat()) for a in (150.0, 210.0))
    turned = {}
    for kind in KINEMATICS:
        for sign in (1.0, -1.0):
            result = fly(slew(kind, fixed(end), sign * start))
            assert result.status == rollout.OK
            assert result.metrics.terminal_angle < 1e-4
            speed = np.linalg.norm(result.log.x.w, axis=1)
            turned[kind, sign] = np.rad2deg(np.trapezoid(speed, result.log.t))
    near, far = turned[KINEMATICS[1], 1.0], turned[KINEMATICS[0], 1.0]
    assert near == pytest.approx(60.0, abs=0.1)
    assert far == pytest.approx(300.0, abs=0.5)
    assert turned[KINEMATICS[1], -1.0] == pytest.approx(near, abs=1e-9)
    assert turned[KINEMATICS[0], -1.0] == pytest.approx(far, abs=1e-9)


def test_multiplicative_error_is_singular_at_180_degrees_only():
    """A fast initial rate away from the reference may reach 180 degrees. A sufficient condition excludes it."""
    law = parts(kinematics=KINEMATICS[1]).controller
    opposite = references.Fixed(vector(Rotation.from_rotvec([0.0, np.pi, 0.0]).as_quat()))(vector(0.0))
    near = Rotation.from_rotvec([0.0, 1e-3, 0.0])
    x = AttitudeState(vector(near.as_quat()), jnp.zeros(3))
    assert abs(float(law.singularity_distance(x, opposite))) == pytest.approx(np.sin(5e-4), rel=1e-9)
    # a fast initial rate away from the reference: |v| exceeds 1, at a node of the time grid or between two nodes
    run = slew(KINEMATICS[1], fixed([0.0, 0.0, 0.0, 1.0]), vector(0.0, 0.6, 0.0, 0.8), (0.0, 0.9, 0.0))
    assert fly(run).status in (rollout.SINGULAR, rollout.TOO_FAST)
    # |v(0)| + t_f |v'(0)| / (e eta) < 1 is sufficient
    slow = slew(KINEMATICS[1], fixed([0.0, 0.0, 0.0, 1.0]), vector(0.0, 0.6, 0.0, 0.8), (0.0, 0.45, 0.0))
    error, error_rate = slow.controller.kinematics.errors(slow.initial, slow.reference(vector(0.0)))
    assert np.linalg.norm(error) + 20.0 * np.linalg.norm(error_rate) / (np.e * 3.5) < 1.0
    assert fly(slow).status == rollout.OK


@pytest.mark.parametrize("hold", [False, True])
def test_switching_rate_is_the_acceleration_that_k2_adds_at_the_reference(hold):
    """At the reference T(q) = I, and |T J^-1| has its maximum there."""
    run = parts(20.0, 3.5, 0.5, inertia=FULL_INERTIA, kinematics=KINEMATICS[1], sign_width=1e-6)
    law, t = run.controller, vector(4.0)
    x = AttitudeState(vector([0.0, 0.0, 0.0, 1.0]), vector([0.3, 0.2, 0.1]))
    target = references.Fixed(vector([0.0, 0.0, 0.0, 1.0]))(t)
    unswitched, switched = (
        commanded(law, t, jnp.asarray(hold), x, target, jnp.zeros(3), vector(k2))[0] for k2 in (0.0, 0.05)
    )
    acceleration = 0.5 * run.plant.inertia_inverse @ (switched - unswitched)
    np.testing.assert_allclose(acceleration, np.full(3, -switching_rate(law, vector(0.05))), rtol=1e-12)
