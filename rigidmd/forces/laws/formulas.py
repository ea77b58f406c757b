"""Formulas of laws between pairs of sites: from the text of an energy, from a function, from a table.

The force of a text is its derivative (SymPy). What does not depend on the distance is computed once for each pair of
kinds, so that 4 eps ((sig/r)**12 - (sig/r)**6) costs what the built-in Lennard-Jones does. The code is written as a
module that is named by its contents: compiled code for it is kept on disk (`core.own_code`).
"""

import ast
import inspect
import itertools
import keyword
import re
from collections.abc import Callable, Mapping, Sequence
from math import inf, isfinite
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from rigidmd.compile import implements, is_a
from rigidmd.compile.own import foreign
from rigidmd.core.own_code import module_of
from rigidmd.errors import told
from rigidmd.forces.laws.own import Table, Tabulated, of_distance
from rigidmd.units import KJ_PER_MOL

if TYPE_CHECKING:
    import sympy

#: Functions that the text of an energy may name.
FUNCTIONS = ("exp", "log", "sqrt", "sin", "cos")
DISTANCE = "r"
LONGEST_TEXT, LARGEST_POWER, MOST_NODES = 2000, 200, 200
#: Function of a distance (Å) that gives the energy v, -v' and -v'', in u Å²/ps².
Radial = Callable[[float], tuple[float, float, float]]
#: Values of r² in a table, equally spaced.
STEPS = 4096


class Formula(NamedTuple):
    """A radial law, energies in kJ/mol and distances in Å where users see them, u Å²/ps² in compiled code."""

    text: str  # what it is, for messages
    parameters: tuple[str, ...]  # names of the parameters of a pair of sites
    numbers: Callable[[Mapping[str, float]], tuple[float, ...]]  # what compiled code takes of them
    radial: Callable[[Mapping[str, float]], Radial]  # of the parameters of a pair
    kind: type  # the class that compiled code knows it by
    shared: tuple = ()
    error: float = 0.0  # of the energy, relative to its largest value in reach; of a table


class FormulaError(ValueError):
    """A formula that cannot be used: what is wrong with it."""


# --- from a text -----------------------------------------------------------------------------------------------------


def of_text(energy: str, constants: Mapping[str, float] | None = None) -> Formula:
    """The formula of an energy (kJ/mol) such as "A*exp(-B*r) - C/r**6", of r (Å) and named parameters.

    constants : parameters that are the same for all sites, which then are numbers of the formula. Raises FormulaError.
    """
    import sympy

    found = _parsed(energy, constants or {})
    r = sympy.Symbol(DISTANCE, positive=True)
    if r not in found.free_symbols:
        raise FormulaError(f"{energy!r} does not depend on the distance {DISTANCE}")
    symbols = sorted(found.free_symbols - {r}, key=str)
    u = sympy.Add(*(round(KJ_PER_MOL) * term for term in _terms(found, r)))
    hoisted, total = _hoisted(u, r)
    force = sympy.Add(*(-r * sympy.diff(term, r) for term in sympy.Add.make_args(total)))  # force/r is 1/r² times this
    fields = sorted((total.free_symbols | force.free_symbols) - {r}, key=str)
    module = module_of(_source(energy, total, force, fields, r).encode(), f"<law {energy}>")
    of_pair = sympy.lambdify([symbols], [hoisted.get(symbol, symbol) for symbol in fields], "math")
    at = sympy.lambdify([symbols, r], [u, -sympy.diff(u, r), -sympy.diff(u, r, 2)], "math")
    names = tuple(symbol.name[len(OWN) :] for symbol in symbols)

    def numbers(given: Mapping[str, float]) -> tuple[float, ...]:
        return tuple(float(x) for x in of_pair([given[name] for name in names])) or (0.0,)

    def radial(given: Mapping[str, float]) -> Radial:
        values = [given[name] for name in names]

        def value(distance: float) -> tuple[float, float, float]:
            v, f, slope = at(values, float(distance))
            return float(v), float(f), float(slope)

        return value

    return Formula(energy, names, numbers, radial, module.Formula)


#: Before the names of a formula's own parameters, which then differ from all others.
OWN, HOISTED = "own_", "whole_"


def _terms(u: "sympy.Expr", r: "sympy.Symbol") -> "list[sympy.Expr]":
    """The terms of a sum, into which factors without r are multiplied. Nothing else is expanded: it might not end."""
    import sympy

    found = []
    for term in sympy.Add.make_args(u):
        factor, rest = term.as_independent(r, as_Add=False)
        found += [factor * part for part in _terms(rest, r)] if rest.is_Add else [term]
    return found


def _hoisted(u: "sympy.Expr", r: "sympy.Symbol") -> "tuple[dict[sympy.Symbol, sympy.Expr], sympy.Expr]":
    """Symbols for what depends on the parameters alone, and the sum with them."""
    import sympy

    of: dict[sympy.Expr, sympy.Expr] = {}
    for term in sympy.Add.make_args(u):
        factor, rest = term.as_independent(r, as_Add=False)
        of[rest] = of.get(rest, sympy.Integer(0)) + factor
    hoisted, total = {}, sympy.Integer(0)
    for k, (rest, factor) in enumerate(of.items()):
        if factor.free_symbols:
            symbol = sympy.Symbol(f"{HOISTED}{k}", real=True)
            hoisted[symbol], factor = factor, symbol
        total += factor * rest
    return hoisted, total


def _source(energy: str, total, force, fields: list, r) -> str:
    """The module of a formula: total is its energy, force its force times r."""
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
from rigidmd.forces.laws.own import of_distance


class Formula(NamedTuple):
    {"; ".join(f"{name}: float" for name in names or ["nothing"])}
    uses_root = {uses_root}


@implements(of_distance, inline=True)
def _of_distance(formula, shared, r2, inverse1, inverse2):
    if not is_a(formula, Formula):
        return None

    def of_distance(formula, shared, r2, inverse1, inverse2):
{body}
        return {_code(u)}, ({_code(w)}) * inverse2

    return of_distance
"""


def _powers_of(powers: Mapping[int, Any]) -> list[str]:
    """Lines that compute whole powers of r, each from smaller ones."""
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
    """An expression of SymPy as Python."""
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
    """An energy as SymPy has it, read without running it: only arithmetic and `FUNCTIONS`. Raises FormulaError."""
    import sympy

    if len(energy) > LONGEST_TEXT:
        raise FormulaError(f"it has {len(energy)} characters; {LONGEST_TEXT} are the most")
    try:
        tree = ast.parse(energy.strip(), mode="eval")
    except (SyntaxError, ValueError, MemoryError, RecursionError):
        reserved = [word for word in re.findall(r"[^\W\d]\w*", energy) if keyword.iskeyword(word)]
        why = f": {reserved[0]} is a reserved word of Python" if reserved else ""
        raise FormulaError(f"{energy!r} is not a formula such as A*exp(-B*r) - C/r**6{why}") from None
    operators = {ast.Add: "__add__", ast.Sub: "__sub__", ast.Mult: "__mul__", ast.Div: "__truediv__"}
    functions = {name: getattr(sympy, name) for name in FUNCTIONS}

    def number(x: float) -> "sympy.Expr":
        if not isfinite(x):
            raise FormulaError(f"{x} is no finite number")
        return sympy.Integer(int(x)) if x == int(x) and abs(x) < 1e9 else sympy.Float(x)

    def read(node: ast.AST) -> "sympy.Expr":
        match node:
            case ast.Constant(value=int() | float() as x) if not isinstance(x, bool):
                return number(x)
            case ast.Name(id=name) if name == DISTANCE:
                return sympy.Symbol(DISTANCE, positive=True)
            case ast.Name(id="pi"):
                return sympy.pi
            case ast.Name(id=name) if name in constants:
                return number(constants[name])
            case ast.Name(id=name):
                return sympy.Symbol(f"{OWN}{name}", real=True)
            case ast.UnaryOp(op=ast.USub(), operand=of):
                return -read(of)
            case ast.UnaryOp(op=ast.UAdd(), operand=of):
                return read(of)
            case ast.BinOp(op=ast.Pow(), left=left, right=right):
                base, exponent = read(left), read(right)
                if exponent.is_number and not abs(float(exponent)) <= LARGEST_POWER:
                    raise FormulaError(f"{ast.unparse(node)} is a power beyond {LARGEST_POWER}")
                return base**exponent
            case ast.BinOp(op=op, left=left, right=right) if type(op) in operators:
                first, second = read(left), read(right)
                if isinstance(op, ast.Div) and second == 0:
                    raise FormulaError(f"{ast.unparse(node)} divides by 0")
                return getattr(first, operators[type(op)])(second)
            case ast.Call(func=ast.Name(id=name), args=[of], keywords=[]) if name in functions:
                return functions[name](read(of))
            case ast.BinOp(op=ast.BitXor()):
                raise FormulaError(f"{ast.unparse(node)}: powers are written **, as in r**6")
            case ast.Call(func=ast.Name(id=name)):
                raise FormulaError(f"{name} is not a function of one number among {', '.join(FUNCTIONS)}")
        raise FormulaError(f"{ast.unparse(node)} has no place in a formula")

    if sum(1 for _ in ast.walk(tree)) > MOST_NODES:
        raise FormulaError(f"it has more than {MOST_NODES} numbers, names and operations")
    try:
        found = read(tree.body)
    except (RecursionError, OverflowError):
        raise FormulaError("it is too deep") from None
    if found.has(sympy.zoo, sympy.nan, sympy.oo, sympy.I):
        raise FormulaError(f"{energy!r} is not finite")
    return found


# --- from a function -------------------------------------------------------------------------------------------------

_COUNT = itertools.count()
#: What a function of users may ask for besides the parameters.
ARGUMENTS = ("r", "r2", "inverse")


def of_function(function: Callable, kind: type | None = None) -> Formula:
    """The formula of a function f(p, r) that gives (energy in kJ/mol, -dE/dr in kJ/mol/Å) for the parameters p.

    It is compiled for vectors of distances: arithmetic, and exp, log, pow, sin, cos, sqrt, fabs of Python's `math`. By
    their names it may also have the arguments r2 (r²) and inverse (1/r), which spare it a division.
    kind : NamedTuple class of the parameters; default: the annotation of p. Raises FormulaError.
    """
    function = getattr(function, "py_func", function)
    name = getattr(function, "__name__", "a law")
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
            f"{name} does not say what its parameters are: annotate {arguments[0].name} with a NamedTuple"
        )
    own = _class_for(kind, function)
    given = [one.name for one in arguments[1:]]

    def called(values: Mapping[str, float], distance: float) -> tuple[float, float]:
        asked = {"r": distance, "r2": distance**2, "inverse": 1 / distance}
        try:
            found = function(own(**values), *(asked[name] for name in given))
            energy, force = map(float, found)
        except (Exception, SystemExit) as error:  # whatever a stranger's function raises
            raise FormulaError(
                f"{name} at r = {distance:g} Å must give (energy, force), two numbers; {told(error)}"
            ) from error
        return energy * KJ_PER_MOL, force * KJ_PER_MOL

    def radial(values: Mapping[str, float]) -> Radial:
        def value(distance: float) -> tuple[float, float, float]:
            energy, force = called(values, distance)
            step = 1e-5 * distance
            slope = (called(values, distance + step)[1] - called(values, distance - step)[1]) / (2 * step)
            return energy, force, slope

        return value

    return Formula(name, own._fields, lambda values: tuple(values[field] for field in own._fields), radial, own)


def _annotated(function: Callable, argument: str) -> Any:
    try:
        return inspect.get_annotations(function, eval_str=True).get(argument)
    except (NameError, SyntaxError, AttributeError, TypeError):
        return None


def _class_for(kind: type, function: Callable) -> type:
    """A new class for a function, which compiled code tells it by: it sees the values that the function uses now."""
    module, name = function.__module__, f"{kind.__qualname__.rpartition('.')[2]}_of_{function.__name__}"
    own = type(name, (kind,), {"__module__": module, "__qualname__": name, "uses_root": True})
    own.__name__ = f"{name}_{next(_COUNT)}"  # Numba's dispatchers take classes of one name for one type
    compiled = foreign(function, inline=True)
    asked = tuple(name for name in list(inspect.signature(function).parameters)[1:])
    values = {"r": "r2 * inverse1", "r2": "r2", "inverse": "inverse1"}
    source = (
        "def of_distance(formula, shared, r2, inverse1, inverse2):\n"
        f"    energy, force = function(formula, {', '.join(values[name] for name in asked)})\n"
        f"    return {KJ_PER_MOL!r} * energy, ({KJ_PER_MOL!r} * inverse1) * force"
    )
    names = {"function": compiled}
    exec(source, names)

    @implements(of_distance, inline=True)
    def _of_function(formula, shared, r2, inverse1, inverse2):
        return names["of_distance"] if is_a(formula, own) else None

    return own


# --- from a table ----------------------------------------------------------------------------------------------------


def of_table(distance: Sequence[float], energy: Sequence[float], cutoff: float) -> Formula:
    """The formula of energies (kJ/mol) at ascending distances (Å), which must reach from contact to the cut-off.

    A cubic spline through the values, taken again at equal steps of r², where the pair loop reads it; its force is the
    derivative of what the loop reads. `error` is that of the spline, from a spline through every second value, divided
    by 16 as befits its order, and that of reading it. Raises FormulaError.
    """
    try:
        r, u = np.asarray(distance, float), np.asarray(energy, float)
    except (TypeError, ValueError):
        raise FormulaError("a table is two lists of numbers: distances in Å, energies in kJ/mol") from None
    if r.ndim != 1 or r.shape != u.shape or len(r) < 8:
        raise FormulaError(
            f"a table needs 8 distances or more, with one energy each; these are {r.shape} and {u.shape}"
        )
    if not (np.isfinite(r).all() and np.isfinite(u).all() and (np.diff(r) > 0).all() and r[0] > 0):
        raise FormulaError("a table needs ascending distances above 0, and finite energies")
    if cutoff == inf or r[-1] < cutoff * (1 - 1e-12):
        raise FormulaError(f"the table ends at {r[-1]:g} Å, before the cut-off of {cutoff:g} Å")
    spline = CubicSpline(r, u * KJ_PER_MOL)
    if not float(spline(r[0], 1)) < 0:
        raise FormulaError(f"the table begins at {r[0]:g} Å, where it does not repel: begin it at shorter distances")
    square = np.linspace(r[0] ** 2, r[-1] ** 2, STEPS + 1)
    root = np.sqrt(square)
    read = CubicSpline(
        square, spline(root), bc_type=((1, spline(r[0], 1) / (2 * r[0])), (1, spline(r[-1], 1) / (2 * r[-1])))
    )
    step = square[1] - square[0]
    coefficients = np.ascontiguousarray((read.c[::-1] * step ** np.arange(4)[:, None]).T).ravel()
    middle = np.sqrt(0.5 * (square[1:] + square[:-1]))
    size = np.abs(u[u <= 0]).max(initial=0.0) * KJ_PER_MOL or np.abs(u).max() * KJ_PER_MOL
    near = middle[spline(middle) < 10 * size]
    coarse = CubicSpline(r[::2], u[::2] * KJ_PER_MOL)
    near = near[near <= r[::2][-1]]
    error = np.abs(coarse(near) - spline(near)).max(initial=0.0) / 16 + np.abs(read(near**2) - spline(near)).max(
        initial=0.0
    )

    def radial(values: Mapping[str, float]) -> Radial:
        scale = values["scale"]

        def value(distance: float) -> tuple[float, float, float]:
            s = distance**2
            first, second = 2 * distance * read(s, 1), 2 * read(s, 1) + 4 * s * read(s, 2)
            return float(scale * read(s)), float(-scale * first), float(-scale * second)

        return value

    table = Table(float(square[0]), float(1 / step), coefficients)
    text = f"a table of {len(r)} energies from {r[0]:g} to {r[-1]:g} Å"
    return Formula(text, ("scale",), lambda values: (values["scale"],), radial, Tabulated, table, float(error / size))
