"""Hook of MkDocs: the reference of the Python interface, from the docstrings of the package."""

import functools
import html
import inspect
import re
import textwrap
from importlib import import_module

from rigidmd import PACKAGES

#: Module -> names in their order; empty for all public names.
MODULES = {
    "rigidmd": (),
    "rigidmd.view": (),
    "rigidmd.analysis": (),
    "rigidmd.ase": (),
    "rigidmd.errors": (
        "RigidMDError",
        "InputError",
        "SceneError",
        "MoleculeError",
        "StructureError",
        "OutputError",
        "CheckpointError",
        "SimulationError",
        "EngineError",
        "RigidMDWarning",
    ),
    "rigidmd.features.analysis.result": ("AnalysisResult", "Value", "Curve"),
    "rigidmd.features.studies.normal_modes": ("NormalModes",),
    "rigidmd.features.studies.sweep.table": ("Table",),
    "rigidmd.engines.observables": ("Observation",),
    "rigidmd.features.bodies.system": ("Pose",),
    "rigidmd.core.state": ("State",),
}
PROPERTIES = (property, functools.cached_property)
DESCRIPTORS = (*PROPERTIES, classmethod, staticmethod)
KEYWORD = inspect.Parameter.KEYWORD_ONLY
WIDTH = 72  # characters of a signature on one line
SECTION = re.compile(r"^(Parameters|Returns|Raises|Examples)\n-+\n", re.MULTILINE)
ENTRY = re.compile(r"^(?=\S)", re.MULTILINE)


def on_files(files, config):
    from mkdocs.structure.files import File  # the tests read `page` without MkDocs

    files.append(File.generated(config, "reference/api.md", content=page()))
    return files


def page() -> str:
    """The page in Markdown."""
    parts = [
        "# API reference",
        "This page lists every public class and function with its docstring."
        " [Python](python.md) is a shorter overview. The modules after `rigidmd.errors` define what"
        " these functions return. You do not import them.",
    ]
    for name, names in MODULES.items():
        short = name.removeprefix("rigidmd.")
        module = import_module(f"rigidmd.features.{PACKAGES[short]}" if short in PACKAGES else name)
        title, _, _ = (module.__doc__ or "").partition("\n\n")
        parts += [f"## {name}", _text(" ".join(title.split()))]
        for public in names or sorted(module.__all__):
            member = getattr(module, public)
            if callable(member):
                parts += _entry("###", public, member)
                parts += _members(public, member)
    return "\n\n".join(parts) + "\n"


def _members(name: str, kind: object) -> list[str]:
    """Entries of the public methods and properties of a class."""
    if not inspect.isclass(kind) or issubclass(kind, Exception):
        return []
    parts = []
    for member, value in vars(kind).items():
        is_shown = inspect.isfunction(value) or isinstance(value, DESCRIPTORS)
        if is_shown and not member.startswith(("_", "model_")) and inspect.getdoc(value):
            parts += _entry("####", f"{name}.{member}", value)
    return parts


def _entry(rank: str, name: str, member: object) -> list[str]:
    """Heading, signature and docstring of a class, function or property."""
    kind = "class " if inspect.isclass(member) else ""
    doc = inspect.getdoc(member) or ""
    if isinstance(member, functools.cached_property):
        doc = inspect.getdoc(member.func) or ""
    if isinstance(member, PROPERTIES):
        return [f"{rank} `{name}`", "*property*", *_docstring(doc)]
    return [
        f"{rank} `{name}`",
        f"```python\n{kind}{name}{_signature(member)}\n```",
        *_docstring(doc),
    ]


def _signature(member: object) -> str:
    """The signature without the names of modules, with a line for each argument if it is long."""
    is_class = inspect.isclass(member)
    if is_class and issubclass(member, Exception):
        return ""
    function = getattr(member, "__func__", member)
    try:
        signature = inspect.signature(function)
    except ValueError:
        return "(...)"
    # scenes have the arguments **data of pydantic: they are read from files
    hidden = {"self", "cls", *(["data"] if is_class else [])}
    arguments = [
        _without_modules(str(each))
        for name, each in signature.parameters.items()
        if name not in hidden and not name.startswith("_")
    ]
    keywords = [k for k, each in enumerate(signature.parameters.values()) if each.kind == KEYWORD]
    if keywords and keywords[0] < len(arguments):
        arguments.insert(keywords[0], "*")
    returned = signature.return_annotation
    is_silent = is_class or returned in (inspect.Signature.empty, None)
    end = "" if is_silent else " -> " + _without_modules(inspect.formatannotation(returned))
    line = f"({', '.join(arguments)}){end}"
    if len(line) < WIDTH:
        return line
    return "(\n" + "".join(f"    {argument},\n" for argument in arguments) + f"){end}"


def _without_modules(text: str) -> str:
    text = re.sub(r"<(?:function [^>]*(?:>[^>]*)?|factory)>", "...", text)
    text = re.sub(r"\b(?:rigidmd|collections|typing|pathlib|numpy|pandas)\.(?:\w+\.)*|~", "", text)
    return re.sub(r"'(?=\w*[A-Z])([^']*)'", r"\1", text)


def _docstring(doc: str) -> list[str]:
    """A docstring in NumPy style as Markdown."""
    text, *sections = SECTION.split(doc)
    parts = [_text(text)]
    for title, body in zip(sections[::2], sections[1::2], strict=True):
        if title == "Examples":
            parts += ["**Examples**", f"```python\n{textwrap.dedent(body).strip()}\n```"]
        else:
            rows = [_row(entry) for entry in ENTRY.split(body) if entry.strip()]
            parts.append("\n".join([f"| {title} | |", "|---|---|", *rows]))
    return [part for part in parts if part.strip()]


def _row(entry: str) -> str:
    """A row of a table, of names and their description."""
    names, _, description = entry.strip().partition("\n")
    cells = [f"`{names.replace('`', '')}`", _text(" ".join(description.split()))]
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def _text(text: str) -> str:
    """Text in which only quoted code is markup."""
    pieces = re.split(r"(`[^`]+`)", text)
    pieces[::2] = [re.sub(r"([*_\[\]|~^])", r"\\\1", html.escape(piece)) for piece in pieces[::2]]
    return "".join(pieces)
