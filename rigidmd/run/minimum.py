"""The result of a minimisation: its figures for the summary, and in words."""

from typing import Any, NamedTuple

import numpy as np

from rigidmd.scene.stage import Stage
from rigidmd.units import BAR, KJ_PER_MOL


class Minimum(NamedTuple):
    """The result of a minimisation; u, Å, ps."""

    converged: bool
    why: str  # reason for its end if it has not converged, else empty
    iterations: int
    relief_steps: int  # of steepest descent, before the iterations
    before: float  # potential energy at the start
    after: float  # at the end
    force: float  # largest force on a molecule that is not frozen
    torque: float  # largest torque about a principal axis
    pressure: tuple[float, ...] | None  # six, by `boxes.COMPONENTS`, without the kinetic part; None without a box
    deviation: float | None  # largest deviation from the pressure asked for; None if the cell does not relax


def minimum_figures(found: Minimum, molecules: int) -> dict[str, Any]:
    """The figures of a minimum with units in their keys. Pressures are without the kinetic part; None without a box."""
    pressure = None if found.pressure is None else np.array(found.pressure) / BAR
    return {
        "converged": found.converged,
        "ended_by": found.why or None,
        "iterations": found.iterations,
        "relief_steps": found.relief_steps,
        "energy_before_kJ_mol_per_molecule": found.before / KJ_PER_MOL / molecules,
        "energy_after_kJ_mol_per_molecule": found.after / KJ_PER_MOL / molecules,
        "largest_force_kJ_mol_A": found.force / KJ_PER_MOL,
        "largest_torque_kJ_mol": found.torque / KJ_PER_MOL,
        "pressure_bar": float(pressure[:3].mean()) if pressure is not None else None,
        "pressure_tensor_bar": pressure.tolist() if pressure is not None else None,
        "largest_pressure_deviation_bar": None if found.deviation is None else found.deviation / BAR,
    }


def minimum_in_words(found: Minimum, stage: Stage) -> str:
    """A warning for a minimisation that has not converged: what it has reached."""
    parts = [
        ("force", found.force / KJ_PER_MOL, stage.force_limit_kJ_mol_A, "kJ/(mol Å)"),
        ("torque", found.torque / KJ_PER_MOL, stage.torque_limit_kJ_mol, "kJ/mol"),
    ]
    if found.deviation is not None:
        parts.append(("deviation of the pressure", found.deviation / BAR, stage.pressure_limit_bar, "bar"))
    reached = ", ".join(f"{what} {value:.3g} (limit {limit:g}) {unit}" for what, value, limit, unit in parts)
    return f"the minimisation has not converged after {found.iterations} iterations ({found.why}): largest {reached}"
