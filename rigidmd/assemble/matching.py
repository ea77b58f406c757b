"""Assigns the atoms of a file to molecules, by residues or else by bonding distance, and fits rigid
templates."""

from collections import Counter, deque
from collections.abc import Collection, Hashable
from itertools import groupby
from typing import NamedTuple

import numpy as np

from rigidmd.assemble.assignment import (
    EQUAL_OF_RADIUS,
    Assignment,
    Orders,
    TemplateFit,
    bond_reach,
    fit_template,
    massive_sites,
    numbered,
)
from rigidmd.assemble.atom_kinds import kinds_of, labels_of
from rigidmd.assemble.bonded_atoms import bonded_atoms
from rigidmd.formats.atoms import Atoms
from rigidmd.formats.cells import make_whole
from rigidmd.scene.models import Molecule

#: Up to this multiple of the tolerance the best order of atoms is searched, for messages on
#: molecules that do not fit.
SEARCH_TOLERANCE = 3
MOST_SEARCHED = 5  # of these molecules
MOST_LISTED = 6  # atoms of a molecule in a message
#: If two species fit, the better one is taken if its rms deviation is less than this fraction of
#: the other's: as models of water that differ, a .gro has 0.004 and 0.05 Å.
EXACTLY = 0.1
#: A mirror image or another order is noted if its rms deviation is less than this fraction of the
#: deviation of a molecule, which is more than the second fraction of the radius.
CLEARLY_BETTER, CLOSE_FIT = 0.5, 0.02


class MatchedMolecules(NamedTuple):
    """The molecules of a file, in the order of the file."""

    species: np.ndarray  # (n,)
    atoms: list[np.ndarray]  # atoms of each molecule, in the order of its sites with mass
    fit: TemplateFit  # of the n molecules
    massless: Counter  # number of massless atoms in the file, by name
    notes: list[str]
    number: np.ndarray | None = None  # (n,) residue numbers, if residues are molecules and numbered


def match(
    atoms: Atoms, species: list[Molecule], cell: np.ndarray | None, tolerance: float
) -> MatchedMolecules | list[str]:
    """The molecules that the atoms form, or error messages. The cell (3, 3), if any, has faces
    across which molecules may be split; tolerance: see Scene.structure."""
    kinds = kinds_of(atoms, species)
    matcher = _Matcher(atoms, kinds, species, cell, tolerance)
    runs = [list(run) for _, run in groupby(range(len(kinds)), key=lambda i: atoms.residue[i])]
    by_residue = matcher.match(runs, "") if atoms.residue[0] else []
    if isinstance(by_residue, MatchedMolecules):
        numbers = [atoms.residue[run[0]][0] for run in runs]
        return by_residue if None in numbers else by_residue._replace(number=np.array(numbers))
    runs_by_bonds, endless = bonded_atoms(atoms, kinds, species, cell)
    by_bonds = matcher.match(runs_by_bonds, ", by bonding distance", endless)
    if isinstance(by_bonds, MatchedMolecules):
        note = (
            "its residues are not the molecules of the scene, which were found by bonding distance"
        )
        by_bonds.notes.extend([note] if by_residue else [])
        return by_bonds
    if by_residue and len(runs) > 1:
        return by_residue
    known = {"X"}.union(*map(labels_of, species))
    if unknown := sorted(
        {name for name, kind in zip(atoms.names, kinds, strict=True) if kind not in known}
    ):
        names = ", ".join(name or "(no name)" for name in unknown[:5]) + (
            ", ..." if len(unknown) > 5 else ""
        )
        expected = ", ".join(f"{molecule.name} ({_composition(molecule)})" for molecule in species)
        return [f"has atoms named {names}, which are in no molecule of the scene: {expected}"]
    return by_bonds


def refit(
    position: np.ndarray,
    matched: MatchedMolecules,
    species: list[Molecule],
    cell: np.ndarray | None,
) -> MatchedMolecules:
    """The same molecules fitted to new positions (a, 3) of their atoms, for any deviation."""
    fit = TemplateFit(*map(np.zeros_like, matched.fit))
    for k in np.unique(matched.species):
        members = np.flatnonzero(matched.species == k)
        points = position[np.array([matched.atoms[m] for m in members])]
        template = species[k].positions_body[massive_sites(species[k])]
        points = make_whole(points, cell, bond_reach(template, np.arange(len(template))))
        for array, values in zip(fit, fit_template(points, species[k]), strict=True):
            array[members] = values
    return matched._replace(fit=fit)


class _Candidate(NamedTuple):
    """A species that a group of atoms may be."""

    species: int
    order: list[int]  # atoms of the group, in the order of the sites with mass
    #: (s,) atoms of one class may be exchanged: by names, then by elements
    classes: list[np.ndarray]
    nameless: bool


class _Group(NamedTuple):
    """Runs of atoms of the same names and kinds as one species."""

    candidate: _Candidate
    points: np.ndarray  # (m, s, 3) whole molecules, sites in the order of the candidate
    order: np.ndarray  # (m, s) atoms of the file, alike
    assigned: Assignment
    limit: float  # largest deviation, Å

    @property
    def fits(self) -> np.ndarray:
        """Whether each molecule fits (m,)."""
        return (self.assigned.fit.deviation <= self.limit) | (self.order.shape[1] == 1)


class _Matcher:
    """Matches runs of atoms to species."""

    def __init__(
        self,
        atoms: Atoms,
        kinds: list[str],
        species: list[Molecule],
        cell: np.ndarray | None,
        tolerance: float,
    ):
        self._atoms, self._kinds, self._species = atoms, kinds, species
        self._cell, self._tolerance = cell, tolerance
        self._orders: dict[tuple, Orders] = {}

    def match(
        self, runs: list[list[int]], how: str, endless: Collection[int] = ()
    ) -> MatchedMolecules | list[str]:
        """Each run of atoms as one molecule. Runs of one composition are fitted together.

        how : text for messages
        endless : first atoms of runs that are bonded to their own images
        """
        atoms = self._atoms
        kinds = self._kinds
        n = len(runs)
        alike: dict[tuple, list[int]] = {}
        for number, run in enumerate(runs):
            residue = atoms.residue[run[0]]
            names = tuple(atoms.names[i] for i in run)
            key = (residue[1] if residue else "", names, tuple(kinds[i] for i in run))
            alike.setdefault(key, []).append(number)
        fit = TemplateFit(np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros(n), np.zeros(n))
        matched = MatchedMolecules(np.full(n, -1), [np.zeros(0, int)] * n, fit, Counter(), notes=[])
        faults: dict[int, str] = {}
        notes: Counter[str] = Counter()
        for (residue, names, run_kinds), members in alike.items():
            groups = self._groups(residue, names, run_kinds, np.array([runs[m] for m in members]))
            if isinstance(groups, str):
                faults |= dict.fromkeys(members, groups)
                continue
            faults |= self._choose(groups, members, matched, notes, len(faults))
            if any(group.candidate.nameless for group in groups) and not faults:
                listed = ", ".join(name or "(no name)" for name in names)
                by_shape = self._species[matched.species[members[0]]].name
                notes[
                    f"the names of atoms {listed} are not elements: assigned to {by_shape} by shape"
                ] += 1
        for number, run in enumerate(runs):
            if run[0] in endless:
                has = _formula(kinds[i].rstrip("?") for i in run)
                image = f"({has}) is bonded to its own image in the next cell"
                faults[number] = f"{image}: a polymer, not a molecule"
        if faults:
            return [
                f"{self._described(m, runs[m], how)} {fault}" for m, fault in sorted(faults.items())
            ]
        others = np.delete(
            np.arange(len(kinds)), np.concatenate([np.zeros(0, int), *matched.atoms])
        )
        matched.massless.update(atoms.names[i] for i in others)
        matched.notes.extend(
            note.replace(COUNT, f"{count} molecule{'s' * (count > 1)}")
            for note, count in notes.items()
        )
        return matched

    def _described(self, number: int, run: list[int], how: str) -> str:
        listed = ", ".join(str(i + 1) for i in run[:MOST_LISTED]) + (
            ", ..." if len(run) > MOST_LISTED else ""
        )
        if run == list(range(run[0], run[-1] + 1)):
            listed = f"{run[0] + 1} to {run[-1] + 1}" if len(run) > 1 else f"{run[0] + 1}"
        residue = self._atoms.residue[run[0]]
        named = f", residue {residue[1]!r}" if "".join(residue[1:2]) else ""
        return f"molecule {number + 1} (atom{'s' * (len(run) > 1)} {listed}{named}{how})"

    def _groups(
        self, residue: str, names: tuple, kinds: tuple, runs: np.ndarray
    ) -> list[_Group] | str:
        """Runs (m, a) of atoms as molecules of each species that they may be, or why they are
        none."""
        named = [k for k, m in enumerate(self._species) if residue and residue in m.residue_names]
        eligible = named or list(range(len(self._species)))
        candidates = [c for k in eligible if (c := _candidate(names, kinds, self._species[k], k))]
        if not candidates:
            expected = " or ".join(
                f"{self._species[k].name} ({_composition(self._species[k])})" for k in eligible
            )
            return f"has atoms {_formula(kind.rstrip('?') for kind in kinds)}, expected {expected}"
        return [self._assigned(c, runs[:, c.order]) for c in candidates]

    def _assigned(self, candidate: _Candidate, order: np.ndarray) -> _Group:
        """The best order of atoms (m, s) by names, and for molecules that do not fit so, by
        elements."""
        by_names, by_elements = (
            self._orders_of(candidate.species, classes) for classes in candidate.classes
        )
        points = make_whole(self._atoms.position[order], self._cell, by_elements.reach)
        assigned = by_names.best(points)
        if by_elements is not by_names:
            bad = np.flatnonzero(assigned.fit.deviation > by_names.limit)
            other = by_elements.best(points[bad])
            assigned = assigned.with_better(bad, other, by_names.limit)
        order = np.take_along_axis(order, assigned.order, axis=1)
        return _Group(candidate, points, order, assigned, by_names.limit)

    def _orders_of(self, species: int, classes: np.ndarray) -> Orders:
        key = (species, *classes.tolist())
        if key not in self._orders:
            molecule = self._species[species]
            self._orders[key] = Orders(molecule, classes, self._tolerance * molecule.radius)
        return self._orders[key]

    def _choose(
        self,
        groups: list[_Group],
        members: list[int],
        matched: MatchedMolecules,
        notes: Counter[str],
        known: int,
    ) -> dict[int, str]:
        """Write the species of molecules `members`, of which `groups` are the possible ones, into
        `matched`. Returns error messages by molecule. `known` is the number of earlier ones."""
        faults = {}
        # (groups, m)
        rms = np.array([np.where(g.fits, g.assigned.fit.rms, np.inf) for g in groups])
        chosen = rms.argmin(axis=0)
        fitting = np.asarray(np.isfinite(rms))
        clear = np.where(np.eye(len(groups), dtype=bool)[chosen].T, np.inf, rms).min(axis=0)
        least = rms.min(axis=0) + EQUAL_OF_RADIUS * max(g.limit for g in groups) / self._tolerance
        doubtful = (fitting.sum(axis=0) > 1) & (least >= EXACTLY * clear)
        for row, m in enumerate(members):
            if doubtful[row]:
                names = " or ".join(
                    self._name(g) for g, fits in zip(groups, fitting[:, row], strict=True) if fits
                )
                faults[m] = f"may be {names}: give them residue_names in the scene"
            elif not fitting[:, row].any():
                faults[m] = self._misfit(groups, row, search=known + len(faults) < MOST_SEARCHED)
            else:
                group = groups[chosen[row]]
                matched.species[m], matched.atoms[m] = group.candidate.species, group.order[row]
                for array, values in zip(matched.fit, group.assigned.fit, strict=True):
                    array[m] = values[row]
        if not faults:
            for k, group in enumerate(groups):
                self._note(group, chosen == k, rms, notes, [self._name(other) for other in groups])
        return faults

    def _name(self, group: _Group) -> str:
        return self._species[group.candidate.species].name

    def _misfit(self, groups: list[_Group], row: int, *, search: bool) -> str:
        """Why a molecule fits no species. search : whether for better orders, beyond the limit"""
        off = np.array([group.assigned.fit.deviation[row] for group in groups])
        mirrored = []
        for k, group in enumerate(groups if search else ()):
            orders = self._orders_of(group.candidate.species, group.candidate.classes[-1])
            points = group.points[row]
            if (best := orders.search(points, SEARCH_TOLERANCE * group.limit)) is not None:
                off[k] = min(off[k], fit_template(points[None, best], orders.molecule).deviation[0])
            if orders.search(MIRROR * points, group.limit) is not None:
                mirrored.append(self._name(group))
        k = int(np.argmin(off / [group.limit for group in groups]))
        limit = f"more than {groups[k].limit:.3f} Å (structure.tolerance)"
        message = (
            f"is not {self._name(groups[k])}: an atom is {off[k]:.3f} Å from the rigid template,"
            f" {limit}"
        )
        if mirrored:
            advice = (
                "a mirror image is another rigid molecule: add a species with mirrored positions"
            )
            message += f". It is the mirror image of {mirrored[0]}; {advice}"
        return message

    def _note(
        self,
        group: _Group,
        rows: np.ndarray,
        rms: np.ndarray,
        notes: Counter[str],
        names: list[str],
    ) -> None:
        """Add notes on the molecules `rows` of a group: what else fits them. rms (groups, m), Å, as
        each of `names`"""
        name = self._name(group)
        fit = group.assigned.fit
        count = int(rows.sum())
        if not count:
            return
        orders = self._orders_of(group.candidate.species, group.candidate.classes[-1])
        fits_one = np.isfinite(rms[:, rows]).any(axis=1)
        others = [names[k] for k in np.flatnonzero(fits_one)]
        if len(others) > 1:
            best = " and not ".join([name, *(other for other in others if other != name)])
            notes[f"{COUNT} taken for {best}, which fits less well"] += count
        if equal := int((group.assigned.rival[rows] <= orders.equal_to(fit.rms[rows])).sum()):
            advice = "name the atoms in the file as the sites of the model"
            what = (
                "two orders of its atoms, in which different sites are exchanged, fit equally well"
            )
            notes[f"{COUNT} of {name}: {what}: the order of the file decides; {advice}"] += equal
        worst = np.flatnonzero(rows)[fit.rms[rows].argmax()]
        least = fit.rms[worst]
        if least <= CLOSE_FIT * orders.molecule.radius:
            return
        points = group.points[worst]
        for what, other_points in (
            ("its mirror image", MIRROR * points),
            ("another order of atoms", points),
        ):
            order = orders.search(other_points, group.limit)
            if order is None:
                continue
            other = fit_template(other_points[None, order], orders.molecule).rms[0]
            if other < CLEARLY_BETTER * least:
                notes[
                    f"a molecule fits {name} with {least:.3f} Å (rms), and {what} with"
                    f" {other:.3f} Å"
                ] += 1


#: Stands for "3 molecules" in notes.
COUNT = "{count}"
#: Factors on coordinates of a mirror image.
MIRROR = np.array([-1.0, 1.0, 1.0])


def _formula(elements) -> str:
    return " ".join(
        f"{element}{count if count > 1 else ''}" for element, count in Counter(elements).items()
    )


def _composition(molecule: Molecule) -> str:
    return _formula(labels_of(molecule)[i] for i in massive_sites(molecule))


def _candidate(names: tuple, kinds: tuple, molecule: Molecule, k: int) -> _Candidate | None:
    """A run of atoms as a molecule of this species, or None. Atoms are assigned by names that occur
    as often among the atoms as among the sites, else by element. The order of atoms with the same
    name follows from the geometry."""
    sites = massive_sites(molecule)
    labels = labels_of(molecule)
    template = [(molecule.site_names[s], labels[s]) for s in sites]
    if names == molecule.site_names and all(
        kinds[s] == labels[s] or kinds[s].endswith("?") for s in sites
    ):
        # as in the files of a run, also if several sites have the same name
        by_names = numbered(molecule.site_names[s] for s in sites)
        return _Candidate(
            k, sites.tolist(), [by_names, numbered(labels[s] for s in sites)], nameless=False
        )
    indices = [i for i, kind in enumerate(kinds) if kind != "X"]
    if len(indices) > len(sites):
        massless = {
            name
            for name, mass in zip(molecule.site_names, molecule.masses, strict=True)
            if mass == 0
        }
        indices = [i for i in indices if not (kinds[i].endswith("?") and names[i] in massless)]
    if len(indices) != len(sites):
        return None
    if len(indices) > 1 and all(kinds[i].endswith("?") for i in indices):
        alike = np.zeros(len(sites), int)
        return _Candidate(k, indices, [alike, alike], nameless=True)
    present = [(names[i], kinds[i]) for i in indices]
    if Counter(kind for _, kind in present) != Counter(label for _, label in template):
        return None
    count, count_wanted = Counter(present), Counter(template)
    shared = {atom for atom in count if count[atom] == count_wanted[atom]}
    group, group_wanted = (
        [key if key in shared else key[1] for key in keys] for keys in (present, template)
    )
    queues: dict[Hashable, deque[int]] = {key: deque() for key in group_wanted}
    for index, key in zip(indices, group, strict=True):
        queues[key].append(index)
    order = [queues[key].popleft() for key in group_wanted]
    classes = [numbered(group_wanted), numbered(label for _, label in template)]
    return _Candidate(k, order, classes, nameless=False)
