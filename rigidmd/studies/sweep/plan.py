"""What a sweep has to do: what is asked for, held against what its folder has."""

from pathlib import Path
from typing import Any

from rigidmd.core.toml import shortened
from rigidmd.errors import OutputError
from rigidmd.run.provenance import differences
from rigidmd.studies.sweep.axes import Axis
from rigidmd.studies.sweep.folder import (
    FAILED,
    FINISHED,
    Manifest,
    Point,
    clear_sweep,
    is_sweep,
    read_manifest,
    state_on_disk,
)

#: Differences that are told.
MOST_TOLD = 8


def known_axes(folder: Path, axes: list[Axis]) -> list[Axis]:
    """The axes in the order of the sweep in a folder; a single value of a key that it varies is one more value."""
    if not is_sweep(folder):
        return axes
    keys = read_manifest(folder).keys
    known = [axis._replace(swept=axis.swept or keys.get(axis.keys[0]) == list(axis.keys)) for axis in axes]
    order = list(keys)
    return sorted(known, key=lambda axis: order.index(axis.keys[0]) if axis.keys[0] in order else len(order))


def planned(folder: Path, fresh: Manifest, force: bool) -> Manifest:
    """The manifest of a folder with what is asked for, in place, each point in the state that its folder tells.

    A sweep that is there keeps its points, and gets those that are new. force : remove it and begin anew. Raises
    OutputError, also if the scene is another one.
    """
    if not is_sweep(folder):
        return fresh
    if force:
        names = _names(folder)
        clear_sweep(folder, [*names, *(point.folder for point in fresh.points)])
        return fresh
    there = read_manifest(folder)
    if faults := _apart(there, fresh):
        told = faults[:MOST_TOLD] + ([f"and {len(faults) - MOST_TOLD} more"] if len(faults) > MOST_TOLD else [])
        raise OutputError(
            f"{folder} holds a sweep of another scene: {'; '.join(told)}. --force begins it anew, -o names another "
            "folder"
        )
    known = {point.folder for point in there.points}
    fresh.points = [*there.points, *(point for point in fresh.points if point.folder not in known)]
    for point in fresh.points:
        settle(folder, point)
    return fresh


def settle(folder: Path, point: Point) -> None:
    """Give a point the state that its folder tells; one that failed stays so until it runs again."""
    found = state_on_disk(folder, point)
    if found == FINISHED or point.state != FAILED:
        point.state = found


def _names(folder: Path) -> list[str]:
    """Folders of points and of means over replicas that are there; none if the manifest cannot be read."""
    try:
        there = read_manifest(folder)
        means = [there.folder_of(values) for values, _ in there.combinations() if values]
        return [*(point.folder for point in there.points), *means]
    except OutputError:
        return []


def _apart(there: Manifest, now: Manifest) -> list[str]:
    """What makes it another sweep: keys that are swept, values of others, files."""
    if there.keys != now.keys:
        return [f"it varies {_listed(there.keys)}, not {_listed(now.keys)}"]
    faults = [
        f"{key} is {_shown(after)}, there {_shown(before)}"
        for key, (before, after) in differences(there.common, now.common).items()
    ]
    faults += [f"the file of {key} has changed" for key in differences(there.inputs, now.inputs)]
    if faults:
        return faults
    known = {point.folder: point.scene_sha256 for point in there.points}
    return [
        f"what {point.folder} reads has changed"
        for point in now.points
        if known.get(point.folder, point.scene_sha256) != point.scene_sha256
    ]


def _listed(keys: dict[str, list[str]]) -> str:
    return " and ".join(", ".join(together) for together in keys.values())


def _shown(value: Any) -> str:
    return value if value == "left out" else shortened(value)
