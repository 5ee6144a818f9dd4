"""Numbers with a unit, such as "0.3 deg/h". Start with `to_number`.

A unit consists of symbols with powers and square roots, separated by spaces or "/":
"kg cm^2", "deg/s/sqrt(Hz)", "rad s^-1".
"""

import decimal
import functools
import re
from collections.abc import Mapping
from decimal import Decimal

_DECIMAL = decimal.Context(prec=30, traps=[])  # an overflow or a division by zero gives infinity
_TURN = Decimal("6.28318530717958647692528676656")  # 2 pi
_KG, _M, _S, _RAD = {"kg": 1.0}, {"m": 1.0}, {"s": 1.0}, {"rad": 1.0}
_RATE = {"rad": 1.0, "s": -1.0}

PREFIXES = {"n": "1e-9", "u": "1e-6", "m": "1e-3", "c": "1e-2", "k": "1e3"}
# symbols that may have one of these prefixes: value in SI units, and powers of the base units
WITH_PREFIX: dict[str, tuple[Decimal | int, Mapping[str, float]]] = {
    "rad": (1, _RAD),
    "deg": (_TURN / 360, _RAD),
    "arcsec": (_TURN / 1_296_000, _RAD),
    "Hz": (_TURN, _RATE),
    "s": (1, _S),
    "sec": (1, _S),
    "m": (1, _M),
    "g": (Decimal("1e-3"), _KG),
    "N": (1, {"kg": 1.0, "m": 1.0, "s": -2.0}),
    "Nm": (1, {"kg": 1.0, "m": 2.0, "s": -2.0}),
    "Nms": (1, {"kg": 1.0, "m": 2.0, "s": -1.0}),
}
WITHOUT_PREFIX: dict[str, tuple[Decimal | int, Mapping[str, float]]] = {
    "arcmin": (_TURN / 21_600, _RAD),
    "mas": (_TURN / 1_296_000_000, _RAD),
    "rev": (_TURN, _RAD),
    "rpm": (_TURN / 60, _RATE),
    "min": (60, _S),
    "h": (3600, _S),
    "hr": (3600, _S),
    "day": (86_400, _S),
    "lb": (Decimal("0.45359237"), _KG),
    "in": (Decimal("0.0254"), _M),
    "ft": (Decimal("0.3048"), _M),
    "dB": (1, {"dB": 1.0}),
}
_SPELLINGS = str.maketrans(
    {"°": "deg", "\u00b5": "u", "\u03bc": "u", "·": " ", "*": " ", "⁻": "-", "¹": "1", "²": "2", "³": "3"}
)

# usual numbers in usual units, by the unit of a key
EXAMPLES = {
    "rad": '"10 arcsec" or "0.5 deg"',
    "rad/s": '"0.3 deg/h", "2 deg/s" or "1.5 Hz"',
    "rad/s/sqrt(Hz)": '"0.02 deg/sqrt(h)" or "0.1 arcsec/s/sqrt(Hz)"',
    "rad/s/sqrt(s)": '"0.1 deg/h/sqrt(h)"',
    "N m": '"5 mN m"',
    "N m s": '"20 mN m s"',
    "N m/s": '"1 mN m/s"',
    "N m/sqrt(s)": '"1 uN m/sqrt(s)"',
    "s": '"200 ms" or "2 min"',
    "1/s": '"0.5 1/s"',
    "1/s^2": '"0.2 1/s^2"',
    "1/s^3": '"0.01 1/s^3"',
    "m": '"500 km"',
    "m^3/s^2": '"398600.44 km^3/s^2"',
    "kg m^2": '"350 kg cm^2"',
    "sqrt(kg) m": '"0.8 sqrt(kg) m"',
    "deg": '"30 deg"',
    "dB": '"6 dB"',
}


def to_number(text: str, unit: str) -> float:
    """Return the number of a text in a unit; raise ValueError if it is no number or has a unit that does not fit.

    >>> to_number("20 ms", "s"), to_number("0.02", "s")
    (0.02, 0.02)
    """
    number = convert(*split(text), unit)
    return float(text) if number is None else number


def split(text: str) -> tuple[str, str]:
    """Return the number and the unit of a text such as "0.05 deg"; both are empty for other texts."""
    joined = " ".join(text.split())
    match = re.fullmatch(r"([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?) ?(.*)", joined)
    return (match[1], match[2]) if match else ("", "")


@functools.lru_cache(maxsize=256)
def parse(text: str) -> tuple[Decimal, dict[str, float]] | None:
    """Return the value of a unit in SI units and its powers of the base units, or None if it is not a known unit.

    >>> parse("mN m")
    (Decimal('0.001'), {'kg': 1.0, 'm': 2.0, 's': -2.0})
    """
    raised = re.sub("([⁻¹²³]+)", r"^\1", text).translate(_SPELLINGS)
    text = re.sub(r"√\(?(\w+)\)?", r"sqrt(\1)", re.sub(r"(?<!\^)-", " ", raised))  # "N-m" is "N m"
    value, total = Decimal(1), dict[str, float]()
    for k, part in enumerate(text.split("/")):
        factors = part.split()
        if not factors:
            return None
        for factor in factors if k or factors != ["1"] else []:
            found = _parse_factor(factor)
            if found is None:
                return None
            one, powers = found
            value = _DECIMAL.divide(value, one) if k else _DECIMAL.multiply(value, one)
            for base, power in powers.items():
                total[base] = total.get(base, 0.0) + (-power if k else power)
    return value, {base: power for base, power in total.items() if power}


def in_si(unit: str) -> float:
    """Return the value of a unit in SI units."""
    found = parse(unit)
    if found is None:
        raise ValueError(f"{unit} is not a known unit")
    return float(found[0])


def _parse_factor(factor: str) -> tuple[Decimal, dict[str, float]] | None:
    """Return value and powers of a symbol with its prefix, its power or a square root; None if it is not known."""
    match = re.fullmatch(r"(sqrt\()?([A-Za-z]+)(?(1)\)|(?:\^(-?\d(?:\.5)?))?)", factor)
    if match is None:
        return None
    name, scale, exponent = match[2], Decimal(1), Decimal("0.5" if match[1] else match[3] or 1)
    if match[1] and name == "Hz":  # a noise density refers to cycles per second, without the 2 pi
        return scale, {"s": -0.5}
    known = WITHOUT_PREFIX.get(name) or WITH_PREFIX.get(name)
    if known is None and name[0] in PREFIXES:
        known, scale = WITH_PREFIX.get(name[1:]), Decimal(PREFIXES[name[0]])
    if known is None:
        return None
    value, powers = known
    return _DECIMAL.power(scale * value, exponent), {base: power * float(exponent) for base, power in powers.items()}


def convert(number: str, text: str, unit: str, *, inverse: bool = False) -> float | None:
    """Return a number in another unit, as the nearest double, or None if the units do not fit or are not known.

    Args:
        number: decimal digits; "20" and "uN m" give 2e-5, while 20 * 1e-6 is not the nearest double.
        text: unit of the number.
        unit: unit of the result.
        inverse: allow the frequency of a period, and the period of a frequency.

    >>> convert("2.5", "deg/h", "rad/s"), convert("2.5", "Hz", "s", inverse=True), convert("2.5", "Hz", "s")
    (1.21203420277384e-05, 0.4, None)
    """
    found, wanted = parse(text), parse(unit)
    if found is None or wanted is None:
        return None
    value = _DECIMAL.multiply(_DECIMAL.create_decimal(number), found[0])
    if found[1] == wanted[1]:
        return float(_DECIMAL.divide(value, wanted[0]))
    if inverse and [_RATE, _S] in ([found[1], wanted[1]], [wanted[1], found[1]]):
        return float(_DECIMAL.divide(_TURN, _DECIMAL.multiply(value, wanted[0])))
    return None
