"""An engine that notices: each kind of finding, what it states, what it leaves behind; and that
ordinary runs continue."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from support.common import BODIES, ROOT, same_bits, site, small_scene
from support.processes import search_path

from rigidmd.assemble.build import build
from rigidmd.assemble.harmonic import stable_angle
from rigidmd.core.integrators import KICK, SCHEMES
from rigidmd.core.state import NOW
from rigidmd.engines.cpu.engine import CpuEngine as Engine
from rigidmd.engines.samples import Sample
from rigidmd.errors import SceneError, SimulationError
from rigidmd.run import Simulation, stable_step
from rigidmd.run import checks as watch
from rigidmd.run.stable_step import DIRECTIONS, stiffest_mode
from rigidmd.scene import Scene

TOP = ROOT / "systems" / "heavy_top_3.toml"
PLAIN = {"figures": False, "trajectory": False}


def stopped(scene, folder=None, change=None):
    """The message of a run that has to stop."""
    simulation = Simulation(scene, folder)
    if change:
        state = simulation.system.state.copy()
        change(state)
        simulation.start_from(state)
    with pytest.raises(SimulationError) as caught:
        simulation.run()
    return str(caught.value)


def water(timestep, *, watch=None, stages=None, count=40):
    stages = stages or [{"duration_ps": 3.0, "timestep_fs": timestep}]
    return small_scene({"spce": count}, 18.5, stages=stages, watch=watch or {})


def test_too_long_a_step_stops_with_all_that_helps(tmp_path, printed):
    (tmp_path / "hot.toml").write_text(
        '[box]\nlengths_A = 18.5\n[[molecules]]\nmodel = "spce"\ncount = 40\n'
        '[[stages]]\nensemble = "nvt"\ntemperature_K = 300\nduration_ps = 0.2\ntimestep_fs = 2\n'
        "[[stages]]\nduration_ps = 20\ntimestep_fs = 25\n"
    )
    said = printed("run", tmp_path / "hot.toml", "-o", tmp_path / "out", code=1).err
    assert "Traceback" not in said
    for part in (
        "warning: stages.1: timestep_fs = 25 is longer than what is stable",
        "fs, which velocity_verlet follows up to",
        "stopped at step ",
        " ps): ",
        "Likely cause: ",
        "timestep_fs below",
        "where the stiffest motion is stable",
        "Last good state, of step ",
        "last_good_state.npz",
    ):
        assert part in said, part
    with np.load(tmp_path / "out" / "last_good_state.npz") as saved:
        assert all(np.isfinite(saved[key]).all() for key in ("position", "velocity", "rotation"))
    assert len((tmp_path / "out" / "log.csv").read_text().splitlines()) > 2
    # the last good state starts a run that goes well
    again = small_scene(
        {"spce": 40},
        None,
        tmp_path / "out",
        box={},
        start={},
        stages=[{"duration_ps": 0.02}],
        structure={"file": "last_good_state.npz", "velocities": True},
    )
    Simulation(again).run()


def test_energy_that_no_scheme_explains():
    said = stopped(water(16.0, watch={"move": False, "turn_rad": False, "kick": False}))
    assert "conserved energy changed by" in said
    assert "kJ/mol per molecule in" in said
    assert "watch.energy = 0.5" in said
    assert "timestep_fs is too long" in said


def test_a_molecule_that_moves_or_rotates_too_far():
    said = stopped(water(2.0), change=lambda state: state.velocity.__setitem__(7, 1e3))
    assert "step 0 (0 ps): molecule 8 (spce) moves 3.46 Å" in said
    assert "watch.move = 0.25" in said
    assert "Try timestep_fs = 0.46 or less" in said
    assert "Last good" not in said  # there was none
    said = stopped(water(2.0), change=lambda state: state.angular_momentum_body.__setitem__(3, 3e3))
    assert "molecule 4 (spce) rotates by" in said
    assert "watch.turn_rad = 2" in said


@pytest.mark.parametrize("edge", [20.0, None])
def test_sites_inside_one_another(edge):
    def overlap(state):
        state.position[11] = state.position[4] + [1.5, 0.0, 0.0]

    said = stopped(small_scene({"argon": 20}, edge), change=overlap)
    assert "changes a momentum of molecule" in said
    assert (
        "AR of molecule 5 (argon) and AR of molecule 12 (argon) are 1.5 Å apart, 0.44 of their diameter"
        in said
    )
    assert "Likely cause: these sites overlap" in said
    assert "Try a start without overlaps" in said


def test_a_charge_on_a_site_without_repulsion(tmp_path):
    ion = {"name": "ion", "count": 5, "sites": [site("X", 20.0, charge=-1.0)]}
    scene = small_scene(
        {},
        20.0,
        molecules=[{"model": "tip4p2005", "count": 20}, ion],
        stages=[{"duration_ps": 2.0, "timestep_fs": 1.0}],
    )
    said = stopped(scene, tmp_path / "out")
    assert "of molecule 24 (ion) are" in said
    assert "HW1 of molecule 5 (tip4p2005)" in said
    assert "a charge on a site without repulsion has collapsed onto an opposite one" in said
    assert 'an entry [[forces.pairs]] with sites = ["HW1", "X"]' in said
    assert (tmp_path / "out" / "last_good_state.npz").exists()
    # what it advises helps
    pair = {"sites": ["HW1", "X"], "sigma_A": 1.5, "epsilon_kJ_mol": 0.5}
    more = {"forces": {"pairs": [pair, pair | {"sites": ["HW2", "X"]}]}}
    Simulation(Scene.from_dict(scene.model_dump(exclude_none=True) | more)).run()


def test_bad_inertia():
    arms = [site(f"H{k}", 1e-5, (x, 0.6, 0.0), 0.4) for k, x in enumerate((-0.8, 0.8))]
    light = {
        "name": "light",
        "count": 30,
        "sites": [site("O", 18.0, charge=-0.8, sigma_A=3.1, epsilon_kJ_mol=0.65), *arms],
    }
    said = stopped(
        small_scene({}, 20.0, molecules=[light], stages=[{"duration_ps": 0.5, "timestep_fs": 1.0}])
    )
    assert "(light)" in said
    assert "Likely cause: bad inertia: a moment of light is 1.3e-05 u Å²" in said
    assert "more of its mass on the outer sites" in said


def test_q_that_is_not_a_rotation():
    simulation = Simulation(water(2.0))
    simulation.system.state.rotation[:] *= 1 + 1e-6  # start_from rejects such a state
    with pytest.raises(SimulationError) as caught:
        simulation.run()
    said = str(caught.value)
    assert "Q is not a rotation: |QᵀQ - 1| is 2e-06 (watch.orthogonality = 1e-09)" in said


@pytest.mark.parametrize("name", ["force", "torque_body"])
def test_a_load_that_is_not_a_number(name):
    system = build(water(2.0))
    load, _ = system.engine().evaluate(system.state)
    getattr(load, name)[5, 1] = np.nan
    check = watch.StepCheck(system, system.scene.watch)
    check.thermal = 250.0
    found = check.failed_check(system.state, load, SCHEMES["velocity_verlet"], 0.002)
    assert str(found) == f"the {name.removesuffix('_body')} on molecule 6 (spce) is not finite"


@pytest.mark.parametrize("name", ["force", "torque_body", "velocity", "angular_momentum_body"])
def test_a_bound_on_all_molecules_hides_no_finding(monkeypatch, name):
    """One number of one molecule grows through its limit: found at the same size as if each
    molecule were observed."""
    system = build(small_scene({"spce": 20, "nitrogen": 20}, 30.0))
    load, _ = system.engine().evaluate(system.state)
    verlet, number = (
        SCHEMES["velocity_verlet"],
        getattr(load if name in load._fields else system.state, name),
    )

    check = watch.StepCheck(system, system.scene.watch)
    check.thermal = 250.0

    def findings(m):
        for size in np.geomspace(1.0, 1e9, 180):
            number[m, 1] = size
            found = check.failed_check(system.state, load, verlet, 0.002)
            yield found and str(found)
        number[m, 1] = 0.0

    for m in (3, 23):
        quick = list(findings(m))
        with monkeypatch.context() as patched:
            patched.setattr(check, "_is_within_limits", lambda *_: False)
            assert quick == list(findings(m))
        assert quick[0] is None and quick[-1] is not None


def test_a_thermostat_is_held_to_its_own_time_only():
    """A drift that a thermostat carries off may add up to any size; within its time constant it may
    not."""
    nvt = [
        {
            "ensemble": "nvt",
            "temperature_K": 300.0,
            "duration_ps": 1.0,
            "thermostat_time_ps": 0.1,
        }
    ]
    scene = small_scene({"spce": 40}, 18.5, stages=nvt, output={"log_interval_ps": 0.05})
    system, simulation = build(scene), Simulation(scene)
    rows = simulation.run().samples.rows
    limits = system.scene.watch

    def problem_of(since, drift):
        now = Sample(**vars(rows[-1]) | {"drift": drift})
        return watch.check_sample(system, limits, rows[since], now)

    assert problem_of(-3, rows[-3].drift + 0.4 * rows[-3].kinetic) is None
    assert problem_of(-3, rows[-3].drift - rows[-3].kinetic)
    assert problem_of(0, 3 * rows[-1].kinetic) is None


def test_limits_can_be_set_and_lifted(capsys, tmp_path):
    def fast(state):
        state.velocity[7] = 600.0

    assert "moves 2.08 Å" in stopped(water(2.0), change=fast)
    assert "watch.move = 0.6" in stopped(water(2.0, watch={"move": 0.6}), change=fast)
    lifted = Simulation(water(2.0, stages=[{"duration_ps": 0.002}], watch={"move": False}))
    fast(lifted.system.state)
    lifted.run()
    data = water(2.0).model_dump(exclude_none=True)
    for table, expected in (
        ({"moev": 1.0}, "watch.moev: unknown key; did you mean move?"),
        ({"move": True}, "watch.move: is True"),
        ({"kick": -1.0}, "watch.kick: is -1.0"),
        ({"turn_rad": float("nan")}, "watch.turn_rad"),
    ):
        with pytest.raises(SceneError, match=r"watch\.") as caught:
            Scene.from_dict(data | {"watch": table})
        assert expected in str(caught.value)
    with pytest.raises(SceneError, match=r"watch\.move: unknown key"):
        Scene.read(TOP, {"watch.move": 0.1})


@pytest.mark.parametrize(
    ("counts", "edge", "kelvin", "stage"),
    [
        ({"spce": 40}, 18.5, 1000.0, {"timestep_fs": 2.0}),
        ({"spce": 40}, 18.5, 0.0, {"timestep_fs": 4.0}),
        (
            {"spce": 40},
            18.5,
            300.0,
            {"timestep_fs": 8.0, "ensemble": "nvt", "temperature_K": 300.0},
        ),
        ({"argon": 60}, 20.0, 1e5, {"timestep_fs": 0.5}),
        ({"tip4p2005": 3}, None, 0.0, {"timestep_fs": 2.0}),
        ({"nitrogen": 2}, None, 1e4, {"timestep_fs": 1.0}),
        ({"spce": 20, "nitrogen": 10}, 18.5, 300.0, {"timestep_fs": 6.0, "integrator": "srkn_6"}),
    ],
)
def test_ordinary_and_hot_runs_continue(counts, edge, kelvin, stage):
    stage = {"duration_ps": 500 * stage["timestep_fs"] / 1000} | stage
    warnings = []
    scene = small_scene(counts, edge, start={"temperature_K": kelvin}, stages=[stage])
    results = Simulation(scene, warn=warnings.append).run()
    # 8 fs is too long for accurate forces on water, and not too long to continue
    assert ["is inaccurate for spce" in text for text in warnings] == [True] * (
        stage["timestep_fs"] == 8.0
    )
    assert results.summary["stages"][0]["steps"] == 500


@pytest.mark.parametrize("spread", [1e-3, 1e-7, 1e-12])
def test_bodies_that_are_all_but_linear_continue(spread):
    """They spin about their axis a thousand times faster than they tumble; their sites are barely disturbed by
    it."""
    arms = [site(f"H{k}", 12.0, (x, spread, 0.0), 0.2) for k, x in enumerate((-1.0, 1.0))]
    thin = {
        "name": "thin",
        "count": 20,
        "sites": [site("O", 16.0, charge=-0.4, sigma_A=3.1, epsilon_kJ_mol=0.65), *arms],
    }
    results = Simulation(
        small_scene({}, 20.0, molecules=[thin], stages=[{"duration_ps": 1.0}])
    ).run()
    assert np.ptp(results["energy"]) < 0.01 * results["kinetic"].max()


@pytest.mark.parametrize(("timestep", "wrong"), [(9.0, True), (2.0, False)])
def test_a_thermostat_cannot_hide_a_step_that_is_too_long(timestep, wrong):
    """It takes out in every step what the step has added, so that the temperature of all motion
    seems right."""
    stage = {
        "ensemble": "nvt",
        "temperature_K": 300.0,
        "timestep_fs": timestep,
        "duration_ps": 12.0,
    }
    warm = stage | {"timestep_fs": 2.0, "duration_ps": 1.0}
    stages = [warm, stage | {"thermostat_time_ps": 0.01}]
    scene = small_scene(
        {"tip4p2005": 40},
        11.0,
        stages=stages,
        forces={"cutoff_A": 5.4, "truncation": "smooth_switch"},
        watch=dict.fromkeys(("move", "turn_rad", "kick"), False),
    )
    results = Simulation(scene).run()
    told = " ".join(note for note in results.summary["notes"] if note.startswith("stages.1"))
    assert ("the conserved energy drifts by" in told) == wrong


def test_observing_costs_no_force_and_changes_no_bit(monkeypatch):
    evaluated, loads = [], []
    evaluate, advance = Engine.evaluate, Engine.advance
    monkeypatch.setattr(
        Engine, "evaluate", lambda self, state: evaluated.append(1) or evaluate(self, state)
    )

    def counted(self, state, scheme, dt, until, observed=False):
        loads.append(until - state.step[NOW])
        return advance(self, state, scheme, dt, until, observed)

    monkeypatch.setattr(Engine, "advance", counted)
    ends, costs = [], []
    quiet = dict.fromkeys(
        ("move", "turn_rad", "kick", "energy", "orthogonality", "stable_step"), False
    )
    for limits, often in ((quiet, 100_000), ({}, 100_000), ({}, 7)):
        monkeypatch.setattr(watch, "check_interval", lambda system, often=often: often)
        ends.append(Simulation(water(2.0, stages=[{"duration_ps": 0.2}], watch=limits)).run().state)
        costs.append((len(evaluated), sum(loads)))
        evaluated.clear(), loads.clear()
    for other in ends[1:]:
        assert same_bits(ends[0], other)
    (plain, steps), *watched = costs
    assert steps == 100
    assert watched == [(plain + DIRECTIONS + 1, steps)] * 2


def test_a_run_that_nobody_looks_at_is_looked_at(monkeypatch):
    monkeypatch.setattr(watch, "check_interval", lambda system: 20)
    scene = water(16.0, stages=[{"duration_ps": 160.0, "timestep_fs": 16.0}])
    silent = Scene.from_dict(
        scene.model_dump(exclude_none=True)
        | {"output": {"log_interval_ps": 1e6, "trajectory": False}}
    )
    step = int(stopped(silent).split()[3])
    assert step % 20 == 0
    assert step <= 200


@pytest.mark.parametrize("name", SCHEMES)
def test_how_far_each_scheme_follows_an_oscillator(name):
    scheme = SCHEMES[name]

    def growth(angle, steps):
        """Largest amplitude in this many steps from x = 1, v = 0, and from x = 0, v = w."""
        largest = 0.0
        for x, v in ((1.0, 0.0), (0.0, angle)):
            for _ in range(steps):
                for flow in scheme.flows:
                    if flow.kind == KICK:
                        v -= flow.fraction * angle**2 * x * (1 - flow.gradient * angle**2)
                    else:
                        x += flow.fraction * v
                largest = max(largest, abs(x))
        return largest

    limit = stable_angle(scheme)
    assert all(growth(share * limit, 300) < 100 for share in (0.1, 0.5, 0.9, 0.98))
    if name in (
        "velocity_verlet",
        "position_verlet",
        "yoshida_4",
        "suzuki_4",
        "two_stage",
        "kahan_li_6",
    ):
        assert growth(1.02 * limit, 300) > 1e3
    known = {
        "velocity_verlet": 2.0,
        "position_verlet": 2.0,
        "takahashi_imada": np.sqrt(12),
        "yoshida_4": 1.573,
    }
    assert limit == pytest.approx(known.get(name, limit), abs=2e-3)


def test_the_stiffest_motion_of_a_dimer():
    """Two argon atoms at the bottom of their well: mu w² = 57.1464 epsilon / sigma² for
    Lennard-Jones."""
    system = build(small_scene({"argon": 2}, None, forces={"truncation": "plain"}))
    argon = system.species[0]
    system.state.position[:] = [[0.0, 0.0, 0.0], [0.0, 2 ** (1 / 6) * argon.sigma[0], 0.0]]
    expected = np.sqrt(
        36 * 2 ** (2 / 3) * argon.epsilon[0] / argon.sigma[0] ** 2 / (argon.mass / 2)
    )
    assert stiffest_mode(system, system.state).rate == pytest.approx(expected, rel=1e-3)
    system.state.position[1] += 1e4
    assert (
        stiffest_mode(system, system.state) is None
        or stiffest_mode(system, system.state).rate < 1e-6
    )


def test_the_stiffest_libration_of_water_is_found_in_few_directions():
    """Against all directions one by one: the largest eigenvalue of the whole matrix of force
    differences."""
    system = build(water(2.0))
    simulation = Simulation(
        water(2.0, stages=[{"ensemble": "nvt", "temperature_K": 300.0, "duration_ps": 1.0}])
    )
    state = simulation.run().state
    few = stiffest_mode(system, state).rate
    before = stable_step.DIRECTIONS
    stable_step.DIRECTIONS = 100
    try:
        assert few == pytest.approx(stiffest_mode(system, state).rate, rel=0.03)
    finally:
        stable_step.DIRECTIONS = before


def test_in_a_large_system_a_slab_has_the_stiffest_motion(monkeypatch):
    scene = small_scene(
        {"spce": 300},
        20.8,
        stages=[{"ensemble": "nvt", "temperature_K": 300.0, "duration_ps": 1.0}],
    )
    simulation = Simulation(scene)
    state = simulation.run().state
    state.position[7] += [41.6, 0.0, -20.8]  # in which box a molecule is does not matter
    whole = stiffest_mode(simulation.system, state)
    for most in (60, 120):
        monkeypatch.setattr(stable_step, "MOST_DISPLACED", most)
        found = stiffest_mode(simulation.system, state)
        x = simulation.system.centres(state, wrapped=True)[:, 0]
        assert np.sum(x < x[found.molecule]) < most
        assert 0.8 * whole.rate < found.rate < 1.001 * whole.rate  # the stiffest of fewer


def test_a_step_that_is_too_long_is_reported_before_the_first_one(tmp_path):
    warnings = []
    watch = {"move": False, "turn_rad": False, "energy": False}
    scene = water(30.0, stages=[{"duration_ps": 0.03, "timestep_fs": 30.0}], watch=watch)
    simulation = Simulation(scene, tmp_path / "out", warn=warnings.append)
    results = simulation.run()
    assert len(warnings) == 1
    assert "stages.0: timestep_fs = 30 is longer than what is stable" in warnings[0]
    assert warnings[0] in results.summary["notes"]
    assert warnings[0] not in simulation._conclusion(results)  # it was printed before
    written = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert 5 < written["stages"][0]["stable_timestep_fs"] < 30


# one body


def top(**overrides):
    return Scene.read(
        TOP,
        {key.replace("__", "."): value for key, value in overrides.items()}
        | {f"output.{key}": value for key, value in PLAIN.items()},
    )


def test_a_body_whose_energy_goes_wrong(tmp_path, printed):
    wrong = dict(
        run__timestep_s=0.2,
        run__duration_s=100.0,
        run__integrator="velocity_verlet",
        output__interval_s=0.2,
    )
    warnings = []
    simulation = Simulation(top(**wrong), tmp_path / "out", warn=warnings.append)
    with pytest.raises(SimulationError) as caught:
        simulation.run()
    said = str(caught.value)
    assert "stopped at step 500 (100 s): the energy minus the work done changed by" in said
    assert "Try timestep_s below 0.085, where its spin and swing are stable" in said
    assert "The motion so far" in said
    assert len((tmp_path / "out" / "motion.csv").read_text().splitlines()) > 200
    assert warnings[0].startswith("run: timestep_s = 0.2 is unstable")
    sets = [
        part
        for key, value in wrong.items()
        for part in ("--set", f"{key.replace('__', '.')}={value}")
    ]
    assert (
        "rigidmd: stopped at step 500"
        in printed("run", TOP, "-o", tmp_path / "again", *sets, code=1).err
    )
    assert Simulation(top(**wrong, watch__energy=False)).run().summary[
        "stable_timestep_s"
    ] == pytest.approx(0.085, rel=1e-3)


def test_the_start_of_a_body_can_be_requested_at_any_step(printed):
    assert "kinetic" in printed("energy", TOP, "--set", "run.timestep_s=1.0").out


def test_a_body_that_is_lost_rotates_too_far_or_loses_q():
    wild = dict(run__duration_s=30.0, run__integrator="rk4", output__interval_s=0.3)
    assert "step 4 (1.2 s): position or momentum of the body is not finite" in stopped(
        top(run__timestep_s=0.3, **wild)
    )
    lost = stopped(top(run__timestep_s=0.02, **wild))
    assert "Q is not a rotation" in lost
    assert "only accuracy keeps Q a rotation under rk4" in lost
    turned = stopped(top(run__timestep_s=0.05, watch__turn_rad=1.0))
    assert "the body rotates by 3 rad in a step (watch.turn_rad = 1)" in turned


@pytest.mark.parametrize("path", BODIES, ids=lambda path: path.stem)
def test_no_shipped_body_is_stopped_or_warned_of(path):
    warnings = []
    steps = {
        "run.duration_s": 300 * Scene.read(path).run.timestep_s,
        "output.interval_s": Scene.read(path).run.timestep_s,
    }
    try:
        scene = Scene.read(path, steps | {f"output.{key}": value for key, value in PLAIN.items()})
        Simulation(scene, warn=warnings.append).run()
    except SceneError as error:
        pytest.skip(str(error))
    assert not warnings


@pytest.mark.parametrize("resistance", [1e-3, 1.0, 1e3, 1e6])
def test_a_body_falls_in_oil_of_any_thickness_as_the_closed_form_states(resistance):
    """m dv/dt = m g - c v, with steps from far below m/c to 1e5 of it."""
    results = Simulation(
        Scene.from_dict(
            {
                "body": {"mass_kg": 1.0, "solid": {"shape": "sphere", "radius_m": 0.05}},
                "gravity": {},
                "output": PLAIN,
                "start": {"velocity_m_s": [3.0, 0.0, 0.0]},
                "run": {"duration_s": 30.0, "timestep_s": 0.1},
                "fluid": {"linear_resistance_kg_s": [resistance] * 3},
            }
        )
    ).run()
    kept, terminal = np.exp(-30.0 * resistance), 9.81 / resistance
    expected = [3.0 * kept, 0.0, -terminal * (1 - kept)]
    assert results.state.velocity[0] == pytest.approx(expected, rel=1e-11, abs=1e-11 * terminal)


# the cache


def test_a_term_of_somebody_elses_spoils_no_cache(tmp_path):
    """A script with a term of its own leaves an index that names its module; another program runs
    without it."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "mylaw.py").write_text(
        "from typing import NamedTuple\nclass Term(NamedTuple):\n    k: float\n"
    )
    (tmp_path / "shared.py").write_text(
        "from rigidmd.compile import kernel\n@kernel(from_python=True)\ndef first(term):\n    return term[0]\n"
    )
    said = []
    for script, path in (
        (
            "from mylaw import Term; import shared; print(shared.first(Term(2.0)))",
            tmp_path / "mine",
        ),
        ("import shared; print(shared.first((3.0,)))", tmp_path),
    ):
        environment = os.environ | {
            "RIGIDMD_CACHE": str(tmp_path / "cache"),
            **search_path(tmp_path, path),
        }
        done = subprocess.run(
            [sys.executable, "-c", script],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        said.append(done.stdout.strip() or done.stderr)
    assert said == ["2.0", "3.0"]


def test_what_went_wrong_is_found_between_observations(monkeypatch):
    """Soon after a collapse nothing is where it was; the state at which it is seen is found by
    computing again."""
    ion = {"name": "ion", "count": 5, "sites": [site("X", 20.0, charge=-1.0)]}
    stages = [
        {"ensemble": "nvt", "temperature_K": 300.0, "duration_ps": 0.05, "timestep_fs": 1.0},
        {
            "ensemble": "nvt",
            "temperature_K": 300.0,
            "thermostat": "nose_hoover",
            "duration_ps": 2.0,
            "timestep_fs": 1.0,
        },
    ]
    scene = small_scene(
        {}, 20.0, molecules=[{"model": "tip4p2005", "count": 20}, ion], stages=stages
    )
    most_overlapping_pair, seen = watch.most_overlapping_pair, []

    def only_between(system, state, molecule):
        seen.append(int(state.step[NOW]))
        return most_overlapping_pair(system, state, molecule) if len(seen) > 2 else None

    monkeypatch.setattr(watch, "most_overlapping_pair", only_between)
    said = stopped(scene)
    assert any(f"at step {step}, " in said for step in seen[2:])
    assert "Likely cause: a charge on a site without repulsion" in said


def test_a_long_way_back_is_not_computed_again(monkeypatch):
    monkeypatch.setattr(watch, "check_interval", lambda system: 20)
    monkeypatch.setattr(watch, "MOVES_PER_CHECK", 1)
    advanced, advance = [], Engine.advance
    monkeypatch.setattr(
        Engine,
        "advance",
        lambda self, state, *rest: advanced.append(state) or advance(self, state, *rest),
    )
    scene = water(16.0, stages=[{"duration_ps": 160.0, "timestep_fs": 16.0}])
    stopped(scene)
    assert len({id(state) for state in advanced}) <= 2  # that of compiling, the value of the run


def test_a_run_that_blows_up_is_reported_and_keeps_the_last_good_state(tmp_path):
    simulation = Simulation(
        small_scene({"spce": 20}, 20.0, watch={"move": False}), tmp_path / "out"
    )
    good = simulation.system.state.position.copy()
    simulation.system.state.velocity[7] = 1e150  # gone within a step
    with pytest.raises(
        SimulationError,
        match=r"step 1 .*molecule 8 \(spce\) is lost.*timestep_fs.*step 0 .*last_good_state",
    ):
        simulation.run()
    with np.load(tmp_path / "out" / "last_good_state.npz") as saved:
        assert saved["position"] == pytest.approx(good, abs=1.0)
        assert np.isfinite(saved["position"]).all()
