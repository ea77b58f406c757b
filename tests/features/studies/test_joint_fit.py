"""Energy and volume at a step of 0 together: `features/studies/joint_fit.py`."""

import numpy as np
import pytest
from scipy.signal import lfilter

from rigidmd import Scene, Simulation
from rigidmd.assemble.build import build
from rigidmd.features.studies.extrapolation import extrapolate
from rigidmd.features.studies.joint_fit import (
    BALANCE,
    DENSITY,
    MEAN_SQUARE,
    POTENTIAL,
    VOLUME,
    RunResults,
    fit_jointly,
    results_of_run,
    results_of_samples,
    slope_name,
)
from rigidmd.features.studies.step_bias import (
    BAR_NM3,
    GAS_CONSTANT,
    Conditions,
    Series,
    conditions,
)
from rigidmd.features.studies.sweep.limits import JOINT, Limit
from rigidmd.run.record import read_record

#: Atoms on springs of one frequency (rad/ps), each about a lattice point that moves with the box, and an
#: energy of the volume for which U + pV is quadratic in it.
COUNT, TEMPERATURE, PRESSURE, OMEGA = 20, 120.0, 400.0, 10.0
ALL = COUNT + 5  # with frozen atoms
FREEDOM = 3 * COUNT
THERMAL = GAS_CONSTANT * TEMPERATURE
STEPS = (6.0, 10.0, 14.0)
VOLUME_MEAN, VOLUME_SIZE = 3.0, 0.1
#: Barostat or none, `kinetic_correction` of the scheme, whether the barostat reads momenta.
KINDS = [(True, 0.0, True), (True, 0.0, False), (True, 1 / 8, True), (True, 1 / 8, False)]
KINDS += [(False, 0.0, False), (False, 1 / 8, False)]


def conditions_at(step, has_barostat, correction=0.0, reads_kinetic=True):
    """step : fs"""
    pressure = PRESSURE * BAR_NM3 if has_barostat else 0.0
    common = TEMPERATURE, pressure, ALL, COUNT, (FREEDOM, 0), 1 / 12, -1 / 24, correction
    return Conditions(1e-3 * step, *common, has_barostat, reads_kinetic)


def results_of(at, potential, volume, density, kinetic, squares):
    """Results of samples (l,), with the kinetic energy at the ends of steps."""
    nothing = np.zeros(len(potential))
    kinetic = kinetic + at.correction * at.step**2 * squares
    both = (kinetic, nothing), (squares, nothing)
    return results_of_samples(density, Series(potential, volume, *both, nothing, 0.1), at)


def energies_at(at):
    """Energies of the springs and of momenta at the ends of steps, over those without a step: exact
    for velocity Verlet and BAOAB."""
    x = (OMEGA * at.step) ** 2
    return (1 / (1 - x / 4), 1.0) if at.correction == 0.0 else (1.0, 1 - x / 4)


def shift_of_volume(at):
    """Of the mean volume: the barostat balances the springs against N kT or against the momenta."""
    springs, momenta = energies_at(at)
    excess = springs - (momenta if at.reads_kinetic else 1.0)
    return -COUNT * excess * VOLUME_SIZE**2 / VOLUME_MEAN


def slopes(has_barostat, correction, reads_kinetic):
    """d<A>/d(dt²) of U per molecule, V and the density, per fs²."""
    short = conditions_at(0.1, has_barostat, correction, reads_kinetic)
    volume = shift_of_volume(short) / 0.1**2 if has_barostat else 0.0
    springs = (energies_at(short)[0] - 1) / 0.1**2
    potential = 0.5 * FREEDOM * THERMAL * springs - short.pressure * volume
    return np.array([potential / ALL, volume, -0.8 * volume / VOLUME_MEAN])


def sampled(rng, step, has_barostat, samples, correction=0.0, reads_kinetic=True):
    """Results of a run."""
    at = conditions_at(step, has_barostat, correction, reads_kinetic)
    keep, warm = 0.8, 50
    noise = np.sqrt(1 - keep**2) * rng.standard_normal((samples + warm, 2 * FREEDOM + 1))
    series = lfilter([1.0], [1.0, -keep], noise, axis=0)[warm:].T
    of_springs, of_momenta = energies_at(at)
    springs = 0.5 * THERMAL * of_springs * (series[:FREEDOM] ** 2).sum(axis=0)
    kinetic = 0.5 * THERMAL * of_momenta * (series[FREEDOM:-1] ** 2).sum(axis=0)
    volume = density = energy = np.zeros(samples)
    if has_barostat:
        change = shift_of_volume(at) + VOLUME_SIZE * series[-1]
        volume = VOLUME_MEAN + change
        density = 0.8 * VOLUME_MEAN / volume
        energy = 0.5 * THERMAL * (change / VOLUME_SIZE) ** 2 - at.pressure * change
    squares = 2 * OMEGA**2 * springs
    return results_of(at, springs + energy, volume, density, kinetic, squares)


@pytest.mark.parametrize(("has_barostat", "correction", "reads_kinetic"), KINDS)
def test_slopes_and_their_errors_are_those_of_springs(has_barostat, correction, reads_kinetic):
    """The slopes and the responses that fluctuations predict, and their errors against their scatter
    over runs."""
    rng = np.random.default_rng(5)
    names = map(slope_name, (POTENTIAL, VOLUME, DENSITY)[: 3 if has_barostat else 1])
    expected = dict(zip(names, slopes(has_barostat, correction, reads_kinetic), strict=False))
    expected |= responses_of_springs(has_barostat)
    runs = [sampled(rng, 6.0, has_barostat, 1000, correction, reads_kinetic) for _ in range(100)]
    for name, value in expected.items():
        values = np.array([run.values[name] for run in runs])
        errors = np.array([run.errors[name] for run in runs])
        scatter = values.std(ddof=1)
        assert abs(values.mean() - value) < 4 * scatter / np.sqrt(len(runs)), name
        assert scatter / np.sqrt(len(runs)) < 0.01 * value or value <= 0 or "slope" in name, name
        assert 0.7 < np.sqrt((errors**2).mean()) / scatter < 1.4, name


@pytest.mark.parametrize(
    ("has_barostat", "correction", "reads_kinetic", "steps", "replicas"),
    [
        (True, 0.0, True, STEPS, 4),
        (True, 1 / 8, False, STEPS[:2], 5),
        (False, 0.0, False, STEPS, 4),
        (False, 1 / 8, False, STEPS[:2], 6),
    ],
)
def test_pulls_of_joint_limits_have_unit_width(
    has_barostat, correction, reads_kinetic, steps, replicas
):
    """(limit - truth)/error of limits, with the errors of independent fits or smaller ones; slopes
    and responses agree with theory."""
    rng, relative = np.random.default_rng(7), VOLUME_SIZE / VOLUME_MEAN
    truth = {
        POTENTIAL: 0.5 * THERMAL * (FREEDOM + has_barostat) / ALL,
        VOLUME: VOLUME_MEAN,
        DENSITY: 0.8 * (1 + relative**2 + 3 * relative**4),
    }
    pulls, ratios, of_slopes, responses = {}, {}, [], {}
    expected = slopes(has_barostat, correction, reads_kinetic)
    for _ in range(60):
        runs = {
            step: [
                sampled(rng, step, has_barostat, 400, correction, reads_kinetic)
                for _ in range(replicas)
            ]
            for step in steps
        }
        found = fit_jointly(runs)
        assert [*found.joint] == [*truth][: 3 if has_barostat else 1]
        for name, (points, fit) in found.joint.items():
            pulls.setdefault(name, []).append((fit.limit - truth[name]) / fit.limit_error)
            alone = extrapolate(points)
            if alone.longest == fit.longest:
                ratios.setdefault(name, []).append(fit.limit_error / alone.limit_error)
        slope, error = found.joint[POTENTIAL][1].slopes[""]
        of_slopes.append((slope - expected[0]) / error)
        for name, (_, fit) in found.responses.items():
            responses.setdefault(name, []).append(fit.limit)
    for name, values in pulls.items():
        assert abs(np.mean(values)) < 0.4, name
        assert 0.7 < np.std(values) < 1.35, name
        assert max(ratios[name]) <= 1, name
        assert np.mean(ratios[name]) < 0.8, name
    assert 0.7 < np.sqrt(np.mean(np.square(of_slopes))) < 1.4
    for name, value in responses_of_springs(has_barostat).items():
        error = np.std(responses[name]) / np.sqrt(len(responses[name]))
        assert abs(np.mean(responses[name]) - value) < 4 * error, name
        assert value == 0 or error < 0.2 * value, name


def responses_of_springs(has_barostat):
    """Half of the gas constant for each square in U + pV and in the kinetic energy."""
    capacity = 1e3 * GAS_CONSTANT * (2 * FREEDOM + has_barostat) / 2 / COUNT
    if not has_barostat:
        return {"c_v (J/(mol K))": capacity}
    kappa = VOLUME_SIZE**2 / THERMAL / VOLUME_MEAN * BAR_NM3
    return {"c_p (J/(mol K))": capacity, "kappa_T (1/bar)": kappa, "alpha_p (1/K)": 0.0}


@pytest.mark.parametrize(("correction", "bias"), [(0.0, 1 / 8), (1 / 8, 0.0)])
def test_springs_have_the_bias_of_theory(correction, bias):
    """Molecules on springs, of one frequency, as velocity Verlet and BAOAB sample them: the bias
    of U is (ω dt)²/8 and 0 kT per degree of freedom."""
    rng, steps, runs = np.random.default_rng(11), (5.0, 10.0, 20.0), {}
    omega = 20.0  # rad/ps
    for step in steps:
        x = (1e-3 * step * omega) ** 2
        hotter = 1 / (1 - x / 4) if correction == 0.0 else 1.0  # positions
        potential = 0.5 * THERMAL * hotter * rng.chisquare(FREEDOM, 4000)
        kinetic = 0.5 * THERMAL * hotter * (1 - x / 4) * rng.chisquare(FREEDOM, 4000)
        squares = 2 * omega**2 * potential
        nothing = np.zeros(4000)
        at = conditions_at(step, False, correction)
        runs[step] = [results_of(at, potential, nothing, nothing, kinetic, squares)]
        assert runs[step][0].values[MEAN_SQUARE] == pytest.approx(x, rel=0.06)
        expected = bias * omega**2 * 1e-6 * FREEDOM * THERMAL / ALL
        slope, error = (
            getattr(runs[step][0], kind)[slope_name(POTENTIAL)] for kind in ("values", "errors")
        )
        next_term = 0.5 * x * omega**2 / 8 * 1e-6 * FREEDOM * THERMAL / ALL
        assert abs(slope - expected) < 4 * error + next_term
        assert error < 0.1 * omega**2 / 8 * 1e-6 * FREEDOM * THERMAL / ALL
    _, fit = fit_jointly(runs).joint[POTENTIAL]
    assert abs(fit.limit - 0.5 * THERMAL * FREEDOM / ALL) < 4 * fit.limit_error


def test_errors_of_responses_go_with_the_root_of_the_number_of_samples():
    """Single runs of two lengths, which both contribute to the errors."""
    rng, counts = np.random.default_rng(3), (1000, 4000)
    runs = {
        step: [sampled(rng, step, True, count)] for step, count in zip(STEPS, counts, strict=False)
    }
    for name, (points, _) in fit_jointly(runs).responses.items():
        alone = [run.errors[name] for (run,) in runs.values()]
        common = np.sqrt(np.mean(np.array(counts) * np.square(alone)))
        found = [point.error for point in points]
        assert found == pytest.approx(common / np.sqrt(counts), rel=1e-9), name


def test_means_that_no_fit_describes_make_the_error_of_a_limit_larger():
    """A kinetic energy that is off by ten times its error has a chi² far above 1. The bias at a step
    has the error of its slope."""
    run = sampled(np.random.default_rng(4), STEPS[0], True, 1000)
    fits = []
    for off in (0.0, 10.0):
        values = run.values | {BALANCE: off * run.errors[BALANCE]}
        joint = fit_jointly({STEPS[0]: [run._replace(values=values)]}).joint
        fits.append([joint[name][1] for name in (POTENTIAL, VOLUME)])
    fit, step = fits[0][0], STEPS[1]
    bias = Limit({}, "baoab", POTENTIAL, [], fit, JOINT).bias(step)
    assert bias == pytest.approx(np.array(fit.slopes[""]) * step**2)
    for plain, scaled in zip(*fits, strict=True):
        assert (plain.freedom, plain.chi2 < 1) == (1, True)
        assert scaled.chi2 > 10
        assert scaled.limit_error == pytest.approx(plain.limit_error * np.sqrt(scaled.chi2))


def stage_of(**keys):
    scene = {
        "box": {"lengths_A": 30.0},
        "molecules": [{"model": "argon", "count": 4}],
        "start": {"temperature_K": 90.0},
        "stages": [{"duration_ps": 1.0, "timestep_fs": 5.0} | keys],
    }
    system = build(Scene.from_dict(scene))
    return system, system.scene.stages[0]


NVT = {"ensemble": "nvt", "temperature_K": 90.0}
NPT = {"ensemble": "npt", "temperature_K": 90.0, "pressure_bar": 1.0}


@pytest.mark.parametrize(
    ("keys", "reason"),
    [
        (NVT, ""),
        (NVT | {"integrator": "baoab"}, ""),
        (NPT, ""),
        (NPT | {"barostat": "monte_carlo"}, ""),
        ({}, "it is for nvt and npt, and the stage is nve"),
        (NVT | {"temperature_K": [90.0, 100.0]}, "temperature or pressure change"),
        (NVT | {"thermostat": "hybrid_monte_carlo"}, "has no time-step error"),
        (NVT | {"integrator": "position_verlet"}, ""),
        (NPT | {"integrator": "position_verlet"}, "the integrator is position_verlet"),
        (NVT | {"integrator": "srkn_4"}, "srkn_4 has 4"),
        (NPT | {"pressure_coupling": "anisotropic"}, "not 'isotropic'"),
    ],
)
def test_stages_without_a_joint_fit_have_a_reason(keys, reason):
    found = conditions(*stage_of(**keys))
    assert isinstance(found, str) is bool(reason)
    assert reason in str(found)


def test_a_log_without_squares_of_forces_has_a_reason(tmp_path):
    scene = {
        "box": {"lengths_A": 30.0},
        "molecules": [{"model": "argon", "count": 100}],
        "start": {"temperature_K": 90.0},
        "stages": [NVT | {"duration_ps": 1.0, "timestep_fs": 10.0}],
        "output": {"figures": False},
    }
    Simulation(Scene.from_dict(scene), tmp_path / "run").run(progress=False)
    record = read_record(tmp_path / "run")
    assert isinstance(results_of_run(record), RunResults)
    del record.columns["force_squares"]
    assert "the log has no F^2/m" in results_of_run(record)


def test_runs_that_are_too_short_have_no_limit():
    rng = np.random.default_rng(2)
    for samples in (5, 15):
        runs = {step: [sampled(rng, step, False, samples)] for step in STEPS}
        assert fit_jointly(runs) == ({}, {})


@pytest.mark.soak
def test_limits_of_nitrogen(tmp_path):
    """Twenty times four runs of 80 ps at three steps: pulls, and the mean of the limits against
    runs at a short step."""
    found = {}
    for repetition in range(20):
        runs = {
            step: [nitrogen(tmp_path, step, 80.0, 100 * repetition + 10 * k + 1) for k in range(4)]
            for step in (16.0, 24.0, 32.0)
        }
        for name, (points, fit) in fit_jointly(runs).joint.items():
            alone = extrapolate(points)
            found.setdefault(name, []).append((*fit[:2], *alone[:2], fit.longest == alone.longest))
    short = [nitrogen(tmp_path, 8.0, 1000.0, 5000 + k) for k in range(4)]
    for name, results in found.items():
        limits, errors, alone, errors_alone, same_steps = np.array(results).T
        pulls = (limits - limits.mean()) / errors
        values = np.array([run.values[name] for run in short])
        truth = values.mean() - 64.0 * np.mean([run.values[slope_name(name)] for run in short])
        error = np.hypot(values.std(ddof=1) / 2, limits.std(ddof=1) / np.sqrt(20))
        print(
            f"{name}: pulls {pulls.std(ddof=1):.2f}; mean {limits.mean():.5g}, alone"
            f" {alone.mean():.5g}, at 8 fs {truth:.5g} ± {error:.2g}; errors"
            f" {errors.mean():.2g}, alone {errors_alone.mean():.2g}"
        )
        assert 0.7 < pulls.std(ddof=1) < 1.4, name
        smaller = errors < errors_alone
        assert smaller[same_steps == 1].all(), name
        assert smaller.mean() > 0.7, name
        assert abs(limits.mean() - truth) < 3.5 * error, name


def nitrogen(folder, step, duration, seed):
    """Results of 32 molecules of nitrogen at 90 K and 500 bar."""
    at = {"temperature_K": 90.0, "timestep_fs": step}
    scene = {
        "seed": seed,
        "box": {"density_g_cm3": 0.85},
        "molecules": [{"model": "nitrogen", "count": 32}],
        "forces": {"cutoff_A": 5.5},
        "start": {"temperature_K": 90.0},
        "stages": [
            at
            | {"ensemble": "npt", "pressure_bar": 500.0, "barostat": "monte_carlo"}
            | {"duration_ps": time}
            for time in (10.0, duration)
        ],
        "output": {"log_interval_ps": 0.096, "figures": False, "trajectory": False},
    }
    where = folder / f"{step:g}_{seed}"
    Simulation(Scene.from_dict(scene), where).run(progress=False)
    return results_of_run(read_record(where))
