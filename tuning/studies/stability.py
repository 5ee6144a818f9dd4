"""`ptsmc margins`: gain, phase and delay margins and the peak sensitivity of a scenario's loop.

The loop is linearised along the nominal run: at samples of the approach phase and in the hold phase. Read
`find_margins` first.
"""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from ptsmc_jax.campaigns import margin_verdicts, store
from ptsmc_jax.scenario import Study, custom, errors, parsing, study
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation import rollout
from ptsmc_jax.simulation.catalogues import CATALOGUES, NO_SIGN
from ptsmc_jax.theory import margins, run_margins
from ptsmc_jax.theory.limit_cycles import LimitCycle
from ptsmc_jax.theory.margins import FIELDS
from ptsmc_jax.theory.run_margins import Course

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def find_margins(scenario: Scenario) -> tuple[Study, Course]:
    """Return the study of a scenario, and the margins along its nominal run.

    Raises ScenarioError if the loop is continuous, if it has no finite derivatives in the hold phase, or if the nominal
    run does not reach its end.
    """
    if not scenario.sampled:
        raise ScenarioError(f'margins need the sampled loop, but loop.mode is "{scenario.loop.mode}"')
    ready = study(scenario)
    if ready.missing_derivative is not None:
        raise ScenarioError(f"margins need the derivative of the law, but {ready.missing_derivative}")
    course = run_margins.margins_along_run(ready.parts)
    without_derivatives, code = np.isnan(course.hold[1].peak_sensitivity).any(), rollout.OK
    if course.singularity_distance < rollout.SINGULAR_DISTANCE:
        code = rollout.SINGULAR
    elif without_derivatives:
        code = int(rollout.simulate_parts(ready.parts, np.uint32(0), np.uint32(0)).status)
    if code not in rollout.FINISHED:
        status, reason = rollout.STATUS[code]
        raise ScenarioError(f"margins need a nominal run that reaches its end, but it ends {status}: {reason}")
    if without_derivatives:
        raise ScenarioError(
            f"margins need finite derivatives of the loop by all of its states, but with controller.kind = "
            f"{errors.show(scenario.controller.kind)} a derivative is not finite in the hold phase; use another law"
        )
    return ready, course


def worst_margins(ready: Study) -> dict[str, dict[str, Any]] | None:
    """Return the margins of the worst axis "before" the hand-over, at the samples that are judged, and in "hold".

    Returns:
        Margins in [dB], [deg] and [s] for both phases, and whether the loops of all axes are "stable". If the nominal
        run ends in a limit cycle, positive margins in "hold" are replaced by 0, and "limit_cycle" has the amplitude
        and the period of the cycle. The result is None for a continuous loop, for a custom law without a derivative,
        and if the loop has no finite derivatives in the hold phase.
    """
    if not ready.scenario.sampled or ready.missing_derivative is not None:
        return None
    sample_margins, hold, limit_cycle = run_margins.judge_run(ready.parts)
    if np.isnan(sample_margins.peak_sensitivity[-1]).any():
        return None
    phases = {}
    for phase, mask in (("before", ~hold), ("hold", hold)):
        if mask.any():
            phase_margins = jax.tree.map(lambda v, mask=mask: v[mask], sample_margins)
            smallest = {name: _finite_or_none(value) for name, value in phase_margins.worst().items()}
            phases[phase] = {"stable": bool(phase_margins.stable.all()), **smallest}
    if limit_cycle is not None:
        phases["hold"] |= _limit_cycle_entry(ready.scenario, limit_cycle)
    return phases


def _limit_cycle_entry(scenario: Scenario, limit_cycle: LimitCycle) -> dict[str, Any]:
    """Return {"limit_cycle": ..} for `summary.json`: fields of the limit cycle by name, and the unit of its size."""
    unit = CATALOGUES[scenario.plant.kind]["peak_torque"].unit
    return {"limit_cycle": {**limit_cycle._asdict(), "unit": unit}}


def _finite_or_none(value: float) -> float | None:
    """Return the number, or None if it is not finite."""
    return float(value) + 0.0 if np.isfinite(value) else None  # + 0.0 replaces -0 by 0


def signal_names(ready: Study) -> tuple[list[str], list[str]]:
    """Return the names of the inputs and the names of the measured signals."""
    plant = ready.parts.plant
    return plant.input_labels, plant.signal_labels(plant.visible(ready.parts.initial))


def summary(ready: Study, course: Course) -> dict[str, Any]:
    """Return the content of `summary.json`: margins in [dB], [deg] and [s]; null: infinite, or no value."""
    inputs, signals = signal_names(ready)
    (_, hold), before = course.hold, course.before_hand_over

    def table(
        loop_margins: margins.Margins, labels: list[str], fields: tuple[str, ...]
    ) -> dict[str, dict[str, float | None]]:
        return {
            label: {name: _finite_or_none(getattr(loop_margins, name)[k]) for name in fields}
            for k, label in enumerate(labels)
        }

    def open_inputs(k: int) -> dict[str, list[str]]:
        """Return the inputs with an open loop at sample k, and those of them that an actuator limit opens."""
        loop_margins, new = jax.tree.map(lambda v: v[k], (course.at_input, course.loops.new))
        is_open = loop_margins.is_open
        has_no_effect = is_open & ~np.any(new[0], axis=0)  # no state depends on the command: an actuator limit cuts it
        return {key: [name for name, selected in zip(inputs, masks, strict=True) if selected]
                for key, masks in (("open", is_open), ("cut", has_no_effect))}  # fmt: skip

    t_f = float(ready.parts.controller.t_f)
    return {
        "stable": bool(hold.stable.all()),
        **open_inputs(-1),
        "worst": {name: _finite_or_none(v) for name, v in course.worst().items()},
        "hold": table(hold, inputs, (*FIELDS, "crossover")),
        "together": {name: _finite_or_none(course.together[name]) for name in FIELDS},
        "sensors": table(course.at_sensors, signals, tuple(name for name in FIELDS if name != "delay")),
        "before": [
            {
                "time_to_go": t_f - float(t),
                "judged": bool(counts),
                "stable": bool(before.stable[k].all()),
                **{
                    name: _finite_or_none((max if name == "peak_sensitivity" else min)(getattr(before, name)[k]))
                    for name in FIELDS
                },
                **open_inputs(k),
            }
            for k, (t, counts) in enumerate(zip(course.t[:-1], course.judged, strict=False))
        ],
        **({"not_converged": True} if course.not_converged else {}),
        **({"dispersed": margin_verdicts.TRIALS} if margin_verdicts.has_different_loops(ready.dispersion) else {}),
        "note": NO_SIGN if ready.scenario.has_discontinuous_sign else None,
        **_initial_angle_entry(ready),
        **({} if course.limit_cycle is None else _limit_cycle_entry(ready.scenario, course.limit_cycle)),
    }


def _initial_angle_entry(ready: Study) -> dict[str, float]:
    """Return {"start_deg": initial angle to the reference in the nominal run [deg]}, or {} for other plants."""
    parts, kinematics = ready.parts, ready.parts.controller.kinematics
    if kinematics.angle_unit != "rad":
        return {}
    return {"start_deg": float(np.rad2deg(kinematics.angle(parts.initial, parts.reference(jnp.zeros(())))))}


def write(folder: Path, ready: Study, course: Course, figures: bool) -> None:
    """Write a result folder: `summary.json`, `margins.csv` and figures.

    Args:
        folder: an empty folder.
        ready: the scenario, ready to simulate.
        course: margins along the nominal run.
        figures: write figures too.
    """
    scenario = ready.scenario
    made_by = {"command": "margins", "seed": None, **custom.checksums(scenario)}
    store.write_run_files(folder, parsing.dump(scenario), made_by, summary(ready, course))
    inputs, _ = signal_names(ready)
    t_f = float(ready.parts.controller.t_f)
    rows = [
        [t, t_f - t, name, *(float(getattr(course.at_input, field)[j, k]) for field in (*FIELDS, "crossover")),
         int(course.at_input.stable[j, k]), int(course.judged[j])]
        for j, t in enumerate(course.t.tolist())
        for k, name in enumerate(inputs)
    ]  # fmt: skip
    columns = ["t", "time_to_go", "axis", "gain_up_dB", "gain_down_dB", "phase_deg", "delay_s", "peak_sensitivity_dB",
               "crossover_rad_s", "stable", "judged"]  # fmt: skip
    store.write_csv(folder / "margins.csv", columns, rows)
    if figures:
        from ptsmc_jax.figures import style

        style.save(figures_of(ready, course), folder / "figures")


def figures_of(ready: Study, course: Course) -> dict[str, "Figure"]:
    """Return the figures of the margins by name."""
    from ptsmc_jax.figures import margin_plots  # slow import, not needed without figures

    inputs, _ = signal_names(ready)
    loop, hold = course.hold
    w, responses = margins.responses(loop)
    limits = {requirement.metric: requirement.limit for requirement in ready.margins}
    return {
        "nichols": margin_plots.nichols(responses, inputs, limits),
        "sensitivity": margin_plots.sensitivity(w, responses, inputs, limits),
        "margins": margin_plots.margins_over_time(
            float(ready.parts.controller.t_f) - course.t[:-1],
            course.judged[:-1],
            course.before_hand_over,
            hold,
            limits,
        ),
    }
