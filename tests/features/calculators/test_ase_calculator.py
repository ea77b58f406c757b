"""The calculator of rigidmd for ASE: energies, forces, stress, minimisation, keywords."""

import pickle
import warnings

import ase.io
import numpy as np
import pytest
from ase import Atoms, units
from ase.build import molecule
from ase.calculators import acn, tip3p, tip4p
from ase.calculators.fd import calculate_numerical_forces
from ase.constraints import FixBondLengths
from ase.md.velocitydistribution import thermalize_momenta
from ase.md.verlet import VelocityVerlet
from support.ase_atoms import FORCES
from support.ase_models import SAME_COULOMB, ase_sites
from support.common import ROOT, small_scene

import rigidmd
from rigidmd import BodyScene, MolecularScene, Scene, Simulation
from rigidmd.assemble.build import build
from rigidmd.errors import RigidMDWarning, SceneError, StructureError
from rigidmd.features.calculators.calculator import TABLES, WITHOUT_ENERGIES, RigidMD
from rigidmd.formats.through_ase import EV
from rigidmd.mechanics.rotation import random_rotations
from rigidmd.run.atom_forces import _transfer_matrices
from rigidmd.scene.models import load_model
from rigidmd.units import FEMTOSECOND, KJ_PER_MOL


def cluster(model: str, n: int, seed: int = 1) -> Atoms:
    """Molecules without a box, far enough from each other."""
    return rigidmd.to_atoms(small_scene({model: n}, None, seed=seed))


def test_energies_do_not_depend_on_the_atoms_before():
    """Two ends of a molecule exchange positions, which the earlier assignment of atoms fits within the
    tolerance."""
    angle, charges = np.radians(124.0), (0.2, -0.3, 0.1)
    x = np.array(
        [(1.54, 0.0, 0.0), (0.0, 0.0, 0.0), (1.33 * np.cos(angle), 1.33 * np.sin(angle), 0.0)]
    )
    sites = [
        {
            "name": name,
            "element": "C",
            "mass_u": mass,
            "position_A": at,
            "charge_e": q,
            "sigma_A": 3.7,
            "epsilon_K": 90.0,
        }
        for name, mass, at, q in zip(
            ("A", "B", "C"), (15.0, 13.0, 14.0), x.tolist(), charges, strict=True
        )
    ]
    pair = ase.Atoms("C6", [*x, *(x @ [[0, 1, 0], [0, 0, 1], [1, 0, 0]] + [0.0, 3.0, 4.5])])
    exchanged = pair[[2, 1, 0, 5, 4, 3]]
    calc = RigidMD([{"name": "propene", "sites": sites}])
    energy = calc.get_potential_energy(pair)
    forces = calc.get_forces(pair)
    assert calc.get_potential_energy(exchanged) == pytest.approx(energy, rel=1e-9)
    assert calc.get_forces(exchanged) == pytest.approx(forces[[2, 1, 0, 5, 4, 3]], abs=1e-9)
    bent = pair.copy()  # continuously
    for _ in range(4):
        bent.positions[0, 2] += 0.02
        calc.get_potential_energy(bent)
    assert calc.get_potential_energy(bent) == RigidMD(
        [{"name": "propene", "sites": sites}]
    ).get_potential_energy(bent)


def test_two_models_that_fit_are_not_chosen_from():
    with pytest.raises(StructureError, match="may be spce or tip3p: give them residue_names"):
        build(rigidmd.scene_from_atoms(molecule("H2O"), ["spce", "tip3p"]))


def test_frames_of_a_run(results):
    atoms, frames = results.atoms(), results.atoms(":")
    assert [frame.info["time_ps"] for frame in frames] == pytest.approx([0.0, 0.02, 0.04, 0.06])
    assert len(results.atoms(slice(1, 3))) == len(results.atoms("1:3")) == 2
    assert (
        results.atoms("-2").info["time_ps"]
        == results.atoms(2).info["time_ps"]
        == frames[2].info["time_ps"]
    )
    for frame, energy in zip(frames, results["potential"], strict=True):
        assert frame.get_potential_energy() * EV / KJ_PER_MOL == pytest.approx(energy, rel=1e-12)
    assert (results.atoms(-1).positions == atoms.positions).all()
    kinetic = atoms.get_kinetic_energy() * EV / KJ_PER_MOL
    assert kinetic == pytest.approx(
        results["kinetic"][-1], rel=2e-8
    )  # ASE's u and eV are of CODATA 2014
    state, model = results.state, results.system.model
    mass = model.mass[model.species]
    squares = mass @ (state.velocity**2).sum(axis=1)
    # the log's kinetic energy of constant energy has no time-step error
    force = results.system.engine().evaluate(state)[0].force
    dt = results.system.scene.stages[-1].timestep_fs * FEMTOSECOND
    squares += dt**2 / 6 * ((force**2).sum(axis=1) / mass).sum()
    ideal = squares / (3 * state.volume)
    # the log's pressure contains the total momentum, which is zero
    ideal *= len(model.species) / (len(model.species) - 1)
    pressure = (ideal / EV - atoms.get_stress()[:3].mean()) / units.bar
    assert pressure == pytest.approx(results["pressure"][-1], rel=1e-7)
    with pytest.raises(IndexError, match="frame 4 is out of range: this run has 4"):
        results.atoms(4)
    for wrong in (1.5, "first", "1:2:3:4", "::0", ""):
        with pytest.raises(ValueError, match="must be a number, a slice or a text"):
            results.atoms(wrong)
    body = Simulation(Scene.read(ROOT / "systems" / "dropped_stone.toml")).run()
    assert isinstance(body.system.scene, BodyScene)
    with pytest.raises(ValueError, match="a single body, which has no atoms"):
        body.atoms()


def held_rigid(n: int) -> FixBondLengths:
    """All distances within n waters."""
    return FixBondLengths(
        [(3 * m + i, 3 * m + j) for m in range(n) for i, j in ((0, 1), (0, 2), (1, 2))]
    )


@pytest.mark.parametrize(("model", "theirs"), [("tip3p", tip3p.TIP3P), ("tip4p", tip4p.TIP4P)])
def test_energies_and_forces_are_those_of_ase(model, theirs):
    """Without a box and cutoff: to rounding with ASE's constants, to the difference of constants
    with ours."""
    atoms = cluster(model, 6)
    other = atoms.copy()
    other.calc = theirs(rc=1e4)
    for entry, energy, force in ((ase_sites(model), 1e-12, 1e-11), (model, 5e-3, 1e-4)):
        atoms.set_constraint()
        other.set_constraint()
        atoms.calc = RigidMD([entry], atom_forces="sites")
        scale = np.abs(other.get_forces()).max()
        assert atoms.get_potential_energy() == pytest.approx(
            other.get_potential_energy(), rel=energy
        )
        if (
            model == "tip3p"
        ):  # the forces of each atom; ASE spreads those of M in another way with the same totals
            assert np.abs(atoms.get_forces() - other.get_forces()).max() < force * scale
        by_molecule = (atoms.get_forces() - other.get_forces()).reshape(6, 3, 3).sum(axis=1)
        assert np.abs(by_molecule).max() < force * scale
        atoms.set_constraint(held_rigid(6))
        other.set_constraint(held_rigid(6))
        close = max(force * scale, 1e-12)  # that of FixBondLengths itself
        assert np.abs(atoms.get_forces() - other.get_forces()).max() < close
        rigid = atoms.copy()
        rigid.set_constraint()
        rigid.calc = RigidMD([entry])
        assert np.abs(rigid.get_forces() - other.get_forces()).max() < close


def test_forces_are_the_gradient_of_the_energy():
    """For rigid and of bent molecules; they add up to the load on each molecule, in both forms."""
    atoms = cluster("tip4p", 4)
    rng = np.random.default_rng(4)
    for bend in (0.0, 0.02):
        atoms.positions += bend * rng.standard_normal(atoms.positions.shape)
        atoms.calc = RigidMD("tip4p", bend=0.14)
        numerical = calculate_numerical_forces(atoms, eps=1e-3)
        assert np.abs(atoms.get_forces() - numerical).max() < 1e-5 * np.abs(numerical).max()


@pytest.mark.parametrize("model", ["tip4p", "tip5p"])
def test_both_forms_have_the_force_and_torque_of_each_molecule(model):
    atoms = cluster(model, 4)
    for form in ("gradient", "sites"):
        atoms.calc = RigidMD(model, atom_forces=form)
        forces = atoms.get_forces() * EV
        placed = atoms.calc._fit_atoms(atoms)
        load, _ = placed.assembly.engine.evaluate(placed.state)
        torque = np.einsum("nij,nj->ni", placed.state.rotation, load.torque_body)
        arm = atoms.positions.reshape(4, 3, 3) - placed.state.position[:, None]
        assert (
            np.abs(forces.reshape(4, 3, 3).sum(axis=1) - load.force).max()
            < 1e-12 * np.abs(load.force).max()
        )
        found = np.cross(arm, forces.reshape(4, 3, 3)).sum(axis=1)
        assert np.abs(found - torque).max() < 1e-12 * np.abs(torque).max()


@pytest.mark.parametrize("model", ["tip4p", "tip5p", "nitrogen_trappe", "opc"])
def test_a_force_on_a_massless_site_is_spread_with_its_torque(model):
    found = load_model(model)
    heavy = found.positions_body[found.masses > 0]
    force = np.array([0.3, -1.1, 0.7])
    for site in np.flatnonzero(found.masses == 0):
        spread = _transfer_matrices(found, int(site)) @ force
        assert spread.sum(axis=0) == pytest.approx(force, abs=1e-12)
        torque = np.cross(found.positions_body[site], force)
        assert np.cross(heavy, spread).sum(axis=0) == pytest.approx(torque, abs=1e-12)
    if model == "tip4p":  # M is 0.15 Å from O along the bisector, H 0.5859 Å
        share = 0.15 / 0.585882276618295 / 2
        assert _transfer_matrices(found, 3)[:, 0, 0] == pytest.approx(
            [1 - 2 * share, share, share], abs=1e-12
        )


def strained(atoms: Atoms, strain: np.ndarray) -> float:
    """The energy after a strain (3, 3) that moves centres of mass and rotates nothing."""
    placed = atoms.calc._fit_atoms(atoms)
    system, other = placed.assembly.system, atoms.copy()
    owner = system.sites.molecule[system.sites.mass > 0]
    centre = placed.state.position @ placed.rotation
    other.set_cell(atoms.cell.array @ (np.eye(3) + strain))
    other.positions[placed.assembly.order] = (
        placed.atoms @ placed.rotation + (centre @ strain)[owner]
    )
    other.calc = atoms.calc
    return other.get_potential_energy()


def check_stress(atoms: Atoms) -> None:
    """The stress against differences of the energy."""
    found, step = atoms.get_stress(voigt=False), 1e-4
    for i, j in ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1)):
        strain = np.zeros((3, 3))
        strain[i, j] += step / 2
        strain[j, i] += step / 2
        slope = (
            (strained(atoms, strain) - strained(atoms, -strain)) / (2 * step) / atoms.get_volume()
        )
        assert found[i, j] == pytest.approx(slope, abs=1e-5 * np.abs(found).max())


def turned(atoms: Atoms) -> Atoms:
    """The same, rotated in space, in a triclinic left-handed cell of the same lattice."""
    found, turn = atoms.copy(), random_rotations(np.random.default_rng(3), 1)[0]
    a, b, c = atoms.cell.array
    found.set_cell(np.array([a, b + a, -c]) @ turn.T)
    found.positions = atoms.positions @ turn.T
    found.wrap()
    return found


def test_stress_and_any_cell(waters):
    settings = FORCES
    waters = waters.copy()
    waters.calc = RigidMD(["spce"], **settings)
    exact = waters.get_stress(voigt=False)
    check_stress(waters)
    other = turned(waters)
    other.calc = RigidMD(["spce"], **settings)
    turn = random_rotations(np.random.default_rng(3), 1)[0]
    assert other.get_potential_energy() == pytest.approx(waters.get_potential_energy(), rel=1e-12)
    assert np.abs(other.get_forces() - waters.get_forces() @ turn.T).max() < 1e-11
    assert np.abs(other.get_stress(voigt=False) - turn @ exact @ turn.T).max() < 1e-13
    check_stress(other)


def test_rigid_molecules_are_minimised(waters):
    atoms = cluster("tip4p", 4)
    atoms.calc = RigidMD("tip4p")
    before = atoms.get_potential_energy()
    found = atoms.calc.minimise(atoms, force_limit_kJ_mol_A=1e-3, torque_limit_kJ_mol=1e-3)
    assert found["converged"]
    assert atoms.get_potential_energy() < before - 0.5
    assert np.abs(atoms.get_forces()).max() < 1e-4
    assert atoms.calc.make_rigid(atoms) < 1e-12
    with pytest.raises(
        SceneError, match=r"stages\.0\.force_limit_kJ_mol_A: is -1, must be greater than 0"
    ):
        atoms.calc.minimise(atoms, force_limit_kJ_mol_A=-1)
    with pytest.warns(RigidMDWarning, match="has not converged after 1 iterations"):
        cold = cluster("tip4p", 4)
        RigidMD("tip4p").minimise(cold, max_iterations=1)
    boxed = turned(waters)
    boxed.set_momenta(np.zeros((120, 3)))
    boxed.calc = RigidMD("spce", cutoff_A=4.0, truncation="smooth_switch")
    before = boxed.get_positions()
    volume, distances = boxed.get_volume(), boxed.get_all_distances(mic=True)
    with pytest.warns(RigidMDWarning, match="has not converged"):
        boxed.calc.minimise(boxed, pressure_bar=1000.0, max_iterations=8)
    assert boxed.get_volume() != volume
    moved = boxed.get_all_distances(mic=True)
    assert (
        np.abs(boxed.positions - before).max() < 2.0
    )  # each atom stays in its image, across the faces of the box
    within = np.kron(np.eye(40), np.ones((3, 3))) > 0
    assert np.abs(moved - distances)[within].max() < 1e-10
    assert np.abs(moved - distances).max() > 0.1


def test_bent_molecules_are_reported_once():
    atoms = molecule("H2O")
    atoms.calc = RigidMD("spce")
    with pytest.warns(
        RigidMDWarning, match=r"an atom is 0\.056 Å from its position in a rigid molecule, 6% of"
    ):
        atoms.get_potential_energy()
    atoms.rattle(0.001)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        atoms.get_potential_energy()
        assert 0.04 < atoms.calc.make_rigid(atoms) < 0.07
        assert atoms.get_distance(0, 1) == pytest.approx(1.0, abs=1e-12)
        fresh = RigidMD("spce")
        fresh.get_potential_energy(atoms)
    atoms.positions[1] += 0.3
    with pytest.raises(
        StructureError, match=r"is not spce(.|\n)*They matched before: keep the molecules rigid"
    ):
        atoms.get_potential_energy()
    atoms.positions[1] -= 0.3
    assert atoms.get_potential_energy() == pytest.approx(0.0, abs=1e-12)


def test_a_calculator_serves_other_atoms(waters):
    calc = RigidMD("spce", cutoff_A=4.0, truncation="smooth_switch")
    pair = cluster("spce", 2)
    first = calc.get_potential_energy(pair)
    calc.get_potential_energy(waters)
    assert calc.get_potential_energy(pair) == pytest.approx(first, rel=1e-12)
    copied = pickle.loads(pickle.dumps(calc))
    assert copied.get_potential_energy(pair.copy()) == pytest.approx(first, rel=1e-12)
    assert "stress" not in calc.results
    larger = waters.copy()
    larger.set_cell(waters.cell.array * 1.5, scale_atoms=False)
    assert calc.get_potential_energy(larger) == pytest.approx(
        RigidMD("spce", cutoff_A=4.0, truncation="smooth_switch").get_potential_energy(larger),
        rel=1e-12,
    )


def test_a_calculator_of_sites_that_share_names(waters):
    sites = [site | {"name": site["element"]} for site in load_model("spce").sites()]
    for atoms in (waters, waters[::-1]):
        energies = [
            RigidMD(models, **FORCES).get_potential_energy(atoms)
            for models in ("spce", [{"name": "w", "sites": sites}])
        ]
        assert energies[1] == pytest.approx(energies[0], rel=1e-12)


def test_a_scene_may_be_the_calculator(results, waters):
    atoms = waters.copy()
    atoms.calc = RigidMD(results.system.scene)
    assert atoms.get_potential_energy() == pytest.approx(waters.get_potential_energy(), rel=1e-12)
    with pytest.raises(SceneError, match="set by the scene"):
        RigidMD(results.system.scene, cutoff_A=5.0)
    with pytest.raises(SceneError, match="is of a single body"):
        RigidMD(Scene.read(ROOT / "systems" / "heavy_top_1.toml"))


@pytest.mark.parametrize("value", [0.0, 0.3, 0.7, 1.0])
def test_a_calculator_scales_the_species_of_coupling(value):
    molecules = [{"model": "spce", "count": 12}, {"model": "argon", "name": "solute", "count": 1}]
    scene = small_scene(
        {},
        15.0,
        molecules=molecules,
        forces={"cutoff_A": 6.0, "electrostatics": "pme"},
        coupling={"species": "solute", "lambda": value},
    )
    simulation = Simulation(scene)
    atoms = simulation.atoms()
    atoms.calc = RigidMD(scene)
    energy = atoms.get_potential_energy() * EV / KJ_PER_MOL
    assert energy == pytest.approx(simulation.observation.potential, rel=1e-6)


def test_every_table_of_a_scene_is_used_by_a_calculator_or_has_no_energy():
    assert {*TABLES, *WITHOUT_ENERGIES} == {*MolecularScene.model_fields}


@pytest.mark.parametrize(
    ("keywords", "said"),
    [
        ({"cutof_A": 5.0}, r"unknown keyword cutof_A; did you mean cutoff_A\?"),
        ({"atom_forces": "all"}, "must be 'gradient' or 'sites'"),
        ({"bend": 0.5}, "must be 0 < bend <= tolerance < 1"),
    ],
)
def test_keywords_of_a_calculator_are_checked(keywords, said):
    with pytest.raises(SceneError, match=said):
        RigidMD("spce", **keywords)


def test_ase_moves_what_it_holds_rigid():
    """ASE's dynamics with ASE's constraints conserves the energy."""
    atoms = cluster("tip4p", 4)
    atoms.calc = RigidMD("tip4p")
    atoms.calc.minimise(atoms)
    atoms.set_constraint(held_rigid(4))
    thermalize_momenta(atoms, temperature_K=100, rng=np.random.default_rng(1))
    dynamics, energies = VelocityVerlet(atoms, 0.5 * units.fs), []
    dynamics.attach(lambda: energies.append(atoms.get_total_energy()))
    dynamics.run(20)
    assert np.ptp(energies) < 1e-3 * atoms.get_kinetic_energy()
    assert atoms.calc._fit_atoms(atoms).bent < 1e-10


@pytest.mark.soak
def test_acetonitrile_is_that_of_ase():
    sites = [
        {
            "name": name,
            "element": element,
            "mass_u": float(mass),
            "position_A": [x, 0.0, 0.0],
            "charge_e": charge * SAME_COULOMB,
            "sigma_A": sigma,
            "epsilon_kJ_mol": float(epsilon * EV / KJ_PER_MOL),
        }
        for name, element, mass, x, charge, sigma, epsilon in (
            ("Me", "C", acn.m_me, 0.0, acn.q_me, acn.sigma_me, acn.epsilon_me),
            ("C", "C", acn.m_c, acn.r_mec, acn.q_c, acn.sigma_c, acn.epsilon_c),
            ("N", "N", acn.m_n, acn.r_men, acn.q_n, acn.sigma_n, acn.epsilon_n),
        )
    ]
    data = {
        "molecules": [{"name": "acn", "sites": sites, "count": 4}],
        "box": {"lengths_A": 12.0, "periodic": False},
    }
    atoms = rigidmd.to_atoms(Scene.from_dict(data | {"stages": [{"ensemble": "minimise"}]}))
    other = atoms.copy()
    other.calc = acn.ACN(rc=1e4)
    atoms.calc = RigidMD([{"name": "acn", "sites": sites}], atom_forces="sites")
    assert atoms.get_potential_energy() == pytest.approx(other.get_potential_energy(), rel=1e-12)


@pytest.mark.soak
def test_pme_in_a_triclinic_cell():
    counts = {"spce": 12, "nitrogen": 4, "argon": 3}
    box = {"lengths_A": [11.0, 12.0, 13.0], "angles_deg": [80.0, 100.0, 75.0]}
    atoms = turned(rigidmd.to_atoms(small_scene(counts, None, box=box, forces={"cutoff_A": 4.5})))
    keywords = {
        "cutoff_A": 4.5,
        "electrostatics": "pme",
        "truncation": "shift",
        "ewald_accuracy": 1e-6,
    }
    atoms.calc = RigidMD(list(counts), **keywords)
    check_stress(atoms)
    chosen = [0, 1, 2, 40, 44, 46]
    numerical = calculate_numerical_forces(atoms, eps=1e-3, iatoms=chosen)
    forces = atoms.get_forces()
    assert np.abs(forces[chosen] - numerical).max() < 1e-5 * np.abs(forces).max()
    plain = atoms.copy()
    plain.calc = RigidMD(
        list(counts),
        atom_forces="sites",
        **keywords | {"electrostatics": "ewald", "ewald_accuracy": 1e-8},
    )
    atoms.calc = RigidMD(list(counts), atom_forces="sites", **keywords)
    assert np.abs(plain.get_forces() - atoms.get_forces()).max() < 1e-3 * np.abs(forces).max()
