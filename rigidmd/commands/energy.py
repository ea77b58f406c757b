"""`rigidmd energy`."""

import json
from typing import Any

from rigidmd.commands.arguments import SCENE, Options, argument, command, read_scene


@command(
    60, "energies and forces of the start", "rigidmd energy water_dimer.toml --json", *SCENE,
    argument("--unit", choices=["kJ/mol", "kcal/mol", "eV", "K"], help="unit of energy (kJ/mol; J for a body)"),
    argument("--json", action="store_true", help="print JSON"),
    argument("--accuracy", action="store_true",
        help="also measure the error of the Coulomb forces (Ewald sums and PME)"),
)  # fmt: skip
def _energy(options: Options) -> int:
    from rigidmd.run import Simulation
    from rigidmd.scene import BodyScene
    from rigidmd.units import ENERGY_UNITS

    scene = read_scene(options)
    if isinstance(scene, BodyScene):
        return _body_energy(scene, options)
    unit = options.unit or "kJ/mol"
    found = Simulation(scene).start_energy(ENERGY_UNITS[unit], unit, options.accuracy)
    if options.json:
        print(json.dumps(found, indent=2))
        return 0
    removal = f", after {found['relief_steps']} steps of overlap removal" if found["relief_steps"] else ""
    print(f"{scene.name}: energies of the start, {found['molecules']} molecules{removal}")
    for note in found["notes"]:
        print(f"  {note}")
    for name, value in [*found["components"].items(), ("potential", found["potential"])]:
        _print_value(name.replace("_", " "), value, unit)
    _print_value("kinetic", found["kinetic"], unit)
    _print_value("virial", found["virial"], unit)
    if found["pressure_bar"] is not None:
        _print_value("pressure", found["pressure_bar"], "bar")
    molecule = found["largest_force_molecule"]
    _print_value("largest force", found["largest_force_per_A"], f"{unit}/Å on molecule {molecule}")
    for name, text in found["meaning"].items():
        print(f"  {name.replace('_', ' ')}: {text}")
    if options.accuracy:
        _print_accuracy(found["accuracy"], unit)
    return 0


def _print_value(name: str, value: float, unit: str, form: str = ">22.10g") -> None:
    print(f"  {name:<22}{value:{form}} {unit}")


def _print_accuracy(error: dict[str, Any], unit: str) -> None:
    print(f"Coulomb forces on sites, compared with {error['reference']}")
    relative = f"{error['relative']:.2g} of it, {error['in_e2_per_A2']:.2g} e²/Å²"
    _print_value("rms force", error["rms_force_per_A"], f"{unit}/Å", ">22.4g")
    _print_value("rms error", error["rms_error_per_A"], f"{unit}/Å: {relative}", ">22.4g")
    _print_value("estimated", error["estimated_per_A"], f"{unit}/Å", ">22.4g")
    _print_value("largest error", error["largest_error_per_A"], f"{unit}/Å", ">22.4g")
    _print_value("error of the energy", error["energy_error"], unit, ">22.4g")


def _body_energy(scene, options: Options) -> int:
    from rigidmd.errors import SceneError
    from rigidmd.run import Simulation

    if options.accuracy:
        raise SceneError(scene.source, ["--accuracy needs molecules with Ewald sums"])
    if options.unit is not None:
        raise SceneError(scene.source, [f"--unit {options.unit} is for molecules; the energy of a body is in J"])
    found = Simulation(scene).start_energy()
    if options.json:
        print(json.dumps(found, indent=2))
        return 0
    print(f"{scene.name}: energy of the start")
    for name in ("kinetic", "potential", "energy"):
        _print_value(name, found[name], "J", ">22.15g")
    for key, name, unit in (("force_N", "force (lab)", "N"), ("torque_body_N_m", "torque (body)", "N m")):
        if found[key] is not None:
            print(f"  {name:<22}{' '.join(f'{x:>22.15g}' for x in found[key])} {unit}")
    return 0
