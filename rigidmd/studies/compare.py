"""`rigidmd compare`: where two runs part, and what differs in what they were made from."""

import hashlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rigidmd.core.files import file_fault
from rigidmd.core.state_file import read_state
from rigidmd.core.toml import read_toml
from rigidmd.errors import OutputError, RigidMDError, SceneError
from rigidmd.io.folder import FINAL, LOG, MOTION, SCENE, SUMMARY, check_is_run
from rigidmd.io.run_files import Columns, Summary, read_columns, read_json
from rigidmd.run.provenance import differences, keys_of

#: Of summary.json: what is compared besides the scene.
MADE = (
    "rigidmd_version", "numba_version", "llvmlite_version", "numpy_version", "python_version", "machine", "processor",
    "vector_bits", "numba_settings", "threads",
)  # fmt: skip
#: Columns by which samples are matched: steps if they mean the same times in both, else times.
STEP, TIMES = "Step", ("Time (ps)", "t")
#: Bits of the fraction of a number, the leading one included.
BITS = 53


class Apart(NamedTuple):
    """Two numbers of a column that are not the same."""

    column: str
    first: str
    second: str
    bits: int | None  # last bits of 53 that differ: 1 for neighbours, 53 for unlike numbers; None for words


@dataclass
class Course:
    """Samples of two runs, matched by their steps or, with unlike steps, by their times."""

    file: str
    samples: tuple[int, int]
    common: int
    clock: str
    at: str | None = None  # the clock's value at the first sample that differs
    index: int = 0  # that sample among the common ones, from 0
    first: list[Apart] = field(default_factory=list)  # columns that differ there
    last: list[Apart] = field(default_factory=list)  # columns that differ at the last common sample
    only: list[str] = field(default_factory=list)  # columns of one file alone


@dataclass
class Comparison:
    """Two runs beside each other. Values of dictionaries are pairs."""

    folders: tuple[str, str]
    scene: dict[str, tuple] = field(default_factory=dict)  # dotted key -> values that differ
    made: dict[str, tuple] = field(default_factory=dict)  # key of summary.json -> values that differ
    course: Course | None = None
    # array of final.npz -> largest difference, internal units; None for unlike shapes
    state: dict[str, float | None] = field(default_factory=dict)
    files: dict[str, bool] = field(default_factory=dict)  # other files of both -> whether their bytes are the same
    missing: list[str] = field(default_factory=list)  # what could not be compared

    @property
    def same(self) -> bool:
        """Whether all that both runs computed is the same to the last bit, and one is as long as the other."""
        course = self.course
        whole = course is None or (course.at is None and course.samples == (course.common, course.common))
        return whole and not self.state and all(self.files.values()) and not self.missing

    def told(self) -> dict[str, Any]:
        """As JSON has it."""
        course = self.course and asdict(self.course) | {
            key: [apart._asdict() for apart in getattr(self.course, key)] for key in ("first", "last")
        }
        return asdict(self) | {"same": self.same, "course": course}


def compare(first: Path, second: Path) -> Comparison:
    """Compare two folders of runs. Raises OutputError if one is not such a folder."""
    for folder in (first, second):
        check_is_run(folder)
    found = Comparison((str(first), str(second)))
    scenes = [_read(folder / SCENE, found, lambda path: read_toml(path, SceneError)[0]) for folder in (first, second)]
    if None not in scenes:
        found.scene = differences(*(keys_of(scene, ("name", "threads")) for scene in scenes))
    summaries = [_read(folder / SUMMARY, found, lambda path: read_json(path, Summary)) for folder in (first, second)]
    if None not in summaries:
        one, other = (_made(summary.model_dump(exclude_unset=True)) for summary in summaries)
        found.made = differences(one, other, "not told")
    for name in (LOG, MOTION):
        if any((folder / name).exists() for folder in (first, second)):
            tables = [_read(folder / name, found, read_columns) for folder in (first, second)]
            if None not in tables:
                found.course = _course(name, *tables)
    _compare_states(first / FINAL, second / FINAL, found)
    for key in ("output.topology", "output.trajectory"):
        names = [keys_of(scene, ()).get(key) for scene in scenes if scene]
        if len(names) == 2 and isinstance(name := names[0], str) and names[1] == name and Path(name).name == name:
            _compare_bytes(first / name, second / name, found)
    return found


def _made(summary: dict[str, Any]) -> dict[str, Any]:
    """What a run was made with and from, by names."""
    made = {key.replace("_", " "): summary[key] for key in MADE if key in summary}
    made |= {f"processor has {feature}": True for feature in summary.get("processor_features", ())}
    return made | {f"file of {key}": digest[:12] for key, digest in summary.get("input_sha256", {}).items()}


def _read(path: Path, found: Comparison, read: Callable[[Path], Any]) -> Any:
    """What a file holds; None, with a word on it, if it cannot be read."""
    try:
        if (content := read(path)) is None:
            found.missing.append(f"{path}: there is no such file")
        return content
    except RigidMDError as error:
        found.missing.append(str(error))
    return None


def _course(file: str, one: Columns, other: Columns) -> Course:
    """Where the columns of two files part. Raises OutputError."""
    first, second = one.cells, other.cells
    columns = [name for name in first if name in second]
    only = [name for name in (*first, *second) if name not in columns]
    time = next((name for name in TIMES if name in columns), None)
    if time is None:
        raise OutputError(f"{file}: there is no column of times")
    clock = STEP if STEP in columns and _agree(first, second, time) else time
    for columns_of in (one, other):
        columns_of.numbers(clock)
    lengths = len(first[clock]), len(second[clock])
    places = _places(second[clock])
    rows = [(k, places[value]) for value, k in _places(first[clock]).items() if value in places]
    found = Course(file, lengths, len(rows), clock, only=only)
    compared = [name for name in columns if name != STEP or clock == STEP]
    for index, (i, j) in enumerate(rows):
        unlike = [
            _apart(name, first[name][i], second[name][j]) for name in compared if first[name][i] != second[name][j]
        ]
        if unlike and found.at is None:
            found.at, found.index, found.first = first[clock][i], index, unlike
        found.last = unlike
    return found


def _agree(first: dict[str, list[str]], second: dict[str, list[str]], time: str) -> bool:
    """Whether the same steps have the same times."""
    times = dict(zip(second[STEP], second[time], strict=True))
    return all(times.get(step, value) == value for step, value in zip(first[STEP], first[time], strict=True))


def _places(values: list[str]) -> dict[tuple[str, int], int]:
    """Value and how often it came before -> row. A step has two samples where a stage begins anew."""
    seen: dict[str, int] = {}
    places = {}
    for row, value in enumerate(values):
        key = f"{float(value):.9g}" if value else value
        places[key, seen.setdefault(key, 0)] = row
        seen[key] += 1
    return places


def _apart(column: str, first: str, second: str) -> Apart:
    """How far apart two cells are."""
    try:
        return Apart(column, first, second, last_bits(float(first), float(second)))
    except ValueError:
        return Apart(column, first, second, None)


def last_bits(a: float, b: float) -> int:
    """How many of the last bits of two numbers differ: of the count of numbers from one to the other, 53 at most."""
    ordered = [int(x) if x >= 0 else -(int(x) & (2**63 - 1)) for x in np.array([a, b]).view(np.int64)]
    return min(abs(ordered[0] - ordered[1]).bit_length(), BITS)


def _compare_states(first: Path, second: Path, found: Comparison) -> None:
    """Largest difference of each array of two final states."""
    there = [path for path in (first, second) if path.exists()]
    if not there:
        return
    try:
        one, other = read_state(first), read_state(second)
    except RigidMDError as error:
        found.missing.append(str(error))
        return
    for name, a, b in zip(one.state._fields, one.state, other.state, strict=True):
        if a.shape != b.shape:
            found.state[name] = None
        elif a.tobytes() != b.tobytes():
            found.state[name] = float(np.abs(a - b).max())


def _compare_bytes(first: Path, second: Path, found: Comparison) -> None:
    """Whether two files have the same bytes."""
    if missing := [f"{path}: {fault}" for path in (first, second) if (fault := file_fault(path))]:
        found.missing += missing
        return
    digests = []
    for path in (first, second):
        with path.open("rb") as file:
            digests.append(hashlib.file_digest(file, "sha256").digest())
    found.files[first.name] = digests[0] == digests[1]


def in_words(found: Comparison) -> str:
    """The comparison as text."""
    one, other = found.folders
    rows = [("scene", _pairs(found.scene) or ["the same"])]
    rows += [("made with", _pairs(found.made) or ["the same"])]
    if found.course is not None:
        rows.append((found.course.file, _course_in_words(found.course)))
    rows += [(name, ["the same bytes" if same else "other bytes"]) for name, same in found.files.items()]
    if found.state:
        apart = [
            f"{name} in shape" if value is None else f"{name} by up to {value:.3g}"
            for name, value in found.state.items()
        ]
        rows.append((FINAL, [f"differs: {', '.join(apart)} (u, Å, ps)"]))
    elif found.course is not None and found.course.file == LOG and not any(FINAL in text for text in found.missing):
        rows.append((FINAL, ["the same to the last bit"]))
    rows += [("missing", [text]) for text in found.missing]
    width = max(len(name) for name, _ in rows)
    lines = [f"{one} against {other}"]
    for name, texts in rows:
        lines += [f"  {head:<{width}}  {text}" for head, text in zip((name, *[""] * len(texts)), texts, strict=False)]
    return "\n".join([*lines, "", _verdict(found)])


def _verdict(found: Comparison) -> str:
    """One line."""
    course = found.course
    if found.same:
        return "the runs are the same to the last bit"
    if course is not None and course.at is not None:
        return f"the runs part at {course.clock} {course.at}, sample {course.index + 1} of {course.common}"
    if course is not None and course.samples != (course.common, course.common):
        return "the runs are the same to the last bit as far as both have samples"
    return "the runs are not the same"


def _pairs(unlike: dict[str, tuple]) -> list[str]:
    """A line for each key."""
    return [f"{key}: {a} against {b}" for key, (a, b) in unlike.items()]


def _course_in_words(course: Course) -> list[str]:
    """Lines about the samples."""
    n, m = course.samples
    lengths = f"{n} samples in both" if n == m == course.common else f"{n} and {m} samples, {course.common} in common"
    lines = [f"a column of one alone: {name}" for name in course.only]
    if course.at is None:
        return [f"{lengths}, the same to the last bit", *lines]
    lines = [f"{lengths}; the first that differs, at {course.clock} {course.at}:", *_listed(course.first), *lines]
    if course.last and course.common - 1 > course.index:
        lines += ["the last in common:", *_listed(course.last)]
    return lines


def _listed(unlike: list[Apart]) -> list[str]:
    """A line for each column."""
    width = max(len(apart.column) for apart in unlike)
    return [
        f"  {apart.column:<{width}}  {apart.first or 'nothing'} against {apart.second or 'nothing'}"
        + (f"  last {apart.bits} of {BITS} bits" if apart.bits else "")
        for apart in unlike
    ]
