"""Scalar expressions: the intermediate representation between a jaxpr and C.

A node is an operation on other nodes. `Pool` makes nodes: it reuses equal nodes (common subexpressions), folds
constants, and simplifies x + 0, 1 x and, for finite x, 0 x.
"""

import math
import operator
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np

from ptsmc_jax.scenario.errors import ScenarioError

# operations whose result is finite if their operands are
FINITE_OPERATIONS = ("neg", "abs", "max", "min", "sign", "sin", "cos", "tanh", "atan", "select")
REAL, BOOL = "real", "bool"  # kinds of numbers; the other kinds are C's integer types, such as "int32_t"
# kind of each dtype that C has
KINDS = {"bool": BOOL, "float32": REAL, "float64": REAL, "int32": "int32_t", "int64": "int64_t", "uint32": "uint32_t"}


class NoRuleError(ScenarioError):
    """An operation or a type has no counterpart in C. The message names the operation and its line in the source."""


class Title:
    """The name of a value in the Python source. The nodes of the components of this value share it."""

    def __init__(self, name: str):
        self.name = name


class Node:
    """A scalar: an operation and its operands, a constant, or a place in memory."""

    __slots__ = ("args", "block", "finite", "indices", "kind", "op", "section", "serial", "title", "value")
    created: ClassVar[int] = 0

    def __init__(self, op: str, args: tuple["Node", ...], kind: str, value: Any, block: "Block"):
        """Make a node. Only `Pool` calls this method.

        Args:
            op: name of the operation, or "constant", "place", "variable", "index" or "table".
            args: the operands.
            kind: kind of the value: `REAL`, `BOOL` or an integer type of C.
            value: number of a constant, C expression of a place, or further data of the operation.
            block: block of statements that computes the value.
        """
        Node.created += 1
        self.serial = Node.created  # in the order of creation: operands have smaller numbers
        self.op, self.args, self.kind, self.value, self.block = op, args, kind, value, block
        self.finite = self._is_finite()
        self.title: Title | None = None  # name of the value in the source
        self.indices = ""  # indices of the component within this value
        self.section = ""  # heading of the function of the source that computes the value

    def _is_finite(self) -> bool:
        """Return whether the value is always finite, so that its product with 0 is 0 and not NaN.

        C checks that its inputs and its state are finite. Parameters are finite, because scenarios reject others.
        """
        if self.kind != REAL:
            return True
        if self.op == "constant":
            return math.isfinite(self.value)
        if self.op == "place":
            return not self.value.startswith("d->")  # numbers that C derives from parameters may overflow
        keeps_finite = self.op in FINITE_OPERATIONS or (self.op == "convert" and self.args[0].kind != REAL)
        return keeps_finite and all(arg.finite for arg in self.args)


class Block:
    """Statements in order: the body of a function or a loop, or one side of a branch."""

    def __init__(self, outer: "Block | None" = None):
        self.outer, self.nodes = outer, []
        self.nodes_by_key: dict[tuple, Node] = {}

    def find(self, key: tuple) -> Node | None:
        """Return the node with this key in this block or an enclosing block, or None."""
        return self.nodes_by_key.get(key) or (self.outer.find(key) if self.outer else None)


class Region:
    """A branch or a loop: its blocks and results."""

    def __init__(self, kind: str, test: Node | None = None):
        self.kind, self.test = kind, test  # "branch", "while" or "count"; condition of a branch
        self.blocks: list[Block] = []
        self.outputs: list[list[Node]] = []  # outputs of each block
        self.results: list[Node] = []  # variables that have the outputs after the region
        self.carried: list[Node] = []  # variables of a loop's state
        self.initial: list[Node] = []  # initial values of a loop's state
        self.length = 0  # number of passes of a counted loop
        self.index: Node | None = None  # index of a counted loop
        # C arrays of a counted loop: those that it reads, with their entries; those that it fills, with output index
        self.tables: list[tuple[Node, list[Node]]] = []
        self.rows: list[tuple[Node, int]] = []


# functions that evaluate an operation on constants, by operation
EVALUATORS: dict[str, Callable] = {
    **{name: getattr(operator, name) for name in "add sub mul neg abs lt le gt ge eq ne".split()},
    **{name: getattr(np, name) for name in "floor ceil rint sign".split()},
    **{"max": np.maximum, "min": np.minimum, "and": operator.and_, "or": operator.or_, "not": operator.not_},
    "sqrt": lambda a: math.sqrt(a) if a >= 0.0 else math.nan,
}


def kind_of(dtype: object) -> str:
    """Return the kind of the numbers of a dtype; empty if C does not have it, see `KINDS`."""
    return KINDS.get(str(dtype), "")


def name_nodes(array: np.ndarray, name: str, *, only_variables: bool = False) -> None:
    """Name nodes of an array that have no name, except constants and places.

    Args:
        array: the nodes.
        name: the name of the array.
        only_variables: whether to name only variables of branches and loops.
    """
    title = Title(name)
    for index, node in np.ndenumerate(array):
        is_allowed = node.op == "variable" if only_variables else node.op not in ("constant", "place")
        if node.title is None and is_allowed:
            node.title, node.indices = title, "".join(str(i + 1) for i in index)


class Pool:
    """Creates the nodes of expressions in the current block. Equal expressions in the same scope are one node."""

    def __init__(self) -> None:
        self.block = self.outermost = Block()
        self.section = ""

    def constant(self, value: float, kind: str) -> Node:
        """Return the node of a constant."""
        value = bool(value) if kind == BOOL else float(value) if kind == REAL else int(value)
        # distinguish 0.0 and -0.0, which are equal; find nan, which is not equal to itself
        key = ("constant", kind, math.copysign(1.0, value) if value == 0 else 0, "nan" if value != value else value)
        return self._atom(key, kind, value)

    def place(self, name: str, kind: str) -> Node:
        """Return the node of a place in memory."""
        return self._atom(("place", name), kind, name)

    def _atom(self, key: tuple, kind: str, value: float | str) -> Node:
        """Return the node of a constant or a place, whose operation is the first entry of the key."""
        return self.block.find(key) or self._store(key, Node(key[0], (), kind, value, self.outermost))

    def new_variable(self, kind: str, op: str = "variable") -> Node:
        """Return a new variable, index or table of a loop or a branch.

        Args:
            kind: kind of the number.
            op: "variable", "index" or "table".
        """
        node = Node(op, (), kind, None, self.block)
        node.section = self.section
        return node

    def _store(self, key: tuple, node: Node) -> Node:
        """Record a new node under its key, so that `Block.find` finds it, and return the node."""
        node.block.nodes_by_key[key] = node
        return node

    def make(self, op: str, *args: Node, kind: str = REAL, value: object = None) -> Node:
        """Return the node of an operation; equal operations give the same node.

        Args:
            op: name of the operation.
            *args: operands.
            kind: kind of the result.
            value: further data of the operation, if any.
        """
        simplified = self._simplify(op, args, kind)
        if simplified is not None:
            return simplified
        ordered = sorted(args, key=lambda node: node.serial) if op in ("add", "mul", "and", "or", "eq", "ne") else args
        key = (op, kind, value, *ordered)
        existing = self.block.find(key)
        if existing is not None:
            return existing
        node = Node(op, args, kind, value, self.block)
        node.section = self.section
        self.block.nodes.append(node)
        return self._store(key, node)

    def _simplify(self, op: str, args: Sequence[Node], kind: str) -> Node | None:
        """Return a simpler node that equals the operation, or None."""
        is_constant = [a.op == "constant" for a in args]
        if all(is_constant) and op in EVALUATORS:
            value = EVALUATORS[op](*(a.value for a in args))
            if kind != REAL or math.isfinite(value):
                return self.constant(value, kind)
        if op == "select":
            test, yes, no = args
            if is_constant[0]:
                return yes if test.value else no
            return yes if yes is no else None
        if op in ("lt", "ge") and is_constant[1] and args[0].kind.startswith("u") and args[1].value == 0:
            return self.constant(op == "ge", BOOL)  # compilers warn about comparisons that are always true or false
        if not any(is_constant):
            return args[0].args[0] if op in ("neg", "not") and args[0].op == op else None
        if op in ("add", "sub", "mul", "div") and len(args) == 2:
            return self._simplify_arithmetic(op, args[0], args[1], kind)
        if op in ("and", "or"):
            constant, other = (args[0], args[1]) if is_constant[0] else (args[1], args[0])
            return other if constant.value == (op == "and") else constant
        return None

    def _simplify_arithmetic(self, op: str, a: Node, b: Node, kind: str) -> Node | None:
        """Return a simpler node that equals an operation of a constant and another number, or None."""
        constant, other = (a, b) if a.op == "constant" else (b, a)
        value = constant.value
        if op == "mul":
            if value == 0.5 and other.op == "add" and other.args[0] is other.args[1]:
                return other.args[0]  # half of a + a is exactly a
            if value == 0 and other.finite:
                return self.constant(0, kind)
            if value == -1:
                return self.make("neg", other, kind=kind)
        if op == "sub" and value == 0 and constant is a:
            return self.make("neg", b, kind=kind)
        neutral = {"add": 0, "sub": 0, "mul": 1, "div": 1}[op]
        return other if value == neutral and (op in ("add", "mul") or constant is b) else None
