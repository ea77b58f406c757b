"""Files that analyses write."""

SHORT = {
    "stages.minimisation": None,
    "stages.equilibration.duration_ps": 0.02,
    "stages.production.duration_ps": 0.2,
    "output.trajectory_interval_ps": 0.004,
    "output.trajectory": "trajectory.trr",
    "output.log_interval_ps": 0.004,
    "output.figures": False,
    "output.pressure_tensor_interval_ps": 0.004,
}
