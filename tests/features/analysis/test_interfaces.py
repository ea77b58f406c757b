"""Slabs between two vapours: Ewald sums without images along the normal, vacuum in the box,
analyses of interfaces."""

import shutil
import subprocess

import numpy as np
import pytest
from support.common import history, noise_with_memory, small_scene, system_of

from rigidmd import Scene, Simulation
from rigidmd.assemble.build import build
from rigidmd.engines.cpu.engine import CpuEngine as Engine
from rigidmd.errors import OutputError, SceneError
from rigidmd.features.analysis.built_in.interfaces import interfaces, slab_of, surface_tension
from rigidmd.features.analysis.runs import Runs
from rigidmd.mechanics.rotation import random_rotations
from rigidmd.units import BAR, GRAM_PER_CM3, KJ_PER_MOL

IONS = [{"model": "na_spce", "count": 7}, {"model": "cl_spce", "count": 7}]
WATERS = [{"model": "spce", "count": 17}]
EWALD = {
    "cutoff_A": 5.9,
    "electrostatics": "ewald",
    "ewald_accuracy": 1e-10,
    "ewald_truncation": "plain",
}


def slab(vacuum, axis="z", normal="z", molecules=IONS, edges=(12.0, 12.5, 8.0), **sections):
    """A layer of molecules across an axis."""
    box = {"lengths_A": list(edges), "vacuum_A": vacuum, "vacuum_axis": axis} | sections.pop(
        "box", {}
    )
    forces = EWALD | {"ewald_slab": normal} | sections.pop("forces", {})
    return small_scene(
        {}, None, molecules=molecules, box=box, forces=forces, precision="double", **sections
    )


def charges(scene):
    """Energy (kJ/mol), forces and start of the charges of a scene."""
    system = build(scene)
    terms = {name: term for name, term in system.terms.items() if name.startswith("coulomb")}
    load, tallies = Engine(system.model, terms).evaluate(system.state)
    constant = sum(value for name, value in system.constants.items() if name.startswith("coulomb"))
    return (
        (sum(tally.energy for tally in tallies.values()) + constant) / KJ_PER_MOL,
        load.force,
        system,
    )


@pytest.mark.parametrize("molecules", [IONS, WATERS])
@pytest.mark.parametrize("axis", ["x", "z"])
def test_charges_in_a_slab_do_not_depend_on_the_vacuum(molecules, axis):
    edges = (8.0, 12.5, 12.0) if axis == "x" else (12.0, 12.5, 8.0)
    energy, force, _ = charges(slab(30.0, axis, axis, molecules, edges))
    longer, same, _ = charges(slab(90.0, axis, axis, molecules, edges))
    assert energy == pytest.approx(longer, abs=1e-3)
    assert force == pytest.approx(same, abs=1e-6 * np.abs(same).max())
    with_images, other, _ = charges(slab(30.0, axis, None, molecules, edges))
    assert abs(with_images - longer) > 0.01
    if molecules is IONS:  # the field of the images acts on molecules with a charge
        assert np.abs(other - same).max() > 1e-3 * np.abs(same).max()


def test_charges_in_a_slab_are_those_of_lammps(tmp_path):
    """`kspace_modify slab 3.0` makes the box three times as long along z, and adds the same
    term."""
    program = shutil.which("lmp")
    if program is None:
        pytest.skip("LAMMPS is not installed")
    energy, force, system = charges(slab(28.0))
    state, (x, y, z) = system.state, np.diag(system.state.cell)
    atoms = [
        f"{k + 1} 1 {1.0 if k < 7 else -1.0} {' '.join(repr(float(c)) for c in at)}"
        for k, at in enumerate(state.position % np.diag(state.cell))
    ]
    (tmp_path / "data").write_text(
        f"ions\n\n14 atoms\n1 atom types\n0 {x} xlo xhi\n0 {y} ylo yhi\n{z / 3} {2 * z / 3} zlo zhi\n\nMasses\n\n1 20.0\n\n"
        "Atoms # charge\n\n" + "\n".join(atoms) + "\n"
    )
    (tmp_path / "in").write_text(
        "units real\natom_style charge\nboundary p p f\nread_data data\npair_style coul/long 5.9\npair_coeff * *\n"
        "kspace_style ewald 1e-8\nkspace_modify slab 3.0\nthermo_modify format float %.15g\nrun 0\n"
        'write_dump all custom forces id fx fy fz modify sort id format float %.15g\nprint "$(pe:%.15g)" file energy\n'
    )
    subprocess.run(
        [program, "-in", "in", "-log", "none"], cwd=tmp_path, check=True, capture_output=True
    )
    kcal, theirs = 4.184, np.loadtxt(tmp_path / "forces", skiprows=9)[:, 1:]
    assert energy == pytest.approx(kcal * float((tmp_path / "energy").read_text()), rel=1e-6)
    assert force == pytest.approx(kcal * KJ_PER_MOL * theirs, abs=2e-6 * np.abs(force).max())


@pytest.mark.parametrize(
    ("scene", "match"),
    [
        (
            lambda: slab(1.0, molecules=[WATERS[0] | {"count": 27}], edges=(12.0, 12.5, 12.0)),
            r"of the longest edge across, which has to be at least 0.5: add vacuum",
        ),
        (
            lambda: slab(30.0, molecules=IONS[:1]),
            "ewald_slab: the dipole of a box with a net charge is not defined",
        ),
        (
            lambda: slab(30.0, normal="x"),
            r"of the longest edge across, which has to be at least 0.5",
        ),
        (
            lambda: slab(30.0, box={"angles_deg": [80.0, 90.0, 90.0]}),
            "must be at right angles to the others",
        ),
        (
            lambda: slab(30.0, forces={"ewald_surface_permittivity": 1.0}),
            "give ewald_slab or ewald_surface_permittivity",
        ),
        (lambda: slab(30.0, forces={"electrostatics": "none"}), "ewald_slab would have no effect"),
        (
            lambda: slab(30.0, box={"periodic": False}),
            "vacuum_A would have no effect: periodic is false",
        ),
        (
            lambda: slab(
                30.0,
                stages=[
                    {
                        "ensemble": "npt",
                        "temperature_K": 300.0,
                        "pressure_bar": 1.0,
                        "duration_ps": 1.0,
                    }
                ],
            ),
            "needs a constant edge along z: keep the volume, or set pressure_coupling = 'lateral'",
        ),
    ],
)
def test_slabs_that_cannot_be(scene, match):
    with pytest.raises(SceneError, match=match):
        build(scene())


def test_ions_in_two_images_of_a_slab_are_refused(tmp_path):
    system = build(slab(30.0))
    place = system.state.position.copy()
    place[3, 2] += system.state.cell[2, 2]
    lines = [
        f"{name} {' '.join(map(str, at))}"
        for name, at in zip(["Na"] * 7 + ["Cl"] * 7, place, strict=True)
    ]
    (tmp_path / "ions.xyz").write_text("\n".join(["14", "", *lines]) + "\n")
    box = {"lengths_A": [12.0, 12.5, 38.0]}
    molecules = [{"model": "na_spce"}, {"model": "cl_spce"}]
    scene = small_scene(
        {},
        None,
        tmp_path,
        molecules=molecules,
        box=box,
        forces=EWALD | {"ewald_slab": "z"},
        structure={"file": "ions.xyz"},
    )
    with pytest.raises(SceneError, match="charged molecules are in different images of the slab"):
        build(scene)


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_vacuum_is_added_to_a_lattice_and_to_a_structure(axis, tmp_path):
    k = "xyz".index(axis)
    forces = {"cutoff_A": 5.0, "electrostatics": "none"}
    plain = small_scene({"spce": 60}, 12.2, forces=forces)
    bare = build(plain)
    found = build(
        plain.model_copy(
            update={
                "box": Scene.from_dict(
                    plain.model_dump(exclude_defaults=True)
                    | {"box": {"lengths_A": 12.2, "vacuum_A": 20.0, "vacuum_axis": axis}}
                ).box
            }
        )
    )
    expected = np.full(3, 12.2)
    expected[k] += 20.0
    assert np.diag(found.state.cell) == pytest.approx(expected)
    assert found.state.position == pytest.approx(bare.state.position + 10.0 * np.eye(3)[k])
    assert not found.scene.forces.tail_correction
    Simulation(plain, tmp_path / "run").run(progress=False)
    data = plain.model_dump(exclude_defaults=True) | {
        "box": {"vacuum_A": 20.0, "vacuum_axis": axis},
        "structure": {"file": "run/final.npz"},
    }
    again = build(Scene.from_dict(data, tmp_path))
    assert np.diag(again.state.cell) == pytest.approx(expected)
    inside = again.state.position[:, k]
    assert (inside >= 10.0).all()
    assert (inside < 22.2).all()


@pytest.mark.parametrize(("coupling", "constant"), [("normal", [0, 1]), ("lateral", [2])])
def test_barostats_of_one_direction_keep_the_others(coupling, constant):
    stage = {
        "ensemble": "npt",
        "temperature_K": 120.0,
        "pressure_bar": 300.0,
        "pressure_coupling": coupling,
        "duration_ps": 1.0,
        "timestep_fs": 4.0,
        "barostat_time_ps": 0.3,
    }
    results = Simulation(
        small_scene({"argon": 108}, 17.5, forces={"cutoff_A": 8.0}, stages=[stage])
    ).run()
    before, after = (np.diag(state.cell) for state in (results.system.state, results.state))
    moved = [k for k in range(3) if k not in constant]
    assert (after[constant] == before[constant]).all()
    assert (np.abs(after[moved] - before[moved]) > 0.01).all()
    if coupling == "lateral":
        assert after[0] / after[1] == pytest.approx(before[0] / before[1], rel=1e-12)
    with pytest.raises(SceneError, match="has one pressure"):
        small_scene({"argon": 108}, 17.5, stages=[stage | {"pressure_bar": [1.0, 1.0, 2.0]}])


LIQUID, VAPOUR, HALF, WIDTH = 0.95, 0.05, 12.0, 2.0  # g/cm³, Å


def synthetic(rng, frames=200, axis=2):
    """Independent frames of water with a tanh profile about a middle that moves, dipoles outwards
    at the interface."""
    system = system_of({"spce": 600}, 20.0)
    edges = np.full(3, 20.0)
    edges[axis] = 80.0
    grid = np.linspace(0, 40, 4001)
    density = 0.5 * (LIQUID + VAPOUR) - 0.5 * (LIQUID - VAPOUR) * np.tanh((grid - HALF) / WIDTH)
    cumulative = np.cumsum(density)
    z = np.interp(rng.random((frames, 600)), cumulative / cumulative[-1], grid) * rng.choice(
        [-1, 1], (frames, 600)
    )
    positions = 20.0 * rng.random((frames, 600, 3))
    positions[..., axis] = z + 80.0 * rng.random((frames, 1))
    mass = density.sum() * 0.01 * 2 * 400.0 * GRAM_PER_CM3  # of the profile in the box
    scale = 600 * system.species[0].mass / mass
    return system, positions, np.diag(edges), scale


@pytest.mark.parametrize("axis", [0, 2])
def test_the_fit_of_a_profile_finds_its_densities_and_width(axis):
    rng = np.random.default_rng(axis)
    system, positions, cell, scale = synthetic(rng, axis=axis)
    Q = random_rotations(rng, positions[..., 0].size).reshape(200, 600, 3, 3)
    frames = history(system, np.arange(200.0), positions, cell, Q)
    found = interfaces(frames, "xyz"[axis])
    expected = {
        "liquid": LIQUID * scale,
        "vapour": VAPOUR * scale,
        "thickness of the slab": 2 * HALF,
        "width d": WIDTH,
    }
    for name, value in expected.items():
        seen = found.value(name)
        assert abs(seen.value - value) < 4 * seen.error + 0.01 * value
        assert 0 < seen.error < 0.1 * value
    assert np.nanmean(np.abs(found["mean cosine of dipoles spce"][:20])) < 0.05


def test_dipoles_are_counted_along_the_outward_normal():
    system, positions, cell, _ = synthetic(np.random.default_rng(3), 20)
    molecule = system.species[0]
    dipole = molecule.charges @ molecule.positions_body
    middle = (
        np.angle(np.exp(2j * np.pi * positions[..., 2] / 80.0).mean(axis=1))[:, None]
        * 80.0
        / (2 * np.pi)
    )
    side = np.sign((positions[..., 2] - middle + 40.0) % 80.0 - 40.0)
    along = dipole / np.linalg.norm(dipole)
    other = np.cross(along, [0.3, 0.4, 0.5])
    frame = np.stack(
        [other / np.linalg.norm(other), np.cross(along, other / np.linalg.norm(other)), along]
    )
    Q = frame[None, None] * np.stack([side, np.ones_like(side), side], axis=-1)[..., None]
    frames = history(system, np.arange(20.0), positions, cell, Q)
    seen = interfaces(frames)["mean cosine of dipoles spce"]
    assert np.nanmin(seen[4:]) > 0.99


def test_sites_of_molecules_that_lie_in_the_interface_have_the_profile_of_the_density():
    """All molecules have one orientation without symmetry, so that their sites are at other
    distances than by Q^T."""
    rng = np.random.default_rng(8)
    system, positions, cell, _ = synthetic(rng, 60)
    for seed in (1, 2):
        Q = np.broadcast_to(random_rotations(np.random.default_rng(seed), 1)[0], (60, 600, 3, 3))
        frames = history(system, np.arange(60.0), positions, cell, Q)
        found = slab_of(frames, "z")
        arms = np.concatenate(
            [np.full(600, (Q[0, 0] @ arm)[2]) for arm in system.species[0].positions_body]
        )
        centres = np.tile(positions[..., 2], 3)
        gap = found.distance - (centres + arms)
        assert np.ptp((gap - gap[:, :1] + 40.0) % 80.0) < 1e-9  # one shift of each frame
        assert np.ptp(arms) > 0.3
        inner = np.abs(found.distance) < 5.0
        assert inner.mean() == pytest.approx(5 / (HALF + (40 - HALF) * VAPOUR / LIQUID), rel=0.05)


def test_the_surface_tension_is_half_the_box_times_the_difference_of_pressures():
    rng = np.random.default_rng(5)
    system, positions, cell, _ = synthetic(rng)
    tensor = np.zeros((4000, 7))
    tensor[:, 0] = 0.05 * np.arange(4000)
    tensor[:, 1:4] = np.array([-300.0, -100.0, 50.0]) + 400.0 * rng.standard_normal((4000, 3))
    Q = random_rotations(rng, positions[..., 0].size).reshape(200, 600, 3, 3)
    found = surface_tension(
        history(system, np.arange(200.0), positions, cell, Q, tensor=tensor)
    ).value()
    assert (
        0.9 < found.error / (0.01 * 40.0 * 400 * np.sqrt(1.5 / 4000)) < 2.0
    )  # it allows for correlation
    assert found.value == pytest.approx(0.01 * 40.0 * 250.0, abs=4 * found.error)
    assert found.unit == "mN/m"
    assert pytest.approx(0.602214, rel=1e-5) == 100 * BAR  # 1 mN/m in u/ps²


def test_the_height_of_a_surface_tension_is_along_the_normal():
    """By a tensor without noise."""
    system, positions, cell, _ = synthetic(np.random.default_rng(5), 20, axis=0)
    tensor = np.zeros((400, 7))
    tensor[:, 0] = 0.05 * np.arange(400)
    tensor[:, 1:4] = [-300.0, -100.0, 50.0]
    tensor[:, 1] += 1e-3 * np.random.default_rng(6).standard_normal(400)
    Q = np.broadcast_to(np.eye(3), (20, 600, 3, 3))
    frames = history(system, np.arange(20.0), positions, cell, Q, tensor=tensor)
    found = surface_tension(frames, "x").value()
    assert found.value == pytest.approx(0.01 * 40.0 * (-300.0 + 25.0), rel=1e-5)


def mixture(seed, frames=300, axis=2, enriched=0.04):
    """Frames of 400 atoms of argon and 200 of krypton in a slab, of which a fraction of the krypton
    is enriched at the interfaces; densities (species, phases), 1/Å³, without that fraction."""
    system, rng = system_of({"argon": 400, "krypton": 200}, 20.0), np.random.default_rng(seed)
    grid = np.linspace(0, 40, 4001)
    tanh = np.tanh((grid - HALF) / WIDTH)
    edges = np.full(3, 20.0)
    edges[axis] = 80.0
    densities, z = [], []
    for count, vapour, excess in ((400, 0.05, 0.0), (200, 0.25, enriched)):
        shape = 0.5 * (1 + vapour) - 0.5 * (1 - vapour) * tanh
        total = np.cumsum(shape)
        of_slab = np.interp(rng.random((frames, count)), total / total[-1], grid)
        at_interface = HALF + 1.5 * rng.standard_normal((frames, count))
        z.append(np.where(rng.random((frames, count)) < excess, at_interface, of_slab))
        unit = (1 - excess) * count / (2 * 400.0 * total[-1] * (grid[1] - grid[0]))
        densities.append([unit, vapour * unit])
    z = np.concatenate(z, axis=1) * rng.choice([-1, 1], (frames, 600))
    positions = edges * rng.random((frames, 600, 3))
    positions[..., axis] = z + 80.0 * rng.random((frames, 1))
    return history(system, np.arange(float(frames)), positions, np.diag(edges)), densities


PHASES = ("liquid", "vapour")


@pytest.mark.parametrize("axis", [0, 2])
def test_species_of_a_slab_have_their_densities_and_mole_fractions(axis):
    frames, densities = mixture(axis, axis=axis)
    found = interfaces(frames, "xyz"[axis])
    for j, phase in enumerate(PHASES):
        total = densities[0][j] + densities[1][j]
        for k, molecule in enumerate(frames.system.species):
            value = found.value(f"{molecule.name} in the {phase}")
            density = densities[k][j] * molecule.mass / GRAM_PER_CM3
            assert abs(value.value - density) < 4 * value.error + 0.02 * density
            assert 0 < value.error < 0.1 * density
            fraction = found.value(f"mole fraction of {molecule.name} in the {phase}")
            assert abs(fraction.value - densities[k][j] / total) < 4 * fraction.error + 0.01
            assert 0 < fraction.error < 0.05
    assert found["argon (g/cm3)"] + found["krypton (g/cm3)"] == pytest.approx(
        found["density (g/cm3)"]
    )


def test_errors_of_species_in_a_slab_are_honest():
    """The scatter over seeds, of one run with errors from its frames, which are larger because of
    what 60 frames may hide, and of three runs with errors from their scatter."""
    alone, together = [], []
    for seed in range(12):
        runs = [mixture(100 + 3 * seed + k, 60, enriched=0.0)[0] for k in range(3)]
        alone += [interfaces(run) for run in runs]
        together.append(interfaces(Runs(tuple(runs))))
    for results, lowest, least, most in ((alone, 0.9, 1.0, 1.8), (together, 0.6, 0.7, 1.4)):
        found = [[value[2:4] for value in result.values] for result in results]
        values, errors = np.moveaxis(np.array(found, float), 2, 0)
        assert values.shape == (len(results), 12)  # of the fit, and two for each species and phase
        ratio = np.sqrt(np.mean(errors**2, axis=0)) / values.std(axis=0, ddof=1)
        print(ratio)
        assert least < np.mean(ratio) < most
        assert (ratio > lowest).all() and (ratio < 2.2).all()


def test_a_slab_of_too_few_frames_has_values_so_far():
    frames, _ = mixture(1, 9)
    found = interfaces(frames[:4])
    assert all(value.value is None for value in found.values)
    assert all("too short for an error. So far: " in value.note for value in found.values)


@pytest.mark.parametrize("seeds", [6, pytest.param(60, marks=pytest.mark.soak)])
def test_densities_of_a_slab_that_change_slowly_have_honest_errors(seeds):
    """The number of molecules in the vapour wanders with 20 frames of correlation, in 400
    frames."""
    system, _, cell, _ = synthetic(np.random.default_rng(0), 2)
    found = {"liquid": [], "vapour": [], "thickness of the slab": []}
    grid = np.linspace(0.0, 40.0, 2001)
    tanh = 0.5 * (1 - np.tanh((grid - HALF) / WIDTH))
    vapour, liquid = (np.cumsum(part) / part.sum() for part in (1 - tanh, tanh))
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        wander = noise_with_memory(rng, 400, (1,), 1.0, 20.0, 1.0)[:, 0]
        fraction = np.clip(0.1 + 0.025 * wander, 0.0, 1.0)  # of the molecules
        chosen = rng.random((400, 600))
        is_vapour = rng.random((400, 600)) < fraction[:, None]
        z = np.where(is_vapour, np.interp(chosen, vapour, grid), np.interp(chosen, liquid, grid))
        positions = 20.0 * rng.random((400, 600, 3))
        positions[..., 2] = z * rng.choice([-1, 1], (400, 600)) + 30.0
        Q = np.broadcast_to(np.eye(3), (400, 600, 3, 3))
        told = interfaces(history(system, np.arange(400.0), positions, cell, Q))
        for name, values in found.items():
            values.append(told.value(name)[2:4])
    unit = 600 * system.species[0].mass / (2 * 400.0) / GRAM_PER_CM3
    truth = {"vapour": 0.1 * unit / np.trapezoid(1 - tanh, grid)}
    truth["liquid"] = 0.9 * unit / np.trapezoid(tanh, grid)
    for name, value in truth.items():
        pulls = [(mean - value) / error for mean, error in found[name]]
        assert 0.4 < np.sqrt(np.mean(np.square(pulls))) < (2.0 if seeds < 20 else 1.4), name


def test_a_surface_tension_without_the_pressure_tensor_states_what_to_set():
    rng = np.random.default_rng(6)
    system, positions, cell, _ = synthetic(rng, 60)
    Q = random_rotations(rng, 60 * 600).reshape(60, 600, 3, 3)
    with pytest.raises(
        OutputError, match=r"pressure tensor, .* set output.pressure_tensor_interval_ps = 0.05"
    ):
        surface_tension(history(system, np.arange(60.0), positions, cell, Q))


def test_what_is_not_a_slab_is_refused():
    system = system_of({"spce": 64}, 12.5)
    rng = np.random.default_rng(1)
    Q = random_rotations(rng, 640).reshape(10, 64, 3, 3)
    frames = history(system, np.arange(10.0), 12.5 * rng.random((10, 64, 3)), np.eye(3) * 12.5, Q)
    for analysis in (interfaces, surface_tension):
        with pytest.raises(OutputError, match=r"no slab between two vapours|no profile of a slab"):
            analysis(frames)
        with pytest.raises(OutputError, match="axis is 'n', must be x or y or z"):
            analysis(frames, "n")
