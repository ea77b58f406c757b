"""The page of a run: system, means with errors, plots, stability margins, files, how to repeat; and
with its animation.

Chemiscope, whose JavaScript is in the page, draws the animation of molecules.
"""

import base64
import html
import json
import shlex
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from rigidmd.features import providers
from rigidmd.features.view import plots
from rigidmd.features.view.kind_display import display_of
from rigidmd.features.view.page import (
    BAD,
    DOUBTFUL,
    GOOD,
    Animation,
    Raw,
    code,
    items,
    notes,
    read_asset,
    section,
    table,
    write_page,
)
from rigidmd.formats import BY_EXTENSION
from rigidmd.io.folder import SCENE
from rigidmd.run.kind import kind_of
from rigidmd.run.record import Record, read_record
from rigidmd.run.resume import MADE_WITH

REPORT = "report.html"
#: Files of a run: name -> contents.
ABOUT = {
    "scene.toml": "the scene with all defaults: it repeats the run to the bit",
    "summary.json": "the values of this page",
    "log.csv": "energies, temperatures and pressures over time",
    "motion.csv": "position, attitude, velocities, energies and errors over time",
    "motion.npz": "the same columns as arrays",
    "final.npz": "the last state, exact to every bit",
    "pressure_tensor.csv": "the pressure tensor over time, for a viscosity",
    "analysis.json": "values of `rigidmd analyse` with their errors",
    "checkpoint.npz": "from which `rigidmd resume` continues",
    "checkpoint_previous.npz": "the checkpoint before it",
    "last_good_state.npz": "the last state before the run failed",
}


def page_title(record: Record) -> str:
    """The name of the scene, and what it has."""
    return record.scene.in_short.partition(";")[0]


def write_report(folder: Path, path: Path) -> tuple[Path, list[str]]:
    """Write the page of the run in a folder. Returns its path, and notes on missing data. Raises
    OutputError."""
    record = read_record(folder)
    write_page(path, page_title(record), parts(record))
    return path, record.missing


def parts(record: Record, animation: str = "") -> Iterator[str]:
    """The parts of the page, as HTML. animation : HTML with the results and plots"""
    kind = kind_of(record.scene)
    system = kind.build(record.scene, user_code=False)
    notes_of_run = (record.summary or {}).get("notes", ())
    warnings = [note for note in notes_of_run if note not in system.notes]
    yield notes([*record.missing, *warnings])
    yield animation
    if not animation:
        yield display_of(record.scene).results_section(record)
        yield section("Plots", plots.plots_part(record))
    for feature in providers("page_parts"):
        for title, texts in feature.page_parts(record):
            yield section(title, *texts)
    yield section("Stability margins", _margins(record))
    yield section("System and interactions", code(kind.describe(system)))
    yield section("Not used, and why", items(system.left_out))
    yield section("Files", _files(record))
    yield section("How to repeat it", *_repeat(record))


def _margins(record: Record) -> str:
    """Time steps compared with the longest stable ones."""
    display = display_of(record.scene)
    rows = []
    unit = display.step_unit
    for stage in display.stepped(record):
        step, stable = stage.get(f"timestep_{unit}"), stage.get(f"stable_timestep_{unit}")
        if step and stable:
            kind, word = next(entry[1:] for entry in MARGINS if step / stable <= entry[0])
            sizes = [f"{step:g}", f"{stable:.3g}", f"{100 * step / stable:.2g} %"]
            rows.append([stage["name"], *sizes, Raw(f'<span class="{kind}">{word}</span>')])
    titles = ["stage", f"step ({unit})", f"longest stable ({unit})", "fraction", ""]
    text = "The longest stable step is estimated from the fastest motion at the start."
    text += display.margins_note
    return table(titles, rows) + f'<p class="faint">{text}</p>' if rows else ""


#: Fraction of the longest stable step up to which a verdict holds.
MARGINS = ((0.5, GOOD, "safe"), (1.0, DOUBTFUL, "near the limit"), (float("inf"), BAD, "too long"))


def _files(record: Record) -> str:
    output = record.scene.output
    rows = []
    about = ABOUT | {output.topology: "names and first positions, for viewers"}
    if output.trajectory:
        form = BY_EXTENSION[Path(output.trajectory).suffix]
        viewer = form.viewer.format(topology=output.topology, trajectory=output.trajectory)
        about[output.trajectory] = (
            f"positions{' and rotations' if form.rotations else ''} over time: {viewer}"
        )
    for path in sorted(record.folder.iterdir()):
        if path.name.startswith(".") or not path.is_file():
            continue
        text = "a figure" if path.suffix in (".png", ".svg") else about.get(path.name, "")
        rows.append([path.name, f"{path.stat().st_size / 1000:,.1f}", text])
    return table(["file", "size (kB)", ""], rows, words=True)


def _repeat(record: Record) -> Iterator[str]:
    summary = record.summary or {}
    folder = shlex.quote(str(record.folder))
    yield code(
        f"rigidmd run {folder}/{SCENE} -o {folder}-again    # the same run\n"
        f"rigidmd compare {folder} {folder}-again    # to the same bits"
    )
    rows = []
    for key in (*MADE_WITH, "precision", "seed", "scene_sha256", "input_sha256"):
        if isinstance(value := summary.get(key), dict):
            value = ", ".join(f"{path} {digest}" for path, digest in value.items())
        rows += [[key.replace("_", " "), value]] if value else []
    yield table([], rows, words=True)
    about = {
        "preparing_s": "to compile and prepare",
        "computing_s": "of steps",
        "wall_s": "in all, output included",
    }
    seconds = [f"{summary[key]:.1f} s {phase}" for key, phase in about.items() if summary.get(key)]
    yield f"<p>{html.escape('; '.join(seconds))}.</p>" if seconds else ""


VIEW = "view.html"
FILM_STYLE = read_asset("film.css")
BAR = """<div class="bar noprint"><button id="film-play" aria-label="play">▶</button>
<button id="film-back" aria-label="a frame back">◂</button>
<button id="film-on" aria-label="a frame on">▸</button>
<input id="film-slider" type="range" min="0" max="100000" value="0" aria-label="time">
<span id="film-clock" class="clock"></span>
<select id="film-speed" aria-label="speed"></select></div>
<div class="readout" id="film-readout"></div>"""


def write_view(folder: Path, path: Path) -> tuple[Path, list[str]]:
    """Write the page of the run in a folder. Returns its path, and notes on data left out. Raises
    OutputError."""
    record = read_record(folder)
    animation = display_of(record.scene).animation(record)
    results = display_of(record.scene).results_section(record)
    first, *others = animation_parts(record, animation, results)
    write_page(path, page_title(record), [*parts(record, first), *others], FILM_STYLE)
    return path, [*record.missing, *animation.notes]


def animation_parts(record: Record, animation: Animation, results: str = "") -> list[str]:
    """The animation next to the results (HTML) and the plots, its data and its scripts, as HTML."""
    part = animation.page_part()

    def packed(values: np.ndarray) -> str:
        """The bytes of an array, as base64."""
        little_endian = values.dtype.newbyteorder("<")
        return base64.b64encode(values.astype(little_endian).tobytes()).decode()

    data = json.dumps(part.data, separators=(",", ":"), allow_nan=False, default=packed)
    if any("</script" in text.lower() for text in part.scripts):
        raise ValueError("a script has the end tag of its element")
    data = data.replace("<", "\\u003c")
    legend = f'<p class="legend">{part.legend}</p>' if part.legend else ""
    return [
        f'<div class="film"><div class="stage">{part.picture}{BAR}</div>'
        f'<div>{results}{legend}<p class="faint noprint">{part.usage}</p>'
        f'<div class="faint">{items(animation.notes)}</div></div></div>{plots.plots_part(record)}',
        f'<script type="application/json" id="film-data">{data}</script>',
        *(f"<script>{text}</script>" for text in part.scripts),
    ]
