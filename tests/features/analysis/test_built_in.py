"""What all analyses have in common: correlations, errors over runs, transients, short runs."""

import numpy as np
import pytest
from support.common import history, system_of
from support.frames import brownian

from rigidmd.core.statistics import steady_from
from rigidmd.errors import OutputError
from rigidmd.features.analysis.built_in.rotation import PER_CM, spectrum
from rigidmd.features.analysis.built_in.structure import (
    density_profile,
    hydrogen_bonds,
    rdf,
    structure_factor,
)
from rigidmd.features.analysis.built_in.transport import (
    NM2_PER_S,
    correlation,
    diffusion,
    msd,
    squared_displacement,
)
from rigidmd.features.analysis.result import converged_value
from rigidmd.features.analysis.runs import Runs
from rigidmd.mechanics.rotation import random_rotations
from rigidmd.units import BOLTZMANN


# correlation functions
def test_correlations_are_those_of_the_definition():
    rng = np.random.default_rng(0)
    series = rng.standard_normal((23, 3, 2))
    direct = [np.mean(series[: 23 - k] * series[k:]) for k in range(11)]
    assert correlation(series, 11) == pytest.approx(direct, abs=1e-14)
    path = np.cumsum(rng.standard_normal((23, 4, 3)), axis=0) + 1000.0
    direct = [np.mean(np.sum((path[k:] - path[: 23 - k]) ** 2, axis=2)) for k in range(11)]
    assert squared_displacement(path, 11) == pytest.approx(direct, abs=1e-10)


@pytest.mark.parametrize("frames", [2, 9])
def test_peaks_of_few_frames_have_no_value(frames):
    system = system_of({"spce": 125}, 15.5)
    rng = np.random.default_rng(1)
    lattice = 3.1 * np.array([*np.ndindex(5, 5, 5)])
    positions = lattice + 0.2 * rng.standard_normal((frames, 125, 3))
    Q = random_rotations(rng, frames * 125).reshape(frames, 125, 3, 3)
    made = history(system, 0.01 * np.arange(frames), positions, np.eye(3) * 15.5, Q)
    for name in ("first peak", "height of that peak", "neighbours up to the first minimum"):
        found = rdf(made, "O").value(f"g O-O: {name}")
        assert found.value is None
        assert found.note.startswith("too short for an error. So far: ")


def test_one_sentence_states_what_is_too_short():
    assert converged_value("x", "D", 1.0, 0.1, 11.0, 1.0).note == (
        "11 ps are 11 correlation times of 1 ps, too short for a value; 20 of them are 20 ps. So far: 1.00 ± 0.10 D"
    )
    assert (
        converged_value("x", "", 1.0, None, 40.0, 1.0).note == "too short for an error. So far: 1"
    )
    assert converged_value("x", "", 1.0, 0.1, 20.0, 1.0).value == 1.0
    assert converged_value("x", "", 1.0, 0.1, 5.0, 1.0, least=5.0).value == 1.0
    assert converged_value("x", "", 1.0, 0.1, 4.9, 1.0, least=5.0).value is None
    assert converged_value("x", "", np.nan, 0.1, 5.0, 1.0).value is None
    assert converged_value("x", "", 1.0, 0.1, 5.0, 0.0).value is None


def test_an_oscillation_has_its_wave_number_and_its_degrees_of_freedom():
    """Springs at 120/cm and librations at 300, 500 and 700/cm, with energies of kT each on the
    average."""
    system = system_of({"spce": 40}, 30.0)
    rng, frames, interval = np.random.default_rng(0), 2000, 0.004
    time, m = interval * np.arange(frames), system.species[0]

    def swing(wave_number, weight, shape):
        size = np.sqrt(rng.exponential(2 * BOLTZMANN * 300 / weight, shape))
        size *= np.sqrt(2 * BOLTZMANN * 300 / weight / np.mean(size**2))
        return size * np.cos(
            2 * np.pi * PER_CM * wave_number * time[:, None, None] + 2 * np.pi * rng.random(shape)
        )

    velocities = swing(120.0, m.mass, (40, 3))
    L = np.concatenate(
        [swing(c, i, (40, 1)) * i for c, i in zip((300, 500, 700), m.inertia, strict=True)], axis=2
    )
    Q = np.broadcast_to(random_rotations(rng, 40), (frames, 40, 3, 3))
    found = spectrum(history(system, time, None, np.eye(3) * 30, Q, velocities, L))
    step = found["wave number (1/cm)"][1]
    expected = {
        "V spce": (120, 3),
        **{f"omega spce axis {k}": (200 + 100 * k + 100 * (k - 1), 1) for k in (1, 2, 3)},
    }
    for title, (wave_number, freedom) in expected.items():
        peak = found.value(f"highest peak of {title}")
        assert peak.value == pytest.approx(wave_number, abs=0.6 * step)
        assert peak.error == pytest.approx(step / 2)
        assert np.sum(found[title]) * step == pytest.approx(freedom, rel=0.03)
        memory = found[f"correlation {title}"]
        assert memory[0] == pytest.approx(1.0)
        assert memory[5] == pytest.approx(
            np.cos(2 * np.pi * PER_CM * wave_number * 5 * interval), abs=0.02
        )
    with pytest.raises(OutputError, match="needs velocities"):
        spectrum(history(system, time, None, np.eye(3) * 30, Q))
    with pytest.raises(OutputError, match=r"frames every 0\.016 ps .* spce axis 2 decays"):
        every = slice(None, None, 4)  # V and one of three angular velocities would do
        spectrum(
            history(
                system, time[every], None, np.eye(3) * 30, Q[every], velocities[every], L[every]
            )
        )


# several runs together
def test_analyses_of_several_runs_are_over_their_sum():
    """Four short runs of a liquid: the limits apply to all of them, the means are those of all
    frames."""
    system, rng, box = system_of({"spce": 40}, 20.0), np.random.default_rng(0), np.eye(3) * 20.0
    members = []
    for _ in range(4):
        Q = random_rotations(rng, 60 * 40).reshape(60, 40, 3, 3)
        paths = brownian(rng, 60, 40, 0.25, 4.0) + 20.0 * rng.random((40, 3))
        members.append(history(system, 4.0 * np.arange(60), paths, box, Q))
    together = Runs(tuple(members))
    uneven = Runs((members[0][:20], members[1]))
    assert uneven.mean([1.0, 3.0]) == 2.5
    for title in ("g O-O", "n O-O"):
        each = [rdf(run)[title] for run in uneven.members]
        assert rdf(uneven)[title] == pytest.approx(np.average(each, axis=0, weights=[1, 3]))
    for analysis, title in (
        (rdf, "g O-O"),
        (structure_factor, "S centres"),
        (density_profile, "density spce (g/cm3)"),
    ):
        each, both = [analysis(run)[title] for run in members], analysis(together)
        assert both[title] == pytest.approx(np.mean(each, axis=0), abs=1e-12), title
        assert both[f"{title} error"] == pytest.approx(
            np.std(each, axis=0, ddof=1) / 2, abs=1e-12
        ), title
    each, both = [hydrogen_bonds(run).value() for run in members], hydrogen_bonds(together).value()
    assert both.value == pytest.approx(np.mean([value.value for value in each]))
    assert both.error == pytest.approx(np.std([value.value for value in each], ddof=1) / 2)
    single, both = diffusion(members[0], 0.85), diffusion(together, 0.85)
    assert both["Time (ps)"][-1] == pytest.approx(4.0 * 24)  # a tenth of all frames
    assert single["Time (ps)"][-1] == pytest.approx(4.0 * 6)
    assert abs(both.value("D of spce").value - 0.25 / NM2_PER_S) < 4 * both.value("D of spce").error
    lags = len(msd(together)["Time (ps)"])
    each = [squared_displacement(run.paths, lags) for run in members]
    assert msd(together)["MSD spce (A^2)"] == pytest.approx(np.mean(each, axis=0))


def test_runs_that_are_too_short_alone_have_a_value_together():
    system, rng, box = system_of({"argon": 16}, 25.0), np.random.default_rng(1), np.eye(3) * 25.0
    members = [
        history(system, 0.5 * np.arange(400), brownian(rng, 400, 16, 0.25, 0.5), box)
        for _ in range(8)
    ]
    alone = [diffusion(run, 0.85).value("D of argon") for run in members]
    assert all(value.value is None and "too short" in value.note for value in alone)
    together = diffusion(Runs(tuple(members)), 0.85).value("D of argon")
    assert abs(together.value - 0.25 / NM2_PER_S) < 4 * together.error < 1.0


@pytest.mark.parametrize("counts", [(50, 50, 50), (20, 60, 100)])
def test_the_error_over_runs_is_that_of_leaving_one_out(counts):
    """Of the mean it is the standard error; of a function of it the same times the slope; long runs
    count more."""
    system, rng = system_of({"argon": 2}, 25.0), np.random.default_rng(4)
    runs = Runs(tuple(history(system, np.arange(float(count)), None) for count in counts))
    found, told = [], []
    for _ in range(400):
        values = [2 + rng.standard_normal() / np.sqrt(count) for count in counts]
        value, error = runs.estimate(values, lambda mean: mean**2)
        found.append(float(value))
        told.append(float(error))
    assert np.sqrt(np.mean(np.square(told))) == pytest.approx(np.std(found), rel=0.2)
    assert np.std(found) == pytest.approx(4 / np.sqrt(sum(counts)), rel=0.1)


# production
def test_a_transient_is_left_out():
    rng = np.random.default_rng(0)
    for shift in (200, 300):
        values = rng.standard_normal(1000) + 30 * np.exp(-np.arange(1000) / (shift / 5))
        assert 0.4 * shift < steady_from(values) < 1.7 * shift
    assert steady_from(np.ones(100)) == 0
    assert max(steady_from(np.cumsum(rng.standard_normal(1000))) for _ in range(10)) <= 500
    assert np.median([steady_from(rng.standard_normal(1000)) for _ in range(50)]) < 150
