"""Stability cases: the rotation of free bodies of every shape at every speed."""

from math import log

import numpy as np
from scipy.special import ellipkm1

from rigidmd.mechanics.rotation import from_vector
from rigidmd.studies.stability.cases import (
    EXACT,
    SPLIT,
    conserved_error,
    families,
    free_rotation,
    invariants_error,
    register_case,
    rotation_error,
    run_body,
)
from rigidmd.studies.stability.outcomes import REFUSED, RIGHT, CaseResult, Outcome, longest_step

OMEGA = (0.7, 1.0, -0.4)
#: Span and step of a free body, s; it rotates by about a radian per second.
SPAN, STEP = 20.0, 0.05
#: Allowed errors of Q after that span. The split rotor is of order 2 in its step, kahan_li_6 with it of order 6.
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
    every = range(first, last + 1)
    return [-k for k in (every if not quick else np.unique(np.linspace(first, last, 4).astype(int)))]


def compare_with_dop853(result: CaseResult, quick: bool, settings: list[tuple[str, float, tuple, tuple]]) -> None:
    """Rotate each (setting, x, moments, omega) by each family for a span, and compare with DOP853."""
    for setting, x, inertia, omega in settings:
        truth = free_rotation(inertia, omega, SPAN)
        # L is exact to rounding, so omega about an axis with little inertia only to that divided by the inertia
        rounding = 4 * np.finfo(float).eps * np.sqrt(SPAN / STEP) * max(inertia) / min(inertia)
        for family in families(quick):
            outcome = run_body(free(inertia, omega), STEP, SPAN, family, rotation_error(truth))
            expected = (RIGHT, REFUSED) if min(inertia) < 1e-12 * max(inertia) else (RIGHT,)
            result.add(setting, outcome, ALLOWED.get(family, EXACTLY) + rounding, family, x, STEP, expected)


def find_step_limits(result: CaseResult, quick: bool, setting: str, inertia, omega=OMEGA) -> None:
    """The longest step of each family that keeps a free body's invariants within the bound."""
    for family in families(quick):
        data = free(inertia, omega)

        def at(step: float, data=data, family=family) -> Outcome:
            return run_body(data, step, 100 * step, family, conserved_error)

        result.limits.append(longest_step(at, STEP, setting, family))


@register_case(1, x="I1/I2", error="error of Q after 20 s")
def near_linear(result: CaseResult, quick: bool) -> None:
    """Bodies that approach a line, I1/I2 from 1e-1 to 1e-15 and exactly 0."""
    ratios = [10.0**k for k in exponents(1, 15, quick)]
    compare_with_dop853(result, quick, [(f"I1/I2 = {r:.0e}", r, (r, 1.0, 1.0 + r), OMEGA) for r in ratios])
    across = np.array([0.0, 1.0, -0.4])
    truth = from_vector(across * SPAN)
    for family in families(quick):
        outcome = run_body(free((0.0, 1.0, 1.0), across), STEP, SPAN, family, rotation_error(truth))
        result.add("I1 = 0", outcome, EXACTLY, family, ratios[-1] / 10, STEP)
    find_step_limits(result, quick, "I1/I2 = 1e-06", (1e-6, 1.0, 1.0 + 1e-6))


@register_case(2, x="relative difference of two moments", error="error of Q after 20 s")
def near_symmetric(result: CaseResult, quick: bool) -> None:
    """Two moments with relative differences of 1e-1 to 1e-16; all three, nearly a sphere."""
    gaps = [10.0**k for k in exponents(1, 16, quick)]
    compare_with_dop853(result, quick, [(f"oblate, {g:.0e}", g, (1.0, 1.0 + g, 1.5), OMEGA) for g in gaps])
    compare_with_dop853(result, quick, [(f"sphere, {g:.0e}", g, (1.0, 1.0 + g, 1.0 + 0.3 * g), OMEGA) for g in gaps])
    find_step_limits(result, quick, "oblate, 1e-02", (1.0, 1.01, 1.5))


@register_case(2, x="factor on the inertia", error="largest |Q - Q of the body itself|")
def inertia_scale(result: CaseResult, quick: bool) -> None:
    """The same body with its inertia scaled by 1e-15 to 1e15: the same motion to rounding."""
    inertia = np.array([1.0, 1.7, 2.4])
    truth = free_rotation(inertia, OMEGA, SPAN)
    for scale in (1e-15, 1e15) if quick else (1e-90, 1e-45, 1e-15, 1e15, 1e45, 1e90):
        for family in families(quick):
            outcome = run_body(free(scale * inertia), STEP, SPAN, family, rotation_error(truth))
            result.add(f"times {scale:.0e}", outcome, ALLOWED.get(family, EXACTLY), family, scale, STEP)


@register_case(3, x="angle of omega off the axis (rad)", error="error of Q after 20 s")
def along_axes(result: CaseResult, quick: bool) -> None:
    """L exactly along each principal axis, and off it by 1e-16 to 1e-2; L = 0."""
    inertia = (1.0, 2.0, 2.6)
    for k in range(3):
        aside = np.roll([0.0, 0.6, 0.8], k)
        offs = [0.0] + [10.0**e for e in exponents(2, 16, quick)]
        axis = np.eye(3)[k]
        settings = [(f"axis {k + 1}, off by {off:.0e}", max(off, 1e-17), inertia, axis + off * aside) for off in offs]
        compare_with_dop853(result, quick, settings)
    for family in families(quick):
        outcome = run_body(free(inertia, (0, 0, 0)), STEP, SPAN, family, rotation_error(np.eye(3)))
        result.add("at rest", outcome, 0.0, family, 1e-17, STEP)


@register_case(3, x="omega off the middle axis, relative", error="error of the time of the first flip, relative")
def intermediate_axis(result: CaseResult, quick: bool) -> None:
    """Spin about the middle axis, off by 1e-3 to 1e-12: the time of the first flip agrees with theory; many follow.

    Only the first is compared: later flips are earlier, because rounding of omega leaves the body 1e-8 off the axis.
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
                times += (t[at] + (t[at + 1] - t[at]) * spin[at] / (spin[at] - spin[at + 1])).tolist()
                return abs(times[0] / first - 1) if times else np.inf

            span = 10 * max(first, log(1e8) / rate)
            data = free((i1, i2, i3), (off, 1.0, 0.0))
            outcome = run_body(data, 0.02, span, family, first_flip_error, samples=int(span / 0.1))
            result.add(f"off by {off:.0e}: {len(times)} flips", outcome, 3e-3, family, off, 0.02)


def quarter_period(off: float, i1: float, i2: float, i3: float) -> float:
    """Time from omega = (off, 1, 0) to omega_2 = 0, I1 < I2 < I3: K(m)/p, a quarter of the period.

    p² = (I2 - I1) A/(I1 I2 I3) and 1 - m = I1 (I3 - I1) off²/A with A = 2T I3 - L² (Landau & Lifshitz, Mechanics,
    section 37, axes 1 and 3 exchanged).
    """
    excess = i1 * (i3 - i1) * off**2 + i2 * (i3 - i2)
    rate = ((i2 - i1) * excess / (i1 * i2 * i3)) ** 0.5
    return float(ellipkm1(i1 * (i3 - i1) * off**2 / excess) / rate)


@register_case(4, x="|omega| dt (rad)", error="error of Q; of the invariants with the split rotor")
def fast_spin(result: CaseResult, quick: bool) -> None:
    """Steps that rotate the body by 0.1 to 1000 rad: the exact rotor keeps Q, the split one |L| and QᵀQ."""
    inertia, omega = np.array([1.0, 1.7, 2.4]), np.array([0.6, 0.64, 0.48])
    for angle in (0.1, 10.0, 1000.0) if quick else (0.1, 1.0, 10.0, 100.0, 1000.0):
        span = max(2 * angle, 20.0)
        data = free(inertia, omega)
        truth = free_rotation(inertia, omega, span)
        for family in (f for f in families(quick) if f != "kahan_li_6"):
            error = invariants_error if family == SPLIT else rotation_error(truth)
            # the error of DOP853 itself is about 1e-13 per radian
            outcome = run_body(data, angle, span, family, error)
            result.add(f"{angle:g} rad per step", outcome, 1e-12 * max(span, 100.0), family, angle, angle)


@register_case(12, x="steps", error="error of |L|, relative")
def long_run(result: CaseResult, quick: bool) -> None:
    """One body for 1e8 steps: growth of the errors of |L|, of QᵀQ and of the energy.

    A random walk grows as steps^0.5, a drift as steps^1. The exponent is the slope of a line through the logarithms of
    the root mean square over windows.
    """
    steps = 1e6 if quick else 1e8
    for family in (SPLIT, EXACT):
        step = 0.1
        kept = {}

        def errors(results, kept=kept) -> float:
            kept.update({name: results[name] for name in ("energy_error", "L_size_error", "orthogonality_error")})
            return np.abs(results["L_size_error"]).max()

        outcome = run_body(free((1.0, 1.7, 2.4)), step, steps * step, family, errors, samples=2000)
        result.add(f"{steps:.0e} steps", outcome, 1e-15 * steps**0.75, family, steps, step)
        for name, symbol in (("L_size_error", "|L|"), ("orthogonality_error", "QᵀQ"), ("energy_error", "energy")):
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
