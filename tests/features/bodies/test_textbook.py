"""The textbook solvers on bodies whose inertia changes, compared with closed forms."""

import numpy as np
import pytest
from support import known
from support.common import ROOT

from rigidmd import Scene, Simulation

#: Of systems/satellite_mass_loss.toml: moments (40, 40, 60) kg m² up to 20 s, then evenly down to
#: (25, 25, 30) at 120 s.
TIMES, TRANSVERSE, AXIAL = [20.0, 120.0], [40.0, 25.0], [60.0, 30.0]
OMEGA = np.array([0.02, 0.0, 0.5])


def moments(t):
    return np.interp(t, TIMES, TRANSVERSE), np.interp(t, TIMES, AXIAL)


def run(**changes):
    overrides = {"output.trajectory": False, "output.interval_s": 5.0} | {
        k.replace("__", "."): v for k, v in changes.items()
    }
    return Simulation(Scene.read(ROOT / "systems" / "satellite_mass_loss.toml", overrides)).run()


@pytest.mark.parametrize(
    ("integrator", "step", "allowed"), [("rk4", 0.05, 1e-8), ("dop853", 5.0, 1e-9)]
)
def test_a_satellite_that_loses_mass_keeps_its_angular_momentum(integrator, step, allowed):
    """omega3 = L3/I3(t); L rotates about axis 3 at L3 (1/I3 - 1/I1) in the body and keeps its size:
    of its transverse part comes omega = L/I1(t). In the lab L stays, though the energy grows."""
    results = run(run__integrator=integrator, run__timestep_s=step)
    t = results["time"]
    assert t[-1] == 150.0 and len(t) == 31
    first, third = moments(t)
    L = OMEGA * [40.0, 40.0, 60.0]
    assert results["omega_body_3"] == pytest.approx(
        known.changing_inertia_spin(L[2], lambda at: moments(at)[1], t), abs=allowed
    )
    fine = np.linspace(0.0, 150.0, 300_001)
    rate = L[2] * (1 / moments(fine)[1] - 1 / moments(fine)[0])
    angle = np.interp(
        t, fine, np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(fine))])
    )
    # L1' = L2 L3 (1/I3 - 1/I1), L2' = -L1 L3 (1/I3 - 1/I1)
    assert results["omega_body_1"] == pytest.approx(L[0] * np.cos(angle) / first, abs=10 * allowed)
    assert results["omega_body_2"] == pytest.approx(-L[0] * np.sin(angle) / first, abs=10 * allowed)
    lab = np.stack([results[f"L_lab_{axis}"] for axis in "xyz"], axis=1)
    assert np.abs(lab - lab[0]).max() < 100 * allowed * np.linalg.norm(L)
    kinetic = 0.5 * (L[0] ** 2 / first + L[2] ** 2 / third)
    assert results["energy"] == pytest.approx(kinetic, rel=1e-6)
    assert (
        np.abs(results["energy_error"]).max() < 1e-6
    )  # the work of what changes the moments is accounted for
