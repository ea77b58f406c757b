"""What pages, figures, animations and notebooks show of a body."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.core.quantities import Quantity
from rigidmd.core.toml import Json
from rigidmd.features.bodies.animation import BodyAnimation
from rigidmd.features.bodies.figures import body_figures, body_panels, timeline
from rigidmd.features.bodies.motion import COLUMNS, Motion
from rigidmd.features.bodies.summary import motion_figures, rows_of, title_of
from rigidmd.features.view.kind_display import KindDisplay
from rigidmd.features.view.page import section, table
from rigidmd.scene.validation import not_none

if TYPE_CHECKING:
    from rigidmd.features.bodies.system import BodySystem
    from rigidmd.features.view.figures.panels import TimedPanel, Timeline
    from rigidmd.features.view.figures.picture import Picture
    from rigidmd.run.record import Record
    from rigidmd.run.results import Results
    from rigidmd.run.simulation import Simulation


class BodyDisplay(KindDisplay["BodySystem", Motion]):
    title = "one rigid body"
    step_unit = "s"
    margins_note = ""

    def figures(self, system: "BodySystem", samples: Motion, summary: Json) -> "dict[str, Picture]":
        return body_figures(system, samples)

    def timeline(self, system: "BodySystem", columns: Mapping[str, np.ndarray]) -> "Timeline":
        return timeline(columns)

    def panels(
        self, system: "BodySystem", columns: Mapping[str, np.ndarray], summary: Json
    ) -> "list[TimedPanel]":
        times, families = timeline(columns), body_panels(system, columns)
        return [(times, panel) for family in families.values() for panel in family]

    def animation(self, record: "Record", most_frames: int | None = None) -> BodyAnimation:
        return BodyAnimation(record)

    def animation_in_memory(self, results: "Results", record: "Record") -> BodyAnimation:
        return self.animation(record)

    def tables(
        self, system: "BodySystem", summary: Json
    ) -> list[tuple[str, list[tuple[str, str]]]]:
        # not of a run that has not ended
        return [(title_of(summary), rows_of(summary))] if "steps" in summary else []

    def results_section(self, record: "Record") -> str:
        time = ("time", f"{record.time[-1]:g} s, {len(record.time)} samples")
        numbers = motion_figures(record.system, Motion(record.columns))
        return section("Results", table([], [time, *rows_of(numbers)], words=True))

    def stepped(self, record: "Record") -> Sequence[Json]:
        return [{"name": record.scene.name} | (record.summary or {})]

    def live_columns(self, described: Mapping[str, Quantity]) -> Sequence[str]:
        """The first of these that it has."""
        return [name for name in ("energy_error", "energy") if name in described][:1]

    def live_samples(self, run: "Simulation") -> tuple[Mapping[str, Quantity], float]:
        return COLUMNS, not_none(run.scene.output.interval_s)
