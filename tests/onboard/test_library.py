"""The compiled controller in the loop equals the simulation; invalid input gives a status and a finite output."""

import re
import shutil
from dataclasses import dataclass, field, replace
from functools import cache

import jax
import numpy as np
import pytest

import ptsmc_jax as ptsmc
from ptsmc_jax import configure, scenario
from ptsmc_jax.campaigns import runs
from ptsmc_jax.devices.attitude_filter import filter_gains
from ptsmc_jax.dispersions.variation import Dispersion
from ptsmc_jax.numerics import paths
from ptsmc_jax.numerics.pytrees import pytree
from ptsmc_jax.onboard import folder
from ptsmc_jax.onboard.generate import column_names
from ptsmc_jax.onboard.library import InTheLoop, Library
from ptsmc_jax.onboard.templates import STATUS
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.simulation import computer
from tests.helpers import gpus, short, undocumented
from tests.onboard.compiled import needs_compiler, program, replayed, step_many
from tests.onboard.flights import FLIGHTS

OK, SATURATED, MISSED, SINGULAR, INPUT, OVERFLOW = range(len(STATUS))


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Return a function of the name of a scenario in FLIGHTS that returns its controller and its compiled `Library`.

    The controller is compiled once. The parameters of the library are reset at each call. real: number type of the C.
    """

    @cache
    def written(name):
        place = tmp_path_factory.mktemp("exported") / "controller"
        return program(FLIGHTS[name], place), place

    @cache
    def compiled(name, real):
        library = Library(written(name)[1], real)
        return library, library.parameters.copy()

    def as_it_was(name, real="double"):
        library, parameters = compiled(name, real)
        library.parameters[:] = parameters
        return written(name)[0], library

    return as_it_was


@needs_compiler
@pytest.mark.parametrize("name", short(list(FLIGHTS), ["wheels"]))
def test_compiled_controller_in_the_loop_equals_the_simulation(name, exported):
    """Only the run with the compiled controller counts statuses of samples."""
    made, library = exported(name)
    ours = runs.simulate(made.ready, 3, 2)
    parts = made.ready.parts
    longer = replace(parts, clock=replace(parts.clock, count=parts.clock.count + 3))  # adds periods of length 0
    theirs = runs.simulate(replace(made.ready, parts=longer), 3, 2, InTheLoop(library, parts).software)
    assert sum(theirs.samples.values()) == theirs.samples["ok"] + theirs.samples["saturated"] == len(ours.log.t) - 1
    assert ours.samples == {}
    of_ours = ours.columns()
    assert undocumented(of_ours) == set()
    for column, other in theirs.columns().items():  # without the last row, whose s comes from the law in Python
        value, other = of_ours[column], other[:-1]
        np.testing.assert_allclose(
            other, value[:-1], rtol=1e-9, atol=1e-9 * np.max(np.abs(value)) + 1e-15, err_msg=column
        )
    for metric, value in ours.metrics.items():
        np.testing.assert_allclose(theirs.metrics[metric], value, rtol=1e-9, atol=1e-15, err_msg=metric)


@pytest.fixture(scope="module")
def filtered(exported):
    """Return the compiled controller of a scenario with attitude filter, and inputs (samples, columns)."""
    made, library = exported("star tracker out of step")
    return library, given(made)


def given(made):
    """Return valid inputs (samples, columns) of a slowly rotating body; made: the controller."""
    t = 0.1 * np.arange(40)
    half = 0.25 + 0.01 * t
    one, none = np.ones_like(t), np.zeros_like(t)
    q = np.stack([np.sin(half), none, none, np.cos(half)], axis=1)
    columns = {"t": t, **{f"attitude[{k}]": q[:, k] for k in range(4)}, "attitude_valid": one, "rate[0]": 0.02 * one}
    return np.stack([columns.get(name, none) for name in column_names(made.board)["in"]], axis=1)


def simulated(library, samples):
    """Return statuses and outputs of a compiled controller for inputs (samples, columns), from its initial state."""
    return replayed(library, samples, library.initial_state())[:2]


def changed(library, samples, at, **values):
    """Return the inputs (samples, columns) with changes in sample `at`; values: by names of columns without indices."""
    found, names = samples.copy(), library.columns["in"]
    for name, value in values.items():
        columns = [k for k, column in enumerate(names) if column.split("[")[0] == name]
        assert columns
        found[at, columns] = value
    return found


@needs_compiler
@pytest.mark.parametrize(
    "bad",
    [
        {"rate": np.nan},
        {"attitude": np.inf},
        {"attitude": 0.0},
        {"t": np.nan},
        {"t": 0.3},  # backwards
        {"t": 0.9},  # equal to the last sample
        {"rate": 20.0},  # more than a radian per period
        {"rate": 1e300},
    ],
    ids=str,
)
def test_invalid_input_gives_a_status_and_the_last_output_and_leaves_the_state_unchanged(filtered, bad):
    """The next sample has the status of a missed sample, and its output is that without the invalid sample."""
    library, samples = filtered
    assert not simulated(library, samples)[0].any()
    statuses, outputs = simulated(library, changed(library, samples, 10, **bad))
    assert statuses[10] == INPUT
    np.testing.assert_array_equal(outputs[10], outputs[9])
    assert statuses[11] == MISSED
    assert not np.delete(statuses, (10, 11)).any()
    # the effect is the same as that of a missed sample
    np.testing.assert_array_equal(outputs[11:], simulated(library, np.delete(samples, 10, axis=0))[1][10:])


@needs_compiler
@pytest.mark.parametrize("name", ["raw", "star tracker out of step"])
def test_the_sign_of_a_measured_quaternion_has_no_effect(name, exported):
    """The commands are identical from the first sample on."""
    made, library = exported(name)
    samples = given(made)
    turned, columns = samples.copy(), [k for k, column in enumerate(library.columns["in"]) if "attitude[" in column]
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=len(samples))
    signs[0] = -1.0
    turned[:, columns] *= signs[:, None]
    (statuses, outputs), (again, others) = simulated(library, samples), simulated(library, turned)
    assert not statuses.any()
    assert not again.any()
    np.testing.assert_array_equal(others, outputs)
    assert np.ptp(outputs, axis=0).max() > 0.0


@needs_compiler
def test_a_sample_without_star_tracker_attitude_is_not_a_missed_sample(filtered):
    library, samples = filtered
    statuses, outputs = simulated(library, changed(library, samples, 10, attitude_valid=0.0, attitude=np.nan))
    assert not statuses.any()
    assert np.all(np.isfinite(outputs))


# the flags are read directly after the call, because NumPy clears them
WATCHED = """
#include <fenv.h>
void ptsmc_many(long, const double *, const double *, const double *, double *, double *, int *);
void watched(long, const double *, const double *, const double *, double *, double *, int *);
int raised(void);
static int flags;
void watched(long count, const double *p, const double *x, const double *in, double *after, double *out, int *status)
{
    feclearexcept(FE_ALL_EXCEPT);
    ptsmc_many(count, p, x, in, after, out, status);
    flags |= fetestexcept(FE_DIVBYZERO | FE_INVALID | FE_OVERFLOW);
}
int raised(void) { return flags; }
"""


@needs_compiler
@pytest.mark.parametrize("name", short(["filter", "star tracker out of step"], ["star tracker out of step"]))
def test_an_invalid_attitude_is_not_used_in_computations(name, exported, tmp_path):
    """Normalising an attitude of zeros would be 0 / 0, which may trap on some processors."""
    (tmp_path / "watched.c").write_text(WATCHED)
    made, plain = exported(name)
    library = Library(plain.folder, options=(str(tmp_path / "watched.c"),))
    samples, names = given(made), column_names(made.board)["in"]
    of_star = [k for k, column in enumerate(names) if column.startswith("attitude")]
    for at, said in ((10, 0.0), (15, np.nan), (20, 1e300)):
        samples[at, of_star] = said
        samples[at, names.index("attitude_valid")] = 0.0
    statuses, *_ = replayed(library, samples, library.initial_state(), function="watched")
    assert library.binary.raised() == 0
    assert not statuses.any()


@needs_compiler
def test_the_age_of_an_attitude_is_clipped_to_the_period_and_must_not_be_nan(exported):
    """The star tracker has its own clock. A NaN age is invalid input only if there is an attitude."""
    made, library = exported("star tracker out of step")
    samples, at = given(made), column_names(made.board)["in"].index("attitude_age")
    valid = column_names(made.board)["in"].index("attitude_valid")
    other = samples.copy()
    other[:, at] = 0.04  # the body turns at 0.02 rad/s
    turned = other.copy()
    half = 0.25 + 0.01 * (samples[:, 0] - 0.04)
    turned[1:, 1], turned[1:, 4] = np.sin(half[1:]), np.cos(half[1:])
    np.testing.assert_allclose(simulated(library, turned)[1][-1], simulated(library, samples)[1][-1], rtol=0, atol=1e-9)
    for age, there, wanted in ((np.nan, 0.0, OK), (np.nan, 1.0, INPUT), (-1.0, 1.0, OK), (1e9, 1.0, OK)):
        other = samples.copy()
        other[10, at], other[10, valid] = age, there
        statuses, outputs = simulated(library, other)
        assert statuses[10] == wanted, age
        assert np.all(np.isfinite(outputs))


@needs_compiler
def test_invalid_wheel_telemetry_is_invalid_input(exported):
    """The next outputs are those without the invalid sample."""
    made, library = exported("wheels")
    samples, at = given(made), column_names(made.board)["in"].index("wheel_momentum[2]")
    for bad in (np.nan, np.inf, 1e9):
        other = samples.copy()
        other[10, at] = bad
        statuses, outputs = simulated(library, other)
        assert (statuses[10], statuses[11]) == (INPUT, MISSED)
        assert set(np.delete(statuses, (10, 11))) <= {OK, SATURATED}
        assert np.all(np.isfinite(outputs))
        np.testing.assert_array_equal(outputs[11:], simulated(library, np.delete(samples, 10, axis=0))[1][10:])


@needs_compiler
def test_a_missed_sample_gives_a_status_and_does_not_update_the_observer(filtered):
    library, samples = filtered
    statuses, outputs = simulated(library, np.delete(samples, slice(10, 15), axis=0))
    assert statuses[10] == MISSED
    assert not np.delete(statuses, 10).any()
    assert np.all(np.isfinite(outputs))
    at = library.columns["out"].index("d_hat[0]")
    np.testing.assert_array_equal(outputs[10, at : at + 3], outputs[9, at : at + 3])
    assert np.any(outputs[11, at : at + 3] != outputs[10, at : at + 3])  # the next sample updates it again


@needs_compiler
def test_a_singular_attitude_gives_the_last_valid_command(exported):
    made, library = exported("raw")
    names = column_names(made.board)["in"]
    angles = np.concatenate([np.linspace(2.9, np.pi, 11), np.linspace(np.pi, 2.9, 11)[1:]])
    samples = np.zeros((len(angles), len(names)))
    samples[:, 0] = 0.1 * np.arange(len(angles))
    samples[:, names.index("attitude[0]")] = np.sin(angles / 2.0)
    samples[:, names.index("attitude[3]")] = np.cos(angles / 2.0)
    statuses, outputs = simulated(library, samples)
    assert statuses.tolist() == [OK] * 10 + [SINGULAR] + [OK] * 10  # singular if half the angle is near 90 deg
    at = column_names(made.board)["out"].index("command[0]")
    np.testing.assert_array_equal(outputs[10, at : at + 3], outputs[9, at : at + 3])


@needs_compiler
def test_an_unknown_status_is_counted_as_other(exported, tmp_path):
    """Unknown statuses are larger than the last one, or negative."""
    made, library = exported("chain")
    code = shutil.copytree(library.folder, tmp_path / "c") / f"ptsmc_{library.name}.c"
    last = "    return status;\n"
    assert code.read_text().count(last) == 1
    code.write_text(code.read_text().replace(last, "    return in->t > 2.0 ? 7 : in->t > 1.0 ? -1 : status;\n"))
    run = runs.simulate(made.ready, 3, 2, InTheLoop(Library(code.parent), made.ready.parts).software)
    late = int(np.sum(run.log.t[:-1] > 1.0))
    assert (*map(str.lower, STATUS), "other") == computer.SAMPLE_STATUSES
    assert run.samples == {**dict.fromkeys(run.samples, 0), "ok": len(run.log.t) - 1 - late, "other": late}


@needs_compiler
@pytest.mark.parametrize("precision", [np.float64, np.float32])
def test_jax_calls_the_controller_without_python_callback(exported, precision):
    """A callback deadlocks with many trials on two devices, because it waits for busy threads to copy arrays."""
    made, library = exported("wheels")
    inputs = given(made)[:6].astype(precision)
    states = np.repeat(library.initial_state()[None], 6, axis=0).astype(precision)
    told = np.full((6, library.parameters.size), np.nan, precision)
    told[3:, library.columns["params"].index("law_eta")] = 4.0
    batched = jax.jit(jax.vmap(jax.vmap(library.step_in_jax)))
    program = batched.lower(*(v.reshape(2, 3, -1) for v in (states, inputs, told)))
    assert library.target in program.as_text()
    assert "callback" not in program.as_text()
    found = program.compile()(*(v.reshape(2, 3, -1) for v in (states, inputs, told)))
    wanted = step_many(library, states, inputs, told)
    for one, other in zip(found, wanted, strict=True):
        assert one.dtype == (np.int32 if other.dtype == np.int32 else precision)
        np.testing.assert_array_equal(one, other.astype(one.dtype).reshape(one.shape))
    at = library.columns["out"].index("command[0]")
    assert np.any(wanted[1][3:, at] != step_many(library, states, inputs)[1][3:, at])


@needs_compiler
def test_trials_with_a_compiled_controller_equal_single_simulations(exported, monkeypatch):
    """The rows of `trials` with a controller equal single simulated runs up to rounding."""
    made, library = exported("chain")
    study, shares = scenario.from_tables(FLIGHTS["chain"]), []
    with monkeypatch.context() as patched:  # the CPU is used even if there is a GPU
        patched.setattr(configure, "devices", gpus)
        rows = ptsmc.trials(study, 3, seed=5, controller=library.folder)
    assert rows["status"].to_list() == ["ok"] * 3
    for trial in range(3):
        run = runs.simulate(made.ready, 5, trial)
        assert rows["controller_ok"][trial] == len(run.log.t) - 1
        shares += [rows[name][trial] / run.metrics[name] - 1.0 for name in ("window_error", "peak_torque", "effort")]
    assert np.max(np.abs(shares)) < 1e-9
    with pytest.raises(ptsmc.ScenarioError, match="has other inputs than the scenario"):
        ptsmc.trials(scenario.from_tables(FLIGHTS["raw"]), 3, controller=library.folder)
    otherwise = scenario.from_tables({**FLIGHTS["chain"], "controller": {**FLIGHTS["chain"]["controller"], "eta": 2.9}})
    with pytest.warns(RuntimeWarning, match=r"other parameters than the scenario: law_eta = 3 instead of 2\.9$"):
        one = ptsmc.simulate(otherwise, seed=5, trial=1, controller=library.folder)
    assert one.metrics["window_error"] == pytest.approx(rows["window_error"][1], rel=1e-9)


@needs_compiler
@pytest.mark.parametrize(
    ("flight", "said"),
    [
        (
            "implicit",
            "has the law PrescribedTime(implicit=False), but must have the law of the scenario, PrescribedTime(",
        ),
        ("no observer", "has the observer NonlinearObserver, but must have the observer of the scenario, NoObserver"),
        ("spin", "has the reference Fixed, but must have the reference of the scenario, Spin"),
        ("terminal", "has the law PrescribedTime(implicit=False), but must have the law of the scenario, Terminal"),
    ],
)
def test_a_controller_with_other_parts_and_the_same_inputs_raises_an_error(exported, flight, said):
    """Otherwise the simulation would silently use another law, observer or reference."""
    _, library = exported("raw")
    parts = scenario.study(folder.on_flight_clock(scenario.from_tables(FLIGHTS[flight]))).parts
    with pytest.raises(ptsmc.ScenarioError, match=re.escape(said)):
        InTheLoop(library, parts)


@needs_compiler
def test_differences_of_small_parameters_are_reported(exported):
    """Parameters of C and of the scenario are compared relative to their size, which may be below 1e-8."""
    made, library = exported("chain")
    parts = replace(made.ready.parts, controller=replace(made.ready.parts.controller, sign_width=2e-9))
    at = library.columns["params"].index("law_sign_width")
    for width, said in ((1e-9, "law_sign_width = 1e-09 instead of 2e-09"), (2e-9 * (1.0 + 1e-7), "")):
        library.parameters[at] = width
        assert InTheLoop(library, parts).parameter_differences.endswith(said)
        assert bool(InTheLoop(library, parts).parameter_differences) == bool(said)


@needs_compiler
def test_arrays_of_other_types_are_converted_for_c_and_of_wrong_length_raise_an_error(filtered):
    """Otherwise C would read other numbers or write beyond the arrays."""
    library, samples = filtered
    state, given, told = library.initial_state(), samples[0], np.full(library.parameters.size, np.nan)
    whole = np.rint(given).astype(int)
    np.testing.assert_array_equal(library.step_in_jax(state, whole, told)[1], step_many(library, state, whole)[1])
    half = [v.astype(np.float16) for v in (state, given, told)]
    after, out, _ = library.step_in_jax(*half)
    assert after.dtype == out.dtype == np.float32
    np.testing.assert_array_equal(out, step_many(library, half[0], half[1], half[2])[1].astype(np.float32))
    for k in range(3):
        short = [v[: -1 if j == k else None] for j, v in enumerate((state, given, told))]
        with pytest.raises((TypeError, ValueError), match="reshape"):
            library.step_in_jax(*short)


@pytree
@dataclass(frozen=True)
class Measured(ptsmc.Draw):
    """A draw of the inertia that is also known to the flight computer, with matching gains."""

    def at(self, c, parts):
        """Return parts whose plant and flight software have the inertia times 1 + 0.05 c[0].

        c: random numbers (1,). The gains eta, of the observer and of the filter are changed to match.
        """
        factor = 1.0 + 0.05 * c[0]
        parts = parts.with_inertia(factor * paths.get(parts, "plant.inertia"))
        law = replace(parts.controller, eta=factor * parts.controller.eta)
        observer = replace(parts.observer, gain=parts.observer.gain / factor)
        sensors = parts.sensors
        if sensors.filter is not None:
            gains = filter_gains(0.5 * factor, parts.period)
            known = replace(sensors.filter, attitude_gain=gains[0], bias_gain=gains[1])
            sensors = replace(sensors, filter=known)
        return replace(parts, controller=law, observer=observer, sensors=sensors)


@needs_compiler
@pytest.mark.parametrize("name", short(["delay, limit, quantised", "filter"], ["delay, limit, quantised"]))
def test_parameters_that_a_trial_changes_are_passed_to_c(name, exported):
    """The trial changes the reference, the torque limit, and, by a custom draw, law, observer and filter."""
    made, library = exported(name)
    drawn = {"reference": {"kind": "normal", "std_deg": 20.0}}
    if name != "filter":
        drawn["torque_limit"] = {"kind": "relative_normal", "std": 0.2}
    ready = scenario.study(folder.on_flight_clock(scenario.from_tables({**FLIGHTS[name], "dispersion": drawn})))
    ready = replace(ready, dispersion=replace(ready.dispersion, custom=Measured()))
    ours = runs.simulate(ready, 3, 2)
    software = InTheLoop(library, ready.parts, ready.dispersion).software
    theirs = runs.simulate(ready, 3, 2, software)
    assert theirs.samples["saturated"] > 0 or name == "filter"
    for metric in ("window_error", "peak_torque", "peak_torque_delivered"):
        np.testing.assert_allclose(theirs.metrics[metric], ours.metrics[metric], rtol=1e-9, err_msg=metric)
    if name != "filter":  # the nominal torque limit is used in the nominal run
        nominal = runs.simulate(made.ready, 0, 0, software)
        assert nominal.samples["saturated"] > 0
        assert np.max(np.abs(nominal.log.u)) <= 3.0


@pytree
@dataclass(frozen=True)
class InconsistentInertia(ptsmc.Draw):
    """A dispersion that changes the inertia of either law or observer (`where`), or only the inverse of both ("")."""

    where: str = field(metadata={"static": True})

    def at(self, c, parts):
        """Return the parts with the changed inertia, for a random number c (1,) [-]."""
        part, factor = getattr(parts, self.where or "controller"), 1.0 + 0.1 * c[0]
        changed = {"inertia": part.model.inertia * factor} if self.where else {}
        model = replace(part.model, inertia_inverse=part.model.inertia_inverse / factor, **changed)
        law = parts.controller
        law = replace(law, kinematics=replace(law.kinematics, model=model))
        if self.where == "controller":
            return replace(parts, controller=law)
        observer = replace(parts.observer, model=model)
        return replace(parts, observer=observer, **({} if self.where else {"controller": law}))


@needs_compiler
@pytest.mark.parametrize("where", ["controller", "observer", ""])
def test_a_draw_that_changes_one_of_several_shared_parameters_raises_an_error(where, exported):
    """C has one inertia for law and observer, so that it cannot use different values."""
    made, library = exported("delay, limit, quantised")
    with pytest.raises(ScenarioError, match=r"dispersion\.custom changes .*inertia.* alone, but the controller in"):
        InTheLoop(library, made.ready.parts, Dispersion(custom=InconsistentInertia(where)))


@needs_compiler
@pytest.mark.parametrize("name", short(["wheels", "implicit chain"], ["implicit chain"]))
def test_a_controller_compiled_in_single_precision_gives_the_same_metrics(exported, name):
    """The metrics of one run agree to 1e-3. See `benchmarks/exported_c.py` for statistics of many trials."""
    made, library = exported(name, "float")
    single = InTheLoop(library, made.ready.parts).software
    ours, theirs = runs.simulate(made.ready, 3, 2), runs.simulate(made.ready, 3, 2, single)
    for name in ("peak_torque", "window_error", "effort"):
        np.testing.assert_allclose(theirs.metrics[name], ours.metrics[name], rtol=1e-3, err_msg=name)
