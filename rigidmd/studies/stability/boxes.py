"""Stability cases: the smallest boxes, the most distant positions, the lowest and highest densities."""

import resource
from pathlib import Path

import numpy as np

from rigidmd.assemble.build import build
from rigidmd.assemble.describe import describe
from rigidmd.scene import Scene
from rigidmd.studies.stability.cases import (
    SPLIT,
    WATER_FORCES,
    molecular_scene,
    molecules_scene,
    outcome_of,
    register_case,
    run_invalid,
    run_molecules,
)
from rigidmd.studies.stability.collisions import bent, from_file
from rigidmd.studies.stability.outcomes import REFUSED, RIGHT, CaseResult, Outcome

RIGHT_OR_REFUSED = (RIGHT, REFUSED)


@register_case(10, error="energy error over kinetic energy", step="fs")
def tight_boxes(result: CaseResult, quick: bool) -> None:
    """Boxes of exactly twice the cutoff, barely larger or smaller; thin slabs; one molecule, two, one too long."""
    cutoff = 6.0

    def scene(edges, molecules, **more) -> dict:
        return molecules_scene(molecules, {"lengths_A": edges}, 0.5, 200, SPLIT, 298.0, None, WATER_FORCES | more)

    waters = [{"model": "spce", "count": 40}]
    for size, edge in (("exactly", 2 * cutoff), ("barely larger", np.nextafter(2 * cutoff, 99))):
        result.add(f"cube, {size} twice the cutoff", run_molecules(scene(float(edge), waters)), 0.05, SPLIT)
    smaller = scene(float(np.nextafter(2 * cutoff, 0)), waters)
    result.add("cube, barely smaller", run_invalid(smaller), 0.0, SPLIT, expected=(REFUSED,))
    slab = scene([2 * cutoff, 2 * cutoff, 60.0], waters)
    result.add("column 12 x 12 x 60 Å", run_molecules(slab), 0.05, SPLIT)
    slab = scene([2 * cutoff, 48.0, 48.0], waters)
    result.add("slab 12 x 48 x 48 Å", run_molecules(slab), 0.05, SPLIT)
    for count in (1, 2):
        result.add(f"{count} of water", run_molecules(scene(12.0, [{"model": "spce", "count": count}])), 0.05, SPLIT)
    rod = bent(0.5)
    for site, x in zip(rod["sites"], (-3.5, 0.0, 3.5), strict=True):
        site["position_A"] = [x, site["position_A"][1], 0.0]
    outcome = run_invalid(scene(13.0, [rod | {"count": 2}]))
    result.add("a molecule longer than half the box", outcome, 0.0, SPLIT, expected=(REFUSED,))


@register_case(10, x="shift (Å)", error="energy and force against the unshifted, relative")
def far_away(result: CaseResult, quick: bool) -> None:
    """Molecules on a face, and shifted by whole boxes of 1e3 to 1e300 Å: the same forces to rounding, or refused."""
    edge = 16.0  # a power of two, so that shifts by whole boxes are exact while digits last
    waters = [{"model": "spce", "count": 40}]
    data = molecules_scene(waters, {"lengths_A": edge}, 0.5, 10, SPLIT, 298.0, None, WATER_FORCES)
    system = build(molecular_scene(data))
    state = system.state.copy()
    state.position[:] = np.round(state.position * 2**10) / 2**10
    load, tallies = system.engine().evaluate(state)
    energy = sum(tally.energy for tally in tallies.values())
    force = np.abs(load.force).max()

    def moved(position) -> Outcome:
        other = state.copy()
        other.position[:] = position
        load_there, there = system.engine().evaluate(other)
        gap = abs(sum(tally.energy for tally in there.values()) - energy) / abs(energy)
        return Outcome(max(gap, np.abs(load_there.force - load.force).max() / force), 0.0)

    on_face = state.position - state.position[0]
    result.add("one exactly on a face", outcome_of(lambda: moved(on_face)), 1e-10, x=1.0)
    for shift in (1e3, 1e7, 1e12, 1e300) if quick else [10.0**k for k in (3, 5, 7, 9, 11, 13, 15, 18, 20, 100, 300)]:
        boxes = np.round(shift / edge) * edge
        away = np.where(np.arange(len(state.position))[:, None] % 2, boxes, 0.0)
        # positions have an error of eps times the distance; forces vary relatively by about ten per Å
        left = 1e3 * np.finfo(float).eps * shift
        expected = (RIGHT,) if left < 1e-3 else RIGHT_OR_REFUSED
        outcome = outcome_of(lambda away=away: moved(state.position + away))
        result.add(f"evaluated {shift:.0e} Å away", outcome, max(1e-10, left), x=shift, expected=expected)
        there = state.copy()
        there.position[:] += away
        outcome = from_file(data, there)
        result.add(f"from a file, {shift:.0e} Å away", outcome, 0.05, SPLIT, shift, 0.5, RIGHT_OR_REFUSED)


@register_case(11, x="density (g/cm³)", error="energy error over kinetic energy", step="fs")
def densities(result: CaseResult, quick: bool) -> None:
    """From vacuum to three times the density of a liquid: right, or refused because it cannot be packed."""
    for density in (1e-6, 1.0, 3.0) if quick else (1e-12, 1e-6, 1e-3, 0.3, 1.0, 1.5, 2.0, 2.5, 3.0):
        cutoff = {"cutoff_A": 6.0 if density <= 1 else 4.2}
        waters, box = [{"model": "spce", "count": 64}], {"density_g_cm3": density}
        data = molecules_scene(waters, box, 0.25, 200, SPLIT, 298.0, None, cutoff)
        result.add(f"{density:g} g/cm³", run_molecules(data), 0.05, SPLIT, density, 0.25, RIGHT_OR_REFUSED)
    if not quick:
        result.add("a million points", outcome_of(a_million_points), 0.2, SPLIT, 1.0)


def a_million_points() -> Outcome:
    """The relative error of the memory that `rigidmd check` predicts for a million argon atoms."""
    data = molecules_scene([{"model": "argon", "count": 1_000_000}], {"density_g_cm3": 1.4}, 1.0, 1, SPLIT, 90.0)
    data["stages"][0].pop("rotor")
    small = data | {"molecules": [{"model": "argon", "count": 1000}]}
    run_molecules(small)  # compile first, so that the compiler's memory is not counted
    predicted = float(describe(Scene.from_dict(data)).rsplit("memory: about ", 1)[1].split(" MB")[0])
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    outcome = run_molecules(data)
    if outcome.message or outcome.crash:
        return outcome
    taken = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - pages * resource.getpagesize()) / 1e6
    return Outcome(abs(predicted / taken - 1), 0.0)
