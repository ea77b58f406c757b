"""Figures by Matplotlib of what a run has measured: shared styles, energies over time, the motion
of a single body."""
