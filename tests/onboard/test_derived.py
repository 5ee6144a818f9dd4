"""Changed parameters in the C struct, without another export, give the commands of the library."""

import subprocess
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ptsmc_jax import scenario
from ptsmc_jax.observers.base import ErrorBound
from ptsmc_jax.onboard import folder, vectors
from ptsmc_jax.onboard.board import build_board
from ptsmc_jax.onboard.library import Library, compiler
from ptsmc_jax.onboard.templates import readme
from scenarios.own_parts import LowPass
from tests.helpers import short
from tests.onboard.compiled import STRICT, needs_compiler, program, step_many
from tests.onboard.flights import FILTER, FLIGHTS, FULL, flight

OTHER = np.diag([8.0, 13.0, 12.0]) + np.array([[0.0, 0.4, 0.3], [0.4, 0.0, -0.5], [0.3, -0.5, 0.0]])

# for each key of a scenario: the name of the parameter in C, and another value
PAPERS = {
    "spacecraft__inertia": ("inertia", OTHER),
    "controller__t_f": ("law_t_f", 4.6),
    "controller__eta": ("law_eta", 3.7),
    "controller__delta": ("law_delta", 0.4),
    "controller__k1": ("law_k1", 1.7),
    "controller__sign_width": ("law_sign_width", 4e-3),
    "controller__surface_rate": ("law_surface_rate", 1.3),
    "controller__layer_time": ("law_layer_time", 0.7),
    "controller__disturbance_rate_bound": ("observer_disturbance_rate_bound", 3e-3),
    "controller__initial_estimate_error": ("observer_initial_error", 2e-3),
    "observer__gain": ("observer_gain", [7.0, 11.0, 9.0]),
}
FILTERS = {"filter__bandwidth": ("filter_bandwidth", 0.13)}
AXES = np.array([[0.6, 0.0, 0.8], [-0.6, 0.0, 0.8], [0.0, 0.6, 0.8], [0.0, -1.0, 0.0]])  # unit vectors
GAIN = {"gain": [10.0, 10.0, 10.0]}  # explicit, because the default depends on the inertia
FLOWN = {
    "raw": (flight(observer=GAIN), PAPERS),
    "filter": (flight(observer=GAIN, **FILTER), PAPERS | FILTERS),
    "star tracker out of step": ({**FLIGHTS["star tracker out of step"], "observer": GAIN}, PAPERS | FILTERS),
    "wheels": (
        flight(observer=GAIN, **FILTER, spacecraft={"inertia": FULL},
               wheels={"kind": "axes", "axes": np.eye(3)[[0, 1, 2, 2]].tolist(), "torque_limit": 2.0}),
        PAPERS | FILTERS | {"wheels__axes": ("actuators_wheels_axes", AXES.T)}),
    "multiplicative": ({**FLIGHTS["multiplicative"], "observer": GAIN}, PAPERS),
    "custom law": (FLIGHTS["custom law"], {
        "spacecraft__inertia": ("inertia", OTHER),
        "controller__t_f": ("law_t_f", 4.6),
        "controller__delta": ("law_delta", 0.8),
        "controller__m": ("law_m", 1.4),
        "controller__k1": ("law_k1", 0.8),
        "controller__k": ("law_k", 3e-3),
        "observer__rate": ("observer_rate", 0.7),
        "reference__angle": ("reference_angle", 0.07)}),
    "no observer": (FLIGHTS["no observer"], {
        "spacecraft__inertia": ("inertia", OTHER),
        "controller__disturbance_bound": ("observer_disturbance_bound", 0.02)}),
    "finite time observer": (FLIGHTS["finite time observer"], {
        "observer__gain": ("observer_gain", [0.2, 0.15, 0.1]),
        "controller__disturbance_rate_bound": ("observer_disturbance_rate_bound", 5e-3),
        "controller__initial_estimate_error": ("observer_initial_error", 2e-3)}),
    "prescribed time observer": (
        flight(observer={"kind": "prescribed_time", "t_o": 2.0, "gain": [10.0, 10.0, 10.0]}), PAPERS | {
        "observer__mu": ("observer_mu", 2.6),
        "observer__t_o": ("observer_t_o", 1.5)}),
}  # fmt: skip


def largest_difference(known, library):
    """Return the largest difference between commands of the compiled C and of the simulation in two trials.

    The difference is relative to the largest command of the trial. known: the scenario. library: the compiled
    controller.
    """
    ready = scenario.study(folder.on_flight_clock(known))
    computer, trials = build_board(ready.parts), jnp.arange(2, dtype=jnp.uint32)
    parts = replace(ready.parts, substeps=10)  # equal for all gains, to share one compiled program
    simulated = vectors.simulate_many(parts, ready.dispersion, jnp.uint32(0), trials)
    simulated = jax.tree.map(np.asarray, simulated)
    at, worst = library.columns["out"].index("command[0]"), 0.0
    for k in range(len(trials)):
        samples = vectors.single_trial(simulated, k)
        assert vectors.is_usable(samples)
        given, out, _ = vectors.rows(computer, samples)
        state, commands = vectors.first_state(computer, samples), slice(at, at + samples.outputs["command"].shape[1])
        found = np.empty_like(out)
        for n, row in enumerate(given):
            state, found[n], _ = step_many(library, state, row)
        apart = np.abs(found[:, commands] - out[:, commands])
        worst = max(worst, float(np.max(apart) / np.max(np.abs(out[:, commands]))))
    return worst


def set_parameter(library, name, value):
    """Set a parameter of the compiled controller; name: in C, value: a number or an array of all its entries."""
    columns = library.columns["params"]
    at = [k for k, column in enumerate(columns) if column.partition("[")[0] == name]
    assert at, (name, columns)
    library.parameters[at] = np.ravel(value)


def exported(tables, place):
    """Export a scenario into the folder `place`; return it with its defaults as stated values, and its `Library`."""
    return scenario.reading.freeze_defaults(program(tables, place).scenario), Library(place)


def changed(known, changes):
    """Return the scenario with other values of keys; changes: {table__key: (parameter in C, value)}."""
    plain = {key: np.asarray(value).T.tolist() if key == "wheels__axes" else np.asarray(value).tolist()
             for key, (_, value) in changes.items()}  # fmt: skip
    return scenario.replace(known, **plain)


@needs_compiler
@pytest.mark.parametrize("name", short(list(FLOWN), ["wheels"]))
def test_changed_parameters_in_c_give_the_commands_of_the_changed_scenario(name, tmp_path):
    """Rounding is 1e-16 of the largest command, or 1e-14 with a filter. The documented accuracy is 1e-12."""
    tables, changes = FLOWN[name]
    known, library = exported(tables, tmp_path / "controller")
    assert largest_difference(known, library) < 1e-12
    assert largest_difference(changed(known, changes), library) > 1e-3
    for parameter, value in changes.values():
        set_parameter(library, parameter, value)
    assert largest_difference(changed(known, changes), library) < 1e-12


MAIN = """
#include <string.h>
#include "ptsmc_flight_flat.h"

/* Parameters that change between two samples: as if they had always been these, but for what is remembered. */
int main(void)
{
    const double first[] = {@first@}, second[] = {@second@};
    double row[PTSMC_FLIGHT_STATE_SIZE];
    ptsmc_flight_params other = ptsmc_flight_parameters;
    ptsmc_flight_state x, y;
    ptsmc_flight_in in;
    ptsmc_flight_out out, expected, before;

    other.inertia[0][0] = (ptsmc_flight_real)11;
    other.observer_gain[1] = (ptsmc_flight_real)7;
    ptsmc_flight_init(&ptsmc_flight_parameters, &x);
    ptsmc_flight_in_from(first, &in);
    ptsmc_flight_step(&ptsmc_flight_parameters, &x, &in, &out);
    ptsmc_flight_init(&other, &y);
    ptsmc_flight_state_to(&x, row);
    ptsmc_flight_state_from(row, &y);
    ptsmc_flight_in_from(second, &in);
    ptsmc_flight_step(&other, &y, &in, &expected);
    y = x;
    ptsmc_flight_step(&ptsmc_flight_parameters, &y, &in, &before);
    ptsmc_flight_step(&other, &x, &in, &out);
    return memcmp(&out, &expected, sizeof out) != 0 || memcmp(&out, &before, sizeof out) == 0;
}
"""


@needs_compiler
def test_parameters_in_c_may_change_between_samples(tmp_path):
    """The next output depends on the new parameters and the state only, as if these parameters had always been set."""
    tables, _ = FLOWN["raw"]
    known, library = exported(tables, tmp_path)
    half, rows = 0.25, np.zeros((2, len(library.columns["in"])))
    rows[:, 0] = 0.0, known.loop.period
    rows[:, 1:5] = np.sin(half), 0.0, 0.0, np.cos(half)
    rows[1, 5] = 0.02
    said = [", ".join(map(repr, row)) for row in rows.tolist()]
    (tmp_path / "main.c").write_text(MAIN.replace("@first@", said[0]).replace("@second@", said[1]))
    sources = [tmp_path / name for name in ("ptsmc_flight.c", "ptsmc_flight_parameters.c", "main.c")]
    subprocess.run([*compiler(), *STRICT, *map(str, sources), "-o", str(tmp_path / "main"), "-lm"], check=True)
    assert subprocess.run([str(tmp_path / "main")], check=False).returncode == 0


class Steepest(LowPass):
    """An observer whose K2 needs an operation without a counterpart in C."""

    def error_bound(self):
        """Return K2 from the largest moment of inertia, an eigenvalue, which C cannot compute."""
        return ErrorBound(*[self.disturbance_bound * jnp.linalg.eigvalsh(self.model.inertia)[-1]] * 3)


def test_a_value_that_c_cannot_derive_is_a_parameter_and_the_readme_reports_it():
    """The README names the operation and the parameters that the value depends on."""
    tables = {**FLIGHTS["raw"], "observer": {"kind": "custom", "code": f"{__file__}:Steepest"}}
    made = folder.Controller(scenario.reading.complete(scenario.from_tables(tables)), "flight", "flight")
    names = [field.name for field in made.code.parameters]
    # the three fields of the bound have the same number
    assert [name for name in made.code.underivable if name in names] == ["bound_rate"]
    assert {"inertia", "observer_disturbance_bound"} == set(made.code.sources_of["bound_rate"])
    assert [field.name for field in made.code.derived] == ["inertia_inverse"]
    said = readme(made.code, made.info)
    assert "| `bound_rate` | `inertia`, `observer_disturbance_bound` |" in said
    assert "`jnp.linalg.eigvalsh` (" in said
