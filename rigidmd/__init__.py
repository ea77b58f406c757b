"""rigidmd: molecular dynamics of rigid molecules, and the motion of single rigid bodies.

import rigidmd

scene = rigidmd.Scene.read("systems/water.toml")
results = rigidmd.Simulation(scene).run()
print(results["temperature"].mean(), results.universe())
"""

from importlib import import_module

__all__ = ["Every", "Results", "Scene", "Simulation"]

_HOMES = {"Scene": "scene", "Simulation": "simulation", "Results": "simulation", "Every": "simulation"}


def __getattr__(name: str):
    # Loaded when asked for, so that `rigidmd --help` need not wait for Numba and MDAnalysis.
    if name == "__version__":
        from importlib.metadata import version

        return version("rigidmd")
    if name in _HOMES:
        return getattr(import_module(f"rigidmd.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'rigidmd' has no attribute {name!r}")


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
