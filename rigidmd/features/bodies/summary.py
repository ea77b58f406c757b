"""The summary of a run of a single body: one dictionary with units in its keys, its notes, and as
text. The energies of the start as text."""

import math
from collections.abc import Container

import numpy as np

from rigidmd.core.toml import Json
from rigidmd.features.bodies.motion import Motion
from rigidmd.features.bodies.rates import body_rates
from rigidmd.features.bodies.system import BodySystem
from rigidmd.run.failed_check import LARGE_ENERGY_ERROR
from rigidmd.run.report import as_lines, last_lines, orthogonality, value_lines

#: Fraction of the run time below which the time of the steps is not a speed.
MOSTLY_OUTPUT = 0.5


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
        **motion_figures(system, motion),
        "trajectory_A_per_m": system.scale,
        "notes": notes,
    }


def motion_figures(system: BodySystem, motion: Motion) -> dict:
    """The part of a body's summary that follows from its motion."""
    columns = motion.columns
    theta, orthogonality = columns.get("theta"), columns.get("orthogonality_error")
    return {
        "energy_start_J": float(columns["energy"][0]),
        "energy_end_J": float(columns["energy"][-1]),
        "work_J": float(columns["work"][-1]),
        "largest_relative_error": {
            name: float(np.abs(columns[f"{name}_error"]).max()) for name in motion.invariants
        },
        "largest_orthogonality_error": (
            None if orthogonality is None else float(orthogonality.max())
        ),
        "theta_range_deg": (
            None if theta is None else np.degrees([theta.min(), theta.max()]).tolist()
        ),
        "rates": {name: rate._asdict() for name, rate in body_rates(system, motion).items()},
    }


def summary_text(summary: dict, known: Container[str] = ()) -> str:
    """The summary of a run of a single body as text, without the notes in `known`."""
    return "\n".join(
        [f"\n{title_of(summary)}", *as_lines(rows_of(summary)), *last_lines(summary, known)]
    )


def title_of(summary: dict) -> str:
    """Steps of a run of a single body, and its speed, or its run time if most of that is output."""
    title = f"{summary['steps']} steps of {summary['timestep_s']:g} s, {summary['duration_s']:g} s"
    if not summary["steps_per_s"]:
        return title
    running = summary["wall_s"] - summary["preparing_s"]
    if summary["computing_s"] < MOSTLY_OUTPUT * running:
        return f"{title}; run time {running:.2g} s, most of it output"
    return f"{title}; {summary['steps_per_s']:,.0f} steps/s"


#: Name of a rate of a body -> its name in reports, and how it is written with a number.
RATES = {
    "precession_rad_s": ("precession", "{} rad/s about the vertical"),
    "precession_about_L_rad_s": ("precession", "{} rad/s about L"),
    "nutation_period_s": ("nutation", "every {} s"),
    "spin_rad_s": ("spin", "{} rad/s about the axis of symmetry"),
    "omega_period_s": ("omega", "returns in the body every {} s"),
    "flip_interval_s": ("flips", "every {} s"),
}


def _rate(rate: dict, pattern: str) -> str:
    """A rate as measured and by theory."""
    measured, theory = rate["measured"], rate["theory"]
    if measured is None:
        theory = math.nan if theory is None else theory
        return (
            f"{pattern.format(f'{theory:.7g}')} in theory. Fewer than two periods in the samples,"
            " or too few samples"
        )
    return pattern.format(f"{measured:.7g}") + (
        "" if theory is None else f"; in theory {theory:.7g}"
    )


def rows_of(summary: dict) -> list[tuple[str, str]]:
    """Names and values in the summary of a single-body run."""
    rows = [
        (
            "energy",
            (
                f"{summary['energy_start_J']:.12g} J at the start, {summary['energy_end_J']:.12g} J"
                " at the end"
            ),
        )
    ]
    if summary["work_J"]:
        rows.append(("work", f"{summary['work_J']:.12g} J done on the body"))
    if summary["theta_range_deg"]:
        low, high = summary["theta_range_deg"]
        rows.append(("theta", f"between {low:.6f}° and {high:.6f}°"))
    rows += [
        (RATES[name][0], _rate(rate, RATES[name][1])) for name, rate in summary["rates"].items()
    ]
    for name, error in summary["largest_relative_error"].items():
        of = "the largest kinetic energy" if name == "energy" else "the largest |L|"
        size = f"at most {error:.1e} of {of}" if error else "exactly 0"
        rows.append((f"{name} error", size))
    if summary["largest_orthogonality_error"] is not None:
        rows.append(orthogonality(summary))
    return rows


def energy_lines(name: str, energies: Json) -> list[str]:
    """Energies of the start, of `BodyRun.start_energy`, as text."""
    rows = [(key, energies[key], "J") for key in ("kinetic", "potential", "energy")]
    lines = [f"{name}: energy of the start", *value_lines(rows, ">22.15g")]
    for key, what, unit in (
        ("force_N", "force (lab)", "N"),
        ("torque_body_N_m", "torque (body)", "N m"),
    ):
        if energies[key] is not None:
            lines.append(f"  {what:<22}{' '.join(f'{x:>22.15g}' for x in energies[key])} {unit}")
    return lines
