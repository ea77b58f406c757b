"""The species of a scene: their rigid molecules, frozen ones, models from a geometry and a table of
parameters."""

from collections import Counter
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np

from rigidmd.errors import InputError, MoleculeError, SceneError, StructureError
from rigidmd.forces.parts import select_by_number
from rigidmd.formats.atoms import HEAVY_HYDROGEN, Atoms, is_element
from rigidmd.io.structure_file import read_atoms, read_geometry
from rigidmd.scene import MolecularScene
from rigidmd.scene.models import (
    Molecule,
    MoleculeFile,
    Site,
    find_site,
    load_model,
    molecule,
    molecule_of,
    read_molecule,
    read_parameters,
    with_masses,
    with_parameters,
)
from rigidmd.scene.species import Molecules, spans
from rigidmd.scene.validation import ValidationError, not_none, validation_messages

#: Largest unit of the last digit, Å, for which a molecule may be linear up to rounding, and the
#: longest distance of a rounded point from where it was, in such units.
ROUNDEST, ROUNDED = 0.02, np.sqrt(3) / 2
#: Atoms within this fraction of the length of a molecule from a line are on it for `molecule`.
ON_LINE = 1e-5
LONGEST_NAME = 5  # of a site; longer labels of atoms are cut
MOST_LISTED = 8  # entries of parameters in a message


def species_of(scene: MolecularScene) -> list[Molecule]:
    """The species of a scene, in its order. Raises SceneError with all errors."""
    species, errors = [], []
    for k, entry in enumerate(scene.molecules):
        try:
            species.append(_one_species(scene, entry))
        except InputError as error:
            errors += [f"molecules.{k}: {error.where}: {fault}" for fault in error.errors]
    names = [m.name for m in species]
    twice = sorted({name for name in names if names.count(name) > 1})
    errors += [
        f"molecules: {name} appears twice. Give these species different names" for name in twice
    ]
    if errors:
        raise SceneError(scene.source, errors)
    return species


def _one_species(scene: MolecularScene, entry: Molecules) -> Molecule:
    if entry.model is not None:
        kind = load_model(entry.model)
    elif entry.file is not None and entry.file.endswith(".toml"):
        kind = read_molecule(scene.path(entry.file))
    else:
        table = (
            () if entry.parameters is None else read_parameters(scene.path(entry.parameters)).sites
        )
        if entry.file is None:
            sites, notes = with_parameters(not_none(entry.sites), table), []
        else:
            where = "sites or of parameters" if entry.parameters is not None else "sites"
            path = scene.path(entry.file)
            sites, notes = sites_of_geometry(path, entry.sites or (), table, where)
        if entry.repeat is None:
            kind = molecule(entry.label, sites)
        else:
            kind = _framework(scene.path(not_none(entry.file)), entry.label, sites, entry.repeat)
        kind = replace(kind, reading=tuple(notes))
    if entry.masses_u is not None:
        kind = with_masses(kind, entry.masses_u)
    changed = {
        "name": entry.name or kind.name,
        "residue_names": entry.residue_names or kind.residue_names,
    }
    return replace(kind, **changed)


def _framework(
    path: Path, name: str, sites: tuple[Site, ...], repeat: tuple[int, int, int]
) -> Molecule:
    """One body of the sites in the repeated cell of a crystal. Raises StructureError."""
    atoms = read_atoms(path)
    if (cell := atoms.cell) is None:
        raise StructureError(str(path), ["has no cell to repeat"])
    steps = np.indices(repeat).reshape(3, -1).T @ cell
    repeated = tuple(
        site.model_copy(update={"position_A": tuple(not_none(site.position_A) + step)})
        for step in steps
        for site in sites
    )
    cell = cell * np.array(repeat)[:, None]
    return replace(molecule(name, repeated), cell=cell)


def _elements_of(entries: tuple[Site, ...]) -> frozenset[str]:
    """The elements that entries of parameters have or are named by."""
    return frozenset(x for s in entries for x in (s.name, s.element) if is_element(x))


def straightened(atoms: Atoms) -> Atoms:
    """The atoms of a molecule on a line, with a note, if the rounding of the coordinates in their
    file explains their distances from it: else nothing but rounding would resist a rotation about
    that line."""
    count = len(atoms.position)
    centre = atoms.position.mean(axis=0)
    _, size, axes = np.linalg.svd(atoms.position - centre, full_matrices=False)
    off = float(np.sqrt((size[1:] ** 2).sum() / count))  # rms
    if count < 3 or not 0 < atoms.rounding <= ROUNDEST or off > ROUNDED * atoms.rounding:
        return atoms
    position = centre + np.outer((atoms.position - centre) @ axes[0], axes[0])
    moved = float(np.linalg.norm(position - atoms.position, axis=1).max())
    if moved <= ON_LINE * size[0]:
        return atoms
    note = (
        f"its atoms are on a line to the {atoms.rounding:g} Å of its coordinates, and were put on"
        f" it, by {moved:.2g} Å at most: a linear molecule"
    )
    return atoms._replace(position=position, notes=[*atoms.notes, note])


def sites_of_geometry(
    path: Path, entries_of_scene: tuple[Site, ...], table: tuple[Site, ...], where: str
) -> tuple[tuple[Site, ...], list[str]]:
    """Sites with positions from a file and parameters from entries of the scene or a table, by atom
    name, of a longer one its first five characters, or else by element, and notes on the file.
    `where` names the entries in messages. Raises StructureError with all errors."""
    errors = []
    sites = []
    used = set()
    available = list(dict.fromkeys(site.name for site in (*entries_of_scene, *table))) or ["none"]
    listed = ", ".join(available[:MOST_LISTED]) + (", ..." if len(available) > MOST_LISTED else "")
    hint = f"there are {listed}. The atoms of the file may have these names in place of elements"
    atoms = read_geometry(path, _elements_of((*entries_of_scene, *table)))
    atoms = straightened(atoms)
    charges = [None] * len(atoms.names) if atoms.charges is None else atoms.charges.tolist()
    columns = atoms.names, atoms.elements, not_none(atoms.masses), atoms.position, charges
    for name, element, mass, position, charge in zip(*columns, strict=True):
        name = name[:LONGEST_NAME]
        match, shared = find_site(entries_of_scene, name, element), find_site(table, name, element)
        if match is None and shared is None:
            errors.append(
                f"atom {name}: no entry of {where} has this name or the name {element}; {hint}"
            )
            continue
        used.add(match.name if match else "")
        entries = [s for s in (match, shared) if s is not None]
        mass = next((s.mass_u for s in entries if s.mass_u is not None), float(mass))
        element = next((s.element for s in entries if s.element != "X"), element)
        charge = next((s.charge_e for s in entries if s.charge_e is not None), charge)
        known = {
            "name": name,
            "element": element,
            "mass_u": mass,
            "position_A": tuple(map(float, position)),
            "charge_e": charge,
        }
        sites.append(match.model_copy(update=known) if match else Site(**known))
    errors += [
        f"sites: {s.name} is not an atom of it" for s in entries_of_scene if s.name not in used
    ]
    if errors:
        raise StructureError(str(path), list(dict.fromkeys(errors)))
    return with_parameters(tuple(sites), table), list(atoms.notes)


def split_frozen(
    scene: MolecularScene, species: list[Molecule], index: np.ndarray, number: np.ndarray
) -> tuple[list[Molecule], np.ndarray, np.ndarray, list[str]]:
    """Species, index (n,) into them, mask of frozen species, error messages. A partly frozen
    species becomes two."""
    species = list(species)
    index = index.copy()
    errors = []
    frozen = [entry.frozen is True for entry in scene.molecules]
    for k, entry in enumerate(scene.molecules):
        of_species = index == k
        selected = np.zeros(len(index), bool)
        ranges = [] if isinstance(entry.frozen, bool) else spans(entry.frozen)
        for _, mask, error in select_by_number(ranges, species[k].name, of_species, number):
            errors += [f"molecules.{k}.frozen: {error}"] if error else []
            selected |= mask
        if selected.any() and (selected == of_species).all():
            frozen[k] = True
        elif selected.any():
            index[selected] = len(species)
            species.append(species[k])
            frozen.append(True)
    return species, index, np.array(frozen), errors


#: Factor on the sum of covalent radii up to which two atoms are bonded.
SLACK = 1.25
#: A sum of charges this close to a whole number is meant to be one; this close, it is one up to
#: rounding.
NEARLY, EXACTLY = 0.05, 1e-9


def model_from_geometry(
    geometry: Path, parameters: Path | None, name: str | None
) -> tuple[MoleculeFile, Molecule, list[str]]:
    """The model of a structure file with one molecule, with the positions in the file: its file,
    molecule, notes.

    parameters : a table of parameters by atom name or element. Without one the model has masses and
        no interactions
    name : default: the name of the file. Raises StructureError or MoleculeError, with all errors.
    """
    notes = []
    source = [f"geometry of {geometry.name}"]
    table = None if parameters is None else read_parameters(parameters)
    atoms = read_geometry(geometry, _elements_of(() if table is None else table.sites))
    names, elements = atoms.names, atoms.elements
    if table is None:
        entries = tuple(Site(name=element) for element in dict.fromkeys(elements))
        sites, reading = sites_of_geometry(geometry, (), entries, "")
        notes.append(
            "it has no interactions: give its sites charge_e, sigma_A and epsilon_kJ_mol, or use"
            " --parameters"
        )
    else:
        sites, reading = sites_of_geometry(geometry, (), table.sites, "the table")
        source.append(
            f"parameters of {not_none(parameters).name}"
            + (f": {table.source}" if table.source else "")
        )
        used = [
            find_site(table.sites, name[:LONGEST_NAME], element)
            for name, element in dict.fromkeys(zip(names, elements, strict=True))
        ]
        if idle := [entry.name for entry in table.sites if entry not in used]:
            notes.append(f"{parameters}: no atom uses {', '.join(idle)}")
    sites = _numbered(sites)
    notes += reading
    if long := sorted({atom for atom in names if len(atom) > 5}):
        notes.append(f"names of atoms have five characters at most: {', '.join(long)} are cut")
    residues = {residue[1] for residue in atoms.residue if len(residue) > 1}
    residues = [
        x
        for x in residues
        if len(residues) == 1 and x.isascii() and x.isprintable() and " " not in x
    ]
    data = {"name": geometry.stem if name is None else name, "source": "; ".join(source)}
    try:
        file = MoleculeFile.model_validate(
            data | {"residue_names": tuple(residues), "sites": sites}
        )
    except ValidationError as error:
        raise MoleculeError(str(geometry), validation_messages(error, MoleculeFile)) from None
    model = molecule_of(file)
    notes += _one_molecule(geometry, atoms, elements)
    nearest = round(model.charge)
    off = abs(model.charge - nearest)
    if off > EXACTLY:
        if off < NEARLY:
            nearly = f"nearly but not exactly {f'{nearest:+d}' if nearest else 0}"
        else:
            nearly = "not a whole number"
        notes.append(f"the charges sum to {model.charge:+.6g} e, {nearly}")
    return file, model, notes


def _numbered(sites: tuple[Site, ...]) -> tuple[Site, ...]:
    """Sites with unique names: sites of the same name are numbered, C1, C2, ..., within five
    characters."""
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


def _one_molecule(path: Path, atoms: Atoms, elements: list[str]) -> list[str]:
    """Notes on parts of the molecule. Raises StructureError for several molecules, or one that its
    cell cuts."""
    with_mass = [k for k, element in enumerate(elements) if element != "X"]
    symbols = ["H" if elements[k] in HEAVY_HYDROGEN else elements[k] for k in with_mass]
    part = _parts(symbols, atoms.position[with_mass], None)
    count = part.max(initial=-1) + 1
    notes = []
    if atoms.cell is not None:
        if _parts(symbols, atoms.position[with_mass], atoms.cell).max(initial=-1) + 1 < count:
            why = (
                "its atoms are bonded through the faces of its cell: make the molecule whole,"
                " without a cell"
            )
            raise StructureError(str(path), [why])
        notes.append("its cell is ignored: the model is one rigid body of all its atoms")
    members = [Counter(symbols[k] for k in np.flatnonzero(part == group)) for group in range(count)]
    if (
        count > 1
        and all(member == members[0] for member in members)
        and sum(members[0].values()) > 1
    ):
        formula = "".join(
            f"{element}{number if number > 1 else ''}"
            for element, number in sorted(members[0].items())
        )
        raise StructureError(str(path), [f"has {count} molecules {formula}: keep one"])
    if count > 1:
        parts = f"{count} parts without a bond between them"
        notes.append(f"its atoms are in {parts}: the model is one rigid body of all of them")
    return notes


def _parts(symbols: list[str], position: np.ndarray, cell: np.ndarray | None) -> np.ndarray:
    """Number (n,) of the part of each atom. Atoms within bonding distance are in one part."""
    from ase import Atoms as AseAtoms
    from ase.neighborlist import natural_cutoffs, neighbor_list
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    atoms = AseAtoms(symbols, position, cell=cell, pbc=cell is not None)
    bonding_distances = [SLACK * distance for distance in natural_cutoffs(atoms)]
    first, second = neighbor_list("ij", atoms, bonding_distances)
    links = coo_array((np.ones(len(first)), (first, second)), shape=(len(symbols), len(symbols)))
    return connected_components(links)[1]
