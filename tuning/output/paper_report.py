"""The report of the paper's claims."""

from tuning.output.report import Report, Section, Table
from tuning.output.summaries import Paper


def build(summary: Paper) -> Report:
    """Return the report of `ptsmc reproduce`."""
    claims = [(one.verdict, f"{one.where}: {one.claim}", one.measured) for one in summary.claims]
    slips = [(one.where, one.correct, one.shown) for one in summary.slips]
    counts = ", ".join(f"{count}: {word}" for word, count in summary.verdicts.items())
    return Report(
        f"{summary.verdicts.get('holds', 0)} of {len(claims)} claims of the paper hold literally",
        "calm",
        [counts, "claims.md states the reasons, and quotes the errors"],
        [
            Section("Claims of the paper", [Table(("verdict", "the paper", "measured"), claims)]),
            Section("Errors of the paper", [Table(("where", "correct", "evidence"), slips)]),
        ],
    )
