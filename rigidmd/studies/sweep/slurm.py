"""`rigidmd sweep --to slurm`: a script for an array of jobs, each of which runs a point until it has finished."""

import shlex
from collections.abc import Sequence
from pathlib import Path

from rigidmd.core.files import write_text
from rigidmd.core.plain_text import as_word, check_script_paths, in_comment
from rigidmd.studies.sweep.folder import FINISHED, SCRIPT, Manifest

#: Time that a run leaves unused at the end of the wall time of its job: seconds, and at most this fraction.
SPARE, SPARE_FRACTION = 300.0, 0.1

JOB = """#!/bin/bash
# {count} points of {name}. Submit it: sbatch {script}
# A job whose time is up submits itself again, and continues from its checkpoint. When all have ended,
#   {collect}
# writes table and figure; `rigidmd sweep` with --to slurm writes a script of the points that have not finished.
#SBATCH --job-name={job}
#SBATCH --array={array}
#SBATCH --time={time}
#SBATCH --cpus-per-task={threads}
#SBATCH --output="{folder}/slurm-%a.out"
#SBATCH --open-mode=append
cd {here} || exit 2
{point} --point "$SLURM_ARRAY_TASK_ID" --threads {threads} --walltime {inner}
code=$?
[ $code -eq {again} ] && exec sbatch --array="$SLURM_ARRAY_TASK_ID" {script}
exit $code
"""


def write_script(
    folder: Path, manifest: Manifest, walltime: float, threads: int, trust: Sequence[str], again: int
) -> tuple[Path, int]:
    """Write sweep.sbatch for the points that have not finished. Returns its path and their number.

    walltime : wall time of a job, s; again : exit code of a run whose time was up. Raises OutputError.
    """
    path = folder.absolute() / SCRIPT
    left = [k for k, point in enumerate(manifest.points) if point.state != FINISHED]
    words = ["rigidmd", "sweep", manifest.scene, "-o", str(folder.absolute())]
    for trusted in trust:
        words += ["--trust", str(Path(trusted).absolute())]
    here = str(Path.cwd())
    check_script_paths([*words, str(path), here])
    text = JOB.format(
        count=len(left), name=in_comment(manifest.name), job=f"{as_word(manifest.name)}-sweep",
        array=format_ranges(left), threads=threads, time=format_walltime(walltime),
        inner=format_walltime(walltime - min(SPARE, SPARE_FRACTION * walltime)),
        folder=str(folder.absolute()).replace("%", "%%"),  # Slurm replaces %j and others
        here=shlex.quote(here), script=shlex.quote(str(path)), again=again,
        point=shlex.join(words), collect=shlex.join([*words, "--collect"]),
    )  # fmt: skip
    write_text(path, text)
    return path, len(left)


def format_ranges(numbers: Sequence[int]) -> str:
    """Ascending numbers as Slurm's --array has them: 0-3,7."""
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][1] + 1:
            parts[-1][1] = number
        else:
            parts.append([number, number])
    return ",".join(f"{first}" if first == last else f"{first}-{last}" for first, last in parts)


def format_walltime(span: float) -> str:
    """Seconds as H:MM:SS."""
    whole = int(span)
    return f"{whole // 3600}:{whole // 60 % 60:02}:{whole % 60:02}"
