"""Nose-Hoover chains in scenes."""

from typing import Annotated

from pydantic import Field, Strict

from rigidmd.scene.ensemble_methods import StageKeys, Thermostat, Values
from rigidmd.scene.validation import Section


class NoseHooverKeys(Section):
    nose_hoover_links: Annotated[int, Strict(), Field(ge=1, le=100)] = 3
    """Links of each Nose-Hoover chain"""


class NoseHoover(Thermostat):
    name = "nose_hoover"
    summary = "one chain for translation and one for rotation"
    source = "Martyna, Tuckerman, Tobias & Klein 1996, Mol. Phys. 87, 1117"
    keys = NoseHooverKeys
    time_is = "period of nose_hoover (0.5 ps)"
    oscillates = True

    def defaults(self, stage: StageKeys) -> Values:
        return {"thermostat_time_ps": 0.5, "nose_hoover_links": 3}


METHOD = NoseHoover()
