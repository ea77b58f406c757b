"""The scenes that travel with the package: `rigidmd examples`, `rigidmd new`, and what the wheel
holds."""

import os
import pty
import shutil
import subprocess
import sys
import tomllib
import zipfile

import pytest
from processes import process
from support import BODIES, ROOT, SYSTEMS

from rigidmd.commands.cli import main
from rigidmd.core.shipped import SYSTEMS as SHIPPED
from rigidmd.scene import Scene


def test_every_package_and_every_data_file_is_in_the_wheel():
    tool = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    packages = {
        ".".join(path.parent.relative_to(ROOT).parts)
        for path in (ROOT / "rigidmd").rglob("__init__.py")
    }
    assert set(tool["packages"]) == packages | {"rigidmd.systems"}
    assert tool["package-dir"] == {"rigidmd.systems": "systems"}
    data = tool["package-data"]
    homes = {"rigidmd": ROOT / "rigidmd", "rigidmd.systems": ROOT / "systems"}
    scripts = (ROOT / "systems" / "scripts", ROOT / "rigidmd" / "docs" / "site")
    held = {
        file
        for name, home in homes.items()
        for pattern in data[name]
        for file in home.glob(pattern)
        if file.is_file()
    }
    there = {
        file
        for home in homes.values()
        for file in home.rglob("*")
        if file.is_file() and (file.suffix not in (".py", ".pyc") or file.parent in scripts)
    }
    assert held == there


def test_a_wheel_has_nothing_of_an_earlier_build(tmp_path):
    """README's command again after an update in which a module has moved."""
    ignored = shutil.ignore_patterns(".*", "build", "*.egg-info", "tests", "docs", "__pycache__")
    checkout = shutil.copytree(ROOT, tmp_path / "checkout", ignore=ignored)
    (checkout / "rigidmd" / "moved.py").touch()
    (checkout / "build" / "lib" / "rigidmd").mkdir(parents=True)  # of a version that built there
    (checkout / "build" / "lib" / "rigidmd" / "former.py").touch()
    module, built = checkout / "rigidmd" / "moved.py", []
    for name in ("first", "second"):
        command = [sys.executable, "-m", "pip", "wheel", "--no-deps", ".", "-w", tmp_path / name]
        done = subprocess.run(command, cwd=checkout, capture_output=True, text=True)
        if "No matching distribution found for setuptools" in done.stderr:
            pytest.skip("no package index, from which pip takes setuptools")
        assert done.returncode == 0, done.stderr
        with zipfile.ZipFile(next((tmp_path / name).glob("*.whl"))) as wheel:
            built.append({one for one in wheel.namelist() if ".dist-info/" not in one})
        module = module.replace(checkout / "rigidmd" / "core" / "moved.py")
    first, second = built
    assert first - second == {"rigidmd/moved.py"} and second - first == {"rigidmd/core/moved.py"}
    assert "rigidmd/former.py" not in first | second
    files = {one for one in second if one.endswith(".py")}
    modules = {str(one.relative_to(checkout)) for one in (checkout / "rigidmd").rglob("*.py")}
    assert {one for one in files if "/systems/" not in one} == modules


def test_the_scenes_shipped_are_those_of_systems():
    for path in (ROOT / "systems").rglob("*.*"):
        assert (SHIPPED / path.relative_to(ROOT / "systems")).read_bytes() == path.read_bytes()


def test_examples_are_listed_by_kind_with_their_first_line(capsys):
    assert main(["examples"]) == 0
    scenes, _, _ = capsys.readouterr().out.partition("notebooks:")
    molecules, bodies = scenes.split("one body:")
    for path in SYSTEMS:
        about = path.read_text().splitlines()[0].removeprefix("# ")
        assert about.endswith("."), f"{path.name}: the first line must stand alone"
        assert len(about) <= 100
        own = bodies if path in BODIES else molecules
        assert f"  {path.stem} " in own
        assert about in own
    assert (bodies + molecules).count("\n  ") == len(SYSTEMS)


@pytest.mark.parametrize("path", SYSTEMS, ids=lambda path: path.stem)
def test_every_example_can_be_copied_and_read(path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["new", path.stem]) == 0
    said = capsys.readouterr().out
    assert f"rigidmd run {path.name}" in said
    copied = Scene.read(path.name)
    assert copied.model_dump() == Scene.read(path).model_dump()
    for file in copied.inputs.values():  # paths relative to the working directory
        assert str(file) in said
        assert file.read_bytes() == (path.parent / file).read_bytes()


def test_a_copy_goes_where_it_is_asked_to_with_all_that_it_reads(tmp_path, capsys):
    target = tmp_path / "deep" / "mine.toml"
    assert main(["new", "water_dimer", "-o", str(target)]) == 0
    assert (tmp_path / "deep" / "structures" / "water_dimer.xyz").is_file()
    assert main(["check", str(target)]) == 0
    assert "mine: 2 molecules" in capsys.readouterr().out


def test_nothing_is_overwritten_unasked(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "structures").mkdir()
    own = tmp_path / "structures" / "water_dimer.xyz"
    own.write_text("mine")
    assert main(["new", "water_dimer"]) == 2
    assert "structures/water_dimer.xyz exists; --force replaces it" in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*.toml")) == []
    assert main(["new", "argon"]) == 0
    (tmp_path / "argon.toml").write_text("mine")
    assert main(["new", "argon"]) == 2
    assert "argon.toml exists; --force replaces it" in capsys.readouterr().err
    assert (tmp_path / "argon.toml").read_text() == "mine"
    assert main(["new", "argon", "--force"]) == 0
    assert (tmp_path / "argon.toml").read_bytes() == (ROOT / "systems" / "argon.toml").read_bytes()


def test_the_name_of_a_series_is_its_first_scene(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["new", "heavy_top"]) == 0
    said = capsys.readouterr().out
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
def test_what_cannot_be_copied_is_said(arguments, expected, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    assert main(["new", *arguments]) == 2
    out, err = capsys.readouterr()
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
