"""Pictures of finished runs: pages, animations, notebook display. `rigidmd.view.plot(results, "energy")`."""

from typing import TYPE_CHECKING

from rigidmd.run.results import Results

if TYPE_CHECKING:
    from chemiscope.widget import StructureWidget

    from rigidmd.figures.picture import Picture
    from rigidmd.view.inline import Film

__all__ = ["plot", "show"]


def plot(results: Results, *columns: str, log: bool = False) -> "Picture":
    """A Matplotlib figure of a run, which a notebook displays and `savefig` writes.

    columns : names of columns, drawn against time, those of one unit in one panel; log: absolute values on a
    logarithmic axis. Without names it is the main figure of the run: energy.png, of a body the path of its axis. The
    name of another figure of a body ("angles", "ellipsoids", "path", "invariants") draws that one. Raises KeyError.
    """
    from rigidmd.view.columns import plot as draw

    return draw(results, columns, log)


def show(results: Results) -> "StructureWidget | Film":
    """The animation of a run in a notebook: molecules by chemiscope, a body on a small page.

    Raises ImportError without chemiscope (rigidmd[view]), ValueError without a trajectory.
    """
    from rigidmd.view.inline import view

    return view(results)
