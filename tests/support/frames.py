"""Made-up frames of rigid molecules with known values."""

import numpy as np

TRICLINIC = np.array([[21.0, 0.0, 0.0], [6.0, 19.0, 0.0], [-7.0, 5.0, 23.0]])


def brownian(rng, frames, n, D, interval, drift=0.0):
    """Paths (f, n, 3) of walkers with a diffusion coefficient D, Å²/ps."""
    steps = np.sqrt(2 * D * interval) * rng.standard_normal((frames, n, 3)) + drift * interval
    return np.cumsum(steps, axis=0)


def rotations_about(turns):
    """Rotation matrices (..., 3, 3) of vectors (..., 3), rad."""
    angle = np.linalg.norm(turns, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(turns, -1, 0)
    none = np.zeros_like(x)
    cross = np.stack([none, -z, y, z, none, -x, -y, x, none], axis=-1).reshape(*turns.shape, 3)
    return (
        np.eye(3)
        + np.sinc(angle / np.pi) * cross
        + 0.5 * np.sinc(angle / 2 / np.pi) ** 2 * cross @ cross
    )
