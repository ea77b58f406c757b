"""What OpenMM can express, and a system as an `openmm.System`: particles, constraints, virtual
sites, groups of forces.

OpenMM has no rigid bodies. Mass points with constrained distances represent them
(`rigid_bodies.MassPoints`), and all other sites are virtual. OpenMM's units are nm, ps, u, e and
kJ/mol.
"""

import re
from math import inf, pi, sqrt
from types import ModuleType
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
from scipy.special import erfc

from rigidmd.core.state import State
from rigidmd.errors import EngineError
from rigidmd.features.external.engines import SPLIT, Key, Limit, Missing, Translations, moves
from rigidmd.features.external.force_field import (
    ForceFieldView,
    coulomb_formula,
    lennard_jones_formula,
)
from rigidmd.features.external.openmm.program import PROGRAM
from rigidmd.features.external.rigid_bodies import MassPoints, Points, RigidBodies, mass_points
from rigidmd.forces.ewald.errors import charges_in, pme_grid_for
from rigidmd.forces.ewald.pme import Pme
from rigidmd.forces.neighbors.space import cell_of
from rigidmd.forces.parts import gather_per_molecule
from rigidmd.forces.potentials.coulomb import ReactionField
from rigidmd.forces.potentials.screened_coulomb import ScreenedCoulomb
from rigidmd.forces.potentials.truncation import TRUNCATIONS, Switched, Unmodified
from rigidmd.scene.stage import Stage
from rigidmd.scene.validation import not_none
from rigidmd.units import COULOMB, KJ_PER_MOL

if TYPE_CHECKING:
    import openmm

    Pairs = openmm.NonbondedForce | openmm.CustomNonbondedForce
    PairsOrTail = Pairs | openmm.CustomVolumeForce
    PairsT = TypeVar("PairsT", openmm.NonbondedForce, openmm.CustomNonbondedForce)

#: nm per Å.
NM = 0.1
#: Relative difference of equal parameters.
ROUNDING = 1e-12

#: Order of OpenMM's splines.
PME_ORDER = 5


def grid_for(view: ForceFieldView, order: int) -> tuple[int, int, int] | None:
    """A grid for splines of an order with the accuracy of the scene's Ewald sum: the grid of the
    scene if the order of its splines is not higher. None if no grid reaches the accuracy."""
    system, potential = view.system, view.coulomb
    pme = system.terms.get("coulomb_reciprocal")
    if isinstance(pme, Pme) and pme.order <= order:
        a, b, c = pme.grid
        return a, b, c
    if not isinstance(potential, ScreenedCoulomb) or system.space.volume == inf:
        return None
    charges = charges_in(
        system.species, np.bincount(system.model.species, minlength=len(system.species))
    )
    real_space = charges.beyond(potential.alpha, potential.cutoff, system.space.volume)
    error = sqrt(max((system.force_error or 0.0) ** 2 / COULOMB**2 - real_space**2, 0.0))
    grid_and_error = pme_grid_for(charges, potential.alpha, cell_of(system.space), error, order)
    return None if grid_and_error is None else grid_and_error[0]


_INTEGRATOR, *_LIMITS = moves("OpenMM", "molecules")
_NO_GRID = (
    f"no grid for OpenMM's splines, of order {PME_ORDER}, reaches the requested accuracy. Request a"
    " lower one"
)
#: What OpenMM can express, and how.
TRANSLATIONS = Translations(
    "OpenMM",
    scene=(
        Key(
            "forces.truncation",
            dict.fromkeys(TRUNCATIONS, "formula"),
            matters=lambda view: view.is_truncated,
        ),
        Key("forces.dispersion", {"cutoff": ""}),
        Key("forces.reaction_field_truncation", dict.fromkeys((None, *TRUNCATIONS), "formula")),
        Key(
            "forces.electrostatics",
            {
                "none": "",
                "coulomb": "",
                "reaction_field": "formula",
                "damped_shifted_force": "formula",
                "ewald": "PME",
                "pme": "PME",
            },
            matters=lambda view: view.coulomb,
        ),
        Key("forces.ewald_truncation", {None: "", "plain": "", "shift": "energy of a step"}),
        Key(
            "run.remove_momentum_interval_ps",
            {None: "", False: ""},
            "the engine openmm removes no momentum. Leave it out",
        ),
    ),
    stage=(
        Key(
            "ensemble",
            {
                "nve": "",
                "nvt": "",
                "npt": "",
                "nph": Missing("OpenMM has no barostat without a thermostat"),
            },
        ),
        Key(
            "thermostat",
            {
                None: "velocity Verlet",
                "nose_hoover": "NoseHooverIntegrator",
                "langevin": "LangevinMiddleIntegrator",
            },
            "OpenMM has nose_hoover and langevin for constrained molecules",
        ),
        Key(
            "barostat",
            {None: "", "monte_carlo": "MonteCarloBarostat"},
            "OpenMM moves the box by monte_carlo, which is isotropic in a scene",
        ),
        Key("pressure_coupling", {"isotropic": ""}),
        _INTEGRATOR,
        Key("rotor", SPLIT, "OpenMM rotates molecules by constrained distances"),
    ),
    limits=(
        Limit(
            "forces.ewald_cutoff_A = {:g}: OpenMM has one cutoff for all forces. Leave it out, or"
            " take cutoff_A",
            lambda view: (
                view.has_ewald_sum
                and view.coulomb.cutoff != view.system.cutoff
                and view.coulomb.cutoff
            ),
        ),
        Limit(
            f"forces.electrostatics = {{!r}}: {_NO_GRID}",
            lambda view: (
                view.has_ewald_sum and grid_for(view, PME_ORDER) is None and view.electrostatics
            ),
        ),
        Limit(
            "a barostat with frozen molecules: OpenMM would move them with the box",
            lambda view: view.frozen.any() and view.has_barostat,
        ),
    ),
    stage_limits=(
        *_LIMITS,
        Limit(
            "temperature_K or pressure_bar changes over the stage: OpenMM keeps them constant",
            lambda stage: stage.ramps,
        ),
    ),
)


class Group:
    """Force groups of a system. A step group subtracts the jump of the pair energies at the cutoff:
    it exerts no force, and energies with it are continuous. TAIL is the tail correction."""

    LENNARD_JONES, COULOMB_PAIRS, RECIPROCAL, STEP_LENNARD_JONES, STEP_COULOMB, TAIL = range(6)


def library() -> ModuleType:
    """The module openmm. Raises EngineError if it is not installed."""
    try:
        import openmm
    except ImportError:
        raise EngineError(f"OpenMM is not installed: {PROGRAM.install}") from None
    return openmm


class Layout(NamedTuple):
    """The particles of a system: sites and mass points, molecule by molecule. q particles, p mass
    points, s sites."""

    view: ForceFieldView
    bodies: RigidBodies  # of the mass points
    mass: np.ndarray  # (q,) u; 0 for virtual sites and frozen particles
    molecule: np.ndarray  # (q,)
    site: np.ndarray  # (s,) particle of each site
    point: np.ndarray  # (p,) particle of each mass point
    of_species: list[MassPoints]
    first: np.ndarray  # (n,) first particle of each molecule
    #: For each species the particles of its mass points, counted from `first`
    local: list[np.ndarray]

    def positions(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Positions, Å, and velocities, Å/ps, of all particles (q, 3) at a state."""
        at, velocity = np.zeros((2, len(self.mass), 3))
        at[self.site] = self.view.system.site_positions(state)
        at[self.point], velocity[self.point] = self.bodies.points(state)
        velocity[self.mass == 0] = 0.0
        return at, velocity

    def excluded(self) -> list[tuple[int, int]]:
        """Pairs of particles that do not interact: within a molecule, and between frozen
        molecules."""
        pairs = []
        for a, n in zip(self.first, np.diff([*self.first, len(self.mass)]), strict=True):
            pairs += [(int(a) + i, int(a) + j) for i in range(n) for j in range(i + 1, n)]
        frozen = np.flatnonzero(self.view.frozen[self.molecule])
        one, other = (frozen[index] for index in np.triu_indices(len(frozen), 1))
        between = self.molecule[one] != self.molecule[other]
        return pairs + list(zip(one[between].tolist(), other[between].tolist(), strict=True))


def layout(view: ForceFieldView) -> Layout:
    """The particles that represent a system: for each molecule its sites, in order, then its other
    mass points."""
    system = view.system
    species = system.model.species
    frozen = system.model.inverse_mass == 0
    bodies = [
        mass_points(m, frozen=bool(is_frozen))
        for m, is_frozen in zip(system.species, frozen, strict=True)
    ]
    local, mass = [], []
    for m, body, is_frozen in zip(system.species, bodies, frozen, strict=True):
        at, of_particles = body.particles(len(m.masses))
        local.append(at)
        mass.append(np.zeros_like(of_particles) if is_frozen else of_particles)
    count = np.array([len(of_species) for of_species in mass])[species]
    sites = system.sites_per_molecule
    first = np.cumsum(count) - count
    molecule = np.repeat(np.arange(len(species)), count)
    within = np.arange(sites.sum()) - np.repeat(np.cumsum(sites) - sites, sites)
    points = Points(
        np.repeat(np.arange(len(species)), [len(local[k]) for k in species]),
        gather_per_molecule([body.position_body for body in bodies], species),
        gather_per_molecule([body.mass for body in bodies], species),
    )
    return Layout(
        view,
        RigidBodies(system, points),
        gather_per_molecule(mass, species),
        molecule,
        np.repeat(first, sites) + within,
        np.concatenate([first[i] + local[k] for i, k in enumerate(species)]),
        bodies,
        first,
        local,
    )


def openmm_system(particles: Layout, cell: np.ndarray, *, separate: bool) -> "openmm.System":
    """The `openmm.System` with all forces except a barostat, and the initial cell (3, 3).

    separate : whether Lennard-Jones and Coulomb forces are separate even if one force can have
        both, which is faster: a step of 512 waters with PME takes 8 ms instead of 11 on two cores
    """
    import openmm

    view = particles.view
    made = openmm.System()
    for mass in particles.mass:
        made.addParticle(float(mass))
    if view.is_periodic:
        made.setDefaultPeriodicBoxVectors(*(cell * NM).tolist())
    for a, k in zip(particles.first, view.system.model.species, strict=True):
        body = particles.of_species[k]
        where = (particles.local[k] + a).tolist()
        if view.frozen[particles.molecule[a]]:
            continue
        for i, j, distance in body.distances:
            made.addConstraint(where[i], where[j], distance * NM)
        for k, site in body.virtual_sites.items():
            made.setVirtualSite(
                int(a) + k, _openmm_virtual_site(where, site.weight.tolist(), site.cross)
            )
    excluded = particles.excluded()
    for force, group in _forces(particles, separate=separate):
        force.setForceGroup(group)
        for i, j in excluded:
            if isinstance(force, openmm.NonbondedForce):
                force.addException(i, j, 0.0, 1.0, 0.0)
            elif isinstance(force, openmm.CustomNonbondedForce):
                force.addExclusion(i, j)
        made.addForce(force)
    return made


def _openmm_virtual_site(
    points: list[int], weight: list[float], cross: float
) -> "openmm.VirtualSite":
    """The virtual site at the sum of weight times point."""
    mm = library()
    if len(points) == 2:
        return mm.TwoParticleAverageSite(*points, *weight)
    if cross:
        return mm.OutOfPlaneSite(*points, weight[1], weight[2], cross / NM)
    if len(points) == 3:
        return mm.ThreeParticleAverageSite(*points, *weight)
    # the origin of local axes is an average of any number of particles; the axes do not matter
    return mm.LocalCoordinatesSite(points, weight, [-1, 1, 0, 0], [-1, 0, 1, 0], [0, 0, 0])


def _forces(particles: Layout, *, separate: bool) -> "list[tuple[PairsOrTail, int]]":
    """The forces of a system with their groups."""
    forces: list[tuple[PairsOrTail, int]] = []
    view = particles.view
    potential = view.lennard_jones
    coulomb = view.coulomb
    plain = _builtin_lennard_jones(view)
    has_charge_force = isinstance(coulomb, ScreenedCoulomb) or (
        coulomb is not None and coulomb.cutoff == inf
    )
    together = plain is not None and has_charge_force and not separate
    if potential is not None and view.epsilon.any():
        if plain is None:
            forces.append((_custom_lennard_jones(particles), Group.LENNARD_JONES))
        elif not together:
            force = _nonbonded(particles, potential.cutoff, np.zeros_like(view.charge), plain)
            forces.append((force, Group.LENNARD_JONES))
        if (
            view.is_periodic
            and isinstance(potential.truncation, Unmodified)
            and view.truncation == "plain"
        ):
            forces.append((_custom_lennard_jones(particles, step=True), Group.STEP_LENNARD_JONES))
    if coulomb is not None and has_charge_force:
        force = _nonbonded(particles, coulomb.cutoff, view.charge, plain if together else None)
        forces.append((force, Group.COULOMB_PAIRS))
        if isinstance(coulomb, ScreenedCoulomb):
            force.setNonbondedMethod(force.PME)
            force.setPMEParameters(float(coulomb.alpha) / NM, *(grid_for(view, PME_ORDER) or ()))
            force.setReciprocalSpaceForceGroup(Group.RECIPROCAL)
            height = f"{-float(erfc(coulomb.alpha * coulomb.cutoff)) / coulomb.cutoff!r}"
            forces.append((_custom_coulomb(particles, height), Group.STEP_COULOMB))
    elif coulomb is not None and not isinstance(coulomb, ScreenedCoulomb):
        forces.append(
            (_custom_coulomb(particles, coulomb_formula(coulomb, 1.0)), Group.COULOMB_PAIRS)
        )
        is_plain = view.scene.forces.reaction_field_truncation == "plain"
        if view.is_periodic and is_plain and isinstance(coulomb, ReactionField):
            height = f"{-(1 / coulomb.cutoff + coulomb.field * coulomb.cutoff**2)!r}"
            forces.append((_custom_coulomb(particles, height), Group.STEP_COULOMB))
    if (tail := view.system.tail) is not None:
        energy = float(tail.energy_volume) / KJ_PER_MOL * NM**3
        constant = float(tail.constant) / KJ_PER_MOL
        forces.append((library().CustomVolumeForce(f"{energy!r}/v+({constant!r})"), Group.TAIL))
    return forces


def _builtin_lennard_jones(view: ForceFieldView) -> tuple[np.ndarray, np.ndarray] | None:
    """sigma and epsilon of kinds if OpenMM has the Lennard-Jones potential of the scene built in,
    and those of all pairs follow by Lorentz-Berthelot rules, else None."""
    potential = view.lennard_jones
    if potential is None or not (potential.cutoff == inf or view.truncation in ("plain", "switch")):
        return None
    sigma, epsilon = view.sigma.diagonal(), view.epsilon.diagonal()
    same = np.allclose(view.epsilon, np.sqrt(np.outer(epsilon, epsilon)), rtol=ROUNDING, atol=0)
    wide = np.isclose(view.sigma, (sigma[:, None] + sigma) / 2, rtol=ROUNDING, atol=0)
    return (sigma, epsilon) if same and wide[view.epsilon > 0].all() else None


def _nonbonded(
    particles: Layout,
    cutoff: float,
    charge: np.ndarray,
    lennard_jones: tuple[np.ndarray, np.ndarray] | None,
) -> "openmm.NonbondedForce":
    """A NonbondedForce between charges (s,) of sites, and with sigma and epsilon of kinds."""
    view = particles.view
    rows = np.zeros((len(particles.mass), 3))
    force = _within(library().NonbondedForce(), view, cutoff)
    force.setUseDispersionCorrection(False)
    rows[:, 1] = 1.0
    rows[particles.site, 0] = charge
    if lennard_jones is not None:
        sigma, epsilon = lennard_jones
        rows[particles.site, 1] = sigma[view.kind] * NM
        rows[particles.site, 2] = epsilon[view.kind] / KJ_PER_MOL
        if (potential := view.lennard_jones) and isinstance(potential.truncation, Switched):
            force.setUseSwitchingFunction(True)
            force.setSwitchingDistance(float(potential.truncation.start) * NM)
    for row in rows.tolist():
        force.addParticle(*row)
    return force


def _within(force: "PairsT", view: ForceFieldView, cutoff: float) -> "PairsT":
    """The same force, within a cutoff (Å) unless it is infinite."""
    if cutoff < inf:
        force.setNonbondedMethod(
            force.CutoffPeriodic if view.is_periodic else force.CutoffNonPeriodic
        )
        force.setCutoffDistance(cutoff * NM)
    return force


def _custom(
    particles: Layout, cutoff: float, formula: str, name: str, of_sites: np.ndarray
) -> "openmm.CustomNonbondedForce":
    """A CustomNonbondedForce with a formula of r in Å, and named values (s,) of sites."""
    text = re.sub(r"\br\b", "R", formula)
    force = library().CustomNonbondedForce(f"{text}; R={1 / NM!r}*r" if text != formula else text)
    force.addPerParticleParameter(name)
    values = np.zeros(len(particles.mass))
    values[particles.site] = of_sites
    for value in values.tolist():
        force.addParticle([value])
    return _within(force, particles.view, cutoff)


def _custom_lennard_jones(particles: Layout, *, step: bool = False) -> "Pairs":
    """The Lennard-Jones potential as a formula, or its step at the cutoff. Linear in c12 and c6,
    from tables of kinds. Kind 0 is for mass points without a site."""
    view = particles.view
    potential = not_none(view.lennard_jones)
    if step:
        formula = f"c6*{potential.cutoff**-6!r}-c12*{potential.cutoff**-12!r}"
    else:
        of12, of6 = (
            lennard_jones_formula(potential, *c, 1.0).split(";", 1)
            for c in ((1.0, 0.0), (0.0, 1.0))
        )
        definitions = f";{of12[1]}" if len(of12) == 2 else ""
        formula = f"c12*({of12[0]})+c6*({of6[0]}){definitions}"
    formula += "; c12=table12(kind1,kind2); c6=table6(kind1,kind2)"
    force = _custom(particles, potential.cutoff, formula, "kind", view.kind + 1)
    six = view.sigma**6
    c6 = 4 * view.epsilon * six / KJ_PER_MOL
    for name, table in (("table12", c6 * six), ("table6", c6)):
        padded = np.pad(table, ((1, 0), (1, 0)))
        force.addTabulatedFunction(
            name, library().Discrete2DFunction(*padded.shape, padded.ravel().tolist())
        )
    return force


def _custom_coulomb(particles: Layout, formula: str) -> "Pairs":
    """q q times a formula of unit strength. Charges are in units in which q q/r is in kJ/mol."""
    main, *definitions = formula.split(";", 1)
    charge = particles.view.charge * np.sqrt(COULOMB / KJ_PER_MOL)
    text = "; ".join([f"q1*q2*({main})", *definitions])
    return _custom(particles, not_none(particles.view.coulomb).cutoff, text, "q", charge)


#: Variables of the velocity Verlet integrator: fraction of a kick, and whether positions move.
KICK, MOVES = "kick", "moves"
#: One more than the largest seed. OpenMM chooses a seed itself for 0.
SEEDS = 2**31 - 1
#: Interval, in steps, of a removal of momentum that never happens.
NEVER = 2**31 - 1
#: Relative tolerance of constrained distances by precision, which is double on the platforms
#: Reference and CPU.
TOLERANCES = {"double": 1e-12, "mixed": 1e-7, "single": 1e-6}


def integrator_of(view: ForceFieldView, k: int, distance_tolerance: float) -> "openmm.Integrator":
    """The integrator of stage k. A minimisation gets velocity Verlet."""
    mm = library()
    stage = view.system.scene.stages[k]
    dt = stage.step
    if stage.thermostat_kind == "langevin":
        friction = stage.thermostat_values["friction_translation_per_ps"]
        made = mm.LangevinMiddleIntegrator(stage.temperatures[0], friction, dt)
        made.setRandomNumberSeed(_seed(view, k))
    elif stage.thermostat_kind == "nose_hoover":
        # OpenMM has the angular frequency of a chain, a scene its period
        frequency = 2 * pi / stage.thermostat_time
        made = mm.NoseHooverIntegrator(
            stage.temperatures[0], frequency, dt, int(stage.thermostat_values["nose_hoover_links"])
        )
    else:
        made = _velocity_verlet(dt)
    made.setConstraintTolerance(distance_tolerance)
    made.setIntegrationForceGroups(integration_groups(stage))
    return made


def _velocity_verlet(dt: float) -> "openmm.CustomIntegrator":
    """Velocity Verlet with constrained distances, to be stepped by `step`.

    Leapfrog steps with half a kick at either end give the same positions and velocities (RATTLE;
    Andersen 1983, J. Comput. Phys. 52, 24) without forces within a step, where OpenMM has not yet
    computed the virtual sites.
    """
    made = library().CustomIntegrator(dt)
    made.addGlobalVariable(KICK, 1.0)
    made.addGlobalVariable(MOVES, 1.0)
    made.addPerDofVariable("x1", 0)
    made.addComputePerDof("v", f"v+{KICK}*dt*f/m")
    made.beginIfBlock(f"{MOVES} = 1")
    made.addComputePerDof("x", "x+dt*v")
    made.addComputePerDof("x1", "x")
    made.addConstrainPositions()
    made.addComputePerDof("v", "v+(x-x1)/dt")
    made.endBlock()
    made.beginIfBlock(f"{MOVES} = 0")
    made.addConstrainVelocities()
    made.endBlock()
    return made


def step(integrator: "openmm.Integrator", steps: int) -> None:
    """Take steps. Velocity Verlet starts and ends with half a kick."""
    import openmm

    if not isinstance(integrator, openmm.CustomIntegrator):
        integrator.step(steps)
        return
    for kick, moving, count in ((0.5, 1, 1), (1.0, 1, steps - 1), (0.5, 0, 1)):
        integrator.setGlobalVariableByName(KICK, kick)
        integrator.setGlobalVariableByName(MOVES, moving)
        integrator.step(count)


def integration_groups(stage: Stage) -> set[int]:
    """The force groups that move a stage: those with forces, and energies that a barostat needs in
    addition."""
    groups = {Group.LENNARD_JONES, Group.COULOMB_PAIRS, Group.RECIPROCAL}
    if stage.has_barostat:
        # it compares energies; the pressure agrees with the forces if energies are continuous
        groups |= {Group.STEP_LENNARD_JONES, Group.STEP_COULOMB, Group.TAIL}
    return groups


def extra_forces(view: ForceFieldView, k: int) -> "list[openmm.Force]":
    """The forces of stage k in addition to its integrator: a barostat, and a momentum remover, so
    that OpenMM subtracts the degrees of freedom of the total momentum."""
    mm = library()
    stage = view.system.scene.stages[k]
    system = view.system
    forces = []
    if stage.thermostat_kind == "nose_hoover" and system.freedom_in(k).translation < 3 * int(
        (~view.frozen).sum()
    ):
        forces.append(mm.CMMotionRemover(NEVER))
    if stage.has_barostat:
        barostat = mm.MonteCarloBarostat(
            stage.pressures[0][0], stage.temperatures[0], stage.moves_every
        )
        barostat.setRandomNumberSeed(_seed(view, k) % (SEEDS - 1) + 1)
        forces.append(barostat)
    return forces


def _seed(view: ForceFieldView, k: int) -> int:
    return (view.system.scene.seed * 1000 + k) % (SEEDS - 1) + 1
