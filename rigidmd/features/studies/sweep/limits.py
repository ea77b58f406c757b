"""Averages of a sweep over a time step, extrapolated to zero time step: extrapolation.csv, .png and
.html."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rigidmd.core.quantities import QUANTITIES
from rigidmd.core.statistics import format_signed
from rigidmd.core.toml import Json
from rigidmd.engines.system import System
from rigidmd.errors import RigidMDError, SceneError
from rigidmd.features.analysis.files import read_table
from rigidmd.features.studies.extrapolation import (
    BiasFit,
    MeanAtStep,
    Together,
    extrapolate,
    means_of_runs,
)
from rigidmd.features.studies.joint_fit import (
    GAS_CONSTANT,
    RunResults,
    fit_jointly,
    results_of_run,
)
from rigidmd.features.studies.sweep.figure import add_legend, panels
from rigidmd.features.studies.sweep.folder import (
    Manifest,
    describe_values,
    point_name,
    readable_key,
    short_keys,
)
from rigidmd.features.studies.sweep.table import (
    DENSITY,
    DRIFT,
    POTENTIAL,
    PRESSURE,
    Measured,
    key_cells,
    main_titles,
    measured_values,
    report_of,
    summarise_run,
)
from rigidmd.features.view.figures.style import INK, curve_style, write_figure
from rigidmd.features.view.page import code, items, plain, section, table, wide, write_page
from rigidmd.io.folder import add_to_folder
from rigidmd.io.write import Cell, ReportTable, nine_digits
from rigidmd.run.record import read_record
from rigidmd.scene import Scene, is_molecular
from rigidmd.scene.ensembles import THERMOSTATS
from rigidmd.scene.stage import Stage
from rigidmd.units import BAR, BOLTZMANN

if TYPE_CHECKING:
    from matplotlib.axes import Axes

OPTION = "--extrapolate"
FILES = ("extrapolation.csv", "extrapolation.png", "extrapolation.html")
MOST_PANELS = 12
RAISED = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
#: Kinds of limits: of each average by itself; of energy and volume together, with the slopes that
#: fluctuations predict; of responses, which fluctuations give.
INDEPENDENT, JOINT, FLUCTUATIONS = "independent", "joint", "fluctuations"
TOO_SHORT = "the runs are too short and too few for an error"
#: Relative rounding error of a mean of equal numbers.
ROUNDING = 1e-12
TEMPERATURES = [
    QUANTITIES[f"temperature{motion}"].header for motion in ("", "_translation", "_rotation")
]
OF_THERMOSTATS = [row for method in THERMOSTATS.values() for row in method.quantities]
OF_LOG = {POTENTIAL, *(row.header for row in (*QUANTITIES.values(), *OF_THERMOSTATS))}
#: Keys of a stage that change no average at a step of 0.
OF_METHODS = ("integrator", "thermostat")
#: The step at which a bias reaches this fraction of the scale of its quantity is reported.
BIAS_LIMIT = 0.01
#: A slope of at most this many standard errors counts as not seen.
UNSEEN = 2.0


class Limit(NamedTuple):
    """A quantity at zero time step, for a combination of values of the keys other than the step and
    the seed. Averages of the log by several methods have one fit.

    scale : of which `BIAS_LIMIT` is reached at a step. None: no step is reported
    """

    values: Json
    integrator: str
    quantity: str  # with its unit
    points: list[MeanAtStep]
    fit: BiasFit
    kind: str = INDEPENDENT
    scale: float | None = None

    @property
    def method(self) -> str:
        return self.points[0].method

    @property
    def order(self) -> int:
        return self.points[0].order

    def bias(self, step: float) -> tuple[float, float] | None:
        """Mean at a step less limit, with its error. That of a joint fit by its slope. None without
        a mean there."""
        if self.kind == JOINT:
            slope, error = self.fit.slopes[""]
            return slope * step**2, error * step**2
        return next((self.fit.bias(at) for at in self.points if at.timestep == step), None)

    @property
    def step_at_limit(self) -> str | None:
        """The step (fs) at which the bias reaches `BIAS_LIMIT`. A bias whose slope is not seen is
        smaller up to the step after ">"."""
        slope, error = self.fit.slopes.get(self.method, (0.0, 0.0))
        seen = abs(slope) > UNSEEN * error
        steepest = abs(slope) + (0.0 if seen else UNSEEN * error)
        if not self.scale or steepest == 0:
            return None
        return (
            f"{'' if seen else '> '}{(BIAS_LIMIT * self.scale / steepest) ** (1 / self.order):.2g}"
        )

    @property
    def title(self) -> str:
        return main_titles().get(self.quantity, self.quantity)

    @property
    def label(self) -> str:
        return describe_values(self.values, short_keys(self.values))


class Limits(NamedTuple):
    name: str  # of the scene
    key: str
    limits: list[Limit]
    missing: list[str]  # sentences on what has no limit
    not_joint: list[str]  # on what has no joint fit

    @property
    def steps(self) -> list[float]:
        return sorted({point.timestep for limit in self.limits for point in limit.points})

    @property
    def keys(self) -> list[str]:
        return [*self.limits[0].values] if self.limits else []

    @property
    def title(self) -> str:
        orders = [(str(limit.order).translate(RAISED), limit.integrator) for limit in self.limits]
        powers = dict.fromkeys(f"dt{order} ({integrator})" for order, integrator in orders)
        return f"averages at a step of 0, from errors of order {', '.join(powers)} in {self.key}"

    def as_text(self) -> ReportTable:
        """For readers: limits, chi² over its degrees of freedom, the longest step of the fit, and
        biases."""
        short = short_keys(self.keys)
        lines = []
        for limit in self.limits:
            fit = limit.fit
            line = {short[key]: cell for key, cell in key_cells(limit.values).items()}
            line["average"] = limit.title
            if any(limit.kind == JOINT for limit in self.limits):
                line["fit"] = limit.kind
            line["limit"] = fit.describe_limit()
            line["chi²/dof"] = f"{fit.chi2:.2g}/{fit.freedom}" if fit.freedom else None
            line["to (fs)"] = f"{fit.longest:g}"
            line["off by 1% at (fs)"] = limit.step_at_limit
            for step in self.steps:
                bias = limit.bias(step)
                line[f"bias at {step:g} fs"] = None if bias is None else format_signed(*bias)
            lines.append(line)
        return report_of(lines)

    def lines(self) -> list[dict[str, Cell]]:
        """The lines of extrapolation.csv."""
        lines = []
        for limit in self.limits:
            fit = limit.fit
            line = key_cells(limit.values) | {
                "average": limit.quantity,
                "fit": limit.kind,
                "integrator": limit.integrator,
                "order": limit.order,
                "limit": nine_digits(fit.limit),
                "limit error": nine_digits(fit.limit_error),
                "chi2": nine_digits(fit.chi2) if fit.freedom else None,
                "degrees of freedom": fit.freedom,
                "longest step in fit (fs)": fit.longest,
            }
            for step in self.steps:
                name = f"bias at {step:g} fs"
                bias, error = limit.bias(step) or (None, None)
                line[name] = nine_digits(bias)
                line[f"{name} error"] = nine_digits(error)
            lines.append(line)
        return lines


def step_key(manifest: Manifest, key: str, scene: Scene) -> tuple[str, int]:
    """The swept key that sets a time step, and the index of its stage. Raises SceneError.

    key : that key, or one that varies together with it; scene : of one of the points
    """
    first = next((first for first, together in manifest.keys.items() if key in together), None)
    stages = scene.stages if is_molecular(scene) else ()
    last = max((k for k, stage in enumerate(stages) if not stage.is_minimisation), default=0)
    label = stages[last].label if stages else ""
    usual = f"stages.{last}.timestep_fs"
    if first is not None and key in (usual, f"stages.{label}.timestep_fs"):
        return first, last
    if first is None:
        varied = ", ".join(key for keys in manifest.keys.values() for key in keys)
        problem = f"is not varied. This sweep varies {varied}"
    elif key.startswith("stages.") and key.endswith(".timestep_fs"):
        problem = f"is not the step of the stage whose averages are taken, the last one, {label}"
    else:
        problem = "is not the time step of a stage of molecules"
    advice = f"give it a key such as --set {usual}=1,2,4 {OPTION} {usual}"
    raise SceneError(OPTION, [f"{key} {problem}; {advice}"])


@dataclass
class _Series:
    """What was measured of the runs that differ in the step and the seed alone, by the step (fs).

    runs : column -> step -> value and error of each run; together : of runs analysed together
    results : step -> results of each run for a joint fit; not_joint : why there are none
    """

    title: str  # describes `values`
    values: Json  # of the other keys
    stage: Stage
    scales: dict[str, float]
    runs: dict[str, dict[float, list[Measured]]] = field(default_factory=dict)
    together: dict[str, dict[float, Together]] = field(default_factory=dict)
    results: dict[float, list[RunResults]] = field(default_factory=dict)
    not_joint: dict[str, None] = field(default_factory=dict)

    def of_method(self, column: str) -> Json:
        """The values of keys on which a column does not depend at a step of 0: with a thermostat,
        averages of the log are the same for all methods."""
        is_same = self.stage.has_thermostat and column in OF_LOG
        keys = [key for key in self.values if key.endswith(OF_METHODS) and is_same]
        return {key: self.values[key] for key in keys}

    def ensemble(self, column: str) -> str:
        """A column, and the values on which it depends."""
        method = self.of_method(column)
        return f"{column} {[(key, x) for key, x in self.values.items() if key not in method]}"

    def points(self, column: str) -> list[MeanAtStep]:
        """Empty if runs are too short and too few."""
        points = means_of_runs(self.runs.get(column, {}), self.together.get(column))
        method, order = str(self.of_method(column)), self.stage.scheme.order
        return [point._replace(method=method, order=order) for point in points]

    def is_constant(self, column: str) -> bool:
        """Whether all values agree to rounding, as edges of a box that does not change."""
        values = [value for of_step in self.runs.get(column, {}).values() for value, _ in of_step]
        values += [value for value, *_ in self.together.get(column, {}).values()]
        return bool(np.ptp(values) <= ROUNDING * np.abs(values).max())

    def describe(self, reason: str) -> str:
        return f"{self.title}: {reason}" if self.title else reason


def extrapolate_sweep(manifest: Manifest, key: str) -> Limits:
    """Extrapolate all log averages in a sweep, and the values of its analyses, to a step of 0.

    With a thermostat, averages of the log by several methods have one limit. Values of analyses
    come from replicas together, if they have been analysed together, else from single runs. Raises
    SceneError if the key is not a swept time step, OutputError.
    """
    found = Limits(manifest.name, key, [], [], [])
    all_series = _series(manifest, key)
    ensembles: dict[str, list[tuple[_Series, str, list[MeanAtStep]]]] = {}
    for series in all_series:
        for column in series.runs | series.together:
            if column == DRIFT or series.is_constant(column):
                continue
            if len({*series.runs.get(column, ()), *series.together.get(column, ())}) < 2:
                found.missing.append(series.describe(f"{column}: has values at one step only"))
            elif points := series.points(column):
                members = ensembles.setdefault(series.ensemble(column), [])
                members.append((series, column, points))
            else:
                found.missing.append(series.describe(f"{column}: {TOO_SHORT}"))
    for members in ensembles.values():
        fit = extrapolate([point for *_, points in members for point in points])
        for series, column, points in members:
            about = series.values, series.stage.integrator, column, points, fit
            found.limits.append(Limit(*about, scale=series.scales.get(column)))
    for series in all_series:
        fits = fit_jointly(series.results)
        for kind, by_quantity in ((JOINT, fits.joint), (FLUCTUATIONS, fits.responses)):
            for name, of_quantity in by_quantity.items():
                about = series.values, series.stage.integrator, name
                found.limits.append(Limit(*about, *of_quantity, kind))
        reasons = [*series.not_joint]
        if series.results and not fits.joint:
            reasons.append(TOO_SHORT)
        found.not_joint.extend(map(series.describe, reasons))
    return found


def _series(manifest: Manifest, key: str) -> list[_Series]:
    """Read all finished runs. The table of the sweep names those that cannot be read."""
    found: dict[str, _Series] = {}
    short = short_keys(manifest.keys)
    for values, points in manifest.combinations():
        series, step = None, 0.0
        for point in points:
            if point.state != "finished":
                continue
            folder = manifest.folder / point.folder
            try:
                record = read_record(folder)
                measured = summarise_run(record) | measured_values(read_table(folder).values())
            except RigidMDError:
                continue
            first, k = step_key(manifest, key, record.scene)
            step = float(values[first])
            others = {name: value for name, value in values.items() if name != first}
            title = describe_values(others, short)
            stage = record.scene.stages[k]  # pyright: ignore[reportAttributeAccessIssue]  (it has them)
            scales = _scales(record.system, k) | {DENSITY: measured.get(DENSITY, (0.0,))[0]}
            series = found.setdefault(title, _Series(title, others, stage, scales))
            for column, value in measured.items():
                series.runs.setdefault(column, {}).setdefault(step, []).append(value)
            results = results_of_run(record)
            if isinstance(results, str):
                series.not_joint[results] = None
            else:
                series.results.setdefault(step, []).append(results)
        if series is not None and len(points) > 1:
            folder = manifest.folder / point_name(values, short)
            for column, value in _values_together(folder).items():
                series.together.setdefault(column, {})[step] = value
    return [*found.values()]


def _scales(system: System, k: int) -> dict[str, float]:
    """Sizes of averages in stage k, of which biases are fractions: kT per degree of freedom for
    U, the set temperature, and N kT/V for the pressure. Empty without a thermostat."""
    stage = system.scene.stages[k]
    if not stage.has_thermostat:
        return {}
    temperature = stage.temperatures[0]
    count = len(system.model.species)
    per_molecule = system.freedom_in(k).total / count
    return dict.fromkeys(TEMPERATURES, temperature) | {
        POTENTIAL: GAS_CONSTANT * temperature * per_molecule,
        PRESSURE: count * BOLTZMANN * temperature / system.space.volume / BAR,
    }


def _values_together(folder: Path) -> dict[str, Together]:
    """The values of analyses of several runs together that have an error, by their headers. Raises
    OutputError."""
    return {
        value.header: Together(value.value, value.error, entry.frames_used.runs)
        for entry in read_table(folder).values()
        for value in entry.values
        if entry.frames_used.runs > 1 and value.value is not None and value.error is not None
    }


def write_limits(folder: Path, limits: Limits, command: str) -> list[str]:
    """Write table, figure and page of limits. The names of the files. Raises OutputError."""
    if not limits.limits:
        return []
    add_to_folder(folder, FILES)
    report_of(limits.lines()).write(folder / FILES[0], quote_text=True)
    write_figure(folder / FILES[1], lambda: _figure(limits), f"{limits.name}: {limits.title}")
    title = f"{limits.name}: averages at a step of 0"
    write_page(folder / FILES[2], title, _parts(limits, command))
    return [name for name in FILES if (folder / name).is_file()]


def _parts(limits: Limits, command: str) -> Iterator[str]:
    note = "mean = limit + slope · dt^order, up to the longest step that chi² allows (column `to`)"
    rows = table(*limits.as_text().shown())
    drawn = wide(_figure(limits), "extrapolation", "means over the time step, and their limits")
    yield f'<p class="faint">{plain(limits.title)}</p>'
    yield section("Limits and biases", rows, items([note, *limits.missing, *limits.not_joint]))
    yield section("Means against the time step", drawn)
    yield section("How to repeat it", code(command))


def _figure(limits: Limits):
    """A panel for each of the main averages: means with error bars, the fit, and the limit with its
    error at 0."""
    main = list(main_titles())
    of_log = [column.header for column in QUANTITIES.values()]

    def rank(name: str) -> int:
        return main.index(name) if name in main else len(main) + (name in of_log)

    independent = [limit for limit in limits.limits if limit.kind == INDEPENDENT]
    shown = sorted({limit.quantity: None for limit in independent}, key=rank)[:MOST_PANELS]
    labels = list(dict.fromkeys(limit.label for limit in independent))
    figure, axes = panels(shown)
    for limit in independent:
        if limit.quantity in shown:
            _draw_limit(axes[shown.index(limit.quantity)], limit, labels.index(limit.label))
    for axis in axes:
        axis.set_xlabel(readable_key(limits.key), fontsize=9, color=INK)
    add_legend(figure, axes[0])
    return figure


def _draw_limit(axis: "Axes", limit: Limit, k: int) -> None:
    fit = limit.fit
    style = curve_style(k, connected=False)
    _, steps, means, errors, _ = zip(*limit.points, strict=True)
    axis.errorbar(steps, means, errors, label=limit.label, ms=3.5, capsize=2.5, **style)
    at_zero = [0], [fit.limit], [fit.limit_error]
    axis.errorbar(*at_zero, ms=4, capsize=2.5, mfc="none", clip_on=False, **style)
    step = np.linspace(0, fit.longest, 60)
    slope, _ = fit.slopes.get(limit.method, (0.0, 0.0))
    axis.plot(step, fit.limit + slope * step**limit.order, color=style["color"], lw=0.9)
    axis.set_xlim(left=0)
