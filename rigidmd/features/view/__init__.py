"""Pictures of finished runs: pages, animations, notebook display. `rigidmd.view.plot(results,
"energy")`."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rigidmd.features.view.notebook import show
    from rigidmd.features.view.plots import plot

__all__ = ["plot", "show"]


def __getattr__(name: str) -> object:
    """The public functions, loaded at first use, because Matplotlib is slow to import."""
    if name not in __all__:
        raise AttributeError(f"module 'rigidmd.view' has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{'plots' if name == 'plot' else 'notebook'}"), name)


def __dir__() -> list[str]:
    return __all__
