"""Limits at a step of zero: fits, errors, runs together."""

import numpy as np
import pytest

from rigidmd.features.studies.extrapolation import MeanAtStep, Together, extrapolate, means_of_runs
from rigidmd.features.studies.sweep.limits import BIAS_LIMIT, UNSEEN, Limit


def test_the_limit_at_a_step_of_zero_is_shared_and_long_steps_are_left_out():
    slopes, error = {"a": 0.3, "b": -0.1}, 0.01
    points = [
        MeanAtStep(name, dt, 5 + b * dt**2, error)
        for name, b in slopes.items()
        for dt in (1.0, 2.0, 3.0)
    ]
    fit = extrapolate(points)
    assert fit.limit == pytest.approx(5)
    assert fit.longest == 3
    assert {name: at[0] for name, at in fit.slopes.items()} == pytest.approx(slopes)
    wild = MeanAtStep("a", 6.0, 5 + 0.3 * 36 + 0.02 * 6**4, error)
    assert extrapolate([*points, wild]) == fit
    assert fit.bias(wild)[0] == pytest.approx(0.3 * 36 + 0.02 * 6**4)
    assert fit.bias(wild)[1] == pytest.approx(np.hypot(error, fit.limit_error))
    alone = extrapolate([MeanAtStep("a", 2.0, 7.0, 0.1), MeanAtStep("b", 4.0, 8.0, 0.1)])
    assert (alone.limit, alone.limit_error, alone.slopes) == (7.0, 0.1, {})
    assert alone.bias(MeanAtStep("a", 2.0, 7.0, 0.1)) == (0.0, 0.0)


def test_errors_of_a_limit_and_of_biases_are_those_of_repeated_measurements():
    rng = np.random.default_rng(0)
    steps, errors = np.array([1.0, 2.0, 3.0, 4.0]), np.array([0.03, 0.02, 0.04, 0.02])
    limits, biases = [], []
    for _ in range(2000):
        noise = errors * rng.standard_normal((2, 4))
        points = [
            MeanAtStep(name, *point)
            for name, b, n in zip("ab", (0.02, 0.05), noise, strict=True)
            for point in zip(steps, 2 + b * steps**2 + n, errors, strict=True)
        ]
        fit = extrapolate(points)
        if fit.longest == 4:  # of what was not omitted by chance
            limits.append((fit.limit, fit.limit_error))
            biases.append([fit.bias(point) for point in points])
    assert len(limits) > 1700
    assert np.std([limit for limit, _ in limits]) == pytest.approx(limits[0][1], rel=0.08)
    found = np.array(biases)
    assert np.allclose(found[:, :, 0].std(axis=0), found[0, :, 1], rtol=0.08)
    assert np.mean([limit for limit, _ in limits]) == pytest.approx(
        2, abs=4 * limits[0][1] / np.sqrt(len(limits))
    )


def test_a_fit_has_its_chi2_and_the_order_of_the_integrator():
    """Each of two methods has its own order."""
    orders, slopes = {"a": 4, "b": 2}, {"a": 0.02, "b": -0.3}
    points = [
        MeanAtStep(name, dt, 1 + slopes[name] * dt**order, 0.1, order)
        for name, order in orders.items()
        for dt in (1.0, 2.0, 4.0)
    ]
    points[1] = points[1]._replace(mean=points[1].mean + 0.1)
    fit = extrapolate(points)
    assert fit.freedom == 3
    assert 0 < fit.chi2 < 3
    assert fit.limit == pytest.approx(1, abs=0.1)
    for name, slope in slopes.items():
        assert fit.slopes[name][0] == pytest.approx(slope, rel=0.05)
    assert extrapolate(points[:2]).freedom == 0


def test_points_that_no_fit_describes_make_the_error_of_the_limit_larger():
    """By the root of chi² over its degrees of freedom: two methods at three steps, and then at
    two."""
    off = {"a": (0.2, -0.2, 0.3), "b": (-0.1, 0.3, 0.1)}
    for count, freedom in ((3, 1), (2, 1)):
        points = [
            MeanAtStep(name, float(k + 1), 5 + values[k], 0.01 * (k + 1))
            for name, values in off.items()
            for k in range(count)
        ]
        fit = extrapolate(points)
        used = [point for point in points if point.timestep <= 2]
        design = np.array(
            [[1.0, *(point.timestep**2 * (point.method == name) for name in off)] for point in used]
        )
        errors = np.array([point.error for point in used])
        weighted = design / errors[:, None]
        found, (chi2,), _, _ = np.linalg.lstsq(
            weighted, np.array([point.mean for point in used]) / errors, rcond=None
        )
        assert (fit.longest, fit.freedom) == (2.0, freedom)
        assert fit.chi2 == pytest.approx(chi2) and chi2 > 10
        assert fit.limit == pytest.approx(found[0])
        plain = np.sqrt(np.linalg.inv(weighted.T @ weighted)[0, 0])
        assert fit.limit_error == pytest.approx(plain * np.sqrt(chi2 / freedom))


@pytest.mark.parametrize(
    ("slope", "error", "seen"), [(0.1, 1.0, False), (-0.1, 0.5, False), (2.0, 0.1, True)]
)
def test_the_step_of_a_bias_that_is_not_seen_allows_for_its_error(slope, error, seen):
    """Means 5 + slope dt^p of two steps whose errors give the slope this error."""
    steps = np.array([1.0, 2.0])
    for order in (2, 4):
        of_mean = error * (steps[1] ** order - steps[0] ** order) / np.sqrt(2)
        points = [MeanAtStep("a", dt, 5 + slope * dt**order, of_mean, order) for dt in steps]
        fit = extrapolate(points)
        assert fit.slopes["a"] == pytest.approx((slope, error))
        limit = Limit({}, "baoab", "U", points, fit, scale=250.0)
        steepest = abs(slope) + (0.0 if seen else UNSEEN * error)
        step = (BIAS_LIMIT * 250.0 / steepest) ** (1 / order)
        assert limit.step_at_limit == f"{'' if seen else '> '}{step:.2g}"
        assert limit._replace(scale=None).step_at_limit is None


@pytest.mark.parametrize(
    ("steps", "runs", "more", "errors", "longest"),
    [
        ((2.0, 4.0), 1, 0.0, 1.0, 4.0),  # errors of single runs
        ((1.0, 2.0, 4.0), 2, 0.0, 1.0, 4.0),
        (
            (1.0, 2.0, 4.0),
            4,
            0.0,
            0.6,
            4.0,
        ),  # errors of single runs that are too small: the scatter counts
        ((1.0, 2.0, 4.0), 8, 0.0, 1.6, 4.0),
        ((2.0, 4.0), 8, 0.0, None, 4.0),  # runs that are too short for an error
        (
            (1.0, 2.0, 3.0, 4.0, 6.0),
            8,
            6.0,
            1.0,
            4.0,
        ),  # the longest step has more than dt², and is omitted
    ],
)
def test_pulls_of_limits_have_unit_width(steps, runs, more, errors, longest):
    """(limit - truth)/error of 1000 extrapolations, of which chi² leaves out a sound step of some
    by chance."""
    rng, pulls, longests = np.random.default_rng(3), [], []
    for _ in range(1000):
        sampled = {}
        for dt in steps:
            values = 5 + 0.1 * dt**2 + more * (dt == steps[-1]) + rng.standard_normal(runs)
            within = (
                [None] * runs
                if errors is None
                else errors * np.exp(0.2 * rng.standard_normal(runs))
            )
            sampled[dt] = list(zip(values, within, strict=True))
        fit = extrapolate(means_of_runs(sampled))
        pulls.append((fit.limit - 5) / fit.limit_error)
        longests.append(fit.longest)
    assert np.mean(np.array(longests) == longest) > 0.85
    assert max(longests) == longest
    assert abs(np.mean(pulls)) < 0.15
    assert 0.9 < np.std(pulls) < 1.2
    assert 0.9 < np.quantile(np.abs(pulls), 0.683) < 1.2


def test_means_of_few_runs_without_errors_are_left_out():
    values = [(1.0, None), (1.2, None)]
    assert means_of_runs({1.0: values, 2.0: values}) == []
    known = means_of_runs({1.0: [(1.0, 0.3), (1.2, 0.4)], 2.0: [(1.5, 0.3)]})
    assert known[0][1:4] == pytest.approx((1.0, 1.1, np.sqrt((0.09 + 0.16) / 2 / 2)))
    assert known[1][1:4] == (2.0, 1.5, 0.3)


def test_a_value_of_runs_together_replaces_the_mean_of_their_values():
    """Squares of means, whose values in single runs are too high, or too short for a value."""
    rng, count = np.random.default_rng(5), 6
    for has_values in (True, False):
        pulls = []
        for _ in range(1000):
            runs, together = {}, {}
            for dt in (1.0, 2.0, 4.0):
                means = 3 + 0.1 * dt**2 + rng.standard_normal(count)
                runs[dt] = [(mean**2, 6.0) for mean in means] if has_values else []
                error = 2 * means.mean() * means.std(ddof=1) / np.sqrt(count)
                together[dt] = Together(means.mean() ** 2 - means.var(ddof=1) / count, error, count)
            points = means_of_runs(runs, together)
            assert [point.mean for point in points] == [value.value for value in together.values()]
            fit = extrapolate(
                [point._replace(mean=point.mean - 0.01 * point.timestep**4) for point in points]
            )
            pulls.append((fit.limit - 9) / fit.limit_error)
        assert abs(np.mean(pulls)) < 0.15
        assert 0.85 < np.std(pulls) < 1.2


def test_two_runs_together_have_a_limit_and_a_wide_error():
    together = {dt: Together(5.0 + dt**2, 0.1, 2) for dt in (1.0, 2.0)}
    points = means_of_runs({}, together)
    assert [point.error for point in points] == pytest.approx([0.1 * 1.32] * 2, rel=0.01)
    mixed = means_of_runs({4.0: [(21.0, 0.3)]}, together)
    assert mixed == []
