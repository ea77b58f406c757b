"""A pair potential added by one file."""

import json
import os
import shutil
import subprocess
import sys
import zlib

import pytest
from support.common import ROOT

SOFT = """
from typing import NamedTuple

import numpy as np

from rigidmd.compile import implements
from rigidmd.compile.simd import inverse_square_root
from rigidmd.features.potentials.pairs import pair_forces
from rigidmd.forces.neighbors import pair_loop
from rigidmd.scene.added_forces import AddedForce
from rigidmd.scene.validation import Positive
from rigidmd.units import KJ_PER_MOL


class SoftRepulsion(AddedForce):
    \"\"\"A soft repulsion of all sites: strength (1 - r/range)².\"\"\"

    strength_kJ_mol: Positive
    \"\"\"Energy at a distance of 0\"\"\"
    range_A: Positive = 5.0
    \"\"\"Where it ends\"\"\"

    def term(self, system):
        sites = [np.arange(len(m.masses)) for m in system.species]
        return pair_forces(Soft(self.range_A, self.strength_kJ_mol * KJ_PER_MOL), system, sites)


class Soft(NamedTuple):
    cutoff: float  # Å
    strength: float  # u Å²/ps²

    def for_slots(self, slots, dtype):
        return self


@implements(pair_loop.pair, Soft, inline=True)
def _pair(potential, i, j, r2):
    inverse = inverse_square_root(r2)
    left = 1.0 - r2 * inverse * (1 / potential.cutoff)
    return potential.strength * left * left, (2.0 * potential.strength / potential.cutoff) * left * inverse
"""
SOFT_SCENE = """
precision = "double"
[box]
lengths_A = 26.0
[[molecules]]
model = "nitrogen"
count = 90
[forces]
cutoff_A = 9.0
lennard_jones = false
soft_repulsion = { strength_kJ_mol = 3.0 }
[start]
temperature_K = 100.0
[[stages]]
duration_ps = 0.05
[output]
trajectory = false
figures = false
"""
SOFT_SCRIPT = """
import json
from pathlib import Path
import numpy as np
import rigidmd
from support.common import shaken
from rigidmd import Scene
from rigidmd.assemble.build import build
from rigidmd.run.kind import describe
from rigidmd import Simulation
from rigidmd.errors import SceneError
from rigidmd.scene import schema

def messages(change):
    try:
        Scene.from_dict(data | {"forces": {"soft_repulsion": change}})
    except SceneError as error:
        return error.errors

scene = Scene.read("soft.toml")
data = {"box": {"lengths_A": 26.0}, "molecules": [{"model": "nitrogen", "count": 9}],
        "start": {"temperature_K": 100.0}, "stages": [{"duration_ps": 0.05}]}
system, engine, state = shaken(build(scene), 5)
load, tallies = engine.evaluate(state)
x = system.site_positions(state)
away = x[:, None] - x
away -= 26.0 * np.rint(away / 26.0)
r = np.linalg.norm(away, axis=2)
owner = system.sites.molecule
near = (r < 5.0) & (owner[:, None] != owner)
strength = 300.0
expected = 0.5 * strength * ((1 - r[near] / 5.0) ** 2).sum()
force, error = load.force[:5].copy(), 0.0
for m in range(5):
    for k in range(3):
        found = []
        for step in (-1e-4, 1e-4):
            state.position[m, k] += step
            found.append(sum(tally.energy for tally in engine.evaluate(state)[1].values()))
            state.position[m, k] -= step
        error = max(error, abs(force[m, k] + (found[1] - found[0]) / 2e-4))
ends = []
for threads in (1, 2):
    results = Simulation(Scene.read("soft.toml", {"threads": threads})).run()
    ends.append([getattr(results.state, name).tobytes() for name in ("position", "velocity", "rotation")])
print(json.dumps({
    "energy": tallies["soft_repulsion"].energy, "expected": expected, "force_error": error, "force": abs(force).max(),
    "same_bits": ends[0] == ends[1], "check": describe(scene, verbose=True), "without": describe(Scene.from_dict(data)),
    "column": system.quantities["soft_repulsion"].header, "file": rigidmd.__file__,
    "schema": list(schema()["$defs"]["Forces"]["properties"]["soft_repulsion"]["properties"]),
    "errors": [messages({}), messages({"strength_kJ_mol": 1.0, "range": 3.0})],
}))
"""


def run_with_file(folder, script):
    """The last line that a script prints in a copy of the package with the potential. Its class is
    named by the text, because compiled code is found by its name."""
    shutil.copytree(
        ROOT / "rigidmd", folder / "rigidmd", ignore=shutil.ignore_patterns("docs", "__pycache__")
    )
    (folder / "systems").symlink_to(ROOT / "systems")
    text = SOFT.replace("Soft(", f"Soft{zlib.crc32(SOFT.encode()):x}(").replace(
        "Soft,", f"Soft{zlib.crc32(SOFT.encode()):x},"
    )
    (folder / "rigidmd/features/potentials/pairs/soft_repulsion.py").write_text(text)
    paths = os.pathsep.join([str(folder), str(ROOT / "tests")])
    done = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        cwd=folder,
        env=os.environ | {"PYTHONPATH": paths},
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout.splitlines()[-1]


def test_adding_a_pair_potential_takes_one_file(tmp_path):
    (tmp_path / "soft.toml").write_text(SOFT_SCENE)
    found = json.loads(run_with_file(tmp_path, SOFT_SCRIPT))
    assert found["energy"] == pytest.approx(found["expected"], rel=1e-12)
    assert found["force_error"] < 1e-6 * found["force"]
    assert found["same_bits"]
    assert "soft repulsion: strength_kJ_mol = 3.0, range_A = 5.0" in found["check"]
    assert "\n  Lennard-Jones: lennard_jones is false\n" in found["check"]
    assert found["column"] == "soft_repulsion (kJ/mol)"
    assert found["file"].endswith("rigidmd/__init__.py") and str(tmp_path) in found["file"]
    assert "soft_repulsion" not in found["without"]
    assert found["schema"] == ["strength_kJ_mol", "range_A"]
    assert found["errors"][0] == ["forces.soft_repulsion.strength_kJ_mol: is missing"]
    assert "did you mean range_A?" in found["errors"][1][0]
