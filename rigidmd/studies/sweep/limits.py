"""Averages of a sweep over a time step, extrapolated to a step of 0: extrapolation.csv, .png and
.html."""

import csv
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rigidmd.analysis.files import read_table
from rigidmd.core.statistics import format_signed
from rigidmd.engines.samples import COLUMNS
from rigidmd.errors import SceneError
from rigidmd.figures.style import INK, curve_style, open_axis, panel_grid, write_figure
from rigidmd.io.folder import SCENE, add_to_folder
from rigidmd.io.write import Column, Table, nine_digits, with_error
from rigidmd.scene import MolecularScene, Scene
from rigidmd.studies.extrapolation import BiasFit, MeanAtStep, Together, extrapolate, means_of_runs
from rigidmd.studies.sweep.folder import Manifest, combination_folder, describe_values, short_keys
from rigidmd.studies.sweep.plan import update_state
from rigidmd.studies.sweep.table import DRIFT, MAIN, SHORT, Measured, key_columns, table_of
from rigidmd.view.page import code, items, page, plain, section, table, wide, write_page

OPTION = "--extrapolate"
FILES = ("extrapolation.csv", "extrapolation.png", "extrapolation.html")
MOST_PANELS, ACROSS = 12, 3


class Limit(NamedTuple):
    """A quantity at a step of 0, for a combination of values of the keys other than the step and
    the seed."""

    values: dict[str, Any]
    method: str  # integrator
    quantity: str  # with its unit
    points: list[MeanAtStep]
    fit: BiasFit

    def bias(self, step: float) -> tuple[float, float] | None:
        """Mean at a step less limit, with its error; None without a mean there."""
        point = next((point for point in self.points if point.timestep == step), None)
        return None if point is None else self.fit.bias(point)


class Limits(NamedTuple):
    name: str  # of the scene
    key: str
    limits: list[Limit]
    missing: list[str]  # sentences on what has no limit

    @property
    def steps(self) -> list[float]:
        return sorted({point.timestep for limit in self.limits for point in limit.points})

    @property
    def title(self) -> str:
        raised = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
        powers = dict.fromkeys(
            f"dt{str(limit.fit.order).translate(raised)} ({limit.method})" for limit in self.limits
        )
        return f"averages at a step of 0, from errors of order {', '.join(powers)} in {self.key}"

    def columns(self) -> list[Column]:
        """The values of the other keys."""
        return key_columns(self.limits[0].values) if self.limits else []

    def as_text(self) -> Table:
        """For readers: limits, chi² over its degrees of freedom, the longest step of the fit, and
        biases."""
        short = short_keys(self.limits[0].values) if self.limits else {}
        found = [column._replace(header=short[column.header]) for column in self.columns()]
        found += [
            Column("average", lambda limit: SHORT.get(limit.quantity, limit.quantity)),
            Column("limit", lambda limit: limit.fit.describe_limit()),
            Column(
                "chi²/dof",
                lambda limit: (
                    f"{limit.fit.chi2:.2g}/{limit.fit.freedom}" if limit.fit.freedom else None
                ),
            ),
            Column("to (fs)", lambda limit: f"{limit.fit.longest:g}"),
        ]
        for step in self.steps:

            def bias(limit, step=step):
                return (at := limit.bias(step)) and format_signed(*at)

            found.append(Column(f"bias at {step:g} fs", bias))
        return Table(found, self.limits)

    def as_columns(self) -> Table:
        """The table of extrapolation.csv."""

        def digits(pair):
            return pair and list(map(nine_digits, pair))

        found = [*self.columns(), Column("average", lambda limit: limit.quantity)]
        found += [
            Column("integrator", lambda limit: limit.method),
            Column("order", lambda limit: limit.fit.order),
        ]
        found += with_error(
            "limit", lambda limit: digits((limit.fit.limit, limit.fit.limit_error)), "limit error"
        )
        found += [
            Column(
                "chi2", lambda limit: nine_digits(limit.fit.chi2) if limit.fit.freedom else None
            ),
            Column("degrees of freedom", lambda limit: limit.fit.freedom),
            Column("longest step in fit (fs)", lambda limit: limit.fit.longest),
        ]
        for step in self.steps:
            name = f"bias at {step:g} fs"
            found += with_error(
                name, lambda limit, step=step: digits(limit.bias(step)), f"{name} error"
            )
        return Table(found, self.limits)


def step_key(manifest: Manifest, key: str, scene: Scene) -> tuple[str, int]:
    """The swept key that sets a time step, and the index of its stage. Raises SceneError.

    key : that key, or one that varies together with it; scene : of one of the points
    """
    first = next((first for first, together in manifest.keys.items() if key in together), None)
    parts = key.split(".")
    stages = scene.stages if isinstance(scene, MolecularScene) else ()
    named = [
        k for k, stage in enumerate(stages) if len(parts) == 3 and parts[1] in (str(k), stage.label)
    ]
    last = max((k for k, stage in enumerate(stages) if not stage.is_minimisation), default=None)
    problem = ""
    if first is None:
        problem = (
            "is not varied; this sweep varies"
            f" {', '.join(k for keys in manifest.keys.values() for k in keys)}"
        )
    elif parts[0] != "stages" or parts[-1] != "timestep_fs" or not named:
        problem = "is not the time step of a stage of molecules"
    elif last not in named:
        problem = (
            "is not the step of the stage whose averages are taken, the last one,"
            f" {stages[last or 0].label}"
        )
    if problem or first is None:
        advice = (
            f"--set stages.{last or 0}.timestep_fs=1,2,4 {OPTION} stages.{last or 0}.timestep_fs"
        )
        raise SceneError(OPTION, [f"{key} {problem}; give it a key such as {advice}"])
    return first, named[-1]


@dataclass
class _Group:
    """Averages of the combinations that differ in the step alone."""

    values: dict[str, Any]  # of the other keys
    integrator: str
    order: int
    #: Average -> step (fs) -> its value and error of each run.
    runs: dict[str, dict[float, list[Measured]]] = field(default_factory=dict)
    #: Average -> step -> its value of the runs together.
    together: dict[str, dict[float, Together]] = field(default_factory=dict)

    def names(self) -> list[str]:
        return list(dict.fromkeys([*self.runs, *self.together]))

    def steps(self, name: str) -> set[float]:
        """The steps at which an average has a value."""
        return self.runs.get(name, {}).keys() | self.together.get(name, {}).keys()

    def is_constant(self, name: str) -> bool:
        values = {value for found in self.runs.get(name, {}).values() for value, _ in found}
        return len(values | {found.value for found in self.together.get(name, {}).values()}) == 1

    def means(self, name: str) -> list[MeanAtStep]:
        return means_of_runs(self.runs.get(name, {}), self.together.get(name, {}))


def extrapolate_sweep(folder: Path, manifest: Manifest, key: str) -> Limits:
    """Extrapolate all averages of the logs of a sweep, and the values of analyses, to a step of 0.

    Values of analyses are those of replicas together, where they have been analysed together, else
    of single runs. Raises SceneError if the key is not a swept time step, OutputError.
    """
    for point in manifest.points:
        update_state(folder, point)
    limits, missing = [], []
    for title, group in _groups(folder, manifest, key).items():
        for column in group.names():
            if column == DRIFT or group.is_constant(column):
                continue
            name = f"{title}: {column}" if title else column
            if len(group.steps(column)) < 2:
                missing.append(f"{name}: has values at one step only")
            elif points := group.means(column):
                fit = extrapolate(points, order=group.order)
                limits.append(Limit(group.values, group.integrator, column, points, fit))
            else:
                missing.append(f"{name}: the runs are too short and too few for an error")
    return Limits(manifest.name, key, limits, missing)


def _groups(folder: Path, manifest: Manifest, key: str) -> dict[str, _Group]:
    """The averages of a sweep by a description of the values of the keys other than the step and
    the seed."""
    short, groups = short_keys(manifest.keys), {}
    for row, (_, points) in zip(
        table_of(folder, manifest, True).rows, manifest.combinations(), strict=True
    ):
        if not row.runs:
            continue
        point = next(point for point in points if point.state == "finished")
        scene = Scene.read(folder / point.folder / SCENE)
        first, k = step_key(manifest, key, scene)
        stage = scene.stages[k]  # pyright: ignore[reportAttributeAccessIssue]  (it has stages)
        others = {name: value for name, value in row.values.items() if name != first}
        group = _Group(others, stage.integrator, stage.scheme.order)
        group = groups.setdefault(describe_values(others, short), group)
        step = float(row.values[first])
        for column in dict.fromkeys(column for run in row.runs.values() for column in run):
            found = [run[column] for run in row.runs.values() if column in run]
            group.runs.setdefault(column, {})[step] = found
        if len(points) > 1:
            where = combination_folder(folder, row.values, short)
            for column, value in _values_together(where).items():
                group.together.setdefault(column, {})[step] = value
    return groups


def _values_together(folder: Path) -> dict[str, Together]:
    """The values of analyses of several runs together that have an error, by their headers. Raises
    OutputError."""
    return {
        value.header: Together(value.value, value.error, entry.frames_used.runs)
        for entry in read_table(folder).values()
        for value in entry.values
        if entry.frames_used.runs > 1 and value.value is not None and value.error is not None
    }


def write_limits(folder: Path, found: Limits, command: str) -> list[str]:
    """Write table, figure and page of limits; the names of the files. Raises OutputError."""
    if not found.limits:
        return []
    add_to_folder(folder, FILES)
    found.as_columns().write(folder / FILES[0], csv.QUOTE_NONNUMERIC)
    write_figure(folder / FILES[1], lambda: _figure(found), f"{found.name}: {found.title}")
    write_page(folder / FILES[2], lambda: _page(found, command))
    return [name for name in FILES if (folder / name).is_file()]


def _page(found: Limits, command: str) -> str:
    note = "mean = limit + slope · dt^order, up to the longest step that chi² allows (column `to`)"
    drawn = "means over the time step, and their limits"
    return page(
        f"{found.name}: averages at a step of 0",
        [
            f'<p class="faint">{plain(found.title)}</p>',
            section(
                "Limits and biases", table(*found.as_text().shown()), items([note, *found.missing])
            ),
            section("Means against the time step", wide(_figure(found), "extrapolation", drawn)),
            section("How to repeat it", code(command)),
        ],
    )


def _figure(found: Limits):
    """A panel for each of the main averages: means with error bars, the fit, and the limit with its
    error at 0."""
    of_log = {column.header for column in COLUMNS.values()}

    def rank(name):
        return MAIN.index(name) if name in MAIN else len(MAIN) + (name in of_log)

    shown = sorted(dict.fromkeys(limit.quantity for limit in found.limits), key=rank)[:MOST_PANELS]
    figure, axes = panel_grid(len(shown), ACROSS, 3.7, 2.8, 0.5)
    short = short_keys(found.limits[0].values)
    labels = list(dict.fromkeys(describe_values(limit.values, short) for limit in found.limits))
    handles = {}
    for axis, name in zip(axes, shown, strict=True):
        for limit in (limit for limit in found.limits if limit.quantity == name):
            label, fit = describe_values(limit.values, short), limit.fit
            style = curve_style(labels.index(label)) | {
                "ls": "none",
                "ms": 4,
                "capsize": 2.5,
                "elinewidth": 0.9,
            }
            steps, means, errors = zip(*(point[1:] for point in limit.points), strict=True)
            handles[label] = axis.errorbar(steps, means, errors, **style)
            axis.errorbar([0], [fit.limit], [fit.limit_error], mfc="none", clip_on=False, **style)
            at = np.linspace(0, fit.longest, 60)
            slope = fit.slopes[""][0] if fit.slopes else 0.0
            axis.plot(at, fit.limit + slope * at**fit.order, color=style["color"], lw=0.9)
        axis.set_title(SHORT.get(name, name), loc="left", fontsize=9, color=INK)
        axis.set_xlim(left=0)
        axis.ticklabel_format(axis="y", useOffset=False)
        open_axis(axis, labelsize=8)
    for axis in axes[-ACROSS:]:
        axis.set_xlabel("time step, fs", fontsize=9, color=INK)
    if len(labels) > 1:
        figure.legend(
            handles.values(),
            handles.keys(),
            frameon=False,
            fontsize=8,
            loc="outside lower left",
            ncols=3,
            labelcolor=INK,
        )
    return figure
