"""What commands share: their exit codes, and pieces of their command lines."""

import argparse
import re
import sys
from collections.abc import Callable
from math import inf, nan
from typing import Any

#: Added to the number of a signal that ends a command: exit code 130 for Ctrl-C, 143 for SIGTERM.
BY_SIGNAL = 128
BAD_INPUT, FAILED, INTERRUPTED = 2, 1, BY_SIGNAL + 2
#: Exit code of a run that stopped because its wall time was up: run it again with --resume.
OUT_OF_TIME = 75


def number(kind: type, least: float, most: float, what: str) -> Callable[[str], Any]:
    """A reader of numbers in a range, whole or real ones, for argparse; what : what they are, in words."""

    def read(text: str) -> Any:
        try:
            value = kind(text) if kind is float or text.isdigit() else nan
        except ValueError:
            value = nan
        if not least <= value <= most:
            raise argparse.ArgumentTypeError(f"{text!r} is not {what}")
        return value

    return read


def time_ps(text: str) -> float:
    """Picoseconds in a time such as 200ps."""
    found = re.fullmatch(r"(\d+\.?\d*(?:[eE][+-]?\d+)?) ?(fs|ps|ns|us)", text)
    if found is None or float(found[1]) == inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not a time with a unit, such as 200ps or 1.5ns")
    return float(found[1]) * {"fs": 1e-3, "ps": 1.0, "ns": 1e3, "us": 1e6}[found[2]]


def seconds(text: str) -> float:
    """Seconds in H:MM:SS, MM:SS or D-H:MM:SS."""
    found = re.fullmatch(r"(?:(?:(\d+)-)?(\d+):)?(\d+):(\d\d)", text)
    days, hours, minutes, rest = (float(part or 0) for part in (found.groups() if found else [inf] * 4))
    found_seconds = 86400 * days + 3600 * hours + 60 * minutes + rest
    if found_seconds == inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not H:MM:SS, such as 3:50:00")
    return found_seconds


def add_trust(parser: argparse.ArgumentParser) -> None:
    """Add --trust, for the Python files of forces of a scene."""
    parser.add_argument(
        "--trust",
        action="append",
        default=[],
        metavar="FILE.py",
        help="let [[forces.custom]] of the scene run this Python file, or a copy of it; it is code and can do whatever "
        "you can; may be repeated",
    )


def add_engine(
    parser: argparse.ArgumentParser, known: str = "rigidmd, lammps or openmm", default: str = "the scene's"
) -> None:
    """Add the options that set the table [engine] of a scene. known : its names, in words; default : in words"""
    parser.add_argument(
        "--engine", metavar="NAME", help=f"who computes, {known}: the key engine.name of the scene (default: {default})"
    )
    parser.add_argument("--ranks", type=int, metavar="N", help="of lammps: MPI processes (default: 1)")
    parser.add_argument("--platform", metavar="NAME", help="of openmm: CPU, Reference, CUDA, OpenCL or HIP")


def say(sentence: str) -> None:
    """Announce something that takes a moment."""
    print(f"  {sentence} ...", file=sys.stderr, flush=True)


def warn(sentence: str) -> None:
    """Print a warning."""
    from rigidmd.errors import visible

    print(f"rigidmd: warning: {visible(sentence)}", file=sys.stderr)
