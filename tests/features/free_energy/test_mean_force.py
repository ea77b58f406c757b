"""The potential of mean force: synthetic samples of a known potential, and runs of two argon
atoms."""

import numpy as np
import pytest

import rigidmd
from rigidmd.commands.cli import main
from rigidmd.errors import OutputError
from rigidmd.features.free_energy.mean_force import Window, potential_of_mean_force

KT = 0.78  # kJ/mol
STIFFNESS = 9.0
DISTANCES = tuple(np.arange(3.4, 8.1, 0.4).tolist())


def lennard_jones(r):
    return 4 * 0.995 * ((3.4 / r) ** 12 - (3.4 / r) ** 6)


def morse(r):
    return 3.0 * ((1 - np.exp(-1.3 * (r - 4.0))) ** 2 - 1)


def drawn(rng, potential, distance, stiffness, count):
    """Distances of two molecules in space, with a restraint, from the inverse of their
    distribution."""
    r = np.linspace(2.5, 14, 40001)
    energy = (potential(r) + 0.5 * stiffness * (r - distance) ** 2) / KT
    density = np.cumsum(r**2 * np.exp(energy.min() - energy))
    return np.interp(rng.random(count), density / density[-1], r)


def windows(seed, potential, distances=DISTANCES, count=400, stiffness=STIFFNESS):
    rng = np.random.default_rng(seed)
    return [Window(d, stiffness, drawn(rng, potential, d, stiffness, count)) for d in distances]


@pytest.mark.parametrize("potential", [lennard_jones, morse])
def test_a_known_potential(potential):
    """By windows with different numbers of samples."""
    every = windows(1, potential, stiffness=STIFFNESS + 3, count=800)
    every[1::2] = [window._replace(samples=window.samples[:200]) for window in every[1::2]]
    result = potential_of_mean_force(every, KT)
    r, found, error = (result[name] for name in ("r (A)", "W (kJ/mol)", "W (kJ/mol) error"))
    outer = r >= r[-max(1, round(0.1 * len(r)))]
    seen = (r > 3.5) & (r < 8)  # the potential is not straight within the first bins
    expected = potential(r) - potential(r)[outer].mean()
    pull = (found - expected)[seen] / error[seen]
    assert 0.5 < np.sqrt(np.mean(pull**2)) < 1.6
    assert error[seen].max() < 0.4
    free = result["free energy of r (kJ/mol)"]
    jacobian = 2 * KT * np.log(r)
    assert found - free == pytest.approx(jacobian - jacobian[outer].mean())
    assert result.value().value == found.min()


SEEDS = 40


def test_errors_are_those_of_repeated_samples():
    """Over seeds, W deviates by its errors: pulls of unit width, without a bias, of windows with
    different numbers of samples."""
    pulls, counts = [], (60, 480)
    for seed in range(SEEDS):
        rng = np.random.default_rng(seed)
        some = [
            Window(d, STIFFNESS, drawn(rng, lennard_jones, d, STIFFNESS, counts[k % len(counts)]))
            for k, d in enumerate(DISTANCES[2:6])
        ]
        result = potential_of_mean_force(some, KT, width=0.2)
        r = result["r (A)"]
        expected = lennard_jones(r) - lennard_jones(r)[-max(1, round(0.1 * len(r))) :].mean()
        at = [np.abs(r - distance).argmin() for distance in (4.3, 4.7, 5.1)]
        found, error = result["W (kJ/mol)"], result["W (kJ/mol) error"]
        pulls.append((found - expected)[at] / error[at])
    assert (np.abs(np.mean(pulls, axis=0)) < 4 / SEEDS**0.5).all()
    assert 0.8 < np.std(pulls) < 1.2


def test_overlap_of_windows_with_different_numbers_of_samples():
    """The overlap in the note is the mean fraction, in the second window, of the first one."""
    distances, counts, stiffness = (4.0, 5.2), (4000, 500), 16.0
    rng = np.random.default_rng(5)
    some = [
        Window(d, stiffness, drawn(rng, lennard_jones, d, stiffness, count))
        for d, count in zip(distances, counts, strict=True)
    ]
    r = np.linspace(2.5, 14, 40001)
    density = np.array(
        [r**2 * np.exp(-(lennard_jones(r) + stiffness / 2 * (r - d) ** 2) / KT) for d in distances]
    )
    density /= density.sum(axis=1, keepdims=True)
    density = density[:, density.sum(axis=0) > 0]
    first, second = density * np.array(counts)[:, None]
    exact = (first * density[1] / (first + second)).sum()
    assert exact < 0.03
    (note,) = [n for n in potential_of_mean_force(some, KT).notes if "barely overlap" in n]
    shown = float(note.partition("(")[2].partition(",")[0])
    assert shown == pytest.approx(exact, rel=0.3)


@pytest.mark.parametrize("depth", [28.0, 40.0])
def test_deep_wells(depth):
    """Weights of the bins that differ by more than the precision, and the range, of a number."""
    rng, stiffness, kt = np.random.default_rng(1), 40.0 * max(1.0, depth / 30), 2.494

    def potential(r):
        return -depth * kt * np.exp(-(((r - 3) / 1.5) ** 2))

    grid, some = np.linspace(2, 8, 40001), []
    for distance in np.arange(2.6, 7.0, 0.3 * min(1.0, (60 / depth) ** 0.5)):
        energy = (potential(grid) + stiffness / 2 * (grid - distance) ** 2) / kt
        total = np.cumsum(grid**2 * np.exp(energy.min() - energy))
        some.append(
            Window(float(distance), stiffness, np.interp(rng.random(200), total / total[-1], grid))
        )
    result = potential_of_mean_force(some, kt)
    r, found, error = (result[name] for name in ("r (A)", "W (kJ/mol)", "W (kJ/mol) error"))
    expected = potential(r) - potential(r)[-max(1, round(0.1 * len(r))) :].mean()
    assert found.min() == pytest.approx(-depth * kt, rel=0.05)
    width = 0.1 * np.abs(np.gradient(expected, r)) / 2  # of the energy in a bin
    assert (np.abs(found - expected) < 5 * error + width).all()


def test_correlated_samples_have_larger_errors():
    """Each sample eight times in a row: the same numbers, and no smaller errors."""
    plain = windows(3, lennard_jones, count=200)
    again = [window._replace(samples=np.repeat(window.samples, 8)) for window in plain]
    one, other = (potential_of_mean_force(of, KT, width=0.2) for of in (plain, again))
    bins = np.isin(one["r (A)"].round(3), other["r (A)"].round(3))
    errors = (
        one["W (kJ/mol) error"][bins],
        other["W (kJ/mol) error"][np.isin(other["r (A)"].round(3), one["r (A)"].round(3))],
    )
    assert 0.7 < np.median(errors[1] / errors[0]) < 2.0


def test_windows_that_are_not_a_chain():
    apart = windows(4, lennard_jones, distances=[4.0, 5.2], stiffness=60.0)
    with pytest.raises(
        OutputError, match=r"windows at 4 and 5\.2 Å have no common distances: add a window"
    ):
        potential_of_mean_force(apart, KT)
    little = potential_of_mean_force(
        windows(4, lennard_jones, distances=[4.0, 4.3, 5.3], stiffness=30.0), KT
    )
    assert any("4.3 and 5.3 Å barely overlap" in note for note in little.notes)
    short = [Window(4.0, STIFFNESS, np.array([4.0, 4.1, 3.9]))]
    with pytest.raises(OutputError, match="decorrelated samples of 3, and needs 10: run longer"):
        potential_of_mean_force(short, KT)


SCENE = """
[box]
lengths_A = 30
[[molecules]]
model = "argon"
count = 2
[[fields.restraints]]
between = [1, 2]
distance_A = 4.0
stiffness_kJ_mol_A2 = 4.0
[[stages]]
ensemble = "minimise"
[[stages]]
ensemble = "nvt"
temperature_K = 94
thermostat = "langevin"
duration_ps = {duration}
timestep_fs = 10
[forces]
tail_correction = false
[output]
log_interval_ps = 0.1
trajectory = false
figures = false
"""


def swept(folder, duration, distances):
    (folder / "argon.toml").write_text(SCENE.format(duration=duration))
    points = {"fields.restraints.0.distance_A": distances}
    return rigidmd.sweep(folder / "argon.toml", points, folder / "sweep", jobs=2)


@pytest.mark.soak
def test_a_sweep_of_windows(tmp_path, capsys):
    results = swept(tmp_path, 40, [4.0, 4.8])
    before = {path: path.read_bytes() for path in (tmp_path / "sweep").rglob("*") if path.is_file()}
    curves = [rigidmd.pmf(sweep).curves[0] for sweep in (results, tmp_path / "sweep")]
    assert {
        path: path.read_bytes() for path in (tmp_path / "sweep").rglob("*") if path.is_file()
    } == before
    assert main(["analyse", str(tmp_path / "sweep"), "--only", "pmf", "--figures", "svg"]) == 0
    printed = capsys.readouterr().out
    assert "potential of mean force along a restrained distance" in printed
    assert "W lowest" in printed and "2 windows" in printed
    for name in ("pmf.csv", "pmf.svg", "analysis.json"):
        assert (tmp_path / "sweep" / name).is_file()
    columns = np.genfromtxt(tmp_path / "sweep" / "pmf.csv", delimiter=",", names=True)
    for curve in curves:
        means = next(iter(curve.columns.values()))
        assert means == pytest.approx(columns[columns.dtype.names[1]], rel=1e-6)
    point = next(path for path in (tmp_path / "sweep").iterdir() if path.is_dir())
    assert main(["analyse", str(point), "--only", "pmf"]) == 2
    assert "pmf needs a sweep over the distance of a restraint" in capsys.readouterr().err


@pytest.mark.soak
def test_the_mean_force_of_two_argon_atoms_is_their_potential(tmp_path):
    swept(tmp_path, 2000, np.arange(3.4, 7.3, 0.5).tolist())
    assert main(["analyse", str(tmp_path / "sweep"), "--only", "pmf"]) == 0
    table = np.genfromtxt(tmp_path / "sweep" / "pmf.csv", delimiter=",", names=True, deletechars="")
    r, found, error = (table[name] for name in table.dtype.names[:3])
    expected = lennard_jones(r) - lennard_jones(r)[-max(1, round(0.1 * len(r))) :].mean()
    seen = (r > 3.5) & (r < 7)
    pull = (found - expected)[seen] / error[seen]
    assert np.sqrt(np.mean(pull**2)) < 2
    assert error[seen].max() < 0.15
