"""Rotation matrices Q (body to lab, x_lab = Q x_body) in NumPy, for code that is not performance
critical: conversions from and to quaternions (w, x, y, z), 3-1-3 Euler angles, 3-2-1 yaw, pitch and
roll, and attitude matrices, in rad."""

import numpy as np
from numpy.typing import ArrayLike


def random_rotations(rng: np.random.Generator, n: int) -> np.ndarray:
    """n rotation matrices (n, 3, 3), uniform on the rotation group: unit quaternions from four
    Gaussians each."""
    return from_quaternion(rng.standard_normal((n, 4)))


def from_quaternion(quaternion_wxyz: np.ndarray) -> np.ndarray:
    """Q (..., 3, 3) of quaternions (..., 4) in order w, x, y, z, which are normalised. The length
    must not be 0."""
    q = np.asarray(quaternion_wxyz, dtype=float)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    return _matrix(
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    )


def unit_vector(vector: ArrayLike) -> np.ndarray:
    """Unit vector along a non-zero vector (k,) of any length, without overflow or underflow."""
    components = np.asarray(vector, dtype=float)
    scaled = components / np.abs(components).max()
    return scaled / np.linalg.norm(scaled)


def to_quaternion(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternions (..., 4) of Q (..., 3, 3) in order w, x, y, z. The first non-zero component
    is positive. No angle has cancellation (Shepperd 1978, J. Guid. Control 1, 223)."""
    q = np.asarray(rotation, dtype=float)
    xx, yy, zz = q[..., 0, 0], q[..., 1, 1], q[..., 2, 2]
    wx = q[..., 2, 1] - q[..., 1, 2]
    xw = q[..., 2, 1] + q[..., 1, 2]
    wy = q[..., 0, 2] - q[..., 2, 0]
    yw = q[..., 0, 2] + q[..., 2, 0]
    wz = q[..., 1, 0] - q[..., 0, 1]
    zw = q[..., 1, 0] + q[..., 0, 1]
    products = _matrix(
        [1 + xx + yy + zz, wx, wy, wz],
        [wx, 1 + xx - yy - zz, zw, yw],
        [wy, zw, 1 - xx + yy - zz, xw],
        [wz, yw, xw, 1 - xx - yy + zz],
    )
    largest = np.diagonal(products, axis1=-2, axis2=-1).argmax(axis=-1)
    row = np.take_along_axis(products, largest[..., None, None], axis=-2)[..., 0, :]
    first = np.take_along_axis(row, (row != 0).argmax(axis=-1)[..., None], axis=-1)
    # + 0.0: no -0 among the zeros
    return np.sign(first) * row / np.linalg.norm(row, axis=-1, keepdims=True) + 0.0


def from_vector(vector: np.ndarray) -> np.ndarray:
    """Rotations (..., 3, 3) by the angle |vector| (rad) about the directions of vectors (...,
    3)."""
    vector = np.asarray(vector, dtype=float)
    half = 0.5 * np.linalg.norm(vector, axis=-1, keepdims=True)
    return from_quaternion(
        np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * vector], axis=-1)
    )


def from_axis(direction: ArrayLike) -> np.ndarray:
    """The smallest rotation (3, 3) that takes axis 3 to a direction (3,) of any length. From 3 to
    -3
    it rotates by 180° about axis 1. It has no rounding for a direction along an axis."""
    x, y, z = unit_vector(direction)
    if z < 0:
        return from_axis((-x, -y, -z)) @ np.diag([1.0, -1.0, -1.0])
    tilt = hat(np.array([-y, x, 0.0]))
    return np.eye(3) + tilt + tilt @ tilt / (1 + z)


def from_euler_angles(euler_angles: np.ndarray) -> np.ndarray:
    """Q = Rz(phi) Rx(theta) Rz(psi) (..., 3, 3) of 3-1-3 Euler angles (..., 3) = (phi, theta,
    psi)."""
    (cf, ct, cp), (sf, st, sp) = _cosines_and_sines(euler_angles)
    return _matrix(
        [cf * cp - sf * ct * sp, -cf * sp - sf * ct * cp, sf * st],
        [sf * cp + cf * ct * sp, -sf * sp + cf * ct * cp, -cf * st],
        [st * sp, st * cp, ct],
    )


def to_euler_angles(rotation: np.ndarray) -> np.ndarray:
    """3-1-3 Euler angles (..., 3) of Q (..., 3, 3): phi and psi in (-pi, pi], theta in [0, pi]; psi
    = 0 where sin(theta) is 0. The three together give Q to rounding, also near it."""
    q = np.asarray(rotation, dtype=float)
    sin_theta = np.hypot(q[..., 0, 2], q[..., 1, 2])
    locked = sin_theta == 0
    phi = np.where(locked, _angle(q[..., 1, 0], q[..., 0, 0]), _angle(q[..., 0, 2], -q[..., 1, 2]))
    # (cos psi, -sin psi, 0)
    row = np.cos(phi)[..., None] * q[..., 0, :] + np.sin(phi)[..., None] * q[..., 1, :]
    psi = np.where(locked, 0.0, _angle(-row[..., 1], row[..., 0]))
    return np.stack([phi, np.arctan2(sin_theta, q[..., 2, 2]), psi], axis=-1) + 0.0  # + 0.0: no -0


def from_yaw_pitch_roll(yaw_pitch_roll: np.ndarray) -> np.ndarray:
    """Q = Rz(yaw) Ry(pitch) Rx(roll) (..., 3, 3) of the 3-2-1 angles (..., 3) = (yaw, pitch,
    roll)."""
    (cy, cp, cr), (sy, sp, sr) = _cosines_and_sines(yaw_pitch_roll)
    return _matrix(
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    )


def hat(vector: np.ndarray) -> np.ndarray:
    """Skew matrices (..., 3, 3) of vectors (..., 3): hat(a) b = a x b, so that dQ/dt = Q
    hat(omega_body)."""
    x, y, z = np.moveaxis(np.asarray(vector, dtype=float), -1, 0)
    zero = np.zeros_like(x)
    return _matrix([zero, -z, y], [z, zero, -x], [-y, x, zero])


def angular_velocity_of_euler_rates(euler_angles: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """omega (..., 3), body frame, from 3-1-3 angles (..., 3) and their time derivatives (..., 3),
    rad per time."""
    (_, ct, cp), (_, st, sp) = _cosines_and_sines(euler_angles)
    phi_dot, theta_dot, psi_dot = np.moveaxis(np.asarray(rates, dtype=float), -1, 0)
    omega = (
        phi_dot * st * sp + theta_dot * cp,
        phi_dot * st * cp - theta_dot * sp,
        phi_dot * ct + psi_dot,
    )
    return np.stack(np.broadcast_arrays(*omega), axis=-1)


def attitude_matrix(rotation: np.ndarray) -> np.ndarray:
    """T = Q^T (..., 3, 3), the attitude matrix: lab to body, dT/dt = -hat(omega_body) T."""
    return np.swapaxes(np.asarray(rotation, dtype=float), -1, -2).copy()


#: Q = T^T (..., 3, 3) of attitude matrices T (lab to body).
from_attitude_matrix = attitude_matrix


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """The proper rotations (..., 3, 3) nearest to matrices (..., 3, 3) in the Frobenius norm, by
    their SVD."""
    u, _, vt = np.linalg.svd(np.asarray(matrix, dtype=float))
    u[..., 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return u @ vt


def orthogonality_error(rotation: np.ndarray) -> float:
    """Largest entry of |Q^T Q - 1| over a stack (..., 3, 3), 0 for an empty stack."""
    if len(rotation) == 0:
        return 0.0
    # entry by entry over the stack, because NumPy is seven times as slow for products of many small
    # matrices
    columns = rotation.reshape(-1, 9).T.copy().reshape(3, 3, -1)
    entries = ((j, k) for j in range(3) for k in range(j, 3))
    return max(
        float(np.abs((columns[:, j] * columns[:, k]).sum(axis=0) - (j == k)).max())
        for j, k in entries
    )


def align(points_body: np.ndarray, points_lab: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Best proper rotations Q (n, 3, 3) with Q points_body ~ points_lab (Kabsch 1976, Acta Cryst.
    A32, 922).

    points_body (s, 3) and points_lab (n, s, 3) relative to their weighted centres. Weights (s,), in
    practice masses. Linear and planar bodies are allowed. A mirror image is not matched, because
    the rotations are proper.
    """
    return nearest_rotation(np.einsum("s,nsi,sj->nij", weights, points_lab, points_body))


def _matrix(*rows: list[np.ndarray]) -> np.ndarray:
    """Matrices (..., m, n) from m rows of n entries (...)."""
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _cosines_and_sines(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cosines and sines, each (3, ...), of angles (..., 3)."""
    angles = np.moveaxis(np.asarray(angles, dtype=float), -1, 0)
    return np.cos(angles), np.sin(angles)


def _angle(sine: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """Angle in (-pi, pi]; arctan2 alone gives -pi for a sine of -0, or a negative one too small to
    change pi."""
    angle = np.arctan2(sine, cosine)
    return np.where(angle <= -np.pi, np.pi, angle)
