"""What a sweep varies: axes, names of points, errors of all points."""

import re

import pytest

from rigidmd.errors import SceneError
from rigidmd.features.studies.sweep import sweeping
from rigidmd.features.studies.sweep.folder import point_name, short_keys, value_name
from rigidmd.features.studies.sweep.plan import Axis, parse_axis, settings
from rigidmd.scene import parse_override
from rigidmd.scene.base import format_override


@pytest.mark.parametrize(
    ("text", "keys", "values"),
    [
        ("seed=1..4", ("seed",), (1, 2, 3, 4)),
        ("seed=1..3,7", ("seed",), (1, 2, 3, 7)),
        ("a.b=280, 290.5", ("a.b",), (280, 290.5)),
        ("a=-2..1", ("a",), (-2, -1, 0, 1)),
        ("a=spce,tip3p", ("a",), ("spce", "tip3p")),
        ("a=true,false", ("a",), (True, False)),
        ("a=[30,30,30],[31,31,31]", ("a",), ([30, 30, 30], [31, 31, 31])),
        ('a="x,y","z"', ("a",), ("x,y", "z")),
        ("a={b=1,c=[2,3]},{b=2,c=[4,5]}", ("a",), ({"b": 1, "c": [2, 3]}, {"b": 2, "c": [4, 5]})),
        ("a,b.c=1,2", ("a", "b.c"), (1, 2)),
    ],
)
def test_values_of_a_key(text, keys, values):
    assert parse_axis(text) == Axis(keys, values)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("a=3", 3),
        ("a=[1,2]", [1, 2]),
        ("a=", None),
        ('a="1,2"', "1,2"),
        ("a=x.gro", "x.gro"),
        ("a=../x.gro", "../x.gro"),
    ],
)
def test_one_value_is_the_same_for_all_points(text, value):
    assert parse_axis(text) == Axis(("a",), (value,), swept=False)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("seed", "is not KEY=VALUE"),
        ("=1,2", "is not KEY=VALUE"),
        ("a,=1,2", "is not KEY=VALUE"),
        ("seed=1,,2", "empty value"),
        ("seed=1,", "empty value"),
        ("seed=4..1", "the range 4..1 is empty"),
        ("seed=0.1..0.5", "not a range of whole numbers"),
        ("seed=1..10000000", "more than 100000 values"),
        ("a=[1,2", "brackets or quotation marks do not match"),
        ("a=1]", "brackets or quotation marks do not match"),
        ('a="x,y', "brackets or quotation marks do not match"),
        ("a=[1,2],x]", "brackets or quotation marks do not match"),
    ],
)
def test_values_that_are_none(text, expected):
    with pytest.raises(SceneError, match=re.escape(expected)):
        parse_axis(text)


def test_names_of_points():
    short = short_keys(["stages.0.temperature_K", "seed"])
    assert (
        point_name({"stages.0.temperature_K": 280.0, "seed": 1}, short)
        == "temperature_K=280_seed=1"
    )
    assert list(short_keys(["stages.0.timestep_fs", "stages.1.timestep_fs"]).values()) == [
        "0.timestep_fs",
        "1.timestep_fs",
    ]
    assert value_name([30, 30.5, 31]) == "30x30.5x31"
    assert (value_name(True), value_name(1e-5), value_name(0.1), value_name("spce")) == (
        "true",
        "1e-05",
        "0.1",
        "spce",
    )
    strange = [
        value_name(text)
        for text in ("../../etc", "..", "", "a b", "a/b", "a-b", "x" * 500, "é\n", "-")
    ]
    assert all(
        re.fullmatch(r"[\w.+\-]{0,60}", name) and not name.startswith(".") for name in strange
    )
    assert len({*strange}) == len(strange)
    long = [
        point_name(
            {f"key{k}": f"{'x' * 30}{end}" for k in range(9)},
            {f"key{k}": f"key{k}" for k in range(9)},
        )
        for end in "ab"
    ]
    assert long[0] != long[1]
    assert max(map(len, long)) < 140


def test_all_combinations_with_keys_that_go_together():
    axes = [Axis(("a", "b"), (1, 2)), Axis(("c",), (0,), swept=False), Axis(("seed",), (1, 2))]
    assert settings(axes) == [{"a": a, "seed": s} for a in (1, 2) for s in (1, 2)]


def test_cores_are_full(monkeypatch):
    monkeypatch.setattr(sweeping, "MOST_THREADS", 8)
    assert sweeping.jobs_and_threads(24, None, None) == (8, 1)
    assert sweeping.jobs_and_threads(3, None, None) == (3, 2)
    assert sweeping.jobs_and_threads(24, 2, None) == (2, 4)
    assert sweeping.jobs_and_threads(24, None, 4) == (2, 4)
    assert sweeping.jobs_and_threads(24, 16, None) == (16, 1)


@pytest.mark.parametrize(
    "value",
    [
        None,
        True,
        3,
        -0.25,
        1e-30,
        "spce",
        "a b,c",
        'quo"te\\',
        "3",
        [30, 30.5],
        ["x", "y"],
        {"between": [1, 2], "a key": {"x": "é"}},
    ],
)
def test_an_override_of_a_command_is_read_as_the_same_value(value):
    assert parse_override(format_override("a.b", value)) == ("a.b", value)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ([], "no key has several values"),
        (["--set", "seed=3"], "no key has several values"),
        (["--set", "seed=1..3", "--set", "seed=5,6"], "seed is set 2 times"),
        (["--set", "seed=4..1", "--set", "a=1,,2"], "2 errors"),
        (["--set", "seed=1,1"], "seed: 1 is listed 2 times"),
        (["--set", "start.temperature_K=90,90.0"], "90 is listed 2 times"),
        (["--set", "sed=1..3"], "did you mean seed?"),
        (
            ["--set", "seed=1..1000", "--set", "start.temperature_K=1..1000"],
            "these are 1000000 points",
        ),
        (["--replicas", "3", "--set", "seed=1..3"], "Leave out one of them"),
        (["--set", "seed=1..3", "--to", "slurm"], "needs --walltime"),
        (
            ["--set", "seed=1..3", "--to", "slurm", "--walltime", "1:00:00", "--collect"],
            "cannot be combined",
        ),
        (["--set", "seed=1..3", "--to", "commands", "--walltime", "1:00:00"], "starts no run"),
        (["--set", "seed=1..3", "--trust", "nothing.py"], "there is no such file"),
    ],
)
def test_bad_input(arguments, expected, argon, tmp_path, printed):
    assert expected in printed("sweep", argon, *arguments, "-o", tmp_path / "sweep", code=2).err
    assert not (tmp_path / "sweep").exists()


def test_all_errors_of_all_points_at_once(argon, tmp_path, printed):
    arguments = [
        "--set",
        "start.temperature_K=-5,100,cold",
        "--set",
        "forces.cutoff_A=8,12",
        "-o",
        str(tmp_path / "s"),
    ]
    said = printed("sweep", argon, *arguments, code=2).err
    assert "3 errors" in said
    assert (
        "at temperature_K = -5, cutoff_A = 8 and 1 more points: --set start.temperature_K: is -5"
        in said
    )
    assert "at temperature_K = 100, cutoff_A = 12: forces.cutoff_A = 12 is longer than half" in said
    assert "at temperature_K = cold" in said
    assert printed(
        "sweep",
        argon,
        "--set",
        "seed=1,2",
        "--set",
        "forces.cutoff_A=12",
        "-o",
        tmp_path / "s",
        code=2,
    ).err.startswith(f"rigidmd: {argon}: forces.cutoff_A = 12")
    assert not (tmp_path / "s").exists()
