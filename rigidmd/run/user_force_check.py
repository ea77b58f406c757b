"""Check of user-defined forces: they are compared with differences of the energy, for a few molecules and the box."""

from collections.abc import Callable
from functools import partial
from math import inf
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.core.state import Load, State
from rigidmd.engines.protocol import Engine
from rigidmd.errors import SceneError
from rigidmd.mechanics.rotation import from_vector
from rigidmd.units import KJ_PER_MOL

if TYPE_CHECKING:
    from rigidmd.engines.system import System

#: Displacements of molecules, in smallest diameters. A force is right if it agrees for one of them, as a pair that
#: crosses a cutoff at which the energy jumps spoils a difference.
STEP_FRACTIONS = (1e-4, 1e-5)
#: Allowed error of a difference, as a fraction of the largest force, torque or virial of the term.
TOLERANCE = 1e-4
#: Components of a strain that keep a cell lower triangular: the six of a box.
COMPONENTS = ((0, 0), (1, 1), (2, 2), (1, 0), (2, 0), (2, 1))
#: Rounding error of an energy, as a fraction of its size.
ROUNDING = 1e-13


def check_forces(system: "System", state: State) -> None:
    """Compare user-defined forces with their energies. Raises SceneError with the numbers where they differ."""
    errors = []
    for name in system.user_terms:
        engine = system.engine_of({name: system.terms[name]}, "double")
        energy = partial(_energy, engine, name)
        load, tallies = engine.evaluate(state)
        tally = tallies[name]
        if not np.isfinite(tally.energy):
            errors.append(f"{name}: its energy at the start is {tally.energy}")
            continue
        noise = ROUNDING * max(abs(tally.energy), np.abs(load.force).sum() * system.smallest_diameter)
        found = _check_molecules(system, state, name, load, energy, noise)
        found = found or _check_virial(system, state, name, tally.virial, energy, noise)
        errors += [found] if found else []
    if errors:
        raise SceneError(system.scene.source, errors)


def _energy(engine: Engine, name: str, state: State) -> float:
    return engine.evaluate(state)[1][name].energy


def _check_molecules(
    system: "System", state: State, name: str, load: Load, energy: Callable[[State], float], noise: float
) -> str:
    """The error of a force or torque, on the molecules with the two largest and a median one; empty without one."""
    rng = np.random.default_rng(0)
    for kind, acting, unit in (("force", load.force, "kJ/mol/Å"), ("torque", load.torque_body, "kJ/mol")):
        size = np.linalg.norm(acting, axis=1)
        if not len(size):
            continue
        ranked = np.argsort(size, kind="stable")
        radii = np.array([m.radius for m in system.species])[system.model.species]
        for m in dict.fromkeys(ranked[[-1, -min(2, len(ranked)), len(ranked) // 2]].tolist()):
            if kind == "torque" and not radii[m]:
                continue
            along = rng.standard_normal(3) + (acting[m] / size[m] if size[m] else 0.0)
            if kind == "torque":
                along *= system.model.inertia[system.model.species[m]] > 0
            if not along.any():
                continue
            along /= np.linalg.norm(along)
            given, measured = float(acting[m] @ along), []
            for fraction in STEP_FRACTIONS:
                step = fraction * (system.smallest_diameter if kind == "force" else 1.0)
                sides = [energy(_moved(state, kind, m, sign * step * along)) for sign in (1, -1)]
                measured.append((sides[1] - sides[0]) / (2 * step))
                if abs(measured[-1] - given) <= TOLERANCE * size.max() + noise / step:
                    break
            else:
                where = "the lab's axes" if kind == "force" else "the axes of its body"
                return (
                    f"{name}: the {kind} on molecule {m + 1} ({system.species[system.model.species[m]].name}) is not "
                    f"the derivative of the energy: along ({', '.join(f'{x:.3f}' for x in along)}) in {where} it is "
                    f"{given / KJ_PER_MOL:.8g} {unit}, and the energy falls by {measured[0] / KJ_PER_MOL:.8g} {unit}"
                )
    return ""


def _moved(state: State, kind: str, m: int, by: np.ndarray) -> State:
    """A copy of a state with a molecule moved (Å, lab) or rotated (rad, body axes)."""
    moved = state.copy()
    if kind == "force":
        moved.position[m] += by
    else:
        moved.rotation[m] = moved.rotation[m] @ from_vector(by)
    return moved


def _check_virial(
    system: "System", state: State, name: str, virial: np.ndarray, energy: Callable[[State], float], noise: float
) -> str:
    """The error of the virial, if there is a box that can be strained; empty if there is none."""
    if state.volume == inf or name in system.position_dependent:
        return ""
    size = max(float(np.abs(virial).sum()), noise)
    for i, j in COMPONENTS:
        given, measured = float(virial[j, i]), []
        for step in (1e-5, 1e-6, 1e-7):
            ends = [energy(_strained(state, i, j, sign * step)) for sign in (1, -1)]
            measured.append((ends[1] - ends[0]) / (2 * step))
            if abs(measured[-1] - given) <= TOLERANCE * max(size, abs(measured[-1])) + noise / step:
                break
        else:
            break
    else:
        return ""
    axes = f"{'xyz'[j]}{'xyz'[i]}"
    advice = "add it" if not virial.any() else "correct it"
    return (
        f"{name}: the component {axes} of its molecular virial is {given / KJ_PER_MOL:.8g} kJ/mol, and when box and "
        f"centres of mass are strained the energy falls by {measured[0] / KJ_PER_MOL:.8g} kJ/mol: {advice}, or, if the "
        "energy depends on positions in the lab, set tied_to_places = True in its class"
    )


def _strained(state: State, i: int, j: int, by: float) -> State:
    """A copy of a state with centres of mass and cell strained, x_j += by x_i (lab)."""
    strained = state.copy()
    for array in (strained.position, strained.cell):
        array[:, j] += by * array[:, i]
    return strained
