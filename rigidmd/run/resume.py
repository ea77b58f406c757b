"""Checks of a checkpoint: that it belongs to the scene, and that its state and data are valid."""

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from rigidmd.core.state import NOW, ORIGIN, STORED_NAMES, State
from rigidmd.core.state_file import LARGEST, are_rotations, is_cell
from rigidmd.errors import CheckpointError
from rigidmd.run.provenance import NOT_COMPARED, computed_with, differences, input_digests, keys_of, plain
from rigidmd.scene import MolecularScene, Scene

T = TypeVar("T")


def check_same_scene(scene: Scene, before: Mapping[str, Any], inputs: Mapping[str, str], steps: int) -> None:
    """Raise CheckpointError unless a resolved scene can continue a run of the scene `before` after some steps.

    The last stage of molecules may be longer or shorter than before, but not shorter than it has run.
    """
    excluded = [*scene.inputs, *scene.embedded_files, *NOT_COMPARED]
    if isinstance(scene, MolecularScene) and not scene.stages[-1].ramps:
        excluded.append(f"stages.{len(scene.stages) - 1}.duration_ps")
        if sum(stage.steps for stage in scene.stages) < steps:
            raise CheckpointError(f"{scene.source}: the run in the folder is already longer, {steps} steps")
    unlike = differences(keys_of(plain(scene), excluded), keys_of(before, excluded))
    changes = [f"{key} is {now}, there {then}" for key, (now, then) in unlike.items()]
    found = input_digests(scene)
    changes += [f"the file of {key} has changed" for key in found if found[key] != inputs.get(key)]
    if changes:
        raise CheckpointError(
            f"{scene.source}: is not the scene of the run in the folder: {'; '.join(changes[:8])}. "
            "--force begins a new run, -o names another folder"
        )


def describe_changes(before: Mapping[str, Any]) -> str | None:
    """A sentence if the run so far was computed with other versions or on another processor; None otherwise."""
    now = computed_with()
    changed = [
        f"{key.replace('_', ' ').removesuffix(' version')} {then} there, {here} here"
        for key, (then, here) in differences(before, now, None).items()
        if key not in ("python_version", "processor_features")
    ]
    if not changed:
        return None
    return (
        f"the run so far was computed with {'; '.join(changed)}: from here on bits may differ from a run without a stop"
    )


def state_from(arrays: Mapping[str, np.ndarray], like: State, exact: bool = True) -> State:
    """The state in a checkpoint of a run whose states have arrays like `like`. Raises ValueError, KeyError.

    exact : whether the method of the run keeps rotation matrices orthogonal to rounding
    """
    found = State(*(np.array(arrays[name], order="C") for name in STORED_NAMES))
    for name, array, expected in zip(STORED_NAMES, found, like, strict=True):
        if array.dtype != expected.dtype or array.shape != expected.shape:
            raise ValueError(f"{name} has the shape {array.shape}, not {expected.shape}, or is of another type")
        if name != "cell" and not (np.abs(array) <= LARGEST).all():
            raise ValueError(f"{name} of its state is not finite")
    if exact and not are_rotations(found.rotation):
        raise ValueError("its state has matrices Q that are not rotations")
    if not is_cell(found.cell) or (np.isfinite(found.cell) != np.isfinite(like.cell)).any():
        raise ValueError("its state has another kind of box")
    if not (0 <= found.step[ORIGIN] <= found.step[NOW] and 0 <= found.time[ORIGIN] <= found.time[NOW]):
        raise ValueError("its step or time is before the start")
    return found


def read_as(kind: type[T], data: Any) -> T:
    """Data of a checkpoint, validated by pydantic as a type. Raises ValueError with one sentence."""
    try:
        return TypeAdapter(kind).validate_python(data)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise ValueError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}") from None


class ResumeData(BaseModel):
    """The data of a run, besides its state, that a checkpoint needs: what evolves, and the scene."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, ser_json_inf_nan="constants", populate_by_name=True)

    scene: dict[str, Any] = {}
    inputs: dict[str, str] = {}  # key -> SHA-256
    notes: list[str] = []

    def to_json(self, **changes: Any) -> dict[str, Any]:
        """JSON values for a checkpoint, which `read_as` reads."""
        return self.model_copy(update=changes).model_dump(mode="json", exclude_none=True, by_alias=True)


@contextlib.contextmanager
def as_checkpoint_errors(folder: Path | None) -> Iterator[None]:
    """Convert errors of checks and of wrong data into a CheckpointError."""
    try:
        yield
    except (KeyError, ValueError, TypeError, IndexError, AttributeError, ArithmeticError) as error:
        raise CheckpointError(
            f"the checkpoint in {folder} does not fit this run: {error}. --force begins a new run"
        ) from None
