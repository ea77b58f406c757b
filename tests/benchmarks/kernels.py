"""What a pair of sites costs in each kernel, and where a step of a liquid goes: one core, every
vector width.

    python tests/benchmarks/kernels.py --workloads W1,W2,W3 --bits 512,256,128

The liquids are those of peers.py. A lane is one site of a vector that meets another site; it is
useful if the two are inside the cutoff and act on one another. The parts of a step are those of
`rigidmd check --profile`. Each width runs in a process of its own, since it is chosen when the
package is imported.
"""

import json
import os
import subprocess
import sys
from argparse import SUPPRESS
from pathlib import Path

import numpy as np
from command_line import SMOKE_OPTION, choice, new_parser, numbers, read_options
from numba import njit
from peers import WORKLOADS, start_folder
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).parents[1]))
from rigidmd import Scene, Simulation
from rigidmd.compile import SIMD_BITS
from rigidmd.core.integrators import SCHEMES
from rigidmd.core.state import State
from rigidmd.engines.cpu.engine import DTYPES
from rigidmd.engines.cpu.program import profile_of
from rigidmd.forces.neighbors.lists import MASKED, end_of_row, largest_displacement
from rigidmd.forces.neighbors.pair_loop import PairWorkspace
from rigidmd.forces.neighbors.sites import compute_site_positions

STEP = 2e-3  # ps
AGE = 8  # steps since the build of a list whose lanes are counted: a usual age
TRUNCATIONS = ("shift", "switch", "smooth_switch")
PAIRS = "forces of pairs"  # text of a pass


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


def measure(job: dict) -> dict:
    """Costs of pairs, and times of the parts of a step, of one workload, precision and truncation,
    in this process' vector width."""
    work = WORKLOADS[job["workload"]]
    scene = Scene.from_dict(
        work.scene(job["truncation"], precision=job["precision"]), start_folder(job["workload"])
    )
    simulation = Simulation(scene)
    engine = simulation.engine
    engine.threads = 1
    scheme = SCHEMES["velocity_verlet"]
    profile = profile_of(engine, simulation.state, scheme, STEP)
    state = engine.begin(simulation.state, scheme)
    engine.advance(state, scheme, STEP, AGE)
    pairs, times = [], [(text, 1e3 * spent) for text, (spent,) in profile.rows]
    for text, spent in times:
        name, _, part = text.partition(": ")
        if part == PAIRS:
            term = engine.workspaces[name]
            lanes, useful = lanes_of(term), useful_pairs(term, state)
            pairs.append(
                {
                    "kernel": f"{name}, {type(term.slot_potential).__name__}",
                    "per_pair": 1e6 * spent / useful,
                    "per_lane": 1e6 * spent / lanes,
                    "useful": useful / lanes,
                }
            )
    lanes = SIMD_BITS // (8 * np.dtype(DTYPES[job["precision"]]).itemsize)
    return {**job, "lanes": lanes, "step": 1e3 * profile.steps[0], "pairs": pairs, "times": times}


def run_job(workload: str, precision: str, truncation: str, bits: int) -> dict:
    """`measure` in a process with this vector width."""
    job = {"workload": workload, "precision": precision, "truncation": truncation}
    done = subprocess.run(
        [sys.executable, __file__, "--job", json.dumps(job), *SMOKE_OPTION],
        env=os.environ | {"RIGIDMD_SIMD_BITS": str(bits), "NUMBA_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    if done.returncode:
        sys.exit(done.stderr)
    print(".", end="", file=sys.stderr, flush=True)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    """Measure and print both tables."""
    parser = new_parser(__doc__)
    parser.add_argument(
        "--workloads", type=choice(WORKLOADS), default=list(WORKLOADS), help="W1,W2,W3,W4"
    )
    parser.add_argument(
        "--bits", type=numbers(int), default=[SIMD_BITS], help="vector widths; 512,256,128"
    )
    parser.add_argument(
        "--truncations",
        type=choice(TRUNCATIONS),
        default=list(TRUNCATIONS),
        help="of mixed precision; double has the first of them",
    )
    parser.add_argument("--job", help=SUPPRESS)
    asked = read_options(parser, workloads=["W2"], truncations=["shift"])
    if asked.job:
        print(json.dumps(measure(json.loads(asked.job))))
        return
    cases = [("mixed", truncation) for truncation in asked.truncations]
    cases.append(("double", asked.truncations[0]))
    for workload in asked.workloads:
        start_folder(workload)
    found = [
        run_job(workload, *case, bits)
        for bits in asked.bits
        for workload in asked.workloads
        for case in cases
    ]
    print(
        "\n| | kernel | precision | truncation | lanes | ns a useful pair | ns a lane | useful lanes |\n"
        + "|---" * 8
        + "|"
    )
    for one in found:
        for pair in one["pairs"]:
            print(
                f"| {one['workload']} | {pair['kernel']} | {one['precision']} | {one['truncation']} | {one['lanes']} "
                f"| {pair['per_pair']:.2f} | {pair['per_lane']:.2f} | {100 * pair['useful']:.0f} % |"
            )
    for one in found:
        print(
            f"\n{one['workload']}, {one['precision']}, {one['truncation']}, {one['lanes']} lanes: "
            f"{one['step']:.2f} ms a step\n\n| part | ms of a step |\n|---|---|"
        )
        for text, spent in one["times"]:
            print(f"| {text} | {spent:.3f} |")


if __name__ == "__main__":
    main()
