"""The figures a run of a single body is judged by, as one dictionary with units in its keys."""

import platform
from importlib.metadata import version

import numba
import numpy as np

from rigidmd.build.body import BodySystem
from rigidmd.measure.motion import Motion


def summarise_body(
    system: BodySystem, motion: Motion, preparing: float, wall: float, computing: float, interrupted: bool
) -> dict:
    """The summary of a run; times in s: preparing (compiling), wall (with output), computing (steps)."""
    run = system.scene.run
    end = float(motion["t"][-1])
    steps = round(end / run.timestep_s)
    return {
        "scene": system.scene.name,
        "rigidmd_version": version("rigidmd"),
        "numba_version": numba.__version__,
        "machine": platform.processor() or platform.machine(),
        "interrupted": interrupted,
        "kind": system.kind,
        "pinned": not system.flies,
        "degrees_of_freedom": system.degrees_of_freedom,
        "mass_kg": system.mass,
        "inertia_kg_m2": system.inertia.tolist(),
        "integrator": run.integrator,
        "formulation": getattr(system.method, "formulation", None),
        "timestep_s": run.timestep_s,
        "steps": steps,
        "duration_s": end,
        "samples": len(motion["t"]),
        "preparing_s": preparing,
        "wall_s": wall,
        "computing_s": computing,
        "steps_per_s": steps / computing if computing > 0 else None,
        "energy_start_J": float(motion["energy"][0]),
        "energy_end_J": float(motion["energy"][-1]),
        "work_J": float(motion["work"][-1]),
        "largest_relative_error": {name: float(np.abs(motion[f"{name}_error"]).max()) for name in motion.invariants},
        "largest_orthogonality_error": float(motion["orthogonality_error"].max()) if system.turns else None,
        "theta_range_deg": np.degrees([motion["theta"].min(), motion["theta"].max()]).tolist()
        if system.turns
        else None,
        "trajectory_A_per_m": system.scale,
    }
