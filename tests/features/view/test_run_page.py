"""Pages of runs: what is in them, what a browser shows, bad input."""

import re
import shutil
import subprocess
import sys

import MDAnalysis
import numpy as np
import pytest
from matplotlib.image import imread
from support.common import ROOT, small_scene, system_of
from support.pages import CHROMIUM, SHORT_WATER, data_of, is_alone, numbers

from rigidmd import Scene, Simulation
from rigidmd.commands import cli
from rigidmd.features.view import molecule_animation
from rigidmd.features.view.kind_display import panels
from rigidmd.features.view.plots import plots_part
from rigidmd.features.view.run_page import write_report
from rigidmd.io.trajectory import Frames
from rigidmd.run.record import read_record

in_browser = pytest.mark.skipif(
    not CHROMIUM, reason="Chromium is not installed: what a browser shows is not tested"
)


def shown(page, out, at=None, size="420,700"):
    """The pixels of a page in a browser, (h, w, 3), at a time of its animation."""
    flags = [
        "--headless=new",
        "--no-sandbox",
        "--disable-quic",
        "--no-first-run",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
        "--enable-unsafe-swiftshader",
        "--hide-scrollbars",
    ]
    address = page.resolve().as_uri() + ("" if at is None else f"#t={at}")
    subprocess.run(
        [
            CHROMIUM,
            *flags,
            f"--user-data-dir={out.parent / 'browser'}",
            f"--window-size={size}",
            f"--screenshot={out}",
            address,
        ],
        check=True,
        capture_output=True,
    )
    return imread(out)[:, :, :3]


def test_a_report_describes_molecules(water, tmp_path, capsys):
    page = tmp_path / "water.html"
    assert cli.main(["report", str(water), "-o", str(page)]) == 0
    text = page.read_text("utf-8")
    assert is_alone(text)
    for title in (
        "Means of each stage",
        "Plots",
        "Stability margins",
        "System and interactions",
        "Not used, and why",
        "Files",
        "How to repeat it",
    ):
        assert f">{title}</h2>" in text
    record = read_record(water)
    own = record.columns["temperature"][record.columns["stage_name"] == "production"]
    assert ">water: 216 spce</h1>" in text
    words = re.sub(r"<[^>]*>", " ", text)
    assert re.search(r"averaged over +all 0.02 ps", words)
    row = re.search(r"\btemperature +K +[^ ]+ +([\d.]+)\s±\s\?", words)
    assert float(row[1]) == pytest.approx(own.mean(), abs=0.5)
    assert "barostat: no NPT or NPH stage" in text
    assert page.stat().st_size < 1e6
    assert str(page) in capsys.readouterr().out


def test_the_drift_is_drawn_in_each_stage_in_one_unit(water):
    record = read_record(water)
    drifts = [
        (times, panel) for times, panel in panels(record) if "conserved energy" in panel.title
    ]
    assert [panel.title.split(":")[0] for _, panel in drifts] == ["equilibration", "production"]
    assert {panel.unit for _, panel in drifts} == {"kT per degree of freedom"}
    for times, panel in drifts:
        at = record.time[times.shown]
        assert (times.time == at).all()
        last = record.summary["stages"][times.stage[0]]
        line = panel.curves[1][1][times.shown]
        assert np.ptp(line) / np.ptp(at) * 1000 == pytest.approx(
            abs(last["drift_kT_ns_per_degree_of_freedom"])
        )
        # kT per degree of freedom: the same ratio to kJ/mol per molecule as in the summary
        ratio = last["drift_kT_ns_per_degree_of_freedom"] / last["drift_kJ_mol_ns_per_molecule"]
        values = record.columns["drift"][times.shown] / 216
        assert panel.curves[0][1][times.shown] == pytest.approx(ratio * values)


def test_the_animation_of_molecules_starts_with_the_last_stage(water, tmp_path):
    page = tmp_path / "water.html"
    assert cli.main(["view", str(water), "-o", str(page)]) == 0
    text, record = page.read_text("utf-8"), read_record(water)
    times = numbers(data_of(page)["time"], "<f8")
    production = record.time[record.columns["stage_name"] == "production"]
    assert data_of(page)["begin"] == times[times >= production[0]][0] > times[0]
    assert text.index("Means of each stage") < text.index('class="plots"')  # next to the animation
    assert text.count("<h1>") == 1


def test_a_report_describes_a_body(top, capsys):
    assert cli.main(["report", str(top)]) == 0  # next to the run, and again
    assert cli.main(["report", str(top)]) == 0
    text = (top / "report.html").read_text("utf-8")
    assert is_alone(text)
    assert "between 40.000000° and" in text
    assert "L_z error" in text
    assert "report.html" in (top / ".rigidmd-run").read_text()  # which a new run there removes


def test_the_animation_of_a_body_is_its_motion(top, tmp_path):
    page = tmp_path / "top.html"
    assert cli.main(["view", str(top), "-o", str(page)]) == 0
    data, seen = data_of(page), read_record(top).columns
    assert np.array_equal(numbers(data["time"], "<f8"), seen["time"])
    quaternion = np.stack([seen[key] for key in ("qw", "qx", "qy", "qz")], axis=-1)
    assert np.allclose(numbers(data["quaternion"], "<f4").reshape(-1, 4), quaternion, atol=1e-6)
    tip = numbers(data["path"], "<f4").reshape(-1, 3)[-1]
    assert np.allclose(
        tip, data["sphere"] * np.array([seen[f"q{i}3"][-1] for i in (1, 2, 3)]), atol=1e-6
    )
    assert is_alone(page.read_text("utf-8"))
    assert page.stat().st_size < 1e6


@pytest.mark.usefixtures("reads_here")
def test_the_animation_of_molecules_is_their_trajectory(water, tmp_path, monkeypatch):
    monkeypatch.setattr(molecule_animation, "chemiscope_script", lambda: "var Chemiscope;")
    page = tmp_path / "water.html"
    assert cli.main(["view", str(water), "-o", str(page)]) == 0
    data, record = data_of(page), read_record(water)
    seen = (numbers(data["positions"], "<i2").astype(float) + data["steps"]) * data["scale"] + data[
        "low"
    ]
    frames = molecule_animation.frames_of(record, 100)
    assert np.allclose(seen.reshape(frames.positions.shape), frames.positions, atol=data["scale"])
    assert data["scale"] < 1e-3
    assert numbers(data["time"], "<f8") == pytest.approx([0, 0.01, 0.02, 0.03, 0.04], abs=1e-6)
    assert len(data["bonds"]) == 2 * 216
    assert set(data["elements"]) == {"O", "H"}
    centre = frames.positions.reshape(-1, 216, 3, 3).mean(axis=2)
    assert centre.min() > -0.01
    assert centre.max() < frames.cells.max() + 0.01


def test_molecules_are_put_into_a_triclinic_cell():
    """Whole, by multiples of the edges of the cell of each frame."""
    sites = system_of({"spce": 5}, 30.0).sites
    rng = np.random.default_rng(2)
    cells = np.array([[[9.0, 0, 0], [4, 8, 0], [-3, 5, 7]], [[10.0, 0, 0], [-4, 9, 0], [2, 3, 8]]])
    positions = rng.uniform(-40, 40, (2, 5, 1, 3)) + rng.uniform(-1, 1, (2, 5, 3, 3))
    positions = positions.reshape(2, 15, 3)
    frames = Frames(np.arange(2.0), positions, cells, 2, 1, is_cut=False)
    found = molecule_animation.inside(frames, sites)
    for before, after, cell in zip(positions, found.positions, cells, strict=True):
        fractions = after.reshape(5, 3, 3).mean(axis=1) @ np.linalg.inv(cell)
        assert (fractions > -1e-5).all()
        assert (fractions < 1 + 1e-5).all()
        moves = (before - after).reshape(5, 3, 3) @ np.linalg.inv(cell)
        assert moves == pytest.approx(np.round(moves[:, :1]) + np.zeros_like(moves), abs=1e-5)


@pytest.mark.parametrize("extension", [".trr", ".gsd", ".traj", ".dcd", ".nc", ".xyz", ".pdb"])
def test_every_format_of_a_trajectory_has_a_page(extension, tmp_path):
    output = {"trajectory": f"t{extension}", "trajectory_interval_ps": 0.01, "figures": False}
    scene = small_scene({"spce": 8}, 20.0, stages=[{"duration_ps": 0.03}], output=output)
    results = Simulation(scene, tmp_path / "run").run()
    frames = molecule_animation.frames_of(read_record(tmp_path / "run"), 100)
    assert frames.time == pytest.approx([0, 0.01, 0.02, 0.03], abs=1e-6)
    assert frames.cells[-1] == pytest.approx(results.state.cell, abs=1e-3)


@pytest.mark.usefixtures("reads_here")
def test_without_chemiscope_a_sentence_states_what_to_install(water, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "chemiscope", None)
    assert cli.main(["view", str(water)]) == 2
    assert capsys.readouterr().err.strip().endswith("needs chemiscope: pip install chemiscope")
    assert not (water / "view.html").exists()


@in_browser
def test_a_browser_shows_a_top_that_moves(top, tmp_path):
    page = tmp_path / "top.html"
    assert cli.main(["view", str(top), "-o", str(page)]) == 0
    one, other = (
        shown(page, tmp_path / f"{at}.png", at)[150:400] for at in (0.05, 0.1)
    )  # half a rotation
    red, green, blue = (np.stack([one, other])[..., k] for k in range(3))
    assert (blue > red + 0.15).mean() > 0.02  # its sides
    assert ((red > blue + 0.2) & (red > green + 0.2)).mean() > 0.005  # its painted side
    assert (np.abs(one - other).max(axis=-1) > 0.2).mean() > 0.02


@in_browser
@pytest.mark.soak
def test_a_browser_shows_water_that_moves(water, tmp_path):
    pytest.importorskip("chemiscope", reason="chemiscope is not installed")
    page = tmp_path / "water.html"
    assert cli.main(["view", str(water), "-o", str(page)]) == 0
    one, other = (shown(page, tmp_path / f"{at}.png", at)[150:450] for at in (0, 0.04))
    red = (one[..., 0] > one[..., 1] + 0.3) & (one[..., 0] > one[..., 2] + 0.3)
    assert red.mean() > 0.005  # oxygen
    assert (np.abs(one - other).max(axis=-1) > 0.2).mean() > 0.02


@in_browser
@pytest.mark.soak
def test_an_animation_of_a_thousand_frames_of_water(tmp_path):
    pytest.importorskip("chemiscope", reason="chemiscope is not installed")
    more = SHORT_WATER | {
        "stages.production.duration_ps": 2.0,
        "output.trajectory_interval_ps": 0.002,
    }
    Simulation(Scene.read(ROOT / "systems" / "water.toml", more), tmp_path / "run").run()
    page = tmp_path / "water.html"
    assert cli.main(["view", str(tmp_path / "run"), "-o", str(page)]) == 0
    assert page.stat().st_size < 30e6
    assert len(numbers(data_of(page)["time"], "<f8")) > 1000
    pictures = [
        shown(page, tmp_path / f"{at}.png", at, "1200,800")[60:560, :600] for at in (0.1, 1.9)
    ]
    assert (np.abs(pictures[0] - pictures[1]).max(axis=-1) > 0.2).mean() > 0.02


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("summary.json", "[]", "summary.json: is [], must be a table"),
        ("summary.json", "{", "cannot be read"),
        ("motion.csv", "t,x\n0,1\n", "has no column"),
        ("motion.csv", "", "has no column"),
        ("scene.toml", "[body", "scene.toml"),
    ],
)
def test_damaged_files_of_a_run(name, text, said, top, tmp_path, capsys):
    shutil.copytree(top, tmp_path / "run")
    (tmp_path / "run" / name).write_text(text)
    assert cli.main(["report", str(tmp_path / "run"), "-o", str(tmp_path / "page.html")]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "page.html").exists()


@pytest.mark.parametrize("run", ["top", "water"])
def test_time_axes_of_plots_are_aligned(run, request):
    text = plots_part(read_record(request.getfixturevalue(run)))
    boxes = re.findall(r'data-box="(\S+) (\S+) (\S+) (\S+)"', text)
    assert len(boxes) >= 4
    assert len({box[:2] for box in boxes}) == 1  # their left and right ends
    assert all(0 < float(top) < float(bottom) < 1 for _, _, top, bottom in boxes)


def test_notes_that_a_page_has_elsewhere_are_not_warnings(water, tmp_path):
    write_report(water, tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text("utf-8")
    assert text.count("pme: alpha") == 1  # in the description of the system


@pytest.mark.parametrize("command", ["report", "view", "film"])
@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("nothing", "does not exist. Name the folder of a run"),
        ("a file", "is a file. Name the folder of a run"),
        ("no run", "is not the folder of a run"),
        ("no samples", "the run has not written samples yet. `rigidmd resume"),
        ("no log", "log.csv cannot be read"),
    ],
)
def test_a_folder_that_is_not_a_run(command, fault, said, water, tmp_path, capsys):
    folder = tmp_path / "run"
    if fault == "a file":
        folder.write_text("x")
    elif fault == "no run":
        folder.mkdir()
    elif fault != "nothing":
        shutil.copytree(water, folder)
        log = folder / "log.csv"
        log.unlink() if fault == "no log" else log.write_text(
            log.read_text().splitlines()[0] + "\n"
        )
    path = tmp_path / ("film.gif" if command == "film" else "page.html")
    assert cli.main([command, str(folder), "-o", str(path)]) == 2
    assert said in capsys.readouterr().err
    assert not path.exists()


@pytest.mark.filterwarnings(
    "ignore:Reader has no dt information"
)  # of MDAnalysis, for a file of one frame
@pytest.mark.parametrize("fault", ["missing", "other atoms", "other shapes", "noise", "empty"])
def test_a_trajectory_that_is_not_that_of_the_run(fault, water, top, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(molecule_animation, "chemiscope_script", lambda: "")
    folder = tmp_path / "run"
    shutil.copytree(water, folder, ignore=shutil.ignore_patterns(".trajectory*"))
    path = folder / "trajectory.xtc"
    match fault:
        case "missing":
            path.unlink()
        case "other atoms":
            shutil.copyfile(top / "trajectory.xtc", path)
        case "other shapes":
            u = MDAnalysis.Universe(folder / "topology.gro")
            u.atoms.positions = 2 * u.atoms.positions
            u.atoms.write(str(path))
        case "noise":
            path.write_bytes(np.random.default_rng(1).bytes(5000))
        case "empty":
            path.write_bytes(b"")
    said = {
        "missing": "is missing",
        "other atoms": "8 sites, must be 648",
        "other shapes": "have other shapes",
    }
    assert cli.main(["view", str(folder)]) == 2
    error = capsys.readouterr().err
    assert said.get(fault, "cannot be read as a trajectory") in error
    assert "Traceback" not in error
    assert fault != "missing" or cli.main(["report", str(folder)]) == 0


@pytest.mark.usefixtures("reads_here")
def test_a_run_that_was_killed_shows_what_there_is(water, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(molecule_animation, "chemiscope_script", lambda: "")
    folder = tmp_path / "run"
    shutil.copytree(water, folder, ignore=shutil.ignore_patterns(".trajectory*"))
    (folder / "summary.json").unlink()
    for name in ("log.csv", "trajectory.xtc"):
        whole = (folder / name).read_bytes()
        (folder / name).write_bytes(whole[: int(0.55 * len(whole))])
    assert cli.main(["view", str(folder)]) == 0
    said = capsys.readouterr().out
    assert "This run has not ended" in said
    assert "ends within a frame" in said
    assert "This run has not ended" in (folder / "view.html").read_text("utf-8")
    assert len(numbers(data_of(folder / "view.html")["time"], "<f8")) == 2


def test_a_body_that_was_killed_shows_its_last_checkpoint(top, tmp_path, capsys):
    folder = tmp_path / "run"
    shutil.copytree(top, folder)
    whole = read_record(top).columns["q11"]
    for name in ("summary.json", "motion.csv"):
        (folder / name).unlink()
    assert cli.main(["view", str(folder)]) == 0
    assert "The motion shown ends at the last checkpoint" in capsys.readouterr().out
    assert np.array_equal(read_record(folder).columns["q11"], whole)


def test_a_page_is_not_replaced_unless_requested(top, tmp_path, capsys):
    page = tmp_path / "page.html"
    page.write_text("mine")
    assert cli.main(["report", str(top), "-o", str(page)]) == 2
    assert "--force replaces it" in capsys.readouterr().err
    assert page.read_text() == "mine"
    assert cli.main(["report", str(top), "-o", str(page), "--force"]) == 0
    assert cli.main(["report", str(top), "-o", str(tmp_path / "page.png")]) == 2
