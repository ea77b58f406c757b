"""Response functions from fluctuations: of ideal gases, of made-up series with known covariances,
and of liquids."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import stats
from scipy.signal import lfilter
from support.common import history, site, system_of

import rigidmd
from rigidmd import Scene, Simulation
from rigidmd.commands.cli import main
from rigidmd.errors import OutputError
from rigidmd.features.analysis.built_in.thermodynamics import response
from rigidmd.features.analysis.runs import Runs
from rigidmd.units import BAR, BOLTZMANN, KJ_PER_MOL

R = 1e3 * BOLTZMANN / KJ_PER_MOL  # J/(mol K)
T, P, EDGE, COUNT = 150.0, 100.0, 20.0, 32  # of what is made up: K, bar, Å, molecules
KT = BOLTZMANN * T
STAGES = {
    "nvt": {"ensemble": "nvt", "temperature_K": T},
    "npt": {"ensemble": "npt", "temperature_K": T, "pressure_bar": P},
    "nve": {"ensemble": "nve"},
}


@cache
def nitrogen(ensemble):
    return system_of({"nitrogen": COUNT}, EDGE, stages=[STAGES[ensemble] | {"duration_ps": 0.004}])


def made_up(ensemble, potential, volume=None, virial=None, interval=0.1, counts=None, **sections):
    """Frames whose samples have these potential energies (kJ/mol), volumes (nm³) and pressures of
    the virial (bar), with momenta that fluctuate by themselves."""
    if counts or sections:
        stage = STAGES[ensemble] | {"duration_ps": 0.004} | sections.pop("stage", {})
        system = system_of(counts or {"nitrogen": COUNT}, EDGE, stages=[stage], **sections)
    else:
        system = nitrogen(ensemble)
    time = interval * np.arange(1, len(potential) + 1)
    rng = np.random.default_rng(0)
    of_translation = T + 0.1 * T * rng.standard_normal(len(time))
    freedom = system.freedom_in(0).translation
    kinetic = freedom * BOLTZMANN * of_translation / (3 * EDGE**3) / BAR
    columns = {
        "time": time,
        "temperature": np.full(len(time), T),
        "temperature_translation": of_translation,
        "potential": np.asarray(potential, float),
        "volume": np.full(len(time), 1e-3 * EDGE**3) if volume is None else volume,
        "pressure": kinetic + (0.0 if virial is None else virial),
    }
    return replace(history(system, time, None, np.eye(3) * EDGE), columns=columns)


def noise(rng, count, time, interval=0.1):
    """A process of Ornstein and Uhlenbeck with unit variance."""
    keep = np.exp(-interval / time)
    steps = np.sqrt(1 - keep**2) * rng.standard_normal(count)
    steps[0] = rng.standard_normal()
    return lfilter([1], [1, -keep], steps)


SLOPES = {"potential": (3.0, 4.0), "virial": (120.0, 160.0), "volume": 0.4}


def liquid(rng, ensemble, length, slow=1.0):
    """Made-up samples over `length` ps: a slow and a fast number, of which everything else is a
    linear function."""
    a, b = (noise(rng, round(length / 0.1), time) for time in (slow, 0.2))
    (by_a, by_b), (virial_by_a, virial_by_b) = SLOPES["potential"], SLOPES["virial"]
    potential = -100.0 + by_a * a + by_b * b
    if ensemble == "npt":
        return made_up(ensemble, potential, volume=8.0 + SLOPES["volume"] * a)
    return made_up(ensemble, potential, virial=100.0 + virial_by_a * a + virial_by_b * b)


def truth_of(ensemble):
    """The responses of a made-up liquid by the formulas of the textbook, from the exact
    covariances."""
    by_a, by_b = KJ_PER_MOL * np.array(SLOPES["potential"])
    if ensemble == "nvt":
        virial = BAR * np.array(SLOPES["virial"])
        slope = COUNT * BOLTZMANN / EDGE**3 + (by_a * virial[0] + by_b * virial[1]) / (KT * T)
        c_v = 2.5 * R + R * (by_a**2 + by_b**2) / KT**2 / COUNT
        return {"c_v": c_v, "gamma_V": slope / BAR}
    of_volume = 1e3 * SLOPES["volume"]
    of_enthalpy = by_a + P * BAR * of_volume
    c_p = 2.5 * R + R * (of_enthalpy**2 + by_b**2) / KT**2 / COUNT
    kappa = of_volume**2 / (KT * EDGE**3)
    alpha = of_enthalpy * of_volume / (KT * T * EDGE**3)
    c_v = c_p - R / BOLTZMANN * T * EDGE**3 * alpha**2 / kappa / COUNT
    found = {"c_p": c_p, "kappa_T": 1e6 * BAR * kappa, "alpha_p": 1e3 * alpha}
    return found | {"c_v": c_v, "gamma_V": alpha / kappa / BAR}


# ideal gases


def test_an_ideal_gas_at_constant_pressure_has_its_responses():
    """V of the density V^N exp(-pV/kT): kappa_T = 1/p, alpha_p = 1/T and gamma_V = p/T for any N,
    and c_p is that of N + 1 centres."""
    levels = (np.arange(20000) + 0.5) / 20000
    volume = stats.gamma(COUNT + 1).ppf(levels) * KT / (P * BAR) * 1e-3
    np.random.default_rng(1).shuffle(volume)
    found = response(made_up("npt", np.full(20000, 7.0), volume))
    exact = {
        "c_p": (2.5 + (COUNT + 1) / COUNT) * R,
        "kappa_T": 1e6 / P,
        "alpha_p": 1e3 / T,
        "c_v": 2.5 * R,
        "gamma_V": P / T,
    }
    assert [value.name for value in found.values if "per gram" not in value.name] == [*exact]
    for name, value in exact.items():
        assert found.value(name).value == pytest.approx(value, rel=1e-3), name


@pytest.mark.parametrize("thermostat", ["velocity_rescaling", "langevin"])
def test_an_ideal_gas_at_constant_volume_has_its_responses(thermostat):
    """Momenta count in full, also where the total momentum is kept at zero."""
    stage = {"thermostat": thermostat}
    found = response(made_up("nvt", np.full(400, 7.0), stage=stage))
    assert found.value("c_v").value == pytest.approx(2.5 * R, rel=1e-12)
    assert found.value("c_v per gram").value == pytest.approx(2.5 * R / 28.0134, rel=1e-4)
    gamma = found.value("gamma_V")
    assert gamma.value == pytest.approx(COUNT * BOLTZMANN / EDGE**3 / BAR, rel=1e-9)


ROTOR = {
    "name": "rotor",
    "sites": [
        site(name, 14.0, [0.0, 0.0, z], element="N", sigma_A=1.0, epsilon_kJ_mol=1e-9)
        for name, z in (("A", -0.55), ("B", 0.55))
    ],
}


@pytest.mark.parametrize("barostat", ["monte_carlo", "cell_rescaling"])
def test_a_run_of_an_ideal_gas_of_rotors_has_its_responses(barostat):
    count, pressure = 12, 200.0
    volume = (count + 1) * BOLTZMANN * 300.0 / (pressure * BAR)
    stage = {
        "ensemble": "npt",
        "temperature_K": 300.0,
        "pressure_bar": pressure,
        "duration_ps": 60.0,
        "timestep_fs": 2.0,
        "thermostat": "langevin",
        "friction_translation_per_ps": 5.0,
        "barostat": barostat,
        "barostat_interval_ps": 0.01,
        "compressibility_per_bar": 1 / pressure,
    }
    if barostat == "cell_rescaling":
        stage["barostat_time_ps"] = 0.2
    scene = {
        "box": {"lengths_A": volume ** (1 / 3)},
        "molecules": [ROTOR | {"count": count}],
        "forces": {"cutoff_A": 1.5},
        "start": {"temperature_K": 300.0},
        "stages": [stage],
        "output": {"log_interval_ps": 0.02, "trajectory_interval_ps": 10.0, "figures": False},
    }
    results = Simulation(Scene.from_dict(scene)).run(progress=False)
    found = rigidmd.analysis.response(results)
    exact = {"c_p": (2.5 + (count + 1) / count) * R, "kappa_T": 1e6 / pressure}
    exact |= {"alpha_p": 1e3 / 300, "c_v": 2.5 * R, "gamma_V": pressure / 300}
    for name, value in exact.items():
        measured = found.value(name)
        assert measured.value is not None, measured
        assert abs(measured.value - value) < 4 * measured.error + 1e-4 * value, measured
        assert measured.error < 0.2 * value, measured


def test_a_run_without_frames_has_responses_and_a_viscosity(tmp_path, capsys):
    """The same as with them: from the log and the pressure tensor, in memory and from a folder."""
    scene = {
        "box": {"lengths_A": 18.0},
        "molecules": [{"model": "argon", "count": 50}],
        "forces": {"cutoff_A": 8.0},
        "stages": [
            {"duration_ps": 25.0, "timestep_fs": 10.0, "ensemble": "nvt", "temperature_K": 200.0}
        ],
        "output": {
            "figures": False,
            "pressure_tensor_interval_ps": 0.02,
            "log_interval_ps": 0.05,
            "trajectory_interval_ps": 5.0,
        },
    }
    found = []
    for trajectory, folder in (("t.xyz", "with"), (False, "without"), (False, None)):
        scene["output"]["trajectory"] = trajectory
        results = Simulation(Scene.from_dict(scene), folder and tmp_path / folder).run(
            progress=False
        )
        analyses = [getattr(rigidmd.analysis, name)(results) for name in ("response", "viscosity")]
        found.append([[str(value) for value in analysis.values] for analysis in analyses])
        if not trajectory:
            with pytest.raises(OutputError, match=r"rdf needs the frames of a trajectory: .*false"):
                rigidmd.analysis.rdf(results)
    assert found[0] == found[1] == found[2]
    assert all(values for values in found[0])
    assert main(["analyse", str(tmp_path / "without")]) == 0
    printed = capsys.readouterr().out
    assert "c_v" in printed
    assert "msd, diffusion" in printed and printed.count("needs the frames of a trajectory") == 1
    (tmp_path / "with" / "t.xyz").unlink()
    assert main(["analyse", str(tmp_path / "with"), "--only", "response"]) == 0
    assert main(["analyse", str(tmp_path / "with"), "--only", "msd"]) == 2
    assert "its trajectory t.xyz is missing" in capsys.readouterr().err


# series with known covariances


@pytest.mark.parametrize("ensemble", ["nvt", "npt"])
def test_values_are_those_of_the_textbook_and_errors_those_of_the_scatter(ensemble):
    """80 correlation times of the slow number. The subtraction of means is corrected: without, the
    compressibility would be too small by 2.5 %."""
    truth, pulls = truth_of(ensemble), {}
    rng = np.random.default_rng(2)
    relative = {name: [] for name in truth}
    for _ in range(150):
        found = response(liquid(rng, ensemble, 80.0))
        for name, value in truth.items():
            if found.value(name).value is not None:
                measured = found.value(name)
                pulls.setdefault(name, []).append((measured.value - value) / measured.error)
                relative[name].append(measured.value / value - 1)
    for name, values in pulls.items():
        rms = np.sqrt(np.mean(np.square(values)))
        print(f"{ensemble} {name}: {rms:.2f} of {len(values)}, {np.mean(relative[name]):+.4f}")
        assert len(values) > 120, name
        assert 0.75 < rms < 1.3, name
        assert abs(np.mean(relative[name])) < 4 * np.std(relative[name]) / np.sqrt(len(values))


@pytest.mark.parametrize("runs", [1, 3])
def test_a_mean_that_is_subtracted_hides_nothing(runs):
    """The mean of many short runs, each of which is too short for a value."""
    rng, truth = np.random.default_rng(3), truth_of("npt")["kappa_T"]
    found = []
    for _ in range(300):
        members = [liquid(rng, "npt", 15.0 / runs) for _ in range(runs)]
        value = response(Runs(tuple(members))).value("kappa_T")
        assert value.value is None or value.error > 0
        found.append(
            float(value.note.split("So far: ")[1].split()[0])
            if value.value is None
            else value.value
        )
    assert abs(np.mean(found) / truth - 1) < 4 * np.std(found) / truth / np.sqrt(300) < 0.1


@pytest.mark.parametrize("ensemble", ["nvt", "npt"])
def test_runs_together_have_the_covariances_of_all_samples(ensemble):
    rng, truth = np.random.default_rng(4), truth_of(ensemble)
    members = [liquid(rng, ensemble, 60.0) for _ in range(12)]
    together = response(Runs(tuple(members)))
    for name, value in truth.items():
        measured = together.value(name)
        assert abs(measured.value - value) < 4 * measured.error, measured
        alone = [response(run).value(name) for run in members]
        errors = [one.error for one in alone if one.error is not None]
        assert measured.error == pytest.approx(np.mean(errors) / np.sqrt(12), rel=0.6), name
    c_v, per_gram = (np.array(together.value(name)[2:4]) for name in ("c_v", "c_v per gram"))
    mass = members[0].system.species[0].mass
    assert per_gram == pytest.approx(c_v / mass)
    curve = together.curves[0]
    (so_far,) = curve.columns.values()
    assert so_far[-1] == pytest.approx(together.value().value, rel=1e-3)
    assert len(together.to_dataframe()) == len(curve.axis[1]) <= 500


@pytest.mark.parametrize("runs", [1, 5])
def test_constant_energy_has_the_responses_of_the_canonical_ensemble(runs):
    """With the heat capacity C of the positions and K of the momenta, U fluctuates by k T² C K/(C +
    K) at constant energy, and dP/dT is reduced alike. Every run has its energy."""
    rng, system = np.random.default_rng(5), system_of({"nitrogen": COUNT}, EDGE)
    of_momenta, of_positions = 0.5 * system.freedom.total, 40.0  # in kB
    size = np.sqrt(of_positions * of_momenta / (of_positions + of_momenta))
    members = []
    for k in range(runs):
        x = noise(rng, 30000, 0.1)
        energy = -50.0 * k + size * KT / KJ_PER_MOL * x
        members.append(made_up("nve", energy, virial=30.0 * k + 20.0 * size * x))
    found = response(Runs(tuple(members)))
    c_v, gamma = found.value("c_v"), found.value("gamma_V")
    assert abs(c_v.value - (2.5 + of_positions / COUNT) * R) < 4 * c_v.error < 0.2 * R
    slope = COUNT * BOLTZMANN / EDGE**3 / BAR + 20.0 * of_positions / T
    assert abs(gamma.value - slope) < 4 * gamma.error < 0.1 * slope
    assert "nve at 150 K" in str(found)


def test_heat_capacities_are_of_the_molecules_that_move():
    molecules = [{"model": "spce", "count": 6}, {"model": "nitrogen", "count": 2}]
    molecules += [{"model": "spce", "name": "wall", "count": 3, "frozen": True}]
    frames = made_up("nvt", np.full(100, 7.0), counts={"spce": 1}, molecules=molecules)
    found = response(frames)
    assert found.value("c_v").value == pytest.approx((6 * 3 + 2 * 2.5) / 8 * R)
    mass = (6 * 18.015 + 2 * 28.013) / 8
    assert found.value("c_v per gram").value == pytest.approx(23 / 8 * R / mass, rel=1e-4)
    assert "of the molecules that are not frozen" in str(found)


# what has no value


def test_a_short_run_has_no_value():
    found = response(liquid(np.random.default_rng(6), "npt", 12.0))
    for name in ("kappa_T", "alpha_p"):
        value = found.value(name)
        assert value.value is None and "100 of them are" in value.note and "So far" in value.note


def test_what_an_ensemble_lacks_is_reported():
    rng = np.random.default_rng(7)
    assert "c_p, kappa_T and alpha_p need a stage with ensemble = 'npt'" in str(
        response(liquid(rng, "nvt", 20.0))
    )
    spring = {"stiffness_kJ_mol_A2": 1.0, "position_A": [1.0, 2.0, 3.0], "molecules": "1-4"}
    frames = made_up("nvt", rng.standard_normal(500), fields={"restraints": [spring]})
    found = response(frames)
    assert [value.name for value in found.values] == ["c_v", "c_v per gram"]
    assert "no gamma_V: the pressure does not contain restraints_0" in str(found)


@pytest.mark.parametrize(
    ("stage", "sections", "words"),
    [
        ({"ensemble": "nvt", "temperature_K": [100.0, 150.0]}, {}, "constant conditions"),
        ({"ensemble": "npt", "temperature_K": T, "pressure_bar": [1.0, 9.0]}, {}, "constant"),
        ({"ensemble": "nph", "pressure_bar": 1.0}, {}, "nph keeps the enthalpy"),
        (
            STAGES["npt"] | {"pressure_coupling": "anisotropic", "pressure_bar": [1.0, 2.0, 3.0]},
            {},
            "one pressure on all sides",
        ),
        (STAGES["npt"] | {"pressure_coupling": "normal"}, {}, "one pressure on all sides"),
        (
            STAGES["nvt"],
            {
                "counts": {"spce": 4},
                "fields": {"electric_V_per_nm": [0.0, 0.0, 0.1], "electric_frequency_per_ps": 1.0},
            },
            "static forces, and these depend on time: electric_field",
        ),
        (
            {"ensemble": "nve"},
            {"box": {"lengths_A": EDGE, "periodic": False}, "forces": {}},
            "where the angular momentum is kept",
        ),
    ],
)
def test_what_gives_no_response_functions_is_refused(stage, sections, words):
    frames = made_up("nve", np.random.default_rng(8).standard_normal(50), stage=stage, **sections)
    if "box" in sections:
        frames = replace(frames, cell=np.full_like(frames.cell, np.inf))
    with pytest.raises(OutputError, match=words):
        response(frames)


# liquids, minutes each

SEEDS, PRESSURE, DENSITY = 24, 500.0, 0.7  # of compressed nitrogen at 150 K: bar, g/cm³


def compressed_nitrogen(seed, ensemble, pressure=PRESSURE):
    """Results of 48 molecules in 100 ps after 10 ps."""
    stage = STAGES[ensemble] | {"timestep_fs": 4.0, "integrator": "baoab"}
    stage["thermostat"] = "velocity_rescaling"
    if ensemble == "npt":
        stage |= {"pressure_bar": pressure, "barostat_time_ps": 0.4}
        stage |= {"compressibility_per_bar": 3e-4}
    scene = {
        "seed": seed,
        "box": {"density_g_cm3": DENSITY},
        "molecules": [{"model": "nitrogen", "count": 48}],
        "forces": {"cutoff_A": 6.0},
        "start": {"temperature_K": T},
        "stages": [stage | {"duration_ps": duration} for duration in (10.0, 100.0)],
        "output": {"log_interval_ps": 0.05, "trajectory_interval_ps": 10.0, "figures": False},
    }
    return Simulation(Scene.from_dict(scene)).run(progress=False)


@pytest.mark.soak
@pytest.mark.parametrize("ensemble", ["nvt", "npt"])
def test_errors_are_those_of_the_scatter_over_seeds(ensemble):
    """The truth is that of all runs together."""
    runs = [compressed_nitrogen(seed, ensemble) for seed in range(SEEDS)]
    each = [rigidmd.analysis.response(results) for results in runs]
    together = rigidmd.analysis.response(runs)
    print(together)
    for truth in together.values:
        values = [found.value(truth.name) for found in each]
        values = [value for value in values if value.value is not None]
        pulls = np.array([(value.value - truth.value) / value.error for value in values])
        rms = np.sqrt(np.mean(pulls**2))
        print(f"{truth.name}: {rms:.2f} of {len(pulls)}, largest {np.abs(pulls).max():.1f}")
        # of nearly white noise it is 0.8, and of 24 pulls it has an error of 0.12
        assert len(pulls) > 0.8 * SEEDS and 0.5 < rms < 1.4, truth.name
        scatter = np.std([value.value for value in values], ddof=1) / np.sqrt(len(values))
        assert 0.6 < truth.error / scatter < 1.7, truth.name


@pytest.mark.soak
def test_the_compressibility_is_the_difference_of_two_pressures():
    low, high = 400.0, 600.0
    runs = [compressed_nitrogen(seed, "npt") for seed in range(SEEDS // 2)]
    kappa = rigidmd.analysis.response(runs).value("kappa_T")
    densities = {
        pressure: [
            np.mean(compressed_nitrogen(seed, "npt", pressure)["density"][200:])
            for seed in range(SEEDS // 2)
        ]
        for pressure in (low, high)
    }
    logs = {pressure: np.log(values) for pressure, values in densities.items()}
    by_density = 1e6 * (logs[high].mean() - logs[low].mean()) / (high - low)
    error = 1e6 * np.hypot(*(stats.sem(values) for values in logs.values())) / (high - low)
    print(kappa, "| by the densities at two pressures:", by_density, "±", error)
    assert abs(kappa.value - by_density) < 3 * np.hypot(kappa.error, error)
    assert error < 0.1 * by_density


@pytest.mark.soak
@pytest.mark.parametrize(
    ("model", "published"),  # Vega & Abascal 2011, Phys. Chem. Chem. Phys. 13, 19663
    [("tip4p2005", {"kappa_T": 46.5, "alpha_p": 0.28, "c_p": 88.3})],
)
def test_water_has_the_published_responses(model, published):
    stage = {
        "ensemble": "npt",
        "temperature_K": 298.15,
        "pressure_bar": 1.0,
        "timestep_fs": 4.0,
        "integrator": "baoab",
        "thermostat": "velocity_rescaling",
    }
    scene = {
        "box": {"density_g_cm3": 0.997},
        "molecules": [{"model": model, "count": 216}],
        "forces": {"cutoff_A": 8.5},
        "precision": "mixed",
        "start": {"temperature_K": 298.15},
        "stages": [stage | {"duration_ps": duration} for duration in (20.0, 400.0)],
        "output": {"trajectory_interval_ps": 10.0, "figures": False},
    }
    found = rigidmd.analysis.response(Simulation(Scene.from_dict(scene)).run(progress=False))
    print(found)
    for name, value in published.items():
        measured = found.value(name)
        assert measured.value is not None, measured
        assert abs(measured.value - value) < 3 * measured.error + 0.02 * value, measured
