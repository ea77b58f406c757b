"""The species of a scene: their rigid molecules, and which molecules are frozen."""

from pathlib import Path

import numpy as np

from rigidmd.errors import InputError, SceneError, StructureError
from rigidmd.forces.parts import select_by_number
from rigidmd.io.structure_file import read_geometry
from rigidmd.scene import MolecularScene
from rigidmd.scene.models import (
    Molecule,
    Site,
    find_site,
    load_model,
    molecule,
    read_molecule,
    read_parameters,
    with_masses,
    with_parameters,
)
from rigidmd.scene.species import Molecules
from rigidmd.scene.validation import not_none


def species_of(scene: MolecularScene) -> list[Molecule]:
    """The species of a scene, in its order. Raises SceneError with all errors."""
    found, faults = [], []
    for k, entry in enumerate(scene.molecules):
        try:
            found.append(_one_species(scene, entry))
        except InputError as error:
            faults += [f"molecules.{k}: {error.where}: {fault}" for fault in error.errors]
    names = [m.name for m in found]
    twice = sorted({name for name in names if names.count(name) > 1})
    faults += [f"molecules: {name} appears twice; give these species different names" for name in twice]
    if faults:
        raise SceneError(scene.source, faults)
    return found


def _one_species(scene: MolecularScene, entry: Molecules) -> Molecule:
    if entry.model is not None:
        found = load_model(entry.model)
    elif entry.file is not None and entry.file.endswith(".toml"):
        found = read_molecule(scene.path(entry.file))
    else:
        table = () if entry.parameters is None else read_parameters(scene.path(entry.parameters)).sites
        if entry.file is None:
            sites = with_parameters(not_none(entry.sites), table)
        else:
            where = "sites or of parameters" if entry.parameters is not None else "sites"
            sites = sites_of_geometry(scene.path(entry.file), entry.sites or (), table, where)
        found = molecule(entry.label, sites)
    if entry.masses_u is not None:
        found = with_masses(found, entry.masses_u)
    changed = {"name": entry.name or found.name, "residue_names": entry.residue_names or found.residue_names}
    return Molecule(**{**vars(found), **changed})


def sites_of_geometry(path: Path, given: tuple[Site, ...], table: tuple[Site, ...], where: str) -> tuple[Site, ...]:
    """Sites with positions from a file and parameters from given entries or a table, by atom name or else by element.
    `where` names the entries in messages. Raises StructureError with all errors."""
    faults, sites, used = [], [], set()
    for name, element, mass, position in zip(*read_geometry(path), strict=True):
        match, shared = find_site(given, name, element), find_site(table, name, element)
        if match is None and shared is None:
            faults.append(f"atom {name}: no entry of {where} has this name or the name {element}")
            continue
        used.add(match.name if match else "")
        entries = [s for s in (match, shared) if s is not None]
        mass = next((s.mass_u for s in entries if s.mass_u is not None), float(mass))
        element = next((s.element for s in entries if s.element != "X"), element)
        known = {"name": name[:5], "element": element, "mass_u": mass, "position_A": tuple(map(float, position))}
        sites.append(match.model_copy(update=known) if match else Site(**known))
    faults += [f"sites: {s.name} is not an atom of it" for s in given if s.name not in used]
    if faults:
        raise StructureError(str(path), list(dict.fromkeys(faults)))
    return with_parameters(tuple(sites), table)


def split_frozen(
    scene: MolecularScene, species: list[Molecule], index: np.ndarray, number: np.ndarray
) -> tuple[list[Molecule], np.ndarray, np.ndarray, list[str]]:
    """Species, index (n,) into them, mask of frozen species, error messages. A partly frozen species becomes two."""
    species, index, faults = list(species), index.copy(), []
    frozen = [entry.frozen is True for entry in scene.molecules]
    for k, entry in enumerate(scene.molecules):
        of_species = index == k
        selected = np.zeros(len(index), bool)
        for _, mask, fault in select_by_number(entry.frozen_spans, species[k].name, of_species, number):
            faults += [f"molecules.{k}.frozen: {fault}"] if fault else []
            selected |= mask
        if selected.any() and (selected == of_species).all():
            frozen[k] = True
        elif selected.any():
            index[selected] = len(species)
            species.append(species[k])
            frozen.append(True)
    if frozen and all(frozen[k] for k in np.unique(index)):
        faults.append("molecules: all are frozen; nothing would move")
    return species, index, np.array(frozen), faults
