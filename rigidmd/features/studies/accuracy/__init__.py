"""Error against run time of every integrator, and the error of averages."""
