"""What the commands of a campaign print."""

import itertools
import shlex
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ptsmc_jax.simulation import catalogues
from ptsmc_jax.simulation.catalogues import percent
from tuning.output import campaign_sentences, pointing_sentences, sentences, terminal
from tuning.output.cells import Table
from tuning.output.progress_lines import Bar

if TYPE_CHECKING:
    import polars as pl

    from ptsmc_jax.campaigns.campaign import Tally
    from tuning.studies.campaign_folder import Folder


class Progress(Bar):
    """A progress bar with the trials, how many a second, and failures so far."""

    def __init__(self, quiet: bool):
        super().__init__(quiet)
        self._started: tuple[float, int] | None = None

    def __call__(self, standing: "Tally") -> None:
        """Show where the campaign stands."""
        now = time.monotonic()
        if self._started is None:
            self._started = now, standing.done
        since, before = self._started
        rate = (standing.done - before) / (now - since) if standing.done > before else 0.0
        text = f"{standing.done} of {standing.total} trials"
        if rate:
            text += f", {rate:,.0f} a second" if rate >= 1.0 else f", {rate:.1g} a second"
        elif standing.done < standing.total:
            text += ", compiling"
        text += f", {standing.failed} failed or missed" if standing.failed else ""
        self._bar.update(self._task, completed=standing.done, total=standing.total, description=text)
        self._lines(text, 0, 0)


def campaign(summary: dict[str, Any], folder: Path) -> None:
    """Counts, quantiles and verdicts, as `summary.json` says."""
    terminal.say(*campaign_sentences.counts(summary))
    for table in campaign_sentences.quantiles(summary):
        terminal.table(table)
    terminal.say(*pointing_sentences.heading(summary))
    for table in pointing_sentences.tables(summary):
        terminal.table(table)
    terminal.say(
        *campaign_sentences.error(summary),
        *map(sentences.verdict, summary["verdicts"]),
        *campaign_sentences.drivers(summary),
        *sentences.cautions(summary),
        f"results in {folder}",
    )


def share_done(folder: "Folder", share: tuple[int, int], *, planned: bool) -> None:
    """A share of a campaign, or its plan, is done."""
    if planned:
        print(f"plan of {folder.trials} trials in {folder.dry.folder}; nothing was flown")
        return
    parts, _ = folder.rows.parts()
    there = sum(part.count for part in parts)
    print(f"shard {share[0]}/{share[1]} done: {there} of {folder.trials} trials are in {folder.path}")
    print("when all are there, in this folder or gathered into one: ptsmc summarize DIR")


def worst(frame: "pl.DataFrame", by: str, folder: Path, kind: str, *, own_code: bool = False) -> None:
    """The worst trials, and how to see one in full.

    Args:
        frame: their rows, the worst first.
        by: the metric that they are the worst by.
        folder: the campaign's.
        kind: of the plant.
        own_code: flying it runs code of one's own.
    """
    wanted = ("trial", "status", by, "window_error", "peak_torque", "settling_time", "initial_angle")
    names = [name for name in dict.fromkeys(wanted) if name in frame.columns]
    rows = [
        tuple("-" if v is None else f"{v:.5g}" if isinstance(v, float) else str(v) for v in row)
        for row in frame.select(names).iter_rows()
    ]
    terminal.table(Table(tuple(sentences.with_unit(name, kind) for name in names), rows))
    one = f"ptsmc replay {shlex.quote(str(folder))} --trial {frame['trial'][0]}" + (" --trust" if own_code else "")
    terminal.say(f"whole rows in {folder / 'worst.csv'}; one in full: {one}")


def why(inputs: list[dict[str, Any]], kind: str) -> None:
    """The inputs that the metric goes with in each worst trial, as percentiles of all trials.

    Of one that failed, or where so few trials do not show what a metric goes with, those farthest from the middle.
    inputs: rows as `reasons.why` makes them; kind: of the plant.
    """
    from ptsmc_jax.numerics import statistics

    for (metric, trial), group in itertools.groupby(inputs, lambda row: (row["metric"], row["trial"])):
        rows = list(group)
        value = rows[0]["value"]
        with_share = [row for row in rows if row["first_order"] is not None]
        if with_share and value is not None:
            with_share = [row for row in with_share if statistics.beyond_chance(row, row["trials"])]
            rows = sorted((row for row in with_share if _explained(row) >= COUNTS), key=_explained, reverse=True)
        else:
            rows.sort(key=_unusual, reverse=True)
        texts = [f"{row['input']} {_of(row['drawn'], row['unit'])} {_among(row)}" for row in rows[:4]]
        nothing = f"{metric} goes with nothing that was drawn; what is left is the noise of the trial"
        unit = catalogues.units(kind).get(metric, "")  # of one of one's own none is known
        reached = f"no {metric}" if value is None else f"{metric} {_of(value, unit)}"
        terminal.say(f"{reached} in trial {trial}: {', '.join(texts) or nothing}")


def _among(row: dict[str, Any]) -> str:
    """Where an input of a trial stands among those of all trials, in words."""
    if row["share"] is not None:
        return f"as in {percent(row['share'])} % of the trials"
    return f"at {row['percentile']:.1f} % (median {row['median']:.3g})"


def _unusual(row: dict[str, Any]) -> float:
    """How far an input is from the middle of all trials, or how few of them have the same, 50 at most."""
    return 50.0 * (1.0 - row["share"]) if row["share"] is not None else abs(row["percentile"] - 50.0)


def _of(value: float, unit: str) -> str:
    """A number with its unit."""
    return f"{value:.4g} {unit}".rstrip(" -")


def _explained(row: dict[str, Any]) -> float:
    """The share of its metric's variance that an input explains."""
    return max(row["first_order"], (row["rank_correlation"] or 0.0) ** 2)


COUNTS = 0.05  # of a metric's variance, that an input explains at least to be named as a reason
ROUND_OFF = 1e-9  # relative: of another program's metrics, where the loop magnifies it as loops do


def replayed(off: float | None, rounding: float, same: float) -> None:
    """How far a trial flown again is off its row, and the run with its history off both; same: what counts as equal."""
    if off is None:
        print("the campaign has no row of this trial yet")
    elif off == 0.0:
        print("the trial flown again is equal to its row, to the last digit")
    elif off <= same:
        print(f"the trial flown again is the same as its row to round-off: {off:.1e} off at most, relative")
    else:
        print(
            f"the trial flown again is NOT the same as its row: {_apart(off)}; versions.json says which versions "
            "and which machine the row is of"
        )
    if rounding <= ROUND_OFF:
        print(f"the history is the same flight to round-off: its metrics differ by {rounding:.0e} at most, relative")
    else:
        print(
            f"the history is flown by a program of its own, and its metrics differ: {_apart(rounding)}; a loop that "
            "chatters or breaks off magnifies round-off so"
        )


def _apart(off: float) -> str:
    if off == float("inf"):
        return "it ends another way, or has other values missing"
    return f"{off:.1e} off at most, relative"
