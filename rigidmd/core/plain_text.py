"""Names and paths of users, made safe for generated files that are code."""

import re
from collections.abc import Sequence

#: Line ends, control characters and characters that Slurm interprets within quotes: not allowed in paths of scripts.
UNSAFE = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff\"\\]")


def in_comment(text: str) -> str:
    """A text in one line for comments and titles; characters with a meaning in some language become underscores."""
    return re.sub(r"[^\w .,:;=()+/@-]", "_", text)


def as_word(text: str) -> str:
    """A text as one word in a file with columns."""
    return re.sub(r"[^A-Za-z0-9_.+*'-]", "_", text) or "_"


def distinct(texts: Sequence[str]) -> list[str]:
    """Texts as distinct identifiers."""
    found: list[str] = []
    for text in texts:
        name, n = re.sub("[^A-Za-z0-9_]", "_", text) or "_", 1
        stem = name
        while name in found:
            name, n = f"{stem}_{n + 1}", n + 1
        found.append(name)
    return found
