"""The origin of a traced equation in the source: its function, and the name of its value."""

import ast
import functools
import inspect
import re
import textwrap
from pathlib import Path
from types import CodeType
from typing import Any, NamedTuple

import jax
from jax.extend.core import JaxprEqn

JAX = Path(jax.__file__).parent
WRAPPERS = ("jaxtyping", "beartype", "<")  # parts of file names of wrappers, whose stack frames are ignored
LIBRARY = Path(__file__).parents[1]
HELPER_FOLDERS = ("numerics/", "onboard/")  # folders whose functions get no heading in the C


Span = tuple[int, int, int, int]  # position of an expression: first line and column, last line and column


class Frame(NamedTuple):
    """A frame of the call stack."""

    file: str
    name: str
    span: Span


def stack_frames(eqn: JaxprEqn) -> list[Frame]:
    """Return the stack frames of an equation, the innermost first, without frames of JAX."""
    trace = eqn.source_info.traceback
    code_objects, instructions = ((), ()) if trace is None else trace.raw_frames()
    calls = []
    for code, instruction in zip(code_objects, instructions, strict=True):
        if not _is_foreign(code.co_filename):
            calls.append(Frame(code.co_filename, code.co_qualname, _instruction_spans(code)[instruction // 2]))
    return calls


@functools.cache
def _is_foreign(file: str) -> bool:
    """Return whether a file belongs to JAX or only wraps calls of other functions."""
    return Path(file).is_relative_to(JAX) or any(part in file for part in WRAPPERS)


@functools.cache
def _instruction_spans(code: CodeType) -> list[Span]:
    """Return the position in the source of each instruction of a function, zeros if it is unknown."""
    return [(a or 0, c or 0, b or 0, d or 0) for a, b, c, d in code.co_positions()]


def describe_call(calls: list[Frame]) -> tuple[str, str]:
    """Return function and line of the innermost call for an error, such as "jnp.linalg.solve"; empty if unknown."""
    if not calls:
        return "", ""
    file, _, span = calls[0]
    functions = (
        node.func for node in ast.walk(_syntax_tree(file)) if isinstance(node, ast.Call) and _span(node) == span
    )
    return next(map(ast.unparse, functions), ""), f"{file}:{span[0]}"


def section_heading(calls: list[Frame]) -> str:
    """Return the heading of an equation's section in C: name, file and summary of the function that it is from.

    Functions in `HELPER_FOLDERS` do not count. The heading is empty if all functions are in these folders.
    """
    for frame in calls:
        path = _heading_path(frame.file)
        name = re.sub(r"\.?<(locals|lambda|genexpr|listcomp)>", "", frame.name).strip(".")
        if path and name:
            text = _function_summary(frame.file, frame.span[0])
            return f"{name}, {path}" + (f": {text}" if text else "")
    return ""


@functools.cache
def _heading_path(file: str) -> str:
    """Return the path of a file for a heading; empty if its functions are helpers."""
    path = Path(file)
    if not path.is_relative_to(LIBRARY):
        return path.name
    is_helper = path.relative_to(LIBRARY).as_posix().startswith(HELPER_FOLDERS)
    return "" if is_helper else path.relative_to(LIBRARY.parent).as_posix()


def value_name(calls: list[Frame]) -> str:
    """Return the name of an equation's value in the source; empty if it has none."""
    tuple_index: int | None = None
    for frame in calls:
        names, index = _expression_uses(frame.file).get(frame.span, ((), None))
        if names is None:  # a return statement: the caller may have a name
            tuple_index = tuple_index if index is None else index
            continue
        if index is None:
            index = 0 if len(names) == 1 else tuple_index
        return names[index] if index is not None and index < len(names) else ""
    return ""


@functools.cache
def _syntax_tree(file: str) -> ast.Module:
    """Return the syntax tree of a file, without content if it cannot be read."""
    try:
        return ast.parse(Path(file).read_bytes())
    except (OSError, SyntaxError, ValueError):
        return ast.Module([], [])


@functools.cache
def _expression_uses(file: str) -> dict[Span, tuple[tuple[str, ...] | None, int | None]]:
    """Return the use of each expression by its position: names that it is assigned to, and its index in a tuple.

    The names are None in a return statement.
    """
    uses: dict[Span, tuple[tuple[str, ...] | None, int | None]] = {}
    for node in ast.walk(_syntax_tree(file)):
        if isinstance(node, ast.Call):  # SurfaceGains(c=.., e=..)
            uses |= {_span(keyword.value): ((keyword.arg,), None) for keyword in node.keywords if keyword.arg}
        if isinstance(node, ast.Return) and node.value is not None:
            names = None
        elif isinstance(node, ast.Assign) and len(node.targets) == 1:
            target = node.targets[0]
            targets = target.elts if isinstance(target, ast.Tuple) else [target]
            names = tuple(element.id if isinstance(element, ast.Name) else "" for element in targets)
        else:
            continue
        if not isinstance(node.value, ast.Tuple):
            uses[_span(node.value)] = names, None
        elif names is None or len(names) == len(node.value.elts):
            uses |= {_span(element): (names, k) for k, element in enumerate(node.value.elts)}
    return uses


def _span(node: Any) -> Span:
    """Return the position of a syntax node: first line and column, last line and column."""
    return node.lineno, node.col_offset, node.end_lineno, node.end_col_offset


@functools.cache
def _function_summary(file: str, line_number: int) -> str:
    """Return the first docstring line of the innermost function that contains a line of a source file."""
    functions = (
        node
        for node in ast.walk(_syntax_tree(file))
        if isinstance(node, ast.FunctionDef) and node.lineno <= line_number <= (node.end_lineno or 0)
    )
    innermost = max(functions, key=lambda node: node.lineno, default=None)
    return "" if innermost is None else summary(ast.get_docstring(innermost))


def summary(docstring: str | None) -> str:
    """Return the first paragraph of a docstring in one line."""
    return " ".join((docstring or "").strip().split("\n\n")[0].split())


def class_docstrings(part: object, common_bases: tuple[type, ...]) -> list[tuple[str, str]]:
    """Return (class, docstring) of a part's class and its base classes, up to the common ones."""
    docstrings = []
    for cls in type(part).__mro__:
        if cls in common_bases or cls.__module__ in ("builtins", "abc", "typing"):
            continue
        text = cls.__dict__.get("__doc__")
        if text and not text.startswith(f"{cls.__name__}(") and text not in [known for _, known in docstrings]:
            docstrings.append((cls.__name__, inspect.cleandoc(text)))
    return docstrings


@functools.cache
def field_comments(cls: type) -> dict[str, str]:
    """Return the comment beside each field of a class: meaning and unit."""
    meanings: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        try:
            source = textwrap.dedent(inspect.getsource(base))
        except (OSError, TypeError):
            continue
        lines_above: list[str] = []
        for text in source.splitlines():
            comment_line = re.match(r"\s+#\s?(.*)$", text)
            if comment_line:
                lines_above.append(comment_line[1])
                continue
            field = re.match(r"\s+(\w+)\s*:\s*[^#]*?(?:#\s*(?:pyright:[^#]*#?\s*)?(.*))?$", text)
            meaning = (field and field[2]) or " ".join(lines_above)
            if field and meaning and not text.strip().endswith(":"):
                meanings[field[1]] = meaning.strip()
            lines_above = []
    return meanings
