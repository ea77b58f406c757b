"""Formulas of user pair potentials from the text of an energy. Only scenes with such a text import
SymPy.

The force is the derivative of the energy. What does not depend on the distance is computed once for
each pair of kinds, so that 4 eps ((sig/r)**12 - (sig/r)**6) is as fast as the built-in
Lennard-Jones. The code is written as a module that is named by its contents, so that its compiled
code is kept on disk (`core.user_modules`).
"""

import ast
import keyword
import re
from collections.abc import Callable, Mapping
from math import copysign, cos, exp, isfinite, log, log10, pi, prod, sin, sqrt
from operator import add, mul, sub, truediv
from typing import NamedTuple

import numpy as np
import sympy

from rigidmd.core.toml import shorten_text
from rigidmd.core.user_modules import module_of
from rigidmd.errors import describe_error
from rigidmd.features.potentials.poses.trace import Number
from rigidmd.features.potentials.sites.formulas import DISTANCE, Formula, FormulaError, Radial
from rigidmd.units import KJ_PER_MOL

#: Functions and operators that the text of an energy may have.
FUNCTIONS = {"exp": exp, "log": log, "sqrt": sqrt, "sin": sin, "cos": cos}
OPERATORS = {ast.Add: add, ast.Sub: sub, ast.Mult: mul, ast.Div: truediv, ast.Pow: pow}
MAX_TEXT_LENGTH = 2000
MAX_POWER = 200
MAX_NODES = 200
MAX_DEPTH = 20
#: decimal digits of numbers in a formula, before or behind the point, with powers multiplied out
MAX_DIGITS = 300
#: Prefixes of the parameters of a formula and of what is computed from them, so that no name occurs
#: twice.
PARAMETER_PREFIX, CONSTANT_PREFIX = "own_", "whole_"


def formula_of_text(energy: str, constants: Mapping[str, float] | None = None) -> Formula:
    """The formula of an energy (kJ/mol) such as "A*exp(-B*r) - C/r**6", of r (Å) and named
    parameters.

    constants : values of parameters that are the same for all sites. Raises FormulaError.
    """
    try:
        parsed = parse_energy(energy, constants)
        r = sympy.Symbol(DISTANCE, positive=True)
        if r not in parsed.free_symbols:
            raise FormulaError(f"{energy!r} does not depend on the distance {DISTANCE}")
        symbols = sorted(parsed.free_symbols - {r}, key=str)
        u = sympy.Add(*(round(KJ_PER_MOL) * term for term in _terms(parsed, r)))
        hoisted, total = _hoisted(u, r)
        of: dict[sympy.Expr, sympy.Expr] = {}
        # force/r times r²
        force = sympy.Add(*(-r * _derivative(term, r, of) for term in sympy.Add.make_args(total)))
        fields = sorted((total.free_symbols | force.free_symbols) - {r}, key=str)
        source = _source(energy, total, force, fields, r)
    except FormulaError:
        raise
    except (
        ArithmeticError,
        ValueError,
        TypeError,
        RecursionError,
        MemoryError,
    ) as error:  # of SymPy and mpmath
        raise FormulaError(
            f"{energy!r} cannot be differentiated: {describe_error(error)}"
        ) from None
    module = module_of(source.encode(), f"<pair potential {energy}>")
    names = {symbol.name[len(PARAMETER_PREFIX) :]: symbol for symbol in symbols}

    def numbers(parameters: Mapping[str, float]) -> tuple[float, ...]:
        values = {symbol: parameters[name] for name, symbol in names.items()}
        return tuple(_jet(hoisted.get(symbol, symbol), values, r, 0.0)[0] for symbol in fields) or (
            0.0,
        )

    def radial(parameters: Mapping[str, float]) -> Radial:
        values = {symbol: parameters[name] for name, symbol in names.items()}

        def value(distance: float) -> tuple[float, float, float]:
            v, first, second = _jet(u, values, r, float(distance))
            return v, -first, -second

        return value

    return Formula(energy, tuple(names), numbers, radial, module.Formula)


def _derivative(e: sympy.Expr, r: sympy.Symbol, known: dict[sympy.Expr, sympy.Expr]) -> sympy.Expr:
    """The derivative by r. SymPy's derivative determines the sign of every part, in a time like
    2**depth."""
    if e not in known:
        args = e.args
        inner = [_derivative(part, r, known) for part in e.args]
        if not inner:
            derivative = sympy.Integer(e == r)
        elif e.is_Add:
            derivative = sympy.Add(*inner)
        elif e.is_Mul:
            derivative = sympy.Add(
                *(sympy.Mul(*args[:k], d, *args[k + 1 :]) for k, d in enumerate(inner) if d != 0)
            )
        elif e.is_Pow and inner[1] == 0:
            derivative = args[1] * args[0] ** (args[1] - 1) * inner[0]
        elif e.is_Pow:
            derivative = e * (inner[1] * sympy.log(args[0]) + inner[0] * args[1] / args[0])
        else:
            derivative = e.fdiff(1) * inner[0]
        known[e] = derivative
    return known[e]


def _jet(e: sympy.Expr, values: Mapping[sympy.Symbol, float], r: sympy.Symbol, x: float) -> tuple:
    """An expression at r = x with its first and second derivative. Raises FormulaError where it is
    not real."""
    if e.is_Symbol:
        return (x, 1.0, 0.0) if e == r else (values[e], 0.0, 0.0)
    if not e.args:
        return float(e), 0.0, 0.0
    parts = [_jet(part, values, r, x) for part in e.args]
    if e.is_Add:
        return tuple(map(sum, zip(*parts, strict=True)))
    a, b, c = parts[0]
    if e.is_Mul:
        for u, v, w in parts[1:]:
            a, b, c = a * u, b * u + a * v, c * u + 2 * b * v + a * w
        return a, b, c
    try:
        if e.is_Pow and parts[1][1:] == (0.0, 0.0):
            n = parts[1][0]
            f = [
                a**n,
                n * a ** (n - 1) if n else 0.0,
                n * (n - 1) * a ** (n - 2) if n * (n - 1) else 0.0,
            ]
        elif e.is_Pow:  # the exponential of n log(a)
            n, m, k = parts[1]
            a, b, c = (
                n * log(a),
                m * log(a) + n * b / a,
                k * log(a) + 2 * m * b / a + n * (c / a - (b / a) ** 2),
            )
            f = [exp(a)] * 3
        else:
            f = {
                "exp": lambda: [exp(a)] * 3,
                "log": lambda: [log(a), 1 / a, -1 / a**2],
                "sin": lambda: [sin(a), cos(a), -sin(a)],
                "cos": lambda: [cos(a), -sin(a), -cos(a)],
                "Abs": lambda: [abs(a), copysign(1.0, a), 0.0],  # from (sig**2)**x
            }[e.func.__name__]()
        if any(isinstance(value, complex) for value in f):
            raise ValueError
    except (ArithmeticError, ValueError, KeyError):
        where = f" at {DISTANCE} = {x:g} Å" if x else ""
        raise FormulaError(f"it has no finite real value{where}") from None
    return f[0], f[1] * b, f[2] * b * b + f[1] * c


def _terms(u: sympy.Expr, r: sympy.Symbol) -> list[sympy.Expr]:
    """The terms of a sum, multiplied by factors without r. Nothing else is expanded, which could
    take too long."""
    terms = []
    for term in sympy.Add.make_args(u):
        factor, rest = term.as_independent(r, as_Add=False)
        terms += [factor * part for part in _terms(rest, r)] if rest.is_Add else [term]
    return terms


def _hoisted(u: sympy.Expr, r: sympy.Symbol) -> tuple[dict[sympy.Symbol, sympy.Expr], sympy.Expr]:
    """Symbols for factors that depend on the parameters only, and the sum with these symbols."""
    of: dict[sympy.Expr, sympy.Expr] = {}
    for term in sympy.Add.make_args(u):
        factor, rest = term.as_independent(r, as_Add=False)
        of[rest] = of.get(rest, sympy.Integer(0)) + factor
    hoisted = {}
    total = sympy.Integer(0)
    for k, (rest, factor) in enumerate(of.items()):
        if factor.free_symbols:
            symbol = sympy.Symbol(f"{CONSTANT_PREFIX}{k}", real=True)
            hoisted[symbol], factor = factor, symbol
        total += factor * rest
    return hoisted, total


def _source(energy: str, total, force, fields: list, r) -> str:
    """The source of the module of a formula with the energy `total` and the force times r,
    `force`."""
    powers: dict[int, sympy.Symbol] = {}

    def named(power):
        n = int(power.exp)
        return powers.setdefault(n, sympy.Symbol(f"r_{'to' if n > 0 else 'over'}_{abs(n)}"))

    def is_integer_power_of_r(e):  # r itself is not one for sympy
        return e.is_Pow and e.base == r and e.exp.is_Integer

    shared, (u, w) = sympy.cse(
        [e.replace(is_integer_power_of_r, named) for e in (total, force)],
        symbols=sympy.numbered_symbols("part_"),
    )
    lines = [f"{symbol} = {_code(e)}" for symbol, e in shared]
    used = {r} & set().union(*(e.free_symbols for e in (u, w, *(e for _, e in shared))))
    uses_root = bool(used) or any(n % 2 for n in powers)
    lines = _powers_of(powers) + lines
    if uses_root:
        lines.insert(0, "r = r2 * inverse1")
    names = [symbol.name for symbol in fields]
    lines[:0] = [f"{name} = formula.{name}" for name in names]
    body = "\n".join(f"    {line}" for line in lines)
    return f"""\
# {energy!r}, written by rigidmd
from math import cos, exp, log, pow, sin, sqrt
from typing import NamedTuple

from rigidmd.compile import implements
from rigidmd.features.potentials.sites.custom import energy_and_force_at


class Formula(NamedTuple):
    {"; ".join(f"{name}: float" for name in names or ["nothing"])}
    uses_root = {uses_root}


@implements(energy_and_force_at, Formula, inline=True)
def _of_distance(formula, shared, r2, inverse1, inverse2):
{body}
    return {_code(u)}, ({_code(w)}) * inverse2
"""


def _powers_of(powers: Mapping[int, sympy.Symbol]) -> list[str]:
    """Lines that compute integer powers of r, each from smaller ones."""
    lines: dict[str, str] = {}

    def power(n: int, one: str, square: str, stem: str) -> str:
        if n <= 2:
            return one if n == 1 else square
        name = f"{stem}_{n}"
        if name not in lines:
            if n % 2:
                factors = one, power(n - 1, one, square, stem)
            else:
                half = power(n // 2 if n % 4 == 0 else n - 2, one, square, stem)
                factors = half, half if n % 4 == 0 else square
            lines[name] = f"{name} = {factors[0]} * {factors[1]}"
        return name

    for n, symbol in sorted(powers.items(), key=lambda item: abs(item[0])):
        value = power(
            abs(n), *(("r", "r2", "r_to") if n > 0 else ("inverse1", "inverse2", "r_over"))
        )
        if value != symbol.name:
            lines[symbol.name] = f"{symbol.name} = {value}"
    return list(lines.values())


def _code(e) -> str:
    if e.is_Symbol:
        return e.name
    if e.is_Number or e.is_NumberSymbol:
        return f"({float(e)!r})"
    parts = [_code(part) for part in e.args]
    if e.is_Add or e.is_Mul:
        return f"({(' + ' if e.is_Add else ' * ').join(parts)})"
    if e.is_Pow:
        if e.exp == sympy.Rational(1, 2):
            return f"sqrt({parts[0]})"
        if e.exp == -sympy.Rational(1, 2):
            return f"(1.0 / sqrt({parts[0]}))"
        if e.exp.is_Integer:
            return f"({parts[0]} ** {int(e.exp)})"
        return f"pow({parts[0]}, {parts[1]})"
    name = e.func.__name__
    if name in FUNCTIONS:
        return f"{name}({parts[0]})"
    raise FormulaError(f"its derivative has {name}, which cannot be computed at every distance")


def parse_energy(energy: str, constants: Mapping[str, float] | None = None) -> sympy.Expr:
    """An energy as a SymPy expression, parsed without running it: arithmetic and `FUNCTIONS`.
    Raises FormulaError."""
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
    parsed = _read(tree.body, constants or {}, 0).value
    if parsed.has(sympy.zoo, sympy.nan, sympy.oo, sympy.I):
        raise FormulaError(f"{energy!r} is not finite")
    return parsed


def value_of(expression: sympy.Basic, values: Mapping[str, Number]) -> Number:
    """The value of an expression with arithmetic and NumPy functions."""
    if isinstance(expression, sympy.Symbol):
        return values[expression.name]
    if isinstance(expression, sympy.Number | sympy.NumberSymbol):
        return float(expression)
    parts = [value_of(part, values) for part in expression.args]
    if expression.is_Add:
        return sum(parts[1:], parts[0])
    if expression.is_Mul:
        return prod(parts[1:], start=parts[0])
    if expression.is_Pow:
        return parts[0] ** parts[1]
    return getattr(np, expression.func.__name__)(*parts)


class _Part(NamedTuple):
    value: sympy.Expr
    number: float | None  # its value if it is a number
    digits: float  # upper limit of the decimal digits of a number in it, before or behind the point
    power: float = 1.0  # largest product of integer exponents
    has_log: bool = False  # exponentials of logarithms become powers


def _number(x: float, what: str) -> _Part:
    """A number of a formula. Raises FormulaError."""
    if isinstance(x, complex) or not isfinite(x) or (x and not abs(log10(abs(x))) <= MAX_DIGITS):
        raise FormulaError(
            f"{what} is not a real number between 1e-{MAX_DIGITS} and 1e{MAX_DIGITS}"
        )
    whole = 2 * x == int(2 * x) and abs(x) < 1e9  # and halves, for square roots
    return _Part(
        sympy.Rational(int(2 * x), 2) if whole else sympy.Float(x),
        x,
        abs(log10(abs(x))) if x else 0.0,
    )


def _read(node: ast.AST, constants: Mapping[str, float], depth: int) -> _Part:
    """A node of a formula as a SymPy expression. Raises FormulaError. Numbers are computed here,
    because those of SymPy are exact, and may be too long for any memory."""

    def inner(of: ast.AST, more: int = 1) -> _Part:
        return _read(of, constants, depth + more)

    if depth > MAX_DEPTH:
        raise FormulaError(
            f"it has more than {MAX_DEPTH} functions, powers and brackets inside one another"
        )
    what = shorten_text(ast.unparse(node))
    try:
        match node:
            case ast.Constant(value=int() | float() as x) if not isinstance(x, bool):
                return _number(float(x), what)
            case ast.Name(id=name) if name == DISTANCE:
                return _Part(sympy.Symbol(DISTANCE, positive=True), None, 0.0)
            case ast.Name(id="pi"):
                return _number(pi, what)
            case ast.Name(id=name) if name in constants:
                return _number(constants[name], what)
            case ast.Name(id=name):
                return _Part(sympy.Symbol(f"{PARAMETER_PREFIX}{name}", real=True), None, 0.0)
            case ast.UnaryOp(op=ast.USub() | ast.UAdd() as op, operand=of):
                part = inner(of, 0)
                sign = 1 if isinstance(op, ast.UAdd) else -1
                return part._replace(
                    value=sign * part.value, number=part.number and sign * part.number
                )
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
                if part.number is not None:
                    return _number(FUNCTIONS[name](part.number), what)
                if name == "sqrt":
                    return part._replace(value=sympy.sqrt(part.value))
                digits = part.digits * (
                    10 ** min(part.digits, 9) if name == "exp" and part.has_log else 1
                )
                _check(digits, part.power, what)
                value = getattr(sympy, name)(part.value)
                return _Part(value, None, digits, part.power, part.has_log or name == "log")
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
    if first.number is not None and second.number is not None:
        return _number(function(first.number, second.number), what)
    digits, power = first.digits + second.digits + 1, max(first.power, second.power)
    if is_power and second.number is not None:
        digits, power = (
            first.digits * abs(second.number),
            first.power * max(1.0, abs(second.number)),
        )
    _check(digits, power, what)
    if function is truediv and second.value == 0:
        raise ZeroDivisionError
    return _Part(
        function(first.value, second.value), None, digits, power, first.has_log or second.has_log
    )


def _check(digits: float, power: float, what: str) -> None:
    """Raise FormulaError if numbers of a part or its powers are too large."""
    if not power <= MAX_POWER:
        raise FormulaError(f"{what} is a power beyond {MAX_POWER}")
    if not digits <= MAX_DIGITS:
        raise FormulaError(f"{what} has numbers of more than {MAX_DIGITS} digits")
