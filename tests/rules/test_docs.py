"""README and the chapters: every command and snippet in them runs, every key and column is in the
manual, no link is dead.

tests/support/documents.py describes the comments before blocks. Commands and snippets of a document run in their order, in one folder that has a copy of systems/.
"""

import argparse
import contextlib
import csv
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from pydantic import BaseModel
from support.common import ROOT
from support.documents import (
    DOCUMENTS,
    PAGES,
    README,
    Block,
    blocks_of,
    changed,
    commands_of,
    new_scenes,
    output_of,
    pattern_of,
    write_files,
)
from support.page_figures import FIGURES, SCRIPTS

from rigidmd.commands import cli
from rigidmd.commands.arguments import read_scene
from rigidmd.core.integrators import SCHEMES, WITH_THERMOSTAT
from rigidmd.core.shipped import CHAPTERS, DOCS, GUIDES, SECTIONS, examples, find_example
from rigidmd.errors import SceneError
from rigidmd.formats import BY_EXTENSION, all_formats
from rigidmd.run.kind import with_defaults
from rigidmd.scene import BodyScene, MolecularScene, Scene, parse_override
from rigidmd.scene.models import read_parameters

MANUAL = "\n".join(
    path.read_text(encoding="utf-8") for path in PAGES.values() if path.parent.name == "reference"
)
#: Commands that run scenes, for which pages have shorter forms.
LONG = ("run", "accuracy", "sweep", "virial", "stability")
#: Commands, and options of commands, that no page runs, and the test that does.
ELSEWHERE = {
    "compare": "test_a_body_continues",
    "resume": "test_a_body_continues",
    "--repeats": "test_the_smallest_form_runs_and_leaves_the_checkout_alone",
    "--scheduler": "test_points_run_on_a_cluster_of_dask",
    "--to": "test_a_script_for_slurm",
    "--collect": "test_a_script_for_slurm",
}
LANGUAGES = {"sh", "python", "toml", "text", "bibtex"}
MINIMAL = {
    MolecularScene: {
        "box": {"lengths_A": 40.0},
        "molecules": [{"model": "spce", "count": 2}],
        "start": {"temperature_K": 300.0},
        "stages": [{"duration_ps": 1.0}],
    },
    BodyScene: {
        "body": {"mass_kg": 1.0, "inertia_kg_m2": [1.0, 2.0, 2.5]},
        "run": {"duration_s": 1.0, "timestep_s": 0.01},
    },
}


class Reader:
    """Does what a document shows its reader to do, in the working directory."""

    def __init__(self, monkeypatch, capsys):
        self.monkeypatch, self.capsys = monkeypatch, capsys
        self.namespace: dict = {"__name__": "__main__"}
        self.printed: dict[str, str] = {}  # by the commands so far

    def follow(self, block: Block) -> None:
        how, _, rest = block.about.partition(" ")
        assert how in ("", "file", "with", "end", "not", "output", "recorded"), block.about
        assert block.about or block.language != "text" or "±" not in block.text, (
            "quoted output must have its command"
        )
        write_files([block], Path())
        options = shlex.split(rest) if how == "with" else []
        if block.language == "sh":
            for words in commands_of(block.text):
                self.command(words, options, runs=how != "not")
        elif block.language == "toml":
            self.scene(tomllib.loads(block.text), rest if how == "file" else "")
        elif block.language == "python" and how != "file":
            self.python(block, options)
        elif how == "output":
            quoted = output_of(block)
            assert quoted.kind in ("of", "like"), block.about
            self.output(quoted.commands[0], block.text, quoted.kind == "like")

    def output(self, words: list[str], text: str, like: bool) -> None:
        """Every line of a block must be in the output of a command, in this order."""
        if shlex.join(words) not in self.printed:
            self.command(words, [], runs=True)
        printed = self.printed[shlex.join(words)]
        remaining = iter(printed.splitlines())
        for quoted in filter(lambda line: line.strip() not in ("", "..."), text.splitlines()):
            pattern = pattern_of(quoted, like)
            found = any(pattern.fullmatch(line) for line in remaining)
            assert found, f"not in the output, or not in this order: {quoted!r}\n{printed}"

    def command(self, words: list[str], options: list[str], runs: bool) -> None:
        given = shlex.join(words)
        alone = options if options and not options[0].startswith("-") else []
        match words:
            case ["rigidmd", *arguments]:
                to = Path(arguments[arguments.index(">") + 1]) if ">" in arguments else None
                arguments = arguments[: arguments.index(">")] if to else arguments
                if arguments[0] in LONG and not alone:
                    arguments = changed(arguments, options)
                if arguments[0] == "analyse":
                    arguments += alone
                if arguments[0] == "film":
                    arguments += ["--seconds", "0.3"]
                parse(arguments)
                if runs:
                    code = cli.main(arguments)
                    said = self.capsys.readouterr()
                    assert code == 0, said.err or said.out
                    self.printed[given] = said.out
                    if to is not None:
                        to.write_text(said.out)
            case ["python", script, *_] if script.startswith("tests/benchmarks/"):
                assert not runs  # its options are checked in test_benchmarks.py
            case ["python", script]:
                done = subprocess.run([sys.executable, script], capture_output=True, text=True)
                assert done.returncode == 0, done.stderr
            case ["pip", "install", what]:
                project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
                assert what in (".", *(f".[{extra}]" for extra in project["optional-dependencies"]))
            case ["pytest"] | ["pytest", "-m", "soak"]:
                pass
            case ["sbatch", _]:
                assert not runs
            case ["pytest", "-m", "soak", "-rP", *scripts]:
                assert not runs
                for script in scripts:
                    assert "@pytest.mark.soak" in (ROOT / script).read_text()
            case _:
                pytest.fail(f"no command that this test knows: {words}")

    def python(self, block: Block, options: list[str]) -> None:
        extra = dict(parse_override(text) for text in options if text != "--set")
        read = Scene.read.__func__

        def shortened(cls, path, overrides=None):
            return read(cls, path, (overrides or {}) | extra)

        with self.monkeypatch.context() as patch:
            patch.setattr(Scene, "read", classmethod(shortened))
            exec(compile("\n" * (block.line - 1) + block.text, "snippet", "exec"), self.namespace)

    def scene(self, data: dict, file: str) -> None:
        """A whole scene must build; a fragment must validate within a minimal scene; a table of
        sites as such."""
        if "sites" in data:
            assert file, "a molecule or table of parameters is a file"
            if "name" not in data:
                read_parameters(Path(file))
            else:
                assert cli.main(["models", file]) == 0
            return
        if {"molecules", "stages"} <= set(data) or {"body", "run"} <= set(data):
            with_defaults(Scene.from_dict(data, "."))
            return
        if (named := data.get("structure", {}).get("file")) is not None:
            Path(named).touch()  # a fragment is not built: it is enough that the file is there
        faults = []
        for kind, minimal in MINIMAL.items():
            whole = {
                key: value
                for key, value in minimal.items()
                if key != "box" or "structure" not in data
            } | data
            try:
                kind.from_dict(whole, ".")
                return
            except SceneError as error:
                faults.append(str(error))
        pytest.fail("\n".join(faults))


def parse(arguments: list[str]) -> argparse.Namespace:
    """The options of a command line, its scene read with them if it is there. Fails where the
    commands would."""
    try:
        options = cli._parse(arguments)
    except SystemExit as error:
        pytest.fail(f"rigidmd {shlex.join(arguments)}: exit code {error.code}")
    scene = getattr(options, "scene", None)
    if scene is not None and Path(scene).suffix == ".toml" and Path(scene).exists():
        read_scene(options)
    return options


@pytest.fixture
def own_formats():
    """Formats that a document registers are gone after its test."""
    all_formats()
    before = dict(BY_EXTENSION)
    yield
    BY_EXTENSION.clear()
    BY_EXTENSION.update(before)


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.stem)
def test_what_a_document_describes_can_be_done(
    document, tmp_path, monkeypatch, capsys, own_formats
):
    shutil.copytree(ROOT / "systems", tmp_path / "systems")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["rigidmd"])
    reader = Reader(monkeypatch, capsys)
    for block in blocks_of(document):
        assert block.language in LANGUAGES, (
            f"{document.name}:{block.line}: a block of {block.language!r}"
        )
        try:
            reader.follow(block)
        except BaseException as error:
            error.add_note(f"in {document.name}, the block at line {block.line}")
            raise
    for path in [*tmp_path.rglob("log.csv"), *tmp_path.rglob("motion.csv")]:
        with path.open() as file:
            header = next(csv.reader(file))
        part = section("Columns of log.csv" if path.name == "log.csv" else "Columns of motion.csv")
        named = set(re.findall(r"`([^`]+)`", part))
        scene = tomllib.loads((path.parent / "scene.toml").read_text())
        tables = scene.get("forces", {})
        names = [entry["name"] for entry in tables.get("custom", ())]
        names += [entry.get("name", entry.get("potential")) for entry in tables.get("bodies", ())]
        own = {f"{name} (kJ/mol)" for name in names}
        header = ["NAME (kJ/mol)" if column in own else column for column in header]
        assert {_first_of_its_kind(column) for column in header} <= named


DURATION_AND_STEP = re.compile(r"([\d.,]+) ps at ([\d.]+) fs|([\d,]+) steps of ([\d.]+) (?:fs|s)\b")


def quoted_segments(text: str) -> set[tuple[float, float]]:
    """(number of steps, time step) that a quoted output has: of molecules in fs, of a body in s."""
    numbers = [
        [each and float(each.replace(",", "")) for each in found.groups()]
        for found in DURATION_AND_STEP.finditer(text)
    ]
    return {
        (round(duration * 1e3 / short), short) if duration else (count, step)
        for duration, short, count, step in numbers
    }


def test_numbers_of_steps_in_outputs_are_found():
    text = "NVT, 10 ps at 4 fs, 3 steps/s\n3,400 steps of 0.0005 s, 1.7 s\n0: 2500 steps of 4 fs = 10 ps"
    assert quoted_segments(text) == {(2500, 4.0), (3400, 0.0005)}


def segments_of(scene: Scene) -> set[tuple[float, float]]:
    """The same of a scene."""
    if isinstance(scene, BodyScene):
        return {(round(scene.run.duration_s / scene.run.timestep_s), scene.run.timestep_s)}
    return {
        (round(stage.duration_ps * 1e3 / stage.timestep_fs), stage.timestep_fs)
        for stage in scene.stages
        if stage.duration_ps
    }


def integrators_of(scene: Scene) -> set[str]:
    stages = [scene.run] if isinstance(scene, BodyScene) else scene.stages
    return {stage.integrator for stage in stages}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.stem)
def test_recorded_output_is_of_the_scene_with_the_defaults_of_today(
    document, tmp_path, monkeypatch, capsys
):
    """Numbers of steps, time steps and integrators, which are known without a run."""
    shutil.copytree(ROOT / "systems", tmp_path / "systems")
    monkeypatch.chdir(tmp_path)
    blocks = blocks_of(document)
    for k, block in enumerate(blocks):
        quoted = output_of(block)
        if quoted is None or not quoted.where:
            assert quoted is None or quoted.kind == "of", (
                f"line {block.line}: where it was recorded must follow a bar"
            )
            continue
        write_files(blocks[:k], tmp_path)
        for words in new_scenes(blocks[:k]):
            cli.main([*words[1:], "--force"])
        runs = [parse(words[1:]) for words in quoted.commands]
        scenes = [
            with_defaults(read_scene(options))
            for options, words in zip(runs, quoted.commands, strict=True)
            if words[1] == "run"
        ]
        if scenes:
            assert quoted_segments(block.text) <= set().union(*map(segments_of, scenes))
            named = set(re.findall(r"\w+", block.text)) & set(SCHEMES)
            assert named <= set().union(*map(integrators_of, scenes))


def form_of(words: list[str]) -> tuple[str, ...]:
    """A command and its options, without their values."""
    return (words[1], *sorted({word for word in words if re.match(r"--?[a-z]", word)}))


def test_every_command_on_a_page_runs():
    """Where it stands; or on another page with the same options, in a test of its own, or in .ci/run."""
    runs, others = set(), {}
    for document in DOCUMENTS:
        for block in (block for block in blocks_of(document) if block.language == "sh"):
            for words in (words for words in commands_of(block.text) if words[:1] == ["rigidmd"]):
                if block.about.startswith("not run"):
                    others[form_of(words)] = f"{document.name}:{block.line}"
                else:
                    runs.add(form_of(words))
    lacking = {shlex.join(form): others[form] for form in others.keys() - runs}
    assert {form for form in lacking if not ELSEWHERE.keys() & set(form.split())} == set(), lacking
    tests = "".join(path.read_text("utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    assert all(f"def {name}(" in tests for name in ELSEWHERE.values())


def _first_of_its_kind(column: str) -> str:
    """The column that stands in the manual for all of its kind: omega_body_1 (rad/s) for
    omega_body_2 (rad/s), q11 for q23."""
    column = re.sub(r"^L_\w+_error$", "L_z_error", column)
    return re.sub(
        r"_[xyz](?= \(|$)",
        "_x",
        re.sub(r"_[123](?= \(|$)", "_1", re.sub(r"^q\d\d$", "q11", column)),
    )


def section(title: str) -> str:
    """What stands under a heading of the manual, to the next of its rank."""
    rank = re.search(rf"^(#+) {re.escape(title)}$", MANUAL, re.MULTILINE)
    assert rank, f"the manual has no heading {title!r}"
    text = MANUAL[rank.end() :]
    after = re.search(rf"^#{{1,{len(rank[1])}}} ", text, re.MULTILINE)
    return text[: after.start()] if after else text


_, COMMANDS = cli._parser()
PLACEHOLDERS = {
    "SCENE": "scene.toml",
    "[NAME]": "",
    "[CHAPTER]": "",
    "NAME": "x",
    "CHAPTER": "x",
    "KEY=VALUE": "a=1",
    "KEY=": "a=",
    "N": "1",
    "PS": "1",
    "DIR": "x",
    "FILE": "x",
}


def is_a_command(words):
    """Whether words of a text are a command of rigidmd with its options, or a script with its."""
    if words[0] == "rigidmd" and len(words) == 2 and words[1] not in PLACEHOLDERS:
        return words[1] in COMMANDS
    if words[0] == "rigidmd" and words[1:2] != ["COMMAND"] and len(words) > 1:
        filled = [PLACEHOLDERS.get(word, word) for word in words[1:]]
        parse([word for word in filled if word][: filled.index(">") if ">" in filled else None])
    elif words[0] == "python" and words[-2:-1] == ["-m"]:
        return words[-1] == "rigidmd"
    elif words[0] == "python" and len(words) > 1:
        script = ROOT / words[1]
        options = [word for word in words if word.startswith("--")]
        return script.is_file() and all(option in script.read_text() for option in options)
    return True


def test_commands_in_the_text_are_commands():
    errors = []
    for document in DOCUMENTS:
        text = re.sub(
            r"^```.*?^```$",
            "",
            document.read_text(encoding="utf-8"),
            flags=re.MULTILINE | re.DOTALL,
        )
        errors += [
            f"{document.name}: {quoted}"
            for quoted in re.findall(r"`([^`]+)`", text)
            if not is_a_command(quoted.replace("\n", " ").split())
        ]
    assert not errors, "\n".join(errors)


def test_every_command_has_an_example_and_every_option_a_help_text():
    examples = dict(
        re.findall(r"^\| `(\w+)` \|.*\| `([^`]+)` \|$", section("Commands"), re.MULTILINE)
    )
    assert examples.keys() == COMMANDS.keys()
    for name, parser in COMMANDS.items():
        words = shlex.split(examples[name])
        assert words[:2] == ["rigidmd", name]
        assert is_a_command(words)
        lacking = [action.dest for action in parser._actions if not action.help]
        assert not lacking, f"rigidmd {name} --help: no text for {lacking}"


def tables_of(kind: type[BaseModel], path: str = "", many: bool = False):
    """(heading in the manual, model) of each table of a scene."""
    name = f"[[{path}]]" if many else f"[{path}]"
    yield f"`{name}`" if path else "Top level", kind
    for key, field in kind.model_fields.items():
        for inner in _models_in(field.annotation):
            yield from tables_of(
                inner, f"{path}.{key}".strip("."), "tuple" in str(field.annotation)
            )


def _models_in(annotation) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in getattr(annotation, "__args__", ()) for model in _models_in(part)]


def _toml(value) -> str:
    match value:
        case None:
            return ""
        case bool():
            return str(value).lower()
        case str():
            return f'"{value}"'
        case dict():
            return f"{{{', '.join(f'{key} = {_toml(own)}' for key, own in value.items())}}}"
        case tuple():
            return f"[{', '.join(map(_toml, value))}]"
    return f"{value:g}"


# Keys that these tables inherit and refuse
REFUSED = {"`[frame]`": {"from_s", "to_s"}, "`[changing_inertia]`": {"times_s", "from_s", "to_s"}}


@pytest.mark.parametrize("kind", [MolecularScene, BodyScene])
def test_every_key_of_a_scene_is_in_the_manual_with_its_default(kind):
    shared = {heading for heading, _ in tables_of(MolecularScene)}
    for heading, model in tables_of(kind):
        if kind is BodyScene and heading in ("Top level", "`[[integrators]]`"):
            continue  # the same as for molecules
        title = f"{heading} (single body)" if kind is BodyScene and heading in shared else heading
        said = {}
        for row in re.findall(r"^\| (`[a-z].*?) \| (.*?) ?\| ", section(title), re.MULTILINE):
            said |= {key: row[1].strip() for key in re.findall(r"`(\w+)`", row[0])}
        wanted = {
            key: "needed"
            if field.is_required()
            else f"`{text}`"
            if (text := _toml(field.default))
            else ""
            for key, field in model.model_fields.items()
            if not _models_in(field.annotation)
            or "Literal" in str(field.annotation)  # a table, or a text in its position
        }
        for key in REFUSED.get(heading, ()):
            wanted.pop(key)
            said.pop(key, None)
        assert said == wanted, f"the manual's table of {title} is not that of the scene"


def slugs(document: Path) -> set[str]:
    """Anchors of a document's headings, as they are made where it is shown."""
    text = re.sub(
        r"^```.*?^```$", "", document.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL
    )
    titles = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def test_links_and_pictures_are_there():
    errors = []
    for document in DOCUMENTS:
        text = document.read_text(encoding="utf-8")
        for link in re.findall(r"\]\(([^)\s]+)\)", text) + re.findall(r'src="([^"]+)"', text):
            path, _, anchor = link.partition("#")
            target = (document.parent / path).resolve() if path else document
            if not link.startswith("https://") and not (
                target.is_file()
                and target.is_relative_to(ROOT)
                and (not anchor or anchor in slugs(target))
            ):
                errors.append(f"{document.name}: {link}")
    assert not errors, "\n".join(errors)


def contents_text() -> str:
    """The page start/contents.md, from the titles and first lines of all pages."""
    lines = ["# All pages", "", "The pages of this documentation, with the subject of each."]
    groups = {
        folder.capitalize(): names for folder, names in SECTIONS.items() if folder != "guides"
    }
    ordered = {}
    for title, names in groups.items():
        ordered[title] = names
        if title == "Tutorials":
            ordered |= {f"Guides: {group.lower()}": names for group, names in GUIDES.items()}
    for title, names in ordered.items():
        lines += ["", f"## {title}", ""]
        for name in names:
            if name == "contents":
                continue
            heading, _, about, *_ = PAGES[name].read_text(encoding="utf-8").splitlines()
            path = Path(os.path.relpath(PAGES[name], PAGES["contents"].parent)).as_posix()
            lines.append(f"- [{heading.removeprefix('# ')}]({path}): {about[0].lower()}{about[1:]}")
    return "\n".join(lines) + "\n"


def test_every_picture_is_shown_and_drawn_by_a_command():
    """Scripts are files whose command line is read by `tests/benchmarks/test_benchmarks.py`."""
    there = {path.name for path in (DOCS / "images").iterdir()}
    assert there == {*FIGURES}
    text = "".join(path.read_text("utf-8") for path in (ROOT / "README.md", *DOCS.rglob("*.md")))
    assert [name for name in sorted(there) if f"images/{name}" not in text] == []
    for drawing in FIGURES.values():
        assert (SCRIPTS / drawing.command.split()[0]).is_file()
        assert drawing.source in ("data", "runs")


def test_readme_is_a_first_page_and_leads_to_the_list_of_all():
    text = README.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 130
    assert max(map(len, text.splitlines())) <= 100
    assert f"({PAGES['contents'].relative_to(ROOT)})" in text


def test_the_list_of_pages_has_their_titles_and_subjects():
    """`PYTHONPATH=tests python tests/rules/test_docs.py` writes it."""
    assert PAGES["contents"].read_text(encoding="utf-8") == contents_text()


def test_author_and_version_are_the_same_wherever_they_stand():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    version, (author,) = project["version"], project["authors"]
    text = README.read_text(encoding="utf-8")
    assert f"{author['name']}, *rigidmd" in text
    assert f"version {version}," in text
    citation = PAGES["contributing"].read_text(encoding="utf-8")
    assert f"{{{{{author['name']}}}}}" in citation
    assert f"version = {{{version}}}" in citation
    assert f"\n## {version}" in PAGES["changelog"].read_text(encoding="utf-8")
    zenodo = json.loads((ROOT / ".zenodo.json").read_text(encoding="utf-8"))
    found = [zenodo[key] for key in ("version", "keywords", "license", "creators")]
    assert found == [version, project["keywords"], project["license"], [{"name": author["name"]}]]


def test_the_conda_recipe_has_the_version_and_requirements_of_the_package():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    recipe = (ROOT / ".ci" / "conda" / "recipe.yaml").read_text(encoding="utf-8")
    versions = dict(re.findall(r'^  (version|python_min): "(.*)"$', recipe, re.MULTILINE))
    metadata = project["project"]
    python = metadata["requires-python"].removeprefix(">=")
    assert versions == {"version": metadata["version"], "python_min": python}
    named = {re.sub(r"(?=[<>=])", " ", text, count=1).lower() for text in metadata["dependencies"]}
    named = {text for text in named if ";" not in text} | set(project["build-system"]["requires"])
    listed = re.findall(r"^    - ([\w-]+ ?[<>=][^$]*?)$", recipe, re.MULTILINE)
    listed = {text.replace("matplotlib-base", "matplotlib") for text in listed}
    assert listed == {text.replace("hatchling>", "hatchling >") for text in named}


def test_help_lists_and_prints_the_chapters(capsys):
    assert set(DOCS.rglob("*.md")) == set(CHAPTERS.values())
    assert cli.main(["help"]) == 0
    listed = re.sub(r"\n {18}", " ", capsys.readouterr().out)
    for name in CHAPTERS:
        source = PAGES[name].read_text(encoding="utf-8")
        about = source.splitlines()[2]
        assert about.endswith(".")
        assert len(about) <= 120
        assert re.search(rf"^  {name} +{re.escape(about)}$", listed, re.MULTILINE)
        assert cli.main(["help", name]) == 0
        said = capsys.readouterr().out
        assert said.startswith(source.splitlines()[0])
        assert "<!--" not in said
        assert "![" not in said
        with contextlib.suppress(StopIteration):
            code = next(block for block in blocks_of(PAGES[name]) if block.language == "sh")
            assert re.sub(r"systems/(?=\w+\.toml)", "", code.text) in said
        for stem, ending in re.findall(
            r"systems/(?:scripts/|notebooks/)?(\w+)(\.toml|\.py|\.ipynb)", source
        ):
            assert find_example(stem).path.suffix == ending  # `rigidmd new` copies it
        assert not re.search(r"systems/(scripts/)?\w+\.(toml|py)", said)
    cli.main(["help", "top"])
    assert (
        f"[picture: seven heavy tops, {DOCS / 'images' / 'seven_tops.png'}]"
        in capsys.readouterr().out
    )


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("commandes", "did you mean commands?"),
        ("qqq", "no page is or contains 'qqq'; `rigidmd help` lists all"),
    ],
)
def test_a_chapter_that_is_not_there(name, expected, capsys):
    assert cli.main(["help", name]) == 2
    assert expected in capsys.readouterr().err


GROUPS = {
    "water": "Water",
    "ion": "Ions",
    "noble gas": "Noble gases",
    "gas": "Gases",
    "organic": "Organic molecules",
}


def models_tables() -> str:
    """The tables of reference/models.md, from the files of the models. The ions of a water model
    have one row."""
    rows: dict[str, dict[str, list[str]]] = {group: {} for group in GROUPS}
    for path in sorted((ROOT / "rigidmd" / "models").glob("*.toml")):
        model = tomllib.loads(path.read_text(encoding="utf-8"))
        title, remarks = model["title"], [model.get("note")]
        if model["group"] == "ion":
            title, remarks = f"Ions, {title.partition(', ')[2]}", ["sigma from Rmin/2"]
        if model.get("mixing") == "geometric":
            remarks.append("geometric mixing")
        cells = [title, str(len(model["sites"])), "; ".join(filter(None, remarks)), model["source"]]
        row = f"{' | '.join(cells)} |".replace("|  |", "| |")
        row = re.sub(r"doi:([^\s)|]+)", r"[doi:\1](https://doi.org/\1)", row)
        rows[model["group"]].setdefault(row, []).append(f"`{model['name']}`")
    head = "| model | molecule | sites | remarks | source |\n|---|---|---|---|---|\n"
    tables = {
        group: "\n".join(f"| {', '.join(names)} | {row}" for row, names in found.items())
        for group, found in rows.items()
    }
    return "\n\n".join(f"## {GROUPS[group]}\n\n{head}{tables[group]}" for group in GROUPS) + "\n"


def bodies_table() -> str:
    """The end of reference/body.md, from the first lines of the shipped scenes of bodies."""
    rows = [f"| `{one.name}` | {one.about} |" for one in examples() if "body" in one.tables]
    head = (
        "## Shipped bodies\n\n`rigidmd new NAME` copies a scene.\n\n| scene | motion |\n|---|---|\n"
    )
    return head + "\n".join(rows) + "\n"


def test_the_page_of_bodies_lists_the_shipped_ones():
    """`PYTHONPATH=tests python tests/rules/test_docs.py` writes the list."""
    assert PAGES["body"].read_text(encoding="utf-8").endswith("\n" + bodies_table())


def test_the_table_of_integrators_has_their_orders_and_costs():
    table = section("Shipped integrators")
    rows = {}
    for names, order, cost in re.findall(
        r"^\| (`.*?`)(?: \(default[^)]*\))? \| (\d+) \| (\d+) \|", table, re.MULTILINE
    ):
        rows |= dict.fromkeys(re.findall(r"`(\w+)`", names), (int(order), int(cost)))
    shipped = SCHEMES | WITH_THERMOSTAT
    assert rows == {
        name: (scheme.order, scheme.force_evaluations) for name, scheme in shipped.items()
    }


def test_the_page_of_models_has_the_tables_of_their_files():
    """`PYTHONPATH=tests python tests/rules/test_docs.py` writes them."""
    assert PAGES["models"].read_text(encoding="utf-8").endswith("\n" + models_tables())


def test_the_section_of_the_collection_is_written_from_its_data(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "tests" / "benchmarks")
    import collection

    assert PAGES["accuracy_cost"].read_text(encoding="utf-8") == collection.page_text()


if __name__ == "__main__":
    text = PAGES["models"].read_text(encoding="utf-8")
    PAGES["models"].write_text(text[: text.index("## Water")] + models_tables(), encoding="utf-8")
    PAGES["contents"].write_text(contents_text(), encoding="utf-8")
    text = PAGES["body"].read_text(encoding="utf-8").partition("## Shipped bodies")[0]
    PAGES["body"].write_text(text + bodies_table(), encoding="utf-8")
