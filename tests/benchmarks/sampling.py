"""What an average costs: total error against computing time, for methods of rigidmd, GROMACS and
OpenMM.

    python tests/benchmarks/sampling.py --to runs/sampling --rounds 4
    python tests/benchmarks/sampling.py --to runs/sampling --collect

512 SPC/E waters at 298.15 K; cutoff 9 Å, Lennard-Jones switched over the last Å with tail
corrections, PME. All engines have the same forces, one thread, and otherwise the settings that
their users have: the step, the integrator and the coupling differ. Averages: U, the height of the
first peak of g(r) of oxygens and D at 0.997 g/cm³, and the density at 1 bar.

Many short runs (6 ps to relax, 48 ps sampled) from a few starts, in rounds of all methods and
steps; a step of 1 fs in one round of four. Each leaves a small file, so that the command continues
where it was stopped, and several of them share the work: `--next N` does N runs and fails if none
is left. Then sampling.json and sampling.png are written next to them: of each average,

- the bias of a method at a step: its mean less the limit of all engines and methods at a step of
  zero, one weighted fit linear in dt² (`extrapolate`);
- the variance of a mean over 1 ns: from the scatter of blocks of 6 ps (for D of 24 ps) about the
  mean of their run, one for Langevin dynamics and one for thermostats of the whole system; those of
  single methods are printed;
- the cost: seconds of a processor (user and system) per ns, a median over runs. It barely depends
  on what else runs.

The total error after a time t is sqrt(bias² + variance / t); of the square of a bias that of its
error is taken off.
"""

import json
import resource
import sys
import tempfile
import time
from collections.abc import Sequence
from functools import cache
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from command_line import SMOKE, choice, new_parser, numbers, read_options
from matplotlib.figure import Figure
from peer_engines import (
    ENGINES,
    Absent,
    Failed,
    call,
    gro,
    openmm_system,
    program,
    sites_of,
    top,
)
from scipy.spatial import cKDTree

sys.path.insert(0, str(Path(__file__).parents[1]))
from rigidmd import Every, Scene, Simulation
from rigidmd.errors import RigidMDError
from rigidmd.features.studies.extrapolation import MeanAtStep, extrapolate
from rigidmd.features.view.figures.style import FAINT, INK, PALETTE
from rigidmd.units import BOLTZMANN, KJ_PER_MOL

COUNT = 343 if SMOKE else 512
TEMPERATURE, DENSITY, CUTOFF, SWITCH = 298.15, 0.997, 9.0, 1.0  # K, g/cm³, Å
#: Time between frames in ps; frames to relax, and all of a run.
EVERY, RELAXED, FRAMES = (0.024, 2, 18) if SMOKE else (0.12, 50, 450)
START_STEPS = 50 if SMOKE else 6000  # of 2 fs, from one start to the next
NS = (FRAMES - RELAXED) * EVERY * 1e-3  # sampled by a run
STARTS, BLOCKS = 4, 8  # blocks of a run, whose scatter is that of its average; two for D
PEAK = (2.70, 2.80)  # Å, the shell around the first maximum of g(r) in which its height is averaged
LAGS = (
    (0.05, 0.15) if SMOKE else (2.0, 8.0)
)  # ps between which the mean square displacement is taken as a straight line
KT_PER_FREEDOM = 6 * BOLTZMANN * TEMPERATURE / KJ_PER_MOL  # of a molecule, kJ/mol
RARE = 1.0  # fs: this step is run in one of four rounds only


class Quantity(NamedTuple):
    title: str
    unit: str
    scale: float  # of errors; 0: the limit
    ensemble: str
    targets: tuple[float, float]  # of the total error, in the unit of errors
    error_unit: str


QUANTITIES = {
    "U": Quantity(
        "potential energy",
        "kJ/mol",
        KT_PER_FREEDOM,
        "nvt",
        (0.01, 0.005),
        "kT per degree of freedom",
    ),
    "density": Quantity("density at 1 bar", "g/cm³", 0.0, "npt", (0.002, 0.001), "fraction"),
    "peak": Quantity("first peak of g(r)", "", 1.0, "nvt", (0.02, 0.005), "of 3.0"),
    "D": Quantity("diffusion coefficient", "1e-5 cm²/s", 0.0, "nvt", (0.05, 0.02), "fraction"),
}


class Method(NamedTuple):
    engine: str
    color: str
    steps: tuple[float, ...]  # fs
    dense: tuple[float, ...]  # fs, with a barostat
    options: dict  # of the stage, or of the .mdp file
    motion: bool = True  # whether it keeps the motion that D belongs to


RESCALING, LANGEVIN, HYBRID = (
    {"thermostat": t} for t in ("velocity_rescaling", "langevin", "hybrid_monte_carlo")
)
METHODS = {
    "velocity_verlet + velocity_rescaling": Method(
        "rigidmd",
        PALETTE["cool"],
        (1, 2, 4, 6, 8),
        (2, 4),
        RESCALING | {"integrator": "velocity_verlet"},
    ),
    "velocity_verlet + nose_hoover": Method(
        "rigidmd",
        PALETTE["cyan"],
        (4, 8),
        (),
        {"integrator": "velocity_verlet", "thermostat": "nose_hoover"},
    ),
    "baoab + velocity_rescaling": Method(
        "rigidmd", PALETTE["navy"], (2, 4, 8), (4, 8), RESCALING | {"integrator": "baoab"}
    ),
    "baoab + langevin": Method(
        "rigidmd", PALETTE["amber"], (2, 4, 8), (4, 8), LANGEVIN | {"integrator": "baoab"}, False
    ),
    "srkn_4 + velocity_rescaling": Method(
        "rigidmd", PALETTE["violet"], (8,), (), RESCALING | {"integrator": "srkn_4"}
    ),
    "velocity_verlet + hybrid_monte_carlo": Method(
        "rigidmd", PALETTE["green"], (2, 4), (), HYBRID | {"integrator": "velocity_verlet"}, False
    ),
    "two_stage + hybrid_monte_carlo": Method(
        "rigidmd", INK, (4, 8), (4,), HYBRID | {"integrator": "two_stage"}, False
    ),
    "GROMACS md + v-rescale": Method(
        "gromacs",
        PALETTE["warm"],
        (1, 2, 4, 8),
        (2, 4),
        {
            "integrator": "md",
            "tcoupl": "v-rescale",
            "tc-grps": "system",
            "tau-t": 0.1,
            "ref-t": TEMPERATURE,
        },
    ),
    "GROMACS sd": Method(
        "gromacs",
        FAINT,
        (2, 4, 8),
        (),
        {"integrator": "sd", "tc-grps": "system", "tau-t": 1.0, "ref-t": TEMPERATURE},
        False,
    ),
    "OpenMM LangevinMiddle": Method("openmm", "black", (1, 2, 4, 8), (4,), {}, False),
}


class Run(NamedTuple):
    ensemble: str
    method: str
    step: float  # fs
    round: int

    def file(self, folder: Path) -> Path:
        name = self.method.replace(" + ", "+").replace(" ", "-")
        return folder / f"{self.ensemble}-{name}-{self.step:g}fs-{self.round}.json"


ENSEMBLES = ("nvt", "npt")


def runs(
    rounds: int,
    methods: Sequence[str] = tuple(METHODS),
    ensembles: Sequence[str] = ENSEMBLES,
    chosen: Sequence[float] | None = None,
) -> list[Run]:
    """All runs, round by round, of the engines that are installed; chosen : steps, all by default"""
    found = []
    for number, ensemble in product(range(rounds), ensembles):
        for name in methods:
            method = METHODS[name]
            if method.engine not in installed():
                continue
            steps = method.steps if ensemble == "nvt" else method.dense
            steps = steps[:2] if SMOKE else steps
            found += [
                Run(ensemble, name, step, number)
                for step in steps
                if (step > RARE or number % STARTS == 0) and (chosen is None or step in chosen)
            ]
    return found


@cache
def installed() -> dict[str, str]:
    """The engines that are installed, with their versions; the others are printed."""
    found = {}
    for name in dict.fromkeys(method.engine for method in METHODS.values()):
        try:
            found[name] = ENGINES[name].version()
        except Absent as error:
            print(f"{name} is skipped: {error}")
    return found


def scene(stage: dict, seed: int = 1, start: bool = True) -> dict:
    """The liquid with one stage, in the folder of its start."""
    return {
        "box": None if start else {"density_g_cm3": DENSITY},
        "structure": {"file": "start.npz"} if start else None,
        "molecules": [{"model": "spce", "count": COUNT}],
        "forces": {
            "cutoff_A": CUTOFF,
            "truncation": "switch",
            "switch_start_A": CUTOFF - SWITCH,
            "electrostatics": "pme",
            "ewald_cutoff_A": CUTOFF,
            "ewald_truncation": "plain",
        },
        "precision": "mixed",
        "threads": 1,
        "seed": seed,
        "start": {"temperature_K": TEMPERATURE},
        "stages": [{"temperature_K": TEMPERATURE} | stage],
        "output": {"trajectory": False, "figures": False, "log_interval_ps": EVERY},
    }


def simulate(data: dict, folder: Path, **options) -> Simulation:
    whole = {key: value for key, value in data.items() if value is not None}
    return Simulation(Scene.from_dict(whole, folder), warn=lambda warning: None, **options)


def make_starts(folder: Path) -> None:
    """STARTS states of the liquid, 12 ps from each other, in folder/start0, start1, ...: start.npz of
    rigidmd, sites.npz of all sites."""
    from peers import WORKLOADS, write_start

    stage = {"ensemble": "nvt", "integrator": "baoab", "thermostat": "langevin", "timestep_fs": 2.0}
    simulation = simulate(
        scene(stage | {"duration_ps": 0.002 * START_STEPS * (1 + STARTS)}, start=False), folder
    )
    for k in range(-1, STARTS):
        simulation.step(START_STEPS)
        if k >= 0:
            state, system = simulation.state, simulation.system
            (folder / f"start{k}").mkdir(exist_ok=True)
            write_start(
                folder / f"start{k}",
                WORKLOADS["W2"],
                state.position,
                state.velocity,
                state.rotation,
                state.angular_momentum_body,
                state.cell[0, 0],
            )
            np.savez(folder / f"start{k}" / "sites.npz", **sites_of(system, state))


# Each engine: the series (FRAMES + 1) of U in kJ/mol and density in g/cm³, positions (FRAMES + 1,
# COUNT, 3) of oxygens and edges of the box in Å, and seconds of a processor per ns


def run_rigidmd(run: Run, folder: Path, start: Path) -> tuple:
    frames, clock = [], []

    def look(moment):
        clock.append(time.process_time())
        frames.append(np.array(moment.site_positions[::3]))

    stage = METHODS[run.method].options | {"ensemble": run.ensemble, "timestep_fs": run.step}
    if stage["thermostat"] == "hybrid_monte_carlo":
        stage |= {"trajectory_steps": round(1000 * EVERY / run.step)}
    stage |= {"duration_ps": FRAMES * EVERY} | (
        {"pressure_bar": 1.0} if run.ensemble == "npt" else {}
    )
    simulation = simulate(scene(stage, 1 + run.round), start, observers=Every(EVERY, look))
    results = simulation.run(progress=False)
    edges = (COUNT * simulation.system.species[0].mass / 0.602214076 / results["density"]) ** (
        1 / 3
    )
    cost = (clock[-1] - clock[RELAXED]) / NS
    return results["potential"], results["density"], np.array(frames), edges, cost


def run_gromacs(run: Run, folder: Path, start: Path) -> tuple:
    from MDAnalysis.coordinates.XTC import XTCReader

    sites = dict(np.load(start / "sites.npz"))
    every = round(1000 * EVERY / run.step)
    options = {
        "dt": run.step * 1e-3,
        "nsteps": FRAMES * every,
        "gen-vel": "yes",
        "gen-temp": TEMPERATURE,
        "gen-seed": 1 + run.round,
        "ld-seed": 1 + run.round,
        "rvdw": CUTOFF / 10,
        "rcoulomb": CUTOFF / 10,
        "vdw-modifier": "potential-switch",
        "rvdw-switch": (CUTOFF - SWITCH) / 10,
        "DispCorr": "AllEnerPres",
        "coulombtype": "PME",
        "coulomb-modifier": "none",
        "nstenergy": every,
        "nstcalcenergy": every,
        "nstlog": 0,
        "nstxout-compressed": every,
        "compressed-x-precision": 10000,
    } | METHODS[run.method].options
    if run.ensemble == "npt":
        options |= {"pcoupl": "C-rescale", "tau-p": 1.0, "ref-p": 1.0, "compressibility": 4.5e-5}
    (folder / "run.mdp").write_text("".join(f"{key} = {value}\n" for key, value in options.items()))
    (folder / "run.gro").write_text(gro(sites, np.zeros_like(sites["position"])))
    (folder / "run.top").write_text(top(sites))
    gmx = [program("gmx"), "-quiet", "-nobackup"]
    call(
        [
            *gmx,
            "grompp",
            "-f",
            "run.mdp",
            "-c",
            "run.gro",
            "-p",
            "run.top",
            "-o",
            "run.tpr",
            "-maxwarn",
            1,
        ],
        folder,
    )
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    call(
        [*gmx, "mdrun", "-deffnm", "run", "-notunepme", "-noconfout", "-ntmpi", 1, "-ntomp", 1],
        folder,
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cost = (after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime) / (
        FRAMES * EVERY * 1e-3
    )
    wanted = "Potential\n" + ("Density\n" if run.ensemble == "npt" else "") + "\n"
    call([*gmx, "energy", "-f", "run.edr", "-o", "run.xvg", "-dp"], folder, wanted)
    lines = [
        line.split()
        for line in (folder / "run.xvg").read_text().splitlines()
        if line[0] not in "#@"
    ]
    table = np.array(lines, float)
    density = 1e-3 * table[:, 2] if run.ensemble == "npt" else np.full(len(table), DENSITY)
    with XTCReader(str(folder / "run.xtc")) as trajectory:
        seen = [
            (frame.positions[::3].astype(float), float(frame.dimensions[0])) for frame in trajectory
        ]
    return (
        table[:, 1],
        density,
        np.array([at for at, _ in seen]),
        np.array([edge for _, edge in seen]),
        cost,
    )


def run_openmm(run: Run, folder: Path, start: Path) -> tuple:
    import openmm

    sites = dict(np.load(start / "sites.npz"))
    system, force = openmm_system(sites, CUTOFF / 10, switch=SWITCH)
    force.setNonbondedMethod(openmm.NonbondedForce.PME)
    if run.ensemble == "npt":
        barostat = openmm.MonteCarloBarostat(1.0, TEMPERATURE)
        barostat.setRandomNumberSeed(1 + run.round)
        system.addForce(barostat)
    integrator = openmm.LangevinMiddleIntegrator(TEMPERATURE, 1.0, run.step * 1e-3)
    integrator.setRandomNumberSeed(1 + run.round)
    platform = openmm.Platform.getPlatformByName("CPU")
    context = openmm.Context(system, integrator, platform, {"Threads": "1"})
    context.setPositions(sites["position"].reshape(-1, 3) / 10)
    context.setVelocitiesToTemperature(TEMPERATURE, 1 + run.round)
    mass, rows, frames = sites["mass"].sum() * COUNT / 602.214076, [], []
    for frame in range(FRAMES + 1):
        if frame == RELAXED:
            began = time.process_time()
        state = context.getState(getEnergy=True, getPositions=True)
        volume = state.getPeriodicBoxVolume()._value
        rows.append((state.getPotentialEnergy()._value, mass / volume, 10 * volume ** (1 / 3)))
        frames.append(10 * state.getPositions(asNumpy=True)._value[::3])
        if frame < FRAMES:
            try:
                integrator.step(round(1000 * EVERY / run.step))
            except openmm.OpenMMException as error:
                raise Failed(str(error)) from None
    cost = (time.process_time() - began) / NS
    energy, density, edges = np.array(rows).T
    return energy, density, np.array(frames), edges, cost


def peak_height(frames: np.ndarray, edges: np.ndarray) -> float:
    """g(r) of oxygens in the shell PEAK."""
    shell = 4 / 3 * np.pi * (PEAK[1] ** 3 - PEAK[0] ** 3)
    found = []
    for at, edge in zip(frames, edges, strict=True):
        tree = cKDTree(np.mod(at, edge) % edge, boxsize=edge)
        pairs = np.diff(tree.count_neighbors(tree, PEAK))[0]
        found.append(pairs * edge**3 / (COUNT * (COUNT - 1) * shell))
    return float(np.mean(found))


def diffusion(frames: np.ndarray, edge: float) -> float:
    """D in 1e-5 cm²/s from the slope of the mean square displacement of oxygens, less that of their
    mean."""
    moves = np.diff(frames, axis=0)
    path = np.cumsum(moves - edge * np.round(moves / edge), axis=0)
    path -= path.mean(axis=1, keepdims=True)
    lags = np.arange(round(LAGS[0] / EVERY), round(LAGS[1] / EVERY) + 1, 3)
    squares = [np.mean(np.sum((path[lag:] - path[:-lag]) ** 2, axis=2)) for lag in lags]
    return float(np.polyfit(lags * EVERY, squares, 1)[0] / 6 * 10)


def do(run: Run, folder: Path) -> None:
    """One run; its averages and cost, or why it failed, into its file."""
    engine = METHODS[run.method].engine
    with tempfile.TemporaryDirectory() as scratch:
        try:
            function = {"rigidmd": run_rigidmd, "gromacs": run_gromacs, "openmm": run_openmm}[
                engine
            ]
            energy, density, frames, edges, cost = function(
                run, Path(scratch), folder / f"start{run.round % STARTS}"
            )
        except (Failed, RigidMDError) as error:
            if SMOKE:
                raise
            run.file(folder).write_text(json.dumps({"failure": str(error)[:300]}) + "\n")
            return
    blocks = np.split(np.arange(RELAXED + 1, FRAMES + 1), BLOCKS)
    halves = np.split(np.arange(RELAXED + 1, FRAMES + 1), 2)
    found = {
        "cost_s_per_ns": cost,
        "U": [float(np.mean(energy[block])) / COUNT for block in blocks],
    }
    if run.ensemble == "npt":
        found["density"] = [float(np.mean(density[block])) for block in blocks]
    else:
        found["peak"] = [peak_height(frames[block], edges[block]) for block in blocks]
        found["D"] = [diffusion(frames[half], edges[-1]) for half in halves]
    run.file(folder).write_text(json.dumps(found) + "\n")


def do_next(folder: Path, wanted: list[Run]) -> bool:
    """The next run that no one has begun; False if there is none."""
    for run in wanted:
        claim = run.file(folder).with_suffix(".begun")
        if run.file(folder).exists():
            continue
        try:
            claim.touch(exist_ok=False)
        except FileExistsError:
            continue
        try:
            do(run, folder)
        finally:
            claim.unlink()
        print(
            f"{time.strftime('%H:%M:%S')} {run.file(folder).stem}: {run.file(folder).read_text()}",
            end="",
            flush=True,
        )
        return True
    return False


class Point(NamedTuple):
    """An average by a method at a step; biases and errors are in units of the quantity's scale."""

    method: str
    step: float
    count: int  # of runs
    mean: float
    error: float  # of the mean, in its own unit
    bias: float
    bias_error: float
    cost: float  # s per ns
    spread: float  # of the mean over 1 ns, statistical

    def total_error(self, seconds):
        return np.sqrt(
            max(0.0, self.bias**2 - self.bias_error**2) + self.spread**2 * self.cost / seconds
        )

    def seconds_to(self, target: float) -> float:
        """Computing time to a total error; infinite where the bias exceeds it."""
        left = target**2 - max(0.0, self.bias**2 - self.bias_error**2)
        return self.spread**2 * self.cost / left if left > 0 else np.inf


def read(folder: Path) -> dict[tuple[str, str, float], list[dict]]:
    """The runs that are there, by ensemble, method and step; none of a step at which one failed."""
    found, failed = {}, set()
    for run in runs(99):
        if run.file(folder).exists():
            result = json.loads(run.file(folder).read_text())
            if "failure" in result:
                print(f"{run.file(folder).stem} failed: {result['failure']}")
                failed.add(run[:3])
            else:
                found.setdefault((run.ensemble, run.method, run.step), []).append(result)
    return {key: results for key, results in found.items() if key not in failed}


def analyse(name: str, found: dict) -> dict:
    """For a quantity its limit, the values of the engines alone, variances of methods over that of all,
    and points."""
    quantity = QUANTITIES[name]
    values = {
        (method, step): [np.ravel(result[name]) for result in results]
        for (ensemble, method, step), results in found.items()
        if ensemble == quantity.ensemble and (name != "D" or METHODS[method].motion)
    }
    squares, freedom = {}, {}  # of blocks about the mean of their run, by method
    for (method, _), blocks in values.items():
        squares[method] = squares.get(method, 0.0) + sum(float(x.size * x.var()) for x in blocks)
        freedom[method] = freedom.get(method, 0) + sum(x.size - 1 for x in blocks)
    pooled = sum(squares.values()) / sum(freedom.values())
    per_run = {}  # variance of a run's average: one for Langevin dynamics, one for thermostats of the whole
    for motion in {METHODS[method].motion for method in squares}:
        alike = [method for method in squares if METHODS[method].motion == motion]
        variance = sum(squares[method] for method in alike) / sum(
            freedom[method] for method in alike
        )
        per_run |= dict.fromkeys(alike, variance / (2 if name == "D" else BLOCKS))
    means = {
        key: MeanAtStep(
            *key,
            float(np.mean([x.mean() for x in blocks])),
            float(np.sqrt(per_run[key[0]] / len(blocks))),
        )
        for key, blocks in values.items()
    }
    fit = extrapolate(list(means.values()))
    scale = quantity.scale or fit.limit
    engines = {}
    for engine in dict.fromkeys(METHODS[method].engine for method, _ in values):
        some = [
            m
            for m in means.values()
            if METHODS[m.method].engine == engine and m.timestep <= fit.longest
        ]
        engines[engine] = list(extrapolate(some)[:2])
    points = []
    for (method, step), mean in means.items():
        costs = [result["cost_s_per_ns"] for result in found[quantity.ensemble, method, step]]
        bias, error = (x / scale for x in fit.bias(mean))
        spread = float(np.sqrt(per_run[method] * NS)) / scale
        points.append(
            Point(
                method,
                step,
                len(costs),
                mean.mean,
                mean.error,
                bias,
                error,
                float(np.median(costs)),
                spread,
            )
        )
    ratios = {
        m: [squares[m] / freedom[m] / pooled, float(np.sqrt(2 / freedom[m]))]
        for m in squares
        if freedom[m]
    }
    return {
        "limit": [fit.limit, fit.limit_error],
        "longest_step_fs": fit.longest,
        "limits_of_engines": engines,
        "variances_over_that_of_all": ratios,
        "points": points,
    }


def cell(points: list[Point], target: float) -> str:
    """The shortest time to a total error and its step; with ? where two errors more of the bias
    would exceed the target."""
    best = min(points, key=lambda point: point.seconds_to(target))
    needed = best.seconds_to(target)
    if needed == np.inf:
        return "not reached"
    unsure = " ?" if abs(best.bias) + 2 * best.bias_error > target else ""
    return (
        f"{needed:.2g} ({best.step:g} fs{unsure})"
        if needed < 99.5
        else f"{needed:.0f} ({best.step:g} fs{unsure})"
    )


def print_tables(result: dict) -> None:
    for name, one in result.items():
        quantity = QUANTITIES[name]
        print(
            f"\n{quantity.title}: limit {one['limit'][0]:.5g} ± {one['limit'][1]:.2g} {quantity.unit}, steps up to "
            f"{one['longest_step_fs']:g} fs"
        )
        for engine, (limit, error) in one["limits_of_engines"].items():
            print(f"  {engine} alone: {limit:.5g} ± {error:.2g}")
        for method, (ratio, error) in one["variances_over_that_of_all"].items():
            print(f"  variance of {method} over that of all: {ratio:.2f} ± {error:.2f}")
        goals = " | ".join(f"s to {target:g} (step)" for target in quantity.targets)
        print(
            f"| method | bias at each step, {quantity.error_unit} | s/ns | {goals} |\n|---|---|---|---|---|"
        )
        for method in METHODS:
            points = [point for point in one["points"] if point.method == method]
            if points:
                biases = ", ".join(
                    f"{p.step:g} fs: {p.bias:+.4f} ± {p.bias_error:.4f}" for p in points
                )
                costs = ", ".join(f"{p.cost:.0f}" for p in points)
                cells = [cell(points, target) for target in quantity.targets]
                print(f"| {method} | {biases} | {costs} | {' | '.join(cells)} |")


def draw(result: dict, path: Path) -> None:
    """Total error against computing time: of each method, at each time, with its best step."""
    figure = Figure(figsize=(4.5 * len(result), 4.8), layout="constrained")
    for axis, (name, one) in zip(
        figure.subplots(1, len(result), squeeze=False).flat, result.items(), strict=True
    ):
        quantity = QUANTITIES[name]
        times = np.geomspace(1, 1e4, 200)
        for method, look in METHODS.items():
            points = [point for point in one["points"] if point.method == method]
            if points:
                errors = np.array([point.total_error(times) for point in points])
                best = errors.argmin(axis=0)
                unknown = np.array([point.bias_error for point in points])[best]
                error = errors.min(axis=0)
                axis.plot(times, error, ":", color=look.color, lw=1.2)
                axis.plot(
                    times,
                    np.where(error >= 2 * unknown, error, np.nan),
                    color=look.color,
                    lw=1.8,
                    label=method,
                )
        for target in quantity.targets:
            axis.axhline(target, color=FAINT, lw=0.8, zorder=0)
        axis.set(
            xscale="log",
            yscale="log",
            xlim=(times[0], times[-1]),
            ylim=(quantity.targets[1] / 5, None),
            title=quantity.title,
            xlabel="computing time on one core, s",
            ylabel=f"total error, {quantity.error_unit}",
        )
        axis.title.set_color(INK)
        axis.spines[["top", "right"]].set_visible(False)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    figure.savefig(path, dpi=120)


def main() -> None:
    parser = new_parser(__doc__)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument(
        "--methods", type=choice(METHODS), default=list(METHODS), help=f"of {', '.join(METHODS)}"
    )
    parser.add_argument(
        "--ensembles", type=choice(ENSEMBLES), default=list(ENSEMBLES), help="nvt,npt"
    )
    parser.add_argument("--steps", type=numbers(float), help="of those of each method, fs; all")
    parser.add_argument(
        "--next", type=int, metavar="N", help="do N runs; exit status 1 if none is left"
    )
    parser.add_argument("--collect", action="store_true", help="run nothing")
    options = read_options(parser, Path("runs/sampling"), rounds=1)
    folder = options.to
    if not options.collect and not (folder / f"start{STARTS - 1}" / "sites.npz").exists():
        make_starts(folder)
    wanted = runs(options.rounds, options.methods, options.ensembles, options.steps)
    if options.next:
        sys.exit(0 if any([do_next(folder, wanted) for _ in range(options.next)]) else 1)
    while not options.collect and do_next(folder, wanted):
        pass
    found = read(folder)
    there = {ensemble for ensemble, _, _ in found}
    result = {
        name: analyse(name, found)
        for name, quantity in QUANTITIES.items()
        if quantity.ensemble in there
    }
    print_tables(result)
    tables = {
        name: one | {"points": [p._asdict() for p in one["points"]]} for name, one in result.items()
    }
    every = [
        {"ensemble": e, "method": m, "step_fs": s, "runs": results}
        for (e, m, s), results in found.items()
    ]
    whole = {"versions": list(installed().values()), **tables, "all": every}
    (folder / "sampling.json").write_text(json.dumps(whole, indent=1) + "\n")
    draw(result, folder / "sampling.png")


if __name__ == "__main__":
    main()
