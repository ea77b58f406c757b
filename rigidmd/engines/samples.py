"""The samples in a run: a table with a column for each quantity."""

from abc import ABC, abstractmethod
from array import array
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.core.plain_text import did_you_mean_first
from rigidmd.core.quantities import QUANTITIES, Quantity, current_name
from rigidmd.core.statistics import least_error_from, may_be_unsteady, steady_from

if TYPE_CHECKING:
    from rigidmd.scene.stage import Stage


class Sample(SimpleNamespace):
    """One line of the log, by the names of its columns, in their units. NaN for what does not
    exist: pressure without a box, T_rot of points."""

    def __getattr__(self, name: str) -> float:
        current = current_name(name, QUANTITIES)
        if current == name:
            raise AttributeError(f"a sample has no {name!r}")
        return getattr(self, current)


#: Key of `results[...]` for rotation matrices (n, 3, 3), where something has one: no column of a
#: file.
MATRIX = "Q"


class SampleTable(ABC):
    """The samples of a run as arrays by the names of their columns, which `described` has."""

    described: Mapping[str, Quantity]

    def __len__(self) -> int:
        return len(self["time"])

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {len(self)} samples of {', '.join(self.described)}>"

    def __getitem__(self, column: str) -> np.ndarray:
        """A column as an array, one value for each sample, in its unit in the file. Raises KeyError
        with all names."""
        column = current_name(column, self.described)
        if column not in self.described:
            raise KeyError(f"no column {column!r}{did_you_mean_first(column, self.described)}")
        return self._array(column)

    @abstractmethod
    def _array(self, name: str) -> np.ndarray: ...

    @property
    def written(self) -> dict[str, np.ndarray]:
        """The columns by their headers in the file."""
        return {
            column.header: self[name] for name, column in self.described.items() if column.header
        }


class Samples(SampleTable):
    """The samples of a run in order: a table with one row of float64 per sample.

    stages : names of all stages
    described : the columns
    table : the result of an earlier `table()`
    """

    def __init__(
        self,
        stages: Sequence[str],
        described: Mapping[str, Quantity] = QUANTITIES,
        table: np.ndarray | None = None,
    ):
        self.stages, self.described = tuple(stages), described
        self._numbers = numbers(described)
        self._values = array("d")  # grows in place
        if table is not None:
            self._values.frombytes(table.tobytes())

    def append(self, sample: Sample) -> None:
        self._values.extend([getattr(sample, name) for name in self._numbers])

    def __len__(self) -> int:
        return len(self._values) // len(self._numbers)

    def _array(self, name: str) -> np.ndarray:
        if name == "stage_name":
            return np.array(self.stages)[self["stage"]]
        return self._column(name).astype(int if name in ("step", "stage") else float)  # a copy

    def __iter__(self) -> Iterator[Sample]:
        return map(self.row, range(len(self)))

    @property
    def rows(self) -> list[Sample]:
        """All samples. They take five times the memory of the table."""
        return list(self)

    def row(self, k: int) -> Sample:
        """Sample k. -1 for the last one."""
        first = range(len(self))[k] * len(self._numbers)
        row = self._values[first : first + len(self._numbers)]
        sample = Sample(**dict(zip(self._numbers, row, strict=True)))
        sample.step, sample.stage = int(sample.step), int(sample.stage)
        sample.stage_name = self.stages[sample.stage]
        return sample

    def latest(self, time: float, since: int) -> int:
        """Index of the last sample not later than a time (ps), at least `since`."""
        width = len(self._numbers)
        at = self._numbers.index("time")
        rows = range(len(self))
        return max(
            since,
            bisect_right(rows, time, lo=since, key=lambda k: self._values[k * width + at]) - 1,
        )

    def of_stage(self, k: int) -> "Samples":
        """The samples of stage k, which are contiguous."""
        samples = Samples(self.stages, self.described)
        width = len(self._numbers)
        if len(rows := np.flatnonzero(self._column("stage") == k)):
            samples._values = self._values[rows[0] * width : (rows[-1] + 1) * width]
        return samples

    def table(self) -> np.ndarray:
        """A copy of all numbers (rows, columns) as float64, which represents each of them
        exactly."""
        return np.array(self._values, float).reshape(-1, len(self._numbers))

    def _column(self, name: str) -> np.ndarray:
        """A view of a column. It must be released before the next sample is appended."""
        return np.asarray(self._values)[self._numbers.index(name) :: len(self._numbers)]


def numbers(described: Mapping[str, Quantity]) -> list[str]:
    """The names of the columns that are not text."""
    return [name for name, quantity in described.items() if quantity.unit]


def moving(stages: "Sequence[Stage]", of: np.ndarray) -> np.ndarray:
    """Whether each sample (n,) is of motion and not of a minimisation. `of` has the index of its
    stage."""
    return ~np.isin(of, [k for k, stage in enumerate(stages) if stage.is_minimisation])


#: Minimum samples of a stage for the detection of its equilibration.
LEAST_SAMPLES = 40


def equilibrated_from(of_stage: Mapping[str, np.ndarray] | SampleTable, stage: "Stage") -> int:
    """Index from which on the samples of a stage are of its equilibrium: where the potential energy
    and, if the box moves, the density are steady (`steady_from`). 0 with few samples, and if the
    temperature or pressure changes."""
    return max(map(steady_from, _slow_series(of_stage, stage)), default=0)


def _slow_series(
    of_stage: Mapping[str, np.ndarray] | SampleTable, stage: "Stage"
) -> list[np.ndarray]:
    """The series of a stage that show its equilibration. None where it cannot be detected."""
    if len(of_stage["time"]) < LEAST_SAMPLES or stage.ramps:
        return []
    return [of_stage[name] for name in ("potential", *(["density"] if stage.changes_box else []))]


def equilibrated(of_stage: Samples, stage: "Stage") -> Samples:
    """The samples of the equilibrated part of a stage."""
    return Samples(
        of_stage.stages, of_stage.described, of_stage.table()[equilibrated_from(of_stage, stage) :]
    )


def describe_equilibrated(
    of_stage: Mapping[str, np.ndarray] | SampleTable, stage: "Stage", begin: float
) -> str:
    """The equilibrated part of a stage that started at a time (ps), such as "the last 14.2 of 20
    ps"."""
    time = of_stage["time"]
    start = equilibrated_from(of_stage, stage)
    all_of_stage = f"all {time[-1] - begin:.4g} ps"
    if stage.ramps:
        return f"{all_of_stage}, in which the set point changes"
    if len(time) < LEAST_SAMPLES:
        return f"{all_of_stage}, too short to detect equilibration"
    if start:
        part = f"the last {time[-1] - time[start]:.4g} of {time[-1] - begin:.4g} ps"
    else:
        part = all_of_stage
    drifts = any(
        least_error_from(values) == len(time) // 2 for values in _slow_series(of_stage, stage)
    )
    if drifts:
        return f"{part}, not yet steady"
    if not start and any(map(may_be_unsteady, _slow_series(of_stage, stage))):
        return f"{part}, perhaps not yet steady"
    return part
