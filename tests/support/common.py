"""Helpers that several test files use. What a test tests it imports from its module."""

import platform
import shlex
import shutil
import subprocess
import time
from pathlib import Path

import numpy as np

from rigidmd import BodyScene, Scene
from rigidmd.assemble.build import build
from rigidmd.commands.cli import main
from rigidmd.compile import kernel
from rigidmd.core.integrators import Scheme
from rigidmd.core.state import NO_CELL, NOW, State
from rigidmd.engines import observables
from rigidmd.engines.cpu.engine import CpuEngine as Engine
from rigidmd.engines.system import System
from rigidmd.features.analysis.rigid_frames import RigidFrames
from rigidmd.mechanics.free_rotor import rotate
from rigidmd.mechanics.rotation import random_rotations

ROOT = Path(__file__).parents[2]
SYSTEMS = sorted((ROOT / "systems").glob("*.toml"))
BODIES = [path for path in SYSTEMS if isinstance(Scene.read(path), BodyScene)]
MOLECULES = [path for path in SYSTEMS if path not in BODIES]

#: Argon atoms on springs, so far from each other that nothing else acts on them: m w² in u/ps², and w dt = 1
#: at 36 fs.
SPRING = 30_000.0


# a system, its engine, its state


def pinned(tables: dict) -> dict:
    """Tables of a scene of molecules with a reaction field, one truncation for all forces, no tail
    correction, double precision and steps of 2 fs, unless they state otherwise: one set of kernels
    for most tests. The defaults of users have tests of their own."""
    forces = {"electrostatics": "reaction_field", "tail_correction": False, "truncation": "switch"}
    forces |= tables.get("forces", {})
    if forces["electrostatics"] == "reaction_field":
        forces = {"reaction_field_truncation": forces["truncation"]} | forces
    stages = [
        stage
        if stage.get("ensemble") == "minimise" or stage.get("integrator") == "auto"
        else {"timestep_fs": 2.0} | stage
        for stage in tables.get("stages", [])
    ]
    return {"precision": "double"} | tables | {"forces": forces, "stages": stages}


def small_scene(counts: dict[str, int], edge: float | None, folder=".", **sections) -> Scene:
    """A scene of shipped models in a cube (no periodic box if edge is None), two NVE steps, and no
    figures unless they are requested."""
    data = {
        "box": {"lengths_A": edge} if edge else {"lengths_A": 15.0, "periodic": False},
        "molecules": [{"model": name, "count": count} for name, count in counts.items()],
        "start": {"temperature_K": 300.0},
        "stages": [{"duration_ps": 0.004}],
    }
    output = {"figures": False} | sections.get("output", {})
    return Scene.from_dict(pinned(data | sections | {"output": output}), folder)


def site(name: str, mass: float, position=(0.0, 0.0, 0.0), charge: float = 0.0, **keys) -> dict:
    """A site of a scene: mass (u), position (Å), charge (e), further keys such as `sigma_A`."""
    charges = {"charge_e": charge} if charge else {}
    return {"name": name, "mass_u": mass, "position_A": list(position)} | charges | keys


def system_of(counts, edge=40.0, cutoff=5.0, **sections) -> System:
    """The system of `small_scene`, with a cutoff (Å)."""
    return build(small_scene(counts, edge, **{"forces": {"cutoff_A": cutoff}} | sections))


def shaken(system: System, seed: int, spread: float = 0.4) -> tuple[System, Engine, State]:
    """A system, its engine, and its start with molecules shaken off the lattice and rotated again."""
    rng = np.random.default_rng(seed)
    state = system.state.copy()
    state.position[:] += spread * rng.standard_normal(state.position.shape)
    if len(state.rotation):
        state.rotation[:] = random_rotations(rng, len(state.rotation))
    return system, system.engine(), state


def bits_with(threads: int, system: System, state: State) -> tuple:
    """All bits of forces, torques, energies and virials of a state, computed by this many threads."""
    engine = system.engine()
    engine.threads = threads
    load, tallies = engine.evaluate(state)
    by_term = [(name, tally.energy, tally.virial.tobytes()) for name, tally in tallies.items()]
    return load.force.tobytes(), load.torque_body.tobytes(), by_term


def built(counts, edge, seed=0, spread=0.4, **sections) -> tuple[System, Engine, State]:
    """`shaken` of `small_scene`: system, engine, state."""
    return shaken(build(small_scene(counts, edge, **sections)), seed, spread)


def same_bits(a, b) -> bool:
    """Whether two sequences of arrays, such as states, are the same."""
    return all(x.tobytes() == y.tobytes() for x, y in zip(a, b, strict=True))


def observe(system: System, engine: Engine, state: State, **options):
    """The observables of a state, with energies in u Å²/ps²."""
    return observables.observe(system, engine, state, energy_unit=1.0, **options)


def move(engine: Engine, state: State, scheme: Scheme, dt: float, steps: int) -> None:
    """Take this many more steps, in place."""
    engine.advance(state, scheme, dt, int(state.step[NOW]) + steps)


@kernel(from_python=True)
def spin(rotor, rotation, angular_momentum, h: float, steps: int) -> None:
    """Rotation the first molecule without torque, in place."""
    for _ in range(steps):
        rotate(rotor, 0, rotation, angular_momentum, 0, h)


def argon(**more) -> Scene:
    """Twenty argon atoms for 0.1 ps."""
    return small_scene(
        {"argon": 20}, 25.0, stages=[{"duration_ps": 0.1}], output={"log_interval_ps": 0.01}, **more
    )


def springs(**stage) -> Scene:
    """64 argon atoms, each an isotropic oscillator, under Langevin's thermostat at 300 K unless the
    stage states otherwise."""
    whole = {
        "ensemble": "nvt",
        "temperature_K": 300.0,
        "duration_ps": 20.0,
        "thermostat": "langevin",
        "friction_translation_per_ps": 15.0,
    } | stage
    return small_scene(
        {"argon": 64},
        80.0,
        forces={"cutoff_A": 8.0},
        stages=[{k: v for k, v in whole.items() if v is not None}],
        fields={"restraints": [{"stiffness_kJ_mol_A2": SPRING / 100}]},
        output={"trajectory": False, "figures": False},
    )


# other programs


def gmx(folder: Path, command: str, text: str = "") -> str:
    """What a command of GROMACS prints; it has to succeed."""
    done = subprocess.run(
        [shutil.which("gmx"), "-quiet", "-nobackup", *shlex.split(command)],
        cwd=folder,
        input=text,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout[-1500:] + done.stderr[-1500:]
    return done.stdout


# made-up frames


def history(
    system,
    time,
    positions,
    cell=None,
    Q=None,
    velocities=None,
    L=None,
    tensor=None,
    temperature=300.0,
):
    """Frames as they are given; a cell for all of them, or one for each."""
    f, n = len(time), len(system.model.species)
    cell = NO_CELL if cell is None else np.asarray(cell)
    if positions is None:
        positions = np.zeros((f, n, 3))
    return RigidFrames(
        system,
        system.scene.stages[-1],
        np.asarray(time),
        np.broadcast_to(cell, (f, 3, 3)),
        positions,
        np.empty((f, 0, 3, 3)) if Q is None else Q,
        velocities,
        L,
        {"temperature": np.full(f, temperature)},
        tensor,
    )


def noise_with_memory(rng, frames, shape, variance, time, interval):
    """Ornstein and Uhlenbeck's process: stationary, with a correlation exp(-t/time)."""
    keep = np.exp(-interval / time)
    x = np.sqrt(variance) * rng.standard_normal(shape)
    found = np.empty((frames, *shape))
    for k in range(frames):
        found[k] = x
        x = keep * x + np.sqrt(variance * (1 - keep**2)) * rng.standard_normal(shape)
    return found


def refused(capsys, tmp_path, text, *arguments, code=2):
    """The message for a scene text; checks that nothing was written and that there is no
    traceback."""
    scene = tmp_path / "bad.toml"
    scene.write_text(text)
    before = sorted(p.relative_to(tmp_path) for p in tmp_path.rglob("*"))
    assert main(["run", str(scene), "-o", str(tmp_path / "out"), *arguments]) == code
    assert sorted(p.relative_to(tmp_path) for p in tmp_path.rglob("*")) == before
    out, err = capsys.readouterr()
    assert "Traceback" not in out + err
    return err


AT_ONCE = 5.0  # s of computing


def refusal(capsys, tmp_path, text, *arguments, commands=("check",)):
    """The message for a scene, the same of each command."""
    (tmp_path / "scene.toml").write_text(text)
    messages = set()
    for command in commands:
        begin = time.process_time()
        assert main([command, str(tmp_path / "scene.toml"), *arguments]) == 2
        assert time.process_time() - begin < AT_ONCE
        messages.add(capsys.readouterr().err)
    assert len(messages) == 1
    return messages.pop()


def processor() -> str:
    """The name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(
            line.partition(":")[2].strip() for line in lines if line.startswith("model name")
        )
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()
