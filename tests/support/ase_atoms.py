"""Molecules as atoms of ASE."""

import numpy as np

from support.scenes import FORTY_WATERS

FORCES = FORTY_WATERS["forces"]
NVE = {"duration_ps": 0.06, "timestep_fs": 2.0}
OUTPUT = {"log_interval_ps": 0.02, "trajectory_interval_ps": 0.02, "figures": False}


def same_state(first, second) -> None:
    """Positions, rotations and momenta agree to rounding."""
    for name in ("position", "rotation", "velocity", "angular_momentum_body", "cell"):
        one, other = getattr(first, name), getattr(second, name)
        if name != "cell" or np.isfinite(one).all():
            assert np.abs(one - other).max(initial=0.0) <= 4e-14 * max(
                1.0, np.abs(one).max(initial=0.0)
            ), name
