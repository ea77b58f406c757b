"""A scene is resolved once: every number that a run uses is in the scene that it writes."""

import pytest
from support.common import argon, same_bits, small_scene

import rigidmd
from rigidmd.assemble.build import build
from rigidmd.errors import SceneError
from rigidmd.run import Simulation
from rigidmd.run.kind import describe
from rigidmd.scene import MolecularScene, Scene


def test_when_total_momentum_is_taken_out():
    pme = {"electrostatics": "pme", "cutoff_A": 9.0}
    frozen = [{"model": "spce", "count": 2}, {"model": "argon", "count": 2, "frozen": True}]
    assert rigidmd.with_defaults(argon()).run.remove_momentum_interval_ps is False
    assert rigidmd.with_defaults(argon(forces=pme)).run.remove_momentum_interval_ps == 1.0
    assert (
        rigidmd.with_defaults(
            argon(forces=pme | {"electrostatics": "ewald"})
        ).run.remove_momentum_interval_ps
        is False
    )
    assert (
        rigidmd.with_defaults(
            argon(forces=pme, run={"remove_momentum_interval_ps": False})
        ).run.remove_momentum_interval_ps
        is False
    )
    assert (
        rigidmd.with_defaults(
            small_scene({}, 25.0, molecules=frozen, forces=pme)
        ).run.remove_momentum_interval_ps
        is False
    )
    assert (
        rigidmd.with_defaults(small_scene({"argon": 3}, None)).run.remove_momentum_interval_ps
        is False
    )
    nvt = {"ensemble": "nvt", "temperature_K": 90.0, "duration_ps": 1.0}
    for thermostat, removed in [
        ("velocity_rescaling", 1.0),
        ("nose_hoover", 1.0),
        ("langevin", False),
        ("andersen", False),
    ]:
        scene = small_scene({"argon": 20}, 25.0, stages=[nvt | {"thermostat": thermostat}])
        assert rigidmd.with_defaults(scene).run.remove_momentum_interval_ps == removed
    with pytest.raises(SceneError, match="total momentum is not conserved with frozen molecules"):
        small_scene({}, 25.0, molecules=frozen, run={"remove_momentum_interval_ps": 0.1})
    text = describe(argon(run={"remove_momentum_interval_ps": 0.2}), verbose=True)
    assert "total momentum: removed every 0.2 ps" in text
    assert "run.remove_momentum_interval_ps is false" in describe(
        argon(run={"remove_momentum_interval_ps": False}), verbose=True
    )


DECIDED = {
    "reaction_field": {"cutoff_A", "switch_start_A"},
    "ewald": {
        "cutoff_A",
        "switch_start_A",
        "ewald_alpha_per_A",
        "ewald_k_radius_per_A",
        "ewald_truncation",
    },
    "pme": {
        "cutoff_A",
        "switch_start_A",
        "ewald_alpha_per_A",
        "pme_grid",
        "pme_order",
        "ewald_truncation",
    },
}


@pytest.mark.parametrize(
    "electrostatics", ["reaction_field", pytest.param("ewald", marks=pytest.mark.soak), "pme"]
)
def test_the_scene_that_a_run_writes_holds_every_number_it_used(electrostatics, tmp_path):
    """And runs again to the same bits, though nothing is left for it to decide."""
    forces = {"electrostatics": electrostatics} | (
        {} if electrostatics == "reaction_field" else {"ewald_accuracy": 1e-3}
    )
    stages = [{"duration_ps": 0.01, "ensemble": "nvt", "temperature_K": 300.0}]
    scene = small_scene({"spce": 30}, 18.5, forces=forces, start={}, stages=stages)
    first = Simulation(scene, tmp_path / "out").run()
    again = Scene.read(tmp_path / "out" / "scene.toml")
    assert DECIDED[electrostatics] <= again.forces.model_fields_set
    assert "ewald_accuracy" not in again.forces.model_fields_set
    assert again.start.temperature_K == 300.0
    assert again.forces.skin_A == 1.9
    assert rigidmd.with_defaults(scene) == first.system.scene
    assert again.model_dump() == first.system.scene.model_dump()
    repeated = Simulation(again).run()
    assert same_bits(first.state, repeated.state)


@pytest.mark.parametrize("electrostatics", [*DECIDED, "damped_shifted_force", "none"])
@pytest.mark.parametrize("angles", [(90.0, 90.0, 90.0), (80.0, 75.0, 85.0)])
def test_a_resolved_scene_has_every_number_and_resolves_to_itself(electrostatics, angles):
    box = {"lengths_A": [22.0, 23.0, 24.0], "angles_deg": angles}
    scene = small_scene({"spce": 30}, None, box=box, forces={"electrostatics": electrostatics})
    resolved = rigidmd.with_defaults(scene)
    assert rigidmd.with_defaults(resolved) == resolved != scene
    for key in {"skin_A", *DECIDED.get(electrostatics, DECIDED["reaction_field"])}:
        assert getattr(resolved.forces, key) is not None, key
    assert resolved.forces.ewald_accuracy is None  # what follows from it is there
    assert resolved.run.remove_momentum_interval_ps == (1.0 if electrostatics == "pme" else False)
    assert resolved.start.temperature_K == 300.0
    assert resolved.output.velocities is False
    again = MolecularScene.model_validate(resolved.model_dump(exclude_none=True))
    assert rigidmd.with_defaults(again) == again


def test_without_a_box_there_is_no_cutoff_to_decide():
    resolved = rigidmd.with_defaults(small_scene({"spce": 3}, None))
    assert resolved.forces.cutoff_A is resolved.forces.switch_start_A is None


def test_a_cell_that_tilts_too_much_leaves_only_the_grid_open():
    """The keys of a scene count along its own edges; the engine has others."""
    box = {"lengths_A": [24.0, 24.0, 24.0], "angles_deg": [60.0, 60.0, 45.0]}
    forces = {"electrostatics": "pme", "cutoff_A": 8.0}
    scene = small_scene({"spce": 30}, None, box=box, forces=forces)
    resolved = rigidmd.with_defaults(scene)
    assert rigidmd.with_defaults(resolved) == resolved
    assert resolved.forces.pme_grid is None
    first, again = (build(each).terms["coulomb_reciprocal"] for each in (scene, resolved))
    assert (resolved.forces.ewald_accuracy, resolved.forces.pme_order) == (5e-5, first.order)
    assert (first.grid, first.order) == (again.grid, again.order)
    even = rigidmd.with_defaults(
        small_scene({"spce": 30}, None, box=box, forces=forces | {"pme_grid": [60, 60, 60]})
    )
    assert (even.forces.pme_grid, even.forces.ewald_accuracy) == ((60, 60, 60), None)


def test_errors_of_all_tables_are_reported_at_once():
    molecules = [{"model": "spce", "count": 3, "frozen": "2-9"}]
    scene = small_scene(
        {}, 17.0, molecules=molecules, forces={"electrostatics": "pme", "ewald_alpha_per_A": 2.0}
    )
    with pytest.raises(SceneError) as error:
        build(scene)
    assert [fault.partition(":")[0].partition(" =")[0] for fault in error.value.errors] == [
        "molecules.0.frozen",
        "forces.cutoff_A",
        "forces.ewald_alpha_per_A",
    ]
    assert "(the default)" in str(error.value)


def test_an_accuracy_that_cannot_be_had_is_called_the_default():
    forces = {"electrostatics": "pme", "cutoff_A": 6.0, "ewald_alpha_per_A": 1.3}
    with pytest.raises(
        SceneError, match=r"ewald_accuracy = 5e-05 \(the default\) cannot be reached"
    ):
        build(small_scene({"spce": 30}, 18.5, forces=forces | {"pme_grid": [8, 8, 8]}))
