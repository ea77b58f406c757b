"""Formulas of user pair potentials: from a text, from a function, from a table."""

import contextlib
import inspect
import itertools
from collections.abc import Callable, Mapping, Sequence
from math import pi
from typing import NamedTuple

import numpy as np

from rigidmd.compile import implements
from rigidmd.compile.kernels import compile_user_function
from rigidmd.errors import describe_error
from rigidmd.features.potentials.expressions.radial import Radial as RadialFunctions
from rigidmd.features.potentials.expressions.slopes import Hoisted, formula_module, function_of
from rigidmd.features.potentials.expressions.text import (
    FormulaError,
    names_in,
    parse_energy,
    value_of,
)
from rigidmd.features.potentials.expressions.trace import Graph, TraceError
from rigidmd.features.potentials.sites.custom import Table, Tabulated, energy_and_force_at
from rigidmd.features.potentials.tables import reach_errors, start_errors, value_errors
from rigidmd.units import KJ_PER_MOL

DISTANCE = "r"
#: Function of a distance (Å) that gives the energy v, -v' and -v'', in u Å²/ps².
Radial = Callable[[float], tuple[float, float, float]]
STEPS = 4096  #: intervals of r² in a table, equally spaced
LEAST_ROWS = 8  #: of a table of a user
#: Largest difference of an energy and the trapezoidal integral of its force between two rows,
#: relative to the largest change of the energy between rows.
WRONG_FORCE = 0.3
#: Neighbouring intervals of a table that differ by more than this factor separate parts of it. A
#: part
#: of longer intervals than its neighbour with fewer than LEAST_ROWS of them is a gap: it is not
#: known how
#: far the spline is off in it.
UNEQUAL = 3.0
#: Largest error of the spline of a table, relative to its deepest energy.
LARGEST_ERROR = 0.1


class Formula(NamedTuple):
    """A radial potential: energies in kJ/mol and distances in Å for users, u Å²/ps² in compiled
    code."""

    text: str  # for messages
    parameters: tuple[str, ...]  # names of the parameters of a pair of sites
    # the fields of `kind` from the parameters
    numbers: Callable[[Mapping[str, float]], tuple[float, ...]]
    radial: Callable[[Mapping[str, float]], Radial]  # of the parameters of a pair
    kind: type  # the NamedTuple class of the formula in compiled code
    shared: tuple = ()
    error: float = 0.0  # of the energy of a table, relative to its largest value in reach


# --- from a text ----------------------------------------------------------------------------------


def formula_of_text(energy: str, constants: Mapping[str, float] | None = None) -> Formula:
    """The formula of an energy (kJ/mol) such as "A*exp(-B*r) - C/r**6", of r (Å) and named
    parameters. The force is its derivative.

    constants : values of parameters that are the same for all sites. Raises FormulaError.
    """
    numbers = {"pi": pi, **(constants or {})}
    tree = parse_energy(energy)
    names = [name for name in names_in(tree) if name not in numbers and name != DISTANCE]
    graph = Graph()
    leaves = {name: graph.leaf(name) for name in names}
    r = graph.leaf(DISTANCE)
    functions = RadialFunctions(r)
    # a number is a node too
    value = graph.constant(0.0) + value_of(tree, {**numbers, **leaves, DISTANCE: r})
    try:
        u = functions.sum_of_products(value, KJ_PER_MOL)
        if not functions.depends_on_r(u):
            raise FormulaError(f"{energy!r} does not depend on the distance {DISTANCE}")
        outputs = [u, functions.fall(u)]
        outputs.append(functions.fall(outputs[1]))
    except TraceError as error:
        raise FormulaError(f"{energy!r} cannot be differentiated: {error}") from None
    hoisted = Hoisted(outputs[:2], names)
    lines, texts, uses_root = functions.code_of(
        outputs[:2], {index: f"formula.p{k}" for index, k in hoisted.places.items()}
    )
    module = formula_module(
        repr(energy),
        energy_and_force_at,
        "formula, shared, r2, inverse1, inverse2",
        lines,
        f"{texts[0]}, {texts[1]} * inverse2",
        inline=True,
        fields=[f"p{k}" for k in range(len(hoisted.places))] or ["nothing"],
        uses_root=uses_root,
    )
    by_place = {leaf.index: f"p[{k}]" for k, leaf in enumerate(leaves.values())}
    values_at = function_of(outputs, "r, p", known=by_place)

    def numbers_of(parameters: Mapping[str, float]) -> tuple[float, ...]:
        try:
            return tuple(hoisted.values(parameters)) or (0.0,)
        except TraceError:
            raise FormulaError("it has no finite real value") from None

    def radial(parameters: Mapping[str, float]) -> Radial:
        p = [parameters[name] for name in names]

        def value(distance: float) -> tuple[float, float, float]:
            try:
                energy, fall, second = values_at(float(distance), p)
                return energy, fall / distance, -(fall + second) / distance**2
            except (ArithmeticError, ValueError):
                raise FormulaError(
                    f"it has no finite real value at {DISTANCE} = {distance:g} Å"
                ) from None

        return value

    return Formula(energy, tuple(names), numbers_of, radial, module.Formula)


# --- from a function ------------------------------------------------------------------------------

_COUNT = itertools.count()
#: Arguments that a user function may have in addition to the parameters.
ARGUMENTS = ("r", "r2", "inverse")


def formula_of_function(function: Callable, kind: type | None = None) -> Formula:
    """The formula of a function f(p, r) that returns (energy in kJ/mol, -dE/dr in kJ/mol/Å) for the
    parameters p.

    It is compiled for vectors of distances: arithmetic, and exp, log, pow, sin, cos, sqrt, fabs of
    Python's `math`. It may also have arguments named r2 (r²) and inverse (1/r), which save a
    division.
    kind : NamedTuple class of the parameters. Default: the annotation of p. Raises FormulaError.
    """
    function = getattr(function, "py_func", function)
    name = getattr(function, "__name__", "a pair potential")
    if not inspect.isfunction(function):
        raise FormulaError(f"{function!r:.60} is not a function of Python, made by def or lambda")
    arguments = list(inspect.signature(function).parameters.values())
    strange = [one.name for one in arguments[1:] if one.name not in ARGUMENTS]
    if len(arguments) < 2 or strange:
        raise FormulaError(
            f"{name} has the arguments ({', '.join(one.name for one in arguments)}). It needs the"
            " parameters, then r, and may have r2 and inverse"
        )
    if kind is None:
        with contextlib.suppress(
            NameError, SyntaxError, AttributeError, TypeError
        ):  # of annotations that are text
            kind = inspect.get_annotations(function, eval_str=True).get(arguments[0].name)
    if not (isinstance(kind, type) and issubclass(kind, tuple) and getattr(kind, "_fields", ())):
        raise FormulaError(
            f"the parameters of {name} are not known: annotate {arguments[0].name} with a"
            " NamedTuple class"
        )
    formula_class = _class_for(kind, function)
    names_of_distances = [one.name for one in arguments[1:]]

    def called(values: Mapping[str, float], distance: float) -> tuple[float, float]:
        asked = {"r": distance, "r2": distance**2, "inverse": 1 / distance}
        try:
            distances = (asked[name] for name in names_of_distances)
            energy, force = map(float, function(formula_class(**values), *distances))
        except (Exception, SystemExit) as error:  # a user function may raise anything
            raise FormulaError(
                f"{name} at r = {distance:g} Å must give (energy, force), two numbers;"
                f" {describe_error(error)}"
            ) from error
        return energy * KJ_PER_MOL, force * KJ_PER_MOL

    def radial(values: Mapping[str, float]) -> Radial:
        def value(distance: float) -> tuple[float, float, float]:
            energy, force = called(values, distance)
            step = 1e-5 * distance
            slope = (called(values, distance + step)[1] - called(values, distance - step)[1]) / (
                2 * step
            )
            return energy, force, slope

        return value

    return Formula(
        name,
        formula_class._fields,
        lambda values: tuple(values[field] for field in formula_class._fields),
        radial,
        formula_class,
    )


def _class_for(kind: type, function: Callable) -> type:
    """A new class for a function, by which compiled code finds it: with the values that the
    function uses now."""
    module = function.__module__
    name = f"{kind.__qualname__.rpartition('.')[2]}_of_{function.__name__}"
    formula_class = type(
        name, (kind,), {"__module__": module, "__qualname__": name, "uses_root": True}
    )
    formula_class.__name__ = (  # Numba takes classes of one name for one type
        f"{name}_{next(_COUNT)}"
    )
    compiled = compile_user_function(function, inline=True)
    asked = list(inspect.signature(function).parameters)[1:]
    values = {"r": "r2 * inverse1", "r2": "r2", "inverse": "inverse1"}
    source = (
        "def energy_and_force_at(formula, shared, r2, inverse1, inverse2):\n"
        f"    energy, force = function(formula, {', '.join(values[name] for name in asked)})\n"
        f"    return {KJ_PER_MOL!r} * energy, ({KJ_PER_MOL!r} * inverse1) * force"
    )
    names = {"function": compiled}
    exec(source, names)
    implements(energy_and_force_at, formula_class, inline=True)(names["energy_and_force_at"])
    return formula_class


# --- from a table ---------------------------------------------------------------------------------


def formula_of_table(
    distance: Sequence[float],
    energy: Sequence[float],
    cutoff: float,
    force: Sequence[float] | None = None,
    name: str = "a table",
) -> Formula:
    """The formula of energies (kJ/mol) at ascending distances (Å), which must reach from contact to
    the cutoff.

    The table is interpolated by a cubic spline, or by cubics with the given forces -dE/dr
    (kJ/mol/Å) at the distances, and tabulated again at equal steps of r² for the pair loop. The
    force is the derivative of that table. Nearer than the first distance a the energy is E(a) + a
    F(a)/12 ((a/r)¹² - 1), down to a/2, and a straight line in r² below. `error` is the error of the
    spline, which has the order 4, estimated by its difference from one through every second value,
    plus the error of the second table. Raises FormulaError, also for gaps in the table and for
    large errors.
    """
    try:
        r, u = np.asarray(distance, float), np.asarray(energy, float)
        f = None if force is None else np.asarray(force, float)
    except (TypeError, ValueError):
        raise FormulaError(
            f"{name} is two lists of numbers: distances in Å, energies in kJ/mol"
        ) from None
    if (
        r.ndim != 1
        or r.shape != u.shape
        or len(r) < LEAST_ROWS
        or (f is not None and f.shape != r.shape)
    ):
        raise FormulaError(
            f"{name} needs {LEAST_ROWS} distances or more, with one energy each. These are"
            f" {r.shape} and {u.shape}"
        )
    columns = [u] if f is None else [u, f]
    for message in (*value_errors(name, r, *columns), *reach_errors(name, r[0], r[-1], cutoff)):
        raise FormulaError(message)
    _check_intervals(name, r, cutoff)
    size = np.abs(u[u <= 0]).max(initial=0.0) or np.abs(u).max()
    if f is not None:
        _check_forces(name, r, u, f, 10 * size)

    from scipy.interpolate import CubicHermiteSpline, CubicSpline, PPoly  # slow to import

    def interpolated(rows: slice) -> PPoly:
        values = KJ_PER_MOL * u[rows]
        return (
            CubicSpline(r[rows], values)
            if f is None
            else CubicHermiteSpline(r[rows], values, -KJ_PER_MOL * f[rows])
        )

    spline = interpolated(slice(None))
    coarse = interpolated(slice(None, None, 2))
    slope = spline(r[[0, -1]], 1) / (2 * r[[0, -1]])  # by r²
    for message in start_errors(name, r[0], slope[0]):
        raise FormulaError(message)
    square = np.linspace(r[0] ** 2, r[-1] ** 2, STEPS + 1)
    read = CubicSpline(square, spline(np.sqrt(square)), bc_type=((1, slope[0]), (1, slope[1])))
    step = square[1] - square[0]
    middle = np.sqrt(0.5 * (square[1:] + square[:-1]))
    near = middle[spline(middle) < 10 * KJ_PER_MOL * size]
    near = near[near <= r[::2][-1]]
    # of the order of the fourth power of an interval, of the spline and of the one through every
    # second value
    fine, twice = (_interval_at(near, distances) ** 4 for distances in (r, r[::2]))
    error = np.abs((coarse(near) - spline(near)) * fine / (twice - fine)).max(initial=0.0)
    error = float(error + np.abs(read(near**2) - spline(near)).max(initial=0.0)) / (
        KJ_PER_MOL * size
    )
    if error > LARGEST_ERROR:
        raise FormulaError(
            f"{name}: the error of its spline is {error:.2g} of its deepest energy, {size:.3g}"
            f" kJ/mol, must be below {LARGEST_ERROR:g}. Use smaller intervals, and check its rows"
            " for slips"
        )
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
    return Formula(
        text, ("scale",), lambda values: (values["scale"],), radial, Tabulated, table, error
    )


def _interval_at(distance: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Length (k,) of the interval between rows (n,) that contains each distance (k,)."""
    return np.diff(rows)[np.clip(np.searchsorted(rows, distance) - 1, 0, len(rows) - 2)]


def _check_intervals(name: str, r: np.ndarray, cutoff: float) -> None:
    """Raise FormulaError if distances r have a gap before the cutoff, see UNEQUAL."""
    length = np.diff(r)
    ratio = length[1:] / length[:-1]
    begins = [
        0,
        *(np.flatnonzero((ratio > UNEQUAL) | (ratio < 1 / UNEQUAL)) + 1).tolist(),
        len(length),
    ]
    for first, end in itertools.pairwise(begins):
        beside = [length[k] for k in (first - 1, end) if 0 <= k < len(length)]
        if (
            beside
            and end - first < LEAST_ROWS
            and length[first:end].min() > min(beside)
            and r[first] < cutoff
        ):
            k = first + int(length[first:end].argmax())
            raise FormulaError(
                f"{name} has a gap from {r[k]:g} to {r[k + 1]:g} Å, next to intervals of "
                f"{min(beside):.3g} Å: the energy in between is not known. Fill it, or use similar "
                "intervals everywhere"
            )


def _check_forces(name: str, r: np.ndarray, u: np.ndarray, f: np.ndarray, high: float) -> None:
    """Raise FormulaError if forces f are not -du/dr between the rows with energies up to `high`."""
    gained = np.diff(u)
    mean = 0.5 * (f[1:] + f[:-1]) * np.diff(r)
    off = np.where(np.maximum(u[1:], u[:-1]) <= high, np.abs(gained + mean), 0.0)
    k = int(off.argmax())
    if off[k] > WRONG_FORCE * np.abs(gained).max(where=u[:-1] <= high, initial=0.0):
        raise FormulaError(
            f"{name}: the forces are not -dE/dr. From {r[k]:g} to {r[k + 1]:g} Å the energy changes"
            f" by {gained[k]:.4g} kJ/mol, with these forces it would by {-mean[k]:.4g}. Have they"
            " another sign or unit?"
        )
