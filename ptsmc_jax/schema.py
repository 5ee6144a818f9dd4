"""Scenario files: every table, key, type, range and default; what is wrong in a file, in one sentence.

Only the shape of a scenario is known here; `scenario.py` checks keys against each other and builds the parts.
"""

import difflib
import json
import math
import tomllib
import types
import typing
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

NOT_YET = "is not available yet"


class ScenarioError(ValueError):
    """A scenario that cannot be run. Its text is one sentence that names the key, the value and what is allowed."""


def wrong(key: str, value: Any, allowed: str) -> ScenarioError:
    """The error for a key whose value is not allowed."""
    return ScenarioError(f"{key} is {show(value)}, but must be {allowed}")


def show(value: Any) -> str:
    """A value as a scenario file would write it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, float):
        return repr(value)
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(show, value)) + "]"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{k} = {show(v)}" for k, v in value.items()) + " }"
    return str(value)


Number = Annotated[float, Meta(description="a number")]
Positive = Annotated[float, Meta(gt=0, description="a number greater than 0")]
NotNegative = Annotated[float, Meta(ge=0, description="a number, at least 0")]
Count = Annotated[int, Meta(ge=1, description="a whole number, at least 1")]
Three = Annotated[tuple[float, float, float], Meta(description="three numbers")]
ThreePositive = Annotated[tuple[Positive, Positive, Positive], Meta(description="three numbers greater than 0")]
Four = Annotated[tuple[float, float, float, float], Meta(description="four numbers")]
Matrix = Annotated[tuple[Three, Three, Three], Meta(description="three rows of three numbers")]
Interval = Annotated[tuple[float, float], Meta(description="two numbers, the lower bound first")]
Inertia = Annotated[Any, Meta(description="three principal moments or a symmetric 3x3 tensor [kg m^2]")]
Quantile = Annotated[float, Meta(gt=0, lt=1, description="a number between 0 and 1")]


class Table(msgspec.Struct, kw_only=True, frozen=True, omit_defaults=False):
    """A table of a scenario file."""


class Plant(Table, frozen=True):
    kind: Literal["spacecraft"] = "spacecraft"


class Spacecraft(Table, frozen=True):
    inertia: Inertia = (10.0, 12.0, 14.0)


class Attitude(Table, frozen=True):
    """Exactly one of the attitude keys; `euler_deg` goes with `sequence`."""

    quat_xyzw: Four | None = None
    quat_wxyz: Four | None = None
    rotvec_deg: Three | None = None
    mrp: Three | None = None
    dcm_body_to_inertial: Matrix | None = None
    euler_deg: Three | None = None
    sequence: Annotated[str, Meta(description='three axes in SciPy\'s notation, such as "ZYX" or "zyx"')] | None = None


ATTITUDE_KEYS = ("quat_xyzw", "quat_wxyz", "rotvec_deg", "mrp", "dcm_body_to_inertial", "euler_deg")


class Initial(Attitude, frozen=True):
    rate: Three = (0.0, 0.0, 0.0)


class FixedReference(Attitude, frozen=True):
    kind: Literal["fixed"] = "fixed"


class SpinReference(Attitude, frozen=True):
    kind: Literal["spin"] = "spin"
    rate: Three = (0.0, 0.0, 0.0)


class NoDisturbance(Table, frozen=True):
    kind: Literal["none"] = "none"


class ConstantDisturbance(Table, frozen=True):
    kind: Literal["constant"] = "constant"
    amplitude: Three = (0.01, 0.01, 0.01)


class SinusoidDisturbance(Table, frozen=True):
    kind: Literal["sinusoid"] = "sinusoid"
    amplitude: Three = (0.01, 0.01, 0.01)
    frequency: Three = (0.1, 0.1, 0.1)
    phase: Three = (0.0, 0.0, 0.0)
    bias: Three = (0.0, 0.0, 0.0)


class Controller(Table, frozen=True):
    kind: Literal["prescribed_time"] = "prescribed_time"
    error: Literal["additive", "multiplicative"] = "additive"
    t_f: Positive = 30.0
    eta: Annotated[float, Meta(gt=2, description="a number greater than 2 (Theorem 1)")] = 3.0
    delta: Positive = 0.05
    k1: Positive = 1.0
    sign_width: NotNegative = 1e-3
    disturbance_rate_bound: NotNegative = 1e-3
    disturbance_bound: NotNegative = 0.01
    initial_estimate_error: NotNegative = 0.0


class NonlinearObserver(Table, frozen=True):
    kind: Literal["nonlinear"] = "nonlinear"
    gain: ThreePositive = (10.0, 10.0, 10.0)


class Loop(Table, frozen=True):
    mode: Literal["continuous", "sampled"] = "continuous"
    period: Positive = 0.05
    clock: Literal["anchored", "flight"] = "anchored"
    t_end: Positive | None = None
    window: Positive = 1.0
    settling_angle: Positive = 1e-3


class Hardware(Table, frozen=True):
    torque_limit: Positive | None = None
    torque_rate_limit: Positive | None = None
    torque_lag: Positive | None = None
    torque_step: Positive | None = None
    delay: Annotated[int, Meta(ge=0, description="a whole number, at least 0")] | None = None
    attitude_noise: NotNegative | None = None
    rate_noise: NotNegative | None = None
    rate_bias: NotNegative | None = None


class UniformAttitude(Table, frozen=True):
    kind: Literal["uniform"] = "uniform"


class AxisAngle(Table, frozen=True):
    kind: Literal["axis_angle"] = "axis_angle"
    min_deg: Annotated[float, Meta(ge=0, le=180, description="an angle from 0 to 180 degrees")] = 20.0
    max_deg: Annotated[float, Meta(ge=0, le=180, description="an angle from 0 to 180 degrees")] = 140.0


class NormalAttitude(Table, frozen=True):
    kind: Literal["normal"] = "normal"
    std_deg: NotNegative = 1.0


class NormalRate(Table, frozen=True):
    kind: Literal["normal"] = "normal"
    std: NotNegative = 0.01


class RelativeInertia(Table, frozen=True):
    kind: Literal["relative_normal"] = "relative_normal"
    std: NotNegative = 0.05


class UniformPhase(Table, frozen=True):
    kind: Literal["uniform"] = "uniform"


class Limit(Table, frozen=True):
    """A requirement in full: metric <= limit in this share of the trials, with this one-sided confidence."""

    limit: Positive
    quantile: Quantile | None = None
    confidence: Quantile | None = None


Free = Literal["eta", "delta", "observer_gain", "k1", "sign_width", "t_f"]
FREE: tuple[str, ...] = typing.get_args(Free)
FreeGains = Annotated[tuple[Free, ...], Meta(min_length=1, description=f"a list of some of {', '.join(FREE)}")]


class Tune(Table, frozen=True):
    free: FreeGains = ("eta", "delta", "observer_gain")
    bounds: Annotated[dict[str, Interval], Meta(description="a table of two numbers for each gain")] = {}
    objective: Literal["rms", "worst", "cvar"] = "rms"
    level: Quantile | None = None
    trials: Count = 256
    starts: Count = 8
    steps: Count = 150


class Dispersion(Table, frozen=True):
    attitude: UniformAttitude | AxisAngle | NormalAttitude | None = None
    rate: NormalRate | None = None
    inertia: RelativeInertia | None = None
    disturbance_phase: UniformPhase | None = None


class Scenario(Table, frozen=True):
    """A scenario as its file says it, every key resolved; tables that are None are off."""

    plant: Plant = Plant()
    spacecraft: Spacecraft = Spacecraft()
    initial: Initial = Initial(
        quat_xyzw=(0.4714045207910317, -0.3333333333333333, 0.5773502691896258, 0.5773502691896258)
    )
    reference: FixedReference | SpinReference = FixedReference(quat_xyzw=(0.0, 0.0, 0.0, 1.0))
    disturbance: NoDisturbance | ConstantDisturbance | SinusoidDisturbance = SinusoidDisturbance()
    controller: Controller = Controller()
    observer: NonlinearObserver = NonlinearObserver()
    loop: Loop = Loop()
    hardware: Hardware | None = None
    dispersion: Dispersion | None = None
    requirements: dict[str, float | Limit] = {}
    tune: Tune | None = None


# table: kinds, the default first; a kind without a struct is refused as not available yet
_KINDS: dict[str, dict[str, type[Table] | None]] = {
    "plant": {"spacecraft": Plant, "chain": None},
    "reference": {"fixed": FixedReference, "spin": SpinReference, "sinusoid": None, "slew": None},
    "disturbance": {"sinusoid": SinusoidDisturbance, "none": NoDisturbance, "constant": ConstantDisturbance},
    "controller": {"prescribed_time": Controller, "pd": None, "terminal": None, "fixed_time": None},
    "observer": {"nonlinear": NonlinearObserver, "none": None, "finite_time": None, "prescribed_time": None},
    "dispersion.attitude": {"axis_angle": AxisAngle, "uniform": UniformAttitude, "normal": NormalAttitude},
    "dispersion.rate": {"normal": NormalRate},
    "dispersion.inertia": {"relative_normal": RelativeInertia},
    "dispersion.disturbance_phase": {"uniform": UniformPhase},
}
_TABLES: dict[str, type[Table]] = {
    "spacecraft": Spacecraft,
    "initial": Initial,
    "loop": Loop,
    "hardware": Hardware,
    "tune": Tune,
}


def load(path: str | Path) -> dict[str, Any]:
    """The raw tables of a TOML file; raises ScenarioError where it is not there or no TOML."""
    try:
        text = Path(path).read_text(encoding="utf-8")
        return tomllib.loads(text)
    except FileNotFoundError:
        raise ScenarioError(f"the scenario file {path} is not there") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError(f"the scenario file {path} cannot be read as text: {error}") from None
    except ValueError as error:  # TOMLDecodeError, or a number with too many digits for Python
        raise ScenarioError(f"the scenario file {path} is no valid TOML: {error}") from None


def parse(raw: Mapping[str, Any], metrics: Collection[str]) -> Scenario:
    """Scenario from raw tables, absent keys at their defaults; raises ScenarioError. `metrics`: known names."""
    defaults = Scenario()
    names = Scenario.__struct_fields__
    found: dict[str, Any] = {}
    for name, table in raw.items():
        if name not in names:
            raise ScenarioError(f"[{name}] is not a known table; the nearest known one is [{nearest(name, names)}]")
        if not isinstance(table, Mapping):
            raise wrong(name, table, "a table")
        if name == "requirements":
            found[name] = {key: _requirement(key, value, metrics) for key, value in table.items()}
        elif name == "dispersion":
            found[name] = _dispersion(table)
        else:
            found[name] = _table(name, table)
    for name, key in (("initial", "attitude"), ("reference", "attitude")):
        default, given = getattr(defaults, name), found.get(name)
        if given is not None:  # a table without an attitude keeps the default one
            said = [key for key in ATTITUDE_KEYS if getattr(given, key) is not None]
            if len(said) > 1:
                two, allowed = " and ".join(said), ", ".join(ATTITUDE_KEYS)
                raise ScenarioError(f"{name} has the attitude keys {two}, but must have exactly one of {allowed}")
            if not said:
                found[name] = msgspec.structs.replace(given, quat_xyzw=default.quat_xyzw)
    return Scenario(**found)


def dump(scenario: Scenario) -> dict[str, Any]:
    """Tables that `parse` reads back to the same scenario; what is None is left out."""
    return typing.cast(dict, _without_none(msgspec.to_builtins(scenario)))


def _without_none(value: Any) -> Any:
    if isinstance(value, Mapping):
        kept = {k: _without_none(v) for k, v in value.items() if v is not None}
        return {k: v for k, v in kept.items() if v != {} or k not in ("requirements", "bounds")}
    if isinstance(value, list | tuple):
        return [_without_none(v) for v in value]
    return value


def nearest(name: str, known: Iterable[str]) -> str:
    """The known name most like this one."""
    return difflib.get_close_matches(name, list(known), n=1, cutoff=0.0)[0]


def _table(name: str, raw: Mapping[str, Any]) -> Table:
    if name not in _KINDS:
        return _fields(name, raw, _TABLES[name])
    kinds = _KINDS[name]
    kind = raw.get("kind", next(iter(kinds)))
    if not isinstance(kind, str) or kind not in kinds:
        allowed = " or ".join(show(k) for k, struct in kinds.items() if struct is not None)
        raise wrong(f"{name}.kind", kind, allowed)
    struct = kinds[kind]
    if struct is None:
        allowed = " or ".join(show(k) for k, s in kinds.items() if s is not None)
        raise ScenarioError(f"{name}.kind = {show(kind)} {NOT_YET}; allowed is {allowed}")
    return _fields(name, raw, struct)


def _dispersion(raw: Mapping[str, Any]) -> Dispersion:
    found = {}
    for key, table in raw.items():
        if key not in Dispersion.__struct_fields__:
            closest = nearest(key, Dispersion.__struct_fields__)
            raise ScenarioError(f"dispersion.{key} is not a known key; the nearest known one is dispersion.{closest}")
        if not isinstance(table, Mapping):
            raise wrong(f"dispersion.{key}", table, 'an inline table such as { kind = "uniform" }')
        found[key] = _table(f"dispersion.{key}", table)
    return Dispersion(**found)


def _requirement(metric: str, value: Any, metrics: Collection[str]) -> float | Limit:
    key = f"requirements.{metric}"
    if metric not in metrics:
        raise ScenarioError(f"{key} is not a known metric; the nearest known one is {nearest(metric, metrics)}")
    if isinstance(value, Mapping):
        if "limit" not in value:
            raise wrong(key, value, "a number greater than 0 or a table with `limit`")
        return typing.cast(Limit, _fields(key, value, Limit))
    return _value(key, value, Positive)


def _fields(name: str, raw: Mapping[str, Any], struct: type[Table]) -> Table:
    hints = typing.get_type_hints(struct, include_extras=True)
    known = struct.__struct_fields__
    for key in raw:
        if key not in known:
            closest = nearest(key, known)
            raise ScenarioError(f"{name}.{key} is not a known key; the nearest known one is {name}.{closest}")
    return struct(**{key: _value(f"{name}.{key}", value, hints[key]) for key, value in raw.items()})


def _value(key: str, value: Any, kind: Any) -> Any:
    value = _plain(value)
    bad = _not_finite(value)
    if bad is not None:
        raise wrong(key, value, f"{_description(kind)}, and {bad!r} is no finite number")
    if _holds_truth(value):  # numpy, which reads the inertia, takes true for 1
        raise wrong(key, value, _description(kind))
    try:
        return msgspec.convert(value, kind, strict=True)
    except msgspec.ValidationError:
        raise wrong(key, value, _description(kind)) from None


def _plain(value: Any) -> Any:
    """Python numbers and tuples for lists and numpy's."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    return tuple(map(_plain, value)) if isinstance(value, list | tuple) else value


def _holds_truth(value: Any) -> bool:
    return isinstance(value, bool) or (isinstance(value, tuple) and any(map(_holds_truth, value)))


def _not_finite(value: Any) -> float | None:
    if isinstance(value, float) and not math.isfinite(value):
        return value
    inside = value.values() if isinstance(value, Mapping) else value if isinstance(value, list | tuple) else ()
    return next((bad for bad in map(_not_finite, inside) if bad is not None), None)


def _description(kind: Any) -> str:
    """What a type allows, in words."""
    if typing.get_origin(kind) in (types.UnionType, typing.Union):
        return " or ".join(_description(k) for k in typing.get_args(kind) if k is not type(None))
    if typing.get_origin(kind) is Literal:
        return " or ".join(show(v) for v in typing.get_args(kind))
    return next((m.description for m in getattr(kind, "__metadata__", ()) if m.description), "of another type")
