"""Energies of pairs of linear bodies as a table over their distance and three angles.

A file .npz has the arrays r_A, theta_1_deg, theta_2_deg, phi_deg, each evenly spaced, and
energy_kJ_mol of the shape of all four. theta_1 and theta_2 are the angles of the axes of the first
and the second body with the vector from the first to the second, phi is the dihedral angle of the
axes about it; angles run from 0 to 180. Between the points the energy is a product of cubic
convolutions, which has continuous slopes (Keys 1981, IEEE Trans. Acoust. 29, 1153); at shorter
distances the parabola through the first three points is continued, which must rise.
"""

from collections.abc import Iterator
from math import acos, sqrt
from pathlib import Path
from typing import NamedTuple
from zipfile import BadZipFile

import numpy as np

from rigidmd.compile import implements, kernel
from rigidmd.features.potentials.expressions.trace import Number
from rigidmd.features.potentials.poses.pairs import pair_slopes
from rigidmd.features.potentials.tables import start_errors, value_errors
from rigidmd.units import KJ_PER_MOL

GRID = ("r_A", "theta_1_deg", "theta_2_deg", "phi_deg")
ENERGY = "energy_kJ_mol"
FEWEST = 4  # points along an edge of the grid
#: Tolerance of equal energies, relative to the largest one, and of even steps, relative to a step.
SAME, EVEN = 1e-6, 1e-6
#: Numbers of a row before the energies: first distance and inverse step, numbers of points, axis.
HEAD = 7
#: Smallest sine in a denominator.
SMALLEST = 1e-9


class BodyTable(NamedTuple):
    """A table in memory."""

    first: float  # Å
    last: float  # Å
    energy: np.ndarray  # (r, theta_1, theta_2, phi) u Å²/ps²

    def row(self, axis: str | None) -> np.ndarray:
        """The numbers for `TableFormula`, of bodies with an axis x, y or z. Energies have one more
        layer at each side: even in the angles, a parabola in r."""
        energy = np.pad(self.energy, [(0, 0), (1, 1), (1, 1), (1, 1)], mode="reflect")
        before, after = (
            3 * energy[a] - 3 * energy[b] + energy[c] for a, b, c in ((0, 1, 2), (-1, -2, -3))
        )
        energy = np.concatenate([before[None], energy, after[None]])
        points = self.energy.shape
        step = (self.last - self.first) / (points[0] - 1)
        head = [self.first, 1 / step, *points, "xyz".index(axis or "z")]
        return np.concatenate([head, energy.ravel()])

    def like(self, r: np.ndarray, u: np.ndarray, v: np.ndarray) -> Number:
        """A simple energy of the distance, and of the angles if the table depends on them: its
        torques have the same directions."""
        energy = r @ r
        if np.ptp(self.energy, axis=(1, 2, 3)).max() > SAME * np.abs(self.energy).max():
            energy = energy * (1 + u @ r + v @ r + u @ v)
        return energy


class TableFormula(NamedTuple):
    """The formula of tables: `pair_slopes` of it reads the row of a `BodyTable`."""

    nothing: float = 0.0


def read_body_table(path: Path) -> BodyTable:
    """The table of a file. Raises ValueError with what is wrong."""
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: np.asarray(file[name], float) for name in file.files}
    except (OSError, ValueError, TypeError, AttributeError, EOFError, BadZipFile) as error:
        raise ValueError(f"{path.name} is not an .npz file of numbers: {error}") from None
    for message in _errors(path.name, arrays):
        raise ValueError(message)
    first, last = arrays["r_A"][[0, -1]].tolist()
    return BodyTable(first, last, arrays[ENERGY] * KJ_PER_MOL)


def _errors(file: str, arrays: dict[str, np.ndarray]) -> Iterator[str]:
    if missing := [name for name in (*GRID, ENERGY) if name not in arrays]:
        yield f"{file}: it has no array {missing[0]}; it needs {', '.join(GRID)} and {ENERGY}"
    for name in GRID:
        points = arrays[name]
        steps = np.diff(points) if points.ndim == 1 else np.zeros(0)
        if len(steps) < FEWEST - 1 or not steps[0] > 0 or np.ptp(steps) > EVEN * steps[0]:
            yield f"{file}: {name} must have {FEWEST} points or more in even ascending steps"
        if name != "r_A" and not np.allclose(points[[0, -1]], [0, 180]):
            yield f"{file}: {name} must run from 0 to 180"
    energy = arrays[ENERGY]
    shape = tuple(len(arrays[name]) for name in GRID)
    if energy.shape != shape:
        yield f"{file}: {ENERGY} has the shape {energy.shape}, must have {shape}"
    yield from value_errors(file, arrays["r_A"], energy)
    tolerance = SAME * np.abs(energy).max()
    for ends in (energy[:, [0, -1]], energy[:, :, [0, -1]]):
        if np.ptp(ends, axis=-1).max() > tolerance:
            yield f"{file}: the energy depends on phi where an axis is along the vector"
    exchanged = energy[:, ::-1, ::-1].swapaxes(1, 2)
    if exchanged.shape != shape or np.abs(exchanged - energy).max() > tolerance:
        why = "energy(theta_1, theta_2) must be energy(180 - theta_2, 180 - theta_1)"
        yield f"{file}: an exchange of both bodies changes the energy: {why}"
    yield from _start_errors(file, arrays)


def _start_errors(file: str, arrays: dict[str, np.ndarray]) -> Iterator[str]:
    """A message if the energy attracts at the first distance, or nearer, where the parabola through
    the first three points continues it."""
    r = arrays["r_A"]
    first, second, third = arrays[ENERGY][:3]
    curvature = first - 2 * second + third
    slope = second - first - curvature / 2  # by the distance in steps, at the first point
    slope = np.maximum(slope, slope - curvature * r[0] / (r[1] - r[0]))  # and at 0
    steepest = np.unravel_index(slope.argmax(), slope.shape)
    angles = [
        f"{name.removesuffix('_deg')} = {arrays[name][k]:g}°"
        for name, k in zip(GRID[1:], steepest, strict=True)
    ]
    yield from start_errors(file, r[0], slope[steepest], f" at {', '.join(angles)}")


@kernel(inline=True)
def _cell(x, points):
    """The cell of a coordinate in steps of a grid, and the position in it."""
    cell = min(max(int(x), 0), points - 2)
    return cell, x - cell


@kernel(inline=True)
def _weights(t):
    """Weights of four points of a cubic convolution, and their slopes."""
    square = t * t
    weights = (
        0.5 * t * (2 * t - 1 - square),
        1 + 0.5 * square * (3 * t - 5),
        0.5 * t * (1 + 4 * t - 3 * square),
        0.5 * square * (t - 1),
    )
    slopes = (
        2 * t - 0.5 - 1.5 * square,
        4.5 * square - 5 * t,
        0.5 + 4 * t - 4.5 * square,
        1.5 * square - t,
    )
    return weights, slopes


@kernel
def _interpolated(p, r, first_angle, second_angle, dihedral):
    """Energy, and its slopes by distance and angles."""
    i, x = _cell((r - p[0]) * p[1], int(p[2]))
    per_1, per_2, per_3 = (p[3] - 1) / np.pi, (p[4] - 1) / np.pi, (p[5] - 1) / np.pi
    j, y = _cell(first_angle * per_1, int(p[3]))
    k, z = _cell(second_angle * per_2, int(p[4]))
    l, w = _cell(dihedral * per_3, int(p[5]))  # noqa: E741
    of_r, slope_r = _weights(x)
    of_1, slope_1 = _weights(y)
    of_2, slope_2 = _weights(z)
    of_3, slope_3 = _weights(w)
    rows_1, rows_2, rows_3 = int(p[3]) + 2, int(p[4]) + 2, int(p[5]) + 2
    energy = by_r = by_1 = by_2 = by_3 = 0.0
    for a in range(4):
        for b in range(4):
            for c in range(4):
                at = HEAD + (((i + a) * rows_1 + j + b) * rows_2 + k + c) * rows_3 + l
                value = slope = 0.0
                for d in range(4):
                    value += of_3[d] * p[at + d]
                    slope += slope_3[d] * p[at + d]
                energy += of_r[a] * of_1[b] * of_2[c] * value
                by_r += slope_r[a] * of_1[b] * of_2[c] * value
                by_1 += of_r[a] * slope_1[b] * of_2[c] * value
                by_2 += of_r[a] * of_1[b] * slope_2[c] * value
                by_3 += of_r[a] * of_1[b] * of_2[c] * slope
    return energy, by_r * p[1], by_1 * per_1, by_2 * per_2, by_3 * per_3


@kernel(inline=True)
def _dot(u, v):
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@kernel(inline=True)
def _combined(a, u, b, v):
    return a * u[0] + b * v[0], a * u[1] + b * v[1], a * u[2] + b * v[2]


@kernel(inline=True)
def _cross(u, v):
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@kernel(inline=True)
def _limited(cosine):
    return min(max(cosine, -1.0), 1.0)


@implements(pair_slopes, TableFormula)
def _of_table(formula, p, r, a, b):
    axis = int(p[6])
    distance = sqrt(_dot(r, r))
    n = (r[0] / distance, r[1] / distance, r[2] / distance)
    u, v = (a[0, axis], a[1, axis], a[2, axis]), (b[0, axis], b[1, axis], b[2, axis])
    c, d, e = _limited(_dot(u, n)), _limited(_dot(v, n)), _dot(u, v)
    s, t = max(sqrt(1 - c * c), SMALLEST), max(sqrt(1 - d * d), SMALLEST)
    cosine = _limited((e - c * d) / (s * t))
    sine = max(sqrt(1 - cosine * cosine), SMALLEST)
    energy, by_r, by_1, by_2, by_3 = _interpolated(p, distance, acos(c), acos(d), acos(cosine))
    # by the cosines c, d, e
    turned = -by_3 / sine
    of_e = turned / (s * t)
    of_c = -by_1 / s + turned * (cosine * c / (s * s) - d / (s * t))
    of_d = -by_2 / t + turned * (cosine * d / (t * t) - c / (s * t))
    along = by_r - (of_c * c + of_d * d) / distance
    across = _combined(of_c / distance, u, of_d / distance, v)
    slope = _combined(along, n, 1.0, across)
    torque = _cross(_combined(of_c, n, of_e, v), u)
    return energy, slope, torque, _cross(_combined(of_d, n, of_e, u), v)
