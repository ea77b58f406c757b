"""Tables of pair potentials: accuracy, files, gaps, errors."""

import re

import numpy as np
import pytest
from support.common import shaken, small_scene
from support.potentials import ARGON, LJ, ROWS, argon_energy
from support.stops import same_after_stops

import rigidmd
from rigidmd.assemble.build import build
from rigidmd.errors import SceneError
from rigidmd.features.potentials.sites.formulas import (
    FormulaError,
    formula_of_table,
    formula_of_text,
)
from rigidmd.run.kind import describe
from rigidmd.units import KJ_PER_MOL

# --- formulas -------------------------------------------------------------------------------------


def test_a_table_is_as_good_as_it_states():
    r = np.linspace(2.5, 10, 200)
    given = {"eps": 1.0, "sig": 3.4}
    exact = formula_of_text(LJ).radial(given)
    table = formula_of_table(r, [exact(x)[0] / KJ_PER_MOL for x in r], 9.0)
    radial, well = table.radial({"scale": 1.0}), KJ_PER_MOL
    off = max(abs(radial(x)[0] - exact(x)[0]) / well for x in np.linspace(2.9, 9, 3001))
    assert off < 3 * table.error < 1e-3
    for x in (3.0, 5.0, 8.0):
        step = 1e-5
        assert radial(x)[1] == pytest.approx(
            (radial(x - step)[0] - radial(x + step)[0]) / (2 * step), rel=1e-6
        )
    for bad, word in (
        (([1, 2], [1, 2]), "8 distances"),
        ((r, r**2), "does not repel"),
        ((r[::-1], r), "ascending"),
    ):
        with pytest.raises(FormulaError, match=word):
            formula_of_table(*bad, 9.0)
    with pytest.raises(FormulaError, match=r"ends at 10 Å, before the cutoff"):
        formula_of_table(r, 1 / r, 12.0)


# --- tables in files ------------------------------------------------------------------------------


def write_argon_table(path, rows=700, first=2.6, with_forces=False):
    r = np.linspace(first, 9.2, rows)
    columns = np.column_stack([r, *argon_energy(r)][: 3 if with_forces else 2])
    head = "r_A, energy_kJ_mol, force_kJ_mol_A" if with_forces else "r_A energy_kJ_mol"
    separator = ", " if with_forces else "  "
    lines = ["# argon", "", head, *(separator.join(f"{x:.12g}" for x in row) for row in columns)]
    path.write_text("\n".join(lines) + "  # the end\n")


def tabulated(folder, count=60, edge=19.0, **entry):
    """Argon with the table argon.csv, or without an entry with the built-in potential."""
    forces = {"cutoff_A": 9.0}
    if entry:
        forces |= {
            "lennard_jones": False,
            "custom": [{"name": "argon", "table": "argon.csv"} | entry],
        }
    return small_scene(
        {"argon": count},
        edge,
        folder,
        forces=forces,
        stages=[{"duration_ps": 0.4, "timestep_fs": 4}],
        start={"temperature_K": 90.0},
        output={"trajectory": False, "figures": False, "log_interval_ps": 0.02},
    )


@pytest.mark.parametrize("with_forces", [False, True])
def test_a_table_in_a_file_is_the_potential_that_it_lists(with_forces, tmp_path):
    write_argon_table(tmp_path / "argon.csv", with_forces=with_forces)
    scene = tabulated(tmp_path, sites=("AR",))
    text = describe(scene)
    assert (
        "argon: argon.csv of 700 energies from 2.6 to 9.2 Å, 60 sites, cutoff 9 Å, switch" in text
    )
    error = float(
        re.search(r"argon: the error of its spline is (\S+) of its deepest energy", text)[1]
    )
    assert 1e-9 < error < 2e-5
    exact, of_table = (rigidmd.Simulation(one).run() for one in (tabulated(tmp_path), scene))
    start = [results["potential"][0] for results in (exact, of_table)]
    depth, pairs = ARGON["epsilon"], 60 * 14
    assert abs(start[0] - start[1]) < 3 * error * depth * pairs
    assert np.abs(exact["conserved"] - of_table["conserved"]).max() < 1e-3
    drift = [np.ptp(results["conserved"]) for results in (exact, of_table)]
    assert drift[1] < 1.1 * drift[0]


def test_a_table_ends_in_a_wall(tmp_path):
    """Nearer than the first row, value and slope are the values of the first row, and the energy rises
    as r⁻¹²."""
    write_argon_table(tmp_path / "argon.csv", first=3.1)
    potential = rigidmd.pair_potential(table=str(tmp_path / "argon.csv"))
    radial = potential.formula(9.0).radial({"scale": 1.0})
    energy, force = argon_energy(3.1)
    below, above = radial(3.1 - 1e-7), radial(3.1 + 1e-7)
    assert below[:2] == pytest.approx(above[:2], rel=1e-5)
    assert below[:2] == pytest.approx((energy * KJ_PER_MOL, force * KJ_PER_MOL), rel=1e-3)
    for r in (3.0, 2.5, 2.0, 1.6):
        wall = energy + 3.1 * force / 12 * ((3.1 / r) ** 12 - 1)
        assert radial(r)[0] == pytest.approx(wall * KJ_PER_MOL, rel=1e-3)
        assert radial(r)[1] == pytest.approx(
            (radial(r - 1e-5)[0] - radial(r + 1e-5)[0]) / 2e-5, rel=1e-5
        )
    scene = tabulated(tmp_path, count=2, edge=30.0, sites=("AR",))
    _, engine, state = shaken(build(scene), 0, 0.0)
    for r in (2.2, 3.05, 4.0):
        state.position[:] = [[5.0, 5.0, 5.0], [5.0 + r, 5.0, 5.0]]
        load, tallies = engine.evaluate(state)
        assert tallies["argon"].energy == pytest.approx(radial(r)[0], rel=1e-12)
        assert load.force[1, 0] == pytest.approx(radial(r)[1], rel=1e-10)


def test_a_run_with_a_table_resumes_with_the_same_bits_and_keeps_a_copy(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_argon_table(tmp_path / "argon.csv")
    data = tabulated(tmp_path, sites=("AR",)).model_dump(exclude_none=True)
    same_after_stops(data, [30, 61], tmp_path)
    again = rigidmd.Scene.read(tmp_path / "whole" / "scene.toml")
    copy = tmp_path / "whole" / again.forces.custom[0].table
    assert copy.read_bytes() == (tmp_path / "argon.csv").read_bytes()
    write_argon_table(tmp_path / "argon.csv", rows=500)
    with pytest.raises(rigidmd.errors.RigidMDError, match=r"forces\.custom\.0\.table"):
        rigidmd.Simulation(rigidmd.Scene.from_dict(data), tmp_path / "parts", resume=True).run()


WRONG_TABLES = {
    "r_nm energy_kJ_mol\n"
    + ROWS: r"argon.csv: line 1: the columns are r_nm, energy_kJ_mol. They must be r_A \(Å\)",
    ROWS
    + "\n9.4": r"argon.csv: line 128: has 1 numbers, must have the same columns in all lines: r_A",
    ROWS + "\n9.4 nan": r"argon.csv: line 128: 9.4 nan has something else than finite numbers",
    ROWS + "\n9.4 abc": r"argon.csv: line 128: 9.4 abc has something else than finite numbers",
    ROWS
    + "\n9.0 -0.1": r"argon.csv: line 128: r_A = 9 must be above 9.3 Å of the row before. Sort the rows",
    "-1 5\n" + ROWS: r"argon.csv: line 1: r_A = -1 must be above 0",
    "\n".join(ROWS.splitlines()[:7]): r"argon.csv: has 7 rows, needs 8 or more",
    "# nothing": r"argon.csv: has 0 rows",
    "\n".join(ROWS.splitlines()[:60]): r"ends at 5.95 Å, before the cutoff of 9 Å$",
    "\n".join(
        f"{float(row.split()[0]) / 10} {row.split()[1]}" for row in ROWS.splitlines()
    ): r"Is it in nm\?",
    "\n".join(ROWS.splitlines()[20:]): r"begins at 4 Å, where it does not repel",
    "\n".join(
        f"{row} {-argon_energy(float(row.split()[0]))[1]:.6g}" for row in ROWS.splitlines()
    ): r"the forces are not -dE/dr. From 3 to 3.05 Å the energy changes by -\S+ kJ/mol, .*Have they another sign or unit\?",
}


@pytest.mark.parametrize("text", WRONG_TABLES, ids=range(len(WRONG_TABLES)))
def test_a_table_that_is_useless_is_reported(text, tmp_path):
    (tmp_path / "argon.csv").write_text(text + "\n")
    with pytest.raises(SceneError, match=WRONG_TABLES[text]):
        build(tabulated(tmp_path, sites=("AR",)))


def test_a_table_that_overrides_another_may_be_anywhere(tmp_path, monkeypatch):
    write_argon_table(tmp_path / "argon.csv")
    tables = tabulated(tmp_path, sites=("AR",)).model_dump(exclude_unset=True)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene").mkdir()
    with pytest.raises(SceneError, match="there is no such file"):
        rigidmd.Scene.from_dict(tables, "scene")
    scene = rigidmd.Scene.from_dict(tables, "scene", {"forces.custom.0.table": "argon.csv"})
    assert scene.inputs == {"forces.custom.0.table": tmp_path / "argon.csv"}


def test_all_errors_of_a_table_are_reported_and_its_file_is_in_the_folder(tmp_path):
    (tmp_path / "argon.csv").write_text("\n".join(["1 x"] * 9) + "\n" + ROWS)
    with pytest.raises(SceneError) as refused:
        build(tabulated(tmp_path, sites=("AR",)))
    assert [re.search(r"argon.csv: line (\d)", fault)[1] for fault in refused.value.errors] == [
        *"123456789"
    ]
    with pytest.raises(
        SceneError, match=r"forces.custom.0.table: '../argon.csv' is outside the scene's folder"
    ):
        tabulated(tmp_path, table="../argon.csv")
    with pytest.raises(SceneError, match="there is no such file"):
        build(tabulated(tmp_path, table="other.csv"))
    with pytest.raises(SceneError, match=r"give a module, .* an energy, .* or a table"):
        tabulated(tmp_path, energy="1/r**9")


# --- what is lost at a cutoff, and tables that state too little -------------------------------------


def lennard_jones_rows(step=0.02, without=(0.0, 0.0), factor=1.0):
    r = np.arange(2.6, 9.3, step)
    r = r[(r <= without[0]) | (r >= without[1])]
    return r, factor * argon_energy(r)[0], factor * argon_energy(r)[1]


@pytest.mark.parametrize("gap", [(3.96, 6.96), (4.0, 9.0), (3.6, 4.4), (3.6, 5.2), (3.7, 3.8)])
@pytest.mark.parametrize("with_forces", [False, True])
def test_a_gap_in_a_table_is_refused(gap, with_forces):
    rows = lennard_jones_rows(without=gap)[: 3 if with_forces else 2]
    with pytest.raises(
        ValueError, match=r"has a gap from 3\.|has a gap from 4 to 9|forces are not -dE/dr"
    ):
        rigidmd.pair_potential(table=rows).formula(9.0)


@pytest.mark.parametrize(
    ("step", "with_forces"), [(0.02, False), (0.05, True), (0.1, False), (0.1, True), (0.15, True)]
)
def test_the_error_of_a_spline_is_what_it_states(step, with_forces):
    """Compared with the exact energy where it is below ten wells; the estimate is within a factor
    of 6."""
    formula = rigidmd.pair_potential(
        table=lennard_jones_rows(step)[: 3 if with_forces else 2]
    ).formula(9.0)
    radial, r = formula.radial({"scale": 1.0}), np.linspace(2.9, 8.99, 2001)
    r = r[argon_energy(r)[0] < 10 * ARGON["epsilon"]]
    off = (
        max(abs(radial(x)[0] / KJ_PER_MOL - argon_energy(x)[0]) for x in r.tolist())
        / ARGON["epsilon"]
    )
    assert off / 3 < formula.error < 6 * off


def test_a_table_of_two_parts_or_of_growing_intervals_has_no_gap():
    fine, coarse = lennard_jones_rows(0.02), lennard_jones_rows(0.1)
    two = [np.r_[a[fine[0] < 5.0], b[coarse[0] > 5.01]] for a, b in zip(fine, coarse, strict=True)]
    r = np.geomspace(2.6, 9.3, 200)
    for rows in (two, (r, *argon_energy(r))):
        assert rigidmd.pair_potential(table=tuple(rows)).formula(9.0).error < 1e-3


def test_a_spline_that_is_nonsense_is_refused_and_a_poor_one_reported(tmp_path):
    r, energy, _ = lennard_jones_rows(0.02)
    wild = energy.copy()
    wild[120] = 1e6
    with pytest.raises(
        ValueError,
        match=r"the error of its spline is .* of its deepest energy, .* must be below 0.1",
    ):
        rigidmd.pair_potential(table=(r, wild)).formula(9.0)
    np.savetxt(tmp_path / "argon.csv", np.column_stack(lennard_jones_rows(0.12)[:2]))
    [told] = build(tabulated(tmp_path, sites=("AR",))).warnings
    assert re.match(
        r"argon the error of its spline is \d\.\de-02 of its deepest energy: use smaller", told
    )


@pytest.mark.parametrize("value", ["1e300", "-1e31", "1e308"])
def test_a_huge_energy_in_a_table_is_reported_with_its_line(value, tmp_path):
    lines = [f"{x:g} {y:g}" for x, y in zip(*lennard_jones_rows(0.1)[:2], strict=True)]
    (tmp_path / "t.csv").write_text("\n".join([lines[0], f"2.61 {value}", *lines[1:]]))
    with pytest.raises(ValueError, match=r"t.csv: line 2: 2.61 .* has a number above 1e\+30"):
        rigidmd.pair_potential(table=tmp_path / "t.csv")
