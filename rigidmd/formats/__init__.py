"""File formats of structures and trajectories: a module here registers its formats, and states
everything about them.

No other code of rigidmd names an extension. A module in this folder is found by being there. A
feature lists its modules with their extensions, and they are imported when one of these is used.
`register` adds a format from outside.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from importlib import import_module
from math import inf
from pathlib import Path
from pkgutil import iter_modules
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from rigidmd.features import FEATURES
from rigidmd.formats.atoms import Atoms, Frame
from rigidmd.formats.systems import Placed

if TYPE_CHECKING:
    from rigidmd.formats.frame_file import FrameFile

Encode = Callable[[Frame, int], bytes]


class FrameReader(Protocol):
    """Reads the frames of a file. Methods raise only OSError and ValueError."""

    count: int

    @property
    def sites(self) -> int: ...
    def frame(self, k: int, /) -> Frame: ...
    def close(self) -> None: ...


class Topology(NamedTuple):
    """The sites of a system, for a file with their names and first positions."""

    names: Sequence[str]
    elements: Sequence[str]
    residues: Sequence[int]  # the number of the residue of each site, from 1
    residue_names: Sequence[str]  # of each site
    positions: np.ndarray  # (s, 3) Å
    cell: np.ndarray | None  # (3, 3) Å; None without a box
    bonds: Callable[[], np.ndarray]  # pairs (b, 2) of sites that are joined


class Format(NamedTuple):
    """A file format. What it cannot do is None or False."""

    #: In lower case; the first is written. None if it is known by its content only
    extensions: tuple[str, ...]
    name: str = ""  # in messages; default: its extensions

    # As a structure. For each structure in a text `read` returns a function that returns its atoms;
    # with `has_types` its last argument is structure.atom_types.
    read: Callable[..., list[Callable[[], Atoms]]] | None = None  # (path, lines)
    content: re.Pattern[str] | None = (
        None  # recognises the start of a text whose extension is unknown
    )
    has_types: bool = False
    crystals: bool = False  # every structure is the unit cell of a crystal
    # A frame of a trajectory, 1 for the first, -1 for the last; with `has_types` as `read`. If the
    # format has no names, `read_arrays` returns the position (n, 3), and velocity and cell (3, 3)
    # if it has them, in another process: a damaged file may crash it.
    read_frame: Callable[..., Atoms] | None = None  # (path, frame)
    read_arrays: Callable[[str, int, int], dict[str, np.ndarray]] | None = (
        None  # (path, frame, number of atoms)
    )

    # As a trajectory. A format is written by `encoder`: (system, interval ps, whether with
    # velocities) -> function of a frame and its index k that returns the bytes to append, for k = 0
    # with the head of the file. `counter` is the position and the `struct` format of the number of
    # frames in the file. `writer` is a class for all other formats of molecules, see
    # `frame_file.FrameFile`.
    encoder: Callable[[Placed, float, bool], Encode] | None = None
    counter: tuple[int, str] = (0, "")
    writer: "type[FrameFile] | None" = None
    reader: Callable[[Path], FrameReader] | None = None  # default: the reader of MDAnalysis
    mdanalysis: str = ""  # its name in MDAnalysis, if that is not its extension
    check: Callable[[str, int, int], dict[str, np.ndarray]] | None = (
        None  # reads all frames, in another process
    )
    times: re.Pattern[bytes] | None = (
        None  # lines in a text of which MDAnalysis reads no (1) cell and no (2) time
    )
    velocities: bool = False  # what it can store
    rotations: bool = False
    double: bool = False  # numbers in double precision
    even: bool = False  # only times at one interval
    viewer: str = "vmd {topology} {trajectory}"  # the command that shows it

    # As a topology: the text of a file with names and first positions.
    topology: Callable[[Topology], str] | None = None
    limits: tuple[float, float] = (-inf, inf)  # smallest and largest coordinate, Å

    @property
    def is_trajectory(self) -> bool:
        """Whether single frames are read of it as structures."""
        return self.read_frame is not None or self.read_arrays is not None

    def exceeded(self, positions: np.ndarray) -> float | None:
        """The limit, Å, beyond which a position (s, 3) is. None if the format can hold all of
        them."""
        least, largest = self.limits
        return least if positions.min() < least else largest if positions.max() > largest else None


class _Formats(dict[str, Format]):
    """Formats by extension. Those of features are loaded at their first use."""

    def __missing__(self, extension: str) -> Format:
        """Raises KeyError for an unknown extension, MissingFeatureError for one of a feature that
        is absent."""
        for row in FEATURES:
            for module, *names in map(str.split, row.formats):
                if extension[1:] in names:
                    row.module(module, f"*{extension}")
                    return super().__getitem__(extension)
        raise KeyError(extension)


BY_EXTENSION = _Formats()
#: Formats that are recognised by their content.
BY_CONTENT: list[Format] = []
#: Default names of files of a run, of the topology of a body, with bonds, and of the `ase.Atoms` of
#: a scene.
TRAJECTORY = "trajectory.xtc"
TOPOLOGY = "topology.gro"
BODY_TOPOLOGY = "topology.pdb"
STRUCTURE = "atoms.xyz"


def register(form: Format) -> None:
    """Add a format, in place of an earlier one with an extension of it."""
    BY_EXTENSION.update(dict.fromkeys(form.extensions, form))
    if form.content is not None and form not in BY_CONTENT:
        BY_CONTENT.append(form)


def all_formats() -> Iterator[Format]:
    """Every format once, those of installed features included."""
    for row in FEATURES:
        for module in (names.split()[0] for names in row.formats if row.is_installed):
            row.module(module)
    return iter(dict.fromkeys((*BY_CONTENT, *BY_EXTENSION.values())))


def format_of(path: str | Path) -> Format | None:
    """The format of a file by its extension. None for one that only ASE may know, or nobody.
    Raises MissingFeatureError for one of a feature that is absent."""
    try:
        return BY_EXTENSION[Path(path).suffix.lower()]
    except KeyError:
        return None


def has_types(path: str | Path) -> bool:
    """Whether atoms in a file of this name have types, which structure.atom_types may name."""
    form = format_of(path)
    return form is None or form.has_types


def extensions(wanted: Callable[[Format], object]) -> tuple[str, ...]:
    """Sorted extensions of the formats for which `wanted` is true."""
    return tuple(sorted(name for form in all_formats() if wanted(form) for name in form.extensions))


def written(wanted: Callable[[Format], object]) -> tuple[str, ...]:
    """For each of these formats only the extension that is written."""
    return tuple(name for name in extensions(wanted) if name == BY_EXTENSION[name].extensions[0])


def topologies() -> tuple[str, ...]:
    """Names of topology files that are found next to a trajectory, as in the folder of a run."""
    return tuple(f"{Path(TOPOLOGY).stem}{name}" for name in written(lambda form: form.topology))


def find_modules() -> None:
    """Import the modules of this package, which register their formats."""
    for module in iter_modules(__path__):
        import_module(f"{__name__}.{module.name}")


find_modules()
