"""Structures from and for ASE: files that it reads, `ase.Atoms` with the sites that have mass, in
ASE's units, and its trajectories (.traj).

In a trajectory, additional arrays, which ASE ignores, hold massless sites and the indices of the
atoms among the sites. It is read item by item, and sizes are checked before arrays are allocated.
"""

import contextlib
import io
import os
import re
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np

from rigidmd.core.process import ignore_warnings
from rigidmd.core.state import NOW, State
from rigidmd.core.toml import Json
from rigidmd.errors import StructureError
from rigidmd.formats import Format, extensions, register
from rigidmd.formats.atoms import (
    HEAVY_HYDROGEN,
    MASSLESS_NAME,
    Atoms,
    Frame,
    is_element,
    structure_error,
)
from rigidmd.formats.frame_file import FrameFile
from rigidmd.formats.systems import MolecularSystem
from rigidmd.units import ENERGY_UNITS

if TYPE_CHECKING:
    import ase
    from ase import Atoms as AseAtoms
    from ase.io import ulm
    from ase.io.trajectory import TrajectoryWriter

EV = ENERGY_UNITS["eV"]

MOST_PROTONS = 118
#: ASE's unit of velocity, sqrt(eV/u), in Å/ps.
ASE_VELOCITY = 98.22694788464063
#: ASE's arrays of names of atoms and residues, as from .pdb. Extended XYZ may have them as columns.
NAMES, RESIDUE_NAMES, RESIDUE_NUMBERS = "atomtypes", "residuenames", "residuenumbers"
#: ASE's array of what follows its symbols in the names of DL_POLY's files.
DL_POLY_NAMES = "dlp4_labels"
#: Numbers and texts of each atom in ASE's arrays that are used, by their shape; which are numbers.
NUMERIC = ("numbers", "positions", "momenta", "masses")
WIDTHS = dict.fromkeys((*NUMERIC, NAMES, RESIDUE_NAMES, RESIDUE_NUMBERS, DL_POLY_NAMES), ()) | {
    "positions": (3,),
    "momenta": (3,),
}
#: Columns of velocities in extended XYZ that ASE does not convert, because programs use different
#: units.
UNITLESS_VELOCITIES = ("vel", "velo", "velocity", "velocities")


def read_by_ase(
    path: Path, source: Path | io.StringIO, name: str | None = None
) -> "list[AseAtoms]":
    """The structures in a file or text, in the format of a name if it has one. Raises
    StructureError."""
    import ase.io.formats

    try:
        with ignore_warnings():
            frames = cast("list[AseAtoms]", ase.io.read(source, index=":", format=name))
            for atoms in frames:
                _check_readable(atoms)
    except ase.io.formats.UnknownFileTypeError:
        known = " ".join(extensions(lambda form: form.read or form.reader))
        raise structure_error(path, f"its format is unknown to ASE; there are {known}") from None
    except Exception as error:  # ASE's readers raise many types, from ImportError to IndexError
        raise structure_error(path, _reason(error)) from None
    return [atoms for atoms in frames if len(atoms)]


def _check_readable(atoms: "AseAtoms") -> None:
    """Raise an exception where what `from_ase` uses has another type or shape, which ASE does not
    check when it reads a file."""
    count = len(atoms)
    if count and not 0 <= atoms.numbers.min() <= atoms.numbers.max() <= MOST_PROTONS:
        raise ValueError("an atomic number is that of no element")
    for name, width in WIDTHS.items():
        array = atoms.arrays.get(name)
        if array is None:
            continue
        if array.shape != (count, *width) or (name in NUMERIC and array.dtype.kind not in "fi"):
            raise ValueError(f"{name} are of another type or number than one for each atom")
    occupancy = atoms.info.get("occupancy", {})
    if not isinstance(occupancy, dict) or not all(isinstance(x, dict) for x in occupancy.values()):
        raise ValueError("occupancy is not a table of elements for each kind of sites")


def _reason(error: Exception) -> str:
    """A message for users on an exception of the readers of ASE."""
    reason = " ".join(str(error).split()).rstrip(".") or "something is missing or misplaced"
    if "Could not determine chemical symbols" in reason:  # a POSCAR
        return (
            "line 6: expected the symbols of its elements, before the numbers of their atoms: add a"
            " line such as 'O H' (the format of VASP 4 has none)"
        )
    symbol = re.search(r"['\"](\w{1,8})['\"]", reason)
    if symbol and ("symbol" in reason or isinstance(error, KeyError)) and not is_element(symbol[1]):
        named = f"names an atom {symbol[1]}, but ASE, which reads this format, knows elements only"
        return (
            f"{named}. Use elements (X for sites without mass), or a .gro, .pdb or .xyz, which may"
            " have any names"
        )
    hint = "Is the file complete and named by its format? A .xyz, .pdb or .gro made of it may help"
    return f"ASE, which reads this format, ends with {type(error).__name__}: {reason}. {hint}"


def read_text_by_ase(path: Path, text: str, name: str) -> "list[AseAtoms]":
    """The structures in the text of a file of this name. Massless sites become X and, where ASE
    needs it, heavy hydrogen becomes H. Raises StructureError."""
    faults = []
    plain = without_massless_names(text)
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / name
        for variant in dict.fromkeys((plain, without_isotopes(plain), text)):
            source.write_text(variant, encoding="utf-8")
            try:
                return read_by_ase(path, source)
            except StructureError as error:
                faults.append(error)
    raise faults[0]


def without_massless_names(text: str) -> str:
    """A text in which names of massless sites are X, the only such name that ASE knows, with
    columns unchanged."""

    def renamed(match: re.Match) -> str:
        return match[0] if is_element(match[0].capitalize()) else "X".ljust(len(match[0]))

    return re.sub(rf"(?<!\S){MASSLESS_NAME.pattern}(?!\S)", renamed, text, flags=re.IGNORECASE)


def without_isotopes(text: str) -> str:
    """A text in which D and T are H: ASE has no symbols for heavy hydrogen."""
    return re.sub(r"(?<!\S)[DT](?!\S)", "H", text)


def from_ase(
    path: Path, atoms, names=None, elements=None, rounding: float = 0.0, notes=()
) -> Atoms:
    """Atoms in Å, ps and u from ASE's, with its masses unless they are its standard ones. By
    default, names and residues are those in the arrays that ASE and rigidmd store, or else names
    are ASE's symbols."""
    symbols = atoms.get_chemical_symbols()
    notes = list(notes)
    if names is None and (stored := atoms.arrays.get(NAMES)) is not None:
        names = [str(name) for name in stored]
        # united atoms have names only
        symbols = ["" if symbol == "X" else symbol for symbol in symbols]
    elif names is None and DL_POLY_NAMES in atoms.arrays:
        names = [
            symbol + str(number)
            for symbol, number in zip(symbols, atoms.arrays[DL_POLY_NAMES], strict=True)
        ]
        symbols = [""] * len(atoms)  # ASE takes the first letters, N for NA
    residue = _residues(atoms)
    if residue is None and RESIDUE_NUMBERS in atoms.arrays:
        notes.append(
            f"its residues are not used: {RESIDUE_NAMES}, and whole {RESIDUE_NUMBERS}, are needed"
        )
    if names is not None and len(names) != len(atoms):
        raise structure_error(path, f"has {len(names)} atoms, of which ASE reads {len(atoms)}")
    occupied = {
        (e, x) for site in atoms.info.get("occupancy", {}).values() for e, x in site.items()
    }
    if invalid := sorted(
        {str(x) for _, x in occupied if not (isinstance(x, int | float) and x >= 0)}
    ):
        raise structure_error(path, f"some of its sites have the occupancy {', '.join(invalid)}")
    if partial_sites := sorted(f"{e} {x:g}" for e, x in occupied if x < 1):
        disorder = (
            f"some of its sites are occupied only partly ({', '.join(partial_sites)}): the crystal"
            " is disordered"
        )
        hint = (
            "in which every site is occupied or left out (for ices, GenIce makes proton-disordered"
            " ones)"
        )
        raise structure_error(
            path, f"{disorder}, so that molecules are unknown. Choose one arrangement of it, {hint}"
        )
    velocity = atoms.get_velocities() * ASE_VELOCITY if atoms.has("momenta") else None
    if velocity is not None and not np.isfinite(velocity).all():
        bad = int(np.argmin(np.isfinite(velocity).all(axis=1)))
        raise structure_error(path, f"atom {bad + 1} has a velocity that is not a finite number")
    if unitless := [key for key in atoms.arrays if key.lower() in UNITLESS_VELOCITIES]:
        notes.append(
            f"its velocities in the column {unitless[0]} have no units and are not used (ASE writes"
            " momenta instead)"
        )
    cell = None
    if atoms.pbc.all():
        cell = atoms.cell.array.copy()
    elif atoms.pbc.any():
        axes = ", ".join(x for x, periodic in zip("abc", atoms.pbc, strict=True) if periodic)
        notes.append(f"its cell is periodic along {axes} only and is not used")
    masses = atoms.get_masses() if atoms.has("masses") else None
    return Atoms(
        symbols if names is None else names,
        symbols if elements is None else elements,
        [()] * len(atoms) if residue is None else residue,
        atoms.get_positions(),
        velocity,
        cell,
        masses,
        notes,
        rounding=rounding,
    )


def _residues(atoms) -> list[tuple] | None:
    """Residues from ASE's arrays of them. None without."""
    names, numbers = (atoms.arrays.get(key) for key in (RESIDUE_NAMES, RESIDUE_NUMBERS))
    if names is None or numbers is None or numbers.dtype.kind != "i":
        return None
    return [(int(n), str(name)) for n, name in zip(numbers, names, strict=True)]


def atoms_of_system(system: MolecularSystem, state: State, *, wrapped: bool = False) -> "ase.Atoms":
    """A state of a system as an `ase.Atoms`, see `atoms_of_sites`."""
    return atoms_of_sites(
        system,
        system.site_positions(state, wrapped),
        system.site_velocities(state),
        state.cell,
        float(state.time[NOW]),
    )


def atoms_of_sites(
    system: MolecularSystem,
    positions: np.ndarray,
    velocities: np.ndarray | None,
    cell: np.ndarray | None,
    time: float,
) -> "ase.Atoms":
    """The sites with mass as an `ase.Atoms`, with masses, names and residues of the models, and
    `info["time_ps"]`, from positions and velocities (s, 3) of all sites, Å and Å/ps, and a cell (3,
    3), None or infinite without a box."""
    import ase

    sites = system.sites
    atom = np.flatnonzero(sites.mass > 0)
    symbols = [
        "H" if e in HEAVY_HYDROGEN else e if is_element(e) else "X" for e in sites.element[atom]
    ]
    boxed = cell is not None and bool(np.isfinite(cell).all())
    atoms = ase.Atoms(
        symbols,
        positions=np.asarray(positions, float)[atom],
        masses=sites.mass[atom],
        cell=cell if boxed else None,
        pbc=boxed,
        info={"time_ps": time},
    )
    if velocities is not None:
        atoms.set_velocities(np.asarray(velocities, float)[atom] / ASE_VELOCITY)
    of_atom = sites.molecule[atom]
    atoms.set_array(NAMES, sites.name[atom].astype(str))
    atoms.set_array(RESIDUE_NAMES, system.residue_names[of_atom].astype(str))
    atoms.set_array(RESIDUE_NUMBERS, system.residue_number[of_atom].astype(int))
    return atoms


TAG = "ASE-Trajectory"
#: Additional arrays: indices of the atoms among the sites (first frame), positions and velocities
#: of the other sites.
ATOMS = "rigidmd_atoms"
MASSLESS = "rigidmd_massless"
MASSLESS_VELOCITY = "rigidmd_massless_velocity"
#: Bytes of the head of a file: magic number, tag, version, number of items, offset of their table.
HEAD = 48
#: What the library raises for damaged files.
DAMAGE = (KeyError, TypeError, IndexError, AttributeError, OverflowError, MemoryError)


class Stored(NamedTuple):
    """A frame of a file, in Å and ASE's unit of momentum. All arrays are float64."""

    positions: np.ndarray  # (a, 3) of the atoms
    momenta: np.ndarray | None  # (a, 3)
    massless: np.ndarray | None  # (m, 3); None if all sites have mass
    massless_velocity: np.ndarray | None  # (m, 3) Å/ps
    cell: np.ndarray | None  # (3, 3); None without a box
    time: float  # ps
    step: int


class TrajReader:
    """Reads the frames of a file that rigidmd wrote. Methods raise only ValueError or OSError."""

    def __init__(self, path: Path):
        from ase.io import ulm

        self._path, self._size = path, path.stat().st_size
        with path.open("rb") as file:
            head = np.frombuffer(file.read(HEAD)[24:], "<i8")
        if len(head) != 3 or not 0 <= head[1] <= self._size // 8:
            raise ValueError("not a trajectory of ASE, or damaged")
        try:
            self._file = ulm.Reader(path)
        except DAMAGE as error:
            raise ValueError(f"it is damaged: {error}") from None
        try:
            if self._file.get_tag() != TAG:
                raise ValueError("not a trajectory of ASE")
            self.count = len(self._file)
            self._atoms = np.zeros(0, np.int64)
            self._mass = np.zeros(0)
            if self.count:
                self._atoms = self._array(self._file, ATOMS, (-1,), np.int64)
                self._mass = self._array(self._file, "masses", (len(self._atoms),))
            self.sites = len(self._atoms)
            if self.count and MASSLESS in self._file:
                self.sites += len(self._array(self._file, MASSLESS, (-1, 3)))
            is_inside = not len(self._atoms) or (
                self._atoms[0] >= 0 and self._atoms[-1] < self.sites
            )
            if not np.array_equal(np.unique(self._atoms), self._atoms) or not is_inside:
                raise ValueError("it is damaged: its indices of atoms are invalid")
        except Exception:  # no file stays open
            self.close()
            raise

    def close(self) -> None:
        self._file.close()

    def read(self, k: int) -> Stored:
        try:
            item = self._file[k]
            cell: np.ndarray = np.array(item.cell, float)
            info = cast(Json, item.get("info") or {})
            if cell.shape != (3, 3):
                raise ValueError("it is damaged: a cell is not of shape (3, 3)")
            n = len(self._atoms)
            m = self.sites - len(self._atoms)
            sizes = {"positions": n, "momenta": n, MASSLESS: m, MASSLESS_VELOCITY: m}
            present = {name for name in sizes if name == "positions" or name in item}
            arrays = [
                self._array(item, name, (size, 3)) if name in present else None
                for name, size in sizes.items()
            ]
            return Stored._make(
                [*arrays, cell if cell.any() else None, float(info["time_ps"]), int(info["step"])]
            )
        except DAMAGE as error:
            raise ValueError(f"frame {k + 1} is damaged: {error}") from None

    def frame(self, k: int) -> Frame:
        stored = self.read(k)
        positions = self._joined(stored.positions, stored.massless)
        velocities = None
        if stored.momenta is not None:
            velocities = self._joined(
                stored.momenta / self._mass[:, None] * ASE_VELOCITY, stored.massless_velocity
            )
        return Frame(stored.time, positions, stored.cell, velocities, step=stored.step)

    def _joined(self, of_atoms: np.ndarray, others: np.ndarray | None) -> np.ndarray:
        of_sites = np.empty((self.sites, 3))
        of_sites[self._atoms] = of_atoms
        if others is not None:
            of_sites[np.setdiff1d(np.arange(self.sites), self._atoms)] = others
        return of_sites

    def _array(
        self, item: "ulm.Reader", name: str, shape: tuple[int, ...], kind: type = np.float64
    ) -> np.ndarray:
        """An array of an item with this type and shape (-1: any length)."""
        try:
            stored = item.proxy(name)
            fits = len(shape) == stored.ndim and all(
                n in (-1, m) for n, m in zip(shape, stored.shape, strict=False)
            )
            if (
                stored.dtype != kind
                or not fits
                or stored.offset < 0
                or stored.offset + stored.nbytes > self._size
            ):
                raise ValueError(f"it is damaged: {name} has the wrong type, shape or offset")
            array = np.array(stored.read())
        except (AssertionError, *DAMAGE):
            raise ValueError(
                f"it is damaged, or not a trajectory of rigidmd: it has no {name}"
            ) from None
        if kind is np.float64 and not np.isfinite(array).all():
            raise ValueError(f"it is damaged: {name} has values that are not finite")
        return array


def _items(file: "TrajectoryWriter") -> "ulm.Writer":
    return cast("ulm.Writer", file.backend)


class TrajFile(FrameFile["TrajectoryWriter", Stored]):
    """Writes ASE's .traj files of molecules, in double precision, for `ase gui` and
    `ase.io.read`."""

    def __init__(
        self,
        path: Path,
        system: MolecularSystem,
        velocities: bool,
        wrapped: bool,
        kept: Sequence[int] | None = None,
    ):
        self._massive = np.flatnonzero(system.sites.mass > 0)
        self._massless = np.flatnonzero(system.sites.mass == 0)
        # its symbols, masses and periodicity are the same in every frame
        self._template = atoms_of_sites(
            system, system.site_positions(system.state), None, system.state.cell, 0.0
        )
        super().__init__(path, system, velocities, wrapped, kept)

    @property
    def kept(self) -> tuple[int, int]:
        with self._writing():
            os.fsync(_items(self._file).fd.fileno())
        return super().kept

    def _frame(self, state: State, time: float, step: int) -> Stored:
        system = self._system
        position = system.site_positions(state, self._wrapped)
        cell = state.cell if np.isfinite(state.cell).all() else None
        momenta = of_massless = None
        if self._velocities:
            velocity = system.site_velocities(state)
            momenta = atoms_of_sites(system, position, velocity, state.cell, time).get_momenta()
            of_massless = velocity[self._massless]
        massless = position[self._massless]
        if not len(massless):
            massless = of_massless = None
        return Stored(
            position[self._massive], momenta, massless, of_massless, cell, float(time), int(step)
        )

    def _append(self, file: "TrajectoryWriter", frame: Stored) -> None:
        atoms = self._template
        atoms.set_positions(frame.positions)
        if frame.cell is not None:
            atoms.set_cell(frame.cell)
        if frame.momenta is not None:
            atoms.set_momenta(frame.momenta)
        atoms.info = {"time_ps": frame.time, "step": frame.step}
        additional = {MASSLESS: frame.massless, MASSLESS_VELOCITY: frame.massless_velocity}
        items = _items(file)
        if len(items) == 0:
            additional[ATOMS] = self._massive.astype(np.int64)
        items.write(**{name: array for name, array in additional.items() if array is not None})
        file.write(atoms)

    def _stored_frames(self, count: int) -> Iterator[Stored]:
        sites = len(self._system.sites.mass)
        with contextlib.closing(TrajReader(self._path)) as old:
            if old.count < count or old.sites != sites:
                raise ValueError(f"{count} frames of {sites} sites are needed")
            for k in range(count):
                yield old.read(k)

    def _arrays(self, frame: Stored) -> list[np.ndarray]:
        return [
            *(part for part in frame[:5] if part is not None),
            np.array([frame.time, float(frame.step)]),
        ]

    def _open(self, path: Path, mode: str) -> "TrajectoryWriter":
        from ase.io.trajectory import TrajectoryWriter  # slow to import

        return TrajectoryWriter(path, mode)


register(
    Format(
        (".traj",),
        writer=TrajFile,
        reader=TrajReader,
        velocities=True,
        double=True,
        viewer="ase gui {trajectory}",
    )
)
