"""The figures of the tutorial of water, one of them in README too: runs systems/water.toml and
draws its box of water.

    python tests/benchmarks/figures.py

writes water_energy.png (energy.png of the run) and water_box.png in rigidmd/docs/images.
"""

import shutil
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from rigidmd import Scene, Simulation

HERE = Path(__file__).parent
COLORS = {"O": np.array([0.80, 0.22, 0.18]), "H": np.array([0.93, 0.93, 0.95])}
RADII = {"O": 0.75, "H": 0.5}
LIGHT = np.array([-0.35, 0.45])


def view(points: np.ndarray) -> np.ndarray:
    """Points seen from in front, a little from the right and above; z is depth."""
    a, b = np.radians(28), np.radians(18)
    turn = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    tilt = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    return points @ (tilt @ turn).T


def draw_box(path: Path, positions: np.ndarray, elements, edges: np.ndarray) -> None:
    """Atoms as lit spheres, far ones paler, and the edges of the box."""
    figure = Figure(figsize=(6, 6), layout="constrained")
    axis = figure.subplots()
    corners = (
        np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * edges - edges / 2
    )
    seen = view(positions - edges / 2)
    shown = view(corners)
    for i in range(8):
        for j in range(i):
            if np.count_nonzero(corners[i] != corners[j]) == 1:
                depth = (shown[i, 2] + shown[j, 2]) / 2
                axis.plot(
                    *shown[[i, j], :2].T, color="#5c6270", lw=0.9, zorder=-1e3 if depth < 0 else 1e3
                )
    far, near = seen[:, 2].min(), seen[:, 2].max()
    for k in np.argsort(seen[:, 2]):
        haze = 0.55 * (near - seen[k, 2]) / (near - far)
        radius, color = RADII[elements[k]], COLORS[elements[k]]
        for step in np.linspace(0, 1, 7):
            lit = color * (0.62 + 0.38 * step) + 0.25 * step**4
            shade = np.clip((1 - haze) * lit + haze * np.array([0.97, 0.975, 0.98]), 0, 1)
            centre = seen[k, :2] + LIGHT * radius * 0.75 * step
            axis.add_patch(
                Circle(centre, radius * (1 - 0.85 * step), color=shade, lw=0, zorder=seen[k, 2])
            )
        outline = Circle(
            seen[k, :2], radius, fill=False, ec=(0.2, 0.2, 0.25, 0.45 * (1 - haze)), lw=0.5
        )
        outline.set_zorder(seen[k, 2])
        axis.add_patch(outline)
    axis.set_aspect("equal")
    axis.autoscale_view()
    axis.axis("off")
    figure.savefig(path, dpi=130)


def main() -> None:
    """Run and draw."""
    images = HERE.parents[1] / "rigidmd" / "docs" / "images"
    with tempfile.TemporaryDirectory() as folder:
        scene = Scene.read(
            HERE.parent.parent / "systems" / "water.toml", {"output.positions": "wrapped"}
        )
        run = Simulation(scene, Path(folder) / "water").run()
        shutil.copyfile(Path(folder) / "water" / "energy.png", images / "water_energy.png")
        universe = run.universe()
        universe.trajectory[-1]
        elements = [name[0] for name in universe.atoms.names]
        draw_box(
            images / "water_box.png", universe.atoms.positions, elements, universe.dimensions[:3]
        )


if __name__ == "__main__":
    main()
