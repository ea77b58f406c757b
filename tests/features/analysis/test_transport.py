"""Transport: diffusion and viscosity of random walks and made-up stresses."""

import re
from math import inf

import numpy as np
import pytest
from scipy.integrate import cumulative_trapezoid
from scipy.signal import lfilter
from support.common import history, noise_with_memory, system_of
from support.frames import TRICLINIC, brownian

from rigidmd.errors import OutputError
from rigidmd.features.analysis.built_in import transport
from rigidmd.features.analysis.built_in.rotation import orientation
from rigidmd.features.analysis.built_in.transport import MPA_S, NM2_PER_S, diffusion, msd, viscosity
from rigidmd.features.analysis.runs import Runs
from rigidmd.mechanics.rotation import random_rotations
from rigidmd.units import BAR, BOLTZMANN


# motion
def test_diffusion_is_that_of_a_random_walk_and_its_error_honest():
    """Scatter over seeds against the error that is given."""
    system = system_of({"argon": 16}, 25.0)
    D, found = 0.25, []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        walk = history(
            system, 4.0 * np.arange(400), brownian(rng, 400, 16, D, 4.0), np.eye(3) * 25.0
        )
        told = diffusion(walk, viscosity_mPa_s=0.85).value("D of argon")
        found += [] if told.value is None else [(told.value, told.error)]
    assert len(found) >= 55  # few are rejected for what is chance
    values, errors = np.array(found).T
    assert values.mean() == pytest.approx(D / NM2_PER_S, abs=4 * values.std() / np.sqrt(len(found)))
    assert 0.7 < np.sqrt(np.mean(((values - D / NM2_PER_S) / errors) ** 2)) < 1.3


@pytest.mark.parametrize("change", [0.9, 1.1])
def test_diffusion_needs_a_straight_displacement(change, monkeypatch):
    """The slope of a made-up displacement changes from one half of the fit to the other by this
    multiple of the largest change."""
    frames, interval = 400, 4.0
    first, last = 8, 40  # lags of the fit
    middle = (first + last) // 2
    ends = np.array([first, middle - 1, middle, last])
    # of t²: the slope of the line of least squares over equal steps is the sum of its two ends
    bend, slope = (ends[2] + ends[3]) - (ends[0] + ends[1]), ends[0] + ends[3]
    share = change * transport.BEND
    square = share / (bend - share * slope)
    t = np.arange(last + 1)
    displacement = interval * (t + square * t**2)
    monkeypatch.setattr(transport, "squared_displacement", lambda paths, lags: displacement[:lags])
    system = system_of({"argon": 16}, 25.0)
    path = brownian(np.random.default_rng(0), frames, 16, 0.25, interval)
    walk = history(system, interval * np.arange(frames), path, np.eye(3) * 25.0)
    found = diffusion(walk, viscosity_mPa_s=0.85).value("D of argon")
    D = (1 + square * slope) / 6 / NM2_PER_S
    if change < 1:
        assert found.value == pytest.approx(D, rel=1e-9)
    else:
        assert found.value is None
        assert "the slope of its displacement changes" in found.note


def test_the_correction_for_the_size_of_the_box_is_that_of_yeh_and_hummer():
    """2.837297 kT/(6 pi eta L): 298.15 K, 0.896 mPa s and 24.86 Å give 0.279e-9 m²/s."""
    system = system_of({"argon": 16}, 24.86)
    rng = np.random.default_rng(0)
    time, path = 4.0 * np.arange(400), brownian(rng, 400, 16, 0.25, 4.0)
    found = diffusion(
        history(system, time, path, np.eye(3) * 24.86, temperature=298.15), viscosity_mPa_s=0.896
    )
    own, infinite = found.value("D of argon"), found.value("D of argon in an infinite box")
    by_hand = 2.837297 * 1.380649e-23 * 298.15 / (6 * np.pi * 0.896e-3 * 24.86e-10) / 1e-9
    assert infinite.value - own.value == pytest.approx(by_hand, rel=1e-6)
    assert infinite.error == own.error
    alone = diffusion(history(system, time, path, np.eye(3) * 24.86))
    assert "without a viscosity" in alone.value("D of argon in an infinite box").note
    rhombic = np.array([[24.86, 0.0, 0.0], [0.0, 24.86, 0.0], [0.0, 8.0, 24.86]])
    for cell in (TRICLINIC, rhombic, np.diag([24.86, 24.86, 30.0])):
        other = diffusion(history(system, time, path, cell), viscosity_mPa_s=0.896)
        assert "for cubic boxes" in other.notes[-1] and len(other.values) == 1
    stress = relaxing(rng, 20_000, 0.02, [(1.0, 0.1)])
    tensor = tensor_of(stress, 0.05, 0.02, 24.86**3)
    measured = diffusion(history(system, time, path, np.eye(3) * 24.86, tensor=tensor))
    eta = viscosity(history(system, time, path, np.eye(3) * 24.86, tensor=tensor)).value()
    own, infinite = measured.values
    of_eta = (infinite.value - own.value) * eta.error / eta.value
    assert of_eta > 0.1 * own.error
    assert infinite.error == pytest.approx(np.hypot(own.error, of_eta), rel=1e-9)
    for wrong in (0.0, -1.0, inf, np.nan):
        with pytest.raises(OutputError, match=r"viscosity_mPa_s is .*, must be from 1e-06"):
            diffusion(history(system, time, path, np.eye(3) * 24.86), viscosity_mPa_s=wrong)


def test_what_does_not_diffuse_gives_no_value():
    """Free flight bends upwards, a cage downwards; a walk too short for neighbours to change is
    given as that."""
    system = system_of({"argon": 16}, 25.0)
    rng = np.random.default_rng(0)
    time, box = 0.5 * np.arange(400), np.eye(3) * 25.0
    flight = time[:, None, None] * rng.standard_normal((16, 3))
    cage = noise_with_memory(rng, 400, (16, 3), 1.0, 5.0, 0.5)
    for path in (flight, cage):
        (told,) = diffusion(history(system, time, path, TRICLINIC)).values
        assert (
            told.value is None and "too short for a value. A run of 798 ps follows it" in told.note
        )
        assert re.search(r"So far: -?\d.* 1e-9 m²/s$", told.note)
    (told,) = diffusion(history(system, time, brownian(rng, 400, 16, 0.25, 0.5), TRICLINIC)).values
    assert told.value is None and "correlation times" in told.note
    assert re.search(r"5 of them are \d+ ps. So far: [\d.]+ ± [\d.]+ 1e-9 m²/s$", told.note)
    with pytest.raises(OutputError, match="needs at least 40 frames; there are 39"):
        diffusion(history(system, time[:39], flight[:39], box))
    assert diffusion(history(system, time[:40], flight[:40], box)).values


def test_errors_of_a_gas_are_those_of_its_molecules():
    """Free rotors in free flight: all blocks of a run are alike, and show nothing of the scatter
    over molecules."""
    system, n, time = system_of({"nitrogen": 100}, 60.0), 100, 0.01 * np.arange(200)
    rate, speed = np.sqrt(BOLTZMANN * 300 / system.species[0].inertia[1]), 3.0
    many = rate * np.hypot(*np.random.default_rng(0).standard_normal((2, 200_000)))
    pulls, doubts = [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        frame, omega = random_rotations(rng, n), rate * np.hypot(*rng.standard_normal((2, n)))
        angle = omega * time[:, None]
        plane = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        along, beside = (
            np.einsum("fni,nij->fnj", plane @ turn, frame[:, :2])
            for turn in ([[1, 0], [0, 1]], [[0, 1], [-1, 0]])
        )
        Q = np.stack([along, beside, np.broadcast_to(frame[:, 2], along.shape)], axis=-1)
        flight = speed * time[:, None, None] * rng.standard_normal((n, 3))
        gas = history(system, time, flight, np.eye(3) * 60, Q)
        turned, moved = orientation(gas), msd(gas)
        late = slice(3, None)
        lag = turned["Time (ps)"][late]
        for found, title, truth in (
            (turned, "C1 nitrogen axis 1", np.cos(many[:, None] * lag).mean(axis=0)),
            (moved, "MSD nitrogen (A^2)", 3 * (speed * lag) ** 2),
        ):
            pulls.append((found[title][late] - truth) / found[f"{title} error"][late])
        doubts.append(
            turned["C1 nitrogen axis 1 error"][late][-1]
            / np.std(np.cos(many * lag[-1]))
            * np.sqrt(n)
        )
    for which in (0, 1):
        assert 0.6 < np.sqrt(np.mean(np.array(pulls[which::2]) ** 2)) < 1.3
    assert np.mean(doubts) == pytest.approx(1.0, abs=0.25)


# flow
def stresses(rng, frames, eta, forget, interval, volume):
    """A pressure tensor (f, 7), bar, whose five components decay within `forget` ps to a viscosity
    eta (mPa s)."""
    variance = eta * MPA_S * BOLTZMANN * 300 / volume / forget / BAR**2
    tensor = noise_with_memory(rng, frames, (6,), variance, forget, interval)
    tensor[:, :3] *= np.sqrt(2)  # so that half the difference of two has that variance
    return np.column_stack([interval * np.arange(frames), tensor])


def relaxing(rng, frames, interval, parts):
    """Series (f, 5) whose correlation has the integrals and times (ps) of parts, in sum 1."""
    found = np.zeros((frames, 5))
    for part, time in parts:
        keep = np.exp(-interval / time)
        noise = np.sqrt(1 - keep**2) * rng.standard_normal((frames, 5))
        noise[0] /= np.sqrt(1 - keep**2)
        found += np.sqrt(part / time) * lfilter([1], [1, -keep], noise, axis=0)
    return found


def tensor_of(stress, eta, interval, volume):
    """A pressure tensor (f, 7), bar, with these five components, for a viscosity eta (mPa s) at 300
    K."""
    unit = np.sqrt(eta * MPA_S * BOLTZMANN * 300 / volume) / BAR
    tensor = np.zeros((len(stress), 7))
    tensor[:, 0] = interval * np.arange(len(stress))
    tensor[:, 1], tensor[:, 3] = 2 * unit * stress[:, 3], -2 * unit * stress[:, 4]
    tensor[:, 4:] = unit * stress[:, :3]
    return tensor


RELAXATIONS = {
    "one": [(1.0, 0.1)],
    "water": [(0.25, 0.03), (0.45, 0.4), (0.30, 1.2)],
    "slow": [(0.3, 0.05), (0.35, 0.5), (0.35, 2.5)],
}
FEW, MANY = 10, pytest.param(60, marks=pytest.mark.soak)


@pytest.mark.parametrize("seeds", [FEW, MANY])
@pytest.mark.parametrize(
    ("name", "runs", "length"), [("one", 1, 100.0), ("water", 1, 100.0), ("slow", 8, 40.0)]
)
def test_the_viscosity_is_the_integral_of_the_stress_and_its_error_honest(
    name, runs, length, seeds
):
    """Also where a part of it relaxes slowly, beyond the time at which an integral is lost in
    noise."""
    system, found, interval = system_of({"argon": 8}, 25.0), [], 0.02
    frames, pulls = int(length / interval), []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        series = [relaxing(rng, frames, interval, RELAXATIONS[name]) for _ in range(runs)]
        members = [
            history(
                system,
                [0.0, length],
                None,
                np.eye(3) * 25.0,
                tensor=tensor_of(x, 0.85, interval, 25.0**3),
            )
            for x in series
        ]
        result = viscosity(Runs(tuple(members)))
        told, time = result.value(), result["Time (ps)"]
        if told.value is not None:
            found.append((told.value, told.error))
        exact = 0.85 * sum(part * (1 - np.exp(-time / tau)) for part, tau in RELAXATIONS[name])
        late = slice(len(time) // 4, None, len(time) // 4)
        off = result["integral (mPa s)"] - exact
        pulls.append((off[late] / result["integral (mPa s) error"][late])[:3])
    values, errors = np.array(found).T
    assert len(found) > 0.8 * seeds
    assert values.mean() == pytest.approx(0.85, abs=4 * values.std(ddof=1) / np.sqrt(len(found)))
    assert 0.4 < np.sqrt(np.mean(((values - 0.85) / errors) ** 2)) < 1.7
    assert np.median(errors) < (0.15 if name == "one" else 0.35) * 0.85
    assert 0.7 < np.sqrt(np.mean(np.square(pulls))) < 1.5  # of the running integral


def test_a_viscosity_has_the_correlation_time_of_the_stress():
    system, box = system_of({"argon": 8}, 25.0), np.eye(3) * 25.0
    stress = relaxing(np.random.default_rng(1), 20_000, 0.02, [(1.0, 0.1)])
    tensor = tensor_of(stress, 0.85, 0.02, 25.0**3)
    found = viscosity(history(system, [0.0, 400.0], None, box, tensor=tensor))
    assert found.value().correlation_ps == pytest.approx(0.1, rel=0.2)
    assert found["fit (mPa s)"][-1] == pytest.approx(
        found["integral (mPa s)"][-1], abs=3 * found["integral (mPa s) error"][-1]
    )
    integral = found["integral (mPa s)"]
    expected = cumulative_trapezoid(found["correlation"], initial=0)
    assert integral / integral[1] == pytest.approx(expected / expected[1], rel=1e-9)


def test_a_viscosity_needs_stresses_long_enough_and_close_enough():
    system, time, box = system_of({"argon": 8}, 25.0), [0.0, 400.0], np.eye(3) * 25.0
    tensor = stresses(np.random.default_rng(0), 2000, 0.85, 0.1, 0.02, 25.0**3)
    for lines, words in (
        (None, "needs the pressure tensor"),
        (tensor[:1], "needs the pressure tensor"),
        (tensor[:990], r"tensor; there are 19.8 ps"),
        (tensor[np.r_[:500, 600:2000]], "at equal intervals"),
        (tensor[::10], "an interval of 0.2 ps of the pressure tensor is too long"),
        (tensor[::100], "an interval of 2 ps of the pressure tensor is too long"),
    ):
        with pytest.raises(OutputError, match=words):
            viscosity(history(system, time, None, box, tensor=lines))
    with pytest.raises(OutputError, match="needs a box"):
        viscosity(history(system, time, None, tensor=tensor))
    slow = stresses(np.random.default_rng(0), 2000, 0.85, 20.0, 0.02, 25.0**3)
    told = viscosity(history(system, time, None, box, tensor=slow)).value()
    assert told.value is None and "too short for a value. A run of 160 ps follows it" in told.note
    assert re.search(r"So far: [\d.]+ ± [\d.]+ mPa s$", told.note)
