"""Parts and scenarios that several tests use."""

import contextlib
import dataclasses
import json
import math
import re
import tomllib
from collections.abc import Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
import pytest
from hypothesis import given, settings
from polars.testing import assert_frame_equal

from ptsmc_jax import configure, programs
from ptsmc_jax.devices import sensors
from ptsmc_jax.dispersions import numbers
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.laws.base import Sample
from ptsmc_jax.laws.kinematics import AdditiveKinematics, ChainKinematics
from ptsmc_jax.laws.prescribed_time import PrescribedTime, PrescribedTimeChain
from ptsmc_jax.observers import nonlinear
from ptsmc_jax.observers.base import NoObserver
from ptsmc_jax.plants import integrator_chain, rigid_body
from ptsmc_jax.signals import disturbances, references
from ptsmc_jax.simulation import clock, rollout
from ptsmc_jax.simulation.rollout import Parts
from ptsmc_jax.theory import envelopes, solutions
from tests.tree import QUICKLY as QUICKLY
from tests.tree import ROOT as ROOT

FIRST_FLIGHT = ROOT / "scenarios" / "first_flight.toml"
REFERENCE = json.loads((Path(__file__).parent / "spacecraft_continuous.json").read_text())

PAPER_INERTIA = (10.0, 12.0, 14.0)
FULL_INERTIA = ((11.0, 1.5, -0.7), (1.5, 9.0, 0.4), (-0.7, 0.4, 14.0))
PAPER_ATTITUDE = np.array([np.sqrt(2) / 3, -1 / 3, np.sqrt(3) / 3, np.sqrt(3) / 3])


# A scenario whose simulation and search take seconds. Within the bounds, and a step beyond them, a period has five
# integration steps, so that one program simulates all gains. Gains, disturbance and window are stated, because their
# defaults follow t_f.
SHORT = """
[controller]
t_f = 5.0
delta = 0.5
eta = 3.0
k1 = 1.0
surface_rate = 1.0
sign_width = 1e-3
[observer]
gain = [10.0, 10.0, 10.0]
[disturbance]
amplitude = [0.01, 0.01, 0.01]
frequency = [0.1, 0.1, 0.1]
[loop]
mode = "sampled"
period = 0.1
t_end = 6.5
window = 1.0
[hardware]
attitude_noise = 2e-5
rate_noise = 1e-6
[dispersion]
attitude = { kind = "axis_angle", min_deg = 20.0, max_deg = 90.0 }
[requirements]
peak_torque = 30.0
[tune]
free = ["eta", "delta"]
bounds = { eta = [2.6, 3.05], delta = [0.1, 2.0] }
trials = 8
starts = 2
steps = 4
"""

# the same for a chain, whose programs compile in a quarter of the time, for tests that do not need a spacecraft
SHORT_CHAIN = """
[plant]
kind = "chain"
x0 = [1.0, 0.0]
[controller]
t_f = 5.0
delta = 0.5
[loop]
mode = "sampled"
period = 0.1
t_end = 6.5
[hardware]
state_noise = [2e-5, 1e-5]
[dispersion]
x0 = { kind = "uniform", half_width = [0.5, 0.1] }
[requirements]
peak_torque = 3.0
[tune]
free = ["eta", "delta"]
bounds = { eta = [2.6, 3.05], delta = [0.1, 2.0] }
trials = 8
starts = 2
steps = 4
"""


def undocumented(columns: Iterable[str]) -> set[str]:
    """Return a set of the columns of trajectory.csv, without their numbers, that docs/output_files.md does not list."""
    page = (ROOT / "docs" / "output_files.md").read_text(encoding="utf-8")
    part = page[page.index("## Columns of trajectory.csv") : page.index("## Columns of other tables")]
    documented = {name for row in part.splitlines() for name in re.findall(r"`([a-z_]+)\d*`", row.split(" | ")[0])}
    return {name.rstrip("0123456789") for name in columns} - documented


def untuned(text: str) -> dict[str, Any]:
    """Return the tables of a scenario without [tune]; text: of the scenario in TOML."""
    return {name: table for name, table in tomllib.loads(text).items() if name != "tune"}


def roomy(timing: Any) -> Any:
    """Return the clock with more steps, or more periods of length zero.

    Different runs then share a compiled program. timing: a sampled or graded clock.
    """
    counts = {name: getattr(timing, name) for name in (("count",) if timing.sampled else ("before", "after"))}
    more = {name: count if count > 1024 else 512 if count <= 512 else 1024 for name, count in counts.items()}
    return dataclasses.replace(timing, **more)


def fly(run: Parts, seed: int = 0, trial: int = 0) -> Any:
    """Simulate a run and return the `rollout` result with its history, all as NumPy arrays.

    One program serves all parts with the same structure.
    """
    numbers = jax.tree.map(np.asarray, run)  # without the weak types of Python numbers
    simulated = rollout.simulate_parts(
        numbers, np.uint32(seed), np.uint32(trial), record=True, software=rollout.PYTHON_SOFTWARE
    )
    return jax.tree.map(np.asarray, simulated)


@programs.jit
def inputs_along(run: Parts, t: Any) -> Any:
    """Return the inputs (n, m) of the exact motion at times t (n,) before the hand-over."""
    return jax.vmap(lambda time: solutions.exact_input(run, time)[0])(t)


ticks_of = jax.jit(lambda timing, t_f, delta: timing.ticks(t_f, delta))
errors_along = jax.jit(jax.vmap(solutions.exact_error, (0, None, None, None, None)))


def vector(*values: Any) -> Any:
    """Return a float64 array of several numbers or of one sequence."""
    return jnp.asarray(np.asarray(values[0] if len(values) == 1 else values, dtype=float), dtype=float)


def time_derivative(signal: Any) -> Any:
    """Return the time derivative of a signal as a function of time [s], by automatic differentiation; signal: of t."""
    return lambda t: jax.jvp(signal, (t,), (jnp.ones_like(t),))[1]


def random_turns(smallest, largest):
    """Return the `Dispersion` that turns the start from the reference by an angle between these [rad]."""
    return Dispersion({"initial_attitude": numbers.axis_angle(smallest, largest)})


def parts(
    t_f=30.0,
    eta=3.0,
    delta=0.05,
    gain=10.0,
    *,
    inertia: Any = PAPER_INERTIA,
    q: Any = PAPER_ATTITUDE,
    rate: Any = (0.0, 0.0, 0.0),
    reference: Any = None,
    disturbance: Any = None,
    rate_bound=1e-3,
    noise: tuple[float, float] | None = None,
    period: float | None = None,
    flight=False,
    t_end: float | None = None,
    sign_width=1e-3,
    k1=1.0,
    surface_rate=1.0,
    saves: Any = (),
    kinematics: Any = AdditiveKinematics,
) -> Parts:
    """Return the parts of the published Case I with changes, in the continuous loop unless a period is given.

    gain: of the observer. q, rate: initial attitude and body rate [rad/s]. rate_bound: of the disturbance. noise: 1
    sigma of attitude [rad] and rate [rad/s]. flight: whether a sampled loop uses the flight clock. saves: extra times
    in the history.
    """
    body = rigid_body.spacecraft(inertia)
    t_end = t_f + 10.0 if t_end is None else t_end
    if period is None:
        pace = max(k1 / 2, surface_rate)
        timing: Any = clock.graded_clock(t_f, delta, t_end, 1.0, pace, 0.1, (0.2 * t_f, 0.2), saves)
        timing = timing if len(saves) else roomy(timing)
    elif flight:
        timing = clock.flight_clock(period, t_end)
    else:
        timing = roomy(clock.anchored_clock(period, t_end))
    return Parts(
        plant=body,
        disturbance=disturbance
        or disturbances.Sinusoid(vector([0.01] * 3), vector([0.1] * 3), vector([0.0] * 3), vector([0.0] * 3)),
        reference=reference or references.Fixed(vector([0.0, 0.0, 0.0, 1.0])),
        controller=PrescribedTime(
            kinematics(body), *(vector(v) for v in (t_f, eta, delta, k1, sign_width, surface_rate))
        ),
        observer=nonlinear.NonlinearObserver(body, vector([gain] * 3), vector(rate_bound), vector(0.0)),
        sensors=sensors.PerfectSensors() if noise is None else sensors.Sensors(*(vector(v) for v in noise)),
        clock=timing,
        initial=rigid_body.AttitudeState(vector(q), vector(rate)),
        t_end=vector(t_end),
        window=vector(1.0),
        settling_angle=vector(1e-3),
    )


def commanded(law: Any, t: Any, hold: Any, x: Any, target: Any, d_hat: Any, k2: Any) -> Any:
    """Return input u (m,) and sliding variable s of a law without a memory at t [s].

    hold: whether t is in the hold phase. k2: bound on the error of d_hat.
    """
    u, s, _ = law(Sample(t, hold, vector(0.1)), x, target, d_hat, k2)
    return u, s


def chain_parts(
    x0: Any,
    t_f=5.0,
    eta: float | None = None,
    delta=0.05,
    *,
    k1=1.0,
    surface_rate=1.0,
    a: Any = None,
    bound=0.0,
    sign_width=1e-3,
    disturbance: Any = None,
    observer: Any = None,
    steps: tuple[int, int] | None = None,
    period: float | None = None,
    noise: Any = None,
    f: Any = None,
    g: Any = None,
) -> Parts:
    """Return the parts of an integrator chain with the length of x0, by default without disturbance.

    The loop is continuous unless a period [s] is given. `bound` is K2 without an observer. `noise` is 1 sigma of each
    state. `steps` are the numbers of steps before and after the hand-over time t_s, for another grid than the default.
    """
    n, t_end = len(x0), t_f + 2.0
    model = integrator_chain.chain(n, f, g)
    eta = n + 1.0 if eta is None else eta
    a = [float(math.comb(n - 1, i)) for i in range(n - 1)] if a is None else a
    gains = tuple(vector(v) for v in (t_f, eta, delta, k1, sign_width, surface_rate))
    law = PrescribedTimeChain(ChainKinematics(model), *gains, a=vector(a))
    if period is not None:
        timing: Any = roomy(clock.anchored_clock(period, t_end))
    elif steps is not None:
        largest = vector(1.5 * t_f / steps[0])
        timing = clock.Graded(vector(t_end), vector(1.0), largest, jnp.zeros(0), *steps)
    else:
        pace = max(envelopes.hold_rates(law).values())
        timing = roomy(clock.graded_clock(t_f, delta, t_end, 1.0, pace, 0.0, (0.0, 0.0), (), n))
    return Parts(
        plant=model,
        disturbance=disturbance or disturbances.Constant(jnp.zeros(1)),
        reference=references.Origin(),
        controller=law,
        observer=observer or NoObserver(model, vector(bound)),
        sensors=sensors.PerfectSensors() if noise is None else sensors.StateSensor(vector(noise)),
        clock=timing,
        initial=vector(x0),
        t_end=vector(t_end),
        window=vector(1.0),
        settling_angle=vector(1e-3),
    )


def chain_flight() -> Parts:
    """Return the parts of a chain with noise on the flight clock. Its t_f and t_end lie between samples."""
    run = chain_parts([1.0, 0.2], 5.02, delta=0.53, period=0.05, noise=[2e-4, 1e-4])
    return dataclasses.replace(run, clock=clock.flight_clock(0.05, 7.02))


def with_controller(run: Parts, **changes: Any) -> Parts:
    """Return the parts with other values of fields of the controller."""
    return dataclasses.replace(run, controller=dataclasses.replace(run.controller, **changes))


def finer(run: Parts, times: int) -> Parts:
    """Return the parts of the same continuous run on a time grid with `times` as many steps."""
    grid = run.clock
    assert isinstance(grid, clock.Graded)
    grid = dataclasses.replace(
        grid, before=grid.before * times, after=grid.after * times, max_step=grid.max_step / times
    )
    return dataclasses.replace(run, clock=grid)


def short(cases: Any, kept: Any) -> list[Any]:
    """Return cases for `parametrize`. All cases except those in `kept` are marked `long`.

    A case is a value, or a tuple of the values of one case.
    """
    many = [case if isinstance(case, tuple) else (case,) for case in cases]
    return [case if case in kept else pytest.param(*one, marks=pytest.mark.long)
            for case, one in zip(cases, many, strict=True)]  # fmt: skip


def drawn(check: Any, count: int, **cases: Any) -> Any:
    """Return a test that calls `check` for `count` random cases, which are the same in every run.

    cases: the Hypothesis strategy of each argument of `check`.
    """
    return settings(max_examples=count, deadline=None, derandomize=True, database=None)(given(**cases)(check))


def tree(folder):
    """Return {path relative to the folder: content in bytes} for all files of a folder."""
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@contextlib.contextmanager
def refuses(error, said):
    """Assert that the code raises this error with one sentence, which contains the text `said`."""
    with pytest.raises(error) as caught:
        yield caught
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def rows_of(folder):
    """Return a data frame with the rows of all trials in the result folder of a campaign."""
    return pl.concat([pl.read_parquet(path) for path in sorted((folder / "trials").glob("*.parquet"))])


def refused(command, tmp_path, *args):
    """Run a command that must fail; return its one-sentence error after checking that it wrote no files.

    command: the fixture. args: of `ptsmc`.
    """
    before = tree(tmp_path)
    status, out, err = command(*args)
    assert (status, out) == (2, "")
    assert tree(tmp_path) == before
    (line,) = err.strip().splitlines()
    return line


def small_search(monkeypatch, held_out=40):
    """Make searches small: a few points, few trials, and `held_out` held-out trials."""
    from tuning.search import confirm, evolution, local_searches, simulations, starts, worst

    for module, name, value in (
        (simulations, "ROW", 10),
        (worst, "SCREENED", 48),
        (worst, "STEPS", 5),
        (confirm, "HELD_OUT", held_out),
        (confirm, "FEWEST_TRIALS", 64),
        (starts, "CANDIDATES", 16),
        (starts, "GLOBAL_CANDIDATES", 64),
        (local_searches, "SOBOL_POINTS", 16),
        (evolution, "GENERATIONS", 3),
    ):
        monkeypatch.setattr(module, name, value)


def same(one, other):
    """Assert that two data frames have equal integers and texts, and other numbers equal to a relative 1e-12."""
    assert one.columns == other.columns
    assert_frame_equal(one.select(pl.exclude(pl.Float64)), other.select(pl.exclude(pl.Float64)))
    for name in one.select(pl.col(pl.Float64)).columns:
        np.testing.assert_allclose(one[name].to_numpy(), other[name].to_numpy(), rtol=1e-12, atol=1e-300, err_msg=name)


def gpus() -> list[Any]:
    """Return what `configure.devices` returns if JAX has a GPU, as a replacement of this function.

    This is JAX's default device if it is set, otherwise a fake GPU, in a list.
    """
    return [configure.default_device() or SimpleNamespace(platform="gpu")]


class _CalledError(Exception):
    """Raised by the replaced program of `assert_prepared`, to end the call."""


def assert_prepared(monkeypatch, owner, program, prepare, call):
    """Assert that `prepare` and `call` pass arguments of equal structure, types and static values to a program.

    owner, program: module and name of the program, which is replaced. prepare, call: functions without arguments.
    """
    calls = []

    def heard(*given, **fixed):
        leaves = [leaf if callable(leaf) or isinstance(leaf, int) else jax.typeof(leaf)
                  for leaf in jax.tree.leaves(given)]  # fmt: skip
        calls.append((jax.tree.structure(given), leaves, fixed))

    def called(*given, **fixed):
        heard(*given, **fixed)
        raise _CalledError

    called.prepare = heard  # pyright: ignore[reportFunctionMemberAccess]
    monkeypatch.setattr(owner, program, called)
    prepare()
    with pytest.raises(_CalledError):
        call()
    assert len(calls) == 2
    assert calls[0] == calls[1]


def equations(trace: Any) -> Any:
    """Yield all equations of a jaxpr or trace, those of nested jaxprs included."""
    for eqn in getattr(trace, "jaxpr", trace).eqns:
        yield eqn
        for value in eqn.params.values():
            for inner in value if isinstance(value, tuple | list) else (value,):
                if hasattr(getattr(inner, "jaxpr", inner), "eqns"):
                    yield from equations(inner)
