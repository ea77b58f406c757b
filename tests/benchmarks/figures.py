"""The figures of the tutorial of water, one of them in README too: runs systems/water.toml and
draws its box of water.

    python tests/benchmarks/figures.py

writes water_energy.png (energy.png of the run) and water_box.png in rigidmd/docs/images, or the
folder of --to.
"""

import shutil
import tempfile
from pathlib import Path

from command_line import SMOKE, new_parser, read_options

from rigidmd import Scene, Simulation
from rigidmd.features.view.figures.style import new_figure, save_files
from rigidmd.features.view.molecule_animation import MoleculeAnimation
from rigidmd.run.record import read_record

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "rigidmd" / "docs" / "images"
CHANGES = {"stages.production.duration_ps": 0.2} if SMOKE else {}


def write_images(folder: Path, images: Path) -> None:
    """Write the figures of a run of water: its energies, and its last frame."""
    shutil.copyfile(folder / "energy.png", images / "water_energy.png")
    animation = MoleculeAnimation(read_record(folder))
    figure = new_figure(5, 5, layout=None)
    animation.draw(figure.add_axes((0, 0, 1, 1)), float(animation.time[-1]))
    save_files(figure, images / "water_box", ["png"])


def main() -> None:
    """Run and draw."""
    images = read_options(new_parser(__doc__), IMAGES).to
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "water"
        Simulation(Scene.read(ROOT / "systems" / "water.toml", CHANGES), run).run()
        write_images(run, images)


if __name__ == "__main__":
    main()
