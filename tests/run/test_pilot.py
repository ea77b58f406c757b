"""integrator = "auto": what is chosen keeps the error requested, is written down, and repeats."""

import re
import tomllib
from math import comb

import numpy as np
import pytest
from support.common import ROOT, SPRING, same_bits, small_scene, springs

from rigidmd.assemble.build import build
from rigidmd.commands.cli import main
from rigidmd.core.integrators import DRIFT, KICK, SCHEMES
from rigidmd.core.statistics import mean_and_error
from rigidmd.engines.protocol import NotFiniteError
from rigidmd.errors import SceneError, SimulationError
from rigidmd.features.bodies.trials import fit_step
from rigidmd.features.studies.accuracy.start import start_of_last_stage
from rigidmd.features.studies.extrapolation import MeanAtStep, extrapolate
from rigidmd.run import Simulation, trials
from rigidmd.run.pilot import choice
from rigidmd.run.pilot.choice import choose
from rigidmd.run.pilot.energy_walk import EnergyWalk, weight
from rigidmd.run.pilot.sampling import bias_of_potential, mean_square_rate
from rigidmd.run.pilot.stages import choose_for_stage
from rigidmd.run.trials import Method, TrialSystem
from rigidmd.scene import Scene

TOP = ROOT / "systems" / "heavy_top_3.toml"


def liquid(**last):
    """27 waters, warmed up, then 0.3 ps of NVE as given."""
    stages = [
        {"ensemble": "nvt", "temperature_K": 300.0, "duration_ps": 0.5},
        {"duration_ps": 0.3} | last,
    ]
    return small_scene(
        {"spce": 27},
        9.4,
        forces={"cutoff_A": 4.69, "switch_start_A": 3.0},
        stages=stages,
        output={"trajectory": False, "log_interval_ps": 0.01, "figures": False},
    )


def energy_error(results):
    """rms of the energy of the last stage, kT per degree of freedom."""
    own = results["stage"] == 1
    energy, kinetic = results["energy"][own], results["kinetic"][own]
    return float(np.sqrt(np.mean((energy - energy[0]) ** 2)) / (2 * kinetic.mean()))


@pytest.mark.soak
def test_the_energy_error_requested_is_kept_with_fewer_forces_than_verlet_needs(tmp_path):
    results = Simulation(liquid(integrator="auto", energy_error_kT=1e-5), tmp_path / "a").run()
    stage = results.summary["stages"][1]
    assert stage["integrator"] != "velocity_verlet"
    assert f"{stage['integrator']} at {stage['timestep_fs']:g} fs chosen: error" in stage["choice"]
    assert "times fewer than velocity_verlet at" in stage["choice"]
    assert energy_error(results) < 1e-5
    said = float(re.search(r"In the [\d.]+ ps that ran it was (\S+)", stage["choice"])[1])
    assert said == pytest.approx(energy_error(results), rel=0.3)
    # the scene that was written states what was chosen, and repeats the run to the bit
    again = Scene.read(tmp_path / "a" / "scene.toml")
    assert again.stages[1].integrator == stage["integrator"]
    assert again.stages[1].timestep_fs == stage["timestep_fs"]
    assert again.stages[1].energy_error_kT is None
    repeated = Simulation(again).run()
    assert same_bits(results.state, repeated.state)
    assert repeated.summary["stages"][1]["choice"] is None


KEPT = {
    "switch": ({"spce": 27}, 9.4, {"cutoff_A": 4.69, "switch_start_A": 3.0}, 300.0),
    "smooth_switch": (
        {"spce": 27},
        9.4,
        {"cutoff_A": 4.69, "truncation": "smooth_switch", "switch_start_A": 3.0},
        300.0,
    ),
    "pme": ({"spce": 27}, 9.4, {"cutoff_A": 4.69, "electrostatics": "pme"}, 300.0),
    "co2": ({"co2_trappe": 40}, 16.0, {"cutoff_A": 7.9, "electrostatics": "pme"}, 240.0),
}


@pytest.mark.soak
@pytest.mark.parametrize("target", [1e-3, 1e-4, 1e-5, 1e-6])
@pytest.mark.parametrize("kind", KEPT)
def test_the_error_requested_is_kept_over_a_long_stage(kind, target):
    """Walks scatter: one in ten is 1.5 times its expected size, which is at most 0.83 of the
    target."""
    counts, edge, forces, temperature = KEPT[kind]
    warm = {"ensemble": "nvt", "temperature_K": temperature, "duration_ps": 2.0}
    stages = [warm, {"duration_ps": 10.0, "integrator": "auto", "energy_error_kT": target}]
    output = {"trajectory": False, "log_interval_ps": 0.05, "figures": False}
    scene = small_scene(
        counts,
        edge,
        forces=forces,
        start={"temperature_K": temperature},
        stages=stages,
        output=output,
    )
    results = Simulation(scene).run()
    assert target / 30 < energy_error(results) < 1.7 * target
    assert "over 10 ps for a target of" in results.summary["stages"][1]["choice"]


def test_a_crude_error_is_kept_crudely():
    simulation = Simulation(liquid(integrator="auto", energy_error_kT=3e-3))
    first = simulation.run()
    coarse = first.summary["stages"][1]
    assert energy_error(first) < 3e-3
    assert energy_error(first) > 1e-5
    assert "chosen: error of the energy" in coarse["choice"]
    assert "over 0.3 ps for a target of 0.003 (expected, from" in coarse["choice"]
    assert "ps that ran it was" in coarse["choice"]
    second = simulation.run().summary["stages"][1]  # a simulation chooses again, and the same
    assert (second["integrator"], second["timestep_fs"]) == (
        coarse["integrator"],
        coarse["timestep_fs"],
    )


@pytest.mark.parametrize("jump", [0, 1, 2, 4])
@pytest.mark.parametrize(("one", "other"), [("velocity_verlet", "two_stage"), ("srkn_4", "srkn_6")])
def test_the_walk_of_integrators_is_that_of_their_kicks_in_a_force_that_jumps(jump, one, other):
    """Work on a body at constant speed in the (jump + 1)-th spline, whose jump-th derivative jumps
    at its knots."""
    rng = np.random.default_rng(jump)
    first, width = (
        rng.uniform(0, 1, (4000, 1)),
        rng.uniform(6, 9, (4000, 1)),
    )  # of the knots, in steps
    work = {}
    for name in (one, other):
        at, sums = 0.0, np.zeros((4000, 1))
        for flow in SCHEMES[name].flows:
            at += flow.fraction if flow.kind == DRIFT else 0.0
            if flow.kind == KICK:
                time = (np.arange(-1, 60) + at - first) / width
                parts = [
                    (-1) ** k * comb(jump + 1, k) * np.maximum(time - k, 0) ** jump * (time > k)
                    for k in range(jump + 2)
                ]
                sums += flow.fraction * np.where(time < jump + 1, sum(parts), 0).sum(
                    axis=1, keepdims=True
                )
        work[name] = float((sums / width).var())
    expected = weight(SCHEMES[one], jump) / weight(SCHEMES[other], jump)
    assert work[one] / work[other] == pytest.approx(expected, rel=0.15)


@pytest.fixture
def known(monkeypatch):
    """(subject, longest steps, expected error of a choice) of known energy errors: c dt^p, and a
    walk of truncated forces.

    Over 20 ps the walk of srkn_4 at 5 fs is 1e-4.
    """

    def make(jump, seed=1):
        true, rng = (
            EnergyWalk(1e-9 / EnergyWalk(1.0, jump, 600).rate(SCHEMES["srkn_4"], 5e-3), jump, 600),
            np.random.default_rng(seed),
        )

        def regular(scheme, dt):
            return 1e-3 * (dt / 5e-3) ** scheme.order

        def measure_errors(trial_system, trial, exact, observations=40):
            scheme, dt = SCHEMES[trial.integrator], 1e-3 * trial.timestep
            trial.failure = "diverges" if dt > 5e-3 * scheme.force_evaluations else ""
            walked = true.rate(scheme, dt) * trial.steps * dt
            trial.energies = [
                0.0,
                *np.cumsum(rng.standard_normal(observations) * np.sqrt(walked / observations)),
            ]
            trial.energy_rms = float(np.hypot(regular(scheme, dt), np.sqrt(walked / 2)))

        def error(found):
            dt, scheme = 1e-3 * found.timestep, SCHEMES[found.integrator]
            return np.sqrt(regular(scheme, dt) ** 2 + true.square(scheme, dt, 20.0))

        monkeypatch.setattr(trials, "measure_errors", measure_errors)
        methods = {name: Method(None, scheme) for name, scheme in SCHEMES.items()}
        trial_system = TrialSystem(
            "",
            None,
            methods,
            None,
            "",
            "",
            1.0,
            1.0,
            0.1,
            "fs",
            1e-3,
            "",
            "",
            None,
            True,
            freedom=600,
        )
        return (
            trial_system,
            {name: 5.0 * scheme.force_evaluations for name, scheme in SCHEMES.items()},
            error,
        )

    return make


def told_over_true(known, jump, target):
    """Ratio of the reported to the true error of a choice, rms over pilots with other noise. It is
    below 1, as the choice favours schemes with little noise in their pilot."""
    ratios = []
    for seed in range(30):
        trial_system, longest, error = known(jump, seed)
        found = choose(trial_system, longest, target, duration=20.0)
        ratios.append(found.error / error(found))
    return np.sqrt(np.mean(np.square(ratios)))


@pytest.mark.parametrize("target", [1e-4, 1e-6])
@pytest.mark.parametrize("jump", [0.0, 2.0, 5.0])
def test_the_error_requested_holds_over_the_whole_run_and_not_only_the_pilot(jump, target, known):
    trial_system, longest, error = known(jump)
    found = choose(trial_system, longest, target, duration=20.0)
    assert target / 5 < error(found) < target
    assert "over 20 ps for a target of" in found.reason
    assert error(choose(trial_system, longest, target)) > error(found)
    assert told_over_true(known, jump, target) == pytest.approx(1.0, rel=0.3)


def test_a_walk_that_no_step_makes_smaller_is_reported_with_what_helps(known):
    trial_system, longest, _ = known(-1.0)
    found = choose(trial_system, longest, 2e-5, duration=20.0)
    assert told_over_true(known, -1.0, 2e-5) == pytest.approx(1.0, rel=0.3)
    assert found.error > 2e-5
    assert (
        "No step tried keeps the target over that time: truncation = 'smooth_switch', a longer"
        in found.reason
    )


@pytest.mark.parametrize("longest_stable", [0.0, 2.0])
def test_a_step_that_diverges_in_its_longer_pilot_is_not_chosen(longest_stable, known, monkeypatch):
    trial_system, longest, _ = known(2.0)
    measure = trials.measure_errors

    def diverges_late(system, trial, exact, *observations):
        measure(system, trial, exact, *observations)
        is_pilot = system.span > trial_system.span and not observations
        if is_pilot and trial.timestep > longest_stable:
            trial.failure = "diverges"

    monkeypatch.setattr(trials, "measure_errors", diverges_late)
    if longest_stable:
        assert choose(trial_system, longest, 1e-4, duration=20.0).timestep <= longest_stable
    else:
        with pytest.raises(
            SimulationError, match=r"keeps its error for 0\.1 but diverges within 1"
        ):
            choose(trial_system, longest, 1e-4, duration=20.0)


@pytest.mark.parametrize("target", [1e-8, pytest.param(1e-3, marks=pytest.mark.soak)])
def test_the_error_of_a_top_is_what_was_requested(target):
    changes = {"run.integrator": "auto", "run.trajectory_error": target, "run.timestep_s": 0.05}
    simulation = Simulation(Scene.read(TOP, changes))
    results = simulation.run()
    exact = Simulation(Scene.read(TOP, {"run.integrator": "srkn_6", "run.timestep_s": 0.001})).run()
    error = np.abs(results.state.rotation - exact.state.rotation).max()
    assert target / 100 < error < 1.5 * target
    assert "chosen: error" in results.summary["notes"][0]
    assert simulation.scene.run.integrator == results.summary["integrator"] != "auto"


@pytest.mark.parametrize(
    "model",
    [
        "argon",
        *(
            pytest.param(name, marks=pytest.mark.extended)
            for name in ("krypton", "methane_trappe", "nitrogen", "co2_trappe", "spce")
        ),
    ],
)
def test_a_step_for_the_trajectory_is_found_from_a_lattice(model):
    """Forces at the lattice nearly cancel: the motion is much stiffer than their size shows."""
    stage = {"integrator": "auto", "trajectory_error": 1e-3, "duration_ps": 0.2}
    scene = small_scene({model: 40}, 20.0, stages=[stage], start={"temperature_K": 90.0})
    chosen, reason = choose_for_stage(build(scene), build(scene).state, 0)
    assert chosen.integrator in SCHEMES
    assert 0.5 < chosen.step_fs < 100
    error, span = map(float, re.findall(r"trajectory (\S+) over (\S+) ps", reason)[0])
    assert error < 1e-3
    assert span < 5


def test_a_reference_that_diverges_at_all_steps_is_an_error_without_a_step(monkeypatch):
    """With more steps first; the message has no step, as none was given."""
    tried = []

    def diverges(system, steps):
        tried.append(steps)
        state = system.state.copy()
        state.position[:] = np.inf
        raise NotFiniteError(state)

    monkeypatch.setattr(choice, "final_state", diverges)
    stage = {"integrator": "auto", "trajectory_error": 1e-3, "duration_ps": 0.2}
    with pytest.raises(SimulationError, match=r"it diverges with up to 65536 steps$"):
        Simulation(small_scene({"argon": 40}, 20.0, stages=[stage])).run()
    assert tried == [16 * 2**k for k in range(13)]


def test_an_error_of_the_trajectory_below_rounding_is_refused():
    changes = {"run.integrator": "auto", "run.trajectory_error": 1e-13}
    with pytest.raises(SceneError, match="trajectory_error: is 1e-13, must not be less than 1e-12"):
        Scene.read(TOP, changes)


@pytest.mark.soak
def test_what_cannot_be_kept_is_reported(capsys, tmp_path):
    command = [
        "run",
        str(TOP),
        "--set",
        "run.integrator=auto",
        "--set",
        "run.energy_error=1e-30",
        "-o",
        str(tmp_path),
    ]
    assert main(command) != 0
    assert "no integrator keeps its error below 1e-30" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("stage", "fault"),
    [
        (
            "integrator = 'auto'",
            "integrator = 'auto' needs one of energy_error_kT, trajectory_error",
        ),
        ("integrator = 'auto'\nenergy_error_kT = 0.001\ntrajectory_error = 0.001", "needs one of"),
        (
            "energy_error_kT = 0.001",
            "energy_error_kT would have no effect without integrator = 'auto'",
        ),
        (
            "integrator = 'auto'\nenergy_error_kT = 0.001\ntimestep_fs = 1.0",
            "timestep_fs would have no effect with",
        ),
        (
            "integrator = 'auto'\nenergy_error_kT = 0.001\nrotor = 'split'",
            "rotor would have no effect with",
        ),
        ("integrator = 'auto'\nenergy_error_kT = 0.001\nbias_kT = 0.001", "needs one of"),
        (
            "integrator = 'auto'\nbias_kT = 0.001",
            "bias_kT is for averages at a temperature, and nve has no thermostat",
        ),
        ("bias_kT = 0.001", "bias_kT would have no effect without integrator = 'auto'"),
    ],
)
def test_contradictions_are_refused(stage, fault):
    stage = tomllib.loads(stage)
    with pytest.raises(SceneError, match=fault):
        liquid(**stage)


def test_check_states_that_it_is_open(printed):
    assert (
        "are chosen before the run"
        in printed(
            "check", TOP, "--set", "run.integrator=auto", "--set", "run.energy_error=1e-6"
        ).out
    )
    water = str(ROOT / "systems" / "water.toml")
    more = [
        "--set",
        "stages.production.integrator=auto",
        "--set",
        "stages.production.energy_error_kT=1e-4",
    ]
    assert "timestep_fs" in printed("check", water, *more, code=2).err
    assert (
        "integrator and step chosen at its start for an error of 0.0001 kT"
        in printed("check", water, *more, "--set", "stages.production.timestep_fs=").out
    )


@pytest.mark.soak
def test_a_first_stage_for_which_nothing_can_be_chosen_is_reported():
    stages = [{"duration_ps": 0.1, "integrator": "auto", "energy_error_kT": 1e-30}]
    with pytest.raises(
        SimulationError,
        match=r"stopped at step 0 \(0 ps\): no integrator keeps its error below 1e-30",
    ):
        Simulation(small_scene({"argon": 40}, 18.5, stages=stages)).run()


@pytest.mark.parametrize(
    "thermostat",
    [
        pytest.param("andersen", marks=pytest.mark.soak),
        pytest.param("langevin", marks=pytest.mark.soak),
        None,
    ],
)
def test_the_bias_requested_sets_the_step(thermostat, tmp_path):
    """For oscillators w is known: the pilot finds it to the error of its sampling, some per cent."""
    stage = {"integrator": "auto", "bias_kT": 1e-3, "thermostat": thermostat, "duration_ps": 0.2}
    if thermostat != "langevin":
        stage["friction_translation_per_ps"] = None
    results = Simulation(springs(**stage), tmp_path / "a").run()
    found = results.summary["stages"][0]
    assert found["integrator"] == "baoab"
    assert found["timestep_fs"] == pytest.approx(
        1e3 * np.sqrt(24 * 1e-3 * 39.948 / SPRING), rel=0.1
    )
    assert f"baoab at {found['timestep_fs']:g} fs chosen: bias of U below about" in found["choice"]
    assert "not sampled" in found["choice"]
    again = Scene.read(tmp_path / "a" / "scene.toml")
    assert again.stages[0].bias_kT is None
    assert again.stages[0].thermostat_kind == (thermostat or "velocity_rescaling")
    repeated = Simulation(again).run()
    assert same_bits(results.state, repeated.state)


def test_a_large_bias_is_not_a_reason_for_an_unstable_step():
    results = Simulation(springs(integrator="auto", bias_kT=10.0, duration_ps=0.2)).run()
    assert results.summary["stages"][0]["timestep_fs"] == pytest.approx(
        1e3 * np.sqrt(39.948 / SPRING), rel=0.03
    )


def test_check_states_which_bias_is_requested(printed):
    water = str(ROOT / "systems" / "water.toml")
    more = [
        "--set",
        "stages.equilibration.integrator=auto",
        "--set",
        "stages.equilibration.bias_kT=1e-3",
    ]
    said = " ".join(printed("check", water, *more).out.split())  # lines are wrapped
    assert "for an error of 0.001 kT per degree of freedom of the average potential energy" in said


@pytest.mark.soak
def test_the_estimated_bias_is_that_of_sampling_within_a_factor_of_two():
    """64 SPC/E waters; BAOAB's estimate is an upper one."""
    stages = [{"ensemble": "nvt", "temperature_K": 300.0, "duration_ps": 5.0}]
    stages += [stages[0] | {"timestep_fs": 2.0}]
    scene = small_scene({"spce": 64}, 12.42, forces={"cutoff_A": 6.0}, stages=stages)
    _, state = start_of_last_stage(scene)
    rate = mean_square_rate(Simulation(scene).system, state, 1)
    means = []
    for step in (2.0, 4.0, 5.0):
        changes = {"integrator": "baoab", "timestep_fs": step, "duration_ps": 240.0}
        last = scene.stages[-1].model_copy(update=changes)
        output = scene.output.model_copy(update={"trajectory": False, "log_interval_ps": 0.05})
        simulation = Simulation(scene.model_copy(update={"stages": (last,), "output": output}))
        simulation.start_from(state)
        results = simulation.run(progress=False)
        energy = results["potential"][results["time"] > 40]
        thermal = 0.0083144626 * 300 * simulation.system.last_freedom.total
        means.append(MeanAtStep("baoab", step, *(x / thermal for x in mean_and_error(energy))))
    bias, error = extrapolate(means).bias(means[-1])
    assert abs(bias) < 2 * bias_of_potential(rate, 5e-3) + 2 * error


@pytest.mark.parametrize(
    ("timestep", "duration", "interval", "wanted"),
    [
        (0.5, 50.0, 0.3, 0.1),  # their common measure
        (0.5, 50.0, 1.0, 0.5),
        (0.4, 50.0, 1.0, 1 / 3),
        (
            0.0011,
            1.0,
            None,
            1 / 910,
        ),  # a default of samples that is shorter than the step does not bind it
        (0.0003, 1.0, None, 0.00025),
        (0.3, 1.0, 0.7390851, 0.25),  # no common measure
        (3.0, 1.0, None, 1.0),
        (
            0.021,
            1.7,
            5e-4,
            0.0209876543209876543,
        ),  # nor does an interval much shorter than the step
    ],
)
def test_a_chosen_step_of_a_body_fits_its_duration_and_samples(
    timestep, duration, interval, wanted
):
    found = fit_step(timestep, duration, interval)
    assert found == pytest.approx(wanted, rel=1e-12)
    assert round(duration / found) * found == pytest.approx(duration, rel=1e-12)
    assert found <= timestep * (1 + 1e-9)


def test_the_step_of_a_dilute_gas_resolves_collisions():
    """Argon atoms beyond their cutoff at the start barely interact: the mean frequency is that of
    no collision."""
    stage = {
        "ensemble": "nvt",
        "temperature_K": 90.0,
        "duration_ps": 1.0,
        "integrator": "auto",
        "bias_kT": 1e-2,
    }
    gas = {"stages": [stage], "forces": {"cutoff_A": 6.2}}
    found = Simulation(small_scene({"argon": 27}, 19.0, **gas), warn=str).run()
    assert 2 <= found.summary["stages"][0]["timestep_fs"] < 60
