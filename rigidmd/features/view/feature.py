"""What this feature does for runs of molecules and for their models."""

from pathlib import Path

from rigidmd.engines.system import System
from rigidmd.feature import Feature
from rigidmd.run.observers import Observer
from rigidmd.scene.models import Molecule


class View(Feature):
    def observers(self, system: System) -> list[Observer]:
        from rigidmd.features.view.figures.run import Figures

        return [Figures(["energy"], ["png"])]

    def draw_model(self, path: Path, molecule: Molecule, *, force: bool) -> None:
        from rigidmd.features.view.molecule_figure import write_molecule_figure

        write_molecule_figure(path, molecule, force=force)


FEATURE = View()
