"""The error of the energy on the step, for six waters with forces of GFN2-xTB: rigid in rigidmd,
flexible in ASE.

    pip install tblite
    python tests/benchmarks/calculators.py

Both start from a minimum of their energy with momenta at 200 K, and take steps of velocity Verlet
for 2 ps. The error is the standard deviation of the energy, divided by kT and the number of degrees
of freedom (36 and 54). FOLDER of --to gets calculator_steps.png. The smallest form has
Lennard-Jones forces in place of GFN2-xTB if tblite is not installed.
"""

import importlib.util
import sys
from pathlib import Path

import numpy as np
from ase import Atoms, units
from ase.build import molecule
from ase.calculators.calculator import Calculator
from ase.calculators.lj import LennardJones
from ase.md.velocitydistribution import thermalize_momenta
from ase.md.verlet import VelocityVerlet
from ase.optimize import LBFGS
from command_line import SMOKE, new_parser, read_options

sys.path.insert(0, str(Path(__file__).parents[1]))
from rigidmd import Simulation, scene_from_atoms
from rigidmd.features.calculators.calculator import CalculatorForce
from rigidmd.features.view.figures.style import (
    INK,
    TEXT,
    TITLE,
    curve_style,
    new_figure,
    open_axis,
    save_files,
)
from rigidmd.units import BOLTZMANN, KJ_PER_MOL

TEMPERATURE, DURATION, INTERVAL = 200.0, 0.024 if SMOKE else 2.0, 0.012  # K, ps, ps
THERMAL = BOLTZMANN * TEMPERATURE / KJ_PER_MOL  # kJ/mol
RIGID, FLEXIBLE = (1.0, 2.0, 3.0, 4.0, 6.0), (0.25, 0.5, 1.0, 2.0)  # fs
HAS_TBLITE = importlib.util.find_spec("tblite") is not None


def calculator() -> Calculator:
    if not HAS_TBLITE:
        return LennardJones(sigma=2.6, epsilon=0.01, rc=8.0)
    from tblite.ase import TBLite

    return TBLite(method="GFN2-xTB", verbosity=0, accuracy=0.05)


def rigid(atoms: Atoms, stage: dict):
    """Results of one stage."""
    scene = scene_from_atoms(
        atoms,
        ["tip3p"],
        forces={"lennard_jones": False, "electrostatics": "none"},
        seed=2,
        stages=[stage],
        start={"temperature_K": TEMPERATURE},
        output={"trajectory": False, "log_interval_ps": INTERVAL},
    )
    return Simulation(scene, forces=[CalculatorForce(calculator(), energy_noise_eV=1e-6)]).run(
        progress=False
    )


def flexible(start: Atoms, step: float) -> np.ndarray:
    """Energies, kJ/mol."""
    atoms, energies = start.copy(), []
    atoms.calc = calculator()
    thermalize_momenta(atoms, TEMPERATURE, rng=np.random.default_rng(3))
    dynamics = VelocityVerlet(atoms, step * units.fs)
    interval = round(1000 * INTERVAL / step)
    dynamics.attach(lambda: energies.append(atoms.get_total_energy()), interval=interval)
    dynamics.run(round(DURATION / INTERVAL) * interval)
    return np.array(energies) / (units.kJ / units.mol)


def main() -> None:
    options = read_options(new_parser(__doc__), Path("runs/calculators"))
    if not HAS_TBLITE:
        print("tblite is not installed: pip install tblite")
        if not SMOKE:
            sys.exit(1)
    cell = molecule("H2O", cell=[3.0, 3.0, 3.0]).repeat((3, 2, 1))
    cell.set_cell(None)
    start = rigid(
        cell, {"ensemble": "minimise", "force_limit_kJ_mol_A": 2.0, "torque_limit_kJ_mol": 2.0}
    ).atoms()
    curves = {"rigid, rigidmd": [], "flexible, ASE": []}
    for step in RIGID:
        results = rigid(start, {"duration_ps": DURATION, "timestep_fs": step})
        calls, seconds = next(iter(results.summary["forces_by_python"].values()))
        curves["rigid, rigidmd"].append((step, results["drift"].std() / (36 * THERMAL)))
        print(
            f"rigid    {step:5g} fs: {curves['rigid, rigidmd'][-1][1]:.2e}   {1000 * seconds / calls:.1f} ms a call"
        )
    relaxed = start.copy()
    relaxed.calc = calculator()
    LBFGS(relaxed, logfile=None).run(fmax=0.02, steps=300)
    for step in FLEXIBLE:
        curves["flexible, ASE"].append((step, flexible(relaxed, step).std() / (54 * THERMAL)))
        print(f"flexible {step:5g} fs: {curves['flexible, ASE'][-1][1]:.2e}")
    draw(curves, options.to)


def draw(curves: dict[str, list], images: Path) -> None:
    """The error against the step."""
    figure = new_figure(5.2, 3.2)
    axis = figure.subplots()
    for k, (name, points) in enumerate(curves.items()):
        axis.loglog(*np.array(points).T, ms=4, lw=1.2, label=name, **curve_style(k))
    axis.set_xlabel("time step (fs)", fontsize=TITLE, color=INK)
    label = "rms energy error\n(kT per degree of freedom)"
    axis.set_ylabel(label, fontsize=TITLE, color=INK)
    steps = sorted({*RIGID, *FLEXIBLE})
    axis.set_xticks(steps, [f"{step:g}" for step in steps])
    axis.minorticks_off()
    axis.legend(frameon=False, labelcolor=INK, fontsize=TEXT)
    open_axis(axis, labelsize=TEXT)
    save_files(figure, images / "calculator_steps", ["png"])


if __name__ == "__main__":
    main()
