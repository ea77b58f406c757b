"""Torques about an axis without inertia, and energies that are not real, are refused."""

import numpy as np
import pytest
from support.body_pairs import ROD, body, line, scene, written_table
from support.common import site

import rigidmd
from rigidmd import Scene, Simulation
from rigidmd.assemble.build import build
from rigidmd.errors import SceneError
from rigidmd.features.free_energy.guest import Guest
from rigidmd.features.free_energy.virial import second_virial
from rigidmd.scene.models import read_molecule


def test_bodies_that_do_not_rotate_have_no_such_potential():
    tables = {"energy": "1/r**12", "name": "wall"}
    with pytest.raises(SceneError, match="no body of the scene rotates"):
        build(scene(tables, molecules=[{"model": "argon", "count": 10}]))


DISK = body("disc", 6)
DOT = {"name": "dot", "count": 6, "sites": [site("A", 20.0)]}
SHIPPED = {
    "gay_berne": ROD,
    "dipole": {"dipole_D": 2.0},
    "quadrupole": {"quadrupole_D_A": 3.0},
    "patch": {"sigma_A": 4.0, "epsilon_kJ_mol": 2.0, "width": 0.3},
}


def errors_of(molecules, tables=None, forces=(), folder=".") -> str:
    """The errors of a scene of molecules, empty without one."""
    data = {
        "box": {"lengths_A": 40.0},
        "molecules": molecules,
        "threads": 1,
        "start": {"temperature_K": 200.0},
        "forces": {"cutoff_A": 12.0, "bodies": [tables] if tables else []},
        "stages": [{"duration_ps": 0.05, "timestep_fs": 5.0}],
    }
    try:
        build(Scene.from_dict(data, folder).with_user_code(forces))
    except SceneError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("potential", SHIPPED)
def test_torques_that_nothing_resists_are_refused(potential):
    """On points, and about the line of linear bodies, whatever the other body is; not on frozen
    bodies, and not about a line that is the axis of the potential."""

    def error(*molecules, **more) -> str:
        parameters = {m["name"]: SHIPPED[potential] for m in molecules}
        return errors_of(list(molecules), {"potential": potential, "parameters": parameters} | more)

    for other in (DISK, line("along")):
        assert "dot is a point: nothing resists" in error(DOT, other)
        assert "dot is a point: nothing resists" in error(other, DOT | {"count": 1})
        assert not error(DOT | {"frozen": True}, other)
        assert "across is linear: nothing resists the torque" in error(line("across"), other)
        assert "Use axis = 'x'" in error(other, line("across"))
        assert "must lie along z" in error(other, line("oblique"))
    assert not error(line("across"), DISK, axis="x")
    assert not error(DISK)
    for reference, message in (((0.0, 0.0, 0.4), ""), ((0.3, 0.0, 0.4), "must be on the line")):
        found = error(line("along"), DISK, references={"along": reference})
        assert message in found if message else not found


def test_torques_of_functions_texts_and_tables_that_nothing_resists_are_refused(tmp_path):
    written_table(tmp_path / "pair.npz", points=(20, 13, 13, 13))
    flat = np.exp(-np.linspace(4, 12, 20))[:, None, None, None] * np.ones((1, 13, 13, 13))
    written_table(tmp_path / "flat.npz", points=(20, 13, 13, 13), energy_kJ_mol=flat)
    one_line = [line("across"), DISK]
    for table, message in (("pair.npz", "Use axis = 'x'"), ("flat.npz", "")):
        found = errors_of(one_line, {"table": table}, folder=tmp_path)
        assert message in found if message else not found
    for energy, message in (("1/r**12", ""), ("(1 + 1e-6*a_r*b_r)/r**12", "across is linear")):
        found = errors_of(one_line, {"energy": energy})
        assert message in found if message else not found

    def of_matrices(r, a, b):  # even about x only
        return ((a[:, 0] @ r) * (b[:, 0] @ r) + 0.1 * (a[:, 0] @ b[:, 0])) / (r @ r) ** 4

    def of_others(r, a, b):
        return (a[:, 1] @ r) * (b[:, 1] @ r) / (r @ r) ** 4

    def given(r, a, b):
        return 1 / (r @ r), 2 * r / (r @ r) ** 2, 1e-3 * a[:, 0], 1e-3 * b[:, 0]

    for function, molecule, message in (
        (of_matrices, line("across"), ""),
        (of_matrices, line("along"), "line of its masses must not change the energy"),
        (of_others, line("across"), "line of its masses must not change the energy"),
        (given, DOT, "dot is a point"),
    ):
        potential = rigidmd.body_pair_potential(function)
        found = errors_of([molecule, DISK], forces=[potential])
        assert message in found if message else not found
        assert not errors_of([molecule | {"frozen": True}, DISK], forces=[potential])


@pytest.mark.parametrize(
    ("energy", "is_finite"),
    [
        ("log(-r)", False),
        ("(5/r)**12*sqrt(7-r)", False),
        ("(r-10)**0.5", False),  # the distance in the lattice: an infinite force
        ("sqrt(a_r)/r**6", False),
        ("exp(900-r)", False),
        ("sqrt(1+a_r)/r**6", True),
        ("(5/r)**12", True),
        ("sqrt(r-9)/r**6", True),
    ],
)
def test_energies_that_are_not_real_where_bodies_start_are_refused(energy, is_finite):
    """60 rods in a lattice of 10 Å."""
    found = errors_of([body("rod", 60)], {"name": "x", "energy": energy})
    message = "x: its energy or force is not a finite number between rod and rod"
    assert message in found if not is_finite else not found
    assert not errors_of([body("rod", 2)], {"name": "x", "energy": "(r-10)**0.5"})


def test_energies_of_sites_that_are_not_real_where_they_start_are_refused():
    for energy, is_finite in (("(r-3)**0.5", True), ("(r-8.05)**0.5", False), ("log(r-6)", False)):
        tables = {
            "box": {"lengths_A": 24.0},
            "molecules": [DOT | {"count": 300}],
            "forces": {"cutoff_A": 9.0, "custom": [{"name": "x", "energy": energy}]},
            "start": {"temperature_K": 200.0},
            "stages": [{"duration_ps": 0.05, "timestep_fs": 5.0}],
        }
        dots = Scene.from_dict(tables)
        if is_finite:
            build(dots)
            continue
        with pytest.raises(SceneError, match=r"not a finite number between dot\.A and dot\.A"):
            build(dots)


def test_trial_molecules_without_inertia_are_refused_too(tmp_path):
    (tmp_path / "dot.toml").write_text(
        'name = "dot"\n[[sites]]\nname = "A"\nmass_u = 20\nposition_A = [0, 0, 0]\n'
    )
    aligning = {"energy": "exp(-r)*a_b**2"}
    settings = {"forces.bodies": [aligning]}
    with pytest.raises(SceneError, match="dot is a point: nothing resists"):
        second_virial(str(tmp_path / "dot.toml"), "nitrogen", temperatures=[300], settings=settings)
    host = build(scene(aligning | {"cutoff_A": 12.0}, {"rod": 4}))
    with pytest.raises(SceneError, match="dot is a point: nothing resists"):
        Guest(host, read_molecule(tmp_path / "dot.toml"), 300.0)


class Twist(rigidmd.Force):
    """A torque about one axis of each body that does no work, as nothing rotates about it."""

    absolute_positions = False

    def __init__(self, axis):
        self.axis = axis

    def on_molecules(self, state):
        nothing = np.zeros_like(state.position)
        return 0.0, nothing, nothing + np.eye(3)[self.axis], np.zeros((3, 3))


def test_a_force_of_python_with_a_torque_about_an_axis_without_inertia_is_refused():
    """The axis of a linear body is its first principal one."""
    run = Simulation(scene(None, {"rod": 8}), forces=[Twist(0)], warn=str)
    with pytest.raises(
        SceneError, match=r"resists its torque of 1 kJ/mol .*\(rod\), about its axis"
    ):
        run.run()
