"""What every room may name without compiling anything: the state, status codes, integrators as rows."""
