"""The analysis `zero_step`: means of a run at a time step of zero, from its own fluctuations. See
`step_bias`."""

from typing import Literal

import numpy as np

from rigidmd.core.statistics import format_signed, mean_and_error
from rigidmd.errors import OutputError
from rigidmd.features.analysis.built_in.structure import LARGEST, density_profile, rdf
from rigidmd.features.analysis.conditions import constant_conditions
from rigidmd.features.analysis.pair_histogram import heights
from rigidmd.features.analysis.registry import built_in
from rigidmd.features.analysis.result import AnalysisResult, Curve, Value
from rigidmd.features.analysis.rigid_frames import RigidFrames
from rigidmd.features.analysis.runs import Runs
from rigidmd.features.studies.step_bias import BLOCKS, Production, bias_of, biases_of, production

#: Most frames for curves, and fewest.
MOST_FRAMES, LEAST_FRAMES = 2000, 20 * BLOCKS
#: Largest difference of the times of a frame and of its line of the log, ps.
SAME_TIME = 1e-4


@built_in(
    "means of all columns at a step of zero, from this run alone",
    position=110,
    on_request=True,
    needs=(constant_conditions,),
)
def zero_step(
    runs: Runs, curves: bool = True, axis: Literal["x", "y", "z"] | None = None
) -> AnalysisResult:
    """Means of nvt and npt without their time-step error, to first order in dt², and this error:
    from covariances in the run itself.

    The error of a value includes errors of the mean, of the covariances, and of the next order in
    dt². The theory chapter `zero_step` has the formulas and what they assume.

    Parameters
    ----------
    curves : bool, optional
        Whether g(r) is corrected too, if the run has frames
    axis : {"x", "y", "z"}, optional
        Axis of a density profile that is corrected too. Default: none
    """
    found = [_of_run(run) for run in runs.members]
    names = [name for name in found[0] if all(name in of_run for of_run in found)]
    step = runs.first.stage.step_fs
    result = AnalysisResult("zero_step", f"means at a step of zero, from {step:g} fs")
    for name in names:
        quantity = runs.system.quantities[name]
        mean = quantity.mean
        divisor = len(runs.system.model.species) if mean and mean.per_molecule else 1
        table = np.array([of_run[name] for of_run in found]) / divisor
        weight = runs.weights / runs.weights.sum()
        (value, bias), errors = weight @ table[:, :2], np.sqrt(weight**2 @ table[:, 2:] ** 2)
        uncertain, error = errors.tolist()
        unit = (mean and mean.unit) or quantity.unit
        note = f"the step added {format_signed(bias, uncertain)}"
        title = quantity.mean_header.partition(" (")[0]
        result.values.append(Value(title, unit, float(value - bias), error, None, note))
    if curves and runs.has_box and not runs.are_several:
        _add_curves(result, runs.first, axis)
    return result


def _production(run: RigidFrames) -> Production:
    """The samples of the last stage. Raises OutputError."""
    of_stage = run.columns["stage"] == run.columns["stage"][-1]
    columns = {name: values[of_stage] for name, values in run.columns.items()}
    found = production(run.system, run.stage, columns)
    if isinstance(found, str):
        raise OutputError(f"zero_step: {found}")
    return found


def _of_run(run: RigidFrames) -> dict[str, tuple[float, float, float, float]]:
    """Mean, bias, its error and the error of the mean at zero, by columns. Raises OutputError."""
    samples = _production(run)
    found = {}
    for name, of_column in biases_of(samples, run.system.quantities).items():
        found[name] = float(samples.columns[name].mean()), *of_column
    return found


def _add_curves(result: AnalysisResult, run: RigidFrames, axis: str | None) -> None:
    """g(r), and a density profile, without time-step error. A note where there are none."""
    at = _production(run)
    if not np.isfinite(at.series.curvature).all():
        result.notes.append("no pressure and no g(r), as the log has no v U'' v of all steps")
        return
    if not len(run):
        result.notes.append(f"no g(r): {run.why_no_frames}")
        return
    every = max(1, len(run) // MOST_FRAMES)
    frames = run[len(run) % every :: every]
    time = at.columns["time"]
    rows = np.minimum(np.searchsorted(time, frames.time - SAME_TIME), len(time) - 1)
    known = np.abs(time[rows] - frames.time) < SAME_TIME
    if known.sum() < LEAST_FRAMES:
        result.notes.append(
            f"no g(r): {known.sum()} of {len(frames)} frames are at lines of the log, and"
            f" {LEAST_FRAMES} are needed. Let trajectory_interval_ps be a multiple of"
            " log_interval_ps"
        )
        return
    largest = 0.5 * float(min(heights(cell).min() for cell in frames.cell))
    functions = [lambda one: _unchecked(rdf)(one, largest=min(LARGEST, largest))]
    if axis:
        (profile,) = _unchecked(density_profile)(Runs((frames,)), axis=axis).curves
        bins = len(profile.axis[1])  # of a single frame the density always changes
        functions.append(lambda one: _unchecked(density_profile)(one, axis=axis, bins=bins))
    indices = np.flatnonzero(known)
    for function in functions:
        single = [function(Runs((frames[k : k + 1],))).curves[0] for k in indices]
        result.curves.append(_corrected(single, at, rows[indices]))


def _unchecked(analysis):
    """The function of an analysis that takes a single frame too."""
    return analysis.__wrapped__


def _corrected(frames: list[Curve], at: Production, rows: np.ndarray) -> Curve:
    """The mean of curves of single frames less the bias by the step."""
    first = frames[0]
    curve = Curve(f"zero_step_{first.file}", first.axis, first.label, {}, level=first.level)
    for title in first.columns:
        values = np.array([frame.columns[title] for frame in frames]).T
        bias = bias_of(values, at.series, at.at, [np.nan] * len(values), rows)
        means, errors = zip(*map(mean_and_error, values), strict=True)
        of_mean = np.array([np.nan if error is None else error for error in errors])
        curve.add(title, np.array(means) - bias.value, np.hypot(of_mean, bias.error))
        curve.columns[f"{title}, of the step"] = bias.value
    return curve
