"""The picture of the seven heavy tops: runs systems/heavy_top_1.toml ... 7 and draws their axes
from above.

    python tests/benchmarks/seven_tops.py

writes seven_tops.png in rigidmd/docs/images, or the folder of --to.
"""

from pathlib import Path

import numpy as np
from command_line import SMOKE, new_parser, read_options

from rigidmd import Scene, Simulation
from rigidmd.features.view.figures.style import (
    COOL,
    FAINT,
    INK,
    TEXT,
    WARM,
    new_figure,
    save_files,
)

ROOT = Path(__file__).parents[2]
CHANGES = {"output.trajectory": False} | ({"run.duration_s": 0.1} if SMOKE else {})
TITLES = (
    "no nutation",
    "waves",
    "cusps",
    "loops",
    "cusps, for longer",
    "deep nutation",
    "a cardioid",
)

#: Lines of the key.
KEY = {
    "axis, from above": {"color": COOL, "lw": 1.0},
    "below the pivot": {"color": COOL, "lw": 1.0, "alpha": 0.35},
    "start": {"color": WARM, "marker": "o", "ms": 3.5, "ls": "none"},
    "horizontal axis": {"color": FAINT, "lw": 0.6},
    "limits of θ": {"color": FAINT, "lw": 0.6, "ls": (0, (5, 4))},
}


def draw(images: Path) -> None:
    """Run the tops, and draw the picture into a folder."""
    figure = new_figure(7.2, 4.3)
    *cells, last = figure.subplots(2, 4).flat
    angle = np.linspace(0, 2 * np.pi, 400)
    circle = np.array([np.cos(angle), np.sin(angle)])
    for k, (cell, title) in enumerate(zip(cells, TITLES, strict=True), 1):
        results = Simulation(Scene.read(ROOT / "systems" / f"heavy_top_{k}.toml", CHANGES)).run()
        axis, is_above = np.array([results["q13"], results["q23"]]), results["q33"] >= 0
        cell.plot(*circle, color=FAINT, lw=0.6)
        for theta in (results["theta"].min(), results["theta"].max()):
            cell.plot(*(np.sin(theta) * circle), color=FAINT, lw=0.6, ls=(0, (5, 4)))
        for side, alpha in ((is_above, 1.0), (~is_above, 0.35)):
            cell.plot(*np.where(side, axis, np.nan), color=COOL, lw=1.0, alpha=alpha)
        cell.plot(*axis[:, 0], "o", ms=3.5, color=WARM)
        zoom = 1.0 if k != 2 else 3.0  # its nutation is small: a third of the circle
        middle = 0.0 if k != 2 else -0.5
        cell.set(
            xlim=(-1.05 / zoom, 1.05 / zoom), ylim=(middle - 1.05 / zoom, middle + 1.05 / zoom)
        )
        cell.set_aspect("equal")
        cell.axis("off")
        name = f"{k}  {title}" + (f", enlarged ×{zoom:g}" if zoom > 1 else "")
        cell.set_title(name, fontsize=TEXT, color=INK)
    last.axis("off")
    for height, (text, style) in zip((0.85, 0.68, 0.51, 0.34, 0.17), KEY.items(), strict=True):
        at = [0.07] if "marker" in style else [0.0, 0.14]
        last.plot(at, [height] * len(at), **style)
        last.text(0.2, height, text, fontsize=TEXT, color=INK, va="center")
    last.set(xlim=(-0.05, 1.0), ylim=(0.0, 1.0))
    save_files(figure, images / "seven_tops", ["png"])


if __name__ == "__main__":
    draw(read_options(new_parser(__doc__), ROOT / "rigidmd" / "docs" / "images").to)
