"""The summary of a run of a single body: one dictionary with units in its keys, and its notes."""

from collections.abc import Iterable, Mapping

import numpy as np

from rigidmd.features.bodies.motion import Motion
from rigidmd.features.bodies.rates import body_rates
from rigidmd.features.bodies.system import BodySystem

#: Larger relative errors of the energy of a body have a note: the motion is then wrong.
LARGE_ENERGY_ERROR = 1e-3


def summarise_body(
    system: BodySystem,
    motion: Motion,
    planned: int,
    preparing: float,
    wall: float,
    computing: float,
    *,
    interrupted: bool,
) -> dict:
    """The summary of a run of a single body, without its `provenance`. planned : steps of a run
    that ends in time"""
    run = system.scene.run
    end = float(motion["time"][-1])
    steps = round(end / run.timestep_s) if interrupted else planned
    notes = system.notes
    if (
        "energy" in motion.invariants
        and (error := np.abs(motion["energy_error"]).max()) > LARGE_ENERGY_ERROR
    ):
        wrong = f"the energy is wrong by {error:.1e} of the largest kinetic energy"
        notes.append(f"{wrong}: timestep_s is too long for this motion")
    if system.rotates:
        speed = np.sqrt(sum(motion[f"omega_body_{k}"] ** 2 for k in (1, 2, 3)))
        if (speed[1:] * np.diff(motion["time"])).max(initial=0.0) > np.pi:
            notes.append(
                "the body rotates by more than 180° between samples. Shorten output.interval_s to"
                " follow its angles"
            )
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
        "samples": len(motion),
        "preparing_s": preparing,
        "wall_s": wall,
        "computing_s": computing,
        "steps_per_s": steps / computing if computing > 0 else None,
        **motion_figures(motion.columns, motion.invariants),
        "rates": {name: rate._asdict() for name, rate in body_rates(system, motion).items()},
        "trajectory_A_per_m": system.scale,
        "notes": notes,
    }


def motion_figures(columns: Mapping[str, np.ndarray], invariants: Iterable[str]) -> dict:
    """The part of a body's summary that follows from the columns of its motion."""
    theta, orthogonality = columns.get("theta"), columns.get("orthogonality_error")
    return {
        "energy_start_J": float(columns["energy"][0]),
        "energy_end_J": float(columns["energy"][-1]),
        "work_J": float(columns["work"][-1]),
        "largest_relative_error": {
            name: float(np.abs(columns[f"{name}_error"]).max()) for name in invariants
        },
        "largest_orthogonality_error": (
            None if orthogonality is None else float(orthogonality.max())
        ),
        "theta_range_deg": (
            None if theta is None else np.degrees([theta.min(), theta.max()]).tolist()
        ),
    }
