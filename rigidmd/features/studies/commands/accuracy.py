"""`rigidmd accuracy`."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from rigidmd.commands.arguments import (
    SCENE,
    Options,
    argument,
    command,
    flag,
    output_folder,
    read_scene,
    write_study,
)
from rigidmd.commands.streams import progress_bar

if TYPE_CHECKING:
    from rigidmd.scene import Scene


@command(
    "Study",
    10,
    "measure the error and the run time of integrators and time steps",
    "rigidmd accuracy heavy_top_3.toml --integrators velocity_verlet,srkn_6\n"
    "  rigidmd accuracy heavy_top_3.toml --integrators rk4,rk4_quaternion,rk4_euler_angles\n"
    "  rigidmd accuracy liquid.toml --averages --sample-ps 50 --timesteps 1,2,4,6,8 "
    "--integrators baoab,velocity_verlet+nose_hoover",
    *SCENE,
    argument(
        "--integrators",
        metavar="A,B,...",
        help=(
            "integrators (default: the scene's and those that suit it; for a body also general ODE"
            " solvers, each with Q as a matrix, a quaternion and Euler angles: rk4, rk4_quaternion,"
            " rk4_euler_angles, dop853, dop853_quaternion, dop853_euler_angles). If the scene sets"
            " run.formulation, rk4, dop853 and radau use it, and rk4_matrix uses the matrix"
        ),
    ),
    argument("--timesteps", metavar="X,Y,...", help="time steps, fs for molecules, s for a body"),
    argument(
        "--span",
        type=float,
        metavar="T",
        help="length of each run (default: 0.1 ps, for a body the length of its run)",
    ),
    argument(
        "--repeats",
        type=int,
        default=3,
        metavar="N",
        help="number of timings of each run (default: 3). One timing shows no spread",
    ),
    flag(
        "--averages",
        help=(
            "molecules only: measure the bias of averages instead, by a sweep of the last stage in"
            " runs/NAME-averages under its thermostat (nvt, npt) over integrators and steps, with"
            " --extrapolate. --integrators then accepts names with a thermostat, such as"
            " baoab+langevin (default: the method of the stage, baoab+velocity_rescaling,"
            " baoab+langevin, velocity_verlet+velocity_rescaling), and --timesteps has fractions of"
            " the longest step that is stable with all of them as its default"
        ),
    ),
    argument(
        "--sample-ps",
        type=float,
        metavar="PS",
        help=(
            "with --averages: sampling time for each time step, after an equilibration of a fifth"
            " of it (default: 20)"
        ),
    ),
    flag(
        "-v", "--verbose", help="also print which integrators are equally fast within timing noise"
    ),
    *output_folder("runs/NAME-accuracy"),
    writes=True,
)
def _accuracy(options: Options) -> int:
    from rigidmd.errors import SceneError
    from rigidmd.features.studies.accuracy import accuracy

    scene = read_scene(options)
    kind = "averages" if options.averages else "accuracy"
    folder = Path(options.output or f"runs/{scene.name}-{kind}")
    integrators = options.integrators.split(",") if options.integrators else None
    try:
        timesteps = (
            [float(text) for text in options.timesteps.split(",")] if options.timesteps else None
        )
    except ValueError:
        raise SceneError(
            "--timesteps", [f"{options.timesteps!r} is not a list of numbers such as 1,2,4"]
        ) from None
    if options.averages:
        return _sweep_of_averages(options, scene, folder, integrators, timesteps)
    if options.sample_ps is not None:
        raise SceneError("--sample-ps", ["it needs --averages"])
    settings = integrators, timesteps, options.span, options.repeats
    write_study(
        folder,
        force=options.force,
        files=accuracy.FILES,
        begins="compiling and running the reference",
        measure=lambda progress: accuracy.measure_accuracy(scene, *settings, progress),
        describe=lambda errors: accuracy.describe_accuracy(errors, verbose=options.verbose),
        write=accuracy.write_accuracy,
    )
    return 0


def _sweep_of_averages(
    options: Options,
    scene: "Scene",
    folder: Path,
    methods: list[str] | None,
    timesteps: list[float] | None,
) -> int:
    from rigidmd.features.studies.accuracy.averages import SAMPLE_PS, plan_averages
    from rigidmd.features.studies.commands import sweep
    from rigidmd.features.studies.sweep.sweeping import open_sweep
    from rigidmd.scene import parse_override

    sample = SAMPLE_PS if options.sample_ps is None else options.sample_ps
    overrides = dict(map(parse_override, options.overrides))
    with progress_bar("compiling, and running what comes before the last stage") as progress:
        plan = plan_averages(scene, overrides, methods, timesteps, sample, progress)
    more = {"trust": options.trust, "force": options.force, "step": plan.step_key}
    path = Path(options.scene)
    with open_sweep(path, plan.axes, folder, includes=plan.includes, **more) as manifest:
        print(f"--averages is a sweep over {', '.join(manifest.keys)}. To read it again:")
        words = ["rigidmd", "sweep", options.scene, "-o", str(folder), "--collect"]
        print(f"  {shlex.join([*words, '--extrapolate', plan.step_key])}")
        defaults = dict.fromkeys(("jobs", "threads", "scheduler", "walltime"))
        settings = vars(options) | defaults | {"extrapolate": plan.step_key}
        return sweep.run(Options(**settings), manifest)
