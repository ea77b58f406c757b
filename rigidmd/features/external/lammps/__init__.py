"""The engine that runs LAMMPS, and the export of files for LAMMPS."""
