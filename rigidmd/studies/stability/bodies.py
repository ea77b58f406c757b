"""Stability cases: single bodies, free at every speed, tops, friction and fluids."""

from collections.abc import Callable, Iterator
from functools import partial
from math import expm1, inf, log
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.integrate import solve_ivp
from scipy.special import ellipkm1

from rigidmd.mechanics.rotation import from_quaternion, from_vector
from rigidmd.run.results import Results
from rigidmd.studies.stability.cases import (
    EXACT,
    HIGHER_ORDER,
    ORDER_2,
    REFUSED,
    RIGHT,
    SCENES,
    SOLVERS,
    SPLIT,
    Trial,
    case,
    powers,
    run_scene,
)

Trials = Iterator[Trial]
OMEGA = (0.7, 1.0, -0.4)
#: Duration and step of a free body, s; it rotates by about a radian per second.
SPAN, STEP = 20.0, 0.05
#: Errors of Q after that: of the split rotor, of order 2, and of kahan_li_6 with it, of order 6.
ROTOR_ERRORS = {SPLIT: 5e-4, "kahan_li_6": 1e-7}
RIGHT_OR_REFUSED = (RIGHT, REFUSED)


def free(inertia: ArrayLike, omega: ArrayLike = OMEGA) -> dict[str, Any]:
    """A body pinned at its centre of mass, which can only rotate."""
    return {
        "body": {"mass_kg": 1.0, "inertia_kg_m2": np.array(inertia), "pinned": True},
        "start": {"angular_velocity_body_rad_s": np.array(omega)},
    }


def free_rotation(inertia: ArrayLike, omega: ArrayLike, span: float) -> np.ndarray:
    """Q of a free body at the end, by DOP853 on Euler's equations and a quaternion; its error is
    1e-13 per radian."""
    i1, i2, i3 = np.array(inertia).tolist()
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

    start = [*np.array(omega), 1.0, 0.0, 0.0, 0.0]
    solution = solve_ivp(rates, (0.0, span), start, "DOP853", rtol=1e-13, atol=1e-14)
    return from_quaternion(solution.y[3:, -1])


def rotation_error(rotation: np.ndarray, results: Results) -> float:
    """Largest entry of |Q - Q_known| at the end."""
    return np.abs(results["Q"][-1] - rotation).max()


def attitude(
    setting: str,
    tables: dict[str, Any],
    rotation: np.ndarray,
    allowed: float = 1e-10,
    step: float = STEP,
    span: float = SPAN,
    **changes: Any,
) -> Trial:
    """A trial that compares the rotation at the end with a known one."""
    run = partial(run_scene, tables, duration=span, error=partial(rotation_error, rotation))
    return Trial(setting, run, step, allowed, **changes)


def free_body(setting: str, inertia: ArrayLike, omega: ArrayLike = OMEGA) -> Trial:
    """A free body that is compared with DOP853."""
    ratio = np.max(inertia) / np.min(inertia)
    # L is exact to rounding, so omega about an axis with little inertia only to that times the
    # ratio of the moments
    rounding = 4 * np.finfo(float).eps * np.sqrt(SPAN / STEP) * ratio
    return attitude(
        setting,
        free(inertia, omega),
        free_rotation(inertia, omega, SPAN),
        1e-10 + rounding,
        method_errors=ROTOR_ERRORS,
        expected=RIGHT_OR_REFUSED if ratio > 1e12 else (RIGHT,),
    )


def step_limit(setting: str, inertia: ArrayLike) -> Trial:
    """The longest step that keeps the invariants of a free body within the bound."""
    return Trial(setting, partial(run_scene, free(inertia), steps=100), STEP).limit()


@case(1, "error of Q after 20 s")
def near_linear(quick: bool) -> Trials:
    """Bodies that approach a line, I1/I2 from 1e-1 to 1e-15 and exactly 0."""
    for ratio in powers(1, 15, quick):
        yield free_body(f"I1/I2 = {ratio:.0e}", (ratio, 1.0, 1.0 + ratio))
    omega = np.array([0.0, 1.0, -0.4])
    yield attitude("I1 = 0", free((0.0, 1.0, 1.0), omega), from_vector(omega * SPAN))
    yield step_limit("I1/I2 = 1e-06", (1e-6, 1.0, 1.0 + 1e-6))


@case(2, "error of Q after 20 s")
def near_symmetric(quick: bool) -> Trials:
    """Two moments with relative differences of 1e-1 to 1e-16; all three, nearly a sphere."""
    for gap in powers(1, 16, quick):
        yield free_body(f"oblate, {gap:.0e}", (1.0, 1.0 + gap, 1.5))
    for gap in powers(1, 16, quick):
        yield free_body(f"sphere, {gap:.0e}", (1.0, 1.0 + gap, 1.0 + 0.3 * gap))
    yield step_limit("oblate, 1e-02", (1.0, 1.01, 1.5))


@case(2, "largest |Q - Q of the body itself|")
def inertia_scale(quick: bool) -> Trials:
    """The same body with its inertia scaled by 1e-15 to 1e15: the same motion to rounding."""
    inertia = np.array([1.0, 1.7, 2.4])
    rotation = free_rotation(inertia, OMEGA, SPAN)
    for scale in (1e-15, 1e15) if quick else (1e-90, 1e-45, 1e-15, 1e15, 1e45, 1e90):
        tables = free(scale * inertia)
        yield attitude(f"times {scale:.0e}", tables, rotation, method_errors=ROTOR_ERRORS)


@case(3, "error of Q after 20 s")
def along_axes(quick: bool) -> Trials:
    """L exactly along each principal axis, and off it by 1e-16 to 1e-2; L = 0."""
    inertia = (1.0, 2.0, 2.6)
    for k, axis in enumerate(np.eye(3)):
        aside = np.roll([0.0, 0.6, 0.8], k)
        for off in (0.0, *powers(2, 16, quick)):
            yield free_body(f"axis {k + 1}, off by {off:.0e}", inertia, axis + off * aside)
    yield attitude("at rest", free(inertia, (0.0, 0.0, 0.0)), np.eye(3), 0.0)


@case(3, "error of the time of the first flip, relative")
def intermediate_axis(quick: bool) -> Trials:
    """Spin about the middle axis, off by 1e-3 to 1e-12: the time of the first flip agrees with
    theory; many follow.

    Only the first is compared: later flips are earlier, because rounding of omega leaves the body
    1e-8 off the axis.
    """
    for off in (1e-3, 1e-12) if quick else (1e-3, 1e-6, 1e-9, 1e-12):
        first = quarter_period(off, 1.0, 2.0, 3.0)
        growth_rate = 3**-0.5  # of the distance from the axis, sqrt((I2 - I1)(I3 - I2)/(I1 I3))
        span = 10 * max(first, log(1e8) / growth_rate)
        run = partial(
            run_scene,
            free((1.0, 2.0, 3.0), (off, 1.0, 0.0)),
            duration=span,
            samples=int(span / 0.1),
            error=partial(first_flip_error, first),
            remark=lambda results: f"{len(flip_times(results))} flips",
        )
        yield Trial(f"off by {off:.0e}", run, 0.02, 3e-3)


def flip_times(results: Results) -> np.ndarray:
    """Times at which omega about the middle axis is 0."""
    spin, time = results["omega_body_2"], results["time"]
    before = np.flatnonzero(np.diff(np.sign(spin)))
    fraction = spin[before] / (spin[before] - spin[before + 1])
    return time[before] + fraction * (time[before + 1] - time[before])


def first_flip_error(first: float, results: Results) -> float:
    return abs(np.append(flip_times(results), inf)[0] / first - 1)


def quarter_period(off: float, i1: float, i2: float, i3: float) -> float:
    """Time from omega = (off, 1, 0) to omega_2 = 0, I1 < I2 < I3: K(m)/p, a quarter of the period.

    p² = (I2 - I1) A/(I1 I2 I3) and 1 - m = I1 (I3 - I1) off²/A with A = 2T I3 - L² (Landau &
    Lifshitz, Mechanics, section 37, axes 1 and 3 exchanged).
    """
    excess = i1 * (i3 - i1) * off**2 + i2 * (i3 - i2)
    rate = ((i2 - i1) * excess / (i1 * i2 * i3)) ** 0.5
    return float(ellipkm1(i1 * (i3 - i1) * off**2 / excess) / rate)


@case(4, "error of Q; of the invariants with the split rotor")
def fast_spin(quick: bool) -> Trials:
    """Steps that rotate the body by 0.1 to 1000 rad: the exact rotor keeps Q, the split one |L| and
    QᵀQ."""
    inertia, omega = (1.0, 1.7, 2.4), (0.6, 0.64, 0.48)
    with_exact_rotor = (EXACT, "srkn_4") if quick else (EXACT, "srkn_4", "pefrl")
    for angle in (0.1, 10.0, 1000.0) if quick else (0.1, 1.0, 10.0, 100.0, 1000.0):
        tables, span = free(inertia, omega), max(2 * angle, 20.0)
        rotation = free_rotation(inertia, omega, span)
        setting = f"{angle:g} rad per step"
        allowed = 1e-12 * max(span, 100.0)  # the error of DOP853 itself is 1e-13 per radian
        run = partial(run_scene, tables, duration=span, error=invariants_error)
        yield Trial(setting, run, angle, allowed, [SPLIT])
        yield attitude(
            setting, tables, rotation, allowed, angle, span, integrators=with_exact_rotor
        )


def invariants_error(results: Results) -> float:
    """Largest relative error of L along the lab's axes and of |L|, and orthogonality error; not of
    the energy."""
    errors = results.summary["largest_relative_error"] | {"energy": 0.0}
    return max(results.summary["largest_orthogonality_error"], *errors.values())


@case(12, "error of |L|, relative")
def long_run(quick: bool) -> Trials:
    """One body for 1e8 steps: growth of the errors of |L|, of QᵀQ and of the energy.

    A random walk grows as steps^0.5, a drift as steps^1.
    """
    steps = 1_000_000 if quick else 100_000_000
    run = partial(
        run_scene,
        free((1.0, 1.7, 2.4)),
        steps=steps,
        samples=2000,
        error=lambda results: np.abs(results["L_size_error"]).max(),
        remark=growth_of_errors,
    )
    yield Trial(f"{steps:.0e} steps", run, 0.1, 1e-15 * steps**0.75, ORDER_2)


def growth_of_errors(results: Results) -> str:
    columns = {"|L|": "L_size", "QᵀQ": "orthogonality", "energy": "energy"}
    growths = [
        f"{symbol}: {describe_growth(results[f'{column}_error'])}"
        for symbol, column in columns.items()
    ]
    return "; ".join(growths)


def describe_growth(errors: np.ndarray) -> str:
    """Largest size and exponent of the growth of errors (t,) at regular times.

    The exponent is the slope of a line through the logarithms of the root mean square over windows.
    """
    errors = np.abs(errors[1:])
    edges = np.unique(np.geomspace(8, len(errors), 9).astype(int))
    rms = np.array([np.sqrt(np.mean(errors[:edge] ** 2)) for edge in edges])
    if not rms.all():
        return f"{errors[-1]:.1e} at the end"
    power = np.polyfit(np.log(edges), np.log(rms), 1)[0]
    kind = "bounded" if power < 0.25 else "a random walk" if power < 0.75 else "linear"
    return f"{errors.max():.1e} at most, growing as steps^{power:.2f}: {kind}"


@case(5, "error of the centre of mass after 0.5 s (m)")
def fast_heavy_top(quick: bool) -> Trials:
    """The fast heavy top through its near-vertical pass, within 2.6e-13 of straight down."""
    top = SCENES["fast_top"]
    run = partial(run_scene, top, duration=0.5, error=centre_error)
    yield Trial("half a second", run, 1e-4, 1e-10, method_errors=dict.fromkeys(ORDER_2, 1e-7))
    # nearly all of its energy is spin, so the bound is a tenth of the fraction of potential energy
    potential_energy, energy = 15 * 9.81, 5435.7
    run = partial(run_scene, top, steps=400, samples=400)
    yield Trial("", run, 1e-3).limit(0.1 * potential_energy / energy)


def centre_error(results: Results) -> float:
    """Largest difference of a coordinate from the centre of mass of Bruls & Cardona, m."""
    known = [-0.7024682970565856, -0.02116518470192333, -0.7114002576517344]
    return np.abs(np.array([results[k][-1] for k in "xyz"]) - known).max()


@case(5, "log of the largest tilt, against theory")
def sleeping_top(quick: bool) -> Trials:
    """The sleeping top at 1 +- 1e-6 (and more) of its threshold: it falls below, and stays upright
    above.

    Upright at rest but for omega_1 = e: theta = e t sinh(r t)/(r t) with r² = M g l/I1 - (L3/2
    I1)², the sine above.
    """
    nudge = 1e-9
    for gap in (1e-4, -1e-4) if quick else (1e-3, -1e-3, 1e-6, -1e-6):
        rate = abs(1 - (1 + gap) ** 2) ** 0.5
        largest = nudge / rate * (np.sinh(8.0) if gap < 0 else 1.0)
        omega = [nudge, 0.0, 4.0 * (1 + gap)]
        tables = SCENES["upright_top"] | {"start": {"angular_velocity_body_rad_s": omega}}
        error = partial(tilt_error, largest)
        run = partial(run_scene, tables, duration=8 / rate, samples=2000, error=error)
        setting = f"1 {gap:+.0e}"
        # the error of a step shifts the threshold by about its square for order 2
        short_step = (0.02 if quick else 0.1) * abs(gap) ** 0.5
        yield Trial(setting, run, short_step, 0.05, ORDER_2)
        yield Trial(setting, run, 0.05, 0.05, HIGHER_ORDER[: 1 if quick else None])


def tilt_error(largest: float, results: Results) -> float:
    return abs(np.log(results["theta"].max() / largest))


@case(5, "error of Q")
def poles(quick: bool) -> Trials:
    """theta exactly 0 and pi in every formulation: right, or refused if Euler angles have no rates
    there."""
    spin, span = 5.0, 3.0
    for theta, tilt in ((0.0, np.eye(3)), (180.0, np.diag([1.0, -1.0, -1.0]))):
        omega = [0.0, 0.0, spin]
        start = {"euler_angles_deg": [0.0, theta, 0.0], "angular_velocity_body_rad_s": omega}
        tables = SCENES["upright_top"] | {"start": start}
        rotation = tilt @ from_vector(np.array([0.0, 0.0, spin * span]))
        setting = f"theta = {theta:g}°"
        yield attitude(setting, tables, rotation, 1e-11, 0.01, span)
        for solver in SOLVERS:
            expected = RIGHT_OR_REFUSED if "euler" in solver else (RIGHT,)
            changes = {"integrators": [solver], "expected": expected}
            yield attitude(setting, tables, rotation, 1e-6, 0.01, span, **changes)


DECAY_STEPS = 20
#: Time of each sample of a decay, s: one per step.
DECAY_TIMES = np.arange(DECAY_STEPS + 1.0)


def strengths(quick: bool) -> list[float]:
    """c dt / I."""
    return [1e-12, 1e-2, 1.0, 1e6] if quick else [10.0**k for k in range(-12, 7)]


def decay(
    setting: str,
    tables: dict[str, Any],
    error: Callable[[Results], float],
    allowed: float = 1e-14 * DECAY_STEPS,
    integrators: tuple[str, ...] = (SPLIT,),
) -> Trial:
    run = partial(run_scene, tables, steps=DECAY_STEPS, samples=DECAY_STEPS, error=error)
    return Trial(setting, run, 1.0, allowed, integrators)


def decay_error(column: str, known: np.ndarray, results: Results) -> float:
    """Error of a column against a decay, relative to its start; infinite if it changes sign or
    grows."""
    values = results[column]
    changes_sign = np.sign(values) * np.sign(known) < 0
    grows = np.diff(np.abs(values)) > 1e-15 * abs(values[0])
    if changes_sign.any() or grows.any():
        return inf
    return np.abs(values - known).max() / abs(values[0])


@case(6, "error of omega, relative; infinite if it overshoots")
def friction(quick: bool) -> Trials:
    """Viscous and dry friction with c dt / I from 1e-12 to 1e6: exact decay, never past zero."""
    spinning = free((2.0, 2.0, 1.0), (0.0, 0.0, 1.0))
    for c in strengths(quick):
        kinds = {
            "viscous": ("viscous_N_m_s", np.exp(-c * DECAY_TIMES)),
            "dry": ("dry_N_m", np.maximum(0.0, 1.0 - c * DECAY_TIMES)),
        }
        for kind, (key, known) in kinds.items():
            tables = spinning | {"friction": {key: [0.0, 0.0, c]}}
            error = partial(decay_error, "omega_body_3", known)
            # others would be of order 2 with resistance, so scenes refuse them
            yield decay(f"{kind}, {c:.0e}", tables, error, integrators=ORDER_2)


@case(6, "error of v, relative; infinite if it overshoots")
def fluid(quick: bool) -> Trials:
    """Linear resistance with c dt / m from 1e-12 to 1e6: exact decay and fall; quadratic: never
    past zero."""
    point = {"body": {"mass_kg": 1.0}}
    moving = point | {"start": {"velocity_m_s": [1.0, 0.0, 0.0]}}
    for c in strengths(quick):
        linear = {"fluid": {"linear_resistance_kg_s": [c] * 3}}
        error = partial(decay_error, "vx", np.exp(-c * DECAY_TIMES))
        yield decay(f"linear, {c:.0e}", moving | linear, error)
        quadratic = {"fluid": {"quadratic_resistance_kg_m": [c] * 3}}
        error = partial(decay_error, "vx", 1 / (1 + c * DECAY_TIMES))
        # of order 2 in c dt: right where the step resolves it, and never past zero anywhere
        allowed = max(1e-13, 0.1 * min(c * c, 5.0))
        yield decay(f"quadratic, {c:.0e}", moving | quadratic, error, allowed)
        # kick, drift, kick are exact for a constant force
        error = partial(fall_error, 9.81 * expm1(-c * DECAY_STEPS) / c)
        yield decay(f"falling, {c:.0e}", point | {"gravity": {}} | linear, error, 1e-13)


def fall_error(speed: float, results: Results) -> float:
    return abs(results["vz"][-1] / speed - 1)
