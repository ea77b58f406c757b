"""Figures and animations of the documentation that one run or one model gives.

    python tests/benchmarks/figures.py                  # those of systems/water.toml, a top and a model
    python tests/benchmarks/figures.py modes slab       # normal modes and a slab, minutes each

`water` writes water_energy.png (energy.png of the run), water_box.png and water.gif; `top` top.gif;
`model` model_tip5p.png; `modes` normal_modes_spce.png; `slab` water_slab.png, in rigidmd/docs/images
or the folder of --to.
"""

import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from command_line import SMOKE, new_parser, read_options

import rigidmd
from rigidmd import Scene, Simulation
from rigidmd.features.view.animation import write_film
from rigidmd.features.view.figures.style import (
    COLORS,
    INK,
    TEXT,
    TITLE,
    new_figure,
    open_axis,
    save_files,
)
from rigidmd.features.view.molecule_animation import MoleculeAnimation
from rigidmd.features.view.molecule_figure import write_molecule_figure
from rigidmd.run.record import read_record
from rigidmd.scene.models import load_model

ROOT = Path(__file__).parents[2]
IMAGES = ROOT / "rigidmd" / "docs" / "images"
SMOOTH = {"forces.truncation": "smooth_switch", "forces.ewald_accuracy": 1e-7}
FEW = {"molecules.0.count": 8, "forces.cutoff_A": 3}
BINS = 60


def run_of(name: str, folder: Path, changes: dict) -> Path:
    """The folder of a run of a shipped scene."""
    Simulation(Scene.read(ROOT / "systems" / f"{name}.toml", changes), folder / name).run()
    return folder / name


def water(folder: Path, images: Path) -> None:
    """The figures of a run of water: energies, the last frame, and an animation."""
    run = run_of("water", folder, {"stages.production.duration_ps": 0.2} if SMOKE else {})
    shutil.copyfile(run / "energy.png", images / "water_energy.png")
    animation = MoleculeAnimation(read_record(run))
    figure = new_figure(5, 5, layout=None)
    animation.draw(figure.add_axes((0, 0, 1, 1)), float(animation.time[-1]))
    save_files(figure, images / "water_box", ["png"])
    write_film(run, images / "water.gif", 0.2 if SMOKE else 3.0)


def top(folder: Path, images: Path) -> None:
    """The animation of a heavy top."""
    run = run_of("heavy_top_3", folder, {"run.duration_s": 0.1} if SMOKE else {})
    write_film(run, images / "top.gif", 0.2 if SMOKE else 5.0)


def model(folder: Path, images: Path) -> None:
    """The figure of a model."""
    write_molecule_figure(images / "model_tip5p.png", load_model("tip5p"), force=True)


def modes(folder: Path, images: Path) -> None:
    """Normal modes of liquid water: translation and libration, and infrared lines."""
    changes = SMOOTH | (FEW if SMOKE else {})
    found = rigidmd.normal_modes(Scene.read(ROOT / "systems" / "water.toml", changes))
    shown = found.rate != 0
    at, translation = found.wavenumber[shown], found.translation[shown]
    figure = new_figure(7.2, 4.0)
    density, infrared = figure.subplots(2, 1, sharex=True)
    density.hist(
        [at, at],
        BINS,
        weights=[translation, 1 - translation],
        stacked=True,
        label=["translation", "libration"],
        color=COLORS[:2],
    )
    density.legend(frameon=False, fontsize=TEXT, labelcolor=INK)
    density.set_ylabel("number of modes", fontsize=TITLE, color=INK)
    infrared.vlines(at, 0, found.intensity[shown], lw=0.8, color=COLORS[0])
    infrared.set_ylim(0, None)
    infrared.set_ylabel("IR intensity (km/mol)", fontsize=TITLE, color=INK)
    infrared.set_xlabel("wavenumber (cm⁻¹)", fontsize=TITLE, color=INK)
    for axis in (density, infrared):
        open_axis(axis, labelsize=TEXT)
    save_files(figure, images / "normal_modes_spce", ["png"])


def slab(folder: Path, images: Path) -> None:
    """The density of water about the middle of a slab, and the fit."""
    equilibration, production = (1.0, 0.4) if SMOKE else (20.0, 100.0)
    changes = {
        "stages.equilibration.duration_ps": equilibration,
        "stages.production.duration_ps": production,
        "output.trajectory_interval_ps": production / 100,
    }
    run = run_of("water_slab", folder, changes)
    result = rigidmd.analysis.interfaces(rigidmd.read_run(run))
    save_files(result.plot("interfaces"), images / "water_slab", ["png"])


PICTURES: dict[str, Callable[[Path, Path], None]] = {
    picture.__name__: picture for picture in (water, top, model, modes, slab)
}
DEFAULT = ("water", "top", "model")


def main() -> None:
    """Run and draw."""
    parser = new_parser(__doc__)
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(PICTURES))
    options = read_options(parser, IMAGES, names=[*PICTURES])
    for name in options.names or DEFAULT:
        with tempfile.TemporaryDirectory() as folder:
            PICTURES[name](Path(folder), options.to)


if __name__ == "__main__":
    main()
