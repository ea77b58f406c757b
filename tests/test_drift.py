"""The error of a drift: right for white noise, for a random walk, and for the two together."""

import numpy as np
import pytest

from rigidmd.measure.drift import inefficiency, slope


@pytest.mark.parametrize(
    ("white", "walk", "low", "high"), [(1.0, 0.0, 0.6, 1.2), (0.0, 1.0, 0.8, 1.5), (1.0, 0.3, 0.8, 1.6)]
)
def test_the_error_of_a_slope_is_as_large_as_its_scatter(white, walk, low, high):
    rng = np.random.default_rng(0)
    time = 0.05 * np.arange(400)
    ratios = []
    for _ in range(300):
        noise = white * rng.standard_normal(400) + walk * np.cumsum(rng.standard_normal(400))
        found = slope(time, 3.0 * time + noise)
        ratios.append((found.value - 3.0) / found.error)
    assert low < np.std(ratios) < high


def test_a_line_is_found_exactly():
    time = np.linspace(0, 2, 50)
    found = slope(time, 1 - 4 * time)
    assert found.value == pytest.approx(-4)
    assert found.rms < 1e-14


def test_inefficiency_of_correlated_samples():
    rng = np.random.default_rng(1)
    x = np.zeros(50000)
    for k in range(1, len(x)):
        x[k] = 0.8 * x[k - 1] + rng.standard_normal()
    assert inefficiency(x) == pytest.approx((1 + 0.8) / (1 - 0.8), rel=0.15)
    assert inefficiency(rng.standard_normal(50000)) == pytest.approx(1, abs=0.1)
