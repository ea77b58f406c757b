"""Animations: their frames, sizes, formats, periods."""

import shutil
import sys
import types
from itertools import pairwise

import numpy as np
import pytest
from PIL import Image, ImageSequence
from support.common import ROOT
from support.pages import data_of, numbers

from rigidmd.commands import cli
from rigidmd.features.view import animation as film
from rigidmd.features.view import molecule_animation
from rigidmd.features.view.animation import write_film
from rigidmd.run.record import read_record


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
@pytest.mark.usefixtures("reads_here")
def test_an_animation_moves(kind, request, tmp_path, capsys):
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
        # of the upper panels, which are of the whole run, on the left, after their first sample
        red = (beside[1:, ..., 0] > beside[1:, ..., 2] + 0.2)[:, : seen.shape[1] // 3].mean(axis=1)
        places = red[:, : red.shape[1] // 2].argmax(axis=1)  # a red line, which moves to the right
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


def test_an_animation_needs_ffmpeg_for_mp4_only(top, tmp_path, monkeypatch, capsys):
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
def test_an_animation_as_mp4(top, tmp_path):
    path = tmp_path / "top.mp4"
    assert cli.main(["film", str(top), "-o", str(path), "--seconds", "0.2"]) == 0
    assert path.read_bytes()[4:8] == b"ftyp"


def test_an_animation_of_a_periodic_motion_ends_where_it_began(top):
    from rigidmd.features.bodies.animation import BodyAnimation

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


@pytest.mark.usefixtures("reads_here")
def test_an_animation_states_what_it_leaves_out(water, tmp_path, monkeypatch):
    monkeypatch.setattr(molecule_animation, "chemiscope_script", lambda: "")
    monkeypatch.setattr(molecule_animation, "MOST_COORDINATES", 3 * 3 * 648)
    page = tmp_path / "water.html"
    assert cli.main(["view", str(water), "-o", str(page)]) == 0
    assert len(numbers(data_of(page)["time"], "<f8")) == 3
    assert "3 of 5 frames are shown, every 2th" in page.read_text("utf-8")


@pytest.mark.parametrize(("seconds", "strobes"), [(0.2, True), (2.0, False)])
def test_an_animation_in_which_a_body_rotates_too_far_between_frames_is_reported(
    seconds, strobes, top, tmp_path
):
    _, told = write_film(top, tmp_path / "top.gif", seconds, height=100)
    assert any("times between two frames" in sentence for sentence in told) == strobes
