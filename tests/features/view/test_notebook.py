"""In a notebook: progress, what values show, figures of columns, animations, a plot of a run that goes
on, the tutorial."""

import base64
import contextlib
import json
import re
import sys
from html.parser import HTMLParser

import numpy as np
import pytest
from support.common import ROOT, SYSTEMS, small_scene

import rigidmd
from rigidmd.commands.cli import main
from rigidmd.core.shipped import NOTEBOOKS
from rigidmd.core.shipped import examples as examples_in
from rigidmd.errors import RigidMDWarning
from rigidmd.features.analysis.result import AnalysisResult, Curve, Value
from rigidmd.features.view import plots
from rigidmd.features.view.figures.style import save_files
from rigidmd.io import progress
from rigidmd.run import Simulation
from rigidmd.scene import Scene

TOP = ROOT / "systems" / "heavy_top_3.toml"
SHORT = {"run.duration_s": 0.05, "output.figures": False}
FEW = {"output.interval_s": 0.01}
TUTORIAL = ROOT / "systems" / "notebooks" / "tutorial.ipynb"
VOID = {"meta", "input", "br", "img", "path", "use", "rect", "image", "hr"}


def top(**more):
    return Scene.read(TOP, SHORT | more)


def argon(folder=None, **options):
    stages = [
        {"ensemble": "nvt", "duration_ps": 0.02, "temperature_K": 90.0},
        {"duration_ps": 0.02},
    ]
    output = {"log_interval_ps": 0.004, "trajectory_interval_ps": 0.01, "figures": True}
    return Simulation(
        small_scene({"argon": 20}, 20.0, stages=stages, output=output), folder, **options
    )


@pytest.fixture
def cell(monkeypatch):
    """A notebook's cell: the list of its outputs, each the list of what was shown there, as MIME
    bundles."""
    display = pytest.importorskip("IPython.display", reason="IPython is not installed")
    outputs = []

    class Handle:
        def display(self, bundle, raw, metadata=None):
            self.shown = [bundle]
            outputs.append(self.shown)

        def update(self, bundle, raw, metadata=None):
            self.shown.append(bundle)

    monkeypatch.setattr(display, "DisplayHandle", Handle)
    monkeypatch.setattr(progress, "in_notebook", lambda: True)
    monkeypatch.setattr(plots, "in_notebook", lambda: True)
    return outputs


class Balance(HTMLParser):
    """Raises AssertionError where tags are not closed in their order."""

    def __init__(self, text):
        super().__init__()
        self.open = []
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        pass

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag


@contextlib.contextmanager
def compiling_something(announce):
    announce()
    yield


def test_a_notebook_shows_the_bar_in_one_position(cell, capsys, monkeypatch):
    monkeypatch.setattr("rigidmd.run.loop.compiling_announced", compiling_something)
    Simulation(top()).run()
    (shown,) = cell
    assert shown[0]["text/plain"] == "compiling (kept on disk: the next run starts at once) ..."
    assert re.fullmatch(r"0 %: 0 of 0.05 s, 00:00", shown[1]["text/plain"])
    assert re.fullmatch(r"100 %: 0.05 s in [\d.]+(e-\d+)? s", shown[-1]["text/plain"])
    assert '<progress value="1.0000"' in shown[-1]["text/html"]
    for bundle in shown:
        Balance(bundle["text/html"])
    Simulation(top()).run(progress=False)
    assert len(cell) == 1
    said = []
    Simulation(top(), say=said.append).run()  # a compiling announcement, and no bar
    assert len(said) == 1
    assert "compiling" not in cell[1][0]["text/plain"]
    assert capsys.readouterr() == ("", "")


def test_a_bar_that_ends_early_waits_for_nothing(cell):
    with progress.progress_of(100, "iterations", shown=None) as bar:
        bar.update(40)
    assert re.fullmatch(r"40 %: 40 of 100 iterations, 00:00", cell[0][-1]["text/plain"])


def test_elsewhere_progress_is_requested(capsys, monkeypatch):
    monkeypatch.setattr("rigidmd.run.loop.compiling_announced", compiling_something)
    Simulation(top()).run()
    assert capsys.readouterr() == ("", "")
    Simulation(top()).run(progress=True)
    assert (
        capsys.readouterr().err == "  compiling (kept on disk: the next run starts at once) ...\n"
    )


def test_a_live_plot_is_one_picture_that_changes(cell, monkeypatch):
    monkeypatch.setattr(plots, "TIME_FRACTION", 1.0)  # of the time may go into drawing
    plain = Simulation(top(**FEW)).run(progress=False)
    live = rigidmd.LivePlot("theta", "energy_error", pause=0.0)
    watched = Simulation(top(**FEW), observers=live).run(progress=False)
    (shown,) = cell
    assert len(shown) == 6  # of two samples to all, and the last one
    assert all(bundle["image/png"].startswith(b"\x89PNG") for bundle in shown)
    assert shown[0]["image/png"] != shown[-1]["image/png"]
    assert watched.state.rotation.tobytes() == plain.state.rotation.tobytes()
    Simulation(top(), observers=[rigidmd.LivePlot(pause=1e6)]).run(progress=False)
    assert len(cell[1]) == 2  # the first and the last
    argon(observers=rigidmd.LivePlot(pause=1e6)).run(progress=False)
    assert cell[2][-1]["text/plain"] == "temperature, drift against time"
    with pytest.raises(KeyError, match="did you mean theta"):
        Simulation(top(), observers=rigidmd.LivePlot("theto")).run(progress=False)
    with pytest.warns(
        RigidMDWarning, match="LivePlot cannot be drawn: KeyError: .no column 'L_x_error'"
    ):
        Simulation(top(), observers=rigidmd.LivePlot("L_x_error")).run(progress=False)


def test_a_live_plot_has_no_effect_elsewhere():
    results = Simulation(top(), observers=rigidmd.LivePlot()).run()
    assert len(results.samples) == 101


def test_scenes_and_results_show_tables_and_a_figure(tmp_path):
    water = Scene.read(ROOT / "systems" / "water.toml")._repr_html_()
    for part in (
        "216 spce: asymmetric, planar",
        "0.9970 g/cm³",
        "coulomb reciprocal: pme",
        "production: 20000 steps of 1 fs = 20 ps",
    ):
        assert part in water
    body = Scene.read(TOP)._repr_html_()
    for part in (
        "symmetric, pinned, 0.15 kg",
        "0.000306 0.000306 0.00012 kg m²",
        "gravity",
        "kahan_li_8",
    ):
        assert part in body
    simulation = argon(tmp_path / "<b>")
    results = simulation.run()
    shown = {
        "scene": water,
        "body": body,
        "ready": simulation._repr_html_(),
        "results": results._repr_html_(),
    }
    assert "&lt;b&gt;" in shown["ready"]
    assert "&lt;b&gt;" in shown["results"]
    for stage in results.summary["stages"]:
        assert f"{stage['temperature_K']:.2f}" in shown["results"]
    drawn = shown["results"].partition("<svg")[2].partition("</svg>")[0]
    assert "var(--ink)" in drawn
    assert not re.search("#(000000|1f2430|2b6f9e)", drawn)  # its colours are the notebook's
    for text in shown.values():
        Balance(text)
    assert 'class="paper"' in Simulation(top()).run()._repr_html_()  # a lit sphere is on white


def test_analyses_show_values_and_a_figure(tmp_path):
    output = {"trajectory_interval_ps": 0.004}
    results = Simulation(
        small_scene({"argon": 20}, 20.0, stages=[{"duration_ps": 0.2}], output=output)
    ).run()
    g, moved = rigidmd.analysis.rdf(results, "argon", "argon"), rigidmd.analysis.msd(results)
    for result, names in (
        (g, ["r (A)", "g argon-argon"]),
        (moved, ["Time (ps)", "MSD argon (A^2)"]),
    ):
        shown = result._repr_html_()
        Balance(shown)
        assert "<svg" in shown
        assert result.about in shown
        table = result.to_dataframe()
        assert list(table)[:2] == names
        assert (table[names[1]].to_numpy() == result[names[1]]).all()
        assert f"{names[1]} error" in table
        assert len(repr(result.curves)) < 200
        axis, *others = result.plot().axes
        assert [other.get_ylabel() for other in others] == (
            ["neighbours within r (dashed)"] if result is g else []
        )
        assert axis.get_xlabel() == names[0].replace("(A)", "(Å)").replace("Time", "time")
    with pytest.raises(KeyError, match=rf"no curve 'g'; there are {g.curves[0].file}"):
        g.plot("g")
    g.plot().savefig(tmp_path / "g.svg")
    assert (tmp_path / "g.svg").read_text().startswith("<?xml")


def test_an_analysis_of_values_shows_their_notes():
    values = [
        Value("D", "1e-9 m^2/s", 2.5, 0.25, 1.0),
        Value("D inf", "1e-9 m^2/s", None, None, None, "too <short>"),
    ]
    result = AnalysisResult("diffusion", "diffusion", values, notes=["a note"])
    shown = result._repr_html_()
    Balance(shown)
    for part in ("2.50 ± 0.25 1e-9 m^2/s", "too &lt;short&gt;", "a note"):
        assert part in shown
    assert list(result.to_dataframe()["error"])[:1] == [0.25]
    with pytest.raises(ValueError, match="diffusion has no curves"):
        result.plot()


def test_an_analysis_of_several_curves_has_a_panel_for_each():
    axis = ("t", np.arange(3.0))
    curves = [Curve(name, axis, name, {name: np.arange(3.0)}) for name in ("one", "two", "three")]
    result = AnalysisResult("several", "several curves", [], curves)
    assert [panel.get_ylabel() for panel in result.plot().axes if panel.get_visible()] == [
        "one",
        "two",
        "three",
    ]
    assert [panel.get_ylabel() for panel in result.plot("two").axes] == ["two"]
    assert list(result.to_dataframe("three")) == ["t", "three"]


def test_a_sweep_shows_its_progress(cell, tmp_path):
    scene = tmp_path / "top.toml"
    scene.write_text(TOP.read_text())
    points = {"run.duration_s": 0.05, "output.figures": False, "run.timestep_s": [1e-3, 5e-4]}
    rigidmd.sweep(scene, points, tmp_path / "sweep", jobs=1)
    (shown,) = cell
    assert re.fullmatch(r"100 %: 2 points in [\d.]+ s", shown[-1]["text/plain"])
    rigidmd.sweep(scene, points, tmp_path / "sweep")  # nothing is left
    assert len(cell) == 1


def test_every_shipped_scene_shows_itself():
    for path in SYSTEMS:
        text = Scene.read(path)._repr_html_()
        Balance(text)
        assert "\nforces:" in text or "\nbody:" in text, path.stem


def test_a_scene_that_cannot_be_built_shows_why(tmp_path):
    scene = small_scene({"argon": 2}, 20.0, stages=[{"duration_ps": 1.0}])
    (tmp_path / "own.toml").write_text(
        'name = "own"\n[[sites]]\nname = "A"\nposition_A = [0, 0, 0]\n'
    )
    data = scene.model_dump(exclude_none=True) | {"molecules": [{"file": "own.toml", "count": 2}]}
    text = Scene.from_dict(data, tmp_path)._repr_html_()
    assert "<li>" in text
    assert "mass_u is missing" in text


def test_plots_are_of_the_columns_with_their_units():
    results = argon().run()
    figure = rigidmd.view.plot(results, "temperature_translation", "pressure", "temperature")
    kelvin, pressure = figure.axes
    titles = [axis.get_title(loc="left") for axis in figure.axes]
    assert titles == ["temperature translation, temperature", "pressure"]
    assert [axis.get_ylabel() for axis in figure.axes] == ["K", "bar"]
    assert pressure.get_xlabel() == "time (ps)"
    assert [text.get_text() for text in kelvin.get_legend().get_texts()] == [
        "temperature translation",
        "temperature",
    ]
    stages = pressure.lines[:2]  # a curve for each stage
    assert (np.concatenate([line.get_ydata() for line in stages]) == results["pressure"]).all()
    assert (np.concatenate([line.get_xdata() for line in stages]) == results["time"]).all()
    body = Simulation(top()).run()
    (axis,) = rigidmd.view.plot(body, "energy_error", log=True).axes
    assert axis.get_yscale() == "log"
    assert (axis.lines[0].get_ydata() == np.abs(body["energy_error"])).all()
    assert axis.get_xlabel() == "time (s)"
    assert rigidmd.view.plot(body).get_suptitle() == "heavy_top_3: path of the body axis"
    assert rigidmd.view.plot(body, "angles").get_suptitle() == "heavy_top_3: Euler angles (3-1-3)"
    png, size = rigidmd.view.plot(body, "theta")._repr_png_()
    assert png.startswith(b"\x89PNG")
    assert size["width"] == 576


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("temperatur", "did you mean temperature"),
        ("stage_name", "has text"),
        ("qqq", "there are step, time"),
    ],
)
def test_a_column_that_cannot_be_plotted(name, expected):
    with pytest.raises(KeyError, match=expected):
        rigidmd.view.plot(argon().run(), "temperature", name)


def test_the_figure_of_a_run_is_its_file(tmp_path):
    results = argon(tmp_path / "out").run()
    save_files(rigidmd.view.plot(results), tmp_path / "again", ["png"])
    assert (tmp_path / "again.png").read_bytes() == (tmp_path / "out" / "energy.png").read_bytes()


def test_the_animation_of_a_body_is_a_page_in_a_frame(tmp_path):
    results = Simulation(top()).run()
    film = rigidmd.view.show(results)
    assert film.save(tmp_path / "film.html").read_text() == film.page
    for part in ("<canvas", "rigidmdPlayer", 'id="film-data"'):
        assert part in film.page
    shown = film._repr_html_()
    assert shown.startswith("<iframe srcdoc=")
    assert "<canvas" not in shown  # it is quoted
    data = json.loads(re.search(r'id="film-data">(.*?)</script>', film.page)[1])
    assert np.frombuffer(base64.b64decode(data["time"])).size == len(results["time"])


def shifted(simulation):
    """A run that starts with molecules outside the box."""
    state = simulation.state.copy()
    state.position[:] += 15.0
    simulation.start_from(state)
    return simulation


@pytest.mark.usefixtures("reads_here")
def test_the_animation_of_molecules_is_a_page_in_a_frame(tmp_path):
    pytest.importorskip("chemiscope", reason="chemiscope is not installed")
    memory, files = (shifted(argon(folder)).run() for folder in (None, tmp_path / "out"))
    place = []
    for results in (memory, files):
        film = rigidmd.view.show(results)
        assert "data-box=" in film.page  # its plots, with cursors
        data = json.loads(re.search(r'id="film-data">(.*?)</script>', film.page)[1])
        packed = {name: base64.b64decode(data[name]) for name in ("time", "positions")}
        time = np.frombuffer(packed["time"])
        assert time == pytest.approx([0, 0.01, 0.02, 0.03, 0.04], abs=1e-6)
        steps = np.frombuffer(packed["positions"], "<i2").astype(float) + data["steps"]
        place.append(data["low"] + data["scale"] * steps.reshape(5, 20, 3))
        assert 0 <= place[-1].min() < place[-1].max() <= 20  # inside the box
    assert place[0] == pytest.approx(place[1], abs=0.012)  # a .xtc has hundredths of Å


def test_without_chemiscope_one_sentence_reports_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "chemiscope", None)
    with pytest.raises(ImportError, match=r"needs chemiscope: pip install chemiscope"):
        rigidmd.view.show(argon().run())


# the tutorial


def test_the_tutorial_is_listed_copied_and_has_no_outputs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert [example.name for example in examples_in(NOTEBOOKS)] == ["tutorial"]
    assert main(["examples"]) == 0
    listed = capsys.readouterr().out
    assert re.search(r"^notebooks:\n  tutorial +A heavy top", listed, re.MULTILINE)
    assert main(["new", "tutorial"]) == 0
    assert "jupyter lab tutorial.ipynb" in capsys.readouterr().out
    assert (tmp_path / "tutorial.ipynb").read_bytes() == TUTORIAL.read_bytes()
    assert main(["new", "tutorial"]) == 2
    assert "tutorial.ipynb exists; --force replaces it" in capsys.readouterr().err
    for part in json.loads(TUTORIAL.read_text())["cells"]:
        assert part["cell_type"] == "markdown" or (
            part["outputs"] == [] and part["execution_count"] is None
        )


def executed(folder, changed=lambda source: source):
    """The tutorial after it has run in a folder, its code changed. Raises if a cell does."""
    nbformat = pytest.importorskip("nbformat", reason="nbclient is not installed")
    client = pytest.importorskip("nbclient", reason="nbclient is not installed")
    pytest.importorskip("ipykernel", reason="ipykernel is not installed")
    book = nbformat.read(TUTORIAL, as_version=4)
    for part in book.cells:
        part.source = changed(part.source) if part.cell_type == "code" else part.source
    client.NotebookClient(
        book, timeout=600, resources={"metadata": {"path": str(folder)}}
    ).execute()
    return book


def shown_by(book):
    """MIME bundles and texts that the cells show."""
    outputs = [output for part in book.cells if part.cell_type == "code" for output in part.outputs]
    assert [
        output for output in outputs if output.output_type == "stream" and output.name == "stderr"
    ] == []
    return [output.get("data") or {"text/plain": output.text} for output in outputs]


def test_the_tutorial_runs(tmp_path):
    def shorter(source):
        source = re.sub(r"duration_ps = \S+", "duration_ps = 0.08", source).replace(
            "duration_s = 1.7", "duration_s = 0.4"
        )
        return source.replace("start=2.0", "start=0.0")

    shown = shown_by(executed(tmp_path, shorter))
    assert (
        sum("image/png" in bundle for bundle in shown) == 4
    )  # columns, errors of steps, the live plot, g(r)
    assert (
        sum("<svg" in bundle.get("text/html", "") for bundle in shown) == 3
    )  # results, an analysis
    assert sum("<progress" in bundle.get("text/html", "") for bundle in shown) == 3
    hand, run = re.search(
        r"by formula ([\d.]+)°, in the run ([\d.]+)°", "".join(b["text/plain"] for b in shown)
    ).groups()
    assert float(hand) == pytest.approx(float(run), abs=2e-3)


@pytest.mark.soak
def test_the_tutorial_shows_what_it_states(tmp_path):
    shown = shown_by(executed(tmp_path))
    told = "".join(bundle["text/plain"] for bundle in shown)
    peak, error = map(float, re.search(r"first peak: ([\d.]+) ± ([\d.]+) Å", told).groups())
    assert peak == pytest.approx(2.75, abs=0.03 + 3 * error)
