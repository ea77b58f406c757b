"""Observables of molecules at one state: energies, temperatures, pressure, momentum and the
orthogonality of Q."""

from math import hypot, inf, isfinite, nan
from typing import NamedTuple, cast

import numpy as np

from rigidmd.core.state import HEAT, NOW, WORK, Load, State, edges_and_angles
from rigidmd.dynamics.observables import sums_of_state
from rigidmd.engines.protocol import Engine
from rigidmd.engines.samples import Sample
from rigidmd.engines.system import System
from rigidmd.forces.ewald.interactions import NEUTRAL
from rigidmd.forces.neighbors.pair_loop import PairForces
from rigidmd.forces.potentials.coulomb import ReactionField
from rigidmd.forces.potentials.truncation import Unmodified
from rigidmd.units import BAR, BOLTZMANN, GRAM_PER_CM3, KJ_PER_MOL

UNIT = np.eye(3)
#: Columns of the box, and of the pressure tensor with their entries in it.
EDGES = ("a", "b", "c", "alpha", "beta", "gamma")
COMPONENTS = {
    f"pressure_{'xyz'[i]}{'xyz'[j]}": (i, j)
    for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
}


class Observation(NamedTuple):
    """The observables of molecules at one state: a line of the log, and what the log does not have.

    The columns of the line are attributes too, such as `potential`, all but the size of the
    momentum. Energies are in the unit that `observe` was given, kJ/mol in a run. Quantities that do
    not exist are NaN.
    """

    sample: Sample
    components: dict[str, float]  # potential energy by term and constant
    kinetic_translation: float
    kinetic_rotation: float
    #: (3, 3) molecular, tail correction included, symmetric; NaN without a box
    pressure_tensor_bar: np.ndarray
    virial: np.ndarray  # (3, 3) molecular, without the tail correction; an energy
    momentum: np.ndarray  # (3,) u Å/ps
    load: Load  # u Å/ps² and u Å²/ps²
    energy_unit: float  # u Å²/ps²

    def __getattr__(self, column: str) -> float:
        return getattr(self.sample, column)

    @property
    def stage_name(self) -> str:
        return self.sample.stage_name

    @property
    def user_energies(self) -> tuple[float, ...]:
        return self.sample.user_energies

    def __dir__(self) -> list[str]:
        return [*object.__dir__(self), *Sample._fields]

    def __repr__(self) -> str:
        energy = self.potential * self.energy_unit / KJ_PER_MOL
        return f"<Observation: potential {energy:.6g} kJ/mol, temperature {self.temperature:.6g} K>"

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
    trajectories: tuple[float, ...] = (),
) -> Observation:
    """All observables, from one evaluation of forces and energies. This function fills the columns
    of the log.

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
    trajectories : the columns `OF_FEATURES`, if the scene has them

    The pressure is the molecular one, (sum m V V + sum F R)/V over centres of mass (Allen &
    Tildesley 2017, 2.7.2), and kB T/V along each axis along which the total momentum is kept at
    zero: its mean in a liquid, see the theory chapter `sampling`. Its tensor is the symmetric part.
    The rest is the rate at which orientations gain angular momentum, 0 on average.
    """
    load, tallies = engine.evaluate_current(state) if moved else engine.evaluate(state)
    components = {name: tally.energy for name, tally in tallies.items()} | system.constants
    volume = state.volume
    tail_pressure = 0.0
    if system.tail is not None:
        components["tail" if system.user_terms else "lennard_jones_tail"] = system.tail.energy(
            volume
        )
        tail_pressure = system.tail.pressure(volume)
    virial = sum((tally.virial for tally in tallies.values()), np.zeros((3, 3)))
    sums = engine.sums(state, load) or sums_of_state(system.model, state, load)
    translation, rotation = 0.5 * sums.translation, 0.5 * sums.rotation
    potential = sum(components.values())
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
    if boxed := volume < inf:
        pressure = (flux + (virial + virial.T) / 2) / volume + (
            system.constant_pressure + tail_pressure
        ) * UNIT
        edges = edges_and_angles(state.cell)
    else:
        pressure = np.full((3, 3), nan)
        edges = [nan] * 6
    tensor_bar = pressure / BAR
    # not in pilot runs, whose samples are in no log
    extras = [] if stage is None else system.extras.values()
    energy = (potential + kinetic) / energy_unit
    ledger = state.energy_ledger / energy_unit
    conserved = energy - float(ledger.sum())
    sample = Sample(
        step=int(state.step[NOW]),
        time=float(state.time[NOW]) if time is None else time,
        potential=potential / energy_unit,
        kinetic=kinetic / energy_unit,
        energy=energy,
        temperature=temperature,
        volume=volume * 1e-3 if boxed else nan,
        density=system.mass / volume / GRAM_PER_CM3 if boxed else nan,
        stage_name=system.scene.stages[stage or 0].label,
        temperature_translation=of_translation,
        temperature_rotation=_temperature(rotation_corrected, freedom.rotation),
        pressure_bar=float(pressure.trace()) / (3 * BAR),
        drift=conserved - (conserved if origin is None else origin),
        momentum=hypot(*sums.momentum.tolist()),
        orthogonality_error=sums.orthogonality_error,
        **dict(zip(EDGES, edges, strict=True)),
        heat=float(ledger[HEAT]),
        work=float(ledger[WORK]),
        **{name: float(tensor_bar[at]) for name, at in COMPONENTS.items()},
        conserved=conserved,
        stage=stage or 0,
        force_squares=sums.force / energy_unit if isfinite(sums.force) else nan,
        torque_squares=sums.torque / energy_unit if isfinite(sums.torque) else nan,
        user_energies=(
            *(components[name] / energy_unit for name in system.user_terms),
            *(term.distance_in(state) for term in system.distances.values()),
            *(x / energy_unit for extra in extras for x in extra.values(system, state, potential)),
            *trajectories,
        ),
    )
    return Observation(
        sample,
        {name: energy / energy_unit for name, energy in components.items()},
        translation / energy_unit,
        rotation / energy_unit,
        tensor_bar,
        virial / energy_unit,
        sums.momentum,
        load,
        energy_unit,
    )


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
