"""`rigidmd accuracy --averages`: the sweep over integrator, thermostat and step of the last stage
that measures the biases of its averages."""

from collections.abc import Callable, Iterable
from math import floor, log10
from typing import NamedTuple, cast

from rigidmd.assemble.harmonic import stable_angle
from rigidmd.core.integrators import WITH_THERMOSTAT
from rigidmd.core.toml import Json
from rigidmd.errors import SceneError, option
from rigidmd.features.studies.accuracy.start import (
    check_engine_is_rigidmd,
    check_times,
    start_of_last_stage,
)
from rigidmd.features.studies.sweep.plan import Axis
from rigidmd.run.kind import kind_of
from rigidmd.run.stable_step import stiffest_mode
from rigidmd.scene import MolecularScene, Scene
from rigidmd.scene.ensembles import THERMOSTATS, ThermostatKeys
from rigidmd.scene.stage import ERROR_TARGETS, Stage
from rigidmd.scene.validation import did_you_mean
from rigidmd.units import FEMTOSECOND

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
#: Interval of the log, ps, and the largest number of its samples; longer runs have longer
#: intervals.
SAMPLING_INTERVAL_PS, MOST_SAMPLES = 0.02, 4000


class AveragesPlan(NamedTuple):
    """The axes of a sweep, and the methods among their combinations: (integrator, thermostat).

    stage : the table of the last stage in keys, such as "stages.1"
    """

    axes: list[Axis]
    methods: list[tuple[str, str]]
    stage: str

    @property
    def step_key(self) -> str:
        return f"{self.stage}.timestep_fs"

    def includes(self, values: Json) -> bool:
        integrator, thermostat = self.methods[0]
        integrator = values.get(f"{self.stage}.integrator", integrator)
        return (integrator, values.get(f"{self.stage}.thermostat", thermostat)) in self.methods


def plan_averages(
    scene: Scene,
    overrides: Json,
    methods: list[str] | None = None,
    timesteps: list[float] | None = None,
    sample: float = SAMPLE_PS,
    progress: Callable[[float], object] = lambda fraction: None,
) -> AveragesPlan:
    """The sweep of the last stage of a scene by methods at time steps, whose scenes are not yet
    checked. Raises SceneError.

    overrides : keys that were set of the file of the scene
    methods : "integrator" or "integrator+thermostat". Default: the method of the stage and
        `DEFAULT_METHODS`
    timesteps : fs. Default: fractions of the longest step that is stable with all methods. For
        them the stages before the last one run
    sample : ps that each is sampled, after a fifth of that
    progress : called with 0 before these stages run
    """
    kind_of(scene).check_has(scene, "averages", option=option("averages"))
    scene = cast(MolecularScene, scene)
    check_engine_is_rigidmd(scene)
    stage = _with_thermostat(scene)
    schemes = scene.schemes | WITH_THERMOSTAT
    pairs = [_parse_method(name, stage, schemes) for name in methods or DEFAULT_METHODS]
    if not methods and not stage.is_auto:
        pairs.insert(0, (stage.integrator, stage.thermostat_kind))
    pairs = list(dict.fromkeys(pairs))
    check_times(scene, (sample, *(timesteps or [])), f"time steps and {option('sample_ps')}")
    if timesteps is None:
        progress(0.0)
        timesteps = _default_steps(scene, min(stable_angle(schemes[name]) for name, _ in pairs))
    integrators, thermostats = map(dict.fromkeys, zip(*pairs, strict=True))
    table = f"stages.{len(scene.stages) - 1}"
    steps = sorted(set(timesteps))
    swept = {"integrator": integrators, "thermostat": thermostats, "timestep_fs": steps}
    axes = [
        Axis((f"{table}.{key}",), tuple(values), swept=len(values) > 1 or key == "timestep_fs")
        for key, values in swept.items()
    ]
    keys = [*ERROR_TARGETS]
    if thermostats.keys() != {stage.thermostat_kind}:  # its settings are not those of another one
        keys += ThermostatKeys.model_fields.keys() - {"thermostat"}
    if integrators.keys() != {stage.integrator}:
        keys.append("rotor")
    unset = [key for key in keys if getattr(stage, key) != type(stage).model_fields[key].default]
    fixed = overrides | dict.fromkeys(f"{table}.{key}" for key in unset)
    fixed |= {"output.trajectory": False, "output.figures": False}
    fixed["output.log_interval_ps"] = max(SAMPLING_INTERVAL_PS, sample / MOST_SAMPLES)
    fixed[f"{table}.duration_ps"] = (1 + EQUILIBRATION) * sample
    keys_of_axes = {axis.keys[0] for axis in axes}
    fixed_axes = [
        Axis((key,), (value,), swept=False)
        for key, value in fixed.items()
        if key not in keys_of_axes
    ]
    return AveragesPlan([*fixed_axes, *axes], pairs, table)


def _default_steps(scene: MolecularScene, angle: float) -> list[float]:
    """Fractions of the longest stable step, at which the stiffest motion rotates by this angle."""
    simulation, state = start_of_last_stage(scene)
    stiffest = stiffest_mode(simulation.system, state)
    if stiffest is None:
        return [ratio * simulation.scene.stages[-1].step_fs for ratio in LADDER_AROUND_SCENE]
    exact = [ratio * angle / stiffest.rate / FEMTOSECOND for ratio in LADDER]
    return [round(step, 1 - floor(log10(step))) for step in exact]  # two digits, for tables


def _with_thermostat(scene: MolecularScene) -> Stage:
    """The last stage. Raises SceneError unless it has a thermostat at one temperature."""
    stage = scene.stages[-1]
    if not stage.has_thermostat:
        error = (
            f"{option('averages')} samples the last stage, and {stage.ensemble} has no thermostat:"
            " give it ensemble = 'nvt' or 'npt'"
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
