"""Functions of vectors: exp, log, powers and trigonometry to the last digits."""

import math
from math import cos, exp, log, sin

import numpy as np
import pytest

from rigidmd.compile import kernel, simd


@kernel(from_python=True)
def every_function(x, y, out):
    for i in range(0, len(x), simd.lanes_of(x)):
        a, b = simd.load(x, i), simd.load(y, i)
        found = (
            exp(a),
            log(a),
            math.pow(a, b),
            sin(b),
            cos(b),
            -(a**3),
            a**-2,
            math.sqrt(a) + abs(b),
        )
        for k in range(8):
            simd.store(out, k * len(x) + i, found[k])


@pytest.mark.parametrize("dtype, error", [(np.float64, 4.5e-16), (np.float32, 2e-7)])
def test_functions_of_vectors_are_right_to_the_last_digits(dtype, error):
    rng = np.random.default_rng(1)
    n = 4096
    x = (10 ** rng.uniform(-2, 1.9, n)).astype(dtype)
    y = rng.uniform(-14, 14, n).astype(dtype)
    out = np.zeros(8 * n, dtype)
    every_function(x, y, out)
    a, b = x.astype(np.longdouble), y.astype(np.longdouble)
    expected = [
        np.exp(a),
        np.log(a),
        a**b,
        np.sin(b),
        np.cos(b),
        -(a**3),
        a**-2,
        np.sqrt(a) + abs(b),
    ]
    for k, values in enumerate(expected):
        off = np.abs(out[k * n : (k + 1) * n] / values - 1)
        assert off[np.abs(values) < np.finfo(dtype).max].max() < error, k


def test_functions_of_vectors_at_the_ends_of_their_range():
    x = np.array([0.0, -1.0, np.inf, np.nan, 800.0, 1e-310, 1.0, 745.0])
    x, y = np.tile(x, 2), np.tile([2.0, 2.0, -3.0, 1.0, 200.0, 1.0, 0.0, 1e14], 2)
    out = np.zeros(8 * 16)
    every_function(x, y, out)
    with np.errstate(all="ignore"):
        assert out[:16] == pytest.approx(np.exp(x), rel=1e-15, nan_ok=True)
        assert out[16:32] == pytest.approx(np.log(x), rel=1e-15, nan_ok=True)
        powers = np.where(x < 0, np.nan, np.abs(x) ** y)  # of a negative number: no number
        assert out[32:48] == pytest.approx(powers, rel=1e-15, nan_ok=True)
    assert np.isnan(
        out[48:80].reshape(2, 16)[:, [7, 15]]
    ).all()  # a sine of 1e14 would state nothing
