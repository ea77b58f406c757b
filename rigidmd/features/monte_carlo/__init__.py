"""Hybrid Monte Carlo: trajectories that are accepted or rejected."""
