"""Derived forces: slopes of functions of numbers and of pairs of bodies."""

import numpy as np
import pytest

from rigidmd.features.potentials.expressions.slopes import code_of, function_of, slopes_of
from rigidmd.features.potentials.expressions.trace import Graph, TraceError
from rigidmd.features.potentials.poses.formulas import formula_of_poses


def traced(function, names):
    """(energy, slopes) of a function of numbers, as a function that Python runs."""
    graph = Graph()
    leaves = [graph.leaf(name) for name in names]
    output = function(*leaves)
    outputs = [output, *slopes_of(output, leaves)]
    return function_of(outputs, ", ".join(names), np), len(code_of(outputs)[0])


@pytest.mark.parametrize(
    "function",
    [
        lambda x, y: x * y + 2 * x - y / x,
        lambda x, y: np.exp(-x) * np.sin(y) + np.cos(x * y),
        lambda x, y: np.sqrt(x * x + y**2) ** 3 + x**-1.5 + 2**y,
        lambda x, y: np.tanh(x - y) + np.log(x) - abs(y - 3) + np.arccos(y / 5),
        lambda x, y: np.where(x > y, x * x, y * x) + np.maximum(x, 0.1) - np.minimum(y, 0.7),
        lambda x, y: -(x * -1) + 0 * y + x * 1 - (0 - y) + x**1 + x**0 + (x - x),
        lambda x, y: x**y,
        lambda x, y: np.array([x, y], object) @ np.array([y, x], object) + np.square(x),
    ],
)
@pytest.mark.parametrize("at", [(0.8, 0.3), (0.4, 1.7)])
def test_slopes_are_those_of_differences(function, at):
    compiled, _ = traced(function, ("x", "y"))
    value, *slopes = compiled(*at)
    assert value == pytest.approx(float(function(*map(np.float64, at))), rel=1e-14)
    for k in range(2):
        step = 1e-6 * np.eye(2)[k]
        ends = [float(function(*(np.array(at) + sign * step))) for sign in (1, -1)]
        assert slopes[k] == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-7, abs=1e-8)


def test_equal_parts_are_computed_once_and_constants_here():
    _, lines = traced(lambda x, y: np.exp(x * y) + np.exp(x * y) ** 2, ("x", "y"))
    _, shorter = traced(lambda x, y: np.exp(x * y), ("x", "y"))
    assert lines <= shorter + 8
    _, none = traced(lambda x, y: x + 0.0 * np.exp(2.0) * y, ("x", "y"))
    assert none == 0


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda r, u, v: 1.0 if r[0] > 0 else 2.0, "branches on a value"),
        (lambda r, u, v: float(r[0]), "use the functions of NumPy"),
        (lambda r, u, v: np.arctan(r[0]), "arctan"),
        (lambda r, u, v: 3.0, "must return an energy that depends on"),
        (lambda r, u, v: (r[0], r), "a tuple of the energy"),
        (lambda r, u: r[0], r"must have the arguments \(r, a, b\)"),
        (lambda r, u, v: r[7], "IndexError"),
        (lambda r, u, v: r[0] / 0.0, "not a finite number"),
    ],
)
def test_functions_without_slopes_are_refused_with_the_reason(function, message):
    with pytest.raises(TraceError, match=message):
        formula_of_poses(function, (), "z")
