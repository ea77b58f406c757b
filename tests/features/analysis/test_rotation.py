"""Rotation: times of rotational diffusion, dipoles and dielectric constants, nematic order."""

import re
from math import inf

import numpy as np
import pytest
from support.common import history, small_scene, system_of
from support.frames import rotations_about

from rigidmd.assemble.build import build
from rigidmd.errors import OutputError
from rigidmd.features.analysis.built_in.rotation import dielectric, orientation
from rigidmd.features.analysis.runs import Runs
from rigidmd.mechanics.rotation import random_rotations
from rigidmd.units import BOLTZMANN, COULOMB


# rotating
def test_free_rotational_diffusion_decays_as_it_must():
    """C1 = exp(-2 D t), C2 = exp(-6 D t) of a sphere that rotates at random."""
    system = system_of({"ccl4": 60}, 60.0, 9.0)
    D, interval, frames, rng = 0.05, 0.4, 600, np.random.default_rng(2)
    turns = rotations_about(np.sqrt(2 * D * interval) * rng.standard_normal((frames, 60, 3)))
    Q = np.empty((frames, 60, 3, 3))
    Q[0] = random_rotations(rng, 60)
    for k in range(1, frames):
        Q[k] = Q[k - 1] @ turns[k]
    found = orientation(history(system, interval * np.arange(frames), None, np.eye(3) * 60, Q))
    # mean cosine and P2 of one rotation, exact for steps of a finite size
    angle = np.linalg.norm(np.sqrt(2 * D * interval) * rng.standard_normal((400_000, 3)), axis=1)
    once = [
        (1 + 2 * np.cos(angle)).mean() / 3,
        (1 + 2 * np.cos(angle) + 2 * np.cos(2 * angle)).mean() / 5,
    ]
    time = found["Time (ps)"]
    for axis in (1, 2, 3):
        for l in (1, 2):  # noqa: E741
            title = f"C{l} ccl4 axis {axis}"
            rate = -np.log(once[l - 1]) / interval
            expected, error = np.exp(-rate * time), found[f"{title} error"]
            assert found[title][0] == pytest.approx(1.0, abs=1e-12)
            assert np.all(np.abs(found[title] - expected) < 5 * np.maximum(error, np.median(error)))
            tau = found.value(f"tau{l} of ccl4, axis {axis}")
            assert abs(tau.value - 1 / rate) < 4 * tau.error + 0.02 / rate
            assert tau.error < 0.1 / rate
            assert rate == pytest.approx((2, 6)[l - 1] * D, rel=0.05)
        told = found.value(f"D_rot of ccl4, axis {axis}")
        assert abs(told.value - D) < 4 * told.error
        assert told.error < 0.1 * D


def test_what_barely_rotates_or_rotates_too_fast_gives_no_time():
    system = system_of({"ccl4": 8}, 40.0, 9.0)
    rng, time = np.random.default_rng(0), np.arange(100.0)
    still = np.broadcast_to(random_rotations(rng, 8), (100, 8, 3, 3))
    told = orientation(history(system, time, None, np.eye(3) * 40, still)).value(
        "tau1 of ccl4, axis 1"
    )
    assert told.value is None and told.note == (
        "C1 is still 1.00 after 10 ps, too short for a value. It needs more than 8e+03 ps. So far: 10 ps"
    )
    wild = random_rotations(rng, 800).reshape(100, 8, 3, 3)
    told = orientation(history(system, time, None, np.eye(3) * 40, wild)).value(
        "D_rot of ccl4, axis 1"
    )
    assert told.value is None and "between frames, every 1 ps: write more of them" in told.note
    with pytest.raises(OutputError, match="no molecule of this run rotates"):
        orientation(history(system_of({"argon": 2}), time, None, np.eye(3) * 40))


# electric
def dipoles(rng, system, frames, time, interval):
    """Q (f, n, 3, 3) of molecules that keep their dipoles along or against the axes of the lab,
    each a telegraph."""
    n = len(system.model.species)
    change = 0.5 * (1 - np.exp(-interval / time))
    signs = np.cumprod(np.where(rng.random((frames, n)) < change, -1, 1), axis=0) * rng.choice(
        [-1, 1], n
    )
    dipole = system.species[0].charges @ system.species[0].positions_body
    along = int(np.abs(dipole).argmax())
    Q = np.zeros((frames, n, 3, 3))
    for k in range(n):
        Q[:, k, k % 3, along] = signs[:, k] * np.sign(dipole[along])
        Q[:, k, (k + 1) % 3, (along + 1) % 3] = signs[:, k]
        Q[:, k, (k + 2) % 3, (along + 2) % 3] = 1.0
    return Q, float(np.linalg.norm(dipole))


FORCES = {
    "tin foil": {"electrostatics": "pme"},
    "vacuum": {"electrostatics": "ewald", "ewald_surface_permittivity": 1.0},
    "water around": {"electrostatics": "ewald", "ewald_surface_permittivity": 80.0},
    "reaction field": {"electrostatics": "reaction_field", "reaction_field_permittivity": 78.5},
    "conducting": {"electrostatics": "reaction_field", "reaction_field_permittivity": inf},
}


@pytest.mark.parametrize("name", FORCES)
def test_the_dielectric_constant_of_independent_dipoles(name):
    """<M²> = n mu², in a box that makes epsilon 2.3 with tin foil and 3.2 in vacuum; time of the
    dipole 2 ps."""
    scene = {"forces": {"cutoff_A": 7.0} | FORCES[name]}
    system = build(small_scene({"spce": 30}, 24.0, **scene))
    Q, mu = dipoles(np.random.default_rng(4), system, 4000, 2.0, 0.5)
    frames = history(system, 0.5 * np.arange(4000), None, np.eye(3) * 24.0, Q)
    result = dielectric(frames)
    found, so_far = result.value(), result["dielectric constant"]
    assert so_far[[999, -1]] == pytest.approx(
        [dielectric(frames[:1000])["dielectric constant"][-1], found.value]
    )
    y = 4 * np.pi * COULOMB * 30 * mu**2 / (3 * 24.0**3 * BOLTZMANN * 300)
    around = {"vacuum": 1.0, "water around": 80.0, "reaction field": 78.5}.get(name)
    epsilon = found.value
    if around is None:
        assert abs(epsilon - 1 - y) < 4 * found.error
        back = epsilon - 1
    else:
        back = (epsilon - 1) * (2 * around + 1) / (2 * around + epsilon)
    assert found.correlation_ps == pytest.approx(2.0, rel=0.3)
    assert 0.005 < found.error / epsilon < 0.1
    M = np.einsum("fnij,j->fi", Q, system.species[0].charges @ system.species[0].positions_body)
    seen = np.mean(np.sum(M**2, axis=1)) / (30 * mu**2)  # <M> is 0
    assert back == pytest.approx(y * seen, rel=1e-9)
    assert seen == pytest.approx(1.0, abs=0.2)


def test_the_error_of_a_dielectric_constant_is_honest():
    system = build(
        small_scene({"spce": 30}, 14.5, forces={"cutoff_A": 7.0, "electrostatics": "pme"})
    )
    found = []
    for seed in range(60):
        Q, _ = dipoles(np.random.default_rng(seed), system, 600, 2.0, 0.5)
        told = dielectric(history(system, 0.5 * np.arange(600), None, np.eye(3) * 14.5, Q)).value()
        found.append((told.value, told.error))
    values, errors = np.array(found, float).T
    assert 0.6 < values.std() / np.sqrt(np.mean(errors**2)) < 1.6


@pytest.mark.parametrize(("runs", "frames"), [(1, 300), (8, 60)])
def test_a_dielectric_constant_has_no_bias_of_short_runs(runs, frames):
    """Runs of 15 correlation times, and eight of three that are too short by themselves: <M> is 0,
    and is not subtracted as a mean of each run would be."""
    system = build(
        small_scene({"spce": 30}, 14.5, forces={"cutoff_A": 7.0, "electrostatics": "pme"})
    )
    found, time, box = [], 0.5 * np.arange(frames), np.eye(3) * 14.5
    for seed in range(60):
        rng = np.random.default_rng(seed)
        every = [dipoles(rng, system, frames, 10.0 if runs == 1 else 5.0, 0.5) for _ in range(runs)]
        told = dielectric(Runs(tuple(history(system, time, None, box, Q) for Q, _ in every)))
        value = told.value()
        if runs == 1:
            so_far = re.search(r"too short for a value; .* So far: ([\d.]+) ± ([\d.]+)", value.note)
            found.append(
                [float(text) for text in so_far.groups()] if so_far else value[2:4]
            )  # 15 of 20 are
        else:
            found.append((value.value, value.error))
    mu = every[0][1]
    truth = 1 + 4 * np.pi * COULOMB * 30 * mu**2 / (3 * 14.5**3 * BOLTZMANN * 300)
    values, errors = np.array(found, float).T
    assert values.mean() == pytest.approx(truth, abs=3 * values.std() / np.sqrt(60))
    assert 3 * values.std() / np.sqrt(60) < 0.13 * truth
    assert 0.7 < np.sqrt(np.mean(((values - truth) / errors) ** 2)) < 1.6
    mean = [told.value(f"mean total dipole along {axis}") for axis in "xyz"]
    assert all(abs(value.value) < 5 * value.error for value in mean)


def test_a_mean_dipole_that_is_subtracted_hides_nothing_of_the_fluctuation():
    """A restraint breaks the symmetry; the same dipoles, of 40 correlation times, without and with
    it."""
    restraint = {"between": [1, 2], "distance_A": 3.0, "stiffness_kJ_mol_A2": 20.0}
    forces = {"cutoff_A": 7.0, "electrostatics": "pme"}
    systems = [
        build(small_scene({"spce": 30}, 14.5, forces=forces, **fields))
        for fields in ({}, {"fields": {"restraints": [restraint]}})
    ]
    time, box, found = 0.5 * np.arange(800), np.eye(3) * 14.5, []
    for seed in range(100):
        Q, _ = dipoles(np.random.default_rng(seed), systems[0], 800, 10.0, 0.5)
        plain, subtracted = (dielectric(history(system, time, None, box, Q)) for system in systems)
        assert "the mean dipole was subtracted" in str(subtracted)
        found.append([plain.value().value, subtracted.value().value])
    plain, subtracted = (np.array([pair for pair in found if None not in pair]) - 1).T
    assert len(plain) > 90
    assert subtracted.mean() / plain.mean() == pytest.approx(1.0, abs=0.0125)


def test_the_error_of_a_dielectric_constant_in_a_reaction_field_follows_its_slope():
    """By differences of the formula, from the error that the same dipoles have with tin foil, which
    is that of y."""
    around, found = 4.0, {}
    fields = {"tin foil": inf, "field": around}
    for name, permittivity in fields.items():
        forces = {
            "cutoff_A": 7.0,
            "electrostatics": "reaction_field",
            "reaction_field_permittivity": permittivity,
        }
        system = build(small_scene({"spce": 30}, 21.0, forces=forces))
        Q, _ = dipoles(np.random.default_rng(4), system, 4000, 2.0, 0.5)
        found[name] = dielectric(
            history(system, 0.5 * np.arange(4000), None, np.eye(3) * 21.0, Q)
        ).value()

    def epsilon(y: float) -> float:
        """The root of (epsilon - 1)(2 around + 1) = y (2 around + epsilon)."""
        return (2 * around + 1 + 2 * around * y) / (2 * around + 1 - y)

    y, doubt = found["tin foil"].value - 1, found["tin foil"].error
    assert found["field"].value == pytest.approx(epsilon(y), rel=1e-9)
    slope = (epsilon(y + 1e-4) - epsilon(y - 1e-4)) / 2e-4
    assert slope > 1.5
    assert found["field"].error == pytest.approx(slope * doubt, rel=1e-6)


def test_dipoles_without_a_dielectric_constant():
    time, box = np.arange(100.0), np.eye(3) * 14.5
    still = np.broadcast_to(np.eye(3), (100, 30, 3, 3))
    forces = {"cutoff_A": 7.0}
    for scene, words in (
        ({"spce": 30}, "an electric field acts"),
        ({"spce": 30}, "has no known boundary"),
        ({"na_spce": 2, "cl_spce": 2}, "has a net charge"),
        ({"argon": 30}, "needs molecules with charges"),
        ({"co2_epm2": 30}, "no molecule has a dipole"),
    ):
        more = {"fields": {"electric_V_per_nm": [0, 0, 0.1]}} if "field" in words else {}
        kind = "damped_shifted_force" if "boundary" in words else "pme"
        if "argon" not in scene:
            more["forces"] = forces | {"electrostatics": kind}
        system = build(small_scene(scene, 14.5, **{"forces": forces} | more))
        n = len(system.model.species)
        with pytest.raises(OutputError, match=words):
            dielectric(
                history(
                    system, time, None, box, still[:, :n] if len(system.state.rotation) else None
                )
            )
    system = build(small_scene({"spce": 30}, 14.5, forces=forces | {"electrostatics": "pme"}))
    Q, _ = dipoles(np.random.default_rng(0), system, 100, 10.0, 0.5)
    told = dielectric(history(system, 0.5 * time, None, box, Q)).value()
    vacuum = build(small_scene({"spce": 30}, 14.5, forces=forces | FORCES["vacuum"]))
    with pytest.raises(
        OutputError, match="fluctuates more than it can with a permittivity of 1 around"
    ):
        dielectric(
            history(
                vacuum,
                0.5 * np.arange(4000),
                None,
                box,
                dipoles(np.random.default_rng(4), vacuum, 4000, 2.0, 0.5)[0],
            )
        )
    assert told.value is None
    assert re.search(
        r"too short for a value; 20 of them are [\d.]+ ps. So far: [\d.]+ ± [\d.]+$", told.note
    )
