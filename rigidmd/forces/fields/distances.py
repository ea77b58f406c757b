"""A harmonic restraint on the distance between two molecules, or between the centres of mass of two
groups."""

from math import sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.compile import implements, kernel
from rigidmd.core.state import OK, State
from rigidmd.forces.neighbors.space import nearest_image
from rigidmd.forces.parts import SystemParts
from rigidmd.forces.terms import add_forces
from rigidmd.scene.fields import Restraint
from rigidmd.units import BOLTZMANN, KJ_PER_MOL

#: A distance of half the box, where the force jumps, has to cost this many kT at least.
LEAST_BARRIER = 15.0


class DistanceRestraint(NamedTuple):
    """U = stiffness/2 (r - distance)², with r from the centre of one group to the nearest image of
    the other centre.

    The members of a group are taken at the images nearest to its first molecule. The force on a
    group acts on its members by their fractions of its mass, without torques, and the total
    momentum does not change.
    """

    first: np.ndarray  # (a,) int64, molecules of a group
    second: np.ndarray  # (b,)
    first_fraction: np.ndarray  # (a,) of the mass of the group
    second_fraction: np.ndarray  # (b,)
    distance: float  # Å
    stiffness: float  # u/ps²

    def observed_distance(self, observation) -> float:
        """The distance r of the groups in an `Observation`, Å."""
        state = observation.state
        start, end = (
            _centre_in(state, *group)
            for group in ((self.first, self.first_fraction), (self.second, self.second_fraction))
        )
        return float(np.linalg.norm(nearest_images(end - start, state.cell)))


def nearest_images(vectors: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) to nearest images in a cell (3, 3), exact up to half its smallest height.
    Unchanged if its edges are infinite."""
    images = np.array(vectors, float)
    if np.isfinite(cell[0, 0]):
        for k in (2, 1, 0):
            images -= np.rint(images[..., k, None] / cell[k, k]) * cell[k]
    return images


def _centre_in(state: State, members: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    origin = state.position[members[0]]
    return origin + fraction @ nearest_images(state.position[members] - origin, state.cell)


def distance_restraint(
    parts: SystemParts, entry: Restraint, where: str, errors: list[str]
) -> DistanceRestraint | None:
    """The term of one of fields.restraints with `between`."""
    state = parts.state
    n = len(parts.model.species)
    before = len(errors)
    groups = [np.array(group) - 1 for group in entry.groups]
    if largest := [int(group.max()) + 1 for group in groups if group.max() >= n]:
        errors.append(f"{where}.between: molecule {largest[0]} does not exist; there are 1 to {n}")
        return None
    if any(len(np.unique(group)) < len(group) for group in groups) or np.isin(*groups).any():
        errors.append(f"{where}.between: a molecule is named twice")
    if not any(parts.moves[parts.model.species[group]].any() for group in groups):
        errors.append(f"{where} would have no effect: all its molecules are frozen")
    mass = [parts.model.mass[parts.model.species[group]] for group in groups]
    fractions = [of / of.sum() for of in mass]
    restraint = DistanceRestraint(
        *groups, *fractions, entry.distance_A, entry.stiffness[0] * KJ_PER_MOL
    )
    if np.isfinite(state.cell[0, 0]):
        errors += _faults_in_box(restraint, parts, where)
    return restraint if len(errors) == before else None


def _faults_in_box(term: DistanceRestraint, parts: SystemParts, where: str) -> list[str]:
    """Messages on a distance or a group that is too long for the box."""
    cell = parts.state.cell
    half = 0.5 / float(np.linalg.norm(np.linalg.inv(cell), axis=0).max())
    temperatures = [parts.scene.start.temperature_K or 0.0]
    temperatures += [value or 0.0 for stage in parts.scene.stages for value in stage.temperatures]
    barrier = 0.5 * term.stiffness * max(0.0, half - term.distance) ** 2
    errors = []
    if barrier <= LEAST_BARRIER * BOLTZMANN * max(temperatures):
        errors.append(
            f"{where}.distance_A = {term.distance:g}: the distance may come near half the smallest"
            f" height of the box, {half:.6g} Å, where the nearest image changes. Use a larger box"
            " or a higher stiffness_kJ_mol_A2"
        )
    for group in (term.first, term.second):
        arms = nearest_images(parts.state.position[group] - parts.state.position[group[0]], cell)
        if (longest := float(np.linalg.norm(arms, axis=1).max())) > 0.5 * half:
            errors.append(
                f"{where}.between: molecules of a group are {longest:.3g} Å from its first one,"
                f" more than a quarter of the smallest height of the box ({2 * half:.3g} Å): their"
                " nearest images would change"
            )
    return errors


@kernel(inline=True)
def _centre(state, members, fraction):
    """The centre of mass of a group, its members at the images nearest to the first."""
    first = members[0]
    x0, y0, z0 = state.position[first, 0], state.position[first, 1], state.position[first, 2]
    x, y, z = x0, y0, z0
    for k in range(len(members)):
        m = members[k]
        dx, dy, dz = nearest_image(
            state.cell,
            state.position[m, 0] - x0,
            state.position[m, 1] - y0,
            state.position[m, 2] - z0,
        )
        x, y, z = x + fraction[k] * dx, y + fraction[k] * dy, z + fraction[k] * dz
    return x, y, z


@implements(add_forces, DistanceRestraint)
def _add_distance_restraint(term, state, load, tally):
    ax, ay, az = _centre(state, term.first, term.first_fraction)
    bx, by, bz = _centre(state, term.second, term.second_fraction)
    arm = nearest_image(state.cell, bx - ax, by - ay, bz - az)
    r = sqrt(arm[0] * arm[0] + arm[1] * arm[1] + arm[2] * arm[2])
    away = r - term.distance
    scale = -term.stiffness * away / r if r > 0 else 0.0
    for i in range(3):
        for k in range(len(term.first)):
            load.force[term.first[k], i] -= term.first_fraction[k] * scale * arm[i]
        for k in range(len(term.second)):
            load.force[term.second[k], i] += term.second_fraction[k] * scale * arm[i]
        if tally is not None:
            for j in range(3):
                tally[1 + 3 * i + j] += scale * arm[i] * arm[j]
    if tally is not None:
        tally[0] += 0.5 * term.stiffness * away * away
    return OK
