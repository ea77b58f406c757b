"""The one door from the tests to the inside of rigidmd, and helpers that several test files use.

A test takes what is public from `rigidmd` itself, and the rest from here: `from support import build, random_rotations`.
Where a name is, HOMES says, below: a module that moves or is renamed changes a line there and no test. A name is
looked up when it is asked for, so that a file which wants little loads little. Names that several modules have are
told apart in RENAMED; modules of which a test patches something are in MODULES.

test_support.py checks that no test file goes past this door but those it lists with a reason.
"""

import os
import shutil
import signal
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np

import rigidmd
from rigidmd import BodyScene, Scene
from rigidmd.analyse.history import History
from rigidmd.assemble.system import System, build
from rigidmd.compile import kernel
from rigidmd.core.schemes import Scheme
from rigidmd.core.state import NO_CELL, NOW, State
from rigidmd.engines.cpu import Engine
from rigidmd.mechanics.rotation import random_rotations
from rigidmd.mechanics.rotor import turn

ROOT = Path(__file__).parent.parent
SYSTEMS = sorted((ROOT / "systems").glob("*.toml"))
BODIES = [path for path in SYSTEMS if isinstance(Scene.read(path), BodyScene)]
MOLECULES = [path for path in SYSTEMS if path not in BODIES]

#: Argon atoms on springs, so far apart that nothing else acts on them: m w² in u/ps², and w dt = 1 at 36 fs.
SPRING = 30_000.0


# a system, its engine, its state


def small_scene(counts: dict[str, int], edge: float | None, folder=".", **sections) -> Scene:
    """A scene of shipped models in a cube (no periodic box if edge is None), two NVE steps."""
    data = {
        "box": {"lengths_A": edge} if edge else {"lengths_A": 15.0, "periodic": False},
        "molecules": [{"model": name, "count": count} for name, count in counts.items()],
        "start": {"temperature_K": 300.0},
        "stages": [{"duration_ps": 0.004}],
    }
    return Scene.from_dict(data | sections, folder)


def system_of(counts, edge=40.0, cutoff=5.0, **sections) -> System:
    """The system of `small_scene`, with a cutoff (Å)."""
    return build(small_scene(counts, edge, **{"forces": {"cutoff_A": cutoff}} | sections))


def shaken(system: System, seed: int, spread: float = 0.4) -> tuple[System, Engine, State]:
    """A system, its engine, and its start with molecules shaken off the lattice and turned anew."""
    rng = np.random.default_rng(seed)
    state = system.state.copy()
    state.position[:] += spread * rng.standard_normal(state.position.shape)
    if len(state.rotation):
        state.rotation[:] = random_rotations(rng, len(state.rotation))
    return system, system.engine(), state


def built(counts, edge, seed=0, spread=0.4, **sections) -> tuple[System, Engine, State]:
    """`shaken` of `small_scene`: system, engine, state."""
    return shaken(build(small_scene(counts, edge, **sections)), seed, spread)


def move(engine: Engine, state: State, scheme: Scheme, dt: float, steps: int) -> None:
    """Take so many more steps, in place."""
    engine.advance(state, scheme, dt, int(state.step[NOW]) + steps)


@kernel(outer=True)
def spin(rotor, rotation, angular_momentum, h: float, steps: int) -> None:
    """Turn the first molecule without torque, in place."""
    for _ in range(steps):
        turn(rotor, 0, rotation, angular_momentum, 0, h)


def springs(**stage) -> Scene:
    """64 argon atoms, each an isotropic oscillator, under Langevin's thermostat at 300 K unless the stage says otherwise."""
    whole = {"ensemble": "nvt", "temperature_K": 300.0, "duration_ps": 20.0, "thermostat": "langevin",
             "friction_translation_per_ps": 15.0} | stage  # fmt: skip
    return small_scene(
        {"argon": 64}, 80.0, forces={"cutoff_A": 8.0}, stages=[{k: v for k, v in whole.items() if v is not None}],
        fields={"restraints": [{"stiffness_kJ_mol_A2": SPRING / 100}]},
        output={"trajectory": False, "figure": False},
    )  # fmt: skip


# runs: other programs, stops


def rigidmd_command(*arguments, **options) -> subprocess.CompletedProcess:
    """The command line, in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "rigidmd", *map(str, arguments)],
        capture_output=True,
        text=True,
        **options,
    )


def gmx(folder: Path, *arguments, text: str = "") -> str:
    """What a command of GROMACS prints; it has to succeed."""
    done = subprocess.run(
        [shutil.which("gmx"), "-quiet", "-nobackup", *arguments],
        cwd=folder, input=text, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-1500:] + done.stderr[-1500:]
    return done.stdout


def stopped_at(steps: set[int]) -> "rigidmd.Every":
    """An observer that sends SIGTERM to this process after some of the steps of a run."""

    def stop(moment):
        if moment.step in steps:
            steps.discard(moment.step)
            os.kill(os.getpid(), signal.SIGTERM)

    return rigidmd.Every(0.001, stop)


def contents(folder: Path) -> dict[str, bytes]:
    """The files of a run that have to be the same to the bit."""
    names = [
        path.name
        for path in folder.iterdir()
        if path.name.startswith(("trajectory", "log", "topology", "motion", "pressure_tensor"))
    ]
    found = {name: (folder / name).read_bytes() for name in names}
    if (folder / "final.npz").exists():
        with np.load(folder / "final.npz") as data:
            found |= {name: data[name].tobytes() for name in data.files}
    return found


def same_after_stops(data: dict, steps: list[int], folder: Path) -> None:
    """Run once without a stop, once with stops after these steps, each time with another number of threads."""
    observers = rigidmd.Every(0.001, lambda moment: None)  # observes at the same steps as those that stop
    rigidmd.Simulation(Scene.from_dict(data | {"threads": 1}), folder / "whole", observers=observers).run()
    left, runs = set(steps), 0
    while True:
        simulation = rigidmd.Simulation(
            Scene.from_dict(data | {"threads": 1 + runs % 2}),
            folder / "parts",
            observers=stopped_at(left),
            resume=True,
        )
        results = simulation.run()
        runs += 1
        if not results.interrupted:
            break
        assert results.signal == signal.SIGTERM
    assert runs == len(steps) + 1
    whole, parts = contents(folder / "whole"), contents(folder / "parts")
    assert whole.keys() == parts.keys() and len(whole) > 3
    assert [name for name in whole if whole[name] != parts[name]] == []


# made-up frames


def history(
    system,
    time,
    positions,
    cell=None,
    Q=None,
    velocities=None,
    L=None,
    tensor=None,
    temperature=300.0,
):
    """Frames as they are given; a cell for all of them, or one for each."""
    f, n = len(time), len(system.model.species)
    cell = NO_CELL if cell is None else np.asarray(cell)
    if positions is None:
        positions = np.zeros((f, n, 3))
    return History(
        system, system.scene.stages[-1], np.asarray(time), np.broadcast_to(cell, (f, 3, 3)), positions,
        np.empty((f, 0, 3, 3)) if Q is None else Q, velocities, L, {"temperature": np.full(f, temperature)}, tensor,
    )  # fmt: skip


def noise_with_memory(rng, frames, shape, variance, time, interval):
    """Ornstein and Uhlenbeck's process: stationary, with a correlation exp(-t/time)."""
    keep = np.exp(-interval / time)
    x = np.sqrt(variance) * rng.standard_normal(shape)
    found = np.empty((frames, *shape))
    for k in range(frames):
        found[k] = x
        x = keep * x + np.sqrt(variance * (1 - keep**2)) * rng.standard_normal(shape)
    return found


# the door


#: Inner module of rigidmd -> the names in it that tests use.
HOMES = {
    "analyse.all": "Task analyse_folder",
    "analyse.correlation": "correlation squared_displacement",
    "analyse.electric": "dielectric total_dipole",
    "analyse.files": "ANALYSIS read_findings",
    "analyse.findings": "Curve Finding Value settled",
    "analyse.flow": "viscosity",
    "analyse.history": "kinds_of rebuilt",
    "analyse.motion": "MPA_S NM2_PER_S diffusion msd",
    "analyse.replicas": "over_replicas",
    "analyse.source": "_evened of_folder steady_from",
    "analyse.structure": "density_profile hydrogen_bonds rdf structure_factor",
    "analyse.turning": "PER_CM orientation spectrum",
    "assemble.atoms": "element_of element_of_mass",
    "assemble.body": "build_body",
    "assemble.cells": "basis_in_words basis_of pairs_within reduced standard_rotation",
    "assemble.describe": "describe",
    "assemble.gsd_format": "GsdReader",
    "assemble.momenta": "draw_momenta mobile remove_momentum",
    "assemble.overlaps": "close_pairs every_site",
    "assemble.room": "array_bytes",
    "assemble.rows": "bath_of box_of",
    "assemble.structure": "read_structure",
    "assemble.structure_files": "read_atoms read_geometry",
    "assemble.to_atoms": "EV",
    "assemble.traj_format": "TrajReader",
    "compile": "SIMD_BITS call call_blocks packed",
    "compile.cache": "COMPILED cache_folder source_digest",
    "compile.lanes": "lane_count",
    "compile.machine": "MOST_THREADS",
    "compile.numba_private": "Index",
    "core.files": "AppendedFile",
    "core.schemes": "DRIFT FORMULATIONS Flow KICK REST SCHEMES Solver WITH_BATH composed split",
    "core.state": "HEAT Load ORIGIN TAKEN WORK no_load state_of",
    "core.state_file": "Saved read_state write_state",
    "core.toml_text": "line_of",
    "dynamics.advance": "Model",
    "dynamics.baths": "Andersen Langevin NoseHoover VelocityRescaling",
    "dynamics.body": "Body",
    "dynamics.boxes": "COMPONENTS COUPLINGS CellRescaling Pressure VolumeMoves box_room",
    "dynamics.noise": "BATCH BATH BOX Key LATTICE MOMENTA chi_square fill_normals key_of normals philox uniforms",
    "dynamics.ramps": "Ramp steady",
    "dynamics.sums": "extent_of sums_over",
    "engines.cpu": "BehindWallError DTYPES NotFiniteError",
    "engines.textbook": "OdeEngine",
    "forces.body.fields": "SteadyForce",
    "forces.laws.coulomb": "radial reaction_field",
    "forces.laws.endings": "Addend Correction NAMES POLYNOMIALS Plain ending",
    "forces.laws.formulas": "FormulaError of_function of_table of_text",
    "forces.laws.lennard_jones": "lennard_jones",
    "forces.laws.own": "OwnOfOneKind tail_of",
    "forces.laws.screened": "INTERVALS TABLE_ERROR TabledScreening force_table screened screening screening_of_lanes",
    "forces.pairs.clusters": "clusters_of",
    "forces.pairs.counts": "count_pairs heights",
    "forces.pairs.lists": (
        "AHEAD BUILDS BUILT ENTRIES IMAGES_FOUND MASKED MET MET_BY_ONE MOST_MET USABLE WINDOW end_of_row farthest"
    ),
    "forces.pairs.loop": "PairWorkspace pair_forces",
    "forces.pairs.sites": "CentralSites blocks_of place_ahead place_sites",
    "forces.pairs.space": "Triclinic cell_of",
    "forces.terms": "Loading",
    "forces.waves.corrections": "intramolecular_energy",
    "forces.waves.ewald": "sum_of",
    "forces.waves.vectors": "waves",
    "looking.body_film": "body_film",
    "looking.columns": "columns_figure record_of",
    "looking.film": "_loop write_film",
    "looking.mesh": "UNITS mesh_of",
    "looking.plots": "draw_panel panels",
    "looking.report": "write_report",
    "measure.accuracy": "accuracy estimated_error",
    "measure.atom_forces": "_shares",
    "measure.bias": "AverageRun Averages Quantity extrapolate",
    "measure.choice": "choose",
    "measure.columns": "BODY BODY_COLUMNS",
    "measure.drift": "slope",
    "measure.means": "correlation_time error_of_mean inefficiency",
    "measure.observables": "Reading kinetic_energies observe",
    "measure.own_forces": "check_forces",
    "measure.samples": "COLUMNS Sample Samples",
    "measure.shadow": "bias_of_potential mean_square_rate",
    "measure.stability": "CRASH Outcome REFUSED RIGHT SILENT TOLD failure longest_step",
    "measure.stable_step": "DIRECTIONS long_steps stable_angle stiffest",
    "measure.subjects": "COMPARATORS _fitted body_subject molecular_subject",
    "measure.summary": "outgrown_sums summarise",
    "measure.trials": "Method Precision Subject Trial measure timing",
    "measure.walk": "Walk weight",
    "mechanics.flight": "Pinned",
    "mechanics.groups": "TOGETHER kick_group stir_group turn_group",
    "mechanics.inertia": "inertia_tensor kind_of_body principal_frame",
    "mechanics.rotation": (
        "align angular_velocity_of_euler_rates attitude_matrix euler_rates from_attitude_matrix "
        "from_euler_angles from_quaternion from_vector from_yaw_pitch_roll hat nearest_rotation "
        "orthogonality_error to_euler_angles to_quaternion to_yaw_pitch_roll"
    ),
    "mechanics.rotor": "ExactRotor NONE NoRotor split_rotor",
    "mechanics.solids": "SOLIDS added_mass_of_ellipsoid solid",
    "molecules": (
        "GROUPS MODELS Molecule Site available_models load_model molecule read_molecule read_parameters with_masses"
    ),
    "output.averages_report": "brief_rows",
    "output.checkpoint": "Checkpoint latest read_checkpoint write_checkpoint",
    "output.connections": "connections",
    "output.figure": "AT_ONCE FAINT INK save_figure shown_range",
    "output.folder": "CHECKPOINT FINAL FolderLock LOG PREVIOUS check_folder",
    "output.frame": "Frame",
    "output.log": "TENSOR columns",
    "output.molecule_figure": "draw_molecule",
    "output.molecule_report": "bonds models_table",
    "output.picture": "Picture",
    "output.precision_report": "write_precision",
    "output.readers": "FORMATS",
    "output.record": "read_record",
    "output.report": "energy_figure signed summary_text",
    "output.run_files": "Summary read_json",
    "output.scene_file": "write_scene",
    "output.sweep_folder": "Manifest Point read_manifest write_manifest",
    "output.sweep_names": "point_name short_keys value_name",
    "output.traj_file": "TrajFile",
    "output.trajectory": "from_files in_memory read_frames",
    "output.trajectory_file": "GsdFile TrajectoryFile open_trajectory write_topology",
    "peers.bodies": "Bodies",
    "peers.checking": "compare_at",
    "peers.engines": "other_engine",
    "peers.gromacs_files": "write_gromacs",
    "peers.lammps": "LammpsEngine",
    "peers.mass_points": "mass_points",
    "peers.openmm": "OpenmmEngine",
    "peers.openmm_files": "write_openmm",
    "peers.portrait": "portrait",
    "run.body_observers": "Figures",
    "run.enthalpy": "Enthalpy",
    "run.keeper": "Keeper",
    "run.minimise": "minimise",
    "run.relief": "relieve",
    "run.resuming": "state_from",
    "run.signals": "interruptible",
    "scene.place": "Box",
    "shipped": "CHAPTERS DOCS find_example notebooks",
    "study.averages": "averages start_of_last_stage",
    "study.compare": "compare",
    "study.export": "export",
    "study.precision": "precision",
    "study.stability.battery": "battery",
    "study.stability.runs": "CASES Case",
    "study.sweep.axes": "Axis parse_axis",
    "study.sweep.cluster": "Cluster",
    "study.sweep.processes": "Pool",
    "study.sweep.running": "Waiting code_kind run_points",
    "study.sweep.slurm": "in_hours in_ranges write_script",
    "study.sweep.table": "Row measured",
    "study.verify": "verify",
}

#: Names that several modules have, or that say little alone: name here -> module:name.
RENAMED = {
    "BATH_STEP": "core.schemes:BATH",
    "BiasPoint": "measure.bias:Point",
    "SAMPLE_NUMBERS": "measure.samples:NUMBERS",
    "SHIPPED": "shipped:SYSTEMS",
    "SOLID_NUMBERS": "mechanics.solids:NUMBERS",
    "StabilityFinding": "measure.stability:Finding",
    "analysis_drawn": "analyse.files:drawn",
    "averages_faults": "output.averages_report:faults",
    "axis_settings": "study.sweep.axes:settings",
    "chosen_cases": "study.stability.battery:chosen",
    "comparison_in_words": "peers.checking:in_words",
    "course_integral": "mechanics.course:integral",
    "course_is_steady": "mechanics.course:is_steady",
    "course_steady": "mechanics.course:steady",
    "course_table": "mechanics.course:table",
    "course_total": "mechanics.course:total",
    "course_value_at": "mechanics.course:value_at",
    "course_window": "mechanics.course:window",
    "differences_in_words": "study.compare:in_words",
    "gromacs_faults": "peers.gromacs_files:faults",
    "lennard_jones_energy_and_force": "forces.laws.lennard_jones:energy_and_force",
    "lennard_jones_tail": "forces.laws.lennard_jones:tail",
    "mean_and_error": "measure.means:mean",
    "openmm_faults": "peers.openmm_system:faults",
    "own_energy_and_force": "forces.laws.own:energy_and_force",
    "precision_advice": "output.precision_report:advice",
    "precision_row": "output.precision_report:row",
    "precision_table": "output.precision_report:table_text",
    "row_of_stage": "assemble.rows:row",
    "stability_failed": "output.stability_report:failed",
    "stability_picture": "output.stability_report:picture",
    "stability_table": "output.stability_report:table_text",
    "stability_words": "output.stability_report:words",
    "tree_ahead": "forces.pairs.tree:ahead",
}

#: Whole modules, of which a test replaces something or names much: name here -> module.
MODULES = {
    "advance": "dynamics.advance",
    "averages_report": "output.averages_report",
    "body_observers": "run.body_observers",
    "boxes": "dynamics.boxes",
    "checkpoint": "output.checkpoint",
    "choice": "measure.choice",
    "choosing": "study.precision",
    "cluster": "study.sweep.cluster",
    "film": "looking.film",
    "formulas": "forces.laws.formulas",
    "gromacs_files": "peers.gromacs_files",
    "groups": "mechanics.groups",
    "lammps": "peers.lammps",
    "lammps_files": "peers.lammps_files",
    "lanes": "compile.lanes",
    "live_plot": "looking.live",
    "log": "output.log",
    "measuring": "measure.trials",
    "memory": "core.memory",
    "memory_room": "assemble.room",
    "molecular_observers": "run.molecular_observers",
    "molecular_run": "run.molecules",
    "molecule_film": "looking.molecule_film",
    "own_code": "core.own_code",
    "pair_loop": "forces.pairs.loop",
    "precision_report": "output.precision_report",
    "progress": "output.progress",
    "provenance": "run.provenance",
    "ramps": "dynamics.ramps",
    "registry": "analyse.registry",
    "resistance": "forces.body.resistance",
    "sampling": "study.averages",
    "stable_step": "measure.stable_step",
    "sweeping": "study.sweep.sweeping",
    "trajectory_formats": "assemble.trajectory_formats",
    "walk": "measure.walk",
    "watch": "measure.watch",
    "wave_vectors": "forces.waves.vectors",
    "worker": "study.sweep.worker",
}


def __getattr__(name: str) -> object:
    if name in MODULES:
        return import_module(f"rigidmd.{MODULES[name]}")
    if name not in _HOME:
        raise AttributeError(f"tests/support.py has no {name!r}: add it to HOMES, which says where names are")
    module, inner = _HOME[name].split(":")
    return getattr(import_module(f"rigidmd.{module}"), inner)


_HOME = {name: f"{module}:{name}" for module, names in HOMES.items() for name in names.split()} | RENAMED
