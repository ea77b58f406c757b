"""Runs the points of a sweep: their order, the states in the manifest, wall time and signals."""

import contextlib
import signal
import time as clock
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rigidmd.run.checkpoints import checked_walltime
from rigidmd.run.signals import signal_handler
from rigidmd.scene import Scene
from rigidmd.studies.sweep.backends import Cluster, Pool
from rigidmd.studies.sweep.folder import FAILED, FINISHED, INTERRUPTED, RUNNING, Manifest, SweepPoint, write_manifest
from rigidmd.studies.sweep.plan import update_state
from rigidmd.studies.sweep.worker import PointTask

#: Seconds between two checks of the time, and between two writings of the manifest.
TICK, WRITING_INTERVAL = 0.5, 1.0
#: Seconds of a wall time for table and figure, and those that a point needs at least; at most these fractions of it.
SPARE, LEAST = 10.0, 20.0
SPARE_FRACTION, LEAST_FRACTION = 0.1, 0.2


@dataclass
class SweepOutcome:
    """How a sweep ended: names of points that finished, failed, had finished before, and are left."""

    finished: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    left: list[str] = field(default_factory=list)
    seconds: float = 0.0
    signal: int | None = None
    out_of_time: bool = False


def run_points(
    folder: Path, manifest: Manifest, runner: Pool | Cluster, walltime: float | None = None, trust: Sequence[str] = (),
    receive: Callable[[str, str, Any], object] = lambda name, kind, value: None,
) -> SweepOutcome:  # fmt: skip
    """Run what is not finished. A point waits while one that compiles the same code has not begun.

    walltime : seconds after which all has to have ended
    trust : Python files that the scene may run
    receive : called with (point, kind, value) of each message of the backend

    Raises OutputError if the manifest cannot be written.
    """
    began, found = clock.monotonic(), SweepOutcome()
    by_name = {point.folder: point for point in manifest.points}
    found.skipped = [point.folder for point in manifest.points if point.state == FINISHED]
    waiting = Waiting(manifest, [point for point in manifest.points if point.state != FINISHED])
    changed, written = True, 0.0
    ends_at, least = None, 0.0
    if walltime is not None:
        ends_at = clock.time() + checked_walltime(walltime) - min(SPARE, SPARE_FRACTION * walltime)
        least = min(LEAST, LEAST_FRACTION * walltime)
    pressed = 0

    def stop(number: int) -> None:
        nonlocal pressed
        found.signal = found.signal or number
        pressed += number == signal.SIGINT

    with signal_handler(stop, signal.SIGINT, signal.SIGTERM), contextlib.closing(runner):
        while True:
            late = ends_at is not None and clock.time() + least > ends_at
            while found.signal is None and not late and runner.free and (point := waiting.next()):
                runner.submit(task_of(folder, manifest, point, ends_at, trust))
            if not runner.running:
                break
            if found.signal is not None:
                runner.kill() if pressed > 1 else runner.stop()
            for name, kind, value in runner.messages(TICK):
                if kind != "died" or found.signal is None:  # else it was stopped before its first step
                    receive(name, kind, value)
                if kind not in ("begun", "ended", "died"):
                    continue
                changed, point = True, by_name[name]
                waiting.compiled(point)
                if kind == "begun":
                    point.state, point.message = RUNNING, None
                    continue
                if kind == "ended":
                    point.state, point.message, point.ran_sha256 = value["state"], value["message"], value["sha256"]
                    point.seconds += value["seconds"]
                    found.out_of_time |= value["out_of_time"]
                elif found.signal is None:
                    point.state, point.message = FAILED, value
                else:  # it was stopped before it sent its end
                    point.state = INTERRUPTED
                    update_state(folder, point)
                if point.state in (FINISHED, FAILED):
                    (found.finished if point.state == FINISHED else found.failed).append(name)
            if changed and clock.monotonic() - written > WRITING_INTERVAL:
                write_manifest(folder, manifest)
                changed, written = False, clock.monotonic()
    found.out_of_time |= found.signal is None and bool(waiting)
    found.left = [point.folder for point in manifest.points if point.state not in (FINISHED, FAILED)]
    write_manifest(folder, manifest)
    found.seconds = clock.monotonic() - began
    return found


def task_of(
    folder: Path, manifest: Manifest, point: SweepPoint, ends_at: float | None = None, trust: Sequence[str] = ()
) -> PointTask:
    return {
        "folder": str(folder.absolute()), "name": point.folder, "scene": manifest.scene,
        "overrides": manifest.overrides(point), "trust": [str(Path(path).absolute()) for path in trust],
        "sha256": point.scene_sha256, "ran_sha256": point.ran_sha256, "ends_at": ends_at,
    }  # fmt: skip


class Waiting:
    """Points that have not begun. One of those that compile the same code goes first, so that it is compiled once."""

    def __init__(self, manifest: Manifest, points: list[SweepPoint]):
        self._kinds: dict[str, str] = {}
        self._known: set[str] = set()  # kinds whose code is compiled
        self._first: str | None = None  # a point that compiles now
        self._queue = deque(points)
        for point in points:
            self._kinds[point.folder] = code_kind(Scene.read(manifest.scene, manifest.overrides(point)))

    def __bool__(self) -> bool:
        return bool(self._queue)

    def next(self) -> SweepPoint | None:
        for point in self._queue:
            known = self._kinds[point.folder] in self._known
            if known or self._first is None:
                self._first = self._first if known else point.folder
                self._queue.remove(point)
                return point
        return None

    def compiled(self, point: SweepPoint) -> None:
        """Note that a point has compiled its code, or will not any more."""
        self._known.add(self._kinds[point.folder])
        if self._first == point.folder:
            self._first = None


def code_kind(scene: Scene) -> str:
    """A text that is equal for scenes that compile the same code: keys and strings, without numbers and files."""

    def bare(value: Any) -> Any:
        match value:
            case bool() | str() | None:
                return value
            case int() | float():
                return 0
            case dict():
                return {key: bare(inner) for key, inner in sorted(value.items())}
            case _:
                return [bare(inner) for inner in value]

    from rigidmd.run.provenance import NOT_COMPARED, keys_of, plain

    return repr(bare(keys_of(plain(scene), (*scene.inputs, *scene.embedded_files, *NOT_COMPARED))))
