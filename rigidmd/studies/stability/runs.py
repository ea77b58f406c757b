"""Cases, which are named ways to try to break the engine; scenes made in code, their runs and outcomes."""

import time as clock
from collections.abc import Callable
from functools import cache
from math import inf, nan
from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_ivp

from rigidmd.core.state import State
from rigidmd.errors import RigidMDError
from rigidmd.mechanics.rotation import from_quaternion
from rigidmd.run import Simulation
from rigidmd.run.results import Results
from rigidmd.scene import MolecularScene, Scene
from rigidmd.studies.stability.outcomes import Finding, Outcome

#: Integrator families: the common one with both rotors, a symplectic Nystrom scheme, a composition with the split
#: rotor.
FAMILIES = {
    "velocity_verlet": {"integrator": "velocity_verlet", "rotor": "split"},
    "velocity_verlet, exact rotor": {"integrator": "velocity_verlet", "rotor": "exact"},
    "srkn_4": {"integrator": "srkn_4"},
    "pefrl": {"integrator": "pefrl"},
    "kahan_li_6": {"integrator": "kahan_li_6"},
}
SPLIT, EXACT = "velocity_verlet", "velocity_verlet, exact rotor"
#: A body without rotation, which has no rotor.
POINT = "velocity_verlet of a point"
QUICK = (SPLIT, EXACT, "srkn_4")
TEXTBOOK = {
    f"{solver}, {form}": {"integrator": solver, "formulation": form}
    for solver in ("rk4", "dop853")
    for form in ("matrix", "quaternion", "euler_angles")
}


#: A case adds trials to its finding; quick : fewer settings and integrators.
Attempt = Callable[[Finding, bool], None]


class Case(NamedTuple):
    """A named way to try to break the engine. group : its number in the list of what the battery must hold."""

    name: str
    group: int
    sentence: str
    attempt: Attempt
    titles: tuple[str, str, str]  # of x and of the error; unit of steps


CASES: dict[str, Case] = {}


def case(group: int, x: str = "", error: str = "", step: str = "s") -> Callable[[Attempt], Attempt]:
    """Register a function as a case under its own name, with the first line of its docstring."""

    def enter(attempt: Attempt) -> Attempt:
        sentence = (attempt.__doc__ or "").strip().splitlines()[0].rstrip(".")
        CASES[attempt.__name__] = Case(attempt.__name__, group, sentence, attempt, (x, error, step))
        return attempt

    return enter


def families(quick: bool) -> tuple[str, ...]:
    """The families for every case."""
    return QUICK if quick else tuple(FAMILIES)


def attempt(run: Callable[[], Outcome]) -> Outcome:
    """The outcome of a run. An error of rigidmd becomes its message, any other a crash."""
    began = clock.perf_counter()
    try:
        with np.errstate(all="ignore"):
            outcome = run()
    except RigidMDError as error:
        outcome = Outcome(message=str(error))
    except Exception as error:  # any other error is a failure of the engine
        outcome = Outcome(crash=f"{type(error).__name__}: {error}")
    return outcome._replace(seconds=clock.perf_counter() - began)


def body_scene(data: dict, step: float, duration: float, family: str, samples: int = 50) -> dict:
    """The tables of a body's scene with a run of this family; no files."""
    known = FAMILIES | TEXTBOOK | {POINT: {"integrator": "velocity_verlet"}}
    run = {"duration_s": float(duration), "timestep_s": float(step)} | known[family]
    output = {"trajectory": False, "figures": False, "interval_s": max(float(step), float(duration) / samples)}
    return data | {"run": run, "output": output | {"interval_s": min(output["interval_s"], float(duration))}}


def run_body(
    data: dict, step: float, duration: float, family: str, error: Callable[[Results], float], samples: int = 50
) -> Outcome:
    """A run of a body for a duration (s), with error(results) against the known answer."""

    def run() -> Outcome:
        results = Simulation(Scene.from_dict(body_scene(data, step, duration, family, samples))).run()
        wrong = list(results.summary["largest_relative_error"].values())
        orthogonality = results.summary["largest_orthogonality_error"]
        told = max([*wrong, orthogonality or 0.0], default=0.0)
        return Outcome(float(error(results)), float(told))

    return attempt(run)


def away_from(rotation: np.ndarray) -> Callable[[Results], float]:
    """The largest entry of |Q - Q_known| at the end, Q of the body's own axes."""
    return lambda results: np.abs([[results[f"q{i}{j}"][-1] for j in (1, 2, 3)] for i in (1, 2, 3)] - rotation).max()


def invariants(results: Results) -> float:
    """Largest relative error of L along the lab's axes, of |L| and of Q's orthogonality; not of the energy."""
    wrong = results.summary["largest_relative_error"]
    return max([results.summary["largest_orthogonality_error"], *(e for name, e in wrong.items() if name != "energy")])


def everything_kept(results: Results) -> float:
    """Largest relative error of all conserved quantities and of Q's orthogonality."""
    return max(invariants(results), results.summary["largest_relative_error"].get("energy", 0.0))


def solved(inertia, omega, span: float) -> np.ndarray:
    """Q of a free body at the end, by DOP853 on Euler's equations and a quaternion, independent of the flows.

    Its error is about 1e-13 per radian.
    """
    i1, i2, i3 = (float(i) for i in inertia)
    k1, k2, k3 = (i2 - i3) / i1, (i3 - i1) / i2, (i1 - i2) / i3

    def rates(t, y):
        a, b, c, w, x, y, z = y.tolist()
        return (
            k1 * b * c, k2 * c * a, k3 * a * b,
            -0.5 * (x * a + y * b + z * c), 0.5 * (w * a + y * c - z * b),
            0.5 * (w * b + z * a - x * c), 0.5 * (w * c + x * b - y * a),
        )  # fmt: skip

    found = solve_ivp(rates, (0.0, span), [*omega, 1.0, 0.0, 0.0, 0.0], "DOP853", rtol=1e-13, atol=1e-14)
    return from_quaternion(found.y[3:, -1])


# Molecules


def molecules_scene(
    molecules: list[dict],
    box: dict,
    step: float,
    steps: int,
    family: str = SPLIT,
    temperature: float | None = 298.0,
    thermostat: dict | None = None,
    forces: dict | None = None,
    looks: int = 25,
) -> dict:
    """The tables of a scene of molecules: one stage of `steps` steps (fs), sampled `looks` times, no files."""
    stage = {"duration_ps": step * steps / 1000, "timestep_fs": float(step)} | FAMILIES[family]
    if thermostat is not None:
        stage |= {"ensemble": "nvt"} | thermostat
    return {
        "box": box,
        "molecules": molecules,
        "forces": forces or {},
        "start": {} if temperature is None else {"temperature_K": float(temperature)},
        "stages": [stage],
        "output": {"trajectory": False, "log_interval_ps": min(1e9, step * max(1, steps // looks) / 1000)},
    }


def molecular(data: dict) -> MolecularScene:
    """The scene of tables of molecules. Raises SceneError."""
    scene = Scene.from_dict(data)
    if not isinstance(scene, MolecularScene):
        raise TypeError(f"{scene.name} is a single body")
    return scene


def simulate(data: dict, state: State | None = None) -> Results:
    """Run a scene of molecules, from a given state if there is one."""
    simulation = Simulation(molecular(data))
    if state is not None:
        simulation.start_from(state)
    return simulation.run()


def energy_error(results: Results, scale: float = 0.0) -> float:
    """Largest change of the conserved energy, relative to the initial kinetic energy (or a scale, kJ/mol)."""
    wrong = np.abs(results["drift"])
    size = scale or results["kinetic"][0]
    return float(wrong.max() / size) if np.isfinite(wrong).all() and size > 0 else inf


def run_molecules(
    data: dict,
    state: State | None = None,
    error: Callable[[Results], float] | None = None,
    scale: float = 0.0,
) -> Outcome:
    """A run of molecules; its error is that of the energy unless `error` computes another."""

    def run() -> Outcome:
        results = simulate(data, state)
        told = energy_error(results, scale)
        return Outcome(told if error is None else float(error(results)), told)

    return attempt(run)


def only_built(data: dict) -> Outcome:
    """A scene that must be refused before it runs; otherwise it counts as run without a right answer."""

    def run() -> Outcome:
        Simulation(Scene.from_dict(data)).run()
        return Outcome(nan, 0.0)

    return attempt(run)


WATERS, WATER_FORCES = 64, {"cutoff_A": 6.0}


@cache
def liquid(model: str, temperature: float, step: float, steps: int) -> State:
    """A state of water after these steps (fs) at a temperature (K), from a lattice."""
    with np.errstate(all="ignore"):
        return simulate(water_scene(model, step, steps, SPLIT, temperature, weak_heat(temperature, step))).state


def weak_heat(temperature: float, step: float) -> dict:
    """A thermostat with a time of 20 steps (fs)."""
    return {"temperature_K": float(temperature), "thermostat_time_ps": 20 * step / 1000}


def water_scene(model: str, *settings, **more) -> dict:
    """`molecules_scene` of a box of water; of TIP4P of 1983 sites are given, because it is not a shipped model."""
    kind = {"name": "tip4p", "sites": TIP4P} if model == "tip4p" else {"model": model}
    box = {"density_g_cm3": 0.997}
    return molecules_scene([kind | {"count": WATERS}], box, *settings, forces=WATER_FORCES, **more)


TIP4P = [
    {
        "name": "OW",
        "element": "O",
        "mass_u": 15.9994,
        "position_A": [0.0, 0.0, 0.0],
        "sigma_A": 3.154,
        "epsilon_K": 78.0,
    },
    {"name": "HW1", "element": "H", "mass_u": 1.008, "position_A": [0.756950, 0.585882, 0.0], "charge_e": 0.52},
    {"name": "HW2", "element": "H", "mass_u": 1.008, "position_A": [-0.756950, 0.585882, 0.0], "charge_e": 0.52},
    {"name": "MW", "mass_u": 0.0, "position_A": [0.0, 0.15, 0.0], "charge_e": -1.04},
]
