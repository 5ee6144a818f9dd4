"""Random scenarios from all tables: equal results by all ways to run them, and gradients equal to finite differences.

Tables and keys are chosen at random. A table or key that contradicts the others is removed again.
"""

import random
import re
from functools import partial

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
import pytest
from polars.testing import assert_frame_equal

import ptsmc_jax as ptsmc
from ptsmc_jax import scenario
from ptsmc_jax.campaigns import montecarlo
from ptsmc_jax.onboard.library import InTheLoop, Library
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.layouts import SCENARIOS
from ptsmc_jax.simulation import rollout
from tests.scenario.test_schema import BUILT_IN
from tuning.search.gains import gains_of, with_gains

SEED, TRIALS = 7, 3
# relative difference between two ways to run a scenario: rounding, which a thin boundary layer amplifies
close = partial(np.testing.assert_allclose, rtol=1e-6, atol=1e-12)
METRICS = ("window_error", "terminal_error", "peak_torque", "effort")  # metrics of all plants


def drawn(seed):
    """Return a random scenario with a sampled loop.

    Each required table of `BUILT_IN` has a random kind, and so do some optional tables. [hardware] and [dispersion]
    have random keys.
    """
    chance = random.Random(seed)
    kind = chance.choice(["spacecraft", "spacecraft", "spacecraft", "chain"])
    tables = {}
    for name, some in BUILT_IN:
        if some.get("plant", {}).get("kind", "spacecraft") == kind:
            tables.setdefault(name, []).append(some[name])
    required = {field.name for field in msgspec.structs.fields(SCENARIOS[kind]) if field.required}
    chosen = {}
    for name, ones in tables.items():
        if name in ("hardware", "dispersion"):
            keys = {key: value for table in chance.sample(ones, len(ones)) for key, value in table.items()}
            chosen[name] = {key: value for key, value in keys.items() if chance.random() < 0.4}
        elif name not in ("loop", "requirements", "tune") and (name in required or chance.random() < 0.4):
            chosen[name] = dict(chance.choice(ones))
    chosen["controller"]["t_f"] = chance.uniform(6.0, 12.0)
    loop = {"mode": "sampled", "clock": "flight", "period": chance.choice([0.05, 0.1, 0.17])}
    return accepted({**chosen, "loop": {**loop, "t_end": chosen["controller"]["t_f"] + 2.5}})


def accepted(tables):
    """Return the scenario of random tables, after removing each key or table that causes a configuration error."""
    while said := refusal(lambda: scenario.study(scenario.from_tables(tables))):
        table, key = re.findall(r"\w+", said)[:2]
        del (tables[table] if key in tables[table] else tables)[key if key in tables[table] else table]
    return scenario.from_tables(tables)


def refusal(call):
    """Return the text of the configuration error that this call raises, empty if there is none."""
    try:
        call()
    except ScenarioError as error:
        return str(error)
    return ""


@pytest.mark.long
@pytest.mark.parametrize("seed", range(12))
def test_a_random_scenario_gives_equal_results_by_all_ways_to_run(seed, tmp_path):
    """The results agree in a batch, alone, from the written file, from the run table, and with the exported C."""
    known = drawn(seed)
    ready = scenario.study(known)
    rows = ptsmc.trials(known, TRIALS, seed=SEED)
    ptsmc.write(known, tmp_path / "drawn.toml")
    again = scenario.study(ptsmc.read(tmp_path / "drawn.toml")).parts
    assert jax.tree.structure(again) == jax.tree.structure(ready.parts)
    for one, other in zip(jax.tree.leaves(again), jax.tree.leaves(ready.parts), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-14)
    alone = ptsmc.simulate(known, seed=SEED, trial=1).metrics
    for name in METRICS:
        close(np.float64(alone[name]), np.float64(rows[name][1]), err_msg=name)
    if ready.drawn:
        from_table = ptsmc.trials(known, rows, seed=SEED).select(rows.columns)
        assert_frame_equal(from_table, rows, rel_tol=1e-6, abs_tol=1e-12)
    if said := refusal(lambda: ptsmc.export(known, tmp_path / "controller")):
        assert re.search("the C does not know of|test vectors need", said)  # failed wheels or diverged
        return
    alike = rows["status"].is_in(montecarlo.FINISHED).to_numpy()
    if "peak_rate" in rows:  # a rotation of a radian per period amplifies rounding
        alike &= rows["peak_rate"].fill_null(np.inf).to_numpy() * known.loop.period < 1.0
    software = InTheLoop(Library(tmp_path / "controller"), ready.parts).software
    simulated = montecarlo.run(ready.parts, ready.dispersion, SEED, np.arange(TRIALS), software=software)
    for name in METRICS:
        by_c = np.asarray(getattr(simulated.metrics, name))
        close(by_c[alike], rows[name].to_numpy()[alike], err_msg=name)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(100, 108))
def test_gradients_of_a_random_scenario_match_finite_differences(seed):
    """The derivative along all gains at once agrees with differences of order 4, to 1e-4 for at least one step size.

    On the flight clock, t_f and delta have a kink at each sample, and a quantised torque has no derivative.
    """
    known = drawn(seed)
    if known.hardware is not None and known.hardware.torque_step is not None:
        known = scenario.replace(known, hardware__torque_step=None)
    parts = scenario.study(known).parts
    gains = {name: v for name, v in gains_of(parts).items() if name not in ("t_f", "delta")}
    along = np.random.default_rng(seed).normal(size=len(gains))

    def fly(x):
        moved = {name: v * (1.0 + x * by) for (name, v), by in zip(gains.items(), along, strict=True)}
        metrics = rollout.simulate(with_gains(parts, moved), np.uint32(SEED), np.uint32(0)).metrics
        return jnp.stack([getattr(metrics, name) for name in METRICS])

    slope = np.asarray(jax.jit(lambda x: jax.jvp(fly, (x,), (1.0,))[1])(0.0))
    value = jax.jit(fly)
    steps = (1e-4, 1e-5, 1e-6, 1e-7)
    numeric = [np.asarray(value(-2 * h) - 8 * value(-h) + 8 * value(h) - value(2 * h)) / (12 * h) for h in steps]
    off = np.abs(np.stack(numeric) - slope).min(axis=0)
    assert np.all(np.isfinite(slope))
    np.testing.assert_array_less(off, 1e-4 * np.abs(slope) + 1e-9 * np.abs(value(0.0)) + 1e-15)
