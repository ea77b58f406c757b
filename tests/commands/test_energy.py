"""`rigidmd energy`: the words next to its numbers."""

import numpy as np
import pytest
from scipy.special import erfc
from support.common import observe, small_scene
from support.ewald import SALT
from support.reference import KE

from rigidmd.core.shipped import SYSTEMS
from rigidmd.run import Simulation
from rigidmd.units import BAR, KJ_PER_MOL


def test_what_energy_states_of_its_figures():
    """The words of `rigidmd energy` next to the numbers that they are about."""
    forces = {"cutoff_A": 6.0, "electrostatics": "ewald", "tail_correction": True}
    for molecules, net in (([SALT[1]], 0.0), (SALT, 6.0)):
        scene = small_scene(
            {}, None, molecules=molecules, box={"lengths_A": [13.0, 14.0, 15.0]}, forces=forces
        )
        simulation = Simulation(scene)
        found = simulation._start_energy(KJ_PER_MOL, "kJ/mol")
        said, system = found["meaning"], simulation.system
        law = system.terms["coulomb_real"].potential
        assert ("(sum of q)² of each molecule" in said["coulomb_self"]) == (net > 0)
        own = -law.alpha / np.sqrt(np.pi) * (system.of_sites(lambda m: m.charges) ** 2).sum()
        own -= 0.5 * erfc(law.alpha * 6.0) / 6.0 * net
        assert found["components"]["coulomb_self"] * KJ_PER_MOL == pytest.approx(KE * own, rel=1e-9)
        assert "less its value at the cutoff" in said["coulomb_real"]
        assert "without the tail correction" in said["virial"]
        translation = (
            observe(system, simulation.engine, simulation.state.copy()).kinetic_translation
            / KJ_PER_MOL
        )
        # with the total momentum, which is zero
        translation *= len(system.model.species) / (len(system.model.species) - 1)
        bar = (2 * translation + found["virial"]) * KJ_PER_MOL / (3 * 13 * 14 * 15) / BAR
        tail = system.tail.pressure(13 * 14 * 15) / BAR
        assert tail < -1
        assert found["pressure_bar"] - bar == pytest.approx(tail, rel=1e-6)
        assert f", and {tail:.10g} bar of the tail" in said["pressure"]


@pytest.mark.parametrize(
    ("truncation", "words"),
    [
        ("plain", "q q (1/r + k r²) up to the cutoff"),
        (
            "switch",
            "q q (1/r + k r²) up to the cutoff, less its value at the cutoff, times switch from 5.4 Å on",
        ),
        pytest.param(
            "force_switch",
            "q q (1/r + k r²) up to the cutoff, its force switched off from 5.4 Å on",
            marks=pytest.mark.soak,
        ),
    ],
)
def test_what_energy_states_of_a_reaction_field(truncation, words, printed, tmp_path):
    scene = tmp_path / "a.toml"
    scene.write_text(f"""
[box]
lengths_A = 13
[[molecules]]
model = "spce"
count = 8
[forces]
cutoff_A = 6
electrostatics = "reaction_field"
truncation = "shift"
reaction_field_truncation = "{truncation}"
tail_correction = false
[start]
temperature_K = 300
[[stages]]
duration_ps = 1
""")
    told = printed("energy", scene).out
    assert f"  coulomb: {words}\n" in told
    assert "  virial: sum of F·R over molecules\n" in told


def test_energies_are_in_total_and_per_molecule(printed):
    """Columns are aligned, and the title states that a minimisation follows."""
    water = printed("energy", SYSTEMS / "water.toml").out.splitlines()
    assert water[0] == "water: 216 molecules at the start, before the minimisation"
    header = next(line for line in water if "per molecule" in line)
    potential = next(line for line in water if line.startswith("  potential"))
    assert header.split() == ["energies", "(kJ/mol)", "total", "per", "molecule"]
    total, per_molecule = map(float, potential.split()[1:])
    assert total / 216 == pytest.approx(per_molecule, rel=1e-9)
    assert len(header) == len(potential)
    dimer = printed("energy", SYSTEMS / "water_dimer.toml").out.splitlines()
    assert dimer[0] == "water_dimer: 2 molecules at the start"
