"""Measured orders of integrators and their errors."""

import numpy as np
import pytest
from support.accuracy import FOURTH, made

from rigidmd.features.studies.accuracy.orders import convergence, fitted_order


@pytest.mark.parametrize(
    ("errors", "order", "at_floor"),
    [
        (FOURTH, 4.0, 0),
        ([*FOURTH[:1], 1e-3 * FOURTH[1], *FOURTH[2:]], 4.0, 0),  # small by accident, once
        ([*FOURTH[:2], 1e-6 * FOURTH[2], *FOURTH[3:]], 4.0, 0),
        ([*FOURTH[:7], 1e-3 * FOURTH[7], *FOURTH[8:]], 4.0, 0),
        ([*FOURTH[:4], 30 * FOURTH[4], *FOURTH[5:]], 4.0, 0),  # large
        ([*FOURTH[:6], 2e-8, 3e-8, 1.5e-8], 4.0, 2),  # rounding
        ([*FOURTH[:5], 5e-6, 3e-6, 6e-6, 2e-6], 4.0, 4),
        ([*FOURTH[:2], *[FOURTH[1]] * 5], None, 5),  # two steps above the floor
        (FOURTH[:2], None, 0),
        (FOURTH[:1], None, 0),
        ([], None, 0),
        ([0.3, 0.2, 0.35, 0.25, 0.3], None, 4),  # nothing falls
        ([0.3, 3e-2, 2e-2, 2e-5, 9e-6], None, 0),  # falls without an order
    ],
)
def test_orders_are_measured_where_errors_fall_and_have_an_error(errors, order, at_floor):
    steps = [2e-3 * 0.5**k for k in range(len(errors))]
    rows = [("srkn_4", *row) for row in zip(steps, [(1.0,)] * len(steps), errors, strict=True)]
    found = convergence(made(*rows, span=2e-2), "srkn_4", "energy_rms")
    assert [trial.timestep for trial in found.floor] == steps[len(steps) - at_floor :]
    if order is None:
        assert found.order is None
    else:
        assert abs(found.order.value - order) < 0.1
        assert found.order.error < 0.5


def test_noise_of_errors_is_the_error_of_an_order():
    rng = np.random.default_rng(3)
    pulls = []
    for _ in range(300):
        points = [(-k * np.log(2), -4 * k * np.log(2) + 0.1 * rng.normal()) for k in range(5)]
        order = fitted_order(points)
        pulls.append((order.value - 4) / order.error)
    assert 0.2 < np.median(np.abs(pulls)) < 1.5


def test_an_error_of_a_trajectory_below_that_of_the_reference_is_not_an_order():
    found = made(
        *[("srkn_4", 2e-3 * 0.5**k, (1.0,), error) for k, error in enumerate(FOURTH)], span=2e-2
    )
    found.reference_error = 9e-8
    assert len(convergence(found, "srkn_4", "rotation_error").floor) == 3
    assert convergence(found, "srkn_4", "energy_rms").floor == []
