"""Assigns the atoms of molecules to the sites of a rigid template, in the order that fits best.

Unique names of sites fix the order, as in most .gro and .pdb files. An order is searched for files
that have elements only (.xyz, .cif, .gen, POSCAR), for names that several atoms share, and for
molecules that symmetry or bonding distances put together, whose atoms are in another order in each.
"""

from collections.abc import Hashable, Iterable, Iterator
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from rigidmd.formats.bonds import shortest_links
from rigidmd.mechanics.rotation import align
from rigidmd.scene.models import Molecule

#: Atoms are bonded up to this multiple of the template's longest bond between such atoms. Hydrogen
#: bonds of water are at least 1.6 times as long as its bonds.
BOND_REACH = 1.25
#: Two orders fit equally well if their rms deviations differ by less than this factor and this
#: fraction of the radius.
EQUAL, EQUAL_OF_RADIUS = 1.2, 1e-4
#: A template is linear if no atom is farther from its axis than this fraction of its radius.
LINEAR = 0.01
#: Atoms that fix an orientation are at least this fraction of the largest possible distance from
#: centre and axis.
WIDE = 0.4
MOST_STARTS = 4000  # orientations from which orders are searched
FIRST_STARTS = 32  # the most likely ones, after which the search may end
MOST_REFINEMENTS = 10
MOST_DISTANCES = 1_000_000  # computed at once


class TemplateFit(NamedTuple):
    """Rigid templates fitted to m molecules of s sites with mass."""

    centre: np.ndarray  # (m, 3) Å
    rotation: np.ndarray  # (m, 3, 3)
    deviation: np.ndarray  # (m,) largest distance of an atom from the template, Å
    square: np.ndarray  # (m,) mean square of these distances, Å²

    @property
    def rms(self) -> np.ndarray:
        """Root of the mean square distance (m,), Å."""
        return np.sqrt(self.square)


class Assignment(NamedTuple):
    """The best orders of atoms of m molecules."""

    order: np.ndarray  # (m, s) atom of each site
    fit: TemplateFit
    #: (m,) rms of the best order in which an atom is a site with other parameters, Å; inf if none
    rival: np.ndarray

    def of(self, rows: np.ndarray) -> "Assignment":
        """That of some of the molecules."""
        return Assignment(
            self.order[rows], TemplateFit(*(values[rows] for values in self.fit)), self.rival[rows]
        )

    def with_better(self, rows: np.ndarray, others: "Assignment", limit: float) -> "Assignment":
        """The same with others in place of some rows where these fit within a limit."""
        better = others.fit.deviation <= limit
        order, rival = self.order.copy(), self.rival.copy()
        order[rows[better]], rival[rows[better]] = others.order[better], others.rival[better]
        fit = TemplateFit(*(values.copy() for values in self.fit))
        for array, values in zip(fit, others.fit, strict=True):
            array[rows[better]] = values[better]
        return Assignment(order, fit, rival)


def massive_sites(molecule: Molecule) -> np.ndarray:
    """Indices of the sites of a molecule that have mass, and so are atoms."""
    return np.flatnonzero(molecule.masses > 0)


def fit_template(points: np.ndarray, molecule: Molecule) -> TemplateFit:
    """Best rigid fit of a template to whole molecules (m, s, 3), with coinciding centres of
    mass."""
    sites = massive_sites(molecule)
    masses, template = molecule.masses[sites], molecule.positions_body[sites]
    centre = points[:, 0] + np.einsum("s,nsk->nk", masses, points - points[:, :1]) / masses.sum()
    relative = points - centre[:, None]
    rotation = align(template, relative, masses)
    off = np.linalg.norm(relative - np.einsum("nij,sj->nsi", rotation, template), axis=2)
    return TemplateFit(centre, rotation, off.max(axis=1), (off**2).mean(axis=1))


def bond_reach(points: np.ndarray, classes: np.ndarray) -> np.ndarray:
    """Largest lengths (s, s) of bonds between atoms of a template with these points (s, 3), Å.
    Bonds are its shortest links, and all pairs of the same classes (s,). Other pairs have 0."""
    count = classes.max() + 1
    longest = np.zeros((count, count))
    for i, j in shortest_links(points):
        one, other = classes[i], classes[j]
        length = max(longest[one, other], BOND_REACH * float(np.linalg.norm(points[i] - points[j])))
        longest[one, other] = longest[other, one] = length
    return longest[classes[:, None], classes]


def numbered(keys: Iterable[Hashable]) -> np.ndarray:
    """A number (n,) for each key, equal for equal keys."""
    numbers: dict[Hashable, int] = {}
    return np.array([numbers.setdefault(key, len(numbers)) for key in keys], int)


class Orders:
    """The orders in which a template may fit atoms, of which those of one class may be exchanged.

    An order is found from an orientation: two atoms that may be two sites of the template (one, if
    it is linear) and the mean position of all atoms give one, and the atoms are assigned to the
    sites with the smallest sum of squares (the linear assignment problem). Orientation and order
    are refined in turn. All pairs of atoms are tried at which distances agree within the limit.
    Symmetric templates fit in several orders.

    molecule, classes (s,) of its sites with mass
    limit : largest deviation of an atom, Å
    """

    def __init__(self, molecule: Molecule, classes: np.ndarray, limit: float):
        self.molecule, self.classes, self.limit = molecule, classes, limit
        sites = massive_sites(molecule)
        self._template = molecule.positions_body[sites]
        self._centred = self._template - self._template.mean(axis=0)
        self._is_fixed = len(np.unique(classes)) == len(classes)
        self.reach = bond_reach(self._template, classes)

    def best(self, points: np.ndarray) -> Assignment:
        """The best orders for whole molecules (m, s, 3). If several fit equally well, the given
        order is kept."""
        order = np.tile(np.arange(points.shape[1]), (len(points), 1))
        assignment = self._best_of_alike(points, order)
        if self._is_fixed:
            return assignment
        open_ = np.flatnonzero(
            (assignment.fit.deviation > self.limit) | (assignment.fit.rms > self._certain)
        )
        open_ = open_[self._distances_agree(points[open_])]
        while len(open_):
            other = self.search(points[open_[0]], self.limit)
            if other is None:
                open_ = open_[1:]
                continue
            # files are regular: this order fits most other molecules as well
            order = np.tile(other, (len(open_), 1))
            others = self._best_of_alike(points[open_], order)
            before = np.where(
                assignment.fit.deviation[open_] <= self.limit, assignment.fit.rms[open_], np.inf
            )
            worse = np.flatnonzero(before > self.equal_to(others.fit.rms))
            assignment = assignment.with_better(open_[worse], others.of(worse), self.limit)
            fits = (assignment.fit.deviation[open_] <= self.limit) & (
                assignment.fit.rms[open_] <= self._certain
            )
            fits[0] = True  # nothing better was found
            open_ = open_[~fits]
        return assignment

    def search(self, points: np.ndarray, limit: float) -> np.ndarray | None:
        """The best order (s,) for a molecule (s, 3) in which no atom deviates by more than a limit,
        Å, or None."""
        best = None
        least = np.inf
        centred = points - points.mean(axis=0)
        for starts in self._starts(centred, 2 * limit):
            orders = self._refined(centred, starts)
            fit = fit_template(points[orders], self.molecule)
            square = np.where(fit.deviation <= limit, fit.square, np.inf)
            if square.min() < least:
                best = orders[square.argmin()]
                least = square.min()
            if np.sqrt(least) <= self._certain:
                break
        return best

    @cached_property
    def _certain(self) -> float:
        """Deviation, Å, at which no two atoms of a class are mistaken for each other, so that all
        orders that fit follow from one by `_alike`."""
        i, j = np.triu_indices(len(self.classes), 1)
        same = self.classes[i] == self.classes[j]
        distances = np.linalg.norm(self._template[i[same]] - self._template[j[same]], axis=1)
        return 0.25 * float(distances.min(initial=np.inf))

    @cached_property
    def _alike(self) -> np.ndarray:
        """Orders (k, s) of the sites in which the template fits itself twice as far off as the
        limit, the given one first, without those that change nothing: exact symmetries under which
        parameters are the same."""
        count = len(self.classes)
        same = np.arange(count)[None]
        if self._is_fixed:
            return same
        starts = self._starts(self._centred, 4 * self.limit)
        orders = np.concatenate([self._refined(self._centred, rotations) for rotations in starts])
        orders = np.unique(orders, axis=0)
        fit = fit_template(self._template[orders], self.molecule)
        exact = fit.deviation <= EQUAL_OF_RADIUS * self.molecule.radius
        changes = ~(exact & self._keeps_parameters(orders, fit)) & (fit.deviation <= 2 * self.limit)
        return np.concatenate([same, orders[changes][fit.square[changes].argsort(kind="stable")]])

    def _keeps_parameters(self, orders: np.ndarray, fit: TemplateFit) -> np.ndarray:
        """Whether sites (k, s) of a template in other orders, fitted to it, have the parameters of
        those that they replace, massless ones included."""
        keys = self._parameters
        sites = massive_sites(self.molecule)
        keeps = (keys[sites][orders] == keys[sites]).all(axis=1)
        massless = np.setdiff1d(np.arange(len(keys)), sites)
        if len(massless):
            at = self.molecule.positions_body[massless]
            moved = fit.centre[:, None] + np.einsum("kij,sj->ksi", fit.rotation, at)
            distance = np.linalg.norm(moved[:, :, None] - at, axis=3)
            close = (
                distance
                <= 2 * fit.deviation[:, None, None] + EQUAL_OF_RADIUS * self.molecule.radius
            )
            keeps &= (close & (keys[massless][:, None] == keys[massless])).any(axis=2).all(axis=1)
        return keeps

    @cached_property
    def _parameters(self) -> np.ndarray:
        """A number for each site of the molecule (s,), the same for sites with the same
        parameters."""
        m = self.molecule
        custom = [tuple(sorted(values.items())) for values in m.parameters] or [()] * len(m.masses)
        values = (
            m.masses.tolist(),
            m.charges.tolist(),
            m.sigma.tolist(),
            m.epsilon.tolist(),
            custom,
        )
        return numbered(zip(*values, strict=True))

    @cached_property
    def _variants(self) -> np.ndarray:
        """A number for each of the orders `_alike` (k,), the same if each atom has the same
        parameters in them."""
        alike = self._alike
        keys = self._parameters[massive_sites(self.molecule)]
        placed = np.empty_like(alike)
        np.put_along_axis(placed, alike, np.broadcast_to(keys, alike.shape), axis=1)
        fit = fit_template(self._template[alike], self.molecule)
        keeps_of_orders = self._keeps_parameters(alike, fit) | (placed != keys).any(axis=1)
        # a symmetry of the atoms that is none of the massless sites is a variant of its own
        return numbered(
            [
                (*row, k * (not keeps))
                for k, (row, keeps) in enumerate(zip(placed.tolist(), keeps_of_orders, strict=True))
            ]
        )

    def _best_of_alike(self, points: np.ndarray, order: np.ndarray) -> Assignment:
        """The best of the orders (m, s) and those like them, and how well the best unlike one
        fits."""
        molecule = np.arange(len(points))
        fits = [
            fit_template(points[molecule[:, None], order[:, alike]], self.molecule)
            for alike in self._alike
        ]
        if len(fits) == 1:
            return Assignment(order, fits[0], np.full(len(points), np.inf))
        # (k, m)
        rms = np.array([np.where(fit.deviation <= self.limit, fit.rms, np.inf) for fit in fits])
        of_variant = np.full((self._variants.max() + 1, len(points)), np.inf)
        np.minimum.at(of_variant, self._variants, rms)
        given_fits = of_variant[0] <= self.equal_to(of_variant.min(axis=0))
        variant = np.where(given_fits, 0, of_variant.argmin(axis=0))
        rms = np.where(self._variants[:, None] == variant, rms, np.inf)
        best = np.where(rms[0] <= self.equal_to(rms.min(axis=0)), 0, rms.argmin(axis=0))
        of_variant[variant, molecule] = np.inf
        fit = TemplateFit(*(np.stack(parts)[best, molecule] for parts in zip(*fits, strict=True)))
        return Assignment(
            np.take_along_axis(order, self._alike[best], axis=1), fit, of_variant.min(axis=0)
        )

    def equal_to(self, least: np.ndarray) -> np.ndarray:
        """Largest rms deviations (m,), Å, that are as good as the best ones, within the digits of
        files."""
        return EQUAL * least + EQUAL_OF_RADIUS * self.molecule.radius

    def _distances_agree(self, points: np.ndarray) -> np.ndarray:
        """Which molecules (m, s, 3) have the same sorted distances between atoms of two classes as
        the template, within twice the limit, as every molecule that fits does."""
        i, j = np.triu_indices(len(self.classes), 1)
        low, high = np.sort([self.classes[i], self.classes[j]], axis=0)
        pair = low * len(self.classes) + high

        def sorted_distances(points: np.ndarray) -> np.ndarray:
            distance = np.linalg.norm(points[:, i] - points[:, j], axis=2)
            order = np.lexsort((distance, np.broadcast_to(pair, distance.shape)), axis=1)
            return np.take_along_axis(distance, order, 1)

        template_distances = sorted_distances(self._template[None])
        blocks = np.array_split(points, 1 + len(points) * len(i) // MOST_DISTANCES)
        return np.concatenate(
            [
                (np.abs(sorted_distances(b) - template_distances) <= 2 * self.limit).all(axis=1)
                for b in blocks
            ]
        )

    @cached_property
    def _anchors(self) -> list[int]:
        """Two sites that fix the orientation of the template, one if it is linear: far from its
        centre and from one line, and of classes with few sites."""
        distance = np.linalg.norm(self._centred, axis=1)
        size = np.bincount(self.classes)[self.classes]
        far = distance >= WIDE * distance.max()
        axis = self._centred / np.where(distance > 0, distance, 1.0)[:, None]
        # (s, s) of the second from the first
        off_axis = np.linalg.norm(np.cross(axis[:, None], self._centred), axis=2)
        off_axis[~far] = 0.0
        if off_axis.max() <= LINEAR * distance.max():
            return [int(np.where(far, size, np.inf).argmin())]
        starts = np.where(off_axis >= WIDE * off_axis.max(), np.outer(size, size), np.inf)
        return [int(k) for k in np.unravel_index(starts.argmin(), starts.shape)]

    def _starts(self, centred: np.ndarray, slack: float) -> Iterator[np.ndarray]:
        """Orientations (k, 3, 3) of the template in which its anchors point at atoms (s, 3), whose
        distances differ by no more than `slack`. The most likely ones first."""
        anchors = self._anchors
        radii = np.linalg.norm(self._centred, axis=1)[anchors]
        off = np.abs(np.linalg.norm(centred, axis=1) - radii[:, None])  # (anchors, s)
        off[self.classes != self.classes[anchors][:, None]] = np.inf
        if len(anchors) == 1:
            [mismatch], pairs = off, np.arange(len(centred))[:, None]
        else:
            apart = np.linalg.norm(centred[:, None] - centred, axis=2)
            one, other = anchors
            apart = np.abs(apart - np.linalg.norm(self._centred[one] - self._centred[other]))
            np.fill_diagonal(apart, np.inf)
            mismatch = np.maximum(np.maximum(off[0][:, None], off[1]), apart).ravel()
            pairs = np.stack(np.unravel_index(np.arange(mismatch.size), apart.shape), axis=1)
        likely = mismatch.argsort(kind="stable")[: np.count_nonzero(mismatch <= slack)][
            :MOST_STARTS
        ]
        size = max(FIRST_STARTS, MOST_DISTANCES // len(centred) ** 2)
        for first, last in pairwise([0, *range(FIRST_STARTS, len(likely), size), len(likely)]):
            if last > first:
                at = centred[pairs[likely[first:last]]]
                yield align(self._centred[anchors], at, np.ones(len(anchors)))

    def _refined(self, centred: np.ndarray, rotations: np.ndarray) -> np.ndarray:
        """Different orders (k, s) of atoms (s, 3) that orientations of the template lead to."""
        orders = self._assigned(centred, rotations)
        for _ in range(MOST_REFINEMENTS):
            orders = np.unique(orders, axis=0)
            refined = self._assigned(
                centred, align(self._centred, centred[orders], np.ones(len(centred)))
            )
            if np.array_equal(refined, orders):
                break
            orders = refined
        return orders

    def _assigned(self, centred: np.ndarray, rotations: np.ndarray) -> np.ndarray:
        """The order of atoms (s, 3) in each orientation (k, 3, 3) that has the least sum of squared
        distances."""
        from scipy.optimize import linear_sum_assignment

        sites = np.einsum("kij,sj->ksi", rotations, self._centred)
        square = ((centred - sites[:, :, None]) ** 2).sum(axis=3)  # (k, site, atom)
        square[:, self.classes[:, None] != self.classes] = np.inf
        order = square.argmin(axis=2)
        clash = (np.sort(order, axis=1) != np.arange(len(centred))).any(axis=1)
        for k in np.flatnonzero(clash):
            order[k] = linear_sum_assignment(square[k])[1]
        return order
