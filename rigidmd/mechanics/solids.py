"""Homogeneous solids by name: principal moments, an outline to draw, and the added mass of an ellipsoid in a fluid.

Every solid is a shape of unit size, scaled along the axes 1, 2, 3 of its principal frame. Axis 3 is the axis of
symmetry, and the origin is the centre of mass. Any consistent units may be used.
"""

from collections.abc import Mapping, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike


class Solid(NamedTuple):
    """A homogeneous solid: principal moments `inertia` (3,) and points `outline` (k, 3) to draw, body frame."""

    inertia: np.ndarray
    outline: np.ndarray


class Shape(NamedTuple):
    """A kind of solid with all dimensions equal to 1.

    dimensions: the axes (0, 1, 2) that each dimension scales, by the name of the dimension in a scene; the solid is
    thin along an axis without a dimension. mean_squares (3,): <x²>, <y²>, <z²> over its mass. outline (k, 3): points on
    its surface.
    """

    dimensions: dict[str, list[int]]
    mean_squares: tuple[float, float, float]
    outline: np.ndarray


#: Number of components of each dimension.
COMPONENTS_PER_DIMENSION = {"radius_m": 1, "height_m": 1, "length_m": 1, "lengths_m": 3, "semi_axes_m": 3}


def _ring(count: int, radius: float, z: float) -> np.ndarray:
    """Points (count, 3), evenly spaced on a circle of this radius about axis 3 at height z."""
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, z)], axis=-1)


def _outline(*rings: tuple[int, float, float]) -> np.ndarray:
    """Points (k, 3) of all rings (count, radius, z); a ring of one point with radius 0 is a tip or a centre."""
    return np.concatenate([_ring(*ring) for ring in rings])


_BALL = _outline((1, 0, -1), (8, 0.5**0.5, -(0.5**0.5)), (8, 1, 0), (8, 0.5**0.5, 0.5**0.5), (1, 0, 1))

#: Shapes by name. A cone points down, with its tip at z = -3/4 height, so that a top stands on it.
SOLIDS = {
    "cylinder": Shape(
        {"radius_m": [0, 1], "height_m": [2]},
        (1 / 4, 1 / 4, 1 / 12),
        _outline((1, 0, -0.5), (12, 1, -0.5), (12, 1, 0.5), (1, 0, 0.5)),
    ),
    "cone": Shape(
        {"radius_m": [0, 1], "height_m": [2]},
        (3 / 20, 3 / 20, 3 / 80),
        _outline((1, 0, -0.75), (8, 0.5, -0.25), (16, 1, 0.25), (1, 0, 0.25)),
    ),
    "sphere": Shape({"radius_m": [0, 1, 2]}, (1 / 5, 1 / 5, 1 / 5), _BALL),
    "cuboid": Shape(
        {"lengths_m": [0, 1, 2]},
        (1 / 12, 1 / 12, 1 / 12),
        np.array([point for point in product([-0.5, 0, 0.5], repeat=3) if any(point)]),
    ),
    "ellipsoid": Shape({"semi_axes_m": [0, 1, 2]}, (1 / 5, 1 / 5, 1 / 5), _BALL),
    "disk": Shape({"radius_m": [0, 1]}, (1 / 4, 1 / 4, 0), _outline((1, 0, 0), (8, 0.5, 0), (16, 1, 0))),
    "ring": Shape({"radius_m": [0, 1]}, (1 / 2, 1 / 2, 0), _outline((24, 1, 0))),
    "rod": Shape({"length_m": [2]}, (0, 0, 1 / 12), _outline(*((1, 0, z) for z in np.linspace(-0.5, 0.5, 13)))),
}


def solid(shape: str, mass: float, dimensions: Mapping[str, float | Sequence[float]]) -> Solid:
    """The homogeneous solid of this mass.

    shape : a key of SOLIDS
    dimensions : all dimensions of that shape, each with COMPONENTS_PER_DIMENSION numbers
    """
    unit = SOLIDS[shape]
    scale = np.zeros(3)
    for name, axes in unit.dimensions.items():
        scale[axes] = dimensions[name]
    spread = mass * scale**2 * unit.mean_squares
    return Solid(spread[[1, 2, 0]] + spread[[2, 0, 1]], unit.outline * scale)


def added_mass_of_ellipsoid(semi_axes: ArrayLike, density: float) -> tuple[np.ndarray, np.ndarray]:
    """Added mass (3,) and added inertia (3,) along and about the axes of an ellipsoid in an ideal fluid at rest.

    semi_axes (3,), all positive; density of the fluid. H. Lamb, Hydrodynamics (6th ed. 1932), art. 114-115, with
    alpha_i = abc ∫ dl / ((a_i² + l) Delta), whose sum is 2. Lamb's differences are written as integrals of one sign:
    gamma - beta = (b² - c²) near and 2 (b² - c²) + (b² + c²) (beta - gamma) = (b² - c²) (alpha + 2 far), so that
    (b² - c²)² near / (alpha + 2 far) is not 0/0 for equal axes, and has no cancellation for nearly equal ones.
    """
    from scipy.special import elliprd  # slow to import, and other solids do not need it

    axes = np.asarray(semi_axes, dtype=float)
    following, last = axes[[1, 2, 0]], axes[[2, 0, 1]]
    a, b, c = axes**2, following**2, last**2
    alpha = 2 / 3 * axes.prod() * elliprd(b, c, a)
    # The trapezoidal rule in log l is exact to rounding: the integrands are analytic in a strip of ± pi about the real
    # axis of log l, and decay as powers of l at both ends, to below 1e-16 at these limits.
    step = 0.4
    l = np.exp(np.arange(np.log(a.min()) - 40, np.log(a.max()) + 30, step))[:, None]  # noqa: E741
    weight = step * l * axes.prod() / (np.sqrt(a + l) * ((b + l) * (c + l)) ** 1.5)
    near, far = weight.sum(axis=0), (l * weight).sum(axis=0)
    displaced = 4 / 3 * np.pi * density * axes.prod()
    added_mass = displaced * alpha / (alpha[[1, 2, 0]] + alpha[[2, 0, 1]])
    difference = (following - last) * (following + last)
    return added_mass, displaced / 5 * difference**2 * near / (alpha + 2 * far)
