"""What every package may import, and compiles nothing: the state, status codes, integrators, file helpers."""
