"""Read and replace values inside nested dataclasses by their path, such as `observer.gain[1]`."""

import re
from dataclasses import replace
from typing import Any

import jax.numpy as jnp


def _split_path(path: str) -> list[str | int]:
    """Return the fields and indices of a path, such as ["observer", "gain", 1] of `observer.gain[1]`."""
    return [int(step) if step.isdecimal() else step for step in re.findall(r"\w+", path)]


def get(tree: Any, path: str) -> Any:
    """Return the value at a path. Raise AttributeError if it does not exist."""
    for step in _split_path(path):
        tree = tree[step] if isinstance(step, int) else getattr(tree, step)
    return tree


def exists(tree: Any, path: str) -> bool:
    """Return whether every field of the path exists. The value at its end may be None."""
    *owners, last = _split_path(path)
    for step in owners:
        tree = getattr(tree, str(step), None)
    return hasattr(tree, str(last))


def put(tree: Any, path: str, value: Any) -> Any:
    """Return a copy of nested dataclasses, named tuples and arrays with another value at a path.

    Args:
        tree: the outermost dataclass, named tuple or array.
        path: fields and indices from the tree to the value.
        value: the new value.
    """
    return _put(tree, _split_path(path), value)


def _put(tree: Any, steps: list[str | int], value: Any) -> Any:
    """Return a copy of a tree with another value at the end of these fields and indices."""
    if not steps:
        return value
    step, *rest = steps
    if isinstance(step, int):
        return jnp.stack([_put(tree[k], rest, value) if k == step else tree[k] for k in range(len(tree))])
    new = {step: _put(getattr(tree, step), rest, value)}
    return tree._replace(**new) if hasattr(tree, "_replace") else replace(tree, **new)
