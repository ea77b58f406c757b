"""A page with a picture of each shipped body, which leads to its film: runs the scenes and writes their pages."""

import base64
import html
import io
from collections.abc import Callable
from pathlib import Path

import numpy as np

from rigidmd.core.files import write_text
from rigidmd.errors import Faults
from rigidmd.figures.style import save_figure
from rigidmd.run import Simulation
from rigidmd.run.record import Record, read_record
from rigidmd.scene import Scene
from rigidmd.scene.shipped import Example, examples
from rigidmd.view.body_film import body_film
from rigidmd.view.draw_body import BodyPicture
from rigidmd.view.film_page import write_view
from rigidmd.view.page import code, page

INDEX = "index.html"
#: The bodies that are run where none is named.
SHOWN = (
    *(f"heavy_top_{k}" for k in range(1, 8)), "intermediate_axis", "sleeping_top", "gyrocompass", "dropped_stone",
)  # fmt: skip
#: Inches and dots per inch of a picture, and the share of the run that it shows: a body in the midst of its motion.
INCHES, DPI, SHARE = 3.2, 100, 0.62
STYLE = """<style>.cards{display:grid;grid-template-columns:repeat(auto-fill,minmax(min(100%,250px),1fr));gap:1rem}
.cards a{color:inherit;text-decoration:none;border:1px solid var(--line);border-radius:8px;padding:.6rem;display:block}
.cards img{width:100%;background:#fff;border-radius:4px}.cards b{display:block}</style>"""


def chosen(names: list[str]) -> list[Example]:
    """The shipped bodies of these names; of none, those of SHOWN. Raises Faults."""
    bodies = {example.name: example for example in examples() if example.is_body}
    if strange := [name for name in names if name not in bodies]:
        raise Faults("gallery", [f"there is no shipped body {strange[0]!r}; there are {', '.join(bodies)}"])
    return [bodies[name] for name in names or SHOWN]


def write_gallery(
    folder: Path, names: list[str], force: bool, command: str, progress: Callable[[str], object] = lambda name: None
) -> Path:
    """Run bodies into folder/runs, write their pages, and one that leads to them. Returns its path. Raises OutputError.

    progress : called with the name of each body before it runs
    """
    cards = []
    for example in chosen(names):
        progress(example.name)
        scene = Scene.read(example.path, {"output.figures": False, "output.trajectory": False})
        run = folder / "runs" / example.name
        Simulation(scene, run, force).run()
        target, _ = write_view(run, folder / f"{example.name}.html")
        cards.append(
            f'<a href="{target.name}"><img alt="" src="data:image/png;base64,{_picture(read_record(run))}">'
            f"<b>{html.escape(example.name)}</b><span>{html.escape(example.about)}</span></a>"
        )
    parts = [
        '<p class="faint">Each picture leads to the film of the body.</p>',
        f'<div class="cards">{"".join(cards)}</div>',
        code(command),
    ]
    write_text(folder / INDEX, page("Tops, gyroscopes and a stone", parts, STYLE))
    return folder / INDEX


def _picture(record: Record) -> str:
    """A moment of the film, PNG in base64."""
    from rigidmd.figures.picture import Picture

    film = body_film(record)
    figure = Picture(figsize=(INCHES, INCHES), dpi=DPI)
    time = float(np.interp(SHARE, [0, 1], film.time[[0, -1]]))
    BodyPicture(film, not record.body.flies).draw(figure.add_axes((0, 0, 1, 1)), time)
    stream = io.BytesIO()
    save_figure(figure, stream, format="png", dpi=DPI)
    return base64.b64encode(stream.getvalue()).decode()
