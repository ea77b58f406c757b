"""Stability cases: single bodies, free at every speed, tops, friction and fluids."""

from collections.abc import Callable
from functools import partial
from math import expm1, log

import numpy as np
from scipy.integrate import solve_ivp
from scipy.special import ellipkm1

from rigidmd.mechanics.rotation import from_quaternion, from_vector
from rigidmd.run.results import Results
from rigidmd.studies.stability.cases import (
    EXACT,
    POINT,
    REFUSED,
    RIGHT,
    SPLIT,
    TEXTBOOK,
    CaseResult,
    families,
    longest_step,
    register,
    run_body,
)


def rotation_error(rotation: np.ndarray) -> Callable[[Results], float]:
    """A function that computes the largest entry of |Q - Q_known| at the end."""
    return lambda results: np.abs(
        [[results[f"q{i}{j}"][-1] for j in (1, 2, 3)] for i in (1, 2, 3)] - rotation
    ).max()


def invariants_error(results: Results) -> float:
    """Largest relative error of L along the lab's axes and of |L|, and orthogonality error; not of
    the energy."""
    wrong = results.summary["largest_relative_error"]
    return max(
        [
            results.summary["largest_orthogonality_error"],
            *(e for name, e in wrong.items() if name != "energy"),
        ]
    )


def conserved_error(results: Results) -> float:
    """Largest relative error of all conserved quantities, and orthogonality error."""
    return max(
        invariants_error(results), results.summary["largest_relative_error"].get("energy", 0.0)
    )


def free_rotation(inertia, omega, span: float) -> np.ndarray:
    """Q of a free body at the end, by DOP853 on Euler's equations and a quaternion; its error is
    1e-13 per radian."""
    i1, i2, i3 = (float(i) for i in inertia)
    k1, k2, k3 = (i2 - i3) / i1, (i3 - i1) / i2, (i1 - i2) / i3

    def rates(t, y):
        a, b, c, w, x, y, z = y.tolist()
        return (
            k1 * b * c,
            k2 * c * a,
            k3 * a * b,
            -0.5 * (x * a + y * b + z * c),
            0.5 * (w * a + y * c - z * b),
            0.5 * (w * b + z * a - x * c),
            0.5 * (w * c + x * b - y * a),
        )

    found = solve_ivp(
        rates, (0.0, span), [*omega, 1.0, 0.0, 0.0, 0.0], "DOP853", rtol=1e-13, atol=1e-14
    )
    return from_quaternion(found.y[3:, -1])


OMEGA = (0.7, 1.0, -0.4)
#: Span and step of a free body, s; it rotates by about a radian per second.
SPAN, STEP = 20.0, 0.05
#: Allowed errors of Q after that span. The split rotor is of order 2 in its step, kahan_li_6 with
#: it of order 6.
ALLOWED = {SPLIT: 5e-4, "kahan_li_6": 1e-7}
EXACTLY = 1e-10


def free(inertia, omega=OMEGA) -> dict:
    """A body pinned at its centre of mass, which can only rotate."""
    return {
        "body": {"mass_kg": 1.0, "inertia_kg_m2": [float(i) for i in inertia], "pinned": True},
        "start": {"angular_velocity_body_rad_s": [float(w) for w in omega]},
    }


def exponents(first: int, last: int, quick: bool) -> list[int]:
    """-first ... -last, all or four of them."""
    return [
        -k
        for k in (
            np.unique(np.linspace(first, last, 4).astype(int)) if quick else range(first, last + 1)
        )
    ]


def compare_with_dop853(
    result: CaseResult, quick: bool, settings: list[tuple[str, tuple, tuple]]
) -> None:
    """Rotate each (setting, moments, omega) by each family for a span, and compare with DOP853."""
    for setting, inertia, omega in settings:
        truth = free_rotation(inertia, omega, SPAN)
        # L is exact to rounding, so omega about an axis with little inertia only to that divided by
        # the inertia
        rounding = 4 * np.finfo(float).eps * np.sqrt(SPAN / STEP) * max(inertia) / min(inertia)
        for family in families(quick):
            outcome = run_body(free(inertia, omega), STEP, SPAN, family, rotation_error(truth))
            expected = (RIGHT, REFUSED) if min(inertia) < 1e-12 * max(inertia) else (RIGHT,)
            result.add(
                setting, outcome, ALLOWED.get(family, EXACTLY) + rounding, family, STEP, expected
            )


def find_step_limits(result: CaseResult, quick: bool, setting: str, inertia) -> None:
    """The longest step of each family that keeps a free body's invariants within the bound."""
    for family in families(quick):
        data = free(inertia)
        run = partial(_conserved_error_after_100_steps, data, family)
        result.limits.append(longest_step(run, STEP, setting, family))


def _conserved_error_after_100_steps(data: dict, family: str, step: float):
    return run_body(data, step, 100 * step, family, conserved_error)


@register(1, error="error of Q after 20 s")
def near_linear(result: CaseResult, quick: bool) -> None:
    """Bodies that approach a line, I1/I2 from 1e-1 to 1e-15 and exactly 0."""
    ratios = [10.0**k for k in exponents(1, 15, quick)]
    compare_with_dop853(
        result, quick, [(f"I1/I2 = {r:.0e}", (r, 1.0, 1.0 + r), OMEGA) for r in ratios]
    )
    across = np.array([0.0, 1.0, -0.4])
    truth = from_vector(across * SPAN)
    for family in families(quick):
        outcome = run_body(free((0.0, 1.0, 1.0), across), STEP, SPAN, family, rotation_error(truth))
        result.add("I1 = 0", outcome, EXACTLY, family, STEP)
    find_step_limits(result, quick, "I1/I2 = 1e-06", (1e-6, 1.0, 1.0 + 1e-6))


@register(2, error="error of Q after 20 s")
def near_symmetric(result: CaseResult, quick: bool) -> None:
    """Two moments with relative differences of 1e-1 to 1e-16; all three, nearly a sphere."""
    gaps = [10.0**k for k in exponents(1, 16, quick)]
    compare_with_dop853(
        result, quick, [(f"oblate, {g:.0e}", (1.0, 1.0 + g, 1.5), OMEGA) for g in gaps]
    )
    compare_with_dop853(
        result, quick, [(f"sphere, {g:.0e}", (1.0, 1.0 + g, 1.0 + 0.3 * g), OMEGA) for g in gaps]
    )
    find_step_limits(result, quick, "oblate, 1e-02", (1.0, 1.01, 1.5))


@register(2, error="largest |Q - Q of the body itself|")
def inertia_scale(result: CaseResult, quick: bool) -> None:
    """The same body with its inertia scaled by 1e-15 to 1e15: the same motion to rounding."""
    inertia = np.array([1.0, 1.7, 2.4])
    truth = free_rotation(inertia, OMEGA, SPAN)
    for scale in (1e-15, 1e15) if quick else (1e-90, 1e-45, 1e-15, 1e15, 1e45, 1e90):
        for family in families(quick):
            outcome = run_body(free(scale * inertia), STEP, SPAN, family, rotation_error(truth))
            result.add(f"times {scale:.0e}", outcome, ALLOWED.get(family, EXACTLY), family, STEP)


@register(3, error="error of Q after 20 s")
def along_axes(result: CaseResult, quick: bool) -> None:
    """L exactly along each principal axis, and off it by 1e-16 to 1e-2; L = 0."""
    inertia = (1.0, 2.0, 2.6)
    for k in range(3):
        aside = np.roll([0.0, 0.6, 0.8], k)
        offs = [0.0] + [10.0**e for e in exponents(2, 16, quick)]
        settings = [
            (f"axis {k + 1}, off by {off:.0e}", inertia, np.eye(3)[k] + off * aside) for off in offs
        ]
        compare_with_dop853(result, quick, settings)
    for family in families(quick):
        outcome = run_body(free(inertia, (0, 0, 0)), STEP, SPAN, family, rotation_error(np.eye(3)))
        result.add("at rest", outcome, 0.0, family, STEP)


@register(3, error="error of the time of the first flip, relative")
def intermediate_axis(result: CaseResult, quick: bool) -> None:
    """Spin about the middle axis, off by 1e-3 to 1e-12: the time of the first flip agrees with
    theory; many follow.

    Only the first is compared: later flips are earlier, because rounding of omega leaves the body
    1e-8 off the axis.
    """
    i1, i2, i3 = 1.0, 2.0, 3.0
    rate = ((i2 - i1) * (i3 - i2) / (i1 * i3)) ** 0.5
    for off in (1e-3, 1e-12) if quick else (1e-3, 1e-6, 1e-9, 1e-12):
        first = quarter_period(off, i1, i2, i3)
        for family in families(quick):
            times = []

            def first_flip_error(results, times=times, first=first) -> float:
                spin, t = results["omega_body_2"], results["time"]
                at = np.flatnonzero(np.diff(np.sign(spin)))
                times += (
                    t[at] + (t[at + 1] - t[at]) * spin[at] / (spin[at] - spin[at + 1])
                ).tolist()
                return abs(times[0] / first - 1) if times else np.inf

            span = 10 * max(first, log(1e8) / rate)
            data = free((i1, i2, i3), (off, 1.0, 0.0))
            outcome = run_body(data, 0.02, span, family, first_flip_error, samples=int(span / 0.1))
            result.add(f"off by {off:.0e}: {len(times)} flips", outcome, 3e-3, family, 0.02)


def quarter_period(off: float, i1: float, i2: float, i3: float) -> float:
    """Time from omega = (off, 1, 0) to omega_2 = 0, I1 < I2 < I3: K(m)/p, a quarter of the period.

    p² = (I2 - I1) A/(I1 I2 I3) and 1 - m = I1 (I3 - I1) off²/A with A = 2T I3 - L² (Landau &
    Lifshitz, Mechanics, section 37, axes 1 and 3 exchanged).
    """
    excess = i1 * (i3 - i1) * off**2 + i2 * (i3 - i2)
    rate = ((i2 - i1) * excess / (i1 * i2 * i3)) ** 0.5
    return float(ellipkm1(i1 * (i3 - i1) * off**2 / excess) / rate)


@register(4, error="error of Q; of the invariants with the split rotor")
def fast_spin(result: CaseResult, quick: bool) -> None:
    """Steps that rotate the body by 0.1 to 1000 rad: the exact rotor keeps Q, the split one |L| and
    QᵀQ."""
    inertia, omega = np.array([1.0, 1.7, 2.4]), np.array([0.6, 0.64, 0.48])
    for angle in (0.1, 10.0, 1000.0) if quick else (0.1, 1.0, 10.0, 100.0, 1000.0):
        span = max(2 * angle, 20.0)
        data = free(inertia, omega)
        truth = free_rotation(inertia, omega, span)
        for family in (f for f in families(quick) if f != "kahan_li_6"):
            error = invariants_error if family == SPLIT else rotation_error(truth)
            # the error of DOP853 itself is about 1e-13 per radian
            outcome = run_body(data, angle, span, family, error)
            result.add(f"{angle:g} rad per step", outcome, 1e-12 * max(span, 100.0), family, angle)


@register(12, error="error of |L|, relative")
def long_run(result: CaseResult, quick: bool) -> None:
    """One body for 1e8 steps: growth of the errors of |L|, of QᵀQ and of the energy.

    A random walk grows as steps^0.5, a drift as steps^1. The exponent is the slope of a line
    through the logarithms of the root mean square over windows.
    """
    steps = 1e6 if quick else 1e8
    for family in (SPLIT, EXACT):
        step = 0.1
        kept = {}

        def errors(results, kept=kept) -> float:
            kept.update(
                {
                    name: results[name]
                    for name in ("energy_error", "L_size_error", "orthogonality_error")
                }
            )
            return np.abs(results["L_size_error"]).max()

        outcome = run_body(free((1.0, 1.7, 2.4)), step, steps * step, family, errors, samples=2000)
        result.add(f"{steps:.0e} steps", outcome, 1e-15 * steps**0.75, family, step)
        for name, symbol in (
            ("L_size_error", "|L|"),
            ("orthogonality_error", "QᵀQ"),
            ("energy_error", "energy"),
        ):
            if kept:
                result.notes.append(f"{family}, {symbol}: {describe_growth(kept[name])}")


def describe_growth(errors: np.ndarray) -> str:
    """Largest size and exponent of the growth of errors (t,) at regular times."""
    errors = np.abs(errors[1:])
    edges = np.unique(np.geomspace(8, len(errors), 9).astype(int))
    rms = np.array([np.sqrt(np.mean(errors[:edge] ** 2)) for edge in edges])
    if not rms.all():
        return f"{errors[-1]:.1e} at the end"
    power = np.polyfit(np.log(edges), np.log(rms), 1)[0]
    kind = "bounded" if power < 0.25 else "a random walk" if power < 0.75 else "linear"
    return f"{errors.max():.1e} at most, growing as steps^{power:.2f}: {kind}"


#: The benchmark of Bruls & Cardona: 150 rad/s, within 2.6e-13 of the lowest point; centre of mass
#: at 0.5 s.
FAST_TOP = {
    "body": {
        "mass_kg": 15.0,
        "inertia_kg_m2": [0.234375, 0.46875, 0.234375],
        "pinned": True,
        "centre_of_mass_m": [0.0, 1.0, 0.0],
    },
    "start": {"angular_velocity_body_rad_s": [0.0, 150.0, -4.61538]},
    "gravity": {},
}
#: Nearly all of its energy is spin, so the bound is a tenth of the fraction of potential energy.
SWING = 0.1 * 15 * 9.81 / 5435.7
CENTRE_AT_HALF = np.array([-0.7024682970565856, -0.02116518470192333, -0.7114002576517344])


@register(5, error="error of the centre of mass after 0.5 s (m)")
def fast_heavy_top(result: CaseResult, quick: bool) -> None:
    """The fast heavy top through its near-vertical pass, within 2.6e-13 of straight down."""

    def centre_error(results) -> float:
        return np.abs([results[k][-1] for k in "xyz"] - CENTRE_AT_HALF).max()

    for family in families(quick):
        outcome = run_body(FAST_TOP, 1e-4, 0.5, family, centre_error)
        result.add(
            "half a second", outcome, 1e-7 if family in (SPLIT, EXACT) else 1e-10, family, 1e-4
        )
        run = partial(_run_400_steps, family, centre_error)
        result.limits.append(longest_step(run, 1e-3, "", family, SWING))


def _run_400_steps(family: str, error: Callable, step: float):
    return run_body(FAST_TOP, step, 400 * step, family, error, 400)


#: The moments about the pivot and weight times arm of an upright top, in units in which its
#: threshold is L3 = 2.
UPRIGHT = {
    "body": {
        "mass_kg": 1.0,
        "inertia_kg_m2": [1.0, 1.0, 0.5],
        "inertia_about": "pivot",
        "pinned": True,
        "centre_of_mass_m": [0.0, 0.0, 0.25],
    },
    "gravity": {"acceleration_m_s2": [0.0, 0.0, -4.0]},
}
NUDGE = 1e-9


@register(5, error="log of the largest tilt, against theory")
def sleeping_top(result: CaseResult, quick: bool) -> None:
    """The sleeping top at 1 +- 1e-6 (and more) of its threshold: it falls below, and stays upright
    above. Upright at rest but for omega_1 = e: theta = e t sinh(r t)/(r t) with r² = M g l/I1 -
    (L3/2 I1)², the sine above."""
    for gap in (1e-4, -1e-4) if quick else (1e-3, -1e-3, 1e-6, -1e-6):
        rate = abs(1 - (1 + gap) ** 2) ** 0.5
        span = 8 / rate
        known = NUDGE / rate * (np.sinh(8.0) if gap < 0 else 1.0)
        data = UPRIGHT | {"start": {"angular_velocity_body_rad_s": [NUDGE, 0.0, 4.0 * (1 + gap)]}}
        for family in families(quick):
            # the error of a step shifts the threshold by about its square for order 2
            step = (0.02 if quick else 0.1) * abs(gap) ** 0.5 if family.startswith(SPLIT) else 0.05

            def tilt(results, known=known):
                return abs(np.log(results["theta"].max() / known))

            result.add(
                f"1 {gap:+.0e}",
                run_body(data, step, span, family, tilt, samples=2000),
                0.05,
                family,
                step,
            )


@register(5, error="error of Q")
def poles(result: CaseResult, quick: bool) -> None:
    """theta exactly 0 and pi in every formulation: right, or refused if Euler angles have no rates
    there."""
    spin, span = 5.0, 3.0
    for theta in (0.0, 180.0):
        start = {
            "euler_angles_deg": [0.0, theta, 0.0],
            "angular_velocity_body_rad_s": [0.0, 0.0, spin],
        }
        data = UPRIGHT | {"start": start}
        tilted = np.diag([1.0, -1.0, -1.0]) if theta else np.eye(3)
        truth = tilted @ from_vector(np.array([0.0, 0.0, spin * span]))
        for family in (*families(quick), *TEXTBOOK):
            expected = (RIGHT, REFUSED) if "euler" in family else (RIGHT,)
            allowed = 1e-11 if family not in TEXTBOOK else 1e-6
            outcome = run_body(data, 0.01, span, family, rotation_error(truth))
            result.add(f"theta = {theta:g}°", outcome, allowed, family, 0.01, expected)


DECAY_STEPS = 20


def strengths(quick: bool) -> list[float]:
    """c dt / I."""
    return [1e-12, 1e-2, 1.0, 1e6] if quick else [10.0**k for k in range(-12, 7)]


def decay(column: str, known: np.ndarray):
    """Error of a column against a decay, relative to its start; infinite if it changes sign or
    grows."""

    def error(results) -> float:
        found = results[column]
        over = (np.sign(found) * np.sign(known) < 0).any() or (
            np.diff(np.abs(found)) > 1e-15 * abs(found[0])
        ).any()
        return np.inf if over else np.abs(found - known).max() / abs(found[0])

    return error


@register(6, error="error of omega, relative; infinite if it overshoots")
def friction(result: CaseResult, quick: bool) -> None:
    """Viscous and dry friction with c dt / I from 1e-12 to 1e6: exact decay, never past zero."""
    at = np.arange(DECAY_STEPS + 1.0)
    for c in strengths(quick):
        spinning = free((2.0, 2.0, 1.0), (0.0, 0.0, 1.0))
        viscous = spinning | {"friction": {"viscous_N_m_s": [0.0, 0.0, c]}}
        dry = spinning | {"friction": {"dry_N_m": [0.0, 0.0, c]}}
        known_dry = np.maximum(0.0, 1.0 - c * at)
        for family in (
            SPLIT,
            EXACT,
        ):  # srkn_4 would be of order 2 with resistance, so scenes refuse it
            for setting, data, known in (
                ("viscous", viscous, np.exp(-c * at)),
                ("dry", dry, known_dry),
            ):
                outcome = run_body(
                    data, 1.0, DECAY_STEPS, family, decay("omega_body_3", known), DECAY_STEPS
                )
                result.add(f"{setting}, {c:.0e}", outcome, 1e-14 * DECAY_STEPS, family, 1.0)


@register(6, error="error of v, relative; infinite if it overshoots")
def fluid(result: CaseResult, quick: bool) -> None:
    """Linear resistance with c dt / m from 1e-12 to 1e6: exact decay and fall; quadratic: never
    past zero."""
    at = np.arange(DECAY_STEPS + 1.0)
    for c in strengths(quick):
        moving = {"body": {"mass_kg": 1.0}, "start": {"velocity_m_s": [1.0, 0.0, 0.0]}}
        linear = moving | {"fluid": {"linear_resistance_kg_s": [c] * 3}}
        quadratic = moving | {"fluid": {"quadratic_resistance_kg_m": [c] * 3}}
        for setting, data, known, allowed in (
            ("linear", linear, np.exp(-c * at), 1e-14 * DECAY_STEPS),
            # of order 2 in c dt: right where the step resolves it, and never past zero anywhere
            ("quadratic", quadratic, 1 / (1 + c * at), max(1e-13, 0.1 * min(c * c, 5.0))),
        ):
            outcome = run_body(data, 1.0, DECAY_STEPS, POINT, decay("vx", known), DECAY_STEPS)
            result.add(f"{setting}, {c:.0e}", outcome, allowed, SPLIT, 1.0)
        falling = {
            "body": {"mass_kg": 1.0},
            "gravity": {},
            "fluid": {"linear_resistance_kg_s": [c] * 3},
        }
        speed = 9.81 * expm1(-c * DECAY_STEPS) / c

        def fall(results, speed=speed):
            return abs(results["vz"][-1] / speed - 1)

        # kick, drift, kick are exact for a constant force
        outcome = run_body(falling, 1.0, DECAY_STEPS, POINT, fall, DECAY_STEPS)
        result.add(f"falling, {c:.0e}", outcome, 1e-13, SPLIT, 1.0)
