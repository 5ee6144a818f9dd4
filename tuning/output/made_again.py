"""The call that makes a result again, from what `versions.json` and the scenario say."""

import shlex
from collections.abc import Mapping
from typing import Any

from ptsmc_jax.scenario import own

# kept in `versions.json`
OPTIONS = (
    "x", "y", "trials", "trial", "plan", "points", "against", "limits", "times", "metrics", "controller", "seed",
    "global_check",
)  # fmt: skip


def call(versions: Mapping[str, Any], scenario: Mapping[str, Any]) -> str:
    """The call as it is typed; scenario: its tables, none where there was no file."""
    trusted = any(own.named(scenario)) or versions.get("metrics") is not None
    if versions.get("campaign") is not None:  # of a trial that `simulate` does not fly
        trusted = trusted or versions.get("controller") is not None
        command = ["ptsmc", "replay", versions["campaign"], "--trial", str(versions["trial"])]
        return shlex.join([*command, *(["--trust"] if trusted else [])])
    command = ["ptsmc", versions["command"], *(["scenario.toml"] if scenario else [])]
    for key in OPTIONS:
        if key == "trials" and versions.get("plan") is not None:
            continue  # the plan says how many
        if versions["command"] != "reproduce" and versions.get(key) is not None:
            option = f"--{key.replace('_', '-')}"
            command += [option] if versions[key] is True else [option, str(versions[key])]
    if versions.get("precision") == 32:
        command += ["--precision", "32"]
    laws, files = versions.get("laws", ()), list(versions.get("own_laws", ()))
    for kind in laws[1 : len(laws) - len(files)]:  # the paper's is the first, those of one's own are the last
        command += ["--against", kind]
    for file in files:
        command += ["--law", file]
    if trusted:
        command.append("--trust")
    return shlex.join(command)
