"""`rigidmd`: the parsing of the command line, the messages and exit codes of errors.

The module of the command is imported, or without one all modules of this package and of features.
Their functions with the decorator `command` are the commands. They compute nothing. Modules import
what they need inside functions, so that `rigidmd --help` loads none of it.
"""

import argparse
import atexit
import gc
import re
import shlex
import sys
import warnings
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from textwrap import fill
from typing import NoReturn

import rigidmd.commands as package
from rigidmd.commands import BAD_INPUT, FAILED, INTERRUPTED
from rigidmd.commands.arguments import COMMANDS, GROUPS
from rigidmd.commands.streams import checked_streams, open_streams, warn
from rigidmd.core.plain_text import did_you_mean
from rigidmd.errors import RigidMDError, RigidMDWarning, SimulationError, Wording, worded_by
from rigidmd.features import FEATURES, modules

EXAMPLES = """examples:
  rigidmd new water && rigidmd run water.toml               a liquid of water
  rigidmd new heavy_top_3 && rigidmd run heavy_top_3.toml   one body: a top
  rigidmd run water.toml --set stages.production.timestep_fs=4 -o runs/water4

`rigidmd COMMAND --help` describes a command and its options.
"""


class CommandLine(Wording):
    """How messages name the options of the command line."""

    #: Those that are not the keyword of Python with dashes.
    arguments = {"folder": "-o", "file": "-o", "overrides": "--set", "sets": "--set"}  # noqa: RUF012

    def option(self, name: str) -> str:
        return self.arguments.get(name) or f"--{name.replace('_', '-')}"

    def resume(self, folder: Path) -> str:
        return f"`rigidmd resume {shlex.quote(str(folder))}`"


#: What the loader of shared libraries and the system report where memory does not suffice.
OUT_OF_MEMORY = (
    "failed to map segment",
    "cannot allocate memory",
    "Cannot allocate memory",
    "can't start new thread",
)


def main(arguments: list[str] | None = None) -> int:
    """Run one command. Exit code: 0 success, 1 failed run, 2 bad input, 75 wall time is up, 130 or
    143 signal."""
    from rigidmd.core.process import check_address_space, without_local_settings

    options = argparse.Namespace()
    # Skip garbage collection of imported objects: it took a quarter of a short run, most
    # of it at the exit.
    gc.set_threshold(10_000, 50)
    atexit.register(gc.freeze)

    def show(message, category, *where, **more):
        (
            warn(str(message))
            if issubclass(category, RigidMDWarning)
            else default_showwarning(message, category, *where, **more)
        )

    try:
        open_streams()
        options = _parse((sys.argv[1:] if arguments is None else arguments) or ["--help"])
        check_address_space()
        streams = checked_streams(lasting=options.writes)
        with warnings.catch_warnings(), without_local_settings(), streams, worded_by(CommandLine()):
            default_showwarning = warnings.showwarning
            warnings.showwarning = show
            return options.command(options)
    except RigidMDError as error:
        print(f"rigidmd: {error}", file=sys.stderr)
        return FAILED if isinstance(error, SimulationError) else BAD_INPUT
    except BrokenPipeError:  # the reader of a pipe has gone: `rigidmd models | head`
        return 0
    except (
        KeyboardInterrupt,
        Exception,
    ) as error:  # libraries raise errors of many types for the causes below
        causes: list[BaseException] = [error]
        while cause := causes[-1].__cause__ or causes[-1].__context__:
            causes.append(cause)
        if any(isinstance(cause, KeyboardInterrupt) for cause in causes):
            print("rigidmd: interrupted", file=sys.stderr)
            return INTERRUPTED
        if any(
            isinstance(cause, MemoryError) for cause in causes
        ):  # zipfile, too, raises another one instead
            what = getattr(options, "scene", "this")
            print(
                f"rigidmd: {what}: not enough memory{_free()}. Take fewer molecules or samples",
                file=sys.stderr,
            )
            return BAD_INPUT
        if any(words in str(cause) for cause in causes for words in OUT_OF_MEMORY):
            print(
                "rigidmd: not enough memory to load the program. Raise the limit (ulimit -v)",
                file=sys.stderr,
            )
            return BAD_INPUT
        if isinstance(error, OSError) and error.filename is not None:  # such as a name too long
            from rigidmd.core.toml import shorten_text

            print(
                f"rigidmd: {shorten_text(str(error.filename))}: {error.strerror}", file=sys.stderr
            )
            return BAD_INPUT
        raise


def _free() -> str:
    """How much memory is free, for messages. Empty if not even that can be found out."""
    from rigidmd.core.process import format_gigabytes, free_memory

    try:
        return f" ({format_gigabytes(free_memory())} free)"
    except MemoryError:
        return ""


def _parse(words: list[str]) -> argparse.Namespace:
    """The options of a command line. An unknown command or option ends the process with a
    suggestion."""
    parser, commands = _parser(words[0] if words else "")
    name = next((word for word in words if not word.startswith("-")), None)
    if name is not None and name not in commands:
        for row in FEATURES:
            if name in row.commands:
                raise row.missing(f"rigidmd {name}")
        parser.error(f"unknown command {name!r}{did_you_mean(name, commands)}")
    options, unknown = parser.parse_known_args(words)
    if unknown and name is not None:
        known = dict.fromkeys(re.findall(r"(?<![\w-])--[a-z-]+", commands[name].format_help()))
        suggestion = did_you_mean(unknown[0].partition("=")[0], known)
        commands[name].error(f"unknown argument {unknown[0]!r}{suggestion}")
    return options


def _parser(first: str = "") -> tuple[argparse.ArgumentParser, dict[str, "_Parser"]]:
    """The parser of a command line, and those of its commands by name: of all, or of the one that
    is the first word."""
    about = (
        "Molecular dynamics of rigid molecules, and the motion of single rigid bodies, from a scene"
        " file."
    )
    form = argparse.RawDescriptionHelpFormatter
    parser = _Parser(
        "rigidmd",
        usage="rigidmd [-h] [--version] COMMAND ...",
        description=fill(about, 80),
        formatter_class=form,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version")
    commands = parser.add_subparsers(
        prog="rigidmd", required=True, metavar="COMMAND", help=argparse.SUPPRESS
    )
    names = {m.name: f"{package.__name__}.{m.name}" for m in iter_modules(package.__path__)}
    names |= modules("commands")
    for name in [names[first]] if first in names else names.values():
        import_module(name)
    parser.epilog = f"{_listed()}\n{EXAMPLES}"
    for name, command in COMMANDS.items():
        description = command.about[0].upper() + command.about[1:] + "."
        epilog = f"example:\n  {command.example}"
        texts = {
            "description": fill(description, 80),
            "epilog": epilog,
            "formatter_class": form,
        }
        of_command = commands.add_parser(name, **texts)
        of_command.set_defaults(command=command.call, **{"writes": False} | command.options)
        for add in command.arguments:
            add(of_command)
    return parser, commands.choices


class _Parser(argparse.ArgumentParser):
    """One whose errors begin with the message, before an example."""

    def error(self, message: str) -> NoReturn:
        lines = [f"{self.prog}: error: {message}"]
        if self.prog != "rigidmd":
            lines.append(f"  for example: {str(self.epilog).splitlines()[1].strip()}")
        what = "commands" if self.prog == "rigidmd" else "arguments"
        lines.append(f"`{self.prog} --help` lists the {what}")
        self.exit(BAD_INPUT, "\n".join(lines) + "\n")


def _listed() -> str:
    """The commands of each group, a line each."""
    lines = []
    for group in GROUPS:
        names = [name for name in COMMANDS if COMMANDS[name].group == group]
        lines += [f"{group}:"] * bool(names)
        for name in sorted(names, key=lambda name: COMMANDS[name].position):
            lines.append(f"  {name:<11}{COMMANDS[name].about.split('. ')[0]}")
        lines += [""] * bool(names)
    return "\n".join(lines)


class _Version(argparse.Action):
    def __call__(self, parser, namespace, values, option_string=None):
        from importlib.metadata import version

        print(f"rigidmd {version('rigidmd')}")
        parser.exit()
