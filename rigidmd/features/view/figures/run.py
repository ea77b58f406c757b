"""The observer that draws the figures of a run."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from rigidmd.features.view.figures import style
from rigidmd.features.view.kind_display import run_figures
from rigidmd.run.observers import Observer

if TYPE_CHECKING:
    from rigidmd.run.results import Results
    from rigidmd.run.simulation import Simulation


class Figures(Observer):
    """Figures of the run, by the stems and the types of their files."""

    draws = True

    def __init__(self, stems: Sequence[str], suffixes: Sequence[str]):
        self._suffixes = suffixes
        self._names = [f"{stem}.{suffix}" for stem in stems for suffix in suffixes]

    def end(self, run: "Simulation", results: "Results") -> None:
        failed = None
        for stem, figure in run_figures(run.system, results.samples, results.summary).items():
            try:
                results.files += style.save_files(figure, run.path(stem), self._suffixes)
            except Exception as error:  # of many types; the other figures are drawn first
                failed = failed or error
        if failed is not None:
            raise failed
