"""Shared by all tests: small scenes, the folder of outside data, the shipped systems."""

import os
from pathlib import Path

import numpy as np
import pytest

from rigidmd.assemble.system import System, build
from rigidmd.core.schemes import Scheme
from rigidmd.core.state import NOW, State
from rigidmd.engines.cpu import Engine
from rigidmd.mechanics.rotation import random_rotations
from rigidmd.scene import BodyScene, Scene

# Tests run on all cores: a second process for each that compiles would only take time from the others.
os.environ.setdefault("RIGIDMD_COMPILERS", "1")

ROOT = Path(__file__).parent.parent
SYSTEMS = sorted((ROOT / "systems").glob("*.toml"))
BODIES = [path for path in SYSTEMS if isinstance(Scene.read(path), BodyScene)]
MOLECULES = [path for path in SYSTEMS if path not in BODIES]


@pytest.fixture(scope="session")
def reference() -> Path:
    """Outside data: RIGIDMD_REFERENCE, or ../shared/reference beside the project."""
    folder = Path(os.environ.get("RIGIDMD_REFERENCE", ROOT.parent / "shared" / "reference"))
    if not folder.is_dir():
        pytest.skip(f"no outside reference data at {folder} (RIGIDMD_REFERENCE names it)")
    return folder


def small_scene(counts: dict[str, int], edge: float | None, folder=".", **sections) -> Scene:
    """A scene of shipped models in a cube (no periodic box if edge is None), two NVE steps."""
    data = {
        "box": {"lengths_A": edge} if edge else {"lengths_A": 15.0, "periodic": False},
        "molecules": [{"model": name, "count": count} for name, count in counts.items()],
        "start": {"temperature_K": 300.0},
        "stages": [{"duration_ps": 0.004}],
    }
    return Scene.from_dict(data | sections, folder)


def shaken(system: System, seed: int, spread: float = 0.4) -> tuple[System, Engine, State]:
    """A system's engine, and its start with molecules shaken off the lattice and turned anew."""
    rng = np.random.default_rng(seed)
    state = system.state.copy()
    state.position[:] += spread * rng.standard_normal(state.position.shape)
    if len(state.rotation):
        state.rotation[:] = random_rotations(rng, len(state.rotation))
    return system, system.engine(), state


def move(engine: Engine, state: State, scheme: Scheme, dt: float, steps: int) -> None:
    """Take so many more steps, in place."""
    engine.advance(state, scheme, dt, int(state.step[NOW]) + steps)


def built(counts, edge, seed=0, spread=0.4, **sections):
    """`shaken` of `small_scene`."""
    return shaken(build(small_scene(counts, edge, **sections)), seed, spread)


#: Argon atoms on springs, so far apart that nothing else acts on them: m w² in u/ps², and w dt = 1 at 36 fs.
SPRING = 30_000.0


def springs(**stage) -> Scene:
    """64 argon atoms, each an isotropic oscillator, under Langevin's thermostat at 300 K unless told otherwise."""
    told = {"ensemble": "nvt", "temperature_K": 300.0, "duration_ps": 20.0, "thermostat": "langevin",
            "friction_translation_per_ps": 15.0} | stage  # fmt: skip
    return small_scene(
        {"argon": 64}, 80.0, forces={"cutoff_A": 8.0}, stages=[{k: v for k, v in told.items() if v is not None}],
        fields={"restraints": [{"stiffness_kJ_mol_A2": SPRING / 100}]},
        output={"trajectory": False, "figure": False},
    )  # fmt: skip
