"""Runs what takes hours, and states when it last passed.

    python tests/support/soak.py                  all parts: statistics, errors, mutations
    python tests/support/soak.py statistics       one of them
    `python tests/support/soak.py faults --minutes 600`
    python tests/support/soak.py --when           when each part last ran and last passed, and at which commit

Each run of a part adds a line to the record, a file of JSON lines (default: .soak/record.jsonl in
the checkout, which git ignores), and its output is next to it. Exit code: 0 if every part passed, 1
if one did not.
"""

import argparse
import datetime
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
PARTS = ("statistics", "faults", "mutations")


def command_of(part: str, minutes: float) -> list[str]:
    """What a part runs."""
    tests = str(ROOT / "tests")
    return {
        "statistics": [
            sys.executable,
            "-m",
            "pytest",
            "-m",
            "soak",
            "-rP",
            "--durations=25",
            tests,
        ],
        "faults": [
            sys.executable,
            f"{tests}/support/faults.py",
            "--minutes",
            str(minutes),
            "--wide",
        ],
        "mutations": [sys.executable, f"{tests}/support/mutations.py"],
    }[part]


def commit() -> str:
    """The commit that is checked out, with a + if a file that git knows has changed since."""

    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", *arguments], cwd=ROOT, capture_output=True, text=True
        ).stdout.strip()

    return git("rev-parse", "--short=12", "HEAD") + (
        "+" if git("status", "--porcelain", "-uno") else ""
    )


def run(part: str, command: Sequence[str], record: Path) -> bool:
    """Run a part, add it to the record, and return whether it passed."""
    began, at, what = datetime.datetime.now(datetime.UTC), time.monotonic(), commit()
    output = record.parent / f"{part}.txt"
    print(f"{part}: {' '.join(command)}\n  output: {output}", flush=True)
    with output.open("w", encoding="utf-8") as file:
        code = subprocess.run(command, cwd=ROOT, stdout=file, stderr=subprocess.STDOUT).returncode
    last = (output.read_text(encoding="utf-8", errors="replace").strip().splitlines() or [""])[-1]
    entry = {
        "part": part,
        "date": began.isoformat(timespec="seconds"),
        "commit": what,
        "minutes": round((time.monotonic() - at) / 60, 1),
        "passed": code == 0,
        "said": last.strip("= ")[:200],
    }
    with record.open("a", encoding="utf-8") as file:
        file.write(json.dumps(entry) + "\n")
    print(line_of(entry), flush=True)
    return code == 0


def line_of(entry: dict[str, Any]) -> str:
    """An entry of the record as a line."""
    result = "passed" if entry["passed"] else "FAILED"
    return f"  {result} {entry['date']} at {entry['commit']} in {entry['minutes']:g} min: {entry['said']}"


def when(record: Path) -> str:
    """For each part its last run and, if that failed, the last one that passed."""
    entries = (
        [json.loads(line) for line in record.read_text(encoding="utf-8").splitlines()]
        if record.exists()
        else []
    )
    lines = []
    for part in PARTS:
        own = [entry for entry in entries if entry["part"] == part]
        passed = [entry for entry in own if entry["passed"]]
        lines += [f"{part}:", *map(line_of, own[-1:])] if own else [f"{part}: has not run"]
        if own and not own[-1]["passed"]:
            lines += [line_of(passed[-1]) if passed else "  has never passed"]
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Run the parts that are named, or print the record."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)} (default: all)"
    )
    parser.add_argument(
        "--minutes", type=float, default=240.0, help="for the fault driver (default: 240)"
    )
    parser.add_argument(
        "--record", type=Path, default=ROOT / ".soak" / "record.jsonl", help="file of results"
    )
    parser.add_argument(
        "--when", action="store_true", help="print when each part last passed, and end"
    )
    options = parser.parse_args(arguments)
    if unknown := set(options.parts) - set(PARTS):
        parser.error(
            f"there is no part {', '.join(sorted(unknown))}; the parts are {', '.join(PARTS)}"
        )
    if options.when:
        print(when(options.record))
        return 0
    options.record.parent.mkdir(parents=True, exist_ok=True)
    results = [
        run(part, command_of(part, options.minutes), options.record)
        for part in options.parts or PARTS
    ]
    return 0 if all(results) else 1


if __name__ == "__main__":
    sys.exit(main())
