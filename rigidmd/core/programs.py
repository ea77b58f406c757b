"""Other programs that can move the molecules: what scenes, commands and reports know of them
without loading them.

A feature with programs has a folder for each, which is found by its module `program` with the
record PROGRAM.
"""

from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pkgutil import iter_modules
from typing import NamedTuple

from rigidmd.feature import Row
from rigidmd.features import FEATURES


class Option(NamedTuple):
    """A key of [engine] that one engine has."""

    values: type[int] | tuple[str, ...]  # the values allowed; int: whole numbers above 0
    default: object
    description: str


class Program(NamedTuple):
    """A program. The feature that has it reads the texts "module:object" of its folder."""

    title: str
    install: str  # how to install it
    translations: str  # its `Translations`
    engine: str = ""  # its subclass of `ExternalEngine`; empty if it cannot be run
    installed: str = ""  # a function that describes what is installed here
    options: Mapping[str, Option] = {}
    describe: Callable[..., str] = lambda **options: ""  # name and options for reports
    #: A message on options that contradict each other
    option_errors: Callable[..., str] = lambda **options: ""
    # the options with which it is compared, unless others are given
    precise: Mapping[str, object] = {}
    thermostat: str | None = None  # its default thermostat in place of rigidmd's
    barostat: str | None = None  # likewise of npt; None if its barostat has no name in a scene
    writer: str = (
        ""  # its function (folder, view, state) -> names of files; empty without an export
    )
    command: str = ""  # that runs an exported folder
    # set by `programs`
    name: str = ""  # in scenes and commands, and of its folder
    feature: Row = FEATURES[0]  # that has it

    def load(self, path: str):
        """An object of its folder."""
        module, _, name = path.partition(":")
        return getattr(self.feature.module(f"{self.name}.{module}"), name)


@cache
def programs() -> dict[str, Program]:
    """Name of a program -> its record."""
    found = {}
    for row in FEATURES:
        if row.programs and row.is_installed:
            for folder in iter_modules(import_module(row.package).__path__):
                path = f"{row.package}.{folder.name}.program"
                if folder.ispkg and folder.name != "commands" and find_spec(path):
                    record = import_module(path).PROGRAM
                    found[folder.name] = record._replace(name=folder.name, feature=row)
    return found


def runnable() -> dict[str, Program]:
    """The programs that scenes can name."""
    return {name: program for name, program in programs().items() if program.engine}


def engine_options() -> dict[str, Option]:
    """The keys of [engine] in addition to its name."""
    return {
        key: option for program in runnable().values() for key, option in program.options.items()
    }
