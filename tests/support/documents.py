"""The blocks of README and of the pages: commands, files, snippets and quoted outputs.

A comment before a block names what it is:

    <!-- test: file NAME -->       the block is the file NAME, which later commands use
    <!-- test: end of NAME -->     it is added to the file NAME
    <!-- test: with OPTIONS -->    OPTIONS are added to each command of the block that runs a scene,
                                   and those of --set to each `Scene.read` of a Python block:
                                   shorter runs. KEY=VALUE alone is added to each `rigidmd analyse`
    <!-- test: not run, WHY -->    commands are parsed, and their scenes read, but not run. Commands
                                   with the same options run elsewhere: on another page, or in a
                                   test that test_docs.py names
    <!-- test: output of CMD -->   every line of the block is in the output of CMD, in this order.
                                   CMD runs with the options of the document where it is one of its
                                   commands, else as it stands
    <!-- test: output like CMD | WHERE -->  the same, but each number may be any number, with more
                                   or fewer spaces before it, and a line may be longer: the block is of a
                                   longer run, or of another version of another program
    <!-- output: CMD && CMD | WHERE -->  the block is recorded: it quotes the output of the last CMD,
                                   in full length. Tests compare what a scene determines
    <!-- test: not output, WHY --> the block is a text that no command prints

WHERE has the version, the processor and the run time. In quoted output `...` stands for any text,
a line of it for any lines, and a number below 1e-9 for any such number: it is a rounding error.
Every quoted output has one of these comments, and outputs.py rewrites the blocks.
"""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from rigidmd.core.shipped import CHAPTERS, DOCS
from support.common import ROOT

README = ROOT / "README.md"
#: The chapters of this checkout; those of an installed package may be elsewhere.
PAGES = {
    name: ROOT / "rigidmd" / "docs" / path.relative_to(DOCS) for name, path in CHAPTERS.items()
}
DOCUMENTS = [README, *PAGES.values()]


class Block(NamedTuple):
    """A fenced block, or the indented lines that README starts with."""

    line: int  # of its first line of text
    language: str
    text: str
    about: str  # what the comment before it describes


def blocks_of(document: Path) -> list[Block]:
    """The blocks of a document in their order."""
    lines = document.read_text(encoding="utf-8").splitlines()
    blocks, about, k = [], "", 0
    while k < len(lines):
        line = lines[k]
        if marker := re.fullmatch(r"<!-- (test|output): (.*) -->", line):
            about = marker[2] if marker[1] == "test" else f"recorded {marker[2]}"
            assert lines[k + 1].startswith(("```", "|")), (
                f"{document.name}:{k + 1}: a block or a table must follow at once"
            )
        elif line.startswith("|"):
            about = ""
        elif line.startswith("```"):
            end = lines.index("```", k + 1)
            blocks.append(Block(k + 2, line[3:], "\n".join(lines[k + 1 : end]), about))
            about, k = "", end
        elif re.match(r" {4}\S", line) and not lines[k - 1]:
            end = next(n for n in range(k, len(lines)) if not lines[n].startswith("    "))
            blocks.append(
                Block(k + 1, "sh", "\n".join(line[4:] for line in lines[k:end]), "not run, by CI")
            )
            k = end - 1
        k += 1
    return blocks


def commands_of(text: str) -> list[list[str]]:
    """The words of each command of a shell block, comments omitted."""
    joined = text.replace("\\\n", " ")
    return [
        shlex.split(part, comments=True)
        for line in joined.splitlines()
        for part in line.split("&&")
    ]


NUMBER = r"(?<![\w.])[+-]?\d[\d,.]*(?:e[+-]?\d+)?"
ROUNDING = r"\d(?:\.\d+)?e-[1-9]\d|0\.0e\+00"


def pattern_of(quoted: str, like: bool) -> re.Pattern:
    """What a quoted line of output stands for; with `like`, of any numbers."""

    def form(part: str) -> str:
        if part == "...":
            return ".*"
        if like and part.isspace():
            return r"\s+"
        if re.fullmatch(ROUNDING, part) and not like:
            return f"(?:{ROUNDING})"
        return NUMBER if like and re.fullmatch(NUMBER, part) else re.escape(part)

    parts = re.split(rf"(\.\.\.|\s+|{ROUNDING}|{NUMBER})", quoted)
    return re.compile("".join(map(form, parts)) + (r"(?:\s.*)?" if like else r"\s*"))


def changed(arguments: list[str], options: list[str]) -> list[str]:
    """Arguments with further options. Those of --set replace values of the same keys."""
    new = {word.partition("=")[0] for word in options}
    pairs = list(zip(arguments, [*arguments[1:], ""], strict=True))
    old = [
        k
        for k, (word, value) in enumerate(pairs)
        if word == "--set" and value.partition("=")[0] in new
    ]
    left = [word for k, word in enumerate(arguments) if k not in old and k - 1 not in old]
    return [*left, *options]


class Output(NamedTuple):
    """A quoted output: the commands that print it, the last one what is quoted."""

    commands: list[list[str]]
    kind: str  # of, like, or recorded
    where: str  # version, processor and run time, or empty


def output_of(block: Block) -> Output | None:
    """The quoted output that a block is."""
    how, _, rest = block.about.partition(" ")
    commands, _, where = rest.partition(" | ")
    if how == "recorded":
        return Output([shlex.split(each) for each in commands.split(" && ")], how, where)
    if how == "output":
        kind, _, command = commands.partition(" ")
        return Output([shlex.split(command)], kind, where)
    return None


def write_files(blocks: list[Block], folder: Path) -> None:
    """Write the files that blocks of a document contain, or end."""
    for block in blocks:
        how, _, rest = block.about.partition(" ")
        if how == "file":
            (folder / rest).write_text(block.text + "\n", encoding="utf-8")
        if how == "end":
            path = folder / rest.removeprefix("of ")
            text = path.read_text(encoding="utf-8")
            path.write_text(f"{text}\n{block.text}\n", encoding="utf-8")


def new_scenes(blocks: list[Block]) -> Iterator[list[str]]:
    """The commands `rigidmd new` and `rigidmd models` of blocks, which write files for later ones."""
    for block in blocks:
        if block.language == "sh":
            for words in commands_of(block.text):
                if words[:2] in (["rigidmd", "new"], ["rigidmd", "models"]):
                    yield words
