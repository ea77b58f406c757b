"""The columns of log.csv, and the samples in a run of molecules.

One table serves files, displays and documentation, the record `Sample`: each field has a `Column`.
"""

from abc import ABC, abstractmethod
from array import array
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from math import nan
from operator import attrgetter
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, NamedTuple, get_args, get_type_hints

import numpy as np

from rigidmd.core.statistics import least_error_from, may_be_unsteady, steady_from
from rigidmd.features import FEATURES

if TYPE_CHECKING:
    from rigidmd.scene.stage import Stage


class Column(NamedTuple):
    """Header, unit and description of a column."""

    header: str  # in the file of samples; empty for a column that is not written
    unit: str  # "1" for plain numbers, empty for text
    about: str


class Sample(NamedTuple):
    """One line of the log, in its units. NaN for what does not exist: pressure without a box, T_rot
    of points."""

    step: Annotated[int, Column("Step", "1", "steps since the start")]
    time: Annotated[float, Column("Time (ps)", "ps", "time since the start")]
    potential: Annotated[
        float,
        Column("Potential Energy (kJ/mole)", "kJ/mol", "potential energy of the whole system"),
    ]
    kinetic: Annotated[
        float,
        Column("Kinetic Energy (kJ/mole)", "kJ/mol", "kinetic energy, translation and rotation"),
    ]
    energy: Annotated[
        float, Column("Total Energy (kJ/mole)", "kJ/mol", "potential and kinetic energy")
    ]
    temperature: Annotated[float, Column("Temperature (K)", "K", "temperature of all motion")]
    volume: Annotated[float, Column("Box Volume (nm^3)", "nm³", "volume of the box")]
    density: Annotated[float, Column("Density (g/mL)", "g/cm³", "mass density")]
    stage_name: Annotated[str, Column("Stage", "", "name of the stage")]
    temperature_translation: Annotated[
        float, Column("T_trans (K)", "K", "temperature of translation")
    ]
    temperature_rotation: Annotated[float, Column("T_rot (K)", "K", "temperature of rotation")]
    pressure_bar: Annotated[
        float,
        Column(
            "Pressure (bar)",
            "bar",
            "molecular pressure, with the tail correction and kB T/V of a total momentum that is"
            " kept at zero",
        ),
    ]
    drift: Annotated[
        float, Column("Drift (kJ/mole)", "kJ/mol", "change of `conserved` since the stage began")
    ]
    momentum: Annotated[float, Column("Momentum (u A/ps)", "u Å/ps", "size of the total momentum")]
    orthogonality_error: Annotated[
        float, Column("Orthogonality error", "1", "largest entry of abs(QᵀQ - 1)")
    ]
    a: Annotated[float, Column("a (A)", "Å", "length of the box's edge a")]
    b: Annotated[float, Column("b (A)", "Å", "length of the box's edge b")]
    c: Annotated[float, Column("c (A)", "Å", "length of the box's edge c")]
    alpha: Annotated[float, Column("alpha (deg)", "°", "angle between b and c")]
    beta: Annotated[float, Column("beta (deg)", "°", "angle between c and a")]
    gamma: Annotated[float, Column("gamma (deg)", "°", "angle between a and b")]
    heat: Annotated[
        float,
        Column("Heat (kJ/mole)", "kJ/mol", "heat that thermostats have added since the start"),
    ]
    work: Annotated[
        float,
        Column("Work (kJ/mole)", "kJ/mol", "work of barostats, drives and minimisations so far"),
    ]
    pressure_xx: Annotated[
        float, Column("Pressure xx (bar)", "bar", "molecular pressure tensor, symmetric part")
    ]
    pressure_yy: Annotated[float, Column("Pressure yy (bar)", "bar", "the same, yy")]
    pressure_zz: Annotated[float, Column("Pressure zz (bar)", "bar", "the same, zz")]
    pressure_xy: Annotated[float, Column("Pressure xy (bar)", "bar", "the same, xy")]
    pressure_xz: Annotated[float, Column("Pressure xz (bar)", "bar", "the same, xz")]
    pressure_yz: Annotated[float, Column("Pressure yz (bar)", "bar", "the same, yz")]
    conserved: Annotated[
        float, Column("", "kJ/mol", "energy less heat, work and the energy of removed momentum")
    ]
    stage: Annotated[int, Column("", "1", "index of the stage, from 0")]
    force_squares: Annotated[
        float, Column("F^2/m (kJ/mole/ps^2)", "kJ/mol/ps²", "sum of F²/m of all molecules")
    ] = nan
    torque_squares: Annotated[
        float, Column("n^2/I (kJ/mole/ps^2)", "kJ/mol/ps²", "the same of torques n")
    ] = nan
    # in the columns that not all scenes have, see `System.more_columns`
    user_energies: tuple[float, ...] = ()


_HINTS = get_type_hints(Sample, include_extras=True)
COLUMNS: dict[str, Column] = {
    name: get_args(_HINTS[name])[1] for name in Sample._fields if name != "user_energies"
}


#: Columns whose means have no meaning.
NOT_AVERAGED = {
    "step",
    "time",
    "stage_name",
    "stage",
    "drift",
    "momentum",
    "orthogonality_error",
    "heat",
    "work",
    "conserved",
    "force_squares",
    "torque_squares",
}


#: Columns that only scenes with a feature have.
OF_FEATURES = {name: Column(*words) for row in FEATURES for name, *words in row.columns}
IN_LOGS = COLUMNS | OF_FEATURES


def distance_column(k: int) -> tuple[str, Column]:
    """Name and column of the distance that fields.restraints.k restrains."""
    about = f"distance of the groups of fields.restraints.{k}"
    return f"distance_{k}", Column(f"Distance {k} (A)", "Å", about)


def energy_column(name: str) -> Column:
    """The column of the energy of a user-defined force."""
    return Column(f"{name} (kJ/mole)", "kJ/mol", f"energy of the force {name}")


NUMBERS = [name for name in COLUMNS if name != "stage_name"]


#: Key of `results[...]` for rotation matrices (n, 3, 3), where something has one: no column of a
#: file.
MATRIX = "Q"


class SampleTable(ABC):
    """The samples of a run as arrays by the names of their columns, which `described` has."""

    described: dict[str, Column]

    def __len__(self) -> int:
        return len(self["time"])

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {len(self)} samples of {', '.join(self.described)}>"

    def __getitem__(self, column: str) -> np.ndarray:
        """A column as an array, one value for each sample, in its unit in the file. Raises KeyError
        with all names."""
        if column not in self.described:
            raise KeyError(f"no column {column!r}; there are {', '.join(self.described)}")
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
    more : further columns, in the order of `Sample.user_energies`
    table : the result of an earlier `table()`. Raises ValueError if it is invalid.
    """

    def __init__(
        self,
        stages: Sequence[str],
        more: Mapping[str, Column] = MappingProxyType({}),
        table: np.ndarray | None = None,
    ):
        self.stages, self.more = tuple(stages), more
        self.described = COLUMNS | dict(more)
        self._numbers = [*NUMBERS, *more]
        self._values = array("d")  # grows in place
        if table is not None:
            if table.ndim != 2 or table.shape[1] != len(self._numbers) or table.dtype != np.float64:
                raise ValueError(f"samples have the shape {table.shape}")
            self._values.frombytes(table.tobytes())
            if not np.isin(self._column("stage"), np.arange(len(self.stages))).all():
                raise ValueError("samples have stages that are not in the scene")
            step = self._column("step")
            if not ((np.abs(step) < 2**53) & (np.floor(step) == step)).all():
                raise ValueError("samples have steps that are not whole numbers")

    def append(self, sample: Sample) -> None:
        self._values.extend((*_VALUES(sample), *sample.user_energies))

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
        width = len(NUMBERS)
        values = dict(zip(NUMBERS, self._values[first : first + width], strict=True))
        step, stage = int(values.pop("step")), int(values.pop("stage"))
        energies = self._values[first + width : first + len(self._numbers)]
        return Sample(
            **values,
            step=step,
            stage=stage,
            stage_name=self.stages[stage],
            user_energies=tuple(energies),
        )

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
        samples = Samples(self.stages, self.more)
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


_VALUES = attrgetter(*NUMBERS)


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
        of_stage.stages, of_stage.more, of_stage.table()[equilibrated_from(of_stage, stage) :]
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
