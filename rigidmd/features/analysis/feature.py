"""What this feature does for pages of runs."""

from collections.abc import Iterator

from rigidmd.feature import Feature
from rigidmd.run.record import Record


class Analyses(Feature):
    def page_parts(self, record: Record) -> Iterator[tuple[str, Iterator[str]]]:
        from rigidmd.features.analysis.display import page_part

        yield "Analyses", page_part(record)


FEATURE = Analyses()
