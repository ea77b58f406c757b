"""Tables of energies of bodies."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.body_pairs import body, of_angles, written_table

from rigidmd import Scene, Simulation
from rigidmd.assemble.build import build
from rigidmd.compile import kernel
from rigidmd.errors import SceneError
from rigidmd.features.potentials.poses.formulas import formula_of_poses
from rigidmd.features.potentials.poses.pairs import pair_slopes
from rigidmd.features.potentials.poses.table import read_body_table
from rigidmd.features.potentials.user_code.pose_checks import within_table
from rigidmd.units import KJ_PER_MOL

#: An energy that rises inwards, of the points of `written_table`; cosine of the angle of two axes.
RISING = np.exp(-np.linspace(4, 12, 30))[:, None, None, None] * np.ones((1, 25, 25, 25))
_ANGLES = np.radians(np.linspace(0, 180, 25))
PARALLEL = np.multiply.outer(np.multiply.outer(np.sin(_ANGLES), np.sin(_ANGLES)), np.cos(_ANGLES))


@kernel(from_python=True)
def compiled_slopes(formula, p, r, a, b):
    return pair_slopes(formula, p, r, a, b)


def test_a_table_has_the_energy_of_its_function_and_forces_that_are_its_slopes(tmp_path):
    table = read_body_table(written_table(tmp_path / "pair.npz"))
    formula = formula_of_poses(table, (), "z")
    row, rng = np.array(formula.numbers({}, {})), np.random.default_rng(8)

    def values(r, a, b):
        return [np.array(x) for x in compiled_slopes(formula.kind(), row, tuple(r), a, b)]

    for _ in range(20):
        a, b = Rotation.random(2, random_state=rng).as_matrix()
        direction = rng.standard_normal(3)
        n = direction / np.linalg.norm(direction)
        r = rng.uniform(4.5, 11.5) * n
        energy, slope, torque, other = values(r, a, b)
        u, v = a[:, 2], b[:, 2]
        across = [x - (x @ n) * n for x in (u, v)]
        cosine = across[0] @ across[1] / np.prod([np.linalg.norm(x) for x in across])
        angles = np.arccos([u @ n, v @ n, cosine])
        expected = of_angles(np.linalg.norm(r), *angles)
        assert energy / KJ_PER_MOL == pytest.approx(expected, abs=2e-3)

        def along(k, r=r, a=a, b=b):
            """Differences of the energy by x, y or z, and by rotations of each body about it."""
            step = 1e-5 * np.eye(3)[k]
            spin = Rotation.from_rotvec(step).as_matrix()
            ends = [(r + step, a, b), (r - step, a, b)]
            ends += [(r, spin @ a, b), (r, spin.T @ a, b), (r, a, spin @ b), (r, a, spin.T @ b)]
            energies = [float(values(*at)[0]) for at in ends]
            return np.subtract(energies[::2], energies[1::2]) / 2e-5

        for k in range(3):
            found = np.array([slope[k], -torque[k], -other[k]])
            assert found == pytest.approx(along(k), abs=2e-5 * max(1.0, np.abs(energy)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"phi_deg": None}, "it has no array phi_deg; it needs r_A"),
        ({"r_A": np.geomspace(4, 12, 30)}, "r_A must have 4 points or more in even ascending"),
        ({"phi_deg": np.linspace(0, 360, 25)}, "phi_deg must run from 0 to 180"),
        ({"energy_kJ_mol": np.zeros((30, 25, 25))}, r"has the shape \(30, 25, 25\), must have"),
        ({"energy_kJ_mol": np.full((30, 25, 25, 25), np.nan)}, "and finite energies"),
        (
            {"energy_kJ_mol": np.ones((30, 25, 25, 1)) * np.arange(25.0)},
            "depends on phi where an axis is along the vector",
        ),
        (
            {"energy_kJ_mol": np.ones((30, 1, 25, 25)) * np.arange(25.0)[:, None, None]},
            "an exchange of both bodies changes the energy",
        ),
        ({"r_A": np.linspace(-1, 12, 30)}, "ascending distances above 0"),
        ({"r_A": np.linspace(3e200, 4e200, 30)}, "more than 1e\\+30, the largest of a table"),
        ({"energy_kJ_mol": 1e300 * RISING}, "more than 1e\\+30, the largest of a table"),
        (
            {"energy_kJ_mol": -RISING},
            "begins at 4 Å, where it does not repel at theta_1 = 0°, thet",
        ),
        ({"energy_kJ_mol": 0 * RISING}, "begins at 4 Å, where it does not repel"),
        # flat at the first two points: the parabola through the first three falls inwards
        ({"energy_kJ_mol": np.minimum(RISING, RISING[1])}, "where it does not repel"),
        # at one pair of angles only
        (
            {"energy_kJ_mol": RISING - 2 * RISING * (PARALLEL > 0.995)},
            "theta_1 = 90°, theta_2 = 90°, ph",
        ),
    ],
)
def test_bad_tables_are_answered_by_what_is_wrong(changes, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        read_body_table(written_table(tmp_path / "pair.npz", **changes))
    (tmp_path / "pair.npz").write_text("1 2 3")
    with pytest.raises(ValueError, match=r"pair\.npz is not an \.npz file of numbers"):
        read_body_table(tmp_path / "pair.npz")


def test_a_scene_has_a_table_as_a_file_and_compares_its_forces_at_the_start(tmp_path):
    written_table(tmp_path / "pair.npz", points=(20, 13, 13, 13))
    data = {
        "box": {"lengths_A": 40.0},
        "molecules": [body("rod", 60)],
        "start": {"temperature_K": 200.0},
        "threads": 1,
        "forces": {"bodies": [{"table": "pair.npz", "species": ["rod"], "cutoff_A": 12.0}]},
        "stages": [{"duration_ps": 0.05, "timestep_fs": 5.0}],
    }
    results = Simulation(Scene.from_dict(data, tmp_path)).run()
    assert np.abs(results["body_pairs"]).min() > 0
    assert np.ptp(results["energy"]) < 1e-3 * np.ptp(results["potential"]) + 1e-3
    data["forces"]["bodies"][0]["cutoff_A"] = 13.0
    with pytest.raises(SceneError, match="the table ends at 12 Å, before the cutoff of 13 Å"):
        build(Scene.from_dict(data, tmp_path))
    data["forces"]["bodies"][0]["cutoff_A"] = 3.9
    with pytest.raises(SceneError, match=r"the table begins at 4 Å, beyond the cutoff of 3\.9 Å"):
        build(Scene.from_dict(data, tmp_path))


@pytest.mark.parametrize(("first", "expected"), [(3.0, ""), (4.2, "bodies come nearer")])
def test_a_table_that_separates_no_bodies_is_warned_of(first, expected, tmp_path):
    r, angles = np.linspace(first, 12, 30), np.linspace(0, 180, 5)
    energy = 8 * ((4 / r) ** 12 - (4 / r) ** 6)
    arrays = {name: angles for name in ("theta_1_deg", "theta_2_deg", "phi_deg")}
    energy = energy[:, None, None, None] * np.ones((1, 5, 5, 5))
    np.savez(tmp_path / "pair.npz", r_A=r, energy_kJ_mol=energy, **arrays)
    data = {
        "box": {"lengths_A": 40.0},
        "molecules": [body("rod", 60)],
        "forces": {"cutoff_A": 12.0, "bodies": [{"table": "pair.npz"}]},
        "stages": [{"ensemble": "nvt", "temperature_K": 200.0, "duration_ps": 1.0}],
    }
    warnings = " ".join(build(Scene.from_dict(data, tmp_path)).warnings)
    assert expected in warnings and bool(warnings) == bool(expected)
    system = build(Scene.from_dict(data | {"box": {"lengths_A": [30.0, 40, 50]}}, tmp_path))
    state = system.state.copy()
    for distance in (first + 0.1, first - 0.1):
        state.position[7] = state.position[4] + [0.0, distance - 40, 0.0]  # of images
        warning = within_table(system, state)
        near = f"molecule 5 (rod) and molecule 8 (rod) have a distance of {distance:.3g} Å"
        swapped = f"molecule 8 (rod) and molecule 5 (rod) have a distance of {distance:.3g} Å"
        assert (near in warning or swapped in warning) == (distance < first)
    charged = body("rod", 60)
    charged["sites"][0] |= {"sigma_A": 3.0, "epsilon_kJ_mol": 1.0}
    warnings = build(Scene.from_dict(data | {"molecules": [charged]}, tmp_path)).warnings
    assert not any("bodies come nearer" in warning for warning in warnings)
