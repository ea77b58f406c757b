"""The summary of a run of molecules: means, drifts and notes."""

import csv
import json
import re

import numpy as np
import pytest
from support.common import argon, small_scene

from rigidmd.assemble.build import build
from rigidmd.commands.cli import main
from rigidmd.core.quantities import QUANTITIES
from rigidmd.core.statistics import mean_and_error, slope
from rigidmd.engines.samples import Sample, Samples
from rigidmd.io.run_files import columns
from rigidmd.run import Simulation, run_together
from rigidmd.run.kind import describe
from rigidmd.run.molecular import MolecularRecord
from rigidmd.run.report import summary_text
from rigidmd.run.summary import summarise
from rigidmd.units import BOLTZMANN, FEMTOSECOND, KJ_PER_MOL


def test_log_and_summary(tmp_path):
    scene = small_scene(
        {"spce": 20}, 18.5, stages=[{"duration_ps": 0.05}], output={"log_interval_ps": 0.01}
    )
    results = Simulation(scene, tmp_path / "out").run()
    with (tmp_path / "out" / "log.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert tuple(rows[0]) == tuple(columns(tensor=False).values())
    assert [float(row["Time (ps)"]) for row in rows] == pytest.approx(
        [0, 0.01, 0.02, 0.03, 0.04, 0.05]
    )
    for row, sample in zip(rows, results.samples.rows, strict=True):
        total = float(row["Potential Energy (kJ/mol)"]) + float(row["Kinetic Energy (kJ/mol)"])
        assert float(row["Total Energy (kJ/mol)"]) == pytest.approx(total)
        assert float(row["Temperature (K)"]) == pytest.approx(sample.temperature)
        assert float(row["Box Volume (nm^3)"]) == pytest.approx(1.85**3)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["degrees_of_freedom"] == 57 + 60
    assert summary["stages"][0]["steps"] == 25
    energy, n, time = results["energy"], 20, results["time"]
    gradient = np.polyfit(time, energy, 1)[0]
    stage = summary["stages"][0]
    assert stage["drift_kJ_mol_ns_per_molecule"] == pytest.approx(
        gradient * 1000 / n, rel=1e-6, abs=1e-9
    )
    thermal = 0.0083144626 * stage["temperature_K"] * 117
    assert stage["drift_kT_ns_per_degree_of_freedom"] == pytest.approx(
        gradient * 1000 / thermal, rel=1e-6, abs=1e-9
    )


@pytest.mark.parametrize("speed", [0.4, 1.0])
def test_the_energy_of_a_removed_momentum_is_in_the_summary(speed):
    """P²/2M of what is removed, as a positive number; only where something is removed is there a
    sentence."""
    stages = [{"duration_ps": 0.04, "timestep_fs": 4.0}, {"duration_ps": 0.04, "timestep_fs": 4.0}]
    sections = {
        "stages": stages,
        "run": {"remove_momentum_interval_ps": 0.031},
        "output": {"trajectory": False},
    }
    simulation = Simulation(small_scene({"argon": 20}, 20.0, **sections), warn=str)
    system, state = simulation.system, simulation.state.copy()
    state.velocity[:] += [speed, -0.5 * speed, 0.2]
    simulation.start_from(state)
    mass = system.model.mass[system.model.species]
    momentum = mass @ state.velocity
    removed = simulation.run().summary["momentum_removed"]
    assert removed["energy_kJ_mol"] == pytest.approx(
        momentum @ momentum / (2 * mass.sum()) / KJ_PER_MOL, rel=1e-9
    )
    assert any("remove_momentum_interval_ps" in note for note in system.notes)
    for thermostat in ("langevin", "hybrid_monte_carlo"):
        stage = {
            "ensemble": "nvt",
            "temperature_K": 90.0,
            "thermostat": thermostat,
            "duration_ps": 0.04,
            "timestep_fs": 4.0,
        }
        scene = small_scene({"argon": 20}, 20.0, **sections | {"stages": [stage]})
        assert not any("remove_momentum_interval_ps" in note for note in scene.rounded_times())
        assert "total momentum: removed" not in describe(scene)


def test_a_drift_of_all_molecules_is_noted():
    simulation = Simulation(argon())
    state = simulation.system.state.copy()
    state.velocity[:, 0] += 0.5
    simulation.start_from(state)
    results = simulation.run()
    mass = float(results.system.model.mass[results.system.model.species].sum())
    said = next(note for note in results.summary["notes"] if "drift together" in note)
    assert (
        f"which adds {mass * 0.5**2 / (57 * BOLTZMANN):.2g} K to T_trans; run.remove_momentum_interval_ps"
        in said
    )


def summarised(
    stage, counts=None, momentum=0.0, truncation="switch", seed=1, before=(), after=(), **made
):
    """The summary of made-up samples of one stage: values (n,) of columns; others are still or
    noise. The stages before and after it have one sample each."""
    rng, n = np.random.default_rng(seed), len(next(iter(made.values())))
    given = {
        "ensemble": "nvt",
        "temperature_K": 300.0,
        "duration_ps": 0.05 * n,
        "timestep_fs": 4.0,
    } | stage
    scene = small_scene(
        counts or {"spce": 40},
        16.0,
        stages=[*before, given, *after],
        forces={"cutoff_A": 7.9, "truncation": truncation},
    )
    system, made_stage = build(scene), len(before)
    state = system.state.copy()
    mass = float(system.model.mass[system.model.species].sum())
    state.velocity[:] = [momentum * np.sqrt(BOLTZMANN * 300.0 / mass), 0.0, 0.0]
    rows = Samples([one.label for one in scene.stages])
    samples = [(k, None) for k in range(made_stage)]
    samples += [(made_stage, k) for k in range(n)]
    samples += [(k, None) for k in range(made_stage + 1, len(scene.stages))]
    for k, (of_stage, index) in enumerate(samples):
        plain = {
            name: 300.0 + rng.standard_normal() for name in QUANTITIES if "temperature" in name
        }
        own = {} if index is None else {name: float(made[name][index]) for name in made}
        row = (
            dict.fromkeys(QUANTITIES, 0.0)
            | plain
            | {"stage_name": "", "step": k, "stage": of_stage, "kinetic": 100.0, "volume": 1.0}
        )
        rows.append(
            Sample(
                **row | {"time": 0.05 * k, "momentum": momentum, "orthogonality_error": 0.0} | own
            )
        )
    record = MolecularRecord()
    record.position.computing = [1.0] * len(scene.stages)
    return summarise(system, record, rows, state, 0.0, 1.0, interrupted=False)


def noted(*given, **made):
    """Notes on the stage, or on a common drift, of the summary of made-up samples."""
    return [
        note
        for note in summarised(*given, **made)["notes"]
        if "stages.0" in note or "together" in note
    ]


KEPT = {"thermostat": "velocity_rescaling"}


def test_means_are_over_the_equilibrated_part():
    """An energy that relaxes in 5 ps, of 20; the temperature differs there."""
    rng, time = np.random.default_rng(5), 0.05 * np.arange(400)
    relaxing = np.exp(-time / 1.0)
    potential = -1600 + 400 * relaxing + 10 * rng.standard_normal(400)
    found = summarised(
        KEPT, potential=potential, temperature=300 + 80 * relaxing + rng.standard_normal(400)
    )
    stage = found["stages"][0]
    begin = stage["equilibrated_from_ps"]
    assert 2.5 < begin < 8
    assert stage["means_over"] == f"the last {19.95 - begin:.4g} of 19.95 ps"
    own = time > begin - 1e-9
    of_potential = (
        stage["potential_kJ_mol_per_molecule"],
        stage["potential_error_kJ_mol_per_molecule"],
    )
    assert of_potential == pytest.approx(mean_and_error(potential[own] / 40), rel=1e-9)
    assert abs(stage["temperature_K"] - 300) < 4 * stage["temperature_error_K"] < 1
    assert stage["temperature_translation_error_K"] == pytest.approx(
        1 / np.sqrt(own.sum()), rel=0.5
    )
    text = summary_text(found | {"scene": "made up"})
    assert f"means           over {stage['means_over']}" in text
    assert "K, set point 300 K" in text
    assert re.search(r"T_trans [\d.]+ ± [\d.]+, T_rot [\d.]+ ± [\d.]+ K\n", text)
    assert re.search(r"potential +-39.\d+ ± 0.0\d+ kJ/mol per molecule", text)


@pytest.mark.parametrize(
    ("given", "potential", "words", "begins"),
    [
        (KEPT, np.linspace(0.0, 1.0, 39), "all 1.9 ps, too short to detect equilibration", None),
        (KEPT, np.zeros(100), "all 4.95 ps", 0.0),
        (KEPT, np.linspace(0.0, 1e3, 100), "all 4.95 ps, not yet steady", 0.0),
        (
            KEPT,
            8 * np.exp(-np.arange(100) / 8) + 1.4 * abs(np.arange(100) % 28 / 14 - 1),
            "all 4.95 ps, perhaps not yet steady",
            0.0,
        ),
        (
            KEPT | {"temperature_K": [300.0, 200.0]},
            np.linspace(0.0, 1e3, 100),
            "all 4.95 ps, in which the set point changes",
            0.0,
        ),
    ],
)
def test_the_part_of_means_is_reported(given, potential, words, begins):
    stage = summarised(given, potential=potential)["stages"][0]
    assert stage["means_over"] == words
    assert stage["equilibrated_from_ps"] == (None if begins is None else pytest.approx(begins))


@pytest.mark.parametrize(
    ("slope", "noise", "verdict"),
    [
        (0.0, 1e-3, r"not significant, [012].\d standard errors$"),
        (1e-3, 1e-3, r"significant, \d+.\d standard errors, but small$"),
        (10.0, 1e-3, r"significant, \d+.\d standard errors, and large$"),
    ],
)
def test_a_drift_has_a_verdict(slope, noise, verdict):
    """The limit is 0.001 kT per degree of freedom: 0.6 kJ/mol for 40 waters in 20 ps, 0.03
    kJ/mol/ps."""
    drift = slope * 0.05 * np.arange(400) + noise * np.random.default_rng(3).standard_normal(400)
    found = summarised(KEPT, drift=drift, temperature=np.full(400, 300.0))
    assert re.match(verdict, found["stages"][0]["drift_verdict"])
    assert f"(conserved energy): {found['stages'][0]['drift_verdict']}" in summary_text(
        found | {"scene": "made up"}
    )
    assert summarised(KEPT, drift=drift[:10])["stages"][0]["drift_verdict"] is None


@pytest.mark.parametrize(
    ("off", "spread", "hint"),
    [
        (-0.5, 3.0, ""),
        (-50.0, 3.0, ", less than this: equilibrate longer"),
        (30.0, 20.0, None),  # more than a canonical ensemble has: sampling hides the scatter
    ],
)
def test_constant_energy_after_a_thermostat_explains_its_temperature(off, spread, hint):
    """Temperatures of 40 argon atoms, with 117 degrees of freedom, scatter by 2 T²/117 less their
    variance at constant energy."""
    warm = {"ensemble": "npt", "temperature_K": [80.0, 100.0], "pressure_bar": 10.0}
    nve = {"ensemble": "nve", "temperature_K": None}
    noise = np.random.default_rng(2).standard_normal(400)
    series = 100.0 + off + spread * (noise - noise.mean()) / noise.std()
    found = summarised(
        nve,
        {"argon": 40},
        before=[warm | {"duration_ps": 0.5}],
        after=[{"ensemble": "nve", "duration_ps": 0.1}],
        temperature=series,
    )
    one, two, three = found["stages"]
    assert one["set_temperature_K"] == (80.0, 100.0) and "temperature_scatter_K" not in one
    assert "temperature_scatter_K" not in three  # nothing was drawn at its start
    assert two["temperature_before_K"] == 100.0
    text = summary_text(found | {"scene": "made up"})
    assert "set point 80 to 100 K" in text and "set point 10 bar" in text
    if hint is None:
        assert two["temperature_scatter_K"] is None and "from the 100 K before" not in text
        return
    level, variance = 100.0 + off, spread**2
    scatter = np.sqrt(2 * level**2 / 117 - variance)
    assert two["temperature_scatter_K"] == pytest.approx(scatter, rel=1e-9)
    assert (
        f"{off:+.2g} K from the 100 K before: an NVE stage keeps the energy at its start. Such"
        f" temperatures scatter by {scatter:.2g} K{hint}\n" in text
    )


@pytest.mark.soak
def test_temperatures_at_constant_energy_scatter_as_estimated():
    stages = [
        {"ensemble": "nvt", "temperature_K": 100.0, "duration_ps": 15.0, "timestep_fs": 5.0},
        {"duration_ps": 20.0, "timestep_fs": 5.0},
    ]
    sections = {
        "stages": stages,
        "output": {"trajectory": False, "log_interval_ps": 0.05},
        "forces": {"cutoff_A": 8.0},
    }
    runs = [
        Simulation(small_scene({"argon": 100}, 17.5, seed=seed, **sections), warn=str)
        for seed in range(1, 41)
    ]
    found = [results.summary["stages"][1] for results in run_together(runs) if results]
    measured = np.std([stage["temperature_K"] for stage in found], ddof=1)
    estimated = np.sqrt(np.mean([(stage["temperature_scatter_K"] or 0.0) ** 2 for stage in found]))
    assert measured == pytest.approx(estimated, rel=3 / np.sqrt(2 * 39))


@pytest.mark.parametrize(
    "thermostat", ["langevin", "andersen", "velocity_rescaling", "nose_hoover", None]
)
@pytest.mark.parametrize("momentum", [0.0, 0.5, 3.0, 12.0])  # sqrt(M kT) is thermal
def test_a_thermal_momentum_is_noted_where_it_is_conserved(thermostat, momentum):
    stage = {"thermostat": thermostat} if thermostat else {"ensemble": "nve", "temperature_K": None}
    told = noted(
        {"timestep_fs": 2.0} | stage, {"argon": 40}, momentum, temperature=np.full(40, 300.0)
    )
    if thermostat in ("langevin", "andersen"):
        assert [("thermal motion has" in note, "adds" in note) for note in told] == [
            (True, False)
        ] * (momentum > 10)
    else:
        assert ["which adds" in note for note in told] == [True] * (momentum > 0)


@pytest.mark.parametrize(
    ("apart", "spread", "n", "has_note"),
    [
        (7.0, 0.1, 400, True),
        (2.0, 0.1, 400, False),  # certain, and small
        (7.0, 60.0, 400, False),  # large, and not certain
        (7.0, 0.1, 30, False),  # few samples
    ],
)
def test_a_difference_of_temperatures_that_sampling_does_not_explain_has_a_note(
    apart, spread, n, has_note
):
    noise = np.random.default_rng(1).standard_normal((3, n)) * spread
    notes = noted(
        KEPT,
        temperature=300 + noise[0],
        temperature_translation=300 + apart / 2 + noise[1],
        temperature_rotation=300 - apart / 2 + noise[2],
    )
    assert len(notes) == has_note
    for note in notes:
        assert re.search(
            r"T_trans is 303.\d K and T_rot 296.\d K, a difference of 7 ± .* Try", note
        )


@pytest.mark.parametrize(
    ("excess", "integrator", "n", "words"),
    [
        (5.5, "velocity_verlet", 400, "the step of 4 fs leaves the molecules 5.5 K too hot"),
        (-5.5, "velocity_verlet", 400, "5.5 K too cold"),
        (1.4, "velocity_verlet", 400, ""),  # 0.5 %
        (5.5, "velocity_verlet", 30, ""),  # too few samples in its half
        (-5.5, "baoab", 400, ""),  # whose thermostat acts elsewhere
    ],
)
def test_a_thermostat_at_the_ends_of_steps_that_leaves_another_temperature_has_a_note(
    excess, integrator, n, words
):
    noise = np.random.default_rng(1).standard_normal(n)
    per_square = 2 / 12 * (4 * FEMTOSECOND) ** 2 / (6 * 40 - 3) / BOLTZMANN * KJ_PER_MOL
    notes = noted(
        KEPT | {"integrator": integrator},
        temperature=300 + noise,
        force_squares=(excess + noise / 10) / per_square,
    )
    assert len(notes) == bool(words)
    for note in notes:
        assert words in note and "Try timestep_fs = 2, or integrator = 'baoab'" in note


def test_points_have_one_temperature():
    noise = np.random.default_rng(0).standard_normal(200)
    points = {
        "temperature_rotation": np.full(200, np.nan),
        "temperature_translation": 310 + noise,
        "temperature": 310 + noise,
    }
    assert noted(KEPT, {"argon": 40}, **points) == []


@pytest.mark.parametrize(
    ("thermostat", "freedom"), [("langevin", 6 * 40), ("velocity_rescaling", 6 * 40 - 3)]
)
def test_a_drift_is_reported_in_the_thermal_energy_of_the_degrees_of_freedom_of_its_stage(
    thermostat, freedom
):
    """A thermostat that changes the total momentum has three more. Errors have the same units."""
    time = 0.05 * np.arange(400)
    drift = 0.7 * time + 0.01 * np.random.default_rng(0).standard_normal(400)
    summary = summarised(
        {"thermostat": thermostat}, time=time, drift=drift, temperature=np.full(400, 300.0)
    )
    (stage,) = summary["stages"]
    line = slope(time, drift)
    assert line.value == pytest.approx(0.7, rel=0.01)
    for kind, of_time in (("drift", line.value), ("drift_error", line.error)):
        assert stage[f"{kind}_kJ_mol_ns_per_molecule"] == pytest.approx(1000 * of_time / 40)
        expected = 1000 * of_time * KJ_PER_MOL / (BOLTZMANN * 300 * freedom)
        assert stage[f"{kind}_kT_ns_per_degree_of_freedom"] == pytest.approx(expected)


@pytest.mark.parametrize(
    ("rate", "n", "interval", "noise", "told"),
    [
        (1.0, 400, 0.05, 0.01, True),  # kT/ns over 20 ps
        (1.0, 50, 0.004, 1e-6, False),  # over 0.2 ps, as clear as can be: 2e-4 kT in all
        (0.05, 400, 0.05, 1e-4, False),  # small
        (1.0, 400, 0.05, 100.0, False),  # noise
        (1.0, 20, 0.5, 0.0, False),  # few samples
        (20.0, 100, 0.05, 0.01, True),
    ],
)
@pytest.mark.parametrize("ensemble", ["nve", "nvt"])
def test_a_drift_is_noted_where_it_is_certain_and_has_added_up(
    rate, n, interval, noise, told, ensemble
):
    time = interval * np.arange(n)
    slope = rate / 1000 * BOLTZMANN / KJ_PER_MOL * 300 * (6 * 40 - 3)  # kJ/mol/ps
    drift = slope * time + noise * np.random.default_rng(2).standard_normal(n)
    stage = KEPT if ensemble == "nvt" else {"ensemble": "nve", "temperature_K": None}
    found = noted(stage, time=time, drift=drift)
    assert len(found) == told
    if told:
        assert re.search(r"drifts by \+[\d.]+ ± [\d.e-]+ kT/ns per degree of freedom", found[0])
        assert "Try a shorter timestep_fs than 4 or truncation = 'smooth_switch'" in found[0]
        assert ("thermostat hides" in found[0]) == (ensemble == "nvt")
        assert "smooth" not in noted(stage, truncation="smooth_switch", time=time, drift=drift)[0]


def test_a_run_prints_each_note_once(tmp_path, capsys):
    """The values of the introduction and warnings are not repeated; the summary has all."""
    scene = {"watch.move": False, "stages.0.timestep_fs": 40.0, "stages.0.duration_ps": 0.4}
    text = "[box]\nlengths_A = 20\n[[molecules]]\nmodel = 'argon'\ncount = 20\n[start]\ntemperature_K = 90\n"
    text += "[[stages]]\nensemble = 'nve'\n[forces]\ncutoff_A = 3.0\n[output]\nfigures = false\n"
    (tmp_path / "s.toml").write_text(text)
    options = [f"--set={key}={str(value).lower()}" for key, value in scene.items()]
    assert main(["run", str(tmp_path / "s.toml"), *options, "-o", str(tmp_path / "out")]) == 0
    said = "".join(capsys.readouterr())
    notes = json.loads((tmp_path / "out" / "summary.json").read_text())["notes"]
    assert any("its minimum" in note for note in notes)
    assert [said.count(note) for note in notes] == [1] * len(notes)
