"""What forces and their defaults read of a scene of molecules, its molecules and their masses.

The classes are in packages above this one: `scene.MolecularScene` and its tables,
`scene.models.Molecule` and `dynamics.model.Model`. The protocols here have the attributes that are
used of them.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, Protocol

import numpy as np

if TYPE_CHECKING:
    from rigidmd.forces.potentials.lennard_jones import Mixing
    from rigidmd.forces.potentials.truncation import TruncationName

Vector = tuple[float, float, float]
#: Numbers of grid points along three edges.
Grid = tuple[int, int, int]
#: Keys of [forces] and their values.
KeysAndValues = dict[str, float | str | Grid | None]


class Molecule(Protocol):
    """A rigid molecule with s sites, in its principal frame."""

    @property
    def name(self) -> str: ...
    @property
    def site_names(self) -> Sequence[str]: ...
    @property
    def elements(self) -> Sequence[str]: ...
    @property
    def masses(self) -> np.ndarray: ...  # (s,) u
    @property
    def positions_body(self) -> np.ndarray: ...  # (s, 3) Å
    @property
    def charges(self) -> np.ndarray: ...  # (s,) e
    @property
    def charge(self) -> float: ...  # e
    @property
    def sigma(self) -> np.ndarray: ...  # (s,) Å
    @property
    def epsilon(self) -> np.ndarray: ...  # (s,) u Å²/ps²
    @property
    def dispersion(self) -> np.ndarray: ...  # (s,) see `scene.models.Molecule`
    @property
    def cell(self) -> np.ndarray | None: ...  # (3, 3) Å, of a framework


class Masses(Protocol):
    """The masses and moments of inertia of n molecules."""

    @property
    def species(self) -> np.ndarray: ...  # (n,) species of each molecule
    @property
    def mass(self) -> np.ndarray: ...  # (species,) u
    @property
    def inverse_mass(self) -> np.ndarray: ...  # (species,) 1/u; 0 for a frozen species
    @property
    def inverse_inertia(self) -> np.ndarray: ...  # (species, 3) 1/(u Å²); 0 where the moment is 0


class PairKeys(Protocol):
    """One of forces.pairs."""

    sites: tuple[str, str]
    sigma_A: float
    epsilon_kJ_mol: float


class ForceKeys(Protocol):
    """The table [forces]. Keys without a default in the table are None until they follow from the
    system."""

    cutoff_A: float | None
    truncation: "TruncationName"
    switch_start_A: float | None
    lennard_jones: bool
    mixing: "Mixing"
    tail_correction: bool | None
    dispersion: Literal["cutoff", "ewald", "pme"]
    dispersion_accuracy: float | None
    dispersion_beta_per_A: float | None
    dispersion_order: int | None
    dispersion_grid: Grid | None
    electrostatics: str | None
    reaction_field_permittivity: float
    reaction_field_truncation: "TruncationName | None"
    damping_per_A: float
    ewald_accuracy: float | None
    ewald_cutoff_A: float | None
    ewald_alpha_per_A: float | None
    ewald_k_max: int | Grid | None
    ewald_k2_max: int | None
    ewald_k_radius_per_A: float | None
    ewald_truncation: Literal["plain", "shift"] | None
    ewald_surface_permittivity: float
    ewald_slab: Literal["x", "y", "z"] | None
    pme_order: int | None
    pme_grid: Grid | None

    @property
    def pairs(self) -> Sequence[PairKeys]: ...
    @property
    def sets_k_vectors(self) -> bool: ...


class WallKeys(Protocol):
    """One of fields.walls."""

    kind: Literal["lj93", "harmonic"]
    positions_A: tuple[float, float]
    acts_on: Literal["sites", "centres"]
    sigma_A: float | None
    epsilon_kJ_mol: float | None
    cutoff_A: float | None
    stiffness_kJ_mol_A2: float | None

    @property
    def direction(self) -> int: ...


class RestraintKeys(Protocol):
    """One of fields.restraints."""

    species: str | None
    distance_A: float | None
    position_A: Vector | None

    @property
    def molecules(self) -> object: ...
    @property
    def between(self) -> object: ...
    @property
    def spans(self) -> list[tuple[int, int]]: ...
    @property
    def groups(self) -> tuple[list[int], ...]: ...
    @property
    def stiffness(self) -> Vector: ...


class FieldKeys(Protocol):
    """The table [fields]."""

    electric_V_per_nm: Vector | None
    electric_frequency_per_ps: float | None
    electric_phase_deg: float
    gravity_m_s2: Vector | None

    @property
    def walls(self) -> Sequence[WallKeys]: ...
    def bounds(self, axis: int) -> tuple[float, float] | None: ...


class CouplingKeys(Protocol):
    """The table [coupling]."""

    species: str

    @property
    def lennard_jones(self) -> float: ...


class StartKeys(Protocol):
    """The table [start]."""

    temperature_K: float | None


class StageKeys(Protocol):
    """One of [[stages]]."""

    @property
    def temperatures(self) -> tuple[float, float]: ...


class SceneKeys(Protocol):
    """A scene of molecules, with defaults."""

    @property
    def source(self) -> str: ...
    @property
    def forces(self) -> ForceKeys: ...
    @property
    def fields(self) -> FieldKeys: ...
    @property
    def coupling(self) -> CouplingKeys | None: ...
    @property
    def start(self) -> StartKeys: ...
    @property
    def stages(self) -> Sequence[StageKeys]: ...
