"""A state on disk, every bit of it: `final.npz`, from which another run can start ([structure] file = "final.npz")."""

from pathlib import Path

import numpy as np

from rigidmd.build.system import System
from rigidmd.forces.space import cell_of
from rigidmd.forces.terms import State
from rigidmd.output.folder import whole_file


def write_state(path: Path, system: System, state: State) -> None:
    """Write a state; build.structure reads it back. No pickle in it."""
    names = list(dict.fromkeys(m.name for m in system.species))
    with whole_file(path) as temporary:
        np.savez(
            temporary,
            species_names=np.array(names),
            species=np.array([names.index(m.name) for m in system.species])[system.model.species],
            residue_number=system.residue_number,
            cell=cell_of(system.space),
            **state._asdict(),
        )
