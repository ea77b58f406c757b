"""Molecules on a lattice: packing, walls, temperatures that forces do not allow."""

import numpy as np
import pytest
from support.common import observe, small_scene
from support.scenes import GOOD

from rigidmd.assemble.build import build
from rigidmd.units import BOLTZMANN


def test_walls_at_any_distance_leave_a_lattice(tmp_path):
    """Edges of the space for molecules may differ by any factor; all molecules lie between the
    walls."""
    for high in (1e-9, 1e-3, 30.0, 1e30):
        walls = {"axis": "z", "kind": "harmonic", "acts_on": "centres", "stiffness_kJ_mol_A2": 1.0}
        scene = small_scene(
            {"argon": 30},
            [20.0, 20.0, 40.0],
            fields={"walls": [walls | {"positions_A": [0.0, high]}]},
            box={"periodic": False, "lengths_A": [20.0, 20.0, 40.0]},
        )
        position = build(scene).state.position
        assert len({tuple(row) for row in position}) == 30
        assert 0 < position[:, 2].min() <= position[:, 2].max() < high


def test_too_dense_to_pack(printed, tmp_path):
    text = (
        GOOD.replace("lengths_A = 20.0", "lengths_A = 8.0")
        .replace("count = 20", "count = 120")
        .replace("[start]", "[forces]\ncutoff_A = 3.9\n[start]")
    )
    scene = tmp_path / "dense.toml"
    scene.write_text(text)
    message = printed("run", scene, "-o", tmp_path / "out", code=2).err
    assert "cannot be packed" in message
    assert "Lower the density" in message
    assert not (tmp_path / "out").exists()


STRONG = """sites = [{ name = "A", mass_u = 20.0, position_A = [0.0, 0.0, 0.0], sigma_A = 3.0, \
epsilon_K = 50.0, charge_e = 1e6 }]"""


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("= 300", "= 1e-30", ["the molecules fit into the box", "1e-30 K are too low"]),
        ("= 300", "= 1e-6", ["the molecules fit into the box", "1e-06 K are too low"]),
        ('model = "spce"', f'name = "ion"\n{STRONG}', ["a charge_e is 1e+06 e, above 1000"]),
    ],
)
def test_forces_that_no_step_follows(old, new, expected, printed, tmp_path):
    """The reason is not the density."""
    scene = tmp_path / "strong.toml"
    scene.write_text(GOOD.replace(old, new))
    message = printed("run", scene, "-o", tmp_path / "out", code=2).err
    assert all(part in message for part in expected), message
    assert "density" not in message
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("model", "rotation"), [("argon", 0), ("nitrogen", 2), ("spce", 3)])
def test_drawn_momenta_have_the_temperature_exactly_and_no_momentum(model, rotation):
    system = build(small_scene({model: 50}, 40.0))
    seen = observe(system, system.engine(), system.state)
    assert system.freedom == (147, 50 * rotation)
    assert seen.temperature == pytest.approx(300, rel=1e-12)
    assert seen.temperature_translation == pytest.approx(300, rel=1e-12)
    if rotation:
        assert seen.temperature_rotation == pytest.approx(300, rel=1e-12)
    assert np.abs(seen.momentum).max() < 1e-10


def test_maxwell_boltzmann_on_every_axis():
    system = build(small_scene({"spce": 4000}, 60.0))
    omega2 = system.state.angular_momentum_body**2 * system.model.inverse_inertia[0]
    assert omega2.mean(axis=0) == pytest.approx(np.full(3, 300 * BOLTZMANN), rel=0.08)
    assert (18.0154 * system.state.velocity**2).mean(axis=0) == pytest.approx(
        np.full(3, 300 * BOLTZMANN), rel=0.08
    )
