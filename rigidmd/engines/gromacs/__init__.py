"""Files for GROMACS."""
