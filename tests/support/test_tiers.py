"""The tiers of tests: which tests are extended; the record of the soak tier; processes of
tests."""

import ast
import re
import subprocess
import sys

import pytest

import rigidmd
from support import soak
from support.common import ROOT
from support.hooks import TIERS, pattern_in, tier_of
from support.processes import process


def test_the_record_names_the_last_run_and_the_last_one_that_passed(tmp_path, capsys):
    record = tmp_path / "record.jsonl"
    assert soak.when(record).splitlines() == [f"{part}: has not run" for part in soak.PARTS]
    assert soak.run("faults", [sys.executable, "-c", "print('1'); print('3 cases')"], record)
    assert not soak.run(
        "faults", [sys.executable, "-c", "print('seed 4 differs'); raise SystemExit(1)"], record
    )
    assert not soak.run("mutations", [sys.executable, "-c", "1 / 0"], record)
    capsys.readouterr()
    assert soak.main(["--when", "--record", str(record)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == [
        "statistics:",
        "faults:",
        "FAILED",
        "passed",
        "mutations:",
        "FAILED",
        "has",
    ]
    assert lines[2].endswith("seed 4 differs") and lines[3].endswith("3 cases")
    assert lines[5].endswith("ZeroDivisionError: division by zero")
    assert (tmp_path / "faults.txt").read_text() == "seed 4 differs\n"


def test_a_part_that_fails_fails_the_soak(tmp_path, monkeypatch):
    codes = {"statistics": 0, "faults": 1}
    monkeypatch.setattr(
        soak,
        "command_of",
        lambda part, minutes: [sys.executable, "-c", f"raise SystemExit({codes[part]})"],
    )
    record = ["--record", str(tmp_path / "new" / "record.jsonl")]
    assert soak.main(["statistics", *record]) == 0
    assert soak.main(["statistics", "faults", *record]) == 1


def test_every_pattern_of_a_tier_names_a_test():
    files = {(tier, file) for tier, patterns in TIERS.items() for file in patterns}
    for tier, file in files:
        tree = ast.parse((ROOT / "tests" / file).read_text(encoding="utf-8"))
        names = [node.name for node in tree.body if isinstance(node, ast.FunctionDef)]
        for pattern in TIERS[tier][file]:
            function = re.split(r"\[|\*", pattern)[0]
            assert any(name.startswith(f"test_{function}") for name in names), (file, pattern)
            assert pattern_in(tier, file, f"test_{pattern.replace('*', '')}"), (file, pattern)
    assert tier_of("run/test_simulation.py", "test_every_system_runs_a_few_steps[water]") is None


def test_processes_import_the_package_that_the_tests_import(tmp_path):
    """Not the one in their working directory, which may be a checkout."""
    (tmp_path / "rigidmd").mkdir()
    (tmp_path / "rigidmd" / "__init__.py").touch()
    command = [sys.executable, "-c", "import rigidmd; print(rigidmd.__file__)"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout.strip() == rigidmd.__file__, done.stderr


def test_no_process_outlives_its_test():
    command = [sys.executable, "-c", "import time; time.sleep(1000)"]
    with (
        pytest.raises(ValueError, match="of the test"),
        process(command, stdout=subprocess.PIPE) as asleep,
    ):
        raise ValueError("an error of the test")
    assert asleep.returncode is not None and asleep.stdout.closed
