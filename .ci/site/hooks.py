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

from rigidmd.core.shipped import GUIDES, SECTIONS

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
#: Live pages whose picture the build makes.
WITH_PICTURE = ("intermediate_axis", "dry_ice")
SITE = Path(__file__).parent
#: Pages with keys of scenes, each of which has an anchor.
WITH_KEYS = ("reference/scene.md", "reference/body.md")
HEADING_OR_KEY = re.compile(
    r'<h[23] id="(?P<heading>[^"]+)"'
    r"|(?P<row><tr>\s*)<td(?P<style>[^>]*)><code>(?P<key>\w+)</code>"
)


def on_config(config):
    pages = {
        folder: [f"{folder}/{name}.md" for name in names] for folder, names in SECTIONS.items()
    }
    pages["guides"] = [
        {group: [f"guides/{name}.md" for name in names]} for group, names in GUIDES.items()
    ]
    pages["reference"].append("reference/api.md")
    named = {"evidence": "Evidence", "start": "Start"}
    config.nav = [
        {"Home": "index.md"},
        *({named.get(folder, folder.capitalize()): found} for folder, found in pages.items()),
    ]
    return config


def on_files(files, config):
    front = (SITE / "front.txt").read_text(encoding="utf-8")
    files.append(File.generated(config, "index.md", content=front))
    for name in ("site.css", "math.woff2", "math.OFL.txt"):
        files.append(File.generated(config, name, abs_src_path=str(SITE / name)))
    for name in LIVE:
        for path in _live_files(name):
            files.append(
                File.generated(config, f"live/{name}{path.suffix}", abs_src_path=str(path))
            )
    return files


def _live_files(name: str) -> list[Path]:
    """The page that `rigidmd view` writes of a run of a shipped scene, and a picture of the run
    unless the documentation has one."""
    folder = Path(tempfile.mkdtemp())
    commands = [
        ("new", name),
        ("run", f"{name}.toml", "-o", "run", *LIVE[name]),
        ("view", "run"),
    ]
    if name in WITH_PICTURE:
        commands.append(("film", "run", "-o", "run/film.gif", "--seconds", "4"))
    for command in commands:
        subprocess.run([sys.executable, "-P", "-m", "rigidmd", *command], cwd=folder, check=True)
    return [*(folder / "run").glob("view.html"), *(folder / "run").glob("film.gif")]


def on_page_markdown(markdown, page, config, files):
    """Links to files that are not part of the documentation become text."""

    def link(found: re.Match) -> str:
        text, target = found.groups()
        path = normpath(Path(page.file.src_uri).parent / target.partition("#")[0])
        return (
            found[0] if re.match(r"#|https?:", target) or files.get_file_from_path(path) else text
        )

    return re.sub(r"(?<!!)\[([^\]]+)\]\(([^)\s]+)\)", link, markdown)


def _key_anchors(content: str) -> str:
    """An anchor for each key in a table: #stages-timestep_fs below the heading `[[stages]]`."""
    heading = ""
    known = set()

    def anchor(found: re.Match) -> str:
        nonlocal heading
        if found["heading"]:
            heading = found["heading"]
            return found[0]
        name = f"{heading}-{found['key']}"
        if name in known:
            return found[0]
        known.add(name)
        link = f'<a class="key" href="#{name}"><code>{found["key"]}</code></a>'
        return f'{found["row"]}<td id="{name}"{found["style"]}>{link}'

    return HEADING_OR_KEY.sub(anchor, content)


def on_page_content(content, page, config, files):
    """Equations in TeX become MathML, and keys of scenes get anchors."""
    if page.file.src_uri in WITH_KEYS:
        content = _key_anchors(content)

    def equation(found: re.Match) -> str:
        tag = found[1]
        opening = found[2]
        tex = html.unescape(found[3])
        display = "block" if opening == r"\[" else "inline"
        return f'<{tag} class="arithmatex">{convert(tex.strip(), display=display)}</{tag}>'

    return re.sub(
        r'<(span|div) class="arithmatex">(\\[\[(])(.*?)\\[\])]</\1>',
        equation,
        content,
        flags=re.DOTALL,
    )
