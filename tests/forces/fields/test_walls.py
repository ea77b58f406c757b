"""Walls: formulas, errors, waters between walls, molecules of a file between walls."""

from math import inf, sqrt

import numpy as np
import pytest
from support.common import move, observe, small_scene
from support.fields import OSCILLATING, VERLET, alone, slit, walls
from support.slopes import energy_of

from rigidmd.assemble.build import build
from rigidmd.engines.cpu.engine import BehindWallError
from rigidmd.errors import SceneError, SimulationError
from rigidmd.run import Simulation


def test_walls_are_what_their_formulas_state():
    def energy(z, **more):
        _, engine, state = alone({"bead": 1}, walls("lj93", **more))
        state.position[:] = [[1e3, -50.0, z]]
        return energy_of(engine, state) / 100

    well = (2 / 5) ** (1 / 6) * 3.0
    assert energy(-4 + well) == pytest.approx(-sqrt(10) / 3 * 2.0, rel=1e-13)
    assert energy(-4 + well + 1e-4) > energy(-4 + well) < energy(-4 + well - 1e-4)
    cut = 2.0 * (2 / 15 * (3 / 8) ** 9 - (3 / 8) ** 3)
    for z in (-2.5, 0.0, 3.9):
        plain = 2.0 * (2 / 15 * (3 / (z + 4)) ** 9 - (3 / (z + 4)) ** 3)
        assert energy(z) == pytest.approx(plain, rel=1e-13)
        assert energy(z, cutoff_A=8.0) == pytest.approx(plain - cut, rel=1e-13)
    assert energy(4.1, cutoff_A=8.0) == 0
    assert energy(2.0, positions_A=[-4.0, 5.0]) == pytest.approx(
        energy(2.0) + energy(-1.0), rel=1e-13
    )
    _, engine, state = alone({"bead": 3}, walls("harmonic", positions_A=[-4.0, 2.0]))
    state.position[:, 2] = [-4.5, 0.0, 4.0]
    load, tallies = engine.evaluate(state)
    assert tallies["walls_0"].energy == pytest.approx(100 * 2.5 * (0.25 + 4), rel=1e-13)
    assert load.force[:, 2].tolist() == pytest.approx([250, 0, -1000])


def test_a_site_behind_a_wall_is_an_error_that_states_where():
    _, engine, state = alone({"bead": 3}, walls("lj93"))
    for z in (-4.0, -4.2):
        state.position[1, 2] = z
        with pytest.raises(
            BehindWallError,
            match=rf"molecule 2 has a site at z = {z:g} Å, behind the wall at z = -4 Å",
        ):
            engine.evaluate(state)
    state.position[1, 2] = np.nan
    with pytest.raises(SimulationError, match="molecule 2 is lost"):
        engine.evaluate(state)
    # one that shoots through the wall in a run is named, with a cause and advice
    scene = small_scene(
        {"argon": 2},
        None,
        stages=[{"duration_ps": 1.0, "timestep_fs": 10}],
        watch={"move": False},
        fields=walls("lj93", positions_A=[0.0, inf], cutoff_A=0.5),
    )
    simulation = Simulation(scene)
    state = simulation.system.state.copy()
    state.position[0, 2], state.velocity[0, 2] = 5.0, -1000.0
    simulation.start_from(state)
    with pytest.raises(
        SimulationError,
        match=r"molecule 1 \(argon\) has a site at z = -.* behind .*a shorter timestep",
    ):
        simulation.run()


def test_a_run_of_waters_between_walls_keeps_its_energy_and_the_momentum_along_them():
    stages = [{"duration_ps": 1.0, "timestep_fs": 1.0}, {"duration_ps": 2.0, "timestep_fs": 1.0}]
    oscillating = {"electric_V_per_nm": [0.2, 0.0, 1.0], "electric_frequency_per_ps": 3.0}
    results = Simulation(slit(oscillating, stages=stages)).run()
    stage = results.summary["stages"][1]
    assert (
        abs(stage["drift_kJ_mol_ns_per_molecule"]) < 4 * stage["drift_error_kJ_mol_ns_per_molecule"]
    )
    nve = results["stage"] == 1
    noise = stage["energy_rms_kJ_mol_per_molecule"] * 60
    assert (
        np.ptp(results["energy"][nve]) > 20 * noise
    )  # without the work of the field it would not be so
    assert noise < 2e-3 * results["kinetic"][nve].mean()
    assert results.summary["degrees_of_freedom"] == 60 * 6 - 2
    assert results.summary["momentum_conserved"] == ["x", "y"]
    state = results.state
    each = 18.0154 * np.abs(state.velocity).sum(axis=0)
    momentum = np.abs(18.0154 * state.velocity.sum(axis=0)) / each
    assert momentum[:2].max() < 1e-12
    assert momentum[2] > 1e-3
    z = state.position[:, 2]
    assert 1.0 < z.min() < z.max() < 15.0


def test_threads_change_no_bit():
    fields = (
        OSCILLATING
        | walls("lj93", acts_on="sites", positions_A=[-1.0, 31.0])
        | {"gravity_m_s2": [0.0, 0.0, 3e12]}
    )
    fields["restraints"] = [{"molecules": "1-100", "stiffness_kJ_mol_A2": 2.0}]
    scene = small_scene(
        {"spce": 700},
        None,
        fields=fields,
        box={"lengths_A": [30.0, 30.0, 44.0]},
        forces={"cutoff_A": 9.0},
    )
    found = []
    for threads in (1, 2):
        system = build(scene.model_copy(update={"threads": threads}))
        engine, state = system.engine(), system.state.copy()
        move(engine, state, VERLET, 0.0005, 5)
        found.append((*state, observe(system, engine, state).potential))
    assert all(np.array_equal(a, b) for a, b in zip(*found, strict=True))
    assert found[0][7].any()  # the ledger


def test_a_start_from_nothing_stands_between_walls():
    system = build(slit({}))
    z = system.site_positions(system.state)[:, 2]
    assert 0.0 < z.min() < 4.0
    assert 12.0 < z.max() < 16.0
    x = system.state.position[:, 0]
    assert x.max() - x.min() > 9.0
    floor = build(small_scene({"argon": 30}, None, fields=walls("lj93", positions_A=[3.0, inf])))
    z = floor.state.position[:, 2]
    assert 3.0 + 2.5 < z.min() < z.max() < 3.0 + 15.0 + 2.6


def test_molecules_of_a_file_are_taken_to_the_images_between_the_walls(tmp_path):
    rows = [(3.0, 3.0, 7.0), (8.0, 3.0, 37.0), (3.0, 8.0, -24.0)]
    lines = [
        f"    1AR      Ar{k:5d}" + "".join(f"{c / 10:8.3f}" for c in x)
        for k, x in enumerate(rows, 1)
    ]
    (tmp_path / "a.gro").write_text("\n".join(["t", "3", *lines, "2.0 2.0 3.0"]) + "\n")

    def found(positions):
        fields = walls("lj93", positions_A=positions)
        scene = small_scene(
            {},
            None,
            tmp_path,
            molecules=[{"model": "argon"}],
            box={},
            structure={"file": "a.gro"},
            fields=fields,
            forces={"cutoff_A": 9.0},
        )
        return build(scene).state.position

    assert found([0.0, 14.0])[:, 2].tolist() == pytest.approx([7, 7, 6])
    assert found([-30.0, -16.0])[:, 2].tolist() == pytest.approx([-23, -23, -24])
    with pytest.raises(
        SceneError,
        match=r"fields.walls.0: at the start, molecule 3 \(argon\) has a site at z = 6 Å, behind",
    ):
        found([6.5, 20.0])
