"""Normal modes of rigid molecules: their small vibrations about a minimum of the energy.

The coordinates are q = (sqrt(m) X, sqrt(I_k) theta_k), with X in the lab frame and theta_k about
principal axes. The Hessian in them has the eigenvalues w² (Goldstein, Classical Mechanics, chapter
6). It is made of central differences of the compiled forces and torques, in double precision. The
guide `normal_modes` has the equations.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import pi, prod
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from scipy.sparse.linalg import LinearOperator, eigsh

from rigidmd.core.state import NOW, State
from rigidmd.engines.observables import observe
from rigidmd.engines.system import System
from rigidmd.errors import SceneError, SimulationError
from rigidmd.features.studies.gamma_point import cells_of, periodic_basis
from rigidmd.io.folder import LOG, SCENE, SUMMARY
from rigidmd.io.run_files import Log, columns
from rigidmd.io.scene_file import input_names, write_scene
from rigidmd.io.write import Column, ReportTable, write_json
from rigidmd.run import Simulation
from rigidmd.run.checks import molecule_label
from rigidmd.run.minimise import Enthalpy
from rigidmd.run.minimise import minimise as find_minimum
from rigidmd.run.schedule import checked_count
from rigidmd.run.stable_step import stiffest_mode
from rigidmd.scene import MolecularScene, Scene, is_molecular
from rigidmd.scene.stage import Stage
from rigidmd.units import AVOGADRO, BOLTZMANN, COULOMB, FEMTOSECOND, KJ_PER_MOL

if TYPE_CHECKING:
    from rigidmd.scene import OneScene

#: Displacement of a difference, in smallest diameters: its error and that of rounding are 1e-10 of
#: the largest entry.
DISPLACEMENT = 3e-6
#: Largest force after the minimisation, and largest one that is accepted as a minimum: fractions of
#: the force with which the stiffest motion opposes a displacement by the smallest diameter.
#: Torques: these forces at a lever of 1 Å.
TIGHT, ACCEPTED = 1e-13, 1e-6
#: A mode with a smaller |w²|, as a fraction of the largest, is a zero mode.
ZERO = 1e-8
#: Largest error of w² as a fraction of the largest: beyond it forces jump where a pair passes the
#: cutoff.
LARGEST_ERROR = 1e-4
SMOOTH = (
    "where forces jump at the cutoff, forces.truncation = 'smooth_switch', and with PME or Ewald"
    " sums also forces.ewald_accuracy = 1e-7, make them smooth"
)
#: Maximum size of a dense Hessian (0.3 GB), so of a complete spectrum by default. Modes at each
#: end beyond it.
MOST_DENSE, COUNT = 6000, 20
#: Residual of Lanczos vectors as a fraction of the largest w², and least dimension of their Krylov
#: space.
RESIDUAL, KRYLOV = 1e-9, 80
#: Largest displacement in an animation, Å; its periods, and the frames of each.
AMPLITUDE, PERIODS, FRAMES = 0.3, 2, 48

FILE = "modes.csv"
PER_CM = 1e10 / 299792458 / (2 * pi)  # wavenumber (cm⁻¹) of 1 rad/ps
HBAR = 6.62607015e-34 / (2 * pi) * AVOGADRO * KJ_PER_MOL * 1e9  # u Å²/ps
#: Intensity (km/mol) of a squared derivative of the dipole of 1 e²/u: N_A/(12 epsilon_0 c²).
INTENSITY = pi * AVOGADRO / 3 * COULOMB * 1e-9 / 299792458**2


class Coordinates:
    """The mass-weighted coordinates q (d,) about a state. Frozen molecules and axes without inertia
    have none.

    The order is: shifts sqrt(m) X along x, y, z of molecule 1, of molecule 2, .... Then rotations
    sqrt(I_k) theta_k about the principal axes 1, 2, 3 of molecule 1, of molecule 2, .... Those that
    do not move are omitted.

    scale : (d,) length of a move of `Enthalpy`, Å, for a unit of q
    index : (d,) of each coordinate among all shifts (3 n) and then all rotations (3 n)
    translations : (t, d) unit vectors of uniform translations along which the total momentum is
        conserved
    """

    def __init__(self, system: System, state: State):
        self.system = system
        self.enthalpy, self.state = Enthalpy(system, Stage(ensemble="minimise"), state), state
        model = system.model
        species = model.species
        rotations = (
            np.sqrt(model.inverse_inertia[species[: len(state.rotation)]]) * self.enthalpy.arm
        )
        self._all = np.concatenate(
            [np.repeat(np.sqrt(model.inverse_mass[species]), 3), rotations.ravel()]
        )
        self.index = np.flatnonzero(self._all)
        self.scale, self._step = self._all[self.index], DISPLACEMENT * system.smallest_diameter
        self.is_shift = self.index < state.position.size
        uniform = [
            self.is_shift * (self.index % 3 == k) / self.scale
            for k in np.flatnonzero(model.keeps_momentum)
        ]
        self.translations = np.array([q / np.linalg.norm(q) for q in uniform]).reshape(
            -1, len(self.index)
        )

    def at(self, q: np.ndarray) -> State:
        """The state at a displacement q (d,)."""
        move = np.zeros_like(self._all)
        move[self.index] = self.scale * q
        return self.enthalpy.moved(self.state, move)

    def slope(self, q: np.ndarray, function: Callable[[State], np.ndarray]) -> np.ndarray:
        """The derivative of a function of the state along q (d,), by a central difference."""
        h = self._step / (np.abs(self.scale * q).max() or 1.0)
        return (function(self.at(h * q)) - function(self.at(-h * q))) / (2 * h)

    def relative(self, q: np.ndarray) -> np.ndarray:
        """A displacement (d,) without its uniform translation."""
        return q - (self.translations @ q) @ self.translations

    def curvature(self, q: np.ndarray) -> np.ndarray:
        """The Hessian times q (d,), without the forces on uniform translations that errors of
        meshes make."""
        gradient = self.slope(self.relative(q), lambda state: self.enthalpy.at(state).gradient)
        return self.relative(self.scale * gradient[self.index])


@dataclass(frozen=True, eq=False)
class NormalModes:
    """Modes, k of d, by ascending w². Columns of vectors are the d mass-weighted coordinates.

    Attributes
    ----------
    system : System
        The system of molecules
    coordinates : Coordinates
        Coordinates about the minimum, which is `coordinates.state`
    energy : float
        Energy of the minimum, kJ/mol
    force : float
        Largest force at the minimum, kJ/mol/Å
    torque : float
        Largest torque at the minimum, kJ/mol
    ended : str
        Why the minimisation stopped before the rounding of forces, if it did
    temperature : float
        Temperature of the scene, K. 0 if it has none
    longest_step_fs : float
        2/w of the last mode, fs. If all were computed, the longest stable step of velocity Verlet
    number : ndarray
        Number (k,) of each mode among all d, from 1
    rate : ndarray
        Angular frequency w (k,), rad/ps. 0 for zero modes, negative for unstable modes
    wavenumber : ndarray
        Wavenumber w/(2 pi c) (k,), cm⁻¹
    error : ndarray
        Error (k,) of the wavenumber by the asymmetry of the Hessian or the residual of the vector,
        cm⁻¹. NaN for zero modes
    vector : ndarray
        Unit vectors (k, d) in rows
    translation : ndarray
        Translational fraction (k,) of the kinetic energy. The rest is librational
    weight : ndarray
        Fraction (k, n) of the kinetic energy in each molecule
    intensity : ndarray
        Infrared intensity (k,) by the dipole of the charges, km/mol (at the Gamma point for a unit
        cell)
    total : int
        Number of all modes, at the Gamma point those of a unit cell
    cells : int
        Number of unit cells, if these are modes at the Gamma point
    """

    system: System
    coordinates: Coordinates
    energy: float
    force: float
    torque: float
    ended: str
    temperature: float
    longest_step_fs: float
    number: np.ndarray
    rate: np.ndarray
    wavenumber: np.ndarray
    error: np.ndarray
    vector: np.ndarray
    translation: np.ndarray
    weight: np.ndarray
    intensity: np.ndarray
    total: int
    cells: int = 0

    def free_energy(self, temperature: float, quantum: bool = True) -> float:
        """Helmholtz energy of the rigid-molecule vibrations, relative to the energy of the minimum.

        Parameters
        ----------
        temperature : float
            Temperature, K. At 0 the result is the zero-point energy
        quantum : bool, optional
            Whether the oscillators are quantum or classical

        Returns
        -------
        float
            Helmholtz energy, kJ/mol

        Raises
        ------
        ValueError
            If there are only some of the modes.
        """
        if len(self.rate) < len(self.coordinates.index):
            raise ValueError("a sum over all modes needs all of them: leave out count and gamma")
        quanta = HBAR * self.rate[self.rate > 0]
        thermal = BOLTZMANN * temperature
        with np.errstate(divide="ignore"):
            x = quanta / thermal
        terms = quanta / 2 + thermal * np.log(-np.expm1(-x)) if quantum else thermal * np.log(x)
        return float(terms.sum() / KJ_PER_MOL)

    def kind(self, k: int) -> str:
        """The kind of a mode.

        Parameters
        ----------
        k : int
            Index of the mode, from 0

        Returns
        -------
        str
            "zero", "translation" or "libration"
        """
        if self.rate[k] == 0:
            return "zero"
        return "translation" if self.translation[k] >= 0.5 else "libration"

    def is_vibration(self, number: int) -> bool:
        """Whether a mode was computed and has a frequency.

        Parameters
        ----------
        number : int
            Number of the mode among all, from 1

        Returns
        -------
        bool
            True if it has a frequency
        """
        return bool(self.rate[self.number == number].any())

    def table(self) -> ReportTable:
        """The modes with their properties. Zero modes, which mix freely, have none.

        Returns
        -------
        ReportTable
            A line for each mode. Its `text()` is for a terminal
        """

        def of(values: np.ndarray) -> Callable[[int], float | None]:
            return lambda k: float(values[k]) if self.rate[k] else None

        return ReportTable(
            [
                Column("mode", lambda k: str(self.number[k])),
                Column("kind", self.kind),
                Column("wavenumber (cm^-1)", lambda k: float(self.wavenumber[k]), "cm⁻¹"),
                Column("error (cm^-1)", of(self.error), "±"),
                Column("frequency (1/ps)", lambda k: float(self.rate[k] / (2 * pi)), "1/ps"),
                Column("translation", of(self.translation)),
                Column("participation", of(1 / (self.weight**2).sum(axis=1)), "molecules"),
                Column("IR intensity (km/mol)", of(self.intensity), "IR (km/mol)"),
                Column(
                    "largest in",
                    lambda k: molecule_label(self.system, int(self.weight[k].argmax())),
                ),
            ],
            range(len(self.rate)),
        )


def normal_modes(
    scene: Scene | Simulation,
    *,
    minimise: bool = True,
    count: int | None = None,
    gamma: bool = False,
    required: int | None = None,
    progress: Callable[[float], object] = lambda fraction: None,
) -> NormalModes:
    """Normal modes about the minimum next to the start of a scene, or next to the present state of
    a simulation.

    A minimisation comes first, to the rounding of forces and torques and at constant cell.

    Parameters
    ----------
    scene : Scene or Simulation
        Molecules at their start, or at their present state
    minimise : bool, optional
        False requires that the start is a minimum
    count : int, optional
        Number of the lowest and of the highest modes, by Lanczos. Default: all, or 20 if there are
        more than 6000
    gamma : bool, optional
        Only modes with the period of the unit cell that `structure.repeat` repeats (k = 0)
    required : int, optional
        Number of a mode that has to be computed, which is checked before computing
    progress : callable, optional
        Called with the fraction done

    Returns
    -------
    NormalModes
        The modes by ascending frequency

    Raises
    ------
    SceneError
        For a single body, for a required mode that does not exist, and at the Gamma point without a
        unit cell.
    SimulationError
        If a minimum is required and not found.

    Examples
    --------
        modes = rigidmd.normal_modes(rigidmd.Scene.read("water_dimer.toml"))
        print(modes.wavenumber, modes.free_energy(300.0), modes.longest_step_fs)
    """
    count = None if count is None else checked_count(count, "count")
    simulation = scene if isinstance(scene, Simulation) else Simulation(scene)
    if not is_molecular(simulation.scene):
        raise SceneError(
            simulation.scene.source,
            [f"normal modes need a molecular scene, and this is {simulation.scene.subject}"],
        )
    state = (simulation.state if simulation is scene else simulation._settle()).copy()
    system = cast(System, simulation.system)
    numbers = _numbers(Coordinates(system, state), count, gamma=gamma)
    if required is not None and required not in numbers:
        among = (
            f"there are {numbers[-1]} modes"
            if len(numbers) == numbers[-1]
            else f"count = {count or COUNT} omits it"
        )
        raise SceneError(
            simulation.scene.source, [f"mode {required} will not be computed: {among}"]
        )
    sizes = _find_minimum(system, state, minimise=minimise)
    c = Coordinates(system, state)
    charges = system.of_sites(lambda m: m.charges)
    cells = 0
    if gamma:
        cells = prod(cells_of(system))
        square, vector, error = _periodic_modes(c, periodic_basis(system, state, c.index), progress)
    elif len(numbers) == len(c.index):
        square, vector, error = _all_modes(c, progress)
    else:
        square, vector, error = _outer_modes(c, (len(numbers) - len(c.translations)) // 2)
    if not error.max() <= LARGEST_ERROR * square[-1]:
        raise SimulationError(
            f"forces are not smooth at the minimum: w² are uncertain by {error.max():.1e}/ps²;"
            f" {SMOOTH}"
        )
    signed = np.where(
        np.abs(square) > ZERO * square[-1], np.sign(square) * np.sqrt(np.abs(square)), np.nan
    )
    rate = np.nan_to_num(signed)
    weight = np.zeros((len(state.position), len(square)))
    np.add.at(weight, c.index // 3 % len(weight), vector.T**2)
    slopes = np.array(
        [c.slope(q, lambda state: charges @ system.site_positions(state)) for q in vector]
    )
    intensity = INTENSITY * (slopes**2).sum(axis=1) / max(cells, 1)
    return NormalModes(
        system,
        c,
        *sizes,
        _last_temperature(simulation.scene),
        2 / rate[-1] / FEMTOSECOND,
        numbers,
        rate,
        PER_CM * rate,
        PER_CM * error / np.abs(2 * signed),
        vector,
        vector**2 @ c.is_shift,
        weight.T,
        intensity,
        int(numbers[-1]),
        cells,
    )


def _numbers(c: Coordinates, count: int | None, *, gamma: bool) -> np.ndarray:
    """The numbers (k,) of the modes to compute. Raises SceneError."""
    d = len(c.index)
    fixed = len(c.translations)
    scene = c.system.scene
    if gamma:
        if count is not None:
            raise SceneError(
                scene.source, ["count and gamma cannot be combined: a unit cell has few modes"]
            )
        return np.arange(1, d // prod(cells_of(c.system)) + 1)
    count = COUNT if count is None and d > MOST_DENSE else count
    if count is None or 2 * count + fixed >= d:
        return np.arange(1, d + 1)
    return np.r_[1 : count + fixed + 1, d - count + 1 : d + 1]


def _last_temperature(scene: MolecularScene) -> float:
    """The temperature at the end of the last stage that sets a temperature, K. Without such a
    stage, the temperature of the start, or 0."""
    temperature = scene.start.temperature_K or 0.0
    for stage in scene.stages:
        temperature = stage.temperatures[1] or temperature
    return temperature


def _find_minimum(
    system: System, state: State, *, minimise: bool
) -> tuple[float, float, float, str]:
    """Move a state to a minimum, in place, or check that it is one: energy, largest force and
    torque (kJ/mol, Å), and why the minimisation stopped before the rounding of forces, if it
    did."""
    loose = Stage(ensemble="minimise")
    enthalpy = Enthalpy(system, loose, state)
    keys = ("force_limit_kJ_mol_A", "torque_limit_kJ_mol")
    ended = ""
    if minimise:
        find_minimum(system, state, loose)
    stiff = _stiffness(enthalpy, system, state)
    for fraction in (ACCEPTED, TIGHT) if minimise else ():
        tight = loose.model_copy(update=dict.fromkeys(keys, fraction * stiff))
        if ended := find_minimum(system, state, tight).ended_by:
            break
        stiff = _stiffness(enthalpy, system, state)  # the start may have been far from the minimum
    point = enthalpy.at(state)
    force, torque = (size / KJ_PER_MOL for size in enthalpy.largest(point)[:2])
    if max(force, torque) <= ACCEPTED * stiff:
        return point.energy / KJ_PER_MOL, force, torque, ended
    stage = f"a stage ensemble = 'minimise' with {' and '.join(keys)} = {ACCEPTED * stiff:.1g}"
    why = f"the minimisation ended there ({ended}); {SMOOTH}"
    advice = why if minimise else f"leave out --no-minimise, or begin with {stage}"
    raise SimulationError(
        f"this is not a minimum of the energy: the largest force is {force:.3g} kJ/(mol Å), the"
        f" largest torque {torque:.3g} kJ/mol; {advice}"
    )


def _stiffness(enthalpy: Enthalpy, system: System, state: State) -> float:
    """The force, kJ/(mol Å), with which the stiffest motion opposes a displacement by the smallest
    diameter. At least the deepest well over this diameter, as far from each other molecules barely
    attract. Raises SimulationError."""
    fastest = stiffest_mode(system, state, enthalpy.engine) if enthalpy.free.any() else None
    if fastest is None:
        raise SimulationError(
            "no force holds these molecules at their positions: they have no normal modes"
        )
    mass = float(system.model.mass[system.model.species[enthalpy.free]].min())
    deepest = max((float(m.epsilon.max()) for m in system.species), default=0.0)
    diameter = system.smallest_diameter
    return max(fastest.rate**2 * mass * diameter, deepest / diameter) / KJ_PER_MOL


def _all_modes(
    c: Coordinates, progress: Callable[[float], object]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """w² (d,), modes (d, d) and the error of w² (d,): the asymmetry of the Hessian, or its error on
    a vector."""
    hessian = np.eye(len(c.index))
    for k, unit in enumerate(hessian):
        hessian[k] = c.curvature(unit)
        progress((k + 1) / len(hessian))
    q = np.random.default_rng(0).standard_normal(len(hessian))
    error = np.linalg.norm(hessian @ q - c.curvature(q)) / np.linalg.norm(q)
    square, vector = np.linalg.eigh((hessian + hessian.T) / 2)
    return square, vector.T, np.full(len(square), max(error, np.abs(hessian - hessian.T).max()))


def _periodic_modes(
    c: Coordinates, basis: np.ndarray, progress: Callable[[float], object]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same in the space of a basis (d, k), which the Hessian must not leave: what does is an
    error too."""
    images = []
    for k, unit in enumerate(basis.T):
        images.append(c.curvature(unit))
        progress((k + 1) / basis.shape[1])
    image = np.array(images).T
    hessian = basis.T @ image
    error = max(
        np.abs(hessian - hessian.T).max(), np.linalg.norm(image - basis @ hessian, axis=0).max()
    )
    square, vector = np.linalg.eigh((hessian + hessian.T) / 2)
    return square, (basis @ vector).T, np.full(len(square), error)


def _outer_modes(c: Coordinates, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same of uniform translations and of the lowest and highest modes, by Lanczos. Errors by
    residuals."""
    shape = (len(c.index),) * 2
    size = min(len(c.index), max(2 * count + 1, KRYLOV))
    start = c.relative(np.random.default_rng(0).standard_normal(len(c.index)))

    def largest(product: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        operator = LinearOperator(shape, matvec=product, dtype=float)  # pyright: ignore[reportCallIssue]
        return eigsh(operator, count, which="LA", ncv=size, tol=RESIDUAL, v0=start)[1].T  # pyright: ignore

    high = largest(c.curvature)
    top = max(q @ c.curvature(q) for q in high)
    # w² near 0 would converge to a fraction of itself
    low = largest(lambda q: c.relative(top * q) - c.curvature(q))
    vector = np.concatenate([c.translations, low, high])
    image = np.concatenate([0 * c.translations, [c.curvature(q) for q in (*low, *high)]])
    square = (vector * image).sum(axis=1)
    order = square.argsort(kind="stable")
    return (
        square[order],
        vector[order],
        np.linalg.norm(image - square[:, None] * vector, axis=1)[order],
    )


def animation_files(scene: "OneScene") -> list[str]:
    """Names of the files of `write_animation`. Raises SceneError without a trajectory."""
    output = scene.output
    if not output.trajectory:
        raise SceneError(
            scene.source, ["an animation needs a trajectory, and output.trajectory is false"]
        )
    return [
        SCENE,
        *input_names(scene).values(),
        str(output.topology),
        output.trajectory,
        LOG,
        SUMMARY,
    ]


def write_animation(folder: Path, modes: NormalModes, number: int) -> None:
    """Write the harmonic motion along a mode, at rest in each frame, with its energies, as a run
    for `view`."""
    from rigidmd.io.trajectory_file import open_trajectory, write_topology

    c = modes.coordinates
    system = modes.system
    scene = system.scene
    output = scene.output
    if not modes.is_vibration(number):
        raise SceneError(
            scene.source,
            [f"mode {number} is not a vibration that was computed, and has no animation"],
        )
    k = int(np.flatnonzero(modes.number == number)[0])
    period = 2 * pi / abs(modes.rate[k])
    q = AMPLITUDE / np.abs(c.scale * modes.vector[k]).max() * modes.vector[k]
    write_scene(folder, scene)
    write_topology(folder / output.topology, system, c.state, wrapped=False)
    log = Log(folder / LOG, columns(system.quantities, tensor=False))
    frames = open_trajectory(
        folder / str(output.trajectory), system, period / FRAMES, velocities=False, wrapped=False
    )
    for step in range(PERIODS * FRAMES + 1):
        state = c.at(np.cos(2 * pi * step / FRAMES) * q)
        time = period * step / FRAMES
        state.velocity[:] = state.angular_momentum_body[:] = 0
        state.time[NOW], state.step[NOW] = time, step
        frames.write(state, time, step)
        log.write(observe(system, c.enthalpy.engine, state, len(scene.stages) - 1).sample)
    frames.close()
    log.close()
    note = (
        f"mode {number}, {modes.wavenumber[k]:.4g} cm⁻¹: harmonic motion by up to {AMPLITUDE:g} Å,"
        " not a run"
    )
    write_json(folder / SUMMARY, {"notes": [note]})
