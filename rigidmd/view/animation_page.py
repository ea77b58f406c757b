"""The page of a run with its animation; chemiscope, whose JavaScript is in the page, draws molecules."""

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
from rigidmd.view.body_animation import BodyAnimation, animate_body
from rigidmd.view.page import items, page

VIEW = "view.html"
HERE = Path(__file__).parent
BAR = """<div class="bar noprint"><button id="film-play" aria-label="play">▶</button>
<button id="film-back" aria-label="a frame back">◂</button><button id="film-on" aria-label="a frame on">▸</button>
<input id="film-slider" type="range" min="0" max="100000" value="0" aria-label="time">
<span id="film-clock" class="clock"></span><select id="film-speed" aria-label="speed"></select></div>"""


def write_view(folder: Path, path: Path) -> tuple[Path, list[str]]:
    """Write the page of the run in a folder. Returns its path, and notes on data left out. Raises OutputError."""
    record = read_record(folder)
    if record.is_body:
        drawn = animate_body(record)
        animation, notes = body_part(record, drawn), drawn.notes
    else:
        from rigidmd.view.molecule_animation import page_part

        animation, notes = page_part(record)
    style = f"<style>{read_asset('film.css')}</style>"
    parts = [*run_page.parts(record, animation[0]), *animation[1:]]
    write_text(path, page(f"{record.scene.name}: the film of a run", parts, style))
    return path, [*record.missing, *notes]


def read_asset(name: str) -> str:
    return (HERE / name).read_text(encoding="utf-8")


def script(text: str) -> str:
    if "</script" in text.lower():
        raise ValueError("the script has the end tag of its element")
    return f"<script>{text}</script>"


def data_part(data: dict[str, Any]) -> str:
    text = json.dumps(data, ensure_ascii=False, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return f'<script type="application/json" id="film-data">{text}</script>'


def packed(values: np.ndarray, kind: str) -> str:
    """Numbers of this kind ("<f4", "<f8", "<i2") as base64."""
    return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode()


def stage(picture: str, beneath: str, record: Record, notes: list[str]) -> str:
    """The animation next to the plots, as HTML."""
    left = f'<div><div class="stage">{picture}{BAR}<div class="readout" id="film-told"></div></div>{beneath}'
    left += f'<div class="faint">{items(notes)}</div></div>'
    return f'<div class="film">{left}{plots.draw(record)}</div>'


def body_part(record: Record, animation: BodyAnimation) -> list[str]:
    """The animation of a body as HTML."""
    flat = partial(packed, kind="<f4")
    data = {
        "time": packed(animation.time, "<f8"), "quaternion": flat(animation.quaternion),
        "position": flat(animation.position), "path": flat(animation.path), "when": packed(animation.when, "<f8"),
        "angles": flat(animation.angles) if animation.angles.size else None,
        "vectors": {name: flat(values) for name, values in animation.vectors.items()},
        "gravity": None if animation.gravity is None else animation.gravity.tolist(),
        "vertices": animation.mesh.vertices.round(6).tolist(), "faces": animation.mesh.faces,
        "painted": animation.mesh.painted, "sphere": animation.sphere, "axis": animation.axis.tolist(),
        "centre": animation.centre.tolist(), "pinned": not record.body.translates, "rod": not animation.mesh.stem,
        "unit": animation.unit, "azimuth": animation.azimuth,
    }  # fmt: skip
    colours = {"L": ("#7a5ca3", "angular momentum L"), "ω": ("#b8862d", "angular velocity ω")}
    legend = "".join(
        f'<span><i class="chip" style="background:{colours[name][0]}"></i>{colours[name][1]}, at most '
        f"{html.escape(animation.largest[name])}</span>"
        for name in animation.vectors
    )
    legend += (
        "" if animation.gravity is None else '<span><i class="chip" style="background:var(--ink)"></i>gravity g</span>'
    )
    trace = "path of the centre of mass" if not animation.sphere else "path of the body axis on the sphere"
    legend += f'<span><i class="chip" style="background:var(--cool)"></i>{trace}</span>'
    how = "Drag to rotate, wheel or pinch to zoom, double click to reset; space plays. A click on a plot jumps to it."
    beneath = f'<p class="legend">{legend}</p><p class="faint noprint">{how}</p>'
    picture = '<canvas id="film" role="img" aria-label="film of the body"></canvas>'
    return [
        stage(picture, beneath, record, animation.notes),
        data_part(data),
        script(read_asset("film.js")),
        script(read_asset("body.js")),
    ]
