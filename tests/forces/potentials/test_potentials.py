"""A pair potential added by two files."""

import json

import pytest
from support.changed_package import edited, run_with_files

SOFT = """
from typing import NamedTuple

import numpy as np

from rigidmd.compile import implements
from rigidmd.compile.simd import inverse_square_root
from rigidmd.forces.neighbors import pair_loop
from rigidmd.forces.parts import Interactions
from rigidmd.units import KJ_PER_MOL


class SoftRepulsion(NamedTuple):
    cutoff: float  # Å
    strength: float  # u Å²/ps²

    def for_slots(self, slots, dtype):
        return self


def interactions(parts):
    keys = parts.scene.forces.soft_repulsion
    sites = parts.sites([np.arange(len(m.masses)) for m in parts.species])
    potential = SoftRepulsion(keys.range_A, keys.strength_kJ_mol * KJ_PER_MOL)
    return Interactions({"soft_repulsion": parts.pair_forces(potential, sites)}, {}, notes=("a soft note",))


@implements(pair_loop.pair, SoftRepulsion, inline=True)
def _pair(potential, i, j, r2):
    inverse = inverse_square_root(r2)
    left = 1.0 - r2 * inverse * (1 / potential.cutoff)
    return potential.strength * left * left, (2.0 * potential.strength / potential.cutoff) * left * inverse
"""
SOFT_KEYS = """class SoftRepulsion(Section):
    \"\"\"A soft repulsion of all sites: strength (1 - r/range)².\"\"\"

    strength_kJ_mol: Positive
    \"\"\"Energy at a distance of 0\"\"\"
    range_A: Positive = 5.0
    \"\"\"Where it ends\"\"\"


class Forces(Section):
    \"\"\"Forces between sites of different molecules.\"\"\"

    soft_repulsion: SoftRepulsion | None = None
    \"\"\"A soft repulsion\"\"\"
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
from support.common import shaken
from rigidmd import Scene
from rigidmd.assemble.build import build
from rigidmd.assemble.describe import describe
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
    "same_bits": ends[0] == ends[1], "check": describe(scene), "without": describe(Scene.from_dict(data)),
    "schema": list(schema()["$defs"]["SoftRepulsion"]["properties"]),
    "errors": [messages({}), messages({"strength_kJ_mol": 1.0, "range": 3.0})],
}))
"""


def test_adding_a_pair_potential_takes_two_files(tmp_path):
    files = {
        "scene/forces.py": edited(
            "scene/forces.py",
            (
                'class Forces(Section):\n    """Forces between sites of different molecules."""\n',
                SOFT_KEYS,
            ),
            (
                "POTENTIALS = {",
                'POTENTIALS = {"soft_repulsion": ("soft repulsion", "not in [forces]"), ',
            ),
        ),
        "forces/potentials/soft_repulsion.py": SOFT,
    }
    assert len(files) == 2
    (tmp_path / "soft.toml").write_text(SOFT_SCENE)
    found = json.loads(run_with_files(tmp_path, files, SOFT_SCRIPT).splitlines()[-1])
    assert found["energy"] == pytest.approx(found["expected"], rel=1e-12)
    assert found["force_error"] < 1e-6 * found["force"]
    assert found["same_bits"]
    assert "soft repulsion: 180 sites" in found["check"] and "  a soft note\n" in found["check"]
    assert "\n  Lennard-Jones: lennard_jones is false\n" in found["check"]
    assert "\n  soft repulsion: not in [forces]\n" in found["without"]
    assert found["schema"] == ["strength_kJ_mol", "range_A"]
    assert found["errors"][0] == ["forces.soft_repulsion.strength_kJ_mol: is missing"]
    assert "did you mean range_A?" in found["errors"][1][0]
