"""Grids of PME for engines whose splines have another order than those of a scene."""

from math import inf, sqrt

import numpy as np

from rigidmd.forces.laws.screened import ScreenedCoulomb
from rigidmd.forces.pairs.space import cell_of
from rigidmd.forces.waves.errors import charges_of, mesh_for, real_error
from rigidmd.forces.waves.mesh import Pme
from rigidmd.peers.portrait import Portrait
from rigidmd.units import COULOMB


def grid_for(portrait: Portrait, order: int) -> tuple[int, int, int] | None:
    """A grid for splines of an order with the accuracy of the scene's Ewald sum; None if there is none.

    The scene's own grid if its splines are of that order or a lower one.
    """
    system, law = portrait.system, portrait.coulomb
    own = system.terms.get("coulomb_reciprocal")
    if isinstance(own, Pme) and own.order <= order:
        a, b, c = own.grid
        return a, b, c
    if not isinstance(law, ScreenedCoulomb) or system.space.volume == inf:
        return None
    counts = np.bincount(system.model.species, minlength=len(system.species))
    charges = charges_of(
        [
            (int(n), m.charges[m.charges != 0], m.positions_body[m.charges != 0])
            for n, m in zip(counts, system.species, strict=True)
        ]
    )
    beyond = real_error(charges, law.alpha, law.cutoff, system.space.volume)
    error = sqrt(max((system.force_error or 0.0) ** 2 / COULOMB**2 - beyond**2, 0.0))
    found = mesh_for(charges, law.alpha, cell_of(system.space), error, order)
    return None if found is None else found[0]
