"""Other engines: export to LAMMPS, OpenMM and GROMACS, comparison, and runs with them."""
