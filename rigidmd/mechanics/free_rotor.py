"""Free-rotor flows: the rotation of a body without torque. The kernel `rotate(rotor, ...)` is
chosen by the type at compile time, so a scene of points compiles no rotation."""

from math import cos, inf, nan, sin, sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.compile import chosen_by_type, is_a, kernel

#: Steps between two corrections of the rounding errors of QᵀQ. They would grow, and with them the
#: error of the total torque: a step of two waters had one of 5e-14 of the forces after 1e3 steps
#: and 1e-12 after 5e5 steps, and their angular momentum drifted faster than a random walk.
ORTHOGONALITY_INTERVAL = 256


class SplitRotor(NamedTuple):
    """Composition of exact rotations: about L, and about the principal axes (Dullweber, Leimkuhler
    & McLachlan 1997).

    H = g |L|²/2 + sum (1/I_k - g) L_k²/2. The first part rotates about L and commutes with the
    rest, which is Ra(h/2) Rb(h/2) Rc(h) Rb(h/2) Ra(h/2). a is the axis of the middle 1/I, b the
    axis whose 1/I is farther from it, c the third; g = (2/I_a + 1/I_c)/3. See the theory chapter
    `dynamics` for the energy that it conserves. Bodies with two equal moments move exactly. For
    linear and spherical bodies only g remains.
    """

    inverse_inertia: np.ndarray  # (species, 3), 1/(u Å²); 0 where the moment is 0
    symmetry: np.ndarray  # (species,) SPHERICAL, or the axis of symmetry 0, 1, 2, or NO_SYMMETRY
    common: np.ndarray  # (species,) g
    # (species, 3) 1/I - g; 0 for linear bodies, which have no momentum along their axis
    excess: np.ndarray
    order: np.ndarray  # (species, 3) axes a, b, c


class ExactRotor(NamedTuple):
    """The exact free motion, to rounding, for any body and any time step, by a closed form or by
    Taylor series: see the theory chapter `dynamics`. A rotation by 0.03 to 0.3 rad takes 0.23 to
    0.46 µs. Longer ones are divided into parts.
    """

    inverse_inertia: np.ndarray  # all five as in SplitRotor
    symmetry: np.ndarray
    common: np.ndarray
    excess: np.ndarray
    order: np.ndarray


NO_SYMMETRY, SPHERICAL = -1, 3  # of SplitRotor.symmetry
MOST_TERMS = 30
#: Largest rotation in one drift, rad. Beyond it the momentum is set to NaN, which stops the run; a
#: body whose energy diverges would otherwise be rotated in parts for hours.
LARGEST_ANGLE = 1e4
SHORT_ANGLE2 = 0.0625  # rad², below which series are used
LONGEST_PART = 0.5  # rad; 0.3 rad takes 14 terms, 1 rad 26


def split_rotor(inertia: np.ndarray) -> SplitRotor:
    """The rotor of bodies with these principal moments (species, 3), u Å²."""
    with np.errstate(divide="ignore"):
        inverse = np.where(inertia > 0, 1 / inertia, 0.0)
    symmetry = np.array([_symmetry(moments) for moments in inertia])
    common, order = (np.array(part) for part in zip(*map(_parts, inverse), strict=True))
    excess = np.where(symmetry[:, None] == SPHERICAL, 0.0, inverse - common[:, None])
    return SplitRotor(inverse, symmetry, common, excess, order)


def _parts(inverse: np.ndarray) -> tuple[float, tuple[int, int, int]]:
    """g and the axes a, b, c of SplitRotor. A symmetric body rotates once about its axis of
    symmetry, c."""
    low, middle, high = np.argsort(inverse)
    far, near = (
        (high, low)
        if inverse[middle] - inverse[low] < inverse[high] - inverse[middle]
        else (low, high)
    )
    beyond = inverse[middle] - inverse[near]
    return inverse[near] + 2 / 3 * beyond, (middle, far, near) if beyond else (middle, near, far)


def _symmetry(moments: np.ndarray) -> int:
    if len(set(moments[moments > 0])) <= 1:
        return SPHERICAL
    return next((k for k in range(3) if moments[k - 1] == moments[k - 2]), NO_SYMMETRY)


class NoRotor(NamedTuple):
    """No rotation: points."""

    inverse_inertia: float = 0.0


@chosen_by_type(inline=True)
def rotate(rotor, species, rotation, angular_momentum_body, m, h):
    """Rotate molecule m of the given species freely for a time h: Q' = Q hat(I^-1 L), L' = L x I^-1
    L, in place."""
    if is_a(rotor, NoRotor):
        return lambda rotor, species, rotation, angular_momentum_body, m, h: None
    if is_a(rotor, SplitRotor):
        return rotate_by_splitting.py_func
    if is_a(rotor, ExactRotor):

        def rotate_exact(rotor, species, rotation, angular_momentum_body, m, h):
            if rotor.symmetry[species] == NO_SYMMETRY:
                rotate_by_series(
                    rotation, angular_momentum_body, m, rotor.inverse_inertia[species], h
                )
            else:
                rotate_by_splitting(rotor, species, rotation, angular_momentum_body, m, h)

        return rotate_exact


@kernel(inline=True)
def rotate_by_splitting(rotor, species, rotation, angular_momentum_body, m, h):
    """Rotate about L, which is constant, by the angle h g |L|, then about the axes. The two flows
    commute."""
    L = angular_momentum_body[m]
    rate = h * rotor.common[species]
    rotate_by_vector(rotation[m], rate * L[0], rate * L[1], rate * L[2])
    a, b, c = rotor.order[species, 0], rotor.order[species, 1], rotor.order[species, 2]
    excess = rotor.excess[species]
    rates = (excess[a], excess[b], excess[c])
    rotate_about_axes(rotation, angular_momentum_body, m, (a, b, c), rates, (0.0, 0.0, 0.0), h)


@kernel
def rotate_by_series(rotation, angular_momentum_body, m, inverse, h):
    """Free motion of an asymmetric body, by the Taylor series for omega and for the rotation
    quaternion."""
    L = angular_momentum_body[m]
    fastest = abs(L[0] * inverse[0]) + abs(L[1] * inverse[1]) + abs(L[2] * inverse[2])
    if not 0.0 < fastest * abs(h) < inf:
        return
    if fastest * abs(h) > LARGEST_ANGLE:
        L[:] = nan
        return
    parts = int(fastest * abs(h) / LONGEST_PART) + 1
    part = h / parts
    a0 = part * inverse[0] * (1 / inverse[1] - 1 / inverse[2])
    a1 = part * inverse[1] * (1 / inverse[2] - 1 / inverse[0])
    a2 = part * inverse[2] * (1 / inverse[0] - 1 / inverse[1])
    terms = np.empty((MOST_TERMS + 1, 7))  # k-th derivatives of omega and q, times h^k/k!
    for _ in range(parts):
        terms[0, 0] = L[0] * inverse[0]
        terms[0, 1] = L[1] * inverse[1]
        terms[0, 2] = L[2] * inverse[2]
        terms[0, 3] = 1.0
        terms[0, 4:] = 0.0
        w = 0.0
        x = 0.0
        y = 0.0
        z = 0.0
        for k in range(MOST_TERMS):
            g0 = 0.0
            g1 = 0.0
            g2 = 0.0
            q0 = 0.0
            q1 = 0.0
            q2 = 0.0
            q3 = 0.0
            for j in range(k + 1):
                v0, v1, v2 = terms[k - j, 0], terms[k - j, 1], terms[k - j, 2]
                g0 += terms[j, 1] * v2
                g1 += terms[j, 2] * v0
                g2 += terms[j, 0] * v1
                p0 = terms[j, 3]
                p1 = terms[j, 4]
                p2 = terms[j, 5]
                p3 = terms[j, 6]
                q0 -= p1 * v0 + p2 * v1 + p3 * v2
                q1 += p0 * v0 + p2 * v2 - p3 * v1
                q2 += p0 * v1 + p3 * v0 - p1 * v2
                q3 += p0 * v2 + p1 * v1 - p2 * v0
            factor = 1 / (k + 1)
            terms[k + 1, 0] = a0 * factor * g0
            terms[k + 1, 1] = a1 * factor * g1
            terms[k + 1, 2] = a2 * factor * g2
            factor *= 0.5 * part
            q0 *= factor
            q1 *= factor
            q2 *= factor
            q3 *= factor
            terms[k + 1, 3] = q0
            terms[k + 1, 4] = q1
            terms[k + 1, 5] = q2
            terms[k + 1, 6] = q3
            w += q0
            x += q1
            y += q2
            z += q3
            if abs(q0) + abs(q1) + abs(q2) + abs(q3) < 1e-17:
                break
        apply_quaternion(rotation, angular_momentum_body, m, w, x, y, z)


@kernel(inline=True)
def apply_quaternion(rotation, angular_momentum_body, m, w, x, y, z):
    """Q <- Q R, L <- R^T L with R the rotation of the quaternion (1 + w, x, y, z), of any
    length."""
    scale = 2 / ((1 + w) * (1 + w) + x * x + y * y + z * z)
    c = scale * (1 + w)
    L = angular_momentum_body[m]
    L[0], L[1], L[2] = rotate_vector(L[0], L[1], L[2], x, y, z, -c, scale)
    rotate_rows(rotation[m], x, y, z, -c, scale)


@kernel(inline=True)
def rotate_vector(a, b, d, x, y, z, first, second):
    """v + first u x v + second u x (u x v) for v = (a, b, d), u = (x, y, z): a rotation, written as
    a change."""
    p = y * d - z * b
    q = z * a - x * d
    r = x * b - y * a
    return (
        a + (first * p + second * (y * r - z * q)),
        b + (first * q + second * (z * p - x * r)),
        d + (first * r + second * (x * q - y * p)),
    )


@kernel(inline=True)
def rotate_rows(rotation, x, y, z, first, second):
    """`rotate_vector` on each row of Q (3, 3), in place: a row of Q R is R^T times the row of Q."""
    for row in range(3):
        rotation[row, 0], rotation[row, 1], rotation[row, 2] = rotate_vector(
            rotation[row, 0], rotation[row, 1], rotation[row, 2], x, y, z, first, second
        )


@kernel(inline=True)
def rotate_about_axes(rotation, angular_momentum_body, m, order, rate, offset, h):
    """Five exact rotations about the axes `order`, by angles h rate (L_k - offset). offset:
    momentum of wheels."""
    L = angular_momentum_body
    a, b, c = order
    rotate_about_axis(rotation, L, m, a, 0.5 * h * rate[0] * (L[m, a] - offset[0]))
    rotate_about_axis(rotation, L, m, b, 0.5 * h * rate[1] * (L[m, b] - offset[1]))
    rotate_about_axis(rotation, L, m, c, h * rate[2] * (L[m, c] - offset[2]))
    rotate_about_axis(rotation, L, m, b, 0.5 * h * rate[1] * (L[m, b] - offset[1]))
    rotate_about_axis(rotation, L, m, a, 0.5 * h * rate[0] * (L[m, a] - offset[0]))


@kernel(inline=True)
def rotate_about_axis(rotation, angular_momentum_body, m, k, angle):
    """Exact flow of (L_k - offset)²/(2 I_k): L <- R_k(angle)^T L, Q <- Q R_k(angle)."""
    if angle != 0.0:
        i = k + 1 if k < 2 else 0
        j = k - 1 if k > 0 else 2
        s, versine = sine_and_versine(angle)
        a = angular_momentum_body[m, i]
        b = angular_momentum_body[m, j]
        angular_momentum_body[m, i] = a + (s * b - versine * a)
        angular_momentum_body[m, j] = b - (s * a + versine * b)
        for row in range(3):
            a = rotation[m, row, i]
            b = rotation[m, row, j]
            rotation[m, row, i] = a + (s * b - versine * a)
            rotation[m, row, j] = b - (s * a + versine * b)


@kernel(inline=True)
def sine_and_versine(angle):
    """sin and 1 - cos of an angle, for rotations that are written as a change: see "Rounding of Q"
    in the theory chapter `dynamics`."""
    odd, even = rotation_coefficients(angle * angle)
    return angle * odd, angle * angle * even


@kernel(inline=True)
def rotation_coefficients(x):
    """sin(angle)/angle and (1 - cos(angle))/angle² of x = angle²."""
    if x < SHORT_ANGLE2:
        return rotation_coefficient_series(x)
    angle = sqrt(x)
    s = sin(angle)
    c = cos(angle)
    return s / angle, (s * s / (1 + c) if c > 0 else 1 - c) / x


@kernel(inline=True)
def rotation_coefficient_series(x):
    """`rotation_coefficients` by Taylor series, accurate to rounding below SHORT_ANGLE2 and faster
    than sin and cos."""
    x2 = x * x
    odd = (1 - 1 / 6 * x) + x2 * (
        (1 / 120 - 1 / 5040 * x) + x2 * ((1 / 362880 - 1 / 39916800 * x) + 1 / 6227020800 * x2)
    )
    even = (1 / 2 - 1 / 24 * x) + x2 * (
        (1 / 720 - 1 / 40320 * x) + x2 * ((1 / 3628800 - 1 / 479001600 * x) + 1 / 87178291200 * x2)
    )
    return odd, even


@kernel(inline=True)
def rotate_by_vector(rotation, x, y, z):
    """Q <- Q R with the rotation vector (x, y, z) of R, body frame. Its length is not needed, which
    saves a third."""
    odd, even = rotation_coefficients(x * x + y * y + z * z)
    rotate_rows(rotation, x, y, z, -odd, even)


@kernel
def restore_orthogonality(rotation, momentum):
    """Q <- Q (3 - QᵀQ) / 2 of rotations (n, 3, 3), in place: a Newton step to the nearest rotation,
    which leaves the square of the error (Higham 2008, Functions of Matrices, eq. 8.20). Bodies
    without angular momentum (n, 3) stay."""
    for m in range(len(rotation)):
        if momentum[m, 0] == 0.0 and momentum[m, 1] == 0.0 and momentum[m, 2] == 0.0:
            continue
        q = rotation[m]
        xx, yy, zz = -1.0, -1.0, -1.0
        xy = yz = zx = 0.0
        for i in range(3):
            xx, yy, zz = xx + q[i, 0] * q[i, 0], yy + q[i, 1] * q[i, 1], zz + q[i, 2] * q[i, 2]
            xy, yz, zx = xy + q[i, 0] * q[i, 1], yz + q[i, 1] * q[i, 2], zx + q[i, 2] * q[i, 0]
        for i in range(3):
            x, y, z = q[i, 0], q[i, 1], q[i, 2]
            q[i, 0] = x - 0.5 * (x * xx + y * xy + z * zx)
            q[i, 1] = y - 0.5 * (x * xy + y * yy + z * yz)
            q[i, 2] = z - 0.5 * (x * zx + y * yz + z * zz)
