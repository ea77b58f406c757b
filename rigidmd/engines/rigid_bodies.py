"""Rigid bodies from sites, for external engines: these give positions, velocities and forces of sites."""

from typing import NamedTuple

import numpy as np

from rigidmd.core.state import Load, State
from rigidmd.engines.system import System


class Points(NamedTuple):
    """Points that represent the molecules of a system, each fixed in a molecule."""

    molecule: np.ndarray  # (s,)
    offset_body: np.ndarray  # (s, 3) from the centre of mass, Å
    mass: np.ndarray  # (s,) u


class RigidBodies:
    """Converts states and loads between bodies and their sites, or other points with the same mass and centre."""

    def __init__(self, system: System, points: Points | None = None):
        model, sites = system.model, system.sites if points is None else points
        self._inverse = model.inverse_inertia[model.species]
        self._molecule, self._body = sites.molecule, sites.offset_body
        self._count = len(model.species)
        self._weight = sites.mass
        self._mass = model.mass[model.species]
        self._inertia = model.inertia[model.species]
        self._frozen = (model.inverse_mass == 0)[model.species]
        spread = np.zeros((self._count, 3, 3))
        np.add.at(spread, self._molecule, np.einsum("si,sj->sij", self._body, self._body))
        extent = np.linalg.norm(np.linalg.eigvalsh(spread), axis=1)
        # a linear body has one moment of inertia that is 0, a point has no extent
        self._linear = (self._inertia == 0).any(axis=1) & (extent > 0)
        self._has_no_rotation = self._frozen | (extent == 0)

    def state(self, before: State, position: np.ndarray, velocity: np.ndarray, cell: np.ndarray) -> State:
        """The state with sites (s, 3) at these positions, molecules whole and not wrapped; all else as in `before`.
        Frozen molecules do not move. The spin of a linear body about its axis has no meaning, so its rotation is the
        one nearest to `before`."""
        centre, drift = self._mean(position), self._mean(velocity)
        arm = position - centre[self._molecule]
        rotation, spin = before.rotation.copy(), before.angular_momentum_body.copy()
        if len(rotation):
            rotates = ~self._has_no_rotation
            rotation[rotates] = self._rotations(before.rotation, arm)[rotates]
            of_sites = np.cross(arm, velocity - drift[self._molecule]) * self._weight[:, None]
            spin[rotates] = np.einsum("nij,ni->nj", rotation, self._sum(of_sites))[rotates]
            spin[self._inertia == 0] = 0.0
        held = self._frozen[:, None]
        return before._replace(
            position=np.where(held, before.position, centre), velocity=np.where(held, before.velocity, drift),
            rotation=np.ascontiguousarray(rotation), angular_momentum_body=spin, cell=np.ascontiguousarray(cell),
        )  # fmt: skip

    def points(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Positions and velocities (s, 3) of the sites, lab frame."""
        centre, drift = state.position[self._molecule], state.velocity[self._molecule]
        if not len(state.rotation):
            return centre + self._body, drift
        arm = np.einsum("sij,sj->si", state.rotation[self._molecule], self._body)
        omega = np.einsum("nij,nj->ni", state.rotation, state.angular_momentum_body * self._inverse)
        return centre + arm, drift + np.cross(omega[self._molecule], arm)

    def load(self, state: State, position: np.ndarray, force: np.ndarray) -> Load:
        """Forces and torques on bodies from forces on sites (s, 3)."""
        arm = position - self._mean(position)[self._molecule]
        if not len(state.rotation):
            return Load(self._sum(force), np.zeros((0, 3)))
        torque = np.einsum("nij,ni->nj", state.rotation, self._sum(np.cross(arm, force)))
        return Load(self._sum(force), torque)

    def intramolecular_virial(self, position: np.ndarray, force: np.ndarray) -> np.ndarray:
        """Sum (3, 3) of F (x) d, d from the centre of mass. The atomic virial less this is the molecular one."""
        return force.T @ (position - self._mean(position)[self._molecule])

    def _sum(self, of_sites: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(self._molecule, part, self._count) for part in of_sites.T], axis=1)

    def _mean(self, of_sites: np.ndarray) -> np.ndarray:
        return self._sum(of_sites * self._weight[:, None]) / self._mass[:, None]

    def _rotations(self, before: np.ndarray, arm: np.ndarray) -> np.ndarray:
        """Rotations (n, 3, 3) that bring the body-frame offsets nearest to the offsets (s, 3) in the lab."""
        overlap = np.zeros((self._count, 9))
        products = np.einsum("si,sj->sij", arm, self._body).reshape(-1, 9)
        for k in range(9):
            overlap[:, k] = np.bincount(self._molecule, products[:, k], self._count)
        left, _, right = np.linalg.svd(overlap.reshape(-1, 3, 3))
        left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
        found = left @ right
        if (line := self._linear).any():
            axis, axis_body = left[line, :, 0], right[line, 0]
            found[line] = _tilted(before[line], np.einsum("nij,nj->ni", before[line], axis_body), axis)
        return found


def _tilted(rotation: np.ndarray, old: np.ndarray, new: np.ndarray) -> np.ndarray:
    """Rotations followed by the shortest ones that bring unit vectors old (n, 3) to new (n, 3).

    Source: Rodrigues' formula, about the cross product. For more than a right angle it follows a rotation by 180° about
    a perpendicular axis, so that opposite vectors are no exception. The result is made orthogonal, or rounding would
    grow from call to call.
    """
    across = np.cross(old, np.eye(3)[np.abs(old).argmin(axis=1)])
    across /= np.linalg.norm(across, axis=1)[:, None]
    back = (np.einsum("ni,ni->n", old, new) < 0)[:, None]
    by_180 = np.where(back[:, None], 2 * np.einsum("ni,nj->nij", across, across) - np.eye(3), np.eye(3))
    old = np.where(back, -old, old)
    cross, cosine = np.cross(old, new), np.einsum("ni,ni->n", old, new)
    hat = np.zeros((len(old), 3, 3))
    for (i, j), k in {(2, 1): 0, (0, 2): 1, (1, 0): 2}.items():
        hat[:, i, j], hat[:, j, i] = cross[:, k], -cross[:, k]
    step = np.eye(3) + hat + hat @ hat / (1 + cosine)[:, None, None]
    left, _, right = np.linalg.svd(step @ by_180 @ rotation)
    return left @ right
