"""Forces of users compared with differences of their energies at the start of a run."""

from collections.abc import Callable, Sequence
from functools import partial
from math import inf

import numpy as np

from rigidmd.core.state import Load, State
from rigidmd.dynamics.barostats import COMPONENTS
from rigidmd.dynamics.model import mobile
from rigidmd.engines.system import System
from rigidmd.errors import SceneError
from rigidmd.forces.neighbors.pair_loop import PairForces
from rigidmd.mechanics.rotation import from_vector
from rigidmd.scene.models import OFF_AXIS
from rigidmd.units import KJ_PER_MOL

#: Displacements of molecules, in smallest diameters or radians, and strains of the box. A force is
#: right if it agrees for one of them, as a pair that crosses a cutoff at which the energy jumps
#: spoils a difference.
STEP_FRACTIONS = (1e-4, 1e-5)
STRAINS = (1e-5, 1e-6, 1e-7)
#: Displacement in smallest diameters after which a wrong force is still wrong.
DISPLACED = 0.01
#: If energies have random errors, the first of these times this factor is used.
NOISY = 10.0
#: Allowed error of a difference, as a fraction of the largest force, torque or virial of the term.
TOLERANCE = 1e-4
#: Rounding error of an energy, as a fraction of its size.
ROUNDING = 1e-13


#: The fall of the energy along a move, if it is not the given one: by a function of the step,
#: steps, given value, size.
_Difference = Callable[[Callable[[float], State], Sequence[float], float, float], float | None]


def check_forces(system: System, state: State) -> None:
    """Compare user-defined forces with differences of their energies, for a few molecules and the
    box. Raises SceneError with the numbers where they differ, also after small displacements: in a
    lattice many pairs can be at the distance of a jump."""
    errors = []
    for name in system.user_terms:
        error = _error_of_force(system, state, name)
        if error and _error_of_force(system, _displaced(system, state), name):
            errors.append(error)
    if errors:
        raise SceneError(system.scene.source, errors)


def _displaced(system: System, state: State) -> State:
    """A state with centres of mass displaced at random."""
    moved = state.copy()
    rng = np.random.default_rng(0)
    moved.position[:] += (
        DISPLACED * system.smallest_diameter * rng.uniform(-1, 1, state.position.shape)
    )
    return moved


def velocity_notes(system: System, state: State) -> list[str]:
    """A note on each user-defined force that depends on the velocities: with other ones at the same
    positions it differs, by more than where nothing changes."""
    rng = np.random.default_rng(0)
    other = state.copy()
    speed = np.abs(state.velocity).max(initial=0.0) or 1.0
    spin = np.abs(state.angular_momentum_body).max(initial=0.0) or 1.0
    other.velocity[:] += speed * rng.standard_normal(other.velocity.shape)
    other.angular_momentum_body[:] += spin * rng.standard_normal(other.angular_momentum_body.shape)
    notes = []
    for name in system.user_terms:
        if isinstance(system.terms[name], PairForces):
            continue
        engine = system.engine_of({name: system.terms[name]}, "double")
        (load, _), (again, _), (moved, _) = (engine.evaluate(at) for at in (state, state, other))
        noise = [np.abs(a - b).max(initial=0.0) for a, b in zip(again, load, strict=True)]
        change = [np.abs(a - b).max(initial=0.0) for a, b in zip(moved, load, strict=True)]
        size = [
            np.abs(a).max(initial=0.0) + np.abs(b).max(initial=0.0)
            for a, b in zip(moved, load, strict=True)
        ]
        if any(c > NOISY * n + ROUNDING * s for c, n, s in zip(change, noise, size, strict=True)):
            notes.append(
                f"{name}: its forces depend on velocities. Integrators take them as forces of"
                " positions, with an error of order 1 in the step, and such forces have no energy"
                " that is conserved. For friction use thermostat = 'langevin'. Otherwise test with"
                " shorter steps"
            )
    return notes


def _error_of_force(system: System, state: State, name: str) -> str:
    engine = system.engine_of({name: system.terms[name]}, "double")
    load, tallies = engine.evaluate(state)
    tally = tallies[name]
    if not np.isfinite(tally.energy):
        return f"{name}: its energy at the start is {tally.energy}"
    if unresisted := _unresisted_torque(system, load):
        return f"{name}: {unresisted}"
    noise = ROUNDING * max(abs(tally.energy), np.abs(load.force).sum() * system.smallest_diameter)
    random = KJ_PER_MOL * getattr(
        getattr(system.python_forces.get(name), "force", None), "energy_noise", 0.0
    )

    def difference(
        moved: Callable[[float], State], steps: Sequence[float], derivative: float, size: float
    ) -> float | None:
        slopes = []
        for step in [NOISY * steps[0]] if random else steps:
            ahead, behind = (engine.evaluate(moved(way))[1][name].energy for way in (step, -step))
            slopes.append((behind - ahead) / (2 * step))
            if (
                abs(slopes[-1] - derivative)
                <= TOLERANCE * max(size, abs(slopes[-1])) + (noise + random) / step
            ):
                return None
        return slopes[0]

    wrong = _check_molecules(system, state, load, difference)
    if not wrong and state.volume < inf and name not in system.position_dependent:
        wrong = _check_virial(
            state, tally.virial, max(float(np.abs(tally.virial).sum()), noise), difference
        )
    if wrong and name in system.python_forces and not random:
        wrong += (
            ". If its energies have random errors, as in single precision, give their size:"
            " energy_noise"
        )
    return f"{name}: {wrong}" if wrong else ""


def _unresisted_torque(system: System, load: Load) -> str:
    """The largest torque about an axis without inertia. Empty without one, up to that of sites that
    are off the axis by OFF_AXIS."""
    if not len(load.torque_body):
        return ""
    without = (system.model.inertia == 0)[system.model.species] & mobile(system.model)[:, None]
    size = np.linalg.norm(np.where(without, load.torque_body, 0.0), axis=1)
    largest = np.abs(load.torque_body).max() + system.smallest_diameter * np.abs(load.force).max()
    m = int(size.argmax())
    if size[m] <= OFF_AXIS * largest:
        return ""
    species = system.species[system.model.species[m]]
    return (
        f"nothing resists its torque of {size[m] / KJ_PER_MOL:.3g} kJ/mol on molecule {m + 1}"
        f" ({species.name}), {'a point' if species.kind == 'point' else 'about its axis'}. Leave"
        " out torques about axes without inertia"
    )


def _check_molecules(system: System, state: State, load: Load, difference: _Difference) -> str:
    """The error of a force or torque, on the molecules with the two largest and a median one. Empty
    without one."""
    rng = np.random.default_rng(0)
    species = [system.species[k] for k in system.model.species]
    for kind, acting, unit in (
        ("force", load.force, "kJ/mol/Å"),
        ("torque", load.torque_body, "kJ/mol"),
    ):
        size = np.linalg.norm(acting, axis=1)
        ranked = np.argsort(size, kind="stable")
        for m in dict.fromkeys(
            ranked[[-1, -min(2, len(ranked)), len(ranked) // 2]].tolist() if len(ranked) else ()
        ):
            if kind == "torque" and not species[m].radius:
                continue
            along = rng.standard_normal(3) + (acting[m] / size[m] if size[m] else 0.0)
            if kind == "torque":
                along *= species[m].inertia > 0
            if not along.any():
                continue
            along /= np.linalg.norm(along)
            derivative = float(acting[m] @ along)
            steps = [
                fraction * (system.smallest_diameter if kind == "force" else 1.0)
                for fraction in STEP_FRACTIONS
            ]
            slope = difference(
                partial(_moved, state, kind, m, along), steps, derivative, size.max()
            )
            if slope is not None:
                where = "the lab's axes" if kind == "force" else "the axes of its body"
                return (
                    f"the {kind} on molecule {m + 1} ({species[m].name}) is not the derivative of"
                    f" the energy: along ({', '.join(f'{x:.3f}' for x in along)}) in {where} it is"
                    f" {derivative / KJ_PER_MOL:.8g} {unit}, and the energy falls by"
                    f" {slope / KJ_PER_MOL:.8g} {unit}"
                )
    return ""


def _moved(state: State, kind: str, m: int, along: np.ndarray, by: float) -> State:
    """A copy of a state with a molecule moved (Å, lab) or rotated (rad, body axes)."""
    moved = state.copy()
    if kind == "force":
        moved.position[m] += by * along
    else:
        moved.rotation[m] = moved.rotation[m] @ from_vector(by * along)
    return moved


def _check_virial(state: State, virial: np.ndarray, size: float, difference: _Difference) -> str:
    """The error of the virial in a box. Empty without one."""
    for i, j in COMPONENTS:

        def strained(by: float, i=i, j=j) -> State:
            """A copy of the state with centres of mass and cell strained, x_j += by x_i (lab)."""
            strained_state = state.copy()
            for array in (strained_state.position, strained_state.cell):
                array[:, j] += by * array[:, i]
            return strained_state

        derivative = float(virial[j, i])
        slope = difference(strained, STRAINS, derivative, size)
        if slope is not None:
            return (
                f"the component {'xyz'[j]}{'xyz'[i]} of its molecular virial is"
                f" {derivative / KJ_PER_MOL:.8g} kJ/mol, and when box and centres of mass are"
                f" strained the energy falls by {slope / KJ_PER_MOL:.8g} kJ/mol:"
                f" {'correct it' if virial.any() else 'add it'}, or, if the energy depends on"
                " positions in the lab, set absolute_positions = True in its class"
            )
    return ""
