"""Restrained distances of groups."""

import re
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from support.common import small_scene
from support.slopes import energy_of, force_on, virial_of

from rigidmd.assemble.build import build
from rigidmd.engines.cpu.engine import CpuEngine as Engine
from rigidmd.errors import SceneError
from rigidmd.features.external.verify import export
from rigidmd.forces.fields import distances
from rigidmd.run import Simulation
from rigidmd.run.kind import describe

TILTED = {"lengths_A": [18.0, 20.0, 22.0], "angles_deg": [80.0, 100.0, 75.0]}
PAIR = {"between": [1, 4], "distance_A": 4.0, "stiffness_kJ_mol_A2": 7.0}
GROUPS = {"between": [[1, 3], "4-6"], "distance_A": 3.0, "stiffness_kJ_mol_A2": 11.0}


def held_apart(entry, box):
    """A term alone, with molecules of two masses anywhere, also in other images of the box."""
    molecules = [{"model": "argon", "count": 3}, {"model": "krypton", "count": 3}]
    fields = {"restraints": [entry]}
    stages = [{"ensemble": "minimise"}]
    box = box or {"lengths_A": 20.0, "periodic": False}
    scene = small_scene({}, None, molecules=molecules, fields=fields, box=box, stages=stages)
    start = np.array(
        [[2, 3, 1], [9, 9, 9], [3, 4, 2.5], [5, 2, 3], [6, 4, 3], [5.5, 2.5, 5]], float
    )
    return scene, start


def centres(state, groups, mass):
    """Centres of groups by the nearest images to their first members, over 27 images each."""
    images = np.zeros((1, 3))
    if np.isfinite(state.cell).all():
        images = np.array(list(np.ndindex(7, 7, 7))) - 3.0
        images = images @ state.cell

    def nearest(vector):
        return (vector + images)[np.linalg.norm(vector + images, axis=1).argmin()]

    found = []
    for group in groups:
        origin = state.position[group[0]]
        arms = np.array([nearest(state.position[m] - origin) for m in group])
        found.append(origin + np.average(arms, axis=0, weights=mass[group]))
    return nearest(found[1] - found[0])


@pytest.mark.parametrize("box", [None, TILTED], ids=["open", "tilted"])
@pytest.mark.parametrize("entry", [PAIR, GROUPS], ids=["pair", "groups"])
def test_a_restrained_distance(entry, box, monkeypatch):
    """Energy by the nearest images, forces and virial by differences of the energy, no force on the
    whole."""
    scene, start = held_apart(entry, box)
    monkeypatch.setattr(
        distances, "_faults_in_box", lambda *_: []
    )  # the lattice of the start is elsewhere
    system = build(scene)
    term = system.terms["restraints_0"]
    engine, state = Engine(system.model, {"restraints_0": term}), system.state.copy()
    state.position[:] = start
    mass = system.model.mass[system.model.species]
    groups = (
        [np.atleast_1d(np.array(group) - 1) for group in ([1], [4])]
        if entry is PAIR
        else [[0, 2], [3, 4, 5]]
    )
    groups = [np.array(group) for group in groups]
    if box is not None:  # molecules that have crossed faces of the box
        state.position[:] += (
            np.array([[0, 0, 0], [1, 0, 0], [0, 1, -1], [1, -2, 0], [0, 1, 0], [1, 1, 1]])
            @ state.cell
        )
    load, tallies = engine.evaluate(state)
    arm = centres(state, groups, mass)
    stiffness = 100 * entry["stiffness_kJ_mol_A2"]
    away = np.linalg.norm(arm) - entry["distance_A"]
    tally = tallies["restraints_0"]
    assert tally.energy == pytest.approx(0.5 * stiffness * away**2, rel=1e-12)
    assert term.observed_distance(SimpleNamespace(state=state)) == pytest.approx(
        np.linalg.norm(arm), rel=1e-13
    )
    assert not load.torque_body.any()
    assert np.abs(load.force.sum(axis=0)).max() < 1e-12 * np.abs(load.force).max()
    h, scale = 1e-5, np.abs(load.force).max()
    energy = partial(energy_of, engine)
    for m in range(6):
        assert load.force[m] == pytest.approx(force_on(m, energy, state, h), abs=1e-7 * scale)
    size = max(1.0, np.abs(tally.virial).max())
    for i in range(3):
        for j in range(i + 1):  # strains that leave the cell lower triangular
            slope = virial_of(energy, state, h, (j, i))
            assert tally.virial[j, i] == pytest.approx(slope, abs=1e-6 * size)


def test_a_restrained_distance_in_a_run():
    """Columns of the log have it; the conserved energy and the momentum are conserved; a barostat
    is possible."""
    entry = {"between": [1, 2], "distance_A": 8.5, "stiffness_kJ_mol_A2": 5.0}
    other = entry | {"between": [3, 6], "distance_A": 9.5}
    stages = [
        {"duration_ps": 0.4},
        {"ensemble": "npt", "temperature_K": 90, "pressure_bar": 1, "duration_ps": 0.02},
    ]
    scene = small_scene(
        {"argon": 27},
        27.0,
        stages=stages,
        fields={"restraints": [other, entry]},
        output={"log_interval_ps": 0.01},
    )
    results = Simulation(scene).run()
    assert results.units["distance_1"] == "Å"
    state, mass = results.state, np.ones(27)
    for name, groups in (("distance_0", ([2], [5])), ("distance_1", ([0], [1]))):
        expected = np.linalg.norm(centres(state, [np.array(group) for group in groups], mass))
        assert results[name][-1] == pytest.approx(expected, abs=1e-9)
        assert np.ptp(results[name]) > 0.01
    nve = results["stage"] == 0
    assert np.abs(results["drift"][nve]).max() < 0.02 * results["kinetic"].mean()
    assert results["momentum"].max() < 1e-9


@pytest.mark.parametrize(
    ("entry", "expected"),
    [
        (PAIR | {"between": [1, 9]}, "between: molecule 9 does not exist; there are 1 to 6"),
        (PAIR | {"between": [2, 2]}, "between: a molecule is named twice"),
        (PAIR | {"between": [[1, 2], [2, 3]]}, "between: a molecule is named twice"),
        (PAIR | {"distance_A": None}, "between needs distance_A"),
        (PAIR | {"between": None}, "distance_A would have no effect without between"),
        (
            PAIR | {"stiffness_kJ_mol_A2": [1.0, 1.0, 2.0]},
            "stiffness_kJ_mol_A2 has one number for a distance",
        ),
        (PAIR | {"position_A": [1.0, 1.0, 2.0]}, "position_A would have no effect with between"),
        (PAIR | {"distance_A": 9.5}, "may come near half the smallest height of the box, 10 Å"),
        (
            PAIR | {"distance_A": 8.0, "stiffness_kJ_mol_A2": 0.01},
            "Use a larger box or a higher stiffness",
        ),
        (PAIR | {"between": [[1, 6], 2]}, "Å from its first one, more than a quarter"),
    ],
)
def test_distances_that_cannot_be(entry, expected):
    entry = {key: value for key, value in entry.items() if value is not None}
    with pytest.raises(SceneError, match=re.escape(expected)):
        build(small_scene({"argon": 6}, 20.0, fields={"restraints": [entry]}))


def test_other_engines_refuse_a_restrained_distance(tmp_path, capsys):
    text = describe(small_scene({"argon": 6}, 20.0, fields={"restraints": [PAIR]}))
    assert "distance of molecule 1 and molecule 4 restrained to 4 Å, 7 kJ/mol/Å²" in text
    for program in ("gromacs", "lammps"):
        with pytest.raises(SceneError, match="restraints"):
            export(
                small_scene({"argon": 6}, 20.0, fields={"restraints": [PAIR]}),
                program,
                tmp_path / program,
            )
