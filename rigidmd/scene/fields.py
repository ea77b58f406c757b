"""The table [fields] of a scene of molecules: electric field, gravity, walls, restraints."""

from collections.abc import Iterator
from math import inf
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

from pydantic import Field, Strict, field_validator

from rigidmd.scene.forces import ELECTROSTATICS
from rigidmd.scene.species import Numbers, spans
from rigidmd.scene.validation import (
    MOST_TABLES,
    Cutoff,
    NonNegative,
    Number,
    Positive,
    Section,
    Vector,
)

if TYPE_CHECKING:
    from rigidmd.scene.molecules import MolecularScene

AXES = "xyz"

Edge = Annotated[float, Strict()]

#: Kind of walls -> keys that only this kind has, and whether they are required.
KEYS_OF_WALLS = {
    "lj93": {"sigma_A": True, "epsilon_kJ_mol": True, "cutoff_A": False},
    "harmonic": {"stiffness_kJ_mol_A2": True},
}


class Walls(Section):
    """Two flat walls that confine molecules."""

    axis: Literal["x", "y", "z"]
    """Lab axis to which the walls are perpendicular"""
    kind: Literal["lj93", "harmonic"]
    """lj93: (2/15) (sigma/d)^9 - (sigma/d)^3, times epsilon, at a distance d. harmonic: stiffness/2
    d² at a depth d behind the wall, 0 in front of it"""
    positions_A: tuple[Edge, Edge]
    """Positions along the axis, the lower position first. Without a box, use -inf or inf for a
    side without a wall"""
    acts_on: Literal["sites", "centres"] = "sites"
    """sites: sites with Lennard-Jones parameters. centres: centres of mass"""
    sigma_A: Positive | None = None
    """Diameter of lj93"""
    epsilon_kJ_mol: Positive | None = None
    """Strength of lj93. The well is 1.054 times as deep"""
    cutoff_A: Cutoff | None = None
    """Cutoff distance of lj93. Its energy is shifted to 0 there. Default: none"""
    stiffness_kJ_mol_A2: Positive | None = None
    """Stiffness of harmonic"""

    def _errors(self):
        for kind, keys in KEYS_OF_WALLS.items():
            set_keys = [key for key in keys if getattr(self, key) is not None]
            if kind != self.kind and set_keys:
                yield f"{', '.join(set_keys)} would have no effect with kind = {self.kind!r}"
            missing = [key for key, needed in keys.items() if needed and key not in set_keys]
            if kind == self.kind and missing:
                yield f"kind = {kind!r} needs {' and '.join(missing)}"
        lower, upper = self.positions_A
        if not lower < upper:
            yield f"positions_A = [{lower:g}, {upper:g}]: the first must be below the second"
        elif (lower, upper) == (-inf, inf):
            yield "positions_A = [-inf, inf] defines no wall"
        elif lower == inf or upper == -inf:
            yield f"positions_A = [{lower:g}, {upper:g}] leaves no space between the walls"

    @property
    def direction(self) -> int:
        """0, 1, 2 for x, y, z."""
        return AXES.index(self.axis)


#: A molecule, or a group of molecules, by their numbers in the scene.
Group = Annotated[int, Strict(), Field(ge=1)] | Numbers


class Restraint(Section):
    """Springs between centres of mass and their positions at the start or one given position, or,
    with `between`, a spring on the distance of two molecules or groups."""

    species: str | None = None
    """The restrained species. Required if there are several species"""
    molecules: Numbers | None = None
    """Numbers of the restrained molecules, [1, 2, 5] or "1-10, 15", as for `frozen`. Default:
    all"""
    between: tuple[Group, Group] | None = None
    """Two molecules, or two groups of molecules, whose distance is restrained: [1, 2], [[1, 2],
    "3-5"]. The numbers count all molecules of the scene from 1 onwards. The distance is between the
    centres of mass, to the nearest periodic image"""
    distance_A: Positive | None = None
    """With between: the distance at which the spring has no energy"""
    stiffness_kJ_mol_A2: NonNegative | tuple[NonNegative, NonNegative, NonNegative]
    """Stiffness. Use three numbers for x, y, z. With between, use one number"""
    position_A: Vector | None = None
    """Position to which all these molecules are restrained. Default: the initial position of each
    molecule"""

    @field_validator("stiffness_kJ_mol_A2")
    @classmethod
    def _does_something(cls, stiffness: float | tuple[float, float, float]):
        if not any(stiffness if isinstance(stiffness, tuple) else (stiffness,)):
            raise ValueError("is 0: it would have no effect. Omit the restraint")
        return stiffness

    def _errors(self):
        if self.between is None:
            if self.distance_A is not None:
                yield "distance_A would have no effect without between = [1, 2]"
            return
        if self.distance_A is None:
            yield "between needs distance_A, at which the spring has no energy"
        if isinstance(self.stiffness_kJ_mol_A2, tuple):
            yield "stiffness_kJ_mol_A2 has one number for a distance"
        if set_keys := [
            key for key in ("species", "molecules", "position_A") if getattr(self, key) is not None
        ]:
            keys = ", ".join(set_keys)
            yield f"{keys} would have no effect with between, which names the molecules"

    @property
    def groups(self) -> tuple[list[int], ...]:
        """The numbers of the molecules of both groups. Empty without `between`."""
        groups = []
        for group in self.between or ():
            ranges = [(group, group)] if isinstance(group, int) else spans(group)
            groups.append([number for first, last in ranges for number in range(first, last + 1)])
        return tuple(groups)

    @property
    def spans(self) -> list[tuple[int, int]]:
        """Ranges (first, last) of molecule numbers. The list is empty if all molecules are
        restrained."""
        return [] if self.molecules is None else spans(self.molecules)

    @property
    def stiffness(self) -> tuple[float, float, float]:
        """Stiffness along x, y, z, kJ/mol/Å²."""
        k = self.stiffness_kJ_mol_A2
        return k if isinstance(k, tuple) else (k, k, k)


class Fields(Section):
    """External fields that act on molecules."""

    electric_V_per_nm: Vector | None = None
    """Uniform electric field. It acts on all charges, whatever the value of `electrostatics`"""
    electric_frequency_per_ps: Positive | None = None
    """Frequency f of a field that oscillates as cos(2 pi f t + phase), with t from the start of the
    run. Default: a constant field"""
    electric_phase_deg: Number = 0.0
    """Phase of the oscillating field"""
    gravity_m_s2: Vector | None = None
    """Acceleration of uniform gravity"""
    walls: tuple[Walls, ...] = Field(default=(), max_length=MOST_TABLES)
    """Flat walls that confine molecules"""
    restraints: tuple[Restraint, ...] = Field(default=(), max_length=MOST_TABLES)
    """Springs on centres of mass"""

    def _errors(self):
        if self.electric_frequency_per_ps is not None and self.electric_V_per_nm is None:
            yield "electric_frequency_per_ps would have no effect without electric_V_per_nm"
        if self.electric_phase_deg and self.electric_frequency_per_ps is None:
            yield "electric_phase_deg would have no effect without electric_frequency_per_ps"

    @property
    def entries(self) -> dict[str, tuple["FieldKind", Section, str]]:
        """Name of each term -> its kind, the table with its keys, and the path of that table or key
        in the scene."""
        entries: dict[str, tuple[FieldKind, Section, str]] = {}
        for name, kind in FIELDS.items():
            value = getattr(self, kind.key)
            if isinstance(value, tuple) and all(isinstance(entry, Section) for entry in value):
                entries |= {
                    f"{name}_{k}": (kind, entry, f"fields.{kind.key}.{k}")
                    for k, entry in enumerate(value)
                }
            elif value is not None:
                entries[name] = (
                    kind,
                    value if isinstance(value, Section) else self,
                    f"fields.{kind.key}",
                )
        return entries

    def bounds(self, axis: int) -> tuple[float, float] | None:
        """Range of positions between the walls perpendicular to an axis, Å. None without walls."""
        ranges = [walls.positions_A for walls in self.walls if walls.direction == axis]
        if ranges:
            return max(lower for lower, _ in ranges), min(upper for _, upper in ranges)
        return None


class FieldKind(NamedTuple):
    """A kind of field. Its keys are of `Fields`."""

    module: str  # in `forces.fields`, with the functions `term` and `sentence`
    key: str  # of `Fields`: a value, a table or a list of tables, each of which is one term
    title: str  # in the list of unused interactions of a scene


#: Name of a term, to which a number is added if `key` is a list -> its kind.
FIELDS = {
    "electric_field": FieldKind("electric", "electric_V_per_nm", "electric field"),
    "gravity": FieldKind("gravity", "gravity_m_s2", "gravity"),
    "walls": FieldKind("walls", "walls", "walls"),
    "restraints": FieldKind("restraints", "restraints", "restraints"),
}


def field_notes(scene: "MolecularScene") -> list[str]:
    """Notes on fields that act with the sums over periodic images."""
    method = scene.forces.electrostatics
    if not (scene.fields.walls and method and ELECTROSTATICS[method].sums_images):
        return []
    effect = (
        "act on the layer between the walls across the empty part of the box. A longer box reduces"
        " this effect"
    )
    return [f"fields.walls: {method} includes the periodic images beyond the walls, which {effect}"]


def field_errors(scene: "MolecularScene") -> Iterator[str]:
    """Messages on fields of a scene that contradict its other tables."""
    fields = scene.fields
    boxed = scene.box.periodic
    has_anchors = any(entry.between is None for entry in fields.restraints)
    held = has_anchors or any(species.frozen for species in scene.molecules)
    for k, walls in enumerate(fields.walls):
        if boxed and inf in map(abs, walls.positions_A):
            why = "or molecules would cross the periodic boundary to the other side"
            yield f"fields.walls.{k}.positions_A: a periodic box needs both walls, {why}"
    for axis, name in enumerate(AXES):
        bounds = fields.bounds(axis)
        if bounds is not None and not bounds[0] < bounds[1]:
            yield f"fields.walls: the walls across {name} leave no space between them"
        along = fields.gravity_m_s2 is not None and fields.gravity_m_s2[axis]
        if along and boxed and bounds is None and not held:
            why = (
                f"nothing stops the fall along {name}, which is periodic: all molecules would be"
                " accelerated together"
            )
            advice = f"Add walls across {name}, freeze or restrain some molecules, or use no box"
            yield f"fields.gravity_m_s2: {why}. {advice}"
    if fields.walls and scene.forces.tail_correction:
        yield "forces.tail_correction assumes a uniform liquid: omit it between walls"
    period = (
        inf if fields.electric_frequency_per_ps is None else 1000 / fields.electric_frequency_per_ps
    )
    for k, stage in enumerate(scene.stages):
        if not (stage.is_auto or stage.is_minimisation) and period < 2 * stage.step_fs:
            what = (
                f"less than two steps of stages.{k} ({stage.step_fs:g} fs), which cannot follow it"
            )
            yield f"fields.electric_frequency_per_ps: a period of {period:.3g} fs is {what}"
