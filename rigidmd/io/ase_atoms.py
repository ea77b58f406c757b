"""Molecules as an `ase.Atoms`: the sites with mass, in ASE's units."""

from typing import TYPE_CHECKING

import numpy as np

from rigidmd.core.state import NOW, State
from rigidmd.engines.system import System
from rigidmd.io.atoms import is_element
from rigidmd.io.formats.through_ase import ASE_VELOCITY, NAMES, RESIDUE_NAMES, RESIDUE_NUMBERS
from rigidmd.units import ENERGY_UNITS

if TYPE_CHECKING:
    import ase

EV = ENERGY_UNITS["eV"]
HEAVY = ("D", "T")


def atoms_of_system(system: System, state: State, wrapped: bool = False) -> "ase.Atoms":
    """A state of a system as an `ase.Atoms`, see `atoms_of_sites`."""
    return atoms_of_sites(
        system, system.site_positions(state, wrapped), system.site_velocities(state), state.cell, float(state.time[NOW])
    )


def atoms_of_sites(
    system: System, positions: np.ndarray, velocities: np.ndarray | None, cell: np.ndarray | None, time: float
) -> "ase.Atoms":
    """The sites with mass as an `ase.Atoms`, with masses, names and residues of the models, and `info["time_ps"]`, from
    positions and velocities (s, 3) of all sites, Å and Å/ps, and a cell (3, 3), None or infinite without a box."""
    import ase

    sites = system.sites
    atom = np.flatnonzero(sites.mass > 0)
    symbols = ["H" if e in HEAVY else e if is_element(e) else "X" for e in sites.element[atom]]
    boxed = cell is not None and bool(np.isfinite(cell).all())
    found = ase.Atoms(
        symbols, positions=np.asarray(positions, float)[atom], masses=sites.mass[atom], cell=cell if boxed else None,
        pbc=boxed, info={"time_ps": time},
    )  # fmt: skip
    if velocities is not None:
        found.set_velocities(np.asarray(velocities, float)[atom] / ASE_VELOCITY)
    of_atom = sites.molecule[atom]
    found.set_array(NAMES, sites.name[atom].astype(str))
    found.set_array(RESIDUE_NAMES, system.residue_names[of_atom].astype(str))
    found.set_array(RESIDUE_NUMBERS, system.residue_number[of_atom].astype(int))
    return found
