"""Sweeps: a scene at many points, a folder each, with one table at the end."""
