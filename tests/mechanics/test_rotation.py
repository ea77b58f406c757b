"""Other ways to write a rotation: quaternions, Euler angles and their rates, yaw-pitch-roll,
attitude matrices."""

import itertools

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rigidmd.mechanics.rotation import (
    angular_velocity_of_euler_rates,
    attitude_matrix,
    from_attitude_matrix,
    from_euler_angles,
    from_quaternion,
    from_vector,
    from_yaw_pitch_roll,
    hat,
    nearest_rotation,
    orthogonality_error,
    random_rotations,
    to_euler_angles,
    to_quaternion,
)

ROUNDING = 2e-15  # some ten roundings of a number near 1
TINY = [0.0, 1e-300, 1e-17, 1e-16, 3e-13, 1e-9, 1e-6]
X, Y, Z = np.eye(3)


def extreme_angles(middles):
    """Every first and last angle of a list that has all the corners, with every middle one (k,
    3)."""
    turns = [0.0, 1e-17, -1e-9, 0.7, np.pi / 2, -np.pi / 2, 2.5, -3.0, np.pi, 1e-9 - np.pi]
    return np.array(list(itertools.product(turns, middles, turns)))


def near(rng, rotations):
    """The same rotations, orthogonal only to rounding: every entry off by some 1e-16."""
    return rotations + 1e-16 * rng.standard_normal(rotations.shape)


def all_rotations(rng):
    """Random ones, half revolutions, quarter revolutions, barely any rotation, and everything close to a lock of
    either sequence."""
    axes = np.array(list(itertools.product([-1, 0, 1], repeat=3)), dtype=float)
    axes = axes[np.any(axes, axis=1)] / np.linalg.norm(
        axes[np.any(axes, axis=1)], axis=1, keepdims=True
    )
    angles = np.array([1e-17, 1e-9, np.pi / 2, np.pi - 1e-9, np.pi])
    tilts = TINY + [np.pi - tiny for tiny in TINY]
    lands = [sign * (np.pi / 2 - tiny) for tiny in TINY for sign in (1, -1)]
    exact = [
        *itertools.permutations(np.eye(3)),
        *itertools.permutations(-np.eye(3)),
        *itertools.permutations([X, -Y, -Z]),
    ]
    exact = np.array([q for q in np.array(exact) if np.linalg.det(q) > 0])
    rounded = np.concatenate(
        [
            random_rotations(rng, 500),
            from_vector(angles[:, None, None] * axes).reshape(-1, 3, 3),
            from_euler_angles(extreme_angles(tilts)),
            from_yaw_pitch_roll(extreme_angles(lands)),
            exact,
        ]
    )
    return np.concatenate([rounded, near(rng, rounded)])


def same_angle(one, other):
    """Largest difference of two sets of angles, full rotates aside."""
    return np.abs(np.remainder(one - other + np.pi, 2 * np.pi) - np.pi).max()


def test_hat_is_the_cross_product():
    a, b = np.random.default_rng(0).standard_normal((2, 4, 5, 3))
    assert (hat(a) @ b[..., None])[..., 0] == pytest.approx(np.cross(a, b))
    assert hat(X).shape == (3, 3)


def test_quaternions_of_all_rotations():
    q = all_rotations(np.random.default_rng(1))
    quaternions = to_quaternion(q)
    assert np.abs(np.linalg.norm(quaternions, axis=1) - 1).max() < ROUNDING
    assert np.abs(from_quaternion(quaternions) - q).max() < ROUNDING
    assert np.all(quaternions[:, 0] >= 0)
    scipy = Rotation.from_matrix(q).as_quat(scalar_first=True)
    assert np.abs(np.abs(np.sum(scipy * quaternions, axis=1)) - 1).max() < ROUNDING


@pytest.mark.parametrize(
    "quaternion",
    [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [0, 0.6, -0.8, 0], [0, 0, 0.6, -0.8]],
)
def test_sign_of_a_quaternion_is_that_of_its_first_component(quaternion):
    found = to_quaternion(from_quaternion(-np.array(quaternion, dtype=float)))
    assert found == pytest.approx(quaternion, abs=ROUNDING)
    assert not np.any(np.signbit(found) & (found == 0))


def test_small_rotations_keep_their_digits_in_a_quaternion():
    vectors = np.array([[1e-12, -2e-12, 3e-12], [0, 0, 1e-150]])
    assert to_quaternion(from_vector(vectors))[:, 1:] == pytest.approx(
        vectors / 2, rel=1e-14, abs=0
    )


def test_euler_angles_and_yaw_pitch_roll_are_the_sequences_they_claim():
    rng = np.random.default_rng(2)
    angles = rng.uniform(-np.pi, np.pi, (3, 20, 3))
    first, middle, last = np.moveaxis(angles, -1, 0)[..., None]
    assert from_euler_angles(angles) == pytest.approx(
        from_vector(first * Z) @ from_vector(middle * X) @ from_vector(last * Z)
    )
    assert from_yaw_pitch_roll(angles) == pytest.approx(
        from_vector(first * Z) @ from_vector(middle * Y) @ from_vector(last * X)
    )
    # Capital letters are scipy's intrinsic sequences: about the axes that rotate along, so the first
    # one stands leftmost.
    flat = angles.reshape(-1, 3)
    assert from_euler_angles(flat) == pytest.approx(Rotation.from_euler("ZXZ", flat).as_matrix())
    assert from_yaw_pitch_roll(flat) == pytest.approx(Rotation.from_euler("ZYX", flat).as_matrix())
    q = random_rotations(rng, 200)
    assert same_angle(to_euler_angles(q), Rotation.from_matrix(q).as_euler("ZXZ")) < 1e-12


def test_angles_give_every_rotation_back():
    q = all_rotations(np.random.default_rng(3))
    angles = to_euler_angles(q)
    assert np.abs(from_euler_angles(angles) - q).max() < ROUNDING
    assert np.all((angles[:, 1] >= 0) & (angles[:, 1] <= np.pi))
    assert np.all((angles[:, [0, 2]] > -np.pi) & (angles[:, [0, 2]] <= np.pi))
    assert not np.signbit(to_euler_angles(np.eye(3))).any()  # nobody wants to read -0
    stack = q[:24].reshape(2, 3, 4, 3, 3)
    assert np.array_equal(to_euler_angles(stack), angles[:24].reshape(2, 3, 4, 3))


def test_euler_angles_close_to_the_lock_keep_their_digits():
    angles = extreme_angles(TINY[1:])
    found = to_euler_angles(from_euler_angles(angles))
    assert same_angle(found[:, [0, 2]], angles[:, [0, 2]]) < ROUNDING
    assert found[:, 1] == pytest.approx(angles[:, 1], rel=1e-14, abs=0)
    upside_down = to_euler_angles(from_euler_angles([0.3, np.pi - 1e-6, 2.0]))
    assert upside_down == pytest.approx([0.3, np.pi - 1e-6, 2.0], abs=ROUNDING)


def test_at_the_lock_the_first_angle_holds_everything():
    half_turn_x = np.diag([1.0, -1, -1])
    turn = from_vector([0, 0, 0.4])
    assert to_euler_angles(from_euler_angles([1.5, 0, -0.2])) == pytest.approx(
        [1.3, 0, 0], abs=ROUNDING
    )
    assert to_euler_angles(turn @ half_turn_x) == pytest.approx([0.4, np.pi, 0], abs=ROUNDING)
    assert to_euler_angles(half_turn_x @ turn) == pytest.approx([-0.4, np.pi, 0], abs=ROUNDING)
    assert np.array_equal(to_euler_angles(np.diag([-1.0, -1, 1])), [np.pi, 0, 0])


def test_euler_rates_are_those_of_the_rotation():
    rng = np.random.default_rng(4)
    angles, rates = rng.uniform(-3, 3, (2, 50, 3))
    h = 1e-5
    change = (from_euler_angles(angles + h * rates) - from_euler_angles(angles - h * rates)) / (
        2 * h
    )
    omega = angular_velocity_of_euler_rates(angles, rates)
    assert change == pytest.approx(from_euler_angles(angles) @ hat(omega), abs=1e-8)
    attitudes = attitude_matrix(from_euler_angles(angles))
    assert attitude_matrix(change) == pytest.approx(-hat(omega) @ attitudes, abs=1e-8)
    # One set of angles and many rates, and the other way round.
    assert angular_velocity_of_euler_rates(angles[0], rates)[0] == pytest.approx(omega[0])


def test_attitude_matrices_are_the_inverse():
    q = random_rotations(np.random.default_rng(5), 6).reshape(2, 3, 3, 3)
    assert attitude_matrix(q) @ q == pytest.approx(
        np.broadcast_to(np.eye(3), q.shape), abs=ROUNDING
    )
    assert np.array_equal(from_attitude_matrix(attitude_matrix(q)), q)
    assert not np.shares_memory(attitude_matrix(q), q)


def test_nearest_rotation():
    rng = np.random.default_rng(6)
    matrices = rng.standard_normal((60, 3, 3))
    assert (np.linalg.det(matrices) < 0).any()
    nearest = nearest_rotation(matrices)
    assert orthogonality_error(nearest) < ROUNDING
    assert np.linalg.det(nearest) == pytest.approx(np.ones(60))
    distance = np.linalg.norm(matrices - nearest, axis=(1, 2))
    for others in (random_rotations(rng, 500), from_vector(1e-3 * rng.standard_normal((500, 3)))):
        rivals = nearest[:, None] @ others if others[0, 0, 0] > 0.99 else others[None]
        assert np.all(
            np.linalg.norm(matrices[:, None] - rivals, axis=(2, 3)) >= distance[:, None] - 1e-12
        )
    q = all_rotations(rng)
    assert np.abs(nearest_rotation(q) - q).max() < ROUNDING
    assert nearest_rotation(3 * q[0]) == pytest.approx(q[0])
