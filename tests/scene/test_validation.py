"""Bad scenes: each has one message that states what, where and what to do; nothing is written and no traceback shown."""

import pickle
import re
import tomllib

import pytest
from support.common import refused, small_scene
from support.scenes import GOOD

from rigidmd.assemble.build import build
from rigidmd.commands.cli import main
from rigidmd.errors import SceneError
from rigidmd.scene import Scene, parse_override


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
                "bad.toml: structure.atom_types is for formats whose atoms have types: .gsd, .xyz .extxyz, data files of LAMMPS (.data), dumps of LAMMPS"
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


def test_an_unknown_integrator_lists_the_names_once(capsys, tmp_path):
    for scheme in ("foo", "velocity-verlt"):
        message = refused(
            capsys, tmp_path, GOOD.replace("timestep_fs = 1", f'integrator = "{scheme}"')
        )
        assert message.count("srkn_6") == 1
        assert message.count("kahan_li_8") == 1


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


def test_a_missing_file_names_the_option_that_gave_it(capsys, tmp_path):
    message = refused(capsys, tmp_path, GOOD, "--set", "structure.file=nowhere.gro")
    assert "bad.toml: --set structure.file: there is no such file" in message


def test_a_thermostat_cannot_warm_what_is_at_rest(capsys, tmp_path):
    text = GOOD.replace("duration_ps", 'ensemble = "nvt"\ntemperature_K = 90\nduration_ps').replace(
        "= 300", "= 0"
    )
    assert "cannot heat molecules at rest" in refused(capsys, tmp_path, text)


def test_the_good_scene_is_good(tmp_path, capsys):
    (tmp_path / "good.toml").write_text(GOOD)
    arguments = ["-o", str(tmp_path / "out"), "--set", "forces.pme_order=6"]
    assert main(["run", str(tmp_path / "good.toml"), *arguments]) == 0


def test_all_errors_at_once(capsys, tmp_path):
    text = (
        GOOD.replace("20.0", '"a"')
        .replace("count = 20", "count = -1")
        .replace("timestep_fs = 1", "timestep_fs = 0\nfoo = 1")
    )
    message = refused(capsys, tmp_path, text)
    assert "4 errors" in message
    for key in ("box.lengths_A", "molecules.0.count", "stages.0.timestep_fs", "stages.0.foo"):
        assert key in message


def test_a_trusted_file_that_nothing_names_is_refused(capsys, printed, tmp_path):
    (tmp_path / "own.py").write_text("")
    own = str(tmp_path / "own.py")
    assert "own.py is not a file that [[forces.custom]]" in refused(
        capsys, tmp_path, GOOD, "--trust", own
    )
    assert (
        "own.py is not a file that [[forces.custom]]"
        in printed("sweep", tmp_path / "bad.toml", "--set", "seed=1,2", "--trust", own, code=2).err
    )


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


def test_entries_of_lists_are_overridden_by_name(capsys, printed, tmp_path):
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
    assert (
        "--set stages.1.timestep_fs: is -2, must be greater than 0"
        in printed("check", path, "--set", "stages.production.timestep_fs=-2", code=2).err
    )
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


def test_files_and_keys_that_are_wrong_are_reported_at_once(tmp_path):
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


def test_errors_are_in_the_order_of_lines(tmp_path):
    path = tmp_path / "s.toml"
    path.write_text(
        "seed = -1\n[box]\ndensity_g_cm3 = 0.9\n[structure]\nfile = 'x.gro'\n[forces]\n"
        "cutof_A = 6.0\nskin_A = -1\n[[molecules]]\nmodel = 'spce'\ncount = 0\n[[stages]]\n"
        "ensemble = 'nvx'\ntimestep = 3\n"
    )
    with pytest.raises(SceneError) as error:
        Scene.read(path)
    lines = [int(re.match(r"line (\d+): ", message)[1]) for message in error.value.errors]
    assert lines == sorted(lines) and lines[0] == 1 and len(lines) >= 7


def test_a_contradiction_of_tables_has_the_line_of_its_first_key(tmp_path):
    path = tmp_path / "s.toml"
    (tmp_path / "x.gro").write_text("")
    path.write_text(
        "[box]\ndensity_g_cm3 = 0.9\n[structure]\nfile = 'x.gro'\n[[molecules]]\nmodel = 'spce'\n"
        "[[stages]]\nduration_ps = 1\n"
    )
    with pytest.raises(SceneError) as error:
        Scene.read(path)
    first, second = error.value.errors
    assert first.startswith("line 2: box.density_g_cm3 and a structure file contradict")
    assert second.startswith("scene: start.temperature_K is missing")


@pytest.mark.parametrize("key", ["duration", "nsteps", "duration_ns"])
def test_a_key_that_is_written_wrongly_gives_one_error(key, tmp_path, capsys):
    text = GOOD.replace("duration_ps", key, 1)
    assert text != GOOD
    with pytest.raises(SceneError) as error:
        Scene.from_dict(tomllib.loads(text))
    (message,) = [line for line in error.value.errors if "duration" in line]
    assert "unknown key" in message and "duration_ps" in message


def test_an_ensemble_without_its_keys_has_an_example():
    stages = [{"ensemble": "npt", "temperature_K": 300.0, "duration_ps": 1.0}]
    with pytest.raises(SceneError, match="needs pressure_bar, for example pressure_bar = 1"):
        small_scene({"argon": 20}, 30.0, stages=stages)


def test_a_bracket_that_is_not_closed_has_line_and_position(tmp_path):
    path = tmp_path / "s.toml"
    path.write_text(GOOD + '\n[[forces.custom]]\nname = "x"\nenergy = "A*exp(-B*r"\n')
    with pytest.raises(SceneError) as error:
        Scene.read(path)
    line = len(path.read_text().splitlines())
    assert f"line {line}: forces.custom.0.energy: the bracket at position 6 is not closed" in str(
        error.value
    )


def test_errors_after_reading_have_the_line_of_their_first_key(tmp_path):
    """Checks of the resolved scene, unless the command line has set the key."""
    path = tmp_path / "scene.toml"
    path.write_text(
        '[box]\nlengths_A = 11\n[[molecules]]\nmodel = "spce"\ncount = 8\n[forces]\ncutoff_A = 6\n'
        '[start]\ntemperature_K = 300\n[[stages]]\nensemble = "nve"\nduration_ps = 1\n'
    )
    with pytest.raises(SceneError) as wrong:
        build(Scene.read(path))
    assert wrong.value.errors[0].startswith("line 7: forces.cutoff_A = 6 is longer than half")
    with pytest.raises(SceneError) as wrong:
        build(Scene.read(path, {"forces.cutoff_A": 7.0}))
    assert wrong.value.errors[0].startswith("forces.cutoff_A = 7 is longer than half")
    source = Scene.read(path, {"forces.cutoff_A": 5.0}).source
    assert source == str(path)
    assert pickle.loads(pickle.dumps(source)).locate("stages.0: duration_ps is") == (
        "line 12: stages.0: duration_ps is"
    )
    assert str(SceneError(source, ["stages.0: an npt stage"])).endswith(
        "line 10: stages.0: an npt stage"
    )
    assert source.locate("molecules overlap") == "molecules overlap"
