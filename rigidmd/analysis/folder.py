"""Many analyses of one run at once."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from rigidmd.analysis.files import stretch_of, write_findings
from rigidmd.analysis.findings import Finding
from rigidmd.analysis.history import History
from rigidmd.analysis.registry import selected
from rigidmd.analysis.source import of_folder
from rigidmd.errors import OutputError
from rigidmd.run.record import read_record

#: Share of the progress that reading takes.
READING = 0.25


class Task(NamedTuple):
    """What is asked for: names (all if empty), the time to begin at (ps) and a viscosity (mPa s), if given."""

    names: list[str]
    start: float | None = None
    viscosity: float | None = None


class Done(NamedTuple):
    """failed : analysis -> why it found nothing, of analyses that were not asked for by name"""

    history: History
    findings: list[Finding]
    failed: dict[str, str]
    files: list[Path]


def analyse_folder(folder: Path, task: Task, step: Callable[[float, str], object] = lambda share, name: None) -> Done:
    """Analyse the run in a folder and write the files into it.

    step : called with the share that is done and what is being done. An analysis that a run is not made for is left out
    with a sentence, unless it was asked for by its name. Raises OutputError.
    """
    entries = selected(task.names)
    step(0.0, "reading frames")
    history = of_folder(read_record(folder), task.start, lambda share: step(READING * share, "reading frames"))
    findings, failed = [], {}
    for k, entry in enumerate(entries):
        step(READING + (1 - READING) * k / len(entries), entry.name)
        more = {"viscosity_mPa_s": task.viscosity} if entry.name == "diffusion" else {}
        try:
            findings.append(entry.function(history, **more))
        except OutputError as error:
            if task.names:
                raise OutputError(f"{folder}: {error}") from None
            failed[entry.name] = str(error)
    if not findings:
        raise OutputError(f"{folder}: no analysis is possible: {'; '.join(failed.values())}")
    files = write_findings(folder, stretch_of(history), findings, failed)
    step(1.0, "")
    return Done(history, findings, failed, files)
