"""Names and paths of users in generated files that are code: they change texts in them, and nothing
else."""

import ast
import re
import shlex
import subprocess
from unittest.mock import patch

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from rigidmd.assemble.build import build
from rigidmd.errors import OutputError, SceneError
from rigidmd.features.external.force_field import force_field_of
from rigidmd.features.external.gromacs import files as gromacs_files
from rigidmd.features.external.lammps import files as lammps_files
from rigidmd.features.studies.sweep.folder import Manifest, SweepPoint
from rigidmd.features.studies.sweep.sweeping import write_slurm_script
from rigidmd.scene import Scene

PLAIN = ("one", "two", "first", "AR", "RES")
#: What some language obeys, at the ends of names and within them.
EVIL = [
    '"""; open("PWNED","w"); """',
    'x"""',
    "a & b &",
    "$(touch PWNED)",
    "${x}",
    "`id`",
    "a; shell ls",
    "# a",
    "a\\",
    "{stages}{title}{system}",
    "%s%n",
    "../../x",
    "[ system ]",
    "#include",
    "*/",
    "'''",
    "\\N{BULLET}",
    "é µ ₂",
    " ",
    "-rf",
]
TEXT = st.one_of(
    st.sampled_from(EVIL),
    st.text(st.sampled_from("abz09 \"'`$&#;\\{}()[]<>%!*/|~@^,.:+=-_é₂"), min_size=1, max_size=30),
    st.text(st.characters(exclude_categories=("C", "Zl", "Zp")), min_size=1, max_size=12),
)
SITE = st.text(st.sampled_from("Aa9\"'`$&#;\\{}()[]<>%!*/|~@^,.:+=-_"), min_size=1, max_size=5)
NAMES = st.tuples(TEXT, TEXT, TEXT, SITE, SITE)
OFTEN = settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def data(names):
    """A scene of points of two species, two stages, with these names."""
    first, second, stage, site, residue = names
    sites = [
        {
            "name": site,
            "element": "Ar",
            "mass_u": 40.0,
            "position_A": [0.0, 0.0, 0.0],
            "sigma_A": 3.4,
            "epsilon_kJ_mol": 1.0,
        }
    ]
    entry = {"sites": sites, "count": 3, "residue_names": [residue]}
    return {
        "name": "names",
        "box": {"lengths_A": 40.0},
        "start": {"temperature_K": 90.0},
        "molecules": [{"name": first, **entry}, {"name": first + second, **entry}],
        "stages": [
            {"name": stage, "duration_ps": 0.1},
            {"name": stage + stage, "duration_ps": 0.1},
        ],
    }


def named(names):
    return Scene.from_dict(data(names))


def without_comments(text, mark):
    return [line.partition(mark)[0].rstrip() for line in text.splitlines()]


def shape(text):
    """The tree of a program without the values of its texts."""
    tree = ast.parse(text)
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            node.value = ""
    return ast.dump(tree)


@pytest.fixture(scope="module")
def usual():
    system = build(named(PLAIN))
    return system, force_field_of(system)


@OFTEN
@given(NAMES)
@example((EVIL[0], EVIL[1], EVIL[0], '"""', "&"))
@example(('x"""', "$x", 'y"""', ";#", "\\"))
def test_names_change_no_command_of_lammps(usual, tmp_path, names):
    found = build(named(names))
    for drawn, name in ((usual[1], "usual"), (force_field_of(found), "found")):
        lammps_files.write_data(tmp_path / name, drawn, usual[0].state)
    texts = [(tmp_path / name).read_text() for name in ("usual", "found")]
    texts += [lammps_files.input_script(drawn) for drawn in (usual[1], force_field_of(found))]
    for one, other in ((texts[0], texts[1]), (texts[2], texts[3])):
        assert without_comments(one, "#") == without_comments(other, "#")
        assert not re.search(r'"""|[&$\\`]', other)
    assert lammps_files.settings(force_field_of(found)) == lammps_files.settings(usual[1])


@OFTEN
@given(NAMES)
@example((EVIL[0], EVIL[1], EVIL[0], ";", "#x"))
@example(("a_", "?", "\\", "\\", '"'))
def test_names_change_no_setting_of_gromacs(usual, tmp_path, names):
    found = build(named(names))
    files = {}
    for drawn, name in ((usual[1], "usual"), (force_field_of(found), "found")):
        (tmp_path / name).mkdir(exist_ok=True)
        files[name] = gromacs_files.write_gromacs(tmp_path / name, drawn, usual[0].state)
    assert len({*files["found"]}) == len(files["found"]) == len(files["usual"])
    for one, other in zip(*files.values(), strict=True):
        before, after = (
            (tmp_path / "usual" / one).read_text(),
            (tmp_path / "found" / other).read_text(),
        )
        if one.endswith(".gro"):
            assert [(line[:5], line[15:], len(line)) for line in before.splitlines()[2:]] == [
                (line[:5], line[15:], len(line)) for line in after.splitlines()[2:]
            ]
            continue
        before, after = (
            without_comments(text, "#" if one == "run.sh" else ";") for text in (before, after)
        )
        assert [len(line.split()) for line in before] == [len(line.split()) for line in after]
        assert [line for line in before if line.startswith("[")] == [
            line for line in after if line.startswith("[")
        ]
        assert (
            not re.search(r"[$`\\#]|^ *\*", "\n".join(after).replace('"$@"', "")) or one == "run.sh"
        )
    subprocess.run(["sh", "-n", tmp_path / "found" / "run.sh"], check=True)
    names = re.findall(r"^(\S+) 1$", (tmp_path / "found" / "topol.top").read_text(), re.MULTILINE)
    assert len(names) == len(set(names)) == 2


@OFTEN
@given(NAMES)
@example((EVIL[0], EVIL[1], "{stages}{title}{system}{kick}", '"""', "&"))
def test_names_change_no_statement_of_the_script_for_openmm(usual, tmp_path, names):
    pytest.importorskip("openmm")
    from rigidmd.features.external.openmm.files import write_openmm

    texts = []
    for drawn in (usual[1], force_field_of(build(named(names)))):
        write_openmm(tmp_path, drawn, usual[0].state)
        texts.append((tmp_path / "run.py").read_text())
    assert shape(texts[0]) == shape(texts[1])
    stages = next(node for node in ast.parse(texts[1]).body if isinstance(node, ast.Assign))
    assert [stage[0] for stage in ast.literal_eval(stages.value)] == [names[2], 2 * names[2]]
    from openmm import app

    assert app.PDBFile(str(tmp_path / "topology.pdb")).topology.getNumAtoms() == 6


def script(folder, name, scene, trust):
    points = [SweepPoint(f"p{k}", {}, "") for k in range(3)]
    folder.mkdir(parents=True, exist_ok=True)
    manifest = Manifest(name, scene, {}, {}, {}, {}, points)
    manifest.folder = folder
    with patch(
        "rigidmd.features.studies.sweep.sweeping.trusted_by", lambda sweep, point, trust: trust
    ):
        path, _ = write_slurm_script(manifest, 3600.0, 1, trust)
    return path.read_text()


def tokens(text):
    return [len(shlex.split(line, comments=True)) for line in text.splitlines()]


@OFTEN
@given(TEXT, TEXT.filter(lambda text: "/" not in text and text not in (".", "..")), TEXT, TEXT)
@example("a\n#SBATCH --uid=0", "b", "c", "d")
@example("a", "new\nline $(touch PWNED)", "c", "d")
@example("a", 'quo"te', "c", "d")
@example("a", "b", "scene\x1b.toml", "d")
@example("a", "%a", "c", "d")
@example("a", "100% %j", "$(touch PWNED)", "`id`")
def test_paths_change_no_word_of_the_script_of_a_job(tmp_path, name, folder, scene, trust):
    usual = script(tmp_path / "usual", "water", "water.toml", ["force.py"])
    if re.search(r"[\x00-\x1f\"\\]", folder + scene + trust):
        with pytest.raises(OutputError, match=r"Rename it, or folder=\.\.\. names another"):
            script(tmp_path / folder, name, scene, [trust])
        return
    text = script(tmp_path / folder, name, scene, [trust])
    assert tokens(text) == tokens(usual)
    subprocess.run(["bash", "-n", "-c", text], check=True)
    options = [
        [line for line in one.splitlines() if line.startswith("#SBATCH")] for one in (usual, text)
    ]
    assert [line.split("=")[0] for line in options[0]] == [
        line.split("=")[0] for line in options[1]
    ]
    run = next(shlex.split(line) for line in text.splitlines() if line.startswith("1) "))
    assert run[:9] == [
        "1)",
        "rigidmd",
        "run",
        scene,
        "-o",
        str(tmp_path / folder / "p1"),
        "--resume",
        "--trust",
        str(tmp_path.cwd() / trust),
    ]
    output = next(line for line in options[1] if "--output" in line)
    written = str(tmp_path / folder).replace("%", "%%")
    assert output == f'#SBATCH --output="{written}/slurm-%a.out"'


@pytest.mark.parametrize(
    "key",
    [
        "molecules.0.name",
        "stages.0.name",
        "name",
        "molecules.0.file",
        "structure.file",
        "molecules.0.sites.0.name",
    ],
)
def test_names_with_control_characters_are_refused(key):
    for hidden in "\n\r\t\x00\x1b\x7f\x85\u2028\u202e":
        with pytest.raises(
            SceneError,
            match=r"control character|must be one|must be a name of letters|plain file name",
        ) as refused:
            Scene.from_dict(data(PLAIN), overrides={key: f"a{hidden}b"})
        assert key in str(refused.value)
        assert not any(hidden in error for error in refused.value.errors)
