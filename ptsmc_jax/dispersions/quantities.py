"""What a trial flies with, by the names of its columns in rows and plans: read from the parts, and set in them.

A quantity is a row of `QUANTITIES`, by the name of the stream that it is drawn from: what is drawn of it is told in
these columns, and a plan may give it there.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

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
    NEAR,
    PAIRS,
    REFERENCE,
    Numbers,
    Quantity,
    UnfitError,
    not_negative,
    numbered,
    of_field,
    plant_of,
    positive,
    reason,
    tensors,
)
from ptsmc_jax.dispersions.misfits import OF_MISFITS, check_inertia
from ptsmc_jax.numerics import matrices
from ptsmc_jax.plants.rigid_body import Spacecraft
from ptsmc_jax.signals import disturbances
from ptsmc_jax.simulation.rollout import Parts

# of what a trial may have more or less, by one factor: name -> where in the parts it stands, and its unit
LEVELS = {
    "attitude_noise": ("sensors", "attitude_noise", "rad"),
    "rate_noise": ("sensors", "rate_noise", "rad/s"),
    "state_noise": ("sensors", "sigma", ""),
    "torque_limit": ("actuators", "torque_limit", "N m"),
}


def level(name: str) -> str:
    """The stream that a factor of `LEVELS` is drawn from."""
    return f"{name}_level"


def _unit(q: np.ndarray) -> np.ndarray:
    """Unit quaternions (rows, 4); those that are unit ones but for rounding stay to the last digit."""
    norm = np.linalg.norm(q, axis=1)
    UnfitError.check(np.abs(norm - 1.0) <= NEAR, lambda k: f"a unit quaternion (its norm is {norm[k]:.9g})")
    rounding = np.abs(norm - 1.0) < 1e-14
    return np.where(rounding[:, None], q, q / norm[:, None])


def with_body(parts: Parts, body: Spacecraft) -> Parts:
    """The parts with another true body, on which the disturbance acts."""
    return replace(parts, plant=body, disturbance=disturbances.on_body(parts.disturbance, body.inertia))


def _with_inertia(parts: Parts, entries: Numbers) -> Parts:
    named = {pair: entries[k] for k, pair in enumerate(PAIRS)}
    inertia = jnp.stack([jnp.stack([named[min(i, j), max(i, j)] for j in range(3)]) for i in range(3)])
    return with_body(parts, plant_of(parts).with_inertia(inertia, matrices.solve(inertia, jnp.eye(3))))


def _inertia_checked(rows: np.ndarray) -> np.ndarray:
    full = tensors(rows)
    UnfitError.check(
        formulas.bodies(full), lambda k: f"a rigid body's inertia ({reason(formulas.check_inertia, full[k])})"
    )
    return rows


def _of_disturbance(name: str, what: Literal["phase", "amplitude"], unit: str) -> Quantity:
    def read(parts: Parts) -> Numbers:
        return disturbances.values(parts.disturbance, what)

    return Quantity(
        lambda parts: numbered(f"{name}_", read(parts).size),
        read,
        lambda parts, new: replace(parts, disturbance=disturbances.with_values(parts.disturbance, what, new)),
        unit=unit,
    )


def _level(name: str) -> Quantity:
    part, key, unit = LEVELS[name]

    def value_in(parts: Parts) -> Any:
        return getattr(getattr(parts, part), key, None)

    def columns(parts: Parts) -> list[str]:
        value = value_in(parts)
        if value is None:
            return []
        return [name] if value.ndim == 0 else numbered(f"{name}_", value.shape[0])

    def write(parts: Parts, new: Numbers) -> Parts:
        device = getattr(parts, part)
        return replace(parts, **{part: replace(device, **{key: new.reshape(value_in(parts).shape)})})

    checked = positive if name == "torque_limit" else not_negative
    return Quantity(columns, lambda parts: jnp.ravel(value_in(parts)), write, checked, unit=unit)


# in the order of their columns
QUANTITIES: dict[str, Quantity] = {
    INITIAL_ATTITUDE: Quantity(
        lambda parts: numbered("initial_q", 4) if parts.plant.attitude else [],
        lambda parts: parts.initial.q,
        lambda parts, q: replace(parts, initial=parts.initial._replace(q=q)),
        _unit,
    ),
    INITIAL_RATE: Quantity(
        lambda parts: numbered("initial_w", 3) if parts.plant.attitude else [],
        lambda parts: parts.initial.w,
        lambda parts, w: replace(parts, initial=parts.initial._replace(w=w)),
        unit="rad/s",
    ),
    INITIAL_STATE: Quantity(
        lambda parts: [] if parts.plant.attitude else numbered("initial_x", parts.plant.visible(parts.initial).size),
        lambda parts: parts.plant.visible(parts.initial),
        lambda parts, x: replace(parts, initial=parts.plant.with_hidden_at_rest(x)),
        unit="",
    ),
    REFERENCE: of_field("reference", "q", numbered("reference_q", 4), checked=_unit),
    INERTIA: Quantity(
        lambda parts: [f"{INERTIA}_{i + 1}{j + 1}" for i, j in PAIRS] if parts.plant.attitude else [],
        lambda parts: jnp.stack([plant_of(parts).inertia[i, j] for i, j in PAIRS]),
        _with_inertia,
        _inertia_checked,
        check_inertia,
        unit="kg m^2",
    ),
    DISTURBANCE_PHASE: _of_disturbance(DISTURBANCE_PHASE, "phase", "rad"),
    DISTURBANCE_AMPLITUDE: _of_disturbance(DISTURBANCE_AMPLITUDE, "amplitude", "N m"),
    DISTURBANCE_BIAS: Quantity(
        lambda parts: numbered(f"{DISTURBANCE_BIAS}_", parts.plant.inputs),
        lambda parts: disturbances.bias(parts.disturbance, parts.plant.inputs),
        lambda parts, bias: replace(parts, disturbance=disturbances.with_bias(parts.disturbance, bias)),
        unit="N m",
    ),
    **{level(name): _level(name) for name in LEVELS},
    # the gyro's at the first sample, which a sensor draws for itself where none is given: it is read there
    RATE_BIAS: of_field("sensors", "given_bias", numbered(f"{RATE_BIAS}_", 3), [0.0] * 3, unit="rad/s"),
    **OF_MISFITS,
}


# columns that say which of several things, such as the number of a wheel
CATEGORIES = tuple(column for quantity in QUANTITIES.values() for column in quantity.categories)


def read_columns(parts: Parts, names: Iterable[str]) -> dict[str, Array]:
    """The numbers of these quantities by their columns, [rad], [rad/s], [kg m^2] or [N m]: `write` of them = parts."""
    by_column = {}
    for name, quantity in QUANTITIES.items():
        columns = quantity.columns(parts) if name in names else []
        if columns:
            numbers = quantity.read(parts)
            by_column |= {column: numbers[k] for k, column in enumerate(columns)}
    return by_column


def units(parts: Parts) -> dict[str, str]:
    """Units, "rad" or "-" say, by column of all that these parts fly with, `initial_angle` with it.

    Empty where another plant than a spacecraft has units of its own.
    """
    attitude = parts.plant.attitude
    named = {"initial_angle": "rad" if attitude else "x1"}
    for quantity in QUANTITIES.values():
        columns, unit = quantity.columns(parts), quantity.unit
        each = (unit,) * len(columns) if isinstance(unit, str) else unit[: len(columns)]
        known = [one if attitude or one in ("rad", "s", "-") else "" for one in each]
        named |= dict(zip(columns, known, strict=True))
    return named
