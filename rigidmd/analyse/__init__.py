"""Analyses of runs of molecules: values with errors, curves, figures."""
