"""Minimisation in the rigid degrees of freedom and the cell: gradients, known minima, what it keeps."""

import warnings

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from support.common import shaken, small_scene
from support.minima import BARE, TIGHT, WELL, minimum_of, stage_of

from rigidmd.assemble.build import build
from rigidmd.core.state import NOW, State, state_of
from rigidmd.dynamics.model import mobile
from rigidmd.errors import RigidMDWarning, SceneError
from rigidmd.run import Every, Simulation
from rigidmd.run.minimise import Enthalpy, minimise
from rigidmd.scene.models import load_model
from rigidmd.units import BAR, COULOMB, GRAM_PER_CM3, KJ_PER_MOL

MIXTURE = {"argon": 4, "nitrogen": 4, "spce": 6}
FORCES = {"cutoff_A": 6.0, "tail_correction": True}


ASKED = {
    "isotropic": 800.0,
    "semi_isotropic": (500.0, 500.0, -1500.0),
    "anisotropic": (500.0, 0.0, 1500.0),
    "flexible": (100.0, 200.0, 300.0, 4000.0, -5000.0, 6000.0),
}


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


def test_rotations_of_any_size_and_strains_are_those_of_the_docstring():
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
    assert results["pressure"][-1] == pytest.approx(0.0, abs=2e-3)  # at rest: no stage moves
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
def test_the_cell_takes_the_pressure_requested(coupling):
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


def test_what_it_keeps_and_what_it_accounts_for():
    scene = small_scene(
        {"argon": 10, "spce": 10},
        18.5,
        stages=[{"duration_ps": 0.01}, stage_of(), {"duration_ps": 0.01}],
    )
    seen = []

    class Look(Every):
        once = False  # both moments of a time, before and after the minimisation

        def observe(self, moment):
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
            stages=[stage_of(max_iterations=400)],
            seed=seed,
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RigidMDWarning)  # of the number of iterations
            minimum = minimum_of(scene)[1]
        assert abs(minimum["energy_after_kJ_mol_per_molecule"]) < 100  # no charge is in another


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
