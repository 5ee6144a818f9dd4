"""CCSDS attitude ephemeris messages (AEM, CCSDS 504.0-B-1 and 504.0-B-2) as text in keyword-value notation.

Start with `segment` and `write`. Frame A to frame B of the standard is a change of components, x_B = M x_A. If A is
inertial and B the body, its quaternion (Q1, Q2, Q3, QC) is that of this package, from body to inertial axes.
"""

import datetime as dt
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from ptsmc_jax.scenario import epochs
from ptsmc_jax.scenario.epochs import Epoch
from ptsmc_jax.signals import attitude_tables

VERSIONS = ("1.0", "2.0")
INERTIAL = ("EME2000", "J2000", "GCRF", "ICRF", "MOD", "TOD", "TEME", "MEME", "EMEJ2000")
BODY = re.compile(r"SC_BODY(_\w+)?|SC(_\w+)?|BODY(_\w+)?|.*_BODY(_\w+)?")
UNIVERSAL = ("UTC", "UT1")
WIDTHS = {"QUATERNION": 4, "QUATERNION/DERIVATIVE": 8, "QUATERNION/RATE": 7, "QUATERNION/ANGVEL": 7}
SPLINES = re.compile(r"CUBIC_?SPLINE|SPLINE")


@dataclass
class Block:
    """A segment of a message: its keywords and its data, with the numbers of their lines."""

    keywords: dict[str, tuple[str, int]] = field(default_factory=dict)
    data: list[tuple[str, int]] = field(default_factory=list)

    def get(self, name: str, default: str | None = None) -> str:
        """Return the value of a keyword in capitals; raise ValueError if it is absent without default."""
        if name not in self.keywords and default is None:
            raise ValueError(f"a segment has no {name}, which the standard demands")
        return self.keywords[name][0].upper() if name in self.keywords else str(default)

    @property
    def kind(self) -> str:
        """The attitude type, such as QUATERNION/RATE."""
        return self.get("ATTITUDE_TYPE").replace(" ", "/")

    def refused(self, name: str, reason: str) -> ValueError:
        """Return the error for the value of a keyword."""
        value, line = self.keywords[name]
        return ValueError(f"line {line}: {name} is {value}, {reason}")


class Segment(NamedTuple):
    """Attitudes of a message."""

    times: np.ndarray  # (n,) [s], 0 at the start of the run
    quaternions: np.ndarray  # (n, 4) from body to inertial axes, scalar last
    rates: np.ndarray | None  # (n, 3) body rates, body axes [rad/s]
    until: float  # end of the usable time [s]


def segment(text: str, zero: Epoch | None = None, *, any_interpolation: bool = False) -> Segment:
    """Return the segment of a message that contains t = 0.

    Args:
        text: the message.
        zero: calendar time of t = 0; None: the first usable time of the first segment.
        any_interpolation: ignore an interpolation method of the message other than a cubic spline.

    Raises:
        ValueError: the message is damaged, or it has content that cannot be a reference. The message of the error names
            line and keyword.
    """
    blocks = list(_blocks(text))
    if zero is None:
        chosen = blocks[0]
    else:
        spans = [_span(block) for block in blocks]
        holding = [k for k, (begin, end) in enumerate(spans) if begin.since(zero) <= 0.0 <= end.since(zero)]
        if not holding:
            listed = ", ".join(f"{str(begin)[:19]} to {str(end)[:19]}" for begin, end in spans)
            raise ValueError(f"no segment contains loop.epoch; the segments are {listed}")
        chosen = blocks[holding[-1]]  # of two segments with a common boundary, the later one
    _check_frames(chosen)
    _check_interpolation(chosen, any_interpolation)
    system = chosen.get("TIME_SYSTEM")
    if zero is not None and system not in UNIVERSAL:
        raise chosen.refused("TIME_SYSTEM", "but loop.epoch is UTC; allowed is UTC, or no loop.epoch")
    begin, end = _span(chosen)
    zero = zero or begin
    times, numbers = _data(chosen)
    quaternions, rates = _attitudes(chosen, numbers)
    return Segment(np.array([one.since(zero) for one in times]), quaternions, rates, end.since(zero))


def _blocks(text: str) -> Iterator[Block]:
    """Yield the segments of a message."""
    block, inside, begun = None, "", False
    for number, line in enumerate(text.splitlines(), 1):
        line = line.strip()
        if not line or line.startswith("COMMENT"):
            continue
        name, equals, value = (part.strip() for part in line.partition("="))
        if not begun:
            if name != "CCSDS_AEM_VERS":
                raise ValueError(f'line {number}: it is "{line[:40]}", but the first keyword of an attitude ephemeris '
                                 "message (AEM) in keyword-value notation must be CCSDS_AEM_VERS")  # fmt: skip
            if value not in VERSIONS:
                raise ValueError(f"line {number}: CCSDS_AEM_VERS is {value}, but must be {' or '.join(VERSIONS)}")
            begun = True
        elif line == "META_START":
            if block is not None:
                yield block
            block, inside = Block(), "META"
        elif line == "META_STOP":
            inside = "DATA"
        elif line in ("DATA_START", "DATA_STOP"):
            if inside != "DATA":
                raise ValueError(f"line {number}: {line} is not after META_STOP")
        elif inside == "DATA":
            assert block is not None
            block.data.append((line, number))
        elif inside == "META" and block is not None and equals:
            block.keywords[name] = value, number
        elif not equals:
            raise ValueError(f'line {number}: it is "{line[:40]}", but must be a keyword, = and its value')
    if block is None or inside != "DATA":
        raise ValueError("the message has no complete segment from META_START to META_STOP")
    yield block


def _epoch(block: Block, name: str) -> Epoch:
    block.get(name)
    value, line = block.keywords[name]
    try:
        return epochs.parse(value)
    except ValueError as error:
        raise ValueError(f"line {line}: {name} is {value}, {error}") from None


def _span(block: Block) -> tuple[Epoch, Epoch]:
    """Return the usable time of a segment."""
    names = [f"USEABLE_{name}" if f"USEABLE_{name}" in block.keywords else name for name in ("START_TIME", "STOP_TIME")]
    begin, end = (_epoch(block, name) for name in names)
    return begin, end


def _check_frames(block: Block) -> None:
    """Raise ValueError if the frames are not an inertial frame and the body."""
    for name, other in (("REF_FRAME_A", "REF_FRAME_B"), ("REF_FRAME_B", "REF_FRAME_A")):
        frame = block.get(name)
        if frame not in INERTIAL and not BODY.fullmatch(frame):
            raise block.refused(name, "which is neither inertial nor the body; allowed are a frame such as SC_BODY_1 "
                                f"and one of {', '.join(INERTIAL)}")  # fmt: skip
        if (frame in INERTIAL) == (block.get(other) in INERTIAL):
            raise block.refused(name, f"and {other} is {block.get(other)}; one must be inertial, the other the body")


def _check_interpolation(block: Block, any_interpolation: bool) -> None:
    """Raise ValueError for an interpolation method without continuous rate and acceleration."""
    method = block.get("INTERPOLATION_METHOD", "CUBIC_SPLINE")
    if not SPLINES.fullmatch(method) and not any_interpolation:
        raise block.refused(
            "INTERPOLATION_METHOD", "but a reference needs continuous rate and acceleration, which a cubic spline has; "
            'allowed is CUBIC_SPLINE, or reference.interpolation = "spline" to use that spline in spite of the keyword',
        )  # fmt: skip


def _data(block: Block) -> tuple[list[Epoch], np.ndarray]:
    """Return the epochs and the numbers (n, width) of the data lines."""
    kind = block.kind
    if kind not in WIDTHS:
        raise block.refused("ATTITUDE_TYPE", f"but must be {' or '.join(WIDTHS)}: only quaternions are read")
    times, rows = [], []
    for line, number in block.data:
        first, *cells = line.split()
        try:
            times.append(epochs.parse(first))
        except ValueError as error:
            raise ValueError(f'line {number}: its time is "{first}", {error}') from None
        if len(cells) != WIDTHS[kind]:
            raise ValueError(f"line {number}: it has {len(cells)} numbers, but {kind} has {WIDTHS[kind]}")
        row = [_number(cell) for cell in cells]
        if not np.all(np.isfinite(row)):
            bad = cells[int(np.argmin(np.isfinite(row)))]
            raise ValueError(f'line {number}, column {cells.index(bad) + 2}: it is "{bad}", but must be a number')
        rows.append(row)
    return times, np.array(rows).reshape(len(rows), WIDTHS[kind])


def _number(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return np.nan


def _attitudes(block: Block, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Return quaternions (n, 4) from body to inertial axes, scalar last, and body rates (n, 3) [rad/s] or None."""
    kind = block.kind
    place = block.get("QUATERNION_TYPE", "LAST")
    if place not in ("FIRST", "LAST"):
        raise block.refused("QUATERNION_TYPE", "but must be FIRST or LAST")
    way = block.get("ATTITUDE_DIR", "A2B").replace(">", "2")
    if way not in ("A2B", "B2A"):
        raise block.refused("ATTITUDE_DIR", "but must be A2B or B2A")

    inertial_first = block.get("REF_FRAME_A") in INERTIAL

    def body_to_inertial(values: np.ndarray) -> np.ndarray:
        values = np.roll(values, -1, axis=1) if place == "FIRST" else values
        return values if inertial_first == (way == "A2B") else values * attitude_tables.CONJUGATE

    quaternions, rates = body_to_inertial(numbers[:, :4]), None
    if kind == "QUATERNION/DERIVATIVE":
        rates = attitude_tables.body_rates(quaternions, body_to_inertial(numbers[:, 4:]))
    elif kind != "QUATERNION":
        rates = np.deg2rad(numbers[:, 4:])
        rates = rates if inertial_first else -rates  # rates in a message are of frame B relative to frame A
        name = "RATE_FRAME" if kind == "QUATERNION/RATE" else "ANGVEL_FRAME"
        frame = block.get(name, "")
        frame = block.get(frame) if frame in ("REF_FRAME_A", "REF_FRAME_B") else frame
        if frame not in (block.get("REF_FRAME_A"), block.get("REF_FRAME_B")):
            raise ValueError(f'a segment has {name} = "{frame}", but must have REF_FRAME_A or REF_FRAME_B')
        if frame in INERTIAL:
            rates = _to_body(quaternions, rates)
    return quaternions, rates


def _to_body(q: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return vectors (n, 3) in body axes, given in inertial axes."""
    unit = q / np.linalg.norm(q, axis=1, keepdims=True)
    v, s = -unit[:, :3], unit[:, 3:]
    turned = np.cross(v, y)
    return y + 2.0 * (s * turned + np.cross(v, turned))


def write(name: str, times: np.ndarray, quaternions: np.ndarray, rates: np.ndarray, epoch: str | None) -> str:
    """Return a message (version 1.0) with attitudes and rates of a spacecraft.

    Args:
        name: of the spacecraft.
        times: (n,) [s].
        quaternions: (n, 4) from body to inertial axes, scalar last.
        rates: (n, 3) body rates, body axes [rad/s].
        epoch: calendar time of t = 0, UTC; None: 2000-01-01T12:00:00, with a comment.
    """
    zero = Epoch(0, 0.0) if epoch is None else epochs.of_key(epoch)  # the standard has calendar times only
    begin, end = (zero.after(float(times[k])) for k in (0, -1))
    created = dt.datetime.now(dt.UTC).strftime("%Y-%m-%dT%H:%M:%S")
    unknown = ["COMMENT The scenario has no epoch: t = 0 is at 2000-01-01T12:00:00."] if epoch is None else []
    head = [
        "CCSDS_AEM_VERS = 1.0",
        f"CREATION_DATE = {created}",
        "ORIGINATOR = PTSMC-JAX",
        "META_START",
        *unknown,
        "COMMENT Quaternion from body to inertial axes, in the order Q1 Q2 Q3 QC, then body rates in deg/s.",
        f"OBJECT_NAME = {name}",
        "OBJECT_ID = 0000-000A",
        "CENTER_NAME = EARTH",
        "REF_FRAME_A = EME2000",
        "REF_FRAME_B = SC_BODY_1",
        "ATTITUDE_DIR = A2B",
        "TIME_SYSTEM = UTC",
        f"START_TIME = {begin}",
        f"STOP_TIME = {end}",
        "ATTITUDE_TYPE = QUATERNION/RATE",
        "QUATERNION_TYPE = LAST",
        "RATE_FRAME = REF_FRAME_B",
        "META_STOP",
        "DATA_START",
    ]
    numbers = np.column_stack([quaternions, np.rad2deg(rates)]).tolist()
    rows = [
        f"{zero.after(float(t))} {' '.join(map(repr, row))}" for t, row in zip(times.tolist(), numbers, strict=True)
    ]
    return "\n".join([*head, *rows, "DATA_STOP", ""])
