"""The engine OpenMM: runs on it, and files for it."""
