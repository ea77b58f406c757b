"""Where measurements of accuracy start, and the checks of their arguments."""

from collections.abc import Iterable
from typing import cast

from rigidmd.core.state import State
from rigidmd.engines.samples import Samples
from rigidmd.errors import SceneError
from rigidmd.run import Simulation
from rigidmd.run.mean_box import scale_to_mean_box
from rigidmd.scene import MolecularScene, Scene, is_molecular
from rigidmd.scene.stage import MOST_STEPS


def check_engine_is_rigidmd(scene: Scene) -> None:
    """Raise SceneError if a scene names another engine: only the integrators of rigidmd are
    measured."""
    if is_molecular(scene) and scene.engine.is_external:
        error = f"engine.name = {scene.engine.name!r}: accuracy measures rigidmd. Leave it out"
        raise SceneError(scene.source, [error])


def check_times(scene: Scene, times: Iterable[float], names: str) -> None:
    """Raise SceneError unless times have a size that numbers of a scene may have."""
    least, largest = scene.SIZES
    if not all(least <= time <= largest for time in times):
        bounds = f"{least:g} and {largest:g}".replace("e+", "e")
        raise SceneError("accuracy", [f"{names} must be between {bounds}"])


def check_number_of_steps(duration: float, step: float) -> None:
    """Raise SceneError if a duration has too many steps, in the same unit."""
    if not duration / step < MOST_STEPS:
        error = f"a run has more than {MOST_STEPS:g} steps: use longer steps, or shorter runs"
        raise SceneError("accuracy", [error])


def start_of_last_stage(scene: MolecularScene) -> tuple[Simulation, State]:
    """A simulation of a scene, and the state in which its last stage starts. Earlier stages run
    without files."""
    simulation = Simulation(scene)
    if len(scene.stages) > 1:
        interval = scene.output.log_interval_ps if scene.stages[-1].volume else 1e9
        quiet = scene.output.model_copy(update={"trajectory": False, "log_interval_ps": interval})
        resolved = simulation.scene
        results = Simulation(
            resolved.model_copy(update={"stages": resolved.stages[:-1], "output": quiet})
        ).run()
        scale_to_mean_box(
            simulation.system, results.state, cast(Samples, results.samples), len(scene.stages) - 1
        )
        return simulation, results.state
    simulation._start()
    return simulation, simulation.state.copy()
