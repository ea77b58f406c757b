"""The piston of constant enthalpy in scenes."""

from rigidmd.core.integrators import Scheme
from rigidmd.scene.ensemble_methods import BAROSTAT_TIME, Barostat, StageKeys, Values


class Piston(Barostat):
    name = "piston"
    summary = "a volume with inertia and without friction"
    source = "Andersen 1980, J. Chem. Phys. 72, 2384"
    time_is = "period of the piston of nph"
    ensembles = ("nph",)
    shapes = ("isotropic",)
    in_verlet_steps = True
    oscillates = True
    reads_momenta = True
    is_default = True

    @property
    def title(self) -> str:
        return "a piston"

    def defaults(self, stage: StageKeys) -> Values:
        return {"barostat_time_ps": BAROSTAT_TIME}

    def joined(self, scheme: Scheme, barostat: tuple, stage: StageKeys) -> Scheme:
        return scheme.with_piston(barostat)


METHOD = Piston()
