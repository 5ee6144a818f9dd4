"""Expressions as the body of a C function, with variables and sections named as in the source. Read `Printer` first."""

import re
import textwrap
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from string import Template
from typing import Any

from ptsmc_jax.numerics import guards
from ptsmc_jax.onboard.expressions import BOOL, REAL, Block, Node, Region

FILES = Path(__file__).parent / "files"
WIDTH = 110  # characters of a line
LONGEST = 90  # characters of an expression inside another expression
RESERVED = set(
    "auto break case char const continue default do double else enum extern float for goto if inline int long register "
    "restrict return short signed sizeof static struct switch typedef union unsigned void volatile while real R in p d "
    "out before now y0 y1 yn j0 j1 jn gamma main index div abs larger smaller sign_of resolution NAN INFINITY "
    "threefry erf_inv".split()
)
# functions of math.h, which a variable of the same name would hide
MATH = ("acos acosh asin asinh atan atan2 atanh cbrt ceil cos cosh erf erfc exp exp2 expm1 fabs floor fmod lgamma log "
        "log1p nextafter pow rint round sin sinh sqrt tan tanh")  # fmt: skip
RESERVED |= {name + end for name in MATH.split() for end in ("", "f")}
INFIX = {"add": ("+", 12), "sub": ("-", 12), "mul": ("*", 13), "div": ("/", 13), "rem": ("%", 13), "lt": ("<", 10),
         "le": ("<=", 10), "gt": (">", 10), "ge": (">=", 10), "eq": ("==", 9), "ne": ("!=", 9), "and": ("&&", 5),
         "or": ("||", 4)}  # fmt: skip
PLAIN = {"max": "larger", "min": "smaller", "sign": "sign_of"}  # helper functions in C, by operation
CALLED = ("threefry", "erf_inv")  # further helper functions in C, with the names of their operations
# integer types: format of a constant, and the smallest real number that is too large for the type
WHOLE = {"int32_t": ("{}", "2147483648"), "int64_t": ("{}", "9223372036854775808.0"),
         "uint32_t": ("{}u", "4294967296")}  # fmt: skip
ATOMS = ("constant", "place", "variable", "index", "table")
ATOM, UNARY, CHOICE = 20, 14, 3  # operator precedences in C: no operator, unary operator, ?:


def _integer_limits(kind: str) -> tuple[str, str]:
    """Return C's names of the least and the largest integer of a type."""
    name = kind.removesuffix("_t").upper()
    return "0" if kind.startswith("u") else f"{name}_MIN", f"{name}_MAX"


def _suffix(kind: str) -> str:
    """Return the suffix of the C helper functions for a type; empty for reals."""
    return {REAL: "", BOOL: "_int32"}.get(kind, f"_{kind.removesuffix('_t')}")


def _helpers() -> dict[str, str]:
    """Return the C helper functions by name; an exported file contains those that it calls."""
    text = [(FILES / "helpers.c").read_text(encoding="utf-8")]
    integers = Template((FILES / "integers.c").read_text(encoding="utf-8"))
    for kind, (_, beyond) in WHOLE.items():
        low, high = _integer_limits(kind)
        sign = "x > 0" if low == "0" else "(x > 0) - (x < 0)"
        values = {"kind": kind, "suffix": _suffix(kind), "sign": sign, "low": low, "high": high, "beyond": beyond}
        text.append(integers.substitute(values))
    functions = "\n".join(text).split("\n\n")
    return {re.findall(r"^static \w+ (\w+)\(", one, re.MULTILINE)[0]: f"{one.rstrip()}\n" for one in functions}


HELPERS = _helpers()


def number(value: Any, kind: str) -> str:
    """Return a constant in C."""
    if kind == BOOL:
        return "1" if value else "0"
    if kind != REAL:
        least = kind[0] == "i" and value == -(2 ** (int(kind[3:5]) - 1))
        return _integer_limits(kind)[0] if least else WHOLE[kind][0].format(int(value))
    if value != value:
        return "R(NAN)"
    if value in (float("inf"), float("-inf")):
        return "R(INFINITY)" if value > 0 else "R(-INFINITY)"
    whole = value == int(value) and abs(value) < 1e15 and str(value) != "-0.0"
    short = str(int(value)) if whole else repr(value)
    return f"R({short})"


def c_type(kind: str) -> str:
    """Return the C type of a kind of numbers, see `expressions.kind_of`."""
    return {REAL: "real", BOOL: "int"}.get(kind, kind)


class Printer:
    """Prints the statements of one C function."""

    def __init__(self, taken: Iterable[str] = ()):
        self.names: dict[int, str] = {}  # C names of the variables, by id of the node
        self.bases: dict[int, str] = {}  # first parts of these names, by id of the `Title`
        self.taken = RESERVED | set(taken)
        self.uses: Counter[int] = Counter()
        self.nodes: dict[int, Node] = {}
        self.kept: set[int] = set()
        self.lengths: dict[int, int] = {}  # approximate length of the text of each expression
        self.counts: Counter[str] = Counter()
        self.section: Any = None
        self.count = 0
        self.entries = 0  # number of entries of the tables that counted loops read
        self.open = False  # whether a loop has an unknown number of passes; `counts` has one pass of it

    @property
    def variables(self) -> int:
        """Largest number of variables, including the entries of tables."""
        return len(self.names) + self.entries

    def body(self, block: Block, outputs: Sequence[tuple[str, Node]], returned: Node | None = None) -> list[str]:
        """Return the lines of a function body in C.

        Args:
            block: the statements.
            outputs: memory locations to assign, and their values.
            returned: value of the return statement, or None without one.
        """
        for node in [*(node for _, node in outputs), *([] if returned is None else [returned])]:
            self._use(node)
        for node in sorted(self.nodes.values(), key=lambda node: node.serial):
            self.lengths[id(node)] = 8 if node.op in ATOMS else 3 + sum(self.lengths[id(arg)] for arg in node.args)
            if self._alone(node):
                self.kept.add(id(node))
                self.lengths[id(node)] = 8
        indent = "    "
        lines = self._block(block, indent)
        if outputs and self.section is not None:
            lines.append("")
        lines += [line for place, node in outputs for line in wrapped(f"{place} = {self.text(node)};", indent)]
        return lines if returned is None else [*lines, *wrapped(f"return {self.text(returned)};", indent)]

    # nodes that are needed, and nodes that get a variable

    def _use(self, node: Node) -> None:
        first = id(node) not in self.nodes
        self.uses[id(node)] += 1
        self.nodes[id(node)] = node
        if not first:
            return
        for arg in node.args:
            self._use(arg)
        if node.op == "region":
            self._use_region(node.value)

    def _use_region(self, region: Region) -> None:
        if region.test is not None:
            self._use(region.test)
        for node in (*region.initial, *(entry for _, entries in region.tables for entry in entries)):
            self._use(node)
        for outputs in region.outputs:
            for node in outputs:
                self._use(node)
        if region.kind != "branch":  # the inputs of a loop are computed before it
            inside = {id(block) for block in region.blocks}
            for node in list(self.nodes.values()):
                for arg in node.args:
                    if id(node.block) in inside and id(arg.block) not in inside:
                        self.uses[id(arg)] += 1

    def _alone(self, node: Node) -> bool:
        if node.op in ATOMS or node.op == "region":
            return False
        return node.title is not None or self.uses[id(node)] > 1 or self.lengths[id(node)] > LONGEST

    # statements

    def _block(self, block: Block, indent: str) -> list[str]:
        lines: list[str] = []
        for node in block.nodes:
            if id(node) not in self.nodes:
                continue
            if node.op == "region":
                lines += self._heading(node, indent)
                statement = self._branch if node.value.kind == "branch" else self._loop
                lines += statement(node.value, indent)
            elif id(node) in self.kept:
                lines += self._heading(node, indent)
                text = self.text(node, inside=True)
                lines += wrapped(f"const {c_type(node.kind)} {self._name(node)} = {text};", indent)
        return lines

    def _heading(self, node: Node, indent: str) -> list[str]:
        section = node.section
        if section is None or section == self.section:
            return []
        self.section = section
        title = f"{section.name}, {section.place}" + (f": {section.about}" if section.about else "")
        return ["", *comment(title, indent)]

    def _branch(self, region: Region, indent: str) -> list[str]:
        live = [id(node) in self.nodes for node in region.results]
        results = [node for node, on in zip(region.results, live, strict=True) if on]
        lines = [f"{indent}{c_type(node.kind)} {self._name(node)};" for node in results]
        assert region.test is not None
        lines += wrapped(f"if ({self.text(region.test)}) {{", indent)
        for k, (block, outputs) in enumerate(zip(region.blocks, region.outputs, strict=True)):
            if k:
                lines.append(f"{indent}}} else {{")
            outer = self.section
            lines += self._block(block, indent + "    ")
            for node, output, on in zip(region.results, outputs, live, strict=True):
                if on:
                    lines += wrapped(f"{self._name(node)} = {self.text(output)};", indent + "    ")
            self.section = outer if k == 0 else None
        return [*lines, f"{indent}}}"]

    def _loop(self, region: Region, indent: str) -> list[str]:
        inner, lines = indent + "    ", []
        for node, start, result in zip(region.carried, region.initial, region.results, strict=True):
            node.title, node.part = result.title, result.part
            self.names[id(result)] = self._name(node)
            lines += wrapped(f"{c_type(node.kind)} {self._name(node)} = {self.text(start)};", indent)
        self.entries += sum(len(entries) for _, entries in region.tables) + len(region.rows) * region.length
        for table, entries in region.tables:
            listed = ", ".join(self.text(entry) for entry in entries)
            lines += wrapped(f"const {c_type(table.kind)} {self._name(table)}[{len(entries)}] = {{{listed}}};",
                                   indent)  # fmt: skip
        for table, _ in region.rows:
            lines.append(f"{indent}{c_type(table.kind)} {self._name(table)}[{region.length}];")
        if region.kind == "count":
            assert region.index is not None
            k = self._name(region.index)
            lines.append(f"{indent}for (int {k} = 0; {k} < {region.length}; {k}++) {{")
        else:
            self.open = True
            lines.append(f"{indent}for (;;) {{")
            lines += self._block(region.blocks[0], inner)
            lines += wrapped(f"if (!({self.text(region.outputs[0][0])})) {{", inner)
            lines += [f"{inner}    break;", f"{inner}}}"]
        once = Counter(self.counts)
        lines += self._block(region.blocks[-1], inner)
        after = []
        for node, output in zip(region.carried, region.outputs[-1], strict=False):
            if output is node:
                continue
            then = self._fresh(f"{self._name(node)}_next")
            lines += wrapped(f"const {c_type(node.kind)} {then} = {self.text(output)};", inner)
            after.append(f"{inner}{self._name(node)} = {then};")
        for table, which in region.rows:
            k = self._name(region.index) if region.index is not None else ""
            lines += wrapped(f"{self._name(table)}[{k}] = {self.text(region.outputs[-1][which])};", inner)
        self.section = None
        for op in self.counts:
            self.counts[op] += (self.counts[op] - once[op]) * max(region.length - 1, 0)
        return [*lines, *after, f"{indent}}}"]

    # names

    def _name(self, node: Node) -> str:
        if id(node) not in self.names:
            if node.title is None:
                what = {"index": "k", "table": "table"}.get(node.op, "a")
                self.count += 1
                self.names[id(node)] = self._fresh(f"{what}{self.count}")
            else:
                base = self._base(node)
                self.names[id(node)] = self._fresh(f"{base}_{node.part}" if node.part else base, used=base)
        return self.names[id(node)]

    def _base(self, node: Node) -> str:
        assert node.title is not None
        if id(node.title) not in self.bases:
            plain = re.sub(r"\W", "_", node.title.name).strip("_") or "x"
            plain = f"{plain}_" if plain in RESERVED or plain[0].isdigit() else plain
            self.bases[id(node.title)] = self._fresh(plain)
        return self.bases[id(node.title)]

    def _fresh(self, name: str, used: str = "") -> str:
        found, k = name, ord("b")
        while found in self.taken and found != used:
            found, k = f"{name}_{chr(k)}" if k <= ord("z") else f"{name}_{k}", k + 1
        self.taken.add(found)
        return found

    # expressions

    def text(self, node: Node, inside: bool = False) -> str:
        """Return the C text of a node: the name of its variable, or its expression if it has none or with `inside`."""
        return self._text(node, inside)[0]

    def _text(self, node: Node, inside: bool = False) -> tuple[str, int]:
        if node.op == "constant":
            # C computes the resolution for its own type `real`, which may be float
            is_resolution = node.kind == REAL and node.value == guards.resolution()
            return "resolution()" if is_resolution else number(node.value, node.kind), ATOM
        if node.op == "place":
            return node.value, ATOM
        if node.op in ATOMS or (id(node) in self.kept and not inside):
            return self._name(node), ATOM
        self.counts[node.op] += 1
        if node.op == "add" and node.args[1].op == "neg" and id(node.args[1]) not in self.kept:
            return self._infix("-", 12, node.args[0], node.args[1].args[0])
        if node.op in INFIX:
            return self._infix(*INFIX[node.op], *node.args)
        if node.op in ("neg", "not"):
            return ("-" if node.op == "neg" else "!") + self._with_precedence(node.args[0], UNARY + 1), UNARY
        if node.op == "select":
            test, yes, no = (self._with_precedence(arg, CHOICE + 1) for arg in node.args)
            if node.kind == "int64_t":  # two small constants would be int
                yes, no = (f"INT64_C({text})" if re.fullmatch(r"-?\d+", text) else text for text in (yes, no))
            return f"{test} ? {yes} : {no}", CHOICE
        if node.op == "convert" and node.args[0].kind == REAL:  # a cast in C must be in the range of its type
            return f"whole{_suffix(node.kind)}({self.text(node.args[0])})", ATOM
        if node.op == "convert":
            return f"({c_type(node.kind)}){self._with_precedence(node.args[0], UNARY + 1)}", UNARY
        if node.op == "row":  # replaces the first index of a parameter, which is 0
            table, index = node.args
            return table.value.replace("[0]", f"[{self.text(index)}]", 1), ATOM
        if node.op == "entry":
            return f"{self._name(node.args[0])}[{self.text(node.args[1])}]", ATOM
        listed = ", ".join(self.text(arg) for arg in node.args)
        if node.op in PLAIN:
            return f"{PLAIN[node.op]}{_suffix(node.kind)}({listed})", ATOM
        if node.op in CALLED:
            return f"{node.op}({listed})", ATOM
        if node.op == "abs" and node.kind != REAL:
            return f"larger{_suffix(node.kind)}({listed}, -{self._with_precedence(node.args[0], UNARY + 1)})", ATOM
        if node.op == "isfinite":
            return f"isfinite({listed})", ATOM
        return f"M({'fabs' if node.op == 'abs' else node.op})({listed})", ATOM

    def _infix(self, sign: str, level: int, a: Node, b: Node) -> tuple[str, int]:
        # parentheses avoid compiler warnings about mixed && and ||, and about comparisons of comparisons
        mixed = {"&&": "or", "||": "and"}.get(sign)
        compared = level in (9, 10)
        left = self._with_precedence(a, ATOM if a.op == mixed else 11 if compared else level)
        right = self._with_precedence(b, ATOM if b.op == mixed else 11 if compared else level + 1)
        return f"{left} {sign} {f'({right})' if right.startswith('-') else right}", level

    def _with_precedence(self, node: Node, level: int) -> str:
        """Return the C text of a node, in parentheses if the precedence of its operator is below `level`."""
        text, level_of_node = self._text(node)
        return text if level_of_node >= level else f"({text})"


def wrapped(text: str, indent: str) -> list[str]:
    """Return the lines of a statement."""
    return textwrap.wrap(text, WIDTH, initial_indent=indent, subsequent_indent=indent + "    ",
                         break_long_words=False, break_on_hyphens=False)  # fmt: skip


def inside_comment(text: str) -> str:
    """Return the text with /* and */ broken by a space, so that it can be part of a C comment."""
    return text.replace("*/", "* /").replace("/*", "/ *")


def comment(text: str, indent: str = "") -> list[str]:
    """Return a C comment, wrapped; a line of the text is a paragraph."""
    lines = [line for paragraph in inside_comment(text).splitlines()
             for line in textwrap.wrap(paragraph, WIDTH - len(indent) - 6, break_long_words=False,
                                       break_on_hyphens=False)]  # fmt: skip
    if len(lines) == 1:
        return [f"{indent}/* {lines[0]} */"]
    return [f"{indent}/* {lines[0]}", *(f"{indent} * {line}" for line in lines[1:]), f"{indent} */"]
