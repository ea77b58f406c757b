"""The ten scenes of tests/support/scenes.py on rigidmd and another engine, a line each: for
docs/evidence/validation.md.

    python tests/benchmarks/engines.py lammps openmm
"""

import sys
from pathlib import Path

from command_line import new_parser, read_options

sys.path.insert(0, str(Path(__file__).parents[1]))

from support.common import small_scene
from support.scenes import SCENES

from rigidmd.errors import RigidMDError
from rigidmd.features.external.verify import verify


def print_table(engine: str) -> None:
    """A line for each scene, or why there is none."""
    print(
        f"| scene | potential here, kJ/mol | {engine} | difference | rms difference of forces, kJ/(mol Å) | of virials | of positions, Å |"
    )
    print("|---|---|---|---|---|---|---|")
    platform = {"platform": "Reference"} if engine == "openmm" else {}
    for name, (counts, sections) in SCENES.items():
        scene = small_scene(counts, 15.0, **sections, engine={"name": engine} | platform)
        try:
            found = verify(scene)
        except RigidMDError as error:
            print(f"| {name} | {error} |")
            continue
        lines = {line.name: line for line in (*found.start, *found.run)}
        whole, force = lines["potential energy"], lines["rms force on a molecule"]
        virial = f"{lines['virial'].difference:.1e}" if "virial" in lines else ""
        print(
            f"| {name} | {whole.here:.6f} | {whole.there:.6f} | {whole.difference:.1e} | {force.difference:.1e} | "
            f"{virial} | {lines['largest move of a site'].difference:.1e}{'' if found.agrees else ' DIFFERS'} |",
            flush=True,
        )


def main() -> None:
    """Print the tables."""
    parser = new_parser(__doc__)
    parser.add_argument("engines", nargs="*", default=["lammps"], metavar="lammps|openmm")
    for engine in read_options(parser, engines=["lammps", "openmm"]).engines:
        print_table(engine)


if __name__ == "__main__":
    main()
