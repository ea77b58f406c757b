"""Samples: one line an observation, kept as rows and asked for as columns."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np


class Sample(NamedTuple):
    """One line of the log, in internal units."""

    step: int
    time: float  # ps
    stage: int
    stage_name: str
    potential: float  # u Å²/ps²
    kinetic: float
    energy: float
    temperature: float  # K
    temperature_translation: float
    temperature_rotation: float
    temperature_translation_unbiased: float  # NaN with any integrator but velocity Verlet
    temperature_rotation_unbiased: float
    pressure_bar: float
    conserved: float  # energy less heat of the thermostat, with what went with the total momentum, u Å²/ps²
    drift: float  # of the conserved energy since the stage began, u Å²/ps²
    momentum: float  # |P|, u Å/ps
    orthogonality: float


@dataclass
class Samples:
    """The rows of a run, in order."""

    rows: list[Sample] = field(default_factory=list)

    def __getitem__(self, column: str) -> np.ndarray:
        """A column as an array (rows,), by the name of a field of `Sample`."""
        if column not in Sample._fields:
            raise KeyError(f"no column {column!r}; there are {', '.join(Sample._fields)}")
        return np.array([getattr(row, column) for row in self.rows])
