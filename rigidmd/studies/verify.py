"""A scene on two engines: the start term by term, then a short run of both at constant energy."""

from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from rigidmd.assemble.build import build
from rigidmd.core.integrators import SCHEMES
from rigidmd.core.state import NOW, State
from rigidmd.engines.comparison import ERRORS, Comparison, compare_at, describe_comparison
from rigidmd.engines.external import ExternalEngine, external_engine
from rigidmd.engines.protocol import Engine
from rigidmd.engines.system import System
from rigidmd.errors import SceneError
from rigidmd.scene import MolecularScene, Scene
from rigidmd.scene.engine import EXTERNAL
from rigidmd.scene.stage import Stage
from rigidmd.studies.export import start_of
from rigidmd.units import FEMTOSECOND

#: Steps of the short run, and of what, fs.
STEPS, STEP = 50, 1.0
#: Å by which positions may differ after it, where forces are sums of pairs; of moves beyond 1 Å a fraction.
APART = 1e-6
#: Times the relative error of lengths that sites may part by, relative to their move: measured 10 (216 SPC/E).
GROWTH = 20
#: Runs with steps halved again and again, where engines have different methods, both of order 2.
HALVINGS = 4


class Verified(NamedTuple):
    """Two engines at the start of a scene and after a short run from there."""

    scene: str
    other: str  # with its version
    start: list[Comparison]
    run: list[Comparison]

    @property
    def agrees(self) -> bool:
        """Whether they do, everywhere."""
        return all(line.agrees for line in (*self.start, *self.run))

    def in_words(self) -> str:
        name = self.other.split()[0]
        parts = [f"{self.scene}: rigidmd and {self.other} at the start"]
        parts += [describe_comparison(self.start, name), f"after {STEPS} steps of {STEP:g} fs at constant energy"]
        parts += [describe_comparison(self.run, name), "they agree" if self.agrees else "they do NOT agree"]
        return "\n".join(parts)

    def told(self) -> dict[str, Any]:
        """As JSON has it."""
        lines = {part: [line._asdict() for line in getattr(self, part)] for part in ("start", "run")}
        return {"scene": self.scene, "engine": self.other, "agrees": self.agrees, **lines}


def verify(scene: Scene) -> Verified:
    """Hold rigidmd against the engine that the scene names, both in double precision where that has it.

    Raises SceneError with all that the other engine cannot do, EngineError if it is not here.
    """
    if not isinstance(scene, MolecularScene):
        raise SceneError(scene.source, ["a single body has no other engine: verify is for molecules"])
    if not scene.engine.is_external:
        raise SceneError(scene.source, [f"engine.name names no other engine; there are {', '.join(EXTERNAL)}"])
    system = build(scene)
    state = start_of(system)
    short = Stage(ensemble="nve", duration_ps=STEPS * STEP * FEMTOSECOND, timestep_fs=STEP)
    system = replace(system, scene=system.scene.model_copy(update={"stages": (short,)}), state=state)
    other = external_engine(system)
    try:
        start = compare_at(system, state, system.engine_of(system.terms, "double"), other)
        run = _short_run(system, state, other)
        return Verified(scene.name, other.version, start, run)
    finally:
        other.close()


def _short_run(system: System, state: State, other: ExternalEngine) -> list[Comparison]:
    """Both engines from the state on: how far sites have moved, and how far apart they are then."""
    rotor, span = other.rotor(system.model), STEPS * STEP * FEMTOSECOND
    here = replace(system, model=system.model._replace(rotor=rotor)) if rotor is not None else system
    own = here.engine_of(here.terms, "double")
    if rotor is not None:  # both turn bodies by the same composition of rotations: every step is the same
        ends, doubt = [_sites_after(system, engine, state, STEPS) for engine in (own, other)], 0.0
    else:
        found = [_extrapolated(system, engine, state) for engine in (own, other)]
        ends, doubt = [end for end, _ in found], sum(error for _, error in found)
    apart = float(np.abs(ends[0] - ends[1]).max())
    far = [float(np.abs(end - system.site_positions(state)).max()) for end in ends]
    allowed = APART * max(1.0, far[0]) + doubt + GROWTH * other.length_tolerance * far[0] + _of_accuracy(system, span)
    return [Comparison("largest move of a site", "Å", far[0], far[1], apart, allowed)]


def _sites_after(system: System, engine: Engine, state: State, steps: int) -> np.ndarray:
    """Positions of sites (s, 3) after the span of the short run in so many steps."""
    scheme, dt = SCHEMES["velocity_verlet"], STEPS * STEP * FEMTOSECOND / steps
    moved = engine.begin(state, scheme)
    moved.begin_stretch(0.0)
    engine.forget()
    engine.advance(moved, scheme, dt, int(moved.step[NOW]) + steps)
    return system.site_positions(moved)


def _extrapolated(system: System, engine: Engine, state: State) -> tuple[np.ndarray, float]:
    """The same extrapolated to a step of 0, which methods of order 2 share, and the largest change by the last step of
    the extrapolation (Romberg's scheme: errors are even powers of the step)."""
    table = [_sites_after(system, engine, state, STEPS * 2**k) for k in range(HALVINGS)]
    change = 0.0
    for order in range(1, HALVINGS):
        new = [b + (b - a) / (4**order - 1) for a, b in pairwise(table)]
        change, table = float(np.abs(new[-1] - table[-1]).max()), new
    return table[0], change


def _of_accuracy(system: System, span: float) -> float:
    """How far the errors of an Ewald sum on both engines may carry a site in a span (ps), Å."""
    error, worst = system.force_error or 0.0, 0.0
    for m in system.species:
        least = m.inertia[m.inertia > 0].min(initial=np.inf)
        worst = max(worst, np.sqrt(len(m.masses)) * (1 / m.mass + m.radius**2 / least))
    return float(ERRORS * error * worst * span**2 / 2)
