"""A system as other engines see it: kinds of sites, parameters between kinds, laws in words and numbers.

Everything is taken from the terms that rigidmd itself runs, so that mixing rules, special pairs and endings are decided
once. `unsupported_terms` names what no other engine can express.
"""

from math import inf
from typing import NamedTuple, TypeVar

import numpy as np

from rigidmd.engines.system import System
from rigidmd.forces.neighbors.pair_loop import PairForces
from rigidmd.forces.potentials.coulomb import ReactionField
from rigidmd.forces.potentials.lennard_jones import LennardJones
from rigidmd.forces.potentials.screened_coulomb import DampedShiftedForce, ScreenedCoulomb
from rigidmd.scene.models import gather_per_molecule

#: Terms that the portrait has a place for; all others are fields and forces of the user's own.
KNOWN = (
    "lennard_jones", "coulomb", "coulomb_real", "coulomb_reciprocal", "coulomb_background", "coulomb_surface",
)  # fmt: skip

CoulombLaw = ReactionField | DampedShiftedForce | ScreenedCoulomb


class SiteKind(NamedTuple):
    """Sites that nothing tells apart but their place in the molecule."""

    name: str  # species.site of the first of them
    element: str
    mass: float  # u; 0 for a massless site
    charge: float  # e


class ForceFieldView(NamedTuple):
    """A system without anything of the engine that runs it. s sites, in the order of the system."""

    system: System
    kinds: list[SiteKind]
    kind: np.ndarray  # (s,) of each site
    frozen: np.ndarray  # (n,) whether each molecule is
    sigma: np.ndarray  # (kinds, kinds) Å
    epsilon: np.ndarray  # (kinds, kinds) u Å²/ps²; 0 where there is no Lennard-Jones force
    lennard_jones: LennardJones | None
    coulomb: CoulombLaw | None

    @property
    def truncation(self) -> str:
        """How forces end at the cut-off."""
        return self.system.scene.forces.truncation

    @property
    def electrostatics(self) -> str:
        """Kind of electrostatics; none where no site has a charge."""
        return "none" if self.coulomb is None else self.system.scene.forces.electrostatics

    @property
    def is_periodic_coulomb(self) -> bool:
        """Whether Coulomb forces act on all periodic images."""
        return isinstance(self.coulomb, ScreenedCoulomb)

    @property
    def is_periodic(self) -> bool:
        """Whether there is a periodic box."""
        return self.system.space.volume < inf

    @property
    def charge(self) -> np.ndarray:
        """Charges (s,) in e."""
        return np.array([kind.charge for kind in self.kinds])[self.kind]

    @property
    def mass(self) -> np.ndarray:
        """Masses (s,) in u."""
        return np.array([kind.mass for kind in self.kinds])[self.kind]

    @property
    def is_body(self) -> np.ndarray:
        """Whether each molecule (n,) turns; all others are points or frozen."""
        turning = np.array([m.inertia.any() for m in self.system.species])
        return turning[self.system.model.species] & ~self.frozen


def force_field_of(system: System) -> ForceFieldView:
    """The portrait of a system. Raises nothing; `unsupported_terms` tells what it leaves out."""
    index = system.model.species
    marks = [
        list(zip(m.elements, m.masses.tolist(), m.charges.tolist(), depth, strict=True))
        for m, depth in zip(system.species, _kinds_of_law(system), strict=True)
    ]
    names = [[f"{m.name}.{site}" for site in m.site_names] for m in system.species]
    known = dict.fromkeys(mark for of_species in marks for mark in of_species)
    order = {mark: k for k, mark in enumerate(known)}
    first: dict[tuple, str] = {}
    for own, called in zip(marks, names, strict=True):
        for mark, name in zip(own, called, strict=True):
            first.setdefault(mark, name)
    kinds = [SiteKind(first[mark], *mark[:3]) for mark in known]
    of_species = [np.array([order[mark] for mark in own]) for own in marks]
    law = _law(system, "lennard_jones", LennardJones)
    sigma, epsilon = _pairs([mark[3] for mark in known], law)
    return ForceFieldView(
        system=system,
        kinds=kinds,
        kind=gather_per_molecule(of_species, index),
        frozen=(system.model.inverse_mass == 0)[index],
        sigma=sigma,
        epsilon=epsilon,
        lennard_jones=law,
        coulomb=_law(system, "coulomb", ReactionField)
        or _law(system, "coulomb", DampedShiftedForce)
        or _law(system, "coulomb_real", ScreenedCoulomb),
    )


def unsupported_terms(system: System) -> list[str]:
    """What a system has that other engines do not, in words."""
    found = [
        f"{name.replace('_', ' ')}: {'a force of your own' if name in system.user_terms else 'a field'}"
        for name in system.terms
        if name not in KNOWN
    ]
    if "coulomb_surface" in system.terms:
        found.append("forces.ewald_surface_permittivity: a surface term")
    if system.thermostat is not None:
        found.append("a thermostat of your own")
    return found


Law = TypeVar("Law")


def _law(system: System, name: str, kind: type[Law]) -> Law | None:
    term = system.terms.get(name)
    return term.law if isinstance(term, PairForces) and isinstance(term.law, kind) else None


def _kinds_of_law(system: System) -> list[list[int]]:
    """For each species the kind in the Lennard-Jones law of each of its sites; -1 for none."""
    found = [[-1] * len(m.masses) for m in system.species]
    term, law = system.terms.get("lennard_jones"), _law(system, "lennard_jones", LennardJones)
    if law is None or not isinstance(term, PairForces):
        return found
    sites = term.sites
    for k, m in enumerate(system.species):
        members = np.flatnonzero(system.model.species == k)
        if len(members) == 0:
            continue
        own = slice(sites.first[members[0]], sites.first[members[0] + 1])
        offsets = sites.offsets()[own]
        for kind, offset in zip(law.kind[own], offsets, strict=True):
            place = int(np.linalg.norm(m.positions_body - offset, axis=1).argmin())
            found[k][place] = int(kind)
    return found


def _pairs(kinds: list[int], law: LennardJones | None) -> tuple[np.ndarray, np.ndarray]:
    """sigma and epsilon between kinds of sites, from the law's own coefficients."""
    size = len(kinds)
    sigma, epsilon = np.ones((size, size)), np.zeros((size, size))
    if law is None:
        return sigma, epsilon
    for i, own in enumerate(kinds):
        for j, other in enumerate(kinds):
            if own < 0 or other < 0 or law.c6[own, other] == 0:
                continue
            c12, c6 = law.c12[own, other], law.c6[own, other]
            sigma[i, j], epsilon[i, j] = (c12 / c6) ** (1 / 6), c6**2 / (4 * c12)
    return sigma, epsilon
