"""Pilot runs: short runs from the start of a stage, by which `integrator = "auto"` chooses
integrator and time step."""
