"""Rotations, inertia and the free rotor, also for any values that hypothesis finds."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from support import known
from support.common import spin

from rigidmd.compile import kernel
from rigidmd.core.state import Load, state_of
from rigidmd.mechanics.batches import LANES, kick_group, rotate_group
from rigidmd.mechanics.free_rotor import NO_SYMMETRY, ExactRotor, rotate, split_rotor
from rigidmd.mechanics.inertia import inertia_tensor, kind_of_body, principal_frame
from rigidmd.mechanics.rotation import (
    align,
    from_euler_angles,
    from_quaternion,
    from_vector,
    orthogonality_error,
    random_rotations,
    to_euler_angles,
    to_quaternion,
)


@kernel(from_python=True)
def turn_all(rotor, species, rotation, angular_momentum, h, together):
    if together:
        rotate_group(rotor, species, rotation, angular_momentum, 0, len(rotation), h)
    else:
        for m in range(len(rotation)):
            rotate(rotor, species[m], rotation, angular_momentum, m, h)


@pytest.mark.parametrize("moments", ["of every kind", "of two axes", "round"])
@pytest.mark.parametrize("longest", [0.2, 3.0])
def test_many_bodies_rotate_together_as_one_by_one(moments, longest):
    """All six orders of axes, symmetric, linear and spherical bodies; short rotates, and some too
    long for the series."""
    rng = np.random.default_rng(4)
    inertia = {
        "of every kind": [
            [1, 2, 2.5],
            [1, 2.5, 2],
            [2, 1, 2.5],
            [2, 2.5, 1],
            [2.5, 1, 2],
            [2.5, 2, 1],
            [1, 1, 1.5],
            [2, 2, 2],
            [0, 1, 1],
            [1.5, 1, 1],
            [0.5, 1.4, 1.5],
            [1.4, 0.5, 1.5],
        ],
        "of two axes": [[1, 1, 1.5], [1.5, 1, 1]],
        "round": [[2, 2, 2], [0, 1, 1]],
    }[moments]
    rotor = split_rotor(np.array(inertia, float))
    n = 20 * LANES + 1
    species = rng.integers(0, len(inertia), n)
    rotation = random_rotations(rng, n)
    momentum = rng.standard_normal((n, 3)) * (rotor.inverse_inertia[species] > 0)
    momentum *= longest * rng.random((n, 1)) / np.linalg.norm(momentum, axis=1, keepdims=True)
    found = []
    for together in (False, True):
        q, momenta = rotation.copy(), momentum.copy()
        turn_all(rotor, species, q, momenta, 0.7, together)
        turn_all(rotor, species, q, momenta, -0.3, together)
        found.append((q, momenta))
    assert found[1][0] == pytest.approx(found[0][0], abs=2e-15)
    assert found[1][1] == pytest.approx(found[0][1], abs=2e-15 * longest)
    assert np.abs(found[0][0] - rotation).max() > 0.02


def test_one_body_that_is_not_a_number_leaves_its_group_alone():
    rng = np.random.default_rng(5)
    rotor, species = split_rotor(np.array([[1.0, 2.0, 2.5]])), np.zeros(20, int)
    rotation, momentum = random_rotations(rng, 20), rng.standard_normal((20, 3))
    momentum[7, 1] = np.nan
    turn_all(rotor, species, rotation, momentum, 0.01, True)
    assert np.array_equal(np.isnan(rotation).any(axis=(1, 2)), np.arange(20) == 7)


@kernel(from_python=True)
def kick_all(species, inverse_mass, inverse_inertia, state, load, h):
    kick_group(species, inverse_mass, inverse_inertia, state, load, 0, len(species), h)


@pytest.mark.parametrize("turning", [True, False])
def test_many_bodies_are_kicked_together(turning):
    """Species in any order, one of them linear; as many bodies as do not fill the last group.
    Points have no momenta."""
    rng, n = np.random.default_rng(6), 5 * LANES + 1
    species, inverse_mass = rng.integers(0, 3, n).astype(np.int32), np.array([1.0, 0.25, 0.0])
    inverse_inertia = np.array([[1.0, 2.0, 3.0], [0.0, 1.0, 1.0], [1.0, 1.0, 1.0]])
    turns = n if turning else 0
    state = state_of(
        np.zeros((n, 3)),
        rng.standard_normal((n, 3)),
        np.zeros((turns, 3, 3)),
        rng.standard_normal((turns, 3)),
        np.eye(3),
    )
    load = Load(rng.standard_normal((n, 3)), rng.standard_normal((turns, 3)))
    velocity = state.velocity + 0.3 * inverse_mass[species, None] * load.force
    idle = inverse_inertia[species[:turns]] == 0
    state.angular_momentum_body[idle] = -0.0  # which a sum with 0 would change
    moved = 0.3 * load.torque_body * ~idle
    load.torque_body[idle] = np.nan
    momentum = state.angular_momentum_body + moved
    kick_all(species, inverse_mass, inverse_inertia, state, load, 0.3)
    assert state.velocity == pytest.approx(velocity, abs=1e-15)
    assert state.angular_momentum_body == pytest.approx(momentum, abs=1e-15)
    assert np.signbit(state.angular_momentum_body[idle]).all()


def test_rotations_agree_with_scipy():
    rng = np.random.default_rng(0)
    quaternions, vectors = rng.standard_normal((20, 4)), rng.standard_normal((20, 3))
    vectors[0] = 0.0
    assert from_quaternion(quaternions) == pytest.approx(
        Rotation.from_quat(quaternions, scalar_first=True).as_matrix()
    )
    assert from_vector(vectors) == pytest.approx(Rotation.from_rotvec(vectors).as_matrix())


def test_random_rotations_are_uniform():
    q = random_rotations(np.random.default_rng(1), 20000)
    assert orthogonality_error(q) < 1e-14
    assert np.abs(q.mean(axis=0)).max() < 0.02  # no direction preferred
    assert (q**2).mean(axis=0) == pytest.approx(np.full((3, 3), 1 / 3), abs=0.01)


@pytest.mark.parametrize("shape", ["bent", "linear", "chiral"])
def test_align_finds_the_rotation(shape):
    rng = np.random.default_rng(2)
    points = {
        "bent": np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]),
        "linear": np.array([[0.0, 0, -1], [0, 0, 0], [0, 0, 1.5]]),
        "chiral": rng.standard_normal((5, 3)),
    }[shape]
    masses = np.arange(1.0, len(points) + 1)
    points = points - masses @ points / masses.sum()
    turned = np.einsum("nij,sj->nsi", random_rotations(rng, 30), points)
    found = align(points, turned, masses)
    assert np.einsum("nij,sj->nsi", found, points) == pytest.approx(turned, abs=1e-12)
    assert np.linalg.det(found) == pytest.approx(np.ones(30))


def test_principal_frame_diagonalises_and_sees_the_kind():
    rng = np.random.default_rng(3)
    q = random_rotations(rng, 1)[0]
    bodies = {
        "point": ([2.0], [[0, 0, 0]]),
        "linear": ([1, 2, 3], [[0, 0, -1], [0, 0, 0], [0, 0, 2]]),
        "spherical": ([1, 1, 1, 1], [[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]),
        "symmetric": ([1, 1, 1], [[1, 0, 0], [-0.5, 0.75**0.5, 0], [-0.5, -(0.75**0.5), 0]]),
        "asymmetric": ([16, 1, 1], [[0, 0, 0], [0.8, 0.6, 0], [-0.8, 0.6, 0]]),
    }
    for kind, (masses, positions) in bodies.items():
        masses, positions = np.array(masses, float), np.array(positions, float)
        frame = principal_frame(masses, positions @ q.T + 5.0)
        assert frame.kind == kind
        x = (positions @ q.T + 5.0 - frame.centre) @ frame.axes
        tensor = (
            masses[:, None, None]
            * ((x**2).sum(1)[:, None, None] * np.eye(3) - x[:, :, None] * x[:, None])
        ).sum(0)
        assert tensor == pytest.approx(
            np.diag(frame.inertia), abs=1e-12 * max(1, frame.inertia.max())
        )
        assert np.linalg.det(frame.axes) == pytest.approx(1)


@pytest.mark.parametrize("scale", [1e-15, 1.0, 1e15])
def test_the_kind_does_not_depend_on_units(scale):
    assert kind_of_body(scale * np.array([1.0, 2.0, 3.0])) == "asymmetric"
    assert kind_of_body(scale * np.array([3.0, 1e-9, 3.0])) == "linear"


def euler_equations(inertia, rotation, angular_momentum, t):
    def slope(_, y):
        q, l = y[:9].reshape(3, 3), y[9:]  # noqa: E741
        w = l / inertia
        hat = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        return np.concatenate([(q @ hat).ravel(), np.cross(l, w)])

    y = np.concatenate([rotation.ravel(), angular_momentum])
    y = solve_ivp(slope, (0, t), y, method="DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    return y[:9].reshape(3, 3), y[9:]


def test_the_split_rotor_is_of_order_two_and_reversible():
    inertia = np.array([1.0, 2.0, 3.5])
    rotor = split_rotor(inertia[None])
    q0, l0 = random_rotations(np.random.default_rng(4), 1), np.array([[0.8, -1.5, 2.0]])
    q_exact, l_exact = euler_equations(inertia, q0[0], l0[0], 2.0)
    errors = []
    for steps in (40, 80, 160):
        q, l = q0.copy(), l0.copy()  # noqa: E741
        spin(rotor, q, l, 2.0 / steps, steps)
        errors.append(max(np.abs(q[0] - q_exact).max(), np.abs(l[0] - l_exact).max()))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert orders == pytest.approx([2, 2], abs=0.1)
    spin(rotor, q, l, -2.0 / steps, steps)
    assert q == pytest.approx(q0, abs=1e-13)
    assert l == pytest.approx(l0, abs=1e-13)


def test_a_free_top_keeps_its_angular_momentum_for_a_million_steps():
    inertia = np.array([[0.6, 1.1, 1.7]])
    q, l = np.eye(3)[None].copy(), np.array([[3.0, -2.0, 5.0]])  # noqa: E741
    lab, size = q[0] @ l[0], np.linalg.norm(l)
    spin(split_rotor(inertia), q, l, 0.01, 1_000_000)
    # five plane rotations a step, each good to 1e-16: a random walk of 5e6 steps ends near 2e-13
    assert abs(np.linalg.norm(l) / size - 1) < 2e-12
    assert np.abs(q[0] @ l[0] - lab).max() < 2e-12 * size
    assert orthogonality_error(q) < 2e-12


@pytest.mark.parametrize("inertia", [[0.0, 2.0, 2.0], [2.0, 2.0, 0.0], [3.0, 3.0, 3.0]])
def test_linear_and_spherical_bodies_rotate_exactly(inertia):
    inertia = np.array([inertia])
    momentum = np.array([[0.5, 0.3, -0.4]]) * (inertia > 0)
    q, l = random_rotations(np.random.default_rng(7), 1), momentum.copy()  # noqa: E741
    start = q.copy()
    spin(split_rotor(inertia), q, l, 0.02, 5000)
    assert (l == momentum).all()  # nothing reaches an axis without inertia
    expected = start[0] @ from_vector(100 * momentum[0] / inertia.max())
    assert q[0] == pytest.approx(expected, abs=1e-11)
    assert orthogonality_error(q) < 1e-12


FREE_TOPS = [
    ([1.0, 1.6, 2.2], [1.0, 0.8, -0.7]),
    ([2.2, 1.0, 1.6], [1.0, 0.8, -0.7]),
    ([1.0, 2.0, 3.0], [1e-2, 1.0, 0.0]),  # m = 1 - 4e-4
    ([1.0, 2.0, 3.0], [1e-8, 1.0, 0.0]),  # m = 1 to rounding: the separatrix
    ([1.0, 2.0, 3.0], [0.0, 1.0, 0.0]),  # L along an axis
    ([1.0, 2.0, 3.0], [1.0, 0.0, 0.0]),
    ([1.0, 2.0, 3.0], [1e-20, 0.0, 1.0]),
    ([1.0, 1.0 + 1e-12, 2.0], [1.0, 1.0, 1.0]),  # nearly symmetric
    ([1.0, 1.0 + 1e-12, 1.0 + 2e-12], [1.0, 1.0, 1.0]),  # nearly spherical
    ([1e-3, 1.0, 1.0005], [1.0, 1.0, 1.0]),  # nearly linear
    ([1.0, 1.0, 2.0], [1.0, 0.5, 0.7]),
    ([1e-12, 2e-12, 2.5e-12], [1e9, 2e9, -1e9]),  # in other units
]


@pytest.mark.parametrize(("inertia", "omega"), FREE_TOPS)
@pytest.mark.parametrize(("h", "steps"), [(0.02, 200), (0.3, 20), (4.0, 1)])
def test_the_exact_rotor_is_exact(inertia, omega, h, steps):
    inertia, omega = np.array(inertia), np.array(omega)
    h = h / np.abs(omega).max()  # so that it is an angle
    start = random_rotations(np.random.default_rng(5), 1)
    q, l = start.copy(), (inertia * omega)[None].copy()  # noqa: E741
    spin(ExactRotor(*split_rotor(inertia[None])), q, l, h, steps)
    spun, turned = known.free_asymmetric_top(inertia, start[0], omega, np.array([h * steps]))
    # a rounded L rotates a nearly linear body about its axis by so much more
    allowed = 1e-13 + 4e-15 * inertia.max() / inertia.min()
    assert np.abs(q[0] - turned[0]).max() < allowed
    assert np.abs(l[0] / inertia - spun[0]).max() < allowed * np.abs(omega).max()
    assert orthogonality_error(q) < 1e-14
    spin(ExactRotor(*split_rotor(inertia[None])), q, l, -h, steps)
    assert np.abs(q - start).max() < allowed


def test_the_exact_rotor_agrees_with_a_general_solver():
    inertia, omega = np.array([1.0, 1.6, 2.2]), np.array([1.0, 0.8, -0.7])
    start = random_rotations(np.random.default_rng(6), 1)
    q, l = start.copy(), (inertia * omega)[None].copy()  # noqa: E741
    spin(ExactRotor(*split_rotor(inertia[None])), q, l, 2.0, 1)
    exact_q, exact_l = euler_equations(inertia, start[0], inertia * omega, 2.0)
    assert np.abs(q[0] - exact_q).max() < 2e-13
    assert np.abs(l[0] - exact_l).max() < 2e-13


def test_the_exact_rotor_keeps_energy_and_momentum_for_a_million_steps():
    inertia = np.array([[0.6, 1.1, 1.7]])
    q, l = np.eye(3)[None].copy(), np.array([[3.0, -2.0, 5.0]])  # noqa: E741
    rotor = ExactRotor(*split_rotor(inertia))
    assert rotor.symmetry[0] == NO_SYMMETRY
    lab, size, energy = q[0] @ l[0], np.linalg.norm(l), (l**2 / inertia).sum()
    spin(rotor, q, l, 0.01, 1_000_000)
    assert abs(np.linalg.norm(l) / size - 1) < 2e-13
    assert abs((l**2 / inertia).sum() / energy - 1) < 2e-13
    assert np.abs(q[0] @ l[0] - lab).max() < 5e-13 * size
    assert orthogonality_error(q) < 5e-13


def test_a_body_that_does_not_rotate_or_is_not_a_number_stays_so():
    rotor = ExactRotor(*split_rotor(np.array([[0.6, 1.1, 1.7]])))
    q, l = np.eye(3)[None].copy(), np.zeros((1, 3))  # noqa: E741
    spin(rotor, q, l, 0.01, 3)
    assert (q == np.eye(3)).all()
    l[:] = [np.nan, 1.0, 1.0]
    spin(rotor, q, l, 0.01, 3)
    assert np.isnan(l).any()


def test_a_rotation_too_long_to_mean_anything_becomes_no_number_at_once():
    rotor = ExactRotor(*split_rotor(np.array([[0.6, 1.1, 1.7]])))
    q, l = np.eye(3)[None].copy(), np.array([[1e15, 2e15, 3e15]])  # noqa: E741
    spin(rotor, q, l, 1.0, 1)  # in parts of half a radian it would take a year
    assert np.isnan(l).all()
    l[:] = [1.0, 2.0, 3.0]
    spin(rotor, q, l, 1000.0, 1)
    assert np.linalg.norm(l) == pytest.approx(14**0.5, rel=1e-12)


FEW = settings(max_examples=60, deadline=None, derandomize=True, database=None)
ROUNDING = 4e-15


def floats(low: float, high: float):
    return st.floats(low, high, allow_nan=False)


def vectors(size: float = 1.0, length: int = 3):
    return st.tuples(*[floats(-size, size)] * length).map(np.array)


quaternions = vectors(1.0, 4).filter(lambda q: np.linalg.norm(q) > 1e-100)
angles = vectors(100.0)


@FEW
@given(quaternions)
def test_any_rotation_comes_back_from_every_way_to_write_it(quaternion):
    q = from_quaternion(quaternion / np.abs(quaternion).max())
    assert orthogonality_error(q[None]) < ROUNDING
    for there, back in (
        (to_quaternion, from_quaternion),
        (to_euler_angles, from_euler_angles),
    ):
        assert np.abs(back(there(q)) - q).max() < ROUNDING


@FEW
@given(angles)
def test_any_angles_come_back_as_the_same_rotation(turned):
    q = from_euler_angles(turned)
    assert np.abs(from_euler_angles(to_euler_angles(q)) - q).max() < ROUNDING


@FEW
@given(
    st.integers(1, 6).flatmap(lambda n: st.lists(vectors(10.0), min_size=n, max_size=n)), st.data()
)
def test_any_masses_have_a_principal_frame(positions, data):
    masses = np.array([data.draw(floats(1e-3, 1e3)) for _ in positions])
    positions = np.array(positions)
    frame = principal_frame(masses, positions)
    size = np.linalg.norm(positions - frame.centre, axis=1).max()
    scale = frame.mass * size**2
    assert np.abs(frame.axes @ frame.axes.T - np.eye(3)).max() < ROUNDING
    assert np.linalg.det(frame.axes) == pytest.approx(1, abs=ROUNDING)
    turned = frame.axes.T @ inertia_tensor(masses, positions - frame.centre) @ frame.axes
    # what counts as equal or zero is made so: 1e-8 of the largest
    assert np.abs(turned - np.diag(frame.inertia)).max() <= 2e-8 * scale
    assert (np.diff(frame.inertia) >= 0).all() or frame.kind == "spherical"
    assert frame.inertia[2] <= (frame.inertia[0] + frame.inertia[1]) * (1 + 3e-8)


#: Moments of a body: of three positive numbers, each pair added, so that no moment is more than the
#: sum of the others.
moments = st.tuples(*[floats(-6.0, 0.0)] * 3).map(
    lambda p: np.roll(10.0 ** np.array(p), 1) + np.roll(10.0 ** np.array(p), 2)
)


@FEW
@given(moments, floats(-80.0, 80.0), vectors(), floats(0.001, 1.0))
def test_a_free_rotor_keeps_what_it_should_for_any_inertia_at_any_scale(
    inertia, exponent, direction, h
):
    scale = 10.0**exponent
    size = np.linalg.norm(direction)
    if size < 1e-3:
        direction, size = np.array([1.0, 0.0, 0.0]), 1.0
    momentum = direction / size
    step = h / np.abs(momentum / inertia).max()
    for rotor in (
        split_rotor(scale * inertia[None]),
        ExactRotor(*split_rotor(scale * inertia[None])),
    ):
        q, l = np.eye(3)[None].copy(), scale * momentum[None]  # noqa: E741
        spin(rotor, q, l, step, 100)
        assert np.linalg.norm(l[0] / scale) == pytest.approx(1, rel=1e-13)
        assert np.abs(q[0] @ l[0] / scale - momentum).max() < 1e-13
        assert orthogonality_error(q) < 1e-13
        if isinstance(rotor, ExactRotor):
            # a moment a million times smaller than L²/2T has its energy from what rounding leaves
            # of L about it
            kinetic = [(v**2 / inertia).sum() for v in (momentum, l[0] / scale)]
            assert kinetic[1] == pytest.approx(
                kinetic[0], rel=1e-12 + 1e-15 * inertia.max() / inertia.min()
            )
