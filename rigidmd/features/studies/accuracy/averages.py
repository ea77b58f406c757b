"""`rigidmd accuracy --averages`: samples the last stage of a scene by several methods and steps,
for their biases."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from math import floor, log10, nan, sqrt
from typing import NamedTuple, cast

import numpy as np

from rigidmd.assemble.harmonic import stable_angle
from rigidmd.core.integrators import WITH_THERMOSTAT
from rigidmd.core.state import State
from rigidmd.core.statistics import mean_and_error
from rigidmd.dynamics.model import remove_momentum
from rigidmd.engines.samples import COLUMNS, NOT_AVERAGED, Samples
from rigidmd.errors import SceneError, SimulationError, option
from rigidmd.features.studies.extrapolation import BiasFit, MeanAtStep, extrapolate
from rigidmd.run import Simulation
from rigidmd.run.kind import kind_of
from rigidmd.run.mean_box import scale_to_mean_box
from rigidmd.run.observers import Every
from rigidmd.run.stable_step import stiffest_mode
from rigidmd.scene import MolecularScene, Scene, is_molecular
from rigidmd.scene.ensembles import THERMOSTATS
from rigidmd.scene.stage import ERROR_TARGETS, MOST_STEPS, Stage
from rigidmd.scene.validation import did_you_mean
from rigidmd.units import BAR, BOLTZMANN, FEMTOSECOND, KJ_PER_MOL

BIAS_LIMIT = 0.01  # the step of this bias, as a fraction of the scale of a quantity, is reported
UNSEEN = 2.0  # a slope of at most this many standard errors counts as not seen


class AveragedQuantity(NamedTuple):
    name: str
    unit: str
    # of which the bias limit is a fraction; NaN: the limit of the quantity at zero time step
    scale: float
    exact: float | None = None  # the limit where it is known
    bias_unit: str = ""  # of reported biases, `unit` when empty
    bias_size: float = 1.0  # of one such unit, in `unit`
    is_main: bool = (
        True  # whether it is printed and drawn; all are in accuracy.csv and accuracy.json
    )
    of: str = "its value"  # name of the scale

    @property
    def unit_of_bias(self) -> str:
        return self.bias_unit or self.unit


@dataclass
class AverageRun:
    integrator: str
    thermostat: str
    timestep: float  # fs
    forces_per_ps: float
    seconds_per_ns: float | None = None
    # name -> mean, standard error
    averages: dict[str, tuple[float, float]] = field(default_factory=dict)
    # names of averages whose sampling is too short for an error
    short: list[str] = field(default_factory=list)
    failure: str = ""  # why there are none

    @property
    def method(self) -> str:
        return f"{self.integrator} + {self.thermostat}"


@dataclass
class Averages:
    """Averages of a stage with a thermostat, by methods and time steps."""

    name: str  # of the scene
    stage: str
    temperature: float  # K
    molecules: int
    freedom: int  # degrees of freedom
    sampled: float  # ps, each
    quantities: list[AveragedQuantity]
    runs: list[AverageRun]

    def __post_init__(self):
        self._fits: dict[str, BiasFit] = {}

    @property
    def methods(self) -> list[str]:
        return list(dict.fromkeys(run.method for run in self.runs))

    @property
    def main(self) -> list[AveragedQuantity]:
        return [quantity for quantity in self.quantities if quantity.is_main]

    def points(self, quantity: AveragedQuantity) -> list[MeanAtStep]:
        return [point for run in self.runs if (point := self.point(run, quantity))]

    def point(self, run: AverageRun, quantity: AveragedQuantity) -> MeanAtStep | None:
        """The mean of a run, or None."""
        if quantity.name not in run.averages:
            return None
        return MeanAtStep(run.method, run.timestep, *run.averages[quantity.name])

    def fit(self, quantity: AveragedQuantity) -> BiasFit | None:
        if quantity.name not in self._fits and (points := self.points(quantity)):
            self._fits[quantity.name] = extrapolate(points, quantity.exact)
        return self._fits.get(quantity.name)

    def bias(self, run: AverageRun, quantity: AveragedQuantity) -> tuple[float, float] | None:
        """Mean less limit and its error, in the quantity's unit of biases. None without a mean."""
        point = self.point(run, quantity)
        fit = self.fit(quantity)
        if point is None or fit is None:
            return None
        value, error = fit.bias(point)
        return value / quantity.bias_size, error / quantity.bias_size

    def bias_limit(self, quantity: AveragedQuantity) -> float:
        """The bias whose step is reported, in the quantity's unit of biases."""
        fit = self.fit(quantity)
        scale = (
            quantity.scale if quantity.scale == quantity.scale or fit is None else abs(fit.limit)
        )
        return BIAS_LIMIT * scale / quantity.bias_size

    def step_at_limit(self, method: str, quantity: AveragedQuantity) -> tuple[float, bool] | None:
        """The step (fs) at which the bias of a method reaches the limit, and whether a bias was
        seen.

        A bias is not seen if its slope is within `UNSEEN` errors of 0. It is then smaller up to
        that step. None if the fit has no slope of the method.
        """
        fit = self.fit(quantity)
        if fit is None or method not in fit.slopes:
            return None
        slope, error = fit.slopes[method]
        seen = abs(slope) > UNSEEN * error
        steepest = abs(slope) if seen else abs(slope) + UNSEEN * error
        return (
            (sqrt(self.bias_limit(quantity) * quantity.bias_size / steepest), seen)
            if steepest > 0
            else None
        )


#: Measured in addition to the method of the stage when no methods are given.
DEFAULT_METHODS = (
    "baoab+velocity_rescaling",
    "baoab+langevin",
    "velocity_verlet+velocity_rescaling",
)
LADDER = (0.15, 0.3, 0.45, 0.6, 0.75)  # time steps, in units of the longest stable step
#: Time steps, in units of the scene's, where the longest stable step is unknown.
LADDER_AROUND_SCENE = (0.5, 1.0, 2.0, 4.0)
SAMPLE_PS = 20.0
#: Time before sampling, as a fraction of the time sampled: the start has the distribution of
#: another step.
EQUILIBRATION = 0.2
#: Interval of the samples that are averaged, ps, and their largest number; longer runs have longer
#: intervals.
SAMPLING_INTERVAL_PS, MOST_SAMPLES = 0.02, 4000


def check_engine_is_rigidmd(scene: Scene) -> None:
    """Raise SceneError if a scene names another engine: only the integrators of rigidmd are
    measured."""
    if is_molecular(scene) and scene.engine.is_external:
        error = f"engine.name = {scene.engine.name!r}: accuracy measures rigidmd. Leave it out"
        raise SceneError(scene.source, [error])


def check_times(scene: Scene, times: Iterable[float], names: str) -> None:
    """Raise SceneError unless times have a size that numbers of a scene may have."""
    least, largest = scene.SIZES
    if not all(least <= time <= largest for time in times):
        bounds = f"{least:g} and {largest:g}".replace("e+", "e")
        raise SceneError("accuracy", [f"{names} must be between {bounds}"])


def check_number_of_steps(duration: float, step: float) -> None:
    """Raise SceneError if a duration has too many steps, in the same unit."""
    if not duration / step < MOST_STEPS:
        error = f"a run has more than {MOST_STEPS:g} steps: use longer steps, or shorter runs"
        raise SceneError("accuracy", [error])


def measure_averages(
    scene: Scene,
    methods: list[str] | None = None,
    timesteps: list[float] | None = None,
    sample: float = SAMPLE_PS,
    progress: Callable[[float], object] = lambda fraction: None,
) -> Averages:
    """Means of U, temperatures, and pressure or density in the last stage, by methods at time
    steps. Raises SceneError.

    methods : "integrator" or "integrator+thermostat". Default: the method of the stage and
        `DEFAULT_METHODS`
    timesteps : fs, the same for all. Default: fractions of the longest stable step of each method
    sample : ps that each is sampled, after a fifth of that
    progress : called with the fraction that is done. At 0, after all arguments have been checked

    The earlier stages of the scene run before, once.
    """
    kind_of(scene).check_has(scene, "averages", option=option("averages"))
    scene = cast(MolecularScene, scene)
    check_engine_is_rigidmd(scene)
    stage = _with_thermostat(scene)
    schemes = scene.schemes | WITH_THERMOSTAT
    pairs = [_parse_method(name, stage, schemes) for name in methods or DEFAULT_METHODS]
    if not methods:
        of_stage = [] if stage.is_auto else [(stage.integrator, stage.thermostat_kind)]
        pairs = list(dict.fromkeys([*of_stage, *pairs]))
    names = f"time steps and {option('sample_ps')}"
    check_times(scene, (sample, *(timesteps or [])), names)
    for step in timesteps or []:
        check_number_of_steps(sample, step * FEMTOSECOND)
    if timesteps and max(timesteps) * FEMTOSECOND > sample:
        error = f"{max(timesteps):g} fs is longer than the {sample:g} ps sampled with it"
        raise SceneError(option("timesteps"), [error])
    progress(0.0)
    simulation, state = start_of_last_stage(scene)
    remove_momentum(simulation.system.model, state.velocity)
    stiffest = stiffest_mode(simulation.system, state)
    plan: list[tuple[Stage, AverageRun]] = []
    for integrator, thermostat in pairs:
        scheme = schemes[integrator]
        steps = timesteps or [
            ratio * simulation.scene.stages[-1].step_fs for ratio in LADDER_AROUND_SCENE
        ]
        if stiffest is not None and not timesteps:
            exact = [ratio * stable_angle(scheme) / stiffest.rate / FEMTOSECOND for ratio in LADDER]
            # two digits, for tables and legends
            steps = [round(step, 1 - floor(log10(step))) for step in exact]
        for step in sorted(set(steps)):
            run = AverageRun(
                integrator, thermostat, step, scheme.force_evaluations / (step * FEMTOSECOND)
            )
            plan.append((_with_method(stage, integrator, thermostat, step, sample), run))
    whole = sum(run.forces_per_ps for _, run in plan)
    done = 0.0
    for changed, run in plan:
        part = run.forces_per_ps / whole
        length = changed.duration

        def report_progress(moment, before=done, part=part, length=length):
            progress(before + part * min(1.0, moment.time / length))

        _sample(scene, changed, state, run, sample, Every(length / 50, report_progress))
        done += part
        progress(done)
    freedom = simulation.system.freedom_in(len(scene.stages) - 1)
    count = len(simulation.system.model.species)
    thermal = BOLTZMANN * stage.temperatures[0]
    unit = thermal * freedom.total / count / KJ_PER_MOL
    of_u = "kT per degree of freedom"
    quantities = [AveragedQuantity("U", "kJ/mol", unit, bias_unit=of_u, bias_size=unit, of=of_u)]
    exact = stage.temperatures[0]
    quantities += [
        AveragedQuantity(name, "K", exact, exact)
        for name, n in (("T_trans", freedom.translation), ("T_rot", freedom.rotation))
        if n
    ]
    if stage.ensemble == "npt":
        quantities.append(AveragedQuantity("density", "g/cm³", nan))
    elif state.volume < np.inf:
        quantities.append(
            AveragedQuantity("pressure", "bar", count * thermal / state.volume / BAR, of="N kT/V")
        )
    runs = [run for _, run in plan]
    quantities += [
        AveragedQuantity(column.header, column.unit, nan, is_main=False)
        for column in COLUMNS.values()
        if any(run.averages.get(column.header, (0.0, 0.0))[1] > 0 for run in runs)  # it varies
    ]
    return Averages(
        scene.name,
        stage.label,
        stage.temperatures[0],
        count,
        freedom.total,
        sample,
        quantities,
        runs,
    )


def start_of_last_stage(scene: MolecularScene) -> tuple[Simulation, State]:
    """A simulation of a scene, and the state in which its last stage starts. Earlier stages run
    without files."""
    simulation = Simulation(scene)
    if len(scene.stages) > 1:
        interval = scene.output.log_interval_ps if scene.stages[-1].volume else 1e9
        quiet = scene.output.model_copy(update={"trajectory": False, "log_interval_ps": interval})
        resolved = simulation.scene
        results = Simulation(
            resolved.model_copy(update={"stages": resolved.stages[:-1], "output": quiet})
        ).run()
        scale_to_mean_box(
            simulation.system, results.state, cast(Samples, results.samples), len(scene.stages) - 1
        )
        return simulation, results.state
    simulation._start()
    return simulation, simulation.state.copy()


def _with_thermostat(scene: MolecularScene) -> Stage:
    """The last stage. Raises SceneError unless it has a thermostat at one temperature."""
    stage = scene.stages[-1]
    if not stage.has_thermostat:
        advice = "give it ensemble = 'nvt' or 'npt'"
        error = (
            f"{option('averages')} samples the last stage, and {stage.ensemble} has no thermostat:"
            f" {advice}"
        )
        raise SceneError(scene.source, [error])
    if len(set(stage.temperatures)) > 1 or (
        stage.has_barostat and stage.pressures[0] != stage.pressures[1]
    ):
        error = (
            f"{option('averages')} needs one temperature and one pressure in the last stage. Here"
            " they change"
        )
        raise SceneError(scene.source, [error])
    return stage


def _parse_method(text: str, stage: Stage, known: Iterable[str]) -> tuple[str, str]:
    """Integrator and thermostat of "integrator+thermostat". Default: Langevin for baoab, else the
    stage's."""
    integrator, _, thermostat = (part.strip() for part in text.partition("+"))
    thermostat = thermostat or (
        "langevin" if integrator in WITH_THERMOSTAT else stage.thermostat_kind
    )
    for what, name, names in (
        ("integrator", integrator, known),
        ("thermostat", thermostat, THERMOSTATS),
    ):
        if name not in names:
            error = f"unknown {what} {name}{did_you_mean(name, names)} (known: {', '.join(names)})"
            raise SceneError(option("integrators"), [error])
    return integrator, thermostat


def _with_method(
    stage: Stage, integrator: str, thermostat: str, step: float, sample: float
) -> Stage:
    """The stage by another method at another step. Its settings of a thermostat or rotor are kept
    only for the same."""
    changes = dict.fromkeys(ERROR_TARGETS) | {
        "integrator": integrator,
        "thermostat": thermostat,
        "timestep_fs": step,
    }
    changes["duration_ps"] = (1 + EQUILIBRATION) * sample
    if thermostat != stage.thermostat_kind:
        changes["thermostat_time_ps"] = None
    if integrator != stage.integrator:
        changes["rotor"] = None
    return stage.model_copy(update=changes)


def _sample(
    scene: MolecularScene,
    stage: Stage,
    state: State,
    run: AverageRun,
    sample: float,
    progress: Every,
) -> None:
    """Run a stage from a state, and store means and cost in `run`."""
    interval = max(SAMPLING_INTERVAL_PS, sample / MOST_SAMPLES)
    output = scene.output.model_copy(update={"trajectory": False, "log_interval_ps": interval})
    changed = scene.model_copy(update={"stages": (stage,), "output": output})
    simulation = Simulation(changed, observers=progress, warn=lambda warning: None)
    simulation.start_from(state)
    try:
        results = simulation.run(progress=False)
    except SimulationError as error:
        run.failure = str(error).splitlines()[0]
        return
    if results.interrupted:
        raise KeyboardInterrupt
    summary = results.summary["stages"][0]
    run.seconds_per_ns = 1000 * summary["computing_s"] / summary["duration_ps"]
    late = results["time"] > EQUILIBRATION * sample
    count = len(simulation.system.model.species)
    series = {
        "U": results["potential"] / count,
        "T_trans": results["temperature_translation"],
        "T_rot": results["temperature_rotation"],
        "pressure": results["pressure_bar"],
        "density": results["density"],
    }
    series |= {
        column.header: results[name] for name, column in COLUMNS.items() if name not in NOT_AVERAGED
    }
    for name, values in series.items():
        average, error = mean_and_error(values[late])
        if average is not None and error is not None:
            run.averages[name] = average, error
        elif average is not None:
            run.short.append(name)
