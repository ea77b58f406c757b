"""Order of orientations: the nematic order parameter."""

from typing import Literal

import numpy as np

from rigidmd.errors import OutputError
from rigidmd.features import acting_on
from rigidmd.features.analysis.registry import built_in
from rigidmd.features.analysis.result import (
    AnalysisResult,
    Curve,
    Value,
    correlation_time_of,
    mean_of_series,
    with_block_error,
)
from rigidmd.features.analysis.rigid_frames import RigidFrames
from rigidmd.features.analysis.runs import Runs
from rigidmd.run.rigid_fit import Kind

#: Mean S of N molecules without order, times the square root of N, for large N: Q has five
#: independent components of the variance 0.3/N, and its largest eigenvalue has the mean
#: sqrt(2/3) 27/32 <r> with r² = sum of Q_ij².
DISORDERED = 0.80286


@built_in("nematic order parameter S and director, of molecules with an axis", position=75)
def nematic(runs: Runs, axis: Literal["", "x", "y", "z"] = "") -> AnalysisResult:
    """S, the largest eigenvalue of Q = <(3 u u - 1)/2>, of the axes u of a species, and the
    director, its eigenvector.

    The mean over frames of S, whose director may rotate, and S about the director of all frames. S
    is 1 for parallel axes. For a frame of N molecules without order it is 0.80/sqrt(N), not 0. The
    middle eigenvalue times -2 has the mean 0 then (Eppenga & Frenkel 1984, Mol. Phys. 52, 1303).

    Parameters
    ----------
    axis : {"x", "y", "z"}, optional
        Axis in the coordinates of the models' files. Default: the axis of linear molecules, and of
        the potentials of two bodies
    """
    result = AnalysisResult("nematic", "nematic order")
    for kind in runs.moving:
        along = _axis_body(runs, kind, axis)
        if along is None:
            continue

        def tensor(part: RigidFrames, kind=kind, along=along) -> np.ndarray:
            return _tensors(part, kind, along).mean(axis=0)

        each = [np.linalg.eigh(_tensors(run, kind, along)) for run in runs.members]
        series = [values[:, 2] for values, _ in each]
        mean, error = mean_of_series(runs, series)
        tau = correlation_time_of(runs, series)
        disorder = DISORDERED / np.sqrt(len(kind.index))
        note = f"{disorder:.2g} without order, for {len(kind.index)} molecules"
        result.values.append(Value(f"S of {kind.name}", "1", mean, error, tau, note))
        value, error = with_block_error(runs, tensor, lambda q: np.linalg.eigvalsh(q)[2:])
        doubt = float(error[0]) if np.isfinite(error[0]) else None
        name = f"S of {kind.name} about the mean director"
        result.values.append(Value(name, "1", float(value[0]), doubt, tau))
        mean_tensor = runs.mean([tensor(run) for run in runs.members])
        director = _towards(np.linalg.eigh(mean_tensor)[1][:, 2], np.ones(3))
        text = ", ".join(f"{x:.3f}" for x in director)
        result.notes.append(f"director of {kind.name}: ({text})")
        values, vectors = (of_run[: runs.shortest] for of_run in each[0])
        columns = {"S": values[:, 2], "-2 x middle": -2 * values[:, 1]}
        directors = _towards(vectors[..., 2], director)
        columns |= {f"n_{name}": directors[:, k] for k, name in enumerate("xyz")}
        columns = {f"{name} {kind.name}": column for name, column in columns.items()}
        if not result.curves:
            time = runs.first.time[: runs.shortest]
            result.curves.append(Curve("nematic", ("Time (ps)", time), "S and director", {}))
        result.curves[0].columns |= columns
    if not result.curves:
        raise OutputError(
            "no molecule of this run is linear. Name an axis of the model's file, such as"
            " `rigidmd analyse RUN nematic axis=z`"
        )
    return result


def _axis_body(runs: Runs, kind: Kind, axis: str) -> np.ndarray | None:
    """The axis of a species in its body frame; None without one."""
    molecule = kind.molecule
    of_features = [
        name
        for feature in acting_on(runs.system.scene)
        for species, name in feature.axes(runs.system)
        if species == molecule.name
    ]
    if molecule.kind == "linear":
        return np.eye(3)[0]
    if not molecule.inertia.any() or not (named := [axis] if axis else of_features):
        return None
    return molecule.axes["xyz".index(named[0])]


def _tensors(frames: RigidFrames, kind: Kind, along: np.ndarray) -> np.ndarray:
    """Q of each frame (f, 3, 3)."""
    u = frames.Q[:, kind.index] @ along
    return 1.5 * np.einsum("fni,fnj->fij", u, u) / len(kind.index) - 0.5 * np.eye(3)


def _towards(vectors: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Vectors (..., 3) with the sign by which they are nearer to another."""
    return np.where((vectors @ other < 0)[..., None], -vectors, vectors)
