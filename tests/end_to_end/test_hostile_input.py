"""Input that was made to break: each is refused at once, with what is wrong, where and what was expected."""

import io
import os
import subprocess
import sys
import zipfile

import numpy as np
import pytest
import tomli_w
from ase.data import chemical_symbols
from support.common import refusal
from support.processes import with_settings
from support.scenes import FROM_FILE, GOOD, SATELLITE, STRUCTURES

from rigidmd.assemble.build import build
from rigidmd.commands.cli import main
from rigidmd.core import process
from rigidmd.core.state import state_of
from rigidmd.core.state_file import SavedState, write_state
from rigidmd.core.toml import line_of
from rigidmd.errors import MoleculeError, RigidMDError, SceneError, StructureError
from rigidmd.scene import Scene
from rigidmd.scene.models import SYMBOLS, read_molecule

DEEP = "[" * 1000 + "]" * 1000


def own_molecule(position="[0.0, 0.0, 1.0]", more=""):
    site = f'{{name = "A", mass_u = 1.0, position_A = {position}{more}}}, {{name = "B", mass_u = 1.0, position_A = [0, 0, 0]}}'
    return f'[[molecules]]\nname = "x"\ncount = 2\nsites = [{site}]\n[[stages]]'


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (
            "count = 20",
            f"count = {2**63}",
            "line 6: molecules.0.count: is a whole number of more than 64 bits",
        ),
        ("count = 20", "count = 1e30", "line 6: molecules.0.count: is 1e+30, must be an integer"),
        (
            "count = 20",
            f"count = {'9' * 5000}",
            "a whole number of more than 64 bits (at line 6, column 1)",
        ),
        (
            "lengths_A = 20.0",
            f"lengths_A = 1{'0' * 400}",
            "line 2: box.lengths_A: is a whole number of more than 64 bits",
        ),
        (
            "lengths_A = 20.0",
            "lengths_A = 1e-300",
            "line 2: box.lengths_A: is 1e-300, must be 0 or between 1e-30",
        ),
        ("lengths_A = 20.0", "lengths_A = 1e-20", "must be 0.5 Å at least"),
        ("lengths_A = 20.0", "lengths_A = 1e10", "must not be longer than 1e+09 Å"),
        ("count = 20", f"count = 20\nx = {DEEP}", "more than 32 deep"),
        ("count = 20", f"count = 20\nx = {'{a=' * 1000}1{'}' * 1000}", "more than 32 deep"),
        ("count = 20", f"count = 20\nx = {'[' * 50}1{']' * 50}", "line 7: molecules.0.x.0.0"),
        (
            "[start]",
            f"[{'.'.join('a' * 100_000)}]",
            "a key of more than 32 parts (at line 12, column 1)",
        ),
        (
            "[[stages]]",
            own_molecule("[0.0, 0.0, 1e200]"),
            "line 11: molecules.1.sites.0.position_A.2: is 1e+200, must be",
        ),
        (
            "[[stages]]",
            own_molecule(more=", charge_e = 1e300"),
            "charge_e: is 1e+300, must be 0 or between",
        ),
        (
            'model = "spce"',
            'file = "a\\u0000.toml"',
            "line 5: molecules.0.file: is 'a\\x00.toml': control characters",
        ),
        (
            'model = "spce"',
            f'file = "{"a" * 300}.toml"',
            "line 5: molecules.0.file: cannot be read: File name too long",
        ),
        (
            'model = "spce"',
            'file = "loop.toml"',
            "cannot be read: Too many levels of symbolic links: ",
        ),
        (
            'model = "spce"',
            'file = "pipe.toml"',
            "line 5: molecules.0.file: is a pipe, a socket or a device",
        ),
        (
            'model = "spce"',
            'model = "spce"\nname = "\\u001b[31mred"',
            "line 6: molecules.0.name: is '\\x1b[31mred'",
        ),
        (
            "[start]",
            '"\\u001b[31mx" = 1\n[start]',
            "\\x1b[31mx: has a control character in its name",
        ),
        ("count = 20", 'count = 20\n"int" = 1', "line 7: molecules.0.int: unknown key"),
        (
            "count = 20",
            "count = 20\n'a' = True",
            "line 7: molecules.0.a: is True, must be written true",
        ),
        ("count = 20", "count = 20\n() = True", "is not TOML"),
        (
            "[[stages]]",
            own_molecule(more=", sigma_A = 9e25, epsilon_K = 1.0"),
            "sigma_A of 9e+25 Å with epsilon overflows",
        ),
        (
            "[start]",
            '[forces]\nelectrostatics = "ewald"\newald_k_max = 1000\n[start]',
            "8e+09 k-vectors, more than 2e+07",
        ),
        (
            "20.0",
            '[20.0, 20.0, 1e6]\n[forces]\nelectrostatics = "pme"',
            "an edge of 1e+06 Å is too long for a grid",
        ),
    ],
)
def test_a_scene_that_was_made_to_break(old, new, expected, capsys, tmp_path):
    os.symlink("loop.toml", tmp_path / "loop.toml")
    os.mkfifo(tmp_path / "pipe.toml")
    assert old in GOOD
    message = refusal(capsys, tmp_path, GOOD.replace(old, new, 1))
    assert expected in message
    assert "\x1b" not in message
    assert len(message) < 1000


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("[0.0, 0.001, 0.0]", "[]", "frame: angular_velocity_rad_s is an empty list"),
        (
            "[0.0, 0.001, 0.0]",
            "[]\ntimes_s = [0.0, 1.0]",
            "frame: angular_velocity_rad_s is an empty list",
        ),
        (
            "[frame]\nangular_velocity_rad_s = [0.0, 0.001, 0.0]",
            "[changing_inertia]\ninertia_kg_m2 = []\ntimes_s = [0.0, 1.0]",
            "changing_inertia: inertia_kg_m2 is an empty list",
        ),
    ],
)
def test_an_empty_list_of_a_body(old, new, expected, capsys, tmp_path):
    text = (
        SATELLITE.replace("inertia_kg_m2 = [1.0, 2.0, 2.5]\n", "")
        if "changing" in new
        else SATELLITE
    )
    assert expected in refusal(capsys, tmp_path, text.replace(old, new))


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        (f"forces.cutoff_A={DEEP}", "--set forces.cutoff_A: is "),
        (f"{'.'.join('a' * 50_000)}=1", "is a key of more than 32 parts"),
        (f"box.lengths_A={'9' * 4500}", "--set box.lengths_A: is "),
        ("molecules.²=1", "molecules has entries 0 to 0"),
        (
            "molecules.0.count=9223372036854775808",
            "--set molecules.0.count: is a whole number of more than 64 bits",
        ),
        ('structure.file="a\\u0000"', "--set structure.file: is "),
    ],
)
def test_an_option_that_was_made_to_break(override, expected, capsys, tmp_path):
    assert expected in refusal(capsys, tmp_path, GOOD, f"--set={override}")


@pytest.mark.parametrize("what", ["keys", "tables", "molecules"])
def test_twenty_thousand_errors_are_reported_at_once(what, capsys, tmp_path):
    some = {
        "keys": "".join(f"k{n} = 1\n" for n in range(20_000)) + GOOD,
        "tables": GOOD + "".join(f"[k{n}]\n" for n in range(20_000)),
        "molecules": GOOD + "".join(f'[[molecules]]\nmodel = "spce{n}"\n' for n in range(5000)),
    }[what]
    message = refusal(capsys, tmp_path, some)
    assert f"{5000 if what == 'molecules' else 20_000} errors" in message
    assert "\n  and " in message
    assert len(message) < 20_000


def test_lines_are_found_among_lists_within_lists():
    text = "a.b = 1\n[[x]]\nk = 1\n[[x.y]]\n[[x.y]]\nk = 2\n[[x]]\n[[x.y]]\nk = 3\n[x.z]\nk = 4\n"
    found = [
        ["a", "b"],
        ["x", 0, "k"],
        ["x", 0, "y", 1, "k"],
        ["x", 1, "y", 0, "k"],
        ["x", 1, "z", "k"],
        ["x", 1, "q"],
    ]
    assert [line_of(keys, text) for keys in found] == [1, 3, 6, 9, 11, 7]
    assert line_of(["none"], text) is None


def test_a_file_may_begin_with_the_mark_of_its_encoding(capsys, tmp_path):
    (tmp_path / "scene.toml").write_text(GOOD, encoding="utf-8-sig")
    assert Scene.read(tmp_path / "scene.toml").molecules[0].count == 20


def test_a_scene_that_is_a_pipe_or_too_large(tmp_path):
    os.mkfifo(tmp_path / "pipe.toml")
    with pytest.raises(SceneError, match="is a pipe, a socket or a device"):
        Scene.read(tmp_path / "pipe.toml")
    (tmp_path / "large.toml").write_bytes(b"#" * 5_000_000)
    with pytest.raises(SceneError, match=r"has 5 MB. Files of up to 4 MB are read"):
        Scene.read(tmp_path / "large.toml")


def test_control_characters_of_a_model_are_not_printed(printed, tmp_path):
    sites = '[[sites]]\nname = "A"\nmass_u = 1.0\nposition_A = [0.0, 0.0, 0.0]\n'
    (tmp_path / "m.toml").write_text(f'name = "\\u001b[31mevil\\u202e"\n{sites}')
    message = printed("models", tmp_path / "m.toml", code=2).err
    assert "\x1b" not in message and "line 1: name: is '\\x1b[31mevil\\u202e'" in message
    (tmp_path / "m.toml").write_text(f"x = {DEEP}\n")
    with pytest.raises(MoleculeError, match="more than 32 deep"):
        read_molecule(tmp_path / "m.toml")


@pytest.mark.parametrize(
    ("name", "old", "new", "expected"),
    [
        (
            "x.xyz",
            "6\n",
            "100000000000\n",
            "x.xyz: line 1 promises 100000000000 atoms, 6 are there: truncated?",
        ),
        ("x.xyz", "6\n", "²\n", "x.xyz: line 1: expected the number of atoms, found '²'"),
        (
            "x.gro",
            "\n6\n",
            f"\n{'9' * 5000}\n",
            "x.gro: line 2: expected the number of atoms, found '999",
        ),
        ("x.gro", "\n6\n", "\n²\n", "x.gro: line 2: expected the number of atoms, found '²'"),
        ("x.data", "6 atoms", "100000000000 atoms", "x.data: line 3 promises 100000000000 atoms"),
        ("x.cif", "1.0\n", "full\n", "x.cif: some of its sites have the occupancy full"),
        ("x.xyz", "O 2.0 ", "O 1e200 ", "x.xyz: an atom is at 1e+200 Å, farther than 1e+09 Å"),
        (
            "y.xyz",
            '"18.0',
            '"0.1',
            "y.xyz: its box: with its edges of 0.1, 18, 18 Å it is 0.1 Å thick",
        ),
        ("x.gro", "   OW", "\x1b[31m", "x.gro: atom 1 has a name with control characters"),
    ],
)
def test_a_structure_that_was_made_to_break(name, old, new, expected, capsys, tmp_path):
    text = STRUCTURES[name].replace("    O", "   OW")
    assert old in text
    (tmp_path / name).write_text(text.replace(old, new, 1))
    scene = FROM_FILE.replace("FILE", name).replace(
        "[box]\nlengths_A = 18.0\n" if name == "y.xyz" else "none", ""
    )
    assert expected in refusal(capsys, tmp_path, scene)


@pytest.mark.parametrize(
    "cell",
    [np.array([[18.0, 0, 0], [18, 0, 0], [0, 0, 18]]), np.diag([18, np.inf, 18]), -18 * np.eye(3)],
)
def test_a_state_with_a_cell_that_is_none(cell, tmp_path):
    turn = np.tile(np.eye(3), (2, 1, 1))
    state = state_of(np.array([[0.0, 0, 0], [5, 5, 5]]), None, turn, None, cell)
    write_state(tmp_path / "final.npz", SavedState(state, ["spce"], np.zeros(2, int), None))
    (tmp_path / "scene.toml").write_text(
        FROM_FILE.replace("FILE", "final.npz").replace("lengths_A = 18.0", "")
    )
    with pytest.raises(StructureError, match="cell: damaged"):
        build(Scene.read(tmp_path / "scene.toml"))


def test_a_state_that_unpacks_to_more_than_there_is(monkeypatch, tmp_path):
    with zipfile.ZipFile(tmp_path / "final.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("position.npy", bytes(10_000_000))
    (tmp_path / "scene.toml").write_text(FROM_FILE.replace("FILE", "final.npz"))
    monkeypatch.setattr(process, "free_memory", lambda: 1e7)
    with pytest.raises(
        StructureError, match=r"not enough memory: reading its 0.01 GB needs 0.02 GB of memory"
    ):
        build(Scene.read(tmp_path / "scene.toml"))


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("NUMBA_NUM_THREADS", "0", "must be a whole number from 1 to 4096"),
        ("NUMBA_NUM_THREADS", "abc", "must be a whole number from 1 to 4096"),
        ("RIGIDMD_SIMD_BITS", "0", "must be one of 128, 256, 512"),
        ("RIGIDMD_SIMD_BITS", "64", "must be one of 128, 256, 512"),
        ("RIGIDMD_SIMD_BITS", "abc", "must be one of 128, 256, 512"),
    ],
)
def test_a_setting_of_the_machine_that_cannot_be(name, value, expected, tmp_path):
    (tmp_path / "scene.toml").write_text(GOOD)
    command = [sys.executable, "-m", "rigidmd", "check", "scene.toml"]
    found = subprocess.run(
        command, cwd=tmp_path, env=with_settings(**{name: value}), capture_output=True, text=True
    )
    assert (found.returncode, found.stdout) == (2, "")
    assert found.stderr == f"rigidmd: {name} is {value!r}, {found.stderr.split(', ', 1)[1]}"
    assert expected in found.stderr


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"NUMBA_DISABLE_JIT": "1"}, "NUMBA_DISABLE_JIT is set: Numba would compile nothing"),
        ({"NUMBA_OPT": "abc"}, "NUMBA_OPT is 'abc', which Numba cannot read: unset it"),
        ({"NUMBA_DEBUG_CACHE": "x"}, "NUMBA_DEBUG_CACHE is 'x', which Numba cannot read: unset it"),
        (
            {"NUMBA_CPU_NAME": "generic", "RIGIDMD_SIMD_BITS": "256"},
            "vectors have at most 128 bits on generic",
        ),
    ],
)
def test_a_setting_with_which_nothing_can_be_compiled(settings, expected, tmp_path):
    (tmp_path / "scene.toml").write_text(GOOD)
    command = [sys.executable, "-m", "rigidmd", "check", "scene.toml"]
    found = subprocess.run(
        command, cwd=tmp_path, env=with_settings(**settings), capture_output=True, text=True
    )
    assert (found.returncode, found.stdout, found.stderr.count("\n")) == (2, "", 1)
    assert expected in found.stderr


@pytest.mark.skipif(sys.platform != "linux", reason="the limit is one of Linux")
@pytest.mark.parametrize("kilobytes", [150_000, 600_000])
def test_a_limit_of_memory_that_is_too_low_for_libraries(kilobytes, tmp_path):
    (tmp_path / "scene.toml").write_text(GOOD)
    command = f"ulimit -v {kilobytes}; exec {sys.executable} -m rigidmd check scene.toml"
    found = subprocess.run(["sh", "-c", command], cwd=tmp_path, capture_output=True, text=True)
    assert (found.returncode, found.stdout, found.stderr.count("\n")) == (2, "", 1)
    assert "not enough memory" in found.stderr
    assert "ulimit -v" in found.stderr


def test_a_terminal_without_the_letters_ends_no_command(monkeypatch, tmp_path):
    (tmp_path / "scene.toml").write_text(GOOD)
    written = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(written, "ascii", write_through=True))
    assert main(["check", str(tmp_path / "scene.toml")]) == 0
    assert rb"20.0000 x 20.0000 x 20.0000 \xc5" in written.getvalue()


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (["--until", "9" * 40 + "ps"], "more than 1e+12 steps away"),
        (["-o", "a" * 300], "File name too long"),
    ],
)
def test_an_end_or_a_folder_that_cannot_be(options, expected, capsys, tmp_path):
    assert expected in refusal(capsys, tmp_path, GOOD, *options, commands=("run",))


@pytest.mark.parametrize(
    "command",
    [
        "check NAME",
        "run NAME",
        "resume NAME",
        "analyse NAME",
        "report NAME",
        "view NAME",
        "compare NAME NAME",
        "sweep NAME --set seed=1,2",
        "new argon -o NAME.toml",
        "virial argon --temperatures 300 -o NAME.csv",
    ],
)
def test_a_name_that_is_too_long_for_a_file(command, printed):
    message = printed(*command.replace("NAME", "a" * 300).split(), code=2).err
    assert message.startswith("rigidmd: ") and "File name too long" in message


def test_an_end_with_more_digits_than_a_number_has(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["run", "nowhere.toml", "--until", "9" * 400 + "ps"])
    assert ended.value.code == 2
    assert "is not a time with a unit" in capsys.readouterr().err


def site_scene(**site):
    return {
        "box": {"lengths_A": 20.0},
        "start": {"temperature_K": 100.0},
        "stages": [{"duration_ps": 0.002}],
        "molecules": [{"name": "a", "count": 2, "sites": [{"name": "A", "mass_u": 40.0} | site]}],
    }


@pytest.mark.parametrize("element", ["x\ny", "", "o", "Ar Ne", "<b>", "Q" * 5000, "Uue"])
def test_an_element_is_a_chemical_symbol(element):
    with pytest.raises(
        SceneError, match=r"element: is '.*', must be a chemical symbol such as O, or X"
    ) as error:
        Scene.from_dict(site_scene(element=element))
    assert len(str(error.value)) < 400


@pytest.mark.parametrize("element", ["X", "D", "W", "Og"])
def test_symbols_of_elements_and_x_are_accepted(element):
    assert Scene.from_dict(site_scene(element=element)).molecules[0].sites[0].element == element


def test_the_elements_are_those_of_ase():
    assert {*SYMBOLS.split()} == {*chemical_symbols} - {"X"}


@pytest.mark.parametrize("name", ["n" * 101, "a\nb", "a\x1b[2J", ""])
@pytest.mark.parametrize("place", ["species", "parameter", "stage", "model"])
def test_names_have_one_line_and_at_most_100_characters(place, name, tmp_path):
    data = site_scene(parameters={name: 1.0} if place == "parameter" else {})
    if place == "species":
        data["molecules"][0]["name"] = name
    if place == "stage":
        data["stages"][0]["name"] = name
    if place == "model":
        (tmp_path / "m.toml").write_text(
            tomli_w.dumps({"name": name, "sites": data["molecules"][0]["sites"]})
        )
        data["molecules"][0] = {"file": "m.toml", "count": 2}
    with pytest.raises(RigidMDError, match=r"name|parameters") as error:
        build(Scene.from_dict(data, tmp_path))
    assert len(str(error.value)) < 500 and "\x1b" not in str(error.value)


def test_the_name_of_a_trajectory_fits_into_a_folder():
    with pytest.raises(SceneError, match="must have at most 200 characters"):
        Scene.from_dict(site_scene() | {"output": {"trajectory": "t" * 260 + ".xtc"}})
