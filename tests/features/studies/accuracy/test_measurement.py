"""Measurements of accuracy: timings, ladders of steps, starts."""

import dataclasses

import numpy as np
import pytest
from support.accuracy import TOP, trials
from support.common import ROOT, small_scene

from rigidmd.core.integrators import SCHEMES
from rigidmd.errors import SimulationError
from rigidmd.features.bodies.trials import body_trial_system
from rigidmd.features.studies.accuracy import measurement
from rigidmd.features.studies.accuracy.accuracy import (
    measure_accuracy,
    recommendations,
    trial_table,
)
from rigidmd.features.studies.accuracy.measurement import measure, time_span
from rigidmd.run.trials import Method, Trial
from rigidmd.scene import Scene


class Clockwork:
    """An engine, and the clock: steps take 1 ms, a call 5 ms, and the first three steps of a new
    engine 30 ms more."""

    now = 0.0

    def __init__(self, made, lasts=10**9):
        self.cold, self.at, self.lasts = 3, 0, lasts
        made.append(self)

    def begin(self, state, scheme):
        """As `Engine.begin`."""
        return state.copy()

    def advance(self, state, scheme, dt, until, observed=False):
        """As `Engine.advance`."""
        steps, self.at = max(0, until - self.at), until
        if self.at > self.lasts:
            raise SimulationError("no further")
        Clockwork.now += 5e-3 + 1e-3 * steps + 30e-3 * min(steps, self.cold)
        self.cold -= min(steps, self.cold)

    def forget(self):
        """As `Engine.forget`."""


@pytest.fixture
def clockwork(monkeypatch):
    """(subject, engines made) of a subject moved by clockwork, for a given lifetime in steps."""
    monkeypatch.setattr(measurement, "TIMING_SECONDS", 0.2)
    monkeypatch.setattr(measurement.clock, "perf_counter", lambda: Clockwork.now)

    def trial_system(can_continue, lasts=10**9):
        made = []
        method = Method(lambda timestep: Clockwork(made, lasts), SCHEMES["velocity_verlet"])
        own, _ = body_trial_system(Scene.read(TOP), 0.1)
        return dataclasses.replace(
            own, methods={"velocity_verlet": method}, can_continue=can_continue
        ), made

    return trial_system


@pytest.mark.parametrize("steps", [1, 25, 1000])
@pytest.mark.parametrize("can_continue", [False, True])
def test_a_timing_is_of_warm_steps_and_of_nothing_else(clockwork, steps, can_continue):
    """25 steps of 216 waters took 40 ms where a new engine began with them, and 20 ms after
    that."""
    trial_system, made = clockwork(can_continue)
    began = Clockwork.now
    seconds = time_span(trial_system, Trial("velocity_verlet", 1e-3, steps, steps))
    assert seconds == pytest.approx(1e-3 * steps)
    assert Clockwork.now - began > 0.2
    assert len(made) == 1
    spans = -(-0.2 // (5e-3 + 1e-3 * steps))
    assert made[0].at == (steps * spans if can_continue else 0)


def test_a_step_that_is_good_for_the_span_only_is_timed_on_the_span(clockwork):
    trial_system, made = clockwork(can_continue=True, lasts=60)
    assert time_span(trial_system, Trial("velocity_verlet", 1e-3, 25, 25)) == pytest.approx(0.025)
    assert made[0].at <= 60
    trial_system, _ = clockwork(can_continue=True, lasts=20)
    with pytest.raises(SimulationError):
        time_span(trial_system, Trial("velocity_verlet", 1e-3, 25, 25))


def test_timings_alternate_between_trials(monkeypatch):
    order = []
    monkeypatch.setattr(
        measurement,
        "time_span",
        lambda trial_system, trial: order.append(trial.steps) or 1e-3 * len(order),
    )
    trial_system, _ = body_trial_system(Scene.read(TOP), 0.01)
    trials = [Trial("velocity_verlet", 0.01 / n, n, n) for n in (2, 3, 4)]
    fractions = []
    measure(trial_system, trials, 2, progress=fractions.append)
    assert order == [2, 3, 4, 2, 3, 4]
    assert [trial.seconds for trial in trials] == [[1e-3, 4e-3], [2e-3, 5e-3], [3e-3, 6e-3]]
    assert fractions == pytest.approx(np.arange(1, 7) / 6)


@pytest.mark.parametrize(
    ("longest", "steps"), [(0.05, [12, 25, 50, 100]), (1.0, [6, 12, 25, 50, 100])]
)
def test_ladders_continue_to_longer_steps_until_one_fails_or_is_too_long_for_the_span(
    longest, steps, monkeypatch
):
    def measure_errors(trial_system, trial, exact):
        trial.energy_rms = 1e-9
        trial.failure = "diverges" if trial.timestep > longest else ""

    trial_system, _ = body_trial_system(Scene.read(TOP), 1.0)
    monkeypatch.setattr(measurement, "measure_errors", measure_errors)
    monkeypatch.setattr(measurement, "final_state", lambda *_: trial_system.state)
    monkeypatch.setattr(measurement, "time_span", lambda *_: 1.0)
    for extend, expected in ((True, steps), (False, [50, 100])):
        trials = measurement.plan(trial_system, {"velocity_verlet": [0.02, 0.01]})
        found = measure(trial_system, trials, 1, extend=extend).trials
        assert [trial.steps for trial in found] == expected
        assert [trial.diverged for trial in found] == [trial.timestep > longest for trial in found]


def test_a_step_that_is_too_long_diverges_and_is_stopped():
    scene = Scene.read(ROOT / "systems" / "water_dimer.toml")
    found = measure_accuracy(scene, ["velocity_verlet"], [1.0, 80.0], span=2.4, repeats=1)
    good, bad = found.trials
    assert not good.diverged
    assert bad.diverged
    assert bad.seconds == []
    assert found.bounded("velocity_verlet")[0].timestep == pytest.approx(1.0)
    assert "velocity_verlet diverges beyond 1 fs" in "\n".join(recommendations(found))
    assert "fails" in trial_table(found).text()


def test_molecules_start_where_the_last_stage_does():
    stages = [{"ensemble": "nvt", "temperature_K": 200.0, "duration_ps": 0.2}, {"duration_ps": 1.0}]
    scene = small_scene({"nitrogen": 8}, 18.5, stages=stages)
    found = measure_accuracy(scene, ["velocity_verlet", "srkn_6"], [4.0, 2.0], repeats=1)
    assert "kT per degree of freedom, at the" in "\n".join(recommendations(found))
    verlet = trials(found, "velocity_verlet")
    assert verlet[0].energy_rms / verlet[1].energy_rms == pytest.approx(4, rel=0.15)
    assert all(trial.position_error < 1 for trial in found.trials)


def test_steps_suit_what_is_fast_in_a_body():
    compass = measure_accuracy(
        Scene.read(ROOT / "systems" / "gyrocompass.toml"), ["kahan_li_6"], span=60.0, repeats=1
    )
    # the wheel's nutation, 20 rad/s, sets the steps, not the Earth's rotating
    assert not any(trial.diverged for trial in compass.trials[-3:])
    assert compass.trials[-1].rotation_error < 1e-6
