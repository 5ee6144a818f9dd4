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
WRAPPERS = ("jaxtyping", "beartype", "<")  # parts of file names of wrappers, whose stack frames are ignored
LIBRARY = Path(__file__).parents[1]
HELPER_FOLDERS = ("numerics/", "onboard/")  # folders whose functions get no heading in the C


class Section(NamedTuple):
    """A Python function whose equations form a section of the generated C, under a heading."""

    name: str
    path: str  # path of its file for a heading
    summary: str  # the first sentence of its docstring


class Frame(NamedTuple):
    """A frame of the call stack."""

    file: str
    name: str
    span: tuple[int, int, int, int]  # position of the expression: first line and column, last line and column


def stack_frames(eqn: Any) -> list[Frame]:
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
    return Path(file).is_relative_to(JAX) or any(part in file for part in WRAPPERS)


@functools.cache
def _instruction_spans(code: Any) -> list[tuple[int, int, int, int]]:
    return [(a or 0, c or 0, b or 0, d or 0) for a, b, c, d in code.co_positions()]


def call_line(calls: list[Frame]) -> str:
    """Return file and line of a call for an error, if possible in the user's code; empty if unknown."""
    frame = _frame_for_error(calls)
    return "" if frame is None else f"{frame.file}:{frame.span[0]}"


def called_function(calls: list[Frame]) -> str:
    """Return the function that the source calls there, such as "jnp.linalg.solve"; empty if it is not a call."""
    frame = _frame_for_error(calls)
    tree = None if frame is None else _syntax_tree(frame.file)
    if frame is None or tree is None:
        return ""
    functions = (node.func for node in ast.walk(tree) if isinstance(node, ast.Call) and _span(node) == frame.span)
    return next(map(ast.unparse, functions), "")


def _frame_for_error(calls: list[Frame]) -> Frame | None:
    """Return the frame that an error names: the innermost frame in the user's code, if the user's code made the call.

    Otherwise it is the innermost frame of the library. The result is None without frames.
    """
    user_frames = [frame for frame in calls if not Path(frame.file).is_relative_to(LIBRARY)]
    # if the user's code only calls the library, the library is the cause
    candidates = user_frames if user_frames and calls[0] in user_frames else calls
    return candidates[0] if candidates else None


def find_section(calls: list[Frame]) -> Section | None:
    """Return the section of an equation: the innermost function that is not in `HELPER_FOLDERS`."""
    for frame in calls:
        path, name = _heading_path(frame.file), _qualified_name(frame.name)
        if path and name:
            return Section(name, path, _function_summary(frame.file, frame.span[0]))
    return None


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
        use = _expression_uses(frame.file).get(frame.span)
        if use is None:
            return ""
        kind, names, index = use
        if kind == "return":
            tuple_index = index if index is not None else tuple_index
            continue
        if index is not None:
            return names[index]
        if len(names) == 1:
            return names[0]
        return names[tuple_index] if tuple_index is not None and tuple_index < len(names) else ""
    return ""


@functools.cache
def _syntax_tree(file: str) -> ast.Module | None:
    try:
        return ast.parse(Path(file).read_bytes())
    except (OSError, SyntaxError, ValueError):
        return None


@functools.cache
def _expression_uses(file: str) -> dict[tuple[int, int, int, int], tuple[str, tuple[str, ...], int | None]]:
    """Return the use of each expression by its position: ("assign" or "return", names, index in a tuple)."""
    uses: dict[tuple[int, int, int, int], tuple[str, tuple[str, ...], int | None]] = {}
    tree = _syntax_tree(file)
    for node in ast.walk(tree) if tree is not None else ():
        if isinstance(node, ast.Call):  # SurfaceGains(c=.., e=..)
            uses |= {_span(keyword.value): ("assign", (keyword.arg,), None) for keyword in node.keywords if keyword.arg}
        if isinstance(node, ast.Return) and node.value is not None:
            kind, names, value = "return", (), node.value
        elif isinstance(node, ast.Assign) and len(node.targets) == 1:
            target, value, kind = node.targets[0], node.value, "assign"
            targets = target.elts if isinstance(target, ast.Tuple) else [target]
            names = tuple(element.id if isinstance(element, ast.Name) else "" for element in targets)
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
def _qualified_name(name: str) -> str:
    return re.sub(r"\.?<(locals|lambda|genexpr|listcomp)>", "", name).strip(".")


@functools.cache
def _function_summary(file: str, line_number: int) -> str:
    tree, innermost = _syntax_tree(file), None
    for node in ast.walk(tree) if tree is not None else ():
        if isinstance(node, ast.FunctionDef) and node.lineno <= line_number <= (node.end_lineno or 0):
            innermost = node if innermost is None or node.lineno >= innermost.lineno else innermost
    text = None if innermost is None else ast.get_docstring(innermost)
    return "" if not text else " ".join(text.split("\n\n")[0].split())


def class_docstrings(part: Any, common_bases: tuple[type, ...]) -> list[tuple[str, str]]:
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
            field = re.match(r"\s+(\w+)\s*:\s*[^#]*?(?:#\s*(.*))?$", text)
            if comment_line:
                lines_above.append(comment_line[1])
                continue
            if field and not text.strip().endswith(":"):
                meaning = field[2] or " ".join(lines_above)
                if meaning:
                    meanings[field[1]] = meaning.strip()
            lines_above = []
    return meanings
