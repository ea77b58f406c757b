"""Of the scene of molecules: what acts on them from outside."""

from math import inf
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, Strict, field_validator

from rigidmd.scene.species import ResidueNumber, checked_numbers, spans
from rigidmd.scene.validation import MOST_TABLES, NonNegative, Number, Positive, Section, Vector

if TYPE_CHECKING:
    from rigidmd.scene.molecules import MolecularScene

AXES = "xyz"

Edge = Annotated[float, Strict()]

#: Keys of `Walls` that only one kind knows, and whether it needs them.
KEYS_OF_WALLS = {
    "lj93": {"sigma_A": True, "epsilon_kJ_mol": True, "cutoff_A": False},
    "harmonic": {"stiffness_kJ_mol_A2": True},
}


class Walls(Section):
    """Two flat walls that molecules stay between."""

    axis: Literal["x", "y", "z"]
    """The axis of the lab that they are perpendicular to"""
    kind: Literal["lj93", "harmonic"]
    """lj93: (2/15) (sigma/d)^9 - (sigma/d)^3, times epsilon, at a distance d; harmonic: stiffness/2 d² at a depth d
    behind the wall, nothing before it"""
    positions_A: tuple[Edge, Edge]
    """Where they are along the axis, the lower one first; without a box -inf or inf for none"""
    acts_on: Literal["sites", "centres"] = "sites"
    """sites: those with Lennard-Jones parameters; centres: centres of mass"""
    sigma_A: Positive | None = None
    """Of lj93: diameter"""
    epsilon_kJ_mol: Positive | None = None
    """Of lj93: strength; the well is 1.054 times as deep"""
    cutoff_A: Positive | None = None
    """Of lj93: distance from which on a wall does nothing; its energy is shifted to 0 there. None when not given"""
    stiffness_kJ_mol_A2: Positive | None = None
    """Of harmonic: stiffness"""

    def _faults(self):
        for kind, keys in KEYS_OF_WALLS.items():
            given = [key for key in keys if getattr(self, key) is not None]
            if kind != self.kind and given:
                yield f"{', '.join(given)} would do nothing with kind = {self.kind!r}"
            missing = [key for key, needed in keys.items() if needed and key not in given]
            if kind == self.kind and missing:
                yield f"kind = {kind!r} needs {' and '.join(missing)}"
        lower, upper = self.positions_A
        if not lower < upper:
            yield f"positions_A = [{lower:g}, {upper:g}]: the first must be below the second"
        elif (lower, upper) == (-inf, inf):
            yield "positions_A = [-inf, inf] is no wall at all"
        elif lower == inf or upper == -inf:
            yield f"positions_A = [{lower:g}, {upper:g}] leaves no place between them"

    @property
    def direction(self) -> int:
        """0, 1, 2 for x, y, z."""
        return AXES.index(self.axis)


class Restraint(Section):
    """Springs that hold centres of mass where they are at the start, or at one place."""

    species: str | None = None
    """The species whose molecules are held; needed where there are several"""
    molecules: tuple[ResidueNumber, ...] | str | None = None
    """Which of them: numbers, [1, 2, 5] or "1-10, 15", as for `frozen`; all when not given"""
    stiffness_kJ_mol_A2: NonNegative | tuple[NonNegative, NonNegative, NonNegative]
    """Stiffness; three numbers for x, y, z"""
    position_A: Vector | None = None
    """The place at which all of them are held; each where it is at the start when not given"""

    @field_validator("molecules")
    @classmethod
    def _are_numbers(cls, molecules: tuple[int, ...] | str | None):
        return None if molecules is None else checked_numbers(molecules)

    @field_validator("stiffness_kJ_mol_A2")
    @classmethod
    def _does_something(cls, stiffness: float | tuple[float, float, float]):
        if not any(stiffness if isinstance(stiffness, tuple) else (stiffness,)):
            raise ValueError("is 0: it would do nothing; leave the restraint out")
        return stiffness

    @property
    def spans(self) -> list[tuple[int, int]]:
        """First and last of the numbers of molecules; none where all are held."""
        return [] if self.molecules is None else spans(self.molecules)

    @property
    def stiffness(self) -> tuple[float, float, float]:
        """Along x, y, z, kJ/mol/Å²."""
        k = self.stiffness_kJ_mol_A2
        return k if isinstance(k, tuple) else (k, k, k)


class Fields(Section):
    """What acts on molecules from outside."""

    electric_V_per_nm: Vector | None = None
    """A uniform electric field, on all charges, whatever `electrostatics` is"""
    electric_frequency_per_ps: Positive | None = None
    """Periods a ps of a field that oscillates as cos(2 pi f t + phase), t from the start of the run; steady when not
    given"""
    electric_phase_deg: Number = 0.0
    """Its phase"""
    gravity_m_s2: Vector | None = None
    """Uniform gravity"""
    walls: tuple[Walls, ...] = Field(default=(), max_length=MOST_TABLES)
    """Flat walls that molecules stay between"""
    restraints: tuple[Restraint, ...] = Field(default=(), max_length=MOST_TABLES)
    """Springs on centres of mass"""

    def _faults(self):
        if self.electric_frequency_per_ps is not None and self.electric_V_per_nm is None:
            yield "electric_frequency_per_ps would do nothing without electric_V_per_nm"
        if self.electric_phase_deg and self.electric_frequency_per_ps is None:
            yield "electric_phase_deg would do nothing without electric_frequency_per_ps"

    @property
    def depends_on_position(self) -> bool:
        """Whether energies depend on where in the lab molecules are: by walls, restraints and gravity. They do not
        follow a box that changes its size. (So do those of charges in a field: see `System.position_dependent`.)"""
        return bool(self.walls or self.restraints or any(self.gravity_m_s2 or ()))

    def bounds(self, axis: int) -> tuple[float, float] | None:
        """Between which positions walls perpendicular to an axis leave molecules, Å; None where there are none."""
        own = [walls.positions_A for walls in self.walls if walls.direction == axis]
        return (max(lower for lower, _ in own), min(upper for _, upper in own)) if own else None


def field_faults(scene: "MolecularScene") -> list[str]:
    """What is wrong between the fields of a scene and its other tables."""
    fields, boxed = scene.fields, scene.box.periodic
    held = bool(fields.restraints) or any(species.frozen for species in scene.molecules)
    faults = []
    for k, walls in enumerate(fields.walls):
        if boxed and inf in map(abs, walls.positions_A):
            faults.append(
                f"fields.walls.{k}.positions_A: in a periodic box both walls are needed, or molecules would come round "
                "to the other side"
            )
    for axis, name in enumerate(AXES):
        bounds = fields.bounds(axis)
        if bounds is not None and not bounds[0] < bounds[1]:
            faults.append(f"fields.walls: those across {name} leave no place between them")
        along = fields.gravity_m_s2 is not None and fields.gravity_m_s2[axis]
        if along and boxed and bounds is None and not held:
            faults.append(
                f"fields.gravity_m_s2: nothing stops the fall along {name}, which is periodic: all molecules would be "
                f"accelerated together. Add walls across {name}, freeze or restrain some molecules, or take no box"
            )
    if fields.walls and scene.forces.tail_correction:
        faults.append("forces.tail_correction is that of a liquid all around; between walls leave it out")
    if fields.electric_frequency_per_ps is not None:
        period = 1000 / fields.electric_frequency_per_ps
        faults += [
            f"fields.electric_frequency_per_ps: a period of {period:.3g} fs is less than two steps of stages.{k} "
            f"({stage.timestep_fs:g} fs), which cannot follow it"
            for k, stage in enumerate(scene.stages)
            if not (stage.is_auto or stage.is_minimisation) and period < 2 * stage.timestep_fs
        ]
    return faults
