"""ASE's own trajectories (.traj) as rigidmd writes them: atoms as ASE has them, and what it has no place for.

The atoms are the sites with mass. Arrays of rigidmd's own, which ASE passes by, hold the sites without mass and say
which sites the atoms are. A file is read item by item; sizes that it promises are compared with what it holds before
anything is made of them.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rigidmd.io.formats.through_ase import ASE_VELOCITY

#: What ASE calls such files.
TAG = "ASE-Trajectory"
#: Arrays of our own: index of the atoms among the sites, in the first frame; positions and velocities of other sites.
ATOMS, MASSLESS, MASSLESS_VELOCITY = "rigidmd_atoms", "rigidmd_massless", "rigidmd_massless_velocity"
#: Bytes of the head of a file: magic number, tag, version, number of items, place of their table.
HEAD = 48


class Stored(NamedTuple):
    """A frame as a file holds it, in Å and ASE's unit of momentum; every array float64."""

    positions: np.ndarray  # (a, 3) of the atoms
    momenta: np.ndarray | None  # (a, 3)
    massless: np.ndarray | None  # (m, 3); None where every site has mass
    massless_velocity: np.ndarray | None  # (m, 3) Å/ps
    cell: np.ndarray | None  # (3, 3); None without a box
    time: float  # ps
    step: int


class TrajReader:
    """Reads the frames of a file that rigidmd wrote. Methods raise ValueError or OSError, and nothing else."""

    def __init__(self, path: Path):
        from ase.io import ulm

        self._path, self._size = path, path.stat().st_size
        with path.open("rb") as file:
            head = np.frombuffer(file.read(HEAD)[24:], "<i8")
        if len(head) != 3 or not 0 <= head[1] <= self._size // 8:
            raise ValueError("it is no trajectory of ASE, or damaged")
        try:
            self._file = ulm.Reader(path)
        except (KeyError, TypeError, IndexError, AttributeError, OverflowError, MemoryError) as error:
            raise ValueError(f"it is damaged: {error}") from None
        try:
            if self._file.get_tag() != TAG:
                raise ValueError("it is no trajectory of ASE")
            self.count = len(self._file)
            self._atoms = self._array(self._file, ATOMS, (-1,), np.int64) if self.count else np.zeros(0, np.int64)
            self._mass = self._array(self._file, "masses", (len(self._atoms),)) if self.count else np.zeros(0)
            self.sites = len(self._atoms)
            if self.count and MASSLESS in self._file:
                self.sites += len(self._array(self._file, MASSLESS, (-1, 3)))
            if not np.array_equal(np.unique(self._atoms), self._atoms) or not self._within():
                raise ValueError("it is damaged: its atoms are no sites")
        except Exception:  # whatever it is: an object that is not made leaves no file open
            self.close()
            raise

    def _within(self) -> bool:
        return not len(self._atoms) or (self._atoms[0] >= 0 and self._atoms[-1] < self.sites)

    def close(self) -> None:
        self._file.close()

    def read(self, k: int) -> Stored:
        """Frame k."""
        try:
            item = self._file[k]
            atoms, others = (len(self._atoms), 3), (self.sites - len(self._atoms), 3)
            has = {name: name in item for name in ("momenta", MASSLESS, MASSLESS_VELOCITY)}
            cell = np.array(item.cell, float)
            info: Any = item.get("info") or {}
            if cell.shape != (3, 3):
                raise ValueError("it is damaged: a cell is none")
            return Stored(
                self._array(item, "positions", atoms),
                self._array(item, "momenta", atoms) if has["momenta"] else None,
                self._array(item, MASSLESS, others) if has[MASSLESS] else None,
                self._array(item, MASSLESS_VELOCITY, others) if has[MASSLESS_VELOCITY] else None,
                cell if cell.any() else None,
                float(info["time_ps"]),
                int(info["step"]),
            )
        except (KeyError, TypeError, IndexError, AttributeError, OverflowError, MemoryError) as error:
            raise ValueError(f"frame {k + 1} is damaged: {error}") from None

    def of_sites(self, frame: Stored) -> tuple[np.ndarray, np.ndarray | None]:
        """Positions (s, 3), Å, and velocities (s, 3), Å/ps, of all sites in the order of the scene."""
        positions = self._joined(frame.positions, frame.massless)
        if frame.momenta is None:
            return positions, None
        return positions, self._joined(frame.momenta / self._mass[:, None] * ASE_VELOCITY, frame.massless_velocity)

    def _joined(self, of_atoms: np.ndarray, others: np.ndarray | None) -> np.ndarray:
        found = np.empty((self.sites, 3))
        found[self._atoms] = of_atoms
        if others is not None:
            found[np.setdiff1d(np.arange(self.sites), self._atoms)] = others
        return found

    def _array(self, item: Any, name: str, shape: tuple[int, ...], kind: type = np.float64) -> np.ndarray:
        """An array of an item, of this type and shape (-1: any length)."""
        try:
            there = item.proxy(name)
            fits = len(shape) == there.ndim and all(n in (-1, m) for n, m in zip(shape, there.shape, strict=False))
            if there.dtype != kind or not fits or there.offset < 0 or there.offset + there.nbytes > self._size:
                raise ValueError(f"it is damaged: {name} is not what it should be")
            found = np.array(there.read())
        except (AssertionError, AttributeError, KeyError, TypeError, IndexError, OverflowError, MemoryError):
            raise ValueError(f"it is damaged, or no trajectory of rigidmd: it has no {name}") from None
        if kind is np.float64 and not np.isfinite(found).all():
            raise ValueError(f"it is damaged: {name} has what is no finite number")
        return found
