"""The display of the table of a sweep in a notebook: means, errors and failed points."""

from rigidmd.core.display import html as html_of
from rigidmd.studies.sweep.table import Table, main_columns
from rigidmd.view.notebook import framed
from rigidmd.view.page import notes, table


@html_of.register
def sweep_html(found: Table) -> str:
    titles, rows = main_columns(found).shown()
    about = f"a sweep over {', '.join(found.keys) or 'no keys'}, in {found.folder}"
    failed = [f"{point}: {why}" for point, why in found.failed.items()]
    return framed("sweep", about, table(titles, rows) + notes(failed))
