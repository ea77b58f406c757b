"""The commands."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.common import ROOT, refused
from support.scenes import GOOD

import rigidmd
from rigidmd.commands.arguments import COMMANDS
from rigidmd.commands.cli import main
from rigidmd.errors import SceneError
from rigidmd.scene import Scene


def test_the_commands(printed, tmp_path):
    water = str(ROOT / "systems" / "water.toml")
    assert "1293 = 645 translation + 648 rotation" in printed("check", water).out
    out = printed("check", ROOT / "systems" / "argon.toml", "--verbose").out
    assert "charges: no site has one" in out
    assert "rotation and torques: every molecule is a point" in out
    assert "2.351" in printed("models").out  # the dipole of SPC/E
    schema = json.loads(
        printed("schema").out, parse_constant=lambda name: pytest.fail(f"{name} is not JSON")
    )
    assert "timestep_fs" in schema["$defs"]["Stage"]["properties"]
    out = printed(
        "check",
        water,
        "--set",
        "stages.production.timestep_fs=4",
        "--set",
        "molecules.0.model=tip3p",
    ).out
    assert "5000 steps of 4 fs" in out
    assert "216 tip3p" in out


def test_energy_of_the_dimer_in_every_unit(printed):
    dimer = str(ROOT / "systems" / "water_dimer.toml")
    found = {}
    for unit in ("kJ/mol", "kcal/mol", "eV", "K"):
        found[unit] = json.loads(printed("energy", dimer, "--json", "--unit", unit).out)
    assert found["kJ/mol"]["potential"] == pytest.approx(-30.124, abs=2e-3)
    assert found["kcal/mol"]["potential"] == pytest.approx(found["kJ/mol"]["potential"] / 4.184)
    assert found["eV"]["potential"] == pytest.approx(found["kJ/mol"]["potential"] / 96.48533212)
    assert found["K"]["potential"] == pytest.approx(
        found["kJ/mol"]["potential"] / 0.00831446261815324
    )
    assert found["kJ/mol"]["largest_force_per_A"] < 0.02  # a minimum, to the file's six digits
    assert "lennard jones" in printed("energy", dimer).out


def test_help_is_quick_and_imports_nothing_heavy():
    code = "import sys; from rigidmd.commands.cli import main\ntry: main(['--help'])\nexcept SystemExit: pass\nprint(sorted({'numba', 'numpy', 'ase', 'MDAnalysis', 'pydantic'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
    assert "example" in done.stdout


def test_help_has_four_groups_with_a_line_for_each_command(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    text = capsys.readouterr().out
    assert max(len(line) for line in text.splitlines()) <= 80
    listed = [line.split()[0] for line in text.splitlines() if re.match(r"  [a-z]+  ", line)]
    assert listed[0] == "new"
    assert set(COMMANDS) - set(listed) == {"schema"}  # which works without being listed
    assert re.findall(r"(?m)^([A-Z]\w+):$", text) == ["Start", "Run", "Look", "Study"]


def test_a_wrong_command_line_gives_the_message_first_and_an_example(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["virial", "spce"])
    assert ended.value.code == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].endswith("the following arguments are required: --temperatures")
    assert lines[1].startswith("  for example: rigidmd virial spce")


def test_adding_a_command_takes_one_file(tmp_path, monkeypatch, capsys, printed):
    (tmp_path / "greet.py").write_text(
        "from rigidmd.commands.arguments import command\n\n"
        "def arguments(parser):\n    parser.add_argument('name', metavar='NAME', help='whom to greet')\n\n"
        "@command('Start', 5, 'greet someone. Kindly', 'rigidmd greet Ada', arguments)\n"
        "def greet(options):\n    print(f'hello {options.name}')\n    return 3\n"
    )
    package = sys.modules["rigidmd.commands"]
    monkeypatch.setattr(package, "__path__", [*package.__path__, str(tmp_path)])
    with pytest.raises(SystemExit):
        main(["--help"])
    listed = capsys.readouterr().out
    assert listed.index("greet someone\n") < listed.index("copy a shipped")  # 5 is the first
    assert printed("greet", "Ada", code=3).out == "hello Ada\n"
    with pytest.raises(SystemExit):
        main(["gret"])
    assert "did you mean greet?" in capsys.readouterr().err.replace("'", "")
    del COMMANDS["greet"], sys.modules["rigidmd.commands.greet"]


def test_version():
    command = [sys.executable, "-m", "rigidmd", "--version"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.stdout.strip() == f"rigidmd {rigidmd.__version__}"


def test_output_goes_to_runs_by_default(tmp_path, monkeypatch, capsys, printed):
    monkeypatch.chdir(tmp_path)
    changes = ("stages.0.duration_ps=0.01", "stages.1.duration_ps=0.01", "output.figures=false")
    command = ["run", str(ROOT / "systems" / "argon.toml")]
    command += [part for change in changes for part in ("--set", change)]
    assert main(command) == 0
    assert (tmp_path / "runs" / "argon" / "summary.json").exists()
    out = capsys.readouterr().out
    assert "argon: 500 molecules, 500 sites, 1497 degrees of freedom" in out
    assert "results in runs/argon" in out
    assert "--force" in printed(*command, code=2).err
    assert main([*command, "--force"]) == 0


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
def test_a_file_that_is_not_a_scene_is_named(name, expected, command, printed, tmp_path):
    path = tmp_path / name
    match name:
        case "empty":
            path.mkdir()
        case "folder" | "run":
            path.mkdir()
            (path / {"folder": "water.toml", "run": "scene.toml"}[name]).write_text("")
        case _:
            path.write_text("; comment\nintegrator = md\n")
    assert expected in printed(command, path, code=2).err


def test_an_unknown_integrator_of_the_command(printed, tmp_path):
    (tmp_path / "good.toml").write_text(GOOD)
    message = printed(
        "accuracy", tmp_path / "good.toml", "--integrators", "velocity_verlet,SRKN6", code=2
    ).err
    assert (
        "--integrators: unknown integrator SRKN6; did you mean srkn_6? (known: velocity_verlet"
        in message
    )


def test_numbers_of_models_are_under_their_headers(printed):
    lines = printed("models").out.splitlines()
    header = next(line for line in lines if line.startswith("water "))
    places = [header.index("charges, e"), header.index("source")]
    for name in ("spce", "acetonitrile_opls", "so2"):
        line = next(line for line in lines if line.startswith(f"  {name} "))
        assert len(line) <= 100
        charges = line[places[0] : places[1]]
        assert all(charges[k] in "+-. " for k in (0, 8, 16)) and charges[:2].strip()
        assert line[places[1] - 1] == " " and line[places[1]].isupper()


def test_the_command_and_the_scene_suggest_the_same_model(capsys, printed, tmp_path):
    scene = refused(capsys, tmp_path, GOOD.replace("spce", "SPC-EE"))
    command = printed("models", "SPC-EE", code=2).err
    assert "did you mean spce?" in command
    assert scene.strip().endswith(command.removeprefix("rigidmd: models: ").strip())


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
def test_a_missing_scene(command, path, expected, printed, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    Path("mine.toml").write_text(GOOD)
    assert (
        expected
        in printed(
            command, path, *(["--set", "seed=1,2"] if command == "sweep" else []), code=2
        ).err
    )
    with pytest.raises(SceneError, match="there is no such file"):
        Scene.read(path)


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["analyze", "runs/x"], "unknown command 'analyze'; did you mean analyse?"),
        (["acuracy", "x.toml"], "unknown command 'acuracy'; did you mean accuracy?"),
        (["foo"], "unknown command 'foo'\n`rigidmd --help` lists the commands"),
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
        ("restarts", "no page is or contains 'restarts'; `rigidmd help` lists all"),
        ("anlysis", "did you mean analysis?"),
    ],
)
def test_help_suggests_a_page(word, expected, printed):
    assert expected in printed("help", word, code=2).err


def test_help_lists_the_pages_with_a_word_by_their_counts(printed):
    first, *best, _ = printed("help", "thermostat").out.splitlines()[:5]
    assert first.startswith("pages that contain the word: ")
    counts = [int(re.search(r"\((\d+)\): ", line)[1]) for line in best]
    assert len(counts) == 3 and counts == sorted(counts, reverse=True)


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
def test_times_of_accuracy_are_in_their_range(kind, options, expected, printed, tmp_path):
    scene = tmp_path / "good.toml"
    scene.write_text(GOOD)
    if kind == "body":
        shutil.copy(ROOT / "systems" / "heavy_top_3.toml", scene)
        expected = expected.replace("1e-30 and 1e30", "1e-100 and 1e100")
    assert expected in printed("accuracy", scene, *options, "-o", tmp_path / "out", code=2).err


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--sample-ps", "1e300"], "time steps and --sample-ps must be between 1e-30 and 1e30"),
        (["--timesteps", "1e-20"], "more than 1e+12 steps"),
    ],
)
def test_times_of_averages_are_in_their_range(options, expected, printed, tmp_path):
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
    assert expected in printed("accuracy", scene, *options, code=2).err


def test_the_help_states_how_a_key_is_removed(capsys):
    with pytest.raises(SystemExit):
        main(["run", "--help"])
    assert "KEY= without a value removes the key" in " ".join(capsys.readouterr().out.split())
