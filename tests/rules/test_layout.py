"""A reader finds the test of a module: a module has a test file of its name, or one of the name of
its package, or a line here. The declarations of features are tested in `test_features.py`."""

import ast
from functools import cache
from pathlib import Path

from support.common import ROOT

TESTS, PACKAGE = ROOT / "tests", ROOT / "rigidmd"

#: Test file -> further modules that it tests.
TESTED_BY = {
    "assemble/test_build.py": "assemble/resolve dynamics/model",
    "assemble/test_defaults.py": "assemble/describe scene/forces",
    "assemble/test_matching.py": "assemble/assignment assemble/atom_kinds assemble/bonded_atoms",
    "commands/test_cli.py": "commands/arguments commands/check commands/compile commands/help"
    " commands/streams core/plain_text scene/json_schema",
    "commands/test_examples.py": "commands/new core/shipped",
    "compile/test_simd.py": "compile/simd_memory compile/simd_types",
    "core/test_integrators.py": "dynamics/force_gradient scene/integrators",
    "core/test_state.py": "core/state_file",
    "dynamics/test_registers.py": "dynamics/observables",
    "dynamics/test_step_loop.py": "mechanics/batches",
    "dynamics/test_step_table.py": "dynamics/step_parts dynamics/step_rows",
    "dynamics/test_thermostats.py": "assemble/stage_description",
    "end_to_end/test_faults.py": "core/files core/signals",
    "end_to_end/test_hostile_input.py": "core/process core/toml",
    "engines/cpu/test_program.py": "compile/program compile/stopwatch engines/cpu/compiled engines/protocol",
    "forces/fields/test_fields.py": "scene/fields",
    "assemble/test_species.py": "scene/species",
    "rules/test_schema.py": "commands/schema",
    "features/analysis/test_runs.py": "features/analysis/display features/analysis/analysis features/analysis/files features/analysis/report features/analysis/registry"
    " features/analysis/commands/analyse",
    "features/analysis/test_conditions.py": "features/analysis/options",
    "features/analysis/test_structure.py": "features/analysis/pair_histogram",
    "features/analysis/test_transport.py": "features/analysis/relaxation",
    "mechanics/test_free_rotor.py": "mechanics/inertia mechanics/vectors",
    "features/bodies/test_engine.py": "features/bodies/assemble features/bodies/defaults"
    " features/bodies/step_loop features/bodies/motion features/bodies/system features/bodies/cpu_engine"
    " features/bodies/forces/applied features/bodies/translation features/bodies/driven_rotor",
    "features/bodies/test_fluid.py": "features/bodies/forces/resistance",
    "features/bodies/test_frames.py": "features/bodies/time_functions",
    "features/bodies/test_input.py": "features/bodies/keys/body features/bodies/keys/forces features/bodies/describe",
    "features/bodies/test_ode.py": "features/bodies/ode/odes",
    "features/bodies/test_rates.py": "features/bodies/rates features/bodies/summary features/bodies/theory",
    "features/bodies/test_run.py": "features/bodies/run features/bodies/feature features/bodies/stored_motion features/bodies/stable_step",
    "features/calculators/test_ase_calculator.py": "run/atom_forces",
    "features/calculators/test_ase.py": "features/calculators/calculator",
    "features/crystals/test_cif.py": "features/crystals/cif_syntax features/crystals/crystal",
    "features/external/test_lammps.py": "features/external/commands/export features/external/commands/verify features/external/engines"
    " features/external/rigid_bodies features/external/verify",
    "features/external/test_settings.py": "core/programs features/external/force_field",
    "features/free_energy/test_coupling.py": "features/free_energy/keys features/free_energy/estimate features/free_energy/soft_core"
    " features/free_energy/lambda_sweep",
    "features/free_energy/test_insertion.py": "features/free_energy/guest features/free_energy/guest_pairs"
    " features/free_energy/pose_trials",
    "features/free_energy/test_mean_force.py": "features/free_energy/windows",
    "features/monte_carlo/test_trajectories.py": "features/monte_carlo/keys"
    " features/monte_carlo/momenta features/monte_carlo/pilot",
    "features/potentials/test_custom.py": "features/potentials/user_code/pair_potential"
    " features/potentials/user_code/pair_terms features/potentials/user_code/cutoffs features/potentials/sites/formulas",
    "features/potentials/test_pose_tables.py": "features/potentials/poses/pairs",
    "features/potentials/test_python_forces.py": "features/potentials/user_code/force features/potentials/user_code/force_checks",
    "features/potentials/test_shipped.py": "features/potentials/poses/shapes features/potentials/poses/bodies features/potentials/poses/formulas features/potentials/poses/gay_berne"
    " features/potentials/poses/multipoles features/potentials/poses/patch features/potentials/poses/potential",
    "features/potentials/test_slopes.py": "features/potentials/expressions/trace",
    "features/potentials/test_text.py": "features/potentials/expressions/radial",
    "features/potentials/test_torques.py": "features/potentials/user_code/pose_checks",
    "features/potentials/test_user_code.py": "features/potentials/user_code/binding"
    " features/potentials/user_code/compiled features/potentials/user_code/trust core/user_modules"
    " features/potentials/user_code/kernels features/potentials/extra features/potentials/feature"
    " features/potentials/keys scene/added_forces scene/table_in_file",
    "features/studies/accuracy/test_averages.py": "features/studies/accuracy/start",
    "features/studies/sweep/test_sweeping.py": "features/studies/commands/compare features/studies/commands/sweep features/studies/compare"
    " features/studies/sweep/folder"
    " features/studies/sweep/replicas",
    "features/studies/sweep/test_table.py": "features/bodies/study features/studies/kind_study features/studies/sweep/figure",
    "features/studies/test_normal_modes.py": "features/studies/commands/modes features/studies/gamma_point",
    "features/view/test_animation.py": "features/view/commands/film features/view/commands/view"
    " features/bodies/animation features/view/molecule_animation features/view/page features/view/solids",
    "features/view/test_mesh.py": "features/bodies/edges",
    "features/view/test_figures.py": "features/analysis/curve_figure features/bodies/figures features/view/figures/energy features/view/figures/panels"
    " features/view/figures/picture features/view/figures/space features/view/figures/style"
    " features/studies/accuracy/figure",
    "features/view/test_notebook.py": "features/analysis/result features/bodies/display features/view/kind_display core/display features/view/plots",
    "features/view/test_run_page.py": "features/view/commands/report features/view/stage_tables",
    "forces/ewald/test_direct_sum.py": "forces/ewald/smooth",
    "forces/neighbors/test_clusters.py": "forces/neighbors/tree",
    "forces/neighbors/test_pair_loop.py": "forces/neighbors/rows forces/neighbors/sites",
    "forces/potentials/test_truncation.py": "forces/potentials/lennard_jones",
    "forces/test_terms.py": "forces/neighbors/space forces/parts",
    "formats/test_atoms.py": "features/crystals/g96",
    "io/test_progress.py": "io/run_files",
    "io/test_trajectory_file.py": "formats/through_mdanalysis io/structure_file",
    "run/test_checks.py": "assemble/harmonic run/failed_check run/rigid_fit run/stable_step",
    "run/test_observers.py": "run/molecular_observers",
    "run/test_pilot.py": "features/bodies/trials run/trial_systems run/trials",
    "run/test_resume.py": "commands/resume io/write run/record run/stored_log",
    "run/test_results.py": "engines/observables",
    "run/test_simulation.py": "run/kind engines/sites engines/system run/loop run/molecular run/part",
    "run/test_summary.py": "run/report",
    "scene/test_hints.py": "scene/base scene/kinds scene/stage",
    "scene/test_thermostats.py": "scene/ensemble_methods scene/ensembles",
    "scene/test_validation.py": "errors",
    "scene/test_molecules.py": "assemble/model_text commands/models formats/bonds io/scene_file",
    "support/test_tiers.py": "core/bound_process",
}
#: Test files whose name is neither that of a module nor that of a package -> what they test.
FEATURES = {
    "features/analysis/test_mixtures.py": "analyses of several species, against NumPy",
    "features/analysis/test_other_programs.py": "analyses against MDAnalysis and others",
    "features/bodies/test_fluid.py": "added mass and resistance",
    "features/bodies/test_frames.py": "rotating and accelerated frames",
    "features/bodies/test_input.py": "errors in scenes of bodies",
    "features/calculators/test_ase_calculator.py": "rigidmd as a calculator of ASE",
    "features/calculators/test_ase_trajectory.py": "trajectories of ASE",
    "features/crystals/test_framework.py": "frozen frameworks",
    "features/external/test_names.py": "names of users in generated files",
    "features/potentials/test_custom_thermostats.py": "thermostats of users",
    "features/potentials/test_pose_tables.py": "tables of poses",
    "features/potentials/test_torques.py": "torques about axes without inertia",
    "forces/test_frozen.py": "frozen molecules and parameters of pairs",
    "run/test_minimise_stages.py": "stages of minimisation",
}
#: Folders whose files are named after what they do.
FREE = ("benchmarks", "end_to_end", "rules", "support")


@cache
def names_of_files() -> dict[str, str]:
    """Test file, below tests/ -> the name of what it tests."""
    return {
        path.relative_to(TESTS).as_posix(): path.stem.removeprefix("test_")
        for path in sorted(TESTS.rglob("test_*.py"))
    }


def has_logic(path: Path) -> bool:
    """Whether a module defines a function or a class."""
    body = ast.parse(path.read_text(encoding="utf-8")).body
    return any(isinstance(node, ast.FunctionDef | ast.ClassDef) for node in body)


def module_names() -> dict[str, Path]:
    """The modules below rigidmd/, without the extension."""
    paths = (path for path in sorted(PACKAGE.rglob("*.py")) if not path.stem.startswith("__"))
    return {path.relative_to(PACKAGE).with_suffix("").as_posix(): path for path in paths}


def has_file_of_its_name(module: str) -> bool:
    """Whether a test file has the name of a module, or of the package in a package that it is
    in. The file is in the folder of the package or among the features."""
    package, *inner = module.split("/")
    if package == "features":
        package, *inner = f"features/{inner[0]}", *inner[1:]
    return any(
        name in (inner or [package]) and file.startswith((f"{package}/", "features/"))
        for file, name in names_of_files().items()
    )


def test_every_module_with_logic_has_a_test_file():
    listed = {name for names in TESTED_BY.values() for name in names.split()}
    lacking = [
        name
        for name, path in module_names().items()
        if has_logic(path)
        and path.stem != "feature"
        and name not in listed
        and not has_file_of_its_name(name)
    ]
    assert not lacking, "no test file has their name, and TESTED_BY has no line for them"


def test_every_line_of_the_lists_is_needed():
    modules, files = module_names(), names_of_files()
    assert [file for file in (*TESTED_BY, *FEATURES) if file not in files] == []
    listed = [name for names in TESTED_BY.values() for name in names.split()]
    assert [name for name in listed if name not in modules] == []
    assert len(listed) == len(set(listed))


def test_test_files_are_named_after_modules_or_features():
    known = {path.stem for path in PACKAGE.rglob("*.py")} | {
        path.name for path in PACKAGE.rglob("*") if path.is_dir()
    }
    strange = [
        file
        for file, name in names_of_files().items()
        if name not in known and file not in FEATURES and file.partition("/")[0] not in FREE
    ]
    assert not strange, "FEATURES has no line for them"
    assert [file for file in FEATURES if names_of_files().get(file) in known] == []
