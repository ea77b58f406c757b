"""The longest stable time step, estimated before the first step from the stiffest motion of a
state."""

from math import sqrt
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rigidmd.core.state import Load, State
from rigidmd.engines.protocol import Engine
from rigidmd.mechanics.rotation import from_vector

if TYPE_CHECKING:
    from rigidmd.engines.system import System

#: Force evaluations for the stiffest motion; its frequency is then exact to a few percent.
DIRECTIONS = 16
#: Displacement for a difference of forces, in smallest diameters.
DISPLACEMENT = 1e-5
#: Most molecules that are displaced: the stiffest motion is local, and each direction takes 48 B
#: per molecule.
MOST_DISPLACED = 50_000
#: Molecules above which the estimate is made only if it costs less than 1 % of the stage.
SMALL_SYSTEM = 1000


class StiffestMode(NamedTuple):
    """The fastest small motion about a state."""

    rate: float  # angular frequency, rad/ps
    molecule: int  # with the largest part in it


def stiffest_mode(
    system: "System", state: State, engine: Engine | None = None
) -> StiffestMode | None:
    """The fastest small motion of all molecules together. None if no restoring force acts.

    The largest eigenvalue of the mass-weighted force differences, in the Krylov space of one random
    vector (Arnoldi). The state is unchanged. Each of `DIRECTIONS` directions takes one force
    evaluation. In large systems only a slab of `MOST_DISPLACED` molecules moves.

    engine : of this system. A new one if not given
    """
    model, engine = system.model, engine or system.engine()
    moving = np.arange(len(state.position))
    if len(moving) > MOST_DISPLACED:
        moving = np.sort(
            np.argpartition(system.centres(state, wrapped=True)[:, 0], MOST_DISPLACED)[
                :MOST_DISPLACED
            ]
        )
    rotating = moving[: len(state.rotation)]
    mass = np.sqrt(model.inverse_mass[model.species[moving]])[:, None]
    inertia = np.sqrt(model.inverse_inertia[model.species[rotating]])
    radius = np.array([m.radius for m in system.species])[model.species[rotating], None]

    def weighted(load: Load) -> np.ndarray:
        return np.concatenate(
            [(mass * load.force[moving]).ravel(), (inertia * load.torque_body[rotating]).ravel()]
        )

    here, moved = weighted(engine.evaluate(state)[0]), state.copy()
    vector = np.random.default_rng(0).standard_normal(here.size)
    vector *= np.concatenate([np.repeat(mass, 3), inertia.ravel()]) > 0
    basis, matrix = [vector / sqrt(_product(vector, vector))], np.zeros((DIRECTIONS, DIRECTIONS))
    for k in range(DIRECTIONS):
        shift, rotation = (part.reshape(-1, 3) for part in np.split(basis[k], [3 * len(moving)]))
        shift, rotation = mass * shift, inertia * rotation
        reach = max(np.abs(shift).max(initial=0.0), np.abs(radius * rotation).max(initial=0.0))
        h = DISPLACEMENT * system.smallest_diameter / reach
        moved.position[moving] = state.position[moving] + h * shift
        if len(rotation):
            moved.rotation[rotating] = state.rotation[rotating] @ from_vector(h * rotation)
        image = (here - weighted(engine.evaluate(moved)[0])) / h
        for j, other in enumerate(basis):
            matrix[j, k] = _product(other, image)
            image = image - matrix[j, k] * other
        size = sqrt(_product(image, image))
        if k + 1 == DIRECTIONS or not size > 1e-6 * np.abs(matrix).max():
            break
        matrix[k + 1, k] = size
        basis.append(image / size)
    matrix = matrix[: len(basis), : len(basis)]
    if not np.isfinite(matrix).all():
        return None
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    if values[-1] <= 0:
        return None
    mode = np.einsum("k,kn", vectors[:, -1], np.array(basis)) ** 2
    part = mode[: 3 * len(moving)].reshape(-1, 3).sum(axis=1)
    part[: len(rotating)] += mode[3 * len(moving) :].reshape(-1, 3).sum(axis=1)
    return StiffestMode(sqrt(values[-1]), int(moving[part.argmax()]))


def _product(a: np.ndarray, b: np.ndarray) -> float:
    """Scalar product of long vectors. `a @ b` would start threads that then spin on cores that a
    run needs."""
    return float(np.einsum("i,i", a, b))
