"""Stochastic velocity rescaling in scenes."""

from rigidmd.scene.ensemble_methods import StageKeys, Thermostat, Values


class VelocityRescaling(Thermostat):
    name = "velocity_rescaling"
    summary = "stochastic, one of translation and one of rotation, by Bussi et al."
    source = "Bussi, Donadio & Parrinello 2007, J. Chem. Phys. 126, 014101"
    time_is = "time constant of velocity_rescaling (default: 0.05 ps)"
    is_default = True
    halved = False
    by_motion = True

    def defaults(self, stage: StageKeys) -> Values:
        return {"thermostat_time_ps": 0.05}

    def rates(self, values: Values) -> tuple[float, float]:
        return 1 / self.time(values), 1 / self.time(values)


METHOD = VelocityRescaling()
