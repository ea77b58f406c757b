"""`rigidmd energy`."""

import json

from rigidmd.commands.arguments import SCENE, Options, argument, command, flag, read_scene
from rigidmd.commands.streams import shown_working


@command(
    "Study",
    20,
    "print energies and forces at the start",
    "rigidmd energy water_dimer.toml --json",
    *SCENE,
    argument(
        "--unit",
        choices=["kJ/mol", "kcal/mol", "eV", "K"],
        help="unit of energy (kJ/mol; J for a body)",
    ),
    flag("--json", help="print JSON"),
    flag("--accuracy", help="also measure the error of the Coulomb forces (Ewald sums and PME)"),
)
def _energy(options: Options) -> int:
    from rigidmd.run import Simulation
    from rigidmd.run.kind import kind_of
    from rigidmd.units import ENERGY_UNITS

    scene = read_scene(options)
    kind = kind_of(scene)
    if options.accuracy:
        kind.check_has(scene, "--accuracy")
    if options.unit is not None:
        kind.check_has(scene, "--unit", unit=options.unit)
    unit = options.unit or kind.energy_unit
    with shown_working("computing energies and forces"):
        energies = Simulation(scene)._start_energy(
            ENERGY_UNITS.get(unit, 1.0), unit, measure_accuracy=options.accuracy
        )
    if options.json:
        print(json.dumps(energies, indent=2))
    else:
        print(*kind.energy_lines(scene.name, energies, unit), sep="\n")
    return 0
