"""Errors that runs report, compared with the scatter of their values over seeds. Minutes each: the
soak tier.

The pull is (value - truth)/error; its root mean square is 1 for an honest error. `pytest -m soak
-rP tests/end_to_end/test_reported_errors.py` prints what was measured.
"""

import numpy as np
import pytest

import rigidmd
from rigidmd import Scene, Simulation

pytestmark = pytest.mark.soak

SEEDS = 60
TEMPERATURE, PRESSURE = 120.0, 500.0
#: Limits of the root mean square of pulls, over all lengths, and fraction of pulls that may be
#: beyond 3.
LEAST, MOST, BEYOND = 0.8, 1.3, 0.025
#: The same for the pulls of one length, whose root mean square has an error of 9 %.
LEAST_OF_LENGTH, MOST_OF_LENGTH = 0.6, 1.5


def argon(seed, ensemble, durations, **output):
    """Results of 64 argon atoms with a stage of each duration (ps), at 120 K and 1.36 g/cm3, or 500
    bar."""
    stage = {"ensemble": ensemble, "temperature_K": TEMPERATURE, "timestep_fs": 10.0}
    if ensemble == "npt":
        stage["pressure_bar"] = PRESSURE
    scene = {
        "seed": seed,
        "box": {"density_g_cm3": 1.36},
        "molecules": [{"model": "argon", "count": 64}],
        "forces": {"cutoff_A": 6.5},
        "start": {"temperature_K": TEMPERATURE},
        "stages": [stage | {"duration_ps": duration} for duration in durations],
        "output": {"log_interval_ps": 0.1, "figures": False} | output,
    }
    return Simulation(Scene.from_dict(scene)).run(progress=False)


def check_pulls(name, measured, truth=None, least=LEAST, most=MOST):
    """Print and check pulls. measured : length (ps) -> values and errors (seeds, 2), None where
        there is none

    truth : the mean of all values, weighted by length, if it is None
    least, most : limits of the root mean square of all pulls
    """
    found, is_known = {}, truth is not None
    for length, pairs in measured.items():
        pairs = [pair for pair in pairs if None not in pair]
        assert len(pairs) >= 0.9 * SEEDS, f"{name}: {len(pairs)} errors at {length:g} ps"
        found[length] = np.array(pairs, float)
    if truth is None:
        truth = np.average([pairs[:, 0].mean() for pairs in found.values()], weights=list(found))
    pulls = {length: (pairs[:, 0] - truth) / pairs[:, 1] for length, pairs in found.items()}
    for length, of_length in pulls.items():
        beyond = (
            f"{np.mean(np.abs(of_length) > 3):.1%} beyond 3, largest {np.abs(of_length).max():.1f}"
        )
        print(
            f"{name}, {length:g} ps: {rms(of_length):.2f}, mean {of_length.mean():+.2f}, {beyond}"
        )
        assert LEAST_OF_LENGTH < rms(of_length) < MOST_OF_LENGTH * most / MOST, name
        if is_known:
            assert abs(of_length.mean()) < 4 * of_length.std() / np.sqrt(len(of_length)), name
    together = np.concatenate(list(pulls.values()))
    print(f"{name}: {rms(together):.2f} of {truth:.5g}")
    assert least < rms(together) < most, name
    assert np.mean(np.abs(together) > 3) < (BEYOND if most == MOST else 3 * BEYOND), name


def rms(values):
    return np.sqrt(np.mean(values**2))


KEYS = {
    "T": ("temperature_K", "temperature_error_K"),
    "U": ("potential_kJ_mol_per_molecule", "potential_error_kJ_mol_per_molecule"),
    "P": ("pressure_bar", "pressure_error_bar"),
    "density": ("density_g_cm3", "density_error_g_cm3"),
}


@pytest.mark.parametrize(
    ("ensemble", "durations"),
    [
        ("nvt", [20.0, 5.0, 10.0, 20.0, 40.0]),  # correlation times of U and P: 0.2 ps
        ("npt", [60.0, 50.0, 100.0, 200.0]),  # of P, U and the density: 1.2, 2.7 and 4.1 ps
    ],
)
def test_errors_of_a_summary_are_those_of_the_scatter_over_seeds(ensemble, durations):
    """The first stage relaxes. Temperature and pressure are known where a thermostat and a barostat
    set them."""
    sampled = durations[1:]
    frames = {"trajectory_interval_ps": 1000.0}
    runs = [
        argon(seed, ensemble, durations, **frames).summary["stages"][1:] for seed in range(SEEDS)
    ]
    known = {"T": TEMPERATURE} | ({"P": PRESSURE} if ensemble == "npt" else {})
    for name, (value, error) in KEYS.items():
        if name == "density" and ensemble == "nvt":
            continue
        measured = {
            length: [(stages[k][value], stages[k][error]) for stages in runs]
            for k, length in enumerate(sampled)
        }
        check_pulls(f"{ensemble}: {name}", measured, known.get(name))


@pytest.fixture(scope="module")
def liquids():
    """Results of 60 seeds, 20 ps and 100 ps each."""
    output = {"trajectory_interval_ps": 0.25, "pressure_tensor_interval_ps": 0.03}
    return [argon(seed, "nvt", [20.0, 100.0], **output) for seed in range(SEEDS)]


def test_errors_of_peaks_are_those_of_the_scatter_over_seeds(liquids):
    measured = {}
    for length in (25.0, 50.0, 100.0):
        for results in liquids:
            for value in rigidmd.analysis.rdf(results, start=120.0 - length).values:
                name = value.name.split(": ")[1]
                pairs = measured.setdefault(name, {}).setdefault(length, [])
                pairs.append((value.value, value.error))
    for name, of_lengths in measured.items():
        # the error of the neighbours allows for the distance of the minimum, which jumps
        check_pulls(name, of_lengths, least=0.65 if "neighbours" in name else LEAST)


def test_errors_of_viscosities_are_those_of_the_scatter_over_seeds(liquids):
    """The truth is the viscosity of all runs together."""
    truth = rigidmd.analysis.viscosity(liquids).value()
    print(truth)
    values = [rigidmd.analysis.viscosity(results).value() for results in liquids]
    pairs = [(value.value, value.error) for value in values]
    check_pulls("viscosity", {100.0: pairs}, truth.value, least=LEAST_OF_LENGTH)


def slab(seed):
    """Results of a slab of 200 argon atoms in its vapour at 105 K: 60 ps and 160 ps."""
    stage = {"ensemble": "nvt", "temperature_K": 105.0, "timestep_fs": 10.0}
    scene = {
        "seed": seed,
        "box": {"lengths_A": [20.0, 20.0, 26.0], "vacuum_A": 40.0},
        "molecules": [{"model": "argon", "count": 200}],
        "forces": {"cutoff_A": 8.5},
        "start": {"temperature_K": 105.0},
        "stages": [stage | {"duration_ps": 60.0}, stage | {"duration_ps": 160.0}],
        "output": {
            "log_interval_ps": 0.2,
            "trajectory_interval_ps": 1.0,
            "pressure_tensor_interval_ps": 0.1,
            "figures": False,
        },
    }
    return Simulation(Scene.from_dict(scene)).run(progress=False)


def test_errors_of_a_slab_are_those_of_the_scatter_over_seeds():
    """160 ps are 7 correlation times of the vapour, 24 ps, and errors are honest from 10 on."""
    runs = [rigidmd.analysis.interfaces(slab(seed), start=60.0) for seed in range(SEEDS)]
    for name, most in (("liquid", MOST), ("vapour", 1.6)):
        values = [found.value(name) for found in runs]
        check_pulls(name, {160.0: [(value.value, value.error) for value in values]}, most=most)
