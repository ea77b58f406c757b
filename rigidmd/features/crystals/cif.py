"""CIF of crystals and mmCIF of molecules. gemmi reads the syntax, and has the space groups.

In its structures atoms that are listed with their images count twice, atoms near special positions
stay there, and a contradiction or another possible setting has no message. ASE refuses many symbols
of space groups, and types that are not elements. So the module `crystal` applies the symmetry.
"""

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rigidmd.core.toml import parse_whole_number
from rigidmd.features.crystals.cif_syntax import parse_cif, tag_of
from rigidmd.features.crystals.crystal import (
    NoSymmetry,
    Statement,
    UnitCell,
    group_of,
    keep_cell,
    name_of,
    parse_operation,
    settings_of_code,
    settings_of_hall,
    settings_of_name,
    settings_of_number,
    settings_of_system,
    unit_cell,
)
from rigidmd.formats import Format, register
from rigidmd.formats.atoms import (
    HEAVY_HYDROGEN,
    MASSLESS_NAME,
    Atoms,
    element_of,
    element_of_symbol,
    is_element,
    last_digit,
    may_be_name,
    structure_error,
)
from rigidmd.formats.cells import cell_error, cell_of, describe_cell
from rigidmd.units import GRAM_PER_CM3

if TYPE_CHECKING:
    import gemmi

#: Occupancies of at least this, or within their uncertainty of 1, are 1.
FULL = 0.999
#: Relative difference of two densities that rounding and the choice of masses explain.
SAME_DENSITY = 0.02
#: Relative difference of a matrix in an mmCIF from that of its cell in the standard orientation, by
#: printed digits.
SAME_MATRIX = 1e-3
MOST_LISTED = 6  # atoms in a message
CELL = [
    f"_cell_{part}"
    for part in ("length_a", "length_b", "length_c", "angle_alpha", "angle_beta", "angle_gamma")
]
OPERATIONS = ("_space_group_symop_operation_xyz", "_symmetry_equiv_pos_as_xyz")
HALL = ("_space_group_name_hall", "_symmetry_space_group_name_hall")
NAMES = (
    "_space_group_name_h-m_alt",
    "_space_group_name_h-m_full",
    "_symmetry_space_group_name_h-m",
    "_symmetry_pdbx_full_space_group_name_h-m",
    "_space_group_name_h-m_ref",
)
NUMBERS = ("_space_group_it_number", "_symmetry_int_tables_number")
CODES = ("_space_group_it_coordinate_system_code",)
SYSTEMS = ("_space_group_crystal_system", "_symmetry_cell_setting")
LISTED = "its list of operations"
MODEL = "_atom_site_pdbx_pdb_model_num"
FORMULA, UNITS_IN_CELL = "_chemical_formula_sum", "_cell_formula_units_z"
DENSITY = "_exptl_crystal_density_diffrn"
#: Tags that are read, next to those of atoms.
READ = {*CELL, *OPERATIONS, *HALL, *NAMES, *NUMBERS, *CODES, *SYSTEMS}
READ |= {FORMULA, UNITS_IN_CELL, DENSITY}
#: Neighbouring residues of an mmCIF differ in one of these.
RESIDUE = (
    "label_asym_id",
    "auth_asym_id",
    "label_seq_id",
    "auth_seq_id",
    "pdbx_pdb_ins_code",
    "label_comp_id",
)


def _is_read(tag: str) -> bool:
    is_of_atoms = tag.startswith("_atom_site") and not tag.startswith("_atom_site_aniso")
    return is_of_atoms or tag in READ


class Block:
    """The values of a data block by tag, in lower case and with _ for the . of mmCIF. None for
    values not given."""

    def __init__(self, block):
        self._raw: dict[str, list[str]] = {}
        for item in block:
            if item.pair is not None:
                self._raw[tag_of(item.pair[0])] = [item.pair[1]]
            elif item.loop is not None:
                values = item.loop.values
                width = item.loop.width()
                self._raw |= {tag_of(tag): values[k::width] for k, tag in enumerate(item.loop.tags)}

    def __contains__(self, tag: str) -> bool:
        return tag in self._raw

    def column(self, tag: str) -> list[str | None]:
        """All values of a tag. None if the block does not have it."""
        import gemmi

        return [
            None if gemmi.cif.is_null(raw) else gemmi.cif.as_string(raw).strip()
            for raw in self._raw.get(tag, ())
        ]

    def first(self, *tags: str) -> str | None:
        """The first value that one of the tags has."""
        return next((value for tag in tags for value in self.column(tag) if value), None)


def number_of(text: str | None) -> tuple[float, float]:
    """A number and its standard uncertainty, as of 0.1185(5). NaN and 0 if the text is not one."""
    match = re.fullmatch(
        r"([-+]?(?:\d+\.?(\d*)|\.(\d+))(?:[eE][-+]?\d+)?)(?:\((\d+)\))?", text or ""
    )
    if not match:
        return np.nan, 0.0
    digits = len(match[2] or match[3] or "")
    return float(match[1]), int(match[4] or 0) / 10**digits


def numbers_of(texts: Iterable[str | None]) -> np.ndarray:
    """The numbers (n,) of texts, as of `number_of`."""
    return np.array([number_of(text)[0] for text in texts])


def read_cif(path: Path, lines: list[str]) -> list[Callable[[], Atoms]]:
    """The structures of a file: its data blocks with atoms, and the models in them."""
    blocks, notes = parse_cif(path, lines, _is_read)
    structures = []
    for content in blocks:
        block = Block(content)
        count = max(len(block.column(f"_atom_site_{axis}_x")) for axis in ("fract", "cartn"))
        models: dict[str | None, list[int]] = {}
        for row, model in enumerate(block.column(MODEL) or [None] * count):
            models.setdefault(model, []).append(row)
        structures += [partial(_structure, path, block, rows, notes) for rows in models.values()]
    return structures


def _structure(path: Path, block: Block, rows: list[int], syntax: list[str]) -> Atoms:
    """One structure: the atoms of these rows and their images by symmetry. `syntax`: notes on the
    file."""
    sites = AtomSites(block, rows)
    _check_order(path, sites)
    names, elements = sites.names()
    residue = sites.residues()
    cell = _cell(path, block)
    is_fractional = sites.has("fract_x")
    position = _coordinates(path, sites, names, "fract" if is_fractional else "cartn")
    if cell is None and is_fractional:
        raise structure_error(path, f"has no cell: {CELL[0]} to {CELL[-1]} are missing")
    # the placeholder of the PDB
    if cell is None or (not is_fractional and np.allclose(cell, np.eye(3))):
        rounding = last_digit(sites.texts_of_coordinates("cartn"))
        return Atoms(names, elements, residue, position, cell=cell, notes=syntax, rounding=rounding)
    if not is_fractional:
        position = _to_fractional(block, position, cell)
    operations, notes = _symmetry(path, block, cell)
    notes = [*syntax, *notes]
    kinds = [
        element or element_of(name) or name for name, element in zip(names, elements, strict=True)
    ]
    try:
        contents = unit_cell(position, kinds, _radii(kinds), operations, cell)
    except NoSymmetry as error:
        reason = "its atoms are disordered, or have another symmetry than it states"
        as_read = f" ({'; '.join(notes)})" if notes else ""
        raise structure_error(path, f"{error} in the cell: {reason}{as_read}") from None
    owner = contents.source_atom
    order = len(operations) if operations else 1
    notes += _contents(block, kinds, contents, cell, order)
    return Atoms(
        [names[k] for k in owner],
        [elements[k] for k in owner],
        [residue[k] for k in owner] if order == 1 else [()] * len(owner),
        contents.fractional @ cell,
        cell=cell,
        notes=notes,
        charges=None if (charges := sites.charges(path)) is None else charges[owner],
    )


class AtomSites:
    """The columns of some atoms, without those flagged as dummies, whose coordinates have no
    meaning."""

    def __init__(self, block: Block, rows: list[int]):
        flags = block.column("_atom_site_calc_flag")
        self._block = block
        self._rows = [row for row in rows if not flags or (flags[row] or "").lower() != "dum"]
        self._formula = _formula(block.first(FORMULA) or "")

    def __len__(self) -> int:
        return len(self._rows)

    def has(self, part: str) -> bool:
        return f"_atom_site_{part}" in self._block

    def column(self, part: str) -> list[str | None]:
        """The values of the tag _atom_site_{part}. None where it has none."""
        values = self._block.column(f"_atom_site_{part}")
        return [values[row] for row in self._rows] if values else [None] * len(self)

    def texts_of_coordinates(self, axes: str) -> Iterator[str]:
        """Coordinates as they are in the file, without their uncertainties."""
        for x in "xyz":
            yield from ((text or "").partition("(")[0] for text in self.column(f"{axes}_{x}"))

    def charges(self, path: Path) -> np.ndarray | None:
        """Charges (n,) in e. None without any. Raises StructureError if some atoms have one."""
        texts = self.column("charge")
        if not any(texts):
            return None
        charges = numbers_of(texts)
        if len(bad := np.flatnonzero(np.isnan(charges))):
            name, found = self.names()[0][bad[0]], texts[bad[0]] or "none"
            what = "a number, as other atoms have"
            raise structure_error(
                path, f"atom {name}: expected _atom_site_charge as {what}, found {found}"
            )
        return charges

    def names(self) -> tuple[list[str], list[str]]:
        """Names and elements. A type that is not an element, such as OW or M, is the name."""
        is_mmcif = self.has("label_atom_id")
        labels = self.column("label_atom_id" if is_mmcif else "label")
        authors = self.column("auth_atom_id")
        names, elements = [], []
        for label, author, symbol in zip(labels, authors, self.column("type_symbol"), strict=True):
            element = _element(symbol or "")
            if is_mmcif or element.capitalize() in self._formula:
                element = element.capitalize()  # symbols of mmCIF are in capitals
            elif element[:1] in self._formula and may_be_name(element):
                element = ""
            is_type = (
                bool(symbol) and not is_mmcif and (element in ("", "X") or may_be_name(element))
            )
            names.append((symbol if is_type else label or author or symbol) or "")
            elements.append(element)
        return names, elements

    def residues(self) -> list[tuple]:
        """Residues of an mmCIF: number, name and a count that differs between neighbours."""
        if not self.has("label_comp_id"):
            return [()] * len(self)
        keys = list(zip(*(self.column(part) for part in RESIDUE), strict=True))
        numbers = [
            author or label
            for label, author in zip(
                self.column("label_seq_id"), self.column("auth_seq_id"), strict=True
            )
        ]
        residues = []
        count = 0
        for k, name in enumerate(self.column("label_comp_id")):
            count += k == 0 or keys[k] != keys[k - 1]
            residues.append((parse_whole_number(numbers[k] or ""), name or "", count))
        return residues


def _element(symbol: str) -> str:
    """The element of a type such as C, Cl, O2- or D, as of `element_of_symbol`. X for massless
    sites."""
    match = re.fullmatch(r"([A-Za-z]{1,2})[\d.]*[-+]?\d*", symbol)
    if match and (element := element_of_symbol(match[1])):
        return element
    return "X" if MASSLESS_NAME.fullmatch(symbol) else ""


def _radii(kinds: list[str]) -> np.ndarray:
    """Covalent radii, Å."""
    from ase.data import atomic_numbers, covalent_radii

    known = {
        kind: "H" if kind in HEAVY_HYDROGEN else kind if is_element(kind) else element_of(kind)
        for kind in set(kinds)
    }
    return np.array([covalent_radii[atomic_numbers[known[kind] or "X"]] for kind in kinds])


def _check_order(path: Path, sites: AtomSites) -> None:
    """Raise StructureError for a disordered crystal."""
    if len(alternatives := sorted({x for x in sites.column("label_alt_id") if x})) > 1:
        raise structure_error(
            path, f"has alternate locations {', '.join(alternatives)}. Keep one of them"
        )
    texts = sites.column("occupancy")
    occupancies = [(1.0, 0.0) if text is None else number_of(text) for text in texts]
    if sites.has("cartn_x") and not any(value for value, _ in occupancies):
        return  # as OpenMM writes them
    names = sites.names()[0]
    if wrong := sorted(
        {
            f"{text}"
            for text, (x, _) in zip(texts, occupancies, strict=True)
            if not 0 <= x <= 2 - FULL
        }
    ):
        raise structure_error(path, f"some of its sites have the occupancy {', '.join(wrong)}")
    partial_sites = sorted(
        {
            f"{name} {value:g}"
            for name, (value, error) in zip(names, occupancies, strict=True)
            if value < FULL and value + error < 1
        }
    )
    groups = sorted({group for group in sites.column("disorder_group") if group})
    if partial_sites:
        listed = ", ".join(partial_sites[:MOST_LISTED]) + (
            ", ..." if len(partial_sites) > MOST_LISTED else ""
        )
        disorder = f"some of its sites are occupied only partly ({listed})"
    elif len(groups) > 1 or any(group.startswith("-") for group in groups):
        disorder = f"its atoms are in disorder groups {', '.join(groups)}"
    else:
        return
    hint = (
        "in which every site is occupied or left out (for ices, GenIce makes proton-disordered"
        " ones)"
    )
    consequence = "so that molecules are unknown. Choose one arrangement of it"
    raise structure_error(path, f"{disorder}: the crystal is disordered, {consequence}, {hint}")


def _coordinates(path: Path, sites: AtomSites, names: list[str], axes: str) -> np.ndarray:
    """Coordinates (n, 3), fractional or in Å."""
    columns = [sites.column(f"{axes}_{x}") for x in "xyz"]
    position = np.array([numbers_of(column) for column in columns]).T
    if len(bad := np.flatnonzero(np.isnan(position).any(axis=1))):
        words = " ".join(str(column[bad[0]]) for column in columns)
        raise structure_error(
            path, f"atom {names[bad[0]]} has no position, expected three numbers, found {words}"
        )
    return position.reshape(-1, 3)


def _cell(path: Path, block: Block) -> np.ndarray | None:
    """The cell (3, 3) in the standard orientation. None if the file has none. Raises
    StructureError."""
    texts = [block.first(tag) for tag in CELL]
    if not any(texts):
        return None
    numbers = numbers_of(texts)
    if missing := [tag for tag, x in zip(CELL, numbers, strict=True) if np.isnan(x)]:
        raise structure_error(path, f"its cell is incomplete: {', '.join(missing)} is not a number")
    cell = cell_of(numbers.tolist())
    if cell is None:
        raise structure_error(path, f"no cell has the edges and angles {' '.join(map(str, texts))}")
    if error := cell_error(cell):
        raise structure_error(path, f"its cell: {error}")
    return cell


def _to_fractional(block: Block, position: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """Fractional coordinates of positions (n, 3) in Å, by the matrix in an mmCIF if the orientation
    is not standard."""
    standard = np.linalg.inv(cell).T
    matrix = [
        [block.first(f"_atom_sites_fract_transf_matrix[{i}][{j}]") for j in "123"] for i in "123"
    ]
    shift = [block.first(f"_atom_sites_fract_transf_vector[{i}]") for i in "123"]
    w, t = np.array([numbers_of(row) for row in matrix]), numbers_of(shift)
    if np.isnan(w).any() or np.isnan(t).any():
        return position @ standard.T
    is_standard = np.abs(w - standard).max() <= SAME_MATRIX * np.abs(standard).max() and not t.any()
    return position @ standard.T if is_standard else position @ w.T + t


def _symmetry(
    path: Path, block: Block, cell: np.ndarray
) -> "tuple[gemmi.GroupOps | None, list[str]]":
    """The symmetry operations, None for the identity alone, and notes on where they are from.

    The list of operations of a file defines the symmetry. Without one it is defined by its Hall
    symbol, its Hermann-Mauguin symbol, or the number of its space group, in this order. Statements
    of less rank select among the settings that are possible.
    """
    stated_symmetry = [*_listed(path, block), *_tabulated(block)]
    statements = [statement for statement in stated_symmetry if statement.settings]
    if not statements:
        if stated := block.first(*HALL, *NAMES, *NUMBERS):
            message = f"its space group {stated} is unknown: give its operations ({OPERATIONS[0]})"
            raise structure_error(path, message)
        is_crystal = "_atom_site_fract_x" in block
        note = (
            "no symmetry operations in the file: its atoms were taken as all atoms of the unit cell"
        )
        return None, [note] if is_crystal else []
    used, *others = statements
    settings = [setting for setting in used.settings if keep_cell(setting, cell)]
    if not settings:
        raise structure_error(path, f"{used.what} cannot be in its cell, {describe_cell(cell)}")
    contradicting = []
    for other in others:
        if agreeing := [setting for setting in settings if setting in other.settings]:
            settings = agreeing
        else:
            contradicting.append(other)
    is_listed = used.what == LISTED
    if contradicting and not is_listed:
        what = " and ".join([used.what, *(other.what for other in contradicting)])
        advice = f"correct one of them, or list the operations ({OPERATIONS[0]})"
        raise structure_error(path, f"{what} contradict each other: {advice}")
    notes = [_described(settings, used)]
    if contradicting:
        notes.append(
            f"{' and '.join(other.what for other in contradicting)} would be another symmetry"
        )
    system = block.first(*SYSTEMS)
    of_system = settings_of_system(system) if system else []
    if of_system and not any(keep_cell(setting, cell) for setting in of_system):
        notes.append(f"its cell, {describe_cell(cell)}, is not {system}, as the file states")
    if not is_listed:
        unknown = [statement.what for statement in stated_symmetry if not statement.settings]
        unknown += [f"its crystal system {system}"] if system and not of_system else []
        notes += [f"{what} is unknown" for what in unknown]
    return settings[0], notes


def _described(settings: "list[gemmi.GroupOps]", used: Statement) -> str:
    """Where the operations of the first setting are from, and which other ones the file may
    mean."""
    chosen, *possible = settings
    if used.what == LISTED and len(chosen) == 1:
        return "x,y,z is the only symmetry operation in the file"
    count = f"{len(chosen)} symmetry operation{'s' * (len(chosen) > 1)}"
    if used.what == LISTED:
        name = name_of(chosen)
        return f"{count} in the file" + (f", which are those of {name}" if name else "")
    note = f"{count} of {used.what}, as the file lists none"
    if not possible:
        return note
    names = ", ".join(name_of(setting) for setting in possible[:MOST_LISTED]) + (
        ", ..." if possible[MOST_LISTED:] else ""
    )
    return (
        f"{note}: the setting {name_of(chosen)} was assumed, which the file does not state (it may"
        f" be {names})"
    )


def _listed(path: Path, block: Block) -> Iterator[Statement]:
    """The list of operations. Raises StructureError if it is not a group."""
    lists = []
    for tag in OPERATIONS:
        texts = [text for text in block.column(tag) if text]
        operations = []
        for text in texts:
            try:
                operations.append(parse_operation(text))
            except ValueError as error:
                message = (
                    f"{tag}: expected an operation such as x,1/2-y,z, found {text[:40]!r} ({error})"
                )
                raise structure_error(path, message) from None
        if operations:
            lists.append(operations)
    if not lists:
        return
    groups = [group_of(operations) for operations in lists]
    if groups[0] != groups[-1]:
        raise structure_error(
            path, f"its two lists of operations differ, {' and '.join(OPERATIONS)}: keep one"
        )
    if groups[0] is None:
        count = len(set(lists[0]))
        raise structure_error(
            path, f"its {count} symmetry operations are not a group: is one missing or misprinted?"
        )
    yield Statement(LISTED, [groups[0]])


def _tabulated(block: Block) -> list[Statement]:
    """What a file states about its space group, in the order of rank, with no settings for what no
    table has."""
    statements = []
    if symbol := block.first(*HALL):
        statements.append(Statement(f"its Hall symbol {symbol}", settings_of_hall(symbol)))
    names = dict.fromkeys(name for tag in NAMES if (name := block.first(tag)))
    statements += [Statement(f"its space group {name}", settings_of_name(name)) for name in names]
    if number := block.first(*NUMBERS):
        settings = settings_of_number(parse_whole_number(number) or 0)
        statements.append(Statement(f"its space group number {number}", settings))
    if any(statement.settings for statement in statements) and (code := block.first(*CODES)):
        statements.append(Statement(f"its coordinate system code {code}", settings_of_code(code)))
    return statements


def _contents(
    block: Block, kinds: list[str], contents: UnitCell, cell: np.ndarray, order: int
) -> list[str]:
    """Notes on the numbers of atoms and the density of the unit cell, compared with what the file
    states."""
    from ase.data import atomic_masses, atomic_numbers

    count = Counter(kinds[k] for k in contents.source_atom)
    massive = {kind: n for kind, n in count.items() if is_element(kind) or kind in HEAVY_HYDROGEN}
    mass = sum(
        n * (HEAVY_HYDROGEN[e] if e in HEAVY_HYDROGEN else atomic_masses[atomic_numbers[e]])
        for e, n in massive.items()
    )
    volume = abs(np.linalg.det(cell))
    density = mass / volume / GRAM_PER_CM3
    notes = []
    if order > 1:
        composition = " ".join(f"{kind}{n}" for kind, n in sorted(count.items()))
        notes.append(
            f"its cell of {volume:.5g} Å³ holds {composition}, {density:.4g} g/cm³, from"
            f" {len(kinds)} atom{'s' * (len(kinds) > 1)} in the file, {contents.special_count} on"
            " special positions"
        )
    if contents.copy_count:
        notes.append(
            f"{contents.copy_count} atoms of the file are images of others by symmetry"
            " and count once"
        )
    stated = number_of(block.first(DENSITY))[0]
    if stated > 0 and abs(density - stated) > SAME_DENSITY * stated:
        notes.append(
            f"the density in the file is {stated:g} g/cm³, but its atoms make {density:.4g} g/cm³"
        )
    formula = _formula(block.first(FORMULA) or "")
    units = number_of(block.first(UNITS_IN_CELL))[0]
    multiples = {units, 1.0}  # 1: pymatgen gives the formula of the cell
    if (
        formula
        and units > 0
        and not any(massive == {e: n * z for e, n in formula.items()} for z in multiples)
    ):
        expected = " ".join(f"{element}{n * units:g}" for element, n in sorted(formula.items()))
        present = " ".join(f"{element}{n}" for element, n in sorted(massive.items()))
        notes.append(f"its formula and Z are {expected} in the cell, but its atoms make {present}")
    return notes


def _formula(text: str) -> dict[str, float]:
    """Numbers of atoms in a formula such as C6 H6. The result is empty if the formula is
    unreadable."""
    words = [re.fullmatch(r"([A-Z][a-z]?)(\d*\.?\d*)", word) for word in text.split()]
    if not all(words):
        return {}
    return {word[1]: float(word[2] or 1) for word in words if word}


register(
    Format(
        (".cif", ".mmcif"),
        read=read_cif,
        crystals=True,
        content=re.compile(r"\A(?:[ \t]*(?:#.*)?\n)*[ \t]*data_\S", re.IGNORECASE),
    )
)
