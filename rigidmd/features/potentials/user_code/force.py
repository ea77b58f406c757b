"""Forces that users write in plain Python."""

import time as clock
import traceback
from collections.abc import Callable, Sequence
from typing import ClassVar, NamedTuple, SupportsFloat, cast

import numpy as np
from numpy.typing import ArrayLike

from rigidmd.core.state import State
from rigidmd.engines.system import System
from rigidmd.errors import SimulationError, describe_error
from rigidmd.features.potentials.poses.potential import BodyPairPotential
from rigidmd.features.potentials.python_forces import PythonForces, PythonForcesWorkspace
from rigidmd.forces.parts import Tail
from rigidmd.forces.terms import trait
from rigidmd.scene.molecules import UserForce
from rigidmd.units import KJ_PER_MOL

EVERY = (True, True, True)


class BoundTerm(NamedTuple):
    """A user-defined force in a system."""

    term: NamedTuple
    description: str
    function: "BoundForce | None" = None  # of a term that Python computes
    tail: Tail | None = None  # of a pair potential, where the scene has forces.tail_correction
    notes: Sequence[str] = ()
    warnings: Sequence[str] = ()
    body_pairs: BodyPairPotential | None = None  # of which the term was made
    #: Messages on pairs for which it has no finite energy and force, of a system at its start.
    errors_at: Callable[[System], list[str]] = lambda system: []


class UserForceError(SimulationError):
    """A force of user code cannot be computed."""


class NotFiniteError(UserForceError):
    """A force of user code has values that are not finite."""


class Force(UserForce):
    """A force on molecules in plain Python: derive a class from it and define `on_sites` or
    `on_molecules`.

    It is called once for every new set of positions, between steps of the compiled loop. A
    `compiled_force` is faster.

    Attributes
    ----------
    name : str or None
        Name in logs and messages. Default: the name of the class
    changes_momentum : sequence of bool
        Which components of the total momentum it may change. False for forces between molecules
    absolute_positions : bool
        Whether its energy depends on absolute positions, which excludes a barostat. If False, its
        virial must be the last of the returned values
    energy_noise : float
        Random error of its energies, kJ/mol, for the comparison with its forces at the start of a
        run

    Examples
    --------
        class Spring(rigidmd.Force):
            def on_molecules(self, state):
                return 0.5 * (state.position**2).sum(), -state.position
    """

    name: ClassVar[str | None] = None
    changes_momentum: ClassVar[Sequence[bool]] = EVERY
    absolute_positions: ClassVar[bool] = True
    energy_noise: ClassVar[float] = 0.0

    def begin(self, system: System) -> None:
        """Called once before the first forces.

        Parameters
        ----------
        system : System
            Has `sites` (names, elements, masses, charges), `species` and `model`
        """

    def on_sites(self, position: np.ndarray, state: State) -> tuple:
        """Energy and forces on all sites.

        Parameters
        ----------
        position : ndarray
            Positions (s, 3) of the sites of `system.sites`, in its order, lab frame, Å, not wrapped
        state : State
            The state of the molecules

        Returns
        -------
        tuple
            Energy in kJ/mol, forces (s, 3) in kJ/mol/Å and, optionally, the molecular virial (3, 3)
            in kJ/mol
        """
        raise NotImplementedError

    def on_molecules(self, state: State) -> tuple:
        """Energy, forces and torques on molecules.

        Parameters
        ----------
        state : State
            The state of the n molecules

        Returns
        -------
        tuple
            Energy in kJ/mol, forces (n, 3) on centres of mass in kJ/mol/Å, lab frame, torques (n,
            3) in kJ/mol, body frame, and the molecular virial (3, 3) in kJ/mol. Torques and virial
            may be omitted
        """
        raise NotImplementedError


def bind_force(force: Force, system: System, name: str) -> BoundTerm:
    """The term of a force in a system. Raises UserForceError or ValueError."""
    function = BoundForce(force, name, system)
    return BoundTerm(function.term, f"{type(force).__qualname__}, computed by Python", function)


class BoundForce:
    """A `Force` in a system: calls it, checks the values, and converts forces on sites to forces on
    bodies.

    calls, seconds : how often it was called, and the time that this took
    may_diverge : whether values that are not finite are passed to the steps, as in trajectories of
        steps that are then rejected, else they are an error
    """

    may_diverge = False

    def __init__(self, force: Force, name: str, system: System):
        self.force, self.name, self.system = force, name, system
        self._by_site = type(force).on_sites is not Force.on_sites
        if self._by_site == (type(force).on_molecules is not Force.on_molecules):
            raise UserForceError(f"the force {name} must define one of on_sites and on_molecules")
        self.calls, self.seconds = 0, 0.0
        self._called("begin", system)
        n = len(system.state.velocity)
        turns = len(system.state.rotation) > 0
        self.term = PythonForces(
            n, turns, changes_momentum(force), trait(force, "absolute_positions")
        )

    def __call__(self, workspace: PythonForcesWorkspace, state: State) -> None:
        """Fill a workspace with the forces at a state. Raises UserForceError."""
        began = clock.perf_counter()
        try:
            if self.may_diverge and not state.is_finite:
                raise NotFiniteError(f"the force {self.name} is not known at this state")
            self._evaluate(workspace, state)
        except NotFiniteError:
            if not self.may_diverge:
                raise
            for array in (workspace.force, workspace.torque_body, workspace.tally):
                array[:] = np.nan
        workspace.fresh[0] = 1
        self.calls, self.seconds = self.calls + 1, self.seconds + clock.perf_counter() - began

    def _evaluate(self, workspace: PythonForcesWorkspace, state: State) -> None:
        state = State(*(_read_only(array) for array in state))
        if self._by_site:
            energy, force, torque, virial = self._of_sites(
                _read_only(self.system.site_positions(state)), state
            )
        else:
            energy, force, torque, virial = self._parts(self._called("on_molecules", state), 4)
        self._fill(workspace.force, force, "forces")
        # points, which have no torques, may get those of molecules
        self._fill(workspace.torque_body, torque if len(state.rotation) else None, "torques")
        if not np.isfinite(energy):
            raise self._error(f"the energy {energy}", NotFiniteError)
        numbers = np.zeros((3, 3)) if virial is None else real_numbers(virial)
        no_virial = f"{virial!r:.60} as its virial, not (3, 3) finite numbers"
        if numbers is None or numbers.shape != (3, 3):
            raise self._error(no_virial)
        if not np.isfinite(numbers).all():
            raise self._error(no_virial, NotFiniteError)
        workspace.tally[0] = energy * KJ_PER_MOL
        workspace.tally[1:] = KJ_PER_MOL * numbers.ravel()

    def _of_sites(self, position: np.ndarray, state: State) -> tuple:
        energy, force, virial, _ = self._parts(self._called("on_sites", position, state), 3)
        on_sites = np.zeros(position.shape)
        molecule = self.system.sites.molecule
        self._fill(on_sites, force, "forces", molecule, 1.0)
        total = np.zeros((len(state.velocity), 3))
        torque = None
        np.add.at(total, molecule, on_sites)
        if len(state.rotation):
            lab = np.zeros_like(total)
            np.add.at(lab, molecule, np.cross(position - state.position[molecule], on_sites))
            torque = np.einsum("nji,nj->ni", state.rotation, lab)
        return energy, total, torque, virial

    def _parts(self, returned: object, largest: int) -> list:
        """Energy and three further values, None for omitted ones."""
        if not isinstance(returned, tuple) or not 2 <= len(returned) <= largest:
            kind = type(returned).__name__
            if isinstance(returned, tuple):
                kind = f"{len(returned)} values"
            optional = (
                " and perhaps torques and a virial" if largest == 4 else " and perhaps a virial"
            )
            raise self._error(f"{kind}. It must return a tuple of an energy, forces{optional}")
        energy = real_numbers(returned[0])
        if energy is None or energy.size != 1:
            raise self._error(f"{returned[0]!r:.60} as its energy, not a real number")
        return [energy.item(), *returned[1:], *[None] * (4 - len(returned))]

    def _fill(
        self,
        target: np.ndarray,
        returned: object,
        what: str,
        molecule: np.ndarray | None = None,
        unit: float = KJ_PER_MOL,
    ) -> None:
        """Copy given values times a unit to an array of the workspace. None is 0."""
        if returned is None:
            target[:] = 0.0
            return
        array = real_numbers(returned)
        if array is None:
            kind = "masked or complex values" if hasattr(returned, "dtype") else f"{returned!r:.60}"
            raise self._error(f"{kind} as {what}, not real numbers of the shape {target.shape}")
        if array.shape != target.shape:
            raise self._error(f"{what} of the shape {array.shape}, not {target.shape}")
        if not np.isfinite(array).all():
            row = int(np.argmin(np.isfinite(array).all(axis=1)))
            k = row if molecule is None else int(molecule[row])
            which = f"molecule {k + 1} ({self.system.species[self.system.model.species[k]].name})"
            values = f"{array[row]} as {what} on {which}, which are not finite numbers"
            raise self._error(values, NotFiniteError)
        target[:] = unit * array

    def _error(self, what: str, kind: type[UserForceError] = UserForceError) -> UserForceError:
        return kind(f"the force {self.name} returned {what}")

    def _called(self, what: str, *arguments: object) -> object:
        try:
            return getattr(self.force, what)(*arguments)
        except UserForceError:
            raise
        except (Exception, SystemExit) as error:  # user code may raise anything
            last = traceback.extract_tb(error.__traceback__)[-1]
            where = f", line {last.lineno} of {last.filename}"
            raise UserForceError(
                f"{what} of the force {self.name} raised {describe_error(error)}{where}"
            ) from error


def real_numbers(values: object) -> np.ndarray | None:
    """An array of real numbers. None for anything else, such as complex numbers, text and masked
    values."""
    try:
        array = np.asarray(values)
        if array.dtype.kind == "O" and not all(isinstance(x, SupportsFloat) for x in array.flat):
            return None
        if array.dtype.kind not in "biufO" or np.ma.is_masked(cast(ArrayLike, values)):
            return None
        return array.astype(float)
    except (TypeError, ValueError):
        return None


def _read_only(array: np.ndarray) -> np.ndarray:
    view = array.view()
    view.flags.writeable = False
    return view


def changes_momentum(term: object) -> np.ndarray:
    """Components (3,) of the total momentum that a force may change. Raises ValueError."""
    flags = getattr(term, "changes_momentum", EVERY)
    each = flags if isinstance(flags, tuple | list | np.ndarray) else (flags,)
    if len(each) not in (1, 3) or not all(isinstance(one, bool | np.bool_) for one in each):
        raise ValueError(
            f"changes_momentum is {flags!r:.60}, must be three truth values, for x, y, z"
        )
    return np.array(np.broadcast_to(flags, 3), bool)
