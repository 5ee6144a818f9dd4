"""Continuous runs against `solve_ivp` with a NumPy right-hand side and adaptive diffrax, at matched error.

The table has one run, and a batch from random attitudes, whose time is divided by the number of runs.
"""

import jax

from ptsmc_jax.configure import configure

configure()

from functools import partial  # noqa: E402

import diffrax  # noqa: E402  # pyright: ignore[reportMissingImports]
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402
from common import machine, medians, say  # noqa: E402
from scipy.integrate import solve_ivp  # noqa: E402

from ptsmc_jax import scenario  # noqa: E402
from ptsmc_jax.campaigns import montecarlo  # noqa: E402
from ptsmc_jax.laws.base import Sample  # noqa: E402
from ptsmc_jax.simulation import rollout  # noqa: E402

ERROR = 1e-9  # wanted in the attitude error vector at t_f
BATCH = 1024  # runs
DRAWN = {"dispersion": {"attitude": {"kind": "axis_angle", "min_deg": 20.0, "max_deg": 140.0}}}


def numpy_loop(parts):
    """Return the closed loop's right-hand side on (q, w, d_hat), the formulas of the paper in NumPy."""
    J, J_inverse = np.asarray(parts.plant.inertia), np.asarray(parts.plant.inertia_inverse)
    law, d = parts.controller, parts.disturbance
    qf = np.asarray(parts.reference(jnp.zeros(())).q)
    t_f, eta, k1, width = (float(v) for v in (law.t_f, law.eta, law.k1, law.sign_width))
    amplitude, frequency, phase = (np.asarray(v) for v in (d.amplitude, d.frequency, d.phase))
    A = np.asarray(parts.observer.decay_matrix(jnp.zeros(()), jnp.zeros(())))
    k2 = [float(v) for v in parts.observer.error_bound()]

    def cross(a, b):
        return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])

    def rate(t, y, hold):
        v, q4, w, d_hat = y[:3], y[3], y[4:7], y[7:]
        T = np.array([[q4, -v[2], v[1]], [v[2], q4, -v[0]], [-v[1], v[0], q4]])
        v_dot, gyroscopic = 0.5 * T @ w, cross(w, J @ w)
        bound = k2[2] + np.exp(-k2[0] * t) * (k2[1] - k2[2])
        tau = 1.0 if hold else t_f - t
        s = tau * v_dot + (1.0 if hold else eta) * (v - qf[:3])
        a, b = (2.0, k1) if hold else (2.0 * (eta - 1.0) / tau, 2.0 * eta / tau**2)
        switching = np.sqrt(np.sum((T @ J_inverse) ** 2)) * bound
        wanted = 0.5 * (w @ w) * v - switching * np.tanh(s / width) - a * v_dot - b * s
        y_inverse = (q4 * q4 * wanted + v * (v @ wanted) - q4 * cross(v, wanted)) / (q4 * (q4 * q4 + v @ v))
        u = gyroscopic - d_hat + J @ y_inverse
        d_true = amplitude * np.sin(frequency * t + phase)
        w_dot = J_inverse @ (u + d_true - gyroscopic)
        return np.concatenate([v_dot, [-0.5 * v @ w], w_dot, A @ (d_true - d_hat)])

    return rate


def main() -> None:
    """Print times at matched error, and their ratios."""
    parts = scenario.study(scenario.from_tables({})).parts
    t_f, t_s = float(parts.controller.t_f), float(parts.controller.hand_over)
    t_end = float(parts.t_end)
    rate = numpy_loop(parts)
    x0 = parts.controller.kinematics.align(parts.initial, parts.reference(jnp.zeros(())))
    y0 = np.concatenate([x0.q, x0.w, np.zeros(3)])

    def by_scipy(tolerance, method):
        y, reached = y0, []
        for start, end, hold in ((0.0, t_s, False), (t_s, t_f, True), (t_f, t_end, True)):
            solution = solve_ivp(partial(rate, hold=hold), (start, end), y, method, rtol=tolerance, atol=tolerance)
            y = solution.y[:, -1]
            reached.append(y[:3])
        return reached[1], reached[2]

    law, watch, plant, k2 = parts.controller, parts.observer, parts.plant, parts.observer.error_bound()

    def closed(t, y, hold):
        x, d_hat = y
        u, *_ = law(Sample(t, hold, jnp.zeros(())), x, parts.reference(t), d_hat, k2(t))
        x_dot = plant.rate(t, x, u, parts.disturbance(t, x))
        seen = watch.model.implied_disturbance(t, x, x_dot, u)
        return x_dot, watch.forcing(t, (t, t), d_hat, seen) - watch.decay_matrix(t, t) @ d_hat

    @partial(jax.jit, static_argnames="solver")
    def by_diffrax(tolerance, solver):
        state, reached = (x0, jnp.zeros(3)), []
        for start, end, hold in ((0.0, t_s, False), (t_s, t_f, True), (t_f, t_end, True)):
            control = diffrax.PIDController(rtol=tolerance, atol=tolerance)
            term = diffrax.ODETerm(lambda t, y, _, hold=hold: closed(t, y, jnp.asarray(hold)))
            solution = diffrax.diffeqsolve(term, solver, start, end, 1e-3, state, stepsize_controller=control,
                                           max_steps=1_000_000, adjoint=diffrax.ForwardMode())  # fmt: skip
            state = jax.tree.map(lambda v: v[-1], solution.ys)
            reached.append(state[0].q[:3])
        return reached[1], reached[2]

    ours = partial(rollout.simulate_parts, parts)
    best, _ = by_scipy(1e-13, "DOP853")
    target = np.asarray(parts.reference(jnp.zeros(())).q)[:3]
    exact = np.linalg.norm(best - target)
    found = float(ours().metrics.terminal_error)
    say(f"terminal error {exact:.6e}; ptsmc_jax is off by {abs(found - exact):.1e}")
    assert abs(found - exact) < ERROR
    runs = {"ptsmc_jax": lambda: ours().metrics.terminal_error}
    for method in ("RK45", "DOP853", "LSODA", "Radau"):
        for tolerance in 10.0 ** np.arange(-5.0, -13.0, -0.5):
            error = np.max(np.abs(by_scipy(tolerance, method)[0] - best))
            if error <= ERROR:
                say(f"solve_ivp {method}: tolerance {tolerance:.0e}, off by {error:.1e}")
                runs[f"solve_ivp {method}"] = partial(by_scipy, tolerance, method)
                break
    for solver in (diffrax.Tsit5(), diffrax.Dopri8()):
        for tolerance in 10.0 ** np.arange(-5.0, -13.0, -0.5):
            error = np.max(np.abs(np.asarray(by_diffrax(tolerance, solver)[0]) - best))
            if error <= ERROR:
                say(f"diffrax {type(solver).__name__}: tolerance {tolerance:.0e}, off by {error:.1e}")
                runs[f"diffrax {type(solver).__name__}"] = partial(by_diffrax, tolerance, solver)
                break
    many = scenario.study(scenario.from_tables(DRAWN))
    trials = np.arange(BATCH)
    runs[f"batch of {BATCH}"] = lambda: montecarlo.run(many.parts, many.dispersion, 0, trials).metrics
    seconds = medians(runs)
    seconds[f"batch of {BATCH}"] /= BATCH
    for name, s in seconds.items():
        say(f"  {name:18s} {s * 1e3:9.4f} ms a run, {s / seconds['ptsmc_jax']:8.4g} times ptsmc_jax")


if __name__ == "__main__":
    say(machine())
    main()
