"""rigidmd: molecular dynamics of rigid molecules, and the motion of single rigid bodies.

Examples
--------
    import rigidmd

    results = rigidmd.Simulation("water.toml").run()
    print(results.mean("temperature"), results["temperature"], results.universe())

    with rigidmd.Simulation("water.toml") as simulation:
        simulation.step(100)  # the first 100 steps. simulation.run() would run the rest
        print(simulation.time, simulation.state.position)

    results = rigidmd.read_run("runs/water")  # of an earlier run
"""

from importlib import import_module

import lazy_loader

from rigidmd.core.display import PROVIDERS
from rigidmd.features import FEATURES

# Public names are loaded at first use, so that `rigidmd --help` need not wait for Numba.
_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)

PROVIDERS += [
    f"{row.package}.{row.display}" for row in FEATURES if row.display and row.is_installed
]
#: Public names that are modules of features.
PACKAGES = {"analysis": "analysis.analysis", "view": "view"}
#: Public name of the version before -> its name now.
FORMER_NAMES = {
    "atoms_of": "to_atoms",
    "integrator": "register_integrator",
    "resolve": "with_defaults",
    "trust": "trust_file",
}


def __getattr__(name: str) -> object:
    if name in PACKAGES:
        return import_module(f"rigidmd.features.{PACKAGES[name]}")
    if name == "__version__":
        from importlib.metadata import version

        return version("rigidmd")
    if name in FORMER_NAMES:
        from rigidmd.core.user_warnings import warn_renamed

        warn_renamed(f"rigidmd.{name}", f"rigidmd.{FORMER_NAMES[name]}")
        return _load(FORMER_NAMES[name])
    return _load(name)
