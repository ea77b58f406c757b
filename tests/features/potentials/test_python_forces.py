"""Forces in Python: on sites and molecules, their errors, what they exclude."""

import math
from typing import NamedTuple

import numpy as np
import pytest
from scipy.integrate import quad
from support.common import ROOT, small_scene
from support.potentials import Spring, points
from support.scenes import GOOD

import rigidmd
from rigidmd.assemble.build import build
from rigidmd.commands.cli import main
from rigidmd.errors import SceneError, SimulationError
from rigidmd.features.potentials.user_code.force_checks import check_forces

# --- forces in Python -----------------------------------------------------------------------------


class Field(rigidmd.Force):
    """A field along z, on sites."""

    changes_momentum = (False, False, False)
    absolute_positions = False

    def begin(self, system):
        self.charge = system.of_sites(lambda molecule: molecule.charges)

    def on_sites(self, position, state):
        force = self.charge[:, None] * [0, 0, 9.64853321233]
        return -(force * position).sum(), force


def test_a_field_on_sites_is_the_built_in_one():
    forces = {"electrostatics": "none"}
    own = build(
        small_scene({"spce": 20, "argon": 3}, 20.0, forces=forces).with_user_code([Field()])
    )
    theirs = build(
        small_scene(
            {"spce": 20, "argon": 3}, 20.0, forces=forces, fields={"electric_V_per_nm": [0, 0, 1]}
        )
    )
    load, tallies = own.engine_of({"field": own.terms["field"]}, "double").evaluate(own.state)
    expected, told = theirs.engine_of({"e": theirs.terms["electric_field"]}, "double").evaluate(
        own.state
    )
    assert tallies["field"].energy == pytest.approx(told["e"].energy, rel=1e-9)
    assert load.force == pytest.approx(expected.force, abs=1e-9)
    assert load.torque_body == pytest.approx(expected.torque_body, rel=1e-9, abs=1e-6)
    assert own.model.keeps_momentum.all()


def test_a_force_in_python_conserves_energy_and_is_in_the_log(tmp_path):
    results = rigidmd.Simulation(points(), tmp_path / "run", forces=[Spring()]).run()
    assert results["spring"] == pytest.approx(results["potential"])
    assert abs(results["drift"]).max() < 1e-4 * results["kinetic"][0]
    assert results.system.freedom.translation == 300  # the momentum is not conserved
    header = (tmp_path / "run" / "log.csv").read_text().splitlines()[0]
    assert header.endswith('"spring (kJ/mol)"')
    assert results.units["spring"] == "kJ/mol"
    assert results.summary["user_forces"] == {"spring": "Spring, computed by Python"}


def test_a_run_with_forces_from_python_is_repeated_by_python_only(tmp_path, capsys):
    folder = tmp_path / "run"
    whole = rigidmd.Simulation(points(), tmp_path / "whole", forces=[Spring()]).run()
    short = points(stages=[{"duration_ps": 0.02, "timestep_fs": 4}])
    rigidmd.Simulation(short, folder, forces=[Spring()]).run()
    assert main(["resume", str(folder), "--until", "0.04ps"]) == 2
    assert "from_python: this run had spring from Python" in capsys.readouterr().err
    scene = rigidmd.Scene.read(folder / "scene.toml")
    with pytest.raises(SceneError, match="This has field"):
        rigidmd.Simulation(scene, forces=[Field()])
    results = rigidmd.Simulation(scene.with_end(0.04), folder, forces=[Spring()], resume=True).run()
    assert np.array_equal(results.state.position, whole.state.position)
    assert np.array_equal(results["spring"], whole["spring"])
    assert main(["report", str(folder)]) == 0  # what has ended can be observed without the code


class Faulty(rigidmd.Force):
    """Goes wrong in the way that it is given, once some molecule has moved."""

    def __init__(self, way):
        self.way, self.seen = way, None

    def on_molecules(self, state):
        energy, force = 0.5 * (state.position**2).sum(), -state.position
        self.seen = state.position.copy() if self.seen is None else self.seen
        if self.way == "raises":
            raise KeyError("charge")
        if self.way == "shape":
            return energy, force[0]
        if self.way == "energy":
            return "much", force
        if self.way == "text":
            return "5", force
        if self.way == "complex":
            return energy + 1e-3j, force
        if self.way == "text of forces":
            return energy, force.astype(str)
        if self.way == "objects":
            return energy, force.astype(object).astype(str).astype(object)
        if self.way == "virial":
            return energy, force, None, [1.0, 2.0]
        if self.way == "tuple":
            return force
        if state.step[0] > 3:
            force[6, 1] = np.nan
        return energy, force


@pytest.mark.parametrize(
    "way, word",
    [
        (
            "raises",
            r"on_molecules of the force faulty raised KeyError: 'charge', line \d+ of .*test_python_forces.py",
        ),
        ("shape", r"the force faulty returned forces of the shape \(3,\), not \(100, 3\)"),
        ("energy", "returned 'much' as its energy"),
        ("text", "returned '5' as its energy, not a real number"),
        ("complex", r"returned .*0\.001j\) as its energy, not a real number"),
        ("text of forces", "as forces, not real numbers"),
        ("objects", "as forces, not real numbers"),
        ("tuple", "returned ndarray. It must return a tuple"),
        ("virial", r"returned \[1.0, 2.0\] as its virial"),
        (
            "nan",
            r"stopped at step \d \(.* ps\): the force faulty returned .*nan.* on molecule 7 \(dot\)",
        ),
    ],
)
def test_a_faulty_force_is_reported_with_its_molecule_and_step(way, word):
    with pytest.raises(SimulationError if way == "nan" else SceneError, match=word):
        rigidmd.Simulation(points(), forces=[Faulty(way)]).run()


class Neither(rigidmd.Force):
    pass


class Wrong(rigidmd.Force):
    def on_molecules(self, state):
        return 0.5 * (state.position**2).sum(), +state.position


class Turned(rigidmd.Force):
    def on_molecules(self, state):
        return 0.0, np.zeros_like(state.position), np.ones_like(state.position)


class Unstretched(Spring):
    absolute_positions = False


class Sheared(rigidmd.Force):
    absolute_positions = False

    def on_molecules(self, state):
        return 0.0, np.zeros_like(state.position), None, np.diag([500.0, -500.0, 0.0])


class InPlace(rigidmd.Force):
    def on_sites(self, position, state):
        position %= 20.0
        return 0.0, np.zeros(position.shape)


class Leaving(rigidmd.Force):
    def on_molecules(self, state):
        raise SystemExit(0)


class Halfway(Spring):
    changes_momentum = (True, False)  # type: ignore[assignment]


@pytest.mark.parametrize(
    "force, word",
    [
        (
            Wrong(),
            r"wrong: the force on molecule \d+ \(spce\) is not the derivative of the energy.* falls by -",
        ),
        (Turned(), "turned: the torque on molecule"),
        (
            Unstretched(),
            "spring: the component xx of its molecular virial is 0 kJ/mol.*absolute_positions = True",
        ),
        (Sheared(), "the component xx of its molecular virial is 500"),
        (InPlace(), "read-only"),
        (Leaving(), "SystemExit: 0"),
        (Halfway(), "must be three truth values"),
        (Neither(), "must define one of on_sites and on_molecules"),
        (lambda state: 0.0, "is not a force"),
    ],
)
def test_a_force_that_is_not_what_its_energy_states_stops_the_run_with_the_numbers(force, word):
    scene = small_scene({"spce": 8}, 20.0, forces={"electrostatics": "none"})
    with pytest.raises((SceneError, SimulationError), match=word):
        system = build(scene.with_user_code([force]))
        check_forces(system, system.state)


def test_forces_from_python_exclude_what_they_cannot_go_with():
    stage = {"ensemble": "npt", "temperature_K": 94, "pressure_bar": 1, "duration_ps": 1}
    with pytest.raises(
        SceneError, match="spring depend on absolute positions in it: keep the volume"
    ):
        rigidmd.Simulation(points(stages=[stage]), forces=[Spring()])
    top = rigidmd.Scene.read(ROOT / "systems" / "heavy_top_3.toml")
    with pytest.raises(SceneError, match=r"forces: for molecules. A single body takes applied"):
        rigidmd.Simulation(top, forces=[Spring()])
    with pytest.raises(SceneError, match="energy is a column of the log"):
        rigidmd.Simulation(points(), forces=[rigidmd.pair_potential("1/r**9", name="energy")])
    with pytest.raises(SceneError, match="thermostat: 3 is neither"):
        rigidmd.Simulation(points(), thermostat=3)


# --- code in files --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "entry, word",
    [
        ({"name": "x"}, "give a module"),
        ({"name": "x", "module": "m.py", "energy": "1/r"}, "give a module"),
        (
            {"name": "x", "module": "m.py", "sites": ["A"]},
            "sites would have no effect with a module",
        ),
        ({"name": "x", "module": "m.txt"}, "must be a Python file"),
        ({"name": "x", "module": "../m.py"}, "outside the scene's folder"),
        ({"name": "x y", "energy": "1/r"}, "name"),
    ],
)
def test_entries_of_custom_forces_are_checked(entry, word):
    with pytest.raises(SceneError, match=word):
        points(forces={"custom": [entry]})


# --- thermostats ----------------------------------------------------------------------------------


def test_an_index_beyond_an_array_in_a_compiled_force_names_its_line():
    class Pull(NamedTuple):
        strength: np.ndarray

    @rigidmd.compiled_force(Pull)
    def pull(term, state, load, tally):
        for m in range(len(state.position)):
            load.force[m, 0] += term.strength[m]

    with pytest.raises(
        SceneError,
        match=r"pull \(line \d+ of test_python_forces.py: `load.force.*`\) has an index beyond",
    ):
        rigidmd.Simulation(points(), forces=[Pull(np.ones(3))]).run()


# --- examples -------------------------------------------------------------------------------------


@pytest.mark.soak
def test_langevin_function_of_dipoles_in_a_field_in_python():
    """Free dipoles in a field: the mean of cos is coth x - 1/x with x = mu E/kT."""
    scene = rigidmd.Scene.from_dict(
        {
            "box": {"lengths_A": 60},
            "molecules": [{"model": "spce", "count": 200}],
            "forces": {"electrostatics": "none", "lennard_jones": False},
            "start": {"temperature_K": 300},
            "stages": [
                {
                    "ensemble": "nvt",
                    "temperature_K": 300,
                    "duration_ps": 100,
                    "thermostat": "langevin",
                }
            ],
        }
    )
    results = rigidmd.Simulation(scene, forces=[Field()]).run()
    energy = results["field"][len(results["field"]) // 10 :]
    mu = results.system.species[0].dipole_debye * 0.20819434 * 9.64853321233
    thermal = 8.31446261815324e-3 * 300
    weight = quad(lambda c: math.exp(mu * c / thermal), -1, 1)[0]
    mean = quad(lambda c: c * math.exp(mu * c / thermal), -1, 1)[0] / weight
    assert energy.mean() / 200 == pytest.approx(-mu * mean, rel=0.01)


# --- what is lost at a cutoff, and tables that state too little -------------------------------------


@pytest.mark.parametrize("name", ["energy", "time", "tail", "load", "box", "trajectory"])
def test_names_that_a_force_cannot_have_are_refused_by_check(name, tmp_path, capsys):
    entry = f'[[forces.custom]]\nname = "{name}"\nenergy = "1/r**9"\nsites = ["OW"]\n'
    (tmp_path / "s.toml").write_text(f"{GOOD}\n{entry}")
    assert main(["check", str(tmp_path / "s.toml")]) == 2
    assert f"{name} is " in capsys.readouterr().err
