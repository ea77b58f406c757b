"""The shapes of bodies with potentials of two bodies: ellipsoids, and spheres with a patch."""

from collections.abc import Iterator

import numpy as np

from rigidmd.engines.system import System
from rigidmd.features.potentials.poses.bodies import BodiesOfPotential, bodies_of_potentials
from rigidmd.features.potentials.poses.gay_berne import GayBerne
from rigidmd.features.potentials.poses.patch import Patch

BALL, PATCH = np.array([0.72, 0.76, 0.82]), np.array([0.85, 0.35, 0.20])
#: A patch is a smaller sphere off the centre of the ball: both in the radius of the ball.
PATCH_RADIUS, PATCH_OFFSET = 0.9, 0.2


def shapes_of(system: System) -> Iterator[tuple[str, list[tuple]]]:
    """For each species whose potential has a shape its name, and its ellipsoids: see
    `feature.Feature.shapes`."""
    drawn: set[str] = set()
    for bodies in bodies_of_potentials(system):
        name = bodies.species.name
        if name not in drawn and type(bodies.potential.function) in (GayBerne, Patch):
            drawn.add(name)
            yield name, [row for m in bodies.molecule.tolist() for row in _ellipsoids(bodies, m)]


def _ellipsoids(bodies: BodiesOfPotential, m: int) -> Iterator[tuple]:
    potential, offset = bodies.potential, bodies.reference
    values = potential.parameters[bodies.species.name]
    k = "xyz".index(potential.axis or "z")
    frame = bodies.frame[:, [k - 2, k - 1, k]]
    if isinstance(potential.function, Patch):
        radius = values["sigma_A"] / 2
        moved = offset + PATCH_OFFSET * radius * frame[:, 2]
        yield m, offset, frame, [radius] * 3, BALL
        yield m, moved, frame, [PATCH_RADIUS * radius] * 3, PATCH
    else:
        wide, long = values["width_A"] / 2, values["length_A"] / 2
        yield m, offset, frame, [wide, wide, long], np.full(3, np.nan)
