"""The page of a run: system, means with errors, plots, stability margins, files, how to repeat; and
with its animation.

Chemiscope, whose JavaScript is in the page, draws the animation of molecules.
"""

import base64
import html
import json
import shlex
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from rigidmd.assemble.describe import describe
from rigidmd.core.shipped import Example, examples
from rigidmd.core.toml import Json
from rigidmd.engines.samples import BODY
from rigidmd.errors import InputError
from rigidmd.features import providers
from rigidmd.features.bodies.animation import BodyAnimation
from rigidmd.features.bodies.summary import motion_figures
from rigidmd.features.view import plots
from rigidmd.features.view.figures.style import new_figure
from rigidmd.features.view.molecule_animation import MoleculeAnimation
from rigidmd.features.view.page import (
    BAD,
    DOUBTFUL,
    GOOD,
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
from rigidmd.run import Simulation
from rigidmd.run.record import Record, read_record
from rigidmd.run.report import body_rows, stage_rows, stage_title
from rigidmd.run.resume import MADE_WITH
from rigidmd.run.summary import stage_summary
from rigidmd.scene import Scene

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


def write_report(folder: Path, path: Path) -> tuple[Path, list[str]]:
    """Write the page of the run in a folder. Returns its path, and notes on missing data. Raises
    OutputError."""
    record = read_record(folder)
    write_page(path, f"{record.scene.name}: a run of rigidmd", parts(record))
    return path, record.missing


def parts(record: Record, animation: str = "") -> Iterator[str]:
    """The parts of the page, as HTML. animation : HTML with the plots"""
    lines = describe(record.scene, user_code=False).splitlines()  # the output of `rigidmd check`
    known = {line.strip() for line in lines}
    warnings = [note for note in (record.summary or {}).get("notes", ()) if note not in known]
    yield f'<p class="faint">{html.escape(record.scene.in_short)}</p>'
    yield notes([*record.missing, *warnings])
    yield animation
    if record.is_body:
        yield section("Results", _body_table(record))
    else:
        yield section("Means of each stage", *_stages(record))
    if not animation:
        yield section("Plots", plots.plots_part(record))
    for feature in providers("page_parts"):
        for title, texts in feature.page_parts(record):
            yield section(title, *texts)
    yield section("Stability margins", _margins(record))
    start = lines.index("omitted:") if "omitted:" in lines else len(lines)
    end = next(
        (k for k in range(start + 1, len(lines)) if not lines[k].startswith("  ")), len(lines)
    )
    yield section("System and interactions", code("\n".join([*lines[:start], *lines[end:]])))
    yield section("Not used, and why", items(line.strip() for line in lines[start + 1 : end]))
    yield section("Files", _files(record))
    yield section("How to repeat it", *_repeat(record))


def _stages(record: Record) -> Iterator[str]:
    """Means and drifts of the stages, as the summary has them, from log.csv, which a run that has
    not ended has too."""
    system = record.system
    samples = record.log
    known = (record.summary or {}).get("stages", ())
    for row, k in enumerate(np.unique(samples["stage"]).tolist()):
        if not system.scene.stages[k].is_minimisation:
            ended = known[row] if row < len(known) else {}
            moves = ended.get("moves_tried", 0), ended.get("moves_accepted", 0)
            stage = stage_summary(system, samples, k, ended.get("computing_s", 0.0), moves)
            yield f"<p>{html.escape(stage_title(stage))}</p>"
            yield table([], stage_rows(stage | {"choice": ended.get("choice")}), words=True)


def _body_table(record: Record) -> str:
    of_invariants = BODY["energy_error"].names + BODY["L_error"].names
    errors = [name.removesuffix("_error") for name in record.columns if name in of_invariants]
    time = ("time", f"{record.time[-1]:g} s, {len(record.time)} samples")
    numbers = motion_figures(record.columns, errors) | {
        "rates": (record.summary or {}).get("rates", {})
    }
    return table([], [time, *body_rows(numbers)], words=True)


def _margins(record: Record) -> str:
    """Time steps compared with the longest stable ones."""
    summary = record.summary or {}
    rows = []
    unit = "s" if record.is_body else "fs"
    whole: Json = {"name": record.scene.name} | summary
    stages = [whole] if record.is_body else summary.get("stages", ())
    for stage in stages:
        step, stable = stage.get(f"timestep_{unit}"), stage.get(f"stable_timestep_{unit}")
        if step and stable:
            kind, word = next(entry[1:] for entry in MARGINS if step / stable <= entry[0])
            sizes = [f"{step:g}", f"{stable:.3g}", f"{100 * step / stable:.2g} %"]
            rows.append([stage["name"], *sizes, Raw(f'<span class="{kind}">{word}</span>')])
    titles = ["stage", f"step ({unit})", f"longest stable ({unit})", "fraction", ""]
    text = "The longest stable step is estimated from the fastest motion at the start."
    if not record.is_body:
        text += " Errors of averages grow long before: see `rigidmd accuracy --averages`."
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


def animation_of(
    record: Record, most_frames: int | None = None
) -> BodyAnimation | MoleculeAnimation:
    """The animation of a run. most_frames : of molecules; default: as many as a page holds. Raises
    OutputError."""
    return BodyAnimation(record) if record.is_body else MoleculeAnimation(record, most_frames)


def write_view(folder: Path, path: Path) -> tuple[Path, list[str]]:
    """Write the page of the run in a folder. Returns its path, and notes on data left out. Raises
    OutputError."""
    record = read_record(folder)
    animation = animation_of(record)
    first, *others = animation_parts(record, animation)
    title = f"{record.scene.name}: the animation of a run"
    write_page(path, title, [*parts(record, first), *others], FILM_STYLE)
    return path, [*record.missing, *animation.notes]


def animation_parts(record: Record, animation: BodyAnimation | MoleculeAnimation) -> list[str]:
    """The animation next to the plots, its data and its scripts, as HTML."""
    part = animation.page_part()

    def packed(values: np.ndarray) -> str:
        """The bytes of an array, as base64."""
        little_endian = values.dtype.newbyteorder("<")
        return base64.b64encode(values.astype(little_endian).tobytes()).decode()

    data = json.dumps(part.data, separators=(",", ":"), allow_nan=False, default=packed)
    if any("</script" in text.lower() for text in part.scripts):
        raise ValueError("a script has the end tag of its element")
    data = data.replace("<", "\\u003c")
    return [
        f'<div class="film"><div><div class="stage">{part.picture}{BAR}</div>'
        f'<p class="legend">{part.legend}</p><p class="faint noprint">{part.usage}</p>'
        f'<div class="faint">{items(animation.notes)}</div></div>{plots.plots_part(record)}</div>',
        f'<script type="application/json" id="film-data">{data}</script>',
        *(f"<script>{text}</script>" for text in part.scripts),
    ]


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
    bodies = {example.name: example for example in examples() if example.is_body}
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
