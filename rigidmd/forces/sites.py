"""Sites of one law: where they are when the bodies are where they are, and what their forces do to the bodies.

Each law has its own sites, only those that take part in it. Sites of one molecule are consecutive.
"""

from typing import NamedTuple

import numpy as np
from numba import prange

from rigidmd.jit import implements, is_a, kernel

# Up to this many molecules loops over molecules stay on one thread. Measured, two threads: starting them costs about
# 40 µs, placing the sites of a water 9.5 ns; so placing alone would gain only beyond some 8000 molecules. The bound is
# shared with the drift, whose sines and cosines make a molecule dearer.
SERIAL = 512


class BodySites(NamedTuple):
    """Sites fixed in bodies."""

    first: np.ndarray  # (n + 1,) int32 sites of molecule m are first[m] ... first[m + 1] - 1
    molecule: np.ndarray  # (s,) int32
    kind: np.ndarray  # (n,) int32 offsets of molecule m are offset_body[kind[m]], offset_body[kind[m] + 1] ...
    offset_body: np.ndarray  # (rows, 3) from the centre of mass, body frame, Å; once for all molecules of a species

    def offsets(self) -> np.ndarray:
        """Offsets (s, 3) of all sites, body frame, Å."""
        return self.offset_body[(self.kind - self.first[:-1])[self.molecule] + np.arange(len(self.molecule))]


class CentralSites(NamedTuple):
    """Sites that are their molecules' centres of mass: nothing to rotate, no torque."""

    first: np.ndarray
    molecule: np.ndarray

    def offsets(self) -> np.ndarray:
        """Offsets (s, 3) of all sites: none."""
        return np.zeros((len(self.molecule), 3))


def place_molecule(sites, state, m, site_position):
    """Positions (lab) of molecule m's sites into site_position (s, 3)."""
    raise TypeError("compiled code only")


@implements(place_molecule, inline=True)
def _place_molecule(sites, state, m, site_position):
    if is_a(sites, CentralSites):

        def place_central(sites, state, m, site_position):
            for i in range(sites.first[m], sites.first[m + 1]):
                for k in range(3):
                    site_position[i, k] = state.position[m, k]

        return place_central

    def place(sites, state, m, site_position):
        begin = sites.kind[m] - sites.first[m]
        for i in range(sites.first[m], sites.first[m + 1]):
            x = sites.offset_body[begin + i, 0]
            y = sites.offset_body[begin + i, 1]
            z = sites.offset_body[begin + i, 2]
            for k in range(3):
                site_position[i, k] = state.position[m, k] + (
                    state.rotation[m, k, 0] * x + state.rotation[m, k, 1] * y + state.rotation[m, k, 2] * z
                )

    return place


def load_molecule(sites, state, load, m, site_force):
    """Add the sum of molecule m's site forces (s, 3), and their torque about its centre, to its load."""
    raise TypeError("compiled code only")


@implements(load_molecule, inline=True)
def _load_molecule(sites, state, load, m, site_force):
    if is_a(sites, CentralSites):

        def load_central(sites, state, load, m, site_force):
            for i in range(sites.first[m], sites.first[m + 1]):
                for k in range(3):
                    load.force[m, k] += site_force[i, k]

        return load_central

    def load_body(sites, state, load, m, site_force):
        q = state.rotation[m]
        begin = sites.kind[m] - sites.first[m]
        for i in range(sites.first[m], sites.first[m + 1]):
            fx = site_force[i, 0]
            fy = site_force[i, 1]
            fz = site_force[i, 2]
            load.force[m, 0] += fx
            load.force[m, 1] += fy
            load.force[m, 2] += fz
            # n_body = d x (Q^T f), with the site's offset d in the body frame
            bx = q[0, 0] * fx + q[1, 0] * fy + q[2, 0] * fz
            by = q[0, 1] * fx + q[1, 1] * fy + q[2, 1] * fz
            bz = q[0, 2] * fx + q[1, 2] * fy + q[2, 2] * fz
            x = sites.offset_body[begin + i, 0]
            y = sites.offset_body[begin + i, 1]
            z = sites.offset_body[begin + i, 2]
            load.torque_body[m, 0] += y * bz - z * by
            load.torque_body[m, 1] += z * bx - x * bz
            load.torque_body[m, 2] += x * by - y * bx

    return load_body


@kernel(parallel=True)
def _place_threaded(sites, state, site_position):
    for m in prange(len(state.position)):
        place_molecule(sites, state, m, site_position)


@kernel(parallel=True)
def _load_threaded(sites, state, load, site_force):
    for m in prange(len(state.position)):
        load_molecule(sites, state, load, m, site_force)


@kernel(outer=True)
def place_sites(sites, state, site_position):
    """Positions of all sites (s, 3) in the lab frame, molecules whole."""
    if len(state.position) <= SERIAL:
        for m in range(len(state.position)):
            place_molecule(sites, state, m, site_position)
    else:
        _place_threaded(sites, state, site_position)


@kernel
def load_from_sites(sites, state, load, site_force):
    """Add the site forces (s, 3) to the bodies' forces and torques."""
    if len(state.position) <= SERIAL:
        for m in range(len(state.position)):
            load_molecule(sites, state, load, m, site_force)
    else:
        _load_threaded(sites, state, load, site_force)


def virial_of_offsets(sites, state, site_force, tally):
    """Turn the site virial in `tally` into the molecular one: subtract sum f (x) (x_site - X_molecule)."""
    raise TypeError("compiled code only")


@implements(virial_of_offsets)
def _virial_of_offsets(sites, state, site_force, tally):
    if is_a(sites, CentralSites):
        return lambda sites, state, site_force, tally: None

    def virial_of_offsets(sites, state, site_force, tally):
        for i in range(len(site_force)):
            m = sites.molecule[i]
            at = sites.kind[m] - sites.first[m] + i
            for k in range(3):
                offset = 0.0
                for axis in range(3):
                    offset += state.rotation[m, k, axis] * sites.offset_body[at, axis]
                for row in range(3):
                    tally[1 + 3 * row + k] -= site_force[i, row] * offset

    return virial_of_offsets
