"""Energies of pairs of bodies: derived slopes, the shipped potentials, the neighbour list, scenes."""

import shutil
import subprocess
import sys
from functools import partial
from itertools import pairwise, product
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.common import bits_with
from support.stops import same_after_stops

import rigidmd
from rigidmd import Scene, Simulation
from rigidmd.assemble.build import build
from rigidmd.assemble.guest import Guest
from rigidmd.compile import kernel
from rigidmd.core.statistics import slope
from rigidmd.engines.body_pairs import bodies_of_potentials
from rigidmd.errors import SceneError
from rigidmd.figures.space import View, camera
from rigidmd.figures.style import new_figure
from rigidmd.forces.poses.formulas import formula_of_poses
from rigidmd.forces.poses.gay_berne import PARAMETERS, GayBerne
from rigidmd.forces.poses.multipoles import dipole, quadrupole
from rigidmd.forces.poses.pair_list import BUILDS, MUST_BUILD
from rigidmd.forces.poses.pairs import pair_slopes
from rigidmd.forces.poses.patch import PARAMETERS as PATCH
from rigidmd.forces.poses.patch import Patch
from rigidmd.forces.poses.slopes import code_of, slopes_of
from rigidmd.forces.poses.table import read_body_table
from rigidmd.forces.poses.trace import Graph, TraceError
from rigidmd.run.checks import within_table
from rigidmd.run.rigid_fit import Bodies
from rigidmd.scene.models import read_molecule
from rigidmd.studies.virial import second_virial
from rigidmd.units import BOLTZMANN, COULOMB, DEBYE, KJ_PER_MOL
from rigidmd.view.solids import solids_of

ROD = {"length_A": 12.0, "width_A": 4.0, "epsilon_kJ_mol": 1.0, "side": 1.0, "end": 0.2}
DISC = {"length_A": 3.0, "width_A": 8.0, "epsilon_kJ_mol": 1.5, "side": 0.5, "end": 1.2}
BALL = {"length_A": 4.0, "width_A": 4.0, "epsilon_kJ_mol": 0.8, "side": 1.0, "end": 1.0}
SITES = {
    "rod": [[0.0, 0.0, 3.4], [0.0, 0.0, -3.4]],
    "disc": [[3.0, 0.0, 0.0], [-1.5, 2.6, 0.0], [-1.5, -2.6, 0.0]],
}


def body(name: str, count: int) -> dict:
    sites = [
        {"name": f"A{k}", "mass_u": 20.0, "position_A": position}
        for k, position in enumerate(SITES[name])
    ]
    return {"name": name, "count": count, "sites": sites}


def scene(forces: dict | None, counts=None, **tables) -> Scene:
    """Rods and discs in a slanted box, with a potential of [[forces.bodies]]."""
    molecules = [body(name, count) for name, count in (counts or {"rod": 24, "disc": 8}).items()]
    return Scene.from_dict(
        {
            "box": {"lengths_A": [36.0, 37.0, 38.0], "angles_deg": [90.0, 84.0, 78.0]},
            "molecules": molecules,
            "start": {"temperature_K": 200.0},
            "precision": "double",
            "threads": 1,
            "forces": {"bodies": [forces] if forces else []},
            "stages": [{"duration_ps": 0.05, "timestep_fs": 5.0}],
        }
        | tables
    )


GAY_BERNE = {
    "potential": "gay_berne",
    "parameters": {"rod": ROD, "disc": DISC},
    "references": {"disc": [0.5, 0.2, 0.3]},
    "cutoff_A": 15.0,
}


def shuffled(simulation: Simulation, seed: int):
    """The start of a simulation with other orientations."""
    simulation._start()
    state = simulation.state.copy()
    n = len(state.position)
    state.rotation[:] = Rotation.random(n, random_state=seed).as_matrix()
    return state


# --- slopes ---------------------------------------------------------------------------------------


def traced(function, names):
    """(energy, slopes) of a function of numbers, as a function that Python runs."""
    graph = Graph()
    leaves = [graph.leaf(name) for name in names]
    output = function(*leaves)
    lines, texts = code_of([output, *slopes_of(output, leaves)])
    source = "\n    ".join([f"def f({', '.join(names)}):", *lines, f"return {', '.join(texts)}"])
    space: dict = {}
    exec(f"from math import *\n{source}", space)
    return space["f"], len(lines)


@pytest.mark.parametrize(
    "function",
    [
        lambda x, y: x * y + 2 * x - y / x,
        lambda x, y: np.exp(-x) * np.sin(y) + np.cos(x * y),
        lambda x, y: np.sqrt(x * x + y**2) ** 3 + x**-1.5 + 2**y,
        lambda x, y: np.tanh(x - y) + np.log(x) - abs(y - 3) + np.arccos(y / 5),
        lambda x, y: np.where(x > y, x * x, y * x) + np.maximum(x, 0.1) - np.minimum(y, 0.7),
        lambda x, y: -(x * -1) + 0 * y + x * 1 - (0 - y) + x**1 + x**0 + (x - x),
        lambda x, y: x**y,
        lambda x, y: np.array([x, y], object) @ np.array([y, x], object) + np.square(x),
    ],
)
@pytest.mark.parametrize("at", [(0.8, 0.3), (0.4, 1.7)])
def test_slopes_are_those_of_differences(function, at):
    compiled, _ = traced(function, ("x", "y"))
    value, *slopes = compiled(*at)
    assert value == pytest.approx(float(function(*map(np.float64, at))), rel=1e-14)
    for k in range(2):
        step = 1e-6 * np.eye(2)[k]
        ends = [float(function(*(np.array(at) + sign * step))) for sign in (1, -1)]
        assert slopes[k] == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-7, abs=1e-8)


def test_equal_parts_are_computed_once_and_constants_here():
    _, lines = traced(lambda x, y: np.exp(x * y) + np.exp(x * y) ** 2, ("x", "y"))
    _, shorter = traced(lambda x, y: np.exp(x * y), ("x", "y"))
    assert lines <= shorter + 8
    _, none = traced(lambda x, y: x + 0.0 * np.exp(2.0) * y, ("x", "y"))
    assert none == 0


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda r, u, v: 1.0 if r[0] > 0 else 2.0, "branches on a value"),
        (lambda r, u, v: float(r[0]), "use the functions of NumPy"),
        (lambda r, u, v: np.arctan(r[0]), "arctan"),
        (lambda r, u, v: 3.0, "must return an energy that depends on"),
        (lambda r, u, v: (r[0], r), "a tuple of the energy"),
        (lambda r, u: r[0], r"must have the arguments \(r, a, b\)"),
        (lambda r, u, v: r[7], "IndexError"),
        (lambda r, u, v: r[0] / 0.0, "not a finite number"),
    ],
)
def test_functions_without_slopes_are_refused_with_the_reason(function, message):
    with pytest.raises(TraceError, match=message):
        formula_of_poses(function, (), "z")


# --- potentials -----------------------------------------------------------------------------------


def named(values: dict) -> SimpleNamespace:
    return SimpleNamespace(**values)


def test_gay_berne_of_two_rods_has_the_wells_of_its_paper():
    """Side by side epsilon_0 / sqrt(1 - chi²) = 5/3 deep, end to end a fifth of it."""
    z, energy = np.array([0.0, 0.0, 1.0]), GayBerne()
    side = 4.0 * 2 ** (1 / 6) * np.array([1.0, 0.0, 0.0])
    end = (8.0 + 4.0 * 2 ** (1 / 6)) * z
    assert energy(side, z, z, named(ROD), named(ROD)) == pytest.approx(-5 / 3, rel=1e-12)
    assert energy(end, z, z, named(ROD), named(ROD)) == pytest.approx(-1 / 3, rel=1e-12)


def from_matrices(r, u, v, p, q, upsilon, mu, gamma):
    """The general form for ellipsoids by 3 x 3 matrices, Everaers & Ejtehadi 2003."""
    distance = np.linalg.norm(r)
    unit = r / distance

    def matrix(axis, across, along):
        return across * np.eye(3) + (along - across) * np.outer(axis, axis)

    bodies = (u, p), (v, q)
    shape = sum(matrix(axis, (x.width_A / 2) ** 2, (x.length_A / 2) ** 2) for axis, x in bodies)
    wells = sum(matrix(axis, x.side ** (-1 / mu), x.end ** (-1 / mu)) for axis, x in bodies)
    sizes = [((x.width_A / 2) ** 2 + (x.length_A / 2) ** 2) * x.width_A / 2 for _, x in bodies]
    eta = (2 * sizes[0] * sizes[1] / np.linalg.det(shape)) ** (upsilon / 2)
    chi = (2 * unit @ np.linalg.solve(wells, unit)) ** mu
    contact = (0.5 * unit @ np.linalg.solve(shape, unit)) ** -0.5
    sigma = (p.width_A + q.width_A) / 2
    ratio = sigma / (distance - contact + gamma * sigma)
    epsilon = np.sqrt(p.epsilon_kJ_mol * q.epsilon_kJ_mol)
    return 4 * epsilon * (ratio**12 - ratio**6) * eta * chi


@pytest.mark.parametrize("exponents", [(1.0, 2.0, 1.0), (3.0, 1.0, 0.8)])
def test_unlike_ellipsoids_are_those_of_the_general_form(exponents):
    rng, energy = np.random.default_rng(1), GayBerne(*exponents)
    kinds = [named(ROD), named(DISC), named(BALL)]
    for p, q in product(kinds, kinds):
        u, v, direction = (x / np.linalg.norm(x) for x in rng.standard_normal((3, 3)))
        r = 11.0 * direction
        expected = from_matrices(r, u, v, p, q, *exponents)
        assert energy(r, u, v, p, q) == pytest.approx(expected, rel=1e-11)
        assert energy(-r, v, u, q, p) == pytest.approx(expected, rel=1e-11)


def original_gay_berne(r, u, v, width, strength, kappa, wells, mu, nu):
    """Gay & Berne 1981, equal ellipsoids."""
    distance = np.linalg.norm(r)
    a, b, c = u @ r / distance, v @ r / distance, u @ v
    chi = (kappa**2 - 1) / (kappa**2 + 1)
    of_wells = (wells ** (1 / mu) - 1) / (wells ** (1 / mu) + 1)
    shape, depth = (
        1 - x / 2 * ((a + b) ** 2 / (1 + x * c) + (a - b) ** 2 / (1 - x * c))
        for x in (chi, of_wells)
    )
    rho = (distance - width / np.sqrt(shape) + width) / width
    epsilon = strength * (1 - (chi * c) ** 2) ** (-nu / 2) * depth**mu
    return 4 * epsilon * (rho**-12 - rho**-6)


@pytest.mark.parametrize("exponents", [(1.0, 2.0), (2.0, 1.0)])
def test_equal_ellipsoids_have_the_original_form(exponents):
    nu, mu = exponents
    rng, energy = np.random.default_rng(4), GayBerne(nu, mu)
    for kind in (ROD, DISC):
        for _ in range(5):
            u, v, direction = (x / np.linalg.norm(x) for x in rng.standard_normal((3, 3)))
            r = rng.uniform(9, 14) * direction
            expected = original_gay_berne(
                r,
                u,
                v,
                kind["width_A"],
                kind["epsilon_kJ_mol"] * kind["side"],
                kind["length_A"] / kind["width_A"],
                kind["side"] / kind["end"],
                mu,
                nu,
            )
            assert energy(r, u, v, named(kind), named(kind)) == pytest.approx(expected, rel=1e-11)


def test_overlapping_ellipsoids_repel():
    """Where the shifted distance is 0 or negative the form alone would diverge or attract."""
    u, x = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
    for distance in (1e-3, 1.0, 3.0):
        assert GayBerne()(distance * u, u, u, named(ROD), named(ROD)) > 1e9
        assert GayBerne()(distance * x, u, x, named(ROD), named(ROD)) > 1e9


def test_torques_and_force_of_a_pair_add_up_to_no_torque():
    rng, formula = np.random.default_rng(11), formula_of_poses(Patch(), PATCH, "x")
    evaluate = evaluated(formula)
    kind = {"sigma_A": 4.0, "epsilon_kJ_mol": 2.0, "width": 0.4}
    row = np.array(formula.numbers(kind, kind))
    for _ in range(5):
        r = 5 * rng.standard_normal(3)
        a, b = Rotation.random(2, random_state=rng).as_matrix()
        _, slope, torque, other = map(np.array, evaluate(row, tuple(r), a, b))
        size = np.abs(torque).max() + np.abs(other).max()
        assert torque + other - np.cross(r, slope) == pytest.approx(0.0, abs=1e-12 * size)


def lammps(*lines: str, folder) -> None:
    program = shutil.which("lmp")
    if program is None:
        pytest.skip("LAMMPS is not installed")
    (folder / "in.lmp").write_text("\n".join(lines))
    ended = subprocess.run(
        [program, "-in", "in.lmp", "-log", "none", "-screen", "none"],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr


def test_a_thousand_pairs_have_the_energies_forces_and_torques_of_lammps(tmp_path):
    pairs, apart = 1000, 100.0
    rng = np.random.default_rng(5)
    rotation = Rotation.random(2 * pairs, random_state=6)
    centre = apart * np.array(list(product(range(10), repeat=3)))[:pairs]
    direction = rng.standard_normal((pairs, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    second = centre + direction * rng.uniform(9.0, 15.0, pairs)[:, None]
    kind = rng.integers(1, 3, 2 * pairs)
    quaternion = rotation.as_quat()[:, [3, 0, 1, 2]]
    position = np.stack([centre, second], axis=1).reshape(-1, 3)
    shapes = {1: ROD, 2: DISC}
    rows = [
        f"{k + 1} {kind[k]} 1 1 {x:.17g} {y:.17g} {z:.17g}" for k, (x, y, z) in enumerate(position)
    ]
    ellipsoids = [
        f"{k + 1} {s['width_A']} {s['width_A']} {s['length_A']} "
        + " ".join(f"{x:.17g}" for x in quaternion[k])
        for k, s in enumerate(shapes[one] for one in kind)
    ]
    size = 10 * apart + 50
    (tmp_path / "pairs.data").write_text(
        f"pairs\n\n{2 * pairs} atoms\n{2 * pairs} ellipsoids\n2 atom types\n\n"
        + "".join(f"-50 {size} {x}lo {x}hi\n" for x in "xyz")
        + "\nAtoms # ellipsoid\n\n"
        + "\n".join(rows)
        + "\n\nEllipsoids\n\n"
        + "\n".join(ellipsoids)
        + "\n"
    )
    coefficients = [
        f"pair_coeff {i} {j} {np.sqrt(p['epsilon_kJ_mol'] * q['epsilon_kJ_mol']):.17g}"
        f" {(p['width_A'] + q['width_A']) / 2}"
        f" {p['side']} {p['side']} {p['end']} {q['side']} {q['side']} {q['end']}"
        for (i, p), (j, q) in product(shapes.items(), repeat=2)
        if i <= j
    ]
    lammps(
        "units lj",
        "atom_style ellipsoid",
        "boundary f f f",
        "read_data pairs.data",
        "pair_style gayberne 1.0 1.0 2.0 20.0",
        *coefficients,
        "compute energy all pe/atom",
        "dump 1 all custom 1 forces.txt id fx fy fz tqx tqy tqz c_energy",
        'dump_modify 1 sort id format float "%.17g"',
        "run 0",
        folder=tmp_path,
    )
    table = np.loadtxt(tmp_path / "forces.txt", skiprows=9).reshape(pairs, 2, 8)
    formula = formula_of_poses(GayBerne(), PARAMETERS, "z")
    evaluate = evaluated(formula)
    matrices = rotation.as_matrix().reshape(pairs, 2, 3, 3)
    for k in range(pairs):
        p, q = (shapes[one] for one in kind[2 * k : 2 * k + 2])
        row = np.array(formula.numbers(p, q))
        values = evaluate(row, tuple(second[k] - centre[k]), *matrices[k])
        energy, slope, torque, other = (np.array(part) / KJ_PER_MOL for part in values)
        size = np.abs(table[k]).max()
        assert energy == pytest.approx(table[k, :, 7].sum(), rel=1e-10, abs=1e-10 * size)
        assert slope == pytest.approx(table[k, 0, 1:4], rel=1e-10, abs=1e-10 * size)
        assert torque == pytest.approx(table[k, 0, 4:7], rel=1e-10, abs=1e-10 * size)
        assert other == pytest.approx(table[k, 1, 4:7], rel=1e-10, abs=1e-10 * size)


def evaluated(formula):
    """A formula as a function of a row of numbers and two poses, in plain Python."""
    function = sys.modules[formula.kind.__module__]._of_poses
    return partial(getattr(function, "py_func", function), formula.kind())


def test_dipoles_and_quadrupoles_are_limits_of_charges():
    """Charges at the distance 2 h on the axis: the error is of the order h²."""
    rng = np.random.default_rng(3)
    u, v, direction = (x / np.linalg.norm(x) for x in rng.standard_normal((3, 3)))
    r = 6.0 * direction

    def of_charges(first, second, h):
        return sum(
            a * b * COULOMB / KJ_PER_MOL / np.linalg.norm(r + h * y * v - h * x * u)
            for (x, a), (y, b) in product(first.items(), second.items())
        )

    two, three = {1: 1.0, -1: -1.0}, {1: 1.0, 0: -2.0, -1: 1.0}
    for h in (0.1, 0.05):
        for charges, energy, key, moment in [
            (two, dipole(), "dipole_D", 2 * h / DEBYE),
            (three, quadrupole(), "quadrupole_D_A", 2 * h * h / DEBYE),
        ]:
            expected = of_charges(charges, charges, h)
            found = energy(r, u, v, named({key: moment}), named({key: moment}))
            assert found == pytest.approx(expected, rel=10 * h * h)
    inside = dipole(12.0)(r, u, v, *[named({"dipole_D": 2.0})] * 2)
    outside = dipole()(r, u, v, *[named({"dipole_D": 2.0})] * 2)
    factor = COULOMB / KJ_PER_MOL * DEBYE**2 * 4 / 12.0**3
    assert inside - outside == pytest.approx(-factor * (u @ v), rel=1e-12)


def test_patches_attract_where_they_face_each_other():
    x, energy = np.array([1.0, 0.0, 0.0]), Patch()
    kind = named({"sigma_A": 4.0, "epsilon_kJ_mol": 2.0, "width": 0.2})
    contact = 4.0 * 2 ** (1 / 6) * x
    assert energy(contact, x, -x, kind, kind) == pytest.approx(-2.0, rel=1e-12)
    assert energy(contact, -x, x, kind, kind) > 1.9


# --- in a run -------------------------------------------------------------------------------------


def simulation(tables: dict, counts=None, **more) -> Simulation:
    return Simulation(scene(tables, counts, **more), warn=str)


ENERGY = GayBerne()


def brute_force(system, state, forces: dict, energy=ENERGY) -> float:
    """The energy (kJ/mol) by a loop over all pairs and their nearest images."""
    cutoff, cell, axis = forces["cutoff_A"], state.cell, "xyz".index(forces.get("axis", "z"))
    shifts = np.array(list(product((-1, 0, 1), repeat=3))) @ cell
    models, names = system.species, [m.name for m in system.species]
    frames = [state.rotation[k] @ models[s].axes.T for k, s in enumerate(system.model.species)]
    points = []
    for k, s in enumerate(system.model.species):
        m = models[s]
        reference = np.array(forces.get("references", {}).get(m.name, m.centre)) - m.centre
        points.append(state.position[k] + frames[k] @ reference)
    total = 0.0
    for i in range(len(points)):
        for j in range(i + 1, len(points)):
            r = points[j] - points[i]
            r = r - np.rint(np.linalg.solve(cell.T, r)) @ cell
            r = min(r + shifts, key=np.linalg.norm)
            distance = np.linalg.norm(r)
            if distance >= cutoff:
                continue
            x = max(0.0, (distance / cutoff - 0.9) / 0.1)
            kinds = [names[system.model.species[k]] for k in (i, j)]
            of_pair = {}
            for pair in forces.get("pairs", ()):
                of_pair |= pair["parameters"] if sorted(kinds) == sorted(pair["species"]) else {}
            parameters = [named(forces["parameters"][name] | of_pair) for name in kinds]
            axes = frames[i][:, axis], frames[j][:, axis]
            total += (1 - x**3 * (10 - 15 * x + 6 * x * x)) * energy(r, *axes, *parameters)
    return total


def test_a_mixture_has_the_energy_of_all_its_pairs_and_forces_that_are_its_slopes():
    run = simulation(GAY_BERNE)
    state = shuffled(run, 4)
    system, engine = run.system, run.system.engine()
    load, tallies = engine.evaluate(state)
    name = "gay_berne"
    assert tallies[name].energy / KJ_PER_MOL == pytest.approx(
        brute_force(system, state, GAY_BERNE), rel=1e-11
    )

    def slope(change) -> float:
        ends = []
        for sign in (1, -1):
            moved = state.copy()
            change(moved, sign * 1e-5)
            ends.append(engine.evaluate(moved)[1][name].energy)
        return (ends[0] - ends[1]) / 2e-5

    size = np.abs(load.force).max()
    for m, k in [(0, 0), (11, 1), (25, 2), (30, 0)]:

        def move(moved, h, m=m, k=k):
            moved.position[m, k] += h

        def rotate(moved, h, m=m, k=k):
            moved.rotation[m] = (
                state.rotation[m] @ Rotation.from_rotvec(h * np.eye(3)[k]).as_matrix()
            )

        assert load.force[m, k] == pytest.approx(-slope(move), abs=1e-7 * size)
        assert load.torque_body[m, k] == pytest.approx(-slope(rotate), abs=1e-6 * size)
    for i, j in [(0, 0), (1, 0), (2, 1), (2, 2)]:

        def strain(moved, h, i=i, j=j):
            matrix = np.eye(3)
            matrix[i, j] += h
            moved.cell[:] = moved.cell @ matrix
            moved.position[:] = moved.position @ matrix

        virial = np.array(tallies[name].virial).reshape(3, 3)
        assert virial[j, i] == pytest.approx(-slope(strain), abs=1e-6 * size)
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


def test_the_list_is_built_anew_where_a_strain_of_a_slanted_cell_exceeds_its_skin():
    """The strain is a matrix S with cell = built S, whose norm e may be up to skin/(cutoff + skin):
    then (1 - e)(cutoff + skin) is the cutoff."""
    tables = GAY_BERNE | {"parameters": {"rod": ROD}, "references": {}}
    box = {"lengths_A": 44.0, "angles_deg": [66.0, 75.0, 70.0]}
    system = build(scene(tables, {"rod": 24}, box=box))
    engine, cutoff = system.engine(), tables["cutoff_A"]
    engine.evaluate(system.state)
    pairs = engine.workspaces["gay_berne"].pairs
    limit = pairs.skin / (cutoff + pairs.skin)
    rng = np.random.default_rng(3)
    strains = [np.tril(rng.standard_normal((3, 3))) for _ in range(8)]
    strains += [np.outer(row, [1.0, 0.0, 0.0]) for row in np.eye(3)]  # xx, xy, xz alone
    for strain in strains:
        for fraction, builds in ((0.99, 0), (1.01, 1)):
            pairs.counters[MUST_BUILD] = 1
            engine.evaluate(system.state)
            before = int(pairs.counters[BUILDS])
            moved = system.state.copy()
            matrix = np.eye(3) + fraction * limit * strain / np.linalg.norm(strain)
            moved.cell[:] = moved.cell @ matrix
            moved.position[:] = moved.position @ matrix
            engine.evaluate(moved)
            assert pairs.counters[BUILDS] - before == builds, strain


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
def test_what_is_wrong_with_a_potential_is_told(tables, message, tmp_path):
    with pytest.raises(SceneError, match=message):
        build(scene(tables))


def test_pairs_at_a_cutoff_where_the_energy_jumps_are_no_wrong_force():
    """Two rods at a distance of exactly the cutoff; a wrong force is found there too."""
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
    with pytest.raises(SceneError, match="is not the derivative of the energy"):
        Simulation(scene(None, **places), forces=[potential]).run()


def test_bodies_that_do_not_rotate_have_no_such_potential():
    tables = {"energy": "1/r**12", "name": "wall"}
    with pytest.raises(SceneError, match="no body of the scene rotates"):
        build(scene(tables, molecules=[{"model": "argon", "count": 10}]))


LINES = {"along": [0.0, 0.0, 1.0], "across": [1.0, 0.0, 0.0], "oblique": [0.6, 0.0, 0.8]}


def line(name: str, count: int = 6) -> dict:
    """Two masses on a line."""
    ends = [[sign * x for x in LINES[name]] for sign in (1.0, -1.0)]
    sites = [{"name": f"A{k}", "mass_u": 20.0, "position_A": x} for k, x in enumerate(ends)]
    return {"name": name, "count": count, "sites": sites}


DISK = body("disc", 6)
DOT = {"name": "dot", "count": 6, "sites": [{"name": "A", "mass_u": 20.0, "position_A": [0, 0, 0]}]}
SHIPPED = {
    "gay_berne": ROD,
    "dipole": {"dipole_D": 2.0},
    "quadrupole": {"quadrupole_D_A": 3.0},
    "patch": {"sigma_A": 4.0, "epsilon_kJ_mol": 2.0, "width": 0.3},
}


def errors_of(molecules, tables=None, forces=(), folder=".") -> str:
    """The errors of a scene of molecules, empty without one."""
    data = {
        "box": {"lengths_A": 40.0},
        "molecules": molecules,
        "threads": 1,
        "start": {"temperature_K": 200.0},
        "forces": {"cutoff_A": 12.0, "bodies": [tables] if tables else []},
        "stages": [{"duration_ps": 0.05, "timestep_fs": 5.0}],
    }
    try:
        build(Scene.from_dict(data, folder).with_user_code(forces))
    except SceneError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("potential", SHIPPED)
def test_torques_that_nothing_resists_are_refused(potential):
    """On points, and about the line of linear bodies, whatever the other body is; not on frozen
    bodies, and not about a line that is the axis of the potential."""

    def error(*molecules, **more) -> str:
        parameters = {m["name"]: SHIPPED[potential] for m in molecules}
        return errors_of(list(molecules), {"potential": potential, "parameters": parameters} | more)

    for other in (DISK, line("along")):
        assert "dot is a point: nothing resists" in error(DOT, other)
        assert "dot is a point: nothing resists" in error(other, DOT | {"count": 1})
        assert not error(DOT | {"frozen": True}, other)
        assert "across is linear: nothing resists the torque" in error(line("across"), other)
        assert "Use axis = 'x'" in error(other, line("across"))
        assert "must lie along z" in error(other, line("oblique"))
    assert not error(line("across"), DISK, axis="x")
    assert not error(DISK)
    for reference, message in (((0.0, 0.0, 0.4), ""), ((0.3, 0.0, 0.4), "must be on the line")):
        found = error(line("along"), DISK, references={"along": reference})
        assert message in found if message else not found


def test_torques_of_functions_texts_and_tables_that_nothing_resists_are_refused(tmp_path):
    written_table(tmp_path / "pair.npz", points=(20, 13, 13, 13))
    flat = np.exp(-np.linspace(4, 12, 20))[:, None, None, None] * np.ones((1, 13, 13, 13))
    written_table(tmp_path / "flat.npz", points=(20, 13, 13, 13), energy_kJ_mol=flat)
    one_line = [line("across"), DISK]
    for table, message in (("pair.npz", "Use axis = 'x'"), ("flat.npz", "")):
        found = errors_of(one_line, {"table": table}, folder=tmp_path)
        assert message in found if message else not found
    for energy, message in (("1/r**12", ""), ("(1 + 1e-6*a_r*b_r)/r**12", "across is linear")):
        found = errors_of(one_line, {"energy": energy})
        assert message in found if message else not found

    def of_matrices(r, a, b):  # even about x only
        return ((a[:, 0] @ r) * (b[:, 0] @ r) + 0.1 * (a[:, 0] @ b[:, 0])) / (r @ r) ** 4

    def of_others(r, a, b):
        return (a[:, 1] @ r) * (b[:, 1] @ r) / (r @ r) ** 4

    def given(r, a, b):
        return 1 / (r @ r), 2 * r / (r @ r) ** 2, 1e-3 * a[:, 0], 1e-3 * b[:, 0]

    for function, molecule, message in (
        (of_matrices, line("across"), ""),
        (of_matrices, line("along"), "line of its masses must not change the energy"),
        (of_others, line("across"), "line of its masses must not change the energy"),
        (given, DOT, "dot is a point"),
    ):
        potential = rigidmd.body_pair_potential(function)
        found = errors_of([molecule, DISK], forces=[potential])
        assert message in found if message else not found
        assert not errors_of([molecule | {"frozen": True}, DISK], forces=[potential])


@pytest.mark.parametrize(
    ("energy", "is_finite"),
    [
        ("log(-r)", False),
        ("(5/r)**12*sqrt(7-r)", False),
        ("(r-10)**0.5", False),  # the distance in the lattice: an infinite force
        ("sqrt(a_r)/r**6", False),
        ("exp(900-r)", False),
        ("sqrt(1+a_r)/r**6", True),
        ("(5/r)**12", True),
        ("sqrt(r-9)/r**6", True),
    ],
)
def test_energies_that_are_not_real_where_bodies_start_are_refused(energy, is_finite):
    """60 rods in a lattice of 10 Å."""
    found = errors_of([body("rod", 60)], {"name": "x", "energy": energy})
    message = "x: its energy or force is not a finite number between rod and rod"
    assert message in found if not is_finite else not found
    assert not errors_of([body("rod", 2)], {"name": "x", "energy": "(r-10)**0.5"})


def test_energies_of_sites_that_are_not_real_where_they_start_are_refused():
    for energy, is_finite in (("(r-3)**0.5", True), ("(r-8.05)**0.5", False), ("log(r-6)", False)):
        tables = {
            "box": {"lengths_A": 24.0},
            "molecules": [DOT | {"count": 300}],
            "forces": {"cutoff_A": 9.0, "custom": [{"name": "x", "energy": energy}]},
            "start": {"temperature_K": 200.0},
            "stages": [{"duration_ps": 0.05, "timestep_fs": 5.0}],
        }
        dots = Scene.from_dict(tables)
        if is_finite:
            build(dots)
            continue
        with pytest.raises(SceneError, match=r"not a finite number between dot\.A and dot\.A"):
            build(dots)


def test_trial_molecules_without_inertia_are_refused_too(tmp_path):
    (tmp_path / "dot.toml").write_text(
        'name = "dot"\n[[sites]]\nname = "A"\nmass_u = 20\nposition_A = [0, 0, 0]\n'
    )
    aligning = {"energy": "exp(-r)*a_b**2"}
    settings = {"forces.bodies": [aligning]}
    with pytest.raises(SceneError, match="dot is a point: nothing resists"):
        second_virial(str(tmp_path / "dot.toml"), "nitrogen", temperatures=[300], settings=settings)
    host = build(scene(aligning | {"cutoff_A": 12.0}, {"rod": 4}))
    with pytest.raises(SceneError, match="dot is a point: nothing resists"):
        Guest(host, read_molecule(tmp_path / "dot.toml"), 300.0)


class Twist(rigidmd.Force):
    """A torque about one axis of each body that does no work, as nothing rotates about it."""

    tied_to_places = False

    def __init__(self, axis):
        self.axis = axis

    def on_molecules(self, state):
        nothing = np.zeros_like(state.position)
        return 0.0, nothing, nothing + np.eye(3)[self.axis], np.zeros((3, 3))


def test_a_force_of_python_with_a_torque_about_an_axis_without_inertia_is_refused():
    """The axis of a linear body is its first principal one."""
    run = Simulation(scene(None, {"rod": 8}), forces=[Twist(0)], warn=str)
    with pytest.raises(
        SceneError, match=r"resists its torque of 1 kJ/mol .*\(rod\), about its axis"
    ):
        run.run()


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
    rigidmd.trust(tmp_path / "own.py")
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


# --- tables ---------------------------------------------------------------------------------------


def of_angles(r, first, second, dihedral):
    """An energy of two linear bodies that an exchange does not change."""
    c, d = np.cos(first), np.cos(second)
    e = c * d + np.sin(first) * np.sin(second) * np.cos(dihedral)
    return 40 * np.exp(-r / 2) * (1 + 0.4 * c * d + 0.3 * e**2 + 0.2 * (c - d) * (1 + 0.5 * e))


def written_table(path, points=(30, 25, 25, 25), **changes):
    ends = {
        "r_A": (4.0, 12.0),
        "theta_1_deg": (0, 180),
        "theta_2_deg": (0, 180),
        "phi_deg": (0, 180),
    }
    grid = {name: np.linspace(*ends[name], n) for name, n in zip(ends, points, strict=True)}
    r, *angles = np.meshgrid(*grid.values(), indexing="ij")
    grid["energy_kJ_mol"] = of_angles(r, *map(np.radians, angles))
    arrays = {name: array for name, array in (grid | changes).items() if array is not None}
    np.savez(path, **arrays)
    return path


#: An energy that rises inwards, of the points of `written_table`; cosine of the angle of two axes.
RISING = np.exp(-np.linspace(4, 12, 30))[:, None, None, None] * np.ones((1, 25, 25, 25))
_ANGLES = np.radians(np.linspace(0, 180, 25))
PARALLEL = np.multiply.outer(np.multiply.outer(np.sin(_ANGLES), np.sin(_ANGLES)), np.cos(_ANGLES))


@kernel(from_python=True)
def compiled_slopes(formula, p, r, a, b):
    return pair_slopes(formula, p, r, a, b)


def test_a_table_has_the_energy_of_its_function_and_forces_that_are_its_slopes(tmp_path):
    table = read_body_table(written_table(tmp_path / "pair.npz"))
    formula = formula_of_poses(table, (), "z")
    row, rng = np.array(formula.numbers({}, {})), np.random.default_rng(8)

    def values(r, a, b):
        return [np.array(x) for x in compiled_slopes(formula.kind(), row, tuple(r), a, b)]

    for _ in range(20):
        a, b = Rotation.random(2, random_state=rng).as_matrix()
        direction = rng.standard_normal(3)
        n = direction / np.linalg.norm(direction)
        r = rng.uniform(4.5, 11.5) * n
        energy, slope, torque, other = values(r, a, b)
        u, v = a[:, 2], b[:, 2]
        across = [x - (x @ n) * n for x in (u, v)]
        cosine = across[0] @ across[1] / np.prod([np.linalg.norm(x) for x in across])
        angles = np.arccos([u @ n, v @ n, cosine])
        expected = of_angles(np.linalg.norm(r), *angles)
        assert energy / KJ_PER_MOL == pytest.approx(expected, abs=2e-3)

        def along(k, r=r, a=a, b=b):
            """Differences of the energy by x, y or z, and by rotations of each body about it."""
            step = 1e-5 * np.eye(3)[k]
            spin = Rotation.from_rotvec(step).as_matrix()
            ends = [(r + step, a, b), (r - step, a, b)]
            ends += [(r, spin @ a, b), (r, spin.T @ a, b), (r, a, spin @ b), (r, a, spin.T @ b)]
            energies = [float(values(*at)[0]) for at in ends]
            return np.subtract(energies[::2], energies[1::2]) / 2e-5

        for k in range(3):
            found = np.array([slope[k], -torque[k], -other[k]])
            assert found == pytest.approx(along(k), abs=2e-5 * max(1.0, np.abs(energy)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"phi_deg": None}, "it has no array phi_deg; it needs r_A"),
        ({"r_A": np.geomspace(4, 12, 30)}, "r_A must have 4 points or more in even ascending"),
        ({"phi_deg": np.linspace(0, 360, 25)}, "phi_deg must run from 0 to 180"),
        ({"energy_kJ_mol": np.zeros((30, 25, 25))}, r"has the shape \(30, 25, 25\), must have"),
        ({"energy_kJ_mol": np.full((30, 25, 25, 25), np.nan)}, "and finite energies"),
        (
            {"energy_kJ_mol": np.ones((30, 25, 25, 1)) * np.arange(25.0)},
            "depends on phi where an axis is along the vector",
        ),
        (
            {"energy_kJ_mol": np.ones((30, 1, 25, 25)) * np.arange(25.0)[:, None, None]},
            "an exchange of both bodies changes the energy",
        ),
        ({"r_A": np.linspace(-1, 12, 30)}, "ascending distances above 0"),
        ({"r_A": np.linspace(3e200, 4e200, 30)}, "more than 1e\\+30, the largest of a table"),
        ({"energy_kJ_mol": 1e300 * RISING}, "more than 1e\\+30, the largest of a table"),
        (
            {"energy_kJ_mol": -RISING},
            "begins at 4 Å, where it does not repel at theta_1 = 0°, thet",
        ),
        ({"energy_kJ_mol": 0 * RISING}, "begins at 4 Å, where it does not repel"),
        # flat at the first two points: the parabola through the first three falls inwards
        ({"energy_kJ_mol": np.minimum(RISING, RISING[1])}, "where it does not repel"),
        # at one pair of angles only
        (
            {"energy_kJ_mol": RISING - 2 * RISING * (PARALLEL > 0.995)},
            "theta_1 = 90°, theta_2 = 90°, ph",
        ),
    ],
)
def test_bad_tables_are_answered_by_what_is_wrong(changes, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        read_body_table(written_table(tmp_path / "pair.npz", **changes))
    (tmp_path / "pair.npz").write_text("1 2 3")
    with pytest.raises(ValueError, match=r"pair\.npz is not an \.npz file of numbers"):
        read_body_table(tmp_path / "pair.npz")


def test_a_scene_has_a_table_as_a_file_and_compares_its_forces_at_the_start(tmp_path):
    written_table(tmp_path / "pair.npz", points=(20, 13, 13, 13))
    data = {
        "box": {"lengths_A": 40.0},
        "molecules": [body("rod", 60)],
        "start": {"temperature_K": 200.0},
        "threads": 1,
        "forces": {"bodies": [{"table": "pair.npz", "species": ["rod"], "cutoff_A": 12.0}]},
        "stages": [{"duration_ps": 0.05, "timestep_fs": 5.0}],
    }
    results = Simulation(Scene.from_dict(data, tmp_path)).run()
    assert np.abs(results["body_pairs"]).min() > 0
    assert np.ptp(results["energy"]) < 1e-3 * np.ptp(results["potential"]) + 1e-3
    data["forces"]["bodies"][0]["cutoff_A"] = 13.0
    with pytest.raises(SceneError, match="the table ends at 12 Å, before the cutoff of 13 Å"):
        build(Scene.from_dict(data, tmp_path))
    data["forces"]["bodies"][0]["cutoff_A"] = 3.9
    with pytest.raises(SceneError, match=r"the table begins at 4 Å, beyond the cutoff of 3\.9 Å"):
        build(Scene.from_dict(data, tmp_path))


@pytest.mark.parametrize(("first", "expected"), [(3.0, ""), (4.2, "bodies come nearer")])
def test_a_table_that_keeps_no_bodies_apart_is_warned_of(first, expected, tmp_path):
    r, angles = np.linspace(first, 12, 30), np.linspace(0, 180, 5)
    energy = 8 * ((4 / r) ** 12 - (4 / r) ** 6)
    arrays = {name: angles for name in ("theta_1_deg", "theta_2_deg", "phi_deg")}
    energy = energy[:, None, None, None] * np.ones((1, 5, 5, 5))
    np.savez(tmp_path / "pair.npz", r_A=r, energy_kJ_mol=energy, **arrays)
    data = {
        "box": {"lengths_A": 40.0},
        "molecules": [body("rod", 60)],
        "forces": {"cutoff_A": 12.0, "bodies": [{"table": "pair.npz"}]},
        "stages": [{"ensemble": "nvt", "temperature_K": 200.0, "duration_ps": 1.0}],
    }
    warnings = " ".join(build(Scene.from_dict(data, tmp_path)).warnings)
    assert expected in warnings and bool(warnings) == bool(expected)
    system = build(Scene.from_dict(data | {"box": {"lengths_A": [30.0, 40, 50]}}, tmp_path))
    state = system.state.copy()
    for distance in (first + 0.1, first - 0.1):
        state.position[7] = state.position[4] + [0.0, distance - 40, 0.0]  # of images
        warning = within_table(system, state)
        near = f"molecule 5 (rod) and molecule 8 (rod) have a distance of {distance:.3g} Å"
        swapped = f"molecule 8 (rod) and molecule 5 (rod) have a distance of {distance:.3g} Å"
        assert (near in warning or swapped in warning) == (distance < first)
    charged = body("rod", 60)
    charged["sites"][0] |= {"sigma_A": 3.0, "epsilon_kJ_mol": 1.0}
    warnings = build(Scene.from_dict(data | {"molecules": [charged]}, tmp_path)).warnings
    assert not any("bodies come nearer" in warning for warning in warnings)
