"""A state on disk, every bit of it: `final.npz`, from which another run can start ([structure] file = "final.npz")."""

from pathlib import Path

import numpy as np

from rigidmd.build.system import System
from rigidmd.core.state import State
from rigidmd.output.folder import whole_file


def write_state(path: Path, system: System, state: State) -> None:
    """Write a state; build.structure reads it back. No pickle in it."""
    with whole_file(path) as temporary:
        np.savez(
            temporary,
            species_names=np.array([m.name for m in system.species]),
            species=system.model.species,
            **state._asdict(),
        )
