"""rigidmd: molecular dynamics of rigid molecules, and the motion of single rigid bodies.

import rigidmd

scene = rigidmd.Scene.read("systems/water.toml")
results = rigidmd.Simulation(scene).run()
print(results["temperature"].mean(), results.units["temperature"], results.universe())
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rigidmd.analyse.registry import analysis
    from rigidmd.run import Every, Moment, Results, Simulation
    from rigidmd.scene import BodyScene, MolecularScene, Scene

    __version__: str

__all__ = ["BodyScene", "Every", "MolecularScene", "Moment", "Results", "Scene", "Simulation", "analysis"]

_HOMES = {name: "scene" if name.endswith("Scene") else "run" for name in __all__} | {"analysis": "analyse.registry"}


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
