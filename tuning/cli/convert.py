"""`ptsmc convert-attitude`: one attitude in every form that a scenario takes."""

import re
import typing
import warnings
from collections.abc import Mapping

import numpy as np

from ptsmc_jax.scenario import attitude_keys, parsing
from ptsmc_jax.scenario.attitude_keys import ATTITUDE_KEYS
from ptsmc_jax.scenario.errors import ScenarioError
from ptsmc_jax.scenario.spacecraft_scenario import SpacecraftScenario
from tuning.errors import UsageError

SEQUENCE = "ZYX"  # default of Euler angles
DIGITS = 12  # the conversion rounds further ones


def quaternion(texts: Mapping[str, str | None]) -> np.ndarray:
    """Unit quaternion (4,), scalar last, of the one attitude key that is given as text; numbers by commas or spaces.

    A `sequence` may be given with euler_deg. Raises UsageError, naming the option.
    """
    keys = [key for key in ATTITUDE_KEYS if texts.get(key) is not None]
    options = [_option(key) for key in ATTITUDE_KEYS]
    if len(keys) != 1:
        wrong = f"{' and '.join(map(_option, keys))} are given" if keys else "no attitude is given"
        raise UsageError(f"{wrong}, but must be exactly one of {', '.join(options)}")
    (key,) = keys
    values = _numbers(key, str(texts[key]))
    rows = key == "dcm_body_to_inertial" and len(values) == 9
    raw: dict[str, object] = {key: [values[k : k + 3] for k in (0, 3, 6)] if rows else values}
    if key == "euler_deg":
        sequence = texts.get("sequence")
        raw["sequence"] = SEQUENCE if sequence is None else sequence
    try:
        scenario = typing.cast(SpacecraftScenario, parsing.parse({"initial": raw}))
        return attitude_keys.quaternion(scenario.initial, "initial")
    except ScenarioError as error:
        raise UsageError(re.sub(r"initial\.(\w+)", lambda match: _option(match[1]), str(error))) from None


def lines(q: np.ndarray, sequence: str | None = None) -> list[str]:
    """The same attitude in every form, as a scenario file has it; q (4,) scalar last. Raises UsageError."""
    from scipy.spatial.transform import Rotation

    order = SEQUENCE if sequence is None else sequence
    turn = Rotation.from_quat(q)
    x, y, z, w = (float(v) for v in q)
    vector = np.round(turn.as_rotvec(degrees=True), DIGITS)  # a whole turn is 0 up to rounding
    angle = float(np.linalg.norm(vector))
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            euler = np.round(turn.as_euler(order, degrees=True), DIGITS)
    except ValueError:
        raise UsageError(
            f"--sequence is {order}, but must be three axes in SciPy's notation, such as ZYX or zyx"
        ) from None
    lock = "; gimbal lock: only the sum or difference of the first and the last is known" if caught else ""
    axis = "" if angle == 0.0 else f" about {_text(vector / angle)}"
    rows = ", ".join(_text(row) for row in turn.as_matrix())
    return [
        f"quat_xyzw = {_text([x, y, z, w])}",
        f"quat_wxyz = {_text([w, x, y, z])}",
        f"rotvec_deg = {_text(vector)}  # {angle:.6g} degrees{axis}",
        f"mrp = {_text(turn.as_mrp())}",
        f"dcm_body_to_inertial = [{rows}]",
        f'euler_deg = {_text(euler)}  # with sequence = "{order}"{lock}',
    ]


def _numbers(key: str, text: str) -> list[float]:
    try:
        return [float(part) for part in re.split(r"[,\s]+", text.strip(" []()"))]
    except ValueError:
        raise UsageError(f"{_option(key)} is {text}, but must be numbers such as 0.1,0.2,0.3") from None


def _option(key: str) -> str:
    return f"--{key.replace('_', '-')}"


def _text(values: object) -> str:
    return "[" + ", ".join(f"{v + 0.0:.{DIGITS}g}" for v in np.round(np.asarray(values, dtype=float), DIGITS + 2)) + "]"
