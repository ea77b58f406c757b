"""The commands. They print and never compute. Each imports what it needs only when it runs."""

import argparse
import json
import re
import shlex
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING

from rigidmd.commands import analyse as analysing
from rigidmd.commands import engines
from rigidmd.commands import studies as studying
from rigidmd.commands import view as looking
from rigidmd.commands.arguments import (
    BAD_INPUT,
    BY_SIGNAL,
    FAILED,
    INTERRUPTED,
    OUT_OF_TIME,
    add_engine,
    add_trust,
    say,
    seconds,
    time_ps,
    warn,
)

if TYPE_CHECKING:
    from rigidmd.scene import BodyScene

EXAMPLES = """examples:
  rigidmd new water                         copy a scene to start from: water.toml
  rigidmd check water.toml                  describe the run without running it
  rigidmd run water.toml                    run it; results go to runs/water
  rigidmd run water.toml --set stages.1.timestep_fs=4 -o runs/water4
  rigidmd energy water.toml --unit kcal/mol
  rigidmd new heavy_top_3 && rigidmd run heavy_top_3.toml      one body: a top, with figures of its motion
  rigidmd help                              the chapters of the documentation
"""

#: What the loader of shared libraries and the system report where memory does not suffice.
NO_ROOM = ("failed to map segment", "cannot allocate memory", "Cannot allocate memory")


def main(arguments: list[str] | None = None) -> int:
    """Run one command.

    Exit code: 0 success, 1 failed run, 2 bad input, 75 wall time is up, 130 or 143 ended by a signal.
    """
    from rigidmd.commands.streams import checked_streams, open_streams
    from rigidmd.core.memory import free_memory, in_words  # now: an import may need more than there is
    from rigidmd.errors import RigidMDError, RigidMDWarning, SimulationError

    options = argparse.Namespace()

    def show(message, category, *where, **more):
        warn(str(message)) if issubclass(category, RigidMDWarning) else others(message, category, *where, **more)

    try:
        open_streams()
        options = _parsed(sys.argv[1:] if arguments is None else arguments)
        with warnings.catch_warnings(), checked_streams(lasting=options.writes):
            others, warnings.showwarning = warnings.showwarning, show
            return options.command(options)
    except SimulationError as error:
        print(f"rigidmd: {error}", file=sys.stderr)
        return FAILED
    except RigidMDError as error:
        print(f"rigidmd: {error}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print("rigidmd: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # the reader of a pipe has gone: `rigidmd models | head`
        return 0
    except Exception as error:  # libraries turn what happens into errors of many types; all others are raised again
        causes = list(_causes(error))
        if any(isinstance(cause, KeyboardInterrupt) for cause in causes):
            print("rigidmd: interrupted", file=sys.stderr)
            return INTERRUPTED
        if any(isinstance(cause, MemoryError) for cause in causes):  # zipfile, too, raises another one in its place
            what, free = getattr(options, "scene", "this"), in_words(free_memory())
            print(f"rigidmd: {what}: not enough memory ({free} free); take fewer molecules or samples", file=sys.stderr)
            return BAD_INPUT
        if any(words in str(cause) for cause in causes for words in NO_ROOM):
            print("rigidmd: not enough memory to load the program; raise the limit (ulimit -v)", file=sys.stderr)
            return BAD_INPUT
        raise


def _causes(error: BaseException | None) -> Iterator[BaseException]:
    """An error and those it came of."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def _parsed(words: list[str]) -> argparse.Namespace:
    """The options of a command line; a command or an option that there is not ends it, with what may be meant."""
    parser, commands = _parser()
    name = next((word for word in words if not word.startswith("-")), None)
    if name is not None and name not in commands:
        parser.error(f"there is no command {name!r}{_meant(name, commands) or '; `rigidmd --help` lists them'}")
    options, unknown = parser.parse_known_args(words)
    if unknown and name is not None:
        known = re.findall(r"(?<![\w-])--[a-z-]+", commands[name].format_help())
        commands[name].error(f"there is no argument {unknown[0]!r}{_meant(unknown[0].partition('=')[0], known)}")
    return options


def _meant(name: str, known: Iterable[str]) -> str:
    """'; did you mean ...?' for a word that is not known."""
    from rigidmd.scene.validation import meant  # not before it is needed: it loads pydantic

    return meant(name, dict.fromkeys(known))


def _parser() -> tuple[argparse.ArgumentParser, dict[str, argparse.ArgumentParser]]:
    """The parser of a command line, and those of its commands by name."""
    parser = argparse.ArgumentParser(
        prog="rigidmd",
        description="Molecular dynamics of rigid molecules, and the motion of single rigid bodies, from a scene file.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    _command(
        commands, "examples", _examples, "list the scenes, notebooks and scripts that rigidmd ships", "rigidmd examples"
    )
    new = _command(
        commands,
        "new",
        _new,
        "copy a shipped scene, notebook or script to start from",
        "rigidmd new water -o mine.toml",
    )
    new.add_argument("name", metavar="NAME", help="which one; `rigidmd examples` lists them")
    new.add_argument("-o", "--output", metavar="FILE", help="the copy (default: NAME.toml, .ipynb or .py)")
    new.add_argument("--force", action="store_true", help="replace that file")

    run = _command(commands, "run", _run, "run a scene", "rigidmd run water.toml -o runs/water")
    _scene_arguments(run)
    run.add_argument("-o", "--output", metavar="DIR", help="folder for the results (default: runs/NAME)")
    run.add_argument("--force", action="store_true", help="replace an earlier run in that folder")
    run.add_argument(
        "--resume", action="store_true",
        help="go on from the last checkpoint in that folder, to the same bits; without one, begin",
    )  # fmt: skip
    add_engine(run)
    _going_on(run)

    resume = _command(
        commands,
        "resume",
        _resume,
        "go on with a run that was stopped",
        "rigidmd resume runs/water --until 200ps",
    )
    resume.add_argument("folder", metavar="DIR", help="folder of the run")
    add_trust(resume)
    _going_on(resume)
    resume.set_defaults(overrides=[], force=False, resume=True)

    compare = _command(
        commands,
        "compare",
        _compare,
        "tell where two runs part and what differs in what they were made from; exit code 0 if they are the same to "
        "the last bit, else 1",
        "rigidmd compare runs/water runs/water2",
    )
    compare.add_argument("first", metavar="RUN", help="folder of a run")
    compare.add_argument("second", metavar="RUN", help="folder of another run")
    compare.add_argument("--json", action="store_true", help="print JSON")

    energy = _command(
        commands,
        "energy",
        _energy,
        "energies and forces of the start",
        "rigidmd energy water_dimer.toml --json",
    )
    _scene_arguments(energy)
    energy.add_argument(
        "--unit", choices=["kJ/mol", "kcal/mol", "eV", "K"], help="unit of energy (kJ/mol; J for a body)"
    )
    energy.add_argument("--json", action="store_true", help="print JSON")
    energy.add_argument(
        "--accuracy", action="store_true", help="also measure the error of the Coulomb forces (Ewald sums and PME)"
    )

    check = _command(
        commands, "check", _check, "describe a run without running it", "rigidmd check water_nitrogen.toml"
    )
    _scene_arguments(check)
    add_engine(check)
    engines.add_commands(partial(_command, commands), _scene_arguments, _read_scene)

    precision = _command(
        commands,
        "precision",
        _precision,
        "measure the error and the run time of integrators at several time steps",
        "rigidmd precision heavy_top_3.toml --integrators velocity_verlet,srkn_6\n"
        "  rigidmd precision heavy_top_3.toml --integrators rk4,rk4_quaternion,rk4_euler_angles\n"
        "  rigidmd precision liquid.toml --averages --sample-ps 50 --timesteps 1,2,4,6,8 "
        "--integrators baoab,velocity_verlet+nose_hoover",
    )
    _scene_arguments(precision)
    precision.add_argument(
        "--integrators", metavar="A,B,...",
        help="integrators (default: the scene's own and those that suit it; for a body also general ODE solvers, each "
        "with Q as a matrix, a quaternion and Euler angles: rk4, rk4_quaternion, rk4_euler_angles, dop853, "
        "dop853_quaternion, dop853_euler_angles). If the scene sets run.formulation, rk4, dop853 and radau use it, "
        "and rk4_matrix uses the matrix",
    )  # fmt: skip
    precision.add_argument("--timesteps", metavar="X,Y,...", help="time steps, fs for molecules, s for a body")
    precision.add_argument("--span", type=float, metavar="T", help="how long each runs (default: 0.1 ps; a body's run)")
    precision.add_argument(
        "--repeats", type=int, default=3, metavar="N", help="timings of each run (default: 3); 1 shows no spread"
    )
    precision.add_argument(
        "--averages", type=float, metavar="PS", nargs="?", const=inf,
        help="of molecules: also average temperatures, energy and pressure over so many ps with every step, at "
        "constant energy. With no PS behind it, instead of all else: sample the last stage under its thermostat (nvt, "
        "npt) with every integrator at every step, and tell the bias of averages. --integrators then takes names with "
        "a thermostat, baoab+langevin (default: that of the stage, baoab+langevin, "
        "velocity_verlet+velocity_rescaling, velocity_verlet+nose_hoover), and --timesteps default to shares of the "
        "longest stable one",
    )  # fmt: skip
    precision.add_argument(
        "--sample-ps", type=float, metavar="PS",
        help="with --averages alone: time sampled with every step, after a fifth of it (default: 20)",
    )  # fmt: skip
    precision.add_argument("-o", "--output", metavar="DIR", help="folder (default: runs/NAME-precision)")
    precision.add_argument("--force", action="store_true", help="replace earlier results in that folder")
    precision.set_defaults(writes=True)

    stability = _command(
        commands,
        "stability",
        _stability,
        "try to break the engine: named cases, each compared with a known answer; exit code 1 if any is silently wrong",
        "rigidmd stability --quick --case near_linear --case water_steps",
    )
    stability.add_argument("--quick", action="store_true", help="fewer settings, integrators and steps: minutes")
    stability.add_argument("--case", action="append", metavar="NAME", help="only this case; may be repeated")
    stability.add_argument("-o", "--output", metavar="DIR", help="folder (default: runs/stability)")
    stability.add_argument("--force", action="store_true", help="replace earlier results in that folder")
    stability.set_defaults(scene="stability", writes=True)

    analysing.add_commands(partial(_command, commands))
    studying.add_commands(partial(_command, commands))
    looking.add_commands(partial(_command, commands))

    models = _command(
        commands,
        "models",
        _models,
        "list the molecular models that rigidmd ships, show or draw one, or write one of your own",
        "rigidmd models tip4p2005 --draw -o water.svg\n"
        "  rigidmd models --from dye.xyz --parameters table.toml -o dye.toml",
    )
    models.add_argument("model", nargs="?", metavar="NAME", help="model to show, or a .toml file with your own")
    models.add_argument("--draw", action="store_true", help="draw it to NAME.png")
    models.add_argument(
        "--from", dest="geometry", metavar="FILE",
        help="write a model of your own: a structure file with one molecule, of any format that a scene takes",
    )  # fmt: skip
    models.add_argument(
        "--parameters", metavar="TABLE",
        help="with --from: a .toml file with charges and Lennard-Jones parameters by name of an atom or element",
    )  # fmt: skip
    models.add_argument("--name", metavar="NAME", dest="own_name", help="with --from: name of the model")
    models.add_argument(
        "-o", "--output", metavar="FILE",
        help="picture file: .png, .svg or .pdf; with --from the model's (default: that of the structure, .toml)",
    )  # fmt: skip
    models.add_argument("--force", action="store_true", help="replace that file")
    _command(
        commands,
        "schema",
        _schema,
        "print the JSON schema of scenes, for editors",
        "rigidmd schema > scene.schema.json",
    )
    chapters = _command(
        commands, "help", _help, "list the chapters of the documentation, or print one", "rigidmd help water | less"
    )
    chapters.add_argument("chapter", nargs="?", metavar="CHAPTER", help="chapter to print, or a word to find in them")
    return parser, commands.choices


class _Version(argparse.Action):
    def __call__(self, parser, namespace, values, option_string=None):
        from importlib.metadata import version

        print(f"rigidmd {version('rigidmd')}")
        parser.exit()


def _command(commands, name: str, function, about: str, example: str) -> argparse.ArgumentParser:
    parser = commands.add_parser(
        name,
        help=about,
        description=about[0].upper() + about[1:] + ".",
        epilog=f"example:\n  {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(command=function, writes=False)  # writes: files are its results, not what it prints
    return parser


def _scene_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scene", metavar="SCENE", help="scene file (TOML)")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="overrides",
        help="override a key of the scene by its dotted path (an entry of a list by its number from 0, or a "
        "stage by its name); KEY= without a value removes the key; may be repeated",
    )
    add_trust(parser)


def _going_on(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(writes=True)
    parser.add_argument("--threads", type=int, metavar="N", help="threads (default: the scene's, or all cores)")
    parser.add_argument(
        "--walltime", type=seconds, metavar="H:MM:SS",
        help="stop shortly before this time is up, with a checkpoint and exit code 75",
    )  # fmt: skip
    parser.add_argument(
        "--until", type=time_ps, metavar="TIME",
        help="let the last stage end at this time of the run, such as 200ps or 1.5ns; lengthens a finished run",
    )  # fmt: skip


def _read_scene(options: argparse.Namespace, **more):
    from rigidmd.scene import Scene, parse_override

    if options.trust:
        from rigidmd.assemble.user_code.trust import check_trusted, trust

        for path in options.trust:
            trust(path)
    overrides = dict(parse_override(text) for text in options.overrides)
    for option, key in (("engine", "name"), ("ranks", "ranks"), ("platform", "platform")):
        if (value := getattr(options, option, None)) is not None:
            overrides[f"engine.{key}"] = value
    scene = Scene.read(options.scene, overrides | more)
    if options.trust:
        check_trusted(scene, options.trust)
    return scene


def _examples(options: argparse.Namespace) -> int:
    from rigidmd.scene.shipped import examples, notebooks, scripts

    scenes = examples()
    kinds = {
        "molecules": [example for example in scenes if not example.is_body],
        "one body": [example for example in scenes if example.is_body],
        "notebooks": notebooks(),
        "scripts, which extend it": scripts(),
    }
    width = max(len(example.name) for example in scenes)
    for title, found in kinds.items():
        print(f"{title}:")
        for example in found:
            print(f"  {example.name:<{width}}  {example.about}")
        print()
    print("`rigidmd new NAME` copies one into the working directory")
    return 0


def _new(options: argparse.Namespace) -> int:
    from rigidmd.scene import Scene
    from rigidmd.scene.shipped import copy_example, find_example, series_of

    example = find_example(options.name)
    path = Path(options.output or f"{example.name}{example.path.suffix}")
    read = Scene.read(example.path).inputs.values() if example.kind == "scene" else ()
    written = copy_example(example, path, options.force, read)
    if example.name != options.name:
        print(f"{options.name} is a series of scenes ({', '.join(series_of(options.name))}); this is {example.name}")
    print(f"{path}: {example.about}")
    if beside := [str(file) for file in written[1:]]:
        print(f"files that it reads, copied beside it: {', '.join(beside)}")
    print("next:")
    if example.kind == "script":
        print(f"  python {shlex.quote(str(path))}    runs it; `rigidmd help extending` explains it")
        return 0
    if example.kind == "notebook":
        print("  open it in Jupyter, VS Code or any program for notebooks: pip install 'rigidmd[notebook]' jupyterlab")
        print(f"  jupyter lab {shlex.quote(str(path))}")
        return 0
    print(f"  rigidmd check {shlex.quote(str(path))}    describes the run without running it")
    print(f"  rigidmd run {shlex.quote(str(path))}      runs it; results go to {Path('runs') / path.stem}")
    print("its comment says what to look at; `rigidmd help manual` explains every table")
    return 0


def _run(options: argparse.Namespace) -> int:
    from rigidmd.scene import BodyScene

    scene = _read_scene(options)
    if options.threads is not None:
        from rigidmd.errors import SceneError

        if isinstance(scene, BodyScene):
            raise SceneError(scene.source, ["--threads is for molecules; a single body uses one thread"])
        scene = _read_scene(options, threads=options.threads)
    if options.until is not None:
        scene = scene.lasting(options.until)
    folder = Path(options.output) if options.output else Path("runs") / scene.name
    from rigidmd.io.folder import check_folder

    if not options.resume:
        check_folder(folder, options.force)  # before anything slow is imported
    from rigidmd.run import Simulation

    going_on = {"resume": options.resume, "walltime": options.walltime}
    simulation = Simulation(scene, folder, options.force, say=say, warn=warn, **going_on)
    print(simulation.introduction(), flush=True)
    results = simulation.run(progress=True)
    print(simulation.conclusion(results))
    print(f"\n  files in {folder}: {', '.join(path.name for path in results.files)}")
    where = shlex.quote(str(folder))
    if results.interrupted:
        print(f"  `rigidmd resume {where}` goes on with it")
    else:
        more = "report` the page alone" if isinstance(scene, BodyScene) else f"analyse {where}` measures it"
        print(f"  `rigidmd view {where}` shows its film on a page, `rigidmd {more}")
    if results.out_of_time:
        return OUT_OF_TIME
    return BY_SIGNAL + results.signal if results.signal else 0


def _resume(options: argparse.Namespace) -> int:
    from rigidmd.io.folder import SCENE, check_is_run

    folder = Path(options.folder)
    check_is_run(folder)
    options.scene, options.output = str(folder / SCENE), options.folder
    return _run(options)


def _compare(options: argparse.Namespace) -> int:
    from rigidmd.studies.compare import compare, in_words

    found = compare(Path(options.first), Path(options.second))
    print(json.dumps(found.told(), indent=2) if options.json else in_words(found))
    return 0 if found.same else FAILED


def _energy(options: argparse.Namespace) -> int:
    from rigidmd.run import Simulation
    from rigidmd.scene import BodyScene
    from rigidmd.units import ENERGY_UNITS

    scene = _read_scene(options)
    if isinstance(scene, BodyScene):
        return _body_energy(scene, options)
    unit = options.unit or "kJ/mol"
    found = Simulation(scene).start_energy(ENERGY_UNITS[unit], unit, options.accuracy)
    if options.json:
        print(json.dumps(found, indent=2))
        return 0
    relieved = f", after {found['relief_steps']} steps of overlap relief" if found["relief_steps"] else ""
    print(f"{scene.name}: energies of the start, {found['molecules']} molecules{relieved}")
    for note in found["notes"]:
        print(f"  {note}")
    for name, value in [*found["components"].items(), ("potential", found["potential"])]:
        print(f"  {name.replace('_', ' '):<22}{value:>22.10g} {unit}")
    print(f"  {'kinetic':<22}{found['kinetic']:>22.10g} {unit}")
    print(f"  {'virial':<22}{found['virial']:>22.10g} {unit}")
    if found["pressure_bar"] is not None:
        print(f"  {'pressure':<22}{found['pressure_bar']:>22.10g} bar")
    force, molecule = found["largest_force_per_A"], found["largest_force_molecule"]
    print(f"  {'largest force':<22}{force:>22.10g} {unit}/Å on molecule {molecule}")
    for name, text in found["meaning"].items():
        print(f"  {name.replace('_', ' ')}: {text}")
    if options.accuracy:
        error = found["accuracy"]
        print(f"Coulomb forces on sites, compared with {error['reference']}")
        print(f"  {'rms force':<22}{error['rms_force_per_A']:>22.4g} {unit}/Å")
        relative = f"{error['relative']:.2g} of it, {error['in_e2_per_A2']:.2g} e²/Å²"
        print(f"  {'rms error':<22}{error['rms_error_per_A']:>22.4g} {unit}/Å: {relative}")
        print(f"  {'estimated':<22}{error['estimated_per_A']:>22.4g} {unit}/Å")
        print(f"  {'largest error':<22}{error['largest_error_per_A']:>22.4g} {unit}/Å")
        print(f"  {'error of the energy':<22}{error['energy_error']:>22.4g} {unit}")
    return 0


def _body_energy(scene: "BodyScene", options: argparse.Namespace) -> int:
    from rigidmd.errors import SceneError
    from rigidmd.run import Simulation

    if options.accuracy:
        raise SceneError(scene.source, ["--accuracy needs molecules with Ewald sums"])
    if options.unit is not None:
        raise SceneError(scene.source, [f"--unit {options.unit} is for molecules; the energy of a body is in J"])
    found = Simulation(scene).start_energy()
    if options.json:
        print(json.dumps(found, indent=2))
        return 0
    print(f"{scene.name}: energy of the start")
    for name in ("kinetic", "potential", "energy"):
        print(f"  {name:<22}{found[name]:>22.15g} J")
    for key, name, unit in (("force_N", "force (lab)", "N"), ("torque_body_N_m", "torque (body)", "N m")):
        if found[key] is not None:
            print(f"  {name:<22}{' '.join(f'{x:>22.15g}' for x in found[key])} {unit}")
    return 0


def _check(options: argparse.Namespace) -> int:
    from rigidmd.assemble.describe import describe
    from rigidmd.run.pilot.stable_step import long_steps
    from rigidmd.scene import BodyScene, MolecularScene

    scene = _read_scene(options)
    print(describe(scene))
    if isinstance(scene, MolecularScene) and scene.engine.is_other:
        from rigidmd.assemble.build import build
        from rigidmd.engines.external import refuse

        refuse(build(scene))
    for warning in [] if isinstance(scene, BodyScene) else long_steps(scene):
        warn(warning)
    return 0


def _precision(options: argparse.Namespace) -> int:
    from tqdm import tqdm

    from rigidmd.errors import SceneError
    from rigidmd.io.folder import check_folder, make_folder
    from rigidmd.studies.accuracy.accuracy import precision
    from rigidmd.studies.accuracy.report import FILES, advice, table_text, write_precision

    scene = _read_scene(options)
    folder = Path(options.output) if options.output else Path("runs") / f"{scene.name}-precision"
    check_folder(folder, options.force, names=FILES)
    integrators = options.integrators.split(",") if options.integrators else None
    try:
        timesteps = [float(text) for text in options.timesteps.split(",")] if options.timesteps else None
    except ValueError:
        raise SceneError("--timesteps", [f"{options.timesteps!r} is not a list of numbers such as 1,2,4"]) from None
    if options.averages == inf:
        return _averages(options, scene, folder, integrators, timesteps)
    if options.sample_ps is not None:
        raise SceneError("--sample-ps", ["it goes with --averages that has no PS of its own"])
    with tqdm(total=1.0, disable=None, leave=False, bar_format="{l_bar}{bar}| [{elapsed}<{remaining}]") as bar:
        told = _progress(bar, "compiling and running the reference")
        found = precision(scene, integrators, timesteps, options.span, options.repeats, options.averages, told)
    print(*advice(found), "", table_text(found), sep="\n")
    make_folder(folder, options.force, FILES)
    written = write_precision(folder, found, shlex.join(["rigidmd", *sys.argv[1:]]))
    print(f"\n  files in {folder}: {', '.join(path.name for path in written)}")
    return 0


def _progress(bar, begins: str) -> Callable[[float], None]:
    """A callback that moves a bar; at 0, when all arguments are known to be good, it reports what begins."""

    def progress(share: float) -> None:
        if share == 0:
            bar.clear()
            say(begins)
        bar.update(share - bar.n)

    return progress


def _averages(
    options: argparse.Namespace, scene, folder: Path, methods: list[str] | None, timesteps: list[float] | None
) -> int:
    """`precision --averages`."""
    from tqdm import tqdm

    from rigidmd.io.folder import check_folder, make_folder
    from rigidmd.studies.accuracy.averages import SAMPLE_PS, averages
    from rigidmd.studies.accuracy.averages_report import FILES, advice, table_text, write_averages

    check_folder(folder, options.force, names=FILES)
    sample = SAMPLE_PS if options.sample_ps is None else options.sample_ps
    with tqdm(total=1.0, disable=None, leave=False, bar_format="{l_bar}{bar}| [{elapsed}<{remaining}]") as bar:
        told = _progress(bar, "compiling, and running what comes before the last stage")
        found = averages(scene, methods, timesteps, sample, told)
    print(table_text(found), "", *advice(found), sep="\n")
    make_folder(folder, options.force, FILES)
    written = write_averages(folder, found, shlex.join(["rigidmd", *sys.argv[1:]]))
    print(f"\n  files in {folder}: {', '.join(path.name for path in written)}")
    return 0


def _stability(options: argparse.Namespace) -> int:
    import platform

    from tqdm import tqdm

    from rigidmd.io.folder import check_folder, make_folder
    from rigidmd.studies.stability.battery import battery, chosen
    from rigidmd.studies.stability.report import FILES, failed, table_text, words, write_stability

    folder = Path(options.output) if options.output else Path("runs") / "stability"
    check_folder(folder, options.force, names=FILES)
    total = len(chosen(options.case))
    with tqdm(total=total, disable=None, leave=False, bar_format="{l_bar}{bar}| {desc} [{elapsed}]") as bar:
        findings = []
        for finding in battery(options.case, options.quick, bar.set_description_str):
            findings.append(finding)
            bar.update()
    print(table_text(findings), "", *words(findings), sep="\n")
    make_folder(folder, options.force, FILES)
    machine = platform.processor() or platform.machine()
    written = write_stability(folder, findings, shlex.join(["rigidmd", *sys.argv[1:]]), machine)
    print(f"\n  files in {folder}: {', '.join(path.name for path in written)}")
    return FAILED if failed(findings) else 0


def _models(options: argparse.Namespace) -> int:
    from rigidmd.errors import MoleculeError
    from rigidmd.scene.models import available_models, load_model, read_molecule
    from rigidmd.view.molecule_text import models_table, molecule_text

    if options.geometry is not None:
        return _own_model(options)
    if options.parameters is not None or options.own_name is not None:
        given = "--parameters" if options.parameters is not None else "--name"
        raise MoleculeError("models", [f"{given} belongs to --from FILE, which writes a model of your own"])
    draws = options.draw or options.output is not None
    if options.model is None:
        if draws:
            raise MoleculeError("models", ["--draw and -o need the NAME of a model"])
        print(models_table([load_model(name) for name in available_models()]))
        print("\n`rigidmd models NAME` shows one in full; --draw draws it")
        return 0
    own = options.model.endswith(".toml")
    found = read_molecule(Path(options.model)) if own else load_model(options.model)
    if not draws:
        print(molecule_text(found))
        return 0
    from rigidmd.view.molecule_figure import draw_molecule

    path = Path(options.output or f"{Path(options.model).stem}.png")
    draw_molecule(path, found, options.force)
    print(f"{found.name} is drawn in {path}")
    return 0


def _own_model(options: argparse.Namespace) -> int:
    """`models --from`."""
    from rigidmd.assemble.model_from_geometry import own_model
    from rigidmd.errors import MoleculeError
    from rigidmd.io.model_file import write_model
    from rigidmd.io.write import check_target

    if options.model is not None:
        faults = [f"--from writes a model of your own: leave out {options.model}, or name the model by --name"]
        raise MoleculeError("models", faults)
    geometry, parameters = Path(options.geometry), Path(options.parameters) if options.parameters else None
    path = Path(options.output or f"{geometry.stem}.toml")
    if options.draw:
        raise MoleculeError("models", [f"--from writes a model; draw it afterwards: rigidmd models {path} --draw"])
    made = own_model(geometry, parameters, options.own_name)
    check_target(path, (".toml",), options.force, "model", [geometry, *([parameters] if parameters else [])])
    write_model(path, made.file)
    print(f"{path}: {made.molecule.name}, {made.molecule.words}; {made.file.source}")
    for note in made.notes:
        warn(note)
    print("next:")
    print(f"  rigidmd models {shlex.quote(str(path))}    shows it; --draw draws it")
    print(f'a scene takes it by a line of its [[molecules]]: file = "{path.name}"')
    return 0


def _schema(options: argparse.Namespace) -> int:
    from rigidmd.scene import schema

    print(json.dumps(schema(), indent=2, allow_nan=False))
    return 0


def _help(options: argparse.Namespace) -> int:
    from rigidmd.scene.shipped import chapter_text, contents

    if options.chapter is not None:
        print(chapter_text(options.chapter))
        return 0
    found = contents()
    width = max(map(len, found))
    print("chapters (`rigidmd help CHAPTER` prints one; `rigidmd COMMAND --help` tells of a command):")
    for name, about in found.items():
        print(f"  {name:<{width}}  {about}")
    return 0
