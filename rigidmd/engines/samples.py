"""Samples of a run of molecules: added one by one, read as columns."""

from array import array
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from operator import attrgetter
from typing import Annotated, Any, NamedTuple, get_args, get_type_hints

import numpy as np

from rigidmd.engines.columns import Column
from rigidmd.scene.stage import Stage


class Sample(NamedTuple):
    """One line of the log, in its units. Missing values are NaN: pressure without a box, T_rot of points."""

    step: Annotated[int, Column("Step", "1", "steps since the start")]
    time: Annotated[float, Column("Time (ps)", "ps", "time since the start")]
    potential: Annotated[float, Column("Potential Energy (kJ/mole)", "kJ/mol", "potential energy of the whole system")]
    kinetic: Annotated[float, Column("Kinetic Energy (kJ/mole)", "kJ/mol", "kinetic energy, translation and rotation")]
    energy: Annotated[float, Column("Total Energy (kJ/mole)", "kJ/mol", "potential and kinetic energy")]
    temperature: Annotated[float, Column("Temperature (K)", "K", "temperature of all motion")]
    volume: Annotated[float, Column("Box Volume (nm^3)", "nm³", "volume of the box")]
    density: Annotated[float, Column("Density (g/mL)", "g/cm³", "mass density")]
    stage_name: Annotated[str, Column("Stage", "", "name of the stage")]
    temperature_translation: Annotated[float, Column("T_trans (K)", "K", "temperature of translation")]
    temperature_rotation: Annotated[float, Column("T_rot (K)", "K", "temperature of rotation")]
    temperature_translation_unbiased: Annotated[
        float, Column("T_trans unbiased (K)", "K", "T_trans without the error of the step (velocity Verlet only)")
    ]
    temperature_rotation_unbiased: Annotated[
        float, Column("T_rot unbiased (K)", "K", "T_rot without the error of the step (velocity Verlet only)")
    ]
    pressure_bar: Annotated[float, Column("Pressure (bar)", "bar", "molecular pressure, tail correction included")]
    drift: Annotated[float, Column("Drift (kJ/mole)", "kJ/mol", "change of `conserved` since the stage began")]
    momentum: Annotated[float, Column("Momentum (u A/ps)", "u Å/ps", "size of the total momentum")]
    orthogonality_error: Annotated[float, Column("Orthogonality error", "1", "largest entry of abs(QᵀQ - 1)")]
    a: Annotated[float, Column("a (A)", "Å", "length of the box's edge a")]
    b: Annotated[float, Column("b (A)", "Å", "length of the box's edge b")]
    c: Annotated[float, Column("c (A)", "Å", "length of the box's edge c")]
    alpha: Annotated[float, Column("alpha (deg)", "°", "angle between b and c")]
    beta: Annotated[float, Column("beta (deg)", "°", "angle between c and a")]
    gamma: Annotated[float, Column("gamma (deg)", "°", "angle between a and b")]
    heat: Annotated[float, Column("Heat (kJ/mole)", "kJ/mol", "what thermostats have put in since the start")]
    work: Annotated[
        float, Column("Work (kJ/mole)", "kJ/mol", "what boxes, drives and minimisations have put in since the start")
    ]
    pressure_xx: Annotated[float, Column("Pressure xx (bar)", "bar", "molecular pressure tensor, symmetric part")]
    pressure_yy: Annotated[float, Column("Pressure yy (bar)", "bar", "the same, yy")]
    pressure_zz: Annotated[float, Column("Pressure zz (bar)", "bar", "the same, zz")]
    pressure_xy: Annotated[float, Column("Pressure xy (bar)", "bar", "the same, xy")]
    pressure_xz: Annotated[float, Column("Pressure xz (bar)", "bar", "the same, xz")]
    pressure_yz: Annotated[float, Column("Pressure yz (bar)", "bar", "the same, yz")]
    conserved: Annotated[
        float, Column("", "kJ/mol", "energy less heat, work and what removals of momentum have put in")
    ]
    stage: Annotated[int, Column("", "1", "index of the stage, from 0")]
    user_energies: tuple[float, ...] = ()  # energies of the user-defined forces, kJ/mol


COLUMNS: dict[str, Column] = {
    name: get_args(hint)[1] for name, hint in get_type_hints(Sample, include_extras=True).items() if name != "user_energies"
}


def user_columns(user_terms: Sequence[str]) -> dict[str, Column]:
    """The columns of the user's own forces."""
    return {name: Column(f"{name} (kJ/mole)", "kJ/mol", f"energy of the force {name}") for name in user_terms}


NUMBERS = [name for name in COLUMNS if name != "stage_name"]


class Samples:
    """The samples of a run in order, kept as a row of float64 each.

    stages : names of all stages
    user_terms : names of the user's own forces, whose energies are columns too
    table : of an earlier `table()`; raises ValueError if it is none
    """

    def __init__(self, stages: Sequence[str], user_terms: tuple[str, ...] = (), table: np.ndarray | None = None):
        self.stages, self.user_terms = tuple(stages), user_terms
        self._numbers = [*NUMBERS, *user_terms]
        self._values = array("d")  # it grows in place, in the machine's memory as NumPy has it
        if table is not None:
            if table.ndim != 2 or table.shape[1] != len(self._numbers) or table.dtype != np.float64:
                raise ValueError(f"samples have the shape {table.shape}")
            self._values.frombytes(table.tobytes())
            if not np.isin(self._column("stage"), np.arange(len(self.stages))).all():
                raise ValueError("samples are of stages that the scene does not have")
            step = self._column("step")
            if not ((np.abs(step) < 2**53) & (np.floor(step) == step)).all():
                raise ValueError("samples have steps that are not whole numbers")

    def __repr__(self) -> str:
        return f"<Samples: {len(self)} of {', '.join(self.described)}>"

    def append(self, sample: Sample) -> None:
        """Add a sample at the end."""
        self._values.extend((*_VALUES(sample), *sample.user_energies))

    def __len__(self) -> int:
        return len(self._values) // len(self._numbers)

    def __getitem__(self, column: str) -> np.ndarray:
        """A column as an array (rows,), by the name of a field of `Sample`, in the unit of the log."""
        if column not in self.described:
            raise KeyError(f"no column {column!r}; there are {', '.join(self.described)}")
        if column == "stage_name":
            return np.array(self.stages)[self["stage"]]
        return self._column(column).astype(int if column in ("step", "stage") else float)  # a copy

    def __iter__(self) -> Iterator[Sample]:
        return map(self.row, range(len(self)))

    @property
    def rows(self) -> list[Sample]:
        """All samples, which take five times the memory of the table."""
        return list(self)

    def row(self, k: int) -> Sample:
        """Sample k; -1 is the last one."""
        first, width = range(len(self))[k] * len(self._numbers), len(NUMBERS)
        values: dict[str, Any] = dict(zip(NUMBERS, self._values[first : first + width], strict=True))
        values |= {name: int(values[name]) for name in ("step", "stage")}
        energies = self._values[first + width : first + len(self._numbers)]
        return Sample(**values, stage_name=self.stages[values["stage"]], user_energies=tuple(energies))

    def latest(self, time: float, since: int) -> int:
        """The last row from `since` on that is not later than a time (ps); `since` if there is none."""
        width, at = len(self._numbers), self._numbers.index("time")
        rows = range(len(self))
        return max(since, bisect_right(rows, time, lo=since, key=lambda k: self._values[k * width + at]) - 1)

    def of_stage(self, k: int) -> "Samples":
        """The samples of stage k, which follow one another."""
        found, width = Samples(self.stages, self.user_terms), len(self._numbers)
        if len(rows := np.flatnonzero(self._column("stage") == k)):
            found._values = self._values[rows[0] * width : (rows[-1] + 1) * width]
        return found

    def table(self) -> np.ndarray:
        """All numbers (rows, columns) as float64, which holds every one of them: a copy."""
        return np.array(self._values, float).reshape(-1, len(self._numbers))

    def _column(self, name: str) -> np.ndarray:
        """A view, which must be gone before the next sample comes."""
        return np.asarray(self._values)[self._numbers.index(name) :: len(self._numbers)]

    @property
    def described(self) -> dict[str, Column]:
        return COLUMNS | user_columns(self.user_terms)


_VALUES = attrgetter(*NUMBERS)


def moving(stages: Sequence[Stage], of: np.ndarray) -> np.ndarray:
    """Which samples (n,), of stages with these indices, are of motion: none of minimisations."""
    return ~np.isin(of, [k for k, stage in enumerate(stages) if stage.is_minimisation])
