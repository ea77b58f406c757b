"""Known answers of stability cases: single bodies, free at every speed, tops, friction, fluids."""

from collections.abc import Iterator
from math import expm1, inf, log, sinh

import numpy as np
from scipy.integrate import solve_ivp

from rigidmd.features.bodies.theory import free_body_period
from rigidmd.features.studies.stability.cases import Trial, builder
from rigidmd.mechanics.rotation import from_euler_angles, from_quaternion, from_vector
from rigidmd.run.results import Results

Trials = Iterator[Trial]


@builder
def rotation(trial: Trial, x: float) -> Trials:
    """The largest entry of |Q - Q_known| at the end."""
    start = trial.scene["start"]
    inertia = np.array(trial.scene["body"]["inertia_kg_m2"])
    omega = np.array(start["angular_velocity_body_rad_s"])
    angles = np.radians(start.get("euler_angles_deg", [0.0, 0.0, 0.0]))
    rounding = 0.0
    if np.cross(omega, inertia * omega).any():
        after_span = free_rotation(inertia, omega, trial.span)
        # L is exact to rounding, so omega about an axis with little inertia only to that times the
        # ratio of the moments
        steps = trial.span / trial.step
        rounding = 4 * np.finfo(float).eps * steps**0.5 * inertia.max() / inertia.min()
    else:
        after_span = from_vector(omega * trial.span)
    known = from_euler_angles(angles) @ after_span

    def error(results: Results) -> float:
        return np.abs(results["Q"][-1] - known).max()

    yield trial._replace(error=error, rounding=rounding)


def free_rotation(inertia: np.ndarray, omega: np.ndarray, span: float) -> np.ndarray:
    """Q of a free body at the end, by DOP853 on Euler's equations and a quaternion. Its error is
    1e-13 per radian."""
    i1, i2, i3 = inertia.tolist()
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

    start = [*omega, 1.0, 0.0, 0.0, 0.0]
    solution = solve_ivp(rates, (0.0, span), start, "DOP853", rtol=1e-13, atol=1e-14)
    return from_quaternion(solution.y[3:, -1])


@builder
def invariants(trial: Trial, x: float) -> Trials:
    """The largest relative error of L along the lab's axes and of |L|, and orthogonality error. Not
    of the energy."""

    def error(results: Results) -> float:
        errors = results.summary["largest_relative_error"] | {"energy": 0.0}
        return max(results.summary["largest_orthogonality_error"], *errors.values())

    yield trial._replace(error=error)


@builder
def first_flip(trial: Trial, off: float) -> Trials:
    """The time of the first flip of a body that rotates about its middle axis, I = (1, 2, 3).

    Only the first is compared: later flips are earlier, because rounding of omega leaves the body
    1e-8 off the axis.
    """
    inertia = np.array(trial.scene["body"]["inertia_kg_m2"])
    known = free_body_period(inertia, np.array([off, 1.0, 0.0])) / 4
    growth_rate = 3**-0.5  # of the distance from the axis, sqrt((I2 - I1)(I3 - I2)/(I1 I3))
    span = 10 * max(known, log(1e8) / growth_rate)

    def error(results: Results) -> float:
        return abs([*flip_times(results), inf][0] / known - 1)

    def remark(results: Results) -> str:
        return f"{len(flip_times(results))} flips"

    samples = int(span / 0.1)
    yield trial._replace(duration=span, samples=samples, error=error, remark=remark)


def flip_times(results: Results) -> np.ndarray:
    """Times at which omega about the middle axis is 0."""
    spin, time = results["omega_body_2"], results["time"]
    before = np.flatnonzero(np.diff(np.sign(spin)))
    fraction = spin[before] / (spin[before] - spin[before + 1])
    return time[before] + fraction * (time[before + 1] - time[before])


@builder
def growth_of_errors(trial: Trial, x: float) -> Trials:
    columns = {"|L|": "L_size_error", "QᵀQ": "orthogonality_error", "energy": "energy_error"}

    def error(results: Results) -> float:
        return np.abs(results["L_size_error"]).max()

    def remark(results: Results) -> str:
        growths = [f"{name}: {describe_growth(results[key])}" for name, key in columns.items()]
        return "; ".join(growths)

    yield trial._replace(error=error, remark=remark)


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


@builder
def fast_top(trial: Trial, x: float) -> Trials:
    """The centre of mass at 0.5 s in the benchmark of Bruls & Cardona, m."""
    known = [-0.7024682970565856, -0.02116518470192333, -0.7114002576517344]

    def error(results: Results) -> float:
        return np.abs(np.array([results[k][-1] for k in "xyz"]) - known).max()

    yield trial._replace(error=error)


@builder
def sleeping_top(trial: Trial, gap: float) -> Trials:
    """The largest tilt of a top that begins upright at rest but for omega_1 = e, at a relative gap
    from the threshold.

    theta = e t sinh(r t)/(r t) with r² = M g l/I1 - (L3/2 I1)². Above the threshold with the sine.
    """
    nudge = trial.scene["start"]["angular_velocity_body_rad_s"][0]
    rate = abs(1 - (1 + gap) ** 2) ** 0.5
    known = nudge / rate * (sinh(8.0) if gap < 0 else 1.0)

    def error(results: Results) -> float:
        return abs(log(results["theta"].max() / known))

    yield trial._replace(duration=8 / rate, error=error)


@builder
def decay(trial: Trial, c: float) -> Trials:
    """Omega or v against a decay, relative to its start. Infinite if it changes sign or grows."""
    resistances = [*trial.scene.get("friction", {}), *trial.scene.get("fluid", {})]
    times = np.arange(trial.steps + 1.0)
    column = "omega_body_3" if "friction" in trial.scene else "vx"
    known = np.exp(-c * times)
    allowed = trial.allowed
    if "dry_N_m" in resistances:
        known = np.maximum(0.0, 1.0 - c * times)
    elif "quadratic_resistance_kg_m" in resistances:
        known = 1 / (1 + c * times)
        # of order 2 in c dt: right where the step resolves it, and never past zero anywhere
        allowed = max(1e-13, 0.1 * min(c * c, 5.0))

    def error(results: Results) -> float:
        values = results[column]
        changes_sign = np.sign(values) * np.sign(known) < 0
        grows = np.diff(np.abs(values)) > 1e-15 * abs(values[0])
        overshoots = changes_sign.any() or grows.any()
        return inf if overshoots else np.abs(values - known).max() / abs(values[0])

    yield trial._replace(error=error, allowed=allowed)


@builder
def fall(trial: Trial, c: float) -> Trials:
    known = 9.81 * expm1(-c * trial.span) / c

    def error(results: Results) -> float:
        return abs(results["vz"][-1] / known - 1)

    yield trial._replace(error=error)
