"""Expressions as the body of a C function, with variables and sections named as in the source. Read `Printer` first."""

import math
import re
import textwrap
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from string import Template

from ptsmc_jax.numerics import guards
from ptsmc_jax.onboard.expressions import BOOL, REAL, Block, Node, Region, Title

FILES = Path(__file__).parent / "files"
WIDTH = 110  # characters of a line
MAX_INLINE_LENGTH = 90  # characters of an expression inside another expression
RESERVED = set(
    "auto break case char const continue default do double else enum extern float for goto if inline int long register "
    "restrict return short signed sizeof static struct switch typedef union unsigned void volatile while real R in p d "
    "out before now y0 y1 yn j0 j1 jn gamma main index div abs larger smaller sign_of resolution NAN INFINITY "
    "threefry erf_inv".split()
)
# functions of math.h, which a variable of the same name would hide
MATH_FUNCTIONS = (
    "acos acosh asin asinh atan atan2 atanh cbrt ceil cos cosh erf erfc exp exp2 expm1 fabs floor fmod lgamma log "
    "log1p nextafter pow rint round sin sinh sqrt tan tanh"
)
RESERVED |= {name + end for name in MATH_FUNCTIONS.split() for end in ("", "f")}
INFIX = {"add": ("+", 12), "sub": ("-", 12), "mul": ("*", 13), "div": ("/", 13), "rem": ("%", 13), "lt": ("<", 10),
         "le": ("<=", 10), "gt": (">", 10), "ge": (">=", 10), "eq": ("==", 9), "ne": ("!=", 9), "and": ("&&", 5),
         "or": ("||", 4)}  # fmt: skip
HELPER_NAMES = {"max": "larger", "min": "smaller", "sign": "sign_of"}  # helper functions in C, by operation
C_FUNCTIONS = ("threefry", "erf_inv", "isfinite")  # operations with the names of their functions in C
# integer types: the least and the largest integer in C, and the smallest real number that is too large for the type
INTEGER_TYPES = {"int32_t": ("INT32_MIN", "INT32_MAX", "2147483648"),
                 "int64_t": ("INT64_MIN", "INT64_MAX", "9223372036854775808.0"),
                 "uint32_t": ("0", "UINT32_MAX", "4294967296")}  # fmt: skip
ATOMS = ("constant", "place", "variable", "index", "table")
ATOM, UNARY, CONDITIONAL = 20, 14, 3  # operator precedences in C: no operator, unary operator, ?:


def _suffix(kind: str) -> str:
    """Return the suffix of the C helper functions for a type; empty for reals."""
    return {REAL: "", BOOL: "_int32"}.get(kind, f"_{kind.removesuffix('_t')}")


def _read_helpers() -> dict[str, str]:
    """Return the C helper functions by name; an exported file contains those that it calls."""
    text = [(FILES / "helpers.c").read_text(encoding="utf-8")]
    integers = Template((FILES / "integers.c").read_text(encoding="utf-8"))
    for kind, (low, high, beyond) in INTEGER_TYPES.items():
        sign = "x > 0" if low == "0" else "(x > 0) - (x < 0)"
        values = {"kind": kind, "suffix": _suffix(kind), "sign": sign, "low": low, "high": high, "beyond": beyond}
        text.append(integers.substitute(values))
    functions = "\n".join(text).split("\n\n")
    names = (re.findall(r"^static \w+ (\w+)\(", function, re.MULTILINE)[0] for function in functions)
    return {name: f"{function.rstrip()}\n" for name, function in zip(names, functions, strict=True)}


HELPERS = _read_helpers()


def format_constant(value: float, kind: str) -> str:
    """Return a constant in C."""
    if kind == BOOL:
        return "1" if value else "0"
    if kind != REAL:
        is_least = (kind, value) in (("int32_t", -(2**31)), ("int64_t", -(2**63)))
        return INTEGER_TYPES[kind][0] if is_least else f"{int(value)}{'u' if kind == 'uint32_t' else ''}"
    if not math.isfinite(value):
        return {math.inf: "R(INFINITY)", -math.inf: "R(-INFINITY)"}.get(value, "R(NAN)")
    is_whole = value == int(value) and abs(value) < 1e15 and str(value) != "-0.0"
    short = str(int(value)) if is_whole else repr(value)
    return f"R({short})"


def c_type(kind: str) -> str:
    """Return the C type of a kind of numbers, see `expressions.kind_of`."""
    return {REAL: "real", BOOL: "int"}.get(kind, kind)


class Printer:
    """Prints the statements of one C function."""

    def __init__(self, taken_names: Iterable[str] = ()):
        self.names: dict[Node, str] = {}  # C names of the variables
        self.bases: dict[Title, str] = {}  # first parts of these names
        self.taken_names = RESERVED | set(taken_names)
        self.use_counts: Counter[Node] = Counter()  # number of uses of each node that is needed
        self.with_variable: set[Node] = set()
        self.lengths: dict[Node, int] = {}  # approximate length of the text of each expression
        self.counts: Counter[str] = Counter()
        self.section = ""  # heading of the present section
        self.count = 0
        self.table_entries = 0  # number of entries of the tables that counted loops read
        self.has_open_loop = False  # whether a loop has an unknown number of passes; `counts` has one pass of it

    @property
    def variables(self) -> int:
        """Largest number of variables, including the entries of tables."""
        return len(self.names) + self.table_entries

    def body(self, block: Block, outputs: Sequence[tuple[str, Node]], returned: Node | None = None) -> list[str]:
        """Return the lines of a function body in C.

        Args:
            block: the statements.
            outputs: memory locations to assign, and their values.
            returned: value of the return statement, or None without one.
        """
        self._count_use(*(node for _, node in outputs), *([] if returned is None else [returned]))
        for node in sorted(self.use_counts, key=lambda node: node.serial):
            self.lengths[node] = 8 if node.op in ATOMS else 3 + sum(self.lengths[arg] for arg in node.args)
            is_inline = node.title is None and self.use_counts[node] == 1 and self.lengths[node] <= MAX_INLINE_LENGTH
            if not is_inline and node.op not in (*ATOMS, "region"):
                self.with_variable.add(node)
                self.lengths[node] = 8
        indent = "    "
        lines = self._print_block(block, indent)
        if outputs and self.section:
            lines.append("")
        lines += [line for place, node in outputs for line in wrap_statement(f"{place} = {self.text(node)};", indent)]
        return lines if returned is None else [*lines, *wrap_statement(f"return {self.text(returned)};", indent)]

    def _count_use(self, *nodes: Node) -> None:
        """Count a use of nodes. The first use of a node is a use of its operands."""
        for node in nodes:
            self.use_counts[node] += 1
            if self.use_counts[node] == 1:
                self._count_use(*node.args)
                if node.op == "region":
                    self._count_region_uses(node.value)

    def _count_region_uses(self, region: Region) -> None:
        """Count the uses of nodes in a branch or a loop."""
        self._count_use(*([] if region.test is None else [region.test]), *region.initial)
        for nodes in (*(entries for _, entries in region.tables), *region.outputs):
            self._count_use(*nodes)
        if region.kind != "branch":  # the inputs of a loop are computed before it
            for node in list(self.use_counts):
                for arg in node.args:
                    if node.block in region.blocks and arg.block not in region.blocks:
                        self.use_counts[arg] += 1

    # statements

    def _print_block(self, block: Block, indent: str) -> list[str]:
        """Return the C lines of a block: a constant for each node with a variable, and its regions."""
        lines: list[str] = []
        for node in block.nodes:
            if node not in self.use_counts:
                continue
            if node.op == "region":
                lines += self._section_heading(node, indent)
                statement = self._print_branch if node.value.kind == "branch" else self._print_loop
                lines += statement(node.value, indent)
            elif node in self.with_variable:
                lines += self._section_heading(node, indent)
                text = self.text(node, inside=True)
                lines += wrap_statement(f"const {c_type(node.kind)} {self._variable_name(node)} = {text};", indent)
        return lines

    def _section_heading(self, node: Node, indent: str) -> list[str]:
        """Return the lines of a heading if a node begins another section, otherwise an empty list."""
        if node.section in ("", self.section):
            return []
        self.section = node.section
        return ["", *format_comment(node.section, indent)]

    def _print_branch(self, region: Region, indent: str) -> list[str]:
        """Return the C lines of if and else. They assign the needed results of the region to variables."""
        results = [(k, node) for k, node in enumerate(region.results) if node in self.use_counts]
        lines = [f"{indent}{c_type(node.kind)} {self._variable_name(node)};" for _, node in results]
        assert region.test is not None
        lines += wrap_statement(f"if ({self.text(region.test)}) {{", indent)
        for block, outputs in zip(region.blocks, region.outputs, strict=True):
            outer = self.section
            lines += self._print_block(block, indent + "    ")
            for k, node in results:
                lines += wrap_statement(f"{self._variable_name(node)} = {self.text(outputs[k])};", indent + "    ")
            if block is region.blocks[0]:
                lines.append(f"{indent}}} else {{")
                self.section = outer
        self.section = ""
        return [*lines, f"{indent}}}"]

    def _print_loop(self, region: Region, indent: str) -> list[str]:
        """Return the C lines of a loop: initial values, tables that the body reads or fills, and the body.

        The operations of a counted loop count once for each pass.
        """
        inner, lines = indent + "    ", []
        for node, start, result in zip(region.carried, region.initial, region.results, strict=True):
            node.title, node.indices = result.title, result.indices
            self.names[result] = self._variable_name(node)
            lines += wrap_statement(f"{c_type(node.kind)} {self._variable_name(node)} = {self.text(start)};", indent)
        self.table_entries += sum(len(entries) for _, entries in region.tables) + len(region.rows) * region.length
        for table, entries in region.tables:
            entry_texts = ", ".join(self.text(entry) for entry in entries)
            declared = f"const {c_type(table.kind)} {self._variable_name(table)}[{len(entries)}]"
            lines += wrap_statement(f"{declared} = {{{entry_texts}}};", indent)
        for table, _ in region.rows:
            lines.append(f"{indent}{c_type(table.kind)} {self._variable_name(table)}[{region.length}];")
        if region.kind == "count":
            assert region.index is not None
            k = self._variable_name(region.index)
            lines.append(f"{indent}for (int {k} = 0; {k} < {region.length}; {k}++) {{")
        else:
            self.has_open_loop = True
            lines.append(f"{indent}for (;;) {{")
            lines += self._print_block(region.blocks[0], inner)
            lines += wrap_statement(f"if (!({self.text(region.outputs[0][0])})) {{", inner)
            lines += [f"{inner}    break;", f"{inner}}}"]
        counts_before = Counter(self.counts)
        lines += self._print_block(region.blocks[-1], inner)
        assignments = []
        for node, output in zip(region.carried, region.outputs[-1], strict=False):
            if output is node:
                continue
            next_name = self._unused_name(f"{self._variable_name(node)}_next")
            lines += wrap_statement(f"const {c_type(node.kind)} {next_name} = {self.text(output)};", inner)
            assignments.append(f"{inner}{self._variable_name(node)} = {next_name};")
        for table, column in region.rows:
            k = self._variable_name(region.index) if region.index is not None else ""
            result = self.text(region.outputs[-1][column])
            lines += wrap_statement(f"{self._variable_name(table)}[{k}] = {result};", inner)
        self.section = ""
        for op in self.counts:
            self.counts[op] += (self.counts[op] - counts_before[op]) * max(region.length - 1, 0)
        return [*lines, *assignments, f"{indent}}}"]

    # names

    def _variable_name(self, node: Node) -> str:
        """Return the C name of the variable of a node, always the same one."""
        if node not in self.names:
            if node.title is None:
                prefix = {"index": "k", "table": "table"}.get(node.op, "a")
                self.count += 1
                self.names[node] = self._unused_name(f"{prefix}{self.count}")
            else:
                base = self._base_name(node.title)
                self.names[node] = self._unused_name(f"{base}_{node.indices}" if node.indices else base, allowed=base)
        return self.names[node]

    def _base_name(self, title: Title) -> str:
        """Return the first part of C names for a value's name in the source, without reserved words."""
        if title not in self.bases:
            plain = re.sub(r"\W", "_", title.name).strip("_") or "x"
            self.bases[title] = self._unused_name(f"{plain}_" if plain in RESERVED or plain[0].isdigit() else plain)
        return self.bases[title]

    def _unused_name(self, name: str, allowed: str = "") -> str:
        """Return a C name that is not taken, with a suffix if necessary; allowed: a taken name that may be used."""
        candidate, k = name, ord("b")
        while candidate in self.taken_names and candidate != allowed:
            candidate, k = f"{name}_{chr(k)}" if k <= ord("z") else f"{name}_{k}", k + 1
        self.taken_names.add(candidate)
        return candidate

    # expressions

    def text(self, node: Node, inside: bool = False) -> str:
        """Return the C text of a node: the name of its variable, or its expression if it has none or with `inside`."""
        return self._text_and_precedence(node, inside)[0]

    def _text_and_precedence(self, node: Node, inside: bool = False) -> tuple[str, int]:
        """Return the C text of a node and the precedence of its outermost operator; inside: see `text`."""
        if node.op == "constant":
            # C computes the resolution for its own type `real`, which may be float
            is_resolution = node.kind == REAL and node.value == guards.resolution()
            return "resolution()" if is_resolution else format_constant(node.value, node.kind), ATOM
        if node.op == "place":
            return node.value, ATOM
        if node.op in ATOMS or (node in self.with_variable and not inside):
            return self._variable_name(node), ATOM
        self.counts[node.op] += 1
        if node.op == "add" and node.args[1].op == "neg" and node.args[1] not in self.with_variable:
            return self._infix("-", 12, node.args[0], node.args[1].args[0])
        if node.op in INFIX:
            return self._infix(*INFIX[node.op], *node.args)
        if node.op in ("neg", "not"):
            return ("-" if node.op == "neg" else "!") + self._in_parentheses(node.args[0], UNARY + 1), UNARY
        if node.op == "select":
            test, yes, no = (self._in_parentheses(arg, CONDITIONAL + 1) for arg in node.args)
            if node.kind == "int64_t":  # two small constants would be int
                yes, no = (f"INT64_C({text})" if re.fullmatch(r"-?\d+", text) else text for text in (yes, no))
            return f"{test} ? {yes} : {no}", CONDITIONAL
        if node.op == "convert" and node.args[0].kind == REAL:  # a cast in C must be in the range of its type
            return f"whole{_suffix(node.kind)}({self.text(node.args[0])})", ATOM
        if node.op == "convert":
            return f"({c_type(node.kind)}){self._in_parentheses(node.args[0], UNARY + 1)}", UNARY
        if node.op == "row":  # replaces the first index of a parameter, which is 0
            table, index = node.args
            return table.value.replace("[0]", f"[{self.text(index)}]", 1), ATOM
        if node.op == "entry":
            return f"{self._variable_name(node.args[0])}[{self.text(node.args[1])}]", ATOM
        arguments = ", ".join(self.text(arg) for arg in node.args)
        if node.op in HELPER_NAMES:
            return f"{HELPER_NAMES[node.op]}{_suffix(node.kind)}({arguments})", ATOM
        if node.op in C_FUNCTIONS:
            return f"{node.op}({arguments})", ATOM
        if node.op == "abs" and node.kind != REAL:
            return f"larger{_suffix(node.kind)}({arguments}, -{self._in_parentheses(node.args[0], UNARY + 1)})", ATOM
        return f"M({'fabs' if node.op == 'abs' else node.op})({arguments})", ATOM

    def _infix(self, sign: str, precedence: int, a: Node, b: Node) -> tuple[str, int]:
        """Return "a sign b", with parentheses where C needs them, and the precedence of the sign."""
        # parentheses avoid compiler warnings about mixed && and ||, and about comparisons of comparisons
        other_logical = {"&&": "or", "||": "and"}.get(sign)
        is_comparison = precedence in (9, 10)
        left = self._in_parentheses(a, ATOM if a.op == other_logical else 11 if is_comparison else precedence)
        right = self._in_parentheses(b, ATOM if b.op == other_logical else 11 if is_comparison else precedence + 1)
        return f"{left} {sign} {f'({right})' if right.startswith('-') else right}", precedence

    def _in_parentheses(self, node: Node, lowest: int) -> str:
        """Return the C text of a node, in parentheses if the precedence of its operator is below `lowest`."""
        text, precedence = self._text_and_precedence(node)
        return text if precedence >= lowest else f"({text})"


def wrap_statement(text: str, indent: str) -> list[str]:
    """Return the lines of a statement."""
    return textwrap.wrap(text, WIDTH, initial_indent=indent, subsequent_indent=indent + "    ",
                         break_long_words=False, break_on_hyphens=False)  # fmt: skip


def escape_comment_marks(text: str) -> str:
    """Return the text with /* and */ broken by a space, so that it can be part of a C comment."""
    return text.replace("*/", "* /").replace("/*", "/ *")


def format_comment(text: str, indent: str = "") -> list[str]:
    """Return a C comment, wrapped; a line of the text is a paragraph."""
    lines = [line for paragraph in escape_comment_marks(text).splitlines()
             for line in textwrap.wrap(paragraph, WIDTH - len(indent) - 6, break_long_words=False,
                                       break_on_hyphens=False)]  # fmt: skip
    if len(lines) == 1:
        return [f"{indent}/* {lines[0]} */"]
    return [f"{indent}/* {lines[0]}", *(f"{indent} * {line}" for line in lines[1:]), f"{indent} */"]
