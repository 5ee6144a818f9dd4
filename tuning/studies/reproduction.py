"""`ptsmc reproduce`: Figs. 1 to 10 of the paper, and its claims and errors compared with simulations.

Read `reproduce` first, then `write`.
"""

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ptsmc_jax.campaigns import store
from ptsmc_jax.campaigns.runs import Run
from ptsmc_jax.figures import run_plots, style
from ptsmc_jax.paper import claims, slips
from ptsmc_jax.paper.claims import Measured
from ptsmc_jax.scenario import from_tables, parsing


@dataclass(frozen=True)
class Reproduction:
    """Simulations of the paper's cases, and the results for its claims and its errors ("slips")."""

    cases: dict[str, Run]
    claims: list[claims.Claim]
    slips: list[slips.Slip]
    observers: list[Measured]

    @property
    def ok(self) -> bool:
        """Whether every case reached its end."""
        return all(run.status == "ok" for run in self.cases.values())


def reproduce() -> Reproduction:
    """Simulate every case of the paper and check its claims."""
    cases = claims.simulate_cases()
    return Reproduction(cases, claims.claims(cases), slips.slips(cases), claims.measure_observers())


def summary(reproduction: Reproduction) -> dict[str, object]:
    """Return the content of `summary.json`."""
    verdicts = [claim.verdict for claim in reproduction.claims]
    return {
        "status": "ok" if reproduction.ok else "failed",
        "verdicts": {word: verdicts.count(word) for word in claims.VERDICTS},
        "claims": [asdict(claim) for claim in reproduction.claims],
        "slips": [asdict(slip) for slip in reproduction.slips],
        "observers": [
            {key: value for key, value in asdict(measured).items() if key not in ("t", "error_history")}
            for measured in reproduction.observers
        ],
        "cases": {
            name: {"figures": claims.CASES[name][0], "status": run.status, **run.metrics}
            for name, run in reproduction.cases.items()
        },
    }


def write(folder: Path, reproduction: Reproduction, figures: bool) -> None:
    """Write a result folder: `summary.json`, `claims.md`, the scenarios, and figures.

    Args:
        folder: an empty folder.
        reproduction: the results.
        figures: write figures too.
    """
    store.write_json(folder / "versions.json", store.versions("reproduce", 0))
    store.write_json(folder / store.SUMMARY, summary(reproduction))
    (folder / "claims.md").write_text(_markdown(reproduction), encoding="utf-8")
    (folder / "scenarios").mkdir()
    for name, (_, _, tables) in claims.CASES.items():
        store.write_toml(folder / "scenarios" / f"{name}.toml", parsing.dump(from_tables(tables)))
    if figures:
        style.save(figures_of(reproduction), folder / "figures")


def figures_of(reproduction: Reproduction) -> dict[str, Figure]:
    """Return the figures of the paper's cases and observers by name."""
    figures = {}
    for name, run in reproduction.cases.items():
        numbers, title, _ = claims.CASES[name]
        first, last = numbers.split(", ")[0], numbers.split(", ")[-1]
        plant, letters = run.parts.plant, ("a", "b") if first == last else ("", "")
        headings = [f"Fig. {number}{f' ({letter})' if letter else ''}: {title}"
                    for number, letter in zip((first, last), letters, strict=True)]  # fmt: skip
        state, torque = plant.charts[0].name, plant.input_name
        figures[f"fig_{int(first):02}{letters[0]}_{state}"] = run_plots.state(
            run.parts, run.log, plant.charts[0], headings[0]
        )
        figures[f"fig_{int(last):02}{letters[1]}_{torque}"] = run_plots.torque(run.parts, run.log, title=headings[1])
        figures[f"convergence_{name}"] = run_plots.convergence(run.parts, run.log, f"Convergence: {title}")
    figures["remark_2_observers"] = _plot_observers(reproduction.observers)
    return figures


@style.styled
def _plot_observers(measured: list[Measured]) -> Figure:
    """Plot each observer's estimation error, and the chattering under both signs (Remark 2)."""
    runs = {(run.observer, run.sign): run for run in measured}
    kinds = list(dict.fromkeys(run.observer for run in measured))
    figure = Figure(figsize=(10.0, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2)
    for kind, (colour, line) in zip(kinds, style.STYLES, strict=False):
        run = runs[kind, "smooth"]
        left.semilogy(run.t, np.maximum(run.error_history, 1e-6), color=colour, ls=line, label=kind)
    left.set(xlabel=style.TIME, ylabel="estimation error $|\\hat d - d|$ [N m]", xlim=(0.0, 10.0), ylim=(1e-5, 1.0))
    left.legend(ncols=2)
    for k, sign in enumerate(dict.fromkeys(run.sign for run in measured)):
        heights = [runs[kind, sign].chattering for kind in kinds]
        colour, hatch = style.STYLES[k][0], ("", "//")[k % 2]
        positions = np.arange(len(kinds)) + 0.38 * (k - 0.5)
        bars = right.bar(positions, heights, 0.36, color=colour, hatch=hatch, ec="white", label=f"{sign} sign")
        right.bar_label(bars, fmt="%.0e", fontsize=8)
    right.set_yscale("log")
    right.set_axisbelow(True)
    right.set_xticks(range(len(kinds)), [kind.replace("_", "\n") for kind in kinds])
    right.set(ylabel="chattering after $t_f$ [N m/s]")
    right.set_ylim(top=8.0 * right.get_ylim()[1])
    right.legend(ncols=2)
    return figure


def _markdown(reproduction: Reproduction) -> str:
    """Return the text of `claims.md`: claims, errors in equations, observers."""
    claim_rows = [(c.where, c.claim, c.measured, f"**{c.verdict}**", c.why) for c in reproduction.claims]
    shown = [(s.where, s.paper, s.correct, s.shown) for s in reproduction.slips]
    return "\n".join(
        [
            "# Claims of the paper and measurements",
            "",
            *_markdown_table(("where", "the paper", "measured", "verdict", "why"), claim_rows),
            "",
            "# Errors in the equations of the paper, and their evidence",
            "",
            *_markdown_table(("where", "printed in the paper", "correct", "evidence"), shown),
            "",
            "# Remark 2: observers and signs, sampled at 20 Hz, t_f = 35 s, delta = 0.5 s, no noise",
            "",
            *_markdown_table(*claims.format_observers(reproduction.observers)),
            "",
        ]
    )


def _markdown_table(header: tuple[str, ...], rows: list[tuple[str, ...]]) -> list[str]:
    """Return the lines of a Markdown table with this header and these rows of cells."""
    cells = [header, tuple("---" for _ in header), *rows]
    return ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in cells]
