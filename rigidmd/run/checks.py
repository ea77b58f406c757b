"""Checks that the numbers of a run are still meaningful, and messages if they are not.

No check evaluates forces: the run has states, loads and samples anyway. A failed check starts a
search for its cause.
"""

from collections.abc import Iterable
from math import inf, sqrt
from typing import NamedTuple

import numpy as np

from rigidmd.assemble.start import OVERLAP, close_pairs, every_site
from rigidmd.core.integrators import Scheme
from rigidmd.core.state import Load, State
from rigidmd.dynamics.model import Model
from rigidmd.dynamics.observables import LargestValues, largest_values
from rigidmd.engines.cpu.engine import BehindWallError
from rigidmd.engines.protocol import NotFiniteError
from rigidmd.engines.samples import Sample
from rigidmd.engines.system import System
from rigidmd.errors import SimulationError
from rigidmd.run.failed_check import MIN_INERTIA_FRACTION, ROUNDING, FailedCheck
from rigidmd.scene.models import Molecule
from rigidmd.scene.molecules import Watch, name_of
from rigidmd.units import BOLTZMANN, FEMTOSECOND, KJ_PER_MOL

#: Opposite charges without repulsion count as collapsed below this fraction of the smallest
#: diameter. The hydrogen of a hydrogen bond stays at half of it, in TIP5P at 0.28 from the lone
#: pair, with a barrier at 0.02. The second fraction is for molecules without any repulsion.
CHARGED_OVERLAP, CHARGES_OVERLAP = 0.1, 1.0
#: Maximum number of moves of molecules between two checks.
MOVES_PER_CHECK = 250_000


def check_interval(system: System) -> int:
    """Steps between two checks of molecules, which cost less than 1 % of the steps."""
    return max(20, MOVES_PER_CHECK // len(system.model.species))


class StepCheck:
    """Checks of the next step in a run of molecules, relative to the momenta at the last good
    sample."""

    def __init__(self, system: System, limits: Watch):
        self._system, self._limits = system, limits
        self.thermal = 0.0  # u Å²/ps²; 0 before the first sample
        model = system.model
        # Distances of sites from the axes, in radii: the move of the sites decides how large a
        # rotation may be.
        arms = [axis_distances(m) / (m.radius or 1.0) for m in system.species]
        self._per_momentum = model.inverse_inertia * np.array(arms)  # (species, 3)
        self._most_per_momentum = float(self._per_momentum.max())
        self._diameter = system.smallest_diameter
        # of the lightest, inverse; 0 if all are frozen
        self._mass_root = sqrt(model.inverse_mass.max())
        self._inertia_root = sqrt(model.inertia[model.inertia > 0].min(initial=inf))
        self._deepest_well = max((m.epsilon.max() for m in system.species), default=0.0)

    def rescale(self, kinetic: float) -> None:
        """Set the scale of momenta by a kinetic energy (u Å²/ps²): its kT, or the deepest well if
        that is larger."""
        self.thermal = max(2 * kinetic / max(self._system.freedom.total, 1), self._deepest_well)

    @np.errstate(over="ignore", invalid="ignore")
    def failed_check(
        self,
        state: State,
        load: Load,
        scheme: Scheme,
        dt: float,
        extent: LargestValues | None = None,
    ) -> FailedCheck | None:
        """The failed check of the next step: a force that is not finite, or too large a kick, move
        or rotation.

        load : at this state or at the last kick; extent : of both, if it is known
        """
        if self._is_within_limits(extent or largest_values(state, load), scheme, dt):
            return None
        system = self._system
        limits = self._limits
        model = self._system.model
        for what, values in (("force", load.force), ("torque", load.torque_body)):
            if not np.isfinite(values).all():
                m = int((~np.isfinite(values).all(axis=1)).argmax())
                return FailedCheck(f"the {what} on {molecule_label(system, m)} is not finite", m)
        # a measure (n,), its limit, a message about its largest value
        measures: list[tuple[np.ndarray, float, str]] = []
        if limits.kick and self.thermal > 0:
            size = kicks(model, load, self.thermal, dt * max(map(abs, scheme.kicks)))
            times = f"by {size.max():.3g} times its thermal size (watch.kick = {limits.kick:g})"
            measures.append((size, limits.kick, f"one kick changes a momentum of {{}} {times}"))
        stride = dt * max(map(abs, scheme.drifts))
        between = "between two force evaluations"
        if limits.move:
            way = stride * np.sqrt((state.velocity**2).sum(axis=1)) * load.force.any(axis=1)
            part = (
                f"{way.max() / self._diameter:.3g} of the smallest diameter (watch.move ="
                f" {limits.move:g})"
            )
            measures.append(
                (
                    way / self._diameter,
                    limits.move,
                    f"{{}} moves {way.max():.3g} Å {between}, {part}",
                )
            )
        if limits.turn_rad and len(state.rotation):
            omega = state.angular_momentum_body * self._per_momentum[model.species]
            angle = stride * np.sqrt((omega**2).sum(axis=1)) * load.torque_body.any(axis=1)
            message = (
                f"{{}} rotates by {angle.max():.3g} rad {between} (watch.turn_rad ="
                f" {limits.turn_rad:g})"
            )
            measures.append((angle, limits.turn_rad, message))
        for size, limit, message in measures:
            if size.max() > limit:
                m = int(size.argmax())
                return FailedCheck(
                    message.format(molecule_label(system, m)), m, factor=size[m] / limit
                )
        return None

    def _is_within_limits(self, largest: LargestValues, scheme: Scheme, dt: float) -> bool:
        """Whether all loads are finite and no molecule can exceed a limit, by the largest of all
        forces and velocities.

        It is nearly always true, and many times as fast as a check of each molecule."""
        limits = self._limits
        stride = dt * max(map(abs, scheme.drifts))
        if not largest.force + largest.torque < inf:
            return False
        if limits.kick and self.thermal > 0:
            kick = dt * max(map(abs, scheme.kicks)) / sqrt(self.thermal)
            if (
                not kick * max(largest.force * self._mass_root, largest.torque / self._inertia_root)
                <= limits.kick
            ):
                return False
        if limits.move and not sqrt(3) * stride * largest.velocity <= limits.move * self._diameter:
            return False
        angle = sqrt(3) * stride * largest.angular_momentum * self._most_per_momentum
        return not limits.turn_rad or angle <= limits.turn_rad


def axis_distances(molecule: Molecule) -> np.ndarray:
    """Largest distances (3,) of a molecule's sites from its principal axes, Å."""
    square = molecule.positions_body**2
    return np.sqrt((square.sum(axis=1, keepdims=True) - square).max(axis=0))


def check_sample(system: System, limits: Watch, since: Sample, now: Sample) -> FailedCheck | None:
    """The failed check of a sample: Q, or the change of the conserved energy since an earlier
    sample of the stage.

    The change is compared with the earlier kinetic energy plus the potential energy released since,
    or with the kinetic energy at a thermostat's temperature if that is larger. In a minimisation
    only Q is checked.
    """
    stage = system.scene.stages[now.stage]
    fraction = 1.0
    if limits.orthogonality and not now.orthogonality_error <= limits.orthogonality:
        message = (
            f"|QᵀQ - 1| is {now.orthogonality_error:.2g} (watch.orthogonality ="
            f" {limits.orthogonality:g})"
        )
        return FailedCheck(f"a matrix Q is not a rotation: {message}", rotation_not_orthogonal=True)
    if stage.is_minimisation:
        return None
    grown = now.volume * 1e3 / system.state.volume if stage.has_barostat else 1.0
    if limits.volume and grown > limits.volume:
        message = (
            f"the box has grown to {grown:.3g} volumes of the start (watch.volume ="
            f" {limits.volume:g})"
        )
        return FailedCheck(f"{message}, {now.density:.3g} g/cm³", evaporated=True)
    if not limits.energy:
        return None
    kinetic = since.kinetic
    per_kelvin = 0.5 * BOLTZMANN / KJ_PER_MOL
    if stage.has_thermostat:
        kinetic = max(
            kinetic, per_kelvin * max(stage.temperatures) * system.freedom_in(now.stage).total
        )
        if now.time > since.time:
            fraction = min(1.0, stage.thermostat_time / (now.time - since.time))
        else:
            fraction = 1.0
    drift = now.drift - (since.drift if since.stage == now.stage else 0.0)
    if np.isnan(drift):  # another engine, which does not count the heat of its thermostat
        return None
    # constants of sums over images may cancel the rest of the potential, but not its rounding
    rounded = abs(now.potential) + sum(map(abs, system.constants.values())) / KJ_PER_MOL
    scale = kinetic + max(0.0, since.potential - now.potential) + ROUNDING * rounded
    if abs(drift) * fraction <= limits.energy * scale:
        return None
    n = len(system.model.species)
    return FailedCheck(
        f"the conserved energy changed by {drift / n:.3g} kJ/mol per molecule in"
        f" {now.time - since.time:g} ps, {abs(drift) * fraction / scale if scale else inf:.3g}"
        f" kinetic energies (watch.energy = {limits.energy:g})"
    )


def molecule_label(system: System, molecule: int) -> str:
    """Number (from 1) and species of a molecule."""
    return f"molecule {molecule + 1} ({system.species[system.model.species[molecule]].name})"


class OverlappingPair(NamedTuple):
    """Two sites whose cores overlap."""

    first: int
    second: int
    distance: float  # Å
    fraction: float  # of their diameter; of the smallest one of the scene if they have none
    without_repulsion: bool  # opposite charges without repulsion between them


def site_labels(system: System, pair: OverlappingPair) -> list[str]:
    """Names of both sites of a pair, each with its molecule."""
    sites = system.sites
    return [
        f"{sites.name[k]} of {molecule_label(system, sites.molecule[k])}"
        for k in (pair.first, pair.second)
    ]


def most_overlapping_pair(
    system: System, state: State, molecule: int | None
) -> OverlappingPair | None:
    """The pair of sites that overlaps most, preferably one of this molecule. None without such a
    pair."""
    if not np.abs(state.position).max() * np.finfo(float).eps < 1e-3 * system.smallest_diameter:
        return None  # a coordinate is too large to resolve distances
    sigma = system.of_sites(lambda m: np.where(m.epsilon > 0, m.sigma, 0.0))
    near = system.of_sites(
        lambda m: np.full(len(m.epsilon), CHARGED_OVERLAP if m.epsilon.any() else CHARGES_OVERLAP)
    )
    acts = any(name.startswith("coulomb") for name in system.terms)
    charge = system.of_sites(lambda m: m.charges) if acts else np.zeros(len(sigma))
    pairs = []
    reach = max(OVERLAP * sigma.max(), near.max() * system.smallest_diameter)
    for i, j, distance in close_pairs(system, state, (reach, every_site)):
        repel = sigma[i] > 0 and sigma[j] > 0
        size = (sigma[i] + sigma[j]) / 2 if repel else system.smallest_diameter
        attract = not repel and charge[i] * charge[j] < 0
        if (repel or attract) and distance <= (OVERLAP if repel else max(near[i], near[j])) * size:
            pairs.append(OverlappingPair(i, j, distance, distance / size, attract))
    of_molecule = [
        pair for pair in pairs if molecule in system.sites.molecule[[pair.first, pair.second]]
    ]
    return min(of_molecule or pairs, key=lambda pair: pair.fraction, default=None)


def _first_overlap(
    system: System, molecule: int | None, states: Iterable[tuple[str, State]]
) -> tuple[str, OverlappingPair | None]:
    """Time and sites of the first overlap of this molecule, or else of any."""
    first: tuple[str, OverlappingPair | None] = ("", None)
    for where, state in states:
        if np.isnan(state.cell).any() or not all(
            np.isfinite(a).all() for a in (state.position, state.rotation)
        ):
            continue
        pair = most_overlapping_pair(system, state, molecule)
        if pair is not None and (
            molecule is None or molecule in system.sites.molecule[[pair.first, pair.second]]
        ):
            return where, pair
        first = first if first[1] else (where, pair)
    return first


def explain(
    system: System,
    error: SimulationError,
    states: Iterable[tuple[str, State]],
    dt: float,
    stable: float | None,
) -> str:
    """The message of a failed check in full: what was observed, the likely cause, what to try.

    states : to search for overlaps, each with a phrase for its time; dt, stable : step and longest
        stable step, ps
    """
    if isinstance(error, NotFiniteError):
        failed = FailedCheck(
            f"{molecule_label(system, error.molecule)} is lost: {error.reason}", error.molecule
        )
    elif isinstance(error, BehindWallError):
        failed = FailedCheck(
            f"{molecule_label(system, error.molecule)} {error.reason}", error.molecule
        )
    elif isinstance(error, FailedCheck):
        failed = error
    else:
        return str(error)
    text = str(failed)
    where, pair = (
        ("", None) if failed.evaporated else _first_overlap(system, failed.molecule, states)
    )
    if pair is not None:
        a, b = site_labels(system, pair)
        whose = "the smallest" if pair.without_repulsion else "their"
        text += (
            f"; {where}{a} and {b} are {pair.distance:.3g} Å apart, {pair.fraction:.2g} of {whose}"
            " diameter"
        )
    return f"{text}. Likely cause: {_user_code(system)}{_cause(system, failed, pair, dt, stable)}"


def _user_code(system: System) -> str:
    """What a user has added to the steps themselves, as a possible cause. Empty without it."""
    rows = {row.name for row in system.scene.integrators} & {
        stage.integrator for stage in system.scene.stages
    }
    if system.thermostat is None:
        named = []
    else:
        named = [f"the thermostat {name_of(system.thermostat)}, from Python"]
    named += [f"the integrator {name}, from the scene" for name in sorted(rows)]
    return f"{' or '.join(named)} (the run without it shows whether), or " if named else ""


def advice_on_repulsion(system: System, pair: OverlappingPair) -> str:
    """What to do if no repulsion acts between two opposite charges."""
    a, b = system.sites.name[[pair.first, pair.second]]
    return (
        "Try giving one of these sites sigma_A and epsilon_kJ_mol, or the pair an entry"
        f' [[forces.pairs]] with sites = ["{a}", "{b}"]'
    )


def _cause(
    system: System,
    failed: FailedCheck,
    pair: OverlappingPair | None,
    dt: float,
    stable: float | None,
) -> str:
    """The likely cause of a failed check, and what to try."""
    shorter = f"a shorter timestep_fs than {dt / FEMTOSECOND:g}"
    if stable is not None and stable < dt:
        shorter = (
            f"timestep_fs below {stable / FEMTOSECOND:.2g}, where the stiffest motion is stable"
        )
    elif failed.factor is not None and failed.factor < 1 / ROUNDING:
        shorter = f"timestep_fs = {dt / failed.factor / FEMTOSECOND:.2g} or less"
    if pair is not None and pair.without_repulsion:
        return (
            "a charge on a site without repulsion has collapsed onto an opposite one."
            f" {advice_on_repulsion(system, pair)}"
        )
    if pair is not None:
        return (
            "these sites overlap: from the start, or because a step was too long. Try a start"
            f" without overlaps, an nvt stage with a short step first, or {shorter}"
        )
    if failed.molecule is not None:
        species = system.species[system.model.species[failed.molecule]]
        even = species.mass * axis_distances(species) ** 2
        fraction = np.divide(species.inertia, even, out=np.ones(3), where=species.inertia > 0)
        if fraction.min() < MIN_INERTIA_FRACTION:
            return (
                f"bad inertia: a moment of {species.name} is"
                f" {species.inertia[fraction.argmin()]:.2g} u Å², {fraction.min():.1g} of that of"
                " its mass at the outermost site, so torques rotate it too fast. Try more of its"
                f" mass on the outer sites, or {shorter}"
            )
    if failed.evaporated:
        return (
            "at this temperature and pressure the liquid boils, or it starts far from its density"
            " under great pressure. Try a higher pressure_bar or a lower temperature_K, an nvt"
            " stage before the barostat, or watch.volume = false for a gas"
        )
    if failed.rotation_not_orthogonal:
        return (
            "Q was not a rotation at the start or was changed from outside: a run only multiplies"
            " rotations. Try the start from which the last good state came. A very long run may"
            " raise watch.orthogonality"
        )
    return f"timestep_fs is too long for this motion. Try {shorter}, or an nvt stage first"


def kicks(model: Model, load: Load, thermal: float, dt: float) -> np.ndarray:
    """Largest kick of each molecule (n,) in a step, relative to the thermal size of that momentum.

    A kick F dt beyond sqrt(m kT), or n dt beyond sqrt(I kT), comes from an overlap, not from a
    liquid. The measure is relative to the masses, temperature and time step of the scene.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        largest = (
            np.abs(load.force).max(axis=1)
            * dt
            * np.sqrt(model.inverse_mass[model.species] / thermal)
        )
        turn = (
            np.abs(load.torque_body)
            * dt
            / np.sqrt(model.inertia[model.species] * thermal)[: len(load.torque_body)]
        )
    turn = np.where((model.inertia[model.species] > 0)[: len(turn)], turn, 0.0)
    largest[: len(turn)] = np.maximum(largest[: len(turn)], turn.max(axis=1, initial=0.0))
    return largest
