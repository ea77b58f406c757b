"""What `rigidmd precision --averages` measures: the bias of averages in the ensemble of a scene's last stage."""

from collections.abc import Callable
from math import floor, inf, log10, nan

import numpy as np

from rigidmd.core.integrators import SCHEMES, WITH_THERMOSTAT
from rigidmd.core.state import State
from rigidmd.core.statistics import mean
from rigidmd.dynamics.momenta import remove_momentum
from rigidmd.errors import SceneError, SimulationError
from rigidmd.run.molecular import MolecularSimulation
from rigidmd.run.observers import Every
from rigidmd.run.pilot.stable_step import stable_angle, stiffest_mode
from rigidmd.scene import BodyScene, MolecularScene
from rigidmd.scene.stage import ERROR_TARGETS, THERMOSTAT_TIMES, Stage
from rigidmd.scene.validation import did_you_mean
from rigidmd.studies.accuracy.bias import AverageRun, Averages, Quantity
from rigidmd.units import BAR, BOLTZMANN, FEMTOSECOND, KJ_PER_MOL

#: Measured besides the method of the stage when no others are asked for.
USUAL = ("baoab+langevin", "velocity_verlet+velocity_rescaling", "velocity_verlet+nose_hoover")
THERMOSTATS = ("langevin", *THERMOSTAT_TIMES)
#: Time steps, in the longest stable one.
LADDER = (0.15, 0.3, 0.45, 0.6, 0.75)
#: The same in the scene's own, where nothing tells what is stable.
AROUND = (0.5, 1.0, 2.0, 4.0)
SAMPLE_PS = 20.0
#: Time before sampling, in the time sampled: the start is from a distribution of another step.
SETTLING = 0.2
#: Averages are taken from looks this far apart, ps, and of long runs from no more than so many.
SAMPLING_INTERVAL_PS, MOST_LOOKS = 0.02, 4000


def check_is_at_home(scene: MolecularScene | BodyScene) -> None:
    """Raise SceneError if another engine computes a scene: what is measured are rigidmd's own integrators."""
    if isinstance(scene, MolecularScene) and scene.engine.is_external:
        raise SceneError(
            scene.source, [f"engine.name = {scene.engine.name!r}: precision measures rigidmd; leave it out"]
        )


def averages(
    scene: MolecularScene | BodyScene,
    methods: list[str] | None = None,
    timesteps: list[float] | None = None,
    sample: float = SAMPLE_PS,
    say: Callable[[float], object] = lambda share: None,
) -> Averages:
    """Means of U, temperatures, and pressure or density in the last stage, by methods at time steps.

    methods : "integrator" or "integrator+thermostat"; the stage's own and `USUAL` when not given. timesteps : fs, the
    same for all; when not given shares of each one's longest stable step. sample : ps that each is sampled, after a
    fifth of that. say : told the share that is done. The earlier stages run before, once, as the scene says. Raises
    SceneError.
    """
    if isinstance(scene, BodyScene):
        raise SceneError(scene.source, ["--averages is for molecules; a single body has no thermostat"])
    check_is_at_home(scene)
    stage = _with_thermostat(scene)
    told = [_method(name, stage) for name in methods] if methods else _usual(stage)
    if not all(0 < length < inf for length in (sample, *(timesteps or []))):
        raise SceneError("precision", ["time steps and --sample-ps must be finite and greater than 0"])
    if timesteps and max(timesteps) * FEMTOSECOND > sample:
        raise SceneError("--timesteps", [f"{max(timesteps):g} fs is longer than the {sample:g} ps sampled with it"])
    say(0.0)
    simulation, state = start_of_last_stage(scene)
    remove_momentum(simulation.system.model, state.velocity)
    found = stiffest_mode(simulation.system, state)
    plan: list[tuple[Stage, AverageRun]] = []
    for integrator, thermostat in told:
        scheme = (SCHEMES | WITH_THERMOSTAT)[integrator]
        if timesteps:
            steps = list(timesteps)
        elif found is None:
            steps = [share * stage.timestep_fs for share in AROUND]
        else:
            steps = [_rounded(share * stable_angle(scheme) / found.rate / FEMTOSECOND) for share in LADDER]
        for step in sorted(set(steps)):
            cost = scheme.force_evaluations / (step * FEMTOSECOND)
            plan.append((_changed(stage, integrator, thermostat, step, sample), AverageRun(
                integrator, thermostat, step, cost)))  # fmt: skip
    whole = sum(run.forces_per_ps for _, run in plan)
    done = 0.0
    for changed, run in plan:
        length = changed.duration

        def share(moment, before=done, part=run.forces_per_ps / whole, length=length):
            say(before + part * min(1.0, moment.time / length))

        _sample(scene, changed, state, run, sample, Every(length / 50, share))
        done += run.forces_per_ps / whole
        say(done)
    last = len(scene.stages) - 1
    freedom = simulation.system.freedom_in(last)
    count = len(simulation.system.model.species)
    thermal = BOLTZMANN * stage.temperatures[0]
    unit = thermal * freedom.total / count / KJ_PER_MOL
    quantities = [Quantity("U", "kJ/mol", unit, bias_unit="kT per degree of freedom", bias_size=unit)]
    for name, n in (("T_trans", freedom.translation), ("T_rot", freedom.rotation)):
        if n:
            exact = stage.temperatures[0]
            quantities.append(Quantity(name, "K", exact, exact))
            quantities.append(Quantity(f"{name} unbiased", "K", exact, exact, only="velocity_verlet"))
    if stage.ensemble == "npt":
        quantities.append(Quantity("density", "g/cm³", nan))
    elif state.volume < np.inf:
        quantities.append(Quantity("pressure", "bar", count * thermal / state.volume / BAR))
    return Averages(
        scene.name,
        stage.label,
        stage.temperatures[0],
        count,
        freedom.total,
        sample,
        quantities,
        [run for _, run in plan],
    )


def start_of_last_stage(scene: MolecularScene) -> tuple[MolecularSimulation, State]:
    """A simulation of a scene, and the state in which its last stage begins: the earlier ones are run, no files."""
    simulation = MolecularSimulation(scene)
    if len(scene.stages) > 1:
        quiet = scene.output.model_copy(update={"trajectory": False, "log_interval_ps": 1e9})
        resolved = simulation.scene
        earlier = MolecularSimulation(resolved.model_copy(update={"stages": resolved.stages[:-1], "output": quiet}))
        return simulation, earlier.run().state
    simulation.start()
    return simulation, simulation.state


def _with_thermostat(scene: MolecularScene) -> Stage:
    """The last stage. Raises SceneError where it does not keep one temperature."""
    stage = scene.stages[-1]
    if not stage.has_thermostat:
        fault = (
            f"--averages samples the last stage, and {stage.ensemble} has no thermostat: give it ensemble = 'nvt' or "
            "'npt', or see --averages PS for averages at constant energy"
        )
        raise SceneError(scene.source, [fault])
    if len(set(stage.temperatures)) > 1 or (stage.has_barostat and stage.pressures[0] != stage.pressures[1]):
        fault = "--averages needs one temperature and one pressure in the last stage; here they change"
        raise SceneError(scene.source, [fault])
    return stage


def _usual(stage: Stage) -> list[tuple[str, str]]:
    own = [] if stage.is_auto else [(stage.integrator, stage.thermostat_kind)]
    return list(dict.fromkeys([*own, *(_method(name, stage) for name in USUAL)]))


def _method(told: str, stage: Stage) -> tuple[str, str]:
    """Integrator and thermostat of "integrator+thermostat"; Langevin's of a lone baoab, else the stage's."""
    integrator, _, thermostat = (part.strip() for part in told.partition("+"))
    known = (*SCHEMES, *WITH_THERMOSTAT)
    if integrator not in known:
        raise SceneError(
            "--integrators", [f"there is no {integrator}{did_you_mean(integrator, known)} (known: {', '.join(known)})"]
        )
    thermostat = thermostat or ("langevin" if integrator in WITH_THERMOSTAT else stage.thermostat_kind)
    if thermostat not in THERMOSTATS:
        fault = f"there is no thermostat {thermostat}{did_you_mean(thermostat, THERMOSTATS)} (known: {', '.join(THERMOSTATS)})"
        raise SceneError("--integrators", [fault])
    return integrator, thermostat


def _changed(stage: Stage, integrator: str, thermostat: str, step: float, sample: float) -> Stage:
    """The stage by another method at another step; what it says of its own thermostat and rotor holds only for them."""
    changes = {"integrator": integrator, "thermostat": thermostat, "timestep_fs": step}
    changes |= {"duration_ps": (1 + SETTLING) * sample}
    changes |= dict.fromkeys(ERROR_TARGETS)
    if thermostat != stage.thermostat_kind:
        changes["thermostat_time_ps"] = None
    if integrator != stage.integrator:
        changes["rotor"] = None
    return stage.model_copy(update=changes)


def _sample(scene: MolecularScene, stage: Stage, state: State, run: AverageRun, sample: float, progress: Every) -> None:
    """Run a stage from a state, and put means and cost into `run`."""
    interval = max(SAMPLING_INTERVAL_PS, sample / MOST_LOOKS)
    output = scene.output.model_copy(update={"trajectory": False, "log_interval_ps": interval})
    changed = scene.model_copy(update={"stages": (stage,), "output": output})
    simulation = MolecularSimulation(changed, observers=progress, warn=lambda warning: None)
    simulation.start_from(state)
    try:
        results = simulation.run(progress=False)
    except SimulationError as error:
        run.fault = str(error).splitlines()[0]
        return
    if results.interrupted:
        raise KeyboardInterrupt
    summary = results.summary["stages"][0]
    run.seconds_per_ns = 1000 * summary["computing_s"] / summary["duration_ps"]
    late = results["time"] > SETTLING * sample
    count = len(simulation.system.model.species)
    series = {
        "U": results["potential"] / count,
        "T_trans": results["temperature_translation"],
        "T_rot": results["temperature_rotation"],
        "T_trans unbiased": results["temperature_translation_unbiased"],
        "T_rot unbiased": results["temperature_rotation_unbiased"],
        "pressure": results["pressure_bar"],
        "density": results["density"],
    }
    for name, values in series.items():
        average, error = mean(values[late])
        if average is not None and error is not None:
            run.averages[name] = average, error
        elif average is not None:
            run.short.append(name)


def _rounded(step: float) -> float:
    """To two digits, which a table and a legend can show."""
    return round(step, 1 - floor(log10(step)))
