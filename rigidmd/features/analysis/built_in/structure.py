"""Structure: g(r), structure factor, density profile, hydrogen bonds."""

from collections.abc import Callable
from functools import partial
from itertools import combinations_with_replacement, product
from typing import Annotated

import numpy as np

from rigidmd.core.statistics import error_of_mean, inefficiency
from rigidmd.errors import OutputError
from rigidmd.features.analysis.conditions import box, trajectory
from rigidmd.features.analysis.options import Axis, Count, Limits
from rigidmd.features.analysis.pair_histogram import count_pairs, heights
from rigidmd.features.analysis.registry import built_in
from rigidmd.features.analysis.result import (
    BLOCKS,
    AnalysisResult,
    Curve,
    Measured,
    Value,
    correlation_time_of,
    mean_of_series,
    with_block_error,
)
from rigidmd.features.analysis.rigid_frames import RigidFrames
from rigidmd.features.analysis.runs import Runs
from rigidmd.io.trajectory import near_pairs
from rigidmd.run.rigid_fit import Kind
from rigidmd.scene.models import Molecule
from rigidmd.units import GRAM_PER_CM3

#: Enough molecules x frames for g(r) and hydrogen bonds, and for S(k). Further frames add little.
ENOUGH_MOLECULES, ENOUGH_MOLECULES_K = 200_000, 100_000
FEWEST, MOST = 20, 500  # frames
#: Å: largest distance and width of bins of g(r), unless others are given.
LARGEST, WIDTH = 10.0, 0.05
#: Å: lengths that may be given; most bins of g(r), and most wave vectors of S(k).
LENGTHS, MOST_BINS, MOST_VECTORS = Limits(1e-4, 1e6), 20_000, 5e7
#: 1/Å: largest wave vector and width of bins of S(k); most wave vectors of a bin.
K_MAX, K_WIDTH, VECTORS_PER_BIN = 8.0, 0.1, 24
#: Bins of a density profile where the density changes along the axis and elsewhere, and the lowest
#: density of a uniform one in units of its mean.
MANY_BINS, FEW_BINS, LEAST_DENSITY = 100, 20, 0.5
#: Blocks of frames for errors of peaks; least fraction of the variance of blocks by which their
#: correlation reduces it.
PEAK_BLOCKS, LEAST_INDEPENDENT = 10, 0.25
#: Å and degrees: largest O···O and H-O···O of a hydrogen bond (Luzar & Chandler 1996, Nature 379,
#: 55).
BOND_DISTANCE, BOND_ANGLE = 3.5, 30.0
BONDING = ("N", "O", "F")  # donors and acceptors of hydrogen bonds


@built_in(
    "radial distribution functions g(r) of sites of different molecules",
    position=10,
    needs=(trajectory, box),
)
def rdf(
    runs: Runs,
    first: str = "",
    second: str = "",
    largest: Annotated[float, LENGTHS] | None = None,
    width: Annotated[float, LENGTHS] = WIDTH,
) -> AnalysisResult:
    """g(r) of two sites, elements or species (centres of mass).

    g is normalised by the number of pairs of different molecules, so it tends to 1 in a small box
    too. Each frame has its own cell.

    Parameters
    ----------
    first, second : str, optional
        Names of sites, elements or species. Default: all pairs of elements, in mixtures of species
    largest : float, optional
        Largest distance, Å. Default: half the box, at most 10 Å
    width : float, optional
        Width of a bin, Å. Wide bins lower a narrow peak, which the error of its height does not
        include
    """
    half = 0.5 * float(min(heights(cell).min() for run in runs.members for cell in run.cell))
    largest = min(half, LARGEST) if largest is None else largest
    if not 0 < width < largest <= half * (1 + 1e-9):
        asked = f"g(r) up to {largest:g} Å in bins of {width:g} Å"
        raise OutputError(f"{asked} is not possible: half the box is {half:.4g} Å")
    if largest > MOST_BINS * width:
        raise OutputError(f"g(r) has at most {MOST_BINS} bins: use a larger width than {width:g} Å")
    if second and not first:
        raise OutputError(f"g(r): second is {second!r}: name the first site too")
    pairs = [(first, second or first)] if first else _pairs(runs)
    thinned, notes = _thinned(runs, ENOUGH_MOLECULES)
    bins = int(largest / width + 1e-9)
    edges = width * np.arange(bins + 1)
    shells = 4 / 3 * np.pi * np.diff(edges**3)
    r = 0.5 * (edges[1:] + edges[:-1])
    curve = Curve("rdf", ("r (A)", r), "g(r)", {}, level=1.0)
    result = AnalysisResult("rdf", "radial distribution functions", curves=[curve], notes=notes)
    for a, b in pairs:
        if (pair_count := _pair_count(thinned.first, a, b)) == 0:
            result.notes.append(f"g(r) of {a} and {b}: no two different molecules have these sites")
            continue
        g = [_g_of_frames(run, a, b, pair_count, width, shells) for run in thinned.members]
        # density of b around each a, without its own molecule: two molecules have one neighbour
        # each
        density = pair_count / len(thinned.first.sites(a, slice(0, 1))[1]) / thinned.volume
        title = f"g {a}-{b}"
        mean, error = _mean_of_frames(thinned, g)
        curve.columns[title] = mean
        within = mean * shells * density
        # up to the middle of each bin
        curve.columns[f"n {a}-{b}"] = np.cumsum(within) - 0.5 * within
        if error is not None:
            curve.errors[title] = error
        result.values += _peaks(f"{a}-{b}", r, thinned, g, shells * density)
    return result


def _g_of_frames(
    frames: RigidFrames, a: str, b: str, pair_count: int, width: float, shells: np.ndarray
) -> np.ndarray:
    """g of two sites in each frame (f, bins). width, shells : of the bins, Å and Å³"""
    g = np.empty((len(frames), len(shells)))
    for k in range(len(frames)):
        at, owner = frames.sites(a, slice(k, k + 1))
        at_2, owner_2 = (at, owner) if a == b else frames.sites(b, slice(k, k + 1))
        counts = count_pairs(at[0], owner, at_2[0], owner_2, frames.cell[k], width, len(shells))
        g[k] = counts * float(frames.volume[k]) / (pair_count * shells)
    return g


def _thinned(runs: Runs, enough: int) -> tuple[Runs, list[str]]:
    """Evenly spaced frames with about `enough` molecules in total, and a note if these are not all
    frames."""
    frame_limit = min(MOST, max(FEWEST, enough // len(runs.system.model.species))) * max(
        1.0, len(runs.members) / BLOCKS
    )
    every = max(1, -(-runs.frame_count // int(frame_limit)))
    thinned = Runs(tuple(run[::every] for run in runs.members))
    note = f"of {thinned.frame_count} of {runs.frame_count} frames, evenly spaced"
    return thinned, [note] if every > 1 else []


def _mean_of_frames(runs: Runs, values: list[np.ndarray]) -> Measured | tuple[np.ndarray, None]:
    """Mean over the frames of each run, whose arrays are (f, p), and its error: of one run from
    blocks, of several from their scatter. None with few frames."""
    means = [of_run.mean(axis=0) for of_run in values]
    if runs.are_several:
        return runs.estimate(means, lambda mean: mean)
    if len(values[0]) < 2 * BLOCKS:
        return means[0], None
    return means[0], error_of_mean(
        [part.mean(axis=0) for part in np.array_split(values[0], BLOCKS)]
    )


def _pairs(runs: Runs) -> list[tuple[str, str]]:
    """Default pairs of names: elements of a pure liquid, species of a mixture."""
    names = [kind.name for kind in runs.kinds]
    if len(set(names)) == 1:
        m = runs.kinds[0].molecule
        elements = dict.fromkeys(
            e for e, mass in zip(m.elements, m.masses, strict=True) if mass > 0 and e != "X"
        )
        names = list(elements) or names
    return list(combinations_with_replacement(dict.fromkeys(names), 2))


def _pair_count(frames: RigidFrames, a: str, b: str) -> int:
    """Number of ordered pairs of a and b in different molecules."""
    (_, first), (_, second) = frames.sites(a, slice(0, 1)), frames.sites(b, slice(0, 1))
    number = len(frames.system.model.species)
    same = np.bincount(first, minlength=number) @ np.bincount(second, minlength=number)
    return len(first) * len(second) - int(same)


def _peaks(
    name: str, r: np.ndarray, runs: Runs, frames: list[np.ndarray], filled: np.ndarray
) -> list[Value]:
    """Position and height of the first peak, and neighbours up to the first minimum, if there is a
    peak.

    frames : g(r) of each frame (f, bins) of each run. Filled (bins,) : neighbours where g is 1
    """
    width = r[1] - r[0]
    edges = np.append(r - 0.5 * width, r[-1] + 0.5 * width)

    def valley(g: np.ndarray, top: int) -> float:
        """Position of the first minimum after a peak, from a fit of a cubic, as single bins are
        noisy."""
        low = top + int(np.argmin(g[top : top + max(3, int(0.9 * top))]))
        reach = max(2, (low - top) // 3)
        near = slice(max(top, low - reach), low + reach + 1)
        skew, bend, tilt, _ = (
            np.polyfit(r[near] - r[low], g[near], 3) if len(r[near]) > 4 else np.zeros(4)
        )
        root = bend**2 - 3 * skew * tilt
        shift = -tilt / (bend + np.sqrt(root)) if bend > 0 and root >= 0 else 0.0
        return float(r[low] + np.clip(shift, -reach * width, reach * width))

    def within(g: np.ndarray, end: float) -> np.ndarray:
        """Neighbours up to a distance, of g (..., bins)."""
        fraction = np.clip((end - edges[:-1]) / width, 0.0, 1.0)  # of each bin
        return (g * filled) @ fraction

    def peak_of(g: np.ndarray, top: int) -> np.ndarray:
        low, middle, high = g[top - 1 : top + 2]
        shift = _shift_of_vertex(low, middle, high)
        position = r[top] + shift * width
        height = middle - 0.25 * (low - high) * shift
        return np.array([position, height, within(g, valley(g, top))])

    def peak_near(g: np.ndarray) -> np.ndarray:
        return peak_of(g, around.start + int(g[around].argmax()))

    g = runs.mean([of_run.mean(axis=0) for of_run in frames])
    top = _first_top(g)
    if g.max() < 1.05 or not 0 < top < len(g) - 3:
        return []
    peak = peak_of(g, top)
    around = slice(max(1, top - max(3, top // 5)), min(len(g) - 3, top + max(3, top // 5) + 1))
    end = valley(g, top)
    inside = [within(of_run, end) for of_run in frames]
    tau = correlation_time_of(runs, inside) if min(map(len, frames)) > 2 else None
    errors: list[float | None] = [None] * 3
    if runs.are_several:
        errors = runs.estimate([of_run.mean(axis=0) for of_run in frames], peak_near)[1].tolist()
    elif len(frames[0]) >= 2 * BLOCKS:
        samples = max(
            inefficiency(series - series.mean()) for series in (frames[0][:, top], inside[0])
        )
        of_blocks, left_out = _errors_over_blocks(frames[0], peak_near, samples)
        errors = np.maximum(of_blocks, left_out).tolist()
        # jumps of the minimum count once
        errors[2] = float(np.hypot(of_blocks[2], left_out[2]) / np.sqrt(2))
    titles = (
        ("first peak", "Å"),
        ("height of that peak", "1"),
        ("neighbours up to the first minimum", "1"),
    )
    return [
        Value(f"g {name}: {title}", unit, float(value), None if e is None else float(e), tau)
        for (title, unit), value, e in zip(titles, peak, errors, strict=True)
    ]


def _shift_of_vertex(low: float, middle: float, high: float) -> float:
    """Where the parabola through three points at -1, 0, 1 has its highest point, 0 if it has
    none."""
    bend = low - 2 * middle + high
    return float(0.5 * (low - high) / bend) if bend < 0 else 0.0


def _errors_over_blocks(
    frames: np.ndarray, conclude: Callable[[np.ndarray], np.ndarray], samples: float
) -> Measured:
    """Two estimates of standard errors, for quantities that follow from a mean over frames (f,
    ...): the scatter between blocks of frames, whose means are noisy, and the scatter when one
    block after another is omitted, which includes few jumps.

    samples : frames for each independent one
    """
    count = min(PEAK_BLOCKS, len(frames) // 2)
    parts = np.array_split(frames, count)
    total = frames.sum(axis=0)
    without = [(total - part.sum(axis=0)) / (len(frames) - len(part)) for part in parts]
    of_blocks = error_of_mean([conclude(part.mean(axis=0)) for part in parts])
    left_out = (count - 1) * error_of_mean([conclude(mean) for mean in without])
    correlated = np.sqrt(max(LEAST_INDEPENDENT, 1 - 0.5 * samples * count / len(frames)))
    return of_blocks / correlated, left_out / correlated


def _first_top(g: np.ndarray) -> int:
    """Index of the first peak: the highest point from where g exceeds 1 to where it falls below
    1."""
    above = np.flatnonzero(g > 1.0)
    if len(above) == 0:
        return 0
    top = int(above[0])
    for k in range(top, len(g)):
        if g[k] > g[top]:
            top = k
        elif g[k] < 1.0 and k - top > 2:
            break
    return top


@built_in("structure factor S(k) of the centres of mass", position=20, needs=(trajectory, box))
def structure_factor(
    runs: Runs, name: str = "", largest: Annotated[float, Limits(1e-6, 1e3)] = K_MAX
) -> AnalysisResult:
    """S(k) = <|sum exp(i k r)|²>/N of sites, elements or species, from wave vectors of the box.

    Parameters
    ----------
    name : str, optional
        A site, an element or a species. Default: the centres of all molecules
    largest : float, optional
        Largest wave vector, 1/Å
    """
    thinned, notes = _thinned(runs, ENOUGH_MOLECULES_K)
    reciprocal = 2 * np.pi * np.linalg.inv(thinned.mean_cell).T
    shortest = float(heights(reciprocal).min())
    if not largest > shortest:
        why = f"this box has no wave vector shorter than {largest:g} 1/Å"
        raise OutputError(f"{why}. The shortest is {shortest:.3g} 1/Å")
    count = 2 / 3 * np.pi * largest**3 / abs(np.linalg.det(reciprocal))
    if count > MOST_VECTORS:
        fitting = largest * (MOST_VECTORS / count) ** (1 / 3)
        raise OutputError(
            f"this box has {count:.2g} wave vectors below {largest:g} 1/Å, more than"
            f" {MOST_VECTORS:.2g}: use largest={fitting:.2g} or less"
        )
    vectors, bin_of = _k_vectors(reciprocal, largest)
    bins = int(bin_of.max()) + 1
    used, members = np.unique(bin_of, return_inverse=True)

    def of_frames(frames: RigidFrames) -> np.ndarray:
        """S(k) of each frame (f, bins)."""
        values = np.empty((len(frames), len(used)))
        for k in range(len(frames)):
            at = frames.positions[k] if not name else frames.sites(name, slice(k, k + 1))[0][0]
            phases = (at @ np.linalg.inv(frames.cell[k])) @ (2 * np.pi * vectors.T)
            size = np.cos(phases).sum(axis=0) ** 2 + np.sin(phases).sum(axis=0) ** 2
            values[k] = np.bincount(members, size) / np.bincount(members) / len(at)
        return values

    values = [of_frames(run) for run in thinned.members]
    mean, error_of_curve = _mean_of_frames(thinned, values)
    length = np.bincount(members, np.linalg.norm(vectors @ reciprocal, axis=1)) / np.bincount(
        members
    )
    title = f"S {name or 'centres'}"
    curve = Curve("structure_factor", ("k (1/A)", length), "S(k)", {title: mean}, level=1.0)
    vectors_used = f"at most {VECTORS_PER_BIN} k-vectors in each of {bins} bins"
    result = AnalysisResult(
        "structure_factor", "structure factor", curves=[curve], notes=[*notes, vectors_used]
    )
    if error_of_curve is not None:
        curve.errors[title] = error_of_curve
        top = int(np.argmax(mean))
        peak = [of_run[:, top] for of_run in values]
        error = max(float(error_of_curve[top]), mean_of_series(thinned, peak)[1] or 0.0)
        note = f"at {length[top]:.2f} 1/Å, bins of {K_WIDTH} 1/Å"
        tau = correlation_time_of(thinned, peak)
        result.values.append(Value("highest peak of S(k)", "1", float(mean[top]), error, tau, note))
    return result


def _k_vectors(reciprocal: np.ndarray, largest: float) -> tuple[np.ndarray, np.ndarray]:
    """Integer wave vectors (w, 3), one of k and -k, and the bin of each. Evenly chosen in bins with
    many."""
    reach = np.ceil(largest / heights(reciprocal)).astype(int)
    vector_blocks, bin_index = [], []
    for h in range(reach[0] + 1):
        indices = np.array(
            list(product([h], range(-reach[1], reach[1] + 1), range(-reach[2], reach[2] + 1)))
        )
        if h == 0:
            indices = indices[(indices[:, 1] > 0) | ((indices[:, 1] == 0) & (indices[:, 2] > 0))]
        size = np.linalg.norm(indices @ reciprocal, axis=1)
        near = size < largest
        vector_blocks.append(indices[near])
        bin_index.append((size[near] / K_WIDTH).astype(int))
    vectors, bin_of = np.concatenate(vector_blocks), np.concatenate(bin_index)
    chosen_blocks = []
    for k in np.unique(bin_of):
        of_bin = np.flatnonzero(bin_of == k)
        chosen_blocks.append(
            of_bin[np.unique(np.linspace(0, len(of_bin) - 1, VECTORS_PER_BIN).astype(int))]
        )
    chosen = np.concatenate(chosen_blocks)
    return vectors[chosen], bin_of[chosen]


@built_in("profile of the density along an axis of the box", position=30, needs=(trajectory, box))
def density_profile(runs: Runs, axis: Axis = "z", bins: Count | None = None) -> AnalysisResult:
    """Mass density (g/cm³) of each species along an edge of the box.

    Parameters
    ----------
    axis : {"z", "x", "y"}, optional
        The edge c, a or b
    bins : int, optional
        Number of bins along the edge. Default: 100 where the density changes, as in a slab, else 20
    """
    k = "xyz".index(axis)
    height = float(
        runs.mean([np.mean([heights(cell)[k] for cell in run.cell]) for run in runs.members])
    )

    def profile(part: RigidFrames, kind: Kind, bins: int) -> np.ndarray:
        across = np.linalg.inv(part.cell)[:, :, k]
        total = np.zeros(bins)
        for site, mass in enumerate(kind.molecule.masses):
            at = part.positions[:, kind.index]
            if part.Q.shape[1]:
                at = at + part.Q[:, kind.index] @ kind.molecule.positions_body[site]
            inside = np.einsum("fni,fi->fn", at, across) % 1.0
            total += mass * np.bincount(
                np.minimum((inside * bins).astype(int), bins - 1).ravel(), minlength=bins
            )
        return total * bins / len(part) / float(part.volume.mean()) / GRAM_PER_CM3

    def profile_of_all(kinds, bins, part) -> np.ndarray:
        return np.sum([profile(part, kind, bins) for kind in kinds], axis=0)

    if bins is None:
        density = runs.mean([profile_of_all(runs.kinds, FEW_BINS, run) for run in runs.members])
        # the mean over a quarter of the edge: few frames of few molecules scatter
        smooth = np.mean([np.roll(density, k) for k in range(FEW_BINS // 4)], axis=0)
        is_uniform = smooth.min() > LEAST_DENSITY * density.mean()
        bins = FEW_BINS if is_uniform else MANY_BINS
    at = (np.arange(bins) + 0.5) * height / bins
    curve = Curve("density_profile", (f"{axis} (A)", at), "density (g/cm³)", {}, from_zero=True)
    for name in dict.fromkeys(kind.name for kind in runs.kinds):
        of_name = [kind for kind in runs.kinds if kind.name == name]  # frozen and mobile ones
        together = partial(profile_of_all, of_name, bins)
        curve.add(f"density {name} (g/cm3)", *with_block_error(runs, together))
    return AnalysisResult("density_profile", f"density along {axis}", curves=[curve])


@built_in("hydrogen bonds for each molecule, by distances and angles", position=40)
def hydrogen_bonds(
    runs: Runs,
    distance: Annotated[float, Limits(0.1, 20)] = BOND_DISTANCE,
    angle: Annotated[float, Limits(0.1, 180)] = BOND_ANGLE,
) -> AnalysisResult:
    """Mean number of hydrogen bonds of a molecule, as donor and acceptor, between heavy sites (N,
    O, F).

    Parameters
    ----------
    distance : float, optional
        Largest distance of the heavy sites, Å
    angle : float, optional
        Largest angle between their line and the bond of the hydrogen, degrees
    """
    if not any(_donors(kind.molecule) for kind in runs.kinds):
        why = "no molecule has a hydrogen bonded to nitrogen, oxygen or fluorine"
        raise OutputError(f"{why}: there are no hydrogen bonds")
    if runs.has_box and distance > 0.5 * heights(runs.mean_cell).min():
        raise OutputError(f"hydrogen bonds of {distance:g} Å are longer than half the box")
    thinned, notes = _thinned(runs, ENOUGH_MOLECULES)
    number = len(runs.system.model.species)
    # (f, n) each
    bonds = [
        np.array([_bonds(run, k, distance, angle) for k in range(len(run))])
        for run in thinned.members
    ]
    each = [of_run.mean(axis=1) for of_run in bonds]
    value, error = mean_of_series(thinned, each)
    size = int(max(of_run.max() for of_run in bonds)) + 1
    fractions = [[np.mean(of_run == k) for k in range(size)] for of_run in bonds]
    axis = ("hydrogen bonds", np.arange(size))
    curve = Curve(
        "hydrogen_bonds",
        axis,
        "fraction of molecules",
        {"share": thinned.mean(fractions)},
        bars=True,
    )
    about = f"{distance:g} Å, {angle:g}°. Each bond counts for both of its molecules"
    tau = correlation_time_of(thinned, each)
    mean_bonds = Value("hydrogen bonds of a molecule", "1", value, error, tau, about)
    return AnalysisResult(
        "hydrogen_bonds", f"hydrogen bonds of {number} molecules", [mean_bonds], [curve], notes
    )


def _donors(molecule: Molecule) -> list[tuple[int, int]]:
    """(heavy site, hydrogen) of the donors of a molecule."""
    heavy = [k for k, element in enumerate(molecule.elements) if element in BONDING]
    donors = []
    for h in (k for k, element in enumerate(molecule.elements) if element == "H"):
        gaps = np.linalg.norm(molecule.positions_body - molecule.positions_body[h], axis=1)
        gaps[[k for k in range(len(gaps)) if molecule.masses[k] == 0 or k == h]] = np.inf
        if (nearest := int(gaps.argmin())) in heavy:
            donors.append((nearest, h))
    return donors


def _bonds(frames: RigidFrames, frame: int, distance: float, angle: float) -> np.ndarray:
    """Hydrogen bonds of each molecule (n,) in a frame."""
    heavy, owner = [], []
    arms = []  # (sites, 3) to the first hydrogen of each, the second, ...; NaN without one
    arm_count = len(max((_donors(kind.molecule) for kind in frames.kinds), key=len))
    for kind in frames.kinds:
        centre = frames.positions[frame, kind.index]
        rotation = frames.Q[frame, kind.index] if frames.Q.shape[1] else np.eye(3)[None]
        body = kind.molecule.positions_body
        for site in (k for k, element in enumerate(kind.molecule.elements) if element in BONDING):
            heavy.append(centre + rotation @ body[site])
            owner.append(kind.index)
            arm = np.full((arm_count, *centre.shape), np.nan)
            for k, hydrogen in enumerate(h for donor, h in _donors(kind.molecule) if donor == site):
                arm[k] = rotation @ (body[hydrogen] - body[site])
            arms.append(arm)
    at, who = np.concatenate(heavy), np.concatenate(owner)
    pairs, gaps = near_pairs(at, frames.cell[frame] if frames.has_box else None, distance)
    both = np.concatenate([pairs, pairs[:, ::-1]])
    way = np.concatenate([gaps, -gaps])  # from the first to the second
    different = who[both[:, 0]] != who[both[:, 1]]
    both, way = both[different], way[different]
    counts = np.zeros(len(frames.system.model.species))
    for arm in np.concatenate(arms, axis=1):
        to = arm[both[:, 0]]
        cosine = (
            np.einsum("pi,pi->p", to, way)
            / np.linalg.norm(to, axis=1)
            / np.linalg.norm(way, axis=1)
        )
        bonded = cosine > np.cos(np.radians(angle))
        np.add.at(counts, who[both[bonded]].ravel(), 1.0)
    return counts
