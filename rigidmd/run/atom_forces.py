"""Forces on the atoms of rigid molecules, in two forms that have the same total force and torque on each molecule.

`gradient_forces`: every atom has the force of the rigid motion that follows from the molecule's force F and torque,

    f_i = m_i (F/M + w x y_i),   K w = torque,   K = tr(C) 1 - C,   C = sum m_i y_i (x) r_i,

with the atoms r_i and their positions y_i in the rigid molecule, both from the centre of mass. These forces are minus
the gradient of the energy as a function of atoms to which rigid molecules are fitted with masses m_i, bent or not: a
shift of the atoms rotates the fit by phi, K phi = sum m_i y_i x shift_i. They vanish at a minimum. Constraints on all
distances reduce any other form to them. K is the inertia tensor of molecules that are not bent.

`site_forces`: each atom has the forces on its site. Forces on massless sites are distributed over the atoms. Forces
inside molecules are included; constraints have to balance them.
"""

from typing import Any, Literal, cast

import numpy as np
from scipy.spatial.distance import cdist

from rigidmd.core.state import Load, State
from rigidmd.engines.cpu.engine import CpuEngine
from rigidmd.engines.observables import observe
from rigidmd.engines.system import System
from rigidmd.forces.neighbors.pair_loop import PairForces
from rigidmd.forces.neighbors.sites import BodySites, CentralSites
from rigidmd.forces.potentials.screened_coulomb import ScreenedCoulomb
from rigidmd.io.formats.through_ase import EV
from rigidmd.run.force_errors import forces_inside
from rigidmd.scene.models import Molecule
from rigidmd.units import BAR

#: Distance of a massless site from a linear combination of the atoms that is rounding, as a fraction of the radius.
COMBINATION_TOLERANCE = 1e-9
#: Smaller moments of inertia, as fractions of the largest, are 0, as one moment of linear molecules is.
MIN_MOMENT = 1e-9

#: `gradient_forces` or `site_forces`.
Form = Literal["gradient", "sites"]
#: Components of a stress in ASE: xx, yy, zz, yz, xz, xy.
VOIGT = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))


def ase_results(
    system: System, engine: CpuEngine, state: State, form: Form = "gradient", atoms: np.ndarray | None = None
) -> dict[str, Any]:
    """Energy (eV), forces (a, 3) on the sites with mass (eV/Å) and, in a box, stress (6,) (eV/Å³) as ASE has them.

    The stress is from the molecular virial, without the ideal part: the derivative of the energy for a strain that
    moves centres of mass and rotates nothing, over the volume.
    """
    still = state._replace(
        velocity=np.zeros_like(state.velocity), angular_momentum_body=np.zeros_like(state.angular_momentum_body)
    )
    seen = observe(system, engine, still, energy_unit=EV)
    force = gradient_forces(system, state, seen.load, atoms)
    if form == "sites":
        force = site_forces(system, engine, state, seen.load, atoms)
    found = {"energy": seen.potential, "forces": force / EV}
    if np.isfinite(state.cell).all():
        found["stress"] = np.array([-seen.pressure_tensor_bar[at] for at in VOIGT]) * (BAR / EV)
    return found


def gradient_forces(system: System, state: State, load: Load, atoms: np.ndarray | None = None) -> np.ndarray:
    """Forces (a, 3) on the sites with mass, u Å/ps²: the first form of this file, with the totals of `load`.

    atoms : positions (a, 3) where they are not those of rigid molecules, Å
    """
    return _gradient_forces(system, state, load.force, _torque_lab(state, load), atoms)


def site_forces(
    system: System, engine: CpuEngine, state: State, load: Load, atoms: np.ndarray | None = None
) -> np.ndarray:
    """Forces (a, 3) on the sites with mass, u Å/ps²: the second form, with the totals of `load`.

    engine : has just evaluated `load` at the state. Forces on whole molecules, such as gravity, are in the first form.
    """
    force = np.zeros((system.site_count, 3))
    arm = _site_arms(system, state)
    for name, workspace in engine.workspaces.items():
        sites = getattr(workspace, "sites", None)
        if not hasattr(workspace, "site_force") or not isinstance(sites, BodySites | CentralSites):
            continue
        on_site = np.array(cast(Any, workspace).site_force)
        at = _site_indices(system, sites)
        if name.endswith("reciprocal"):
            real = cast(PairForces, system.terms[name.replace("reciprocal", "real")])
            law = cast(ScreenedCoulomb, real.potential)
            position = (state.position[system.sites.molecule] + arm)[at]
            on_site = on_site + forces_inside(law.charge, position, sites.first, law.alpha)
        np.add.at(force, at, on_site)
    atom = system.sites.mass > 0
    found = force[atom] + _massless_forces_on_atoms(system, state, force)[atom]
    of_atom, n = system.sites.molecule[atom], len(state.position)
    rest = load.force - _sum_per_molecule(of_atom, found, n)
    torque = _torque_lab(state, load) - _sum_per_molecule(
        of_atom, np.cross(_from_centre(system, state, arm, atoms), found), n
    )
    return found + _gradient_forces(system, state, rest, torque, atoms)


def _gradient_forces(
    system: System, state: State, force: np.ndarray, torque: np.ndarray, atoms: np.ndarray | None
) -> np.ndarray:
    atom = system.sites.mass > 0
    of_atom, mass = system.sites.molecule[atom], system.sites.mass[atom, None]
    total = system.model.mass[system.model.species][:, None]
    found = mass * (force / total)[of_atom]
    if len(state.rotation):
        arm = _site_arms(system, state)
        y, r = arm[atom], _from_centre(system, state, arm, atoms)
        moments = _sum_per_molecule(of_atom, mass[..., None] * y[:, :, None] * r[:, None, :], len(force))
        moments = 0.5 * (moments + moments.swapaxes(1, 2))  # it is symmetric where the fit is the best
        tensor = moments.trace(axis1=1, axis2=2)[:, None, None] * np.eye(3) - moments
        turn = np.einsum("nij,nj->ni", np.linalg.pinv(tensor, rcond=MIN_MOMENT, hermitian=True), torque)
        found += mass * np.cross(turn[of_atom], y)
    return found


def _site_arms(system: System, state: State) -> np.ndarray:
    """Positions (s, 3) of sites from their centres of mass, lab frame."""
    return system.site_positions(state) - state.position[system.sites.molecule]


def _from_centre(system: System, state: State, arm: np.ndarray, atoms: np.ndarray | None) -> np.ndarray:
    atom = system.sites.mass > 0
    return arm[atom] if atoms is None else atoms - state.position[system.sites.molecule[atom]]


def _torque_lab(state: State, load: Load) -> np.ndarray:
    if len(state.rotation) == 0:
        return np.zeros_like(load.force)
    return np.einsum("nij,nj->ni", state.rotation, load.torque_body)


def _sum_per_molecule(owner: np.ndarray, values: np.ndarray, n: int) -> np.ndarray:
    found = np.zeros((n, *values.shape[1:]))
    np.add.at(found, owner, values)
    return found


def _site_indices(system: System, sites: BodySites | CentralSites) -> np.ndarray:
    """Index (s,) of the sites of a pair potential among all sites."""
    counts = np.array([len(m.masses) for m in system.species])[system.model.species]
    begin = np.cumsum(counts) - counts
    offset, found = sites.offsets(), np.zeros(len(sites.molecule), int)
    for k, m in enumerate(system.species):
        members = np.flatnonzero(system.model.species == k)
        members = members[np.diff(sites.first)[members] > 0]
        if len(members) == 0:
            continue
        of_first = np.arange(int(sites.first[members[0]]), int(sites.first[members[0] + 1]))
        nearest = cdist(offset[of_first], m.positions_body).argmin(axis=1)
        found[sites.first[members][:, None] + np.arange(len(of_first))] = begin[members][:, None] + nearest
    return found


def _massless_forces_on_atoms(system: System, state: State, force: np.ndarray) -> np.ndarray:
    """Forces (s, 3) on the atoms that are equivalent to the forces (s, 3) on massless sites."""
    found = np.zeros_like(force)
    counts = np.array([len(m.masses) for m in system.species])[system.model.species]
    begin = np.cumsum(counts) - counts
    for k, m in enumerate(system.species):
        bare, heavy = np.flatnonzero(m.masses == 0), np.flatnonzero(m.masses > 0)
        if len(bare) == 0:
            continue
        first = begin[system.model.species == k][:, None]
        rotation = state.rotation if len(state.rotation) else np.tile(np.eye(3), (len(counts), 1, 1))
        Q = rotation[system.model.species == k]
        matrices = np.array([_transfer_matrices(m, int(site)) for site in bare])  # (bare, heavy, 3, 3)
        body = np.einsum("nij,nbi->nbj", Q, force[first + bare])
        found[first + heavy] = np.einsum("nij,bhjk,nbk->nhi", Q, matrices, body)
    return found


def _transfer_matrices(molecule: Molecule, site: int) -> np.ndarray:
    """Matrices (heavy, 3, 3), body frame, from the force on a massless site to forces on the atoms with the same total
    force and torque: by the coefficients of a site that is a linear combination of the atoms, or else the smallest."""
    position, heavy = molecule.positions_body[site], molecule.positions_body[molecule.masses > 0]
    rows = np.vstack([heavy.T, np.ones(len(heavy))])
    weight = np.linalg.lstsq(rows, np.append(position, 1.0), rcond=COMBINATION_TOLERANCE)[0]
    if np.abs(rows @ weight - np.append(position, 1.0)).max() <= COMBINATION_TOLERANCE * max(molecule.radius, 1.0):
        return weight[:, None, None] * np.eye(3)
    totals = np.hstack([np.vstack([np.eye(3), _cross(x)]) for x in heavy])
    return (np.linalg.pinv(totals, rcond=COMBINATION_TOLERANCE) @ np.vstack([np.eye(3), _cross(position)])).reshape(
        -1, 3, 3
    )


def _cross(x: np.ndarray) -> np.ndarray:
    """The matrix (3, 3) of the product x x f."""
    return np.cross(np.eye(3), x)
