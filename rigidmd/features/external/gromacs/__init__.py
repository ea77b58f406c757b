"""The export of files for GROMACS."""
