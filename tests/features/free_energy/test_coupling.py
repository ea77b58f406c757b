"""Coupling: energies at both ends and in between, forces, the log, free energies with known
values."""

import sys

import numpy as np
import pytest
from scipy.integrate import quad
from support.common import ROOT, built, move, observe, shaken, small_scene
from support.reference import nearest
from support.slopes import force_on, torque_on

import rigidmd
from rigidmd.assemble.build import build, integrator_of_stage
from rigidmd.commands.cli import main
from rigidmd.core.state import state_of
from rigidmd.errors import OutputError, SceneError
from rigidmd.features.free_energy.coupling import energy_to_lambda
from rigidmd.features.free_energy.estimate import SampledLambda, free_energy_of
from rigidmd.features.free_energy.soft_core import SOFTNESS, SoftCore
from rigidmd.scene.models import load_model
from rigidmd.units import BOLTZMANN, KJ_PER_MOL

TRICLINIC = {"lengths_A": [17.0, 16.0, 18.0], "angles_deg": [80.0, 95.0, 100.0]}
TAIL = {"cutoff_A": 7.0, "tail_correction": True, "truncation": "shift"}
MESH = {
    "cutoff_A": 5.5,
    "electrostatics": "pme",
    "pme_order": 6,
    "pme_grid": [24, 24, 24],
    "ewald_cutoff_A": 5.5,
    "ewald_alpha_per_A": 0.5,
}
ARGON, WATER = {"model": "argon", "count": 60}, {"model": "spce", "count": 40}
#: Other molecules, model and number of the coupled ones, forces.
SYSTEMS = {
    "atoms": (ARGON, "krypton", 2, TAIL),
    "waters": (WATER, "spce", 1, MESH),
    "an ion": (WATER, "na_spce", 1, MESH),
}


def coupled_scene(name, value=None, count=None, **coupling):
    """A scene of `SYSTEMS`; without a value of lambda, one without [coupling]."""
    other, model, number, forces = SYSTEMS[name]
    guests = [{"model": model, "name": "guest", "count": number}] if count is None else []
    tables = {"molecules": [other, *guests], "box": TRICLINIC, "forces": forces}
    if value is not None:
        tables["coupling"] = {"species": "guest", "lambda": value, **coupling}
    return small_scene({}, 1.0, **tables)


def changes_of(observation):
    """The energies at coupling.lambdas less the present one."""
    names = [name for name in vars(observation.sample) if name.startswith("energy_to_lambda")]
    return [getattr(observation, name) for name in names]


@pytest.mark.parametrize("name", SYSTEMS)
def test_both_ends_are_the_plain_scene_and_the_one_without_the_molecules(name):
    plain, engine, state = shaken(build(coupled_scene(name)), 3, 0.2)
    full = build(coupled_scene(name, 1.0, lambdas=[0.0, 0.4, 1.0]))
    assert full.terms.keys() == plain.terms.keys()
    expected = observe(plain, engine, state)
    found = observe(full, full.engine(), state, stage=0)
    assert found.potential == expected.potential
    assert np.array_equal(found.virial, expected.virial)
    bare, absent = build(coupled_scene(name, count=0)), build(coupled_scene(name, 0.0))
    n = len(bare.model.species)
    rest = state_of(
        position=state.position[:n],
        rotation=state.rotation[:n] if len(state.rotation) else None,
        cell=state.cell,
    )
    without = observe(bare, bare.engine(), rest)
    alone = observe(absent, absent.engine(), state)
    assert alone.potential == pytest.approx(without.potential, rel=1e-9)
    assert np.allclose(alone.load.force[:n], without.load.force, rtol=1e-7, atol=1e-6)
    assert not alone.load.force[n:].any() and not alone.load.torque_body[n:].any()
    changes = changes_of(found)
    assert changes[0] == pytest.approx(without.potential - expected.potential, rel=1e-6)
    assert changes[2] == 0.0
    between = build(coupled_scene(name, 0.4))
    energy = observe(between, between.engine(), state).potential
    assert changes[1] == pytest.approx(energy - expected.potential, rel=1e-9)


@pytest.mark.parametrize("value", [0.3, 0.8])
def test_the_tail_of_soft_cores_is_that_of_all_pairs(value):
    """Of two unlike kinds in different numbers, by quadrature beyond the cutoff."""
    forces = {"cutoff_A": 7.0, "tail_correction": True, "truncation": "plain"}
    coupling = {"species": "guest", "lambda": value}
    species = [ARGON, {"model": "krypton", "name": "guest", "count": 3}]
    system = build(
        small_scene({}, 1.0, molecules=species, box=TRICLINIC, forces=forces, coupling=coupling)
    )
    models, counts = [load_model("argon"), load_model("krypton")], (60, 3)
    energy = pressure = 0.0
    for i, j in np.ndindex(2, 2):
        sigma = (models[i].sigma[0] + models[j].sigma[0]) / 2
        depth = 4 * np.sqrt(models[i].epsilon[0] * models[j].epsilon[0])
        of_pair = 1.0 if i == j == 0 else value

        def s(r, sigma=sigma, of_pair=of_pair):
            return (r / sigma) ** 6 + (1 - of_pair) / 2

        def by_energy(r, s=s, depth=of_pair * depth):
            return r**2 * depth * (1 / s(r) ** 2 - 1 / s(r))

        def by_slope(r, s=s, depth=of_pair * depth, sigma=sigma):
            slope = 6 * r**5 / sigma**6 * (1 / s(r) ** 2 - 2 / s(r) ** 3)
            return -(r**3) * depth * slope / 3

        energy += 2 * np.pi * counts[i] * counts[j] * quad(by_energy, 7, np.inf)[0]
        pressure += 2 * np.pi * counts[i] * counts[j] * quad(by_slope, 7, np.inf)[0]
    volume = system.space.volume
    assert system.tail.energy(volume) == pytest.approx(energy / volume, rel=1e-7)
    assert system.tail.pressure(volume) == pytest.approx(pressure / volume**2, rel=1e-7)


def test_charges_follow_lennard_jones():
    """Charges of the coupled species scale the self energies and the pairs inside it too."""
    for value, factor in ((0.3, 0.0), (0.5, 0.0), (0.75, 0.5), (1.0, 1.0)):
        system = build(coupled_scene("waters", value))
        assert np.allclose(system.species[1].charges, factor * load_model("spce").charges)
        assert np.array_equal(system.species[0].charges, load_model("spce").charges)
        assert ("soft_core" in system.terms) == (value < 0.5)
        whole = build(coupled_scene("waters", 1.0)).constants
        for name in ("coulomb_self", "coulomb_intramolecular"):
            assert system.constants[name] == pytest.approx(whole[name] * (40 + factor**2) / 41)
    system = build(coupled_scene("waters", 0.6, charges_from=0.2))
    assert np.allclose(system.species[1].charges, 0.5 * load_model("spce").charges)


@pytest.mark.parametrize(
    "truncation",
    ["shift", "switch", *(pytest.param(n, marks=pytest.mark.extended) for n in ("force_switch",))],
)
def test_the_soft_core_is_the_formula_of_the_paper(truncation):
    """Beutler et al. 1994, eq. 5, with plain loops over all pairs; two coupled molecules."""
    value, cutoff, start = 0.35, 7.0, 6.0
    forces = {"cutoff_A": cutoff, "truncation": truncation}
    if truncation != "shift":
        forces["switch_start_A"] = start
    _, engine, state = built(
        {},
        1.0,
        spread=1.5,
        molecules=[ARGON, {"model": "krypton", "name": "guest", "count": 2}],
        box=TRICLINIC,
        forces=forces,
        coupling={"species": "guest", "lambda": value},
    )
    argon, krypton = load_model("argon"), load_model("krypton")

    def bare(r, sigma, epsilon):
        s = SOFTNESS * (1 - value) + (r / sigma) ** 6
        return value * 4 * epsilon * (1 / s**2 - 1 / s)

    expected = 0.0
    for i in range(60, 62):
        for j in range(i):
            other = krypton if j >= 60 else argon
            sigma = (krypton.sigma[0] + other.sigma[0]) / 2
            epsilon = np.sqrt(krypton.epsilon[0] * other.epsilon[0])
            r = np.linalg.norm(nearest(state.position[i] - state.position[j], state.cell))
            if r >= cutoff:
                continue
            u, t = bare(r, sigma, epsilon), (r - start) / (cutoff - start)
            if truncation == "shift":
                u -= bare(cutoff, sigma, epsilon)
            elif truncation == "switch":
                u *= 1 - 10 * t**3 + 15 * t**4 - 6 * t**5 if t > 0 else 1.0
            else:
                formula = SoftCore(
                    *(value * 4 * epsilon * sigma**p for p in (12, 6)),
                    SOFTNESS * (1 - value) * sigma**6,
                )
                _, force, slope = formula.radial(cutoff)
                d = cutoff - start
                a, b = (slope - 3 * force / d) / d, (2 * force / d - slope) / d**2
                x = max(0.0, r - start)
                u += a * (d**3 - x**3) / 3 + b * (d**4 - x**4) / 4 - bare(cutoff, sigma, epsilon)
            expected += u
    energy = engine.evaluate(state)[1]["soft_core"].energy
    assert energy == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("value", [0.2, 0.8])
def test_forces_and_torques_are_derivatives_of_the_energy(value):
    system, engine, state = shaken(build(coupled_scene("waters", value)), 5, 0.2)
    load = engine.evaluate(state)[0]
    guest, step = 40, 1e-4

    def energy(moved):
        return observe(system, engine, moved).potential

    for found, expected in (
        (load.force[guest], force_on(guest, energy, state, step)),
        (load.torque_body[guest], torque_on(guest, energy, state, step)),
    ):
        assert found == pytest.approx(expected, abs=1e-4 * (np.abs(found).max() + 1.0))


def test_the_second_derivative_of_the_soft_core():
    formula = SoftCore(3.0e8, 4.0e5, 900.0)
    for r in (1.5, 3.0, 4.5):
        (_, f, s), h = formula.radial(r), 1e-4
        one, other = formula.radial(r + h), formula.radial(r - h)
        assert (other[0] - one[0]) / (2 * h) == pytest.approx(f, rel=1e-6)
        assert (one[1] - other[1]) / (2 * h) == pytest.approx(s, rel=1e-6)


def test_energy_is_conserved_at_half_coupling():
    """A quarter of the error with half the step, also of coupled atoms that overlap others."""
    errors = []
    for dt in (0.004, 0.002):
        system, engine, state = built(
            {},
            1.0,
            spread=0.2,
            molecules=[ARGON, {"model": "krypton", "name": "guest", "count": 8}],
            box={"lengths_A": 20.0},
            forces={"cutoff_A": 8.0, "truncation": "switch", "switch_start_A": 6.0},
            coupling={"species": "guest", "lambda": 0.5},
        )
        state.position[60:] = state.position[:8] + 0.5
        scheme, energies = integrator_of_stage(system, 0), []
        for _ in range(50):
            move(engine, state, scheme, dt, round(0.02 / dt))
            energies.append(observe(system, engine, state).energy)
        errors.append(np.std(energies))
    assert errors[0] / errors[1] == pytest.approx(4.0, abs=0.1)
    assert errors[0] < 1e-4 * np.mean(energies)


def test_energies_of_other_lambdas_do_not_depend_on_earlier_states():
    """So that a run that resumes has the same bits in its log."""
    system, engine, state = shaken(build(coupled_scene("atoms", 0.5, lambdas=[0.2, 0.8])), 1, 0.3)
    once = changes_of(observe(system, engine, state, stage=0))
    moved = state.copy()
    moved.position[:] += 0.1 * np.random.default_rng(1).standard_normal(moved.position.shape)
    assert changes_of(observe(system, engine, moved, stage=0)) != once
    moved.time[:] += 1.0
    assert changes_of(observe(system, engine, state, stage=0)) == once
    assert len(once) == 2


def test_what_cannot_be_coupled_is_refused():
    for coupling, tables, message in (
        ({"species": "neon"}, {}, "neon is not among the species, argon, guest"),
        ({"species": "guest", "lambda": 1.5}, {}, "coupling.lambda: is 1.5"),
        (
            {"species": "guest"},
            {"forces": TAIL | {"custom": [{"name": "mine", "energy": "1/r**9"}]}},
            "only Lennard-Jones forces and charges are scaled",
        ),
        (
            {"species": "guest"},
            {
                "molecules": [
                    ARGON,
                    {"model": "krypton", "name": "guest", "count": 1, "frozen": True},
                ],
                "forces": TAIL | {"tail_correction": False},
            },
            "its molecules are frozen",
        ),
    ):
        molecules = [ARGON, {"model": "krypton", "name": "guest", "count": 1}]
        whole = {"molecules": molecules, "box": TRICLINIC, "forces": TAIL} | tables
        with pytest.raises(SceneError, match=message):
            build(small_scene({}, 1.0, **whole, coupling=coupling))


# two atoms in a box: the free energy is an integral

EDGE, CUTOFF, TEMPERATURE = 20.0, 9.0, 120.0
THERMAL = BOLTZMANN * TEMPERATURE
MODEL = load_model("argon")


def energy_of_two(r, value):
    """kT; truncated and shifted."""
    c12, c6 = (value * 4 * MODEL.epsilon[0] * MODEL.sigma[0] ** p for p in (12, 6))
    formula = SoftCore(c12, c6, SOFTNESS * (1 - value) * MODEL.sigma[0] ** 6)

    def u(r):
        return (formula.c12 / (r**6 + formula.softness) - formula.c6) / (r**6 + formula.softness)

    return np.where(r < CUTOFF, u(r) - u(CUTOFF), 0.0) / THERMAL


def exact_of_two():
    """kJ/mol"""
    shell = quad(
        lambda r: 4 * np.pi * r**2 * np.expm1(-energy_of_two(r, 1.0)), 1.0, CUTOFF, epsrel=1e-10
    )[0]
    return -THERMAL / KJ_PER_MOL * np.log1p((shell - 4 / 3 * np.pi) / EDGE**3)


def test_mbar_has_the_integral_over_two_atoms_with_honest_errors():
    """Distances drawn from their distributions; deviations of 10 seeds in units of the errors."""
    lambdas, pulls = [0.0, 0.3, 0.6, 1.0], []
    places = np.random.default_rng(0).random((60_000, 3)) - 0.5
    r = EDGE * np.linalg.norm(places, axis=1)
    energies = np.array([energy_of_two(r, value) for value in lambdas])
    for seed in range(10):
        rng, runs = np.random.default_rng(seed), []
        for k in range(4):
            weight = np.exp(-energies[k] + energies[k].min())
            drawn = rng.choice(len(r), 400, p=weight / weight.sum())
            changes = (energies[:, drawn] - energies[k, drawn]).T
            runs.append(SampledLambda(k, changes))
        parts = [("F", 0.0, 1.0), ("forth", 0.3, 0.6), ("back", 0.6, 0.3)]
        result = free_energy_of(lambdas, runs, THERMAL / KJ_PER_MOL, parts)
        value, forth, back = map(result.value, ("F", "forth", "back"))
        assert (forth.value, forth.error) == pytest.approx((-back.value, back.error))
        exact_of_drawn = -THERMAL / KJ_PER_MOL * np.log(np.mean(np.exp(-energies[-1])))
        pulls.append((value.value - exact_of_drawn) / value.error)
    assert abs(np.mean(pulls)) < 3 / np.sqrt(10)
    assert 0.5 < np.sqrt(np.mean(np.square(pulls))) < 1.6
    assert exact_of_drawn == pytest.approx(exact_of_two(), abs=3e-3)


def test_correlated_samples_are_used_once():
    rng = np.random.default_rng(2)
    changes = rng.standard_normal((400, 2))
    changes[:, 0] = 0.0
    run, repeated = (SampledLambda(0, x) for x in (changes, np.repeat(changes, 5, axis=0)))
    assert len(run.decorrelated) >= 200
    assert len(repeated.decorrelated) < 1.5 * len(run.decorrelated)


def test_overlap_of_lambdas_with_different_numbers_of_samples():
    """Two harmonic energies: the overlap is the mean fraction, in samples at the first lambda, of
    the second one; rows of the matrix have the sum 1."""
    rng, counts, gap, runs = np.random.default_rng(4), (4000, 500), 3.0, []
    for k, count in enumerate(counts):
        x = rng.standard_normal(count) + gap * k
        energies = np.stack([x**2 / 2, (x - gap) ** 2 / 2], axis=1)
        runs.append(SampledLambda(k, energies - energies[:, [k]]))
    result = free_energy_of([0.0, 1.0], runs, 2.5)
    matrix = np.stack([result["lambda 0"], result["lambda 1"]], axis=1)
    assert matrix.sum(axis=1) == pytest.approx([1.0, 1.0], abs=1e-6)
    x = np.linspace(-8, 12, 4001)
    first, second = (np.exp(-((x - gap * k) ** 2) / 2) for k in (0, 1))
    fraction = second * counts[1] / (first * counts[0] + second * counts[1])
    exact = np.average(fraction, weights=first)
    assert result.value("least overlap of neighbours").value == matrix[0, 1]
    assert matrix[0, 1] == pytest.approx(exact, rel=0.1)


def test_few_samples_and_missing_overlap_are_reported():
    rng = np.random.default_rng(3)
    near, far = (rng.standard_normal((200, 2)) for _ in range(2))
    near[:, 0] = far[:, 1] = 0.0
    near[:, 1] += 15.0
    far[:, 0] += 15.0
    result = free_energy_of([0.0, 1.0], [SampledLambda(0, near), SampledLambda(1, far)], 2.5)
    assert any("barely overlap" in note and "add a point" in note for note in result.notes)
    with pytest.raises(OutputError, match=r"5 decorrelated samples at lambda = 1.*run longer"):
        free_energy_of([0.0, 1.0], [SampledLambda(0, near), SampledLambda(1, far[:5])], 2.5)


TWO_ATOMS = f"""
[box]
lengths_A = {EDGE}
[[molecules]]
model = "argon"
count = 1
[[molecules]]
model = "argon"
name = "guest"
count = 1
[coupling]
species = "guest"
lambdas = [0.0, 0.4, 1.0]
[forces]
cutoff_A = {CUTOFF}
tail_correction = false
[[stages]]
ensemble = "nvt"
thermostat = "langevin"
friction_translation_per_ps = 2.0
temperature_K = {TEMPERATURE}
duration_ps = 400
timestep_fs = 10
[output]
log_interval_ps = 0.5
trajectory = false
figures = false
"""


def test_a_sweep_has_a_free_energy(tmp_path, capsys, monkeypatch):
    """The log, the commands, and what is refused. The free energy is the integral."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "two.toml").write_text(TWO_ATOMS)
    sets = ["--set", "coupling.lambda=0,0.4,1"]
    assert main(["sweep", "two.toml", "-o", "sweep", "--jobs", "2", *sets]) == 0
    log = tmp_path / "sweep/lambda=0.4/log.csv"
    headers = [energy_to_lambda(value).header for value in (0.0, 0.4, 1.0)]
    assert all(header in log.read_text().splitlines()[0] for header in headers)
    capsys.readouterr()
    assert main(["analyse", "sweep", "free_energy"]) == 0
    printed = capsys.readouterr().out
    for text in ("free energy of coupling", "overlap matrix", "an ideal gas of the same number"):
        assert text in printed
    value = rigidmd.free_energy(tmp_path / "sweep").value()
    assert abs(value.value - exact_of_two()) < 4 * value.error < 0.1
    density = 1e27 / 6.02214076e23 / EDGE**3  # of one molecule, mol/L
    assert f"number density, {density:.4g} mol/L," in value.note
    assert main(["analyse", "sweep/lambda=1", "free_energy"]) == 2
    assert "free_energy needs a sweep over coupling.lambda" in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, "pymbar", None)
    with pytest.raises(OutputError, match="free_energy needs pymbar: pip install"):
        rigidmd.free_energy(tmp_path / "sweep")
    log.write_text(log.read_text().replace(headers[2], "Other"))
    with pytest.raises(OutputError, match=r"no energy at lambda = 1\. List all values"):
        rigidmd.free_energy(tmp_path / "sweep")


@pytest.mark.soak
def test_water_in_water_has_the_published_free_energy(tmp_path, monkeypatch, capsys):
    """-7.05 kcal/mol (Wang et al. 2009, table 3), within 0.1 kcal/mol and the error; the scene of
    the guide."""
    monkeypatch.chdir(tmp_path)
    guide = (ROOT / "rigidmd/docs/guides/free_energies.md").read_text(encoding="utf-8")
    scene = guide.partition("file hydration.toml -->\n```toml\n")[2].partition("```")[0]
    (tmp_path / "hydration.toml").write_text(scene)
    values = "0,0.1,0.2,0.3,0.5,0.625,0.75,0.875,1"
    sets = ["--set", f"coupling.lambda={values}", "--set", "stages.0.duration_ps=600"]
    assert main(["sweep", "hydration.toml", "-o", "sweep", *sets]) == 0
    value = rigidmd.free_energy(tmp_path / "sweep").value("free energy of coupling")
    with capsys.disabled():
        print(value)
    assert abs(value.value + 7.05 * 4.184) < 0.1 * 4.184 + 2 * value.error
    assert value.error < 0.1 * 4.184
