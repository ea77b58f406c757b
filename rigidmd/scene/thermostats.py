"""The thermostats of scenes: their names, keys and descriptions. Their flows are in `dynamics.thermostats`."""

from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

from pydantic import Field, Strict

from rigidmd.scene.validation import NameIn, Positive, Section

#: Values of keys by their names.
Values = dict[str, float]


class Thermostat(NamedTuple):
    """What scenes and reports know of a thermostat."""

    summary: str  # for the description of the key `thermostat`
    source: str
    #: Whether it acts on each molecule by itself: the total momentum is not conserved, diffusion and spectra change.
    on_molecules: bool
    keys: dict[str, float | Callable[[Any], float]]  # its keys -> their defaults, or functions of the stage
    time: Callable[[Values], float] = lambda values: values["thermostat_time_ps"]  # time constant, ps
    description: Callable[[Values], str] = lambda values: f"{values['thermostat_time_ps']:g} ps"  # for reports

    def values(self, stage: Any) -> Values:
        """The values of its keys in a stage."""
        return {key: getattr(stage, key) or default_of(default, stage) for key, default in self.keys.items()}


def default_of(default: float | Callable[[Any], float], stage: Any) -> float:
    return default(stage) if callable(default) else default


def _describe_frictions(values: Values) -> str:
    translation, rotation = values.values()
    return f"friction {translation:g}/ps" + (f" ({rotation:g}/ps of rotation)" if rotation != translation else "")


THERMOSTATS = {
    "velocity_rescaling": Thermostat(
        "stochastic, by Bussi et al.", "Bussi, Donadio & Parrinello 2007, J. Chem. Phys. 126, 014101", False,
        {"thermostat_time_ps": 0.1},
    ),
    "langevin": Thermostat(
        "friction and noise", "Davidchack, Ouldridge & Tretyakov 2015, J. Chem. Phys. 142, 144114", True,
        {"friction_translation_per_ps": 1.0,
         "friction_rotation_per_ps": lambda stage: stage.friction_translation_per_ps or 1.0},
        time=lambda values: 1 / min(values.values()), description=_describe_frictions,
    ),
    "nose_hoover": Thermostat(
        "one chain for translation and one for rotation",
        "Martyna, Tuckerman, Tobias & Klein 1996, Mol. Phys. 87, 1117", False,
        {"thermostat_time_ps": 0.5, "nose_hoover_links": 3},
    ),
    "andersen": Thermostat(
        "collisions", "Andersen 1980, J. Chem. Phys. 72, 2384", True, {"thermostat_time_ps": 1.0},
    ),
}  # fmt: skip


DEFAULT = "velocity_rescaling"


class ThermostatKeys(Section):
    """The keys of thermostats in a stage."""

    thermostat: Annotated[str, NameIn(THERMOSTATS)] | None = Field(
        default=None,
        description="; ".join(f"{name}: {kind.summary}" for name, kind in THERMOSTATS.items())
        + f". Default: langevin with baoab, else {DEFAULT}",
    )
    thermostat_time_ps: Positive | None = None
    """Time constant of velocity_rescaling (default: 0.1 ps), period of nose_hoover (0.5 ps), or mean time between two
    collisions of a molecule with andersen (1 ps)"""
    friction_translation_per_ps: Positive | None = None
    """Friction of langevin on translation; default: 1"""
    friction_rotation_per_ps: Positive | None = None
    """Friction of langevin on rotation; default: friction_translation_per_ps"""
    nose_hoover_links: Annotated[int, Strict(), Field(ge=1, le=100)] = 3
    """Links of each Nose-Hoover chain"""
