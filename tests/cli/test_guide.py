"""The commands in `docs/guide.md`, in their order, with fewer trials and smaller searches."""

import re
import shlex
import shutil
import subprocess

import pytest

from tests.helpers import ROOT, small_search

GUIDE = (ROOT / "docs" / "guide.md").read_text()
TUNE = "\n[tune]\ntrials = 16\nstarts = 2\nsteps = 4\n"
SMALLER = {"--trials 2000": "--trials 64", "--law mine.py:Growing": "--law mine.py:Growing --against pd"}


def calls():
    """Return a list of all commands in the shell blocks of the guide, without the installation."""
    blocks = re.findall(r"^```(\S*)[^\n]*\n(.*?)^```", GUIDE, re.M | re.S)
    return [line.split("#")[0].strip() for language, block in blocks if not language for line in block.splitlines()]


@pytest.mark.long
@pytest.mark.skipif(shutil.which("make") is None or shutil.which("cc") is None, reason="no compiler for the C")
def test_commands_of_the_guide_run(command, tmp_path, monkeypatch):
    small_search(monkeypatch)
    here = tmp_path / "scenarios"
    here.mkdir()
    for name in ("cubesat", "first_flight"):  # without margins and probabilities, which need thousands of trials
        text = (ROOT / "scenarios" / f"{name}.toml").read_text().split("\n[tune]")[0]
        text = re.sub(r"\n(?:\w+_margin|peak_sensitivity) = .*", "", text).replace(
            ", probability = 0.9973, confidence = 0.9", ""
        )
        (here / f"{name}.toml").write_text(text + TUNE)
    (tmp_path / "mine.py").write_text(re.findall(r"```python\n(.*?)```", GUIDE, re.S)[0])
    law = '[controller]\nkind = "custom"\ncode = "mine.py:Growing"'
    (tmp_path / "mine.toml").write_text((here / "first_flight.toml").read_text().replace("[controller]", law))
    shutil.copy(tmp_path / "mine.py", here)
    simulated = 0
    for call in calls():
        for whole, small in SMALLER.items():
            call = call.replace(whole, small)
        if "corners.csv" in call:
            shutil.copy(tmp_path / "out" / "montecarlo-tuned" / "worst.csv", tmp_path / "corners.csv")
        name, *rest = shlex.split(call)
        if name == "make":
            done = subprocess.run([name, *rest], cwd=tmp_path, capture_output=True, text=True, check=False)
            assert done.returncode == 0, done.stdout + done.stderr
            continue
        status, out, err = command(*rest)
        assert status in (0, 1), f"{call}: {err}"  # 1: gains of a small search may violate a requirement
        assert out
        simulated += 1
    assert simulated >= 14
