"""Integration in time: the compiled loop over the flows of a scheme: kicks, drifts, thermostats,
barostats."""
