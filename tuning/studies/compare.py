"""The paper's law beside others, tuned to the same requirements by the same search, judged on the same trials."""

import contextlib
import dataclasses
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from ptsmc_jax.campaigns import store
from ptsmc_jax.campaigns.montecarlo import Trials
from ptsmc_jax.figures import study_plots, style
from ptsmc_jax.numerics.statistics import value_at, vary
from ptsmc_jax.scenario import cautions, errors, free_gains, own, parsing, replace, study, systems, tables
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.law_tables import LAWS, common_keys
from ptsmc_jax.scenario.spacecraft_scenario import SpacecraftScenario
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.requirements import Verdict
from tuning.errors import UsageError
from tuning.search import gains, own_parts
from tuning.search.journal import Journal
from tuning.search.objective import T_F
from tuning.search.progress import Report, headed
from tuning.studies import judging, stability, tuner

OURS, PAPER = "prescribed_time", "paper"  # the paper's law as tuned, and with the paper's gains
OFF = 0.1  # share by which the inertia differs from what laws are told
UNTOLD = ("heavier", "lighter", "later")
KEPT = (
    "minimise",
    "statistic",
    "level",
    "torque_weight",
    "worst_case",
    "trials",
    "starts",
    "steps",
)  # of `tune`, for every law


@dataclass(frozen=True)
class Contender:
    """A law with its gains, judged on the fresh trials."""

    flown: Scenario
    gains: dict[str, float]
    at_bound: dict[str, str]
    trials: Trials
    verdicts: list[Verdict]
    floor: float | None  # RMS window error that no controller can beat
    margins: dict[str, dict[str, Any]] | None = None  # of the nominal loop, see `stability.worst`
    changed: Mapping[str, Trials] = field(default_factory=dict)  # with what it is not told, see `perturbed`

    @property
    def met(self) -> bool:
        """Every requirement met, and no trial failed or missed t_f."""
        return judging.met(self.verdicts, self.trials)


@dataclass(frozen=True)
class Comparison:
    """All contenders on the same trials: the paper's gains first where they can fly, then the tuned laws."""

    contenders: dict[str, Contender]
    fresh_seed: int
    interrupted: bool
    paper_refused: str | None = None  # why the paper's gains are not among them

    @property
    def status(self) -> str:
        """Whether the tuned law of the paper meets every requirement, in a word."""
        if self.interrupted:
            return "interrupted"
        return "met" if self.contenders[OURS].met else "not met"


def check(scenario: Scenario) -> None:
    """Raise ScenarioError where there is nothing to compare with."""
    if scenario.motion != "spacecraft":
        kind = errors.show(scenario.plant.kind)
        raise ScenarioError(
            f'plant.kind is {kind}, but must be "spacecraft": laws are compared with a wrong inertia, too; for another '
            "plant ptsmc tune finds the gains of one law at a time"
        )
    if not scenario.sampled:
        mode = errors.show(scenario.loop.mode)
        raise ScenarioError(f'loop.mode is {mode}, but must be "sampled": the other laws fly there')


def laws() -> list[str]:
    """The kinds of laws that are compared, the paper's first."""
    return [OURS, *(kind for kind, law in LAWS["spacecraft"].items() if kind != "prescribed_time" and kind != "own")]


@dataclass(frozen=True)
class Rivals:
    """What the paper's law is compared with."""

    kinds: tuple[str, ...] | None = None  # None: all of them
    own: tuple[str, ...] = ()  # laws of one's own, "FILE.py:NAME"

    def check(self) -> None:
        """Raise UsageError where a kind is not known, or a law of one's own is no name."""
        others = laws()[1:]
        for kind in self.kinds or ():
            if kind not in others:
                raise UsageError(f"--against is {kind}, but must be one of {', '.join(others)}")
        for where in self.own:
            try:
                systems.named(where, systems.WHERE)
            except ValueError as error:
                raise UsageError(f"--law is {where}: {error}") from None

    @property
    def named(self) -> dict[str, dict[str, str]]:
        """The law of the table [controller] of each, the paper's first, by what it is called."""
        kinds = laws() if self.kinds is None else [OURS, *self.kinds]
        tables = {kind: {"kind": kind} for kind in kinds}
        for code in self._codes:
            tables[_free_name(code.rpartition(":")[2], tables)] = {"kind": "own", "code": code}
        return tables

    @property
    def _codes(self) -> list[str]:
        """Where the laws of one's own stand, links followed: each once, in however many ways it is written."""
        split = (where.rpartition(":") for where in self.own)
        codes = (f"{os.path.realpath(at)}:{name}" if at.endswith(".py") else f"{at}:{name}" for at, _, name in split)
        return list(dict.fromkeys(codes))

    def identity(self) -> dict[str, Any]:
        """What `versions.json` knows these rivals by; nothing where they are all the kinds that there are."""
        digests = {code: systems.digest(code) for code in self._codes}
        return {"laws": list(self.named), "own_laws": digests} if self != Rivals() else {}


def _free_name(name: str, taken: Iterable[str]) -> str:
    """What a law of one's own is called: as its class, where no other law is."""
    while name in (PAPER, *taken):
        name = f"own {name}"
    return name


def contenders(scenario: Scenario, rivals: Rivals = Rivals()) -> dict[str, Scenario]:
    """The scenario under each law: what is tuned is for the scenario's own as it says, for the others the default.

    Its own is among them where it is one of those asked for, or of the user's own.
    """
    table, tune = scenario.controller, scenario.search
    same = {key: getattr(tune, key) for key in KEPT if getattr(tune, key) is not None}
    posed = {}
    for name, law in rivals.named.items():
        if _is(table, law):
            posed[name] = scenario
        elif name == OURS:
            posed[name] = _posed(gains.papers(scenario), tune, same)
        else:
            fields = LAWS["spacecraft"][law["kind"]].__struct_fields__
            both = "sign_width" in fields and hasattr(table, "sign_width")
            width = {"sign_width": table.sign_width} if both else {}
            law = {**law, **common_keys(table), **width}
            posed[name] = _posed(replace(scenario, tune=None, controller=law), tune, same)
    if table.kind == "own" and all(one is not scenario for one in posed.values()):
        posed[_free_name(type(table).__name__, posed)] = scenario
    return posed


def _is(table: Any, law: Mapping[str, str]) -> bool:
    """Whether the scenario's law is the one that is named; one of one's own by where it stands, links followed."""
    if table.kind != law["kind"] or table.kind != "own":
        return table.kind == law["kind"]

    def place(code: str) -> tuple[Any, str]:
        return systems.location(code), code.rpartition(":")[2]

    return isinstance(table.code, str) and place(table.code) == place(law["code"])


def that_fly(scenario: Scenario, rivals: Rivals = Rivals()) -> dict[str, Scenario]:
    """The contenders; raises ScenarioError where one cannot fly: before hours of search, not after."""
    each = contenders(scenario, rivals)
    for law, posed in each.items():
        try:
            study(posed)
            free_gains.need_some(posed)
        except ScenarioError as error:
            raise ScenarioError(f"the law {law} cannot fly this: {error}") from None
    return each


def _posed(other: Scenario, tune: tables.Tune, same: dict[str, Any]) -> Scenario:
    """With the default gains of its law free, and t_f in the same interval where it is what is minimised."""
    if tune.minimise != T_F:
        return replace(other, tune=same)
    free = [*replace(other, tune={}).search.gains, "t_f"]
    return replace(other, tune={**same, "free": free, "bounds": {"t_f": tune.bounds["t_f"]}})


def perturbed(flown: Scenario) -> dict[str, Scenario]:
    """The scenario with what its law is not told of: another inertia, a control period of delay; those that can fly."""
    assert isinstance(flown, SpacecraftScenario)
    inertia = np.asarray(flown.true_inertia)
    changes: list[dict[str, Any]] = [
        {"spacecraft__true_inertia": ((1.0 + OFF) * inertia).tolist()},
        {"spacecraft__true_inertia": ((1.0 - OFF) * inertia).tolist()},
        {"hardware__delay": flown.devices.delay_periods + 1},
    ]
    others = {}
    for name, change in zip(UNTOLD, changes, strict=True):
        with contextlib.suppress(ScenarioError):
            others[name] = replace(flown, **change)
    return others


def _with_more(one: Contender, fresh_seed: int) -> Contender:
    """With its margins, and flown once more with what its law is not told of."""
    changed = {name: judging.judge(other, fresh_seed) for name, other in perturbed(one.flown).items()}
    return dataclasses.replace(one, margins=stability.worst(study(one.flown)), changed=changed)


def compare(
    scenario: Scenario,
    seed: int,
    tell: Report,
    journal: Journal | None = None,
    rivals: Mapping[str, Scenario] | None = None,
) -> Comparison:
    """Tune every law, and judge them and the paper's gains on trials that none of them saw.

    Args:
        scenario: what all of them fly.
        seed: of the search; fresh trials have one that follows from it.
        tell: is called after every step.
        journal: of evaluations, from which an interrupted comparison goes on.
        rivals: the scenario under each law, as `that_fly` gives them; None: all of them.
    """
    fresh_seed = judging.seed_of_judge(seed)
    rivals = that_fly(scenario) if rivals is None else rivals
    others, refused = judging.beside(scenario)
    found, interrupted = {}, False
    if PAPER in others:
        tell("the paper's gains: judging on fresh trials", 0, 0, np.nan, 0.0)
        found[PAPER] = _with_more(_papers(judging.as_flown(others[PAPER]), fresh_seed), fresh_seed)
    for law, posed in rivals.items():
        report = headed(tell, law)
        tuned = tuner.tune(posed, seed, report, journal, trusted=False, tries=1)  # all on the same fresh trials
        fresh, floor = tuned.fresh["tuned"], tuned.floors["tuned"]
        found[law] = Contender(tuned.tuned, tuned.gains, tuned.at_bound, fresh, tuned.verdicts, floor)
        interrupted = tuned.search.interrupted
        if interrupted:
            break
        report("judging with another inertia and delay than it knows", 0, 0, np.nan, 0.0)
        found[law] = _with_more(found[law], fresh_seed)
    return Comparison(found, fresh_seed, interrupted, refused)


def _papers(flown: Scenario, fresh_seed: int) -> Contender:
    trials = judging.judge(flown, fresh_seed)
    verdicts, floor = judging.verdicts_of(flown, trials, fresh_seed), judging.floor_of(flown, fresh_seed)
    return Contender(flown, gains.gains_of(study(flown).parts), {}, trials, verdicts, floor)


def figures_of(contender: Contender) -> dict[str, Any]:
    """What is said of a contender: over the trials that were flown to the end, but for the counts."""
    trials = contender.trials
    rank: Any = stats.spearmanr
    angle, finished = trials.drawn["initial_angle"], trials.finished
    error, interval = judging.window_error(trials)
    settling = np.asarray(trials.metrics.settling_time)
    settled = finished & np.isfinite(settling)
    times, times_or_never = settling[settled], np.where(settled, settling, np.inf)  # never is beyond every quantile
    spread = times.size > 2 and vary(angle[settled]) and vary(times)
    mean = {name: float(np.mean(getattr(trials.metrics, name)[finished])) if finished.any() else None
            for name in ("peak_torque", "effort", "chattering")}  # fmt: skip
    return {
        "gains": contender.gains,
        "at_bound": contender.at_bound,
        "met": contender.met,
        "counts": trials.counts(),
        "window_error": error,
        "floor": contender.floor,
        "window_error_interval": interval,
        **mean,
        "largest_peak_torque": _largest_peak(trials),
        "unsettled": int(trials.status.size - times.size),
        "settling_time": {str(q): _quantile(times_or_never, q) for q in (0.01, 0.5, 0.99)},
        # how far settling hangs on where a trial starts: rank correlation, and seconds from the nearest to the farthest
        "settling_by_angle": float(rank(angle[settled], times)[0]) if spread else None,
        "settling_near_far": _near_far(angle, times_or_never) if spread else None,
        "margins": contender.margins,
        "untold": {name: _perturbed_figures(other) for name, other in contender.changed.items()},
        "verdicts": [verdict.in_summary() for verdict in contender.verdicts],
    }


def _perturbed_figures(trials: Trials) -> dict[str, Any]:
    """What is said of trials with something that the law is not told of."""
    error, interval = judging.window_error(trials)
    return {
        "window_error": error,
        "window_error_interval": interval,
        "largest_peak_torque": _largest_peak(trials),
        "lost": int(np.count_nonzero(~trials.ok)),
    }


def _largest_peak(trials: Trials) -> float | None:
    """The largest peak torque [N m] of the trials that were flown to the end; None: none was."""
    return float(np.max(trials.metrics.peak_torque[trials.finished])) if trials.finished.any() else None


def _quantile(times: np.ndarray, q: float) -> float | None:
    """A quantile of settling times [s], infinite where a trial never settles; None: never."""
    value = value_at(np.sort(times), q)
    return value if np.isfinite(value) else None


def _near_far(angle: np.ndarray, times: np.ndarray) -> tuple[float | None, float | None]:
    """Median settling times of the nearest and the farthest fifth of the starts [s]; see `_quantile`."""
    order = np.argsort(angle)
    fifth = max(1, angle.size // 5)
    return _quantile(times[order[:fifth]], 0.5), _quantile(times[order[-fifth:]], 0.5)


def summary(comparison: Comparison) -> dict[str, Any]:
    """What `summary.json` says."""
    found = comparison.contenders
    first = next(iter(found.values()))
    return {
        "status": comparison.status,
        "seed": comparison.fresh_seed,
        "trials": int(first.trials.status.size),
        "paper_refused": comparison.paper_refused,
        "paper_is": gains.paper_is(found[PAPER].flown) if PAPER in found else None,
        "judged_on": "flight clock",  # each with a sign of its own, or none
        "settling_angle": first.flown.loop.settling_angle,
        "laws": {law: figures_of(contender) for law, contender in found.items()},
        "cautions": list(dict.fromkeys(text for one in found.values() for text in cautions.of(one.flown))),
    }


def write(folder: Path, scenario: Scenario, comparison: Comparison, figures: bool, known_by: Mapping[str, Any]) -> None:
    """Fill a result folder."""
    said = summary(comparison)
    store.record(folder, parsing.dump(scenario), known_by, said)
    (folder / "scenarios").mkdir()
    for law, contender in comparison.contenders.items():
        tables = own_parts.carry(parsing.dump(contender.flown), folder / "scenarios")
        store.write_toml(folder / "scenarios" / f"{law}.toml", tables)
    store.write_csv(folder / "compare.csv", *_rows(scenario, said))
    if figures:
        style.save(dict(_figures(comparison)), folder / "figures")


_SHARES = ("0.01", "0.5", "0.99")
_COLUMNS = ("met", "window_error", "peak_torque", "largest_peak_torque", "effort", "chattering", "unsettled",
            "settling_by_angle")  # fmt: skip


def _rows(scenario: Scenario, said: Mapping[str, Any]) -> tuple[list[str], list[list[Any]]]:
    """Head and rows of `compare.csv`, a law each."""
    required = [name for name in catalogues.MARGINS if name in scenario.requirements]
    nominal = [name for name in catalogues.MARGINS if name not in required]  # of the nominal loop in hold
    head = ["law", *_COLUMNS, *(f"settling_time_{100 * float(q):g}" for q in _SHARES), *required, *nominal,
            "window_error_low", "window_error_high", *(f"window_error_{name}" for name in UNTOLD), "gains"]  # fmt: skip

    def row(law: str, figures: Mapping[str, Any]) -> list[Any]:
        worst = {v["metric"]: v["worst"] for v in figures["verdicts"]}
        hold = (figures["margins"] or {}).get("hold", {})
        return [
            law, *(figures[name] for name in _COLUMNS), *((figures["settling_time"] or {}).get(q) for q in _SHARES),
            *map(worst.get, required), *map(hold.get, nominal), *(figures["window_error_interval"] or (None, None)),
            *(figures["untold"].get(name, {}).get("window_error") for name in UNTOLD),
            "; ".join(f"{name} = {value:.6g}" for name, value in figures["gains"].items()),
        ]  # fmt: skip

    return head, [row(law, figures) for law, figures in said["laws"].items()]


def _figures(comparison: Comparison) -> Iterator[tuple[str, Any]]:
    sets = {law: contender.trials for law, contender in comparison.contenders.items()}
    ours = comparison.contenders[OURS]
    t_f = ours.flown.controller.t_f
    yield "settling", study_plots.settling_by_angle(
        {law: (np.degrees(t.drawn["initial_angle"]), np.where(t.finished, t.metrics.settling_time, np.nan))
         for law, t in sets.items()}, t_f,
    )  # fmt: skip
    limit = tables.limit_of(ours.flown, "peak_torque")
    yield "tradeoff", study_plots.tradeoff(
        {law: (t.metrics.window_error[t.finished], t.metrics.peak_torque[t.finished]) for law, t in sets.items()
         if t.finished.any()}, limit,
    )  # fmt: skip


def identity(scenario: Scenario, seed: int, against: Rivals = Rivals()) -> dict[str, Any]:
    """What `versions.json` knows a finished or interrupted comparison by."""
    return {"command": "compare", "seed": seed, **own.digests(scenario), **against.identity()}
