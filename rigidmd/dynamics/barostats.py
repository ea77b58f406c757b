"""Boxes: flows that change the cell at a pressure, chosen by type; a constant volume compiles none.

A move multiplies the cell (rows a, b, c) and the centres of mass from the right by a lower triangular matrix T, which
keeps a along x and b in the xy plane. Rotations and angular momenta stay as they are: what answers is the molecular
virial sum F (x) R, with W_ij = sum F_i R_j in `tally[1:]`.

`move_box(box, ...)` acts where the row of a step has BOX, `stretch(box, ...)` where it has STRETCH. What a box does to
the energy of the molecules is in `state.books[WORK]`.
"""

from math import exp, log, sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.compile import implements, is_a, kernel
from rigidmd.core.integrators import BOX
from rigidmd.core.state import NOW, OK, ORIGIN, TALLY_SIZE, WORK, Load, State, no_load
from rigidmd.dynamics.force_gradient import copy
from rigidmd.dynamics.noise import Key, normals, uniforms
from rigidmd.dynamics.ramps import Ramp, present
from rigidmd.dynamics.thermostats import scale_array, translational_energy
from rigidmd.forces.neighbors.space import volume_of
from rigidmd.forces.terms import PRESSED, TALLIED, load_now

#: Components of strains and pressures, in this order: (row, column) of the lower triangle.
COMPONENTS = ((0, 0), (1, 1), (2, 2), (1, 0), (2, 0), (2, 1))
#: Which coordinate moves each component (-1: none).
COUPLINGS = {
    "isotropic": (0, 0, 0, -1, -1, -1),
    "semi_isotropic": (0, 0, 1, -1, -1, -1),
    "anisotropic": (0, 1, 2, -1, -1, -1),
    "flexible": (0, 1, 2, 3, 4, 5),
}
#: The drift of a move is no longer than this strain; noise comes on top. It bounds what a bad start does in one move.
LONGEST_DRIFT = 0.01


class Pressure(NamedTuple):
    """The pressure asked for, by component; it changes evenly over a stretch. u/(Å ps²)."""

    first: tuple[float, float, float, float, float, float]
    last: tuple[float, float, float, float, float, float]
    steps: float


class NoBox(NamedTuple):
    """Constant volume."""

    rate: float = 0.0


class CellRescaling(NamedTuple):
    """Stochastic cell rescaling (Bernetti & Bussi 2020, J. Chem. Phys. 153, 114107), made exact by a test.

    The strain of each coordinate drifts by beta h/(3 tau) (P - P0) and gets noise of variance 2 kT beta h/(3 V tau n),
    n the components that share it: d ln V = (beta/tau) (P - P0) dt + sqrt(2 kT beta/(V tau)) dW where all three do
    (anisotropic cells: Del Tatto, Raiteri, Bernetti & Bussi 2022, Appl. Sci. 12, 1139). P is that of virial and kinetic
    energy at the moment; translational momenta are divided by T. The move is then accepted or taken back by the rule of
    Metropolis and Hastings, so that neither h, tau nor beta leaves an error in what is sampled: exp(-(H + P0 V)/kT)
    with the measure dV and, of a cell that changes its shape, the invariant measure of the strain.

    Deviatoric pressures act as true (Cauchy) stress: their work is that in the mean volume of the move.
    """

    thermal_energy: Ramp  # kB T, u Å²/ps²
    pressure: Pressure
    rate: float  # compressibility over time constant, Å ps²/u/ps
    coordinate: tuple[int, int, int, int, int, int]  # of COUPLINGS
    at_rest: tuple[float, float, float]  # 1 of each axis along which the total momentum is kept at zero
    beyond: tuple[float, float]  # dispersion beyond the cut-off: its energy times V, its pressure times V²
    key: Key


class VolumeMoves(NamedTuple):
    """Monte Carlo barostat: V' uniform about V, centres scaled, velocities kept (Åqvist et al. 2004, Chem. Phys. Lett.
    384, 288); accepted with min(1, exp(-(dU + P0 dV)/kT + N ln(V'/V)))."""

    thermal_energy: Ramp
    pressure: Pressure
    width: float  # largest change of the volume, Å³
    molecules: float  # that move
    beyond: tuple[float, float]
    key: Key


class Piston(NamedTuple):
    """Isotropic volume with inertia and no noise (Andersen 1980, J. Chem. Phys. 72, 2384): constant enthalpy.

    H = K + U + P0 V + Pi²/(2 M) in centres and momenta scaled by the edge is followed by kicks of Pi (BOX) and changes
    of V (STRETCH), each exact, beside those of the molecules. Pi is the last number of `state.bath`; what P0 V and the
    piston gain is what `books[WORK]` loses.
    """

    pressure: Pressure
    inverse_mass: float  # 1/M, Å⁴/u, see `piston`
    beyond: tuple[float, float]


def piston(pressure: Pressure, period: float, compressibility: float, volume: float, beyond: tuple) -> Piston:
    """A piston with which a volume of this compressibility (Å ps²/u) swings with a period (ps).

    It hangs on the spring dP/dV = -1/(compressibility V), so that M = (period/2 pi)²/(compressibility V).
    """
    return Piston(pressure, compressibility * volume * (2 * np.pi / period) ** 2, beyond)


class BoxRoom(NamedTuple):
    """Where a move is made and, if it is rejected, taken back."""

    tally: np.ndarray  # (2, 10) energies and virials: now, before the move; of a piston virials only
    strain: np.ndarray  # (3, 6) of the move; its drift; its variance
    turned: np.ndarray  # (2, 3, 3) T, its inverse
    position: np.ndarray  # as in State
    velocity: np.ndarray
    cell: np.ndarray
    load: Load
    known: np.ndarray  # (1,) whether tally[0] is that of `load`
    counts: np.ndarray  # (2,) moves tried, accepted


def box_room(state: State) -> BoxRoom:
    """Room for the molecules of a state."""
    return BoxRoom(
        np.zeros((2, TALLY_SIZE)),
        np.zeros((3, 6)),
        np.zeros((2, 3, 3)),
        state.position.copy(),
        state.velocity.copy(),
        state.cell.copy(),
        no_load(state),
        np.zeros(1, np.int64),
        np.zeros(2, np.int64),
    )


def load_for(box, terms, state, load, room, row, which):
    """Forces and torques at the present positions; a status code.

    which : PLAIN, or TALLIED for energies and virials too. A step in which the box moves always computes virials, and
        energies too where the move depends on them
    """
    raise TypeError("compiled code only")


def move_box(box, model, terms, state, load, room, cursor, h, draw):
    """The flow of a box over a time h, in place; a status code. cursor : see `advance`."""
    raise TypeError("compiled code only")


def stretch(box, state, h):
    """The flow of the volume by its own inertia, in place."""
    raise TypeError("compiled code only")


@implements(load_for, inline=True)
def _load_for(box, terms, state, load, room, row, which):
    if is_a(box, NoBox):
        return lambda box, terms, state, load, room, row, which: load_now(terms, state, load, which)

    needed = PRESSED if is_a(box, Piston) else TALLIED

    def with_virials(box, terms, state, load, room, row, which):
        room.known[0] = 0
        for k in range(len(row.kind)):
            if row.kind[k] == BOX and (state.step[NOW] - state.step[ORIGIN] + 1) % row.every[k] == 0:
                return tally_bodies(terms, state, load, room, which if which == TALLIED else needed)
        return load_now(terms, state, load, which)

    return with_virials


@kernel(inline=True)
def tally_bodies(terms, state, load, room, which):
    """Forces and torques and virial at the present positions, with TALLIED also energies; a status code.

    which : TALLIED or PRESSED
    """
    status = load_now(terms, state, load, which)
    for k in range(TALLY_SIZE):
        room.tally[0, k] = 0.0
        for tally in terms.tallies:
            room.tally[0, k] += tally[k]
    room.known[0] = 1 if status == OK else 0
    return status


@implements(stretch)
def _stretch(box, state, h):
    if not is_a(box, Piston):
        return lambda box, state, h: None

    def stretch(box, state, h):
        volume = volume_of(state.cell)
        after = volume + h * box.inverse_mass * state.bath[-1]
        scale = (after / volume) ** (1 / 3)
        scale_array(state.position, scale)
        scale_array(state.velocity, 1 / scale)
        scale_array(state.cell, scale)
        state.books[WORK] -= asked(box.pressure, state, 0) * (after - volume)

    return stretch


@implements(move_box, Piston)
def _kick_piston(box, model, terms, state, load, room, cursor, h, draw):
    if cursor[1] != 1 or room.known[0] == 0:
        status = tally_bodies(terms, state, load, room, PRESSED)
        if status != OK:
            return status
        cursor[1] = 1
    volume = volume_of(state.cell)
    virial = room.tally[0, 1] + room.tally[0, 5] + room.tally[0, 9]
    pressure = (2 * translational_energy(model, state) + virial) / (3 * volume) + box.beyond[1] / volume**2
    before = state.bath[-1]
    state.bath[-1] += h * (pressure - asked(box.pressure, state, 0))
    state.books[WORK] -= 0.5 * box.inverse_mass * (state.bath[-1] ** 2 - before**2)
    return OK


@implements(move_box)
def _move_box(box, model, terms, state, load, room, cursor, h, draw):
    if is_a(box, NoBox):
        return lambda box, model, terms, state, load, room, cursor, h, draw: OK
    if is_a(box, Piston):
        return None

    def try_move(box, model, terms, state, load, room, cursor, h, draw):
        if cursor[2] == 0:
            if cursor[1] != 1 or room.known[0] == 0:
                cursor[1] = 0
                status = tally_bodies(terms, state, load, room, TALLIED)
                if status != OK:
                    return status
                cursor[1] = 1
            propose(box, model, state, room, h, draw)
            keep(state, load, room)
            apply_strain(box, state, room)
            cursor[2] = 1
        status = tally_bodies(terms, state, load, room, TALLIED)
        if status != OK:
            return status
        cursor[2] = 0
        chance = log_chance(box, model, state, room, h)
        u, _ = uniforms(box.key, draw + 8, 0, state.step[NOW])
        room.counts[0] += 1
        if log(u) < chance:
            room.counts[1] += 1
            state.books[WORK] += energy_gained(box, model, state, room)
        else:
            take_back(state, load, room)
            terms.known[0] = 0
        return OK

    return try_move


@kernel(inline=True)
def asked(pressure, state, k):
    """Component k of the pressure asked for in the step that is being taken."""
    share = (state.step[NOW] - state.step[ORIGIN] + 1) / pressure.steps
    return pressure.first[k] + (pressure.last[k] - pressure.first[k]) * share


@kernel
def keep(state, load, room):
    """Remember what a move changes."""
    copy(state.position, room.position)
    copy(state.velocity, room.velocity)
    copy(load.force, room.load.force)
    copy(load.torque_body, room.load.torque_body)
    copy(room.tally[:1], room.tally[1:])
    copy(state.cell, room.cell)


@kernel
def take_back(state, load, room):
    """Undo a move."""
    copy(room.position, state.position)
    copy(room.velocity, state.velocity)
    copy(room.load.force, load.force)
    copy(room.load.torque_body, load.torque_body)
    copy(room.tally[1:], room.tally[:1])
    copy(room.cell, state.cell)


def propose(box, model, state, room, h, draw):
    """Draw the strain of a move, with its drift and variance, into room.strain, and T and its inverse."""
    raise TypeError("compiled code only")


def log_chance(box, model, state, room, h):
    """The logarithm of the chance of a move that has been made to be kept."""
    raise TypeError("compiled code only")


@implements(propose)
def _propose(box, model, state, room, h, draw):
    if is_a(box, VolumeMoves):

        def propose_volume(box, model, state, room, h, draw):
            u, _ = uniforms(box.key, draw, 0, state.step[NOW])
            volume = volume_of(state.cell)
            room.strain[0] = 0.0
            for k in range(3):
                room.strain[0, k] = log(max(1 + (2 * u - 1) * box.width / volume, 0.1)) / 3
            set_matrices(room)

        return propose_volume

    def propose_strain(box, model, state, room, h, draw):
        drift(box, model, state, room, h, room.strain[1], room.strain[2])
        for c in range(6):
            xi, _ = normals(box.key, draw + c, 0, state.step[NOW])
            for k in range(6):
                if box.coordinate[k] == c:
                    room.strain[0, k] = room.strain[1, k] + sqrt(room.strain[2, k]) * xi
        set_matrices(room)

    return propose_strain


@kernel
def drift(box, model, state, room, h, mean, variance):
    """Mean and variance of the strain of a move, by component (6,), into `mean` and `variance`; 0 of what stays."""
    volume = volume_of(state.cell)
    thermal = present(box.thermal_energy, state)
    for k in range(6):
        mean[k] = variance[k] = 0.0
    for c in range(6):
        push, shared = 0.0, 0
        for k in range(6):
            if box.coordinate[k] == c:
                push += driving(box, model, state, room, k, volume, thermal)
                shared += 1
        for k in range(6):
            if box.coordinate[k] == c:
                variance[k] = 2 * thermal * box.rate * h / (3 * volume * shared)
                mean[k] = max(-LONGEST_DRIFT, min(LONGEST_DRIFT, variance[k] / (2 * thermal) * push))


@kernel
def driving(box, model, state, room, k, volume, thermal):
    """What drives component k of the strain: minus the derivative of H + P0 V, u Å²/ps²."""
    i, j = COMPONENTS[k]
    total = room.tally[0, 1 + 3 * j + i] - volume * asked(box.pressure, state, k)
    for m in range(len(state.velocity)):
        total += model.mass[model.species[m]] * state.velocity[m, i] * state.velocity[m, j]
    if k < 3:
        total += box.beyond[1] / volume + box.at_rest[k] * thermal
    return total


@kernel
def set_matrices(room):
    """T and its inverse of the strain: exp of the diagonal, the rest as it is."""
    matrix, inverse, strain = room.turned[0], room.turned[1], room.strain[0]
    matrix[:] = 0.0
    inverse[:] = 0.0
    for k in range(3):
        matrix[k, k] = exp(strain[k])
        inverse[k, k] = exp(-strain[k])
    matrix[1, 0], matrix[2, 0], matrix[2, 1] = strain[3], strain[4], strain[5]
    inverse[1, 0] = -matrix[1, 0] * inverse[0, 0] * inverse[1, 1]
    inverse[2, 1] = -matrix[2, 1] * inverse[1, 1] * inverse[2, 2]
    inverse[2, 0] = (matrix[1, 0] * matrix[2, 1] * inverse[1, 1] - matrix[2, 0]) * inverse[0, 0] * inverse[2, 2]


@kernel
def apply_strain(box, state, room):
    """Multiply centres and cell by T; momenta, where the box changes them, by its inverse."""
    matrix = room.turned[0]
    times(state.position, matrix)
    times(state.cell, matrix)
    give_way(box, state, room)


@kernel(inline=True)
def times(rows, matrix):
    """Multiply vectors (n, 3), rows, from the right by a lower triangular matrix, in place."""
    for m in range(len(rows)):
        x, y, z = rows[m, 0], rows[m, 1], rows[m, 2]
        rows[m, 0] = x * matrix[0, 0] + y * matrix[1, 0] + z * matrix[2, 0]
        rows[m, 1] = y * matrix[1, 1] + z * matrix[2, 1]
        rows[m, 2] = z * matrix[2, 2]


def give_way(box, state, room):
    """Change the velocities with the strain, or not."""
    raise TypeError("compiled code only")


@implements(give_way)
def _give_way(box, state, room):
    if is_a(box, VolumeMoves):
        return lambda box, state, room: None

    def contravariant(box, state, room):
        inverse = room.turned[1]
        for m in range(len(state.velocity)):
            x, y, z = state.velocity[m, 0], state.velocity[m, 1], state.velocity[m, 2]
            state.velocity[m, 0] = inverse[0, 0] * x
            state.velocity[m, 1] = inverse[1, 0] * x + inverse[1, 1] * y
            state.velocity[m, 2] = inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2] * z

    return contravariant


@kernel
def energy_gained(box, model, state, room):
    """Change of potential and kinetic energy by the move (u Å²/ps²), dispersion beyond the cut-off included."""
    gained = room.tally[0, 0] - room.tally[1, 0]
    gained += box.beyond[0] * (1 / volume_of(state.cell) - 1 / volume_of(room.cell))
    for m in range(len(state.velocity)):
        for k in range(3):
            squares = state.velocity[m, k] ** 2 - room.velocity[m, k] ** 2
            gained += 0.5 * model.mass[model.species[m]] * squares
    return gained


@implements(log_chance)
def _log_chance(box, model, state, room, h):
    if is_a(box, VolumeMoves):

        def of_volume(box, model, state, room, h):
            before, after = volume_of(room.cell), volume_of(state.cell)
            work = energy_gained(box, model, state, room) + asked(box.pressure, state, 0) * (after - before)
            return box.molecules * log(after / before) - work / present(box.thermal_energy, state)

        return of_volume

    def of_strain(box, model, state, room, h):
        before, after = volume_of(room.cell), volume_of(state.cell)
        matrix, inverse = room.turned[0], room.turned[1]
        there, back = room.strain, np.zeros((2, 6))
        drift(box, model, state, room, h, back[0], back[1])
        mean = (asked(box.pressure, state, 0) + asked(box.pressure, state, 1) + asked(box.pressure, state, 2)) / 3
        work = energy_gained(box, model, state, room) + mean * (after - before)
        chance = log(after / before)
        used = -1
        for k in range(6):
            if box.coordinate[k] < 0:
                continue
            i, j = COMPONENTS[k]
            turn = there[0, k]
            turn_back = -turn if k < 3 else inverse[i, j]
            deviation = asked(box.pressure, state, k) - (mean if k < 3 else 0.0)
            work += deviation * 0.5 * (before + after) * 0.5 * (turn - turn_back)
            if k < 3:
                chance += box.at_rest[k] * turn
            if box.coordinate[k] > used:  # coordinates are numbered in the order of their first component
                used = box.coordinate[k]
                chance += 0.5 * (turn - there[1, k]) ** 2 / there[2, k] + 0.5 * log(there[2, k])
                chance -= 0.5 * (turn_back - back[0, k]) ** 2 / back[1, k] + 0.5 * log(back[1, k])
        if box.coordinate[3] >= 0:
            # densities of T and of its inverse in the left invariant measure of lower triangular matrices
            chance -= 2 * (log(matrix[1, 1]) + 2 * log(matrix[2, 2]))
        return chance - work / present(box.thermal_energy, state)

    return of_strain
