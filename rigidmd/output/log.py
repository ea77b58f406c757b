"""log.csv: one line an observation, flushed at once, so that a killed run leaves what it had measured.

Columns as OpenMM's StateDataReporter, then ours.
"""

import csv
from math import isnan
from pathlib import Path

from rigidmd.measure.samples import Sample
from rigidmd.units import KJ_PER_MOL

COLUMNS = (
    "Step",
    "Time (ps)",
    "Potential Energy (kJ/mole)",
    "Kinetic Energy (kJ/mole)",
    "Total Energy (kJ/mole)",
    "Temperature (K)",
    "Box Volume (nm^3)",
    "Density (g/mL)",
    "Stage",
    "T_trans (K)",
    "T_rot (K)",
    "T_trans unbiased (K)",
    "T_rot unbiased (K)",
    "Pressure (bar)",
    "Drift (kJ/mole)",
    "Momentum (u A/ps)",
    "Orthogonality error",
)


class Log:
    """Writes samples to a CSV file. Numbers with all digits that matter; empty where there is none."""

    def __init__(self, path: Path, volume: float, density: float):
        self._file = path.open("w", newline="", encoding="utf-8")
        self._writer = csv.writer(self._file, quoting=csv.QUOTE_NONNUMERIC, lineterminator="\n")
        self._writer.writerow(COLUMNS)
        self._constant = (volume * 1e-3, density) if density > 0 else (None, None)

    def write(self, sample: Sample) -> None:
        """Add a line."""
        row = [
            sample.step,
            round(sample.time, 9),
            sample.potential / KJ_PER_MOL,
            sample.kinetic / KJ_PER_MOL,
            sample.energy / KJ_PER_MOL,
            sample.temperature,
            *self._constant,
            sample.stage_name,
            sample.temperature_translation,
            sample.temperature_rotation,
            sample.temperature_translation_unbiased,
            sample.temperature_rotation_unbiased,
            sample.pressure_bar,
            sample.drift / KJ_PER_MOL,
            sample.momentum,
            sample.orthogonality,
        ]
        self._writer.writerow([None if isinstance(x, float) and isnan(x) else x for x in row])
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()
