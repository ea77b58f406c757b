"""Moving frames, wheels, and what is switched on and off."""

import numpy as np
import pytest
from scipy.integrate import quad
from support.bodies import FREE, ROTOR, end, rotor_end, simulate
from support.common import same_bits
from support.scenes import PINNED

from rigidmd.errors import SceneError
from rigidmd.features.bodies.time_functions import constant_function as steady
from rigidmd.features.bodies.time_functions import integrate_function as integral
from rigidmd.features.bodies.time_functions import interpolated_function as table
from rigidmd.features.bodies.time_functions import is_constant_function as is_steady
from rigidmd.features.bodies.time_functions import pulse_function as window
from rigidmd.features.bodies.time_functions import sum_functions as total
from rigidmd.features.bodies.time_functions import values_at as value_at
from rigidmd.mechanics.rotation import from_vector
from rigidmd.run import Simulation
from rigidmd.scene import Scene


def test_wheels_drives_and_friction_in_a_rotating_accelerated_frame():
    q, w = rotor_end(1.0)
    gaps = []
    for dt in (2e-3, 1e-3):
        results = simulate(PINNED | ROTOR, run__timestep_s=dt)
        _, _, found, spin = end(results)
        gaps.append(max(np.abs(found - q).max(), np.abs(spin - w).max()))
        assert np.abs(results["energy_error"]).max() < 1e-4
    assert not np.array_equal(
        results.system.axes, np.eye(3)
    )  # the centre of mass is off every axis
    wheels = np.stack([results[f"h_body_{k}"][[0, -1]] for k in (1, 2, 3)], axis=1)
    slant = np.array([0.0, 1.0, 2.0]) / 5**0.5
    # the motors' torques over time: 0.15 up to the peak, as much down from it and beyond zero, 0.1
    # beyond their table
    assert wheels == pytest.approx(
        np.array([1.5 * slant, 1.55 * slant + [0.21, 0.0, 0.0]]), abs=1e-12
    )
    assert gaps[1] < 5e-5
    assert np.log2(gaps[0] / gaps[1]) == pytest.approx(2, abs=0.1)


@pytest.mark.parametrize(
    "integrator", ["velocity_verlet", "srkn_6", "kahan_li_8", "rk4", "dop853", "radau"]
)
def test_what_is_switched_on_and_off_gives_its_whole_impulse(integrator):
    stone = {
        "body": {"mass_kg": 2.0},
        "run": {"duration_s": 100.0, "timestep_s": 0.25, "integrator": integrator},
        "output": {"trajectory": False},
    }
    for first, last in ((0.0, 1.0), (50.0, 51.0), (50.07, 50.19), (99.0, 100.0)):
        results = simulate(
            stone | {"applied": [{"force_N": [3.0, 0.0, 0.0], "from_s": first, "to_s": last}]}
        )
        assert results["vx"][-1] == pytest.approx(1.5 * (last - first), rel=1e-9)
        assert results["x"][-1] == pytest.approx(
            1.5 * (last - first) * (100.0 - 0.5 * (first + last)), rel=1e-9
        )
        assert results["time"][-1] == pytest.approx(100.0, rel=2e-3)
        assert np.diff(results["time"]).min() > 0


def test_breaks_at_the_ends_and_on_top_of_each_other_do_no_harm():
    stone = {
        "body": {"mass_kg": 2.0},
        "run": {"duration_s": 1.0, "timestep_s": 0.3},
        "output": {"trajectory": False},
    }
    late = simulate(
        stone | {"applied": [{"force_N": [3.0, 0.0, 0.0], "from_s": 0.95}]}
    )  # three steps end at 0.9
    assert late["time"][-1] == pytest.approx(0.9)
    assert (late["vx"] == 0).all()
    twins = [
        {"force_N": [3.0, 0.0, 0.0], "from_s": 0.5},
        {"force_N": [1.0, 0.0, 0.0], "from_s": 0.5 + 1e-12},
    ]
    assert simulate(stone | {"applied": twins})["vx"][-1] == pytest.approx(2 * 0.4, rel=1e-9)


def test_a_frame_that_changes_its_axis_is_left_to_compositions():
    frame = {"angular_velocity_rad_s": [[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]], "times_s": [0.0, 1.0]}
    with pytest.raises(SceneError, match="a frame that changes its axis has no exact flow"):
        simulate(FREE | {"frame": frame}, run__integrator="srkn_6")
    exact = simulate(
        FREE | {"frame": frame},
        run__integrator="dop853",
        run__timestep_s=0.1,
        run__relative_tolerance=1e-12,
        run__absolute_tolerance=1e-12,
    )
    errors = [
        max(
            np.abs(a - b).max()
            for a, b in zip(
                end(
                    simulate(
                        FREE | {"frame": frame}, run__integrator="suzuki_4", run__timestep_s=dt
                    )
                ),
                end(exact),
                strict=True,
            )
        )
        for dt in (0.1, 0.05)
    ]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.3)


def test_a_table_does_not_cost_the_order_of_the_integrator():
    errors = []
    for dt in (0.1, 0.05):
        results = simulate(
            PINNED | ROTOR | {"friction": None}, run__timestep_s=dt, run__integrator="kahan_li_6"
        )
        exact = simulate(
            PINNED | ROTOR | {"friction": None}, run__timestep_s=2e-3, run__integrator="kahan_li_6"
        )
        errors.append(np.abs(results.state.rotation - exact.state.rotation).max())
    assert np.log2(errors[0] / errors[1]) > 5


def test_courses():
    motor = window([1.0, 2.0, 3.0], 0.5, 1.5)
    assert value_at(motor, np.array([0.0, 0.5, 1.4, 1.5, 9.0]))[:, 0].tolist() == [0, 1, 1, 0, 0]
    ramp = table([1.0, 2.0, 4.0], [[0.0, 0, 0], [1.0, 0, 0], [5.0, 0, 0]])
    assert value_at(ramp, np.array([0.0, 1.0, 1.5, 3.0, 4.0, 9.0]))[:, 0].tolist() == [
        0,
        0,
        0.5,
        3,
        5,
        5,
    ]
    both = integral(total([motor, ramp]), np.array([10.0, 0, 0]))
    for t in (0.3, 0.7, 1.2, 1.7, 3.1, 6.0):
        area = quad(
            lambda s: float(
                value_at(motor, np.array([s]))[0, 0] + value_at(ramp, np.array([s]))[0, 0]
            ),
            0,
            t,
            points=[p for p in (0.5, 1.0, 1.5, 2.0, 4.0) if p < t] or None,
        )[0]
        assert value_at(both, np.array([t]))[0, 0] == pytest.approx(10 + area, abs=1e-12)
    assert is_steady(steady([1.0, 2.0, 3.0]))
    assert not is_steady(motor)
    assert value_at(window([1.0, 0, 0], 0.0, np.inf), np.array([0.0, 1e9]))[:, 0].tolist() == [1, 1]


def test_a_changing_or_accelerating_frame_agrees_with_one_that_does_not_rotate():
    # a free body that nothing acts on, given in a frame that spins up about a fixed direction: exact
    rest = simulate(FREE, gravity__acceleration_m_s2=[0.0, 0.0, 0.0])
    direction = np.array([1.0, 2.0, -1.0])
    turned = simulate(
        FREE | {"frame": {"angular_acceleration_rad_s2": list(0.7 * direction)}},
        gravity__acceleration_m_s2=[0.0, 0.0, 0.0],
    )
    back = from_vector(-0.35 * direction)  # 0.7 t²/2 at t = 1
    for a, b in zip(end(turned)[:3:2], end(rest)[:3:2], strict=True):
        assert a == pytest.approx(back @ b, abs=1e-12)
    # velocity and angular velocity are relative to the frame
    x, v, _, _ = end(turned)
    assert v == pytest.approx(back @ end(rest)[1] - np.cross(0.7 * direction, x), abs=1e-12)
    assert (
        "energy_error" not in turned.samples.columns
    )  # not conserved in such a frame, and not stated to be


def test_the_same_scene_gives_the_same_bits_however_often_it_is_observed():
    ends = [simulate(PINNED | ROTOR, output__interval_s=dt).state for dt in (0.01, 0.07, 1.0, 1.0)]
    for other in ends[1:]:
        assert same_bits(ends[0], other)
    simulation = Simulation(Scene.from_dict(PINNED | ROTOR))
    assert (
        simulation.run().samples["energy"].tobytes() == simulation.run().samples["energy"].tobytes()
    )
