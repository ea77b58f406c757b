"""Molecules of users: a geometry with a table of parameters, `rigidmd models`, and models made from a structure."""

import re

import numpy as np
import pytest

from rigidmd.assemble.build import build
from rigidmd.assemble.model_text import models_table
from rigidmd.commands.cli import main
from rigidmd.io.scene_file import write_scene
from rigidmd.run import Simulation
from rigidmd.scene import Scene
from rigidmd.scene.models import MODELS, available_models, load_model, read_molecule
from rigidmd.units import KJ_PER_MOL

TABLE = """
title = "aromatic"
[[sites]]
name = "C"
charge_e = -0.115
sigma_A = 3.55
epsilon_kcal_mol = 0.07
[[sites]]
name = "H"
charge_e = 0.115
sigma_A = 2.42
epsilon_kcal_mol = 0.03
[[sites]]
name = "N"
sigma_A = 3.25
epsilon_kcal_mol = 0.17
"""
OWN = """
[box]
lengths_A = 30.0
[[molecules]]
file = "benzene.xyz"
parameters = "aromatic.toml"
count = 8
[start]
temperature_K = 300
[forces]
mixing = "geometric"
pme_order = 6
[[stages]]
duration_ps = 0.004
"""


INNER = """
name = "argon"
[[sites]]
name = "Ar"
element = "Ar"
mass_u = 39.948
position_A = [0.0, 0.0, 0.0]
sigma_A = 3.4
epsilon_K = 120.0
"""


@pytest.fixture
def own(tmp_path):
    """A folder with a geometry, a table of parameters and a scene."""
    m = load_model("benzene_opls")
    lines = [
        f"{e} {x:.12f} {y:.12f} {z:.12f}"
        for e, (x, y, z) in zip(m.elements, m.positions_body + np.array([1, 2, 3]), strict=True)
    ]
    (tmp_path / "benzene.xyz").write_text("12\n\n" + "\n".join(lines) + "\n")
    (tmp_path / "aromatic.toml").write_text(TABLE)
    (tmp_path / "own.toml").write_text(OWN)
    return tmp_path


def test_a_geometry_with_a_table_of_parameters_is_the_model(own):
    m, found = load_model("benzene_opls"), build(Scene.read(own / "own.toml")).species[0]
    for what in ("charges", "sigma", "epsilon", "masses"):
        assert getattr(found, what) == pytest.approx(getattr(m, what), rel=1e-12), what
    assert found.inertia == pytest.approx(m.inertia, rel=1e-9)
    assert found.planar


def test_what_a_site_states_itself_goes_before_the_table(own):
    """The scene's entry, a charge of zero too, and in another unit of energy."""
    entry = (
        'sites = [{ name = "H", charge_e = 0.0, sigma_A = 2.5, epsilon_kJ_mol = 0.2 }]\ncount = 8'
    )
    (own / "own.toml").write_text(OWN.replace("count = 8", entry))
    found = build(Scene.read(own / "own.toml")).species[0]
    hydrogen = [i for i, e in enumerate(found.elements) if e == "H"]
    assert (found.charges[hydrogen] == 0).all()
    assert found.charge == pytest.approx(-6 * 0.115)
    assert found.epsilon[hydrogen] / KJ_PER_MOL == pytest.approx(0.2)
    assert found.epsilon[found.elements.index("C")] / KJ_PER_MOL == pytest.approx(0.07 * 4.184)


def test_sites_of_a_scene_take_their_parameters_from_the_table_too(own):
    text = OWN.replace('file = "benzene.xyz"', 'name = "diatom"').replace(
        "count = 8",
        'sites = [{ name = "C1", element = "C", mass_u = 12.0, position_A = [0, 0, 0.6] }, '
        '{ name = "H1", element = "H", mass_u = 1.0, position_A = [0, 0, -0.6], charge_e = 0.2 }]\ncount = 8',
    )
    (own / "own.toml").write_text(text)
    found = build(Scene.read(own / "own.toml")).species[0]
    assert found.charges == pytest.approx([-0.115, 0.2])
    assert found.sigma == pytest.approx([3.55, 2.42])
    assert found.kind == "linear"


def test_check_states_what_kind_of_molecule_it_is(own, printed):
    assert (
        "8 benzene: symmetric, planar, 12 sites, 78.1140 u, neutral, no dipole"
        in printed("check", own / "own.toml").out
    )
    (own / "aromatic.toml").write_text(TABLE.replace("charge_e = 0.115", "charge_e = 0.215"))
    out = printed("check", own / "own.toml").out
    assert "planar, 12 sites, 78.1140 u, net charge +0.6 e" in out
    assert "net charge: +4.8 e" in out


def test_a_run_keeps_the_table_and_runs_again_from_its_copy(own):
    text = OWN.replace("count = 8", "masses_u = { H = 2.014 }\ncount = 8")
    (own / "own.toml").write_text(text)
    first = Simulation(Scene.read(own / "own.toml"), own / "out").run()
    assert (own / "out" / "input_0.parameters_aromatic.toml").read_text() == TABLE
    (own / "aromatic.toml").unlink()
    again = Simulation(Scene.read(own / "out" / "scene.toml")).run()
    assert first.state.position.tobytes() == again.state.position.tobytes()
    assert again.system.species[0].mass == pytest.approx(6 * (12.011 + 2.014), rel=1e-4)


@pytest.mark.parametrize("named", ["", 'name = "ring"\n'])
def test_copied_files_do_not_rename_a_species(named, own):
    """Also where other tables call it by its name."""
    (own / "inner.toml").write_text(INNER)
    species = f'parameters = "aromatic.toml"\n{named}'
    other = '[[molecules]]\nfile = "inner.toml"\ncount = 2\n[fields]\nrestraints = [{ species = "SPECIES", stiffness_kJ_mol_A2 = 1.0 }]\n[start]'
    name = "ring" if named else "benzene"
    text = OWN.replace('parameters = "aromatic.toml"\n', species).replace(
        "[start]", other.replace("SPECIES", name)
    )
    (own / "own.toml").write_text(text)
    first = build(Scene.read(own / "own.toml"))
    (own / "kept").mkdir()
    write_scene(own / "kept", first.scene)
    again = build(Scene.read(own / "kept" / "scene.toml"))
    assert [m.name for m in again.species] == [m.name for m in first.species] == [name, "argon"]
    assert [entry.label for entry in again.scene.molecules] == [name, "argon"]
    assert again.scene.fields == first.scene.fields


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (
            ('parameters = "aromatic.toml"', 'parameters = "../aromatic.toml"'),
            "is outside the scene's folder",
        ),
        (
            ('parameters = "aromatic.toml"', 'parameters = "none.toml"'),
            "line 6: molecules.0.parameters: there is no such file",
        ),
        (('parameters = "aromatic.toml"', 'parameters = "aromatic.csv"'), "must be a .toml file"),
        (
            ('parameters = "aromatic.toml"', ""),
            "a geometry file needs sites, or a file of parameters",
        ),
        (('file = "benzene.xyz"', 'model = "spce"'), "parameters would have no effect"),
        (
            ('"aromatic.toml"', '"aromatic.toml"\nsites = [{ name = "S" }]'),
            "sites: S is not an atom of it",
        ),
    ],
)
def test_errors_of_tables_in_a_scene(change, expected, own, printed):
    (own / "own.toml").write_text(OWN.replace(*change))
    assert expected in printed("check", own / "own.toml", code=2).err


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (
            ('name = "H"', 'name = "F"'),
            "atom H: no entry of sites or of parameters has this name or the name H; there are ",
        ),
        (('name = "N"', 'name = "H"'), "sites: H appears twice"),
        (
            ("sigma_A = 2.42\n", ""),
            "needs both sigma_A and one of epsilon_kJ_mol, epsilon_kcal_mol, epsilon_K",
        ),
        (("epsilon_kcal_mol = 0.03", "epsilon_kcal_mol = 0.03\nepsilon_K = 15.0"), "not both"),
        (("charge_e = 0.115", "charge = 0.115"), "did you mean charge_e?"),
        (("charge_e = 0.115", "position_A = [0, 0, 0]"), "position_A belongs to a molecule"),
        (('title = "aromatic"', "title"), "is not TOML"),
    ],
)
def test_errors_of_a_table(change, expected, own, printed):
    (own / "aromatic.toml").write_text(TABLE.replace(*change))
    assert expected in printed("check", own / "own.toml", code=2).err


def test_another_mixing_rule_than_the_model_was_made_with_is_reported(own, capsys, printed):
    text = OWN.replace(
        'file = "benzene.xyz"\nparameters = "aromatic.toml"', 'model = "benzene_opls"'
    )
    (own / "own.toml").write_text(text)
    assert "mixing" not in printed("check", own / "own.toml").out
    assert main(["check", str(own / "own.toml"), "--set", "forces.mixing=lorentz-berthelot"]) == 0
    said = "benzene_opls was developed with geometric mixing, forces.mixing is lorentz-berthelot"
    assert said in capsys.readouterr().out


def test_the_list_of_models_is_readable(printed):
    lines = printed("models").out.splitlines()
    assert max(map(len, lines)) <= 100
    listed = [line.split()[0] for line in lines if line.startswith("  ")]
    assert sorted(listed) == available_models()
    assert re.search(
        r"tip4p2005 +4 +18.02 +2.305 +\+0.5564 -1.113 +Abascal & Vega 2005", "\n".join(lines)
    )
    argon = models_table([load_model("argon")]).splitlines()[-1]
    assert argon.split() == ["argon", "1", "39.95", "Verlet", "1967"]


def test_one_model_in_full(printed):
    out = printed("models", "tip5p").out
    for part in (
        "asymmetric, 5 sites, 18.0154 u, neutral, dipole 2.292 D",
        "principal moments 0.61457 1.1551 1.7697 u Å²",
        "OW-HW 0.9572 Å (2), OW-LP 0.7000 Å (2)",
        "HW-OW-HW 104.52°",
        "LP-OW-LP 109.47°",
        "3.12         0.66944   80.515",
        "doi:10.1063/1.481505",
    ):
        assert part in out
    assert max(map(len, out.splitlines())) <= 104
    out = printed("models", MODELS / "co2_epm2.toml").out
    assert "quadrupole along the axis -4.1294 D Å" in out
    assert "mixing  geometric" in out


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["spc/e"], "did you mean spce"),
        (["tip4"], "did you mean tip4p or tip4p2005"),
        (["--draw"], "need the NAME of a model"),
        (["spce", "-o", "spce.gif"], "ends in .png or .svg or .pdf"),
        (["spce", "-o", "no/spce.png"], "the folder no does not exist"),
        (["mine.toml"], "there is no such file"),
    ],
)
def test_models_that_cannot_be_shown(arguments, expected, printed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert expected in printed("models", *arguments, code=2).err
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("draws")
def test_a_drawing_is_not_overwritten_unasked(printed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert printed("models", "tip4p2005", "--draw").out == "tip4p2005 is drawn in tip4p2005.png\n"
    first = (tmp_path / "tip4p2005.png").read_bytes()
    assert first.startswith(b"\x89PNG")
    assert "exists; --force replaces it" in printed("models", "tip4p2005", "--draw", code=2).err
    assert main(["models", "spce", "-o", "tip4p2005.png", "--force"]) == 0
    assert (tmp_path / "tip4p2005.png").read_bytes() != first
    assert [p.name for p in tmp_path.iterdir()] == ["tip4p2005.png"]


@pytest.mark.parametrize(
    "name", ["so2", "tip5p", "benzene_opls", "ccl4", "na_spce", "co2_epm2", "methane_trappe"]
)
@pytest.mark.usefixtures("draws")
def test_every_kind_of_molecule_can_be_drawn(name, tmp_path):
    """Every site's name stands in the picture, once, and what is charged states so."""
    assert main(["models", name, "-o", str(tmp_path / "m.svg")]) == 0
    text = (tmp_path / "m.svg").read_text()
    m = load_model(name)
    for site, charge in zip(m.site_names, m.charges, strict=True):
        label = f"{site} {charge:+.5g}" if charge else site
        assert len(re.findall(rf"<!-- {re.escape(label)} -->", text)) == 1, label
    assert main(["models", name, "-o", str(tmp_path / "again.svg")]) == 0
    assert (tmp_path / "again.svg").read_text() == text


@pytest.mark.usefixtures("draws")
def test_a_molecule_of_a_user_is_shown_and_drawn(tmp_path, printed):
    """Whatever its sites are called: names are not formulas."""
    sites = "".join(
        f'[[sites]]\nname = "{name}"\nmass_u = 3.0\nposition_A = [0, 0, {12.0 * k}]\n'
        for k, name in enumerate(("A$b$", "B_{"))
    )
    (tmp_path / "odd.toml").write_text(f'name = "odd"\ntitle = "$x"\n{sites}charge_e = 1.5\n')
    assert "net charge +1.5 e, dipole 43.229 D" in printed("models", tmp_path / "odd.toml").out
    assert main(["models", str(tmp_path / "odd.toml"), "-o", str(tmp_path / "odd.svg")]) == 0
    assert "<!-- A$b$ -->" in (tmp_path / "odd.svg").read_text()


def test_a_model_from_a_structure_reads_back_to_the_same_molecule(own, printed, monkeypatch):
    monkeypatch.chdir(own)
    (own / "aromatic.toml").write_text(
        TABLE.replace("charge_e = 0.115", "charge_e = 0.115\nparameters = { A = 0.1 }")
    )
    out, err = printed(
        "models", "--from", "benzene.xyz", "--parameters", "aromatic.toml", "--name", "ring"
    )
    assert out.startswith(
        "benzene.toml: ring, symmetric, planar, 12 sites, 78.1140 u, neutral, no dipole; geometry of"
    )
    assert 'file = "benzene.toml"' in out
    assert "no atom uses N" in err
    scene = OWN.replace(
        'file = "benzene.xyz"\nparameters = "aromatic.toml"', 'file = "benzene.toml"'
    )
    (own / "new.toml").write_text(scene)
    before, after = (build(Scene.read(own / name)).species[0] for name in ("own.toml", "new.toml"))
    for what in ("masses", "positions_body", "charges", "sigma", "epsilon", "inertia"):
        assert getattr(before, what).tobytes() == getattr(after, what).tobytes(), what
    assert after.parameters == before.parameters == 6 * ({},) + 6 * ({"A": 0.1},)
    assert (after.name, after.elements) == ("ring", before.elements)
    assert after.site_names == tuple(
        f"{e}{k}" for e in "CH" for k in range(1, 7)
    )  # atoms that share a name
    assert "78.1140 u, neutral" in printed("models", "benzene.toml").out


def test_a_model_without_a_table_has_masses_and_states_what_to_fill_in(own, printed, monkeypatch):
    monkeypatch.chdir(own)
    (own / "heavy water.xyz").write_text("4\n\nO 0 0 0\nD 0.96 0 0\nD -0.24 0.93 0\nM 0.1 0.1 0\n")
    out, err = printed("models", "--from", "heavy water.xyz")
    assert "'heavy water.toml'" in out
    assert "has no interactions" in err
    text = (own / "heavy water.toml").read_text()
    assert text.startswith("# Sites have masses only")
    assert "charge_e = -0.1" in text
    assert 'name = "M"\nmass_u = 0.0\nposition_A = [0.1, 0.1, 0.0]' in text
    found = read_molecule(own / "heavy water.toml")
    assert found.mass == pytest.approx(15.999 + 2 * 2.0141, abs=1e-3)
    assert not found.charges.any()


@pytest.mark.parametrize(
    ("names", "numbered"),
    [
        ("O H H", "O H1 H2"),
        ("H1 H1 H11 H12", "H13 H14 H11 H12"),
        ("OW HW1 HW1 OW", "OW1 HW11 HW12 OW2"),
        (
            " ".join(["HYDRO"] * 11),
            " ".join([*(f"HYDR{k}" for k in range(1, 10)), "HYD10", "HYD11"]),
        ),
    ],
)
def test_sites_of_a_new_model_have_names_of_their_own(names, numbered, own, capsys, monkeypatch):
    monkeypatch.chdir(own)
    rows = [f"{name} {1.1 * k} {0.2 * k * k} 0" for k, name in enumerate(names.split())]
    (own / "new.xyz").write_text(f"{len(rows)}\n\n" + "\n".join(rows) + "\n")
    assert main(["models", "--from", "new.xyz"]) == 0
    assert read_molecule(own / "new.toml").site_names == tuple(numbered.split())


def test_the_residue_and_charge_of_a_new_model(own, printed, monkeypatch):
    monkeypatch.chdir(own)
    lines = [
        f"ATOM  {k:>5} {name:<4} LIG A   1    {x:8.3f}   0.000   0.000  1.00  0.00          {name[0]:>2}"
        for k, (name, x) in enumerate((("C1", 0.0), ("H1", 1.09)), 1)
    ]
    (own / "lig.pdb").write_text(
        "CRYST1   30.000   30.000   30.000  90.00  90.00  90.00\n" + "\n".join(lines) + "\nEND\n"
    )
    assert (
        "its cell is ignored"
        in printed(
            "models", "--from", "lig.pdb", "--parameters", "aromatic.toml", "-o", "x.toml"
        ).err
    )
    assert read_molecule(own / "x.toml").residue_names == ("LIG",)
    for charge, said in (
        ("0.1151", "+0.0001 e, nearly but not exactly 0"),
        ("0.6", "+0.485 e, not a whole number"),
    ):
        (own / "aromatic.toml").write_text(
            TABLE.replace("charge_e = 0.115", f"charge_e = {charge}")
        )
        again = [
            "models",
            "--from",
            "lig.pdb",
            "--parameters",
            "aromatic.toml",
            "-o",
            "x.toml",
            "--force",
        ]
        assert said in printed(*again).err


CUT = '2\nLattice="5 0 0 0 5 0 0 0 5"\nN 0.3 0 0\nN 4.3 0 0\n'


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--from", "none.xyz"], "none.xyz: there is no such file"),
        (["--from", "."], ".: is a folder"),
        (["--from", "own.toml", "-o", "x.toml"], "its format is unknown to ASE"),
        (["--from", "two.xyz"], "holds 2 structures: keep one"),
        (["--from", "pair.xyz"], "pair.xyz: has 2 molecules N2: keep one"),
        (["--from", "cut.xyz"], "bonded through the faces of its cell"),
        (
            ["--from", "benzene.xyz", "--parameters", "none.toml"],
            "none.toml: there is no such file",
        ),
        (
            ["--from", "benzene.xyz", "--parameters", "poor.toml"],
            "atom H: no entry of the table has this name",
        ),
        (["--from", "benzene.xyz", "--name", ""], "name: is ''"),
        (["--from", "benzene.xyz", "-o", "x.png"], "x.png: the name of this model ends in .toml"),
        (["--from", "benzene.xyz", "-o", "no/x.toml"], "the folder no does not exist"),
        (["--from", "benzene.xyz", "-o", "own.toml"], "own.toml exists; --force replaces it"),
        (
            [
                "--from",
                "benzene.xyz",
                "--parameters",
                "aromatic.toml",
                "-o",
                "aromatic.toml",
                "--force",
            ],
            "aromatic.toml is an input of this model",
        ),
        (
            ["--from", "benzene.xyz", "--draw"],
            "Draw it afterwards: rigidmd models benzene.toml --draw",
        ),
        (["spce", "--from", "benzene.xyz"], "leave out spce"),
        (["spce", "--parameters", "aromatic.toml"], "--parameters belongs to --from FILE"),
        (["--name", "x"], "--name belongs to --from FILE"),
    ],
)
def test_models_that_cannot_be_made(arguments, expected, own, printed, monkeypatch):
    monkeypatch.chdir(own)
    benzene, pair = (own / "benzene.xyz").read_text(), "N 0 0 0\nN 1.1 0 0\nN 0 0 6\nN 1.1 0 6\n"
    files = {
        "two.xyz": 2 * benzene,
        "pair.xyz": f"4\n\n{pair}",
        "cut.xyz": CUT,
        "poor.toml": TABLE.replace('name = "H"', 'name = "F"'),
    }
    for name, text in files.items():
        (own / name).write_text(text)
    before = {path.name: path.read_bytes() for path in own.iterdir()}
    out, err = printed("models", *arguments, code=2)
    assert out == ""
    assert expected in err
    assert {path.name: path.read_bytes() for path in own.iterdir()} == before
