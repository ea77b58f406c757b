"""The system of a scene of any kind and its sites, as runs, output and analysis use them."""

from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from rigidmd.core.state import State

if TYPE_CHECKING:
    from rigidmd.scene import OneScene


class Sites(NamedTuple):
    """All sites of a system, molecule by molecule, for output and analysis."""

    molecule: np.ndarray  # (s,)
    offset_body: np.ndarray  # (s, 3)
    name: np.ndarray  # (s,) text
    element: np.ndarray  # (s,) text
    mass: np.ndarray  # (s,)

    def __repr__(self) -> str:
        return f"<Sites: {len(self.name)} of {len(np.unique(self.molecule))} molecules>"


class AnySystem(Protocol):
    """The system of a scene of any kind."""

    @property
    def scene(self) -> "OneScene": ...  # resolved
    @property
    def state(self) -> State: ...  # at the start
    @property
    def notes(self) -> list[str]: ...
    @property
    def warnings(self) -> list[str]: ...
    @cached_property
    def sites(self) -> Sites: ...
    @property
    def charges(self) -> np.ndarray: ...  # (s,) e
    @property
    def residue_names(self) -> np.ndarray: ...
    def connections(self, *, massless: bool = False) -> np.ndarray: ...  # (b, 2) joined sites
    def site_positions(self, state: State, wrapped: bool = False) -> np.ndarray: ...
    def site_velocities(self, state: State) -> np.ndarray: ...
