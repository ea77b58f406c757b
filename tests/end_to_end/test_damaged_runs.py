"""Files of a run that are not what a run writes: each command ends with one sentence, or takes
them."""

import copy
import json
import os
import random
import shutil

import pytest
from support.common import ROOT

from rigidmd import Scene, Simulation
from rigidmd.commands import cli
from rigidmd.errors import OutputError, RigidMDError
from rigidmd.features.analysis.files import ANALYSIS, read_results
from rigidmd.features.studies.compare import compare, describe_run_comparison
from rigidmd.features.studies.sweep.folder import Manifest, SweepPoint, read_manifest
from rigidmd.features.view.run_page import write_report
from rigidmd.io.run_files import Summary, read_json
from rigidmd.run.record import read_record

DEEP = "[" * 5000 + "]" * 5000
#: What a value of a file of JSON becomes, as text.
OTHERS = [
    "null",
    "3",
    "-1e300",
    "1e999",
    "NaN",
    '"text"',
    "[]",
    "{}",
    "[[1]]",
    '{"a": 1}',
    "true",
    "9" * 5000,
    DEEP,
    '"\\u0000"',
    '"</script><b>"',
]
#: For a cell of a file of CSV.
CELLS = [
    "",
    "x",
    "nan",
    "inf",
    "1e999",
    "-1e308",
    "\0",
    '"',
    "9" * 200_000,
    "0x1",
    "1,2",
    "\n",
    "\u2028",
    "é",
    "1_0",
    " 1 ",
]
ARGON = {
    "box": {"lengths_A": 30.0},
    "start": {"temperature_K": 90.0},
    "molecules": [{"model": "argon", "count": 20}],
    "stages": [{"name": "first", "duration_ps": 0.02}, {"duration_ps": 0.1}],
    "output": {"log_interval_ps": 0.004, "trajectory_interval_ps": 0.01, "figures": False},
}


@pytest.fixture(scope="module")
def argon(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "argon"
    Simulation(Scene.from_dict(copy.deepcopy(ARGON)), folder).run()
    assert cli.main(["analyse", str(folder), "--only", "rdf", "--from", "0.02ps"]) == 0
    return folder


@pytest.fixture(scope="module")
def top(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "top"
    scene = Scene.read(
        ROOT / "systems" / "heavy_top_3.toml", {"run.duration_s": 0.1, "output.figures": False}
    )
    Simulation(scene, folder).run()
    return folder


def copied(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "run", dirs_exist_ok=True)
    return tmp_path / "run"


def places(value, path=()):
    """Paths to all values of nested tables and lists."""
    yield path
    for key, inner in (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    ):
        yield from places(inner, (*path, key))


def replaced(data, path, text):
    """JSON with one value replaced by a text."""
    data = copy.deepcopy(data)
    if not path:
        return text
    inner = data
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = "PLACE"
    return json.dumps(data).replace('"PLACE"', text)


def taken(function, *arguments):
    """Whether a file is taken; it may be rejected with a sentence that names it."""
    try:
        function(*arguments)
    except OutputError as error:
        assert any(word in str(error) for word in (".json", ".csv", "has not written samples yet"))
        assert "\n" not in str(error)
        assert len(str(error)) < 1000
        return False
    return True


@pytest.mark.parametrize("which", ["argon", "top"])
def test_any_value_of_a_summary(which, request, tmp_path):
    source = request.getfixturevalue(which)
    folder, other = copied(source, tmp_path), source
    data, chosen = json.loads((source / "summary.json").read_text()), random.Random(1)
    every = [(path, text) for path in places(data) for text in OTHERS]
    found = [0, 0]
    for path, text in chosen.sample(every, min(len(every), 600)):
        (folder / "summary.json").write_text(replaced(data, path, text))
        found[taken(read_json, folder / "summary.json", Summary)] += 1
    assert min(found) > 5
    for k, (path, text) in enumerate(chosen.sample(every, 10)):
        (folder / "summary.json").write_text(replaced(data, path, text))
        describe_run_comparison(compare(folder, other))
        if taken(read_record, folder) and k < 2:
            taken(write_report, folder, tmp_path / "page.html")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"stages": "abc"}', "stages: is 'abc', must be a list"),
        ('{"stages": {"a": 1}}', "stages: is a table, must be"),
        ('{"stages": [{"name": 3}]}', "stages.0.name: is 3"),
        ('{"notes": 3}', "notes: is 3, must be a list"),
        ('{"notes": [[1]]}', "notes.0: is a list, must be a text"),
        ('{"wall_s": "long"}', "wall_s: is 'long'"),
        ('{"wall_s": NaN}', "wall_s: is nan"),
        ("[]", "is [], must be a table"),
        (DEEP, "cannot be read"),
        ("\0", "cannot be read"),
        ("\ud800", "cannot be read"),
    ],
)
@pytest.mark.parametrize("command", ["report", "view", "film", "analyse"])
def test_a_damaged_summary_is_named_with_its_field(command, text, said, argon, tmp_path, printed):
    folder = copied(argon, tmp_path)
    (folder / "summary.json").write_text(text, errors="surrogatepass")
    message = printed(command, folder, code=2).err
    assert f"{folder / 'summary.json'}" in message
    assert said in message
    assert message.count("\n") == 1


def test_any_value_of_an_analysis(argon, tmp_path):
    folder = copied(argon, tmp_path)
    data, chosen = json.loads((argon / ANALYSIS).read_text()), random.Random(2)
    every = [(path, text) for path in places(data) for text in OTHERS]
    found = [0, 0]
    for path, text in chosen.sample(every, min(len(every), 300)):
        (folder / ANALYSIS).write_text(replaced(data, path, text))
        found[taken(read_results, folder)] += 1
    assert min(found) > 5


def test_any_value_of_a_manifest(tmp_path):
    points = [SweepPoint(f"p{k}", {"seed": k}, "0" * 64) for k in range(2)]
    keys = {"seed": ["seed"]}
    manifest = Manifest("s", "s.toml", keys, {"a.b": 1}, {"c": [1]}, {"file": "0"}, points)
    manifest.folder = tmp_path
    manifest.write()
    data = json.loads((tmp_path / "sweep.json").read_text())
    assert read_manifest(tmp_path).points == points
    found = [0, 0]
    for path in places(data):
        for text in OTHERS:
            (tmp_path / "sweep.json").write_text(replaced(data, path, text))
            found[taken(read_manifest, tmp_path)] += 1
    assert min(found) > 5


@pytest.mark.parametrize(
    ("which", "name"), [("argon", "log.csv"), ("argon", "rdf.csv"), ("top", "motion.csv")]
)
def test_any_cell_of_a_table(which, name, request, tmp_path):
    source = request.getfixturevalue(which)
    folder, text = copied(source, tmp_path), (source / name).read_text()
    lines, chosen = text.splitlines(), random.Random(3)
    read = read_results if name == "rdf.csv" else read_record
    texts = [
        "",
        "\n",
        "\0",
        '"',
        "a\n",
        lines[0],
        lines[0] + "\n",
        "x" * 3_000_000,
        text[:-20],
        text.replace("\n", "\r\n"),
        "\ufeff" + text,
        text + "1,2\n",
        text * 2,
        ("," * 50_000 + "\n") * 2,
    ]
    for _ in range(25):
        row = chosen.randrange(len(lines))
        cells = lines[row].split(",")
        cells[chosen.randrange(len(cells))] = chosen.choice(CELLS)
        texts.append("\n".join([*lines[:row], ",".join(cells), *lines[row + 1 :], ""]))
    found, pages = [0, 0], 0
    for damaged in texts:
        (folder / name).write_text(damaged)
        ends = taken(read, folder)
        found[ends] += 1
        if ends and pages < 2:
            pages += taken(write_report, folder, tmp_path / "page.html")
        if name != "rdf.csv":
            try:
                describe_run_comparison(compare(folder, source))
            except OutputError as error:
                assert name in str(error)
    assert min(found) > 5


def put(kind, path, tmp_path):
    """What is not a file, in the position of one."""
    path.unlink(missing_ok=True)
    match kind:
        case "pipe":
            os.mkfifo(path)
        case "link to a device":
            path.symlink_to("/dev/zero")
        case "link to a pipe":
            os.mkfifo(tmp_path / "pipe")
            path.symlink_to(tmp_path / "pipe")
        case "folder":
            path.mkdir()
        case "broken link":
            path.symlink_to(tmp_path / "nothing")
        case "huge":
            path.touch()
            os.truncate(path, 10**13)


KINDS = ["pipe", "link to a pipe", "link to a device", "folder", "broken link", "huge"]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "name", ["summary.json", "log.csv", ANALYSIS, "rdf.csv", "scene.toml", "final.npz"]
)
def test_what_is_not_a_file_is_not_read(kind, name, argon, tmp_path):
    folder = copied(argon, tmp_path)
    put(kind, folder / name, tmp_path)
    if name == "scene.toml":
        with pytest.raises(
            RigidMDError, match=name if kind != "broken link" else "is not the folder of a run"
        ):
            read_record(folder)
        return
    if name != "final.npz":
        with pytest.raises(OutputError, match=name):
            (read_results if name in (ANALYSIS, "rdf.csv") else read_record)(folder)
    if "link" in kind and name in ("summary.json", "log.csv", "final.npz"):
        with pytest.raises(OutputError, match=f"{name} is a link out of its folder"):
            compare(folder, argon)
    elif name in ("summary.json", "log.csv") or (name == "final.npz" and kind != "huge"):
        assert any(name in text for text in compare(folder, argon).missing)


@pytest.mark.parametrize("name", ["summary.json", "log.csv"])
@pytest.mark.parametrize("command", ["report", "view", "film", "analyse", "compare"])
def test_a_pipe_hangs_no_command(command, name, argon, tmp_path, capsys):
    folder = copied(argon, tmp_path)
    put("pipe", folder / name, tmp_path)
    code = cli.main([command, str(folder), *([str(argon)] if command == "compare" else [])])
    said = capsys.readouterr()
    assert code == (1 if command == "compare" else 2)
    assert f"{folder / name} cannot be read: it is a pipe" in said.out + said.err


@pytest.mark.parametrize(
    "name", ["log.csv", "summary.json", "trajectory.xtc", "scene.toml", "rdf.csv"]
)
@pytest.mark.parametrize("command", ["report", "view", "analyse", "resume", "film"])
def test_no_link_out_of_the_folder_of_a_run_is_followed(command, name, argon, tmp_path, printed):
    folder = copied(argon, tmp_path)
    elsewhere = tmp_path / "elsewhere"
    if (folder / name).exists():
        (folder / name).rename(elsewhere)
    else:
        elsewhere.write_text("salary_of_alice,r (Å)\n1,2\n")
    (folder / name).symlink_to(elsewhere)
    said = printed(command, folder, code=2)
    assert (
        f"{folder / name} is a link out of its folder" in said.err
        and "salary" not in said.out + said.err
    )


def test_a_link_within_the_folder_of_a_run_is_followed(argon, tmp_path):
    folder = copied(argon, tmp_path)
    (folder / "log.csv").rename(folder / "log_of_the_run.csv")
    (folder / "log.csv").symlink_to("log_of_the_run.csv")
    assert len(read_record(folder).columns["time"]) == len(read_record(argon).columns["time"])
