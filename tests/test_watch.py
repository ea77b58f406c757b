"""An engine that notices: each kind of finding, what it says, what it leaves behind; and that ordinary runs go on."""

import os
import subprocess
import sys

from conftest import ROOT


def test_a_term_of_somebody_elses_spoils_no_cache(tmp_path):
    """A script with a term of its own leaves an index that names its module; another program runs without it."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "mylaw.py").write_text(
        "from typing import NamedTuple\nclass Term(NamedTuple):\n    k: float\n"
    )
    (tmp_path / "shared.py").write_text(
        "from rigidmd.jit import kernel\n@kernel\ndef first(term):\n    return term[0]\n"
    )
    said = []
    for script, path in (
        ("from mylaw import Term; import shared; print(shared.first(Term(2.0)))", tmp_path / "mine"),
        ("import shared; print(shared.first((3.0,)))", tmp_path),
    ):
        environment = os.environ | {
            "RIGIDMD_CACHE": str(tmp_path / "cache"),
            "PYTHONPATH": os.pathsep.join(map(str, (ROOT, tmp_path, path))),
        }
        done = subprocess.run(
            [sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=False
        )
        said.append(done.stdout.strip() or done.stderr)
    assert said == ["2.0", "3.0"]
