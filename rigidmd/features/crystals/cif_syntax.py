"""The syntax of CIF, read by gemmi. What is invalid in entries that are not needed, such as a comma
after a quoted citation, is left out with a note."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from rigidmd.formats.atoms import structure_error

if TYPE_CHECKING:
    import gemmi

#: Words that start a line and end the entry before it.
HEADS = ("data_", "save_", "global_", "stop_")


def tag_of(tag: str) -> str:
    """A tag in lower case, with _ for the . of mmCIF."""
    return tag.lower().replace(".", "_")


def parse_cif(
    path: Path, lines: list[str], is_needed: Callable[[str], bool]
) -> "tuple[gemmi.cif.Document, list[str]]":
    """The blocks of a file, and notes on its syntax. `is_needed`: whether an entry with a tag, see
    `tag_of`, must be valid. Raises StructureError."""
    import gemmi

    # Names of authors may have any letters, also where CIF allows ASCII only.
    lines = [line.encode("ascii", errors="replace").decode() for line in lines]
    notes = []
    first = next((k for k, line in enumerate(lines) if line.split("#")[0].strip()), 0)
    if lines and lines[first].split()[0].lower().startswith(("_", "loop_")):
        lines[first] = f"data_unnamed {lines[first]}"
        notes.append(f"line {first + 1}: there is no 'data_' before its first entry")
    try:
        return gemmi.cif.read_string("\n".join(lines)), notes
    except (ValueError, RuntimeError) as error:
        whole = _syntax_error(str(error))
    try:
        document = gemmi.cif.read_string("\n".join(_needed_lines(lines, is_needed)))
    except (ValueError, RuntimeError) as error:
        message = f"{_syntax_error(str(error))}. Is the file complete?"
        raise structure_error(path, message) from None
    if not any(is_needed(tag_of(tag)) for block in document for tag in _tags(block)):
        raise structure_error(path, f"{whole}. Is the file complete?")
    return document, [*notes, f"{whole}, in an entry that is not needed"]


def _syntax_error(message: str) -> str:
    """A message of gemmi, such as string:2:0(7): Wrong number of values, with its line."""
    match = re.match(r"string(?::(\d+))?(?::\d+\(\d+\))?(?: in \S+)?:? *(.*)", message, re.DOTALL)
    line, what = (match[1], match[2]) if match else (None, message)
    where = f"line {line}: " if line else ""
    return f"{where}this is not valid CIF: {what or 'damaged'}"


def _tags(block) -> Iterator[str]:
    for item in block:
        if item.pair is not None:
            yield item.pair[0]
        elif item.loop is not None:
            yield from item.loop.tags


def _needed_lines(lines: list[str], is_needed: Callable[[str], bool]) -> list[str]:
    """The lines of entries of which a tag is needed, and empty ones in place of all others. An
    entry is a loop, or a tag with its value, and starts on a line of its own."""
    entries: list[tuple[int, list[str]]] = []  # the first line of each, and its tags
    is_header = is_text = False
    for k, line in enumerate(lines):
        if is_text or line.startswith(";"):
            is_text = is_text != line.startswith(";")
            is_header = False
            continue
        words = line.split("#")[0].split()
        if not words:
            continue
        if words[0].lower().startswith(("loop_", *HEADS)):
            entries.append((k, []))
            is_header = words[0].lower().startswith("loop_")
        elif words[0].startswith("_") and not is_header:
            entries.append((k, []))
        elif not words[0].startswith("_"):
            is_header = False
            continue
        if entries:
            entries[-1][1].extend(tag_of(word) for word in words if word.startswith("_"))
    needed = list(lines[: entries[0][0]]) if entries else []
    ends = [start for start, _ in entries[1:]] + [len(lines)]
    for (start, tags), end in zip(entries, ends, strict=True):
        is_kept = not tags or any(map(is_needed, tags))
        needed += lines[start:end] if is_kept else [""] * (end - start)
    return needed
