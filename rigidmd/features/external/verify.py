"""Scenes and other engines. `rigidmd export` writes a scene as a folder that another engine runs by
itself. `rigidmd verify` compares a scene on two engines: its start term by term, then a short run
of both at constant energy."""

import tempfile
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rigidmd.assemble.build import build
from rigidmd.core.files import writing
from rigidmd.core.integrators import SCHEMES
from rigidmd.core.programs import programs, runnable
from rigidmd.core.state import NOW, State
from rigidmd.core.toml import Json
from rigidmd.engines.protocol import Engine
from rigidmd.engines.system import System
from rigidmd.errors import SceneError
from rigidmd.features.external.engines import (
    ERRORS,
    Comparison,
    ExternalEngine,
    checked_view,
    compare_at,
    describe_comparison,
    external_engine,
)
from rigidmd.io.folder import SCENE, check_folder, check_names, write_marker, written_by_runs
from rigidmd.io.scene_file import input_names, write_scene
from rigidmd.run import Simulation
from rigidmd.scene import Scene, is_molecular
from rigidmd.scene.engine import EngineChoice
from rigidmd.scene.stage import Stage
from rigidmd.units import FEMTOSECOND

#: File that lists what an export wrote in its folder; `force` replaces the files of an export only.
MARKER = ".rigidmd-export"


class Exported(NamedTuple):
    title: str  # name of the engine
    files: list[str]
    notes: list[str]
    command: str  # that runs the scene in the folder


def export(scene: Scene, to: str, folder: Path, force: bool = False) -> Exported:
    """Write a scene for an external engine. It starts after overlap removal and the first
    minimisations. Raises SceneError with all that the engine cannot do, OutputError if the folder
    is in use."""
    if not is_molecular(scene):
        raise SceneError(
            scene.source, [f"export supports molecules only, and this is {scene.subject}"]
        )
    check_folder(folder, force=force, what="export", marker=MARKER)
    program = programs()[to]
    # a scene for an engine that scenes cannot name has the defaults of rigidmd
    engine = EngineChoice.model_validate({"name": to}) if program.engine else EngineChoice()
    system = build(scene.model_copy(update={"engine": engine}))
    later = [
        f"stages.{k}: export does not support a minimisation after other stages"
        for k, stage in enumerate(system.scene.stages)
        if stage.is_minimisation
        and any(not before.is_minimisation for before in system.scene.stages[:k])
    ]
    scaled = [
        f"stages.{k}.volume = 'mean' stays with rigidmd: omit it, or export that stage with the"
        " final state of the stage before as [structure]"
        for k, stage in enumerate(system.scene.stages)
        if stage.volume
    ]
    view = checked_view(system, program, program.title, [*later, *scaled])
    state = start_of(system)
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".export", dir=folder) as made:
            write_scene(Path(made), system.scene)
            names = [
                SCENE,
                *input_names(system.scene).values(),
                *program.load(program.writer)(Path(made), view, state),
            ]
            check_names(folder, names, MARKER)
            for name in written_by_runs(folder, MARKER):
                (folder / name).unlink(missing_ok=True)
            for name in names:
                (Path(made) / name).replace(folder / name)
        write_marker(folder, names, MARKER)
    return Exported(program.title, names, system.notes, program.command)


def start_of(system: System) -> State:
    """The state after overlap removal and the first minimisations, by rigidmd itself."""
    return Simulation(
        system.scene.model_copy(update={"engine": EngineChoice()}), warn=lambda sentence: None
    )._settle()


STEPS, STEP = 50, 1.0  # number of steps of the short run, and their length, fs
#: Tolerance of positions after it (Å), where forces are sums of pairs; for moves beyond 1 Å
#: relative to the move.
TOLERANCE = 1e-6
#: Tolerance of positions relative to the move, in relative errors of lengths: 10 were measured (216
#: SPC/E).
GROWTH = 20
#: Number of runs, each with half the step of the one before, where engines have different methods
#: of order 2.
HALVINGS = 4


class Verification(NamedTuple):
    """Two engines at the start of a scene and after a short run from there."""

    scene: str
    other: str  # with its version
    start: list[Comparison]
    run: list[Comparison]

    @property
    def agrees(self) -> bool:
        return all(line.agrees for line in (*self.start, *self.run))

    def description(self) -> str:
        name = self.other.split()[0]
        parts = [
            f"{self.scene}: rigidmd and {self.other} at the start",
            describe_comparison(self.start, name),
            f"after {STEPS} steps of {STEP:g} fs at constant energy",
            describe_comparison(self.run, name),
            "they agree" if self.agrees else "they do NOT agree",
        ]
        return "\n".join(parts)

    def to_json(self) -> Json:
        lines = {
            part: [line._asdict() for line in getattr(self, part)] for part in ("start", "run")
        }
        return {"scene": self.scene, "engine": self.other, "agrees": self.agrees, **lines}


def verify(scene: Scene) -> Verification:
    """Compare rigidmd with the engine that the scene names, both in double precision where that
    engine has it. Raises SceneError with all that the other engine cannot do, EngineError if it is
    not installed."""
    if not is_molecular(scene):
        raise SceneError(
            scene.source, [f"{scene.subject} has no other engine: verify is for molecules"]
        )
    if not scene.engine.is_external:
        raise SceneError(
            scene.source, [f"engine.name names no other engine; there are {', '.join(runnable())}"]
        )
    system = build(scene)
    state = start_of(system)
    short = Stage(ensemble="nve", duration_ps=STEPS * STEP * FEMTOSECOND, timestep_fs=STEP)
    system = replace(
        system, scene=system.scene.model_copy(update={"stages": (short,)}), state=state
    )
    other = external_engine(system)
    try:
        start = compare_at(system, state, system.engine_of(system.terms, "double"), other)
        return Verification(scene.name, other.version, start, _short_run(system, state, other))
    finally:
        other.close()


def _short_run(system: System, state: State, other: ExternalEngine) -> list[Comparison]:
    """Compare the largest moves of sites on both engines from a state on, and the difference of
    their positions."""
    rotor = other.rotor(system.model)
    span = STEPS * STEP * FEMTOSECOND
    here = (
        replace(system, model=system.model._replace(rotor=rotor)) if rotor is not None else system
    )
    engines = here.engine_of(here.terms, "double"), other
    if (
        rotor is not None
    ):  # both rotate bodies by the same composition of rotations: every step is the same
        ends = [_sites_after(system, engine, state, STEPS) for engine in engines]
        step_error = 0.0
    else:
        found = [_extrapolated(system, engine, state) for engine in engines]
        ends = [end for end, _ in found]
        step_error = sum(error for _, error in found)
    difference = float(np.abs(ends[0] - ends[1]).max())
    moves = [float(np.abs(end - system.site_positions(state)).max()) for end in ends]
    worst = 0.0  # displacement (Å) of a site by an error of a force, per u Å/ps² and ps²/2
    tolerance = (
        TOLERANCE * max(1.0, moves[0]) + step_error + GROWTH * other.length_tolerance * moves[0]
    )
    for m in system.species:  # and what errors of the Ewald sums of both engines explain
        least = m.inertia[m.inertia > 0].min(initial=np.inf)
        worst = max(worst, np.sqrt(len(m.masses)) * (1 / m.mass + m.radius**2 / least))
    tolerance += float(ERRORS * (system.force_error or 0.0) * worst * span**2 / 2)
    return [Comparison("largest move of a site", "Å", moves[0], moves[1], difference, tolerance)]


def _sites_after(system: System, engine: Engine, state: State, steps: int) -> np.ndarray:
    """Site positions (s, 3) after the span of the short run, in this number of steps."""
    scheme = SCHEMES["velocity_verlet"]
    dt = STEPS * STEP * FEMTOSECOND / steps
    moved = engine.begin(state, scheme)
    moved.begin_segment(0.0)
    engine.forget()
    engine.advance(moved, scheme, dt, int(moved.step[NOW]) + steps)
    return system.site_positions(moved)


def _extrapolated(system: System, engine: Engine, state: State) -> tuple[np.ndarray, float]:
    """Positions extrapolated to a step of 0, where methods of order 2 agree, and the largest change
    by the last extrapolation (Romberg's scheme: errors are even powers of the step)."""
    table = [_sites_after(system, engine, state, STEPS * 2**k) for k in range(HALVINGS)]
    change = 0.0
    for order in range(1, HALVINGS):
        new = [b + (b - a) / (4**order - 1) for a, b in pairwise(table)]
        change = float(np.abs(new[-1] - table[-1]).max())
        table = new
    return table[0], change
