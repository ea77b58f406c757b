"""energy.png of a run of molecules: drift, energies and temperatures."""

from typing import TYPE_CHECKING

import numpy as np

from rigidmd.core.toml import Json
from rigidmd.engines.samples import SampleTable
from rigidmd.features.view.figures.panels import (
    PER_MOLECULE,
    Panel,
    drift_panels,
    molecular_timeline,
    stack,
)

if TYPE_CHECKING:
    from rigidmd.engines.system import System
    from rigidmd.features.view.figures.picture import Picture

#: Columns of the samples in energy.png.
DRAWN = ("time", "stage", "drift", "potential", "kinetic")
TEMPERATURES = ("temperature_translation", "temperature_rotation")


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
        [(times, Panel("energies minus their means in the last stage", energies, PER_MOLECULE))],
        [(times, Panel("temperature", temperatures, "K"))],
    ]
    drifts = drift_panels(system, column, summary["stages"])
    pairs = [drifts[k : k + 2] for k in range(0, len(drifts), 2)]
    return stack([*pairs, *rows], f"{system.scene.name}: {count} molecules")
