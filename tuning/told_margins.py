"""Margins as a table and in words, from their `summary.json`."""

from collections.abc import Mapping
from typing import Any

from tuning.told import Summary, Table


def table(summary: Summary) -> Table:
    """Margins in hold: of each axis of the plant's input alone, of all at once, and of what each sensor sees."""

    def row(where: str, found: Mapping[str, Any]) -> tuple[str, ...]:
        return where, *(_limit(found.get(name, "-")) for name in ("gain_up", "gain_down", "phase", "delay", "modulus"))

    rows = [row(f"input {name}", found) for name, found in summary["hold"].items()]
    rows.append(row("all inputs at once", summary["together"]))
    rows += [row(f"sensor {name}", found) for name, found in summary["sensors"].items()]
    head = ("in hold, opened at", "gain up [dB]", "gain down [dB]", "phase [deg]", "delay [s]", "sensitivity [dB]")
    return Table(head, rows)


def _limit(value: Any) -> str:
    return value if isinstance(value, str) else "none" if value is None else f"{value:.3g}"


def lines(summary: Summary) -> list[str]:
    """Whether the loop is stable, and where before the hand-over its margins are least."""
    lines = ["the loop in hold is stable" if summary["stable"] else "the loop in hold is NOT stable"]
    lost = [one["time_to_go"] for one in summary["before"] if not one["stable"]]
    if lost:
        lines.append(
            f"frozen at {max(lost):.3g} s to go and less, before the hand-over, it is unstable: "
            "for so short a time that may do no harm, but gains there cost torque and accuracy"
        )
    least = min(
        (one for one in summary["before"] if one["stable"]), key=lambda one: one["phase"] or 180.0, default=None
    )
    if least is not None:
        lines.append(
            f"least before the hand-over: phase {_limit(least['phase'])} deg, gain up {_limit(least['gain_up'])} dB, "
            f"delay {_limit(least['delay'])} s, at {least['time_to_go']:.3g} s to go"
        )
    return [*lines, *([summary["said"]] if summary["said"] else [])]
