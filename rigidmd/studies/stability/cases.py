"""The table of stability cases, and what all of them use: trials, their scenes, their outcomes."""

from collections.abc import Callable, Iterable, Mapping
from math import inf, isfinite, nan
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rigidmd.core.state import State
from rigidmd.core.toml import parse_toml
from rigidmd.run import Simulation
from rigidmd.run.results import Results
from rigidmd.scene import Scene

RIGHT, REFUSED, REPORTED, UNDETECTED, CRASH = "right", "refused", "reported", "undetected", "crash"
#: Tables of scenes by their names.
SCENES = parse_toml(Path(__file__).with_name("scenes.toml").read_text(encoding="utf-8"))
#: Velocity Verlet with both rotors, a symplectic Nystrom scheme, compositions with split rotors.
INTEGRATORS = {
    "velocity_verlet": {"integrator": "velocity_verlet"},
    "velocity_verlet, exact rotor": {"integrator": "velocity_verlet", "rotor": "exact"},
    "srkn_4": {"integrator": "srkn_4"},
    "pefrl": {"integrator": "pefrl"},
    "kahan_li_6": {"integrator": "kahan_li_6"},
}
SPLIT, EXACT, *HIGHER_ORDER = INTEGRATORS
ORDER_2 = (SPLIT, EXACT)
SOLVERS = {
    f"{solver}, {form}": {"integrator": solver, "formulation": form}
    for solver in ("rk4", "dop853")
    for form in ("matrix", "quaternion", "euler_angles")
}
#: A run is bounded while the errors of conserved quantities stay below this fraction of the kinetic
#: energy.
BOUND = 0.1


class Outcome(NamedTuple):
    error: float = nan  # with respect to the known answer, in the unit of the case
    reported_error: float = nan  # largest error of conserved quantities in the results, relative
    message: str = ""  # of the rigidmd error that refused or stopped it
    crash: str = ""  # any other exception
    remark: str = ""  # what else the results show
    seconds: float = 0.0


class Trial(NamedTuple):
    """A setting of a case and its expected outcome; it runs with several integrators.

    A trial with a bound has its longest bounded step bisected.
    """

    setting: str
    run: Callable[[str, float], Outcome]  # of an integrator and a step
    step: float = nan
    allowed: float = 0.0  # largest error
    integrators: Iterable[str] = ()  # default: all
    expected: tuple[str, ...] = (RIGHT,)
    method_errors: Mapping[str, float] = {}  # integrator -> additional allowed error
    bound: float | None = None

    def limit(self, bound: float = BOUND) -> "Trial":
        """The bisection of the longest step of this trial."""
        return self._replace(bound=bound, allowed=nan, expected=())


class Case(NamedTuple):
    """A way to try to break the engine."""

    name: str
    group: int  # number of its kind of difficulty, from 1 to 14
    sentence: str
    trials: Callable[[bool], Iterable[Trial]]  # of a quick battery or the whole one
    error_title: str = ""
    step_unit: str = "s"


CASES: dict[str, Case] = {}


def case(group: int, error: str = "", step: str = "s") -> Callable:
    """Register a function as a case under its name, with the first paragraph of its docstring."""

    def register(trials: Callable[[bool], Iterable[Trial]]) -> Callable:
        paragraph = (trials.__doc__ or "").partition("\n\n")[0]
        sentence = " ".join(paragraph.split()).rstrip(".")
        CASES[trials.__name__] = Case(trials.__name__, group, sentence, trials, error, step)
        return trials

    return register


def powers(first: int, last: int, quick: bool) -> list[float]:
    """10^-first ... 10^-last; four of them if quick."""
    exponents = np.linspace(first, last, 4).astype(int) if quick else range(first, last + 1)
    return [10.0 ** -int(k) for k in exponents]


def complete_scene(
    tables: dict[str, Any],
    integrator: str = SPLIT,
    step: float = 1.0,
    *,
    duration: float = 0.0,
    steps: int = 1,
    samples: int = 50,
    thermostat: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """The tables of a body (s) or of molecules (fs) with those of a run, which writes no files.

    The run lasts for the duration or the number of steps, whichever is longer.
    """
    method = (INTEGRATORS | SOLVERS)[integrator]
    if "body" in tables:
        duration = max(duration, steps * step)
        interval = min(max(step, duration / samples), duration)
        output = {"trajectory": False, "figures": False, "interval_s": interval}
        run = method | {"duration_s": duration, "timestep_s": step}
        return {**tables, "run": run, "output": output}
    steps = max(steps, round(duration / step))
    interval = min(1e9, step * max(1, steps // samples) / 1000)
    output = {"trajectory": False, "log_interval_ps": interval}
    stage = method | {"duration_ps": steps * step / 1000, "timestep_fs": step}
    return {"stages": [stage | (thermostat or {})], **tables, "output": output}


def finish(scene: dict[str, Any], state: State | None = None, folder: str = ".") -> Results:
    """Run a scene. Its warnings are left out, as the cases are extreme on purpose."""
    with np.errstate(all="ignore"):
        simulation = Simulation(Scene.from_dict(scene, folder), warn=lambda _: None)
        if state is not None:
            simulation.start_from(state)
        return simulation.run()


def conserved_error(results: Results, scale: float = 0.0) -> float:
    """Largest error of conserved quantities, relative; of molecules: that of the energy, relative
    to the initial kinetic energy or to a scale (kJ/mol)."""
    if "largest_relative_error" in results.summary:
        orthogonality = results.summary["largest_orthogonality_error"] or 0.0
        return max([orthogonality, *results.summary["largest_relative_error"].values()])
    largest = np.abs(results["drift"]).max()
    size = scale or results["kinetic"][0]
    return float(largest / size) if isfinite(largest) and size > 0 else inf


def run_scene(
    tables: dict[str, Any],
    integrator: str,
    step: float,
    *,
    error: Callable[[Results], float] | None = None,
    remark: Callable[[Results], str] | None = None,
    scale: float = 0.0,
    state: State | None = None,
    folder: str = ".",
    **settings: Any,
) -> Outcome:
    """The outcome of a run with the settings of `complete_scene`.

    error : compares the results with the known answer; default: the error of conserved quantities
    scale : of the energy error, kJ/mol
    """
    results = finish(complete_scene(tables, integrator, step, **settings), state, folder)
    reported = conserved_error(results, scale)
    text = "" if remark is None else remark(results)
    return Outcome(reported if error is None else float(error(results)), reported, remark=text)
