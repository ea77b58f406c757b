"""Kinetic energies, kicks, friction with noise and rotations of several bodies at a time, in SIMD
vectors.

In rotations each lane has a body: for a single body, each factor of a rotation would wait for the
one before it.
"""

import numpy as np

from rigidmd.compile import chosen_by_type, is_a, kernel
from rigidmd.compile.simd import (
    align_stack,
    broadcast,
    lane_count,
    load,
    mask_bits,
    select,
    store,
    sum_lanes,
)
from rigidmd.compile.simd_memory import load_matrices, load_vectors, store_matrices, store_vectors
from rigidmd.mechanics.free_rotor import (
    SHORT_ANGLE2,
    SplitRotor,
    rotate,
    rotate_vector,
    rotation_coefficient_series,
)

LANES = lane_count(np.float64)  # bodies that are rotated together
#: Rows of the constants of the species in each lane: axes a and b (as numbers), h g, h (1/I - g)
#: about a, b and c, the square of the largest of these, and 1 if the axes a, b, c are left-handed,
#: -1 if right-handed.
AXIS_A = 0
AXIS_B = 1
COMMON = 2
RATE = 3
LARGEST_RATE2 = 6
HANDEDNESS = 7
ROWS = 8


@kernel
def kick_group(species, inverse_mass, inverse_inertia, state, body_load, first, end, h):
    """V += h F/m, L += h n_body of molecules first ... end - 1. Axes without inertia keep their
    momentum."""
    velocity, momentum = state.velocity, state.angular_momentum_body
    force, torque = body_load.force, body_load.torque_body
    kinds = np.full(LANES, -1)
    velocity_factors, torque_factors = np.empty(3 * LANES), np.empty(3 * LANES)
    rotates = len(momentum) > 0
    while first + LANES <= end:
        if _species_changed(kinds, species, first):
            for n in range(3 * LANES):
                kind = kinds[n // 3]
                velocity_factors[n] = h * inverse_mass[kind]
                torque_factors[n] = h if inverse_inertia[kind, n % 3] > 0 else 0.0
        for n in range(0, 3 * LANES, LANES):
            at = 3 * first + n
            store(velocity, at, load(velocity, at) + load(velocity_factors, n) * load(force, at))
            if rotates:
                before, factor = load(momentum, at), load(torque_factors, n)
                store(
                    momentum, at, select(factor == 0.0, before, before + factor * load(torque, at))
                )
        first += LANES
    for m in range(first, end):
        kind = species[m]
        for k in range(3):
            velocity[m, k] += h * inverse_mass[kind] * force[m, k]
            if rotates and inverse_inertia[kind, k] > 0:
                momentum[m, k] += h * torque[m, k]


@kernel
def kinetic_energies(species, mass, inverse_inertia, velocity, momentum, first, end):
    """Translational and rotational kinetic energy of molecules first ... end - 1."""
    kinds = np.full(LANES, -1)
    masses, inverses = np.empty(3 * LANES), np.empty(3 * LANES)
    rotates = len(momentum) > 0
    zero = broadcast(0.0, velocity)
    translation_sums, rotation_sums = (zero, zero, zero), (zero, zero, zero)
    while first + LANES <= end:
        if _species_changed(kinds, species, first):
            for n in range(3 * LANES):
                masses[n], inverses[n] = mass[kinds[n // 3]], inverse_inertia[kinds[n // 3], n % 3]
        translation_sums = _with_squares(translation_sums, masses, velocity, 3 * first)
        if rotates:
            rotation_sums = _with_squares(rotation_sums, inverses, momentum, 3 * first)
        first += LANES
    translational = sum_lanes(translation_sums[0] + translation_sums[1] + translation_sums[2])
    rotational = sum_lanes(rotation_sums[0] + rotation_sums[1] + rotation_sums[2])
    for m in range(first, end):
        kind = species[m]
        for k in range(3):
            translational += mass[kind] * velocity[m, k] ** 2
            if rotates:
                rotational += inverse_inertia[kind, k] * momentum[m, k] ** 2
    return 0.5 * translational, 0.5 * rotational


@kernel(inline=True)
def _with_squares(sums, weights, values, at):
    """Three vectors of sums, with the weighted squares of the values (n, 3) of one molecule per
    lane added."""
    x, y, z = load(values, at), load(values, at + LANES), load(values, at + 2 * LANES)
    a, b, c = sums
    return (
        a + load(weights, 0) * x * x,
        b + load(weights, LANES) * y * y,
        c + load(weights, 2 * LANES) * z * z,
    )


@kernel
def scale_group(values, first, end, scale):
    """Multiply rows first ... end - 1 of an array (n, 3) by a number, in place."""
    at = 3 * first
    while at + LANES <= 3 * end:
        store(values, at, load(values, at) * scale)
        at += LANES
    for n in range(at, 3 * end):
        values[n // 3, n % 3] *= scale


@kernel
def apply_langevin_group(model, state, keep, keep_momentum, noise, numbers, first, end):
    """Friction and noise: v <- keep v + size xi, and likewise angular momenta, of molecules first
    ... end - 1.

    noise (species, 4) : sizes along each axis of a body, and that of a velocity. numbers (6 k,) :
    number j of molecule first + m is numbers[k j + m]. Three for its velocity, then three for its
    angular momentum. Returns the kinetic energy gained.
    """
    species, velocity, momentum = model.species, state.velocity, state.angular_momentum_body
    kinds = np.full(LANES, -1)
    constants = np.empty(8 * LANES)
    rotates = len(momentum) > 0
    stride = len(numbers) // 6
    gained = broadcast(0.0, velocity)
    at = 0
    while first + LANES <= end:
        if _species_changed(kinds, species, first):
            for n in range(LANES):
                kind = kinds[n]
                for k in range(3):
                    constants[k * LANES + n] = noise[kind, k]
                    constants[(4 + k) * LANES + n] = model.inverse_inertia[kind, k]
                constants[3 * LANES + n], constants[7 * LANES + n] = (
                    noise[kind, 3],
                    model.mass[kind],
                )
        size = load(constants, 3 * LANES)
        before = load_vectors(velocity, first)
        after = _friction_and_noise(before, keep, (size, size, size), numbers, at, stride)
        store_vectors(velocity, first, after)
        x, y, z = _square_gain(before, after)
        gained += load(constants, 7 * LANES) * (x + y + z)
        if rotates:
            sizes = load(constants, 0), load(constants, LANES), load(constants, 2 * LANES)
            before = load_vectors(momentum, first)
            after = _friction_and_noise(
                before, keep_momentum, sizes, numbers, 3 * stride + at, stride
            )
            store_vectors(momentum, first, after)
            x, y, z = _square_gain(before, after)
            gained += (
                load(constants, 4 * LANES) * x
                + load(constants, 5 * LANES) * y
                + load(constants, 6 * LANES) * z
            )
        first, at = first + LANES, at + LANES
    heat = sum_lanes(gained)
    for m in range(first, end):
        kind = species[m]
        for k in range(3):
            old = velocity[m, k]
            velocity[m, k] = keep * old + noise[kind, 3] * numbers[stride * k + at]
            heat += model.mass[kind] * (velocity[m, k] ** 2 - old * old)
            if rotates:
                old = momentum[m, k]
                momentum[m, k] = (
                    keep_momentum * old + noise[kind, k] * numbers[stride * (3 + k) + at]
                )
                heat += model.inverse_inertia[kind, k] * (momentum[m, k] ** 2 - old * old)
        at += 1
    return 0.5 * heat


@kernel(inline=True)
def _friction_and_noise(before, keep, sizes, numbers, at, stride):
    """Vectors of one molecule per lane after friction and noise."""
    return (
        keep * before[0] + sizes[0] * load(numbers, at),
        keep * before[1] + sizes[1] * load(numbers, at + stride),
        keep * before[2] + sizes[2] * load(numbers, at + 2 * stride),
    )


@kernel(inline=True)
def _square_gain(before, after):
    """Increase of the square of each component."""
    a, b, c = before
    x, y, z = after
    return x * x - a * a, y * y - b * b, z * z - c * c


@chosen_by_type
def rotate_group(rotor, species, rotation, angular_momentum_body, first, end, h):
    """`free_rotor.rotate` for molecules first ... end - 1."""
    if not is_a(rotor, SplitRotor):
        return _rotate_one_by_one.py_func

    def rotate_together(rotor, species, rotation, angular_momentum_body, first, end, h):
        align_stack()
        constants = np.empty(ROWS * LANES)
        kinds = np.full(LANES, -1)
        whole = (1 << LANES) - 1
        about = (False, False, False)
        while first + LANES <= end:
            if _species_changed(kinds, species, first):
                about = _set_constants(constants, kinds, rotor, h)
            momentum = load_vectors(angular_momentum_body, first)
            x, y, z = momentum
            if (
                mask_bits(
                    load(constants, LARGEST_RATE2 * LANES) * (x * x + y * y + z * z) < SHORT_ANGLE2
                )
                != whole
            ):
                _rotate_one_by_one(
                    rotor, species, rotation, angular_momentum_body, first, first + LANES, h
                )
            elif about[0] | about[1] | about[2]:
                _rotate_lanes(constants, about, rotation, angular_momentum_body, first, momentum)
            else:
                common = load(constants, COMMON * LANES)
                along = (common * x, common * y, common * z)
                rotated = _rotate_about_momenta(load_matrices(rotation, first), along, -1.0)
                store_matrices(rotation, first, rotated)
            first += LANES
        _rotate_one_by_one(rotor, species, rotation, angular_momentum_body, first, end, h)

    return rotate_together


@kernel
def _rotate_one_by_one(rotor, species, rotation, angular_momentum_body, first, end, h):
    for m in range(first, end):
        rotate(rotor, species[m], rotation, angular_momentum_body, m, h)


@kernel(inline=True)
def _species_changed(kinds, species, first):
    """Whether the species of the lanes differ from `kinds`, which is then updated."""
    same = True
    for n in range(len(kinds)):
        same &= kinds[n] == species[first + n]
    if not same:
        for n in range(len(kinds)):
            kinds[n] = species[first + n]
    return not same


@kernel
def _set_constants(constants, kinds, rotor, h):
    """Fill the rows of constants. Returns whether any body rotates about each of the axes a, b,
    c."""
    about_a = about_b = about_c = False
    for n in range(LANES):
        kind = kinds[n]
        a, b, c = rotor.order[kind, 0], rotor.order[kind, 1], rotor.order[kind, 2]
        common = h * rotor.common[kind]
        rates = rotor.excess[kind]
        constants[AXIS_A * LANES + n], constants[AXIS_B * LANES + n] = a, b
        constants[COMMON * LANES + n] = common
        constants[RATE * LANES + n] = h * rates[a]
        constants[(RATE + 1) * LANES + n] = h * rates[b]
        constants[(RATE + 2) * LANES + n] = h * rates[c]
        fastest = max(abs(common), abs(h * rates[a]), abs(h * rates[b]), abs(h * rates[c]))
        constants[LARGEST_RATE2 * LANES + n] = fastest**2
        constants[HANDEDNESS * LANES + n] = -1.0 if (b - a) % 3 == 1 else 1.0
        about_a |= rates[a] != 0.0
        about_b |= rates[b] != 0.0
        about_c |= rates[c] != 0.0
    return about_a, about_b, about_c


@kernel(inline=True)
def _rotate_lanes(constants, about, rotation, angular_momentum_body, first, momentum):
    """`free_rotor.rotate_by_splitting` for one body per lane, in the frame of the rotor's axes a,
    b, c."""
    a, b, sign = (
        load(constants, AXIS_A * LANES),
        load(constants, AXIS_B * LANES),
        load(constants, HANDEDNESS * LANES),
    )
    axes = (a == 0.0, b == 0.0, a == 1.0, b == 1.0)
    q = load_matrices(rotation, first)
    L = _to_rotor_axes(momentum, axes)
    common = load(constants, COMMON * LANES)
    along = (common * L[0], common * L[1], common * L[2])
    ordered = (
        _to_rotor_axes(q[:3], axes) + _to_rotor_axes(q[3:6], axes) + _to_rotor_axes(q[6:], axes)
    )
    q0, q1, q2, q3, q4, q5, q6, q7, q8 = _rotate_about_momenta(ordered, along, sign)
    L0, L1, L2 = L
    if about[0]:
        angle = 0.5 * load(constants, RATE * LANES) * L0
        L1, L2, q1, q2, q4, q5, q7, q8 = _rotate_about_axis(
            angle, sign, L1, L2, q1, q2, q4, q5, q7, q8
        )
    if about[1]:
        angle = 0.5 * load(constants, (RATE + 1) * LANES) * L1
        L2, L0, q2, q0, q5, q3, q8, q6 = _rotate_about_axis(
            angle, sign, L2, L0, q2, q0, q5, q3, q8, q6
        )
    if about[2]:
        angle = load(constants, (RATE + 2) * LANES) * L2
        L0, L1, q0, q1, q3, q4, q6, q7 = _rotate_about_axis(
            angle, sign, L0, L1, q0, q1, q3, q4, q6, q7
        )
    if about[1]:
        angle = 0.5 * load(constants, (RATE + 1) * LANES) * L1
        L2, L0, q2, q0, q5, q3, q8, q6 = _rotate_about_axis(
            angle, sign, L2, L0, q2, q0, q5, q3, q8, q6
        )
    if about[0]:
        angle = 0.5 * load(constants, RATE * LANES) * L0
        L1, L2, q1, q2, q4, q5, q7, q8 = _rotate_about_axis(
            angle, sign, L1, L2, q1, q2, q4, q5, q7, q8
        )
    transposed = (axes[0], axes[2], axes[1], axes[3])
    x, y, z = _to_rotor_axes((L0, L1, L2), transposed)
    # its momentum is kept, with the signs of zeros
    unchanged = load(constants, RATE * LANES) == 0.0
    unchanged = (
        unchanged
        & (load(constants, (RATE + 1) * LANES) == 0.0)
        & (load(constants, (RATE + 2) * LANES) == 0.0)
    )
    kept = (
        select(unchanged, momentum[0], x),
        select(unchanged, momentum[1], y),
        select(unchanged, momentum[2], z),
    )
    store_vectors(angular_momentum_body, first, kept)
    back = (
        _to_rotor_axes((q0, q1, q2), transposed)
        + _to_rotor_axes((q3, q4, q5), transposed)
        + _to_rotor_axes((q6, q7, q8), transposed)
    )
    store_matrices(rotation, first, back)


@kernel(inline=True)
def _to_rotor_axes(vector, axes):
    """Components of a body vector along the rotor's axes a, b, c, or with the transposed axes the
    body vector of such components."""
    x, y, z = vector
    a_is_x, b_is_x, a_is_y, b_is_y = axes
    return (
        select(a_is_x, x, select(a_is_y, y, z)),
        select(b_is_x, x, select(b_is_y, y, z)),
        select(a_is_x | b_is_x, select(a_is_y | b_is_y, z, y), x),
    )


@kernel(inline=True)
def _rotate_about_momenta(q, along, sign):
    """Rows of rotations (nine numbers) after a rotation along a vector:
    `free_rotor.rotate_by_vector`."""
    x, y, z = along
    odd, even = rotation_coefficient_series(x * x + y * y + z * z)
    odd = sign * odd
    return (
        rotate_vector(q[0], q[1], q[2], x, y, z, odd, even)
        + rotate_vector(q[3], q[4], q[5], x, y, z, odd, even)
        + rotate_vector(q[6], q[7], q[8], x, y, z, odd, even)
    )


@kernel(inline=True)
def _rotate_about_axis(angle, sign, La, Lb, a0, b0, a1, b1, a2, b2):
    """`free_rotor.rotate_about_axis`: the other two components of the momenta, and of each row of
    the rotations."""
    odd, even = rotation_coefficient_series(angle * angle)
    s = sign * (angle * odd)
    versine = angle * angle * even
    return (
        _rotate_pair(La, Lb, s, versine)
        + _rotate_pair(a0, b0, s, versine)
        + _rotate_pair(a1, b1, s, versine)
        + _rotate_pair(a2, b2, s, versine)
    )


@kernel(inline=True)
def _rotate_pair(a, b, s, versine):
    return a - (s * b + versine * a), b + (s * a - versine * b)
