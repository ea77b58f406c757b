"""The summary of a run of a single body: one dictionary with units in its keys."""

import numpy as np

from rigidmd.engines.body_motion import Motion
from rigidmd.engines.body_system import BodySystem

#: Larger errors are noted: the motion is then wrong.
LARGE_ENERGY_ERROR = 1e-3


def summarise_body(
    system: BodySystem, motion: Motion, planned: int, preparing: float, wall: float, computing: float, interrupted: bool
) -> dict:
    """The summary of a run but for what it was computed with; times in s: preparing (compiling), wall (with output),
    computing (steps).
    """
    run = system.scene.run
    end = float(motion["time"][-1])
    steps = round(end / run.timestep_s) if interrupted else planned
    return {
        "interrupted": interrupted,
        "kind": system.kind,
        "pinned": not system.translates,
        "degrees_of_freedom": system.degrees_of_freedom,
        "mass_kg": system.mass,
        "inertia_kg_m2": system.inertia.tolist(),
        "integrator": run.integrator,
        "formulation": getattr(system.method, "formulation", None),
        "timestep_s": run.timestep_s,
        "steps": steps,
        "duration_s": end,
        "samples": len(motion["time"]),
        "preparing_s": preparing,
        "wall_s": wall,
        "computing_s": computing,
        "steps_per_s": steps / computing if computing > 0 else None,
        "energy_start_J": float(motion["energy"][0]),
        "energy_end_J": float(motion["energy"][-1]),
        "work_J": float(motion["work"][-1]),
        "largest_relative_error": {name: float(np.abs(motion[f"{name}_error"]).max()) for name in motion.invariants},
        "largest_orthogonality_error": float(motion["orthogonality_error"].max()) if system.rotates else None,
        "theta_range_deg": np.degrees([motion["theta"].min(), motion["theta"].max()]).tolist()
        if system.rotates
        else None,
        "trajectory_A_per_m": system.scale,
        "notes": _notes(system, motion, interrupted),
    }


def _notes(system: BodySystem, motion: Motion, interrupted: bool) -> list[str]:
    """Warnings about the results."""
    notes = system.notes
    if "energy" in motion.invariants and (error := np.abs(motion["energy_error"]).max()) > LARGE_ENERGY_ERROR:
        notes.append(
            f"the energy is wrong by {error:.1e} of the largest kinetic energy: timestep_s is too long for this motion"
        )
    if system.rotates:
        speed = np.sqrt(sum(motion[f"omega_body_{k}"] ** 2 for k in (1, 2, 3)))
        if (speed[1:] * np.diff(motion["time"])).max(initial=0.0) > np.pi:
            notes.append(
                "the body turns by more than 180° between samples; shorten output.interval_s to follow its angles"
            )
    return notes
