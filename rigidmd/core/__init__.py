"""Used by every package, without compiled code: the state, status codes, integrators, statistics,
files, TOML."""
