"""`rigidmd modes`."""

from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

from rigidmd.commands.arguments import (
    SCENE,
    Options,
    argument,
    command,
    flag,
    number,
    output_folder,
    read_scene,
    write_study,
)

if TYPE_CHECKING:
    from rigidmd.features.studies.normal_modes import NormalModes

COUNT = number(int, 1, 10**6, "a number from 1 on")
#: Rows of the table at each end of the spectrum.
ROWS = 8


@command(
    "Study",
    30,
    "compute normal modes of rigid molecules. At a minimum of the energy: frequencies, "
    "infrared intensities, zero-point and free energy, the longest stable step",
    "rigidmd modes water_dimer.toml --animate 10 && rigidmd view runs/water_dimer-modes",
    *SCENE,
    flag("--no-minimise", help="require that the start is a minimum"),
    argument(
        "--count",
        type=COUNT,
        metavar="N",
        help=(
            "compute only the N lowest and N highest modes, by Lanczos (default: all, or 20 if"
            " there are more than 6000)"
        ),
    ),
    flag(
        "--gamma",
        help=(
            "compute only the modes at the Gamma point of the unit cell that structure.repeat"
            " repeats"
        ),
    ),
    argument(
        "--animate",
        type=COUNT,
        metavar="K",
        help="also write mode K as a run, for `view` and `film`",
    ),
    *output_folder("runs/NAME-modes"),
    writes=True,
)
def _modes(options: Options) -> int:
    from rigidmd.features.studies.normal_modes import (
        FILE,
        animation_files,
        normal_modes,
        write_animation,
    )

    scene = read_scene(options)
    begin = perf_counter()
    names = (FILE, *(animation_files(scene) if options.animate else []))

    def write(folder: Path, modes: "NormalModes", command: str) -> None:
        modes.table().write(folder / FILE)
        if options.animate and modes.is_vibration(options.animate):
            write_animation(folder, modes, options.animate)

    def compute(progress: Callable[[float], object]) -> "NormalModes":
        return normal_modes(
            scene,
            minimise=not options.no_minimise,
            count=options.count,
            gamma=options.gamma,
            required=options.animate,
            progress=progress,
        )

    def describe(modes: "NormalModes") -> Iterator[str]:
        yield from _describe(modes)
        if options.animate and not modes.is_vibration(options.animate):
            yield f"  mode {options.animate} is a zero mode, which has no animation"
        yield f"  {perf_counter() - begin:.3g} s"

    folder = Path(options.output or f"runs/{scene.name}-modes")
    write_study(
        folder,
        force=options.force,
        files=names,
        begins="minimising",
        measure=compute,
        describe=lambda modes: list(describe(modes)),
        write=write,
    )
    return 0


def _describe(modes: "NormalModes") -> Iterator[str]:
    table = modes.table()
    at = modes.wavenumber
    total = modes.total
    last = len(modes.rate) - 1
    unstable = at[modes.rate < 0]
    warm = modes.temperature
    is_whole = len(at) == len(modes.coordinates.index)
    point = "a saddle point" if len(unstable) else "a minimum"
    yield (
        f"{modes.system.scene.name}: normal modes at {point} of the energy, {modes.energy:.8g}"
        " kJ/mol"
    )
    why = f" ({modes.ended})" if modes.ended else ""
    yield (
        f"  largest force {modes.force:.1e} kJ/(mol Å), largest torque {modes.torque:.1e}"
        f" kJ/mol{why}"
    )
    if modes.cells:
        yield (
            f"  modes at the Gamma point: equal displacements in all {modes.cells} unit cells,"
            " intensities of one"
        )
    yield (
        f"  {len(at)} of {total} modes: {(modes.rate == 0).sum()} zero modes, {len(unstable)}"
        " unstable modes"
    )
    if len(unstable):
        yield (
            f"  unstable: {', '.join(f'{x:.4g}' for x in unstable)} cm⁻¹. Displace the molecules"
            " and repeat"
        )
    for kind in ("translation", "libration"):
        if len(of := [x for k, x in enumerate(at) if x > 0 and modes.kind(k) == kind]):
            yield f"  {kind}s: {len(of)}, from {of[0]:.4g} to {of[-1]:.4g} cm⁻¹"
    if is_whole:
        yield f"  zero-point energy of the rigid model {modes.free_energy(0):.6g} kJ/mol"
    if is_whole and warm:
        quantum = modes.free_energy(warm)
        classical = modes.free_energy(warm, quantum=False)
        yield (
            f"  free energy of the vibrations at {warm:g} K: {quantum:.6g} kJ/mol, classical"
            f" {classical:.6g} kJ/mol"
        )
    if not modes.cells:  # of the whole crystal other modes may be faster
        _, kind, *_, part, _, where = table.values(last)
        yield (
            f"  longest stable step of velocity Verlet {modes.longest_step_fs:.3g} fs, set by mode"
            f" {total}: {kind} of {part:.3g} molecules, largest in {where}"
        )
    zero = [k for k in table.rows if modes.rate[k] == 0]
    if zero:
        last_zero = f"s {zero[0] + 1} to {zero[-1] + 1}" if len(zero) > 1 else f" {zero[0] + 1}"
        yield f"  zero: mode{last_zero}"
    moving = [k for k in table.rows if k not in zero]
    shown = [*moving[:ROWS], *[k for k in moving[ROWS:] if k > last - ROWS]]
    yield "\n" + table._replace(rows=shown).text()
