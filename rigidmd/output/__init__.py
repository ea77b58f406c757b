"""What a run writes, all in its own folder: trajectory (MDAnalysis here), log, state, summary, figure."""
