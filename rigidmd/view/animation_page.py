"""The page of a run with its animation; chemiscope, whose JavaScript is in the page, draws molecules."""

import base64
import json
from pathlib import Path

import numpy as np

from rigidmd.core.files import write_text
from rigidmd.run.record import Record, read_record
from rigidmd.view import plots, run_page
from rigidmd.view.body_animation import BodyAnimation
from rigidmd.view.molecule_animation import MoleculeAnimation
from rigidmd.view.page import items, page, read_asset

VIEW = "view.html"
FILM_STYLE = f"<style>{read_asset('film.css')}</style>"
BAR = """<div class="bar noprint"><button id="film-play" aria-label="play">▶</button>
<button id="film-back" aria-label="a frame back">◂</button><button id="film-on" aria-label="a frame on">▸</button>
<input id="film-slider" type="range" min="0" max="100000" value="0" aria-label="time">
<span id="film-clock" class="clock"></span><select id="film-speed" aria-label="speed"></select></div>"""


def animation_of(record: Record, most_frames: int | None = None) -> BodyAnimation | MoleculeAnimation:
    """The animation of a run. most_frames : of molecules; default: as many as a page holds. Raises OutputError."""
    return BodyAnimation(record) if record.is_body else MoleculeAnimation(record, most_frames)


def write_view(folder: Path, path: Path) -> tuple[Path, list[str]]:
    """Write the page of the run in a folder. Returns its path, and notes on data left out. Raises OutputError."""
    record = read_record(folder)
    animation = animation_of(record)
    first, *others = animation_parts(record, animation)
    parts = [*run_page.parts(record, first), *others]
    write_text(path, page(f"{record.scene.name}: the film of a run", parts, FILM_STYLE))
    return path, [*record.missing, *animation.notes]


def animation_parts(record: Record, animation: BodyAnimation | MoleculeAnimation) -> list[str]:
    """The animation next to the plots, its data and its scripts, as HTML."""
    part = animation.page_part()
    left = f'<div><div class="stage">{part.picture}{BAR}<div class="readout" id="film-readout"></div></div>'
    left += f'<p class="legend">{part.legend}</p><p class="faint noprint">{part.usage}</p>'
    left += f'<div class="faint">{items(part.notes)}</div></div>'
    data = json.dumps(part.data, ensure_ascii=False, separators=(",", ":"), allow_nan=False, default=_packed)
    data = data.replace("<", "\\u003c")
    if any("</script" in text.lower() for text in part.scripts):
        raise ValueError("a script has the end tag of its element")
    return [
        f'<div class="film">{left}{plots.plots_part(record)}</div>',
        f'<script type="application/json" id="film-data">{data}</script>',
        *(f"<script>{text}</script>" for text in part.scripts),
    ]


def _packed(values: np.ndarray) -> str:
    """The bytes of an array, as base64."""
    return base64.b64encode(np.ascontiguousarray(values, values.dtype.newbyteorder("<")).tobytes()).decode()
