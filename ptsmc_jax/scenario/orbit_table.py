"""The table [orbit] of scenario files. The numbers of an orbit are declared in `signals.orbits`."""

import dataclasses
from typing import Annotated, Any

import numpy as np

from ptsmc_jax.scenario import epochs
from ptsmc_jax.scenario.schema import PartTable, make_table
from ptsmc_jax.scenario.values import Kinds, Meaning, Number
from ptsmc_jax.signals import orbits


class OrbitTable(PartTable, frozen=True):
    """The orbit of references that point to the Earth, and of the gravity gradient."""

    true_anomaly: Annotated[Number, Meaning("angle from perigee to the spacecraft at t = 0", "rad")] = 0.0

    @property
    def mean_anomaly(self) -> float:
        """Mean anomaly at t = 0 [rad]."""
        return orbits.mean_anomaly(self.true_anomaly, float(self.eccentricity))  # pyright: ignore

    def build(self, epoch: str | None) -> Any:
        """Build the orbit with NumPy numbers; epoch: value of `loop.epoch`."""
        names = [field.name for field in dataclasses.fields(orbits.Orbit)]
        numbers = {name: getattr(self, name) for name in names}
        if numbers["earth_angle"] is None:
            numbers["earth_angle"] = 0.0 if epoch is None else orbits.earth_angle(epochs.parse_key(epoch).days)
        return self.part_class(**{name: np.float64(value) for name, value in numbers.items()})


ORBITS: Kinds = {"kepler": make_table(OrbitTable, orbits.Orbit, "kepler")}
