"""What machine code is made from: the definitions that a kernel reaches, for the keys of the cache.

A definition is a top-level function, class or constant of a module. A kernel reaches the names in
its syntax tree, and theirs in turn; of a class, its fields and constants, but no methods. It
reaches a function that implements another one for a class (`implements`) if it reaches both, so
that the classes in the types of its arguments count. Docstrings, comments and layout are not part
of a definition, so that editing them compiles nothing. The package `compile` is one definition,
because Numba finds its lowering functions by types and not by names.
"""

import ast
import atexit
import hashlib
import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from functools import cache
from importlib.machinery import SourceFileLoader
from importlib.util import cache_from_source
from pathlib import Path
from types import ModuleType
from typing import NamedTuple

from rigidmd.core.files import untrusted_reason, write_text
from rigidmd.errors import OutputError, SettingError

PACKAGE = Path(__file__).parent.parent
COMPILER = "rigidmd.compile"
#: Two checkouts have different sources.
PACKAGE_NAME = hashlib.sha256(str(PACKAGE).encode()).hexdigest()[:16]

#: A definition: the name of its module and its name. The name of a module alone stands for all of
#: it.
Node = tuple[str, str]


class Implementation(NamedTuple):
    """A function that implements another one; for arguments of a class, or for types that it
    chooses itself."""

    of: Node
    kind: Node | None
    function: Node


implementations: list[Implementation] = []


def register_implementation(of: Callable, kinds: tuple[type, ...], function: Callable) -> None:
    """Note that a function implements another one, for classes or, without any, for types that it
    chooses."""
    nodes = [node_of(kind) for kind in kinds] or [None]
    implementations.extend(Implementation(node_of(of), kind, node_of(function)) for kind in nodes)


def node_of(value: Callable) -> Node:
    """The top-level definition that contains a function or class."""
    return value.__module__, value.__qualname__.partition(".")[0]


class Definition(NamedTuple):
    """The digest of a syntax tree, and the names in it: `name`, or `module.name` for an
    attribute."""

    digest: str
    names: list[str]


class Source(NamedTuple):
    """The definitions of a module, and its imports: name -> module, and name in it or empty."""

    definitions: dict[str, Definition]
    imports: dict[str, list[str]]


def closure_digest(roots: Iterable[Node]) -> str:
    """Hexadecimal digest of all definitions that some definitions reach."""
    return _closure_digest(frozenset(roots), len(implementations))


@cache
def _closure_digest(roots: frozenset[Node], _implementations: int) -> str:
    parts = sorted({f"{module}.{name} {_digest(module, name)}" for module, name in _reached(roots)})
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def package_digest() -> str:
    """Hexadecimal digest of the package that compiles."""
    names = sorted(path.stem for path in Path(__file__).parent.glob("*.py"))
    digests = [
        source_of(COMPILER if name == "__init__" else f"{COMPILER}.{name}") for name in names
    ]
    content = json.dumps(
        [{k: d.digest for k, d in source.definitions.items()} for source in digests]
    )
    return hashlib.sha256(content.encode()).hexdigest()


def _reached(roots: Iterable[Node]) -> set[Node]:
    reached: set[Node] = set()
    fresh = set(roots)
    while fresh:
        reached |= fresh
        fresh = {node for one in fresh for node in _references(one)}
        fresh |= {
            i.function
            for i in implementations
            if i.of in reached and (i.kind is None or i.kind in reached)
        }
        fresh -= reached
    return reached


def _digest(module: str, name: str) -> str:
    source = source_of(module)
    return source.definitions[name].digest if name in source.definitions else ""


@cache
def _references(node: Node) -> tuple[Node, ...]:
    """The definitions of the package that a definition names."""
    module, name = node
    if module not in _package_modules():
        return tuple(_references_of_values(module))
    source = source_of(module)
    if name not in source.definitions:
        return ()
    loose = [(module, "")] if name and "" in source.definitions else []
    named = [_resolved(module, one) for one in source.definitions[name].names]
    return tuple(dict.fromkeys([*loose, *(one for nodes in named for one in nodes)]))


def _resolved(module: str, name: str) -> list[Node]:
    """The definitions that a name in a module stands for; none outside of the package, or in
    `compile`."""
    first, _, attribute = name.partition(".")
    source = source_of(module)
    if first in source.definitions:
        return [(module, first)]
    if first not in source.imports:
        return []
    target, item = source.imports[first]
    if item and f"{target}.{item}" in _package_modules():
        target, item = f"{target}.{item}", ""
    if target not in _package_modules() or f"{target}.".startswith(f"{COMPILER}."):
        return []
    if item:
        return _resolved(target, item)
    if attribute:
        return _resolved(target, attribute)
    return [(target, one) for one in source_of(target).definitions]


def _references_of_values(module: str) -> Iterator[Node]:
    """The definitions of the package that a module outside of it uses: its values that come from
    there."""
    for value in list(vars(sys.modules.get(module, ModuleType(module))).values()):
        value = getattr(value, "py_func", value)
        origin = getattr(value, "__module__", None)
        if isinstance(value, ModuleType) and value.__name__ in _package_modules():
            yield from ((value.__name__, name) for name in source_of(value.__name__).definitions)
        elif (
            isinstance(origin, str)
            and origin in _package_modules()
            and hasattr(value, "__qualname__")
        ):
            yield node_of(value)


@cache
def _package_modules() -> frozenset[str]:
    """Names of all modules of the package."""
    paths = (path.relative_to(PACKAGE.parent).with_suffix("") for path in PACKAGE.rglob("*.py"))
    return frozenset(".".join(path.parts).removesuffix(".__init__") for path in paths)


# --- reading --------------------------------------------------------------------------------------


#: Module -> digest of its text, and its content as lists; what another process has read. Times and
#: sizes of files would not do: copies and images of a package may have the same for another text.
#: The 45 modules that a run of water reaches are read in 1 ms; parsing them takes 1 s.
_stored: dict[str, list] = {}


def text_digest(text: bytes) -> str:
    """Hexadecimal digest of the text of a file."""
    return hashlib.sha256(text).hexdigest()[:32]


@cache
def source_of(module: str) -> Source:
    """The definitions of a module of the package; none of another one."""
    if module not in _package_modules():
        return Source({}, {})
    path = PACKAGE.parent / Path(*module.split("."))
    path = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    text = path.read_bytes()
    digest, stored = text_digest(text), _stored.get(module)
    if stored is None or stored[0] != digest:
        _require_byte_code_of(module, path, text)
        source = read_source(text.decode())
        stored = _stored[module] = [digest, source.definitions, source.imports]
        _stored[""] = []  # there is something new
    _, definitions, imports = stored
    return Source({name: Definition(*one) for name, one in definitions.items()}, imports)


def _require_byte_code_of(module: str, path: Path, text: bytes) -> None:
    """Raises SettingError if Python runs byte code of another text. It finds byte code by the time
    and the size of the file. Machine code made from it would be stored for the present text."""
    loader = SourceFileLoader(module, str(path))
    if loader.get_code(module) != loader.source_to_code(text, str(path)):
        raise SettingError(
            f"{cache_from_source(path)} is byte code of an earlier {path.name}, which had the same"
            " time and size: remove it, and begin again"
        )


def read_stored(folder: Path) -> None:
    """Read what other processes have stored in a folder, and store there at the end what this one
    reads."""
    path = folder / f"sources-{PACKAGE_NAME}.json"
    with suppress(OSError, ValueError), path.open(encoding="utf-8") as file:
        if not untrusted_reason(os.fstat(file.fileno())):
            os.utime(path)  # it is in use
            _stored.update(json.load(file))
    atexit.register(_store, path)


def _store(path: Path) -> None:
    """Write what this process has read of sources, if anything."""
    if _stored.pop("", None) is None or not path.parent.is_dir():
        return
    with suppress(OutputError):
        write_text(path, json.dumps(_stored))


def read_source(text: str) -> Source:
    """The definitions and imports of the text of a module. Statements that define nothing are one
    definition, ""."""
    parts: dict[str, list[ast.AST]] = {}
    imports: dict[str, list[str]] = {}
    tree = _WithoutDocstrings().visit(ast.parse(text))
    for statement in ast.walk(tree):
        if isinstance(statement, ast.ImportFrom) and not statement.level:
            imports |= {
                a.asname or a.name: [statement.module or "", a.name] for a in statement.names
            }
        elif isinstance(statement, ast.Import):
            imports |= {a.asname or a.name.partition(".")[0]: [a.name, ""] for a in statement.names}
    for statement in tree.body:
        if not isinstance(statement, ast.Import | ast.ImportFrom):
            for name in _defined(statement):
                parts.setdefault(name, []).append(statement)
    definitions = {name: _definition(statements) for name, statements in parts.items()}
    return Source(definitions, imports)


def _defined(statement: ast.stmt) -> list[str]:
    """The names that a top-level statement defines."""
    if isinstance(statement, ast.FunctionDef | ast.ClassDef):
        return [statement.name]
    targets = (
        statement.targets
        if isinstance(statement, ast.Assign)
        else [getattr(statement, "target", None)]
    )
    names = [
        n.id for target in targets if target for n in ast.walk(target) if isinstance(n, ast.Name)
    ]
    return names if isinstance(statement, ast.Assign | ast.AnnAssign) and names else [""]


def _definition(statements: list[ast.AST]) -> Definition:
    names: dict[str, None] = {}
    for node in (node for statement in statements for node in ast.walk(statement)):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            names[f"{node.value.id}.{node.attr}"] = None
        elif isinstance(node, ast.Name):
            names[node.id] = None
    # a module that is named only with attributes is not reached as a whole
    dotted = {name.partition(".")[0] for name in names if "." in name}
    text = "\n".join(ast.dump(statement) for statement in statements)
    return Definition(
        hashlib.sha256(text.encode()).hexdigest()[:16],
        [name for name in names if name not in dotted],
    )


class _WithoutDocstrings(ast.NodeTransformer):
    """Removes texts that are statements, and the methods of classes, which compiled code does not
    call."""

    def visit_Expr(self, node: ast.Expr) -> ast.Expr | None:
        text = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return None if text else node

    def visit_ClassDef(self, node: ast.ClassDef) -> ast.ClassDef:
        node.body = [one for one in node.body if not isinstance(one, ast.FunctionDef)]
        self.generic_visit(node)
        return node
