"""The options that all scripts of this folder have.

    python tests/benchmarks/NAME.py --smoke        # its smallest form: seconds, and numbers without a meaning
    python tests/benchmarks/NAME.py --to FOLDER    # where it writes, if it writes files

The smallest form takes every path of a script: all methods, and all engines that are installed.
"""

import argparse
import atexit
import sys
import tempfile
from pathlib import Path

#: Whether this process runs the smallest form, and the option that gives it to a child process.
SMOKE = "--smoke" in sys.argv
SMOKE_OPTION = ["--smoke"] if SMOKE else []


def new_parser(description: str | None) -> argparse.ArgumentParser:
    """A parser whose help is the text of a script as it stands there."""
    return argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def read_options(
    parser: argparse.ArgumentParser, to: Path | None = None, **smallest
) -> argparse.Namespace:
    """The options of the command line, with `smoke`, and with `to` if the script writes files.

    to : the folder of its files by default; the smallest form has a temporary one
    smallest : values of options in the smallest form, unless they are given
    """
    parser.add_argument(
        "--smoke", action="store_true", help="the smallest form, which takes seconds"
    )
    if to is not None:
        parser.add_argument(
            "--to", type=Path, default=to, metavar="FOLDER", help=f"where it writes; {shown(to)}"
        )
    if SMOKE:
        parser.set_defaults(**smallest)
        if to is not None:
            folder = tempfile.TemporaryDirectory()
            atexit.register(folder.cleanup)
            parser.set_defaults(to=Path(folder.name))
    options = parser.parse_args()
    if to is not None:
        options.to.mkdir(parents=True, exist_ok=True)
    return options


def numbers(kind):
    """A parser of comma-separated numbers."""
    return lambda text: [kind(part) for part in text.split(",")]


def choice(known):
    """A parser of comma-separated names."""

    def parse(text: str) -> list[str]:
        names = text.split(",")
        if unknown := [name for name in names if name not in known]:
            raise argparse.ArgumentTypeError(f"no {', '.join(unknown)}; known: {', '.join(known)}")
        return names

    return parse


def shown(folder: Path) -> str:
    """A folder as the help shows it."""
    root = Path(__file__).parents[2]
    return str(folder.relative_to(root) if folder.is_relative_to(root) else folder)
