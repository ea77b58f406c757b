"""The closed forms of `known` against numerical integration and against published numbers."""

import json

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from support import known


def integrated(rhs, y0, times):
    """(n, len(y0)) by DOP853 at the tightest tolerance."""
    out = solve_ivp(rhs, (0.0, times[-1]), y0, "DOP853", t_eval=times, rtol=1e-13, atol=1e-14)
    assert out.success
    return out.y.T


def gyrostat(
    inertia,
    rotation0,
    omega0,
    times,
    arm=(0, 0, 0),
    rotor=(0, 0, 0),
    force=(0, 0, 0),
    frame=(0, 0, 0),
):
    """(omega, Q) of I w' = (I w + rotor) x w + arm x Q^T force, Q' = Q hat(w) - hat(frame) Q,
    integrated."""
    i, h, r, f, s = (np.asarray(x, float) for x in (inertia, rotor, arm, force, frame))

    def cross(a, b):
        return np.array(
            [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
        )

    def rhs(_, y):
        w, q = y[:3], y[3:].reshape(3, 3)
        seen = w - s @ q  # rate relative to the frame, in the body
        turning = np.stack([cross(row, seen) for row in q])  # the lab's axes in the body
        return np.concatenate([(cross(i * w + h, w) + cross(r, f @ q)) / i, turning.ravel()])

    y = integrated(rhs, np.concatenate([np.asarray(omega0, float), np.ravel(rotation0)]), times)
    return y[:, :3], y[:, 3:].reshape(-1, 3, 3)


def heavy(i1, i3, mgl, theta0, rates, times):
    """(omega, Q) of a symmetric top from Euler rates, phi = psi = 0."""
    phi, theta, psi = rates
    s, c = np.sin(theta0), np.cos(theta0)
    rotation0 = known.turn((1, 0, 0), theta0)
    return gyrostat(
        (i1, i1, i3),
        rotation0,
        (theta, phi * s, psi + phi * c),
        times,
        (0, 0, 1),
        force=(0, 0, -mgl),
    )


START = known.euler_rotation(0.7, 1.1, -2.3)


def quoted(text):
    """The first bracketed list of numbers in a text."""
    return [float(x) for x in text[text.index("(") + 1 : text.index(")")].split(",")]


@pytest.fixture(scope="module")
def numbers(reference):
    return json.loads((reference / "singlebody" / "REFERENCE.json").read_text())


# Free bodies


@pytest.mark.parametrize(
    "omega0", [(1.0, -2.0, 3.0), (0.3, 0.2, 0.0), (0.0, 0.0, -2.0), (1e-8, 0.0, 4.0), (0, 0, 0)]
)
@pytest.mark.parametrize("i3", [0.3, 2.0, 3.7])
def test_free_symmetric_top(i3, omega0):
    times = np.linspace(0, 10, 11)
    omega, rotation = known.free_symmetric_top(2.0, i3, omega0, times, START)
    want = gyrostat((2.0, 2.0, i3), START, omega0, times)
    np.testing.assert_allclose(omega, want[0], atol=1e-11)
    np.testing.assert_allclose(rotation, want[1], atol=1e-11)
    # the asymmetric formula in its limit, axes moved about
    other = known.free_asymmetric_top((2.0, 2.0, i3), START, omega0, times)
    np.testing.assert_allclose(other[0], omega, atol=1e-13)
    np.testing.assert_allclose(other[1], rotation, atol=1e-13)


def test_free_symmetric_top_of_principia(numbers):
    case = numbers["symmetric_top_precession"]["ShortFat"]
    inertia, l0 = np.array(case["I"], float), np.array(case["L0"], float)
    times = np.linspace(0, 20, 41)
    omega, rotation = known.free_symmetric_top(inertia[0], inertia[2], l0 / inertia, times, START)
    rate = 7 * (3 - 9) / (3 * 9)
    want = np.stack([5 * np.sin(rate * times), 5 * np.cos(rate * times), 7 + 0 * times], axis=1)
    np.testing.assert_allclose(inertia * omega, want, atol=1e-13)
    np.testing.assert_allclose(
        np.einsum("nij,nj->ni", rotation, inertia * omega) - START @ l0, 0, atol=1e-13
    )
    case = numbers["symmetric_top_precession"]["TallSkinny"]
    inertia, l0 = np.array(case["I"], float), np.array(case["L0"], float)
    omega, _ = known.free_asymmetric_top(inertia, START, l0 / inertia, times)
    want = np.stack([7 + 0 * times, -5 * np.sin(rate * times), 5 * np.cos(rate * times)], axis=1)
    np.testing.assert_allclose(inertia * omega, want, atol=1e-13)


FREE = {
    "above": ((1.0, 2.0, 3.0), (0.3, 0.5, 2.0)),
    "below": ((1.0, 2.0, 3.0), (2.0, 0.5, -0.3)),
    "unsorted": ((2.5, 1.0, 1.7), (-0.4, 0.9, 1.3)),
    "unsorted, below": ((3.0, 1.0, 2.0), (0.2, -1.5, 0.1)),
    "flips": ((1.0, 2.0, 3.0), (1e-2, 1.0, 0.0)),
    "flips the other way": ((1.0, 2.0, 3.0), (0.0, -1.0, 1e-4)),
    "almost steady": ((2.0, 3.0, 1.0), (1e-9, 2.0, 1e-7)),
    "almost symmetric": ((1.0, 1.0 + 1e-9, 2.0), (1.0, 1.0, 1.0)),
    "separatrix": ((1.0, 2.0, 3.0), (np.sqrt(3.0) / 8, 1.0, 1 / 8)),
}


@pytest.mark.parametrize("name", FREE)
def test_free_asymmetric_top(name):
    inertia, omega0 = FREE[name]
    times = np.linspace(0, 12, 25)
    omega, rotation = known.free_asymmetric_top(inertia, START, omega0, times)
    want = gyrostat(inertia, START, omega0, times)
    np.testing.assert_allclose(omega, want[0], atol=3e-12)
    np.testing.assert_allclose(rotation, want[1], atol=3e-12)


@pytest.mark.parametrize("name", FREE)
def test_free_asymmetric_top_over_many_periods(name):
    inertia, omega0 = FREE[name]
    period = known.free_asymmetric_period(inertia, omega0)
    times = np.array([0.0, 0.25, 0.5, 100.0, 100.25, 100.5, -37.0]) * min(period, 100.0)
    omega, rotation = known.free_asymmetric_top(inertia, START, omega0, times)
    np.testing.assert_allclose(
        rotation @ np.swapaxes(rotation, 1, 2), np.tile(np.eye(3), (7, 1, 1)), atol=1e-14
    )
    momentum = np.asarray(inertia) * omega
    np.testing.assert_allclose(
        np.einsum("nij,nj->ni", rotation, momentum) - START @ momentum[0], 0, atol=3e-14
    )
    np.testing.assert_allclose(np.sum(momentum * omega, axis=1), momentum[0] @ omega[0], rtol=3e-15)
    np.testing.assert_allclose(omega[0], omega0, atol=1e-15)
    if period < 100:
        np.testing.assert_allclose(omega[[3, 4, 5, 6]], omega[[0, 1, 2, 0]], atol=1e-11)
        # every period rotates Q by the same lab rotation, a hundred by its hundredth power
        once = known.free_asymmetric_top(inertia, START, omega0, [period])[1][0] @ START.T
        np.testing.assert_allclose(
            np.linalg.matrix_power(once, 100) @ START, rotation[3], atol=1e-12
        )


def test_free_asymmetric_period_and_flip():
    assert known.flip_interval((1, 2, 3), (1e-2, 1, 0)) == pytest.approx(
        20.7546097646692, rel=1e-14
    )
    assert known.free_asymmetric_period((3, 1, 2), (0, 0, 1)) == np.inf  # on the intermediate axis
    assert known.free_asymmetric_period((2, 2, 2), (1, 2, 3)) == np.inf
    for inertia, omega0, near in [
        ((1, 2, 3), (0, 0, 2.0), (1e-9, 0, 2.0)),
        ((3, 1, 2), (0, -2.0, 0), (1e-9, -2.0, 0)),
        ((2, 2, 5), (0, 0, 2.0), (1e-9, 0, 2.0)),
    ]:
        period = known.free_asymmetric_period(inertia, omega0)
        assert period == pytest.approx(known.free_asymmetric_period(inertia, near), rel=1e-14)
    assert known.free_asymmetric_period((2, 2, 5), (1, 0, 2.0)) == pytest.approx(
        2 * np.pi / (2 * 3 / 2), rel=1e-15
    )
    omega, rotation = known.free_asymmetric_top((3, 1, 2), START, (0, 0, 1.5), np.array([2.0]))
    np.testing.assert_allclose(rotation[0], START @ known.turn((0, 0, 1), 3.0), atol=1e-15)
    np.testing.assert_array_equal(omega, [[0, 0, 1.5]])


def test_free_bodies_of_the_literature(numbers):
    half, s, c = known.amplitude(20.0, 0.49)
    sign = 1 - 2 * (half % 2)
    sn_cn_dn = [sign * s, sign * c, np.sqrt(1 - 0.51 * s**2)]
    np.testing.assert_allclose(sn_cn_dn, quoted(numbers["free_body_jacobi"]["y_at_20"]), atol=1e-14)
    assert known.quarter_period(0.49) == pytest.approx(1.862640802332738552, rel=1e-15)
    # Hairer, Norsett, Wanner: y is the omega of moments 1 : 4 : 6
    omega, _ = known.free_asymmetric_top((1, 4, 6), START, (1, 0, 0.9), np.array([20.0]))
    np.testing.assert_allclose(omega[0], quoted(numbers["free_body_HNW"]["y_at_20"]), atol=5e-9)
    case = numbers["free_body_Bajars"]
    inertia = np.array(case["I"])
    omega, _ = known.free_asymmetric_top(
        inertia, START, np.array([np.cos(1.1), 0, np.sin(1.1)]) / inertia, [100.0]
    )
    np.testing.assert_allclose(inertia * omega[0], quoted(case["L_at_100"]), atol=5e-9)


# Lagrange's top: I1, I3, mgl, theta0, (phi', theta', psi'), time

TOPS = {
    "cusps": (1.0, 0.6, 2.0, 1.0, (0.0, 0.0, 8.0), 12.0),
    "waves": (1.0, 0.6, 2.0, 1.0, (0.45, 0.1, 8.0), 12.0),
    "loops": (1.0, 0.6, 2.0, 1.0, (-0.6, 0.3, 8.0), 12.0),
    "downward start": (1.0, 0.6, 2.0, 1.0, (0.1, 2.0, 4.0), 12.0),
    "upward start": (1.0, 0.6, 2.0, 2.0, (0.1, -2.0, -4.0), 12.0),
    "fast": (1.0, 0.6, 2.0, 1.2, (0.0, 0.0, 300.0), 1.0),
    "past the upper vertical": (1.0, 0.6, 2.0, 0.02, (0.0, 0.1, 4.0), 12.0),
    "past the lower vertical": (1.0, 0.6, 2.0, 2.0, (-0.2, 0.0, 0.1), 12.0),
    "spherical pendulum": (1.0, 0.3, 2.0, 2.0, (0.7, 0.4, -0.7 * np.cos(2.0)), 12.0),
    "leaves the vertical": (1.0, 0.6, 2.0, 0.0, (0.0, 0.3, 3.0), 12.0),
    "spherical body": (1.0, 1.0, 2.0, 1.0, (0.3, 0.3, 3.0), 12.0),
}


@pytest.mark.parametrize("name", TOPS)
def test_lagrange_top(name):
    i1, i3, mgl, theta0, rates, end = TOPS[name]
    top = known.LagrangeTop(i1, i3, mgl, theta0, *rates)
    times = np.linspace(0, end, 49)
    omega, rotation = heavy(i1, i3, mgl, theta0, rates, times)
    got = top.rotation(times)
    tight = 1e-11
    np.testing.assert_allclose(top.axis(times), got[:, :, 2], atol=1e-15)
    np.testing.assert_allclose(got, rotation, atol=tight)
    momentum = np.array([i1, i1, i3]) * omega
    assert top.energy == pytest.approx(
        0.5 * momentum[0] @ omega[0] + mgl * rotation[0, 2, 2], rel=1e-14
    )
    assert top.l_3 == pytest.approx(momentum[0, 2], rel=1e-14, abs=1e-15)
    assert top.l_z == pytest.approx(rotation[0, 2] @ momentum[0], rel=1e-14)
    least, greatest = top.theta_limits
    np.testing.assert_allclose([np.cos(greatest), np.cos(least)], top.roots[:2], atol=1e-15)
    seen = top.theta(np.linspace(0, top.period, 2001))
    assert least <= seen.min() < least + 1e-3 and greatest - 1e-3 < seen.max() <= greatest
    far = 1000 * top.period
    assert top.theta([far])[0] == pytest.approx(theta0, abs=1e-10)
    assert top.phi([far])[0] == pytest.approx(far * top.mean_precession, rel=1e-11, abs=1e-9)


def test_lagrange_top_rates():
    """The limits of small nutation and the reality of cusps; the mean precession of a fast top is M
    / L3 (1 + ...)."""
    i1, i3, mgl, theta0 = 1.0, 0.6, 2.0, 1.0
    slow, fast = known.steady_precession_rates(i1, i3 * 8.0, mgl, theta0)
    for rate in (slow, fast):
        assert i1 * np.cos(theta0) * rate**2 - i3 * 8.0 * rate + mgl == pytest.approx(0, abs=1e-13)
        top = known.LagrangeTop(i1, i3, mgl, theta0, rate, 0.0, 8.0 - rate * np.cos(theta0))
        np.testing.assert_allclose(top.theta(np.linspace(0, 50, 11)), theta0, atol=1e-14)
        np.testing.assert_allclose(
            top.phi(np.linspace(0, 50, 11)), rate * np.linspace(0, 50, 11), atol=1e-12
        )
        assert top.mean_precession == pytest.approx(rate, rel=1e-13)
    horizontal = known.steady_precession_rates(i1, 5.0, mgl, np.pi / 2)
    assert horizontal[0] == pytest.approx(0.4, rel=1e-15)
    assert (
        known.steady_precession_rates(i1, -5.0, mgl, 1.0)[0]
        == -known.steady_precession_rates(i1, 5.0, mgl, 1.0)[0]
    )
    assert np.isnan(known.steady_precession_rates(i1, 0.5, mgl, 0.1)).all()
    top = known.LagrangeTop(i1, i3, mgl, theta0, 0.0, 0.0, 8.0)
    assert top.theta_limits[0] == pytest.approx(theta0, rel=1e-15)
    assert top.l_z - top.l_3 * top.roots[1] == pytest.approx(0, abs=1e-15)  # phi' = 0 at the cusp
    for spin in (1e3, 1e5):
        top = known.LagrangeTop(i1, i3, mgl, theta0, 0.0, 0.0, spin)
        assert top.mean_precession * i3 * spin / mgl == pytest.approx(1.0, abs=10 / spin**2 * 10)
        assert top.period * i3 * spin / i1 == pytest.approx(2 * np.pi, rel=100 / spin**2)


def test_lagrange_top_asleep_and_as_a_pendulum():
    limit = known.sleeping_limit(1.0, 2.0)
    assert limit == pytest.approx(np.sqrt(8.0), rel=1e-15)
    times = np.linspace(0, 5, 11)
    for factor in (0.9, 1.1):
        top = known.LagrangeTop(1.0, 0.6, 2.0, 0.0, 0.0, 0.0, factor * limit / 0.6)
        np.testing.assert_allclose(top.theta(times), 0.0, atol=1e-15)
        near = known.LagrangeTop(1.0, 0.6, 2.0, 1e-6, 0.0, 0.0, factor * limit / 0.6)
        assert (near.theta_limits[1] < 1e-5) == (factor > 1)
        assert near.theta_limits[0] == pytest.approx(1e-6, rel=1e-12)
    asleep = known.LagrangeTop(1.0, 0.6, 2.0, 0.0, 0.0, 0.0, 7.0).rotation(times)
    np.testing.assert_allclose(asleep, known.turn((0, 0, 1), 7.0 * times), atol=1e-14)
    # no spin: a pendulum through the lowest point, and one over the top
    for theta0, rate in ((2.0, 0.0), (2.0, 0.5), (1.0, 3.0), (np.pi / 2, -3.0)):
        top = known.LagrangeTop(1.0, 0.6, 2.0, theta0, 0.0, rate, 0.0)
        want = integrated(
            lambda _, y: [y[1], 2.0 * np.sin(y[0])], [theta0, rate], np.linspace(0, 12, 25)
        )
        got = top.rotation(np.linspace(0, 12, 25))
        np.testing.assert_allclose(got, known.turn((1, 0, 0), want[:, 0]), atol=1e-11)
    top = known.LagrangeTop(1.0, 0.6, 2.0, np.pi - 1e-4, 0.0, 0.0, 0.0)
    assert 2 * top.period == pytest.approx(2 * np.pi / np.sqrt(2.0), rel=1e-8)


def test_fast_heavy_top(numbers):
    """Bruls & Cardona: past 2.6e-13 of straight down. Its axis is body axis 2, horizontal at the
    start."""
    case = numbers["heavy_top_short"]
    rate, spin = case["w0_body"][2], case["w0_body"][1]
    top = known.LagrangeTop(15.234375, 0.46875, 15 * 9.81, np.pi / 2, rate, 0.0, spin)
    assert top.energy == pytest.approx(5435.696790865546875, rel=1e-15)
    assert top.period == pytest.approx(0.745206947616769, rel=1e-14)
    assert top._low == pytest.approx(2.6e-13, rel=0.1)
    x, y, z = top.axis(np.array([0.5]))[0]  # along -y at phi = 0, theirs along +y
    want = (-0.7024682970565856, -0.02116518470192333, -0.7114002576517344)
    np.testing.assert_allclose((-x, -y, z), want, atol=3e-13)


# Frames that rotate


@pytest.mark.parametrize("size", [0.0, 7.292e-5, 0.3, 2.0])
def test_rotating_fall(size):
    spin, g = size * np.array([0.0, np.cos(0.8), np.sin(0.8)]), np.array([0.02, -0.01, -9.81])
    x0, v0, times = np.array([1.0, -2.0, 30.0]), np.array([0.5, 3.0, 1.0]), np.linspace(0, 3, 13)
    x, v = known.rotating_fall(spin, g, x0, v0, times)
    hat = np.cross(np.eye(3), spin)
    assert np.allclose(hat @ x0, np.cross(spin, x0))
    big = np.zeros((7, 7))
    big[:3, 3:6], big[3:6, :3], big[3:6, 3:6], big[3:6, 6] = np.eye(3), -hat @ hat, -2 * hat, g
    want = np.array([expm(big * t) @ np.concatenate([x0, v0, [1.0]]) for t in times])
    np.testing.assert_allclose(x, want[:, :3], atol=2e-13)
    np.testing.assert_allclose(v, want[:, 3:6], atol=2e-13)

    def rhs(_, y):
        return np.concatenate(
            [y[3:], g - 2 * np.cross(spin, y[3:]) - np.cross(spin, np.cross(spin, y[:3]))]
        )

    want = integrated(rhs, np.concatenate([x0, v0]), times)
    np.testing.assert_allclose(np.concatenate([x, v], axis=1), want, atol=1e-11)


def test_eastward_drift():
    """From rest: W g t^3 cos(latitude) / 3 to the east, for a frame that rotates slowly."""
    spin, latitude, t = 7.292e-5, 0.8, 4.0
    axis = spin * np.array([0.0, np.cos(latitude), np.sin(latitude)])
    x, _ = known.rotating_fall(axis, (0, 0, -9.81), (0, 0, 0), (0, 0, 0), [t])
    assert x[0, 0] == pytest.approx(spin * 9.81 * t**3 * np.cos(latitude) / 3, rel=1e-7)


COMPASS = {
    "ship": ((0.05, 0.04, 0.045), 12.0, 1.5, 7.292e-5, 0.8),
    "fast frame": ((0.05, 0.04, 0.045), 12.0, 60.0, 0.5, 0.8),
    "slow rotor": ((0.05, 0.04, 0.045), 0.3, 6.0, 0.2, -0.4),
}


@pytest.mark.parametrize("name", COMPASS)
def test_gyrocompass_linear(name):
    """The whole equations, linearised by differences about rest, have that period."""
    inertia, h, mgl, spin, latitude = COMPASS[name]
    tilt = known.gyrocompass_rest(inertia, h, mgl, spin, latitude)
    north, up = np.array([0, 1.0, 0]), np.array([0, 0, 1.0])
    first, third = (
        np.cos(tilt) * north + np.sin(tilt) * up,
        np.cos(tilt) * up - np.sin(tilt) * north,
    )
    rest = np.stack([first, [-1, 0, 0], third], axis=1)
    frame = spin * np.array([0, np.cos(latitude), np.sin(latitude)])
    i = np.array(inertia)

    def rhs(y):
        e, w = y[:3], y[3:]
        q = rest @ expm(np.cross(np.eye(3), e)) if e.any() else rest
        seen = w - frame @ q
        torque = np.cross([0, 0, -1], np.array([0, 0, -mgl]) @ q)
        return np.concatenate(
            [seen + np.cross(e, seen) / 2, (np.cross(i * w + [h, 0, 0], w) + torque) / i]
        )

    start = np.concatenate([np.zeros(3), frame @ rest])
    np.testing.assert_allclose(rhs(start), 0, atol=1e-12)
    step = 1e-4
    jacobian = np.stack(
        [(rhs(start + d) - rhs(start - d)) / (2 * step) for d in step * np.eye(6)], axis=1
    )
    rates = np.abs(np.linalg.eigvals(jacobian).imag)
    period = known.gyrocompass_period_linear(inertia, h, mgl, spin, latitude)
    assert period == pytest.approx(2 * np.pi / rates.min(), rel=1e-6)
    simple = known.gyrocompass_period(h, mgl, spin, latitude)
    corrected = simple * np.sqrt(
        (1 + inertia[2] * mgl / h**2) / (1 + h * spin * np.cos(latitude) / mgl)
    )
    assert abs(corrected / period - 1) < 0.1 * abs(simple / period - 1)


def test_gyrocompass_swings():
    """The whole motion, from a small azimuth: it is back after the period."""
    inertia, h, mgl, spin, latitude = COMPASS["fast frame"]
    period = known.gyrocompass_period_linear(inertia, h, mgl, spin, latitude)
    tilt = known.gyrocompass_rest(inertia, h, mgl, spin, latitude)
    rest = np.array(
        [[0, -1.0, 0], [np.cos(tilt), 0, -np.sin(tilt)], [np.sin(tilt), 0, np.cos(tilt)]]
    )
    frame = spin * np.array([0, np.cos(latitude), np.sin(latitude)])
    rotation0 = known.turn((0, 0, 1), -1e-4) @ rest
    times = np.linspace(0, 2 * period, 4001)
    _, rotation = gyrostat(
        inertia, rotation0, frame @ rotation0, times, (0, 0, -1), (h, 0, 0), (0, 0, -mgl), frame
    )
    azimuth = np.arctan2(rotation[:, 0, 0], rotation[:, 1, 0])
    waves = np.stack([f(2 * np.pi * times / period) for f in (np.cos, np.sin)], axis=1)
    fit, *_ = np.linalg.lstsq(waves, azimuth, rcond=None)
    assert fit[0] == pytest.approx(1e-4, rel=0.01)
    assert np.abs(azimuth - waves @ fit).max() < 1e-6  # what is left is the fast nutation


# Resistance, wheels, limbs


def test_terminal_speed():
    assert known.terminal_speed(6.0, 1.0, 1.0) == pytest.approx(2.0, rel=1e-15)
    assert known.terminal_speed(6.0, 2.0, 0.0) == 3.0
    assert known.terminal_speed(8.0, 0.0, 2.0) == pytest.approx(2.0, rel=1e-15)
    speed = integrated(lambda _, v: 5.0 - 0.7 * v - 0.3 * v**2, [0.0], np.array([0.0, 30.0]))[-1, 0]
    assert known.terminal_speed(5.0, 0.7, 0.3) == pytest.approx(speed, rel=1e-12)


@pytest.mark.parametrize(
    ("viscous", "dry"), [(0.3, 0.2), (0.0, 0.2), (0.3, 0.0), (1e-9, 0.2), (0.0, 0.0)]
)
def test_coasting_spin(viscous, dry):
    stop = known.coasting_stop(2.0, viscous, dry, 5.0)
    times = np.linspace(0, 0.999 * min(stop, 20.0), 9)
    want = integrated(lambda _, w: (-viscous * w - dry) / 2.0, [5.0], times)[:, 0]
    np.testing.assert_allclose(known.coasting_spin(2.0, viscous, dry, 5.0, times), want, atol=1e-11)
    back = known.coasting_spin(2.0, viscous, dry, -5.0, times)
    np.testing.assert_array_equal(back, -known.coasting_spin(2.0, viscous, dry, 5.0, times))
    if dry:
        last = known.coasting_spin(2.0, viscous, dry, 5.0, np.array([stop * (1 - 1e-9), 2 * stop]))
        assert 0 < last[0] < 1e-7 and last[1] == 0


def test_wheel_rotation():
    times = np.linspace(0, 5, 11)
    late = integrated(lambda t, y: [y[1], -0.3 / 4.0 if t < 2 else 0.0], [0.0, 0.0], times[:5])[
        :, 0
    ]
    got = known.wheel_turn(4.0, 0.3, 2.0, times)
    np.testing.assert_allclose(got[:5], late, atol=1e-13)
    np.testing.assert_allclose(np.diff(got[4:]), -0.3 * 2.0 / 4.0 * 0.5, rtol=1e-13)


def test_changing_inertia_spin():
    def inertia(t):
        return 3.0 + np.cos(t)

    np.testing.assert_allclose(
        known.changing_inertia_spin(6.0, inertia, [0.0, np.pi]), [1.5, 3.0], rtol=1e-15
    )
