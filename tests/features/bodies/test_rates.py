"""Rates of single bodies in the summary: precession, nutation, flips, measured in runs and in
closed form."""

import json

import numpy as np
import pytest
from scipy import special
from scipy.integrate import quad
from scipy.special import ellipk
from support.common import ROOT

import rigidmd
from rigidmd.commands.cli import main
from rigidmd.features.bodies.theory import complete_integral, free_body_period, heavy_top_motion

SYSTEMS = ROOT / "systems"
#: A top whose spin is fast enough for steady precession at 30°.
SPIN, LEAN = 200.0, np.radians(30)
TEXTBOOK = {
    "body": {
        "mass_kg": 0.1,
        "inertia_kg_m2": [2e-4, 2e-4, 5e-5],
        "inertia_about": "pivot",
        "pinned": True,
        "centre_of_mass_m": [0.0, 0.0, 0.04],
    },
    "start": {"euler_angles_deg": [0.0, 30.0, 0.0], "euler_rates_rad_s": [0.0, 0.0, SPIN]},
    "gravity": {},
    "run": {"duration_s": 3.0, "timestep_s": 1e-3, "integrator": "kahan_li_8"},
}


def rates(scene, **more):
    """The rates in the summary of a run: name -> (measured, theory)."""
    found = rigidmd.Simulation(scene, **more).run().summary["rates"]
    return {name: (rate["measured"], rate["theory"]) for name, rate in found.items()}


def shipped(name, **changes):
    return rigidmd.Scene.read(
        SYSTEMS / f"{name}.toml", {key.replace("__", "."): value for key, value in changes.items()}
    )


@pytest.mark.parametrize("spin", [0.01, -0.02, 0.3])
@pytest.mark.parametrize(
    ("lean", "phi", "theta"), [(0.4, 5.0, 3.0), (1.9, -2.0, 4.0), (2.8, 1.0, 0.0)]
)
def test_the_motion_of_a_top_is_the_quadrature_of_its_cubic(spin, lean, phi, theta):
    across, moment = 2e-4, 0.03924
    turning = across * phi * np.sin(lean) ** 2
    vertical = turning + spin * np.cos(lean)
    energy = 0.5 * across * ((phi * np.sin(lean)) ** 2 + theta**2) + moment * np.cos(lean)
    alpha, beta, b, c = 2 * moment / across, 2 * energy / across, vertical / across, spin / across
    low, high, top = np.sort(
        np.roots([alpha, -(beta + c * c), 2 * b * c - alpha, beta - b * b]).real
    )

    def over_a_period(of):
        middle, half = (low + high) / 2, (high - low) / 2

        def speed(u):
            return np.sqrt(alpha * (top - u))

        def inner(s):
            return of(middle + half * np.sin(s)) / speed(middle + half * np.sin(s))

        return 2 * quad(inner, -np.pi / 2, np.pi / 2, epsabs=0, epsrel=1e-11, limit=500)[0]

    period = over_a_period(lambda u: 1.0)
    angle = over_a_period(lambda u: (b - c * u) / (1 - u * u))
    transverse = across**2 * ((phi * np.sin(lean)) ** 2 + theta**2)
    found = heavy_top_motion(across, moment, spin, np.cos(lean), transverse, turning)
    assert found.nutation_period == pytest.approx(period, rel=1e-9)
    assert found.precession == pytest.approx(angle / period, rel=1e-8)


@pytest.mark.parametrize(
    "omega", [[0.0, 30.0, 0.05], [0.3, 2.0, 0.1], [1.0, 0.1, 0.2], [0.1, 0.2, 3.0]]
)
@pytest.mark.parametrize("inertia", [[9.82e-6, 1.338e-5, 2.263e-5], [3.0, 1.0, 2.0]])
def test_the_period_of_a_free_body_is_an_elliptic_integral(inertia, omega):
    inertia, omega = np.array(inertia), np.array(omega)
    (a, b, c), squares = np.sort(inertia), omega[np.argsort(inertia)] ** 2
    energy, size = np.array([a, b, c]) @ squares, np.array([a, b, c]) ** 2 @ squares
    if size > energy * b:
        rate, parameter = (c - b) * (size - energy * a), (b - a) * (energy * c - size)
    else:
        rate, parameter = (a - b) * (size - energy * c), (b - c) * (energy * a - size)
    expected = 4 * ellipk(parameter / rate) * np.sqrt(a * b * c / rate)
    assert free_body_period(inertia, omega) == pytest.approx(expected, rel=1e-9)


def test_rotation_about_the_middle_axis_never_returns():
    assert free_body_period(np.array([1.0, 2.0, 3.0]), np.array([0.0, 1.0, 0.0])) == np.inf


def test_steady_precession_has_the_slow_root_of_the_quadratic():
    momentum, moment, across = 5e-5 * SPIN, 0.1 * 9.81 * 0.04, 2e-4
    slow = (momentum - np.sqrt(momentum**2 - 4 * across * np.cos(LEAN) * moment)) / (
        2 * across * np.cos(LEAN)
    )
    assert slow == pytest.approx(4.2345866, abs=1e-7)
    turn = [slow, 0.0, SPIN - slow * np.cos(LEAN)]
    found = rates(
        rigidmd.Scene.from_dict(
            TEXTBOOK | {"start": TEXTBOOK["start"] | {"euler_rates_rad_s": turn}}
        )
    )
    assert found["precession_rad_s"] == pytest.approx((slow, slow), rel=1e-11)
    assert found["spin_rad_s"] == (pytest.approx(SPIN, rel=1e-13), None)
    assert "nutation_period_s" not in found  # theta is constant


#: The top of TEXTBOOK about other axes: axis 3 -> 1, -> 2, and gravity in any direction.
TURNED = {
    "axis 1": ([5e-5, 2e-4, 2e-4], [0.04, 0.0, 0.0], [0.3, 0.0, 0.0], [SPIN, 0.0, 0.0]),
    "axis 2": ([2e-4, 5e-5, 2e-4], [0.0, 0.04, 0.0], [0.0, 0.0, 0.4], [0.0, SPIN, 0.0]),
    "hanging": ([2e-4, 2e-4, 5e-5], [0.0, 0.0, -0.04], [0.0, 0.5, 0.2], [2.0, 0.0, SPIN / 10]),
}


@pytest.mark.parametrize("name", TURNED)
def test_precession_is_about_the_direction_of_gravity(name):
    inertia, centre, angles, omega = TURNED[name]
    body = TEXTBOOK["body"] | {"inertia_kg_m2": inertia, "centre_of_mass_m": centre}
    start = {
        "yaw_pitch_roll_deg": np.degrees(angles).tolist(),
        "angular_velocity_body_rad_s": omega,
    }
    scene = TEXTBOOK | {
        "body": body,
        "start": start,
        "gravity": {"acceleration_m_s2": [-3.0, 8.0, -6.0]},
    }
    found = rates(rigidmd.Scene.from_dict(scene))
    assert {"precession_rad_s", "nutation_period_s", "spin_rad_s"} == set(found)
    for key in ("precession_rad_s", "nutation_period_s"):
        measured, theory = found[key]
        assert measured == pytest.approx(theory, rel=1e-7), key


@pytest.mark.parametrize(
    ("name", "duration"), [("heavy_top_2", 0.4), ("heavy_top_4", 1.0), ("heavy_top_6", 1.5)]
)
def test_tops_that_nutate_precess_as_in_theory_on_average(name, duration):
    found = rates(shipped(name, run__duration_s=duration))
    for key in ("precession_rad_s", "nutation_period_s"):
        measured, theory = found[key]
        assert measured == pytest.approx(theory, rel=1e-8), key


def test_a_t_handle_flips_as_in_theory(tmp_path, printed):
    less = ["--set", "output.figures=false", "--set", "run.duration_s=5", "-o", str(tmp_path / "t")]
    assert (
        "  flips           every 1.191569 s; in theory 1.191569\n"
        in printed("run", SYSTEMS / "t_handle.toml", *less).out
    )
    found = json.loads((tmp_path / "t" / "summary.json").read_text())["rates"]
    for name, factor in (("flip_interval_s", 1), ("omega_period_s", 2)):
        for value in found[name].values():
            assert value == pytest.approx(factor * 1.191569083, rel=1e-9)
    assert main(["report", str(tmp_path / "t")]) == 0
    assert "every 1.191569 s; in theory 1.191569" in (tmp_path / "t" / "report.html").read_text()


def test_a_wobble_about_a_stable_axis_is_not_a_flip():
    found = rates(shipped("free_asymmetric_top", run__duration_s=20.0))
    assert set(found) == {"omega_period_s"}
    measured, theory = found["omega_period_s"]
    assert measured == pytest.approx(theory, rel=1e-9)


@pytest.mark.parametrize(
    ("name", "along"), [("free_symmetric_top_oblate", 30.0), ("free_symmetric_top_prolate", 20.0)]
)
def test_a_free_symmetric_top_precesses_about_its_angular_momentum(name, along):
    results = rigidmd.Simulation(shipped(name, run__duration_s=0.5)).run()
    found, system = results.summary["rates"], results.system
    momentum = np.linalg.norm([results[f"L_lab_{k}"][0] for k in "xyz"])
    measured, theory = found["precession_about_L_rad_s"].values()
    assert theory == pytest.approx(momentum / system.inertia[0], rel=1e-13)
    assert measured == pytest.approx(theory, rel=1e-11)
    assert found["spin_rad_s"]["measured"] == pytest.approx(along, rel=1e-12)


def test_rates_without_a_closed_form_have_no_theory():
    short = TEXTBOOK | {"run": {"duration_s": 0.6, "timestep_s": 1e-3}}
    rubbed = rates(
        rigidmd.Scene.from_dict(short | {"friction": {"viscous_N_m_s": [1e-6, 1e-6, 1e-6]}})
    )
    pushed = rates(
        rigidmd.Scene.from_dict(short), applied={"push": lambda pose: ([0, 0, 0], [1e-4, 0, 0])}
    )
    for found in (rubbed, pushed):
        assert found["precession_rad_s"][0] == pytest.approx(4.3, abs=0.3)
        assert {theory for _, theory in found.values()} == {None}


@pytest.mark.parametrize(
    "name", ["dropped_stone", "gyrocompass", "satellite_wheel", "body_in_fluid"]
)
def test_bodies_that_do_none_of_this_have_no_rates(name):
    duration = 200.0 if name == "gyrocompass" else 1.0
    assert rates(shipped(name, run__duration_s=duration)) == {}


def test_a_run_that_is_too_short_has_the_theory_only(tmp_path, printed):
    found = rates(shipped("heavy_top_3", run__duration_s=0.2))
    assert found["nutation_period_s"] == (None, pytest.approx(0.33876572785788))
    assert found["precession_rad_s"][0] is None
    short = [
        "--set",
        "run.duration_s=0.2",
        "--set",
        "output.figures=false",
        "-o",
        str(tmp_path / "short"),
    ]
    assert (
        "every 0.3387657 s in theory. Fewer than two periods in the samples"
        in printed("run", SYSTEMS / "heavy_top_3.toml", *short).out
    )


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_the_range_of_theta_is_that_of_the_whole_run(sense):
    """A start in the middle of the range, upwards and downwards."""
    start = {"euler_angles_deg": [0.0, 50.0, 0.0], "euler_rates_rad_s": [1.0, 8.0 * sense, 60.0]}
    results = rigidmd.Simulation(rigidmd.Scene.from_dict(TEXTBOOK | {"start": start})).run()
    low, high = results.summary["theta_range_deg"]
    theta = np.degrees(results["theta"])
    assert (low, high) == (theta.min(), theta.max())
    assert low < 45 and high > 55


@pytest.mark.parametrize("seed", range(3))
def test_elliptic_integrals_are_those_of_scipy(seed):
    """Also of arguments that differ by many orders, and near the singular end."""
    rng = np.random.default_rng(seed)
    for _ in range(200):
        complement, p = 10.0 ** rng.uniform(-12, 0), 10.0 ** rng.uniform(-8, 3)
        first, third = special.elliprf(0, complement, 1), special.elliprj(0, complement, 1, p)
        parts = first, (1 - p) / 3 * third
        rounding = 1e-12 * max(map(abs, parts))
        assert complete_integral(complement, p) == pytest.approx(sum(parts), abs=rounding)
        for m1 in (complement, complement * 1e-200):
            assert complete_integral(m1) == pytest.approx(special.ellipkm1(m1), rel=3e-15)
    assert complete_integral(0.0) == complete_integral(0.5, 0.0) == np.inf
