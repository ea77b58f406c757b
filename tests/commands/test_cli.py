"""The commands."""

import json
import subprocess
import sys

import pytest
from support.common import ROOT

import rigidmd
from rigidmd.commands.arguments import COMMANDS
from rigidmd.commands.cli import main


def test_the_commands(capsys, tmp_path):
    water = str(ROOT / "systems" / "water.toml")
    assert main(["check", water]) == 0
    assert "1293 = 645 translation + 648 rotation" in capsys.readouterr().out
    assert main(["check", str(ROOT / "systems" / "argon.toml")]) == 0
    out = capsys.readouterr().out
    assert "charges: no site has one" in out
    assert "rotation and torques: every molecule is a point" in out
    assert main(["models"]) == 0
    assert "2.351" in capsys.readouterr().out  # the dipole of SPC/E
    assert main(["schema"]) == 0
    schema = json.loads(
        capsys.readouterr().out, parse_constant=lambda name: pytest.fail(f"{name} is not JSON")
    )
    assert "timestep_fs" in schema["$defs"]["Stage"]["properties"]
    assert (
        main(
            [
                "check",
                water,
                "--set",
                "stages.production.timestep_fs=4",
                "--set",
                "molecules.0.model=tip3p",
            ]
        )
        == 0
    )
    out = capsys.readouterr().out
    assert "5000 steps of 4 fs" in out
    assert "216 tip3p" in out


def test_energy_of_the_dimer_in_every_unit(capsys):
    dimer = str(ROOT / "systems" / "water_dimer.toml")
    found = {}
    for unit in ("kJ/mol", "kcal/mol", "eV", "K"):
        assert main(["energy", dimer, "--json", "--unit", unit]) == 0
        found[unit] = json.loads(capsys.readouterr().out)
    assert found["kJ/mol"]["potential"] == pytest.approx(-30.124, abs=2e-3)
    assert found["kcal/mol"]["potential"] == pytest.approx(found["kJ/mol"]["potential"] / 4.184)
    assert found["eV"]["potential"] == pytest.approx(found["kJ/mol"]["potential"] / 96.48533212)
    assert found["K"]["potential"] == pytest.approx(
        found["kJ/mol"]["potential"] / 0.00831446261815324
    )
    assert found["kJ/mol"]["largest_force_per_A"] < 0.02  # a minimum, to the file's six digits
    assert main(["energy", dimer]) == 0
    assert "lennard jones" in capsys.readouterr().out


def test_help_is_quick_and_imports_nothing_heavy():
    code = "import sys; from rigidmd.commands.cli import main\ntry: main(['--help'])\nexcept SystemExit: pass\nprint(sorted({'numba', 'numpy', 'ase', 'MDAnalysis', 'pydantic'} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
    assert "example" in done.stdout


def test_adding_a_command_takes_one_file(tmp_path, monkeypatch, capsys):
    (tmp_path / "greet.py").write_text(
        "from rigidmd.commands.arguments import command\n\n"
        "def arguments(parser):\n    parser.add_argument('name', metavar='NAME', help='whom to greet')\n\n"
        "@command(5, 'greet someone', 'rigidmd greet Ada', arguments)\n"
        "def greet(options):\n    print(f'hello {options.name}')\n    return 3\n"
    )
    package = sys.modules["rigidmd.commands"]
    monkeypatch.setattr(package, "__path__", [*package.__path__, str(tmp_path)])
    with pytest.raises(SystemExit):
        main(["--help"])
    listed = capsys.readouterr().out
    assert listed.index("greet someone") < listed.index(
        "list the scenes"
    )  # position 5 is before all others
    assert main(["greet", "Ada"]) == 3
    assert capsys.readouterr().out == "hello Ada\n"
    with pytest.raises(SystemExit):
        main(["gret"])
    assert "did you mean greet?" in capsys.readouterr().err.replace("'", "")
    del COMMANDS["greet"], sys.modules["rigidmd.commands.greet"]


def test_version():
    command = [sys.executable, "-m", "rigidmd", "--version"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.stdout.strip() == f"rigidmd {rigidmd.__version__}"


def test_output_goes_to_runs_by_default(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    changes = ("stages.0.duration_ps=0.01", "stages.1.duration_ps=0.01", "output.figures=false")
    command = ["run", str(ROOT / "systems" / "argon.toml")]
    command += [part for change in changes for part in ("--set", change)]
    assert main(command) == 0
    assert (tmp_path / "runs" / "argon" / "summary.json").exists()
    printed = capsys.readouterr().out
    assert "argon: 500 molecules, 500 sites, 1497 degrees of freedom" in printed
    assert "results in runs/argon" in printed
    assert main(command) == 2
    assert "--force" in capsys.readouterr().err
    assert main([*command, "--force"]) == 0
