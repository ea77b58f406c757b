"""What the feature of single bodies does: the kind of scene of a body."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.core.toml import Json
from rigidmd.feature import Feature
from rigidmd.features.bodies.keys.body import MOTION, BodyScene
from rigidmd.run.kind import Kind

if TYPE_CHECKING:
    from rigidmd.features.bodies.motion import Motion
    from rigidmd.features.bodies.run import BodyRun
    from rigidmd.features.bodies.system import BodySystem
    from rigidmd.io.run_files import Columns
    from rigidmd.run.record import Record
    from rigidmd.run.simulation import Simulation

ONE_LOOP = "is for molecules. The step of a body is one loop"


class BodyKind(Kind[BodyScene, "BodySystem"]):
    name = BodyScene.kind
    takes = ("applied",)
    takes_instead = "for molecules. A single body takes applied={name: function}"
    lacks = {  # noqa: RUF012  (as in the base class)
        "--threads": "--threads is for molecules. A single body uses one thread",
        "--program": f"--program {ONE_LOOP}",
        "--profile": f"--profile {ONE_LOOP}",
        "averages": "{option} is for molecules. A single body has no thermostat",
        "--accuracy": "--accuracy needs molecules with Ewald sums",
        "--unit": "--unit {unit} is for molecules. The energy of a body is in J",
    }
    energy_unit = "J"
    samples_file = MOTION

    def build(self, scene: BodyScene, *, user_code: bool = True) -> "BodySystem":
        from rigidmd.features.bodies.assemble import build_body

        return build_body(scene)

    def describe(self, system: "BodySystem", *, verbose: bool = False) -> str:
        from rigidmd.features.bodies.describe import describe_body

        return describe_body(system, verbose=verbose)

    def step_errors(self, system: "BodySystem") -> list[str]:
        from rigidmd.features.bodies.stable_step import step_errors

        return step_errors(system)

    def step_warnings(self, system: "BodySystem") -> list[str]:
        from rigidmd.features.bodies.stable_step import step_warnings

        return step_warnings(system)

    def run_part(self, simulation: "Simulation", scene: BodyScene, user_code: Json) -> "BodyRun":
        from rigidmd.features.bodies.run import BodyRun

        return BodyRun(simulation, scene, **user_code)

    def energy_lines(self, name: str, energies: Json, unit: str) -> list[str]:
        from rigidmd.features.bodies.summary import energy_lines

        return energy_lines(name, energies)

    def read_samples(self, path: Path) -> "Columns | None":
        from rigidmd.features.bodies.stored_motion import read_motion

        return read_motion(path)

    def columns_of_run(
        self, folder: Path, system: "BodySystem", missing: list[str]
    ) -> dict[str, np.ndarray]:
        from rigidmd.features.bodies.stored_motion import columns_of_run

        return columns_of_run(folder, system, missing)

    def samples_of(self, record: "Record[BodySystem]") -> "Motion":
        from rigidmd.features.bodies.motion import Motion

        return Motion(record.columns)

    def adds_to(self, feature: str) -> object:
        if feature == "view":
            from rigidmd.features.bodies.display import BodyDisplay

            return BodyDisplay()
        if feature == "studies":
            from rigidmd.features.bodies.study import BodyStudy

            return BodyStudy()
        return None


class Bodies(Feature):
    def kind(self) -> BodyKind:
        return BodyKind()


FEATURE = Bodies()
