"""Campaigns with a run table: given values are used, other quantities are random.

A run table that a campaign has written reproduces the campaign.
"""

import dataclasses
import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
import pytest
from polars.testing import assert_frame_equal
from scipy.spatial.transform import Rotation

import ptsmc_jax as ptsmc
from ptsmc_jax import programs, scenario
from ptsmc_jax.campaigns import campaign, montecarlo, run_tables
from ptsmc_jax.campaigns.store import RefusedError
from ptsmc_jax.dispersions.quantities import QUANTITIES
from ptsmc_jax.plants import rigid_body
from ptsmc_jax.signals import disturbances
from ptsmc_jax.simulation import catalogues, rollout
from tests.helpers import SHORT_CHAIN, refuses, untuned, vector

SEED, TRIALS = 3, 50  # number of trials, small enough for the compiled program of few trials
EVERYTHING = """
[controller]
t_f = 3.0
delta = 1.0
[loop]
mode = "sampled"
period = 0.25
t_end = 4.5
[disturbance]
kind = "sum"
terms = [{ kind = "sinusoid" }, { kind = "gravity_gradient" }]
[hardware]
attitude_noise = 2e-5
rate_noise = 1e-6
rate_bias = 1e-5
torque_limit = 30.0
[dispersion]
attitude = { kind = "axis_angle", min_deg = 20.0, max_deg = 90.0 }
rate = { kind = "normal" }
inertia = { kind = "relative_normal" }
reference = { kind = "normal" }
disturbance_phase = { kind = "uniform" }
disturbance_amplitude = { kind = "relative_normal" }
disturbance_bias = { kind = "normal" }
attitude_noise = { kind = "relative_normal" }
rate_noise = { kind = "relative_uniform" }
torque_limit = { kind = "relative_uniform" }
"""
CHAIN = """
plant = { kind = "chain", order = 3 }
controller = { delta = 0.5 }
loop = { mode = "sampled", period = 0.1 }
hardware = { state_noise = [1e-4, 1e-4, 1e-4] }
dispersion = { x0 = { kind = "normal" }, state_noise = { kind = "relative_normal" } }
"""


def ready(text):
    """Return the study of a scenario; text: of the scenario in TOML."""
    return scenario.study(scenario.from_tables(tomllib.loads(text)))


@pytest.fixture(scope="module")
def everything():
    """Return a spacecraft campaign with a dispersion of every quantity, and its run table (a data frame)."""
    made = campaign.Campaign(ready(EVERYTHING), SEED)
    return made, made.draw(range(TRIALS))


@pytest.fixture(scope="module")
def of_a_chain():
    """Return a campaign that uses the compiled program of other tests, and its run table (a data frame)."""
    made = campaign.Campaign(scenario.study(scenario.from_tables(untuned(SHORT_CHAIN))), SEED)
    return made, made.draw(range(TRIALS))


def of_run_table(made, table):
    """Return the campaign `made` with the trials of a run table (a data frame) instead of its random trials."""
    return campaign.from_run_table(made.ready, made.seed, run_tables.check_table(table, made.ready.parts))


# the spacecraft is a long test, because a later test checks that its run table has the exact inputs
@pytest.mark.parametrize("which", ["of_a_chain", pytest.param("everything", marks=pytest.mark.long)])
def test_campaign_of_a_written_run_table_has_identical_rows(which, request, tmp_path):
    """Rows of a campaign, in any order, are a run table too.

    Their results are ignored, and each row keeps the noise of its trial.
    """
    made, run_table = request.getfixturevalue(which)
    frame = made.simulate(range(TRIALS))
    run_table.write_csv(tmp_path / "run_table.csv")
    run_table.write_parquet(tmp_path / "run_table.parquet")
    checksums = set()
    for name in ("run_table.csv", "run_table.parquet"):
        again = of_run_table(made, run_tables.read(tmp_path / name))
        checksums.add(run_tables.check_table(run_tables.read(tmp_path / name), made.ready.parts).checksum)
        assert again.run_table is not None
        assert not again.run_table.given  # the program of the original campaign simulates it
        assert_frame_equal(again.simulate(range(TRIALS)), frame, check_exact=True)
    assert len(checksums) == 1
    # rows of a campaign are a valid run table; their results are ignored, and each row has the noise of its trial
    some = of_run_table(made, frame[[40, 7]])
    simulated = some.simulate(range(2))
    assert simulated["run_trial"].to_list() == [40, 7]
    assert_frame_equal(simulated.select(frame.columns[1:]), frame[[40, 7]].select(frame.columns[1:]), check_exact=True)
    assert (
        of_run_table(made, simulated).simulate(range(2)).equals(simulated)
    )  # rows of this campaign are a run table too


def test_written_run_table_has_the_exact_inputs_of_the_campaign(everything, tmp_path):
    made, run_table = everything
    run_table.write_csv(tmp_path / "run_table.csv")
    again = of_run_table(made, run_tables.read(tmp_path / "run_table.csv"))
    assert again.run_table is not None
    assert not again.run_table.given
    assert_frame_equal(again.draw(range(TRIALS)).select(run_table.columns), run_table, check_exact=True)


class Farther(ptsmc.Draw):
    """A custom dispersion that moves the initial state farther away."""

    count = 1

    def at(self, c, parts):
        """Return the parts with the initial state times 2 + 0.1 c[0]."""
        return dataclasses.replace(parts, initial=parts.initial * (2.0 + 0.1 * c[0]))


def test_custom_dispersion_is_not_applied_twice_to_a_run_table():
    """Earlier, the dispersion was applied to its own result, and the angle in the run table was refused."""
    known = scenario.from_tables({"plant": {"kind": "chain"}, "loop": {"mode": "sampled"}})
    drawn = ptsmc.replace(known, dispersion={"custom": {"kind": "custom", "code": Farther}})
    made = campaign.Campaign(scenario.study(drawn), SEED)
    run_table = made.draw(range(5)).drop("custom_1")
    assert run_table["initial_x1"].n_unique() == 5
    again = of_run_table(made, run_table)
    assert again.run_table is not None
    assert not again.run_table.given
    assert_frame_equal(again.draw(range(5)).select(run_table.columns), run_table, check_exact=True)
    other = of_run_table(made, run_table.drop("initial_angle").with_columns(initial_x1=pl.col("initial_x1") + 1.0))
    assert other.run_table is not None
    assert set(other.run_table.given) == {"initial_state"}


def test_other_values_of_a_custom_dispersion_in_a_run_table_are_refused():
    """Earlier, other values in the run table were ignored."""
    known = scenario.from_tables({"plant": {"kind": "chain"}, "loop": {"mode": "sampled"}})
    ready = scenario.study(ptsmc.replace(known, dispersion={"custom": {"kind": "custom", "code": Farther}}))
    written = campaign.Campaign(ready, SEED).draw(range(5))

    def again(table):
        return campaign.from_run_table(
            ready, SEED, run_tables.check_table(table, ready.parts, drawn=ready.dispersion.custom_names())
        )

    assert_frame_equal(again(written).draw(range(5)), written, check_exact=True)
    worst = written[[3, 1]]
    assert again(worst).draw(range(2))["custom_1"].to_list() == worst["custom_1"].to_list()
    for table in (written.with_columns(custom_1=pl.lit(3.0)), worst.drop("trial", "initial_angle")):
        with pytest.raises(
            RefusedError, match=r"^the run table has custom_1 \S+ in row 0, but must have \S+ there, which is"
        ):
            again(table)


@pytest.fixture(scope="module")
def corners(everything):
    """Return a run table of two rows and its campaign. Its values differ from the random ones for every quantity."""
    made, run_table = everything
    generator = np.random.default_rng(1)
    table = run_table.head(2).drop("trial", "initial_angle")
    columns = {name: table[name].to_numpy() * (1.0 + 0.01 * generator.uniform(size=2)) for name in table.columns}
    for what in ("initial", "reference"):
        q = Rotation.from_rotvec(generator.normal(size=(2, 3))).as_quat()
        q[:, 3] += 1.0  # far from 180 degrees
        q /= np.linalg.norm(q, axis=1, keepdims=True)
        columns |= {f"{what}_q{k + 1}": q[:, k] for k in range(4)}
    table = pl.DataFrame({"trial": [5, 9], "seed": [SEED, 11], **columns})
    return table, of_run_table(made, table)


def check_row_values(given, table):
    """Assert that rows of a campaign (`given`) have the values of the run table `table`."""
    assert given["run_trial"].to_list() == [5, 9]
    assert given["run_seed"].to_list() == [SEED, 11]
    for name in set(table.columns) - {"trial", "seed"}:  # quaternions come normalised
        np.testing.assert_allclose(given[name], table[name], rtol=1e-12, err_msg=name)


def test_values_of_a_run_table_are_the_inputs_of_the_trials(corners):
    table, from_table = corners
    check_row_values(from_table.draw(range(2)), table)


alone = programs.jit(montecarlo.one)


# batches are long tests: they compile further programs, and a chain and `test_montecarlo.py` test batches too
@pytest.mark.parametrize(
    "kind", ["alone", *(pytest.param(kind, marks=pytest.mark.long) for kind in ("drawn", "given"))]
)
def test_simulation_with_parts_set_by_hand_reproduces_a_row(everything, corners, kind):
    """Every number of a row is written into the nominal parts by hand."""
    made, rows = everything[0], everything[1].head(2)
    if kind == "alone":
        simulated = [alone(made.ready.parts, made.ready.dispersion, jnp.uint32(SEED), jnp.uint32(k)) for k in range(2)]
        metrics = {name: [float(getattr(one.metrics, name)) for one in simulated] for name in made.ready.catalogue}
        status = [rollout.STATUS[int(one.status)][0] for one in simulated]
        for name in simulated[0].drawn:
            np.testing.assert_allclose(rows[name], [one.drawn[name] for one in simulated], rtol=1e-12, err_msg=name)
        rows = rows.with_columns(status=pl.Series(status), **{name: pl.Series(v) for name, v in metrics.items()})
    elif kind == "drawn":
        rows = made.simulate(range(2))
    else:
        table, from_table = corners
        rows = from_table.simulate(range(2))
        check_row_values(rows, table)
    for row in rows.iter_rows(named=True):
        by_hand = set_by_hand(made.ready.parts, row)
        seed, trial = row.get("run_seed", SEED), row.get("run_trial", row["trial"])
        run = rollout.simulate_parts(by_hand, jnp.uint32(seed), jnp.uint32(trial))
        assert rollout.STATUS[int(run.status)][0] == row["status"]
        for name in made.ready.catalogue:
            value = float(getattr(run.metrics, name))
            assert row[name] == pytest.approx(value, rel=1e-11) or np.isnan(value), name
        turn = Rotation.from_quat(by_hand.reference.q).inv() * Rotation.from_quat(by_hand.initial.q)
        assert row["initial_angle"] == pytest.approx(turn.magnitude(), rel=1e-12)


def set_by_hand(parts, row):
    """Return the nominal parts with every value of a spacecraft row; row: a dict of values by column."""
    row = dict(row)

    def take_vector(name, count):
        """Remove the columns name1, name2, .. from the row and return them as a vector."""
        return vector([row.pop(f"{name}{k}") for k in range(1, count + 1)])

    for what in (*made_of_a_run(), "initial_angle"):
        row.pop(what, None)
    inertia = np.zeros((3, 3))
    for i in range(3):
        for j in range(i, 3):
            inertia[i, j] = inertia[j, i] = row.pop(f"inertia_{i + 1}{j + 1}")
    sinusoid, gradient = parts.disturbance.terms
    phases, amplitudes = take_vector("disturbance_phase_", 4), take_vector("disturbance_amplitude_", 3)
    acting = disturbances.Sum((
        dataclasses.replace(sinusoid, phase=phases[:3], amplitude=amplitudes),
        dataclasses.replace(gradient, phase=phases[3], inertia=vector(inertia)),
        disturbances.Constant(take_vector("disturbance_bias_", 3)),
    ))  # fmt: skip
    noises = {name: vector(row.pop(name)) for name in ("attitude_noise", "rate_noise")}
    by_hand = dataclasses.replace(
        parts,
        plant=rigid_body.spacecraft(inertia),
        disturbance=acting,
        initial=rigid_body.AttitudeState(take_vector("initial_q", 4), take_vector("initial_w", 3)),
        reference=dataclasses.replace(parts.reference, q=take_vector("reference_q", 4)),
        sensors=dataclasses.replace(parts.sensors, given_bias=take_vector("rate_bias_", 3), **noises),
        actuators=dataclasses.replace(parts.actuators, torque_limit=vector(row.pop("torque_limit"))),
    )
    assert not row  # the row has no other inputs
    return by_hand


def made_of_a_run():
    """Return the names of the columns of a row that are not inputs."""
    return ("trial", "run_trial", "run_seed", "status", "reason", "bad_time", *catalogues.CATALOGUES["spacecraft"])


def test_quantities_that_a_run_table_omits_are_random():
    made = campaign.Campaign(ready(CHAIN), SEED)
    run_table = made.draw(range(2))
    states = pl.DataFrame({f"initial_x{k}": [0.1 * k, -0.1] for k in (1, 2, 3)})
    drawn = of_run_table(made, states).draw(range(2))
    given = list(states.columns)
    assert_frame_equal(drawn.select(given), states)
    others = [name for name in run_table.columns if name not in given and name != "initial_angle"]
    assert sum(name.startswith("state_noise") for name in others) == 3
    assert_frame_equal(drawn.select(others), run_table.select(others), rel_tol=1e-14, abs_tol=1e-18)


FILTER = '[filter]\nkind = "steady_state"\n'


@pytest.mark.parametrize("text", [EVERYTHING + FILTER, CHAIN], ids=["spacecraft", "chain"])
def test_quantities_are_read_as_written_and_do_not_change_the_controller(text):
    """A quantity is written into the parts, such as a dispersed inertia, and read from them again."""
    parts = ready(text).parts
    generator = np.random.default_rng(2)
    there = {name: quantity.columns(parts) for name, quantity in QUANTITIES.items()}
    assert sum(map(len, there.values())) > 4
    for name, columns in there.items():
        if not columns:
            continue
        quantity = QUANTITIES[name]
        values = generator.uniform(0.1, 1.0, len(columns))
        written = quantity.write(parts, vector(values))
        np.testing.assert_array_equal(quantity.read(written), values, err_msg=name)
        for one, other in zip(onboard(written), onboard(parts), strict=True):
            assert one is other, name


def onboard(parts):
    """Return the flight software of the parts: controller, observer, and attitude filter or None."""
    return parts.controller, parts.observer, getattr(parts.sensors, "filter", None)


def test_dispersions_do_not_change_the_flight_software():
    whole, drawn = ready(EVERYTHING + FILTER), []
    jax.eval_shape(lambda k: drawn.append(whole.dispersion.apply(whole.parts, 3, k)), jnp.uint32(0))
    assert onboard(whole.parts)[2] is not None
    for one, other in zip(onboard(drawn[0]), onboard(whole.parts), strict=True):
        assert one is other


def test_chain_is_simulated_with_a_run_table():
    """The initial states, and the seeds and trials of the noise, are from the run table."""
    noise = (
        '[dispersion]\nstate_noise = { kind = "relative_normal" }'  # compiled program of `test_run_table_commands.py`
    )
    flight = scenario.from_tables(untuned(SHORT_CHAIN.replace("[dispersion]", noise)))
    states = {"initial_x1": [1.1, -0.4], "initial_x2": [0.2, 0.3]}
    whose = {"trial": [2, 0], "seed": [SEED, 11]}
    simulated = ptsmc.trials(flight, pl.DataFrame(whose | states), seed=SEED)
    assert simulated["run_trial"].to_list() == whose["trial"]
    assert simulated["run_seed"].to_list() == whose["seed"]
    known = scenario.study(flight)
    for k, (trial, seed) in enumerate(zip(*whose.values(), strict=True)):
        row, at = simulated.row(k, named=True), (jnp.uint32(seed), jnp.uint32(trial))
        assert [row[name] for name in states] == [values[k] for values in states.values()]
        drawn = known.dispersion.apply(known.parts, *at)
        start = vector([row[name] for name in states])
        run = rollout.simulate_parts(dataclasses.replace(drawn, initial=start), *at)
        np.testing.assert_allclose(row["state_noise_1"], drawn.sensors.sigma[0], rtol=1e-12)
        for name in ("terminal_error", "peak_torque", "window_error"):
            np.testing.assert_allclose(row[name], getattr(run.metrics, name), rtol=1e-9)


Q = {f"initial_q{k}": [0.0, 0.0] for k in (1, 2, 3)}
J = {f"inertia_{i}{j}": {1: 10.0, 2: 12.0, 3: 14.0}[i] * (i == j) for i in (1, 2, 3) for j in range(i, 4)}
BAD = [
    ({}, "the run table has no rows, but must have one for each trial"),
    ({"inital_w1": [0.0]}, "the run table has the column inital_w1, which no trial of this scenario has; the nearest "
     "known one is initial_w1"),
    ({"controller_ok": [65], "controller_eta": [3.0]},  # column of exported C code, and unknown column
     "the run table has the column controller_eta, which no trial of this scenario has"),
    ({"initial_x1": [0.0]}, "the column initial_x1, which no trial of this scenario has"),
    ({"initial_w1": [0.0], "initial_w2": [0.0]},
     "has the column initial_w1, but not initial_w3: initial_w1 to initial_w3 come together"),
    ({"initial_w1": [0.0, 0.0], "initial_w2": [0.0, np.nan], "initial_w3": [0.0, 0.0]},
     "has initial_w2 nan in row 1, but must have a finite number"),
    ({"torque_limit": [1.0, None]}, "has torque_limit empty in row 1, but must have a finite number"),
    ({"torque_limit": ["1.0", "much"]}, "has torque_limit much in row 1, but must have a finite number"),
    ({"torque_limit": [True]}, "has torque_limit True in row 0, but must have a finite number"),
    ({"torque_limit": [[1.0, 2.0]]}, "has torque_limit [1.0, 2.0] in row 0, but must have a finite number"),
    ({"torque_limit": [1.0, 0.0]}, "has torque_limit 0 in row 1, but must have a number greater than 0"),
    ({"attitude_noise": [-1e-5]}, "has attitude_noise -1e-05 in row 0, but must have numbers of at least 0"),
    (Q | {"initial_q4": [1.0, 0.9]}, "has initial_q1 to initial_q4 = 0, 0, 0, 0.9 in row 1, but must have a unit "
     "quaternion (its norm is 0.9)"),
    ({name: [value, 30.0 if name == "inertia_33" else value] for name, value in J.items()},
     "in row 1, but must have a rigid body's inertia (no rigid body has these principal moments: the largest, 30"),
    ({name: [-value] for name, value in J.items()}, "must be positive definite"),
    ({"trial": [0, -1]}, "has trial -1 in row 1, but must have a whole number from 0 to 4294967295"),
    ({"trial": [0.5]}, "has trial 0.5 in row 0, but must have a whole number"),
    ({"seed": [2**32]}, "has seed 4294967296 in row 0, but must have a whole number"),
    ({"star_tracker_outage_begin": [3.0], "star_tracker_outage_end": [17.0]},  # outages need a filter
     "has the column star_tracker_outage_begin, which no trial of this scenario has"),
]  # fmt: skip


@pytest.mark.parametrize(("columns", "said"), BAD, ids=[row[1][:50] for row in BAD])
def test_invalid_values_of_a_run_table_are_refused_with_row_and_column(everything, columns, said):
    with refuses(RefusedError, said):
        run_tables.check_table(pl.DataFrame(columns, strict=False), everything[0].ready.parts)


HARDWARE = """
spacecraft = { inertia = [10.0, 12.0, 14.0] }
flexible = { frequency = [3.0], damping = [0.01], coupling = [[1.5, 0.0, 0.0]] }
loop = { mode = "sampled", period = 0.1 }
hardware = { attitude_noise = 1e-5, rate_noise = 1e-5 }
filter = { kind = "steady_state", bandwidth = 1.0 }
wheels = { kind = "pyramid", torque_limit = 2.0 }
pointing = { window = 0.16 }
"""
COUPLING = [f"mode_coupling_1{i}" for i in (1, 2, 3)]
OUTAGE = ["star_tracker_outage_begin", "star_tracker_outage_end"]
FAILURE = ["wheel_failure_time", "wheel_failure_wheel"]
ONE_WHEEL = "but must have a time and the number of a wheel, from 1 to 4, or 0 for none"
NO_BODY = "but must have a flexible body's coupling (the inertia minus D'D, the inertia without the modes, must be "
MISFIT = [
    (OUTAGE, [(3.0, 9.0), (9.0, 3.0)],
     f"{OUTAGE[0]} to {OUTAGE[1]} = 9, 3 in row 1, but must have a begin and an end that is not before it"),
    (FAILURE, [(2.0, 9.0)], f"wheel_failure_time to wheel_failure_wheel = 2, 9 in row 0, {ONE_WHEEL}"),
    (FAILURE, [(2.0, 4.0), (2.0, 5.0)], f"= 2, 5 in row 1, {ONE_WHEEL}"),
    (FAILURE, [(2.0, 0.0), (2.0, -3.0)], f"= 2, -3 in row 1, {ONE_WHEEL}"),
    (FAILURE, [(2.0, 1.0), (2.0, 1.5)], f"= 2, 1.5 in row 1, {ONE_WHEEL}"),
    (["timing_jitter"], [(0.3,), (0.31,)],
     "timing_jitter 0.31 in row 1, but must have at most 0.3, so that no period is longer than pointing.window"),
    (COUPLING, [(1.5, 0.0, 0.0), (5.0, 0.0, 0.0)],
     f"mode_coupling_11 to mode_coupling_13 = 5, 0, 0 in row 1, {NO_BODY}positive definite (its smallest "
     "principal moment is -15 kg m^2))"),
    ([*COUPLING, *J], [(3.1, 0.0, 0.0, *body) for body in ((10.0, 0.0, 0.0, 12.0, 0.0, 14.0), (9.0, 0, 0, 9, 0, 9))],
     f"mode_coupling_11 to mode_coupling_13 = 3.1, 0, 0 in row 1, {NO_BODY}positive definite (its smallest principal "
     "moment is -0.61 kg m^2))"),
    ([*J], [(10.0, 0.0, 0.0, 12.0, 0.0, 14.0), (2.0, 0.0, 0.0, 2.0, 0.0, 2.0)],  # the nominal coupling subtracts 2.25
     f"inertia_11 to inertia_33 = 2, 0, 0, 2, 0, 2 in row 1, {NO_BODY.replace('coupling', 'inertia')}positive "
     "definite (its smallest principal moment is -0.25 kg m^2))"),
]  # fmt: skip


@pytest.fixture(scope="module")
def hardware_parts():
    """Return the parts of a spacecraft with wheels, an attitude filter and a flexible mode.

    The tests check run tables against these parts.
    """
    return ready(HARDWARE).parts


def table_of(columns, rows):
    """Return a run table, a data frame of numbers; columns: names, rows: lists of numbers."""
    return pl.DataFrame(rows, schema=dict.fromkeys(columns, pl.Float64), orient="row")


@pytest.mark.parametrize(("columns", "rows", "said"), MISFIT, ids=[row[2][-60:] for row in MISFIT])
def test_impossible_hardware_errors_of_a_run_table_are_refused_with_row_and_column(hardware_parts, columns, rows, said):
    with refuses(RefusedError, said):
        run_tables.check_table(table_of(columns, rows), hardware_parts)


def test_limiting_cases_of_hardware_errors_in_a_run_table_are_accepted(hardware_parts):
    """Outages of zero length, wheel 0 (no failure), the last wheel, and a coupling that needs the row's inertia."""
    heavy = (20.0, 0.0, 0.0, 20.0, 0.0, 20.0)
    rows = [(-1.0, -1.0, 2.0, 0.0, 4.0, 0.0, 0.0, *heavy), (3.0, 3.0, 2.0, 4.0, 0.0, 0.0, 4.4, *heavy)]
    run_table = run_tables.check_table(table_of([*OUTAGE, *FAILURE, *COUPLING, *J], rows), hardware_parts)
    assert [list(values[1]) for values in run_table.given.values()] == [[3, 3], [2, 4], [0, 0, 4.4], list(heavy)]


def test_initial_angle_that_contradicts_the_initial_attitude_of_a_run_table_is_refused(everything):
    made, run_table = everything
    wrong = pl.when(pl.col("trial") == 2).then(3.0).otherwise("initial_angle")
    with pytest.raises(RefusedError, match="has initial_angle 3 in row 2, but must have "):
        of_run_table(made, run_table.with_columns(wrong.alias("initial_angle")))


@pytest.mark.parametrize(("angle", "least"), [(0.5, 1e-5), (20.0, 2e-4)])
def test_rounded_initial_angles_of_a_run_table_are_accepted_and_others_refused(angle, least):
    """The tolerance is 1e-5 rad, or 1e-5 relative to a state |x_1| above 1."""
    said, off = np.array([1.0, angle]), np.array([0.0, least])

    def check(simulated):
        run_tables.check_dependent({"initial_angle": said}, pl.DataFrame({"initial_angle": simulated}), "the run table")

    check(said + 0.9 * off)
    with pytest.raises(RefusedError, match="in row 1, but must have"):
        check(said + 1.1 * off)


def test_run_tables_of_different_trials_have_different_checksums():
    """Values, names, trials, seeds and the number of rows change the checksum. The initial angle does not."""
    numbers, three = np.arange(6.0).reshape(2, 3), np.array([3, 5], np.uint32)
    some = run_tables.RunTable({"initial_rate": numbers}, 2)
    others = [
        dataclasses.replace(some, given={"initial_rate": np.nextafter(numbers, 9.0)}),
        dataclasses.replace(some, given={"disturbance_bias": numbers}),
        dataclasses.replace(some, streams={"trial": three}),
        dataclasses.replace(some, streams={"seed": three}),
        dataclasses.replace(some, given={}, count=3),
    ]
    assert len({one.checksum for one in (some, *others)}) == 6
    assert dataclasses.replace(some, dependent={"initial_angle": np.ones(2)}).checksum == some.checksum


@pytest.mark.parametrize("folder", ["tables[1]", "tables*"])
def test_run_table_in_a_folder_with_wildcards_in_its_name_is_read(tmp_path, folder):
    table = pl.DataFrame({"trial": [4, 2]})
    for name, rows in ((folder, table), ("plans1", table.head(1))):
        (tmp_path / name).mkdir()
        rows.write_csv(tmp_path / name / "run_table.csv")
        rows.write_parquet(tmp_path / name / "run_table.parquet")
    for path in ("run_table.csv", "run_table.parquet"):
        assert run_tables.read(tmp_path / folder / path)["trial"].cast(int).to_list() == [4, 2]


def test_files_that_are_not_run_tables_are_refused(tmp_path):
    for name, content, said in (
        ("none.csv", None, "which does not exist; allowed is a .csv or .parquet file with a row for each trial"),
        ("run_table.txt", b"trial\n1\n", "run_table.txt, but must be a .csv or .parquet file"),
        ("cut.parquet", b"PAR1", "cut.parquet, which cannot be read: "),
        ("empty.csv", b"", "empty.csv, which cannot be read: "),
        ("folder", None, "folder, but must be a .csv or .parquet"),
    ):
        if content is not None:
            (tmp_path / name).write_bytes(content)
        if name == "folder":
            (tmp_path / name).mkdir()
        with refuses(RefusedError, said):
            run_tables.read(tmp_path / name)
    pl.DataFrame({"trial": [1]}).write_parquet(tmp_path / "folder" / "1.parquet")
    pl.DataFrame({"other": [1]}).write_parquet(tmp_path / "folder" / "2.parquet")
    with refuses(RefusedError, "folder, whose 2.parquet cannot be read: "):
        run_tables.read(tmp_path / "folder")
    (tmp_path / "folder" / "1.parquet").write_bytes(b"PAR1")
    with refuses(RefusedError, "folder, whose 1.parquet cannot be read: "):
        run_tables.read(tmp_path / "folder")
