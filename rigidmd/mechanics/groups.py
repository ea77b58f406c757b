"""Rotations of many bodies at a time, part by part, in loops without branches or calls that the compiler vectorises.

With one body at a time, each part waits for the one before it, and a water takes two and a half times as long.
"""

import numpy as np

from rigidmd.compile import implements, is_a, kernel
from rigidmd.mechanics.rotor import SHORT, SplitRotor, series_of_square, turn, turned

GROUP = 128  # bodies; their data stay in the L1 cache
SHARE, RATE, SIGN, L, Q, ROWS = 0, 1, 4, 5, 8, 17  # first row of each quantity in a group


def turn_group(rotor, species, rotation, angular_momentum_body, first, end, h):
    """`turn` of molecules first ... end - 1, at most GROUP."""
    raise TypeError("compiled code only")


@implements(turn_group)
def _turn_group(rotor, species, rotation, angular_momentum_body, first, end, h):
    if not is_a(rotor, SplitRotor):
        return lambda rotor, species, rotation, angular_momentum_body, first, end, h: _turn_one_by_one(
            rotor, species, rotation, angular_momentum_body, first, end, h
        )

    def turn_together(rotor, species, rotation, angular_momentum_body, first, end, h):
        count = end - first
        # few bodies, or bodies that rotate about their momenta only, take longer to collect than to rotate
        if count < 8 or not rotor.excess.any():
            _turn_one_by_one(rotor, species, rotation, angular_momentum_body, first, end, h)
            return
        group = np.empty((ROWS, GROUP))
        longest, about = _collect(group, rotor, species, rotation, angular_momentum_body, first, count, h)
        if not longest * longest < SHORT:
            _turn_one_by_one(rotor, species, rotation, angular_momentum_body, first, end, h)
            return
        _about_momenta(group, count)
        if about[0]:
            _about_axes(group, count, 0, 0.5)
        if about[1]:
            _about_axes(group, count, 1, 0.5)
        if about[2]:
            _about_axes(group, count, 2, 1.0)
        if about[1]:
            _about_axes(group, count, 1, 0.5)
        if about[0]:
            _about_axes(group, count, 0, 0.5)
        for n in range(count):
            m = np.uint64(first + n)
            for k in range(3):
                axis = np.uint64(rotor.order[species[m], k])
                angular_momentum_body[m, axis] = group[L + k, n]
                for row in range(3):
                    rotation[m, row, axis] = group[Q + 3 * row + k, n]

    return turn_together


@kernel
def _turn_one_by_one(rotor, species, rotation, angular_momentum_body, first, end, h):
    for m in range(first, end):
        turn(rotor, species[m], rotation, angular_momentum_body, m, h)


@kernel(inline=True)
def _collect(group, rotor, species, rotation, angular_momentum_body, first, count, h):
    """Fill the rows of a group; returns a bound on all angles, and which axes have rotations.

    Components are in the order of the rotor's axes a, b, c. If it is not cyclic, the frame is left-handed: SIGN.
    """
    longest = 0.0
    about_a = about_b = about_c = False
    for n in range(count):
        m = np.uint64(first + n)
        kind = np.uint64(species[m])
        fastest = abs(rotor.common[kind])
        length = 0.0
        for k in range(3):
            axis = np.uint64(rotor.order[kind, k])
            rate = rotor.excess[kind, axis]
            fastest = max(fastest, abs(rate))
            length += abs(angular_momentum_body[m, axis])
            group[RATE + k, n] = h * rate
            group[L + k, n] = angular_momentum_body[m, axis]
            for row in range(3):
                group[Q + 3 * row + k, n] = rotation[m, row, axis]
        group[SHARE, n] = h * rotor.common[kind]
        group[SIGN, n] = 1.0 if (rotor.order[kind, 1] - rotor.order[kind, 0]) % 3 == 1 else -1.0
        about_a |= group[RATE, n] != 0.0
        about_b |= group[RATE + 1, n] != 0.0
        about_c |= group[RATE + 2, n] != 0.0
        angle = abs(h) * fastest * length
        longest = angle if not angle <= longest else longest
    return longest, (about_a, about_b, about_c)


@kernel(inline=True)
def _about_momenta(group, count):
    """`rotor.about_momentum` of each body."""
    for n in range(count):
        x = group[SHARE, n] * group[L, n]
        y = group[SHARE, n] * group[L + 1, n]
        z = group[SHARE, n] * group[L + 2, n]
        odd, even = series_of_square(x * x + y * y + z * z)
        odd = -group[SIGN, n] * odd
        for row in range(Q, Q + 9, 3):
            group[row, n], group[row + 1, n], group[row + 2, n] = turned(
                group[row, n], group[row + 1, n], group[row + 2, n], x, y, z, odd, even
            )


@kernel(inline=True)
def _about_axes(group, count, k, part):
    """`rotor.about_axis` of each body, about its k-th axis in the rotor's order, for a part of the time."""
    i, j = (k + 1) % 3, (k + 2) % 3
    for n in range(count):
        angle = part * group[RATE + k, n] * group[L + k, n]
        odd, even = series_of_square(angle * angle)
        s = group[SIGN, n] * angle * odd
        versine = angle * angle * even
        for row in range(L, L + 12, 3):
            a = group[row + i, n]
            b = group[row + j, n]
            group[row + i, n] = a + (s * b - versine * a)
            group[row + j, n] = b - (s * a + versine * b)
