"""Rewrites the quoted outputs of README and of the pages, and their figures.

    PYTHONPATH=tests python tests/support/outputs.py                     # what takes at most a minute
    PYTHONPATH=tests python tests/support/outputs.py npt --limit 600     # one page, up to ten minutes each
    PYTHONPATH=tests python tests/support/outputs.py --figures           # the figures too

Each command runs as the page has it, in a folder with a copy of systems/ and the files of the page.
A line of a block is replaced by the line of the new output that has the same words. The script lists
what changed, and the lines that are not in the new output, which a person must mend.
"""

import argparse
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import rigidmd
from support.common import ROOT, processor
from support.documents import (
    DOCUMENTS,
    Block,
    Output,
    blocks_of,
    changed,
    commands_of,
    new_scenes,
    output_of,
    pattern_of,
    write_files,
)
from support.page_figures import redraw

SECONDS = re.compile(r", (\d+) s$")


def machine() -> str:
    """Version and processor, as a block names them."""
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.strip()
    return f"rigidmd {rigidmd.__version__} at {commit}, {os.cpu_count()} cores of an {processor()}"


class Page:
    """A document, its commands run once each in a folder."""

    def __init__(self, path: Path, folder: Path):
        self.path, self.folder = path, folder
        self.blocks = blocks_of(path)
        self.printed: dict[str, tuple[str, float]] = {}
        shutil.copytree(ROOT / "systems", folder / "systems")

    def run(self, words: list[str]) -> tuple[str, float]:
        """Output and run time of a command, which runs once."""
        line = shlex.join(words)
        if line not in self.printed:
            start = time.perf_counter()
            done = subprocess.run(
                [sys.executable, "-m", *words],
                cwd=self.folder,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
            )
            self.printed[line] = done.stdout, time.perf_counter() - start
        return self.printed[line]

    def shortened(self, words: list[str]) -> list[str]:
        """A command as the comment before its block shortens it."""
        for block in self.blocks:
            if block.language == "sh" and words in commands_of(block.text):
                return changed(words, shlex.split(block.about.partition("with ")[2]))
        return words

    def output(self, block: Block, quoted: Output) -> tuple[str, float]:
        """The output that a block quotes, and the time that its commands took."""
        before = self.blocks[: self.blocks.index(block)]
        write_files(before, self.folder)
        for words in new_scenes(before):
            self.run(words)
        for part in before:  # snippets that write tables
            if part.language == "python" and not part.about and "rigidmd" not in part.text:
                subprocess.run([sys.executable, "-c", part.text], cwd=self.folder, check=True)
        runs = [
            self.run(self.shortened(words) if quoted.kind == "of" else words)
            for words in quoted.commands
        ]
        return runs[-1][0], sum(seconds for _, seconds in runs)

    def rewrite(self, block: Block, quoted: Output) -> list[str]:
        """Write the new output of a block. Returns what changed, a line each."""
        printed, seconds = self.output(block, quoted)
        text, missing = renewed(block.text, printed)
        if text != block.text:
            page = self.path.read_text(encoding="utf-8")
            new = f"{machine()}, {seconds:.0f} s" if quoted.where else ""
            page = page.replace(
                f"{quoted.where} -->\n```text\n{block.text}\n```",
                f"{new} -->\n```text\n{text}\n```",
            )
            self.path.write_text(page, encoding="utf-8")
        where = f"{self.path}:{block.line}"
        changes = [f"{where}: not in the output: {line!r}" for line in missing]
        return [*changes, *([f"{where}: changed"] if text != block.text else [])]


def renewed(quoted: str, printed: str) -> tuple[str, list[str]]:
    """A block with the numbers of a new output, and its lines that the output has not."""
    lines, at, missing = printed.splitlines(), 0, []
    new = []
    for line in quoted.splitlines():
        pattern = pattern_of(line, like=True)
        here = next((k for k in range(at, len(lines)) if pattern.fullmatch(lines[k])), None)
        if line.strip() in ("", "..."):
            new.append(line)
        elif here is None or "..." in line:
            new.append(line)
            if here is None or not pattern_of(line, like=False).fullmatch(lines[here]):
                missing.append(line)
        else:
            new.append(lines[here])
            at = here + 1
    return "\n".join(new), missing


def main() -> None:
    """Rewrite the pages that the command line names."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("pages", nargs="*", help="names of pages; all by default")
    parser.add_argument("--limit", type=float, default=60, metavar="SECONDS")
    parser.add_argument("--figures", action="store_true", help="draw the figures of all pages")
    options = parser.parse_args()
    for path in DOCUMENTS:
        if options.pages and path.stem not in options.pages:
            continue
        with tempfile.TemporaryDirectory() as folder:
            page = Page(path, Path(folder) / "page")
            for block in page.blocks:
                quoted = output_of(block)
                took = SECONDS.search(quoted.where) if quoted else None
                if quoted is None or (took and float(took[1]) > options.limit):
                    continue
                for line in page.rewrite(block, quoted):
                    print(line, flush=True)
    for name in redraw(options.limit) if options.figures else ():
        print(f"{name}: drawn", flush=True)


if __name__ == "__main__":
    main()
