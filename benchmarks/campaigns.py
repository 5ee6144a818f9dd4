"""Campaigns of 1e4, 1e5 and 1e6 trials as whole processes: seconds, trials a second, largest resident memory."""

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from common import SCENARIO, machine, say

# a process of its own, so that its largest memory is its own
RUN = """
import resource, sys
from tuning.cli.main import main
try:
    main()
finally:
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, file=sys.stderr)
"""


def main() -> None:
    """Print a line a size; without figures and summary, and with them."""
    say(machine())
    with tempfile.TemporaryDirectory() as folder:
        for trials in (10_000, 10_000, 100_000, 1_000_000):  # the first fills the compile cache
            out = Path(folder) / f"{trials}-{time.monotonic_ns()}"
            options = ["montecarlo", str(SCENARIO), "--trials", str(trials), "--out", str(out), "--quiet"]
            started = time.monotonic()
            done = subprocess.run([sys.executable, "-c", RUN, *options], text=True, capture_output=True, check=False)
            seconds = time.monotonic() - started
            trials = json.loads((out / "summary.json").read_text())["simulated"]
            size = sum(path.stat().st_size for path in out.rglob("*.parquet")) / 2**20
            say(f"{trials:8d} trials: {seconds:5.1f} s with start, summary and figures, {trials / seconds:.0f} a s, "
                f"largest memory {float(done.stderr.split()[-1]):.2f} GiB, rows {size:.0f} MiB")  # fmt: skip


if __name__ == "__main__":
    main()
