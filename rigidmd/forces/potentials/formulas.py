"""Formulas of user pair potentials: from the text of an energy, from a function, from a table.

The force of a text is its derivative (SymPy). What does not depend on the distance is computed once for each pair of
kinds, so that 4 eps ((sig/r)**12 - (sig/r)**6) is as fast as the built-in Lennard-Jones. The code is written as a
module that is named by its contents, so that its compiled code is kept on disk (`core.user_modules`).
"""

import ast
import inspect
import itertools
import keyword
import re
from collections.abc import Callable, Mapping, Sequence
from math import copysign, cos, exp, inf, isfinite, log, log10, pi, sin, sqrt
from operator import add, mul, sub, truediv
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicHermiteSpline, CubicSpline, PPoly

from rigidmd.compile import implements, is_a
from rigidmd.compile.kernels import compile_user_function
from rigidmd.core.toml import shorten_text
from rigidmd.core.user_modules import module_of
from rigidmd.errors import describe_error
from rigidmd.forces.potentials.custom import Table, Tabulated, energy_and_force_at
from rigidmd.units import KJ_PER_MOL

if TYPE_CHECKING:
    import sympy

#: Functions and operators that the text of an energy may have.
FUNCTIONS = {"exp": exp, "log": log, "sqrt": sqrt, "sin": sin, "cos": cos}
OPERATORS = {ast.Add: add, ast.Sub: sub, ast.Mult: mul, ast.Div: truediv, ast.Pow: pow}
DISTANCE = "r"
MAX_TEXT_LENGTH, MAX_POWER, MAX_NODES, MAX_DEPTH = 2000, 200, 200, 20
MAX_DIGITS = 300  #: decimal digits of numbers in a formula, before or behind the point, with powers multiplied out
#: Function of a distance (Å) that gives the energy v, -v' and -v'', in u Å²/ps².
Radial = Callable[[float], tuple[float, float, float]]
STEPS = 4096  #: intervals of r² in a table, equally spaced
LEAST_ROWS = 8  #: of a table of a user
#: Largest difference of an energy and the trapezoidal integral of its force between two rows, relative to the largest
#: change of the energy between rows.
WRONG_FORCE = 0.3


class Formula(NamedTuple):
    """A radial potential: energies in kJ/mol and distances in Å for users, u Å²/ps² in compiled code."""

    text: str  # for messages
    parameters: tuple[str, ...]  # names of the parameters of a pair of sites
    numbers: Callable[[Mapping[str, float]], tuple[float, ...]]  # the fields of `kind` from the parameters
    radial: Callable[[Mapping[str, float]], Radial]  # of the parameters of a pair
    kind: type  # the NamedTuple class of the formula in compiled code
    shared: tuple = ()
    error: float = 0.0  # of the energy of a table, relative to its largest value in reach


class FormulaError(ValueError):
    """A formula that cannot be used, and why."""


# --- from a text -----------------------------------------------------------------------------------------------------


def formula_of_text(energy: str, constants: Mapping[str, float] | None = None) -> Formula:
    """The formula of an energy (kJ/mol) such as "A*exp(-B*r) - C/r**6", of r (Å) and named parameters.

    constants : values of parameters that are the same for all sites. Raises FormulaError.
    """
    import sympy

    try:
        found = _parsed(energy, constants or {})
        r = sympy.Symbol(DISTANCE, positive=True)
        if r not in found.free_symbols:
            raise FormulaError(f"{energy!r} does not depend on the distance {DISTANCE}")
        symbols = sorted(found.free_symbols - {r}, key=str)
        u = sympy.Add(*(round(KJ_PER_MOL) * term for term in _terms(found, r)))
        hoisted, total = _hoisted(u, r)
        of: dict[sympy.Expr, sympy.Expr] = {}
        terms = sympy.Add.make_args(total)
        force = sympy.Add(*(-r * _derivative(term, r, of) for term in terms))  # force/r is 1/r² times this
        fields = sorted((total.free_symbols | force.free_symbols) - {r}, key=str)
        source = _source(energy, total, force, fields, r)
    except FormulaError:
        raise
    except (ArithmeticError, ValueError, TypeError, RecursionError, MemoryError) as error:  # of SymPy and mpmath
        raise FormulaError(f"{energy!r} cannot be differentiated: {describe_error(error)}") from None
    module = module_of(source.encode(), f"<pair potential {energy}>")
    names = {symbol.name[len(PARAMETER_PREFIX) :]: symbol for symbol in symbols}

    def numbers(given: Mapping[str, float]) -> tuple[float, ...]:
        values = {symbol: given[name] for name, symbol in names.items()}
        return tuple(_jet(hoisted.get(symbol, symbol), values, r, 0.0)[0] for symbol in fields) or (0.0,)

    def radial(given: Mapping[str, float]) -> Radial:
        values = {symbol: given[name] for name, symbol in names.items()}

        def value(distance: float) -> tuple[float, float, float]:
            v, first, second = _jet(u, values, r, float(distance))
            return v, -first, -second

        return value

    return Formula(energy, tuple(names), numbers, radial, module.Formula)


#: Prefixes of the parameters of a formula and of what is computed from them, so that no name occurs twice.
PARAMETER_PREFIX, CONSTANT_PREFIX = "own_", "whole_"


def _derivative(e: "sympy.Expr", r: "sympy.Symbol", known: "dict[sympy.Expr, sympy.Expr]") -> "sympy.Expr":
    """The derivative by r. SymPy's derivative determines the sign of every part, in a time like 2**depth."""
    import sympy

    if e not in known:
        args, inner = e.args, [_derivative(part, r, known) for part in e.args]
        if not inner:
            found = sympy.Integer(e == r)
        elif e.is_Add:
            found = sympy.Add(*inner)
        elif e.is_Mul:
            found = sympy.Add(*(sympy.Mul(*args[:k], d, *args[k + 1 :]) for k, d in enumerate(inner) if d != 0))
        elif e.is_Pow and inner[1] == 0:
            found = args[1] * args[0] ** (args[1] - 1) * inner[0]
        elif e.is_Pow:
            found = e * (inner[1] * sympy.log(args[0]) + inner[0] * args[1] / args[0])
        else:
            found = e.fdiff(1) * inner[0]
        known[e] = found
    return known[e]


def _jet(e: "sympy.Expr", values: "Mapping[sympy.Symbol, float]", r: "sympy.Symbol", x: float) -> tuple:
    """An expression at r = x with its first and second derivative. Raises FormulaError where it is not real."""
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
            f = [a**n, n * a ** (n - 1) if n else 0.0, n * (n - 1) * a ** (n - 2) if n * (n - 1) else 0.0]
        elif e.is_Pow:  # the exponential of n log(a)
            n, m, k = parts[1]
            a, b, c = n * log(a), m * log(a) + n * b / a, k * log(a) + 2 * m * b / a + n * (c / a - (b / a) ** 2)
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


def _terms(u: "sympy.Expr", r: "sympy.Symbol") -> "list[sympy.Expr]":
    """The terms of a sum, multiplied by factors without r. Nothing else is expanded, which could take too long."""
    import sympy

    found = []
    for term in sympy.Add.make_args(u):
        factor, rest = term.as_independent(r, as_Add=False)
        found += [factor * part for part in _terms(rest, r)] if rest.is_Add else [term]
    return found


def _hoisted(u: "sympy.Expr", r: "sympy.Symbol") -> "tuple[dict[sympy.Symbol, sympy.Expr], sympy.Expr]":
    """Symbols for factors that depend on the parameters only, and the sum with these symbols."""
    import sympy

    of: dict[sympy.Expr, sympy.Expr] = {}
    for term in sympy.Add.make_args(u):
        factor, rest = term.as_independent(r, as_Add=False)
        of[rest] = of.get(rest, sympy.Integer(0)) + factor
    hoisted, total = {}, sympy.Integer(0)
    for k, (rest, factor) in enumerate(of.items()):
        if factor.free_symbols:
            symbol = sympy.Symbol(f"{CONSTANT_PREFIX}{k}", real=True)
            hoisted[symbol], factor = factor, symbol
        total += factor * rest
    return hoisted, total


def _source(energy: str, total, force, fields: list, r) -> str:
    """The source of the module of a formula with the energy `total` and the force times r, `force`."""
    import sympy

    powers: dict[int, sympy.Symbol] = {}

    def named(power):
        n = int(power.exp)
        return powers.setdefault(n, sympy.Symbol(f"r_{'to' if n > 0 else 'over'}_{abs(n)}"))

    def whole(e):
        return e.is_Pow and e.base == r and e.exp.is_Integer

    shared, (u, w) = sympy.cse(
        [e.replace(whole, named) for e in (total, force)], symbols=sympy.numbered_symbols("part_")
    )
    lines = [f"{symbol} = {_code(e)}" for symbol, e in shared]
    used = {r} & set().union(*(e.free_symbols for e in (u, w, *(e for _, e in shared))))
    uses_root = bool(used) or any(n % 2 for n in powers)
    lines = _powers_of(powers) + lines
    if uses_root:
        lines.insert(0, "r = r2 * inverse1")
    names = [symbol.name for symbol in fields]
    lines[:0] = [f"{name} = formula.{name}" for name in names]
    body = "\n".join(f"        {line}" for line in lines)
    return f"""\
# {energy!r}, written by rigidmd
from math import cos, exp, log, pow, sin, sqrt
from typing import NamedTuple

from rigidmd.compile import implements, is_a
from rigidmd.forces.potentials.custom import energy_and_force_at


class Formula(NamedTuple):
    {"; ".join(f"{name}: float" for name in names or ["nothing"])}
    uses_root = {uses_root}


@implements(energy_and_force_at, inline=True)
def _of_distance(formula, shared, r2, inverse1, inverse2):
    if not is_a(formula, Formula):
        return None

    def energy_and_force_at(formula, shared, r2, inverse1, inverse2):
{body}
        return {_code(u)}, ({_code(w)}) * inverse2

    return energy_and_force_at
"""


def _powers_of(powers: Mapping[int, Any]) -> list[str]:
    """Lines that compute integer powers of r, each from smaller ones."""
    lines: dict[str, str] = {}

    def even(n: int, square: str, stem: str) -> str:
        if n == 2:
            return square
        name = f"{stem}_{n}"
        if name not in lines:
            half = n // 2
            parts = (even(half, square, stem),) * 2 if half % 2 == 0 else (even(n - 2, square, stem), square)
            lines[name] = f"{name} = {parts[0]} * {parts[1]}"
        return name

    for n, symbol in sorted(powers.items(), key=lambda item: abs(item[0])):
        square, one, stem = ("r2", "r", "r_to") if n > 0 else ("inverse2", "inverse1", "r_over")
        if abs(n) == 1:
            value = one
        elif n % 2:
            value = f"{one} * {even(abs(n) - 1, square, stem)}"
        else:
            value = even(abs(n), square, stem)
        if value != symbol.name:
            lines[symbol.name] = f"{symbol.name} = {value}"
    return list(lines.values())


def _code(e) -> str:
    import sympy

    if e.is_Symbol:
        return e.name
    if e.is_Number or e.is_NumberSymbol:
        return f"({float(e)!r})"
    parts = [_code(part) for part in e.args]
    if e.is_Add:
        return f"({' + '.join(parts)})"
    if e.is_Mul:
        return f"({' * '.join(parts)})"
    if e.is_Pow:
        if e.exp == sympy.Rational(1, 2):
            return f"sqrt({parts[0]})"
        if e.exp == -sympy.Rational(1, 2):
            return f"(1.0 / sqrt({parts[0]}))"
        if e.exp.is_Integer:
            return f"({parts[0]} ** {int(e.exp)})"
        return f"pow({parts[0]}, {parts[1]})"
    names = {sympy.exp: "exp", sympy.log: "log", sympy.sin: "sin", sympy.cos: "cos"}
    if e.func in names:
        return f"{names[e.func]}({parts[0]})"
    raise FormulaError(f"its derivative has {e.func.__name__}, which cannot be computed at every distance")


def _parsed(energy: str, constants: Mapping[str, float]) -> "sympy.Expr":
    """An energy as a SymPy expression, parsed without running it: arithmetic and `FUNCTIONS`. Raises FormulaError."""
    import sympy

    if len(energy) > MAX_TEXT_LENGTH:
        raise FormulaError(f"it has {len(energy)} characters, the limit is {MAX_TEXT_LENGTH}")
    try:
        tree = ast.parse(energy.strip(), mode="eval")
    except (SyntaxError, ValueError, MemoryError, RecursionError):
        reserved = [word for word in re.findall(r"[^\W\d]\w*", energy) if keyword.iskeyword(word)]
        why = f": {reserved[0]} is a reserved word of Python" if reserved else ""
        raise FormulaError(f"{energy!r} is not a formula such as A*exp(-B*r) - C/r**6{why}") from None
    if sum(1 for _ in ast.walk(tree)) > MAX_NODES:
        raise FormulaError(f"it has more than {MAX_NODES} numbers, names and operations")
    found = _read(tree.body, constants, 0).value
    if found.has(sympy.zoo, sympy.nan, sympy.oo, sympy.I):
        raise FormulaError(f"{energy!r} is not finite")
    return found


class _Part(NamedTuple):
    value: "sympy.Expr"
    number: float | None  # its value if it is a number
    digits: float  # upper limit of the decimal digits of a number in it, before or behind the point
    power: float = 1.0  # largest product of integer exponents
    has_log: bool = False  # exponentials of logarithms become powers


def _number(x: float, what: str) -> _Part:
    """A number of a formula. Raises FormulaError."""
    import sympy

    if isinstance(x, complex) or not isfinite(x) or (x and not abs(log10(abs(x))) <= MAX_DIGITS):
        raise FormulaError(f"{what} is not a real number between 1e-{MAX_DIGITS} and 1e{MAX_DIGITS}")
    whole = 2 * x == int(2 * x) and abs(x) < 1e9  # and halves, for square roots
    return _Part(sympy.Rational(int(2 * x), 2) if whole else sympy.Float(x), x, abs(log10(abs(x))) if x else 0.0)


def _read(node: ast.AST, constants: Mapping[str, float], depth: int) -> _Part:
    """A node of a formula as a SymPy expression. Raises FormulaError. Numbers are computed here, because those of SymPy
    are exact, and may be too long for any memory."""
    import sympy

    def inner(of: ast.AST, more: int = 1) -> _Part:
        return _read(of, constants, depth + more)

    if depth > MAX_DEPTH:
        raise FormulaError(f"it has more than {MAX_DEPTH} functions, powers and brackets inside one another")
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
                part, sign = inner(of, 0), 1 if isinstance(op, ast.UAdd) else -1
                return part._replace(value=sign * part.value, number=part.number and sign * part.number)
            case ast.BinOp(op=ast.BitXor()):
                raise FormulaError(f"{what}: powers are written **, as in r**6")
            case ast.BinOp(op=op, left=left, right=right) if type(op) in OPERATORS:
                is_power = isinstance(op, ast.Pow)
                return _combined(OPERATORS[type(op)], inner(left, int(is_power)), inner(right), is_power, what)
            case ast.Call(func=ast.Name(id=name), args=[of], keywords=[]) if name in FUNCTIONS:
                part = inner(of)
                if part.number is not None:
                    return _number(FUNCTIONS[name](part.number), what)
                if name == "sqrt":
                    return part._replace(value=sympy.sqrt(part.value))
                digits = part.digits * (10 ** min(part.digits, 9) if name == "exp" and part.has_log else 1)
                _check(digits, part.power, what)
                value = getattr(sympy, name)(part.value)
                return _Part(value, None, digits, part.power, part.has_log or name == "log")
            case ast.Call(func=ast.Name(id=name)):
                raise FormulaError(f"{name} is not a function of one number among {', '.join(FUNCTIONS)}")
    except ZeroDivisionError:
        raise FormulaError(f"{what} divides by 0") from None
    except (OverflowError, ValueError) as error:
        if isinstance(error, FormulaError):
            raise
        raise FormulaError(f"{what} is not a finite real number") from None
    raise FormulaError(f"{what} is not allowed in a formula")


def _combined(function: Callable, first: _Part, second: _Part, is_power: bool, what: str) -> _Part:
    """Two parts under an operator. Raises FormulaError."""
    if first.number is not None and second.number is not None:
        return _number(function(first.number, second.number), what)
    digits, power = first.digits + second.digits + 1, max(first.power, second.power)
    if is_power and second.number is not None:
        digits, power = first.digits * abs(second.number), first.power * max(1.0, abs(second.number))
    _check(digits, power, what)
    if function is truediv and second.value == 0:
        raise ZeroDivisionError
    return _Part(function(first.value, second.value), None, digits, power, first.has_log or second.has_log)


def _check(digits: float, power: float, what: str) -> None:
    """Raise FormulaError if numbers of a part or its powers are too large."""
    if not power <= MAX_POWER:
        raise FormulaError(f"{what} is a power beyond {MAX_POWER}")
    if not digits <= MAX_DIGITS:
        raise FormulaError(f"{what} has numbers of more than {MAX_DIGITS} digits")


# --- from a function -------------------------------------------------------------------------------------------------

_COUNT = itertools.count()
#: Arguments that a user function may have besides the parameters.
ARGUMENTS = ("r", "r2", "inverse")


def formula_of_function(function: Callable, kind: type | None = None) -> Formula:
    """The formula of a function f(p, r) that returns (energy in kJ/mol, -dE/dr in kJ/mol/Å) for the parameters p.

    It is compiled for vectors of distances: arithmetic, and exp, log, pow, sin, cos, sqrt, fabs of Python's `math`. It
    may also have arguments named r2 (r²) and inverse (1/r), which save a division.
    kind : NamedTuple class of the parameters; default: the annotation of p. Raises FormulaError.
    """
    function = getattr(function, "py_func", function)
    name = getattr(function, "__name__", "a pair potential")
    if not inspect.isfunction(function):
        raise FormulaError(f"{function!r:.60} is not a function of Python, made by def or lambda")
    arguments = list(inspect.signature(function).parameters.values())
    strange = [one.name for one in arguments[1:] if one.name not in ARGUMENTS]
    if not arguments or len(arguments) < 2 or strange:
        raise FormulaError(
            f"{name} has the arguments ({', '.join(one.name for one in arguments)}); it needs the parameters, then r, "
            "and may have r2 and inverse"
        )
    kind = kind or _annotated(function, arguments[0].name)
    if not (isinstance(kind, type) and issubclass(kind, tuple) and getattr(kind, "_fields", ())):
        raise FormulaError(
            f"the parameters of {name} are not known: annotate {arguments[0].name} with a NamedTuple class"
        )
    formula_class = _class_for(kind, function)
    given = [one.name for one in arguments[1:]]

    def called(values: Mapping[str, float], distance: float) -> tuple[float, float]:
        asked = {"r": distance, "r2": distance**2, "inverse": 1 / distance}
        try:
            found = function(formula_class(**values), *(asked[name] for name in given))
            energy, force = map(float, found)
        except (Exception, SystemExit) as error:  # a user function may raise anything
            raise FormulaError(
                f"{name} at r = {distance:g} Å must give (energy, force), two numbers; {describe_error(error)}"
            ) from error
        return energy * KJ_PER_MOL, force * KJ_PER_MOL

    def radial(values: Mapping[str, float]) -> Radial:
        def value(distance: float) -> tuple[float, float, float]:
            energy, force = called(values, distance)
            step = 1e-5 * distance
            slope = (called(values, distance + step)[1] - called(values, distance - step)[1]) / (2 * step)
            return energy, force, slope

        return value

    return Formula(
        name, formula_class._fields, lambda values: tuple(values[field] for field in formula_class._fields), radial,
        formula_class,
    )  # fmt: skip


def _annotated(function: Callable, argument: str) -> Any:
    try:
        return inspect.get_annotations(function, eval_str=True).get(argument)
    except (NameError, SyntaxError, AttributeError, TypeError):
        return None


def _class_for(kind: type, function: Callable) -> type:
    """A new class for a function, by which compiled code finds it: with the values that the function uses now."""
    module, name = function.__module__, f"{kind.__qualname__.rpartition('.')[2]}_of_{function.__name__}"
    formula_class = type(name, (kind,), {"__module__": module, "__qualname__": name, "uses_root": True})
    formula_class.__name__ = f"{name}_{next(_COUNT)}"  # Numba takes classes of one name for one type
    compiled = compile_user_function(function, inline=True)
    asked = tuple(name for name in list(inspect.signature(function).parameters)[1:])
    values = {"r": "r2 * inverse1", "r2": "r2", "inverse": "inverse1"}
    source = (
        "def energy_and_force_at(formula, shared, r2, inverse1, inverse2):\n"
        f"    energy, force = function(formula, {', '.join(values[name] for name in asked)})\n"
        f"    return {KJ_PER_MOL!r} * energy, ({KJ_PER_MOL!r} * inverse1) * force"
    )
    names = {"function": compiled}
    exec(source, names)

    @implements(energy_and_force_at, inline=True)
    def _of_function(formula, shared, r2, inverse1, inverse2):
        return names["energy_and_force_at"] if is_a(formula, formula_class) else None

    return formula_class


# --- from a table ----------------------------------------------------------------------------------------------------


def formula_of_table(
    distance: Sequence[float], energy: Sequence[float], cutoff: float, force: Sequence[float] | None = None,
    name: str = "a table",
) -> Formula:  # fmt: skip
    """The formula of energies (kJ/mol) at ascending distances (Å), which must reach from contact to the cutoff.

    The table is interpolated by a cubic spline, or by cubics with the given forces -dE/dr (kJ/mol/Å) at the distances,
    and tabulated again at equal steps of r² for the pair loop. The force is the derivative of that table. Nearer than
    the first distance a the energy is E(a) + a F(a)/12 ((a/r)¹² - 1), down to a/2, and a straight line in r² below.
    `error` is the error of the spline, estimated by one through every second value and divided by 16 for its order,
    plus the error of the second table. Raises FormulaError.
    """
    try:
        r, u = np.asarray(distance, float), np.asarray(energy, float)
        f = None if force is None else np.asarray(force, float)
    except (TypeError, ValueError):
        raise FormulaError(f"{name} is two lists of numbers: distances in Å, energies in kJ/mol") from None
    if r.ndim != 1 or r.shape != u.shape or len(r) < LEAST_ROWS or (f is not None and f.shape != r.shape):
        raise FormulaError(
            f"{name} needs {LEAST_ROWS} distances or more, with one energy each; these are {r.shape} and {u.shape}"
        )
    finite = np.isfinite(r).all() and np.isfinite(u).all() and (f is None or np.isfinite(f).all())
    if not (finite and (np.diff(r) > 0).all() and r[0] > 0):
        raise FormulaError(f"{name} needs ascending distances above 0, and finite energies")
    if cutoff == inf or r[-1] < cutoff * (1 - 1e-12):
        unit = "; is it in nm?" if r[-1] < 3 < cutoff <= 10 * r[-1] * 1.01 else ""
        raise FormulaError(f"{name} ends at {r[-1]:g} Å, before the cutoff of {cutoff:g} Å{unit}")

    size = np.abs(u[u <= 0]).max(initial=0.0) or np.abs(u).max()
    if f is not None:
        _check_forces(name, r, u, f, 10 * size)

    def interpolated(rows: slice) -> PPoly:
        values = KJ_PER_MOL * u[rows]
        return CubicSpline(r[rows], values) if f is None else CubicHermiteSpline(r[rows], values, -KJ_PER_MOL * f[rows])

    spline, coarse = interpolated(slice(None)), interpolated(slice(None, None, 2))
    slope = spline(r[[0, -1]], 1) / (2 * r[[0, -1]])  # by r²
    if not slope[0] < 0:
        raise FormulaError(f"{name} begins at {r[0]:g} Å, where it does not repel: begin it at shorter distances")
    square = np.linspace(r[0] ** 2, r[-1] ** 2, STEPS + 1)
    read = CubicSpline(square, spline(np.sqrt(square)), bc_type=((1, slope[0]), (1, slope[1])))
    step = square[1] - square[0]
    middle = np.sqrt(0.5 * (square[1:] + square[:-1]))
    near = middle[spline(middle) < 10 * KJ_PER_MOL * size]
    near = near[near <= r[::2][-1]]
    error = np.abs(coarse(near) - spline(near)).max(initial=0.0) / 16
    error = float(error + np.abs(read(near**2) - spline(near)).max(initial=0.0)) / (KJ_PER_MOL * size)
    if (steps := int(0.75 * square[0] / step)) > 0:
        inner = square[0] - step * np.arange(steps, -1, -1.0)
        six = (square[0] / inner) ** 6
        energies = spline(r[0]) - slope[0] * square[0] / 6 * (six - 1)
        wall = CubicHermiteSpline(inner, energies, slope[0] * six * square[0] / inner)
        read = PPoly(np.hstack([wall.c, read.c]), np.concatenate([inner, square[1:]]))
    coefficients = np.ascontiguousarray((read.c[::-1] * step ** np.arange(4)[:, None]).T).ravel()

    def radial(values: Mapping[str, float]) -> Radial:
        scale = values["scale"]

        def value(distance: float) -> tuple[float, float, float]:
            s = distance**2
            first, second = 2 * distance * read(s, 1), 2 * read(s, 1) + 4 * s * read(s, 2)
            return float(scale * read(s)), float(-scale * first), float(-scale * second)

        return value

    table = Table(float(read.x[0]), float(1 / step), coefficients)
    text = f"{name} of {len(r)} energies from {r[0]:g} to {r[-1]:g} Å"
    return Formula(text, ("scale",), lambda values: (values["scale"],), radial, Tabulated, table, error)


def _check_forces(name: str, r: np.ndarray, u: np.ndarray, f: np.ndarray, high: float) -> None:
    """Raise FormulaError if forces f are not -du/dr between the rows with energies up to `high`."""
    gained, mean = np.diff(u), 0.5 * (f[1:] + f[:-1]) * np.diff(r)
    off = np.where(np.maximum(u[1:], u[:-1]) <= high, np.abs(gained + mean), 0.0)
    k = int(off.argmax())
    if off[k] > WRONG_FORCE * np.abs(gained).max(where=u[:-1] <= high, initial=0.0):
        raise FormulaError(
            f"{name}: the forces are not -dE/dr. From {r[k]:g} to {r[k + 1]:g} Å the energy changes by {gained[k]:.4g} "
            f"kJ/mol, with these forces it would by {-mean[k]:.4g}. Have they another sign or unit?"
        )
