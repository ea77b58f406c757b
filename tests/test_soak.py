"""The record of the soak tier: what is told of parts that passed, that failed and that have not
run."""

import sys

import soak


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
