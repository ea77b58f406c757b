"""Analyses of runs of molecules, each with its error."""
