"""Estimated errors of Ewald sums compared with measured ones."""

from itertools import product

import pytest
from support.common import built, shaken, small_scene

from rigidmd.assemble.build import build
from rigidmd.run.force_errors import coulomb_errors, estimated_error
from rigidmd.run.summary import ewald_error_notes
from rigidmd.units import COULOMB


@pytest.mark.parametrize(
    ("asked", "method"),
    [
        (1e-5, "ewald"),
        (1e-5, "pme"),
        pytest.param(1e-4, "pme", marks=pytest.mark.extended),
        *(
            pytest.param(asked, method, marks=pytest.mark.soak)
            for asked, method in product([1e-3, 1e-4, 1e-5, 1e-6], ["ewald", "pme"])
            if asked != 1e-5 and (asked, method) != (1e-4, "pme")
        ),
    ],
)
def test_forces_are_as_accurate_as_requested(method, asked):
    """Measured against a tight Ewald sum: within a factor 2 of the request, either way; and as
    estimated."""
    forces = {"cutoff_A": 7.7, "electrostatics": method, "ewald_accuracy": asked}
    system, _, state = built({"spce": 125}, 15.52, 7, forces=forces)
    found = coulomb_errors(system, state)
    assert 0.5 * asked < found["in_e2_per_A2"] < 2 * asked
    assert (
        0.7 * asked < system.force_error / COULOMB < 1.03 * asked
    )  # of both parts of the sum together
    assert found["estimated_per_A"] == pytest.approx(found["rms_error_per_A"], rel=0.6)
    grown = state._replace(cell=1.1 * state.cell, position=1.1 * state.position)
    assert estimated_error(system, grown.cell) == pytest.approx(
        coulomb_errors(system, grown)["rms_error_per_A"], rel=0.6
    )


@pytest.mark.parametrize(
    ("asked", "method"),
    [(1e-4, "pme"), (1e-5, "ewald"), pytest.param(1e-6, "pme", marks=pytest.mark.soak)],
)
def test_forces_of_a_slab_are_as_accurate_as_requested(method, asked):
    """The density of the liquid counts, not the mean of the box: also of one that has grown along
    its normal."""
    box = {"lengths_A": [12.5, 12.5, 12.5], "vacuum_A": 37.5}
    forces = {"cutoff_A": 6.2, "electrostatics": method, "ewald_accuracy": asked}
    scene = small_scene(
        {}, None, molecules=[{"model": "spce", "count": 64}], box=box, forces=forces
    )
    system, _, state = shaken(build(scene), 7)
    found = coulomb_errors(system, state)
    assert 0.5 * asked < found["in_e2_per_A2"] < 2 * asked
    assert found["estimated_per_A"] == pytest.approx(found["rms_error_per_A"], rel=0.6)
    assert estimated_error(system, state.cell) == pytest.approx(system.force_error, rel=1e-9)


@pytest.mark.parametrize("method", ["ewald", "pme"])
def test_a_box_that_has_outgrown_its_k_vectors_is_noted(method):
    forces = {"cutoff_A": 7.7, "electrostatics": method}
    stages = [{"ensemble": "npt", "temperature_K": 300.0, "pressure_bar": 1.0, "duration_ps": 0.01}]
    system = build(small_scene({"spce": 125}, 15.52, forces=forces, stages=stages))
    assert estimated_error(system, system.state.cell) == pytest.approx(
        system.force_error, rel=1e-12
    )
    for factor, told in ((1.0, 0), (1.01, 0), (1.2, 1)):
        assert (
            len(ewald_error_notes(system, system.state._replace(cell=factor * system.state.cell)))
            == told
        )
