"""Known answers of stability cases: molecules that collide, overlap, lack repulsion or are far
away. Water and its thermostat. Invalid input."""

import sys
from collections.abc import Iterator
from math import hypot, inf, nan, sqrt
from pathlib import Path

import numpy as np

from rigidmd.core.state import State
from rigidmd.core.statistics import mean_and_error
from rigidmd.core.toml import Json
from rigidmd.engines.system import System
from rigidmd.features.studies.stability.cases import Outcome, Trial, builder
from rigidmd.features.studies.stability.runner import (
    Warn,
    complete_scene,
    finish,
    run_scene,
    system_of,
)
from rigidmd.run.kind import describe
from rigidmd.run.results import Results
from rigidmd.scene import Scene
from rigidmd.scene.validation import not_none
from rigidmd.units import BOLTZMANN, KJ_PER_MOL

Trials = Iterator[Trial]
SIGMA = 3.2
#: States of water by molecules and temperature.
STATES: dict[tuple[str, float], State] = {}


@builder
def run(trial: Trial, x: object) -> Trials:
    """The errors of conserved quantities."""
    yield trial


def pair_of(trial: Trial, distance: float, aside: float = 0.1, speed: float = 0.0) -> State:
    """Two molecules at a distance (Å) that approach each other at a speed (Å/ps)."""
    state = system_of(trial).state
    state.position[:] = [[10 - distance / 2, 10, 10], [10 + distance / 2, 10 + aside, 10]]
    state.velocity[:] = [[speed / 2, 0, 0], [-speed / 2, 0, 0]]
    state.angular_momentum_body[:] = 0.0
    return state


@builder
def collision(trial: Trial, temperature: float) -> Trials:
    """Two molecules that collide and separate, in steps of a hundredth of an ångström."""
    speed = 2 * sqrt(3 * BOLTZMANN * temperature / 36.0)
    state = pair_of(trial, 6.0, speed=speed)
    yield trial._replace(state=state, step=0.4 / speed * 10, duration=8.0 / speed * 1000)


@builder
def overlap(trial: Trial, ratio: float) -> Trials:
    yield trial._replace(state=pair_of(trial, ratio * SIGMA, aside=0.0))


@builder
def release(trial: Trial, x: float) -> Trials:
    yield trial._replace(state=pair_of(trial, 0.5 * SIGMA))


@builder
def lattice(trial: Trial, density: float) -> Trials:
    """Four molecules of 36 u, with a cutoff of nearly half the box."""
    edge = (4 * 36.0 / (density * 0.602214)) ** (1 / 3)
    yield trial._replace(scene=trial.scene | {"forces": {"cutoff_A": 0.45 * edge}})


@builder
def touching_charges(trial: Trial, x: float) -> Trials:
    system = system_of(trial)
    state = system.state
    offsets = system.sites.offset_body
    state.rotation[:] = np.eye(3)
    state.position[:] = [[10, 10, 10], 10 + offsets[1] - offsets[5]]
    yield trial._replace(state=state)


@builder
def liquid(trial: Trial, temperature: float) -> Trials:
    yield trial._replace(state=water_at(trial, temperature))


@builder
def tip4p(trial: Trial, step: float) -> Trials:
    yield trial._replace(state=water_at(trial._replace(step=1.0), 300.0))


def water_at(trial: Trial, temperature: float) -> State:
    """Liquid water at a temperature: at 298 K after 0.5 ps from a lattice, else from there. At 0 K
    at rest in a minimum of its energy."""
    key = str(trial.scene["molecules"]), temperature
    if key not in STATES:
        is_first, is_frozen = temperature == 298.0, temperature == 0.0
        step, steps = (1.0, 500) if is_first else (trial.step, 1000)
        heat = {"temperature_K": temperature, "thermostat_time_ps": 20 * step / 1000}
        changes: Json = {"start": {"temperature_K": 298.0}}
        if is_frozen:
            changes |= {"stages": [{"ensemble": "minimise"}]}
        preparation = Trial(
            scene=trial.scene | changes,
            stage={"ensemble": "nvt"} | heat,
            steps=steps,
            state=None if is_first else water_at(trial, 298.0),
        )
        state = finish(preparation, "velocity_verlet", lambda warning: None, step).state
        if is_frozen:
            state.velocity[:] = 0.0
            state.angular_momentum_body[:] = 0.0
        STATES[key] = state
    return STATES[key]


@builder
def equipartition(trial: Trial, step: float) -> Trials:
    """|T_rot - T_trans| in its standard errors, after a fifth of the run."""

    def error(results: Results) -> float:
        late = len(results["time"]) // 5
        columns = [f"temperature_{motion}" for motion in ("rotation", "translation")]
        averages = [mean_and_error(results[column][late:]) for column in columns]
        (rotation, its_error), (translation, error) = (map(not_none, pair) for pair in averages)
        return abs(rotation - translation) / hypot(its_error, error)

    yield trial._replace(error=error)


@builder
def thermostat(trial: Trial, ratio: float) -> Trials:
    """With dt / tau: little heat if weak, the canonical mean of the kinetic energy if strong."""
    heat = {"temperature_K": 298.0, "thermostat_time_ps": trial.step / 1000 / ratio}
    steps = trial.steps
    freedom = 6 * 64 - 3
    canonical = 0.5 * freedom * 298.0 * BOLTZMANN / KJ_PER_MOL

    def error(results: Results) -> float:
        kinetic = results["kinetic"]
        if steps * ratio < 1e-3:
            added = np.abs(results["energy"] - results["conserved"]).max() / kinetic[0]
            # ten standard deviations of its noise, 2 sqrt(dt/tau / freedom) in a step
            return added / (10 * sqrt(4 * ratio * steps / freedom))
        if ratio < 1:
            return 0.0 if np.isfinite(kinetic).all() else inf
        return abs(kinetic[1:].mean() / canonical - 1) / sqrt(2 / freedom / steps)

    stage = {"ensemble": "nvt"} | heat
    yield trial._replace(state=water_at(trial, 298.0), stage=stage, error=error)


def shifted(trial: Trial, shift: float) -> tuple[System, State, State]:
    """A system, its state, and that with every second molecule shifted by whole boxes."""
    system = system_of(trial)
    state = system.state.copy()
    state.position[:] = np.round(state.position * 2**10) / 2**10
    away = state.copy()
    edge = trial.scene["box"]["lengths_A"]
    away.position[1::2] += np.round(shift / edge) * edge
    return system, state, away


@builder
def far_away_in_file(trial: Trial, shift: float) -> Trials:
    yield trial._replace(state=shifted(trial, shift)[2])


@builder
def far_away(trial: Trial, shift: float) -> Trials:
    """The change of energy and forces, relative. Without a shift the first molecule is on a face.

    Positions have an error of eps times the distance. Forces vary relatively by about ten per Å.
    """
    system, state, away = shifted(trial, shift)
    if shift == 0:
        away.position[:] -= state.position[0]

    def compare(*_: object) -> Outcome:
        energy, force = energy_and_force(system, state)
        its_energy, its_force = energy_and_force(system, away)
        force_error = np.abs(its_force - force).max() / np.abs(force).max()
        return Outcome(max(abs(its_energy / energy - 1), force_error), 0.0)

    allowed = max(1e-10, 1e3 * np.finfo(float).eps * shift)
    yield trial._replace(run=compare, allowed=allowed, step=nan)


def energy_and_force(system: System, state: State) -> tuple[float, np.ndarray]:
    load, tallies = system.engine().evaluate(state)
    return sum(tally.energy for tally in tallies.values()), load.force.copy()


@builder
def memory(trial: Trial, x: float) -> Trials:
    if sys.platform == "linux":  # where a process can read its memory
        yield trial._replace(run=memory_error)


def memory_error(trial: Trial, integrator: str, warn: Warn, step: float) -> Outcome:
    """The relative error of the memory that `rigidmd check` predicts. On Linux only."""
    assert sys.platform == "linux"
    import resource

    few = [{"model": "argon", "count": 1000}]
    small = trial._replace(scene=trial.scene | {"molecules": few})
    run_scene(small, integrator, warn, step)  # compile first, which needs memory too
    scene = Scene.from_dict(complete_scene(trial, integrator, step))
    predicted = float(describe(scene).rsplit("memory: about ", 1)[1].split(" MB")[0])
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    run_scene(trial, integrator, warn, step)
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    used = (largest - pages * resource.getpagesize()) / 1e6
    return Outcome(abs(predicted / used - 1), 0.0)


@builder
def spoiled_scenes(trial: Trial, x: float) -> Trials:
    for keys, value, scene in spoiled(complete_scene(trial, trial.integrators[0], trial.step)):
        name = ".".join(map(str, keys))
        yield trial._replace(setting=f"{trial.setting}, {name} = {value}", scene=scene)


def spoiled(data: object) -> Iterator[tuple[list[str | int], float, object]]:
    """Nested tables and lists with one number replaced by NaN or an infinity: its path, the value,
    the tables."""
    if isinstance(data, dict | list):
        for key, inner in data.items() if isinstance(data, dict) else enumerate(data):
            for keys, value, changed in spoiled(inner):
                copied = data.copy()
                copied[key] = changed
                yield [key, *keys], value, copied
    elif isinstance(data, int | float) and not isinstance(data, bool):
        yield from (([], value, value) for value in (nan, inf, -inf))


@builder
def spoiled_structures(trial: Trial, x: float) -> Trials:
    state = pair_of(trial, 5.0, speed=0.1)
    for part in ("position", "velocity", "rotation", "angular_momentum_body"):
        for value in (nan, inf):
            changed = state.copy()
            getattr(changed, part)[1] = value
            yield trial._replace(setting=f"structure, {part} = {value}", state=changed)
