"""The origin of a traced equation in the source: its function, and the name of its value."""

import ast
import functools
import inspect
import re
import textwrap
from pathlib import Path
from typing import Any, NamedTuple

import jax

JAX = Path(jax.__file__).parent
FOREIGN = ("jaxtyping", "beartype", "<")  # parts of file names of wrappers, whose stack frames are ignored
LIBRARY = Path(__file__).parents[1]
HELPERS = ("numerics/", "onboard/")  # folders whose functions get no heading in the C


class Section(NamedTuple):
    """A function of the source."""

    name: str
    place: str  # path of its file for a heading
    about: str  # the first sentence of its docstring


class Frame(NamedTuple):
    """A frame of the call stack."""

    file: str
    name: str
    span: tuple[int, int, int, int]  # position of the expression: first line and column, last line and column


def frames(eqn: Any) -> list[Frame]:
    """Return the stack frames of an equation, the innermost first, without frames of JAX."""
    trace = eqn.source_info.traceback
    codes, at = ((), ()) if trace is None else trace.raw_frames()
    calls = []
    for code, where in zip(codes, at, strict=True):
        if not _foreign(code.co_filename):
            calls.append(Frame(code.co_filename, code.co_qualname, _spans(code)[where // 2]))
    return calls


@functools.cache
def _foreign(file: str) -> bool:
    return Path(file).is_relative_to(JAX) or any(part in file for part in FOREIGN)


@functools.cache
def _spans(code: Any) -> list[tuple[int, int, int, int]]:
    return [(a or 0, c or 0, b or 0, d or 0) for a, b, c, d in code.co_positions()]


def line(calls: list[Frame]) -> str:
    """Return file and line of a call for an error, if possible in the user's code; empty if unknown."""
    frame = _written(calls)
    return "" if frame is None else f"{frame.file}:{frame.span[0]}"


def function(calls: list[Frame]) -> str:
    """Return the function that the source calls there, such as "jnp.linalg.solve"; empty if it is not a call."""
    frame = _written(calls)
    tree = None if frame is None else _tree(frame.file)
    if frame is None or tree is None:
        return ""
    found = (node.func for node in ast.walk(tree) if isinstance(node, ast.Call) and _span(node) == frame.span)
    return next(map(ast.unparse, found), "")


def _written(calls: list[Frame]) -> Frame | None:
    """Return the frame that an error names: the innermost frame in the user's code, if the user's code made the call.

    Otherwise it is the innermost frame of the library. The result is None without frames.
    """
    users = [frame for frame in calls if not Path(frame.file).is_relative_to(LIBRARY)]
    inside = users if users and calls[0] in users else calls  # a user's call of the library is not the cause
    return inside[0] if inside else None


def section(found: list[Frame]) -> Section | None:
    """Return the section of an equation: the innermost function that is not in `HELPERS`."""
    for frame in found:
        place, name = _place(frame.file), _name(frame.name)
        if place and name:
            return Section(name, place, _about(frame.file, frame.span[0]))
    return None


@functools.cache
def _place(file: str) -> str:
    """Return the path of a file for a heading; empty if its functions are helpers."""
    path = Path(file)
    if not path.is_relative_to(LIBRARY):
        return path.name
    helps = path.relative_to(LIBRARY).as_posix().startswith(HELPERS)
    return "" if helps else path.relative_to(LIBRARY.parent).as_posix()


def title(found: list[Frame]) -> str:
    """Return the name of an equation's value in the source; empty if it has none."""
    which: int | None = None
    for frame in found:
        where = _values(frame.file).get(frame.span)
        if where is None:
            return ""
        kind, names, index = where
        if kind == "return":
            which = index if index is not None else which
            continue
        if index is not None:
            return names[index]
        if len(names) == 1:
            return names[0]
        return names[which] if which is not None and which < len(names) else ""
    return ""


@functools.cache
def _tree(file: str) -> ast.Module | None:
    try:
        return ast.parse(Path(file).read_bytes())
    except (OSError, SyntaxError, ValueError):
        return None


@functools.cache
def _values(file: str) -> dict[tuple[int, int, int, int], tuple[str, tuple[str, ...], int | None]]:
    """Return the use of each expression by its position: ("assign" or "return", names, index in a tuple)."""
    uses: dict[tuple[int, int, int, int], tuple[str, tuple[str, ...], int | None]] = {}
    tree = _tree(file)
    for node in ast.walk(tree) if tree is not None else ():
        if isinstance(node, ast.Call):  # SurfaceGains(c=.., e=..)
            uses |= {_span(word.value): ("assign", (word.arg,), None) for word in node.keywords if word.arg}
        if isinstance(node, ast.Return) and node.value is not None:
            kind, names, value = "return", (), node.value
        elif isinstance(node, ast.Assign) and len(node.targets) == 1:
            target, value, kind = node.targets[0], node.value, "assign"
            several = target.elts if isinstance(target, ast.Tuple) else [target]
            names = tuple(one.id if isinstance(one, ast.Name) else "" for one in several)
        else:
            continue
        if isinstance(value, ast.Tuple):
            for k, element in enumerate(value.elts):
                if kind == "return" or len(names) == len(value.elts):
                    uses[_span(element)] = (kind, names, k)
        else:
            uses[_span(value)] = (kind, names, None)
    return uses


def _span(node: Any) -> tuple[int, int, int, int]:
    return node.lineno, node.col_offset, node.end_lineno, node.end_col_offset


@functools.cache
def _name(name: str) -> str:
    return re.sub(r"\.?<(locals|lambda|genexpr|listcomp)>", "", name).strip(".")


@functools.cache
def _about(file: str, at: int) -> str:
    tree, best = _tree(file), None
    for node in ast.walk(tree) if tree is not None else ():
        if isinstance(node, ast.FunctionDef) and node.lineno <= at <= (node.end_lineno or 0):
            best = node if best is None or node.lineno >= best.lineno else best
    text = None if best is None else ast.get_docstring(best)
    return "" if not text else " ".join(text.split("\n\n")[0].split())


def documents(part: Any, until: tuple[type, ...]) -> list[tuple[str, str]]:
    """Return (class, docstring) of a part's class and its base classes, up to the common ones."""
    texts = []
    for cls in type(part).__mro__:
        if cls in until or cls.__module__ in ("builtins", "abc", "typing"):
            continue
        text = cls.__dict__.get("__doc__")
        if text and not text.startswith(f"{cls.__name__}(") and text not in [known for _, known in texts]:
            texts.append((cls.__name__, inspect.cleandoc(text)))
    return texts


@functools.cache
def comments(cls: type) -> dict[str, str]:
    """Return the comment beside each field of a class: meaning and unit."""
    meanings: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        try:
            source = textwrap.dedent(inspect.getsource(base))
        except (OSError, TypeError):
            continue
        above: list[str] = []
        for text in source.splitlines():
            alone = re.match(r"\s+#\s?(.*)$", text)
            field = re.match(r"\s+(\w+)\s*:\s*[^#]*?(?:#\s*(.*))?$", text)
            if alone:
                above.append(alone[1])
                continue
            if field and not text.strip().endswith(":"):
                meaning = field[2] or " ".join(above)
                if meaning:
                    meanings[field[1]] = meaning.strip()
            above = []
    return meanings
