"""The table `QUANTITIES` of all quantities that can differ from trial to trial, with functions that read them.

The name of a quantity is also the name of its random stream. Result files and run tables have the same columns. See
`base.Quantity` for the entries of the table.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ptsmc_jax import formulas
from ptsmc_jax.devices.sensors import RATE_BIAS
from ptsmc_jax.dispersions.base import (
    DISTURBANCE_AMPLITUDE,
    DISTURBANCE_BIAS,
    DISTURBANCE_PHASE,
    INERTIA,
    INITIAL_ATTITUDE,
    INITIAL_RATE,
    INITIAL_STATE,
    REFERENCE,
    Quantity,
    TableValues,
    UnfitError,
    error_message,
    field_quantity,
    not_negative,
    number_names,
    positive,
    validator,
)
from ptsmc_jax.dispersions.numbers import (
    Numbers,
    Random,
    replace_nominal,
    rotate_about_axis,
    rotate_from_reference,
    rotate_nominal,
    scale_nominal,
)
from ptsmc_jax.numerics import attitude, matrices, paths
from ptsmc_jax.plants.rigid_body import Spacecraft
from ptsmc_jax.signals import disturbances
from ptsmc_jax.simulation.rollout import Parts

NORM_TOLERANCE = 1e-6  # largest error of the norm of a unit vector or quaternion in a run table
PAIRS = [(i, j) for i in range(3) for j in range(i, 3)]  # the upper triangle, in the order of the inertia's columns
# index in PAIRS for each entry of a symmetric matrix
_PAIR_INDICES = [[PAIRS.index((min(i, j), max(i, j))) for j in range(3)] for i in range(3)]


def level_name(name: str) -> str:
    """Return the name of the quantity whose numbers have a common random factor, such as `torque_limit_level`."""
    return f"{name}_level"


# --- attitudes and inertia ---


def _normalise(q: np.ndarray) -> np.ndarray:
    """Return quaternions (rows, 4) divided by their norms. Norms of 1 up to rounding errors are not corrected.

    Raise UnfitError if a norm differs from 1 by more than `NORM_TOLERANCE`.
    """
    norm = np.linalg.norm(q, axis=1)
    UnfitError.check(np.abs(norm - 1.0) <= NORM_TOLERANCE, lambda k: f"a unit quaternion (its norm is {norm[k]:.9g})")
    is_normalised = np.abs(norm - 1.0) < 1e-14
    return np.where(is_normalised[:, None], q, q / norm[:, None])


def with_body(parts: Parts, body: Spacecraft) -> Parts:
    """Return the parts with another true body. A gravity-gradient torque also acts on that body."""
    return replace(parts, plant=body, disturbance=disturbances.on_body(parts.disturbance, body.inertia))


def _with_inertia(parts: Parts, entries: Numbers) -> Parts:
    """Return the parts with the true inertia of these entries (6,) [kg m^2], in the order of `PAIRS`."""
    inertia = jnp.stack([jnp.stack([entries[k] for k in row]) for row in _PAIR_INDICES])
    return with_body(parts, paths.get(parts, "plant").with_inertia(inertia, matrices.solve(inertia, jnp.eye(3))))


def _to_matrices(rows: np.ndarray) -> np.ndarray:
    """Return symmetric matrices (rows, 3, 3) from upper triangles (rows, 6) in the order of `PAIRS` [kg m^2]."""
    return rows[:, _PAIR_INDICES]


def _check_inertia(rows: np.ndarray) -> np.ndarray:
    """Return the upper triangles (rows, 6) [kg m^2].

    Raise UnfitError if a row is not the inertia of a rigid body.
    """
    tensors = _to_matrices(rows)
    UnfitError.check(
        formulas.is_rigid_body(tensors),
        lambda k: f"a rigid body's inertia ({error_message(formulas.check_inertia, tensors[k])})",
    )
    return rows


def _count_modes(parts: Parts) -> int:
    """Return the number of flexible modes of the true plant."""
    return getattr(parts.plant, "frequency", np.zeros(0)).shape[-1]


def _check_flexible_body(table: TableValues, parts: Parts) -> None:
    """Raise UnfitError if J - D'D is not positive definite for the inertia J and the mode coupling D of a row.

    The nominal J or D is used if the run table does not give it. A rigid body is not checked.
    """
    if not _count_modes(parts):
        return
    body, count = paths.get(parts, "plant"), len(next(iter(table.values())))
    inertia = _to_matrices(table[INERTIA]) if INERTIA in table else np.broadcast_to(body.inertia, (count, 3, 3))
    changed, coupling = "inertia", np.broadcast_to(body.coupling, (count, *body.coupling.shape))
    if "mode_coupling" in table:
        changed, coupling = "coupling", table["mode_coupling"].reshape(coupling.shape)
    UnfitError.check(
        formulas.is_flexible_body(inertia, coupling),
        lambda k: f"a flexible body's {changed} ({error_message(formulas.rest_inertia, inertia[k], coupling[k])})",
    )


# --- disturbance ---


def _disturbance_quantity(name: str, field: Literal["phase", "amplitude"], **others: Any) -> Quantity:
    """Return the quantity of the phases or amplitudes of a disturbance; others: other fields of `Quantity`."""

    def read_field(parts: Parts) -> Numbers:
        return disturbances.values(parts.disturbance, field)

    return Quantity(
        lambda parts: number_names(f"{name}_", read_field(parts).size),
        read_field,
        lambda parts, new: replace(parts, disturbance=disturbances.with_values(parts.disturbance, field, new)),
        **others,
    )


# --- actuators and sample times ---


def channel_directions(parts: Parts) -> Float[Array, "m channels"]:
    """Return the directions (m, channels) [-] of the actuators in the design model: body axes, or wheel axes."""
    wheels = parts.actuators.wheels
    return jnp.eye(parts.plant.inputs) if wheels is None else wheels.axes


def _count_channels(parts: Parts) -> int:
    """Return the number of actuator channels, 0 in the continuous loop."""
    return channel_directions(parts).shape[1] if parts.clock.sampled else 0


def _read_directions(parts: Parts) -> Numbers:
    """Return the true directions of the actuator channels, one after another, (3 channels,) [-]."""
    directions = parts.actuators.directions
    return jnp.ravel((channel_directions(parts) if directions is None else directions).T)


def _rotate_channels(random: Random, nominal: Numbers, parts: Parts) -> Numbers:
    """Return the nominal directions of the channels (3 channels,) [-], each rotated by its rotation vector [rad]."""
    turns, axes = random.reshape(-1, 3), nominal.reshape(-1, 3)
    rotated = [attitude.rotate(attitude.from_rotation_vector(turns[k]), axes[k]) for k in range(axes.shape[0])]
    return jnp.concatenate(rotated)


def _read_wheel_failure(parts: Parts) -> Numbers:
    """Return the failure time [s] and the number of the wheel, from 1, (2,). Without a failure: infinity and 0."""
    times = parts.actuators.failure_times
    if times is None:
        return jnp.array([jnp.inf, 0.0])
    wheel = jnp.argmin(times).astype(float) + 1.0
    return jnp.stack([jnp.min(times), jnp.where(jnp.any(jnp.isfinite(times)), wheel, 0.0)])


def _with_wheel_failure(parts: Parts, failure: Numbers) -> Parts:
    """Return the parts with a wheel that fails; failure: time [s] and number of the wheel from 1, 0 for none."""
    wheel = jnp.arange(channel_directions(parts).shape[1]).astype(float) + 1.0
    return paths.put(parts, "actuators.failure_times", jnp.where(wheel == failure[1], failure[0], jnp.inf))


def _random_wheel_failure(random: Random, nominal: Numbers, parts: Parts) -> Numbers:
    """Return the failure time [s] and the number of the wheel, from a random time and a random number on (0, 1)."""
    return jnp.stack([random[0], 1.0 + jnp.floor(random[1] * channel_directions(parts).shape[1])])


def _check_wheel_failure(table: TableValues, parts: Parts) -> None:
    """Raise UnfitError if a row of the run table has a number of a wheel that the spacecraft does not have."""
    wheel, last = table["wheel_failure"][:, 1], channel_directions(parts).shape[1]
    is_valid = (wheel == np.round(wheel)) & (wheel >= 0.0) & (wheel <= last)
    UnfitError.check(is_valid, lambda row: f"a time and the number of a wheel, from 1 to {last}, or 0 for none")


def _check_jitter(table: TableValues, parts: Parts) -> None:
    """Check that no control period is longer than the averaging window of the pointing metrics."""
    if parts.pointing is not None:
        largest = 0.5 * (float(parts.pointing.window) / float(parts.period) - 1.0)
        message = f"at most {largest:.6g}, so that no period is longer than pointing.window"
        UnfitError.check(table["timing_jitter"][:, 0] <= largest + 1e-9, lambda row: message)


def _vector_columns(name: str, count: int) -> list[str]:
    """Return the columns of `count` vectors (3,), such as name_23 for component 3 of vector 2."""
    return [f"{name}_{k + 1}{i + 1}" for k in range(count) for i in range(3)]


CATEGORIES = ("wheel_failure_wheel",)  # columns without an order

# the order is the order of the columns
QUANTITIES: dict[str, Quantity] = {
    INITIAL_ATTITUDE: field_quantity(
        "initial.q",
        "initial_q",
        combine={"normal": rotate_nominal, "axis_angle": rotate_from_reference, "any_attitude": replace_nominal},
        validate=_normalise,
    ),
    INITIAL_RATE: field_quantity("initial.w", "initial_w", unit="rad/s"),
    INITIAL_STATE: Quantity(
        lambda parts: (
            number_names("initial_x", parts.plant.visible(parts.initial).size) if "x" in parts.plant.signals else []
        ),
        lambda parts: parts.plant.visible(parts.initial),
        lambda parts, x: replace(parts, initial=parts.plant.with_hidden_at_rest(x)),
        unit="",
    ),
    REFERENCE: field_quantity(
        "reference.q",
        "reference_q",
        combine={"normal": rotate_nominal, "axis_angle": rotate_about_axis, "any_attitude": replace_nominal},
        validate=_normalise,
    ),
    INERTIA: Quantity(  # its random numbers: `RelativeInertia`
        lambda parts: [f"{INERTIA}_{i + 1}{j + 1}" for i, j in PAIRS] if hasattr(parts.plant, "with_inertia") else [],
        lambda parts: jnp.stack([paths.get(parts, "plant.inertia")[i, j] for i, j in PAIRS]),
        _with_inertia,
        unit="kg m^2",
        validate=_check_inertia,
        check_together=lambda table, parts: None if "mode_coupling" in table else _check_flexible_body(table, parts),
    ),
    DISTURBANCE_PHASE: _disturbance_quantity(DISTURBANCE_PHASE, "phase", unit="rad"),
    DISTURBANCE_AMPLITUDE: _disturbance_quantity(DISTURBANCE_AMPLITUDE, "amplitude", combine=scale_nominal, unit="N m"),
    DISTURBANCE_BIAS: Quantity(
        lambda parts: number_names(f"{DISTURBANCE_BIAS}_", parts.plant.inputs),
        lambda parts: disturbances.bias(parts.disturbance, parts.plant.inputs),
        lambda parts, bias: replace(parts, disturbance=disturbances.with_bias(parts.disturbance, bias)),
        replace_nominal,
        unit="N m",
    ),
    **{
        level_name(name): field_quantity(
            path, f"{name}_", combine=scale_nominal, size=lambda parts: 1, unit=unit, validate=validate
        )
        for name, path, unit, validate in (
            ("attitude_noise", "sensors.attitude_noise", "rad", not_negative),
            ("rate_noise", "sensors.rate_noise", "rad/s", not_negative),
            ("state_noise", "sensors.sigma", "", not_negative),
            ("torque_limit", "actuators.torque_limit", "N m", positive),
        )
    },
    # gyro bias at the first sample; without a value in a run table, the sensors have a random bias
    RATE_BIAS: field_quantity("sensors.given_bias", f"{RATE_BIAS}_", np.zeros(3), unit="rad/s"),
    "actuator_scale": field_quantity(
        "actuators.scale",
        "actuator_scale_",
        lambda parts: jnp.ones(_count_channels(parts)),
        lambda parts: parts.clock.sampled,
        combine=scale_nominal,
        hardware=True,
    ),
    "actuator_misalignment": Quantity(
        lambda parts: _vector_columns("actuator_misalignment", _count_channels(parts)),
        _read_directions,
        lambda parts, directions: paths.put(parts, "actuators.directions", directions.reshape(-1, 3).T),
        _rotate_channels,
        validate=validator(
            lambda rows: np.abs(np.linalg.norm(rows.reshape(len(rows), -1, 3), axis=2) - 1.0) <= NORM_TOLERANCE,
            "unit vectors, three numbers for each channel",
        ),
        hardware=True,
    ),
    "star_tracker_misalignment": field_quantity(
        "sensors.misalignment", "star_tracker_misalignment_", np.zeros(3), unit="rad", hardware=True
    ),
    "gyro_scale": field_quantity("sensors.rate_scale", "gyro_scale_", np.ones(3), combine=scale_nominal, hardware=True),
    "star_tracker_outage": field_quantity(
        "sensors.outage",
        ("star_tracker_outage_begin", "star_tracker_outage_end"),
        np.full(2, np.inf),
        lambda parts: getattr(parts.sensors, "filter", None) is not None,
        combine=lambda random, nominal, parts: jnp.stack([random[0], random[0] + random[1]]),  # from begin and duration
        unit="s",
        validate=validator(lambda rows: rows[:, 0] <= rows[:, 1], "a begin and an end that is not before it"),
        hardware=True,
    ),
    "wheel_failure": Quantity(
        lambda parts: [] if parts.actuators.wheels is None else ["wheel_failure_time", *CATEGORIES],
        _read_wheel_failure,
        _with_wheel_failure,
        _random_wheel_failure,
        unit=("s", "-"),
        check_together=_check_wheel_failure,
        hardware=True,
    ),
    "timing_jitter": field_quantity(
        "jitter",
        "timing_jitter",
        0.0,
        lambda parts: parts.clock.sampled,
        combine=replace_nominal,
        validate=validator(
            lambda rows: (rows >= 0.0) & (rows < 0.5), "a fraction of the control period from 0 to below 0.5"
        ),
        check_together=_check_jitter,
        hardware=True,
    ),
    "mode_frequency": field_quantity(
        "plant.frequency", "mode_frequency_", combine=scale_nominal, unit="rad/s", validate=positive, hardware=True
    ),
    "mode_coupling": Quantity(
        lambda parts: _vector_columns("mode_coupling", _count_modes(parts)),
        lambda parts: jnp.ravel(paths.get(parts, "plant.coupling")),
        lambda parts, rows: replace(
            parts, plant=paths.put(parts.plant, "coupling", rows.reshape(-1, 3)).with_rest_inverse()
        ),
        scale_nominal,
        _count_modes,
        unit="sqrt(kg) m",
        check_together=_check_flexible_body,
        hardware=True,
    ),
}


def read_columns(parts: Parts, names: Iterable[str]) -> dict[str, Array]:
    """Return the numbers of these quantities by column, in SI units [rad, rad/s, kg m^2, N m]."""
    by_column = {}
    for name, quantity in QUANTITIES.items():
        columns = quantity.columns(parts) if name in names else []
        if columns:
            numbers = quantity.read(parts)
            by_column |= {column: numbers[k] for k, column in enumerate(columns)}
    return by_column


def units(parts: Parts) -> dict[str, str]:
    """Return the unit of each column of these parts and of `initial_angle`, such as "rad" or "-", by column.

    For a plant with custom units, the units of all quantities except angles, times and ratios are empty.
    """
    unit_of = {"initial_angle": parts.controller.kinematics.angle_unit}
    for quantity in QUANTITIES.values():
        columns, unit = quantity.columns(parts), quantity.unit
        column_units = (unit,) * len(columns) if isinstance(unit, str) else unit[: len(columns)]
        known_units = [name if parts.plant.input_unit or name in ("rad", "s", "-") else "" for name in column_units]
        unit_of |= dict(zip(columns, known_units, strict=True))
    return unit_of
