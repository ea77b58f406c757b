"""What this feature does for runs and for other features."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.engines.system import System
from rigidmd.feature import Feature
from rigidmd.scene.stage import Stage

if TYPE_CHECKING:
    from rigidmd.commands.arguments import Options


class Studies(Feature):
    def step_biases(
        self, system: System, stage: Stage, columns: dict[str, np.ndarray]
    ) -> dict[str, tuple[float, float, float]] | str:
        from rigidmd.features.studies.step_bias import biases

        return biases(system, stage, columns)

    def analyse_sweep(
        self, folder: Path, request: tuple, more: dict, progress, options: "Options"
    ) -> int:
        """Analyse a sweep for `rigidmd analyse`: print the results of each combination, and the
        extrapolation. An exit code."""
        from rigidmd.commands import FAILED
        from rigidmd.features.analysis.commands.analyse import print_results
        from rigidmd.features.studies.commands.sweep import print_limits
        from rigidmd.features.studies.sweep.folder import read_manifest
        from rigidmd.features.studies.sweep.replicas import ANALYSES, analyse_sweep

        names, start, viscosity = request
        analysed = analyse_sweep(folder, names, start, viscosity, progress, options.figures, more)
        progress(1.0, "")
        for of in analysed:
            runs = f"{of.runs} run{'s' if of.runs > 1 else ''}"
            files = f"{len(of.files)} files in {of.files[0].parent}" if of.files else "no results"
            print(f"{of.title or folder}: {runs}, {files}")
            print_results(of.results, of.failed, verbose=options.verbose)
            print()
        print(f"values of all in {folder / ANALYSES}")
        if options.extrapolate is not None:
            names_of_files = print_limits(read_manifest(folder), options.extrapolate)
            print(f"\n  files in {folder}: {', '.join(names_of_files)}")
        return FAILED if names and any(of.failed for of in analysed) else 0


FEATURE = Studies()
