"""What `ptsmc reproduce` leaves: Figs. 1 to 10 of the paper, and its claims and slips beside what was measured."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from ptsmc_jax.campaigns import store
from ptsmc_jax.campaigns.runs import Run
from ptsmc_jax.figures import run_plots, style
from ptsmc_jax.paper import claims, remark_2, slips
from ptsmc_jax.scenario import from_tables, parsing


@dataclass(frozen=True)
class Reproduction:
    """The paper's cases as flown, and what was measured."""

    cases: dict[str, Run]
    claims: list[claims.Claim]
    slips: list[slips.Slip]
    observers: list[remark_2.Measured]

    @property
    def ok(self) -> bool:
        """Every case was flown to its end."""
        return all(run.status == "ok" for run in self.cases.values())


def reproduce() -> Reproduction:
    """Fly every case of the paper and measure what it claims."""
    cases = claims.fly_cases()
    return Reproduction(cases, claims.claims(cases), slips.slips(cases), remark_2.measure())


def summary(reproduction: Reproduction) -> dict[str, Any]:
    """What `summary.json` says."""
    verdicts = [claim.verdict for claim in reproduction.claims]
    return {
        "status": "ok" if reproduction.ok else "failed",
        "verdicts": {word: verdicts.count(word) for word in claims.VERDICTS},
        "claims": [asdict(claim) for claim in reproduction.claims],
        "slips": [asdict(slip) for slip in reproduction.slips],
        "observers": [
            {key: value for key, value in asdict(one).items() if key not in ("t", "off")}
            for one in reproduction.observers
        ],
        "cases": {
            name: {"figures": claims.CASES[name][0], "status": run.status, **run.metrics}
            for name, run in reproduction.cases.items()
        },
    }


def write(folder: Path, reproduction: Reproduction, figures: bool) -> None:
    """Fill a result folder."""
    store.write_json(folder / "versions.json", store.versions("reproduce", 0))
    store.write_json(folder / store.SUMMARY, summary(reproduction))
    (folder / "claims.md").write_text(_markdown(reproduction), encoding="utf-8")
    (folder / "scenarios").mkdir()
    for name, (_, _, tables) in claims.CASES.items():
        store.write_toml(folder / "scenarios" / f"{name}.toml", parsing.dump(from_tables(tables)))
    if figures:
        style.save(_figures(reproduction), folder / "figures")


def _figures(reproduction: Reproduction) -> dict[str, Figure]:
    figures = {}
    for name, run in reproduction.cases.items():
        numbers, title, _ = claims.CASES[name]
        first, last = numbers.split(", ")[0], numbers.split(", ")[-1]
        if run.parts.plant.attitude:
            drawn = (first, "", "attitude", run_plots.attitude), (last, "", "torque", run_plots.torque)
        else:
            drawn = (first, "a", "states", run_plots.states), (last, "b", "control", run_plots.torque)
        for number, letter, label, draw in drawn:
            heading = f"Fig. {number}{f' ({letter})' if letter else ''}: {title}"
            figures[f"fig_{int(number):02}{letter}_{label}"] = draw(run.parts, run.log, title=heading)
        figures[f"convergence_{name}"] = run_plots.convergence(run.parts, run.log, f"Convergence: {title}")
    figures["remark_2_observers"] = run_plots.observers(reproduction.observers)
    return figures


def _markdown(reproduction: Reproduction) -> str:
    claims = [(c.where, c.claim, c.measured, f"**{c.verdict}**", c.why) for c in reproduction.claims]
    shown = [(s.where, s.paper, s.correct, s.shown) for s in reproduction.slips]
    return "\n".join(
        [
            "# The paper's claims beside what was measured",
            "",
            *_rows(("where", "the paper", "measured", "verdict", "why"), claims),
            "",
            "# Its slips, and what shows them",
            "",
            *_rows(("where", "the paper", "what it must be", "shown by"), shown),
            "",
            "# Remark 2: observers and signs, sampled at 20 Hz, t_f = 35 s, delta = 0.5 s, no noise",
            "",
            *_rows(*remark_2.rows(reproduction.observers)),
            "",
        ]
    )


def _rows(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    cells = [header, tuple("---" for _ in header), *rows]
    return ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in cells]
