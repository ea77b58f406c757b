"""The pages of shipped bodies, and an index with a picture of each, which `rigidmd gallery`
writes."""

import base64
import html
from collections.abc import Callable
from pathlib import Path

import numpy as np

from rigidmd.core.shipped import Example, examples
from rigidmd.errors import InputError
from rigidmd.features.bodies.animation import BodyAnimation
from rigidmd.features.view.figures.style import new_figure
from rigidmd.features.view.page import code, write_page
from rigidmd.features.view.run_page import write_view
from rigidmd.run import Simulation
from rigidmd.run.record import read_record
from rigidmd.scene import Scene

INDEX = "index.html"
#: The default bodies.
SHOWN = (
    *(f"heavy_top_{k}" for k in range(1, 8)),
    "intermediate_axis",
    "sleeping_top",
    "gyrocompass",
    "dropped_stone",
)
#: Inches of a picture, and the fraction of the run that has passed in it.
INCHES, RUN_FRACTION = 3.2, 0.62
STYLE = """.cards{display:grid;grid-template-columns:repeat(auto-fill,
minmax(min(100%,250px),1fr));gap:1rem}
.cards a{color:inherit;text-decoration:none;border:1px solid var(--line);border-radius:8px;
padding:.6rem;display:block}
.cards img{width:100%;background:#fff;border-radius:4px}.cards b{display:block}"""


def selected_bodies(names: list[str]) -> list[Example]:
    """The shipped bodies with these names, or those of SHOWN. Raises RigidMDError."""
    bodies = {example.name: example for example in examples() if "body" in example.tables}
    if unknown := [name for name in names if name not in bodies]:
        raise InputError(
            "gallery", [f"unknown body {unknown[0]!r}; shipped are {', '.join(bodies)}"]
        )
    return [bodies[name] for name in names or SHOWN]


def write_gallery(
    folder: Path,
    names: list[str],
    *,
    force: bool,
    command: str,
    progress: Callable[[str], object] = lambda name: None,
) -> Path:
    """Run bodies into folder/runs, write their pages and an index. Returns the path of the index.
    Raises OutputError.

    progress : called with the name of each body before it runs
    """
    cards = []
    for example in selected_bodies(names):
        progress(example.name)
        scene = Scene.read(example.path, {"output.figures": False, "output.trajectory": False})
        run = folder / "runs" / example.name
        Simulation(scene, run, force).run()
        target, _ = write_view(run, folder / f"{example.name}.html")
        animation = BodyAnimation(read_record(run))
        figure = new_figure(INCHES, INCHES, layout=None)
        moment = np.interp(RUN_FRACTION, (0, 1), animation.time[[0, -1]])
        animation.draw(figure.add_axes((0, 0, 1, 1)), float(moment))
        picture = base64.b64encode(figure.png()[0]).decode()
        cards.append(
            f'<a href="{target.name}"><img alt="" src="data:image/png;base64,{picture}">'
            f"<b>{html.escape(example.name)}</b><span>{html.escape(example.about)}</span></a>"
        )
    about = '<p class="faint">Each picture links to the animation of the body.</p>'
    index = [about, f'<div class="cards">{"".join(cards)}</div>', code(command)]
    write_page(folder / INDEX, "Tops, gyroscopes and a stone", index, STYLE)
    return folder / INDEX
