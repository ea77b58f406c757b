"""The engine LAMMPS: runs on it, and files for it."""
