"""Campaigns and searches that are killed at random moments and resumed: are the results those of an undisturbed run?

    python -m benchmarks.kills --kills 1000

Each round starts a command, kills it (SIGKILL) at a random moment, and starts it again until it ends by itself. One
start in five starts two processes in the same folder. After each round, a campaign must have every trial once, with the
numbers of an undisturbed campaign. A search must have the same gains and the same results on held-out trials.
"""

import argparse
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import polars as pl

from ptsmc_jax.campaigns import store
from ptsmc_jax.scenario import parsing, read, replace

ROOT = Path(__file__).parents[1]
PTSMC = [sys.executable, "-c", "from tuning.cli import command; command()"]
COMMANDS = {
    "campaign": ["montecarlo", "s.toml", "--trials", "30000", "--no-figures", "--quiet", "--out", "out"],
    "search": ["tune", "s.toml", "--no-figures", "--quiet", "--out", "out"],
}
TWICE = 0.2  # fraction of starts with two processes
ENDED = (0, 1)  # exit statuses of complete results: requirements met or not
LATEST = 1.2  # latest time of a kill, as a multiple of the duration of an undisturbed run


def started(folder: Path, kind: str) -> subprocess.Popen:
    """Start a command in a folder."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen([*PTSMC, *COMMANDS[kind]], cwd=folder, env=environment, stdout=subprocess.DEVNULL,
                            stderr=subprocess.PIPE, text=True)  # fmt: skip


def campaign(folder: Path) -> pl.DataFrame:
    """Return the rows of a campaign in the order of its files."""
    return pl.concat([pl.read_parquet(path) for path in sorted((folder / "out" / "trials").glob("0*.parquet"))])


def search(folder: Path) -> Any:
    """Return the gains, and the results on training and held-out trials."""
    summary = json.loads((folder / "out" / "summary.json").read_text(encoding="utf-8"))
    return summary["gains"], summary["training"], summary["held_out"], (folder / "out" / "tuned.toml").read_text()


RESULTS: dict[str, Callable[[Path], Any]] = {"campaign": campaign, "search": search}


def same(one: Any, other: Any) -> bool:
    """Return whether two results are equal to the last bit."""
    return one.equals(other) if isinstance(one, pl.DataFrame) else json.dumps(one) == json.dumps(other)


def kills_until_the_end(folder: Path, kind: str, latest: float, draws: random.Random) -> int:
    """Start and kill a command until it ends by itself, and return the number of kills.

    Args:
        folder: the working directory of the command.
        kind: "campaign" or "search".
        latest: latest time of a kill after the start of a process [s].
        draws: random numbers.
    """
    kills = 0
    while True:
        runs = [started(folder, kind) for _ in range(2 if draws.random() < TWICE else 1)]
        until = [time.monotonic() + draws.uniform(0.0, latest) for _ in runs]
        ended = False
        for run, at in sorted(zip(runs, until, strict=True), key=lambda one: one[1]):
            try:
                _, error = run.communicate(timeout=max(0.0, at - time.monotonic()))
            except subprocess.TimeoutExpired:
                run.kill()
                run.communicate()
                kills += 1
                continue
            if run.returncode not in ENDED and "is in use" not in error:
                raise SystemExit(f"{kind}: exit status {run.returncode}: {error}")
            ended = ended or run.returncode in ENDED
        if ended:
            return kills


def main() -> None:
    """Kill commands until the number of kills is reached, and print the results of the rounds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    short = replace(read(ROOT / "scenarios" / "first_flight.toml"), tune={"trials": 16, "starts": 2, "steps": 10})
    draws, expected, seconds = random.Random(arguments.seed), dict[str, Any](), dict[str, float]()
    with tempfile.TemporaryDirectory() as there:
        for kind in COMMANDS:
            folder = Path(there) / kind
            folder.mkdir()
            store.write_toml(folder / "s.toml", parsing.dump(short))
            for _ in range(2):  # the second run finds compiled programs
                shutil.rmtree(folder / "out", ignore_errors=True)
                begun, run = time.monotonic(), started(folder, kind)
                _, error = run.communicate()
                if run.returncode not in ENDED:
                    raise SystemExit(error)
                seconds[kind] = time.monotonic() - begun
            expected[kind] = RESULTS[kind](folder)
            print(f"{kind}: {seconds[kind]:.1f} s undisturbed", flush=True)
        total, rounds, wrong = 0, 0, 0
        while total < arguments.kills:
            for kind in COMMANDS:
                folder = Path(there) / kind
                shutil.rmtree(folder / "out")
                kills = kills_until_the_end(folder, kind, LATEST * seconds[kind], draws)
                equal = same(RESULTS[kind](folder), expected[kind])
                total, rounds, wrong = total + kills, rounds + 1, wrong + (not equal)
                print(f"{kind}: {kills} kills, {'equal' if equal else 'WRONG'}; {total} kills in all", flush=True)
        print(f"{total} kills in {rounds} rounds, {wrong} wrong results")


if __name__ == "__main__":
    main()
