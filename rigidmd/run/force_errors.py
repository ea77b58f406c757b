"""Errors of the forces of a scene: of Ewald sums, estimated and measured; of single precision
between pairs; of user-defined forces, which are compared with their energies."""

from collections.abc import Callable, Sequence
from functools import partial
from math import inf
from typing import TYPE_CHECKING, Protocol, cast

import numpy as np

from rigidmd.assemble.build import build
from rigidmd.core.state import Load, State
from rigidmd.core.toml import Json
from rigidmd.dynamics.barostats import COMPONENTS
from rigidmd.dynamics.model import mobile
from rigidmd.engines.system import System
from rigidmd.errors import SceneError
from rigidmd.forces.ewald.direct_sum import EwaldSum
from rigidmd.forces.ewald.errors import (
    charges_in,
    filled_fraction,
    left_out_error,
    pme_error,
    real_error,
)
from rigidmd.forces.ewald.smooth import InverseR, Smooth
from rigidmd.forces.neighbors.pair_loop import PairForces
from rigidmd.forces.neighbors.sites import compute_site_positions
from rigidmd.forces.neighbors.space import fractions, space_of
from rigidmd.forces.potentials.screened_coulomb import ScreenedCoulomb
from rigidmd.mechanics.rotation import from_vector
from rigidmd.scene.models import OFF_AXIS
from rigidmd.scene.validation import not_none
from rigidmd.units import COULOMB, KJ_PER_MOL

if TYPE_CHECKING:
    from rigidmd.forces.ewald.pme import Pme  # needs rocket-fft, which is for scenes with PME


#: Error of the reference sum, relative to the estimated error of the sum under test.
REFERENCE_ERROR = 1e-3
MIN_REFERENCE_ERROR = 1e-12  # e²/Å²; float64 has no more digits


class HasSiteForces(Protocol):
    """The workspace of a force between sites."""

    @property
    def site_force(self) -> np.ndarray: ...  # (s, 3)


def coulomb_errors(system: System, state: State, size: float = 1.0) -> Json:
    """Errors of a system's Ewald sums at a state, of forces on sites and of the energy, compared
    with a more accurate sum: the entry `accuracy` of `rigidmd energy`, with energies in a unit of
    `size` u Å²/ps². Raises SceneError if it has no Ewald sums."""
    scene = system.scene
    if reason := _reason_without_errors(system):
        raise SceneError(scene.source, [f"--accuracy measures errors of Ewald sums: {reason}"])
    estimated = not_none(system.force_error)
    accuracy = max(REFERENCE_ERROR * estimated / COULOMB, MIN_REFERENCE_ERROR)
    settings = (
        "ewald_alpha_per_A",
        "ewald_k_max",
        "ewald_k2_max",
        "ewald_k_radius_per_A",
        "pme_order",
        "pme_grid",
    )
    changes = dict.fromkeys(settings) | {"electrostatics": "ewald", "ewald_accuracy": accuracy}
    forces = scene.forces.model_copy(update=changes)
    try:
        reference = build(scene.model_copy(update={"forces": forces, "precision": "double"}))
    except SceneError as error:
        problem = f"a direct sum good to {accuracy:.1g} e²/Å² is out of reach in this box"
        raise SceneError(scene.source, [f"--accuracy: {problem}"]) from error
    moves = _charged_sites_that_move(system)
    coulomb, energy = _coulomb(system, state)
    exact, exact_energy = _coulomb(reference, state)
    error = np.linalg.norm((coulomb - exact)[moves], axis=1)
    measured = float(np.sqrt((error**2).mean()))
    force = float(np.sqrt((exact[moves] ** 2).sum(axis=1).mean()))
    return {
        "reference": next(note for note in reference.notes if note.startswith("ewald")),
        "rms_force_per_A": force / size,
        "rms_error_per_A": measured / size,
        "relative": measured / force if force else None,  # one ion feels no force
        "in_e2_per_A2": measured / COULOMB,
        "estimated_per_A": estimated / size,
        "largest_error_per_A": float(error.max()) / size,
        "energy_error": (energy - exact_energy) / size,
    }


def _reason_without_errors(system: System) -> str:
    """Why the errors of Ewald sums cannot be measured. Empty if they can."""
    method = system.scene.forces.electrostatics
    if method not in ("ewald", "pme"):
        return f"forces.electrostatics is {method!r}"
    if system.force_error is None:
        return "no site has a charge"
    if not _charged_sites_that_move(system).any():
        return "all molecules with charges are frozen"
    return ""


def _charged_sites_that_move(system: System) -> np.ndarray:
    """Whether the molecule of each charged site (s,) moves."""
    return mobile(system.model)[cast(PairForces, system.terms["coulomb_real"]).sites.molecule]


def estimated_error(system: System, cell: np.ndarray) -> float:
    """Estimated rms error of Coulomb forces in another cell (3, 3), u Å/ps², with the Ewald sums of
    a system."""
    term = system.terms["coulomb_reciprocal"]
    volume = abs(float(np.linalg.det(cell)))
    counts = np.bincount(system.model.species, minlength=len(system.species))
    charges = charges_in(system.species, counts)
    cutoff = not_none(system.scene.forces.ewald_cutoff_A)
    if isinstance(term, EwaldSum):
        reciprocal = left_out_error(charges, term.smooth.alpha, term.k_vectors, cell)
    else:
        term = cast("Pme", term)
        reciprocal = pme_error(charges, term.smooth.alpha, cell, term.grid, term.order)
    position = fractions(system.space, system.state.position) @ cell
    filled = filled_fraction(system.species, counts, space_of(cell), position)
    real = real_error(charges, term.smooth.alpha, cutoff, volume)
    return float(np.hypot(real, reciprocal)) / np.sqrt(filled) * COULOMB


def single_precision_errors(system: System, state: State) -> tuple[float, float] | None:
    """Relative rms errors of forces and torques with `precision = "mixed"`. None for a scene with
    "double"."""
    if system.precision == "double" and not system.precision_reason:
        return None
    exact = system.engine_of(system.terms, "double").evaluate(state)[0]
    mixed = system.engine_of(system.terms, "mixed").evaluate(state)[0]
    sizes = [
        (float(np.linalg.norm(a - b)), float(np.linalg.norm(b)))
        for a, b in zip(mixed, exact, strict=True)
    ]
    force, torque = (error / size if size > 0 else 0.0 for error, size in sizes)
    return force, torque


def _coulomb(system: System, state: State) -> tuple[np.ndarray, float]:
    """Coulomb forces on charged sites (s, 3) without pairs inside molecules, and the Coulomb
    energy."""
    charged = {name: term for name, term in system.terms.items() if name.startswith("coulomb")}
    engine = system.engine_of(charged, system.precision)
    _, tallies = engine.evaluate(state)
    real = cast(PairForces, system.terms["coulomb_real"])
    position = np.empty((len(real.sites.molecule), 3))
    compute_site_positions(real.sites, state, position)
    potential = cast(ScreenedCoulomb, real.potential)
    force = forces_inside(potential.charge, position, real.sites.first, InverseR(potential.alpha))
    for name in ("coulomb_real", "coulomb_reciprocal"):
        force = force + cast(HasSiteForces, engine.workspaces[name]).site_force
    constants = sum(
        energy for name, energy in system.constants.items() if name.startswith("coulomb")
    )
    return force, sum(tally.energy for tally in tallies.values()) + constants


def forces_inside(
    charge: np.ndarray, position: np.ndarray, first: np.ndarray, smooth: Smooth
) -> np.ndarray:
    """Forces (s, 3) that cancel the forces of the reciprocal part between sites of one molecule."""
    force = np.zeros_like(position)
    count = np.diff(first)
    for gap in range(1, count.max(initial=1)):
        i = np.concatenate(
            [np.arange(a, a + n - gap) for a, n in zip(first[:-1], count, strict=True) if n > gap]
        )
        d = position[i] - position[i + gap]
        slope = smooth.force_over_r(np.linalg.norm(d, axis=1))
        pull = (charge[i] * charge[i + gap] * slope)[:, None] * d
        np.subtract.at(force, i, pull)
        np.add.at(force, i + gap, pull)
    return force


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
                " positions in the lab, set tied_to_places = True in its class"
            )
    return ""
