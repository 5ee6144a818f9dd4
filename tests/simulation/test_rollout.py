from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.campaigns import runs
from ptsmc_jax.devices.actuators import Actuators
from ptsmc_jax.laws.baselines import PD
from ptsmc_jax.laws.kinematics import MultiplicativeKinematics
from ptsmc_jax.observers import nonlinear
from ptsmc_jax.plants import integrator_chain, rigid_body, second_order
from ptsmc_jax.signals import disturbances, references
from ptsmc_jax.simulation import clock, control_period, rollout
from ptsmc_jax.simulation.gains import with_gains
from tests.helpers import (
    FULL_INERTIA,
    REFERENCE,
    chain_flight,
    chain_parts,
    errors_along,
    finer,
    fly,
    parts,
    short,
    ticks_of,
    vector,
    with_controller,
)

TIGHT = clock.anchored_clock(0.25, 30.0)


def at_20_hz(*gains) -> rollout.Parts:
    """Return the parts of a run at 20 Hz that uses the compiled program of runs at up to 100 Hz.

    gains: t_f, eta, delta and the observer's gain.
    """
    run = parts(*gains, period=0.05)
    return replace(run, clock=run.clock.long_enough_for([parts(20.0, 3.0, 2.0, period=0.01).clock]))


def perfect(run: rollout.Parts) -> rollout.Parts:
    """Return the parts without disturbance and with K2 = 0.

    Then d_hat = 0 is a perfect estimate and exact solution 1 applies.
    """
    quiet = disturbances.Constant(jnp.zeros(3))
    bound = replace(run.observer, disturbance_rate_bound=vector(0.0))
    return replace(run, disturbance=quiet, observer=bound)


def parts_of_reference_case(case: dict) -> rollout.Parts:
    """Return the parts that simulate a case of the reference data, with its times in the history."""
    # the reference data use c instead of sqrt(3) c in (55)
    times = [row["t"] for row in case["trajectory"]]
    run = parts(case["t_f"], case["eta"], case["delta"], rate_bound=1e-3 / np.sqrt(3.0), saves=times)
    assert isinstance(run.clock, clock.Graded)
    assert run.clock.before <= 414
    assert run.clock.after <= 101
    return replace(run, clock=replace(run.clock, before=414, after=101))


@pytest.mark.parametrize("case", REFERENCE["cases"], ids=lambda case: case["name"])
def test_the_continuous_loop_matches_an_independent_integration(case):
    run = parts_of_reference_case(case)
    result = fly(run)
    log = result.log
    steps = log.t.size - 1
    assert steps <= 600
    for row in case["trajectory"]:
        k = int(np.flatnonzero(log.t == row["t"])[-1])  # save times are nodes, exactly
        for name, value in (("q", log.x.q), ("omega", log.x.w), ("d_hat", log.d_hat), ("s", log.s)):
            np.testing.assert_allclose(value[k], row[name], rtol=0, atol=2e-8, err_msg=f"{name} at {row['t']}")
        # the torque is the state times gains of up to 2 J eta^2/tau^2 before the hand-over, and 2 J after it
        tau = max(case["t_f"] - row["t"], case["delta"])
        gain = 2 * 14 * case["eta"] ** 2 / tau**2 if row["t"] < case["t_f"] - case["delta"] else 2 * 14
        np.testing.assert_allclose(log.u[k], row["torque"], rtol=0, atol=2e-8 * max(gain, 1.0))
    summary = case["summary"]
    np.testing.assert_allclose(result.metrics.terminal_error, summary["terminal_error_2"], rtol=1e-3)
    late = log.t >= case["t_f"]
    np.testing.assert_allclose(np.abs(log.error[late]).max(), summary["hold_error_inf"], rtol=1e-3)
    assert int(result.status) == rollout.OK


@pytest.mark.parametrize("eta", [2.2, 3.0, 5.0])
@pytest.mark.parametrize("rate", [(0.0, 0.0, 0.0), (0.02, -0.03, 0.01)])
def test_a_perfect_estimate_gives_the_exact_solution(eta, rate):
    run = finer(perfect(parts(30.0, eta, 0.05, inertia=FULL_INERTIA, rate=rate)), 2)
    log = fly(run).log
    before = log.t < 29.949
    error, error_rate = run.controller.kinematics.errors(run.initial, run.reference(vector(0.0)))
    exact = errors_along(log.t, vector(30.0), vector(eta), error, error_rate)
    # the error is up to 1e-9 on the default grid and a sixteenth with twice the steps; s is tau <= 30 s times a rate
    np.testing.assert_allclose(log.error[before], exact.error[before], rtol=0, atol=1e-10)
    np.testing.assert_allclose(log.s[before], exact.s[before], rtol=0, atol=3e-9)


@pytest.mark.parametrize("plant", short(["chain", "spacecraft"], ["chain"]))
def test_derivatives_of_the_rollout_match_the_exact_solution(plant):
    run = perfect(parts(30.0, 3.0, 0.5)) if plant == "spacecraft" else chain_parts([0.6, 0.0], 30.0, 3.0, 0.5)
    run = finer(run, 4)  # relative error 3e-8 on the default grid, 1/256 of it here
    error, error_rate = run.controller.kinematics.errors(run.initial, run.reference(vector(0.0)))
    start = error + 0 * error_rate

    def at_hand_over(eta, delta):
        log = rollout.simulate(with_controller(run, eta=eta, delta=delta), record=True).log
        assert log is not None
        held = ticks_of(run.clock, run.controller.t_f, delta).hold
        return log.error[jnp.argmax(held)]  # the first row of the hold phase is the hand-over

    found = jax.jit(jax.jacfwd(lambda *at: (at_hand_over(*at),) * 2, (0, 1), has_aux=True))
    (by_eta, by_delta), value = found(vector(3.0), vector(0.5))
    r = 0.5 / 30.0
    log_r, s0 = -np.log(r), 3.0 * start
    np.testing.assert_allclose(value, r**3 * (start + s0 * log_r), rtol=1e-9)
    # d/d eta of r^eta (x0 + eta x0 L): -L r^eta (x0 + s0 L) + r^eta x0 L = -s0 L^2 r^eta from rest
    np.testing.assert_allclose(by_eta, -s0 * log_r**2 * r**3, rtol=1e-8)
    np.testing.assert_allclose(by_delta, r**3 * (3.0 * (start + s0 * log_r) - s0) / 0.5, rtol=1e-8)


def test_the_sampled_loop_converges_to_the_continuous_loop_with_first_order():
    truth = fly(parts(20.0, 3.0, 2.0, 5.0, sign_width=0.05)).metrics
    sampled = [parts(20.0, 3.0, 2.0, 5.0, sign_width=0.05, period=period) for period in (0.04, 0.02, 0.01)]
    clocks = [run.clock for run in sampled]
    gaps = []
    for run in sampled:
        metrics = fly(replace(run, clock=run.clock.long_enough_for(clocks))).metrics
        gaps.append(abs(float(metrics.window_error / truth.window_error) - 1.0))
    ratios = np.array(gaps[:-1]) / np.array(gaps[1:])
    assert np.all((ratios > 1.8) & (ratios < 2.2))  # zero-order hold: half a period of delay


def test_motion_under_held_torque_matches_an_adaptive_integrator():
    from scipy.integrate import solve_ivp

    run = parts(20.0, 3.0, 1.0, period=0.25, noise=(2e-5, 1e-6), inertia=FULL_INERTIA)
    run = replace(run, clock=TIGHT)
    log = fly(run, 3, 7).log
    inertia = np.asarray(FULL_INERTIA)

    def rate(t, y, u):
        q, w = y[:4], y[4:]
        v_dot = 0.5 * (q[3] * w + np.cross(q[:3], w))
        d = 0.01 * np.sin(0.1 * t) * np.ones(3)
        w_dot = np.linalg.solve(inertia, u + d - np.cross(w, inertia @ w))
        return np.concatenate([v_dot, [-0.5 * q[:3] @ w], w_dot])

    y = np.concatenate([log.x.q[0], log.x.w[0]])
    for k in range(len(log.t) - 1):
        if log.t[k + 1] > log.t[k]:
            span = (log.t[k], log.t[k + 1])
            y = solve_ivp(rate, span, y, args=(log.u[k],), rtol=1e-11, atol=1e-13).y[:, -1]
    # the error of RK4 at 0.25 s and up to 0.15 rad/s is (0.04)^5/120 per step, 1e-7 after 120 steps
    np.testing.assert_allclose(np.concatenate([log.x.q[-1], log.x.w[-1]]), y, atol=1e-7)


@pytest.mark.parametrize("kind", ["anchored", "flight"])
def test_the_last_row_of_a_history_has_the_estimate_and_s_of_a_sample_at_t_end(kind):
    """It equals the row at this time in a longer run, which has a sample there. The torque is still the held one."""
    chain = {"plant": {"kind": "chain", "order": 2}, "observer": {"kind": "nonlinear"},
             "controller": {"t_f": 3.0, "delta": 1.0}, "hardware": {"state_noise": [1e-5, 1e-6]}}  # fmt: skip
    loop = {"mode": "sampled", "period": 0.25, "window": 1.0, "clock": kind}

    def history(t_end):
        return runs.simulate(scenario.study(scenario.from_tables({**chain, "loop": {**loop, "t_end": t_end}}))).log

    log, longer = history(4.5), history(5.0)
    end = log.t.size - 1
    assert log.t[end] == longer.t[end] == 4.5
    np.testing.assert_array_equal(log.d_hat[end], longer.d_hat[end])
    np.testing.assert_array_equal(log.s[end], longer.s[end])
    assert np.all(log.d_hat[end] != log.d_hat[end - 1])
    np.testing.assert_array_equal(log.u[end], log.u[end - 1])


@pytest.mark.parametrize("flight", [False, True])
def test_metrics_at_a_t_f_between_two_samples_use_the_motion_at_t_f(flight):
    """`terminal_error` equals that of an independent integration from the last sample to t_f."""
    body = with_controller(at_20_hz(20.0, 3.0, 0.53), t_f=vector(20.02))  # t_f = t_s + 10.6 periods
    run = chain_flight() if flight else body
    t_f = float(run.controller.t_f)
    result = fly(run)
    log = result.log
    k = np.flatnonzero((log.t < t_f) & log.has_length)[-1]
    assert t_f - log.t[k] > 1e-3  # t_f is not at a sample
    halves = 64  # independent check: many small RK4 steps from the previous sample with the same torque
    x = jax.tree.map(lambda v: jnp.asarray(v[k]), log.x)
    from ptsmc_jax.numerics import integrators

    for j in range(halves):
        step = (t_f - log.t[k]) / halves
        x = integrators.rk4(
            lambda t, y: run.plant.rate(t, y, jnp.asarray(log.u[k]), run.disturbance(t)),
            vector(log.t[k] + j * step),
            x,
            vector(step),
        )
    error, _ = run.controller.kinematics.errors(x, run.reference(vector(t_f)))
    np.testing.assert_allclose(result.metrics.terminal_error, np.linalg.norm(error), rtol=1e-8)


def test_status_of_singular_and_diverged_runs():
    """The failure has a time. Metrics of a run with a NaN state are NaN."""
    turned = np.array([0.0, 0.0, 1.0, 1e-4])
    near = fly(parts(q=turned / np.linalg.norm(turned)))
    assert int(near.status) == rollout.SINGULAR
    assert float(near.bad_time) == 0.0

    wild = fly(replace(parts(20.0, 8.0, 0.05, period=0.25, noise=(0.05, 0.05)), clock=TIGHT))
    assert int(wild.status) in (rollout.TOO_FAST, rollout.SINGULAR, rollout.DIVERGED)
    assert 0.0 < float(wild.bad_time) <= 30.0

    lost = fly(parts(q=np.array([np.nan, 0.0, 0.0, 1.0])))
    assert int(lost.status) == rollout.DIVERGED
    assert all(np.isnan(float(getattr(lost.metrics, name))) for name in ("window_error", "hold_error", "settling_time"))


@pytest.mark.parametrize(("disturbance", "status"), [(0.5, rollout.OK), (50.0, rollout.NOT_CONVERGED)])
def test_a_run_that_starts_on_the_target_has_not_converged_beyond_ten_settling_angles(disturbance, status):
    """The limit of 5 % of the initial error is 0 here, so the limit of ten settling angles of 1e-3 applies.

    A constant disturbing acceleration a leaves the error a tau^2 / (eta - 2)^2 at tau = delta, here 1.25e-3 and 0.125.
    """
    pushed = disturbances.Constant(vector([disturbance]))
    result = fly(chain_parts([0.0, 0.0], disturbance=pushed))
    assert int(result.status) == status
    assert (float(result.metrics.terminal_angle) > 1e-2) == (status == rollout.NOT_CONVERGED)
    np.testing.assert_equal(float(result.bad_time), 5.0 if status == rollout.NOT_CONVERGED else np.nan)


def test_runs_that_did_not_converge_have_finished():
    """A loss with this mask keeps the metrics and the derivatives of a run that did not converge at t_f."""
    codes = jnp.array(list(rollout.STATUS))
    names = [name for name, _ in rollout.STATUS.values()]
    assert [name for name, count in zip(names, jax.jit(rollout.has_finished)(codes), strict=True) if count] == [
        "ok", "not_converged",
    ]  # fmt: skip
    slow = chain_parts([0.0, 0.0], disturbance=disturbances.Constant(vector([50.0])))

    def loss(eta):
        run = rollout.simulate_once(with_gains(slow, {"eta": eta}))
        return jnp.where(rollout.has_finished(run.status), run.metrics.window_error, jnp.nan), run.status

    derivative, status = jax.jacfwd(loss, has_aux=True)(jnp.asarray(3.0))
    assert int(status) == rollout.NOT_CONVERGED
    assert abs(derivative) > 1.0
    with pytest.raises(TypeError):
        rollout.has_finished("ok")  # type: ignore[arg-type]  # the status of `ptsmc.simulate`


def simulated(plant, mode, **tables):
    """Return the result of a simulated scenario with this plant, mode of the loop and other tables."""
    loop = {"mode": mode, "settling_angle": 1e-3}
    return runs.simulate(scenario.study(scenario.from_tables({"plant": plant, "loop": loop, **tables})))


MASS = second_order.system(1, lambda t, a, b: b, lambda t, a, b: 0 * a, lambda t, a, b: jnp.eye(1))


CHAIN, SYSTEM = {"kind": "chain"}, {"kind": "system", "system": MASS}
LOOPS = [(CHAIN, "continuous"), (CHAIN, "sampled"), (SYSTEM, "continuous"), (SYSTEM, "sampled")]


@pytest.mark.parametrize(("plant", "mode"), short(LOOPS, LOOPS[1:3]))
def test_a_run_with_a_metric_that_is_not_finite_is_not_ok(plant, mode):
    """The state stays finite, but its square overflows (1.8e308), so the RMS over the window has no value."""
    needs = {"requirements": {"peak_torque": 1e300, "window_error": 1e300}}
    large, lost = (simulated({**plant, "x0": [x, 0.0]}, mode, **needs) for x in (1e140, 1e160))
    assert (large.status, large.met) == ("ok", True)
    assert all(np.isfinite(value) for name, value in large.metrics.items() if name != "settling_time")
    assert np.isnan(large.metrics["settling_time"])  # a run that never settles can still be ok
    assert np.isfinite(lost.log.x).all()
    assert not np.isfinite(lost.metrics["window_error"])
    assert (lost.status, lost.reason) == ("diverged", "a metric is not finite")
    assert lost.bad_time == float(lost.parts.t_end)
    assert not any(v.met for v in lost.verdicts)
    assert not lost.met


def test_a_spacecraft_with_an_overflowing_momentum_is_not_ok():
    for inertia, code in ((1e140, rollout.OK), (1e170, rollout.UNBOUNDED)):
        result = fly(parts(inertia=(inertia,) * 3, gain=inertia, rate=(0.02, -0.03, 0.01)))
        assert int(result.status) == code
        assert np.isfinite(float(result.metrics.peak_momentum)) == (code == rollout.OK)
        assert np.isfinite(float(result.metrics.window_error))


def test_either_sign_of_the_initial_quaternion_gives_the_same_run():
    q = parts().initial.q
    one, other = fly(parts()), fly(parts(q=-q))
    np.testing.assert_array_equal(one.log.x.q, other.log.x.q)
    np.testing.assert_array_equal(one.metrics.window_error, other.metrics.window_error)
    # and a reference given with q_f4 < 0 is reached with a true error of zero, not of 2 pi
    flipped = fly(parts(reference=references.Fixed(vector(0.0, 0.0, 0.0, -1.0))))
    np.testing.assert_allclose(flipped.metrics.window_error, one.metrics.window_error, rtol=1e-9)
    assert float(flipped.metrics.terminal_angle) < 1e-6


def test_runs_with_other_numbers_share_a_compiled_program(monkeypatch):
    traced, loop = [], rollout._sampled_loop

    def counted(*args):
        traced.append(args)
        return loop(*args)

    monkeypatch.setattr(rollout, "_sampled_loop", counted)
    for k in range(3):
        run = parts(20.0 - k, 3.0 + k, 0.5 + k, 10.0 * (1 + k), k1=1.0 + k, period=0.25, noise=(1e-5 * k, 1e-6))
        run = replace(run, clock=replace(TIGHT, period=vector(0.25 + 0.01 * k), t_end=vector(30.0 - k)))
        fly(run, k, k)
    assert len(traced) <= 1  # 0 if another test has compiled it


def test_control_periods_computed_one_by_one_give_the_run():
    observer = nonlinear.NonlinearObserver(integrator_chain.chain(2), vector([10.0]), vector(1e-3), vector(0.0))
    run = chain_parts([1.0, 0.2], delta=0.5, period=0.5, noise=[2e-5, 1e-6], observer=observer)
    log = fly(run, 1, 2).log
    ticks = run.clock.ticks(run.controller.t_f, run.controller.delta)
    start = jnp.asarray(log.x[0])
    vehicle, state = control_period.start(run, ticks, start, np.uint32(1), np.uint32(2))

    @jax.jit
    def step(state, tick):
        after, record = control_period.control_period(vehicle, state, tick)
        return after, record.decision.u

    for k in range(ticks.t.size):
        state, command = step(state, jax.tree.map(lambda rows, k=k: rows[k], control_period.schedule(ticks)))
        if ticks.t_next[k] > ticks.t[k]:
            times = np.where(log.has_length, log.t, np.inf)
            row = int(np.argmin(np.abs(times - ticks.t[k])))
            np.testing.assert_allclose(command, log.commanded[row], rtol=1e-9)
    np.testing.assert_allclose(state.x, log.x[-1], rtol=1e-10, atol=1e-12)


@pytest.mark.long
def test_simulate_without_jit_gives_the_same_result():
    run = parts(5.0, 3.0, 0.5, period=0.5, noise=(2e-5, 1e-6), t_end=6.0)
    with jax.disable_jit():
        plain = rollout.simulate(run, np.uint32(1), np.uint32(2))
    compiled = fly(run, 1, 2)
    for name, value in plain.metrics.items():
        np.testing.assert_allclose(value, compiled.metrics[name], rtol=1e-10, err_msg=name)


def test_observer_and_controller_use_the_design_model():
    heavier = rigid_body.spacecraft((10.5, 12.6, 14.7))
    run = at_20_hz(20.0, 3.0, 0.5)
    off = fly(replace(run, plant=heavier))
    assert int(off.status) == rollout.OK
    same = fly(replace(run, plant=rigid_body.spacecraft((10.0, 12.0, 14.0))))
    np.testing.assert_array_equal(same.metrics.window_error, fly(run).metrics.window_error)
    assert abs(float(off.metrics.window_error / same.metrics.window_error) - 1.0) > 0.05
    np.testing.assert_array_equal(run.observer.model.inertia, run.controller.model.inertia)


def test_a_t_f_beyond_the_samples_of_the_clock_gives_an_incomplete_run():
    """The clock `TIGHT` covers any delta, but not a t_f whose run ends after its last sample."""
    run = parts(20.0, 3.0, 0.5, period=0.25, noise=(2e-4, 1e-5))
    run = replace(run, clock=TIGHT)
    codes = {}
    for name, t_f, delta in (
        ("as made", 20.0, 0.5),
        ("shorter", 19.0, 0.25),
        ("longer", 22.0, 0.5),
        ("early hand-over", 20.0, 3.0),
    ):
        other = with_controller(run.with_t_f(vector(t_f)), delta=vector(delta))
        found = fly(other, 1, 4)
        codes[name] = (int(found.status), float(found.bad_time))
    assert codes["as made"][0] == codes["shorter"][0] == codes["early hand-over"][0] == rollout.OK
    assert codes["longer"] == (rollout.INCOMPLETE, 30.25)
    assert rollout.INCOMPLETE not in rollout.FINISHED


def test_a_t_f_beyond_the_grid_of_the_continuous_loop_is_refused():
    """Twice the t_f of the grid leaves too few steps near t_f. Earlier the window error was wrong by 66 %."""
    run = parts_of_reference_case(REFERENCE["cases"][0])
    codes = {t_f: int(fly(run.with_t_f(vector(t_f))).status) for t_f in (30.0, 45.0, 60.0, 90.0)}
    assert codes == {30.0: rollout.OK, 45.0: rollout.OK, 60.0: rollout.INCOMPLETE, 90.0: rollout.INCOMPLETE}
    assert float(with_gains(run, {"t_f": 45.0}).controller.t_f) == 45.0
    with pytest.raises(ValueError, match=r"t_f = 60 s with delta = 0\.05 s needs more than the 414 steps .* hand-over"):
        with_gains(run, {"t_f": 60.0})
    assert float(jax.jit(lambda eta: with_gains(run, {"eta": eta}).controller.eta)(3.5)) == 3.5


def test_a_single_run_is_compiled_with_optimisation_only_if_it_is_long(monkeypatch):
    monkeypatch.setattr(rollout, "simulate_once", once := object())
    run = parts(30.0, period=0.01, t_end=31.0)
    assert rollout.single_run_program(run) is once
    longer = replace(run, clock=clock.flight_clock(1e-3, 31.0))
    assert rollout.single_run_program(longer) is rollout.simulate_parts


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"actuators": Actuators(torque_limit=vector(1e-9))}, "actuators"),
        ({"walk_rate": vector([1e-3] * 3)}, "walk_rate"),
        ({"jitter": vector(0.1)}, "jitter"),
    ],
)
def test_a_continuous_loop_refuses_parts_that_it_would_ignore(changes, name):
    run = parts(20.0, 3.0, 2.0)
    with pytest.raises(TypeError, match=f"^the continuous loop cannot simulate {name}"):
        rollout.simulate_parts(replace(run, **changes))


def test_a_continuous_loop_refuses_a_law_of_the_sampled_loop():
    """An earlier version raised NotImplementedError without a message."""
    run = parts(20.0, 3.0, 2.0)
    law = PD(MultiplicativeKinematics(run.controller.model), vector(20.0), vector(2.0), vector(1.0), vector(2.0))
    with pytest.raises(TypeError, match=r"^the law PD needs the sampled loop"):
        rollout.simulate_parts(replace(run, controller=law))
    # implicit sampling, which the continuous loop ignored earlier
    with pytest.raises(TypeError, match=r"^the law PrescribedTime needs the sampled loop"):
        rollout.simulate_parts(replace(run, controller=replace(run.controller, implicit=True)))
