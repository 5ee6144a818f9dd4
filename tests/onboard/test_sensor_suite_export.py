"""Exported C with a sensor suite: replay of the simulation, and missing and invalid readings."""

import re

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import ptsmc_jax as ptsmc
from ptsmc_jax.numerics import attitude
from ptsmc_jax.onboard import folder, vectors
from ptsmc_jax.onboard.library import Library
from ptsmc_jax.simulation.computer import SAMPLE_STATUSES
from tests.onboard.compiled import needs_compiler, program, replayed, step_many
from tests.onboard.flights import LAW, LOOP, SPREAD
from tests.tree import ROOT


class Horizon(ptsmc.AttitudeSensor):
    """A custom sensor: the elevation of its boresight over a plane, and of its x axis, both scaled."""

    scale: float = ptsmc.number(1.0, above=0.0, meaning="of both", unit="-")

    def read(self, q):
        """Return the components (2,) [-] of the sensor's z and x axes along inertial z, times `scale`."""
        axes = attitude.multiply(q, self.mounting)
        along = [attitude.rotate(axes, jnp.eye(3)[k])[2] for k in (2, 0)]
        return self.scale * jnp.stack(along)


TRACKER = {"kind": "star_tracker", "noise_across": "8 arcsec", "noise_about": "40 arcsec"}
TABLES = {
    "loop": LOOP,
    "controller": LAW,
    "dispersion": SPREAD,
    "sensors": [
        {**TRACKER, "boresight": [0.0, 1.0, 1.0], "period": 0.2, "latency": 0.1},
        {**TRACKER, "rotvec_deg": [20.0, 60.0, -30.0], "period": 0.25, "latency": 0.07},
        {"kind": "vector_sensor", "direction": [0.0, 0.6, 0.8], "noise": 1e-3, "period": 0.3},
        {"kind": "custom", "code": f"{__file__}:Horizon", "noise": [1e-3, 2e-3], "scale": 2.0, "latency": 0.1},
        {"kind": "gyro", "rate_noise": 1e-6, "rate_bias": 1e-5, "rate_bias_walk": 1e-8},
    ],
}
INPUT = SAMPLE_STATUSES.index("input")

pytestmark = needs_compiler


@pytest.fixture(scope="module")
def suite(tmp_path_factory):
    """Return the compiled controller, and inputs, outputs and states (samples, columns) of a simulated trial.

    The states have one more row: the initial state is the first one.
    """
    place = tmp_path_factory.mktemp("suite") / "controller"
    made = program(TABLES, place)
    samples = folder.simulate(made, 3, 1)[0]
    given, out, states = vectors.rows(made.board, samples)
    return Library(place), given, out, np.vstack([vectors.first_state(made.board, samples), states])


def columns(library, name):
    """Return the places of a quantity in the inputs of the compiled controller, a list with one for each component."""
    return [k for k, column in enumerate(library.columns["in"]) if column.partition("[")[0] == name]


def test_comments_in_the_exported_c_name_the_table_of_each_sensor(suite):
    library, *_ = suite
    header = (library.folder / f"ptsmc_{library.name}.h").read_text()
    for place, name in enumerate(("star_tracker_1", "star_tracker_2", "vector_sensor_1", "custom_1")):
        comment = header.rpartition(f" {name}[")[0].rpartition("/*")[2]
        assert f"sensors[{place}]" in comment
    page = (ROOT / "docs" / "export.md").read_text()
    documented = {re.sub(r"_\d", "_1", column.partition("[")[0]) for column in library.columns["in"]}
    assert not [name for name in documented if f"`{name}`" not in page]


def test_exported_c_with_a_suite_replays_the_simulation(suite):
    """Each sample starts from the simulated state. Outputs and states agree to 1e-12 of their peak."""
    library, given, out, states = suite
    after, outputs, statuses = step_many(library, states[:-1], given)
    assert not statuses.any()
    for kind, found, wanted in (("out", outputs, out), ("state", after, states[1:])):
        names = [column.partition("[")[0] for column in library.columns[kind]]
        for name in dict.fromkeys(names):
            places = [k for k, other in enumerate(names) if other == name]
            peak = np.abs(wanted[:, places]).max()
            np.testing.assert_allclose(
                found[:, places], wanted[:, places], rtol=0, atol=1e-12 * peak, err_msg=f"{kind}.{name}"
            )
    assert 0.0 < given[:, columns(library, "star_tracker_2_valid")].mean() < 1.0


def test_a_reading_marked_as_invalid_is_ignored(suite):
    library, given, _, states = suite
    _, outputs, _ = replayed(library, given, states[0])
    missing, at = given.copy(), int(np.flatnonzero(given[:, columns(library, "star_tracker_2_valid")[0]] == 0.0)[3])
    for name in ("star_tracker_2", "star_tracker_2_age"):
        missing[at, columns(library, name)] = np.nan
    statuses, others, _ = replayed(library, missing, states[0])
    assert not statuses.any()
    np.testing.assert_array_equal(others, outputs)


@pytest.mark.parametrize(
    "name", ["star_tracker_1", "star_tracker_2", "star_tracker_2_age", "vector_sensor_1", "custom_1"]
)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_reading_marked_as_valid_that_is_not_finite_is_invalid_input(suite, name, value):
    library, given, _, states = suite
    bad, valid = given.copy(), name.removesuffix("_age") + "_valid"
    at = int(np.flatnonzero(given[:, columns(library, valid)[0]])[5])
    bad[at, columns(library, name)] = value
    assert replayed(library, bad[: at + 1], states[0])[0][at] == INPUT


def test_the_first_star_tracker_reading_initialises_the_attitude(suite):
    """A vector sensor alone cannot initialise the attitude."""
    library, given, _, states = suite
    begin = int(np.flatnonzero(given[:, columns(library, "star_tracker_2_valid")[0]])[0])
    none = given[: begin + 1].copy()
    none[:, [columns(library, name)[0] for name in ("star_tracker_1_valid", "star_tracker_2_valid")]] = 0.0
    assert np.all(replayed(library, none, library.initial_state())[0] == INPUT)
    statuses, _, found = replayed(library, given[begin:], library.initial_state())
    assert not statuses.any()
    at = library.columns["state"].index("attitude[0]")
    off = Rotation.from_quat(states[1 + begin :, at : at + 4]).inv() * Rotation.from_quat(found[:, at : at + 4])
    assert off.magnitude()[0] > 2e-3  # the body turns, and the first reading is old
    assert np.all(off.magnitude()[10:] < 6e-4)  # three times the noise about the boresight
