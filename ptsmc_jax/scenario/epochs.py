"""Calendar times of scenarios and attitude files, in seconds since J2000 (2000-01-01T12:00:00). See `parse`."""

import datetime as dt
import re
from typing import NamedTuple

from ptsmc_jax.scenario.errors import wrong

J2000 = dt.datetime(2000, 1, 1, 12)
ALLOWED = 'a time such as "2026-03-20T12:00:00.5" or "2026-079T12:00:00.5"'
_ISO_TIME = re.compile(r"(\d{4})-(\d{2}-\d{2}|\d{3})T(\d{2}):(\d{2}):(\d{2})(\.\d+)?Z?")


class Epoch(NamedTuple):
    """A time: whole seconds since J2000 and a fraction of a second, so that differences are exact to 1e-16 s."""

    seconds: int
    fraction: float

    def since(self, other: "Epoch") -> float:
        """Return the time from another epoch to this one [s]."""
        return (self.seconds - other.seconds) + (self.fraction - other.fraction)

    @property
    def days(self) -> float:
        """Days since J2000."""
        return (self.seconds + self.fraction) / 86_400.0

    def after(self, seconds: float) -> "Epoch":
        """Return the epoch this many seconds later."""
        whole, fraction = divmod(self.fraction + seconds, 1.0)
        return Epoch(self.seconds + int(whole), fraction)

    def __str__(self) -> str:
        """Return the time as ISO 8601 with 12 decimals of a second."""
        picoseconds = round(self.fraction * 1e12)
        whole = J2000 + dt.timedelta(seconds=self.seconds + picoseconds // 10**12)
        return f"{whole.isoformat()}.{picoseconds % 10**12:012d}"


def parse(text: str) -> Epoch:
    """Return the epoch of an ISO 8601 text with month and day, or with the day of the year.

    Raises:
        ValueError: it is no such text. Leap seconds are not allowed. The message continues the text.
    """
    match = _ISO_TIME.fullmatch(text.strip())
    try:
        if match is None:
            raise ValueError
        year, day, hour, minute, second, fraction = match.groups()
        date_format = "%Y-%m-%d" if "-" in day else "%Y-%j"
        start = dt.datetime.strptime(f"{year}-{day}", date_format)
        time = start + dt.timedelta(hours=int(hour), minutes=int(minute), seconds=int(second))
        if int(hour) > 23 or int(minute) > 59 or int(second) > 59:
            raise ValueError
    except ValueError:
        raise ValueError(f"but must be {ALLOWED}, without leap seconds") from None
    return Epoch(int((time - J2000).total_seconds()), float(fraction or 0.0))


def parse_key(text: str) -> Epoch:
    """Return the epoch of the key `loop.epoch`; raise ScenarioError if it is not valid."""
    try:
        return parse(text)
    except ValueError:
        raise wrong("loop.epoch", text, f"{ALLOWED}, without leap seconds") from None
