"""The animation of a run in a notebook: a widget of chemiscope for molecules, a page in a frame for a body."""

import html
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from rigidmd.core.files import write_text
from rigidmd.engines.body_system import BodySystem
from rigidmd.engines.system import System
from rigidmd.errors import OutputError
from rigidmd.io.trajectory import Frames
from rigidmd.view.animation_page import body_part, read_asset
from rigidmd.view.body_animation import animate_body
from rigidmd.view.molecule_animation import describe_thinning, frames_of, inside, massive_bonds
from rigidmd.view.page import page
from rigidmd.view.plots import record_of

if TYPE_CHECKING:
    from chemiscope.widget import StructureWidget

    from rigidmd.run.results import Results


#: Most coordinates in a widget, which a notebook stores as text.
MOST_COORDINATES = 1_500_000
#: Height of a frame, pixels.
HEIGHT = 720


class AnimationPage:
    """A page with an animation, which a notebook shows in a frame; `page` is its HTML."""

    def __init__(self, page: str):
        self.page = page

    def _repr_html_(self) -> str:
        return f'<iframe srcdoc="{html.escape(self.page)}" style="width:100%;height:{HEIGHT}px;border:0"></iframe>'

    def save(self, path: str | Path) -> Path:
        """Write the page, replacing a file of that name. Raises OutputError."""
        path = Path(path)
        write_text(path, self.page)
        return path


def show_animation(results: "Results") -> "StructureWidget | AnimationPage":
    """The animation of results. Raises ImportError without chemiscope, ValueError without a trajectory."""
    if isinstance(results.system, BodySystem):
        record = record_of(results.system, results.samples, results.summary)
        animation = animate_body(record)
        name = results.system.scene.name
        return AnimationPage(page(name, body_part(record, animation), f"<style>{read_asset('film.css')}</style>"))
    try:
        import chemiscope
    except ImportError:
        raise ImportError(
            "rigidmd.view.show() of molecules needs the extra rigidmd[view]: pip install chemiscope"
        ) from None
    system = results.system
    massive = np.flatnonzero(system.sites.mass > 0)
    frames = _frames(results, system, max(2, MOST_COORDINATES // (3 * len(massive))))
    elements = [str(element) for element in system.sites.element[massive]]
    bonds = massive_bonds(system)
    structures = []
    for k, positions in enumerate(np.round(frames.positions[:, massive].astype(float), 3)):
        x, y, z = positions.T.tolist()
        structures.append({"size": len(massive), "names": elements, "x": x, "y": y, "z": z, "bonds": bonds})
        if frames.cells is not None:
            structures[k]["cell"] = frames.cells[k].ravel().tolist()
    settings = {"unitCell": frames.cells is not None, "keepOrientation": True, "spaceFilling": False, "axes": "off"}
    shown = chemiscope.show(
        structures,
        properties={"time": {"target": "structure", "values": frames.time.tolist(), "units": "ps"}},
        metadata={"name": system.scene.name, "description": " ".join(describe_thinning(frames))},
        settings={"structure": [settings]},
        mode="structure",
    )
    return cast("StructureWidget", shown)


def _frames(results: "Results", system: System, most: int) -> Frames:
    """At most `most` frames, from the files of a run or from memory."""
    if not system.scene.output.trajectory or not results._frames:
        raise ValueError("this run has no frames (output.trajectory = false)")
    if results.files:
        record = record_of(system, results.samples, results.summary, [])
        try:
            return frames_of(replace(record, folder=results.files[0].parent), most)
        except OutputError as error:
            raise ValueError(str(error)) from None
    count = len(results._frames)
    stride = max(1, -(-count // most))
    chosen = results._frames[::stride]
    frames = Frames(
        time=np.array([frame.time for frame in chosen]), positions=np.array([frame.positions for frame in chosen]),
        cells=np.array([frame.cell for frame in chosen]) if system.density else None, count=count, stride=stride,
        is_cut=False,
    )  # fmt: skip
    return inside(frames, system.sites)
