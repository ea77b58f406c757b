"""Pilot runs: they choose an integrator and a time step, and find the longest stable step."""
