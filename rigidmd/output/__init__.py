"""Files of a run: trajectory (MDAnalysis is used only here), log, state, summary, figures, reports."""
