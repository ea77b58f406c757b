"""Extreme scenes, atoms and sweeps: each ends in finite numbers or in one sentence and an exit code
for it.

Kinds of scenes and counts follow a trial from outside with about 760 attacks. What that trial
attacked besides is repeated elsewhere: texts of energies, damaged files and arbitrary input in
test_fuzz.py, disks, signals and streams in test_faults.py, checkpoints in test_checkpoint.py, names in
generated files in test_names.py.
"""

import json
import math

import ase
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rigidmd.commands.cli import main
from rigidmd.core.state import State
from rigidmd.errors import RigidMDError
from rigidmd.features.calculators.calculator import RigidMD
from rigidmd.mechanics.rotation import orthogonality_error
from rigidmd.run import Simulation
from rigidmd.scene import Scene

ARGON = """
seed = 5
threads = 1
forces.cutoff_A = 6.0
start.temperature_K = 90.0
output = { trajectory = false, figures = false, log_interval_ps = 0.01 }
[box]
lengths_A = 16.0
[[molecules]]
model = "argon"
count = 20
[[stages]]
ensemble = "nve"
duration_ps = 0.04
"""
WATER = (
    ARGON.replace('"argon"', '"spce"')
    .replace("= 90.0", "= 300.0")
    .replace("count = 20", "count = 12")
)
TOP = """
[body]
mass_kg = 0.5
inertia_kg_m2 = [1.0e-3, 1.2e-3, 0.6e-3]
pinned = true
centre_of_mass_m = [0.0, 0.0, 0.05]
[start]
euler_angles_deg = [0.0, 30.0, 0.0]
angular_velocity_body_rad_s = [0.0, 0.1, 60.0]
[gravity]
acceleration_m_s2 = [0.0, 0.0, -9.81]
[run]
timestep_s = 1e-4
duration_s = 0.02
[output]
trajectory = false
figures = false
interval_s = 0.002
"""
THERMAL = ("stages.0.ensemble=nvt", "stages.0.temperature_K=90")
PRESSED = ("stages.0.ensemble=npt", "stages.0.temperature_K=90", "stages.0.pressure_bar=1")
PME = ("forces.electrostatics=pme",)
#: One kind of attack a line: what is set in the scene.
MOLECULES = {
    "none": (ARGON, "molecules.0.count=0"),
    "one atom": (ARGON, "molecules.0.count=1"),
    "two atoms": (ARGON, "molecules.0.count=2"),
    "one atom, Langevin": (ARGON, "molecules.0.count=1", *THERMAL, "stages.0.thermostat=langevin"),
    "one atom, Andersen": (ARGON, "molecules.0.count=1", *THERMAL, "stages.0.thermostat=andersen"),
    "one atom, Nose-Hoover": (
        ARGON,
        "molecules.0.count=1",
        *THERMAL,
        "stages.0.thermostat=nose_hoover",
    ),
    "one atom, a barostat": (ARGON, "molecules.0.count=1", *PRESSED),
    "one water": (WATER, "molecules.0.count=1"),
    "one water, PME": (WATER, "molecules.0.count=1", *PME),
    "two waters, PME, Langevin": (
        WATER,
        "molecules.0.count=2",
        *PME,
        *THERMAL,
        "stages.0.thermostat=langevin",
    ),
    "two waters, a barostat": (WATER, "molecules.0.count=2", *PRESSED),
    "a negative seed": (ARGON, "seed=-1"),
    "the largest seed": (ARGON, "seed=18446744073709551615"),
    "a seed of 65 bits": (ARGON, "seed=18446744073709551616"),
    "a duration of no whole steps": (ARGON, "stages.0.duration_ps=0.0037"),
    "a duration below a step": (ARGON, "stages.0.duration_ps=0.0001"),
    "no duration": (ARGON, "stages.0.duration_ps=0"),
    "steps of 1e-12 fs": (ARGON, "stages.0.timestep_fs=1e-12", "stages.0.duration_ps=1e-12"),
    "steps of 1e-20 fs": (
        ARGON,
        *THERMAL,
        "stages.0.timestep_fs=1e-20",
        "stages.0.duration_ps=4e-23",
    ),
    "steps of a picosecond": (ARGON, "stages.0.timestep_fs=1000", "stages.0.duration_ps=4"),
    "a log below the step": (ARGON, "output.log_interval_ps=1e-6"),
    "a log beyond the run": (ARGON, "output.log_interval_ps=1e6"),
    "a needle of a box": (ARGON, "box.lengths_A=[20.0, 20.0, 4000.0]"),
    "a thin box": (ARGON, "box.lengths_A=[20.0, 20.0, 0.6]"),
    "a cutoff beyond half the box": (ARGON, "forces.cutoff_A=9.0"),
    "a cutoff below the atoms": (ARGON, "forces.cutoff_A=0.9"),
    "a million kelvin": (ARGON, "start.temperature_K=1e6"),
    "a nanokelvin": (ARGON, "start.temperature_K=1e-9"),
    "no motion": (ARGON, "start.temperature_K=0"),
    "all frozen": (ARGON, "molecules.0.frozen=true"),
    "all frozen, a thermostat": (ARGON, "molecules.0.frozen=true", *THERMAL),
    "light atoms": (ARGON, "molecules.0.masses_u.Ar=1e-6"),
    "heavy atoms": (ARGON, "molecules.0.masses_u.Ar=1e6"),
    "weightless atoms": (ARGON, "molecules.0.masses_u.Ar=0"),
    "too dense": (ARGON, "box.lengths_A=", "box.density_g_cm3=12"),
    "very thin gas": (ARGON, "box.lengths_A=", "box.density_g_cm3=1e-9"),
    "no interaction": (ARGON, "forces.lennard_jones=false"),
}
BODIES = {
    "tiny moments": ("body.inertia_kg_m2=[1e-30, 1e-30, 1e-30]",),
    "huge moments": ("body.inertia_kg_m2=[1e90, 1e90, 1e90]",),
    "moments of a rod": ("body.inertia_kg_m2=[1e-3, 1e-3, 0.0]",),
    "moments of a nearly thin rod": ("body.inertia_kg_m2=[1e-3, 1e-3, 1e-18]",),
    "moments of no body": ("body.inertia_kg_m2=[1e-3, 1e-3, 1e-2]",),
    "a point": ("body.inertia_kg_m2=[0.0, 0.0, 0.0]",),
    "negative moments": ("body.inertia_kg_m2=[-1e-3, 1e-3, 1e-3]",),
    "a tiny mass": ("body.mass_kg=1e-90",),
    "a huge mass": ("body.mass_kg=1e90",),
    "no mass": ("body.mass_kg=0",),
    "a fast spin": ("start.angular_velocity_body_rad_s=[0.0, 0.0, 1e8]",),
    "a spin beyond light": ("start.angular_velocity_body_rad_s=[0.0, 0.0, 1e30]",),
    "no spin": ("start.angular_velocity_body_rad_s=[0.0, 0.0, 0.0]",),
    "upright": ("start.euler_angles_deg=[0.0, 0.0, 0.0]",),
    "hanging": ("start.euler_angles_deg=[0.0, 180.0, 0.0]",),
    "a picosecond": ("run.duration_s=1e-12", "run.timestep_s=1e-13", "output.interval_s=1e-12"),
    "ages": ("run.duration_s=1e12", "run.timestep_s=1e11", "output.interval_s=1e11"),
    "1e12 steps, sampled": ("run.duration_s=1e8", "output.interval_s=1e-4"),
    "no gravity": ("gravity.acceleration_m_s2=[0.0, 0.0, 0.0]",),
    "crushing gravity": ("gravity.acceleration_m_s2=[0.0, 0.0, -1e30]",),
    "thick oil": ("friction.viscous_N_m_s=[1e30, 1e30, 1e30]",),
    "negative friction": ("friction.viscous_N_m_s=[-1.0, 0.0, 0.0]",),
    "dry friction": ("friction.dry_N_m=[1e30, 1e30, 1e30]",),
    "stiff, radau": ("friction.viscous_N_m_s=[1e6, 1e6, 1e6]", "run.integrator=radau"),
    "stiff, dop853": ("friction.viscous_N_m_s=[1e6, 1e6, 1e6]", "run.integrator=dop853"),
    "stiff, rk4": ("friction.viscous_N_m_s=[1e6, 1e6, 1e6]", "run.integrator=rk4"),
    "no interval": ("output.interval_s=0",),
    "steps of 1e-300 s": (
        "run.timestep_s=1e-300",
        "run.duration_s=1e-299",
        "output.interval_s=1e-5",
    ),
    "an interval of no whole steps": ("output.interval_s=0.00033",),
    "a step beyond the run": ("run.timestep_s=1",),
    "an angle beyond a circle": ("start.euler_angles_deg=[1e6, 3e5, -1e9]",),
}


def outcome(command: list[str], capsys) -> tuple[int, str]:
    """Exit code and standard error of a command: 0; 1 if the run stopped; 2 if the input was
    rejected; 75 out of time."""
    code = main(command)
    said = capsys.readouterr()
    assert code in (0, 1, 2, 75), said.err
    assert "Traceback" not in said.err + said.out
    if code in (1, 2):
        assert said.err.lstrip().startswith("rigidmd: ") or "\nrigidmd: " in said.err, said.err
    return code, said.err


def is_finite(value: object) -> bool:
    """Whether a value of JSON holds no infinite number."""
    if isinstance(value, dict):
        return all(map(is_finite, value.values()))
    if isinstance(value, list):
        return all(map(is_finite, value))
    return not isinstance(value, float) or math.isfinite(value)


def run_of(text: str, overrides: tuple[str, ...], folder, capsys) -> None:
    """Run a scene: its summary is finite, or a message stands in its position."""
    scene = folder / "scene.toml"
    scene.write_text(text)
    sets = [word for override in overrides for word in ("--set", override)]
    checked, _ = outcome(["check", str(scene), *sets], capsys)
    code, said = outcome(
        ["run", str(scene), *sets, "-o", str(folder / "run"), "--walltime", "0:00:40"], capsys
    )
    assert code == 2 or checked == 0, said  # what `check` rejects does not run
    if code in (0, 75):
        assert is_finite(json.loads((folder / "run" / "summary.json").read_text()))
    else:
        assert not (folder / "run" / "summary.json").exists()


@pytest.mark.soak
@pytest.mark.parametrize("text", [ARGON, WATER, TOP], ids=["argon", "water", "top"])
def test_the_scenes_run_without_an_attack(text, capsys, tmp_path):
    run_of(text, (), tmp_path, capsys)
    assert (tmp_path / "run" / "summary.json").exists()


@pytest.mark.soak
@pytest.mark.parametrize("attack", MOLECULES)
def test_extreme_scenes_of_molecules(attack, capsys, tmp_path):
    text, *overrides = MOLECULES[attack]
    run_of(text, tuple(overrides), tmp_path, capsys)


@pytest.mark.soak
@pytest.mark.parametrize("attack", BODIES)
def test_extreme_scenes_of_bodies(attack, capsys, tmp_path):
    run_of(TOP, BODIES[attack], tmp_path, capsys)


def waters() -> ase.Atoms:
    """Two waters of SPC/E in a box."""
    half = math.radians(109.47) / 2
    arm = np.array(
        [[0.0, 0, 0], [math.sin(half), math.cos(half), 0], [-math.sin(half), math.cos(half), 0]]
    )
    second = arm + np.array([10.0, 10.0, 9.0])
    places = np.concatenate([arm + 5.0, second])
    return ase.Atoms("OHHOHH", places, cell=[15.0] * 3, pbc=True)


def changed(**arrays) -> ase.Atoms:
    """The waters with one number of each array replaced."""
    atoms = waters()
    for name, value in arrays.items():
        held = atoms.arrays[name].astype(float)
        held[(1, 0)[: held.ndim]] = value
        atoms.arrays[name] = held
    return atoms


def with_cell(cell, pbc=True) -> ase.Atoms:
    atoms = waters()
    atoms.set_cell(cell)
    atoms.pbc = pbc
    return atoms


def coincident() -> ase.Atoms:
    atoms = waters()
    atoms.positions[3:] = atoms.positions[:3]
    return atoms


def _massless() -> ase.Atoms:
    atoms = waters()
    atoms.set_masses([np.nan] * 6)
    return atoms


ATOMS = {
    "a position that is no number": lambda: changed(positions=np.nan),
    "an infinite position": lambda: changed(positions=np.inf),
    "an atom light years away": lambda: changed(positions=1e12),
    "no cell, periodic": lambda: with_cell(np.zeros((3, 3))),
    "a cell that is no number": lambda: with_cell([np.nan, 15.0, 15.0]),
    "a left-handed cell": lambda: with_cell(np.diag([15.0, 15.0, -15.0])),
    "negative edges": lambda: with_cell(np.diag([-15.0, -15.0, -15.0])),
    "a thin cell": lambda: with_cell([15.0, 15.0, 0.5]),
    "a skewed cell": lambda: with_cell([[15.0, 0, 0], [14.9, 1.0, 0], [0, 0, 15.0]]),
    "periodic along one axis": lambda: with_cell([15.0] * 3, (True, False, False)),
    "molecules in one place": coincident,
    "no atoms": ase.Atoms,
    "another element": lambda: ase.Atoms("SHHOHH", waters().positions, cell=[15.0] * 3, pbc=True),
    "half a molecule": lambda: waters()[:5],
    "masses that are no numbers": _massless,
    "a cell beyond numbers": lambda: with_cell([1e200] * 3),
    "not periodic": lambda: with_cell([15.0] * 3, False),
    "molecules in the wrong order": lambda: waters()[[1, 0, 2, 5, 3, 4]],
}


@pytest.mark.soak
@pytest.mark.parametrize("attack", ATOMS)
def test_extreme_atoms_of_the_calculator(attack):
    """Energy, forces and stress are finite, or one sentence states what is wrong."""
    atoms = ATOMS[attack]()
    atoms.calc = RigidMD("spce", cutoff_A=5.0)
    try:
        found = [atoms.get_potential_energy(), *atoms.get_forces().ravel()]
        found += list(atoms.get_stress()) if atoms.pbc.all() else []
    except RigidMDError as error:
        assert str(error).startswith("atoms: ") and len(str(error)) < 2000
    else:
        assert np.isfinite(found).all()


AXES = [
    "seed",
    "seed=",
    "seed=1",
    "seed=1..",
    "seed=..3",
    "seed=3..1",
    "seed=1..1e9",
    "seed=1,1",
    "seed=1.5,2",
    "seed=a,b",
    "nowhere=1,2",
    "stages.9.duration_ps=0.01,0.02",
    "stages=1,2",
    "box.lengths_A=[1, 2",
    "=1,2",
    "seed=-1,2",
    "start.temperature_K=nan,90",
    "start.temperature_K=inf,90",
    "molecules.0.model=argon,nothing",
]


@pytest.mark.soak
@pytest.mark.parametrize("axis", AXES)
def test_odd_axes_of_a_sweep(axis, capsys, tmp_path):
    """Rejected before the first point with nothing written, or every point ends."""
    (tmp_path / "scene.toml").write_text(ARGON)
    folder = tmp_path / "sweep"
    code, said = outcome(
        ["sweep", str(tmp_path / "scene.toml"), "--set", axis, "-o", str(folder)], capsys
    )
    if code:
        assert not folder.exists() and axis.partition("=")[0] in said
    else:
        assert (folder / "sweep.csv").exists()


FEWER = settings(max_examples=25, deadline=None, derandomize=True, database=None)


def site(k: int):
    return st.fixed_dictionaries(
        {
            "name": st.just(f"S{k}"),
            "mass_u": st.sampled_from([0.0, 1.0, 16.0, 1e4]),
            "position_A": st.tuples(*[st.sampled_from([0.0, 1e-6, 0.5, -1.0, 4.0])] * 3).map(list),
            "charge_e": st.sampled_from([0.0, 0.4, -0.4]),
            "sigma_A": st.sampled_from([0.1, 3.0]),
            "epsilon_K": st.sampled_from([0.0, 1.0, 100.0]),
        }
    )


molecules = st.one_of(
    st.sampled_from(["argon", "nitrogen", "spce", "tip4p2005"]).map(lambda name: {"model": name}),
    st.integers(1, 3)
    .flatmap(lambda n: st.tuples(*map(site, range(n))))
    .map(lambda s: {"name": "own", "sites": list(s)}),
)
stages = st.fixed_dictionaries(
    {
        "timestep_fs": st.sampled_from([0.01, 1.0, 10.0, 1000.0]),
        "integrator": st.sampled_from(["velocity_verlet", "pefrl", "srkn_4", "kahan_li_6"]),
        "ensemble": st.sampled_from(["nve", "nvt"]),
    }
)
scenes = st.fixed_dictionaries(
    {
        "seed": st.integers(0, 100),
        "box": st.sampled_from(
            [
                {"lengths_A": 12.0},
                {"lengths_A": [12.0, 30.0, 12.0]},
                {"lengths_A": 5.0},
                {"density_g_cm3": 1.0},
            ]
        ),
        "molecules": st.tuples(molecules, st.sampled_from([1, 2, 20])).map(
            lambda one: [one[0] | {"count": one[1]}]
        ),
        "forces": st.fixed_dictionaries(
            {
                "cutoff_A": st.sampled_from([1.0, 5.0, 6.0]),
                "truncation": st.sampled_from(
                    ["plain", "shift", "force_shift", "force_switch", "switch", "smooth_switch"]
                ),
            }
        ),
        "start": st.sampled_from([0.0, 300.0, 1e6]).map(lambda t: {"temperature_K": t}),
        "stages": stages.map(lambda s: [s]),
    }
)


@pytest.mark.soak
@FEWER
@given(scenes)
def test_any_small_scene_runs_ten_steps_or_is_refused_with_a_message(data):
    runs_or_is_refused(data)


ONE_KIND = scenes.map(
    lambda data: data | {"molecules": [{"model": "spce", "count": data["molecules"][0]["count"]}]}
).map(
    lambda data: (
        data
        | {"stages": [data["stages"][0] | {"integrator": "velocity_verlet", "ensemble": "nve"}]}
    )
)


@FEWER
@given(ONE_KIND)
def test_any_small_scene_of_one_kind_runs_ten_steps_or_is_refused_with_a_message(data):
    """As above, of scenes that compile to the same code."""
    runs_or_is_refused(data)


def runs_or_is_refused(data):
    stage = dict(data["stages"][0])
    stage["duration_ps"] = 10 * stage["timestep_fs"] / 1000
    if stage["ensemble"] == "nvt":
        stage["temperature_K"] = 300.0
    whole = data | {"stages": [stage], "output": {"trajectory": False, "log_interval_ps": 1e3}}
    try:
        with np.errstate(all="ignore"):
            results = Simulation(Scene.from_dict(whole)).run()
    except RigidMDError as error:
        assert str(error)
        return
    assert len(results.samples.rows) == 2
    assert results.samples.rows[-1].step == 10
    assert isinstance(results.state, State)
    for array in results.state:
        assert np.isfinite(array).all()
    assert np.isfinite(results["energy"]).all()
    assert orthogonality_error(results.state.rotation) < 1e-12
