"""Stability cases: molecules that collide, overlap or lack repulsion; extreme boxes and densities;
invalid input."""

import resource
import tempfile
from collections.abc import Iterator
from math import inf, nan, sqrt
from pathlib import Path
from typing import Any

import numpy as np

from rigidmd.assemble.build import build
from rigidmd.assemble.describe import describe
from rigidmd.core.state import State
from rigidmd.core.state_file import write_state
from rigidmd.scene import MolecularScene, Scene
from rigidmd.studies.stability.cases import (
    EXACT,
    REFUSED,
    REPORTED,
    RIGHT,
    SPLIT,
    CaseResult,
    Outcome,
    attempt,
    body_scene,
    energy_error,
    families,
    longest_step,
    molecules_scene,
    register,
    run_invalid,
    run_molecules,
    simulate,
)
from rigidmd.units import BOLTZMANN

#: A bent molecule of three sites with Lennard-Jones and charges, of the same kind of scene as
#: water.
SIGMA, EPSILON = 3.2, 80.0


def bent(off_line: float = 0.5, name: str = "bent", mass: float = 12.0) -> dict:
    """Three equal sites with steps of 1 Å along x, the middle one at this height (Å) off the line
    of the others."""
    site = {"mass_u": mass, "sigma_A": SIGMA, "epsilon_K": EPSILON}
    sites = [
        site | {"name": "A", "position_A": [-1.0, 0.0, 0.0], "charge_e": 0.2},
        site | {"name": "B", "position_A": [0.0, float(off_line), 0.0], "charge_e": -0.4},
        site | {"name": "C", "position_A": [1.0, 0.0, 0.0], "charge_e": 0.2},
    ]
    return {"name": name, "sites": sites}


BOX, FORCES = {"lengths_A": 20.0}, {"cutoff_A": 9.0, "truncation": "smooth_switch"}
WATER_FORCES = {"cutoff_A": 6.0}
RIGHT_OR_REFUSED = (RIGHT, REFUSED)


def pair_of(distance: float, speed: float) -> tuple[list[dict], State]:
    """Two bent molecules at a distance (Å) that approach each other at a speed (Å/ps)."""
    species = [bent() | {"count": 2}]
    data = molecules_scene(species, BOX, 1.0, 1, temperature=0.0, forces=FORCES)
    state = build(MolecularScene.from_dict(data)).state
    state.position[:] = [[10 - distance / 2, 10, 10], [10 + distance / 2, 10.1, 10]]
    state.velocity[:] = [[speed / 2, 0, 0], [-speed / 2, 0, 0]]
    state.angular_momentum_body[:] = 0.0
    return species, state


@register(7, error="energy error over kinetic energy", step="fs")
def head_on(result: CaseResult, quick: bool) -> None:
    """Head-on collisions of Lennard-Jones molecules at 1e2 to 1e6 K, with the step scaled to the
    speed."""
    for temperature in (1e2, 1e6) if quick else (1e2, 1e3, 1e4, 1e5, 1e6):
        speed = 2 * sqrt(3 * BOLTZMANN * temperature / 36.0)
        species, state = pair_of(6.0, speed)
        way = 8.0 / speed * 1000  # fs, to collide and separate

        def at(step: float, family: str, species=species, state=state, way=way) -> Outcome:
            data = molecules_scene(
                species, BOX, step, max(1, round(way / step)), family, 0.0, None, FORCES
            )
            return run_molecules(data, state)

        step = 0.4 / speed * 10  # a hundredth of an ångström
        for family in families(quick):
            allowed = 5e-2 if family.startswith(SPLIT) else 1e-2
            result.add(f"{temperature:.0e} K", at(step, family), allowed, family, step)
            if temperature == 1e2 or not quick:
                result.limits.append(
                    longest_step(lambda h, f=family: at(h, f), step, f"{temperature:.0e} K", family)
                )


@register(7, error="energy error over the energy of the start", step="fs")
def overlaps(result: CaseResult, quick: bool) -> None:
    """Two molecules released at 0.5 sigma, 0.1 sigma and 0: refused, separated or computed
    correctly."""
    for ratio in (0.5, 0.1, 0.0):
        data = molecules_scene([bent() | {"count": 2}], BOX, 0.01, 400, SPLIT, 10.0, None, FORCES)
        _, state = pair_of(ratio * SIGMA, 0.0)
        state.position[:, 1] = 10.0
        result.add(
            f"file with {ratio:g} sigma", from_file(data, state), 0.0, SPLIT, 0.01, (REFUSED,)
        )
    for density in (5.0, 50.0):
        cutoff = {"cutoff_A": 0.45 * (4 * 36.0 / (density * 0.602214)) ** (1 / 3)}
        species, box = [bent() | {"count": 4}], {"density_g_cm3": density}
        data = molecules_scene(species, box, 0.5, 100, SPLIT, 300.0, None, cutoff)
        result.add(
            f"lattice of {density:g} g/cm³", run_molecules(data), 0.01, SPLIT, 0.5, (REFUSED,)
        )
    species, state = pair_of(0.5 * SIGMA, 0.0)
    for family in families(quick):

        @attempt
        def at(step: float, family=family) -> Outcome:
            scene = molecules_scene(
                species, BOX, step, max(1, round(50 / step)), family, 0.0, None, FORCES
            )
            results = simulate(
                scene | {"watch": {"kick": False}}, state
            )  # this case tests the first kick
            reported_error = energy_error(results, results["potential"][0])
            return Outcome(reported_error, reported_error)

        result.add("released at 0.5 sigma", at(0.005), 1e-2, family, 0.005)
        result.limits.append(longest_step(at, 0.005, "released at 0.5 sigma", family))


@attempt
def from_file(data: dict, state: State, velocities: bool = False) -> Outcome:
    """The outcome of a scene that starts from a file with the molecules of a state."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "start.npz"
        write_state(
            path,
            build(MolecularScene.from_dict(data | {"start": {"temperature_K": 0.0}})).saved(state),
        )
        started = data | {"structure": {"file": path.name, "velocities": velocities}}
        return run_molecules(started | ({"start": {}} if velocities else {}), folder=folder)


@register(8, error="energy error over kinetic energy", step="fs")
def bare_charges(result: CaseResult, quick: bool) -> None:
    """A charge without repulsion next to an opposite one: they collapse, and the run reports it."""
    ion = {"mass_u": 10.0, "sigma_A": SIGMA, "epsilon_K": EPSILON}
    sites = [
        ion | {"name": "O", "position_A": [0.0, 0.0, 0.0]},
        {"name": "H", "mass_u": 2.0, "position_A": [3.0, 0.0, 0.0], "charge_e": 0.8},
        {"name": "M", "mass_u": 2.0, "position_A": [-1.0, 2.5, 0.0], "charge_e": -0.8},
    ]
    bare = {"name": "bare", "count": 8, "sites": sites}
    for family in families(quick):
        data = molecules_scene([bare], BOX, 1.0, 500, family, 300.0, None, FORCES, samples=100)
        result.add(
            "arms longer than sigma/2", run_molecules(data), 0.1, family, 1.0, (REFUSED, REPORTED)
        )
    data = molecules_scene([bare | {"count": 2}], BOX, 1.0, 100, SPLIT, 300.0, None, FORCES)
    system = build(MolecularScene.from_dict(data))
    state, offsets = system.state, system.sites.offset_body
    state.rotation[:] = np.eye(3)
    state.position[:] = [[10, 10, 10], 10 + offsets[1] - offsets[5]]
    result.add("a hydrogen on a charge site", from_file(data, state), 0.0, SPLIT, 1.0, (REFUSED,))


@register(1, error="energy error over kinetic energy", step="fs")
def near_linear_molecules(result: CaseResult, quick: bool) -> None:
    """Molecules bent by 0.5 Å to 1e-15 Å and exactly straight, at 300 K: right, or refused as
    hardly bent."""
    heights = [0.5, 1e-2, 1e-5, 0.0] if quick else [0.5] + [10.0**-k for k in range(1, 16)] + [0.0]
    for height in heights:
        for family in families(quick):
            # the smaller the moment about the axis, the faster the spin that rotates the middle
            # site
            data = molecules_scene(
                [bent(height) | {"count": 27}], BOX, 1.0, 200, family, 300.0, None, FORCES
            )
            result.add(f"{height:.0e} Å", run_molecules(data), 0.02, family, 1.0, RIGHT_OR_REFUSED)


@register(2, error="energy error over kinetic energy", step="fs")
def mass_ratio(result: CaseResult, quick: bool) -> None:
    """Two species whose masses differ by 1e6, at the step of the light one."""
    species = [bent(0.5, "light", 1.0) | {"count": 20}, bent(0.5, "heavy", 1e6) | {"count": 7}]
    for family in families(quick):

        def at(step: float, family=family) -> Outcome:
            return run_molecules(
                molecules_scene(species, BOX, step, 400, family, 300.0, None, FORCES)
            )

        result.add("1e6", at(0.5), 0.02, family, 0.5)
        if not quick:
            result.limits.append(longest_step(at, 0.5, "1e6", family))


@register(10, error="energy error over kinetic energy", step="fs")
def tight_boxes(result: CaseResult, quick: bool) -> None:
    """Boxes of exactly twice the cutoff, barely larger or smaller; thin slabs; one molecule, two,
    one too long."""
    cutoff = 6.0

    def scene(edges, molecules) -> dict:
        return molecules_scene(
            molecules, {"lengths_A": edges}, 0.5, 200, SPLIT, 298.0, None, WATER_FORCES
        )

    waters = [{"model": "spce", "count": 40}]
    for size, edge in (("exactly", 2 * cutoff), ("barely larger", np.nextafter(2 * cutoff, 99))):
        result.add(
            f"cube, {size} twice the cutoff", run_molecules(scene(float(edge), waters)), 0.05, SPLIT
        )
    smaller = scene(float(np.nextafter(2 * cutoff, 0)), waters)
    result.add("cube, barely smaller", run_invalid(smaller), 0.0, SPLIT, expected=(REFUSED,))
    for setting, edges in (
        ("column 12 x 12 x 60", [12.0, 12.0, 60.0]),
        ("slab 12 x 48 x 48", [12.0, 48.0, 48.0]),
    ):
        result.add(f"{setting} Å", run_molecules(scene(edges, waters)), 0.05, SPLIT)
    for count in (1, 2):
        result.add(
            f"{count} of water",
            run_molecules(scene(12.0, [{"model": "spce", "count": count}])),
            0.05,
            SPLIT,
        )
    rod = bent(0.5)
    for site, x in zip(rod["sites"], (-3.5, 0.0, 3.5), strict=True):
        site["position_A"] = [x, site["position_A"][1], 0.0]
    outcome = run_invalid(scene(13.0, [rod | {"count": 2}]))
    result.add("a molecule longer than half the box", outcome, 0.0, SPLIT, expected=(REFUSED,))


@register(10, error="energy and force against the unshifted, relative")
def far_away(result: CaseResult, quick: bool) -> None:
    """Molecules on a face, and shifted by whole boxes of 1e3 to 1e300 Å: the same forces to
    rounding, or refused."""
    edge = 16.0  # a power of two, so that shifts by whole boxes are exact while digits last
    waters = [{"model": "spce", "count": 40}]
    # rounding is compared, which the grid of PME and single precision would hide
    forces = WATER_FORCES | {"electrostatics": "reaction_field"}
    data = molecules_scene(waters, {"lengths_A": edge}, 0.5, 10, SPLIT, 298.0, None, forces) | {
        "precision": "double"
    }
    system = build(MolecularScene.from_dict(data))
    state = system.state.copy()
    state.position[:] = np.round(state.position * 2**10) / 2**10
    load, tallies = system.engine().evaluate(state)
    energy = sum(tally.energy for tally in tallies.values())
    force = np.abs(load.force).max()

    @attempt
    def moved(position) -> Outcome:
        other = state.copy()
        other.position[:] = position
        load_there, there = system.engine().evaluate(other)
        gap = abs(sum(tally.energy for tally in there.values()) - energy) / abs(energy)
        return Outcome(max(gap, np.abs(load_there.force - load.force).max() / force), 0.0)

    result.add("one exactly on a face", moved(state.position - state.position[0]), 1e-10)
    for shift in (
        (1e3, 1e7, 1e12, 1e300)
        if quick
        else [10.0**k for k in (3, 5, 7, 9, 11, 13, 15, 18, 20, 100, 300)]
    ):
        away = np.where(
            np.arange(len(state.position))[:, None] % 2, np.round(shift / edge) * edge, 0.0
        )
        # positions have an error of eps times the distance; forces vary relatively by about ten per
        # Å
        left = 1e3 * np.finfo(float).eps * shift
        expected = (RIGHT,) if left < 1e-3 else RIGHT_OR_REFUSED
        outcome = moved(state.position + away)
        result.add(f"evaluated {shift:.0e} Å away", outcome, max(1e-10, left), expected=expected)
        there = state.copy()
        there.position[:] += away
        outcome = from_file(data, there)
        result.add(f"from a file, {shift:.0e} Å away", outcome, 0.05, SPLIT, 0.5, RIGHT_OR_REFUSED)


@register(11, error="energy error over kinetic energy", step="fs")
def densities(result: CaseResult, quick: bool) -> None:
    """From vacuum to three times the density of a liquid: right, or refused because it cannot be
    packed."""
    for density in (1e-6, 1.0, 3.0) if quick else (1e-12, 1e-6, 1e-3, 0.3, 1.0, 1.5, 2.0, 2.5, 3.0):
        cutoff = {"cutoff_A": 6.0 if density <= 1 else 4.2, "electrostatics": "reaction_field"}
        waters, box = [{"model": "spce", "count": 64}], {"density_g_cm3": density}
        data = molecules_scene(waters, box, 0.25, 200, SPLIT, 298.0, None, cutoff)
        result.add(f"{density:g} g/cm³", run_molecules(data), 0.05, SPLIT, 0.25, RIGHT_OR_REFUSED)
    if not quick:
        result.add("a million points", a_million_points(), 0.2, SPLIT)


@attempt
def a_million_points() -> Outcome:
    """The relative error of the memory that `rigidmd check` predicts for a million argon atoms."""
    data = molecules_scene(
        [{"model": "argon", "count": 1_000_000}], {"density_g_cm3": 1.4}, 1.0, 1, SPLIT, 90.0
    )
    data["stages"][0].pop("rotor")
    small = data | {"molecules": [{"model": "argon", "count": 1000}]}
    run_molecules(small)  # compile first, so that the compiler's memory is not counted
    predicted = float(
        describe(Scene.from_dict(data)).rsplit("memory: about ", 1)[1].split(" MB")[0]
    )
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    outcome = run_molecules(data)
    if outcome.message or outcome.crash:
        return outcome
    taken = (
        resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - pages * resource.getpagesize()
    ) / 1e6
    return Outcome(abs(predicted / taken - 1), 0.0)


@register(13, error="energy error over kinetic energy", step="fs")
def strange_molecules(result: CaseResult, quick: bool) -> None:
    """Coinciding sites, a straight molecule along a diagonal, no mass, negative mass, mass at one
    point only."""

    def scene(change) -> dict:
        kind = bent() | {"count": 8}
        change(kind["sites"])
        return molecules_scene([kind], BOX, 1.0, 50, SPLIT, 300.0, None, FORCES)

    def place(k, position):
        return lambda sites: sites[k].update(position_A=position)

    def weigh(*masses):
        return lambda sites: [
            site.update(mass_u=mass) for site, mass in zip(sites, masses, strict=True)
        ]

    changes = {
        "two coinciding sites": place(1, [-1.0, 0.0, 0.0]),
        "two sites at 1e-9 Å": place(1, [-1.0, 1e-9, 0.0]),
        "all sites coinciding": lambda sites: [
            site.update(position_A=[0.0, 0.0, 0.0]) for site in sites
        ],
        "no mass": weigh(0.0, 0.0, 0.0),
        "negative mass": weigh(12.0, -1.0, 12.0),
        "all mass in one site": weigh(0.0, 12.0, 0.0),
        "massless site off a line of masses": weigh(12.0, 0.0, 12.0),
    }
    for setting, change in changes.items():
        result.add(setting, run_invalid(scene(change)), 0.0, SPLIT, expected=(REFUSED,))

    def slanted(sites):
        for site, k in zip(sites, (-1.0, 0.0, 1.0), strict=True):
            site["position_A"] = [0.1 + 0.3 * k, 0.2 + 0.7 * k, 0.3 - 0.9 * k]

    result.add("a straight molecule given in space", run_molecules(scene(slanted)), 0.05, SPLIT)


def spoiled(data: Any) -> Iterator[tuple[list, float, Any]]:
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


@register(13)
def no_numbers(result: CaseResult, quick: bool) -> None:
    """NaN and infinity in place of every number of a scene of molecules, of a body, and in
    structures."""
    heat = {"temperature_K": 300.0, "thermostat_time_ps": 0.1}
    molecules = molecules_scene(
        [bent() | {"count": 8}], BOX, 1.0, 10, SPLIT, 300.0, heat, FORCES | {"skin_A": 1.0}
    )
    tables = {
        "body": {
            "mass_kg": 1.0,
            "inertia_kg_m2": [1.0, 1.5, 2.0],
            "pinned": True,
            "centre_of_mass_m": [0.0, 0.1, 0.2],
        },
        "start": {
            "euler_angles_deg": [1.0, 2.0, 3.0],
            "angular_velocity_body_rad_s": [1.0, 2.0, 3.0],
        },
        "gravity": {"acceleration_m_s2": [0.0, 0.0, -9.81]},
        "friction": {"viscous_N_m_s": [0.1, 0.1, 0.1], "dry_N_m": [0.1, 0.1, 0.1]},
        "applied": [{"torque_N_m": [0.1, 0.2, 0.3], "from_s": 0.1, "to_s": 0.2}],
    }
    for setting, data in (("molecules", molecules), ("body", body_scene(tables, 0.01, 1.0, EXACT))):
        for keys, value, bad in spoiled(data):
            name = f"{setting}, {'.'.join(map(str, keys))} = {value}"
            result.add(name, run_invalid(bad), 0.0, setting, expected=(REFUSED,))
    species, state = pair_of(5.0, 0.1)
    file = molecules_scene(species, BOX, 1.0, 10, SPLIT, None, None, FORCES)
    for part in ("position", "velocity", "rotation", "angular_momentum_body"):
        for value in (nan, inf):
            bad = state.copy()
            getattr(bad, part)[1] = value
            outcome = from_file(file, bad, True)
            result.add(
                f"structure, {part} = {value}", outcome, 0.0, "structure", expected=(REFUSED,)
            )
