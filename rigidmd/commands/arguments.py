"""The command registry, arguments that several commands have, and the reading of scenes."""

import argparse
import re
import shlex
import sys
from collections.abc import Callable, Iterable
from math import inf, nan
from pathlib import Path
from typing import NamedTuple, TypedDict, TypeVar, Unpack

from rigidmd.commands.streams import progress_bar
from rigidmd.core.programs import engine_options, runnable
from rigidmd.features import provider

#: Adds an argument to the parser of a command.
Argument = Callable[[argparse.ArgumentParser], object]
Options = argparse.Namespace
ActionClass = type[argparse.Action]
Result = TypeVar("Result")


#: Groups of commands in the order of `rigidmd --help`, which does not list the others.
GROUPS = ("Start", "Run", "Look", "Study")


class Command(NamedTuple):
    group: str
    position: int  # in its group
    about: str
    example: str
    arguments: tuple[Argument, ...]
    options: dict[str, object]  # that no argument sets
    call: Callable[[Options], int]


COMMANDS: dict[str, Command] = {}  # the commands of the imported modules, by name


def command(
    group: str, position: int, about: str, example: str, *arguments: Argument, **options: object
) -> Callable:
    """Register a function as the command of its name, without underscores around it.

    group, position : in `rigidmd --help`, which lists the commands of `GROUPS` with the first
    sentence of `about`; options : those that no argument sets, such as `writes=True` of a command
    whose results are files, not what it prints
    The function is called with the options, and returns the exit code.
    """

    def register(call: Callable[[Options], int]) -> Callable[[Options], int]:
        COMMANDS[call.__name__.strip("_")] = Command(
            group, position, about, example, arguments, options, call
        )
        return call

    return register


class Settings(TypedDict, total=False):
    """Those of `argparse.ArgumentParser.add_argument`."""

    help: str
    metavar: str | None
    dest: str | None
    default: object
    const: object
    type: Callable[[str], object]
    choices: Iterable[str]
    nargs: int | str
    action: str | ActionClass
    required: bool


def argument(*names: str, **settings: Unpack[Settings]) -> Argument:
    """An argument of a command."""
    return lambda parser: parser.add_argument(*names, **settings)


def flag(*names: str, help: str) -> Argument:
    """An option that is on or off."""
    return argument(*names, action="store_true", help=help)


def repeated(name: str, metavar: str, help: str, dest: str | None = None) -> Argument:
    """An option that may be repeated, whose values make a list."""
    return argument(name, action="append", default=[], metavar=metavar, help=help, dest=dest)


def number(
    kind: type[int] | type[float], lowest: float, highest: float, description: str
) -> Callable[[str], float]:
    """A reader for argparse of int or float numbers in a range."""

    def read(text: str) -> float:
        try:
            value = kind(text) if kind is float or text.isdigit() else nan
        except ValueError:
            value = nan
        if not lowest <= value <= highest:
            raise argparse.ArgumentTypeError(f"{text!r} is not {description}")
        return value

    return read


def time_ps(text: str) -> float:
    """Picoseconds in a time such as 200ps."""
    match = re.fullmatch(r"(\d+\.?\d*(?:[eE][+-]?\d+)?) ?(fs|ps|ns|us)", text)
    if match is None or float(match[1]) == inf:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a time with a unit, such as 200ps or 1.5ns"
        )
    return float(match[1]) * {"fs": 1e-3, "ps": 1.0, "ns": 1e3, "us": 1e6}[match[2]]


def seconds(text: str) -> float:
    """Seconds in H:MM:SS, MM:SS or D-H:MM:SS."""
    match = re.fullmatch(r"(?:(?:(\d+)-)?(\d+):)?(\d+):(\d\d)", text)
    days, hours, minutes, rest = (
        float(part or 0) for part in (match.groups() if match else [inf] * 4)
    )
    found_seconds = 86400 * days + 3600 * hours + 60 * minutes + rest
    if found_seconds == inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not H:MM:SS, such as 3:50:00")
    return found_seconds


def output_folder(default: str, earlier: str = "earlier results") -> tuple[Argument, Argument]:
    """-o and --force of a command that writes a folder."""
    return (
        argument("-o", "--output", metavar="DIR", help=f"folder (default: {default})"),
        flag("--force", help=f"replace {earlier} in that folder"),
    )


#: For the Python files of forces of a scene.
TRUST = repeated(
    "--trust",
    "FILE.py",
    help=(
        "let [[forces.custom]] of the scene run this Python file, or a copy of it. It is code"
        " and can do whatever you can. Can be repeated"
    ),
)
#: SCENE, --set and --trust, which `read_scene` reads.
SCENE = (
    argument("scene", metavar="SCENE", help="scene file (TOML)"),
    repeated(
        "--set",
        "KEY=VALUE",
        help=(
            "override a key of the scene by its dotted path (an entry of a list by its number,"
            " counted from 0, or a stage by its name). KEY= without a value removes the key. Can"
            " be repeated"
        ),
        dest="overrides",
    ),
    TRUST,
)


def add_engine(
    parser: argparse.ArgumentParser, default: str = "the scene's", *, itself: bool = True
) -> None:
    """Add the options that set the table [engine] of a scene; itself : rigidmd is one of the
    engines."""
    *names, last = [*(["rigidmd"] if itself else []), *runnable()]
    known = f"{', '.join(names)} or {last}"
    parser.add_argument(
        "--engine", metavar="NAME", help=f"engine to use, {known}: engine.name (default: {default})"
    )
    for key, option in engine_options().items():
        kind, metavar = (int, "N") if option.values is int else (str, "NAME")
        values = f" ({', '.join(option.values)})" if isinstance(option.values, tuple) else ""
        text = option.description[0].lower() + option.description[1:] + values
        parser.add_argument(f"--{key}", type=kind, metavar=metavar, help=text)


def read_scene(options: Options, **more):
    """The scene of the options of `SCENE` and `add_engine`; more : further keys to override."""
    from rigidmd.scene import Scene, parse_override

    if options.trust:
        of_users = provider("trust", "--trust")
        for path in options.trust:
            of_users.trust(path)
    overrides = dict(parse_override(text) for text in options.overrides)
    for option, key in {"engine": "name", **{key: key for key in engine_options()}}.items():
        if (value := getattr(options, option, None)) is not None:
            overrides[f"engine.{key}"] = value
    scene = Scene.read(options.scene, overrides | more)
    if options.trust:
        provider("check_trusted", "--trust").check_trusted(scene, options.trust)
    return scene


def run_folder(output: str) -> tuple[Argument, Argument, Argument]:
    """RUN, -o and --force of a command that writes a file about a run."""
    return (
        argument("folder", metavar="RUN", help="folder of a run"),
        argument("-o", "--output", metavar="FILE", help=output),
        flag("--force", help="replace that file"),
    )


def file_about_run(options: Options, default: str, extensions: tuple[str, ...]) -> Path:
    """The file to write, by default in the folder of the run, where it may be replaced. Raises
    OutputError."""
    from rigidmd.io.folder import add_to_folder, check_is_run
    from rigidmd.io.write import check_target

    folder = Path(options.folder)
    check_is_run(folder)
    if options.output:
        check_target(Path(options.output), extensions, force=options.force)
        return Path(options.output)
    add_to_folder(folder, [default])
    return folder / default


def write_study(
    folder: Path,
    *,
    force: bool,
    files: tuple[str, ...],
    begins: str,
    measure: Callable[[Callable], Result],
    describe: Callable[[Result], list[str]],
    write: Callable[[Path, Result, str], object],
) -> Result:
    """Measure something, print it and write its files into a folder, which is locked meanwhile.
    Returns what was found.

    files : names of all files that `write` may write; begins : what starts when the arguments have
        been checked
    """
    from rigidmd.io.folder import FolderLock, check_folder, make_folder

    check_folder(folder, force=force, names=files)
    with FolderLock(folder) as lock:
        with progress_bar(begins) as progress:
            result = measure(progress)
        print(*describe(result), sep="\n")
        make_folder(folder, files, lock)
        write(folder, result, shlex.join(["rigidmd", *sys.argv[1:]]))
    written = [name for name in files if (folder / name).is_file()]
    print(f"\n  files in {folder}: {', '.join(written)}")
    return result


def print_page(path: Path, notes: list[str]) -> None:
    """Print notes and how to open a page that was written."""
    for note in notes:
        print(note)
    print(
        f"{path}: {path.stat().st_size / 1e6:.2g} MB. Open it in a browser:"
        f" {shlex.quote(str(path.resolve()))}"
    )
