"""Other programs that can move the molecules: what scenes, commands and reports know of them
without loading them.

`programs/NAME.py` has a record PROGRAM for each, and its engine is the folder `engines/NAME/`.
"""

from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module
from pkgutil import iter_modules
from typing import Any, NamedTuple


class Option(NamedTuple):
    """A key of [engine] that one engine has."""

    values: type[int] | tuple[str, ...]  # the values allowed; int: whole numbers above 0
    default: object
    description: str


class Program(NamedTuple):
    """A program. Objects of the folder of its engine are named as "module:object"."""

    title: str
    install: str  # how to install it
    translations: str  # its `engines.external.Translations`
    engine: str = ""  # its subclass of `engines.external.ExternalEngine`; empty if it cannot be run
    installed: str = ""  # a function that describes what is installed here
    options: Mapping[str, Option] = {}
    describe: Callable[..., str] = lambda **options: ""  # name and options for reports
    #: A message on options that contradict each other
    option_errors: Callable[..., str] = lambda **options: ""
    # the options with which `rigidmd verify` compares, unless others are given
    precise: Mapping[str, object] = {}
    thermostat: str | None = None  # its default thermostat in place of rigidmd's
    barostat: str | None = None  # likewise of npt; None if its barostat has no name in a scene
    writer: str = (
        ""  # its function (folder, view, state) -> names of files; empty without an export
    )
    command: str = ""  # that runs an exported folder
    name: str = ""  # in scenes and commands, and of its folder; set by `programs`

    def load(self, path: str) -> Any:
        """An object of its folder."""
        module, _, name = path.partition(":")
        return getattr(import_module(f"rigidmd.features.external.{self.name}.{module}"), name)


@cache
def programs() -> dict[str, Program]:
    """Name of a program -> its record."""
    return {
        module.name: import_module(f"{__name__}.{module.name}").PROGRAM._replace(name=module.name)
        for module in iter_modules(__path__)
    }


def runnable() -> dict[str, Program]:
    """The programs that scenes can name."""
    return {name: program for name, program in programs().items() if program.engine}


def engine_options() -> dict[str, Option]:
    """The keys of [engine] in addition to its name."""
    return {
        key: option for program in runnable().values() for key, option in program.options.items()
    }
