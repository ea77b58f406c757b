"""Scenes of a body that cannot be what their author meant: each error one clear message, all at
once."""

import tomllib

import pytest
from support.common import ROOT

from rigidmd.errors import SceneError
from rigidmd.features.bodies.assemble import build_body
from rigidmd.scene import Scene

RUN = {"duration_s": 1.0, "timestep_s": 0.01}


def faults(**tables):
    with pytest.raises(SceneError) as caught:
        build_body(
            Scene.from_dict(
                {"body": {"mass_kg": 1.0, "inertia_kg_m2": [1.0, 2.0, 2.5]}, "run": RUN} | tables
            )
        )
    return "\n".join(caught.value.errors)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("body = {mass_kg = 1.0, inertia_kg_m2 = [1.0, 2.0, 4.0]}", "triangle inequality"),
        (
            "body = {mass_kg = 1.0, inertia_tensor_kg_m2 = [[1, 5.0, 0], [5.0, 1, 0], [0, 0, 1]]}",
            "must not be negative",
        ),
        (
            "body = {mass_kg = 1.0, inertia_tensor_kg_m2 = [[1.0, 0.1, 0], [0, 1, 0], [0, 0, 1]]}",
            "is not symmetric",
        ),
        (
            "body = {mass_kg = 1.0, inertia_kg_m2 = [1.0, 1.0, 0.5], pinned = true, centre_of_mass_m = [0.0, 0.0, 1.0], inertia_about = 'pivot'}",
            "inertia about its pivot: about its centre of mass",
        ),
        ("run.integrator = 'baoab'", "is 'baoab': it has a thermostat, for molecules"),
        ("run.integrator = 'leapfrog'", "is 'leapfrog': write 'velocity_verlet'"),
        ("run.integrator = ['srkn_4']", "run.integrator: is a list, must be"),
        ("run.integrator = {}", "run.integrator: is a table, must be"),
        ("run.duration_s = '2 ms'", "must be a number: write 0.002, in s"),
        ("watch.energy = 1e-30", "must not be less than 1e-09"),
        (
            "body = {mass_kg = 1.0, solid = {shape = 'cuboid', lengths_m = [1e+90, 1e+90, 1e+80]}}\nstart.angular_velocity_body_rad_s = [1.0, 0, 2.0]",
            "energy at the start: mass, moments of inertia or rates are too large",
        ),
        ("body.mass_kg = 1e+90\nstart.velocity_m_s = [1e+90, 0.0, 1.0]", "are too large"),
        ("body.mass_kg = -1.0", "must be greater than 0"),
        ("body = {}", "mass_kg is missing"),
        ("body = {mass_kg = 1.0, solid = {shape = 'con', radius_m = 1.0}}", "did you mean cone?"),
        (
            "body = {mass_kg = 1.0, solid = {shape = 'cone', radius_m = 1.0}}",
            "a cone has height_m and radius_m, not radius_m",
        ),
        (
            "start = {rotation = [[0.9, 0.5, 0], [0.5, 0.866, 0], [0, 0, 1.0]], project = true}",
            "must be below 0.1",
        ),
        (
            "body = {mass_kg = 1.0, solid = {shape = 'disk', radius_m = 1.0}, inertia_kg_m2 = [1.0, 1, 1]}",
            "give one of",
        ),
        (
            "body = {points = [{mass_kg = 1.0, position_m = [0.0, 0, 0]}], mass_kg = 2.0}",
            "mass_kg would have no effect",
        ),
        (
            "body.solids = [{shape = 'sphere', radius_m = 1.0}]",
            "body.solids.0: give mass_kg or density_kg_m3",
        ),
        (
            "body.solids = [{shape = 'sphere', radius_m = 1.0, mass_kg = 1.0, density_kg_m3 = 1.0}]",
            "give mass_kg or density_kg_m3, not both",
        ),
        (
            "body.solids = [{shape = 'sphere', radius_m = 1.0, density_kg_m3 = -1.0}]",
            "body.solids.0.density_kg_m3: is -1.0, must be greater than 0",
        ),
        (
            "body = {solids = [{shape = 'sphere', radius_m = 1.0, mass_kg = 1.0}], mass_kg = 2.0}",
            "mass_kg would have no effect: the solids have masses",
        ),
        (
            "body = {solids = [{shape = 'sphere', radius_m = 1.0, mass_kg = 1.0}], pinned = true, centre_of_mass_m = [0.0, 0, 1]}",
            "it follows from the solids",
        ),
        (
            "body = {solids = [{shape = 'sphere', radius_m = 1.0, mass_kg = 1.0}], pinned = true, inertia_about = 'pivot'}",
            "would have no effect with solids",
        ),
        (
            "body = {solids = [{shape = 'sphere', radius_m = 1.0, mass_kg = 1.0}], solid = {shape = 'sphere', radius_m = 1.0}}",
            "give one of solid, solids",
        ),
        ("body.solids = []", "body.solids: has 0 entries, needs at least 1"),
        ("body.solids = {shape = 'sphere', radius_m = 1.0}", "write [[body.solids]]"),
        (
            "body.solids = [{shape = 'sphere', radius_m = 1.0, mass_kg = 1.0, axis = [0.0, 0, 0]}]",
            "axis is zero",
        ),
        (
            "body.solids = [{shape = 'cuboid', lengths_m = [1.0, 1.0, 1.0], mass_kg = 1.0, axis = [0.0, 0, 1]}]",
            "a cuboid may be rotated about its axis: give euler_angles_deg",
        ),
        (
            "body.solids = [{shape = 'cuboid', lengths_m = [1.0, 1.0, 1.0], mass_kg = 1.0, axis = [0.0, 0, 1], euler_angles_deg = [0.0, 1, 0]}]",
            "give axis or euler",
        ),
        (
            "body.solids = [{shape = 'disk', radius_m = 1.0, density_kg_m3 = 1.0}]",
            "a disk has no volume: give mass_kg",
        ),
        (
            "body.solids = [{shape = 'cylinder', radius_m = 1.0, mass_kg = 1.0}]",
            "a cylinder has height_m and radius_m, not",
        ),
        (
            "body.solids = [{shape = 'sphere', radius_m = 1e-90, density_kg_m3 = 1.0}]",
            "its mass is 4.18879e-270 kg",
        ),
        (
            "body.solids = [{shape = 'sphere', radius_m = 1.0, mass_kg = 1.0}]\nfluid.density_kg_m3 = 1.0\ngravity = {}",
            "needs a body.solid",
        ),
        (
            "body.solids = [{shape = 'sphere', radius_m = 1.0, mass_kg = 1.0, density = 1.0}]",
            "did you mean density_kg_m3?",
        ),
        ("body = {mass_kg = 1.0, centre_of_mass_m = [0.0, 0, 1]}", "This one is not pinned"),
        ("body = {mass_kg = 1.0, pinned = true}", "cannot move"),
        ("start.rotation = [[1.0, 0.01, 0], [0, 1, 0], [0, 0, 1]]", "|Q^T Q - 1| is 0.01"),
        ("start.rotation = [[1.0, 0, 0], [0, 1, 0], [0, 0, -1.0]]", "a reflection"),
        (
            "start = {rotation = [[1.0, 0, 0], [0, 1, 0], [0, 0, -1.0]], project = true}",
            "is not a rotation with rounded digits",
        ),
        ("start.quaternion_wxyz = [0.0, 0, 0, 0]", "quaternion_wxyz is zero"),
        (
            "start = {euler_angles_deg = [0.0, 0, 0], euler_rates_rad_s = [1.0, 0, 0]}",
            "euler_rates_rad_s with theta = 0",
        ),
        (
            "start = {euler_angles_deg = [0.0, 180, 0], euler_rates_rad_s = [1.0, 0, 0]}",
            "with theta = 180",
        ),
        ("start.euler_rates_rad_s = [1.0, 0, 0]", "needs euler_angles_deg"),
        (
            "start = {euler_angles_deg = [0.0, 1, 0], quaternion_wxyz = [1.0, 0, 0, 0]}",
            "give one of euler_angles_deg, quat",
        ),
        (
            "body = {mass_kg = 1.0, inertia_kg_m2 = [1.0, 1.0, 0.5], pinned = true, centre_of_mass_m = [0.0, 0.0, 1.0]}\nstart.position_m = [0.0, 0, 1]",
            "start.position_m: the body is pinned",
        ),
        (
            "body = {mass_kg = 1.0, inertia_kg_m2 = [1.0, 1.0, 0.5], pinned = true, centre_of_mass_m = [0.0, 0.0, 1.0]}\nfluid.added_mass_kg = [1.0, 1, 1]",
            "no such force acts",
        ),
        ("body.mass_kg = 1.0\nstart.euler_angles_deg = [0.0, 1, 0]", "a point does not rotate"),
        ("body.mass_kg = 1.0\napplied = [{torque_N_m = [0.0, 1, 0]}]", "a torque cannot rotate it"),
        ("friction.viscous_N_m_s = [1.0, -1, 0]", "must not be less than 0"),
        ("fluid.linear_resistance_kg_s = [1.0, -1, 0]", "must not be less than 0"),
        (
            "fluid.density_kg_m3 = 1000.0\ngravity = {}",
            "needs a body.solid that is a sphere or an ellipsoid",
        ),
        ("fluid.displaced_mass_kg = 1.0", "buoyancy needs [gravity]"),
        (
            "applied = [{force_N = [[1.0, 0, 0], [2.0, 0, 0]], times_s = [1.0, 1.0]}]",
            "must increase: entry 1 is 1 after 1",
        ),
        ("applied = [{force_N = [[1.0, 0, 0]], times_s = [0.0, 1.0]}]", "has 1 values for 2 times"),
        ("applied = [{force_N = [[1.0, 0, 0], [1.0, 0, 0]]}]", "times_s is missing"),
        (
            "applied = [{force_N = [1.0, 0, 0], from_s = 2.0, to_s = 1.0}]",
            "to_s = 1 is not after from_s = 2",
        ),
        ("applied = [{}]", "needs force_N or torque_N_m"),
        ("frame = {}", "needs angular_velocity_rad_s"),
        ("frame.angular_velocity_rad_s = [1.0, 0, 0]\nfluid = {}", "are not supported"),
        ("wheels = [{axis = [0.0, 0, 0]}]", "axis is zero"),
        (
            "wheels = [{axis = [0.0, 0, 1], to_s = 1.0}]",
            "would have no effect without motor_torque_N_m",
        ),
        (
            "changing_inertia = {times_s = [0.0, 1.0], inertia_kg_m2 = [[1.0, 1, 1], [1.0, 1, 3]]}",
            "triangle inequality",
        ),
        ("run.formulation = 'quaternion'", "formulation would have no effect with velocity_verlet"),
        ("run.integrator = 'rk5'", "did you mean rk4?"),
        ("run.relative_tolerance = 1e-08", "would have no effect with velocity_verlet"),
        ("run.timestep_s = 3.0", "less than one step"),
        ("output.interval_s = 3.0", "longer than run.duration_s"),
        ("output.axis = [0.0, 0, 0]", "axis is zero"),
        ("gravity.accelaration_m_s2 = [0.0, 0, 1]", "did you mean acceleration_m_s2?"),
        ("stages = []", "unknown key"),
        ("body.mass_kg = 1.0\nfluid.added_mass_kg = [1.0, 1, 1]", "a point carries no fluid along"),
        ("body.mass_kg = 1.0\nfluid.linear_resistance_kg_s = [1.0, 1, 2]", "a point has no axes"),
        (
            "body.mass_kg = 1.0\nfriction.viscous_N_m_s = [1.0, 1, 1]",
            "friction: the body has no inertia",
        ),
        (
            "body.points = [{mass_kg = 1.0, position_m = [0.0, 0, 0]}]\nstart.euler_angles_deg = [0.0, 1, 0]",
            "a point does not rotate",
        ),
        (
            "body = {mass_kg = 1.0, solid = {shape = 'rod', length_m = 1.0}}\nfluid.added_mass_kg = [1.0, 2, 3]",
            "equal added masses across its axis",
        ),
        (
            "body = {mass_kg = 1.0, inertia_kg_m2 = [1.0, 1.0, 0.5], pinned = true}\ngravity = {}",
            "gravity has no effect on a body pinned at its centre",
        ),
        (
            "body = {mass_kg = 1.0, inertia_kg_m2 = [1.0, 1.0, 0.5], pinned = true, centre_of_mass_m = [0.0, 0.0, 1.0]}\napplied = [{force_N = [1.0, 0, 0]}]",
            "has no effect at the pivot",
        ),
        (
            "body = {mass_kg = 1.0, pinned = true, centre_of_mass_m = [0.0, 0, 1]}\nchanging_inertia = {times_s = [0.0, 1.0], inertia_kg_m2 = [[1.0, 1, 1], [2.0, 2, 2]]}",
            "must be at the pivot",
        ),
        ("body = {mass_kg = 1.0, pinned = true, inertia_about = 'pivot'}", "no inertia is given"),
        (
            "friction.dry_N_m = [0.1, 0, 0]\nrun.integrator = 'dop853'",
            "dry friction is discontinuous",
        ),
        (
            "friction.viscous_N_m_s = [0.1, 0, 0]\nrun.integrator = 'kahan_li_6'",
            "negative substeps",
        ),
        (
            "start.angular_velocity_body_rad_s = [1e+200, 0, 0]",
            "must be 0 or between 1e-100 and 1e100",
        ),
        (
            "start.euler_angles_deg = [0.0, 20.0]",
            "start.euler_angles_deg: has 2 entries, needs more",
        ),
        ("wheels.axis = [0.0, 0, 1]", "write [[wheels]]"),
        ("body.fixed_point = true", "In rigidmd this is pinned in [body]"),
        ("wheels = [{inertia_kg_m2 = 1.0}]", "In rigidmd this is momentum_kg_m2_s in [[wheels]]"),
        (
            "start.angular_velocity_rad_s = [0.0, 0, 1]",
            "did you mean angular_velocity_body_rad_s or angular_velocity_lab_rad_s?",
        ),
        (
            "body = {mass_kg = 1.0, inertia_tensor_kg_m2 = [[2.0, 0.1, 0], [0.1, 2.5, 0.2], [0, 0.2, 3.0]]}\nfriction.dry_N_m = [0.3, 0.3, 0.3]",
            "which are not principal axes of its inertia",
        ),
        (
            "body = {mass_kg = 1.0, solid = {shape = 'rod', length_m = 1.0}}\nstart.angular_velocity_body_rad_s = [0.0, 0, 1]",
            "rotates about an axis without inertia",
        ),
        (
            "body = {mass_kg = 1.0, solid = {shape = 'rod', length_m = 1.0}}\napplied = [{axes = 'body', torque_N_m = [0.0, 0, 1]}]",
            "nothing resists a torque about the axis",
        ),
        (
            "body = {mass_kg = 1.0, inertia_tensor_kg_m2 = [[2.0, 0.1, 0], [0.1, 2.5, 0.2], [0, 0.2, 3.0]]}\nfriction.viscous_N_m_s = [1.0, 0, 0]",
            "which are not principal axes of its inertia",
        ),
    ],
)
def test_each_error_has_its_message(text, message):
    """Tables of a scene, as TOML; those of `run` are added to its two numbers."""
    tables = tomllib.loads(text)
    if "run" in tables:
        tables["run"] = RUN | tables["run"]
    assert message in faults(**tables)


def test_all_errors_come_at_once_with_their_lines(tmp_path, printed):
    path = tmp_path / "bad.toml"
    path.write_text(
        "[body]\nmass_kg = 1\ninertia_kg_m2 = [1, 2, 4]\npinned = true\n\n"
        "[start]\nposition_m = [0, 0, 1]\nrotation = [[1, 0, 0], [0, 2, 0], [0, 0, 1]]\n\n"
        "[friction]\nviscous_N_m_s = [1, -1, 0]\n\n"
        "[[applied]]\ntimes_s = [0, 2, 1]\nforce_N = [[1, 0, 0], [0, 0, 0], [0, 0, 0]]\n\n"
        "[run]\nduration_s = 1\ntimestep_s = 0.01\nintegrater = 'rk4'\n"
    )
    said = printed("run", path, "-o", tmp_path / "out", code=2).err
    for part in (
        "6 errors",
        "line 1: body: no body has this inertia",
        "line 7: start.position_m: the body is pinned",
        "line 6: start: the matrix is not a rotation",
        "line 11: friction.viscous_N_m_s.1: is -1, must not be less than 0",
        "line 14: applied.0.times_s: must increase: entry 2 is 1 after 2",
        "line 20: run.integrater: unknown key; did you mean integrator?",
    ):
        assert part in said, part
    assert not (tmp_path / "out").exists()


def test_all_errors_of_solids_come_at_once_with_their_lines(tmp_path, printed):
    path = tmp_path / "bad.toml"
    path.write_text(
        "[[body.solids]]\nshape = 'ring'\nradius_m = 1\ndensity_kg_m3 = 2\naxis = [0, 0, 0]\n\n"
        "[[body.solids]]\nshape = 'sphere'\nradius_m = -1\nmass_kg = 2\n\n"
        "[run]\nduration_s = 1\ntimestep_s = 0.01\n"
    )
    said = printed("check", path, code=2).err
    for part in (
        "line 1: body.solids.0: a ring has no volume: give mass_kg instead of density_kg_m3; axis is zero",
        "line 9: body.solids.1.radius_m: is -1, must be greater than 0",
    ):
        assert part in said, part


def test_the_energy_of_a_body_is_in_joule(printed):
    scene = str(ROOT / "systems" / "fast_heavy_top.toml")
    assert "The energy of a body is in J" in printed("energy", scene, "--unit", "K", code=2).err
    assert "5435.696790865" in printed("energy", scene).out


def test_what_is_not_a_scene_of_either_kind_is_reported(tmp_path, printed):
    path = tmp_path / "what.toml"
    path.write_text("name = 'x'\n")
    assert (
        "has neither [body], for a single body, nor [[molecules]]"
        in printed("check", path, code=2).err
    )
    path.write_text("[gravity]\n[run]\nduration_s = 1\ntimestep_s = 0.1\n")
    assert "body: is missing" in printed("check", path, code=2).err


def test_an_override_is_blamed_by_its_key_and_threads_are_for_molecules(printed):
    scene = str(ROOT / "systems" / "heavy_top_1.toml")
    assert (
        "--set run.integrator: is 'verlet', must be"
        in printed("check", scene, "--set", "run.integrator=verlet", code=2).err
    )
    assert "--threads is for molecules" in printed("run", scene, "--threads", "2", code=2).err


def test_bodies_of_points_that_are_symmetric_to_rounding_have_their_own_axes():
    corners = [[1.0, 0.0, 0.0], [-0.5, 3**0.5 / 2, 0.0], [-0.5, -(3**0.5) / 2, 0.0]]
    triangle = {"points": [{"mass_kg": 1.0, "position_m": corner} for corner in corners]}
    system = build_body(
        Scene.from_dict(
            {"body": triangle, "friction": {"viscous_N_m_s": [1.0, 1.0, 0.5]}, "run": RUN}
        )
    )
    assert (system.axes == [[1, 0, 0], [0, 1, 0], [0, 0, 1]]).all()
    assert system.inertia[0] == system.inertia[1]
    pendulum = {
        "mass_kg": 0.3,
        "pinned": True,
        "inertia_about": "pivot",
        "centre_of_mass_m": [0.0, 0.0, 0.7],
        "inertia_kg_m2": [0.3 * 0.7 * 0.7, 0.3 * 0.7 * 0.7, 0.0],
    }
    assert build_body(Scene.from_dict({"body": pendulum, "run": RUN})).kind == "linear"
