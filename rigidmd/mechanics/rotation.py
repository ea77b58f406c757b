"""Rotation matrices Q (body to lab, x_lab = Q x_body), stacks of them included. Plain NumPy; nothing here is hot."""

import numpy as np


def random_rotations(rng: np.random.Generator, n: int) -> np.ndarray:
    """n rotation matrices (n, 3, 3), uniform on the rotation group: unit quaternions from four Gaussians each."""
    return from_quaternion(rng.standard_normal((n, 4)))


def from_quaternion(quaternion_wxyz: np.ndarray) -> np.ndarray:
    """Q (..., 3, 3) of quaternions (..., 4) in order w, x, y, z; any non-zero length, the direction counts."""
    q = np.asarray(quaternion_wxyz, dtype=float)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def from_vector(vector: np.ndarray) -> np.ndarray:
    """Rotations (..., 3, 3) by the angle |vector| (rad) about the directions of vectors (..., 3)."""
    vector = np.asarray(vector, dtype=float)
    half = 0.5 * np.linalg.norm(vector, axis=-1, keepdims=True)
    return from_quaternion(np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * vector], axis=-1))


def orthogonality_error(rotation: np.ndarray) -> float:
    """Largest entry of |Q^T Q - 1| over a stack (..., 3, 3); 0 for an empty stack.

    The split rotor multiplies Q by plane rotations whose cos² + sin² is 1 to rounding, so each step adds at most a few
    1e-17 of random sign and nothing pulls Q back: the error grows like a random walk, and its size tells how long the
    run can still be trusted.
    """
    if len(rotation) == 0:
        return 0.0
    return float(np.abs(np.swapaxes(rotation, -1, -2) @ rotation - np.eye(3)).max())


def align(points_body: np.ndarray, points_lab: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Best proper rotations Q (n, 3, 3) with Q points_body ~ points_lab (Kabsch 1976, Acta Cryst. A32, 922).

    points_body (s, 3) and points_lab (n, s, 3) relative to their weighted centres; weights (s,), in practice masses.
    Linear and planar bodies are fine; a mirror image is not reached, since only proper rotations are allowed.
    """
    covariance = np.einsum("s,nsi,sj->nij", weights, points_lab, points_body)
    u, _, vt = np.linalg.svd(covariance)
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    return u @ vt
