"""One or two flat walls perpendicular to an axis of the lab, which act on sites at unwrapped
positions.

See the theory chapter `interactions`. The Lennard-Jones 9-3 wall is not defined on and behind the
wall: a site there ends the evaluation with BEHIND_WALL.
"""

from collections.abc import Sequence
from math import inf, isnan
from typing import NamedTuple

import numpy as np

from rigidmd.compile import chosen_by_type, implements, is_a, kernel
from rigidmd.core.state import BEHIND_WALL, NOT_FINITE, OK, State
from rigidmd.forces.neighbors.sites import BodySites, CentralSites, locate_site, sites_of
from rigidmd.forces.neighbors.space import Orthorhombic, Unbounded
from rigidmd.forces.parts import SystemParts
from rigidmd.forces.terms import add_forces
from rigidmd.scene.fields import Walls
from rigidmd.scene.models import Molecule
from rigidmd.units import KJ_PER_MOL

#: Distance of the well of a Lennard-Jones wall, in sigma, at which a lattice of molecules starts.
WELL = (2 / 5) ** (1 / 6)


class LennardJonesWalls(NamedTuple):
    """Lennard-Jones 9-3 walls, the same for all sites that they act on."""

    axis: int  # 0, 1, 2 for x, y, z
    lower: float  # Å; -inf for none
    upper: float  # Å; inf for none
    sigma: float  # Å
    epsilon: float  # u Å²/ps²
    cutoff: float  # Å; inf for none
    sites: BodySites | CentralSites

    absolute_positions = True

    @property
    def changes_momentum(self) -> np.ndarray:
        """Components (3,) of the total momentum that they change: the component across them."""
        return np.arange(3) == self.axis

    def behind(self, state: State) -> tuple[int, str] | None:
        """The molecule of the site that is furthest behind a wall, or on it, and where. None if all
        are in front."""
        m = self.sites.molecule
        x = state.position[m, self.axis]  # of the sites
        if isinstance(self.sites, BodySites):
            x = x + np.einsum("sj,sj->s", state.rotation[m, self.axis], self.sites.offsets())
        if not len(x):
            return None
        site, depth = max(
            ((int(x.argmin()), self.lower - x.min()), (int(x.argmax()), x.max() - self.upper)),
            key=lambda end: end[1],
        )
        if depth < 0:
            return None
        wall = self.lower if x[site] <= self.lower else self.upper
        axis = "xyz"[self.axis]
        return (
            int(m[site]),
            f"has a site at {axis} = {x[site]:.6g} Å, behind the wall at {axis} = {wall:g} Å",
        )


class HarmonicWalls(NamedTuple):
    """Harmonic walls, which act only on sites behind them."""

    axis: int
    lower: float
    upper: float
    stiffness: float  # u/ps²
    sites: BodySites | CentralSites

    changes_momentum = LennardJonesWalls.changes_momentum
    absolute_positions = True


def term(
    parts: SystemParts, walls: Walls, where: str, errors: list[str]
) -> LennardJonesWalls | HarmonicWalls:
    """The term of one of fields.walls. The messages on the gap between walls follow those on the
    last of them."""
    points = _acted_on(walls, parts.species, parts.moves)
    index = parts.model.species
    errors += [
        f"{where}: {m.name} has no site with Lennard-Jones parameters, and would pass the walls. "
        "Use acts_on = 'centres'"
        for m, offsets, free in zip(parts.species, points, parts.moves, strict=True)
        if free and not len(offsets)
    ]
    sites = sites_of(index, points, parts.model.inverse_inertia)
    positions = (walls.direction, *walls.positions_A)
    if walls.kind == "harmonic":
        term_of_walls = HarmonicWalls(*positions, walls.stiffness_kJ_mol_A2 * KJ_PER_MOL, sites)
    else:
        epsilon = walls.epsilon_kJ_mol * KJ_PER_MOL
        cutoff = walls.cutoff_A or inf
        term_of_walls = LennardJonesWalls(*positions, walls.sigma_A, epsilon, cutoff, sites)
        if (behind := term_of_walls.behind(parts.state)) is not None:
            m, reason = behind
            errors.append(
                f"{where}: at the start, molecule {m + 1} ({parts.species[index[m]].name}) {reason}"
            )
    if walls is parts.scene.fields.walls[-1]:
        errors += _gap_errors(parts)
    return term_of_walls


def sentence(walls: Walls, term: LennardJonesWalls | HarmonicWalls) -> str:
    """What `rigidmd check` prints of it."""
    kind = f"harmonic, {walls.stiffness_kJ_mol_A2 or 0:g} kJ/mol/Å²"
    if walls.kind == "lj93":
        kind = (
            f"Lennard-Jones 9-3, sigma {walls.sigma_A:g} Å, epsilon {walls.epsilon_kJ_mol:g}"
            " kJ/mol, "
        )
        kind += f"cutoff {walls.cutoff_A:g} Å" if walls.cutoff_A else "no cutoff"
    what = "centres of mass" if walls.acts_on == "centres" else f"{len(term.sites.molecule)} sites"
    positions = [f"{walls.axis} = {x:g} Å" for x in walls.positions_A if abs(x) < inf]
    return f"at {' and '.join(positions)}, on {what}: {kind}"


def _acted_on(walls: Walls, species: Sequence[Molecule], moves: np.ndarray) -> list[np.ndarray]:
    """Points (k, 3) of each species on which walls act, body frame, Å. None of frozen species."""
    offsets = [
        np.zeros((1, 3)) if walls.acts_on == "centres" else m.positions_body[m.epsilon > 0]
        for m in species
    ]
    return [points if free else points[:0] for points, free in zip(offsets, moves, strict=True)]


def _gap_errors(parts: SystemParts) -> list[str]:
    """Messages on walls that do not fit into a periodic box, or too close to their periodic
    images."""
    fields = parts.scene.fields
    space = parts.space
    if isinstance(space, Unbounded):
        return []
    if not isinstance(space, Orthorhombic):
        return ["fields.walls need a box with right angles, or none"]
    errors = []
    cutoff = parts.scene.forces.cutoff_A or inf
    for axis, name in enumerate("xyz"):
        if (bounds := fields.bounds(axis)) is None:
            continue
        protrusion = min(
            _protrusion(walls, parts) for walls in fields.walls if walls.direction == axis
        )
        width = bounds[1] - bounds[0]
        edge = space.edges[axis]
        least = width + 2 * protrusion + cutoff
        if edge < least:
            sites = f", {2 * protrusion:.3g} Å by which sites may protrude," if protrusion else ""
            errors.append(
                f"fields.walls: along {name} the box is {edge:g} Å, and must be {least:.6g} Å at"
                f" least: {width:g} Å between the walls{sites} and the cutoff of {cutoff:g} Å, so"
                " that molecules at one wall do not interact with periodic images of molecules at"
                " the other"
            )
    return errors


def _protrusion(walls: Walls, parts: SystemParts) -> float:
    """Largest distance of interacting sites from the points on which walls act, Å."""
    farthest = 0.0
    for m, points in zip(parts.species, _acted_on(walls, parts.species, parts.moves), strict=True):
        acting = m.positions_body[(m.epsilon > 0) | (m.charges != 0)]
        if len(points) and len(acting):
            distance = np.linalg.norm(acting[:, None] - points, axis=2).min(axis=1)
            farthest = max(farthest, float(distance.max()))
    return farthest


def range_of_centres(walls: Walls, species: Sequence[Molecule]) -> tuple[float, float]:
    """Range (lower, upper) of centres of mass that is free for every orientation between walls,
    Å."""
    points = np.concatenate(_acted_on(walls, species, np.ones(len(species), bool)))
    margin = float(np.linalg.norm(points, axis=1).max(initial=0.0))
    margin += WELL * walls.sigma_A if walls.kind == "lj93" else 0.0
    return walls.positions_A[0] + margin, walls.positions_A[1] - margin


@chosen_by_type(inline=True)
def add_site_force(sites, state, load, m, i, axis, force):
    """Add a force along a lab axis on site i of molecule m to the force and torque on the
    molecule."""
    if is_a(sites, CentralSites):

        def push_centre(sites, state, load, m, i, axis, force):
            load.force[m, axis] += force

        return push_centre

    def push_off_centre(sites, state, load, m, i, axis, force):
        load.force[m, axis] += force
        offset = sites.offset_body[sites.kind[m] - sites.first[m] + i]
        row = state.rotation[m, axis]  # the lab axis in the body frame
        for k in range(3):
            a, b = (k + 1) % 3, (k + 2) % 3
            load.torque_body[m, k] += force * (offset[a] * row[b] - offset[b] * row[a])

    return push_off_centre


@implements(add_forces, LennardJonesWalls)
def _add_lennard_jones_walls(term, state, load, tally):
    at_cutoff = _lj93(term.sigma / term.cutoff)[0]
    for m in range(len(state.position)):
        for i in range(term.sites.first[m], term.sites.first[m + 1]):
            x = locate_site(term.sites, state, m, i)[term.axis]
            for outward, distance in ((1.0, x - term.lower), (-1.0, term.upper - x)):
                if not distance > 0:
                    return NOT_FINITE if isnan(distance) else BEHIND_WALL
                if distance < term.cutoff:
                    energy, slope = _lj93(term.sigma / distance)
                    force = outward * term.epsilon * slope / distance
                    add_site_force(term.sites, state, load, m, i, term.axis, force)
                    if tally is not None:
                        tally[0] += term.epsilon * (energy - at_cutoff)
    return OK


@kernel(inline=True)
def _lj93(s):
    """(2/15) s^9 - s^3 with s = sigma/d, and -d times its derivative by d."""
    s3 = s * s * s
    s9 = s3 * s3 * s3
    return 2 / 15 * s9 - s3, 6 / 5 * s9 - 3 * s3


@implements(add_forces, HarmonicWalls)
def _add_harmonic_walls(term, state, load, tally):
    for m in range(len(state.position)):
        for i in range(term.sites.first[m], term.sites.first[m + 1]):
            x = locate_site(term.sites, state, m, i)[term.axis]
            for outward, depth in ((1.0, term.lower - x), (-1.0, x - term.upper)):
                if depth > 0:
                    force = outward * term.stiffness * depth
                    add_site_force(term.sites, state, load, m, i, term.axis, force)
                    if tally is not None:
                        tally[0] += 0.5 * term.stiffness * depth * depth
    return OK
