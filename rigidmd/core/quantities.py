"""The table of quantities of runs: what is sampled, averaged and shown, and how.

A row is all that a quantity takes: the log, `results[...]`, the summary, reports, pages and sweeps
read this table. A name in Python has no unit. A header is a title with the unit.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from math import hypot, inf, isfinite, nan

from rigidmd.core.state import HEAT, NOW, WORK
from rigidmd.core.user_warnings import warn_renamed
from rigidmd.units import GRAM_PER_CM3


@dataclass(frozen=True)
class Mean:
    """Where the mean of a quantity over a stage is shown, with its error.

    key : in summary.json, with {} where the key of the error has "_error"
    unit : where it is not the unit of the samples
    title : of its row in the full report; None for no row. Means with the same title are one row,
        each after its `label`
    short : the same in the short report, by default the title without a label
    digits : decimals of a mean without an error, `short_digits` in the short report
    set_point : key of the set point in summary.json
    order : in summary and reports
    per_molecule : whether the sum over all molecules is divided by their number
    header : in the table of a sweep, where it is not the header of the samples; `brief` where the
        table is printed
    is_main : whether that table has it where it is printed and drawn
    """

    key: str
    title: str | None = None
    unit: str = ""
    label: str = ""
    short: str = ""
    digits: int = 3
    short_digits: int | None = None
    set_point: str = ""
    order: int = 9
    per_molecule: bool = False
    header: str = ""
    brief: str = ""
    is_main: bool = False


#: Units in ASCII, as headers have them.
IN_ASCII = str.maketrans({"Å": "A", "²": "^2", "³": "^3", "°": "deg"})


@dataclass(frozen=True)
class Quantity:
    """A quantity, one value for each sample.

    title : of its column in the file of samples; empty for one that is not written
    unit : "1" for plain numbers, empty for text
    of : its value for an `engines.observables.Observation`. Default: the attribute of its name
    is_averaged : whether its mean has a meaning
    of_tensor : whether log.csv has it on request, and pressure_tensor.csv has it
    of_box : whether its mean is shown of stages that change the box only
    mean : where its mean is shown; of one that is not averaged, where its drift is shown
    gradient : its gradient over the gradient of the potential energy; NaN where it is unknown
    kinetic : the motions whose kinetic energy it contains
    former : its name in the version before
    """

    name: str  # in Python
    title: str
    unit: str
    about: str
    of: Callable[..., float | str] | None = None
    is_averaged: bool = True
    of_tensor: bool = False
    of_box: bool = False
    mean: Mean | None = None
    gradient: float = nan
    kinetic: tuple[str, ...] = ()
    former: str = ""

    @property
    def header(self) -> str:
        """The header of its column, such as "Box Volume (nm^3)"."""
        has_unit = self.title and self.unit not in ("", "1")
        return f"{self.title} ({self.unit.translate(IN_ASCII)})" if has_unit else self.title

    @property
    def mean_header(self) -> str:
        """The header of its mean in the table of a sweep."""
        return (self.mean and self.mean.header) or self.header

    def value(self, observation: object) -> float | str:
        return self.of(observation) if self.of else getattr(observation, self.name)


def current_name(name: str, described: Mapping[str, Quantity]) -> str:
    """The name of a quantity by this name, or by its former one."""
    if name not in described:
        for row in described.values():
            if row.former and row.former == name:
                warn_renamed(name, row.name)
                return row.name
    return name


#: Motions of molecules, each with a kinetic energy and degrees of freedom.
MOTIONS = ("translation", "rotation")


def energy_of_force(name: str) -> Quantity:
    """The energy of a user-defined force."""
    return Quantity(
        name,
        name,
        "kJ/mol",
        f"energy of the force {name}",
        lambda o: o.energies[name] / o.energy_unit,
    )


def restrained_distance(k: object, of: Callable[..., float] | None = None) -> Quantity:
    """The distance that fields.restraints.k restrains."""
    about = f"distance of the groups of fields.restraints.{k}"
    return Quantity(f"distance_{k}", f"Distance {k}", "Å", about, of)


def _edge(name: str, k: int) -> Quantity:
    about = f"length of the box's edge {name}"
    return Quantity(
        name,
        name,
        "Å",
        about,
        lambda o: o.edges[k],
        of_box=True,
        mean=Mean(f"{name}{{}}_A", "box", label=name),
        gradient=0.0,
    )


def _angle(name: str, between: str, k: int) -> Quantity:
    about = f"angle between {between}"
    return Quantity(name, name, "°", about, lambda o: o.edges[k], of_box=True)


def _pressure(axes: str, about: str) -> Quantity:
    i, j = map("xyz".index, axes)
    return Quantity(
        f"pressure_{axes}",
        f"Pressure {axes}",
        "bar",
        about,
        lambda o: float(o.pressure_tensor[i, j]),
        of_tensor=True,
    )


def _volume(o) -> float:
    return o.state.volume * 1e-3 if o.state.volume < inf else nan


def _density(o) -> float:
    volume = o.state.volume
    return o.system.mass / volume / GRAM_PER_CM3 if volume < inf else nan


def _sum(name: str) -> Callable[..., float]:
    def of(o) -> float:
        value = getattr(o.sums, name)
        return value / o.energy_unit if isfinite(value) else nan

    return of


#: A row whose mean has no meaning.
_unaveraged = partial(Quantity, is_averaged=False)
#: Of all scenes, in the order of log.csv, whose first columns are those of OpenMM.
QUANTITIES = {
    row.name: row
    for row in (
        _unaveraged(
            "step",
            "Step",
            "1",
            "steps since the start",
            lambda o: int(o.state.step[NOW]),
        ),
        _unaveraged("time", "Time", "ps", "time since the start"),
        Quantity(
            "potential",
            "Potential Energy",
            "kJ/mol",
            "potential energy of the whole system",
            mean=Mean(
                "potential{}_kJ_mol_per_molecule",
                "potential",
                "kJ/mol per molecule",
                short="potential energy",
                order=3,
                per_molecule=True,
                header="Potential Energy per molecule (kJ/mol)",
                brief="U per molecule (kJ/mol)",
                is_main=True,
            ),
            gradient=1.0,
        ),
        Quantity(
            "kinetic",
            "Kinetic Energy",
            "kJ/mol",
            "kinetic energy, translation and rotation",
            kinetic=MOTIONS,
        ),
        Quantity(
            "energy",
            "Total Energy",
            "kJ/mol",
            "potential and kinetic energy",
            kinetic=MOTIONS,
        ),
        Quantity(
            "temperature",
            "Temperature",
            "K",
            "temperature of all motion",
            mean=Mean(
                "temperature{}_K",
                "temperature",
                digits=2,
                short_digits=1,
                set_point="set_temperature_K",
                order=0,
                is_main=True,
            ),
            kinetic=MOTIONS,
        ),
        Quantity(
            "volume",
            "Box Volume",
            "nm³",
            "volume of the box",
            _volume,
            of_box=True,
            gradient=0.0,
        ),
        Quantity(
            "density",
            "Density",
            "g/cm³",
            "mass density",
            _density,
            of_box=True,
            mean=Mean(
                "density{}_g_cm3",
                "density",
                digits=4,
                order=5,
                brief="Density (g/cm³)",
                is_main=True,
            ),
            gradient=0.0,
        ),
        _unaveraged("stage_name", "Stage", "", "name of the stage"),
        Quantity(
            "temperature_translation",
            "T_trans",
            "K",
            "temperature of translation",
            mean=Mean(
                "temperature_translation{}_K",
                "",
                label="T_trans",
                short="  translational",
                digits=2,
                short_digits=1,
                order=1,
            ),
            kinetic=MOTIONS[:1],
        ),
        Quantity(
            "temperature_rotation",
            "T_rot",
            "K",
            "temperature of rotation",
            mean=Mean(
                "temperature_rotation{}_K",
                "",
                label="T_rot",
                short="  rotational",
                digits=2,
                short_digits=1,
                order=2,
            ),
            kinetic=MOTIONS[1:],
        ),
        Quantity(
            "pressure",
            "Pressure",
            "bar",
            "molecular pressure, with the tail correction and kB T/V of a total momentum that is"
            " kept at zero",
            mean=Mean(
                "pressure{}_bar",
                "pressure",
                digits=0,
                set_point="set_pressure_bar",
                order=4,
                is_main=True,
            ),
            kinetic=MOTIONS[:1],
            former="pressure_bar",
        ),
        _unaveraged(
            "drift",
            "Drift",
            "kJ/mol",
            "change of `conserved` since the stage began",
            lambda o: o.conserved - (o.conserved if o.origin is None else o.origin),
            mean=Mean(
                "drift{}_kT_ns_per_degree_of_freedom",
                unit="kT/ns per degree of freedom",
                short="energy drift",
                digits=4,
                header="Drift (kT/ns per degree of freedom)",
                brief="drift (kT/ns/DOF)",
                is_main=True,
            ),
        ),
        _unaveraged(
            "momentum",
            "Momentum",
            "u Å/ps",
            "size of the total momentum",
            lambda o: hypot(*o.sums.momentum.tolist()),
        ),
        _unaveraged(
            "orthogonality_error",
            "Orthogonality error",
            "1",
            "largest entry of abs(QᵀQ - 1)",
            lambda o: o.sums.orthogonality_error,
        ),
        _edge("a", 0),
        _edge("b", 1),
        _edge("c", 2),
        _angle("alpha", "b and c", 3),
        _angle("beta", "c and a", 4),
        _angle("gamma", "a and b", 5),
        _unaveraged(
            "heat",
            "Heat",
            "kJ/mol",
            "heat that thermostats have added since the start",
            lambda o: float(o.ledger[HEAT]),
        ),
        _unaveraged(
            "work",
            "Work",
            "kJ/mol",
            "work of barostats, drives and minimisations so far",
            lambda o: float(o.ledger[WORK]),
        ),
        _pressure("xx", "molecular pressure tensor, symmetric part"),
        *(_pressure(axes, f"the same, {axes}") for axes in ("yy", "zz", "xy", "xz", "yz")),
        _unaveraged(
            "conserved",
            "",
            "kJ/mol",
            "energy less heat, work and the energy of removed momentum",
        ),
        _unaveraged("stage", "", "1", "index of the stage, from 0"),
        _unaveraged(
            "force_squares",
            "F^2/m",
            "kJ/mol/ps²",
            "sum of F²/m of all molecules",
            _sum("force"),
        ),
        _unaveraged(
            "torque_squares",
            "n^2/I",
            "kJ/mol/ps²",
            "the same of torques n",
            _sum("torque"),
        ),
        _unaveraged(
            "curvature",
            "v U'' v",
            "kJ/mol/ps²",
            "second derivative of the potential energy along free flight and free rotation, in the"
            " middle of the step before",
            _sum("curvature"),
        ),
    )
}


def with_means(described: Mapping[str, Quantity] = QUANTITIES) -> list[tuple[Quantity, Mean]]:
    """The quantities whose means are shown, in the order of summary and reports."""
    rows = [(row, row.mean) for row in described.values() if row.mean]
    return sorted(rows, key=lambda pair: pair[1].order)
