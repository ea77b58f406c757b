"""What studies measure of a body: extremes of its motion, accuracy, stability cases."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.core.integrators import SOLVERS
from rigidmd.core.toml import Json
from rigidmd.features.bodies.keys.body import BodyScene
from rigidmd.features.bodies.motion import COLUMNS, FAMILIES
from rigidmd.features.bodies.system import BodySystem
from rigidmd.features.studies.kind_study import AccuracyStart, KindStudy, Measured
from rigidmd.run.record import Record

if TYPE_CHECKING:
    from rigidmd.features.studies.stability.cases import Trial

#: Columns that are not in the table of a sweep.
NOT_IN_TABLE = {
    name
    for family in ("time", "rotation", "quaternion", "orthogonality_error")
    for name in FAMILIES[family].names
}
RADIANS = 0.1  # rotation per force evaluation in the middle of the ladder of time steps, rad
#: Step of a body that does not rotate, in the step of its scene, which is assumed to be suitable
AT_REST = 8.0


class BodyStudy(KindStudy[BodyScene]):
    main_columns = (
        "theta lowest (rad)",
        "theta highest (rad)",
        "energy end (J)",
        "energy_error largest",
        "L_size_error largest",
    )

    def summarise(self, record: Record[BodySystem]) -> dict[str, Measured]:
        results: dict[str, Measured] = {}
        for name, values in record.columns.items():
            if name in NOT_IN_TABLE or not np.isfinite(values).all():
                continue
            if name.endswith("_error"):
                results[f"{name} largest"] = float(np.abs(values).max()), None
                continue
            unit = COLUMNS[name].unit if name in COLUMNS else "1"
            numbers = values.mean(), values.min(), values.max(), values[-1]
            for word, number in zip(("mean", "lowest", "highest", "end"), numbers, strict=True):
                results[f"{name} {word} ({unit})"] = float(number), None
        return results

    def accuracy_start(self, scene: BodyScene, span: float | None) -> AccuracyStart:
        from rigidmd.features.bodies.trials import body_trial_system

        trial_system, speed = body_trial_system(scene, span)
        evaluations = scene.run.row.force_evaluations if scene.run.has_scheme else 1
        base = RADIANS / speed if speed else AT_REST * scene.run.timestep_s / evaluations
        return AccuracyStart(trial_system, base, scene.run.integrator)

    def method_name(self, name: str, scene: BodyScene) -> str:
        """A solver with the formulation of the scene, unless it is the matrix."""
        solver, _, form = name.partition("_")
        if solver not in SOLVERS:
            return name
        form = form or scene.run.formulation
        return solver if form in (None, "matrix") else f"{solver}_{form}"

    def complete_trial(self, trial: "Trial", method: Json, step: float) -> Json:
        interval = min(max(step, trial.span / trial.samples), trial.span)
        output = {"trajectory": False, "figures": False, "interval_s": interval}
        run = method | {"duration_s": trial.span, "timestep_s": step}
        return {"run": run, "output": output, **trial.scene}

    def add_stability_cases(self) -> None:
        from rigidmd.features.bodies import stability  # noqa: F401  (registers builders)
        from rigidmd.features.studies.stability.cases import add_cases

        add_cases(Path(__file__).with_name("stability_cases.toml"))
