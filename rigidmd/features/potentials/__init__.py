"""Potentials of users, between sites and between bodies: formula, table and Python function."""
