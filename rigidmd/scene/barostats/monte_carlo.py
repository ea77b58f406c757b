"""Monte Carlo changes of the volume in scenes."""

from rigidmd.scene.ensemble_methods import Barostat, StageKeys, Values, default_interval


class MonteCarlo(Barostat):
    name = "monte_carlo"
    summary = "random changes of the volume"
    source = "Åqvist et al. 2004, Chem. Phys. Lett. 384, 288"
    shapes = ("isotropic",)

    def defaults(self, stage: StageKeys) -> Values:
        return {"barostat_interval_ps": default_interval(stage)}


METHOD = MonteCarlo()
