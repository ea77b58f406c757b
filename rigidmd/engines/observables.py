"""Observables of molecules at one state: energies, temperatures, pressure, momentum and the orthogonality of Q."""

from math import inf, nan
from typing import Any, NamedTuple

import numpy as np

from rigidmd.core.state import Load, State
from rigidmd.dynamics.momenta import DegreesOfFreedom
from rigidmd.dynamics.observables import sums_of_state
from rigidmd.engines.protocol import Engine
from rigidmd.engines.system import System
from rigidmd.units import BAR, BOLTZMANN, KJ_PER_MOL

UNIT = np.eye(3)


class Reading(NamedTuple):
    """Observables of molecules at one state, in the units of the log. Quantities that do not exist are NaN."""

    components: dict[str, float]  # potential energy by term and constant, kJ/mol
    potential: float  # their sum, kJ/mol
    kinetic_translation: float  # kJ/mol
    kinetic_rotation: float
    kinetic: float  # both
    energy: float  # potential and kinetic
    temperature: float  # K
    temperature_translation: float
    temperature_rotation: float
    temperature_translation_unbiased: float  # see `observe`; NaN with any integrator but velocity Verlet
    temperature_rotation_unbiased: float
    pressure_bar: float  # molecular, tail correction included; NaN without a box
    pressure_tensor_bar: np.ndarray  # (3, 3) the same by components, the symmetric part; NaN without a box
    virial: np.ndarray  # (3, 3) molecular, without the tail correction, kJ/mol
    momentum: np.ndarray  # (3,) u Å/ps
    force: np.ndarray  # (n, 3) on each molecule, lab frame, kJ/mol/Å
    torque_body: np.ndarray  # (n, 3) on each molecule, body frame, kJ/mol; (0, 3) of points
    orthogonality_error: float  # largest entry of |QᵀQ - 1|

    def __repr__(self) -> str:
        return f"<Reading: potential {self.potential:.6g} kJ/mol, temperature {self.temperature:.6g} K>"


class Observation(NamedTuple):
    """Observables of molecules at one state, in internal units (Å, ps, u, K, u Å²/ps²)."""

    components: dict[str, float]  # potential energy by term and constant
    virial: np.ndarray  # (3, 3) molecular
    kinetic_translation: float
    kinetic_rotation: float
    temperature_translation: float  # K; NaN without degrees of freedom
    temperature_rotation: float
    temperature: float
    temperature_translation_unbiased: float  # see `observe`; NaN with any integrator but velocity Verlet
    temperature_rotation_unbiased: float
    pressure_tensor: np.ndarray  # (3, 3) symmetric, u/(Å ps²); NaN without a box
    momentum: np.ndarray  # (3,)
    orthogonality_error: float
    load: Load

    @property
    def potential(self) -> float:
        return sum(self.components.values())

    @property
    def kinetic(self) -> float:
        return self.kinetic_translation + self.kinetic_rotation

    @property
    def energy(self) -> float:
        return self.potential + self.kinetic

    @property
    def pressure_tensor_bar(self) -> np.ndarray:
        """Molecular pressure tensor (3, 3) in bar; NaN without a box."""
        return self.pressure_tensor / BAR

    @property
    def pressure_bar(self) -> float:
        """Molecular pressure in bar; NaN without a box."""
        return float(self.pressure_tensor.trace()) / (3 * BAR)

    @property
    def reading(self) -> Reading:
        """The observables in the units of the log."""
        energies = ("potential", "kinetic_translation", "kinetic_rotation", "kinetic", "energy", "virial")
        values: dict[str, Any] = {name: getattr(self, name) for name in Reading._fields if hasattr(self, name)}
        values |= {name: values[name] / KJ_PER_MOL for name in energies}
        values["components"] = {name: energy / KJ_PER_MOL for name, energy in self.components.items()}
        values |= {"force": self.load.force / KJ_PER_MOL, "torque_body": self.load.torque_body / KJ_PER_MOL}
        return Reading(**values)

    @property
    def largest_force(self) -> tuple[float, int]:
        """Largest force on a molecule (u Å/ps²), and the index of that molecule."""
        size = np.linalg.norm(self.load.force, axis=1)
        return float(size.max()), int(size.argmax())


def observe(
    system: System, engine: Engine, state: State, verlet_step: float = nan, freedom: DegreesOfFreedom | None = None,
    moved: bool = False
) -> Observation:  # fmt: skip
    """All observables, from one evaluation of forces and energies.

    freedom : degrees of freedom of the temperatures; by default `system.freedom`
    moved : whether the engine has just moved this state, so that it may have its forces and energies already
    verlet_step : time step (ps) if the state comes from velocity Verlet. Between its kicks the kinetic energy is higher
    than at its steps by dt²/8 [sum F²/m + sum n . I^-1 n] on average: for a mode of frequency w the first is too high
    by x/12 and the second too low by x/6, x = (w dt)². The weighted mean (twice the first plus once the second)/3 is
    right to O(x²) (Eastwood et al. 2010, J. Chem. Theory Comput. 6, 2045): the unbiased temperatures.

    The pressure is the molecular one, (sum m V V + sum F R)/V over centres of mass (Allen & Tildesley 2017, 2.7.2). Its
    tensor is the symmetric part. The rest is the rate at which orientations gain angular momentum, 0 on average.
    """
    load, tallies = engine.evaluate_current(state) if moved else engine.evaluate(state)
    components = {name: tally.energy for name, tally in tallies.items()} | system.constants
    volume, tail_pressure = state.volume, 0.0
    if system.tail is not None:
        components["tail" if system.user_terms else "lennard_jones_tail"] = system.tail.energy(volume)
        tail_pressure = system.tail.pressure(volume)
    virial = sum((tally.virial for tally in tallies.values()), np.zeros((3, 3)))
    sums = engine.sums(state, load) or sums_of_state(system.model, state, load)
    translation, rotation = 0.5 * sums.translation, 0.5 * sums.rotation
    correction = verlet_step**2 / 12
    translation_unbiased = translation + correction * sums.force
    rotation_unbiased = rotation + correction * sums.torque
    freedom = freedom or system.freedom
    pressure = np.full((3, 3), nan)
    if volume < inf:
        pressure = (sums.flow + (virial + virial.T) / 2) / volume + (system.constant_pressure + tail_pressure) * UNIT
    return Observation(
        components=components, virial=virial, kinetic_translation=translation, kinetic_rotation=rotation,
        temperature_translation=_temperature(translation, freedom.translation),
        temperature_rotation=_temperature(rotation, freedom.rotation),
        temperature=_temperature(translation + rotation, freedom.total),
        temperature_translation_unbiased=_temperature(translation_unbiased, freedom.translation),
        temperature_rotation_unbiased=_temperature(rotation_unbiased, freedom.rotation), pressure_tensor=pressure,
        momentum=sums.momentum, orthogonality_error=sums.orthogonality_error, load=load,
    )  # fmt: skip


def kinetic_energies(system: System, state: State) -> tuple[float, float]:
    """Kinetic energies of translation and rotation, u Å²/ps²."""
    sums = sums_of_state(system.model, state)
    return 0.5 * sums.translation, 0.5 * sums.rotation


def _temperature(kinetic: float, freedom: int) -> float:
    return 2 * kinetic / (freedom * BOLTZMANN) if freedom else nan
