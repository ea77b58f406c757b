"""Samples of a run of molecules, kept as rows and read as columns."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, NamedTuple, get_args, get_type_hints

import numpy as np

from rigidmd.measure.columns import Column
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
    orthogonality: Annotated[float, Column("Orthogonality error", "1", "largest entry of abs(QᵀQ - 1)")]
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
    own: tuple[float, ...] = ()  # energies of the user's own forces, kJ/mol

    def value(self, name: str, own: Sequence[str]) -> float | int | str:
        """The value of a column; `own` are the names of the user's own forces."""
        return self.own[own.index(name)] if name in own else getattr(self, name)


COLUMNS: dict[str, Column] = {
    name: get_args(hint)[1] for name, hint in get_type_hints(Sample, include_extras=True).items() if name != "own"
}


def own_columns(own: Sequence[str]) -> dict[str, Column]:
    """The columns of the user's own forces."""
    return {name: Column(f"{name} (kJ/mole)", "kJ/mol", f"energy of the force {name}") for name in own}


NUMBERS = [name for name in COLUMNS if name != "stage_name"]


@dataclass
class Samples:
    """The rows of a run, in order."""

    rows: list[Sample] = field(default_factory=list)
    own: tuple[str, ...] = ()  # names of the user's own forces, whose energies are columns too

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, column: str) -> np.ndarray:
        """A column as an array (rows,), by the name of a field of `Sample`, in the unit of the log."""
        if column not in self.described:
            raise KeyError(f"no column {column!r}; there are {', '.join(self.described)}")
        return np.array([row.value(column, self.own) for row in self.rows])

    def table(self) -> np.ndarray:
        """All numbers (rows, columns) as float64, which holds every one of them; for `of_table`."""
        numbers = [*NUMBERS, *self.own]
        return np.array([[float(row.value(name, self.own)) for name in numbers] for row in self.rows]).reshape(
            -1, len(numbers)
        )

    @classmethod
    def of_table(cls, table: np.ndarray, stages: Sequence[str], own: tuple[str, ...] = ()) -> "Samples":
        """The rows of a table; `stages` are the names of all stages, `own` those of the user's own forces.

        Raises ValueError if it is no such table.
        """
        if table.ndim != 2 or table.shape[1] != len(NUMBERS) + len(own):
            raise ValueError(f"samples have the shape {table.shape}")
        rows = []
        for values in table.tolist():
            row = dict(zip(NUMBERS, values[: len(NUMBERS)], strict=True))
            row |= {name: int(row[name]) for name in ("step", "stage")}
            rows.append(Sample(**row, stage_name=stages[int(row["stage"])], own=tuple(values[len(NUMBERS) :])))
        return cls(rows, own)

    @property
    def described(self) -> dict[str, Column]:
        """Name -> column."""
        return COLUMNS | own_columns(self.own)


def moving(stages: Sequence[Stage], of: np.ndarray) -> np.ndarray:
    """Which samples (n,), of stages with these indices, are of motion: none of minimisations."""
    return ~np.isin(of, [k for k, stage in enumerate(stages) if stage.is_minimisation])
