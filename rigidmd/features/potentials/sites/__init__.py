"""Pair potentials between sites: formulas, tables and functions."""
