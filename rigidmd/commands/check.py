"""`rigidmd check`."""

import sys
from typing import TYPE_CHECKING, cast

from rigidmd.commands import FAILED
from rigidmd.commands.arguments import SCENE, Options, add_engine, command, flag, read_scene
from rigidmd.commands.streams import warn
from rigidmd.errors import SceneError

if TYPE_CHECKING:
    from rigidmd.engines.system import System
    from rigidmd.scene import MolecularScene


@command(
    "Run",
    10,
    "describe a run without running it. Exit code 1 if a time step is unstable",
    "rigidmd check water_nitrogen.toml",
    *SCENE,
    add_engine,
    flag(
        "-v",
        "--verbose",
        help="also print what is compiled in, what is omitted, and the reasons",
    ),
    flag("--program", help="also print the compiled passes of a time step, in order"),
    flag(
        "--profile",
        help="also measure the rows of a step from the start, on one thread and on all",
    ),
)
def _check(options: Options) -> int:
    from rigidmd.run.kind import kind_of
    from rigidmd.scene import is_molecular

    scene = read_scene(options)
    kind = kind_of(scene)
    for option in ("program", "profile"):
        if getattr(options, option):
            kind.check_has(scene, f"--{option}")
    system = kind.build(scene)
    print(kind.describe(system, verbose=options.verbose))
    if is_molecular(scene):
        _print_more(options, cast("System", system))
    for warning in (*system.warnings, *kind.step_warnings(system)):
        warn(warning)
    if errors := kind.step_errors(system):
        print(f"rigidmd: error: {SceneError(scene.source, errors)}", file=sys.stderr)
    return FAILED if errors else 0


def _print_more(options: Options, system: "System") -> None:
    """Print what only molecules have: the comparison with another engine, programs, a profile."""
    if program := system.scene.engine.program:
        print(program.feature.load().describe_engine(system))
    if options.program:
        _print_programs(system)
    if options.profile:
        _print_profile(system.scene)


def _print_programs(system: "System") -> None:
    """Print the program of each stage that is not a minimisation."""
    from rigidmd.assemble.build import integrator_of_stage
    from rigidmd.engines.cpu.program import (
        describe_program,
        program_of_forces,
        program_of_step,
    )

    engine = system.engine()
    for k, stage in enumerate(system.scene.stages):
        if stage.is_minimisation or stage.is_auto:
            continue
        scheme = integrator_of_stage(system, k)
        print(f"\nprogram of a step of stages.{k} ({stage.label}, {scheme.name}):")
        print(describe_program(program_of_step(engine, system.state, scheme)))
    print("\nprogram of the forces:")
    print(describe_program(program_of_forces(engine, system.state)))


def _print_profile(scene: "MolecularScene") -> None:
    """Measure and print the rows of the first stage that is not a minimisation."""
    from rigidmd.assemble.build import integrator_of_stage
    from rigidmd.engines.cpu.program import describe_profile, profile_of
    from rigidmd.run import Simulation

    stages = [
        k for k, stage in enumerate(scene.stages) if not stage.is_minimisation and not stage.is_auto
    ]
    if not stages:
        raise SceneError(scene.source, ["--profile needs a stage with a time step"])
    simulation = Simulation(scene)
    if simulation.system.python_forces:
        raise SceneError(
            scene.source, ["--profile measures compiled forces, and Python computes some of these"]
        )
    state = simulation._settle()
    system, stage = simulation.system, simulation.scene.stages[stages[0]]
    scheme = integrator_of_stage(system, stages[0])
    profile = profile_of(system.engine(), state, scheme, stage.step)
    print(f"\ntime of a step of stages.{stages[0]} ({stage.label}) and of its rows:")
    print(describe_profile(profile))
