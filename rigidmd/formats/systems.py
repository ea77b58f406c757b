"""What formats use of the system of a run, which is of the package `engines` above this one."""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Protocol

import numpy as np

from rigidmd.core.state import State


class Sites(Protocol):
    """The sites of a system (s,), molecule by molecule."""

    @property
    def name(self) -> np.ndarray: ...
    @property
    def element(self) -> np.ndarray: ...
    @property
    def mass(self) -> np.ndarray: ...
    @property
    def molecule(self) -> np.ndarray: ...


class Placed(Protocol):
    """What systems of all kinds have."""

    @property
    def state(self) -> State: ...
    @cached_property
    def sites(self) -> Sites: ...
    @property
    def residue_names(self) -> np.ndarray: ...
    def site_positions(self, state: State, wrapped: bool = False) -> np.ndarray: ...
    def site_velocities(self, state: State) -> np.ndarray: ...


class Shape(Protocol):
    """The sites of a molecule (s,) that bonds depend on."""

    @property
    def positions_body(self) -> np.ndarray: ...
    @property
    def masses(self) -> np.ndarray: ...
    @property
    def elements(self) -> Sequence[str]: ...


class Species(Shape, Protocol):
    """A kind of molecule: a `scene.models.Molecule`."""

    @property
    def name(self) -> str: ...
    @property
    def mass(self) -> float: ...
    @property
    def inertia(self) -> np.ndarray: ...
    @property
    def site_names(self) -> Sequence[str]: ...
    @property
    def charges(self) -> np.ndarray: ...
    @property
    def sigma(self) -> np.ndarray: ...
    @property
    def epsilon(self) -> np.ndarray: ...


class Model(Protocol):
    @property
    def species(self) -> np.ndarray: ...  # (n,) the index of the species of each molecule


class MolecularSystem(Placed, Protocol):
    """An `engines.system.System`."""

    @cached_property
    def sites(self) -> Sites: ...
    @property
    def species(self) -> Sequence[Species]: ...
    @property
    def model(self) -> Model: ...
    @property
    def residue_number(self) -> np.ndarray: ...
    def of_sites(self, of: Callable[[Species], np.ndarray]) -> np.ndarray: ...
    def centres(self, state: State, wrapped: bool = False) -> np.ndarray: ...
