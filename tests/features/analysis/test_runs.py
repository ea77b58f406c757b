"""Analyses of runs: the command, files, bad input."""

import csv
import json
import os
import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.analysis import SHORT
from support.common import ROOT, small_scene

import rigidmd
from rigidmd import Scene, Simulation
from rigidmd.assemble.build import build
from rigidmd.commands import cli
from rigidmd.errors import OutputError, SceneError
from rigidmd.features.analysis import registry
from rigidmd.features.analysis.files import read_table
from rigidmd.features.analysis.report import results_text
from rigidmd.features.analysis.result import AnalysisResult, Value
from rigidmd.features.analysis.rigid_frames import frames_of_folder
from rigidmd.run.record import read_record


@pytest.fixture
def copy(water, tmp_path):
    """The run, to be spoilt."""
    return Path(shutil.copytree(water, tmp_path / "run"))


def said(capsys, *arguments, code=2):
    """What the command states of it: one sentence, without a traceback."""
    assert cli.main(["analyse", *map(str, arguments)]) == code
    found = capsys.readouterr().err.strip()
    assert found.startswith("rigidmd: ") and "\n" not in found and "Traceback" not in found
    return found


def table(path):
    """The columns of a CSV file."""
    with path.open(encoding="utf-8", newline="") as file:
        head, *lines = list(csv.reader(file))
    return {
        title: np.array([float(line[k] or "nan") for line in lines]) for k, title in enumerate(head)
    }


def names(folder):
    """Files of a folder, without those that MDAnalysis leaves next to a trajectory."""
    return sorted(path.name for path in folder.iterdir() if "_offsets." not in path.name)


# the command
BUILT_IN = [
    "rdf",
    "structure_factor",
    "density_profile",
    "interfaces",
    "hydrogen_bonds",
    "msd",
    "diffusion",
    "orientation",
    "nematic",
    "spectrum",
    "dielectric",
    "response",
    "viscosity",
    "surface_tension",
]


def test_all_analyses_of_a_run_by_one_command(copy, capsys):
    before = names(copy)
    assert cli.main(["analyse", str(copy), "--from", "0.02ps"]) == 0
    text = capsys.readouterr().out
    found = json.loads((copy / "analysis.json").read_text())["analyses"]
    assert list(found) == BUILT_IN
    left_out = [
        name for name, entry in found.items() if not entry["curves"] and not entry["values"]
    ]
    assert left_out == ["interfaces", "nematic", "viscosity", "surface_tension"]
    assert (
        "viscosity: a viscosity needs at least 20 ps of the pressure tensor; there are 0.2 ps"
        in text
    )
    files = [name for entry in found.values() for name in entry["files"]]
    assert sorted([*before, "analysis.json", *files]) == names(copy)
    assert set(files) <= set(
        (copy / ".rigidmd-run").read_text().split("\n")
    )  # which a new run removes
    for entry in found.values():
        for curve in entry["curves"]:
            columns = table(copy / f"{curve['file']}.csv")
            assert all(
                len(values) > 3 and np.isfinite(values).all() for values in columns.values()
            ), curve
        for value in entry["values"]:
            assert value["value"] is not None or "too short" in value["note"], value
            assert value["value"] is None or value["error"] is not None, value
    assert list(table(copy / "rdf.csv"))[:4] == ["r (A)", "g O-O", "g O-O error", "n O-O"]
    bonds = found["hydrogen_bonds"]["values"][0]
    assert 1.0 < bonds["value"] < 4.5
    for name in (
        "D of spce",
        "tau1 of spce, axis 2",
        "D_rot of spce, axis 1",
        "dielectric constant",
    ):
        assert re.search(
            rf"^  {name}: .* too short for a value[.;] .*So far: ", text, re.MULTILINE
        ), name
    # once more, of one analysis: the same bits, and the others stay
    kept = {
        name: (copy / name).read_bytes()
        for name in [*files, "analysis.json"]
        if not name.endswith(".png")
    }
    assert cli.main(["analyse", str(copy), "--only", "rdf, orientation", "--from", "0.02ps"]) == 0
    assert {name: (copy / name).read_bytes() for name in kept} == kept
    assert cli.main(["analyse", str(copy), "--only", "rdf", "--from", "100fs"]) == 0
    again = json.loads((copy / "analysis.json").read_text())["analyses"]
    assert again["rdf"]["frames_used"]["from_ps"] == pytest.approx(0.1, abs=0.003)
    assert again["rdf"] != found["rdf"] and again["spectrum"] == found["spectrum"]
    # a file of rigidmd 0.2 has another name for the frames
    written = (copy / "analysis.json").read_text()
    (copy / "analysis.json").write_text(written.replace('"frames_used"', '"stretch"'))
    assert {entry.frames_used.runs for entry in read_table(copy).values()} == {1}
    (copy / "analysis.json").write_text(written)
    capsys.readouterr()


def test_the_list_is_that_of_all(capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["analyse", "--list"])
    assert ended.value.code == 0
    listed = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    assert set(listed) == {*BUILT_IN, "insertion", "zero_step", "pmf", "free_energy"}


def test_results_in_memory_and_from_the_folder_agree(water):
    results = Simulation(Scene.read(ROOT / "systems" / "water.toml", SHORT)).run()
    history = frames_of_folder(read_record(water), 0.02)
    for name, options, column in (
        ("rdf", {"first": "OW", "second": "HW", "width": 0.2}, "g OW-HW"),
        ("structure_factor", {"name": "OW", "largest": 3.0}, "S OW"),
        ("msd", {}, "MSD spce (A^2)"),
        ("orientation", {}, "C2 spce axis 2"),
        ("spectrum", {}, "omega spce axis 1"),
        ("density_profile", {"bins": 5}, "density spce (g/cm3)"),
        ("dielectric", {}, "Mz (D)"),
    ):
        here = getattr(rigidmd.analysis, name)(results, start=0.02, **options)[column]
        there = registry.selected([name])[0].function(history, **options)[column]
        assert here == pytest.approx(there, rel=2e-3, abs=2e-3 * np.abs(there).max()), name
    seen = results._analysis_frames[0.02]
    assert np.array_equal(seen.tensor, history.tensor)
    assert len(seen.tensor) == 51 and seen.interval == pytest.approx(0.004)
    assert np.abs(seen.Q - history.Q).max() < 1e-5
    assert np.abs(seen.L - history.L).max() < 1e-3
    state = results.state
    last = (
        np.abs(seen.positions[-1] - state.position).max(),
        np.abs(seen.Q[-1] - state.rotation).max(),
    )
    assert max(last) < 1e-5  # frames are in single precision
    assert np.abs(seen.L[-1] - state.angular_momentum_body).max() < 1e-3
    tensor = np.array([results[f"pressure_{k}"] for k in ("xx", "yy", "zz", "xy", "xz", "yz")]).T
    assert np.array_equal(history.tensor[1:, 1:], tensor[-50:])


def test_a_file_of_the_pressure_tensor_is_read_with_care(copy):
    lines = (copy / "pressure_tensor.csv").read_text().splitlines()
    rng = np.random.default_rng(0)
    rows = [
        ",".join(map(repr, [round(0.02 + 0.004 * k, 9), *rng.normal(0, 500, 6).tolist()]))
        for k in range(10)
    ]
    (copy / "pressure_tensor.csv").write_text("\n".join([lines[0], *rows]) + "\n" + rows[0][:-30])
    history = frames_of_folder(read_record(copy), 0.02)
    assert history.tensor.shape == (10, 7)  # the line that is cut is omitted
    (copy / "pressure_tensor.csv").write_text("\n".join([lines[0], *rows, "0,x,0,0,0,0,0"]) + "\n")
    with pytest.raises(
        OutputError, match=r"pressure_tensor.csv: column .* has a cell that is not a number"
    ):
        frames_of_folder(read_record(copy))
    (copy / "pressure_tensor.csv").write_text("a,b\n1,2\n")
    with pytest.raises(
        OutputError, match=r"is not a pressure tensor of rigidmd: its columns must be"
    ):
        frames_of_folder(read_record(copy))
    (copy / "pressure_tensor.csv").write_text("")
    with pytest.raises(OutputError, match=r"is not a pressure tensor of rigidmd"):
        frames_of_folder(read_record(copy))


# bad input
@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--only", "rfd"], "unknown analysis 'rfd'; did you mean rdf? there are"),
        (["--only", "viscosty"], "did you mean viscosity?"),
        (
            ["--from", "1ns"],
            "from 1000 ps on there are 0 of 56 frames. An analysis needs at least two",
        ),
        (["--from", "0.22ps"], "from 0.22 ps on there is 1 of 56 frames"),
        (
            ["--only", "diffusion", "--from", "0.1ps"],
            "a diffusion coefficient needs at least 40 frames; there are",
        ),
        (["--only", "viscosity"], "a viscosity needs at least 20 ps of the pressure tensor"),
        (["--trust", "nowhere.py"], "nowhere.py: "),
    ],
)
def test_what_cannot_be_analysed_is_one_sentence(options, words, water, capsys):
    before = names(water)
    assert words in said(capsys, water, *options)
    assert names(water) == before


@pytest.mark.parametrize("time", ["-5ps", "10", "soon", "5 days", ""])
def test_a_time_without_sense_is_refused(time, water, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["analyse", str(water), f"--from={time}"])
    assert ended.value.code == 2
    assert "is not a time with a unit, such as 200ps or 1.5ns" in capsys.readouterr().err


@pytest.mark.parametrize("value", ["0", "-1", "thick", "nan", "inf"])
def test_a_viscosity_without_sense_is_refused(value, water, capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["analyse", str(water), f"--viscosity={value}"])
    assert ended.value.code == 2
    assert "is not a viscosity from 1e-6 to 1e12" in capsys.readouterr().err


def test_names_of_sites_are_suggested(water):
    history = frames_of_folder(read_record(water), 0.02)
    rdf = registry.selected(["rdf"])[0].function
    with pytest.raises(
        OutputError,
        match=r"^unknown site 'ow'; did you mean OW\? there are OW, HW1, HW2, spce, O, H$",
    ):
        rdf(history, "OW", "ow")
    with pytest.raises(OutputError, match=r"^unknown site 'Xe'; there are OW"):
        rdf(history, "Xe")
    for largest, width in (
        (20.0, 0.1),
        (-1.0, 0.1),
        (5.0, 0.0),
        (5.0, 6.0),
        (np.nan, 0.1),
        (5.0, np.nan),
    ):
        with pytest.raises(
            OutputError, match=r"is not possible: half the box is 9\.3|must be from 0.0001"
        ):
            rdf(history, "OW", largest=largest, width=width)
    with pytest.raises(OutputError, match=r"axis is 'w', must be x or y or z"):
        registry.selected(["density_profile"])[0].function(history, "w")
    with pytest.raises(OutputError, match="bins is 0, must be from 1"):
        registry.selected(["density_profile"])[0].function(history, "z", bins=0)
    for largest in (0.01, -1.0, np.nan):
        with pytest.raises(OutputError, match=r"no wave vector|must be from"):
            registry.selected(["structure_factor"])[0].function(history, largest=largest)
    elements, centres = rdf(history, "O", "H", width=0.5), rdf(history, "spce", width=0.5)
    assert np.array_equal(elements["g O-H"], rdf(history, "OW", "HW", width=0.5)["g OW-HW"])
    assert centres["g spce-spce"].max() > 1.4
    assert rdf(history, "OW").value("g OW-OW: first peak").value == pytest.approx(3.0, abs=0.4)


def test_a_run_that_was_killed_is_analysed_as_far_as_it_came(copy, capsys):
    (copy / "summary.json").unlink()
    log, trajectory = copy / "log.csv", copy / "trajectory.trr"
    log.write_text("\n".join(log.read_text().splitlines()[:40]) + '\n0.1,"nv')
    trajectory.write_bytes(trajectory.read_bytes()[:-1000])
    assert cli.main(["analyse", str(copy), "--only", "msd", "--from", "0.02ps"]) == 0
    text = capsys.readouterr().out
    assert (
        "This run has not ended" in text
        and "trajectory.trr ends within a frame, which is left out" in text
    )
    found = json.loads((copy / "analysis.json").read_text())["analyses"]["msd"]["frames_used"]
    assert found["to_ps"] < 0.16 and found["frames"] == 34


def test_a_folder_that_is_not_a_run_of_molecules(tmp_path, copy, capsys):
    assert "nowhere" in said(capsys, tmp_path / "nowhere")
    assert str(tmp_path) in said(capsys, tmp_path)
    (copy / "trajectory.trr").write_bytes(b"nothing")
    assert "cannot be read as a trajectory" in said(capsys, copy)
    (copy / "trajectory.trr").unlink()
    assert "its trajectory trajectory.trr is missing" in said(capsys, copy, "--only", "msd")
    scene = (copy / "scene.toml").read_text()
    (copy / "scene.toml").write_text(
        scene.replace('trajectory = "trajectory.trr"', "trajectory = false").replace(
            "velocities = true", ""
        )
    )
    words = "msd needs the frames of a trajectory: this run wrote no trajectory"
    assert words in said(capsys, copy, "--only", "msd")
    top = tmp_path / "top"
    body = Scene.read(
        ROOT / "systems" / "heavy_top_3.toml", {"run.duration_s": 0.05, "output.figures": False}
    )
    results = Simulation(body, top).run()
    assert "is a run of a single body, and analyses are for molecules" in said(capsys, top)
    with pytest.raises(
        OutputError, match="this is a run of a single body, and analyses are for molecules"
    ):
        rigidmd.analysis.rdf(results)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        '{"analyses": 3}',
        '{"analyses": {"rdf": 1}}',
        '{"analyses": {"rdf": {}}}',
        "\xff",
    ],
)
def test_a_damaged_table_is_reported_and_kept(text, copy, capsys):
    path = copy / "analysis.json"
    path.write_text(text, encoding="latin-1")
    before = names(copy)
    found = said(capsys, copy, "--only", "msd", "--from", "0.02ps")
    assert str(path) in found and "Remove it, and analyse again" in found
    assert path.read_text(encoding="latin-1") == text and names(copy) == before


def test_files_of_others_are_not_overwritten(copy, capsys):
    (copy / "msd.csv").write_text("mine\n")
    assert f"{copy / 'msd.csv'} exists and is not of an analysis" in said(
        capsys, copy, "--only", "msd", "--from", "0.02ps"
    )
    assert (copy / "msd.csv").read_text() == "mine\n" and not (copy / "analysis.json").exists()
    (copy / "msd.csv").unlink()
    assert cli.main(["analyse", str(copy), "--only", "msd", "--from", "0.02ps"]) == 0
    (copy / "analysis.json").unlink()  # files of this command may be written again
    assert cli.main(["analyse", str(copy), "--only", "msd,dielectric", "--from", "0.02ps"]) == 0
    trusted = copy.parent / "own.py"
    for name, words in (
        ("log", "log.csv exists and is not"),
        ("dipole", "dipole.csv is a file of the analysis dielectric"),
    ):
        trusted.write_text(
            f"import rigidmd\n@rigidmd.analysis.register\ndef {name}(frames):\n    return frames.time\n"
        )
        before = {path.name: path.read_bytes() for path in copy.iterdir()}
        capsys.readouterr()
        assert words in said(capsys, copy, "--trust", trusted, "--only", name, "--from", "0.02ps")
        assert {path.name: path.read_bytes() for path in copy.iterdir()} == before


@pytest.mark.skipif(
    not hasattr(os, "geteuid") or os.geteuid() == 0, reason="root may write everywhere"
)
def test_a_folder_that_cannot_be_written_is_reported(copy, capsys):
    copy.chmod(0o555)
    try:
        assert str(copy) in said(capsys, copy, "--only", "msd")
    finally:
        copy.chmod(0o755)


# analyses of user-defined
OWN = """import numpy as np
import rigidmd

@rigidmd.analysis.register
def height(frames):
    "mean height of the centres (A)"
    return frames.positions[:, :, 2].mean(axis=1)

@rigidmd.analysis.register
def spins(frames):
    return {"L": np.abs(frames.L).mean(axis=(1, 2)), "one": np.ones(len(frames))}
"""


def test_a_function_of_a_user_is_found_by_name(copy, capsys):
    (copy.parent / "own.py").write_text(OWN)
    trust = ["--trust", str(copy.parent / "own.py"), "--from", "0.02ps"]
    assert cli.main(["analyse", str(copy), *trust, "-v", "--only", "height,spins"]) == 0
    entries = json.loads((copy / "analysis.json").read_text())["analyses"]
    assert entries["height"]["about"] == "mean height of the centres (A)"
    columns, history = table(copy / "height.csv"), frames_of_folder(read_record(copy), 0.02)
    assert columns["height"] == pytest.approx(history.positions[:, :, 2].mean(axis=1), rel=1e-8)
    assert list(table(copy / "spins.csv")) == ["Time (ps)", "L", "one"]
    assert entries["spins"]["values"][1]["value"] == 1.0
    assert "mean height of the centres" in capsys.readouterr().out
    assert (
        cli.main(["analyse", str(copy), *trust, "--only", "height"]) == 0
    )  # the same function once more


def test_the_mean_of_a_user_has_an_honest_error():
    from support.common import history, noise_with_memory, system_of

    system, found = system_of({"argon": 2}), []
    for seed in range(50):
        series = noise_with_memory(np.random.default_rng(seed), 1000, (1,), 1.0, 5.0, 1.0)[:, 0]
        rigidmd.analysis.register(lambda_of(series))
        told = registry.KNOWN["noise"].function(history(system, np.arange(1000.0), None)).value()
        found.append((told.value, told.error, told.correlation_ps))
    values, errors, times = np.array(found).T
    assert np.mean(times) == pytest.approx(5.0, rel=0.2)
    assert 0.6 < values.std() / np.sqrt(np.mean(errors**2)) < 1.6


def lambda_of(series):
    def noise(frames):
        return series

    return noise


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ("return 1 / 0", "the analysis mine raised ZeroDivisionError: division by zero"),
        (
            "return 1.0",
            "must return one number for each of the 51 frames, or a dictionary of such arrays; 'mine' has the shape ()",
        ),
        ("return frames.positions", "has the shape (51, 216, 3)"),
        ("return {'a': frames.time, 'b': frames.time[1:]}", "'b' has the shape (50,)"),
        ("return {}", "returned an empty dictionary"),
        ("return frames.time * float('nan')", "'mine' is not a finite number at frame 1"),
        ("return ['x'] * len(frames)", "must return one number"),
        ("return None", "must return one number"),
        ("raise SystemExit(0)", "raised SystemExit"),
    ],
)
def test_a_function_of_a_user_that_is_wrong(body, words, water, tmp_path, capsys):
    before = names(water)
    (tmp_path / "own.py").write_text(
        f"import rigidmd\n@rigidmd.analysis.register\ndef mine(frames):\n    {body}\n"
    )
    assert words in said(
        capsys, water, "--trust", tmp_path / "own.py", "--only", "mine", "--from", "0.02ps"
    )
    assert names(water) == before


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            "x = 1",
            "defines no analysis: put @rigidmd.analysis.register before a function of frames",
        ),
        ("raise ValueError('no')", "own.py raised ValueError: no"),
        ("def (", "own.py raised SyntaxError"),
        ("import sys; sys.exit(0)", "own.py raised SystemExit"),
        (
            "import rigidmd\n@rigidmd.analysis.register\ndef rdf(frames): return frames.time",
            "own.py: rdf is an analysis of rigidmd",
        ),
        (
            "import rigidmd\nrigidmd.analysis.register(lambda frames: frames.time)",
            "an analysis has the name of its function",
        ),
    ],
)
def test_a_file_of_a_user_that_is_wrong(text, words, water, tmp_path, capsys):
    (tmp_path / "own.py").write_text(text)
    assert words in said(capsys, water, "--trust", tmp_path / "own.py")


def test_adding_an_analysis_takes_one_file(tmp_path, monkeypatch, copy, capsys):
    """A file next to the built-in ones: a command, a position, a function of results with its
    arguments and help."""
    (tmp_path / "cosines.py").write_text(
        f"from {registry.__name__} import built_in\n"
        f"from {registry.AnalysisResult.__module__} import AnalysisResult, Value\n"
        "@built_in('mean cosine of an axis of the bodies', position=15)\n"
        "def mean_cosine(frames, axis='z', power=1):\n"
        "    'Mean of cos(angle)**power to an axis of the box.'\n"
        "    k = 'xyz'.index(axis)\n"
        "    found = float((frames.first.Q[:, :, k, 2] ** power).mean())\n"
        "    return AnalysisResult('mean_cosine', 'cosine', [Value(axis, '1', found, 0.0)])\n"
    )
    monkeypatch.setattr(registry, "KNOWN", registry.KNOWN.copy())
    monkeypatch.setattr(
        rigidmd.features.analysis.built_in,
        "__path__",
        [*rigidmd.features.analysis.built_in.__path__, str(tmp_path)],
    )
    registry.load_built_in()
    monkeypatch.delitem(sys.modules, "rigidmd.features.analysis.built_in.cosines")
    results = Simulation(Scene.read(ROOT / "systems" / "water.toml", SHORT)).run()
    found = rigidmd.analysis.mean_cosine(results, "x", power=2, start=0.0)
    assert found.value("x").value == pytest.approx((results.rotation[:, :, 0, 2] ** 2).mean())
    assert (
        rigidmd.analysis.analyse(results, "mean_cosine", axis="y").value("y").value
        != found.value("x").value
    )
    help(rigidmd.analysis.mean_cosine)
    said = capsys.readouterr().out
    assert (
        "mean_cosine(results: " in said
        and ", axis='z', power=1, *, start: float | None = None)" in said
    )
    assert "Mean of cos(angle)**power to an axis of the box." in said
    assert "mean_cosine" in dir(rigidmd.analysis)
    with pytest.raises(SystemExit):
        cli.main(["analyse", "--list"])
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()][:2] == [
        "rdf",
        "mean_cosine",
    ]
    assert cli.main(["analyse", str(copy), "--only", "mean_cosine"]) == 0
    with pytest.raises(
        OutputError, match=r"mean_cosine is an analysis of rigidmd. Rename your function"
    ):
        rigidmd.analysis.register(_named("mean_cosine"))


def _named(name):
    def function(frames):
        return frames.time

    function.__name__ = name
    return function


def test_an_analysis_that_is_registered_is_a_function_of_results():
    @rigidmd.analysis.register
    def height_of_all(frames):
        "mean height (Å)"
        return frames.positions[:, :, 2].mean(axis=1)

    results = Simulation(Scene.read(ROOT / "systems" / "water.toml", SHORT)).run()
    found = rigidmd.analysis.height_of_all(results, start=0.0)
    assert len(found["height_of_all"]) == len(results.rotation)
    title, entries = rigidmd.analysis.height_of_all.__doc__.split("\n\nParameters\n")
    assert title == "mean height (Å)" and "start : float" in entries
    assert "height_of_all" in dir(rigidmd.analysis)
    with pytest.raises(AttributeError, match="no attribute 'height_of_none'"):
        _ = rigidmd.analysis.height_of_none


def test_a_pressure_tensor_needs_a_box():
    asked = {"pressure_tensor_interval_ps": 0.01}
    with pytest.raises(
        SceneError, match=r"output.pressure_tensor_interval_ps needs a periodic box"
    ):
        build(small_scene({"argon": 4}, None, output=asked))
    for wrong in (-1, "often", True):
        with pytest.raises(SceneError, match="pressure_tensor_interval_ps"):
            small_scene({"argon": 4}, 25.0, output={"pressure_tensor_interval_ps": wrong})


@pytest.fixture(scope="module")
def text_run(tmp_path_factory):
    """A run whose frames are text."""
    folder = tmp_path_factory.mktemp("runs") / "text"
    more = {
        "output.trajectory": "t.xyz",
        "stages.production.duration_ps": 0.04,
        "output.pressure_tensor_interval_ps": False,
    }
    Simulation(Scene.read(ROOT / "systems" / "water.toml", SHORT | more), folder).run()
    return folder


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (
            lambda frames: [
                *frames[:9],
                [frames[9][0].replace("648", "647"), *frames[9][1:-1]],
                *frames[10:],
            ],
            "frame 10 of 16 is not one of 648 sites",
        ),
        (
            lambda frames: [
                *frames[:9],
                [*frames[9][:2], "OW nan 0 0", *frames[9][3:]],
                *frames[10:],
            ],
            "not finite numbers",
        ),
        (
            lambda frames: [
                *frames[:9],
                [*frames[9][:2], "OW 900.0 0 0", *frames[9][3:]],
                *frames[10:],
            ],
            "frame 5: a site of molecule 1 is",
        ),
        (
            lambda frames: frames[:6],
            "from 0.02 ps on there is 1 of 6 frames. An analysis needs at least two",
        ),
        (
            lambda frames: [*frames[:9], *frames[10:]],
            "needs frames at equal intervals. These are 0.004 to 0.008 ps",
        ),
    ],
    ids=["number", "nan", "torn", "one", "uneven"],
)
def test_frames_that_are_spoilt_are_reported(spoil, words, text_run, tmp_path, capsys):
    folder = Path(shutil.copytree(text_run, tmp_path / "run"))
    lines = (folder / "t.xyz").read_text().splitlines()
    frames = [lines[k : k + 650] for k in range(0, len(lines), 650)]
    (folder / "t.xyz").write_text(
        "\n".join(line for frame in spoil(frames) for line in frame) + "\n"
    )
    assert words in said(capsys, folder, "--only", "msd", "--from", "0.02ps")


def test_friction_on_each_molecule_is_reported(water):
    record = read_record(water)
    assert "thermostat" not in " ".join(frames_of_folder(record, 0.02).notes)
    stages = tuple(
        s.model_copy(update={"ensemble": "nvt", "thermostat": "langevin"})
        for s in record.scene.stages
    )
    scene = record.system.scene.model_copy(update={"stages": stages})
    columns = record.columns | {"stage_name": np.full(len(record.columns["time"]), "nvt")}
    told = frames_of_folder(
        replace(record, system=replace(record.system, scene=scene), columns=columns), 0.02
    ).notes
    assert "the thermostat langevin acts on each molecule" in " ".join(told)


@pytest.mark.usefixtures("reads_here")
def test_stages_of_one_name_are_distinguished(tmp_path):
    """Production is the last stage, also where an earlier one has its name."""
    stages = [
        {"name": "x", "ensemble": "nvt", "temperature_K": 90.0, "duration_ps": 0.02},
        {"name": "x", "duration_ps": 0.2},
    ]
    output = {"trajectory_interval_ps": 0.01, "log_interval_ps": 0.01, "figures": False}
    Simulation(
        small_scene({"argon": 20}, 25.0, stages=stages, output=output), tmp_path / "run"
    ).run()
    record = read_record(tmp_path / "run")
    assert np.bincount(record.columns["stage"].astype(int)).tolist() == [3, 20]
    found = frames_of_folder(record)
    assert found.stage.ensemble == "nve"
    assert 0.02 - 1e-6 < found.time[0] < found.time[-1] == pytest.approx(0.22)


def test_figures_are_of_the_requested_type(copy, capsys):
    before = {path.name for path in copy.iterdir()}
    for kind in ("svg", "png"):
        assert (
            cli.main(["analyse", str(copy), "--only", "msd,density_profile", "--figures", kind])
            == 0
        )
        made = {path.name for path in copy.iterdir()} - before
        # no figure of another type stays from the analysis before
        assert made == {
            "analysis.json",
            "msd.csv",
            f"msd.{kind}",
            "density_profile.csv",
            f"density_profile.{kind}",
        }


def test_a_pair_of_sites_has_one_row():
    peaks = [("first peak", "Å", 2.75), ("height of that peak", "1", 3.1)]
    values = [
        Value(f"g {pair}: {title}", unit, x, 0.01, 0.4)
        for pair in ("O-O", "O-H")
        for title, unit, x in peaks
    ]
    values.insert(2, Value("g O-O: neighbours up to the first minimum", "1", 4.3, 0.1, 0.4))
    values.append(Value("density", "g/cm³", 1.0, 0.001, 0.2))
    text = "\n".join(results_text([AnalysisResult("test", "a test", values)], {}))
    rows = [re.split("  +", line.strip()) for line in text.splitlines() if line]
    assert rows == [
        ["quantity", "value", "unit", "correlation time (ps)"],
        ["density", "1.0000 ± 0.0010", "g/cm³", "0.2"],
        ["g(r)", "first peak (Å)", "height", "neighbours", "correlation time (ps)"],
        ["O-O", "2.750 ± 0.010", "3.100 ± 0.010", "4.30 ± 0.10", "0.4"],
        ["O-H", "2.750 ± 0.010", "3.100 ± 0.010", "-", "0.4"],
    ]


def test_a_value_with_a_large_error_is_not_known_yet():
    values = [
        Value("firm", "1", 4.0, 2.0, None, ""),
        Value("vague", "D", 28.0, 101.0, None, ""),
        Value("mean total dipole along x", "D", 4.0, 1.0, None, ""),
    ]
    result = AnalysisResult("test", "a test", values)
    text = "\n".join(results_text([result], {}))
    table, missing = text.split("No value yet:")
    assert "firm" in table and "vague" not in table and "dipole" not in text
    assert "vague: 28 ± 101 D is too uncertain" in " ".join(missing.split())
    assert "dipole" in "\n".join(results_text([result], {}, verbose=True))
