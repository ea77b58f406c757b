"""Properties that hold for anything, by examples that hypothesis observations for: rotations, rotors,
whole scenes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.common import spin

from rigidmd.core.state import State
from rigidmd.errors import RigidMDError
from rigidmd.mechanics.free_rotor import ExactRotor, split_rotor
from rigidmd.mechanics.inertia import inertia_tensor, principal_frame
from rigidmd.mechanics.rotation import (
    from_euler_angles,
    from_quaternion,
    orthogonality_error,
    to_euler_angles,
    to_quaternion,
)
from rigidmd.run import Simulation
from rigidmd.scene import Scene

FEW = settings(max_examples=60, deadline=None, derandomize=True, database=None)
FEWER = settings(max_examples=25, deadline=None, derandomize=True, database=None)
ROUNDING = 4e-15


def floats(low: float, high: float):
    return st.floats(low, high, allow_nan=False)


def vectors(size: float = 1.0, length: int = 3):
    return st.tuples(*[floats(-size, size)] * length).map(np.array)


quaternions = vectors(1.0, 4).filter(lambda q: np.linalg.norm(q) > 1e-100)
angles = vectors(100.0)


@FEW
@given(quaternions)
def test_any_rotation_comes_back_from_every_way_to_write_it(quaternion):
    q = from_quaternion(quaternion / np.abs(quaternion).max())
    assert orthogonality_error(q[None]) < ROUNDING
    for there, back in (
        (to_quaternion, from_quaternion),
        (to_euler_angles, from_euler_angles),
    ):
        assert np.abs(back(there(q)) - q).max() < ROUNDING


@FEW
@given(angles)
def test_any_angles_come_back_as_the_same_rotation(turned):
    q = from_euler_angles(turned)
    assert np.abs(from_euler_angles(to_euler_angles(q)) - q).max() < ROUNDING


@FEW
@given(
    st.integers(1, 6).flatmap(lambda n: st.lists(vectors(10.0), min_size=n, max_size=n)), st.data()
)
def test_any_masses_have_a_principal_frame(positions, data):
    masses = np.array([data.draw(floats(1e-3, 1e3)) for _ in positions])
    positions = np.array(positions)
    frame = principal_frame(masses, positions)
    size = np.linalg.norm(positions - frame.centre, axis=1).max()
    scale = frame.mass * size**2
    assert np.abs(frame.axes @ frame.axes.T - np.eye(3)).max() < ROUNDING
    assert np.linalg.det(frame.axes) == pytest.approx(1, abs=ROUNDING)
    turned = frame.axes.T @ inertia_tensor(masses, positions - frame.centre) @ frame.axes
    # what counts as equal or zero is made so: 1e-8 of the largest
    assert np.abs(turned - np.diag(frame.inertia)).max() <= 2e-8 * scale
    assert (np.diff(frame.inertia) >= 0).all() or frame.kind == "spherical"
    assert frame.inertia[2] <= (frame.inertia[0] + frame.inertia[1]) * (1 + 3e-8)


#: Moments of a body: of three positive numbers, each pair added, so that no moment is more than the
#: sum of the others.
moments = st.tuples(*[floats(-6.0, 0.0)] * 3).map(
    lambda p: np.roll(10.0 ** np.array(p), 1) + np.roll(10.0 ** np.array(p), 2)
)


@FEW
@given(moments, floats(-80.0, 80.0), vectors(), floats(0.001, 1.0))
def test_a_free_rotor_keeps_what_it_should_for_any_inertia_at_any_scale(
    inertia, exponent, direction, h
):
    scale = 10.0**exponent
    size = np.linalg.norm(direction)
    if size < 1e-3:
        direction, size = np.array([1.0, 0.0, 0.0]), 1.0
    momentum = direction / size
    step = h / np.abs(momentum / inertia).max()
    for rotor in (
        split_rotor(scale * inertia[None]),
        ExactRotor(*split_rotor(scale * inertia[None])),
    ):
        q, l = np.eye(3)[None].copy(), scale * momentum[None]  # noqa: E741
        spin(rotor, q, l, step, 100)
        assert np.linalg.norm(l[0] / scale) == pytest.approx(1, rel=1e-13)
        assert np.abs(q[0] @ l[0] / scale - momentum).max() < 1e-13
        assert orthogonality_error(q) < 1e-13
        if isinstance(rotor, ExactRotor):
            # a moment a million times smaller than L²/2T has its energy from what rounding leaves
            # of L about it
            kinetic = [(v**2 / inertia).sum() for v in (momentum, l[0] / scale)]
            assert kinetic[1] == pytest.approx(
                kinetic[0], rel=1e-12 + 1e-15 * inertia.max() / inertia.min()
            )


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
def test_any_small_scene_runs_ten_steps_or_is_refused_in_words(data):
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
def test_any_small_scene_of_one_kind_runs_ten_steps_or_is_refused_in_words(data):
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
