"""Molecules that stay put but exert force, and Lennard-Jones parameters of particular pairs."""

import numpy as np
import pytest
from support.common import built, move, observe, shaken, site, small_scene
from support.reference import Oracle

from rigidmd.assemble.build import build
from rigidmd.core.integrators import SCHEMES
from rigidmd.dynamics.model import mobile
from rigidmd.errors import SceneError
from rigidmd.mechanics.rotation import nearest_rotation
from rigidmd.run import Simulation
from rigidmd.run.kind import describe
from rigidmd.scene import Scene

CALORIE = 4.184
VERLET = SCHEMES["velocity_verlet"]
# kcal/mol, Å: HOWTO.json next to the data
WELLS = {1: (0.02, 2.5), 2: (0.005, 1.0), 3: (0.02, 3.2), 4: (0.015, 3.1), 5: (0.015, 3.1)}
SPECIAL = {(2, 4): (0.005, 0.5)}


def fourmol(folder):
    """Of the 29 atoms in order: molecule, type, mass, position (Å), velocity (Å/ps)."""
    lines = (folder / "data.fourmol").read_text().split("\n")

    def table(title, width):
        begin = lines.index(title) + 2
        rows = []
        for line in lines[begin:]:
            if not line.strip():
                break
            rows.append([float(x) for x in line.split()[:width]])
        return np.array(sorted(rows))

    masses = {int(kind): mass for kind, mass in table("Masses", 2)}
    atoms, velocity = table("Atoms # full", 7), table("Velocities", 4)[:, 1:] * 1000
    kind = atoms[:, 2].astype(int)
    return (
        atoms[:, 1].astype(int),
        kind,
        np.array([masses[k] for k in kind]),
        atoms[:, 4:7],
        velocity,
    )


def columns(path, key):
    """A block of numbers in a YAML file, (29, 3), without its first column."""
    block = path.read_text().split(f"{key}: ! |2\n")[1]
    return np.array([line.split()[1:] for line in block.split("\n")[:29]], float)


@pytest.mark.parametrize("case", ["small", "single"])
def test_rigid_bodies_among_frozen_atoms_follow_lammps(reference, case):
    """8 steps of 0.25 fs. The cutoff of 8 Å exceeds half the box of 15 Å, so the box stands there
    eight times."""
    folder = reference / "lammps_rigid"
    owner, kind, mass, position, velocity = fourmol(folder)
    bodies = [owner == m for m in (3, 4, 5)] if case == "small" else [owner <= 2]
    bodies += [np.arange(29) == i for i in range(29) if not any(b[i] for b in bodies)]
    molecules = []
    for b, members in enumerate(bodies):
        sites = [
            site(
                f"T{kind[i]}",
                mass[i],
                position[i].tolist(),
                sigma_A=WELLS[kind[i]][1],
                epsilon_kJ_mol=WELLS[kind[i]][0] * CALORIE,
            )
            for i in np.flatnonzero(members)
        ]
        alone = len(sites) == 1
        molecules.append({"name": f"b{b}", "sites": sites, "count": 8, "frozen": alone})
    pairs = [
        {"sites": [f"T{a}", f"T{b}"], "epsilon_kJ_mol": e * CALORIE, "sigma_A": s}
        for (a, b), (e, s) in SPECIAL.items()
    ]
    scene = Scene.from_dict(
        {
            "box": {"lengths_A": 30.0},
            "molecules": molecules,
            "forces": {
                "cutoff_A": 8.0,
                "truncation": "plain",
                "mixing": "geometric",
                "pairs": pairs,
            },
            "start": {"temperature_K": 0.0},
            "stages": [{"duration_ps": 0.002, "timestep_fs": 0.25, "rotor": "exact"}],
        }
    )
    system = build(scene)
    state = system.state
    images = 15.0 * np.array(list(np.ndindex(2, 2, 2)))
    for b, members in enumerate(bodies):
        own = slice(8 * b, 8 * b + 8)
        m, x, v = mass[members], position[members], velocity[members]
        centre = m @ x / m.sum()
        q = nearest_rotation((x - centre).T @ (system.species[b].positions_body * m[:, None]))
        state.position[own] = centre + images
        state.rotation[own] = q
        if not scene.molecules[b].frozen:
            state.velocity[own] = m @ v / m.sum()
            state.angular_momentum_body[own] = q.T @ np.cross(x - centre, m[:, None] * v).sum(
                axis=0
            )
    engine = system.engine()
    move(engine, state, scene.stages[0].scheme, 0.00025, 8)
    file = folder / f"fix-timestep-rigid_nve_{case}.yaml"
    found, speeds = system.site_positions(state), system.site_velocities(state)
    first = np.concatenate(
        [np.flatnonzero(system.sites.molecule == 8 * b) for b in range(len(bodies))]
    )
    order = np.concatenate([np.flatnonzero(members) for members in bodies])
    assert np.abs(found[first] - columns(file, "run_pos")[order]).max() < 1e-8
    moving = np.concatenate([np.full(members.sum(), members.sum() > 1) for members in bodies])
    assert np.abs(speeds[first] / 1000 - columns(file, "run_vel")[order])[moving].max() < 1e-8
    assert np.abs(speeds[first][~moving]).max() == 0


@pytest.fixture(scope="module")
def slit():
    """Waters between frozen ones and frozen argon: system, engine, state."""
    molecules = [
        {"model": "spce", "count": 20},
        {"model": "spce", "name": "ice", "count": 6, "frozen": True},
        {"model": "argon", "count": 5, "frozen": True},
    ]
    scene = small_scene({}, 16.0, molecules=molecules, forces={"cutoff_A": 7.9})
    return shaken(build(scene), 3, 0.2)


def test_frozen_molecules_do_not_count_and_do_not_move(slit):
    system, engine, state = slit
    assert system.freedom == (60, 60)
    state = system.state.copy()
    engine.forget()
    move(engine, state, VERLET, 0.0001, 300)
    assert (state.position[20:] == system.state.position[20:]).all()
    assert (state.rotation[20:] == system.state.rotation[20:]).all()
    assert not state.velocity[20:].any()
    assert not state.angular_momentum_body[20:].any()
    assert np.abs(state.position[:20] - system.state.position[:20]).min() > 0


def test_what_is_frozen_acts_on_others_and_not_on_itself(slit):
    system, engine, state = slit
    seen = observe(system, engine, state)
    oracle = Oracle(system)
    whole = sum(oracle.energy(state.position, state.rotation))
    among = frozen_energy(system, state, oracle.owner >= 20)
    assert among != 0
    assert seen.potential - sum(system.constants.values()) == pytest.approx(
        whole - among, rel=1e-10
    )


def frozen_energy(system, state, frozen):
    """Energy of the frozen sites among themselves, by the oracle."""
    oracle = Oracle(system)
    keep = np.flatnonzero(frozen)
    for name in ("charge", "sigma", "epsilon", "owner", "offset"):
        setattr(oracle, name, getattr(oracle, name)[keep])
    return sum(oracle.energy(state.position, state.rotation))


def test_a_run_among_frozen_molecules_keeps_its_energy(tmp_path):
    molecules = [
        {"model": "spce", "count": 20},
        {"model": "argon", "name": "wall", "count": 8, "frozen": True},
    ]
    stages = [
        {"ensemble": "nvt", "temperature_K": 300.0, "duration_ps": 1.0},
        {"duration_ps": 1.0, "timestep_fs": 0.5},
    ]
    scene = small_scene(
        {},
        16.0,
        molecules=molecules,
        forces={"cutoff_A": 7.0, "switch_start_A": 5.0},
        stages=stages,
        output={"trajectory": False},
    )
    simulation = Simulation(scene)
    results = simulation.run()
    nve = results["stage"] == 1
    assert np.ptp(results["energy"][nve]) < 2e-3 * results["kinetic"][nve].mean()
    assert results["momentum"][-1] > 1  # walls push: it is not kept, and not taken out
    assert results.summary["degrees_of_freedom"] == 120
    walls = slice(20, None)
    # overlap removal of the lattice moved only what may move
    assert (results.state.position[walls] == simulation.system.state.position[walls]).all()


def test_a_scene_in_which_nothing_would_move_is_refused():
    frozen = small_scene({}, 20.0, molecules=[{"model": "argon", "count": 3, "frozen": True}])
    for function in (Simulation, describe):  # a run, and `check`
        with pytest.raises(SceneError, match="all are frozen"):
            function(frozen)
    with pytest.raises(SceneError, match="omit it with frozen molecules"):
        small_scene(
            {},
            20.0,
            forces={"tail_correction": True},
            molecules=[
                {"model": "argon", "count": 3},
                {"model": "nitrogen", "count": 3, "frozen": True},
            ],
        )


def test_some_molecules_of_a_species_freeze_as_a_species_of_their_own_would():
    """The same molecules as one species of which some are frozen, and as two: the same bits."""
    two = [
        {"model": "spce", "count": 20},
        {"model": "spce", "name": "ice", "count": 6, "frozen": True},
    ]
    one = [{"model": "spce", "count": 26, "frozen": "21-24, 25, 26"}]
    found = []
    for molecules in (two, one):
        system, engine, state = shaken(
            build(small_scene({}, 16.0, molecules=molecules, forces={"cutoff_A": 7.9})), 3, 0.2
        )
        assert system.freedom == (60, 60)
        assert (mobile(system.model) == (np.arange(26) < 20)).all()
        assert not (state.velocity[20:].any() or state.angular_momentum_body[20:].any())
        move(engine, state, VERLET, 0.0002, 20)
        found.append((state, observe(system, engine, state)))
    (a, seen_a), (b, seen_b) = found
    for name in ("position", "rotation", "velocity", "angular_momentum_body"):
        assert (getattr(a, name) == getattr(b, name)).all()
    assert (seen_a.potential, seen_a.energy) == (seen_b.potential, seen_b.energy)
    assert [m.name for m in system.species] == ["spce", "spce"]
    assert set(system.residue_names) == {"SOL"}


def test_describe_states_which_are_frozen():
    text = describe(
        small_scene({}, 20.0, molecules=[{"model": "spce", "count": 10, "frozen": [2, 3, 7]}])
    )
    assert "  7 spce: asymmetric" in text
    assert "  3 spce: asymmetric" in text
    assert text.count("frozen") == 1
    assert "degrees of freedom: 42 = 21 translation + 21 rotation" in text


def frozen_of(scene):
    """Indices of the molecules that do not move, from 0."""
    return np.flatnonzero(~mobile(build(scene).model)).tolist()


def gro(atoms, edge=30.0):
    """(residue number, residue name, atom name, position in Å)"""
    lines = [
        f"{n:5d}{residue:<5}{name:>5}{k:5d}" + "".join(f"{c / 10:8.3f}" for c in x)
        for k, (n, residue, name, x) in enumerate(atoms, 1)
    ]
    return (
        "\n".join(
            ["t", str(len(atoms)), *lines, f"{edge / 10:.3f} {edge / 10:.3f} {edge / 10:.3f}"]
        )
        + "\n"
    )


SPOTS = 5.0 * np.array(list(np.ndindex(4, 4, 4))) + 2.0
#: Argon and krypton in turns, as the file counts residues: 7, 8, 9, 10, ...
MIXED = [(7 + k, name, name.capitalize(), SPOTS[k]) for k, name in enumerate(["AR", "KR"] * 4)]


def noble(folder, name, text, frozen, **more):
    (folder / name).write_text(text)
    molecules = [{"model": "argon", "frozen": frozen}, {"model": "krypton"}]
    return small_scene(
        {}, None, folder, molecules=molecules, box={}, structure={"file": name} | more
    )


def test_molecules_are_picked_by_their_residue_numbers(tmp_path):
    assert frozen_of(noble(tmp_path, "a.gro", gro(MIXED), [7, 11])) == [0, 4]
    assert frozen_of(noble(tmp_path, "a.gro", gro(MIXED), "8-12")) == [2, 4]  # of argon only
    assert frozen_of(noble(tmp_path, "a.gro", gro(MIXED), "7-9, 13")) == [0, 2, 6]
    with pytest.raises(
        SceneError, match=r"molecules.0.frozen: no argon has the number 8; they have 7 to 13"
    ):
        build(noble(tmp_path, "a.gro", gro(MIXED), [8]))
    twice = frozen_of(noble(tmp_path, "a.gro", gro(MIXED), [9], repeat=(1, 2, 1)))
    assert twice == [2, 10]  # in each copy of the cell
    lines = [
        f"ATOM  {k + 1:5d} {atom:<4} {name:<4}A{number:4d}    {x[0]:8.3f}{x[1]:8.3f}{x[2]:8.3f}  1.00  0.00          {atom:>2}"
        for k, (number, name, atom, x) in enumerate(MIXED)
    ]
    text = (
        "\n".join(
            [
                "CRYST1   30.000   30.000   30.000  90.00  90.00  90.00 P 1           1",
                *lines,
                "END",
            ]
        )
        + "\n"
    )
    assert frozen_of(noble(tmp_path, "a.pdb", text, [7, 11])) == [0, 4]


def test_without_residues_molecules_are_counted_within_their_species(tmp_path):
    rows = [f"{name} {x[0]} {x[1]} {x[2]}" for _, _, name, x in MIXED]
    text = "\n".join([str(len(rows)), 'Lattice="30 0 0 0 30 0 0 0 30"', *rows]) + "\n"
    assert frozen_of(noble(tmp_path, "a.xyz", text, [1, 3])) == [0, 4]
    assert frozen_of(noble(tmp_path, "a.xyz", text, "2-4")) == [2, 4, 6]
    one = [(1, "", name, x) for _, _, name, x in MIXED]  # one residue of no name around all of them
    assert frozen_of(noble(tmp_path, "b.gro", gro(one), [4])) == [6]
    lattice = [
        {"model": "argon", "count": 4, "frozen": [1, 4]},
        {"model": "krypton", "count": 3, "frozen": [2]},
    ]
    assert frozen_of(small_scene({}, 20.0, molecules=lattice)) == [0, 3, 5]


def test_all_numbers_of_a_species_are_all_of_it():
    molecules = [{"model": "argon", "count": 4, "frozen": "1-4"}, {"model": "krypton", "count": 3}]
    system = build(small_scene({}, 20.0, molecules=molecules))
    assert [m.name for m in system.species] == ["argon", "krypton"]
    assert (system.model.inverse_mass == 0).tolist() == [True, False]
    molecules[1]["frozen"] = [1, 2, 3]
    with pytest.raises(SceneError, match="all are frozen"):
        Simulation(small_scene({}, 20.0, molecules=molecules))
    with pytest.raises(SceneError, match="omit it with frozen molecules"):
        small_scene({}, 20.0, forces={"tail_correction": True}, molecules=molecules[:1])


def test_a_restart_freezes_the_same_molecules(tmp_path):
    """Though its residues were not counted from 1, and the saved state has no residues."""
    scene = noble(tmp_path, "a.gro", gro(MIXED), [7, 11])
    results = Simulation(scene, tmp_path / "out").run()
    assert results.summary["species"] == {"argon": 4, "krypton": 4}
    with np.load(tmp_path / "out" / "final.npz") as saved:
        assert saved["species_names"].tolist() == ["argon", "krypton"]
        assert saved["species"].tolist() == [0, 1] * 4
        assert saved["residue_number"].tolist() == list(range(7, 15))
        still = saved["position"][[0, 4]]
    assert [residue.resname for residue in results.universe().residues] == ["AR", "KR"] * 4
    again = Scene.read(
        tmp_path / "out" / "scene.toml",
        {
            "structure.file": str(tmp_path / "out" / "final.npz"),
            "structure.velocities": True,
            "start": None,
        },
    )
    system = build(again)
    assert frozen_of(again) == [0, 4]
    assert (system.state.position[[0, 4]] == still).all()
    assert not system.state.velocity[[0, 4]].any()
    assert system.state.velocity[[1, 2, 3]].all()


def pair_energy(system, sigma, epsilon, r):
    return 100 * 4 * epsilon * ((sigma / r) ** 12 - (sigma / r) ** 6)


@pytest.mark.parametrize("names", [("OW", "Ar"), ("spce.OW", "argon.Ar"), ("Ar", "O")])
def test_particular_pairs_have_their_own_parameters(names):
    pairs = [{"sites": names, "sigma_A": 3.0, "epsilon_kJ_mol": 2.5}]
    system, engine, state = built(
        {"spce": 1, "argon": 2}, None, 0, forces={"electrostatics": "none", "pairs": pairs}
    )
    state.position[:] = [[0, 0, 0], [4.0, 0, 0], [0, 500.0, 0]]
    oxygen = system.site_positions(state)[list(system.sites.name).index("OW")]
    seen = observe(system, engine, state)
    r = np.linalg.norm(oxygen - state.position[1])
    assert seen.potential == pytest.approx(pair_energy(system, 3.0, 2.5, r), rel=1e-7)
    state.position[2] = [4.0, 3.5, 0]  # argon and argon: as ever
    near = pair_energy(system, 3.0, 2.5, np.linalg.norm(oxygen - state.position[2]))
    own = system.species[1]
    argon = pair_energy(system, own.sigma[0], own.epsilon[0] / 100, 3.5)
    assert observe(system, engine, state).potential == pytest.approx(
        seen.potential + near + argon, rel=1e-7
    )


def test_a_pair_can_be_given_to_sites_that_have_no_well_of_their_own():
    pairs = [{"sites": ["HW1", "Ar"], "sigma_A": 2.0, "epsilon_kJ_mol": 1.0}]
    system, engine, state = built(
        {"spce": 1, "argon": 1}, None, 0, forces={"electrostatics": "none", "pairs": pairs}
    )
    plain, other, _ = built({"spce": 1, "argon": 1}, None, 0, forces={"electrostatics": "none"})
    state.position[:] = [[0, 0, 0], [3.5, 0, 0]]
    hydrogen = system.site_positions(state)[list(system.sites.name).index("HW1")]
    gain = observe(system, engine, state).potential - observe(plain, other, state).potential
    r = np.linalg.norm(hydrogen - state.position[1])
    assert gain == pytest.approx(pair_energy(system, 2.0, 1.0, r), rel=1e-9)


def test_a_pair_of_unknown_sites_is_refused():
    pairs = [{"sites": ["OW", "Xx"], "sigma_A": 2.0, "epsilon_kJ_mol": 1.0}]
    with pytest.raises(
        SceneError, match=r"forces.pairs.0.sites: no site is 'Xx'; there are spce.OW"
    ):
        build(small_scene({"spce": 2}, 20.0, forces={"pairs": pairs}))
