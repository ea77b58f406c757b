"""`rigidmd energy`."""

import json

from rigidmd.commands.arguments import SCENE, Options, argument, command, flag, read_scene
from rigidmd.core.toml import Json


@command(
    60,
    "energies and forces of the start",
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
    from rigidmd.errors import SceneError
    from rigidmd.run import Simulation
    from rigidmd.scene import BodyScene
    from rigidmd.units import ENERGY_UNITS

    scene = read_scene(options)
    if isinstance(scene, BodyScene):
        if options.accuracy:
            raise SceneError(scene.source, ["--accuracy needs molecules with Ewald sums"])
        if options.unit is not None:
            raise SceneError(
                scene.source,
                [f"--unit {options.unit} is for molecules. The energy of a body is in J"],
            )
        energies = Simulation(scene)._start_energy()
        unit = "J"
    else:
        unit = options.unit or "kJ/mol"
        energies = Simulation(scene)._start_energy(
            ENERGY_UNITS[unit], unit, measure_accuracy=options.accuracy
        )
    if options.json:
        print(json.dumps(energies, indent=2))
    elif isinstance(scene, BodyScene):
        _print_body(scene.name, energies)
    else:
        _print_molecules(scene.name, energies, unit)
    return 0


def _print_molecules(name: str, energies: Json, unit: str) -> None:
    steps = energies["overlap_removal_steps"]
    removal = f", after {steps} steps of overlap removal" if steps else ""
    print(f"{name}: energies of the start, {energies['molecules']} molecules{removal}")
    for note in energies["notes"]:
        print(f"  {note}")
    rows = [(term.replace("_", " "), value, unit) for term, value in energies["components"].items()]
    rows += [(key, energies[key], unit) for key in ("potential", "kinetic", "virial")]
    if (lattice_energy := energies["lattice_energy_per_molecule"]) is None:
        rows += [("per molecule", energies["potential_per_molecule"], f"{unit}, potential")]
    else:
        rows += [("lattice energy", lattice_energy, f"{unit} per molecule")]
    rows += (
        [] if energies["pressure_bar"] is None else [("pressure", energies["pressure_bar"], "bar")]
    )
    where = f"{unit}/Å on molecule {energies['largest_force_molecule']}"
    _print_rows([*rows, ("largest force", energies["largest_force_per_A"], where)], ">22.10g")
    for key, text in energies["meaning"].items():
        print(f"  {key.replace('_', ' ')}: {text}")
    if error := energies.get("accuracy"):
        print(f"Coulomb forces on sites, compared with {error['reference']}")
        relative = "" if error["relative"] is None else f"{error['relative']:.2g} of it, "
        relative += f"{error['in_e2_per_A2']:.2g} e²/Å²"
        rows = [
            ("rms force", error["rms_force_per_A"], f"{unit}/Å"),
            ("rms error", error["rms_error_per_A"], f"{unit}/Å: {relative}"),
            ("estimated", error["estimated_per_A"], f"{unit}/Å"),
            ("largest error", error["largest_error_per_A"], f"{unit}/Å"),
        ]
        _print_rows([*rows, ("error of the energy", error["energy_error"], unit)], ">22.4g")


def _print_body(name: str, energies: Json) -> None:
    print(f"{name}: energy of the start")
    _print_rows(
        [(key, energies[key], "J") for key in ("kinetic", "potential", "energy")], ">22.15g"
    )
    for key, what, unit in (
        ("force_N", "force (lab)", "N"),
        ("torque_body_N_m", "torque (body)", "N m"),
    ):
        if energies[key] is not None:
            print(f"  {what:<22}{' '.join(f'{x:>22.15g}' for x in energies[key])} {unit}")


def _print_rows(rows: list[tuple[str, float, str]], form: str) -> None:
    for name, value, unit in rows:
        print(f"  {name:<22}{value:{form}} {unit}")
