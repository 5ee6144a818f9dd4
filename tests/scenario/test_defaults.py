"""Defaults that follow from other keys (disturbance bounds, observer gain), and warnings about unusual values."""

import math
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.numerics.pytrees import vector
from ptsmc_jax.observers.nonlinear import NonlinearObserver
from ptsmc_jax.plants import rigid_body
from ptsmc_jax.scenario import disturbance_tables, free_gains, parsing, plausibility, reading
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.signals.disturbances import Disturbance
from tests.helpers import FULL_INERTIA
from tests.tree import ROOT
from tuning.search import gains

CUBESAT = [0.05, 0.08, 0.11]
SAMPLED = {"mode": "sampled", "period": 0.1}


def free(said):
    """Return the names of the free gains of a scenario with the table [tune]."""
    assert said.tune is not None
    assert said.tune.free is not None
    return said.tune.free


def bounds(**tables):
    """Return the default bounds of the disturbance and of its rate in a scenario with these tables."""
    law = reading.complete(scenario.from_tables(tables)).controller
    return law.disturbance_bound, law.disturbance_rate_bound


def largest_disturbance(disturbance, dispersion=None, count=400, spacecraft=None):
    """Return the largest component of d and of d' over random times, phases and factors, by finite differences.

    disturbance, dispersion, spacecraft: tables of the scenario. count: number of trials.
    """
    tables = {"disturbance": disturbance, "dispersion": dispersion or {}, "spacecraft": spacecraft or {}}
    ready = scenario.study(scenario.from_tables(tables))
    t = np.linspace(0.0, 40.0, 8001)

    @jax.jit
    def history(trial):
        drawn = ready.dispersion.apply(ready.parts, np.uint32(0), trial)
        return jax.vmap(lambda time: drawn.disturbance(time, drawn.initial))(jnp.asarray(t))

    each = [np.asarray(history(np.uint32(k))) for k in range(count)]
    return max(np.abs(d).max() for d in each), max(np.abs(np.gradient(d, t, axis=0)).max() for d in each)


def test_published_disturbance_bounds_follow_from_the_published_cases():
    """Case I has 0.01 sin(0.1 t) on the published body, Figs. 1 and 2 have 0.01 sin(t)."""
    assert bounds() == (0.01, 1e-3)
    assert scenario.from_tables({}).observer.gain == (10.0, 10.0, 10.0)
    assert bounds(plant={"kind": "chain"}) == (0.01, 0.01)
    assert bounds(disturbance={"kind": "none"}) == (0.0, 0.0)


def test_bounds_of_a_sinusoid_follow_from_amplitude_bias_and_frequency():
    table = {
        "kind": "sinusoid",
        "amplitude": [2e-3, 1e-3, 0.0],
        "frequency": [1.0, 3.0, 9.0],
        "bias": [0.0, -4e-3, 1e-3],
    }
    assert bounds(disturbance=table) == (5e-3, 3e-3)
    assert largest_disturbance(table, count=1) == pytest.approx((5e-3, 3e-3), rel=1e-3)  # steps of 2.5 mrad


def test_disturbance_bounds_include_dispersions():
    """Bounds include factors (truncated at three sigma, or uniform), a bias of three sigma, and all phases."""
    table = {"kind": "sinusoid", "amplitude": [1e-3] * 3, "frequency": [1.0] * 3}
    drawn = {
        "disturbance_amplitude": {"kind": "relative_uniform", "half_width": 0.5},
        "disturbance_phase": {"kind": "uniform"},
        "disturbance_bias": {"kind": "uniform", "half_width": 2e-3},
    }
    assert bounds(disturbance=table, dispersion=drawn) == (3.5e-3, 1.5e-3)
    seen = largest_disturbance(table, drawn, count=60)
    assert 0.9 * 3.5e-3 < seen[0] <= 3.5e-3  # the largest of 180 random pairs of uniform numbers
    assert 0.9 * 1.5e-3 < seen[1] <= 1.5e-3
    normal = {"disturbance_amplitude": {"kind": "relative_normal", "std": 0.1},
              "disturbance_bias": {"kind": "normal", "std": 1e-3}}  # fmt: skip
    assert bounds(disturbance=table, dispersion=normal) == pytest.approx((4.3e-3, 1.3e-3), rel=1e-15)  # rounding


def test_bounds_of_several_disturbances_add_up_component_by_component():
    terms = [{"kind": "constant", "amplitude": [3e-3, 0.0, 0.0]},
             {"kind": "sinusoid", "amplitude": [0.0, 4e-3, 0.0], "frequency": [1.0] * 3}]  # fmt: skip
    assert bounds(disturbance={"kind": "sum", "terms": terms}) == (4e-3, 4e-3)


def test_densities_of_independent_random_walks_add_up_by_their_squares():
    """Two walks with densities of 3 and 4 on the same axis are one walk with a density of 5."""

    def walking(*densities):
        terms = [{"kind": "random_walk", "density": density} for density in densities]
        tables = {"loop": {"mode": "sampled"}, "disturbance": {"kind": "sum", "terms": [*terms, {"kind": "constant"}]}}
        return np.asarray(scenario.study(scenario.from_tables(tables)).parts.walk_rate)

    one, other, both = [3e-4, 1e-4, 0.0], [4e-4, 0.0, 2e-4], [5e-4, 1e-4, 2e-4]
    np.testing.assert_allclose(walking(one, other), walking(both), rtol=1e-12)


def test_bounds_of_the_gravity_gradient_include_correlated_inertias():
    """The dispersion that `ptsmc identify` writes, at three sigma in every direction of its six coordinates."""
    dispersion = {"inertia": {"kind": "correlated", "factor": [[0.01] * k for k in range(1, 7)]}}
    tables = {"disturbance": {"kind": "gravity_gradient", "orbit_rate": 1e-3}, "dispersion": dispersion}
    kind = scenario.study(scenario.from_tables(tables)).dispersion.numbers["inertia"]
    directions = np.random.default_rng(1).normal(size=(500, 6))
    directions *= 3.0 / np.linalg.norm(directions, axis=1, keepdims=True)
    moments = np.linalg.eigvalsh(np.stack([kind.at(jnp.asarray(c))[0] for c in directions]))
    largest = 1.5e-6 * np.max(moments[:, 2] - moments[:, 0])
    assert 0.3 * bounds(**tables)[0] < largest <= bounds(**tables)[0]


def test_bounds_of_the_gravity_gradient_are_tight():
    """The largest c x J c is half the difference of the moments, and its rate is at most the difference times |c'|."""
    n, inertia = 1.1e-3, np.asarray(FULL_INERTIA)
    apart = np.ptp(np.linalg.eigvalsh(inertia))
    rng = np.random.default_rng(0)
    c, along = rng.normal(size=(2, 20000, 3))
    c /= np.linalg.norm(c, axis=1, keepdims=True)
    along -= np.sum(along * c, axis=1, keepdims=True) * c
    along /= np.linalg.norm(along, axis=1, keepdims=True)  # c' at unit rate
    torque = np.linalg.norm(np.cross(c, c @ inertia), axis=1).max()
    changes = np.linalg.norm(np.cross(along, c @ inertia) + np.cross(c, along @ inertia), axis=1).max()
    assert 0.99 < torque / (0.5 * apart) <= 1.0  # the nearest of 20000 directions is 1 deg off
    assert 0.98 < changes / apart <= 1.0
    tables = {"spacecraft": {"inertia": FULL_INERTIA}, "disturbance": {"kind": "gravity_gradient", "orbit_rate": n}}
    size, rate = bounds(**tables)
    assert size == pytest.approx(1.5 * n**2 * apart, rel=1e-3)
    turns = n + 2 * np.pi / 30.0
    assert rate == pytest.approx(3 * n**2 * apart * turns, rel=1e-3)
    # random moments, three sigma further apart
    least, _, most = np.linalg.eigvalsh(inertia)
    drawn, _ = bounds(**tables, dispersion={"inertia": {"kind": "relative_normal", "std": 0.05}})
    assert drawn == pytest.approx(1.5 * n**2 * (1.15 * most - 0.85 * least), rel=1e-3)


def test_bounds_of_a_random_walk_are_three_sigma():
    """The size bound is the walk at t_end. The rate bound is the change in the observer's time constant of 1.2 s."""
    table = {"kind": "random_walk", "density": [1e-5, 2e-5, 0.0]}
    size, rate = bounds(disturbance=table, loop=SAMPLED)
    assert size == pytest.approx(3 * 2e-5 * np.sqrt(40.0), rel=1e-3)
    assert rate == pytest.approx(3 * 2e-5 / np.sqrt(1.2), rel=1e-3)
    rng = np.random.default_rng(1)  # 3 sigma of the observer's error: c J / l / sqrt(2), with J / l = 1.2 s
    h, off = 0.1, np.zeros(4000)
    for _ in range(400):
        off = np.exp(-h / 1.2) * (off + 2e-5 * np.sqrt(h) * rng.normal(size=off.size))
    assert np.std(off) < rate * 1.2 / 3 < 2 * np.std(off)


class Wobble(Disturbance):
    """A custom disturbance: 0.02 sin(0.3 t) about x, and a term about y that grows with the rate."""

    share: float = 0.1

    def __call__(self, t, x):
        """Return the torque (3,) [N m]."""
        return jnp.stack([0.02 * jnp.sin(0.3 * t), self.share * jnp.sum(x.w**2), 0.0 * t])


def test_bounds_of_a_custom_disturbance_are_taken_along_the_nominal_run():
    table = {"kind": "custom", "code": Wobble, "share": 0.0}
    assert bounds(disturbance=table) == pytest.approx((0.02, 6e-3), rel=1e-3)
    angle = 2.0 * np.arccos(0.5773502691896258)  # until t_f, fastest at the start, three times the mean rate
    largest, _ = bounds(disturbance={**table, "share": 10.0})
    assert largest == pytest.approx(10.0 * (3.0 * angle / 30.0) ** 2, rel=0.02)
    assert (
        scenario.from_tables({"disturbance": {"kind": "custom", "code": "any.py:D"}}).controller.disturbance_bound
        is None
    )


class BreaksOff(Disturbance):
    """A disturbance that is NaN after 10 s."""

    def __call__(self, t, x):
        """Return the torque (3,) [N m]."""
        return jnp.where(t > 10.0, jnp.nan, 0.01) * jnp.ones(3)


def test_a_custom_disturbance_that_becomes_nan_during_the_run_is_refused():
    with pytest.raises(ScenarioError, match=r"class BreaksOff .* \[nan, nan, nan\] at t = 10\.02 s .* finite numbers"):
        bounds(disturbance={"kind": "custom", "code": BreaksOff})


def test_the_default_observer_gain_depends_on_inertia_and_period():
    """The gain is proportional to the mean moment of inertia, and at most the moment over the period."""

    def gain(**tables):
        (value,) = set(scenario.from_tables(tables).observer.gain)
        return value

    cubesat_gain = pytest.approx(0.08 * 10.0 / 12.0, rel=1e-12)
    assert gain(spacecraft={"inertia": CUBESAT}) == cubesat_gain
    mean = (FULL_INERTIA[0][0] + FULL_INERTIA[1][1] + FULL_INERTIA[2][2]) / 3.0
    assert gain(spacecraft={"inertia": FULL_INERTIA}) == pytest.approx(mean * 10.0 / 12.0, rel=1e-12)
    assert gain(loop={"mode": "sampled", "period": 4.0, "window": 4.0}) == 3.0  # 12 / 4
    assert gain(plant={"kind": "chain"}, observer={"kind": "nonlinear"}) == 10.0
    cubesat = scenario.from_tables({"spacecraft": {"inertia": CUBESAT}})
    assert gains.published_gains(cubesat)["observer_gain"] == cubesat_gain


def test_stated_disturbance_bounds_are_kept():
    given = {"disturbance_rate_bound": 2e-3, "disturbance_bound": 0.0}
    assert bounds(controller=given) == (0.0, 2e-3)


def test_defaults_change_with_replaced_values_and_stated_values_do_not():
    """Bounds of gains follow the period, t_end follows t_f, and disturbance bounds follow the disturbance."""
    said = scenario.from_tables({"loop": SAMPLED, "tune": {"bounds": {"eta": [2.1, 5.0]}}})
    slow = scenario.replace(said, loop__period=0.5, controller__t_f=36.0)
    assert slow.tune is not None
    assert slow.controller.delta == slow.tune.bounds["delta"][0] == 0.5
    assert slow.tune.bounds["eta"] == (2.1, 5.0)
    assert slow.loop.t_end == 46.0  # a published case ends 10 s after t_f
    assert scenario.replace(said, controller__t_f=45.0).loop.t_end == pytest.approx(60.0)  # otherwise 4/3 t_f
    assert scenario.replace(said, disturbance__amplitude=[0.02] * 3).controller.disturbance_bound == 0.02
    assert "observer_gain" not in free(scenario.replace(said, observer__kind="none"))
    assert scenario.replace(slow, loop__t_end=50.0, controller__t_f=30.0).loop.t_end == 50.0
    assert scenario.from_tables(parsing.dump(slow)) == slow
    assert scenario.from_tables(parsing.stated_tables(slow)) == slow


SENSORS = [{"kind": "gyro", "rate_noise": 1e-6}, {"kind": "star_tracker", "noise_across": 4e-5}]


@pytest.mark.parametrize(
    ("tables", "mode"),
    [
        ({}, "continuous"),
        ({"loop": {"period": 0.1}}, "continuous"),
        ({"hardware": {"torque_limit": 1.0}}, "sampled"),
        ({"wheels": {"torque_limit": 0.2}}, "sampled"),
        ({"sensors": SENSORS}, "sampled"),
        ({"plant": {"kind": "chain"}, "hardware": {"delay": 1}}, "sampled"),
    ],
)
def test_the_loop_is_sampled_by_default_if_there_are_devices(tables, mode):
    assert scenario.from_tables(tables).loop.mode == mode


def test_setting_gains_in_a_scenario_changes_no_other_value():
    walk = {"kind": "random_walk", "density": [1e-5] * 3}
    said = scenario.from_tables({"loop": SAMPLED, "tune": {}, "disturbance": walk})
    tuned = gains.in_scenario(said, {"eta": 4.0, "observer_gain": 100.0})
    assert tuned.tune == said.tune
    assert tuned.controller.disturbance_rate_bound == said.controller.disturbance_rate_bound


NOISY = {"loop": SAMPLED, "spacecraft": {"inertia": CUBESAT}, "hardware": {"rate_noise": 1e-4}}
QUIET = {"kind": "constant", "amplitude": [1e-6] * 3}


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ({}, []),
        ({"controller": {"disturbance_rate_bound": 9e-3}}, []),
        ({"controller": {"disturbance_rate_bound": 0.011}}, ["rate_bound is 0.011", "has 0.001: the law"]),
        ({"controller": {"disturbance_rate_bound": 9e-5}}, ["disturbance_rate_bound is 9e-05", "may not reject it"]),
        ({"controller": {"disturbance_bound": 1.0}}, []),  # not used with an observer
        ({"controller": {"disturbance_bound": 1.0}, "observer": {"kind": "none"}}, ["bound is 1", "chatters"]),
        ({"controller": {"disturbance_rate_bound": 1e-3}, "disturbance": QUIET}, ["has 0: the law switches"]),
        *(
            ({"controller": {"kind": law, "disturbance_rate_bound": 1e-3}, "disturbance": QUIET, "loop": SAMPLED}, said)
            for law, said in (("pd", []), ("super_twisting", []), ("terminal", ["the law switches"]))
        ),
        (
            {**NOISY, "disturbance": QUIET, "observer": {"gain": [0.07] * 3}},
            ["observer.gain is [0.07, 0.07, 0.07]", "larger than the disturbance", "at most 1e-06"],
        ),
        ({**NOISY, "disturbance": QUIET, "observer": {"gain": [1e-4] * 3}}, []),
        ({**NOISY, "disturbance": {"kind": "none"}}, []),
    ],
    ids=str,
)  # fmt: skip
def test_unusual_disturbance_bounds_and_noisy_estimates_cause_a_warning(tables, said):
    found = plausibility.warnings(scenario.from_tables(tables))
    assert len(found) == bool(said)
    assert all(words in found[0] for words in said)


@pytest.mark.parametrize(("share", "said"), [(1.02, False), (0.98, True)])
def test_an_estimate_with_more_noise_than_the_disturbance_causes_a_warning(share, said):
    observed = {**NOISY, "observer": {"gain": [0.07] * 3}}
    noise = plausibility.estimate_noise(scenario.from_tables({**observed, "disturbance": {"kind": "none"}}))
    acting = {"kind": "constant", "amplitude": [share * noise, 0.0, 0.0]}
    tables = {**observed, "disturbance": acting}
    assert plausibility.estimate_noise(scenario.from_tables(tables)) == noise  # for any disturbance
    assert any("try a smaller gain" in one for one in plausibility.warnings(scenario.from_tables(tables))) is said


@pytest.mark.parametrize("rate_noise", [1e-3, 1e-1])
def test_the_default_gain_of_the_observer_causes_no_warning_about_a_noisy_estimate(rate_noise):
    """No smaller gain helps: within t_f the estimate must approach the disturbance."""
    tables = {**NOISY, "hardware": {"attitude_noise": 1e-5, "rate_noise": rate_noise}}
    default = scenario.from_tables(tables)
    for same in (default, scenario.from_tables(parsing.dump(default))):
        assert not any("try a smaller gain" in one for one in plausibility.warnings(same))
    larger = scenario.replace(default, observer__gain=[1e3 * gain for gain in default.observer.gain])
    assert any("try a smaller gain" in one for one in plausibility.warnings(larger))


def test_the_predicted_noise_of_the_estimate_matches_a_simulated_observer():
    """Run the digital observer on 40000 samples of noise. Chance changes an axis by at most 1 % (3 sigma)."""
    gain, h, sigma = [0.05, 0.2, 1.0], 0.1, 1e-4
    tables = {**NOISY, "observer": {"gain": gain}}
    observer = NonlinearObserver(rigid_body.spacecraft(CUBESAT), vector(gain), vector(0.0), vector(0.0))
    n = sigma * np.random.default_rng(0).normal(size=(40001, 3))
    impulses, matrix = jnp.asarray(np.asarray(CUBESAT) * np.diff(n, axis=0)), observer.update_matrix(vector(h))

    def step(memory, impulse):
        new = observer.update(matrix, memory, impulse, vector(0.0), vector(h))
        return new, new

    _, estimates = jax.lax.scan(step, jnp.zeros(3), impulses)
    assert np.std(np.asarray(estimates)[200:], axis=0).max() == pytest.approx(
        plausibility.estimate_noise(scenario.from_tables(tables)), rel=0.02
    )


def test_the_value_of_a_gain_beyond_its_search_bound_is_allowed_or_none():
    """The value is a tenth of the interval beyond the bound, or None if the reason of the bound is known."""
    said = scenario.from_tables({"loop": SAMPLED, "tune": {"bounds": {"eta": [2.05, 8.0], "delta": [0.1, 10.0]}}})
    assert free_gains.value_beyond_bound(said, "eta", "upper") == pytest.approx(8.595)
    assert free_gains.value_beyond_bound(said, "eta", "lower") == pytest.approx(
        2.025
    )  # half way to 2, the excluded end
    assert free_gains.value_beyond_bound(said, "delta", "upper") == pytest.approx(10.0 * 100.0**0.1, rel=1e-3)
    assert free_gains.value_beyond_bound(said, "delta", "lower") is None  # one period, the shortest delta
    assert free_gains.value_beyond_bound(said, "observer_gain", "upper") is None  # dead-beat
    law, observer = {"kind": "scaling", "disturbance_rate_bound": 0.123456}, {"kind": "finite_time"}
    other = scenario.from_tables({"controller": law, "observer": observer, "loop": SAMPLED, "tune": {}})
    assert other.search.bounds["m"][0] == 1.0
    assert other.search.bounds["observer_gain"][0] == 0.123456
    for gain in ("m", "observer_gain"):  # the bound is the smallest allowed value
        assert free_gains.value_beyond_bound(other, gain, "lower") is None


class Vibration(Disturbance):
    """A vibration with an angular frequency [rad/s]."""

    rate: float = 1.0

    def __call__(self, t, x):
        """Return the torque 0.01 sin(rate t) on each axis, (3,) [N m]."""
        return 0.01 * jnp.sin(self.rate * t) * jnp.ones(3)

    def fastest(self):
        """Return the angular frequency [rad/s]."""
        return self.rate


@pytest.mark.parametrize("rate", [1.0, 50.0, 50.0 * math.pi])
def test_bounds_of_a_fast_custom_disturbance_are_not_aliased(rate):
    """An earlier version aliased a disturbance of 25 Hz with its sample times and found bounds of nearly zero."""
    said = scenario.from_tables({"disturbance": {"kind": "custom", "code": Vibration, "rate": rate}})
    known = disturbance_tables.largest_disturbance(said)
    assert known is not None
    np.testing.assert_allclose(known, (0.01, 0.01 * rate), rtol=3e-3)


class Swell(Disturbance):
    """A disturbance with a period of ten minutes, and random size [N m] and phase [rad]."""

    size: float = 0.01
    late: float = 0.0
    drawn: ClassVar = {"amplitude": "size", "phase": "late"}

    def __call__(self, t, x):
        """Return the torque size sin(0.01 t + late) on each axis, (3,) [N m]."""
        return self.size * jnp.sin(0.01 * t + self.late) * jnp.ones(3)


@pytest.mark.parametrize(
    ("drawn", "most"),
    [
        ({}, math.sin(0.4)),  # the largest value within 40 s
        ({"disturbance_amplitude": {"kind": "relative_uniform", "half_width": 0.5}}, 1.5 * math.sin(0.4)),
        ({"disturbance_phase": {}}, 1.0),
        ({"disturbance_amplitude": {"kind": "relative_normal", "std": 0.1}, "disturbance_phase": {}}, 1.3),
    ],
)
def test_bounds_of_a_custom_disturbance_include_dispersions(drawn, most):
    dispersion = {"dispersion": drawn} if drawn else {}
    known = disturbance_tables.largest_disturbance(
        scenario.from_tables({"disturbance": {"kind": "custom", "code": Swell}, **dispersion})
    )
    assert known is not None
    np.testing.assert_allclose(known[0], 0.01 * most, rtol=3e-3)


@pytest.mark.parametrize(
    ("drawn", "said"), [({"amplitude": "siz"}, "siz"), ({"sizes": "size"}, "sizes"), (("size",), "size")]
)
def test_a_custom_disturbance_that_disperses_an_unknown_field_is_refused(drawn, said):
    wrong = type("Wrong", (Swell,), {"drawn": drawn, "__annotations__": {"drawn": ClassVar}})
    with pytest.raises(ScenarioError, match=rf"class Wrong whose drawn is .*{said}.*, but must name fields of it"):
        scenario.from_tables({"disturbance": {"kind": "custom", "code": wrong}})


@pytest.mark.parametrize(
    ("hardware", "warned"),
    [
        ({"attitude_noise": 2e-5}, True),
        ({"attitude_noise": 2e-5, "torque_limit": 0.5}, True),
        ({"attitude_noise": 2e-5, "rate_noise": 0.0}, False),  # stated on purpose
        ({"attitude_noise": 2e-5, "rate_noise_density": 1e-6}, False),
        ({"attitude_noise": 2e-5, "rate_bias": 1e-6}, False),
        ({"attitude_noise": 0.0}, False),
        ({"torque_limit": 0.5}, False),
    ],
)
def test_a_noisy_star_tracker_with_a_perfect_gyro_causes_a_warning(hardware, warned):
    """There is no warning if the scenario states that the gyro has no noise."""
    found = plausibility.warnings(scenario.from_tables({"loop": {"mode": "sampled"}, "hardware": hardware}))
    assert [one for one in found if "hardware.attitude_noise is 2e-05 rad" in one and "true rate" in one] == found
    assert bool(found) == warned


@pytest.mark.parametrize(
    ("factor", "said"),
    [(1e7, "torque limit allows"), (1e4, "torque limit allows"), (1.0, None), (1e-7, "rad in one")],
)
@pytest.mark.parametrize("actuators", [{"hardware": {"torque_limit": 0.01}}, {"wheels": {"torque_limit": 0.01}}])
def test_an_inertia_in_another_unit_causes_a_warning_about_the_torque_limit(factor, said, actuators):
    tables = {"spacecraft": {"inertia": [0.5 * factor] * 3}, "controller": {"t_f": 60.0}, "loop": {"mode": "sampled"}}
    found = [one for one in plausibility.warnings(scenario.from_tables({**tables, **actuators})) if "kg cm^2" in one]
    assert [said in one for one in found] == ([] if said is None else [True])


def test_a_large_required_torque_of_a_continuous_loop_causes_no_warning_about_its_period():
    tables = {"loop": {"mode": "continuous"}, "requirements": {"peak_torque": 1e5}}
    assert not plausibility.warnings(scenario.from_tables(tables))


@pytest.mark.parametrize(
    "path", sorted(ROOT.glob("scenarios/*.toml")) + sorted(ROOT.glob("benchmarks/satellites/*.toml"))
)
def test_the_scenarios_of_the_repository_cause_no_warning(path):
    assert not plausibility.warnings(scenario.read(path))


@pytest.mark.parametrize(("delay", "said"), [(0, False), (59, False), (60, True), (599, True)])
def test_a_delay_that_is_probably_in_seconds_causes_a_warning(delay, said):
    """The warning begins at a tenth of t_f = 30 s, 60 periods of 0.05 s."""
    every = plausibility.warnings(scenario.from_tables({"loop": {"mode": "sampled"}, "hardware": {"delay": delay}}))
    found = [one for one in every if "surface_rate" not in one]  # the surface is too fast for this delay
    known = f"hardware.delay is {delay}, a delay of {delay * 0.05:g} s with loop.period = 0.05 s"
    assert found == [f"{known}; the key counts control periods, not seconds"] * said


PYRAMID = 4.0 / math.sqrt(3.0)  # largest torque about an axis, relative to that of a wheel


@pytest.mark.parametrize(
    ("metric", "key", "ratio"),
    [
        ("peak_torque", "hardware", 1.0),
        ("peak_torque_delivered", "hardware", 1.0),
        ("peak_torque", "wheels", PYRAMID),
        ("peak_wheel_torque", "wheels", 1.0),
    ],
)
@pytest.mark.parametrize(("factor", "said"), [(1.0, False), (1.001, True), (1000.0, True)])
def test_a_required_torque_beyond_the_actuators_causes_a_warning(metric, key, ratio, factor, said):
    tables = {key: {"torque_limit": 0.5}, "requirements": {metric: 0.5 * ratio * factor}, "loop": {"mode": "sampled"}}
    found = [one for one in plausibility.warnings(scenario.from_tables(tables)) if "saturation" in one]
    assert len(found) == said
    assert not said or (found[0].startswith(f"requirements.{metric} is") and f"{key}.torque_limit = 0.5" in found[0])


@pytest.mark.parametrize(("limit", "said"), [(2.0, False), (3.0, True)])
def test_a_required_input_of_a_chain_beyond_its_limit_causes_a_warning(limit, said):
    tables = {"plant": {"kind": "chain"}, "hardware": {"torque_limit": 2.0}, "requirements": {"peak_torque": limit}}
    found = plausibility.warnings(scenario.from_tables(tables))
    assert [one.startswith("requirements.peak_torque is 3, but") for one in found] == [True] * said


VIBRATION = {"kind": "sinusoid", "amplitude": [20.0] * 3, "frequency": [100.0] * 3}  # beyond the Nyquist frequency


@pytest.mark.parametrize("key", ["hardware", "wheels"])
@pytest.mark.parametrize(
    ("disturbance", "said"),
    [
        ({"kind": "constant", "amplitude": [0.0, -1.05, 0.0]}, True),
        ({"kind": "constant", "amplitude": ["0.95 N m", 0.0, 0.0]}, False),
        (VIBRATION | {"bias": [0.95, 0.0, 0.0]}, False),
        (VIBRATION | {"bias": [1.05, 0.0, 0.0]}, True),
        ({"kind": "sinusoid", "amplitude": [0.0, -1.05, 0.0], "frequency": [0.1, 0.1, 0.1]}, True),
        ({"kind": "sinusoid", "amplitude": [0.95, 0.0, 0.0], "frequency": [0.1, 0.1, 0.1]}, False),
        ({"kind": "sinusoid", "amplitude": [0.6, 0.0, 0.0], "bias": [-0.6, 0.0, 0.0]}, True),
        ({"kind": "sum", "terms": [{"kind": "constant", "amplitude": [0.6, 0.0, 0.0]}] * 2}, True),
        ({"kind": "sum", "terms": [VIBRATION, {"kind": "sinusoid", "amplitude": [0.0, 0.0, 1.05]}]}, True),
        ({"kind": "gravity_gradient"}, False),
        ({"kind": "none"}, False),
    ],
    ids=str,
)
def test_a_disturbance_beyond_the_torque_limit_causes_a_warning(key, disturbance, said):
    """The limit of the torque about a body axis is 1 N m."""
    limits = {"hardware": 1.0, "wheels": 1.0 / PYRAMID}
    tables = {"loop": {"mode": "sampled"}, "disturbance": disturbance, key: {"torque_limit": limits[key]}}
    found = [one for one in plausibility.warnings(scenario.from_tables(tables)) if "cannot hold" in one]
    assert [f"{key}.torque_limit is" in one for one in found] == [True] * said


@pytest.mark.parametrize("plant", ["spacecraft", "chain"])
@pytest.mark.parametrize(
    ("lag", "said"), [(50.0, True), (3.0, True), (2.9, False), ("50 ms", False), (50, True), (None, False)]
)
def test_a_lag_that_is_long_compared_with_t_f_causes_a_warning(plant, lag, said):
    """The warning begins at a tenth of t_f = 30 s."""
    tables = {"plant": {"kind": plant}, "controller": {"t_f": 30.0}, "loop": {"mode": "sampled"}}
    found = plausibility.warnings(scenario.from_tables({**tables, "hardware": {"torque_lag": lag}}))
    assert [f"hardware.torque_lag is {lag:g} s" in one and f'"{lag:g} ms"' in one for one in found] == [True] * said


@pytest.mark.parametrize(("noise", "said"), [(10.0, True), (0.1, True), (1e-2, False), ("10 arcsec", False)])
def test_an_implausible_star_tracker_noise_causes_a_warning(noise, said):
    tracker, gyro = {"kind": "star_tracker", "noise_across": noise}, {"kind": "gyro", "rate_noise": 1e-6}
    devices = {"hardware.attitude_noise": {"hardware": {"attitude_noise": noise, "rate_noise": 0.0}},
               "sensors[0].noise_across": {"sensors": [tracker, gyro]}}  # fmt: skip
    for key, tables in devices.items():
        read = scenario.from_tables({"loop": {"mode": "sampled"}, **tables})
        found = [one for one in plausibility.warnings(read) if "another unit" in one]
        assert len(found) == said
        assert not said or (found[0].startswith(key) and f'"{noise:g} arcsec"' in found[0])


@pytest.mark.parametrize(
    ("key", "noise", "said"),
    [
        ("rate_noise_density", 0.1, True),  # 0.1 deg/sqrt(h) without its unit
        ("rate_noise_density", 0.016, True),  # 5.02 deg
        ("rate_noise_density", 0.0158, False),  # 4.96 deg
        ("rate_noise_density", "0.5 deg/sqrt(h)", False),  # a poor gyro
        ("rate_noise", 0.1, True),  # 0.1 deg/s without its unit
        ("rate_noise", 0.072, True),  # 5.05 deg
        ("rate_noise", 0.071, False),  # 4.98 deg
        ("rate_noise", "0.1 deg/s", False),
    ],
)
def test_a_gyro_noise_that_integrates_to_a_large_angle_causes_a_warning(key, noise, said):
    """The angle is density * sqrt(t_f) = noise * sqrt(period * t_f), here with t_f = 30 s and a period of 0.05 s."""
    tracker, gyro = {"kind": "star_tracker", "noise_across": 1e-5}, {"kind": "gyro", key: noise}
    devices = {"hardware": {"hardware": {key: noise}}, "sensors[1]": {"sensors": [tracker, gyro]}}
    for place, tables in devices.items():
        read = scenario.from_tables({"loop": {"mode": "sampled"}, **tables})
        found = [one for one in plausibility.warnings(read) if "another unit" in one]
        assert [one.startswith(f"{place}.{key} is {noise} rad/s") for one in found] == [True] * said


SURFACE = {"t_f": 60.0, "surface_rate": 1.0}


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"controller": {"surface_rate": 1.0}}, True),  # c h = 5
        ({}, False),  # the default is designed for the period
        ({"controller": {"surface_rate": 0.39}}, False),
        ({"controller": {"surface_rate": 0.41}}, True),
        ({"controller": {"surface_rate": 0.39}, "hardware": {"delay": 1}}, True),  # with this delay c h must be below 1
        ({"controller": {"surface_rate": 1.0, "sampling": "implicit"}}, False),
        ({"controller": {"kind": "pd"}}, False),
        ({"plant": {"kind": "chain", "order": 2}, "controller": {**SURFACE, "a": [0.1]}}, False),
        ({"plant": {"kind": "chain", "order": 2}, "controller": {**SURFACE, "a": [0.5]}}, True),
    ],
    ids=str,
)
def test_a_surface_rate_without_a_stable_k1_causes_a_warning(changes, said):
    """Without delay a stable K1 exists if c h < 2, and for a chain of order 2 if c a_1 h < 2."""
    law = {"t_f": 300.0, **changes.get("controller", {})}
    tables = {"loop": {"mode": "sampled", "period": 5.0}, "disturbance": QUIET, **changes, "controller": law}
    if "plant" in changes:
        del tables["disturbance"]
    found = [one for one in plausibility.warnings(scenario.from_tables(tables)) if "surface_rate" in one]
    assert len(found) == said


@pytest.mark.parametrize("damping", [0.1, 0.03, 0.003])  # p t_f / 3.5 is 1.6, 0.48 and 0.048
def test_default_bounds_extend_to_slow_gains_if_a_flexible_mode_needs_them(damping):
    """A late mode limits the pole of the hold phase to p = z w / (2 k), k the inertia of mode over hub."""
    base = {
        "spacecraft": {"inertia": [100.0, 100.0, 100.0]},
        "controller": {"t_f": 100.0},
        "loop": {**SAMPLED, "period": 0.5},
        "tune": {},
    }
    modes = {"frequency": [2.0], "damping": [damping], "coupling": [[math.sqrt(80.0), 0.0, 0.0]]}
    pole = damping * 2.0 / math.sqrt(0.2) / (2.0 * 4.0)  # 80 of 100 kg m^2: k = 80 / 20, and the body is free
    rigid, flexible = scenario.from_tables(base), scenario.from_tables({**base, "flexible": modes})
    for name in ("observer_gain", "k1", "surface_rate"):
        ratio = flexible.search.bounds[name][0] / rigid.search.bounds[name][0]
        assert ratio == pytest.approx(min(1.0, max(0.1, pole * 100.0 / 3.5)), rel=1e-9)
