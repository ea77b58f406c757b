"""Charges of a scene become terms: the law between pairs, what images add, constants of rigid molecules."""

from collections.abc import Callable
from math import inf, pi, sqrt
from typing import Any, NamedTuple

import numpy as np

from rigidmd.assemble.cells import basis_in_words, edges_in_words
from rigidmd.core.state import State
from rigidmd.errors import SceneError
from rigidmd.forces.laws.coulomb import reaction_field, self_energy
from rigidmd.forces.laws.screened import damped_self_energy, damped_shifted_force, screened_coulomb
from rigidmd.forces.pairs.loop import pair_forces
from rigidmd.forces.pairs.sites import BodySites, CentralSites
from rigidmd.forces.pairs.space import Space, cell_of
from rigidmd.forces.waves import corrections, ewald, vectors
from rigidmd.forces.waves.errors import (
    FAREST,
    alpha_for,
    charges_of,
    mesh_error,
    mesh_for,
    radius_of,
    real_error,
    wave_error,
    wave_radius_for,
)
from rigidmd.molecules import Molecule
from rigidmd.scene import MolecularScene
from rigidmd.units import COULOMB, COULOMB_CHARGE, KJ_PER_MOL

#: Along an edge, as forces.ewald_k_max has it: more would take all memory.
MOST_WAVES = 1000
#: A sum of charges smaller than this share of the sum of their sizes is rounding.
NEUTRAL = 1e-10
#: Of the error of real space, what polynomials in single precision may be off by between unit charges. With it the
#: measured error of PME on 4096 waters, 3.3e-5 e²/Å², is what it was with all terms.
FIT_SHARE = 0.02


class Charged(NamedTuple):
    """The charged sites of a system."""

    species: list[Molecule]
    index: np.ndarray  # (n,) species of each molecule
    frozen: np.ndarray  # (n,)
    chosen: list[np.ndarray]  # charged sites of each species
    sites: BodySites | CentralSites
    group: np.ndarray  # (s,) sites of one group do not act on one another

    @property
    def charge_e(self) -> np.ndarray:
        """Charges (s,) in e."""
        return np.concatenate([self.species[k].charges[self.chosen[k]] for k in self.index])

    def each(self, what) -> float:
        """Sum over molecules that move of what(charges (s,) in energy units, positions (s, 3)) of one."""
        total = 0.0
        for k, (m, c) in enumerate(zip(self.species, self.chosen, strict=True)):
            count = int(((self.index == k) & ~self.frozen).sum())
            total += count * what(m.charges[c] * COULOMB_CHARGE, m.positions_body[c]) if count else 0.0
        return total


class Electrostatics(NamedTuple):
    """What charges add to a system."""

    terms: dict[str, NamedTuple]
    constants: dict[str, float]  # u Å²/ps²
    pressure: float = 0.0  # u/(Å ps²), that no motion changes
    force_error: float | None = None  # estimated rms error of the force on a site, u Å/ps²; with Ewald sums
    notes: tuple[str, ...] = ()
    decided: dict[str, Any] | None = None  # keys of forces that the scene left open, with what they became


def electrostatics(
    scene: MolecularScene,
    charged: Charged,
    space: Space,
    cutoff: float,
    start: float,
    state: State,
    basis: np.ndarray,
) -> Electrostatics:
    """What the charges of a scene add. Raises SceneError.

    start : where a switch of the reaction field begins, Å
    basis (3, 3) : integers, the edges of the box in those of the cell that was described, whose waves a scene counts
    """
    forces = scene.forces

    def between_pairs(law: NamedTuple) -> NamedTuple:
        return pair_forces(law, charged.sites, charged.group)

    charge = charged.charge_e
    if forces.electrostatics == "reaction_field":
        law = reaction_field(charge, cutoff, forces.reaction_field_permittivity, forces.truncation, start)
        own = charged.each(lambda q, x: self_energy(law._replace(charge=q), x)) if cutoff < inf else None
        return Electrostatics({"coulomb": between_pairs(law)}, {} if own is None else {"reaction_field_self": own})
    if forces.electrostatics == "damped_shifted_force":
        law = damped_shifted_force(charge, cutoff, forces.damping_per_A)
        own = charged.each(lambda q, x: damped_self_energy(law._replace(charge=q), x))
        return Electrostatics({"coulomb": between_pairs(law)}, {"damped_self": own})
    return _ewald(scene, charged, space, cutoff, between_pairs, state, basis)


def electrostatic_faults(scene: MolecularScene, space: Space, cutoff: float) -> list[str]:
    """What is wrong with a scene's electrostatics in this box."""
    forces = scene.forces
    method = forces.electrostatics
    faults = []
    if method in ("ewald", "pme") and space.volume == inf:
        faults.append(
            f"forces.electrostatics = {method!r} sums over the images of a periodic box, and there is none; "
            "use reaction_field, which without a box is Coulomb's plain law"
        )
    elif method == "damped_shifted_force" and cutoff == inf:
        faults.append("forces.electrostatics = 'damped_shifted_force' ends at a cut-off; give forces.cutoff_A")
    given = {"damped_shifted_force": "damping_per_A", "ewald": "ewald_alpha_per_A", "pme": "ewald_alpha_per_A"}
    if not faults and (key := given.get(method)) and (getattr(forces, key) or 0.0) * cutoff > FAREST:
        faults.append(
            f"forces.{key} = {getattr(forces, key):g} with a cut-off of {cutoff:g} Å screens charges there by "
            f"erfc({getattr(forces, key) * cutoff:.3g}), far below rounding; at most {FAREST / cutoff:.3g} is of use"
        )
    return faults


class Settings(NamedTuple):
    """Of an Ewald sum, and what it leaves out."""

    alpha: float  # 1/Å
    waves: vectors.Waves | None  # of Ewald; of PME those that tell what frozen molecules do to one another
    grid: tuple[int, int, int] | None  # of PME
    order: int | None
    radius: float | None  # of waves, 1/Å, where they are those within one
    real_error: float  # e²/Å², see ewald_errors
    wave_error: float


def _settings(scene: MolecularScene, charged: Charged, space: Space, cutoff: float, basis: np.ndarray) -> Settings:
    """What the scene gives, and what follows from the accuracy it asks for."""
    forces, volume, cell = scene.forces, space.volume, cell_of(space)
    charges = charges_of(
        [
            (int((charged.index == k).sum()), m.charges[c], m.positions_body[c])
            for k, (m, c) in enumerate(zip(charged.species, charged.chosen, strict=True))
        ]
    )
    share = forces.ewald_accuracy / sqrt(2)  # for either part
    asked = f"forces.ewald_accuracy = {forces.ewald_accuracy:g} cannot be had"
    alpha = forces.ewald_alpha_per_A or alpha_for(charges, cutoff, volume, share)
    if alpha * cutoff > FAREST:
        raise SceneError(scene.source, [f"{asked} with a cut-off of {cutoff:g} Å; take a longer one"])
    beyond = real_error(charges, alpha, cutoff, volume)
    reciprocal = 2 * pi * np.linalg.inv(cell).T
    grid, order = _given_grid(scene, basis, cell), forces.pme_order
    if forces.electrostatics == "pme":
        if grid is None or order is None:
            found = mesh_for(charges, alpha, cell, share, order, grid)
            if found is None:
                given = " with the forces.pme_order or pme_grid that is given" if order or grid else ""
                raise SceneError(
                    scene.source,
                    [f"{asked}{given} at alpha = {alpha:.3g} 1/Å; ask for less, or take a longer cut-off"],
                )
            grid, order = found
        left = mesh_error(charges, alpha, cell, grid, order)
        over = None
        if charged.frozen.any():
            over = vectors.waves_within(reciprocal, wave_radius_for(charges, alpha, reciprocal, 1e-3 * left))
        return Settings(alpha, over, grid, order, None, beyond, left)
    radius = forces.ewald_k_radius_per_A
    if forces.gives_waves:
        most = forces.ewald_k_max if isinstance(forces.ewald_k_max, tuple | None) else (forces.ewald_k_max,) * 3
        longest = np.linalg.norm(cell, axis=1).max()
        if radius is not None and most is None and radius * longest > 2 * pi * MOST_WAVES:
            fault = f"forces.ewald_k_radius_per_A = {radius:g} is more than {MOST_WAVES} waves along an edge of the box"
            raise SceneError(scene.source, [fault])
        over = (
            vectors.waves(most, forces.ewald_k2_max, basis)
            if radius is None
            else vectors.waves_within(reciprocal, radius, most, basis)
        )
        if over.total == 0:
            raise SceneError(scene.source, ["forces.ewald_k_max or ewald_k_radius_per_A leaves no wave at all"])
    else:
        radius = wave_radius_for(charges, alpha, reciprocal, share)
        over = vectors.waves_within(reciprocal, radius)
    left = wave_error(charges, alpha, radius_of(over.total, volume), volume)
    return Settings(alpha, over, None, None, radius, beyond, left)


def _given_grid(scene: MolecularScene, basis: np.ndarray, cell: np.ndarray) -> tuple[int, int, int] | None:
    """The grid that a scene gives, if it is one of the cell (3, 3) that stands for its own too. Raises SceneError."""
    grid = scene.forces.pme_grid
    if grid is None or len(set(grid)) == 1 or np.array_equal(basis, vectors.AS_GIVEN):
        return grid
    fault = (
        f"forces.pme_grid = {list(grid)} counts points along edges of a cell that leans too much; the box is that with "
        f"{edges_in_words(cell)}, {basis_in_words(basis)}, and has its own edges. Describe the box by that cell, or "
        "give three equal numbers, or leave pme_grid out"
    )
    raise SceneError(scene.source, [fault])


def _ewald(
    scene: MolecularScene,
    charged: Charged,
    space: Space,
    cutoff: float,
    between_pairs: Callable[[NamedTuple], NamedTuple],
    state: State,
    basis: np.ndarray,
) -> Electrostatics:
    settings = _settings(scene, charged, space, cutoff, basis)
    forces, alpha = scene.forces, settings.alpha
    charge = charged.charge_e * COULOMB_CHARGE
    law = screened_coulomb(charged.charge_e, cutoff, alpha, forces.shifts_ewald, FIT_SHARE * settings.real_error)
    if settings.grid is None:
        over = ewald.EwaldSum(alpha, charge, charged.sites, settings.waves)
        most = " ".join(map(str, settings.waves.most))
        how = f"{settings.waves.total} waves, |n| up to {most}"
        if forces.ewald_k_max is not None and not np.array_equal(basis, vectors.AS_GIVEN):
            how += "; these are the waves that ewald_k_max means in the cell that was described"
    else:
        from rigidmd.forces.waves.mesh import Pme  # rocket-fft is for scenes with PME only

        over = Pme(alpha, charge, charged.sites, settings.grid, settings.order)
        how = f"grid {' x '.join(map(str, settings.grid))}, splines of order {settings.order}"
    terms = {"coulomb_real": between_pairs(law), "coulomb_reciprocal": over}
    constants = {
        # The shift counts all charges inside a charge's cut-off, itself and its molecule among them, which together are
        # about neutral; pairs inside a molecule and the charge itself, no pairs of the loop, are this constant.
        "coulomb_self": charged.each(
            lambda q, x: corrections.self_energy(q, alpha) - 0.5 * law.shift * float(q.sum()) ** 2
        ),
        "coulomb_intramolecular": charged.each(lambda q, x: corrections.intramolecular_energy(q, x, alpha)),
    }
    error = float(np.hypot(settings.real_error, settings.wave_error))
    notes = [
        f"{forces.electrostatics}: alpha {alpha:.6g} 1/Å, cut-off {cutoff:g} Å, {how}"
        + ("" if law.shift == 0 else "; energies of real space shifted to 0 at the cut-off"),
        f"estimated rms error of the force on a site: {error:.2g} e²/Å² = {error * COULOMB / KJ_PER_MOL:.2g} "
        f"kJ/(mol Å); {settings.real_error:.2g} beyond the cut-off, {settings.wave_error:.2g} in the reciprocal part",
    ]
    still = charged.frozen[charged.sites.molecule]
    net, net_still = charge.sum(), charge[still].sum()
    neutral = abs(net) <= NEUTRAL * np.abs(charge).sum()
    if not neutral:
        terms["coulomb_background"] = corrections.background(net**2 - net_still**2, alpha)
        notes.append(
            f"the box has a net charge of {charged.charge_e.sum():+.6g} e; an even background of the opposite charge "
            "makes it neutral, and energies and pressure depend on the size of the box"
        )
    if (permittivity := forces.ewald_surface_permittivity) < inf:
        if not neutral:
            fault = "forces.ewald_surface_permittivity: a box with a net charge has no dipole of its own; leave it out"
            raise SceneError(scene.source, [fault])
        terms["coulomb_surface"] = corrections.surface_dipole(charge, permittivity, charged.sites)
    pressure = 0.0
    if still.any():
        constants["coulomb_frozen"], pressure = _of_frozen(
            charged, charge * still, space, settings, permittivity, state
        )
    decided = {"ewald_alpha_per_A": alpha, "ewald_truncation": "shift" if forces.shifts_ewald else "plain"}
    if settings.radius is not None:
        decided["ewald_k_radius_per_A"] = settings.radius
    if settings.grid is not None and np.array_equal(basis, vectors.AS_GIVEN):  # else it is one of another cell
        decided |= {"pme_grid": tuple(map(int, settings.grid)), "pme_order": settings.order}
    return Electrostatics(terms, constants, pressure, error * COULOMB, tuple(notes), decided)


def _of_frozen(
    charged: Charged, charge: np.ndarray, space: Space, settings: Settings, permittivity: float, state: State
) -> tuple[float, float]:
    """Energy and pressure that take out what frozen molecules do to one another in sums over images: constants.

    charge (s,) : 0 for sites that move
    """
    sites, volume = charged.sites, space.volume
    arms = np.zeros((len(charge), 3))
    if len(state.rotation):
        arms = np.einsum("sij,sj->si", state.rotation[sites.molecule], sites.offsets())
    position = state.position[sites.molecule] + arms
    energy, force, virial = ewald.sum_of(charge, position, cell_of(space), settings.alpha, settings.waves)
    dipole = charge @ position
    surface = 2 * pi / ((2 * permittivity + 1) * volume)
    force -= 2 * surface * charge[:, None] * dipole
    energy += surface * float(dipole @ dipole)
    trace = float(virial.trace()) + 3 * surface * float(dipole @ dipole)
    trace -= 2 * surface * float(dipole @ dipole) + float((force * arms).sum())
    return -energy, -trace / (3 * volume)
