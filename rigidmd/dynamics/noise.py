"""Counter-based random numbers: Philox4x32-10 (Salmon et al., Parallel random numbers: as easy as
1, 2, 3, SC '11).

A number is a function of a key and a counter. No state has to be saved, and the numbers are the
same for any number of threads. The key depends on (seed, purpose, stage). The counter is (draw,
molecule, step).
"""

from math import cos, log, pi, sin, sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.compile import kernel
from rigidmd.compile.simd import lanes_of, load, store

#: Purposes. Each has a stream of random numbers, so that an additional draw for one changes nothing
#: for the others.
LATTICE, MOMENTA, THERMOSTAT, BAROSTAT = 1, 2, 3, 4

MULTIPLIER_0, MULTIPLIER_1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
WEYL_0, WEYL_1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)
LOW = np.uint64(0xFFFFFFFF)
HALF = np.uint64(32)
WHOLE = 2.0**-32
BITS_10, BITS_21, BITS_22, LOW_21 = (
    np.uint64(10),
    np.uint64(21),
    np.uint64(22),
    np.uint64((1 << 21) - 1),
)


class Key(NamedTuple):
    """The key of a stream: two 32-bit numbers."""

    low: np.uint64
    high: np.uint64


def key_of(seed: int, purpose: int, stage: int = 0) -> Key:
    """The key of a purpose (LATTICE, MOMENTA, ...) in a stage. It is well mixed, so seeds may be 1,
    2, 3."""
    low, high = np.random.SeedSequence([seed, purpose, stage]).generate_state(2, np.uint32)
    return Key(np.uint64(low), np.uint64(high))


@kernel(from_python=True, inline=True)
def philox(key, draw, molecule, step):
    """Four 32-bit numbers, as uint64, for a counter with draw and molecule below 2^32, step below
    2^63. It is inlined, since the loop of `fill_words` is vectorised only then."""
    a, b = np.uint64(draw) & LOW, np.uint64(molecule) & LOW
    c, d = np.uint64(step) & LOW, np.uint64(step) >> HALF
    low, high = key.low, key.high
    for _ in range(10):
        first, second = MULTIPLIER_0 * a, MULTIPLIER_1 * c
        a, b, c, d = (
            (second >> HALF) ^ b ^ low,
            second & LOW,
            (first >> HALF) ^ d ^ high,
            first & LOW,
        )
        low, high = (low + WEYL_0) & LOW, (high + WEYL_1) & LOW
    return a, b, c, d


@kernel(from_python=True)
def uniforms(key, draw, molecule, step):
    """Two independent uniform numbers in (0, 1], from 64 bits each: never 0, and 1 only by
    rounding."""
    a, b, c, d = philox(key, draw, molecule, step)
    return ((a + 0.5) * WHOLE + b) * WHOLE, ((c + 0.5) * WHOLE + d) * WHOLE


@kernel(from_python=True)
def normals(key, draw, molecule, step):
    """Two independent normal numbers of mean 0 and variance 1 (Box & Muller 1958)."""
    u, v = uniforms(key, draw, molecule, step)
    radius = sqrt(-2 * log(u))
    return radius * cos(2 * pi * v), radius * sin(2 * pi * v)


@kernel(from_python=True)
def chi_square(key, draw, molecule, step, freedom):
    """The sum of squares of `freedom` normal numbers, from draws `draw`, draw + 1, ... (Marsaglia &
    Tsang 2000). It is twice a Gamma variate of shape freedom/2. For a shape below 1, from one of
    shape + 1 (their section 6)."""
    if freedom == 0:
        return 0.0
    shape = 0.5 * freedom
    scale = 1.0
    if shape < 1:
        u, _ = uniforms(key, draw, molecule, step)
        scale = u ** (1 / shape)
        shape += 1
        draw += 1
    d = shape - 1 / 3
    c = 1 / sqrt(9 * d)
    while True:
        x, _ = normals(key, draw, molecule, step)
        u, _ = uniforms(key, draw + 1, molecule, step)
        draw += 2
        v = (1 + c * x) ** 3
        if v > 0 and log(u) < 0.5 * x * x + d - d * v + d * log(v):
            return 2 * scale * d * v


#: Molecules whose random words are made at once, by loops over them that are vectorised.
BATCH = 64


@kernel
def fill_words(words, key, draw, first, step):
    """The four words of BATCH molecules, from `first` on, into words (4, BATCH)."""
    for m in range(words.shape[1]):
        words[0, m], words[1, m], words[2, m], words[3, m] = philox(key, draw, first + m, step)


@kernel
def fill_normals(found, words, key, draw, first, step):
    """Six normal numbers of each of BATCH molecules, from `first` on: two draws (Box & Muller 1958,
    with vectors). Number k of molecule first + m goes to found[BATCH k + m]. Each radius has 53
    random bits, so that numbers go up to 8.6, and each angle 32.

    words : scratch (2, 4, BATCH)
    """
    fill_words(words[0], key, draw, first, step)
    fill_words(words[1], key, draw + 1, first, step)
    _fill_pairs(found, words.reshape(-1))
    for m in range(0, 3 * BATCH, lanes_of(found)):
        radius, angle = sqrt(-2.0 * log(load(found, m))), load(found, 3 * BATCH + m)
        store(found, m, radius * cos(angle))
        store(found, 3 * BATCH + m, radius * sin(angle))


@kernel
def _fill_pairs(found, words):
    """Three uniform numbers in (0, 1] of each molecule, then three angles, of eight words."""
    for m in range(BATCH):
        more, rest = words[6 * BATCH + m], words[7 * BATCH + m]
        found[m] = _fraction(words[m], more & LOW_21)
        found[BATCH + m] = _fraction(words[BATCH + m], rest & LOW_21)
        found[2 * BATCH + m] = _fraction(
            words[2 * BATCH + m], (more >> BITS_21) << BITS_10 | rest >> BITS_22
        )
    for m in range(3 * BATCH):
        found[3 * BATCH + m] = 2 * pi * WHOLE * np.int64(words[3 * BATCH + m])


@kernel(inline=True)
def _fraction(word, more):
    """A uniform number in (0, 1], from a word and 21 more bits: never 0, and 1 only by rounding."""
    return (np.int64(word << BITS_21 | more) + 0.5) * 2.0**-53
