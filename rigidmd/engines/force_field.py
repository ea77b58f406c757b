"""The force field of a system as another program would see it: kinds of sites, and pair potentials between kinds.

The engines LAMMPS and OpenMM and the exports to LAMMPS, OpenMM and GROMACS are made from this view. It is read from the
terms that rigidmd itself runs, so that mixing rules, special pairs and truncation are decided once.
`unsupported_terms` lists what no other program can express.
"""

from math import inf
from typing import NamedTuple, TypeVar

import numpy as np

from rigidmd.engines.system import System
from rigidmd.forces.neighbors.pair_loop import PairForces
from rigidmd.forces.parts import gather_per_molecule
from rigidmd.forces.potentials.coulomb import ReactionField
from rigidmd.forces.potentials.lennard_jones import LennardJones
from rigidmd.forces.potentials.screened_coulomb import DampedShiftedForce, ScreenedCoulomb
from rigidmd.scene.stage import Stage

#: Terms that the view includes. All others are fields and user-defined forces.
KNOWN = (
    "lennard_jones", "coulomb", "coulomb_real", "coulomb_reciprocal", "coulomb_background", "coulomb_surface",
)  # fmt: skip

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
    def truncation(self) -> str:
        return self.system.scene.forces.truncation

    @property
    def electrostatics(self) -> str:
        """The electrostatics of the scene; "none" if no site has a charge."""
        return "none" if self.coulomb is None else self.system.scene.forces.electrostatics

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
    """The force field of a system. It leaves out the terms that `unsupported_terms` lists."""
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


def unsupported_terms(system: System) -> list[str]:
    """Descriptions of the terms of a system that no other program has."""
    kind = {name: "a user-defined force" if name in system.user_terms else "a field" for name in system.terms}
    found = [f"{name.replace('_', ' ')}: {kind[name]}" for name in system.terms if name not in KNOWN]
    if "coulomb_surface" in system.terms:
        found.append("forces.ewald_surface_permittivity: a surface term")
    if system.thermostat is not None:
        found.append("a user-defined thermostat")
    return found


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


def common_stage_limits(stage: Stage, program: str, bodies: str, rotation: str) -> list[str]:
    """Descriptions of the settings of a stage that all external programs lack."""
    found, is_langevin = [], stage.thermostat_kind == "langevin"
    if is_langevin and len(set(stage.frictions)) > 1:
        found.append(f"friction_rotation_per_ps: {program} has one friction for translation and rotation")
    if stage.integrator not in (("velocity_verlet", "baoab") if is_langevin else ("velocity_verlet",)):
        found.append(f"integrator = {stage.integrator!r}: {program} moves {bodies} by velocity_verlet")
    if stage.rotor == "exact":
        found.append(f"rotor = 'exact': {rotation}")
    return found
