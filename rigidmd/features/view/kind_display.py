"""What pages, figures, animations and notebooks show of a kind of scene."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar, Generic, TypeVar, cast

import numpy as np

from rigidmd.core.quantities import Quantity
from rigidmd.core.toml import Json
from rigidmd.engines.samples import SampleTable, moving
from rigidmd.engines.sites import AnySystem
from rigidmd.run.kind import kind_of
from rigidmd.scene import Scene

if TYPE_CHECKING:
    from rigidmd.engines.samples import Samples
    from rigidmd.engines.system import System
    from rigidmd.features.view.figures.panels import TimedPanel, Timeline
    from rigidmd.features.view.figures.picture import Picture
    from rigidmd.features.view.page import Animation
    from rigidmd.run.record import Record
    from rigidmd.run.results import Results
    from rigidmd.run.simulation import Simulation


SystemT = TypeVar("SystemT", bound=AnySystem)
SamplesT = TypeVar("SamplesT", bound=SampleTable)


class KindDisplay(ABC, Generic[SystemT, SamplesT]):
    """What is shown of a kind of scene.

    title : what the scene is, in notebooks
    step_unit : unit of its time steps
    margins_note : sentence on time steps and their longest stable ones
    """

    title: ClassVar[str]
    step_unit: ClassVar[str]
    margins_note: ClassVar[str] = ""

    @abstractmethod
    def figures(self, system: SystemT, samples: SamplesT, summary: Json) -> "dict[str, Picture]":
        """The figures of a run by the names of their files, if there are enough samples."""

    @abstractmethod
    def timeline(self, system: SystemT, columns: Mapping[str, np.ndarray]) -> "Timeline":
        """The times of samples."""

    @abstractmethod
    def panels(
        self, system: SystemT, columns: Mapping[str, np.ndarray], summary: Json
    ) -> "list[TimedPanel]":
        """The panels of a run that its columns allow. summary : empty of a run that has not
        ended"""

    @abstractmethod
    def animation(self, record: "Record", most_frames: int | None = None) -> "Animation":
        """The animation of a stored run. Raises OutputError.

        most_frames : default: as many as a page holds
        """

    @abstractmethod
    def animation_in_memory(self, results: "Results", record: "Record") -> "Animation":
        """The animation of results, for a notebook. Raises OutputError."""

    @abstractmethod
    def tables(self, system: SystemT, summary: Json) -> list[tuple[str, list[tuple[str, str]]]]:
        """Titles and rows of the tables of a summary."""

    @abstractmethod
    def results_section(self, record: "Record") -> str:
        """The section of a page with the results of a run."""

    @abstractmethod
    def stepped(self, record: "Record") -> Sequence[Json]:
        """The parts of a summary with a time step and its longest stable one."""

    @abstractmethod
    def live_columns(self, described: Mapping[str, Quantity]) -> Sequence[str]:
        """The default columns of a live plot."""

    @abstractmethod
    def live_samples(self, run: "Simulation") -> tuple[Mapping[str, Quantity], float]:
        """The columns that the samples of a run will have, and their interval."""


class MolecularDisplay(KindDisplay["System", "Samples"]):
    title = "rigid molecules"
    step_unit = "fs"
    margins_note = " Errors of averages grow long before: see `rigidmd accuracy --averages`."

    def figures(self, system: "System", samples: "Samples", summary: Json) -> "dict[str, Picture]":
        from rigidmd.features.view.figures.energy import energy_figure

        is_enough = moving(system.scene.stages, samples["stage"]).sum() > 1
        return {"energy": energy_figure(system, samples, summary)} if is_enough else {}

    def timeline(self, system: "System", columns: Mapping[str, np.ndarray]) -> "Timeline":
        from rigidmd.features.view.figures.panels import molecular_timeline

        return molecular_timeline(system, columns)

    def panels(
        self, system: "System", columns: Mapping[str, np.ndarray], summary: Json
    ) -> "list[TimedPanel]":
        from rigidmd.features.view.figures.panels import molecular_panels

        return molecular_panels(system, columns, summary.get("stages", ()))

    def animation(self, record: "Record", most_frames: int | None = None) -> "Animation":
        from rigidmd.features.view.molecule_animation import MoleculeAnimation

        return MoleculeAnimation(record, most_frames)

    def animation_in_memory(self, results: "Results", record: "Record") -> "Animation":
        from rigidmd.features.view.molecule_animation import (
            MoleculeAnimation,
            chemiscope_script,
            frames_in_memory,
        )

        chemiscope_script()
        frames = frames_in_memory(results, record.system, record)
        return MoleculeAnimation(record, frames=frames)

    def tables(self, system: "System", summary: Json) -> list[tuple[str, list[tuple[str, str]]]]:
        from rigidmd.run.report import stage_rows, stage_title

        described = system.quantities
        return [(stage_title(stage), stage_rows(stage, described)) for stage in summary["stages"]]

    def results_section(self, record: "Record") -> str:
        from rigidmd.features.view.page import section
        from rigidmd.features.view.stage_tables import stage_tables

        return section("Means of each stage", *stage_tables(record))

    def stepped(self, record: "Record") -> Sequence[Json]:
        return (record.summary or {}).get("stages", ())

    def live_columns(self, described: Mapping[str, Quantity]) -> Sequence[str]:
        return ("temperature", "drift")

    def live_samples(self, run: "Simulation") -> tuple[Mapping[str, Quantity], float]:
        return run._part.samples().described, run.scene.output.log_interval_ps


def display_of(scene: Scene) -> KindDisplay:
    return cast(KindDisplay, kind_of(scene).adds_to("view") or MolecularDisplay())


def panels(record: "Record") -> "list[TimedPanel]":
    """The panels of a run that its columns allow."""
    display = display_of(record.scene)
    return display.panels(record.system, record.columns, record.summary or {})


def timeline(system: AnySystem, columns: Mapping[str, np.ndarray]) -> "Timeline":
    """The times of samples."""
    return display_of(system.scene).timeline(system, columns)


def run_figures(system: AnySystem, samples: SampleTable, summary: Json) -> "dict[str, Picture]":
    """The figures of a run by the names of their files, if there are enough samples."""
    return display_of(system.scene).figures(system, samples, summary)
