"""Fits of rigid molecules to the positions and velocities of sites, such as those in a
trajectory."""

from typing import NamedTuple

import numpy as np

from rigidmd.engines.system import System
from rigidmd.errors import OutputError
from rigidmd.mechanics.rotation import align
from rigidmd.scene.models import Molecule


class Bodies(NamedTuple):
    """Rigid bodies of a frame: centres (n, 3), Q (n, 3, 3). Velocities and L (n, 3) or None."""

    position: np.ndarray
    Q: np.ndarray
    velocity: np.ndarray | None
    L: np.ndarray | None


class RigidFit:
    """Fits the molecules of a system, with the axes of `rigidmd models NAME`, to frames of
    sites."""

    def __init__(self, system: System):
        self._kinds, self._n = kinds_of(system), len(system.model.species)
        self._rotates = len(system.state.rotation) > 0

    def bodies(self, sites: np.ndarray, velocities: np.ndarray | None) -> Bodies:
        """Bodies of a frame from sites (s, 3), Å, and their velocities. Raises OutputError if a
        molecule is not whole, or a number not finite. Q of a linear molecule has an arbitrary
        rotation about its axis."""
        if not (np.isfinite(sites).all() and (velocities is None or np.isfinite(velocities).all())):
            raise OutputError("positions or velocities are not finite numbers")
        centre = np.empty((self._n, 3))
        Q = np.tile(np.eye(3), (self._n if self._rotates else 0, 1, 1))
        velocity = np.empty((self._n, 3))
        L = np.zeros((len(Q), 3))
        for kind in self._kinds:
            at = sites[kind.sites].astype(float)
            index = kind.index
            body = kind.molecule.positions_body
            middle, middle_body = at.mean(axis=1), body.mean(axis=0)
            rotation = align(body - middle_body, at - middle[:, None], np.ones(len(body)))
            centre[index] = middle - rotation @ middle_body
            arms = np.einsum("nij,sj->nsi", rotation, body)
            off = np.abs(at - centre[index][:, None] - arms).max(axis=(1, 2), initial=0.0)
            if (
                worst := float(off.max(initial=0.0))
            ) > MAX_DEVIATION + MAX_RELATIVE_DEVIATION * kind.molecule.radius:
                raise OutputError(
                    f"a site of molecule {index[off.argmax()] + 1} is {worst:.2g} Å away from its"
                    f" position in the rigid {kind.name}: the molecules of a trajectory must be"
                    " whole, and be the molecules of this run"
                )
            if self._rotates:
                Q[index] = rotation
            if velocities is not None:
                v = velocities[kind.sites].astype(float)
                mass = kind.molecule.masses
                mean = np.einsum("s,nsi->ni", mass, v) / kind.molecule.mass
                velocity[index] = mean
                if self._rotates:
                    lab = np.einsum("s,nsi->ni", mass, np.cross(arms, v - mean[:, None]))
                    L[index] = np.einsum("nij,ni->nj", rotation, lab)
        return (
            Bodies(centre, Q, None, None) if velocities is None else Bodies(centre, Q, velocity, L)
        )


#: Largest deviation of a site from the rigid molecule, Å, and fraction of the radius: files are
#: rounded to 0.01 Å.
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
    kinds = []
    for k, molecule in enumerate(system.species):
        index = np.flatnonzero(system.model.species == k)
        if len(index):
            sites = first[index][:, None] + np.arange(len(molecule.masses))
            kinds.append(Kind(molecule, index, sites, bool(system.model.inverse_mass[k] > 0)))
    return kinds
