"""Single rigid bodies whose motion is known in closed form: plain NumPy and SciPy, nothing of the
package.

The oracle for the dynamics of one body. Q takes body to lab; omega and L are in the body frame
unless the name states `_lab`; Euler angles are 3-1-3, Q = Rz(phi) Rx(theta) Rz(psi); gravity points
along -z; the axis of a symmetric top is body axis 3 and I1 = I2, about the pivot where there is
one. Any coherent units.

Elliptic functions are kept in the complementary parameter m1 = 1 - m, which is formed without a
difference,
so that motions near a separatrix lose nothing (scipy.special.ellipj does lose there).
"""

from decimal import Decimal, localcontext

import numpy as np
from scipy.special import elliprc, elliprf, elliprj

# Elliptic functions


def quarter_period(m1: float) -> float:
    """K(m), m1 = 1 - m. DLMF 19.25.1."""
    return float(elliprf(0.0, m1, 1.0)) if m1 > 0 else np.inf


def amplitude(u, m1: float):
    """(half rotates, s, c): am(u | m) = pi half_turns + an angle of sine s and cosine c >= 0, each
    good to its own size.

    So sn = (-1)^half_turns s, cn = (-1)^half_turns c. Gauss's transformation by the
    arithmetic-geometric mean, in cotangents, of terms of one sign (Bulirsch, Numer. Math. 7 (1965)
    78: sncndn). At m = 1 tanh and 1/cosh.
    """
    u = np.asarray(u, float)
    if m1 <= 0:
        return np.zeros_like(u), np.tanh(u), 1 / np.cosh(np.minimum(np.abs(u), 700.0))
    k = quarter_period(m1)
    half = np.round(u / (2 * k))
    v = u - 2 * k * half
    means, a, b = [], 1.0, np.sqrt(m1)
    while True:
        means.append((a, b))
        mean = (a + b) / 2
        if a - b < 1e-12 * a:
            break
        a, b = mean, np.sqrt(a * b)
    size = np.maximum(np.abs(v), 1e-100)
    ratio = np.where(
        size < k / 2, 1 / np.tan(mean * size), np.tan(mean * np.maximum(k - size, 0.0))
    )
    c, dn = mean * ratio, 1.0
    for a, b in reversed(means):
        ratio = ratio * c
        c = c * dn
        dn = (b + ratio) / (a + ratio)
        ratio = c / a
    s = np.copysign(1 / np.hypot(c, 1.0), v)
    return half, s, c * np.abs(s)


def first_kind(s, c, m1: float):
    """F(angle | m) of an angle in [-pi/2, pi/2] by its sine and cosine. DLMF 19.25.5."""
    return s * elliprf(c * c, c * c + m1 * s * s, 1.0)


def third_kind(n: float, one_minus_n: float, s, c, m: float, m1: float):
    """Pi(n; angle | m) for n < 1 and an angle in [-pi/2, pi/2], in Carlson's integrals without
    cancellation.

    DLMF 19.25.14; for n < -sqrt(m) through the change of parameter n -> m/n (DLMF 19.21.12), both
    terms positive.
    """
    x, y, p = c * c, c * c + m1 * s * s, c * c + one_minus_n * s * s
    if n >= -np.sqrt(m):
        return s * elliprf(x, y, 1.0) + n / 3 * s**3 * elliprj(x, y, 1.0, p)
    q = 1 - m / n * s * s
    return s * elliprc(x * y, p * q) - m / n / 3 * s**3 * elliprj(x, y, 1.0, q)


# Rotations


def turn(axis, angle) -> np.ndarray:
    """Right-handed rotations by `angle` (n,) about one axis (any length), (n, 3, 3). Rodrigues."""
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    hat = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = np.asarray(angle, float)[..., None, None]
    return np.eye(3) + np.sin(angle) * hat + 2 * np.sin(angle / 2) ** 2 * (hat @ hat)


def euler_rotation(phi, theta, psi) -> np.ndarray:
    """Q = Rz(phi) Rx(theta) Rz(psi)."""
    return turn((0, 0, 1), phi) @ turn((1, 0, 0), theta) @ turn((0, 0, 1), psi)


# Free bodies


def free_symmetric_top(i1, i3, omega0, times, rotation0=None):
    """(omega (n, 3), Q (n, 3, 3)) of a body with moments (i1, i1, i3) under no torque.

    Q(t) = R(L_lab, |L| t / I1) Q0 Rz((I1 - I3) omega3 t / I1); omega rotates about axis 3 at (I3 -
    I1) omega3 / I1. Landau & Lifshitz, Mechanics, sections 33 and 36.
    """
    omega0, times = np.asarray(omega0, float), np.asarray(times, float)
    rotation0 = np.eye(3) if rotation0 is None else np.asarray(rotation0, float)
    momentum = np.array([i1, i1, i3]) * omega0
    about_axis = turn((0, 0, 1), (i1 - i3) / i1 * omega0[2] * times)
    omega = np.einsum("nji,j->ni", about_axis, omega0)
    if not momentum.any():
        return omega, np.broadcast_to(rotation0, (len(times), 3, 3)).copy()
    size = np.linalg.norm(momentum)
    return omega, turn(rotation0 @ momentum, size * times / i1) @ rotation0 @ about_axis


class _FreeRotor:
    """The constants of a free asymmetric top, axes so ordered that omega3 keeps its sign.

    With L^2 and 2T of the start, every difference L^2 - 2T Ik is summed as sum_j Ij (Ij - Ik)
    omega_j^2.
    """

    def __init__(self, inertia, omega0):
        inertia, omega0 = np.asarray(inertia, float), np.asarray(omega0, float)
        self.steady = not np.cross(omega0, inertia * omega0).any()
        order = np.argsort(inertia, kind="stable")
        if self.excess(inertia, omega0, inertia[order[1]]) < 0:
            order = order[::-1]
        self.axes = np.eye(3)[order]  # rows: the new axes in the old
        self.axes[0] *= np.linalg.det(self.axes)
        self.inertia, self.omega0 = inertia[order], self.axes @ omega0
        if self.steady:
            return
        i1, i2, i3 = self.inertia
        from1, from2, from3 = (self.excess(self.inertia, self.omega0, i) for i in self.inertia)
        self.peak = np.array(
            [
                np.sqrt(from3 / (i1 * (i1 - i3))),
                -np.sqrt(from3 / (i2 * (i2 - i3))),
                np.copysign(np.sqrt(from1 / (i3 * (i3 - i1))), self.omega0[2]),
            ]
        )
        self.rate = (
            -np.sign(i3 - i1)
            * np.sign(self.omega0[2])
            * np.sqrt(from1 * (i3 - i2) / (i1 * i2 * i3))
        )
        self.m = from3 * (i1 - i2) / (from1 * (i3 - i2))
        self.m1 = (i3 - i1) * from2 / (from1 * (i3 - i2))

    @staticmethod
    def excess(inertia, omega, moment):
        """L^2 - 2T moment."""
        return float(np.sum(inertia * (inertia - moment) * omega**2))

    def quarter(self):
        """Time of a quarter period of omega."""
        if not self.steady:
            return quarter_period(self.m1) / abs(self.rate)
        i1, i2, i3 = self.inertia  # spin about one axis: the limit of a small wobble
        if np.count_nonzero(self.omega0) != 1 or not self.omega0[2]:
            return np.inf
        wobble = (i3 - i1) * (i3 - i2) / (i1 * i2)
        return np.pi / 2 / (abs(self.omega0[2]) * np.sqrt(wobble)) if wobble > 0 else np.inf


def free_asymmetric_top(inertia, rotation0, omega0, times):
    """(omega (n, 3), Q (n, 3, 3)) of a body under no torque, moments in any order, equal ones too.

    omega = (w1 cn, w2 sn, w3 dn)(u0 + rate t | m), the axes in the order that keeps omega3 from
    zero; the angle about L psi = |L| t / I3 + |L| (1/I1 - 1/I3) / rate [Pi(n; phi | m) - Pi(n; phi0
    | m)], n = I3 (I1 - I2) / (I1 (I3 - I2)) <= 0. Landau & Lifshitz, Mechanics, section 37; van Zon
    & Schofield, J. Comput. Phys. 225 (2007) 145.
    """
    times, rotation0 = np.asarray(times, float), np.asarray(rotation0, float)
    top = _FreeRotor(inertia, omega0)
    if top.steady:
        omega = np.broadcast_to(np.asarray(omega0, float), (len(times), 3)).copy()
        speed = np.linalg.norm(omega0)
        return omega, rotation0 @ turn(omega0 if speed else (0, 0, 1), speed * times)
    i1, i2, i3 = top.inertia
    m, m1 = top.m, top.m1
    s0, c0 = top.omega0[1] / top.peak[1], top.omega0[0] / top.peak[0]
    half0, size = float(c0 < 0), np.hypot(s0, c0) * (-1 if c0 < 0 else 1)
    s0, c0 = s0 / size, c0 / size
    half, s, c = amplitude(first_kind(s0, c0, m1) + top.rate * times, m1)
    sign = 1 - 2 * ((half + half0) % 2)
    omega = top.peak * np.stack([sign * c, sign * s, np.sqrt(c * c + m1 * s * s)], axis=1)

    n, one_minus_n = i3 * (i1 - i2) / (i1 * (i3 - i2)), i2 * (i3 - i1) / (i1 * (i3 - i2))
    swept = third_kind(n, one_minus_n, s, c, m, m1) - third_kind(n, one_minus_n, s0, c0, m, m1)
    if half.any():
        swept = swept + 2 * half * third_kind(n, one_minus_n, 1.0, 0.0, m, m1)
    momentum = top.inertia * np.concatenate([top.omega0[None], omega])
    size = np.linalg.norm(momentum[0])
    psi = size * times / i3 + size * (i3 - i1) / (i1 * i3 * top.rate) * swept

    l1, l2, l3 = momentum.T
    flat = np.hypot(l1, l2)
    along = np.hypot(flat, l3)
    a = np.stack([l1 / flat * l3 / along, l2 / flat * l3 / along, -flat / along], axis=1)
    direction = momentum / along[:, None]
    frames = np.stack([a, np.cross(direction, a), direction], axis=1)
    rotation = rotation0 @ top.axes.T @ frames[0].T @ turn((0, 0, 1), psi) @ frames[1:] @ top.axes
    return omega @ top.axes, rotation


def free_asymmetric_period(inertia, omega0) -> float:
    """Period of omega (body frame), 4 K(m) / rate; about a stable axis the limit of a small wobble;
    inf if none."""
    return 4 * _FreeRotor(inertia, omega0).quarter()


def flip_interval(inertia, omega0) -> float:
    """Time between two turnings over (Dzhanibekov), 2 K(m) / rate: half the period."""
    return 2 * _FreeRotor(inertia, omega0).quarter()


# Lagrange's top


def _decimal_sin_cos(x: Decimal):
    """(sin, cos) by Taylor's series."""
    sine, cosine, term, k = Decimal(0), Decimal(1), Decimal(1), 0
    while abs(term) > Decimal("1e-90"):
        k += 1
        term *= x / k
        if k % 2:
            sine += term if k % 4 == 1 else -term
        else:
            cosine += term if k % 4 == 0 else -term
    return sine, cosine


class LagrangeTop:
    """A symmetric top pinned on its axis: closed form in Jacobi functions, from its Euler angles
    and rates at t = 0.

    With u = cos theta, M = m g l > 0 (centre of mass at +l on axis 3), E' = E - L3^2 / (2 I3):
    u'^2 = (1 - u^2)(2 E' - 2 M u) / I1 - ((Lz - L3 u) / I1)^2 = (2 M / I1)(u - u1)(u - u2)(u - u3),
    u = u1 + (u2 - u1) sn^2(p t + d | m), p^2 = M (u3 - u1) / (2 I1), m = (u2 - u1) / (u3 - u1);
    phi' = ((Lz - L3)/(1 - u) + (Lz + L3)/(1 + u)) / (2 I1), each an elliptic integral of the third
    kind;
    psi' = L3 / I3 - phi' u. Whittaker, Analytical Dynamics, sections 71-72; Landau & Lifshitz,
    Mechanics, section 35. The constants are formed in 80 digits from the doubles given, so that
    near misses of the vertical keep theirs. Where the path goes through the vertical exactly, phi
    and psi jump by pi there, and Q is right on both sides.
    """

    def __init__(self, i1, i3, mgl, theta0, phi_rate0, theta_rate0, psi_rate0):
        if not (mgl > 0 and 0 <= theta0 <= np.pi):
            raise ValueError("mgl > 0 and 0 <= theta0 <= pi, please")
        self.i1, self.i3, self.mgl = i1, i3, mgl
        with localcontext() as context:
            context.prec = 80
            i1, i3, mgl, theta0, phi_rate, theta_rate, psi_rate = map(
                Decimal, map(float, (i1, i3, mgl, theta0, phi_rate0, theta_rate0, psi_rate0))
            )
            sine, u0 = _decimal_sin_cos(theta0)
            flat = sine * sine
            below, above = 1 + u0, 1 - u0
            if sine == 0:  # theta0 = 0
                below, above = Decimal(2), Decimal(0)
            l3 = i3 * (psi_rate + phi_rate * u0)
            kick = i1 * flat * phi_rate  # Lz - L3 u0
            minus, plus = kick - l3 * above, kick + l3 * below  # Lz -+ L3
            # the cubic in v = u - u0
            tilt, spin, speed = 2 * mgl / i1, l3 / i1, theta_rate**2 + flat * phi_rate**2
            c0 = flat * theta_rate**2
            c1 = 2 * flat * phi_rate * spin - tilt * flat - 2 * u0 * speed
            c2 = 2 * u0 * tilt - speed - spin**2

            def bisect(negative, positive):
                for _ in range(280):
                    v = (negative + positive) / 2
                    if c0 + v * (c1 + v * (c2 + v * tilt)) < 0:
                        negative = v
                    else:
                        positive = v
                return positive

            if c0 == 0:
                half = c2 / (2 * tilt)
                big = -half - max(half**2 - c1 / tilt, Decimal(0)).sqrt().copy_sign(half)
                v1, v2, v3 = sorted([Decimal(0), big, c1 / tilt / big if big else Decimal(0)])
            else:
                v1, v2 = bisect(-below, Decimal(0)), bisect(above, Decimal(0))
                v3 = -c2 / tilt - v1 - v2
            low, high = below + v1, above - v2  # 1 + u1, 1 - u2
            low, high = (Decimal(0) if x < Decimal("1e-60") else x for x in (low, high))
            width, reach = v2 - v1, v3 - v1
            e = i1 * speed / 2 + mgl * u0 + l3**2 / (2 * i3)
            self._low, self._high, self._width = float(low), float(high), float(width)
            self._wide, self._tall = float(above - v1), float(below + v2)  # 1 - u1, 1 + u2
            self._m, self._m1 = float(width / reach), float((v3 - v2) / reach)
            self._p = float((mgl * reach / (2 * i1)).sqrt())
            self._minus, self._plus = float(minus), float(plus)
            self._split = low == 0 or width > low
            if self._split:
                self._phi_base, self._psi_base = 0.0, float(l3 / i3 - l3 / i1)
            else:
                one = minus / (above - v1) / (2 * i1) if high else Decimal(0)
                two = plus / low / (2 * i1)
                self._phi_base, self._psi_base = (
                    float(one + two),
                    float(l3 / i3 - l3 / i1 - one + two),
                )
            self.roots = np.array([float(u0 + v) for v in (v1, v2, v3)])
            self.energy, self.l_3, self.l_z = float(e), float(l3), float(kick + l3 * u0)
            s, c = (
                (max(-v1, v1 * 0) / width).sqrt() if width else 0,
                (max(v2, v1 * 0) / width).sqrt() if width else 1,
            )
            self._s0, self._c0 = (-float(s) if theta_rate0 > 0 else float(s)), float(c)
        self._d = (
            float(first_kind(self._s0, self._c0, self._m1)) if self._m1 or self._c0 else np.inf
        )

    @property
    def period(self) -> float:
        """Of the nutation, 2 K(m) / p; in steady precession the limit of a small nutation; inf on
        the separatrix."""
        return 2 * quarter_period(self._m1) / self._p

    @property
    def theta_limits(self) -> tuple[float, float]:
        """(least, greatest) theta."""
        least = 2 * np.arctan2(np.sqrt(self._high), np.sqrt(self._tall))
        return float(least), float(2 * np.arctan2(np.sqrt(self._wide), np.sqrt(self._low)))

    @property
    def mean_precession(self) -> float:
        """Advance of phi in one period, divided by it."""
        above, below = self._parts(np.array(1.0), np.array(0.0), np.array(1.0))
        return float(self._phi_base + (above + below) / self.period)

    def _amplitude(self, times):
        return amplitude(self._p * np.asarray(times, float) + self._d, self._m1)

    def _parts(self, half, s, c):
        """The terms of phi in 1 - u and in 1 + u, from sn = 0 onward, without the rates
        `_phi_base`, `_psi_base`.

        Unless the path comes near the downward vertical, F is taken out of both Pi and put into
        those rates (the ones at u1), so that a slow precession is not a difference of two large terms.
        """
        m, m1, scale = self._m, self._m1, 2 * self.i1 * self._p

        def swept(n, one_minus_n, s, c):
            if self._split:
                return third_kind(n, one_minus_n, s, c, m, m1)
            x = c * c
            return n / 3 * s**3 * elliprj(x, x + m1 * s * s, 1.0, x + one_minus_n * s * s)

        def term(lz, gap, n, one_minus_n):
            whole = 2 * half * swept(n, one_minus_n, 1.0, 0.0) if np.any(half) else 0.0
            return lz / (scale * gap) * (whole + swept(n, one_minus_n, s, c))

        above = below = np.zeros_like(s)
        if self._high:
            above = term(self._minus, self._wide, self._width / self._wide, self._high / self._wide)
        elif self._width:  # through the upward vertical: a half rotation there
            above = np.pi * half
        if self._low:
            below = term(self._plus, self._low, -self._width / self._low, self._tall / self._low)
        elif self._width:  # through the downward vertical
            below = np.pi * (half + np.sign(s) / 2)
        return above, below

    def theta(self, times) -> np.ndarray:
        _, s, c = self._amplitude(times)
        above, below = self._high + self._width * c * c, self._low + self._width * s * s
        return 2 * np.arctan2(np.sqrt(above), np.sqrt(below))

    def _turned(self, times):
        above, below = self._parts(*self._amplitude(times))
        above0, below0 = self._parts(np.array(0.0), np.array(self._s0), np.array(self._c0))
        return above - above0, below - below0

    def phi(self, times) -> np.ndarray:
        """From 0 at t = 0."""
        above, below = self._turned(times)
        return self._phi_base * np.asarray(times, float) + above + below

    def psi(self, times) -> np.ndarray:
        """From 0 at t = 0: psi' = L3/I3 - L3/I1 - (Lz - L3)/(2 I1 (1 - u)) + (Lz + L3)/(2 I1 (1 +
        u))."""
        above, below = self._turned(times)
        return self._psi_base * np.asarray(times, float) - above + below

    def rotation(self, times) -> np.ndarray:
        """Q (n, 3, 3), phi = psi = 0 at the start."""
        return euler_rotation(self.phi(times), self.theta(times), self.psi(times))

    def axis(self, times) -> np.ndarray:
        """The symmetry axis in the lab (n, 3): (sin theta sin phi, -sin theta cos phi, cos
        theta)."""
        theta, phi = self.theta(times), self.phi(times)
        return np.stack(
            [np.sin(theta) * np.sin(phi), -np.sin(theta) * np.cos(phi), np.cos(theta)], axis=-1
        )


def steady_precession_rates(i1, l3, mgl, theta) -> tuple[float, float]:
    """(slow, fast) roots of I1 cos(theta) x^2 - L3 x + M = 0; nan if there are none, fast inf at 90
    degrees.

    For sin(theta) (I1 cos(theta) x^2 - L3 x + M) = I1 theta'' at theta'' = 0. Landau & Lifshitz,
    Mechanics, section 35.
    """
    lead = i1 * np.cos(theta)
    inside = l3 * l3 - 4 * lead * mgl
    if inside < 0:
        return np.nan, np.nan
    half = (l3 + np.copysign(np.sqrt(inside), l3)) / 2
    return float(mgl / half), float(half / lead) if lead else np.inf


def sleeping_limit(i1, mgl) -> float:
    """The least L3 at which a top stands upright: L3^2 = 4 I1 m g l."""
    return float(2 * np.sqrt(i1 * mgl))


# Frames that rotate


def rotating_fall(omega_frame, gravity, x0, v0, times):
    """(x, v), each (n, 3), of a point in a frame that rotates at a constant rate, relative to the
    frame.

    x'' = g - 2 W x x' - W x (W x x), g and W constant in the frame. In axes at rest X = R(t) x has
    X'' = R(t) g, so X = x0 + (v0 + W x x0) t + t^2 [g_par / 2 + g_perp (1 - cos z)/z^2 + (n x g)(z
    - sin z)/z^2], z = |W| t.
    """
    spin, g = np.asarray(omega_frame, float), np.asarray(gravity, float)
    x0, v0, t = np.asarray(x0, float), np.asarray(v0, float), np.asarray(times, float)[:, None]
    rate = np.linalg.norm(spin)
    n = spin / rate if rate else np.array([0.0, 0.0, 1.0])
    z = rate * t
    along, across = n * (n @ g), np.cross(n, g)
    aside = g - along
    small = np.abs(z) < 1.0
    zs, zl = np.where(small, z, 0.0), np.where(small, 1.0, z)
    series = term = zs / 6
    for k in range(2, 12):
        term = -term * zs**2 / ((2 * k) * (2 * k + 1))
        series = series + term
    late = np.where(small, series, (zl - np.sin(zl)) / zl**2)
    sinc, versine = (
        np.sinc(z / np.pi),
        np.sinc(z / (2 * np.pi)) ** 2 / 2,
    )  # sin z / z, (1 - cos z) / z^2
    start = v0 + np.cross(spin, x0)
    x_rest = x0 + start * t + t**2 * (along / 2 + aside * versine + across * late)
    v_rest = start + t * (along + aside * sinc + across * z * versine)
    back = np.swapaxes(turn(n, z[:, 0]), 1, 2)
    x = np.einsum("nij,nj->ni", back, x_rest)
    return x, np.einsum("nij,nj->ni", back, v_rest) - np.cross(spin, x)


def gyrocompass_period(h, mgl, omega, latitude) -> float:
    """2 pi sqrt(h / (m g l W cos(latitude))): the rotor's inertia and the frame's rate next to
    the weight neglected.

    The axis at azimuth a east of north and elevation e: the frame's vertical rate from each other, the
    horizon under an axis that points east sinks, e' = W cos(latitude) a; the pendulum's torque m g
    l e rotates the axis, a' = -m g l e / h. Together a'' = -(m g l W cos(latitude) / h) a. Period of
    the undamped gyrocompass.
    """
    return float(2 * np.pi * np.sqrt(h / (mgl * omega * np.cos(latitude))))


def gyrocompass_rest(inertia, h, mgl, omega, latitude) -> float:
    """Elevation of axis 1 above the horizon at rest in the meridian, from -torque = (I W + h) x W
    about the pivot.

    m g l sin(a) = h W sin(b) + (I1 - I3) W^2 sin(b) cos(b), b = latitude - a.
    """
    i1, _, i3 = inertia
    a = 0.0
    for _ in range(100):
        s, c = np.sin(latitude - a), np.cos(latitude - a)
        off = mgl * np.sin(a) - h * omega * s - (i1 - i3) * omega**2 * s * c
        slope = mgl * np.cos(a) + h * omega * c + (i1 - i3) * omega**2 * (c * c - s * s)
        a, old = a - off / slope, a
        if abs(a - old) < 1e-16 * max(1.0, abs(a)):
            break
    return float(a)


def gyrocompass_period_linear(inertia, h, mgl, omega, latitude) -> float:
    """Slowest period of the pendulous gyrostat's small motions about rest in the meridian, nothing
    neglected.

    Body: principal moments about the pivot, rotor momentum h along axis 1 (north at rest), centre
    of mass at
    -l along axis 3. At rest the axes point north, west and up, tilted by the elevation a
    (`gyrocompass_rest`), and the frame's rate is W (A, 0, B) = omega (cos b, 0, sin b), b =
    latitude - a, in the body. With Q = Q_rest exp(hat(e)), I w' = (I w + h) x w + torque becomes I
    e'' + G e' + K e = 0,
    G12 = -(I1 + I2 - I3) B, G23 = h - (I2 + I3 - I1) A, antisymmetric; K11 = M cos a + (I3 - I2)
    B^2,
    K22 = M cos a + h A + (I1 - I3)(A^2 - B^2), K33 = h A + (I1 - I2) A^2, K13 = K31 = (I2 - I3) A B
    - M sin a.
    The determinant is a cubic in s^2, whose least root is found by Newton's method. To first order
    T^2 = T0^2 (1 + I3 M / h^2) / (1 + h W cos(latitude) / M).
    """
    i1, i2, i3 = (np.polynomial.Polynomial([0.0, float(i)]) for i in inertia)
    j1, j2, j3 = inertia
    tilt = gyrocompass_rest(inertia, h, mgl, omega, latitude)
    a, b = omega * np.cos(latitude - tilt), omega * np.sin(latitude - tilt)
    weight = mgl * np.cos(tilt)
    g12, g23 = -(j1 + j2 - j3) * b, h - (j2 + j3 - j1) * a
    k13 = (j2 - j3) * a * b - mgl * np.sin(tilt)
    first, second = (
        i1 + weight + (j3 - j2) * b * b,
        i2 + weight + h * a + (j1 - j3) * (a * a - b * b),
    )
    k33 = h * a + (j1 - j2) * a * a
    square = np.polynomial.Polynomial([0.0, 1.0])
    det = first * second * (i3 + k33) - second * k13**2
    det += square * (g23**2 * first + g12**2 * (i3 + k33) + 2 * g12 * g23 * k13)
    slope, root = det.deriv(), 0.0
    for _ in range(100):
        root, old = root - det(root) / slope(root), root
        if abs(root - old) <= 4e-16 * abs(root):
            break
    return float(2 * np.pi / np.sqrt(-root))


# Resistance, wheels, limbs


def terminal_speed(weight_in_fluid, linear, quadratic) -> float:
    """The speed at which linear v + quadratic v^2 carries the weight left after buoyancy."""
    return float(
        2 * weight_in_fluid / (linear + np.sqrt(linear**2 + 4 * quadratic * weight_in_fluid))
    )


def coasting_stop(i, viscous, dry, omega0) -> float:
    """When dry friction brings the spin to rest: (I / c) log(1 + c |omega0| / d); inf without
    it."""
    if not dry:
        return np.inf
    x = viscous * abs(omega0) / dry
    return float(i * abs(omega0) / dry * (np.log1p(x) / x if x else 1.0))


def coasting_spin(i, viscous, dry, omega0, times) -> np.ndarray:
    """omega(t) of I omega' = -c omega - d sign(omega), at rest from `coasting_stop` on.

    omega = omega0 exp(-c t / I) - (d / c)(1 - exp(-c t / I)).
    """
    times = np.asarray(times, float)
    x = viscous * times / i
    lost = -np.expm1(-x) / viscous if viscous else times / i
    speed = abs(omega0) * np.exp(-x) - dry * lost
    return np.copysign(np.where(times < coasting_stop(i, viscous, dry, omega0), speed, 0.0), omega0)


def wheel_turn(i_body, torque, t_on, times) -> np.ndarray:
    """Angle of a satellite at rest while the momentum of its wheel on the same axis grows by
    `torque` a second.

    L = I omega + h = 0, h = torque min(t, t_on): angle = -torque t^2 / (2 I), later -torque t_on (t
    - t_on / 2) / I. If h is the wheel's whole momentum, `torque` is the motor's and I is the body's
    without the wheel;
    if h counts from the body (relative spin), I is the value of the two locked together.
    """
    times = np.asarray(times, float)
    on = np.minimum(times, t_on)
    return -torque * on * (times - on / 2) / i_body


def changing_inertia_spin(l3, i3, times) -> np.ndarray:
    """omega3(t) = L3 / I3(t) of a skater, i3 a function of the time: no torque about the axis."""
    return l3 / np.asarray(i3(np.asarray(times, float)), float)
