"""Ewald sums: k-space sums, smooth particle mesh Ewald (PME), corrections, estimated errors."""
