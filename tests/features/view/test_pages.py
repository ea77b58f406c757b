"""Pages and animations of runs: what is in them, what a browser shows of them, and bad input."""

import base64
import json
import re
import shutil
import subprocess
import sys
import types
from itertools import pairwise

import MDAnalysis
import numpy as np
import pytest
from matplotlib.image import imread
from PIL import Image, ImageSequence
from support.common import ROOT, small_scene, system_of

from rigidmd import Scene, Simulation
from rigidmd.assemble.body import build_body
from rigidmd.commands import cli
from rigidmd.formats.bonds import connections
from rigidmd.io.trajectory import Frames
from rigidmd.mechanics.inertia import SOLIDS, shifted_inertia, solid
from rigidmd.run.record import read_record
from rigidmd.view import animation as film
from rigidmd.view import molecule_animation
from rigidmd.view.animation import write_film
from rigidmd.view.mesh import UNITS, mesh_of
from rigidmd.view.plots import plots_part
from rigidmd.view.run_page import write_report

CHROMIUM = next(
    (
        path
        for name in ("chromium", "chromium-browser", "google-chrome")
        if (path := shutil.which(name))
    ),
    "",
)
in_browser = pytest.mark.skipif(
    not CHROMIUM, reason="Chromium is not installed: what a browser shows is not tested"
)
SHORT_WATER = {
    "stages.equilibration.duration_ps": 0.02,
    "stages.equilibration.timestep_fs": 2.0,
    "stages.production.duration_ps": 0.02,
    "output.trajectory_interval_ps": 0.01,
    "output.log_interval_ps": 0.004,
    "output.figures": False,
}


@pytest.fixture(scope="module")
def top(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "top"
    scene = Scene.read(
        ROOT / "systems" / "heavy_top_3.toml", {"run.duration_s": 0.5, "output.figures": False}
    )
    Simulation(scene, folder).run()
    return folder


@pytest.fixture(scope="module")
def water(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "water"
    Simulation(Scene.read(ROOT / "systems" / "water.toml", SHORT_WATER), folder).run()
    return folder


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


def data_of(page):
    """The data of the animation in a page."""
    found = re.search(
        r'<script type="application/json" id="film-data">(.*?)</script>', page.read_text("utf-8")
    )
    return json.loads(found[1])


def numbers(text, kind):
    return np.frombuffer(base64.b64decode(text), kind)


def is_alone(text):
    """Whether a page loads nothing from elsewhere."""
    own = re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)
    return not re.search(
        r"<link|<script[^>]* src|<img[^>]* src=\"(?!data:)|url\((?!#)|@import|<image", own
    )


def test_a_report_tells_of_molecules(water, tmp_path, capsys):
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
    assert (
        '<td>means</td><td class="wrap">over all 0.02 ps, too short to detect equilibration</td>'
        in text
    )
    of_stage = text[text.index("<p>production: ") :]
    row = re.search(r"<td>temperature</td><td>([\d.]+) K \(too short for an error\)</td>", of_stage)
    assert float(row[1]) == pytest.approx(own.mean(), abs=0.5)
    assert "barostat: no NPT or NPH stage" in text
    assert page.stat().st_size < 1e6
    assert str(page) in capsys.readouterr().out


def test_a_report_tells_of_a_body(top, capsys):
    assert cli.main(["report", str(top)]) == 0  # next to the run, and again
    assert cli.main(["report", str(top)]) == 0
    text = (top / "report.html").read_text("utf-8")
    assert is_alone(text)
    assert "between 40.000000° and" in text
    assert "L_z error" in text
    assert "report.html" in (top / ".rigidmd-run").read_text()  # which a new run there removes


def test_the_film_of_a_body_is_its_motion(top, tmp_path):
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


def test_the_film_of_molecules_is_their_trajectory(water, tmp_path, monkeypatch):
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


def test_molecules_are_put_into_a_cell_that_leans():
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


@pytest.mark.parametrize("ending", [".trr", ".gsd", ".traj", ".dcd", ".nc", ".xyz", ".pdb"])
def test_every_format_of_a_trajectory_can_be_looked_at(ending, tmp_path):
    output = {"trajectory": f"t{ending}", "trajectory_interval_ps": 0.01, "figures": False}
    scene = small_scene({"spce": 8}, 20.0, stages=[{"duration_ps": 0.03}], output=output)
    results = Simulation(scene, tmp_path / "run").run()
    frames = molecule_animation.frames_of(read_record(tmp_path / "run"), 100)
    assert frames.time == pytest.approx([0, 0.01, 0.02, 0.03], abs=1e-6)
    assert frames.cells[-1] == pytest.approx(results.state.cell, abs=1e-3)


def test_without_chemiscope_a_sentence_says_what_to_install(water, monkeypatch, capsys):
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
def test_a_film_of_a_thousand_frames_of_water(tmp_path):
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


def test_numbers_that_are_none_are_refused(top, tmp_path, capsys):
    shutil.copytree(top, tmp_path / "run")
    path = tmp_path / "run" / "motion.csv"
    for cell, said in (
        ("x", "has a cell that is not a number"),
        ("nan", "has a cell that is not a finite number"),
    ):
        head, line, *_ = (top / "motion.csv").read_text().splitlines()
        path.write_text(f"{head}\n{line}\n{','.join([cell, *line.split(',')[1:]])}\n")
        assert cli.main(["view", str(tmp_path / "run")]) == 2
        assert said in capsys.readouterr().err


def frames_in(path):
    """The frames of a .gif (f, h, w, 3), 0 to 1."""
    with Image.open(path) as film:
        return (
            np.array([np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)])
            / 255
        )


@pytest.mark.parametrize("kind", ["top", "water"])
def test_a_film_moves(kind, request, tmp_path, capsys):
    path = tmp_path / "film.gif"
    plots = ["--plots"] if kind == "water" else []
    assert (
        cli.main(
            [
                "film",
                str(request.getfixturevalue(kind)),
                "-o",
                str(path),
                "--seconds",
                "0.3",
                *plots,
            ]
        )
        == 0
    )
    seen = frames_in(path)
    assert len(seen) == 4
    picture = seen[:, 80:, : seen.shape[1]]  # below the clock
    ink = (picture < 0.9).any(axis=-1)
    assert 0.02 < ink.mean() < 0.9
    for one, other in pairwise(picture):
        assert (np.abs(one - other).max(axis=-1) > 0.2).mean() > 1e-3
    if plots:
        beside = seen[:, :, int(seen.shape[2] / 1.7) :]
        red = (beside[..., 0] > beside[..., 2] + 0.2).mean(axis=1)
        places = red.argmax(axis=1)  # a red line in each plot, which moves to the right
        assert red.max(axis=1).min() > 0.3
        assert np.all(np.diff(places) > 5)
    assert "0.3 s of animation" in capsys.readouterr().out


def test_a_gif_is_small(top, tmp_path):
    """By default: the page of a run that shows it loads in a moment."""
    path, _ = write_film(top, tmp_path / "film.gif", 3.0)
    assert len(frames_in(path)) == 38
    assert path.stat().st_size < 200_000  # 10 s are below 500 kB


def test_a_gif_that_is_too_large_has_fewer_frames(top, tmp_path, monkeypatch):
    monkeypatch.setattr(film, "GIF_BYTES", 20_000)
    path, _ = write_film(top, tmp_path / "film.gif", 0.5)
    with Image.open(path) as picture:
        assert picture.n_frames == 2
        assert picture.info["duration"] == 240  # as long as with all six


def test_gifs_of_the_documentation_are_small():
    gifs = [*(ROOT / "rigidmd" / "docs").rglob("*.gif")]
    assert gifs
    assert {path.name: path.stat().st_size for path in gifs if path.stat().st_size > 500_000} == {}


@pytest.mark.parametrize("run", ["top", "water"])
def test_time_axes_of_plots_are_aligned(run, request):
    text = plots_part(read_record(request.getfixturevalue(run)))
    boxes = re.findall(r'data-box="(\S+) (\S+) (\S+) (\S+)"', text)
    assert len(boxes) >= 4
    assert len({box[:2] for box in boxes}) == 1  # their left and right ends
    assert all(0 < float(top) < float(bottom) < 1 for _, _, top, bottom in boxes)


def test_notes_that_a_page_has_elsewhere_are_no_warnings(water, tmp_path):
    write_report(water, tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text("utf-8")
    assert text.count("pme: alpha") == 1  # in the description of the system


def test_a_film_needs_ffmpeg_for_mp4_only(top, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(film.shutil, "which", lambda name: None)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)  # not installed
    assert film.default_name() == "film.gif"
    assert cli.main(["film", str(top), "-o", str(tmp_path / "film.mp4")]) == 2
    assert (
        "needs ffmpeg: install the program, or `pip install imageio-ffmpeg`"
        in capsys.readouterr().err
    )
    program = tmp_path / "its-ffmpeg"
    program.write_text(
        f"#!{sys.executable}\nimport sys\nsys.stdin.buffer.read()\nopen(sys.argv[-1], 'wb').write(b'film')\n"
    )
    program.chmod(0o700)
    monkeypatch.setitem(
        sys.modules, "imageio_ffmpeg", types.SimpleNamespace(get_ffmpeg_exe=lambda: str(program))
    )
    assert film.default_name() == "film.mp4"
    assert (
        cli.main(
            [
                "film",
                str(top),
                "-o",
                str(tmp_path / "its.mp4"),
                "--seconds",
                "0.2",
                "--height",
                "100",
            ]
        )
        == 0
    )
    assert (tmp_path / "its.mp4").read_bytes() == b"film"
    assert cli.main(["film", str(top), "-o", str(tmp_path / "film.avi")]) == 2
    assert "ends in .mp4 or .gif" in capsys.readouterr().err


@pytest.mark.skipif(
    not shutil.which("ffmpeg"), reason="ffmpeg is not installed: .mp4 is not tested"
)
def test_a_film_as_mp4(top, tmp_path):
    path = tmp_path / "top.mp4"
    assert cli.main(["film", str(top), "-o", str(path), "--seconds", "0.2"]) == 0
    assert path.read_bytes()[4:8] == b"ftyp"


def test_a_film_of_a_periodic_motion_ends_where_it_began(top):
    from rigidmd.view.body_animation import BodyAnimation

    film = BodyAnimation(read_record(top))
    assert film.loop_end() == (0.5, [])  # this top has fallen and risen, but rotated elsewhere
    half = np.pi * film.time / 0.13  # half the angle of a rotation in 0.13 s, about z
    turning = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], axis=-1)
    still = {name: np.tile(values[0], (len(values), 1)) for name, values in film.vectors.items()}
    film.quaternion, film.vectors = turning, still
    end, notes = film.loop_end()
    assert end == pytest.approx(0.39, abs=1e-9)
    assert "motion returns to its start at 0.39 s" in notes[0]
    film.vectors = {
        name: values * (1 + 0.01 * film.time[:, None] / 0.39) for name, values in still.items()
    }
    end, notes = film.loop_end()  # alike in a picture
    assert end == pytest.approx(0.39, abs=1e-9)
    assert "motion nearly returns to its start at 0.39 s" in notes[0]


@pytest.mark.parametrize("command", ["report", "view", "film"])
@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("nothing", "is not there. Name the folder of a run"),
        ("a file", "is a file. Name the folder of a run"),
        ("no run", "is not the folder of a run"),
        ("no samples", "the run has not written samples yet. `rigidmd resume"),
        ("no log", "log.csv cannot be read"),
    ],
)
def test_a_folder_that_is_no_run(command, fault, said, water, tmp_path, capsys):
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


def test_a_film_says_what_it_leaves_out(water, tmp_path, monkeypatch):
    monkeypatch.setattr(molecule_animation, "chemiscope_script", lambda: "")
    monkeypatch.setattr(molecule_animation, "MOST_COORDINATES", 3 * 3 * 648)
    page = tmp_path / "water.html"
    assert cli.main(["view", str(water), "-o", str(page)]) == 0
    assert len(numbers(data_of(page)["time"], "<f8")) == 3
    assert "3 of 5 frames are shown, every 2th" in page.read_text("utf-8")


def test_a_page_is_not_replaced_unless_asked(top, tmp_path, capsys):
    page = tmp_path / "page.html"
    page.write_text("mine")
    assert cli.main(["report", str(top), "-o", str(page)]) == 2
    assert "--force replaces it" in capsys.readouterr().err
    assert page.read_text() == "mine"
    assert cli.main(["report", str(top), "-o", str(page), "--force"]) == 0
    assert cli.main(["report", str(top), "-o", str(tmp_path / "page.png")]) == 2


def volume(mesh):
    """For a closed surface whose faces are seen counterclockwise from outside."""
    corners = [mesh.vertices[face] for face in mesh.faces]
    return sum(p[0] @ np.cross(p[k], p[k + 1]) / 6 for p in corners for k in range(1, len(p) - 1))


@pytest.mark.parametrize("shape", ["cylinder", "cone", "cuboid", "sphere", "ellipsoid"])
def test_the_drawn_surface_is_that_of_the_solid(shape):
    sizes = {
        "radius_m": 2.0,
        "height_m": 3.0,
        "lengths_m": [1.0, 2.0, 3.0],
        "semi_axes_m": [1.0, 2.0, 3.0],
    }
    given = {key: sizes[key] for key in SOLIDS[shape].dimensions}
    body = {"mass_kg": 1.0, "solid": {"shape": shape, **given}}
    scene = Scene.from_dict({"body": body, "run": {"duration_s": 1.0, "timestep_s": 0.1}})
    mesh = mesh_of(build_body(scene))
    known = {
        "cylinder": np.pi * 12,
        "cone": np.pi * 4,
        "cuboid": 6,
        "sphere": np.pi * 32 / 3,
        "ellipsoid": np.pi * 8,
    }
    assert volume(mesh) == pytest.approx(known[shape], rel=0.04)
    assert 0 < sum(mesh.painted) < len(mesh.faces)
    outline = solid(shape, 1.0, given).outline
    assert np.allclose(np.ptp(outline, axis=0), np.ptp(mesh.vertices, axis=0), rtol=0.01)


def inertia_of_mesh(mesh, mass):
    """Centre (3,) and inertia tensor (3, 3) about it, of a homogeneous body inside a closed
    surface."""
    products, first, whole = np.zeros((3, 3)), np.zeros(3), 0.0
    for face in mesh.faces:
        p = mesh.vertices[face]
        for k in range(1, len(p) - 1):
            corners = np.stack([p[0], p[k], p[k + 1]])
            part, total = np.linalg.det(corners) / 6, corners.sum(axis=0)
            whole, first = whole + part, first + part * total / 4
            products += part / 20 * (corners.T @ corners + np.outer(total, total))
    centre = first / whole
    products = mass / whole * products - mass * np.outer(centre, centre)
    return centre, np.trace(products) * np.eye(3) - products


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize(("across", "along"), [(1.0, 1.9), (1.0, 0.3), (1.0, 1.0)])
@pytest.mark.parametrize("offset", [0.0, -3.0, 3.0])
def test_a_symmetric_body_is_drawn_as_the_solid_of_revolution_of_its_inertia(
    axis, across, along, offset
):
    moments, centre = np.full(3, across), np.zeros(3)
    moments[axis], centre[axis] = along, offset
    body = {
        "mass_kg": 2.0,
        "inertia_kg_m2": moments.tolist(),
        "pinned": True,
        "centre_of_mass_m": centre.tolist(),
    }
    mesh = mesh_of(
        build_body(Scene.from_dict({"body": body, "run": {"duration_s": 1.0, "timestep_s": 0.1}}))
    )
    assert mesh.stem == (offset != 0)
    if not mesh.stem:
        place, tensor = inertia_of_mesh(mesh, 2.0)
        assert np.allclose(place, centre, atol=1e-9)
        assert np.allclose(
            tensor, np.diag(moments), rtol=0.05, atol=0.02
        )  # of polygons of 24 sides
        return
    assert (
        np.linalg.norm(mesh.vertices, axis=1).min() < 1e-12
    )  # it reaches to the pivot, with a tip
    flat = np.delete(mesh.vertices, axis, axis=1)
    assert np.allclose(
        np.ptp(flat, axis=0), 2 * np.linalg.norm(flat, axis=1).max(), rtol=0.02
    )  # round about the axis
    assert (
        np.sign(mesh.vertices[:, axis]).sum() * np.sign(offset) > 0
    )  # on the side of the centre of mass


@pytest.mark.parametrize(
    ("drawn_as", "about"),
    [
        ("ellipsoid", "the ellipsoid of the same mass and inertia"),
        ("cuboid", "the cuboid of the same mass and inertia"),
        ("top", "the cylinder of the same mass and inertia, on a stem"),
        ({"shape": "cone", "radius_m": 0.04, "height_m": 0.06}, "a cone"),
        ({"shape": "ring", "radius_m": 0.04}, "a ring"),
    ],
)
def test_a_scene_chooses_what_a_body_is_drawn_as(drawn_as, about):
    system = build_body(
        Scene.read(ROOT / "systems" / "heavy_top_3.toml", {"output.drawn_as": drawn_as})
    )
    mesh = mesh_of(system)
    assert mesh.about == about
    if about == "a cone":  # on its tip
        assert np.linalg.norm(mesh.vertices, axis=1).min() < 1e-12
        assert np.isclose(mesh.vertices[:, 2].max(), 0.06)
    elif drawn_as in ("ellipsoid", "cuboid"):
        place, tensor = inertia_of_mesh(mesh, 0.15)
        assert np.allclose(place, [0, 0, 0.04])
        assert np.allclose(np.diag(tensor), [0.66e-4, 0.66e-4, 1.2e-4], rtol=0.06)


CYLINDER = {
    "shape": "cylinder",
    "radius_m": 1.0,
    "height_m": 2.0,
    "axis": [1.0, -1.0, 0.5],
    "mass_kg": 1.0,
}
TILTED = [
    {
        "shape": "cuboid",
        "lengths_m": [0.3, 1.0, 2.0],
        "euler_angles_deg": [20.0, 50.0, -30.0],
        "density_kg_m3": 1.0,
    },
    {
        "shape": "cone",
        "radius_m": 0.5,
        "height_m": 1.5,
        "axis": [1.0, 2.0, -2.0],
        "density_kg_m3": 1.0,
        "position_m": [1.0, -1.0, 2.0],
    },
]


@pytest.mark.parametrize("pinned", [False, True])
@pytest.mark.parametrize("solids", [None, TILTED], ids=["handle", "tilted"])
def test_a_body_of_solids_is_drawn_as_its_solids(solids, pinned):
    """For one density, the drawn surface has the centre and the inertia of the body."""
    parts = {} if solids is None else {"body.solids": solids}
    system = build_body(
        Scene.read(ROOT / "systems" / "t_handle.toml", parts | {"body.pinned": pinned})
    )
    mesh = mesh_of(system)
    assert mesh.about == "its solids"
    place, tensor = inertia_of_mesh(mesh, system.mass)
    assert np.allclose(place, system.centre, atol=0.01 * mesh.reach)
    known = system.axes @ np.diag(system.inertia) @ system.axes.T
    known = shifted_inertia(known, -system.mass, system.centre)
    assert np.allclose(tensor, known, atol=0.04 * known.max())
    corners = [
        mesh.vertices[face] for face in mesh.faces
    ]  # short, as those at the back are drawn first
    sides = [
        np.linalg.norm(np.roll(face, -1, axis=0) - face, axis=1).max()
        for face in corners
        if len(face) == 4
    ]
    assert max(sides) < 0.16 * mesh.reach


@pytest.mark.parametrize(
    ("sets", "expected"),
    [
        (["output.drawn_as=tpo"], "did you mean top?"),
        (["output.drawn_as.shape=cone"], "a cone has height_m and radius_m, not none"),
        (
            ["output.drawn_as=top", "body.inertia_kg_m2=[3e-4,3.2e-4,1e-4]"],
            "a top has two equal moments of inertia",
        ),
    ],
)
def test_a_shape_that_a_body_cannot_be_drawn_as(sets, expected, capsys):
    arguments = [word for text in sets for word in ("--set", text)]
    assert cli.main(["check", str(ROOT / "systems" / "heavy_top_3.toml"), *arguments]) == 2
    assert expected in capsys.readouterr().err


@pytest.mark.parametrize(("seconds", "strobes"), [(0.2, True), (2.0, False)])
def test_a_film_in_which_a_body_turns_too_far_between_frames_says_so(
    seconds, strobes, top, tmp_path
):
    _, told = write_film(top, tmp_path / "top.gif", seconds, height=100)
    assert any("times between two frames" in sentence for sentence in told) == strobes


def test_a_point_at_rest_is_drawn(tmp_path):
    scene = {"body": {"mass_kg": 1.0}, "start": {"position_m": [0, 0, 100]}}
    scene["run"] = {"duration_s": 0.1, "timestep_s": 0.01}
    Simulation(Scene.from_dict(scene), tmp_path / "rest").run()
    assert cli.main(["view", str(tmp_path / "rest")]) == 0


def test_a_body_without_a_solid_is_drawn_as_the_cuboid_of_its_inertia():
    lengths = np.array([1.0, 2.0, 3.0])
    inertia = 2.0 / 12 * (lengths @ lengths - lengths**2)
    scene = Scene.from_dict(
        {
            "body": {"mass_kg": 2.0, "inertia_kg_m2": inertia.tolist()},
            "run": {"duration_s": 1.0, "timestep_s": 0.1},
        }
    )
    mesh = mesh_of(build_body(scene))
    assert np.allclose(np.ptp(mesh.vertices, axis=0), lengths)
    assert volume(mesh) == pytest.approx(6.0)
    assert set(UNITS) < set(SOLIDS)


@pytest.fixture(scope="module")
def water_in_memory():
    return Simulation(Scene.read(ROOT / "systems" / "water.toml", SHORT_WATER)).run()


def test_a_universe_knows_bonds_charges_masses_and_velocities(water_in_memory):
    u = water_in_memory.universe()
    assert len(u.bonds) == 2 * 216
    assert u.bonds.values() == pytest.approx(1.0, abs=1e-4)  # SPC/E: 1 Å
    assert u.select_atoms("name OW").charges == pytest.approx(-0.8476)
    assert u.residues[5].atoms.total_charge() == pytest.approx(0.0, abs=1e-12)
    frame = u.trajectory[-1]
    expected = water_in_memory.system.site_velocities(water_in_memory.state)
    assert np.allclose(frame.velocities, expected, rtol=1e-5, atol=1e-4)


def test_rotations_are_output(water_in_memory):
    rotation = water_in_memory.rotation
    u = water_in_memory.universe()
    assert rotation.shape == (len(u.trajectory), 216, 3, 3)
    sites = water_in_memory.system.sites
    arms = np.einsum("nij,nsj->nsi", rotation[2], sites.offset_body.reshape(216, 3, 3))
    u.trajectory[2]
    seen = u.atoms.positions.reshape(216, 3, 3).astype(float)
    assert np.allclose(arms - arms[:, :1], seen - seen[:, :1], atol=1e-4)


def test_the_files_of_a_run_tell_the_same(tmp_path):
    scene = Scene.read(
        ROOT / "systems" / "water.toml", SHORT_WATER | {"output.topology": "topology.pdb"}
    )
    results = Simulation(scene, tmp_path / "run").run()
    u = results.universe()
    assert len(u.bonds) == 2 * 216
    assert u.atoms[0].charge == pytest.approx(-0.8476)
    assert u.atoms[0].mass == pytest.approx(15.9994)
    assert len(MDAnalysis.Universe(tmp_path / "run" / "topology.pdb").bonds) == 2 * 216  # CONECT
    rotation, last = (
        results.rotation,
        results.state.rotation,
    )  # rebuilt from positions rounded to 0.01 Å
    assert rotation.shape == (len(u.trajectory), 216, 3, 3)
    assert np.abs(rotation[-1] - last).max() < 0.02


@pytest.mark.filterwarnings(
    "ignore:1 A.3 CRYST1 record"
)  # a body has no box, and MDAnalysis states so
def test_a_body_has_its_edges_as_bonds(tmp_path):
    more = {"run.duration_s": 0.01, "output.figures": False}
    results = Simulation(
        Scene.read(ROOT / "systems" / "heavy_top_3.toml", more), tmp_path / "run"
    ).run()
    joined = {tuple(pair) for pair in results.universe().bonds.indices.tolist()}
    octahedron = {
        (i, j) for i in range(2, 8) for j in range(i + 1, 8) if j - i != 3
    }  # tips are opposite to the third next
    assert joined == octahedron | {(0, 1)}  # and the pivot to the centre
    assert len(MDAnalysis.Universe(tmp_path / "run" / "topology.pdb").bonds) == 13
    assert results.rotation.shape == (21, 1, 3, 3)
    assert np.array_equal(results.rotation[-1, 0], results["Q"][-1])


@pytest.mark.parametrize(
    ("body", "edges"),
    [
        ({"mass_kg": 1.0, "solid": {"shape": "cuboid", "lengths_m": [1.0, 2.0, 3.0]}}, 12),
        ({"mass_kg": 1.0, "solid": {"shape": "cylinder", "radius_m": 1.0, "height_m": 2.0}}, 36),
        ({"mass_kg": 1.0, "solid": {"shape": "ring", "radius_m": 1.0}}, 24),
        ({"mass_kg": 1.0, "solid": {"shape": "rod", "length_m": 1.0}}, 12),
        ({"solids": [CYLINDER, CYLINDER | {"position_m": [0.0, 5.0, 0.0]}]}, 36 + 1 + 36),
        (
            {
                "solids": [CYLINDER, TILTED[0], TILTED[0] | {"position_m": [9.0, 0.0, 0.0]}],
                "pinned": True,
            },
            1 + 36 + 2 + 24,
        ),
        (
            {
                "points": [
                    {"mass_kg": 1.0, "position_m": [x, x * x, 0.0]} for x in (0.0, 1.0, 2.0, 3.0)
                ]
            },
            3,
        ),
    ],
)
def test_edges_of_solids(body, edges):
    scene = Scene.from_dict({"body": body, "run": {"duration_s": 1.0, "timestep_s": 0.1}})
    assert len(connections(build_body(scene))) == edges


def test_a_gallery_leads_to_films(tmp_path, capsys):
    folder = tmp_path / "gallery"
    assert cli.main(["gallery", "heavy_top_3", "-o", str(folder)]) == 0
    index = (folder / "index.html").read_text("utf-8")
    assert index.count("<img") == 1
    assert 'href="heavy_top_3.html"' in index
    assert is_alone(index)
    assert len(numbers(data_of(folder / "heavy_top_3.html")["time"], "<f8")) == 3401
    assert cli.main(["gallery", "heavy_top_3", "-o", str(folder)]) == 2
    assert "--force replaces it" in capsys.readouterr().err
    assert cli.main(["gallery", "water", "-o", str(tmp_path / "other")]) == 2
    assert "unknown body 'water'" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()
