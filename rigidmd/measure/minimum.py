"""Where a minimisation ended: its figures for the summary, and in words."""

from typing import Any, NamedTuple

import numpy as np

from rigidmd.scene.stage import Stage
from rigidmd.units import BAR, KJ_PER_MOL


class Minimum(NamedTuple):
    """Where a minimisation ended, in u, Å, ps."""

    converged: bool
    why: str  # it ended, where it has not converged
    iterations: int
    relief_steps: int  # of steepest descent before, which move apart what overlaps
    before: float  # potential energy
    after: float
    force: float  # largest on a molecule that moves
    torque: float  # largest about a principal axis
    pressure: np.ndarray  # (6,) by `boxes.COMPONENTS`, without that of motion; NaN without a box
    deviation: float | None  # largest of the pressure from the one asked for; None where the cell is kept


def minimum_figures(found: Minimum, molecules: int) -> dict[str, Any]:
    """Its figures with units in their keys. The pressure is that of forces alone; None where there is none."""
    pressure = found.pressure / BAR
    boxed = bool(np.isfinite(pressure).all())
    return {
        "converged": found.converged,
        "ended_by": found.why or None,
        "iterations": found.iterations,
        "relief_steps": found.relief_steps,
        "energy_before_kJ_mol_per_molecule": found.before / KJ_PER_MOL / molecules,
        "energy_after_kJ_mol_per_molecule": found.after / KJ_PER_MOL / molecules,
        "largest_force_kJ_mol_A": found.force / KJ_PER_MOL,
        "largest_torque_kJ_mol": found.torque / KJ_PER_MOL,
        "pressure_bar": float(pressure[:3].mean()) if boxed else None,
        "pressure_tensor_bar": pressure.tolist() if boxed else None,
        "largest_pressure_deviation_bar": None if found.deviation is None else found.deviation / BAR,
    }


def minimum_in_words(found: Minimum, stage: Stage) -> str:
    """How far a minimisation that has not converged has come."""
    parts = [
        ("force", found.force / KJ_PER_MOL, stage.force_limit_kJ_mol_A, "kJ/(mol Å)"),
        ("torque", found.torque / KJ_PER_MOL, stage.torque_limit_kJ_mol, "kJ/mol"),
    ]
    if found.deviation is not None:
        parts.append(("deviation of the pressure", found.deviation / BAR, stage.pressure_limit_bar, "bar"))
    reached = ", ".join(f"{what} {value:.3g} (limit {limit:g}) {unit}" for what, value, limit, unit in parts)
    ended = f"the minimisation ended after {found.iterations} iterations before it converged ({found.why})"
    return f"{ended}; largest {reached}"
