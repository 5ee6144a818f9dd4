"""`ptsmc margins`: what gain, phase, delay and sensitivity the loop of a scenario leaves, and where."""

from pathlib import Path
from typing import Any

import numpy as np

from ptsmc_jax import margins, schema, store, systems
from ptsmc_jax.margins import Course
from ptsmc_jax.plants import Spacecraft
from ptsmc_jax.scenario import Study, study
from ptsmc_jax.schema import ScenarioError
from ptsmc_jax.tables import Scenario

FIELDS = ("gain_up", "gain_down", "phase", "delay", "modulus")
_NO_SIGN = "the exact sign has no slope: it counts as if it were not there"


def find(scenario: Scenario) -> tuple[Study, Course]:
    """Margins of a scenario with the sampled loop, along its nominal run. Raises ScenarioError without one."""
    if scenario.loop.mode != "sampled":
        raise ScenarioError(f'margins need the sampled loop, but loop.mode is "{scenario.loop.mode}"')
    ready = study(scenario)
    return ready, margins.along(ready.parts)


def worst(ready: Study) -> dict[str, dict[str, float | None]] | None:
    """Margins of the worst axis at the last sample before the "hand_over" and in "hold"; None: no sampled loop."""
    if ready.scenario.loop.mode != "sampled":
        return None
    return {
        where: {name: _number(value) for name, value in found.worst().items()}
        for where, (found, _) in margins.at_ends(ready.parts).items()
    }


def _number(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None


def names(ready: Study) -> tuple[list[str], list[str]]:
    """Of the inputs, and of what the sensors see."""
    plant = ready.parts.plant
    if isinstance(plant, Spacecraft):
        return list("xyz"), [f"{what} {axis}" for what in ("attitude", "rate") for axis in "xyz"]
    size = np.asarray(ready.parts.initial).size
    return [f"u{k + 1}" for k in range(plant.inputs)], [f"x{k + 1}" for k in range(size)]


def summary(ready: Study, course: Course) -> dict[str, Any]:
    """What `summary.json` says: [dB], [deg], [s]; null: no limit, or no value."""
    inputs, seen = names(ready)
    hold, before = ({name: getattr(course.at_input, name)[rows] for name in (*FIELDS, "stable", "crossover")}
                    for rows in (-1, slice(0, -1)))  # fmt: skip

    def table(found: dict[str, np.ndarray], labels: list[str], fields: tuple[str, ...]) -> dict[str, Any]:
        return {label: {name: _number(found[name][k]) for name in fields} for k, label in enumerate(labels)}

    held = margins.Margins(*(v[-1] for v in course.at_input)).worst()
    t_f = float(ready.parts.controller.t_f)
    exact = getattr(ready.scenario.controller, "sign_width", None) == 0.0
    return {
        "stable": bool(hold["stable"].all()),
        "worst": {name: _number(v) for name, v in held.items()},
        "hold": table(hold, inputs, (*FIELDS, "crossover")),
        "together": {name: _number(course.together[name]) for name in FIELDS},
        "sensors": table(course.at_sensors._asdict(), seen, ("gain_up", "gain_down", "phase", "modulus")),
        "before": [
            {
                "time_to_go": t_f - float(t),
                "stable": bool(before["stable"][k].all()),
                **{
                    name: _number(getattr(np, "max" if name == "modulus" else "min")(before[name][k]))
                    for name in FIELDS
                },
            }
            for k, t in enumerate(course.t[:-1])
        ],
        "said": _NO_SIGN if exact else None,
    }


def write(folder: Path, ready: Study, course: Course, figures: bool) -> None:
    """Fill a result folder."""
    scenario = ready.scenario
    store.write_toml(folder / "scenario.toml", schema.dump(scenario))
    source = systems.source(getattr(scenario.plant, "system", None))
    store.write_json(folder / "versions.json", store.versions("margins", None, **source))
    store.write_json(folder / "summary.json", summary(ready, course))
    inputs, _ = names(ready)
    t_f = float(ready.parts.controller.t_f)
    rows = [
        [t, t_f - t, name, *(float(getattr(course.at_input, field)[j, k]) for field in (*FIELDS, "crossover")),
         int(course.at_input.stable[j, k])]
        for j, t in enumerate(course.t.tolist())
        for k, name in enumerate(inputs)
    ]  # fmt: skip
    units = ("gain_up_dB", "gain_down_dB", "phase_deg", "delay_s", "modulus_dB", "crossover_rad_s", "stable")
    store.write_csv(folder / "margins.csv", ["t", "time_to_go", "axis", *units], rows)
    if figures:
        from ptsmc_jax import drawing, margin_plots

        w, seen = margins.responses(course.hold)
        before = margins.Margins(*(v[:-1] for v in course.at_input))
        hold = margins.Margins(*(v[-1] for v in course.at_input))
        made = {
            "nichols": margin_plots.nichols(seen, inputs),
            "sensitivity": margin_plots.sensitivity(w, seen, inputs),
            "margins": margin_plots.over_time(t_f - course.t[:-1], before, hold),
        }
        drawing.save(made, folder / "figures")
