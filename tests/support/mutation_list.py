"""Small errors in the physics that tests must find: what `mutations.py` applies, one at a time.

A mutation replaces a text that occurs exactly once in a file, and names the tests that should fail
then. Each has been seen to survive tests once, or is as subtle as one that has. `test_mutations.py`
keeps the texts up to date.
"""

from typing import NamedTuple


class Mutation(NamedTuple):
    """A change of one position in the sources that no test may overlook."""

    name: str
    sentence: str  # what is wrong then
    file: str  # below rigidmd/
    old: str
    new: str
    tests: tuple[str, ...]  # FILE::TEST below tests/, most likely first


CORE = [
    Mutation(
        "A1",
        "torque of a body: the sign of one product of its z component",
        "forces/neighbors/sites.py",
        "            turn_z += x * by - y * bx",
        "            turn_z += x * by + y * bx",
        ("forces/test_terms.py::test_forces_and_torques_are_the_slope_of_the_energy[shift]",),
    ),
    Mutation(
        "A2",
        "force of a switched potential: k for k + 1 in the slope of the switch",
        "forces/potentials/truncation.py",
        "    slope = (k + 1) * series[0] * left**k / width",
        "    slope = k * series[0] * left**k / width",
        (
            "forces/potentials/test_truncation.py::test_a_switched_force_is_that_of_the_product[switch-5.0]",
        ),
    ),
    Mutation(
        "A3",
        "virial of the surface dipole: its part of the volume along one axis alone",
        "forces/ewald/corrections.py",
        "        for k in (0, 1, 5, 9):\n            tally[k] += energy\n        for i in range(len(term.charge)):",
        "        for k in (0, 1):\n            tally[k] += energy\n        for i in range(len(term.charge)):",
        (
            "forces/ewald/test_interactions.py::test_virial_is_the_slope_of_the_energy_with_the_volume[method1-2.0-90.0]",
        ),
    ),
    Mutation(
        "A4",
        "molecular virial: the transpose of its tensor",
        "forces/neighbors/sites.py",
        "                    virial[block, 3 * row + k] += force[row] * offset[k]",
        "                    virial[block, 3 * row + k] += force[k] * offset[row]",
        ("forces/test_terms.py::test_virials_are_sums_over_pairs[triclinic-double]",),
    ),
    Mutation(
        "A5",
        "textbook solvers: the sign of the Coriolis term of the velocity",
        "features/bodies/ode/rates.py",
        "- W[i] * V[j] + W[j] * V[i]",
        "+ W[i] * V[j] - W[j] * V[i]",
        (
            "features/bodies/test_frames.py::test_a_frame_that_changes_its_axis_is_left_to_compositions",
        ),
    ),
    Mutation(
        "A6",
        "textbook solvers: the growth of the moments of inertia is left out",
        "features/bodies/ode/rates.py",
        "L[i] * y[n + j] - L[j] * y[n + i] - motor - growth * y[n + k]",
        "L[i] * y[n + j] - L[j] * y[n + i] - motor",
        (
            "features/bodies/test_ode.py::test_a_satellite_that_loses_mass_keeps_its_angular_momentum",
        ),
    ),
    Mutation(
        "A7",
        "a frame that spins up: its rate at the start of a step, not in the middle",
        "features/bodies/translation.py",
        "frame_rate(frame, time + 0.5 * h)",
        "frame_rate(frame, time)",
        (
            "features/bodies/test_frames.py::test_a_changing_or_accelerating_frame_agrees_with_one_that_does_not_rotate",
        ),
    ),
    Mutation(
        "A8",
        "mean squared displacement: one origin too few",
        "features/analysis/built_in/transport.py",
        "/ (frames - lag) / n",
        "/ (frames - lag - 1) / n",
        ("features/analysis/test_built_in.py::test_correlations_are_those_of_the_definition",),
    ),
    Mutation(
        "A9",
        "viscosity: the differences of normal stresses are not halved",
        "features/analysis/built_in/transport.py",
        "(xx - yy) / 2, (yy - zz) / 2], axis=1)",
        "(xx - yy), (yy - zz)], axis=1)",
        (
            "features/analysis/test_transport.py::test_the_viscosity_is_the_integral_of_the_stress_and_its_error_honest",
        ),
    ),
    Mutation(
        "A10",
        "LAMMPS data file: xz and yz of the box exchanged",
        "features/external/lammps/files.py",
        "        tilt = (state.cell[1, 0], state.cell[2, 0], state.cell[2, 1])",
        "        tilt = (state.cell[1, 0], state.cell[2, 1], state.cell[2, 0])",
        ("features/external/test_lammps.py::test_both_engines_compute_the_same[triclinic]",),
    ),
    Mutation(
        "A11",
        "errors over runs: the standard deviation without n - 1",
        "core/statistics.py",
        "    return np.std(np.asarray(values, float), axis=0, ddof=1)",
        "    return np.std(np.asarray(values, float), axis=0, ddof=0)",
        (
            "features/studies/sweep/test_table.py::test_a_row_has_the_error_over_its_runs_or_that_of_its_only_run",
        ),
    ),
    Mutation(
        "A12",
        "dielectric constant: <M>², which is 0, is taken off",
        "features/analysis/built_in/rotation.py",
        "    centre = np.zeros(3)",
        "    centre = runs.mean([M.mean(axis=0) for M in dipoles])",
        (
            "features/analysis/test_rotation.py::test_the_dielectric_constant_of_independent_dipoles",
            "features/analysis/test_rotation.py::test_a_dielectric_constant_has_no_bias_of_short_runs",
        ),
    ),
]

RINGS = [
    Mutation(
        "B1",
        "Monte Carlo barostat: a scene passes N + 1 for N",
        "assemble/build.py",
        "float(mobile(system.model).sum()),",
        "float(mobile(system.model).sum()) + 1.0,",
        ("assemble/test_build.py::test_a_monte_carlo_barostat_counts_the_molecules",),
    ),
    Mutation(
        "B2",
        "Monte Carlo barostat: N + 1 in the rule of acceptance",
        "dynamics/barostats/monte_carlo.py",
        "    return barostat.molecules * log(after / before)",
        "    return (barostat.molecules + 1) * log(after / before)",
        (
            "assemble/test_build.py::test_a_change_of_the_volume_is_accepted_by_the_power_of_the_number_of_molecules",
            "forces/neighbors/test_lists.py::test_an_ideal_gas_has_its_volumes_through_a_whole_run",
        ),
    ),
    Mutation(
        "B3",
        "Nose-Hoover: degrees of freedom of translation for those of rotation",
        "dynamics/thermostats/nose_hoover.py",
        'int(stage.thermostat_values["nose_hoover_links"]), freedom.translation, freedom.rotation',
        'int(stage.thermostat_values["nose_hoover_links"]), freedom.translation, freedom.translation',
        ("assemble/test_build.py::test_chains_count_the_degrees_of_freedom_of_their_motion",),
    ),
    Mutation(
        "B4",
        "Langevin: frictions of translation and rotation exchanged",
        "dynamics/thermostats/langevin.py",
        "Langevin(thermal_energy, *stage.thermostat_values.values(), key)",
        "Langevin(thermal_energy, *list(stage.thermostat_values.values())[::-1], key)",
        ("assemble/test_build.py::test_langevin_has_the_friction_of_each_motion",),
    ),
    Mutation(
        "B5",
        "pressure ramp: the first pressure is kept",
        "dynamics/barostats/__init__.py",
        "    return pressure.first[k] + (pressure.last[k] - pressure.first[k]) * fraction",
        "    return pressure.first[k] + 0.0 * fraction",
        (
            "assemble/test_build.py::test_a_ramp_is_even_over_the_steps_of_its_stage",
            "assemble/test_build.py::test_what_drives_the_cell_follows_a_ramp_of_the_pressure",
        ),
    ),
    Mutation(
        "B6",
        "tail correction of a mixture: unlike pairs once, not twice",
        "forces/potentials/lennard_jones.py",
        "        strength = sign * count @ c @ count",
        "        strength = sign * count @ np.triu(c) @ count",
        (
            "features/analysis/test_mixtures.py::test_the_tail_of_a_mixture_is_a_sum_over_all_pairs_of_its_sites",
        ),
    ),
    Mutation(
        "B7",
        "spectra: 33.36 for 29.98 in the wave number",
        "features/analysis/built_in/rotation.py",
        "PER_CM = 0.0299792458",
        "PER_CM = 0.0333564095",
        ("features/analysis/test_mixtures.py::test_wave_numbers_and_freedoms_of_a_mixture",),
    ),
    Mutation(
        "B8",
        "rotational diffusion: rotations about axes of the lab, not of the body",
        "features/analysis/built_in/rotation.py",
        'between = np.einsum("fnji,fnjk->fnik", Q[:-1], Q[1:])',
        'between = np.einsum("fnij,fnkj->fnik", Q[1:], Q[:-1])',
        (
            "features/analysis/test_mixtures.py::test_an_anisotropic_body_diffuses_about_its_own_axes",
        ),
    ),
    Mutation(
        "B9",
        "n(r) of a mixture: divided by the number of the other species",
        "features/analysis/built_in/structure.py",
        "len(thinned.first.sites(a, slice(0, 1))[1])",
        "len(thinned.first.sites(b, slice(0, 1))[1])",
        (
            "features/analysis/test_mixtures.py::test_pairs_of_a_mixture_are_counted_against_the_pairs_that_there_are",
        ),
    ),
    Mutation(
        "B10",
        "spectrum of linear molecules: twice as high",
        "features/analysis/built_in/rotation.py",
        "moments[2], lambda part, group: _lab_momenta",
        "2 * moments[2], lambda part, group: _lab_momenta",
        ("features/analysis/test_mixtures.py::test_wave_numbers_and_freedoms_of_a_mixture",),
    ),
    Mutation(
        "B11",
        "error of a drift: the random walk too small by a third",
        "core/statistics.py",
        "    walk = max(0.0, 3 * (slow * long - fast * short)",
        "    walk = max(0.0, 2 * (slow * long - fast * short)",
        ("core/test_statistics.py::test_the_error_of_a_slope_is_as_large_as_its_scatter",),
    ),
    Mutation(
        "B12",
        "standard errors of means forget the correlation of samples",
        "core/statistics.py",
        "    return average, sqrt(max(window, BATCH_FACTOR * _batch_variance(centred)) / variance_fraction / n)",
        "    return average, sqrt(variance / n)",
        ("core/test_statistics.py::test_the_error_of_a_mean_is_as_large_as_its_scatter",),
    ),
    Mutation(
        "B13",
        "temperatures at constant energy: the time-step error twice",
        "core/integrators.py",
        "        return (1 / 6 - moment) / 2",
        "        return 1 / 6 - moment",
        (
            "dynamics/test_thermostats.py::test_kinetic_energies_are_corrected_by_the_scheme",
            "features/studies/accuracy/test_averages.py::test_the_step_takes_from_the_kinetic_energy_at_its_ends",
        ),
    ),
    Mutation(
        "B14",
        "start: the total momentum of a mixture is removed with equal weights",
        "dynamics/model.py",
        "    velocity -= momentum / mass.sum()",
        "    velocity -= np.where(model.keeps_momentum, velocity.mean(axis=0), 0.0)",
        (
            "assemble/test_build.py::test_a_mixture_starts_at_rest_and_at_its_temperature",
            "assemble/test_build.py::test_a_push_that_is_taken_out_is_the_same_for_all_molecules",
        ),
    ),
    Mutation(
        "B15",
        "run: the total momentum is removed with the mass of the first species for all",
        "dynamics/step_rows.py",
        "        m_i = model.mass[model.species[m]]\n        mass += m_i",
        "        m_i = model.mass[0]\n        mass += m_i",
        ("assemble/test_build.py::test_a_mixture_is_brought_to_rest_by_one_velocity_for_all",),
    ),
    Mutation(
        "B16",
        "LAMMPS: pressures in bar where it reads atm",
        "features/external/lammps/files.py",
        "ATMOSPHERE = 1.01325 * BAR",
        "ATMOSPHERE = 1.0 * BAR",
        (
            "features/external/test_settings.py::test_lammps_has_pressures_in_atm_less_that_of_the_tail",
        ),
    ),
    Mutation(
        "B17",
        "LAMMPS: the damping time of Langevin is the friction",
        "features/external/lammps/files.py",
        "{_num(1e3 / friction)}",
        "{_num(1e3 * friction)}",
        ("features/external/test_settings.py::test_lammps_has_the_damping_time_of_langevin",),
    ),
    Mutation(
        "B18",
        "GROMACS: tau-t ten times as long",
        "features/external/gromacs/files.py",
        '"tau-t": f"{stage.thermostat_time:.12g}"',
        '"tau-t": f"{10 * stage.thermostat_time:.12g}"',
        ("features/external/test_settings.py::test_gromacs_has_the_time_of_each_thermostat",),
    ),
    Mutation(
        "B19",
        "OpenMM: the inverse of the friction of Langevin",
        "features/external/openmm/system.py",
        "mm.LangevinMiddleIntegrator(stage.temperatures[0], friction, dt)",
        "mm.LangevinMiddleIntegrator(stage.temperatures[0], 1 / friction, dt)",
        ("features/external/test_settings.py::test_openmm_has_the_friction_of_langevin",),
    ),
    Mutation(
        "B20",
        "resume: Nose-Hoover chains and pistons start anew",
        "run/resume.py",
        "    if (np.isfinite(state.cell) != np.isfinite(like.cell)).any():",
        "    state.extra_variables[:] = 0.0\n    if (np.isfinite(state.cell) != np.isfinite(like.cell)).any():",
        (
            "io/test_checkpoint.py::test_a_checkpoint_gives_back_all_of_a_state",
            "run/test_resume.py::test_chains_resume_to_the_same_bits_in_double_precision",
        ),
    ),
    Mutation(  # harmless within a run, whose steps count on; a stage that is run alone would repeat the numbers
        "B21",
        "random numbers of every stage are those of the first",
        "assemble/build.py",
        "    key = noise.key_of(system.scene.seed, noise.THERMOSTAT, k)",
        "    key = noise.key_of(system.scene.seed, noise.THERMOSTAT, 0)",
        ("assemble/test_build.py::test_stages_have_random_numbers_of_their_own",),
    ),
    Mutation(
        "B22",
        "profile of the density: sites are not rotated with their molecule",
        "features/analysis/built_in/structure.py",
        "                at = at + part.Q[:, kind.index] @ kind.molecule.positions_body[site]",
        "                at = at + kind.molecule.positions_body[site]",
        (
            "features/analysis/test_mixtures.py::test_the_profile_of_a_mixture_is_that_of_its_rotated_sites",
        ),
    ),
    Mutation(
        "B23",
        "hydrogen bonds: O-H is not rotated with its molecule",
        "features/analysis/built_in/structure.py",
        "arm[k] = rotation @ (body[hydrogen] - body[site])",
        "arm[k] = body[hydrogen] - body[site]",
        (
            "features/analysis/test_mixtures.py::test_hydrogen_bonds_of_a_mixture_are_those_of_its_geometry",
        ),
    ),
    Mutation(  # misses a pair only where cutoff and skin nearly fill the box; the test pins the documented quarter too
        "B24",
        "neighbour list: images of a changed cell may move 2.4 times as far",
        "forces/neighbors/update.py",
        "    return 0.25 * pairs.skin if is_short else 0.0",
        "    return 0.6 * pairs.skin if is_short else 0.0",
        (
            "forces/neighbors/test_lists.py::test_one_list_has_all_pairs_of_a_cell_that_is_strained[angles0]",
        ),
    ),
    Mutation(
        "B25",
        "cell rescaling with Langevin counts as if the total momentum were kept",
        "engines/system.py",
        "        return self.model.keeps_momentum & (k is None or self.keeps_momentum_in(k))",
        "        return self.model.keeps_momentum | (k is None or self.keeps_momentum_in(k))",
        ("assemble/test_build.py::test_cell_rescaling_knows_whether_the_total_momentum_is_kept",),
    ),
    Mutation(
        "R-hmc-1",
        "hybrid Monte Carlo: the sign of the change of the energy in the test",
        "features/monte_carlo/trajectories.py",
        "    if log(u) < -loss:",
        "    if log(u) < loss:",
        (
            "end_to_end/test_ensembles.py::test_dipoles_at_a_long_step_by_hybrid_monte_carlo[350.0-0.0008]",
        ),
    ),
    Mutation(
        "R-hmc-2",
        "hybrid Monte Carlo: a barostat takes the virial of a trajectory that was rejected",
        "features/monte_carlo/trajectories.py",
        "        known[0] = FORCES_ONLY",
        "        known[0] |= FORCES_ONLY",
        (
            "features/monte_carlo/test_trajectories.py::test_energy_less_heat_and_work_is_conserved[pressed1]",
        ),
    ),
    Mutation(
        "D1",
        "dispersion by Ewald sums: the virial of a k-vector",
        "forces/ewald/smooth.py",
        "3 * (fall - rest) /",
        "2 * (fall - rest) /",
        (
            "forces/ewald/test_dispersion.py::test_forces_torques_and_virial_are_slopes_of_the_energy[forces0-box0]",
        ),
    ),
    Mutation(
        "D2",
        "dispersion by Ewald sums: the sign of the shift of the pairs within the cutoff",
        "forces/potentials/lennard_jones.py",
        "    energy = polynomial(dispersion.screening.energy, t) - dispersion.shift",
        "    energy = polynomial(dispersion.screening.energy, t) + dispersion.shift",
        ("forces/ewald/test_dispersion.py::test_energy_is_conserved[None]",),
    ),
    Mutation(
        "D3",
        "dispersion by Ewald sums: each of two parts may have the whole error that is asked for",
        "forces/ewald/dispersion.py",
        "    part = _error(accuracy, species, counts) * sqrt(parts.filled / 2)",
        "    part = _error(accuracy, species, counts) * 2",
        ("forces/ewald/test_dispersion.py::test_forces_are_as_accurate_as_requested",),
    ),
    Mutation(
        "D4",
        "surface tension: the pressure along the normal is less that of all axes, not of those across",
        "features/analysis/built_in/interfaces.py",
        "0.5 * slab.height * 1.5 * (normal",
        "0.5 * slab.height * (normal",
        (
            "features/analysis/test_interfaces.py::test_the_surface_tension_is_half_the_box_times_the_difference_of_pressures",
        ),
    ),
    Mutation(
        "D5",
        "slab: the field of its dipole is that of a sphere along the normal",
        "forces/ewald/interactions.py",
        '(2 * pi if axis == forces.ewald_slab else 0.0 for axis in "xyz")',
        '(2 * pi / 3 if axis == forces.ewald_slab else 0.0 for axis in "xyz")',
        (
            "features/analysis/test_interfaces.py::test_charges_in_a_slab_do_not_depend_on_the_vacuum[z-molecules1]",
        ),
    ),
    Mutation(
        "D6",
        "responses: the total momentum that a run keeps at zero is missing in the heat capacity",
        "features/analysis/built_in/thermodynamics.py",
        "0.5 * BOLTZMANN * (3 * count + freedom.rotation)",
        "0.5 * BOLTZMANN * freedom.total",
        (
            "features/analysis/test_thermodynamics.py::test_an_ideal_gas_at_constant_volume_has_its_responses",
        ),
    ),
    Mutation(
        "D7",
        "responses: what the subtraction of means hides is not added",
        "features/analysis/built_in/thermodynamics.py",
        "covariances.T + self.hidden / fraction",
        "covariances.T + 0 * self.hidden / fraction",
        ("features/analysis/test_thermodynamics.py::test_a_mean_that_is_subtracted_hides_nothing",),
    ),
    Mutation(
        "D8",
        "responses: fluctuations at constant energy are those of the canonical ensemble",
        "features/analysis/built_in/thermodynamics.py",
        "factor = 1 / (1 - BOLTZMANN * of.xx / matter.counted)",
        "factor = 1 / (1 + BOLTZMANN * of.xx / matter.counted)",
        (
            "features/analysis/test_thermodynamics.py::test_constant_energy_has_the_responses_of_the_canonical_ensemble",
        ),
    ),
]
