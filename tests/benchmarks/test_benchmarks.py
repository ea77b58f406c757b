"""The scripts of tests/benchmarks: each runs in its smallest form, and commands on pages and in the
scripts have options that exist."""

import argparse
import os
import re
import runpy
import shlex
import subprocess
import sys

import pytest
from support.common import ROOT
from support.page_figures import FIGURES, redraw
from support.processes import search_path

FOLDER = ROOT / "tests" / "benchmarks"
SCRIPTS = sorted(
    path
    for path in FOLDER.glob("*.py")
    if "__main__" in path.read_text() and not path.name.startswith("test_")
)
PAGES = [ROOT / "README.md", *(ROOT / "rigidmd" / "docs").rglob("*.md")]


def files() -> dict[str, int]:
    """The files of the checkout that a script could change, with their times."""
    folders = (ROOT / "rigidmd" / "docs", ROOT / "systems", FOLDER)
    found = {str(path): path.stat().st_mtime_ns for one in folders for path in one.rglob("*")}
    return {name: time for name, time in found.items() if "__pycache__" not in name}


@pytest.mark.extended
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_the_smallest_form_runs_and_leaves_the_checkout_alone(script, tmp_path):
    before = files()
    done = subprocess.run(
        [sys.executable, script, "--smoke"],
        cwd=tmp_path,
        env=os.environ | search_path(FOLDER) | {"TMPDIR": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    absent = re.search(r"^(\w+) is not installed", done.stderr, re.MULTILINE)
    if done.returncode != 0 and absent:
        pytest.skip(f"{absent[1]} is not installed")
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    assert "Traceback" not in done.stderr
    assert files() == before
    assert not list(tmp_path.iterdir()), "files were left in the working directory"


@pytest.mark.extended
def test_files_go_to_the_folder_that_is_given(tmp_path):
    before = files()
    command = [sys.executable, FOLDER / "euler_angles.py", "--to", tmp_path / "new" / "folder"]
    subprocess.run(command, check=True, cwd=tmp_path, env=os.environ | search_path(FOLDER))
    assert (tmp_path / "new" / "folder" / "euler_angles.png").stat().st_size > 10_000
    assert files() == before


class Parsed(Exception):
    """A script has read its command line, and nothing was run."""


def commands_in(text: str) -> list[tuple[str, list[str]]]:
    """Scripts of this folder with their arguments, in the order of a text."""
    text = text.replace("\\\n", " ")
    found = re.findall(r"python (tests/benchmarks/\w+\.py)([^`#|\n]*)", text)
    return [(script, shlex.split(rest.partition("-->")[0])) for script, rest in found]


@pytest.fixture
def parse(monkeypatch, capsys):
    """Run a script until it has read its command line. Fails where the command would."""
    monkeypatch.syspath_prepend(FOLDER)
    parse_args = argparse.ArgumentParser.parse_args

    def parse_only(parser):
        parse_args(parser)
        raise Parsed

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_only)

    def parse(script: str, arguments: list[str]) -> None:
        monkeypatch.setattr(sys, "argv", [script, *arguments])
        try:
            runpy.run_path(str(ROOT / script), run_name="__main__")
        except Parsed:
            return
        except SystemExit:
            pytest.fail(f"{shlex.join([script, *arguments])}: {capsys.readouterr().err}")
        pytest.fail(f"{script} reads no command line")

    return parse


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.stem)
def test_the_commands_in_a_script_have_options_that_exist(script, parse):
    text = script.read_text(encoding="utf-8")
    named = commands_in(re.match(r'"""(.*?)"""', text, re.DOTALL)[1])
    assert any(name == f"tests/benchmarks/{script.name}" for name, _ in named)
    for command in named:
        parse(*command)


def test_the_commands_on_pages_have_options_that_exist(parse):
    named = [command for page in PAGES for command in commands_in(page.read_text("utf-8"))]
    assert len(named) > 20
    for script, arguments in named:
        parse(script, arguments)


def test_the_commands_of_figures_have_options_that_exist(parse):
    for drawing in FIGURES.values():
        script, *arguments = shlex.split(drawing.command)
        parse(f"tests/benchmarks/{script}", [*arguments, "--to", "figures"])


def test_figures_from_data_are_drawn_into_a_folder_and_those_that_change_are_listed(tmp_path):
    wanted = {name for name, one in FIGURES.items() if one.seconds <= 3}
    assert {*redraw(3, tmp_path)} == wanted == {path.name for path in tmp_path.iterdir()}
    (tmp_path / "scaling.png").write_bytes(b"")
    assert redraw(3, tmp_path) == ["scaling.png"]


def test_an_option_that_does_not_exist_is_found(parse):
    with pytest.raises(pytest.fail.Exception, match="unrecognized arguments: --json"):
        parse("tests/benchmarks/scaling.py", ["--json", "scaling.json"])
