"""Print what each feature of a scenario costs: CPU time per control period and trial, beside the plain scenario.

    python benchmarks/features.py [WORD ...] [--trials 2048] [--pairs 5]

The plain scenario is `scenarios/filtered_flight.toml`. Each row changes one thing in it. The rows come from the tables
and kinds that scenario files have, so a new kind or key adds its row. The last rows are the packaged scenarios, beside
the first flight. Given words select the rows that contain one of them. A row runs by turns with the scenario that it is
compared with, and the ratio is the median over these pairs.
"""

import argparse
import time
import typing
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from ptsmc_jax.configure import configure

configure()

import jax  # noqa: E402
from common import HERE, SCENARIO, machine, say  # noqa: E402

from ptsmc_jax import scenario  # noqa: E402
from ptsmc_jax.campaigns import montecarlo  # noqa: E402
from ptsmc_jax.scenario import layouts  # noqa: E402
from ptsmc_jax.scenario.errors import ScenarioError  # noqa: E402
from ptsmc_jax.scenario.tables import Scenario  # noqa: E402

SCENARIOS = HERE.parent / "scenarios"
PLAIN = scenario.read(SCENARIOS / "filtered_flight.toml")
FULL_INERTIA = [[11.0, 0.8, -0.5], [0.8, 12.0, 0.6], [-0.5, 0.6, 14.0]]
CUSTOM = {"kind": "custom", "code": str(SCENARIOS / "own_parts.py")}
EXCLUDED = ("loop.mode continuous",)  # it has no control periods


def custom(name: str, **keys: Any) -> dict[str, Any]:
    """Return the table of a class in `scenarios/own_parts.py`."""
    return {**CUSTOM, "code": f"{CUSTOM['code']}:{name}", **keys}


# Values of rows whose defaults are not enough, as changes of the plain scenario (see `scenario.replace`). A kind
# without an entry gets its defaults.
VALUES: dict[str, dict[str, Any]] = {
    "spacecraft.inertia": {"spacecraft__inertia": FULL_INERTIA},
    "spacecraft.true_inertia": {"spacecraft__true_inertia": FULL_INERTIA},
    "reference spin": {"reference": {"kind": "spin", "rate": [0.01, -0.02, 0.03]}},
    "reference slew": {"reference": {"kind": "slew", "to_quat_xyzw": [0.28, 0.0, 0.0, 0.96]}},
    "reference custom": {"reference": custom("Nodding")},
    "disturbance gravity_gradient": {"disturbance": {"kind": "gravity_gradient", "orbit_rate": 1e-3}},
    "disturbance custom": {"disturbance": custom("SolarPressure")},
    "disturbance sum": {"disturbance": {"kind": "sum", "terms": [{"kind": "sinusoid"}, {"kind": "constant"}]}},
    "observer custom": {"observer": custom("LowPass")},
    "controller custom": {"controller": custom("Scaling", t_f=35.0, delta=3.0), "tune": None},
    "sensors custom": {"sensors": custom("StarTracker"), "filter": None, "hardware": None},
    "hardware.torque_limit": {"hardware__torque_limit": 0.5},
    "hardware.torque_rate_limit": {"hardware__torque_rate_limit": 5.0},
    "hardware.torque_lag": {"hardware__torque_lag": 0.1},
    "hardware.torque_step": {"hardware__torque_step": 1e-4},
    "hardware.delay": {"hardware__delay": 1},
    "hardware.rate_noise_density": {"hardware__rate_noise": None, "hardware__rate_noise_density": 2e-7},
    "hardware.rate_bias": {"hardware__rate_bias": 1e-6},
    "hardware.rate_bias_walk": {"hardware__rate_bias_walk": 1e-8},
    "hardware.star_tracker_every": {"hardware__star_tracker_every": 4},
    "hardware.star_tracker_period": {"hardware__star_tracker_period": 0.12},
    "dispersion.custom custom": {"dispersion__custom": custom("SunDirection"), "disturbance": custom("SolarPressure")},
}
KEYS: dict[str, dict[str, Any]] = {  # that a kind needs besides `kind`, by table
    "controller": {"t_f": 35.0},
    "hardware.command_filter": {"corner": 6.0},
}
# Rows that need another one: they change its scenario, and are compared with it.
BASES = {
    "dispersion.torque_limit": "hardware.torque_limit",
    "dispersion.wheel_failure": "wheels pyramid",
    "dispersion.mode": "flexible",
    "dispersion.custom": "disturbance custom",
}


def changes() -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the name of each row and its changes, from the tables, kinds and keys that a spacecraft may have."""
    for table, kinds in PLAIN.TABLES.items():
        mine = getattr(PLAIN, table, None)
        if isinstance(kinds, Mapping):
            yield from of_kinds(table, table, kinds, getattr(mine, "kind", None))
        elif mine is None and table not in ("dispersion", "tune"):
            yield table, {table: {}}
        if mine is not None and table != "tune":
            yield from of_choices(table, mine)
    for table in ("spacecraft", "hardware"):
        for key in getattr(PLAIN, table).__struct_fields__:
            if name_kinds := layouts.KINDS.get(f"{table}.{key}"):
                yield from of_kinds(f"{table}.{key}", f"{table}__{key}", name_kinds, None)
            elif getattr(getattr(PLAIN, table), key) is None or f"{table}.{key}" in VALUES:
                yield f"{table}.{key}", {}
    for key in type(PLAIN.dispersion).__struct_fields__:
        drawn = getattr(PLAIN.dispersion, key)
        yield from of_kinds(f"dispersion.{key}", f"dispersion__{key}", layouts.DISPERSIONS[key], drawn and drawn.kind)


def of_kinds(name: str, key: str, kinds: Mapping[str, Any], mine: str | None) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield a row for each kind of a table but `mine`, the plain scenario's."""
    for kind in kinds:
        if kind not in (mine, "none" if mine is None else None):
            yield f"{name} {kind}", {key: {"kind": kind, **KEYS.get(name, {})}}


def of_choices(table: str, mine: Any) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield a row for each other value of the keys of a table that are one of several words, or true or false."""
    for key, kind in typing.get_type_hints(type(mine)).items():
        if typing.get_origin(kind) is typing.Literal and key in mine.__struct_fields__ and key != "kind":
            for word in typing.get_args(kind):
                if word != getattr(mine, key) and f"{table}.{key} {word}" not in EXCLUDED:
                    yield f"{table}.{key} {word}", {f"{table}__{key}": word}


def plants() -> Iterator[tuple[str, Callable[[], Scenario]]]:
    """Yield the other plants, each with a scenario of its own."""
    examples = {
        "chain": lambda: scenario.from_tables({"plant": {"kind": "chain"}, "loop": {"mode": "sampled"}}),
        "system": lambda: scenario.read(SCENARIOS / "two_link_arm.toml"),
    }
    for kind in layouts.SCENARIOS:
        if kind != PLAIN.plant.kind:
            yield f"plant {kind}", examples[kind]


def scenarios() -> dict[str, tuple[str, Callable[[], Scenario]]]:
    """Return, by the name of each row, the name of the row that it is compared with, and its scenario."""
    found: dict[str, tuple[str, Callable[[], Scenario]]] = {"plain": ("plain", lambda: PLAIN)}
    for name, default in changes():
        base = next((base for prefix, base in BASES.items() if name.startswith(prefix)), "plain")
        found[name] = base, lambda name=name, base=base, default=default: changed(found[base][1](), name, default)
    found |= {name: ("plain", made) for name, made in plants()}
    files = sorted(SCENARIOS.glob("*.toml"))
    first = f"scenario {SCENARIO.stem}"
    return found | {f"scenario {file.stem}": (first, lambda file=file: scenario.read(file)) for file in files}


def changed(base: Scenario, name: str, default: dict[str, Any]) -> Scenario:
    """Return the scenario of a row. Raises ScenarioError if the row needs a value in `VALUES`."""
    values = VALUES.get(name, default)
    if not values:
        raise ScenarioError(f"{name} needs a value in VALUES")
    return scenario.replace(base, **values)


class Timed:
    """A compiled scenario that can be run and timed."""

    def __init__(self, scene: Scenario, trials: int) -> None:
        """Compile it, by a first run."""
        self.study, self.trials = scenario.study(scene), np.arange(trials)
        self.substeps, self.count = self.study.parts.substeps, self.study.parts.clock.count
        self.run()

    def run(self) -> float:
        """Return the CPU time per control period and trial of a run [ns]."""
        begun = time.process_time()
        jax.block_until_ready(montecarlo.run(self.study.parts, self.study.dispersion, 0, self.trials).metrics)
        return (time.process_time() - begun) / (self.trials.size * self.count) * 1e9


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("words", nargs="*")
    parser.add_argument("--trials", type=int, default=2048)
    parser.add_argument("--pairs", type=int, default=5)
    asked = parser.parse_args()
    found, bases = scenarios(), {}
    chosen = [name for name in found if not asked.words or any(word in name for word in asked.words)]
    say(f"{machine()}; {asked.trials} trials, medians of {asked.pairs} pairs\n")
    say("| feature | substeps | ns | compared with | ns | ratio |\n|---|---|---|---|---|---|")
    for name in chosen:
        base, made = found[name]
        try:
            if base not in bases:
                bases[base] = Timed(found[base][1](), asked.trials)
            mine, other = Timed(made(), asked.trials), bases[base]
        except ScenarioError as error:
            say(f"| {name} | not measured: {error} | | | | |")
            continue
        pairs = np.array([(mine.run(), other.run()) for _ in range(asked.pairs)])
        ratio = float(np.median(pairs[:, 0] / pairs[:, 1]))
        first, second = np.median(pairs, axis=0)
        say(f"| {name} | {mine.substeps} | {first:.0f} | {base} | {second:.0f} | {ratio:.2f} |")


if __name__ == "__main__":
    main()
