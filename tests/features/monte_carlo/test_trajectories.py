"""Hybrid Monte Carlo: exact for every scheme, rejections without a trace, the choice of a step,
clear refusals."""

import numpy as np
import pytest
from support.common import built, small_scene

import rigidmd
from rigidmd.assemble.build import integrator_of_stage
from rigidmd.core.integrators import SCHEMES
from rigidmd.core.statistics import mean_and_error
from rigidmd.errors import SceneError, SimulationError
from rigidmd.run import Simulation
from rigidmd.scene import Scene
from rigidmd.units import BOLTZMANN

HYBRID = {"ensemble": "nvt", "temperature_K": 120.0, "thermostat": "hybrid_monte_carlo"}
KEPT = {"momentum_refreshment": 1e-20}
GRADIENT = next(name for name, scheme in SCHEMES.items() if scheme.has_gradient)
MIXTURE = {"argon": 6, "nitrogen_trappe": 6, "spce": 6}  # points, linear and asymmetric bodies


def sampled(stage: dict, counts: dict[str, int], edge: float, interval: float, **sections):
    """The results of a run and its simulation."""
    output = {"trajectory": False, "figures": False, "log_interval_ps": interval}
    tables = {
        "forces": {"cutoff_A": 5.0, "electrostatics": "none"},
        "stages": [HYBRID | stage],
        "output": output,
    }
    simulation = Simulation(small_scene(counts, edge, **tables | sections))
    return simulation.run(), simulation


@pytest.mark.parametrize("name", SCHEMES)
def test_the_weights_of_every_integrator_have_the_mean_one(name):
    """<exp(-dH/kT)> = 1 needs reversible flows that keep volumes in phase space, and momenta that
    fit kT."""
    step = {"kahan_li_8": 60.0, "kahan_li_6": 60.0}.get(name, 30.0)
    stage = {
        "integrator": name,
        "timestep_fs": step,
        "trajectory_steps": 6,
        "duration_ps": 6 * step * 0.4,
    }
    results, _ = sampled(stage, {"nitrogen_trappe": 12, "argon": 4}, 13.0, 6 * step / 1000)
    weights = results["exp_minus_dH"][40:]
    size = results["abs_dH"][40:].mean()
    assert 1e-5 < size < 5, size  # neither exact, which proves nothing, nor rejected
    assert abs(weights.mean() - 1) < 4.5 * mean_and_error(weights)[1]


def test_a_rejected_trajectory_leaves_no_trace():
    """Positions and orientations return to the same bits, momenta to the negative of those at the
    start, which a refreshment lost in rounding leaves as they were; and the forces are the values of the
    start."""
    system, engine, state = built(
        MIXTURE,
        12.0,
        forces={"cutoff_A": 5.0},
        stages=[HYBRID | {"timestep_fs": 40.0, "trajectory_steps": 5, "duration_ps": 1.0} | KEPT],
    )
    scheme, dt = integrator_of_stage(system, 0), 0.04
    engine.evaluate(state)
    now, seen = engine.begin(state, scheme), []
    for k in range(1, 30):
        before = now.copy()
        engine.advance(now, scheme, dt, 5 * k, observed=True)
        ended, accepted, *_ = engine.extension_sums
        if ended - accepted > len(seen):
            seen.append(k)
            assert np.array_equal(now.position, before.position) and np.array_equal(
                now.rotation, before.rotation
            )
            assert np.array_equal(now.velocity, -before.velocity)
            assert np.array_equal(now.angular_momentum_body, -before.angular_momentum_body)
            load, _ = engine.evaluate(now)
            np.testing.assert_allclose(
                engine.load.force, load.force, rtol=1e-9, atol=1e-9 * np.abs(load.force).max()
            )
            assert now.time[0] == pytest.approx(5 * k * dt)
    assert len(seen) > 5


PRESSED = {"ensemble": "npt", "pressure_bar": 100.0, "barostat_interval_ps": 0.25}


@pytest.mark.parametrize("pressed", [{}, PRESSED, PRESSED | {"integrator": "position_verlet"}])
def test_energy_less_heat_and_work_is_conserved(pressed):
    """Accepted errors of the energy are heat, and not a drift; rejected ones leave none,
    also if the next move of the box needs the virial, and if a step ends with a drift."""
    stage = {"timestep_fs": 50.0, "trajectory_steps": 5, "duration_ps": 20.0} | pressed
    forces = {"cutoff_A": 5.0, "electrostatics": "none", "tail_correction": False}
    results, _ = sampled(stage, MIXTURE, 13.0, 0.25, forces=forces, precision="double")
    assert 0 < results["acceptance"][1:].mean() < 1
    assert np.abs(results["drift"]).max() < 1e-8 * np.abs(results["energy"]).max()


def test_a_part_of_each_momentum_is_kept():
    """After an accepted trajectory momenta have correlation sqrt(1 - r) with those before the
    refreshment."""
    stages = [
        HYBRID
        | {
            "timestep_fs": 1.0,
            "trajectory_steps": 1,
            "momentum_refreshment": 0.3,
            "duration_ps": 1.0,
        }
    ]
    system, engine, state = built({"argon": 400}, 90.0, spread=0.0, stages=stages)
    rng, model = np.random.default_rng(1), system.model
    state.velocity[:] = rng.standard_normal((400, 3)) * np.sqrt(
        BOLTZMANN * 120.0 * model.inverse_mass[0]
    )
    scheme = integrator_of_stage(system, 0)
    now = engine.begin(state, scheme)
    before = now.velocity.copy()
    engine.advance(now, scheme, 0.001, 1)
    assert np.corrcoef(before.ravel(), now.velocity.ravel())[0, 1] == pytest.approx(
        np.sqrt(0.7), abs=0.05
    )


def test_auto_chooses_step_and_length():
    results, simulation = sampled(
        {"integrator": "auto", "duration_ps": 60.0},
        {"nitrogen_trappe": 24},
        14.0,
        0.2,
        precision="double",
    )
    stage = simulation.scene.stages[0]
    chosen = results.summary["stages"][0]["choice"]
    assert (
        stage.trajectory_steps > 1
        and stage.integrator in chosen
        and "per force evaluation" in chosen
    )
    assert results["acceptance"][1:].mean() > 0.3
    given = sampled(
        {"integrator": "auto", "duration_ps": 1.0, "trajectory_steps": 7},
        {"nitrogen_trappe": 24},
        14.0,
        0.2,
    )
    assert given[1].scene.stages[0].trajectory_steps == 7


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"integrator": "baoab"}, "baoab contains a thermostat of its own"),
        ({"integrator": "auto", "bias_kT": 0.01}, "bias_kT would have no effect"),
        ({"momentum_refreshment": 0.0}, "momentum_refreshment"),
        (
            {"thermostat": "langevin", "trajectory_steps": 10},
            "trajectory_steps would have no effect with langevin",
        ),
        ({"trajectory_steps": 0}, "trajectory_steps"),
    ],
)
def test_settings_that_contradict_it_are_refused(changes, message):
    stage = HYBRID | {"duration_ps": 1.0} | changes
    data = {
        "molecules": [{"model": "argon", "count": 10}],
        "box": {"density_g_cm3": 1.0},
        "stages": [stage],
    }
    with pytest.raises(SceneError, match=message):
        Scene.from_dict(data)


def test_fields_that_depend_on_time_are_refused():
    field = {"electric_V_per_nm": [0.0, 0.0, 0.1], "electric_frequency_per_ps": 1.0}
    with pytest.raises(
        SceneError,
        match=r"stages\.0: hybrid_monte_carlo needs an energy that does not depend on time",
    ):
        Simulation(
            small_scene(
                {"spce": 4},
                12.0,
                stages=[HYBRID | {"duration_ps": 1.0}],
                fields=field,
                forces={"cutoff_A": 5.0},
            )
        )


@pytest.mark.parametrize("name", ["velocity_verlet", "position_verlet", GRADIENT])
def test_a_trajectory_that_diverges_is_rejected(name):
    """Its step throws molecules out of all numbers. The run continues from the start of the
    trajectory, a rejection is not a drift, and a note shows of few trajectories too."""
    stage = {"integrator": name, "timestep_fs": 3000.0, "trajectory_steps": 4, "duration_ps": 48.0}
    watch = {"move": False, "energy": False, "kick": False, "turn_rad": False}
    results, simulation = sampled(
        stage, {"nitrogen_trappe": 12, "argon": 4}, 13.0, 12.0, watch=watch
    )
    start = Simulation(simulation.scene)
    start._start()
    assert np.array_equal(results.state.position, start.state.position)
    assert results["acceptance"][1:].tolist() == [0.0] * 4
    assert np.isfinite(results["abs_dH"][1:]).all()
    assert np.abs(results["drift"]).max() < 1e-9 * np.abs(results["energy"]).max()
    assert any(
        "0.0% of the trajectories were accepted" in note for note in results.summary["notes"]
    )
    assert results.summary["stages"][0]["trajectories"] == 4


class Pen(rigidmd.Force):
    """A force of 0 that cannot be computed where a site is too far from its start."""

    name, reach = "pen", 1.0  # Å

    def __init__(self, beyond):
        self.beyond = beyond

    def begin(self, system):
        self.start = system.state.position.copy()

    def at(self, position):
        assert np.isfinite(position).all()
        energy, force = 0.0, np.zeros_like(position)
        return self.beyond(force) if self.is_beyond(position) else (energy, force)

    def is_beyond(self, position):
        return bool(np.abs(position - self.start).max() > self.reach)


class PenOfSites(Pen):
    def on_sites(self, position, state):
        return self.at(position)


class PenOfMolecules(Pen):
    def on_molecules(self, state):
        return self.at(state.position)


def run_in(pen):
    """Trajectories of 0.1 ps, of which some leave the pen."""
    stage = HYBRID | {"timestep_fs": 10.0, "trajectory_steps": 10, "duration_ps": 4.0}
    output = {"trajectory": False, "figures": False, "log_interval_ps": 0.1}
    tables = {"forces": {"cutoff_A": 5.0}, "stages": [stage], "output": output}
    return Simulation(small_scene({"argon": 8}, 16.0, **tables), forces=[pen], warn=str).run()


@pytest.mark.parametrize("kind", [PenOfSites, PenOfMolecules])
@pytest.mark.parametrize(
    "beyond",
    [
        lambda force: (np.nan, force),
        lambda force: (0.0, force + np.nan),
        lambda force: (np.inf, force),
    ],
    ids=["energy", "forces", "infinite"],
)
def test_a_trajectory_whose_python_force_is_not_finite_is_rejected(kind, beyond):
    pen = kind(beyond)
    results = run_in(pen)
    assert not pen.is_beyond(results.state.position)
    assert 0.05 < results["acceptance"][1:].mean() < 0.95
    assert np.isfinite(results["potential"]).all()
    assert np.abs(results["drift"]).max() < 1e-9


def test_an_exception_of_a_python_force_ends_the_run():
    def fail(force):
        raise ZeroDivisionError("too far")

    with pytest.raises(
        SimulationError, match="on_sites of the force pen raised ZeroDivisionError: too far"
    ):
        run_in(PenOfSites(fail))


def test_every_metropolis_test_has_its_own_random_number():
    """For many tests of the same trajectory, with the same dH, a fraction exp(-dH/kT) is
    accepted."""
    stages = [HYBRID | {"timestep_fs": 40.0, "trajectory_steps": 5, "duration_ps": 1.0} | KEPT]
    system, engine, state = built(MIXTURE, 12.0, forces={"cutoff_A": 5.0}, stages=stages)
    scheme = integrator_of_stage(system, 0)
    now = engine.begin(state, scheme)
    thermal = np.sqrt(BOLTZMANN * 120.0 * system.model.inverse_mass[system.model.species])
    now.velocity[:] = thermal[:, None] * np.random.default_rng(2).standard_normal(
        now.velocity.shape
    )
    engine.advance(now, scheme, 0.002, 500)
    kept, steps = now.copy(), 500

    def again(dt):
        """The chance of the trajectory from the kept state, and whether it was accepted this
        time."""
        nonlocal steps
        for name in ("position", "rotation", "velocity", "angular_momentum_body"):
            getattr(now, name)[:] = getattr(kept, name)
        engine.forget()
        before, steps = engine.extension_sums, steps + 5
        engine.advance(now, scheme, dt, steps, observed=True)
        _, accepted, _, chance, _ = engine.extension_sums - before
        return chance, accepted

    dt = next(dt for dt in np.arange(0.003, 0.02, 0.0005).tolist() if 0.2 < again(dt)[0] < 0.8)
    chances, outcomes = np.transpose([again(dt) for _ in range(60)])
    assert np.ptp(chances) < 1e-6
    assert abs(outcomes.mean() - chances[0]) < 4 * np.sqrt(chances[0] * (1 - chances[0]) / 60)


def test_few_accepted_trajectories_are_noted():
    results, _ = sampled(
        {"timestep_fs": 75.0, "trajectory_steps": 4, "duration_ps": 20.0}, {"argon": 900}, 36.0, 0.3
    )
    assert any("trajectories were accepted" in note for note in results.summary["notes"])


def test_intervals_are_whole_trajectories():
    results, simulation = sampled(
        {"timestep_fs": 2.0, "trajectory_steps": 30, "duration_ps": 0.5}, MIXTURE, 14.0, 0.1
    )
    assert np.diff(results["step"]).tolist() == [60, 60, 60, 60]
    assert any(
        "whole number of trajectories of 30 steps of 2 fs" in note
        for note in simulation.system.notes
    )
