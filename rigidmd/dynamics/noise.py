"""Counter-based random numbers: Philox4x32-10 (Salmon et al., Parallel random numbers: as easy as 1, 2, 3, SC '11).

A number is a function of a key and a counter, so there is no generator and no state to save, and the numbers are the
same for any number of threads. The key depends on (seed, purpose, stage); the counter is (draw, molecule, step).
"""

from math import cos, exp, log, pi, sin, sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.compile import kernel

#: Purposes. Each has its own stream, so that an additional draw for one changes nothing for the others.
LATTICE, MOMENTA, BATH, BOX = 1, 2, 3, 4

MULTIPLIER_0, MULTIPLIER_1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
WEYL_0, WEYL_1 = np.uint64(0x9E3779B9), np.uint64(0xBB67AE85)
LOW = np.uint64(0xFFFFFFFF)
HALF = np.uint64(32)
WHOLE = 2.0**-32


class Key(NamedTuple):
    """The key of a stream: two 32-bit numbers."""

    low: np.uint64
    high: np.uint64


def key_of(seed: int, purpose: int, stage: int = 0) -> Key:
    """The key of a purpose (LATTICE, MOMENTA, BATH) in a stage. It is well mixed, so seeds may be 1, 2, 3."""
    low, high = np.random.SeedSequence([seed, purpose, stage]).generate_state(2, np.uint32)
    return Key(np.uint64(low), np.uint64(high))


@kernel(outer=True)
def philox(key, draw, molecule, step):
    """Four 32-bit numbers, as uint64, for a counter with draw and molecule below 2^32, step below 2^63."""
    a, b = np.uint64(draw) & LOW, np.uint64(molecule) & LOW
    c, d = np.uint64(step) & LOW, np.uint64(step) >> HALF
    low, high = key.low, key.high
    for _ in range(10):
        first, second = MULTIPLIER_0 * a, MULTIPLIER_1 * c
        a, b, c, d = (second >> HALF) ^ b ^ low, second & LOW, (first >> HALF) ^ d ^ high, first & LOW
        low, high = (low + WEYL_0) & LOW, (high + WEYL_1) & LOW
    return a, b, c, d


@kernel(outer=True)
def uniforms(key, draw, molecule, step):
    """Two independent uniform numbers in (0, 1], from 64 bits each: never 0, and 1 only by rounding."""
    a, b, c, d = philox(key, draw, molecule, step)
    return ((a + 0.5) * WHOLE + b) * WHOLE, ((c + 0.5) * WHOLE + d) * WHOLE


@kernel(outer=True)
def normals(key, draw, molecule, step):
    """Two independent normal numbers of mean 0 and variance 1 (Box & Muller 1958)."""
    u, v = uniforms(key, draw, molecule, step)
    radius = sqrt(-2 * log(u))
    return radius * cos(2 * pi * v), radius * sin(2 * pi * v)


@kernel(outer=True)
def chi_square(key, draw, molecule, step, freedom):
    """The sum of squares of `freedom` normal numbers, from draws `draw`, draw + 1, ... (Marsaglia & Tsang 2000).

    It is twice a Gamma variate of shape freedom/2; for a shape below 1, from one of shape + 1 (their section 6).
    """
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


# The ziggurat of Marsaglia & Tsang (2000, J. Stat. Softw. 5, 8) with 128 strips; strip and place in it come from
# different bits of a word, as Doornik (2005) asks for.
STRIPS = 128
LAST_EDGE, STRIP_AREA = 3.442619855899, 9.91256303526217e-3


def _ziggurat() -> tuple[np.ndarray, np.ndarray]:
    """Edges (STRIPS + 1,) of the strips, and which part (STRIPS,) of each lies under the curve altogether."""
    edge = np.zeros(STRIPS + 1)
    height = np.exp(-0.5 * LAST_EDGE**2)
    edge[0], edge[1] = STRIP_AREA / height, LAST_EDGE
    for n in range(2, STRIPS):
        edge[n] = np.sqrt(-2 * np.log(STRIP_AREA / edge[n - 1] + height))
        height = np.exp(-0.5 * edge[n] ** 2)
    return edge, edge[1:] / edge[:-1]


EDGE, INSIDE = _ziggurat()


@kernel
def fill_words(words, key, draw, first, step):
    """The four words of so many molecules, from `first` on, into words (4, molecules); a loop that is vectorised."""
    for m in range(words.shape[1]):
        words[0, m], words[1, m], words[2, m], words[3, m] = philox(key, draw, first + m, step)


@kernel(inline=True)
def normal_of(word, key, draw, molecule, step):
    """A normal number, to 2^-24 of a strip of the ziggurat, of one 32-bit word.

    With its word it took 5 to 6 ns on a loaded machine: for baths that draw for every molecule in every step. One in 80
    takes further draws, from `draw` on.
    """
    strip = np.int64(word & np.uint64(STRIPS - 1))
    u = (np.int64(word >> np.uint64(8)) + 0.5) * 2.0**-23 - 1
    if abs(u) < INSIDE[strip]:
        return u * EDGE[strip]
    return _of_edge(strip, u, key, draw, molecule, step)


@kernel(outer=True)
def _of_edge(strip, u, key, draw, molecule, step):
    """A number from where a strip is cut by the curve, or from the tail."""
    while True:
        if strip == 0:
            while True:
                v, w = uniforms(key, draw, molecule, step)
                draw += 1
                beyond = -log(v) / LAST_EDGE
                if -2 * log(w) > beyond * beyond:
                    return LAST_EDGE + beyond if u > 0 else -LAST_EDGE - beyond
        x = u * EDGE[strip]
        v, w = uniforms(key, draw, molecule, step)
        low = exp(-0.5 * (EDGE[strip] ** 2 - x * x))
        high = exp(-0.5 * (EDGE[strip + 1] ** 2 - x * x))
        if low + v * (high - low) < 1.0:
            return x
        a, _, _, _ = philox(key, draw + 1, molecule, step)
        draw += 2
        strip = np.int64(a & np.uint64(STRIPS - 1))
        u = 2 * w - 1
        if abs(u) < INSIDE[strip]:
            return u * EDGE[strip]
