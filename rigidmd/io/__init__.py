"""Files that runs read and write: formats of structures and trajectories, the folder of a run, log,
checkpoint."""
