"""The engine that runs compiled code on the cores of one machine, for molecules and for a single
body."""
