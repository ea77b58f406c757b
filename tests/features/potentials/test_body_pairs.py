"""Energies of pairs of bodies in scenes: all pairs, orders of integrators, errors, pictures."""

from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.body_pairs import GAY_BERNE, ROD, body, brute_force, evaluated, scene, simulation
from support.common import bits_with
from support.slopes import energy_of, force_on, torque_on, virial_of
from support.stops import same_after_stops

import rigidmd
from rigidmd import Scene, Simulation
from rigidmd.assemble.build import build
from rigidmd.core.statistics import slope
from rigidmd.errors import SceneError
from rigidmd.features.potentials.poses.bodies import bodies_of_potentials
from rigidmd.features.potentials.poses.formulas import formula_of_poses
from rigidmd.features.potentials.poses.gay_berne import GayBerne
from rigidmd.features.view.figures.space import View, camera
from rigidmd.features.view.figures.style import new_figure
from rigidmd.features.view.solids import solids_of
from rigidmd.run.rigid_fit import Bodies
from rigidmd.units import BOLTZMANN, KJ_PER_MOL


def shuffled(simulation: Simulation, seed: int):
    """The start of a simulation with other orientations."""
    simulation._start()
    state = simulation.state.copy()
    n = len(state.position)
    state.rotation[:] = Rotation.random(n, random_state=seed).as_matrix()
    return state


# --- in a run -------------------------------------------------------------------------------------


def test_a_mixture_has_the_energy_of_all_its_pairs_and_forces_that_are_its_slopes():
    run = simulation(GAY_BERNE)
    state = shuffled(run, 4)
    system, engine = run.system, run.system.engine()
    load, tallies = engine.evaluate(state)
    name = "gay_berne"
    assert tallies[name].energy / KJ_PER_MOL == pytest.approx(
        brute_force(system, state, GAY_BERNE), rel=1e-11
    )

    size, h = np.abs(load.force).max(), 1e-5
    energy = partial(energy_of, engine)
    for m in (0, 11, 25, 30):
        force, torque = force_on(m, energy, state, h), torque_on(m, energy, state, h)
        assert load.force[m] == pytest.approx(force, abs=1e-7 * size)
        assert load.torque_body[m] == pytest.approx(torque, abs=1e-6 * size)
    virial = np.array(tallies[name].virial).reshape(3, 3)
    for i, j in [(0, 0), (1, 0), (2, 1), (2, 2)]:
        slope = virial_of(energy, state, h, (j, i))
        assert virial[j, i] == pytest.approx(slope, abs=1e-6 * size)
    assert load.force.sum(axis=0) == pytest.approx(np.zeros(3), abs=1e-12 * size)


def test_given_forces_are_those_that_are_derived():
    """Dipoles, with force and torques by hand."""
    strength = 30.0

    def energy(r, u, v):
        s = np.sqrt(r @ r)
        return strength * (u @ v / s**3 - 3 * (u @ r) * (v @ r) / s**5)

    def with_forces(r, u, v):
        s2 = r @ r
        s3, s5 = s2**1.5, s2**2.5
        a, b, c = u @ r, v @ r, u @ v
        force = strength * 3 * ((c * r + b * u + a * v) / s5 - 5 * a * b * r / (s5 * s2))
        to_first = strength * (v / s3 - 3 * b * r / s5)
        to_second = strength * (u / s3 - 3 * a * r / s5)
        return energy(r, u, v), force, np.cross(to_first, u), np.cross(to_second, v)

    derived, given = (formula_of_poses(f, (), "z") for f in (energy, with_forces))
    assert derived.is_derived and not given.is_derived
    rng = np.random.default_rng(2)
    for _ in range(20):
        r = 6 * rng.standard_normal(3)
        a, b = Rotation.random(2, random_state=rng).as_matrix()
        one, other = (
            np.hstack(evaluated(formula)(np.zeros(1), tuple(r), a, b))
            for formula in (derived, given)
        )
        assert one == pytest.approx(other, rel=1e-11, abs=1e-11 * np.abs(one).max())


def test_bits_do_not_depend_on_threads_nor_on_stops(tmp_path):
    system = build(scene(GAY_BERNE))
    state = system.state.copy()
    assert bits_with(1, system, state) == bits_with(2, system, state)
    stages = [{"ensemble": "nvt", "temperature_K": 200.0, "duration_ps": 0.2, "timestep_fs": 5.0}]
    molecules = [body("rod", 24), body("disc", 8)]
    tables = {
        "box": {"lengths_A": 37.0},
        "molecules": molecules,
        "forces": {"bodies": [GAY_BERNE]},
        "stages": stages,
    }
    same_after_stops(tables, [7, 22], tmp_path)


def test_energy_is_conserved_with_the_order_of_the_integrator():
    stage = {"duration_ps": 1.0, "timestep_fs": 8.0, "ensemble": "nve"}
    noise = []
    for step in (20.0, 10.0):
        run = simulation(GAY_BERNE, stages=[stage | {"timestep_fs": step}])
        results = run.run()
        noise.append(np.ptp(results["energy"]))
    assert 3.0 < noise[0] / noise[1] < 5.5


#: Eight rods without a box or a cutoff, whose energy has all derivatives.
CLUSTER = {
    "box": {"lengths_A": 24.0, "periodic": False},
    "molecules": [body("rod", 8)],
    "forces": {"bodies": [{"potential": "gay_berne", "parameters": {"rod": ROD}}]},
    "start": {"temperature_K": 60.0},
    "precision": "double",
    "threads": 1,
}


@pytest.mark.parametrize(
    ("integrator", "order"), [("velocity_verlet", 2), ("two_stage", 2), ("chin_4a", 4)]
)
def test_integrators_have_their_order(integrator, order):
    """Positions after 2 ps against half the step, and again."""
    ends = []
    for step in (20.0, 10.0, 5.0):
        stage = {"duration_ps": 2.0, "timestep_fs": step, "integrator": integrator}
        results = Simulation(Scene.from_dict(CLUSTER | {"stages": [stage]}), warn=str).run()
        ends.append(results.state.position)
    errors = [np.abs(one - other).max() for one, other in pairwise(ends)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.1)


def test_energy_does_not_drift():
    """The slope of the energy of a hot fluid of rods is within three of its errors, and below
    0.02 kT/ns for each degree of freedom, as in water."""
    stage = {"ensemble": "nve", "duration_ps": 20.0, "timestep_fs": 5.0}
    start, output = {"temperature_K": 600.0}, {"log_interval_ps": 0.1}
    run = simulation(GAY_BERNE, stages=[stage], start=start, output=output)
    results = run.run()
    line = slope(results["time"], results["energy"])
    thermal = BOLTZMANN / KJ_PER_MOL * results["temperature"].mean() * run.system.freedom.total
    allowed = 3 * line.error + 2e-5 * thermal
    assert abs(line.value) < allowed and line.error < 1e-4 * thermal


@pytest.mark.parametrize("axis", ["x", "y"])
def test_a_text_has_the_energy_of_all_its_pairs(axis):
    """With each mean of unlike parameters, and one that is given for the pair."""
    forces = {
        "name": "text",
        "energy": "4*eps*((sig/r)**12 - (sig/r)**6)*(1 + k*a_r*b_r + q*exp(-a_b**2))",
        "parameters": {
            "disc": {"eps": 1.0, "sig": 5.0, "k": 2.0, "q": 1.0},
            "plate": {"eps": 0.5, "sig": 6.0, "k": 6.0, "q": 0.5},
        },
        "mixing": {"k": "harmonic"},
        "pairs": [{"species": ["plate", "disc"], "parameters": {"q": 0.2}}],
        "axis": axis,
        "cutoff_A": 14.0,
    }

    def energy(r, u, v, p, q):
        s = np.sqrt(r @ r)
        six = ((p.sig + q.sig) / 2 / s) ** 6
        angles = 2 / (1 / p.k + 1 / q.k) * (u @ r) * (v @ r) / s**2
        angles = angles + np.sqrt(p.q * q.q) * np.exp(-((u @ v) ** 2))
        return 4 * np.sqrt(p.eps * q.eps) * (six**2 - six) * (1 + angles)

    molecules = [body("disc", 24), body("disc", 8) | {"name": "plate"}]
    function = rigidmd.body_pair_potential(
        energy,
        forces["parameters"],
        pairs={("plate", "disc"): {"q": 0.2}},
        axis=axis,
        cutoff_A=forces["cutoff_A"],
    )
    run = simulation(forces, molecules=molecules)
    state = shuffled(run, 9)
    expected = brute_force(run.system, state, forces, energy)
    of_python = build(scene(None, molecules=molecules).with_user_code([function]))
    for system in (run.system, of_python):
        (found,) = system.engine().evaluate(state)[1].values()
        assert found.energy / KJ_PER_MOL == pytest.approx(expected, rel=1e-11)


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"potential": "gay_berne"}, r"parameters is missing: gay_berne needs length_A"),
        (
            {"potential": "gay_berne", "parameters": {"rod": ROD | {"lenght_A": 3.0}}},
            r"parameters of rod: gay_berne has no lenght_A; did you mean length_A",
        ),
        (
            {"potential": "patch", "parameters": {"rod": {"sigma_A": 3.0}}},
            r"parameters of rod: epsilon_kJ_mol, width is missing",
        ),
        (
            {"potential": "gay_berne", "parameters": {"rodd": ROD}},
            r"parameters: there is no rodd; did you mean rod",
        ),
        (
            {"potential": "gay_berne", "energy": "1/r"},
            "give one of potential, energy, table and module",
        ),
        (
            {"potential": "gay_berne", "parameters": {"rod": ROD | {"width_A": -4.0}}},
            "width_A of rod is -4, must be above 0",
        ),
        (GAY_BERNE | {"options": {"mu": 0.0}}, "mu of options is 0, must be above 0"),
        ({"energy": "1/r +"}, "is not a formula"),
        ({"energy": "k/r"}, "no species has the parameter k"),
        (GAY_BERNE | {"cutoff_A": 30.0}, "longer than half an edge of the box"),
        (GAY_BERNE | {"options": {"nu": 1.0}}, r"options: gay_berne has no nu; there are upsilon"),
        (GAY_BERNE | {"truncation": "plain", "switch_start_A": 9.0}, "would have no effect"),
        (
            {"module": "own.py", "name": "own", "parameters": {"rod": {"k": 1.0}}},
            "parameters would have no effect here",
        ),
    ],
)
def test_what_is_wrong_with_a_potential_is_reported(tables, message, tmp_path):
    with pytest.raises(SceneError, match=message):
        build(scene(tables))


def test_pairs_at_a_cutoff_where_the_energy_jumps_are_not_a_wrong_force():
    """Two rods at a distance of exactly the cutoff. A wrong force is found there too: by its virial,
    as neighbours on opposite sides enter alike when one rod moves."""
    places = {"box": {"lengths_A": 48.0}, "molecules": [body("rod", 64)]}
    tables = GAY_BERNE | {"parameters": {"rod": ROD}, "references": {}}
    right = simulation(tables | {"cutoff_A": 12.0, "truncation": "plain"}, **places)
    right._start()
    distances = np.linalg.norm(right.state.position[0] - right.state.position[1:], axis=1)
    assert np.abs(distances - 12.0).min() < 1e-9

    def wrong(r, u, v):
        s = np.sqrt(r @ r)
        return 100 / s**6, 100 * r / s**8, 0 * u, 0 * v

    potential = rigidmd.body_pair_potential(wrong, axis="z", cutoff_A=12.0, truncation="plain")
    with pytest.raises(SceneError, match="xx of its molecular virial is 0 kJ/mol, and when"):
        Simulation(scene(None, **places), forces=[potential]).run()


def test_a_potential_of_a_module_needs_trust(tmp_path):
    (tmp_path / "own.py").write_text(
        "import numpy as np, rigidmd\n"
        "own = rigidmd.body_pair_potential(lambda r, a, b: 100 / (r @ r) ** 3, cutoff_A=12)\n"
    )
    tables = {"module": "own.py", "name": "own"}
    data = {
        "box": {"lengths_A": 40.0},
        "molecules": [body("rod", 10)],
        "start": {"temperature_K": 200.0},
        "forces": {"bodies": [tables]},
        "stages": [{"duration_ps": 0.05}],
    }
    untrusted = Scene.from_dict(data, tmp_path)
    with pytest.raises(SceneError, match="is Python code"):
        build(untrusted)
    rigidmd.trust_file(tmp_path / "own.py")
    assert list(build(Scene.from_dict(data, tmp_path)).terms) == ["own"]


# --- pictures -------------------------------------------------------------------------------------


def test_bodies_are_drawn_as_ellipsoids_where_they_are():
    """Rods along their axis z, discs about a reference point, and the silhouettes of two rods."""
    system = build(scene(GAY_BERNE))
    solids, state = solids_of(system), system.state
    assert solids is not None and len(solids.molecule) == 32
    load = np.zeros((0, 3))
    centres, rotation = solids.poses(Bodies(state.position, state.rotation, load, load))
    for k in (0, 30):  # a rod and a disc
        species = system.species[system.model.species[k]]
        frame = state.rotation[k] @ species.axes.T
        reference = np.array(GAY_BERNE["references"].get(species.name, species.centre))
        assert centres[k] == pytest.approx(state.position[k] + frame @ (reference - species.centre))
        assert rotation[k, :, 2] == pytest.approx(frame[:, 2])
    assert solids.semi_axes[[0, 30]] == pytest.approx(np.array([[2, 2, 6], [4, 4, 1.5]]))
    axis = new_figure(4, 4, layout=None).add_axes((0, 0, 1, 1))
    view = View(axis, camera(np.array([0.0, -1.0, 0.0])), 10.0)
    about_y = Rotation.from_rotvec([0, 0.7, 0]).as_matrix()
    image = view.solids(
        np.array([[0.0, 0, 0], [0.0, 20, 0]]),  # the second one is behind the first
        np.array([about_y, np.eye(3)]),
        np.array([[2.0, 2, 6], [2, 2, 3]]),
        np.array([[1.0, 0, 0], [0, 0, 1]]),
    )
    view.image(image)
    assert np.array_equal(axis.images[0].get_array(), image)
    pixel = (20.0 / image.shape[0]) ** 2
    red, blue = image[..., 0] > image[..., 2], image[..., 2] > image[..., 0]
    assert red.sum() * pixel == pytest.approx(np.pi * 12, rel=0.01)
    assert 0 < blue.sum() * pixel < np.pi * 6 - np.pi * 4 * 0.6
    row = np.argwhere(red).max(axis=0)[0]
    assert (row / image.shape[0] - 0.5) * 20 == pytest.approx(
        np.hypot(6 * np.cos(0.7), 2 * np.sin(0.7)), abs=0.05
    )


def test_potentials_of_python_are_drawn_like_those_of_scenes():
    """Also those of a stored run, whose energies are not computed."""
    potential = rigidmd.body_pair_potential(
        GayBerne(),
        GAY_BERNE["parameters"],
        axis="z",
        references=GAY_BERNE["references"],
        cutoff_A=15.0,
    )
    expected = solids_of(build(scene(GAY_BERNE)))
    systems = [
        build(scene(None).with_user_code([potential])),
        build(scene(GAY_BERNE), user_code=False),
    ]
    for solids in map(solids_of, systems):
        assert expected is not None and solids is not None
        for one, other in zip(solids, expected, strict=True):
            np.testing.assert_array_equal(one, other)
    text = {"energy": "exp(-r)*a_b**2", "name": "aligning", "axis": "x"}
    (bodies, _) = bodies_of_potentials(build(scene(text), user_code=False))
    assert bodies.potential.axis == "x" and bodies.species.name == "rod"


def test_the_list_finds_every_pair_while_bodies_move_and_the_box_changes():
    """Few bodies in a long box of many bins, hot, with a barostat: the energy at the end is that of
    all pairs."""
    npt = {
        "ensemble": "npt",
        "temperature_K": 900.0,
        "pressure_bar": 1.0,
        "barostat_time_ps": 0.05,
        "duration_ps": 3.0,
        "timestep_fs": 5.0,
    }
    tables = {"box": {"lengths_A": [34.0, 36.0, 120.0]}, "stages": [npt]}
    run = simulation(GAY_BERNE, {"rod": 40, "disc": 20}, **tables)
    results = run.run()
    _, tallies = run.system.engine().evaluate(results.state)
    expected = brute_force(run.system, results.state, GAY_BERNE)
    assert tallies["gay_berne"].energy / KJ_PER_MOL == pytest.approx(expected, rel=1e-10)
    assert results["potential"][-1] == pytest.approx(expected, rel=1e-9)
    assert results["volume"][-1] != results["volume"][0]
