"""The scenes that travel with the package: `rigidmd examples`, `rigidmd new`, and what the wheel
holds."""

import os
import pty
import shutil
import subprocess
import sys
import zipfile

import pytest
from support.common import BODIES, ROOT, SYSTEMS
from support.processes import process

from rigidmd.commands.cli import main
from rigidmd.core.shipped import SYSTEMS as SHIPPED
from rigidmd.scene import Scene


def test_a_wheel_has_every_file_and_nothing_of_an_earlier_build(tmp_path):
    """README's command again after an update in which a module has moved."""
    ignored = shutil.ignore_patterns(".*", "build", "*.egg-info", "tests", "__pycache__")
    checkout = shutil.copytree(ROOT, tmp_path / "checkout", ignore=ignored)
    former = checkout / "build" / "lib" / "rigidmd" / "former.py"  # of a version that built there
    former.parent.mkdir(parents=True)
    former.touch()
    module = checkout / "rigidmd" / "moved.py"
    module.touch()
    for name in ("first", "second"):
        command = [sys.executable, "-m", "pip", "wheel", "--no-deps", ".", "-w", tmp_path / name]
        done = subprocess.run(command, cwd=checkout, capture_output=True, text=True)
        if "No matching distribution found for hatchling" in done.stderr:
            pytest.skip("no package index, from which pip takes hatchling")
        assert done.returncode == 0, done.stderr
        with zipfile.ZipFile(next((tmp_path / name).glob("*.whl"))) as wheel:
            held = {file for file in wheel.namelist() if ".dist-info/" not in file}
        there = {
            prefix + path.relative_to(checkout).as_posix()
            for folder, prefix in (("rigidmd", ""), ("systems", "rigidmd/"))
            for path in (checkout / folder).rglob("*")
            if path.is_file()
        }
        assert held == there
        module = module.replace(checkout / "rigidmd" / "core" / "moved.py")


def test_the_scenes_shipped_are_those_of_systems():
    for path in (ROOT / "systems").rglob("*.*"):
        assert (SHIPPED / path.relative_to(ROOT / "systems")).read_bytes() == path.read_bytes()


def test_examples_are_listed_by_kind_with_their_first_line(printed):
    scenes, _, _ = printed("examples").out.partition("notebooks:")
    molecules, bodies = scenes.split("one body:")
    for path in SYSTEMS:
        about = path.read_text().splitlines()[0].removeprefix("# ")
        assert about.endswith("."), f"{path.name}: the first line must stand alone"
        assert len(about) <= 100
        own = bodies if path in BODIES else molecules
        assert f"  {path.stem} " in own
        assert about in own
    assert (bodies + molecules).count("\n  ") == len(SYSTEMS)
    header, *rows = molecules.rstrip().splitlines()
    numbers = {row.split()[0]: row[: len(header)].split()[1:] for row in rows}
    assert header.endswith(" number")
    assert numbers["water_nitrogen"] == ["220"]
    assert numbers["dry_ice"] == []  # its molecules come from a structure file


@pytest.mark.parametrize("path", SYSTEMS, ids=lambda path: path.stem)
def test_every_example_can_be_copied_and_read(path, tmp_path, monkeypatch, printed):
    monkeypatch.chdir(tmp_path)
    said = printed("new", path.stem).out
    assert f"rigidmd run {path.name}" in said
    copied = Scene.read(path.name)
    assert copied.model_dump() == Scene.read(path).model_dump()
    for file in copied.inputs.values():  # paths relative to the working directory
        assert str(file) in said
        assert file.read_bytes() == (path.parent / file).read_bytes()


def test_a_copy_goes_where_it_is_requested_to_with_all_that_it_reads(tmp_path, printed):
    target = tmp_path / "deep" / "mine.toml"
    assert main(["new", "water_dimer", "-o", str(target)]) == 0
    assert (tmp_path / "deep" / "structures" / "water_dimer.xyz").is_file()
    assert "mine: 2 molecules" in printed("check", target).out


def test_nothing_is_overwritten_unasked(tmp_path, monkeypatch, printed):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "structures").mkdir()
    own = tmp_path / "structures" / "water_dimer.xyz"
    own.write_text("mine")
    assert (
        "structures/water_dimer.xyz exists; --force replaces it"
        in printed("new", "water_dimer", code=2).err
    )
    assert sorted(tmp_path.rglob("*.toml")) == []
    assert main(["new", "argon"]) == 0
    (tmp_path / "argon.toml").write_text("mine")
    assert "argon.toml exists; --force replaces it" in printed("new", "argon", code=2).err
    assert (tmp_path / "argon.toml").read_text() == "mine"
    assert main(["new", "argon", "--force"]) == 0
    assert (tmp_path / "argon.toml").read_bytes() == (ROOT / "systems" / "argon.toml").read_bytes()


def test_the_name_of_a_series_is_its_first_scene(tmp_path, monkeypatch, printed):
    monkeypatch.chdir(tmp_path)
    said = printed("new", "heavy_top").out
    assert "heavy_top_7). This is heavy_top_1" in said
    assert (tmp_path / "heavy_top_1.toml").read_bytes() == (
        ROOT / "systems" / "heavy_top_1.toml"
    ).read_bytes()


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["watr"], ["unknown scene 'watr'", "did you mean water", "`rigidmd examples`"]),
        (["heavytop_3"], ["did you mean heavy_top_3"]),
        (["steady_precession"], ["steady_precession_fast or steady_precession_slow"]),
        (["systems/water.toml"], ["did you mean water or"]),
        (["water", "-o", "mine"], ["mine must end in .toml"]),
        (["water", "-o", "."], [". must end in .toml"]),
        (["water", "-o", "file/mine.toml"], ["file/mine.toml cannot be written"]),
    ],
)
def test_what_cannot_be_copied_is_reported(arguments, expected, tmp_path, monkeypatch, printed):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    out, err = printed("new", *arguments, code=2)
    assert out == ""
    assert all(part in err for part in expected), err
    assert [path.name for path in tmp_path.rglob("*")] == ["file"]


@pytest.mark.parametrize("arguments", [["examples"], ["help"], ["help", "scene"]])
def test_what_only_prints_is_quick_and_imports_nothing_heavy(arguments):
    code = f"import sys; from rigidmd.commands.cli import main\nmain({arguments})\nprint(sorted({{'numba', 'numpy', 'ase', 'MDAnalysis', 'pydantic'}} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_help_has_lines_for_a_terminal(capsys):
    assert main(["help"]) == 0
    assert max(len(line) for line in capsys.readouterr().out.splitlines()) <= 120


@pytest.mark.parametrize("terminal", [True, False])
def test_help_uses_a_pager_on_a_terminal(terminal):
    command = [
        sys.executable,
        "-c",
        "import sys; from rigidmd.commands.cli import main; main(['help', 'top'])",
    ]
    settings = {"env": os.environ | {"PAGER": "sed s/^/paged:/", "TERM": "xterm"}}
    if not terminal:
        out = subprocess.run(command, **settings, capture_output=True, text=True).stdout
        assert out.startswith("# ") and "paged:" not in out
        return
    leader, follower = pty.openpty()
    with process(command, **settings, stdin=follower, stdout=follower, stderr=follower) as pages:
        os.close(follower)
        out = b""
        while b"\n" not in out:
            out += os.read(leader, 1000)
        os.close(leader)
        pages.wait()
    assert out.startswith(b"paged:# ")
