"""The text of an energy as a traced number. It is parsed, not executed: arithmetic and
`FUNCTIONS`."""

import ast
import keyword
import re
from collections.abc import Callable, Mapping
from math import cos, exp, isfinite, log, log10, sin, sqrt
from operator import add, mul, sub, truediv
from typing import NamedTuple

from rigidmd.core.toml import shorten_text
from rigidmd.features.potentials.expressions.trace import Number, Traced

#: Functions and operators that the text of an energy may have.
FUNCTIONS = {"exp": exp, "log": log, "sqrt": sqrt, "sin": sin, "cos": cos}
OPERATORS = {ast.Add: add, ast.Sub: sub, ast.Mult: mul, ast.Div: truediv, ast.Pow: pow}
MAX_TEXT_LENGTH = 2000
MAX_POWER = 200
MAX_NODES = 200
MAX_DEPTH = 20
#: decimal digits of numbers in a formula, before or behind the point, with powers multiplied out
MAX_DIGITS = 300


class FormulaError(ValueError):
    """A formula that cannot be used, and why."""


def parse_energy(energy: str) -> ast.expr:
    """The syntax tree of an energy such as "A*exp(-B*r) - C/r**6". Raises FormulaError."""
    if len(energy) > MAX_TEXT_LENGTH:
        raise FormulaError(f"it has {len(energy)} characters, the limit is {MAX_TEXT_LENGTH}")
    try:
        tree = ast.parse(energy.strip(), mode="eval")
    except (SyntaxError, ValueError, MemoryError, RecursionError):
        reserved = [word for word in re.findall(r"[^\W\d]\w*", energy) if keyword.iskeyword(word)]
        why = f": {reserved[0]} is a reserved word of Python" if reserved else ""
        raise FormulaError(
            f"{energy!r} is not a formula such as A*exp(-B*r) - C/r**6{why}"
        ) from None
    if sum(1 for _ in ast.walk(tree)) > MAX_NODES:
        raise FormulaError(f"it has more than {MAX_NODES} numbers, names and operations")
    return tree.body


def names_in(tree: ast.expr) -> list[str]:
    """The names of numbers in an energy, sorted; not those of functions, nor pi."""
    names = [node.id for node in ast.walk(tree) if isinstance(node, ast.Name)]
    calls = [node.func for node in ast.walk(tree) if isinstance(node, ast.Call)]
    functions = {node.id for node in calls if isinstance(node, ast.Name)}
    return sorted({*names} - functions - {"pi"})


def value_of(tree: ast.expr, values: Mapping[str, Number]) -> Number:
    """The value of an energy with the values of its names. Raises FormulaError."""
    return _read(tree, values, 0).value


class _Part(NamedTuple):
    value: Number
    digits: float  # upper limit of the decimal digits of a number in it, before or behind the point
    power: float = 1.0  # largest product of integer exponents


def _number(x: float, what: str) -> _Part:
    """A number of a formula. Raises FormulaError."""
    if isinstance(x, complex) or not isfinite(x) or (x and not abs(log10(abs(x))) <= MAX_DIGITS):
        raise FormulaError(
            f"{what} is not a real number between 1e-{MAX_DIGITS} and 1e{MAX_DIGITS}"
        )
    return _Part(x, abs(log10(abs(x))) if x else 0.0)


def _read(node: ast.AST, values: Mapping[str, Number], depth: int) -> _Part:
    """A node of a formula. Raises FormulaError."""

    def inner(of: ast.AST, more: int = 1) -> _Part:
        return _read(of, values, depth + more)

    if depth > MAX_DEPTH:
        raise FormulaError(
            f"it has more than {MAX_DEPTH} functions, powers and brackets inside one another"
        )
    what = shorten_text(ast.unparse(node))
    try:
        match node:
            case ast.Constant(value=int() | float() as x) if not isinstance(x, bool):
                return _number(float(x), what)
            case ast.Name(id=name):
                value = values[name]
                return _number(value, what) if isinstance(value, float) else _Part(value, 0.0)
            case ast.UnaryOp(op=ast.USub(), operand=of):
                part = inner(of, 0)
                return part._replace(value=-part.value)
            case ast.UnaryOp(op=ast.UAdd(), operand=of):
                return inner(of, 0)
            case ast.BinOp(op=ast.BitXor()):
                raise FormulaError(f"{what}: powers are written **, as in r**6")
            case ast.BinOp(op=op, left=left, right=right) if type(op) in OPERATORS:
                is_power = isinstance(op, ast.Pow)
                return _combined(
                    OPERATORS[type(op)],
                    inner(left, int(is_power)),
                    inner(right),
                    is_power=is_power,
                    what=what,
                )
            case ast.Call(func=ast.Name(id=name), args=[of], keywords=[]) if name in FUNCTIONS:
                part = inner(of)
                if isinstance(part.value, float):
                    return _number(FUNCTIONS[name](part.value), what)
                return part._replace(value=getattr(part.value, name)())
            case ast.Call(func=ast.Name(id=name)):
                raise FormulaError(
                    f"{name} is not a function of one number among {', '.join(FUNCTIONS)}"
                )
    except ZeroDivisionError:
        raise FormulaError(f"{what} divides by 0") from None
    except (OverflowError, ValueError) as error:
        if isinstance(error, FormulaError):
            raise
        raise FormulaError(f"{what} is not a finite real number") from None
    raise FormulaError(f"{what} is not allowed in a formula")


def _combined(
    function: Callable, first: _Part, second: _Part, *, is_power: bool, what: str
) -> _Part:
    """Two parts under an operator. Raises FormulaError."""
    x, y = first.value, second.value
    number = y.number if isinstance(y, Traced) else y
    if isinstance(x, float) and isinstance(y, float):
        return _number(function(x, y), what)
    digits, power = first.digits + second.digits + 1, max(first.power, second.power)
    if is_power and number is not None:
        digits, power = first.digits * abs(number), first.power * max(1.0, abs(number))
    if not power <= MAX_POWER:
        raise FormulaError(f"{what} is a power beyond {MAX_POWER}")
    if not digits <= MAX_DIGITS:
        raise FormulaError(f"{what} has numbers of more than {MAX_DIGITS} digits")
    if function is truediv and number == 0:
        raise ZeroDivisionError
    return _Part(function(x, y), digits, power)
