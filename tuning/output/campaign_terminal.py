"""What the commands of a campaign print."""

import math
import time
from pathlib import Path
from typing import Any

from tuning.output import pointing_sentences, sentences, terminal
from tuning.output.progress_lines import Bar


class Progress(Bar):
    """A progress bar with the trials, how many a second, and failures so far."""

    def __init__(self, quiet: bool):
        super().__init__(quiet)
        self._started: tuple[float, int] | None = None

    def __call__(self, standing: Any) -> None:
        """standing: a `campaign.Tally`."""
        now = time.monotonic()
        if self._started is None:
            self._started = now, standing.done
        since, before = self._started
        rate = (standing.done - before) / (now - since) if standing.done > before else 0.0
        text = f"{standing.done} of {standing.total} trials"
        text += f", {rate:,.0f} a second" if rate else ", compiling" if standing.done < standing.total else ""
        text += f", {standing.failed} failed or missed" if standing.failed else ""
        self._bar.update(self._task, completed=standing.done, total=standing.total, description=text)
        self._lines(text, 0, 0)


def campaign(found: dict[str, Any], folder: Path) -> None:
    """Counts, quantiles and verdicts, as `summary.json` says."""
    terminal.say(*sentences.campaign_counts(found))
    terminal.table(sentences.campaign(found))
    terminal.say(*pointing_sentences.heading(found))
    for table in pointing_sentences.tables(found):
        terminal.table(table)
    terminal.say(
        *sentences.campaign_error(found),
        *map(sentences.verdict, found["verdicts"]),
        *sentences.campaign_drivers(found),
        *sentences.cautions(found),
        f"results in {folder}",
    )


def share_done(folder: Any, share: tuple[int, int], *, planned: bool) -> None:
    """A share of a campaign, or its plan, is done."""
    if planned:
        print(f"plan of {folder.trials} trials in {folder.dry.folder}; nothing was flown")
        return
    parts, _ = folder.rows.parts()
    there = sum(part.count for part in parts)
    print(f"shard {share[0]}/{share[1]} done: {there} of {folder.trials} trials are in {folder.path}")
    print("when all are there, in this folder or gathered into one: ptsmc summarize DIR")


def worst(frame: Any, by: str, folder: Path, kind: str, *, own_code: bool = False) -> None:
    """The worst trials, and how to see one in full; kind: of the plant; own_code: flying it runs code of one's own."""
    wanted = ("trial", "status", by, "window_error", "peak_torque", "settling_time", "initial_angle")
    names = [name for name in dict.fromkeys(wanted) if name in frame.columns]
    rows = [
        tuple("-" if v is None else f"{v:.5g}" if isinstance(v, float) else str(v) for v in row)
        for row in frame.select(names).iter_rows()
    ]
    terminal.table(sentences.Table(tuple(sentences.with_unit(name, kind) for name in names), rows))
    one = f"ptsmc replay {folder} --trial {frame['trial'][0]}" + (" --trust" if own_code else "")
    terminal.say(f"whole rows in {folder / 'worst.csv'}; one in full: {one}")


def why(told: list[dict[str, Any]]) -> None:
    """The inputs that the metric goes with in each worst trial, as percentiles of all trials.

    Of one that failed, or where so few trials do not show what a metric goes with, those farthest from the middle.
    """
    for metric, trial in dict.fromkeys((one["metric"], one["trial"]) for one in told):
        mine = [one for one in told if (one["metric"], one["trial"]) == (metric, trial)]
        heading = f"{metric} {mine[0]['value']:.4g} in trial {trial}"
        shown = [one for one in mine if one["first_order"] is not None]
        if shown and math.isfinite(mine[0]["value"]):
            mine = sorted((one for one in shown if _explained(one) >= COUNTS), key=_explained, reverse=True)
        else:
            mine.sort(key=lambda one: -abs(one["percentile"] - 50.0))
        said = [
            f"{m['input']} {m['drawn']:.4g} at {m['percentile']:.1f} % (median {m['median']:.3g})" for m in mine[:4]
        ]
        nothing = f"{metric} goes with nothing that was drawn; what is left is the noise of the trial"
        terminal.say(f"{heading}: {', '.join(said) or nothing}")


def _explained(one: dict[str, Any]) -> float:
    """The share of its metric's variance that an input explains."""
    return max(one["first_order"], one["rank_correlation"] ** 2)


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
