"""Input files of GROMACS: its energies of them are those of rigidmd, and every stage runs."""

import shutil
import subprocess

import numpy as np
import pytest
from support.common import built, gmx, shaken, small_scene
from support.reference import Oracle

from rigidmd.assemble.build import build
from rigidmd.engines.observables import kinetic_energies
from rigidmd.errors import SceneError
from rigidmd.features.external.force_field import force_field_of
from rigidmd.features.external.gromacs.files import TRANSLATIONS as table
from rigidmd.features.external.gromacs.files import write_gromacs
from rigidmd.features.external.verify import export
from rigidmd.mechanics.rotation import random_rotations
from rigidmd.units import KJ_PER_MOL

needs_gmx = pytest.mark.skipif(shutil.which("gmx") is None, reason="no gmx here")
#: So short that GROMACS' half a kick back and forth in its first step changes no velocity.
STAGES = [{"duration_ps": 1e-5, "timestep_fs": 0.001}]
FINE = {"electrostatics": "pme", "ewald_alpha_per_A": 0.5, "pme_order": 5, "pme_grid": [64] * 3}
PAIRS = [{"sites": ["OW", "AR"], "sigma_A": 3.3, "epsilon_kJ_mol": 0.9}]
WATER = {"spce": 12, "argon": 4}
#: Without k-vectors: energies are the values of the oracle, which compiles nothing.
PLAIN = {
    "reaction_field": {"truncation": "shift"},
    **{
        name: {"truncation": name, "electrostatics": "none"}
        for name in ("plain", "force_switch", "switch")
    },
}
WAVES = {
    "tip5p": ({"tip5p": 6, "co2_trappe": 4, "na_spce": 2, "argon": 2}, {"tail_correction": True}),
    "tip4p": ({"tip4p2005": 8, "argon": 4}, {"pairs": PAIRS}),
    "benzene": (
        {"benzene_opls": 4, "argon": 2},
        {"mixing": "geometric", "ewald_truncation": "plain"},
    ),
    "methanol": ({"methanol_trappe": 6, "argon": 2}, {}),
}


def energies(folder):
    """What GROMACS computes of the first step, kJ/mol, by its own names."""
    gmx(folder, "grompp -f 1_nve.mdp -c conf.gro -p topol.top -o first.tpr -maxwarn 1")
    gmx(folder, "mdrun -s first.tpr -nsteps 0 -nt 1 -g first.log -c last.gro")
    text = (folder / "first.log").read_text()
    lines = text[text.index("Energies (kJ/mol)") :].splitlines()[1:]
    found = {}
    for names, values in zip(lines[::2], lines[1::2], strict=False):
        if not names.strip():
            return found
        found |= zip(
            (names[k : k + 15].strip() for k in range(0, len(names), 15)),
            map(float, values.split()),
            strict=True,
        )
    return found


@needs_gmx
@pytest.mark.parametrize("case", PLAIN)
def test_truncations(case, tmp_path):
    system = build(small_scene(WATER, 16.0, forces={"cutoff_A": 6.0} | PLAIN[case], stages=STAGES))
    state = nudged(system)
    names = write_gromacs(tmp_path, force_field_of(system), state)
    assert set(names) == {path.name for path in tmp_path.iterdir()}
    found = energies(tmp_path)
    lj, coulomb = Oracle(system).energy(state.position, state.rotation)
    assert found["LJ (SR)"] == pytest.approx(lj / KJ_PER_MOL, rel=1e-5)
    charged = (coulomb + sum(system.constants.values())) / KJ_PER_MOL
    assert found.get("Coulomb (SR)", 0.0) == pytest.approx(charged, rel=1e-4)


def nudged(system):
    """The start, with molecules moved a little off their positions and rotated again."""
    rng, state = np.random.default_rng(3), system.state.copy()
    state.position[:] += 0.2 * rng.standard_normal(state.position.shape)
    state.rotation[:] = random_rotations(rng, len(state.rotation))
    return state


@needs_gmx
@pytest.mark.parametrize("case", WAVES)
def test_energies_are_those_of_rigidmd(case, tmp_path):
    counts, forces = WAVES[case]
    system, ours, state = built(
        counts, 16.0, seed=3, spread=0.2, forces={"cutoff_A": 6.0} | FINE | forces, stages=STAGES
    )
    write_gromacs(tmp_path, force_field_of(system), state)
    found = energies(tmp_path)
    tallies = ours.evaluate(state)[1]
    potential = sum(t.energy for t in tallies.values()) + sum(system.constants.values())
    potential += system.tail.energy(state.volume) if system.tail else 0.0
    assert found["LJ (SR)"] == pytest.approx(tallies["lennard_jones"].energy / KJ_PER_MOL, rel=1e-5)
    # of Coulomb energies large parts cancel: those of molecules with themselves
    parts = [value for name, value in found.items() if name.startswith(("LJ", "Coul", "Disper"))]
    assert found["Potential"] == pytest.approx(
        potential / KJ_PER_MOL, abs=1e-5 * np.abs(parts).sum()
    )
    assert found["Kinetic En."] == pytest.approx(
        sum(kinetic_energies(system, state)) / KJ_PER_MOL, rel=2e-5
    )
    moved = positions(tmp_path / "last.gro") - positions(tmp_path / "conf.gro")
    assert (
        np.abs(moved - 1.6 * np.rint(moved / 1.6)).max() < 1e-3
    )  # GROMACS has put virtual sites where they were


def positions(path):
    """Positions in a .gro, nm."""
    lines = path.read_text().splitlines()[2:-1]
    width = lines[0][20:].index(".", lines[0][20:].index(".") + 1) - lines[0][20:].index(".")
    return np.array(
        [[float(line[20 + width * k : 20 + width * (k + 1)]) for k in range(3)] for line in lines]
    )


@needs_gmx
def test_a_triclinic_box(tmp_path):
    box = {"lengths_A": [16.0, 15.0, 15.5], "angles_deg": [75.0, 80.0, 100.0]}
    scene = small_scene(
        {"spce": 12, "argon": 6}, 1.0, box=box, stages=STAGES, forces={"cutoff_A": 6.0} | FINE
    )
    system, ours, state = shaken(build(scene), 3, 0.2)
    write_gromacs(tmp_path, force_field_of(system), state)
    found, tallies = energies(tmp_path), ours.evaluate(state)[1]
    potential = (
        sum(t.energy for t in tallies.values()) + sum(system.constants.values())
    ) / KJ_PER_MOL
    assert found["Potential"] == pytest.approx(potential, abs=1e-5 * abs(found["Coul. recip."]))


@needs_gmx
def test_every_stage_runs(tmp_path):
    at = {"duration_ps": 0.02, "timestep_fs": 1.0, "temperature_K": 300.0}
    npt = at | {"ensemble": "npt", "pressure_bar": 1.0}
    stages = [
        {"duration_ps": 0.02, "timestep_fs": 1.0},
        at | {"ensemble": "nvt", "thermostat": "nose_hoover"},
        at | {"ensemble": "nvt", "thermostat": "langevin"},
        at | {"ensemble": "nvt", "temperature_K": [300.0, 320.0], "name": "warm up"},
        npt,
        npt | {"thermostat": "langevin", "pressure_coupling": "semi_isotropic"},
    ]
    scene = small_scene(
        {"tip4p2005": 20, "nitrogen": 5},
        16.0,
        stages=stages,
        forces={"cutoff_A": 6.0, "electrostatics": "pme"},
    )
    system = build(scene)
    write_gromacs(tmp_path, force_field_of(system), system.state)
    ran = subprocess.run(
        ["./run.sh", "-nt", "1"], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr[-3000:]
    assert "WARNING" not in ran.stderr
    for name in ("1_nve", "2_nvt", "3_nvt", "4_warm_up", "5_npt", "6_npt"):
        assert (tmp_path / f"{name}.gro").exists()


def test_what_gromacs_cannot_do_is_reported_at_once(tmp_path):
    stages = [
        {"duration_ps": 0.1, "ensemble": "nvt", "temperature_K": 300.0, "thermostat": "andersen"},
        {
            "duration_ps": 0.1,
            "ensemble": "npt",
            "temperature_K": 300.0,
            "pressure_bar": 1.0,
            "barostat": "monte_carlo",
        },
        {"duration_ps": 0.1, "integrator": "yoshida_4"},
    ]
    counts = {"spce": 4, "methanol_trappe": 2, "methane_opls": 2}
    system = build(
        small_scene(
            counts, 16.0, stages=stages, forces={"cutoff_A": 6.0, "truncation": "smooth_switch"}
        )
    )
    messages = " ".join(table.refusals(force_field_of(system)))
    for words in (
        "forces.truncation = 'smooth_switch'",
        "forces.reaction_field_truncation = 'smooth_switch'",
        "no rigid bodies whose mass",
        "one kind of triangle",
        "andersen",
        "monte_carlo",
        "yoshida_4",
    ):
        assert words in messages
    free = small_scene({"spce": 2}, None)
    with pytest.raises(SceneError, match=r"GROMACS: .*no box or no cutoff"):
        export(free, "gromacs", tmp_path / "there")
    assert not list(tmp_path.iterdir())


@needs_gmx
@pytest.mark.parametrize("truncation", ["plain", "shift", "force_switch"])
@pytest.mark.parametrize(
    ("counts", "error"), [({"argon": 300}, 1e-5), ({"argon": 200, "krypton": 100}, 3e-4)]
)
def test_the_tail_correction_of_points_is_that_of_gromacs(counts, error, truncation, tmp_path):
    """A molecule is not among its own neighbours. GROMACS has a mean C6 over pairs of different
    atoms of a mixture."""
    forces = {
        "cutoff_A": 9.0,
        "truncation": truncation,
        "tail_correction": True,
        "electrostatics": "none",
    }
    system = build(small_scene(counts, 22.5, forces=forces, stages=STAGES))
    write_gromacs(tmp_path, force_field_of(system), system.state)
    expected = system.tail.energy(system.space.volume) / KJ_PER_MOL
    assert energies(tmp_path)["Disper. corr."] == pytest.approx(expected, rel=error)
