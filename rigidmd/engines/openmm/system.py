"""A system as an `openmm.System`: particles, constraints, virtual sites, and forces in separate groups.

OpenMM has no rigid bodies. Mass points with constrained distances represent them (`mass_points`), and all other sites
are virtual. OpenMM's units are nm, ps, u, e and kJ/mol.
"""

import re
from math import inf
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.special import erfc

from rigidmd.core.state import State
from rigidmd.engines.expressions import coulomb_formula, lennard_jones_formula
from rigidmd.engines.force_field import ForceFieldView
from rigidmd.engines.mass_points import MassPoints, mass_points
from rigidmd.engines.openmm.options import PROGRAM
from rigidmd.engines.openmm.translations import PME_ORDER, grid_for
from rigidmd.engines.rigid_bodies import Points, RigidBodies
from rigidmd.errors import EngineError
from rigidmd.forces.parts import gather_per_molecule
from rigidmd.forces.potentials.lennard_jones import LennardJones
from rigidmd.forces.potentials.screened_coulomb import DampedShiftedForce, ScreenedCoulomb
from rigidmd.forces.potentials.truncation import Switched, Unmodified
from rigidmd.units import COULOMB, KJ_PER_MOL

if TYPE_CHECKING:
    import openmm

#: nm per Å.
NM = 0.1
#: Relative difference of equal parameters.
ROUNDING = 1e-12


class Group:
    """Force groups of a system. A step group subtracts the jump of the pair energies at the cutoff: it exerts no force,
    and energies with it are continuous. TAIL is the tail correction."""

    LENNARD_JONES, COULOMB_PAIRS, RECIPROCAL, STEP_LENNARD_JONES, STEP_COULOMB, TAIL = range(6)


def library() -> Any:
    """The module openmm. Raises EngineError if it is not installed."""
    try:
        import openmm
    except ImportError:
        raise EngineError(f"OpenMM is not installed: {PROGRAM.install}") from None
    return openmm


class Layout(NamedTuple):
    """The particles of a system: sites and mass points, molecule by molecule. q particles, p mass points, s sites."""

    view: ForceFieldView
    bodies: RigidBodies  # of the mass points
    mass: np.ndarray  # (q,) u; 0 for virtual sites and frozen particles
    molecule: np.ndarray  # (q,)
    site: np.ndarray  # (s,) particle of each site
    point: np.ndarray  # (p,) particle of each mass point
    of_species: list[MassPoints]
    first: np.ndarray  # (n,) first particle of each molecule
    local: list[np.ndarray]  # for each species the particles of its mass points, counted from `first`

    def positions(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Positions, Å, and velocities, Å/ps, of all particles (q, 3) at a state."""
        at, velocity = np.zeros((2, len(self.mass), 3))
        at[self.site] = self.view.system.site_positions(state)
        at[self.point], velocity[self.point] = self.bodies.points(state)
        velocity[self.mass == 0] = 0.0
        return at, velocity

    def excluded(self) -> list[tuple[int, int]]:
        """Pairs of particles that do not interact: within a molecule, and between frozen molecules."""
        pairs = []
        for a, n in zip(self.first, np.diff([*self.first, len(self.mass)]), strict=True):
            pairs += [(int(a) + i, int(a) + j) for i in range(n) for j in range(i + 1, n)]
        frozen = np.flatnonzero(self.view.frozen[self.molecule])
        one, other = (frozen[index] for index in np.triu_indices(len(frozen), 1))
        between = self.molecule[one] != self.molecule[other]
        return pairs + list(zip(one[between].tolist(), other[between].tolist(), strict=True))


def layout(view: ForceFieldView) -> Layout:
    """The particles that represent a system: for each molecule its sites, in order, then its other mass points."""
    system = view.system
    species, frozen = system.model.species, system.model.inverse_mass == 0
    bodies = [mass_points(m, bool(is_frozen)) for m, is_frozen in zip(system.species, frozen, strict=True)]
    local, mass = [], []
    for m, body, is_frozen in zip(system.species, bodies, frozen, strict=True):
        extra = np.cumsum(body.site < 0) - 1
        local.append(np.where(body.site >= 0, body.site, len(m.masses) + extra))
        mass.append(np.zeros(len(m.masses) + int((body.site < 0).sum())))
        mass[-1][local[-1]] = 0.0 if is_frozen else body.mass
    count = np.array([len(of_species) for of_species in mass])[species]
    first = np.cumsum(count) - count
    sites = system.sites_per_molecule
    within = np.arange(sites.sum()) - np.repeat(np.cumsum(sites) - sites, sites)
    molecule = np.repeat(np.arange(len(species)), count)
    points = Points(
        np.repeat(np.arange(len(species)), [len(local[k]) for k in species]),
        gather_per_molecule([body.position_body for body in bodies], species),
        gather_per_molecule([body.mass for body in bodies], species),
    )
    return Layout(
        view, RigidBodies(system, points), gather_per_molecule(mass, species), molecule,
        np.repeat(first, sites) + within, np.concatenate([first[i] + local[k] for i, k in enumerate(species)]),
        bodies, first, local,
    )  # fmt: skip


def openmm_system(particles: Layout, cell: np.ndarray, separate: bool) -> "openmm.System":
    """The `openmm.System` with all forces except a barostat, and the initial cell (3, 3).

    separate : whether Lennard-Jones and Coulomb forces are separate even if one force can have both, which is faster: a
        step of 512 waters with PME takes 8 ms instead of 11 on two cores
    """
    mm, view = library(), particles.view
    made = mm.System()
    for mass in particles.mass:
        made.addParticle(float(mass))
    if view.is_periodic:
        made.setDefaultPeriodicBoxVectors(*(cell * NM).tolist())
    for a, k in zip(particles.first, view.system.model.species, strict=True):
        body, where = particles.of_species[k], (particles.local[k] + a).tolist()
        if view.frozen[particles.molecule[a]]:
            continue
        for i, j, distance in body.distances:
            made.addConstraint(where[i], where[j], distance * NM)
        for k, site in body.virtual_sites.items():
            made.setVirtualSite(int(a) + k, _openmm_virtual_site(mm, where, site.weight.tolist(), site.cross))
    excluded = particles.excluded()
    for force, group in _forces(mm, view, particles, separate):
        force.setForceGroup(group)
        add = force.addException if isinstance(force, mm.NonbondedForce) else None
        for i, j in excluded if group != Group.TAIL else []:
            if add is None:
                force.addExclusion(i, j)
            else:
                add(i, j, 0.0, 1.0, 0.0)
        made.addForce(force)
    return made


def _openmm_virtual_site(mm: Any, points: list[int], weight: list[float], cross: float):
    """The virtual site at the sum of weight times point."""
    if len(points) == 2:
        return mm.TwoParticleAverageSite(*points, *weight)
    if cross:
        return mm.OutOfPlaneSite(*points, weight[1], weight[2], cross / NM)
    if len(points) == 3:
        return mm.ThreeParticleAverageSite(*points, *weight)
    # the origin of local axes is an average of any number of particles; the axes do not matter
    return mm.LocalCoordinatesSite(points, weight, [-1, 1, 0, 0], [-1, 0, 1, 0], [0, 0, 0])


def _forces(mm: Any, view: ForceFieldView, particles: Layout, separate: bool) -> list[tuple]:
    found, law, coulomb = [], view.lennard_jones, view.coulomb
    plain = _builtin_lennard_jones(view)
    has_charge_force = isinstance(coulomb, ScreenedCoulomb) or (coulomb is not None and coulomb.cutoff == inf)
    together = plain is not None and has_charge_force and not separate
    if law is not None and view.epsilon.any():
        if plain is None:
            found.append((_custom_lennard_jones(mm, view, particles), Group.LENNARD_JONES))
        elif not together:
            force = _nonbonded(mm, view, particles, law.cutoff, np.zeros_like(view.charge), plain)
            found.append((force, Group.LENNARD_JONES))
        if view.is_periodic and isinstance(law.truncation, Unmodified) and view.truncation == "plain":
            found.append((_custom_lennard_jones(mm, view, particles, step=True), Group.STEP_LENNARD_JONES))
    if coulomb is not None and has_charge_force:
        force = _nonbonded(mm, view, particles, coulomb.cutoff, view.charge, plain if together else None)
        found.append((force, Group.COULOMB_PAIRS))
        if isinstance(coulomb, ScreenedCoulomb):
            force.setNonbondedMethod(mm.NonbondedForce.PME)
            force.setPMEParameters(float(coulomb.alpha) / NM, *(grid_for(view, PME_ORDER) or ()))
            force.setReciprocalSpaceForceGroup(Group.RECIPROCAL)
            height = f"{-float(erfc(coulomb.alpha * coulomb.cutoff)) / coulomb.cutoff!r}"
            found.append((_custom_coulomb(mm, view, particles, height), Group.STEP_COULOMB))
    elif coulomb is not None and not isinstance(coulomb, ScreenedCoulomb):
        found.append((_custom_coulomb(mm, view, particles, coulomb_formula(coulomb, 1.0)), Group.COULOMB_PAIRS))
        if view.is_periodic and not isinstance(coulomb, DampedShiftedForce) and view.truncation == "plain":
            height = f"{-(1 / coulomb.cutoff + coulomb.field * coulomb.cutoff**2)!r}"
            found.append((_custom_coulomb(mm, view, particles, height), Group.STEP_COULOMB))
    if (tail := view.system.tail) is not None:
        energy = float(tail.energy_volume) / KJ_PER_MOL * NM**3
        found.append((mm.CustomVolumeForce(f"{energy!r}/v"), Group.TAIL))
    return found


def _builtin_lennard_jones(view: ForceFieldView) -> tuple[np.ndarray, np.ndarray] | None:
    """sigma and epsilon of kinds if OpenMM has the Lennard-Jones potential of the scene built in, else None."""
    law = view.lennard_jones
    if law is None or not (law.cutoff == inf or view.truncation in ("plain", "switch")):
        return None
    return _lorentz_berthelot(view)


def _lorentz_berthelot(view: ForceFieldView) -> tuple[np.ndarray, np.ndarray] | None:
    """sigma and epsilon of kinds if all pairs follow from them by Lorentz-Berthelot rules, else None."""
    sigma, epsilon = view.sigma.diagonal(), view.epsilon.diagonal()
    deep = view.epsilon > 0
    same = np.allclose(view.epsilon, np.sqrt(np.outer(epsilon, epsilon)), rtol=ROUNDING, atol=0)
    wide = np.isclose(view.sigma, (sigma[:, None] + sigma) / 2, rtol=ROUNDING, atol=0)
    return (sigma, epsilon) if same and wide[deep].all() else None


def _nonbonded(
    mm: Any, view: ForceFieldView, particles: Layout, cutoff: float, charge: np.ndarray,
    lennard_jones: tuple[np.ndarray, np.ndarray] | None
):  # fmt: skip
    """A NonbondedForce between charges (s,) of sites, and with sigma and epsilon of kinds."""
    force = mm.NonbondedForce()
    force.setUseDispersionCorrection(False)
    force.setNonbondedMethod(_method(mm.NonbondedForce, view, cutoff))
    if cutoff < inf:
        force.setCutoffDistance(cutoff * NM)
    rows = np.zeros((len(particles.mass), 3))
    rows[:, 1] = 1.0
    rows[particles.site, 0] = charge
    if lennard_jones is not None:
        sigma, epsilon = lennard_jones
        rows[particles.site, 1] = sigma[view.kind] * NM
        rows[particles.site, 2] = epsilon[view.kind] / KJ_PER_MOL
        if (law := view.lennard_jones) and isinstance(law.truncation, Switched):
            force.setUseSwitchingFunction(True)
            force.setSwitchingDistance(float(law.truncation.start) * NM)
    for row in rows.tolist():
        force.addParticle(*row)
    return force


def _method(kind, view: ForceFieldView, cutoff: float) -> int:
    if cutoff == inf:
        return kind.NoCutoff
    return kind.CutoffPeriodic if view.is_periodic else kind.CutoffNonPeriodic


def _custom(
    mm: Any, view: ForceFieldView, particles: Layout, cutoff: float, formula: str, values: dict[str, np.ndarray]
):
    """A CustomNonbondedForce with a formula of r in Å, and values (s,) of sites."""
    text = re.sub(r"\br\b", "R", formula)
    force = mm.CustomNonbondedForce(f"{text}; R={1 / NM!r}*r" if text != formula else text)
    force.setNonbondedMethod(_method(mm.CustomNonbondedForce, view, cutoff))
    if cutoff < inf:
        force.setCutoffDistance(cutoff * NM)
    rows = np.zeros((len(particles.mass), len(values)))
    for k, (name, of_sites) in enumerate(values.items()):
        force.addPerParticleParameter(name)
        rows[particles.site, k] = of_sites
    for row in rows.tolist():
        force.addParticle(row)
    return force


def _custom_lennard_jones(mm: Any, view: ForceFieldView, particles: Layout, step: bool = False):
    """The Lennard-Jones potential as a formula, or its step at the cutoff; linear in c12 and c6, from tables of kinds.
    Kind 0 is for mass points without a site."""
    law = view.lennard_jones
    assert isinstance(law, LennardJones)
    if step:
        formula = f"c6*{law.cutoff**-6!r}-c12*{law.cutoff**-12!r}"
    else:
        of12, of6 = (lennard_jones_formula(law, *c, 1.0).split(";", 1) for c in ((1.0, 0.0), (0.0, 1.0)))
        definitions = f";{of12[1]}" if len(of12) == 2 else ""
        formula = f"c12*({of12[0]})+c6*({of6[0]}){definitions}"
    six = view.sigma**6
    c6 = 4 * view.epsilon * six / KJ_PER_MOL
    force = _custom(
        mm, view, particles, law.cutoff,
        f"{formula}; c12=table12(kind1,kind2); c6=table6(kind1,kind2)", {"kind": view.kind + 1},
    )  # fmt: skip
    size = len(c6) + 1
    for name, table in (("table12", c6 * six), ("table6", c6)):
        padded = np.zeros((size, size))
        padded[1:, 1:] = table
        force.addTabulatedFunction(name, mm.Discrete2DFunction(size, size, padded.ravel().tolist()))
    return force


def _custom_coulomb(mm: Any, view: ForceFieldView, particles: Layout, formula: str):
    """q q times a formula of unit strength. Charges are in units in which q q/r is in kJ/mol."""
    law = view.coulomb
    assert law is not None
    main, *definitions = formula.split(";", 1)
    charge = view.charge * np.sqrt(COULOMB / KJ_PER_MOL)
    text = "; ".join([f"q1*q2*({main})", *definitions])
    return _custom(mm, view, particles, law.cutoff, text, {"q": charge})
