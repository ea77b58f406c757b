"""Fits of rigid molecules to the positions and velocities of sites, such as those in a trajectory."""

from typing import NamedTuple

import numpy as np

from rigidmd.engines.system import System
from rigidmd.errors import OutputError
from rigidmd.scene.models import Molecule


class Bodies(NamedTuple):
    """Rigid bodies of a frame: centres (n, 3), Q (n, 3, 3); velocities and L (n, 3) or None."""

    position: np.ndarray
    Q: np.ndarray
    velocity: np.ndarray | None
    L: np.ndarray | None


class RigidFit:
    """Fits the molecules of a system, with the axes of `rigidmd models NAME`, to frames of sites."""

    def __init__(self, system: System):
        self._kinds = [(kind, _Template(kind.molecule)) for kind in kinds_of(system)]
        self._n, self._rotates = len(system.model.species), len(system.state.rotation) > 0

    def bodies(self, sites: np.ndarray, velocities: np.ndarray | None) -> Bodies:
        """Bodies of a frame from sites (s, 3), Å, and their velocities. Raises OutputError if a molecule is not whole.
        Q of a linear molecule has an arbitrary rotation about its axis."""
        centre = np.empty((self._n, 3))
        Q = np.tile(np.eye(3), (self._n if self._rotates else 0, 1, 1))
        velocity, L = np.empty((self._n, 3)), np.zeros((len(Q), 3))
        for kind, fit in self._kinds:
            at, index = sites[kind.sites].astype(float), kind.index
            middle = at.mean(axis=1)
            rotation = fit.rotations_onto(at - middle[:, None])
            centre[index] = middle - rotation @ fit.middle
            arms = np.einsum("nij,sj->nsi", rotation, kind.molecule.positions_body)
            off = np.abs(at - centre[index][:, None] - arms).max(axis=(1, 2), initial=0.0)
            if (worst := float(off.max(initial=0.0))) > MAX_DEVIATION + MAX_RELATIVE_DEVIATION * kind.molecule.radius:
                raise OutputError(
                    f"a site of molecule {index[off.argmax()] + 1} is {worst:.2g} Å away from its position in the "
                    f"rigid {kind.name}: the molecules of a trajectory must be whole, and be the molecules of this run"
                )
            if self._rotates:
                Q[index] = rotation
            if velocities is not None:
                v, mass = velocities[kind.sites].astype(float), kind.molecule.masses
                mean = np.einsum("s,nsi->ni", mass, v) / kind.molecule.mass
                velocity[index] = mean
                if self._rotates:
                    lab = np.einsum("s,nsi->ni", mass, np.cross(arms, v - mean[:, None]))
                    L[index] = np.einsum("nij,ni->nj", rotation, lab)
        return Bodies(centre, Q, None, None) if velocities is None else Bodies(centre, Q, velocity, L)


class _Template:
    """The sites of a molecule in its body frame, which extend in r dimensions. middle (3,) : mean of the sites; weights
    (s, r) : of the singular value decomposition; axes (3, 3) : in rows, along its first two directions"""

    def __init__(self, molecule: Molecule):
        body = molecule.positions_body
        self.middle = body.mean(axis=0)
        left, sizes, columns = np.linalg.svd(body - self.middle, full_matrices=False)
        rank = int((sizes > FLAT * max(sizes[0], np.abs(body).max())).sum()) if sizes[0] > 0 else 0
        self.weights, self.axes = left[:, :rank] / sizes[:rank], _right_handed(columns[None, :rank])[0]

    def rotations_onto(self, arms: np.ndarray) -> np.ndarray:
        """Rotations (n, 3, 3) of the template onto sites (n, s, 3) about their middle."""
        return np.einsum("nri,rj->nij", _right_handed(np.einsum("nsi,sr->nri", arms, self.weights)), self.axes)


def _right_handed(rows: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) whose first two rows are the first two of r <= 3 rows (n, r, 3), orthonormalised."""
    axes, rank = np.empty((len(rows), 3, 3)), rows.shape[1]
    axes[:, 0] = rows[:, 0] if rank else [1.0, 0.0, 0.0]
    axes[:, 0] /= np.linalg.norm(axes[:, 0], axis=1)[:, None]
    beside = rows[:, 1] if rank > 1 else np.eye(3)[np.abs(axes[:, 0]).argmin(axis=1)]
    axes[:, 1] = beside - np.einsum("ni,ni->n", beside, axes[:, 0])[:, None] * axes[:, 0]
    axes[:, 1] /= np.linalg.norm(axes[:, 1], axis=1)[:, None]
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    return axes


#: Singular values of a template below this fraction of the largest are zero: it is flat or a line.
FLAT = 1e-6
#: Largest deviation of a site from the rigid molecule, Å, and fraction of the radius: files are rounded to 0.01 Å.
MAX_DEVIATION, MAX_RELATIVE_DEVIATION = 0.03, 0.03


class Kind(NamedTuple):
    """The molecules of one species: their indices (k,), and the indices (k, s) of their sites."""

    molecule: Molecule
    index: np.ndarray
    sites: np.ndarray
    moves: bool

    @property
    def name(self) -> str:
        return self.molecule.name


def kinds_of(system: System) -> list[Kind]:
    """The species of a system that have molecules, frozen and mobile ones separately."""
    first = np.flatnonzero(np.diff(system.sites.molecule, prepend=-1))
    found = []
    for k, molecule in enumerate(system.species):
        index = np.flatnonzero(system.model.species == k)
        if len(index):
            sites = first[index][:, None] + np.arange(len(molecule.masses))
            found.append(Kind(molecule, index, sites, bool(system.model.inverse_mass[k] > 0)))
    return found
