"""Functions of numbers as graphs, by calling them once with numbers that record what is done.

A function of NumPy arrays is called with arrays of `Traced` numbers. Each is a node of the graph of
the computation. Equal nodes are one, and parts that are constant are computed here.
"""

import math
import operator
from collections.abc import Callable, Iterable, Mapping, Sequence

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
        numbers = [part.number for part in parts if part.number is not None]
        if len(numbers) == len(parts):
            return self.constant(computed(kind, numbers))
        short = _SIMPLER[kind](*parts) if kind in _SIMPLER else None
        return self._node(kind, parts) if short is None else short

    def power(self, base: "Traced", exponent: "Traced") -> "Traced":
        """A constant exponent is a number in the node."""
        n = exponent.number
        if n is None:
            return self._node("power", (base, exponent))
        if base.number is not None:
            return self.constant(computed("power", [base.number, n]))
        if n in (0.0, 1.0):
            return base if n else self.constant(1.0)
        if n == 0.5:
            return self.node("sqrt", base)
        return self._node("power", (base, n))

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

    def first(self: "Traced", other: "Number | np.ndarray"):
        if isinstance(other, np.ndarray):
            return NotImplemented
        return self.graph.node(kind, self, self._other(other))

    def second(self: "Traced", other: "Number | np.ndarray"):
        if isinstance(other, np.ndarray):
            return NotImplemented
        return self.graph.node(kind, self._other(other), self)

    return first, second


def _function(kind: str) -> "Callable[[Traced], Traced]":
    """The method of a function of one number."""
    return lambda node: node.graph.node(kind, node)


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

    def _other(self, value: "Number") -> "Traced":
        if isinstance(value, Traced):
            return value
        return self.graph.constant(float(value))

    __add__, __radd__ = _operators("add")
    __sub__, __rsub__ = _operators("subtract")
    __mul__, __rmul__ = _operators("multiply")
    __truediv__, __rtruediv__ = _operators("divide")

    __neg__, __abs__ = _function("negative"), _function("fabs")

    def __pos__(self):
        return self

    def __pow__(self, exponent: "Number | np.ndarray"):
        if isinstance(exponent, np.ndarray):
            return NotImplemented
        return self.graph.power(self, self._other(exponent))

    def __rpow__(self, base: "Number"):
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

    sqrt, exp, log = _function("sqrt"), _function("exp"), _function("log")
    sin, cos, tanh = _function("sin"), _function("cos"), _function("tanh")
    arccos, erfc, absolute = _function("acos"), _function("erfc"), _function("fabs")

    def square(self):
        return self * self

    def __array_ufunc__(
        self, ufunc: np.ufunc, method: str, *inputs: "Number | np.ndarray", **options: object
    ):
        """NumPy functions for single numbers and arrays."""
        if method != "__call__" or options:
            return NotImplemented
        numbers = [value for value in inputs if not isinstance(value, np.ndarray)]
        if len(numbers) < len(inputs):
            arrays = np.broadcast_arrays(*(np.array(value, object) for value in inputs))
            result = np.empty(arrays[0].shape, object)
            for at in np.ndindex(*result.shape):
                result[at] = ufunc(*(array[at] for array in arrays))
            return result
        name = ufunc.__name__
        if name in _OPERATORS:
            return _OPERATORS[name](*map(self._other, numbers))
        if name in ("maximum", "minimum"):
            first, second = map(self._other, numbers)
            is_less = first < second
            if name == "maximum":
                return choose(is_less, second, first)
            return choose(is_less, first, second)
        if hasattr(self, name) and len(inputs) == 1:
            return getattr(self, name)()
        raise TraceError(f"numpy.{name} has no slope here: use {', '.join(FUNCTIONS)}")

    def __array_function__(
        self,
        function: Callable,
        kinds: Iterable[type],
        arguments: "Sequence[Number]",
        options: Mapping[str, object],
    ):
        if function is np.where and len(arguments) == 3:
            return choose(*arguments)
        return NotImplemented


#: A number that is recorded, or a constant.
Number = Traced | float


def choose(condition: Number, yes: Number, no: Number) -> Number:
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
#: Names of nodes and of functions of NumPy with two numbers.
_BINARY: dict[str, Callable] = {
    "add": operator.add,
    "subtract": operator.sub,
    "multiply": operator.mul,
    "divide": operator.truediv,
    "power": operator.pow,
    "less": operator.lt,
}
_OPERATORS = _BINARY | {
    "float_power": operator.pow,
    "less_equal": operator.lt,
    "greater": operator.gt,
    "greater_equal": operator.gt,
}
#: Kind of a node -> its value.
_VALUES = _BINARY | {
    "negative": operator.neg,
    "where": lambda condition, x, y: x if condition else y,
}


def computed(kind: str, numbers: Sequence[float]) -> float:
    try:
        value = (_VALUES[kind] if kind in _VALUES else getattr(math, kind))(*numbers)
    except (ArithmeticError, ValueError):
        value = math.nan
    if isinstance(value, complex) or not math.isfinite(value):
        raise TraceError(f"{kind} of {', '.join(f'{x:g}' for x in numbers)} is not a finite number")
    return float(value)


def _simpler_sum(x: Traced, y: Traced) -> Traced | None:
    if x.number == 0:
        return y
    if y.number == 0:
        return x
    return x - y.parts[0] if y.kind == "negative" else None


def _simpler_difference(x: Traced, y: Traced) -> Traced | None:
    if y.number == 0:
        return x
    if x.number == 0:
        return -y
    if x is y:
        return x.graph.constant(0.0)
    return x + y.parts[0] if y.kind == "negative" else None


def _simpler_product(x: Traced, y: Traced) -> Traced | None:
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


def _simpler_quotient(x: Traced, y: Traced) -> Traced | None:
    if x.number == 0 or y.number == 1:
        return x
    if y.number is not None:
        return x * computed("divide", [1.0, y.number])
    return -(x.parts[0] / y) if x.kind == "negative" else None


_SIMPLER: dict[str, Callable] = {
    "add": _simpler_sum,
    "subtract": _simpler_difference,
    "multiply": _simpler_product,
    "divide": _simpler_quotient,
    "negative": lambda x: x.parts[0] if x.kind == "negative" else None,
}
