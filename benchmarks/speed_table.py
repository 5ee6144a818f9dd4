"""Print the whole speed table: the library beside other simulators, and on a GPU if there is one.

    python3.11 benchmarks/speed_table.py [--keep]

The program makes an environment for each simulator under benchmarks/; `--keep` uses existing environments. It needs a C
compiler and a package index. Then it runs the scripts one after the other and prints a Markdown table. The table has
million trial-steps per second of both, measured in one run, and their ratio. Rows that cannot be measured here name the
reason. Run nothing else on the machine meanwhile.
"""

import datetime
import shutil
import subprocess
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
LIBRARY = ["--constraint", str(HERE.parent / "constraints.txt"), "--editable", str(HERE.parent)]
GPU = shutil.which("nvidia-smi") is not None
ENVIRONMENTS = {
    ".venv": [*LIBRARY, "--requirement", str(HERE / "requirements.txt"), *(["jax[cuda12]"] if GPU else [])],
    ".venv-basilisk": ["--editable", str(HERE.parent), "bsk==2.12.1"],  # its versions of others are not the tests'
    ".venv-jaxonomy": ["jaxonomy==3.4.1"],
}
RUNS = {
    "C": (".venv", ["against_c.py"]),
    "diffrax": (".venv", ["against_diffrax.py"]),
    "Basilisk": (".venv-basilisk", ["against_basilisk.py"]),
    "jaxonomy": (".venv", ["against_jaxonomy.py", str(HERE / ".venv-jaxonomy" / "bin" / "python")]),
    "GPU, own scan beside own kernel": (".venv", ["accelerator.py"]),
}
PUBLISHED = """\
| crazyflow, as published (RTX 4090, float32, a quadrotor) | up to 914 | | |
| DiffEqGPU.jl, as published (V100, Tsit5, 3 states) | 46 000 to 89 000 | | |"""


def python(name: str) -> Path:
    """Return the interpreter of an environment."""
    return HERE / name / "bin" / "python"


def make(name: str, needs: list[str]) -> str:
    """Make an environment; return the reason if that fails, or an empty text."""
    shutil.rmtree(HERE / name, ignore_errors=True)
    for call in (
        [sys.executable, "-m", "venv", str(HERE / name)],
        [str(python(name)), "-m", "pip", "install", "--quiet", *needs],
    ):
        done = subprocess.run(call, capture_output=True, text=True, check=False)
        if done.returncode:
            return last(done.stderr)
    return ""


def last(text: str) -> str:
    """Return the last line that a program printed."""
    return ([line.strip() for line in text.splitlines() if line.strip()] or ["no word"])[-1]


def rows(name: str, environment: str, call: list[str]) -> list[str]:
    """Return the rows that a script prints, or a row with the reason if there are none."""
    done = subprocess.run([str(python(environment)), *call], cwd=HERE, capture_output=True, text=True, check=False)
    print(done.stdout, flush=True)
    found = [line for line in done.stdout.splitlines() if line.startswith("| ")]
    return found if done.returncode == 0 else [*found, f"| {name} | not measured: {last(done.stderr)} | | |"]


def main(keep: bool) -> None:
    """Print the table."""
    failed = {}
    for name, needs in ENVIRONMENTS.items():
        if not (keep and python(name).exists()):
            failed[name] = make(name, needs)
    table = []
    for name, (environment, call) in RUNS.items():
        needed = [environment, *(other for other in ENVIRONMENTS if any(f"/{other}/" in word for word in call))]
        reason = next((failed[e] for e in needed if failed.get(e)), None)
        table += rows(name, environment, call) if reason is None else [f"| {name} | not measured: {reason} | | |"]
    print(f"{datetime.date.today()}, `python3.11 benchmarks/speed_table.py`; million trial-steps a second\n")
    print("| beside | theirs | ours | times |\n|---|---|---|---|", *table, PUBLISHED, sep="\n")


if __name__ == "__main__":
    if sys.argv[1:] not in ([], ["--keep"]):
        sys.exit(__doc__)
    main("--keep" in sys.argv)
