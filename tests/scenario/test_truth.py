"""A custom system as the true plant, while law and observer use another system as the design model."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from ptsmc_jax import scenario
from ptsmc_jax.campaigns import montecarlo, runs
from ptsmc_jax.onboard import board
from ptsmc_jax.plants import system
from ptsmc_jax.scenario import custom
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.simulation import rollout
from ptsmc_jax.theory import linear, margins, solutions
from tests.helpers import refuses
from tuning.studies import stability

FILE = """
import jax.numpy as jnp
from ptsmc_jax.plants import system

known = system(1, lambda t, a, b: b, lambda t, a, b: 0.0 * a, lambda t, a, b: jnp.eye(1))
true = system(1, lambda t, a, b: b, lambda t, a, b: -0.5 * a - 0.3 * b, lambda t, a, b: 1.2 * jnp.eye(1))
two = system(2, lambda t, a, b: b, lambda t, a, b: 0.0 * a, lambda t, a, b: jnp.eye(2))
late = system(1, lambda t, a, b: b, lambda t, a, b, z: -0.5 * a + z, lambda t, a, b: jnp.zeros((1, 1)),
              Z=lambda t, a, b, z, u: (u - z) / 0.3, z0=[0.1])
"""
PERIOD = 0.1
TABLES = {
    "plant": {"kind": "system", "system": "my.py:known", "truth": "my.py:true", "x0": [1.0, -0.2]},
    "controller": {"kind": "pd", "k_p": 2.0, "k_d": 1.5, "t_f": 5.0},
    "loop": {"mode": "sampled", "period": PERIOD, "t_end": 6.5, "clock": "flight"},
}
FILES = {"my.py": FILE}
pytestmark = pytest.mark.usefixtures("here")


def test_the_true_plant_is_simulated_with_a_law_for_the_design_model():
    """The input u = -2 x_1 - 1.5 x_2 is held, and the true motion follows from the matrix exponential.

    The error of RK4 per period is h^5 / 120 = 8e-8 times the fifth derivative, which is about 1. It decays within ten
    periods.
    """
    parts = scenario.study(scenario.from_tables(TABLES)).parts
    log = rollout.simulate_parts(parts, record=True).log
    kept = np.asarray(log.has_length)
    x, u = np.asarray(log.x)[kept], np.asarray(log.u)[kept]
    block = expm(PERIOD * np.array([[0.0, 1.0, 0.0], [-0.5, -0.3, 1.2], [0.0, 0.0, 0.0]]))
    state = np.array([1.0, -0.2])
    for k in range(60):
        np.testing.assert_allclose(x[k], state, rtol=0.0, atol=2e-6)
        held = -2.0 * state[0] - 1.5 * state[1]
        np.testing.assert_allclose(u[k, 0], held, rtol=0.0, atol=1e-5)
        state = block[:2, :2] @ state + block[:2, 2] * held


HIDDEN = {**TABLES, "plant": {**TABLES["plant"], "truth": "my.py:late"}}


def test_a_true_plant_with_a_hidden_state_matches_the_matrix_exponential():
    """An input with a lag, z' = (u - z) / 0.3 s: all three states follow from the matrix exponential.

    The history has the hidden state, and the poles of the linearised loop are those of the closed form. With one step
    per period, RK4 would have a relative error of (h / 0.3)^5 / 120 = 3e-5 in z. The steps that follow from the rate of
    z have an error below a millionth.
    """
    ready = scenario.study(scenario.from_tables({**HIDDEN, "hardware": {"state_noise": [0.0, 0.0]}}))
    parts = ready.parts
    assert parts.substeps > 1
    run = runs.simulate(ready, 0)
    x, u = np.asarray(run.log.x), np.asarray(run.log.u)
    motion = np.array([[0.0, 1.0, 0.0, 0.0], [-0.5, 0.0, 1.0, 0.0], [0.0, 0.0, -1 / 0.3, 1 / 0.3], [0.0] * 4])
    block, state = expm(PERIOD * motion), np.array([1.0, -0.2, 0.1])
    for k in range(60):
        np.testing.assert_allclose(x[k], state, rtol=0.0, atol=1e-6)
        held = -2.0 * state[0] - 1.5 * state[1]
        np.testing.assert_allclose(u[k, 0], held, rtol=0.0, atol=1e-5)
        state = block[:3, :3] @ state + block[:3, 3] * held
    told = run.columns()
    np.testing.assert_array_equal(told["z1"], x[:, 2])
    assert [name for name in told if name[0] == "x"] == ["x1", "x2"]
    course = linear.simulate_nominal_jit(parts)
    last = np.flatnonzero(linear.is_full(jax.tree.map(np.asarray, course.period.now), PERIOD))[-1:]
    loop = jax.tree.map(lambda v: np.asarray(v)[0], linear.open_loops(parts, course, last))  # with z
    poles = np.abs(np.linalg.eigvals(linear.open_at_input(loop, 0.0, np).closed()))
    closed = block[:3, :3] + np.outer(block[:3, 3], [-2.0, -1.5, 0.0])
    slowest = poles[
        np.abs(poles - 1.0) > margins.CIRCLE_TOLERANCE
    ].max()  # without an observer, the memory has a pole at 1
    np.testing.assert_allclose(slowest, np.abs(np.linalg.eigvals(closed)).max(), rtol=1e-5)


def test_dispersions_and_rows_contain_only_visible_states():
    """Dispersions, rows and run tables contain the visible initial state only; z begins at z0."""
    drawn = {"x0": {"kind": "uniform", "half_width": [0.1, 0.0]}}
    ready = scenario.study(scenario.from_tables({**HIDDEN, "dispersion": drawn}))
    simulated = montecarlo.run(ready.parts, ready.dispersion, 0, np.arange(3))
    assert [name for name in simulated.drawn if name.startswith("initial_x")] == ["initial_x1", "initial_x2"]
    by_hand = replace(ready.parts, initial=jnp.array([simulated.drawn["initial_x1"][2], -0.2, 0.1]))
    again = rollout.simulate_parts(by_hand, 0, 2).metrics
    np.testing.assert_allclose(simulated.metrics.window_error[2], again.window_error, rtol=1e-12)


def test_exact_motion_names_and_exported_code_ignore_hidden_states():
    """The input along the exact motion uses the design model, and exported C reads visible states only."""
    law = {"t_f": 5.0, "delta": 1.0}
    parts, known = (
        scenario.study(scenario.from_tables({**tables, "controller": law})).parts
        for tables in (HIDDEN, {**TABLES, "plant": {**TABLES["plant"], "truth": "my.py:known"}})
    )
    for t in (0.0, 2.0):
        planned, expected = (solutions.exact_input(one, jnp.asarray(t))[0] for one in (parts, known))
        np.testing.assert_allclose(planned, expected, rtol=1e-12)
    ready = scenario.study(scenario.from_tables({**HIDDEN, "controller": law}))
    assert stability.signal_names(ready)[1] == ["x1", "x2"]
    assert board.build_board(parts).inputs["x"].shape == (2,)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"Z": None}, "Z and z0 go together"),
        ({"z0": []}, "Z and z0 go together"),
        ({"z0": "no"}, "z0 is no, but must be a list of finite numbers"),
        ({"Z": lambda t, a, b, z, u: 0.0}, "Z(t, x_1, x_2, z, u) returns (), but for n = 1 must return an array (2,)"),
        ({"H": lambda t, a, b: a}, "H(t, x_1, x_2, z) fails"),
    ],
)
def test_invalid_hidden_states_are_refused(changes, said):
    good = {"H": lambda t, a, b, z: z[:1], "Z": lambda t, a, b, z, u: -z, "z0": [0.0, 1.0]}
    with refuses(ValueError, said):
        system(1, lambda t, a, b: b, G=lambda t, a, b: jnp.eye(1), **{**good, **changes})


@pytest.mark.parametrize("kind", ["terminal", "time_base_pd", "predefined_time"])
def test_comparison_laws_control_a_custom_system(kind):
    """The rates of a system come from the motion under the published law, for every law."""
    tables = {**TABLES, "controller": {"kind": kind, "t_f": 5.0}}
    run = rollout.simulate_parts(scenario.study(scenario.from_tables(tables)).parts)
    assert int(run.status) in rollout.FINISHED


def test_a_custom_true_plant_is_reported_as_custom_code():
    loaded = scenario.from_tables(TABLES)
    assert set(custom.code_by_key(loaded)) == {"plant.system", "plant.truth"}
    assert set(custom.checksums(loaded)) == {"system_sha256", "truth_sha256"}


@pytest.mark.parametrize(
    ("truth", "said"),
    [
        ("my.py", 'plant.truth is "my.py": it names nothing'),  # test_systems.py has every name that is refused
        ("my.py:two", 'plant.truth is "my.py:two", which has n = 2; allowed is n = 1, as plant.system'),
        (3, "plant.truth is 3"),
    ],
)
def test_an_invalid_true_plant_is_refused(truth, said):
    with refuses(ScenarioError, said):
        scenario.study(scenario.from_tables({**TABLES, "plant": {**TABLES["plant"], "truth": truth}}))


def test_a_design_model_with_hidden_states_is_refused():
    with pytest.raises(ScenarioError, match=r'plant.system is "my.py:late", which has states that no law knows'):
        scenario.study(scenario.from_tables({**TABLES, "plant": {**TABLES["plant"], "system": "my.py:late"}}))
