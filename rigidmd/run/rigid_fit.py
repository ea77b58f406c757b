"""Rigid bodies from the positions and velocities of sites: fits of rigid templates."""

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


class Rebuilt:
    """Rebuilds rigid bodies from sites: fits of rigid templates, whose axes are those of `rigidmd models NAME`."""

    def __init__(self, system: System):
        self._kinds = kinds_of(system)
        self._templates = [_template(kind.molecule) for kind in self._kinds]
        self._n = len(system.model.species)
        self._turning = len(system.state.rotation) > 0

    def bodies(self, sites: np.ndarray, velocities: np.ndarray | None) -> Bodies:
        """Bodies of a frame from sites (s, 3), Å, and their velocities. Raises OutputError if a molecule is not whole.

        Q of a linear molecule has an arbitrary turn about its axis.
        """
        centre = np.empty((self._n, 3))
        Q = np.tile(np.eye(3), (self._n if self._turning else 0, 1, 1))
        velocity = None if velocities is None else np.empty((self._n, 3))
        L = None if velocities is None else np.zeros((len(Q), 3))
        for kind, fit in zip(self._kinds, self._templates, strict=True):
            at, own = sites[kind.sites].astype(float), kind.index
            middle = at.mean(axis=1)
            turn = fit.turned(at - middle[:, None])
            centre[own] = middle - turn @ fit.middle
            arms = np.einsum("nij,sj->nsi", turn, kind.molecule.positions_body)
            off = np.abs(at - centre[own][:, None] - arms).max(axis=(1, 2), initial=0.0)
            if (worst := float(off.max(initial=0.0))) > OFF + OFF_RELATIVE * kind.molecule.radius:
                raise OutputError(
                    f"a site of molecule {own[off.argmax()] + 1} is {worst:.2g} Å away from where its rigid "
                    f"{kind.name} has it: the molecules of a trajectory must be whole, and those of this run"
                )
            if self._turning:
                Q[own] = turn
            if velocity is not None and L is not None and velocities is not None:
                v, mass = velocities[kind.sites].astype(float), kind.molecule.masses
                mean = np.einsum("s,nsi->ni", mass, v) / kind.molecule.mass
                velocity[own] = mean
                if self._turning:
                    lab = np.einsum("s,nsi->ni", mass, np.cross(arms, v - mean[:, None]))
                    L[own] = np.einsum("nij,ni->nj", turn, lab)
        return Bodies(centre, Q, velocity, L)


class _Template(NamedTuple):
    """middle (3,) of the sites in the body's frame; their directions: sites (s, r) times `columns` (r, 3) of the body's
    frame, r the number of dimensions in which they extend."""

    middle: np.ndarray
    weights: np.ndarray
    columns: np.ndarray

    def turned(self, arms: np.ndarray) -> np.ndarray:
        """Rotations (n, 3, 3) that bring the template to sites (n, s, 3) about their middle."""
        seen = np.einsum("nsi,sr->nri", arms, self.weights)
        axes = np.empty((len(arms), 3, 3))  # rows: where the first, second and third of the template's own axes lie
        rank = len(self.columns)
        axes[:, 0] = seen[:, 0] if rank else [1.0, 0.0, 0.0]
        axes[:, 0] /= np.linalg.norm(axes[:, 0], axis=1)[:, None]
        beside = seen[:, 1] if rank > 1 else np.eye(3)[np.abs(axes[:, 0]).argmin(axis=1)]
        axes[:, 1] = beside - np.einsum("ni,ni->n", beside, axes[:, 0])[:, None] * axes[:, 0]
        axes[:, 1] /= np.linalg.norm(axes[:, 1], axis=1)[:, None]
        axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
        return np.einsum("nri,rj->nij", axes, _right_handed(self.columns))


def _template(molecule: Molecule) -> _Template:
    body = molecule.positions_body
    middle = body.mean(axis=0)
    left, sizes, columns = np.linalg.svd(body - middle, full_matrices=False)
    rank = int((sizes > FLAT * max(sizes[0], np.abs(body).max())).sum()) if sizes[0] > 0 else 0
    return _Template(middle, left[:, :rank] / sizes[:rank], columns[:rank])


def _right_handed(rows: np.ndarray) -> np.ndarray:
    """Orthonormal rows (r, 3), r <= 3, completed to a rotation (3, 3) that keeps the first two."""
    found = np.eye(3)
    if len(rows):
        found[0] = rows[0]
        beside = rows[1] if len(rows) > 1 else np.eye(3)[np.abs(rows[0]).argmin()]
        beside = beside - beside @ rows[0] * rows[0]
        found[1] = beside / np.linalg.norm(beside)
        found[2] = np.cross(found[0], found[1])
    return found


#: Singular values of a template below this fraction of the largest are zero: it is flat or a line.
FLAT = 1e-6
#: Å, and fraction of a molecule's radius, by which a site may lie off the rigid molecule: files are rounded to 0.01 Å.
OFF, OFF_RELATIVE = 0.03, 0.03


class Kind(NamedTuple):
    """The molecules of one species: indices (k,) of molecules, and those of their sites (k, s)."""

    molecule: Molecule
    index: np.ndarray
    sites: np.ndarray
    moves: bool

    @property
    def name(self) -> str:
        return self.molecule.name


def kinds_of(system: System) -> list[Kind]:
    """The species of a system that have molecules, frozen ones apart."""
    first = np.flatnonzero(np.diff(system.sites.molecule, prepend=-1))
    found = []
    for k, molecule in enumerate(system.species):
        index = np.flatnonzero(system.model.species == k)
        if len(index):
            sites = first[index][:, None] + np.arange(len(molecule.masses))
            found.append(Kind(molecule, index, sites, bool(system.model.inverse_mass[k] > 0)))
    return found
