"""OpenMM as an engine: energies, forces on bodies and trajectories agree with rigidmd."""

import json
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
from scipy.special import erfc
from support.common import built, shaken, small_scene
from support.reference import Oracle

from rigidmd.assemble.build import build
from rigidmd.commands import cli
from rigidmd.core.state import HEAT
from rigidmd.engines.observables import kinetic_energies
from rigidmd.engines.protocol import NotFiniteError
from rigidmd.errors import EngineError, SceneError
from rigidmd.features.external.engines import external_engine
from rigidmd.features.external.force_field import force_field_of
from rigidmd.features.external.openmm.engine import OpenmmEngine
from rigidmd.features.external.openmm.files import write_openmm
from rigidmd.features.external.openmm.system import TRANSLATIONS as table
from rigidmd.features.external.rigid_bodies import RigidBodies, mass_points
from rigidmd.mechanics.inertia import inertia_tensor
from rigidmd.mechanics.rotation import random_rotations
from rigidmd.run.record import read_record
from rigidmd.scene.models import available_models, load_model
from rigidmd.units import BAR, BOLTZMANN, COULOMB

pytest.importorskip("openmm")

#: An isosceles triangle whose base has two masses.
HDO = {
    "name": "hdo",
    "count": 4,
    "sites": [
        {
            "name": "O",
            "element": "O",
            "mass_u": 15.999,
            "position_A": [0, 0, 0],
            "charge_e": -0.8,
            "sigma_A": 3.1,
            "epsilon_kJ_mol": 0.6,
        },
        {
            "name": "H",
            "element": "H",
            "mass_u": 1.008,
            "position_A": [0.8, 0.6, 0],
            "charge_e": 0.4,
        },
        {
            "name": "D",
            "element": "H",
            "mass_u": 2.014,
            "position_A": [-0.8, 0.6, 0],
            "charge_e": 0.4,
        },
    ],
}
#: Every kind of body, and argon so that all have several kinds of Lennard-Jones sites: that
#: compiles once.
CLUSTERS = [
    {"spce": 4},
    {"tip4p2005": 4},
    {"tip5p": 4},
    {"nitrogen_trappe": 6},
    {"co2_trappe": 5},
    {"benzene_opls": 3},
    {"methane_opls": 4},
    {"methanol_trappe": 4},
    {"ammonia_trappe": 4},
    {"tip5p": 2, "co2_trappe": 2, "benzene_opls": 1, "methane_opls": 2, "spce": 2, "na_spce": 1},
]
MIXTURE = CLUSTERS[-1]


def difference(found, expected):
    """Largest difference relative to the root of the mean square."""
    return np.abs(found - expected).max() / np.sqrt((expected**2).mean())


def agree(ours, theirs, state, tolerance, of_loads=None):
    """Assert that two engines have the same energies by term and loads; the virials of both."""
    (load, tallies), (other, counted) = ours.evaluate(state), theirs.evaluate(state)
    assert set(tallies) == set(counted)
    moving = system_moves(theirs)
    for name, tally in tallies.items():
        assert counted[name].energy == pytest.approx(tally.energy, rel=tolerance), name
    for mine, its in zip(load, other, strict=True):
        assert difference(its[moving], mine[moving]) < (of_loads or tolerance)
    return (sum(t.virial for t in found.values()) for found in (tallies, counted))


def system_moves(engine):
    """Which molecules are not frozen: what acts on the others has no meaning."""
    return ~force_field_of(engine._system).frozen


@pytest.mark.parametrize("name", available_models())
@pytest.mark.parametrize("sites", [True, False])
def test_mass_points_move_as_the_molecule(name, sites):
    molecule = load_model(name)
    body = mass_points(molecule, sites=sites)
    size = molecule.mass * max(molecule.radius, 1.0)
    assert body.mass.sum() == pytest.approx(molecule.mass, rel=1e-12)
    assert np.abs(body.mass @ body.position_body).max() < 1e-12 * size
    off = inertia_tensor(body.mass, body.position_body) - np.diag(molecule.inertia)
    assert np.abs(off).max() <= 1e-12 * molecule.inertia.max()
    point = body.position_body
    normal = np.cross(point[1] - point[0], point[2] - point[0]) if len(point) == 3 else np.zeros(3)
    found = {k: site.weight @ point + site.cross * normal for k, site in body.virtual_sites.items()}
    assert sorted([*found, *body.site[body.site >= 0]]) == list(range(len(molecule.masses)))
    for site, position in found.items():
        assert np.abs(position - molecule.positions_body[site]).max() < 1e-10
    assert len(body.mass) == {"point": 1, "linear": 2}.get(
        molecule.kind, 3 if planar(molecule) else 4
    )


def planar(molecule):
    a, b, c = molecule.inertia
    return abs(a + b - c) < 1e-10 * c


@pytest.mark.parametrize("counts", CLUSTERS, ids=lambda counts: "-".join(counts))
def test_energies_and_forces_on_bodies_of_a_cluster(counts):
    system, ours, state = built(counts | {"argon": 2}, None, seed=3, spread=0.2)
    theirs = OpenmmEngine(system, platform="Reference")
    agree(ours, theirs, state, 1e-10)
    particles, (at, _) = theirs._particles, theirs._particles.positions(state)
    theirs._put(theirs._evaluating_context, state)
    theirs._evaluating_context.computeVirtualSites()
    virtual_sites = (
        theirs._evaluating_context.getState(getPositions=True).getPositions(asNumpy=True)._value
        * 10
    )
    assert np.abs(virtual_sites - at)[particles.site].max() < 1e-10


def test_molecules_whose_base_has_two_masses_keep_their_shape():
    """OpenMM's SETTLE would take such a triangle for one with equal masses, and end in numbers that
    are none."""
    scene = small_scene({}, None, molecules=[HDO, {"model": "argon", "count": 2}])
    system, ours, state = shaken(build(scene), 2, 0.1)
    agree(ours, OpenmmEngine(system, platform="Reference"), state, 1e-10)
    row = system.scene.stages[0].scheme
    mine = extrapolated(system, system.engine, state, row)
    its = extrapolated(system, lambda: OpenmmEngine(system, platform="Reference"), state, row)
    assert np.abs(its - mine).max() < 1e-6


def extrapolated(system, make, start, row):
    """Positions of sites after 50 fs, from steps of 1, 1/2 and 1/4 fs extrapolated to none: those
    of no integrator."""
    found = []
    for n in (1, 2, 4):
        engine = make()
        state = engine.begin(start, row)
        engine.advance(state, row, 1e-3 / n, 50 * n)
        found.append(system.site_positions(state))
    first, second = ((4 * b - a) / 3 for a, b in pairwise(found))
    return (16 * second - first) / 15


@pytest.mark.parametrize("platform", ["Reference", "CPU"])
def test_both_engines_go_the_same_way(platform):
    """OpenMM rotates bodies by keeping distances, another method of order 2: what is left at no step
    is the physics."""
    system, _, state = built(MIXTURE | {"argon": 2}, None, seed=3, spread=0.1)
    row = system.scene.stages[0].scheme
    mine = extrapolated(system, system.engine, state, row)
    its = extrapolated(system, lambda: OpenmmEngine(system, platform=platform), state, row)
    # SETTLE reads distances in single precision
    assert np.abs(its - mine).max() < 1e-6
    assert np.abs(mine - system.site_positions(state)).max() > 0.1


def test_linear_bodies_stay_rotations_however_often_they_are_read():
    """Their spin about the axis is nobody's: what was read last decides, and its rounding must not
    grow."""
    system, _, state = built({"co2_trappe": 5, "argon": 2}, None, seed=3)
    bodies, rng = RigidBodies(system), np.random.default_rng(1)
    found = state
    for _ in range(300):
        turned = state._replace(rotation=random_rotations(rng, len(state.rotation)))
        position = system.site_positions(turned)
        found = bodies.state(found, position, np.zeros_like(position), state.cell)
    axes = [s.rotation[:5] @ system.species[0].positions_body[1] for s in (found, turned)]
    assert np.abs(axes[0] - axes[1]).max() < 1e-14
    unit = np.einsum("nij,nik->njk", found.rotation, found.rotation)
    assert np.abs(unit - np.eye(3)).max() < 1e-14
    opposite = found._replace(rotation=found.rotation * [-1.0, -1.0, 1.0])
    position = system.site_positions(opposite)
    assert np.isfinite(
        bodies.state(found, position, np.zeros_like(position), state.cell).rotation
    ).all()


BOX = {"forces": {"cutoff_A": 6.0}}
ENDINGS = ("plain", "shift", "force_shift", "force_switch", "switch", "smooth_switch")


WAYS = [*((ending, "lorentz-berthelot") for ending in ENDINGS), ("switch", "geometric")]


@pytest.mark.parametrize(("truncation", "mixing"), WAYS)
def test_truncations_and_mixing(truncation, mixing):
    forces = {
        "cutoff_A": 6.0,
        "truncation": truncation,
        "mixing": mixing,
        "reaction_field_permittivity": 20.0,
    }
    system, _, state = built({"spce": 8, "argon": 8}, 13.0, forces=forces)
    tallies = OpenmmEngine(system, platform="Reference").evaluate(state)[1]
    expected = Oracle(system).energy(state.position, state.rotation)
    assert [tallies[name].energy for name in ("lennard_jones", "coulomb")] == pytest.approx(
        expected, rel=1e-9
    )


def test_damped_shifted_force():
    forces = {"cutoff_A": 6.0, "electrostatics": "damped_shifted_force"}
    system, _, state = built({"spce": 8, "argon": 8}, 13.0, forces=forces)
    found = OpenmmEngine(system, platform="Reference").evaluate(state)[1]["coulomb"].energy
    x, charge, owner = (
        system.site_positions(state),
        force_field_of(system).charge,
        system.sites.molecule,
    )
    i, j = np.triu_indices(len(x), 1)
    d = x[i] - x[j]
    r = np.linalg.norm(d - 13.0 * np.rint(d / 13.0), axis=1)
    near = (r < 6.0) & (owner[i] != owner[j])
    x, end = 0.2 * 6.0, erfc(0.2 * 6.0) / 6.0
    slope = end / 6.0 + 0.4 / np.sqrt(np.pi) * np.exp(-(x**2)) / 6.0
    pairs = charge[i] * charge[j] * (erfc(0.2 * r) / r - end + slope * (r - 6.0))
    assert found == pytest.approx(COULOMB * pairs[near].sum(), rel=1e-9)


def test_a_triclinic_box_with_parameters_of_pairs():
    pairs = [{"sites": ["OW", "AR"], "sigma_A": 3.3, "epsilon_kJ_mol": 0.9}]
    box = {"lengths_A": [15.0, 14.0, 14.5], "angles_deg": [75.0, 80.0, 100.0]}
    for tensor in (True, False):
        scene = small_scene(
            {"spce": 12, "argon": 6},
            1.0,
            box=box,
            forces={"cutoff_A": 6.0, "pairs": pairs},
            output={"pressure_tensor": tensor},
        )
        system, ours, state = shaken(build(scene), 3)
        mine, its = agree(ours, OpenmmEngine(system, platform="Reference"), state, 1e-10)
        # from differences of energies
        assert its.trace() == pytest.approx(mine.trace(), rel=1e-5)
        if tensor:
            assert difference(its, (mine + mine.T) / 2) < 1e-5


def test_pme_with_ions_and_frozen_molecules():
    """On a fine grid, to the accuracy of its splines: the two differ in how they correct for
    them."""
    forces = {
        "cutoff_A": 6.0,
        "electrostatics": "pme",
        "ewald_alpha_per_A": 0.5,
        "pme_order": 5,
        "pme_grid": [64] * 3,
    }
    molecules = [
        {"model": "spce", "count": 12},
        {"model": "na_spce", "count": 2},
        {"model": "spce", "name": "ice", "count": 3, "frozen": True},
    ]
    system, ours, state = shaken(
        build(small_scene({}, 13.0, molecules=molecules, forces=forces)), 3, 0.2
    )
    state.position[-3:], state.rotation[-3:] = (
        system.state.position[-3:],
        system.state.rotation[-3:],
    )
    agree(ours, OpenmmEngine(system, platform="Reference"), state, 1e-6)
    single = OpenmmEngine(system, platform="CPU")
    agree(ours, single, state, 1e-4)


def test_k_vectors_of_ewald_become_a_grid():
    """OpenMM has splines of order 5: a grid of the accuracy requested takes the position of other
    orders and of k-vectors."""
    found = []
    for method in ("ewald", "pme"):
        forces = {
            "cutoff_A": 6.0,
            "electrostatics": method,
            "ewald_accuracy": 1e-6,
            "ewald_truncation": "plain",
        }
        system, _, state = built({"spce": 12}, 13.0, seed=1, forces=forces)
        tallies = OpenmmEngine(system, platform="Reference").evaluate(state)[1]
        found.append(sum(t.energy for t in tallies.values()) + sum(system.constants.values()))
    assert found[0] == pytest.approx(found[1], rel=1e-4)


THERMOSTATS = {
    "nve": {},
    "nose_hoover": {"ensemble": "nvt", "temperature_K": 300.0, "thermostat": "nose_hoover"},
    "langevin": {
        "ensemble": "nvt",
        "temperature_K": 300.0,
        "thermostat": "langevin",
        "friction_translation_per_ps": 10.0,
    },
    "npt": {
        "ensemble": "npt",
        "temperature_K": 300.0,
        "thermostat": "langevin",
        "pressure_bar": 1000.0,
        "barostat": "monte_carlo",
        "barostat_interval_ps": 0.005,
    },
}


def staged(kind, duration=1.0, counts=None):
    stage = {"duration_ps": duration, "timestep_fs": 1.0} | THERMOSTATS[kind]
    scene = small_scene(
        counts or {"spce": 20},
        13.0,
        stages=[stage],
        forces={"cutoff_A": 6.0, "tail_correction": True},
    )
    return shaken(build(scene), 3, 0.1)


def conserved(system, engine, state):
    """Energy less the heat of thermostats, u Å²/ps²."""
    potential = sum(t.energy for t in engine.evaluate(state)[1].values())
    return potential + sum(kinetic_energies(system, state)) - state.energy_ledger[HEAT]


@pytest.mark.parametrize("kind", THERMOSTATS)
def test_stages_repeat_continue_and_conserve(kind):
    system, _, start = staged(kind)
    row = system.scene.stages[0].scheme

    def fresh():
        engine = OpenmmEngine(system, platform="Reference")
        return engine, engine.begin(start, row)

    engine, state = fresh()
    before = conserved(system, engine, state)
    engine.advance(state, row, 1e-3, 60)
    memory, kept = engine.memory(), state.copy()
    if kind == "nve":
        assert abs(conserved(system, engine, state) - before) < 2e-2 * sum(
            kinetic_energies(system, state)
        )
    engine.advance(state, row, 1e-3, 100)
    other, again = fresh()
    other.advance(again, row, 1e-3, 60)
    other.evaluate(again)  # observations leave no trace
    other.advance(again, row, 1e-3, 100)
    resumed, _ = fresh()
    resumed.recall(kept, memory)
    resumed.advance(kept, row, 1e-3, 100)
    for found in (again, kept):
        assert all(np.array_equal(a, b) for a, b in zip(found, state, strict=True))
    assert (state.volume != start.volume) == (kind == "npt")
    assert np.abs(state.position - start.position).max() < 6.0  # not wrapped
    turn = np.einsum("nij,nik->njk", state.rotation, state.rotation)
    assert np.abs(turn - np.eye(3)).max() < 1e-12
    engine.close()


def test_what_is_frozen_stays():
    molecules = [
        {"model": "spce", "count": 12},
        {"model": "spce", "name": "ice", "count": 3, "frozen": True},
    ]
    system, _, start = shaken(build(small_scene({}, 13.0, molecules=molecules, **BOX)), 3, 0.1)
    start.position[-3:], start.rotation[-3:] = (
        system.state.position[-3:],
        system.state.rotation[-3:],
    )
    engine, row = OpenmmEngine(system, platform="Reference"), system.scene.stages[0].scheme
    state = engine.begin(start, row)
    engine.advance(state, row, 1e-3, 20)
    assert np.array_equal(state.position[-3:], start.position[-3:])
    assert np.abs(state.position[:-3] - start.position[:-3]).min(axis=1).max() > 0.0


@pytest.mark.soak
@pytest.mark.parametrize("kind", ["nose_hoover", "langevin"])
def test_thermostats_keep_the_temperature_of_both_motions(kind):
    system, _, start = staged(kind)
    row, free = system.scene.stages[0].scheme, system.freedom_in(0)
    engine = OpenmmEngine(system, platform="CPU")
    state, found = engine.begin(start, row), []
    for k in range(1, 6001):
        engine.advance(state, row, 1e-3, 20 * k)
        found.append(kinetic_energies(system, state))
    kinetic = np.array(found)[500:].reshape(11, 500, 2).mean(axis=1) / BOLTZMANN
    of_motion = 2 * kinetic / [free.translation, free.rotation]
    error = of_motion.std(axis=0, ddof=1) / np.sqrt(11)
    assert (np.abs(of_motion.mean(axis=0) - 300.0) < 4 * error).all()
    assert (error < 4.0).all()


@pytest.mark.soak
def test_the_barostat_gives_the_volume_of_an_ideal_gas():
    """(N + 1) kT/P, of bodies that barely touch: the sites of a pair exclude 0.02 Å³, of 140 for
    each molecule.

    The cutoff is short because OpenMM's largest change of the volume is a part of what that was,
    not of what it is."""
    stage = (
        {"duration_ps": 1000.0, "timestep_fs": 2.0} | THERMOSTATS["npt"] | {"pressure_bar": 300.0}
    )
    sites = [
        {
            "name": name,
            "element": "N",
            "position_A": [x, 0.0, 0.0],
            "sigma_A": 0.3,
            "epsilon_kJ_mol": 1e-6,
        }
        for name, x in (("N1", -0.5), ("N2", 0.5))
    ]
    gas = {"name": "gas", "count": 20, "sites": [site | {"mass_u": 14.0} for site in sites]}
    system = build(small_scene({}, 14.0, molecules=[gas], stages=[stage], forces={"cutoff_A": 0.5}))
    engine, row = OpenmmEngine(system, platform="Reference"), system.scene.stages[0].scheme
    state, found = engine.begin(system.state, row), []
    for k in range(1, 20001):
        engine.advance(state, row, 2e-3, 10 * k)
        found.append(state.volume)
    means = np.array(found).reshape(20, 1000).mean(axis=1)
    expected = 21 * BOLTZMANN * 300.0 / (300.0 * BAR)
    error = means.std(ddof=1) / np.sqrt(20)
    assert abs(means.mean() - expected) < 4 * error < 0.08 * expected


def test_the_folder_runs_by_itself(tmp_path):
    stages = [
        {"name": kind, "duration_ps": 0.01, "timestep_fs": 1.0} | THERMOSTATS[kind]
        for kind in THERMOSTATS
    ]
    every = {"log_interval_ps": 0.005, "trajectory_interval_ps": 0.005}
    system = build(
        small_scene(
            {"tip4p2005": 10, "co2_trappe": 3, "methane_opls": 2},
            13.0,
            stages=stages,
            output=every,
            **BOX,
        )
    )
    drawn = force_field_of(system)
    names = write_openmm(tmp_path, drawn, system.state)
    assert set(names) == {path.name for path in tmp_path.iterdir()}
    subprocess.run([sys.executable, "run.py", "Reference"], cwd=tmp_path, check=True)
    lines = (tmp_path / "log.csv").read_text().splitlines()
    assert [line.split(",")[0] for line in lines[1:]] == [
        kind for kind in THERMOSTATS for _ in range(2)
    ]
    assert (tmp_path / "final.xml").stat().st_size and (tmp_path / "trajectory.dcd").stat().st_size
    row = system.scene.stages[0].scheme
    engine = OpenmmEngine(system, platform="Reference")
    state = engine.begin(system.state, row)
    engine.advance(state, row, 1e-3, 5)
    expected = sum(t.energy for t in engine.evaluate(state)[1].values()) / 100
    assert float(lines[1].split(",")[2]) == pytest.approx(expected, rel=1e-6)


def test_what_openmm_cannot_do_is_reported_at_once():
    stages = [
        {"duration_ps": 0.1, "ensemble": "nvt", "temperature_K": [300.0, 310.0]},
        {
            "duration_ps": 0.1,
            "ensemble": "npt",
            "temperature_K": 300.0,
            "pressure_bar": 1.0,
            "thermostat": "langevin",
        },
        {"duration_ps": 0.1, "ensemble": "nph", "pressure_bar": 1.0},
        {"duration_ps": 0.1, "integrator": "yoshida_4"},
    ]
    scene = small_scene({"spce": 4}, 13.0, stages=stages, **BOX)
    messages = " ".join(table.refusals(force_field_of(build(scene))))
    for words in (
        "velocity_rescaling",
        "cell_rescaling",
        "nph",
        "changes over the stage",
        "yoshida_4",
    ):
        assert words in messages
    falling = small_scene(
        {"spce": 4},
        13.0,
        fields={"electric_V_per_nm": [0.0, 0.0, 0.1]},
        engine={"name": "openmm"},
        **BOX,
    )
    with pytest.raises(
        SceneError, match=r"engine.name = .openmm.: electric field: a field has no translation for"
    ):
        external_engine(build(falling))


def test_a_platform_that_is_not_there():
    system = build(small_scene({"spce": 4}, 13.0, **BOX))
    with pytest.raises(
        EngineError,
        match=r"no platform 'Abacus' here: there are Reference, CPU.*knows CPU, Reference",
    ):
        OpenmmEngine(system, platform="Abacus")


def test_without_openmm_one_sentence_states_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "openmm", None)
    system = build(small_scene({"spce": 4}, 13.0, **BOX))
    with pytest.raises(
        EngineError, match="OpenMM is not installed: pip install openmm installs it"
    ):
        OpenmmEngine(system)


def test_numbers_that_are_none():
    system = build(small_scene({"spce": 4}, 13.0, **BOX))
    engine, row = OpenmmEngine(system, platform="Reference"), system.scene.stages[0].scheme
    state = engine.begin(system.state, row)
    state.velocity[0] = np.nan
    with pytest.raises(NotFiniteError):
        engine.advance(state, row, 1e-3, 5)


def test_a_run_there_is_a_run_like_any_other(tmp_path, capsys):
    text = """
[box]
lengths_A = 13.0
[[molecules]]
model = "spce"
count = 20
[forces]
cutoff_A = 6.0
[[stages]]
ensemble = "nvt"
temperature_K = 300
duration_ps = 0.02
[[stages]]
duration_ps = 0.02
timestep_fs = 1
[output]
log_interval_ps = 0.01
trajectory_interval_ps = 0.01
"""
    (tmp_path / "water.toml").write_text(text)
    run = [
        "run",
        str(tmp_path / "water.toml"),
        "--engine",
        "openmm",
        "--platform",
        "Reference",
        "-o",
        str(tmp_path / "run"),
    ]
    assert cli.main(run) == 0
    said = capsys.readouterr().out
    assert "computed by OpenMM on its platform Reference" in said
    record = read_record(tmp_path / "run")
    assert list(record.columns["step"]) == [0, 5, 10, 20, 30]
    drift = record.columns["drift"]
    assert np.isnan(drift[1:3]).all() and np.abs(drift[3:]).max() < 0.1  # kJ/mol, of 20 molecules
    assert cli.main(["resume", str(tmp_path / "run"), "--until", "0.05ps"]) == 0
    assert read_record(tmp_path / "run").columns["step"][-1] == 40
    assert cli.main([*run, "--force", "--platform", "Abacus"]) == 2
    assert "Traceback" not in capsys.readouterr().err
    verify = ["verify", str(tmp_path / "water.toml"), "--engine", "openmm", "--json"]
    assert cli.main(verify) == 0
    assert json.loads(capsys.readouterr().out)["engine"].startswith("OpenMM 8")
