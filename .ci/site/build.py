"""Write the site of the documentation as a folder of Markdown, with the configuration of a theme:

    python .ci/site/build.py FOLDER && mkdocs build --strict -f FOLDER/mkdocs.yml -d SITE

FOLDER/docs has the pages with equations as MathML, which browsers show without a script, anchors
at keys of scenes, the reference of the Python interface, and live pages. theme.yml and site.css are
the only files here that belong to the theme.
"""

import argparse
import json
import re
import shutil
import subprocess
import sys
import tempfile
from os.path import normpath
from pathlib import Path

import api
from equations import mathml

from rigidmd import __version__
from rigidmd.core.shipped import DOCS, GUIDES, SECTIONS

SITE = Path(__file__).parent
#: Live pages: scene, options of the run.
LIVE = {
    "heavy_top_3": "",
    "intermediate_axis": "",
    "dry_ice": "--set output.trajectory_interval_ps=0.1",
    "water": "--set stages.production.duration_ps=2 --set output.trajectory_interval_ps=0.1",
}
#: Live pages whose picture is made here. The documentation has the others.
WITH_PICTURE = ("intermediate_axis", "dry_ice")
#: Pages with keys of scenes, each of which has an anchor.
WITH_KEYS = ("scene.md", "body.md")
#: A list of all pages, for those who read the files. The site has a navigation.
LISTED = "contents"
#: Weights in a search by folder: what to do comes before how it was measured.
WEIGHTS = {"start": 2, "tutorials": 2, "guides": 2, "evidence": 0.5, "project": 0.25}
#: Other words for what a page is about.
SYNONYMS = {
    "chemical_potential": ["chemical potential"],
    "npt": ["density"],
    "potentials": ["own potential", "custom potential", "user-defined potential"],
    "resume": ["continue", "restart"],
    "run_times": ["how long", "speed"],
    "slab": ["surface tension"],
}
HEADING_OR_KEY = re.compile(r"^##+ (?P<heading>.+)$|^\| `(?P<key>\w+)`", re.MULTILINE)
CODE_OR_COMMENT = re.compile(
    r"^( *```+).*?^\1$|(?<!`)(`+)(?!`)(?:(?!\n\n).)+?(?<!`)\2(?!`)|<!--.*?-->",
    re.MULTILINE | re.DOTALL,
)
OPTION = re.compile(r"`-[^`\n]{,40}`")  # stays on one line
EQUATION = re.compile(r"\$\$(?P<display>.+?)\$\$|\$(?P<inline>[^$]+)\$", re.DOTALL)
LINK = re.compile(r"(?<!!)\[([^\]]+)\]\(([^)\s#]+)[^)\s]*\)")


def main() -> None:
    parser = argparse.ArgumentParser(description="Write the site as a folder of Markdown.")
    parser.add_argument("folder", type=Path)
    parser.add_argument("--without-live", action="store_true", help="leave live pages empty")
    arguments = parser.parse_args()
    docs = arguments.folder / "docs"
    if docs.exists():
        parser.error(f"{docs} exists")
    shutil.copytree(DOCS, docs)
    for name in ("site.css", "math.woff2", "math.OFL.txt"):
        shutil.copy(SITE / name, docs)
    front = (SITE / "front.txt").read_text(encoding="utf-8")
    (docs / "index.md").write_text(front.replace("VERSION", __version__), encoding="utf-8")
    (docs / "reference" / "api.md").write_text(api.page(), encoding="utf-8")
    (docs / "live").mkdir(exist_ok=True)
    for name in LIVE:
        write_live(name, docs / "live", is_empty=arguments.without_live)
    for path in docs.rglob("*.md"):
        text = page(path.relative_to(docs), path.read_text(encoding="utf-8"))
        header = f"---\n{json.dumps(settings(path))}\n---\n"  # JSON is YAML
        path.write_text(header + text, encoding="utf-8")
    theme = (SITE / "theme.yml").read_text(encoding="utf-8")
    config = f"{theme}nav: {json.dumps(navigation())}\n"
    (arguments.folder / "mkdocs.yml").write_text(config, encoding="utf-8")


def navigation() -> list[dict]:
    """Titles and pages, in the order of the site."""
    pages: dict[str, list] = {
        folder.capitalize(): [f"{folder}/{name}.md" for name in names if name != LISTED]
        for folder, names in SECTIONS.items()
    }
    pages["Guides"] = [
        {group: [f"guides/{name}.md" for name in names]} for group, names in GUIDES.items()
    ]
    pages["Reference"].append("reference/api.md")
    return [{"Home": "index.md"}, *({title: names} for title, names in pages.items())]


def page(path: Path, text: str) -> str:
    """A page of the documentation, by its path in the folder, as Markdown with HTML."""
    code: list[str] = []

    def store(found: re.Match) -> str:
        kept = "" if found[0].startswith("<!--") else found[0]
        code.append(f"{kept}{{ .option }}" if OPTION.fullmatch(kept) else kept)
        return f"\0{len(code) - 1}\0"

    def equation(found: re.Match) -> str:
        if tex := found["display"]:
            return f'<div class="math">{mathml(tex, "block")}</div>'
        return f'<span class="math">{mathml(found["inline"], "inline")}</span>'

    def link(found: re.Match) -> str:
        """A link to a file that is not part of the documentation becomes text."""
        label, target = found.groups()
        is_outside = normpath(path.parent / target).startswith("..")
        return label if is_outside else found[0]

    if path.name in WITH_KEYS:
        text = with_key_anchors(text)
    text = CODE_OR_COMMENT.sub(store, text)
    text = LINK.sub(link, EQUATION.sub(equation, text))
    return re.sub("\0(\\d+)\0", lambda found: code[int(found[1])], text)


def settings(path: Path) -> dict:
    """Settings of a page: its sidebars, and its weight and further words in a search."""
    if path.stem == "index":
        return {"hide": ["navigation", "toc"]}
    if path.stem == LISTED:
        return {"search": {"exclude": True}}
    weight = 0.5 if path.stem == "api" else WEIGHTS.get(path.parent.name, 1)
    return {"search": {"boost": weight}, "tags": SYNONYMS.get(path.stem, [])}


def with_key_anchors(text: str) -> str:
    """An anchor for each key in a table: #stages-timestep_fs below the heading `[[stages]]`."""
    heading = ""
    known = set()

    def anchor(found: re.Match) -> str:
        nonlocal heading
        if found["heading"]:
            heading = re.sub(r"\W+", "-", found["heading"].lower()).strip("-")
            return found[0]
        name = f"{heading}-{found['key']}"
        if name in known:
            return found[0]
        known.add(name)
        return f'| <a class="key" id="{name}" href="#{name}">`{found["key"]}`</a>'

    return HEADING_OR_KEY.sub(anchor, text)


def write_live(name: str, folder: Path, *, is_empty: bool) -> None:
    """The page that `rigidmd view` writes of a run of a shipped scene, and a picture of the run
    unless the documentation has one."""
    targets = {"view.html": folder / f"{name}.html"}
    if name in WITH_PICTURE:
        targets["film.gif"] = folder / f"{name}.gif"
    if is_empty:
        for target in targets.values():
            target.touch()
        return
    commands = [f"new {name}", f"run {name}.toml -o run {LIVE[name]}", "view run"]
    if name in WITH_PICTURE:
        commands.append("film run -o run/film.gif --seconds 4")
    with tempfile.TemporaryDirectory() as work:
        for command in commands:
            words = [sys.executable, "-P", "-m", "rigidmd", *command.split()]
            subprocess.run(words, cwd=work, check=True)
        for file, target in targets.items():
            shutil.copy(Path(work) / "run" / file, target)


if __name__ == "__main__":
    main()
