"""Stability cases: friction, fluids and the thermostat, from very weak to a million times too strong for the step."""

from math import expm1, sqrt

import numpy as np

from rigidmd.studies.stability.cases import (
    POINT,
    QUICK,
    SPLIT,
    WATERS,
    liquid,
    register_case,
    run_body,
    run_molecules,
    water_scene,
)
from rigidmd.studies.stability.outcomes import CaseResult

STEPS = 20


def strengths(quick: bool) -> list[float]:
    """c dt / I."""
    return [1e-12, 1e-2, 1.0, 1e6] if quick else [10.0**k for k in range(-12, 7)]


def decay(column: str, known: np.ndarray):
    """Error of a column against a decay, relative to its start; infinite if it changes sign or grows."""

    def error(results) -> float:
        found = results[column]
        over = (np.sign(found) * np.sign(known) < 0).any() or (np.diff(np.abs(found)) > 1e-15 * abs(found[0])).any()
        return np.inf if over else np.abs(found - known).max() / abs(found[0])

    return error


@register_case(6, x="c dt / I", error="error of omega, relative; infinite if it overshoots")
def friction(result: CaseResult, quick: bool) -> None:
    """Viscous and dry friction with c dt / I from 1e-12 to 1e6: exact decay, never past zero."""
    at = np.arange(STEPS + 1.0)
    for c in strengths(quick):
        spinning = {
            "body": {"mass_kg": 1.0, "inertia_kg_m2": [2.0, 2.0, 1.0], "pinned": True},
            "start": {"angular_velocity_body_rad_s": [0.0, 0.0, 1.0]},
        }
        viscous = spinning | {"friction": {"viscous_N_m_s": [0.0, 0.0, c]}}
        dry = spinning | {"friction": {"dry_N_m": [0.0, 0.0, c]}}
        for family in QUICK[:2] if quick else QUICK:
            if family == "srkn_4":
                continue  # its order would be 2 with resistance, so scenes refuse it
            for setting, data, known in (
                ("viscous", viscous, np.exp(-c * at)),
                ("dry", dry, np.maximum(0.0, 1.0 - c * at)),
            ):
                outcome = run_body(data, 1.0, STEPS, family, decay("omega_body_3", known), STEPS)
                result.add(f"{setting}, {c:.0e}", outcome, 1e-14 * STEPS, family, c, 1.0)


@register_case(6, x="c dt / m", error="error of v, relative; infinite if it overshoots")
def fluid(result: CaseResult, quick: bool) -> None:
    """Linear resistance with c dt / m from 1e-12 to 1e6: exact decay and fall; quadratic: never past zero."""
    at = np.arange(STEPS + 1.0)
    for c in strengths(quick):
        moving = {"body": {"mass_kg": 1.0}, "start": {"velocity_m_s": [1.0, 0.0, 0.0]}}
        linear = moving | {"fluid": {"linear_resistance_kg_s": [c] * 3}}
        quadratic = moving | {"fluid": {"quadratic_resistance_kg_m": [c] * 3}}
        family = SPLIT
        for setting, data, known, allowed in (
            ("linear", linear, np.exp(-c * at), 1e-14 * STEPS),
            # of order 2 in c dt: right where the step resolves it, and never past zero anywhere
            ("quadratic", quadratic, 1 / (1 + c * at), max(1e-13, 0.1 * min(c * c, 5.0))),
        ):
            outcome = run_body(data, 1.0, STEPS, POINT, decay("vx", known), STEPS)
            result.add(f"{setting}, {c:.0e}", outcome, allowed, family, c, 1.0)
        falling = {"body": {"mass_kg": 1.0}, "gravity": {}, "fluid": {"linear_resistance_kg_s": [c] * 3}}
        speed = 9.81 * expm1(-c * STEPS) / c

        def fall(results, speed=speed) -> float:
            return abs(results["vz"][-1] / speed - 1)

        # kick, drift, kick are exact for a constant force
        result.add(f"falling, {c:.0e}", run_body(falling, 1.0, STEPS, POINT, fall, STEPS), 1e-13, family, c, 1.0)


@register_case(6, x="dt / time constant", error="kinetic energy, standard errors from the canonical mean")
def thermostat(result: CaseResult, quick: bool) -> None:
    """The thermostat with dt / tau from 1e-12 to 1e6: little heat when weak, the canonical mean when strong."""
    state = liquid("spce", 298.0, 1.0, 500)
    freedom = 6 * WATERS - 3
    for ratio in (1e-12, 1e6) if quick else [10.0**k for k in range(-12, 7, 3)]:
        step, steps = 0.5, 200
        heat = {"temperature_K": 298.0, "thermostat_time_ps": step / 1000 / ratio}
        data = water_scene("spce", step, steps, SPLIT, 298.0, heat, samples=steps)
        weak = steps * ratio < 1e-3

        def error(results, weak=weak, ratio=ratio, steps=steps) -> float:
            kinetic = results["kinetic"]
            heat_added = np.abs(results["energy"] - results["conserved"]).max() / kinetic[0]
            if weak:  # heat in a step: at most some ten standard deviations of its noise, 2 sqrt(dt/tau / freedom)
                return heat_added / (10 * sqrt(4 * ratio * steps / freedom))
            if ratio < 1:
                return 0.0 if np.isfinite(kinetic).all() else np.inf
            mean = kinetic[1:].mean() / (0.5 * freedom * 298.0 * 0.008314462618)
            return abs(mean - 1) / sqrt(2 / freedom / steps)

        result.add(f"dt/tau = {ratio:.0e}", run_molecules(data, state, error), 1.0 if weak else 5.0, SPLIT, ratio, step)
