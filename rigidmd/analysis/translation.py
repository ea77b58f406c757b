"""How far molecules go: mean squared displacement, and the diffusion coefficient with its error."""

import numpy as np

from rigidmd.analysis.correlation import squared_displacement
from rigidmd.analysis.findings import BLOCKS, LEAST_EACH, Curve, Finding, Value, over_parts, settled, so_far
from rigidmd.analysis.history import History
from rigidmd.analysis.registry import built_in
from rigidmd.errors import OutputError
from rigidmd.run.rigid_fit import Kind
from rigidmd.units import BAR

#: Lags that are fitted, as fractions of a block.
FIT_FROM, FIT_TO = 0.1, 0.5
#: Change of the slope of a displacement, as a fraction, from which on molecules do not yet diffuse.
BEND = 0.1
#: Yeh & Hummer 2004, J. Phys. Chem. B 108, 15873: cubic boxes.
YEH_HUMMER = 2.837297
#: One mPa s in u/(Å ps), and 1e-9 m²/s in Å²/ps.
MPA_S, NM2_PER_S = BAR * 1e4, 0.1


def evenly(history: History, what: str) -> tuple[float, int]:
    """Interval between frames (ps) and number of lags for a correlation function: half a block. Raises OutputError."""
    if history.interval is None:
        gaps = np.diff(history.time)
        raise OutputError(
            f"{what} needs frames at equal times; here they are {gaps.min():g} to {gaps.max():g} ps apart"
        )
    lags = int(len(history) // BLOCKS * FIT_TO) + 1
    if lags < 3:
        raise OutputError(f"{what} needs at least {4 * BLOCKS} frames; there are {len(history)}")
    return history.interval, lags


def _displacements(history: History, kind: Kind, lags: int) -> np.ndarray:
    """Mean squared displacement (lags,), Å²."""
    return squared_displacement(history.paths[:, kind.index], lags)


@built_in("mean squared displacement of the centres of mass")
def msd(history: History) -> Finding:
    """Mean squared displacement (Å²) of each species against time, all origins, up to half a fifth of the frames.

    Molecules are followed through the walls of the box, without what a barostat scaled. Raises OutputError.
    """
    interval, lags = evenly(history, "a mean squared displacement")
    curve = Curve("msd", ("Time (ps)", interval * np.arange(lags)), "MSD (Å²)", {}, log=(True, True))
    for kind in history.moving:
        found = over_parts(history, kind, lambda part, own: _displacements(part, own, lags))
        curve.add(f"MSD {kind.name} (A^2)", *found)
    return Finding("msd", "mean squared displacement", curves=[curve])


@built_in("diffusion coefficient, with the correction for the size of the box")
def diffusion(history: History, viscosity_mPa_s: float | None = None) -> Finding:
    """D of each species (1e-9 m²/s) from the slope of its mean squared displacement, and D of an infinite box.

    viscosity_mPa_s : for the correction of Yeh and Hummer; default: that of the run, where its pressure tensor was kept
    Raises OutputError.
    """
    from rigidmd.analysis.shear_viscosity import viscosity_of

    if viscosity_mPa_s is not None and not 0 < viscosity_mPa_s < np.inf:
        raise OutputError(f"viscosity_mPa_s must be a number above 0, not {viscosity_mPa_s:g}")
    interval, lags = evenly(history, "a diffusion coefficient")
    first = max(1, int(len(history) // BLOCKS * FIT_FROM))
    time = interval * np.arange(first, lags)
    if len(time) < 4:
        raise OutputError(f"a diffusion coefficient needs at least {8 * BLOCKS} frames; there are {len(history)}")

    half = len(time) // 2

    def slopes(part: History, kind: Kind) -> np.ndarray:
        seen = _displacements(part, kind, lags)[first:]
        return np.array([_slope(time, seen), _slope(time[half:], seen[half:]) - _slope(time[:half], seen[:half])]) / 6

    found = Finding("diffusion", "diffusion coefficients", curves=[_so_far(history, interval, lags)])
    found.notes.append(f"slope of the mean squared displacement from {time[0]:.3g} to {time[-1]:.3g} ps")
    edge = _cubic_edge(history)
    eta = viscosity_of(history) if viscosity_mPa_s is None else None
    for kind in history.moving:
        name, ((D, bend), (error, doubt)) = f"D of {kind.name}", np.array(over_parts(history, kind, slopes)).tolist()
        if D <= 0 or abs(bend) > BEND * D + 2 * np.nan_to_num(doubt):
            told = (
                f"the slope of its displacement changes from {time[0]:.3g} to {time[-1]:.3g} ps, too short for a "
                f"value; a run of {4 * history.span:.3g} ps follows it four times as far. "
                f"{so_far(D / NM2_PER_S, error / NM2_PER_S, '1e-9 m²/s')}"
            )
            found.values.append(Value(name, "1e-9 m²/s", None, None, None, told))
            continue
        away = _spacing(history) ** 2 / (6 * D)
        own = settled(name, "1e-9 m²/s", D / NM2_PER_S, error / NM2_PER_S, history.span, away, least=LEAST_EACH)
        found.values.append(own)
        if own.value is None or edge is None:
            continue
        name = f"D of {kind.name} in an infinite box"
        flows = viscosity_mPa_s if eta is None else eta.value
        if flows is None:
            told = f"no correction for the size of the box without a viscosity: {eta.note if eta else ''}"
            found.values.append(Value(name, "1e-9 m²/s", None, None, None, told))
            continue
        more = YEH_HUMMER * history.thermal_energy / (6 * np.pi * flows * MPA_S * edge) / NM2_PER_S
        source = "as given, without its error" if eta is None else "that of this run"
        told = f"corrected by {more:.3g} for L = {edge:.4g} Å with a viscosity of {flows:.3g} mPa s, {source}"
        doubt = more * (eta.error or 0.0) / flows if eta else 0.0
        both = None if own.error is None else float(np.hypot(own.error, doubt))
        found.values.append(own._replace(name=name, value=own.value + more, error=both, note=told))
    if edge is None and history.has_box:
        found.notes.append("no correction for the size of the box: that of Yeh and Hummer is for cubic boxes")
    return found


def _so_far(history: History, interval: float, lags: int) -> Curve:
    """MSD/6t of each species, which tends to D."""
    time = interval * np.arange(1, lags)
    curve = Curve("diffusion", ("Time (ps)", time), "MSD/6t (1e-9 m²/s)", {})
    size = 6 * NM2_PER_S * time
    for kind in history.moving:
        found = over_parts(history, kind, lambda part, own: _displacements(part, own, lags)[1:] / size)
        curve.add(f"MSD/6t {kind.name} (1e-9 m^2/s)", *found)
    return curve


def _slope(time: np.ndarray, values: np.ndarray) -> float:
    """Least-squares slope of values (t,) against time."""
    off = time - time.mean()
    return off @ values / (off @ off)


def _spacing(history: History) -> float:
    """Distance of neighbouring molecules, Å: what a molecule has to move before its surroundings are others."""
    if not history.has_box:
        return history.system.smallest_diameter
    return float((history.volume.mean() / len(history.system.model.species)) ** (1 / 3))


def _cubic_edge(history: History) -> float | None:
    """The edge of a cubic box, Å; None of others."""
    if not history.has_box:
        return None
    cell = history.cell.mean(axis=0)
    edge = float(cell[0, 0])
    return edge if np.abs(cell - edge * np.eye(3)).max() < 0.01 * edge else None
