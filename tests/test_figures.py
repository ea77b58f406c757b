"""Figures: long curves have no gaps, many curves are told apart."""

import io

import numpy as np
import pytest
from conftest import ROOT
from matplotlib.figure import Figure
from matplotlib.image import imread

from rigidmd.core.schemes import SCHEMES
from rigidmd.measure.subjects import COMPARATORS, body_subject
from rigidmd.measure.trials import Precision, Trial
from rigidmd.output import precision_report
from rigidmd.output.figure import AT_ONCE, save_figure
from rigidmd.scene import Scene


def ink(x, y, save):
    """Darkness (0 to 1) of the pixels of a curve."""
    figure = Figure(figsize=(8, 8))
    axis = figure.add_axes((0, 0, 1, 1))
    axis.set_axis_off()
    axis.plot(x, y, color="black", lw=1.0)
    stream = io.BytesIO()
    save(figure, stream)
    stream.seek(0)
    return 1 - imread(stream)[:, :, :3].mean(axis=2)


@pytest.mark.parametrize("points", [AT_ONCE - 1, AT_ONCE, AT_ONCE + 1, 2 * AT_ONCE - 1, 13_000])
def test_long_curves_have_no_gaps(points):
    way = np.linspace(0, 1, points)  # a spiral, with sides of a few pixels
    radius, angle = np.sqrt(way), 60 * np.pi * np.sqrt(way)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    pieces = ink(x, y, lambda figure, stream: save_figure(figure, stream, dpi=150))
    whole = ink(x, y, lambda figure, stream: figure.savefig(stream, dpi=150))
    assert whole.max() > 0.9
    assert np.abs(pieces - whole).max() < 0.5


def test_no_figure_is_written_past_this():
    written = [path.name for path in (ROOT / "rigidmd").rglob("*.py") if ".savefig(" in path.read_text()]
    assert written == ["figure.py"]


def test_as_many_integrators_as_there_are_are_told_apart(monkeypatch, tmp_path):
    subject, _ = body_subject(Scene.read(ROOT / "systems" / "heavy_top_3.toml"), 0.1)
    names = [*SCHEMES, *COMPARATORS]
    trials = [
        Trial(name, 1e-3 * k, 10, 10, [1e-3 / k], *[k**4 * 10.0**-n] * 3)
        for n, name in enumerate(names)
        for k in (1, 2, 3)
    ]
    figures = []
    monkeypatch.setattr(precision_report, "save_figure", lambda figure, *_, **__: figures.append(figure))
    precision_report.draw(tmp_path / "precision.png", Precision(subject, trials, 10, 1e-30))
    for axis in figures[0].axes:
        curves = [line for line in axis.lines if line.get_label() in names]
        assert [line.get_label() for line in curves] == names
        styles = {(line.get_color(), line.get_linestyle(), str(line._dash_pattern)) for line in curves}
        assert len(styles) == len(names)
