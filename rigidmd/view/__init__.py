"""Pictures of finished runs: pages, animations, notebook display. `rigidmd.view.plot(results, "energy")`."""

from typing import TYPE_CHECKING

from rigidmd.run.results import Results

if TYPE_CHECKING:
    from chemiscope.widget import StructureWidget

    from rigidmd.figures.picture import Picture
    from rigidmd.view.notebook import AnimationPage

__all__ = ["plot", "show"]


def plot(results: Results, *columns: str, log: bool = False) -> "Picture":
    """A Matplotlib figure of a run, which a notebook displays and `savefig` writes.

    columns : names of columns, drawn against time, with one panel for each unit; default: the main figure of the run
        (energy.png, or the path of the axis of a body); or the name of another figure of a body ("angles",
        "ellipsoids", "path", "invariants")
    log : absolute values on a logarithmic axis. Raises KeyError
    """
    from rigidmd.view.plots import plot as draw

    return draw(results, columns, log)


def show(results: Results) -> "StructureWidget | AnimationPage":
    """The animation of a run in a notebook: molecules by chemiscope, a body on a small page. Raises ImportError without
    chemiscope, ValueError without a trajectory."""
    from rigidmd.view.notebook import show_animation

    return show_animation(results)
