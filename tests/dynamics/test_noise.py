"""Random numbers by counting: known answers, distributions, and that streams are from each other."""

import numpy as np
import pytest
from scipy import stats

from rigidmd.compile import kernel
from rigidmd.dynamics.noise import (
    BATCH,
    LATTICE,
    MOMENTA,
    THERMOSTAT,
    Key,
    chi_square,
    fill_normals,
    key_of,
    normals,
    philox,
    uniforms,
)


def words(*values):
    return tuple(int(value, 16) for value in values)


# counter (4 words), key (2 words), result: kat_vectors of Random123 for philox4x32-10
KNOWN = [
    (words(*["0"] * 4), words("0", "0"), words("6627e8d5", "e169c58d", "bc57ac4c", "9b00dbd8")),
    (
        words(*["ffffffff"] * 4),
        words(*["ffffffff"] * 2),
        words("408f276d", "41c83b0e", "a20bc7c6", "6d5451fd"),
    ),
    (
        words("243f6a88", "85a308d3", "13198a2e", "03707344"),
        words("a4093822", "299f31d0"),
        words("d16cfe09", "94fdcceb", "5001e420", "24126ea1"),
    ),
]


@pytest.mark.parametrize(("counter", "key", "result"), KNOWN)
def test_known_answers(counter, key, result):
    a, b, c, d = counter
    found = philox(
        Key(np.uint64(key[0]), np.uint64(key[1])),
        np.uint64(a),
        np.uint64(b),
        np.uint64(c + (d << 32)),
    )
    assert tuple(map(int, found)) == result


@kernel(from_python=True)
def fill(key, freedom, uniform, normal, square):
    for step in range(len(square)):
        uniform[step, 0], uniform[step, 1] = uniforms(key, 0, 0, step)
        normal[step, 0], normal[step, 1] = normals(key, 1, 0, step)
        square[step] = chi_square(key, 2, 0, step, freedom)


@pytest.mark.parametrize("freedom", [1, 2, 7, 1293])
def test_distributions(freedom):
    n = 20_000
    uniform, normal, square = np.empty((n, 2)), np.empty((n, 2)), np.empty(n)
    fill(key_of(5, THERMOSTAT), freedom, uniform, normal, square)
    assert stats.kstest(uniform.ravel(), "uniform").pvalue > 1e-3
    assert stats.kstest(normal.ravel(), "norm").pvalue > 1e-3
    assert stats.kstest(square, "chi2", args=(freedom,)).pvalue > 1e-3
    for pair in (uniform, normal):
        assert abs(np.corrcoef(pair.T)[0, 1]) < 4 / np.sqrt(n)


@kernel(from_python=True)
def fill_batches(found, key, step):
    words = np.empty((2, 4, BATCH), np.uint64)
    for batch in range(len(found)):
        fill_normals(found[batch], words, key, 7, BATCH * batch, step)


def six_of_each(batches, key, step):
    """The numbers (molecules, 6) of molecules 0, 1, ... in this many batches."""
    found = np.empty((batches, 6 * BATCH))
    fill_batches(found, key, step)
    return found.reshape(batches, 6, BATCH).transpose(0, 2, 1).reshape(-1, 6)


def test_numbers_in_batches_are_normal():
    rows = six_of_each(4000, key_of(5, THERMOSTAT), 3)
    assert stats.kstest(rows.ravel(), "norm").pvalue > 1e-3
    for x in (2.0, 3.0, 4.0):
        expected = rows.size * stats.norm.sf(x)
        assert abs((np.abs(rows) > x).sum() / 2 - expected) < 4 * np.sqrt(expected)
    for values in (rows, rows**2):
        assert np.abs(np.corrcoef(values.T) - np.eye(6)).max() < 5 / np.sqrt(len(rows))
        assert abs(np.corrcoef(values[1:].ravel(), values[:-1].ravel())[0, 1]) < 5 / np.sqrt(
            rows.size
        )


def test_numbers_in_batches_are_those_of_their_words():
    """Radii of 53 bits and angles of 32, in Python."""
    key, step = key_of(5, THERMOSTAT), 11
    found = six_of_each(3, key, step)
    for m in (0, 1, BATCH - 1, BATCH, 2 * BATCH + 2, 3 * BATCH - 1):
        (a, b, c, d), (e, f, more, rest) = (
            [int(word) for word in philox(key, draw, m, step)] for draw in (7, 8)
        )
        extra = more % 2**21, rest % 2**21, (more >> 21) * 2**10 + (rest >> 22)
        u = [(word * 2**21 + low + 0.5) / 2**53 for word, low in zip((a, b, c), extra, strict=True)]
        radius, angle = np.sqrt(-2 * np.log(u)), 2 * np.pi * np.array([d, e, f]) / 2**32
        expected = np.concatenate([radius * np.cos(angle), radius * np.sin(angle)])
        assert found[m] == pytest.approx(expected, rel=1e-12, abs=1e-15)


def test_no_freedom_has_no_energy():
    assert chi_square(key_of(5, THERMOSTAT), 0, 0, 0, 0) == 0


def test_streams_are_separate():
    keys = {
        key_of(seed, purpose, stage)
        for seed in range(4)
        for purpose in (LATTICE, MOMENTA, THERMOSTAT)
        for stage in (0, 1)
    }
    assert len(keys) == 4 * 3 * 2
    numbers = {
        uniforms(key_of(1, THERMOSTAT), draw, m, step)
        for draw in (0, 1)
        for m in (0, 1)
        for step in (0, 1, 2**40)
    }
    assert len(numbers) == 2 * 2 * 3
