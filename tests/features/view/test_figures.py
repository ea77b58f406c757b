"""Figures: long curves have no gaps, many curves are given from each other."""

import io
import re
from dataclasses import replace
from itertools import combinations, product

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imread
from matplotlib.text import Text
from support.common import ROOT, small_scene

from rigidmd.assemble.build import build
from rigidmd.core.integrators import SCHEMES
from rigidmd.core.quantities import QUANTITIES
from rigidmd.engines.samples import Sample, Samples
from rigidmd.features.analysis.curve_figure import curve_figure as drawn
from rigidmd.features.analysis.result import Curve
from rigidmd.features.bodies.figures import FLOOR, error_panel, timeline
from rigidmd.features.bodies.trials import body_trial_system
from rigidmd.features.studies.accuracy.figure import accuracy_figure
from rigidmd.features.studies.accuracy.measurement import IntegratorAccuracy
from rigidmd.features.view.figures.energy import energy_figure
from rigidmd.features.view.figures.panels import draw_panel
from rigidmd.features.view.figures.picture import Picture
from rigidmd.features.view.figures.space import AT_ONCE, draw_line
from rigidmd.features.view.figures.style import COLORS, DARK_PALETTE, FAINT, PALETTE, shown_range
from rigidmd.features.view.kind_display import panels
from rigidmd.features.view.molecule_figure import write_molecule_figure
from rigidmd.features.view.page import read_asset
from rigidmd.features.view.plots import columns_figure, record_of
from rigidmd.run.trial_systems import COMPARATORS
from rigidmd.run.trials import Trial
from rigidmd.scene import Scene
from rigidmd.scene.models import load_model


def ink(draw):
    """Darkness (0 to 1) of the pixels of a curve."""
    figure = Figure(figsize=(8, 8))
    axis = figure.add_axes((0, 0, 1, 1), xlim=(-1.05, 1.05), ylim=(-1.05, 1.05))
    axis.set_axis_off()
    draw(axis)
    stream = io.BytesIO()
    figure.savefig(stream, dpi=150)
    stream.seek(0)
    return 1 - imread(stream)[:, :, :3].mean(axis=2)


@pytest.mark.parametrize("points", [AT_ONCE - 1, AT_ONCE, AT_ONCE + 1, 2 * AT_ONCE - 1, 13_000])
def test_long_curves_have_no_gaps(points):
    way = np.linspace(0, 1, points)  # a spiral, with sides of a few pixels
    radius, angle = np.sqrt(way), 60 * np.pi * np.sqrt(way)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    style = {"color": "black", "lw": 1.0}
    pieces = ink(lambda axis: draw_line(axis, np.stack([x, y], axis=-1), **style))
    whole = ink(lambda axis: axis.plot(x, y, snap=False, **style))
    assert whole.max() > 0.9
    assert np.abs(pieces - whole).max() < 0.5


def test_no_figure_is_written_past_this():
    written = [
        path.name for path in (ROOT / "rigidmd").rglob("*.py") if ".savefig(" in path.read_text()
    ]
    assert written == ["picture.py"]


def test_every_figure_shows_names_as_they_are_written():
    made = [
        path.name
        for path in (ROOT / "rigidmd").rglob("*.py")
        if re.search(r"import .*\bFigure\b|\bFigure\(", path.read_text("utf-8"))
    ]
    assert made == ["picture.py"]  # see below for its texts


#: Names that users give: Matplotlib reads formulas between dollar signs, and fails at most of
#: these.
PNG = b"\x89PNG"
NAMES = ["$`$", "$a$ $", r"\frac{$x$", "$$", "$(x) ${v}", r"\$a$", "a_b^c", "%(x)s {} <b>"]


@pytest.mark.parametrize("name", NAMES)
def test_texts_of_a_figure_are_not_formulas(name):
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
    figure.data("png", 50)
    shown = [text for text in figure.findobj(Text) if text.get_text() == name]
    assert len(shown) == 10
    assert not any(text.get_parse_math() for text in shown)
    assert any(
        label.get_parse_math() and "10^" in label.get_text() for label in axis.get_yticklabels()
    )


def test_what_is_zero_has_no_logarithmic_axis():
    """Such as the displacement of an atom alone, which is at rest."""
    time, log = np.arange(5.0), (True, True)
    (axis,) = drawn(Curve("msd", ("time (ps)", time), "msd", {"msd": 0 * time}, log=log)).axes
    assert (axis.get_xscale(), axis.get_yscale()) == ("log", "linear")


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
        assert figure.png()[0].startswith(PNG)
    assert any(name in text.get_text() for text in figures[-1].findobj(Text))
    molecule = load_model("spce")
    own = replace(molecule, name=name, title=name, source=name, site_names=(name,) * 3)
    write_molecule_figure(tmp_path / "own.png", own, force=False)
    assert (tmp_path / "own.png").read_bytes().startswith(PNG)


STAGES = ["minimise", "equilibration", "a short one", "another", "quench", "production at 300 K"]
STEPS = [0, 5, 3, 4, 0, 500]


def samples_of(rng, start=-1000.0):
    """Samples of a run of STAGES; a minimisation starts far above, and its first stage starts far
    from its mean."""
    rows, step = [], 0
    blank = dict.fromkeys(QUANTITIES, 0.0)
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
    samples = Samples(STAGES)
    for row in rows:
        samples.append(row)
    return samples


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
    *drifts, energies, temperature = figure.axes
    assert energies.get_xlim() == temperature.get_xlim()
    assert energies.get_position().intervalx == pytest.approx(temperature.get_position().intervalx)
    named = [text for text in energies.texts if text.get_text()]
    assert [text.get_text() for text in named] == [STAGES[k] for k in (1, 2, 3, 5)]
    boxes = [text.get_window_extent(renderer) for text in named]
    assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))
    frame = energies.get_window_extent(renderer)
    assert all(frame.contains(*corner) for box in boxes for corner in box.corners())
    titles = [axis.get_title(loc="left").replace("\n", " ") for axis in drifts]
    assert [title.split(":")[0] for title in titles] == [STAGES[k] for k in (1, 2, 3, 5)]
    notes = [" ".join(text.get_text() for text in axis.texts) for axis in drifts]
    assert all("drift +0.1" in note.replace("\n", " ") for note in notes)
    assert all(axis.get_xlabel() == "time (ps)" for axis in (*drifts, temperature))
    assert temperature.get_ylabel() == "K"


def test_texts_of_energies_are_inside_the_figure_and_do_not_overlap(staged):
    figure = energy_figure(*staged)
    renderer = FigureCanvasAgg(figure).get_renderer()
    figure.draw(renderer)
    words = [text for text in figure.findobj(Text) if any(map(str.isalpha, text.get_text()))]
    boxes = {text.get_text(): text.get_window_extent(renderer) for text in words}
    assert len(boxes) > 10
    for box in boxes.values():
        assert min(box.x0, box.y0) >= 0
        assert box.x1 <= figure.bbox.x1
        assert box.y1 <= figure.bbox.y1
    assert not [pair for pair in combinations(boxes, 2) if boxes[pair[0]].overlaps(boxes[pair[1]])]


def test_each_stage_has_its_drift_on_its_own_scale(staged):
    _, samples, _ = staged
    *drifts, _, _ = energy_figure(*staged).axes
    for axis, k in zip(drifts, (1, 2, 3, 5), strict=True):
        of_stage = samples["drift"][samples["stage"] == k] / 4
        curve, line = axis.lines
        assert curve.get_ydata() == pytest.approx(of_stage)
        low, high = axis.get_ylim()
        assert low < np.nanmin(of_stage)
        assert high > np.nanmax(of_stage)
        assert high - low < 1.5 * np.ptp(of_stage)
        slope = np.polyfit(line.get_xdata(), line.get_ydata(), 1)[0]
        assert slope == pytest.approx(0.1 / 1000)  # kJ/mol/ns as kJ/mol/ps


#: Deuteranopia and protanopia in linear RGB: Machado, Oliveira and Fernandes, IEEE Trans. Vis.
#: Comput. Graph. 15, 1291 (2009), severity 1.
VIEWERS = {
    "all cones": np.eye(3),
    "deuteranopia": np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ]
    ),
    "protanopia": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
}
#: Linear sRGB to CIE XYZ with D65, and the white of D65.
TO_XYZ = np.array(
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ]
)


def lab(color, viewer):
    """CIE L*a*b* of a colour #rrggbb as a viewer sees it."""
    rgb = np.array([int(color[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    seen = (VIEWERS[viewer] @ linear).clip(0, 1)
    x, y, z = TO_XYZ @ seen / (TO_XYZ @ np.ones(3))
    f = [np.cbrt(t) if t > (6 / 29) ** 3 else t / 3 * (29 / 6) ** 2 + 4 / 29 for t in (x, y, z)]
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def test_distances_of_colours_are_those_of_cie():
    # blue and purple of rigidmd 0.2, which the review found at a distance of 2.2 for deuteranopes
    pair = "#2b6f9e", "#7a5ca3"
    distance = {
        viewer: np.linalg.norm(lab(pair[0], viewer) - lab(pair[1], viewer)) for viewer in VIEWERS
    }
    assert distance["all cones"] == pytest.approx(32.5, abs=0.1)
    assert distance["deuteranopia"] == pytest.approx(2.2, abs=0.1)


@pytest.mark.parametrize("viewer", VIEWERS)
@pytest.mark.parametrize("palette", [PALETTE, DARK_PALETTE], ids=["light", "dark"])
def test_colours_of_curves_are_distinguished_by_all(palette, viewer):
    seen = {name: lab(color, viewer) for name, color in palette.items()}
    distances = {
        pair: np.linalg.norm(seen[pair[0]] - seen[pair[1]]) for pair in combinations(seen, 2)
    }
    assert min(distances.values()) > 25, min(distances, key=distances.get)


def test_there_is_one_palette():
    assert list(PALETTE) == list(DARK_PALETTE)
    known = {*PALETTE.values(), *DARK_PALETTE.values(), FAINT}
    for folder in ("rigidmd/features", "tests/benchmarks"):
        for path in (ROOT / folder).rglob("*"):
            if (
                path.suffix in (".py", ".js") and path.name != "molecule_figure.py"
            ):  # of the elements
                found = {*re.findall(r'"(#[0-9a-f]{6})"', path.read_text("utf-8"))} - {"#000000"}
                assert found <= known, path
    styles = [read_asset(name) for name in ("page.css", "notebook.css")]
    for style, (name, color) in product(styles, [*PALETTE.items(), *DARK_PALETTE.items()]):
        assert f"--{name}:{color}" in style
    assert len(COLORS) == 8


def test_panels_have_the_range_of_what_is_equilibrated(staged):
    system, samples, summary = staged
    record = record_of(system, samples, summary)
    drawn = {panel.title: (times, panel) for times, panel in panels(record)}
    axis = Figure().subplots()
    draw_panel(axis, *drawn["potential energy"])
    low, high = axis.get_ylim()
    late = samples["potential"][samples["stage"] == 5] / 4
    assert low < late.min() < late.max() < high
    assert high - low < 4 * np.ptp(late)  # neither minimisations nor the start of the first stage
    lines = [len(line.get_xdata()) for line in axis.lines if len(line.get_xdata()) > 2]
    assert lines == [steps for steps in STEPS if steps]  # one for each stage
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


def test_as_many_integrators_as_there_are_are_distinguished():
    trial_system, _ = body_trial_system(Scene.read(ROOT / "systems" / "heavy_top_3.toml"), 0.1)
    names = [*SCHEMES, *COMPARATORS]
    trials = [
        Trial(name, 1e-3 * k, 10, 10, [1e-3 / k], *[k**4 * 10.0**-n] * 3)
        for n, name in enumerate(names)
        for k in (1, 2, 3)
    ]
    figure = accuracy_figure(IntegratorAccuracy(trial_system, trials, 10, 1e-30), "0.1 s")
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
            f"{trial.timestep:.2g} s"
            for trial in IntegratorAccuracy(trial_system, trials, 10, 1e-30).front(error)
        ]
        steps = [
            text.get_text() for text in axis.texts if text.get_text() != "error of the reference"
        ]
        assert 0 < len(steps) <= len(front)  # of the best alone, and not one on another
        assert set(steps) <= set(front)
        assert axis.get_xlabel() == ""  # one label for both panels
    assert figure.get_supxlabel() == "run time (s) per s of motion"
    assert right.get_ylabel() == "rms energy error / largest kinetic energy"
    figure.draw(renderer := FigureCanvasAgg(figure).get_renderer())
    for axis in figure.axes:
        boxes = [text.get_window_extent(renderer) for text in axis.texts]
        assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))


def test_curves_are_dashed_where_timings_scatter_and_against_evaluations_if_most_do():
    trial_system, _ = body_trial_system(Scene.read(ROOT / "systems" / "heavy_top_3.toml"), 0.1)

    def figure(*spreads: float):
        trials = [
            Trial(
                "velocity_verlet",
                1e-3 / k,
                10 * k,
                10 * k,
                [1.0 * k, k + spread * k],
                *[k**-2.0] * 3,
            )
            for k, spread in enumerate(spreads, 1)
        ]
        measured = IntegratorAccuracy(trial_system, trials, 10, 1e-30)
        return accuracy_figure(measured, "0.1 s")

    drawn = figure(0.0, 0.5, 0.0, 0.0, 0.0)
    solid, dashed = drawn.axes[1].lines[:2]
    assert dashed.get_linestyle() == "--"
    assert np.isfinite(dashed.get_xdata()[:3]).all()  # around the second trial
    assert not np.isfinite(dashed.get_xdata()[3:]).all()
    assert np.isfinite(solid.get_xdata()[-3:]).all()
    assert "run time" in drawn.get_supxlabel()
    unclear = figure(0.5, 0.5, 0.5)
    assert unclear.get_supxlabel() == "force evaluations per s of motion"
    assert unclear.axes[1].lines[0].get_xdata() == pytest.approx([100, 200, 300])


def test_g_of_r_has_the_neighbours_within_a_distance_on_the_right():
    r = np.linspace(0.05, 10, 200)
    g = 1 + 2 * np.exp(-((r - 3) ** 2))
    neighbours = r**3
    columns = {"g O-O": g, "n O-O": neighbours, "g H-H": g / 2, "n H-H": neighbours / 2}
    left, right = drawn(Curve("rdf", ("r (A)", r), "g(r)", columns, level=1.0)).axes
    assert [line.get_label() for line in left.lines if line.get_linestyle() == "-"][1:] == [
        "g O-O",
        "g H-H",
    ]
    for k, name in enumerate(("n O-O", "n H-H")):
        assert (right.lines[k].get_ydata() == columns[name]).all()
        assert right.lines[k].get_color() == left.lines[k + 1].get_color()
    assert 27 < right.get_ylim()[1] < 200  # the first shell can be read


def test_columns_of_a_curve_share_colours_and_powers_are_drawn():
    t = np.arange(1.0, 6.0)
    columns = {f"C{n} axis {k}": t / (k + n) for k in (1, 2) for n in (1, 2)}
    shared = Curve("orientation", ("Time (ps)", t), "C(t)", columns, per_color=2)
    lines = drawn(shared).axes[0].lines
    assert [line.get_color() for line in lines] == [COLORS[0]] * 2 + [COLORS[1]] * 2
    assert [line.get_linestyle() for line in lines] == ["-", "--"] * 2
    assert all(line.get_marker() == "o" for line in lines)  # of few points
    straight = Curve("msd", ("Time (ps)", t), "MSD", {"MSD": t**2}, log=(True, True), power=1.0)
    figure = drawn(straight)
    power = figure.axes[0].lines[-1]
    assert power.get_label() == "slope 1"
    assert power.get_ydata() == pytest.approx(5 * t)
    figure.draw(FigureCanvasAgg(figure).get_renderer())
    assert figure.axes[0].get_xlabel() == "time (ps)"
    assert "1" in [text.get_text() for text in figure.axes[0].get_xticklabels(which="both")]


def test_a_curve_may_start_at_0_and_bands_of_first_values_do_not_set_its_range():
    t = np.arange(1.0, 11.0)
    errors = {"running": 100.0 / t**2}
    curve = Curve("running", ("Time (ps)", t), "mean", {"running": 5 + 0 * t}, errors)
    assert drawn(curve).axes[0].get_ylim()[1] < 10
    assert drawn(replace(curve, from_zero=True)).axes[0].get_ylim()[0] == 0


def test_errors_of_exactly_0_have_a_tick_of_that_name():
    axis = Figure().subplots()
    times = timeline({"time": np.arange(4.0)})
    draw_panel(axis, times, error_panel([("L", np.array([0.0, 1e-15, 1e-14, 0.0]))]))
    ticks = dict(
        zip(axis.get_yticks(), (t.get_text() for t in axis.get_yticklabels()), strict=True)
    )
    assert ticks[FLOOR] == "0"
    assert all(text in ("0", f"{tick:.0e}") for tick, text in ticks.items())
