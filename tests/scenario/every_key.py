"""Every key of every table and kind of a scenario, as `ptsmc new` writes them, most of them in comments."""

import re
import tomllib

from ptsmc_jax.scenario.attitude_keys import ATTITUDE_KEYS
from tests.onboard.flights import PROFILE
from tuning.cli import new

KEY = re.compile(r"^#?([a-z]\w*) = ")
TABLE = re.compile(r"^#?\[(\w+|\[\w+\])\]")
ATTITUDE = {*ATTITUDE_KEYS, "sequence"}
COMMANDS = {"torque", "wheel_torque", "wheel_speed"}


def key_of(line):
    """Return the key that a line sets, also in a comment; None: it sets no key."""
    found = KEY.match(line)
    return found[1] if found else None


def blocks(text):
    """Return {table: lines with keys}, without the introduction of the file. [[sensors]] is "[sensors]"."""
    found, name = {}, None
    for line in text.splitlines():
        if match := TABLE.match(line):
            name = match[1]
            found.setdefault(name, [])
        elif name and key_of(line):
            found[name].append(line)
    return found


def kinds(lines):
    """Return a list with the lines of each kind of a table, the active kind first.

    A table without kinds has one list of lines.
    """
    found = [[]]
    for line in lines:
        if key_of(line) == "kind" and found[-1]:
            found.append([])
        found[-1].append(line)
    return found


def values(lines):
    """Return {key: value} of the keys of lines, also in comments. The last line of a key counts."""
    return {key: value for line in lines for key, value in tomllib.loads(line.removeprefix("#")).items()}


def attitudes(lines):
    """Return a list for each attitude key: the lines with the other keys and this attitude key."""
    others = [line for line in lines if key_of(line) not in ATTITUDE]
    return [
        [*others, *(line for line in lines if key_of(line) in (key, key == "euler_deg" and "sequence"))]
        for key in ATTITUDE_KEYS
    ]


def complete(plant):
    """Return pairs of a table's name and the tables of a valid scenario with all keys of one kind of this table.

    plant: its kind. The scenario around the table is sampled and has the noises and limits that dispersions need.
    """
    text = new.scenario_text(plant, {})
    found, written = blocks(text), tomllib.loads(text)
    hardware = values(found["hardware"])
    for key in ("rate_noise_density", "star_tracker_every", "star_tracker_period"):  # exclude rate_noise, need a filter
        hardware.pop(key, None)
    # keys with a row for each axis or wheel, which do not fit four wheels
    alike = {key: value for key, value in hardware.items() if not key.startswith("actuator_")}
    base = {**written, "loop": {**written["loop"], "mode": "sampled"}, "hardware": alike}
    drawn = base | ({"flexible": {}, "wheels": {}, "filter": {}} if plant == "spacecraft" else {})  # for dispersions
    every = []
    for name, lines in found.items():
        if name == "[sensors]":
            continue
        groups = kinds(lines)
        if name == "dispersion":
            groups = [[line] for line in lines]
        elif name == "initial":
            groups = attitudes(lines)
        elif name == "telemetry" and plant == "spacecraft":  # one of three kinds of commands
            groups = [[line for line in lines if key_of(line) not in COMMANDS - {key}] for key in sorted(COMMANDS)]
        around = {"tune": written, "dispersion": drawn}.get(
            name, base
        )  # default bounds of delta follow the loop's mode
        if name == "sensors":  # custom sensors exclude noise in [hardware]
            around = around | {"hardware": {}}
        if name == "reference":  # directions need an orbit and an epoch
            around = around | {"orbit": {}, "loop": {**around["loop"], "epoch": "2026-03-20T12:00:00"}}
        more = {"loop": {"mode": "sampled"}, "tune": {"statistic": "cvar"}}.get(name, {})  # key `level` needs cvar
        for table in map(values, groups):
            table |= {"file": PROFILE} if "file" in table else {}
            every.append((name, {**around, name: hardware if name == "hardware" else {**table, **more}}))
    return every
