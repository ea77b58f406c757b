"""Errors of means and of drifts are as large as their scatter: white noise, processes with memory,
random walks."""

import numpy as np
import pytest
from scipy.signal import lfilter
from support.common import small_scene

from rigidmd import Simulation
from rigidmd.assemble.build import build
from rigidmd.core.statistics import (
    correlation_time,
    error_of_mean,
    format_signed,
    inefficiency,
    slope,
    steady_from,
)
from rigidmd.core.statistics import mean_and_error as mean
from rigidmd.run.summary import drift_of_thermostats
from rigidmd.units import BOLTZMANN, KJ_PER_MOL

SERIES = 400


def memory(rng, n, time):
    """Ornstein and Uhlenbeck's process (SERIES, n) of variance 1; time in samples."""
    keep = np.exp(-1 / time)
    noise = np.sqrt(1 - keep**2) * rng.standard_normal((SERIES, n))
    noise[:, 0] /= np.sqrt(1 - keep**2)
    return lfilter([1], [1, -keep], noise, axis=1)


def white(rng, n, time):
    return rng.standard_normal((SERIES, n))


def autoregressive(rng, n, time):
    """x = a x + noise, whose sum over correlations is `time`."""
    return memory(rng, n, 1 / np.log((2 * time + 1) / (2 * time - 1)))


def mixed(slow):
    """A slow process below white noise."""
    return lambda rng, n, time: (
        np.sqrt(1 - slow) * white(rng, n, time) + np.sqrt(slow) * memory(rng, n, time)
    )


def fast_and_slow(rng, n, time):
    return np.sqrt(0.7) * memory(rng, n, max(0.5, time / 8)) + np.sqrt(0.3) * memory(rng, n, time)


def pulls(series, estimate=mean):
    """(mean - truth)/error of series of mean 0, and the fraction of them that have an error."""
    found = np.array([estimate(values) for values in series], float)
    known = np.isfinite(found[:, 1])
    return found[known, 0] / found[known, 1], known.mean()


PROCESSES = {
    "white": white,
    "autoregressive": autoregressive,
    "memory": memory,
    "half of it slow": mixed(0.5),
    "a tenth slow": mixed(0.1),
    "fast and slow": fast_and_slow,
}


@pytest.mark.parametrize("name", PROCESSES)
@pytest.mark.parametrize("n", [16, 50, 160, 1000, pytest.param(5000, marks=pytest.mark.soak)])
def test_the_error_of_a_mean_is_as_large_as_its_scatter(n, name):
    """For lengths of 10, 20 and 100 of the longest correlation time; a tenth that is slow is harder
    to see."""
    rng = np.random.default_rng(n)
    for time in (n / 10, n / 20, n / 100) if name != "white" else (0.5,):
        if time < 0.75 and name != "white":
            continue
        found, known = pulls(PROCESSES[name](rng, n, time))
        size = np.sqrt(np.mean(found**2))
        short = 20 * time > n
        assert 0.7 < size < (1.45 if short else 1.25), (time, size)
        assert np.mean(np.abs(found) > 2) < (0.15 if short else 0.12)
        assert np.mean(np.abs(found) > 3) < (0.06 if short else 0.03)
        assert known > 0.9
        # the precision is not given away where samples are many: of white noise 1/sqrt(n)
        if name == "white" and n > 50:
            assert np.median([mean(x)[1] for x in white(rng, n, 0.5)]) < 1.35 / np.sqrt(n)


@pytest.mark.parametrize(
    "values", [np.ones(7), np.arange(7.0), np.arange(100.0), np.linspace(0, 1, 20) ** 2]
)
def test_what_is_too_short_has_no_error(values):
    assert mean(values) == (pytest.approx(values.mean()), None)
    assert mean(np.full(20, 0.1)) == (pytest.approx(0.1), 0.0)
    assert mean([1.0, np.nan] * 10) == (None, None)


@pytest.mark.parametrize("levels", [(-2.0, -1.0, 0.0, 1.0, 2.0), (1.0, -1.0, 0.5, 0.5, -1.0)])
def test_a_slow_part_below_fast_noise_has_the_error_of_its_batches(levels):
    """One level a fifth of the samples: the variance of the mean of five, twice what neighbours
    share, 3/2 of that."""
    fast = 8.0 * np.random.default_rng(3).standard_normal((5, 1000))
    values = (fast - fast.mean(axis=1, keepdims=True) + np.array(levels)[:, None]).ravel()
    offset = np.array(levels) - np.mean(levels)
    shared = offset[1:] @ offset[:-1] / (offset @ offset) + 1 / 5
    variance = offset @ offset / 4 / 5 * (1 + 2 * min(max(shared, 0.0), 0.5))
    lost = 1 - inefficiency(values - values.mean()) / len(values)
    assert mean(values) == pytest.approx(
        (np.mean(levels), np.sqrt(1.5 * variance / lost)), rel=1e-9, abs=1e-12
    )


# the equilibrated part


@pytest.mark.parametrize(
    ("times", "n", "low", "high"),
    [(10, 100, 1.0, 1.35), (20, 500, 0.85, 1.15), (40, 100, 0.75, 1.05), (100, 300, 0.7, 1.0)],
)
def test_the_choice_of_the_equilibrated_part_leaves_errors_as_they_are(times, n, low, high):
    """A series in equilibrium is not cut to a part that happens to be quiet."""
    rng = np.random.default_rng(7 * n + times)
    series = np.concatenate([memory(rng, n, n / times) for _ in range(4)])
    found, known = pulls(series, lambda values: mean(values[steady_from(values) :]))
    assert low < np.sqrt(np.mean(found**2)) < high
    assert np.mean(np.abs(found) > 3) < 0.045
    assert known > 0.95
    assert np.mean([steady_from(values) > 0 for values in series]) < 0.05


@pytest.mark.parametrize("times", [20, 100])
@pytest.mark.parametrize("size", [3.0, 10.0, 50.0])
@pytest.mark.parametrize("decay", [0.02, 0.06])
def test_a_transient_leaves_no_bias_that_the_error_does_not_cover(decay, size, times):
    """For this size in standard deviations, decaying in this fraction of 500 samples."""
    rng = np.random.default_rng(int(size * times))
    transient = size * np.exp(-np.arange(500) / (500 * decay))
    series = memory(rng, 500, 500 / times)[:200] + transient
    found, known = pulls(series, lambda values: mean(values[steady_from(values) :]))
    assert np.sqrt(np.mean(found**2)) < (1.35 if times == 20 else 1.1)
    assert known > 0.9
    if times == 100 and size >= 10:  # it is seen, and little more than it is cut off
        late = [steady_from(values) for values in series]
        assert 500 * decay < np.median(late) < 500 * decay * (np.log(size) + 1.5)
        errors = [mean(values[first:])[1] for values, first in zip(series, late, strict=True)]
        assert np.median(errors) < 1.8 * np.sqrt(2 / times)


def test_few_independent_values_have_the_error_of_student():
    values = np.random.default_rng(0).standard_normal((20_000, 4))
    for count in (2, 3, 4):
        error = error_of_mean(values[:, :count].T)
        within = np.mean(np.abs(values[:, :count].mean(axis=1)) < error)
        assert within == pytest.approx(0.683, abs=0.012)


def test_values_without_an_error_are_printed_as_such():
    assert (
        format_signed(1.5, None)
        == "+1.5 (too short for an error)"
        == format_signed(1.5, float("nan"))
    )
    assert format_signed(1.5, 0.25) == "+1.50 ± 0.25"


def test_inefficiency_of_correlated_samples():
    rng = np.random.default_rng(1)
    x = np.zeros(50000)
    for k in range(1, len(x)):
        x[k] = 0.8 * x[k - 1] + rng.standard_normal()
    assert inefficiency(x) == pytest.approx((1 + 0.8) / (1 - 0.8), rel=0.15)
    assert inefficiency(rng.standard_normal(50000)) == pytest.approx(1, abs=0.1)
    assert correlation_time(x, 0.1) == pytest.approx(0.05 * inefficiency(x - x.mean()))


@pytest.mark.soak
def test_means_of_windows_of_a_run_have_honest_errors():
    """Windows of 10 ps of 0.6 ns of 100 argon atoms: potential energy, temperature, pressure."""
    stages = [
        {"ensemble": "nvt", "temperature_K": 94.4, "timestep_fs": 10.0, "duration_ps": t}
        for t in (20.0, 600.0)
    ]
    scene = small_scene(
        {"argon": 100},
        16.8,
        start={"temperature_K": 94.4},
        stages=stages,
        forces={"cutoff_A": 8.0},
        output={"trajectory": False, "log_interval_ps": 0.1},
    )
    results = Simulation(scene).run()
    for name in ("potential", "temperature", "pressure"):
        values = results[name][results["stage"] == 1]
        found, known = pulls(values[: len(values) // 100 * 100].reshape(-1, 100) - values.mean())
        assert known > 0.9
        assert 0.7 < np.sqrt(np.mean(found**2)) < 1.3, name
        assert np.mean(np.abs(found) > 2) < 0.15


# drift


@pytest.mark.parametrize(
    ("n", "noise", "walk", "high"),
    [
        (16, 1.0, 0.0, 0.8),
        (40, 1.0, 0.0, 0.8),
        (400, 1.0, 0.0, 0.8),
        (40, 0.0, 1.0, 1.4),
        (200, 0.0, 1.0, 1.3),
        (1000, 0.0, 1.0, 1.3),
        (200, 1.0, 0.03, 1.25),
        (1000, 1.0, 0.03, 1.6),
        (400, 1.0, 0.3, 1.5),
    ],
)
def test_the_error_of_a_slope_is_as_large_as_its_scatter(n, noise, walk, high):
    """Also where a walk hides under white noise."""
    rng = np.random.default_rng(0)
    time, ratios = 0.05 * np.arange(n), []
    for _ in range(SERIES):
        values = noise * rng.standard_normal(n) + walk * np.cumsum(rng.standard_normal(n))
        found = slope(time, 3.0 * time + values)
        ratios.append((found.value - 3.0) / found.error)
    assert 0.35 < np.std(ratios) < high
    assert np.mean(np.abs(ratios) > 3) < 0.07


def test_few_samples_have_a_slope_without_an_error():
    for n in (3, 10, 15):
        found = slope(np.arange(n), np.sin(np.arange(n)))
        assert np.isfinite(found.value) and np.isnan(found.error)
    assert np.isfinite(slope(np.arange(16), np.sin(np.arange(16))).error)


def test_a_line_is_found_exactly():
    time = np.linspace(0, 2, 50)
    found = slope(time, 1 - 4 * time)
    assert found.value == pytest.approx(-4)
    assert found.rms < 1e-14


class Columns(dict):
    """Columns of a log, each of 40 samples."""

    def __len__(self):
        return 40


def test_heat_between_two_thermostats_explains_a_drift():
    """Temperatures off their set points by -1 and +1 K are a flow of heat, and a drift by the
    difference of the mean (w dt)² of both motions."""
    nvt = {"ensemble": "nvt", "temperature_K": 300.0, "duration_ps": 0.4, "timestep_fs": 4.0}
    values = {
        "temperature_translation": 299.0,
        "temperature_rotation": 301.0,
        "force_squares": 1e5,
        "torque_squares": 4e5,
    }
    columns = Columns({name: np.full(40, value) for name, value in values.items()})

    def of(**stage) -> tuple[float, float]:
        scene = small_scene({"spce": 20}, 18.5, stages=[nvt | stage])
        return drift_of_thermostats(build(scene), columns, 0)

    unit = BOLTZMANN / KJ_PER_MOL
    x = [0.004**2 * square / (count * unit * 300) for square, count in ((1e5, 57), (4e5, 60))]
    flow = 0.5 * unit * (57 + 60) / 2 / 0.05
    assert of() == pytest.approx((flow * (x[1] - x[0]) / 12, 0.0), rel=1e-9)
    noise = np.random.default_rng(0).standard_normal(40)
    columns["temperature_rotation"] = columns["temperature_rotation"] + noise - noise.mean()
    error = 0.5 * unit * 60 / 2 / 0.05 * mean(noise)[1]
    assert of() == pytest.approx(np.array([flow, error]) * (x[1] - x[0]) / 12, rel=1e-9)
    assert of(thermostat_time_ps=0.1)[0] == pytest.approx(of()[0] / 2)
    assert of(integrator="velocity_verlet") == (0.0, 0.0)
    assert of(thermostat="langevin") == (0.0, 0.0)
    assert of(ensemble="nve", temperature_K=None) == (0.0, 0.0)
