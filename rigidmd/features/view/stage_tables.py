"""The tables of the stages of a run of molecules, for its page."""

import html
from collections.abc import Iterator

import numpy as np

from rigidmd.features.view.page import table
from rigidmd.run.record import Record
from rigidmd.run.report import stage_rows, stage_title
from rigidmd.run.summary import stage_summary


def stage_tables(record: Record) -> Iterator[str]:
    """Means and drifts of the stages, as the summary has them, from log.csv, which a run that has
    not ended has too."""
    system = record.system
    samples = record.log
    known = (record.summary or {}).get("stages", ())
    for row, k in enumerate(np.unique(samples["stage"]).tolist()):
        if not system.scene.stages[k].is_minimisation:
            ended = known[row] if row < len(known) else {}
            moves = ended.get("moves_tried", 0), ended.get("moves_accepted", 0)
            stage = stage_summary(system, samples, k, ended.get("computing_s", 0.0), moves)
            yield f"<p>{html.escape(stage_title(stage))}</p>"
            stage["choice"] = ended.get("choice")
            yield table([], stage_rows(stage, system.quantities), words=True)
