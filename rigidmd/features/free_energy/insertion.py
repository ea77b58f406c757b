"""Insertion of trial molecules: excess chemical potential, Henry constant, heat of adsorption
(Widom 1963, J. Chem. Phys. 39, 2808; Frenkel & Smit, section 7.2). See the guide
`chemical_potential`."""

from math import ceil
from typing import Literal, NamedTuple

import numpy as np

from rigidmd.core.state import state_of
from rigidmd.core.statistics import error_of_mean
from rigidmd.errors import InputError, OutputError
from rigidmd.features.analysis.built_in.interfaces import BIN, slab_of
from rigidmd.features.analysis.built_in.thermodynamics import thermal_energy_of
from rigidmd.features.analysis.conditions import (
    box,
    check_conditions,
    equilibrium,
    static,
    trajectory,
)
from rigidmd.features.analysis.files import run_analyses
from rigidmd.features.analysis.options import Count, Seed, Temperature, check_options
from rigidmd.features.analysis.registry import built_in
from rigidmd.features.analysis.result import (
    BLOCKS,
    AnalysisResult,
    Curve,
    Value,
    converged_value,
    correlation_time_of,
    mean_of_series,
    too_short,
)
from rigidmd.features.analysis.rigid_frames import RigidFrames, frames_of_start
from rigidmd.features.analysis.runs import Runs
from rigidmd.features.free_energy.guest import Guest, model_named
from rigidmd.mechanics.rotation import random_rotations
from rigidmd.scene import MolecularScene
from rigidmd.units import BAR, BOLTZMANN, KJ_PER_MOL

TRIALS = 1000  # in each frame
FRAMES = 100  # equal ones, without a run
MOST_TRIALS = 5e7  # 8 bytes each in several arrays
#: The sum of the weights must be worth this number of equal trials, and of equal frames.
FEWEST_TRIALS, FEWEST_FRAMES = 100.0, 5.0
LARGEST = 0.01  # fraction of the trials of which messages give the part of the sum
#: Å³ u⁻¹ (kT)⁻¹ in mol/(kg Pa): 1 u is 1e-3 kg/mol, and 1 bar is 1e5 Pa.
PER_KG_PA = 1e3 * BAR * 1e-5
LARGEST_LOGARITHM = 690.0  # of a number


class Trials(NamedTuple):
    """Trials in the frames of a run.

    volume (f,) Å³; energy (f, t) u/kT, inf where molecules overlap; height (f, t) distance along a
    normal from the middle of a slab, Å, in a profile; lowest : the lowest energy of all runs, u/kT
    """

    volume: np.ndarray
    energy: np.ndarray
    height: np.ndarray
    lowest: float = 0.0

    @property
    def weight(self) -> np.ndarray:
        """exp(-u/kT) over its largest value (f, t)."""
        return np.exp(self.lowest - self.energy)

    @property
    def moments(self) -> np.ndarray:
        """V, V w and V w u/kT, with the weights w, of each frame (3, f)."""
        weight = self.weight
        energy = np.where(weight > 0, self.energy, 0.0)
        mean, product = (values.mean(axis=1) for values in (weight, weight * energy))
        return self.volume * np.array([np.ones(len(mean)), mean, product])


@built_in(
    "excess chemical potential and Henry constant by insertion",
    position=97,
    on_request=True,
    needs=(trajectory, box),
)
def insertion(
    runs: Runs,
    model: str = "",
    trials: Count = TRIALS,
    zero_loading: bool = False,
    axis: Literal["", "x", "y", "z"] = "",
    seed: Seed = 1,
    temperature: Temperature | None = None,
) -> AnalysisResult:
    """Excess chemical potential of a model by trial insertions into the frames of a run, and its
    fugacity or Henry constant; in frozen molecules also the heat of adsorption at zero loading.

    Energies are of the forces of the run, with sums over k-vectors and the tail correction.

    Parameters
    ----------
    model : str, optional
        A species of the run, a shipped model or a .toml file. Default: the first species
    trials : int, optional
        Number of positions and orientations in each frame
    zero_loading : bool, optional
        Whether only the frozen molecules act on the trial molecule
    axis : {"x", "y", "z"}, optional
        Normal of a slab, along which there is a profile. Default: none
    seed : int, optional
        Seed of the trials
    temperature : float, optional
        Temperature with zero_loading, K. Default: the temperature of the run
    """
    if trials * runs.frame_count > MOST_TRIALS:
        raise OutputError(f"insertion has at most {MOST_TRIALS:.0e} trials in all frames together")
    frozen = runs.system.model.inverse_mass[runs.system.model.species] == 0
    if zero_loading and not frozen.any():
        raise OutputError("zero loading needs frozen molecules, and the run has none")
    host = frozen if zero_loading else np.ones(len(frozen), bool)
    if temperature is not None and not zero_loading:
        raise OutputError("insertion at another temperature needs zero_loading=true")
    if not (model or runs.moving):
        raise OutputError("insertion needs a molecule, such as model=methane_trappe")
    if temperature is None:
        check_conditions("insertion", runs, [equilibrium])
        thermal = float(runs.mean([thermal_energy_of(run) for run in runs.members]))
    else:
        check_conditions("insertion", runs, [static])
        thermal = BOLTZMANN * temperature
    if not thermal > 0:
        raise OutputError(
            "insertion needs a temperature above 0 K, from a stage with a thermostat, from"
            " start.temperature_K or, with zero_loading=true, from temperature=300"
        )
    try:
        molecule = model_named(model or runs.moving[0].name, runs.system.species)
        guest = Guest(runs.system, molecule, thermal / BOLTZMANN, host)
        left_out = _left_out(runs, guest, host)
        sets = [
            _trials_of(run, guest, thermal, trials, axis, np.random.default_rng([seed, k]))
            for k, run in enumerate(runs.members)
        ]
    except InputError as error:
        raise OutputError(str(error)) from None
    lowest = min(float(trials.energy.min()) for trials in sets)
    sets = [trials._replace(lowest=lowest if np.isfinite(lowest) else 0.0) for trials in sets]
    result = AnalysisResult("insertion", f"insertion of {molecule.name}")
    result.values = _values(runs, sets, guest, thermal, host, zero_loading=zero_loading)
    if left_out:
        note = "; ".join(filter(None, [result.values[0].note, left_out]))
        result.values[0] = result.values[0]._replace(note=note)
    result.notes = [_note(sets, guest, thermal)]
    if axis:
        result.curves = [_profile(sets, thermal, axis)]
    return result


def results_of_scene(
    path: str, options: dict[str, object]
) -> tuple[list[AnalysisResult], dict[str, str]]:
    """Insertion into the frozen molecules of a scene, without a run: results, and messages on what
    failed. Raises OutputError."""
    check_options([insertion], options)
    model = str(options.get("model", ""))
    runs = Runs((frames_of_start(MolecularScene.read(path), FRAMES, model),))
    results, failed = run_analyses(runs, ["insertion"], options={"zero_loading": True} | options)
    for result in results:  # trials at rest have no time
        result.values = [value._replace(correlation_ps=None) for value in result.values]
    return results, failed


def _left_out(runs: Runs, guest: Guest, host: np.ndarray) -> str:
    """What of the trial molecule or of the run has no part in its energy, for a note. Raises
    OutputError where a value would not be of this molecule."""
    molecule, scene = guest.molecule, runs.system.scene
    name, forces, coupling = molecule.name, scene.forces, scene.coupling
    if coupling is not None and coupling.species == name and coupling.value < 1:
        raise OutputError(
            f"the run scales the interactions of {name} ({coupling.in_short}), and would scale the"
            " trial molecule too: insert a model of another name, or use a run at lambda = 1"
        )
    if not guest.interacts and (molecule.charges.any() or molecule.epsilon.any()):
        raise OutputError(f"no force of the run acts on {name}: see [forces] of its scene")
    acting = [runs.system.species[k] for k in np.unique(runs.system.model.species[host])]
    charged = [other.name for other in acting if other.charges.any()]
    if molecule.charges.any() and charged and forces.electrostatics == "none":
        raise OutputError(
            f"electrostatics = 'none' ignores the charges of {name} and of {', '.join(charged)}:"
            " set forces.electrostatics = 'pme', or insert a model without charges"
        )
    notes = {
        f"no other molecule has a charge, and the charges of {name} act on nothing": (
            molecule.charges.any() and not charged
        ),
        f"forces.lennard_jones is false, also for {name}": (
            molecule.epsilon.any() and not forces.lennard_jones
        ),
        f"the run has {'' if coupling is None else coupling.in_short}": (
            coupling is not None and coupling.value < 1
        ),
    }
    return "; ".join(note for note, applies in notes.items() if applies)


def _trials_of(
    run: RigidFrames,
    guest: Guest,
    thermal: float,
    count: int,
    axis: str,
    rng: np.random.Generator,
) -> Trials:
    shape = (len(run), count)
    energy, height = np.empty(shape), np.zeros(shape)
    slab = slab_of(run, axis) if axis else None
    for f in range(len(run)):
        position = rng.random((count, 3)) @ run.cell[f]
        rotation = run.Q[f] if run.Q.shape[1] else None
        state = state_of(position=run.positions[f], rotation=rotation, cell=run.cell[f])
        energy[f] = guest.energies(state, position, random_rotations(rng, count))
        if slab is not None:
            edge = run.cell[f, slab.axis, slab.axis]
            middle = run.positions[f, 0, slab.axis] - slab.centre[f, 0]
            height[f] = (position[:, slab.axis] - middle + edge / 2) % edge - edge / 2
    return Trials(run.volume, energy / thermal, height)


def _values(
    runs: Runs,
    sets: list[Trials],
    guest: Guest,
    thermal: float,
    host: np.ndarray,
    *,
    zero_loading: bool,
) -> list[Value]:
    """The chemical potential and what follows from it."""
    moments = [trials.moments for trials in sets]
    name = guest.molecule.name
    volume, weight, energy = runs.mean([of_run.mean(axis=1) for of_run in moments])
    why = _why_refused(sets)
    if not weight > 0:
        return [Value(f"mu_ex of {name}", "kJ/mol", None, None, None, why)]
    lowest = sets[0].lowest
    log_weight = np.log(weight) - lowest

    def value(title: str, unit: str, value: float, size: float, changes: list[np.ndarray]) -> Value:
        """A value with an error from what each frame changes in it, in units of `size`."""
        error = mean_of_series(runs, changes)[1]
        error = None if error is None else error * size
        if why:
            return too_short(title, unit, value, error, why)
        tau = correlation_time_of(runs, changes)
        return converged_value(title, unit, value, error, runs.span, tau)

    unit = thermal / KJ_PER_MOL
    ratio = [w / weight - v / volume for v, w, _ in moments]
    mu = (np.log(volume) - log_weight) * unit
    values = [value(f"mu_ex of {name}", "kJ/mol", mu, unit, ratio)]

    def exponential(title: str, unit: str, factor: float, exponent: float) -> Value:
        """A value factor exp(exponent), of which each frame changes a fraction."""
        logarithm = np.log(factor) + exponent
        if abs(logarithm) > LARGEST_LOGARITHM:
            note = f"exp({logarithm:.6g}) is beyond the range of numbers: use mu_ex"
            return Value(title, unit, None, None, None, note)
        number = float(np.exp(logarithm))
        return value(title, unit, number, number, ratio)

    species = runs.system.model.species[host]
    if zero_loading:
        factor = PER_KG_PA / (runs.system.model.mass[species].sum() * thermal)
        heat = [(u - w * energy / weight) / weight for _, w, u in moments]
        return [
            *values,
            exponential(f"Henry constant of {name}", "mol/(kg Pa)", factor, log_weight),
            value(
                f"heat of adsorption of {name}",
                "kJ/mol",
                (1 - energy / weight) * unit,
                unit,
                heat,
            ),
        ]
    if runs.system.model.inverse_mass[species].all():  # nothing is frozen
        same = np.array([runs.system.species[k].name == name for k in species])
        title, count = (
            (f"fugacity of {name}", same.sum())
            if same.any()
            else (f"Henry constant of {name}", len(same))
        )
        values.append(exponential(title, "bar", count * thermal / BAR, -log_weight))
    return values


def _why_refused(sets: list[Trials]) -> str:
    """Why the mean of the weights is not to be trusted; empty if it is."""
    weights = [trials.weight for trials in sets]
    weight = np.sort(np.concatenate([of_run.ravel() for of_run in weights]))[::-1]
    if not weight[0] > 0:
        return f"the molecule overlaps in all of {len(weight)} trials"
    frames = np.concatenate([of_run.sum(axis=1) for of_run in weights])
    worth, of_frames = (w.sum() ** 2 / (w**2).sum() for w in (weight, frames))
    if worth >= FEWEST_TRIALS and of_frames >= FEWEST_FRAMES:
        return ""
    part = weight[: ceil(LARGEST * len(weight))].sum() / weight.sum()
    return (
        f"the largest {LARGEST:.0%} of the trials carry {part:.0%} of the sum, which is worth"
        f" {worth:.2g} equal trials in {of_frames:.2g} frames; {FEWEST_TRIALS:g} in"
        f" {FEWEST_FRAMES:g} are needed"
    ).replace("%", " %")


def _note(sets: list[Trials], guest: Guest, thermal: float) -> str:
    count = sum(trials.energy.size for trials in sets)
    fits = sum(np.count_nonzero(np.isfinite(trials.energy)) for trials in sets)
    return (
        f"{count} trials at {thermal / BOLTZMANN:.5g} K, of which {100 * fits / count:.2f} % do not"
        f" overlap; {'with' if guest.has_tail else 'without'} tail correction"
    )


def _profile(sets: list[Trials], thermal: float, axis: str) -> Curve:
    """The chemical potential against the distance from the middle of a slab, with errors from
    blocks of frames; NaN where the molecule overlaps in all trials."""
    height = np.concatenate([trials.height for trials in sets])
    weight = np.concatenate([trials.weight for trials in sets])
    half = np.abs(height).max()
    count = max(2, round(2 * half / BIN))
    edges = np.linspace(-half, half, count + 1)
    bin_of = np.minimum(((height + half) * (count / (2 * half))).astype(int), count - 1)

    def potential(rows: slice) -> np.ndarray:
        index = bin_of[rows].ravel()
        # `histogram` takes differences of a sum over all bins, in which small weights are lost
        sums = np.bincount(index, weight[rows].ravel(), minlength=count)
        counts = np.bincount(index, minlength=count)
        with np.errstate(divide="ignore", invalid="ignore"):
            logarithm = np.log(np.where(sums > 0, sums / counts, np.nan))
        return thermal / KJ_PER_MOL * (sets[0].lowest - logarithm)

    size = len(height) // BLOCKS
    parts = [potential(slice(k * size, (k + 1) * size)) for k in range(BLOCKS)] if size else []
    values = potential(slice(None))
    errors = error_of_mean(parts) if parts else np.full_like(values, np.nan)
    curve = Curve("insertion", (f"{axis} (A)", (edges[1:] + edges[:-1]) / 2), "mu_ex (kJ/mol)", {})
    curve.add("mu_ex", values, errors)
    return curve
