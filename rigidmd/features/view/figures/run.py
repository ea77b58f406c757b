"""The figures of a run: energy.png of molecules, and the figures of a single body."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, cast

import numpy as np

from rigidmd.core.statistics import format_signed
from rigidmd.core.toml import Json
from rigidmd.engines.samples import SampleTable, moving
from rigidmd.features.bodies.figures import body_figures
from rigidmd.features.bodies.motion import Motion
from rigidmd.features.bodies.system import BodySystem
from rigidmd.features.view.figures import style
from rigidmd.features.view.figures.panels import Panel, Timeline, stack, timeline
from rigidmd.run.observers import Observer

if TYPE_CHECKING:
    from rigidmd.engines.system import System
    from rigidmd.features.view.figures.picture import Picture
    from rigidmd.run.results import Results
    from rigidmd.run.simulation import Simulation

#: Columns of the samples in energy.png.
DRAWN = ("time", "stage", "drift", "potential", "kinetic")
TEMPERATURES = ("temperature_translation", "temperature_rotation")
#: Most stages whose drift is drawn, the last ones.
MOST_DRIFTS = 4


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


def run_figures(
    system: "System | BodySystem", samples: SampleTable, summary: Json
) -> "dict[str, Picture]":
    """The figures of a run by the names of their files, if there are enough samples."""
    if isinstance(system, BodySystem):
        return body_figures(system, cast(Motion, samples))
    is_enough = moving(system.scene.stages, samples["stage"]).sum() > 1
    return {"energy": energy_figure(system, samples, summary)} if is_enough else {}


def energy_figure(system: "System", samples: SampleTable, summary: Json) -> "Picture":
    """The drift of the conserved energy in each stage, each on its own scale. Energies and
    temperatures."""
    count = len(system.model.species)
    column = {name: samples[name] for name in (*DRAWN, *TEMPERATURES)}
    times = timeline(system, column)
    energies = []
    for name in ("potential", "kinetic"):
        values = column[name] / count
        last = values[times.shown][times.stage == times.stage[-1]]
        energies.append((f"{name}, mean {last.mean():.5g}", values - last.mean()))
    temperatures = [
        (name.removeprefix("temperature_"), column[name])
        for name in TEMPERATURES
        if np.isfinite(column[name][times.shown]).all()
    ]
    rows = [
        [
            (
                times,
                Panel(
                    "energies minus their means in the last stage (kJ/mol per molecule)", energies
                ),
            )
        ],
        [(times, Panel("temperature (K)", temperatures))],
    ]
    drifts = [
        (part, _drift_panel(part, k, column["drift"] / count, summary["stages"], system))
        for k in np.unique(times.stage)[-MOST_DRIFTS:].tolist()
        if (part := times.of_stage(k)).time.size > 1
        # an external engine may not report it
        and np.isfinite(column["drift"][part.shown]).any()
    ]
    pairs = [drifts[k : k + 2] for k in range(0, len(drifts), 2)]
    return stack([*pairs, *rows], f"{system.scene.name}: {count} molecules")


def _drift_panel(
    times: Timeline, k: int, drift: np.ndarray, stages: list[dict], system: "System"
) -> Panel:
    """The conserved energy since a stage began, kJ/mol per molecule, and the line of its drift, if
    there is a summary of the stage."""
    title = f"{system.scene.stages[k].label}: conserved energy (kJ/mol per molecule)"
    curves = [("", drift)]
    stage = stages[k] if k < len(stages) else {}  # {}: of a run that has not ended
    gradient = stage.get("drift_kJ_mol_ns_per_molecule")
    if gradient is not None and times.time.size > 2:
        error = stage["drift_error_kJ_mol_ns_per_molecule"]
        verdict = (stage.get("drift_verdict") or "").partition(",")[0]
        value = format_signed(gradient, error).replace(" ", "\N{NO-BREAK SPACE}")
        title += f", drift {value} per ns"
        title += f": {verdict}" if verdict else ""
        line = np.full(len(drift), np.nan)
        mean = drift[times.shown].mean() - gradient / 1000 * times.time.mean()
        line[times.shown] = mean + gradient / 1000 * times.time
        curves.append(("", line))
    return Panel(title, curves)
