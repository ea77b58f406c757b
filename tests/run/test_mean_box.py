"""A stage in the mean box of the npt stage before it: the box, the molecules in it, the energy,
stops, error messages."""

import numpy as np
import pytest
from scipy.stats import t as student
from support.common import small_scene
from support.stops import same_after_stops

from rigidmd.errors import SceneError
from rigidmd.features.studies.accuracy.start import start_of_last_stage
from rigidmd.run import Simulation
from rigidmd.run.report import summary_text
from rigidmd.scene import Scene

FS = 1e-3  # ps
LIQUID = {"timestep_fs": 2.0, "temperature_K": 300.0}
#: 60 steps with a sample each, in which the box moves fast.
NPT = LIQUID | {
    "ensemble": "npt",
    "pressure_bar": 2000.0,
    "duration_ps": 0.12,
    "barostat_time_ps": 0.05,
}
MEAN = LIQUID | {"ensemble": "nvt", "volume": "mean", "duration_ps": 0.02}


def scene(coupling="isotropic", after=MEAN, **more):
    """40 waters and 20 nitrogen molecules."""
    stages = [NPT | {"pressure_coupling": coupling}, after]
    forces = {"cutoff_A": 6.0, "tail_correction": True, "electrostatics": "reaction_field"}
    sections = {"stages": stages, "output": {"log_interval_ps": 0.002}, "forces": forces} | more
    return small_scene({"spce": 40, "nitrogen": 20}, 15.0, **sections)


def marginal_standard_error(values):
    """The start that the marginal standard error rule finds, from its definition."""
    errors = [np.var(values[k:]) / (len(values) - k) for k in range(len(values) // 2 + 1)]
    return int(np.argmin(errors))


def samples_per_independent_one(values):
    """By the initial monotone sequence of pairs of correlations, whose mean is the value of the samples;
    by direct sums."""
    n, x = len(values), values - values.mean()
    correlation = [float(x[: n - k] @ x[k:] / (x @ x)) for k in range(n)]
    pairs = [a + b for a, b in zip(correlation[0::2], correlation[1::2], strict=False)]
    end = next((k for k, pair in enumerate(pairs) if k and pair <= 0), len(pairs))
    total = 2 * sum(min(pairs[: k + 1]) for k in range(end)) - 1
    return max(total, 1 / n) / max(0.25, 1 - (4 * end - 1) / n)


def start_of_the_mean(values):
    """0, unless what precedes the start of the marginal standard error rule has another mean, by
    Student's test at a chance of 1e-4, with the variance and the correlation of the second half."""
    start, late = marginal_standard_error(values), values[len(values) // 2 :]
    if start == 0:
        return 0
    samples = samples_per_independent_one(late)
    freedom = len(late) / samples
    variance = late.var(ddof=1) / max(0.25, 1 - 1 / freedom)
    error = np.sqrt(variance * (min(1, samples / start) + samples / (len(values) - start)))
    differs = abs(values[:start].mean() - values[start:].mean())
    return start if differs > student.isf(5e-5, max(freedom - 2, 0.5)) * error else 0


@pytest.mark.parametrize("coupling", ["isotropic", "semi_isotropic", "anisotropic", "flexible"])
def test_box_and_molecules_at_the_start_are_scaled_to_the_mean(coupling):
    whole = Simulation(scene(coupling, MEAN | {"duration_ps": 2 * FS})).run()
    first = Simulation(
        scene(coupling, MEAN).model_copy(update={"stages": scene(coupling).stages[:1]})
    ).run()
    before, after = first.state, whole.state
    of_stage = whole["stage"] == 0
    series = [whole[name][of_stage] for name in ("potential", "density")]
    start = max(map(start_of_the_mean, series))
    mean = {
        name: whole[name][of_stage][start:].mean()
        for name in ("volume", "a", "b", "c", "alpha", "beta", "gamma")
    }
    assert after.volume == pytest.approx(1000 * mean["volume"], rel=1e-12)
    assert abs(after.volume / before.volume - 1) > 1e-4
    edges = np.linalg.norm(after.cell, axis=1)
    assert edges / edges[0] == pytest.approx(
        np.array([mean[k] for k in "abc"]) / mean["a"], rel=1e-12
    )
    for angle, (i, j) in {"alpha": (1, 2), "beta": (2, 0), "gamma": (0, 1)}.items():
        cosine = after.cell[i] @ after.cell[j] / edges[i] / edges[j]
        assert np.degrees(np.arccos(cosine)) == pytest.approx(mean[angle], abs=1e-9)
    if coupling != "flexible":
        assert np.array_equal(after.cell, np.diag(np.diag(after.cell)))
    moved = after.position @ np.linalg.inv(after.cell) - before.position @ np.linalg.inv(
        before.cell
    )
    flight = np.abs(after.velocity).max() * 2 * FS
    assert (
        np.abs(moved).max() * edges.max() < 1.5 * flight < 0.2
    )  # one step of 2 fs, and no other shift
    assert np.abs(after.rotation - before.rotation).max() < 0.3
    assert np.abs(after.velocity - before.velocity).max() < 0.2 * np.abs(before.velocity).max()


def test_the_energy_of_the_scaling_is_work_and_no_drift():
    results = Simulation(
        scene(
            "anisotropic",
            {"ensemble": "nve", "volume": "mean", "duration_ps": 0.01, "timestep_fs": 0.2},
        )
    ).run()
    last = int(np.flatnonzero(results["stage"] == 0)[-1])
    work = results["work"][last + 1] - results["work"][last]
    gained = results["potential"][last + 1] - results["potential"][last]
    kinetic = results["kinetic"][last + 1] - results["kinetic"][last]
    assert abs(work) > 0.1  # kJ/mol
    assert gained + kinetic == pytest.approx(work, abs=0.01)
    assert np.abs(results["drift"][last + 1 :]).max() < 0.01
    assert np.ptp(results["work"][last + 1 :]) == 0
    row = [
        line for line in summary_text(results.summary).splitlines() if line.startswith("  volume")
    ]
    assert len(row) == 1 and "nm³, the mean of the stage before, at whose end it was" in row[0]
    stage = results.summary["stages"][1]
    assert stage["volume_nm3"] == pytest.approx(results["volume"][-1], rel=1e-12)
    assert stage["volume_before_nm3"] == results["volume"][last]


@pytest.mark.parametrize("stops", [[30, 59], [60], [61, 65]], ids=str)
def test_stops_before_at_and_after_the_scaling_change_no_bit(stops, tmp_path):
    data = scene("anisotropic").model_dump(mode="json", exclude_none=True)
    same_after_stops(data, stops, tmp_path)


def test_the_start_of_the_last_stage_is_in_the_mean_box():
    """As `rigidmd accuracy` measures it."""
    of = scene("flexible")
    whole = Simulation(of).run()
    _, state = start_of_last_stage(of)
    assert np.array_equal(state.cell, whole.state.cell)


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        (
            [MEAN],
            r"stages.0.volume = 'mean' needs an npt or nph stage just before it, at constant .*; it is the first stage",
        ),
        (
            [NPT, LIQUID | {"ensemble": "nvt", "duration_ps": 1.0}, MEAN],
            r"stages.2.volume .*; stages.1 is nvt. Add one, or",
        ),
        ([NPT, {"ensemble": "minimise"}, MEAN], r"stages.2.volume .*; stages.1 is minimise"),
        (
            [NPT | {"pressure_bar": [1.0, 500.0]}, MEAN],
            r"stages.1.volume .*; stages.0 is npt, and its set point changes",
        ),
        ([NPT | {"volume": "mean"}], "volume would have no effect in an npt stage"),
        ([NPT, MEAN | {"volume": "last"}], "volume"),
    ],
)
def test_stages_without_a_mean_box_before_them_are_refused(stages, message):
    with pytest.raises(SceneError, match=message):
        small_scene({"argon": 40}, 20.0, stages=stages)


def test_check_and_exports_know_of_it(tmp_path, printed):
    path = tmp_path / "mean.toml"
    path.write_text(
        "[box]\nlengths_A = 20\n[[molecules]]\nmodel = 'spce'\ncount = 40\n"
        "[[stages]]\nensemble = 'npt'\npressure_bar = 1\ntemperature_K = 300\nduration_ps = 1\n"
        "[[stages]]\nensemble = 'nve'\nvolume = 'mean'\nduration_ps = 1\n"
    )
    assert (
        "nve: 500 steps of 2 fs = 1 ps, velocity_verlet, in the mean box of the stage before"
        in printed("check", path).out
    )
    assert (
        "stages.1.volume = 'mean' stays with rigidmd"
        in printed("export", path, "--to", "gromacs", "-o", tmp_path / "out", code=2).err
    )
    assert Scene.read(path).stages[1].volume == "mean"


def test_a_scene_that_begins_with_a_minimisation_settles_before_any_sample():
    """As an export does."""
    stages = [
        {"ensemble": "minimise"},
        {"ensemble": "nvt", "temperature_K": 90.0, "duration_ps": 0.1},
    ]
    simulation = Simulation(
        small_scene({"argon": 40}, 20.0, stages=stages, start={"temperature_K": 90.0})
    )
    assert np.isfinite(simulation._settle().position).all()
