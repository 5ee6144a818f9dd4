"""Custom sensors and dispersions: comparison with built-in parts and a loop computed by hand, and error messages."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
import pytest

import ptsmc_jax as ptsmc
from ptsmc_jax import explore, scenario
from ptsmc_jax.campaigns import margin_verdicts, store
from ptsmc_jax.devices.custom_sensors import CUSTOM_NOISE
from ptsmc_jax.devices.ticks import Ticks
from ptsmc_jax.dispersions.base import CUSTOM
from ptsmc_jax.numerics import draws
from ptsmc_jax.plants.rigid_body import AttitudeState
from ptsmc_jax.scenario import custom, parsing, reading, systems
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.simulation import rollout
from ptsmc_jax.theory import linear
from scenarios.own_parts import LateStarTracker
from tests.helpers import FIRST_FLIGHT, SHORT, refuses, ticks_of, vector
from tuning.search import gains
from tuning.studies import stability

FILE = """
import dataclasses

import jax.numpy as jnp
import ptsmc_jax as ptsmc


class Noisy(ptsmc.SampledSensor):
    '''Both states with white noise, the first one through a lag of one sample.'''

    draws = 2
    sigma: tuple = (1e-3, 2e-3)

    def begin(self, x):
        return x[:1]

    def see(self, memory, x, noise, t, dt):
        seen = x + self.sigma * noise
        return jnp.concatenate([memory, seen[1:]]), seen[:1]


class Smoothed(ptsmc.SampledSensor):
    '''Both states with white noise, through a filter of first order.'''

    draws = 2
    share: float = ptsmc.gain(0.5, (0.05, 1.0), below=1.0 + 1e-9)

    def begin(self, x):
        return x

    def see(self, memory, x, noise, t, dt):
        memory = memory + self.share * (x + 1e-2 * noise - memory)
        return memory, memory


class Drift(ptsmc.Draw):
    '''A disturbance that is larger or smaller, and a start that goes with it.'''

    count = 2
    std: float = 0.1

    def at(self, c, parts):
        wave = dataclasses.replace(parts.disturbance, amplitude=parts.disturbance.amplitude * (1.0 + self.std * c[0]))
        return dataclasses.replace(parts, disturbance=wave, initial=parts.initial + 0.01 * c[1])

    def values(self, c):
        return {"drift": 1.0 + self.std * c[0]}
"""
CHAIN = {
    "plant": {"kind": "chain", "order": 2, "x0": [1.0, 0.0]},
    "controller": {"kind": "pd", "k_p": 2.0, "k_d": 2.0, "t_f": 5.0},
    "loop": {"mode": "sampled", "period": 0.1, "t_end": 6.5},
}
NOISY = {"kind": "custom", "code": "mine.py:Noisy"}
DRIFT = {"custom": {"kind": "custom", "code": "mine.py:Drift"}}
FILES = {"mine.py": FILE}
pytestmark = pytest.mark.usefixtures("here")


def parts_of(**tables):
    """Return the parts of a chain under a PD law with these tables."""
    return scenario.study(scenario.from_tables({**CHAIN, **tables})).parts


def test_custom_sensors_match_a_loop_computed_by_hand():
    """u = -2 x_1 - 2 x_2 with measured states: x_1 of the previous sample, and the noise of (seed, trial, sample)."""
    parts = parts_of(sensors={**NOISY, "sigma": [0.02, 0.03]}, disturbance={"kind": "none"})
    log = rollout.simulate_parts(parts, 3, 7, record=True).log
    kept = np.asarray(log.has_length)
    t, x, u = (np.asarray(v)[kept] for v in (log.t, log.x, log.u))
    ticks = ticks_of(parts.clock, parts.controller.t_f, parts.controller.delta)
    sample = np.asarray(ticks.sample)[np.asarray(ticks.t_next > ticks.t)]
    key = draws.stream(np.uint32(3), np.uint32(7), CUSTOM_NOISE)
    noise = np.asarray(jax.jit(jax.vmap(lambda k: draws.normals(key, 2, k)))(sample[1:]))
    seen = x[1:-1] + np.array([0.02, 0.03]) * noise
    wanted = -2.0 * seen[:-1, 0] - 2.0 * seen[1:, 1]  # x_1 is one sample late
    np.testing.assert_allclose(u[2:-1, 0], wanted, rtol=0.0, atol=1e-13)
    other = rollout.simulate_parts(parts, 3, 8)
    assert float(other.metrics.window_error) != float(rollout.simulate_parts(parts, 3, 7).metrics.window_error)
    assert linear.quiet(parts).sensors.noise_scale == 0.0
    assert t.size > 60


def test_a_period_of_length_zero_does_not_change_the_sensor_memory():
    """Clocks contain periods of length zero. Measurements in them are not used."""
    sensors = parts_of(sensors=NOISY, disturbance={"kind": "none"}).sensors
    now = Ticks(*(jnp.asarray(v) for v in (0.5, 0.5, False, 3, 1.0, False)))
    _, (_, _, kept) = sensors.measure(
        sensors.begin(3, 7, vector([1.0, 2.0]), now), vector([5.0, 6.0]), now, vector(0.1)
    )
    assert kept.tolist() == [1.0]
    _, (_, _, new) = sensors.measure(
        sensors.begin(3, 7, vector([1.0, 2.0]), now), vector([5.0, 6.0]), now._replace(t_next=vector(0.6)), vector(0.1)
    )
    assert abs(float(new[0]) - 5.0) < 0.1


def test_custom_sensors_of_a_spacecraft_measure_attitude_and_rate(command, here):
    """A sensor with an attitude bias brings the body to rest with this error, and every row is predicted."""
    (here / "mine.py").write_text(
        "import jax.numpy as jnp\nimport ptsmc_jax as ptsmc\nfrom ptsmc_jax.numerics import attitude\n\n"
        "class Tilted(ptsmc.SampledSensor):\n    turn: float = 2e-3\n\n"
        "    def see(self, memory, x, noise, t, dt):\n"
        "        by = self.turn * jnp.array([0.0, 0.0, 1.0])\n"
        "        return x._replace(q=attitude.multiply(x.q, attitude.from_rotation_vector(by))), memory\n"
    )
    text = SHORT.replace("attitude_noise = 2e-5\n", "").replace("rate_noise = 1e-6\n", "").replace("[hardware]\n", "")
    text = text[: text.index("[requirements]")] + '[sensors]\nkind = "custom"\ncode = "mine.py:Tilted"\n'
    text = text.replace("t_end = 6.5", "t_end = 25.0").replace("k1 = 1.0\n", "k1 = 4.0\n")
    (here / "s.toml").write_text(text)
    run = explore.simulate(scenario.read("s.toml"))
    turned = np.asarray(run.run.log.x.q)[-1]
    np.testing.assert_allclose(2.0 * np.linalg.norm(turned[:3]), 2e-3, rtol=0.05)  # the rest is the observer's lag
    assert run.run.lower_bound is None
    status, _, error = command("simulate", "s.toml", "--no-figures", "--quiet")
    assert (status, error) == (0, f"ptsmc: runs {here}/mine.py, which sensors.code of s.toml names\n")
    made = store.read_versions(here / "out" / "simulate-s")
    assert made["sensors_sha256"] == systems.checksum("mine.py:Tilted")
    again = command("simulate", "out/simulate-s/scenario.toml", "--quiet", "--out", "new")
    assert again[0] == 2
    assert "(sensors.code), which this command would run" in again[2]


def test_a_late_star_tracker_delays_the_attitude_and_not_the_rate():
    sensor, rng = LateStarTracker(model=None), np.random.default_rng(1)
    q = rng.normal(size=(8, 4))
    q /= np.linalg.norm(q, axis=1)[:, None]
    states = [AttitudeState(jnp.asarray(q[k]), jnp.full(3, float(k))) for k in range(8)]
    memory, seen = sensor.begin(states[0]), []
    for x in states:
        one, memory = sensor.see(memory, x, jnp.zeros(6), jnp.asarray(0.0), jnp.asarray(0.1))
        seen.append(one)
    np.testing.assert_allclose([one.q for one in seen], q[np.maximum(np.arange(8) - sensor.late, 0)], atol=1e-15)
    np.testing.assert_array_equal([one.w[0] for one in seen], np.arange(8.0))


@pytest.mark.long
def test_margins_with_a_late_star_tracker_lie_between_no_delay_and_full_delay():
    """Margins are smaller than without delay, and larger than with an equally late gyro."""
    flight = scenario.replace(
        scenario.read(FIRST_FLIGHT), tune=None, requirements=None, controller__delta=1.0, observer__gain=[5.0] * 3
    )
    sensors = {"kind": "custom", "code": LateStarTracker}
    late = scenario.replace(flight, hardware=None, sensors=sensors)
    all_late = scenario.replace(flight, hardware__delay=LateStarTracker.late)
    judged = [stability.worst_margins(scenario.study(one)) for one in (all_late, late, flight)]
    left = [one["hold"] for one in judged if one is not None]
    for margin in ("gain_margin", "phase_margin"):
        least, with_delay, most = (found[margin] for found in left)
        assert least < with_delay < most


def test_custom_dispersions_change_the_parts_and_appear_in_the_rows(command, here):
    """Their rows are a valid run table, and `ptsmc montecarlo` uses them."""
    tables = {**CHAIN, "disturbance": {"kind": "sinusoid", "amplitude": [0.05]}, "dispersion": DRIFT}
    ready = scenario.study(scenario.from_tables(tables))
    assert ready.dispersion.varies
    assert margin_verdicts.has_different_loops(ready.dispersion)
    c = ready.dispersion.coordinates(jnp.uint32(2), jnp.uint32(5))[CUSTOM]
    drawn = ready.dispersion.apply(ready.parts, jnp.uint32(2), jnp.uint32(5))
    np.testing.assert_allclose(drawn.disturbance.amplitude, 0.05 * (1.0 + 0.1 * c[0]), rtol=1e-15)
    np.testing.assert_allclose(drawn.initial, np.array([1.0, 0.0]) + 0.01 * np.asarray(c[1]), rtol=1e-15)
    rows = ptsmc.trials(scenario.from_tables(tables), 40, seed=2)
    assert rows["drift"].n_unique() == 40
    np.testing.assert_allclose(rows["drift"][5], 1.0 + 0.1 * float(c[0]), rtol=1e-12)
    run_table = rows[3:9].select("trial", "drift", "window_error")  # a run table: `trial` selects the draws
    again = ptsmc.trials(scenario.from_tables(tables), run_table, seed=2)
    np.testing.assert_array_equal(again["drift"], rows["drift"][3:9])
    wider = {**tables, "dispersion": {"custom": {**DRIFT["custom"], "std": 0.2}}}
    store.write_toml(here / "c.toml", wider)
    assert command("montecarlo", "c.toml", "--trials", 40, "--seed", 2, "--no-figures", "--quiet")[0] in (0, 1)
    kept = pl.read_parquet(here / "out" / "montecarlo-c" / "trials")
    np.testing.assert_allclose(kept["drift"][5], 1.0 + 0.2 * float(c[0]), rtol=1e-12)


def test_keys_of_custom_sensors_and_dispersions_are_read_and_written(here):
    loaded = scenario.from_tables({**CHAIN, "sensors": {**NOISY, "sigma": [1.0, 2.0]}, "dispersion": DRIFT})
    assert custom.has_unloaded_code(loaded)
    assert set(custom.code_by_key(loaded)) == {"sensors.code", "dispersion.custom.code"}
    assert set(custom.checksums(loaded)) == {"sensors_sha256", "dispersion_custom_sha256"}
    whole = reading.complete(loaded)
    assert whole.dispersion is not None
    assert (whole.sensors.sigma, whole.dispersion.custom.std) == ((1.0, 2.0), 0.1)
    assert reading.complete(scenario.from_tables(parsing.dump(whole))) == whole


SEES = [
    ("def see", "def seen", "the class Noisy has no method see"),
    ("return jnp.concatenate([memory, seen[1:]]), seen[:1]", "return seen", "see returns f64(2,)"),
    (
        "return jnp.concatenate([memory, seen[1:]]), seen[:1]",
        "return seen[:1], seen[:1]",
        "see returns (f64(1,), f64(1,))",
    ),
    ("seen[1:]]), seen[:1]", "seen[1:]]), seen", "see returns (f64(2,), f64(2,))"),
    ("x + self.sigma", "jnp.nan * x + self.sigma", "must return finite numbers"),
    ("x + self.sigma", "x + 0.0 / dt + self.sigma", "finite numbers, also at the first sample, where dt is 0"),
    ("draws = 2\n    sigma", "draws = 2.5\n    sigma", "draws is 2.5, but must be a whole number of at least 0"),
    ("sigma * noise", "sigma * noise[2]", "see fails: IndexError: index 2 is out of bounds for axis 0 with size 2"),
    ("x + self.sigma", "1 / 0 + self.sigma", "see fails: ZeroDivisionError: division by zero (line 18 of mine.py)"),
]
DRAWS = [
    ("std: float = 0.1", "std: float = ptsmc.gain(1.0, (0.1, 2.0))", "the tuner cannot change parts of this kind"),
    ("def at", "def be", "the class Drift has no method at"),
    ("return dataclasses.replace(parts, disturbance", "return dict(d", "at returns a dict at t = 0"),
    (
        "initial=parts.initial + 0.01 * c[1]",
        "initial=jnp.zeros(3)",
        "at returns f64(3,) at t = 0, but must return parts with numbers of the same shapes, of the form f64(2,)",
    ),
    ("initial=parts.initial + 0.01 * c[1]", "initial=None", "at returns parts with another initial at t = 0"),
    ("0.01 * c[1]", "jnp.inf * c[1]", "at returns [inf, inf] at t = 0, but must return finite numbers"),
    ("0.01 * c[1]", "0.01 * c[2]", "at fails: IndexError: index 2 is out of bounds for axis 0 with size 2 (line"),
    ("0.01 * c[1]", "1 / 0 * c[1]", "at fails: ZeroDivisionError"),
    ('{"drift": 1.0', '{" ": 1.0', "returns a number ' ' at t = 0, but must return printable names"),
    ('{"drift": 1.0', '{"status": 1.0', "names that no column of the result file has"),
    ('{"drift": 1.0', '{"run_trial": 1.0', "names that no column of the result file has"),  # would replace this column
    (
        '{"drift": 1.0 + self.std * c[0]}',
        '{"drift": c[0] > 0.0}',
        "values returns {drift: bool()}",
    ),  # a summary cannot rank it
    ('{"drift": 1.0 + self.std * c[0]}', "[c[0]]", "must return a dict of numbers by name"),
    ('{"drift": 1.0 + self.std * c[0]}', '{"drift": 1 / 0}', "values fails: ZeroDivisionError"),
    ("count = 2", "count = 0", "count is 0, but must be a whole number of at least 1"),
    ("count = 2", "count = 2\n    drawn = 'gaussian'", 'drawn is "gaussian", but must be "normal" or "uniform"'),
]


@pytest.mark.parametrize(("old", "new", "said"), SEES + DRAWS, ids=[row[2][:30] for row in SEES + DRAWS])
def test_errors_in_custom_sensors_and_dispersions_are_one_sentence(here, old, new, said):
    assert old in FILE
    (here / "mine.py").write_text(FILE.replace(old, new))
    which = {"sensors": NOISY} if (old, new, said) in SEES else {"dispersion": DRIFT}
    with pytest.raises(ScenarioError) as caught:
        parts_of(**which, disturbance={"kind": "sinusoid", "amplitude": [0.05]})
    text = str(caught.value)
    assert said in text
    assert "\n" not in text
    assert ("sensors.code" if "sensors" in which else "dispersion.custom") in text


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ({"hardware": {"state_noise": [1.0, 1.0]}}, "hardware.state_noise is [1.0, 1.0], but must be absent, because"),
        ({"loop": {"mode": "continuous"}, "controller": {"t_f": 5.0}}, "[sensors] needs the sampled loop"),
    ],
)
def test_custom_sensors_exclude_built_in_sensors_and_filters(tables, said):
    with refuses(ScenarioError, said):
        scenario.from_tables({**CHAIN, "sensors": NOISY, **tables})
    flight = {"loop": {"mode": "sampled"}, "sensors": NOISY}
    with pytest.raises(ScenarioError, match=r"filter\.kind"):
        scenario.from_tables({**flight, "filter": {}})  # earlier: an error about its bandwidth
    for key in ("attitude_noise", "rate_noise", "star_tracker_misalignment", "gyro_scale", "star_tracker_outage"):
        with pytest.raises(
            ScenarioError, match=rf"^dispersion\.{key} changes the sensors of \[hardware\], but \[sensors\]"
        ):
            scenario.from_tables({**flight, "dispersion": {key: {}}})  # not an error about noise
    assert dataclasses.is_dataclass(ptsmc.SampledSensor)


def test_gains_of_custom_sensors_are_tuned_and_written():
    """They have bounds, units and a gradient of the window error, which equals finite differences."""
    tables = {**CHAIN, "sensors": {"kind": "custom", "code": "mine.py:Smoothed"}, "tune": {}}
    loaded = reading.complete(scenario.from_tables(tables))
    assert loaded.tune is not None
    assert loaded.tune.free == ("k_p", "k_d", "sensors_share")
    assert loaded.tune.bounds["sensors_share"] == (0.05, 1.0)
    parts = scenario.study(loaded).parts
    assert gains.gains_of(parts)["sensors_share"] == 0.5
    assert gains.units_of(loaded, ["sensors_share"]) == {"sensors_share": "-"}
    other = gains.in_scenario(loaded, {"sensors_share": 0.3})
    assert other.sensors.share == 0.3
    assert gains.controls_differ(loaded, other)
    one, two = (
        rollout.simulate_parts(p, 1, 2).metrics.window_error
        for p in (gains.with_gains(parts, {"sensors_share": 0.3}), scenario.study(other).parts)
    )
    assert float(one) == float(two) != float(rollout.simulate_parts(parts, 1, 2).metrics.window_error)

    def error(share):
        return rollout.simulate(gains.with_gains(parts, {"sensors_share": share}), 1, 2).metrics.window_error

    slope = float(jax.jit(jax.grad(error))(0.3))
    both = [float(jax.jit(error)(0.3 + step)) for step in (1e-6, -1e-6)]
    np.testing.assert_allclose(slope, (both[0] - both[1]) / 2e-6, rtol=1e-5)
