"""The engine that moves a single body by a general ODE solver, an independent check of the
integrators."""
