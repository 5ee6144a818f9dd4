"""`ptsmc compare`: tune several control laws to the same requirements and judge them on the same held-out trials.

The laws are the prescribed-time law, the built-in baselines and custom laws. Each is also simulated with a wrong
inertia and an unknown delay. Read `compare` first.
"""

import contextlib
import dataclasses
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from ptsmc_jax.campaigns import store
from ptsmc_jax.campaigns.montecarlo import Trials
from ptsmc_jax.figures import study_plots, style
from ptsmc_jax.numerics.statistics import has_variation, sample_quantile
from ptsmc_jax.scenario import custom, free_gains, parsing, plausibility, replace, requirements, study, systems, tables
from ptsmc_jax.scenario.errors import ScenarioError, wrong
from ptsmc_jax.scenario.law_tables import LAWS, common_keys
from ptsmc_jax.scenario.spacecraft_scenario import SpacecraftScenario
from ptsmc_jax.scenario.tables import Scenario
from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.requirements import Verdict
from tuning.errors import UsageError
from tuning.search import custom_parts, gains
from tuning.search.journal import Journal
from tuning.search.objective import T_F, Problem
from tuning.search.progress import Report, headed
from tuning.studies import judging, stability, tuner

OURS, PUBLISHED = "prescribed_time", "published"  # the prescribed-time law with tuned gains, and with published gains
PUBLISHED_LABEL = "published gains"  # name of `PUBLISHED` in figures and texts
INERTIA_ERROR = 0.1  # relative difference between the true inertia and the design model
MODEL_ERRORS = ("heavier", "lighter", "later")
# keys of `tune` that are the same for every law
SHARED_KEYS = ("minimise", "statistic", "level", "torque_weight", "worst_case", "trials", "starts", "steps")


@dataclass(frozen=True)
class Contender:
    """A law with its gains, judged on held-out trials."""

    simulated: Scenario
    gains: dict[str, float]
    at_bound: dict[str, str]
    widened_bounds: dict[str, tuple[float, float]]
    trials: Trials
    verdicts: list[Verdict]
    lower_bound: float | None  # lower bound of the RMS window error
    margins: dict[str, dict[str, Any]] | None = None  # margins of the nominal loop, see `stability.worst_margins`
    changed: Mapping[str, Trials] = field(default_factory=dict)  # trials with each of the `MODEL_ERRORS`

    @property
    def met(self) -> bool:
        """Whether every requirement is met, every trial reaches its end, and every trial converges by t_f."""
        return judging.meets_requirements(self.verdicts, self.trials)


@dataclass(frozen=True)
class Comparison:
    """All contenders on the same trials: first the published gains if they can be simulated, then the tuned laws."""

    contenders: dict[str, Contender]
    held_out_seed: int
    interrupted: bool
    published_unavailable: str | None = None  # reason why the published gains cannot be simulated

    @property
    def status(self) -> str:
        """Return "interrupted", or "met" if the tuned prescribed-time law meets every requirement, else "not met"."""
        if self.interrupted:
            return "interrupted"
        return "met" if self.contenders[OURS].met else "not met"


def check(scenario: Scenario) -> None:
    """Raise ScenarioError if the other laws cannot control the plant or the loop of the scenario."""
    if scenario.motion != "spacecraft":
        allowed = '"spacecraft", because the comparison changes the inertia; for another plant use ptsmc tune'
        raise wrong("plant.kind", scenario.plant.kind, f"{allowed} for one law at a time")
    if not scenario.sampled:
        raise wrong("loop.mode", scenario.loop.mode, '"sampled": the other laws need the sampled loop')


def law_kinds() -> list[str]:
    """Return the kinds of the compared laws, the prescribed-time law first."""
    return [OURS, *(kind for kind, law in LAWS["spacecraft"].items() if kind != "prescribed_time" and kind != "custom")]


@dataclass(frozen=True)
class Rivals:
    """The laws that the prescribed-time law is compared with."""

    kinds: tuple[str, ...] | None = None  # built-in laws; None: all of them
    custom: tuple[str, ...] = ()  # custom laws, "FILE.py:NAME"

    def check(self) -> None:
        """Raise UsageError if a kind is unknown, or the location of a custom law is malformed or has no file."""
        others = law_kinds()[1:]
        for kind in self.kinds or ():
            if kind not in others:
                allowed = f"one of {', '.join(others)}; repeat the option for several laws"
                raise UsageError(f"--against is {kind}, but must be {allowed} ({OURS} is always compared)")
        for location in self.custom:
            try:
                file, _ = systems.split_name(location, systems.NAME_FORMS)
                if file.endswith(".py") and not Path(file).is_file():
                    raise ValueError(f"the file {file} does not exist")
            except ValueError as error:
                raise UsageError(f"--law is {location}: {error}") from None

    @property
    def law_tables(self) -> dict[str, dict[str, str]]:
        """The keys of the table [controller] that select each law, by its label, the prescribed-time law first."""
        kinds = law_kinds() if self.kinds is None else [OURS, *self.kinds]
        tables = {kind: {"kind": kind} for kind in kinds}
        for code in self.codes:
            tables[_unique_label(code.rpartition(":")[2], tables)] = {"kind": "custom", "code": code}
        return tables

    @property
    def codes(self) -> list[str]:
        """The custom laws as FILE:CLASS or MODULE:CLASS, with symbolic links resolved, without duplicates."""
        parts = (location.rpartition(":") for location in self.custom)
        codes = (f"{os.path.realpath(at)}:{name}" if at.endswith(".py") else f"{at}:{name}" for at, _, name in parts)
        return list(dict.fromkeys(codes))


def _unique_label(name: str, labels: Iterable[str]) -> str:
    """Return a unique label for a custom law: its class name, preceded by "custom" if another law has this label."""
    while name in (PUBLISHED, *labels):
        name = f"custom {name}"
    return name


def contenders(scenario: Scenario, rivals: Rivals = Rivals()) -> dict[str, Scenario]:
    """Return the scenario with each law, by label.

    The scenario's own law has its free gains and bounds from the scenario. The other laws have the default ones. The
    scenario's own law is included if it is among the requested laws, or if it is a custom law.
    """
    table, tune = scenario.controller, scenario.search
    shared = {key: getattr(tune, key) for key in SHARED_KEYS if getattr(tune, key) is not None}
    scenarios = {}
    for name, law in rivals.law_tables.items():
        if _has_law(table, law):
            scenarios[name] = scenario
        elif name == OURS:
            scenarios[name] = _with_default_search(gains.published_scenario(scenario), tune, shared)
        else:
            fields = LAWS["spacecraft"][law["kind"]].__struct_fields__
            both_have_width = "sign_width" in fields and hasattr(table, "sign_width")
            width = {"sign_width": table.sign_width} if both_have_width else {}
            law = {**law, **common_keys(table), **width}
            scenarios[name] = _with_default_search(replace(scenario, tune=None, controller=law), tune, shared)
    if table.kind == "custom" and all(candidate is not scenario for candidate in scenarios.values()):
        scenarios[_unique_label(type(table).__name__, scenarios)] = scenario
    return scenarios


def _has_law(table: Any, law: Mapping[str, str]) -> bool:
    """Return whether a table [controller] has this law; law: its kind, and its code if it is custom.

    Custom laws are compared by file and class name.
    """
    if table.kind != law["kind"] or table.kind != "custom":
        return table.kind == law["kind"]

    def file_and_class(code: str) -> tuple[str, str]:
        return systems.location(code), code.rpartition(":")[2]

    return isinstance(table.code, str) and file_and_class(table.code) == file_and_class(law["code"])


def validated_contenders(scenario: Scenario, rivals: Rivals = Rivals()) -> dict[str, Scenario]:
    """Return the contenders, see `contenders`.

    Raises ScenarioError if a law cannot control the scenario. The check comes before the search, which may take hours.
    """
    candidates = contenders(scenario, rivals)
    for law, candidate in candidates.items():
        try:
            study(candidate)
            free_gains.require_free_gains(candidate)
        except ScenarioError as error:
            raise ScenarioError(f"the law {law} cannot be used in this scenario: {error}") from None
    return candidates


def _with_default_search(other: Scenario, tune: tables.Tune, shared: dict[str, object]) -> Scenario:
    """Return the scenario with the default free gains of its law, and with the same bounds of t_f if t_f is minimised.

    Args:
        other: the scenario with another law.
        tune: the table of the original scenario.
        shared: keys of `tune` that are the same for every law, with their values.
    """
    if tune.minimise != T_F:
        return replace(other, tune=shared)
    free_names = [*replace(other, tune={}).search.gains, "t_f"]
    return replace(other, tune={**shared, "free": free_names, "bounds": {"t_f": tune.bounds["t_f"]}})


def perturbed_scenarios(simulated: Scenario) -> dict[str, Scenario]:
    """Return the scenario with each model error that the law does not know, by the names in `MODEL_ERRORS`.

    The true inertia is 10 % larger or smaller than in the design model, or the delay is one control period longer. A
    variant that is not a valid scenario is left out.
    """
    assert isinstance(simulated, SpacecraftScenario)
    inertia = np.asarray(simulated.true_inertia)
    changes: list[dict[str, object]] = [
        {"spacecraft__true_inertia": ((1.0 + INERTIA_ERROR) * inertia).tolist()},
        {"spacecraft__true_inertia": ((1.0 - INERTIA_ERROR) * inertia).tolist()},
        {"hardware__delay": simulated.devices.delay_periods + 1},
    ]
    variants = {}
    for name, change in zip(MODEL_ERRORS, changes, strict=True):
        with contextlib.suppress(ScenarioError):
            variants[name] = replace(simulated, **change)
    return variants


def _add_margins_and_model_errors(
    contender: Contender, held_out_seed: int, problem: Problem | None = None
) -> Contender:
    """Return the contender with its stability margins, and with its trials under each of the `MODEL_ERRORS`."""
    variants = perturbed_scenarios(contender.simulated)
    changed = {name: judging.judge(variant, held_out_seed, problem) for name, variant in variants.items()}
    margins = stability.worst_margins(study(contender.simulated))
    return dataclasses.replace(contender, margins=margins, changed=changed)


def compare(
    scenario: Scenario,
    seed: int,
    report: Report,
    journal: Journal | None,
    rivals: Mapping[str, Scenario],
) -> Comparison:
    """Tune every law, and judge the tuned laws and the published gains on the same held-out trials.

    Args:
        scenario: the mission, requirements and dispersions for all laws.
        seed: seed of the searches. The seed of the held-out trials follows from it.
        report: called with the progress after every step.
        journal: evaluations of an interrupted comparison, which then resumes.
        rivals: the scenario with each law, as `validated_contenders` returns it.

    Returns:
        The results of each law. If the comparison is interrupted, the laws after the interruption are missing.

    """
    held_out_seed = judging.derive_held_out_seed(seed)
    references, published_error = judging.reference_scenarios(scenario)
    results, interrupted = {}, False
    if PUBLISHED in references:
        report(f"{PUBLISHED_LABEL}: verifying on held-out trials", 0, 0, np.nan, 0.0)
        simulated = judging.on_flight_clock(references[PUBLISHED])
        trials = judging.judge(simulated, held_out_seed)
        verdicts = judging.verdicts_of(simulated, trials, held_out_seed)
        lower_bound = judging.rms_lower_bound(simulated, held_out_seed)
        published_gains = gains.gains_of(study(simulated).parts)
        published = Contender(simulated, published_gains, {}, {}, trials, verdicts, lower_bound)
        results[PUBLISHED] = _add_margins_and_model_errors(published, held_out_seed)
    for number, (law, candidate) in enumerate(rivals.items(), 1):
        law_report = headed(report, f"{law}, law {number} of {len(rivals)}")
        # more tries would judge the laws on different held-out trials
        tuned = tuner.tune(candidate, seed, law_report, journal, with_checks=False, tries=1)
        held_out, lower_bound = tuned.held_out["tuned"], tuned.lower_bounds["tuned"]
        results[law] = Contender(
            tuned.tuned, tuned.gains, tuned.at_bound, tuned.widened_bounds, held_out, tuned.verdicts, lower_bound
        )
        interrupted = tuned.search.interrupted
        if interrupted:
            break
        law_report("simulating a wrong inertia and a longer delay", 0, 0, np.nan, 0.0)
        results[law] = _add_margins_and_model_errors(results[law], held_out_seed, tuned.search.problem)
    return Comparison(results, held_out_seed, interrupted, published_error)


def contender_results(contender: Contender) -> dict[str, object]:
    """Return the results of a contender as in `summary.json`.

    Statistics use the trials that reached their end. The counts and the quantiles of the settling time use all trials.
    """
    trials = contender.trials
    initial_angle, finished = trials.drawn["initial_angle"], trials.finished
    error, interval = judging.rms_window_error(trials)
    settling = np.asarray(trials.metrics.settling_time)
    settled = finished & np.isfinite(settling)
    times, times_or_never = settling[settled], np.where(settled, settling, np.inf)  # infinite: the trial never settles
    depends_on_angle = times.size > 2 and has_variation(initial_angle[settled]) and has_variation(times)
    mean = {name: float(np.mean(getattr(trials.metrics, name)[finished])) if finished.any() else None
            for name in ("peak_torque", "effort", "chattering")}  # fmt: skip
    return {
        "gains": contender.gains,
        "gain_units": gains.units_of(contender.simulated, contender.gains),
        "at_bound": contender.at_bound,
        "widened_bounds": contender.widened_bounds,
        "met": contender.met,
        "counts": trials.counts(),
        "window_error": error,
        "lower_bound": contender.lower_bound,
        "window_error_interval": interval,
        **mean,
        "largest_peak_torque": _largest_peak(trials),
        "unsettled": int(trials.status.size - times.size),
        "settling_time": {str(q): _quantile(times_or_never, q) for q in (0.01, 0.5, 0.99)},
        "settling_near_far": _median_settling_times(initial_angle, times_or_never) if depends_on_angle else None,
        "margins": contender.margins,
        "model_errors": {name: _perturbed_results(other) for name, other in contender.changed.items()},
        "verdicts": [verdict.in_summary() for verdict in contender.verdicts],
    }


def _perturbed_results(trials: Trials) -> dict[str, object]:
    """Return the results of trials with a model error that the law does not know, by name.

    They are the window error with its interval, the largest peak torque, and the number of failures.
    """
    error, interval = judging.rms_window_error(trials)
    return {
        "window_error": error,
        "window_error_interval": interval,
        "largest_peak_torque": _largest_peak(trials),
        "failures": int(np.count_nonzero(~trials.ok)),
    }


def _largest_peak(trials: Trials) -> float | None:
    """Return the largest peak torque of the trials that reached their end [N m]; None: no trial did."""
    return float(np.max(trials.metrics.peak_torque[trials.finished])) if trials.finished.any() else None


def _quantile(times: np.ndarray, q: float) -> float | None:
    """Return a quantile of settling times (trials,) [s], or None if the quantile is infinite.

    A settling time is infinite if the trial never settles.
    """
    value = sample_quantile(np.sort(times), q)
    return value if np.isfinite(value) else None


def _median_settling_times(angle: np.ndarray, times: np.ndarray) -> tuple[float | None, float | None]:
    """Return the median settling times [s] of the fifths of the trials with the smallest and largest initial angles."""
    order = np.argsort(angle)
    fifth = max(1, angle.size // 5)
    return _quantile(times[order[:fifth]], 0.5), _quantile(times[order[-fifth:]], 0.5)


def summary(comparison: Comparison) -> dict[str, Any]:
    """Return the content of `summary.json`."""
    results = comparison.contenders
    first = next(iter(results.values()))
    return {
        "status": comparison.status,
        "seed": comparison.held_out_seed,
        "trials": int(first.trials.status.size),
        "published_unavailable": comparison.published_unavailable,
        "published_label": gains.published_label(results[PUBLISHED].simulated) if PUBLISHED in results else None,
        "judged_on": "flight clock",  # no sign function is named here, because the laws have different ones
        "settling_angle": first.simulated.loop.settling_angle,
        "laws": {law: contender_results(contender) for law, contender in results.items()},
        "warnings": _warnings_by_law(results),
    }


def warn_about_plain_numbers(scenario: Scenario) -> Iterator[str]:
    """Yield a warning about numbers of a custom law that may be gains, but are not declared with `gain` or `number`."""
    table = scenario.controller
    fields = dataclasses.fields(table.part_class) if table.kind == "custom" else ()
    names = [
        field.name
        for field in fields
        if field.name in table.declared and not field.metadata and not isinstance(field.default, tuple)
    ]
    if names:
        is_plain = "it is a plain number" if len(names) == 1 else "they are plain numbers"
        yield (
            f"the search does not tune {', '.join(names)}, because {is_plain} of the class; declare gains with "
            "ptsmc_jax.gain, and other numbers with ptsmc_jax.number"
        )


def _warnings_by_law(results: Mapping[str, Contender]) -> list[str]:
    """Return the warnings of all laws in a list, each text once.

    A warning begins with its laws if it does not concern all of them.
    """
    laws_by_text: dict[str, list[str]] = {}
    for law, contender in results.items():
        texts = plausibility.warnings(contender.simulated, tuned=law != PUBLISHED)
        for text in (*texts, *warn_about_plain_numbers(contender.simulated)):
            laws_by_text.setdefault(text, []).append(PUBLISHED_LABEL if law == PUBLISHED else law)
    return [text if len(laws) == len(results) else f"{', '.join(laws)}: {text}" for text, laws in laws_by_text.items()]


def write(
    folder: Path, scenario: Scenario, comparison: Comparison, figures: bool, identity: Mapping[str, object]
) -> None:
    """Write a result folder: `summary.json`, `compare.csv`, a scenario for each law, and figures.

    Args:
        folder: an empty folder.
        scenario: the scenario of the comparison.
        comparison: the results.
        figures: write figures too.
        identity: entries of `versions.json`, from the function `identity`.
    """
    content = summary(comparison)
    store.write_run_files(folder, parsing.dump(scenario), identity, content)
    (folder / "scenarios").mkdir()
    for law, contender in comparison.contenders.items():
        tables = custom_parts.copy_custom_files(parsing.dump(contender.simulated), folder / "scenarios")
        store.write_toml(folder / "scenarios" / f"{law}.toml", tables)
    store.write_csv(folder / "compare.csv", *_csv_table(scenario, content))
    if figures:
        style.save(dict(plot_figures(comparison)), folder / "figures")


_COLUMNS = ("window_error", "peak_torque", "largest_peak_torque", "effort", "chattering", "unsettled")


def _csv_table(scenario: Scenario, content: Mapping[str, Any]) -> tuple[list[str], list[list[object]]]:
    """Return the header and the rows of `compare.csv`, one row for each law."""
    required = [name for name in catalogues.MARGINS if name in scenario.requirements]
    settling = ("settling_median", "settling_nearest_fifth", "settling_farthest_fifth")
    margins = *(f"worst_{name}" for name in required), *(f"nominal_{name}" for name in catalogues.MARGINS)
    header = ["law", "met", *_COLUMNS, *settling, *margins,
            "window_error_low", "window_error_high", *(f"window_error_{name}" for name in MODEL_ERRORS),
            "gains"]  # fmt: skip

    def row(law: str, figures: Mapping[str, Any]) -> list[object]:
        worst = {v["metric"]: v["worst"] for v in figures["verdicts"]}
        hold = (figures["margins"] or {}).get("hold", {})
        return [
            law, int(figures["met"]), *(figures[name] for name in _COLUMNS),
            figures["settling_time"]["0.5"], *(figures["settling_near_far"] or (None, None)),
            *map(worst.get, required), *map(hold.get, catalogues.MARGINS),
            *(figures["window_error_interval"] or (None, None)),
            *(figures["model_errors"].get(name, {}).get("window_error") for name in MODEL_ERRORS),
            "; ".join(f"{name} = {value:.6g}" for name, value in figures["gains"].items()),
        ]  # fmt: skip

    return header, [row(law, figures) for law, figures in content["laws"].items()]


def plot_figures(comparison: Comparison) -> Iterator[tuple[str, Figure]]:
    """Yield the figures of a comparison with their names."""
    ours = comparison.contenders[OURS]
    # the tuned law is first, as in the figures of `tune`, and has the same colour there
    trials_by_law = {
        PUBLISHED_LABEL if law == PUBLISHED else law: contender.trials
        for law, contender in {OURS: ours, **comparison.contenders}.items()
    }
    t_f = ours.simulated.controller.t_f
    yield "settling", study_plots.settling_by_angle(
        {law: (np.degrees(t.drawn["initial_angle"]), np.where(t.finished, t.metrics.settling_time, np.nan))
         for law, t in trials_by_law.items()}, t_f,
    )  # fmt: skip
    limits = {requirement.metric: requirement.limit for requirement in requirements(ours.simulated)}
    torque = style.torque_metric(limits)
    yield "tradeoff", study_plots.tradeoff(
        {law: (t.metrics.window_error[t.finished], getattr(t.metrics, torque)[t.finished])
         for law, t in trials_by_law.items() if t.finished.any()}, limits,
    )  # fmt: skip


def identity(scenario: Scenario, seed: int, against: Rivals = Rivals()) -> dict[str, object]:
    """Return the entries of `versions.json` that identify a comparison.

    Args:
        scenario: the scenario of the comparison.
        seed: seed of the searches.
        against: the other laws.
    """
    checksums = {code: systems.checksum(code) for code in against.codes}
    laws = {"laws": list(against.law_tables), "custom_laws": checksums} if against != Rivals() else {}
    return {"command": "compare", "seed": seed, **custom.checksums(scenario), **laws}
