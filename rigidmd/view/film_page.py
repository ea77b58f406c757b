"""The page of a run with its film. Of molecules the library chemiscope draws it, whose JavaScript is in the page."""

import base64
import html
import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from rigidmd.core.files import write_text
from rigidmd.run.record import Record, read_record
from rigidmd.view import plots, run_page
from rigidmd.view.body_film import BodyFilm, body_film
from rigidmd.view.page import items, page

VIEW = "view.html"
HERE = Path(__file__).parent
BAR = """<div class="bar noprint"><button id="film-play" aria-label="play">▶</button>
<button id="film-back" aria-label="a frame back">◂</button><button id="film-on" aria-label="a frame on">▸</button>
<input id="film-slider" type="range" min="0" max="100000" value="0" aria-label="time">
<span id="film-clock" class="clock"></span><select id="film-speed" aria-label="speed"></select></div>"""


def write_view(folder: Path, path: Path) -> tuple[Path, list[str]]:
    """Write the page of the run in a folder. Returns its path, and what it leaves out. Raises OutputError."""
    record = read_record(folder)
    if record.is_body:
        drawn = body_film(record)
        film, told = body_part(record, drawn), drawn.told
    else:
        from rigidmd.view.molecule_film import page_part

        film, told = page_part(record)
    style = f"<style>{own('film.css')}</style>"
    parts = [*run_page.parts(record, film[0]), *film[1:]]
    write_text(path, page(f"{record.scene.name}: the film of a run", parts, style))
    return path, [*record.missing, *told]


def own(name: str) -> str:
    """A script or style of this room."""
    return (HERE / name).read_text(encoding="utf-8")


def script(text: str) -> str:
    """A script of the page."""
    if "</script" in text.lower():
        raise ValueError("a script that ends its own element")
    return f"<script>{text}</script>"


def data_part(data: dict[str, Any]) -> str:
    """Data for the film."""
    text = json.dumps(data, ensure_ascii=False, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return f'<script type="application/json" id="film-data">{text}</script>'


def packed(values: np.ndarray, kind: str) -> str:
    """Numbers of this kind ("<f4", "<f8", "<i2") as base64."""
    return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode()


def stage(picture: str, beneath: str, record: Record, told: list[str]) -> str:
    """The film beside the plots."""
    left = f'<div><div class="stage">{picture}{BAR}<div class="readout" id="film-told"></div></div>{beneath}'
    left += f'<div class="faint">{items(told)}</div></div>'
    return f'<div class="film">{left}{plots.draw(record)}</div>'


def body_part(record: Record, film: BodyFilm) -> list[str]:
    """The film of a body as HTML."""
    flat = partial(packed, kind="<f4")
    data = {
        "time": packed(film.time, "<f8"),
        "quaternion": flat(film.quaternion),
        "position": flat(film.position),
        "path": flat(film.path),
        "when": packed(film.when, "<f8"),
        "angles": flat(film.angles) if film.angles.size else None,
        "vectors": {name: flat(values) for name, values in film.vectors.items()},
        "gravity": None if film.gravity is None else film.gravity.tolist(),
        "vertices": film.mesh.vertices.round(6).tolist(),
        "faces": film.mesh.faces,
        "painted": film.mesh.painted,
        "sphere": film.sphere,
        "axis": film.axis.tolist(),
        "centre": film.centre.tolist(),
        "pinned": not record.body.flies,
        "rod": not film.mesh.stem,
        "unit": film.unit,
        "azimuth": film.azimuth,
    }
    colours = {"L": ("#7a5ca3", "angular momentum L"), "ω": ("#b8862d", "angular velocity ω")}
    legend = "".join(
        f'<span><i class="chip" style="background:{colours[name][0]}"></i>{colours[name][1]}, at most '
        f"{html.escape(film.largest[name])}</span>"
        for name in film.vectors
    )
    legend += "" if film.gravity is None else '<span><i class="chip" style="background:var(--ink)"></i>gravity g</span>'
    trace = "path of the centre of mass" if not film.sphere else "path of the body axis on the sphere"
    legend += f'<span><i class="chip" style="background:var(--cool)"></i>{trace}</span>'
    how = "Drag to turn, wheel or pinch to zoom, double click to go back; space plays. A click on a plot jumps there."
    beneath = f'<p class="legend">{legend}</p><p class="faint noprint">{how}</p>'
    picture = '<canvas id="film" role="img" aria-label="film of the body"></canvas>'
    return [
        stage(picture, beneath, record, film.told),
        data_part(data),
        script(own("film.js")),
        script(own("body.js")),
    ]
