"""The table of a sweep and its figure."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.common import ROOT
from support.sweeps import ARGON, run_here, table

from rigidmd.commands import cli
from rigidmd.features.studies.sweep import figure, sweeping
from rigidmd.features.studies.sweep.figure import axis_label
from rigidmd.features.studies.sweep.plan import parse_axis
from rigidmd.features.studies.sweep.table import SweepRow, summarise_run
from rigidmd.features.studies.sweep.table import Table as SweepTable
from rigidmd.run.record import read_record


def test_the_energy_of_a_molecule_has_its_fraction_of_the_error(finished):
    """For a longer run, whose energies forget themselves from one sample to the next."""
    record = read_record(finished / "temperature_K=90_seed=1")
    columns = {name: np.resize(values, 40) for name, values in record.columns.items()}
    columns["time"] = np.linspace(0.0, 0.5, 40)
    columns["potential"] = np.random.default_rng(1).standard_normal(40) - 5.0
    found = summarise_run(replace(record, columns=columns))
    energy, error = found["Potential Energy (kJ/mol)"]
    assert error > 0.1
    assert found["Potential Energy per molecule (kJ/mol)"] == pytest.approx(
        (energy / 20, error / 20)
    )


def test_the_density_of_an_earlier_stage_is_in_the_table(tmp_path, argon, printed):
    """A pair of stages, of which the first samples the density and the second keeps it."""
    stages = """
[[stages]]
name = "density"
ensemble = "npt"
temperature_K = 90.0
pressure_bar = 50.0
duration_ps = 2
timestep_fs = 5

[[stages]]
name = "production"
ensemble = "nvt"
temperature_K = 90.0
duration_ps = 1
timestep_fs = 5
"""
    text = ARGON.replace("[[stages]]\nduration_ps = 0.5\ntimestep_fs = 5\n", stages)
    (scene := tmp_path / "pair.toml").write_text(text + "log_interval_ps = 0.02\n")
    together = "stages.density.temperature_K,stages.production.temperature_K"
    folder = tmp_path / "s"
    points = run_here(scene, [parse_axis(f"{together}=90,110")], folder).points
    said = printed("sweep", scene, "-o", folder, "--collect").out
    assert "density: Density (g/cm^3)" in said
    for row, point in zip(table(folder), points, strict=True):
        stage = json.loads((folder / point.folder / "summary.json").read_text())["stages"][0]
        assert float(row["density: Density (g/cm^3)"]) == pytest.approx(
            stage["density_g_cm3"], rel=1e-6
        )
        if stage["density_error_g_cm3"] is not None:
            assert float(row["density: Density (g/cm^3) error"]) == pytest.approx(
                stage["density_error_g_cm3"], rel=1e-6
            )
        assert float(row["density: Temperature (K)"]) == pytest.approx(
            stage["temperature_K"], rel=1e-6
        )
        assert "Density (g/cm^3) error" not in row  # it is constant in the last stage


@pytest.mark.parametrize(
    ("key", "together", "label"),
    [
        ("stages.density.temperature_K", [], "set temperature of stages.density (K)"),
        ("box.density_g_cm3", ["box.density_g_cm3"], "set density of box (g/cm³)"),
        (
            "stages.0.timestep_fs",
            ["stages.0.timestep_fs", "seed"],
            "set timestep of stages.0 (fs)\ntogether with seed",
        ),
        ("molecules.0.count", [], "set count of molecules.0"),
        ("seed", [], "seed"),
        ("stages.0.pressure_bar", [], "set pressure of stages.0 (bar)"),
    ],
)
def test_axes_have_units_and_name_the_keys_that_vary_together(key, together, label):
    assert axis_label(key, together) == label


@pytest.mark.parametrize("errors", [0.5, None])
def test_a_figure_shows_all_points_of_all_curves(errors, tmp_path):
    """Curves with errors are displaced, which must not move them out of the panel."""
    rows = [
        SweepRow({"a.b_K": x, "word": word}, {None: {"x": (x + shift, errors)}})
        for x in (300.0, 280.0, 290.0)
        for word, shift in (("one", 0.0), ("two", 40.0))
    ]
    drawn = figure.draw_table(SweepTable(tmp_path, ["a.b_K", "word"], rows, ["x"]), ["x"])
    (axis,) = drawn.axes
    assert axis.get_xlim()[0] <= 280 < 300 <= axis.get_xlim()[1] < 310
    assert axis.get_ylim()[0] <= 280 < 340 <= axis.get_ylim()[1] < 350
    assert axis.lines[0].get_xdata().tolist() == [280, 290, 300]
    assert [text.get_text() for text in drawn.legends[0].texts] == ["word = one", "word = two"]


def test_a_row_has_the_error_over_its_runs_or_that_of_its_only_run():
    assert SweepRow({}, {1: {"x": (1.0, 0.5)}, 2: {"x": (3.0, 0.5)}})["x"] == (
        2.0,
        pytest.approx(1.0),
    )
    assert SweepRow({}, {1: {"x": (1.0, 0.5)}, 2: {}})["x"] == (1.0, 0.5)
    assert SweepRow({}, {1: {"x": (0.1, 0.0)}, 2: {"x": (0.1, 0.0)}, 3: {"x": (0.1, 0.0)}})[
        "x"
    ] == (0.1, None)


def test_bodies_and_words(tmp_path, printed):
    """A body has no seeds; a key whose values are words has positions on the axis."""
    scene = ROOT / "systems" / "heavy_top_3.toml"
    fixed = {"run.duration_s": 0.02, "output.figures": False, "output.trajectory": False}
    integrators = {"run.integrator": ["velocity_verlet", "kahan_li_8"]}
    run_here(scene, sweeping.axes_of(integrators | fixed), tmp_path / "s")
    assert cli.main(["sweep", str(scene), "-o", str(tmp_path / "s"), "--collect"]) == 0
    errors = [float(row["energy_error largest"]) for row in table(tmp_path / "s")]
    assert errors[0] > 100 * errors[1]
    for row in table(tmp_path / "s"):
        lowest, mean, highest = (
            float(row[f"theta {word} (rad)"]) for word in ("lowest", "mean", "highest")
        )
        assert lowest < mean < highest
    assert (tmp_path / "s" / "sweep.png").exists()
    assert (
        "a single body, whose motion has no seed"
        in printed("sweep", scene, "--replicas", "3", "-o", tmp_path / "t", code=2).err
    )
    assert not (tmp_path / "t").exists()
