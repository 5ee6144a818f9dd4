"""Measure the effect of each stage of the search: searches without it or with a change, on five problems.

    python benchmarks/tuning_ablation.py [SEEDS [PROBLEM ...]]

Each search adds a line to out/tuning_ablation.jsonl and is not repeated. The table has a row for each problem and
variant. Its columns are the median and largest distance from the best objective of all variants, the seeds within 1 %
of it, and the number of simulations. Differential evolution of `tuning.search.global_check` is a variant, on the first
seed.
"""

import json
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from ptsmc_jax.configure import configure

KEPT = Path("out/tuning_ablation.jsonl")
SCENARIOS = Path(__file__).parent.parent / "scenarios"
FILES = {"first": "first_flight", "filtered": "filtered_flight", "hard": "hard_flight", "arm": "two_link_arm"}
CHAIN = {
    "plant": {"kind": "chain", "order": 4, "x0": [1.0, -0.5, 0.3, 0.0]},
    "controller": {"t_f": 10.0, "eta": 5.0, "delta": 0.5},
    "loop": {"mode": "sampled", "period": 0.02, "t_end": 12.0},
    "hardware": {"state_noise": [1e-5, 1e-5, 1e-5, 1e-5]},
    "dispersion": {"x0": {"kind": "uniform", "half_width": [0.5, 0.5, 0.3, 0.2]}},
    "tune": {"trials": 64},
}


@contextmanager
def changed(module: object, **values: object) -> Iterator[None]:
    """Change values of a module within the context."""
    before = {name: getattr(module, name) for name in values}
    for name, value in values.items():
        setattr(module, name, value)
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(module, name, value)


def variants() -> dict[str, Callable]:
    """Return a context for each variant of the search, by name."""
    from tuning.search import evolution, hand_overs, local_searches, optimise, starts

    everything = local_searches.LocalSearches

    class AllTheWay(everything):
        """A search without successive halving: every local search has half of the steps."""

        def _successive_halving(self, problem, starts, stages, step_name, **others):
            stages = ((len(starts), max(2, self._steps // 2)),) if step_name == "searching" else stages
            return super()._successive_halving(problem, starts, stages, step_name, **others)

    class Evolved(everything):
        """Differential evolution after the local searches."""

        def search_locally(self, problem, starts):
            super().search_locally(problem, starts)
            self.evolve(problem, self.normalised, evolution.NEAR_BEST)

    def searching(kind: type) -> Callable:
        return lambda: changed(optimise, LocalSearches=kind)

    return {
        "as it is": lambda: changed(local_searches),
        "all trials from the start": lambda: changed(local_searches, FEWEST_AVERAGED=10**6),
        "without a race": searching(AllTheWay),
        "starts drawn, not chosen": lambda: changed(
            starts, choose_promising=lambda _, __, share, count, ___: share[:count]
        ),
        "chosen by merit alone": lambda: changed(starts, DISTANCES=(0.0,)),
        "nothing held in the sweep": lambda: changed(starts, find_decisive_gains=lambda _: []),
        "careful steps only": lambda: changed(local_searches, BOLD=local_searches.CAREFUL),
        "bold steps only": lambda: changed(local_searches, CAREFUL=local_searches.BOLD),
        "off samples": lambda: changed(hand_overs, points_on_samples=lambda *_: []),
        "evolution added": searching(Evolved),
    }


def main() -> None:
    """Print a line for each search, and the table."""
    configure()
    from ptsmc_jax import scenario
    from tuning.search import global_check, optimise
    from tuning.studies import posing

    seeds, wanted = int(sys.argv[1]) if len(sys.argv) > 1 else 20, sys.argv[2:] or [*FILES, "chain"]
    KEPT.parent.mkdir(exist_ok=True)
    rows = [json.loads(line) for line in KEPT.read_text().splitlines()] if KEPT.exists() else []
    done = {(row["problem"], row["variant"], row["seed"]) for row in rows}

    def keep(problem: str, variant: str, seed: int, **found: object) -> None:
        rows.append({"problem": problem, "variant": variant, "seed": seed, **found})
        with KEPT.open("a") as file:
            file.write(json.dumps(rows[-1]) + "\n")
        print(rows[-1], flush=True)

    for name in wanted:
        loaded = scenario.from_tables(CHAIN) if name == "chain" else scenario.read(SCENARIOS / f"{FILES[name]}.toml")
        table = loaded.tune
        assert table is not None
        posed = posing.set_up_tuning(loaded, 0)
        evaluate, with_gradients = posed.evaluate, posed.settings.with_gradients
        for seed in range(seeds):
            for variant, inside in variants().items():
                if (name, variant, seed) in done:
                    continue
                started, before = time.monotonic(), (evaluate.rollouts, evaluate.gradients)
                with inside():
                    settings = optimise.Settings(table.starts, table.steps, seed, with_gradients, judged=False)
                    found = optimise.search(
                        evaluate, posed.problem, posed.ready.requirements, posed.scenario_gains, settings
                    )
                keep(name, variant, seed, goal=found.value, kept=bool(found.worst.max(initial=0.0) <= 1.0),
                     rollouts=evaluate.rollouts - before[0], gradients=evaluate.gradients - before[1],
                     seconds=round(time.monotonic() - started, 1), gains=found.gains.tolist())  # fmt: skip
                if seed == 0 and variant == "as it is" and (name, "differential evolution", 0) not in done:
                    started = time.monotonic()
                    check = global_check.check(evaluate, found, 1)
                    keep(name, "differential evolution", 0, goal=check.value, kept=check.kept,
                         rollouts=check.rollouts, gradients=0, seconds=round(time.monotonic() - started, 1),
                         gains=list(check.gains.values()))  # fmt: skip
    _table([row for row in rows if row["problem"] in wanted])


def _table(rows: list[dict]) -> None:
    print("\n| problem | variant | seeds | within 1 % | median, largest distance | simulations | with gradients |")
    print("|---|---|---|---|---|---|---|")
    for problem in dict.fromkeys(row["problem"] for row in rows):
        of_it = [row for row in rows if row["problem"] == problem]
        best = min(row["goal"] for row in of_it if row["kept"] and row["variant"] != "off samples")
        for variant in dict.fromkeys(row["variant"] for row in of_it):
            some = [row for row in of_it if row["variant"] == variant]
            far = np.asarray([row["goal"] / best - 1.0 if row["kept"] else np.inf for row in some])
            simulated = [np.median([row[kind] for row in some]) for kind in ("rollouts", "gradients")]
            print(f"| {problem} | {variant} | {len(some)} | {np.sum(far <= 0.01)} | {100 * np.median(far):.2f} %, "
                  f"{100 * far.max():.2f} % | {simulated[0]:.0f} | {simulated[1]:.0f} |")  # fmt: skip


if __name__ == "__main__":
    main()
