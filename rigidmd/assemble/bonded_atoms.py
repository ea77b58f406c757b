"""Groups of the atoms of a file that are joined by bonds."""

import numpy as np

from rigidmd.assemble.assignment import BOND_REACH, massive_sites
from rigidmd.assemble.atom_kinds import UNKNOWN, labels_of
from rigidmd.formats.atoms import Atoms, is_element
from rigidmd.formats.bonds import shortest_links
from rigidmd.formats.cells import pairs_within
from rigidmd.scene.models import Molecule

#: Two ways along bonds that end this close, relative to a bond, end at the same image of an atom.
SAME_PLACE = 1e-3


def bonded_atoms(
    atoms: Atoms, kinds: list[str], species: list[Molecule], cell: np.ndarray | None
) -> tuple[list[list[int]], set[int]]:
    """Groups of atoms with mass, in file order, linked by bonds as long as in the templates'
    spanning trees, and the first atoms of groups without an end: bonded to their own images, as in
    polymers."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    numbers = {kind: k for k, kind in enumerate({*kinds}.union(*map(labels_of, species)))}
    reach = np.zeros((len(numbers), len(numbers)))
    for molecule in species:
        sites = massive_sites(molecule)
        points = molecule.positions_body[sites]
        number = [numbers[labels_of(molecule)[s]] for s in sites]
        for i, j in shortest_links(points):
            one = number[i]
            other = number[j]
            length = float(np.linalg.norm(points[i] - points[j]))
            reach[one, other] = reach[other, one] = max(reach[one, other], BOND_REACH * length)
    if UNKNOWN in numbers:
        sites = [
            number for kind, number in numbers.items() if kind != UNKNOWN and not is_element(kind)
        ]
        longest = reach[np.ix_(sites, sites)].max(initial=0.0)
        reach[numbers[UNKNOWN], [*sites, numbers[UNKNOWN]]] = longest
        reach[[*sites, numbers[UNKNOWN]], numbers[UNKNOWN]] = longest
    with_mass = np.array([i for i, kind in enumerate(kinds) if kind != "X"], int)
    number = np.array([numbers[kinds[i]] for i in with_mass], int)
    i, j, step = pairs_within(atoms.position[with_mass], cell, reach.max())
    bonded = np.linalg.norm(step, axis=1) <= reach[number[i], number[j]]
    i, j, step = i[bonded], j[bonded], step[bonded]
    shape = (len(with_mass), len(with_mass))
    count, label = connected_components(
        coo_array((np.ones(len(i)), (i, j)), shape=shape), directed=False
    )
    runs = [[] for _ in range(count)]
    for atom, component in zip(with_mass, label, strict=True):
        runs[component].append(atom)
    endless = set() if cell is None else {runs[c][0] for c in _endless(label, i, j, step)}
    return sorted(runs), endless


def _endless(label: np.ndarray, i: np.ndarray, j: np.ndarray, step: np.ndarray) -> set[int]:
    """Components (labels of atoms) whose bonds i, j with vectors step (b, 3) close a ring through
    the periodic cell."""
    i, j, step = np.append(i, j), np.append(j, i), np.vstack([step, -step])
    position = np.zeros((len(label), 3))
    reached = np.zeros(len(label), bool)
    reached[np.unique(label, return_index=True)[1]] = True
    while len(onward := np.flatnonzero(reached[i] & ~reached[j])):
        position[j[onward]] = position[i[onward]] + step[onward]
        reached[j[onward]] = True
    gap = np.linalg.norm(position[i] + step - position[j], axis=1)
    return set(label[i[gap > SAME_PLACE * np.linalg.norm(step, axis=1)]].tolist())
