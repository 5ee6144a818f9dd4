"""Custom systems with law (29): the spacecraft and a two-link arm as systems, singular runs, and files."""

import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.campaigns import store
from ptsmc_jax.laws.kinematics import SecondOrderKinematics
from ptsmc_jax.laws.prescribed_time import PrescribedTime
from ptsmc_jax.numerics import attitude
from ptsmc_jax.observers.base import NoObserver
from ptsmc_jax.plants import second_order
from ptsmc_jax.plants.rigid_body import AttitudeState
from ptsmc_jax.scenario import parsing, systems
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.signals import references
from ptsmc_jax.simulation import rollout
from ptsmc_jax.theory import envelopes, solutions
from tests.helpers import FULL_INERTIA, ROOT, commanded, errors_along, finer, fly, parts, refuses, short, vector
from tuning.studies import posing

ARM = str(ROOT / "scenarios" / "two_link_arm.py") + ":arm"
SPIN = references.Spin(vector(0.1, -0.2, 0.1, np.sqrt(1 - 0.06)), vector(0.02, -0.05, 0.03))


def spacecraft_as_system(reference, inertia=FULL_INERTIA):
    """Return a spacecraft as a system x_1' = F, x_2' = H + G u + D d.

    x_1 is the error eps_1 (3,) to the reference, x_2 the body rate (3,).
    """
    tensor = vector(inertia)
    inverse = jnp.linalg.inv(tensor)

    def F(t, x_1, x_2):  # noqa: N802
        v_f = reference(t).q[:3]
        v_f_dot = jax.jvp(lambda t: reference(t).q[:3], (t,), (jnp.ones_like(t),))[1]
        v = x_1 + v_f
        return 0.5 * attitude.t_matrix(jnp.append(v, jnp.sqrt(1.0 - v @ v))) @ x_2 - v_f_dot

    def H(t, x_1, x_2):  # noqa: N802
        return -inverse @ jnp.cross(x_2, tensor @ x_2)

    def G(t, x_1, x_2):  # noqa: N802
        return inverse

    return second_order.system(3, F, H, G, D=G, inertia=inertia)


def as_system(run, reference):
    """Return the parts of the same run with the spacecraft written as a system: K1 of (29) is half of K1 of (60)."""
    model, law = spacecraft_as_system(reference), run.controller
    error, _ = law.kinematics.errors(run.initial, reference(vector(0.0)))
    return replace(
        run,
        plant=model,
        controller=PrescribedTime(
            SecondOrderKinematics(model), law.t_f, law.eta, law.delta, law.k1 / 2, law.sign_width, law.surface_rate
        ),
        observer=replace(run.observer, model=model),
        reference=references.CurrentTime(),
        initial=jnp.concatenate([error, run.initial.w]),
    )


torque = jax.jit(commanded)


@jax.jit
def system_terms(model, t, x, u):
    """Return dF/dx_2, acceleration without force, mass matrix and generalised force of a system.

    x: the state (x_1, x_2). u: input.
    """
    force = model.generalised_force(t, x, u)
    return model.rate_jacobian(t, x), model.coasting_acceleration(t, x), model.mass(t, x), force


@pytest.mark.parametrize("hold", [False, True])
@pytest.mark.parametrize("seed", short(range(4), [0]))
def test_law_and_jacobians_of_a_system_match_those_derived_by_hand(seed, hold):
    """The law of the system gives the torque and the sliding variable of the law for a spacecraft."""
    rng = np.random.default_rng(seed)
    run = parts(20.0, 3.5, 0.5, inertia=FULL_INERTIA, reference=SPIN, k1=1.7, sign_width=0.1, surface_rate=1.3)
    own = as_system(run, SPIN)
    q = rng.normal(size=4)
    q[3] = abs(q[3]) + 0.5
    x, t = AttitudeState(vector(q / np.linalg.norm(q)), vector(0.1 * rng.normal(size=3))), vector(4.0)
    d_hat, k2, phase = vector(0.1, 0.1, -0.2), vector(0.05), jnp.asarray(hold)
    u, s = torque(run.controller, t, phase, x, SPIN(t), d_hat, k2)
    state = jnp.concatenate([x.q[:3] - SPIN(t).q[:3], x.w])
    found, surface = torque(own.controller, t, phase, state, t, d_hat, k2)
    np.testing.assert_allclose(surface, s, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found, u, rtol=0, atol=1e-11)  # terms of some 10 N m
    # by hand: dF/dx2 = T / 2, and x_1'' without acceleration is -|w|^2 v / 4 - q_1f'' (58)
    slope, coasting, mass, force = system_terms(own.plant, t, state, u)
    np.testing.assert_allclose(slope, 0.5 * attitude.t_matrix(x.q), rtol=0, atol=1e-15)
    by_hand = -0.25 * (x.w @ x.w) * x.q[:3] - jax.jit(lambda t: attitude.vector_rates(*SPIN(t))[1])(t)
    np.testing.assert_allclose(coasting, by_hand, rtol=0, atol=1e-15)
    np.testing.assert_allclose(mass, FULL_INERTIA, rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(force, run.plant.generalised_force(t, x, u), rtol=0, atol=1e-13)


GAINS = {"eta": 3.0, "delta": 0.05, "k1": 1.0, "surface_rate": 1.0, "sign_width": 1e-3}


def arm_tables(**changes):
    """Return the tables of a scenario of a two-link arm; changes: {table: changed keys}."""
    tables = {
        "plant": {"kind": "system", "system": ARM, "x0": [0.8, -1.0, 0.5, 0.2]},
        "controller": {"t_f": 3.0, **GAINS, "disturbance_rate_bound": 0.6, "disturbance_bound": 0.45},
        "observer": {"kind": "nonlinear", "gain": [10.0, 10.0]},
        "disturbance": {"kind": "sinusoid", "amplitude": [0.4, 0.05], "frequency": [1.0, 3.0]},
        "loop": {"t_end": 4.0, "window": 0.5},
    }
    return {name: {**table, **changes.get(name, {})} for name, table in tables.items()}


@pytest.mark.parametrize("mode", short(["continuous", "sampled"], ["sampled"]))
def test_error_of_the_two_link_arm_stays_below_its_bound(mode):
    ready = scenario.study(scenario.from_tables(arm_tables(loop={"mode": mode, "period": 0.002})))
    result = fly(ready.parts)
    assert result.status == rollout.OK
    before = result.log.t < 2.949
    size = np.linalg.norm(result.log.error[before], axis=1)
    limit = envelopes.error_bound(ready.parts, result.log.t[before])
    slack = 0.0 if mode == "continuous" else 1e-3  # torques change by about 10 N m/s and are held for a period
    assert np.all(size <= limit * (1 + 1e-9) + slack)
    assert result.metrics.window_error < 5e-3


def test_coriolis_forces_of_the_arm_match_the_lagrangian():
    """Lagrange's equation C q' = M' q' - d(q' M q' / 2)/dq holds, by automatic differentiation of the mass matrix."""
    ready = scenario.study(scenario.from_tables(arm_tables()))
    arm: Any = ready.parts.plant
    rng = np.random.default_rng(3)
    mass, load = (arm.H.func.__globals__[name] for name in ("mass", "load"))  # the file's own functions
    for _ in range(5):
        q, rate = vector(rng.normal(size=2)), vector(rng.normal(size=2))

        def lagrangian_force(q, rate=rate):
            return 0.5 * rate @ mass(q) @ rate

        # C q' = M' q' - d(q' M q'/2)/dq; the rest of `load`, its value at rest, is gravity
        m_dot = jax.jvp(mass, (q,), (rate,))[1]
        coriolis = m_dot @ rate - jax.grad(lagrangian_force)(q)
        np.testing.assert_allclose(load(q, rate) - load(q, 0 * rate), coriolis, rtol=0, atol=1e-14)


@pytest.mark.parametrize("mode", short(["continuous", "sampled"], ["sampled"]))
def test_a_run_that_meets_a_singular_input_gain_is_marked_with_the_time(mode):
    """The input gain x_1 - 0.2, alone or off the diagonal of a matrix, is singular on the way of x_1 from 0.5 to 0."""

    def F(t, x_1, x_2):  # noqa: N802
        return x_2

    def H(t, x_1, x_2):  # noqa: N802
        return jnp.zeros(1)

    def G(t, x_1, x_2):  # noqa: N802
        return jnp.reshape(x_1 - 0.2, (1, 1))

    def swapped(t, x_1, x_2):
        return jnp.stack([jnp.stack([0 * x_1[0], x_1[0] - 0.2]), jnp.stack([1.0 + 0 * x_1[0], 0 * x_1[0]])])

    one = second_order.system(1, F, H, G)
    two = second_order.system(2, lambda t, a, b: b, lambda t, a, b: 0 * a, swapped)
    t = np.linspace(0.0, 4.9, 4000)  # exact solution 1 gives the time of x_1 = 0.2
    x = errors_along(t, vector(5.0), vector(3.0), vector([0.5]), vector([0.0])).error[:, 0]
    model, x0 = (one, [0.5, 0.0]) if mode == "continuous" else (two, [0.5, 0.3, 0.0, 0.0])
    run = study(model, x0, controller={"disturbance_bound": 0.0}, loop={"mode": mode, "period": 0.05}).parts
    result = fly(run)
    assert result.status == rollout.SINGULAR
    assert result.bad_time == pytest.approx(t[np.argmax(x < 0.2)], abs=0.06)


def no_linear_rate(t, x_1, x_2):
    """Return x_1' (m,) of a system that is not linear in x_2."""
    return jnp.sinh(x_2) - 0.1 * jnp.sin(t) + 0.2 * x_1[::-1]


CURVED = second_order.system(2, no_linear_rate, lambda t, a, b: -b, lambda t, a, b: jnp.eye(2) + 0.1 * jnp.outer(a, a))
AT_FIRST = (0.4, -0.2, 0.3, 0.1)


def test_newton_finds_x_2_of_a_nonlinear_rate():
    """The law then commands the input of the exact motion."""
    law = PrescribedTime(SecondOrderKinematics(CURVED), *(vector(v) for v in (5.0, 3.0, 0.1, 1.0, 1e-3, 1.0)))
    start, none_known = vector(AT_FIRST), jnp.zeros(2)
    begun = law.kinematics.errors(start, vector(0.0))

    @jax.jit
    @jax.vmap
    def looked_at(t):
        def exact(t):
            return solutions.exact_error(t, law.t_f, law.eta, *begun).error_rate

        error, rate = solutions.exact_error(t, law.t_f, law.eta, *begun).error, exact(t)
        acceleration = jax.jvp(exact, (t,), (jnp.ones_like(t),))[1]
        motion = solutions.plant_motion(law.kinematics, t, start, (error, rate, acceleration))
        u, _ = torque(law, t, jnp.asarray(False), motion.x, t, none_known, vector(0.0))
        return motion.x, error, rate, CURVED.input_for(t, motion.x, motion.w_dot, none_known), u

    t = np.linspace(0.0, 4.8, 25)
    x, error, rate, exact, u = (np.asarray(v) for v in looked_at(vector(t)))
    np.testing.assert_array_equal(x[:, :2], error)
    found = np.sinh(x[:, 2:]) - 0.1 * np.sin(t)[:, None] + 0.2 * x[:, 1::-1]
    np.testing.assert_allclose(found, rate, rtol=0, atol=1e-14)
    np.testing.assert_allclose(u, exact, rtol=0, atol=1e-12)  # rounding times gains of up to 225


def test_an_invalid_system_is_refused_in_one_sentence():
    """Wrong shapes, sizes, inertias and number types, errors of its functions and missing derivatives are refused."""

    def F(t, x_1, x_2):  # noqa: N802
        return x_2

    def G(t, x_1, x_2):  # noqa: N802
        return jnp.eye(2)

    with pytest.raises(ValueError, match=r"G\(t, x_1, x_2\) returns \(2, 2\), but for n = 3 must return an array"):
        second_order.system(3, F, F, G)
    with pytest.raises(ValueError, match=r"H\(t, x_1, x_2\) fails for x_1 and x_2 of shape \(2,\)"):
        second_order.system(2, F, lambda t, x: x, G)
    with pytest.raises(ValueError, match=r"^H\(t, x_1, x_2\) fails .*: IndexError: index 2 is out of bounds [^\n]*$"):
        second_order.system(2, F, lambda t, a, b: -a * b[2], G)  # JAX clamps the index to b[1]
    second_order.system(2, F, lambda t, a, b: -a * b[jnp.argmax(a)] - b[jnp.array([1, 0])], G)
    with pytest.raises(ValueError, match="n is 0"):
        second_order.system(0, F, F, G)
    for size in (1.0, 1e-9):  # also for small numbers
        with pytest.raises(ValueError, match="inertia must be a symmetric, positive definite"):
            second_order.system(2, F, F, G, inertia=size * np.array([[1.0, 5.0], [0.0, 1.0]]))
    with pytest.raises(ValueError, match="inertia must be a symmetric, positive definite"):
        second_order.system(2, F, F, G, inertia=-np.eye(2))
    with pytest.raises(ValueError, match=r"^F\(t, x_1, x_2\) fails .*TracerBoolConversionError: [^\n]*$"):
        second_order.system(2, lambda t, a, b: b if a[0] > 0 else -b, F, G)
    with pytest.raises(ValueError, match=r"traced array [^\n]*; use jax\.numpy\.where instead of if"):
        second_order.system(2, lambda t, a, b: float(t) * b, F, G)
    with pytest.raises(ValueError, match="n is True"):
        second_order.system(True, F, F, lambda t, a, b: jnp.eye(1))
    for kind, other in (("int", int), ("float", jnp.float16), ("complex", complex)):
        with pytest.raises(ValueError, match=rf"^F\(t, x_1, x_2\) returns {kind}\d+ numbers, but must return"):
            second_order.system(2, lambda t, a, b, other=other: b.astype(other), F, G)
    second_order.system(2, F, lambda t, a, b: jnp.zeros(2, int), lambda t, a, b: np.eye(2, dtype=int))
    with pytest.raises(ValueError, match=r"^H\(t, x_1, x_2\) cannot be differentiated .*: Pure callbacks [^\n]*$"):
        second_order.system(2, F, lambda t, a, b: jax.pure_callback(np.negative, a, a), G)


@pytest.mark.parametrize(
    ("plant", "said"),
    [
        ({"kind": "system"}, "plant.system is absent"),
        ({"kind": "system", "system": 3.0}, "plant.system is 3"),
        ({"kind": "system", "system": "nowhere.py:arm", "x0": [1, 0]}, "the file nowhere.py does not exist"),
        ({"kind": "system", "system": ARM + "s"}, "has no such name"),
        ({"kind": "system", "system": ARM.replace(":arm", ":mass")}, "has a function of that name"),
        ({"kind": "system", "system": "numpy:pi"}, "has a float of that name"),
        ({"kind": "system", "system": "scipy.no_such_module:arm"}, "there is no module scipy.no_such_module"),
        ({"kind": "system", "system": "no_such_module:arm"}, "there is no module no_such_module"),
        (
            {"kind": "system", "system": ARM, "x0": [1, 2, 3]},
            "plant.x0 is [1.0, 2.0, 3.0], but must be a list of x_1 followed by x_2",
        ),
        ({"kind": "system", "system": ARM, "x0": [1]}, "plant.x0 is [1.0], but must be a list of x_1 followed by x_2"),
        ({"kind": "system", "system": ARM, "x0": [1, 2]}, "plant.x0 is [1.0, 2.0], but must be a list of 4 numbers"),
        ({"kind": "system", "system": ARM, "order": 2}, "plant.order is not a known key"),
    ],
)
def test_invalid_system_names_are_refused(plant, said):
    with refuses(ScenarioError, said):
        scenario.study(scenario.from_tables({"plant": plant}))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"observer": {"gain": [1.0]}}, "observer.gain is [1.0], but must be a list of 2 numbers, one for each input"),
        ({"disturbance": {"phase": [1.0]}}, "disturbance.phase is [1.0], but must be a list of 2 numbers"),
        ({"controller": {"eta": 2.0}}, "controller.eta is 2.0, but must be a number greater than 2 (Theorem 2)"),
        ({"controller": {"a": [1.0]}}, "controller.a is not a known key"),
        ({"controller": {"error": "multiplicative"}}, "controller.error is not a known key"),
    ],
)
def test_invalid_keys_of_a_custom_system_are_refused(changes, said):
    with pytest.raises(ScenarioError, match="^" + re.escape(said)):
        scenario.from_tables(arm_tables(**changes))


def test_replace_and_repeated_reading_keep_the_same_custom_system(tmp_path: Path):
    """All runs with the same object share a compiled program."""
    made = one_coordinate()
    tables = {"plant": {"kind": "system", "system": made, "x0": [0.1, 0.0]}}
    changed = scenario.study(scenario.replace(scenario.from_tables(tables), controller__eta=4.0))
    assert changed.parts.plant is made
    assert isinstance(changed.parts.observer, NoObserver)
    (tmp_path / "my.py").write_text((ROOT / "scenarios" / "two_link_arm.py").read_text())
    (tmp_path / "my.toml").write_text('[plant]\nkind = "system"\nsystem = "my.py:arm"\nx0 = [1, 1, 0, 0]\n')
    first, other = (scenario.study(scenario.read(tmp_path / "my.toml")) for _ in range(2))
    assert first.parts.plant is other.parts.plant  # one compiled program for all runs
    assert first.parts.plant.inputs == 2


def study(system, x0, **tables):
    """Return the study of a custom system with this initial state; system: the object."""
    return scenario.study(scenario.from_tables({"plant": {"kind": "system", "system": system, "x0": x0}, **tables}))


def one_coordinate(F=lambda t, a, b: b, H=lambda t, a, b: 0 * a, G=lambda t, a, b: jnp.eye(1), D=None):
    """Return the custom system of one coordinate with these functions; see `second_order.system`."""
    return second_order.system(1, F, H, G, D)


FAST = [one_coordinate(H=lambda t, a, b: -60 * b), one_coordinate(H=lambda t, a, b: -2500 * a)]


@pytest.mark.parametrize("system", short(FAST, FAST[1:]))
def test_integration_steps_resolve_the_fast_modes_of_a_system(system):
    loop = {"loop": {"mode": "sampled", "period": 0.05}, "controller": {"delta": 0.3, "disturbance_bound": 0.0}}
    run = study(system, [1.0, 0.0], **loop).parts
    ours, finer_steps = fly(run), fly(replace(run, substeps=8 * run.substeps))
    for name in ("window_error", "peak_torque"):
        np.testing.assert_allclose(getattr(ours.metrics, name), getattr(finer_steps.metrics, name), rtol=1e-3)
    with pytest.raises(ScenarioError, match=r"^plant\.system is too fast.*would take more than 200 integration"):
        study(one_coordinate(H=lambda t, a, b: -1e4 * b), [1.0, 0.0], **loop)


@pytest.mark.parametrize("w", short([10.0, 20.0], [20.0]))
def test_integration_steps_resolve_a_system_that_depends_on_time(w):
    system = one_coordinate(F=lambda t, a, b: b - jnp.cos(w * t))
    tables = {"controller": {"t_f": 30.0, "disturbance_bound": 0.0}}
    run = study(system, [1.0, 0.0], **tables).parts
    ours, theirs = (rollout.simulate_parts(one).metrics for one in (run, finer(run, 4)))  # no history: many steps
    np.testing.assert_allclose(ours.window_error, theirs.window_error, rtol=0.02)


def test_sign_width_that_needs_too_many_steps_later_in_the_run_is_refused():
    """The gain D of the disturbance grows from 1 to 100. For D = 1, this sign width is allowed."""
    steep = {"controller": {"disturbance_bound": 1.0, "sign_width": 1e-2}}
    with pytest.raises(ScenarioError, match=r"^controller\.sign_width is 0\.01, but must be larger"):
        study(one_coordinate(D=lambda t, a, b: jnp.eye(1) * (1 + 99 * jnp.tanh(t))), [1.0, 0.0], **steep)


# inputs in different units, and a disturbance on one of two inputs
HALF = second_order.system(
    2,
    lambda t, a, b: b,
    lambda t, a, b: 0 * a,
    lambda t, a, b: jnp.array([[1e-4, 1.0], [0, 1]]),
    lambda t, a, b: jnp.diag(jnp.array([1.0, 0])),
)
BOTH = second_order.system(2, lambda t, a, b: b, lambda t, a, b: 0 * a, lambda t, a, b: jnp.eye(2) * (a[0] - 0.5))


@pytest.mark.parametrize(
    ("system", "x0", "mode", "singular"),
    [
        pytest.param(BOTH, [1.0, 0.2, 0.0, 0.0], "sampled", True, marks=pytest.mark.long),
        (one_coordinate(G=lambda t, a, b: jnp.reshape((a - 0.5) ** 2, (1, 1))), [1.0, 0.0], "continuous", True),
        (HALF, [1.0, 0.2, 0.0, 0.0], "continuous", False),
    ],
)
def test_singularity_of_a_system_is_relative_to_its_initial_state_in_any_units(system, x0, mode, singular):
    run = study(system, x0, controller={"disturbance_bound": 0.0}, loop={"mode": mode}).parts
    assert fly(run).status == (rollout.SINGULAR if singular else rollout.OK)


def test_a_custom_system_with_a_singular_matrix_at_the_start_is_refused():
    with pytest.raises(ScenarioError, match=r"^plant\.system has a singular dF/dx2 G at t = 0 in plant\.x0"):
        study(one_coordinate(G=lambda t, a, b: jnp.zeros((1, 1))), [1.0, 0.0])
    with pytest.raises(ScenarioError, match=r'singular D .*observer\.kind = "nonlinear" must invert; .*"none"$'):
        study(HALF, [1.0, 0.0, 0.0, 0.0], observer={"kind": "nonlinear"})


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"F": lambda t, a, b: b / t}, "F = [nan]"),
        ({"F": lambda t, a, b: jnp.cbrt(b)}, "dF/dx2 = [[inf]]"),
        ({"H": lambda t, a, b: jnp.log(-a)}, "H = [nan]"),
        ({"G": lambda t, a, b: jnp.eye(1) / b[0]}, "G = [[inf]]"),
        ({"D": lambda t, a, b: jnp.eye(1) / b[0]}, "D = [[inf]]"),
    ],
)
def test_a_custom_system_that_is_not_finite_at_the_start_is_refused_with_its_function(changes, said):
    with pytest.raises(ScenarioError, match=f"^{re.escape(f'plant.system has {said} at t = 0 in plant.x0; allowed')}"):
        study(one_coordinate(**changes), [1.0, 0.0])


def test_a_true_plant_whose_hidden_state_is_not_finite_at_the_start_is_refused():
    late = {"H": lambda t, a, b, z: 0 * a, "Z": lambda t, a, b, z, u: u / b, "z0": [0.0]}
    truth = second_order.system(1, lambda t, a, b: b, G=lambda t, a, b: jnp.eye(1), **late)
    tables = {"kind": "system", "system": one_coordinate(), "truth": truth, "x0": [1.0, 0.0]}
    with pytest.raises(ScenarioError, match=r"^plant\.truth has Z = \[nan\] at t = 0 in plant\.x0; allowed are finite"):
        scenario.study(scenario.from_tables({"plant": tables}))


FILES = {
    "future.py": "from __future__ import annotations\nfrom dataclasses import dataclass\n"
    "from pieces import F, H, G\nfrom ptsmc_jax.plants import system\n\n"
    "@dataclass\nclass Numbers:\n    mass: float = 1.0\n\nmine = system(1, F, H, G)\n",
    "pieces.py": "import jax.numpy as jnp\n\ndef F(t, a, b):\n    return b\n\ndef H(t, a, b):\n    return -a\n\n"
    "def G(t, a, b):\n    return jnp.eye(1)\n",
    "leaves.py": "import sys\nsys.exit(0)\n",
    "broken.py": "def (\n",
}


def test_custom_files_can_import_helpers_and_cannot_exit_the_command(tmp_path):
    """The checksum changes with the file. A system without a file has none."""
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    assert systems.load(f"{tmp_path}/future.py:mine").inputs == 1
    assert str(tmp_path) not in sys.path
    for name, said in (("leaves.py", "SystemExit: 0"), ("broken.py", "SyntaxError: ")):
        with pytest.raises(ValueError, match=rf"^running .*{name} fails: {said}[^\n]*$"):
            systems.load(f"{tmp_path}/{name}:mine")
    before = systems.checksum(f"{tmp_path}/future.py:mine")
    (tmp_path / "future.py").write_text(FILES["future.py"] + "# changed\n")
    assert systems.checksum(f"{tmp_path}/future.py:mine") != before
    assert systems.checksum(spacecraft_as_system(SPIN)) is None


def test_a_written_scenario_with_a_system_made_in_python_cannot_be_read(tmp_path):
    tables = {"plant": {"kind": "system", "system": spacecraft_as_system(SPIN), "x0": [0.1, 0.0, 0.0, 0.0, 0.0, 0.0]}}
    made = scenario.from_tables(tables)
    store.write_toml(tmp_path / "s.toml", parsing.dump(made))
    with pytest.raises(ScenarioError, match=r'^plant\.system is "<System made in Python>": it names nothing'):
        scenario.read(tmp_path / "s.toml")
    assert store.read_previous_summary(tmp_path, parsing.dump(made), {"command": "tune", "seed": 0}) is None


def test_integration_steps_suit_the_run_with_the_shortest_t_f_of_a_search(monkeypatch):
    tables = {
        "plant": {"kind": "system", "system": ARM, "x0": [0.8, -1.0, 0.0, 0.0]},
        "controller": {"t_f": 3.0, **GAINS},
        "loop": {"mode": "sampled", "period": 0.05, "t_end": 13.0},
        "tune": {"free": ["t_f", "eta"], "bounds": {"t_f": [0.5, 4.0]}},
    }
    looked_at, visited = [], solutions.visited_states

    def spied(parts):
        looked_at.append((float(parts.controller.t_f), float(parts.t_end)))
        return visited(parts)

    monkeypatch.setattr(solutions, "visited_states", spied)
    posing.set_up_tuning(scenario.from_tables(tables), 0)
    assert looked_at == [(0.5, 10.5)]
