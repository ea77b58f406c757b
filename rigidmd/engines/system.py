"""The system of a scene of molecules: what an engine moves."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from math import inf
from typing import Any, NamedTuple, Protocol, cast, runtime_checkable

import numpy as np

from rigidmd.core.quantities import (
    QUANTITIES,
    Quantity,
    energy_of_force,
    restrained_distance,
)
from rigidmd.core.state import State
from rigidmd.core.state_file import SavedState, errors_of_arrays
from rigidmd.dynamics.model import DegreesOfFreedom, Model, mobile
from rigidmd.engines.cpu.engine import CpuEngine, Precision
from rigidmd.engines.sites import Sites
from rigidmd.forces.fields.distances import DistanceRestraint
from rigidmd.forces.neighbors.pair_loop import PairForces
from rigidmd.forces.neighbors.space import Space, space_of, wrap
from rigidmd.forces.parts import Tail, gather_per_molecule
from rigidmd.forces.terms import trait
from rigidmd.formats.bonds import connections
from rigidmd.scene import MolecularScene
from rigidmd.scene.models import Molecule
from rigidmd.units import GRAM_PER_CM3


@runtime_checkable
class TermMaker(Protocol):
    """An object that makes a term for a system."""

    def term(self, system: "System") -> NamedTuple:
        """A NamedTuple of a class with `compiled_force`."""
        ...


@runtime_checkable
class ThermostatOfStages(Protocol):
    """A user-defined thermostat that is made for each stage."""

    def for_stage(self, system: "System", k: int) -> NamedTuple:
        """The thermostat of stage k, of a class with `compiled_thermostat`."""
        ...


@dataclass(frozen=True)
class Extra:
    """What a feature adds to a system, in addition to its terms."""

    #: Name of a term that it adds, whose energy is a column -> description
    user_terms: Mapping[str, str] = field(default_factory=dict)
    #: Name of a term that Python computes -> function
    python_forces: Mapping[str, Callable] = field(default_factory=dict)
    #: In place of the thermostat of every stage
    thermostat: "NamedTuple | ThermostatOfStages | None" = None
    #: Name of a term in place of one of the core -> what it is, for messages
    titles: Mapping[str, str] = field(default_factory=dict)
    #: Columns of the log
    quantities: tuple[Quantity, ...] = ()


@dataclass(frozen=True)
class System:
    """The molecules that a scene describes and the forces on them, which are constant during a run.

    `state` is the start, of which every run takes a copy. It is not for changes, although engines
    need
    it writable: `Simulation.start_from` checks another one.
    """

    scene: MolecularScene  # resolved: every default is filled in
    species: list[Molecule]
    model: Model
    space: Space
    state: State
    terms: dict[str, NamedTuple]
    freedom: DegreesOfFreedom
    constants: dict[str, float]  # constant energies, u Å²/ps²
    constant_pressure: float  # a constant part of the pressure, u/(Å ps²)
    tail: Tail | None  # the tail correction, where the scene requests it
    #: (n,) numbers by which a scene may select molecules: see Molecules.frozen
    residue_number: np.ndarray
    from_lattice: bool
    left_out: list[str]
    precision_reason: str = ""  # where the scene has precision = "auto"
    force_error: float | None = (
        None  # estimated rms error of the Coulomb force on a site, u Å/ps²; with Ewald sums
    )
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)  # of what is allowed and probably not meant
    extras: dict[str, Extra] = field(default_factory=dict)  # by the name of a feature

    def __repr__(self) -> str:
        return f"<System of {self.scene.in_short}>"

    @property
    def user_terms(self) -> dict[str, str]:
        """Name of a term that a feature adds -> description."""
        return {
            name: text for extra in self.extras.values() for name, text in extra.user_terms.items()
        }

    @property
    def python_forces(self) -> dict[str, Callable]:
        """Name of a term that Python computes -> function."""
        return {
            name: f for extra in self.extras.values() for name, f in extra.python_forces.items()
        }

    @property
    def thermostat(self) -> "NamedTuple | ThermostatOfStages | None":
        """User-defined, in place of the thermostat of every stage."""
        given = (extra.thermostat for extra in self.extras.values())
        return next((thermostat for thermostat in given if thermostat is not None), None)

    @cached_property
    def cache(self) -> dict[str, Any]:
        """What features compute once for this system."""
        return {}

    @cached_property
    def sites(self) -> Sites:
        """All sites. Made at the first use, because a run needs them only to write a trajectory."""
        owner = np.repeat(np.arange(len(self.model.species)), self.sites_per_molecule)
        return Sites(
            owner,
            self.of_sites(lambda m: m.positions_body),
            self.of_sites(lambda m: np.array(m.site_names, dtype=object)),
            self.of_sites(lambda m: np.array(m.elements, dtype=object)),
            self.of_sites(lambda m: m.masses),
        )

    @property
    def site_count(self) -> int:
        return int(self.sites_per_molecule.sum())

    @property
    def sites_per_molecule(self) -> np.ndarray:
        """Number of sites of each molecule (n,)."""
        return np.array([len(m.masses) for m in self.species])[self.model.species]

    @cached_property
    def mass(self) -> float:
        """Total mass, u."""
        return float(self.model.mass[self.model.species].sum())

    @property
    def density(self) -> float:
        """Mass density, g/cm³, 0 without a box."""
        return self.mass / self.space.volume / GRAM_PER_CM3

    @property
    def cutoff(self) -> float:
        """Cutoff between sites, Å; inf without one."""
        return self.scene.forces.cutoff_A or inf

    def user_thermostat(self, k: int) -> "NamedTuple | None":
        """The user-defined thermostat in stage k. None without one."""
        if isinstance(self.thermostat, ThermostatOfStages):
            return self.thermostat.for_stage(self, k)
        return self.thermostat

    @property
    def external(self) -> list[str]:
        """Names of the terms of external fields, which may change the total momentum."""
        terms = self.terms.items()
        return [name for name, term in terms if trait(term, "changes_momentum") is not None]

    @property
    def position_dependent(self) -> list[str]:
        """Names of the terms whose energy depends on positions in the lab, which exclude a
        barostat. A field is among them only if a molecule has a net charge."""
        return [name for name, term in self.terms.items() if trait(term, "absolute_positions")]

    @cached_property
    def quantities(self) -> dict[str, Quantity]:
        """The columns of the samples of this scene."""
        rows = [*QUANTITIES.values(), *map(energy_of_force, self.user_terms)]
        rows += [
            restrained_distance(name.rpartition("_")[2], term.observed_distance)
            for name, term in self.terms.items()
            if isinstance(term, DistanceRestraint)
        ]
        rows += [row for extra in self.extras.values() for row in extra.quantities]
        rows += [row for stage in self.scene.stages for row in stage.thermostat_method.quantities]
        return {row.name: row for row in rows}

    @property
    def removes_momentum_every(self) -> float | None:
        """Time between removals of the total momentum, ps. None for never, also where every
        thermostat changes it."""
        moving = [k for k, stage in enumerate(self.scene.stages) if not stage.is_minimisation]
        if any(map(self.keeps_momentum_in, moving)):
            return self.scene.run.remove_momentum_interval_ps or None
        return None

    def keeps_momentum_in(self, k: int) -> bool:
        """Whether the thermostat of stage k leaves the total momentum as it is."""
        if self.thermostat is not None:
            return not getattr(self.thermostat, "changes_momentum", False)
        return self.scene.stages[k].keeps_momentum

    def at_rest_in(self, k: int | None) -> np.ndarray:
        """Whether each component (3,) of the total momentum is kept at zero, in stage k or, with
        None, at the start."""
        return self.model.keeps_momentum & (k is None or self.keeps_momentum_in(k))

    @property
    def last_freedom(self) -> DegreesOfFreedom:
        """Degrees of freedom in the last stage that is not a minimisation."""
        moving = [k for k, stage in enumerate(self.scene.stages) if not stage.is_minimisation]
        return self.freedom_in(moving[-1]) if moving else self.freedom

    def freedom_in(self, k: int) -> DegreesOfFreedom:
        """Degrees of freedom in stage k, with the total momentum if the thermostat changes it."""
        if self.keeps_momentum_in(k):
            return self.freedom
        return self.freedom._replace(translation=3 * int(mobile(self.model).sum()))

    @property
    def smallest_diameter(self) -> float:
        """Smallest Lennard-Jones diameter, or smallest molecular radius without Lennard-Jones
        sites, Å."""
        sigma = [s for m in self.species for s, e in zip(m.sigma, m.epsilon, strict=True) if e > 0]
        return min(sigma or [m.radius for m in self.species if m.radius > 0] or [1.0])

    def saved(self, state: State) -> SavedState:
        """A state as its file holds it, with names and numbers. Frozen and free molecules are one
        species there."""
        names = list(dict.fromkeys(m.name for m in self.species))
        index = np.array([names.index(m.name) for m in self.species])
        first = [next(m for m in self.species if m.name == name).fingerprint for name in names]
        return SavedState(
            state, names, index[self.model.species], self.residue_number, np.array(first)
        )

    @property
    def residue_names(self) -> np.ndarray:
        """Residue name of each molecule (n,) in topology files."""
        return np.array([m.residue_names[0] for m in self.species], dtype=object)[
            self.model.species
        ]

    @property
    def precision(self) -> Precision:
        """Precision of forces. A resolved scene has no "auto"."""
        return cast(Precision, self.scene.precision)

    def state_errors(self, state: State) -> list[str]:
        """Messages on positions, momenta and cell of a state from outside which this system cannot
        have."""
        about = f"the scene has {len(self.state.position)} molecules"
        if errors := errors_of_arrays(state, self.state, about):
            return errors
        cell = np.asarray(state.cell)
        if np.isfinite(cell).all() != np.isfinite(self.state.cell).all():
            return ["one of scene and state has a periodic box, and the other has none"]
        half = min(space_of(cell).edges) / 2
        pair_terms = [term for term in self.terms.values() if isinstance(term, PairForces)]
        reach = [term.potential.cutoff for term in pair_terms]  # type: ignore[attr-defined]
        return [
            f"half the smallest of a_x, b_y, c_z of its box, {half:.4g} Å, is below the cutoff of"
            f" {r:g} Å"
            for r in reach
            if r > half
        ][:1]

    def engine(self) -> CpuEngine:
        return self.engine_of(self.terms, self.precision)

    def engine_of(self, terms: dict[str, NamedTuple], precision: Precision) -> CpuEngine:
        """A new engine for this system with the given terms."""
        scene = self.scene
        virials = any(stage.ensemble == "nph" for stage in scene.stages)
        return CpuEngine(
            self.model,
            terms,
            precision,
            scene.forces.skin_A,
            self.python_forces,
            scene.threads,
            virials,
        )

    def of_sites(self, of: Callable[[Molecule], np.ndarray]) -> np.ndarray:
        """Values of all sites (s,). `of` returns the values of one molecule."""
        return gather_per_molecule([of(m) for m in self.species], self.model.species)

    @property
    def charges(self) -> np.ndarray:
        """Charges (s,) of all sites, e."""
        return self.of_sites(lambda m: m.charges)

    def connections(self, *, massless: bool = False) -> np.ndarray:
        """Pairs (b, 2) of sites that bonds join, see `formats.bonds.connections`."""
        return connections(self, massless=massless)

    def site_positions(self, state: State, wrapped: bool = False) -> np.ndarray:
        """Positions (s, 3) of all sites, lab frame, Å. Molecules are whole; wrapped: centres of
        mass inside the box."""
        placed = state._replace(position=self.centres(state, wrapped))
        return self.positions_of(placed, self.sites.molecule, self.sites.offset_body)

    def positions_of(
        self, state: State, molecule: np.ndarray, offset_body: np.ndarray
    ) -> np.ndarray:
        """Positions (k, 3) of points fixed in molecules (k,) at offsets (k, 3), lab frame, Å, not
        wrapped."""
        return state.position.take(molecule, axis=0) + _lab_offsets(state, molecule, offset_body)

    def centres(self, state: State, wrapped: bool = False) -> np.ndarray:
        """Centres of mass (n, 3), lab frame, Å; wrapped: inside the box."""
        return wrap(space_of(state.cell), state.position) if wrapped else state.position

    def site_velocities(self, state: State) -> np.ndarray:
        """Velocities (s, 3) of all sites, lab frame, Å/ps."""
        owner = self.sites.molecule
        velocity = state.velocity.take(owner, axis=0)
        if len(state.rotation) == 0:
            return velocity
        omega = state.angular_momentum_body * self.model.inverse_inertia[self.model.species]
        lab = np.einsum("nij,nj->ni", state.rotation, omega)
        return velocity + np.cross(
            lab.take(owner, axis=0), _lab_offsets(state, owner, self.sites.offset_body)
        )


def _lab_offsets(state: State, molecule: np.ndarray, offset_body: np.ndarray) -> np.ndarray:
    """Offsets (k, 3) of points from the centres of molecules (k,): from the body frame to the lab
    frame, Å."""
    if len(state.rotation) == 0:
        return np.zeros_like(offset_body)
    # `take` is 4 times faster than indexing
    return np.einsum("sij,sj->si", state.rotation.take(molecule, axis=0), offset_body)
