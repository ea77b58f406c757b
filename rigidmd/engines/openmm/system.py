"""A system in OpenMM's terms: particles, kept distances, virtual sites, and forces, each in a group of its own.

OpenMM knows no rigid bodies. Mass points joined by kept distances stand for them (`mass_points`), and all other sites
are virtual. Its units are nm, ps, u, e and kJ/mol.
"""

import re
from math import inf, sqrt
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.special import erfc

from rigidmd.engines.expressions import coulomb_formula, lennard_jones_formula
from rigidmd.engines.force_field import ForceFieldView, unsupported_terms
from rigidmd.engines.mass_points import MassPoints, mass_points
from rigidmd.engines.rigid_bodies import Points
from rigidmd.engines.system import charges_in
from rigidmd.errors import EngineError
from rigidmd.forces.ewald.errors import pme_grid_for, real_error
from rigidmd.forces.ewald.pme import Pme
from rigidmd.forces.neighbors.space import cell_of
from rigidmd.forces.potentials.lennard_jones import LennardJones
from rigidmd.forces.potentials.screened_coulomb import DampedShiftedForce, ScreenedCoulomb
from rigidmd.forces.potentials.truncation import Switched, Unmodified
from rigidmd.scene.models import gather_per_molecule
from rigidmd.scene.stage import Stage
from rigidmd.units import COULOMB, KJ_PER_MOL

if TYPE_CHECKING:
    import openmm

#: nm in an Å.
NM = 0.1
#: Relative differences of parameters that are rounding.
ROUNDING = 1e-12
#: Of OpenMM's splines.
PME_ORDER = 5
#: Of one system, the groups of its forces. A step is what the energies of pairs jump by at the cut-off, taken off: it
#: exerts no force, and with it energies are continuous. The tail is that of the tail correction.
LENNARD_JONES, COULOMB_PAIRS, RECIPROCAL, STEP_LENNARD_JONES, STEP_COULOMB, TAIL = range(6)


def library() -> Any:
    """OpenMM. Raises EngineError with what to install."""
    try:
        import openmm
    except ImportError:
        raise EngineError("OpenMM is not here: pip install 'rigidmd[openmm]' brings it") from None
    return openmm


def unsupported_features(view: ForceFieldView) -> list[str]:
    """What of a scene OpenMM cannot do, in words; empty if it can do all."""
    system, forces = view.system, view.system.scene.forces
    found = [f"{what} is left to rigidmd" for what in unsupported_terms(system)]
    if view.has_ewald_sum and grid_for(view, PME_ORDER) is None:
        found.append(
            f"forces.electrostatics = {forces.electrostatics!r}: no grid for OpenMM's splines, of order {PME_ORDER}, "
            "has the accuracy asked for; ask for less"
        )
    for k, stage in enumerate(system.scene.stages):
        found += [f"stages.{k}.{fault}" for fault in _unsupported_in_stage(stage)]
    if view.frozen.any() and any(stage.has_barostat for stage in system.scene.stages):
        found.append("a barostat with frozen molecules: OpenMM would move them with the box")
    return found


def grid_for(view: ForceFieldView, order: int) -> tuple[int, int, int] | None:
    """A grid for splines of an order with the accuracy of the scene's Ewald sum; None if there is none.

    The scene's own grid if its splines are of that order or a lower one.
    """
    system, law = view.system, view.coulomb
    own = system.terms.get("coulomb_reciprocal")
    if isinstance(own, Pme) and own.order <= order:
        a, b, c = own.grid
        return a, b, c
    if not isinstance(law, ScreenedCoulomb) or system.space.volume == inf:
        return None
    counts = np.bincount(system.model.species, minlength=len(system.species))
    charges = charges_in(system.species, counts)
    beyond = real_error(charges, law.alpha, law.cutoff, system.space.volume)
    error = sqrt(max((system.force_error or 0.0) ** 2 / COULOMB**2 - beyond**2, 0.0))
    found = pme_grid_for(charges, law.alpha, cell_of(system.space), error, order)
    return None if found is None else found[0]


def _unsupported_in_stage(stage: Stage) -> list[str]:
    if stage.is_minimisation:
        return []  # rigidmd itself minimises
    found, allowed, kind = [], ("velocity_verlet",), stage.thermostat_kind
    if stage.has_thermostat and kind not in ("nose_hoover", "langevin"):
        found.append(f"thermostat = {kind!r}: OpenMM has nose_hoover and langevin for molecules with kept distances")
    if kind == "langevin":
        allowed = ("velocity_verlet", "baoab")
        if len(set(stage.frictions)) > 1:
            found.append("friction_rotation_per_ps: OpenMM has one friction for translation and rotation")
    if stage.integrator not in allowed:
        found.append(f"integrator = {stage.integrator!r}: OpenMM moves molecules by velocity_verlet")
    if stage.rotor == "exact":
        found.append("rotor = 'exact': OpenMM turns molecules by keeping distances")
    if stage.ensemble == "nph":
        found.append("ensemble = 'nph': OpenMM has no barostat without a thermostat")
    if stage.barostat_kind == "cell_rescaling":
        found.append("barostat = 'cell_rescaling': OpenMM moves the box by monte_carlo, which is isotropic in a scene")
    if stage.ramps:
        found.append("temperature_K or pressure_bar changes over the stage: OpenMM keeps them constant")
    return found


class Layout(NamedTuple):
    """The particles of a system: sites and mass points, molecule by molecule. q particles, p mass points, s sites."""

    mass: np.ndarray  # (q,) u; 0 for what is placed or frozen
    molecule: np.ndarray  # (q,)
    site: np.ndarray  # (s,) particle of each site
    point: np.ndarray  # (p,) particle of each mass point
    points: Points
    of_species: list[MassPoints]
    first: np.ndarray  # (n,) first particle of each molecule
    local: list[np.ndarray]  # for each species the particles of its points, from the first one of the molecule

    def excluded(self, view: ForceFieldView) -> list[tuple[int, int]]:
        """Pairs of particles that do not act on one another: those of one molecule, and of frozen ones."""
        count = np.diff([*self.first, len(self.mass)])
        pairs = [
            (int(a) + i, int(a) + j)
            for a, n in zip(self.first, count, strict=True)
            for i in range(n)
            for j in range(i + 1, n)
        ]
        still = np.flatnonzero(view.frozen[self.molecule])
        other = np.triu_indices(len(still), 1)
        apart = self.molecule[still[other[0]]] != self.molecule[still[other[1]]]
        return pairs + list(zip(still[other[0]][apart].tolist(), still[other[1]][apart].tolist(), strict=True))


def layout(view: ForceFieldView) -> Layout:
    """The particles that stand for the molecules of a system: of each its sites, in their order, then other points."""
    system = view.system
    species, frozen = system.model.species, system.model.inverse_mass == 0
    bodies = [mass_points(m, bool(still)) for m, still in zip(system.species, frozen, strict=True)]
    local, mass = [], []
    for m, body, still in zip(system.species, bodies, frozen, strict=True):
        extra = np.cumsum(body.site < 0) - 1
        where = np.where(body.site >= 0, body.site, len(m.masses) + extra)
        own = np.zeros(len(m.masses) + int((body.site < 0).sum()))
        own[where] = 0.0 if still else body.mass
        local.append(where)
        mass.append(own)
    count = np.array([len(own) for own in mass])[species]
    first = np.cumsum(count) - count
    sites = system.sites_per_molecule
    within = np.arange(sites.sum()) - np.repeat(np.cumsum(sites) - sites, sites)
    points = Points(
        np.repeat(np.arange(len(species)), [len(local[k]) for k in species]),
        gather_per_molecule([body.position_body for body in bodies], species),
        gather_per_molecule([body.mass for body in bodies], species),
    )
    return Layout(
        gather_per_molecule(mass, species),
        np.repeat(np.arange(len(species)), count),
        np.repeat(first, sites) + within,
        np.concatenate([first[i] + local[k] for i, k in enumerate(species)]),
        points,
        bodies,
        first,
        local,
    )


def openmm_system(view: ForceFieldView, particles: Layout, cell: np.ndarray, apart: bool) -> "openmm.System":
    """OpenMM's System, with all forces but a barostat; cell (3, 3) is that of the state it begins with.

    apart : whether Lennard-Jones and Coulomb forces are two forces even where one can do both, which is faster: a step
        of 512 waters with PME takes 8 ms in place of 11 on two cores
    """
    mm = library()
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
        for site, place in body.virtual_sites.items():
            made.setVirtualSite(int(a) + site, _openmm_virtual_site(mm, where, place.weight.tolist(), place.cross))
    excluded = particles.excluded(view)
    for force, group in _forces(mm, view, particles, apart):
        force.setForceGroup(group)
        add = force.addException if isinstance(force, mm.NonbondedForce) else None
        for i, j in excluded if group != TAIL else []:
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
    # at the origin of local axes, which is an average of any number of particles; the axes do not matter
    return mm.LocalCoordinatesSite(points, weight, [-1, 1, 0, 0], [-1, 0, 1, 0], [0, 0, 0])


def _forces(mm: Any, view: ForceFieldView, particles: Layout, apart: bool) -> list[tuple]:
    """Forces and their groups."""
    found, law, coulomb = [], view.lennard_jones, view.coulomb
    plain = _builtin_lennard_jones(view)
    has_charge_force = isinstance(coulomb, ScreenedCoulomb) or (coulomb is not None and coulomb.cutoff == inf)
    together = plain is not None and has_charge_force and not apart
    if law is not None and view.epsilon.any():
        if plain is None:
            found.append((_custom_lennard_jones(mm, view, particles), LENNARD_JONES))
        elif not together:
            force = _nonbonded(mm, view, particles, law.cutoff, np.zeros_like(view.charge), plain)
            found.append((force, LENNARD_JONES))
        if view.is_periodic and isinstance(law.truncation, Unmodified) and view.truncation == "plain":
            found.append((_custom_lennard_jones(mm, view, particles, step=True), STEP_LENNARD_JONES))
    if coulomb is not None and has_charge_force:
        force = _nonbonded(mm, view, particles, coulomb.cutoff, view.charge, plain if together else None)
        found.append((force, COULOMB_PAIRS))
        if isinstance(coulomb, ScreenedCoulomb):
            force.setNonbondedMethod(mm.NonbondedForce.PME)
            force.setPMEParameters(float(coulomb.alpha) / NM, *(grid_for(view, PME_ORDER) or ()))
            force.setReciprocalSpaceForceGroup(RECIPROCAL)
            height = f"{-float(erfc(coulomb.alpha * coulomb.cutoff)) / coulomb.cutoff!r}"
            found.append((_custom_coulomb(mm, view, particles, height), STEP_COULOMB))
    elif coulomb is not None and not isinstance(coulomb, ScreenedCoulomb):
        found.append((_custom_coulomb(mm, view, particles, coulomb_formula(coulomb, 1.0)), COULOMB_PAIRS))
        if view.is_periodic and not isinstance(coulomb, DampedShiftedForce) and view.truncation == "plain":
            height = f"{-(1 / coulomb.cutoff + coulomb.field * coulomb.cutoff**2)!r}"
            found.append((_custom_coulomb(mm, view, particles, height), STEP_COULOMB))
    if (tail := view.system.tail) is not None:
        energy = float(tail.energy_volume) / KJ_PER_MOL * NM**3
        found.append((mm.CustomVolumeForce(f"{energy!r}/v"), TAIL))
    return found


def _builtin_lennard_jones(view: ForceFieldView) -> tuple[np.ndarray, np.ndarray] | None:
    """sigma and epsilon of kinds where OpenMM's own law is that of the scene; None where it is not."""
    law = view.lennard_jones
    if law is None or not (law.cutoff == inf or view.truncation in ("plain", "switch")):
        return None
    return _lorentz_berthelot(view)


def _lorentz_berthelot(view: ForceFieldView) -> tuple[np.ndarray, np.ndarray] | None:
    """sigma and epsilon of kinds if those between kinds follow from them, else None."""
    sigma, epsilon = view.sigma.diagonal(), view.epsilon.diagonal()
    deep = view.epsilon > 0
    same = np.allclose(view.epsilon, np.sqrt(np.outer(epsilon, epsilon)), rtol=ROUNDING, atol=0)
    wide = np.isclose(view.sigma, (sigma[:, None] + sigma) / 2, rtol=ROUNDING, atol=0)
    return (sigma, epsilon) if same and wide[deep].all() else None


def _nonbonded(
    mm: Any,
    view: ForceFieldView,
    particles: Layout,
    cutoff: float,
    charge: np.ndarray,
    lennard_jones: tuple[np.ndarray, np.ndarray] | None,
):
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
    """A CustomNonbondedForce of a formula of r in Å, with values (s,) of sites."""
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
    """The law as a formula, or the step that it makes at the cut-off; linear in c12 and c6, which tables of kinds give.

    Kind 0 of the tables is that of points that are no sites.
    """
    law = view.lennard_jones
    assert isinstance(law, LennardJones)
    if step:
        formula = f"c6*{law.cutoff**-6!r}-c12*{law.cutoff**-12!r}"
    else:
        parts = [lennard_jones_formula(law, *c, 1.0).split(";", 1) for c in ((1.0, 0.0), (0.0, 1.0))]
        definitions = f";{parts[0][1]}" if len(parts[0]) == 2 else ""
        formula = f"c12*({parts[0][0]})+c6*({parts[1][0]}){definitions}"
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
    """q q times a formula of unit strength; charges are in units where q q/r is in kJ/mol."""
    law = view.coulomb
    assert law is not None
    main, *definitions = formula.split(";", 1)
    charge = view.charge * np.sqrt(COULOMB / KJ_PER_MOL)
    text = "; ".join([f"q1*q2*({main})", *definitions])
    return _custom(mm, view, particles, law.cutoff, text, {"q": charge})
