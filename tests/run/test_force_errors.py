"""Errors of Ewald sums: estimates compared with measurements, and `rigidmd energy --accuracy` on
every scene and model that is shipped."""

import numpy as np
import pytest
from support.common import MOLECULES, ROOT, built, shaken, small_scene

from rigidmd.assemble.build import build
from rigidmd.commands.cli import main
from rigidmd.errors import SceneError
from rigidmd.run.force_errors import coulomb_errors, estimated_error
from rigidmd.scene.models import load_model

MODELS = sorted(path.stem for path in (ROOT / "rigidmd" / "models").glob("*.toml"))
CHARGED = [name for name in MODELS if load_model(name).charges.any()]
CUBE = {"lengths_A": 15.52}
TILTED = {"lengths_A": [16.0, 17.0, 18.0], "angles_deg": [75.0, 45.0, 70.0]}  # is reduced
EWALD = {"cutoff_A": 7.7, "electrostatics": "ewald", "ewald_accuracy": 1e-3}


@pytest.mark.parametrize(
    ("k_max", "k2_max", "box"),
    [
        (6, None, CUBE),
        (8, 30, CUBE),
        ([10, 10, 3], None, CUBE),
        ([30, 1, 1], None, CUBE),
        ([4, 9, 9], 60, CUBE),
        (6, None, TILTED),
        ([8, 8, 3], None, TILTED),
        ([3, 9, 9], None, TILTED),
    ],
)
def test_estimate_for_k_vectors_in_a_box_of_any_shape(k_max, k2_max, box):
    """The mean square over three states, as few k-vectors make the error of some sets."""
    forces = {"cutoff_A": 5.0, "electrostatics": "ewald", "ewald_alpha_per_A": 0.6}
    forces |= {"ewald_k_max": k_max, "ewald_k2_max": k2_max}
    molecules = [{"model": "spce", "count": 125}]
    system = build(small_scene({}, None, molecules=molecules, box=box, forces=forces))
    measured = []
    for seed in (7, 8, 9):
        _, _, state = shaken(system, seed, spread=3.0)  # no lattice is left
        measured.append(coulomb_errors(system, state)["rms_error_per_A"])
    ratio = system.force_error / np.sqrt(np.mean(np.square(measured)))
    assert 1 / 1.3 < ratio < 1.3
    assert estimated_error(system, system.state.cell) == pytest.approx(system.force_error, rel=1e-9)


def test_estimate_in_a_box_with_very_many_k_vectors():
    """Every n-th of them is summed."""
    forces = {"cutoff_A": 9.0, "electrostatics": "ewald", "ewald_alpha_per_A": 0.4}
    forces |= {"ewald_k_max": [9, 12, 15]}
    system, _, state = built({"spce": 60}, 200.0, 7, forces=forces)
    error = coulomb_errors(system, state)["rms_error_per_A"]
    assert system.force_error == pytest.approx(error, rel=0.2)


def test_errors_are_measured_where_some_sites_have_no_charge():
    counts = {"tip4p2005": 40, "argon": 10, "nitrogen": 10, "na_spce": 2}
    system, _, state = built(counts, 15.52, 7, forces=EWALD)
    measured = coulomb_errors(system, state)
    assert 0.5e-3 < measured["in_e2_per_A2"] < 2e-3
    assert measured["estimated_per_A"] == pytest.approx(measured["rms_error_per_A"], rel=0.6)


def test_errors_of_one_ion_which_feels_no_force(tmp_path, printed):
    scene = tmp_path / "ion.toml"
    scene.write_text(
        '[box]\nlengths_A = 20.0\n[forces]\nelectrostatics = "ewald"\n[[molecules]]\n'
        'model = "na_spce"\ncount = 1\n[[stages]]\nduration_ps = 1\n[start]\ntemperature_K = 300\n'
    )
    assert "nan" not in printed("energy", scene, "--accuracy").out


DILUTE = [{"model": "spce", "count": 8}]
FROZEN_SALT = [{"model": "na_spce", "count": 4, "frozen": True}, {"model": "argon", "count": 8}]


@pytest.mark.parametrize(
    ("molecules", "forces", "reason"),
    [
        ([{"model": "spce", "count": 8}], {}, "forces.electrostatics is 'reaction_field'"),
        ([{"model": "argon", "count": 8}], EWALD, "no site has a charge"),
        (FROZEN_SALT, EWALD, "all molecules with charges are frozen"),
        (DILUTE, {"electrostatics": "pme", "ewald_cutoff_A": 7.0}, "out of reach in this box"),
    ],
)
def test_reasons_why_no_error_is_measured(molecules, forces, reason):
    forces = {"cutoff_A": 7.0} | forces
    box = {"lengths_A": 900.0} if molecules is DILUTE else CUBE
    scene = small_scene({}, None, molecules=molecules, box=box, forces=forces)
    system = build(scene)
    with pytest.raises(SceneError, match=reason):
        coulomb_errors(system, system.state)


@pytest.mark.extended
@pytest.mark.parametrize("method", ["pme", "ewald"])
@pytest.mark.parametrize("name", CHARGED)
def test_errors_are_measured_for_every_model(name, method):
    forces = {"cutoff_A": 9.0, "electrostatics": method}
    precision = "mixed" if method == "pme" else "double"
    system, _, state = built({name: 20}, 22.0, 7, forces=forces, precision=precision)
    measured = coulomb_errors(system, state)
    assert 0 < measured["rms_error_per_A"] < 3 * measured["estimated_per_A"]


@pytest.mark.extended
@pytest.mark.parametrize("path", MOLECULES, ids=lambda path: path.stem)
def test_errors_are_measured_for_every_scene(path, capsys):
    status = main(["energy", str(path), "--accuracy"])
    out, err = capsys.readouterr()
    if status == 0:
        assert "rms error   " in out
        assert "nan" not in out
    else:
        assert "forces.electrostatics is" in err or "no site has a charge" in err
