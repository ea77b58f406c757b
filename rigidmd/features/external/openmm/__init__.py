"""The engine that runs OpenMM, and the export of files for OpenMM."""
