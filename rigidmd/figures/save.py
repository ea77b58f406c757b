"""Writing figures of Matplotlib: its settings while it draws, and curves of any number of
points."""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise

from rigidmd.core.process import PROCESS_LOCK

#: Most points of a curve that are drawn at once. The renderer fails on 200,000 points across a
#: figure.
AT_ONCE = 5000


class InPieces:
    """A path effect of Matplotlib that draws a path in pieces, each from the end of the previous
    one. The pieces of Matplotlib, `agg.path.chunksize`, omit the last point of each, and thus two
    sides of the path."""

    def draw_path(self, renderer, gc, path, affine, rgbFace=None):
        sides = len(path.vertices) - 1
        # of equal length: a short level one would be snapped to whole pixels
        pieces = -(-sides // (AT_ONCE - 1))
        for first, last in pairwise(sides * k // pieces for k in range(pieces + 1)):
            piece = type(path)(path.vertices[first : last + 1])
            piece.simplify_threshold = path.simplify_threshold
            renderer.draw_path(gc, piece, affine, rgbFace)


@contextmanager
def settings(changed: dict) -> Iterator[None]:
    """Context with other settings of Matplotlib, which has one set of them for all threads."""
    from matplotlib import rc_context

    with PROCESS_LOCK, rc_context(changed):
        yield


def save_figure(figure, target, **options) -> None:
    """`figure.savefig`, with curves of any number of points."""
    axes = list(figure.axes)
    while axes:  # not figure.findobj, which makes all ticks
        axis = axes.pop()
        axes += axis.child_axes
        for line in axis.lines:
            if len(line.get_xdata()) > AT_ONCE:
                line.set_path_effects([InPieces()])
    with settings({"agg.path.chunksize": 0}):
        figure.savefig(target, **options)
