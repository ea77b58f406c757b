"""What a session of these tests adds to pytest: the order of files, limits of time, the processor
time of compiling, and in CI the skips that are allowed.

`CI=true` in the environment makes a skipped test that is not in `ALLOWED` a failure of the session.
`RIGIDMD_CI_WITHOUT` names what could not be installed, separated by spaces (`chromium gromacs
ffmpeg`): .ci/run sets both. `RIGIDMD_TEST_COSTS` names a JSON file for the costs of each test.
"""

import json
import os
import re
import time
from collections import Counter
from fnmatch import fnmatchcase
from pathlib import Path
from threading import get_ident

import pytest
from numba.core import event

TESTS = Path(__file__).parents[1]
#: Files that begin first, about the longest first: a file is run by one worker. Neighbours have few
#: kernels in common: of two workers that need one kernel, one waits until the other has compiled it.
LONGEST = (
    "forces/test_terms.py",
    "forces/neighbors/test_update.py",
    "features/bodies/test_engine.py",
    "rules/test_docs.py",
    "assemble/test_matching.py",
    "features/view/test_figures.py",
    "forces/ewald/test_interactions.py",
    "forces/ewald/test_direct_sum.py",
    "forces/ewald/test_pme.py",
    "forces/ewald/test_corrections.py",
    "forces/ewald/test_errors.py",
    "features/bodies/test_systems.py",
    "features/external/test_lammps.py",
    "features/studies/sweep/test_sweeping.py",
    "run/test_simulation.py",
    "compile/test_kernels.py",
    "compile/test_cache.py",
    "forces/ewald/test_dispersion.py",
    "features/view/test_animation.py",
    "features/view/test_run_page.py",
    "run/test_results.py",
    "features/calculators/test_ase_calculator.py",
    "features/calculators/test_ase.py",
    "end_to_end/test_hostile_input.py",
    "run/test_resume.py",
    "end_to_end/test_faults.py",
    "features/potentials/test_custom.py",
    "features/potentials/test_tables.py",
    "dynamics/test_step_loop.py",
    "compile/test_thread_pool.py",
    "compile/test_simd.py",
    "run/test_minimise.py",
    "end_to_end/test_ensembles.py",
    "end_to_end/test_fuzz.py",
    "io/test_trajectory_file.py",
    "features/view/test_notebook.py",
)
RANKS = {file: rank for rank, file in enumerate(LONGEST)}

#: Tests beyond the default tier: marker -> file -> patterns of names. Extended: variants that compile
#: kinds of kernels which no other default test needs, or start many processes; .ci/run runs them.
#: Soak: repeats of statistics, rare variants, and the whole of what other tests check in parts.
TIERS = {
    "extended": {
        "features/studies/accuracy/test_accuracy.py": (
            "only_what_keeps_its_order_is_tried",
            "the_command_writes_a_table_a_figure_and_a_page",
        ),
        "rules/test_architecture.py": (
            "a_run_of_a_top_loads_what_its_output_needs[no output]",
            "a_run_of_a_top_loads_what_its_output_needs[default output]",
        ),
        "features/bodies/test_systems.py": (
            "the_error_of_the_split_rotor_is_second_order*",
            "every_scene_keeps_what_it_should_and_states_what_to_look_at[dropped_stone]",
            "every_scene_keeps_what_it_should_and_states_what_to_look_at[satellite_mass_loss]",
            "every_scene_keeps_what_it_should_and_states_what_to_look_at[gyroscope_friction]",
            "every_scene_keeps_what_it_should_and_states_what_to_look_at[gyrocompass]",
            "every_scene_keeps_what_it_should_and_states_what_to_look_at[body_in_fluid]",
            "the_split_rotor_conserves_the_energy_that_theory_states*",
            "euler_angles_refuse_the_pole_or_come_through_it[rk4]",
            "the_sleeping_top_wakes_where_it_should",
            "the_split_rotor_has_the_best_of_all_orders*",
        ),
        "features/bodies/test_fluid.py": (
            "functions_that_depend_on_velocities_are_noted*",
            "a_body_in_a_fluid_follows_kirchhoff",
            "equal_coefficients_resist_alike_in_all_directions",
            "stiff_resistance_ends_at_the_terminal_speed",
        ),
        "features/bodies/test_frames.py": (
            "what_is_switched_on_and_off_gives_its_whole_impulse[dop853]",
            "breaks_at_the_ends_and_on_top_of_each_other_do_no_harm",
            "a_frame_that_changes_its_axis_is_left_to_compositions",
            "a_table_does_not_cost_the_order_of_the_integrator",
            "the_same_scene_gives_the_same_bits_however_often_it_is_observed",
            "what_is_switched_on_and_off_gives_its_whole_impulse[ra*",
            "what_is_switched_on_and_off_gives_its_whole_impulse[rk4]",
            "wheels_drives_and_friction_in_a_rotating_accelerated_frame",
        ),
        "features/bodies/test_engine.py": (
            "a_python_function_can_apply_what_a_scene_does",
            "what_has_no_exact_flow_is_not_given_to_schemes_that_count_on_one",
        ),
        "features/bodies/test_ode.py": (
            "a_satellite_that_loses_mass_keeps_its_angular_momentum[rk4*",
            "a_run_that_cannot_continue_states_when",
        ),
        "features/potentials/test_pose_tables.py": (
            "a_scene_has_a_table_as_a_file_and_compares_its_forces_at_the_start",
        ),
        "features/potentials/test_body_pairs.py": (
            "pairs_at_a_cutoff_where_the_energy_jumps_are_not_a_wrong_force",
            "a_text_has_the_energy_of_all_its_pairs*",
            "integrators_have_their_order*",
        ),
        "compile/test_code.py": (
            "a_second_process_compiles_the_last_tasks_first",
            "compiling_continues_alone_where_the_second_process_ends",
        ),
        "compile/test_cache.py": (
            "without_a_home_folder_the_cache_is_a_temporary_one[raise*",
            "code_of_another_user_is_not_used",
            "code_behind_a_link_in_the_cache_is_not_used",
            "a_full_disk_costs_time_only[tempfile*",
            "an_index_that_cannot_be_read_is_not_replaced",
            "kernels_are_found_after_a_process_with_a_module_that_others_lack",
        ),
        "compile/test_machine.py": (
            "vectors_are_as_wide_as_those_of_the_processor_that_is_named[skylake*",
            "vectors_are_as_wide_as_those_of_the_processor_that_is_named[nehalem*",
            "settings_that_change_code_have_a_cache_of_their_own",
        ),
        "features/free_energy/test_coupling.py": ("a_sweep_has_a_free_energy",),
        "assemble/test_defaults.py": ("a_droplet_in_a_large_box_has_the_accuracy_of_a_liquid*",),
        "forces/ewald/test_dispersion.py": (
            "same_bits_for_any_number_of_threads*",
            "energy_is_conserved*",
            "forces_are_as_accurate_as_requested*",
            "forces_torques_and_virial_are_slopes_of_the_energy[forces1*",
            "mixed_precision[co2_trappe]",
            "openmm_has_the_same_energy_and_forces",
            "the_mesh_is_the_sum*",
        ),
        "rules/test_docs.py": tuple(
            f"what_a_document_describes_can_be_done[{page}]"
            for page in (
                "analysis",
                "ase",
                "chemical_potential",
                "engines",
                "ensembles",
                "extending",
                "free_energies",
                "installation",
                "molecule",
                "normal_modes",
                "npt",
                "pictures",
                "potentials",
                "python",
                "resume",
                "robustness",
                "run_times",
                "slab",
                "structures",
                "studies",
                "time_step",
                "time_step_water",
                "top",
                "transport",
                "water",
            )
        ),
        "end_to_end/test_equations_of_state.py": ("*",),
        "end_to_end/test_ensembles.py": ("*",),
        "forces/ewald/test_errors.py": ("forces_of_a_slab_are_as_accurate_as_requested*",),
        "forces/ewald/test_corrections.py": (
            "frozen_molecules_do_not_act_on_one_another",
            "lennard_jones_and_real_space_end_at_different_distances*",
        ),
        "forces/ewald/test_interactions.py": (
            "madelung_constant_of_rock_salt[pme*",
            "ions_in_a_triclinic_cell[pme]",
            "total_does_not_depend_on_how_it_is_split*",
        ),
        "forces/ewald/test_pme.py": (
            "total_momentum_is_taken_out_at_steps_that_the_scene_decides",
        ),
        "forces/ewald/test_direct_sum.py": ("k_vectors_of_a_cell_that_a_file_describes_otherwise",),
        "end_to_end/test_faults.py": ("*",),
        "features/view/test_figures.py": ("figures_of_a_run_and_of_a_molecule_take_any_name*",),
        "forces/neighbors/test_update.py": (
            "a_cutoff_within_which_are_too_many_sites_is_refused",
            "a_list_with_little_memory_grows_and_misses_nothing[mixed]",
        ),
        "forces/test_terms.py": (
            "forces_and_torques_are_the_slope_of_the_energy[smooth_switch*",
            "forces_and_torques_are_the_slope_of_the_energy[force_switch*",
            "virials_are_sums_over_pairs[none-double]",
            "energies_are_those_of_the_oracle[force_switch*",
            "energies_are_those_of_the_oracle[plain*",
            "energies_are_those_of_the_oracle[smooth_switch*",
            "energies_are_those_of_the_oracle[switch*",
            "everything_follows_a_cell_that_changes[ewald*",
            "everything_follows_a_cell_that_changes[pme*",
            "forces_and_torques_are_the_slope_of_the_energy[force_shift*",
            "forces_have_the_same_bits_with_their_energies_and_without[a text*",
            "forces_have_the_same_bits_with_their_energies_and_without[damped*",
            "forces_have_the_same_bits_with_their_energies_and_without[defaults-mixed]",
            "forces_have_the_same_bits_with_their_energies_and_without[no box*",
            "molecules_millions_of_cells_away*",
            "triclinic_boxes*",
        ),
        "features/crystals/test_framework.py": ("a_framework_acts_as_its_atoms_do[na_spce-pme]",),
        "end_to_end/test_fuzz.py": ("*",),
        "features/free_energy/test_insertion.py": ("energies_are_the_differences_of_the_engine*",),
        "features/external/test_lammps.py": (
            "an_export_of_ellipsoids_runs_by_itself",
            "a_liquid_of_ellipsoids_next_to_sites_is_the_same",
            "a_run_is_one_like_any_other[1]",
        ),
        "features/view/test_notebook.py": ("a_sweep_shows_its_progress", "the_tutorial_runs"),
        "engines/cpu/test_engine.py": (
            "an_observation_takes_the_energies_of_the_last_step[stochastic_cell*",
            "an_observation_takes_the_energies_of_the_last_step[srkn_6*",
            "an_observation_takes_the_energies_of_the_last_step[c*",
            "an_observation_takes_the_energies_of_the_last_step[piston*",
        ),
        "engines/cpu/test_program.py": ("check_measures_a_potential_of_bodies",),
        "end_to_end/test_extreme_scenes.py": (
            "any_small_scene_of_one_kind_runs_ten_steps_or_is_refused_with_a_message",
        ),
        "run/test_results.py": (
            "a_run_that_nobody_closes_lets_its_folder_go[signal]",
            "a_run_that_nobody_closes_lets_its_folder_go[deleted]",
            "an_editor_knows_the_types",
            "every_column_of_every_body_is_in_the_table",
        ),
        "run/test_resume.py": (
            "a_body_continues[rk4]",
            "a_folder_is_all_that_is_needed",
            "a_forked_child_leaves_the_files_of_the_run_alone",
            "a_run_that_is_stopped_ends_like_one_that_is_not",
            "every_ensemble_continues_to_the_same_bits[hybrid_monte_carlo*",
        ),
        "io/test_checkpoint.py": ("wrong_numbers_in_a_checkpoint_do_no_harm[dop853*",),
        "io/test_folder.py": ("no_command_writes_through_a_link*",),
        "run/test_schedule.py": ("a_signal_stops_with_a_summary_and_its_code[15*",),
        "run/test_simulation.py": tuple(
            f"every_system_runs_a_few_steps[{name}]" for name in ("gay_berne", "water_nitrogen")
        ),
        "assemble/test_scenes.py": ("the_scene_that_a_run_writes_holds_every_number_it_used[pme]",),
        "commands/test_examples.py": ("a_wheel_has_every_file_and_nothing_of_an_earlier_build",),
        "compile/test_sources.py": ("*",),
        "features/studies/test_stability.py": (
            "the_command_writes_its_files_and_does_not_overwrite",
        ),
        "features/studies/test_stored_runs.py": ("a_sweep_is_read",),
        "end_to_end/test_working_directory.py": (
            "nothing_in_the_working_directory_is_executed_or_obeyed*",
        ),
        "features/studies/sweep/test_points.py": (
            "a_killed_process_loses_its_point_alone_and_a_signal_stops_all",
            "points_run_on_a_cluster_of_dask",
            "points_that_fail_are_reported_and_repeated",
        ),
        "compile/test_thread_pool.py": (
            "there_may_be_more_threads_than_cores_and_the_process_ends[7]",
            "simulations_on_all_threads_at_once_have_the_bits_of_each_alone",
        ),
        "io/test_trajectory_file.py": ("a_run_continues_from_a_trajectory",),
        "features/potentials/test_tables.py": (
            "a_table_in_a_file_is_the_potential_that_it_lists*",
        ),
        "features/potentials/test_text.py": ("any_text_is_read_or_refused_soon",),
        "features/potentials/test_user_code.py": (
            "every_example_of_an_extension_runs_and_is_short*",
        ),
        "features/view/test_run_page.py": ("a_browser_shows_a_top_that_moves",),
        "features/free_energy/test_virial.py": ("published_values",),
        "end_to_end/test_walk.py": ("a_sample_of_the_walk*",),
        "dynamics/test_step_loop.py": (
            "no_drift_beyond_its_error_at_one_femtosecond_over_twenty_picoseconds",
        ),
        "features/monte_carlo/test_trajectories.py": (
            "the_weights_of_every_integrator_have_the_mean_one[takahashi_imada]",
        ),
        "io/test_trajectory.py": ("frames_of_xtc_are_those_that_mdanalysis_writes[None]",),
        "run/test_checks.py": ("a_term_of_somebody_elses_spoils_no_cache",),
        "compile/test_kernels.py": ("an_inner_kernel_is_kept_and_linked_into_other_kernels_later",),
        "features/analysis/test_thermodynamics.py": (
            "a_run_of_an_ideal_gas_of_rotors_has_its_responses[cell_rescaling]",
        ),
        "features/bodies/test_run.py": (
            "a_solver_of_many_internal_steps_ends_between_two_observations_and_resumes_to_the_same_bits[radau*",
        ),
        "core/test_integrators.py": (
            "trajectories_of_hybrid_monte_carlo_have_weights_of_mean_one[outer*",
        ),
        "commands/test_cli.py": ("times_of_accuracy_are_in_their_range[molecules*",),
    },
    "soak": {
        "run/test_pilot.py": ("a_crude_error_is_kept_crudely*",),
        "features/bodies/test_systems.py": ("free_bodies_of_others",),
        "features/bodies/test_ode.py": (
            "the_textbook_systems_are_the_same_motion*matrix*",
            "the_textbook_systems_are_the_same_motion[quaternion-fluid]",
        ),
        "forces/ewald/test_dispersion.py": ("mixed_precision[argon]",),
        "dynamics/test_step_loop.py": (
            "a_smooth_cutoff_leaves_every_scheme_its_order_in_the_liquid[chin_4a*",
        ),
        "core/test_integrators.py": ("adding_an_integrator_*",),
        "features/external/test_settings.py": ("adding_an_engine_takes_a_folder",),
        "end_to_end/test_faults.py": ("a_run_that_is_stopped_by_signals_continues*",),
        "forces/fields/test_fields.py": ("adding_a_field_*",),
        "forces/neighbors/test_update.py": (
            "a_list_with_almost_no_skin_is_built_at_every_step[mixed*",
        ),
        "features/potentials/test_pairs.py": ("adding_a_pair_potential_takes_one_file",),
        "features/crystals/test_framework.py": ("a_published_henry_constant",),
        "end_to_end/test_fuzz.py": ("all_that_is_changed_is_valid*",),
        "features/studies/test_joint_fit.py": ("pulls_of_joint_limits_have_unit_width*",),
        "support/test_known.py": ("gyrocompass_swings",),
        "features/free_energy/test_mean_force.py": ("errors_are_those_of_repeated_samples",),
        "end_to_end/test_reference.py": ("a_cutoff_that_reaches_hundreds_of_clusters",),
        "run/test_resume.py": ("a_run_that_is_killed_continues[2*",),
        "run/test_simulation.py": tuple(
            f"every_system_runs_a_few_steps[{name}]"
            for name in (
                "dry_ice",
                "janus",
                "lta",
                "tip4p2005",
                "water_from_structure",
                "water_npt",
                "water_pme",
                "water_slab",
            )
        ),
        "compile/test_simd.py": (
            "mixed_precision_costs_less_than_a_hundred_thousandth*switch*",
            "the_narrowest_vectors*",
            "the_same_bits_for_any_number_of_threads[mixed]",
        ),
        "features/studies/test_stability.py": ("quick*",),
        "end_to_end/test_working_directory.py": ("analyses_execute_and_obey_nothing*",),
        "features/studies/sweep/test_limits.py": ("energy_at_a_step_of_zero_has_a_joint_fit*",),
        "features/studies/sweep/test_points.py": (
            "a_second_interrupt_ends_all_points_at_once",
            "points_end_with_their_sweep*",
        ),
        "features/free_energy/test_virial.py": (
            "errors_are_honest",
            "steep_spherocylinders_tend_to_hard_ones",
        ),
        "end_to_end/test_walk.py": ("every_command_on_*",),
    },
}

#: Reasons to skip that are properties of a machine, which CI cannot install.
MACHINE = (
    "root may write everywhere",  # the folder without permissions: CI runs as root in a container
    "no small file system can be made here",  # a full disk: mounting needs CAP_SYS_ADMIN
    "where there is one core",
    "this machine has one core",
    "one core",
    "an instruction of AVX-512",
    "vectors are not wider than the stack",
    "this is what all tests run with here",  # vectors of 128 bits
    "the processors are those of x86",
)
#: Reasons to skip that are allowed where the program could not be installed.
PROGRAMS = {
    "chromium": "Chromium is not installed",
    "gromacs": "(GROMACS is not installed|no gmx here)",
    "ffmpeg": "ffmpeg is not installed",
    "reference": "no outside reference data at",
}

IN_CI = os.environ.get("CI", "").lower() in ("1", "true", "yes")
ALLOWED = [re.escape(reason) for reason in MACHINE]
ALLOWED += [
    r"no .*/spce_monoclinic_sample_periodic4\.txt"
]  # a file of NIST that the shared folder does not have
ALLOWED += [
    "could not import 'tblite.ase'"
]  # a semi-empirical method, which no extra of the project installs
ALLOWED += [
    PROGRAMS[name] for name in os.environ.get("RIGIDMD_CI_WITHOUT", "").split() if name in PROGRAMS
]

#: Processor time of compiling, s, above which CI lists a test. The first test of a file that needs
#: common kernels compiles them.
MOST_COMPILING = 4.0

_skipped: list[str] = []
_costs: dict[str, dict] = {}  # by the name of the test


class Costs(event.Listener):
    """What this process spends on tests: processor time and compiled kernels.

    Numba's lock of the compiler is also held while a kernel is read from the cache, but then no
    pass of the compiler runs.
    """

    def __init__(self):
        self.compiling = 0.0  # s
        self.kernels: list[str] = []
        self.before = os.times()
        self._depth: Counter[int] = Counter()  # of nested locks, by thread
        self._start: dict[int, float] = {}
        self._kernel: dict[int, str] = {}
        event.register("numba:compiler_lock", self)
        event.register("numba:run_pass", self)

    def on_start(self, event):
        """The outermost lock of a thread starts its clock; the first pass names the kernel."""
        thread = get_ident()
        if event.kind == "numba:run_pass":
            self._kernel.setdefault(thread, event.data["qualname"])
            return
        if not self._depth[thread]:
            self._start[thread] = time.thread_time()
        self._depth[thread] += 1

    def on_end(self, event):
        """The end of the outermost lock stops the clock."""
        thread = get_ident()
        if event.kind == "numba:run_pass":
            return
        self._depth[thread] -= 1
        if not self._depth[thread] and thread in self._kernel:
            self.compiling += time.thread_time() - self._start[thread]
            self.kernels.append(self._kernel.pop(thread))

    def take(self) -> dict:
        """Costs since the last call, and zero again: seconds of this process, of child processes
        that ended, and of compiling in this process; names of kernels."""
        spent = os.times()
        user, system, *children = (
            now - before for now, before in zip(spent[:4], self.before, strict=False)
        )
        taken = {
            "process": user + system,
            "children": sum(children),
            "compiling": self.compiling,
            "kernels": self.kernels,
        }
        self.before, self.compiling, self.kernels = spent, 0.0, []
        return taken


COSTS = Costs()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo):
    """The last report of a test has its costs, also for the controller of several workers."""
    if call.when == "teardown":
        item.user_properties.append(("costs", COSTS.take()))
    return (yield)


@pytest.hookimpl(tryfirst=True)  # before tests are selected by their markers
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long files come first; tests have the markers of their tiers; a test of the soak tier has no
    limit of time."""
    items.sort(key=lambda item: RANKS.get(file_of(item), len(RANKS)))
    for item in items:
        if (tier := tier_of(file_of(item), item.name)) and not item.get_closest_marker("soak"):
            item.add_marker(tier)
        if item.get_closest_marker("soak"):
            item.add_marker(pytest.mark.timeout(0))


def file_of(item: pytest.Item) -> str:
    """The file of a test, below tests/."""
    return item.path.relative_to(TESTS).as_posix()


def tier_of(file: str, name: str) -> str | None:
    """The marker of a test by `TIERS`, the later of two; None for the default tier."""
    return next((tier for tier in reversed(TIERS) if pattern_in(tier, file, name)), None)


def pattern_in(tier: str, file: str, name: str) -> str | None:
    """The first pattern of a tier that names a test."""
    name = name.removeprefix("test_")
    patterns = TIERS[tier].get(file, ())
    return next((one for one in patterns if fnmatchcase(name, one.replace("[", "[[]"))), None)


def _note(report: pytest.TestReport | pytest.CollectReport) -> None:
    if not report.skipped or hasattr(report, "wasxfail") or not isinstance(report.longrepr, tuple):
        return
    path, _, reason = report.longrepr
    if not any(re.match(allowed, reason.removeprefix("Skipped: ")) for allowed in ALLOWED):
        _skipped.append(f"{report.nodeid or Path(path).name}: {reason}")


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Note a test that was skipped for a reason that is not allowed, and the costs of each."""
    _note(report)
    if costs := dict(report.user_properties).get("costs"):
        _costs[report.nodeid] = costs


def pytest_collectreport(report: pytest.CollectReport) -> None:
    """Note a file that was skipped for a reason that is not allowed."""
    _note(report)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """In CI a session with such skips has failed."""
    if IN_CI and _skipped and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter) -> None:
    """Processor time of tests and of compiling; in CI tests that compile long, and the skips that
    are not allowed."""
    if path := os.environ.get("RIGIDMD_TEST_COSTS"):
        Path(path).write_text(json.dumps(_costs, indent=1))
    total, compiling = (
        sum(sum(costs[name] for name in names) for costs in _costs.values())
        for names in (("process", "children"), ("compiling",))
    )
    kernels = sum(len(costs["kernels"]) for costs in _costs.values())
    terminalreporter.line(
        f"{total:.0f} s of processor time, of which {compiling:.0f} s compiled {kernels} kernels"
    )
    if IN_CI:
        for name, costs in sorted(_costs.items(), key=lambda item: -item[1]["compiling"]):
            if costs["compiling"] > MOST_COMPILING:
                terminalreporter.line(f"{costs['compiling']:5.1f} s of compiling: {name}")
    if IN_CI and _skipped:
        terminalreporter.section(
            "skipped tests that CI does not allow (tests/support/hooks.py)", red=True
        )
        for line in sorted(set(_skipped)):
            terminalreporter.line(line)
