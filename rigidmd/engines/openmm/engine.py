"""An engine that lets OpenMM compute, on one of its platforms.

Two contexts hold the system: one moves it, the other evaluates term by term, so that looks leave no trace in the motion
and what moves may compute several terms at once. OpenMM has
no virial; that of molecules follows from energies at centres of mass that are moved apart and together.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from rigidmd.core.state import HEAT, Load, State
from rigidmd.dynamics.step_loop import Model
from rigidmd.engines.cpu import NotFiniteError
from rigidmd.engines.external import OtherEngine, same
from rigidmd.engines.force_field import Portrait
from rigidmd.engines.observables import kinetic_energies
from rigidmd.engines.openmm import system as parts
from rigidmd.engines.openmm.stages import integration_groups, integrator_of, movers, step, tolerance
from rigidmd.engines.protocol import Tally
from rigidmd.engines.rigid_bodies import Bodies
from rigidmd.engines.system import System
from rigidmd.errors import EngineError, SimulationError
from rigidmd.forces.ewald.corrections import background, intramolecular_energy, self_energy
from rigidmd.forces.potentials.screened_coulomb import ScreenedCoulomb
from rigidmd.units import COULOMB_CHARGE, KJ_PER_MOL

if TYPE_CHECKING:
    import openmm

PLATFORMS = ("CPU", "Reference", "CUDA", "OpenCL", "HIP")
ANGSTROM = 1 / parts.NM  # in nm
#: kJ/mol/nm in u Å/ps².
FORCE = KJ_PER_MOL * parts.NM
#: Strain of the differences that give the virial, where energies are double and single. The error of a difference is
#: its square times a few hundred, and rounding over it.
STRAIN = {True: 2e-5, False: 5e-4}


class Held(NamedTuple):
    """A system in OpenMM, and what reads it."""

    drawn: Portrait
    particles: parts.Layout
    bodies: Bodies

    def positions(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Positions, Å, and velocities, Å/ps, of all particles (q, 3) at a state."""
        at, velocity = np.zeros((2, len(self.particles.mass), 3))
        at[self.particles.site] = self.drawn.system.site_positions(state)
        at[self.particles.point], velocity[self.particles.point] = self.bodies.points(state)
        velocity[self.particles.mass == 0] = 0.0
        return at, velocity

    def made(self, state: State, apart: bool) -> "openmm.System":
        """OpenMM's system in the cell of a state; see `openmm_system`."""
        return parts.openmm_system(self.drawn, self.particles, state.cell, apart)


def held(drawn: Portrait) -> Held:
    """How a system is held in OpenMM."""
    particles = parts.layout(drawn)
    return Held(drawn, particles, Bodies(drawn.system, particles.points))


def platform_of(name: str, system: System) -> tuple[Any, dict[str, str]]:
    """A platform of OpenMM and its properties. Raises EngineError with those that are there."""
    mm = parts.library()
    there = [mm.Platform.getPlatform(k).getName() for k in range(mm.Platform.getNumPlatforms())]
    if name not in there:
        known = "" if name in PLATFORMS else f"; OpenMM knows {', '.join(PLATFORMS)}"
        raise EngineError(f"OpenMM has no platform {name!r} here: there are {', '.join(there)}{known}")
    scene = system.scene
    if name == "CPU":
        return mm.Platform.getPlatformByName(name), {"Threads": str(scene.threads)} if scene.threads else {}
    return mm.Platform.getPlatformByName(name), {} if name == "Reference" else {"Precision": scene.precision}


class OpenmmEngine(OtherEngine):
    """Moves the molecules of a system as one of its stages says, see `rigidmd.engines.Engine`.

    `openmm_system.faults` tells what OpenMM cannot do. Raises EngineError if it is not here.
    """

    lengths_to = 2.0**-24  # SETTLE has its distances in single precision, on all platforms

    def __init__(self, system: System, stage: int = 0, platform: str = "CPU"):
        mm = parts.library()
        super().__init__(system, stage)
        drawn = self._portrait
        where, properties = platform_of(platform, system)
        self.made_by = f"OpenMM {mm.__version__} on {platform}"
        self._held = held(drawn)
        #: Whether forces are computed in double precision.
        self._double = platform == "Reference" or properties.get("Precision") == "double"
        self._integrator = integrator_of(drawn, stage, tolerance(platform, properties))
        rest = mm.VerletIntegrator(0.001)
        try:
            seen, moved = (self._held.made(system.state, apart) for apart in (True, False))
            for mover in movers(drawn, stage):
                moved.addForce(mover)
            self._seer = mm.Context(seen, rest, where, properties)
            self._mover = mm.Context(moved, self._integrator, where, properties)
        except mm.OpenMMException as error:
            raise EngineError(f"OpenMM cannot hold this system on {platform}: {error}") from None
        self._groups = {force.getForceGroup() for force in seen.getForces()}
        if drawn.has_waves:
            self._groups.add(parts.RECIPROCAL)
        self._seen: tuple[State, Load, dict[str, Tally]] | None = None

    def _run(self, state: State, steps: int, dt: float) -> None:
        self._integrator.setStepSize(dt)
        try:
            step(self._integrator, steps)
        except parts.library().OpenMMException as error:
            if "NaN" in str(error):
                raise NotFiniteError(state._replace(position=np.full_like(state.position, np.nan))) from None
            raise SimulationError(f"OpenMM stopped: {error}") from None

    def evaluate(self, state: State) -> tuple[Load, dict[str, Tally]]:
        if self._seen is None or not same(self._seen[0], state):
            position, force = self._forces(state)
            load = self._held.bodies.load(state, position, force)
            virial = self._virial(state, self._held.bodies.within(position, force))
            self._seen = state.copy(), load, self._tallies(state, virial)
        _, load, tallies = self._seen
        return Load(load.force.copy(), load.torque_body.copy()), dict(tallies)

    def memory(self) -> dict[str, np.ndarray]:
        """What OpenMM itself keeps of its context: particles, random numbers, its thermostat."""
        kept = (
            np.frombuffer(self._mover.createCheckpoint(), np.uint8).copy()
            if self._has is not None
            else np.zeros(0, np.uint8)
        )
        return {"context": kept, "heat": np.array([self._books])}

    def recall(self, state: State, memory: dict[str, np.ndarray]) -> None:
        """Go on from a state with what `memory` gave for it. Raises ValueError if they do not fit."""
        kept = memory["context"]
        self._has = None
        if len(kept):
            try:
                self._mover.loadCheckpoint(kept.tobytes())
            except parts.library().OpenMMException as error:
                raise ValueError(f"OpenMM cannot go on from its checkpoint: {error}") from None
            self._has, (self._books,) = state.copy(), memory["heat"].tolist()
        self._moved = state

    def close(self) -> None:
        for name in ("_mover", "_seer", "_integrator"):
            vars(self).pop(name, None)

    def _give(self, state: State) -> None:
        """Let OpenMM have a state, unless it has it already; its thermostat goes on."""
        if same(self._has, state):
            return
        self._put(self._mover, state)
        velocity = self._held.positions(state)[1]
        self._mover.setVelocities(velocity * parts.NM)
        self._books = float(state.books[HEAT]) - self._heat(state)
        self._has = state.copy()

    def _put(self, context, state: State) -> None:
        """Give a context the positions and the cell of a state."""
        if not state.is_finite:
            raise NotFiniteError(state)
        if self._held.drawn.boxed:
            context.setPeriodicBoxVectors(*(state.cell * parts.NM))
        context.setPositions(self._held.positions(state)[0] * parts.NM)

    def _take(self, state: State) -> None:
        """Fill a state in, in place, with what OpenMM has. Raises NotFiniteError."""
        had = self._mover.getState(getPositions=True, getVelocities=True)
        point = self._held.particles.point
        position = had.getPositions(asNumpy=True)._value[point] * ANGSTROM
        velocity = had.getVelocities(asNumpy=True)._value[point] * ANGSTROM
        if not (np.isfinite(position).all() and np.isfinite(velocity).all()):
            raise NotFiniteError(state._replace(position=np.full_like(state.position, np.nan)))
        cell = had.getPeriodicBoxVectors(asNumpy=True)._value * ANGSTROM if self._stage.has_barostat else state.cell
        found = self._held.bodies.state(state, position, velocity, cell)
        if self._stage.has_barostat:  # OpenMM puts molecules back into the box whenever it changes that
            moved = found.position @ np.linalg.inv(cell) - state.position @ np.linalg.inv(state.cell)
            found.position[:] -= np.rint(moved) @ cell
        for mine, its in zip(state[:5], found[:5], strict=True):
            mine[:] = its
        state.books[HEAT] = self._books + self._heat(state)

    def rotor(self, model: Model) -> None:
        """None: OpenMM turns bodies by keeping distances."""
        return None

    def _heat(self, state: State) -> float:
        """What a thermostat has put in, up to a constant, u Å²/ps²: what the energy has gained.

        OpenMM counts the energy of a Nosé-Hoover chain, but has velocities half a step off with it, and so no conserved
        energy at any one time.
        """
        if self.counts_heat:
            return 0.0
        groups = integration_groups(self._held.drawn, self._stage)
        energy = self._mover.getState(getEnergy=True, groups=groups).getPotentialEnergy()._value
        return KJ_PER_MOL * energy + sum(kinetic_energies(self._system, state))

    def _energy(self, group: int | set[int]) -> float:
        """Energy of some groups where the evaluating context is, u Å²/ps²."""
        groups = group if isinstance(group, set) else {group}
        return KJ_PER_MOL * self._seer.getState(getEnergy=True, groups=groups).getPotentialEnergy()._value

    def _forces(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Positions of mass points (p, 3) and the forces on them, in which those on virtual sites are."""
        self._put(self._seer, state)
        acting = self._groups - {parts.STEP_LENNARD_JONES, parts.STEP_COULOMB}
        force = self._seer.getState(getForces=True, groups=acting).getForces(asNumpy=True)._value
        return self._held.bodies.points(state)[0], force[self._held.particles.point] * FORCE

    def _tallies(self, state: State, virial: np.ndarray) -> dict[str, Tally]:
        """Energies under the names of rigidmd's terms, which leave constants of single charges to constants."""
        drawn = self._held.drawn
        self._put(self._seer, state)
        found = {"lennard_jones": self._energy(parts.LENNARD_JONES)} if parts.LENNARD_JONES in self._groups else {}
        law = drawn.coulomb
        if isinstance(law, ScreenedCoulomb):
            alpha = law.alpha
            charge = drawn.charge * COULOMB_CHARGE
            even = background(float(charge.sum()) ** 2, alpha).strength / state.volume
            found["coulomb_real"] = self._energy(parts.COULOMB_PAIRS) - self._within(state, alpha)
            if law.shift:
                found["coulomb_real"] += self._energy(parts.STEP_COULOMB)
            found["coulomb_reciprocal"] = self._energy(parts.RECIPROCAL) - self_energy(charge, alpha) - even
            if "coulomb_background" in drawn.system.terms:
                found["coulomb_background"] = even
        elif law is not None:
            found["coulomb"] = self._energy(parts.COULOMB_PAIRS)
        zero = np.zeros((3, 3))
        return {name: Tally(float(u), zero if k else virial) for k, (name, u) in enumerate(found.items())}

    def _within(self, state: State, alpha: float) -> float:
        """What OpenMM takes off for the pairs that do not act on one another, which the sum over waves has."""
        drawn, total = self._held.drawn, 0.0
        species = drawn.system.model.species
        for k, m in enumerate(drawn.system.species):
            count = int(((species == k) & ~drawn.frozen).sum())
            total += count * intramolecular_energy(m.charges * COULOMB_CHARGE, m.positions_body, alpha)
        still = drawn.frozen[drawn.system.sites.molecule] & (drawn.charge != 0)
        if still.any():
            position = drawn.system.site_positions(state)[still]
            total += intramolecular_energy(drawn.charge[still] * COULOMB_CHARGE, position, alpha)
        return total

    def _virial(self, state: State, within: np.ndarray) -> np.ndarray:
        """The virial of molecules (3, 3), its symmetric part: how the energy falls as their centres move apart, from
        energies that are continuous at the cut-off. 0 without a box.

        within : sum of F (x) d over mass points; the virial of all sites, which is symmetric, has it besides

        Where the scene asks for no tensor of pressures, only its trace, of which each axis gets a third: that takes two
        energies in place of twelve, and every look has to wait for them.
        """
        virial, strain = np.zeros((3, 3)), STRAIN[self._double]
        if not self._held.drawn.boxed:
            return virial
        groups = self._groups - {parts.TAIL}

        def slope(along: np.ndarray) -> float:
            """Of the energy with a strain of centres and cell along a matrix."""
            energy = []
            for sign in (-1, 1):
                by = np.eye(3) + sign * strain * along
                self._put(self._seer, state._replace(position=state.position @ by, cell=state.cell @ by))
                energy.append(self._energy(groups))
            return (energy[1] - energy[0]) / (2 * strain)

        output = self._system.scene.output
        if not (output.pressure_tensor or output.pressure_tensor_interval_ps):
            return -slope(np.eye(3)) / 3 * np.eye(3)
        for row, column in zip(*np.tril_indices(3), strict=True):  # the cell keeps its form
            along = np.zeros((3, 3))
            along[row, column] = 1.0
            apart = -slope(along) + (within[column, row] - within[row, column]) / 2
            virial[row, column] = virial[column, row] = apart
        return virial
