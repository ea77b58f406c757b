"""The figures of README and of the pages, and the commands that draw them.

    PYTHONPATH=tests python tests/support/page_figures.py                # what takes at most a minute
    PYTHONPATH=tests python tests/support/page_figures.py --limit 600    # up to ten minutes each

Each command writes its images into a folder, from which they replace those of rigidmd/docs/images.
The script lists the images that changed.
"""

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from support.common import ROOT
from support.processes import search_path

IMAGES = ROOT / "rigidmd" / "docs" / "images"
SCRIPTS = ROOT / "tests" / "benchmarks"


class Drawing(NamedTuple):
    """What draws an image.

    command : a script of tests/benchmarks with its arguments, which takes --to FOLDER
    seconds : on two cores
    source : "data" of rigidmd/docs/evidence/data, or "runs"
    """

    command: str
    seconds: int
    source: str


_WATER = Drawing("figures.py water", 60, "runs")
_COLLECTION = Drawing("collection.py --pages", 5, "data")
#: Image -> what draws it.
FIGURES = {
    "calculator_steps.png": Drawing("calculators.py", 600, "runs"),  # needs tblite
    "collection_top.png": _COLLECTION,
    "collection_water.png": _COLLECTION,
    "error_time.png": _COLLECTION,
    "euler_angles.png": Drawing("euler_angles.py", 2, "data"),
    "long_run.png": Drawing("long_run.py", 3, "data"),
    "model_tip5p.png": Drawing("figures.py model", 3, "data"),
    "normal_modes_spce.png": Drawing("figures.py modes", 60, "runs"),
    "scaling.png": Drawing("scaling.py --draw", 3, "data"),
    "seven_tops.png": Drawing("seven_tops.py", 20, "runs"),
    "single_body.png": Drawing("single_body.py --draw", 3, "data"),
    "top.gif": Drawing("figures.py top", 30, "runs"),
    "water.gif": _WATER,
    "water_box.png": _WATER,
    "water_energy.png": _WATER,
    "water_slab.png": Drawing("figures.py slab", 400, "runs"),
    "zero_step.png": Drawing("zero_step.py", 40_000, "runs"),
}


def redraw(limit: float, images: Path = IMAGES) -> list[str]:
    """Draw what takes at most these seconds, and return the names of the images that changed."""
    changed = []
    for command in dict.fromkeys(one.command for one in FIGURES.values() if one.seconds <= limit):
        script, *arguments = shlex.split(command)
        with tempfile.TemporaryDirectory() as folder:
            call = [sys.executable, str(SCRIPTS / script), *arguments, "--to", folder]
            environment = os.environ | search_path(SCRIPTS)
            subprocess.run(call, check=True, stdout=subprocess.DEVNULL, env=environment)
            drawn = {path.name: path for path in Path(folder).rglob("*")}
            for name in (name for name, one in FIGURES.items() if one.command == command):
                old = images / name
                if not old.is_file() or old.read_bytes() != drawn[name].read_bytes():
                    shutil.copyfile(drawn[name], old)
                    changed.append(name)
    return changed


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--limit", type=float, default=60.0, help="seconds for an image; 60")
    print(*redraw(parser.parse_args().limit), sep="\n")
