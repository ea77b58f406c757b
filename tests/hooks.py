"""What a session of these tests adds to pytest: the order of files, limits of time, and in CI the
skips that are allowed.

`CI=true` in the environment makes a skipped test that is not in `ALLOWED` a failure of the session.
`RIGIDMD_CI_WITHOUT` names what could not be installed, separated by spaces (`chromium gromacs
ffmpeg`): .ci/run sets both.
"""

import os
import re
from fnmatch import fnmatchcase
from pathlib import Path

import pytest

#: Files that take longest with cold kernels, the longest first: a file is run by one worker, so
#: they begin first. The first two have no kernels in common, which both workers would compile.
LONGEST = (
    "forces",
    "body_engine",
    "docs",
    "run",
    "ewald",
    "resume",
    "sweep",
    "compile",
    "dispersion",
    "python",
    "bodies",
    "view",
    "ase",
    "strangers",
    "faults",
    "user_code",
    "dynamics",
    "threads",
    "simd",
    "minimise",
    "ensembles",
    "fuzz",
    "trajectory_structures",
    "notebook",
)
RANKS = {f"test_{name}.py": rank for rank, name in enumerate(LONGEST)}

#: Variants that compile kinds of kernels which no other default test needs, or start many processes:
#: file -> patterns of names. They have the marker `extended`, and .ci/run runs them too.
EXTENDED = {
    "test_accuracy.py": ("the_command_writes_a_table_a_figure_and_a_page",),
    "test_auto.py": ("a_crude_error_is_kept_crudely*",),
    "test_bodies.py": (
        "free_bodies_of_others",
        "the_sleeping_top_wakes_where_it_should",
        "the_split_rotor_has_the_best_of_all_orders*",
    ),
    "test_body_engine.py": (
        "a_python_function_can_apply_what_a_scene_does",
        "stiff_resistance_ends_at_the_terminal_speed",
        "the_textbook_systems_are_the_same_motion*matrix*",
        "wheels_drives_and_friction_in_a_turning_accelerated_frame",
    ),
    "test_body_pairs.py": (
        "a_text_has_the_same_energy_as_its_function*",
        "integrators_have_their_order*",
    ),
    "test_dispersion.py": (
        "forces_are_as_accurate_as_asked_for*",
        "mixed_precision*",
        "openmm_has_the_same_energy_and_forces",
        "the_mesh_is_the_sum*",
    ),
    "test_docs.py": tuple(
        f"what_a_document_says_can_be_done[[]{page}]"
        for page in (
            "analysis",
            "body_pairs",
            "crystals",
            "extending",
            "five_minutes",
            "mixtures",
            "molecule",
            "normal_modes",
            "npt",
            "pictures",
            "slab",
            "studies",
            "tables",
            "top",
            "water",
        )
    ),
    "test_coupling.py": ("a_sweep_has_a_free_energy",),
    "test_dynamics.py": (
        "a_smooth_cut_off_leaves_every_scheme_its_order_in_the_liquid[[]chin_4a*",
        "adding_an_integrator_*",
    ),
    "test_engine_settings.py": ("adding_an_engine_takes_a_folder_and_a_file",),
    "test_ewald.py": (
        "lennard_jones_and_real_space_end_apart*",
        "total_does_not_depend_on_how_it_is_split*",
        "total_momentum_is_taken_out_at_steps_that_the_scene_decides",
        "waves_of_a_cell_that_a_file_describes_otherwise",
    ),
    "test_fault_driver.py": ("runs_survive_mixed_faults",),
    "test_faults.py": ("a_run_that_is_stopped_by_signals_goes_on*",),
    "test_fields.py": ("adding_a_field_*",),
    "test_forces.py": (
        "a_list_with_almost_no_skin_is_built_at_every_step[[]mixed*",
        "energies_are_those_of_the_oracle[[]smooth_switch*",
        "energies_are_those_of_the_oracle[[]switch*",
        "everything_follows_a_cell_that_changes[[]ewald*",
        "slanted_boxes*",
        "a_list_with_little_room_grows_and_misses_nothing[[]mixed]",
        "adding_a_pair_potential_takes_two_files",
        "energies_are_those_of_the_oracle[[]force_switch*",
        "energies_are_those_of_the_oracle[[]plain*",
        "molecules_millions_of_cells_away*",
    ),
    "test_fuzz.py": ("all_that_is_changed_is_valid*",),
    "test_notebook.py": ("the_tutorial_runs", "the_tutorial_shows_what_it_says"),
    "test_properties.py": ("any_small_scene_of_one_kind_runs_ten_steps_or_is_refused_in_words",),
    "test_python.py": ("an_editor_knows_the_types",),
    "test_resume.py": (
        "a_run_that_is_killed_goes_on[[]2*",
        "a_run_that_is_stopped_ends_like_one_that_is_not",
    ),
    "test_run.py": (
        "a_look_takes_the_energies_of_the_last_step[[]cell*",
        "a_look_takes_the_energies_of_the_last_step[[]piston*",
        *(
            f"every_system_runs_a_few_steps[[]{name}]"
            for name in (
                "dry_ice",
                "tip4p2005",
                "water_from_structure",
                "water_npt",
                "water_pme",
                "water_slab",
            )
        ),
        "the_scene_that_a_run_writes_holds_every_number_it_used[[]pme]",
    ),
    "test_simd.py": (
        "mixed_precision_costs_less_than_a_hundred_thousandth*switch*",
        "the_narrowest_vectors*",
        "the_same_bits_for_any_number_of_threads[[]mixed]",
    ),
    "test_stability.py": ("quick*",),
    "test_strangers.py": ("analyses_execute_and_obey_nothing*",),
    "test_sweep.py": ("energy_at_a_step_of_zero_has_a_joint_fit*",),
    "test_threads.py": ("simulations_on_all_threads_at_once_have_the_bits_of_each_alone",),
    "test_trajectory_structures.py": ("a_run_goes_on_from_a_trajectory",),
    "test_user_code.py": (
        "a_table_in_a_file_is_the_potential_that_it_lists*",
        "every_example_of_an_extension_runs_and_is_short*",
    ),
    "test_virial.py": ("steep_spherocylinders_tend_to_hard_ones",),
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

_skipped: list[str] = []


@pytest.hookimpl(tryfirst=True)  # before tests are selected by their markers
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long files come first; variants are marked; a test of the soak tier has no limit of time."""
    items.sort(key=lambda item: RANKS.get(item.path.name, len(RANKS)))
    for item in items:
        if item.get_closest_marker("soak"):
            item.add_marker(pytest.mark.timeout(0))
        elif is_extended(item.path.name, item.name):
            item.add_marker(pytest.mark.extended)


def is_extended(file: str, name: str) -> bool:
    """Whether a test is a variant of the second tier."""
    name = name.removeprefix("test_")
    return any(fnmatchcase(name, pattern) for pattern in EXTENDED.get(file, ()))


def _note(report: pytest.TestReport | pytest.CollectReport) -> None:
    if not report.skipped or hasattr(report, "wasxfail") or not isinstance(report.longrepr, tuple):
        return
    path, _, reason = report.longrepr
    if not any(re.match(allowed, reason.removeprefix("Skipped: ")) for allowed in ALLOWED):
        _skipped.append(f"{report.nodeid or Path(path).name}: {reason}")


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Note a test that was skipped for a reason that is not allowed."""
    _note(report)


def pytest_collectreport(report: pytest.CollectReport) -> None:
    """Note a file that was skipped for a reason that is not allowed."""
    _note(report)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """In CI a session with such skips has failed."""
    if IN_CI and _skipped and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter) -> None:
    """In CI list them."""
    if IN_CI and _skipped:
        terminalreporter.section("skipped tests that CI does not allow (tests/hooks.py)", red=True)
        for line in sorted(set(_skipped)):
            terminalreporter.line(line)
