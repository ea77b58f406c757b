"""The folder of a run. It is never overwritten without `force`, and its files are complete or
absent."""

import os
from collections.abc import Iterable
from pathlib import Path

from filelock import FileLock, Timeout

from rigidmd.core.files import is_temporary, unreadable_reason, write_text, writing
from rigidmd.core.toml import shorten_text
from rigidmd.errors import OutputError, option, resume_command

#: Names of files of a run. The scene names trajectory and topology.
SCENE = "scene.toml"
LOG = "log.csv"
FINAL, LAST_GOOD, SUMMARY = "final.npz", "last_good_state.npz", "summary.json"
CHECKPOINT, PREVIOUS = "checkpoint.npz", "checkpoint_previous.npz"
#: Marks the folder of a run and lists the files that the run may write, one per line. `force` may
#: remove them.
MARKER = ".rigidmd-run"
LOCK = ".rigidmd-lock"
#: The manifest of a sweep, in the parent folder of its runs.
SWEEP = "sweep.json"


def elsewhere() -> str:
    """The advice to take another folder, for messages."""
    return f"{option('folder')} names another folder"


def check_folder(
    folder: Path,
    *,
    force: bool,
    inputs: Iterable[Path] = (),
    names: Iterable[str] = (),
    what: str = "run",
    marker: str = MARKER,
) -> None:
    """Raise OutputError if a run, or another `what`, cannot be written to a folder, or would remove
    one of its inputs. Changes nothing. `names`: files that it will write. Existing ones must have
    been written by an earlier one."""
    try:
        exists = folder.exists()
    except OSError as error:  # a name that is too long
        raise OutputError(
            f"{shorten_text(str(folder))} cannot be written: {error.strerror}"
        ) from None
    if exists and not folder.is_dir():
        raise OutputError(f"{folder} is a file; {elsewhere()}")
    if not is_empty(folder):
        if not (folder / marker).is_file():
            raise OutputError(f"{folder} is not empty and holds no earlier {what}; {elsewhere()}")
        if not force:
            if (folder / CHECKPOINT).is_file():
                resume = f"{resume_command(folder)} continues it, "
            else:
                resume = ""
            advice = f"{resume}{option('force')} replaces it, {elsewhere()}"
            raise OutputError(f"{folder} holds an earlier {what}; {advice}")
        replaced = {(folder / name).resolve() for name in written_by_runs(folder, marker)}
        if used := [path for path in inputs if path.resolve() in replaced]:
            raise OutputError(
                f"{used[0]} is an input of this run and would be replaced; {elsewhere()}"
            )
        check_names(folder, names, marker)
    parent = folder
    while not parent.exists():
        parent = parent.parent
    if not parent.is_dir() or not os.access(parent, os.W_OK | os.X_OK):
        raise OutputError(f"{folder} cannot be written: no permission in {parent}; {elsewhere()}")


def check_names(folder: Path, names: Iterable[str], marker: str = MARKER) -> None:
    """Raise OutputError if a file of one of these names is in a folder whose marker does not list
    it."""
    known = {*written_by_runs(folder, marker), marker, LOCK}
    if foreign := [name for name in names if name not in known and os.path.lexists(folder / name)]:
        problem = f"{folder / foreign[0]} exists, was not written by rigidmd, and would be replaced"
        raise OutputError(f"{problem}. Move it away, or {elsewhere()}")


def write_marker(folder: Path, names: Iterable[str], marker: str = MARKER) -> None:
    """List the files of a run in its folder."""
    write_text(folder / marker, "\n".join(dict.fromkeys(names)) + "\n")


def make_folder(folder: Path, names: Iterable[str], lock: "FolderLock") -> None:
    """Make the folder of a run that will write these files, after `check_folder`. Only files that
    an earlier run wrote
    are removed. lock : was taken before the check, and is taken now if the folder is new. Raises
        OutputError."""
    with writing(folder, "made"):
        if not lock.is_taken:
            folder.mkdir(parents=True)  # an error if another run has made it since the check
            lock.take()
        for name in written_by_runs(folder):
            (folder / name).unlink(missing_ok=True)
        write_marker(folder, names)


def check_is_run(folder: Path) -> None:
    """Raise OutputError unless a run has written to a folder."""
    if not folder.is_dir():
        path = str(folder)
        what = f"{path} is a file" if folder.exists() else f"the folder {path!r} does not exist"
        raise OutputError(f"{what}. Name the folder of a run, such as runs/water")
    if (folder / SWEEP).is_file():
        raise OutputError(f"{folder} is the folder of a sweep. Name one of the runs in it")
    if not (folder / MARKER).is_file() or not (folder / SCENE).is_file():
        raise OutputError(
            f"{folder} is not the folder of a run: `rigidmd run` wrote no {SCENE} there"
        )
    for path in folder.iterdir():
        check_inside(path)


def check_inside(path: Path) -> None:
    """Raise OutputError if a file is a link out of its folder.

    Pages and tables of a run from others would otherwise show what other files of this user
    contain.
    """
    if not path.is_symlink():
        return
    try:
        inside = path.resolve().is_relative_to(path.parent.resolve())
    except (OSError, RuntimeError):  # a loop of links
        inside = False
    if not inside:
        raise OutputError(
            f"{path} is a link out of its folder, which is not followed. Put a copy of the file"
            " there"
        )


def add_to_folder(folder: Path, names: Iterable[str]) -> None:
    """List files that are made from a run, so that a new run in the folder removes them. Raises
    OutputError."""
    names = list(names)
    check_names(folder, names)
    write_marker(folder, [*written_by_runs(folder), *names])


class FolderLock:
    """Keeps other runs out of a folder. The operating system releases it when the process ends in
    any way."""

    def __init__(self, folder: Path):
        self._folder = folder
        # any thread may end a run
        self._lock = FileLock(folder / LOCK, timeout=0, thread_local=False)

    @property
    def is_taken(self) -> bool:
        return self._lock.is_locked

    def take(self) -> None:
        """Take the lock unless it is taken already or the folder does not exist. Raises
        OutputError."""
        if self.is_taken or not self._folder.is_dir():
            return
        try:
            self._lock.acquire()
        except Timeout:
            raise OutputError(f"another run is writing in {self._folder}; {elsewhere()}") from None
        except OSError as error:
            raise OutputError(f"{self._folder} cannot be written: {error.strerror}") from None

    def release(self) -> None:
        self._lock.release()

    def __enter__(self) -> "FolderLock":
        self.take()
        return self

    def __exit__(self, *error: object) -> None:
        self.release()


def never_began(folder: Path, samples_file: str) -> bool:
    """Whether a run ended before its first checkpoint, so that nothing is lost if it is started
    again."""
    ended = (CHECKPOINT, PREVIOUS, FINAL, LAST_GOOD, SUMMARY)
    if CHECKPOINT not in written_by_runs(folder) or any((folder / name).exists() for name in ended):
        return False
    samples = folder / samples_file
    with writing(samples, "read"):
        # their header, the start
        is_short = (
            not unreadable_reason(samples, 1e5) and len(samples.read_bytes().splitlines()) <= 2
        )
    return is_short or not samples.exists()


class RunMark:
    """Recognises the last run in a folder, by its scene file, which no other run leaves
    unchanged."""

    def __init__(self, folder: Path, *, is_complete: bool):
        self._folder, self.is_complete = folder, is_complete
        self._written = self._last_written()

    def _last_written(self) -> tuple[int, int] | None:
        try:
            status = (self._folder / SCENE).stat()
        except OSError:
            return None
        return status.st_ino, status.st_mtime_ns

    @property
    def is_there(self) -> bool:
        """Whether the files in the folder are still those of this run."""
        return self._written is not None and self._written == self._last_written()

    @property
    def can_continue(self) -> bool:
        """Whether something of the run remains to be done, and it has a checkpoint."""
        return not self.is_complete and any(
            (self._folder / name).is_file() for name in (CHECKPOINT, PREVIOUS)
        )


def offsets_of(trajectory: Path) -> list[Path]:
    """The files that MDAnalysis writes next to a trajectory that it reads."""
    return [
        trajectory.with_name(f".{trajectory.name}_offsets.{extension}")
        for extension in ("npz", "lock")
    ]


def is_empty(folder: Path) -> bool:
    """Whether a folder is absent or has only a lock and temporary files of a run that was
    killed."""
    return not folder.exists() or all(
        path.name == LOCK or is_temporary(path) for path in folder.iterdir()
    )


def written_by_runs(folder: Path, marker: str = MARKER) -> list[str]:
    """Files that an earlier run in this folder may have written. Only plain names in its marker are
    used."""
    path = folder / marker
    with writing(path, "read"):
        names = (
            path.read_text(encoding="utf-8", errors="replace").split("\n") if path.is_file() else []
        )
    return [name for name in names if name and Path(name).name == name]
