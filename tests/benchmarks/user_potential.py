"""What a custom pair potential costs, compared with the built-in Lennard-Jones with the same
truncation, in turns.

    python tests/benchmarks/user_potential.py --molecules 4000 --rounds 9
"""

import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from command_line import SMOKE, new_parser, read_options

sys.path.insert(0, str(Path(__file__).parents[1]))
import rigidmd
from rigidmd.assemble.build import build
from rigidmd.assemble.build import integrator_of_stage as row

STEPS = 5 if SMOKE else 40


class Mie(NamedTuple):
    """Parameters of a pair of sites."""

    epsilon: float
    sigma: float


def mie(p: Mie, r, inverse):
    """Mie 12-6 as a function of the distance."""
    six = (p.sigma * inverse) ** 6
    u = 4 * p.epsilon * six
    return u * (six - 1), u * (12 * six - 6) * inverse


def potentials(epsilon: float, sigma: float) -> dict[str, rigidmd.PairPotential | None]:
    """Name -> potential; None is the built-in one."""
    given = {"epsilon": epsilon, "sigma": sigma}
    text = "4*epsilon*((sigma/r)**12 - (sigma/r)**6)"
    r = np.linspace(2.4, 9.5, 1000)
    power = (sigma / r) ** 6
    return {
        "built in": None,
        "text": rigidmd.pair_potential(text, {"AR": given}),
        "function": rigidmd.pair_potential(mie, {"AR": Mie(epsilon, sigma)}),
        "exp-6": rigidmd.pair_potential(
            "A*exp(-B*r) - C/r**6", {"AR": {"A": 1.5e6, "B": 3.7, "C": 6.2e3}}
        ),
        "table": rigidmd.pair_potential(table=(r, 4 * epsilon * (power * power - power))),
    }


def main() -> None:
    """Print the median of the ratios of each potential."""
    parser = new_parser(__doc__)
    parser.add_argument("--molecules", type=int, default=4000, help="4000")
    parser.add_argument("--rounds", type=int, default=9, help="9")
    options = read_options(parser, molecules=400, rounds=1)
    count, rounds = options.molecules, options.rounds
    print(
        f"{count} argon, cut-off 9 Å, steps of 4 fs; time of a step relative to the built-in potential"
    )
    for precision in ("mixed",) if SMOKE else ("double", "mixed"):
        for truncation in ("switch",) if SMOKE else ("plain", "switch"):
            scene = rigidmd.Scene.from_dict(
                {
                    "precision": precision,
                    "box": {"density_g_cm3": 1.374},
                    "molecules": [{"model": "argon", "count": count}],
                    "forces": {"truncation": truncation},
                    "start": {"temperature_K": 94},
                    "stages": [{"duration_ps": 1, "timestep_fs": 4}],
                }
            )
            molecule = build(scene).species[0]
            runs = {}
            for name, potential in potentials(
                float(molecule.epsilon[0]) / 100, float(molecule.sigma[0])
            ).items():
                of = (
                    scene
                    if potential is None
                    else scene.model_copy(
                        update={"forces": scene.forces.model_copy(update={"lennard_jones": False})}
                    ).with_user_code([potential])
                )
                system = build(of)
                engine = system.engine()
                state = engine.begin(system.state, row(system, 0))
                engine.advance(state, row(system, 0), 0.004, STEPS)
                runs[name] = (engine, state, row(system, 0), [])
            for turn in range(rounds):
                for engine, state, scheme, seconds in runs.values():
                    began = time.perf_counter()
                    engine.advance(state, scheme, 0.004, STEPS * (turn + 2))
                    seconds.append(time.perf_counter() - began)
            base = np.array(runs["built in"][3])
            ratios = {name: np.median(np.array(run[3]) / base) for name, run in runs.items()}
            print(
                f"  {precision:6} {truncation:6}",
                *(f"{name} {ratio:.2f}" for name, ratio in ratios.items()),
                sep="  ",
            )


if __name__ == "__main__":
    main()
