"""Inertia of point masses: tensor, principal frame, kind of body, in any consistent units."""

from typing import Literal, NamedTuple

import numpy as np

BodyKind = Literal["point", "linear", "spherical", "symmetric", "asymmetric"]

#: Two principal moments that differ by less than this fraction of the largest count as equal, and a
#: smaller moment as zero: 1e-8 in inertia is 1e-4 in length, a rounded coordinate.
SAME_MOMENT = 1e-8


class PrincipalFrame(NamedTuple):
    """The principal frame of a body, in which its inertia is diagonal.

    mass (u), centre (3,), axes (3, 3) with the principal axes as columns (right-handed), inertia
    (3,) ascending
    (u Å²), kind. A moment that counts as zero (point, linear) is exactly 0.
    """

    mass: float
    centre: np.ndarray
    axes: np.ndarray
    inertia: np.ndarray
    kind: BodyKind


def inertia_tensor(masses: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Inertia tensor (3, 3) about the origin of masses (s,) at positions (s, 3)."""
    squares = np.einsum("s,sk,sk->", masses, positions, positions)
    return squares * np.eye(3) - np.einsum("s,si,sj->ij", masses, positions, positions)


def shifted_inertia(tensor: np.ndarray, mass: float, offset: np.ndarray) -> np.ndarray:
    """Inertia tensor (3, 3) about a point at `offset` (3,) from the centre of mass, by the parallel
    axis theorem.

    tensor (3, 3) : about the centre of mass. A negative mass gives the inverse
    """
    return tensor + inertia_tensor(np.array([mass]), np.array([offset], dtype=float))


def inertia_error(tensor: np.ndarray, scale: float = 0.0) -> str:
    """Why no mass distribution has this inertia tensor (3, 3), or an empty text if such a
    distribution exists. The tolerance for rounding is 1e-12 of the largest moment, or of `scale` if
    the tensor is a difference of larger ones."""
    low, middle, high = np.linalg.eigvalsh(tensor)
    slack = 1e-12 * max(abs(low), abs(high), scale)
    if low < -slack:
        return f"a principal moment is {low:.6g}, must not be negative"
    if low + middle < high - slack:
        return (
            f"principal moments {low:.6g} and {middle:.6g} together are less than {high:.6g}"
            " (triangle inequality)"
        )
    return ""


def principal_frame(
    masses: np.ndarray, positions: np.ndarray, size: float | None = None
) -> PrincipalFrame:
    """Principal frame of masses (s,) at positions (s, 3).

    `size` is the length scale for the decision that all masses are at one point. By default, the
    largest distance of a position from the centre of mass.
    """
    masses = np.asarray(masses, dtype=float)
    positions = np.asarray(positions, dtype=float)
    mass = masses.sum()
    centre = masses @ positions / mass
    relative = positions - centre
    if size is None:
        size = np.linalg.norm(relative, axis=1).max(initial=0.0)
    moments, axes = np.linalg.eigh(inertia_tensor(masses, relative))
    if moments[2] <= SAME_MOMENT * mass * size**2:
        return PrincipalFrame(mass, centre, np.eye(3), np.zeros(3), "point")
    # eigh leaves signs undefined: make the largest component of each axis positive, then the frame
    # right-handed.
    axes = axes * np.sign(axes[np.abs(axes).argmax(axis=0), [0, 1, 2]])
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    kind = kind_of_body(moments)
    if kind == "linear":
        moments = np.array([0.0, moments[2], moments[2]])
    elif kind == "spherical":
        moments = np.full(3, moments.mean())
    elif kind == "symmetric":  # equal to the last bit, so that the rotor is exact
        pair = [0, 1] if moments[1] - moments[0] < moments[2] - moments[1] else [1, 2]
        moments[pair] = moments[pair].mean()
    return PrincipalFrame(mass, centre, axes, moments, kind)


def kind_of_body(inertia: np.ndarray) -> BodyKind:
    """Kind of body from three principal moments in any order."""
    low, middle, high = np.sort(inertia)
    if high == 0:
        return "point"
    if low <= SAME_MOMENT * high:
        return "linear"
    if high - low <= SAME_MOMENT * high:
        return "spherical"
    if min(high - middle, middle - low) <= SAME_MOMENT * high:
        return "symmetric"
    return "asymmetric"


def rotational_freedom(kind: BodyKind) -> int:
    """Rotational degrees of freedom: 0 for a point, 2 for a linear body, otherwise 3."""
    return {"point": 0, "linear": 2}.get(kind, 3)
