"""Files that are shipped with the package: example scenes, notebooks, scripts, chapters of the
documentation."""

import json
import re
import shutil
import textwrap
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from rigidmd.core.files import atomic_file, writing
from rigidmd.core.plain_text import did_you_mean, similar_names, suggestion
from rigidmd.errors import InputError, OutputError, option

PACKAGE = Path(__file__).parent.parent
#: In a wheel the scenes are inside the package; in a checkout or an editable install they are next
#: to it.
SYSTEMS = next(path for path in (PACKAGE / "systems", PACKAGE.parent / "systems") if path.is_dir())
DOCS = PACKAGE / "docs"
NOTEBOOKS, SCRIPTS = "notebooks/*.ipynb", "scripts/*.py"
#: Shipped files in the chapters: stem, extension.
_SHIPPED = re.compile(r"systems/(?:scripts/|notebooks/)?(\w+)(\.toml|\.ipynb|\.py)")
#: Kind of an example by the extension of its file.
KINDS = {".toml": "scene", ".ipynb": "notebook", ".py": "script"}
#: Guides by what they are for.
GUIDES = {
    "Set up": ("structures", "electrostatics", "potentials", "ensembles"),
    "Run": ("npt", "slab", "time_step", "run_times", "resume", "troubleshooting"),
    "Analyse": (
        "analysis",
        "transport",
        "normal_modes",
        "chemical_potential",
        "free_energies",
        "pictures",
    ),
    "Many runs": ("studies",),
    "Other programs": ("coming_from", "ase", "engines"),
    "Extend": ("extending",),
}
#: Folders of the documentation and their chapters, in the order of the list.
SECTIONS = {
    "start": ("installation", "why", "contents"),
    "tutorials": ("water", "top", "molecule", "notebook"),
    "guides": tuple(name for names in GUIDES.values() for name in names),
    "theory": ("dynamics", "bodies", "interactions", "sampling", "errors", "zero_step"),
    "reference": (
        "commands",
        "scene",
        "body",
        "models",
        "integrators",
        "files",
        "python",
        "units",
        "limits",
    ),
    "evidence": (
        "benchmarks",
        "accuracy_cost",
        "time_step_water",
        "validation",
        "robustness",
    ),
    "project": ("contributing", "changelog"),
}
CHAPTERS = {
    name: DOCS / folder / f"{name}.md" for folder, names in SECTIONS.items() for name in names
}


BEST = 3  # pages with a word that are shown with their subjects


class Example(NamedTuple):
    """A shipped scene, notebook or script."""

    name: str
    path: Path
    about: str  # the first line of its comment, or of its text
    tables: tuple[str, ...] = ()  # of a scene
    molecules: int | None = None  # of a scene that gives all counts

    @property
    def kind(self) -> str:
        return KINDS[self.path.suffix]


def examples(files: str = "*.toml") -> list[Example]:
    """The shipped scenes, or the examples among other files, sorted by name. Numbers within names
    by their value."""
    shipped = []
    for path in SYSTEMS.glob(files):
        text = path.read_text(encoding="utf-8")
        tables = tomllib.loads(text) if path.suffix == ".toml" else {}
        first = "".join(json.loads(text)["cells"][0]["source"]) if path.suffix == ".ipynb" else text
        shipped.append(
            Example(
                path.stem,
                path,
                first.partition("\n")[0].removeprefix("# "),
                tuple(tables),
                _count_of(tables.get("molecules", [])),
            )
        )
    return sorted(
        shipped,
        key=lambda one: [int(p) if p.isdigit() else p for p in re.split(r"(\d+)", one.name)],
    )


def _count_of(molecules: list[dict]) -> int | None:
    """The number of molecules of a scene, if its [[molecules]] have it."""
    counts = [entry["count"] for entry in molecules if "count" in entry]
    return sum(counts) if len(counts) == len(molecules) > 0 else None


def find_example(name: str) -> Example:
    """The example with this name, or the first scene in a numbered series with this name. Raises
    InputError."""
    known = {
        example.name: example for example in [*examples(), *examples(NOTEBOOKS), *examples(SCRIPTS)]
    }
    if name in known:
        return known[name]
    if series := series_of(name):
        return known[series[0]]
    stem = Path(name).stem
    near = [other for other in known if f"{other}_".startswith(f"{stem}_")] or similar_names(
        stem, known
    )
    hint = suggestion(near) or ";"
    raise InputError(
        "examples", [f"unknown scene {name!r}{hint} `rigidmd examples` lists all {len(known)}"]
    )


def series_of(name: str) -> list[str]:
    """The scenes NAME_1, NAME_2 and so on. The list is empty if there are none."""
    return [
        example.name
        for example in examples()
        if re.fullmatch(rf"{re.escape(name)}_\d+", example.name)
    ]


def copy_example(
    example: Example, path: Path, *, force: bool, read: Iterable[Path] = ()
) -> list[Path]:
    """Copy an example to `path`, with the files that it reads. Returns the paths written. Raises
    OutputError."""
    if path.suffix != example.path.suffix:
        other = f"{option('file')} names another file for the {example.kind}"
        raise OutputError(f"{path} must end in {example.path.suffix}: {other}")
    inputs = {path.parent / file.relative_to(example.path.parent): file for file in read}
    for target in (path, *inputs):
        is_equal_input = (
            target in inputs
            and target.is_file()
            and target.read_bytes() == inputs[target].read_bytes()
        )
        if target.is_dir():
            raise OutputError(f"{target} is a folder; {option('file')} names another file")
        if target.exists() and not force and not is_equal_input:
            raise OutputError(
                f"{target} exists; {option('force')} replaces it, {option('file')} names another"
                " file"
            )
    for target, source in {path: example.path, **inputs}.items():
        with writing(target):
            target.parent.mkdir(parents=True, exist_ok=True)
            with atomic_file(target) as temporary:
                shutil.copyfile(source, temporary)
    return [path, *inputs]


def contents() -> dict[str, dict[str, str]]:
    """Chapters of the documentation by folder: name -> subject, the first line under its title."""
    return {
        folder: {name: CHAPTERS[name].read_text(encoding="utf-8").splitlines()[2] for name in names}
        for folder, names in SECTIONS.items()
    }


def chapter_text(name: str) -> str:
    """A chapter as plain text, without comments, or the chapters that contain a word. Pictures
    become name and path. Raises InputError."""
    if name in CHAPTERS:
        return _plain(name)
    counts = _pages_with(name)
    if not counts:
        hint = did_you_mean(name, CHAPTERS) or ";"
        raise InputError(
            "help", [f"no page is or contains {name!r}{hint} `rigidmd help` lists all"]
        )
    subjects = {page: about for pages in contents().values() for page, about in pages.items()}
    best, others = list(counts)[:BEST], list(counts)[BEST:]
    lines = [f"pages that contain the word: {len(counts)}"]
    lines += [f"  {page} ({counts[page]}): {subjects[page]}" for page in best]
    named = ", ".join(f"{page} ({counts[page]})" for page in others)
    lines += [textwrap.fill(named, 98, initial_indent="  ", subsequent_indent="  ")] * bool(others)
    return "\n".join([*lines, f"`rigidmd help {best[0]}` prints the first"])


def _pages_with(word: str) -> dict[str, int]:
    """How often the chapters have a word, most often first."""
    pattern = re.compile(rf"\b{re.escape(word)}", re.IGNORECASE)
    searched = [chapter for chapter in CHAPTERS if chapter not in ("changelog", "contents")]
    counts = {chapter: len(pattern.findall(_plain(chapter))) for chapter in searched}
    found = [chapter for chapter in searched if counts[chapter]]
    return {chapter: counts[chapter] for chapter in sorted(found, key=lambda c: -counts[c])}


def _plain(name: str) -> str:
    """The text of a chapter. Shipped files are named as `rigidmd new` copies them, not by their
    paths."""
    text = re.sub(r"<!--.*?-->\n?", "", CHAPTERS[name].read_text(encoding="utf-8"), flags=re.DOTALL)
    copied = sorted(set(_SHIPPED.findall(text)))
    title, _, text = text.partition("\n")
    if copied:
        files = textwrap.fill(", ".join(f"{stem}{extension}" for stem, extension in copied), 120)
        title += f"\n\n`rigidmd new NAME` copies the shipped files that are named here:\n{files}"

    def picture(match: re.Match) -> str:
        about, path = match.groups()
        return f"[picture: {about}, {(CHAPTERS[name].parent / path).resolve()}]"

    text = re.sub(r"!\[([^\]]*)\]\(([^)]*)\)", picture, _SHIPPED.sub(r"\1\2", text))
    return f"{title}\n{text}".rstrip()
