"""Observables of molecules at one state: energies, temperatures, pressure, momentum and the
orthogonality of Q."""

from dataclasses import dataclass, field
from math import inf, nan
from typing import cast

import numpy as np

from rigidmd.core.quantities import QUANTITIES
from rigidmd.core.state import NOW, Load, State, edges_and_angles
from rigidmd.core.user_warnings import warn_renamed
from rigidmd.dynamics.observables import StateSums, sums_of_state
from rigidmd.engines.protocol import Engine
from rigidmd.engines.samples import Sample
from rigidmd.engines.system import System
from rigidmd.forces.ewald.interactions import NEUTRAL
from rigidmd.forces.neighbors.pair_loop import PairForces
from rigidmd.forces.potentials.coulomb import ReactionField
from rigidmd.forces.potentials.truncation import Unmodified
from rigidmd.units import BAR, BOLTZMANN, KJ_PER_MOL

UNIT = np.eye(3)


@dataclass(repr=False)
class Observation:
    """The observables of molecules at one state: a line of the log, and what the log does not have.

    The columns of the line are attributes too, such as `temperature`. Energies are in the unit that
    `observe` was given, kJ/mol in a run. Quantities that do not exist are NaN.

    Attributes
    ----------
    system : System
        The system of molecules
    state : State
        The state of the run, whose next steps change it
    load : Load
        Forces and torques, u Å/ps² and u Å²/ps²
    energies : dict of str to float
        Potential energy by term and constant, u Å²/ps²
    energy_unit : float
        Unit of energies, u Å²/ps²
    time : float
        Time since the start, ps
    stage : int
        Index of the stage
    origin : float or None
        Conserved energy at the start of the stage
    extension_sums : ndarray or None
        Sums of an engine since the last sample
    sums : StateSums
        Sums over molecules
    ledger : ndarray
        Heat, work and energy of removed momentum (3,), kJ/mol
    potential, kinetic, energy : float
        Potential and kinetic energy, and their sum, kJ/mol
    kinetic_translation, kinetic_rotation : float
        Parts of the kinetic energy, kJ/mol
    temperature, temperature_translation, temperature_rotation : float
        Temperatures of all motion, of translation and of rotation, K
    virial : ndarray
        Molecular virial (3, 3), without the tail correction, kJ/mol
    pressure : float
        Molecular pressure, bar
    pressure_tensor : ndarray
        Molecular pressure tensor (3, 3), symmetric, with the tail correction, bar
    edges : list of float
        Edges (Å) and angles (degrees) of the box
    sample : Sample
        The line of the log
    """

    system: System
    state: State
    load: Load
    energies: dict[str, float]
    energy_unit: float
    time: float
    stage: int
    origin: float | None
    extension_sums: np.ndarray | None
    sums: StateSums
    ledger: np.ndarray
    potential: float
    kinetic_translation: float
    kinetic_rotation: float
    kinetic: float
    energy: float
    temperature: float
    temperature_translation: float
    temperature_rotation: float
    virial: np.ndarray
    pressure: float
    pressure_tensor: np.ndarray
    edges: list[float]
    sample: Sample = field(default_factory=Sample, init=False)

    def __getattr__(self, column: str) -> float:
        if column == "pressure_tensor_bar":
            warn_renamed(column, "pressure_tensor")
            return self.pressure_tensor  # pyright: ignore[reportReturnType]
        return getattr(self.sample, column)

    def __dir__(self) -> list[str]:
        return [*object.__dir__(self), *vars(self.sample)]

    def __repr__(self) -> str:
        energy = self.potential * self.energy_unit / KJ_PER_MOL
        return f"<Observation: potential {energy:.6g} kJ/mol, temperature {self.temperature:.6g} K>"

    @property
    def stage_name(self) -> str:
        """Name of the stage."""
        return self.system.scene.stages[self.stage].label

    @property
    def conserved(self) -> float:
        """Total energy less heat, work and the energy of removed momentum, kJ/mol."""
        return self.energy - float(self.ledger.sum())

    @property
    def components(self) -> dict[str, float]:
        """Potential energy by term and constant."""
        return {name: energy / self.energy_unit for name, energy in self.energies.items()}

    @property
    def momentum(self) -> np.ndarray:
        """Total momentum (3,), u Å/ps."""
        return self.sums.momentum

    @property
    def force(self) -> np.ndarray:
        """Force (n, 3) on each molecule, lab frame, per Å."""
        return self.load.force / self.energy_unit

    @property
    def torque_body(self) -> np.ndarray:
        """Torque (n, 3) on each molecule, body frame. (0, 3) of points."""
        return self.load.torque_body / self.energy_unit


def observe(
    system: System,
    engine: Engine,
    state: State,
    stage: int | None = None,
    *,
    time: float | None = None,
    origin: float | None = None,
    correction: float = 0.0,
    moved: bool = False,
    energy_unit: float = KJ_PER_MOL,
    extension_sums: np.ndarray | None = None,
) -> Observation:
    """All observables, from one evaluation of forces and energies, and the columns of the log.

    stage : index of the stage, which may remove momentum from the degrees of freedom of the
        temperatures
    time : ps, by default of the state
    origin : conserved energy at the start of the stage, from which its drift is counted. By default
        the current one
    correction : of the kinetic energy in temperatures and pressures, for each (ps²) of the squares
        of forces and torques, see `Scheme.kinetic_correction`
    moved : whether the engine has just moved this state, so that it may have its forces and
        energies already
    energy_unit : unit of all energies, u Å²/ps²
    extension_sums : see `Engine.extension_sums`, since the last sample

    The pressure is the molecular one, (sum m V V + sum F R)/V over centres of mass (Allen &
    Tildesley 2017, 2.7.2), and kB T/V along each axis along which the total momentum is kept at
    zero: its mean in a liquid, see the theory chapter `sampling`. Its tensor is the symmetric part.
    The rest is the rate at which orientations gain angular momentum, 0 on average.
    """
    load, tallies = engine.evaluate_current(state) if moved else engine.evaluate(state)
    energies = {name: tally.energy for name, tally in tallies.items()} | system.constants
    volume = state.volume
    tail_pressure = 0.0
    if system.tail is not None:
        name = "tail" if system.user_terms else "lennard_jones_tail"
        energies[name] = system.tail.energy(volume)
        tail_pressure = system.tail.pressure(volume)
    virial = sum((tally.virial for tally in tallies.values()), np.zeros((3, 3)))
    sums = engine.sums(state, load) or sums_of_state(system.model, state, load)
    translation, rotation = 0.5 * sums.translation, 0.5 * sums.rotation
    potential = sum(energies.values())
    kinetic = translation + rotation
    translation_corrected, rotation_corrected, flux = translation, rotation, sums.momentum_flux
    if correction:  # else squares of forces may exceed the range of numbers
        translation_corrected = translation + correction * sums.force
        rotation_corrected = rotation + correction * sums.torque
        flux = flux + 2 * correction * sums.force_squares
    freedom = system.freedom if stage is None else system.freedom_in(stage)
    temperature = _temperature(translation_corrected + rotation_corrected, freedom.total)
    of_translation = _temperature(translation_corrected, freedom.translation)
    if (at_rest := system.at_rest_in(stage)).any() and freedom.total:
        # a single molecule has no other momentum than the total one
        missing = of_translation if freedom.translation else temperature
        flux = flux + BOLTZMANN * missing * np.diag(at_rest)
    if volume < inf:
        pressure = (flux + (virial + virial.T) / 2) / volume + (
            system.constant_pressure + tail_pressure
        ) * UNIT
        edges = edges_and_angles(state.cell)
    else:
        pressure = np.full((3, 3), nan)
        edges = [nan] * 6
    observation = Observation(
        system,
        state,
        load,
        energies,
        energy_unit,
        time=float(state.time[NOW]) if time is None else time,
        stage=stage or 0,
        origin=origin,
        extension_sums=extension_sums,
        sums=sums,
        ledger=state.energy_ledger / energy_unit,
        potential=potential / energy_unit,
        kinetic_translation=translation / energy_unit,
        kinetic_rotation=rotation / energy_unit,
        kinetic=kinetic / energy_unit,
        energy=(potential + kinetic) / energy_unit,
        temperature=temperature,
        temperature_translation=of_translation,
        temperature_rotation=_temperature(rotation_corrected, freedom.rotation),
        virial=virial / energy_unit,
        pressure=float(pressure.trace()) / (3 * BAR),
        pressure_tensor=pressure / BAR,
        edges=edges,
    )
    # those of pilot runs are in no log
    quantities = QUANTITIES if stage is None else system.quantities
    observation.sample = Sample(
        **{name: quantity.value(observation) for name, quantity in quantities.items()}
    )
    return observation


def kinetic_energies(system: System, state: State) -> tuple[float, float]:
    """Kinetic energies of translation and rotation, u Å²/ps²."""
    sums = sums_of_state(system.model, state)
    return 0.5 * sums.translation, 0.5 * sums.rotation


def _temperature(kinetic: float, freedom: int) -> float:
    return 2 * kinetic / (freedom * BOLTZMANN) if freedom else nan


def describe_quantities(system: System) -> dict[str, str]:
    """Explanations for `rigidmd energy`: name of an energy of charges, `virial` or `pressure` ->
    text."""
    method = system.scene.forces.electrostatics
    descriptions = {}
    if method == "reaction_field" and system.cutoff < inf and "coulomb" in system.terms:
        descriptions = _describe_reaction_field(system)
    elif method in ("ewald", "pme"):
        descriptions = _describe_ewald(system)
    descriptions = {
        name: text
        for name, text in descriptions.items()
        if name in {*system.terms, *system.constants}
    }
    if system.space.volume == inf:
        return descriptions
    virial, pressure = "sum of F·R over molecules", "(2 K of translation + virial)/3 V"
    if axes := int(system.at_rest_in(None).sum()):
        momentum = "the total momentum, which is zero"
        pressure += f", and {'' if axes == 3 else f'{axes}/3 of '}kB T_trans/V of {momentum}"
    if system.external:
        virial += (
            ", of the forces between molecules. Fields, walls and restraints do not contribute"
        )
    if system.tail is not None:
        virial += ", without the tail correction"
        pressure += f", and {system.tail.pressure(system.state.volume) / BAR:.10g} bar of the tail"
    if "coulomb_frozen" in system.constants:
        constant = f"{system.constant_pressure / BAR:.10g} bar"
        pressure += f", and {constant}, which removes the forces between frozen molecules"
    return descriptions | {"virial": virial, "pressure": pressure}


def _describe_reaction_field(system: System) -> dict[str, str]:
    name = system.scene.forces.reaction_field_truncation or ""
    shape = cast(ReactionField, cast(PairForces, system.terms["coulomb"]).potential).truncation
    start = 0.0 if isinstance(shape, Unmodified) else shape.start
    ends = {
        "plain": "",
        "shift": ", less its value at the cutoff",
        "force_shift": ", less its value and slope there",
        "force_switch": f", its force switched off from {start:g} Å on",
    }
    how = ends.get(name, f", less its value at the cutoff, times {name} from {start:g} Å on")
    return {
        "coulomb": f"q q (1/r + k r²) up to the cutoff{how}",
        "reaction_field_self": "charges of each molecule in their own reaction field",
    }


def _describe_ewald(system: System) -> dict[str, str]:
    """The real-space energy may be shifted."""
    real, self_energy = "q q erfc(alpha r)/r between molecules", "-alpha/sqrt(pi) q² of each site"
    if system.scene.forces.ewald_truncation == "plain":
        return {"coulomb_real": f"{real}, plain at the cutoff", "coulomb_self": self_energy}
    of_shift = ". Shifted energies add nothing to it, as every molecule is neutral"
    if any(abs(m.charge) > NEUTRAL * np.abs(m.charges).sum() for m in system.species):
        of_shift = (
            ", and -erfc(alpha R)/(2 R) (sum of q)² of each molecule, as energies are shifted. R is"
            " the cutoff"
        )
    return {
        "coulomb_real": f"{real}, less its value at the cutoff",
        "coulomb_self": self_energy + of_shift,
    }
