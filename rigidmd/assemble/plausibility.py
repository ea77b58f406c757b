"""Numbers of a scene that are possible and probably in another unit, or of another quantity.

Two tables have limits of quantities with the likely causes of numbers outside them: `PLAUSIBLE` of
numbers that are warned of, `REFUSED` of numbers that no scene can mean.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from math import degrees, inf
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rigidmd.units import GRAM_PER_CM3, KJ_PER_MOL

if TYPE_CHECKING:
    from rigidmd.forces.neighbors.space import Space
    from rigidmd.scene import MolecularScene
    from rigidmd.scene.forces import Forces
    from rigidmd.scene.models import Molecule

#: Distance of the minimum of a Lennard-Jones energy, over sigma.
MINIMUM = 2 ** (1 / 6)
#: A length of [forces] below this fraction of the minimum of every molecule is an error: nothing
#: but overlaps is within it.
SHORTEST = 0.5
#: The same of a switch with a tail correction: what it removes between there and the contact is
#: below a percent of the correction.
SHORTEST_SWITCH = 0.8
#: Mass of a site over that of its element, and the mass of up to four hydrogens (u) that a united
#: atom has too. Isotopes are within these limits.
LIGHTEST, HEAVIEST, HYDROGENS = 0.85, 1.1, 4.1
#: A molecule is bent by rounding if all mass is within this distance (Å) of a line: in bent
#: molecules an atom is farther from any line.
NEARLY_LINEAR = 0.08
#: Angles (degrees) that are a multiple of this in radians, to this many degrees, are probably in
#: radians.
ROUND_ANGLE, ROUNDED = 5.0, 0.4
ATMOSPHERE_PA, TO_ATMOSPHERE = 101325.0, 0.03
COLDEST_LIQUID = 100.0  # K, of water that starts without a file


class PlausibleRange(NamedTuple):
    """Plausible values of a quantity, and the likely cause if a value is smaller or larger."""

    unit: str
    least: float
    most: float
    if_small: str = ""
    if_large: str = ""
    heaviest_site: float = inf  # u, of models for which the limits hold: those of atoms

    def outside(self, value: float, where: str) -> str:
        """A sentence on a value outside the limits. Empty for a plausible one and for 0."""
        size = abs(value)
        if size == 0 or self.least <= size <= self.most:
            return ""
        bound = "below"
        limit = self.least
        cause = self.if_small
        if size > self.most:
            bound = "above"
            limit = self.most
            cause = self.if_large
        return f"{where} is {value:.4g} {self.unit}, {bound} {limit:g}: {cause}"


PLAUSIBLE = {
    "nearest distance": PlausibleRange(
        "Å", 0.5, 15.0, "are the positions in nm?", "are the positions in pm?"
    ),
    "largest sigma_A": PlausibleRange("Å", 0.9, 15.0, "is it in nm?", "is it in pm?"),
    "largest epsilon": PlausibleRange("kJ/mol", 0.0, 40.0, "", "is it in J/mol or in K?"),
    "charge_e": PlausibleRange("e", 1e-6, 10.0, "is it in coulomb?", "is it in another unit?"),
    "mass_u": PlausibleRange("u", 0.1, 1e4, "is it in kg or g?", "is it in another unit?"),
    "pressure_bar": PlausibleRange("bar", 0.0, 5e4, "", "is it in Pa?"),
    "electric_V_per_nm": PlausibleRange("V/nm", 0.0, 100.0, "", "is it in V/m?"),
    "gravity": PlausibleRange("m/s²", 0.0, 500.0, "", "is it in cm/s²?"),
    "angles_deg": PlausibleRange(
        "°", 10.0, 170.0, "are they in radians?", "do three edges really lie in one plane?"
    ),
}


REFUSED = {
    "density": PlausibleRange(
        "g/cm³", 0.0, 25.0, "", "is it in kg/m³, or an edge in nm?", heaviest_site=300.0
    ),
    # no step at any temperature follows the forces of such charges, and no grid resolves them
    "charge_e": PlausibleRange("e", 0.0, 1e3, "", "is it in another unit?"),
}


def scene_errors(
    scene: "MolecularScene", species: "list[Molecule]", counts: np.ndarray, space: "Space"
) -> list[str]:
    """Messages on numbers that no scene can mean. counts (k,) : molecules of each species"""
    mass = float(counts @ np.array([m.mass for m in species]))
    density = 0.0 if space.volume == inf else mass / space.volume / GRAM_PER_CM3
    key = "box.density_g_cm3" if scene.box.density_g_cm3 is not None else "the density of the box"
    charge = max(float(np.abs(m.charges).max()) for m in species)
    values = {
        "density": (scene.box.density_g_cm3 or density, key),
        "charge_e": (0.0 if scene.forces.electrostatics == "none" else charge, "a charge_e"),
    }
    heaviest = max(m.masses.max() for m in species)
    limits = {name: limit for name, limit in REFUSED.items() if heaviest <= limit.heaviest_site}
    refusals = (limit.outside(*values[name]) for name, limit in limits.items())
    errors = [*filter(None, refusals)]
    contact = shortest_contact(species) if scene.forces.lennard_jones else inf
    if contact == inf:
        return errors
    errors += too_short(_lengths(scene.forces), contact, "the sites of two molecules")
    if not scene.forces.tail_correction:
        return errors
    cutoff, start = scene.forces.cutoff_A, scene.forces.switch_start_A
    if SHORTEST * contact <= (cutoff or inf) < contact:
        errors.append(
            "forces.tail_correction needs a cutoff beyond the contact of two molecules,"
            f" {contact:.3g} Å. cutoff_A is {cutoff:g}"
        )
    elif switches_cores(scene.forces, contact) and (start or 0.0) >= SHORTEST * contact:
        errors.append(
            f"forces.tail_correction needs a switch that begins near the contact of two molecules,"
            f" {contact:.3g} Å, or beyond: it would count their overlaps. switch_start_A is"
            f" {start:g}"
        )
    return errors


def switches_cores(forces: "Forces", contact: float) -> bool:
    """Whether a switch changes the energy where sites that touch at a contact (Å) overlap."""
    start = forces.switch_start_A
    return start is not None and start < SHORTEST_SWITCH * contact < inf


def _lengths(forces: "Forces") -> dict[str, float | None]:
    """The cutoffs and the starts of switches of [forces], by their keys."""
    tables = {"forces": forces, **forces.added}
    names = ("cutoff_A", "switch_start_A", "ewald_cutoff_A")
    lengths = {
        f"{where}.{name}": getattr(table, name, None)
        for where, table in tables.items()
        for name in names
    }
    for where, force in forces.added.items():
        lengths |= {f"{where}.{key}": length for key, length in force.more_lengths.items()}
    return lengths


def too_short(lengths: Mapping[str, float | None], contact: float, touching: str) -> list[str]:
    """Messages on lengths (Å) of forces, by their keys, within which there are overlaps only.

    contact : at which the `touching` begin to repel, Å
    """
    return [
        f"{key} is {length:g} Å, and {touching} touch at {contact:.3g} Å:"
        f" {'is it in nm? ' if 10 * length > contact else ''}within it there are overlaps only"
        for key, length in lengths.items()
        if length is not None and length < SHORTEST * contact
    ]


def shortest_contact(species: "Sequence[Molecule]") -> float:
    """Smallest distance at which two like molecules have minimum energy, by their largest sites, Å;
    inf without."""
    largest = [float(m.sigma.max(where=m.epsilon > 0, initial=0.0)) for m in species]
    return MINIMUM * min((x for x in largest if x > 0), default=inf)


def scene_warnings(scene: "MolecularScene", species: "list[Molecule]") -> list[str]:
    """Warnings of numbers that are probably in another unit."""
    warnings = _implausible(_scene_values(scene))
    for entry, m in zip(scene.molecules, species, strict=True):
        if entry.model is None or entry.masses_u is not None:  # the shipped models are right
            warnings += molecule_warnings(m)
    for k, stage in enumerate(scene.stages):
        for pressure in stage.pressures if stage.pressure_bar is not None else ():
            if any(abs(abs(x) - ATMOSPHERE_PA) < TO_ATMOSPHERE * ATMOSPHERE_PA for x in pressure):
                warnings.append(
                    f"stages.{k}.pressure_bar is {pressure[0]:g} bar: 1 atm is 101325 Pa, or"
                    " 1.01325 bar"
                )
    if scene.structure is None and any(m.group == "water" for m in species):
        cold = [
            k
            for k, stage in enumerate(scene.stages)
            if 0 < max(stage.temperatures) < COLDEST_LIQUID
        ]
        warnings += [
            f"stages.{k}.temperature_K is {max(scene.stages[k].temperatures):g} K, for water that"
            " starts as a liquid: is it in °C?"
            for k in cold
        ]
    gravity = scene.fields.gravity_m_s2
    return warnings + ([] if gravity is None else gravity_warnings("fields.gravity_m_s2", gravity))


def _implausible(values: Iterable[tuple[str, float, str]]) -> list[str]:
    """Sentences on values outside the limits of `PLAUSIBLE`: quantity, value and where it
    stands."""
    descriptions = (PLAUSIBLE[name].outside(value, where) for name, value, where in values)
    return [*dict.fromkeys(filter(None, descriptions))]


def _scene_values(scene: "MolecularScene") -> Iterator[tuple[str, float, str]]:
    """Quantity, value and key of numbers of a scene that do not depend on its molecules."""
    for k, stage in enumerate(scene.stages):
        pressures = (
            [x for ends in stage.pressures for x in ends] if stage.pressure_bar is not None else []
        )
        largest = max(pressures, key=abs, default=0.0)
        if abs(abs(largest) - ATMOSPHERE_PA) >= TO_ATMOSPHERE * ATMOSPHERE_PA:
            yield "pressure_bar", largest, f"stages.{k}.pressure_bar"
    for angle in scene.box.angles_deg or ():
        yield "angles_deg", angle, "box.angles_deg"
    if scene.fields.electric_V_per_nm is not None:
        field = float(np.linalg.norm(scene.fields.electric_V_per_nm))
        yield "electric_V_per_nm", field, "fields.electric_V_per_nm"


def molecule_warnings(m: "Molecule") -> list[str]:
    """Warnings of numbers of a molecule that are probably in another unit."""
    return _implausible(_molecule_values(m)) + _mass_warnings(m) + _bent_by_rounding(m)


def _molecule_values(m: "Molecule") -> Iterator[tuple[str, float, str]]:
    """Quantity, value and description of numbers of a molecule."""
    position = m.positions_body[m.masses > 0]
    if len(position) > 1:
        apart = np.linalg.norm(position[:, None] - position, axis=2) + np.diag(
            np.full(len(position), inf)
        )
        yield (
            "nearest distance",
            float(apart.min()),
            f"{m.name}: the distance of its nearest sites with mass",
        )
    acting = m.epsilon > 0
    if acting.any():
        yield "largest sigma_A", float(m.sigma[acting].max()), f"{m.name}: its largest sigma_A"
        deepest = float(m.epsilon.max()) / KJ_PER_MOL
        yield "largest epsilon", deepest, f"{m.name}: its largest well depth"
    for name, charge, mass in zip(m.site_names, m.charges.tolist(), m.masses.tolist(), strict=True):
        yield "charge_e", charge, f"{m.name}: charge_e of {name}"
        yield "mass_u", mass, f"{m.name}: mass_u of {name}"


def _bent_by_rounding(m: "Molecule") -> list[str]:
    """A warning of a molecule that is not linear but has all mass near a line."""
    off = float(np.linalg.norm(m.positions_body[m.masses > 0, 1:], axis=1).max())
    if not 0 < off < NEARLY_LINEAR or m.inertia.min() == 0:
        return []
    return [
        f"{m.name} is nearly linear: its atoms are at most {off:.2g} Å from a line. Their rotation"
        " about it needs a short time step. If only rounding bends it, put them on the line"
    ]


def _mass_warnings(m: "Molecule") -> list[str]:
    """Warnings of masses that differ from the masses of the elements."""
    from ase.data import atomic_masses, atomic_numbers  # not needed for shipped models

    messages = {}
    for name, element, mass in zip(m.site_names, m.elements, m.masses.tolist(), strict=True):
        if atomic_numbers.get(element, 0) > 0:
            usual = float(atomic_masses[atomic_numbers[element]])
        else:
            usual = 0.0
        if mass > 0 and usual and not LIGHTEST * usual <= mass <= HEAVIEST * usual + HYDROGENS:
            messages[element] = (
                f"{m.name}: mass_u of {name} is {mass:g} u, and {element} has {usual:.4g} u"
            )
    return list(messages.values())


def gravity_warnings(key: str, acceleration: tuple[float, float, float]) -> list[str]:
    """Warnings of gravity that points upwards or is in another unit."""
    size = float(np.linalg.norm(acceleration))
    warnings = _implausible([("gravity", size, key)])
    if acceleration[2] > 0.9 * size:
        warnings.append(f"{key} points up, along +z: should it be [0, 0, {-acceleration[2]:g}]?")
    return warnings


def in_radians(angle: float) -> bool:
    """Whether an angle has fractions of a degree and is a round number of degrees if it is in
    radians."""
    inside = degrees(angle)
    near = ROUND_ANGLE * round(inside / ROUND_ANGLE)
    return angle % 1 != 0 and near != 0 and abs(inside - near) < ROUNDED
