"""Studies that consist of many runs: precision, stability."""
