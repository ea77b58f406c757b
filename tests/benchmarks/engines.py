"""The ten scenes of tests/scenes.py on rigidmd and another engine, a line each: for
docs/evidence/validation.md.

python tests/benchmarks/engines.py [lammps|openmm]
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

from scenes import SCENES
from support import small_scene

from rigidmd.errors import RigidMDError
from rigidmd.studies.other_engines import verify


def main(engine: str) -> None:
    """Print the table."""
    print(
        f"| scene | potential here, kJ/mol | {engine} | apart | rms force apart, kJ/(mol Å) | virial apart | paths apart, Å |"
    )
    print("|---|---|---|---|---|---|---|")
    platform = {"platform": "Reference"} if engine == "openmm" else {}
    for name, (counts, sections) in SCENES.items():
        try:
            found = verify(
                small_scene(counts, 15.0, **sections, engine={"name": engine} | platform)
            )
        except RigidMDError as error:
            print(f"| {name} | {error} |")
            continue
        lines = {line.name: line for line in (*found.start, *found.run)}
        whole, force = lines["potential energy"], lines["rms force on a molecule"]
        virial = f"{lines['virial'].apart:.1e}" if "virial" in lines else ""
        print(
            f"| {name} | {whole.here:.6f} | {whole.there:.6f} | {whole.apart:.1e} | {force.apart:.1e} | "
            f"{virial} | {lines['largest move of a site'].apart:.1e}{'' if found.agrees else ' PARTS'} |",
            flush=True,
        )


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "lammps")
