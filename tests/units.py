"""Scenarios in other units of time and inertia."""

import copy
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from ptsmc_jax.scenario import keys, layouts
from ptsmc_jax.simulation import catalogues
from tuning.search import gains as gain_names

# powers of the units of inertia and of time in a unit
UNITS = {"kg": (1.0, 0.0), "N": (1.0, -2.0), "s": (0.0, 1.0), "Hz": (0.0, -1.0), "rad": (0.0, 0.0), "deg": (0.0, 0.0),
         "m": (0.0, 0.0), "1": (0.0, 0.0), "-": (0.0, 0.0), "dB": (0.0, 0.0)}  # fmt: skip


def powers(unit: str) -> tuple[float, float]:
    """Return the powers of inertia and time in a unit such as "rad/s/sqrt(Hz)"; lengths are part of the inertia.

    >>> powers("N m s"), powers("rad/s/sqrt(Hz)"), powers("sqrt(kg) m"), powers("1/s^2")
    ((1.0, -1.0), (0.0, -0.5), (0.5, 0.0), (0.0, -2.0))
    """
    total = np.zeros(2)
    for sign, part in re.findall(r"(^|/)([^/]+)", unit):
        for root, name, power in re.findall(r"(sqrt\()?([A-Za-z]+|1|-)\)?(?:\^(\d))?", part):
            weight = (0.5 if root else 1.0) * float(power or 1) * (-1.0 if sign else 1.0)
            total += weight * np.asarray(UNITS[name])
    return float(total[0]), float(total[1])


def in_units(tables: Mapping[str, Any], inertia: float, time: float) -> dict[str, Any]:
    """Return the tables of a scenario with every number in other units, according to the declared units of keys."""
    plant = tables.get("plant", {}).get("kind", "spacecraft")
    layout: Mapping[str, Any] = layouts.TABLES[plant]
    scaled = copy.deepcopy(dict(tables))

    def times(value: Any, unit: str) -> Any:
        if isinstance(value, list | tuple):
            return [times(one, unit) for one in value]
        if isinstance(value, str):
            found = re.fullmatch(r"([-+.\deE]+) (.*)", value)
            assert found is not None
            value = float(found[1]) * catalogues.UNITS[unit][found[2]]
        mass, second = powers(unit)
        return value * inertia**mass * time**second

    def of(table: dict[str, Any], struct: Any) -> None:
        for key in keys.list_keys(struct, catalogues.CATALOGUE["peak_torque"].unit):
            if key.name in table and key.unit and not isinstance(table[key.name], dict):
                table[key.name] = times(table[key.name], key.unit)

    for name, table in scaled.items():
        kinds = layout.get(name)
        if name == "requirements":
            entries = {**catalogues.CATALOGUE, **catalogues.MARGINS}
            units = {metric: entry.unit for metric, entry in entries.items()}
            for metric, value in table.items():
                if isinstance(value, dict):
                    value["limit"] = times(value["limit"], units[metric])
                else:
                    table[metric] = times(value, units[metric])
        elif name == "tune":
            units = gain_names.units(plant)
            for gain, interval in table.get("bounds", {}).items():
                table["bounds"][gain] = times(interval, units[gain].replace("1/s^(2-p)", "-").replace("1/s^p", "-"))
        elif name == "dispersion":
            for key, one in table.items():
                of(one, layouts.DISPERSIONS[key][one["kind"]])
        elif name == "disturbance" and table.get("kind") == "sum":
            for term in table["terms"]:
                of(term, layout["disturbance"][term["kind"]])
        elif kinds is not None:
            of(table, kinds[table.get("kind", next(iter(kinds)))] if isinstance(kinds, Mapping) else kinds)
    return scaled
