"""Validation of input tables: strict value types for pydantic, and its errors as messages with key
and line."""

import ast
import inspect
import re
from collections.abc import Collection, Container, Iterable
from functools import cache, reduce
from itertools import pairwise
from math import copysign, isfinite
from operator import getitem
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal, TypeVar, overload

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    Strict,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic_core import ErrorDetails, PydanticKnownError, core_schema

from rigidmd.core.plain_text import did_you_mean, plain_letters
from rigidmd.core.toml import Json, line_of, shorten_repr, shorten_text, values_in
from rigidmd.core.user_warnings import warn_renamed
from rigidmd.errors import MOST_SHOWN, RigidMDWarning, Source, option
from rigidmd.scene.hints import KEY_WITH_UNIT, OTHER_UNITS, hint_on_key, in_british, models_in

Number = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Positive = Annotated[float, Strict(), Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Strict(), Field(ge=0, allow_inf_nan=False)]
#: A cutoff, Å. Powers of the reciprocals of much smaller ones overflow in single precision.
Cutoff = Annotated[float, Strict(), Field(ge=1e-3, allow_inf_nan=False)]
#: An error of Q that rounding allows pilot runs to find.
TrajectoryError = Annotated[float, Strict(), Field(ge=1e-12, allow_inf_nan=False)]
Count = Annotated[int, Strict(), Field(gt=0)]
Flag = Annotated[bool, Strict()]
Vector = tuple[Number, Number, Number]

T = TypeVar("T")

#: Largest number of tables in a list of tables.
MOST_TABLES = 1000


def _add_docstrings(schema: Json, kind: type[BaseModel]) -> None:
    """Describe keys in a JSON schema by their docstrings. The option `use_attribute_docstrings` of
    pydantic parses all sources at each import instead, which took a quarter of the time to read a
    scene."""
    for owner in kind.__mro__[:-2]:
        classes = ast.parse(inspect.getsource(not_none(inspect.getmodule(owner)))).body
        bodies = [
            node.body
            for node in classes
            if isinstance(node, ast.ClassDef) and node.name == owner.__name__
        ]
        for key, text in pairwise(bodies[0] if bodies else []):
            if isinstance(key, ast.AnnAssign) and isinstance(text, ast.Expr):
                described = schema["properties"].get(ast.unparse(key.target), {})
                described.setdefault("description", inspect.cleandoc(ast.literal_eval(text.value)))


class Contradictions(ValueError):
    """Keys of a table contradict each other."""

    def __init__(self, messages: list[str]):
        super().__init__("; ".join(messages))
        self.messages = messages


if TYPE_CHECKING:
    from pydantic._internal._model_construction import ModelMetaclass
else:
    ModelMetaclass = type(BaseModel)
OBJECT = {*dir(object)}
#: Names of pydantic, which are of no use to users.
OF_PYDANTIC = {*dir(BaseModel)} - OBJECT | {*vars(BaseModel)}


class SectionKind(ModelMetaclass):
    """The class of sections, whose `dir` and `help` are short."""

    _internal: tuple[str, ...]

    def __dir__(cls) -> list[str]:
        return _for_users(super().__dir__(), cls._internal)


class Section(BaseModel, metaclass=SectionKind):
    """A frozen table of a TOML file. Unknown keys are errors."""

    _internal: ClassVar[tuple[str, ...]] = ()
    """Names that packages use and users do not"""

    def __dir__(self) -> list[str]:
        return _for_users(super().__dir__(), self._internal)

    model_config = ConfigDict(
        frozen=True, extra="forbid", defer_build=True, json_schema_extra=_add_docstrings
    )

    @model_validator(mode="after")
    def _is_sound(self):
        if errors := [*self._errors()]:
            raise Contradictions(errors)
        return self

    def _errors(self) -> Iterable[str]:
        """Messages on keys of this table that contradict each other."""
        return ()


def _for_users(names: Iterable[str], internal: Iterable[str]) -> list[str]:
    """The names of a section that users need."""
    hidden = OF_PYDANTIC.union(internal)
    return [name for name in names if name not in hidden and (name[:2] != "__" or name in OBJECT)]


#: A name or a path, without line ends and other control characters.
Line = Annotated[str, Field(pattern=r"^[^\x00-\x1f\x7f-\x9f\u2028\u2029]*$", max_length=4096)]

#: A name that messages and tables repeat, in one line.
ShortName = Annotated[str, Field(pattern=r"^[^\x00-\x1f\x7f-\x9f\u2028\u2029]+$", max_length=100)]


class NameIn:
    """Annotation of a text that is a name in a table, which is read again at each validation. Its
    JSON schema lists the
    names. in_scene : whether names in the context of the validation are known too"""

    def __init__(self, names: Collection[str], in_scene: bool = False):
        self.names, self.in_scene = names, in_scene

    def _check(self, name: object, info: ValidationInfo) -> str:
        *first, last = known = [*self.names, *(info.context or () if self.in_scene else ())]
        if not isinstance(name, str) or name not in known:
            raise PydanticKnownError(
                "literal_error", {"expected": f"{', '.join(map(repr, first))} or {last!r}"}
            )
        return name

    def __get_pydantic_core_schema__(self, source, handler):
        return core_schema.with_info_plain_validator_function(self._check)

    def __get_pydantic_json_schema__(self, schema, handler):
        return {"enum": list(self.names), "type": "string"}


#: No run or stage has as many steps.
MOST_STEPS = 1e12


def number_of_steps(interval: float, step: float, together: int = 1) -> int:
    """The nearest number of steps to an interval, at least 1 and a multiple of `together`. A longer
    interval than `MOST_STEPS` has about these, which no run reaches: kernels count in 64 bits."""
    return max(1, round(min(interval / step, MOST_STEPS) / together)) * together


def not_none(value: T | None) -> T:
    """The value of an optional key that validation or defaults have set."""
    assert value is not None, "the scene is not validated or not resolved"
    return value


def validation_messages(
    error: ValidationError,
    model: type[BaseModel],
    text: str = "",
    overridden: Iterable[str] = (),
    reported: Iterable[list] = (),
) -> list[str]:
    """One message for each error of pydantic: line (if the TOML text is given), key, what was
    expected.

    overridden : keys that are set by the command line and have no line
    reported : paths of keys that have messages already
    """
    errors: dict[tuple, list[str]] = {}
    of_tables: list[str] = []  # that keys of the whole input contradict each other
    for detail in error.errors(include_url=False):
        unknown = detail["type"] == "extra_forbidden"  # the last key is text of the user
        names = detail["loc"][:-1] if unknown else detail["loc"]
        keys = [key for key in names if not (isinstance(key, str) and UNION_BRANCH.search(key))]
        keys += detail["loc"][-1:] if unknown else ()
        if detail["type"] == "missing" and keys and isinstance(keys[-1], int):
            keys = keys[:-1]  # the list lacks an entry
        fault = detail.get("ctx", {}).get("error")
        if not keys and isinstance(fault, Contradictions):
            for message in fault.messages:
                located = SceneText("", text).locate(message)
                of_tables.append(f"scene: {message}" if located == message else located)
            continue
        # Messages beyond the number shown are only counted.
        sentence = _sentence(detail, keys, model) if len(errors) <= MOST_SHOWN else detail["msg"]
        errors.setdefault(tuple(keys), []).append(sentence)
    # pydantic reports one error for each type that a value may have: join them. An error inside a
    # value is more specific than an error of the whole value.
    known = set(map(tuple, reported))
    for keys in [*errors]:
        if errors[keys] == [SENTENCES["missing"]] and _is_meant(keys, errors):
            del errors[keys]
    around = {keys[:depth] for keys in {*errors, *known} for depth in range(1, len(keys))}
    return of_tables + [
        f"{location_of(list(keys), text, overridden)}: {_either(list(dict.fromkeys(sentences)))}"
        for keys, sentences in errors.items()
        if keys not in around | known
    ]


class SceneText(Source):
    """The name of a scene in messages, with the text of its file.

    overridden : keys that are set by the command line and have no line
    """

    text: str
    overridden: tuple[str, ...]

    def __new__(cls, name: str, text: str = "", overridden: Iterable[str] = ()):
        source = super().__new__(cls, name)
        source.text, source.overridden = text, tuple(overridden)
        return source

    def locate(self, error: str) -> str:
        """An error with the line of the key that it begins with: "stages.0: timestep_fs = 20 is
        unstable" with that of timestep_fs."""
        path = re.match(r"\w+(\.\w+)*(: \w+)?", error)
        names = path[0].replace(": ", ".") if path else ""
        keys = [int(key) if key.isdigit() else key for key in names.split(".")]
        line = None if is_within(names, self.overridden) else line_of(keys, self.text)
        return f"line {line}: {error}" if line else error


def _is_meant(missing: tuple, errors: dict[tuple, list[str]]) -> bool:
    """Whether the message on an unknown key of the same table suggests a missing one."""
    key = str(missing[-1]) if missing else ""
    name = re.compile(rf"\b{re.escape(key)}\b")
    return any(
        keys[:-1] == missing[:-1]
        and sentence.startswith(UNKNOWN)
        and name.search(sentence.partition("; there ")[0])
        for keys, sentences in errors.items()
        for sentence in sentences
    )


def numbers_out_of_range(data: object, least: float, largest: float) -> list[tuple[list, str]]:
    """Path of keys and message of numbers in nested tables whose absolute value is outside these
    limits."""
    bounds = f"{least:g} and {largest:g}".replace("e+", "e")
    return [
        (keys, f"is {value:g}, must be 0 or between {bounds}")
        for keys, value in values_in(data)
        if isinstance(value, float)
        and value != 0
        and not least <= abs(value) <= largest
        and isfinite(value)
    ]


def limit_number(data: Json, keys: list, least: float, largest: float) -> None:
    """Replace the number at a path of keys by the nearest one of the same sign whose absolute value
    is in these limits."""
    *path, last = keys
    table = reduce(getitem, path, data)
    table[last] = copysign(min(max(abs(table[last]), least), largest), table[last])


def _either(sentences: list[str]) -> str:
    """Join messages: "is 1, must be a list" and "is 1, must be a table" become "is 1, must be a
    list or a table". Advice, after the first colon, comes last."""
    parts = [sentence.partition(ADVICE) for sentence in sentences]
    begin, must, _ = parts[0][0].partition(", must be ")
    either = " or ".join([parts[0][0], *(part[0].removeprefix(begin + must) for part in parts[1:])])
    return either + next((colon + advice for _, colon, advice in parts if advice), "")


def location_of(keys: list, text: str, overridden: Iterable[str] = ()) -> str:
    """Where a key of a scene is set: its line and name, or "--set KEY"."""
    path = ".".join(shorten_text(str(key)) for key in keys)
    if is_within(path, overridden):
        return f"{option('overrides')} {path}"
    line = line_of(keys, text)
    return (f"line {line}: " if line else "") + (path or "scene")


def setting(key: str, value: str = "", argument: str = "overrides") -> str:
    """How a user sets a key, or removes it without a value: --set KEY=VALUE, in Python
    overrides={'KEY': VALUE}."""
    if in_python():
        return f"{argument}={{{key!r}: {value or None}}}"
    return f"{option(argument)} {key}={value}"


def in_python() -> bool:
    """Whether messages are read by a user of Python, not of the command line."""
    return not option("overrides").startswith("-")


def is_within(path: str, keys: Iterable[str]) -> bool:
    """Whether a dotted path is one of these keys, or inside the table of one."""
    return any(f"{path}.".startswith(f"{key}.") for key in keys)


#: A part of a location of pydantic that names the branch of a union.
UNION_BRANCH = re.compile(r"[\[(]|^(constrained-)?(float|int|bool|str)$")
UNKNOWN = "unknown key"
#: Messages by the type of pydantic's error.
SENTENCES = {
    "missing": "is missing",
    "too_long": "has {actual_length} entries, must not have more than {max_length}",
    "too_short": "has {actual_length} entries, needs at least {min_length}",
    "greater_than": "is {shown}, must be greater than {gt:g}",
    "less_than": "is {shown}, must be less than {lt:g}",
    "greater_than_equal": "is {shown}, must not be less than {ge:g}",
    "less_than_equal": "is {shown}, must not be more than {le:g}",
    "finite_number": "is {shown}, must be a finite number",
    "float_type": "is {shown}, must be a number",
    **dict.fromkeys(("int_type", "int_from_float"), "is {shown}, must be an integer"),
    "bool_type": "is {shown}, must be true or false",
    "string_type": "is {shown}, must be a text in quotes",
    "string_too_short": "is {shown}, must not be empty",
    "string_too_long": "is {shown}, must not have more than {max_length} characters",
    **dict.fromkeys(("tuple_type", "list_type"), "is {shown}, must be a list"),
    **dict.fromkeys(
        ("model_type", "model_attributes_type", "dict_type"), "is {shown}, must be a table"
    ),
    "value_error": "{error}",
}
_LETTERS = "a name of letters, digits and underscores"
#: What a text must be that does not match a pattern of a key.
PATTERNS = {
    r"^[^\x00-\x1f\x7f-\x9f\u2028\u2029]*$": "one line without control characters",
    r"^[^\x00-\x1f\x7f-\x9f\u2028\u2029]+$": "one line without control characters, not empty",
    r"^[!-~]{1,5}$": (
        "one to five visible ASCII characters without spaces. A longer label of a file is cut to"
        " its first five characters"
    ),
    r"^[^\W\d]\w*$": f"{_LETTERS} that does not begin with a digit",
    r"^[A-Za-z]\w*$": f"{_LETTERS} that begins with a letter from A to Z",
    r"^[\w][\w.\-]*$": f"{_LETTERS}, in which points and hyphens may follow the first one",
}


#: Begin of advice in a message.
ADVICE = ": write "
#: Number of a text with a unit, such as "1 ns".
WITH_UNIT = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([A-Za-zÅµ°/]*\d?)\s*")


def _as_number(text: str, keys: list) -> str:
    """Advice on a text where a number is expected: the number in the unit of the key. Empty for
    other texts."""
    match = WITH_UNIT.fullmatch(text)
    if not match:
        return ""
    number = float(match[1])
    unit = match[2]
    if not unit:
        return f"{ADVICE}{match[1]} without quotes"
    key = KEY_WITH_UNIT.fullmatch(
        str(next((key for key in reversed(keys) if isinstance(key, str)), ""))
    )
    size = OTHER_UNITS[key[1]].get(unit) if key else None
    if key is None or size is None:
        return f"{ADVICE}it without unit, in the one that the key names"
    return f"{ADVICE}{number * size:.12g}, in {key[1].replace('_', '/').replace('A', 'Å')}"


def _sentence(detail: ErrorDetails, keys: list, model: type[BaseModel]) -> str:
    value = detail["input"]
    if isinstance(value, dict):
        shown = "a table"
    elif isinstance(value, list):
        shown = "a list"
    else:
        shown = shorten_repr(value)
    context = detail.get("ctx", {})
    match detail["type"]:
        case "extra_forbidden":
            return UNKNOWN + hint_on_key(str(keys[-1]), keys[:-1], value, model)
        case "missing" if isinstance(detail["loc"][-1], int) and isinstance(value, list | tuple):
            return f"has {len(value)} entries, needs more"
        case "literal_error":
            expected = context["expected"].replace("False", "false").replace("True", "true")
            return f"is {shown}, must be {expected}" + did_you_mean(
                str(value), re.findall(r"'([^']*)'", expected)
            )
        case "tuple_type" | "list_type" if isinstance(value, dict):
            return f"is a table, must be a list of tables: write [[{'.'.join(map(str, keys))}]]"
        case "string_pattern_mismatch":
            return f"is {shown}, must be {PATTERNS[context['pattern']]}"
        case "float_type" | "int_type" if isinstance(value, str):
            return SENTENCES[detail["type"]].format(shown=shown) + _as_number(value, keys)
        case kind if kind in SENTENCES:
            return SENTENCES[kind].format(shown=shown, **context)
    return f"is {shown}: {detail['msg']}"


@overload
def exact_names(data: Json, annotation: object) -> Json: ...
@overload
def exact_names(data: str | None, annotation: object) -> str | None: ...
@overload
def exact_names(data: object, annotation: object) -> object: ...
def exact_names(data: object, annotation: object) -> object:
    """Data of a type in which keys, and values with a fixed choice, have their exact spelling:
    "NVT" becomes "nvt", and "minimize" becomes "minimise". The case of letters, hyphens,
    underscores and slashes do not matter in values, nor does American spelling."""
    if isinstance(data, str):
        plain = plain_letters(in_british(data))
        near = [name for name in _choices(annotation) if plain_letters(name) == plain]
        return near[0] if len(near) == 1 else data
    if isinstance(data, list):
        return [exact_names(value, annotation) for value in data]
    if not isinstance(data, dict):
        return data
    fields = {
        key: kind for model in models_in(annotation) for key, kind in _annotations(model).items()
    }
    return {
        key: exact_names(value, fields.get(key) if fields else annotation)
        for key, value in _current_keys(data, fields).items()
    }


#: Key of the version before -> its name now.
FORMER_KEYS = {"most_iterations": "max_iterations"}


def _current_keys(data: dict, known: Container[str]) -> dict:
    """Data in which an unknown key in American spelling, or of the version before, is the known
    key."""
    names = {
        key: new
        for key in data
        if isinstance(key, str) and key not in known
        if (new := FORMER_KEYS.get(key, in_british(key))) in known and new not in data
    }
    for old in FORMER_KEYS.keys() & names:
        warn_renamed(f"the key {old}", FORMER_KEYS[old], RigidMDWarning)
    return {names.get(key, key): value for key, value in data.items()}


@cache
def _annotations(model: type[BaseModel]) -> dict[str, object]:
    return {key: field.rebuild_annotation() for key, field in model.model_fields.items()}


def _choices(annotation: object) -> list[str]:
    """The values that a type allows, if it is a choice of names."""
    if isinstance(annotation, str):
        return [annotation]
    parts = (*getattr(annotation, "__args__", ()), *getattr(annotation, "__metadata__", ()))
    if isinstance(annotation, NameIn):
        return [*annotation.names]
    return [n for part in parts for n in _choices(part)]


#: Limits of checks during a run; false switches a check off. A limit below these stops every run.
Limit = Annotated[float, Strict(), Field(ge=1e-6, allow_inf_nan=False)] | Literal[False]
LimitOfEnergy = Annotated[float, Strict(), Field(ge=1e-9, allow_inf_nan=False)] | Literal[False]
LimitOfRounding = Annotated[float, Strict(), Field(ge=1e-14, allow_inf_nan=False)] | Literal[False]
LimitOfVolume = Annotated[float, Strict(), Field(gt=1, allow_inf_nan=False)] | Literal[False]
