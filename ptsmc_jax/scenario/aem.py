"""CCSDS attitude ephemeris messages (AEM, CCSDS 504.0-B-1 and 504.0-B-2) as text in keyword-value notation.

Start with `read_segment` and `format_message`. The standard's rotation from frame A to frame B converts components,
x_B = M x_A. The quaternion of this package rotates vectors from body to inertial axes. If A is inertial and B is the
body, it equals the quaternion (Q1, Q2, Q3, QC) of the standard.
"""

import datetime as dt
import re
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ptsmc_jax.scenario import epochs
from ptsmc_jax.scenario.epochs import Epoch
from ptsmc_jax.signals import references

VERSIONS = ("1.0", "2.0")
INERTIAL_FRAMES = ("EME2000", "J2000", "GCRF", "ICRF", "MOD", "TOD", "TEME", "MEME", "EMEJ2000")
BODY_FRAMES = re.compile(r"SC_BODY(_\w+)?|SC(_\w+)?|BODY(_\w+)?|.*_BODY(_\w+)?")
UNIVERSAL_TIMES = ("UTC", "UT1")
NUMBERS_PER_LINE = {"QUATERNION": 4, "QUATERNION/DERIVATIVE": 8, "QUATERNION/RATE": 7, "QUATERNION/ANGVEL": 7}
CUBIC_SPLINE_NAMES = re.compile(r"CUBIC_?SPLINE|SPLINE")


@dataclass
class Block:
    """A segment of a message: its keywords and its data lines, each with its line number."""

    keywords: dict[str, tuple[str, int]] = field(default_factory=dict)
    data: list[tuple[str, int]] = field(default_factory=list)

    def get(self, name: str, default: str | None = None) -> str:
        """Return the value of a keyword, converted to capitals. Raise ValueError if it is absent and has no default."""
        if name not in self.keywords and default is None:
            raise ValueError(f"a segment has no {name}, which the standard demands")
        return self.keywords[name][0].upper() if name in self.keywords else str(default)

    @property
    def kind(self) -> str:
        """The attitude type, such as QUATERNION/RATE."""
        return self.get("ATTITUDE_TYPE").replace(" ", "/")

    def error_at(self, name: str, reason: str) -> ValueError:
        """Return the error for the value of a keyword."""
        value, line = self.keywords[name]
        return ValueError(f"line {line}: {name} is {value}, {reason}")


class Segment(NamedTuple):
    """Attitudes of a segment of a message."""

    times: np.ndarray  # (n,) [s], 0 at the start of the run
    quaternions: np.ndarray  # (n, 4) from body to inertial axes, scalar last
    rates: np.ndarray | None  # (n, 3) body rates, body axes [rad/s]
    usable_until: float  # end of the usable time [s]


def read_segment(text: str, start_epoch: Epoch | None = None, *, any_interpolation: bool = False) -> Segment:
    """Return the segment of a message that contains t = 0.

    Args:
        text: the message.
        start_epoch: calendar time of t = 0; None: the first usable time of the first segment.
        any_interpolation: ignore an interpolation method of the message other than a cubic spline.

    Raises:
        ValueError: the message is damaged, or it has content that cannot be a reference. The message of the error names
            line and keyword.
    """
    blocks = _split_segments(text)
    if start_epoch is None:
        block = blocks[0]
    else:
        intervals = [_usable_interval(block) for block in blocks]
        containing = [
            k for k, (begin, end) in enumerate(intervals) if begin.since(start_epoch) <= 0.0 <= end.since(start_epoch)
        ]
        if not containing:
            shown = ", ".join(f"{str(begin)[:19]} to {str(end)[:19]}" for begin, end in intervals)
            raise ValueError(f"no segment contains loop.epoch; the segments are {shown}")
        block = blocks[containing[-1]]  # the later one of two segments with a common boundary
    _check_frames(block)
    _check_interpolation(block, any_interpolation)
    system = block.get("TIME_SYSTEM")
    if start_epoch is not None and system not in UNIVERSAL_TIMES:
        raise block.error_at("TIME_SYSTEM", "but loop.epoch is UTC; allowed is UTC, or no loop.epoch")
    begin, end = _usable_interval(block)
    start_epoch = start_epoch or begin
    times, numbers = _parse_data(block)
    quaternions, rates = _convert_attitudes(block, numbers)
    return Segment(np.array([time.since(start_epoch) for time in times]), quaternions, rates, end.since(start_epoch))


def _split_segments(text: str) -> list[Block]:
    """Return the segments of an attitude ephemeris message, each with its keywords and data lines."""
    lines = [(line.strip(), number) for number, line in enumerate(text.splitlines(), 1)]
    lines = [(line, number) for line, number in lines if line and not line.startswith("COMMENT")]
    first, number = lines[0] if lines else ("", 1)
    if "".join(first.split()) not in [f"CCSDS_AEM_VERS={version}" for version in VERSIONS]:
        raise ValueError(
            f'line {number}: it is "{first[:40]}", but an attitude ephemeris message (AEM) in keyword-value notation '
            f"must begin with CCSDS_AEM_VERS = {' or '.join(VERSIONS)}"
        )
    blocks, in_data = [], False
    for line, number in lines[1:]:
        name, equals, value = (part.strip() for part in line.partition("="))
        if line == "META_START":
            blocks.append(Block())
            in_data = False
        elif line == "META_STOP" and blocks:
            in_data = True
        elif in_data and line not in ("DATA_START", "DATA_STOP"):
            blocks[-1].data.append((line, number))
        elif not in_data and not equals:
            raise ValueError(f'line {number}: it is "{line[:40]}", but must be a keyword, = and its value')
        elif not in_data and blocks:
            blocks[-1].keywords[name] = value, number
    if not in_data:
        raise ValueError("the message has no complete segment from META_START to META_STOP")
    return blocks


def _usable_interval(block: Block) -> list[Epoch]:
    """Return the start and the end of the usable time of a segment."""
    ends = []
    for name in ("START_TIME", "STOP_TIME"):
        name = f"USEABLE_{name}" if f"USEABLE_{name}" in block.keywords else name
        value = block.get(name)
        try:
            ends.append(epochs.parse(value))
        except ValueError as error:
            raise block.error_at(name, str(error)) from None
    return ends


def _check_frames(block: Block) -> None:
    """Raise ValueError if the frames are not an inertial frame and the body."""
    for name, other in (("REF_FRAME_A", "REF_FRAME_B"), ("REF_FRAME_B", "REF_FRAME_A")):
        frame = block.get(name)
        if frame not in INERTIAL_FRAMES and not BODY_FRAMES.fullmatch(frame):
            raise block.error_at(name, "which is neither inertial nor the body; allowed are a frame such as SC_BODY_1 "
                                f"and one of {', '.join(INERTIAL_FRAMES)}")  # fmt: skip
        if (frame in INERTIAL_FRAMES) == (block.get(other) in INERTIAL_FRAMES):
            raise block.error_at(name, f"and {other} is {block.get(other)}; one must be inertial, the other the body")


def _check_interpolation(block: Block, any_interpolation: bool) -> None:
    """Raise ValueError for an interpolation method without continuous rate and acceleration."""
    method = block.get("INTERPOLATION_METHOD", "CUBIC_SPLINE")
    if not CUBIC_SPLINE_NAMES.fullmatch(method) and not any_interpolation:
        raise block.error_at(
            "INTERPOLATION_METHOD", "but a reference needs continuous rate and acceleration, which a cubic spline has; "
            'allowed is CUBIC_SPLINE, or reference.interpolation = "spline" to use that spline in spite of the keyword',
        )  # fmt: skip


def _parse_data(block: Block) -> tuple[list[Epoch], np.ndarray]:
    """Return the epochs and the numbers (n, numbers per line) of the data lines."""
    kind = block.kind
    if kind not in NUMBERS_PER_LINE:
        raise block.error_at("ATTITUDE_TYPE", f"but must be {' or '.join(NUMBERS_PER_LINE)}: only quaternions are read")
    times, rows, count = [], [], NUMBERS_PER_LINE[kind]
    for line, number in block.data:
        time, *cells = line.split()
        try:
            times.append(epochs.parse(time))
        except ValueError as error:
            raise ValueError(f'line {number}: its time is "{time}", {error}') from None
        try:
            row = [float(cell) for cell in cells]
        except ValueError:
            row = []
        if len(row) != count or not np.all(np.isfinite(row)):
            raise ValueError(f'line {number}: it is "{line[:120]}", but must be a time and {count} numbers')
        rows.append(row)
    return times, np.array(rows).reshape(len(rows), count)


def _convert_attitudes(block: Block, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Return quaternions (n, 4) from body to inertial axes, scalar last, and body rates (n, 3) [rad/s] or None."""
    kind = block.kind
    scalar_position = block.get("QUATERNION_TYPE", "LAST")
    if scalar_position not in ("FIRST", "LAST"):
        raise block.error_at("QUATERNION_TYPE", "but must be FIRST or LAST")
    direction = block.get("ATTITUDE_DIR", "A2B").replace(">", "2")
    if direction not in ("A2B", "B2A"):
        raise block.error_at("ATTITUDE_DIR", "but must be A2B or B2A")

    from_inertial = block.get("REF_FRAME_A") in INERTIAL_FRAMES

    def body_to_inertial(values: np.ndarray) -> np.ndarray:
        values = np.roll(values, -1, axis=1) if scalar_position == "FIRST" else values
        return values if from_inertial == (direction == "A2B") else values * references.CONJUGATE

    quaternions, rates = body_to_inertial(numbers[:, :4]), None
    if kind == "QUATERNION/DERIVATIVE":
        rates = references.body_rates(quaternions, body_to_inertial(numbers[:, 4:]))
    elif kind != "QUATERNION":
        rates = np.deg2rad(numbers[:, 4:])
        rates = rates if from_inertial else -rates  # rates in a message are of frame B relative to frame A
        name = "RATE_FRAME" if kind == "QUATERNION/RATE" else "ANGVEL_FRAME"
        frame = block.get(name, "")
        frame = block.get(frame) if frame in ("REF_FRAME_A", "REF_FRAME_B") else frame
        if frame not in (block.get("REF_FRAME_A"), block.get("REF_FRAME_B")):
            raise ValueError(f'a segment has {name} = "{frame}", but must have REF_FRAME_A or REF_FRAME_B')
        if frame in INERTIAL_FRAMES:
            rates = _rotate_to_body(quaternions, rates)
    return quaternions, rates


def _rotate_to_body(quaternions: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return the body components (n, 3) of vectors that are given in inertial axes."""
    unit = quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)
    v, s = -unit[:, :3], unit[:, 3:]
    cross = np.cross(v, vectors)
    return vectors + 2.0 * (s * cross + np.cross(v, cross))


def format_message(name: str, times: np.ndarray, quaternions: np.ndarray, rates: np.ndarray, epoch: str | None) -> str:
    """Return a message (version 1.0) with the attitudes of a spacecraft and their derivatives.

    Derivatives of quaternions are unambiguous. Other programs read the rates of QUATERNION/RATE as derivatives of Euler
    angles, and issue 2 of the standard has removed this attitude type.

    Args:
        name: name of the spacecraft.
        times: (n,) [s].
        quaternions: (n, 4) from body to inertial axes, scalar last.
        rates: (n, 3) body rates, body axes [rad/s].
        epoch: calendar time of t = 0, UTC; None: 2000-01-01T12:00:00, with a comment.
    """
    start_epoch = Epoch(0, 0.0) if epoch is None else epochs.parse_key(epoch)  # the standard has calendar times only
    begin, end = (start_epoch.after(float(times[k])) for k in (0, -1))
    created = dt.datetime.now(dt.UTC).strftime("%Y-%m-%dT%H:%M:%S")
    epoch_comment = ["COMMENT The scenario has no epoch: t = 0 is at 2000-01-01T12:00:00."] if epoch is None else []
    header = [
        "CCSDS_AEM_VERS = 1.0",
        f"CREATION_DATE = {created}",
        "ORIGINATOR = PTSMC-JAX",
        "META_START",
        *epoch_comment,
        "COMMENT Quaternion from body to inertial axes, in the order Q1 Q2 Q3 QC, then its derivative in 1/s.",
        f"OBJECT_NAME = {name}",
        "OBJECT_ID = 0000-000A",
        "CENTER_NAME = EARTH",
        "REF_FRAME_A = EME2000",
        "REF_FRAME_B = SC_BODY_1",
        "ATTITUDE_DIR = A2B",
        "TIME_SYSTEM = UTC",
        f"START_TIME = {begin}",
        f"STOP_TIME = {end}",
        "ATTITUDE_TYPE = QUATERNION/DERIVATIVE",
        "QUATERNION_TYPE = LAST",
        "META_STOP",
        "DATA_START",
    ]
    numbers = np.hstack([quaternions, references.quaternion_rates(quaternions, rates)]).tolist()
    rows = [
        f"{start_epoch.after(float(t))} {' '.join(map(repr, row))}"
        for t, row in zip(times.tolist(), numbers, strict=True)
    ]
    return "\n".join([*header, *rows, "DATA_STOP", ""])
