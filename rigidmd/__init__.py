"""rigidmd: molecular dynamics of rigid molecules, and the motion of single rigid bodies.

import rigidmd

scene = rigidmd.Scene.read("water.toml")
results = rigidmd.Simulation(scene).run()
print(results["temperature"].mean(), results.units["temperature"], results.universe())

with rigidmd.Simulation(scene) as simulation:
    simulation.step(100)  # the first 100 steps; simulation.run() would run the rest
    print(simulation.state.time, simulation.state.position)
"""

from importlib import import_module
from typing import TYPE_CHECKING

from rigidmd.core.display import PROVIDERS

if TYPE_CHECKING:
    from rigidmd import analysis, view
    from rigidmd.assemble.scenes import atoms_of, resolve, scene_from_atoms
    from rigidmd.assemble.user_code.force import Force
    from rigidmd.assemble.user_code.pair_potential import PairLaw, pair_law
    from rigidmd.assemble.user_code.trust import trust
    from rigidmd.dynamics.user_kernels import compiled_force, compiled_thermostat
    from rigidmd.run import Every, Moment, Observer, Results, Simulation, run_together
    from rigidmd.scene import BodyScene, MolecularScene, Scene
    from rigidmd.scene.integrators import integrator
    from rigidmd.studies.normal_modes import normal_modes
    from rigidmd.studies.stored_runs import read_run
    from rigidmd.studies.sweep.sweeping import sweep
    from rigidmd.studies.sweep.windows import pmf
    from rigidmd.view.plots import LivePlot

    __version__: str

#: Public name -> the module that has it, loaded at first use, so that `rigidmd --help` need not
#: wait for Numba.
_HOMES = {
    "BodyScene": "scene",
    "MolecularScene": "scene",
    "Scene": "scene",
    "Every": "run",
    "Moment": "run",
    "Observer": "run",
    "Results": "run",
    "Simulation": "run",
    "run_together": "run",
    "resolve": "assemble.scenes",
    "atoms_of": "assemble.scenes",
    "scene_from_atoms": "assemble.scenes",
    "Force": "assemble.user_code.force",
    "trust": "assemble.user_code.trust",
    "PairLaw": "assemble.user_code.pair_potential",
    "pair_law": "assemble.user_code.pair_potential",
    "integrator": "scene.integrators",
    "compiled_force": "dynamics.user_kernels",
    "compiled_thermostat": "dynamics.user_kernels",
    "LivePlot": "view.plots",
    "read_run": "studies.stored_runs",
    "sweep": "studies.sweep.sweeping",
    "normal_modes": "studies.normal_modes",
    "pmf": "studies.sweep.windows",
    "analysis": "",
    "view": "",
}
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
    "atoms_of",
    "compiled_force",
    "compiled_thermostat",
    "integrator",
    "normal_modes",
    "pair_law",
    "pmf",
    "read_run",
    "resolve",
    "run_together",
    "scene_from_atoms",
    "sweep",
    "trust",
    "view",
]

PROVIDERS += ["rigidmd.view.notebook", "rigidmd.studies.sweep.notebook"]


def __getattr__(name: str) -> object:
    if name == "__version__":
        from importlib.metadata import version

        return version("rigidmd")
    if name not in _HOMES:
        raise AttributeError(f"module 'rigidmd' has no attribute {name!r}")
    home = _HOMES[name]
    return (
        getattr(import_module(f"rigidmd.{home}"), name)
        if home
        else import_module(f"rigidmd.{name}")
    )


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
