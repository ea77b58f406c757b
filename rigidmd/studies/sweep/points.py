"""The points of a sweep, each a scene of its own: all are read and checked before the first one runs."""

import hashlib
import json
from collections.abc import Sequence
from math import inf
from pathlib import Path
from typing import Any

from rigidmd.errors import InputError, RigidMDError, SceneError
from rigidmd.run.provenance import APART, keys_of, plain, scene_digest
from rigidmd.scene import BodyScene, MolecularScene, Scene
from rigidmd.studies.sweep.axes import Axis, settings
from rigidmd.studies.sweep.folder import SEED, Manifest, Point
from rigidmd.studies.sweep.names import in_words, point_name, short_keys


def points_of(path: str | Path, axes: Sequence[Axis]) -> tuple[Manifest, bool]:
    """All points of a sweep over a scene file, checked, and whether they are of a single body.

    Raises SceneError with all faults of all points.
    """
    swept = [axis for axis in axes if axis.swept]
    keys = {axis.keys[0]: list(axis.keys) for axis in swept}
    fixed = {key: axis.values[0] for axis in axes if not axis.swept for key in axis.keys}
    short = short_keys(keys)
    every = settings(axes)
    digest = Digests()
    faults: dict[str, list[str]] = {}  # each with the points that have it
    checked: dict[str, RigidMDError | None] = {}  # values but for the seed -> what is wrong; replicas are built alike
    asked, scene = None, None
    for values in every:
        overrides = fixed | {key: value for first, value in values.items() for key in keys[first]}
        told = in_words(values, short)
        try:
            scene = Scene.read(path, overrides)
            kind = json.dumps({key: value for key, value in values.items() if key != SEED}, default=str)
            if kind not in checked:
                checked[kind] = _fault_of(scene)
            if (wrong := checked[kind]) is not None:
                raise wrong
        except RigidMDError as error:
            where = f"{error.where}: " if isinstance(error, InputError) and error.where != str(path) else ""
            for fault in error.faults if isinstance(error, InputError) else [str(error)]:
                faults.setdefault(f"{where}{fault}", []).append(told)
            continue
        if asked is None:
            apart = [key for together in keys.values() for key in together]
            common, inputs = common_part(scene, apart, digest)
            asked = Manifest(scene.name, str(Path(path).absolute()), keys, fixed, common, inputs)
        asked.points.append(Point(point_name(values, short), values, digest.of(scene)))
    if faults or asked is None:
        raise SceneError(str(path), [_in_words(fault, points, len(every)) for fault, points in faults.items()])
    return asked, isinstance(scene, BodyScene)


def common_part(scene: Scene, apart: Sequence[str], digest: "Digests") -> tuple[dict[str, Any], dict[str, str]]:
    """Keys of a scene and digests of its inputs, without the swept keys."""
    keys = keys_of(plain(scene), (*APART, *apart, *scene.inputs, *scene.embedded_files))
    keys = {key: str(value) if value in (inf, -inf) else value for key, value in keys.items()}  # JSON has no infinity
    inputs = {key: sha for key, sha in digest.inputs(scene).items() if key not in apart}
    return keys, inputs


class Digests:
    """Digests of scenes, for which each file is read once."""

    def __init__(self):
        self._known: dict[Path, str] = {}

    def inputs(self, scene: Scene) -> dict[str, str]:
        """SHA-256 of each file that a scene reads, by its dotted key. Raises SceneError."""
        try:
            for path in scene.inputs.values():
                if path not in self._known:
                    self._known[path] = hashlib.sha256(path.read_bytes()).hexdigest()
        except OSError as error:
            raise SceneError(scene.source, [f"{error.filename} cannot be read: {error.strerror}"]) from None
        return {key: self._known[path] for key, path in scene.inputs.items()}

    def of(self, scene: Scene) -> str:
        """SHA-256 of a scene, as it was read, and of all files that it reads."""
        told = json.dumps([scene_digest(scene), self.inputs(scene)], sort_keys=True)
        return hashlib.sha256(told.encode()).hexdigest()


def _fault_of(scene: MolecularScene | BodyScene) -> RigidMDError | None:
    """What only the system of a scene shows to be wrong."""
    from rigidmd.assemble.body import build_body
    from rigidmd.assemble.build import build

    try:
        if not isinstance(scene, BodyScene):
            build(scene)
        elif not scene.run.is_auto:
            build_body(scene)
    except RigidMDError as error:
        return error
    return None


def _in_words(fault: str, points: list[str], count: int) -> str:
    """A fault with the points that have it; one of all `count` points is that of the scene."""
    if len(points) == count and count > 1:
        return fault
    more = f" and {len(points) - 1} more points" if len(points) > 1 else ""
    return f"at {points[0]}{more}: {fault}"
