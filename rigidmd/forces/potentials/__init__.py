"""Pair potentials, one file each, and their truncation at the cutoff."""
