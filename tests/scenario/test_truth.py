"""A system of one's own that flies while law and observer know another one."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from ptsmc_jax import scenario
from ptsmc_jax.plants import system
from ptsmc_jax.scenario import own, systems
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.simulation import rollout

FILE = """
import jax.numpy as jnp
from ptsmc_jax.plants import system

known = system(1, lambda t, a, b: b, lambda t, a, b: 0.0 * a, lambda t, a, b: jnp.eye(1))
true = system(1, lambda t, a, b: b, lambda t, a, b: -0.5 * a - 0.3 * b, lambda t, a, b: 1.2 * jnp.eye(1))
two = system(2, lambda t, a, b: b, lambda t, a, b: 0.0 * a, lambda t, a, b: jnp.eye(2))
number = 3
"""
PERIOD = 0.1
TABLES = {
    "plant": {"kind": "system", "system": "my.py:known", "truth": "my.py:true", "x0": [1.0, -0.2]},
    "controller": {"kind": "pd", "k_p": 2.0, "k_d": 1.5, "t_f": 5.0},
    "loop": {"mode": "sampled", "period": PERIOD, "t_end": 6.5, "clock": "flight"},
}


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    """An empty folder with the systems in my.py, and a process that has run nothing yet."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(systems, "_ran", {})
    (tmp_path / "my.py").write_text(FILE)
    return tmp_path


def test_the_truth_flies_under_a_law_that_knows_the_model():
    """u = -2 x_1 - 1.5 x_2 held, the truth's motion by the matrix exponential.

    RK4 leaves h^5 / 120 = 8e-8 of its fifth derivative a period, of the order 1, which the loop forgets within ten.
    """
    parts = scenario.study(scenario.from_tables(TABLES)).parts
    log = rollout.simulate_jit(parts, record=True).log
    kept = np.asarray(log.has_length)
    x, u = np.asarray(log.x)[kept], np.asarray(log.u)[kept]
    block = expm(PERIOD * np.array([[0.0, 1.0, 0.0], [-0.5, -0.3, 1.2], [0.0, 0.0, 0.0]]))
    state = np.array([1.0, -0.2])
    for k in range(60):
        np.testing.assert_allclose(x[k], state, rtol=0.0, atol=2e-6)
        held = -2.0 * state[0] - 1.5 * state[1]
        np.testing.assert_allclose(u[k, 0], held, rtol=0.0, atol=1e-5)
        state = block[:2, :2] @ state + block[:2, 2] * held


def test_the_observer_sees_what_the_model_leaves_out():
    """At rest off the origin the truth pulls by -0.5 x_1: what an observer that knows 1/s^2 takes for a disturbance."""
    tables = {**TABLES, "observer": {"kind": "nonlinear", "gain": [5.0]}}
    log = rollout.simulate_jit(scenario.study(scenario.from_tables(tables)).parts, record=True).log
    kept = np.asarray(log.has_length)
    x, u, seen = (np.asarray(v)[kept] for v in (log.x, log.u, log.d_hat))
    left_out = -0.5 * x[:, 0] - 0.3 * x[:, 1] + 0.2 * u[:, 0]
    # the estimate follows at 5 1/s what changes at about 1 1/s: a fifth of its rate, and a period, behind
    late = slice(10, -2)
    assert np.abs(seen[late, 0] - left_out[late]).max() < 0.5 * np.abs(left_out).max()
    assert np.corrcoef(seen[late, 0], left_out[late])[0, 1] > 0.9


def test_the_same_system_as_truth_changes_nothing():
    same = {**TABLES, "plant": {**TABLES["plant"], "truth": "my.py:known"}}
    none = {**TABLES, "plant": {key: value for key, value in TABLES["plant"].items() if key != "truth"}}
    both = [rollout.simulate_jit(scenario.study(scenario.from_tables(t)).parts, record=True).log for t in (same, none)]
    np.testing.assert_array_equal(both[0].x, both[1].x)
    made = system(1, lambda t, a, b: b, lambda t, a, b: -0.5 * a - 0.3 * b, lambda t, a, b: 1.2 * jnp.eye(1))
    from_python = {**TABLES, "plant": {**TABLES["plant"], "truth": made}}
    found = [rollout.simulate_jit(scenario.study(scenario.from_tables(t)).parts) for t in (from_python, TABLES)]
    assert float(found[0].metrics.window_error) == float(found[1].metrics.window_error)


@pytest.mark.parametrize("kind", ["terminal", "time_base_pd", "predefined_time"])
def test_laws_to_compare_with_fly_a_system_by_its_scenario(kind):
    """How fast a system is along its run is asked of the paper's way, whatever law flies."""
    tables = {**TABLES, "controller": {"kind": kind, "t_f": 5.0}}
    run = rollout.simulate_jit(scenario.study(scenario.from_tables(tables)).parts)
    assert int(run.status) in rollout.FINISHED


def test_a_truth_is_a_program_too():
    loaded = scenario.from_tables(TABLES)
    assert set(own.programs(loaded)) == {"plant.system", "plant.truth"}
    assert set(own.digests(loaded)) == {"system_sha256", "truth_sha256"}


@pytest.mark.parametrize(
    ("truth", "said"),
    [
        ("my.py", 'plant.truth is "my.py": it names nothing'),
        ("my.py:gone", "plant.truth is"),
        ("my.py:number", "my.py has a int of that name"),
        ("gone.py:true", "the file gone.py is not there"),
        ("my.py:two", "a list of 4 numbers, since plant.truth has n = 2"),
        (3, "plant.truth is 3"),
    ],
)
def test_what_is_no_truth_is_refused(truth, said):
    with pytest.raises(ScenarioError) as caught:
        scenario.study(scenario.from_tables({**TABLES, "plant": {**TABLES["plant"], "truth": truth}}))
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
