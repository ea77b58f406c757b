"""Ewald sums: reciprocal sums, smooth particle mesh Ewald (PME), corrections, estimated errors."""
