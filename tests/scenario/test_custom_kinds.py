"""Custom laws, observers, disturbances and references: keys and gains of their classes, and runs with them."""

import dataclasses
import pickle
import shutil
import tomllib
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import ptsmc_jax as ptsmc
from ptsmc_jax import scenario
from ptsmc_jax.campaigns import montecarlo
from ptsmc_jax.laws.base import Sample
from ptsmc_jax.onboard.board import build_board
from ptsmc_jax.scenario import custom, custom_checks, mission, parsing, reading, systems
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.simulation import rollout
from tests.helpers import ROOT, SHORT, SHORT_CHAIN, short, small_search, vector
from tests.scenario.bad_scenarios import check_sentence
from tuning.search import gains
from tuning.studies import posing, stability

HEAD = "import jax.numpy as jnp\nimport ptsmc_jax as ptsmc\n\n"
LAW = """
class Mine(ptsmc.AccelerationLaw):
    '''The paper's law.'''

    eta: float = ptsmc.gain(3.0, (2.1, 6.0), above=2.0)
    delta: float = ptsmc.gain(0.5, (0.1, 2.0), unit="s")
    k1: float = ptsmc.gain(1.0, lambda t_f, h: (1.0 / t_f, 0.5 / h), unit="1/s", meaning="rate of s")
    width: float = 1e-3

    def acceleration(self, now, error, error_rate, bound):
        left = jnp.where(now.hold, 1.0, self.t_f - now.t)
        s = left * error_rate + jnp.where(now.hold, 1.0, self.eta) * error
        a = jnp.where(now.hold, 2.0, 2.0 * (self.eta - 1.0) / left)
        b = jnp.where(now.hold, self.k1, 2.0 * self.eta / left**2)
        wanted = -2.0 * bound * jnp.tanh(s * (1.0 / self.width)) - a * error_rate - b * s
        return 0.5 * wanted, s
"""
SAMPLED = {"mode": "sampled", "period": 0.1, "t_end": 6.5}
CHAIN = {"plant": {"kind": "chain", "order": 2, "x0": [1.0, 0.0]}, "loop": SAMPLED}
MINE = {"kind": "custom", "code": "mine.py:Mine", "t_f": 5.0}
# the law above instead of the published law, without the keys that only the published law has
SHORT_CUSTOM = SHORT.replace("[controller]\n", '[controller]\nkind = "custom"\ncode = "mine.py:Mine"\n').replace(
    "surface_rate = 1.0\nsign_width = 1e-3\n", ""
)
FILES = {"mine.py": HEAD + LAW}
pytestmark = pytest.mark.usefixtures("here")


def made(file, name) -> Any:
    """Return the object with this name in a custom file; file: its path."""
    return systems.load_object(f"{file}:{name}", systems.NAME_FORMS)


def simulated(tables, record=True):
    """Return the result of the simulation of a scenario with these tables, with its history by default."""
    return rollout.simulate_parts(scenario.study(scenario.from_tables(tables)).parts, record=record)


@pytest.mark.parametrize("plant", short(["chain", "spacecraft"], ["chain"]))
def test_the_published_law_as_a_custom_law_gives_the_same_run(plant):
    tables = tomllib.loads(SHORT if plant == "spacecraft" else SHORT_CHAIN)
    del tables["tune"]
    if plant == "chain":
        tables |= {"disturbance": {"kind": "sinusoid"}, "observer": {"kind": "nonlinear", "gain": [10.0]}}
    error, rate = ({"error": "additive"}, 1.5) if plant == "spacecraft" else ({}, 0.75)  # k1 of (29) is half of (60)'s
    both = []
    constants = {"surface_rate": 1.0, "sign_width": 1e-3, "layer_time": 1.0}  # of the custom law
    published = {"kind": "prescribed_time", "t_f": 5.0, "k1": rate, **constants}
    for law in (MINE | error | {"k1": 1.5}, published):
        both.append(simulated({**tables, "controller": {**law, "eta": 2.7, "delta": 0.5}}))
    # equal to the last bit with the settings of `ptsmc`; here two programs may fuse differently, and gains amplify it
    for mine, builtin in zip(*map(jax.tree.leaves, both), strict=True):
        np.testing.assert_allclose(mine, builtin, rtol=1e-9, atol=1e-10)


def test_a_class_that_is_a_registered_pytree_can_be_a_custom_part(here):
    """Classes that are used from Python can be registered by the user."""
    (here / "said.py").write_text(
        "from dataclasses import dataclass\nfrom ptsmc_jax.numerics.pytrees import pytree\n"
        + HEAD
        + OTHER.replace("class Wave(", "@pytree\n@dataclass(frozen=True)\nclass Wave(")
    )
    (here / "other.py").write_text(HEAD + OTHER)
    one, other = (simulated({**CHAIN, "disturbance": {"kind": "custom", "code": f"{file}.py:Wave"}}, record=False)
                  for file in ("said", "other"))  # fmt: skip
    assert one.metrics.effort == other.metrics.effort > 0.0


def test_reading_a_scenario_runs_no_custom_code_and_completing_it_finds_keys_gains_and_bounds():
    """A completed scenario stays complete after a change, and is equal after writing and reading."""
    (systems.Path("mine.py")).write_text(HEAD + "raise RuntimeError('was run')\n" + LAW)
    tables = {**CHAIN, "controller": {**MINE, "k1": 2}, "tune": {"trials": 8}}
    loaded = scenario.from_tables(tables)
    assert custom.has_unloaded_code(loaded)
    assert parsing.dump(loaded)["controller"]["k1"] == 2
    with pytest.raises(ScenarioError, match=r"controller\.code is .* running mine\.py fails: RuntimeError"):
        reading.complete(loaded)
    (systems.Path("mine.py")).write_text(HEAD + LAW)
    whole = reading.complete(loaded)
    assert not custom.has_unloaded_code(whole)
    assert reading.complete(whole) is whole
    assert whole.controller.k1 == 2.0
    assert whole.controller.eta == 3.0
    assert whole.tune is not None
    assert whole.tune.free == ("delta", "eta", "k1")
    assert dict(whole.tune.bounds) == {"eta": (2.1, 6.0), "delta": (0.1, 2.0), "k1": (0.2, 5.0)}
    assert gains.units_of(whole, ["k1", "eta"]) == {"k1": "1/s", "eta": "-"}
    again = scenario.replace(whole, controller__eta=4.0)  # stays complete
    assert again.controller.eta == 4.0
    assert reading.complete(scenario.from_tables(parsing.dump(whole))) == whole


def test_custom_numbers_have_units_and_custom_gains_have_bounds(here):
    declared = LAW.replace("width: float = 1e-3", 'width: float = ptsmc.number(1e-3, above=0.0, unit="s", meaning="w")')
    declared = declared.replace("(2.1, 6.0), above=2.0", '"eta", above=2.0')
    (here / "mine.py").write_text(HEAD + declared)
    tables = {**CHAIN, "controller": {**MINE, "width": "2 ms"}, "tune": {"free": ["eta"]}}
    found = reading.complete(scenario.from_tables(tables))
    assert found.controller.width == 2e-3
    assert found.search.bounds["eta"] == (2.05, 8.0)  # the bounds of the built-in law for order 2
    with pytest.raises(ScenarioError, match=r"controller\.width is 0\.0, but must be a number greater than 0"):
        reading.complete(scenario.from_tables({**tables, "controller": {**MINE, "width": 0.0}}))


def test_a_scenario_with_custom_code_can_be_pickled_before_and_after_the_code_runs(here):
    (here / "mine.toml").write_text('controller = { kind = "custom", code = "mine.py:Mine" }\nloop.mode = "sampled"\n')
    waits = ptsmc.read("mine.toml")
    for read in (waits, reading.complete(waits)):
        again = pickle.loads(pickle.dumps(read))
        assert again == read
        assert custom.has_unloaded_code(again) == custom.has_unloaded_code(read)


def test_default_gains_of_a_custom_law_are_reported_as_defaults_of_its_class():
    """They do not follow from the numbers of the scenario, unlike the default gains of other laws."""
    without_gains, with_gain = (
        reading.complete(scenario.from_tables({**CHAIN, "controller": {**MINE, **law}})) for law in ({}, {"eta": 3.0})
    )
    assert "its class" in str(mission.describe_default_gains(without_gains))
    assert mission.describe_default_gains(with_gain) is None


def test_custom_gains_can_be_set_in_parts_and_in_the_scenario():
    """Gains of a law and of an observer have names, units and present values."""
    file = ROOT / "scenarios" / "own_parts.py"
    tables = {
        **CHAIN,
        "controller": {"kind": "custom", "code": f"{file}:Scaling", "t_f": 5.0, "delta": 0.5},
        "observer": {"kind": "custom", "code": f"{file}:LowPass"},
        "tune": {"trials": 8},
    }
    whole = reading.complete(scenario.from_tables(tables))
    assert whole.tune is not None
    assert whole.tune.free == ("delta", "m", "k1", "k", "observer_rate")
    parts = scenario.study(whole).parts
    moved = gains.with_gains(parts, {"k1": 0.25, "observer_rate": 3.5})
    assert (moved.controller.k1, moved.observer.rate) == (0.25, 3.5)
    assert gains.gains_of(moved) == {
        "delta": 0.5, "m": 1.0, "k1": 0.25, "k": 1e-3, "observer_rate": 3.5, "t_f": 5.0,
    }  # fmt: skip
    assert gains.present_values(moved, gains.free_gain_names(whole)) == [0.5, 1.0, 0.25, 1e-3, 3.5]
    written = gains.in_scenario(whole, {"m": 2.0, "observer_rate": 4.0})
    assert (written.controller.m, written.observer.rate) == (2.0, 4.0)
    assert gains.units_of(whole, ["observer_rate"]) == {"observer_rate": "1/s"}


SIGNED = """
class Signed(ptsmc.AccelerationLaw):
    '''A constant beside PD.'''

    lead: float = ptsmc.gain(0.0, (-1.0, 1.0), above=-float("inf"))

    def acceleration(self, now, error, error_rate, bound):
        return self.lead - error - error_rate, error
"""


@pytest.mark.parametrize(("value", "bounds"), [(0.5, (-1.0, 1.0)), (-3.0, (-4.0, 1.0)), (2.0, (-1.0, 7.0))])
def test_default_bounds_of_a_gain_of_any_sign_contain_its_value(here, value, bounds):
    (here / "signed.py").write_text(HEAD + SIGNED)
    law = {"kind": "custom", "code": "signed.py:Signed", "t_f": 5.0, "lead": value}
    whole = reading.complete(scenario.from_tables({**CHAIN, "controller": law, "tune": {}}))
    assert whole.tune is not None
    assert whole.tune.bounds == {"lead": bounds}


OTHER = """
class Filtered(ptsmc.SampledObserver):
    '''The mean of the last two periods.'''

    share: float = ptsmc.gain(0.5, (0.1, 0.9), below=1.0)

    def begin(self):
        return {"last": jnp.zeros(1), "estimate": jnp.zeros(1)}

    def step(self, memory, d_mean, t, dt):
        return {"last": d_mean, "estimate": self.share * d_mean + (1.0 - self.share) * memory["last"]}

    def estimate(self, memory):
        return memory["estimate"]


class Wave(ptsmc.Disturbance):
    '''A sinusoid.'''

    size: float = 0.02
    rates: tuple = (0.5, 1.5)

    def __call__(self, t, x):
        return self.size * (jnp.sin(self.rates[0] * t) + jnp.sin(self.rates[1] * t)) * jnp.ones(1)

    def fastest(self):
        return float(self.rates[1])


class Steady(ptsmc.Disturbance):
    '''Constant.'''

    def __call__(self, t, x):
        return 0.01 * jnp.ones(3)


class Turning(ptsmc.Reference):
    '''Turns about z.'''

    rate: float = 0.03

    def attitude(self, t):
        half = 0.5 * self.rate * t
        return jnp.stack([0.0 * half, 0.0 * half, jnp.sin(half), jnp.cos(half)])
"""


@pytest.mark.parametrize("what", ["amplitude", "phase"])
def test_only_declared_numbers_of_a_custom_disturbance_are_dispersed(here, what):
    """A key with the name phase or amplitude alone does not suffice."""
    how = {"amplitude": "relative_normal", "phase": "uniform"}[what]
    tables = {
        **CHAIN,
        "disturbance": {"kind": "custom", "code": "other.py:Wave"},
        "dispersion": {f"disturbance_{what}": {"kind": how}},
    }
    named = OTHER.replace("size", what)
    (here / "other.py").write_text(HEAD + named)
    with pytest.raises(ScenarioError, match=f"dispersion.disturbance_{what} needs a disturbance that has"):
        scenario.study(scenario.from_tables(tables))
    said = f"    drawn = {{'{what}': '{what}'}}\n    {what}: float = 0.02"
    (here / "other.py").write_text(HEAD + named.replace(f"    {what}: float = 0.02", said))
    ready = scenario.study(scenario.from_tables(tables))
    simulated = [ready.dispersion.apply(ready.parts, 0, trial).disturbance for trial in range(2)]
    assert getattr(simulated[0], what) != getattr(simulated[1], what)


@pytest.mark.parametrize("beside", ["none", "random_walk"])
def test_sum_of_a_custom_disturbance_and_a_term_without_a_signal_is_the_custom_disturbance(here, beside):
    """A random walk is not a function of time, so it is not part of the sum."""
    (here / "other.py").write_text(HEAD + OTHER)
    terms = [{"kind": "custom", "code": "other.py:Wave"}, {"kind": beside}]
    ready = scenario.study(scenario.from_tables({**CHAIN, "disturbance": {"kind": "sum", "terms": terms}}))
    assert type(ready.parts.disturbance).__name__ == "Wave"


def test_a_custom_disturbance_and_observer_match_built_in_parts_and_a_loop_by_hand(here):
    """The built-in sum of two sinusoids gives the same run, and a loop by hand gives the observer's memory."""
    (here / "other.py").write_text(HEAD + OTHER)
    law = {"kind": "pd", "k_p": 2.0, "k_d": 2.0, "t_f": 5.0}
    custom_one = {**CHAIN, "controller": law, "disturbance": {"kind": "custom", "code": "other.py:Wave", "size": 0.03}}
    waves = [{"kind": "sinusoid", "amplitude": [0.03], "frequency": [w], "phase": [0.0]} for w in (0.5, 1.5)]
    known = {**CHAIN, "controller": law, "disturbance": {"kind": "sum", "terms": waves}}
    one, other = (simulated(tables) for tables in (custom_one, known))
    np.testing.assert_allclose(one.log.x, other.log.x, rtol=0, atol=1e-14)
    steps = [scenario.study(scenario.from_tables(tables)).parts.substeps for tables in (custom_one, known)]
    assert steps[0] == steps[1]  # `fastest` sets the steps like the keys of the built-in sum

    watched = simulated({**custom_one, "observer": {"kind": "custom", "code": "other.py:Filtered", "share": 0.7}})
    kept = np.asarray(watched.log.has_length)
    t, x, u = (np.asarray(v)[kept] for v in (watched.log.t, watched.log.x, watched.log.u))
    seen = np.diff(x[:, 1]) / np.diff(t) - u[:-1, 0]  # x_2' = u + d: the mean of d over each period
    wanted = 0.7 * seen[1:] + 0.3 * seen[:-1]
    np.testing.assert_allclose(np.asarray(watched.log.d_hat)[kept][2:-1, 0], wanted[:-1], atol=1e-12)


def test_bounds_that_depend_on_a_custom_reference_are_known_after_its_code_has_run(here):
    """Reading a scenario runs no code, so the rate of the reference is unknown until then."""
    (here / "other.py").write_text(HEAD + OTHER)
    shared = {"loop": SAMPLED, "controller": {"t_f": 5.0}}
    waiting = {**shared, "reference": {"kind": "custom", "code": "other.py:Turning", "rate": 0.03}}
    spin = {**shared, "reference": {"kind": "spin", "rate": [0.0, 0.0, 0.03]}}
    there = {"kind": "custom", "code": made("other.py", "Steady")}
    for acting in ({"kind": "gravity_gradient", "orbit_rate": 1e-2}, there):
        loaded = scenario.from_tables({**waiting, "disturbance": acting})
        assert loaded.controller.disturbance_rate_bound is None
        # `fastest` of the reference returns nothing; a steady rotation does not need it
        known = reading.complete(scenario.from_tables({**spin, "disturbance": acting})).controller
        found = reading.complete(loaded).controller
        assert found.disturbance_bound == known.disturbance_bound > 0.0
        assert 0.0 <= found.disturbance_rate_bound <= known.disturbance_rate_bound


def test_a_custom_reference_has_exact_rates(here):
    (here / "other.py").write_text(HEAD + OTHER)
    start = {"rotvec_deg": [10.0, 20.0, -30.0]}
    tables = {"loop": {**SAMPLED}, "controller": {"kind": "pd", "t_f": 5.0}}
    turning = {**tables, "reference": {"kind": "custom", "code": "other.py:Turning", **start}}
    spin = {**tables, "reference": {"kind": "spin", "rate": [0.0, 0.0, 0.03], **start}}
    for t in (0.0, 2.5):
        one, other = (
            scenario.study(scenario.from_tables(which)).parts.reference(jnp.asarray(t)) for which in (turning, spin)
        )
        for mine, known in zip(one, other, strict=True):
            np.testing.assert_allclose(mine, known, atol=1e-15)


REMEMBERS = LAW.replace(
    "def acceleration(self, now,", "def begin(self):\n        return jnp.zeros(1)\n\n    def acceleration(self, now,"
)
RETURNS = "return 0.5 * wanted"
# a part of the law, what replaces it, and the expected text about it and about the allowed values
# fmt: off
CHANGED = [
    (f"{RETURNS}, s", "return jnp.zeros(2), s", "acceleration returns (real(2,), real(1,))", "(real(1,), real(1,))"),
    (f"{RETURNS}, s", "return [0.5 * wanted[0]], s", "returns ([real()], real(1,))", "form (real(1,), real(1,))"),
    (f"{RETURNS}, s", "return [0.5 * wanted, s]", "returns [real(1,), real(1,)]", "an acceleration and a sliding"),
    (f"{RETURNS}, s", RETURNS, "returns real(1,)", "an acceleration and a sliding variable"),
    (f"{RETURNS}, s", "0.5 * wanted, s", "acceleration returns nothing", "a sliding variable"),
    # an earlier version ran this as 0 and 1, and margins ended in a traceback
    (f"{RETURNS}, s", f"{RETURNS}, s > 0.0", "returns (real(1,), bool(1,))", "of the form (real(1,), real(1,))"),
    # an earlier error named the class MineOnErrorOfChain
    (RETURNS, "return self.width_ * wanted", "AttributeError: 'Mine' object has no attribute 'width_'", "line 21 of"),
    ("def acceleration", "def accelerate", "the class Mine has no method", "acceleration or __call__"),
    (f"{RETURNS}, s", "return 1 / 0 * wanted, s", "acceleration fails", "line 21 of mine.py"),
    (f"{RETURNS}, s", f"{RETURNS}, s, now.memory + error", "NoneType", "needs a method begin"),
    ("gain(3.0,", "gain(7.0,", "the default of eta is 7", "inside its usual bounds, 2.1 to 6"),
    ("    width: float", "    k_i = ptsmc.gain(0.1, (0.01, 1.0))\n    width: float", "cannot have", "type annotation"),
    (RETURNS, "exit(0)", "acceleration fails: SystemExit", "line 21 of mine.py"),
    (RETURNS, "return jnp.log(-1.0) * wanted", "returns [nan]", "finite numbers"),
    (RETURNS, "return wanted if wanted[0] > 9.0 else 0.5 * wanted", "needs the value of a traced number",
     "jax.numpy.where instead of if"),
    (RETURNS, "return float(wanted[0]) * wanted", "needs the value", "jax.numpy instead of numpy and float()"),
    ("        left =", "        kept.append(error)\n        error = kept[-2:][0]\n        left =",
     "whose acceleration stores a traced number", "memory"),
    ("3.0, (2.1, 6.0), above=2.0", "3.0", "the gain eta of the class Mine has no bounds", "usual=(lower, upper)"),
    ("(2.1, 6.0)", "(6.0, 2.1)", "usual bounds of the gain eta of the class Mine are [6, 2.1]", "lower one first"),
    # an earlier error named tune.bounds.eta, which is not in the file
    ("(2.1, 6.0)", "(2.0, 6.0)", "usual bounds of the gain eta of the class Mine are [2, 6]", "numbers greater than 2"),
    ("lambda t_f, h: (1.0 / t_f, 0.5 / h)", "lambda t_f: 1.0", "usual bounds of the gain k1", "TypeError"),
    ("(2.1, 6.0)", "(2.1, 4.0, 6.0)", "usual bounds of the gain eta of the class Mine are [2.1, 4, 6]", "two numbers"),
    # an earlier version ended in a KeyError, or in an AttributeError if the name belongs to a law with other fields
    *(("(2.1, 6.0)", f'"{name}"', f'the gain eta of the class Mine are "{name}"', '"eta", "k1", "sign_width"')
      for name in ("etta", "fixed_time_p")),
    ("gain(3.0,", "gain(1.0,", "the default of eta is 1", "a number greater than 2"),
    ("width: float = 1e-3", "width: str = 'x'", 'the default of width is "x"', "one number or several"),
    ("width: float = 1e-3", "width: float", "cannot have such fields", "width"),
    *(("width: float", f"{name}: float", f"the class Mine has a field {name}", "already uses")
      for name in ("code", "check", "order")),
    ("width: float", "kinematics: float", "the class Mine cannot have such fields", "the base class does not use"),
    ("width: float = 1e-3", "t_f: float = 1.0", "the class Mine has a field t_f", "another name"),
    (RETURNS, "return 1j * wanted", "returns (complex128(1,), real(1,))", "form (real(1,), real(1,))"),
]
# the code, other keys of the scenario, and the expected text
BAD = [
    *((f"kept = []\n\n{LAW.replace(old, new)}", {}, *said) for old, new, *said in CHANGED),
    ("Mine = [3]", {}, "it is of type list, but must be a class derived from", "ptsmc_jax.AccelerationLaw"),
    (LAW, {"eta": float("nan")}, "controller.eta is nan", "finite numbers"),
    ("Mine = 3", {}, "it is of type int, but must be a class derived from", "ptsmc_jax.AccelerationLaw"),
    ("class Mine:\n    pass", {}, "it is a class Mine, but must be a class derived from", "ptsmc_jax.AccelerationLaw"),
    ("Other = 3", {}, "mine.py has no such name", "FILE.py:NAME"),
    ("x = = 1", {}, "running mine.py fails: SyntaxError", "mine.py"),
    (LAW, {"etta": 3.0}, "controller.etta is not a known key", "controller.eta"),
    (LAW, {"eta": 1.5}, "controller.eta is 1.5", "greater than 2"),
    (LAW, {"code": "gone.py:Mine"}, "the file gone.py does not exist", "gone.py"),
    (LAW, {"code": "mine"}, 'controller.code is "mine"', "FILE.py:NAME"),
    (LAW, {"code": None}, "controller.code is absent", "FILE.py:NAME"),
    (REMEMBERS, {}, "acceleration returns (real(1,), real(1,))", "an acceleration, a sliding variable and its memory"),
    (REMEMBERS.replace("wanted, s", "wanted, s, jnp.zeros(2)"), {}, "returns (real(1,), real(1,), real(2,))", "1,))"),
]
# fmt: on


@pytest.mark.parametrize(
    ("law", "keys", "of_what", "allowed"), BAD, ids=[f"{k} {row[2][:40]}" for k, row in enumerate(BAD)]
)
def test_errors_in_a_custom_law_are_one_sentence(here, law, keys, of_what, allowed):
    assert law not in (LAW, f"kept = []\n\n{LAW}") or keys
    (here / "mine.py").write_text(HEAD + law)
    controller = {key: value for key, value in {**MINE, **keys}.items() if value is not None}
    tables = {**CHAIN, "controller": controller, **({"tune": {}} if "usual bounds" in of_what else {})}
    with pytest.raises(ScenarioError) as caught:
        scenario.study(scenario.from_tables(tables))
    check_sentence(str(caught.value).replace("Error", ""), of_what.replace("Error", ""), allowed.replace("Error", ""))


# a part of OTHER, what replaces it, and the expected text, by the table that names the class
# fmt: off
OTHERS = {
    "observer": [
        ('return {"last": d_mean,', 'return {"last": jnp.zeros(3),', "observer.code is"),
        ("def step", "def stop", "has no method step"),
        ("share: float", "gain: float", "needs another name"),
        ("    share: float", "    gain: float = 0.5\n    share: float", "needs another name"),
        ("    share: float", "    gain: tuple = (0.5,)\n    share: float", "needs another name"),
        ("share: float", "gain_2: float", "needs another name"),
        ("share: float", "update: float", "the class Filtered has a field update, a name that"),
        ("def estimate", "def error_bound(self):\n        return lambda t: 0.1\n\n    def estimate",
         "error_bound returns a function at t = 0, but must return a bound such as"),
    ],
    "disturbance": [
        ("float(self.rates[1])", "'fast'", 'disturbance.code is the class Wave, whose method fastest returns "fa'),
        ("float(self.rates[1])", "None", "fastest returns nothing, but must return an angular frequency"),
        ("float(self.rates[1])", "float('nan')", "whose method fastest returns nan"),
        ("float(self.rates[1])", "-1.0", "whose method fastest returns -1.0"),
        ("* jnp.ones(1)", "* jnp.ones(3)", "__call__ returns real(3,)"),
        ("jnp.sin(self.rates[0] * t)", "jnp.log(-1.0)", "__call__ returns [nan]"),
        ("(0.5, 1.5)", "(0.5, 1e9)", "disturbance.frequency"),
    ],
    "reference": [
        ("jnp.cos(half)", "2.0 * jnp.cos(half)", "a quaternion of length 1"),
        ("jnp.stack([0.0 * half, ", "jnp.stack([", "(4,)"),
        ("    def attitude", "    def fastest(self):\n        pass\n\n    def attitude",
         "Turning, whose method fastest returns nothing"),
        ("jnp.cos(half)", "jnp.where(t > 3.0, jnp.nan, jnp.cos(half))", "its attitude is not finite at t = 3.0"),
    ],
}
# fmt: on
CLASSES = {"observer": "Filtered", "disturbance": "Wave", "reference": "Turning"}


@pytest.mark.parametrize(("name", "old", "new", "said"), [(name, *row) for name in OTHERS for row in OTHERS[name]])
def test_errors_in_other_custom_parts_are_one_sentence(here, name, old, new, said):
    assert old in OTHER
    (here / "other.py").write_text(HEAD + OTHER.replace(old, new))
    law = {} if "not finite" in said else {"kind": "pd"}  # the published law once reported a singularity here
    plant = {"loop": SAMPLED} if name == "reference" else CHAIN
    tables = {**plant, "controller": {**law, "t_f": 5.0}, name: {"kind": "custom", "code": f"other.py:{CLASSES[name]}"}}
    with pytest.raises(ScenarioError) as caught:
        scenario.study(scenario.from_tables(tables))
    assert said in str(caught.value) or "disturbance is too fast" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_scenario_with_a_class_made_in_python_cannot_be_written(here):
    made_here = ptsmc.replace(
        scenario.from_tables(CHAIN), controller={"kind": "custom", "code": made("mine.py", "Mine")}
    )
    with pytest.raises(ScenarioError, match=r'^controller\.code is "<Mine made in Python>", but must be the name of'):
        ptsmc.write(made_here, "s.toml")
    assert not (here / "s.toml").exists()


def test_errors_in_custom_code_during_a_run_are_one_sentence(command, here, monkeypatch):
    """JAX finds a traced number in a list during the run. The error names the custom file."""
    monkeypatch.setattr(systems, "_executed_paths", set())
    kept = LAW.replace("        left =", "        kept.append(error)\n        error = kept[-4:][0]\n        left =")
    (here / "mine.py").write_text(HEAD + "kept = []\n\n\ndef fails():\n    return 1 / 0\n" + kept)
    (here / "s.toml").write_text(SHORT_CUSTOM)
    code, _, error = command("simulate", "s.toml", "--no-figures", "--quiet")
    assert code == 2
    runs, refused = error.splitlines()
    assert runs == f"ptsmc: runs {here}/mine.py, which controller.code of s.toml names"
    check_sentence(refused.removeprefix("ptsmc: "), f"{here}/mine.py stores a traced number", "its memory")
    assert not (here / "out").exists()
    with pytest.raises(ZeroDivisionError) as caught:
        made("mine.py", "fails")()
    assert systems.find_faulty_file(caught.value) == str(here / "mine.py")
    with pytest.raises(ZeroDivisionError) as caught:
        raise ZeroDivisionError
    assert systems.find_faulty_file(caught.value) is None
    with pytest.raises(ValueError, match="JVP") as no_slopes:  # as in a search: the traceback contains only JAX
        jax.jvp(lambda x: jax.pure_callback(lambda x: x, x, x), (1.0,), (1.0,))
    assert systems.find_faulty_file(no_slopes.value) == str(here / "mine.py")
    with pytest.raises(NotImplementedError) as no_batches:  # as in a campaign
        jax.vmap(lambda x: jax.pure_callback(lambda x: x, x, x))(jnp.zeros(2))
    assert systems.find_faulty_file(no_batches.value) == str(here / "mine.py")


def changed_law(here, command):
    """Return the tables of a scenario whose law returns this acceleration, a Python expression."""
    body = f"import jax\n{HEAD}{LAW}".replace("return 0.5 * wanted, s", f"return {command}, s")
    (here / "mine.py").write_text(body)
    return {**CHAIN, "controller": MINE}


@pytest.mark.parametrize(("command", "reason"), [
    ("jax.lax.stop_gradient(wanted)", "zero derivatives"),
    ("jnp.round(1e4 * wanted) / 1e4", "zero derivatives"),
    ("-jnp.sign(s)", "zero derivatives"),
    ("0.5 * wanted", None),
    ("jnp.clip(wanted, -1e-4, 1e-4)", None),  # saturated at t = 0
    ("jnp.where(jnp.abs(error) < 0.05, 0.0, wanted)", None),  # a dead zone
    ("-jnp.sign(s) - error", None),
])  # fmt: skip
def test_margins_of_a_law_without_a_derivative_are_refused(here, command, reason):
    """An earlier version reported the margins of the loop without the law, and an unstable loop."""
    tables = changed_law(here, command)
    required = scenario.from_tables({**tables, "requirements": {"gain_margin": 6.0}})
    ready = scenario.study(scenario.from_tables(tables))
    missing = custom_checks.describe_missing_derivative(ready.parts, ready.scenario)
    if reason is None:
        assert missing is None
        scenario.study(required)
        return
    assert missing is not None
    for refuse, name in ((scenario.study, "requirements.gain_margin"), (stability.find_margins, "")):
        with pytest.raises(ScenarioError) as caught:
            refuse(required if name else ready.scenario)
        check_sentence(str(caught.value).replace("Error", ""), f"{name}", reason)
        assert 'controller.code is "mine.py:Mine"' in str(caught.value)
    assert stability.worst_margins(ready) is None
    tuned = posing.set_up_tuning(posing.with_tune(ready.scenario), 0)
    assert not tuned.settings.with_gradients  # differential evolution


@pytest.mark.parametrize(("command", "is_finite"), [
    ("wanted - jnp.linalg.norm(error_rate) * error_rate", False), ("wanted - jnp.sum(error_rate**2) * error_rate", True)
])  # fmt: skip
def test_a_derivative_that_is_not_finite_at_rest_is_described(here, command, is_finite):
    ready = scenario.study(scenario.from_tables(changed_law(here, command)))
    assert custom_checks.describe_missing_derivative(ready.parts, ready.scenario) is None
    assert (custom_checks.describe_infinite_derivative(ready.parts, ready.scenario) is None) == is_finite


def test_margins_and_tuning_of_a_law_that_jax_cannot_differentiate_are_refused(here):
    """An earlier message named all custom files instead of the class."""
    tables = changed_law(here, "jax.pure_callback(lambda v: v, wanted, wanted)")
    tuned = posing.with_tune(scenario.study(scenario.from_tables(tables)).scenario)
    required = scenario.from_tables({**tables, "requirements": {"gain_margin": 6.0}})
    for refuse in (
        lambda: stability.find_margins(tuned),
        lambda: scenario.study(required),
        lambda: posing.set_up_tuning(tuned, 0),
    ):
        with pytest.raises(ScenarioError, match=r"mine.py:Mine.* acceleration cannot be differentiated: ValueError"):
            refuse()


def test_a_law_that_reacts_through_its_memory_has_a_derivative(here):
    """The command is the error of the sample before."""
    late = REMEMBERS.replace("return 0.5 * wanted, s", "return -now.memory, s, error")
    (here / "mine.py").write_text(HEAD + late)
    ready = scenario.study(scenario.from_tables({**CHAIN, "controller": MINE}))
    assert custom_checks.describe_missing_derivative(ready.parts, ready.scenario) is None


def test_an_absent_custom_file_is_refused_and_not_reported_as_run(command, here):
    """The error is the only line, so no line reports that the command runs the file."""
    (here / "s.toml").write_text(SHORT_CUSTOM.replace("mine.py", "my/laws.py"))
    code, _, error = command("simulate", "s.toml")
    assert code == 2
    assert error.count("\n") == 1
    assert f"the file {here}/my/laws.py does not exist" in error


def test_custom_code_that_exits_is_a_configuration_error(command, here):
    """An earlier version ended with the status of the custom code, 0, which means that all requirements are met."""
    late = LAW.replace("        left =", "        asked.append(0)\n        if len(asked) > 4: exit(0)\n        left =")
    (here / "mine.py").write_text(HEAD + "asked = []\n" + late)
    (here / "s.toml").write_text(SHORT_CUSTOM)
    code, _, error = command("simulate", "s.toml", "--no-figures", "--quiet")
    assert code == 2
    assert error.splitlines()[1:] == [f"ptsmc: {here}/mine.py fails: SystemExit: 0 (line 16 of mine.py)"]
    assert not (here / "out").exists()


def test_an_unknown_free_gain_is_refused_with_the_gains_of_the_scenario(here):
    """Earlier, the message listed the gains of all built-in laws and not those of the custom law."""
    (here / "mine.py").write_text(HEAD + LAW)
    with pytest.raises(ScenarioError, match=r'"etta"\], but must be a list of some of delta, eta, k1, t_f$'):
        scenario.study(scenario.from_tables({**CHAIN, "controller": MINE, "tune": {"free": ["k1", "etta"]}}))
    with pytest.raises(ScenarioError, match=r"has no k_p; allowed is some of delta, eta, k1, t_f$"):
        scenario.study(scenario.from_tables({**CHAIN, "controller": MINE, "tune": {"free": ["k_p"]}}))


def test_a_scenario_without_gains_is_refused_before_a_search(command, here):
    (here / "mine.py").write_text(HEAD + LAW.split("    eta:")[0] + "    def acceleration(self, now, error, *_):\n"
                                  "        return -error, error\n")  # fmt: skip
    (here / "s.toml").write_text(
        '[plant]\nkind = "chain"\n[controller]\nkind = "custom"\ncode = "mine.py:Mine"\n[observer]\nkind = "none"\n'
        '[loop]\nmode = "sampled"\n'
    )
    for search in ("tune", "pareto"):
        status, _, error = command(search, "s.toml")
        assert (status, error.count("\n")) == (2, 2)  # the first line names the file that is run
        assert "tune.free is absent" in error
        assert "allowed is some of delta, t_f, or a law with" in error
    assert not (here / "out").exists()


@pytest.mark.long
def test_tune_command_changes_gains_of_a_custom_law_and_copies_its_file(command, here, monkeypatch):
    """With the copy, the tuned scenario runs on another computer, but only with the option --trust."""
    small_search(monkeypatch)
    (here / "s.toml").write_text(SHORT_CUSTOM)
    assert command("tune", "s.toml", "--no-figures")[0] in (0, 1)
    found = tomllib.loads((here / "out/tune-s/tuned.toml").read_text())["controller"]
    assert 2.1 <= found["eta"] <= 6.0
    assert found["eta"] != 3.0
    assert found["code"] == "mine.py:Mine"
    (here / "out/tune-s").rename(here / "sent")  # as on another computer without mine.py
    (here / "mine.py").unlink()
    assert command("simulate", "sent/tuned.toml", "--no-figures", "--quiet")[0] == 2
    status, _, error = command("simulate", "sent/tuned.toml", "--no-figures", "--quiet", "--trust")
    assert status in (0, 1)
    assert error == f"ptsmc: runs {here}/sent/mine.py, which controller.code of sent/tuned.toml names\n"


def test_a_custom_law_integrates_the_error_in_its_memory():
    """The result equals the same sum by hand."""

    class Integral(ptsmc.AccelerationLaw):
        k: float = ptsmc.gain(0.3, (0.01, 1.0))

        def begin(self):
            return jnp.zeros(self.model.inputs)

        def acceleration(self, now, error, error_rate, bound):
            memory = now.memory + now.dt * error
            return -2.0 * error - 2.0 * error_rate - self.k * memory, error, memory

    tables = {**CHAIN, "controller": {"kind": "custom", "code": Integral, "t_f": 5.0}}
    log = simulated(tables).log
    kept = np.asarray(log.has_length)
    t, x, u = (np.asarray(v)[kept] for v in (log.t, log.x, log.u))
    total = np.cumsum(np.diff(t) * x[:-1, 0])
    np.testing.assert_allclose(u[:-1, 0], -2.0 * x[:-1, 0] - 2.0 * x[:-1, 1] - 0.3 * total, atol=1e-13)
    assert dataclasses.is_dataclass(Integral)


@pytest.mark.parametrize("clock", ["anchored", "flight"])
def test_the_first_sample_of_a_custom_law_has_the_initial_error(clock):
    """The anchored clock begins with periods of length zero, which must not change the memory."""

    class InitialErrorLaw(ptsmc.AccelerationLaw):
        """A law that stores the first error in its memory and returns it as s."""

        k: float = ptsmc.gain(1.0, (0.1, 2.0))

        def begin(self):
            return jnp.full(self.model.inputs, jnp.nan)

        def acceleration(self, now, error, error_rate, bound):
            start = jnp.where(now.t == 0.0, error, now.memory)
            return -self.k * error - 2.0 * error_rate, start, start

    table = {"kind": "custom", "code": InitialErrorLaw, "t_f": 5.03, "delta": 0.5}  # not a whole number of periods
    log = simulated({**CHAIN, "controller": table, "loop": {**SAMPLED, "clock": clock}}).log
    kept = np.asarray(log.has_length)
    assert kept.any()
    np.testing.assert_array_equal(np.asarray(log.s)[kept], np.asarray(log.x)[kept][0, 0])


def test_new_like_a_scenario_keeps_the_keys_of_custom_parts(command, here):
    for name in ("own_parts.toml", "own_parts.py"):
        shutil.copy(ROOT / "scenarios" / name, here)
    assert command("new", "commented.toml", "--like", "own_parts.toml", "--quiet")[0] == 0
    first, second = (reading.complete(scenario.read(path)) for path in ("own_parts.toml", "commented.toml"))
    assert first == second


def test_fields_of_custom_base_classes_are_keys(here):
    (here / "mine.py").write_text(
        HEAD + LAW.replace("class Mine", "class First") + "\n\nclass Mine(First):\n    pass\n"
    )
    whole = reading.complete(scenario.from_tables({**CHAIN, "controller": {**MINE, "eta": 2.5}}))
    assert set(whole.controller.gains) == {"eta", "delta", "k1", "t_f"}
    assert scenario.study(whole).parts.controller.eta == 2.5


def test_custom_files_import_current_helper_modules_of_their_own_folder(tmp_path):
    """Two folders have a helper with the same name. The acceleration that the law commands shows which helper ran."""
    law = "import helper\n" + HEAD + LAW.replace("return 0.5 * wanted", "return helper.K * wanted")
    for folder, k in (("a", 1.0), ("b", 3.0)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "mine.py").write_text(law)
        (tmp_path / folder / "helper.py").write_text(f"K = {k}\n")

    def asked(folder):
        table = {**MINE, "code": f"{tmp_path / folder / 'mine.py'}:Mine"}
        parts = scenario.study(scenario.from_tables({**CHAIN, "controller": table})).parts
        now = Sample(jnp.zeros(()), jnp.asarray(False), jnp.asarray(0.1))
        return float(parts.controller.acceleration(now, vector([1.0]), vector([0.2]), jnp.asarray(0.1))[0][0])

    one = asked("a")
    assert asked("b") == pytest.approx(3.0 * one, rel=1e-12)
    assert asked("a") == one
    (tmp_path / "a" / "helper.py").write_text("K = 2.0\n")
    assert asked("a") == pytest.approx(2.0 * one, rel=1e-12)


@pytest.mark.parametrize("name", ["observer_rate", "sensors_x", "filter_bandwidth"])
def test_a_custom_law_cannot_reuse_the_gain_name_of_another_part(here, name):
    gain = f"{name}: float = ptsmc.gain(1.0, (0.5, 2.0))\n    width: float"
    (here / "mine.py").write_text(HEAD + LAW.replace("width: float", gain))
    with pytest.raises(ScenarioError, match=f"its gain {name} needs another name"):
        scenario.study(scenario.from_tables({**CHAIN, "controller": MINE}))


def test_a_gain_of_an_observer_can_have_a_name_like_a_gain_of_an_axis(here):
    """An earlier version took it for the gain of an axis, and a search ended in a traceback."""
    low = OTHER.replace("self.share", "self.gain_low").replace("share: float", "gain_low: float")
    (here / "mine.py").write_text(HEAD + low)
    observer = {"kind": "custom", "code": "mine.py:Filtered", "gain_low": 0.7}
    whole = reading.complete(scenario.from_tables({**CHAIN, "observer": observer, "tune": {}}))
    parts = gains.with_gains(scenario.study(whole).parts, {"observer_gain_low": 0.3})
    assert parts.observer.gain_low == 0.3
    assert gains.in_scenario(whole, {"observer_gain_low": 0.4}).observer.gain_low == 0.4
    assert gains.base("observer_gain_low") == "observer_gain_low"
    assert gains.base("observer_gain_2") == "observer_gain"


DETUMBLING = """
class Detumbling(ptsmc.AccelerationLaw):
    '''A torque against the body rate, at any attitude.'''

    k: float = ptsmc.gain(10.0, (1.0, 100.0), unit="N m s")

    def __call__(self, now, x, target, d_hat, k2):
        return -self.k * x.w, x.w, now.memory
"""


def test_a_custom_law_that_returns_a_torque_has_no_singularity(here):
    """An earlier version reported a singularity at an attitude error of 180 deg, where only accelerations have one."""
    (here / "mine.py").write_text(HEAD + DETUMBLING)
    law = {"kind": "custom", "code": "mine.py:Detumbling", "t_f": 5.0}
    tables = {"controller": law, "loop": SAMPLED, "initial": {"rotvec_deg": [0.0, 0.0, 150.0]}}
    tables["dispersion"] = {"rate": {"kind": "normal", "std": 1.0}}
    ready = scenario.study(scenario.from_tables(tables))
    trials = montecarlo.run(ready.parts, ready.dispersion, 0, np.arange(20))
    assert trials.counts()["singular"] == 0
    assert trials.finished.all()
    assert "singularity_distance" not in build_board(ready.parts).state


def test_a_run_whose_law_memory_becomes_nan_has_diverged(here):
    """Exported code rejects every later sample. An earlier version reported ok as long as the command was finite."""
    forgetful = """
class Forgetful(ptsmc.AccelerationLaw):
    '''PD, which loses what it remembers after 2 s, and does not notice.'''

    def begin(self):
        return jnp.zeros(())

    def acceleration(self, now, error, error_rate, bound):
        return -error - 2.0 * error_rate, error, jnp.where(now.t > 2.0, jnp.nan, now.memory)
"""
    (here / "mine.py").write_text(HEAD + forgetful)
    tables = {**CHAIN, "controller": {"kind": "custom", "code": "mine.py:Forgetful", "t_f": 5.0}}
    result = simulated(tables, record=False)
    assert rollout.STATUS[int(result.status)][0] == "diverged"
    np.testing.assert_allclose(result.bad_time, 2.2, rtol=1e-12)  # the end of the first period after 2 s
