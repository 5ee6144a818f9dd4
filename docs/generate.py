"""Write the reference pages in docs/: scenario files and metrics from the code's types, commands from the program.

`python docs/generate.py` writes them. A test fails if they differ from the code.
"""

import inspect
import re
import sys
import typing
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from unittest import mock

from ptsmc_jax import units
from ptsmc_jax.scenario import errors, keys, layouts, sensor_tables
from ptsmc_jax.scenario.attitude_keys import Attitude
from ptsmc_jax.scenario.tables import Limit
from ptsmc_jax.scenario.values import Kinds, Table
from ptsmc_jax.simulation import catalogues, rollout
from tuning.cli.main import app

HERE = Path(__file__).parent
MADE = "<!-- Made by docs/generate.py from the code, where it is to be changed. -->"
LISTS = ("three numbers", "a list of numbers")  # allowed values of a key that has a number for each component
PLANTS = {"spacecraft": "A spacecraft", "chain": "An integrator chain", "system": "A custom system"}
SCENARIOS = """\
A scenario is a TOML file of tables. Every table and every key is optional, and has a default. Defaults with * apply
only with the inertia and t_f of the paper. For any other spacecraft or t_f they [follow from the
mission](theory/default_gains.md), and gains are designed for the sampled loop. `orbit`, `flexible`, `hardware`,
`sensors`, `wheels`, `filter`, `pointing`, `dispersion`, `requirements` and `tune` are off if they are absent. A key
that is unknown, has the wrong type, is out of range or is not finite is refused with its name. `ptsmc new` writes a
file with all of this.

Numbers are in the unit of their key. A text such as `"10 arcsec"` has a unit of its own. In a list each number may have
its own, such as `["350 kg cm^2", "300 kg cm^2", 0.03]`:

EXAMPLES

A unit consists of symbols with powers and square roots, separated by spaces or `/`, such as "kg m^2 s^-1":

- symbols that may have a prefix: WITH_PREFIX;
- other symbols: WITHOUT_PREFIX;
- prefixes: PREFIXES.

`Hz` is 2 pi rad/s, but `sqrt(Hz)` is `1/sqrt(s)`. The value of a key that ends in `period` may be a frequency, such as
`"2.5 Hz"`. The value of a `frequency` or an `orbit_rate` may be a period, such as `"95 min"`.

A table with a `kind` has the keys of that kind. Commands that simulate write the complete scenario as `scenario.toml`
beside their results. Conditions on several keys, such as `delta` of at least one control period, are reported if a
scenario violates them."""
METRICS = """\
Metrics are in `summary.json`, in the rows of a campaign and in `[requirements]`. For many trials the summary lists
mean, largest value and quantiles. For `window_error` it lists the RMS and `lower_bound`, the [lower
bound](theory/lower_bound.md).

The terminal and the figures show angles in arcsec or degrees. They show `terminal_error`, `window_error` and
`hold_error` of a spacecraft as the angle 2 asin |v| of the norm |v|. The files have each metric in the unit of the
tables below.

If a run never settles, `settling_time` is null, and a limit on `settling_time` is violated. If another metric is
infinite or has no value, the run counts as diverged at t_end.

## Status of a run

Files have the name of the status. If it is not `ok`, they also have a reason and a time, `bad_time`. In Python the
results of `simulate_parts`, `one` and `run` have the number. `ptsmc.STATUS[number]` is its name and reason, and
`ptsmc.has_finished(status)` is true if the metrics count. If they do not count, the run violates every requirement.

STATUS_TABLE

## Verdicts

`verdicts` in `summary.json` is a list with an entry for each requirement:

| key | unit | meaning |
| --- | --- | --- |
| `metric` | - | name of the metric or margin |
| `limit` | the metric's | largest allowed value; smallest allowed value if `at_least` is true |
| `worst` | the metric's | largest value of all trials; smallest value if `at_least` is true |
| `margin` | - | `worst` / `limit`, or 2 - `worst` / `limit` if `at_least` is true; never negative |
| `failures` | - | number of trials beyond the limit or without a value |
| `trials` | - | number of judged trials; for a margin, number of judged loops |
| `met` | - | whether the requirement is met |
| `reason` | - | why a margin has no value; else empty |

`margin` is a ratio and no stability margin. The requirement is met if it is at most 1. With 1.1 the worst value is 10 %
beyond the limit. With a quantile, `margin` uses the value at the quantile instead of `worst`. For a fraction of the
time, `margin` is the fraction beyond the limit, divided by the allowed fraction. It is null if a failed trial counts,
or if the trials are too few."""
ERRORS = """\
With `controller.error = "additive"` the attitude error vector is eps_1 = q_1 - q_1f, as in the paper. With
`"multiplicative"`, and for the comparison laws, it is the vector part of q_f* q. The units x1, x2 and u are those of
the states and the input.

| metrics | condition |
| --- | --- |
| `peak_wheel_momentum`, `peak_wheel_torque` | the scenario has `[wheels]` |
| `peak_modal`, `residual_modal` | the scenario has `[flexible]` |
| pointing error indices | the scenario has `[pointing]` |
| `within_ape_x` and similar | a requirement limits a fraction of the time |
| AKE, MKE, RKE | the attitude is measured with noise or filtered |

A run without the condition does not have the metric, and its status is `ok` all the same. In Python the attribute, such
as `run.metrics.ape_boresight`, is then NaN, and `"ape_boresight" in run.metrics` is false.

Custom metrics: `ptsmc montecarlo --metrics`.

The observation of pointing errors begins `after` t_f and ends at t_end. It consists of consecutive windows; an
incomplete last window counts for APE and AKE only. The error about an axis is a component of the rotation vector from
the reference to the body, in body axes. The half-cone error is the angle between the actual and the desired boresight
direction. For means and differences it is a two-dimensional vector across the boresight. The errors are evaluated at
the ends of control periods and at the start of the observation, RPE also at the ends of windows. Means are integrals
over time. Half-cones of RPE, PDE and RKE are up to 0.5 % too large. PDE is the largest difference between the means
of any two windows. The measured attitude is constant between samples."""
HISTORY = """\
## History of a run in Python

`run.log` of `ptsmc.simulate_parts(parts, record=True)` has a row for the start of each control period or integration
step, and a last row at t_end. Without `record=True` it is None. Its arrays have the shape (time, component). The units
are those of a spacecraft; a chain or a system has its own. Exclude rows without a length from sums and means:
`jnp.mean(x, where=run.log.has_length)`.

`u` is the delivered torque, and `commanded` is the commanded torque. They differ by limits, delay, lag and hardware
errors of the actuators. `peak_torque` is the largest component of `commanded`, and `peak_torque_delivered` is the
largest component of `u`. `readings` has the sensor readings, such as `attitude` and `rate`.

HISTORY_TABLE"""
REQUIREMENTS = """\
The name of any [metric](metrics.md), with the largest value that is allowed in every trial, or with a table. An example
is `window_error = { limit = 1e-4, quantile = 0.9973, confidence = 0.9 }`. For a [pointing error](pointing.md), the
table may be `ape_boresight = { limit = 1e-3, probability = 0.9973, confidence = 0.9, interpretation = "mixed" }`.

The sampled loop may also have required margins, as numbers or with a unit, such as `"6 dB"`. `gain_margin` [dB],
`phase_margin` [deg] and `delay_margin` [s] are lower limits. `peak_sensitivity` [dB] is the largest allowed peak
sensitivity M_s. A table has these keys:"""

SUITE = sensor_tables.SUITE_MEANING.replace("Kalman filter", "[Kalman filter](theory/sensor_suites.md)")


def scenarios() -> str:
    """Return the reference of scenario files. A kind of plant lists only the tables that earlier kinds do not have."""
    rows = [f"| {unit} | {examples} |" for unit, examples in units.EXAMPLES.items()]
    table = "\n".join(["| unit of the key | examples |", "| --- | --- |", *rows])
    text = SCENARIOS.replace("EXAMPLES", table)
    for name in ("WITH_PREFIX", "WITHOUT_PREFIX", "PREFIXES"):
        text = text.replace(name, ", ".join(getattr(units, name)))
    parts = ["# Scenario files", MADE, text]
    seen: dict[type[Table], str] = {}
    whole: dict[tuple, str] = {}  # a table with all its kinds, the default first
    for plant, title in PLANTS.items():
        parts += [f"## {title}"]
        for name, table in layouts.TABLES[plant].items():
            kinds = table if isinstance(table, Mapping) else {"": table}
            parts += [f"### [{name}]"]
            if tuple(kinds.items()) in whole:
                parts += [f"As for {whole[tuple(kinds.items())]}."]
                continue
            whole[tuple(kinds.items())] = lower = title[0].lower() + title[1:]
            first = next(iter(kinds))
            for kind, struct in kinds.items():
                if struct in seen:
                    continue
                default = " (default)" if kind == first else ""
                said = f'`kind = "{kind}"`{default}: ' if kind else ""
                said = f'`kind = "{plant}"`: ' if name == "plant" else said
                parts += [said + keys.description(struct), *_keys(name, struct, plant)]
            known: dict[str, list[str]] = {}
            for kind, struct in kinds.items():
                if struct in seen:
                    known.setdefault(seen[struct], []).append(f'`"{kind}"`' + " (default)" * (kind == first))
            parts += [
                f"As for {other}, in the plant's own units: `kind =` {', '.join(named)}."
                for other, named in known.items()
            ]
            seen = dict.fromkeys(kinds.values(), lower) | seen
            if name == "sensors" and plant == "spacecraft":
                parts += ["### [[sensors]]", SUITE]
                for kind, struct in sensor_tables.SENSORS.items():
                    parts += [f'`kind = "{kind}"`: {keys.description(struct)}', *_keys(name, struct, plant)]
        if plant == "spacecraft":
            parts += ["### [requirements]", REQUIREMENTS, *_keys("requirements", Limit, plant)]
        else:
            parts += ["### [requirements]", "As for a spacecraft, on the metrics that the plant has."]
    return _page(parts)


def metric_list() -> str:
    """Return the reference of the metrics."""
    statuses = [
        [str(code), f"`{name}`", reason or "reached t_end", "count" if code in rollout.FINISHED else "do not count"]
        for code, (name, reason) in rollout.STATUS.items()
    ]
    text = METRICS.replace("STATUS_TABLE", _grid("number status meaning metrics", statuses))
    parts = ["# Metrics", MADE, text]
    for title, known in (
        ("A spacecraft's", catalogues.CATALOGUE),
        ("Those of chains and systems", catalogues.STATE_CATALOGUE),
    ):
        parts += [
            f"## {title}",
            _grid("metric unit meaning", [[f"`{key}`", one.unit, one.meaning] for key, one in known.items()]),
        ]
    history = re.findall(r"^    (\w+): .*?  # (.*)$", inspect.getsource(rollout.Log), re.MULTILINE)
    rows = [[f"`{name}`", content] for name, content in history]
    return _page([*parts, ERRORS, HISTORY.replace("HISTORY_TABLE", _grid("field content", rows))])


def commands() -> str:
    """Return the reference of the commands."""
    with mock.patch.object(sys, "argv", ["ptsmc"]):  # which the usage lines are made from
        text = app.generate_docs(output_format="markdown")
    text = text[text.index("## ptsmc simulate") :]
    for made, better in {
        " *[default: False]*": "",
        " STR`": "`",
        "--figures, --no-figures`: Draw figures. *[default: True]*": "--no-figures`: Draw no figures.",
    }.items():
        text = text.replace(made, better)
    return _page(["# Commands", MADE, "\n".join(line.rstrip() for line in text.strip().splitlines())])


def _keys(table: str, struct: type[Table], plant: str) -> Iterator[str]:
    """Yield the keys of a table of the scenario, as a table of the page."""
    if table == "dispersion":
        yield from _dispersion(struct, layouts.SCENARIOS[plant].unit_of_d)
        return
    borrowed = issubclass(struct, Attitude) and table != "initial"
    fallback = _case_i(plant).get(table, {}) if table in ("initial", "controller") else {}
    rows = [
        [f"`{key.name}`", key.allowed, _shown(key, struct, fallback), key.unit, key.meaning]
        for key in keys.list_keys(struct, layouts.SCENARIOS[plant].unit_of_d)
        if not (borrowed and key.name in Attitude.__struct_fields__)
    ]
    if rows:
        yield _grid("key allowed default unit meaning", rows)
    for key in keys.list_keys(struct):
        if f"{table}.{key.name}" in layouts.KINDS and plant == "spacecraft":
            yield f"The kinds of `{key.name}`:"
            yield _grid("key meaning entries effect", list(_kinds(key, layouts.KINDS[f"{table}.{key.name}"])))
    if borrowed:
        yield "And one of the attitude keys of `[initial]`."


def _case_i(plant: str) -> Mapping[str, Mapping[str, Any]]:
    """Return the defaults of a plant with the paper's law that are not defaults of single keys."""
    made = layouts.SCENARIOS[plant]
    return made.plant_defaults(typing.cast(type[Table], made.TABLES["plant"])(), (), "prescribed_time")


def _dispersion(struct: type[Table], unit_of_d: str) -> Iterator[str]:
    """Yield a table of the keys, and a table of their kinds. Several keys may have the same kind."""
    rows, users = [], dict[tuple[str, type[Table]], list[str]]()
    for key in keys.list_keys(struct):
        names = [f'`"{kind}"`' for kind in layouts.DISPERSIONS[key.name]]
        names[0] += " (default)" * (len(names) > 1)
        rows.append([f"`{key.name}`", key.meaning, ", ".join(names)])
        for one in layouts.DISPERSIONS[key.name].items():
            users.setdefault(one, []).append(f"`{key.name}`")
    yield _grid("key meaning kinds", rows)
    yield "The kinds, their entries and the allowed values:"
    kinds = [
        [f'`kind = "{kind}"`', ", ".join(named), _entries(table, unit_of_d), keys.description(table)]
        for (kind, table), named in users.items()
    ]
    yield _grid("kind keys entries effect", kinds)


def _kinds(key: keys.Key, kinds: Kinds) -> Iterator[list[str]]:
    """Yield a row for each kind of an inline table."""
    for kind, struct in kinds.items():
        yield [f"`{key.name}`", key.meaning, f'`kind = "{kind}"`; {_entries(struct)}', keys.description(struct)]


def _entries(struct: type[Table], unit_of_d: str = keys.UNIT_OF_D) -> str:
    """Return the entries of an inline table: name, allowed values, default and meaning of each."""
    entries = []
    for key in keys.list_keys(struct, unit_of_d):
        default = f", default {shown}" if (shown := _default(key.default)) else ""
        entries.append(f"`{key.name}` ({key.allowed}{default}): {key.text}")
    return "; ".join(entries)


def _shown(key: keys.Key, struct: type[Table], fallback: Mapping[str, Any]) -> str:
    """Return the default of a key. A default that follows the mission has its value in the paper's case and a mark."""
    if key.name in struct.scaled and key.default is None:
        value = struct.scaled[key.name].value
        each = " each" if isinstance(value, float) and key.allowed.startswith(LISTS) else ""
        return f"{_default(value)}{each} *"
    return _default(fallback.get(key.name, key.default))


def _default(value: object) -> str:
    shown = isinstance(value, bool | int | float | str | tuple | list) and value != ()
    return f"`{errors.show(value)}`" if shown else ""


def _grid(header: str, rows: list[list[str]]) -> str:
    """Return a table without its empty columns."""
    titles = header.split()
    used = [k for k in range(len(titles)) if any(row[k] for row in rows)]
    lines = [titles, ["---"] * len(titles), *rows]
    return "\n".join("| " + " | ".join(line[k].replace("|", "\\|") for k in used) + " |" for line in lines)


def _page(parts: list[str]) -> str:
    return "\n\n".join(parts) + "\n"


PAGES = {"scenarios.md": scenarios, "metrics.md": metric_list, "commands.md": commands}

if __name__ == "__main__":
    for name, page in PAGES.items():
        (HERE / name).write_text(page(), encoding="utf-8")
