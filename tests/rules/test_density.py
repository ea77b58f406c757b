"""One idea to a line: tokens per line of code, the formatter is on everywhere, and `Any` is rare.
Pages are short, with few nominal phrases."""

import io
import re
import tokenize

import pytest
from support.common import ROOT

MOST_TOKENS = 9.0  # per line of code, in the mean over a package
MOST_SKIPS = 15  # for tables of numbers
MOST_ANY = 18  # may only fall
MOST_WORDS = 75_500  # of all pages
#: Per 1,000 words of text.
MOST_OF, MOST_ITS = 25, 3.5
LAYOUT = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}


# Python 3.12 and later split an f-string into tokens; here each is one token.
STRING_BEGINS = getattr(tokenize, "FSTRING_START", None)
STRING_ENDS = getattr(tokenize, "FSTRING_END", None)


def tokens_and_lines(text):
    """Number of tokens of Python code, and of lines on which one starts; without comments."""
    count, lines, depth = 0, set(), 0
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == STRING_ENDS:
            depth -= 1
        elif depth == 0 and token.type not in LAYOUT:
            count += 1
            lines.add(token.start[0])
        if token.type == STRING_BEGINS:
            depth += 1
    return count, len(lines)


def test_tokens_and_lines_are_counted():
    assert tokens_and_lines('"""Two\nlines."""\n\nx = f(1)  # a comment\n') == (7, 2)
    assert tokens_and_lines("y = f'{f\"{a}\"} b'\n") == (3, 1)
    assert tokens_and_lines("# nothing\n") == (0, 0)


def test_lines_of_code_have_few_tokens():
    counts = [
        tokens_and_lines(path.read_text(encoding="utf-8"))
        for path in (ROOT / "rigidmd").rglob("*.py")
    ]
    tokens, lines = map(sum, zip(*counts, strict=True))
    assert tokens / lines <= MOST_TOKENS


@pytest.mark.parametrize("folder", ["rigidmd", "tests"])
def test_the_formatter_is_on(folder):
    texts = [path.read_text(encoding="utf-8") for path in (ROOT / folder).rglob("*.py")]
    skips = [text.count("# fmt" + ": ") for text in texts]
    assert sum(skips) <= MOST_SKIPS
    assert not any("# isort" + ": " in text for text in texts)


def test_any_is_rare():
    paths = [*(ROOT / "rigidmd").rglob("*.py"), *(ROOT / "rigidmd").rglob("*.pyi")]
    count = sum(len(re.findall(r"\bAny\b", path.read_text(encoding="utf-8"))) for path in paths)
    assert count <= MOST_ANY, "replace Any by a type, or by a Protocol of what is used"


def test_pages_are_short_with_few_nominal_phrases():
    texts = [path.read_text("utf-8") for path in (ROOT / "rigidmd" / "docs").rglob("*.md")]
    assert sum(len(text.split()) for text in texts) <= MOST_WORDS
    blocks = re.compile(r"^```.*?^```$|<!--.*?-->|\$\$.*?\$\$|\$[^$]*\$", re.MULTILINE | re.DOTALL)
    words = [
        word.lower()
        for text in texts
        for word in re.findall(r"[A-Za-z][\w'-]*", blocks.sub("", text))
    ]
    assert 1000 * words.count("of") <= MOST_OF * len(words)
    assert 1000 * words.count("its") <= MOST_ITS * len(words)
