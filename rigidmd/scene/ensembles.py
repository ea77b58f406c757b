"""The thermostats and barostats that scenes may name, and their keys."""

from collections.abc import Iterable, Sequence
from importlib import import_module
from pkgutil import iter_modules
from textwrap import fill
from types import ModuleType
from typing import Annotated, TypeVar

from pydantic import Field

from rigidmd.features import modules
from rigidmd.scene import barostats, thermostats
from rigidmd.scene.ensemble_methods import Barostat, EnsembleMethod, Shapes, Thermostat
from rigidmd.scene.validation import NameIn, Number, Positive, Section

Six = tuple[float, float, float, float, float, float]

#: Compressibility of water at 298 K and 1 bar, 1/bar.
COMPRESSIBILITY = 4.5e-5


def _methods_of(package: ModuleType) -> list:
    """The METHOD of each file of a package, from the newest one on, and then of features."""
    of_core = [
        import_module(f"{package.__name__}.{file.name}").METHOD
        for file in iter_modules(package.__path__)
    ]
    kind = package.__name__.rpartition(".")[2]
    of_features = [import_module(module).METHOD for _, module in modules(kind)]
    return [*sorted(of_core, key=lambda method: -method.year), *of_features]


_THERMOSTATS: list[Thermostat] = _methods_of(thermostats)
_BAROSTATS: list[Barostat] = _methods_of(barostats)
#: Name -> thermostat, the default first.
THERMOSTATS = {
    kind.name: kind for kind in sorted(_THERMOSTATS, key=lambda kind: not kind.is_default)
}
DEFAULT_THERMOSTAT = next(iter(THERMOSTATS))
#: Name -> barostat.
BAROSTATS = {kind.name: kind for kind in _BAROSTATS}


def in_lines(text: str) -> str:
    """A description in the lines of a docstring."""
    return fill(text, 95, initial_indent=3 * " ").lstrip()


def _times(methods: Iterable[EnsembleMethod]) -> str:
    """What the common key of times is to each method."""
    *first, last = [method.time_is for method in methods if method.time_is]
    text = f"{', '.join(first)}, or {last}"
    return in_lines(text[0].upper() + text[1:])


class CommonThermostatKeys(Section):
    """The keys of several thermostats in a stage."""

    thermostat: Annotated[str, NameIn(THERMOSTATS)] | None = Field(
        default=None,
        description="; ".join(f"{name}: {kind.summary}" for name, kind in THERMOSTATS.items())
        + f". Default: {DEFAULT_THERMOSTAT}",
    )
    thermostat_time_ps: Positive | None = Field(
        default=None, description=_times(THERMOSTATS.values())
    )


class CommonBarostatKeys(Section):
    """The keys of several barostats in a stage."""

    pressure_bar: Number | tuple[Number, Number] | tuple[Number, Number, Number] | Six | None = None
    """Pressure of the barostat, or of the minimisation of the enthalpy. Use two values for a linear
    change over the stage, [1, 1000], three values for the pressures along the axes, or six values
    for the tensor xx, yy, zz, xy, xz, yz"""
    pressure_coupling: Shapes = "isotropic"
    """How the box changes. isotropic: it keeps its shape. semi_isotropic: x and y together, z
    separately. anisotropic: three edges. flexible: edges and angles. normal: z alone, at constant
    area. lateral: x and y together, z is kept"""
    barostat: Annotated[str, NameIn(BAROSTATS)] | None = Field(
        default=None,
        description="; ".join(
            f"{name}, of {kind.ensembles[0]}: {kind.summary}" for name, kind in BAROSTATS.items()
        )
        + ". Default: the first one of the ensemble",
    )
    barostat_time_ps: Positive | None = Field(
        default=None, description=f"{_times(BAROSTATS.values())}. Default: 1 ps"
    )
    barostat_interval_ps: Positive | None = None
    """Time between two box moves in npt. Default: 0.05 of barostat_time_ps"""
    compressibility_per_bar: Positive | None = None
    """Compressibility. It sets how fast the box changes, but not the ensemble. Default: 4.5e-5, the
    value for water"""


Common = TypeVar("Common", bound=Section)


def _with_keys_of(methods: Sequence[EnsembleMethod], common: type[Common]) -> type[Common]:
    """A section with the common keys, and then those that each method has."""
    keys = [method.keys for method in methods if method.keys is not None]
    return type(common)(common.__name__, (*reversed(keys), common), {"__module__": __name__})


#: The keys of a stage.
ThermostatKeys = _with_keys_of([*THERMOSTATS.values()], CommonThermostatKeys)
BarostatKeys = _with_keys_of([*BAROSTATS.values()], CommonBarostatKeys)
