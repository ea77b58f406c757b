"""Homogeneous solids, bodies made of several, and the added mass of an ellipsoid in a fluid, in any
consistent units."""

from collections.abc import Mapping, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike


class Solid(NamedTuple):
    """A homogeneous solid: principal moments `inertia` (3,) and points `outline` (k, 3) to draw,
    body frame."""

    inertia: np.ndarray
    outline: np.ndarray


class Shape(NamedTuple):
    """A kind of solid with all dimensions equal to 1, which are scaled along the axes 1, 2, 3 of
    its principal frame. Axis 3 is the axis of symmetry, and the origin is the centre of mass.

    dimensions: the axes (0, 1, 2) that each dimension scales, by the name of the dimension in a
    scene. The solid is thin along an axis without a dimension. mean_squares (3,): <x²>, <y²>, <z²>
    over its mass. outline (k, 3): points on its surface. volume: 0 for a thin solid.
    """

    dimensions: dict[str, list[int]]
    mean_squares: tuple[float, float, float]
    outline: np.ndarray
    volume: float

    def scale(self, dimensions: Mapping[str, float | Sequence[float]]) -> np.ndarray:
        """Factors (3,) of the unit solid along its axes, 0 along an axis without a dimension."""
        factors = np.zeros(3)
        for name, axes in self.dimensions.items():
            factors[axes] = dimensions[name]
        return factors


#: Number of components of each dimension.
COMPONENTS_PER_DIMENSION = {
    "radius_m": 1,
    "height_m": 1,
    "length_m": 1,
    "lengths_m": 3,
    "semi_axes_m": 3,
}


def _outline(*rings: tuple[int, float, float]) -> np.ndarray:
    """Points (k, 3) of all rings (count, radius, z), evenly spaced on circles about axis 3 at
    height z. A ring of one point with radius 0 is a tip or a centre."""
    points = []
    for count, radius, z in rings:
        angle = 2 * np.pi * np.arange(count) / count
        points.append(
            np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, z)], axis=-1)
        )
    return np.concatenate(points)


_BALL = _outline(
    (1, 0, -1), (8, 0.5**0.5, -(0.5**0.5)), (8, 1, 0), (8, 0.5**0.5, 0.5**0.5), (1, 0, 1)
)
#: Shapes by name. A cone points down, with its tip at z = -3/4 height, so that a top stands on it.
SOLIDS = {
    "cylinder": Shape(
        {"radius_m": [0, 1], "height_m": [2]},
        (1 / 4, 1 / 4, 1 / 12),
        _outline((1, 0, -0.5), (12, 1, -0.5), (12, 1, 0.5), (1, 0, 0.5)),
        np.pi,
    ),
    "cone": Shape(
        {"radius_m": [0, 1], "height_m": [2]},
        (3 / 20, 3 / 20, 3 / 80),
        _outline((1, 0, -0.75), (8, 0.5, -0.25), (16, 1, 0.25), (1, 0, 0.25)),
        np.pi / 3,
    ),
    "sphere": Shape({"radius_m": [0, 1, 2]}, (1 / 5, 1 / 5, 1 / 5), _BALL, 4 / 3 * np.pi),
    "cuboid": Shape(
        {"lengths_m": [0, 1, 2]},
        (1 / 12, 1 / 12, 1 / 12),
        np.array([point for point in product([-0.5, 0, 0.5], repeat=3) if any(point)]),
        1.0,
    ),
    "ellipsoid": Shape({"semi_axes_m": [0, 1, 2]}, (1 / 5, 1 / 5, 1 / 5), _BALL, 4 / 3 * np.pi),
    "disk": Shape(
        {"radius_m": [0, 1]}, (1 / 4, 1 / 4, 0), _outline((1, 0, 0), (8, 0.5, 0), (16, 1, 0)), 0.0
    ),
    "ring": Shape({"radius_m": [0, 1]}, (1 / 2, 1 / 2, 0), _outline((24, 1, 0)), 0.0),
    "rod": Shape(
        {"length_m": [2]},
        (0, 0, 1 / 12),
        _outline(*((1, 0, z) for z in np.linspace(-0.5, 0.5, 13))),
        0.0,
    ),
}


def solid(shape: str, mass: float, dimensions: Mapping[str, float | Sequence[float]]) -> Solid:
    """The homogeneous solid of this mass.

    shape : a key of SOLIDS
    dimensions : all dimensions of that shape, each with COMPONENTS_PER_DIMENSION numbers
    """
    unit = SOLIDS[shape]
    scale = unit.scale(dimensions)
    spread = mass * scale**2 * unit.mean_squares
    return Solid(spread[[1, 2, 0]] + spread[[2, 0, 1]], unit.outline * scale)


def added_mass_of_ellipsoid(semi_axes: ArrayLike, density: float) -> tuple[np.ndarray, np.ndarray]:
    """Added mass (3,) and added inertia (3,) along and about the axes of an ellipsoid in an ideal
    fluid at rest.

    semi_axes (3,), all positive. Density of the fluid. See the theory chapter `bodies` (Lamb, art.
    114-115). Lamb's differences are written as integrals of one sign, (b² - c²)² near/(alpha + 2
    far), which has no cancellation for nearly equal axes.
    """
    from scipy.special import elliprd  # slow to import, and other solids do not need it

    axes = np.asarray(semi_axes, dtype=float)
    following, last = axes[[1, 2, 0]], axes[[2, 0, 1]]
    a, b, c = axes**2, following**2, last**2
    alpha = 2 / 3 * axes.prod() * elliprd(b, c, a)
    # The trapezoidal rule in log l is exact to rounding: the integrands are analytic in a strip of
    # ± pi about the real axis of log l, and decay as powers of l at both ends, to below 1e-16 at
    # these limits.
    step = 0.4
    l = np.exp(np.arange(np.log(a.min()) - 40, np.log(a.max()) + 30, step))[:, None]  # noqa: E741
    weight = step * l * axes.prod() / (np.sqrt(a + l) * ((b + l) * (c + l)) ** 1.5)
    near = weight.sum(axis=0)
    far = (l * weight).sum(axis=0)
    displaced = 4 / 3 * np.pi * density * axes.prod()
    added_mass = displaced * alpha / (alpha[[1, 2, 0]] + alpha[[2, 0, 1]])
    difference = (following - last) * (following + last)
    return added_mass, displaced / 5 * difference**2 * near / (alpha + 2 * far)
