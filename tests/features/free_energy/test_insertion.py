"""Insertion: energies against the engine, integrals over a single atom, what is refused."""

import json

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.signal import lfilter
from support.common import history, observe, shaken, small_scene

import rigidmd
from rigidmd.assemble.build import build
from rigidmd.commands.cli import main
from rigidmd.core.state import state_of
from rigidmd.core.statistics import mean_and_error
from rigidmd.errors import OutputError
from rigidmd.features.analysis.registry import known
from rigidmd.features.analysis.runs import Runs
from rigidmd.features.free_energy.guest import CORE, Guest, model_named
from rigidmd.features.free_energy.insertion import Trials, _profile
from rigidmd.mechanics.rotation import random_rotations
from rigidmd.scene.models import load_model
from rigidmd.units import BAR, BOLTZMANN, KJ_PER_MOL

insertion = known()["insertion"].function
TRICLINIC = {"lengths_A": [17.0, 16.0, 18.0], "angles_deg": [80.0, 95.0, 100.0]}
CUBE = {"lengths_A": 13.0}
SUM = {"cutoff_A": 5.5, "ewald_cutoff_A": 5.5, "ewald_alpha_per_A": 0.5}
MESH = SUM | {"electrostatics": "pme", "pme_order": 6, "pme_grid": [24, 24, 24]}
WATER = [{"model": "spce", "count": 40}]
ARGON = [{"model": "argon", "count": 40}]
MINE = {
    "name": "mine",
    "energy": "4*d*((s/r)**12-(s/r)**6)",
    "parameters": {"d": 1.0, "s": 3.4},
    "truncation": "force_shift",
}
#: Molecules, box, forces, trial molecule.
SYSTEMS = {
    "tail in a triclinic cell": (
        ARGON,
        TRICLINIC,
        {"cutoff_A": 7.0, "tail_correction": True},
        "argon",
    ),
    "pme in a triclinic cell": (WATER, TRICLINIC, MESH, "spce"),
    "among frozen molecules": (
        [{"model": "spce", "name": "ice", "count": 20, "frozen": True}, *WATER],
        TRICLINIC,
        {"cutoff_A": 5.5, "electrostatics": "reaction_field"},
        "co2_trappe",
    ),
    "an ion by ewald": (
        WATER,
        CUBE,
        SUM | {"electrostatics": "ewald", "ewald_k_max": 7},
        "na_spce",
    ),
    "dispersion by pme": (
        [*ARGON, {"model": "nitrogen_trappe", "count": 20}],
        TRICLINIC,
        MESH
        | {"truncation": "shift", "dispersion": "pme", "mixing": "geometric"}
        | {"dispersion_beta_per_A": 0.5, "dispersion_order": 6, "dispersion_grid": [24, 24, 24]},
        "nitrogen_trappe",
    ),
    "user potential": (
        ARGON,
        TRICLINIC,
        {"cutoff_A": 7.0, "lennard_jones": False, "custom": [MINE]},
        "argon",
    ),
}
RARE = ("an ion by ewald", "dispersion by pme", "user potential")


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.extended] if name in RARE else []) for name in SYSTEMS],
)
def test_energies_are_the_differences_of_the_engine(name):
    """A scene with the molecule gives the second energy."""
    molecules, box, forces, model = SYSTEMS[name]
    added = [*molecules, {"model": model, "name": "added", "count": 1}]
    bare, whole = (
        build(small_scene({}, 1.0, molecules=some, box=box, forces=forces))
        for some in (molecules, added)
    )
    bare, engine, state = shaken(bare, 3, 0.2)
    rng = np.random.default_rng(3)
    position, rotation = rng.random((60, 3)) @ state.cell, random_rotations(rng, 60)
    energies = Guest(bare, model_named(model), 300.0).energies(state, position, rotation)
    fits = np.flatnonzero(energies < CORE)[:4]
    assert len(fits) > 1 and np.isinf(energies).any()
    before = observe(bare, engine, state).potential
    rotations = (
        state.rotation if len(state.rotation) else np.tile(np.eye(3), (len(state.position), 1, 1))
    )
    for k in fits:
        trial = state_of(
            position=np.vstack([state.position, position[k]]),
            rotation=np.concatenate([rotations, rotation[k : k + 1]])
            if len(whole.state.rotation)
            else None,
            cell=state.cell,
        )
        after = observe(whole, whole.engine(), trial).potential
        assert energies[k] == pytest.approx(after - before, rel=1e-8, abs=1e-5)


ATOM = [{"model": "krypton", "count": 1, "frozen": True}, {"model": "argon", "count": 1}]
TEMPERATURE = 150.0


def frames_about_an_atom(frames=200):
    """A frozen atom of krypton, and an atom of argon."""
    scene = small_scene(
        {},
        24.0,
        molecules=ATOM,
        forces={"cutoff_A": 10.0, "truncation": "plain", "switch_start_A": None},
        stages=[{"ensemble": "nvt", "temperature_K": TEMPERATURE, "duration_ps": 1.0}],
    )
    system = build(scene)
    positions = np.tile([[5.0, 6.0, 7.0], [17.0, 18.0, 19.0]], (frames, 1, 1))
    return history(system, np.arange(frames), positions, np.diag([24.0] * 3))


def exact_about_an_atom(temperature):
    """mu_ex, kJ/mol; Henry constant, mol/(kg Pa); heat of adsorption, kJ/mol."""
    one, other = load_model("krypton"), load_model("argon")
    sigma = (one.sigma[0] + other.sigma[0]) / 2
    well, thermal = np.sqrt(one.epsilon[0] * other.epsilon[0]), BOLTZMANN * temperature

    def u(r):
        return 4 * well * ((sigma / r) ** 12 - (sigma / r) ** 6) / thermal

    def shell(function):
        return quad(lambda r: 4 * np.pi * r**2 * function(u(r)), 1.0, 10.0, epsrel=1e-10)[0]

    volume = 24.0**3
    weight = volume + shell(lambda x: np.expm1(-x)) - 4 / 3 * np.pi
    energy = shell(lambda x: x * np.exp(-x))
    per_kg = weight * 1e-30 / (one.mass * 1.66053907e-27) / (1.380649e-23 * temperature)
    return (
        -np.log(weight / volume) * thermal / KJ_PER_MOL,
        per_kg / 6.02214076e23,
        (1 - energy / weight) * thermal / KJ_PER_MOL,
    )


@pytest.mark.parametrize("temperature", [150.0, 30.0])
def test_zero_loading_is_the_integral_over_an_atom_with_honest_errors(temperature):
    """Deviations of 30 seeds, in units of their errors. At 30 K the mean weight and the mean energy
    vary together, so that the error of the heat has to be that of their ratio."""
    exact = exact_about_an_atom(temperature)
    frames = frames_about_an_atom()
    pulls = []
    for seed in range(30):
        result = insertion(
            frames, "argon", trials=100, zero_loading=True, seed=seed, temperature=temperature
        )
        assert [value.unit for value in result.values] == ["kJ/mol", "mol/(kg Pa)", "kJ/mol"]
        pulls.append([(v.value - x) / v.error for v, x in zip(result.values, exact, strict=True)])
    spread = np.sqrt(np.mean(np.square(pulls), axis=0))
    assert (np.abs(np.mean(pulls, axis=0)) < 3 * spread / np.sqrt(30)).all()
    assert (spread > 0.6).all() and (spread < 1.1).all()


def test_several_runs_and_other_species():
    """With frozen molecules only the chemical potential is defined."""
    frames = frames_about_an_atom()
    result = insertion(Runs((frames, frames)), "neon", trials=200)
    (mu,) = result.values
    assert mu.name == "mu_ex of neon" and mu.error > 0
    assert "80000 trials at 150 K" in result.notes[0]


def test_ideal_gas():
    """Atoms far from each other: fugacities are the partial pressures of an ideal gas, and the Henry
    constant is the total pressure."""
    scene = small_scene({"neon": 3, "argon": 5}, 300.0, forces={"cutoff_A": 6.0})
    positions = np.tile(100.0 * np.array(list(np.ndindex(2, 2, 2))), (30, 1, 1))
    frames = history(build(scene), np.arange(30), positions, np.diag([300.0] * 3))
    of_one = BOLTZMANN * 300.0 / 300.0**3 / BAR
    for name, title, count in (
        ("neon", "fugacity", 3),
        ("argon", "fugacity", 5),
        ("krypton", "Henry constant", 8),
    ):
        value = insertion(frames, name, trials=300).value(f"{title} of {name}")
        assert value.value == pytest.approx(count * of_one, rel=1e-3)


def test_frames_count_by_their_volumes():
    """An atom of argon with one of krypton in boxes of two sizes: <V w> is <V> and the integral of
    exp(-u/kT) - 1."""
    stage = {"ensemble": "npt", "temperature_K": TEMPERATURE, "pressure_bar": 1.0}
    forces = {"cutoff_A": 10.0, "truncation": "plain", "switch_start_A": None}
    scene = small_scene(
        {"krypton": 1},
        22.0,
        forces=forces | {"tail_correction": False},
        stages=[stage | {"duration_ps": 1.0}],
    )
    edges = np.tile([22.0, 40.0], 100)
    cells = edges[:, None, None] * np.eye(3)
    frames = history(
        build(scene), np.arange(200), np.full((200, 1, 3), 5.0), cells, temperature=TEMPERATURE
    )
    thermal = BOLTZMANN * TEMPERATURE / KJ_PER_MOL
    mu = exact_about_an_atom(TEMPERATURE)[0]
    integral = 24.0**3 * np.expm1(-mu / thermal)
    expected, unweighted = (
        -thermal * np.log1p(integral * inverse)
        for inverse in (1 / np.mean(edges**3), np.mean(1 / edges**3))
    )
    found = insertion(frames, "argon", trials=400).value()
    assert abs(found.value - expected) < 4 * found.error < abs(unweighted - expected) / 2


def test_a_profile_is_of_the_distance_from_the_middle():
    """A frozen layer of krypton that argon does not enter."""
    grid = np.array([[x, y, 5.0] for x in range(0, 24, 3) for y in range(0, 24, 3)], float)
    molecules = [{"model": "krypton", "count": len(grid), "frozen": True}]
    molecules.append({"model": "argon", "count": 1})
    scene = small_scene({}, 24.0, molecules=molecules, forces={"cutoff_A": 10.0})
    positions = np.tile(np.vstack([grid, [0.0, 0.0, 17.0]]), (10, 1, 1))
    frames = history(build(scene), np.arange(10), positions, np.diag([24.0] * 3))
    result = insertion(frames, "argon", trials=2000, axis="z")
    z, mu = result["z (A)"], result["mu_ex"]
    inside = mu[np.abs(z) < 1.5]
    assert (np.isnan(inside) | (inside > 500.0)).all() and np.isnan(inside).any()
    near = (np.abs(z) > 3) & (np.abs(z) < 4.5)
    far = (np.abs(z) > 9) & (np.abs(z) < 10)
    assert mu[near].max() < mu[far].min() < 0.5


@pytest.mark.parametrize("spread", [0.3, 1.0])
def test_errors_of_exponential_averages(spread):
    """Pulls of ln <w> of series of correlated weights exp(x) with a normal x. The larger of two
    estimates makes them narrower than 1, see the theory chapter `errors`."""
    rng, memory, pulls = np.random.default_rng(8), np.exp(-1 / 2), []
    noise = np.sqrt(1 - memory**2) * rng.standard_normal((300, 300))
    for series in lfilter([1.0], [1.0, -memory], noise, axis=1)[:, 60:]:
        weight = np.exp(spread * series - spread**2 / 2)
        _, error = mean_and_error(weight / weight.mean())
        pulls.append(np.log(weight.mean()) / error)
    assert 0.7 < np.sqrt(np.mean(np.square(pulls))) < 1.05


@pytest.mark.parametrize("temperature", [1e-6, 0.01, 3.0])
def test_weights_beyond_the_range_of_numbers_have_a_chemical_potential(temperature):
    """exp(-u/kT) has no number where u is below -700 kT. The Henry constant has one if the
    logarithm of its value allows it."""
    result = insertion(
        frames_about_an_atom(20), "argon", trials=2000, zero_loading=True, temperature=temperature
    )
    mu, henry, heat = result.values
    assert all(v.value is None or np.isfinite([v.value, v.error]).all() for v in result.values)
    if temperature < 1:
        assert "So far: -1.1" in mu.note and "So far: 1.1" in heat.note
        assert "is beyond the range of numbers: use mu_ex" in henry.note
    else:
        assert "e+" in henry.note or henry.value > 1e10


def test_atoms_of_low_temperature_have_a_core():
    """500 kT at 0.1 K are less than the well depth."""
    guest = Guest(frames_about_an_atom(2).system, load_model("argon"), 0.1)
    near = np.array([[5.0, 6.0, 10.9]])
    positions = np.array([[5.0, 6.0, 7.0], [17.0, 18.0, 19.0]])
    state = state_of(position=positions, cell=np.diag([24.0] * 3))
    assert guest.energies(state, near, np.eye(3)[None])[0] < -500 * BOLTZMANN * 0.1


COUPLED = [*ARGON, {"model": "argon", "name": "solute", "count": 1}]


def frames_of_atoms(molecules, forces=None, **sections):
    system = build(
        small_scene(
            {}, 24.0, molecules=molecules, forces={"cutoff_A": 9.0} | (forces or {}), **sections
        )
    )
    positions = np.tile(system.state.position, (30, 1, 1))
    return history(system, np.arange(30), positions, np.diag([24.0] * 3))


def test_the_species_of_coupling_is_not_inserted():
    frames = frames_of_atoms(COUPLED, coupling={"species": "solute", "lambda": 0.1})
    with pytest.raises(
        OutputError, match=r"scales the interactions of solute \(lambda 0.1 of solute"
    ):
        insertion(frames, "solute")
    (mu, *_) = insertion(frames, "argon").values
    assert "the run has lambda 0.1 of solute" in mu.note
    whole = frames_of_atoms(COUPLED, coupling={"species": "solute", "lambda": 1.0})
    same = insertion(whole, "solute").values[0]
    assert same.value == pytest.approx(insertion(whole, "argon").values[0].value, rel=1e-6)
    assert "lambda" not in same.note


def test_charges_are_not_dropped():
    """Without charges in the system they have no energy, of which there is a note."""
    ions = [{"model": "na_spce", "count": 20, "frozen": True}, {"model": "cl_spce", "count": 20}]
    frames = frames_of_atoms(ions, forces={"electrostatics": "none"})
    words = "electrostatics = 'none' ignores the charges of co2_trappe and of na_spce, cl_spce"
    with pytest.raises(OutputError, match=words):
        insertion(frames, "co2_trappe")
    with pytest.raises(OutputError, match=r"and of na_spce: set forces\.electrostatics = 'pme'"):
        insertion(frames, "co2_trappe", zero_loading=True)
    assert insertion(frames, "krypton", trials=3).values
    for forces in ({}, {"electrostatics": "none"}):
        (mu, *_) = insertion(frames_of_atoms(ARGON, forces=forces), "co2_trappe", trials=300).values
        assert "the charges of co2_trappe act on nothing" in mu.note


def test_a_molecule_on_which_nothing_acts_is_refused():
    mine = MINE | {"parameters": {"Ar": {"d": 1.0, "s": 3.4}}}
    frames = frames_of_atoms(ARGON, forces={"lennard_jones": False, "custom": [mine]})
    with pytest.raises(OutputError, match="no force of the run acts on krypton"):
        insertion(frames, "krypton")


def test_a_profile_keeps_small_weights_next_to_large_ones():
    """On one side of the middle the weight is 1e30 times as large."""
    height = np.tile(np.linspace(-9.9, 9.9, 400), (10, 1))
    energy = np.where(height < 0, -np.log(1e30), np.log(2.0))
    sets = [Trials(np.full(10, 8000.0), energy, height, lowest=float(energy.min()))]
    curve = _profile(sets, KJ_PER_MOL, "z")
    mu, z = curve.columns["mu_ex"], curve.axis[1]
    assert mu[z > 0.3] == pytest.approx(np.log(2.0), rel=1e-12)
    assert mu[z < -0.3] == pytest.approx(-np.log(1e30), rel=1e-12)


def test_errors_of_a_profile_are_those_of_its_scatter():
    """ln <w> of weights exp(-x) with a normal x, in each bin."""
    rng, pulls, spread = np.random.default_rng(9), [], 0.5
    for _ in range(30):
        height = rng.uniform(-10, 10, (50, 400))
        energy = spread * rng.standard_normal(height.shape)
        trials = Trials(np.full(50, 8000.0), energy, height, lowest=float(energy.min()))
        curve = _profile([trials], KJ_PER_MOL, "z")
        mu, error = curve.columns["mu_ex"], curve.errors["mu_ex"]
        pulls.append((mu + spread**2 / 2) / error)
    assert 0.8 < np.quantile(np.abs(pulls), 0.683) < 1.2


def test_what_has_no_meaning_is_refused():
    frames = frames_about_an_atom(30)
    few = insertion(frames, "argon", trials=1, zero_loading=True).value()
    assert few.value is None
    assert "the largest 1 % of the trials carry" in few.note and "So far" in few.note
    with pytest.raises(OutputError, match="a box"):
        insertion(history(frames.system, np.arange(4), frames.positions[:4]))
    with pytest.raises(OutputError, match="no_such_model"):
        insertion(frames, "no_such_model")
    with pytest.raises(OutputError, match=r"trials is 0, must be from 1 to 1e\+06"):
        insertion(frames, trials=0)
    gas = build(small_scene({"neon": 3}, 30.0))
    with pytest.raises(OutputError, match="frozen"):
        insertion(history(gas, np.arange(4), None, np.diag([30.0] * 3)), "neon", zero_loading=True)


@pytest.mark.usefixtures("reads_here")
def test_the_command(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene = small_scene(
        {"argon": 60},
        24.0,
        stages=[{"ensemble": "nvt", "temperature_K": 150.0, "duration_ps": 8.0}],
        output={"trajectory_interval_ps": 0.1, "figures": False, "log_interval_ps": 0.1},
    )
    results = rigidmd.Simulation(scene, tmp_path / "run").run()
    assert main(["analyse", "run", "insertion", "model=krypton", "trials=300", "axis=z"]) == 0
    assert "mu_ex of krypton" in capsys.readouterr().out
    entry = json.loads((tmp_path / "run/analysis.json").read_text())["analyses"]["insertion"]
    same = rigidmd.analysis.insertion(results, "krypton", trials=300)
    assert entry["values"][0]["value"] == pytest.approx(same.value().value, rel=1e-6)
    assert (tmp_path / "run/insertion.csv").is_file()
    for words, message in (
        (["insertion", "trial=3"], "trials"),
        (["insertion", "trials=many"], "is not like trials=1000"),
        (["rdf", "trials=3"], "unknown option"),
    ):
        assert main(["analyse", "run", *words]) != 0
        assert message in capsys.readouterr().err
    assert main(["analyse", "run"]) == 0
    assert "insertion" not in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["analyse", "--list"])
    assert "insertion" in capsys.readouterr().out
