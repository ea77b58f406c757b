"""What holds for every table of energies of users, of sites and of bodies."""

from collections.abc import Iterator
from math import inf

import numpy as np

#: Largest absolute value of a distance (Å), an energy (kJ/mol) or a force: products of a few are
#: finite.
LARGEST_VALUE = 1e30


def value_errors(name: str, r: np.ndarray, *values: np.ndarray) -> Iterator[str]:
    """Messages on distances r (n,) in Å and values (n, ...) that no table can have."""
    if not (
        all(np.isfinite(x).all() for x in (r, *values)) and (np.diff(r) > 0).all() and r[0] > 0
    ):
        yield f"{name} needs ascending distances above 0, and finite energies"
        return
    size = np.max([np.abs(x).reshape(len(r), -1).max(axis=1) for x in (r, *values)], axis=0)
    row = int(size.argmax())
    if size[row] > LARGEST_VALUE:
        yield (
            f"{name} has {size[row]:g} at {r[row]:g} Å, more than {LARGEST_VALUE:g}, the largest of"
            " a table: begin it at larger distances"
        )


def reach_errors(name: str, first: float, last: float, cutoff: float) -> Iterator[str]:
    """A message if a table does not reach from below the cutoff to the cutoff, Å."""
    if cutoff == inf or last < cutoff * (1 - 1e-12):
        unit = ". Is it in nm?" if last < 3 < cutoff <= 10 * last * 1.01 else ""
        yield f"{name} ends at {last:g} Å, before the cutoff of {cutoff:g} Å{unit}"
    elif not first < cutoff:
        yield f"{name} begins at {first:g} Å, beyond the cutoff of {cutoff:g} Å"


def start_errors(name: str, first: float, slope: float, where: str = "") -> Iterator[str]:
    """A message if the energy does not rise at shorter distances than the first one (Å).

    slope : by the distance; where : the orientations of that slope
    """
    if not slope < 0:
        yield (
            f"{name} begins at {first:g} Å, where it does not repel{where}: begin it at shorter"
            " distances"
        )
