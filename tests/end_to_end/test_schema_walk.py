"""Whatever `check` accepts starts: every numeric key of the schema with odd values, one at a time.

A scene with an odd value is rejected by `check`, or it runs: to its end, or until a limit of `watch`
or a lost molecule stops it. `run` never rejects what `check` accepts, with one exception: a lattice
of molecules that overlap removal cannot separate, which only forces show.
"""

import copy
import gc
import os
import signal
import sys
import time
import tomllib
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import tomli_w
from support.schema_scenes import BODIES, BODY_VARIANTS, MOLECULES, VARIANTS

from rigidmd.commands.cli import main
from rigidmd.scene import schema
from rigidmd.scene.base import override

FLOATS = (-1e30, -1.0, 0.0, 1e-90, 1e-30, 1e-9, 0.3, 7.0, 1e4, 1e9, 1e30, 1e90)
INTEGERS = (-1, 0, 1, 2, 7, 1000, 2**31, 2**63 - 1, 2**63, 10**30)
SCENES = (
    {name: (text, {}) for name, text in (MOLECULES | BODIES).items()} | VARIANTS | BODY_VARIANTS
)
#: Exit codes of a run: its end, or --walltime.
ENDED, OUT_OF_TIME = 0, 75
SECONDS = 120  # of processor time of a case, with compiling
WAITING = 15 * SECONDS  # on a machine with other work
#: The odd values that most failures came from.
TELLING = (-1, 0, 1, 2**31, 2**63, -1e30, 0.0, 1e-90, 1e-30, 1e30, 1e90)


def tables_of(name: str) -> dict[str, Any]:
    """The tables of a scene, with the changes of its variant."""
    text, changes = SCENES[name]
    tables = tomllib.loads(text)
    for key, value in changes.items():
        _, errors = override(tables, key, copy.deepcopy(value))
        assert not errors, errors
    return tables


def numbers_of(tables: Any, keys: tuple = ()) -> Iterator[tuple[tuple, float]]:
    """Path of keys and value of each number in nested tables."""
    for key, value in tables.items() if isinstance(tables, dict) else enumerate(tables):
        if isinstance(value, dict | list):
            yield from numbers_of(value, (*keys, key))
        elif isinstance(value, int | float) and not isinstance(value, bool):
            yield (*keys, key), value


def key_of(path: tuple) -> str:
    """The dotted key of a path, without positions in lists."""
    return ".".join(part for part in path if isinstance(part, str))


def cases() -> dict[str, list[tuple[tuple, float]]]:
    """By scene, the numbers to change: each key in the first scene that has it; of a list its first
    and last entry."""
    found: dict[str, list[tuple[tuple, float]]] = {}
    known: set[str] = set()
    for name in SCENES:
        by_key: dict[str, list[tuple[tuple, float]]] = {}
        for path, value in numbers_of(tables_of(name)):
            by_key.setdefault(key_of(path), []).append((path, value))
        new = {key: entries for key, entries in by_key.items() if key not in known}
        known |= set(new)
        found[name] = [
            entry for entries in new.values() for entry in {0: entries[0], -1: entries[-1]}.values()
        ]
    return found


def odd_values(name: str) -> list[tuple[tuple, float]]:
    """The changed numbers of a scene, the most showing ones first."""
    odd = [
        (keys, value)
        for keys, number in cases()[name]
        for value in (INTEGERS if isinstance(number, int) else FLOATS)
    ]
    return sorted(odd, key=lambda entry: entry[1] not in TELLING)


def numeric_keys(node: Any, definitions: dict, keys: tuple = ()) -> Iterator[str]:
    """Dotted keys of all numbers in a JSON schema; of a table with free names the key of the
    table."""
    if reference := node.get("$ref"):
        yield from numeric_keys(definitions[reference.rpartition("/")[2]], definitions, keys)
    if node.get("type") in ("number", "integer"):
        yield ".".join(keys)
    for key, inner in node.get("properties", {}).items():
        yield from numeric_keys(inner, definitions, (*keys, key))
    parts = [
        *node.get("anyOf", ()),
        *node.get("oneOf", ()),
        *node.get("allOf", ()),
        *node.get("prefixItems", ()),
    ]
    parts += [
        inner
        for key in ("items", "additionalProperties")
        if isinstance(inner := node.get(key), dict)
    ]
    for inner in parts:
        yield from numeric_keys(inner, definitions, keys)


def test_the_walk_knows_every_numeric_key():
    """A new key of the schema needs a scene in schema_scenes.py."""
    whole = schema()
    wanted = set(numeric_keys(whole, whole["$defs"]))
    known = {key_of(path) for name in SCENES for path, _ in numbers_of(tables_of(name))}
    # of a table with free names the schema has the key of the table
    missing = {
        key
        for key in wanted
        if not any(key == other or other.startswith(f"{key}.") for other in known)
    }
    assert not missing


def write(folder: Path, tables: dict[str, Any]) -> Path:
    path = folder / "scene.toml"
    path.write_bytes(tomli_w.dumps(tables).encode())
    (folder / "argon.xyz").write_text(
        '1\nLattice="9.0 0 0 0 9.0 0 0 0 9.0" pbc="T T T"\nAr 1.0 2.0 3.0\n'
    )
    return path


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_of_the_walk_is_accepted(name, capsys, tmp_path):
    assert main(["check", str(write(tmp_path, tables_of(name)))]) == 0, capsys.readouterr().err


def in_child(command: list[str], log: Path) -> tuple[int, str]:
    """Exit code and output of a command in a forked process, which a hang or a crash ends alone."""
    process = os.fork()
    if process == 0:
        code = 70
        try:
            with log.open("w", buffering=1) as file:
                os.dup2(file.fileno(), 1)
                os.dup2(file.fileno(), 2)
                sys.stdout = sys.stderr = file  # pytest has other ones
                gc.disable()  # a search for cycles would copy the memory of the parent
                # the default action of both signals ends the process
                signal.setitimer(signal.ITIMER_PROF, SECONDS)
                signal.alarm(WAITING)
                try:
                    code = main(command)
                except BaseException:
                    traceback.print_exc()
        finally:
            os._exit(code)
    until = time.monotonic() + 2 * WAITING
    status = 0
    while time.monotonic() < until:
        ended, status = os.waitpid(process, os.WNOHANG)
        if ended:
            break
        time.sleep(0.01)
    return os.waitstatus_to_exitcode(status), log.read_text(errors="replace")


def error_of(path: Path, folder: Path) -> str:
    """What is wrong with `check` or `run` of a scene; empty if nothing is."""
    log = folder / "log.txt"
    code, text = in_child(["check", str(path)], log)
    if code == 2 and "Traceback" not in text:
        return ""
    if code != 0 or "Traceback" in text or "RuntimeWarning" in text:
        return f"check ends with {code}: {text[-600:]}"
    command = ["run", str(path), "-o", str(folder / "run"), "--force", "--walltime", "0:00:05"]
    code, text = in_child(command, log)
    # a molecule or body may fly out of what the files of the run can hold
    stopped = code == 1 and ("stopped at step" in text or "a position is beyond" in text)
    overlaps = code == 2 and "overlap removal" in text
    if "Traceback" in text or not (code in (ENDED, OUT_OF_TIME) or stopped or overlaps):
        return f"run ends with {code}: {text[-600:]}"
    return ""


@pytest.mark.soak
@pytest.mark.parametrize("name", SCENES)
def test_what_check_accepts_starts(name, capsys, tmp_path):
    base = str(write(tmp_path, tables_of(name)))
    # the children begin with what these import and compile
    for command in (["check", base], ["run", base, "-o", str(tmp_path / "run")]):
        assert main(command) == 0, capsys.readouterr().err
    gc.freeze()
    failures = []
    for keys, odd in odd_values(name):
        tables = tables_of(name)
        target: Any = tables
        for key in keys[:-1]:
            target = target[key]
        target[keys[-1]] = odd
        if error := error_of(write(tmp_path, tables), tmp_path):
            failures.append(f"{'.'.join(map(str, keys))} = {odd!r}: {error}")
            print(failures[-1], file=sys.stderr)  # an end before the last case leaves these
    gc.unfreeze()
    assert not failures, "\n\n".join(failures)
