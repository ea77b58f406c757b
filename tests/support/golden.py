"""Digests of all that the package computes and prints: recorded before a change that must change no
bit, compared after it.

    python tests/support/golden.py record /tmp/golden.json
    python tests/support/golden.py compare /tmp/golden.json

A case is a run, a command or a table of spoilt scenes. It has parts (files and printed texts), and a
part has members: the arrays of a .npz file, the columns of a table, the keys of a JSON file. Wall
times, versions and paths are left out. A record is of one machine, and is never committed. The
package is the one that Python imports. Only its public interface is used, so that modules may move.
"""

import argparse
import ast
import contextlib
import copy
import csv
import hashlib
import io
import json
import os
import platform
import re
import shutil
import sys
import tempfile
import tomllib
import traceback
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from importlib.metadata import version
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from llvmlite import binding
from tqdm import tqdm

import rigidmd
from rigidmd.commands.cli import main as rigidmd_main

ROOT = Path(__file__).parents[2]
sys.path[:0] = [str(ROOT / "tests")]  # as a script
from support import scenes, schema_scenes  # noqa: E402

Tables = dict[str, Any]
Parts = dict[str, dict[str, str]]  # part -> member -> digest

LONGEST_LINE = 200  # characters of a line that is printed
STEPS, BODY_STEPS = 40, 1000
THREADS = (1, 2)
LONGEST = (
    4000  # characters of a text that is stored in place of its digest, so that it can be shown
)
TIMESTEP_FS = 5.0  # of stages without one, which is at most as long
#: Keys of JSON files whose values are wall times, versions or the machine.
NOT_COMPARED = re.compile(
    r".*_version|machine|processor|processor_features|vector_bits|with"
    r"|preparing_s|wall_s|computing_s|steps_per_s|ns_per_day|computing|seconds"
)
#: Wall times and free memory in printed texts, and announcements of slow work.
WALL_TIME = re.compile(
    r"(?m)[\d.,e+]+ steps/s(,? \(?[\d.,e+]+ ns/day\)?)?|(?<=; )[\d.,e+]+ s$|[\d.e+]+ GB free"
    r"|run time [\d.e+-]+ s, most of it output|^  .* \.\.\.\n"
)
FIGURES = {".png", ".svg", ".html"}
SCENES = {
    name: (tomllib.loads(text), changes)
    for name, (text, changes) in (
        {
            name: (text, {})
            for name, text in (schema_scenes.MOLECULES | schema_scenes.BODIES).items()
        }
        | schema_scenes.VARIANTS
        | schema_scenes.BODY_VARIANTS
    ).items()
}
#: Changes of the stages of schema_scenes.BAROSTATS, for the other barostats and couplings.
BAROSTATS = {
    "anisotropic": {},
    "piston": {
        "ensemble": "nph",
        "pressure_bar": 10.0,
        "temperature_K": None,
        "thermostat_time_ps": None,
        "compressibility_per_bar": None,
        "pressure_coupling": None,
    },
    "isotropic": {"pressure_coupling": "isotropic", "pressure_bar": [1.0, 100.0]},
    "flexible": {
        "pressure_coupling": "flexible",
        "pressure_bar": [1.0, 2.0, 3.0, 0.1, 0.2, 0.3],
    },
} | {
    coupling: {"pressure_coupling": coupling, "pressure_bar": 20.0}
    for coupling in ("semi_isotropic", "normal", "lateral")
}
#: What replaces the value of a key, one at a time.
ODD = ("text", "", -1, 0, 1, 7.3, 1e30, 2**63, True, [], [1.0, -2.0], {}, {"a": 1})


# --- digests --------------------------------------------------------------------------------------


def digest(value: str | bytes) -> str:
    """A short text itself, otherwise a SHA-256."""
    if isinstance(value, str):
        if len(value) <= LONGEST:
            return value
        value = value.encode()
    return f"SHA-256 {hashlib.sha256(value).hexdigest()[:32]}"


def compared(value: Any) -> Any:
    """JSON without wall times, versions and paths of folders."""
    if isinstance(value, dict):
        calls = {k: count for k, (count, _) in value.get("forces_by_python", {}).items()}
        values = value | ({"forces_by_python": calls} if calls else {})
        return {k: compared(v) for k, v in values.items() if not NOT_COMPARED.fullmatch(k)}
    if isinstance(value, list):
        return [compared(entry) for entry in value]
    return value.replace(f"{Path.cwd()}/", "") if isinstance(value, str) else value


def members_of(path: Path) -> dict[str, str]:
    """The digests of what a file holds."""
    if path.suffix == ".npz":
        with np.load(path) as archive:
            arrays = {name: archive[name] for name in archive.files}
        arrays = {name: array for name, array in arrays.items() if isinstance(array, np.ndarray)}
        values = json.loads(arrays.pop("values").tobytes()) if "values" in arrays else {}
        return members_of_json(values) | {
            name: digest(f"{array.dtype}{array.shape}".encode() + array.tobytes())
            for name, array in arrays.items()
        }
    if path.suffix == ".json":
        return members_of_json(json.loads(path.read_text()))
    if path.suffix == ".csv":
        rows = list(csv.reader(path.read_text().splitlines()))
        columns = {rows[0][k]: column for k, column in enumerate(zip(*rows[1:], strict=True))}
        return {
            name: digest("\n".join(column))
            for name, column in columns.items()
            if not NOT_COMPARED.fullmatch(name)
        }
    return {"": digest(path.read_bytes())}


def members_of_json(values: Any, depth: int = 3, name: str = "") -> dict[str, str]:
    if not isinstance(values, dict) or depth == 0:
        return {name: digest(json.dumps(compared(values), sort_keys=True))}
    inner = [
        members_of_json(value, depth - 1, f"{name}.{key}".lstrip("."))
        for key, value in compared(values).items()
    ]
    return {key: value for members in inner for key, value in members.items()}


def parts_of(folder: Path) -> Parts:
    """The digests of all files of a folder, without figures."""
    return {
        path.relative_to(folder).as_posix(): members_of(path)
        for path in sorted(folder.rglob("*"))
        if path.is_file()
        and path.suffix not in FIGURES
        and not path.name.startswith((".", "checkpoint_previous"))
    }


def printed(*arguments: str, code: int | None = None) -> str:
    """What a command prints, with its exit code, without wall times. Raises RuntimeError if the exit
    code is not the given one."""
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        try:
            ended = rigidmd_main(list(arguments))
        except SystemExit as end:
            ended = int(end.code or 0)
    text = WALL_TIME.sub("", output.getvalue())
    for folder in (Path.cwd(), sys.prefix):  # of this case, and of Python
        text = text.replace(f"{folder}/", "")
    if code is not None and ended != code:
        raise RuntimeError(f"{' '.join(arguments)} ends with {ended}: {text}")
    return f"{text}exit code {ended}"


# --- scenes ---------------------------------------------------------------------------------------


def changed(tables: Tables, changes: Tables) -> Tables:
    """Tables with other values at dotted keys. None removes a key."""
    tables = copy.deepcopy(tables)
    for key, value in changes.items():
        target: Any = tables
        *parents, last = [int(part) if part.isdigit() else part for part in key.split(".")]
        for parent in parents:
            target = target.setdefault(parent, {}) if isinstance(target, dict) else target[parent]
        if value is not None:
            target[last] = value
        elif isinstance(last, int) or last in target:
            del target[last]
    return tables


def shortened(tables: Tables) -> Tables:
    """Tables with a few steps in each stage, and rows of the log."""
    tables = copy.deepcopy(tables)
    output = tables.setdefault("output", {})
    output["figures"] = False
    if "body" in tables:
        step = tables["run"]["timestep_s"]
        tables["run"]["duration_s"] = BODY_STEPS * step
        output["interval_s"] = BODY_STEPS // 20 * step
        return tables
    steps = []
    for stage in tables["stages"]:
        if stage.get("ensemble") != "minimise":
            steps.append(stage.get("timestep_fs", TIMESTEP_FS) / 1000)
            stage["duration_ps"] = STEPS * steps[-1]
    intervals = {"log_interval_ps": 4, "trajectory_interval_ps": 10}
    if "pressure_tensor_interval_ps" in output:
        intervals["pressure_tensor_interval_ps"] = 4
    output |= {key: count * min(steps) for key, count in intervals.items()}
    return tables


def write(tables: Tables, name: str = "scene") -> str:
    """Write a scene and what it may read into the working directory. Returns its path."""
    if not Path("structures").exists():
        shutil.copytree(ROOT / "systems" / "structures", "structures")
    Path("argon.xyz").write_text(
        '1\nLattice="9.0 0 0 0 9.0 0 0 0 9.0" pbc="T T T"\nAr 1.0 2.0 3.0\n'
    )
    path = Path(f"{name}.toml")
    path.write_text(tomli_w.dumps(tables))
    return path.name


# --- cases ----------------------------------------------------------------------------------------


def run(name: str, tables: Tables, threads: int) -> Parts:
    options = () if "body" in tables else ("--threads", str(threads))
    text = printed("run", write(tables, name), "-o", "run", "-v", *options, code=0)
    return parts_of(Path("run")) | {"output": {"": digest(text)}}


def resumed_run(tables: Tables) -> Parts:
    """A run that is stopped within its second stage."""
    with rigidmd.Simulation(write(tables), "run") as simulation:
        simulation.step(STEPS + STEPS // 2)
    stopped = {f"stopped {name}": members for name, members in parts_of(Path("run")).items()}
    text = printed("resume", "run", code=0)
    return stopped | parts_of(Path("run")) | {"output": {"": digest(text)}}


class Spring(rigidmd.Force):
    """A force in Python that binds each molecule to the origin."""

    def on_molecules(self, state):
        return 0.5 * (state.position**2).sum(), -state.position, np.zeros_like(state.position)


def user_forces(tables: Tables) -> Parts:
    """A force in Python, and a pair potential from a formula."""
    potential = rigidmd.pair_potential(
        "4*e*((s/r)**9 - (s/r)**6)", {"Ar": {"e": 0.5, "s": 3.3}}, name="soft", truncation="switch"
    )
    scene = rigidmd.Scene.from_dict(changed(tables, {"forces.tail_correction": False}))
    rigidmd.Simulation(scene, "run", forces=[Spring(), potential]).run()
    return parts_of(Path("run"))


def sweep(tables: Tables) -> Parts:
    path = write(tables)
    text = printed(
        "sweep", path, "--set", "coupling.lambda=0.3,0.6", "--jobs", "1", "-o", "sweep", code=0
    )
    return parts_of(Path("sweep")) | {"output": {"": digest(text)}}


def checks(tables: Tables) -> Parts:
    path = write(tables)
    commands = (("check",), ("check", "--program"), ("energy", "--json"))
    return {
        " ".join(words): {"": digest(printed(words[0], path, *words[1:]))} for words in commands
    }


def texts() -> Parts:
    """What commands without a scene print, and their help."""
    help_text = printed("--help")
    commands = re.findall(r"(?m)^    (\w+)  ", help_text)
    printing = [["schema"], ["models"], ["models", "spce"], ["examples"], ["help"]]
    printing += [[name, "--help"] for name in commands]
    return {"--help": {"": digest(help_text)}} | {
        " ".join(words): {"": digest(printed(*words))} for words in printing
    }


def spoilt_scenes(name: str) -> Parts:
    """The messages of a scene with one key that is removed, misspelt, or has an odd value."""
    tables = tables_of(name)
    messages = {}
    for key, value in spoilt_keys()[name]:
        changes = [{key: None}, {key: None, f"{key}x": value}, *({key: odd} for odd in ODD)]
        for change in changes:
            path = write(changed(tables, change))
            messages[str(change)] = digest(printed("check", path))
    return {"messages": messages}


def tables_of(name: str) -> Tables:
    return changed(*SCENES[name])


def spoilt_keys() -> dict[str, list[tuple[str, Any]]]:
    """By scene, keys and values: each key in the first scene that has it."""
    known: set[str] = set()
    keys: dict[str, list[tuple[str, Any]]] = {}
    for name in SCENES:
        keys[name] = []
        for key, value in leaves(tables_of(name)):
            plain = re.sub(r"\.\d+", "", key)
            if plain not in known:
                keys[name].append((key, value))
            known.add(plain)
    return keys


def leaves(tables: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and values of tables and of lists of tables."""
    for key, value in tables.items() if isinstance(tables, dict) else enumerate(tables):
        name = f"{prefix}{key}"
        if isinstance(value, dict) or (isinstance(value, list) and isinstance(value[0], dict)):
            yield from leaves(value, f"{name}.")
        elif isinstance(tables, dict):
            yield name, value


def tests_of_messages() -> Parts:
    """The messages of the scenes, overrides and command lines in tables of tests: a table is read
    from the source of its test."""
    texts = {"good": scenes.GOOD, "body": scenes.SATELLITE, "file": scenes.FROM_FILE}
    texts |= schema_scenes.MOLECULES | schema_scenes.BODIES
    write({})
    messages = {}
    for names, row in test_tables():
        values = dict(zip(names, row, strict=True))
        if isinstance(old := values.get("old"), str) and isinstance(values.get("new"), str):
            text = next((text for text in texts.values() if old in text), "")
            Path("scene.toml").write_text(text.replace(old, values["new"]))
            name, command = f"{old!r} -> {values['new']!r}", ["check", "scene.toml"]
        elif isinstance(values.get("override"), str):
            Path("scene.toml").write_text(scenes.GOOD)
            name = f"--set {values['override']}"
            command = ["check", "scene.toml", "--set", values["override"]]
        else:
            continue
        messages[name if len(name) <= LONGEST_LINE else digest(name.encode())] = digest(
            printed(*command)
        )
    return {"messages": messages}


def test_tables() -> Iterator[tuple[list[str], tuple]]:
    """Names and values of the rows, of literals, of parametrised tests."""
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not (isinstance(node, ast.Call) and ast.unparse(node.func).endswith("parametrize")):
                continue
            with contextlib.suppress(ValueError):
                names = ast.literal_eval(node.args[0])
                names = names.replace(" ", "").split(",") if isinstance(names, str) else names
                for row in node.args[1].elts if isinstance(node.args[1], ast.List) else ():
                    with contextlib.suppress(ValueError):
                        values = ast.literal_eval(row)
                        values = values if len(names) > 1 else (values,)
                        if isinstance(values, tuple) and len(values) == len(names):
                            yield list(names), values


def cases() -> dict[str, Callable[[], Parts]]:
    """All cases by name, those that take long first."""
    shipped = {
        path.stem: tomllib.loads(path.read_text())
        for path in sorted((ROOT / "systems").glob("*.toml"))
    }
    running = {name: shortened(tables) for name, tables in shipped.items()}
    for name in SCENES:
        tables = tables_of(name)
        if name != "barostats" and "engine" not in tables and "auto" not in str(tables):
            running[f"schema {name}"] = shortened(tables)
    gas = changed(tables_of("barostats"), {"box.density_g_cm3": 0.3})  # so that it may contract
    for name, changes in BAROSTATS.items():
        changes = {f"stages.0.{key}": value for key, value in changes.items()}
        running[f"barostat {name}"] = shortened(changed(gas, changes))
    found: dict[str, Callable[[], Parts]] = {}
    for name, tables in sorted(running.items(), key=lambda item: "body" in item[1]):
        for precision in ("double",) if "body" in tables else ("mixed", "double"):
            for threads in THREADS[:1] if "body" in tables else THREADS:
                scene = tables if "body" in tables else tables | {"precision": precision}
                title = f"{name}[{precision}, {threads} thread{'s' * (threads > 1)}]"
                found[title] = partial(run, name.replace(" ", "_"), scene, threads)
    found |= {f"messages of {name}": partial(spoilt_scenes, name) for name in SCENES}
    found |= {
        "messages of tests": tests_of_messages,
        "resumed run": partial(resumed_run, running["barostat anisotropic"]),
        "user forces": partial(user_forces, shortened(tables_of("argon"))),
        "sweep of a coupling": partial(sweep, shortened(tables_of("coupled"))),
        "texts": texts,
    }
    return found | {f"check {name}": partial(checks, tables) for name, tables in shipped.items()}


# --- record and compare ---------------------------------------------------------------------------


def measure(names: list[str]) -> dict[str, Parts]:
    """The digests of cases. One that fails has the part "failed"."""
    known, measured = cases(), {}
    for name in names:
        with (
            tempfile.TemporaryDirectory() as folder,
            contextlib.chdir(folder),
            warnings.catch_warnings(action="ignore"),
        ):
            try:
                measured[name] = known[name]()
            except Exception:
                measured[name] = {"failed": {"": traceback.format_exc()}}
    return measured


def measure_all(pattern: str, jobs: int) -> dict[str, Parts]:
    """The digests of all cases whose names match. Cases of one scene and precision run in one
    process, which loads their kernels once."""
    groups: dict[str, list[str]] = {}
    for name in cases():
        if re.search(pattern, name):
            groups.setdefault(name.partition(",")[0], []).append(name)
    measured: dict[str, Parts] = {}
    with contextlib.ExitStack() as stack:
        if jobs == 1:
            results: Any = map(measure, groups.values())
        else:
            pool = stack.enter_context(ProcessPoolExecutor(jobs))
            futures = [pool.submit(measure, names) for names in groups.values()]
            results = (future.result() for future in as_completed(futures))
        for part in tqdm(results, total=len(groups), disable=None, leave=False):
            measured |= part
    return dict(sorted(measured.items()))


def machine() -> dict[str, str]:
    """What the bits depend on besides the package."""
    names = [name for name, on in binding.get_host_cpu_features().items() if on]
    libraries = ("numpy", "numba", "llvmlite", "scipy", "rocket-fft", "ase", "MDAnalysis")
    settings = {
        name: value
        for name, value in os.environ.items()
        if name.startswith(("RIGIDMD_SIMD", "NUMBA_"))
    }
    return {
        "computer": platform.node(),
        "processor": f"{platform.machine()} {binding.get_host_cpu_name()} {' '.join(sorted(names))}",
        "cores": str(len(os.sched_getaffinity(0))),
        "Python": platform.python_version(),
        "libraries": ", ".join(f"{name} {version(name)}" for name in libraries),
        "settings": str(dict(sorted(settings.items()))),
    }


def differences(before: dict[str, Parts], after: dict[str, Parts]) -> list[str]:
    """A line for each part of a case that differs."""
    lines = []
    for case in sorted(before.keys() | after.keys()):
        if case not in before or case not in after:
            where = "the record" if case not in before else "this package"
            lines.append(f"{case}: is missing in {where}")
            continue
        old, new = before[case], after[case]
        for part in sorted(old.keys() | new.keys()):
            was, now = old.get(part, {}), new.get(part, {})
            members = [member for member in was | now if was.get(member) != now.get(member)]
            if members:
                lines.append(f"{case}: {part}{described(members, was, now)}")
    return lines


def described(members: list[str], was: dict[str, str], now: dict[str, str]) -> str:
    """The first member that differs, how many others do, and its first line that differs."""
    first = members[0]
    more = f" and {len(members) - 1} more" if len(members) > 1 else ""
    texts = [texts.get(first, "missing").splitlines() or [""] for texts in (was, now)]
    pairs = zip_longest(*texts, fillvalue="")
    lines = next((pair for pair in pairs if pair[0] != pair[1]), ("", ""))
    values = " -> ".join(repr(line[:LONGEST_LINE]) for line in lines)
    return f" ({first}{more}): {values}" if first or more else f": {values}"


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="example:\n  python tests/support/golden.py compare /tmp/golden.json --only 'water_npt|texts'",
    )
    parser.add_argument("command", choices=["record", "compare"])
    parser.add_argument("file", type=Path, metavar="FILE", help="the record, a JSON file")
    parser.add_argument(
        "--only",
        default="",
        metavar="PATTERN",
        help="cases whose names match this regular expression",
    )
    parser.add_argument(
        "-j", dest="jobs", type=int, default=2, metavar="N", help="processes (default: 2)"
    )
    options = parser.parse_args(arguments)
    here = machine()
    record: dict[str, Any] = {}
    if options.command == "compare":
        record = json.loads(options.file.read_text())
        if others := [key for key in here if record["machine"].get(key) != here[key]]:
            for key in others:
                print(f"{key}: {record['machine'].get(key)} in the record, {here[key]} here")
            print(f"{options.file} cannot be compared: bits differ between machines and versions")
            return 1
    measured = measure_all(options.only, options.jobs)
    failed = [name for name, parts in measured.items() if "failed" in parts]
    if options.command == "record":
        options.file.write_text(json.dumps({"machine": here, "cases": measured}, indent=1))
        lines = [f"{name}: fails: {measured[name]['failed']['']}" for name in failed]
        print("\n".join([*lines, f"{len(measured)} cases in {options.file}"]))
        return bool(failed)
    recorded = {
        name: parts for name, parts in record["cases"].items() if re.search(options.only, name)
    }
    lines = differences(recorded, measured)
    print(
        "\n".join([*lines, f"{len(measured)} cases, {len(lines)} differences from {options.file}"])
    )
    return bool(lines)


if __name__ == "__main__":
    sys.exit(main())
