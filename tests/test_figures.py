"""Figures: long curves have no gaps, many curves are given from each other."""

import io
import re
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.text import Text
from support import ROOT, small_scene

from rigidmd.analysis.curve_figure import curve_figure as drawn
from rigidmd.analysis.result import Curve
from rigidmd.assemble.build import build
from rigidmd.core.integrators import SCHEMES
from rigidmd.engines.samples import NUMBERS, Sample, Samples
from rigidmd.figures.picture import Picture
from rigidmd.figures.run import energy_figure
from rigidmd.figures.save import AT_ONCE, save_figure
from rigidmd.figures.style import shown_range
from rigidmd.run.trial_systems import COMPARATORS, body_trial_system
from rigidmd.run.trials import Trial
from rigidmd.scene import Scene
from rigidmd.scene.models import load_model
from rigidmd.studies.accuracy import accuracy
from rigidmd.studies.accuracy.measurement import IntegratorAccuracy
from rigidmd.view.molecule_figure import write_molecule_figure
from rigidmd.view.plots import columns_figure, draw_panel, panels, record_of


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
    written = [
        path.name for path in (ROOT / "rigidmd").rglob("*.py") if ".savefig(" in path.read_text()
    ]
    assert written == ["save.py"]


def test_every_figure_shows_names_as_they_are_written():
    made = [
        path.name
        for path in (ROOT / "rigidmd").rglob("*.py")
        if re.search(r"\bFigure\b", path.read_text())
    ]
    assert made == ["picture.py"]  # see below for its texts


#: Names that users give: Matplotlib reads formulas between dollar signs, and fails at most of
#: these.
NAMES = ["$`$", "$a$ $", r"\frac{$x$", "$$", "$(x) ${v}", r"\$a$", "a_b^c", "%(x)s {} <b>"]


@pytest.mark.parametrize("name", NAMES)
def test_texts_of_a_figure_are_no_formulas(name):
    figure = Picture(figsize=(6, 4), layout="constrained")
    axis, other = figure.subplots(1, 2)
    figure.suptitle(name)
    figure.text(0.1, 0.1, name)
    axis.set(title=name, xlabel=name, ylabel=name, yscale="log")
    axis.plot([1, 1000], [1e-5, 1], label=name)
    axis.legend(title=name)
    axis.annotate(name, (1, 1), (5, 1e-3))
    other.set_title(name, loc="left")
    other.inset_axes((0, 0, 0.5, 0.5)).set_title(name)
    for ending in ("png", "svg"):
        save_figure(figure, io.BytesIO(), format=ending)
    shown = [text for text in figure.findobj(Text) if text.get_text() == name]
    assert len(shown) == 10
    assert not any(text.get_parse_math() for text in shown)
    assert any(
        label.get_parse_math() and "10^" in label.get_text() for label in axis.get_yticklabels()
    )


@pytest.mark.parametrize("name", NAMES)
def test_figures_of_a_run_and_of_a_molecule_take_any_name(name, staged, tmp_path):
    system, samples, summary = staged
    stages = tuple(stage.model_copy(update={"name": name}) for stage in system.scene.stages)
    named = replace(system, scene=system.scene.model_copy(update={"stages": stages}))
    rows = samples.table()
    figures = [energy_figure(named, Samples([name] * len(stages), table=rows), summary)]
    record = record_of(named, samples, summary)
    figures.append(columns_figure(record, ["potential"], samples.described))
    figures.append(
        drawn(
            Curve(
                "curve",
                ("r (Å)", np.arange(3.0)),
                name,
                {name: np.arange(3.0), "other": np.ones(3)},
            )
        )
    )
    for figure in figures:
        save_figure(figure, io.BytesIO(), format="png")
    molecule = load_model("spce")
    own = replace(molecule, name=name, title=name, source=name, site_names=(name,) * 3)
    write_molecule_figure(tmp_path / "own.png", own, force=False)


STAGES = ["minimise", "equilibration", "a short one", "another", "quench", "production at 300 K"]
STEPS = [0, 5, 3, 4, 0, 500]


def samples_of(rng, start=-1000.0):
    """Samples of a run of STAGES; a minimisation starts far above, and its first stage starts far
    from its mean."""
    rows, step = [], 0
    blank = dict.fromkeys(Sample._fields, 0.0) | {"user_energies": ()}
    for k, (name, steps) in enumerate(zip(STAGES, STEPS, strict=True)):
        for n in range(steps or 2):
            step += bool(steps)
            value = (
                -10
                + rng.normal()
                + (start * np.exp(-4 * n) if k == 1 else 1e4 if not steps else 0.0)
            )
            given = {
                "step": step,
                "time": 0.1 * step,
                "stage": k,
                "stage_name": name,
                "potential": value,
            }
            noise = {
                "kinetic": rng.normal(),
                "temperature_translation": 300 + rng.normal(),
                "drift": rng.normal(),
            }
            rows.append(Sample(**blank | given | noise | {"temperature_rotation": float("nan")}))
    return Samples(
        STAGES, table=np.array([[float(getattr(row, name)) for name in NUMBERS] for row in rows])
    )


@pytest.fixture(scope="module")
def staged():
    stages = [
        {"name": name, "duration_ps": 0.1 * steps}
        if steps
        else {"name": name, "ensemble": "minimise"}
        for name, steps in zip(STAGES, STEPS, strict=True)
    ]
    system = build(small_scene({"argon": 4}, None, stages=stages))
    told = {"drift_kJ_mol_ns_per_molecule": 0.1, "drift_error_kJ_mol_ns_per_molecule": 0.1}
    return (
        system,
        samples_of(np.random.default_rng(1)),
        {"stages": [told | {"name": name} for name in STAGES]},
    )


def test_the_figure_of_a_run_has_one_time_axis_and_stages_that_can_be_read(staged):
    figure = energy_figure(*staged)
    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw(renderer)
    assert len({axis.get_xlim() for axis in figure.axes}) == 1
    for axis in figure.axes[1:]:
        named = [text for text in axis.texts if text.get_text()]
        assert [text.get_text() for text in named] == [STAGES[k] for k in (1, 2, 3, 5)]
        boxes = [text.get_window_extent(renderer) for text in named]
        assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))
        assert all(
            axis.get_window_extent(renderer).contains(*corner)
            for box in boxes
            for corner in box.corners()
        )


def test_panels_have_the_range_of_what_is_equilibrated(staged):
    system, samples, summary = staged
    record = record_of(system, samples, summary)
    drawn = {panel.title.split(" (")[0]: panel for panel in panels(record)}
    axis = Figure().subplots()
    draw_panel(axis, record, drawn["potential energy"])
    low, high = axis.get_ylim()
    late = samples["potential"][samples["stage"] == 5] / 4
    assert low < late.min() < late.max() < high
    assert high - low < 4 * np.ptp(late)  # neither minimisations nor the start of the first stage
    (line,) = (line for line in axis.lines if len(line.get_xdata()) > 2)
    assert len(line.get_xdata()) == sum(STEPS)
    figure = columns_figure(record, ["potential"], samples.described)
    assert np.diff(figure.axes[0].get_ylim()) < 4 * 4 * np.ptp(late)


@pytest.mark.parametrize(
    ("values", "stage", "wanted"),
    [
        ([0.0, 1.0, 0.0, 1.0], [0, 0, 0, 0], (-0.05, 1.05)),  # all of it
        ([99.0, 1.0, 0.0, 1.0], [0, 0, 0, 0], (-0.1, 2.1)),  # the start is beyond
        (
            [99.0, 98.0, 99.0, 1.0, 0.0, 1.0, 0.0],
            [0, 0, 0, 1, 1, 1, 1],
            (-4.95, 103.95),
        ),  # a stage of its own
        ([5.0, 5.0, 5.0], [0, 0, 0], None),
        ([np.nan, np.nan], [0, 0], None),
        ([np.nan, 1.0, 0.0], [0, 0, 0], (-0.05, 1.05)),
    ],
)
def test_what_range_is_shown(values, stage, wanted):
    found = shown_range(np.array(values), np.array(stage))
    assert found == (wanted and pytest.approx(wanted))


def test_as_many_integrators_as_there_are_are_told_apart():
    trial_system, _ = body_trial_system(Scene.read(ROOT / "systems" / "heavy_top_3.toml"), 0.1)
    names = [*SCHEMES, *COMPARATORS]
    trials = [
        Trial(name, 1e-3 * k, 10, 10, [1e-3 / k], *[k**4 * 10.0**-n] * 3)
        for n, name in enumerate(names)
        for k in (1, 2, 3)
    ]
    figure = accuracy.accuracy_figure(IntegratorAccuracy(trial_system, trials, 10, 1e-30))
    for axis in figure.axes:
        curves = [line for line in axis.lines if line.get_label() in names]
        assert [line.get_label() for line in curves] == names
        styles = {
            (line.get_color(), line.get_linestyle(), str(line._dash_pattern)) for line in curves
        }
        assert len(styles) == len(names)
    left, right = figure.axes
    for axis, error in ((left, "trajectory_error"), (right, "energy_rms")):
        front = [
            f"{trial.timestep:.2g}"
            for trial in IntegratorAccuracy(trial_system, trials, 10, 1e-30).front(error)
        ]
        steps = [
            text.get_text() for text in axis.texts if text.get_text() != "error of the reference"
        ]
        assert 0 < len(steps) <= len(front)  # of the best alone, and not one on another
        assert set(steps) <= set(front)
        assert axis.get_xlabel() == ""  # one label for both panels
    assert figure.get_supxlabel() == "computing time (s) per s of motion"
