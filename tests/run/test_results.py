"""From Python: units of results, data frames, what notebooks and editors show."""

import contextlib
import copy
import csv
import json
import pickle
import re
import subprocess
import sys
from math import nan
from pathlib import Path

import numpy as np
import pytest
from support.common import BODIES, ROOT, small_scene
from support.stops import contents

import rigidmd
from rigidmd.core.quantities import QUANTITIES
from rigidmd.engines.observables import Observation
from rigidmd.errors import OutputError, SceneError, StructureError
from rigidmd.features.bodies.motion import COLUMNS as BODY_COLUMNS
from rigidmd.features.bodies.motion import FAMILIES
from rigidmd.run import Every, Simulation
from rigidmd.scene import Scene
from rigidmd.scene.models import load_model
from rigidmd.units import KJ_PER_MOL

TOP = ROOT / "systems" / "heavy_top_3.toml"
SHORT = {"run.duration_s": 0.05, "output.figures": False}


def argon(folder=None, **options):
    stages = [
        {"ensemble": "nvt", "duration_ps": 0.02, "temperature_K": 90.0},
        {"duration_ps": 0.02},
    ]
    scene = small_scene({"argon": 20}, 20.0, stages=stages, output={"log_interval_ps": 0.01})
    return Simulation(scene, folder, **options)


def test_results_are_what_the_log_states(tmp_path):
    results = argon(tmp_path / "out").run()
    with (tmp_path / "out" / "log.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 5
    for name, column in QUANTITIES.items():
        assert results.units[name] == column.unit
        if not column.header or column.of_tensor:
            continue
        for row, value in zip(rows, results[name], strict=True):
            told = row[column.header]
            assert (
                told == value
                if column.unit == ""
                else float(told or "nan") == pytest.approx(value, abs=0, nan_ok=True)
            )
    potential = rows[0]["Potential Energy (kJ/mol)"]
    assert -100 < float(potential) < 100  # 20 atoms of a gas, in kJ/mol
    assert results["potential"][0] == float(potential)
    own = results["stage"] == 1
    assert np.diff(results["conserved"][own]) == pytest.approx(
        np.diff(results["drift"][own]), abs=1e-9
    )
    freedom, boltzmann = 3 * 20 - 3, 0.00831446261815324  # kJ/mol/K
    assert results["kinetic"] == pytest.approx(0.5 * freedom * boltzmann * results["temperature"])


def test_the_record_and_its_table_name_the_same_units():
    said = {
        "kJ/mol": "(kJ/mol)",
        "kJ/mol/ps²": "(kJ/mol/ps^2)",
        "K": "(K)",
        "bar": "(bar)",
        "ps": "(ps)",
        "nm³": "(nm^3)",
        "g/cm³": "(g/cm^3)",
        "u Å/ps": "(u A/ps)",
        "Å": "(A)",
        "°": "(deg)",
    }
    for column in QUANTITIES.values():
        if column.header:
            assert column.header.endswith(said.get(column.unit, column.header))
            assert "(" not in column.header or column.unit in said
        assert column.about


def test_observers_see_the_units_of_the_log():
    seen = []

    def look(moment):  # a state is in u, Å, ps
        kinetic = 0.5 * 39.948 * (moment.state.velocity**2).sum() / KJ_PER_MOL
        seen.append((moment.observation, kinetic))

    simulation = argon(observers=Every(0.01, look))
    results = simulation.run()
    for k, (reading, kinetic) in enumerate(seen):
        for name in ("potential", "kinetic", "energy", "temperature", "pressure"):
            assert getattr(reading, name) == results[name][k]
        assert sum(reading.components.values()) == pytest.approx(reading.potential)
        assert reading.kinetic_translation == pytest.approx(kinetic, rel=1e-12)
        for name in QUANTITIES:
            assert getattr(reading.sample, name) == pytest.approx(results[name][k], nan_ok=True)
        assert reading.momentum.shape == (3,)
        assert reading.sample.momentum == pytest.approx(np.linalg.norm(reading.momentum))
        for i, j in ((0, 1), (0, 2), (1, 2)):
            shear = getattr(reading.sample, f"pressure_{'xyz'[i]}{'xyz'[j]}")
            assert shear == reading.pressure_tensor[i, j]
    # forces are the slopes of the energy that is given
    system, engine, state = simulation.system, simulation.engine, simulation.state.copy()
    energy = []
    for shift in (1e-4, -1e-4):
        state.position[0, 0] += shift
        energy.append(
            sum(tally.energy for tally in engine.evaluate(state)[1].values()) / KJ_PER_MOL
        )
        state.position[0, 0] -= shift
    assert isinstance(seen[-1][0], Observation)
    assert seen[-1][0].force.shape == (len(system.model.species), 3)
    assert seen[-1][0].force[0, 0] == pytest.approx(
        -(energy[0] - energy[1]) / 2e-4, rel=1e-5, abs=1e-9
    )


def test_a_body_has_matrices_and_si_units():
    results = Simulation(Scene.read(TOP, SHORT)).run()
    q = results["Q"]
    assert q.shape == (len(results["time"]), 3, 3)
    assert q[7, 0, 2] == results["q13"][7]
    assert q[7, 2, 0] == results["q31"][7]
    assert results.units["Q"] == "1"
    assert results.units["omega_body_1"] == "rad/s"
    assert results["kinetic"] + results["potential"] == pytest.approx(results["energy"])
    with pytest.raises(
        KeyError, match=r"no column 'energ'; did you mean energy\? There are time, x.*, Q"
    ):
        results["energ"]
    stone = Simulation(Scene.read(ROOT / "systems" / "dropped_stone.toml")).run()
    with pytest.raises(KeyError, match="no column 'Q'"):
        stone["Q"]


def test_every_column_of_every_body_is_in_the_table():
    found = set()
    for path in BODIES:
        scene = Scene.read(path)
        results = Simulation(
            Scene.read(
                path,
                {
                    f"{key}_s": n * scene.run.timestep_s
                    for key, n in (("run.duration", 10), ("output.interval", 1))
                },
            )
        ).run()
        assert set(results.units) == set(results.samples.columns) | (
            {"Q"} if "q11" in results.units else set()
        )
        found |= set(results.units)
    assert found - {"Q"} <= set(BODY_COLUMNS)
    assert {
        family for family, members in FAMILIES.items() if not found & set(members.names)
    } == set()


def test_a_data_frame_has_the_headers_of_the_log(tmp_path):
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    results = argon(tmp_path / "a").run()
    frame, log = results.to_dataframe(), pandas.read_csv(tmp_path / "a" / "log.csv")
    assert list(frame.columns) == list(log.columns)
    for header in log.columns:
        if log[header].dtype.kind == "f":
            np.testing.assert_allclose(frame[header].to_numpy(float), log[header], rtol=1e-15)
        else:
            assert list(frame[header]) == list(log[header])
    results = Simulation(Scene.read(TOP, SHORT), tmp_path / "b").run()
    frame = results.to_dataframe()
    assert list(frame.columns) == (tmp_path / "b" / "motion.csv").read_text().splitlines()[0].split(
        ","
    )
    assert (frame["theta (rad)"] == results["theta"]).all()


def test_without_pandas_one_sentence_reports_it(monkeypatch):
    results = Simulation(Scene.read(TOP, SHORT)).run()
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match=r"^to_dataframe\(\) needs pandas: pip install pandas$"):
        results.to_dataframe()


@pytest.mark.parametrize("time", [float("nan"), float("inf"), -1.0])
def test_times_from_python_are_finite(time):
    scene = Scene.read(TOP, SHORT)
    with pytest.raises(
        ValueError, match=r"walltime is .*, must be a finite number of seconds, not negative"
    ):
        Simulation(scene, walltime=time)
    with pytest.raises(
        ValueError, match=r"the interval of Every is .*, must be a finite time above 0"
    ):
        Every(time, print)

    class Seldom(rigidmd.Observer):
        interval = time

    with pytest.raises(
        ValueError, match=r"the interval of Seldom is .*, must be a finite time above 0"
    ):
        Simulation(scene, observers=Seldom()).run()
    with pytest.raises(TypeError, match="3 is not a Simulation"):
        rigidmd.run_together([3])  # pyright: ignore[reportArgumentType]


def test_values_show_what_they_are(tmp_path):
    water = Scene.read(ROOT / "systems" / "water.toml")
    assert (
        repr(water)
        == "<MolecularScene water: 216 spce; minimisation, equilibration 10 ps, production 20 ps>"
    )
    assert "216 spce of structures/water216.gro" in repr(
        Scene.read(ROOT / "systems" / "water_from_structure.toml")
    )
    scene = Scene.read(TOP, SHORT)
    assert (
        repr(scene)
        == "<BodyScene heavy_top_3: one body, pinned; 0.05 s in 100 steps of 0.0005 s, kahan_li_8>"
    )
    simulation = Simulation(scene)
    assert repr(simulation).startswith("<Simulation heavy_top_3: one body (symmetric, pinned)")
    assert "results stay in memory" in repr(simulation)
    results = simulation.run()
    assert repr(results).startswith("<Results of heavy_top_3: 101 samples, no files;")
    folder = tmp_path / "out"
    written = Simulation(scene, folder)
    assert f"writes to {folder}" in repr(written)
    assert f"5 files in {folder}" in repr(written.run())
    states = [
        simulation.system,
        simulation.state,
        results.samples,
        results.system,
        load_model("tip4p2005"),
    ]
    seen = Simulation(scene, observers=Every(0.01, lambda moment: states.append(moment)))
    seen.run()
    assert type(states[-1]).__name__ in repr(states[-1])
    for value in (water, scene, simulation, results, *states):
        assert len(str(value)) < 700
        assert "\n" not in str(value)
    for value in (water, scene, simulation, results):
        assert len(repr(value)) < 250
        assert "\n" not in repr(value)
        assert scene.name in value._repr_html_() or value is water
    shown = results._repr_html_()
    assert "<code>q11</code>" in shown and "<code>q12</code>" in shown
    assert "<td>rad/s</td>" in shown
    shown = argon().run()._repr_html_()
    assert "<td><code>potential</code></td><td>kJ/mol</td>" in shown
    assert "<td><code>stage</code></td>" in shown


SCRIPT = """import rigidmd

scene = rigidmd.Scene.read("systems/water.toml", {"stages.equilibration.duration_ps": 1.0})
watch = rigidmd.Every(1.0, lambda moment: print(moment.time, moment.observation.temperature))
simulation = rigidmd.Simulation(scene, "runs/water", observers=[watch, rigidmd.LivePlot("drift")])
results = simulation.run(progress=True)
print(rigidmd.__version__, results["energy"].mean(), results.units["energy"], results.summary["stages"])
print(results.universe().trajectory, results.to_dataframe(), results.state.position.shape, results.files[0].name)
if isinstance(scene, rigidmd.BodyScene):
    rigidmd.Simulation(scene, applied={"wind": lambda pose: ([0, 0, pose.time], [0, 0, 0])}).run()
"""
HOVER = {
    "scene": "MolecularScene | BodyScene",
    "simulation": "Simulation",
    "simulation.state": "State",
    'rigidmd.Simulation("water.toml").system': "AnySystem",
    'rigidmd.Simulation("water.toml").scene': "MolecularScene | BodyScene",
    "results": "Results",
    'results["energy"]': "ndarray[",
    "results.universe()": "Universe",
    "results.state": "State",
    "rigidmd.view.plot(results)": "Picture",
    "rigidmd.view.show(results)": "AnimationPage",
    "results.atoms()": "Atoms",
    "results.atoms(slice(3))": "list[Atoms]",
    'rigidmd.scene_from_atoms(results.atoms(), ["spce"], seed=3)': "MolecularScene",
}


def pyright(project):
    """What pyright states of the project in a folder: its report as a dictionary."""
    command = [
        sys.executable,
        "-m",
        "pyright",
        "--outputjson",
        "--pythonpath",
        sys.executable,
        "-p",
        str(project),
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    try:
        found = json.loads(done.stdout)
        assert "generalDiagnostics" in found
    except (ValueError, AssertionError):
        pytest.skip(
            f"pyright cannot run here (pip install 'pyright[nodejs]'): {done.stderr.strip()[-200:]}"
        )
    return found


def findings_in_script(folder, text):
    """What pyright states of a script, the tutorial and the chapter about it: (severity, line,
    message) of each finding."""
    cells = json.loads((ROOT / "systems" / "notebooks" / "tutorial.ipynb").read_text())["cells"]
    chapter = (ROOT / "rigidmd" / "docs" / "tutorials" / "notebook.md").read_text()
    files = {
        "script.py": text,
        "tutorial.py": "\n".join(
            "".join(part["source"]) for part in cells if part["cell_type"] == "code"
        ),
        "chapter.py": "".join(re.findall(r"```python\n(.*?)```", chapter, re.DOTALL)),
    }
    for name, source in files.items():
        (folder / name).write_text(source)
    shown = {"reportUnusedExpression": "none"}  # the last line of a cell
    (folder / "pyrightconfig.json").write_text(
        json.dumps({"include": list(files), "extraPaths": [str(ROOT)]} | shown)
    )
    found = pyright(folder)["generalDiagnostics"]
    return [
        (entry["severity"], entry["range"]["start"]["line"], entry["message"]) for entry in found
    ]


def test_an_editor_knows_the_types(tmp_path):
    hover = "".join(f"reveal_type({expression})\n" for expression in HOVER)
    wrong = "results.temperature\nrigidmd.Simulation(scene, obervers=[watch])\n"
    found = findings_in_script(tmp_path, SCRIPT + hover + wrong)
    lines = SCRIPT.count("\n")
    at_wrong = lines + len(HOVER)
    assert {at for severity, at, _ in found if severity != "information"} == {
        at_wrong,
        at_wrong + 1,
    }
    for line, (expression, kind) in enumerate(HOVER.items(), start=lines):
        (message,) = [message for _, at, message in found if at == line]
        told = message.removeprefix(f'Type of "{expression}" is "').removesuffix('"')
        assert told.startswith(kind) or set(told.split(" | ")) == set(kind.split(" | ")), message


@pytest.mark.parametrize(
    ("key", "numpy", "plain"),
    [
        ("seed", np.int64(3), 3),
        ("threads", np.uint8(2), 2),
        ("molecules.0.count", np.int32(7), 7),
        ("molecules.0.frozen", np.bool_(False), False),
        ("molecules.0.frozen", np.arange(1, 4), [1, 2, 3]),
        ("molecules.0.name", np.str_("water"), "water"),
        ("box.lengths_A", np.array([20, 21, 22]), [20, 21, 22]),
        ("box.lengths_A", np.array(20.0), 20.0),
        ("box.lengths_A", (np.float32(20), np.int8(21), 22.5), [20.0, 21, 22.5]),
        ("start.temperature_K", np.float32(300), 300.0),
        ("forces.ewald_accuracy", np.float64(1e-5), 1e-5),
        ("stages.0.duration_ps", np.int16(2), 2),
        ("output.pressure_tensor", np.True_, True),
        ("output.trajectory", Path("a.trr"), "a.trr"),
        ("molecules.0.masses_u", {np.str_("H"): np.float32(2)}, {"H": 2.0}),
    ],
)
def test_values_of_numpy_and_paths_in_a_scene(key, numpy, plain):
    """In dictionaries, at any depth, and as what replaces their values."""
    data = {
        "box": {"lengths_A": 20.0},
        "molecules": [{"model": "spce", "count": 5}],
        "start": {"temperature_K": 300.0},
        "forces": {"electrostatics": "ewald"},
        "stages": [{"duration_ps": 1.0}],
    }

    def scene(value):
        changed = json.loads(json.dumps(data))
        *tables, last = key.split(".")
        target = changed
        for part in tables:
            target = target[int(part)] if isinstance(target, list) else target.setdefault(part, {})
        target[last] = value
        return Scene.from_dict(changed)

    assert scene(numpy) == scene(plain) == Scene.from_dict(data, overrides={key: numpy})
    assert data == json.loads(json.dumps(data))
    assert data["box"] == {"lengths_A": 20.0}  # an override leaves the dictionary as it was


def test_paths_and_numbers_of_types_in_a_scene(tmp_path):
    (tmp_path / "a.data").write_text("x")
    data = {
        "structure": {"file": Path("a.data"), "atom_types": {1: "O", np.int64(2): "H"}},
        "molecules": [{"model": "spce"}],
        "stages": [{"ensemble": "minimise"}],
    }
    scene = Scene.from_dict(data, tmp_path)
    assert scene.structure.file == "a.data"
    assert scene.structure.atom_types == {"1": "O", "2": "H"}
    deep: list = []
    deep.append(deep)
    with pytest.raises(SceneError, match="more than 32 deep"):
        Scene.from_dict(data | {"seed": deep}, tmp_path)


def test_the_package_states_that_it_has_types():
    assert (ROOT / "rigidmd" / "py.typed").is_file()
    assert all(hasattr(rigidmd, name) for name in rigidmd.__all__)


# steps


def heavy_top(folder=None, **options):
    scene = Scene.read(
        TOP, SHORT | {"run.integrator": "velocity_verlet", "output.trajectory": False}
    )
    return Simulation(scene, folder, **options)


@pytest.mark.parametrize("make", [argon, heavy_top])
def test_steps_are_the_steps_of_a_run(make, tmp_path):
    """Over the end of a stage and past the end of the scene, mixed with `run`; files and bits are
    those of `run`."""
    seen, whole = [], make(tmp_path / "whole", observers=Every(0.002, lambda moment: None)).run()
    count = int(whole.state.step[0])
    simulation = make(
        tmp_path / "steps", observers=Every(0.002, lambda moment: seen.append(moment.step))
    )
    assert simulation.step() == 1 and simulation.state.step[0] == 1
    assert seen[0] == 0 and seen[-1] <= 1
    with pytest.raises(RuntimeError, match="the run has begun"):
        simulation._before_run().take_threads(1)
    with pytest.raises(OutputError, match="another run is writing"):
        make(tmp_path / "steps", force=True).run()
    assert simulation.step(7) == 7
    assert not (tmp_path / "steps" / "summary.json").exists()
    for left in (count // 2, count):
        assert simulation.step(left) == min(left, count - 8 - (0 if left < count else count // 2))
    assert simulation.step(3) == 0
    results = simulation.run()
    assert not results.interrupted and results.state.step[0] == count
    assert all(np.array_equal(a, b) for a, b in zip(results.state, whole.state, strict=True))
    assert contents(tmp_path / "steps") == contents(tmp_path / "whole")
    again = make(observers=Every(0.002, seen.append))
    again.step(5)
    assert np.array_equal(again.run().state.velocity, whole.state.velocity)
    with pytest.raises(ValueError, match="the number of steps is 0: at least 1"):
        again.step(0)
    for count in (1.5, nan, True, "1"):
        with pytest.raises(TypeError, match=r"the number of steps is .*, must be an integer"):
            again.step(count)
    assert again.step(np.int64(1)) == 1


@pytest.mark.parametrize("make", [argon, heavy_top])
@pytest.mark.parametrize("how", ["close", "with", "error", "stop"])
def test_a_run_that_is_closed_between_steps_has_all_files_and_resumes(make, how, tmp_path):
    whole, looks = tmp_path / "whole", Every(0.002, lambda moment: None)
    make(whole, observers=looks).run()
    folder = tmp_path / "steps"
    if how in ("close", "stop"):
        simulation = make(folder, observers=looks)
        simulation.step(9)
        if how == "stop":
            simulation.stop()
            assert simulation.step(5) == 0 and simulation.run().interrupted
        simulation.close()
        simulation.close()
    else:
        with contextlib.suppress(KeyError), make(folder, observers=looks) as simulation:
            simulation.step(9)
            if how == "error":
                raise KeyError
    assert json.loads((folder / "summary.json").read_text())["interrupted"]
    assert {path.name for path in folder.iterdir()} == {path.name for path in whole.iterdir()}
    with make(folder, observers=looks, resume=True) as simulation:
        simulation.step(2)
        assert simulation.state.step[0] == 11
        assert not simulation.run().interrupted
    assert contents(folder) == contents(whole)
    with make(tmp_path / "to the end") as simulation:
        simulation.step(10**6)
    assert not json.loads((tmp_path / "to the end" / "summary.json").read_text())["interrupted"]


@pytest.mark.parametrize("ends", ["exit", "deleted", "signal"])
def test_a_run_that_nobody_closes_lets_its_folder_go(ends, tmp_path):
    program = f"""
import gc, os, signal, sys
import rigidmd
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in a process that a shell starts in the background
scene = rigidmd.Scene.read({str(TOP)!r}, {SHORT | {"output.trajectory": False}!r})
simulation = rigidmd.Simulation(scene, "run", observers=[rigidmd.Every(0.001, lambda moment: moment.step == 16 and
    {ends!r} == "signal" and os.kill(os.getpid(), signal.SIGINT))])
simulation.step(9)
if {ends!r} == "deleted":
    del simulation
    gc.collect()
    rigidmd.Simulation(scene, "run", resume=True).run()
elif {ends!r} == "signal":
    try:
        simulation.step(50)
    except KeyboardInterrupt:
        sys.exit(simulation.state.step[0] >= 16 and os.path.exists("run/summary.json"))
"""
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (int(ends == "signal"), "")
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["interrupted"] == (
        ends != "deleted"
    )
    heavy_top_scene = Scene.read(tmp_path / "run" / "scene.toml")
    assert not Simulation(heavy_top_scene, tmp_path / "run", resume=True).run().interrupted


class Plain:
    """An observer without a base class."""

    interval = 0.01

    def __init__(self):
        self.times = []

    def observe(self, moment):
        self.times.append(moment.time)


class PlainWithFile(Plain):
    def files(self):
        return ["times.txt"]

    def end(self, run, results):
        run.path("times.txt").write_text(str(len(self.times)))
        results.files.append(run.path("times.txt"))


def test_an_observer_is_any_object_with_an_interval_and_see(tmp_path):
    one, two = Plain(), PlainWithFile()
    results = argon(tmp_path / "out", observers=[one, two]).run()
    assert one.times == two.times == pytest.approx([0, 0.01, 0.02, 0.03, 0.04])
    assert (
        tmp_path / "out" / "times.txt"
    ).read_text() == "5" and tmp_path / "out" / "times.txt" in results.files
    argon(observers=one).run()
    assert len(one.times) == 10
    for wrong in (3, print, object(), [one, "observe"]):
        with pytest.raises(TypeError, match="is not an observer"):
            argon(observers=wrong)


def test_a_simulation_takes_what_its_kind_of_scene_has():
    assert type(argon()) is type(heavy_top()) is rigidmd.Simulation
    with pytest.raises(SceneError, match="applied: for a single body"):
        argon(applied={"push": lambda pose: ((0, 0, 0), (0, 0, 0))})
    with pytest.raises(SceneError, match="forces and thermostat: for molecules"):
        heavy_top(forces=[], thermostat=3)
    for method in ("_start", "_settle", "atoms"):
        with pytest.raises(TypeError, match=r"is a single body. This method is for molecules"):
            getattr(heavy_top(), method)()


@pytest.mark.parametrize("make", [argon, heavy_top])
def test_a_run_again_in_its_folder_continues_after_an_interrupt_and_repeats_after_its_end(
    make, tmp_path
):
    whole = make(tmp_path / "whole").run()
    calls = []

    def interrupt(moment):
        calls.append(moment.step)
        if len(calls) == 2:
            raise KeyboardInterrupt

    interval = 0.01 if make is argon else 0.02
    simulation = make(tmp_path / "run", observers=Every(interval, interrupt))
    with pytest.raises(KeyboardInterrupt):
        simulation.run()
    begun = contents(tmp_path / "run")
    results = simulation.run()
    for found, expected in zip(results.state, whole.state, strict=True):
        assert np.array_equal(found, expected)
    assert begun.keys() <= contents(tmp_path / "run").keys()
    again = simulation.run()
    assert np.array_equal(again.state.rotation, whole.state.rotation)
    assert calls.count(0) >= 2
    other = make(tmp_path / "run")  # the files are now those of another run
    with pytest.raises(
        OutputError, match="resume=True continues it, force=True replaces it"
    ) as refused:
        other.run()
    assert "--" not in str(refused.value) and " -o" not in str(refused.value)


def test_the_state_is_read_only_and_observables_follow_it():
    simulation, quiet = argon(), argon()
    for count in (3, 2):
        simulation.step(count)
        quiet.step(count)
        reading, forces = simulation.observation, simulation.forces
        assert simulation.energy == pytest.approx(reading.potential + reading.kinetic)
        energies = []
        for shift in (1e-4, -1e-4):
            moved, other = simulation.state.copy(), argon()
            moved.position[1, 2] += shift
            other.start_from(moved)
            energies.append(other.observation.potential)
        assert forces[1, 2] == pytest.approx(
            -(energies[0] - energies[1]) / 2e-4, rel=1e-5, abs=1e-9
        )
    for array in simulation.state:
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0
    for found, expected in zip(simulation.run().state, quiet.run().state, strict=True):
        assert np.array_equal(found, expected)  # observables leave no trace


def test_observables_of_a_body():
    with heavy_top() as simulation:
        start = simulation.energy
        simulation.step(20)
        assert simulation.energy == pytest.approx(start, rel=1e-6)
        assert simulation.observation.time == simulation.state.time[0] > 0
        assert simulation.forces.shape == (0, 3)  # it is pinned


def test_a_simulation_begins_only_from_states_that_it_can_have():
    water = small_scene({"spce": 4}, 20.0)
    simulation = Simulation(water)
    state = simulation.state.copy()
    simulation.start_from(state)
    wrong = {
        "rotation": [
            -state.rotation,
            2 * state.rotation,
            state.rotation[:2],
            state.rotation * np.nan,
        ],
        "position": [
            state.position[:3],
            np.vstack([state.position] * 2),
            state.position + np.inf,
            np.ma.masked_equal(state.position, state.position[0, 0]),
            None,
        ],
        "velocity": [state.velocity * 1j, state.velocity[:, :2]],
        "angular_momentum_body": [state.angular_momentum_body[0]],
        "cell": [
            -state.cell,
            state.cell.T + np.triu(np.ones((3, 3)), 1),
            np.diag([np.inf] * 3),
            state.cell / 2,
        ],
    }
    for name, values in wrong.items():
        for value in values:
            with pytest.raises(StructureError, match="start_from: ") as refused:
                simulation.start_from(state._replace(**{name: value}))
            assert name in str(refused.value) or name == "cell"
    with pytest.raises(TypeError, match="needs a State"):
        simulation.start_from(state.position)
    assert np.array_equal(simulation.state.position, state.position)


def test_a_simulation_cannot_be_pickled_or_copied():
    simulation = argon()
    for attempt in (pickle.dumps, copy.copy, copy.deepcopy):
        with pytest.raises(TypeError, match="a Simulation has compiled code"):
            attempt(simulation)
    assert np.array_equal(
        pickle.loads(pickle.dumps(simulation.state)).position, simulation.state.position
    )


def test_messages_name_arguments_of_python_not_options(tmp_path):
    """For overrides, sweeps and code that is not trusted."""
    path = tmp_path / "argon.toml"
    path.write_text((ROOT / "systems" / "argon.toml").read_text())
    (tmp_path / "spring.py").write_text("x = 3\n")
    entry = {"module": "spring.py", "name": "x"}
    first = "stages.0.temperature_K"
    for expected, call in {
        "overrides stages.0.timestep_fs: is -1": lambda: Scene.read(
            path, {"stages.0.timestep_fs": -1}
        ),
        "overrides stages.7.x: stages has entries 0 to": lambda: Scene.read(
            path, {"stages.7.x": 1}
        ),
        "overrides={'box.volume': None}: box has no volume": lambda: Scene.read(
            path, {"box.volume": None}
        ),
        f"sets={{'{first}': [280, 290]}} or sets={{'seed': range(1, 9)}}": lambda: rigidmd.sweep(
            path, {"seed": 1}
        ),
        "call rigidmd.trust_file(": lambda: rigidmd.with_defaults(
            Scene.read(path, {"forces.custom": [entry]})
        ),
        "names by module: it names none": lambda: rigidmd.sweep(
            path, {"seed": [1, 2]}, trust=[tmp_path / "spring.py"]
        ),
        "there is no such file": lambda: rigidmd.trust_file(tmp_path / "other.py"),
    }.items():
        with pytest.raises(SceneError) as caught:
            call()
        assert expected in str(caught.value)
        assert "--" not in str(caught.value)


def test_a_simulation_takes_the_path_of_a_scene():
    simulation = Simulation(ROOT / "systems" / "heavy_top_3.toml")
    assert simulation.scene.name == "heavy_top_3"
    assert Simulation(str(ROOT / "systems" / "heavy_top_3.toml")).scene == simulation.scene
    with pytest.raises(TypeError, match=r"rigidmd\.Scene\.from_dict for a dictionary"):
        Simulation({"body": {}})  # pyright: ignore[reportArgumentType, reportCallIssue]


@pytest.mark.parametrize("count", [10, 1, 2.5])
def test_run_with_a_number_of_steps_names_step(count):
    simulation = Simulation(ROOT / "systems" / "heavy_top_3.toml")
    with pytest.raises(TypeError, match=rf"for {count} steps use step\({count}\)"):
        simulation.run(count)
    assert simulation.state.step[0] == 0  # nothing ran


def test_a_simulation_shows_what_is_for_users():
    shown = {name for name in dir(Simulation) if not name.startswith("_")}
    values = {"scene", "system", "engine", "threads", "state", "observation", "energy", "forces"}
    values |= {"time", "steps_done"}
    verbs = {"run", "step", "stop", "close", "compile", "start_from", "atoms", "path", "notes"}
    assert shown == values | verbs
    simulation = Simulation(ROOT / "systems" / "heavy_top_3.toml")
    assert {name for name in vars(simulation) if not name.startswith("_")} == {"folder"}
    assert set(dir(rigidmd.analysis)) == set(rigidmd.analysis.__all__)
