"""The reference of the Python interface in Markdown, from annotations and docstrings."""

import functools
import html
import inspect
import re
import textwrap
from collections.abc import Callable
from importlib import import_module
from types import FunctionType

from rigidmd import PACKAGES

ERRORS = (
    "RigidMDError InputError SceneError MoleculeError StructureError OutputError CheckpointError"
    " SimulationError EngineError RigidMDWarning"
)
#: Title, module, public names in the order that a script needs. Names that are not listed follow in
#: the next section of the module without names.
SECTIONS = (
    ("rigidmd", "rigidmd", "Scene Simulation Results read_run Every sweep"),
    ("rigidmd.analysis", "rigidmd.analysis", ""),
    ("rigidmd.view", "rigidmd.view", ""),
    ("More of rigidmd", "rigidmd", ""),
    ("rigidmd.ase", "rigidmd.ase", ""),
    ("rigidmd.errors", "rigidmd.errors", ERRORS),
    ("Results of analyses", "rigidmd.features.analysis.result", "AnalysisResult Value Curve"),
    ("Normal modes", "rigidmd.features.studies.normal_modes", "NormalModes"),
    ("The table of a sweep", "rigidmd.features.studies.sweep.table", "Table"),
    ("Observables", "rigidmd.engines.observables", "Observation"),
    ("The state of molecules", "rigidmd.core.state", "State"),
    ("The state of a body", "rigidmd.features.bodies.system", "Pose"),
)
#: Classes that users do not create: functions return them.
RETURNED = (
    "Scene MolecularScene BodyScene Results Moment PairPotential BodyPairPotential AnalysisResult"
    " Value Curve NormalModes Table Observation State Pose"
)
PROPERTIES = (property, functools.cached_property)
KEYWORD = inspect.Parameter.KEYWORD_ONLY
WIDTH = 72  # characters of a signature in a heading
SECTION = re.compile(r"^(Parameters|Attributes|Returns|Raises|Examples)\n-+\n", re.MULTILINE)
ENTRY = re.compile(r"^(?=\S)", re.MULTILINE)


def page() -> str:
    """The page in Markdown."""
    parts = [
        "# API reference",
        "Public classes and functions with their docstrings. [Python](python.md) is a shorter"
        " overview.",
    ]
    listed = set()
    for title, name, names in SECTIONS:
        short = name.removeprefix("rigidmd.")
        module = import_module(f"rigidmd.features.{PACKAGES[short]}" if short in PACKAGES else name)
        parts += [f"## {title}", *(_docstring(module.__doc__ or "") if title == name else [])]
        for public in names.split() or sorted(set(module.__all__) - listed):
            listed.add(public)
            member = getattr(module, public)
            if callable(member):
                parts += _entry("###", public, member)
                parts += _members(public, member)
    return "\n\n".join(parts) + "\n"


def _members(name: str, kind: object) -> list[str]:
    """Entries of the methods and properties of a class that its bases do not have."""
    if not inspect.isclass(kind) or issubclass(kind, Exception):
        return []
    shown = set(dir(kind)).difference(*(dir(base) for base in kind.__bases__))
    kinds = (classmethod, FunctionType, *PROPERTIES)
    members = [
        (kinds.index(type(value)), f"{name}.{member}", value)
        for member, value in vars(kind).items()
        if type(value) in kinds
        and member in shown
        and not member.startswith("_")
        and inspect.getdoc(value)
    ]
    members.sort(key=lambda item: item[0])
    return [part for _, member, value in members for part in _entry("####", member, value)]


def _entry(rank: str, name: str, member: object) -> list[str]:
    """Heading with signature, and docstring, of a class, function or property. A long signature
    stands below the heading."""
    if isinstance(member, PROPERTIES):
        member = member.func if isinstance(member, functools.cached_property) else member.fget
        signature = _returned(member, ": ")
    else:
        signature = "" if name in RETURNED.split() else _signature(member)
    title, block = name + signature, []
    if len(title) > WIDTH:
        title, block = name, [f"```python\n{name}{signature}\n```"]
    _, dot, last = name.rpartition(".")
    heading = f'{rank} `{title}` {{ #{name} data-toc-label="{dot}{last}" }}'
    return [heading, *block, *_docstring(inspect.getdoc(member) or "")]


def _returned(function: Callable, sign: str) -> str:
    """The annotation of what a function returns, after `sign`."""
    returned = inspect.signature(function).return_annotation
    if returned in (inspect.Signature.empty, None):
        return ""
    return sign + _without_modules(inspect.formatannotation(returned))


def _signature(member: object) -> str:
    """The signature without the names of modules, with a line for each argument if it is long."""
    is_class = inspect.isclass(member)
    if is_class and issubclass(member, Exception):
        return ""
    function = getattr(member, "__func__", member)
    parameters = [
        each
        for name, each in inspect.signature(function).parameters.items()
        if name not in ("self", "cls") and not name.startswith("_")
    ]
    arguments = [_without_modules(str(each)) for each in parameters]
    keywords = [k for k, each in enumerate(parameters) if each.kind == KEYWORD]
    if keywords and "*" not in "".join(arguments[: keywords[0]]):
        arguments.insert(keywords[0], "*")
    end = "" if is_class else _returned(function, " -> ")
    line = f"({', '.join(arguments)}){end}"
    if len(line) < WIDTH:
        return line
    return "(\n" + "".join(f"    {argument},\n" for argument in arguments) + f"){end}"


def _without_modules(text: str) -> str:
    text = re.sub(r"<(?:function [^>]*(?:>[^>]*)?|factory)>", "...", text)
    text = re.sub(r"\b(?:rigidmd|collections|typing|pathlib|numpy|pandas)\.(?:\w+\.)*|~", "", text)
    text = re.sub(r"\b(Scene|System)T\b", r"\1", text)
    text = re.sub(r"\bAnnotated\[(\w+), [^\]]*\]", r"\1", text)
    text = re.sub(r"\bOptional\[(\w+|Literal\[[^\]]*\])\]", r"\1 | None", text)
    text = re.sub(r"_Buffer, .*?_NestedSequence\[complex \| bytes \| str\]", "ArrayLike", text)
    text = re.sub(r"\bUnion\[(\w+)\]", r"\1", text)
    return re.sub(r"(^|: )'([^']*)'|'(?=[\w.]*[A-Z])([^']*)'", r"\1\2\3", text)


def _docstring(doc: str) -> list[str]:
    """A docstring in NumPy style as Markdown."""
    text, *sections = SECTION.split(doc)
    parts = [_text(text)]
    for title, body in zip(sections[::2], sections[1::2], strict=True):
        if title == "Examples":
            parts += ["**Examples**", f"```python\n{textwrap.dedent(body).strip()}\n```"]
            continue
        rows = [_row(entry) for entry in ENTRY.split(body) if entry.strip()]
        if title in ("Returns", "Raises"):
            lines = [f"*{title}* {names}: {text}" for names, _, text in rows]
            parts.append("  \n".join(line.removesuffix(": ") for line in lines))
            continue
        has_types = any(kind for _, kind, _ in rows)
        table = [(title, " ", " "), ("---",) * 3, *rows]
        lines = [" | ".join(row if has_types else (row[0], row[2])) for row in table]
        parts.append("\n".join(f"| {line} |" for line in lines))
    return [part for part in parts if part.strip()]


def _row(entry: str) -> tuple[str, str, str]:
    """Cells of a table: names, type, description."""
    head, _, description = entry.strip().partition("\n")
    names, _, kind = head.replace("`", "").partition(" : ")
    return f"`{names}`", _text(kind), _text(" ".join(description.split()))


def _text(text: str) -> str:
    """Text in which only quoted code is markup."""
    pieces = re.split(r"(`[^`]+`)", text)
    pieces[::2] = [re.sub(r"([*_\[\]|~^])", r"\\\1", html.escape(piece)) for piece in pieces[::2]]
    return "".join(pieces)
