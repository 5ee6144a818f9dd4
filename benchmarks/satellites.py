"""Does `ptsmc tune` find gains for any satellite? The data sheets in `satellites/`, each from several seeds.

    python benchmarks/satellites.py [NAME,NAME,...] [--seeds 5] [--trials N] [--global] [--out FILE.jsonl]

Every scenario is tuned from its defaults. A row reports whether the held-out trials meet every requirement, the
objective, its ratio to the lower bound, margins, simulations and seconds. With --global, differential evolution solves
the same problem, and the row adds how far its objective is from the tuned one. `--half METRIC` divides the limit of a
requirement by two, which makes the scenario infeasible: the row then reports the best compromise.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

from ptsmc_jax.configure import configure

HERE = Path(__file__).parent / "satellites"


def tuned(name: str, seed: int, trials: int | None, half: str | None, *, globally: bool) -> dict[str, Any]:
    """Return the row of one satellite and seed."""
    from ptsmc_jax.scenario import parsing, read, replace
    from ptsmc_jax.scenario.tables import Limit
    from tuning.studies import tuner

    scenario = replace(read(HERE / f"{name}.toml"), tune={} if trials is None else {"trials": trials})
    if half is not None:
        required = scenario.requirements[half]
        in_full = parsing.to_dict(required) if isinstance(required, Limit) else {"limit": required}
        limit = {**in_full, "limit": 0.5 * in_full["limit"]}
        scenario = replace(scenario, **{f"requirements__{half}": limit})
    begun = time.monotonic()
    found = tuner.tune(scenario, seed, with_global_check=globally)
    errors = found.held_out["tuned"].metrics.window_error[found.held_out["tuned"].finished]
    rms = float((errors**2).mean() ** 0.5) if errors.size else None
    bound = found.lower_bounds["tuned"]
    return {
        "name": name,
        "seed": seed,
        "half": half,
        "met": found.met,
        "searched": found.search.value,
        "over": dict(zip(found.search.problem.rows, found.search.worst.tolist(), strict=True)),
        "conflict": found.search.conflict,
        "rms": rms,
        "ratio": rms / bound if rms and bound else None,
        "verdicts": {one.metric: [one.worst, one.limit, one.met] for one in found.verdicts},
        "gains": found.gains,
        "at_bound": found.at_bound,
        "evolution": None if found.check is None else [found.check.value, found.check.distance, found.check.kept],
        "rollouts": found.rollouts,
        "gradients": found.gradients,
        "seconds": time.monotonic() - begun,
    }


def main() -> None:
    """Print a line for each satellite and seed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("names", nargs="?", default=",".join(sorted(path.stem for path in HERE.glob("*.toml"))))
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--trials", type=int)
    parser.add_argument("--half")
    parser.add_argument("--global", dest="globally", action="store_true")
    parser.add_argument("--out", type=Path)
    asked = parser.parse_args()
    configure(keep_programs=True)
    for name in asked.names.split(","):
        for seed in range(asked.seeds):
            row = tuned(name, seed, asked.trials, asked.half, globally=asked.globally)
            print(
                f"{name:14} seed {seed}  {'met' if row['met'] else 'NOT MET':8} objective {row['searched']:.4g}  "
                f"held-out RMS {row['rms'] or float('nan'):.4g}, {row['ratio'] or float('nan'):.3g} times the bound  "
                f"{row['rollouts']} + {row['gradients']} simulations, {row['seconds']:.0f} s",
                flush=True,
            )
            if asked.out is not None:
                with asked.out.open("a") as file:
                    file.write(json.dumps(row) + "\n")


if __name__ == "__main__":
    main()
