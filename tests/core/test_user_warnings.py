"""Warnings to users, `core/user_warnings.py`: names of the version before work with a warning that
names the new one."""

from types import SimpleNamespace

import numpy as np
import pytest
from support.common import small_scene

import rigidmd
from rigidmd import FORMER_NAMES, Scene, Simulation
from rigidmd.errors import RigidMDWarning, SceneError
from rigidmd.run.observers import as_observer

STAGES = [{"ensemble": "minimise", "most_iterations": 3}, {"duration_ps": 0.02}]


def scene(**tables):
    return small_scene({"argon": 8}, 20.0, **tables)


@pytest.mark.parametrize(("old", "new"), FORMER_NAMES.items())
def test_a_function_has_its_former_name_for_one_version(old, new):
    with pytest.warns(DeprecationWarning, match=f"rigidmd.{old} is rigidmd.{new} now") as caught:
        assert getattr(rigidmd, old) is getattr(rigidmd, new)
    assert caught[0].filename == __file__  # the line of the user
    assert new in dir(rigidmd) and old not in dir(rigidmd)


def test_a_key_has_its_former_name_for_one_version():
    with pytest.warns(RigidMDWarning, match="the key most_iterations is max_iterations now"):
        assert scene(stages=STAGES).stages[0].max_iterations == 3
    with pytest.raises(SceneError, match=r"stages.0.most_iterations: unknown key"):
        scene(stages=[STAGES[0] | {"max_iterations": 4}])
    with pytest.raises(SceneError, match="most_iterations: unknown key"):
        scene(run={"most_iterations": 3})


def test_observers_with_the_former_method_are_called():
    seen = []

    class Plain:
        interval = 0.01

        def see(self, moment):
            seen.append(moment.step)

    class Derived(rigidmd.Every):
        def see(self, moment):
            seen.append("before")
            super().see(moment)

    class Both:
        interval = 0.01

        def observe(self, moment):
            pass

        def see(self, moment):
            raise AssertionError

    assert as_observer(SimpleNamespace(interval=0.01, observe=print)).interval == 0.01
    assert as_observer(Both()).interval == 0.01
    observers = [Plain(), Derived(0.01, lambda moment: seen.append(moment.step))]
    with (
        pytest.warns(DeprecationWarning, match="Plain.see is observe now"),
        pytest.warns(DeprecationWarning, match="Derived.see is observe now"),
    ):
        Simulation(scene(stages=STAGES[1:]), observers=observers).run()
    steps = seen[::3]
    assert len(steps) == 3
    assert seen == [entry for step in steps for entry in (step, "before", step)]


@pytest.mark.parametrize("depends", [True, False])
def test_a_force_with_the_former_attribute_keeps_its_meaning(depends):
    class Spring(rigidmd.Force):
        tied_to_places = depends
        changes_momentum = False

        def on_molecules(self, state):
            zero = np.zeros((len(state.velocity), 3))
            return 0.0, zero, zero, np.zeros((3, 3))

    with pytest.warns(DeprecationWarning, match="Spring.tied_to_places is absolute_positions now"):
        system = Simulation(scene(stages=STAGES[1:]), forces=Spring()).system
    assert system.position_dependent == ["spring"] * depends


def test_columns_have_their_former_names_for_one_version(tmp_path):
    simulation = Simulation(scene(stages=STAGES[1:]), tmp_path / "run")
    results = simulation.run()
    observation = simulation.observation
    with pytest.warns(DeprecationWarning, match="pressure_bar is pressure now"):
        assert (results["pressure_bar"] == results["pressure"]).all()
    with pytest.warns(DeprecationWarning, match="pressure_bar is pressure now"):
        assert observation.pressure_bar == observation.pressure
    with pytest.warns(DeprecationWarning, match="pressure_tensor_bar is pressure_tensor now"):
        assert (observation.pressure_tensor_bar == observation.pressure_tensor).all()
    with pytest.warns(DeprecationWarning, match="pressure_bar is pressure now"):
        assert rigidmd.view.plot(results, "pressure_bar")
    log = tmp_path / "run" / "log.csv"
    text = log.read_text()
    assert '"Total Energy (kJ/mol)"' in text and '"Density (g/cm^3)"' in text
    log.write_text(text.replace("(kJ/mol", "(kJ/mole").replace("g/cm^3", "g/mL"))
    read = rigidmd.read_run(tmp_path / "run")  # a log of an earlier version
    for name in ("energy", "drift", "density", "torque_squares"):
        assert (read[name] == results[name]).all()


def test_new_names_warn_of_nothing():
    Simulation(scene(stages=[{"ensemble": "minimise", "max_iterations": 3}]))
    assert Scene.read("systems/water.toml")
