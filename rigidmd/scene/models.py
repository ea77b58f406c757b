"""Molecular models: rigid bodies in their principal frames from lists of sites. `models/` has
published ones."""

import re
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Annotated, Literal, TypedDict, TypeVar, Unpack

import numpy as np
from pydantic import AfterValidator, Field, ValidationError

from rigidmd.core.plain_text import did_you_mean, suggestion
from rigidmd.core.toml import impossible_values, read_toml, shorten_repr
from rigidmd.errors import MoleculeError
from rigidmd.mechanics.inertia import BodyKind, principal_frame, rotational_freedom
from rigidmd.scene.validation import (
    Line,
    NonNegative,
    Number,
    Positive,
    Section,
    ShortName,
    Vector,
    location_of,
    numbers_out_of_range,
    validation_messages,
)
from rigidmd.units import BOLTZMANN, DEBYE, ENERGY_UNITS, KJ_PER_MOL

MODELS = Path(__file__).parent.parent / "models"
#: Smallest and largest absolute value of numbers of molecules other than 0: products of a few are
#: finite.
SIZES = (1e-30, 1e30)
#: Largest number of sites of a molecule.
MOST_SITES = 5000
#: Two sites closer than this fraction of the molecule's size count as coinciding.
COINCIDENT = 1e-6
#: A site further than this fraction of the size from a linear body's axis exerts a torque without
#: any inertia.
OFF_AXIS = 1e-4
MOST_PARAMETERS = 100  # of a site
MOST_SUGGESTED = 3  # models, in the message on an unknown one
#: Keys of the well depth, of which a Lennard-Jones site has one, and their units; it also has
#: sigma_A.
DEPTHS = {
    "epsilon_kJ_mol": KJ_PER_MOL,
    "epsilon_kcal_mol": ENERGY_UNITS["kcal/mol"],
    "epsilon_K": BOLTZMANN,
}
LENNARD_JONES = ("sigma_A", *DEPTHS)

#: Names of sites and residues that every structure format can hold: one to five visible ASCII
#: characters.
SiteName = Annotated[str, Field(pattern=r"^[!-~]{1,5}$")]


SYMBOLS = """
H He Li Be B C N O F Ne Na Mg Al Si P S Cl Ar K Ca Sc Ti V Cr Mn Fe Co Ni Cu Zn Ga Ge As Se Br Kr
Rb Sr Y Zr Nb Mo Tc Ru Rh Pd Ag Cd In Sn Sb Te I Xe Cs Ba La Ce Pr Nd Pm Sm Eu Gd Tb Dy Ho Er Tm
Yb Lu Hf Ta W Re Os Ir Pt Au Hg Tl Pb Bi Po At Rn Fr Ra Ac Th Pa U Np Pu Am Cm Bk Cf Es Fm Md No
Lr Rf Db Sg Bh Hs Mt Ds Rg Cn Nh Fl Mc Lv Ts Og
"""
#: Values of `element`: chemical symbols, deuterium and tritium, and X for a site without an
#: element.
ELEMENTS = frozenset((*SYMBOLS.split(), "D", "T", "X"))


def _checked_element(symbol: str) -> str:
    if symbol not in ELEMENTS:
        advice = "names of other kinds of sites belong to name"
        raise ValueError(
            f"is {shorten_repr(symbol)}, must be a chemical symbol such as O, or X; {advice}"
        )
    return symbol


class Site(Section):
    """A point of a rigid molecule with optional mass, charge and Lennard-Jones parameters."""

    name: SiteName
    """Name in trajectories and topology files, at most five characters"""
    element: Annotated[str, AfterValidator(_checked_element)] = "X"
    """Chemical symbol. X for a site without mass"""
    mass_u: NonNegative | None = None
    """Mass, 0 for a massless site. Default with `file`: the mass of the element"""
    position_A: Vector | None = None
    """Position in any frame fixed in the molecule. Default with `file`: the position there"""
    charge_e: Number | None = None
    """Charge in elementary charges"""
    sigma_A: Positive | None = None
    """Lennard-Jones diameter"""
    epsilon_kJ_mol: NonNegative | None = None
    """Lennard-Jones well depth"""
    epsilon_kcal_mol: NonNegative | None = None
    """Lennard-Jones well depth, 1 kcal is 4.184 kJ"""
    epsilon_K: NonNegative | None = None
    """Lennard-Jones well depth divided by Boltzmann's constant"""
    parameters: dict[ShortName, Number] = Field(default={}, max_length=MOST_PARAMETERS)
    """Parameters of custom pair potentials, by name"""

    def _errors(self):
        set_keys = [key for key in DEPTHS if getattr(self, key) is not None]
        if len(set_keys) > 1:
            number = "both" if len(set_keys) == 2 else "all"
            yield f"give one of {', '.join(set_keys)}, not {number}"
        if bool(set_keys) != (self.sigma_A is not None):
            yield f"a Lennard-Jones site needs both sigma_A and one of {', '.join(DEPTHS)}"

    @property
    def epsilon(self) -> float:
        """Well depth in u Å²/ps², 0 without one."""
        return sum(unit * (getattr(self, key) or 0.0) for key, unit in DEPTHS.items())


Mixing = Literal["lorentz-berthelot", "geometric"]

#: In the order of `rigidmd models`.
GROUPS = ("water", "ion", "noble gas", "gas", "organic", "other")


class MoleculeFile(Section):
    """A file of `models/`."""

    name: ShortName
    title: Line = ""
    group: Literal[GROUPS] = "other"  # type: ignore[valid-type]
    """Group in the list of `rigidmd models`"""
    source: str = ""
    """Source of the numbers"""
    note: str = ""
    """Advice for its users"""
    mixing: Mixing | None = None
    """Mixing rule of the model, if its sites have several kinds of parameters"""
    residue_names: tuple[SiteName, ...] = ()
    sites: tuple[Site, ...] = Field(min_length=1)


class ParameterFile(Section):
    """A table of parameters for several molecules. The key `parameters` of a scene names it."""

    title: str = ""
    source: str = ""
    sites: tuple[Site, ...] = Field(min_length=1)
    """Keyed by site name, or else by element"""


@dataclass(frozen=True, eq=False)
class Molecule:
    """A rigid molecule in its principal frame, centre of mass at the origin.

    masses (s,) u, positions_body (s, 3) Å, charges (s,) e, sigma (s,) Å, epsilon (s,) u Å²/ps².
    Inertia (3,) u Å², ascending, 0 about an axis on which the whole mass lies.
    centre (3,), axes (3, 3): centre of mass, Å, and principal axes (columns) in the coordinates of
    the model's file.
    """

    name: str
    residue_names: tuple[str, ...]
    site_names: tuple[str, ...]
    elements: tuple[str, ...]
    masses: np.ndarray
    positions_body: np.ndarray
    charges: np.ndarray
    sigma: np.ndarray
    epsilon: np.ndarray
    mass: float
    inertia: np.ndarray
    kind: BodyKind
    centre: np.ndarray
    axes: np.ndarray
    title: str = ""
    source: str = ""
    group: str = "other"
    note: str = ""
    mixing: Mixing | None = None
    parameters: tuple[dict[str, float], ...] = ()  # of each site, for custom pair potentials
    cell: np.ndarray | None = None  # (3, 3) Å, of a framework, in the coordinates of its file
    reading: tuple[str, ...] = ()  # how the structure file of its sites was interpreted

    def __repr__(self) -> str:
        return f"<Molecule {self.name}: {self.description}>"

    @property
    def fingerprint(self) -> tuple[float, ...]:
        """Mass, u, moments of inertia, u Å², and number of sites (5,), by which a saved state is
        checked."""
        return (self.mass, *map(float, self.inertia), float(len(self.masses)))

    @property
    def dispersion(self) -> np.ndarray:
        """c (s,) of each site, 2 sigma³ sqrt(epsilon): c_i c_j is the geometric mean of the
        coefficients of 1/r⁶."""
        return 2 * self.sigma**3 * np.sqrt(self.epsilon)

    @property
    def degrees_of_freedom(self) -> int:
        return 3 + rotational_freedom(self.kind)

    @property
    def charge(self) -> float:
        """Net charge in e. Exactly 0 if the charges of the sites cancel to rounding."""
        total = float(self.charges.sum())
        return 0.0 if abs(total) <= 1e-12 * np.abs(self.charges).sum() else total

    @property
    def dipole_debye(self) -> float:
        """Dipole moment about the centre of mass in debye (1 e Å = 4.80320471 D)."""
        return float(np.linalg.norm(self.charges @ self.positions_body)) / DEBYE

    @property
    def has_dipole(self) -> bool:
        """Whether the dipole moment about the centre of mass is more than a rounding error."""
        return bool(
            self.dipole_debye * DEBYE > COINCIDENT * self.radius * np.abs(self.charges).sum()
        )

    @property
    def quadrupole_debye_A(self) -> np.ndarray:
        """Traceless quadrupole moment (3, 3) about the centre of mass, body frame, D Å: sum of q (3
        x x - r²) / 2."""
        x, q = self.positions_body, self.charges
        return (
            1.5 * np.einsum("s,si,sj->ij", q, x, x)
            - 0.5 * np.sum(q * np.sum(x**2, axis=1)) * np.eye(3)
        ) / DEBYE

    @property
    def planar(self) -> bool:
        """Whether all sites, massless ones included, lie in one plane but not on one line."""
        # extents along the principal axes of the shape, descending; fewer than three for one or two
        # sites
        extents = [*np.linalg.svd(self.positions_body, compute_uv=False), 0.0, 0.0]
        return bool(extents[2] <= OFF_AXIS * self.radius < extents[1])

    @property
    def description(self) -> str:
        """Kind of body, number of sites, mass, charge and dipole, for reports."""
        shape = f"{self.kind}, planar" if self.planar else self.kind
        charge = f"net charge {self.charge:+g} e" if self.charge else "neutral"
        count = len(self.masses)
        dipole = ""
        if self.charges.any() and self.radius > 0 and self.cell is None:
            dipole = f", dipole {self.dipole_debye:.3f} D" if self.has_dipole else ", no dipole"
        return (
            f"{shape}, {count} site{'' if count == 1 else 's'}, {self.mass:.4f} u, {charge}{dipole}"
        )

    @property
    def radius(self) -> float:
        """Distance of the outermost site from the centre of mass, Å."""
        return float(np.linalg.norm(self.positions_body, axis=1).max())

    def sites(self) -> list[dict]:
        """The sites as in a scene file, in the principal frame."""
        entries = []
        for i, name in enumerate(self.site_names):
            entry = {
                "name": name,
                "element": self.elements[i],
                "mass_u": float(self.masses[i]),
                "position_A": self.positions_body[i].tolist(),
                "charge_e": float(self.charges[i]),
            }
            if self.epsilon[i] > 0:
                entry |= {
                    "sigma_A": float(self.sigma[i]),
                    "epsilon_kJ_mol": float(self.epsilon[i] / KJ_PER_MOL),
                }
            if self.parameters[i]:
                entry["parameters"] = dict(self.parameters[i])
            entries.append(entry)
        return entries


class About(TypedDict, total=False):
    """Fields of a `Molecule` that do not follow from its sites."""

    title: str
    source: str
    group: str
    note: str
    mixing: Mixing | None


def molecule(
    name: str, sites: tuple[Site, ...], residue_names: tuple[str, ...] = (), **about: Unpack[About]
) -> Molecule:
    """The rigid body of these sites, each of which needs a position and a mass. Raises
    MoleculeError."""
    missing = [
        (s, key) for s in sites for key in ("mass_u", "position_A") if getattr(s, key) is None
    ]
    errors = [f"site {s.name}: {key} is missing" for s, key in missing]
    if len(sites) > MOST_SITES:
        errors.append(f"has {len(sites)} sites, must not have more than {MOST_SITES}")
    if errors:
        raise MoleculeError(f"molecule {name}", errors)
    masses, positions = np.array([s.mass_u for s in sites]), np.array([s.position_A for s in sites])
    if masses.sum() == 0:
        raise MoleculeError(
            f"molecule {name}", ["all sites are massless. A body needs mass to move"]
        )
    size = float(np.linalg.norm(positions - masses @ positions / masses.sum(), axis=1).max())
    frame = principal_frame(masses, positions, size)
    body = (positions - frame.centre) @ frame.axes
    from scipy.spatial import KDTree  # slow to import

    near = KDTree(body).query_pairs(COINCIDENT * size, output_type="ndarray")
    errors += [
        f"sites {sites[j].name} and {sites[i].name} coincide"
        for i, j in sorted(near[:, ::-1].tolist())
    ]
    if frame.kind == "linear" or (frame.kind == "point" and not errors):
        off = np.linalg.norm(body[:, 1:] if frame.kind == "linear" else body, axis=1)
        limit = OFF_AXIS * size
        where = "from the centre of mass, but all the mass is there: nothing resists its torque"
        if frame.kind == "linear":
            where = (
                "off the axis of a linear body: nothing resists its torque about that axis. Put it"
                " on the line of the other sites"
            )
        errors += [
            f"site {s.name} is {d:.3g} Å {where}"
            for s, d in zip(sites, off, strict=True)
            if d > limit
        ]
    if errors:
        raise MoleculeError(f"molecule {name}", errors)
    if frame.kind == "point":
        body = np.zeros_like(body)  # exactly at the centre of mass, without rounding errors
    return Molecule(
        name=name,
        residue_names=tuple(residue_names) or (name.upper()[:5],),
        site_names=tuple(s.name for s in sites),
        elements=tuple(s.element for s in sites),
        masses=masses,
        positions_body=body,
        charges=np.array([s.charge_e or 0.0 for s in sites]),
        sigma=np.array([s.sigma_A or 0.0 for s in sites]),
        epsilon=np.array([s.epsilon for s in sites]),
        mass=float(frame.mass),
        inertia=frame.inertia,
        kind=frame.kind,
        centre=frame.centre,
        axes=frame.axes,
        parameters=tuple(s.parameters for s in sites),
        **about,
    )


def with_masses(original: Molecule, masses: dict[str, float]) -> Molecule:
    """The same molecule with other masses (u) of isotopes, by site name or else element. Raises
    MoleculeError."""
    errors = []
    changed = {}
    for key, mass in masses.items():
        sites = [i for i, name in enumerate(original.site_names) if name == key]
        sites = sites or [i for i, element in enumerate(original.elements) if element == key]
        heavy = [i for i in sites if original.masses[i] > 0]
        if not heavy:
            known = ", ".join(dict.fromkeys([*original.elements, *original.site_names]))
            if sites:
                why = "is massless, and stays so"
            else:
                why = f"is not a site or element of it; there are {known}"
            errors.append(f"masses_u.{key} {why}")
        changed |= {i: mass for i in heavy if i not in changed or original.site_names[i] == key}
    if errors:
        raise MoleculeError(f"molecule {original.name}", errors)
    sites = [
        Site(**entry | {"mass_u": changed.get(i, entry["mass_u"])})
        for i, entry in enumerate(original.sites())
    ]
    copied_keys = ("name", "residue_names", "title", "source", "group", "note", "mixing")
    changed_masses = molecule(
        sites=tuple(sites), **{key: getattr(original, key) for key in copied_keys}
    )
    return replace(  # the sites were in the original's principal frame
        changed_masses,
        centre=original.centre + original.axes @ changed_masses.centre,
        axes=original.axes @ changed_masses.axes,
    )


def with_parameters(sites: tuple[Site, ...], table: tuple[Site, ...]) -> tuple[Site, ...]:
    """Sites with missing keys filled in from a table, by site name or else element."""
    filled = []
    for site in sites:
        if (entry := find_site(table, site.name, site.element)) is not None:
            keys = [key for key in ("mass_u", "charge_e") if getattr(site, key) is None]
            keys += ["element"] if site.element == "X" else []
            keys += LENNARD_JONES if site.sigma_A is None else []
            keys += [] if site.parameters else ["parameters"]
            site = site.model_copy(update={key: getattr(entry, key) for key in keys})
        filled.append(site)
    return tuple(filled)


def find_site(sites: tuple[Site, ...], name: str, element: str) -> Site | None:
    """The entry of this name, or else of the element."""
    by_name = {site.name: site for site in reversed(sites)}  # the first of several
    return by_name.get(name) or by_name.get(element)


@cache
def available_models() -> list[str]:
    """Names of the shipped models."""
    return sorted(path.stem for path in MODELS.glob("*.toml"))


@cache
def model_error(name: str) -> str:
    """The message on an unknown model. Empty for a known one."""
    known = available_models()
    if name in known:
        return ""
    meant = did_you_mean(name, known) or suggestion(_models_called(name, known)) or "."
    return f"unknown model {name!r}{meant} `rigidmd models` lists all {len(known)}"


def _models_called(name: str, known: list[str]) -> list[str]:
    """The first models with this word as the name of a residue, such as N2, or in their title."""
    tables = {model: read_toml(MODELS / f"{model}.toml", MoleculeError)[0] for model in known}
    words = {
        model: {*table.get("residue_names", []), *re.findall(r"\w+", table["title"])}
        for model, table in tables.items()
    }
    return [m for m in known if name.lower() in map(str.lower, words[m])][:MOST_SUGGESTED]


def load_model(name: str) -> Molecule:
    """A shipped model by name. Raises MoleculeError."""
    if error := model_error(name):
        raise MoleculeError("models", [error])
    return read_molecule(MODELS / f"{name}.toml")


def read_molecule(path: Path) -> Molecule:
    """A molecule from a TOML file like those in `models/`. Raises MoleculeError."""
    return molecule_of(_read(path, MoleculeFile))


def molecule_of(file: MoleculeFile) -> Molecule:
    """The molecule of a file. Raises MoleculeError."""
    return molecule(**{key: value for key, value in file if value is not None})


def read_parameters(path: Path) -> ParameterFile:
    """A table of parameters. Raises MoleculeError."""
    table = _read(path, ParameterFile)
    names = [s.name for s in table.sites]
    errors = [
        f"sites: {name} appears twice" for name in sorted(set(names)) if names.count(name) > 1
    ]
    errors += [
        f"sites: {s.name}: position_A belongs to a molecule"
        for s in table.sites
        if s.position_A is not None
    ]
    if errors:
        raise MoleculeError(str(path), errors)
    return table


Table = TypeVar("Table", bound=Section)


def _read(path: Path, kind: type[Table]) -> Table:
    data, text = read_toml(path, MoleculeError)
    if wrong := impossible_values(data) or numbers_out_of_range(data, *SIZES):
        raise MoleculeError(
            str(path), [f"{location_of(keys, text)}: {fault}" for keys, fault in wrong]
        )
    try:
        return kind.model_validate(data)
    except ValidationError as error:
        raise MoleculeError(str(path), validation_messages(error, kind, text)) from None
