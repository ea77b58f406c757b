"""Bad input: each gets one message that states what, where and what to do; no traceback, nothing
half-written."""

import json
import re
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest
from support.common import MOLECULES, ROOT, small_scene
from support.scenes import GOOD

from rigidmd.assemble.build import build
from rigidmd.assemble.time_step import step_warnings
from rigidmd.commands.cli import CommandLine, main
from rigidmd.errors import (
    MoleculeError,
    OutputError,
    SceneError,
    SimulationError,
    StructureError,
    worded_by,
)
from rigidmd.io.folder import check_folder
from rigidmd.run import Simulation
from rigidmd.scene import BodyScene, MolecularScene, Scene, parse_override, schema
from rigidmd.scene.hints import OF_A_BODY, OF_MOLECULES
from rigidmd.scene.models import Site, load_model, molecule, read_molecule
from rigidmd.scene.stage import Stage


def refused(capsys, tmp_path, text, *arguments, code=2):
    """The message for a scene text; checks that nothing was written and that there is no
    traceback."""
    scene = tmp_path / "bad.toml"
    scene.write_text(text)
    before = sorted(p.relative_to(tmp_path) for p in tmp_path.rglob("*"))
    assert main(["run", str(scene), "-o", str(tmp_path / "out"), *arguments]) == code
    assert sorted(p.relative_to(tmp_path) for p in tmp_path.rglob("*")) == before
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err
    return err


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (
            "count = 20",
            "count = 20\ncuont = 3",
            ["line 7", "molecules.0.cuont", "unknown key", "did you mean count?"],
        ),
        (
            "timestep_fs = 1",
            "timestep = 1",
            ["line 10", "stages.0.timestep", "did you mean timestep_fs?"],
        ),
        ("[start]", "[strat]", ["strat", "did you mean start?"]),
        (
            "lengths_A = 20.0",
            'lengths_A = "wide"',
            ["line 2", "box.lengths_A", "'wide'", "must be a number"],
        ),
        ("lengths_A = 20.0", "lengths_A = -1", ["box.lengths_A", "-1", "greater than 0"]),
        ("lengths_A = 20.0", "lengths_A = nan", ["box.lengths_A", "finite"]),
        ("lengths_A = 20.0", "lengths_A = inf", ["box.lengths_A", "finite"]),
        ("lengths_A = 20.0", "density_g_cm3 = 0", ["box.density_g_cm3", "greater than 0"]),
        ("lengths_A = 20.0", "", ["box needs lengths_A or density_g_cm3"]),
        (
            "lengths_A = 20.0",
            "lengths_A = 17.0",
            ["cutoff_A = 9 (the default)", "half the shortest edge", "8.500 Å"],
        ),
        ("lengths_A = 20.0", "lengths_A = 20.0\nperiodic = 1", ["box.periodic", "true or false"]),
        ("count = 20", "count = 0", ["molecules.0.count", "greater than 0"]),
        ("count = 20", "count = 2.5", ["molecules.0.count", "must be an integer"]),
        ("count = 20", "", ["molecules.0.count is missing"]),
        (
            'model = "spce"',
            'model = "SPC-EE"',
            ["line 5", "molecules.0.model", "unknown model 'SPC-EE'", "did you mean spce?"],
        ),
        ('model = "spce"', "", ["molecules.0", "one of model, file, sites"]),
        (
            "timestep_fs = 1",
            "timestep_fs = 0",
            ["line 10", "stages.0.timestep_fs", "greater than 0"],
        ),
        (
            "timestep_fs = 1",
            "timestep_fs = -2",
            ["stages.0.timestep_fs", "is -2", "greater than 0"],
        ),
        ("timestep_fs = 1", "timestep_fs = 100", ["less than one step"]),
        ("duration_ps = 0.01", "", ["stages.0.duration_ps", "missing"]),
        (
            "timestep_fs = 1",
            'ensemble = "nvp"',
            [
                "line 10",
                "stages.0.ensemble",
                "'nvp'",
                "must be 'nve', 'nvt', 'npt', 'nph' or 'minimise'",
            ],
        ),
        (
            "timestep_fs = 1",
            "ensemble = nvt",
            ["line 10: stages.0.ensemble: is nvt without quotes", '"nvt"'],
        ),
        (
            "timestep_fs = 1",
            "ensemble = infinite",
            ["line 10: stages.0.ensemble: is infinite without quotes"],
        ),
        (
            'model = "spce"',
            "file = a/water.xyz",
            ["line 5: molecules.0.file: is a/water.xyz without quotes", '"a/water.xyz"'],
        ),
        (
            "count = 20",
            'count = 20\nresidue_names = ["SOL", W]',
            ["line 7: molecules.0.residue_names: is W without quotes"],
        ),
        (
            "count = 20",
            "count = 20\nfrozen = True",
            ["line 7: molecules.0.frozen: is True, must be written true"],
        ),
        (
            "count = 20",
            "count = 20\nfrozen = null",
            ["line 7: molecules.0.frozen: is null", "omit the key"],
        ),
        ("[start]", "[output]\npositions = [\n[start]", ["is not TOML", "line 14"]),
        ("timestep_fs = 1", "timestep_fs = 1 fs", ["is not TOML", "line 10"]),
        (
            "timestep_fs = 1",
            'integrator = "rk4"',
            ["line 10: stages.0.integrator: is 'rk4': general ODE solvers are for single"],
        ),
        (
            "timestep_fs = 1",
            'integrator = "MD-VV"',
            ["is 'MD-VV': write 'velocity_verlet'", "kahan_li_8"],
        ),
        ("timestep_fs = 1", 'integrator = "sd"', ["thermostat = 'langevin'"]),
        (
            "timestep_fs = 1",
            'timestep_fs = "1 ps"',
            ["is '1 ps', must be a number: write 1000, in fs"],
        ),
        (
            "duration_ps = 0.01",
            'duration_ps = "1 ns"',
            ["line 9: stages.0.duration_ps: is '1 ns'", "write 1000, in ps"],
        ),
        ("lengths_A = 20.0", 'lengths_A = "2 nm"', ["must be a number or a list: write 20, in Å"]),
        (
            "temperature_K = 300",
            'temperature_K = "300"',
            ["must be a number: write 300 without quotes"],
        ),
        (
            "temperature_K = 300",
            'temperature_K = "27 C"',
            ["write it without unit, in the one that the key names"],
        ),
        (
            "[start]",
            "[watch]\nvolume = 0.5\n[start]",
            ["watch.volume: is 0.5, must be greater than 1 or false"],
        ),
        ("[start]", "[watch]\nvolume = 1\n[start]", ["watch.volume: is 1, must be greater than 1"]),
        (
            "[start]",
            "[watch]\nmove = 1e-30\n[start]",
            ["watch.move: is 1e-30, must not be less than 1e-06"],
        ),
        (
            "[start]",
            "[watch]\northogonality = 1e-17\n[start]",
            ["watch.orthogonality", "not be less than 1e-14"],
        ),
        (
            "timestep_fs = 1",
            'integrator = "verlet"',
            ["did you mean velocity_verlet or position_verlet?"],
        ),
        (
            "count = 20",
            "count = 20\nfrozen = 1.5",
            ["molecules.0.frozen", "is 1.5, must be true or false or a list or a text"],
        ),
        (
            "count = 20",
            'count = 20\nfrozen = "1..3"',
            ["molecules.0.frozen", "'1..3'", "numbers of molecules such as '1-10'"],
        ),
        (
            "count = 20",
            'count = 20\nfrozen = "9-3, 2"',
            ["molecules.0.frozen", "9-3 ends before it begins"],
        ),
        ("count = 20", "count = 20\nfrozen = []", ["molecules.0.frozen", "is empty"]),
        (
            "count = 20",
            "count = 20\nfrozen = [1, 21]",
            ["molecules.0.frozen: no spce has the number 21; they have 1 to 20"],
        ),
        (
            "count = 20",
            'count = 20\nfrozen = "15-30"',
            ["molecules.0.frozen: no spce has the number 15-30"],
        ),
        ("timestep_fs = 1", 'ensemble = "nvt"', ["needs temperature_K"]),
        (
            "timestep_fs = 1",
            "temperature_K = 300",
            ["temperature_K would have no effect in an nve stage"],
        ),
        ("temperature_K = 300", "temperature_K = -1", ["start.temperature_K", "-1"]),
        ("[start]\ntemperature_K = 300", "", ["start.temperature_K is missing"]),
        ("[start]", "[forces]\nskin_A = 0\n[start]", ["forces.skin_A"]),
        (
            "[start]",
            '[forces]\ntruncation = "swich"\n[start]',
            ["forces.truncation", "did you mean switch?"],
        ),
        (
            "[start]",
            '[forces]\ntruncation = "switch"\ncutoff_A = 6\nswitch_start_A = 7\n[start]',
            ["switch_start_A = 7", "below"],
        ),
        (
            "[start]",
            '[output]\ntrajectory = "../t.xtc"\n[start]',
            ["output.trajectory", "plain file name"],
        ),
        ("[start]", '[output]\ntrajectory = "t.mp4"\n[start]', ["output.trajectory", ".xtc"]),
        (
            "[start]",
            "[output]\nvelocities = true\n[start]",
            ["trajectory.xtc cannot store them", "use a .gsd or .nc or .traj or .trr file"],
        ),
        (
            "[start]",
            '[output]\ntrajectory = "t.dcd"\ntrajectory_interval_ps = 0.0035\n[start]',
            [".dcd", "one time between frames"],
        ),
        ("[start]", '[output]\ntrajectory = "x.pdb"\ntopology = "x.pdb"\n[start]', ["both x.pdb"]),
        ("[start]", '[output]\ntrajectory = "input_a.pdb"\n[start]', ["input_"]),
        (
            "[start]",
            '[forces]\ntruncation = "shift"\nswitch_start_A = 5\n[start]',
            ["would have no effect with truncation = 'shift'"],
        ),
        ("[start]", "[forces]\nskin_A = 1e3\n[start]", ["forces.skin_A", "not be more than 100"]),
        ("count = 20", "count = 10000000000000", ["not enough memory"]),
        ("timestep_fs = 1", "timestep_fs = 1e-20", ["more than 1e+12 steps"]),
        (
            "count = 20",
            'count = 20\nresidue_names = ["ETHYLENE GLYCOL"]',
            ["residue_names.0", "one to five visible"],
        ),
        ("[start]", "precision = ", ["not TOML"]),
        (
            "[start]",
            '[structure]\nfile = "../../etc/passwd"\n[start]',
            ["outside the scene's folder", "--set"],
        ),
        ("[start]", '[structure]\nfile = "/etc/passwd"\n[start]', ["outside the scene's folder"]),
        (
            "[start]",
            '[structure]\nfile = "none.gro"\n[start]',
            ["line 13: structure.file: there is no such file", "none.gro"],
        ),
        (
            "[start]",
            '[structure]\nfile = "bda.toml"\n[start]',
            ["line 13: structure.file: ", "did you mean bad.toml?"],
        ),
        ("[start]", '[structure]\nfile = "."\n[start]', ["line 13: structure.file: is a folder"]),
        (
            "[start]",
            '[structure]\nfile = "bad.toml"\natom_types = { 1 = "O" }\n[start]',
            [
                "bad.toml: structure.atom_types is for formats whose atoms have types: data files of LAMMPS (.data), dumps of LAMMPS, .xyz .extxyz"
            ],
        ),
        (
            "count = 20",
            'count = 20\nparameters = "p.toml"',
            ["line 4: molecules.0: parameters would have no effect"],
        ),
        (
            "lengths_A = 20.0",
            "lengths_A = 20.0\nangles_deg = [30.0, 30.0, 90.0]",
            ["cannot form these angles"],
        ),
        (
            "lengths_A = 20.0",
            "density_g_cm3 = 1.0\nangles_deg = [80.0, 80.0, 90.0]",
            ["angles_deg needs lengths_A"],
        ),
        (
            "lengths_A = 20.0",
            "lengths_A = 20.0\nangles_deg = [90.0, 90.0, 180.0]",
            ["angles_deg.2", "less than 180"],
        ),
        (
            "lengths_A = 20.0",
            "lengths_A = 20.0\nangles_deg = [90.0, 90.0, 50.0]",
            ["smallest of a_x, b_y, c_z"],
        ),
        (
            "lengths_A = 20.0",
            "density_g_cm3 = 997",
            ["box.density_g_cm3 is 997 g/cm³", "is it in kg/m³"],
        ),
        (
            "lengths_A = 20.0",
            "lengths_A = 0.84",
            ["density of the box is 1009 g/cm³", "an edge in nm?"],
        ),
        (
            "[[stages]]",
            '[[molecules]]\nname = "x"\nsites = []\n[[stages]]',
            ["molecules.1.sites", "needs at least 1"],
        ),
        (
            "[[stages]]",
            '[[molecules]]\nname = "x"\ncount = 1\nsites = [{name = "A", mass_u = -1.0, position_A = [0,0,0]}]\n[[stages]]',
            ["molecules.1.sites.0.mass_u", "-1.0", "not be less than 0"],
        ),
        (
            "[[stages]]",
            '[[molecules]]\nmodel = "spce"\ncount = 1\n[[stages]]',
            ["spce appears twice"],
        ),
    ],
)
def test_a_bad_scene(old, new, expected, capsys, tmp_path):
    assert old in GOOD
    message = refused(capsys, tmp_path, GOOD.replace(old, new))
    for part in ["bad.toml", *expected] if "passwd" not in new else expected:
        assert part in message


#: A stage with a thermostat and a barostat, and time constants that its steps of 2 fs cannot
#: follow.
SHORT_TIMES = [
    (
        {"ensemble": "nvt", "thermostat": "nose_hoover", "thermostat_time_ps": 0.006},
        "thermostat_time_ps = 0.006 is a period shorter than pi steps, 0.00628 ps",
    ),
    (
        {"ensemble": "npt", "pressure_bar": 1.0, "barostat_time_ps": 1e-9},
        "barostat_time_ps = 1e-09 is shorter than the 0.002 ps between moves of the box",
    ),
    (
        {
            "ensemble": "npt",
            "pressure_bar": 1.0,
            "barostat_time_ps": 0.1,
            "barostat_interval_ps": 0.2,
        },
        "barostat_time_ps = 0.1 is shorter than the 0.2 ps between moves of the box",
    ),
    (
        {"ensemble": "nph", "pressure_bar": 1.0, "barostat_time_ps": 0.005, "temperature_K": None},
        "barostat_time_ps = 0.005 is a period shorter than pi steps, 0.00628 ps",
    ),
]


@pytest.mark.parametrize(("stage", "message"), SHORT_TIMES)
def test_a_time_constant_shorter_than_steps(stage, message):
    stage = {"duration_ps": 1.0, "timestep_fs": 2.0, "temperature_K": 300.0} | stage
    with pytest.raises(SceneError, match=re.escape(message)):
        small_scene({"spce": 4}, 13.0, stages=[stage])


@pytest.mark.parametrize("key", ["barostat_time_ps", "barostat_interval_ps"])
def test_an_interval_beyond_all_steps_is_never(key):
    """The number of steps stays one that kernels can count."""
    stage = {
        "ensemble": "npt",
        "pressure_bar": 1.0,
        "temperature_K": 300.0,
        "duration_ps": 1.0,
        key: 1e30,
    }
    scene = small_scene(
        {"spce": 4},
        13.0,
        stages=[stage | ({"barostat": "monte_carlo"} if "interval" in key else {})],
    )
    assert scene.stages[0].steps < scene.stages[0].moves_every < 2**62
    assert not [note for note in scene.rounded_times() if "1e+30" in note]


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("md.mdp", "is an input file of GROMACS, not a scene: `rigidmd help coming_from`"),
        ("in.lammps", "is an input file of LAMMPS, not a scene"),
        ("water.in", "is an input file of LAMMPS, not a scene"),
        ("run.py", "is an input file of Python, not a scene"),
        (
            "start.gro",
            'is a structure file, not a scene: a scene names it by [structure] file = "start.gro"',
        ),
        ("start.pdb", 'a scene names it by [structure] file = "start.pdb"'),
        (
            "run.xtc",
            'is a trajectory file, not a scene: a scene names it by [structure] file = "run.xtc"',
        ),
        (
            "start.xsf",
            "a scene is a TOML file. One that starts from a structure names it by [structure] file",
        ),
        ("folder", "is a folder. A scene is a file, such as "),
        ("empty", "is a folder. A scene is a TOML file"),
        ("run", "is a folder. `rigidmd resume "),
    ],
)
@pytest.mark.parametrize("command", ["run", "check", "energy"])
def test_a_file_that_is_no_scene_is_named(name, expected, command, capsys, tmp_path):
    path = tmp_path / name
    match name:
        case "empty":
            path.mkdir()
        case "folder" | "run":
            path.mkdir()
            (path / {"folder": "water.toml", "run": "scene.toml"}[name]).write_text("")
        case _:
            path.write_text("; comment\nintegrator = md\n")
    assert main([command, str(path)]) == 2
    assert expected in capsys.readouterr().err


def test_walls_far_apart_or_close_together_leave_a_lattice(tmp_path):
    """Edges of the space for molecules may differ by any factor; all molecules lie between the
    walls."""
    for high in (1e-9, 1e-3, 30.0, 1e30):
        walls = {"axis": "z", "kind": "harmonic", "acts_on": "centres", "stiffness_kJ_mol_A2": 1.0}
        scene = small_scene(
            {"argon": 30},
            [20.0, 20.0, 40.0],
            fields={"walls": [walls | {"positions_A": [0.0, high]}]},
            box={"periodic": False, "lengths_A": [20.0, 20.0, 40.0]},
        )
        position = build(scene).state.position
        assert len({tuple(row) for row in position}) == 30
        assert 0 < position[:, 2].min() <= position[:, 2].max() < high


def test_an_unknown_integrator_lists_the_names_once(capsys, tmp_path):
    for scheme in ("foo", "velocity-verlt"):
        message = refused(
            capsys, tmp_path, GOOD.replace("timestep_fs = 1", f'integrator = "{scheme}"')
        )
        assert message.count("srkn_6") == 1
        assert message.count("kahan_li_8") == 1


FOREIGN = tomllib.loads((ROOT / "rigidmd/scene/foreign_keys.toml").read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    ("table", "key", "text"),
    [(table, *item) for table, entries in FOREIGN.items() for item in entries.items()],
)
def test_a_setting_of_another_program_names_the_key_of_a_scene(table, key, text):
    section = "body" if key.endswith("_s") or table == "body" else "forces"
    where = "wheels.0" if table == "wheels" else section
    names, _, note = text.partition(": ")
    for name in names.split():
        for asked in (name, name.upper().replace("_", "-")):
            with pytest.raises(SceneError) as raised:
                unknown = {asked: 1}
                Scene.from_dict(
                    {"body": {}, "wheels": [unknown]} if table == "wheels" else {section: unknown}
                )
            (found,) = [
                line
                for line in raised.value.errors
                if line.startswith(f"{where}.{asked}: unknown key")
            ]
            assert note in found
            if table != "none":
                assert f"In rigidmd this is {key}" in found


@pytest.mark.parametrize(
    ("table", "names"), [(table, list(names)) for table, names in FOREIGN.items()]
)
def test_what_stands_for_a_setting_of_another_program_is_a_key(table, names):
    tables = json.dumps(schema()["$defs"])
    if table != "none":
        assert [name for name in names if f'"{name}": ' not in tables] == []


def test_a_hint_names_the_table_and_the_unit():
    with pytest.raises(
        SceneError,
        match=r"forces.rcut: unknown key. In rigidmd this is cutoff_A in \[forces\] \(in Å\)",
    ):
        small_scene({"spce": 20}, 20.0, forces={"rcut": 9.0})
    with pytest.raises(
        SceneError, match=r"stages.0.timestep: unknown key; did you mean timestep_fs\?"
    ):
        small_scene({"spce": 20}, 20.0, stages=[{"timestep": 1.0}])


LIQUID = {
    "box": {"lengths_A": 20.0},
    "molecules": [{"model": "spce", "count": 20}],
    "stages": [{"ensemble": "nvt", "duration_ps": 1.0, "temperature_K": 300.0}],
}


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"stages": [{"tau_t_ps": 1.0}]}, "this is thermostat_time_ps in [[stages]] (in ps)"),
        ({"stages": [{"tdamp_ps": 1.0}]}, "this is thermostat_time_ps in [[stages]]"),
        ({"stages": [{"duration_ns": 1.5}]}, "duration_ns: unknown key; write duration_ps = 1500"),
        (
            {"stages": [{"temperature_C": 25}]},
            "temperature_C: unknown key; write temperature_K = 298.15",
        ),
        ({"forces": {"cutoff_nm": 0.9}}, "cutoff_nm: unknown key; write cutoff_A = 9"),
        ({"nonbonded": {}}, "nonbonded: unknown key; did you mean forces?"),
        ({"initial": {}}, "initial: unknown key; did you mean start?"),
        ({"electrostatics": {"method": "pme"}}, "electrostatics is a key of [forces]"),
        ({"run": {"seed": 3}}, "run.seed: unknown key; seed is a key of the top level"),
        ({"stages": [{"cutoff_A": 9.0}]}, "cutoff_A is a key of [forces]"),
        ({"forces": {"integrator": "baoab"}}, "integrator is a key of [[stages]]"),
        ({"forces": {"coulomb": "pme"}}, "In rigidmd this is electrostatics in [forces]"),
        ({"gravity": {}}, "gravity: unknown key; only a scene of a single body has it"),
        ({"molecules": [{"model": "N2"}]}, "did you mean nitrogen or nitrogen_2cljq or"),
    ],
)
def test_a_hint_on_units_tables_and_keys_of_other_tables(changes, expected):
    with pytest.raises(SceneError) as raised:
        Scene.from_dict(LIQUID | changes)
    assert expected in str(raised.value)


def test_a_key_of_the_other_kind_of_scene_is_known():
    molecules, body = set(MolecularScene.model_fields), set(BodyScene.model_fields)
    assert set(OF_MOLECULES) == molecules - body
    assert set(OF_A_BODY) == body - molecules


def test_a_single_body_has_no_engine(capsys):
    for command in ("check", "run", "verify"):
        assert main([command, str(ROOT / "systems/t_handle.toml"), "--engine", "lammps"]) == 2
        assert "engine: unknown key; only a scene of molecules has it" in capsys.readouterr().err


def test_a_long_list_of_keys_has_the_most_similar_ones():
    with pytest.raises(SceneError) as raised:
        Scene.from_dict(LIQUID | {"stages": [{"xyzzy": 1.0, "duration_ps": 1.0}]})
    (line,) = (line for line in raised.value.errors if "xyzzy" in line)
    assert re.search(r"there are (\w+, ){7}\w+ and \d+ others$", line)
    listed = re.findall(r"\w+", line.partition("there are ")[2].partition(" and ")[0])
    assert listed == [key for key in Stage.model_fields if key in listed]


def test_american_spelling_is_accepted():
    stage = {"ensemble": "minimize"}
    assert Scene.from_dict(LIQUID | {"stages": [stage]}).stages[0].ensemble == "minimise"
    top = {"mass_kg": 1.0, "inertia_kg_m2": [1.0, 1.0, 0.5], "center_of_mass_m": [0, 0, 0.1]}
    run = {"duration_s": 1.0, "timestep_s": 0.01}
    scene = Scene.from_dict({"body": top | {"pinned": True}, "run": run})
    assert scene.body.centre_of_mass_m == (0, 0, 0.1)


@pytest.mark.parametrize(
    ("table", "key", "given", "meant"),
    [
        ("stages.0", "ensemble", "NVT", "nvt"),
        ("stages.0", "thermostat", "Nose-Hoover", "nose_hoover"),
        ("stages.0", "integrator", "Velocity-Verlet", "velocity_verlet"),
        ("forces", "mixing", "Lorentz_Berthelot", "lorentz-berthelot"),
        ("forces", "electrostatics", "PME", "pme"),
        ("molecules.0", "model", "SPC/E", "spce"),
        ("molecules.0", "model", "TIP4P/2005", "tip4p2005"),
    ],
)
def test_case_and_hyphens_of_names_do_not_matter(table, key, given, meant):
    stage = {"ensemble": "nvt", "duration_ps": 1.0, "temperature_K": 300}
    data = {
        "box": {"lengths_A": 20.0},
        "molecules": [{"model": "spce", "count": 20}],
        "stages": [stage],
        "forces": {},
    }
    scene = Scene.from_dict(data, ".", {f"{table}.{key}": given})
    assert scene == Scene.from_dict(data, ".", {f"{table}.{key}": meant})
    assert f"'{meant}'" in repr(scene.model_dump()) and given not in repr(scene.model_dump())


def test_langevin_in_any_case_sets_the_integrator_and_user_rows_keep_their_names():
    stage = {"ensemble": "nvt", "duration_ps": 1.0, "temperature_K": 300, "thermostat": "Langevin"}
    assert small_scene({"spce": 20}, 20.0, stages=[stage]).stages[0].integrator == "baoab"
    row = {"name": "Velocity_Verlet", "steps": [1.0], "order": 2}
    with pytest.raises(SceneError, match="is an integrator of rigidmd"):
        small_scene({"spce": 20}, 20.0, integrators=[row])


def test_an_unknown_integrator_of_the_command(capsys, tmp_path):
    (tmp_path / "good.toml").write_text(GOOD)
    assert (
        main(["accuracy", str(tmp_path / "good.toml"), "--integrators", "velocity_verlet,SRKN6"])
        == 2
    )
    message = capsys.readouterr().err
    assert (
        "--integrators: unknown integrator SRKN6; did you mean srkn_6? (known: velocity_verlet"
        in message
    )


def test_the_command_and_the_scene_suggest_the_same_model(capsys, tmp_path):
    scene = refused(capsys, tmp_path, GOOD.replace("spce", "SPC-EE"))
    assert main(["models", "SPC-EE"]) == 2
    command = capsys.readouterr().err
    assert "did you mean spce?" in command
    assert scene.strip().endswith(command.removeprefix("rigidmd: models: ").strip())


def test_a_missing_file_names_the_option_that_gave_it(capsys, tmp_path):
    message = refused(capsys, tmp_path, GOOD, "--set", "structure.file=nowhere.gro")
    assert "bad.toml: --set structure.file: there is no such file" in message


def test_a_molecule_file_with_a_text_without_quotes(tmp_path):
    (tmp_path / "mine.toml").write_text("name = mine\n")
    with pytest.raises(MoleculeError, match=r"mine.toml: line 1: name: is mine without quotes"):
        read_molecule(tmp_path / "mine.toml")


@pytest.mark.parametrize(
    ("model", "density", "temperature", "fine", "too_long", "words"),
    [
        ("spce", 1.0, 300, 5, 20, "about its lightest axis by 0.41 rad"),
        ("nitrogen", 0.8, 77, 40, 120, "about its lightest axis by 0.33 rad"),
        ("argon", 1.37, 94, 40, 150, "moves by 0.06"),
    ],
)
def test_check_warns_of_a_step_that_no_liquid_bears(
    model, density, temperature, fine, too_long, words, capsys, tmp_path
):
    """Longest stable steps of these liquids, by `stiffest_mode` after 3 ps: 10.7, 63 and 90 fs."""
    text = GOOD.replace("lengths_A = 20.0", f"density_g_cm3 = {density}").replace(
        "= 300", f"= {temperature}"
    )
    text = text.replace("spce", model).replace("count = 20", "count = 400").replace("0.01", "1.0")
    for step, long in ((fine, False), (too_long, True)):
        (tmp_path / "liquid.toml").write_text(
            text.replace("timestep_fs = 1", f"timestep_fs = {step}")
        )
        assert main(["check", str(tmp_path / "liquid.toml")]) == 0
        warned = capsys.readouterr().err
        assert bool(warned) == long
        if long:
            for part in (
                f"stages.0: timestep_fs = {step} is too long for {model} at {temperature} K",
                words,
            ):
                assert part in warned


def test_a_step_is_long_for_what_moves_and_for_its_scheme():
    def warned(**more):
        stage = {"duration_ps": 1.0, "timestep_fs": 15.0} | more.pop("stage", {})
        molecules = [
            {"model": "spce", "count": 5, "frozen": more.pop("frozen", False)},
            {"model": "argon", "count": 5},
        ]
        return step_warnings(small_scene({}, 20.0, molecules=molecules, stages=[stage], **more))

    assert len(warned()) == 1
    assert not warned(frozen=True)
    assert len(warned(frozen=[1, 2])) == 1
    assert not warned(
        stage={"integrator": "srkn_4"}
    )  # stable up to 1.6 times as far, and more accurate
    assert not warned(watch={"stable_step": False})
    assert not warned(start={"temperature_K": 30.0})
    assert (
        len(
            warned(
                start={"temperature_K": 100.0}, stage={"temperature_K": 300.0, "ensemble": "nvt"}
            )
        )
        == 1
    )


@pytest.mark.parametrize("path", MOLECULES, ids=lambda path: path.stem)
def test_no_shipped_scene_has_too_long_a_step(path):
    assert step_warnings(Scene.read(path)) == []


def test_a_thermostat_cannot_warm_what_is_at_rest(capsys, tmp_path):
    text = GOOD.replace("duration_ps", 'ensemble = "nvt"\ntemperature_K = 90\nduration_ps').replace(
        "= 300", "= 0"
    )
    assert "cannot heat molecules at rest" in refused(capsys, tmp_path, text)


def test_the_good_scene_is_good(tmp_path, capsys):
    (tmp_path / "good.toml").write_text(GOOD)
    assert main(["run", str(tmp_path / "good.toml"), "-o", str(tmp_path / "out")]) == 0


def test_all_faults_at_once(capsys, tmp_path):
    text = (
        GOOD.replace("20.0", '"a"')
        .replace("count = 20", "count = -1")
        .replace("timestep_fs = 1", "timestep_fs = 0\nfoo = 1")
    )
    message = refused(capsys, tmp_path, text)
    assert "4 errors" in message
    for key in ("box.lengths_A", "molecules.0.count", "stages.0.timestep_fs", "stages.0.foo"):
        assert key in message


@pytest.mark.parametrize("command", ["run", "check", "energy", "accuracy", "sweep"])
@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ("nowhere.toml", "nowhere.toml: there is no such file. `rigidmd examples` lists scenes"),
        ("water", "water: there is no such file. `rigidmd new water` copies a shipped scene"),
        ("systems/water.toml", "there is no such file. `rigidmd new water` copies a shipped scene"),
        (
            "heavy_top.toml",
            "there is no such file. `rigidmd new heavy_top_1` copies a shipped scene",
        ),
        ("mien.toml", "there is no such file; did you mean mine.toml?"),
    ],
)
def test_a_missing_scene(command, path, expected, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    Path("mine.toml").write_text(GOOD)
    assert main([command, path, *(["--set", "seed=1,2"] if command == "sweep" else [])]) == 2
    assert expected in capsys.readouterr().err
    with pytest.raises(SceneError, match="there is no such file"):
        Scene.read(path)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["analyze", "runs/x"], "unknown command 'analyze'; did you mean analyse?"),
        (["acuracy", "x.toml"], "unknown command 'acuracy'; did you mean accuracy?"),
        (["foo"], "unknown command 'foo'. `rigidmd --help` lists them"),
        (
            ["run", "x.toml", "--forse"],
            "rigidmd run: error: unknown argument '--forse'; did you mean --force?",
        ),
        (["run", "x.toml", "--wall-time=1:00"], "'--wall-time=1:00'; did you mean --walltime?"),
        (["film", "x", "--fps", "3"], "rigidmd film: error: unknown argument '--fps'"),
        (["check", "x.toml", "y.toml"], "rigidmd check: error: unknown argument 'y.toml'"),
    ],
)
def test_a_command_line_that_is_not_known_suggests_what_is(words, expected, capsys):
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert expected in capsys.readouterr().err


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("restarts", "there are five_minutes, installation, why"),
        ("rdf", "the word is in five_minutes ("),
        ("anlysis", "did you mean analysis?"),
    ],
)
def test_help_finds_words_in_chapters(word, expected, capsys):
    assert main(["help", word]) == 2
    assert expected in capsys.readouterr().err


@pytest.mark.parametrize("until", ["1e999ps", "nanps", "-1ps"])
def test_times_of_the_command_line_are_finite(until, capsys):
    with pytest.raises(SystemExit):
        main(["run", "x.toml", f"--until={until}"])
    assert "is not a time with a unit" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["run", "x.toml", f"--walltime={'9' * 400}:00"])
    assert "is not H:MM:SS" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--span", "nan"], "time steps and --span must be between 1e-30 and 1e30"),
        (["--timesteps", "1,inf"], "time steps and --span must be between 1e-30 and 1e30"),
        (["--timesteps", "5e-324"], "time steps and --span must be between 1e-30 and 1e30"),
        (["--timesteps", "1e-20"], "more than 1e+12 steps"),
        (["--span", "1e20"], "more than 1e+12 steps"),
        (["--repeats", "0"], "--repeats must be at least 1"),
    ],
)
@pytest.mark.parametrize("kind", ["molecules", "body"])
def test_times_of_accuracy_are_in_their_range(kind, options, expected, capsys, tmp_path):
    scene = tmp_path / "good.toml"
    scene.write_text(GOOD)
    if kind == "body":
        shutil.copy(ROOT / "systems" / "heavy_top_3.toml", scene)
        expected = expected.replace("1e-30 and 1e30", "1e-100 and 1e100")
    assert main(["accuracy", str(scene), *options, "-o", str(tmp_path / "out")]) == 2
    assert expected in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--sample-ps", "1e300"], "time steps and --sample-ps must be between 1e-30 and 1e30"),
        (["--timesteps", "1e-20"], "more than 1e+12 steps"),
    ],
)
def test_times_of_averages_are_in_their_range(options, expected, capsys, tmp_path):
    scene = ROOT / "systems" / "argon.toml"
    options = [
        "--averages",
        "--set",
        "stages.1.ensemble=nvt",
        "--set",
        "stages.1.temperature_K=90",
        *options,
        "-o",
        str(tmp_path / "out"),
    ]
    assert main(["accuracy", str(scene), *options]) == 2
    assert expected in capsys.readouterr().err


def test_a_trusted_file_that_nothing_names_is_refused(capsys, tmp_path):
    (tmp_path / "own.py").write_text("")
    own = str(tmp_path / "own.py")
    assert "own.py is not a file that [[forces.custom]]" in refused(
        capsys, tmp_path, GOOD, "--trust", own
    )
    assert main(["sweep", str(tmp_path / "bad.toml"), "--set", "seed=1,2", "--trust", own]) == 2
    assert "own.py is not a file that [[forces.custom]]" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("stages.1.timestep_fs=4", "stages has entries 0 to 0"),
        ("stages.x.timestep_fs=4", "stages has entries 0 to 0"),
        ("molecules.spce.cont=4", "--set molecules.0.cont: unknown key; did you mean count?"),
        ("molecules.spc.count=4", "molecules has entries 0 to 0 ('spce'), not 'spc'"),
        (
            "box.density_g_cm3=1",
            "give lengths_A or density_g_cm3, not both; --set box.lengths_A= removes it",
        ),
        ("stages.0.timestep_fs.y=4", "stages.0.timestep_fs is not a table"),
        ("stages.0.timestep_fs=fast", "'fast', must be a number"),
        ("timestep_fs", "is not KEY=VALUE"),
        ("nonsense=1", "unknown key"),
        (
            "forces.cutoff_A=",
            "--set forces.cutoff_A=: the scene has no forces to remove; there are box, molecules",
        ),
        (
            "stages.0.timestep=",
            "--set stages.0.timestep=: stages.0 has no timestep to remove; did you mean timestep_fs?",
        ),
        ("molecules.1=", "molecules has entries 0 to 0, not '1'"),
        ("molecules.0=", "molecules: has 0 entries, needs at least 1"),
        ("stages.0.duration_ps=", "--set stages.0.duration_ps: is missing"),
        ("box.lengths_A.x=", "box.lengths_A is not a table"),
    ],
)
def test_a_bad_override(override, expected, capsys, tmp_path):
    assert expected in refused(capsys, tmp_path, GOOD, "--set", override)


def test_entries_of_lists_are_overridden_by_name(capsys, tmp_path):
    stages = '[[stages]]\nname = "production"\nduration_ps = 1\n[[stages]]\nensemble = "nvt"\ntemperature_K = 300\nduration_ps = 1\n'
    path = tmp_path / "two.toml"
    path.write_text(f"{GOOD}{stages}")
    found = Scene.read(
        path,
        {
            "stages.production.timestep_fs": 2,
            "stages.nvt.temperature_K": 310,
            "molecules.spce.count": 3,
        },
    )
    assert [stage.timestep_fs for stage in found.stages][1] == 2
    assert (found.stages[2].temperature_K, found.molecules[0].count) == (310, 3)
    assert len(Scene.read(path, {"stages.production": None}).stages) == 2
    assert main(["check", str(path), "--set", "stages.production.timestep_fs=-2"]) == 2
    assert "--set stages.1.timestep_fs: is -2, must be greater than 0" in capsys.readouterr().err
    path.write_text(path.read_text().replace('ensemble = "nvt"', 'name = "production"'))
    assert (
        main(["check", str(path), "--set", "stages.production.timestep_fs=2"]) == 2
    )  # which of the two?
    assert "stages has entries 0 to 2 ('', 'production', 'production')" in capsys.readouterr().err


def test_overrides_are_read_as_toml():
    assert parse_override("forces.cutoff_A=8.5") == ("forces.cutoff_A", 8.5)
    assert parse_override("molecules.0.model=tip3p") == ("molecules.0.model", "tip3p")
    assert parse_override("box.lengths_A=[1, 2.0, 3]") == ("box.lengths_A", [1, 2.0, 3])
    assert parse_override("output.trajectory=false") == ("output.trajectory", False)


def test_an_override_with_nothing_removes_the_key(tmp_path):
    path = tmp_path / "scene.toml"
    more = (
        "[[stages]]\nduration_ps = 0.02\ntimestep_fs = 4\n[forces]\ncutoff_A = 8.0\nskin_A = 1.0\n"
    )
    path.write_text(GOOD + more)

    def read(*texts):
        return Scene.read(path, dict(parse_override(text) for text in texts))

    assert read().forces.cutoff_A == 8.0
    assert (read("forces.cutoff_A=").forces.cutoff_A, read("forces.cutoff_A= ").forces.skin_A) == (
        None,
        1.0,
    )
    assert read("forces=").forces.skin_A == 1.9
    assert [stage.timestep_fs for stage in read("stages.0=").stages] == [4]
    assert read("stages.1.timestep_fs=").stages[1].timestep_fs is None
    with pytest.raises(
        SceneError, match=r"stages.0.name: is ''"
    ):  # an empty text is a value, here a wrong one
        read('stages.0.name=""')
    path.write_text(path.read_text().replace("timestep_fs = 4", "timestep_fs = -4"))
    with pytest.raises(
        SceneError, match=r"scene.toml: stages.0.timestep_fs: is -4, must be greater than 0"
    ):
        read("stages.0=")  # line 10, where stages.0 has its step, is another stage's


def test_the_help_tells_how_a_key_is_removed(capsys):
    with pytest.raises(SystemExit):
        main(["run", "--help"])
    assert "KEY= without a value removes the key" in " ".join(capsys.readouterr().out.split())


def test_too_dense_to_pack(capsys, tmp_path):
    text = (
        GOOD.replace("lengths_A = 20.0", "lengths_A = 8.0")
        .replace("count = 20", "count = 120")
        .replace("[start]", "[forces]\ncutoff_A = 3.9\n[start]")
    )
    scene = tmp_path / "dense.toml"
    scene.write_text(text)
    assert main(["run", str(scene), "-o", str(tmp_path / "out")]) == 2
    message = capsys.readouterr().err
    assert "cannot be packed" in message
    assert "Lower the density" in message
    assert not (tmp_path / "out").exists()


STRONG = """sites = [{ name = "A", mass_u = 20.0, position_A = [0.0, 0.0, 0.0], sigma_A = 3.0, \
epsilon_K = 50.0, charge_e = 1e6 }]"""


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("= 300", "= 1e-30", ["the molecules fit into the box", "1e-30 K are too low"]),
        ("= 300", "= 1e-6", ["the molecules fit into the box", "1e-06 K are too low"]),
        ('model = "spce"', f'name = "ion"\n{STRONG}', ["a charge_e is 1e+06 e, above 1000"]),
    ],
)
def test_forces_that_no_step_follows(old, new, expected, capsys, tmp_path):
    """The reason is not the density."""
    scene = tmp_path / "strong.toml"
    scene.write_text(GOOD.replace(old, new))
    assert main(["run", str(scene), "-o", str(tmp_path / "out")]) == 2
    message = capsys.readouterr().err
    assert all(part in message for part in expected), message
    assert "density" not in message
    assert not (tmp_path / "out").exists()


def test_output_folders(capsys, tmp_path):
    full = tmp_path / "mine"
    full.mkdir()
    (full / "thesis.txt").write_text("years of work")
    scene = tmp_path / "good.toml"
    scene.write_text(GOOD)
    for force in ([], ["--force"]):
        assert main(["run", str(scene), "-o", str(full), *force]) == 2
        assert "holds no earlier run" in capsys.readouterr().err
        assert (full / "thesis.txt").read_text() == "years of work"
    assert main(["run", str(scene), "-o", str(scene)]) == 2
    assert "is a file" in capsys.readouterr().err
    assert main(["run", str(scene), "-o", "/proc/here/there"]) == 2
    assert "cannot be" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("names", "resumes"), [((".rigidmd-run",), False), ((".rigidmd-run", "checkpoint.npz"), True)]
)
def test_a_folder_with_a_checkpoint_names_the_command_that_continues_it(names, resumes, tmp_path):
    for name in names:
        (tmp_path / name).touch()
    with pytest.raises(
        OutputError, match=r"holds an earlier run; .*force=True replaces it, folder=... names"
    ) as refused:
        check_folder(tmp_path, force=False)
    assert ("resume=True continues it" in str(refused.value)) == resumes
    assert "--" not in str(refused.value)
    with (
        worded_by(CommandLine()),
        pytest.raises(OutputError, match=r"; .*--force replaces it, -o names") as refused,
    ):
        check_folder(tmp_path, force=False)
    assert (f"`rigidmd resume {tmp_path}` continues it" in str(refused.value)) == resumes


def test_force_removes_only_what_a_run_wrote_and_never_its_own_inputs(capsys, tmp_path):
    scene = tmp_path / "good.toml"
    scene.write_text(GOOD)
    out = tmp_path / "out"
    assert main(["run", str(scene), "-o", str(out)]) == 0
    (out / "notes.txt").write_text("mine")
    assert main(["run", str(scene), "-o", str(out), "--force"]) == 0
    assert (out / "notes.txt").read_text() == "mine"
    kept = {path.name: path.read_bytes() for path in out.iterdir()}
    assert main(["run", str(out / "scene.toml"), "-o", str(out), "--force"]) == 2
    assert "is an input of this run" in capsys.readouterr().err
    restart = ["--set", f"structure.file={out / 'final.npz'}", "--set", "box.lengths_A=20.0"]
    assert main(["run", str(scene), *restart, "-o", str(out), "--force"]) == 2
    assert "is an input of this run" in capsys.readouterr().err
    assert {path.name: path.read_bytes() for path in out.iterdir()} == kept
    project = tmp_path / "project"
    project.mkdir()
    (project / "scene.toml").write_text(GOOD)
    assert main(["run", str(project / "scene.toml"), "-o", str(project), "--force"]) == 2
    assert (project / "scene.toml").read_text() == GOOD


def test_an_earlier_run_is_kept_when_the_new_scene_is_bad(capsys, tmp_path):
    scene = tmp_path / "good.toml"
    scene.write_text(GOOD)
    assert main(["run", str(scene), "-o", str(tmp_path / "out")]) == 0
    kept = (tmp_path / "out" / "summary.json").read_text()
    assert (
        main(
            [
                "run",
                str(scene),
                "-o",
                str(tmp_path / "out"),
                "--force",
                "--set",
                "forces.cutoff_A=19",
            ]
        )
        == 2
    )
    assert (tmp_path / "out" / "summary.json").read_text() == kept


@pytest.mark.parametrize(
    ("sites", "expected"),
    [
        ([(1.0, (0, 0, 0)), (1.0, (0, 0, 0)), (1.0, (1, 0, 0))], "coincide"),
        ([(0.0, (0, 0, 0)), (0.0, (1, 0, 0))], "massless"),
        ([(1.0, (0, 0, 0)), (0.0, (1, 0, 0))], "nothing resists its torque"),
        (
            [(1.0, (0, 0, 0)), (1.0, (0, 0, 1)), (0.0, (0.3, 0, 0.5))],
            "off the axis of a linear body",
        ),
    ],
)
def test_sites_that_make_no_body(sites, expected):
    with pytest.raises(MoleculeError, match=expected):
        molecule(
            "x",
            tuple(
                Site(name=f"A{k}", mass_u=m, position_A=tuple(map(float, x)))
                for k, (m, x) in enumerate(sites)
            ),
        )


# structure files


def structure_scene(tmp_path, text, name="start.gro", extra="", models=("spce",)):
    (tmp_path / name).write_text(text)
    species = "".join(f'[[molecules]]\nmodel = "{model}"\n' for model in models)
    return f'{species}{extra}[structure]\nfile = "{name}"\n[forces]\ncutoff_A = 5.0\n[start]\ntemperature_K = 300\n[[stages]]\nduration_ps = 0.01\n'


WATER216 = (ROOT / "systems" / "structures" / "water216.gro").read_text()


def lines_changed(change):
    lines = WATER216.splitlines()
    change(lines)
    return "\n".join(lines) + "\n"


def truncate(lines):
    del lines[400:]


def rename(lines):
    lines[2:5] = [
        line.replace("SOL", "ETH").replace("OW", "C1").replace("HW1", "C2") for line in lines[2:5]
    ]


def overlap(lines):
    shift = lines[2][20:44]
    lines[5] = lines[5][:20] + shift + lines[5][44:]
    for k in (1, 2):
        lines[5 + k] = lines[5 + k][:20] + lines[2 + k][20:44] + lines[5 + k][44:]


def bend(lines):
    lines[3] = lines[3][:20] + "   5.000   5.000   5.000" + lines[3][44:]


def wild_velocity(lines):
    lines[10] = lines[10][:44] + "     nan  0.0000  0.0000"


def nonsense(lines):
    lines[10] = lines[10][:20] + "     nan   0.000   0.000" + lines[10][44:]


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (truncate, ["promises 648 atoms", "truncated"]),
        (rename, ["molecule 1", "'ETH'", "C2 H", "expected spce (O H2)"]),
        (overlap, ["molecules 1 and 2 overlap"]),
        (bend, ["molecule 1", "is not spce", "from the rigid template"]),
        (wild_velocity, ["atom 9", "a velocity that is not a finite number"]),
        (nonsense, ["atom 9", "not a finite number"]),
    ],
)
def test_a_bad_structure_file(change, expected, capsys, tmp_path):
    message = refused(capsys, tmp_path, structure_scene(tmp_path, lines_changed(change)))
    for part in ["start.gro", *expected]:
        assert part in message


@pytest.mark.parametrize(("share", "code"), [(0.59, 2), (0.61, 0)])
def test_sites_overlap_within_six_tenths_of_their_diameter(share, code, capsys, tmp_path):
    sigma = load_model("argon").sigma[0]
    (tmp_path / "two.xyz").write_text(
        f"2\n\nAr 5.0 5.0 5.0\nAr {5.0 + share * sigma:.9f} 5.0 5.0\n"
    )
    (tmp_path / "two.toml").write_text(
        "box.lengths_A = 20.0\nforces.cutoff_A = 8.0\nstructure.file = 'two.xyz'\n"
        "start.temperature_K = 90.0\n[[molecules]]\nmodel = 'argon'\n[[stages]]\nduration_ps = 0.01\n"
    )
    assert main(["check", str(tmp_path / "two.toml")]) == code
    assert ("molecules 1 and 2 overlap" in capsys.readouterr().err) == (code == 2)


def test_the_box_of_the_scene_counts_for_a_saved_state_too(tmp_path):
    Simulation(small_scene({"argon": 20}, 20.0), tmp_path / "out").run()
    for box, edge in (({}, 20.0), ({"lengths_A": 40.0}, 40.0), ({"periodic": False}, np.inf)):
        data = small_scene({"argon": 20}, 20.0).model_dump() | {
            "box": box,
            "structure": {"file": "final.npz"},
        }
        assert build(Scene.from_dict(data, tmp_path / "out")).space.x == edge
    with np.load(tmp_path / "out" / "final.npz") as saved:
        good = dict(saved)
    for key, value in {
        "species": good["species"] + 5,
        "velocity": good["velocity"][:3],
        "position": good["position"] * np.nan,
    }.items():
        np.savez(tmp_path / "out" / "final.npz", **good | {key: value})
        with pytest.raises(StructureError, match=f"{key}.*: damaged"):
            build(Scene.from_dict(data, tmp_path / "out"))


def test_points_from_a_file_fit_wherever_they_are(tmp_path):
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(*[np.arange(4.0)] * 3), -1).reshape(-1, 3) * 5 + rng.random((64, 3))
    atoms = "".join(
        f"{k + 1:5d}AR      AR{k + 1:5d}{x[0] / 10:8.3f}{x[1] / 10:8.3f}{x[2] / 10:8.3f}\n"
        for k, x in enumerate(grid)
    )
    (tmp_path / "ar.gro").write_text(f"argon\n64\n{atoms}   2.00000   2.00000   2.00000\n")
    data = small_scene({"argon": 64}, None).model_dump() | {
        "box": {},
        "structure": {"file": "ar.gro"},
    }
    assert len(build(Scene.from_dict(data, tmp_path)).state.position) == 64


def test_structure_files_with_other_faults(capsys, tmp_path):
    assert "count is 200" in refused(
        capsys, tmp_path, structure_scene(tmp_path, WATER216, extra="count = 200\n")
    )
    assert "may be spce or spc:" in refused(
        capsys, tmp_path, structure_scene(tmp_path, WATER216, models=("spce", "spc"))
    )
    two = "1\n\nAr 0 0 0\n" * 2
    assert "holds 2 structures" in refused(
        capsys, tmp_path, structure_scene(tmp_path, two, "two.xyz", models=("argon",))
    )
    xyz = "3\n\nO 0 0 0\nH 0.8165 0.5774 0\nH -0.8165 0.5774 0\n"
    assert "has no box" in refused(capsys, tmp_path, structure_scene(tmp_path, xyz, "a.xyz"))
    text = (
        structure_scene(tmp_path, WATER216)
        .replace("[structure]", "[structure]\nvelocities = true")
        .replace("start.gro", "b.xyz")
        .replace("[start]\ntemperature_K = 300\n", "")
    )
    (tmp_path / "b.xyz").write_text(
        '3\nLattice="20 0 0 0 20 0 0 0 20"\nO 0 0 0\nH 0.8165 0.5774 0\nH -0.8165 0.5774 0\n'
    )
    assert "lacks velocities for some atoms" in refused(capsys, tmp_path, text)
    (tmp_path / "c.npz").write_bytes(b"not a zip file")
    assert "not a state that rigidmd wrote" in refused(
        capsys, tmp_path, text.replace("b.xyz", "c.npz")
    )


def test_molecules_by_order_and_by_geometry(tmp_path):
    """An .xyz has no residues: waters atom by atom, and one with all oxygens first, split across
    the boundary."""
    from rigidmd.assemble.structure import read_structure

    water, nitrogen = load_model("spce"), load_model("nitrogen")
    rng = np.random.default_rng(0)
    from rigidmd.mechanics.rotation import random_rotations

    centres = np.array([[0.1, 0.2, 9.9], [5.0, 5.0, 0.1], [9.95, 5.0, 5.0]])
    q = random_rotations(rng, 3)
    kinds = [water, nitrogen, water]
    atoms = [
        (m.elements[s], (c + r @ m.positions_body[s]) % 10)
        for m, c, r in zip(kinds, centres, q, strict=True)
        for s in range(len(m.masses))
    ]
    orders = {"file": atoms, "sorted": sorted(atoms, key=lambda atom: -ord(atom[0][0]))}
    for name, listed in orders.items():
        lines = [f"{e} {x[0]:.8f} {x[1]:.8f} {x[2]:.8f}" for e, x in listed]
        path = tmp_path / f"{name}.xyz"
        path.write_text(f'{len(lines)}\nLattice="10 0 0 0 10 0 0 0 10"\n' + "\n".join(lines) + "\n")
        found = read_structure(path, [water, nitrogen], None, True, 0.15)
        assert sorted(found.species.tolist()) == [0, 0, 1]
        assert found.residual_max < 1e-6
        for c in centres:
            step = found.position - c
            assert np.abs(step - 10 * np.round(step / 10)).max(axis=1).min() < 1e-6


def test_a_molecule_from_a_geometry_file(tmp_path):
    (tmp_path / "co2.xyz").write_text("3\n\nO 0 0 1.16\nC 0 0 0\nO 0 0 -1.16\n")
    sites = [
        {"name": "C", "charge_e": 0.7, "sigma_A": 2.8, "epsilon_K": 27.0},
        {"name": "O", "charge_e": -0.35, "sigma_A": 3.05, "epsilon_K": 79.0},
    ]
    data = small_scene({"argon": 5}, 25.0).model_dump()
    data["molecules"] = [{"file": "co2.xyz", "sites": sites, "count": 20}]
    system = build(Scene.from_dict(data, tmp_path))
    co2 = system.species[0]
    assert (co2.name, co2.kind, co2.charge) == ("co2", "linear", 0)
    assert co2.mass == pytest.approx(44.009, abs=1e-3)
    data["molecules"][0]["sites"] = sites[:1]
    with pytest.raises(SceneError, match="atom O: no entry of sites"):
        build(Scene.from_dict(data, tmp_path))


def test_a_run_that_blows_up_says_so_and_keeps_the_last_good_state(tmp_path):
    simulation = Simulation(
        small_scene({"spce": 20}, 20.0, watch={"move": False}), tmp_path / "out"
    )
    good = simulation.system.state.position.copy()
    simulation.system.state.velocity[7] = 1e150  # gone within a step
    with pytest.raises(
        SimulationError,
        match=r"step 1 .*molecule 8 \(spce\) is lost.*timestep_fs.*step 0 .*last_good_state",
    ):
        simulation.run()
    with np.load(tmp_path / "out" / "last_good_state.npz") as saved:
        assert saved["position"] == pytest.approx(good, abs=1.0)
        assert np.isfinite(saved["position"]).all()


@pytest.mark.parametrize("number", [5e-324, 1e-310, 1e-31, 1e300, -1e300])
@pytest.mark.parametrize("key", ["stages.0.timestep_fs", "start.temperature_K"])
def test_checks_of_tables_do_not_calculate_with_numbers_out_of_range(key, number, tmp_path):
    """Each such number has one message, next to those of other keys."""
    path = tmp_path / "good.toml"
    path.write_text(GOOD)
    with pytest.raises(SceneError) as raised:
        Scene.read(path, {key: number, "seed": -1})
    of_key, of_seed = raised.value.errors
    assert f"{key}: is {number:g}, must be 0 or between 1e-30 and 1e30" in of_key
    assert "seed" in of_seed


def test_files_and_keys_that_are_wrong_are_told_at_once(tmp_path):
    (tmp_path / "scene.toml").write_text(
        '[structure]\nfile = "../x.pdb"\n[[molecules]]\nmodel = "spce"\ncoont = 3\n[[molecules]]\nfile = "no.toml"\n'
        "[forces]\ncutoff_A = 1e300\n[[stages]]\nduration_ps = -1.0\n"
    )
    with pytest.raises(SceneError) as raised:
        Scene.read(tmp_path / "scene.toml")
    said = str(raised.value)
    for words in (
        "line 2: structure.file: '../x.pdb' is outside the scene's folder",
        "line 5: molecules.0.coont: unknown key",
        "line 7: molecules.1.file: there is no such file",
        "line 9: forces.cutoff_A: is 1e+300",
        "line 11: stages.0.duration_ps: is -1",
    ):
        assert words in said
