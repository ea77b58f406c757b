"""The template and the writer of all pages: one self-contained HTML file, readable on a phone, in
the dark and in print."""

import html
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rigidmd.core.files import write_text
from rigidmd.core.toml import Json
from rigidmd.features.view.figures.style import DARK_PALETTE, FAINT, PALETTE, curve_style, drawing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from rigidmd.features.view.figures.picture import Picture

#: Classes of a verdict: what is good, what to look at, what is wrong.
GOOD, DOUBTFUL, BAD = "good", "doubtful", "bad"


def read_asset(name: str) -> str:
    """A script or a style of this package, with the colours of figures."""
    text = Path(__file__).with_name(name).read_text(encoding="utf-8")
    for kind, palette in (("light", PALETTE), ("dark", DARK_PALETTE)):
        colors = ";".join(f"--{color}:{digits}" for color, digits in palette.items())
        text = text.replace(f"--palette:{kind}", colors)
    return text


STYLE = read_asset("page.css")


class PagePart(NamedTuple):
    """An animation on a page."""

    picture: str  # HTML
    legend: str  # HTML
    usage: str  # how to use it
    data: Json  # for the scripts: JSON values and arrays
    scripts: list[str]


class Animation:
    """The animation of a run."""

    time: np.ndarray  # (t,)
    notes: list[str]

    def draw(self, axes: "Axes", time: float) -> None:
        """Draw the picture at a time."""
        raise NotImplementedError

    def page_part(self) -> PagePart:
        """Its part of a page."""
        raise NotImplementedError

    def loop_end(self) -> tuple[float, list[str]]:
        """The time at which a file ends, and notes on it."""
        return float(self.time[-1]), []

    def film_notes(self, step: float, seconds: float) -> list[str]:
        """Notes on a file with pictures at intervals of `step` that lasts for some seconds."""
        return []


def page(title: str, parts: Iterable[str], style: str = "") -> str:
    """A whole page of HTML parts under a title (plain text), with more style."""
    title_html = html.escape(title)
    body = "\n".join(part for part in parts if part)
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8">\
<meta name="viewport" content="width=device-width,initial-scale=1">\
<title>{title_html}</title>
<style>{STYLE}{style}</style></head>
<body>
<h1>{title_html}</h1>
{body}
</body></html>
"""


def write_page(path: Path, title: str, parts: Iterable[str], style: str = "") -> None:
    """Write a page of parts, which may be made while it is written; see `figures.style.drawing`.
    Raises OutputError."""
    with drawing(path):
        write_text(path, page(title, parts, style))


def section(title: str, *parts: str, anchor: str = "") -> str:
    """A heading (plain text) and HTML parts. Empty without any part."""
    if not any(parts):
        return ""
    name = f' id="{html.escape(anchor)}"' if anchor else ""
    return (
        f"<section><h2{name}>{html.escape(title)}</h2>\n"
        + "\n".join(part for part in parts if part)
        + "</section>"
    )


def table(
    titles: Sequence[str],
    rows: Iterable[Sequence[object]],
    words: bool = False,
    marked: Mapping[str, object] = {},
) -> str:
    """A table of plain text, which scrolls if it is too wide. words: cells are sentences, aligned
    left. marked: cell of the first column -> what is shown instead, such as one of `chips`"""
    head = "".join(f"<th>{html.escape(title)}</th>" for title in titles)
    kind = ' class="words"' if words else ""
    cells = [[_cell(marked.get(str(first), first)), *map(_cell, rest)] for first, *rest in rows]
    body = "".join(f"<tr>{''.join(line)}</tr>\n" for line in cells)
    top = f"<thead><tr>{head}</tr></thead>" if titles else ""
    return (
        f'<div class="scroll"><table{kind}>{top}<tbody>\n{body}</tbody></table></div>'
        if body
        else ""
    )


class Raw(str):
    """A cell or item that is HTML already."""


def _cell(value: object) -> str:
    text = plain(value)
    visible = re.sub(r"<[^>]*>", "", text) if isinstance(value, Raw) else str(value)
    return f'<td class="wrap">{text}</td>' if len(visible) > 40 else f"<td>{text}</td>"


def plain(value: object) -> str:
    if isinstance(value, Raw):
        return value
    return "" if value is None else html.escape(str(value))


def chips(names: Iterable[str]) -> dict[str, Raw]:
    """Names with the colours of their curves, as cells."""
    mark = '<span style="color:{}">■</span> {}'
    return {
        name: Raw(mark.format(curve_style(k)["color"], plain(name))) for k, name in enumerate(names)
    }


def items(lines: Iterable[object]) -> str:
    entries = "".join(f"<li>{plain(line)}</li>\n" for line in lines)
    return f"<ul>\n{entries}</ul>" if entries else ""


def notes(lines: Iterable[str]) -> str:
    """Sentences that must be seen."""
    return "\n".join(f'<p class="note">{html.escape(line)}</p>' for line in lines)


def code(text: str) -> str:
    return f"<pre>{html.escape(text)}</pre>"


def figure(drawn: "Picture", salt: str, about: str) -> str:
    """A figure of Matplotlib as part of a page, whose colours it takes. salt: another one for each
    figure of a page."""
    for part in (drawn, *drawn.axes):
        part.patch.set_visible(False)
    text = drawn.data("svg", 0, fonttype="none", hashsalt=salt).decode()
    label = f'<svg role="img" aria-label="{html.escape(about)}"'
    svg = text[text.index("<svg") :].replace("<svg", label, 1)
    for name, color in (PALETTE | {"faint": FAINT}).items():
        svg = svg.replace(color, f"var(--{name})")
    return svg


def wide(drawn: "Picture", salt: str, about: str) -> str:
    """A figure of several panels, which scrolls on a narrow screen."""
    width = 120 * drawn.get_figwidth()  # pixels
    style = f"max-width:{width:.0f}px;min-width:{min(620.0, 0.7 * width):.0f}px"
    return (
        '<div class="scroll"><div class="wide"'
        f' style="{style}">{figure(drawn, salt, about)}</div></div>'
    )
