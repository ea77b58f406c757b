"""Python files with user code, which run only if the user trusts them: forces of a scene, and
analyses."""

from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

from rigidmd.core.files import unreadable_reason
from rigidmd.core.user_modules import USER_FILE_PREFIX, digest_of, module_of
from rigidmd.errors import SceneError, describe_error, option
from rigidmd.scene import Scene
from rigidmd.scene.validation import in_python

#: Digests of the files that may run.
_TRUSTED: set[str] = set()


def trust_file(path: str | Path) -> None:
    """Allow scenes to run a Python file with these contents, at any path.

    The code can do anything that you can do: read it before. On the command line, --trust FILE does
    the same.

    Parameters
    ----------
    path : str or Path
        Path of the Python file

    Raises
    ------
    SceneError
        If the file cannot be read.
    """
    _TRUSTED.add(digest_of(_source(Path(path), option("trust"))))


def check_trusted(scene: Scene, paths: Sequence[str]) -> None:
    """Raise SceneError for a trusted file that the scene does not run."""
    for path in unused_files(scene, paths):
        named = ", ".join(map(str, _modules(scene)))
        files = f"it names {named}" if named else "it names none"
        what = (
            "is not a file that [[forces.custom]] or [[forces.bodies]] of"
            f" {scene.source} names by module"
        )
        raise SceneError(option("trust"), [f"{path} {what}: {files}"])


def unused_files(scene: Scene, paths: Sequence[str]) -> list[str]:
    """The trusted files that a scene does not run."""
    contents = [_source(path, "forces") for path in _modules(scene)]
    return [path for path in paths if _source(Path(path), option("trust")) not in contents]


def _modules(scene: Scene) -> list[Path]:
    return [path for key, path in scene.inputs.items() if key.endswith(".module")]


def trusted_module(path: Path, key: str) -> ModuleType:
    """The module of a file that a scene names by `key`, if it is trusted. Raises SceneError."""
    source = _source(path, key)
    if digest_of(source) not in _TRUSTED:
        why = "is Python code, which can do whatever you can: read it, and if you trust it,"
        advice = f"call rigidmd.trust_file({str(path)!r})"
        if not in_python():
            advice = f"add {option('trust')} {path} (in Python: {advice.removeprefix('call ')})"
        raise SceneError(key, [f"{path} {why} {advice}"])
    try:
        return module_of(source, str(path), USER_FILE_PREFIX)
    except SceneError:
        raise
    except (Exception, SystemExit) as error:  # user code may raise anything
        line = f", line {error.lineno}" if isinstance(error, SyntaxError) else ""
        raise SceneError(key, [f"{path}{line} raised {describe_error(error)}"]) from error


def _source(path: Path, key: str) -> bytes:
    if fault := unreadable_reason(path):
        raise SceneError(key, [f"{fault}: {path}"])
    try:
        return path.read_bytes()
    except OSError as error:
        raise SceneError(key, [f"{path} cannot be read: {error.strerror}"]) from None
