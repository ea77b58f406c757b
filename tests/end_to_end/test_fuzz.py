"""Input from outsiders: whatever a file or an option holds, it is taken or rejected with one of our
errors.

Valid input is changed at random: keys dropped, doubled and renamed, extreme numbers, wrong types,
strange text, bytes cut off and flipped; besides input that is arbitrary. Nothing here compiles
kernels: `check` describes a run.
"""

import contextlib
import io
import os
import resource
import sys
import time
import tomllib
import warnings
from copy import deepcopy
from pathlib import Path

import ase
import ase.io
import gsd.hoomd
import numpy as np
import pytest
import tomli_w
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.scenes import FROM_FILE, SATELLITE, STRUCTURES

from rigidmd.commands.cli import main
from rigidmd.core.state import state_of
from rigidmd.core.state_file import SavedState, write_state
from rigidmd.errors import UNPRINTABLE, CheckpointError, StructureError
from rigidmd.formats.atoms import is_element
from rigidmd.io.checkpoint import Checkpoint, read_checkpoint, write_checkpoint
from rigidmd.io.structure_file import read_atoms

SECONDS, BYTES = 5.0, 2e9  # of computing, that an input may take
FEW, MANY = 20, 1250  # inputs of each of the nine tests, in CI and in the soak tier

WATER = """
seed = 3
[box]
lengths_A = 20.0
[[molecules]]
model = "spce"
count = 5
[[molecules]]
model = "argon"
count = 2
frozen = [1]
[forces]
cutoff_A = 8.0
truncation = "shift"
[[forces.pairs]]
sites = ["O", "Ar"]
sigma_A = 3.3
epsilon_kJ_mol = 0.5
[[forces.custom]]
name = "soft"
energy = "A*exp(-B*r) - C/r**6"
parameters = { AR = { A = 1e5, B = 3.7, C = 6e3 }, O = { A = 2e5, B = 3.9, C = 3e3 } }
mixing = { B = "arithmetic" }
[[forces.custom.pairs]]
sites = ["O", "H"]
parameters = { A = 1e4, B = 4.0, C = 0.0 }
[start]
temperature_K = 300.0
[[stages]]
ensemble = "nvt"
temperature_K = [300.0, 280.0]
duration_ps = 0.01
timestep_fs = 1
[fields]
electric_V_per_nm = [0.0, 0.0, 0.5]
restraints = [{ species = "argon", molecules = "2", stiffness_kJ_mol_A2 = 10.0 }]
walls = [{ axis = "z", kind = "harmonic", positions_A = [3.0, 9.0], stiffness_kJ_mol_A2 = 5.0 }]
[output]
trajectory = "t.trr"
log_interval_ps = 0.002
"""
PRESSED = """
precision = "mixed"
[box]
lengths_A = [20.0, 21.0, 22.0]
angles_deg = [80.0, 85.0, 90.0]
[[molecules]]
name = "own"
count = 4
sites = [
  { name = "A", element = "O", mass_u = 16.0, position_A = [0.0, 0.0, 0.0], charge_e = -0.5, sigma_A = 3.0, epsilon_K = 50.0 },
  { name = "B", element = "H", mass_u = 1.0, position_A = [0.0, 0.0, 1.0], charge_e = 0.5 },
]
masses_u = { B = 2.0 }
[forces]
cutoff_A = 8.0
electrostatics = "pme"
ewald_accuracy = 1e-3
tail_correction = true
[[stages]]
ensemble = "minimise"
max_iterations = 5
[[stages]]
ensemble = "npt"
temperature_K = 300.0
pressure_bar = 1.0
duration_ps = 0.01
integrator = "baoab"
barostat = "cell_rescaling"
"""
SUMMED = PRESSED.replace('"pme"', '"ewald"').replace("angles_deg = [80.0, 85.0, 90.0]\n", "")
TOP = """
[body]
mass_kg = 2.0
pinned = true
solid = { shape = "cylinder", radius_m = 0.1, height_m = 0.3 }
centre_of_mass_m = [0.0, 0.0, 0.2]
[start]
euler_angles_deg = [0.0, 30.0, 0.0]
euler_rates_rad_s = [0.0, 0.0, 50.0]
[gravity]
acceleration_m_s2 = [0.0, 0.0, -9.81]
[friction]
viscous_N_m_s = [0.0, 0.0, 0.001]
[[applied]]
axes = "body"
torque_N_m = [[0.0, 0.0, 0.1], [0.0, 0.0, 0.0]]
times_s = [0.0, 0.5]
[run]
duration_s = 1.0
timestep_s = 0.001
"""
SUNK = """
[body]
points = [{ mass_kg = 1.0, position_m = [0.1, 0.0, 0.0] }, { mass_kg = 1.0, position_m = [-0.1, 0.0, 0.0] }, { mass_kg = 1.5, position_m = [0.0, 0.2, 0.0] }, { mass_kg = 1.5, position_m = [0.0, -0.2, 0.0] }]
[start]
velocity_m_s = [1.0, 0.0, 0.0]
rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
[gravity]
[fluid]
linear_resistance_kg_s = [0.1, 0.1, 0.1]
added_mass_kg = [0.1, 0.2, 0.3]
displaced_mass_kg = 1.0
[run]
duration_s = 0.5
timestep_s = 0.001
[output]
trajectory = false
"""
CHANGING = SATELLITE.replace("inertia_kg_m2 = [1.0, 2.0, 2.5]\n", "").replace(
    "[frame]\nangular_velocity_rad_s = [0.0, 0.001, 0.0]",
    "[changing_inertia]\ntimes_s = [0.0, 1.0]\ninertia_kg_m2 = [[1.0, 2.0, 2.5], [2.0, 2.0, 2.5]]",
)
SCENES = [tomllib.loads(text) for text in (WATER, PRESSED, SUMMED, TOP, SATELLITE, SUNK, CHANGING)]

MODEL = """
name = "mine"
title = "A molecule"
residue_names = ["MIN"]
mixing = "geometric"
[[sites]]
name = "A"
element = "O"
mass_u = 16.0
charge_e = -0.8
sigma_A = 3.1
epsilon_kJ_mol = 0.6
position_A = [0.0, 0.0, 0.0]
[[sites]]
name = "B"
element = "H"
mass_u = 1.0
charge_e = 0.4
position_A = [0.8, 0.6, 0.0]
[[sites]]
name = "C"
element = "H"
mass_u = 1.0
charge_e = 0.4
position_A = [-0.8, 0.6, 0.0]
"""
TABLE = """
title = "Shared"
[[sites]]
name = "O"
mass_u = 16.0
charge_e = -0.8
sigma_A = 3.1
epsilon_kcal_mol = 0.15
[[sites]]
name = "H"
charge_e = 0.4
"""
ONE_WATER = "3\nwater\nO 0.0 0.0 0.0\nH 0.8164904 0.5773590 0.0\nH -0.8164904 0.5773590 0.0\n"


NUMBERS = [
    0,
    1,
    -1,
    2,
    3,
    7,
    2**31,
    2**53,
    10**12,
    2**63 - 1,
    2**63,
    10**30,
    10**400,
    0.0,
    -0.0,
    0.5,
    1.0,
    -1.0,
    3.0,
    90.0,
    1e3,
    1e-3,
    1e6,
    1e-6,
    1e10,
    1e-10,
    1e30,
    1e-30,
    1e31,
    1e-31,
    1e100,
    1e-100,
    1e200,
    -1e200,
    1e300,
    1e-300,
    5e-324,
    float("inf"),
    float("-inf"),
    float("nan"),
]
FACTORS = [
    0.0,
    -1.0,
    0.5,
    0.8,
    0.9,
    0.99,
    1.01,
    1.1,
    1.3,
    2.0,
    5.0,
    0.1,
    30.0,
    1e-3,
    1e3,
    1e-6,
    1e6,
    1e-12,
    1e12,
]
TEXTS = [
    "",
    " ",
    "x",
    "nan",
    "1",
    "spce",
    "argon",
    "\x1b[31mred\x07",
    "a\x00b",
    "\u202eleft",
    "ä",
    "²",
    "٣",
    "1-10",
    "1-99999999999999999999",
    "../x",
    "/",
    ".",
    "~",
    "/dev/zero",
    "/dev/tty",
    "x.gro",
    "x.xyz",
    "x.toml",
    "a" * 300,
    "a" * 300 + ".toml",
    "[a(b",
    "int",
    "float",
    "1.2.3",
    "O",
    "H",
    "nve",
    "npt",
    "pme",
    "ewald",
    "none",
    "true",
    "z",
    "%s",
    "{}",
    "\n",
    "\t",
    "Å" * 70,
]
STRANGE = st.one_of(
    st.sampled_from(NUMBERS),
    st.sampled_from(TEXTS),
    st.booleans(),
    st.floats(),
    st.integers(-(2**70), 2**70).filter(
        lambda n: not 10**4 < n < 2**31
    ),  # such counts are many molecules
    st.text(max_size=20),
    st.sampled_from(
        [
            [],
            {},
            [[]],
            [{}],
            {"a": 1},
            [1.0, 2.0, 3.0],
            [0.0, 0.0, 0.0],
            ["A", "B"],
            [[1.0, 2.0, 3.0]] * 2,
        ]
    ),
    st.sampled_from([[], [[]], [[], []], [[[]]], [[[], []]], [[], [[]]]]),
).map(deepcopy)  # or a later change would change what is drawn from
BYTE_CHANGES = st.lists(
    st.tuples(
        st.sampled_from(
            ["digit", "digit", "digit", "cut", "flip", "drop line", "double line", "word", "insert"]
        ),
        st.floats(0, 1, exclude_max=True),
        st.one_of(
            st.binary(min_size=1, max_size=4),
            st.sampled_from([str(number).encode() for number in NUMBERS]),
            st.sampled_from(
                [
                    text.encode()
                    for text in (*TEXTS, "?", "-", "\ufeff", '"', "'''", "[[", "]", "=", "#")
                ]
            ),
        ),
    ),
    min_size=1,
    max_size=3,
)


def paths(data, before=()):
    """The paths of all keys and entries of nested tables and lists, and what is there."""
    for key, value in data.items() if isinstance(data, dict) else enumerate(data):
        yield (*before, key), value
        if isinstance(value, dict | list):
            yield from paths(value, (*before, key))


@st.composite
def changed(draw, tables):
    """One of these tables with some of its keys and values changed."""
    data = deepcopy(draw(st.sampled_from(tables)))
    for _ in range(draw(st.sampled_from([1, 1, 1, 2, 3]))):
        if not (places := [path for path, _ in paths(data)]):
            break
        *parents, last = draw(st.sampled_from(places))
        holder = data
        for key in parents:
            holder = holder[key]
        what = draw(
            st.sampled_from(
                ["drop", "replace", "scale", "scale", "scale", "double", "rename", "add"]
            )
        )
        if what == "drop":
            del holder[last]
        elif what == "scale" and type(holder[last]) in (int, float):
            holder[last] *= draw(
                st.sampled_from(FACTORS if isinstance(holder[last], float) else [0, 1, 2, 3, 10])
            )
        elif what in ("replace", "scale"):
            holder[last] = draw(STRANGE)
        elif what == "double" and isinstance(holder, list):
            holder.insert(last, deepcopy(holder[last]))
        elif isinstance(holder, list):
            holder.append(draw(STRANGE))
        elif what == "rename":
            holder[draw(st.one_of(st.sampled_from(TEXTS), st.text(max_size=9)))] = holder.pop(last)
        else:
            holder[draw(st.sampled_from(TEXTS))] = draw(STRANGE)
    return data


def with_bytes_changed(content: bytes, changes) -> bytes:
    """A file with bytes cut off, flipped or replaced."""
    for what, where, piece in changes:
        at = int(where * len(content))
        lines = content.split(b"\n")
        line = int(where * len(lines))
        if what == "digit" and (
            digits := [k for k, byte in enumerate(content) if 48 <= byte <= 57]
        ):
            at = digits[int(where * len(digits))]
            content = (
                content[:at] + bytes([48 + piece[0] % 10 if piece else 48]) + content[at + 1 :]
            )
        elif what == "cut":
            content = content[:at]
        elif what == "flip" and content:
            content = (
                content[:at] + bytes([content[at] ^ (1 << piece[0] % 8)]) + content[at + 1 :]
                if piece
                else content
            )
        elif what == "drop line":
            content = b"\n".join(lines[:line] + lines[line + 1 :])
        elif what == "double line":
            content = b"\n".join([*lines[: line + 1], *lines[line:]])
        elif what == "word" and (words := lines[line].split(b" ")):
            words[int(where * 997) % len(words)] = piece
            lines[line] = b" ".join(words)
            content = b"\n".join(lines)
        elif what == "insert":
            content = content[:at] + piece + content[at:]
    return content


class Trial:
    """Runs commands on strange input, and keeps what they took."""

    def __init__(self):
        self.inputs = self.refused = 0
        self.slowest, self.slowest_of = 0.0, ""
        self.before = self.peak

    @property
    def peak(self) -> float:
        """Largest memory of this process so far, bytes."""
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (
            1 if sys.platform == "darwin" else 1024
        )

    def __call__(self, *arguments: str) -> int:
        """The exit code of a command, which must be 0 or 2 with a message that is safe to print."""
        out, err = io.StringIO(), io.StringIO()
        begin = time.process_time()
        with (
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter(
                "error", RuntimeWarning
            )  # of NumPy: numbers that overflow or mean nothing
            code = main(list(arguments))
        self.note(time.process_time() - begin, code == 2, arguments)
        said = out.getvalue() + err.getvalue()
        assert code in (0, 2), said
        assert not UNPRINTABLE.search(said), said
        if code == 2:
            assert err.getvalue().startswith("rigidmd: "), said
            assert len(err.getvalue().splitlines()[0].split(": ")) >= 3 or "errors" in said, said
            assert len(said) < 100_000
        return code

    def note(self, seconds: float, refused: bool, what: object) -> None:
        """Count an input."""
        self.inputs += 1
        self.refused += refused
        if seconds > self.slowest:
            self.slowest, self.slowest_of = seconds, str(what)[:200]
        assert seconds < SECONDS, what
        assert self.peak - self.before < BYTES, what


@pytest.fixture(scope="module")
def trial():
    """One for all inputs; shows what they took."""
    main(["check", "nowhere.toml"])  # what is imported at the first command is none of the input's
    found = Trial()
    yield found
    print(
        f"\n{found.inputs} inputs, {found.refused} refused, the slowest {found.slowest:.2f} s {found.slowest_of}, "
        f"{(found.peak - found.before) / 1e6:.0f} MB more at most"
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Where all scenes lie; their files are written again for each input."""
    place = tmp_path_factory.mktemp("strange")
    before = Path.cwd()
    os.chdir(place)
    yield place
    os.chdir(before)


def fuzz(*strategies):
    """A test that takes a few inputs, and one in the soak tier that takes many."""

    def tests(function):
        def limited(count):
            told = settings(
                max_examples=count,
                deadline=None,
                derandomize=True,
                database=None,
                suppress_health_check=list(HealthCheck),
            )
            return told(given(*strategies)(function))

        return limited(FEW), pytest.mark.soak(limited(MANY))

    return tests


def written(data: dict) -> bytes:
    """A table as TOML."""
    return tomli_w.dumps(data).encode("utf-8", "surrogatepass")


@pytest.fixture(scope="module")
def attack(trial, folder):
    """Check a scene, with other files next to it."""

    def check(scene: bytes, *arguments: str, **files: bytes) -> int:
        (folder / "scene.toml").write_bytes(scene)
        for name, content in files.items():
            (folder / name.replace("_", ".", 1)).write_bytes(content)
        return trial("check", "scene.toml", *arguments)

    return check


def test_all_that_is_changed_is_valid(attack, folder, trial):
    assert [attack(written(scene)) for scene in SCENES] == [0] * len(SCENES)
    for name, text in STRUCTURES.items():
        assert (
            attack(
                FROM_FILE.replace("FILE", name).encode(), **{name.replace(".", "_"): text.encode()}
            )
            == 0
        ), name
    _models(trial, attack, folder, (tomllib.loads(MODEL), []))
    _tables(attack, (tomllib.loads(TABLE), False, []))
    _states(attack, folder, ({}, []))
    assert trial.refused == 0


def _scenes(attack, data):
    attack(written(data))


def _texts(attack, told):
    text, changes = told
    attack(with_bytes_changed(text, changes))


def _overrides(attack, told):
    scene, key, value = told
    attack(written(scene), f"--set={key}={value}")


def _structures(attack, told):
    name, changes, frame = told
    scene = FROM_FILE.replace("FILE", name).replace("[box]", f"{frame}[box]")
    attack(
        scene.encode(),
        **{name.replace(".", "_"): with_bytes_changed(STRUCTURES[name].encode(), changes)},
    )


#: Files that are read through ASE, or that are binary, next to those of `STRUCTURES`: name -> format of ASE.
OF_ASE = {
    "x.traj": "traj",
    "POSCAR": "vasp",
    "x.xsf": "xsf",
    "x.gen": "gen",
    "x.json": "json",
    "CONFIG": "dlp4",
    "z.xyz": "extxyz",
}


@pytest.fixture(scope="module")
def readable(folder):
    """The content of a file of each format, by name."""
    points = [[1, 1, 1], [1.8, 1.6, 1], [0.2, 1.6, 1], [6, 6, 6], [6.8, 6.6, 6], [5.2, 6.6, 6]]
    atoms = ase.Atoms("OHHOHH", points, cell=[18, 18, 18], pbc=True)
    atoms.set_velocities(np.ones((6, 3)))
    for name, form in OF_ASE.items():
        ase.io.write(folder / name, atoms, format=form)
    frame = gsd.hoomd.Frame()
    frame.particles.N, frame.particles.types = 6, ["O", "H"]
    frame.particles.typeid = [0, 1, 1, 0, 1, 1]
    frame.particles.position, frame.particles.velocity = atoms.positions - 9.0, np.ones((6, 3))
    frame.configuration.box = [18, 18, 18, 0, 0, 0]
    with gsd.hoomd.open(str(folder / "x.gsd"), "w") as file:
        file.append(frame)
    rows = list(zip(atoms.symbols, atoms.positions, strict=True))
    block = "".join(
        f"    1 SOL   {e:<5}{k:7d}{''.join(f'{x / 10:15.9f}' for x in p)}\n"
        for k, (e, p) in enumerate(rows, 1)
    )
    g96 = f"TITLE\nwater\nEND\nPOSITION\n{block}END\nBOX\n{3 * f'{1.8:15.9f}'}\nEND\n"
    columns = ("type_symbol", "label_atom_id", "label_comp_id", "Cartn_x", "Cartn_y", "Cartn_z")
    tags = "".join(f"_atom_site.{c}\n" for c in columns)
    edges = "".join(f"_cell.length_{x} 18\n_cell.angle_{y} 90\n" for x, y in CELL_TAGS)
    mmcif = "".join(f"{e} {e} SOL {' '.join(map(str, p))}\n" for e, p in rows)
    texts = STRUCTURES | {"x.g96": g96, "x.mmcif": f"data_x\n{edges}loop_\n{tags}{mmcif}"}
    binary = {name: (folder / name).read_bytes() for name in (*OF_ASE, "x.gsd")}
    return {name: text.encode() for name, text in texts.items()} | binary


CELL_TAGS = (("a", "alpha"), ("b", "beta"), ("c", "gamma"))
READABLE = sorted([*STRUCTURES, *OF_ASE, "x.gsd", "x.g96", "x.mmcif"])


def test_every_readable_file_is_read(readable, folder):
    assert sorted(readable) == READABLE
    for name, content in readable.items():
        (folder / name).write_bytes(content)
        assert len(read_atoms(folder / name).names) == 6, name


def _readers(trial, folder, readable, told):
    name, changes = told
    path = folder / name
    path.write_bytes(with_bytes_changed(readable[name], changes))
    begin = time.process_time()
    refused = False
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        try:
            atoms = read_atoms(path)
        except StructureError as error:
            refused = True
            assert str(path) in str(error)
            assert not UNPRINTABLE.search(str(error).replace("\n", " "))
        else:
            assert np.isfinite(atoms.position).all()
            assert all(
                symbol in ("", "X", "D", "T") or is_element(symbol.capitalize())
                for symbol in atoms.elements
            )
    trial.note(time.process_time() - begin, refused, (name, changes))


def _models(trial, attack, folder, told):
    model, changes = told
    (folder / "m.toml").write_bytes(with_bytes_changed(written(model), changes))
    trial("models", "m.toml")
    attack(WATER.replace('model = "spce"', 'file = "m.toml"').encode())


def _tables(attack, told):
    table, geometry, changes = told
    own = 'file = "x.xyz"\nparameters = "t.toml"'
    scene = WATER.replace('model = "spce"', own)
    attack(
        scene.encode(),
        t_toml=written(table),
        x_xyz=with_bytes_changed(ONE_WATER.encode(), changes if geometry else []),
    )


def _states(attack, folder, told):
    arrays, changes = told
    turn = np.tile(np.eye(3), (2, 1, 1))
    state = state_of(np.array([[0.0, 0, 0], [5, 5, 5]]), None, turn, None, 18.0 * np.eye(3))
    write_state(
        folder / "good.npz", SavedState(state, ["spce"], np.zeros(2, int), np.array([1, 2]))
    )
    with np.load(folder / "good.npz") as good:
        found = {name: good[name] for name in good.files}
    for name, array in arrays.items():
        if array is None:
            found.pop(name, None)
        else:
            found[name] = array
    np.savez(folder / "final.npz", **found)
    content = with_bytes_changed((folder / "final.npz").read_bytes(), changes)
    attack(FROM_FILE.replace("FILE", "final.npz").encode(), final_npz=content)


def _checkpoints(trial, folder, changes):
    write_checkpoint(
        folder, Checkpoint({"of": {"x": {"a": 1}}, "run": {}}, {"x/y": np.arange(50.0)})
    )
    path = folder / "checkpoint.npz"
    kept = path.read_bytes()
    path.write_bytes(with_bytes_changed(kept, changes))
    begin = time.process_time()
    try:
        found = read_checkpoint(path)
    except CheckpointError as error:
        assert str(path) in str(error)
        trial.note(time.process_time() - begin, True, changes)
    else:
        assert np.array_equal(
            found.of("x").arrays["y"], np.arange(50.0)
        )  # nothing wrong is ever taken
        trial.note(time.process_time() - begin, False, changes)


@st.composite
def overrides(draw):
    """A scene, a dotted key and a value: one of its own keys with a number near its own, or
    anything."""
    scene = draw(st.sampled_from(SCENES))
    own = {".".join(map(str, path)): value for path, value in paths(scene)}
    if draw(st.booleans()):
        key = draw(
            st.sampled_from([key for key, value in own.items() if type(value) in (int, float)])
        )
        return (
            scene,
            key,
            own[key] * draw(st.sampled_from([1, 2, 0] if isinstance(own[key], int) else FACTORS)),
        )
    key = draw(
        st.one_of(
            st.sampled_from(KEYS),
            st.sampled_from(KEYS).map(lambda key: f"{key}.0"),
            st.text(max_size=20),
        )
    )
    strange = st.sampled_from([*NUMBERS, *TEXTS, "[[", "{a=1}", "[1,2", "=", "a=b"])
    return scene, key, draw(st.one_of(strange, st.text(max_size=20)))


KEYS = sorted({".".join(map(str, path)) for scene in SCENES for path, _ in paths(scene)})
ARRAYS = st.one_of(
    st.none(),
    st.sampled_from(
        [
            np.zeros(0),
            np.zeros((2, 3)),
            np.full((2, 3), np.nan),
            np.full((2, 3), 1e300),
            np.zeros((3, 3)),
            np.eye(3),
            -np.eye(3),
            np.full((3, 3), np.inf),
            np.diag([18.0, np.inf, 18.0]),
            np.array([[18.0, 0, 0], [18, 0, 0], [0, 0, 18]]),
            1e-300 * np.eye(3),
            np.zeros(2, int),
            np.full(2, 7),
            np.array(["spce"]),
            np.array(["\x1b[31m"]),
            np.array(3.0),
            np.array(2),
            np.zeros((2, 3, 3)),
            np.zeros(2, complex),
            np.zeros((2, 3), bool),
            np.array(10**9),
            np.array([]),
        ]
    ),
)
NAMES = [
    "schema",
    "species_names",
    "species",
    "residue_number",
    "models",
    *state_of()._fields,
    "other",
]

test_scenes, test_many_scenes = fuzz(changed(SCENES))(_scenes)
test_texts, test_many_texts = fuzz(
    st.one_of(
        st.tuples(st.sampled_from(SCENES).map(written), BYTE_CHANGES),
        st.tuples(
            st.one_of(st.binary(max_size=200), st.text(max_size=200).map(str.encode)), st.just([])
        ),
    )
)(_texts)
test_overrides, test_many_overrides = fuzz(overrides())(_overrides)
test_structures, test_many_structures = fuzz(
    st.tuples(
        st.sampled_from(sorted(STRUCTURES)),
        BYTE_CHANGES,
        st.sampled_from(["", "", "frame = 2\n", "frame = -1\n", "tolerance = 1e-30\n"]),
    )
)(_structures)
test_readers, test_many_readers = fuzz(st.tuples(st.sampled_from(READABLE), BYTE_CHANGES))(_readers)
test_models, test_many_models = fuzz(
    st.one_of(
        st.tuples(changed([tomllib.loads(MODEL)]), st.just([])),
        st.tuples(st.just(tomllib.loads(MODEL)), BYTE_CHANGES),
    )
)(_models)
test_tables, test_many_tables = fuzz(
    st.tuples(changed([tomllib.loads(TABLE)]), st.booleans(), BYTE_CHANGES)
)(_tables)
test_states, test_many_states = fuzz(
    st.tuples(
        st.dictionaries(st.sampled_from(NAMES), ARRAYS, max_size=2),
        st.one_of(st.just([]), st.just([]), BYTE_CHANGES),
    )
)(_states)
test_checkpoints, test_many_checkpoints = fuzz(BYTE_CHANGES)(_checkpoints)
