"""Andersen's thermostat in scenes."""

from rigidmd.scene.ensemble_methods import StageKeys, Thermostat, Values


class Andersen(Thermostat):
    name = "andersen"
    summary = "collisions"
    source = "Andersen 1980, J. Chem. Phys. 72, 2384"
    time_is = "mean time between two collisions of a molecule with andersen (1 ps)"
    on_molecules = True

    def defaults(self, stage: StageKeys) -> Values:
        return {"thermostat_time_ps": 1.0}

    def rates(self, values: Values) -> tuple[float, float]:
        return 1 / self.time(values), 1 / self.time(values)


METHOD = Andersen()
