"""Errors and gaps of the paper that a simulation can show. Start with `slips`.

The docstrings of the laws name the other errors.
"""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from ptsmc_jax.campaigns import runs
from ptsmc_jax.campaigns.runs import Run
from ptsmc_jax.laws.kinematics import AdditiveKinematics
from ptsmc_jax.laws.prescribed_time import PrescribedTime, surface_coefficients
from ptsmc_jax.numerics import attitude
from ptsmc_jax.numerics.pytrees import pytree
from ptsmc_jax.observers import nonlinear
from ptsmc_jax.paper import claims
from ptsmc_jax.plants import rigid_body
from ptsmc_jax.scenario import from_tables, study
from ptsmc_jax.signals.references import Target
from ptsmc_jax.theory import rules


@dataclass(frozen=True)
class Slip:
    """An error or gap of the paper, the correction, and the numerical evidence."""

    where: str
    paper: str
    correct: str
    shown: str
    values: dict[str, float]


def slips(cases: dict[str, Run]) -> list[Slip]:
    """Return the errors and gaps of the paper with their numerical evidence.

    cases: the runs that `claims.simulate_cases` returns, by the name of the case.
    """
    return [
        _show_expansion_coefficients(),
        _show_factor_of_theorem_3(),
        _show_missing_term(),
        _show_factor_of_bound([cases[name] for name in claims.SPACECRAFT]),
        _show_decay_of_bound(),
        _show_initial_estimate(),
        _show_effective_gain(),
        _show_sign_of_q4(),
        _show_growth_near_q4_zero(),
    ]


def _show_expansion_coefficients() -> Slip:
    """Compare (36), by automatic differentiation, with (37) and the corrected coefficients c_i."""
    t_f, eta, t = 5.0, 4.3, 1.7

    def x(time: jax.Array) -> jax.Array:
        return 2.0 - 0.7 * time + 0.3 * time**2 - 0.1 * time**3

    @jax.jit
    def relative_differences(t: jax.Array) -> jax.Array:
        """Return the relative differences of (36) and (37) at t for each order from n = 2."""
        derivative, x_derivative, states, differences = (lambda time: x(time) / (t_f - time) ** eta), x, [x(t)], []
        tau = t_f - t
        for n in (2, 3, 4, 5):
            derivative, x_derivative = jax.grad(derivative), jax.grad(x_derivative)
            states.append(x_derivative(t))
            c = surface_coefficients(jnp.asarray(eta), n)
            s = sum(c[i] * tau**i * states[i] for i in range(n))
            differences.append(derivative(t) * tau ** (eta + n - 1) / s - 1.0)
        return jnp.abs(jnp.stack(differences))

    worst = float(relative_differences(t).max())
    return Slip(
        "(37), (38), (40)",
        'c_i is an "expansion parameter", sums of (38) and (40) end at n-1',
        "c_i = C(n-1, i) eta (eta+1) .. (eta+n-2-i); the sums end at n-2, x_(n+1) does not exist",
        f"orders 2 to 5: (37) with these c_i is (36) to {worst:.0e}",
        {"largest_relative_difference": worst},
    )


def _show_factor_of_theorem_3() -> Slip:
    """Show that s of Theorem 3 grows without bound, because its factor (t_f - t)^(eta+n-1) is missing."""
    tables = claims.CASES["third_order"][2]
    quiet = {"disturbance": {"amplitude": [0.0]}, "controller": {**tables["controller"], "disturbance_bound": 0.0}}
    run = runs.simulate(study(from_tables({**tables, **quiet})))
    law, n = run.parts.controller, run.parts.controller.order
    before = run.log.t < float(law.hand_over)
    tau = float(law.t_f) - run.log.t[before]
    without_factor = np.abs(run.log.s[before, 0]) / tau ** (float(law.eta) + n - 1)
    growth = float(np.interp(-0.05, -tau, without_factor) / without_factor[0])
    return Slip(
        "Theorem 3",
        "s = d^(n-1)/dt^(n-1) (x_1 / (t_f - t)^eta)",
        "times (t_f - t)^(eta+n-1), as in (36)",
        f"without the factor s grows like 1 / (t_f - t): {growth:.0f} times its first value 0.05 s before t_f = 5 s",
        {"growth": growth},
    )


def _show_missing_term() -> Slip:
    """Simulate x'' = -K1 s - F with and without F = x', from x = 1, x' = -1 (s = 0), with K1 = 1."""

    def largest_s(factor: float) -> float:
        """Return the largest |s| within 10 s; factor: 1 with the term F, 0 without it."""

        def rate(_: float, y: np.ndarray) -> list[float]:
            return [y[1], -(y[0] + y[1]) - factor * y[1]]

        motion = solve_ivp(rate, (0.0, 10.0), [1.0, -1.0], rtol=1e-10, atol=1e-12)
        return float(np.abs(motion.y.sum(axis=0)).max())

    with_term, without = largest_s(1.0), largest_s(0.0)
    return Slip(
        "(29), second branch",
        "no term for the x_1' of s = x_1 + x_1'",
        "F(x) inside the bracket, as (10) has x_2 and (60) 2 eps_1'",
        f"from x_1 = 1 on the surface s = 0: |s| stays {with_term:.0e} with it and reaches {without:.2f} without",
        {"with": with_term, "without": without},
    )


def _error_over_bound(run: Run, start: float) -> float:
    """Return the largest estimation error over K2 after the time `start` [s]."""
    error = np.linalg.norm(run.log.d_hat - run.log.disturbance, axis=1)
    bound = np.asarray(jax.vmap(run.parts.observer.error_bound())(jnp.asarray(run.log.t)))
    later = run.log.t > start
    return float((error[later] / bound[later]).max())


def _show_factor_of_bound(cases: list[Run]) -> Slip:
    """Compare the estimation error with the bound (55), where the factor sqrt(3) is missing."""
    corrected = max(_error_over_bound(run, 0.0) for run in cases)
    printed = corrected * 3**0.5
    return Slip(
        "(55)",
        "c bounds the components of d', and the 2-norm of the error by c / l_m",
        "sqrt(3) c",
        f"Cases I and II: the error reaches {printed:.2f} times the bound as printed, {corrected:.4f} of this one",
        {"over_printed": printed, "over_corrected": corrected},
    )


def _show_decay_of_bound() -> Slip:
    """Show that the bound (55) decays faster than the estimation error if J has products of inertia."""
    inertia = np.array([[12.0, 5.0, -2.0], [5.0, 11.0, 2.0], [-2.0, 2.0, 14.0]])
    gain = np.array([10.0, 10.0, 10.0])
    a = gain[:, None] * np.linalg.inv(inertia)
    printed = float(np.diag(a).min())
    bound = nonlinear.NonlinearObserver(
        rigid_body.spacecraft(inertia), jnp.asarray(gain), jnp.asarray(0.0), jnp.asarray(1.0)
    ).error_bound()
    error = np.linalg.norm(expm(-10.0 * a), 2)  # after 10 s, from 1
    return Slip(
        "(55)",
        "l_m is the smallest diagonal element of l J^-1",
        "the smallest eigenvalue of l^1/2 J^-1 l^1/2, and the bound times sqrt(cond(l))",
        f"a body with products of inertia: after 10 s the error is {error / np.exp(-10 * printed):.1f} times the "
        f"paper's bound, {error / float(bound(jnp.asarray(10.0))):.4f} of the corrected one",
        {"printed": printed, "corrected": float(bound.rate)},
    )


def _show_initial_estimate() -> Slip:
    """Show that the estimation error exceeds K2 of (57) if the initial estimation error is wrongly assumed to be 0."""
    bound = {"disturbance_rate_bound": 1e-3}  # the published bound, not the bound 0 of a constant
    tables = {"disturbance": {"frequency": [0.0] * 3, "phase": [np.pi / 2] * 3}}  # constant
    true_bound = {**bound, "initial_estimate_error": 0.01 * 3**0.5}
    ratios = [
        _error_over_bound(runs.simulate(study(from_tables({**tables, "controller": controller}))), 1.0)
        for controller in (bound, true_bound)
    ]
    return Slip(
        "(57)",
        "K2 needs |e_d(0)|, which no controller knows",
        "an input, `initial_estimate_error`; 0 is right only where d(0) = d_hat(0)",
        f"a constant disturbance of 0.01 N m: the error is up to {ratios[0]:.1f} times K2 from 1 s on with 0, "
        f"{ratios[1]:.3f} of it with the true bound",
        {"with_0": ratios[0], "with_true_bound": ratios[1]},
    )


def _show_effective_gain() -> Slip:
    """Show that s decays at the rate K1 / 2 after the hand-over, not at the rate K1."""
    tables = {
        "disturbance": claims.NO_DISTURBANCE,
        "controller": {"disturbance_rate_bound": 0.0, "delta": 5.0, "k1": 1.6},
    }
    run = runs.simulate(study(from_tables(tables)))
    hold = (run.log.t > 26.0) & (run.log.t < 34.0)
    rate = -float(np.polyfit(run.log.t[hold], np.log(np.linalg.norm(run.log.s[hold], axis=1)), 1)[0])
    return Slip(
        "(60)",
        "K1",
        "its effective gain is K1 / 2: s' = -K1 s / 2",
        f"K1 = 1.6: s decays at {rate:.4f} 1/s after the hand-over",
        {"k1": 1.6, "rate": rate},
    )


@pytree
@dataclass(frozen=True)
class _Unaligned(AdditiveKinematics):
    """The attitude error as printed in the paper, without a choice of the sign of q."""

    def align(self, x: rigid_body.AttitudeState, target: Target) -> rigid_body.AttitudeState:
        """Return the state unchanged."""
        return x

    def singularity_distance(self, x: rigid_body.AttitudeState, target: Target) -> jax.Array:
        """Return |q4|."""
        return jnp.abs(x.q[3])


def _show_sign_of_q4() -> Slip:
    """Simulate a slew from a quaternion with the other sign of q4, with the printed and the corrected error."""
    tables = {
        "initial": {"quat_xyzw": [0.0, 0.0, 0.0, -1.0]},
        "reference": {"rotvec_deg": [0.0, 0.0, 60.0]},
        "disturbance": claims.NO_DISTURBANCE,
        "controller": {"disturbance_rate_bound": 0.0},
    }
    ready = study(from_tables(tables))
    law = ready.parts.controller
    printed = replace(law, kinematics=_Unaligned(law.model))

    def at_t_f(controller: PrescribedTime) -> tuple[float, float]:
        """Simulate this controller. Return the norm of the error eps_1 and the angle to the reference [deg] at t_f."""
        run = runs.simulate(replace(ready, parts=replace(ready.parts, controller=controller)))
        k = int(np.flatnonzero(run.log.t <= float(law.t_f))[-1])
        angle = attitude.angle(jnp.asarray(run.log.x.q[k]), jnp.asarray(run.log.reference.q[k]))
        return float(np.linalg.norm(run.log.error[k])), float(np.rad2deg(angle))

    (error, angle), (_, aligned_angle) = at_t_f(printed), at_t_f(law)
    return Slip(
        "4",
        "any sign of q",
        "the sign of q4 at t = 0 must be that of q_f4: the law cannot cross q4 = 0",
        f"a slew of 60 degrees from the other sign of q: eps_1 = {error:.0e} at t_f, {angle:.0f} degrees "
        f"away from the reference; from the right one {aligned_angle:.0e} degrees",
        {"error": error, "angle_deg": angle, "aligned_angle_deg": aligned_angle},
    )


def _show_growth_near_q4_zero() -> Slip:
    """Show that the first torque grows without bound as the initial rotation angle approaches 180 deg."""
    inertia = jnp.diag(jnp.asarray([10.0, 12.0, 14.0]))
    peaks = {}
    for angle in (90.0, 170.0, 179.0):
        q = attitude.from_rotation_vector(jnp.deg2rad(angle) * jnp.asarray([0.0, 0.0, 1.0]))
        torque = rules.first_torque(inertia, q, jnp.asarray(3.0), jnp.asarray(30.0))
        peaks[f"{angle:g}"] = float(jnp.abs(torque).max())
    return Slip(
        "Theorem 2, Section 4",
        "bounded control, globally",
        "singular at q4 = 0, 180 degrees from the inertial frame's identity; the bound grows like 1 / q4",
        f"first torque about axis 3 from 90, 170, 179 degrees: {', '.join(f'{v:.3g}' for v in peaks.values())} N m",
        peaks,
    )
