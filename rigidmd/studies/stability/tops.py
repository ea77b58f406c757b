"""Stability cases: heavy tops at the vertical, and at the threshold of the sleeping top."""

import numpy as np

from rigidmd.mechanics.rotation import from_vector
from rigidmd.studies.stability.cases import (
    EXACT,
    FAMILIES,
    SPLIT,
    TEXTBOOK,
    families,
    register_case,
    rotation_error,
    run_body,
)
from rigidmd.studies.stability.outcomes import REFUSED, RIGHT, CaseResult, Outcome, longest_step

#: The benchmark of Bruls & Cardona: 150 rad/s, within 2.6e-13 of the lowest point; centre of mass at 0.5 s computed
#: with 40 digits.
FAST_TOP = {
    "body": {"mass_kg": 15.0, "inertia_kg_m2": [0.234375, 0.46875, 0.234375], "pinned": True,
             "centre_of_mass_m": [0.0, 1.0, 0.0]},
    "start": {"angular_velocity_body_rad_s": [0.0, 150.0, -4.61538]},
    "gravity": {},
}  # fmt: skip
#: Nearly all of its energy is spin, so the bound is a tenth of the fraction of potential energy.
SWING = 0.1 * 15 * 9.81 / 5435.7
CENTRE_AT_HALF = np.array([-0.7024682970565856, -0.02116518470192333, -0.7114002576517344])


@register_case(5, x="step (s)", error="error of the centre of mass after 0.5 s (m)")
def fast_heavy_top(result: CaseResult, quick: bool) -> None:
    """The fast heavy top through its near-vertical pass, within 2.6e-13 of straight down."""
    allowed: dict[str, float] = dict.fromkeys((SPLIT, EXACT), 1e-7)
    for family in families(quick):

        def centre_error(results) -> float:
            return np.abs([results[k][-1] for k in "xyz"] - CENTRE_AT_HALF).max()

        step = 1e-4
        outcome = run_body(FAST_TOP, step, 0.5, family, centre_error)
        result.add("half a second", outcome, allowed.get(family, 1e-10), family, step, step)

        def at(step: float, family=family) -> Outcome:
            return run_body(FAST_TOP, step, 400 * step, family, centre_error, samples=400)

        result.limits.append(longest_step(at, 1e-3, "", family, SWING))


#: The moments about the pivot and weight times arm of an upright top, in units in which its threshold is L3 = 2.
UPRIGHT = {
    "body": {"mass_kg": 1.0, "inertia_kg_m2": [1.0, 1.0, 0.5], "inertia_about": "pivot", "pinned": True,
             "centre_of_mass_m": [0.0, 0.0, 0.25]},
    "gravity": {"acceleration_m_s2": [0.0, 0.0, -4.0]},
}  # fmt: skip
NUDGE = 1e-9


@register_case(5, x="distance from the threshold of sleep, relative", error="log of the largest tilt, against theory")
def sleeping_top(result: CaseResult, quick: bool) -> None:
    """The sleeping top at 1 +- 1e-6 (and more) of its threshold: it falls below, and stays upright above.

    Upright at rest but for omega_1 = e: theta = e t sinh(r t)/(r t) with r² = M g l/I1 - (L3/2 I1)², the sine above.
    """
    for gap in (1e-4, -1e-4) if quick else (1e-3, -1e-3, 1e-6, -1e-6):
        rate = abs(1 - (1 + gap) ** 2) ** 0.5
        span = 8 / rate
        known = NUDGE / rate * (np.sinh(8.0) if gap < 0 else 1.0)
        data = UPRIGHT | {"start": {"angular_velocity_body_rad_s": [NUDGE, 0.0, 4.0 * (1 + gap)]}}
        for family in families(quick):
            # the error of a step shifts the threshold by about its square for order 2
            order_2 = family.startswith(SPLIT)
            step = (0.02 if quick else 0.1) * abs(gap) ** 0.5 if order_2 else 0.05

            def tilt(results, known=known) -> float:
                return abs(np.log(results["theta"].max() / known))

            outcome = run_body(data, step, span, family, tilt, samples=2000)
            result.add(f"1 {gap:+.0e}", outcome, 0.05, family, abs(gap), step)


@register_case(5, error="error of Q")
def poles(result: CaseResult, quick: bool) -> None:
    """theta exactly 0 and pi in every formulation: right, or refused if Euler angles have no rates there."""
    spin, span = 5.0, 3.0
    for theta in (0.0, 180.0):
        start = {"euler_angles_deg": [0.0, theta, 0.0], "angular_velocity_body_rad_s": [0.0, 0.0, spin]}
        data = UPRIGHT | {"start": start}
        tilted = np.diag([1.0, -1.0, -1.0]) if theta else np.eye(3)
        truth = tilted @ from_vector(np.array([0.0, 0.0, spin * span]))
        for family in (*families(quick), *TEXTBOOK):
            expected = (RIGHT, REFUSED) if "euler" in family else (RIGHT,)
            allowed = 1e-11 if family in FAMILIES else 1e-6
            outcome = run_body(data, 0.01, span, family, rotation_error(truth))
            result.add(f"theta = {theta:g}°", outcome, allowed, family, theta, 0.01, expected)
