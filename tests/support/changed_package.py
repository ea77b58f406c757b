"""Processes in which the package has other files, as where a user adds one."""

import re
import subprocess
import sys
import zlib
from pathlib import Path

from support.common import ROOT

#: Loads modules of rigidmd from other files, in a process that has not imported rigidmd.
OTHER_MODULES = """
import importlib.util, sys
class Other:
    modules = {modules!r}
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return importlib.util.spec_from_file_location(name, cls.modules[name]) if name in cls.modules else None
sys.meta_path.insert(0, Other)
sys.path.insert(0, {tests!r})
"""


def run_with_files(folder: Path, files: dict[str, str], script: str) -> str:
    """What a script prints in a process in which the package has these files, new ones or others of
    the same name. Classes of terms are named by the text, because compiled code is found by their
    names."""
    found = {}
    for k, (name, text) in enumerate(files.items()):
        for term in re.findall(
            r"^class (\w+)\(NamedTuple\)", "" if (ROOT / "rigidmd" / name).exists() else text, re.M
        ):
            text = re.sub(rf"\b{term}\b", f"{term}_{zlib.crc32(text.encode()):x}", text)
        path = folder / f"{k}_{Path(name).name}"
        path.write_text(text)
        found["rigidmd." + name.removesuffix(".py").replace("/", ".")] = str(path)
    prelude = OTHER_MODULES.format(modules=found, tests=str(ROOT / "tests"))
    done = subprocess.run(
        [sys.executable, "-c", prelude + script], capture_output=True, text=True, cwd=folder
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def edited(name: str, *changes: tuple[str, str]) -> str:
    """The text of a file of the package with some changes; each old text must be there once."""
    text = (ROOT / "rigidmd" / name).read_text()
    for old, new in changes:
        assert text.count(old) == 1, f"{name}: {old!r} is there {text.count(old)} times"
        text = text.replace(old, new)
    return text
