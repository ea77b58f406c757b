"""Settings of thermostats and barostats as other engines read them, each in the units of that
engine.

No engine runs here: the files that are written are read back. What the numbers mean is in the
manuals: GROMACS tau-t of sd is the inverse of the friction, of nose-hoover a period, of v-rescale a
time constant, all in ps and bar; LAMMPS' Langevin has a damping time, the inverse of the friction,
and its chains and pistons the inverse of an angular frequency, in fs and atm; OpenMM has frictions
and frequencies in 1/ps, and pressures in bar.
"""

import json
import subprocess
import sys
from dataclasses import replace
from math import pi
from typing import NamedTuple

import numpy as np
import pytest
from support.common import ROOT, shaken, small_scene

from rigidmd.assemble.build import build
from rigidmd.assemble.time_step import MIXED_ERROR
from rigidmd.core.programs import programs
from rigidmd.errors import SceneError
from rigidmd.features.external.force_field import force_field_of
from rigidmd.features.external.gromacs.files import write_gromacs
from rigidmd.features.external.lammps import files
from rigidmd.features.external.openmm import engine
from rigidmd.features.external.openmm.files import write_openmm
from rigidmd.features.external.openmm.system import Group, integration_groups

COUNTS = {"spce": 6, "nitrogen": 4}
NVT = {"ensemble": "nvt", "temperature_K": 310.0, "duration_ps": 0.4, "timestep_fs": 2.0}
WARMING = NVT | {"temperature_K": [280.0, 320.0]}
LANGEVIN = {
    "thermostat": "langevin",
    "friction_translation_per_ps": 5.0,
    "integrator": "velocity_verlet",
}
CHAINS = {"thermostat": "nose_hoover", "thermostat_time_ps": 0.7, "nose_hoover_links": 4}
RESCALING = {"thermostat_time_ps": 0.3}
NPT = NVT | {"ensemble": "npt", "pressure_bar": 250.0}


def drawn(*stages, counts=COUNTS, tail=False, **sections):
    forces = {"cutoff_A": 5.0, "truncation": "shift", "tail_correction": tail}
    return force_field_of(
        build(small_scene(counts, 13.0, stages=list(stages), **{"forces": forces} | sections))
    )


# GROMACS


def settings(folder, *stages, **sections):
    """The .mdp file of the only stage, as key -> text."""
    own = drawn(*stages, **sections)
    write_gromacs(folder, own, own.system.state)
    (path,) = folder.glob("*.mdp")
    lines = (line.split("=") for line in path.read_text().splitlines())
    return {key.strip(): value.strip() for key, value in lines}


@pytest.mark.parametrize(
    ("stage", "coupling", "integrator", "time"),
    [
        (LANGEVIN, "no", "sd", 1 / 5.0),
        (CHAINS, "nose-hoover", "md-vv", 0.7),
        (RESCALING, "v-rescale", "md", 0.3),
    ],
    ids=["langevin", "nose_hoover", "velocity_rescaling"],
)
def test_gromacs_has_the_time_of_each_thermostat(stage, coupling, integrator, time, tmp_path):
    found = settings(tmp_path, NVT | stage)
    assert (found["tcoupl"], found["integrator"], found["tc-grps"]) == (
        coupling,
        integrator,
        "System",
    )
    assert float(found["tau-t"]) == pytest.approx(time, rel=1e-9)
    assert float(found["ref-t"]) == 310.0
    assert (float(found["dt"]), int(found["nsteps"])) == (0.002, 200)
    assert found["pcoupl"] == "no"
    assert found.get("nh-chain-length") == ("4" if stage is CHAINS else None)
    assert found["comm-mode"] == ("None" if stage is LANGEVIN else "Linear")


def test_gromacs_has_no_thermostat_at_constant_energy(tmp_path):
    found = settings(tmp_path, {"duration_ps": 0.4})
    assert (found["tcoupl"], found["pcoupl"], found["integrator"]) == ("no", "no", "md-vv")


def test_gromacs_warms_from_one_temperature_to_the_other(tmp_path):
    found = settings(tmp_path, WARMING | RESCALING)
    assert [float(value) for value in found["annealing-temp"].split()] == [280.0, 320.0]
    assert [float(value) for value in found["annealing-time"].split()] == [0.0, 0.4]  # ps
    assert (found["annealing"], found["annealing-npoints"]) == ("single", "2")
    assert float(found["ref-t"]) == 280.0


@pytest.mark.parametrize(
    ("pressure", "coupling", "expected"),
    [
        (250.0, "isotropic", [250.0]),
        ([250.0, 250.0, 400.0], "semi_isotropic", [250.0, 400.0]),
    ],
)
def test_gromacs_has_the_pressure_of_each_direction(pressure, coupling, expected, tmp_path):
    stage = NPT | {
        "pressure_bar": pressure,
        "pressure_coupling": coupling,
        "barostat_time_ps": 1.7,
        "compressibility_per_bar": 8e-5,
    }
    found = settings(tmp_path, stage | RESCALING)
    assert [float(value) for value in found["ref-p"].split()] == expected
    assert [float(value) for value in found["compressibility"].split()] == [8e-5] * len(expected)
    assert (found["pcoupl"], found["pcoupltype"]) == ("C-rescale", coupling.replace("_", ""))
    assert float(found["tau-p"]) == 1.7
    assert float(found["tau-t"]) == 0.3


def test_gromacs_takes_momentum_out_and_writes_at_the_intervals_of_the_scene(tmp_path):
    output = {"log_interval_ps": 0.03, "trajectory_interval_ps": 0.05}
    found = settings(tmp_path, NVT, run={"remove_momentum_interval_ps": 0.02}, output=output)
    assert [
        int(found[key]) for key in ("nstcomm", "nstlog", "nstenergy", "nstxout-compressed")
    ] == [10, 15, 15, 25]


def test_gromacs_has_lengths_in_nm(tmp_path):
    forces = {
        "cutoff_A": 5.0,
        "truncation": "switch",
        "switch_start_A": 4.2,
        "electrostatics": "none",
    }
    found = settings(tmp_path, NVT, counts={"argon": 20}, forces=forces)
    assert [float(found[key]) for key in ("rlist", "rvdw", "rcoulomb", "rvdw-switch")] == [
        0.5,
        0.5,
        0.5,
        0.42,
    ]


def test_gromacs_has_a_site_off_the_plane_of_its_masses(tmp_path):
    """For a lone pair of TIP5P: r = r_i + a r_ij + b r_ik + c r_ij x r_ik, c in 1/nm."""
    own = drawn(NVT, counts={"tip5p": 20})
    write_gromacs(tmp_path, own, own.system.state)
    block = (tmp_path / "topol.top").read_text().split("[ virtual_sites3 ]\n")[1].split("\n\n")[0]
    places = own.system.species[0].positions_body / 10  # nm
    rows = [line.split() for line in block.splitlines()]
    assert [row[4] for row in rows] == ["4", "4"]
    for row in rows:
        site, i, j, k = (places[int(number) - 1] for number in row[:4])
        a, b, c = map(float, row[5:])
        assert abs(c) > 1
        assert i + a * (j - i) + b * (k - i) + c * np.cross(j - i, k - i) == pytest.approx(
            site, abs=1e-9
        )


# LAMMPS

#: kcal/mol/Å³ in atm is another way to the same number: 1 atm = 1.01325 bar.
ATM = 1 / 1.01325


def commands(stage, **sections):
    """Fixes of a stage: name -> words behind its style."""
    lines = files.fixes(drawn(stage, **sections), 0)
    return {line.split()[1]: line.split()[3:] for line in lines}


def after(words, key, count):
    """The numbers that follow a keyword."""
    at = words.index(key) + 1
    return [float(word) for word in words[at : at + count]]


@pytest.mark.parametrize(
    "counts", [{"spce": 6}, {"argon": 6}, {"spce": 6, "argon": 6}], ids="-".join
)
def test_lammps_has_the_damping_time_of_langevin(counts):
    found = commands(WARMING | LANGEVIN, counts=counts)
    if "spce" in counts:
        assert found["bodies"][:2] == ["rigid/small", "molecule"]
        assert after(found["bodies"], "langevin", 3) == [
            280.0,
            320.0,
            pytest.approx(1000 / 5.0),
        ]  # fs
    if "argon" in counts:
        assert found["points"] == ["nve"]
        assert after(found["points_bath"], "langevin", 3) == [
            280.0,
            320.0,
            pytest.approx(1000 / 5.0),
        ]
    if len(counts) == 2:
        seeds = [
            int(after(words, "langevin", 4)[3]) for name, words in found.items() if name != "points"
        ]
        assert len(set(seeds)) == 2


@pytest.mark.parametrize("counts", [{"spce": 6}, {"argon": 6}], ids="-".join)
def test_lammps_has_the_period_of_chains(counts):
    (words,) = commands(WARMING | CHAINS, counts=counts).values()
    assert words[0] == ("rigid/nvt/small" if "spce" in counts else "nvt")
    assert after(words, "temp", 3) == [280.0, 320.0, pytest.approx(1000 * 0.7 / (2 * pi))]
    assert after(words, "tparam" if "spce" in counts else "tchain", 1) == [4.0]


@pytest.mark.parametrize("counts", [{"spce": 6}, {"argon": 6}], ids="-".join)
@pytest.mark.parametrize("ensemble", ["npt", "nph"])
@pytest.mark.parametrize("tail", [False, True])
def test_lammps_has_pressures_in_atm_less_that_of_the_tail(counts, ensemble, tail):
    """Its forces have no tail: a pressure P is that of its forces at P less the tail's."""
    stage = NPT | CHAINS if ensemble == "npt" else {"ensemble": "nph", "duration_ps": 0.4}
    stage = stage | {"pressure_bar": [100.0, 300.0], "barostat_time_ps": 1.7}
    own = drawn(stage, counts=counts, tail=tail)
    (line,) = files.fixes(own, 0)
    words = line.split()[3:]
    beyond = own.system.tail.pressure(13.0**3) / 6.02214076e-3 if tail else 0.0  # bar
    assert (beyond < -1) == tail
    first, last, damping = after(words, "iso", 3)
    assert first == pytest.approx((100.0 - beyond) * ATM, rel=1e-7)
    assert last == pytest.approx((300.0 - beyond) * ATM, rel=1e-7)
    assert damping == pytest.approx(1700.0)
    style = f"rigid/{ensemble}/small" if "spce" in counts else ensemble
    assert words[0] == style and ("temp" in words) == (ensemble == "npt")


def test_lammps_has_a_pressure_along_each_axis():
    stage = (
        NPT | CHAINS | {"pressure_bar": [100.0, 200.0, 300.0], "pressure_coupling": "anisotropic"}
    )
    words = commands(stage, counts={"spce": 6})["bodies"]
    for axis, pressure in zip("xyz", (100.0, 200.0, 300.0), strict=True):
        assert after(words, axis, 3) == pytest.approx([pressure * ATM, pressure * ATM, 1000.0])
    assert words[words.index("couple") + 1] == "none"


def test_lammps_has_steps_in_fs():
    text = files.input_script(
        drawn(NVT | LANGEVIN, output={"log_interval_ps": 0.03, "trajectory": False})
    )
    lines = [line.split() for line in text.splitlines()]
    assert ["timestep", "2.0"] in lines and ["run", "200"] in lines and ["thermo", "15"] in lines


# OpenMM


def made(folder, *stages, **sections):
    """Integrators and what else acts, read back from what is written for OpenMM."""
    mm = pytest.importorskip("openmm")
    own = drawn(*stages, engine={"name": "openmm"}, **sections)
    write_openmm(folder, own, own.system.state)
    read = [
        mm.XmlSerializer.deserialize(path.read_text()) for path in sorted(folder.glob("[bi]*.xml"))
    ]
    integrators = [one for one in read if isinstance(one, mm.Integrator)]
    return integrators, [one for one in read if not isinstance(one, mm.Integrator)]


def in_units(quantity, name):
    import openmm.unit

    unit = openmm.unit.picosecond**-1 if name == "1/ps" else getattr(openmm.unit, name)
    return quantity.value_in_unit(unit)


def test_openmm_has_the_friction_of_langevin(tmp_path):
    (integrator,), others = made(tmp_path, NVT | LANGEVIN)
    assert in_units(integrator.getFriction(), "1/ps") == pytest.approx(5.0)
    assert in_units(integrator.getTemperature(), "kelvin") == 310.0
    assert in_units(integrator.getStepSize(), "femtosecond") == pytest.approx(2.0)
    assert others == []


def test_openmm_has_the_period_of_chains(tmp_path):
    """A chain of frequency w has the mass g kT/w²: w is 2 pi over the period."""
    (integrator,), others = made(tmp_path, NVT | CHAINS)
    assert in_units(integrator.getCollisionFrequency(), "1/ps") == pytest.approx(2 * pi / 0.7)
    assert in_units(integrator.getTemperature(), "kelvin") == 310.0
    assert integrator.getThermostat().getChainLength() == 4
    assert [type(other).__name__ for other in others] == [
        "CMMotionRemover"
    ]  # so that it counts three less


@pytest.mark.parametrize("thermostat", [LANGEVIN, CHAINS], ids=["langevin", "nose_hoover"])
def test_openmm_has_the_pressure_and_the_temperature_of_its_barostat(thermostat, tmp_path):
    stage = NPT | thermostat | {"barostat": "monte_carlo", "barostat_interval_ps": 0.05}
    _, others = made(tmp_path, stage)
    (barostat,) = [other for other in others if "Barostat" in type(other).__name__]
    assert in_units(barostat.getDefaultPressure(), "bar") == pytest.approx(250.0)
    assert in_units(barostat.getDefaultTemperature(), "kelvin") == 310.0
    assert barostat.getFrequency() == 25  # steps of 2 fs


def test_openmm_has_the_energy_of_the_tail_at_its_volume(tmp_path):
    """A formula of the volume v in nm³ that gives kJ/mol."""
    mm = pytest.importorskip("openmm")
    own = drawn(NVT | LANGEVIN, tail=True, engine={"name": "openmm"})
    write_openmm(tmp_path, own, own.system.state)
    whole = mm.XmlSerializer.deserialize((tmp_path / "system.xml").read_text())
    (tail,) = [force for force in whole.getForces() if isinstance(force, mm.CustomVolumeForce)]
    strength, rest = tail.getEnergyFunction().split("/v+")
    constant = float(rest.strip("()"))
    assert constant > 1e-3  # of sites of one molecule, with shifted energies
    for edge in (13.0, 14.0):  # Å
        expected = own.system.tail.energy(edge**3) / 100  # u Å²/ps² in kJ/mol
        assert expected < -0.1
        assert float(strength) / (edge / 10) ** 3 + constant == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    "charges",
    [
        {"electrostatics": "reaction_field", "reaction_field_truncation": "plain"},
        {"electrostatics": "pme", "ewald_truncation": "plain", "ewald_accuracy": 1e-4},
    ],
)
def test_openmm_compares_continuous_energies_for_its_barostat(charges, tmp_path):
    """Forces move molecules; a barostat compares all energies of the system, with steps at cutoffs
    and the tail."""
    mm = pytest.importorskip("openmm")
    forces = {"cutoff_A": 5.0, "truncation": "plain", "tail_correction": True} | charges
    groups = []
    for stage in (NVT | LANGEVIN, NPT | LANGEVIN | {"barostat": "monte_carlo"}):
        view = drawn(stage, engine={"name": "openmm"}, forces=forces)
        groups.append(integration_groups(view.scene.stages[0]))
    write_openmm(tmp_path, view, view.system.state)
    whole = mm.XmlSerializer.deserialize((tmp_path / "system.xml").read_text())
    present = {force.getForceGroup() for force in whole.getForces()}
    steps = {Group.STEP_LENNARD_JONES, Group.STEP_COULOMB, Group.TAIL}
    assert steps <= present
    assert groups[0] == {Group.LENNARD_JONES, Group.COULOMB_PAIRS, Group.RECIPROCAL}
    assert groups[1] == groups[0] | steps
    assert present <= groups[1]


def test_openmm_has_an_integrator_for_each_stage(tmp_path):
    integrators, _ = made(
        tmp_path, NVT | LANGEVIN, {"duration_ps": 0.1}, NVT | LANGEVIN | {"timestep_fs": 1.0}
    )
    kinds = [type(one).__name__ for one in integrators]
    assert sorted(kinds) == [
        "CustomIntegrator",
        "LangevinMiddleIntegrator",
        "LangevinMiddleIntegrator",
    ]
    seeds = {one.getRandomNumberSeed() for one in integrators if hasattr(one, "getFriction")}
    assert len(seeds) == 2


# what no table has


class Stranger(NamedTuple):
    """A potential, or a term."""

    strength: float = 1.0


class StrangeField(NamedTuple):
    changes_momentum: bool = True


def with_strange(system, what):
    """A system with something that no engine can know."""
    stage, scene, terms = system.scene.stages[0], system.scene, dict(system.terms)
    if what in ("thermostat", "barostat"):
        scene = scene.model_copy(update={"stages": (stage.model_copy(update={what: "made_up"}),)})
    elif what == "truncation":
        scene = scene.model_copy(
            update={"forces": scene.forces.model_copy(update={"truncation": "made_up"})}
        )
    elif what == "potential":  # it took the name of the Coulomb forces of rigidmd
        terms["coulomb"] = terms["coulomb"]._replace(potential=Stranger())
    else:
        terms[what] = {"field": StrangeField(), "term": Stranger()}[what]
    return replace(system, scene=scene, terms=terms)


@pytest.mark.parametrize("name", programs())
@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("thermostat", "stages.0.thermostat = 'made_up': {}"),
        ("barostat", "stages.0.barostat = 'made_up': {}"),
        ("truncation", "forces.truncation = 'made_up': {} has plain, shift, "),
        ("potential", "coulomb: the pair potential Stranger has no translation for {}"),
        ("field", "field: a field has no translation for {}"),
        ("term", "term: the term Stranger has no translation for {}"),
    ],
)
def test_what_no_table_has_is_refused(name, what, message):
    stage = NPT | {"thermostat": "langevin", "integrator": "velocity_verlet"}
    system = build(
        small_scene(
            {"spce": 4}, 13.0, stages=[stage], forces={"cutoff_A": 5.0, "truncation": "shift"}
        )
    )
    program = programs()[name]
    table = program.load(program.translations)
    found = list(table.refusals(force_field_of(with_strange(system, what))))
    assert any(message.format(program.title) in line for line in found), found
    new = set(found) - set(table.refusals(force_field_of(system)))
    assert new and all("made_up" in line or "has no translation" in line for line in new), new


@pytest.mark.parametrize("name", programs())
def test_the_soft_core_of_a_coupling_is_refused_by_its_name(name):
    coupling = {"species": "argon", "lambda": 0.4}
    system = build(small_scene({"argon": 20}, 20.0, coupling=coupling))
    program = programs()[name]
    found = list(program.load(program.translations).refusals(force_field_of(system)))
    refusal = f"soft core: the soft core of [coupling] has no translation for {program.title}"
    assert any(refusal in line for line in found), found
    assert not any("CustomPotential" in line for line in found)


# the precision of OpenMM


@pytest.mark.parametrize(
    ("platform", "precision", "properties"),
    [
        ("CUDA", None, {"Precision": "mixed"}),
        ("OpenCL", "double", {"Precision": "double"}),
        ("HIP", "single", {"Precision": "single"}),
        ("Reference", None, {}),
        ("CPU", None, {"Threads": "3"}),
    ],
)
def test_a_gpu_has_mixed_precision_unless_the_scene_states_otherwise(
    platform, precision, properties
):
    assert engine.properties_of(platform, precision, 3) == properties
    given = {"name": "openmm", "platform": platform} | (
        {"precision": precision} if precision else {}
    )
    choice = small_scene({"argon": 2}, 20.0, engine=given).engine
    assert choice.options == {"platform": platform, "precision": precision}
    assert ("precision" in choice.title) == ("Precision" in properties)


def test_a_platform_with_one_precision_has_no_other():
    for platform, precision in (("CPU", "double"), ("Reference", "single")):
        with pytest.raises(
            SceneError, match=f"precision = '{precision}' is for GPUs: the platform {platform} has"
        ):
            small_scene(
                {"argon": 2},
                20.0,
                engine={"name": "openmm", "platform": platform, "precision": precision},
            )
    with pytest.raises(
        SceneError,
        match=r"precision would have no effect with engine.name = 'lammps'. It is for openmm",
    ):
        small_scene({"argon": 2}, 20.0, engine={"name": "lammps", "precision": "mixed"})


def test_the_error_of_mixed_precision_is_the_one_in_the_manual():
    assert f"forces to {MIXED_ERROR:.0e})" in (ROOT / "rigidmd/docs/reference/scene.md").read_text()
    system, ours, state = shaken(
        build(small_scene({"tip4p2005": 216}, 18.64, forces={"cutoff_A": 9.0})), 1, 0.2
    )
    exact, found = (
        ours.evaluate(state)[0].force,
        system.engine_of(system.terms, "mixed").evaluate(state)[0].force,
    )
    error = np.sqrt(np.sum((found - exact) ** 2) / np.sum(exact**2))
    assert 0.1 * float(MIXED_ERROR) < error < 2 * float(MIXED_ERROR)


# a new engine

OPTIONS = """
from rigidmd.core.programs import Option, Program

PROGRAM = Program(
    "Mirror", "it needs nothing", "mirror:TABLE", engine="mirror:MirrorEngine", installed="mirror:installed",
    options={"tilt": Option(int, 2, "Angle of mirror; default: 2")}, describe=lambda tilt: f"Mirror tilted by {tilt}",
    thermostat="langevin", writer="mirror:write", command="cat mirror.txt",
)
"""
MIRROR = """
import numpy as np

from rigidmd.features.external.engines import ExternalEngine
from rigidmd.features.external.engines import Key, Translations

TABLE = Translations("Mirror", (), (Key("thermostat", {None: "", "langevin": ""}),), (), ())


def installed():
    return "Mirror 1.0"


def write(folder, view, state):
    (folder / "mirror.txt").write_text(f"{len(view.kinds)} kinds")
    return ["mirror.txt"]


class MirrorEngine(ExternalEngine):
    version, error = "Mirror 1.0", 0.0

    def __init__(self, system, stage, tilt):
        super().__init__(system, stage)
        assert tilt == 3
        self.mirrored, self.method = system.engine(), self._stage.scheme

    def evaluate(self, state):
        load, tallies = self.mirrored.evaluate(state)
        return load._replace(force=load.force + self.error), tallies

    def memory(self):
        return {}

    def recall(self, state, memory):
        self.forget()

    def _send(self, state):
        self.mirrored.forget()

    def _run(self, state, steps, dt):
        self.mirrored.advance(state, self.method, dt, int(state.step[0]) + steps)

    def _receive(self, state):
        pass
"""
#: Runs commands, given as JSON with the error of the engine, and prints exit code and output of each.
SCRIPT = """
import contextlib, io, json, sys

import rigidmd.features.external

rigidmd.features.external.__path__.append(sys.argv[1] + "/engines")

from rigidmd.commands import cli

results = []
for error, arguments in json.load(sys.stdin):
    if error:
        from rigidmd.features.external.mirror.mirror import MirrorEngine

        MirrorEngine.error = error
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = cli.main(arguments)
        except SystemExit as end:
            code = end.code
    results.append([code, out.getvalue(), err.getvalue()])
print(json.dumps(results))
"""


def test_adding_an_engine_takes_a_folder(tmp_path):
    folder = tmp_path / "engines" / "mirror"
    folder.mkdir(parents=True)
    (folder / "__init__.py").touch()
    (folder / "mirror.py").write_text(MIRROR)
    (folder / "program.py").write_text(OPTIONS)
    (tmp_path / "script.py").write_text(SCRIPT)
    scene = tmp_path / "argon.toml"
    scene.write_text(
        "[box]\nlengths_A = 16.0\n[[molecules]]\nmodel = 'argon'\ncount = 20\n[forces]\ncutoff_A = 7.0\n"
        "[start]\ntemperature_K = 90.0\n[[stages]]\nduration_ps = 0.02\n"
    )

    there = ("--engine", "mirror", "--tilt", "3")
    andersen = (
        "stages.0.ensemble=nvt",
        "stages.0.temperature_K=90",
        "stages.0.thermostat=andersen",
    )
    changes = [part for change in andersen for part in ("--set", change)]
    commands = [
        ("run", scene, *there, "-o", "out"),
        ("resume", "out", "--until", "0.03ps"),
        ("check", scene, *there),
        ("verify", scene, *there),
        ("check", scene, *there, *changes),
        ("check", scene, "--engine", "lammps", "--tilt", "3"),
        ("export", scene, "--to", "mirror", "-o", "exported"),
        ("schema",),
        ("run", "--help"),
        ("run", scene, *there, "-o", "wrong"),
    ]
    errors = [0.0] * 9 + [0.1]
    done = subprocess.run(
        [sys.executable, str(tmp_path / "script.py"), str(tmp_path)],
        input=json.dumps([[e, [*map(str, c)]] for e, c in zip(errors, commands, strict=True)]),
        capture_output=True,
        text=True,
        cwd=tmp_path,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    results = json.loads(done.stdout.splitlines()[-1])
    assert [code for code, _, _ in results] == [0, 0, 0, 0, 2, 2, 0, 0, 0, 2], results
    ran, _, checked, _, refused, foreign, _, schema, text, wrong = results
    assert "computed by Mirror tilted by 3" in ran[1]
    assert '"engine": "Mirror 1.0"' in (tmp_path / "out" / "summary.json").read_text()
    assert checked[1].rstrip().endswith("Mirror 1.0")
    assert (
        "engine.name = 'mirror': stages.0.thermostat = 'andersen': Mirror has langevin"
        in refused[2]
    )
    assert "tilt would have no effect with engine.name = 'lammps'. It is for mirror" in foreign[2]
    assert (tmp_path / "exported" / "mirror.txt").read_text() == "1 kinds"
    assert '"mirror"' in schema[1] and '"Angle of mirror; default: 2"' in schema[1]
    assert "rigidmd, lammps, openmm or mirror" in text[1] and "--tilt N" in text[1]
    assert "mirror and rigidmd do not agree at the start" in wrong[2]
