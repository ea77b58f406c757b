"""Runs of molecules as `ase.Atoms`. Forces on atoms, in two forms with the same totals on each
molecule.

`gradient_forces`: every atom has the force of the rigid motion that follows from the molecule's
force and torque, minus the energy gradient for atoms to which rigid molecules are fitted. The guide
`ase` has the formula. `site_forces`: each atom has the forces on its site. Forces on massless sites
are distributed over the atoms. Forces inside molecules are included. Constraints have to balance
them.
"""

import contextlib
from collections.abc import Callable
from typing import TYPE_CHECKING, Literal, cast

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.distance import cdist

from rigidmd.core.process import ignore_warnings
from rigidmd.core.state import NOW, State
from rigidmd.core.toml import Json
from rigidmd.engines.cpu.engine import CpuEngine
from rigidmd.engines.observables import observe
from rigidmd.engines.system import System
from rigidmd.forces.ewald.direct_sum import EwaldSum
from rigidmd.forces.neighbors.sites import BodySites, CentralSites
from rigidmd.formats import format_of
from rigidmd.formats.through_ase import EV, atoms_of_sites, atoms_of_system
from rigidmd.formats.through_mdanalysis import TrajectoryReader
from rigidmd.mechanics.rotation import hat
from rigidmd.run.force_errors import HasSiteForces, forces_inside
from rigidmd.run.rigid_fit import kinds_of
from rigidmd.scene.models import Molecule
from rigidmd.units import BAR, KJ_PER_MOL

if TYPE_CHECKING:
    import ase

    from rigidmd.run.results import Results


#: Times of a run that differ by less than this fraction are equal.
SAME_TIME = 1e-9
#: Distance of a massless site from a linear combination of the atoms that is rounding, as a
#: fraction of the radius.
COMBINATION_TOLERANCE = 1e-9
#: Smaller moments of inertia, as fractions of the largest, are 0, as one moment of linear molecules
#: is.
MIN_MOMENT = 1e-9

#: `gradient_forces` or `site_forces`.
Form = Literal["gradient", "sites"]


def atoms_of_results(
    results: "Results", frame: int | slice | str | None
) -> "ase.Atoms | list[ase.Atoms]":
    """See `Results.atoms`."""
    from ase.calculators.singlepoint import SinglePointCalculator

    system, frames = results.system, results._frames
    if not isinstance(system, System):
        raise ValueError("this is a run of a single body, which has no atoms")

    def with_logged_energy(atoms: "ase.Atoms", time: float) -> "ase.Atoms":
        """Atoms with the energy of the log, if it has a line at their time."""
        if len(same := np.flatnonzero(_same(results["time"], time))):
            # after a minimisation that starts then
            energy = results["potential"][same[-1]] * KJ_PER_MOL / EV
            atoms.calc = SinglePointCalculator(atoms, energy=float(energy))
        return atoms

    def final() -> "ase.Atoms":
        """The final state, exactly, with its energy, forces and stress."""
        state = results.state
        last_atoms = atoms_of_system(
            system, state, wrapped=system.scene.output.positions == "wrapped"
        )
        last_atoms.info["time_ps"] = float(state.time[NOW])
        if results._is_stored:
            return with_logged_energy(last_atoms, float(state.time[NOW]))
        last_atoms.calc = SinglePointCalculator(
            last_atoms, **ase_results(system, system.engine(), state)
        )
        return last_atoms

    if frame is None:
        return final()
    if not frames:
        raise ValueError(
            "this run has no frames (output.trajectory = false). atoms() is the final state"
        )
    indices = _frame_indices(frame, len(frames))
    sites = _sites_of_frames(results)
    frames_read = []
    last = results._state
    for k in indices:
        time = frames[k].time
        if k == len(frames) - 1 and last is not None and _same(time, float(last.time[NOW])):
            frames_read.append(final())
        else:
            frames_read.append(with_logged_energy(atoms_of_sites(system, *sites(k), time), time))
    return frames_read if isinstance(indices, range) else frames_read[0]


def _frame_indices(frame: int | slice | str, count: int) -> range | list[int]:
    """Indices of frames: a range for several, a list of one for an index. Raises IndexError,
    ValueError."""
    from ase.utils import string2index

    selection: object = frame
    if isinstance(frame, str):
        with contextlib.suppress(ValueError, TypeError):
            selection = string2index(frame)
    if isinstance(selection, slice) and selection.step != 0:
        return range(count)[selection]
    if not isinstance(selection, int | np.integer):
        raise ValueError(
            f"frame is {frame!r}, must be a number, a slice or a text like '-1' or '::10'"
        )
    if not -count <= selection < count:
        raise IndexError(f"frame {selection} is out of range: this run has {count}")
    return [int(selection) % count]


#: Positions, velocities and cell.
SitesOfFrame = tuple[np.ndarray, np.ndarray | None, np.ndarray | None]


def _sites_of_frames(results: "Results") -> Callable[[int], SitesOfFrame]:
    """A function of k that gives positions, velocities and cell of frame k, from the files if there
    are any."""
    from rigidmd.io.trajectory import read_exactly  # MDAnalysis is slow to import

    exact = next(
        (path for path in results.files if (form := format_of(path)) is not None and form.double),
        None,
    )
    if exact is not None or not results.files:
        frames = results._frames if exact is None else read_exactly(exact)
        return lambda k: frames[k].sites
    with ignore_warnings():  # frames that are not evenly spaced: each has its time
        trajectory = cast(TrajectoryReader, results.universe().trajectory)

    def sites(k: int) -> SitesOfFrame:
        frame = trajectory[k]
        cell = None if frame.dimensions is None else frame.triclinic_dimensions
        return frame.positions, frame.velocities if frame.has_velocities else None, cell

    return sites


def _same(time: ArrayLike, other: float) -> np.ndarray:
    return np.abs(np.subtract(time, other)) <= SAME_TIME * max(abs(other), 1.0)


def ase_results(
    system: System,
    engine: CpuEngine,
    state: State,
    form: Form = "gradient",
    atoms: np.ndarray | None = None,
) -> Json:
    """Energy (eV), forces (a, 3) on the sites with mass (eV/Å) and, in a box, stress (6,) (eV/Å³)
    as ASE has them.

    The stress is from the molecular virial, without the ideal part: the derivative of the energy
    for a strain that moves centres of mass and rotates nothing, over the volume.

    atoms : positions (a, 3) where they are not those of rigid molecules, Å
    """
    from ase.stress import full_3x3_to_voigt_6_stress

    velocity, momentum = np.zeros_like(state.velocity), np.zeros_like(state.angular_momentum_body)
    observation = observe(
        system,
        engine,
        state._replace(velocity=velocity, angular_momentum_body=momentum),
        energy_unit=EV,
    )
    load = observation.load
    torque = np.zeros_like(observation.load.force)
    if len(state.rotation):
        torque = np.einsum("nij,nj->ni", state.rotation, load.torque_body)
    if form == "sites":
        force = site_forces(system, engine, state, load.force, torque, atoms)
    else:
        force = gradient_forces(system, state, load.force, torque, atoms)
    results = {"energy": observation.potential, "forces": force / EV}
    if np.isfinite(state.cell).all():
        results["stress"] = full_3x3_to_voigt_6_stress(-observation.pressure_tensor) * (BAR / EV)
    return results


def gradient_forces(
    system: System, state: State, force: np.ndarray, torque: np.ndarray, atoms: np.ndarray | None
) -> np.ndarray:
    """Forces (a, 3) on the sites with mass, u Å/ps²: the first form of this file.

    force, torque : (n, 3) of the molecules, lab frame
    atoms : as in `ase_results`
    """
    atom = system.sites.mass > 0
    of_atom = system.sites.molecule[atom]
    mass = system.sites.mass[atom, None]
    atom_force = mass * (force / system.model.mass[system.model.species][:, None])[of_atom]
    if len(state.rotation):
        arm, r = _arms(system, state, atoms)
        y = arm[atom]
        moments = _sum_per_molecule(
            of_atom, mass[..., None] * y[:, :, None] * r[:, None, :], len(force)
        )
        # it is symmetric where the fit is the best
        moments = 0.5 * (moments + moments.swapaxes(1, 2))
        tensor = moments.trace(axis1=1, axis2=2)[:, None, None] * np.eye(3) - moments
        turn = np.einsum(
            "nij,nj->ni", np.linalg.pinv(tensor, rcond=MIN_MOMENT, hermitian=True), torque
        )
        atom_force += mass * np.cross(turn[of_atom], y)
    return atom_force


def site_forces(
    system: System,
    engine: CpuEngine,
    state: State,
    force: np.ndarray,
    torque: np.ndarray,
    atoms: np.ndarray | None,
) -> np.ndarray:
    """Forces (a, 3) on the sites with mass, u Å/ps²: the second form, with total force and torque
    (n, 3), lab frame.

    engine : has just evaluated them at the state. Forces on whole molecules, such as gravity, are
        in the first form.
    """
    on_sites = np.zeros((system.site_count, 3))
    arm, from_centre = _arms(system, state, atoms)
    for name, workspace in engine.workspaces.items():
        sites = getattr(workspace, "sites", None)
        if not hasattr(workspace, "site_force") or not isinstance(sites, BodySites | CentralSites):
            continue
        of_term = np.array(cast(HasSiteForces, workspace).site_force)
        at = _site_indices(system, sites)
        if name.endswith("reciprocal"):
            term = cast(EwaldSum, system.terms[name])
            position = (state.position[system.sites.molecule] + arm)[at]
            of_term = of_term + forces_inside(term.charge, position, sites.first, term.smooth)
        np.add.at(on_sites, at, of_term)
    atom = system.sites.mass > 0
    atom_force = on_sites[atom] + _massless_forces_on_atoms(system, state, on_sites)[atom]
    of_atom = system.sites.molecule[atom]
    n = len(state.position)
    remainder = force - _sum_per_molecule(of_atom, atom_force, n)
    torque = torque - _sum_per_molecule(of_atom, np.cross(from_centre, atom_force), n)
    return atom_force + gradient_forces(system, state, remainder, torque, atoms)


def _arms(system: System, state: State, atoms: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Positions from the centres of mass, lab frame: (s, 3) of the sites, (a, 3) of the atoms."""
    arm = system.site_positions(state) - state.position[system.sites.molecule]
    atom = system.sites.mass > 0
    return arm, arm[atom] if atoms is None else atoms - state.position[system.sites.molecule[atom]]


def _sum_per_molecule(owner: np.ndarray, values: np.ndarray, n: int) -> np.ndarray:
    sums = np.zeros((n, *values.shape[1:]))
    np.add.at(sums, owner, values)
    return sums


def _site_indices(system: System, sites: BodySites | CentralSites) -> np.ndarray:
    """Index (s,) of the sites of a pair potential among all sites."""
    offset = sites.offsets()
    indices = np.zeros(len(sites.molecule), int)
    for kind in kinds_of(system):
        has_sites = np.diff(sites.first)[kind.index] > 0
        first = sites.first[kind.index[has_sites]]
        if len(first):
            count = int(sites.first[kind.index[has_sites][0] + 1] - first[0])
            nearest = cdist(
                offset[first[0] : first[0] + count], kind.molecule.positions_body
            ).argmin(axis=1)
            indices[first[:, None] + np.arange(count)] = kind.sites[has_sites][:, nearest]
    return indices


def _massless_forces_on_atoms(system: System, state: State, force: np.ndarray) -> np.ndarray:
    """Forces (s, 3) on the atoms that are equivalent to the forces (s, 3) on massless sites."""
    on_atoms = np.zeros_like(force)
    for kind in kinds_of(system):
        m = kind.molecule
        bare = np.flatnonzero(m.masses == 0)
        heavy = np.flatnonzero(m.masses > 0)
        if len(bare) == 0:
            continue
        if len(state.rotation):
            Q = state.rotation[kind.index]
        else:
            Q = np.tile(np.eye(3), (len(kind.index), 1, 1))
        # (bare, heavy, 3, 3)
        matrices = np.array([_transfer_matrices(m, int(site)) for site in bare])
        body = np.einsum("nij,nbi->nbj", Q, force[kind.sites[:, bare]])
        on_atoms[kind.sites[:, heavy]] = np.einsum("nij,bhjk,nbk->nhi", Q, matrices, body)
    return on_atoms


def _transfer_matrices(molecule: Molecule, site: int) -> np.ndarray:
    """Matrices (heavy, 3, 3), body frame, from the force on a massless site to forces on the atoms
    with the same total force and torque: by the coefficients of a site that is a linear combination
    of the atoms, or else the smallest."""
    position = molecule.positions_body[site]
    heavy = molecule.positions_body[molecule.masses > 0]
    rows = np.vstack([heavy.T, np.ones(len(heavy))])
    weight = np.linalg.lstsq(rows, np.append(position, 1.0), rcond=COMBINATION_TOLERANCE)[0]
    if np.abs(rows @ weight - np.append(position, 1.0)).max() <= COMBINATION_TOLERANCE * max(
        molecule.radius, 1.0
    ):
        return weight[:, None, None] * np.eye(3)
    totals = np.hstack([np.vstack([np.eye(3), hat(x)]) for x in heavy])
    of_site = np.vstack([np.eye(3), hat(position)])
    return (np.linalg.pinv(totals, rcond=COMBINATION_TOLERANCE) @ of_site).reshape(-1, 3, 3)
