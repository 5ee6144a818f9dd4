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

SEQUENCE = "ZYX"  # default rotation sequence of Euler angles
DIGITS = 12  # significant digits of the output; the conversion has rounding errors in further digits


def parse_quaternion(texts: Mapping[str, str | None]) -> np.ndarray:
    """Return the unit quaternion (4,), scalar last, of the attitude that the options of the command give.

    Raises UsageError, which names the option, unless exactly one attitude is given and valid.

    Args:
        texts: value of each option by its key, None if absent. `sequence` applies to euler_deg only.
    """
    keys = [key for key in ATTITUDE_KEYS if texts.get(key) is not None]
    options = [_option_name(key) for key in ATTITUDE_KEYS]
    if len(keys) != 1:
        problem = f"{' and '.join(map(_option_name, keys))} are given" if keys else "no attitude is given"
        raise UsageError(f"{problem}, but must be exactly one of {', '.join(options)}")
    (key,) = keys
    values = _parse_numbers(key, str(texts[key]))
    is_matrix = key == "dcm_body_to_inertial" and len(values) == 9
    raw: dict[str, object] = {key: [values[k : k + 3] for k in (0, 3, 6)] if is_matrix else values}
    if key == "euler_deg":
        sequence = texts.get("sequence")
        raw["sequence"] = SEQUENCE if sequence is None else sequence
    try:
        scenario = typing.cast(SpacecraftScenario, parsing.parse({"initial": raw}))
        return attitude_keys.quaternion(scenario.initial, "initial")
    except ScenarioError as error:
        raise UsageError(re.sub(r"initial\.(\w+)", lambda match: _option_name(match[1]), str(error))) from None


def attitude_lines(q: np.ndarray, sequence: str | None = None) -> list[str]:
    """Return one attitude in every form that a scenario file accepts, one line for each.

    Args:
        q: unit quaternion (4,), scalar last.
        sequence: rotation sequence of the Euler angles; None: `SEQUENCE`. Raises UsageError if it is invalid.
    """
    from scipy.spatial.transform import Rotation

    axes = SEQUENCE if sequence is None else sequence
    rotation = Rotation.from_quat(q)
    x, y, z, w = (float(v) for v in q)
    vector = np.round(rotation.as_rotvec(degrees=True), DIGITS)  # a whole turn is 0 up to rounding
    angle = float(np.linalg.norm(vector))
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            euler = np.round(rotation.as_euler(axes, degrees=True), DIGITS)
    except ValueError:
        raise UsageError(
            f"--sequence is {axes}, but must be three axes in SciPy's notation, such as ZYX or zyx"
        ) from None
    gimbal_lock = "; gimbal lock: only the sum or difference of the first and the last is known" if caught else ""
    axis = "" if angle == 0.0 else f" about {_format_numbers(vector / angle)}"
    rows = ", ".join(_format_numbers(row) for row in rotation.as_matrix())
    return [
        f"quat_xyzw = {_format_numbers([x, y, z, w])}",
        f"quat_wxyz = {_format_numbers([w, x, y, z])}",
        f"rotvec_deg = {_format_numbers(vector)}  # {angle:.6g} degrees{axis}",
        f"mrp = {_format_numbers(rotation.as_mrp())}",
        f"dcm_body_to_inertial = [{rows}]",
        f'euler_deg = {_format_numbers(euler)}  # with sequence = "{axes}"{gimbal_lock}',
    ]


def _parse_numbers(key: str, text: str) -> list[float]:
    """Return the numbers in the text of an option, separated by commas or spaces.

    Args:
        key: name of the option in Python, for the error.
        text: the text.

    Raises:
        UsageError: the text has something else than numbers.
    """
    try:
        return [float(part) for part in re.split(r"[,\s]+", text.strip(" []()"))]
    except ValueError:
        raise UsageError(f"{_option_name(key)} is {text}, but must be numbers such as 0.1,0.2,0.3") from None


def _option_name(key: str) -> str:
    """Return an option as the user writes it, such as "--euler-deg" for "euler_deg"."""
    return f"--{key.replace('_', '-')}"


def _format_numbers(values: object) -> str:
    """Return numbers (n,) as a list in TOML, rounded."""
    return "[" + ", ".join(f"{v + 0.0:.{DIGITS}g}" for v in np.round(np.asarray(values, dtype=float), DIGITS + 2)) + "]"
