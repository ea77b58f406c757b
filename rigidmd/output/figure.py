"""Shared by all figures: writing, and styles for many curves."""

from itertools import pairwise

#: Points of a curve that are drawn at once. The renderer fails on 200,000 points across a figure.
AT_ONCE = 5000
COLORS = ("#2b6f9e", "#c8553d", "#4f8a5b", "#7a5ca3", "#b8862d", "#1f2430", "#3fa7a0", "#c2569a", "#8a8f99", "#7f9a1c")
MARKERS = "os^Dv*PX<>"
DASHES = ((), (5, 1.5), (1.5, 1.2), (6, 1.5, 1.5, 1.5))


def curve_style(k: int) -> dict:
    """Style of the k-th of many curves: ten colours, then other dashes and markers."""
    rounds, color = divmod(k, len(COLORS))
    dashes = DASHES[rounds % len(DASHES)]
    marker = MARKERS[(color + 3 * rounds) % len(MARKERS)]
    return {"color": COLORS[color], "ls": (0, dashes) if dashes else "-", "marker": marker}


class InPieces:
    """A path effect of Matplotlib that draws a path in pieces, each from the end of the previous one.

    Matplotlib's own pieces, `agg.path.chunksize`, omit the last point of each, and thus two sides of the path.
    """

    def draw_path(self, renderer, gc, path, affine, rgbFace=None):
        """Draw a path of straight sides."""
        sides = len(path.vertices) - 1
        pieces = -(-sides // (AT_ONCE - 1))  # of equal length: a short level one would be snapped to whole pixels
        for first, last in pairwise(sides * k // pieces for k in range(pieces + 1)):
            piece = type(path)(path.vertices[first : last + 1])
            piece.simplify_threshold = path.simplify_threshold
            renderer.draw_path(gc, piece, affine, rgbFace)


def save_figure(figure, target, **options) -> None:
    """`figure.savefig`, with curves of any number of points."""
    from matplotlib import rc_context
    from matplotlib.lines import Line2D

    for line in figure.findobj(Line2D):
        if len(line.get_xdata()) > AT_ONCE:
            line.set_path_effects([InPieces()])
    with rc_context({"agg.path.chunksize": 0}):
        figure.savefig(target, **options)
