"""GROMACS for commands, which do not load its export."""

from rigidmd.core.programs import Program

PROGRAM = Program(
    "GROMACS",
    "GROMACS has its own package",
    "files:TRANSLATIONS",
    writer="files:write_gromacs",
    command="sh run.sh",
)
