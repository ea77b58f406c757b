"""Hooks of MkDocs for the site: pages made from other files, live pages, and equations."""

import html
import re
import subprocess
import sys
import tempfile
from os.path import normpath
from pathlib import Path

from latex2mathml.converter import convert
from mkdocs.structure.files import File

from rigidmd.core.shipped import SECTIONS

README = Path(__file__).parents[3] / "README.md"
#: Live pages: scene, options of the run.
LIVE = {
    "heavy_top_3": (),
    "intermediate_axis": (),
    "dry_ice": ("--set", "output.trajectory_interval_ps=0.1"),
    "water": (
        "--set",
        "stages.production.duration_ps=2",
        "--set",
        "output.trajectory_interval_ps=0.1",
    ),
}
CSS = """math {
  font-family: "Latin Modern Math", "STIX Two Math", "Cambria Math", "DejaVu Math TeX Gyre", math;
}
.md-typeset math { font-size: 1.08em; }
.md-typeset math mi[mathvariant^=bold] { font-weight: bold; }
.md-typeset mtd[columnalign=right] { text-align: right; }
.md-typeset mtd[columnalign=left] { text-align: left; }
.md-typeset td:first-child code, .md-typeset th code { white-space: nowrap; }
.md-typeset div.arithmatex { overflow-x: auto; overflow-y: hidden; padding: .3em 0; }
.md-typeset .docstring { white-space: pre-line; }
.md-typeset table:not([class]) td, .md-typeset table:not([class]) th {
  padding: .5em .8em; min-width: 0;
}
"""


def on_config(config):
    config.nav = [
        {"Home": ["index.md"]},
        *(
            {folder.capitalize(): [f"{folder}/{name}.md" for name in names]}
            for folder, names in SECTIONS.items()
        ),
    ]
    next(group["Reference"] for group in config.nav if "Reference" in group).append(
        "reference/api.md"
    )
    return config


def on_files(files, config):
    front = README.read_text(encoding="utf-8").replace("rigidmd/docs/", "")
    live = [f"[{name}](live/{name}.html)" for name in LIVE]
    front += (
        "\n## Live pages\n\nPages that `rigidmd view` wrote of shipped scenes:"
        f" {', '.join(live)}.\n"
    )
    files.append(File.generated(config, "index.md", content=front))
    files.append(File.generated(config, "site.css", content=CSS))
    for name in LIVE:
        files.append(
            File.generated(config, f"live/{name}.html", abs_src_path=str(_live_page(name)))
        )
    return files


def _live_page(name: str) -> Path:
    """The page that `rigidmd view` writes of a run of a shipped scene."""
    folder = Path(tempfile.mkdtemp())
    for command in (
        ("new", name),
        ("run", f"{name}.toml", "-o", "run", *LIVE[name]),
        ("view", "run"),
    ):
        subprocess.run([sys.executable, "-P", "-m", "rigidmd", *command], cwd=folder, check=True)
    return next((folder / "run").glob("*.html"))


def on_page_markdown(markdown, page, config, files):
    """Links to files that are not part of the documentation become text."""

    def link(found: re.Match) -> str:
        text, target = found.groups()
        path = normpath(Path(page.file.src_uri).parent / target.partition("#")[0])
        return (
            found[0] if re.match(r"#|https?:", target) or files.get_file_from_path(path) else text
        )

    return re.sub(r"(?<!!)\[([^\]]+)\]\(([^)\s]+)\)", link, markdown)


def on_page_content(content, page, config, files):
    """Equations in TeX become MathML."""

    def equation(found: re.Match) -> str:
        tag, opening, tex = found[1], found[2], html.unescape(found[3])
        display = "block" if opening == r"\[" else "inline"
        return f'<{tag} class="arithmatex">{convert(tex.strip(), display=display)}</{tag}>'

    return re.sub(
        r'<(span|div) class="arithmatex">(\\[\[(])(.*?)\\[\])]</\1>',
        equation,
        content,
        flags=re.DOTALL,
    )
