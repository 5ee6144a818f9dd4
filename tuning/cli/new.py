"""`ptsmc new`: write a scenario file with value, unit and meaning of every key. Unused keys are comments."""

import textwrap
from collections.abc import Iterator, Mapping
from typing import Any

import msgspec

from ptsmc_jax import scenario
from ptsmc_jax.scenario import errors, free_gains, keys, layouts, mission, parsing, reading
from ptsmc_jax.scenario.attitude_keys import Attitude
from ptsmc_jax.scenario.custom import Custom
from ptsmc_jax.scenario.law_tables import LawTable
from ptsmc_jax.scenario.schema import PartTable
from ptsmc_jax.scenario.sensor_tables import SENSORS, SUITE_MEANING
from ptsmc_jax.scenario.tables import Scenario, Tune
from ptsmc_jax.scenario.values import Table
from ptsmc_jax.simulation import catalogues
from tuning.errors import UsageError

COLUMN, WIDTH = 36, 120  # column in which meanings begin, and largest length of a line
# Example values of keys without a default.
EXAMPLES: dict[str, Any] = {
    "plant.system": "my_plant.py:my_plant",
    "controller.code": "my_parts.py:MyLaw",
    "controller.delta": 0.5,
    "controller.disturbance_bound": 0.01,
    "controller.disturbance_rate_bound": 1e-3,
    "observer.code": "my_parts.py:MyObserver",
    "disturbance.code": "my_parts.py:MyDisturbance",
    "reference.code": "my_parts.py:MyReference",
    "reference.file": "attitude.csv",
    "reference.quaternion_order": "xyzw",
    "reference.direction": "body_to_inertial",
    "loop.epoch": "2026-03-20T12:00:00",
    "orbit.earth_angle": 0.0,
    "disturbance.orbit_rate": 1.1e-3,
    "sensors.code": "my_parts.py:MySensors",
    "sensors.boresight": [0.0, 0.0, 1.0],
    "sensors.rotvec_deg": [0.0, 90.0, 0.0],
    "sensors.period": 0.5,
    "sensors.noise_across": 4e-5,
    "sensors.noise_about": 2e-4,
    "sensors.direction": [1.0, 0.0, 0.0],
    "sensors.noise": 1e-3,
    "sensors.rate_noise": 1e-6,
    "sensors.rate_noise_density": 2e-7,
    "dispersion.code": "my_parts.py:MyDraw",
    "plant.truth": "my_plant.py:true_plant",
    "spacecraft.true_inertia": [10.5, 12.6, 14.7],
    "initial.quat_xyzw": [0.0, 0.0, 0.0, 1.0],
    "initial.quat_wxyz": [1.0, 0.0, 0.0, 0.0],
    "initial.rotvec_deg": [0.0, 0.0, 120.0],
    "initial.mrp": [0.0, 0.0, 0.5],
    "initial.dcm_body_to_inertial": [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
    "initial.euler_deg": [90.0, 0.0, 0.0],
    "initial.sequence": "ZYX",
    "disturbance.terms": [{"kind": "constant"}, {"kind": "sinusoid"}],
    "hardware.torque_limit": 0.5,
    "hardware.torque_rate_limit": 5.0,
    "hardware.torque_lag": 0.1,
    "hardware.torque_step": 1e-4,
    "hardware.delay": 1,
    "hardware.attitude_noise": 2e-5,
    "hardware.rate_noise": 1e-6,
    "hardware.rate_noise_density": 2e-7,
    "hardware.rate_bias": 1e-6,
    "hardware.rate_bias_walk": 1e-8,
    "hardware.star_tracker_every": 4,
    "hardware.star_tracker_period": 0.25,
    "hardware.state_noise": 1e-4,
    "hardware.actuator_scale": 1.02,
    "hardware.actuator_misalignment_deg": [0.0, 0.0, 0.1],
    "hardware.gyro_scale": [1.001, 0.999, 1.0],
    "hardware.star_tracker_misalignment_deg": [0.0, 0.01, 0.0],
    "wheels.torque_limit": 0.2,
    "wheels.momentum_limit": 4.0,
    "wheels.momentum": 0.0,
    "filter.bandwidth": 0.05,
    "dispersion.half_width": 1.0,
    "dispersion.latest": 30.0,
    "dispersion.std": 1.0,
    "tune.level": 0.9,
    "telemetry.attitude": ["measured_q1", "measured_q2", "measured_q3", "measured_q4"],
    "telemetry.attitude_age": "measured_age",
    "telemetry.rate": ["measured_w1", "measured_w2", "measured_w3"],
    "telemetry.torque": ["sent1", "sent2", "sent3"],
    "telemetry.wheel_torque": ["torque1", "torque2", "torque3", "torque4"],
    "telemetry.wheel_speed": ["speed1", "speed2", "speed3", "speed4"],
    "telemetry.wheel_inertia": 1e-5,
    "telemetry.state": ["measured_x1", "measured_x2"],
    "telemetry.input": ["sent1"],
    "identify.free": ["inertia", "gyro_bias"],
    "identify.torque_walk": 1e-6,
}
REQUIREMENTS = {"window_error": {"limit": 1e-4, "quantile": 0.9973, "confidence": 0.9}, "peak_torque": 0.5}
INTRODUCTION = """\
A scenario for ptsmc. Every key is optional: an absent key has the value shown here. Tables that are off, like
#[hardware], stay off. To use a line such as #delay = 1, remove its # and the # of its table. Units are in brackets.
The keys of other kinds follow a table, and replace the keys of its kind."""


class _ScenarioFile:
    """The lines of a scenario file."""

    def __init__(self, stated: Scenario, resolved: Scenario):
        self.resolved, self.plant = resolved, resolved.plant.kind
        self.stated_tables = parsing.to_raw_tables(stated)
        self.values = parsing.dump(resolved)
        # including the default gains, if they are known without running custom code
        default = parsing.to_dict(free_gains.resolve(resolved, Tune()))
        self.values["tune"] = {**default, **self.values.get("tune", {})}

    def lines(self) -> Iterator[str]:
        """Return all lines of the file."""
        yield from _comment_lines(INTRODUCTION)
        for name, table in layouts.TABLES[self.plant].items():
            if name == "tune":
                yield from ("", *self.requirement_lines())
            yield from ("", *self.table_lines(name, table))
            if name == "sensors" and self.plant == "spacecraft":
                yield from ("", *self.sensor_list_lines())

    def table_lines(self, name: str, table: type[Table] | layouts.Kinds) -> Iterator[str]:
        """Return the lines of a table, followed by the keys of its other kinds as comments."""
        stated, values = self.stated_tables.get(name), self.values.get(name, {})
        if isinstance(stated, list):  # see `sensor_list_lines`
            stated, values = None, {}
        kinds = table if isinstance(table, Mapping) else {}
        kind = self.plant if name == "plant" else values.get("kind", next(iter(kinds), None))
        struct = table if isinstance(table, type) else kinds[kind]
        if kind is None:
            yield from _comment_lines(keys.description(struct))
        yield f"{'#' if stated is None else ''}[{name}]"
        yield from self.kind_lines(name, kind, struct, stated, values)
        if issubclass(struct, Attitude) and name != "initial":
            yield from _comment_lines("its attitude by one of the keys of [initial]")
        for other, alternative in kinds.items():
            if other != kind:
                yield ""
                yield from self.kind_lines(name, other, alternative, None, {})

    def sensor_list_lines(self) -> Iterator[str]:
        """Return the lines of the sensors of the scenario, then of the other kinds of sensors as comments."""
        yield from _comment_lines(SUITE_MEANING)
        stated = self.stated_tables.get("sensors")
        sensors = list(zip(stated, self.values["sensors"], strict=True)) if isinstance(stated, list) else []
        for keys_given, values in sensors:
            yield from ("", "[[sensors]]")
            kind = values["kind"]
            yield from self.kind_lines("sensors", kind, SENSORS[kind], keys_given, values)
        for kind in (kind for kind in SENSORS if kind not in {values["kind"] for _, values in sensors}):
            yield from ("", "#[[sensors]]")
            yield from self.kind_lines("sensors", kind, SENSORS[kind], None, {})

    def kind_lines(
        self, name: str, kind: str | None, struct: type[Table], stated: dict[str, Any] | None, values: dict[str, object]
    ) -> Iterator[str]:
        """Return the lines of the keys of one kind of a table.

        Args:
            name: name of the table.
            kind: kind of the table; None: the table has no kinds.
            struct: declaration of the keys of this kind.
            stated: the keys in the scenario; None: all lines are comments.
            values: the values that the scenario states or implies.
        """
        if kind is not None:
            yield from _key_lines(stated is None, "kind", kind, keys.description(struct))
        values = {**self.default_values(name, struct), **values}
        # the attitude keys are explained at [initial] only; other tables show those that the scenario has
        explained_before = Attitude.__struct_fields__ if name not in ("initial", "sensors") else ()
        for key in keys.list_keys(struct, self.resolved.unit_of_d):
            is_off = stated is None or key.name not in stated
            kinds = layouts.DISPERSIONS[key.name] if name == "dispersion" else layouts.KINDS.get(f"{name}.{key.name}")
            if kinds is not None:
                yield from self.inline_lines(name, key, (stated or {}).get(key.name, {}), kinds)
            elif not (is_off and key.name in explained_before):
                value = values[key.name] if key.name in values else self.example_value(name, kind, key)
                yield from _key_lines(is_off, key.name, value, _describe_key(key))
        if issubclass(struct, Custom):
            for name in stated or ():
                if name not in ("kind", *struct.__struct_fields__):
                    yield from _key_lines(False, name, values[name], "custom")

    def inline_lines(
        self, name: str, key: keys.Key, chosen: Mapping[str, object], kinds: layouts.Kinds
    ) -> Iterator[str]:
        """Return a line for each kind of an inline table; all but the kind in the scenario are comments.

        Args:
            name: name of the table that contains the inline table.
            key: key of the inline table.
            chosen: the inline table of the scenario.
            kinds: all kinds.
        """
        yield from _comment_lines(f"{key.meaning}:")
        for kind, struct in kinds.items():
            scaled = {key: mission.scales(self.resolved).scaled_value(one) for key, one in struct.scaled.items()}
            others = (k for k in keys.list_keys(struct, self.resolved.unit_of_d) if k.name not in scaled)
            table = {"kind": kind, **scaled, **{k.name: self.example_value(name, kind, k) for k in others}}
            is_chosen = chosen.get("kind") == kind
            yield from _key_lines(not is_chosen, key.name, chosen if is_chosen else table, keys.description(struct))

    def requirement_lines(self) -> Iterator[str]:
        """Return the requirements of the scenario, or two examples."""
        catalogue, stated = self.resolved.metrics, self.stated_tables.get("requirements")
        limited = [name for name in catalogue if not name.startswith(catalogues.WITHIN)]  # required by other keys
        yield from _comment_lines(
            "The largest allowed value of a metric, in every trial or in a fraction of them, with a confidence. "
            f"A limit may have a unit: {'hold_angle' if 'hold_angle' in catalogue else 'settling_time'} = "
            f'"{"0.05 deg" if "hold_angle" in catalogue else "800 ms"}". The metrics are {", ".join(limited)}. '
            f"The margins of the sampled loop are {', '.join(catalogues.MARGINS)}. The limit is "
            "the smallest allowed margin, or the largest allowed peak sensitivity."
        )
        yield f"{'#' if stated is None else ''}[requirements]"
        known = {**catalogue, **catalogues.MARGINS}
        for name, limit in (stated or REQUIREMENTS).items():
            entry = known[name]
            yield from _key_lines(stated is None, name, limit, f"{entry.meaning} [{entry.unit}]")

    def default_values(self, name: str, struct: type[Table]) -> dict[str, object]:
        """Return the defaults of the keys of a table; keys without a default are missing."""
        needed = {"code": EXAMPLES[f"{name}.code"]} if issubclass(struct, Custom) else {}
        needed |= {"t_f": self.resolved.controller.t_f} if issubclass(struct, LawTable) else {}
        table: Any = struct(**needed)
        table = table.fill_defaults(self.resolved) if isinstance(table, PartTable) else table
        table = mission.fill_scaled_defaults(table, mission.scales(self.resolved))
        table = table.complete_for_file(self.resolved) if isinstance(table, PartTable) else table
        return {key: value for key, value in parsing.to_dict(table).items() if value not in ([], {})}

    def example_value(self, table: str, kind: str | None, key: keys.Key) -> object:
        """Return the value that a comment shows for an unused key: its default or an example."""
        if key.default not in (None, (), msgspec.NODEFAULT):
            return key.default
        value = EXAMPLES[f"{table}.{key.name}"]
        if key.allowed.endswith("for each state"):
            return [value] * len(self.resolved.plant.x0)
        if key.allowed.endswith("for each component of a reading"):
            return [value] * 3
        if key.allowed.endswith("for each axis, wheel or input"):
            return [value] * self.resolved.inputs
        return [value] * (4 if kind == "pyramid" else 3) if key.allowed.endswith("for each wheel") else value


def scenario_text(plant: str | None, raw: Mapping[str, object]) -> str:
    """Return a commented scenario file.

    Args:
        plant: kind of the plant; None: the kind in `raw`, or a spacecraft.
        raw: tables of a scenario, see `parsing.load`; empty: the default scenario of the plant.

    Raises:
        ScenarioError: `raw` is not a valid scenario.
        UsageError: the kind of the plant is unknown, or `raw` has another kind.
    """
    if plant is not None and plant not in layouts.TABLES:
        raise UsageError(f"--plant is {plant}, but must be {' or '.join(layouts.TABLES)}")
    kind = plant or "spacecraft"
    given = raw or {"plant": {"kind": kind, **({"system": EXAMPLES["plant.system"]} if kind == "system" else {})}}
    stated = parsing.parse(given)
    if plant not in (None, stated.plant.kind):
        raise UsageError(f"--plant is {plant}, but the scenario of --like has plant.kind = {stated.plant.kind}")
    # the file of the system does not exist yet, so the scenario cannot be checked
    resolved = reading.resolve(stated) if kind == "system" and not raw else scenario.from_tables(given)
    return "\n".join(_ScenarioFile(stated, resolved).lines()) + "\n"


def _describe_key(key: keys.Key) -> str:
    """Return the meaning of a key, after its allowed values if they are texts."""
    choice = f"{key.allowed.replace(' or ', ' | ')}: " if key.allowed.startswith('"') and " or " in key.allowed else ""
    return choice + key.text


def _key_lines(off: bool, key: str, value: object, meaning: str) -> Iterator[str]:
    """Return `key = value  # meaning`; a long meaning is on the lines above."""
    shown = f"{'#' if off else ''}{errors.show_key(key)} = {errors.show(value)}"
    line = f"{shown:<{COLUMN - 1}} # {meaning}"
    if len(line) > WIDTH:
        yield from _comment_lines(meaning)
    yield line if len(line) <= WIDTH else shown


def _comment_lines(words: str) -> list[str]:
    """Return a text as comments of the scenario file, wrapped to its width."""
    return [f"# {line}" for line in textwrap.wrap(words, WIDTH - 2)]
