"""The display of the table of a sweep in a notebook: means, errors and failed points."""

from rigidmd.core.display import html as html_of
from rigidmd.features.studies.sweep.table import Table
from rigidmd.features.view.notebook import framed
from rigidmd.features.view.page import notes, table


@html_of.register
def sweep_html(sweep: Table) -> str:
    titles, rows = sweep.brief().shown()
    about = f"a sweep over {', '.join(sweep.keys) or 'no keys'}, in {sweep.folder}"
    failed = [f"{point}: {why}" for point, why in sweep.failed.items()]
    return framed("sweep", about, table(titles, rows) + notes(failed))
