"""rigidmd: molecular dynamics of rigid molecules, and the motion of single rigid bodies.

import rigidmd

scene = rigidmd.Scene.read("water.toml")
results = rigidmd.Simulation(scene).run()
print(results["temperature"].mean(), results.units["temperature"], results.universe())
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rigidmd.analyse.registry import analysis
    from rigidmd.dynamics.own import compiled_force, compiled_thermostat
    from rigidmd.looking.live import LivePlot
    from rigidmd.own.force import Force
    from rigidmd.own.pair_law import PairLaw, pair_law
    from rigidmd.own.trust import trust
    from rigidmd.run import Every, Moment, Observer, Results, Simulation, run_together
    from rigidmd.scene import BodyScene, MolecularScene, Scene
    from rigidmd.study.sweep.sweeping import sweep

    __version__: str

__all__ = [
    "BodyScene",
    "Every",
    "Force",
    "LivePlot",
    "MolecularScene",
    "Moment",
    "Observer",
    "PairLaw",
    "Results",
    "Scene",
    "Simulation",
    "analysis",
    "compiled_force",
    "compiled_thermostat",
    "pair_law",
    "run_together",
    "sweep",
    "trust",
]

#: The module in which each of them is.
_HOMES = (
    dict.fromkeys(("BodyScene", "MolecularScene", "Scene"), "scene")
    | dict.fromkeys(("Every", "Moment", "Observer", "Results", "Simulation", "run_together"), "run")
    | dict.fromkeys(("compiled_force", "compiled_thermostat"), "dynamics.own")
    | dict.fromkeys(("PairLaw", "pair_law"), "own.pair_law")
    | {
        "Force": "own.force",
        "LivePlot": "looking.live",
        "analysis": "analyse.registry",
        "sweep": "study.sweep.sweeping",
        "trust": "own.trust",
    }
)


def __getattr__(name: str) -> object:
    # Loaded when asked for, so that `rigidmd --help` need not wait for Numba and MDAnalysis.
    if name == "__version__":
        from importlib.metadata import version

        return version("rigidmd")
    if name in _HOMES:
        return getattr(import_module(f"rigidmd.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'rigidmd' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
