"""Structures from and for ASE: files that it reads, and `ase.Atoms` with the sites that have mass, in ASE's units."""

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from rigidmd.core.process import ignore_warnings
from rigidmd.core.state import NOW, State
from rigidmd.io.formats import System, extensions
from rigidmd.io.formats.atoms import HEAVY_HYDROGEN, Atoms, is_element, structure_error
from rigidmd.units import ENERGY_UNITS

if TYPE_CHECKING:
    import ase
    from ase import Atoms as AseAtoms

EV = ENERGY_UNITS["eV"]

#: ASE's unit of velocity, sqrt(eV/u), in Å/ps.
ASE_VELOCITY = 98.22694788464063
#: ASE's arrays of names of atoms and residues, as from .pdb. Extended XYZ may have them as columns.
NAMES, RESIDUE_NAMES, RESIDUE_NUMBERS = "atomtypes", "residuenames", "residuenumbers"
#: Columns of velocities in extended XYZ that ASE does not convert, because programs use different units.
UNITLESS_VELOCITIES = ("vel", "velo", "velocity", "velocities")


def read_by_ase(path: Path, source: Path | io.StringIO, **options: Any) -> "list[AseAtoms]":
    """The structures in a file or text. Raises StructureError."""
    import ase.io.formats

    try:
        with ignore_warnings():
            found = cast("list[AseAtoms]", ase.io.read(source, index=":", **options))
    except ase.io.formats.UnknownFileTypeError:
        known = " ".join(extensions(lambda form: form.read or form.read_packed))
        raise structure_error(path, f"its format is unknown to ASE; known here are {known}") from None
    except Exception as error:  # ASE's readers raise many types, from ImportError to IndexError
        reason = " ".join(str(error).split()).rstrip(".") or "something is missing or misplaced"
        hint = "Is the file complete and named by its format? A .xyz, .pdb or .gro made of it may help"
        message = f"ASE, which reads this format, ends with {type(error).__name__}: {reason}. {hint}"
        raise structure_error(path, message) from None
    return [atoms for atoms in found if len(atoms)]


def from_ase(path: Path, atoms, names=None, elements=None, residue=None, masses=None, notes=()) -> Atoms:
    """Atoms in Å, ps and u from ASE's. By default, names and elements are ASE's symbols."""
    symbols = atoms.get_chemical_symbols()
    notes = list(notes)
    if names is not None and len(names) != len(atoms):
        raise structure_error(path, f"has {len(names)} atoms, of which ASE reads {len(atoms)}")
    occupied = {(e, x) for site in (atoms.info.get("occupancy") or {}).values() for e, x in site.items()}
    if invalid := sorted({str(x) for _, x in occupied if not (isinstance(x, int | float) and x >= 0)}):
        raise structure_error(path, f"some of its sites have the occupancy {', '.join(invalid)}")
    if partial_sites := sorted(f"{e} {x:g}" for e, x in occupied if x < 1):
        found = f"some of its sites are occupied only partly ({', '.join(partial_sites)}): the crystal is disordered"
        hint = "in which every site is occupied or left out (for ices, GenIce makes proton-disordered ones)"
        raise structure_error(path, f"{found}, so that molecules are unknown. Give one arrangement of it, {hint}")
    velocity = atoms.get_velocities() * ASE_VELOCITY if atoms.has("momenta") else None
    if velocity is not None and not np.isfinite(velocity).all():
        bad = int(np.argmin(np.isfinite(velocity).all(axis=1)))
        raise structure_error(path, f"atom {bad + 1} has a velocity that is not a finite number")
    if unitless := [key for key in UNITLESS_VELOCITIES if key in atoms.arrays]:
        notes.append(f"the column {unitless[0]} has no units and is not used (ASE writes momenta instead)")
    cell = None
    if atoms.pbc.all():
        cell = atoms.cell.array.copy()
    elif atoms.pbc.any():
        axes = ", ".join(x for x, periodic in zip("abc", atoms.pbc, strict=True) if periodic)
        notes.append(f"its cell is periodic along {axes} only and is not used")
    return Atoms(
        symbols if names is None else names, symbols if elements is None else elements,
        [()] * len(atoms) if residue is None else residue, atoms.get_positions(), velocity, cell, masses, notes,
    )  # fmt: skip


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
    symbols = ["H" if e in HEAVY_HYDROGEN else e if is_element(e) else "X" for e in sites.element[atom]]
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
