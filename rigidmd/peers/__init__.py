"""The same scene on other engines: LAMMPS, OpenMM and GROMACS. Files for them, runs on them, and a check of both."""
