"""Normal modes: closed forms, sums over a lattice, differences of an energy in NumPy, counts of
modes, what is rejected."""

import csv

import numpy as np
import pytest
import scipy.constants as si
from scipy.differentiate import hessian
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from support.common import ROOT, SPRING, shaken, small_scene

import rigidmd
from rigidmd.assemble.build import build
from rigidmd.commands.cli import main
from rigidmd.core.state import state_of
from rigidmd.errors import SceneError, SimulationError
from rigidmd.features.studies import normal_modes
from rigidmd.features.studies.gamma_point import periodic_basis
from rigidmd.io.trajectory import read_frames
from rigidmd.run.record import read_record
from rigidmd.run.stable_step import stiffest_mode
from rigidmd.scene.models import load_model
from rigidmd.units import COULOMB, KJ_PER_MOL

DIMER = ROOT / "systems" / "water_dimer.toml"
ARGON = load_model("argon")
SIGMA, WELL = float(ARGON.sigma[0]), float(ARGON.epsilon[0])
#: Curvature of the Lennard-Jones potential at its minimum, 72 / 2^(1/3) epsilon/sigma² = 57.146 of
#: them.
CURVATURE = 72 / 2 ** (1 / 3)
MIXTURE = {"argon": 3, "nitrogen": 3, "spce": 4}


def modes_from(scene, state=None, **options):
    simulation = rigidmd.Simulation(scene)
    if state is not None:
        simulation.start_from(state)
    return rigidmd.normal_modes(simulation, **options)


@pytest.fixture(scope="module")
def dimer():
    return rigidmd.normal_modes(rigidmd.Scene.read(DIMER))


@pytest.fixture(scope="module")
def mixture():
    """Points, linear and asymmetric molecules in a periodic box."""
    scene = small_scene(MIXTURE, 10.0, forces={"cutoff_A": 4.9, "truncation": "smooth_switch"})
    return modes_from(scene, shaken(build(scene), 3, spread=0.1)[2])


def test_two_points():
    scene = small_scene({"argon": 2}, None)
    modes = modes_from(scene, state_of(np.array([[0.0, 0, 0], [1.1 * SIGMA, 0.3, 0.1]])))
    assert modes.number.tolist() == [1, 2, 3, 4, 5, 6]
    assert (modes.rate[:5] == 0).all()
    w = np.sqrt(CURVATURE * WELL / SIGMA**2 / (ARGON.mass / 2))
    assert modes.rate[5] == pytest.approx(w, rel=1e-8)
    assert modes.wavenumber[5] == pytest.approx(w * 1e12 / (2 * np.pi * si.c * 100), rel=1e-8)
    assert modes.longest_step_fs == pytest.approx(2000 / w, rel=1e-8)
    assert modes.energy == pytest.approx(-WELL / KJ_PER_MOL, rel=1e-12)
    assert modes.kind(5) == "translation"
    assert modes.weight[5] == pytest.approx([0.5, 0.5])
    assert modes.intensity[5] == 0


def test_a_dipole_in_a_field():
    """w² = mu E/I about the two axes across the dipole; rotation about it is free."""
    scene = small_scene({"spce": 1}, None, fields={"electric_V_per_nm": [0.3, -0.2, 0.6]})
    modes, water = rigidmd.normal_modes(scene), load_model("spce")
    dipole = np.abs(water.charges @ water.positions_body)
    along = int(dipole.argmax())
    across = sorted(water.inertia[k] for k in range(3) if k != along)[::-1]  # ascending w
    field = np.linalg.norm([0.3, -0.2, 0.6]) * si.e * si.N_A * 1e-2  # u Å/ps² on a charge e
    assert (modes.rate[:4] == 0).all()
    assert modes.rate[4:] ** 2 == pytest.approx(
        [dipole[along] * field / i for i in across], rel=1e-8
    )
    assert modes.translation[4:] == pytest.approx([0, 0], abs=1e-12)
    # infrared: N_A/(12 epsilon_0 c²) |dM/dq|², and |dM/dq|² is mu²/I
    unit = si.N_A * si.e**2 / (12 * si.epsilon_0 * si.c**2 * si.atomic_mass) / 1000
    assert modes.intensity[4:] == pytest.approx(
        [unit * dipole[along] ** 2 / i for i in across], rel=1e-6
    )


def test_a_crystal_of_argon_is_that_of_lattice_dynamics():
    """All w² of 108 atoms, from dynamical matrices at the 27 wave vectors that the box admits, in
    NumPy."""
    a, cutoff, cells = 5.31, 7.5, 3
    basis = a / 2 * np.array([[0, 0, 0], [0, 1, 1], [1, 0, 1], [1, 1, 0]])
    corners = a * np.array(list(np.ndindex(cells, cells, cells)))
    scene = small_scene(
        {"argon": 4 * cells**3}, cells * a, forces={"cutoff_A": cutoff, "truncation": "plain"}
    )
    state = state_of((corners[:, None] + basis).reshape(-1, 3), cell=cells * a * np.eye(3))
    found = modes_from(scene, state)

    steps = a / 2 * np.array([s for s in np.ndindex(9, 9, 9) if sum(s) % 2 == 0], float) - 2 * a
    r = np.linalg.norm(steps, axis=1)
    steps, r = steps[(r > 0) & (r < cutoff)], r[(r > 0) & (r < cutoff)]
    slope = 24 * WELL * (SIGMA**6 / r**7 - 2 * SIGMA**12 / r**13)
    second = 24 * WELL * (26 * SIGMA**12 / r**14 - 7 * SIGMA**6 / r**8)
    unit = steps / r[:, None]
    along = np.einsum("ni,nj->nij", unit, unit)
    constants = second[:, None, None] * along + (slope / r)[:, None, None] * (np.eye(3) - along)
    square = []
    for n in np.ndindex(cells, cells, cells):
        # the four wave vectors of the primitive lattice that are n/cells in the cubic one
        for extra in ([0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]):
            k = 2 * np.pi / a * (np.array(n) / cells + extra)
            square.extend(
                np.linalg.eigvalsh(np.einsum("n,nij->ij", 1 - np.cos(steps @ k), constants))
                / ARGON.mass
            )
    square = np.sort(square)
    assert np.abs(found.rate**2 - square).max() < 1e-7 * square[-1]
    assert (found.rate == 0).sum() == 3
    assert found.error[-1] < 1e-6 * found.wavenumber[-1]


def test_forces_that_jump_at_the_minimum_are_refused():
    """A shell of neighbours at the cutoff, less than a displacement inside. Its Hessian is
    symmetric, and wrong."""
    a = 5.31
    corners = a * np.array(list(np.ndindex(3, 3, 3)))
    basis = a / 2 * np.array([[0, 0, 0], [0, 1, 1], [1, 0, 1], [1, 1, 0]])
    state = state_of((corners[:, None] + basis).reshape(-1, 3), cell=3 * a * np.eye(3))
    scene = small_scene(
        {"argon": 108},
        3 * a,
        forces={"cutoff_A": a * np.sqrt(2) * (1 + 1e-8), "truncation": "shift"},
    )
    with pytest.raises(
        SimulationError, match=r"forces are not smooth.*truncation = 'smooth_switch'"
    ):
        modes_from(scene, state, minimise=False)


def dimer_energy(state):
    """Energy (u Å²/ps²) of two SPC/E waters displaced by moves (12, ...): shifts and rotation
    vectors, in NumPy."""
    water = load_model("spce")

    def energy(moves):
        moves, total = np.asarray(moves), 0.0
        sites = []
        for m in range(2):
            rotation = Rotation.from_rotvec(
                moves[6 + 3 * m : 9 + 3 * m].reshape(3, -1).T
            ).as_matrix()
            at = np.einsum("ij,njk,sk->nsi", state.rotation[m], rotation, water.positions_body)
            sites.append(
                at + state.position[m] + moves[3 * m : 3 * m + 3].reshape(3, -1).T[:, None]
            )
        for i, one in enumerate(np.moveaxis(sites[0], 1, 0)):
            for j, other in enumerate(np.moveaxis(sites[1], 1, 0)):
                r = np.linalg.norm(one - other, axis=1)
                total = total + COULOMB * water.charges[i] * water.charges[j] / r
                if water.epsilon[i] * water.epsilon[j] > 0:
                    total = total + 4 * water.epsilon[i] * (
                        (water.sigma[i] / r) ** 12 - (water.sigma[i] / r) ** 6
                    )
        return total.reshape(moves.shape[1:])

    return energy, np.concatenate([np.repeat([water.mass] * 2, 3), np.tile(water.inertia, 2)])


def test_the_water_dimer_is_that_of_differences_of_its_energy(dimer):
    energy, masses = dimer_energy(dimer.coordinates.state)
    assert energy(np.zeros(12)) / KJ_PER_MOL == pytest.approx(dimer.energy, rel=1e-12)
    second = hessian(energy, np.zeros(12), initial_step=0.05).ddf / np.sqrt(
        np.outer(masses, masses)
    )
    square = np.linalg.eigvalsh((second + second.T) / 2)
    assert np.abs(dimer.rate**2 - square).max() < 1e-6 * square[-1]
    assert (dimer.rate == 0).sum() == 6
    # the modes are its eigenvectors
    assert (
        np.abs(dimer.vector @ second - (dimer.rate**2)[:, None] * dimer.vector).max()
        < 1e-5 * square[-1]
    )


def test_thermodynamics_of_the_dimer(dimer):
    vibrations = dimer.wavenumber[dimer.rate > 0]
    zero_point = si.h * si.c * 100 * vibrations.sum() / 2 * si.N_A / 1000
    assert dimer.free_energy(0) == pytest.approx(zero_point, rel=1e-9)
    partition = 1.0
    for w in dimer.rate[dimer.rate > 0] * 1e12:
        levels = si.hbar * w * (np.arange(4000) + 0.5) / (si.k * 300)
        partition *= np.exp(-levels).sum()
    assert dimer.free_energy(300) == pytest.approx(-si.R * 300 * np.log(partition) / 1000, rel=1e-9)
    assert dimer.free_energy(1e6, quantum=False) == pytest.approx(dimer.free_energy(1e6), rel=1e-6)
    assert dimer.temperature == 20


def test_numbers_of_modes_of_a_mixture(mixture):
    total = 3 * 3 + 5 * 3 + 6 * 4
    assert len(mixture.rate) == total
    assert (mixture.rate == 0).sum() == 3
    assert (mixture.rate[3:] > 0).all()
    uniform = (mixture.vector[:3] * mixture.coordinates.scale)[:, :30].reshape(3, 10, 3)  # shifts
    assert np.ptp(uniform, axis=1).max() < 1e-7
    assert mixture.translation.sum() == pytest.approx(3 * 10)
    assert mixture.weight.sum(axis=1) == pytest.approx(np.ones(total))
    assert mixture.weight.sum(axis=0) == pytest.approx([3] * 3 + [5] * 3 + [6] * 4)
    assert np.abs(mixture.vector @ mixture.vector.T - np.eye(total)).max() < 1e-12
    assert mixture.error[3:].max() < 1e-4 * mixture.wavenumber[3]
    assert max(mixture.force, mixture.torque) < 1e-8


def test_the_highest_is_the_stiffest_motion(mixture):
    """Of the estimate of the longest stable step, 16 directions of a Krylov space."""
    found = stiffest_mode(mixture.system, mixture.coordinates.state)
    assert found.rate == pytest.approx(mixture.rate[-1], rel=0.01)
    assert found.molecule == mixture.weight[-1].argmax()


def test_lanczos_has_the_modes_of_the_complete_spectrum(mixture):
    state = mixture.coordinates.state
    some = modes_from(mixture.system.scene, state, count=6)
    assert some.number.tolist() == [*range(1, 10), *range(43, 49)]
    whole = mixture.wavenumber[some.number - 1]
    assert np.abs(some.wavenumber - whole)[3:] == pytest.approx(0, abs=5e-6)
    assert (
        np.abs(some.wavenumber - whole)[3:] <= some.error[3:] + mixture.error[some.number - 1][3:]
    ).all()
    assert np.abs((some.vector * mixture.vector[some.number - 1]).sum(axis=1))[3:] == pytest.approx(
        1, abs=1e-6
    )
    with pytest.raises(ValueError, match="leave out count"):
        some.free_energy(300)


def test_frozen_molecules_have_no_modes():
    molecules = [
        {"model": "spce", "count": 3},
        {"model": "spce", "name": "ice", "count": 3, "frozen": True},
    ]
    scene = small_scene({}, 13.0, molecules=molecules, forces={"cutoff_A": 6.0})
    modes = modes_from(scene, shaken(build(scene), 3, 0.1)[2])
    assert len(modes.rate) == 18
    assert (modes.rate > 0).all()
    assert not modes.weight[:, 3:].any()


def test_the_longest_step_is_the_limit():
    """Atoms on springs, which velocity Verlet follows at a step of 0.98 times 2/w, and not at one
    of 1.02 times."""
    unwatched = {key: False for key in ("energy", "kick", "move", "stable_step")}

    def scene(step: float):
        stage = {"ensemble": "nve", "timestep_fs": step, "duration_ps": 0.04 * step}
        return small_scene(
            {"argon": 8},
            80.0,
            forces={"cutoff_A": 8.0},
            stages=[stage],
            watch=unwatched,
            fields={"restraints": [{"stiffness_kJ_mol_A2": SPRING / 100}]},
            output={"log_interval_ps": 1e-3 * step},
        )

    modes = rigidmd.normal_modes(scene(1.0))
    assert modes.rate == pytest.approx(np.full(24, np.sqrt(SPRING / ARGON.mass)), rel=1e-7)
    below, above = (
        rigidmd.Simulation(scene(part * modes.longest_step_fs)).run()["kinetic"]
        for part in (0.98, 1.02)
    )
    assert len(below) == len(above) == 41
    assert below.max() < 100 * below[0]
    assert above[-1] > 1e9 * above[0]


def test_what_is_not_a_minimum_is_refused(mixture):
    scene = rigidmd.Scene.read(DIMER)
    assert rigidmd.normal_modes(scene, minimise=False).rate[-1] > 0  # its file has a minimum
    state = mixture.coordinates.state.copy()
    state.position[0] += 0.05
    with pytest.raises(
        SimulationError,
        match=r"largest force is \d.*largest torque \d.*leave out --no-minimise, or begin",
    ):
        modes_from(mixture.system.scene, state, minimise=False)
    with pytest.raises(SimulationError, match="no force holds these molecules"):
        rigidmd.normal_modes(small_scene({"spce": 1}, None))
    with pytest.raises(SceneError, match="this is a single body"):
        rigidmd.normal_modes(rigidmd.Scene.read(ROOT / "systems" / "heavy_top_1.toml"))


def test_unstable_modes_are_negative():
    """Three atoms in a row: they bend, with w² = -3 V'(2r)/(r m) where the force V'(r) + V'(2r) is
    zero."""
    scene = small_scene({"argon": 3}, None)
    modes = modes_from(scene, state_of(np.array([[0.0, 0, 0], [3.8, 0, 0], [7.6, 0, 0]])))

    def slope(r):
        return 24 * WELL * (SIGMA**6 / r**7 - 2 * SIGMA**12 / r**13)

    r = brentq(lambda r: slope(r) + slope(2 * r), 3.6, 4.0)
    assert modes.rate[:2] == pytest.approx(
        np.full(2, -np.sqrt(3 * slope(2 * r) / r / ARGON.mass)), rel=1e-6
    )
    assert (modes.rate[2:7] == 0).all() and (modes.rate[7:] > 0).all()
    assert modes.free_energy(0) == pytest.approx(
        si.N_A * si.hbar * modes.rate[7:].sum() * 1e12 / 2000
    )


@pytest.mark.usefixtures("reads_here")
def test_the_command_writes_a_table_and_an_animation(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["modes", str(DIMER), "--animate", "12"]) == 0
    text = capsys.readouterr().out
    for words in (
        "6 zero modes, 0 unstable",
        "zero-point energy of the rigid model 10.82",
        "set by mode 12: libration of 1.11 molecules",
    ):
        assert words in text
    folder = tmp_path / "runs" / "water_dimer-modes"
    with (folder / "modes.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["mode"] for row in rows] == [str(k) for k in range(1, 13)]
    assert float(rows[-1]["wavenumber (cm^-1)"]) == pytest.approx(703.2, abs=0.1)
    record = read_record(folder)
    period = 1 / float(rows[-1]["frequency (1/ps)"])
    assert record.time[-1] == pytest.approx(2 * period, rel=1e-6)
    frames = read_frames(record.trajectory, 6, 1000)
    shift = np.linalg.norm(
        frames.positions - frames.positions[12], axis=2
    )  # a quarter of a period: the minimum
    assert 0.2 < shift.max() < 0.6
    assert shift[[36, 60, 84]].max() < 0.02
    assert np.abs(frames.positions[48] - frames.positions[0]).max() < 0.02
    assert record.columns["potential"][12] == pytest.approx(record.columns["potential"].min())
    assert main(["view", str(folder)]) == 0
    assert main(["modes", str(DIMER)]) == 2
    assert "holds an earlier run" in capsys.readouterr().err
    assert main(["modes", str(DIMER), "--force", "--animate", "3"]) == 0
    assert "mode 3 is a zero mode, which has no animation" in capsys.readouterr().out
    assert (folder / "modes.csv").is_file() and not (folder / "log.csv").exists()


def test_a_mode_that_does_not_exist_is_refused_before_computing(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(normal_modes, "find_minimum", None)  # nothing is computed
    assert main(["modes", str(DIMER), "--animate", "13"]) == 2
    assert "mode 13 will not be computed: there are 12 modes" in capsys.readouterr().err
    assert main(["modes", str(DIMER), "--animate", "9", "--count", "2"]) == 2
    assert "mode 9 will not be computed: count = 2 omits it" in capsys.readouterr().err


def test_atoms_far_from_each_other_end_at_the_minimum():
    modes = rigidmd.normal_modes(
        small_scene({"argon": 2}, None, box={"lengths_A": 60, "periodic": False})
    )
    assert modes.energy == pytest.approx(-WELL / KJ_PER_MOL)
    assert modes.rate[5] ** 2 == pytest.approx(
        CURVATURE * WELL / SIGMA**2 / (ARGON.mass / 2), rel=1e-4
    )
    assert not modes.rate[:5].any()


@pytest.mark.parametrize("temperatures", [[100, 300], [250, 50]])
def test_the_temperature_is_that_of_the_end_of_the_last_ramp(temperatures):
    stages = [
        {"ensemble": "nvt", "duration_ps": 1, "temperature_K": temperatures},
        {"ensemble": "minimise"},
        {"duration_ps": 1},
    ]
    scene = rigidmd.Scene.from_dict(
        small_scene({"argon": 2}, None, stages=stages).model_dump(exclude_none=True)
    )
    assert (
        modes_from(scene, state_of(np.array([[0.0, 0, 0], [3.8, 0, 0]]))).temperature
        == temperatures[1]
    )


CRYSTAL = """data_alpha_nitrogen
_cell_length_a 5.65
_cell_length_b 5.65
_cell_length_c 5.65
_cell_angle_alpha 90
_cell_angle_beta 90
_cell_angle_gamma 90
_space_group_name_H-M_alt 'P a -3'
loop_
_atom_site_label
_atom_site_type_symbol
_atom_site_fract_x
_atom_site_fract_y
_atom_site_fract_z
N1 N 0.0561 0.0561 0.0561
"""


def crystal(folder, repeat):
    (folder / "nitrogen.cif").write_text(CRYSTAL)
    structure = {"file": "nitrogen.cif", "repeat": repeat}
    forces = {"cutoff_A": 4.9, "truncation": "smooth_switch"}
    data = {"structure": structure, "molecules": [{"model": "nitrogen"}], "forces": forces}
    return rigidmd.Scene.from_dict(data | {"stages": [{"ensemble": "minimise"}]}, folder)


def test_modes_at_the_gamma_point_are_those_of_the_unit_cell(tmp_path):
    whole = rigidmd.normal_modes(crystal(tmp_path, [2, 2, 2]))
    cell = rigidmd.normal_modes(crystal(tmp_path, [2, 2, 2]), gamma=True)
    longer = rigidmd.normal_modes(crystal(tmp_path, [3, 2, 2]), gamma=True)
    assert (cell.total, cell.cells, longer.cells) == (20, 8, 12)
    assert cell.vector.shape == (20, 160)
    assert (cell.rate[:3] == 0).all() and (cell.rate[3:] > 0).all()
    assert longer.wavenumber == pytest.approx(cell.wavenumber, abs=0.02)
    # each is in the space of the modes of the whole crystal with its frequency
    for k in range(3, 20):
        near = np.abs(whole.wavenumber - cell.wavenumber[k]) < 0.02
        assert np.linalg.norm(whole.vector[near] @ cell.vector[k]) == pytest.approx(1, abs=1e-4)
    assert np.abs(cell.vector @ cell.vector.T - np.eye(20)).max() < 1e-12
    # librations E_g, T_g, T_g and translations A_u, E_u, T_u, T_u: Pa-3 has degenerate modes
    libration = cell.wavenumber[3:][cell.translation[3:] < 0.5]
    assert len(libration) == 8
    assert (
        np.ptp(libration[:2]) < 0.05
        and np.ptp(libration[2:5]) < 0.05
        and np.ptp(libration[5:]) < 0.05
    )
    with pytest.raises(ValueError, match="leave out count and gamma"):
        cell.free_energy(300)
    with pytest.raises(SceneError, match="count and gamma"):
        rigidmd.normal_modes(crystal(tmp_path, [2, 2, 2]), gamma=True, count=3)
    with pytest.raises(SceneError, match="needs the unit cell of a crystal"):
        rigidmd.normal_modes(rigidmd.Scene.read(DIMER), gamma=True)
    system, state = cell.system, cell.coordinates.state.copy()
    state.position[3] += 0.2
    with pytest.raises(
        SimulationError,
        match="does not have the period of its unit cell: of 8 copies of a molecule",
    ):
        periodic_basis(system, state, cell.coordinates.index)
    state = cell.coordinates.state.copy()
    state.rotation[9] = Rotation.from_rotvec([0.3, 0.2, 0.1]).as_matrix() @ state.rotation[9]
    with pytest.raises(SimulationError, match="have different orientations"):
        periodic_basis(system, state, cell.coordinates.index)


def test_the_layout_of_vectors(mixture):
    """Shifts of all molecules first, along x, y, z; then rotations about the principal axes that
    have inertia."""
    state, system = mixture.coordinates.state, mixture.system
    mass, per_moment = (
        of[system.model.species] for of in (system.model.mass, system.model.inverse_inertia)
    )
    for column, (molecule, axis) in {0: (0, 0), 13: (4, 1)}.items():
        q = np.zeros(mixture.vector.shape[1])
        q[column] = 0.01
        moved = mixture.coordinates.at(q)
        shift = np.zeros_like(state.position)
        shift[molecule, axis] = 0.01 / np.sqrt(mass[molecule])
        assert moved.position - state.position == pytest.approx(shift, abs=1e-12)
        assert (moved.rotation == state.rotation).all()
    column = 30 + 2 * 3 + 3 + 2  # axis 3 of the second water, after three linear molecules
    q = np.zeros(mixture.vector.shape[1])
    q[column] = 0.01
    moved, molecule = mixture.coordinates.at(q), 7
    turned = Rotation.from_matrix(state.rotation[molecule].T @ moved.rotation[molecule]).as_rotvec()
    assert turned == pytest.approx([0, 0, 0.01 * np.sqrt(per_moment[molecule, 2])], abs=1e-12)
    assert (np.delete(moved.rotation, molecule, 0) == np.delete(state.rotation, molecule, 0)).all()


def test_the_lattice_energy_of_a_crystal(tmp_path, capsys):
    """It does not depend on the number of cells, and is not a part of a liquid or of a crystal in a
    field."""
    cells = [
        rigidmd.Simulation(crystal(tmp_path, repeat))._start_energy(100.0, "kJ/mol")
        for repeat in ([2, 2, 2], [3, 2, 2])
    ]
    for found in cells:
        assert found["lattice_energy_per_molecule"] == found["potential"] / found["molecules"]
    one, other = (found["lattice_energy_per_molecule"] for found in cells)
    assert one == pytest.approx(other, rel=1e-5)
    assert (
        -8.5 < one < -6.9
    )  # 6.9 kJ/mol is the heat of sublimation, less than this by the zero-point energy
    liquid = rigidmd.Simulation(small_scene(MIXTURE, 20.0))._start_energy(100.0, "kJ/mol")
    assert liquid["lattice_energy_per_molecule"] is None
    assert liquid["potential_per_molecule"] == liquid["potential"] / 10
    scene = tmp_path / "crystal.toml"
    scene.write_text(
        '[structure]\nfile = "nitrogen.cif"\nrepeat = [2, 2, 2]\n[[molecules]]\nmodel = "nitrogen"\n[forces]\n'
        'cutoff_A = 4.9\ntruncation = "smooth_switch"\n[[stages]]\nensemble = "minimise"\n'
    )
    assert main(["energy", str(scene)]) == 0
    printed = capsys.readouterr().out
    assert f"{'lattice energy':22}{one:22.10g} kJ/mol per molecule" in printed
    assert "relative to the same rigid molecules far from each other; static" in printed
