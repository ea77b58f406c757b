"""Rigid molecules: from a list of sites to a body in its principal frame. `models/*.toml` holds the published ones."""

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, ValidationError, model_validator

from rigidmd.errors import MoleculeError
from rigidmd.mechanics.inertia import Kind, principal_frame, rotational_freedom
from rigidmd.units import BOLTZMANN, KJ_PER_MOL
from rigidmd.validation import NonNegative, Number, Positive, Section, Vector, faults_of

MODELS = Path(__file__).parent / "models"

#: Two sites closer than this fraction of the molecule's size are on one place.
SAME_PLACE = 1e-6
#: A site further than this fraction of the size from a linear body's axis would turn it about an axis without inertia.
OFF_AXIS = 1e-4


#: Names of sites and residues as every structure format can hold them: one to five visible ASCII characters.
SiteName = Annotated[str, Field(pattern=r"^[!-~]{1,5}$")]


class Site(Section):
    """A point of a rigid molecule: mass, charge and Lennard-Jones parameters, each only where it has them."""

    name: SiteName
    """Name in trajectories and topology files, at most five characters"""
    element: str = "X"
    """Chemical symbol; X for a site without mass"""
    mass_u: NonNegative | None = None
    """Mass; 0 for a massless site. With `file`, taken from the element when not given"""
    position_A: Vector | None = None
    """Position in any frame fixed in the molecule; taken from `file` where there is one"""
    charge_e: Number = 0.0
    """Charge in elementary charges"""
    sigma_A: Positive | None = None
    """Lennard-Jones diameter"""
    epsilon_kJ_mol: NonNegative | None = None
    """Lennard-Jones well depth"""
    epsilon_K: NonNegative | None = None
    """Lennard-Jones well depth over Boltzmann's constant"""

    @model_validator(mode="after")
    def _lennard_jones_is_whole(self):
        given = [self.epsilon_kJ_mol is not None, self.epsilon_K is not None]
        if sum(given) > 1:
            raise ValueError("give epsilon_kJ_mol or epsilon_K, not both")
        if any(given) != (self.sigma_A is not None):
            raise ValueError("a Lennard-Jones site needs both sigma_A and one of epsilon_kJ_mol, epsilon_K")
        return self

    @property
    def epsilon(self) -> float:
        """Well depth in u Å²/ps²; 0 without one."""
        return (self.epsilon_kJ_mol or 0.0) * KJ_PER_MOL + (self.epsilon_K or 0.0) * BOLTZMANN


class MoleculeFile(Section):
    """What a file of `models/` holds."""

    name: str = Field(min_length=1)
    title: str = ""
    source: str = ""
    residue_names: tuple[SiteName, ...] = ()
    sites: tuple[Site, ...] = Field(min_length=1)


@dataclass(frozen=True, eq=False)
class Molecule:
    """A rigid molecule in its principal frame, centre of mass at the origin.

    masses (s,) u, positions_body (s, 3) Å, charges (s,) e, sigma (s,) Å, epsilon (s,) u Å²/ps²; inertia (3,) u Å²,
    ascending, 0 where the body has no extent about that axis.
    """

    name: str
    title: str
    source: str
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
    kind: Kind

    @property
    def degrees_of_freedom(self) -> int:
        """Three of translation and those of rotation."""
        return 3 + rotational_freedom(self.kind)

    @property
    def charge(self) -> float:
        """Net charge in e, rounded where the sites' charges cancel to rounding."""
        total = float(self.charges.sum())
        return 0.0 if abs(total) <= 1e-12 * np.abs(self.charges).sum() else total

    @property
    def dipole_debye(self) -> float:
        """Dipole moment about the centre of mass in debye (1 e Å = 4.80320471 D)."""
        return float(np.linalg.norm(self.charges @ self.positions_body)) * 4.80320471

    @property
    def radius(self) -> float:
        """Distance of the outermost site from the centre of mass, Å."""
        return float(np.linalg.norm(self.positions_body, axis=1).max())

    def sites(self) -> list[dict]:
        """The sites as they would stand in a scene file, in the principal frame."""
        entries = []
        for i, name in enumerate(self.site_names):
            entry = {
                "name": name,
                "element": self.elements[i],
                "mass_u": float(self.masses[i]),
                "position_A": [float(x) for x in self.positions_body[i]],
                "charge_e": float(self.charges[i]),
            }
            if self.epsilon[i] > 0:
                entry |= {"sigma_A": float(self.sigma[i]), "epsilon_kJ_mol": float(self.epsilon[i] / KJ_PER_MOL)}
            entries.append(entry)
        return entries


def molecule(
    name: str, sites: tuple[Site, ...], title: str = "", source: str = "", residue_names: tuple[str, ...] = ()
) -> Molecule:
    """The rigid body of these sites, which all have a position and a mass.

    Raises MoleculeError with every reason why they are none.
    """
    faults = [
        f"site {s.name}: {key} is missing" for s in sites for key in ("mass_u", "position_A") if getattr(s, key) is None
    ]
    if faults:
        raise MoleculeError(f"molecule {name}", faults)
    masses = np.array([s.mass_u for s in sites])
    positions = np.array([s.position_A for s in sites])
    if masses.sum() == 0:
        raise MoleculeError(f"molecule {name}", ["all sites are massless; a body needs mass to move"])
    size = float(np.linalg.norm(positions - masses @ positions / masses.sum(), axis=1).max())
    frame = principal_frame(masses, positions, size)
    body = (positions - frame.centre) @ frame.axes
    for i in range(len(sites)):
        for j in range(i):
            if np.linalg.norm(body[i] - body[j]) <= SAME_PLACE * size:
                faults.append(f"sites {sites[j].name} and {sites[i].name} are on one place")  # noqa: PERF401
    if frame.kind == "point" and not faults:
        off = np.linalg.norm(body, axis=1)
        faults += [
            f"site {s.name} is {d:.3g} Å from the centre of mass, but all the mass is there: nothing resists its torque"
            for s, d in zip(sites, off, strict=True)
            if d > OFF_AXIS * size
        ]
    if frame.kind == "linear":
        off = np.linalg.norm(body[:, 1:], axis=1)
        faults += [
            f"site {s.name} is {d:.3g} Å off the axis of a linear body: nothing resists its torque about that axis"
            for s, d in zip(sites, off, strict=True)
            if d > OFF_AXIS * size
        ]
    if faults:
        raise MoleculeError(f"molecule {name}", faults)
    if frame.kind == "point":
        body = np.zeros_like(body)  # the centre of mass, without the rounding of having computed it
    return Molecule(
        name=name,
        title=title,
        source=source,
        residue_names=tuple(residue_names) or (name.upper()[:5],),
        site_names=tuple(s.name for s in sites),
        elements=tuple(s.element for s in sites),
        masses=masses,
        positions_body=body,
        charges=np.array([s.charge_e for s in sites]),
        sigma=np.array([s.sigma_A or 0.0 for s in sites]),
        epsilon=np.array([s.epsilon for s in sites]),
        mass=float(frame.mass),
        inertia=frame.inertia,
        kind=frame.kind,
    )


def available_models() -> list[str]:
    """Names of the models that come with the package."""
    return sorted(path.stem for path in MODELS.glob("*.toml"))


def load_model(name: str) -> Molecule:
    """A model that comes with the package, by name."""
    return read_molecule(MODELS / f"{name}.toml")


def read_molecule(path: Path) -> Molecule:
    """A molecule from a TOML file as those in `models/`. Raises MoleculeError."""
    try:
        text = path.read_text(encoding="utf-8")
        data = MoleculeFile.model_validate(tomllib.loads(text))
    except OSError as error:
        raise MoleculeError(str(path), [f"cannot be read: {error.strerror}"]) from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise MoleculeError(str(path), [f"is not TOML: {error}"]) from None
    except ValidationError as error:
        raise MoleculeError(str(path), faults_of(error, MoleculeFile, text)) from None
    return molecule(data.name, data.sites, data.title, data.source, data.residue_names)
