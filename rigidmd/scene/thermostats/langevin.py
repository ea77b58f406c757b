"""Langevin's thermostat in scenes."""

from rigidmd.scene.ensemble_methods import StageKeys, Thermostat, Values
from rigidmd.scene.validation import Positive, Section


class LangevinKeys(Section):
    friction_translation_per_ps: Positive | None = None
    """Friction that langevin applies to translation. Default: 1"""
    friction_rotation_per_ps: Positive | None = None
    """Friction that langevin applies to rotation. Default: friction_translation_per_ps"""


class Langevin(Thermostat):
    name = "langevin"
    summary = "friction and noise"
    source = "Davidchack, Ouldridge & Tretyakov 2015, J. Chem. Phys. 142, 144114"
    keys = LangevinKeys
    on_molecules = True

    def defaults(self, stage: StageKeys) -> Values:
        assert isinstance(stage, LangevinKeys)
        return {
            "friction_translation_per_ps": 1.0,
            "friction_rotation_per_ps": stage.friction_translation_per_ps or 1.0,
        }

    def time(self, values: Values) -> float:
        return 1 / min(values.values())

    def rates(self, values: Values) -> tuple[float, float]:
        translation, rotation = values.values()
        return 2 * translation, 2 * rotation

    def describe(self, values: Values) -> str:
        translation, rotation = values.values()
        also = f" ({rotation:g}/ps of rotation)" if rotation != translation else ""
        return f"friction {translation:g}/ps{also}"


METHOD = Langevin()
