"""What runs many runs: precision, stability."""
