"""Minimisation in the rigid degrees of freedom and the cell: gradients, known minima, what a stage
of it states and keeps."""

import csv
import json
import warnings

import ase.units
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from support.common import ROOT, shaken, small_scene

from rigidmd.assemble.build import build
from rigidmd.assemble.describe import describe
from rigidmd.commands.cli import main
from rigidmd.core.state import NOW, State, state_of
from rigidmd.dynamics.model import mobile
from rigidmd.engines.cpu.engine import CpuEngine
from rigidmd.errors import RigidMDWarning, SceneError, SimulationError
from rigidmd.figures.panels import panels
from rigidmd.io.trajectory import read_frames
from rigidmd.run import Every, Simulation
from rigidmd.run import minimise as minimise_module
from rigidmd.run import molecular as molecular_run
from rigidmd.run.minimise import Enthalpy, minimise, precision_of_minimisation
from rigidmd.run.record import read_record
from rigidmd.run.schedule import CheckpointSchedule
from rigidmd.scene import Scene
from rigidmd.scene.models import load_model
from rigidmd.studies.accuracy.accuracy import measure_accuracy
from rigidmd.units import BAR, BOLTZMANN, COULOMB, GRAM_PER_CM3, KJ_PER_MOL
from rigidmd.view.run_page import write_report

MIXTURE = {"argon": 4, "nitrogen": 4, "spce": 6}
FORCES = {"cutoff_A": 6.0, "tail_correction": True}
WELL = 119.8 * BOLTZMANN  # of argon
#: Forces to about 1e-6 of those of a liquid.
TIGHT = {"force_limit_kJ_mol_A": 1e-5, "torque_limit_kJ_mol": 1e-5}
ASKED = {
    "isotropic": 800.0,
    "semi_isotropic": (500.0, 500.0, -1500.0),
    "anisotropic": (500.0, 0.0, 1500.0),
    "flexible": (100.0, 200.0, 300.0, 4000.0, -5000.0, 6000.0),
}


def stage_of(**keys) -> dict:
    return {"ensemble": "minimise"} | keys


def minimum_of(scene, state: State | None = None):
    """The results of a scene from a state, and the figures of its last stage's minimum."""
    simulation = Simulation(scene)
    if state is not None:
        simulation.start_from(state)
    results = simulation.run()
    return results, results.summary["stages"][-1]["minimum"]


@pytest.mark.parametrize(
    ("coupling", "electrostatics"),
    [
        *((coupling, "reaction_field") for coupling in (None, *ASKED)),
        pytest.param("flexible", "ewald", marks=pytest.mark.soak),
    ],
)
def test_the_gradient_is_that_of_the_enthalpy(coupling, electrostatics):
    """Points, linear and asymmetric molecules, shifts, rotates and all components of a tilting
    cell."""
    asked = {"pressure_bar": ASKED[coupling], "pressure_coupling": coupling} if coupling else {}
    scene = small_scene(
        MIXTURE,
        13.0,
        forces=FORCES | {"electrostatics": electrostatics},
        stages=[stage_of(**asked), {"duration_ps": 0.01}],
    )
    system, _, state = shaken(build(scene), 3, spread=0.1)
    if coupling == "flexible":
        state.cell[1, 0], state.cell[2, 0], state.cell[2, 1] = 0.4, 0.3, -0.6
    enthalpy = Enthalpy(system, scene.stages[0], state)
    point = enthalpy.at(state)
    n, turns = 3 * len(state.position), (system.model.inertia > 0)[system.model.species].ravel()
    coordinates = {None: 0, "isotropic": 1, "semi_isotropic": 2, "anisotropic": 3, "flexible": 6}[
        coupling
    ]
    assert len(point.gradient) == 2 * n + coordinates
    assert (point.gradient[n : 2 * n][~turns] == 0).all()
    some = np.random.default_rng(0).choice(
        np.flatnonzero(np.append(np.ones(n, bool), turns)), 12, replace=False
    )
    for k in [*some, *range(2 * n, len(point.gradient))]:
        gains = []
        for h in (1e-4, -1e-4):
            move = np.zeros(len(point.gradient))
            move[k] = h
            gains.append(enthalpy.gain(point, enthalpy.at(enthalpy.moved(state, move)), move))
        slope = (gains[0] - gains[1]) / 2e-4
        assert slope == pytest.approx(point.gradient[k], abs=1e-6 * np.abs(point.gradient).max())
    if coupling is None:  # the cell is kept, and its pressure is still known
        assert enthalpy.largest(point)[2] == 0
        assert np.isfinite(point.pressure).all()


def test_turns_of_any_size_and_strains_are_those_of_the_docstring():
    scene = small_scene(
        MIXTURE,
        13.0,
        forces=FORCES,
        stages=[stage_of(pressure_bar=0.0, pressure_coupling="flexible")],
    )
    system, _, state = shaken(build(scene), 3, spread=0.1)
    enthalpy, rng = Enthalpy(system, scene.stages[0], state), np.random.default_rng(1)
    n = len(state.position)
    move = rng.standard_normal(6 * n + 6)
    moved = enthalpy.moved(state, move)
    shift, turn = move[: 3 * n].reshape(n, 3), move[3 * n : 6 * n].reshape(n, 3)
    radius = np.array([m.radius or 1.0 for m in system.species])[system.model.species]
    turned = state.rotation @ Rotation.from_rotvec(turn / radius[:, None]).as_matrix()
    assert np.abs(moved.rotation - turned).max() < 1e-14
    strain = move[6 * n :] / (np.sqrt(n) * np.cbrt(state.volume / n))
    matrix = np.diag(np.exp(strain[:3]))
    matrix[[1, 2, 2], [0, 0, 1]] = strain[3:]
    assert np.abs(moved.cell - state.cell @ matrix).max() < 1e-13
    assert np.abs(moved.position - state.position @ matrix - shift).max() < 1e-12


def cluster(points: np.ndarray, seed: int) -> State:
    """Atoms at points in diameters, shaken by a tenth of one."""
    rng = np.random.default_rng(seed)
    return state_of(position=3.405 * (points + 0.1 * rng.uniform(-1, 1, points.shape)))


def icosahedron() -> np.ndarray:
    golden = (1 + np.sqrt(5)) / 2
    corners = [np.roll([0, a, b * golden], k) for k in range(3) for a in (1, -1) for b in (1, -1)]
    return 1.08 * np.array([np.zeros(3), *corners]) / np.hypot(1, golden)


def bipyramid() -> np.ndarray:
    angle = 2 * np.pi * np.arange(5) / 5
    ring = 0.95 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    return np.vstack([ring, [[0, 0, 0.55], [0, 0, -0.55]]])


@pytest.mark.parametrize(
    ("points", "energy"), [(bipyramid(), -16.505384), (icosahedron(), -44.326801)]
)
def test_lennard_jones_clusters(points, energy):
    """Hoare & Pal 1971, Adv. Phys. 20, 161; the Cambridge Cluster Database."""
    n = len(points)
    scene = small_scene({"argon": n}, None, stages=[stage_of(force_limit_kJ_mol_A=1e-6)])
    results, found = minimum_of(scene, cluster(points, 2))
    assert found["converged"]
    assert found["largest_force_kJ_mol_A"] <= 1e-6
    assert n * found["energy_after_kJ_mol_per_molecule"] * KJ_PER_MOL / WELL == pytest.approx(
        energy, abs=1e-6
    )
    assert results["potential"][-1] == pytest.approx(
        n * found["energy_after_kJ_mol_per_molecule"], rel=1e-12
    )
    assert found["pressure_bar"] is None


def pair_energy(model: str, x: np.ndarray) -> float:
    """Two rigid molecules (kJ/mol), the first at the origin: x (9,), position and rotation vectors of
    both. Plain NumPy."""
    m = load_model(model)
    sites = m.positions_body
    a = Rotation.from_rotvec(x[3:6]).apply(sites)
    b = Rotation.from_rotvec(x[6:9]).apply(sites) + x[:3]
    r = np.linalg.norm(a[:, None] - b, axis=2)
    energy = COULOMB * np.outer(m.charges, m.charges) / r
    sigma, well = (m.sigma[:, None] + m.sigma) / 2, np.sqrt(np.outer(m.epsilon, m.epsilon))
    energy += 4 * well * ((sigma / r) ** 12 - (sigma / r) ** 6)
    return float(energy.sum()) / KJ_PER_MOL


@pytest.mark.parametrize(
    ("model", "published"), [("tip4p", -26.09), pytest.param("spce", None, marks=pytest.mark.soak)]
)
def test_the_water_dimer(model, published):
    """TIP4P: 6.24 kcal/mol (Jorgensen et al. 1983, J. Chem. Phys. 79, 926, table III)."""
    m = load_model(model)
    o, h = (m.positions_body[[name.startswith(kind) for name in m.site_names]] for kind in "OH")
    donor, acceptor = (h[0] - o[0]), h.mean(axis=0) - o[0]
    guess = np.zeros(9)
    guess[:3] = [2.8, 0.0, 0.0]
    guess[3:6] = Rotation.align_vectors([[1.0, 0, 0]], [donor])[0].as_rotvec()
    guess[6:9] = Rotation.align_vectors([[0.6, 0, 0.8]], [acceptor])[0].as_rotvec()
    best = minimize(lambda x: pair_energy(model, x), guess, method="BFGS", tol=1e-9).fun
    scene = small_scene({model: 2}, None, stages=[stage_of(**TIGHT)])
    energies = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        state = state_of([[0, 0, 0], [3.2, 0, 0]], None, Rotation.random(2, rng).as_matrix())
        _, found = minimum_of(scene, state)
        assert found["converged"]
        energies.append(2 * found["energy_after_kJ_mol_per_molecule"])
    assert min(energies) == pytest.approx(best, abs=1e-6)
    if published:
        assert best == pytest.approx(published, abs=0.03)


def test_fcc_argon_has_its_lattice_constant_at_no_pressure():
    """Shells within the cutoff: 2 (sigma/a)^6 S12 = S6 with S_p = sum (r/a)^-p."""
    cutoff, n = 8.66, 4
    near = np.array(list(np.ndindex(7, 7, 7))) - 3
    sites = (
        near[:, None] + np.array([[0, 0, 0], [0.5, 0.5, 0], [0.5, 0, 0.5], [0, 0.5, 0.5]])
    ).reshape(-1, 3)
    shells = np.linalg.norm(sites, axis=1)
    shells = shells[(shells > 0) & (shells < 1.65)]
    exact = 3.405 * (2 * (shells**-12.0).sum() / (shells**-6.0).sum()) ** (1 / 6)
    assert 1.59 * exact < cutoff < 1.73 * exact
    a = 1.02 * exact
    points = sites[(sites >= -1).all(axis=1) & (sites < n - 1).all(axis=1)]
    assert len(points) == 4 * n**3
    position = a * points + 0.05 * np.random.default_rng(0).standard_normal(points.shape)
    limits = {"force_limit_kJ_mol_A": 1e-6, "pressure_limit_bar": 1e-3}
    scene = small_scene(
        {"argon": len(points)},
        n * a,
        forces={"cutoff_A": cutoff, "truncation": "shift"},
        stages=[stage_of(pressure_bar=0.0, **limits)],
        output={"pressure_tensor": True},
    )
    results, found = minimum_of(scene, state_of(position, cell=np.eye(3) * n * a))
    assert found["converged"]
    assert found["largest_pressure_deviation_bar"] <= 1e-3
    assert results.summary["stages"][0]["a_A"] / n == pytest.approx(exact, rel=1e-6)
    assert results["pressure_bar"][-1] == pytest.approx(0.0, abs=2e-3)  # at rest: no stage moves
    assert results["temperature"][-1] == 0


def nitrogen_crystal(a: float, n: int, matrix: np.ndarray) -> tuple[State, np.ndarray]:
    """n³ cells of Pa3, centres and cell times a matrix; the axes (4 n³, 3) of its molecules."""
    corners = np.array([[0, 0, 0], [0.5, 0.5, 0], [0.5, 0, 0.5], [0, 0.5, 0.5]])
    along = np.array([[1, 1, 1], [1, -1, -1], [-1, -1, 1], [-1, 1, -1]]) / np.sqrt(3)
    centres = (np.array(list(np.ndindex(n, n, n)))[:, None] + corners).reshape(-1, 3) * a
    axes = np.tile(along, (n**3, 1))
    across = np.cross(axes, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across, axis=1)[:, None]
    rotation = np.stack(
        [axes, across, np.cross(axes, across)], axis=2
    )  # the molecule lies along its first axis
    return state_of(centres @ matrix, None, rotation, None, n * a * np.eye(3) @ matrix), axes


def test_a_nitrogen_crystal_finds_its_shape_and_stays():
    n = 3
    sheared = np.array([[1.0, 0, 0], [0.02, 1.0, 0], [-0.01, 0, 1.0]])
    stage = stage_of(
        pressure_bar=0.0, pressure_coupling="flexible", pressure_limit_bar=1e-3, **TIGHT
    )
    found = []
    for matrix in (np.eye(3), sheared):
        state, axes = nitrogen_crystal(5.66, n, matrix)
        scene = small_scene(
            {"nitrogen": len(axes)}, 5.66 * n, forces={"cutoff_A": 8.0}, stages=[stage, stage]
        )
        results, again = minimum_of(scene, state)
        assert [stage["minimum"]["converged"] for stage in results.summary["stages"]] == [
            True,
            True,
        ]
        assert again["iterations"] == 0
        assert np.abs(
            np.einsum("ni,ni->n", results.state.rotation[:, :, 0], axes)
        ) == pytest.approx(1.0, abs=1e-9)
        found.append((results.state.cell, again["energy_after_kJ_mol_per_molecule"]))
    (cubic, energy), (relaxed, other) = found
    assert np.abs(cubic - cubic[0, 0] * np.eye(3)).max() < 1e-6
    assert np.abs(relaxed - cubic).max() < 1e-5
    assert other == pytest.approx(energy, rel=1e-9)


@pytest.mark.parametrize("coupling", ASKED)
def test_the_cell_takes_the_pressure_asked_for(coupling):
    """Each coordinate of the coupling its own; what no coordinate holds stays as it was."""
    asked = {
        "semi_isotropic": (900.0, 900.0, 500.0),
        "flexible": (100.0, 200.0, 300.0, 100.0, -100.0, 150.0),
    }.get(coupling, ASKED[coupling])
    stage = stage_of(pressure_bar=asked, pressure_coupling=coupling, pressure_limit_bar=0.1)
    scene = small_scene(
        {"argon": 20, "nitrogen": 20, "spce": 30},
        15.5,
        forces=FORCES | {"cutoff_A": 5.0},
        stages=[stage],
    )
    system, _, state = shaken(build(scene), 1)
    volume = state.volume
    found = minimise(system, state, scene.stages[0])
    assert found.converged
    pressure = np.array(found.pressure) / BAR
    edges = state.cell.diagonal()
    if coupling == "isotropic":
        assert pressure[:3].mean() == pytest.approx(asked, abs=0.1)
    elif coupling == "semi_isotropic":
        assert pressure[:2].mean() == pytest.approx(asked[0], abs=0.1)
    else:
        assert pressure[: len(asked)] == pytest.approx(asked, abs=0.1)
    alike = {"isotropic": 3, "semi_isotropic": 2}.get(coupling, 1)
    assert edges[:alike] == pytest.approx(edges[0], rel=1e-12)
    assert (np.diff(edges)[alike - 1 :] != 0).all()
    assert (np.abs(state.cell[np.tril_indices(3, -1)]) > 1e-3).all() == (coupling == "flexible")
    assert (state.cell[np.triu_indices(3, 1)] == 0).all()
    assert state.volume < volume


def test_it_begins_from_overlaps():
    """Two pairs of molecules in one another, one of them a hundredth of a diameter from each other: 1e24
    wells."""
    scene = small_scene({"argon": 10, "spce": 10}, 18.5, stages=[stage_of()])
    system, _, state = shaken(build(scene), 1, spread=0.1)
    state.position[1] = state.position[0] + [0.03, 0.01, 0.0]
    state.position[12] = state.position[11] + [0.4, 0.2, 0.1]
    found = minimise(system, state, scene.stages[0])
    assert found.energy_before > 1e20 * WELL
    assert found.converged
    assert found.overlap_steps > 0
    assert found.energy_after < 0
    assert found.force <= 0.1 * KJ_PER_MOL
    assert np.abs(np.linalg.det(state.rotation) - 1).max() < 1e-12


def test_frozen_molecules_stay():
    scene = small_scene(
        {}, 18.5, molecules=[{"model": "spce", "count": 12, "frozen": "1-4"}], stages=[stage_of()]
    )
    system, _, state = shaken(build(scene), 1, spread=0.1)
    before, held = state.copy(), ~mobile(system.model)
    found = minimise(system, state, scene.stages[0])
    assert found.converged
    assert held.sum() == 4
    for name in ("position", "rotation"):
        assert np.array_equal(getattr(state, name)[held], getattr(before, name)[held])
        assert (getattr(state, name)[~held] != getattr(before, name)[~held]).any(axis=-1).all()


def test_what_it_keeps_and_what_it_books():
    scene = small_scene(
        {"argon": 10, "spce": 10},
        18.5,
        stages=[{"duration_ps": 0.01}, stage_of(), {"duration_ps": 0.01}],
    )
    seen = []

    class Look(Every):
        once = False  # both moments of a time, before and after the minimisation

        def see(self, moment):
            state = moment.state
            seen.append(
                (
                    moment.step,
                    moment.time,
                    state.velocity,
                    state.angular_momentum_body,
                    state.position,
                )
            )

    once = []
    observers = [Look(0.01, print), Every(0.01, lambda moment: once.append(moment.state.position))]
    results = Simulation(scene, observers=observers).run()
    assert [moment[0] for moment in seen] == [0, 5, 5, 10]
    assert np.array_equal(once, [seen[k][4] for k in (0, 2, 3)])
    before, after = [moment for moment in seen if moment[0] == 5]
    for k in (1, 2, 3):
        assert np.array_equal(before[k], after[k])  # time, velocity, angular momentum
    assert not np.array_equal(before[4], after[4])  # position
    assert results.state.time[NOW] == pytest.approx(0.02)
    assert results.state.step[NOW] == 10
    conserved = results["conserved"]
    taken = results["potential"][1] - results["potential"][2]
    assert taken > 100
    assert conserved[2] == pytest.approx(
        conserved[1], abs=1e-9 * taken
    )  # it is accounted for as work
    assert results["work"][1] - results["work"][2] == pytest.approx(taken, rel=1e-9)
    drift = results["drift"]
    assert np.isnan(drift[results["stage"] == 1]).all()
    assert np.isfinite(drift[results["stage"] != 1]).all()
    first, middle, last = results.summary["stages"]
    assert set(first) == set(middle) == set(last)
    assert first["minimum"] is last["minimum"] is None
    for key in (
        "temperature_K",
        "drift_kJ_mol_ns_per_molecule",
        "timestep_fs",
        "integrator",
        "energy_rms_kJ_mol_per_molecule",
    ):
        assert middle[key] is None
    assert middle["steps"] == 0
    assert (
        middle["potential_kJ_mol_per_molecule"]
        == middle["minimum"]["energy_after_kJ_mol_per_molecule"]
    )
    assert results.universe().trajectory.dt > 0


def test_it_says_how_far_it_came():
    scene = small_scene({"spce": 10}, 18.5, stages=[stage_of(most_iterations=3)])
    with pytest.warns(
        RigidMDWarning,
        match=r"stages.0: the minimisation has not converged after 3 iterations .*most_iterations = 3",
    ):
        results, found = minimum_of(scene)
    assert not found["converged"]
    assert found["ended_by"] == "most_iterations = 3"
    assert found["iterations"] == 3
    assert found["largest_force_kJ_mol_A"] > 0.1
    assert any(
        "largest force" in note and "(limit 0.1)" in note for note in results.summary["notes"]
    )
    assert found["energy_after_kJ_mol_per_molecule"] < found["energy_before_kJ_mol_per_molecule"]


def test_it_can_be_stopped():
    scene = small_scene({"spce": 10}, 18.5, stages=[stage_of()])
    system, _, state = shaken(build(scene), 1, spread=0.1)
    done = []
    found = minimise(system, state, scene.stages[0], lambda: len(done) == 2, done.append)
    assert (found.converged, found.ended_by, found.iterations) == (False, "interrupted", 2)
    assert found.energy_after < found.energy_before


def test_charges_that_nothing_keeps_apart():
    ion = {"mass_u": 20.0, "position_A": [0.0, 0.0, 0.0]}
    molecules = [
        {
            "name": "plus",
            "count": 1,
            "sites": [ion | {"name": "P", "charge_e": 1.0, "sigma_A": 2.5, "epsilon_kJ_mol": 0.4}],
        },
        {"name": "minus", "count": 1, "sites": [ion | {"name": "M", "charge_e": -1.0}]},
    ]
    scene = small_scene({}, None, molecules=molecules, stages=[stage_of()])
    simulation = Simulation(scene)
    simulation.start_from(state_of([[0.0, 0, 0], [4.0, 0.3, 0]]))
    with pytest.raises(
        SimulationError,
        match=r"no lower bound: P of molecule 1 .* and M of molecule 2 .*forces.pairs",
    ):
        simulation.run()


def test_atoms_that_are_nearly_in_one_place():
    """The squares of their forces exceed the range of numbers."""
    scene = small_scene({"argon": 2}, None, stages=[stage_of()])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        results, minimum = minimum_of(scene, state_of([[0.0, 0.0, 0.0], [1e-12, 0.0, 0.0]]))
    assert minimum["converged"]
    assert results["potential"][-1] == pytest.approx(-WELL / KJ_PER_MOL, rel=1e-3)
    assert np.isnan(results["force_squares"][0]) and np.isfinite(results["force_squares"][-1])


#: Models whose charges have no repulsion of their own.
BARE = [
    name
    for name in sorted(path.stem for path in (ROOT / "rigidmd" / "models").glob("*.toml"))
    if ((load_model(name).charges != 0) & (load_model(name).epsilon == 0)).any()
]


@pytest.mark.parametrize(
    ("name", "seeds"),
    [
        ("tip5p", 3),
        *(pytest.param(name, 3, marks=pytest.mark.extended) for name in BARE),
        *(pytest.param(name, 20, marks=pytest.mark.soak) for name in BARE),
    ],
)
def test_models_with_bare_charges_are_minimised_from_every_lattice(name, seeds):
    """Opposite charges get as near as 0.9 Å in TIP5P."""
    edge = np.cbrt(64 * load_model(name).mass / GRAM_PER_CM3)
    for seed in range(1, seeds + 1):
        scene = small_scene(
            {name: 64},
            float(edge),
            forces={"cutoff_A": 6.0},
            stages=[stage_of(most_iterations=400)],
            seed=seed,
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RigidMDWarning)  # of the number of iterations
            minimum = minimum_of(scene)[1]
        assert abs(minimum["energy_after_kJ_mol_per_molecule"]) < 100  # no charge is in another


def test_a_box_that_nothing_holds_together():
    scene = small_scene(
        {"argon": 8}, 12.5, forces={"cutoff_A": 6.0}, stages=[stage_of(pressure_bar=-5000.0)]
    )
    with pytest.raises(SimulationError, match=r"has grown to .* volumes .*higher pressure_bar"):
        minimum_of(scene)


def test_a_box_that_becomes_too_small_for_the_cut_off():
    scene = small_scene(
        {"argon": 8}, 12.5, forces={"cutoff_A": 6.0}, stages=[stage_of(pressure_bar=5000.0)]
    )
    with pytest.raises(SimulationError, match="too small for the cutoff"):
        minimum_of(scene)


@pytest.mark.parametrize(
    ("stages", "more", "expected"),
    [
        ([stage_of(duration_ps=1.0)], {}, "duration_ps would have no effect in a minimise stage"),
        ([stage_of(timestep_fs=1.0)], {}, "timestep_fs would have no effect"),
        ([stage_of(temperature_K=300.0)], {}, "temperature_K would have no effect"),
        ([stage_of(integrator="srkn_6")], {}, "integrator would have no effect"),
        (
            [stage_of(pressure_coupling="flexible")],
            {},
            "would have no effect in a minimise stage without pressure_bar",
        ),
        (
            [stage_of(pressure_limit_bar=2.0)],
            {},
            "would have no effect in a minimise stage without pressure_bar",
        ),
        ([stage_of(pressure_bar=(1.0, 2.0))], {}, "one pressure, not one that changes"),
        ([stage_of(pressure_bar=(1.0, 2.0, 3.0))], {}, "pressure_coupling = 'anisotropic'"),
        ([stage_of(most_iterations=0)], {}, "most_iterations"),
        ([stage_of(force_limit_kJ_mol_A=0.0)], {}, "force_limit_kJ_mol_A"),
        (
            [{"duration_ps": 1.0, "force_limit_kJ_mol_A": 0.2}],
            {},
            "force_limit_kJ_mol_A would have no effect in an nve stage",
        ),
        ([{"ensemble": "nve"}], {}, r"stages.0.duration_ps: is missing"),
        (
            [stage_of(), {"duration_ps": 1.0}],
            {"start": {}},
            "the first stage that is not a minimisation is nve",
        ),
        (
            [stage_of(pressure_bar=1.0)],
            {"box": {"lengths_A": 20.0, "periodic": False}},
            "box.periodic is false",
        ),
        (
            [stage_of(pressure_bar=1.0)],
            {"molecules": [{"model": "spce", "count": 4, "frozen": "1"}]},
            "frozen molecules do not move",
        ),
        (
            [stage_of(), {"ensemble": "nvt", "duration_ps": 1.0, "temperature_K": 300.0}],
            {"start": {"temperature_K": 0.0}},
            "cannot heat molecules at rest",
        ),
    ],
)
def test_bad_input(stages, more, expected):
    with pytest.raises(SceneError, match=expected):
        small_scene({"spce": 4}, 20.0, stages=stages, **more)


def test_accuracy_needs_a_stage_in_which_time_passes():
    with pytest.raises(SceneError, match="the last stage is a minimisation"):
        measure_accuracy(small_scene({"spce": 4}, 20.0, stages=[stage_of()]))


def test_momenta_are_those_of_the_first_stage_that_moves():
    nvt = {"ensemble": "nvt", "duration_ps": 0.01, "temperature_K": 250.0}
    drawn = build(small_scene({"spce": 8}, 20.0, stages=[stage_of(), nvt], start={}))
    plain = build(small_scene({"spce": 8}, 20.0, stages=[nvt], start={}))
    assert drawn.scene.start.temperature_K == 250.0
    assert np.array_equal(drawn.state.velocity, plain.state.velocity)
    alone = build(small_scene({"spce": 8}, 20.0, stages=[stage_of()], start={}))
    assert alone.scene.start.temperature_K == 0.0
    assert not alone.state.velocity.any()
    assert not alone.state.angular_momentum_body.any()


SCENE = """\
[box]
density_g_cm3 = 0.9
[[molecules]]
model = "spce"
count = 40
[forces]
cutoff_A = 5.0
[[stages]]
ensemble = "minimise"
[[stages]]
name = "cell"
ensemble = "minimise"
pressure_bar = 1
[[stages]]
ensemble = "nvt"
temperature_K = 300
duration_ps = 0.02
[output]
log_interval_ps = 0.01
trajectory_interval_ps = 0.01
"""


def test_a_scene_through_the_command_line(tmp_path, capsys):
    (tmp_path / "scene.toml").write_text(SCENE)
    assert main(["check", str(tmp_path / "scene.toml")]) == 0
    said = capsys.readouterr().out
    assert (
        "0: minimise: to a minimum of the potential energy. No time passes and momenta do not change"
        in said
    )
    assert "1: cell: to a minimum of the enthalpy at 1 bar, the cell isotropic" in said
    assert "torques of 0.1 kJ/mol and a pressure within 1 bar. At most 5000 iterations" in said
    command = ["run", str(tmp_path / "scene.toml"), "-o", str(tmp_path / "out"), "-v"]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "minimise: converged after" in said
    assert "cell: converged after" in said
    assert "bar of the given pressure" in said
    with (tmp_path / "out" / "log.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["Stage"] for row in rows] == ["minimise", "minimise", "cell", "nvt", "nvt"]
    assert [float(row["Time (ps)"]) for row in rows] == pytest.approx([0, 0, 0, 0.01, 0.02])
    assert [row["Drift (kJ/mole)"] for row in rows[:3]] == ["", "", ""]
    assert [float(row["Temperature (K)"]) for row in rows[:3]] == pytest.approx([300, 300, 300])
    energies = [float(row["Potential Energy (kJ/mole)"]) for row in rows]
    assert energies[0] > energies[1] > energies[2]
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    kept, cell, nvt = summary["stages"]
    assert kept["minimum"]["converged"]
    assert kept["minimum"]["largest_pressure_deviation_bar"] is None
    assert cell["minimum"]["largest_pressure_deviation_bar"] <= 1
    assert cell["density_g_cm3"] == pytest.approx(float(rows[2]["Density (g/mL)"]))
    assert cell["density_g_cm3"] != pytest.approx(0.9, rel=1e-3)
    assert 40 * kept["minimum"]["energy_after_kJ_mol_per_molecule"] == pytest.approx(energies[1])
    assert nvt["steps"] == 8  # of 2.5 fs, the default that divides the intervals
    assert nvt["temperature_K"] > 0
    assert (tmp_path / "out" / "energy.png").is_file()
    again = Simulation(Scene.read(tmp_path / "out" / "scene.toml")).run()
    assert [ts.time for ts in again.universe().trajectory] == pytest.approx([0, 0.01, 0.02])
    with np.load(tmp_path / "out" / "final.npz") as final:
        for name in ("position", "rotation", "velocity"):
            assert np.array_equal(final[name], getattr(again.state, name))


def test_a_minimum_alone_has_no_figure(tmp_path):
    Simulation(
        small_scene({"argon": 4}, None, stages=[stage_of()], start={}), tmp_path / "out"
    ).run(progress=True)
    assert "energy.png" not in {path.name for path in (tmp_path / "out").iterdir()}
    assert "stages:" in describe(small_scene({"argon": 4}, None, stages=[stage_of()], start={}))


SHORT = {"ensemble": "nvt", "temperature_K": 90.0, "duration_ps": 0.02}
SEVERAL = [
    stage_of(name="a"),
    stage_of(name="b"),
    SHORT,
    stage_of(name="c", most_iterations=3),
    SHORT,
]
EVERY_STEP_OR_TWO = {
    "trajectory_interval_ps": 0.01,
    "log_interval_ps": 0.004,
    "pressure_tensor_interval_ps": 0.01,
}


def several(folder, stages, trajectory, **options):
    output = EVERY_STEP_OR_TWO | {"trajectory": trajectory, "figures": False}
    scene = small_scene(
        {"argon": 20}, 20.0, stages=stages, start={"temperature_K": 90.0}, output=output
    )
    return Simulation(scene, folder, warn=lambda warning: None, **options)


@pytest.mark.parametrize(
    "ending", [".xtc", ".trr", ".gsd", ".traj", ".dcd", ".nc", ".xyz", ".pdb", None]
)
def test_a_trajectory_has_one_frame_of_each_time(tmp_path, ending):
    folder = None if ending is None else tmp_path / "out"
    seen = []
    looks = Every(0.01, lambda moment: seen.append(moment.state.position.copy()))
    results = several(folder, SEVERAL, f"t{ending or '.xtc'}", observers=looks).run()
    times = [0.0, 0.01, 0.02, 0.03, 0.04]
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        u = results.universe()
    assert [ts.time for ts in u.trajectory] == pytest.approx(times)
    assert u.trajectory.dt == pytest.approx(0.01)
    assert u.trajectory.totaltime == pytest.approx(0.04)
    for ts, positions in zip(u.trajectory, seen, strict=True):  # those after the minimisations
        assert ts.positions == pytest.approx(positions, abs=6e-3)
    energies = results["potential"]
    minima = {0: results.summary["stages"][1], 2: results.summary["stages"][3]}
    for k, stage in minima.items():
        assert results.atoms(
            k
        ).get_potential_energy() / ase.units.kJ * ase.units.mol == pytest.approx(
            20 * stage["minimum"]["energy_after_kJ_mol_per_molecule"]
        )
    assert list(results["stage"][:3]) == [
        0,
        0,
        1,
    ]  # the log has the energy before each minimisation
    assert energies[0] > energies[1] >= energies[2]
    if ending is None:
        assert results._tensor[:, 0] == pytest.approx(times)
        return
    found = read_frames(folder / f"t{ending}", 20, 100)
    assert found.time == pytest.approx(times, abs=1e-6)
    record = read_record(folder)
    assert list(record.columns["stage"]) == list(results["stage"])
    assert list(np.unique(record.columns["stage"][record.moving])) == [2, 4]


@pytest.mark.parametrize("stopped_in", [0, 1, 3])
def test_an_interrupted_minimisation_leaves_a_frame_that_its_repetition_replaces(
    tmp_path, monkeypatch, stopped_in
):
    whole = several(tmp_path / "whole", SEVERAL, "t.xtc")
    whole.run()
    run = several(tmp_path / "out", SEVERAL, "t.xtc")

    def stopped(system, state, stage, stop, advanced):
        if stage is system.scene.stages[stopped_in]:
            run.stop()
        return minimise(system, state, stage, stop, advanced)

    monkeypatch.setattr(molecular_run, "minimise", stopped)
    results = run.run()
    done = [0.0] if stopped_in < 2 else [0.0, 0.01, 0.02]
    assert results.interrupted
    assert [ts.time for ts in results.universe().trajectory] == pytest.approx(done)
    several(tmp_path / "out", SEVERAL, "t.xtc", resume=True).run()
    for name in ("t.xtc", "log.csv", "pressure_tensor.csv", "final.npz"):
        assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()


def test_a_minimisation_and_its_overlap_removal_end_in_their_time(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(
        CheckpointSchedule, "time_is_up", property(lambda self: asked.append(1) or len(asked) > 1)
    )
    (tmp_path / "two.xyz").write_text("3\n\nAr 0 0 0\nAr 0.9 0 0\nAr 0 1.1 0\n")
    sections = {
        "structure": {"file": "two.xyz"},
        "molecules": [{"model": "argon"}],
        "box": {"periodic": False},
    }
    scene = small_scene({}, None, tmp_path, **sections, stages=[stage_of(), SHORT], start={})
    results = Simulation(scene, tmp_path / "out", warn=lambda warning: None).run()
    assert results.interrupted
    assert results.out_of_time
    (found,) = [stage["minimum"] for stage in results.summary["stages"]]
    assert (found["converged"], found["ended_by"], found["iterations"]) == (False, "interrupted", 0)
    assert found["overlap_removal_steps"] <= 2
    monkeypatch.undo()
    results = Simulation(scene, tmp_path / "out", resume=True, warn=lambda warning: None).run()
    assert not results.interrupted
    assert results.summary["stages"][0]["minimum"]["converged"]
    assert results.summary["stages"][0]["minimum"]["overlap_removal_steps"] > 2


def test_a_minimum_alone_has_one_frame(tmp_path):
    results = several(tmp_path / "out", [stage_of(), stage_of(name="again")], "t.xtc").run()
    u = results.universe()
    assert len(u.trajectory) == 1
    assert u.atoms.positions == pytest.approx(results.state.position, abs=6e-3)
    write_report(tmp_path / "out", tmp_path / "report.html")
    record = read_record(tmp_path / "out")
    assert panels(record.system, record.columns) == []
    assert not record.moving.any()


def test_structures_that_overlap_may_be_minimised(tmp_path):
    (tmp_path / "two.xyz").write_text("2\n\nAr 0 0 0\nAr 1.5 0 0\n")
    sections = {
        "structure": {"file": "two.xyz"},
        "molecules": [{"model": "argon"}],
        "box": {"periodic": False},
    }
    scene = small_scene(
        {}, None, tmp_path, **sections, stages=[stage_of(force_limit_kJ_mol_A=1e-4)], start={}
    )
    results, found = minimum_of(scene)
    assert found["converged"]
    assert any("overlap" in note for note in results.summary["notes"])
    assert np.linalg.norm(np.diff(results.state.position, axis=0)) == pytest.approx(
        2 ** (1 / 6) * 3.405, rel=1e-3
    )


def test_compiling_is_not_minimising(monkeypatch):
    """The first forces, which may compile for a minute, come before the clock of the stage, in its
    precision."""
    from rigidmd.run import molecular

    order = []
    evaluate, minimise_stage = CpuEngine.evaluate, molecular.minimise

    def evaluate_and_record(engine, state):
        order.append(f"forces in {engine._setup.dtype.__name__}")
        return evaluate(engine, state)

    def minimise_and_record(*arguments):
        order.append("minimise")
        return minimise_stage(*arguments)

    monkeypatch.setattr(CpuEngine, "evaluate", evaluate_and_record)
    monkeypatch.setattr(molecular, "minimise", minimise_and_record)
    stages = [
        stage_of(most_iterations=2, **TIGHT),
        {"duration_ps": 0.002},
        stage_of(most_iterations=2),
    ]
    Simulation(small_scene({"argon": 20}, 20.0, stages=stages, precision="mixed"), warn=str).run()
    assert order.count("minimise") == 2
    assert "forces in float64" in order[: order.index("minimise")]


@pytest.mark.parametrize(
    ("counts", "limit", "precision"),
    [
        ({"spce": 10}, 10.0, "mixed"),
        ({"argon": 10}, 0.1, "mixed"),
        ({"spce": 10}, 1e-4, "double"),
        ({"argon": 10}, 1e-5, "double"),
    ],
)
def test_loose_limits_need_no_double_precision(counts, limit, precision):
    """The minimum is the same to the error of mixed precision; no kernel of double precision is
    loaded."""
    limits = {"force_limit_kJ_mol_A": limit, "torque_limit_kJ_mol": limit}
    energies = {}
    for each in ("mixed", "double"):
        scene = small_scene(counts, 18.5, stages=[stage_of(**limits)], precision=each)
        system, _, state = shaken(build(scene), 1, spread=0.1)
        minimum = minimise(system, state, scene.stages[0])
        assert minimum.converged
        assert minimum.precision == (precision if each == "mixed" else "double")
        at_minimum, _ = system.engine_of(system.terms, "double").evaluate(state)
        assert np.linalg.norm(at_minimum.force, axis=1).max() < 1.01 * limit * KJ_PER_MOL
        energies[each] = minimum.energy_after
    assert energies["mixed"] == pytest.approx(energies["double"], rel=1e-4 if limit < 10 else 0.1)


def test_a_pressure_is_found_in_double_precision():
    scene = small_scene({"argon": 20}, 20.0, stages=[stage_of(pressure_bar=1.0)], precision="mixed")
    assert precision_of_minimisation(build(scene), scene.stages[0]) == "double"


def test_where_mixed_precision_stalls_double_precision_continues(monkeypatch):
    """Also from a start whose energy single precision cannot hold: two sites 0.001 Å from each other."""
    scene = small_scene({"argon": 10}, 18.5, stages=[stage_of()], precision="mixed")
    system, _, state = shaken(build(scene), 1, spread=0.1)
    overlapping = state.copy()
    minimum = minimise(system, state, scene.stages[0])
    assert minimum.precision == "mixed"
    overlapping.position[1] = overlapping.position[0] + [0.001, 0.0, 0.0]
    assert minimise(system, overlapping, scene.stages[0]).precision == "double"
    step = minimise_module._Descent.step

    def stall_in_mixed_precision(descent, point):
        return None if descent._enthalpy.precision == "mixed" else step(descent, point)

    monkeypatch.setattr(minimise_module._Descent, "step", stall_in_mixed_precision)
    _, _, state = shaken(build(scene), 1, spread=0.1)
    stalled = minimise(system, state, scene.stages[0])
    assert (stalled.converged, stalled.precision) == (True, "double")
    assert stalled.energy_after == pytest.approx(minimum.energy_after, rel=1e-4)


@pytest.mark.parametrize("field", [5.3, 8.0])
def test_molecules_in_a_uniform_field_alone_have_torques_and_no_forces(field):
    """They rotate until the first step is short enough; ions in a field too strong for the step are
    not badly packed."""
    sections = {
        "forces": {"lennard_jones": False, "electrostatics": "none"},
        "start": {"temperature_K": 300.0},
    }
    sections |= {
        "fields": {"electric_V_per_nm": [0.0, 0.0, field]},
        "stages": [{"duration_ps": 0.5, "timestep_fs": 6.25}],
    }
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        removal = Simulation(small_scene({"spce": 30}, None, **sections), warn=str)._start()
    assert removal.steps > 0
    assert removal.excess <= 1
    sections["stages"] = [{"duration_ps": 5.0, "timestep_fs": 500.0}]
    with pytest.raises(
        SceneError, match=r"timestep_fs of the first stage is too long for electric"
    ):
        Simulation(small_scene({"na_spce": 3}, None, **sections), warn=str)._start()
