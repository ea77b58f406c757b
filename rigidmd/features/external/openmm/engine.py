"""The engine that runs OpenMM, on one of its platforms.

Two contexts hold the system. One moves it, with several terms in one force where that is faster.
The other evaluates it term by term, so that observations leave no trace in the motion. OpenMM has
no virial: the molecular virial follows from energies at scaled centres of mass.
"""

from typing import TYPE_CHECKING

import numpy as np

from rigidmd.core.state import HEAT, Load, State
from rigidmd.engines.observables import kinetic_energies
from rigidmd.engines.protocol import NotFiniteError, Tally
from rigidmd.engines.system import System
from rigidmd.errors import EngineError, SimulationError
from rigidmd.features.external.engines import (
    ExternalEngine,
    not_finite,
    same_state,
    tallies_of,
)
from rigidmd.features.external.openmm.program import FIXED_PRECISIONS, PLATFORMS, precision_of
from rigidmd.features.external.openmm.system import (
    NM,
    TOLERANCES,
    Group,
    extra_forces,
    integration_groups,
    integrator_of,
    layout,
    library,
    openmm_system,
    step,
)
from rigidmd.forces.ewald.corrections import background, intramolecular_energy, self_energy
from rigidmd.forces.potentials.screened_coulomb import ScreenedCoulomb
from rigidmd.units import COULOMB_CHARGE, KJ_PER_MOL

if TYPE_CHECKING:
    import openmm

ANGSTROM = 1 / NM  # Å per nm
#: kJ/mol/nm in u Å/ps².
FORCE = KJ_PER_MOL * NM
#: Strain of the finite differences for the virial, for energies in double precision or not. The
#: error of a difference is a few hundred times the strain squared, plus rounding divided by the
#: strain.
STRAIN = {True: 2e-5, False: 5e-4}
#: Limits of relative errors of forces by the arithmetic, and of the virial by its differences.
#: Measured: 6e-6 and 1e-4 on CPU, 0 and 1.4e-5 on Reference (216 TIP4P/2005 and 500 argon, cutoff 9
#: Å). On CUDA the same in mixed and in single precision: 5e-6 and 2e-4 (216 SPC/E, 216 TIP4P/2005
#: and, of the force scale, 500 argon; H200).
ERRORS = {"double": (0.0, 1e-4), "mixed": (2e-5, 1e-3), "single": (2e-5, 1e-3)}


def _platforms() -> "dict[str, openmm.Platform]":
    """Name -> platform of OpenMM on this machine."""
    kinds = library().Platform
    return {p.getName(): p for p in map(kinds.getPlatform, range(kinds.getNumPlatforms()))}


def installed() -> str:
    return f"OpenMM {library().__version__} with the platforms {', '.join(_platforms())}"


def properties_of(platform: str, precision: str | None, threads: int | None) -> dict[str, str]:
    """The properties of a platform: the number of threads of CPU, the precision of a GPU."""
    if platform in FIXED_PRECISIONS:
        return {"Threads": str(threads)} if platform == "CPU" and threads else {}
    return {"Precision": precision_of(platform, precision)}


class OpenmmEngine(ExternalEngine):
    """Moves molecules by OpenMM. Raises EngineError if it is not installed. `system.TRANSLATIONS`
    has all it can do."""

    length_tolerance = 2.0**-24  # SETTLE has its distances in single precision, on all platforms

    def __init__(
        self, system: System, stage: int = 0, platform: str = "CPU", precision: str | None = None
    ):
        mm = library()
        super().__init__(system, stage)
        view = self._view
        platforms = _platforms()
        if platform not in platforms:
            known = "" if platform in PLATFORMS else f". OpenMM knows {', '.join(PLATFORMS)}"
            cuda = "; pip install 'openmm[cuda12]' installs it" if platform == "CUDA" else ""
            raise EngineError(
                f"OpenMM has no platform {platform!r} here: there are"
                f" {', '.join(platforms)}{known}{cuda}"
            )
        properties = properties_of(platform, precision, system.scene.threads)
        self.version = f"OpenMM {mm.__version__} on {platform}"
        self._particles = layout(view)
        self._precision = precision_of(platform, precision)
        self.force_tolerance, self.virial_tolerance = ERRORS[self._precision]
        self._integrator = integrator_of(
            view, stage, TOLERANCES[properties.get("Precision", "double")]
        )
        verlet = mm.VerletIntegrator(0.001)
        try:
            evaluated, moved = (
                openmm_system(self._particles, system.state.cell, separate=apart)
                for apart in (True, False)
            )
            for force in extra_forces(view, stage):
                moved.addForce(force)
            self._evaluating_context = mm.Context(
                evaluated, verlet, platforms[platform], properties
            )
            self._moving_context = mm.Context(
                moved, self._integrator, platforms[platform], properties
            )
        except mm.OpenMMException as error:
            raise EngineError(f"OpenMM cannot hold this system on {platform}: {error}") from None
        self._groups = {force.getForceGroup() for force in evaluated.getForces()}
        if view.has_ewald_sum:
            self._groups.add(Group.RECIPROCAL)
        self._evaluated: tuple[State, Load, dict[str, Tally]] | None = None

    def _run(self, state: State, steps: int, dt: float) -> None:
        self._integrator.setStepSize(dt)
        try:
            step(self._integrator, steps)
        except library().OpenMMException as error:
            if "NaN" in str(error):
                raise not_finite(state) from None
            raise SimulationError(f"OpenMM stopped: {error}") from None

    def evaluate(self, state: State) -> tuple[Load, dict[str, Tally]]:
        if self._evaluated is None or not same_state(self._evaluated[0], state):
            self._put(self._evaluating_context, state)
            acting = self._groups - {Group.STEP_LENNARD_JONES, Group.STEP_COULOMB}
            on_all = (
                self._evaluating_context.getState(getForces=True, groups=acting)
                .getForces(asNumpy=True)
                ._value
            )
            # the forces on mass points include those of virtual sites
            bodies = self._particles.bodies
            force = on_all[self._particles.point] * FORCE
            position = bodies.points(state)[0]
            virial = self._virial(state, bodies.intramolecular_virial(position, force))
            self._evaluated = (
                state.copy(),
                bodies.load(state, position, force),
                self._tallies(state, virial),
            )
        _, load, tallies = self._evaluated
        return Load(*map(np.copy, load)), dict(tallies)

    def memory(self) -> dict[str, np.ndarray]:
        """OpenMM's checkpoint of the context: particles, random numbers, thermostat."""
        content = self._moving_context.createCheckpoint() if self._known_state is not None else b""
        return {
            "context": np.frombuffer(content, np.uint8).copy(),
            "heat": np.array([self._heat_offset]),
        }

    def recall(self, state: State, memory: dict[str, np.ndarray]) -> None:
        checkpoint = memory["context"]
        self._known_state = None
        if len(checkpoint):
            try:
                self._moving_context.loadCheckpoint(checkpoint.tobytes())
            except library().OpenMMException as error:
                raise ValueError(f"OpenMM cannot resume from its checkpoint: {error}") from None
            self._known_state, (self._heat_offset,) = state.copy(), memory["heat"].tolist()

    def close(self) -> None:
        for name in ("_moving_context", "_evaluating_context", "_integrator"):
            vars(self).pop(name, None)

    def _send(self, state: State) -> None:
        """Set OpenMM's state, unless it has it already. Its thermostat continues."""
        if same_state(self._known_state, state):
            return
        self._put(self._moving_context, state)
        self._moving_context.setVelocities(self._particles.positions(state)[1] * NM)
        self._heat_offset = float(state.energy_ledger[HEAT]) - self._heat(state)
        self._known_state = state.copy()

    def _put(self, context, state: State) -> None:
        """Set the positions and the cell of a context."""
        if not state.is_finite:
            raise NotFiniteError(state)
        if self._view.is_periodic:
            context.setPeriodicBoxVectors(*(state.cell * NM))
        context.setPositions(self._particles.positions(state)[0] * NM)

    def _receive(self, state: State) -> None:
        had = self._moving_context.getState(getPositions=True, getVelocities=True)
        point = self._particles.point
        position = had.getPositions(asNumpy=True)._value[point] * ANGSTROM
        velocity = had.getVelocities(asNumpy=True)._value[point] * ANGSTROM
        if not (np.isfinite(position).all() and np.isfinite(velocity).all()):
            raise not_finite(state)
        cell = state.cell
        if self._stage.has_barostat:
            cell = had.getPeriodicBoxVectors(asNumpy=True)._value * ANGSTROM
        received = self._particles.bodies.state(state, position, velocity, cell)
        # OpenMM wraps molecules into the box whenever it changes the box
        if self._stage.has_barostat:
            moved = received.position @ np.linalg.inv(cell) - state.position @ np.linalg.inv(
                state.cell
            )
            received.position[:] -= np.rint(moved) @ cell
        for mine, its in zip(state[:5], received[:5], strict=True):
            mine[:] = its
        state.energy_ledger[HEAT] = self._heat_offset + self._heat(state)

    def _heat(self, state: State) -> float:
        """Heat from a thermostat, up to a constant: the gain of the energy, u Å²/ps². OpenMM
        computes the energy of a Nosé-Hoover chain, but its velocities are half a step off, so that
        no conserved energy exists at any one time."""
        if self.conserves_energy:
            return 0.0
        energy = _energy_of(self._moving_context, integration_groups(self._stage))
        return energy + sum(kinetic_energies(self._system, state))

    def _tallies(self, state: State, virial: np.ndarray) -> dict[str, Tally]:
        """Energies by the names of rigidmd's terms, without the constants of single charges."""
        self._put(self._evaluating_context, state)

        def energy(group: int) -> float:
            return _energy_of(self._evaluating_context, {group})

        energies = {}
        if Group.LENNARD_JONES in self._groups:
            energies["lennard_jones"] = energy(Group.LENNARD_JONES)
        view = self._view
        potential = view.coulomb
        if isinstance(potential, ScreenedCoulomb):
            alpha = potential.alpha
            charge = view.charge * COULOMB_CHARGE
            even = background(float(charge.sum()) ** 2, alpha).strength / state.volume
            energies["coulomb_real"] = energy(Group.COULOMB_PAIRS) - self._excluded_energy(
                state, alpha
            )
            if potential.shift:
                energies["coulomb_real"] += energy(Group.STEP_COULOMB)
            energies["coulomb_reciprocal"] = (
                energy(Group.RECIPROCAL) - self_energy(charge, alpha) - even
            )
            if "coulomb_background" in view.system.terms:
                energies["coulomb_background"] = even
        elif potential is not None:
            energies["coulomb"] = energy(Group.COULOMB_PAIRS)
        return tallies_of(energies, virial)

    def _excluded_energy(self, state: State, alpha: float) -> float:
        """The reciprocal energy of excluded pairs, which OpenMM subtracts."""
        view = self._view
        total = 0.0
        species = view.system.model.species
        for k, m in enumerate(view.system.species):
            count = int(((species == k) & ~view.frozen).sum())
            total += count * intramolecular_energy(
                m.charges * COULOMB_CHARGE, m.positions_body, alpha
            )
        still = view.frozen[view.system.sites.molecule] & (view.charge != 0)
        if still.any():
            position = view.system.site_positions(state)[still]
            total += intramolecular_energy(view.charge[still] * COULOMB_CHARGE, position, alpha)
        return total

    def _virial(self, state: State, intramolecular: np.ndarray) -> np.ndarray:
        """The symmetric part of the molecular virial (3, 3): the decrease of the energy as centres
        of mass separate.

        Energies are continuous at the cutoff. 0 without a box.

        intramolecular : sum of F (x) d over mass points, which the virial of all sites (symmetric)
            has in addition

        If the scene has no output of the pressure tensor, only the trace is computed and each axis
        gets a third. That takes two energies instead of twelve at each observation.
        """
        virial = np.zeros((3, 3))
        strain = STRAIN[self._precision == "double"]
        if not self._view.is_periodic:
            return virial
        groups = self._groups - {Group.TAIL}

        def slope(along: np.ndarray) -> float:
            """Slope of the energy for a strain of centres and cell along a matrix."""
            energy = []
            for sign in (-1, 1):
                by = np.eye(3) + sign * strain * along
                self._put(
                    self._evaluating_context,
                    state._replace(position=state.position @ by, cell=state.cell @ by),
                )
                energy.append(_energy_of(self._evaluating_context, groups))
            return (energy[1] - energy[0]) / (2 * strain)

        output = self._system.scene.output
        if not (output.pressure_tensor or output.pressure_tensor_interval_ps):
            return -slope(np.eye(3)) / 3 * np.eye(3)
        for row, column in zip(*np.tril_indices(3), strict=True):  # the cell stays triangular
            along = np.zeros((3, 3))
            along[row, column] = 1.0
            element = (
                -slope(along) + (intramolecular[column, row] - intramolecular[row, column]) / 2
            )
            virial[row, column] = virial[column, row] = element
        return virial


def _energy_of(context, groups: set[int]) -> float:
    """Energy of some force groups in a context, u Å²/ps²."""
    return KJ_PER_MOL * context.getState(getEnergy=True, groups=groups).getPotentialEnergy()._value
