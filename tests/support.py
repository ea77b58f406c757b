"""The one door from the tests to the inside of rigidmd, and helpers that several test files use.

A test takes what is public from `rigidmd` itself, and the rest from here: `from support import
build, random_rotations`. Where a name is, HOMES says, below: a module that moves or is renamed
changes a line there and no test. A name is looked up when it is asked for, so that a file which
wants little loads little. Names that several modules have are told apart in RENAMED; modules of
which a test patches something are in MODULES.

test_support.py checks that no test file goes past this door but those it lists with a reason.
"""

import os
import re
import shutil
import signal
import subprocess
import sys
import zlib
from importlib import import_module
from pathlib import Path

import numpy as np

import rigidmd
from rigidmd import BodyScene, Scene
from rigidmd.analysis.rigid_frames import RigidFrames
from rigidmd.assemble.build import build
from rigidmd.compile import kernel
from rigidmd.core.integrators import Scheme
from rigidmd.core.state import NO_CELL, NOW, State
from rigidmd.engines import observables
from rigidmd.engines.cpu.engine import CpuEngine as Engine
from rigidmd.engines.system import System
from rigidmd.mechanics.free_rotor import rotate
from rigidmd.mechanics.rotation import random_rotations

ROOT = Path(__file__).parent.parent
SYSTEMS = sorted((ROOT / "systems").glob("*.toml"))
BODIES = [path for path in SYSTEMS if isinstance(Scene.read(path), BodyScene)]
MOLECULES = [path for path in SYSTEMS if path not in BODIES]

#: Argon atoms on springs, so far apart that nothing else acts on them: m w² in u/ps², and w dt = 1
#: at 36 fs.
SPRING = 30_000.0


# a system, its engine, its state


def pinned(tables: dict) -> dict:
    """Tables of a scene of molecules with a reaction field, one truncation for all forces, no tail
    correction and double precision, unless they say otherwise: one set of kernels for most tests.
    The defaults of users have tests of their own."""
    forces = {"electrostatics": "reaction_field", "tail_correction": False, "truncation": "switch"}
    forces |= tables.get("forces", {})
    if forces["electrostatics"] == "reaction_field":
        forces = {"reaction_field_truncation": forces["truncation"]} | forces
    return {"precision": "double"} | tables | {"forces": forces}


def small_scene(counts: dict[str, int], edge: float | None, folder=".", **sections) -> Scene:
    """A scene of shipped models in a cube (no periodic box if edge is None), two NVE steps."""
    data = {
        "box": {"lengths_A": edge} if edge else {"lengths_A": 15.0, "periodic": False},
        "molecules": [{"model": name, "count": count} for name, count in counts.items()],
        "start": {"temperature_K": 300.0},
        "stages": [{"duration_ps": 0.004}],
    }
    return Scene.from_dict(pinned(data | sections), folder)


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


def bits_with(threads: int, system: System, state: State) -> tuple:
    """All bits of forces, torques, energies and virials of a state, computed by so many threads."""
    engine = system.engine()
    engine.threads = threads
    load, tallies = engine.evaluate(state)
    by_term = [(name, tally.energy, tally.virial.tobytes()) for name, tally in tallies.items()]
    return load.force.tobytes(), load.torque_body.tobytes(), by_term


def built(counts, edge, seed=0, spread=0.4, **sections) -> tuple[System, Engine, State]:
    """`shaken` of `small_scene`: system, engine, state."""
    return shaken(build(small_scene(counts, edge, **sections)), seed, spread)


def observe(system: System, engine: Engine, state: State, **options):
    """The observables of a state, with energies in u Å²/ps²."""
    return observables.observe(system, engine, state, energy_unit=1.0, **options)


def move(engine: Engine, state: State, scheme: Scheme, dt: float, steps: int) -> None:
    """Take so many more steps, in place."""
    engine.advance(state, scheme, dt, int(state.step[NOW]) + steps)


@kernel(from_python=True)
def spin(rotor, rotation, angular_momentum, h: float, steps: int) -> None:
    """Turn the first molecule without torque, in place."""
    for _ in range(steps):
        rotate(rotor, 0, rotation, angular_momentum, 0, h)


def springs(**stage) -> Scene:
    """64 argon atoms, each an isotropic oscillator, under Langevin's thermostat at 300 K unless the
    stage says otherwise."""
    whole = {
        "ensemble": "nvt",
        "temperature_K": 300.0,
        "duration_ps": 20.0,
        "thermostat": "langevin",
        "friction_translation_per_ps": 15.0,
    } | stage
    return small_scene(
        {"argon": 64},
        80.0,
        forces={"cutoff_A": 8.0},
        stages=[{k: v for k, v in whole.items() if v is not None}],
        fields={"restraints": [{"stiffness_kJ_mol_A2": SPRING / 100}]},
        output={"trajectory": False, "figures": False},
    )


# runs: other programs, stops


def rigidmd_command(*arguments, **options) -> subprocess.CompletedProcess:
    """The command line, in a process of its own."""
    return subprocess.run(
        [sys.executable, "-m", "rigidmd", *map(str, arguments)],
        capture_output=True,
        text=True,
        **options,
    )


#: Loads modules of rigidmd from other files, in a process that has not imported rigidmd.
OTHER_MODULES = """
import importlib.util, sys
class Other:
    modules = {modules!r}
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return importlib.util.spec_from_file_location(name, cls.modules[name]) if name in cls.modules else None
sys.meta_path.insert(0, Other)
sys.path.insert(0, {tests!r})
"""


def run_with_files(folder: Path, files: dict[str, str], script: str) -> str:
    """What a script prints in a process in which the package has these files, new ones or others of
    the same name. Classes of terms are named by the text, because compiled code is found by their
    names."""
    found = {}
    for k, (name, text) in enumerate(files.items()):
        for term in re.findall(
            r"^class (\w+)\(NamedTuple\)", "" if (ROOT / "rigidmd" / name).exists() else text, re.M
        ):
            text = re.sub(rf"\b{term}\b", f"{term}_{zlib.crc32(text.encode()):x}", text)
        path = folder / f"{k}_{Path(name).name}"
        path.write_text(text)
        found["rigidmd." + name.removesuffix(".py").replace("/", ".")] = str(path)
    prelude = OTHER_MODULES.format(modules=found, tests=str(ROOT / "tests"))
    done = subprocess.run(
        [sys.executable, "-c", prelude + script], capture_output=True, text=True, cwd=folder
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def edited(name: str, *changes: tuple[str, str]) -> str:
    """The text of a file of the package with some changes; each old text must be there once."""
    text = (ROOT / "rigidmd" / name).read_text()
    for old, new in changes:
        assert text.count(old) == 1, f"{name}: {old!r} is there {text.count(old)} times"
        text = text.replace(old, new)
    return text


def gmx(folder: Path, *arguments, text: str = "") -> str:
    """What a command of GROMACS prints; it has to succeed."""
    done = subprocess.run(
        [shutil.which("gmx"), "-quiet", "-nobackup", *arguments],
        cwd=folder,
        input=text,
        capture_output=True,
        text=True,
        timeout=120,
    )
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
    """Run once without a stop, once with stops after these steps, each time with another number of
    threads."""
    observers = rigidmd.Every(
        0.001, lambda moment: None
    )  # observes at the same steps as those that stop
    rigidmd.Simulation(
        Scene.from_dict(data | {"threads": 1}), folder / "whole", observers=observers
    ).run()
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
    return RigidFrames(
        system,
        system.scene.stages[-1],
        np.asarray(time),
        np.broadcast_to(cell, (f, 3, 3)),
        positions,
        np.empty((f, 0, 3, 3)) if Q is None else Q,
        velocities,
        L,
        {"temperature": np.full(f, temperature)},
        tensor,
    )


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
    "run.schedule": "CheckpointSchedule interruptible",
    "assemble.build": "barostat_of integrator_of_stage thermostat_of",
    "scene.species": "Box",
    "assemble.start": "close_pairs every_site",
    "studies.sweep.plan": "Axis parse_axis",
    "studies.sweep.sweeping": "write_slurm_script",
    "view.animation": "write_film",
    "view.body_animation": "BodyAnimation",
    "core.shipped": "CHAPTERS DOCS NOTEBOOKS find_example",
    "analysis.mean_force": "Window potential_of_mean_force",
    "analysis.result": "Curve AnalysisResult Value converged_value",
    "analysis.runs": "Runs",
    "analysis.rigid_frames": "without_rounding fit_frames frames_of_folder",
    "io.formats.bonds": "bonds connections",
    "dynamics.model": "Model draw_momenta mobile remove_momentum",
    "run.pilot.trial_systems": "COMPARATORS _fit_step body_trial_system molecular_trial_system",
    "run.rigid_fit": "kinds_of",
    "figures.body": "FIGURES",
    "figures.run": "energy_figure",
    "analysis.files": "ANALYSIS analyse_folder read_results",
    "analysis.built_in.interfaces": "Slab fitted interfaces slab_of surface_tension",
    "analysis.built_in.transport": "MPA_S NM2_PER_S correlation diffusion msd squared_displacement viscosity",
    "analysis.built_in.structure": "density_profile hydrogen_bonds rdf structure_factor",
    "analysis.built_in.rotation": "PER_CM dielectric orientation spectrum total_dipole",
    "io.formats.atoms": "Frame element_of element_of_mass",
    "assemble.body": "build_body",
    "io.formats.cells": "describe_basis basis_of least_skewed_cell nearest_images pairs_within reduced_cell standard_rotation",
    "assemble.describe": "describe",
    "io.formats": "BY_EXTENSION",
    "io.formats.gsd": "GsdFile GsdReader",
    "assemble.memory_check": "array_bytes",
    "assemble.structure": "read_structure",
    "io.structure_file": "read_atoms read_geometry",
    "io.formats.through_ase": "EV TrajFile TrajReader",
    "compile": "BoundTask SIMD_BITS implements call call_blocks pack_arguments",
    "compile.cache": "CacheIndex cache_folder",
    "compile.simd": "lane_count",
    "compile.machine": "MOST_THREADS",
    "commands.arguments": "COMMANDS read_scene",
    "core.files": "AppendedFile",
    "core.integrators": "DRIFT FORMULATIONS Flow KICK REMOVE_MOMENTUM SCHEMES Solver WITH_THERMOSTAT composed split",
    "core.state": "HEAT Load ORIGIN STORED_NAMES REMOVED WORK no_load state_of",
    "core.state_file": "SavedState read_state write_state",
    "core.toml": "line_of",
    "dynamics.thermostats": "Andersen Langevin NoseHoover Ramp VelocityRescaling constant_ramp",
    "assemble.stage_description": "describe_stage",
    "dynamics.body_step_loop": "Body",
    "dynamics.barostats": "COMPONENTS COUPLINGS CellRescaling Pressure VolumeMoves barostat_workspace",
    "dynamics.noise": "BATCH THERMOSTAT BAROSTAT Key LATTICE MOMENTA chi_square fill_normals key_of normals philox uniforms",
    "dynamics.observables": "largest_values sums_of_state",
    "engines.cpu.engine": "BehindWallError DTYPES",
    "engines.protocol": "NotFiniteError",
    "engines.ode.engine": "OdeEngine",
    "forces.body.applied": "SteadyForce",
    "forces.potentials.coulomb": "radial reaction_field",
    "forces.potentials.truncation": "SWITCH_FUNCTIONS SwitchCorrection SwitchTerm TRUNCATIONS Unmodified truncation_terms",
    "forces.potentials.formulas": "FormulaError formula_of_function formula_of_table",
    "forces.potentials.text_formulas": "formula_of_text",
    "forces.potentials.lennard_jones": "lennard_jones",
    "forces.potentials.custom": "CustomOneKind tail_of_pair",
    "forces.potentials.screened_coulomb": "INTERVALS TABLE_ERROR TabledScreening force_table screened screening screening_of_lanes",
    "forces.neighbors.clusters": "BUILT LEAD_TIME clusters_of",
    "analysis.pair_histogram": "count_pairs heights",
    "forces.neighbors.lists": (
        "BUILDS ENTRIES IMAGES_FOUND MASKED NEIGHBORS NEIGHBORS_OF_ONE MAX_NEIGHBORS USABLE WINDOW end_of_row largest_displacement"
    ),
    "forces.neighbors.pair_loop": "PairWorkspace pair_forces",
    "forces.neighbors.sites": "CentralSites blocks_of predict_site compute_site_positions",
    "forces.neighbors.space": "Triclinic cell_of",
    "forces.terms": "TermDispatcher",
    "forces.ewald.corrections": "intramolecular_energy",
    "forces.ewald.direct_sum": "ewald_sum_in_numpy k_vectors_up_to",
    "view.mesh": "UNITS mesh_of",
    "view.plots": "columns_figure draw_panel panels record_of",
    "view.run_page": "write_report",
    "run.force_errors": "check_forces coulomb_errors estimated_error",
    "run.atom_forces": "_transfer_matrices",
    "run.pilot.choice": "EnergyWalk choose weight",
    "core.statistics": "correlation_time error_of_mean format_signed inefficiency mean_and_error slope steady_from",
    "engines.observables": "Observation kinetic_energies",
    "engines.samples": "BODY BODY_COLUMNS COLUMNS Sample Samples",
    "run.pilot.sampling": "bias_of_potential mean_square_rate",
    "run.pilot.stable_step": "DIRECTIONS stiffest_mode",
    "assemble.time_step": "MARGIN MIXED_ERROR error_of_step stable_angle step_error step_warnings",
    "forces.ewald.errors": "charges_in pme_error real_error",
    "run.summary": "ewald_error_notes summarise",
    "assemble.user_code.compiled": "check_compiled_code",
    "run.checks": "FailedCheck explain",
    "run.body_theory": "free_body_period heavy_top_motion",
    "run.pilot.trials": "Method IntegratorAccuracy TrialSystem Trial measure time_span",
    "mechanics.translation": "NoTranslation",
    "mechanics.batches": "LANES kick_group apply_langevin_group rotate_group",
    "mechanics.inertia": (
        "COMPONENTS_PER_DIMENSION SOLIDS added_mass_of_ellipsoid inertia_tensor kind_of_body principal_frame "
        "shifted_inertia solid"
    ),
    "mechanics.rotation": (
        "align angular_velocity_of_euler_rates attitude_matrix euler_rates from_attitude_matrix "
        "from_euler_angles from_quaternion from_vector from_yaw_pitch_roll hat nearest_rotation "
        "orthogonality_error to_euler_angles to_quaternion"
    ),
    "mechanics.free_rotor": "ExactRotor NO_SYMMETRY NoRotor split_rotor",
    "mechanics.time_functions": (
        "constant_function integrate_function interpolated_function is_constant_function "
        "pulse_function sum_functions values_at"
    ),
    "scene.models": (
        "GROUPS MODELS Molecule Site available_models load_model molecule read_molecule read_parameters with_masses"
    ),
    "studies.accuracy.averages_report": "brief_table describe_failures",
    "io.checkpoint": "Checkpoint latest read_checkpoint write_checkpoint",
    "figures.style": "AT_ONCE FAINT INK curve_style new_figure open_axis save_figure shown_range",
    "io.folder": "CHECKPOINT FINAL FolderLock LOG PREVIOUS check_folder",
    "view.molecule_figure": "models_table write_molecule_figure",
    "figures.picture": "Picture",
    "run.record": "read_record",
    "run.report": "summary_text",
    "io.run_files": "Summary TENSOR columns read_json",
    "io.scene_file": "write_scene",
    "studies.sweep.folder": "Manifest SweepPoint point_name read_manifest short_keys value_name",
    "io.trajectory": "TrajectoryFile from_files in_memory open_trajectory read_frames reader_of write_topology",
    "engines.rigid_bodies": "RigidBodies mass_points",
    "engines.external": "compare_at describe_comparison external_engine",
    "engines.registry": "programs",
    "engines.gromacs.files": "write_gromacs",
    "engines.lammps.engine": "LammpsEngine",
    "engines.openmm.engine": "OpenmmEngine",
    "engines.openmm.files": "write_openmm",
    "engines.force_field": "force_field_of",
    "run.minimise": "Enthalpy minimise remove_overlaps",
    "run.resume": "Arrays state_from",
    "run.body": "BodyRecord BodyRun",
    "run.molecular": "MolecularRecord MolecularRun",
    "studies.accuracy.averages": (
        "AverageRun AveragedQuantity Averages UNSEEN measure_averages start_of_last_stage "
    ),
    "studies.extrapolation": "MeanAtStep Together extrapolate means_of_runs",
    "studies.compare": "compare describe_run_comparison",
    "studies.gamma_point": "periodic_basis",
    "studies.accuracy.accuracy": "measure_accuracy trial_table write_accuracy",
    "studies.stability.report": "run_cases selected_cases",
    "studies.stability.cases": (
        "CASES CRASH CaseResult Outcome REFUSED REPORTED RIGHT UNDETECTED failure longest_step"
    ),
    "studies.sweep.points": "format_walltime wait_for_folder",
    "io.progress": "progress_of",
    "scene.base": "format_override",
    "studies.sweep.figure": "axis_label",
    "studies.sweep.table": "SweepRow summarise_run",
    "studies.other_engines": "export verify",
}

#: Names that several modules have, or that say little alone: name here -> module:name.
RENAMED = {
    "BATH_STEP": "core.integrators:THERMOSTAT",
    "SAMPLE_NUMBERS": "engines.samples:NUMBERS",
    "SHIPPED": "core.shipped:SYSTEMS",
    "analysis_curve_figure": "analysis.curve_figure:curve_figure",
    "axis_settings": "studies.sweep.plan:settings",
    "examples_in": "core.shipped:examples",
    "gromacs_table": "engines.gromacs.files:TRANSLATIONS",
    "lennard_jones_energy_and_force": "forces.potentials.lennard_jones:energy_and_force",
    "lennard_jones_tail": "forces.potentials.lennard_jones:tail",
    "openmm_table": "engines.openmm.system:TRANSLATIONS",
    "own_energy_and_force": "forces.potentials.custom:energy_and_force",
    "accuracy_recommendations": "studies.accuracy.accuracy:recommendations",
    "accuracy_table": "studies.accuracy.accuracy:table_text",
    "stability_table": "studies.stability.report:table_text",
    "stability_conclusions": "studies.stability.report:conclusions",
    "SweepTable": "studies.sweep.table:Table",
    "tree_ahead": "forces.neighbors.tree:ahead",
}

#: Whole modules, of which a test replaces something or names much: name here -> module.
MODULES = {
    "normal_modes": "studies.normal_modes",
    "advance": "dynamics.step_loop",
    "averages_report": "studies.accuracy.averages_report",
    "boxes": "dynamics.barostats",
    "checkpoint": "io.checkpoint",
    "choice": "run.pilot.choice",
    "choosing": "studies.accuracy.accuracy",
    "distances": "forces.fields.distances",
    "couplings": "scene.couplings",
    "integrator_rows": "scene.integrators",
    "film": "view.animation",
    "formats": "io.formats",
    "formulas": "forces.potentials.text_formulas",
    "gromacs_files": "engines.gromacs.files",
    "groups": "mechanics.batches",
    "lammps": "engines.lammps.engine",
    "openmm_engine": "engines.openmm.engine",
    "lammps_files": "engines.lammps.files",
    "lanes": "compile.simd",
    "live_plot": "view.plots",
    "log": "io.run_files",
    "measuring": "run.pilot.trials",
    "memory": "core.process",
    "memory_room": "assemble.memory_check",
    "run_observers": "run.observers",
    "molecular_run": "run.molecular",
    "molecule_film": "view.molecule_animation",
    "user_modules": "core.user_modules",
    "pair_loop": "forces.neighbors.pair_loop",
    "accuracy_report": "studies.accuracy.accuracy",
    "progress": "io.progress",
    "provenance": "run.resume",
    "ramps": "dynamics.thermostats",
    "registry": "analysis.registry",
    "resistance": "forces.body.resistance",
    "sampling": "studies.accuracy.averages",
    "stable_step": "run.pilot.stable_step",
    "limits": "studies.sweep.limits",
    "sweeping": "studies.sweep.sweeping",
    "reading_process": "io.formats.through_mdanalysis",
    "watch": "run.checks",
    "wave_vectors": "forces.ewald.direct_sum",
    "sweep_figure": "studies.sweep.figure",
    "sweep_points": "studies.sweep.points",
}


def __getattr__(name: str) -> object:
    if name in MODULES:
        return import_module(f"rigidmd.{MODULES[name]}")
    if name not in _HOME:
        raise AttributeError(
            f"tests/support.py has no {name!r}: add it to HOMES, which says where names are"
        )
    module, inner = _HOME[name].split(":")
    return getattr(import_module(f"rigidmd.{module}"), inner)


_HOME = {
    name: f"{module}:{name}" for module, names in HOMES.items() for name in names.split()
} | RENAMED
