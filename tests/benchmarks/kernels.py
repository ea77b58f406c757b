"""What a pair of sites costs in each kernel, and where a step of a liquid goes: one core, every
vector width.

    python tests/benchmarks/kernels.py --workloads W1,W2,W3 --bits 512,256,128

The liquids are those of peers.py. A lane is one site of a vector that meets another site; it is
useful if the two are inside the cutoff and act on one another. Times are the shortest of many
calls, since other programs can only add to them. A kernel is called several times by compiled code,
and what a call from Python takes with no kernel at all, some milliseconds to find the types of so
many arrays, is taken off. Each width runs in a process of its own, since it is chosen when the
package is imported.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numba import literally, njit
from peers import WORKLOADS, choice, numbers, start_of
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).parents[1]))
from rigidmd import Scene, Simulation
from rigidmd.compile import SIMD_BITS, call, call_blocks, pack_arguments
from rigidmd.core.integrators import SCHEMES
from rigidmd.core.state import State, no_load
from rigidmd.engines.cpu.engine import DTYPES
from rigidmd.forces.neighbors.lists import BUILDS, MASKED, end_of_row, largest_displacement
from rigidmd.forces.neighbors.pair_loop import PairWorkspace
from rigidmd.forces.neighbors.sites import blocks_of, compute_site_positions

STEP = 2e-3  # ps
STEPS = 100  # before anything is measured, so that lists are of a usual age; and of the rate of a whole step
SECONDS = 0.5  # for each measurement
TIMES = 10  # that a kernel is called at once
MESH = ("scale", "spread", "convolve", "back", "forces")  # tasks in blocks
ENDINGS = ("shift", "switch", "smooth_switch")


@njit
def run_blocks(code, name, content, blocks, times):
    """All blocks of a task on this thread, this many times."""
    for _ in range(times):
        call_blocks(code, literally(name), pack_arguments(content), blocks)


@njit
def run_once(code, name, content, times):
    """A task that has one block, this many times."""
    for _ in range(times):
        call(code, literally(name), pack_arguments(content))


@njit
def entries_that_matter(pairs):
    """Entries of the rows' shells that can hold a site inside the cutoff."""
    found, moved = 0, largest_displacement(pairs)
    clusters, per_cluster = pairs.clusters, len(pairs.row_end) * 4 // len(pairs.clusters.origin)
    for block in range(len(pairs.needed)):
        first = 0
        for r in range(
            per_cluster * clusters.bounds[block], per_cluster * clusters.bounds[block + 1]
        ):
            found += end_of_row(pairs, r, moved) - first
            first = pairs.row_end[r]
    return found


def milliseconds(function, *arguments) -> float:
    """Shortest time of a kernel, ms."""
    function(*arguments, 1)
    taken = {0: [], TIMES: []}
    while sum(taken[TIMES]) < SECONDS or len(taken[TIMES]) < 5:
        for times, own in taken.items():
            began = time.perf_counter()
            function(*arguments, times)
            own.append(time.perf_counter() - began)
    return max(0.0, 1e3 * (min(taken[TIMES]) - min(taken[0])) / TIMES)


def useful_pairs(term: PairWorkspace, state: State) -> int:
    """Pairs of sites of different molecules inside the cutoff."""
    edges, group = state.cell.diagonal(), term.pairs.group
    position = np.empty((len(group), 3))
    compute_site_positions(term.sites, state, position)
    tree = cKDTree(np.mod(position, edges) % edges, boxsize=edges)
    found = tree.query_pairs(term.potential.cutoff, output_type="ndarray")
    return int((group[found[:, 0]] != group[found[:, 1]]).sum())


def lanes_of(term: PairWorkspace) -> int:
    """Lanes that the loop works on with the list as it is."""
    pairs = term.pairs
    rows = entries_that_matter(pairs) + pairs.needed[:, MASKED].sum()
    return int(rows) * 2 * 4 * len(pairs.clusters.order) // len(pairs.clusters.origin)


def measure(job: dict) -> list[dict]:
    """Rows of both tables for one workload, precision and truncation, in this process' vector width."""
    work = WORKLOADS[job["workload"]]
    folder = start_of(job["workload"], "own").sites_file.parent
    scene = Scene.from_dict(work.scene(job["ending"], precision=job["precision"]), folder)
    simulation = Simulation(scene)
    engine, state = simulation.engine, simulation.state
    engine.threads = 1
    scheme = SCHEMES["velocity_verlet"]
    engine.advance(state, scheme, STEP, STEPS)
    builds = {name: builds_of(own) for name, own in engine.workspaces.items()}
    began = time.perf_counter()
    engine.advance(state, scheme, STEP, 2 * STEPS)
    step = 1e3 * (time.perf_counter() - began) / STEPS
    common = {
        **job,
        "bits": SIMD_BITS,
        "lanes": SIMD_BITS // (8 * DTYPES[job["precision"]]().itemsize),
        "step": step,
    }
    found = []
    for name, term in engine.workspaces.items():
        if isinstance(term, PairWorkspace):
            every = STEPS / max(1, builds_of(term) - builds[name])
            found.append(
                common
                | {"kernel": f"{name}, {type(term.slot_potential).__name__}"}
                | of_pairs(term, state, every)
            )
        elif hasattr(term, "mesh"):
            found.append(common | {"kernel": name, "mesh": of_mesh(term)})
    return found


def builds_of(term: NamedTuple) -> int:
    """Builds of its list so far; 0 if it has none."""
    return int(term.pairs.counters[BUILDS]) if isinstance(term, PairWorkspace) else 0


def of_pairs(term: PairWorkspace, state: State, every: float) -> dict:
    """Times of the kernels of a pair potential between pairs, whose list is built again every this many steps."""
    load = no_load(state)
    pairs, blocks = term.pairs, len(term.pairs.needed)
    code, lists, content = (
        term.code,
        term.list_code,
        (term.slot_potential, pairs, term.sums, None, None),
    )
    placed, on_sites = (pairs, term.sites, state), (term.sites, state, load, term.forces_in_slots)
    lanes, useful = lanes_of(term), useful_pairs(term, state)
    forces = milliseconds(run_blocks, code, "forces", content, blocks)
    gather = milliseconds(run_blocks, code, "gather", (pairs, term.sums, None), blocks)
    follow = milliseconds(run_blocks, lists, "displacements", pairs, blocks)
    place = milliseconds(run_blocks, lists, "local", placed, blocks)
    loads = milliseconds(run_blocks, code, "load", on_sites, blocks_of(len(state.position)))
    build = (  # in their order: each needs what the one before it leaves
        milliseconds(run_blocks, lists, "wrap", placed, blocks)
        + milliseconds(run_blocks, lists, "bin", placed, blocks)
        + milliseconds(run_once, lists, "sort", pairs)
        + milliseconds(run_blocks, lists, "origins", placed, blocks)
        + place
        + follow
        + milliseconds(run_once, lists, "boxes", pairs)
        + milliseconds(run_blocks, lists, "fill", pairs, blocks)
    )
    return {
        "every": every,
        "per_pair": 1e6 * forces / useful,
        "per_lane": 1e6 * forces / lanes,
        "useful": useful / lanes,
        "parts": {
            "pairs": forces,
            "gather": gather,
            "follow": follow,
            "sites": place + loads,
            "list": build / every,
        },
    }


def of_mesh(term: NamedTuple) -> dict[str, float]:
    """Times of the kernels of the mesh, ms."""
    content, blocks = (term.smooth, term.charge, term.spline, term.mesh), len(term.mesh.tallies)
    content_of = {"convolve": (term.smooth, term.mesh, None)}
    times = {
        task: milliseconds(run_blocks, term.code, task, content_of.get(task, content), blocks)
        for task in MESH
    }
    return times | {"sort": milliseconds(run_once, term.code, "sort", content)}


def main() -> None:
    """Measure and print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument(
        "--workloads", type=choice(WORKLOADS), default=list(WORKLOADS), help="W1,W2,W3"
    )
    parser.add_argument(
        "--bits", type=numbers(int), default=[SIMD_BITS], help="vector widths; 512,256,128"
    )
    parser.add_argument(
        "--endings",
        type=choice(ENDINGS),
        default=list(ENDINGS),
        help="of mixed precision; double has the first of them",
    )
    parser.add_argument("--job", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.job:
        print(json.dumps(measure(json.loads(asked.job))))
        return
    rows = []
    for bits in asked.bits:
        for workload in asked.workloads:
            start_of(workload, "own")
            for precision, ending in [
                *(("mixed", ending) for ending in asked.endings),
                ("double", asked.endings[0]),
            ]:
                job = {"workload": workload, "precision": precision, "ending": ending}
                command = [sys.executable, __file__, "--job", json.dumps(job)]
                environment = os.environ | {
                    "RIGIDMD_SIMD_BITS": str(bits),
                    "NUMBA_NUM_THREADS": "1",
                }
                done = subprocess.run(command, env=environment, capture_output=True, text=True)
                if done.returncode:
                    sys.exit(done.stderr)
                rows += json.loads(done.stdout.splitlines()[-1])
                print(".", end="", file=sys.stderr, flush=True)
    of_pair, of_waves = [r for r in rows if "parts" in r], [r for r in rows if "mesh" in r]
    print(
        "\n| | kernel | precision | ending | lanes | ns a useful pair | ns a lane | useful lanes |\n"
        + "|---" * 8
        + "|"
    )
    for r in of_pair:
        print(
            f"| {r['workload']} | {r['kernel']} | {r['precision']} | {r['ending']} | {r['lanes']} "
            f"| {r['per_pair']:.2f} | {r['per_lane']:.2f} | {100 * r['useful']:.0f} % |"
        )
    print(
        "\n| ms of a step | lanes | "
        + " | ".join(of_pair[0]["parts"])
        + " | list every | the step |\n"
        + "|---" * 9
        + "|"
    )
    for r in of_pair:
        if r["ending"] == asked.endings[0]:
            parts = " | ".join(f"{part:.3f}" for part in r["parts"].values())
            print(
                f"| {r['workload']} {r['kernel'].partition(',')[0]}, {r['precision']} | {r['lanes']} | {parts} "
                f"| {r['every']:.1f} steps | {r['step']:.2f} |"
            )
    if of_waves:
        print(
            "\n| ms of a step | lanes | "
            + " | ".join(of_waves[0]["mesh"])
            + " |\n"
            + "|---" * 8
            + "|"
        )
    for r in of_waves:
        if r["ending"] == asked.endings[0]:
            parts = " | ".join(f"{part:.3f}" for part in r["mesh"].values())
            print(f"| {r['workload']} {r['kernel']}, {r['precision']} | {r['lanes']} | {parts} |")


if __name__ == "__main__":
    main()
