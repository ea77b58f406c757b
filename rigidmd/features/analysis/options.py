"""Options of analyses: the parameters of their functions after the frames, KEY=VALUE on the command
line. The annotation of a parameter has its type and its limits."""

from collections.abc import Callable, Iterable, Mapping
from inspect import Parameter, signature
from numbers import Integral, Real
from types import NoneType
from typing import Annotated, Literal, NamedTuple, get_args, get_origin

from rigidmd.errors import OutputError
from rigidmd.scene.base import format_override
from rigidmd.scene.validation import did_you_mean


class Limits(NamedTuple):
    """The smallest and the largest value of a number."""

    least: float
    most: float


Count = Annotated[int, Limits(1, 1_000_000)]
Seed = Annotated[int, Limits(0, 2**63 - 1)]
#: K. Classical molecules
Temperature = Annotated[float, Limits(1e-6, 1e6)]
Axis = Literal["x", "y", "z"]


def options_of(function: Callable) -> dict[str, Parameter]:
    """The options of an analysis by name."""
    _, *parameters = signature(function).parameters.values()
    return {parameter.name: parameter for parameter in parameters}


def check_options(functions: Iterable[Callable], options: Mapping[str, object]) -> None:
    """Raise OutputError for options that no analysis takes, or values that they cannot have."""
    known: dict[str, Parameter] = {}
    for function in functions:
        known |= options_of(function)
    for key, value in options.items():
        if key not in known:
            hint = did_you_mean(key, known) or ";"
            taken = ", ".join(known) or "none"
            raise OutputError(f"unknown option {key!r} of these analyses{hint} there are {taken}")
        check_value(known[key], value)


def check_value(option: Parameter, value: object) -> None:
    """Raise OutputError for a value of another type than that of an option, or beyond its
    limits."""
    is_annotated = option.annotation is not Parameter.empty
    kinds, limits, names = _values_of(option.annotation if is_annotated else type(option.default))
    if value is None and NoneType in kinds:
        return
    accepted = tuple({float: Real, int: Integral}.get(kind, kind) for kind in kinds)
    if not isinstance(value, accepted) or (isinstance(value, bool) and bool not in kinds):
        example = "1.5" if option.default is None else format_override(option.name, option.default)
        raise OutputError(f"{option.name}: {value!r} is not like {example}")
    if names and value not in names:
        raise OutputError(f"{option.name} is {value!r}, must be {' or '.join(filter(None, names))}")
    if limits and not limits.least <= value <= limits.most:  # pyright: ignore[reportOperatorIssue]
        what = f"from {limits.least:g} to {limits.most:g}"
        raise OutputError(f"{option.name} is {value}, must be {what}")


def _values_of(annotation: object) -> tuple[tuple[type, ...], Limits | None, tuple[str, ...]]:
    """Types, limits of numbers and the choice of texts of an annotation."""
    if get_origin(annotation) is Annotated:
        inner, limits = get_args(annotation)
        return _values_of(inner)[0], limits, ()
    if get_origin(annotation) is Literal:
        return (str,), None, get_args(annotation)
    if alternatives := get_args(annotation):  # X | None
        parts = [_values_of(each) for each in alternatives]
        kinds = tuple(kind for part in parts for kind in part[0])
        return kinds, next((part[1] for part in parts if part[1]), None), ()
    assert isinstance(annotation, type)
    return (annotation,), None, ()
