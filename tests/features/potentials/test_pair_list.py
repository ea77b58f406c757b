"""The list of pairs of bodies: all pairs of a moving and strained cell."""

import numpy as np
import pytest
from support.body_pairs import GAY_BERNE, ROD, brute_force, scene, simulation

from rigidmd.assemble.build import build
from rigidmd.features.potentials.poses.pair_list import BUILDS, MUST_BUILD
from rigidmd.units import KJ_PER_MOL


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


def test_the_list_is_rebuilt_where_a_strain_of_a_triclinic_cell_exceeds_its_skin():
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
