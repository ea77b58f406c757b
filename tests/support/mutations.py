"""Whether tests find small errors in the physics:

    python tests/support/mutations.py [--list] [--all] [NAME ...]

Each mutation of mutation_list.py and fresh_mutations.py is applied to a copy of the checkout,
alone, and the tests that it names run there until one fails. Nothing in the checkout changes. The
exit code is 1 if a mutation survives, does not apply or runs out of time, and 2 if the tests fail
without any mutation.

Kernels are compiled into a cache of the copy, which is kept between mutations: a mutation of Python
code alone takes seconds, one of a kernel as long as what depends on it takes to compile. The 37 of
mutation_list.py took 25 minutes with cold kernels on one core of a busy machine.
"""

import argparse
import contextlib
import io
import os
import re
import signal
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from support.fresh_mutations import FRESH
from support.mutation_list import CORE, RINGS, Mutation

ROOT = Path(__file__).parents[2]
MUTATIONS: list[Mutation] = [*CORE, *RINGS, *FRESH]
#: Exit codes of pytest: all passed; some failed; could not begin, as with an error of an import.
PASSED, FAILED, INTERRUPTED = 0, 1, 2


def copy_of_checkout(folder: Path, working_tree: bool) -> Path:
    """The files of HEAD, or the values of the working tree, in a folder that is empty or holds an
    earlier copy.

    Files that are there already keep their times, and so the kernels that were compiled from them.
    """
    archive = subprocess.run(
        ["git", "archive", "HEAD"], cwd=ROOT, capture_output=True, check=True
    ).stdout
    with tarfile.open(fileobj=io.BytesIO(archive)) as files:
        wanted = {
            member.name: (files.extractfile(member).read(), member.mode)
            for member in files
            if member.isfile()
        }
    if working_tree:
        listing = ["git", "ls-files", "--modified", "--others", "--exclude-standard", "-z"]
        names = subprocess.run(
            listing, cwd=ROOT, capture_output=True, check=True, text=True
        ).stdout.split("\0")
        for name in filter(None, names):
            wanted.pop(name, None)
            if (ROOT / name).is_file():
                wanted[name] = (ROOT / name).read_bytes(), (ROOT / name).stat().st_mode
    copy = folder / "checkout"
    for path in [
        path for path in copy.rglob("*") if path.is_file() and "__pycache__" not in path.parts
    ]:
        if path.relative_to(copy).as_posix() not in wanted:
            path.unlink()
    for name, (content, mode) in wanted.items():
        path = copy / name
        if not path.is_file() or path.read_bytes() != content:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
            path.chmod(mode)
    return copy


def find_once(old: str, text: str) -> re.Match:
    """Where the code `old` occurs in a text, whatever its line breaks and trailing commas are.

    Raises ValueError unless it occurs exactly once.
    """
    pattern = r"\s*".join(
        r",?\s*" + re.escape(word) if word in ")]}" else re.escape(word)
        for word in re.findall(r"\w+|[^\w\s]", old)
    )
    found = list(re.finditer(pattern, text))
    if len(found) != 1:
        raise ValueError(f"its text occurs {len(found)} times")
    return found[0]


@contextlib.contextmanager
def applied(mutation: Mutation, copy: Path) -> Iterator[None]:
    """Change the file of a copy, and give it back as it was, with its time: kernels of other files
    stay compiled.

    Raises ValueError unless the text occurs exactly once.
    """
    path = copy / "rigidmd" / mutation.file
    text, times = path.read_text(encoding="utf-8"), path.stat()
    try:
        path.write_text(mutated(mutation, text), encoding="utf-8")
        yield
    finally:
        path.write_text(text, encoding="utf-8")
        os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))


def mutated(mutation: Mutation, text: str) -> str:
    """The text of a file with a mutation. Raises ValueError unless its old text occurs once."""
    place = find_once(mutation.old, text)
    return text[: place.start()] + mutation.new.strip() + text[place.end() :]


def run_tests(copy: Path, arguments: Sequence[str], limit: float) -> tuple[int | None, str]:
    """The exit code of pytest in a copy, None if it was stopped at the time limit (s); and what it
    printed."""
    reference = os.environ.get("RIGIDMD_REFERENCE", ROOT.parent / "shared" / "reference")
    settings = {
        "PYTHONPATH": str(copy),  # before an installed rigidmd, in child processes too
        "RIGIDMD_CACHE": str(copy.parent / "kernels"),
        "RIGIDMD_REFERENCE": str(reference),
        "PYTHONDONTWRITEBYTECODE": "1",  # of two mutations in one second the second would not be read
    }
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-x",
        "-m",
        "not soak",
        "-q",
        "-rfE",
        "--tb=no",
        "-p",
        "no:cacheprovider",
        *arguments,
    ]
    with subprocess.Popen(
        command,
        cwd=copy,
        env=os.environ | settings,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    ) as process:
        try:
            printed, _ = process.communicate(timeout=limit)
            return process.returncode, printed
        except subprocess.TimeoutExpired:
            return None, ""
        finally:
            with contextlib.suppress(
                ProcessLookupError
            ):  # workers too, of which pytest-xdist has some
                os.killpg(process.pid, signal.SIGKILL)


def verdict(mutation: Mutation, copy: Path, limit: float, whole: bool) -> tuple[bool, str]:
    """Whether a test finds a mutation, and that as text."""
    selections = [["-n", "0", *(f"tests/{test}" for test in mutation.tests)]] + (
        [["tests"]] if whole else []
    )
    try:
        with applied(mutation, copy):
            for arguments in selections:
                code, printed = run_tests(copy, arguments, limit)
                if code is None:
                    return False, f"no verdict within {limit:g} s"
                if code in (FAILED, INTERRUPTED):
                    first = re.search(
                        r"^(?:FAILED|ERROR) (?:tests/)?(.+?)(?: - .*)?$", printed, re.MULTILINE
                    )
                    return True, f"killed by {first[1] if first else 'an error before the tests'}"
                if code != PASSED:
                    return False, f"pytest ended with {code}: {printed.strip().splitlines()[-1]}"
                if not re.search(r"\d passed", printed):
                    return False, "its tests were skipped"
    except ValueError as error:
        return False, f"does not apply: {error}"
    return False, "survived"


def chosen(names: Sequence[str]) -> list[Mutation]:
    """The mutations of these names, all for none. Raises SystemExit for a name that there is
    not."""
    known = {mutation.name: mutation for mutation in MUTATIONS}
    if unknown := [name for name in names if name not in known]:
        raise SystemExit(f"there is no mutation {', '.join(unknown)}; --list shows all")
    return [known[name] for name in names] or MUTATIONS


def main() -> int:
    """The command; its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", help="such as B7; default: all")
    parser.add_argument("--list", action="store_true", help="print all mutations and end")
    parser.add_argument(
        "--all", action="store_true", help="where the named tests pass, run all but the soak tier"
    )
    parser.add_argument(
        "--working-tree", action="store_true", help="copy what is not committed too"
    )
    parser.add_argument(
        "--folder", type=Path, help="for copy and kernels, and kept; default: a temporary one"
    )
    parser.add_argument(
        "--limit",
        type=float,
        default=900.0,
        metavar="S",
        help="for each run of pytest (default: 900)",
    )
    options = parser.parse_args()
    mutations = chosen(options.names)
    if options.list:
        for mutation in mutations:
            print(f"{mutation.name:4} {mutation.file:32} {mutation.sentence}")
        return 0
    with contextlib.ExitStack() as stack:
        folder = options.folder or Path(
            stack.enter_context(tempfile.TemporaryDirectory(prefix="mutations-"))
        )
        copy = copy_of_checkout(folder.absolute(), options.working_tree)
        tests = dict.fromkeys(f"tests/{test}" for mutation in mutations for test in mutation.tests)
        begun = time.monotonic()
        code, printed = run_tests(copy, ["-n", "0", *tests], options.limit * 2)
        print(
            f"without a mutation: {printed.strip().splitlines()[-1] if printed else 'no verdict'}, "
            f"{time.monotonic() - begun:.0f} s",
            flush=True,
        )
        if code != PASSED:
            print(printed)
            return 2
        killed = 0
        for mutation in mutations:
            begun = time.monotonic()
            found, words = verdict(mutation, copy, options.limit, options.all)
            killed += found
            print(f"{mutation.name:4} {words}, {time.monotonic() - begun:.0f} s", flush=True)
    print(f"{killed} of {len(mutations)} killed")
    return 0 if killed == len(mutations) else 1


if __name__ == "__main__":
    signal.signal(
        signal.SIGTERM, lambda number, frame: sys.exit(128 + number)
    )  # ends the tests that run too
    sys.exit(main())
