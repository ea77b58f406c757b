"""The display of scenes, simulations, results (tables and a figure, light or dark) and animations
in a notebook."""

import html
from collections.abc import Iterable
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from rigidmd.analysis.result import AnalysisResult, Value
from rigidmd.assemble.body import build_body
from rigidmd.assemble.species import species_of
from rigidmd.assemble.stage_description import describe_stage
from rigidmd.core.display import html as html_of
from rigidmd.core.files import write_text
from rigidmd.core.statistics import format_with_error
from rigidmd.engines.body_system import BodySystem
from rigidmd.engines.system import System
from rigidmd.errors import InputError, OutputError
from rigidmd.figures.run import run_figures
from rigidmd.io.trajectory import Frames
from rigidmd.mechanics.rotation import to_euler_angles
from rigidmd.run.report import body_rows, body_title, stage_rows, stage_title
from rigidmd.run.results import Results
from rigidmd.run.simulation import Simulation
from rigidmd.scene import BodyScene, MolecularScene, Scene
from rigidmd.view.body_animation import BodyAnimation
from rigidmd.view.molecule_animation import describe_thinning, frames_of, inside, massive_bonds
from rigidmd.view.page import Raw, figure, notes, page, read_asset, table
from rigidmd.view.plots import record_of
from rigidmd.view.run_page import FILM_STYLE, animation_parts

if TYPE_CHECKING:
    from chemiscope.widget import StructureWidget

    from rigidmd.figures.picture import Picture

STYLE = read_asset("notebook.css")
#: What acts on a body: a table of its scene, and its title.
ACTING = {
    "gravity": "gravity",
    "applied": "applied forces",
    "friction": "friction",
    "fluid": "a fluid",
    "frame": "a moving frame",
    "wheels": "wheels",
    "changing_inertia": "changing inertia",
}
COULOMB = {
    "reaction_field": "reaction field",
    "ewald": "Ewald sum",
    "pme": "particle mesh Ewald",
    "damped_shifted_force": "damped shifted force",
    "coulomb": "Coulomb",
    "none": "charges ignored",
    None: "particle mesh Ewald or, without a box, Coulomb",
}
USER_FORCES = "user forces"

TableRow = tuple[str, str]


@html_of.register
def scene_html(scene: Scene) -> str:
    kind = "one rigid body" if isinstance(scene, BodyScene) else "rigid molecules"
    return framed(scene.name, kind, _table(_rows(scene)))


@html_of.register
def simulation_html(simulation: Simulation) -> str:
    folder = simulation.folder
    where = "nowhere: the results stay in memory" if folder is None else str(folder)
    rows = [row for row in _rows(simulation.scene) if row[0] != USER_FORCES]
    user_terms: dict[str, str] = getattr(simulation.system, "user_terms", {})
    rows += [(USER_FORCES, f"{name}: {words}") for name, words in user_terms.items()]
    rows += [("threads", str(simulation.threads)), ("writes to", where)]
    if names := [type(observer).__name__ for observer in simulation._observers]:
        rows.append(("observers", ", ".join(names)))
    return framed(simulation.scene.name, "ready to run: run() does it", _table(rows))


@html_of.register
def results_html(results: Results) -> str:
    summary = results.summary
    text = []
    if isinstance(results.system, BodySystem):
        if "steps" in summary:  # not of a run that has not ended
            text += [f"<p>{html.escape(body_title(summary))}</p>", _table(body_rows(summary))]
    else:
        for stage in summary["stages"]:
            text += [f"<p>{html.escape(stage_title(stage))}</p>", _table(stage_rows(stage))]
    drawn = run_figures(results.system, results.samples, summary)
    left = f"{''.join(text)}{notes(summary['notes'])}"
    name, drawing = next(iter(drawn.items()), ("", None))
    right = _drawing(drawing, f"{results.system.scene.name}-{name}", f"figure: {name}")
    return framed(
        results.system.scene.name,
        results._summary_line,
        f"{_sides(left, right)}{_columns(results)}",
    )


@html_of.register
def analysis_html(result: AnalysisResult) -> str:
    rows = [(value.name, _measured(value), value.note) for value in result.values]
    right = _drawing(
        result.plot() if result.curves else None, f"analysis-{result.name}", result.about
    )
    left = f"{table([], rows, words=True)}{notes(result.notes)}"
    return framed(result.name, result.about, _sides(left, right))


def _measured(value: Value) -> str:
    """A value with its error and unit; empty without one, as its note has the reason."""
    unit = "" if value.unit in ("", "1") else f" {value.unit}"
    return "" if value.value is None else f"{format_with_error(value.value, value.error)}{unit}"


def _sides(left: str, right: str) -> str:
    """Text and figure side by side."""
    return f'<div class="sides"><div>{left}</div>{f"<div>{right}</div>" if right else ""}</div>'


def _drawing(drawing: "Picture | None", salt: str, about: str) -> str:
    """A figure in the colours of the notebook, or on white if it has a shaded solid; empty without
    one."""
    if drawing is None:
        return ""
    svg = figure(drawing, salt, about).replace("#000000", "var(--ink)")
    # not of the rest of the notebook
    svg = svg.replace("*{stroke-linejoin", ".rigidmd svg *{stroke-linejoin")
    return f'<div class="{"paper" if "<image" in svg else "figure"}">{svg}</div>'


def framed(name: str, about: str, body: str) -> str:
    """A block of HTML in the style of the package, with a name and what it is."""
    head = (
        f'<div class="head">{html.escape(name)} <span'
        f' class="faint">{html.escape(about)}</span></div>'
    )
    return f'<style>{STYLE}</style><div class="rigidmd">{head}{body}</div>'


def _table(rows: Iterable[TableRow]) -> str:
    """A table in which equal names in successive rows appear once."""
    rows = list(rows)
    before = ["", *(name for name, _ in rows)]
    text = [
        ("" if name == last else name, value)
        for last, (name, value) in zip(before, rows, strict=False)
    ]
    return table([], text, words=True)


def _rows(scene: Scene) -> list[TableRow]:
    """Names and values of a scene, or its errors if it cannot be built."""
    try:
        if isinstance(scene, BodyScene):
            return list(_body_rows(build_body(scene)))
        return list(_molecular_rows(cast(MolecularScene, scene)))
    except InputError as error:
        return [("this scene", scene.in_short), *(("fault", fault) for fault in error.errors)]


def _molecular_rows(scene: MolecularScene) -> Iterable[TableRow]:
    species = species_of(scene)
    for entry, molecule in zip(scene.molecules, species, strict=True):
        count = f"{entry.count} " if entry.count else ""
        yield (
            "molecules",
            f"{count}{molecule.name}: {molecule.description}{', frozen' if entry.frozen else ''}",
        )
    if scene.structure is not None:
        yield "start", f"from {scene.structure.file}"
    yield "box", _box(scene)
    forces = scene.forces
    acting = (
        ["Lennard-Jones"]
        if forces.lennard_jones and any((m.epsilon > 0).any() for m in species)
        else []
    )
    acting += [COULOMB[forces.electrostatics]] if any(m.charges.any() for m in species) else []
    acting += [f"cutoff {forces.cutoff_A:g} Å"] if forces.cutoff_A and acting else []
    yield "forces", ", ".join(acting) or "none of the models"
    for force in forces.custom:
        yield USER_FORCES, f"{force.name}: {force.energy or force.module}"
    for name in type(scene.fields).model_fields:
        if getattr(scene.fields, name):
            yield "fields", name.replace("_", " ")
    for stage in scene.stages:
        yield "stages", describe_stage(stage)[0]


def _box(scene: MolecularScene) -> str:
    box = scene.box
    if not box.periodic:
        return "not periodic"
    if box.density_g_cm3 is not None:
        return f"periodic, {box.density_g_cm3:g} g/cm³"
    if box.lengths_A is not None:
        lengths = box.lengths_A if isinstance(box.lengths_A, tuple) else (box.lengths_A,) * 3
        return f"periodic, {' x '.join(f'{length:g}' for length in lengths)} Å"
    return "periodic, from the structure file"


def _body_rows(system: BodySystem) -> Iterable[TableRow]:
    scene, run = system.scene, system.scene.run
    pinned = "" if system.translates else ", pinned"
    yield (
        "body",
        (
            f"{system.kind}{pinned}, {system.mass:g} kg, {system.degrees_of_freedom} degrees of"
            " freedom"
        ),
    )
    if system.rotates:
        moments = ", ".join(f"{x:.6g}" for x in system.inertia)
        yield (
            "moments",
            f"{moments} kg m² about the {'centre of mass' if system.translates else 'pivot'}",
        )
        pose = system.pose(0.0, system.state)
        angles = ", ".join(
            f"{x + 0.0:.6g}°" for x in np.degrees(to_euler_angles(pose.rotation)).round(9)
        )
        spin = float(np.linalg.norm(pose.angular_velocity_body))
        motion = "at rest"
        if spin * run.duration_s > 1e-6:
            motion = (
                f"rotating at {spin:.6g} rad/s, {2 * np.pi / spin / run.timestep_s:.3g} steps per"
                " rotation"
            )
        yield "start", f"φ, θ, ψ = {angles}; {motion}"
    if acting := [word for name, word in ACTING.items() if getattr(scene, name)]:
        yield "acting", ", ".join(acting)
    yield "run", f"{run.duration_s:g} s in {run.steps} steps of {run.timestep_s:g} s"
    yield "method", "chosen before the run" if run.is_auto else run.integrator
    interval = scene.output.interval_s or inf
    yield "samples", f"every {max(1, round(interval / run.timestep_s)) * run.timestep_s:g} s"


def _columns(results: Results) -> str:
    """All columns with units, first and last values, folded."""
    families: dict[tuple[str, str], list[str]] = {}
    for name, column in results.samples.described.items():
        families.setdefault((column.unit, column.about), []).append(name)
    rows = []
    for (unit, about), names in families.items():
        values, ends = results[names[0]], ""
        if len(names) == 1 and values.ndim == 1 and len(values):
            ends = " ... ".join(x if isinstance(x, str) else f"{x:.6g}" for x in values[[0, -1]])
        rows.append((Raw(" ".join(f"<code>{name}</code>" for name in names)), unit, ends, about))
    listed = table(["column", "unit", "first ... last", ""], rows, words=True)
    return (
        f"<details><summary>{len(results.units)} columns: results[name]</summary>{listed}</details>"
    )


#: Most coordinates in a widget, which a notebook stores as text.
MOST_COORDINATES = 1_500_000
#: Height of a frame, pixels.
HEIGHT = 720


class AnimationPage:
    """A page with an animation, which a notebook shows in a frame; `page` is its HTML."""

    def __init__(self, page: str):
        self.page = page

    def _repr_html_(self) -> str:
        return (
            f'<iframe srcdoc="{html.escape(self.page)}"'
            f' style="width:100%;height:{HEIGHT}px;border:0"></iframe>'
        )

    def save(self, path: str | Path) -> Path:
        """Write the page, replacing a file of that name. Raises OutputError."""
        path = Path(path)
        write_text(path, self.page)
        return path


def show(results: Results) -> "StructureWidget | AnimationPage":
    """The animation of a run in a notebook: molecules by chemiscope, a body on a small page.

    Raises
    ------
    ImportError
        Without chemiscope.
    ValueError
        Without a trajectory.
    """
    if isinstance(results.system, BodySystem):
        record = record_of(results.system, results.samples, results.summary)
        return AnimationPage(
            page(record.scene.name, animation_parts(record, BodyAnimation(record)), FILM_STYLE)
        )
    try:
        import chemiscope
    except ImportError:
        raise ImportError(
            "rigidmd.view.show() of molecules needs chemiscope: pip install chemiscope"
        ) from None
    system = results.system
    massive = np.flatnonzero(system.sites.mass > 0)
    frames = _frames(results, system, max(2, MOST_COORDINATES // (3 * len(massive))))
    elements = [str(element) for element in system.sites.element[massive]]
    bonds = massive_bonds(system)
    structures = []
    for k, positions in enumerate(np.round(frames.positions[:, massive].astype(float), 3)):
        x, y, z = positions.T.tolist()
        structures.append(
            {"size": len(massive), "names": elements, "x": x, "y": y, "z": z, "bonds": bonds}
        )
        if frames.cells is not None:
            structures[k]["cell"] = frames.cells[k].ravel().tolist()
    settings = {
        "unitCell": frames.cells is not None,
        "keepOrientation": True,
        "spaceFilling": False,
        "axes": "off",
    }
    shown = chemiscope.show(
        structures,
        properties={"time": {"target": "structure", "values": frames.time.tolist(), "units": "ps"}},
        metadata={"name": system.scene.name, "description": " ".join(describe_thinning(frames))},
        settings={"structure": [settings]},
        mode="structure",
    )
    return cast("StructureWidget", shown)


def _frames(results: Results, system: System, max_frames: int) -> Frames:
    """At most `max_frames` frames, from the files of a run or from memory."""
    if not system.scene.output.trajectory or not results._frames:
        raise ValueError("this run has no frames (output.trajectory = false)")
    if results.files:
        record = record_of(system, results.samples, results.summary, [])
        try:
            return frames_of(replace(record, folder=results.files[0].parent), max_frames)
        except OutputError as error:
            raise ValueError(str(error)) from None
    count = len(results._frames)
    stride = max(1, -(-count // max_frames))
    chosen = results._frames[::stride]
    frames = Frames(
        time=np.array([frame.time for frame in chosen]),
        positions=np.array([frame.positions for frame in chosen]),
        cells=np.array([frame.cell for frame in chosen]) if system.density else None,
        count=count,
        stride=stride,
        is_cut=False,
    )
    return inside(frames, system.sites)
