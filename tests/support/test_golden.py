"""Golden digests: a record equals itself, and what differs is named."""

import json

import numpy as np
import pytest

from support import golden


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    path = tmp_path_factory.mktemp("golden") / "golden.json"
    assert golden.main(["record", str(path), "--only", "dropped_stone", "-j", "1"]) == 0
    return path


def compare(record, tmp_path, change):
    """The exit code of a comparison with a record after a change of its JSON."""
    values = json.loads(record.read_text())
    change(values)
    path = tmp_path / "changed.json"
    path.write_text(json.dumps(values))
    return golden.main(["compare", str(path), "--only", "dropped_stone", "-j", "1"])


RUN, CHECK = "dropped_stone[double, 1 thread]", "check dropped_stone"


def test_a_record_equals_itself(record, capsys, tmp_path):
    assert compare(record, tmp_path, lambda values: None) == 0
    assert "2 cases, 0 differences" in capsys.readouterr().out


def test_what_differs_is_named(record, capsys, tmp_path):
    def change(values):
        cases = values["cases"]
        cases[RUN]["checkpoint.npz"]["state/position"] = "SHA-256 0"
        cases[RUN]["summary.json"]["seed"] = "7"
        cases[CHECK]["check --program"][""] += "!"
        cases["dropped_stone again"] = {}

    assert compare(record, tmp_path, change) == 1
    *lines, total = capsys.readouterr().out.splitlines()
    assert total.startswith("2 cases, 4 differences")
    assert lines[0].startswith(f"{CHECK}: check --program: ")
    assert lines[1] == "dropped_stone again: is missing in this package"
    assert lines[2].startswith(f"{RUN}: checkpoint.npz (state/position): 'SHA-256 0' -> ")
    assert lines[3].startswith(f"{RUN}: summary.json (seed): '7' -> ")


def test_a_record_of_another_machine_is_refused(record, capsys, tmp_path):
    def change(values):
        values["machine"]["Python"] = "3.0"

    assert compare(record, tmp_path, change) == 1
    out = capsys.readouterr().out
    assert "Python: 3.0 in the record" in out and "bits differ between machines" in out


def test_digests_have_values_and_no_wall_times(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def digests(wall, value):
        values = {"wall_s": wall, "numba_version": str(wall), "seed": value}
        nested = {"of": {"run": {"position": {"seconds": wall, "time": value}}}}
        (tmp_path / "summary.json").write_text(
            json.dumps(values | {"files": [f"{tmp_path}/a"], "stages": [values]})
        )
        text = np.frombuffer(json.dumps(nested).encode(), np.uint8)
        np.savez("checkpoint.npz", values=text, position=np.arange(3.0) + value)
        (tmp_path / "log.csv").write_text(f'"Step","wall_s","Energy"\n0,{wall},{value}\n')
        return golden.parts_of(tmp_path)

    assert digests(1.0, 2.0) == digests(3.0, 2.0)
    named = golden.differences({"x": digests(1.0, 2.0)}, {"x": digests(1.0, 4.0)})
    assert [line.partition(":")[2].partition(":")[0] for line in named] == [
        " checkpoint.npz (of.run.position and 1 more)",
        " log.csv (Energy)",
        " summary.json (seed and 1 more)",
    ]
    for text in (
        "1 fs, 1,578 steps/s (124.8 ns/day)",
        "1 fs, 78 steps/s, 4.8 ns/day",
        "1 fs, 9 steps/s",
        "1 fs, run time 0.69 s, most of it output",
    ):
        assert golden.WALL_TIME.sub("", text) == "1 fs, "
