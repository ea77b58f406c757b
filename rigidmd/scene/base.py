"""The base class of scenes: reading one from a TOML file or a dictionary, and setting single keys
of it."""

import json
import os
import re
import shlex
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, TypeVar, overload

from pydantic import (
    AfterValidator,
    Field,
    PrivateAttr,
    ValidationError,
    ValidationInfo,
    field_validator,
)

from rigidmd.core.display import Displayed
from rigidmd.core.files import unreadable_reason
from rigidmd.core.integrators import SCHEMES, Scheme
from rigidmd.core.plain_text import did_you_mean, similar_names, suggestion
from rigidmd.core.shipped import examples
from rigidmd.core.toml import (
    DEEPEST,
    Json,
    TOMLDecodeError,
    impossible_values,
    parse_toml,
    parse_whole_number,
    plain_values,
    read_toml,
    shorten_repr,
    values_in,
)
from rigidmd.errors import SceneError, option
from rigidmd.features import FEATURES, check_installed
from rigidmd.formats import Format, format_of, written
from rigidmd.scene.integrators import IntegratorRow, with_registered_rows
from rigidmd.scene.validation import (
    MOST_TABLES,
    SceneText,
    Section,
    exact_names,
    is_within,
    limit_number,
    location_of,
    numbers_out_of_range,
    setting,
    validation_messages,
)

if TYPE_CHECKING:
    from rigidmd.scene import BodyScene, MolecularScene, OneScene

LONGEST_NAME = 100
#: Largest number of characters of the name of a file. File systems allow 255, which temporary files
#: need too.
LONGEST_FILE_NAME = 200
#: Keys that name a file.
FILE_KEYS = re.compile(
    "|".join(
        [
            r"(structure|molecules\.[^.]+)\.(file|topology|parameters)",
            *(row.file_keys for row in FEATURES if row.file_keys),
        ]
    )
)
#: Programs whose input files have these names.
FOREIGN_INPUTS = {
    "GROMACS": re.compile(r".*\.(mdp|top|itp|tpr|ndx)"),
    "LAMMPS": re.compile(r"in\..+|.*\.in"),
    "Amber": re.compile(r".*\.(mdin|prmtop|parm7)"),
    "NAMD or CHARMM": re.compile(r".*\.(namd|psf|prm|rtf)"),
    "Python": re.compile(r".*\.(py|ipynb)"),
}
PathName = str | os.PathLike
AnyScene = TypeVar("AnyScene", "MolecularScene", "BodyScene")


class Scene(Section, Displayed):
    """The description of a run, read by `Scene.read(path)`, as a scene of the kind that its tables
    show: `MolecularScene`, or one of a feature."""

    kind: ClassVar[str] = ""
    """The table that only scenes of this kind have"""
    subject: ClassVar[str] = ""
    """What moves, for messages"""
    time_unit: ClassVar[str] = "ps"
    """Unit of the times of a run, "ps" or "s\""""

    _internal: ClassVar[tuple[str, ...]] = ("SIZES", "contradictions", "rows", "schemes", "subject")

    name: Annotated[str, Field(pattern=r"^[\w][\w.\-]*$", max_length=LONGEST_NAME)] = "scene"
    """Name of the run. Default: the name of the file"""

    integrators: tuple[IntegratorRow, ...] = Field(default=(), max_length=MOST_TABLES)
    """User-defined integrators, for stages, [run] of a single body and `rigidmd accuracy`"""

    SIZES: ClassVar[tuple[float, float]] = (1e-100, 1e100)
    """Smallest and largest absolute value of numbers other than 0, so that squares and products
    stay finite"""

    _source: str = PrivateAttr("scene")
    _folder: Path = PrivateAttr(Path())
    #: From which `_folder` starts
    _read_in: Path = PrivateAttr(default_factory=lambda: _working_directory())
    _embedded_files: dict[str, bytes] = PrivateAttr(default_factory=dict)

    @field_validator("integrators")
    @classmethod
    def _pass_to_stages(cls, rows: tuple[IntegratorRow, ...], info: ValidationInfo):
        names = [row.name for row in rows]
        if len(set(names)) < len(names):
            raise ValueError(f"two have the same name: {', '.join(names)}")
        if info.context is not None:
            info.context.update({row.name: row.scheme for row in rows})
        return rows

    @property
    def rows(self) -> dict[str, Scheme]:
        """The integrators of [[integrators]]."""
        return {row.name: row.scheme for row in self.integrators}

    @property
    def schemes(self) -> dict[str, Scheme]:
        """The integrators without a thermostat: those of rigidmd and of [[integrators]]."""
        return SCHEMES | self.rows

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.in_short}>"

    __str__ = __repr__

    @property
    def in_short(self) -> str:
        """A description in one line."""
        return self.name

    @property
    def source(self) -> str:
        """Path of the file, for messages."""
        return self._source

    def with_end(self, time: float) -> "Scene":
        """The same scene with its end at a time of the run.

        Parameters
        ----------
        time : float
            End of the last stage, ps, of the run of a body s

        Returns
        -------
        Scene
            A copy with another end

        Raises
        ------
        SceneError
            If the end cannot be set.
        """
        raise NotImplementedError

    def path(self, file: str) -> Path:
        """Path of a file that the scene names relative to its folder.

        Parameters
        ----------
        file : str
            The name, relative to the folder of the scene

        Returns
        -------
        Path
            The path, absolute if the working directory has changed
        """
        is_same = _working_directory() == self._read_in
        return (self._folder if is_same else self._read_in / self._folder) / file

    @property
    def inputs(self) -> dict[str, Path]:
        """The other files that the scene reads: dotted key -> path."""
        return {}

    @property
    def embedded_files(self) -> dict[str, bytes]:
        """Inputs that are not on disk: dotted key of the file's name -> content. A run writes them
        to its folder."""
        return self._embedded_files

    @classmethod
    def contradictions(cls, data: Json, text: str) -> list[str]:
        """Messages on tables that contradict each other, found even if single tables are
        invalid."""
        return []

    @overload
    @classmethod
    def read(cls: type[AnyScene], path: PathName, overrides: Json | None = None) -> AnyScene: ...
    @overload
    @classmethod
    def read(cls, path: PathName, overrides: Json | None = None) -> "OneScene": ...
    @classmethod
    def read(cls, path: PathName, overrides: Json | None = None) -> "Scene":
        """The scene in a TOML file, with single keys overridden.

        Files named in the scene must lie in its folder or below. Files named in `overrides` may be
        anywhere, and are taken relative to the working directory.

        Parameters
        ----------
        path : str or Path
            Path of the TOML file
        overrides : dict, optional
            Dotted key -> value, such as {"stages.1.timestep_fs": 4}. None removes the key

        Returns
        -------
        MolecularScene or BodyScene
            A scene of the kind that its tables show

        Raises
        ------
        SceneError
            With all errors.
        """
        path = Path(path)
        data, text = read_tables(path)
        data.setdefault("name", default_name(path))
        return cls.from_dict(data, path.parent, overrides, source=str(path), text=text)

    @overload
    @classmethod
    def from_dict(
        cls: type[AnyScene],
        data: Json,
        folder: PathName = ".",
        overrides: Json | None = None,
        source: str = "scene",
        text: str = "",
        embedded_files: dict[str, bytes] | None = None,
    ) -> AnyScene: ...
    @overload
    @classmethod
    def from_dict(
        cls,
        data: Json,
        folder: PathName = ".",
        overrides: Json | None = None,
        source: str = "scene",
        text: str = "",
        embedded_files: dict[str, bytes] | None = None,
    ) -> "OneScene": ...
    @classmethod
    def from_dict(
        cls,
        data: Json,
        folder: PathName = ".",
        overrides: Json | None = None,
        source: str = "scene",
        text: str = "",
        embedded_files: dict[str, bytes] | None = None,
    ) -> "Scene":
        """The scene as a nested dictionary, as a TOML file gives it.

        Numbers and arrays of NumPy and paths are accepted as numbers, lists and texts. The
        dictionary is not changed.

        Parameters
        ----------
        data : dict
            The tables of the scene
        folder : str or Path, optional
            Folder of the files that the scene names. Default: the working directory
        overrides : dict, optional
            Dotted key -> value, as in `read`
        source : str, optional
            Path of the TOML file, for messages
        text : str, optional
            Text of the TOML file, for the numbers of lines in messages
        embedded_files : dict of str to bytes, optional
            See `embedded_files`. With them, files may be outside `folder`

        Returns
        -------
        MolecularScene or BodyScene
            A scene of the kind that its tables show

        Raises
        ------
        SceneError
            With all errors.
        """
        folder, data = Path(folder), plain_values(data)
        overrides = {key: plain_values(value) for key, value in (overrides or {}).items()}
        from rigidmd.scene.kinds import class_for, without_kind

        kind = class_for(data) if cls is Scene else cls
        if kind is None:
            raise SceneError(source, [without_kind()])
        errors, overridden = [], []
        for named, value in overrides.items():
            is_file = isinstance(value, str) and FILE_KEYS.fullmatch(named)
            key, wrong = override(data, named, os.path.abspath(value) if is_file else value)
            errors += wrong
            if value is None and parse_whole_number(key.rpartition(".")[2]) is not None:
                text = ""  # the entries after a removed one are numbered differently in the text
            else:
                overridden.append(key)
        check_installed(data, source)
        if wrong := impossible_values(data):
            raise SceneError(
                source, [f"{location_of(keys, text, overridden)}: {fault}" for keys, fault in wrong]
            )
        wrong = numbers_out_of_range(data, *kind.SIZES)
        errors += [f"{location_of(keys, text, overridden)}: {fault}" for keys, fault in wrong]
        for keys, _ in wrong:  # checks of whole tables calculate with all numbers
            limit_number(data, keys, *kind.SIZES)
        errors += kind.contradictions(data, text)
        for keys, name in values_in(data):
            key = ".".join(map(str, keys))
            if not (isinstance(name, str) and FILE_KEYS.fullmatch(key)) or key in (
                embedded_files or {}
            ):
                continue
            where = location_of(keys, text, overridden)
            path = folder / name
            if not (embedded_files or is_within(key, overridden) or is_inside(path, folder)):
                advice = f"move it there, or set it by {setting(key, 'PATH')}"
                errors.append(
                    f"{where}: {shorten_repr(name)} is outside the scene's folder; {advice}"
                )
            elif fault := unreadable_reason(path):
                errors.append(f"{where}: {fault}: {shorten_repr(str(path))}{_similar_files(path)}")
        complete, rows = with_registered_rows(exact_names(data, kind))
        scene = None
        try:
            scene = kind.model_validate(complete, context=rows)
        except ValidationError as error:
            reported = [keys for keys, _ in wrong]
            errors += validation_messages(error, kind, text, overridden, reported)
        if scene is None or errors:
            raise SceneError(
                source, [fault + _removal_hint(fault, data, overridden) for fault in errors]
            )
        scene._source = SceneText(source, text, overridden)
        scene._folder, scene._embedded_files = folder, embedded_files or {}
        return scene


def read_tables(path: Path) -> tuple[Json, str]:
    """The tables of a scene file, and its text. Raises SceneError, which suggests shipped scenes of
    similar names."""
    fault = unreadable_reason(path)
    if fault.startswith("there is no such file"):
        shipped = similar_names(path.stem, [example.name for example in examples()])
        if shipped:
            new = f". `rigidmd new {shipped[0]}` copies a shipped scene"
        else:
            new = ". `rigidmd examples` lists scenes"
        raise SceneError(str(path), [fault + (_similar_files(path, ".toml") or new)])
    if path.is_dir():
        raise SceneError(str(path), [fault + _scenes_in(path)])
    try:
        return read_toml(path, SceneError)
    except SceneError as error:
        if other := _other_kind_of_file(path):
            raise SceneError(str(path), [other]) from None
        if path.suffix in (".toml", ""):
            raise error
        advice = (
            "a scene is a TOML file. One that starts from a structure names it by [structure] file"
        )
        raise SceneError(str(path), [f"{fault}; {advice}" for fault in error.errors]) from None


def _scenes_in(folder: Path) -> str:
    """Which scenes a folder has, and how a run in it is continued, for the message on a folder as a
    scene."""
    try:
        names = sorted(file.name for file in folder.iterdir() if file.suffix == ".toml")
    except OSError:
        return ""
    if "scene.toml" in names:
        run = shlex.quote(str(folder))
        return (
            f". `rigidmd resume {run}` continues the run in it, and {folder / 'scene.toml'} is its"
            " scene"
        )
    if names:
        return f". A scene is a file, such as {folder / names[0]}"
    return ". A scene is a TOML file"


def _other_kind_of_file(path: Path) -> str:
    """What a file that is not TOML is by its name, and where it belongs. Empty for other names."""
    name = path.name.lower()
    for program, pattern in FOREIGN_INPUTS.items():
        if pattern.fullmatch(name):
            return (
                f"is an input file of {program}, not a scene: `rigidmd help coming_from` lists the"
                " keys of a scene for the settings of other programs, and `rigidmd new` copies a"
                " shipped scene"
            )
    if form := format_of(path):
        kind = "structure" if form.read is not None else "trajectory"
        key = f'[structure] file = "{path.name}"'
        return (
            f"is a {kind} file, not a scene: a scene names it by {key}; see `rigidmd help"
            " structures`"
        )
    return ""


def _working_directory() -> Path:
    """The working directory. Empty if it has been removed."""
    try:
        return Path.cwd()
    except OSError:
        return Path()


def with_absolute_paths(data: Mapping[str, object], folder: PathName = "") -> Json:
    """A copy of the tables of a scene in which every path, relative to a folder, is absolute.

    folder : default: the working directory
    """
    copy = plain_values(data)
    for keys, name in [*values_in(copy)]:
        if isinstance(name, str) and FILE_KEYS.fullmatch(".".join(map(str, keys))):
            *parents, last = keys
            table = copy
            for key in parents:
                table = table[key]
            table[last] = os.path.abspath(os.path.join(folder, name))
    return copy


def default_name(path: Path) -> str:
    """The name of a scene whose file sets none."""
    return re.sub(r"[^\w.\-]", "_", path.stem).lstrip(".-")[:LONGEST_NAME] or "scene"


def is_inside(path: Path, folder: Path) -> bool:
    """Whether a path is inside a folder. True for a path that cannot be resolved, which is
    missing."""
    try:
        return path.resolve().is_relative_to(folder.resolve())
    # a name that is too long, a loop of links, a zero byte
    except (OSError, RuntimeError, ValueError):
        return True


def _similar_files(path: Path, suffix: str = "") -> str:
    """'; did you mean ...?' for files of similar names in the folder of a path. Empty if there are
    none."""
    try:
        neighbours = [
            other for other in sorted(path.parent.iterdir()) if other.name.endswith(suffix)
        ]
    except (OSError, ValueError):
        return ""
    stems = similar_names(
        path.stem, {other.stem for other in neighbours if other.name != path.name}
    )
    return suggestion([other.name for other in neighbours if other.stem in stems])


def file_name(wanted: Callable[[Format], object]) -> AfterValidator:
    """Annotation of a plain file name with an extension that is written of the formats for which
    `wanted` is true."""

    def check(name):
        if name is None or name is False:
            return name
        if not re.fullmatch(r"[\w\-][\w.\-]*", name):
            raise ValueError(f"is {shorten_repr(name)}, must be a plain file name without a folder")
        if len(name) > LONGEST_FILE_NAME:
            raise ValueError(
                f"is {shorten_repr(name)}, must have at most {LONGEST_FILE_NAME} characters"
            )
        if name.startswith("input_"):
            raise ValueError(
                f"is {name!r}. Names beginning with input_ are reserved for copies of input files"
            )
        form = format_of(name)
        if form is None or not wanted(form) or not name.endswith(form.extensions[0]):
            raise ValueError(f"is {name!r}, must end in one of {' '.join(written(wanted))}")
        return name

    return AfterValidator(check)


def _removal_hint(error: str, data: dict, overridden: Iterable[str]) -> str:
    """How to remove the keys that contradict overridden ones on the command line. Empty for any
    other error."""
    if not re.search("not both|omit one|contradict", error):
        return ""
    names = re.findall(r"[a-z]\w*(?:\.\w+)*", error)
    if overridden:
        tables = dict.fromkeys(["", *(f"{key.rpartition('.')[0]}." for key in overridden)])
    else:
        tables = ()
    keys = [table + name for table in tables for name in names]
    removable = [
        key for key in dict.fromkeys(keys) if key not in overridden and _has_key(data, key)
    ]
    return "".join(f"; {setting(key)} removes it" for key in removable)


def _has_key(data: object, key: str) -> bool:
    """Whether nested tables have a dotted key that is not a table."""
    for part in key.split("."):
        if not isinstance(data, dict) or part not in data:
            return False
        data = data[part]
    return not isinstance(data, dict)


def override(data: dict, key: str, value: object) -> tuple[str, list[str]]:
    """Set one dotted key in nested tables and lists in place. None removes it. Returns the key,
    with numbers for names of entries of lists, and error messages."""
    *parents, last = key.split(".", DEEPEST + 1)
    where = f"{option('overrides')} {key}"
    if len(parents) > DEEPEST:
        return key, [
            f"{option('overrides')} {shorten_repr(key)}: is a key of more than {DEEPEST} parts"
        ]
    target: Any = data
    indices: list[int | str | None] = []
    for depth, part in enumerate([*parents, last]):
        here = ".".join(key.split(".")[:depth])
        listed, table = isinstance(target, list), isinstance(target, dict)
        number = parse_whole_number(part)
        if listed:
            # of a stage its name or ensemble, of molecules their name or model
            named = [
                [e[k] for k in ("name", "ensemble", "model") if isinstance(e, dict) and k in e]
                for e in target
            ]
            names = [labels[0] if labels else "" for labels in named]
            if number is None and names.count(part) == 1:
                number = names.index(part)
            if number is None or number >= len(target):
                if number is None and any(names):
                    called = f" ({', '.join(map(shorten_repr, names))})"
                else:
                    called = ""
                return key, [
                    f"{where}: {here} has entries 0 to {len(target) - 1}{called}, not {part!r}"
                ]
        elif not table:
            return key, [f"{where}: {here} is not a table"]
        elif value is None and part not in target:
            hint = did_you_mean(part, target) or f"; there are {', '.join(target)}"
            return key, [f"{setting(key)}: {here or 'the scene'} has no {part} to remove{hint}"]
        index = number if listed else part
        indices.append(index)
        if depth == len(parents) and value is None:
            del target[index]
        elif depth == len(parents):
            target[index] = value
        elif table:
            target = target.setdefault(index, {})
        else:
            target = target[index]
    return ".".join(map(str, indices)), []


def parse_override(text: str) -> tuple[str, object]:
    """KEY=VALUE of the command line. The value is read as TOML, else as text. None if empty. Raises
    SceneError."""
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise SceneError(
            "--set", [f"{text!r} is not KEY=VALUE, for example stages.1.timestep_fs=4"]
        )
    if not value.strip():
        return key.strip(), None
    try:
        return key.strip(), parse_toml(f"value = {value}")["value"]
    except TOMLDecodeError:
        return key.strip(), value.strip()


def format_override(key: str, value: object) -> str:
    """KEY=VALUE of the command line, which `parse_override` reads as this value."""
    return f"{key}={format_toml(value)}"


def format_toml(value: object) -> str:
    """A value in one line of TOML. Empty for None."""
    match value:
        case None:
            return ""
        case bool():
            return str(value).lower()
        case str():
            return json.dumps(value, ensure_ascii=False)
        case list() | tuple():
            return f"[{', '.join(map(format_toml, value))}]"
        case Mapping():
            pairs = (f"{json.dumps(key)} = {format_toml(part)}" for key, part in value.items())
            return f"{{{', '.join(pairs)}}}"
    return repr(value)
