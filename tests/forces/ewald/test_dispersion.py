"""Dispersion by Ewald sums: plain lattice sums, gradients, accuracy, OpenMM's LJPME, conserved
energy, threads."""

from functools import partial
from itertools import product

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import erfc
from support.common import bits_with, built, observe, shaken, small_scene
from support.slopes import energy_of, force_on, torque_on, trace_of_virial, virial_of

import rigidmd
from rigidmd.assemble.build import build
from rigidmd.compile.machine import MOST_THREADS
from rigidmd.core.statistics import slope
from rigidmd.errors import SceneError
from rigidmd.features.external.engines import external_engine
from rigidmd.run import Simulation
from rigidmd.run.kind import describe
from rigidmd.units import KJ_PER_MOL

BOXES = [
    {"lengths_A": [13.0, 13.5, 15.0]},
    {"lengths_A": [15.0, 14.0, 15.0], "angles_deg": [80.0, 100.0, 75.0]},
]
MIXTURE = [{"model": "argon", "count": 3}, {"model": "co2_trappe", "count": 3}]
PLAIN = {"cutoff_A": 6.0, "truncation": "plain", "mixing": "geometric", "electrostatics": "none"}
EWALD = PLAIN | {
    "dispersion": "ewald",
    "dispersion_accuracy": 1e-13,
}  # the energy of the k-vectors omitted has one sign
MESH = PLAIN | {
    "dispersion": "pme",
    "dispersion_beta_per_A": 0.5,
    "dispersion_grid": [36, 36, 40],
    "dispersion_order": 8,
}


def mixture(forces, box, seed=5, molecules=MIXTURE, **sections):
    """A system, its engine with the terms of Lennard-Jones, and a shaken state."""
    system, _, state = shaken(
        build(small_scene({}, None, molecules=molecules, box=box, forces=forces, **sections)), seed
    )
    return system, system.engine(), state


def lattice_sum(system, state, cutoff):
    """-c c/r⁶ of all images and c12/r¹² within the cutoff. Far images end softly, beyond them the
    density is uniform: a plain sum, of which the correction is exact but for exp(-(pi d/L)²) with
    the width d of the end."""
    position, cell, owner = system.site_positions(state), state.cell, system.sites.molecule
    sigma, epsilon = (
        system.of_sites(lambda m, name=name: getattr(m, name)) for name in ("sigma", "epsilon")
    )
    strength, longest = 2 * sigma**3 * np.sqrt(epsilon), np.linalg.norm(cell, axis=1).max()
    middle, width, edge = 8 * longest, 1.4 * longest, 5.5

    def weight(r):
        x = (r - middle) / width
        return np.where(x < -edge, 1.0, np.where(x > edge, 0.0, 0.5 * erfc(x)))

    first, last = middle - edge * width, middle + edge * width
    reach = np.ceil(last / system.space.edges).astype(int)
    images = np.stack(
        np.meshgrid(*(np.arange(-n, n + 1) for n in reach), indexing="ij"), axis=-1
    ).reshape(-1, 3)
    shift, home = images @ cell, (images == 0).all(axis=1)
    energy = 0.0
    for i, j in product(range(len(position)), repeat=2):
        r = np.linalg.norm(position[i] - position[j] + shift, axis=1)
        r = r[~(home & (owner[i] == owner[j]))]
        energy -= 0.5 * strength[i] * strength[j] * np.sum(weight(r) / r**6)
        if owner[i] != owner[j]:
            r = r[r < cutoff]
            energy += (
                2 * np.sqrt(epsilon[i] * epsilon[j]) * (sigma[i] * sigma[j]) ** 6 * np.sum(r**-12.0)
            )
    beyond = quad(lambda r: (1 - weight(r)) / r**4, first, last, epsabs=0, epsrel=1e-9)[0] + 1 / (
        3 * last**3
    )
    return energy - 2 * np.pi / abs(np.linalg.det(cell)) * strength.sum() ** 2 * beyond


@pytest.mark.parametrize("box", BOXES)
def test_the_sum_is_the_plain_lattice_sum_for_any_beta(box):
    found = []
    for beta in (0.95, 1.1):
        system, engine, state = mixture(EWALD | {"dispersion_beta_per_A": beta}, box)
        found.append(observe(system, engine, state).potential)
    assert found[0] == pytest.approx(found[1], rel=1e-10)
    assert found[0] == pytest.approx(lattice_sum(system, state, 6.0), rel=1e-10)


@pytest.mark.parametrize("box", BOXES)
def test_the_mesh_is_the_sum(box):
    """With a fine mesh: energy, forces, torques and the trace of the virial."""
    (system, engine, state), (other, direct, _) = (
        mixture(f | {"dispersion_beta_per_A": 0.5}, box) for f in (MESH, EWALD)
    )
    mesh, exact = observe(system, engine, state), observe(other, direct, state)
    # relative to what cancels: the self energy, and the reciprocal forces between sites of a
    # molecule
    size = np.abs(direct.workspaces["dispersion_reciprocal"].site_force).max()
    assert mesh.potential == pytest.approx(
        exact.potential, abs=1e-8 * other.constants["dispersion_self"]
    )
    assert mesh.load.force == pytest.approx(exact.load.force, abs=5e-7 * size)
    assert mesh.load.torque_body == pytest.approx(exact.load.torque_body, abs=5e-7 * size)
    assert mesh.virial == pytest.approx(exact.virial, abs=1e-5 * np.abs(exact.virial).max())


@pytest.mark.parametrize("box", BOXES)
@pytest.mark.parametrize("forces", [EWALD | {"dispersion_beta_per_A": 0.9}, MESH])
def test_forces_torques_and_virial_are_slopes_of_the_energy(forces, box):
    """With the default mixing rule and shifted energies. The virial along each edge and across with
    the direct sum."""
    _, engine, state = mixture(forces | {"mixing": "lorentz-berthelot", "truncation": "shift"}, box)
    load, tallies = engine.evaluate(state)
    virial, h = sum(tally.virial for tally in tallies.values()), 1e-3
    energy = partial(energy_of, engine)
    scale = np.abs(load.force).max()
    for m in (0, 4):
        assert load.force[m] == pytest.approx(force_on(m, energy, state, h), abs=3e-7 * scale)
    torque = torque_on(4, energy, state, h)
    assert load.torque_body[4] == pytest.approx(torque, abs=3e-7 * scale)
    size = np.abs(virial).max()
    assert virial.trace() == pytest.approx(trace_of_virial(energy, state, 1e-4), abs=1e-6 * size)
    if forces["dispersion"] == "ewald":
        for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2)):  # cells stay lower triangles
            slope = virial_of(energy, state, 1e-4, (i, j))
            assert virial[i, j] == pytest.approx(slope, abs=1e-6 * size)


@pytest.mark.parametrize(
    ("asked", "method", "box"),
    [(1e-4, "ewald", 0), (2e-4, "pme", 0), (2e-4, "pme", 1)]
    + [
        pytest.param(a, m, 0, marks=pytest.mark.soak)
        for a, m in product([1e-3, 1e-5], ["ewald", "pme"])
    ],
)
def test_forces_are_as_accurate_as_requested(asked, method, box):
    """Within a factor 2, relative to 24 epsilon/sigma, with molecules of one site each; as the note
    states."""
    box = [
        {"lengths_A": 22.0},
        {"lengths_A": [24.0, 23.0, 24.0], "angles_deg": [75.0, 100.0, 80.0]},
    ][box]
    forces = {
        "cutoff_A": 8.0,
        "truncation": "shift",
        "dispersion": method,
        "dispersion_accuracy": asked,
    }
    molecules = [{"model": "argon", "count": 150}, {"model": "krypton", "count": 60}]
    system, engine, state = mixture(forces, box, molecules=molecules)
    _, direct, _ = mixture(
        forces | {"dispersion": "ewald", "dispersion_accuracy": 1e-9}, box, molecules=molecules
    )
    off = engine.evaluate(state)[0].force - direct.evaluate(state)[0].force
    measured = np.sqrt((off**2).sum(axis=1).mean()) / max(
        24 * m.epsilon[0] / m.sigma[0] for m in system.species
    )
    assert 0.5 * asked < measured < 2 * asked


@pytest.mark.parametrize("asked", [5e-5, 1e-4])
@pytest.mark.parametrize(
    "box",
    [{"lengths_A": 18.0}, {"lengths_A": 40.0}, {"lengths_A": [18.0, 17.0, 16.0], "vacuum_A": 30.0}],
)
def test_the_note_has_the_error_that_was_requested(asked, box):
    """In a liquid, in a dilute box, of which a part is filled, and in a slab."""
    forces = {
        "cutoff_A": 7.9,
        "truncation": "shift",
        "dispersion": "ewald",
        "dispersion_accuracy": asked,
    }
    system, _, _ = mixture(forces, box, molecules=[{"model": "argon", "count": 90}])
    (argon,) = system.species
    (note,) = [note for note in system.notes if "Estimated rms error of its force" in note]
    expected = asked * 24 * argon.epsilon[0] / argon.sigma[0] / KJ_PER_MOL
    assert float(note.split(": ")[-1].split()[0]) == pytest.approx(expected, rel=0.02)


def test_defaults_are_written_and_resolve_to_themselves():
    scene = small_scene(
        {"spce": 64}, 18.6, forces={"cutoff_A": 8.0, "truncation": "shift", "dispersion": "pme"}
    )
    resolved = rigidmd.with_defaults(scene)
    assert rigidmd.with_defaults(resolved) == resolved
    forces = resolved.forces
    assert (forces.dispersion_accuracy, forces.tail_correction) == (5e-5, False)
    assert None not in (
        forces.dispersion_beta_per_A,
        forces.dispersion_order,
        forces.dispersion_grid,
    )
    assert resolved.run.remove_momentum_interval_ps == 1.0
    assert "dispersion by pme: beta" in describe(scene)


def test_openmm_has_the_same_energy_and_forces():
    """LJPME with Lorentz-Berthelot mixing: geometric on the grid, as here."""
    openmm = pytest.importorskip("openmm")
    box, cutoff, beta = [13.0, 13.5, 15.0], 6.0, 0.4
    forces = {
        "cutoff_A": cutoff,
        "truncation": "shift",
        "electrostatics": "none",
        "dispersion": "pme",
        "dispersion_beta_per_A": beta,
        "dispersion_grid": [60, 60, 64],
        "dispersion_order": 8,
    }
    system, engine, state = mixture(forces, {"lengths_A": box})
    other, force = openmm.System(), openmm.NonbondedForce()
    other.setDefaultPeriodicBoxVectors(*(np.diag(box) / 10))
    sigma, epsilon = (
        system.of_sites(lambda m, name=name: getattr(m, name)) for name in ("sigma", "epsilon")
    )
    owner = system.sites.molecule
    for s, e in zip(sigma, epsilon, strict=True):
        other.addParticle(1.0)
        force.addParticle(0.0, s / 10, e / KJ_PER_MOL)
    for i, j in zip(*np.triu_indices(len(owner), 1), strict=True):
        if owner[i] == owner[j]:
            force.addException(int(i), int(j), 0.0, 0.1, 0.0)
    force.setNonbondedMethod(openmm.NonbondedForce.LJPME)
    force.setCutoffDistance(cutoff / 10)
    force.setUseSwitchingFunction(False)
    force.setLJPMEParameters(10 * beta, 100, 100, 100)
    force.setPMEParameters(10 * beta, 16, 16, 16)
    other.addForce(force)
    context = openmm.Context(
        other, openmm.VerletIntegrator(0.001), openmm.Platform.getPlatformByName("Reference")
    )
    context.setPositions(system.site_positions(state) / 10)
    found = context.getState(getEnergy=True, getForces=True)
    theirs = found.getForces(asNumpy=True)._value * KJ_PER_MOL / 10
    seen, total = observe(system, engine, state), np.zeros_like(state.position)
    np.add.at(total, owner, theirs)
    sums = system.constants["dispersion_self"]  # which nearly cancel
    assert seen.potential == pytest.approx(
        found.getPotentialEnergy()._value * KJ_PER_MOL, abs=1e-7 * sums
    )
    assert seen.load.force == pytest.approx(total, abs=1e-6 * np.abs(total).max())


@pytest.mark.parametrize("model", ["argon", "co2_trappe"])
def test_mixed_precision(model):
    """One kind of sites and several."""
    forces = {"cutoff_A": 8.0, "truncation": "shift", "dispersion": "pme", "electrostatics": "none"}
    system, _, state = built({model: 150}, 21.0, 3, 0.2, forces=forces)
    exact, found = (
        system.engine_of(system.terms, how).evaluate(state)[0] for how in ("double", "mixed")
    )
    for one, other in zip(exact, found, strict=True):
        assert np.linalg.norm(one - other) <= 1e-5 * np.linalg.norm(one)


def test_same_bits_for_any_number_of_threads():
    if MOST_THREADS < 2:
        pytest.skip("one core")
    forces = {
        "cutoff_A": 8.0,
        "truncation": "shift",
        "dispersion": "pme",
        "electrostatics": "none",
        "dispersion_accuracy": 1e-5,
    }
    system, _, state = built({"co2_trappe": 200}, 24.0, 7, forces=forces)
    assert bits_with(1, system, state) == bits_with(2, system, state)


def run_of(**stage):
    forces = {
        "cutoff_A": 8.0,
        "truncation": "shift",
        "dispersion": "pme",
        "dispersion_accuracy": 2e-4,
        "electrostatics": "none",
    }
    first = {"ensemble": "minimise"}
    data = dict(
        molecules=[{"model": "argon", "count": 108}],
        start={"temperature_K": 100.0},
        stages=[first, stage],
    )
    scene = small_scene({}, 17.2, forces=forces, output={"log_interval_ps": 0.05}, **data)
    rows = Simulation(scene).run().samples.rows
    rows = [row for row in rows if row.stage == rows[-1].stage]
    return np.array([row.time for row in rows]), np.array([row.conserved for row in rows]) / 108


@pytest.mark.parametrize("barostat", [None, "cell_rescaling"])
def test_energy_is_conserved(barostat):
    """Without a barostat and with one, whose work is the integral of the pressure: energy and
    virial agree."""
    stage = {"ensemble": "nve", "duration_ps": 5.0, "timestep_fs": 4.0}
    if barostat:
        stage |= {
            "ensemble": "npt",
            "temperature_K": 100.0,
            "thermostat": "langevin",
            "friction_translation_per_ps": 0.5,
            "pressure_bar": 300.0,
            "barostat": barostat,
            "barostat_time_ps": 0.5,
        }
    time, energy = run_of(**stage)
    found = slope(time, energy)
    assert np.std(energy) < 2e-3  # kJ/mol per molecule; kT is 0.83
    assert abs(found.value) < 4 * found.error + 2e-4


@pytest.mark.parametrize(
    ("forces", "words"),
    [
        ({"dispersion": "lj"}, "dispersion"),
        ({"dispersion": "pme", "tail_correction": True}, "count what lies beyond the cutoff twice"),
        (
            {"dispersion": "pme", "truncation": "switch"},
            "truncation = 'switch' would change the sum",
        ),
        ({"dispersion": "pme", "lennard_jones": False}, "lennard_jones is false"),
        ({"dispersion": "ewald", "dispersion_order": 5}, "belong to 'pme'"),
        ({"dispersion_accuracy": 1e-4}, "would have no effect with dispersion = 'cutoff'"),
        (
            {"dispersion": "pme", "custom": [{"name": "a", "energy": "1/r^9"}]},
            "custom forces have no such sum",
        ),
        (
            {"dispersion": "pme", "dispersion_beta_per_A": 2.0, "cutoff_A": 8.0},
            "cannot be reached at beta",
        ),
        (
            {"dispersion": "pme", "dispersion_grid": [8, 8, 8], "dispersion_accuracy": 1e-9},
            "cannot be reached at beta",
        ),
        ({"dispersion": "ewald", "dispersion_beta_per_A": 0.9, "dispersion_accuracy": 1e-12}, None),
    ],
)
def test_settings_that_make_no_sense(forces, words):
    if words is None:
        build(
            small_scene(
                {"argon": 3}, 17.0, forces={"cutoff_A": 8.0, "truncation": "shift"} | forces
            )
        )
        return
    with pytest.raises(SceneError, match=words):
        build(
            small_scene(
                {"argon": 3}, 17.0, forces={"cutoff_A": 8.0, "truncation": "shift"} | forces
            )
        )


def test_what_is_refused_is_reported():
    forces = {"cutoff_A": 8.0, "truncation": "shift", "dispersion": "pme"}
    with pytest.raises(SceneError, match="needs a periodic box"):
        build(small_scene({"argon": 3}, None, forces=forces))
    frozen = [{"model": "argon", "count": 3}, {"model": "krypton", "count": 2, "frozen": True}]
    with pytest.raises(SceneError, match="act between frozen molecules"):
        build(small_scene({}, 17.0, molecules=frozen, forces=forces))
    other = small_scene({"argon": 30}, 20.0, forces=forces, engine={"name": "openmm"})
    with pytest.raises(SceneError, match=r"forces\.dispersion = 'pme': OpenMM has cutoff"):
        external_engine(build(other))
