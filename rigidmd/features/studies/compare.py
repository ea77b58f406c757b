"""`rigidmd compare`: where two runs diverge, and how their inputs and versions differ."""

import filecmp
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from rigidmd.core.files import unreadable_reason
from rigidmd.core.state import State
from rigidmd.core.state_file import read_state
from rigidmd.core.toml import Json, read_toml
from rigidmd.errors import OutputError, RigidMDError, SceneError
from rigidmd.io.folder import FINAL, SCENE, SUMMARY, check_is_run
from rigidmd.io.run_files import Columns, Summary, read_json
from rigidmd.io.write import columns_text
from rigidmd.run.kind import Molecules, kinds
from rigidmd.run.resume import MADE_WITH, differences, keys_of

#: Columns by which samples are matched: steps if they have the same times in both files, else
#: times.
STEP = "Step"
TIMES = ("Time (ps)", "time")
Content = TypeVar("Content")
BITS = 53  # bits of the significand of a float64


@dataclass
class CellDifference:
    column: str
    first: str
    second: str
    # last bits of 53 that differ: 1 for neighbours, 53 for unlike numbers; None for text
    bits: int | None


#: Units of the state of molecules.
UNITS = {
    "position": "Å",
    "velocity": "Å/ps",
    "angular_momentum_body": "u Å²/ps",
    "cell": "Å",
    "time": "ps",
}


@dataclass
class SampleComparison:
    """Samples of two runs, matched by their steps or, with unlike steps, by their times."""

    file: str
    lengths: tuple[int, int]
    common: int
    clock: str
    at: str | None = None  # the clock's value at the first sample that differs
    index: int = 0  # that sample among the common ones, from 0
    first: list[CellDifference] = field(default_factory=list)  # columns that differ there
    # columns that differ at the last common sample
    last: list[CellDifference] = field(default_factory=list)
    only: list[str] = field(default_factory=list)  # columns of one file alone


@dataclass
class RunComparison:
    """The differences of two runs. Values of dictionaries are pairs."""

    folders: tuple[str, str]
    scene: dict[str, tuple] = field(default_factory=dict)  # dotted key -> values that differ
    # key of summary.json -> values that differ
    made: dict[str, tuple] = field(default_factory=dict)
    samples: SampleComparison | None = None
    # array of final.npz -> largest difference, internal units; None for unlike shapes
    state: dict[str, float | None] = field(default_factory=dict)
    # other files of both -> whether their bytes are the same
    files: dict[str, bool] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)  # what could not be compared

    @property
    def same(self) -> bool:
        """Whether all that both runs computed is the same to the last bit, and they have the same
        length."""
        samples = self.samples
        same_samples = samples is None or (
            samples.at is None and samples.lengths == (samples.common, samples.common)
        )
        return same_samples and not self.state and all(self.files.values()) and not self.missing

    def to_json(self) -> Json:
        return asdict(self) | {"same": self.same}


def compare(first: Path, second: Path) -> RunComparison:
    """Compare two folders of runs. Raises OutputError if one is not such a folder."""
    for folder in (first, second):
        check_is_run(folder)
    found = RunComparison((str(first), str(second)))

    def either(name: str) -> bool:
        return (first / name).exists() or (second / name).exists()

    def both(name: str, read: Callable[[Path], Content | None]) -> list[Content]:
        """The content of this file in both folders. Empty, which `missing` explains, if one of them
        cannot be read."""
        contents = []
        for path in (first / name, second / name):
            try:
                content = read(path)
                why = f"{path} does not exist"
            except RigidMDError as error:
                content = None
                why = str(error)
            if content is None:
                found.missing.append(why)
            else:
                contents.append(content)
        return contents if len(contents) == 2 else []

    if scenes := both(SCENE, lambda path: read_toml(path, SceneError)[0]):
        found.scene = differences(*(keys_of(scene, ("name", "threads")) for scene in scenes))
    if summaries := both(SUMMARY, lambda path: read_json(path, Summary)):
        made = []
        for there in (summary.model_dump(exclude_unset=True) for summary in summaries):
            of_run = {key.replace("_", " "): there[key] for key in MADE_WITH if key in there}
            of_run |= {
                f"processor has {feature}": True for feature in there.get("processor_features", ())
            }
            made.append(
                of_run
                | {f"file of {key}": sha[:12] for key, sha in there.get("input_sha256", {}).items()}
            )
        found.made = differences(made[0], made[1], "not recorded")
    for kind in kinds():
        name = kind.samples_file
        if either(name) and (tables := both(name, kind.read_samples)):
            found.samples = _compare_samples(name, *tables)
    if either(FINAL) and (saved := both(FINAL, read_state)):
        for name, a, b in zip(State._fields, *(of.state for of in saved), strict=True):
            if a.shape != b.shape:
                found.state[name] = None
            elif a.tobytes() != b.tobytes():
                found.state[name] = float(np.abs(a - b).max())
    for key in ("output.topology", "output.trajectory"):
        names = [keys_of(scene, ()).get(key) for scene in scenes]
        if (
            scenes
            and isinstance(name := names[0], str)
            and names[1] == name
            and Path(name).name == name
        ):
            paths = first / name, second / name
            if missing := [
                f"{path}: {reason}" for path in paths if (reason := unreadable_reason(path))
            ]:
                found.missing += missing
            else:
                found.files[name] = filecmp.cmp(*paths, shallow=False)
    return found


def _compare_samples(file: str, one: Columns, other: Columns) -> SampleComparison:
    """Compare the columns of two files. Raises OutputError."""
    first, second = one.cells, other.cells
    columns = [name for name in first if name in second]
    only = [name for name in (*first, *second) if name not in columns]
    time = next((name for name in TIMES if name in columns), None)
    if time is None:
        raise OutputError(f"{file}: no column of times")
    clock = time
    if STEP in columns:
        times = dict(zip(second[STEP], second[time], strict=True))
        if all(
            times.get(step, value) == value
            for step, value in zip(first[STEP], first[time], strict=True)
        ):
            clock = STEP
    for columns_of in (one, other):
        columns_of.numbers(clock)
    lengths = len(first[clock]), len(second[clock])
    rows_of_second = _rows_by_value(second[clock])
    rows = [
        (k, rows_of_second[key])
        for key, k in _rows_by_value(first[clock]).items()
        if key in rows_of_second
    ]
    found = SampleComparison(file, lengths, len(rows), clock, only=only)
    compared = [name for name in columns if name != STEP or clock == STEP]
    for index, (i, j) in enumerate(rows):
        pairs = [(name, first[name][i], second[name][j]) for name in compared]
        unlike = [CellDifference(name, a, b, last_bits(a, b)) for name, a, b in pairs if a != b]
        if unlike and found.at is None:
            found.at, found.index, found.first = first[clock][i], index, unlike
        found.last = unlike
    return found


def _rows_by_value(values: list[str]) -> dict[tuple[str, int], int]:
    """(value, number of earlier rows with it) -> row. A step has two samples where a stage
    starts."""
    seen: dict[str, int] = {}
    rows = {}
    for row, value in enumerate(values):
        key = f"{float(value):.9g}" if value else value
        rows[key, seen.setdefault(key, 0)] = row
        seen[key] += 1
    return rows


def last_bits(first: str, second: str) -> int | None:
    """Number of last bits that differ: bits of the count of floats between two numbers, at most 53.
    None for text."""
    try:
        numbers = np.array([float(first), float(second)]).view(np.int64)
    except ValueError:
        return None
    ordered = [int(x) if x >= 0 else -(int(x) & (2**63 - 1)) for x in numbers]
    return min(abs(ordered[0] - ordered[1]).bit_length(), BITS)


def describe_run_comparison(found: RunComparison) -> str:
    """The comparison of two runs as text."""
    one, other = found.folders
    rows = [
        (name, [f"{key}: {a} and {b}" for key, (a, b) in unlike.items()] or ["the same"])
        for name, unlike in (("scene", found.scene), ("made with", found.made))
    ]
    if found.samples is not None:
        rows.append((found.samples.file, _describe_samples(found.samples)))
    rows += [
        (name, ["the same bytes" if same else "other bytes"]) for name, same in found.files.items()
    ]
    if found.state:
        is_molecular = found.samples is None or found.samples.file == Molecules.samples_file
        units = UNITS if is_molecular else {}
        by = {
            name: "in shape"
            if value is None
            else f"by up to {value:.3g} {units.get(name, '')}".rstrip()
            for name, value in found.state.items()
        }
        samples = found.samples
        is_longer = samples is not None and samples.lengths[0] != samples.lengths[1]
        lengths = " (different lengths)" if is_longer else ""
        rows.append(
            (
                FINAL,
                [f"differs{lengths}: {', '.join(f'{name} {how}' for name, how in by.items())}"],
            )
        )
    elif (
        found.samples is not None
        and found.samples.file == Molecules.samples_file
        and not any(FINAL in text for text in found.missing)
    ):
        rows.append((FINAL, ["the same to the last bit"]))
    rows += [("missing", [text]) for text in found.missing]
    cells = [("", "" if k else name, text) for name, texts in rows for k, text in enumerate(texts)]
    verdict = "the runs are not the same"
    samples = found.samples
    if found.same:
        verdict = "the runs are the same to the last bit"
    elif samples is not None and samples.at is not None:
        verdict = (
            f"the runs diverge at {samples.clock} {samples.at}, sample {samples.index + 1} of"
            f" {samples.common}"
        )
    elif samples is not None and samples.lengths != (samples.common, samples.common):
        verdict = "the runs are bitwise identical over their common samples"
    return "\n".join([f"{one} and {other}", columns_text(cells, left=(0, 1, 2)), "", verdict])


def _describe_samples(samples: SampleComparison) -> list[str]:
    n, m = samples.lengths
    lengths = (
        f"{n} samples in both"
        if n == m == samples.common
        else f"{n} and {m} samples, {samples.common} in common"
    )
    lines = [f"a column of one run only: {name}" for name in samples.only]
    if samples.at is None:
        return [f"{lengths}, the same to the last bit", *lines]
    first = f"{lengths}. The first that differs, at {samples.clock} {samples.at}:"
    lines = [first, *_describe_cells(samples.first), *lines]
    if samples.last and samples.common - 1 > samples.index:
        lines += ["the last in common:", *_describe_cells(samples.last)]
    return lines


def _describe_cells(unlike: list[CellDifference]) -> list[str]:
    rows = [
        (
            "",
            cell.column,
            f"{cell.first or 'nothing'} and {cell.second or 'nothing'}"
            + (f"  last {cell.bits} of {BITS} bits" if cell.bits else ""),
        )
        for cell in unlike
    ]
    return columns_text(rows, left=(0, 1, 2)).splitlines()
