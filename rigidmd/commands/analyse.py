"""The command `analyse`. It prints and never computes."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from rigidmd.commands.arguments import time_ps

if TYPE_CHECKING:
    from rigidmd.analysis.folder import Task


def add_commands(add: Callable[..., argparse.ArgumentParser]) -> None:
    """Add it with `add(name, function, about, example)`."""
    analyse = add(
        "analyse",
        _analyse,
        "measure g(r), diffusion, orientation, dielectric constant, viscosity and more in a run, each with its error",
        "rigidmd analyse runs/water --only rdf,diffusion --from 10ps",
    )
    analyse.add_argument("folder", metavar="RUN", help="folder of a run, or of a sweep: means and errors over its runs")
    analyse.add_argument(
        "--only", type=lambda text: [name.strip() for name in text.split(",") if name.strip()], default=[],
        metavar="NAMES", help="these analyses, separated by commas (default: all); `--list` names them",
    )  # fmt: skip
    analyse.add_argument(
        "--from", dest="start", type=time_ps, metavar="TIME",
        help="use frames from this time of the run on, such as 10ps (default: where it is found to be equilibrated)",
    )  # fmt: skip
    analyse.add_argument(
        "--viscosity", type=_positive, metavar="MPA_S",
        help="viscosity in mPa s for the correction of D for the size of the box (default: that of the run)",
    )  # fmt: skip
    analyse.add_argument(
        "--trust", action="append", default=[], metavar="FILE.py",
        help="run this Python file first, which may define analyses with @rigidmd.analysis; may be repeated",
    )  # fmt: skip
    analyse.add_argument("--list", action=_List, nargs=0, help="list the analyses")
    analyse.set_defaults(scene="this run", writes=True)


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1e12:
        raise argparse.ArgumentTypeError(f"{text!r} is not a viscosity above 0")
    return value


class _List(argparse.Action):
    def __call__(self, parser, *_):
        from rigidmd.analysis.registry import selected

        for entry in selected([]):
            print(f"{entry.name:18} {entry.about}")
        parser.exit()


def _analyse(options: argparse.Namespace) -> int:
    from tqdm import tqdm

    from rigidmd.analysis.folder import Task, analyse_folder
    from rigidmd.analysis.registry import trusted
    from rigidmd.studies.sweep.folder import is_sweep

    for path in options.trust:
        trusted(Path(path))
    with tqdm(total=1.0, disable=None, leave=False, bar_format="{desc} {l_bar}{bar}| [{elapsed}<{remaining}]") as bar:

        def step(share: float, name: str) -> None:
            bar.set_description_str(name, refresh=False)
            bar.update(share - bar.n)

        task = Task(options.only, options.start, options.viscosity)
        if is_sweep(Path(options.folder)):
            return _analyse_sweep(Path(options.folder), task, step)
        done = analyse_folder(Path(options.folder), task, step)
    history = done.history
    print(f"{options.folder}: {len(history)} frames from {history.time[0]:g} to {history.time[-1]:g} ps")
    for note in history.notes:
        print(f"  {note}")
    for finding in done.findings:
        print(finding)
    for name, why in done.failed.items():
        print(f"{name}: left out: {why}")
    print(f"{len(done.files)} files in {options.folder}, values in {done.files[0].name}; `rigidmd report` shows them")
    return 0


def _analyse_sweep(folder: Path, task: "Task", step: Callable[[float, str], object]) -> int:
    """`analyse` of a sweep."""
    from rigidmd.studies.sweep.replicas import ANALYSES, analyse_sweep

    found = analyse_sweep(folder, task, step)
    step(1.0, "")
    for combination in found:
        runs = f"{combination.runs} run{'s' if combination.runs > 1 else ''}"
        print(f"{combination.title or folder}: {runs}, {len(combination.files)} files in {combination.files[0].parent}")
        for finding in combination.findings:
            print(finding)
        for name, why in combination.failed.items():
            print(f"{name}: left out: {why}")
        print()
    print(f"values of all in {folder / ANALYSES}")
    return 0
