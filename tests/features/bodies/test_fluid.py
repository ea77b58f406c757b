"""Bodies in a fluid: resistance, buoyancy, added mass."""

import numpy as np
import pytest
from numba import njit
from scipy.integrate import solve_ivp
from support.bodies import FLUID, FREE, end, kirchhoff_end, simulate

from rigidmd.features.bodies.assemble import build_body
from rigidmd.features.bodies.forces import resistance
from rigidmd.mechanics.rotation import from_vector
from rigidmd.run import Simulation
from rigidmd.scene import Scene


def test_a_body_in_a_fluid_follows_kirchhoff():
    exact = kirchhoff_end(1.0)
    gaps = []
    for dt in (2e-3, 1e-3):
        results = simulate(FREE | {"fluid": FLUID}, run__timestep_s=dt)
        gaps.append(max(np.abs(a - b).max() for a, b in zip(end(results), exact, strict=True)))
        assert np.abs(results["energy_error"]).max() < 2e-5
    assert gaps[1] < 3e-6
    assert np.log2(gaps[0] / gaps[1]) == pytest.approx(2, abs=0.1)


def test_a_frictionless_fluid_keeps_energy_and_impulse():
    ideal = {key: FLUID[key] for key in ("added_mass_kg", "added_inertia_kg_m2")}
    results = simulate(
        FREE | {"fluid": ideal},
        gravity__acceleration_m_s2=[0.0, 0.0, 0.0],
        run__integrator="kahan_li_8",
        run__duration_s=20.0,
        run__timestep_s=0.02,
    )
    assert np.abs(results["energy_error"]).max() < 1e-12
    before, after = results.system.state.velocity, results.state.velocity
    assert (before == after).all()  # the impulse of body and fluid; the body's velocity wanders
    assert np.ptp(results["vx"]) > 0.1


@njit
def resisted_motion(*arguments):
    return resistance.resisted_motion(*arguments)


@pytest.mark.parametrize("dry", [0.0, 0.3])
@pytest.mark.parametrize("linear", [0.0, 1e-9, 0.4, 30.0])
@pytest.mark.parametrize("push", [0.0, 0.2, -0.2, 5.0, -5.0])
@pytest.mark.parametrize("h", [1e-9, 0.1, 1.0, 1e6])
def test_a_push_against_resistance_is_solved_exactly(dry, linear, push, h):
    for speed in (2.0, 0.05, 0.0, 1e-300):
        after, way = resisted_motion(speed, push, dry, linear, h)
        mirrored = resisted_motion(-speed, -push, dry, linear, h)
        assert (after, way) == (-mirrored[0], -mirrored[1])
        if dry == 0 == push and speed > 0:
            assert (after > 0) == (linear * h < 600)  # only dry friction brings anything to rest
        if dry and abs(push) <= dry and h == 1e6:
            assert after == 0  # and holds it
        if h <= 1 and (speed == 0 or speed > 1e-9):
            expected, left = np.array([speed, 0.0]), h
            while left > 0:  # until it stops, if it does, and on from there
                sense = np.sign(expected[0]) or (np.sign(push) if abs(push) > dry else 0.0)
                drive = 0.0 if sense == 0 else push - dry * sense

                def rate(_, y, drive=drive):
                    return [drive - linear * y[0], y[0]]

                def stops(_, y, sense=sense):
                    return y[0] * sense + 1e-300

                stops.terminal, stops.direction = True, -1
                solved = solve_ivp(
                    rate, (0, left), expected, method="DOP853", rtol=1e-12, atol=1e-15, events=stops
                )
                expected = solved.y[:, -1] * [solved.status == 0, 1]
                left = 0.0 if solved.status == 0 else left - solved.t[-1]
            assert after == pytest.approx(expected[0], rel=1e-9, abs=1e-12)
            assert way == pytest.approx(expected[1], rel=1e-9, abs=1e-12)


def test_stiff_resistance_ends_at_the_terminal_speed():
    for drag in (100.0, 1e6, 1e12):
        results = simulate(
            {
                "body": {"mass_kg": 1.0},
                "gravity": {},
                "fluid": {"linear_resistance_kg_s": [drag] * 3},
                "run": {"duration_s": 10.0, "timestep_s": 0.1},
                "output": {"trajectory": False},
            }
        )
        assert results["vz"][-1] == pytest.approx(-9.81 / drag, rel=1e-12)
        assert results["z"][-1] - results["z"][-2] == pytest.approx(-9.81 / drag * 0.1, rel=1e-9)
    bearing = {
        "body": {"mass_kg": 1.0, "inertia_kg_m2": [1.0, 1.0, 1.0]},
        "friction": {"dry_N_m": [0.0, 0.0, 2.0]},
        "applied": [{"axes": "body", "torque_N_m": [0.0, 0.0, 1.0]}],
        "run": {"duration_s": 10.0, "timestep_s": 0.1},
        "output": {"trajectory": False},
    }
    assert (simulate(bearing)["omega_body_3"] == 0).all()
    assert (simulate(bearing)["phi"] == 0).all()
    bearing["applied"][0]["torque_N_m"] = [0.0, 0.0, 3.0]  # 1 N m more than friction holds
    assert simulate(bearing)["omega_body_3"][-1] == pytest.approx(10.0, rel=1e-12)


def test_equal_coefficients_resist_alike_in_all_directions():
    ball = {
        "body": {"mass_kg": 1.0, "solid": {"shape": "sphere", "radius_m": 0.1}},
        "fluid": {
            "quadratic_resistance_kg_m": [1.0, 1.0, 1.0],
            "quadratic_rotational_resistance_N_m_s2": [0.01] * 3,
        },
        "run": {"duration_s": 2.0, "timestep_s": 1e-3},
        "output": {"trajectory": False},
    }
    for way in ([1.0, 0, 0], [0.6, 0.8, 0], [0.48, 0.6, 0.64]):
        results = simulate(
            ball | {"start": {"velocity_m_s": way, "angular_velocity_body_rad_s": way}}
        )
        speed = np.array([results[k][-1] for k in ("vx", "vy", "vz")])
        assert speed == pytest.approx(np.array(way) / 3, abs=1e-6)  # v0/(1 + b v0 t/m)
        spin = np.array([results[f"omega_body_{k}"][-1] for k in (1, 2, 3)])
        assert spin == pytest.approx(np.array(way) / (1 + 0.01 * 2 / 0.004), abs=1e-6)
    point = {k: v for k, v in ball.items() if k != "body"} | {"body": {"mass_kg": 1.0}}
    point["fluid"] = {"quadratic_resistance_kg_m": [1.0, 1.0, 1.0]}
    results = simulate(point | {"start": {"velocity_m_s": [0.48, 0.6, 0.64]}})
    assert [results[k][-1] for k in ("vx", "vy", "vz")] == pytest.approx(
        [0.16, 0.2, 0.64 / 3], abs=1e-6
    )


def test_weight_and_buoyancy_are_minus_the_gradient_of_their_energy():
    system = build_body(Scene.from_dict(FREE | {"fluid": FLUID}))
    engine, state = system.engine(), system.state
    load, _ = engine.evaluate(state)

    def energy(moved):
        return sum(tally.energy for tally in engine.evaluate(moved)[1].values())

    step = 1e-5
    for k in range(3):
        there, back = state.copy(), state.copy()
        there.position[0, k] += step
        back.position[0, k] -= step
        assert load.force[0, k] == pytest.approx(
            (energy(back) - energy(there)) / (2 * step), rel=1e-6
        )
        turn = from_vector(step * np.eye(3)[k])
        there, back = state.copy(), state.copy()
        there.rotation[0] = there.rotation[0] @ turn
        back.rotation[0] = back.rotation[0] @ turn.T
        assert load.torque_body[0, k] == pytest.approx(
            (energy(back) - energy(there)) / (2 * step), rel=1e-6
        )


@pytest.mark.parametrize("strength", [1e-6, 1.0, 1e3, 1e6, 1e12])
def test_quadratic_resistance_never_ends(strength):
    """However strong, it brakes, and never past zero: |v| at the middle of a kick is the value of the
    resistance itself."""
    point = {
        "body": {"mass_kg": 1.0},
        "start": {"velocity_m_s": [1.0, -2.0, 0.5]},
        "run": {"duration_s": 4.0, "timestep_s": 0.5},
    }
    point["fluid"] = {"quadratic_resistance_kg_m": [strength] * 3}
    results = Simulation(
        Scene.from_dict(
            point | {"output": {"trajectory": False, "figures": False, "interval_s": 0.5}}
        )
    ).run()
    speed = np.sqrt(sum(results[k] ** 2 for k in ("vx", "vy", "vz")))
    known = speed[0] / (1 + strength * speed[0] * results["time"])
    assert (np.diff(speed) <= 0).all()
    assert speed[-1] < speed[0]
    assert (speed[1:] <= 1.2 * known[1:]).all()
    assert (results["vx"] >= 0).all()
    fixed = point | {
        "body": {"mass_kg": 1.0, "inertia_kg_m2": [1.0, 1.0, 1.0], "pinned": True},
        "start": {"angular_velocity_body_rad_s": [1.0, -2.0, 0.5]},
    }
    fixed["fluid"] = {"quadratic_rotational_resistance_N_m_s2": [strength] * 3}
    turning = Simulation(
        Scene.from_dict(
            fixed | {"output": {"trajectory": False, "figures": False, "interval_s": 0.5}}
        )
    ).run()
    spin = np.sqrt(sum(turning[f"omega_body_{k}"] ** 2 for k in (1, 2, 3)))
    assert spin == pytest.approx(speed, rel=1e-9, abs=1e-12)


def test_a_stone_released_in_a_stiff_fluid_falls_at_its_terminal_speed():
    stone = {
        "body": {"mass_kg": 1.0},
        "gravity": {},
        "fluid": {"quadratic_resistance_kg_m": [1e8] * 3},
        "run": {"duration_s": 3.0, "timestep_s": 0.5},
    }
    results = Simulation(
        Scene.from_dict(
            stone | {"output": {"trajectory": False, "figures": False, "interval_s": 0.5}}
        )
    ).run()
    assert results["vz"][1:] == pytest.approx(-np.sqrt(9.81 / 1e8), rel=1e-9)


def drag(pose):
    return -0.3 * pose.velocity, [0, 0, 0]


def gyroscopic(pose):
    return [0, 0, 0], np.cross([0.2, 0.1, 0.4], pose.angular_velocity_body)


def pulled(pose):
    return [np.sin(pose.time), 0, 0], 0.1 * pose.rotation[2]


@pytest.mark.parametrize("start", [FREE["start"], {"position_m": [0.0, 0.0, 0.0]}])
def test_functions_that_depend_on_velocities_are_noted(start):
    """At rest too; not the values of the pose, and not with a solver of the textbook equations."""
    data = FREE | {"start": start}
    simulation = Simulation(
        Scene.from_dict(data), applied={"drag": drag, "spin": gyroscopic, "pull": pulled}
    )
    assert simulation.system.velocity_dependent_functions() == ["drag", "spin"]
    notes = simulation.run().summary["notes"]
    assert any("drag and spin" in note and "order 1" in note and "dop853" in note for note in notes)
    notes = simulate(data, {"drag": drag}, run__integrator="dop853").summary["notes"]
    assert not any("order 1" in note for note in notes)
