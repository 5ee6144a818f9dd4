"""Configuration errors of scenarios, and the text of values in their messages. Start with `wrong`.

A message is one sentence that names the key, its value and the allowed values.
"""

import json
import re
from collections.abc import Mapping

LONGEST_VALUE = 160  # characters of a value in an error
MOST_BITS = 1023  # largest length of a whole number that can become a finite float


class ScenarioError(ValueError):
    """A configuration error. Its text is one sentence that names the key, the value and the allowed values.

    Attributes:
        key: the key whose value is not allowed, such as "controller.eta"; empty if no single key is wrong.
        value: the value of that key, as read.
        allowed: the allowed values in words; empty if the text does not contain "but must be ..".
    """

    def __init__(self, text: str, *, key: str = "", value: object = None, allowed: str = ""):
        super().__init__(text)
        self.key, self.value, self.allowed = key, value, allowed

    def _render_traceback_(self) -> list[str]:
        """Return the sentence alone: IPython prints it in notebooks instead of a traceback."""
        return [f"ScenarioError: {self}"]


def wrong(key: str, value: object, allowed: str) -> ScenarioError:
    """Return the error for a key whose value is not allowed.

    Args:
        key: the key, such as "controller.eta".
        value: its value.
        allowed: the allowed values, in words.
    """
    return value_error(key, value, f", but must be {allowed}", allowed)


def value_error(key: str, value: object, reason: str, allowed: str = "") -> ScenarioError:
    """Return the error for the value of a key.

    Args:
        key: the key, such as "controller.eta".
        value: its value.
        reason: the text after the value, with the punctuation before it. It ends with the allowed values, if there are
            any.
        allowed: the same allowed values in words, an attribute of the error that is not added to its text.
    """
    return ScenarioError(f"{key} is {brief(value)}{reason}", key=key, value=value, allowed=allowed)


def list_of(count: int, each: str, entry: str = "number") -> str:
    """Return the text of a list of fixed length, such as "a list of 3 numbers, one for each axis".

    Args:
        count: length of the list.
        each: noun for what each entry belongs to, such as "axis".
        entry: noun for an entry.
    """
    if count == 1:
        return f"a list with one {entry}, since there is one {each}"
    return f"a list of {count} {entry}s, one for each {each}"


def brief(value: object) -> str:
    """Return the text of a value for an error message, cut after `LONGEST_VALUE` characters."""
    shown = show(value)
    return shown if len(shown) <= LONGEST_VALUE else f"{shown[:LONGEST_VALUE]} ... ({len(shown)} characters)"


def show_key(key: str) -> str:
    """Return a key as TOML writes it, in quotes if it has characters that a bare key must not have."""
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else json.dumps(key, ensure_ascii=False)


def show(value: object) -> str:
    """Return a value as a scenario file would write it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, float):
        return repr(value)
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(show, value)) + "]"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{show_key(k)} = {show(v)}" for k, v in value.items()) + " }" if value else "{}"
    if isinstance(value, int) and value.bit_length() > MOST_BITS:  # Python refuses to print longer whole numbers
        return f"a whole number of {value.bit_length()} bits"
    return str(value)
