"""Assigns the atoms of a file to molecules, by residues or else by bonding distance, and fits rigid templates."""

from collections import Counter, deque
from collections.abc import Collection, Hashable, Iterable
from functools import cache
from itertools import groupby
from math import inf
from typing import Any, NamedTuple

import numpy as np

from rigidmd.io.formats.atoms import CHARMM_IONS, CHARMM_WATER, SAME_MASS, Atoms, element_of
from rigidmd.io.formats.bonds import shortest_links
from rigidmd.io.formats.cells import make_whole, pairs_within
from rigidmd.mechanics.rotation import align
from rigidmd.scene.models import Molecule

#: Atoms are bonded up to this multiple of the template's longest bond between atoms of the same labels. Hydrogen bonds
#: of water are at least 1.6 times as long as its bonds.
BOND_REACH = 1.25
#: Two ways along bonds that end this close, relative to a bond, end at the same image of an atom.
SAME_PLACE = 1e-3
#: Partial assignments tried before the search for an order of atoms gives up.
MOST_TRIES = 20_000
MOST_DISTANCES = 1_000_000  # computed at once
#: u; programs without massless sites give them a mass below this.
NO_MASS = 0.1
#: Up to this multiple of the tolerance the best order of atoms is searched, for messages on molecules that do not fit.
MOST_SEARCHED, SEARCH_TOLERANCE = 5, 3
MOST_LISTED = 6  # atoms of a molecule in a message


class TemplateFit(NamedTuple):
    """Rigid templates fitted to m molecules of s sites with mass."""

    centre: np.ndarray  # (m, 3) Å
    rotation: np.ndarray  # (m, 3, 3)
    deviation: np.ndarray  # (m,) largest distance of an atom from the template, Å
    square: np.ndarray  # (m,) mean square of these distances, Å²


class MatchedMolecules(NamedTuple):
    """The molecules of a file, in the order of the file."""

    species: np.ndarray  # (n,)
    atoms: list[np.ndarray]  # atoms of each molecule, in the order of its sites with mass
    fit: TemplateFit  # of the n molecules
    massless: Counter  # number of massless atoms in the file, by name
    notes: list[str]
    number: np.ndarray | None = None  # (n,) residue numbers, if residues are molecules and numbered


def massive_sites(molecule: Molecule) -> np.ndarray:
    """Indices of the sites of a molecule that have mass, and so are atoms."""
    return np.flatnonzero(molecule.masses > 0)


def match(
    atoms: Atoms, species: list[Molecule], cell: np.ndarray | None, tolerance: float
) -> MatchedMolecules | list[str]:
    """The molecules that the atoms form, or error messages. The cell (3, 3), if any, has faces across which molecules
    may be split; tolerance: see Scene.structure."""
    kinds = _kinds(atoms, species)
    runs = [list(run) for _, run in groupby(range(len(kinds)), key=lambda i: atoms.residue[i])]
    by_residue = _match_groups(atoms, kinds, runs, species, cell, tolerance, "") if atoms.residue[0] else []
    if isinstance(by_residue, MatchedMolecules):
        numbers = [atoms.residue[run[0]][0] for run in runs]
        return by_residue if None in numbers else by_residue._replace(number=np.array(numbers))
    runs_by_bonds, endless = _bonded(atoms, kinds, species, cell)
    by_bonds = _match_groups(atoms, kinds, runs_by_bonds, species, cell, tolerance, ", by bonding distance", endless)
    if isinstance(by_bonds, MatchedMolecules):
        note = "its residues are not the molecules of the scene, which were found by bonding distance"
        by_bonds.notes.extend([note] if by_residue else [])
        return by_bonds
    if by_residue and len(runs) > 1:
        return by_residue
    known = {"X"}.union(*map(_labels, species))
    if unknown := sorted({name for name, kind in zip(atoms.names, kinds, strict=True) if kind not in known}):
        names = ", ".join(name or "(no name)" for name in unknown[:5]) + (", ..." if len(unknown) > 5 else "")
        wanted = ", ".join(f"{molecule.name} ({_composition(molecule)})" for molecule in species)
        return [f"has atoms named {names}, which are in no molecule of the scene: {wanted}"]
    return by_bonds


def refit(
    position: np.ndarray, matched: MatchedMolecules, species: list[Molecule], cell: np.ndarray | None
) -> MatchedMolecules:
    """The same molecules fitted to new positions (a, 3) of their atoms, for any deviation."""
    fit = TemplateFit(*map(np.zeros_like, matched.fit))
    for k in np.unique(matched.species):
        members = np.flatnonzero(matched.species == k)
        points = position[np.array([matched.atoms[m] for m in members])]
        points = make_whole(points, cell, _reach(species[k], np.eye(points.shape[1], dtype=bool)))
        for array, values in zip(fit, _fit(points, species[k]), strict=True):
            array[members] = values
    return matched._replace(fit=fit)


def _labels(molecule: Molecule) -> list[str]:
    """Label of each site: its element, else its name. Atoms with the same label are interchangeable."""
    return [e if e != "X" else name for e, name in zip(molecule.elements, molecule.site_names, strict=True)]


def _kinds(atoms: Atoms, species: list[Molecule]) -> list[str]:
    """The label of every atom: its element, or the name of a site; X for massless ones. "?" marks a guess.

    An element in the file is accepted. A name counts if it is the name of a site or begins with an element of the
    scene. If the file has masses, names of sites and elements have priority over the mass, and the mass over the
    beginning of any other name.
    """
    by_name, by_mass = {}, []
    for molecule in species:
        for name, label, mass in zip(molecule.site_names, _labels(molecule), molecule.masses, strict=True):
            by_name.setdefault(name, set()).add(label if mass > 0 else "X")
            by_mass += [(mass, label)] if mass > 0 else []
    vocabulary = frozenset(label for _, label in by_mass)
    open_names = {name for name, labels in by_name.items() if len(labels) > 1}
    by_name = {name: labels.pop() for name, labels in by_name.items() if len(labels) == 1}
    site_names = set(by_name) - vocabulary
    points = {name: _labels(m)[0] for m in species if len(m.masses) == 1 for name in m.residue_names}
    shared = {name for m in species if len(m.masses) > 1 for name in m.residue_names}
    virtual = CHARMM_WATER[1] if set(CHARMM_WATER) <= set(atoms.names) else None
    hydrogen = next((h for h in ("H", "D", "T") if h in vocabulary), "")

    def isotope(element: str) -> str:
        """The isotope of hydrogen in the scene, for others in the file: light water from a file of heavy water."""
        return hydrogen if hydrogen and element in ("H", "D", "T") and element not in vocabulary else element

    @cache
    def kind(name: str, element: str, mass: float, residue: str | None) -> str:
        if 0 < mass < NO_MASS:
            return "X"
        if mass > 0:
            if name == "X" or isotope(name) in vocabulary:
                return isotope(name)
            if name in site_names:
                return by_name[name]
            nearest, label = min(by_mass, key=lambda entry: abs(entry[0] - mass))
            if abs(nearest - mass) <= SAME_MASS * mass:
                return label
            if (guess := isotope(element_of(name, vocabulary))) in vocabulary:
                return guess
        if name in site_names and (not element or element == "X"):
            return by_name[name]
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
    return [kind(*atom) for atom in zip(atoms.names, atoms.elements, masses.tolist(), residues, strict=True)]


def _reach(molecule: Molecule, allowed: np.ndarray) -> np.ndarray:
    """Largest lengths (s, s) of bonds between atoms, Å, given the sites that each may be, `allowed` (s, s). Bonds are
    the shortest links of the template; other pairs of atoms have 0."""
    points = molecule.positions_body[massive_sites(molecule)]
    reach = np.zeros((len(points), len(points)))
    for i, j in shortest_links(points):
        pairs = np.outer(allowed[i], allowed[j])
        longest = BOND_REACH * np.linalg.norm(points[i] - points[j])
        reach = np.maximum(reach, longest * (pairs | pairs.T))
    return reach


def _bonded(
    atoms: Atoms, kinds: list[str], species: list[Molecule], cell: np.ndarray | None
) -> tuple[list[list[int]], set[int]]:
    """Groups of atoms with mass, in file order, linked by bonds as long as in the templates' spanning trees, and the
    first atoms of groups without an end: bonded to their own images, as in polymers."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    numbers = {kind: k for k, kind in enumerate({*kinds}.union(*map(_labels, species)))}
    reach = np.zeros((len(numbers), len(numbers)))
    for molecule in species:
        sites = massive_sites(molecule)
        points = molecule.positions_body[sites]
        number = [numbers[_labels(molecule)[s]] for s in sites]
        for i, j in shortest_links(points):
            one, other, length = number[i], number[j], float(np.linalg.norm(points[i] - points[j]))
            reach[one, other] = reach[other, one] = max(reach[one, other], BOND_REACH * length)
    with_mass = np.array([i for i, kind in enumerate(kinds) if kind != "X"], int)
    number = np.array([numbers[kinds[i]] for i in with_mass], int)
    i, j, step = pairs_within(atoms.position[with_mass], cell, reach.max())
    bonded = np.linalg.norm(step, axis=1) <= reach[number[i], number[j]]
    i, j, step = i[bonded], j[bonded], step[bonded]
    shape = (len(with_mass), len(with_mass))
    count, label = connected_components(coo_array((np.ones(len(i)), (i, j)), shape=shape), directed=False)
    runs = [[] for _ in range(count)]
    for atom, component in zip(with_mass, label, strict=True):
        runs[component].append(atom)
    endless = set() if cell is None else {runs[c][0] for c in _endless(label, i, j, step)}
    return sorted(runs), endless


def _endless(label: np.ndarray, i: np.ndarray, j: np.ndarray, step: np.ndarray) -> set[int]:
    """Components (labels of atoms) whose bonds i, j with vectors step (b, 3) close a ring through the periodic cell."""
    i, j, step = np.append(i, j), np.append(j, i), np.vstack([step, -step])
    position, reached = np.zeros((len(label), 3)), np.zeros(len(label), bool)
    reached[np.unique(label, return_index=True)[1]] = True
    while len(onward := np.flatnonzero(reached[i] & ~reached[j])):
        position[j[onward]] = position[i[onward]] + step[onward]
        reached[j[onward]] = True
    gap = np.linalg.norm(position[i] + step - position[j], axis=1)
    return set(label[i[gap > SAME_PLACE * np.linalg.norm(step, axis=1)]].tolist())


class _Candidate(NamedTuple):
    """A species that a group of atoms may be."""

    species: int
    order: list[int]  # atoms of the group, in the order of the sites with mass
    allowed: list[np.ndarray]  # (s, s) whether a site may be each atom of this order: by names, then by elements
    nameless: bool


def _match_groups(
    atoms: Atoms, kinds: list[str], runs: list[list[int]], species: list[Molecule], cell, tolerance: float, how: str,
    endless: Collection[int] = ()
) -> MatchedMolecules | list[str]:  # fmt: skip
    """Each run of atoms as one molecule. Runs of one composition are fitted together. how : text for messages.
    endless : first atoms of runs that are bonded to their own images."""

    def described(number: int) -> str:
        run = runs[number]
        listed = ", ".join(str(i + 1) for i in run[:MOST_LISTED]) + (", ..." if len(run) > MOST_LISTED else "")
        if run == list(range(run[0], run[-1] + 1)):
            listed = f"{run[0] + 1} to {run[-1] + 1}" if len(run) > 1 else f"{run[0] + 1}"
        residue = f", residue {atoms.residue[run[0]][1]!r}" if "".join(atoms.residue[run[0]][1:2]) else ""
        return f"molecule {number + 1} (atom{'s' * (len(run) > 1)} {listed}{residue}{how})"

    alike, faults, n = {}, {}, len(runs)
    for number, run in enumerate(runs):
        residue = atoms.residue[run[0]]
        key = (residue[1] if residue else "", tuple(atoms.names[i] for i in run), tuple(kinds[i] for i in run))
        alike.setdefault(key, []).append(number)
    fit = TemplateFit(np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros(n), np.zeros(n))
    found = MatchedMolecules(np.full(n, -1), [np.zeros(0, int)] * n, fit, massless=Counter(), notes=[])
    for (residue, names, run_kinds), members in alike.items():
        named = [k for k, molecule in enumerate(species) if residue and residue in molecule.residue_names]
        eligible = named or list(range(len(species)))
        candidates = [c for k in eligible if (c := _candidate(names, run_kinds, species[k], k))]
        if not candidates:
            has = _formula(kind.rstrip("?") for kind in run_kinds)
            wanted = " or ".join(f"{species[k].name} ({_composition(species[k])})" for k in eligible)
            faults |= {m: f"has atoms {has}, expected {wanted}" for m in members}
            continue
        _fit_group(atoms, [runs[m] for m in members], members, candidates, species, cell, tolerance, found, faults)
        if any(c.nameless for c in candidates) and not faults:
            listed = ", ".join(name or "(no name)" for name in names)
            by_shape = species[found.species[members[0]]].name
            found.notes.append(f"the names of atoms {listed} are not elements: assigned to {by_shape} by shape")
    for number, run in enumerate(runs):
        if run[0] in endless:
            has = _formula(kinds[i].rstrip("?") for i in run)
            faults[number] = f"({has}) is bonded to its own image in the next cell: a polymer, not a molecule"
    if faults:
        return [f"{described(m)} {fault}" for m, fault in sorted(faults.items())]
    others = np.delete(np.arange(len(kinds)), np.concatenate([np.zeros(0, int), *found.atoms]))
    found.massless.update(atoms.names[i] for i in others)
    return found


def _formula(elements) -> str:
    return " ".join(f"{element}{count if count > 1 else ''}" for element, count in Counter(elements).items())


def _composition(molecule: Molecule) -> str:
    return _formula(_labels(molecule)[i] for i in massive_sites(molecule))


def _candidate(names: tuple, kinds: tuple, molecule: Molecule, k: int) -> _Candidate | None:
    """A run of atoms as a molecule of this species, or None. Atoms are assigned by names that occur as often among the
    atoms as among the sites, else by element. The order of atoms with the same name follows from the geometry."""
    sites = massive_sites(molecule)
    labels = _labels(molecule)
    wanted = [(molecule.site_names[s], labels[s]) for s in sites]
    if names == molecule.site_names and all(kinds[s] == labels[s] or kinds[s].endswith("?") for s in sites):
        # as in the files of a run, also if several sites have the same name
        return _Candidate(k, sites.tolist(), [np.eye(len(sites), dtype=bool), _same(labels[s] for s in sites)], False)
    indices = [i for i, kind in enumerate(kinds) if kind != "X"]
    if len(indices) > len(sites):
        massless = {name for name, mass in zip(molecule.site_names, molecule.masses, strict=True) if mass == 0}
        indices = [i for i in indices if not (kinds[i].endswith("?") and names[i] in massless)]
    if len(indices) != len(sites):
        return None
    if len(indices) > 1 and all(kinds[i].endswith("?") for i in indices):
        return _Candidate(k, indices, [np.ones((len(sites), len(sites)), bool)], nameless=True)
    present = [(names[i], kinds[i]) for i in indices]
    if Counter(kind for _, kind in present) != Counter(label for _, label in wanted):
        return None
    count, count_wanted = Counter(present), Counter(wanted)
    shared = {atom for atom in count if count[atom] == count_wanted[atom]}
    group, group_wanted = ([key if key in shared else key[1] for key in keys] for keys in (present, wanted))
    queues: dict[Any, deque[int]] = {key: deque() for key in group_wanted}
    for index, key in zip(indices, group, strict=True):
        queues[key].append(index)
    order = [queues[key].popleft() for key in group_wanted]
    return _Candidate(k, order, [_same(group_wanted), _same(label for _, label in wanted)], nameless=False)


def _same(keys: Iterable[Hashable]) -> np.ndarray:
    """Mask (n, n) of equal keys."""
    numbers: dict[Hashable, int] = {}
    number = np.array([numbers.setdefault(key, len(numbers)) for key in keys])
    return number[:, None] == number


def _fit_group(
    atoms, runs, members, candidates, species, cell, tolerance, found: MatchedMolecules, faults: dict
) -> None:
    """Fit runs of one composition to their candidates; write into `found` or `faults`."""
    fits = []
    for c in candidates:
        order = np.array(runs)[:, c.order]
        fits.append((order, _fit_in_any_order(atoms.position, order, species[c.species], cell, c.allowed, tolerance)))
    for row, m in enumerate(members):
        limits = [tolerance * species[c.species].radius for c in candidates]
        fitting = [k for k, (_, fit) in enumerate(fits) if len(fits[k][0][row]) == 1 or fit.deviation[row] <= limits[k]]
        if len(fitting) == 1:
            order, fit = fits[fitting[0]]
            found.species[m] = candidates[fitting[0]].species
            found.atoms[m] = order[row]
            for array, values in zip(found.fit, fit, strict=True):
                array[m] = values[row]
        elif fitting:
            names = " or ".join(species[candidates[k].species].name for k in fitting)
            faults[m] = f"may be {names}: give them residue_names in the scene"
        else:
            off = np.array([fit.deviation[row] for _, fit in fits])
            for k, c in enumerate(candidates if len(faults) < MOST_SEARCHED else ()):  # of the best order found
                molecule, wide = species[c.species], SEARCH_TOLERANCE * limits[k]
                points = atoms.position[fits[k][0][row]][None]
                points = make_whole(points, cell, _reach(molecule, c.allowed[-1]))
                if (best := _search_order(points[0], molecule, c.allowed[-1], wide, MOST_TRIES // 10)) is not None:
                    off[k] = min(off[k], _fit(points[:, best], molecule).deviation[0])
            k = int(np.argmin(off / limits))
            limit = f"more than {limits[k]:.3f} Å (structure.tolerance)"
            name = species[candidates[k].species].name
            faults[m] = f"is not {name}: an atom is {off[k]:.3f} Å from the rigid template, {limit}"


def _fit_in_any_order(
    position: np.ndarray, order: np.ndarray, molecule: Molecule, cell, allowed: list[np.ndarray], tolerance: float
) -> TemplateFit:
    """The fit of molecules to their atoms `order` (m, s), which is corrected in place where another order fits. Each
    mask of `allowed`, see _Candidate, is tried where the ones before it give no fit."""
    limit = tolerance * molecule.radius
    points = make_whole(position[order], cell, _reach(molecule, allowed[-1]))
    fit = _fit(points, molecule)
    for mask in allowed:
        bad = np.flatnonzero(fit.deviation > limit)
        if len(bad) and mask.sum() > len(mask):
            bad = bad[_distances_agree(points[bad], molecule, mask, limit)]
            while len(bad):
                better = _search_order(points[bad[0]], molecule, mask, limit)
                if better is None:
                    bad = bad[1:]
                    continue
                new_fit = _fit(points[bad][:, better], molecule)  # files are regular: this order fits most others
                fits = new_fit.deviation <= limit
                for old, new in zip(fit, new_fit, strict=True):
                    old[bad[fits]] = new[fits]
                order[bad[fits]] = order[bad[fits]][:, better]
                fits[0] = True  # even if rounding puts it just above the limit
                bad = bad[~fits]
    return fit


def _distances_agree(points: np.ndarray, molecule: Molecule, allowed: np.ndarray, limit: float) -> np.ndarray:
    """Which molecules (m, s, 3) have the same sorted distances between two kinds of atoms as the template, within twice
    the limit, as every molecule that fits does."""
    template = molecule.positions_body[massive_sites(molecule)]
    i, j = np.triu_indices(len(template), 1)
    kind = allowed.argmax(axis=1)
    pair = np.minimum(kind[i], kind[j]) * len(kind) + np.maximum(kind[i], kind[j])

    def sorted_distances(points: np.ndarray) -> np.ndarray:
        distance = np.linalg.norm(points[:, i] - points[:, j], axis=2)
        return np.take_along_axis(distance, np.lexsort((distance, np.broadcast_to(pair, distance.shape)), axis=1), 1)

    wanted = sorted_distances(template[None])
    blocks = np.array_split(points, 1 + len(points) * len(i) // MOST_DISTANCES)
    return np.concatenate([(np.abs(sorted_distances(b) - wanted) <= 2 * limit).all(axis=1) for b in blocks])


def _fit(points: np.ndarray, molecule: Molecule) -> TemplateFit:
    """Best rigid fit of a template to whole molecules (m, s, 3), with coinciding centres of mass."""
    sites = massive_sites(molecule)
    masses, template = molecule.masses[sites], molecule.positions_body[sites]
    centre = points[:, 0] + np.einsum("s,nsk->nk", masses, points - points[:, :1]) / masses.sum()
    relative = points - centre[:, None]
    rotation = align(template, relative, masses)
    off = np.linalg.norm(relative - np.einsum("nij,sj->nsi", rotation, template), axis=2)
    return TemplateFit(centre, rotation, off.max(axis=1), (off**2).mean(axis=1))


def _search_order(
    points: np.ndarray, molecule: Molecule, allowed: np.ndarray, limit: float, most: int = MOST_TRIES
) -> list[int] | None:
    """An order of the atoms (s, 3) in which the template fits within `limit`, or None. A depth-first search assigns
    atoms to sites one by one so that all distances agree: first closely, then up to twice the limit, which every fit
    within the limit satisfies."""
    template = molecule.positions_body[massive_sites(molecule)]
    wanted = np.linalg.norm(template[:, None] - template, axis=2)
    there = np.linalg.norm(points[:, None] - points, axis=2)
    tries = 0

    def extended(order: list[int], closeness: float) -> list[int] | None:
        nonlocal tries
        site = len(order)
        tries += 1
        if tries > most:
            return None
        if site == len(points):
            return order if _fit(points[None, order], molecule).deviation[0] <= limit else None
        off = np.abs(there[:, order] - wanted[site, :site]).max(axis=1, initial=0.0)
        off[order] = inf
        off[~allowed[site]] = inf
        for atom in np.argsort(off):
            if off[atom] > closeness:
                return None
            if found := extended([*order, int(atom)], closeness):
                return found
        return None

    for closeness in (0.1, 0.5, 2.0):
        tries = 0
        if found := extended([], closeness * limit):
            return found
    return None
