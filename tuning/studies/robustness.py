"""What margins cost: the best gains for each of some limits on the largest sensitivity, judged on fresh trials.

The largest sensitivity, max |S|, bounds the other margins: where it is M, the gain may be at least M / (M - 1) or
M / (M + 1) times as large, and the phase 2 arcsin(1 / (2 M)) off (Skogestad and Postlethwaite, Multivariable Feedback
Control, 2005, 2.4.3); 6 dB keep 6 dB upwards, 3.5 dB downwards and 29 deg. One program flies every limit: each is
searched from scratch, and then starts from what its neighbours found, as the front against the torque does.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ptsmc_jax.campaigns import margin_verdicts, store
from ptsmc_jax.figures import study_plots, style
from ptsmc_jax.scenario import cautions, own, parsing, study, tables
from ptsmc_jax.scenario import replace as changed
from ptsmc_jax.scenario.errors import wrong
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.catalogues import MARGINS
from tuning.search import gains, trust
from tuning.search.journal import Journal
from tuning.search.objective import Problem, replaced
from tuning.search.progress import Report, headed
from tuning.studies import judging, pareto, posing

LIMITS = (3.0, 4.0, 5.0, 6.0, 8.0, 12.0)  # on the largest sensitivity [dB], where none are given
NONE = np.inf
SENSITIVITY = "modulus_margin"
IN_PLACE = ("gain_margin", "phase_margin", SENSITIVITY)  # margins that a limit on the sensitivity stands for


@dataclass(frozen=True)
class Robust:
    """The best gains for a limit on the largest sensitivity."""

    limit: float  # [dB]; infinite: none
    gains: dict[str, float]
    rms: float  # window error over the fresh trials
    interval: tuple[float, float] | None  # of it
    peak: float  # peak torque that the share of fresh trials asked for stays below, or all of them
    margins: dict[str, float]  # each of `catalogues.MARGINS`, the worst of the fresh trials' loops; infinite: no limit
    failures: int  # fresh trials that failed or missed t_f
    meets: bool  # every requirement of the scenario, on the fresh trials


@dataclass(frozen=True)
class Ladder:
    """What was found for each limit, from none to the tightest."""

    robust: list[Robust]
    idle: list[float]  # limits that the gains found for a looser one keep [dB]
    without: list[float]  # limits that no gains keep [dB]
    fresh_seed: int
    trials: int
    floor: float | None  # RMS window error that no controller can beat
    rollouts: int
    gradients: int

    @property
    def status(self) -> str:
        """Whether the gains for some limit meet every requirement on the fresh trials."""
        return "met" if any(one.meets for one in self.robust) else "not met"


def usual_limits(scenario: Scenario) -> tuple[float, ...]:
    """Limits on the largest sensitivity, the scenario's own among them [dB]."""
    own_limit = tables.limit_of(scenario, SENSITIVITY)
    return tuple(sorted({*LIMITS, *([] if own_limit is None else [own_limit])}))


def check(scenario: Scenario) -> None:
    """Raise ScenarioError where there is nothing to ask."""
    against = "to ask what margins cost"
    if not scenario.sampled:
        raise wrong("loop.mode", scenario.loop.mode, f'"sampled" {against}')
    pareto.check_search(scenario, against)


def _limited(scenario: Scenario, limit: float) -> Scenario:
    """The scenario with a limit on the largest sensitivity [dB] in place of the margins that it stands for."""
    kept = {name: one for name, one in parsing.dump(scenario).get("requirements", {}).items() if name not in IN_PLACE}
    return changed(scenario, requirements={**kept, SENSITIVITY: limit})


def _under(problem: Problem, limit: float) -> Problem:
    """The problem with another limit on the largest sensitivity [dB]."""
    asked = problem.margins
    assert asked is not None
    at = asked.metrics.index(SENSITIVITY)
    return replace(problem, margins=replace(asked, wanted=replaced(asked.wanted, at, limit)))


def trace(
    scenario: Scenario,
    seed: int,
    limits: Sequence[float],
    tell: Report = lambda *_: None,
    journal: Journal | None = None,
) -> Ladder:
    """The best gains for none and each of these limits [dB]. Raises KeyboardInterrupt on Ctrl-C."""
    limits = [NONE, *sorted(limits, reverse=True)]
    posed = posing.pose(_limited(scenario, limits[-1]), seed, journal)
    ladder, shares = [], []
    for limit in limits:
        name = f"|S| at most {limit:g} dB" if limit < NONE else "no limit on |S|"
        starts = pareto.FEWER if ladder else scenario.search.starts
        searched = posed.search(
            _under(posed.problem, limit), posed.own, starts, judged=False, report=headed(tell, name)
        )
        outcome = pareto.uninterrupted(searched)
        ladder.append((name, outcome.problem))
        shares.append(outcome.share)
    best = pareto.climbed(ladder, shares, posed, tell)
    apart, fresh_seed, robust, flown = pareto.apart(best), judging.seed_of_judge(seed), [], 0
    for done, k in enumerate(sorted(apart)):
        tell("judging on fresh trials", done, len(apart), np.nan, 0.0)
        named = posed.named(apart[k].share)
        tuned = gains.in_scenario(scenario, named)
        trials = judging.judge(tuned, fresh_seed)
        flown = trials.status.size
        robust.append(
            Robust(
                limit=limits[k],
                gains=named,
                peak=judging.largest(pareto.TORQUE, tuned, trials),
                margins=_margins(tuned, fresh_seed),
                **judging.figures(tuned, trials, fresh_seed),
            )
        )
    return Ladder(
        robust=robust,
        idle=[limits[k] for k in best if k not in apart],
        without=[limit for k, limit in enumerate(limits) if k not in best],
        fresh_seed=fresh_seed,
        trials=flown,
        floor=judging.floor_of(scenario, fresh_seed),
        rollouts=posed.evaluate.rollouts,
        gradients=posed.evaluate.gradients,
    )


def _margins(scenario: Scenario, fresh_seed: int) -> dict[str, float]:
    """Each margin of the scenario's loop, or the worst of the fresh trials' loops where these differ."""
    asked = changed(scenario, requirements=dict.fromkeys(MARGINS, 1.0))
    verdicts = margin_verdicts.over_trials(study(judging.as_flown(asked)), fresh_seed)
    return {verdict.metric: verdict.worst for verdict in verdicts}


def identity(scenario: Scenario, seed: int, limits: Sequence[float]) -> dict[str, Any]:
    """What `versions.json` knows a finished or interrupted study by; limits in [dB]."""
    listed = ",".join(str(float(limit)).removesuffix(".0") for limit in sorted(limits, reverse=True))
    return {"command": "pareto", "seed": seed, "against": "margins", "limits": listed, **own.digests(scenario)}


def summary(ladder: Ladder, scenario: Scenario) -> dict[str, Any]:
    """What `summary.json` says."""
    return {
        "status": ladder.status,
        "against": "margins",
        "plant": scenario.plant.kind,
        "requirements": list(scenario.requirements),
        "trials": ladder.trials,
        "seed": ladder.fresh_seed,
        "interval_confidence": trust.CONFIDENCE,
        "floor": ladder.floor,
        "rollouts": ladder.rollouts,
        "gradients": ladder.gradients,
        "gain_units": gains.units_of(scenario),
        "robust": [_stated(one) for one in ladder.robust],
        "idle": ladder.idle,
        "without": ladder.without,
        "cautions": cautions.of(scenario),
    }


def _stated(one: Robust) -> dict[str, Any]:
    """As `summary.json` has it: null where there is no limit, or no value."""
    stated = asdict(one)
    margins = {name: value if np.isfinite(value) else None for name, value in one.margins.items()}
    return {**stated, "limit": one.limit if one.limit < NONE else None, "margins": margins}


def write(folder: Path, scenario: Scenario, ladder: Ladder, figures: bool, known_by: dict[str, Any]) -> None:
    """Fill a result folder."""
    store.record(folder, parsing.dump(scenario), known_by, summary(ladder, scenario))
    names = gains.named(scenario)
    header = ["limit", *names, "rms_window_error", "rms_low", "rms_high", "peak_torque", *MARGINS, "failures", "meets"]
    rows = [
        [one.limit, *(one.gains[name] for name in names), one.rms, *(one.interval or ("", "")), one.peak,
         *(one.margins[name] for name in MARGINS), one.failures, int(one.meets)]
        for one in ladder.robust
    ]  # fmt: skip
    store.write_csv(folder / "robustness.csv", header, rows)
    if figures and ladder.robust:
        style.save({"robustness": _figure(scenario, ladder.robust)}, folder / "figures")


def _figure(scenario: Scenario, robust: Sequence[Robust]) -> Figure:
    """None stands as far to the right of the loosest limit as that does of the next."""
    limits = [one.limit for one in robust]
    finite = [limit for limit in limits if limit < NONE]
    beyond = 2.0 * finite[0] - finite[1] if len(finite) > 1 else sum(finite) + 1.0
    units = {**catalogues.units(scenario.plant.kind), **{name: margin.unit for name, margin in MARGINS.items()}}
    columns = {"window_error": [one.rms for one in robust], pareto.TORQUE: [one.peak for one in robust]} | {
        name: [one.margins[name] for one in robust] for name in MARGINS if name != SENSITIVITY
    }
    titles = {"window_error": "RMS window error", pareto.TORQUE: "largest peak torque"}
    panels = {
        f"{titles.get(name, name.replace('_', ' '))} [{units[name]}]": (
            np.where(np.isfinite(values), values, np.nan), tables.limit_of(scenario, name)
        )
        for name, values in columns.items()
    }  # fmt: skip
    along = study_plots.Ladder(
        "What margins cost, fresh trials",
        "limit on the largest sensitivity |S| [dB]",
        [limit if limit < NONE else beyond for limit in limits],
        [f"{limit:g}" if limit < NONE else "none" for limit in limits],
    )
    return study_plots.costs(robust, along, panels)
