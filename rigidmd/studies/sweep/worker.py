"""A process that runs points of a sweep, one after another: `python -m rigidmd.studies.sweep.worker`.

Each line of its standard input is a task, each line of its output a message, both JSON. It ends with its input: when
its parent process has died, it stops with a checkpoint.
"""

import contextlib
import json
import os
import queue
import signal
import sys
import threading
import time as clock
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypedDict

from filelock import FileLock, Timeout

from rigidmd.core.files import writing
from rigidmd.errors import OutputError, RigidMDError
from rigidmd.io.folder import LOCK
from rigidmd.studies.sweep.folder import State, SweepPoint, state_on_disk

PROGRESS_REPORTS = 100  # number of progress messages of a run
#: Seconds to wait for a run in the folder of a point that is about to stop: its sweep was killed, or dask moved it.
LOCK_TIMEOUT = 120.0

Send = Callable[[str, Any], None]


class PointTask(TypedDict):
    folder: str  # of the sweep
    name: str  # of the point's folder in it
    scene: str
    overrides: dict[str, Any]
    trust: list[str]
    sha256: str  # digest of its scene
    ran_sha256: str | None
    ends_at: float | None  # `time.time()` at which it has to have ended; None for never


class PointResult(TypedDict):
    state: State
    message: str | None
    sha256: str | None  # scene_sha256 of its summary
    seconds: float
    out_of_time: bool


def run_task(task: PointTask, send: Send = lambda kind, value: None, progress: bool = False) -> PointResult:
    """Run a point in its folder, from its last checkpoint if it has one; a point that has finished is not run again.

    send : called with ("begun", None) when it is compiled, ("fraction", fraction done), ("announced" or "warned", text)
    """
    began = clock.monotonic()
    ended: PointResult = {"state": "failed", "message": None, "sha256": None, "seconds": 0.0, "out_of_time": False}
    try:
        _run(task, send, progress, ended)
    except RigidMDError as error:
        ended["message"] = str(error)
    except KeyboardInterrupt:
        ended["state"] = "interrupted"
    except MemoryError:
        ended["message"] = "not enough memory; run fewer points at a time (--jobs)"
    except Exception as error:
        traceback.print_exc()
        ended["message"] = f"{type(error).__name__}: {error}"
    ended["seconds"] = clock.monotonic() - began
    return ended


def _run(task: PointTask, send: Send, progress: bool, ended: PointResult) -> None:
    from rigidmd.assemble.user_code.trust import trust
    from rigidmd.run import Every, Observer, Simulation
    from rigidmd.scene import BodyScene, Scene
    from rigidmd.studies.sweep.plan import Digests

    class Begun(Observer):
        def begin(self, run: Simulation) -> None:
            send("begun", None)

    for path in task["trust"]:
        trust(path)
    scene = Scene.read(task["scene"], task["overrides"])
    if Digests().of(scene) != task["sha256"]:
        raise RigidMDError(f"{task['scene']} or a file that it reads has changed since the sweep began")
    sweep, folder = Path(task["folder"]), Path(task["folder"]) / task["name"]
    wait_for_folder(folder)
    point = SweepPoint(task["name"], {}, task["sha256"], ran_sha256=task["ran_sha256"])
    if state_on_disk(sweep, point) == "finished":
        ended["state"], ended["sha256"] = "finished", task["ran_sha256"]
        return
    walltime = None if task["ends_at"] is None else max(0.0, task["ends_at"] - clock.time())
    observers: list[Observer] = [Begun()]
    whole = scene.run.duration_s if isinstance(scene, BodyScene) else sum(stage.duration for stage in scene.stages)
    if whole > 0:
        fraction = lambda moment: send("fraction", min(1.0, moment.time / whole))  # noqa: E731
        observers.append(Every(whole / PROGRESS_REPORTS, fraction))
    resume = scene.output.checkpoint_minutes is not False  # without checkpoints it starts again
    simulation = Simulation(
        scene, folder, not resume, observers=observers, say=lambda sentence: send("announced", sentence),
        warn=lambda sentence: send("warned", sentence), resume=resume, walltime=walltime,
    )  # fmt: skip
    results = simulation.run(progress=progress)
    ended["state"] = "interrupted" if results.interrupted else "finished"
    ended["sha256"] = None if results.interrupted else results.summary["scene_sha256"]
    ended["out_of_time"] = results.out_of_time


def wait_for_folder(folder: Path, timeout: float = LOCK_TIMEOUT) -> None:
    """Wait until no other run writes in a folder. Raises OutputError after the timeout."""
    with writing(folder):
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with FileLock(folder / LOCK, timeout=timeout):
                pass
        except Timeout:
            raise OutputError(f"another run is writing in {folder}, and did not end within {timeout:g} s") from None


def main() -> None:
    """Run tasks until standard input ends."""
    channel = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what others print must not be read as a message
    tasks: queue.SimpleQueue[PointTask | None] = queue.SimpleQueue()

    def read() -> None:
        for line in sys.stdin:
            tasks.put(json.loads(line))
        tasks.put(None)
        os.kill(os.getpid(), signal.SIGTERM)  # a run stops at its next observation

    def send(kind: str, value: Any) -> None:
        with contextlib.suppress(BrokenPipeError):  # the parent has died: the run is stopping
            print(json.dumps([kind, value]), file=channel, flush=True)

    threading.Thread(target=read, daemon=True).start()
    while (task := tasks.get()) is not None:
        send("ended", run_task(task, send))
    os._exit(0)


if __name__ == "__main__":
    main()
