"""Checks of potentials of two bodies at random poses: torques that nothing resists, and the
distance at which bodies touch. Bodies in a run within the first distance of a table."""

from collections.abc import Callable, Iterator, Sequence
from math import inf
from typing import cast

import numpy as np

from rigidmd.core.state import State
from rigidmd.dynamics.model import mobile
from rigidmd.engines.system import System
from rigidmd.features.potentials.extra import body_pairs_of
from rigidmd.features.potentials.poses.bodies import reference_of
from rigidmd.features.potentials.poses.formulas import PairValues, PoseFormula
from rigidmd.features.potentials.poses.pairs import BodyPairs, reference_points
from rigidmd.features.potentials.poses.potential import BodyPairPotential
from rigidmd.formats.cells import pairs_within
from rigidmd.mechanics.rotation import from_quaternion
from rigidmd.run.checks import molecule_label
from rigidmd.scene.models import OFF_AXIS, Molecule

POSES, ORIENTATIONS = 4096, 64
#: Nearest distance of the random poses as a fraction of the cutoff, and their farthest one without
#: a cutoff, Å.
NEAREST, FARTHEST = 0.2, 20.0
#: Largest rounding error of a torque, relative to the force times the distance.
ROUNDING = 1e-9


def unresisted_torques(
    potential: BodyPairPotential,
    formula: PoseFormula,
    rows: np.ndarray,
    kinds: Sequence[Molecule],
    system: System,
) -> Iterator[str]:
    """Messages on species with a torque about an axis without inertia.

    rows (k, k, numbers) : of each pair of the k species on which the potential acts
    """
    names = np.array([m.name for m in system.species])[system.model.species]
    moving = set(names[mobile(system.model)].tolist())
    cutoff = potential.cutoff_A or system.cutoff
    farthest = FARTHEST if cutoff == inf else cutoff
    r, a, b = random_poses(NEAREST * farthest, farthest)
    for i, m in enumerate(kinds):
        if m.name not in moving or (m.inertia > 0).all():
            continue
        for j, other in enumerate(kinds):
            if (names == other.name).sum() <= (i == j):  # there is no such pair
                continue
            values = formula.values(rows[min(i, j), max(i, j)], r, a, b)
            if i > j:
                values = PairValues(
                    values.energy, -values.slope, values.torque_of_other, values.torque
                )
            arm = m.axes @ reference_of(potential, m)  # along the axes of the model's file
            if _is_unresisted(m, arm, r, b if i > j else a, values):
                yield _message(potential, m, arm)
                break


def lowest_energy(formula: PoseFormula, row: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """The lowest energy of two bodies in random orientations as a function of distances (k,), u
    Å²/ps²."""

    def energy(distances: np.ndarray) -> np.ndarray:
        return _values_at(formula, row, distances).energy.reshape(len(distances), -1).min(axis=1)

    return energy


def not_finite_at(formula: PoseFormula, row: np.ndarray, distances: np.ndarray) -> float | None:
    """The first of distances (k,) at which two bodies in random orientations have an energy, a
    force or a torque that is not finite."""
    values = np.column_stack(_values_at(formula, row, distances))
    is_finite = np.isfinite(values).reshape(len(distances), -1).all(axis=1)
    return None if is_finite.all() else float(distances[is_finite.argmin()])


def _values_at(formula: PoseFormula, row: np.ndarray, distances: np.ndarray) -> PairValues:
    """The values of two bodies in the same random orientations at each of distances (k,)."""
    r, a, b = (x[:ORIENTATIONS] for x in random_poses(1.0, 1.0))
    vectors = (distances[:, None, None] * r).reshape(-1, 3)
    poses = (np.tile(x, (len(distances), 1, 1)) for x in (a, b))
    return formula.values(row, vectors, *poses)


def random_poses(nearest: float, farthest: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vectors (m, 3) between two bodies at distances (Å) from the nearest to the farthest, and
    rotation matrices (m, 3, 3) of both."""
    numbers = np.random.default_rng(1).standard_normal((POSES, 11))
    direction = numbers[:, :3] / np.linalg.norm(numbers[:, :3], axis=1)[:, None]
    r = np.geomspace(nearest, farthest, POSES)[:, None] * direction
    return r, from_quaternion(numbers[:, 3:7]), from_quaternion(numbers[:, 7:])


@np.errstate(invalid="ignore", over="ignore")
def _is_unresisted(
    m: Molecule, arm: np.ndarray, r: np.ndarray, pose: np.ndarray, values: PairValues
) -> bool:
    """Whether a body has a torque about an axis without inertia in any pose.

    arm (3,) : from its centre of mass to its reference point; values : with the body as the first
    """
    lever = pose @ arm
    torque = values.torque + np.cross(lever, values.slope)
    about = np.einsum("mij,jk,mi->mk", pose, m.axes[:, m.inertia == 0], torque)
    force, distance, at_lever, whole, reaction, unresisted = (
        np.linalg.norm(x, axis=1)
        for x in (values.slope, r, lever, torque, values.torque_of_other, about)
    )
    allowed = ROUNDING * (force * distance + reaction)
    if m.kind == "linear":  # whose sites may be as far off its axis
        allowed += OFF_AXIS * (force * at_lever + whole)
    return bool((unresisted > allowed).any())


def _message(potential: BodyPairPotential, m: Molecule, arm: np.ndarray) -> str:
    if m.kind == "point":
        return (
            f"{m.name} is a point: nothing resists the torque of this potential. Give it sites with"
            " mass off its centre, or freeze it"
        )
    line = m.axes[:, 0]
    what = f"{m.name} is linear: nothing resists the torque of this potential about its axis"
    if np.linalg.norm(np.cross(line, arm)) > OFF_AXIS * np.linalg.norm(arm):
        return f"{what}. Its reference point must be on the line of its masses"
    if potential.axis is None:
        return f"{what}. Rotation about the line of its masses must not change the energy"
    nearest = int(np.abs(line).argmax())
    if abs(line[nearest]) > 1 - OFF_AXIS:
        return f"{what}. Use axis = '{'xyz'[nearest]}', the line of its masses"
    return f"{what}. Its masses must lie along {potential.axis}, the axis of the potential"


def within_table(system: System, state: State) -> str:
    """A warning of two bodies that are nearer than the first distance of a table of energies. Empty
    without one."""
    for name, potential in body_pairs_of(system).items():
        first = getattr(potential.function, "first", 0.0)
        if not first:
            continue
        term = cast(BodyPairs, system.terms[name])
        bodies, point = reference_points(term, state)
        i, j, step = pairs_within(point, state.cell if state.volume < inf else None, first)
        distance = np.linalg.norm(step, axis=1)
        distance[term.group[bodies[i]] == term.group[bodies[j]]] = inf
        if distance.min(initial=inf) < first:
            k = int(distance.argmin())
            one, other = (molecule_label(system, int(bodies[side[k]])) for side in (i, j))
            return (
                f"{name}: {one} and {other} have a distance of {distance[k]:.3g} Å. The table"
                f" begins at {first:g} Å, and nearer its energy is a guess: begin it at shorter"
                " distances"
            )
    return ""
