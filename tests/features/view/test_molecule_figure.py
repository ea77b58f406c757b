"""Molecules in memory for other viewers: bonds, velocities, rotations."""

import MDAnalysis
import numpy as np
import pytest
from support.common import ROOT
from support.pages import SHORT_WATER

from rigidmd import Scene, Simulation


@pytest.fixture(scope="module")
def water_in_memory():
    return Simulation(Scene.read(ROOT / "systems" / "water.toml", SHORT_WATER)).run()


def test_a_universe_knows_bonds_charges_masses_and_velocities(water_in_memory):
    u = water_in_memory.universe()
    assert len(u.bonds) == 2 * 216
    assert u.bonds.values() == pytest.approx(1.0, abs=1e-4)  # SPC/E: 1 Å
    assert u.select_atoms("name OW").charges == pytest.approx(-0.8476)
    assert u.residues[5].atoms.total_charge() == pytest.approx(0.0, abs=1e-12)
    frame = u.trajectory[-1]
    expected = water_in_memory.system.site_velocities(water_in_memory.state)
    assert np.allclose(frame.velocities, expected, rtol=1e-5, atol=1e-4)


def test_rotations_are_output(water_in_memory):
    rotation = water_in_memory.rotation
    u = water_in_memory.universe()
    assert rotation.shape == (len(u.trajectory), 216, 3, 3)
    sites = water_in_memory.system.sites
    arms = np.einsum("nij,nsj->nsi", rotation[2], sites.offset_body.reshape(216, 3, 3))
    u.trajectory[2]
    seen = u.atoms.positions.reshape(216, 3, 3).astype(float)
    assert np.allclose(arms - arms[:, :1], seen - seen[:, :1], atol=1e-4)


def test_the_files_of_a_run_agree(tmp_path):
    scene = Scene.read(
        ROOT / "systems" / "water.toml", SHORT_WATER | {"output.topology": "topology.pdb"}
    )
    results = Simulation(scene, tmp_path / "run").run()
    u = results.universe()
    assert len(u.bonds) == 2 * 216
    assert u.atoms[0].charge == pytest.approx(-0.8476)
    assert u.atoms[0].mass == pytest.approx(15.9994)
    assert len(MDAnalysis.Universe(tmp_path / "run" / "topology.pdb").bonds) == 2 * 216  # CONECT
    rotation, last = (
        results.rotation,
        results.state.rotation,
    )  # rebuilt from positions rounded to 0.01 Å
    assert rotation.shape == (len(u.trajectory), 216, 3, 3)
    assert np.abs(rotation[-1] - last).max() < 0.02


@pytest.mark.filterwarnings(
    "ignore:1 A.3 CRYST1 record"
)  # a body has no box, and MDAnalysis states so
def test_a_body_has_its_edges_as_bonds(tmp_path):
    more = {"run.duration_s": 0.01, "output.figures": False}
    results = Simulation(
        Scene.read(ROOT / "systems" / "heavy_top_3.toml", more), tmp_path / "run"
    ).run()
    joined = {tuple(pair) for pair in results.universe().bonds.indices.tolist()}
    octahedron = {
        (i, j) for i in range(2, 8) for j in range(i + 1, 8) if j - i != 3
    }  # tips are opposite to the third next
    assert joined == octahedron | {(0, 1)}  # and the pivot to the centre
    assert len(MDAnalysis.Universe(tmp_path / "run" / "topology.pdb").bonds) == 13
    assert results.rotation.shape == (21, 1, 3, 3)
    assert np.array_equal(results.rotation[-1, 0], results["Q"][-1])
