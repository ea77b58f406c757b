"""The force field of a system as another program would see it: kinds of sites, and pair potentials between kinds.

The engines LAMMPS and OpenMM and the exports to LAMMPS, OpenMM and GROMACS are made from this view. It is read from the
terms that rigidmd itself runs, so that mixing rules, special pairs and truncation are decided once.
`unknown_terms` lists what no other program can express.
"""

from math import inf
from typing import NamedTuple, TypeVar

import numpy as np

from rigidmd.engines.system import System
from rigidmd.forces.ewald.corrections import Background, SurfaceDipole
from rigidmd.forces.ewald.direct_sum import EwaldSum
from rigidmd.forces.ewald.pme import Pme
from rigidmd.forces.neighbors.pair_loop import PairForces
from rigidmd.forces.parts import gather_per_molecule
from rigidmd.forces.potentials.coulomb import ReactionField
from rigidmd.forces.potentials.lennard_jones import LennardJones
from rigidmd.forces.potentials.screened_coulomb import DampedShiftedForce, ScreenedCoulomb
from rigidmd.scene import MolecularScene

#: Classes of the pair potentials and terms that the view describes.
DESCRIBED = (LennardJones, ReactionField, DampedShiftedForce, ScreenedCoulomb, EwaldSum, Pme, Background)

CoulombLaw = ReactionField | DampedShiftedForce | ScreenedCoulomb


class SiteKind(NamedTuple):
    """Sites with the same element, mass, charge and Lennard-Jones parameters."""

    name: str  # species.site of the first one
    element: str
    mass: float  # u; 0 for a massless site
    charge: float  # e


class ForceFieldView(NamedTuple):
    """The sites of a system (s, in its order) and their pair potentials, independent of any engine."""

    system: System
    kinds: list[SiteKind]
    kind: np.ndarray  # (s,) index into `kinds`
    frozen: np.ndarray  # (n,) whether each molecule is frozen
    sigma: np.ndarray  # (kinds, kinds) Å
    epsilon: np.ndarray  # (kinds, kinds) u Å²/ps²; 0 where there is no Lennard-Jones force
    lennard_jones: LennardJones | None
    coulomb: CoulombLaw | None

    @property
    def scene(self) -> MolecularScene:
        return self.system.scene

    @property
    def truncation(self) -> str:
        return self.scene.forces.truncation

    @property
    def is_truncated(self) -> bool:
        """Whether `truncation` matters."""
        return self.system.cutoff < inf and bool(self.lennard_jones or isinstance(self.coulomb, ReactionField))

    @property
    def has_barostat(self) -> bool:
        return any(stage.has_barostat for stage in self.scene.stages)

    @property
    def electrostatics(self) -> str:
        """The electrostatics of the scene; "none" if no site has a charge."""
        return "none" if self.coulomb is None else self.scene.forces.electrostatics

    @property
    def has_ewald_sum(self) -> bool:
        return isinstance(self.coulomb, ScreenedCoulomb)

    @property
    def is_periodic(self) -> bool:
        return self.system.space.volume < inf

    @property
    def charge(self) -> np.ndarray:
        """Charges (s,) in e."""
        return np.array([kind.charge for kind in self.kinds])[self.kind]

    @property
    def is_body(self) -> np.ndarray:
        """Whether each molecule (n,) is a rigid body that rotates. All others are points or frozen."""
        rotates = np.array([m.inertia.any() for m in self.system.species])
        return rotates[self.system.model.species] & ~self.frozen


def force_field_of(system: System) -> ForceFieldView:
    """The force field of a system. It leaves out the terms that `unknown_terms` lists."""
    index = system.model.species
    per_species = zip(system.species, _lennard_jones_kinds(system), strict=True)
    parameters = [list(zip(m.elements, m.masses.tolist(), m.charges.tolist(), k, strict=True)) for m, k in per_species]
    first: dict[tuple, str] = {}  # parameters of a kind -> name of its first site
    for m, of_sites in zip(system.species, parameters, strict=True):
        for site, of_site in zip(m.site_names, of_sites, strict=True):
            first.setdefault(of_site, f"{m.name}.{site}")
    order = {of_kind: k for k, of_kind in enumerate(first)}
    kinds = [SiteKind(name, *of_kind[:3]) for of_kind, name in first.items()]
    of_species = [np.array([order[of_site] for of_site in of_sites]) for of_sites in parameters]
    lennard_jones = _potential(system, "lennard_jones", LennardJones)
    sigma, epsilon = _pairs([of_kind[3] for of_kind in first], lennard_jones)
    coulomb = _potential(system, "coulomb", ReactionField) or _potential(system, "coulomb", DampedShiftedForce)
    return ForceFieldView(
        system, kinds, gather_per_molecule(of_species, index), (system.model.inverse_mass == 0)[index], sigma, epsilon,
        lennard_jones, coulomb or _potential(system, "coulomb_real", ScreenedCoulomb),
    )  # fmt: skip


def unknown_terms(system: System) -> list[str]:
    """Messages on what acts on a system and is not in its view."""
    found = []
    for name, term in system.terms.items():
        kind = type(term.potential if isinstance(term, PairForces) else term)
        if name in system.user_terms or kind not in DESCRIBED:
            what = "a field" if hasattr(term, "changes_momentum") else f"the term {kind.__name__}"
            what = f"the pair potential {kind.__name__}" if isinstance(term, PairForces) else what
            what = "forces.ewald_surface_permittivity" if isinstance(term, SurfaceDipole) else what
            found.append(f"{name.replace('_', ' ')}: {'a user-defined force' if name in system.user_terms else what}")
    found += ["a user-defined thermostat"] if system.thermostat is not None else []
    return [f"{what} is left to rigidmd" for what in found]


Potential = TypeVar("Potential")


def _potential(system: System, name: str, kind: type[Potential]) -> Potential | None:
    """The pair potential of a term if it is of a class, else None."""
    term = system.terms.get(name)
    return term.potential if isinstance(term, PairForces) and isinstance(term.potential, kind) else None


def _lennard_jones_kinds(system: System) -> list[list[int]]:
    """The Lennard-Jones kind of each site of each species; -1 for sites without Lennard-Jones forces."""
    found = [[-1] * len(m.masses) for m in system.species]
    term, law = system.terms.get("lennard_jones"), _potential(system, "lennard_jones", LennardJones)
    if law is None or not isinstance(term, PairForces):
        return found
    sites = term.sites
    for k, m in enumerate(system.species):
        members = np.flatnonzero(system.model.species == k)
        if len(members) == 0:
            continue
        first = slice(sites.first[members[0]], sites.first[members[0] + 1])
        for kind, offset in zip(law.kind[first], sites.offsets()[first], strict=True):
            found[k][int(np.linalg.norm(m.positions_body - offset, axis=1).argmin())] = int(kind)
    return found


def _pairs(kinds: list[int], law: LennardJones | None) -> tuple[np.ndarray, np.ndarray]:
    """sigma and epsilon between Lennard-Jones kinds, from the coefficients of the potential."""
    size = len(kinds)
    sigma, epsilon = np.ones((size, size)), np.zeros((size, size))
    if law is None:
        return sigma, epsilon
    for i, one in enumerate(kinds):
        for j, other in enumerate(kinds):
            if one < 0 or other < 0 or law.c6[one, other] == 0:
                continue
            c12, c6 = law.c12[one, other], law.c6[one, other]
            sigma[i, j], epsilon[i, j] = (c12 / c6) ** (1 / 6), c6**2 / (4 * c12)
    return sigma, epsilon
