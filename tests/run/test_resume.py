"""Runs that are stopped and continue: to the same bits as one that never was."""

import hashlib
import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, field
from importlib.metadata import version
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from support.common import ROOT, small_scene
from support.processes import process, wait_until
from support.scenes import FORTY_WATERS, MINIMISE, NPH, NPT, NVE, NVT, forty_waters
from support.stops import (
    change,
    contents,
    everything,
    same_after_stops,
    stopped_at,
    top,
)

from rigidmd.commands import cli
from rigidmd.errors import CheckpointError
from rigidmd.features.bodies.run import BodyRecord, BodyRun
from rigidmd.io.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from rigidmd.io.folder import CHECKPOINT, PREVIOUS
from rigidmd.run import Every, Simulation, run_together
from rigidmd.run import resume as provenance
from rigidmd.run.molecular import MolecularRecord, MolecularRun
from rigidmd.run.resume import Arrays
from rigidmd.scene import Scene


def test_a_run_that_is_stopped_ends_like_one_that_is_not(tmp_path):
    """Two stages, mixed precision, a box that moves, a ramp, a pressure tensor of its own."""
    output = FORTY_WATERS["output"] | {"pressure_tensor_interval_ps": 0.01}
    data = forty_waters(NVT, NPT, NVE, precision="mixed", output=output, forces={"cutoff_A": 5.0})
    same_after_stops(data, [3, 61, 100, 133, 207], tmp_path)
    assert (tmp_path / "whole" / "pressure_tensor.csv").read_text().count("\n") == 32


ENSEMBLES = {
    "langevin": (NVT | {"thermostat": "langevin"}, NVE),
    "nose_hoover": (NVT | {"thermostat": "nose_hoover"}, NPH),
    "andersen": (NVT | {"thermostat": "andersen"}, NVE | {"integrator": "srkn_4"}),
    "hybrid_monte_carlo": (
        NVT | {"thermostat": "hybrid_monte_carlo", "trajectory_steps": 4, "timestep_fs": 6.0},
        NPT
        | {"thermostat": "hybrid_monte_carlo", "trajectory_steps": 3, "momentum_refreshment": 0.4},
    ),
    "monte_carlo": (NPT | {"barostat": "monte_carlo"}, NVE | {"integrator": "position_verlet"}),
    "flexible": (
        NPT | {"thermostat": "langevin", "pressure_coupling": "flexible"},
        NVE | {"integrator": "chin_4a"},
    ),
    "minimise": (MINIMISE, NVT, MINIMISE, NVE),
    "auto": (NVT, {"integrator": "auto", "energy_error_kT": 0.01, "duration_ps": 0.4}),
}


@pytest.mark.parametrize(
    ("name", "precision"),
    [  # in the default tier one, and the chains of nose_hoover below
        pytest.param(
            *which, marks=[] if which == ("hybrid_monte_carlo", "double") else pytest.mark.soak
        )
        for which in product(ENSEMBLES, ("double", "mixed"))
    ],
)
def test_every_ensemble_continues_to_the_same_bits(name, precision, tmp_path):
    stops = (
        [8, 16, 49, 76] if name == "hybrid_monte_carlo" else [17, 60, 111, 140]
    )  # the ends of trajectories
    same_after_stops(forty_waters(*ENSEMBLES[name], precision=precision), stops, tmp_path)


@pytest.mark.soak
@pytest.mark.parametrize(
    "name",
    [
        "trajectory.trr",
        "trajectory.gsd",
        "trajectory.traj",
        "trajectory.dcd",
        "trajectory.nc",
        "trajectory.xyz",
        "trajectory.pdb",
    ],
)
def test_every_format_continues(name, tmp_path):
    same_after_stops(
        forty_waters(NVT, output=FORTY_WATERS["output"] | {"trajectory": name}), [31, 80], tmp_path
    )


@pytest.mark.soak
def test_pme_continues(tmp_path):
    forces = {"cutoff_A": 5.0, "truncation": "shift", "electrostatics": "pme"}
    same_after_stops(
        forty_waters(NPT, NVE, forces=forces, precision="mixed"), [31, 80, 120], tmp_path
    )


@pytest.mark.parametrize("integrator", ["velocity_verlet", "rk4", "dop853"])
def test_a_body_continues(integrator, printed, tmp_path):
    data = top(integrator)
    looks = Every(0.005, lambda moment: None)
    Simulation(Scene.from_dict(data), tmp_path / "whole", observers=looks).run()
    left = {30, 71}
    for _ in range(3):
        stops = stopped_at(left)
        stops.interval = 0.005
        results = Simulation(
            Scene.from_dict(data), tmp_path / "parts", observers=stops, resume=True
        ).run()
    assert not results.interrupted
    whole, parts = contents(tmp_path / "whole"), contents(tmp_path / "parts")
    assert [name for name in whole if whole[name] != parts[name]] == []
    assert cli.main(["compare", str(tmp_path / "whole"), str(tmp_path / "parts")]) == 0
    assert (
        "had ended at step 100: writing" in printed("resume", tmp_path / "parts").err
    )  # nothing of --until
    motion = tmp_path / "parts" / "motion.csv"
    *lines, last = motion.read_text().splitlines()
    motion.write_text("\n".join([*lines, last[: last.rindex(",")] + ",0.125"]) + "\n")
    assert cli.main(["compare", str(tmp_path / "whole"), str(tmp_path / "parts")]) == 1


def test_the_command_resume_continues_and_lengthens(again, capsys, printed):
    folder = str(again / "run")
    assert "continuing from step" in printed("resume", folder).err
    assert re.search(
        r"had ended at step \d+ \(--until lengthens it\)", printed("resume", folder).err
    )
    assert read_checkpoint(again / "run" / CHECKPOINT).values["of"]["run"]["position"]["first"] == 0
    assert (
        cli.main(["run", str(again / "water.toml"), "-o", folder, "--resume", "--until", "0.12ps"])
        == 0
    )
    steps = [
        int(line.split(",")[0]) for line in (again / "run" / "log.csv").read_text().splitlines()[1:]
    ]
    assert steps == list(range(0, 121, 10))
    capsys.readouterr()
    assert "already longer, 120 steps" in printed("resume", folder, "--until", "0.05ps", code=2).err


def test_a_folder_is_all_that_is_needed(stopped, tmp_path):
    """`rigidmd resume` reads the scene that the run has written: its inputs are copies, and what
    was open is decided."""
    auto = {"duration_ps": 0.1, "integrator": "auto", "energy_error_kT": 1e-2}
    data = forty_waters(
        NVT, auto, structure={"file": "final.npz"}, start={"temperature_K": 298.0}, box={}
    )
    data["molecules"] = [{"model": "spce"}]
    folder = stopped / "run"
    looks = stopped_at(set())
    Simulation(Scene.from_dict(data, folder), tmp_path / "whole", observers=looks).run()
    parts = tmp_path / "parts"
    Simulation(Scene.from_dict(data, folder), parts, observers=stopped_at({40})).run()
    for step in (130, None):
        again = Scene.read(parts / "scene.toml")
        Simulation(again, parts, resume=True, observers=stopped_at({step} if step else set())).run()
    assert contents(tmp_path / "whole") == contents(parts)
    assert [path.name for path in parts.iterdir() if path.name.startswith("input_")] == [
        "input_structure_final.npz"
    ]


def test_compare_reports_where_two_runs_diverge(again, stopped, tmp_path, capsys, printed):
    """A run and itself, its continuation, and a run of another scene whose log was changed in a
    bit."""
    one, other = str(stopped / "run"), again / "run"
    assert "the runs are the same to the last bit\n" in printed("compare", one, other).out
    assert cli.main(["resume", str(other)]) == 0
    capsys.readouterr()
    said = printed("compare", one, other, code=1).out
    assert "7 and 11 samples, 7 in common, the same to the last bit" in said
    assert "position by up to" in said and "over their common samples" in said
    log = other / "log.csv"
    lines = [line.split(",") for line in log.read_text().splitlines()]
    column = lines[0].index('"Kinetic Energy (kJ/mol)"')
    lines[3][column] = repr(float(np.nextafter(float(lines[3][column]), np.inf)))
    log.write_text("\n".join(",".join(line) for line in lines) + "\n")
    scene = other / "scene.toml"
    scene.write_text(scene.read_text().replace("seed = 1", "seed = 5"))
    said = printed("compare", one, other, code=1).out
    assert "seed: 1 and 5" in said
    assert "the runs diverge at Step 20, sample 3 of 7" in said and "last 1 of 53 bits" in said
    told = json.loads(printed("compare", one, other, "--json", code=1).out)
    assert [cell["column"] for cell in told["samples"]["first"]] == ["Kinetic Energy (kJ/mol)"]
    assert "is not the folder of a run" in printed("compare", one, tmp_path, code=2).err


def test_the_summary_states_what_a_run_was_made_with(stopped):
    told = json.loads((stopped / "run" / "summary.json").read_text())
    for package in ("numba", "llvmlite", "numpy", "scipy", "rocket_fft"):
        assert told[f"{package}_version"] == version(package)
    assert (told["seed"], told["precision"], told["threads"], told["input_sha256"]) == (
        1,
        "mixed",
        1,
        {},
    )
    assert "64bit" in told["processor_features"] or platform.machine() not in ("x86_64", "AMD64")
    own = Scene.read(stopped / "run" / "scene.toml", {"threads": 2, "name": "other"})
    assert provenance.scene_digest(own) == told["scene_sha256"]
    assert provenance.scene_digest(own.model_copy(update={"seed": 2})) != told["scene_sha256"]


def test_another_version_is_reported(again, printed):
    kept = read_checkpoint(again / "run" / CHECKPOINT)
    del kept.values["with"]["scipy_version"]  # earlier versions of rigidmd did not name it
    kept.values["with"] |= {"numba_version": "0.1", "rocket_fft_version": "0.2"}
    write_checkpoint(again / "run", kept)
    written = printed("resume", again / "run").err
    assert "computed with numba 0.1 there, " in written
    assert "; rocket fft 0.2 there, " in written and "scipy" not in written


def test_an_input_that_changes_meanwhile_is_the_one_that_was_read(stopped, tmp_path):
    """Digests are the values of the start, whatever happens to the files of a run that continues."""
    shutil.copy(stopped / "run" / "final.npz", tmp_path / "start.npz")
    digest = hashlib.sha256((tmp_path / "start.npz").read_bytes()).hexdigest()
    data = forty_waters(NVT, structure={"file": "start.npz"}, box={})
    data["molecules"] = [{"model": "spce"}]
    away = Every(0.05, lambda moment: (tmp_path / "start.npz").unlink(missing_ok=True))
    results = Simulation(Scene.from_dict(data, tmp_path), tmp_path / "run", observers=away).run()
    assert results.summary["input_sha256"] == {"structure.file": digest}
    assert read_checkpoint(tmp_path / "run" / CHECKPOINT).values["of"]["run"]["inputs"] == {
        "structure.file": digest
    }


def test_another_scene_is_not_continued_with(again, printed):
    command = ["run", str(again / "water.toml"), "-o", str(again / "run"), "--resume"]
    said = printed(*command, "--set", "stages.0.timestep_fs=0.5", "--set", "seed=3", code=2).err
    assert "stages.0.timestep_fs is 0.5, there 1.0" in said and "seed is 3, there 1" in said
    before = contents(again / "run")
    assert cli.main([*command, "--set", "threads=2"]) == 0
    assert contents(again / "run") != before


def flip(path: Path) -> None:
    """Damage a file within its first half."""
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 4
    path.write_bytes(bytes(data))


def linked(path: Path) -> None:
    """Put a link to a copy elsewhere in the position of a file."""
    path.rename(path.parent.parent / path.name)
    path.symlink_to(path.parent.parent / path.name)


def piped(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


BROKEN = {
    "a damaged log": (lambda run: flip(run / "log.csv"), [], "log.csv has changed or is damaged"),
    "a damaged trajectory": (
        lambda run: flip(run / "trajectory.xtc"),
        [],
        "trajectory.xtc has changed",
    ),
    "no log": (lambda run: (run / "log.csv").unlink(), [], "log.csv: there is no such file"),
    "no trajectory": (
        lambda run: (run / "trajectory.xtc").unlink(),
        [],
        "trajectory.xtc: there is no such file",
    ),
    "a short log": (
        lambda run: os.truncate(run / "log.csv", 50),
        [],
        "log.csv is shorter than it was",
    ),
    "a linked log": (
        lambda run: linked(run / "log.csv"),
        [],
        "log.csv is a link out of its folder",
    ),
    "a linked trajectory": (
        lambda run: linked(run / "trajectory.xtc"),
        [],
        "trajectory.xtc is a link out of its folder",
    ),
    "a piped log": (
        lambda run: piped(run / "log.csv"),
        [],
        "log.csv: is a pipe, a socket or a device",
    ),
    "a shorter scene": (lambda run: None, ["--until", "0.001ps"], "already longer"),
    "another seed": (
        lambda run: change(run / "scene.toml", "seed = 1", "seed = 2"),
        [],
        "seed is 2, there 1",
    ),
    "a figure of another": (
        lambda run: [
            change(run / "scene.toml", "figures = false", "figures = true"),
            (run / "energy.png").touch(),
        ],
        [],
        "energy.png exists, was not written by rigidmd",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_refused_resume_changes_nothing(case, again, printed):
    """Neither a summary nor frames beyond the checkpoint are lost: all is checked before the first
    change."""
    run = again / "run"
    data = Scene.read(again / "water.toml", {"threads": 1})
    Simulation(
        data, run, resume=True, observers=stopped_at({73})
    ).run()  # its checkpoint before is older than its files
    (run / CHECKPOINT).write_bytes((run / PREVIOUS).read_bytes())
    damage, more, sentence = BROKEN[case]
    damage(run)
    before = everything(run)
    assert sentence in printed("resume", run, *more, code=2).err
    assert everything(run) == before and "summary.json" in before


@pytest.mark.parametrize("name", ["trajectory.gsd", "trajectory.traj", "trajectory.pdb"])
def test_frames_beyond_a_checkpoint_outlive_a_refused_resume(name, again, capsys):
    """Formats with a table or an end of their own."""
    data = forty_waters(NVT, output=FORTY_WATERS["output"] | {"trajectory": name}, threads=1)
    run = again / "other"
    Simulation(Scene.from_dict(data), run, observers=stopped_at({31})).run()
    shutil.copy(run / CHECKPOINT, again)
    Simulation(Scene.from_dict(data), run, resume=True).run()
    shutil.copy(again / CHECKPOINT, run)
    whole = contents(run)
    (again / "log.csv").write_bytes((run / "log.csv").read_bytes())
    flip(run / "log.csv")
    before = everything(run)
    assert cli.main(["resume", str(run)]) == 2
    assert everything(run) == before
    (run / "log.csv").write_bytes((again / "log.csv").read_bytes())
    assert cli.main(["resume", str(run)]) == 0
    assert contents(run) == whole
    flip(run / name)
    shutil.copy(again / CHECKPOINT, run)
    before = everything(run)
    capsys.readouterr()
    assert cli.main(["resume", str(run)]) == 2
    assert name in capsys.readouterr().err and everything(run) == before


def test_a_callback_that_changes_the_directory(again, monkeypatch):
    """Paths are the values of the start: neither another run is overwritten nor are files missing."""
    elsewhere = again / "elsewhere"
    shutil.copytree(again / "run", elsewhere / "run")
    before = everything(elsewhere / "run")
    monkeypatch.chdir(again)
    data = forty_waters(NVT | {"duration_ps": 0.02}, threads=1)
    moved = Every(0.005, lambda moment: os.chdir(elsewhere))
    results = Simulation(Scene.from_dict(data), "new", observers=moved).run()
    assert everything(elsewhere / "run") == before and not (elsewhere / "new").exists()
    assert {path.name for path in results.files} <= set(everything(again / "new"))
    assert (
        all(path.is_file() for path in results.files)
        and results.universe().trajectory.n_frames == 2
    )
    monkeypatch.chdir(again)
    Simulation(
        Scene.from_dict(data | {"name": "new"}).with_end(0.03), "new", observers=moved, resume=True
    ).run()
    monkeypatch.chdir(again)
    run_together(
        [Simulation(Scene.from_dict(data | {"seed": k}), f"of{k}", observers=moved) for k in (1, 2)]
    )
    assert [path.name for path in elsewhere.iterdir()] == ["run"] and everything(
        elsewhere / "run"
    ) == before
    assert len((again / "of2" / "log.csv").read_text().splitlines()) == 4


def test_a_forked_child_leaves_the_files_of_the_run_alone(again):
    """A child of a callback that unwinds, or comes back into the run, writes nothing and ends no
    lock."""
    ends = ("raises", "exits", "returns")
    program = f"""
import os, sys
from rigidmd import Every, Scene, Simulation
from rigidmd.errors import OutputError, SimulationError
def fork(moment):
    if moment.step == 12 and os.fork() == 0:
        if end == "raises":
            raise SimulationError("the child")
        if end == "exits":
            sys.exit(3)
    elif moment.step == 12:
        os.wait()
scene = Scene.read("water.toml", {{"threads": 1, "output.log_interval_ps": 0.001, "stages.0.duration_ps": 0.03}})
parent = os.getpid()
for end in {ends}:
    try:
        Simulation(scene, end, observers=Every(0.001, fork)).run()
    except (OutputError, SimulationError):
        assert os.getpid() != parent
    if os.getpid() != parent:
        break
"""
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=again, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    for end in ends:
        lines = (again / end / "log.csv").read_text().splitlines()[1:]
        assert [int(line.split(",")[0]) for line in lines] == list(range(31)), end
        assert not (again / end / "last_good_state.npz").exists()


def test_a_run_cannot_run_itself(again, tmp_path):
    data = Scene.from_dict(forty_waters(NVT | {"duration_ps": 0.01}, threads=1))
    simulation = Simulation(
        data, tmp_path / "run", observers=Every(0.005, lambda moment: simulation.run())
    )
    with pytest.raises(RuntimeError, match="running already"):
        simulation.run()
    simulation = Simulation(data, tmp_path / "run", force=True)
    assert simulation.run().summary["interrupted"] is False
    for strange in (3, "runs/water", data, None):
        with pytest.raises(TypeError, match="is not a Simulation"):
            run_together([simulation, strange])


class Counting(Every):
    """Counts its observations, also over stops, and sees to it that its memory is not that of another."""

    def __init__(self, start: int):
        super().__init__(0.01, self.count)
        self.counted = start

    def count(self, moment) -> None:
        self.counted += 1

    def memory(self) -> Checkpoint:
        return Checkpoint({"counted": self.counted}, {"squares": np.arange(self.counted) ** 2})

    def resume(self, run, kept) -> None:
        self.counted = kept.values["counted"]
        assert len(kept.arrays["squares"]) == self.counted


def test_observers_of_a_checkpoint_are_known_by_what_they_are(again):
    """What may change (figures, the user's observers) takes no other observer's memory."""
    data = forty_waters(NVT, threads=1)
    first, second = Counting(0), Counting(100)
    Simulation(
        Scene.from_dict(data), again / "two", observers=[first, second, stopped_at({40})]
    ).run()
    assert (first.counted, second.counted) == (5, 105)
    figure = data | {"output": data["output"] | {"figures": True}}
    for now, own in (
        (figure, [stopped_at({70}), Counting(0), Counting(0)]),
        (data, [Counting(0), Counting(0), Counting(7)]),
    ):
        Simulation(Scene.from_dict(now), again / "two", resume=True, observers=own).run()
    assert [one.counted for one in own] == [11, 111, 10]  # the third is new
    assert (
        not (again / "two" / "energy.png").exists()
        or "energy.png" in (again / "two" / ".rigidmd-run").read_text()
    )


@dataclass
class LongerRecord(MolecularRecord):
    """A record with fields that no code of the package knows."""

    seen: int = 0
    names: dict[int, list[str]] = field(default_factory=dict)
    squares: np.ndarray = field(default_factory=lambda: np.zeros(0))
    tables: Arrays = field(default_factory=dict)


@dataclass
class LongerBodyRecord(BodyRecord):
    seen: int = 0


@pytest.mark.parametrize("kind", ["molecules", "body"])
def test_a_field_that_is_added_to_the_record_survives_a_stop(kind, tmp_path, monkeypatch):
    monkeypatch.setattr(MolecularRun, "record_type", LongerRecord)
    monkeypatch.setattr(BodyRun, "record_type", LongerBodyRecord)
    data = forty_waters(NVT, threads=1) if kind == "molecules" else top("velocity_verlet")
    interval, stop = (0.01, 0.04) if kind == "molecules" else (0.02, 0.1)
    left, reached = {stop}, []

    def count(moment):
        record = simulation._part.record
        record.seen += 1
        reached.append(record.seen)
        if kind == "molecules":
            record.names[moment.step] = [f"at {moment.step}"]
            record.squares = np.arange(record.seen) ** 2.0
            record.tables[f"at {moment.step}"] = np.full(2, moment.time)
        if moment.time > 0.99 * stop and left:
            left.clear()
            simulation.stop()

    for resume in (False, True):
        simulation = Simulation(
            Scene.from_dict(data), tmp_path / "run", observers=Every(interval, count), resume=resume
        )
        assert simulation.run().interrupted != resume
    assert reached == list(range(1, len(reached) + 1)) and len(reached) > 10
    if kind == "molecules":
        record = simulation._part.record
        assert list(record.names.values()) == [[f"at {10 * k}"] for k in range(len(reached))]
        assert record.squares.tolist() == [k**2 for k in range(len(reached))]
        assert len(record.tables) == len(reached) and record.tables[
            "at 20"
        ].tolist() == pytest.approx([0.02, 0.02])


class Remembering(Every):
    """Declares what it remembers, and no code for it."""

    remembers = {"counted": int, "times": np.ndarray}  # noqa: RUF012

    def __init__(self):
        super().__init__(0.01, self.count)
        self.counted, self.times = 0, np.zeros(0)

    def count(self, moment) -> None:
        self.counted, self.times = self.counted + 1, np.append(self.times, moment.time)


def test_what_an_observer_remembers_is_declared_once(again):
    data = forty_waters(NVT, threads=1)
    for stops in ({40}, set()):
        counts = Remembering()
        Simulation(
            Scene.from_dict(data), again / "two", resume=True, observers=[counts, stopped_at(stops)]
        ).run()
    assert counts.counted == 11 and counts.times == pytest.approx(0.01 * np.arange(11))
    kept = read_checkpoint(again / "two" / CHECKPOINT)
    kept.values["of"]["user-Remembering"]["counted"] = "many"
    write_checkpoint(again / "two", kept)
    with pytest.raises(CheckpointError, match="integer"):
        Simulation(
            Scene.from_dict(data), again / "two", resume=True, observers=[Remembering()]
        ).run()


def test_a_run_that_was_killed_before_its_first_checkpoint_begins_again(again):
    whole = contents(again / "run")
    for name in (CHECKPOINT, PREVIOUS, "final.npz", "summary.json"):
        (again / "run" / name).unlink()
    log = (again / "run" / "log.csv").read_text().splitlines(keepends=True)
    (again / "run" / "log.csv").write_text("".join(log[:2]))
    assert cli.main(["resume", str(again / "run"), "--until", "0.06ps"]) == 0
    assert contents(again / "run") == whole


def test_a_run_stops_before_its_wall_time_is_up(stopped, tmp_path, capsys, monkeypatch):
    """On a clock that continues by 10 ms whenever it is read."""
    now, spare = [0.0], 3.0  # seconds that are left for the end

    def read():
        now[0] += 0.01
        return now[0]

    command = [
        "run",
        str(stopped / "water.toml"),
        "-o",
        str(tmp_path / "run"),
        "--set",
        "stages.0.duration_ps=1000",
    ]
    steps = []
    for more in ([], ["--resume"]):
        began, seen = now[0], len(steps)
        with monkeypatch.context() as patch:
            patch.setattr(time, "monotonic", read)
            assert cli.main([*command, *more, "--walltime", "0:00:04"]) == 75
        assert "continues it" in capsys.readouterr().out
        assert 4.0 - spare - 0.1 < now[0] - began < 4.0
        log = (tmp_path / "run" / "log.csv").read_text().splitlines()
        steps = [int(line.split(",")[0]) for line in log[1:-1]]
        assert steps == list(range(0, 10 * len(steps), 10))
        assert len(steps) > seen + 10


def killed(command: list[str], after: float) -> int:
    """Kill a command this many seconds after it has written to its log; its exit code."""
    log = Path(command[command.index("-o") + 1]) / "log.csv"
    before = log.stat().st_mtime_ns if log.exists() else None
    with process(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as run:
        wait_until(lambda: log.exists() and log.stat().st_mtime_ns != before, run)
        with suppress(subprocess.TimeoutExpired):
            run.wait(after)
    return run.returncode


@pytest.mark.parametrize("times", [2, pytest.param(200, marks=pytest.mark.soak)])
def test_a_run_that_is_killed_continues(times, stopped, tmp_path):
    """kill -9 at random moments, with a checkpoint at every observation, of a run that is longer than
    anybody waits for."""
    scene = [
        "run",
        str(stopped / "water.toml"),
        "--set",
        "output.checkpoint_minutes=1e-9",
        "--threads",
        "1",
    ]
    scene += ["--set", "output.log_interval_ps=0.02"]
    longest = 1000 * times
    command = [sys.executable, "-m", "rigidmd", *scene, "-o", str(tmp_path / "parts"), "--resume"]
    rng = np.random.default_rng(times)
    for _ in range(times):
        assert (
            killed(
                [*command, "--set", f"stages.0.duration_ps={longest}"], float(rng.uniform(0.0, 0.3))
            )
            == -signal.SIGKILL
        )
    lines = (
        (tmp_path / "parts" / "log.csv").read_text().splitlines()[1:]
    )  # the last perhaps half a line, or none yet
    reached = max((int(line.partition(",")[0]) for line in lines), default=0)
    end = ["--set", f"stages.0.duration_ps={np.ceil(reached / 1000) + 1.0}"]
    assert cli.main([*scene, "-o", str(tmp_path / "parts"), "--resume", *end]) == 0
    without = ["--set", "output.checkpoint_minutes=false"]
    assert cli.main([*scene, "-o", str(tmp_path / "whole"), *without, *end]) == 0
    whole, parts = contents(tmp_path / "whole"), contents(tmp_path / "parts")
    assert [name for name in whole if whole[name] != parts[name]] == []


@pytest.mark.soak
def test_a_chain_of_batch_jobs_is_one_run(stopped, tmp_path):
    """The recipe of the manual, with a scheduler that starts the next job at once."""
    manual = (ROOT / "rigidmd" / "docs" / "guides" / "resume.md").read_text()
    job = next(
        block for block in re.findall(r"```text\n(.*?)```", manual, re.DOTALL) if "#SBATCH" in block
    )
    (tmp_path / "job.sh").write_text(job.replace("3:55:00", "0:00:05"))
    (tmp_path / "bin").mkdir()
    commands = {
        "sbatch": 'echo job >> jobs; exec bash "$1"',
        "rigidmd": f'exec {sys.executable} -m rigidmd "$@"',
    }
    for name, line in commands.items():
        (tmp_path / "bin" / name).write_text(f"#!/bin/bash\n{line}\n")
        (tmp_path / "bin" / name).chmod(0o755)
    scene = (stopped / "water.toml").read_text().replace("duration_ps = 0.1", "duration_ps = 12.0")
    (tmp_path / "water.toml").write_text(scene)
    path = f"{tmp_path / 'bin'}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"PATH": path}
    subprocess.run(["bash", "job.sh"], cwd=tmp_path, env=environment, check=True)
    assert len((tmp_path / "jobs").read_text().splitlines()) >= 2
    assert cli.main(["run", str(tmp_path / "water.toml"), "-o", str(tmp_path / "whole")]) == 0
    whole, parts = contents(tmp_path / "whole"), contents(tmp_path / "runs" / "water")
    assert [name for name in whole if whole[name] != parts[name]] == []


@pytest.mark.parametrize(
    "ramp", [{"temperature_K": [90.0, 140.0]}, {"temperature_K": [140.0, 90.0]}]
)
def test_the_duration_of_a_ramp_stays(ramp, tmp_path):
    """Another duration would be another slope of the temperature from there on."""
    thermostat = {"ensemble": "nvt"}

    def scene(duration, **temperature):
        return small_scene(
            {"argon": 8},
            20.0,
            stages=[{"duration_ps": duration} | thermostat | temperature],
            output={"figures": False},
        )

    Simulation(scene(0.004, **ramp), tmp_path / "ramp").run()
    with pytest.raises(CheckpointError, match=r"stages\.0\.duration_ps is 0\.008, there 0\.004"):
        Simulation(scene(0.008, **ramp), tmp_path / "ramp", resume=True).run()
    level = {"temperature_K": 100.0}
    Simulation(scene(0.004, **level), tmp_path / "level").run()
    longer = Simulation(scene(0.008, **level), tmp_path / "level", resume=True).run()
    assert longer["time"][-1] == pytest.approx(0.008)


WATER = {
    "box": {"density_g_cm3": 0.9},
    "molecules": [{"model": "spce", "count": 40}],
    "forces": {"cutoff_A": 5.0, "truncation": "smooth_switch"},
    "start": {"temperature_K": 298.0},
    "output": {"log_interval_ps": 0.013, "trajectory_interval_ps": 0.02, "figures": False},
}
CHAINS = {
    "ensemble": "nvt",
    "temperature_K": 298.0,
    "thermostat": "nose_hoover",
    "thermostat_time_ps": 0.05,
}


def test_chains_resume_to_the_same_bits_in_double_precision(tmp_path):
    """A short period, so that the chains have swung when the run stops."""
    stage = CHAINS | {"duration_ps": 0.06, "timestep_fs": 1.0}
    same_after_stops(WATER | {"stages": [stage], "precision": "double"}, [17, 41], tmp_path)
