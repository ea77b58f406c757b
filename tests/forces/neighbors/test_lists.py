"""Cells that change: which pairs a list has meanwhile, and the volumes of an ideal gas through a
whole run."""

from itertools import product

import numpy as np
import pytest
from support.common import built, site

from rigidmd import Scene, Simulation
from rigidmd.forces.neighbors.lists import BUILDS, IMAGES_FOUND

IMAGES = np.array(list(product((-1, 0, 1), repeat=3)), float)
#: Å
CUTOFF, SKIN = 7.0, 5.0


def lennard_jones(position, cell, sigma, epsilon):
    """Energy and forces of all pairs within the cutoff, over 27 images."""
    i, j = np.triu_indices(len(position), 1)
    inside = (position[i] - position[j]) @ np.linalg.inv(cell)
    away = ((inside - np.round(inside)) @ cell)[:, None] + IMAGES @ cell
    r2 = np.sum(away**2, axis=2)
    six = np.where(r2 < CUTOFF**2, (sigma**2 / r2) ** 3, 0.0)
    energy = 4 * epsilon * np.sum(six * six - six)
    pushes = np.sum((24 * epsilon * (2 * six * six - six) / r2)[..., None] * away, axis=1)
    force = np.zeros_like(position)
    np.add.at(force, i, pushes)
    np.add.at(force, j, -pushes)
    return energy, force


@pytest.mark.parametrize("angles", [[90, 90, 90], [70, 100, 115]])
def test_one_list_has_all_pairs_of_a_cell_that_is_strained(angles):
    """The potential jumps where it ends, so that one missing pair shows. Strains of 0.5, 1 and 2 %
    move no image by more than a quarter of the skin: the list stays; a strain beyond that is for a
    new one."""
    forces = {"cutoff_A": CUTOFF, "truncation": "plain", "electrostatics": "none", "skin_A": SKIN}
    box = {"lengths_A": [19.0, 18.5, 18.0], "angles_deg": angles}
    system, engine, state = built(
        {"argon": 160}, 1.0, 3, spread=0.15, box=box, forces=forces, precision="double"
    )
    argon = system.species[0]
    engine.evaluate(state)
    (pairs,) = [own.pairs for own in engine.workspaces.values()]
    start, rng = state.copy(), np.random.default_rng(2)
    images = pairs.multiple[: pairs.counters[IMAGES_FOUND]]
    reach = np.linalg.norm(images @ start.cell, axis=1).max()
    for size in (0.005, -0.005, 0.01, -0.01, 0.02, -0.02):
        for _ in range(3):
            direction = np.tril(rng.standard_normal((3, 3)))
            moves = np.linalg.norm(images @ start.cell @ direction, axis=1).max()
            strain = (
                np.eye(3) + size * direction * reach / moves
            )  # the farthest image moves as by a dilatation
            moved = abs(size) * reach
            state.cell[:] = start.cell @ strain
            state.position[:] = start.position @ strain
            energy, force = lennard_jones(
                state.position, state.cell, argon.sigma[0], argon.epsilon[0]
            )
            load, tallies = engine.evaluate(state)
            assert tallies["lennard_jones"].energy == pytest.approx(energy, rel=1e-9)
            assert load.force == pytest.approx(force, rel=1e-8, abs=1e-7 * np.abs(force).max())
            assert pairs.counters[BUILDS] == 1
            assert moved < 0.25 * SKIN
    for share, builds in ((0.245, 1), (0.255, 2)):
        strain = np.eye(3) * (1 + share * SKIN / reach)
        state.cell[:], state.position[:] = start.cell @ strain, start.position @ strain
        energy, _ = lennard_jones(state.position, state.cell, argon.sigma[0], argon.epsilon[0])
        assert engine.evaluate(state)[1]["lennard_jones"].energy == pytest.approx(energy, rel=1e-9)
        assert pairs.counters[BUILDS] == builds, share


GAS = {
    "name": "point",
    "sites": [site("A", 40.0, element="Ar", sigma_A=0.005, epsilon_kJ_mol=1e-6)],
}


def test_an_ideal_gas_has_its_volumes_through_a_whole_run():
    """p(V) ~ V^N exp(-P V/kT): the mean of P V/kT is N + 1 and so is its variance. With N = 3 one
    too many is 25 %.

    A move is at most kT/P long (two standard deviations by the compressibility of the scene), so
    that half of the moves are rejected where it matters; the pressure is that at which the mean
    volume is 1000 Å³.
    """
    n, thermal = 3, 1.380649e-23 * 300  # J
    unit = 1e-27 / (n + 1)  # m³, kT/P
    pressure = thermal / unit / 1e5  # bar
    stage = {
        "ensemble": "npt",
        "temperature_K": 300.0,
        "pressure_bar": pressure,
        "duration_ps": 120.0,
        "timestep_fs": 1.0,
        "thermostat": "langevin",
        "barostat": "monte_carlo",
        "barostat_interval_ps": 0.001,
        # 2 sqrt(kT compressibility V) = kT/P at the start
        "compressibility_per_bar": unit / (4 * 1e-27) / pressure,
    }
    scene = {
        "box": {"lengths_A": 10.0},
        "molecules": [GAS | {"count": n}],
        "start": {"temperature_K": 300.0},
        "forces": {"cutoff_A": 0.02, "skin_A": 0.01, "electrostatics": "none"},
        "stages": [stage],
        "output": {"trajectory": False, "figures": False, "log_interval_ps": 0.02},
    }
    results = Simulation(Scene.from_dict(scene)).run()
    tried, accepted = (
        results.summary["stages"][0][key] for key in ("moves_tried", "moves_accepted")
    )
    assert tried == 120_000 and 0.3 < accepted / tried < 0.95
    volumes = results["volume"][50:] * 1e-27 / unit  # from nm³
    blocks = volumes[: len(volumes) // 20 * 20].reshape(20, -1).mean(axis=1)
    error = blocks.std(ddof=1) / np.sqrt(20)
    assert error < 0.106
    assert abs(volumes.mean() - (n + 1)) < 4 * error
    assert volumes.var() == pytest.approx(n + 1, rel=0.2)
