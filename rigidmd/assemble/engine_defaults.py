"""What a scene leaves open, decided for the engine that computes it: others have other thermostats and barostats."""

from typing import Any

from rigidmd.scene import MolecularScene
from rigidmd.scene.stage import Stage

#: Thermostat that stands in for velocity rescaling, which neither LAMMPS nor OpenMM has for rigid bodies.
THERMOSTAT = "nose_hoover"
#: Barostats of other engines: LAMMPS' own has no name in a scene.
BAROSTATS = {"lammps": None, "openmm": "monte_carlo"}


def with_engine_defaults(scene: MolecularScene) -> tuple[MolecularScene, list[str]]:
    """A scene with what it leaves open decided for its engine, before other defaults; and notes on it.

    A scene for rigidmd itself stays as it is.
    """
    if not scene.engine.is_external:
        return scene, []
    notes = [f"computed by {scene.engine.title}"]
    stages = []
    for k, stage in enumerate(scene.stages):
        if stage.has_thermostat and stage.thermostat is None and not stage.thermostat_is_open:
            notes.append(f"stages.{k}: thermostat {THERMOSTAT}, because {scene.engine.name} has no velocity_rescaling")
            stage = stage.model_copy(update={"thermostat": THERMOSTAT})
        if stage.ensemble == "npt" and stage.barostat is None:
            stage = stage.model_copy(update={"barostat": BAROSTATS[scene.engine.name]})
        stages.append(stage)
    changed: dict[str, Any] = {"stages": tuple(stages)}
    forces = scene.forces
    if forces.electrostatics in ("ewald", "pme") and forces.ewald_truncation is None:
        changed["forces"] = forces.model_copy(update={"ewald_truncation": "plain"})
    if scene.run.remove_momentum_interval_ps is None:
        changed["run"] = scene.run.model_copy(update={"remove_momentum_interval_ps": False})
    return scene.model_copy(update=changed), notes


def stage_with_defaults(scene: MolecularScene, stage: Stage) -> Stage:
    """A stage with every number that it uses; LAMMPS' barostat has none but the time."""
    found = stage.with_defaults
    if scene.engine.name == "lammps" and stage.ensemble == "npt" and stage.barostat is None:
        found = found.model_copy(update={"barostat": None, "barostat_interval_ps": None})
    return found
