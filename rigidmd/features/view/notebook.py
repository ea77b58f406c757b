"""The display of scenes, simulations, results (tables and a figure, light or dark) and animations
in a notebook."""

import html
from pathlib import Path
from typing import TYPE_CHECKING

from rigidmd.core.display import html as html_of
from rigidmd.core.files import write_text
from rigidmd.errors import InputError, OutputError
from rigidmd.features.view.kind_display import display_of
from rigidmd.features.view.page import Raw, code, figure, items, notes, page, read_asset, table
from rigidmd.features.view.plots import record_of
from rigidmd.features.view.run_page import FILM_STYLE, animation_parts, page_title
from rigidmd.run.kind import describe, kind_of
from rigidmd.run.results import Results
from rigidmd.run.simulation import Simulation
from rigidmd.scene import Scene

if TYPE_CHECKING:
    from rigidmd.features.view.figures.picture import Picture

STYLE = read_asset("notebook.css")


@html_of.register
def scene_html(scene: Scene) -> str:
    try:
        text = code(describe(scene, user_code=False))
    except InputError as error:
        text = f"<p>{html.escape(scene.in_short)}</p>{items(error.errors)}"
    return framed(scene.name, display_of(scene).title, text)


@html_of.register
def simulation_html(simulation: Simulation) -> str:
    folder = simulation.folder
    where = "nowhere: the results stay in memory" if folder is None else str(folder)
    rows = [("threads", str(simulation.threads)), ("writes to", where)]
    if names := [type(observer).__name__ for observer in simulation._observers]:
        rows.append(("observers", ", ".join(names)))
    described = kind_of(simulation.scene).describe(simulation.system)
    text = code(described) + table([], rows, words=True)
    return framed(simulation.scene.name, "ready to run: run() does it", text)


@html_of.register
def results_html(results: Results) -> str:
    summary = results.summary
    name = results.system.scene.name
    system = results.system
    display = display_of(system.scene)
    text = [
        f"<p>{html.escape(title)}</p>{table([], rows, words=True)}"
        for title, rows in display.tables(system, summary)
    ]
    stem, drawn = next(iter(display.figures(system, results.samples, summary).items()), ("", None))
    left = f"{''.join(text)}{notes(summary['notes'])}"
    right = drawing_of(drawn, f"{name}-{stem}", f"figure: {stem}")
    return framed(name, results._summary_line, f"{sides(left, right)}{_columns(results)}")


def sides(left: str, right: str) -> str:
    """Text and figure side by side."""
    return f'<div class="sides"><div>{left}</div>{f"<div>{right}</div>" if right else ""}</div>'


def drawing_of(drawing: "Picture | None", salt: str, about: str) -> str:
    """A figure in the colours of the notebook, or on white if it has a shaded solid. Empty without
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


def _columns(results: Results) -> str:
    """All columns with their units, folded."""
    described = results.samples.described.items()
    rows = [(Raw(f"<code>{name}</code>"), column.unit, column.about) for name, column in described]
    listed = table(["column", "unit", ""], rows, words=True)
    title = f"{len(results.units)} columns: results[name]"
    return f"<details><summary>{title}</summary>{listed}</details>"


#: Height of a frame, pixels.
HEIGHT = 720


class AnimationPage:
    """A page with an animation, which a notebook shows in a frame. `page` is its HTML."""

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


def show(results: Results) -> AnimationPage:
    """The animation of a run in a notebook, on a small page with the plots.

    Parameters
    ----------
    results : Results
        Results of a run with a trajectory

    Returns
    -------
    AnimationPage
        The page, which a notebook displays

    Raises
    ------
    ImportError
        For molecules, without chemiscope.
    ValueError
        Without a trajectory.
    """
    system = results.system
    record = record_of(system, results.samples, results.summary)
    try:
        animation = display_of(system.scene).animation_in_memory(results, record)
    except OutputError as error:
        kind = ImportError if "chemiscope" in str(error) else ValueError
        raise kind(str(error)) from None
    return AnimationPage(page(page_title(record), animation_parts(record, animation), FILM_STYLE))
