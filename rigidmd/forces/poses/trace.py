"""Slopes of a function of numbers, by calling it once with numbers that record what is done.

A function of NumPy arrays is called with arrays of `Traced` numbers. Each is a node of the graph of
the computation. Slopes follow from the graph by reverse differentiation, as further nodes, and
`code_of` writes nodes as lines of Python, which are compiled. Equal nodes are one, and parts that
are constant are computed here.
"""

import math
from collections.abc import Callable, Container, Sequence
from typing import Any

import numpy as np

#: Largest number of nodes of a function with its slopes; a Gay-Berne potential has 250.
MOST_NODES = 20_000


class TraceError(ValueError):
    """A function whose slopes cannot be derived, and why."""


class Graph:
    """The nodes of one function: each node once."""

    def __init__(self):
        self._nodes: dict[tuple, Traced] = {}

    def leaf(self, name: str) -> "Traced":
        """A number that is known when the code runs."""
        return self._node("leaf", (name,))

    def constant(self, value: float) -> "Traced":
        return self._node("constant", (float(value),))

    def node(self, kind: str, *parts: "Traced") -> "Traced":
        """A function of other nodes, simplified."""
        numbers = [part.number for part in parts]
        if all(number is not None for number in numbers):
            return self.constant(_computed(kind, numbers))
        short = _SIMPLER[kind](self, *parts) if kind in _SIMPLER else None
        return self._node(kind, parts) if short is None else short

    def power(self, base: "Traced", exponent: float) -> "Traced":
        if base.number is not None:
            return self.constant(_computed("power", [base.number, exponent]))
        if exponent in (0.0, 1.0):
            return base if exponent else self.constant(1.0)
        if exponent == 0.5:
            return self.node("sqrt", base)
        return self._node("power", (base, exponent))

    def _node(self, kind: str, parts: tuple) -> "Traced":
        key = (kind, *(id(part) if isinstance(part, Traced) else part for part in parts))
        if key not in self._nodes:
            if len(self._nodes) >= MOST_NODES:
                raise TraceError(f"it has more than {MOST_NODES} operations with its slopes")
            self._nodes[key] = Traced(self, kind, parts, len(self._nodes))
        return self._nodes[key]


def _operators(kind: str) -> tuple[Callable, Callable]:
    """The methods of an operator, with the node as the first and as the second operand. NumPy
    applies them to the entries of arrays."""

    def first(self: "Traced", other: Any):
        if isinstance(other, np.ndarray):
            return NotImplemented
        return self.graph.node(kind, self, self._other(other))

    def second(self: "Traced", other: Any):
        if isinstance(other, np.ndarray):
            return NotImplemented
        return self.graph.node(kind, self._other(other), self)

    return first, second


class Traced:
    """A node: a number, or a condition, of a traced function."""

    def __init__(self, graph: Graph, kind: str, parts: tuple, index: int):
        self.graph, self.kind, self.parts, self.index = graph, kind, parts, index

    @property
    def number(self) -> float | None:
        """Its value, if that is constant."""
        return self.parts[0] if self.kind == "constant" else None

    @property
    def inner(self) -> list["Traced"]:
        """The nodes of which it is a function."""
        return [part for part in self.parts if isinstance(part, Traced)]

    def _other(self, value: Any) -> "Traced":
        if isinstance(value, Traced):
            return value
        return self.graph.constant(float(value))

    __add__, __radd__ = _operators("add")
    __sub__, __rsub__ = _operators("subtract")
    __mul__, __rmul__ = _operators("multiply")
    __truediv__, __rtruediv__ = _operators("divide")

    def __neg__(self):
        return self.graph.node("negative", self)

    def __pos__(self):
        return self

    def __abs__(self):
        return self.absolute()

    def __pow__(self, exponent: Any):
        if isinstance(exponent, np.ndarray):
            return NotImplemented
        known = self._other(exponent)
        if known.number is None:
            return (known * self.log()).exp()
        return self.graph.power(self, known.number)

    def __rpow__(self, base: Any):
        return self._other(base) ** self

    __lt__, __gt__ = _operators("less")
    __le__, __ge__ = __lt__, __gt__

    def __bool__(self):
        raise TraceError(
            "it branches on a value that changes: use numpy.where(condition, x, y), or return the"
            " force and the torques with the energy"
        )

    def __float__(self):
        raise TraceError(
            "it needs the value of a number that changes: use the functions of NumPy, as in"
            " numpy.exp, not those of math"
        )

    # functions of NumPy, which it finds by these names for arrays of objects

    def sqrt(self):
        return self.graph.node("sqrt", self)

    def exp(self):
        return self.graph.node("exp", self)

    def log(self):
        return self.graph.node("log", self)

    def sin(self):
        return self.graph.node("sin", self)

    def cos(self):
        return self.graph.node("cos", self)

    def tanh(self):
        return self.graph.node("tanh", self)

    def arccos(self):
        return self.graph.node("acos", self)

    def absolute(self):
        return self.graph.node("fabs", self)

    def square(self):
        return self * self

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any):
        """Functions of NumPy of single numbers and of arrays."""
        if method != "__call__" or options:
            return NotImplemented
        if any(isinstance(value, np.ndarray) for value in inputs):
            arrays = [_as_objects(value) for value in inputs]
            return _each(lambda *values: ufunc(*values), *arrays)
        name = ufunc.__name__
        if name in _OPERATORS:
            return _OPERATORS[name](*map(self._other, inputs))
        if name in ("maximum", "minimum"):
            first, second = map(self._other, inputs)
            is_less = first < second
            if name == "maximum":
                return _where(is_less, second, first)
            return _where(is_less, first, second)
        if hasattr(self, name) and len(inputs) == 1:
            return getattr(self, name)()
        raise TraceError(f"numpy.{name} has no slope here: use {', '.join(FUNCTIONS)}")

    def __array_function__(self, function: Any, kinds: Any, arguments: Any, options: Any):
        if function is np.where and len(arguments) == 3:
            return _where(*arguments)
        return NotImplemented


def _as_objects(value: Any) -> np.ndarray:
    array = np.empty((), object)
    if isinstance(value, np.ndarray):
        return value.astype(object)
    array[()] = value
    return array


def _each(function: Callable, *arrays: np.ndarray) -> np.ndarray:
    spread = np.broadcast_arrays(*arrays)
    result = np.empty(spread[0].shape, object)
    for at in np.ndindex(*result.shape):
        result[at] = function(*(array[at] for array in spread))
    return result


def _where(condition: Any, yes: Any, no: Any) -> Any:
    """`yes` or `no`; both are computed."""
    if not isinstance(condition, Traced):
        return yes if condition else no
    yes, no = condition._other(yes), condition._other(no)
    if condition.number is not None:
        return yes if condition.number else no
    return condition.graph.node("where", condition, yes, no)


#: Functions of NumPy with slopes.
FUNCTIONS = (
    "sqrt",
    "exp",
    "log",
    "sin",
    "cos",
    "tanh",
    "arccos",
    "abs",
    "minimum",
    "maximum",
    "where",
)
_OPERATORS: dict[str, Callable] = {
    "add": lambda x, y: x + y,
    "subtract": lambda x, y: x - y,
    "multiply": lambda x, y: x * y,
    "divide": lambda x, y: x / y,
    "power": lambda x, y: x**y,
    "float_power": lambda x, y: x**y,
    "less": lambda x, y: x < y,
    "less_equal": lambda x, y: x < y,
    "greater": lambda x, y: x > y,
    "greater_equal": lambda x, y: x > y,
}
#: Kind of a node -> its code, and its value.
_CODE = {
    "add": "({} + {})",
    "subtract": "({} - {})",
    "multiply": "({} * {})",
    "divide": "({} / {})",
    "negative": "(-{})",
    "less": "({} < {})",
    "where": "({1} if {0} else {2})",
}
_VALUES: dict[str, Callable] = {
    "add": lambda x, y: x + y,
    "subtract": lambda x, y: x - y,
    "multiply": lambda x, y: x * y,
    "divide": lambda x, y: x / y,
    "negative": lambda x: -x,
    "power": lambda x, y: x**y,
    "less": lambda x, y: float(x < y),
    "where": lambda condition, x, y: x if condition else y,
}


def _computed(kind: str, numbers: Sequence[Any]) -> float:
    try:
        value = (_VALUES[kind] if kind in _VALUES else getattr(math, kind))(*numbers)
    except (ArithmeticError, ValueError):
        value = math.nan
    if isinstance(value, complex) or not math.isfinite(value):
        raise TraceError(f"{kind} of {', '.join(f'{x:g}' for x in numbers)} is not a finite number")
    return float(value)


def _simpler_sum(graph: Graph, x: Traced, y: Traced) -> Traced | None:
    if x.number == 0:
        return y
    if y.number == 0:
        return x
    return x - y.parts[0] if y.kind == "negative" else None


def _simpler_difference(graph: Graph, x: Traced, y: Traced) -> Traced | None:
    if y.number == 0:
        return x
    if x.number == 0:
        return -y
    if x is y:
        return graph.constant(0.0)
    return x + y.parts[0] if y.kind == "negative" else None


def _simpler_product(graph: Graph, x: Traced, y: Traced) -> Traced | None:
    for one, other in ((x, y), (y, x)):
        if one.number == 0:
            return one
        if one.number == 1:
            return other
        if one.number == -1:
            return -other
        if one.kind == "negative":
            return -(one.parts[0] * other)
    return None


def _simpler_quotient(graph: Graph, x: Traced, y: Traced) -> Traced | None:
    if x.number == 0 or y.number == 1:
        return x
    if y.number is not None:
        return x * _computed("divide", [1.0, y.number])
    return -(x.parts[0] / y) if x.kind == "negative" else None


_SIMPLER: dict[str, Callable] = {
    "add": _simpler_sum,
    "subtract": _simpler_difference,
    "multiply": _simpler_product,
    "divide": _simpler_quotient,
    "negative": lambda graph, x: x.parts[0] if x.kind == "negative" else None,
}
#: Kind of a node -> its slopes by its parts: a function of the node and of the parts.
_SLOPES: dict[str, Callable] = {
    "add": lambda node, x, y: (1.0, 1.0),
    "subtract": lambda node, x, y: (1.0, -1.0),
    "multiply": lambda node, x, y: (y, x),
    "divide": lambda node, x, y: (1 / y, -node / y),
    "negative": lambda node, x: (-1.0,),
    "sqrt": lambda node, x: (0.5 / node,),
    "exp": lambda node, x: (node,),
    "log": lambda node, x: (1 / x,),
    "sin": lambda node, x: (x.cos(),),
    "cos": lambda node, x: (-x.sin(),),
    "tanh": lambda node, x: (1 - node * node,),
    "acos": lambda node, x: (-1 / (1 - x * x).sqrt(),),
    "fabs": lambda node, x: (_where(x < 0.0, -1.0, 1.0),),
    "power": lambda node, x: (node.parts[1] * x ** (node.parts[1] - 1),),
    "less": lambda node, x, y: (0.0, 0.0),
}


def slopes_of(output: Traced, leaves: Sequence[Traced]) -> list[Any]:
    """The slopes of a node by leaves; 0.0 by one on which it does not depend."""
    slope: dict[int, Any] = {output.index: 1.0}
    for node in reversed(_in_order([output])):
        above = slope.get(node.index, 0.0)
        if not node.inner or (isinstance(above, float) and above == 0):
            continue
        if node.kind == "where":
            condition, yes, no = node.parts
            terms = [(yes, _where(condition, above, 0.0)), (no, _where(condition, 0.0, above))]
        else:
            factors = _SLOPES[node.kind](node, *node.inner)
            terms = [
                (part, above * factor) for part, factor in zip(node.inner, factors, strict=True)
            ]
        for part, term in terms:
            slope[part.index] = slope.get(part.index, 0.0) + term
    return [slope.get(leaf.index, 0.0) for leaf in leaves]


def _in_order(outputs: Sequence[Traced], known: Container[int] = ()) -> list[Traced]:
    """The nodes that the outputs need, each after those that it needs; not what only known nodes
    need."""
    needed: dict[int, Traced] = {}
    waiting = list(outputs)
    while waiting:
        node = waiting.pop()
        if node.index not in needed:
            needed[node.index] = node
            waiting += [] if node.index in known else node.inner
    return [needed[index] for index in sorted(needed)]


def code_of(
    outputs: Sequence[Any], known: dict[int, str] | None = None
) -> tuple[list[str], list[str]]:
    """Lines that compute the nodes, and the text of each output, a node or a number.

    known : text of the nodes that are not computed here
    """
    nodes = [output for output in outputs if isinstance(output, Traced)]
    names: dict[int, str] = dict(known or {})
    lines: list[str] = []
    for node in _in_order(nodes, names):
        if node.index in names:
            continue
        if node.kind == "leaf":
            names[node.index] = node.parts[0]
        elif node.kind == "constant":
            names[node.index] = repr(node.parts[0])
        else:
            names[node.index] = f"v{node.index}"
            lines.append(f"v{node.index} = {_expression(node, names)}")
    texts = [
        names[output.index] if isinstance(output, Traced) else repr(float(output))
        for output in outputs
    ]
    return lines, texts


def _expression(node: Traced, names: dict[int, str]) -> str:
    parts = [names[part.index] for part in node.inner]
    if node.kind == "power":
        exponent = node.parts[1]
        if exponent == round(exponent) and abs(exponent) <= 64:
            whole = f"{parts[0]} ** {int(abs(exponent))}"
            # a negative power of 0 would raise ZeroDivisionError in compiled code
            return whole if exponent > 0 else f"1.0 / {whole}"
        return f"pow({parts[0]}, {exponent!r})"
    if node.kind in _CODE:
        return _CODE[node.kind].format(*parts)
    return f"{node.kind}({', '.join(parts)})"


class Hoisted:
    """What depends on parameters alone is computed once for each pair of kinds: it is read from a
    row of numbers in the loop.

    names : of the parameters, which are leaves
    """

    def __init__(self, outputs: Sequence[Any], names: Sequence[str]):
        nodes = _in_order([output for output in outputs if isinstance(output, Traced)])
        fixed: set[int] = set()
        for node in nodes:
            if node.kind == "leaf":
                is_fixed = node.parts[0] in names
            else:
                is_fixed = all(part.index in fixed for part in node.inner)
            if is_fixed:
                fixed.add(node.index)
        used = [part for node in nodes if node.index not in fixed for part in node.inner]
        used += [output for output in outputs if isinstance(output, Traced)]
        read = {
            node.index: node for node in used if node.index in fixed and node.kind != "constant"
        }
        self._nodes = list(read.values())
        self.positions = {node.index: f"p[{k}]" for k, node in enumerate(self._nodes)}

    def values(self, parameters: dict[str, float]) -> list[float]:
        """The numbers of a pair of kinds, from its parameters by name. Raises TraceError."""
        known: dict[int, float] = {}
        for node in _in_order(self._nodes):
            if node.kind == "leaf":
                known[node.index] = parameters[node.parts[0]]
            elif node.number is not None:
                known[node.index] = node.number
            else:
                parts = [
                    known[part.index] if isinstance(part, Traced) else part for part in node.parts
                ]
                known[node.index] = _computed(node.kind, parts)
        return [known[node.index] for node in self._nodes]
