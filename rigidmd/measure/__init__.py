"""Measurements on states: observables, drift, limits. Nothing here changes a state."""
