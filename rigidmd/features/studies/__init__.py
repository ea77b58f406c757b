"""Many runs: accuracy, stability, sweeps, comparisons of runs and engines."""
