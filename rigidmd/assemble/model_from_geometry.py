"""Makes a molecular model from the geometry of one molecule and a table of parameters."""

from collections import Counter
from itertools import count
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rigidmd.assemble.species import sites_of_geometry
from rigidmd.core.files import unreadable_reason
from rigidmd.errors import MoleculeError, StructureError
from rigidmd.io.formats.atoms import HEAVY_HYDROGEN, Atoms
from rigidmd.io.structure_file import read_atoms, read_geometry
from rigidmd.scene.models import Molecule, MoleculeFile, Site, find_site, molecule, read_parameters
from rigidmd.scene.validation import ValidationError, validation_messages

#: Factor on the sum of covalent radii up to which two atoms are bonded.
SLACK = 1.25
#: A sum of charges this close to a whole number is meant to be one; this close, it is one up to rounding.
NEARLY, EXACTLY = 0.05, 1e-9


class GeometryModel(NamedTuple):
    """The file of a model, its molecule, and notes."""

    file: MoleculeFile
    molecule: Molecule
    notes: list[str]


def model_from_geometry(geometry: Path, parameters: Path | None, name: str | None) -> GeometryModel:
    """The model of a structure file with one molecule, with the positions in the file.

    parameters : a table of parameters by atom name or element; without one the model has masses and no interactions
    name : default: the name of the file. Raises StructureError or MoleculeError, with all errors.
    """
    name = geometry.stem if name is None else name
    notes, source = [], [f"geometry of {geometry.name}"]
    if fault := unreadable_reason(geometry):
        raise StructureError(str(geometry), [fault])
    if parameters is None:
        names, elements, *_ = read_geometry(geometry)
        sites = sites_of_geometry(geometry, (), tuple(Site(name=element) for element in dict.fromkeys(elements)), "")
        notes.append("it has no interactions: give its sites charge_e, sigma_A and epsilon_kJ_mol, or use --parameters")
    else:
        table = read_parameters(parameters)
        sites = sites_of_geometry(geometry, (), table.sites, "the table")
        source.append(f"parameters of {parameters.name}" + (f": {table.source}" if table.source else ""))
        names, elements, *_ = read_geometry(geometry)
        used = [find_site(table.sites, *atom) for atom in dict.fromkeys(zip(names, elements, strict=True))]
        if idle := [entry.name for entry in table.sites if entry not in used]:
            notes.append(f"{parameters}: no atom uses {', '.join(idle)}")
    sites = _numbered(sites)
    if long := sorted({atom for atom in names if len(atom) > 5}):
        notes.append(f"names of atoms have five characters at most: {', '.join(long)} are cut")
    atoms = read_atoms(geometry)
    data = {"name": name, "source": "; ".join(source), "residue_names": _residue(atoms), "sites": sites}
    try:
        file = MoleculeFile.model_validate(data)
    except ValidationError as error:
        raise MoleculeError(str(geometry), validation_messages(error, MoleculeFile)) from None
    found = molecule(file.name, file.sites, file.title, file.source, file.residue_names)
    notes += _one_molecule(geometry, atoms, elements)
    whole = round(found.charge)
    off = abs(found.charge - whole)
    if off > EXACTLY:
        nearly = f"nearly but not exactly {f'{whole:+d}' if whole else 0}" if off < NEARLY else "not a whole number"
        notes.append(f"the charges sum to {found.charge:+.6g} e, {nearly}")
    return GeometryModel(file, found, notes)


def _numbered(sites: tuple[Site, ...]) -> tuple[Site, ...]:
    """Sites with unique names: sites of the same name are numbered, C1, C2, ..., within five characters."""
    times = Counter(site.name for site in sites)
    numbers = {name: count(1) for name in times}
    taken = {name for name in times if times[name] == 1}
    named = []
    for site in sites:
        name = site.name
        while times[site.name] > 1 and (name == site.name or name in taken):
            number = str(next(numbers[site.name]))
            name = site.name[: 5 - len(number)] + number
        taken.add(name)
        named.append(site.model_copy(update={"name": name}))
    return tuple(named)


def _residue(atoms: Atoms) -> tuple[str, ...]:
    """The name of the only residue, if structure files can store it."""
    names = {residue[1] for residue in atoms.residue if len(residue) > 1}
    return tuple(x for x in names if len(names) == 1 and x.isascii() and x.isprintable() and " " not in x)


def _one_molecule(path: Path, atoms: Atoms, elements: list[str]) -> list[str]:
    """Notes on parts of the molecule. Raises StructureError for several molecules, or one that its cell cuts."""
    with_mass = [k for k, element in enumerate(elements) if element != "X"]
    symbols = ["H" if elements[k] in HEAVY_HYDROGEN else elements[k] for k in with_mass]
    part = _parts(symbols, atoms.position[with_mass], None)
    count, notes = part.max(initial=-1) + 1, []
    if atoms.cell is not None:
        joined = _parts(symbols, atoms.position[with_mass], atoms.cell).max(initial=-1) + 1
        if joined < count:
            why = "its atoms are bonded through the faces of its cell: make the molecule whole, without a cell"
            raise StructureError(str(path), [why])
        notes.append("its cell is ignored: the model is one rigid body of all its atoms")
    members = [Counter(symbols[k] for k in np.flatnonzero(part == group)) for group in range(count)]
    if count > 1 and all(member == members[0] for member in members) and sum(members[0].values()) > 1:
        formula = "".join(f"{element}{number if number > 1 else ''}" for element, number in sorted(members[0].items()))
        raise StructureError(str(path), [f"has {count} molecules {formula}: keep one"])
    if count > 1:
        notes.append(
            f"its atoms are in {count} parts without a bond between them: the model is one rigid body of all of them"
        )
    return notes


def _parts(symbols: list[str], position: np.ndarray, cell: np.ndarray | None) -> np.ndarray:
    """Number (n,) of the part of each atom; atoms within bonding distance are in one part."""
    from ase import Atoms as AseAtoms
    from ase.neighborlist import natural_cutoffs, neighbor_list
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    atoms = AseAtoms(symbols, position, cell=cell, pbc=cell is not None)
    first, second = neighbor_list("ij", atoms, natural_cutoffs(atoms, SLACK))
    links = coo_array((np.ones(len(first)), (first, second)), shape=(len(symbols), len(symbols)))
    return connected_components(links)[1]
