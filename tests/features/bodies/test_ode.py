"""The textbook solvers: the same motion as the compositions, and closed forms."""

import numpy as np
import pytest
from support import known
from support.bodies import FLUID, FREE, ROTOR, end, kirchhoff_end, rotor_end, simulate
from support.common import ROOT
from support.scenes import PINNED

from rigidmd import Scene, Simulation
from rigidmd.errors import SimulationError


@pytest.mark.parametrize(
    ("formulation", "scene"),
    [
        pytest.param("matrix", PINNED | ROTOR, id="matrix-rotor"),
        pytest.param("quaternion", FREE | {"fluid": FLUID}, id="quaternion-fluid"),
        pytest.param(
            "euler_angles", PINNED | ROTOR, id="euler_angles-rotor", marks=pytest.mark.soak
        ),
        pytest.param("quaternion", PINNED | ROTOR, id="quaternion-rotor", marks=pytest.mark.soak),
        pytest.param("matrix", FREE | {"fluid": FLUID}, id="matrix-fluid", marks=pytest.mark.soak),
        pytest.param(
            "euler_angles", FREE | {"fluid": FLUID}, id="euler_angles-fluid", marks=pytest.mark.soak
        ),
    ],
)
def test_the_textbook_systems_are_the_same_motion(scene, formulation):
    exact = kirchhoff_end(1.0)[2:] if "fluid" in scene else rotor_end(1.0)
    options = {"run__formulation": formulation}
    found = {
        "rk4": simulate(scene, run__integrator="rk4", run__timestep_s=1e-3, **options),
        "dop853": simulate(scene, run__integrator="dop853", run__timestep_s=0.1, **options),
        "radau": simulate(
            scene,
            run__integrator="radau",
            run__timestep_s=0.1,
            run__relative_tolerance=1e-8,
            run__absolute_tolerance=1e-8,
            **options,
        ),
    }
    for name, results in found.items():
        _, _, q, w = end(results)
        allowed = 1e-5 if name == "radau" else 1e-7
        assert max(np.abs(q - exact[0]).max(), np.abs(w - exact[1]).max()) < allowed, name
        assert np.abs(results["energy_error"]).max() < 1e-4, name
    coarse = simulate(scene, run__integrator="rk4", run__timestep_s=0.05, **options)
    error = coarse.summary["largest_orthogonality_error"]
    assert (error < 1e-14) == (
        formulation == "euler_angles"
    )  # the accuracy control: it shows a step that is too long
    if formulation != "euler_angles":
        fine = simulate(scene, run__integrator="rk4", run__timestep_s=0.025, **options)
        assert np.log2(error / fine.summary["largest_orthogonality_error"]) > 3.5


def test_a_run_that_cannot_continue_states_when():
    def singular(pose):  # falls into a centre
        return -1e3 * pose.position / np.linalg.norm(pose.position) ** 6, np.zeros(3)

    with pytest.raises(
        SimulationError, match=r"at t = 0\.\d+: dop853 finds no step that keeps its tolerances"
    ):
        simulate(
            FREE,
            {"centre": singular},
            run__integrator="dop853",
            start__velocity_m_s=[0.0, 0.0, 0.0],
            start__position_m=[0.5, 0.0, 0.0],
            gravity__acceleration_m_s2=[0.0, 0.0, 0.0],
        )
    light = {
        "body": {"mass_kg": 1e-100},
        "applied": [{"force_N": [1e100, 0.0, 0.0]}],
        "run": {"duration_s": 1e99, "timestep_s": 1e98},
    }
    with pytest.raises(
        SimulationError, match=r"stopped at step .*: position or momentum of the body is not finite"
    ):
        simulate(light)


def test_euler_angles_are_singular_only_near_their_poles():
    tilted = FREE | {
        "start": {"euler_angles_deg": [0.0, 60.0, 0.0], "euler_rates_rad_s": [40.0, 0.0, 0.0]}
    }
    body = {"mass_kg": 1.0, "solid": {"shape": "sphere", "radius_m": 1.0}}
    for solver in ("rk4", "dop853"):  # dt phi' = 2: too long a step for RK4, but not singular
        results = simulate(
            tilted | {"body": body},
            run__integrator=solver,
            run__formulation="euler_angles",
            run__timestep_s=0.05,
        )
        assert results["theta"] == pytest.approx(np.full(11, np.pi / 3), abs=0.2)


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
