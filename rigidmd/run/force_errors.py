"""Errors of the forces of a scene: of Ewald sums, estimated and measured, and of single precision between pairs."""

from math import pi, sqrt
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np
from scipy.special import erf

from rigidmd.assemble.build import build
from rigidmd.core.state import State
from rigidmd.dynamics.momenta import mobile
from rigidmd.engines.system import System
from rigidmd.errors import SceneError
from rigidmd.forces.ewald.direct_sum import EwaldSum
from rigidmd.forces.ewald.errors import charges_of, k_cutoff_of_count, k_space_error, pme_error, real_error
from rigidmd.forces.neighbors.pair_loop import PairForces
from rigidmd.forces.neighbors.sites import compute_site_positions
from rigidmd.forces.potentials.screened_coulomb import ScreenedCoulomb
from rigidmd.units import COULOMB

if TYPE_CHECKING:
    from rigidmd.forces.ewald.pme import Pme  # needs rocket-fft, which is for scenes with PME

#: Error of the reference sum, relative to the estimated error of the sum under test.
REFERENCE_ERROR = 1e-3
MIN_REFERENCE_ERROR = 1e-12  # e²/Å²; float64 has no more digits


class CoulombErrors(NamedTuple):
    """Errors of the Coulomb forces on sites, u Å/ps², and of the Coulomb energy."""

    estimated: float  # rms
    measured: float  # rms
    largest: float
    force: float  # rms of the forces themselves
    energy: float  # u Å²/ps²
    reference: str  # the sum compared with

    @property
    def relative(self) -> float:
        return self.measured / self.force


def coulomb_errors(system: System, state: State) -> CoulombErrors:
    """Errors of a system's Ewald sums at a state. Raises SceneError if it has none."""
    scene = system.scene
    if system.force_error is None:
        method = scene.forces.electrostatics
        raise SceneError(
            scene.source, [f"--accuracy needs Ewald sums; forces.electrostatics is {method!r}, or no site has a charge"]
        )
    forces = scene.forces.model_copy(
        update={
            "electrostatics": "ewald",
            "ewald_accuracy": max(REFERENCE_ERROR * system.force_error / COULOMB, MIN_REFERENCE_ERROR),
            **dict.fromkeys(("ewald_alpha_per_A", "ewald_k_max", "ewald_k2_max", "ewald_k_radius_per_A")),
            **dict.fromkeys(("pme_order", "pme_grid")),
        }
    )
    tight = scene.model_copy(update={"forces": forces, "precision": "double"})
    reference = build(tight)
    moves = mobile(system.model)[cast(PairForces, system.terms["coulomb_real"]).sites.molecule]
    found, energy = _coulomb(system, state)
    exact, exact_energy = _coulomb(reference, state)
    error = np.linalg.norm((found - exact)[moves], axis=1)
    return CoulombErrors(
        estimated=system.force_error, measured=float(np.sqrt((error**2).mean())), largest=float(error.max()),
        force=float(np.sqrt((exact[moves] ** 2).sum(axis=1).mean())), energy=energy - exact_energy,
        reference=next(note for note in reference.notes if note.startswith("ewald")),
    )  # fmt: skip


def estimated_error(system: System, cell: np.ndarray) -> float:
    """Estimated rms error of Coulomb forces in another cell (3, 3), u Å/ps², with the Ewald sums of a system."""
    term, volume = system.terms["coulomb_reciprocal"], abs(float(np.linalg.det(cell)))
    counts = np.bincount(system.model.species, minlength=len(system.species))
    charged = [m.charges != 0 for m in system.species]
    charges = charges_of(
        [(int(n), m.charges[c], m.positions_body[c]) for n, m, c in zip(counts, system.species, charged, strict=True)]
    )
    if isinstance(term, EwaldSum):
        reciprocal = k_space_error(charges, term.alpha, k_cutoff_of_count(term.k_vectors.total, volume), volume)
    else:
        term = cast("Pme", term)
        reciprocal = pme_error(charges, term.alpha, cell, term.grid, term.order)
    return float(np.hypot(real_error(charges, term.alpha, system.cutoff, volume), reciprocal)) * COULOMB


def single_precision_errors(system: System, state: State) -> tuple[float, float] | None:
    """Relative rms errors of forces and torques with `precision = "mixed"`; None in double precision."""
    scene = system.scene
    if scene.precision == "double":
        return None
    exact = system.engine_of(system.terms, "double").evaluate(state)[0]
    found = system.engine().evaluate(state)[0]
    errors = []
    for a, b in zip(found, exact, strict=True):
        size = float(np.linalg.norm(b))
        errors.append(float(np.linalg.norm(a - b)) / size if size > 0 else 0.0)
    return errors[0], errors[1]


def _coulomb(system: System, state: State) -> tuple[np.ndarray, float]:
    """Coulomb forces on charged sites (s, 3) without pairs inside molecules, and the Coulomb energy."""
    charged = {name: term for name, term in system.terms.items() if name.startswith("coulomb")}
    engine = system.engine_of(charged, system.scene.precision)
    _, tallies = engine.evaluate(state)
    real, force = cast(PairForces, system.terms["coulomb_real"]), np.zeros((system.site_count, 3))
    for name in ("coulomb_real", "coulomb_reciprocal"):
        force = force + cast(Any, engine.workspaces[name]).site_force
    position = np.empty_like(force)
    compute_site_positions(real.sites, state, position)
    law = cast(ScreenedCoulomb, real.potential)
    force = force + forces_inside(law.charge, position, real.sites.first, law.alpha)
    constants = sum(energy for name, energy in system.constants.items() if name.startswith("coulomb"))
    return force, sum(tally.energy for tally in tallies.values()) + constants


def forces_inside(charge: np.ndarray, position: np.ndarray, first: np.ndarray, alpha: float) -> np.ndarray:
    """Forces (s, 3) that cancel the forces of the reciprocal part between sites of one molecule."""
    force = np.zeros_like(position)
    count = np.diff(first)
    for gap in range(1, count.max(initial=1)):
        i = np.concatenate([np.arange(a, a + n - gap) for a, n in zip(first[:-1], count, strict=True) if n > gap])
        d = position[i] - position[i + gap]
        r = np.linalg.norm(d, axis=1)
        slope = erf(alpha * r) / r**3 - 2 * alpha / sqrt(pi) * np.exp(-((alpha * r) ** 2)) / r**2
        pull = (charge[i] * charge[i + gap] * slope)[:, None] * d
        np.subtract.at(force, i, pull)
        np.add.at(force, i + gap, pull)
    return force
