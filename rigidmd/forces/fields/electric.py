"""A uniform electric field on molecules, steady or oscillating: U = -E . M, see the theory chapter
`interactions`.

Every kick adds the work of an oscillating field, -(dE/dt) . M, over its part of the step to the
energy ledger. This is the flow of the momentum that is conjugate to time as a coordinate, so energy
less work is conserved as well as any Hamiltonian.
"""

from math import cos, pi, radians, sin
from typing import NamedTuple

import numpy as np

from rigidmd.compile import implements, kernel
from rigidmd.core.plain_text import vector_text
from rigidmd.core.state import NOW, OK
from rigidmd.forces.parts import SystemParts
from rigidmd.forces.terms import add_forces, energy_rate
from rigidmd.mechanics.vectors import body_component, body_vector
from rigidmd.scene.fields import Fields
from rigidmd.scene.validation import not_none
from rigidmd.units import VOLT_PER_NM


class ElectricField(NamedTuple):
    species: np.ndarray  # (n,) int32
    charge: np.ndarray  # (species,) net charge, e; 0 for a frozen species
    dipole_body: np.ndarray  # (species, 3) about the centre of mass, e Å; 0 for a frozen species
    field: np.ndarray  # (3,) lab frame, force on a charge e, u Å/ps²

    @property
    def changes_momentum(self) -> np.ndarray:
        """Components (3,) of the total momentum that it changes: those along the field, unless the
        charges cancel."""
        charge = self.charge[self.species]
        cancels = abs(charge.sum()) <= 1e-10 * np.abs(charge).sum()
        return np.zeros(3, bool) if cancels else self.field != 0

    @property
    def absolute_positions(self) -> bool:
        """Whether its energy depends on positions in the lab: if any molecule has a net charge."""
        return bool(self.charge[self.species].any())


class OscillatingField(NamedTuple):
    """A uniform field E0 cos(frequency t + phase), t the time of the state."""

    species: np.ndarray
    charge: np.ndarray
    dipole_body: np.ndarray
    field: np.ndarray  # (3,) E0
    frequency: float  # angular, rad/ps
    phase: float  # rad

    time_dependent = True
    changes_momentum = ElectricField.changes_momentum
    absolute_positions = ElectricField.absolute_positions


def term(
    parts: SystemParts, fields: Fields, where: str, errors: list[str]
) -> ElectricField | OscillatingField | None:
    """The term of fields.electric_V_per_nm."""
    if not any(fields.electric_V_per_nm or ()):
        return None
    charge = np.where(parts.moves, [m.charge for m in parts.species], 0.0)
    dipole = np.where(
        parts.moves[:, None], [m.charges @ m.positions_body for m in parts.species], 0.0
    )
    present = np.unique(parts.model.species)
    if not (charge[present].any() or dipole[present].any()):
        errors.append(f"{where} would have no effect: no molecule that moves has a charge")
    steady = ElectricField(
        parts.model.species, charge, dipole, np.array(fields.electric_V_per_nm) * VOLT_PER_NM
    )
    if fields.electric_frequency_per_ps is None:
        return steady
    return OscillatingField(
        *steady, 2 * pi * fields.electric_frequency_per_ps, radians(fields.electric_phase_deg)
    )


def sentence(fields: Fields, term: object) -> str:
    """What `rigidmd check` prints of it."""
    amplitude = f"{vector_text(not_none(fields.electric_V_per_nm))} V/nm"
    if fields.electric_frequency_per_ps is None:
        return amplitude
    frequency = f"f = {fields.electric_frequency_per_ps:g}/ps. Its work is in the energy ledger"
    return f"{amplitude} cos(2 pi f t + {fields.electric_phase_deg:g}°), {frequency}"


@implements(add_forces, ElectricField)
def _add_electric_field(term, state, load, tally):
    return _add_field(term, state, load, tally, 1.0)


@implements(add_forces, OscillatingField)
def _add_oscillating_field(term, state, load, tally):
    return _add_field(term, state, load, tally, cos(term.frequency * state.time[NOW] + term.phase))


@kernel
def _add_field(term, state, load, tally, factor):
    """Forces, torques and energy of `factor` times the field."""
    for m in range(len(state.position)):
        kind = term.species[m]
        for k in range(3):
            load.force[m, k] += factor * term.charge[kind] * term.field[k]
    for m in range(len(state.rotation)):
        mu = term.dipole_body[term.species[m]]
        q = state.rotation[m]
        x, y, z = body_vector(q, term.field)
        a, b, c = factor * x, factor * y, factor * z
        load.torque_body[m, 0] += mu[1] * c - mu[2] * b
        load.torque_body[m, 1] += mu[2] * a - mu[0] * c
        load.torque_body[m, 2] += mu[0] * b - mu[1] * a
    if tally is not None:
        tally[0] -= factor * _along_moment(term, state)
    return OK


@kernel
def _along_moment(term, state):
    """E0 . M."""
    total = 0.0
    for m in range(len(state.position)):
        charge = term.charge[term.species[m]]
        for k in range(3):
            total += charge * term.field[k] * state.position[m, k]
    for m in range(len(state.rotation)):
        mu = term.dipole_body[term.species[m]]
        for k in range(3):
            total += mu[k] * body_component(state.rotation[m], term.field, k)
    return total


@implements(energy_rate, OscillatingField)
def _rate_of_oscillating_field(term, state):
    return (
        term.frequency
        * sin(term.frequency * state.time[NOW] + term.phase)
        * _along_moment(term, state)
    )
