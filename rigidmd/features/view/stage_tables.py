"""The tables of the stages of a run of molecules, for its page."""

import html
from collections.abc import Iterator

import numpy as np

from rigidmd.features.view.page import Raw, items, table
from rigidmd.run.record import Record
from rigidmd.run.report import SHOWN_STAGES, means_table, stage_notes, stage_title
from rigidmd.run.summary import stage_summary


def stage_tables(record: Record) -> Iterator[str]:
    """Means and drifts of the stages, as the summary has them, from log.csv, which a run that has
    not ended has too."""
    system = record.system
    samples = record.log
    known = (record.summary or {}).get("stages", ())
    stages = []
    for row, k in enumerate(np.unique(samples["stage"]).tolist()):
        if not system.scene.stages[k].is_minimisation:
            ended = known[row] if row < len(known) else {}
            moves = ended.get("moves_tried", 0), ended.get("moves_accepted", 0)
            stage = stage_summary(system, samples, k, ended.get("computing_s", 0.0), moves)
            stages.append(stage | {"choice": ended.get("choice")})
    shown = stages[-SHOWN_STAGES:]
    yield "".join(f"<p>{html.escape(stage_title(stage))}</p>" for stage in stages)
    if shown:
        header, *rows = means_table(shown, system.quantities)
        yield table(header[:-1], [_row(*row) for row in rows], words=True)
        yield items(note for stage in shown for note in stage_notes(stage))


def _row(title: str, *cells: str) -> list[str]:
    """A row of the table of the report: the unit is next to the title, and numbers stay with their
    errors."""
    *means, unit = cells
    of_unit = f'<span class="unit"> {html.escape(unit)}</span>' if unit else ""
    numbers = [mean.replace(" ± ", "\N{NO-BREAK SPACE}±\N{NO-BREAK SPACE}") for mean in means]
    return [
        Raw(html.escape(title) + of_unit),
        *(Raw(f'<span class="whole">{html.escape(number)}</span>') for number in numbers),
    ]
