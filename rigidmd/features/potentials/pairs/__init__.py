"""Pair potentials of sites with a key of [forces] each: every file here is one, and its name is the
key.

A file has the table of its keys, an `AddedForce` of its name in CamelCase with a method
`term(system)`, and the compiled pair function of the potential. Its energy is a column of the log,
and is compared with its forces at the start of a run.
"""

from typing import NamedTuple

import numpy as np

from rigidmd.engines.system import System
from rigidmd.forces.neighbors.pair_loop import PairForces
from rigidmd.forces.neighbors.sites import exclusion_groups, sites_of


def pair_forces(potential: NamedTuple, system: System, indices: list[np.ndarray]) -> PairForces:
    """The term of a pair potential between the sites indices[k] of each species k, of different
    molecules that are not both frozen."""
    model = system.model
    offsets = [m.positions_body[k] for m, k in zip(system.species, indices, strict=True)]
    sites = sites_of(model.species, offsets, model.inverse_inertia)
    is_frozen = (model.inverse_mass == 0)[model.species]
    return PairForces(potential, sites, exclusion_groups(sites, is_frozen))
