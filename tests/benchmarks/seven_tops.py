"""The picture of the seven heavy tops: runs systems/heavy_top_1.toml ... 7 and draws their axes
from above.

    python tests/benchmarks/seven_tops.py

writes seven_tops.png in rigidmd/docs/images, or the folder of --to.
"""

from pathlib import Path

import numpy as np
from command_line import SMOKE, new_parser, read_options
from matplotlib.figure import Figure

from rigidmd import Scene, Simulation

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


def draw(images: Path) -> None:
    """Run the tops, and draw the picture into a folder."""
    figure = Figure(figsize=(10, 5.3), layout="constrained")
    for k, (cell, title) in enumerate(zip(figure.subplots(2, 4).flat, TITLES, strict=False), 1):
        results = Simulation(Scene.read(ROOT / "systems" / f"heavy_top_{k}.toml", CHANGES)).run()
        angle = np.linspace(0, 2 * np.pi, 400)
        x, y, up = results["q13"], results["q23"], results["q33"]
        zoom = 1.0 if k != 2 else 3.0  # its loops are small: a third of the circle
        cell.plot(np.cos(angle), np.sin(angle), color="#8a8f99", lw=0.6)
        for theta in (results["theta"].min(), results["theta"].max()):
            cell.plot(
                np.sin(theta) * np.cos(angle),
                np.sin(theta) * np.sin(angle),
                color="#8a8f99",
                lw=0.6,
                ls=(0, (5, 4)),
            )
        above = up >= 0
        cell.plot(np.where(above, x, np.nan), np.where(above, y, np.nan), color="#2b6f9e", lw=1.0)
        cell.plot(
            np.where(above, np.nan, x),
            np.where(above, np.nan, y),
            color="#2b6f9e",
            lw=1.0,
            alpha=0.3,
        )
        cell.plot(x[0], y[0], "o", ms=3.5, color="#c8553d")
        middle = (0.0, 0.0) if zoom == 1 else (0.0, -0.5)
        cell.set(
            xlim=(middle[0] - 1.05 / zoom, middle[0] + 1.05 / zoom),
            ylim=(middle[1] - 1.05 / zoom, middle[1] + 1.05 / zoom),
        )
        cell.set_aspect("equal")
        cell.axis("off")
        cell.set_title(
            f"{k}  {title}" + (f" (×{zoom:g})" if zoom > 1 else ""), fontsize=9, color="#1f2430"
        )
    figure.axes[-1].axis("off")
    figure.savefig(images / "seven_tops.png", dpi=130)


if __name__ == "__main__":
    draw(read_options(new_parser(__doc__), ROOT / "rigidmd" / "docs" / "images").to)
