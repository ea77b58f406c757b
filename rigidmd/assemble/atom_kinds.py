"""What the atoms of a file may be: elements, or sites of the molecules of a scene."""

from functools import cache

import numpy as np

from rigidmd.formats.atoms import (
    CHARMM_IONS,
    CHARMM_WATER,
    SAME_MASS,
    Atoms,
    element_of,
    is_element,
)
from rigidmd.scene.models import Molecule

#: u; programs without massless sites give them a mass below this.
NO_MASS = 0.1
UNKNOWN = "X?"  # the kind of an atom with mass that is one of several sites without elements


def labels_of(molecule: Molecule) -> list[str]:
    """Label of each site: its element, else its name. Atoms with the same label are
    interchangeable."""
    return [
        e if e != "X" else name
        for e, name in zip(molecule.elements, molecule.site_names, strict=True)
    ]


def kinds_of(atoms: Atoms, species: list[Molecule]) -> list[str]:
    """The label of every atom: its element, or the name of a site. X for massless ones. "?" marks a
    guess.

    An element in the file is accepted. A name counts if it is the name of a site or starts with an
    element of the scene. If the file has masses, names of sites and elements have priority over the
    mass, and the mass over the start of any other name.
    """
    by_name = {}
    by_mass = []
    for molecule in species:
        for name, label, mass in zip(
            molecule.site_names, labels_of(molecule), molecule.masses, strict=True
        ):
            by_name.setdefault(name, set()).add(label if mass > 0 else "X")
            by_mass += [(mass, label)] if mass > 0 else []
    vocabulary = frozenset(label for _, label in by_mass)
    open_names = {name for name, labels in by_name.items() if len(labels) > 1}
    by_name = {name: labels.pop() for name, labels in by_name.items() if len(labels) == 1}
    site_names = set(by_name) - vocabulary
    points = {
        name: labels_of(m)[0] for m in species if len(m.masses) == 1 for name in m.residue_names
    }
    shared = {name for m in species if len(m.masses) > 1 for name in m.residue_names}
    virtual = CHARMM_WATER[1] if set(CHARMM_WATER) <= set(atoms.names) else None
    hydrogen = next((h for h in ("H", "D", "T") if h in vocabulary), "")

    def isotope(element: str) -> str:
        """The isotope of hydrogen in the scene, for others in the file: light water from a file of
        heavy water."""
        if hydrogen and element in ("H", "D", "T") and element not in vocabulary:
            return hydrogen
        return element

    def without_element(mass: float) -> str:
        """The site of this mass that has no element, such as a united atom. X, without mass, if
        there is none."""
        near = {
            label
            for other, label in by_mass
            if abs(other - mass) <= SAME_MASS * mass and not is_element(label)
        }
        return near.pop() if len(near) == 1 else UNKNOWN if near else "X"

    @cache
    def kind(name: str, element: str, mass: float, residue: str | None) -> str:
        if 0 < mass < NO_MASS:
            return "X"
        if mass > 0:
            if name == "X":
                return without_element(mass)
            if isotope(name) in vocabulary:
                return isotope(name)
            if name in site_names:
                return by_name[name]
            nearest, label = min(by_mass, key=lambda entry: abs(entry[0] - mass))
            if abs(nearest - mass) <= SAME_MASS * mass:
                return label
            if (guess := isotope(element_of(name, vocabulary))) in vocabulary:
                return guess
        if not element or element == "X":
            if name in site_names:
                return by_name[name]
            if name in vocabulary:
                return name
        if name == virtual:
            return "X"
        if element:
            return isotope(element)
        if name in open_names:
            return f"{name}?"
        if residue in points and residue not in shared:
            return points[residue]
        if residue in (None, name):  # an ion or a noble gas: NA, CL, AR, SOD
            ion = CHARMM_IONS.get(name.upper(), "")
            name = ion if ion in vocabulary else name if residue is None else name.capitalize()
        guess = isotope(element_of(name, vocabulary))
        return guess if guess in vocabulary or guess == "X" else f"{guess or name or 'nameless'}?"

    masses = np.zeros(len(atoms.names)) if atoms.masses is None else atoms.masses
    residues = [residue[1] if residue else None for residue in atoms.residue]
    return [
        kind(*atom)
        for atom in zip(atoms.names, atoms.elements, masses.tolist(), residues, strict=True)
    ]
