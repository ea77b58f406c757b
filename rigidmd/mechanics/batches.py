"""Kinetic energies, kicks, friction with noise and rotations of many bodies at a time.

Rotations have a body in each lane: with one body at a time, each part of a rotation waits for the one before it.
"""

import numpy as np

from rigidmd.compile import implements, is_a, kernel
from rigidmd.compile.simd import align_stack, broadcast, lane_count, load, mask_bits, select, store, sum_lanes
from rigidmd.compile.simd_records import load_matrices, load_vectors, store_matrices, store_vectors
from rigidmd.mechanics.free_rotor import SHORT_ANGLE2, SplitRotor, rotate, rotate_vector, rotation_coefficient_series

LANES = lane_count(np.float64)  # bodies that turn together
#: Rows of what the lanes have to know of their species: axes a and b (as numbers), h g, h (1/I - g) about a, b and c,
#: the square of the largest of these, and 1 if the axes a, b, c are left-handed, -1 if right-handed.
AXIS_A, AXIS_B, SHARE, RATE, FASTEST2, TURN, ROWS = 0, 1, 2, 3, 6, 7, 8


@kernel
def kick_group(species, inverse_mass, inverse_inertia, state, acting, first, end, h):
    """V += h F/m, L += h n_body of molecules first ... end - 1; no momentum gathers on an axis without inertia."""
    velocity, momentum, force, torque = state.velocity, state.angular_momentum_body, acting.force, acting.torque_body
    kinds = np.full(LANES, -1)
    shares, parts = np.empty(3 * LANES), np.empty(3 * LANES)
    turns = len(momentum) > 0
    while first + LANES <= end:
        if _are_others(kinds, species, first):
            for n in range(3 * LANES):
                kind = kinds[n // 3]
                shares[n] = h * inverse_mass[kind]
                parts[n] = h if inverse_inertia[kind, n % 3] > 0 else 0.0
        for n in range(0, 3 * LANES, LANES):
            at = 3 * first + n
            store(velocity, at, load(velocity, at) + load(shares, n) * load(force, at))
            if turns:
                before, part = load(momentum, at), load(parts, n)
                store(momentum, at, select(part == 0.0, before, before + part * load(torque, at)))
        first += LANES
    for m in range(first, end):
        kind = species[m]
        for k in range(3):
            velocity[m, k] += h * inverse_mass[kind] * force[m, k]
            if turns and inverse_inertia[kind, k] > 0:
                momentum[m, k] += h * torque[m, k]


@kernel
def kinetic_energies(species, mass, inverse_inertia, velocity, momentum, first, end):
    """Translational and rotational kinetic energy of molecules first ... end - 1."""
    kinds = np.full(LANES, -1)
    masses, inverses = np.empty(3 * LANES), np.empty(3 * LANES)
    turns = len(momentum) > 0
    zero = broadcast(0.0, velocity)
    moving, turning = (zero, zero, zero), (zero, zero, zero)
    while first + LANES <= end:
        if _are_others(kinds, species, first):
            for n in range(3 * LANES):
                masses[n], inverses[n] = mass[kinds[n // 3]], inverse_inertia[kinds[n // 3], n % 3]
        moving = _with_squares(moving, masses, velocity, 3 * first)
        if turns:
            turning = _with_squares(turning, inverses, momentum, 3 * first)
        first += LANES
    moved, rotate_vector = sum_lanes(moving[0] + moving[1] + moving[2]), sum_lanes(turning[0] + turning[1] + turning[2])
    for m in range(first, end):
        kind = species[m]
        for k in range(3):
            moved += mass[kind] * velocity[m, k] ** 2
            if turns:
                rotate_vector += inverse_inertia[kind, k] * momentum[m, k] ** 2
    return 0.5 * moved, 0.5 * rotate_vector


@kernel(inline=True)
def _with_squares(sums, weights, values, at):
    """Three vectors of sums, with the weighted squares of the values (n, 3) of as many molecules as lanes added."""
    x, y, z = load(values, at), load(values, at + LANES), load(values, at + 2 * LANES)
    return (
        sums[0] + load(weights, 0) * x * x,
        sums[1] + load(weights, LANES) * y * y,
        sums[2] + load(weights, 2 * LANES) * z * z,
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
def apply_langevin_group(model, state, keep, keep_turning, new, numbers, first, end):
    """Friction and noise: v <- keep v + size xi, and so the angular momenta, of molecules first ... end - 1.

    new (species, 4) : sizes along each axis of a body, and that of a velocity. numbers (6 k,) : number j of molecule
    first + m is numbers[k j + m]; three for its velocity, then three for its angular momentum. Returns the kinetic
    energy gained.
    """
    species, velocity, momentum = model.species, state.velocity, state.angular_momentum_body
    kinds, known = np.full(LANES, -1), np.empty(8 * LANES)
    turns, apart = len(momentum) > 0, len(numbers) // 6
    gained, at = broadcast(0.0, velocity), 0
    while first + LANES <= end:
        if _are_others(kinds, species, first):
            for n in range(LANES):
                kind = kinds[n]
                for k in range(3):
                    known[k * LANES + n] = new[kind, k]
                    known[(4 + k) * LANES + n] = model.inverse_inertia[kind, k]
                known[3 * LANES + n], known[7 * LANES + n] = new[kind, 3], model.mass[kind]
        size = load(known, 3 * LANES)
        before = load_vectors(velocity, first)
        after = _stirred(before, keep, (size, size, size), numbers, at, apart)
        store_vectors(velocity, first, after)
        x, y, z = _growth(before, after)
        gained += load(known, 7 * LANES) * (x + y + z)
        if turns:
            sizes = load(known, 0), load(known, LANES), load(known, 2 * LANES)
            before = load_vectors(momentum, first)
            after = _stirred(before, keep_turning, sizes, numbers, 3 * apart + at, apart)
            store_vectors(momentum, first, after)
            x, y, z = _growth(before, after)
            gained += load(known, 4 * LANES) * x + load(known, 5 * LANES) * y + load(known, 6 * LANES) * z
        first, at = first + LANES, at + LANES
    heat = sum_lanes(gained)
    for m in range(first, end):
        kind = species[m]
        for k in range(3):
            old = velocity[m, k]
            velocity[m, k] = keep * old + new[kind, 3] * numbers[apart * k + at]
            heat += model.mass[kind] * (velocity[m, k] ** 2 - old * old)
            if turns:
                old = momentum[m, k]
                momentum[m, k] = keep_turning * old + new[kind, k] * numbers[apart * (3 + k) + at]
                heat += model.inverse_inertia[kind, k] * (momentum[m, k] ** 2 - old * old)
        at += 1
    return 0.5 * heat


@kernel(inline=True)
def _stirred(before, keep, sizes, numbers, at, apart):
    """Vectors of as many molecules as lanes after friction and noise."""
    return (
        keep * before[0] + sizes[0] * load(numbers, at),
        keep * before[1] + sizes[1] * load(numbers, at + apart),
        keep * before[2] + sizes[2] * load(numbers, at + 2 * apart),
    )


@kernel(inline=True)
def _growth(before, after):
    """By how much the square of each component has grown."""
    return (
        after[0] * after[0] - before[0] * before[0],
        after[1] * after[1] - before[1] * before[1],
        after[2] * after[2] - before[2] * before[2],
    )


def rotate_group(rotor, species, rotation, angular_momentum_body, first, end, h):
    """`rotate` of molecules first ... end - 1."""
    raise TypeError("compiled code only")


@implements(rotate_group)
def _turn_group(rotor, species, rotation, angular_momentum_body, first, end, h):
    if not is_a(rotor, SplitRotor):
        return lambda rotor, species, rotation, angular_momentum_body, first, end, h: _turn_one_by_one(
            rotor, species, rotation, angular_momentum_body, first, end, h
        )

    def turn_together(rotor, species, rotation, angular_momentum_body, first, end, h):
        align_stack()
        known, kinds = np.empty(ROWS * LANES), np.full(LANES, -1)
        whole = (1 << LANES) - 1
        about = (False, False, False)
        while first + LANES <= end:
            if _are_others(kinds, species, first):
                about = _learn(known, kinds, rotor, h)
            momentum = load_vectors(angular_momentum_body, first)
            x, y, z = momentum
            if mask_bits(load(known, FASTEST2 * LANES) * (x * x + y * y + z * z) < SHORT_ANGLE2) != whole:
                _turn_one_by_one(rotor, species, rotation, angular_momentum_body, first, first + LANES, h)
            elif about[0] | about[1] | about[2]:
                _turn_lanes(known, about, rotation, angular_momentum_body, first, momentum)
            else:
                share = load(known, SHARE * LANES)
                turned_lanes = _about_momenta(load_matrices(rotation, first), (share * x, share * y, share * z), -1.0)
                store_matrices(rotation, first, turned_lanes)
            first += LANES
        _turn_one_by_one(rotor, species, rotation, angular_momentum_body, first, end, h)

    return turn_together


@kernel
def _turn_one_by_one(rotor, species, rotation, angular_momentum_body, first, end, h):
    for m in range(first, end):
        rotate(rotor, species[m], rotation, angular_momentum_body, m, h)


@kernel(inline=True)
def _are_others(kinds, species, first):
    """Whether the lanes' bodies are of other kinds than before; the kinds become theirs."""
    same = True
    for n in range(len(kinds)):
        same &= kinds[n] == species[first + n]
    if not same:
        for n in range(len(kinds)):
            kinds[n] = species[first + n]
    return not same


@kernel
def _learn(known, kinds, rotor, h):
    """Fill the rows that the lanes have to know; returns about which of the axes a, b, c there are rotations."""
    about_a = about_b = about_c = False
    for n in range(LANES):
        kind = kinds[n]
        a, b, c = rotor.order[kind, 0], rotor.order[kind, 1], rotor.order[kind, 2]
        share, rates = h * rotor.common[kind], rotor.excess[kind]
        known[AXIS_A * LANES + n], known[AXIS_B * LANES + n] = a, b
        known[SHARE * LANES + n] = share
        known[RATE * LANES + n] = h * rates[a]
        known[(RATE + 1) * LANES + n] = h * rates[b]
        known[(RATE + 2) * LANES + n] = h * rates[c]
        known[FASTEST2 * LANES + n] = max(abs(share), abs(h * rates[a]), abs(h * rates[b]), abs(h * rates[c])) ** 2
        known[TURN * LANES + n] = -1.0 if (b - a) % 3 == 1 else 1.0
        about_a |= rates[a] != 0.0
        about_b |= rates[b] != 0.0
        about_c |= rates[c] != 0.0
    return about_a, about_b, about_c


@kernel(inline=True)
def _turn_lanes(known, about, rotation, angular_momentum_body, first, momentum):
    """`rotor.turn_by_parts` of the bodies in lanes, in the frame of the rotor's axes a, b, c."""
    a, b, rotate = load(known, AXIS_A * LANES), load(known, AXIS_B * LANES), load(known, TURN * LANES)
    axes = (a == 0.0, b == 0.0, a == 1.0, b == 1.0)
    q = load_matrices(rotation, first)
    L = _in_order(momentum, axes)
    share = load(known, SHARE * LANES)
    along = (share * L[0], share * L[1], share * L[2])
    ordered = _in_order(q[:3], axes) + _in_order(q[3:6], axes) + _in_order(q[6:], axes)
    q0, q1, q2, q3, q4, q5, q6, q7, q8 = _about_momenta(ordered, along, rotate)
    L0, L1, L2 = L
    if about[0]:
        angle = 0.5 * load(known, RATE * LANES) * L0
        L1, L2, q1, q2, q4, q5, q7, q8 = _about_axis(angle, rotate, L1, L2, q1, q2, q4, q5, q7, q8)
    if about[1]:
        angle = 0.5 * load(known, (RATE + 1) * LANES) * L1
        L2, L0, q2, q0, q5, q3, q8, q6 = _about_axis(angle, rotate, L2, L0, q2, q0, q5, q3, q8, q6)
    if about[2]:
        angle = load(known, (RATE + 2) * LANES) * L2
        L0, L1, q0, q1, q3, q4, q6, q7 = _about_axis(angle, rotate, L0, L1, q0, q1, q3, q4, q6, q7)
    if about[1]:
        angle = 0.5 * load(known, (RATE + 1) * LANES) * L1
        L2, L0, q2, q0, q5, q3, q8, q6 = _about_axis(angle, rotate, L2, L0, q2, q0, q5, q3, q8, q6)
    if about[0]:
        angle = 0.5 * load(known, RATE * LANES) * L0
        L1, L2, q1, q2, q4, q5, q7, q8 = _about_axis(angle, rotate, L1, L2, q1, q2, q4, q5, q7, q8)
    x, y, z = _in_place((L0, L1, L2), axes)
    still = load(known, RATE * LANES) == 0.0  # its momentum is kept, with the signs of zeros
    still = still & (load(known, (RATE + 1) * LANES) == 0.0) & (load(known, (RATE + 2) * LANES) == 0.0)
    kept = select(still, momentum[0], x), select(still, momentum[1], y), select(still, momentum[2], z)
    store_vectors(angular_momentum_body, first, kept)
    back = _in_place((q0, q1, q2), axes) + _in_place((q3, q4, q5), axes) + _in_place((q6, q7, q8), axes)
    store_matrices(rotation, first, back)


@kernel(inline=True)
def _in_order(vector, axes):
    """Components of a body vector along the rotor's axes a, b, c."""
    x, y, z = vector
    a_is_x, b_is_x, a_is_y, b_is_y = axes
    return (
        select(a_is_x, x, select(a_is_y, y, z)),
        select(b_is_x, x, select(b_is_y, y, z)),
        select(a_is_x | b_is_x, select(a_is_y | b_is_y, z, y), x),
    )


@kernel(inline=True)
def _in_place(vector, axes):
    """A body vector from its components along the rotor's axes a, b, c."""
    a, b, c = vector
    a_is_x, b_is_x, a_is_y, b_is_y = axes
    return (
        select(a_is_x, a, select(b_is_x, b, c)),
        select(a_is_y, a, select(b_is_y, b, c)),
        select(a_is_x | a_is_y, select(b_is_x | b_is_y, c, b), a),
    )


@kernel(inline=True)
def _about_momenta(q, along, rotate):
    """Rows of rotations (nine numbers) after a rotation along a vector: `rotor.turn_along`."""
    x, y, z = along
    odd, even = rotation_coefficient_series(x * x + y * y + z * z)
    odd = rotate * odd
    return (
        rotate_vector(q[0], q[1], q[2], x, y, z, odd, even)
        + rotate_vector(q[3], q[4], q[5], x, y, z, odd, even)
        + rotate_vector(q[6], q[7], q[8], x, y, z, odd, even)
    )


@kernel(inline=True)
def _about_axis(angle, rotate, La, Lb, a0, b0, a1, b1, a2, b2):
    """`rotor.about_axis`: the other two components of the momenta, and of each row of the rotations."""
    odd, even = rotation_coefficient_series(angle * angle)
    s = rotate * (angle * odd)
    versine = angle * angle * even
    return (
        _rotated(La, Lb, s, versine)
        + _rotated(a0, b0, s, versine)
        + _rotated(a1, b1, s, versine)
        + _rotated(a2, b2, s, versine)
    )


@kernel(inline=True)
def _rotated(a, b, s, versine):
    return a - (s * b + versine * a), b + (s * a - versine * b)
