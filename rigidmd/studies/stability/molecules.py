"""Stability cases: molecules that collide, overlap or lack repulsion; extreme boxes and densities;
invalid input."""

import resource
import tempfile
from collections.abc import Iterator, Sequence
from functools import partial
from math import inf, nan, sqrt
from pathlib import Path
from typing import Any

import numpy as np

from rigidmd.assemble.build import build
from rigidmd.assemble.describe import describe
from rigidmd.core.state import State
from rigidmd.core.state_file import write_state
from rigidmd.engines.system import System
from rigidmd.scene import MolecularScene, Scene
from rigidmd.studies.stability.cases import (
    EXACT,
    ORDER_2,
    REFUSED,
    REPORTED,
    RIGHT,
    SCENES,
    SPLIT,
    Outcome,
    Trial,
    case,
    complete_scene,
    finish,
    powers,
    run_scene,
)
from rigidmd.units import BOLTZMANN

Tables = dict[str, Any]
SIGMA, EPSILON = 3.2, 80.0
BOX = {"lengths_A": 20.0}
FORCES = {"cutoff_A": 9.0, "truncation": "smooth_switch"}
WATER_FORCES = {"cutoff_A": 6.0}
RIGHT_OR_REFUSED = (RIGHT, REFUSED)
SHORT_STEP = 0.005  # fs, for molecules that are released where they overlap


def chain(
    positions: Sequence[Sequence[float]] = ((-1.0, 0.0, 0.0), (0.0, 0.5, 0.0), (1.0, 0.0, 0.0)),
    masses: Sequence[float] = (12.0, 12.0, 12.0),
    name: str = "chain",
) -> Tables:
    """A molecule of three sites with Lennard-Jones and charges. Positions (3, 3): Å, masses: u."""
    well = {"sigma_A": SIGMA, "epsilon_K": EPSILON}
    columns = zip("ABC", positions, masses, (0.2, -0.4, 0.2), strict=True)
    sites = [
        well | {"name": site, "position_A": position, "mass_u": mass, "charge_e": charge}
        for site, position, mass, charge in columns
    ]
    return {"name": name, "sites": sites}


def bent(height: float) -> Tables:
    """A chain with steps of 1 Å along x, its middle site at a height (Å) off the line."""
    return chain([[-1.0, 0.0, 0.0], [0.0, height, 0.0], [1.0, 0.0, 0.0]])


def molecules_scene(
    molecules: list[Tables], box: Tables = BOX, forces: Tables = FORCES, temperature: float = 300.0
) -> Tables:
    """The tables of a scene without its stages."""
    start = {"temperature_K": temperature}
    return {"box": box, "molecules": molecules, "forces": forces, "start": start}


def chains(count: int, molecule: Tables | None = None, **settings: Any) -> Tables:
    """A scene of equal molecules."""
    return molecules_scene([(molecule or chain()) | {"count": count}], **settings)


def waters(count: int, box: Tables, forces: Tables = WATER_FORCES) -> Tables:
    """A scene of SPC/E water at 298 K."""
    return molecules_scene([{"model": "spce", "count": count}], box, forces, 298.0)


def system_of(tables: Tables) -> System:
    return build(MolecularScene.from_dict(complete_scene(tables)))


def pair_of(distance: float, speed: float = 0.0, aside: float = 0.1) -> tuple[Tables, State]:
    """Two molecules at a distance (Å) that approach each other at a speed (Å/ps)."""
    tables = chains(2, temperature=0.0)
    state = system_of(tables).state
    state.position[:] = [[10 - distance / 2, 10, 10], [10 + distance / 2, 10 + aside, 10]]
    state.velocity[:] = [[speed / 2, 0, 0], [-speed / 2, 0, 0]]
    state.angular_momentum_body[:] = 0.0
    return tables, state


def from_file(
    tables: Tables, state: State, integrator: str, step: float, **settings: Any
) -> Outcome:
    """The outcome of a run that starts from a file with the molecules of a state."""
    with tempfile.TemporaryDirectory() as folder:
        write_state(Path(folder) / "start.npz", system_of(tables).saved(state))
        started = {"structure": {"file": "start.npz"}} | tables
        return run_scene(started, integrator, step, folder=folder, **settings)


@case(7, "energy error over kinetic energy", "fs")
def head_on(quick: bool) -> Iterator[Trial]:
    """Head-on collisions of Lennard-Jones molecules at 1e2 to 1e6 K, with the step scaled to the
    speed."""
    for temperature in (1e2, 1e6) if quick else (1e2, 1e3, 1e4, 1e5, 1e6):
        speed = 2 * sqrt(3 * BOLTZMANN * temperature / 36.0)
        tables, state = pair_of(6.0, speed)
        way = 8.0 / speed * 1000  # fs, to collide and separate
        step = 0.4 / speed * 10  # a hundredth of an ångström
        run = partial(run_scene, tables, duration=way, state=state)
        method_errors = dict.fromkeys(ORDER_2, 0.04)
        trial = Trial(f"{temperature:.0e} K", run, step, 0.01, method_errors=method_errors)
        yield trial
        if temperature == 1e2 or not quick:
            yield trial.limit()


@case(7, "energy error over the energy of the start", "fs")
def overlaps(quick: bool) -> Iterator[Trial]:
    """Two molecules released at 0.5 sigma, 0.1 sigma and 0: refused, separated or computed
    correctly."""
    refused = {"integrators": [SPLIT], "expected": (REFUSED,)}
    for ratio in (0.5, 0.1, 0.0):
        _, state = pair_of(ratio * SIGMA, aside=0.0)
        run = partial(from_file, chains(2, temperature=10.0), state, steps=400)
        yield Trial(f"file with {ratio:g} sigma", run, 0.01, **refused)
    for density in (5.0, 50.0):
        edge = (4 * 36.0 / (density * 0.602214)) ** (1 / 3)
        tables = chains(4, box={"density_g_cm3": density}, forces={"cutoff_A": 0.45 * edge})
        run = partial(run_scene, tables, steps=100)
        yield Trial(f"lattice of {density:g} g/cm³", run, 0.5, **refused)
    tables, state = pair_of(0.5 * SIGMA)
    tables["watch"] = {"kick": False}  # this case tests the first kick
    scale = finish(complete_scene(tables, SPLIT, SHORT_STEP), state)["potential"][0]
    run = partial(run_scene, tables, duration=50.0, state=state, scale=scale)
    trial = Trial("released at 0.5 sigma", run, SHORT_STEP, 0.01)
    yield trial
    yield trial.limit()


@case(8, "energy error over kinetic energy", "fs")
def bare_charges(quick: bool) -> Iterator[Trial]:
    """A charge without repulsion next to an opposite one: they collapse, and the run reports it."""
    bare = SCENES["bare"]
    run = partial(run_scene, chains(8, bare), steps=500, samples=100)
    yield Trial("arms longer than sigma/2", run, 1.0, 0.1, expected=(REFUSED, REPORTED))
    tables = chains(2, bare)
    system = system_of(tables)
    state, offsets = system.state, system.sites.offset_body
    state.rotation[:] = np.eye(3)
    state.position[:] = [[10, 10, 10], 10 + offsets[1] - offsets[5]]
    run = partial(from_file, tables, state, steps=100)
    yield Trial("a hydrogen on a charge site", run, 1.0, 0.0, [SPLIT], (REFUSED,))


@case(1, "energy error over kinetic energy", "fs")
def near_linear_molecules(quick: bool) -> Iterator[Trial]:
    """Molecules bent by 0.5 Å to 1e-15 Å and exactly straight, at 300 K: right, or refused as
    hardly bent."""
    for height in (0.5, 1e-2, 1e-5, 0.0) if quick else (0.5, *powers(1, 15, quick), 0.0):
        # the smaller the moment about the axis, the faster the spin that rotates the middle site
        run = partial(run_scene, chains(27, bent(height)), steps=200)
        yield Trial(f"{height:.0e} Å", run, 1.0, 0.02, expected=RIGHT_OR_REFUSED)


@case(2, "energy error over kinetic energy", "fs")
def mass_ratio(quick: bool) -> Iterator[Trial]:
    """Two species whose masses differ by 1e6, at the step of the light one."""
    light = chain(masses=[1.0] * 3, name="light") | {"count": 20}
    heavy = chain(masses=[1e6] * 3, name="heavy") | {"count": 7}
    run = partial(run_scene, molecules_scene([light, heavy]), steps=400)
    trial = Trial("1e6", run, 0.5, 0.02)
    yield trial
    if not quick:
        yield trial.limit()


@case(10, "energy error over kinetic energy", "fs")
def tight_boxes(quick: bool) -> Iterator[Trial]:
    """Boxes of exactly twice the cutoff, barely larger or smaller; thin slabs; one molecule, two,
    one too long."""
    boxes = {
        "cube, exactly twice the cutoff": (40, 12.0),
        "cube, barely larger twice the cutoff": (40, np.nextafter(12.0, inf)),
        "cube, barely smaller": (40, np.nextafter(12.0, 0.0)),
        "column 12 x 12 x 60 Å": (40, [12.0, 12.0, 60.0]),
        "slab 12 x 48 x 48 Å": (40, [12.0, 48.0, 48.0]),
        "1 of water": (1, 12.0),
        "2 of water": (2, 12.0),
    }
    for setting, (count, lengths) in boxes.items():
        run = partial(run_scene, waters(count, {"lengths_A": lengths}), steps=200)
        expected = (REFUSED,) if "smaller" in setting else (RIGHT,)
        yield Trial(setting, run, 0.5, 0.05, [SPLIT], expected)
    rod = chain([[-3.5, 0.0, 0.0], [0.0, 0.5, 0.0], [3.5, 0.0, 0.0]])
    run = partial(run_scene, chains(2, rod, box={"lengths_A": 13.0}, forces=WATER_FORCES))
    yield Trial("a molecule longer than half the box", run, 0.5, 0.0, [SPLIT], (REFUSED,))


@case(10, "energy and force against the unshifted, relative", "fs")
def far_away(quick: bool) -> Iterator[Trial]:
    """Molecules on a face, and shifted by whole boxes of 1e3 to 1e300 Å: the same forces to
    rounding, or refused."""
    edge = 16.0  # a power of two, so that shifts by whole boxes are exact while digits last
    # rounding is compared, which the grid of PME and single precision would hide
    forces = WATER_FORCES | {"electrostatics": "reaction_field"}
    tables = waters(40, {"lengths_A": edge}, forces) | {"precision": "double"}
    system = system_of(tables)
    state = system.state.copy()
    state.position[:] = np.round(state.position * 2**10) / 2**10
    energy, force = _energy_and_force(system, state)

    def moved(position: np.ndarray, *_: Any) -> Outcome:
        shifted = state.copy()
        shifted.position[:] = position
        its_energy, its_force = _energy_and_force(system, shifted)
        error = abs(its_energy - energy) / abs(energy)
        return Outcome(max(error, np.abs(its_force - force).max() / np.abs(force).max()), 0.0)

    run = partial(moved, state.position - state.position[0])
    yield Trial("one exactly on a face", run, nan, 1e-10, [""])
    for power in (3, 7, 12, 300) if quick else (3, 5, 7, 9, 11, 13, 15, 18, 20, 100, 300):
        shift = 10.0**power
        away = state.copy()
        away.position[1::2] += np.round(shift / edge) * edge
        # positions have an error of eps times the distance; forces vary relatively by about ten per
        # Å
        rounding = 1e3 * np.finfo(float).eps * shift
        expected = (RIGHT,) if rounding < 1e-3 else RIGHT_OR_REFUSED
        setting, run = f"evaluated {shift:.0e} Å away", partial(moved, away.position)
        yield Trial(setting, run, nan, max(1e-10, rounding), [""], expected)
        run = partial(from_file, tables, away, steps=10)
        setting = f"from a file, {shift:.0e} Å away"
        yield Trial(setting, run, 0.5, 0.05, [SPLIT], RIGHT_OR_REFUSED)


def _energy_and_force(system: System, state: State) -> tuple[float, np.ndarray]:
    load, tallies = system.engine().evaluate(state)
    return sum(tally.energy for tally in tallies.values()), load.force.copy()


@case(11, "energy error over kinetic energy", "fs")
def densities(quick: bool) -> Iterator[Trial]:
    """From vacuum to three times the density of a liquid: right, or refused because it cannot be
    packed."""
    for density in (1e-6, 1.0, 3.0) if quick else (1e-12, 1e-6, 1e-3, 0.3, 1.0, 1.5, 2.0, 2.5, 3.0):
        forces = {"cutoff_A": 6.0 if density <= 1 else 4.2, "electrostatics": "reaction_field"}
        tables = waters(64, {"density_g_cm3": density}, forces)
        run = partial(run_scene, tables, steps=200)
        yield Trial(f"{density:g} g/cm³", run, 0.25, 0.05, [SPLIT], RIGHT_OR_REFUSED)
    if not quick:
        yield Trial("a million points", a_million_points, 1.0, 0.2, [SPLIT])


def argon(count: int) -> Tables:
    molecules: list[Tables] = [{"model": "argon", "count": count}]
    return molecules_scene(molecules, {"density_g_cm3": 1.4}, {}, 90.0)


def a_million_points(integrator: str, step: float) -> Outcome:
    """The relative error of the memory that `rigidmd check` predicts for a million argon atoms."""
    run_scene(argon(1000), integrator, step)  # compile first, which needs memory too
    scene = Scene.from_dict(complete_scene(argon(1_000_000), integrator, step))
    predicted = float(describe(scene).rsplit("memory: about ", 1)[1].split(" MB")[0])
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    run_scene(argon(1_000_000), integrator, step)
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    used = (largest - pages * resource.getpagesize()) / 1e6
    return Outcome(abs(predicted / used - 1), 0.0)


@case(13, "energy error over kinetic energy", "fs")
def strange_molecules(quick: bool) -> Iterator[Trial]:
    """Coinciding sites, a straight molecule along a diagonal, no mass, negative mass, mass at one
    point only."""
    for setting, changes in SCENES["strange"].items():
        run = partial(run_scene, chains(8, chain(**changes)), steps=50)
        yield Trial(setting, run, 1.0, 0.0, [SPLIT], (REFUSED,))
    diagonal = [[0.1 + 0.3 * k, 0.2 + 0.7 * k, 0.3 - 0.9 * k] for k in (-1, 0, 1)]
    run = partial(run_scene, chains(8, chain(diagonal)), steps=50)
    yield Trial("a straight molecule given in space", run, 1.0, 0.05, [SPLIT])


@case(13)
def no_numbers(quick: bool) -> Iterator[Trial]:
    """NaN and infinity in place of every number of a scene of molecules, of a body, and in
    structures."""
    tables = chains(8, forces=FORCES | {"skin_A": 1.0})
    heat = {"ensemble": "nvt", "temperature_K": 300.0, "thermostat_time_ps": 0.1}
    scenes = {
        "molecules": complete_scene(tables, steps=10, thermostat=heat),
        "body": complete_scene(SCENES["driven_body"], EXACT, 0.01, duration=1.0),
    }
    for kind, scene in scenes.items():
        for keys, value, changed in spoiled(scene):
            setting = f"{kind}, {'.'.join(map(str, keys))} = {value}"
            run = partial(run_spoiled, changed)
            yield Trial(setting, run, nan, 0.0, [kind], (REFUSED,))
    tables, state = pair_of(5.0, 0.1)
    structure = {"file": "start.npz", "velocities": True}
    tables |= {"structure": structure, "start": {}}
    for part in ("position", "velocity", "rotation", "angular_momentum_body"):
        for value in (nan, inf):
            changed = state.copy()
            getattr(changed, part)[1] = value
            run = partial(run_spoiled_structure, tables, changed)
            yield Trial(f"structure, {part} = {value}", run, nan, 0.0, ["structure"], (REFUSED,))


def run_spoiled(scene: Tables, *_: Any) -> Outcome:
    finish(scene)
    return Outcome()


def run_spoiled_structure(tables: Tables, state: State, *_: Any) -> Outcome:
    return from_file(tables, state, SPLIT, 1.0, steps=10)


def spoiled(data: Any) -> Iterator[tuple[list[Any], float, Any]]:
    """Nested tables and lists with one number replaced by NaN or an infinity: its path, the value,
    the tables."""
    if isinstance(data, dict | list | tuple):
        for key, inner in data.items() if isinstance(data, dict) else enumerate(data):
            for keys, value, changed in spoiled(inner):
                copied = data.copy() if isinstance(data, dict) else list(data)
                copied[key] = changed
                yield [key, *keys], value, copied
    elif isinstance(data, int | float) and not isinstance(data, bool):
        yield from (([], value, value) for value in (nan, inf, -inf))
