"""energy.png of a run of molecules: drift, energies and temperatures."""

from typing import TYPE_CHECKING

import numpy as np

from rigidmd.core.statistics import format_signed
from rigidmd.core.toml import Json
from rigidmd.engines.samples import SampleTable
from rigidmd.features.view.figures.panels import Panel, Timeline, molecular_timeline, stack

if TYPE_CHECKING:
    from rigidmd.engines.system import System
    from rigidmd.features.view.figures.picture import Picture

#: Columns of the samples in energy.png.
DRAWN = ("time", "stage", "drift", "potential", "kinetic")
TEMPERATURES = ("temperature_translation", "temperature_rotation")
#: Most stages whose drift is drawn, the last ones.
MOST_DRIFTS = 4


def energy_figure(system: "System", samples: SampleTable, summary: Json) -> "Picture":
    """The drift of the conserved energy in each stage, each on its own scale. Energies and
    temperatures."""
    count = len(system.model.species)
    column = {name: samples[name] for name in (*DRAWN, *TEMPERATURES)}
    times = molecular_timeline(system, column)
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
