"""Formulas for pairs of bodies, from NumPy functions whose slopes are derived, or which give force
and torques themselves."""

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from rigidmd.errors import describe_error
from rigidmd.features.potentials.expressions.slopes import (
    Hoisted,
    code_of,
    formula_module,
    function_of,
    slopes_of,
)
from rigidmd.features.potentials.expressions.trace import Graph, Number, Traced, TraceError
from rigidmd.features.potentials.poses.pairs import pair_slopes
from rigidmd.features.potentials.poses.table import BodyTable, TableFormula
from rigidmd.units import KJ_PER_MOL

AXES = "xyz"
#: What a function may return: an energy, or also the force on the second body and both torques.
ENERGY, WITH_FORCES = 1, 4
#: Of the energy of a table with its slopes, about.
TABLE_OPERATIONS = 1800


class PairValues(NamedTuple):
    """Energies (m,) of pairs, their slopes (m, 3) by the vector between both bodies, and the
    torques (m, 3) on both, along the axes of the lab, u Å²/ps²."""

    energy: np.ndarray
    slope: np.ndarray
    torque: np.ndarray
    torque_of_other: np.ndarray


class PoseFormula(NamedTuple):
    """A formula in compiled code."""

    kind: type  # NamedTuple class, which chooses the code
    #: The row of numbers of a pair of kinds, from the parameters of the first and the second.
    numbers: Callable[[Mapping[str, float], Mapping[str, float]], list[float]]
    #: For pairs, in NumPy, from a row of numbers, vectors (m, 3) and rotation matrices (m, 3, 3):
    #: what `pair_slopes` gives; for a table, of a simple function of the same distance and angles.
    values: Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], PairValues]
    operations: int  # in the loop, of the energy with force and torques
    is_derived: bool  # whether force and torques are derived from the energy


def formula_of_poses(
    function: Callable | BodyTable, parameters: Sequence[str] = (), axis: str | None = None
) -> PoseFormula:
    """The formula of a function of two poses.

    function(r, a, b) or function(r, a, b, p, q), see `body_pair_potential`; or a table.

    parameters : names of the parameters of a kind
    axis : x, y or z, a body axis that a and b then are, instead of rotation matrices

    Raises TraceError.
    """
    if isinstance(function, BodyTable):
        row = function.row(axis).tolist()
        alike = formula_of_poses(function.like, (), axis or AXES[-1])
        return alike._replace(
            kind=TableFormula, numbers=lambda first, second: row, operations=TABLE_OPERATIONS
        )
    name = getattr(function, "__name__", "a potential")
    graph = Graph()
    r = np.array([graph.leaf(letter) for letter in AXES], object)
    matrices = [
        np.array([[graph.leaf(f"{body}[{i}, {j}]") for j in range(3)] for i in range(3)], object)
        for body in ("a", "b")
    ]
    poses = matrices if axis is None else [matrix[:, AXES.index(axis)] for matrix in matrices]
    of_kinds = [
        _Parameters({key: graph.leaf(f"{body}.{key}") for key in parameters}) for body in ("p", "q")
    ]
    returned = _called(function, name, [r, *poses], of_kinds)
    if isinstance(returned, tuple):
        outputs = _given(name, returned)
    else:
        outputs = _derived(name, returned, r, matrices)
    names = [f"{body}.{key}" for body in ("p", "q") for key in parameters]
    hoisted = Hoisted(outputs, names)
    places = {index: f"p[{k}]" for index, k in hoisted.places.items()}
    lines, texts = code_of(outputs, places)
    values_at = function_of(outputs, "x, y, z, a, b, p", np, places)
    operations = len(lines)
    lines, (e, gx, gy, gz, tx, ty, tz, ux, uy, uz) = _with_entries(lines, texts)
    vectors = f"({gx}, {gy}, {gz}), ({tx}, {ty}, {tz}), ({ux}, {uy}, {uz})"
    module = formula_module(name, pair_slopes, "formula, p, r, a, b", lines, f"{e}, {vectors}")

    def numbers(first: Mapping[str, float], second: Mapping[str, float]) -> list[float]:
        values = {f"p.{key}": first[key] for key in parameters}
        values |= {f"q.{key}": second[key] for key in parameters}
        return hoisted.values(values)

    def pair_values(row: np.ndarray, r: np.ndarray, a: np.ndarray, b: np.ndarray) -> PairValues:
        matrices = (np.moveaxis(matrix, 0, -1) for matrix in (a, b))
        energy, *vectors = np.broadcast_arrays(*values_at(*r.T, *matrices, row))
        return PairValues(energy, *np.transpose(np.reshape(vectors, (3, 3, -1)), (0, 2, 1)))

    is_derived = not isinstance(returned, tuple)
    return PoseFormula(module.Formula, numbers, pair_values, operations, is_derived)


class _Parameters:
    """The parameters of a body, as attributes."""

    def __init__(self, leaves: Mapping[str, Traced]):
        self._leaves = leaves

    def __getattr__(self, name: str) -> Traced:
        if name not in self._leaves:
            known = ", ".join(self._leaves) or "none"
            raise TraceError(f"no species has the parameter {name}; there are {known}")
        return self._leaves[name]


def _called(function: Callable, name: str, poses: list, of_kinds: list) -> object:
    try:
        count = len(inspect.signature(function).parameters)
    except (TypeError, ValueError):
        count = 0
    if count not in (3, 5):
        raise TraceError(f"{name} must have the arguments (r, a, b) or (r, a, b, p, q)")
    try:
        return function(*poses, *(of_kinds if count == 5 else ()))
    except TraceError:
        raise
    except (Exception, SystemExit) as error:  # a user's function may raise anything
        raise TraceError(f"{name} raised {describe_error(error)}") from error


def _derived(name: str, energy: object, r: np.ndarray, matrices: list[np.ndarray]) -> list[Number]:
    """The energy, its slopes by r, and the torques on both bodies, -dE/d(angle) about the axes of
    the lab, in u Å²/ps²."""
    if isinstance(energy, np.ndarray) and energy.size == 1:
        energy = energy.item()
    if not isinstance(energy, Traced):
        raise TraceError(
            f"{name} returned {energy!r:.60}, must return an energy that depends on r, a or b"
        )
    energy = energy * KJ_PER_MOL
    leaves = [*r, *(entry for matrix in matrices for entry in matrix.ravel())]
    slopes = slopes_of(energy, leaves)
    torques = []
    for k, matrix in enumerate(matrices):
        slope = np.array(slopes[3 + 9 * k : 12 + 9 * k], object).reshape(3, 3)
        columns = [_cross(slope[:, column], matrix[:, column]) for column in range(3)]
        torques += [columns[0][i] + columns[1][i] + columns[2][i] for i in range(3)]
    return [energy, *slopes[:3], *torques]


def _cross(u: np.ndarray, v: np.ndarray) -> list[Number]:
    return [
        u[1] * v[2] - u[2] * v[1],
        u[2] * v[0] - u[0] * v[2],
        u[0] * v[1] - u[1] * v[0],
    ]


def _given(name: str, returned: tuple) -> list[Number]:
    """The same of a function that returns energy, force on the second body, and both torques."""
    shapes = [np.asarray(value, object).shape for value in returned]
    if shapes != [(), (3,), (3,), (3,)]:
        raise TraceError(
            f"{name} returned a tuple of the shapes {shapes}, must return an energy, or a tuple of"
            " the energy, the force (3,) on the second body, and the torques (3,) on the first and"
            " on the second body"
        )
    energy, force, torque, other = returned
    values = [energy, *(-x for x in force), *torque, *other]
    return [value * KJ_PER_MOL for value in values]


def _with_entries(lines: list[str], texts: list[str]) -> tuple[list[str], list[str]]:
    """Lines and texts with the entries of both matrices as names, and first the lines of these."""
    used = set(re.findall(r"[ab]\[\d, \d\]", "\n".join([*lines, *texts])))
    entries = [f"{entry[0]}{entry[2]}{entry[5]} = {entry}" for entry in sorted(used)]

    def short(text: str) -> str:
        return re.sub(r"([ab])\[(\d), (\d)\]", r"\1\2\3", text)

    return ["x, y, z = r", *entries, *map(short, lines)], [*map(short, texts)]
