"""Displacements with the period of a unit cell: the modes of a repeated cell at the Gamma point, k
= 0."""

from math import prod

import numpy as np
from scipy.spatial.distance import cdist

from rigidmd.core.state import State
from rigidmd.engines.system import System
from rigidmd.errors import SceneError, SimulationError

#: Largest difference of equivalent molecules from translated copies, in smallest diameters and
#: radians.
SAME_POSITION, SAME_ROTATION = 1e-2, 1e-2


def cells_of(system: System) -> tuple[int, int, int]:
    """The numbers of unit cells along the edges. Raises SceneError without a repeated cell."""
    scene = system.scene
    if scene.structure is None or not scene.box.periodic:
        why = (
            "needs the unit cell of a crystal: [structure] with file and repeat, in a periodic box"
        )
        raise SceneError(scene.source, [f"the Gamma point {why}"])
    return scene.structure.repeat


def periodic_basis(system: System, state: State, index: np.ndarray) -> np.ndarray:
    """Orthonormal displacements (d, k) that are equal in all unit cells, in mass-weighted
    coordinates.

    Molecules that are translated copies of each other move alike. Their principal axes may be
    chosen differently, as those of linear molecules are: M = Q_j^T Q_i brings body components of
    one to those of another.

    index : (d,) of the coordinates among shifts (3 n) and rotations (3 n), as in
        `normal_modes.Coordinates`
    Raises SceneError without a repeated cell, SimulationError if the crystal lacks the period of
    the unit cell.
    """
    n = len(state.position)
    rotates = len(state.rotation) > 0
    groups = _translated_copies(system, state)
    place = np.full(6 * n, -1)
    place[index] = np.arange(len(index))
    columns = []
    for group in groups:
        first = group[0]
        moments = system.model.inverse_inertia[system.model.species[group[0]]]
        root = np.where(moments > 0, 1 / np.sqrt(np.where(moments > 0, moments, 1.0)), 0.0)
        for k in range(3):
            if place[3 * first + k] >= 0:
                column = np.zeros(len(index))
                column[place[3 * group + k]] = 1.0
                columns.append(column)
        for k in range(3):
            if not rotates or place[3 * (n + first) + k] < 0:
                continue
            column = np.zeros(len(index))
            angle = np.eye(3)[k] / root[k]
            for j in group:
                turned = root * (state.rotation[j].T @ state.rotation[first] @ angle)
                there = place[3 * (n + j) : 3 * (n + j) + 3]
                column[there[there >= 0]] = turned[there >= 0]
            columns.append(column)
    basis = np.array(columns).T
    return basis / np.linalg.norm(basis, axis=0)


def _translated_copies(system: System, state: State) -> list[np.ndarray]:
    """Indices of the molecules that are copies of each other by unit-cell translations. Raises
    SceneError, SimulationError."""
    repeat = np.array(cells_of(system))
    in_cells = state.position @ np.linalg.inv(state.cell) * repeat
    unit_cell = state.cell / repeat[:, None]
    left = np.arange(len(in_cells))
    groups = []
    species = system.model.species
    while len(left):
        apart = in_cells[left] - in_cells[left[0]]
        off = np.linalg.norm((apart - np.round(apart)) @ unit_cell, axis=1)
        alike = (off <= SAME_POSITION * system.smallest_diameter) & (
            species[left] == species[left[0]]
        )
        groups.append(left[alike])
        left = left[~alike]
    if any(len(group) != prod(repeat) for group in groups):
        sizes = ", ".join(map(str, sorted({len(group) for group in groups})))
        raise SimulationError(
            "at its minimum the crystal does not have the period of its unit cell: of"
            f" {prod(repeat)} copies of a molecule {sizes} are at equal positions. Its modes at the"
            " Gamma point belong to a larger cell"
        )
    for group in groups if len(state.rotation) else []:
        for j in group[1:]:
            _check_same_orientation(system, state, group[0], j)
    return groups


def _check_same_orientation(system: System, state: State, first: int, other: int) -> None:
    """Raise SimulationError unless the sites of two copies coincide after a translation."""
    molecule = system.species[system.model.species[first]]
    kind = np.unique(
        np.column_stack([molecule.masses, molecule.charges, molecule.sigma, molecule.epsilon]),
        axis=0,
        return_inverse=True,
    )[1].ravel()
    here = molecule.positions_body @ state.rotation[first].T
    there = molecule.positions_body @ state.rotation[other].T
    distance = cdist(here, there) + np.where(kind[:, None] == kind, 0.0, np.inf)
    if distance.min(axis=1).max() > SAME_ROTATION * max(molecule.radius, system.smallest_diameter):
        raise SimulationError(
            f"molecules {first + 1} and {other + 1} are at equal positions in their unit cells and"
            " have different orientations: the crystal lacks the period of its unit cell, so it"
            " has no modes at its Gamma point"
        )
