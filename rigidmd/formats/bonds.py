"""Bonds of molecules, for viewers and topology files."""

import numpy as np

from rigidmd.formats.systems import MolecularSystem, Shape


def connections(system: MolecularSystem, *, massless: bool = False) -> np.ndarray:
    """Pairs (b, 2) of sites that bonds join. `massless`: whether massless sites are joined to their
    nearest atoms, so that each molecule is connected."""
    starts = np.searchsorted(system.sites.molecule, np.arange(len(system.model.species)))
    chosen = [
        [pair for pair in bonds(m) if massless or m.masses[pair[1]] > 0] for m in system.species
    ]
    links = [np.array(pairs, int).reshape(-1, 2) for pairs in chosen]
    return np.concatenate(
        [start + links[kind] for start, kind in zip(starts, system.model.species, strict=True)]
    )


def shortest_links(points: np.ndarray) -> np.ndarray:
    """Pairs (n - 1, 2) of points (n, 3): the shortest links that connect them."""
    from scipy.sparse.csgraph import minimum_spanning_tree
    from scipy.spatial.distance import cdist

    tree = minimum_spanning_tree(cdist(points, points)).tocoo()
    return np.stack([tree.row, tree.col], axis=-1)


#: Covalent radii, Å (Cordero et al. 2008, Dalton Trans. 2832), of the elements in rigid models.
COVALENT = {"H": 0.31, "C": 0.76, "N": 0.71, "O": 0.66, "F": 0.57, "S": 1.05, "Cl": 1.02}
#: Factor on the sum of covalent radii up to which two atoms are bonded.
SLACK = 1.25


def bonds(m: Shape) -> list[tuple[int, int]]:
    """Bonds, heavier site first: atoms within bonding distance, shortest links, massless sites to
    nearest atoms."""
    from scipy.spatial.distance import cdist

    x = m.positions_body
    atoms = np.flatnonzero(m.masses > 0)
    massless = np.flatnonzero(m.masses == 0)
    radius = SLACK * np.array([COVALENT.get(m.elements[i], 0.0) for i in atoms.tolist()])
    bonded = cdist(x[atoms], x[atoms]) <= radius[:, None] + radius
    bonded[tuple(shortest_links(x[atoms]).T)] = True
    pairs = atoms[np.argwhere(np.triu(bonded | bonded.T, 1))].tolist()
    links = sorted((i, j) if m.masses[i] >= m.masses[j] else (j, i) for i, j in pairs)
    nearest = atoms[cdist(x[massless], x[atoms]).round(9).argmin(axis=1)]
    return [*links, *zip(nearest.tolist(), massless.tolist(), strict=True)]


def distance(m: Shape, i: int, j: int) -> float:
    """The distance of two sites of a molecule, Å."""
    return float(np.linalg.norm(m.positions_body[i] - m.positions_body[j]))
