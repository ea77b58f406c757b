"""The defaults of users: electrostatics, truncation of charges, tail correction, real-space cutoff
of PME, precision."""

import json
import re
import tomllib
from math import erfc, inf, sqrt

import numpy as np
import pytest
from scipy.special import erfcinv
from support.common import ROOT, small_scene
from support.stops import stopped_at

from rigidmd import Scene, Simulation, with_defaults
from rigidmd.assemble.build import build
from rigidmd.assemble.harmonic import stable_angle, step_error
from rigidmd.assemble.time_step import MARGIN, MIXED_ERROR, _one_digit, error_of_step, step_warnings
from rigidmd.commands.cli import main
from rigidmd.core.integrators import SCHEMES, WITH_THERMOSTAT
from rigidmd.errors import SceneError
from rigidmd.forces.ewald.errors import charges_in, pme_error
from rigidmd.run.force_errors import coulomb_errors
from rigidmd.run.kind import describe
from rigidmd.units import COULOMB, COULOMB_CHARGE, KJ_PER_MOL

WATER = {"model": "spce", "count": 64}
NVT = {"ensemble": "nvt", "temperature_K": 298.15, "duration_ps": 0.02}


def scene(edge: float | None = 13.0, **tables) -> Scene:
    """64 waters with nothing but what a user has to state."""
    box = {"lengths_A": edge} if edge else {"lengths_A": 13.0, "periodic": False}
    forces = {"cutoff_A": 6.0} if edge else {}
    return Scene.from_dict(
        {"box": box, "molecules": [WATER], "forces": forces, "stages": [NVT]} | tables
    )


def forces_of(**tables):
    return build(scene(**tables)).scene.forces


def test_charges_act_on_all_images_in_a_box_and_by_coulomb_without_one():
    assert forces_of().electrostatics == "pme"
    assert forces_of(edge=None).electrostatics == "coulomb"
    assert forces_of(molecules=[{"model": "argon", "count": 64}]).electrostatics == "none"
    assert (
        forces_of(forces={"electrostatics": "reaction_field", "cutoff_A": 6.0}).electrostatics
        == "reaction_field"
    )


@pytest.mark.parametrize(
    ("edge", "forces", "message"),
    [
        (
            13.0,
            {"reaction_field_permittivity": 78.0},
            "would have no effect with electrostatics = 'pme' .the default.",
        ),
        (
            None,
            {"ewald_accuracy": 1e-4},
            "ewald_accuracy would have no effect with electrostatics = 'coulomb' .the default",
        ),
        (
            13.0,
            {"electrostatics": "coulomb"},
            "'coulomb' is for open boxes. In a periodic one use pme",
        ),
        (
            None,
            {"electrostatics": "pme"},
            "'pme' needs a periodic box; use coulomb, the sum over all pairs",
        ),
        (13.0, {"ewald_cutoff_A": 7.0}, "ewald_cutoff_A = 7 is longer than half the shortest edge"),
        (13.257, {"cutoff_A": 7.0}, r"Use a larger box, or cutoff_A = 6\.62 or less"),
        (
            13.0,
            {"electrostatics": "pme", "reaction_field_truncation": "switch"},
            "reaction_field_truncation would have no effect",
        ),
    ],
)
def test_keys_without_an_effect_are_refused(edge, forces, message):
    with pytest.raises(SceneError, match=message):
        build(scene(edge, forces={"cutoff_A": 6.0} | forces))


def test_without_a_box_all_pairs_of_charges_act_whatever_the_cutoff():
    simulation = Simulation(scene(None, forces={"cutoff_A": 4.0}))
    found = simulation._start_energy(KJ_PER_MOL, "kJ/mol")["components"]
    system = simulation.system
    position, charge = (
        system.site_positions(simulation.state),
        system.of_sites(lambda m: m.charges) * COULOMB_CHARGE,
    )
    distance = np.linalg.norm(position[:, None] - position, axis=2)
    other = np.not_equal.outer(system.sites.molecule, system.sites.molecule)
    pairs = np.divide(np.outer(charge, charge), distance, out=np.zeros_like(distance), where=other)
    assert found["coulomb"] == pytest.approx(pairs.sum() / 2 / KJ_PER_MOL, rel=1e-10)
    assert system.terms["lennard_jones"].potential.cutoff == 4.0


# --- truncation of charges ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("forces", "expected"),
    [
        ({}, "shift"),
        ({"truncation": "force_switch"}, "shift"),
        ({"truncation": "plain"}, "plain"),
        ({"truncation": "smooth_switch"}, "smooth_switch"),
        ({"reaction_field_truncation": "switch"}, "switch"),
    ],
)
def test_a_reaction_field_is_truncated_apart_from_lennard_jones(forces, expected):
    found = forces_of(forces={"cutoff_A": 6.0, "electrostatics": "reaction_field"} | forces)
    assert (found.reaction_field_truncation, found.truncation) == (
        expected,
        forces.get("truncation", "shift"),
    )


def test_the_force_of_a_conducting_reaction_field_vanishes_at_the_cutoff():
    system = build(scene(forces={"cutoff_A": 6.0, "electrostatics": "reaction_field"}))
    term = system.terms["coulomb"]
    energy = [
        1 / r + term.potential.field * r**2 + term.potential.terms[0] for r in (6.0, 6.0 - 1e-4)
    ]
    assert energy[0] == pytest.approx(0, abs=1e-15)
    assert energy[1] == pytest.approx(0, abs=1e-8)


# --- tail correction ------------------------------------------------------------------------------


def positions_file(path, position, edges) -> str:
    rows = [f"Ar {x} {y} {z}" for x, y, z in position]
    lattice = " ".join(f"{x:g}" for x in np.diag(edges).ravel())
    path.write_text(
        "\n".join([str(len(rows)), f'Lattice="{lattice}" Properties=species:S:1:pos:R:3', *rows])
        + "\n"
    )
    return path.name


@pytest.mark.parametrize(
    ("lattice", "edges", "expected"),
    [
        ((5, 5, 5), (20.0, 20.0, 20.0), True),
        ((5, 5, 5), (20.0, 20.0, 60.0), False),  # a slab
        ((5, 5, 5), (60.0, 60.0, 60.0), False),  # a droplet
        ((5, 5, 15), (20.0, 20.0, 60.0), True),
        ((2, 2, 2), (20.0, 20.0, 20.0), True),  # few molecules are far from each other, and even
    ],
)
def test_a_tail_correction_is_for_boxes_that_molecules_fill(lattice, edges, expected, tmp_path):
    spacing = np.array(edges) / lattice if expected else np.full(3, 4.0)
    position = spacing * (np.array(list(np.ndindex(*lattice))) + 0.5)
    tables = {
        "structure": {"file": positions_file(tmp_path / "argon.xyz", position, edges)},
        "molecules": [{"model": "argon"}],
        "forces": {"cutoff_A": 6.0},
        "stages": [NVT | {"temperature_K": 90.0}],
    }
    system = build(Scene.from_dict(tables, tmp_path))
    assert system.scene.forces.tail_correction is expected
    assert (system.tail is not None) == expected
    assert ("tail correction: -" in describe(system.scene)) == expected


@pytest.mark.parametrize(
    "tables",
    [
        {"molecules": [WATER, {"model": "argon", "count": 2, "frozen": True}]},
        {
            "box": {"lengths_A": [13.0, 13.0, 30.0]},
            "fields": {
                "walls": [
                    {
                        "axis": "z",
                        "positions_A": [0.0, 13.0],
                        "kind": "harmonic",
                        "stiffness_kJ_mol_A2": 100.0,
                    }
                ]
            },
        },
        {"forces": {"cutoff_A": 6.0, "lennard_jones": False}},
        {
            "forces": {
                "cutoff_A": 6.0,
                "custom": [{"name": "slow", "energy": "A/r", "parameters": {"A": 1.0}}],
            }
        },
    ],
)
def test_no_tail_correction_next_to_walls_and_frozen_molecules(tables):
    system = build(scene(**tables))
    assert system.tail is None
    assert any("tail correction" in reason for reason in system.left_out)


# --- PME ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cutoff", [6.0, 9.0])
def test_the_real_space_cutoff_of_pme_is_that_of_speed_and_keeps_the_accuracy(cutoff):
    tables = {
        "molecules": [WATER | {"count": 216}],
        "box": {"density_g_cm3": 0.997},
        "precision": "double",
    }
    system = build(scene(**tables, forces={"cutoff_A": cutoff}))
    forces = system.scene.forces
    assert 5.0 <= forces.ewald_cutoff_A <= 7.0  # by the density of charges, not by Lennard-Jones
    assert (forces.cutoff_A, system.terms["lennard_jones"].potential.cutoff) == (cutoff, cutoff)
    assert system.terms["coulomb_real"].potential.cutoff == forces.ewald_cutoff_A
    found = coulomb_errors(system, system.state)
    assert found["in_e2_per_A2"] < 5e-5
    again = build(system.scene)
    assert again.scene.forces == forces  # a resolved scene stays as it is


def test_dilute_charges_have_a_longer_cutoff_and_given_ones_stay():
    ions = [{"model": "na_spce", "count": 5}, {"model": "cl_spce", "count": 5}]
    assert forces_of(edge=50.0, molecules=ions).ewald_cutoff_A > 8.0
    assert forces_of(forces={"cutoff_A": 6.0, "ewald_cutoff_A": 6.2}).ewald_cutoff_A == 6.2
    assert forces_of(forces={"cutoff_A": 6.0, "ewald_alpha_per_A": 0.5}).ewald_cutoff_A == 6.0
    assert forces_of(forces={"cutoff_A": 6.0, "electrostatics": "ewald"}).ewald_cutoff_A == 6.0


def test_the_accuracy_is_better_than_the_defaults_of_gromacs_and_openmm():
    """GROMACS: ewald-rtol 1e-5, order 4, a grid of at most 1.2 Å; OpenMM: a tolerance of 5e-4,
    order 5."""
    edge, cutoff = 49.72, 9.0
    charges = charges_in(build(scene()).species, np.array([4096]))
    cell, volume, tolerance = edge * np.eye(3), edge**3, 5e-4
    alphas = float(erfcinv(1e-5)) / cutoff, sqrt(-np.log(2 * tolerance)) / cutoff
    assert erfc(alphas[0] * cutoff) == pytest.approx(1e-5)
    grids = (42, 42, 42), (45, 45, 45)  # ceil(2 alpha L/(3 tolerance^(1/5))) of OpenMM
    errors = [
        np.hypot(
            charges.beyond(alpha, cutoff, volume), pme_error(charges, alpha, cell, grid, order)
        )
        for alpha, grid, order in zip(alphas, grids, (4, 5), strict=True)
    ]
    assert np.round(np.array(errors) * 1e5) == pytest.approx([9, 8])  # as in the manual
    assert build(scene()).force_error / COULOMB < 5e-5 < min(errors)


# --- precision ------------------------------------------------------------------------------------


def precision_of(**stage) -> tuple[str, str]:
    system = build(
        scene(stages=[{key: value for key, value in (NVT | stage).items() if value is not None}])
    )
    return system.scene.precision, system.precision_reason


@pytest.mark.parametrize(
    ("stage", "precision", "reason"),
    [
        ({}, "mixed", "baoab at 4 fs, about 4e-02 of the forces, is 13,"),
        (
            {"timestep_fs": 0.1},
            "double",
            "is 8 times that of single precision, 3e-06, and not 30 times",
        ),
        ({"integrator": "srkn_4", "timestep_fs": 2.0}, "double", "srkn_4 at 2 fs"),
        ({"integrator": "two_stage", "timestep_fs": 4.0}, "mixed", "two_stage at 4 fs"),
        (
            {"ensemble": "minimise", "temperature_K": None, "duration_ps": None},
            "double",
            "no stage has a given time step",
        ),
        (
            {"integrator": "auto", "energy_error_kT": 1e-4, "timestep_fs": None},
            "double",
            "chooses its step for a small",
        ),
    ],
)
def test_precision_is_single_between_sites_where_the_step_hides_it(stage, precision, reason):
    tables = {} if stage.get("ensemble") != "minimise" else {"start": {"temperature_K": 300.0}}
    stages = [{key: value for key, value in (NVT | stage).items() if value is not None}]
    if stage.get("integrator") == "auto":
        stages[0]["ensemble"] = "nve"
        del stages[0]["temperature_K"]
        tables = {"start": {"temperature_K": 300.0}}
    system = build(scene(stages=stages, **tables))
    assert system.scene.precision == precision
    assert reason in system.precision_reason
    text = describe(system.scene.model_copy(update={"precision": "auto"}), verbose=True)
    assert f"precision: {precision}, chosen because" in text


def test_the_strictest_stage_decides_and_a_given_precision_stays():
    fine = NVT | {"timestep_fs": 0.1}
    assert build(scene(stages=[NVT, fine])).scene.precision == "double"
    assert build(scene(stages=[{"ensemble": "minimise"}, NVT])).scene.precision == "mixed"
    for given in ("double", "mixed"):
        system = build(scene(precision=given))
        assert (system.scene.precision, system.precision_reason) == (given, "")


def test_fine_ewald_sums_are_in_double_precision():
    system = build(scene(forces={"cutoff_A": 6.0, "ewald_accuracy": 1e-7}))
    assert system.scene.precision == "double"
    assert "finer than single precision" in system.precision_reason


def test_a_run_states_its_precision_and_energy_is_in_double(tmp_path):
    simulation = Simulation(scene())
    summary = simulation.run().summary
    assert summary["precision"] == "mixed"
    assert summary["precision_reason"].startswith("mixed: the error of baoab at 4 fs")
    run = tmp_path / "run"
    Simulation(scene(), run, observers=stopped_at({2})).run()
    assert main(["resume", str(run)]) == 0
    resumed = json.loads((run / "summary.json").read_text())
    assert resumed["precision_reason"] == summary["precision_reason"]
    energy = Simulation(scene())._start_energy(KJ_PER_MOL, "kJ/mol")
    exact = Simulation(scene(precision="double"))._start_energy(KJ_PER_MOL, "kJ/mol")
    assert energy["components"] == exact["components"]


@pytest.mark.parametrize(
    "name", ["velocity_verlet", "two_stage", "pefrl", "srkn_6", "takahashi_imada"]
)
def test_the_error_of_a_step_is_that_of_the_frequency(name):
    """The phase of an oscillator after many steps, against w t."""
    scheme, angle = SCHEMES[name], 0.3
    matrix = np.eye(2)
    for flow in scheme.flows:
        if flow.kind == 0:  # a kick
            matrix = (
                np.array([[1, 0], [-flow.fraction * angle**2 * (1 - flow.gradient * angle**2), 1]])
                @ matrix
            )
        else:
            matrix = np.array([[1, flow.fraction], [0, 1]]) @ matrix
    followed = abs(np.angle(np.linalg.eigvals(matrix)[0]))
    assert step_error(scheme, angle) == pytest.approx(
        abs((followed / angle) ** 2 - 1), rel=1e-6, abs=1e-12
    )
    assert step_error(scheme, 1.01 * stable_angle(scheme)) == inf
    for small in (1e-1, 1e-3, 1e-8, 1e-300):  # not the rounding error of the trace
        assert step_error(scheme, small) <= small**2 / 10
    assert step_error(scheme, 0.0) == 0.0


def test_check_ends_for_a_step_far_below_rounding():
    row = {"name": "mine", "steps": [0.6, -0.2, 0.6], "order": 2}
    stage = {"duration_ps": 0.004, "timestep_fs": 1e-9, "integrator": "mine"}
    found = scene(stages=[stage], integrators=[row], start={"temperature_K": 300})
    assert "times shorter than mine needs" in "".join(step_warnings(found))


def test_the_error_of_velocity_verlet_is_known():
    for angle in (0.01, 0.1, 0.3):
        assert step_error(SCHEMES["velocity_verlet"], angle) == pytest.approx(
            angle**2 / 12, rel=0.02
        )
        assert step_error(WITH_THERMOSTAT["baoab"], angle) == pytest.approx(angle**2 / 12, rel=0.02)
    species = build(scene()).species
    assert error_of_step(species, 0.0, SCHEMES["velocity_verlet"], 2.0) == 0.0
    assert (
        error_of_step(species, 298.15, SCHEMES["velocity_verlet"], 2.0) > 100 * MARGIN * MIXED_ERROR
    )


@pytest.mark.parametrize("edge", [40.0, 200.0])
def test_a_droplet_in_a_large_box_has_the_accuracy_of_a_liquid(edge, printed):
    """The mean density of the box would allow errors that a droplet or a pair of molecules in a gas
    does not have."""
    path = ROOT / "systems" / "water_from_structure.toml"
    found = json.loads(
        printed("energy", path, "--accuracy", "--json", "--set", f"box.lengths_A={edge}").out
    )["accuracy"]
    assert 1e-7 < found["in_e2_per_A2"] < 5e-5
    scene = with_defaults(Scene.read(path, {"box.lengths_A": edge}))
    assert (
        max(scene.forces.pme_grid) <= 24
    )  # a spacing that the box would not allow at a cutoff of 14 Å


@pytest.mark.parametrize(
    ("integrator", "forces", "warned"),
    [
        ("srkn_4", {}, True),
        ("srkn_4", {"truncation": "plain"}, True),
        ("srkn_4", {"truncation": "smooth_switch"}, False),
        ("velocity_verlet", {}, False),
        ("srkn_4", {"lennard_jones": False}, False),
    ],
)
def test_check_warns_of_an_order_that_the_truncation_does_not_allow(
    integrator, forces, warned, tmp_path, printed
):
    forces = "".join(f"{key} = {json.dumps(value)}\n" for key, value in forces.items())
    text = f'[box]\nlengths_A = 40\n[[molecules]]\nmodel = "spce"\ncount = 8\n[forces]\n{forces}[start]\ntemperature_K = 300\n'
    (tmp_path / "s.toml").write_text(
        f'{text}[[stages]]\nduration_ps = 0.1\ntimestep_fs = 1\nintegrator = "{integrator}"\n'
    )
    assert ("forces jump to 0 at the cutoff" in printed("check", tmp_path / "s.toml").err) == warned


def test_the_scene_of_a_run_has_no_keys_without_an_effect(tmp_path):
    stages = [{"ensemble": "minimise", "max_iterations": 2}, NVT]
    ran = scene(stages=stages)
    Simulation(ran, folder=tmp_path / "run").run()
    tables = tomllib.loads((tmp_path / "run" / "scene.toml").read_text())
    limits = {"max_iterations", "force_limit_kJ_mol_A", "torque_limit_kJ_mol"}
    assert set(tables["stages"][0]) == {"ensemble", *limits}
    assert not {"nose_hoover_links", "pressure_coupling", "max_iterations"} & set(
        tables["stages"][1]
    )
    assert not {"damping_per_A", "reaction_field_permittivity"} & set(tables["forces"])
    assert (
        build(Scene.read(tmp_path / "run" / "scene.toml")).scene.stages == build(ran).scene.stages
    )


@pytest.mark.parametrize("name", ["heavy_top_3", "water", "water_dimer"])
def test_check_names_no_classes(name):
    text = describe(Scene.read(ROOT / "systems" / f"{name}.toml"))
    assert re.findall(r"\b[A-Z][a-z]+[A-Z]\w*", text) == []


def step_of(model="spce", temperature=298.15, masses=None, **stage) -> float:
    """The default time step (fs) of a last stage, of 40 ps unless stated."""
    molecules = {"model": model, "count": 64} | ({"masses_u": masses} if masses else {})
    held = {"temperature_K": temperature} if stage.get("ensemble") in ("nvt", "npt") else {}
    built = build(
        scene(
            30.0,
            molecules=[molecules],
            start={"temperature_K": temperature},
            stages=[{"duration_ps": 40} | held | stage],
        )
    )
    return built.scene.stages[-1].timestep_fs


@pytest.mark.parametrize(
    ("stage", "expected"),
    [
        ("ensemble = 'nvt'", 4),
        ("ensemble = 'npt'\npressure_bar = 1", 4),
        ("ensemble = 'nvt'\nthermostat = 'langevin'", 4),
        ("ensemble = 'nvt'\nintegrator = 'velocity_verlet'", 1),
        ("ensemble = 'nvt'\nthermostat = 'hybrid_monte_carlo'", 2),
        ("ensemble = 'nve'", 2),
        ("ensemble = 'nph'\npressure_bar = 1", 2),
        ("ensemble = 'nve'\nintegrator = 'srkn_4'", 5),
        ("ensemble = 'nvt'\ntimestep_fs = 3", 3),
        ("ensemble = 'nvt'\ntemperature = 350.0", 4),
        ("ensemble = 'nvt'\ntemperature = 500.0", 2.5),
        ("ensemble = 'nvt'\nmodel = 'tip4p2005'", 4),
        ("ensemble = 'nve'\nmodel = 'tip4p2005'", 2),
        ("ensemble = 'nvt'\nmasses.H = 4.0", 5),
        ("ensemble = 'nvt'\nmodel = 'ammonia_trappe'\ntemperature = 240.0", 5),
        ("ensemble = 'nve'\nmodel = 'ammonia_trappe'\ntemperature = 240.0", 4),
        ("ensemble = 'nvt'\nmodel = 'nitrogen'\ntemperature = 77.0", 10),
        ("ensemble = 'nve'\nmodel = 'argon'\ntemperature = 94.0", 10),
    ],
)
def test_the_default_step_follows_from_the_molecules(stage, expected):
    stage = tomllib.loads(stage)
    assert step_of(**stage) == expected


def test_the_default_step_divides_the_duration_and_the_intervals():
    def with_intervals(**tables) -> float:
        stages = [{"ensemble": "nvt", "temperature_K": 298.15, "duration_ps": 0.3}]
        return build(scene(stages=stages, **tables)).scene.stages[0].timestep_fs

    assert with_intervals() == 4  # as does 0.3 ps
    assert step_of(model="argon", duration_ps=0.004) == 4  # no step is longer than its stage
    assert with_intervals(output={"log_interval_ps": 0.015}) == 2.5
    assert with_intervals(output={"trajectory_interval_ps": 0.05}) == 2.5
    of_no_file = {"trajectory": False, "trajectory_interval_ps": 0.05}
    assert with_intervals(output=of_no_file) == 4
    assert with_intervals(output={"log_interval_ps": 0.0017}) == 4  # none divides it


def test_the_default_step_is_that_of_the_molecules_that_move():
    of_water, of_argon = {"model": "spce", "count": 8}, {"model": "argon", "count": 8}
    stages = [{"ensemble": "nvt", "temperature_K": 94, "duration_ps": 40}]
    box = {"lengths_A": 30.0}

    def step(*molecules, **tables) -> float:
        return (
            build(scene(molecules=list(molecules), box=box, stages=stages, **tables))
            .scene.stages[0]
            .timestep_fs
        )

    assert step(of_argon) == 10
    assert step(of_water, of_argon) == 5
    assert step(of_water | {"frozen": True}, of_argon) == 10


def test_a_default_step_without_a_temperature_is_two_femtoseconds():
    at_rest = {"start": {"temperature_K": 0}, "stages": [{"duration_ps": 1}]}
    assert build(scene(**at_rest)).scene.stages[0].timestep_fs == 2


def test_a_default_step_that_contradicts_another_key_is_reported_with_its_length():
    field = {
        "electric_V_per_nm": [0, 0, 0.1],
        "electric_frequency_per_ps": 150,
    }  # a period of 6.7 fs
    with pytest.raises(SceneError, match=r"two steps of stages\.0 \(4 fs\)"):
        build(scene(fields=field))
    stages = [NVT | {"timestep_fs": 3}]
    assert build(scene(fields=field, stages=stages)).scene.stages[0].timestep_fs == 3


def test_a_run_keeps_its_default_step_and_check_states_its_error(tmp_path, printed):
    path = tmp_path / "water.toml"
    path.write_text(
        "box.lengths_A = 13.0\nforces.cutoff_A = 6.0\n[[molecules]]\nmodel = 'spce'\ncount = 64\n"
        "[[stages]]\nensemble = 'nvt'\ntemperature_K = 298.15\nduration_ps = 0.02\n"
        "[[stages]]\nduration_ps = 0.02\n"
    )
    out = " ".join(printed("check", path).out.split())
    error = "time-step error: spce rotates about its lightest axis as if forces were wrong by"
    assert "0: nvt: 5 steps of 4 fs = 0.02 ps, baoab" in out
    assert f"{error} 4 %. Bias of U about 0.004 kT per degree of freedom" in out
    assert "1: nve: 10 steps of 2 fs = 0.02 ps, velocity_verlet" in out
    assert f"{error} 1 % run time: about" in out
    assert main(["run", str(path), "-o", str(tmp_path / "run")]) == 0
    written = tomllib.loads((tmp_path / "run" / "scene.toml").read_text())
    assert [stage["timestep_fs"] for stage in written["stages"]] == [4.0, 2.0]
    assert main(["resume", str(tmp_path / "run"), "--until", "0.06ps"]) == 0
    assert Scene.read(path).stages[0].timestep_fs is None


def test_the_limit_of_a_cutoff_in_a_dodecahedron_is_not_called_the_minimum_image_convention():
    """Its images are at the distance of an edge, which half of a_x, b_y or c_z does not show."""
    edge = 17.4
    box = {"lengths_A": [edge] * 3, "angles_deg": [60.0, 60.0, 90.0]}
    forces = {"cutoff_A": 8.0}
    with pytest.raises(SceneError) as refused:
        build(small_scene({"argon": 20}, None, box=box, forces=forces))
    text = str(refused.value)
    assert (
        "half the smallest of a_x, b_y, c_z of the box, 6.152 Å, up to which rigidmd finds" in text
    )
    assert "convention allows 8.700 Å, half the distance of its nearest images). Use" in text
    with pytest.raises(SceneError, match=r"violates the minimum-image convention\. Use"):
        build(small_scene({"argon": 20}, None, box=box, forces={"cutoff_A": 8.8}))


@pytest.mark.parametrize(
    ("value", "text"), [(0.00042, "0.0004"), (1.2, "1"), (38.6, "40"), (251.0, "300"), (0.0, "0")]
)
def test_numbers_with_one_digit(value, text):
    assert _one_digit(value) == text
