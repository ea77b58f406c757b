"""Translation: mean squared displacement, and the diffusion coefficient with its error."""

import numpy as np

from rigidmd.analysis.correlation import squared_displacement
from rigidmd.analysis.registry import built_in
from rigidmd.analysis.result import (
    BLOCKS,
    MIN_MOLECULAR_TIMES,
    AnalysisResult,
    Curve,
    Value,
    converged_value,
    describe_so_far,
    with_group_error,
)
from rigidmd.analysis.rigid_frames import RigidFrames
from rigidmd.errors import OutputError
from rigidmd.run.rigid_fit import Kind
from rigidmd.units import BAR

#: Lags that are fitted, as fractions of a block.
FIT_FROM, FIT_TO = 0.1, 0.5
#: Relative change of the slope of the displacement above which molecules do not diffuse yet.
BEND = 0.1
#: Yeh & Hummer 2004, J. Phys. Chem. B 108, 15873: cubic boxes.
YEH_HUMMER = 2.837297
#: One mPa s in u/(Å ps), and 1e-9 m²/s in Å²/ps.
MPA_S, NM2_PER_S = BAR * 1e4, 0.1


def interval_and_lags(frames: RigidFrames, what: str) -> tuple[float, int]:
    """Interval between frames (ps) and number of lags for a correlation function: half a block. Raises OutputError."""
    if frames.interval is None:
        gaps = np.diff(frames.time)
        raise OutputError(f"{what} needs frames at equal intervals; these are {gaps.min():g} to {gaps.max():g} ps")
    lags = int(len(frames) // BLOCKS * FIT_TO) + 1
    if lags < 3:
        raise OutputError(f"{what} needs at least {4 * BLOCKS} frames; there are {len(frames)}")
    return frames.interval, lags


def _displacements(frames: RigidFrames, kind: Kind, lags: int) -> np.ndarray:
    return squared_displacement(frames.paths[:, kind.index], lags)


@built_in("mean squared displacement of the centres of mass", position=50)
def msd(frames: RigidFrames) -> AnalysisResult:
    """Mean squared displacement (Å²) of each species against time, all origins, up to half a fifth of the frames.

    Paths continue through the faces of the box, without the scaling by a barostat. Raises OutputError.
    """
    interval, lags = interval_and_lags(frames, "a mean squared displacement")
    curve = Curve("msd", ("Time (ps)", interval * np.arange(lags)), "MSD (Å²)", {}, log=(True, True))
    for kind in frames.moving:
        found = with_group_error(frames, kind, lambda part, group: _displacements(part, group, lags))
        curve.add(f"MSD {kind.name} (A^2)", *found)
    return AnalysisResult("msd", "mean squared displacement", curves=[curve])


@built_in("diffusion coefficient, with the correction for the size of the box", position=60)
def diffusion(frames: RigidFrames, viscosity_mPa_s: float | None = None) -> AnalysisResult:
    """D of each species (1e-9 m²/s) from the slope of its mean squared displacement, and D of an infinite box.

    viscosity_mPa_s : for the correction of Yeh and Hummer; default: from the pressure tensor of the run, if any
    Raises OutputError.
    """
    from rigidmd.analysis.built_in.shear_viscosity import viscosity_of

    if viscosity_mPa_s is not None and not 0 < viscosity_mPa_s < np.inf:
        raise OutputError(f"viscosity_mPa_s must be a number above 0, not {viscosity_mPa_s:g}")
    interval, lags = interval_and_lags(frames, "a diffusion coefficient")
    first = max(1, int(len(frames) // BLOCKS * FIT_FROM))
    time = interval * np.arange(first, lags)
    if len(time) < 4:
        raise OutputError(f"a diffusion coefficient needs at least {8 * BLOCKS} frames; there are {len(frames)}")

    half = len(time) // 2

    def slopes(part: RigidFrames, kind: Kind) -> np.ndarray:
        seen = _displacements(part, kind, lags)[first:]
        return np.array([_slope(time, seen), _slope(time[half:], seen[half:]) - _slope(time[:half], seen[:half])]) / 6

    found = AnalysisResult("diffusion", "diffusion coefficients", curves=[_so_far(frames, interval, lags)])
    found.notes.append(f"slope of the mean squared displacement from {time[0]:.3g} to {time[-1]:.3g} ps")
    edge = _cubic_edge(frames)
    eta = viscosity_of(frames) if viscosity_mPa_s is None else None
    for kind in frames.moving:
        name, ((D, bend), (error, doubt)) = (
            f"D of {kind.name}",
            np.array(with_group_error(frames, kind, slopes)).tolist(),
        )
        if D <= 0 or abs(bend) > BEND * D + 2 * np.nan_to_num(doubt):
            note = (
                f"the slope of its displacement changes from {time[0]:.3g} to {time[-1]:.3g} ps, too short for a "
                f"value; a run of {4 * frames.span:.3g} ps follows it four times as far. "
                f"{describe_so_far(D / NM2_PER_S, error / NM2_PER_S, '1e-9 m²/s')}"
            )
            found.values.append(Value(name, "1e-9 m²/s", None, None, None, note))
            continue
        away = _neighbour_distance(frames) ** 2 / (6 * D)
        value = converged_value(
            name, "1e-9 m²/s", D / NM2_PER_S, error / NM2_PER_S, frames.span, away, least=MIN_MOLECULAR_TIMES
        )
        found.values.append(value)
        if value.value is None or edge is None:
            continue
        name = f"D of {kind.name} in an infinite box"
        viscosity = viscosity_mPa_s if eta is None else eta.value
        if viscosity is None:
            note = f"no correction for the size of the box without a viscosity: {eta.note if eta else ''}"
            found.values.append(Value(name, "1e-9 m²/s", None, None, None, note))
            continue
        more = YEH_HUMMER * frames.thermal_energy / (6 * np.pi * viscosity * MPA_S * edge) / NM2_PER_S
        source = "as given, without its error" if eta is None else "from this run"
        note = f"corrected by {more:.3g} for L = {edge:.4g} Å with a viscosity of {viscosity:.3g} mPa s, {source}"
        doubt = more * (eta.error or 0.0) / viscosity if eta else 0.0
        both = None if value.error is None else float(np.hypot(value.error, doubt))
        found.values.append(value._replace(name=name, value=value.value + more, error=both, note=note))
    if edge is None and frames.has_box:
        found.notes.append("no correction for the size of the box: the one of Yeh and Hummer is for cubic boxes")
    return found


def _so_far(frames: RigidFrames, interval: float, lags: int) -> Curve:
    """MSD/6t of each species, which tends to D."""
    time = interval * np.arange(1, lags)
    curve = Curve("diffusion", ("Time (ps)", time), "MSD/6t (1e-9 m²/s)", {})
    size = 6 * NM2_PER_S * time
    for kind in frames.moving:
        found = with_group_error(frames, kind, lambda part, group: _displacements(part, group, lags)[1:] / size)
        curve.add(f"MSD/6t {kind.name} (1e-9 m^2/s)", *found)
    return curve


def _slope(time: np.ndarray, values: np.ndarray) -> float:
    off = time - time.mean()
    return off @ values / (off @ off)


def _neighbour_distance(frames: RigidFrames) -> float:
    """Distance of neighbouring molecules, Å, over which a molecule has to move to change its surroundings."""
    if not frames.has_box:
        return frames.system.smallest_diameter
    return float((frames.volume.mean() / len(frames.system.model.species)) ** (1 / 3))


def _cubic_edge(frames: RigidFrames) -> float | None:
    """The edge of a cubic box, Å, or None."""
    if not frames.has_box:
        return None
    cell = frames.cell.mean(axis=0)
    edge = float(cell[0, 0])
    return edge if np.abs(cell - edge * np.eye(3)).max() < 0.01 * edge else None
