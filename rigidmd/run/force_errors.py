"""Errors of the forces of a scene: of Ewald sums, estimated and measured; of single precision
between pairs."""

from typing import TYPE_CHECKING, Protocol, cast

import numpy as np

from rigidmd.assemble.build import build
from rigidmd.core.state import State
from rigidmd.core.toml import Json
from rigidmd.dynamics.model import mobile
from rigidmd.engines.system import System
from rigidmd.errors import SceneError
from rigidmd.forces.ewald.direct_sum import EwaldSum
from rigidmd.forces.ewald.errors import (
    charges_in,
    filled_fraction,
    left_out_error,
    pme_error,
)
from rigidmd.forces.ewald.smooth import InverseR, Smooth
from rigidmd.forces.neighbors.pair_loop import PairForces
from rigidmd.forces.neighbors.sites import compute_site_positions
from rigidmd.forces.neighbors.space import fractions, space_of
from rigidmd.forces.potentials.screened_coulomb import ScreenedCoulomb
from rigidmd.scene.validation import not_none
from rigidmd.units import COULOMB

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
    real = charges.beyond(term.smooth.alpha, cutoff, volume)
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
