"""Stochastic cell rescaling in scenes."""

from rigidmd.scene.ensemble_methods import (
    BAROSTAT_TIME,
    Barostat,
    StageKeys,
    Values,
    default_interval,
)


class CellRescaling(Barostat):
    name = "cell_rescaling"
    summary = "stochastic cell rescaling, made exact by a Metropolis test"
    source = "Bernetti & Bussi 2020, J. Chem. Phys. 153, 114107"
    time_is = "time constant of cell_rescaling"
    relaxes_in_moves = True
    reads_momenta = True
    is_default = True

    def defaults(self, stage: StageKeys) -> Values:
        return {"barostat_time_ps": BAROSTAT_TIME, "barostat_interval_ps": default_interval(stage)}


METHOD = CellRescaling()
