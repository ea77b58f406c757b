"""Trajectories as structure files: the last frame of an earlier run, of this engine or another, or
a clear message."""

import shutil
import sys
from itertools import cycle
from pathlib import Path

import ase.io
import MDAnalysis as mda
import numpy as np
import pytest
from MDAnalysis.analysis.dielectric import DielectricConstant
from MDAnalysis.lib.formats.libmdaxdr import XTCFile
from support.common import small_scene
from support.scenes import FORTY_WATERS, NVT, forty_waters

from rigidmd import formats
from rigidmd.assemble.build import build
from rigidmd.assemble.structure import read_structure
from rigidmd.core.process import ignore_warnings
from rigidmd.core.state import NO_CELL, edges_and_angles
from rigidmd.errors import SceneError, SimulationError, StructureError
from rigidmd.features.analysis.rigid_frames import without_rounding
from rigidmd.features.external.verify import export
from rigidmd.formats import BY_EXTENSION, Topology, through_mdanalysis
from rigidmd.formats.atoms import Frame
from rigidmd.io.structure_file import read_atoms, read_geometry
from rigidmd.io.trajectory import (
    from_files,
    in_memory,
    read_frames,
    reader_of,
)
from rigidmd.io.trajectory_file import open_trajectory, write_topology
from rigidmd.mechanics.rotation import random_rotations
from rigidmd.run import Simulation
from rigidmd.scene import Scene
from rigidmd.scene.models import load_model

TEXT = """
[structure]
file = "old.xtc"
[[molecules]]
model = "tip4p2005"
[forces]
cutoff_A = 6.0
[[stages]]
temperature_K = 300
ensemble = "nvt"
duration_ps = 0.01
"""


def make(folder, ending, **species):
    """A trajectory of two frames with its topology; returns its path and the system of the second
    frame.

    species : a table of [[molecules]] in place of a shipped water
    """
    tables = {"box": {"lengths_A": [20.0, 21.0, 22.0], "angles_deg": [80.0, 95.0, 75.0]}}
    if species:
        tables["molecules"] = [species | {"count": 4}]
    system = build(small_scene({"tip4p2005": 4}, None, **tables))
    moved = system.state.copy()
    moved.position[:] += [40.0, 1.0, -3.0]
    moved.velocity[:] *= 2.0
    path = folder / f"old{ending}"
    file = open_trajectory(
        path, system, 1.0, velocities=ending in (".trr", ".gsd", ".nc"), wrapped=False
    )
    for k, state in enumerate((system.state, moved)):
        file.write(state, float(k), k)
    file.close()
    write_topology(folder / "topology.gro", system, moved, wrapped=True)
    return path, system, moved


#: Steps beyond 32 bits, signed or not, as far as a scene allows.
STEPS = [0, 2**31 - 1, 2**31, 2**32 + 5, 10**12]
EVERY_ENDING = [".xtc", ".trr", ".gsd", ".traj", ".dcd", ".nc", ".xyz", ".pdb"]


@pytest.mark.parametrize("ending", EVERY_ENDING)
def test_all_readers_find_the_frames_of_many_steps_and_boxes_that_change(tmp_path, ending):
    _, system, _ = make(tmp_path, ".gsd")
    states = [system.state.copy() for _ in STEPS]
    for k, state in enumerate(states):
        state.position[:] += 0.1 * k
        state.cell[:] *= 1 + 0.02 * k
    times = 4.3e6 + 0.1 * np.arange(len(STEPS))  # ps, which single precision rounds to halves
    whole, parts = tmp_path / f"whole{ending}", tmp_path / f"parts{ending}"
    file = open_trajectory(whole, system, 0.1, velocities=False, wrapped=False)
    for state, time, step in zip(states, times, STEPS, strict=True):
        file.write(state, time, step)
    file.close()
    kept = None
    for first, last in ((0, 2), (2, 5)):  # a run that resumes writes the same bytes
        file = open_trajectory(parts, system, 0.1, velocities=False, wrapped=False, kept=kept)
        if kept is not None:
            file.cut()
        for k in range(first, last):
            file.write(states[k], times[k], STEPS[k])
        kept = file.kept
        file.close()
    assert parts.read_bytes() == whole.read_bytes()

    lengths = np.array([np.linalg.norm(state.cell, axis=1) for state in states])
    sites = np.array([system.site_positions(state, False) for state in states])
    u = from_files(system, tmp_path / "topology.gro", whole, list(times))
    assert [frame.time for frame in u.trajectory] == list(times)
    found = read_frames(whole, len(sites[0]), 100)
    cells = np.linalg.norm(found.cells, axis=2)
    if ending != ".xyz":  # MDAnalysis reads no box of it
        assert np.array([frame.dimensions[:3].copy() for frame in u.trajectory]) == pytest.approx(
            lengths, abs=6e-4
        )
        plain = mda.Universe(str(tmp_path / "topology.gro"), str(whole), format=reader_of(ending))
        assert np.array(
            [frame.dimensions[:3].copy() for frame in plain.trajectory]
        ) == pytest.approx(lengths, abs=6e-4)
    assert cells == pytest.approx(lengths, abs=6e-4)
    assert np.array([frame.positions.copy() for frame in u.trajectory]) == pytest.approx(
        sites, abs=0.006
    )
    assert found.positions == pytest.approx(sites, abs=0.006)
    if ending in (".xyz", ".pdb", ".traj"):
        images = ase.io.read(whole, ":")
        assert len(images) == len(STEPS)
        assert np.array([image.cell.lengths() for image in images]) == pytest.approx(
            lengths, abs=6e-4
        )
        massive = system.sites.mass > 0 if ending == ".traj" else slice(None)
        assert np.array([image.positions for image in images]) == pytest.approx(
            sites[:, massive], abs=0.006
        )
    if ending == ".pdb":
        assert [
            line[:6].strip()
            for line in whole.read_text().splitlines()
            if line.startswith(("CRYST1", "MODEL", "END"))
        ] == [
            "CRYST1",
            "MODEL",
            "ENDMDL",
        ] * len(STEPS)


@pytest.mark.parametrize(("model", "sites"), [("spce", 3), ("tip4p2005", 4), ("tip5p", 5)])
@pytest.mark.parametrize("kept", ["files", "memory"])
def test_each_molecule_of_a_universe_is_one_fragment(tmp_path, model, sites, kept):
    system = build(small_scene({model: 8}, 20.0))
    state = system.state
    if kept == "files":
        file = open_trajectory(tmp_path / "t.xtc", system, 1.0, velocities=False, wrapped=False)
        for k in range(2):
            file.write(state, float(k), k)
        file.close()
        for name in ("t.gro", "t.pdb"):
            write_topology(tmp_path / name, system, state, wrapped=True)
        u = from_files(system, tmp_path / "t.pdb", tmp_path / "t.xtc", [0.0, 1.0])
        drawn = mda.Universe(str(tmp_path / "t.pdb"))
        assert len(drawn.bonds) == 2 * 8  # viewers draw none to massless sites
    else:
        sites_now = system.site_positions(state, False), state.cell, system.site_velocities(state)
        u = in_memory(system, [Frame(float(k), *sites_now) for k in range(2)])
    assert [len(fragment) for fragment in u.atoms.fragments] == [sites] * 8
    assert {tuple(bond.atoms.resids) for bond in u.bonds} == {(k, k) for k in range(1, 9)}
    found = DielectricConstant(u.atoms, temperature=300, make_whole=True).run().results
    assert np.isfinite(found["eps_mean"])


@pytest.mark.parametrize(("ending", "frame"), list(zip(EVERY_ENDING, cycle((1, -1)), strict=False)))
def test_united_atoms_of_trajectories_of_rigidmd(tmp_path, ending, frame):
    """Sites with mass and no element, and sites with neither, are found by their names in every
    format."""
    system = build(small_scene({"co2_2cljq": 4}, 20.0))
    moved = system.state.copy()
    moved.position[:] += [3.0, 1.0, -2.0]
    path = tmp_path / f"old{ending}"
    file = open_trajectory(path, system, 1.0, velocities=False, wrapped=False)
    for k, state in enumerate((system.state, moved)):
        file.write(state, float(k), k)
    file.close()
    write_topology(tmp_path / "topology.gro", system, moved, wrapped=True)
    found = read_structure(
        path,
        [load_model("co2_2cljq")],
        None,
        True,
        0.15,
        frame=frame,
        topology=tmp_path / "topology.gro",
    )
    state = moved if frame == -1 else system.state
    step = (found.position - state.position) / 20.0
    assert np.abs(step - np.round(step)).max() < 1e-3
    assert found.residual_max < 0.02


def test_times_in_single_precision_are_evened_where_they_can_be():
    times = 4.3e6 + 0.1 * np.arange(200)
    rounded = times.astype(np.float32).astype(float)
    assert np.diff(rounded).min() == 0
    assert without_rounding(rounded) == pytest.approx(times, abs=0.3)
    assert np.diff(without_rounding(rounded)) == pytest.approx(np.full(199, 0.1), rel=0.03)
    for uneven in (
        np.array([0.0, 1.0, 3.0]),
        np.array([0.0, 0.0, 1.0]),
        np.array([2.0]),
        np.array([]),
    ):
        assert np.array_equal(without_rounding(uneven), uneven)


@pytest.mark.parametrize(
    ("names", "ending"),
    [
        pytest.param(
            names,
            ending,
            marks=[] if names[0] == "Q" or ending in (".xtc", ".gsd") else pytest.mark.soak,
        )
        for names in ("OW HW1 HW2 MW", "O H H M", "O H H H", "Q Q Q Q")
        for ending in (".xtc", ".trr", ".gsd", ".dcd", ".nc")
    ],
)
@pytest.mark.usefixtures("reads_here")
def test_the_last_frame_of_a_trajectory(ending, names, tmp_path):
    """Whatever names sites share, massless ones included."""
    sites = load_model("tip4p2005").sites()
    named = [site | {"name": name} for site, name in zip(sites, names.split(), strict=True)]
    path, system, moved = make(tmp_path, ending, name="water", sites=named)
    names = None if ending == ".gsd" else tmp_path / "topology.gro"
    found = read_structure(path, system.species, None, True, 0.15, topology=names)
    error = 0.02 if ending == ".xtc" else 2e-5
    assert np.abs(found.position - moved.position).max() < error
    assert found.cell == pytest.approx(moved.cell, abs=1e-4)
    assert found.residual_max < error
    assert list(found.number) == [1, 2, 3, 4]
    if ending in (".trr", ".gsd", ".nc"):
        assert found.velocity == pytest.approx(moved.velocity, abs=1e-4)
        spin = np.linalg.norm(moved.angular_momentum_body, axis=1)
        assert np.linalg.norm(found.angular_momentum_body, axis=1) == pytest.approx(spin, abs=1e-3)
    else:
        assert found.velocity is None
    if ending in (".trr", ".gsd"):
        first = read_structure(path, system.species, None, True, 0.15, frame=1, topology=names)
        assert np.abs(first.position - system.state.position).max() < error
        assert not [
            other.name for other in tmp_path.iterdir() if other.name.startswith(".")
        ]  # no offsets next to it


@pytest.mark.parametrize(
    ("ending", "fault", "said"),
    [
        (".xtc", "no names", "there is no topology.gro or topology.pdb next to it: name a file"),
        (".xtc", "other names", "it has 16 atoms, the file with their names 3"),
        (".dcd", "noise", "cannot be read as a trajectory"),
        (".trr", "empty", "cannot be read as a trajectory"),
        (".nc", "cut", "cannot be read as a trajectory"),
        (".xtc", "frame", "structure.frame is 3: it holds 2"),
        (".gsd", "frame", "structure.frame is 3: it holds 2"),
        (".gsd", "noise", "Not a GSD file"),
        (".xtc", "crash", "its reader crashed. Is it damaged?"),
        (".xtc", "outside", "is outside the scene's folder"),
        (".gsd", "topology", "topology is for trajectories without names"),
        (".xtc", "not a structure", "name a structure file with names"),
    ],
)
def test_what_cannot_be_a_start(ending, fault, said, tmp_path, printed, monkeypatch):
    folder = tmp_path / "scene"
    folder.mkdir()
    path = make(folder, ending)[0]
    more = ""
    match fault:
        case "no names":
            (folder / "topology.gro").unlink()
        case "other names":
            (folder / "topology.gro").write_text(
                "t\n3\n"
                + "".join(
                    f"    1SOL  {name:>5}{k:>5}   0.000   0.000   0.{k}00\n"
                    for k, name in enumerate(("OW", "HW1", "HW2"), 1)
                )
                + "   2.0 2.0 2.0\n"
            )
        case "noise":
            path.write_bytes(np.random.default_rng(1).bytes(4000))
        case "empty":
            path.write_bytes(b"")
        case "cut":
            path.write_bytes(path.read_bytes()[:300])
        case "frame":
            more = "frame = 3"
        case "crash":
            program = tmp_path / "crash.py"
            program.write_text("import os, signal\nos.kill(os.getpid(), signal.SIGSEGV)\n")
            monkeypatch.setattr(through_mdanalysis, "PROGRAM", (str(program),))
        case "outside":
            shutil.move(folder / "topology.gro", tmp_path)
            more = 'topology = "../topology.gro"'
        case "topology":
            more = 'topology = "topology.gro"'
        case "not a structure":
            more = 'topology = "old.xtc"'
    file = folder / "scene.toml"
    file.write_text(TEXT.replace('"old.xtc"', f'"old{ending}"\n{more}'))
    error = printed("check", file, code=2).err
    assert said in error
    assert "Traceback" not in error


def test_damaged_gsd_as_structure(tmp_path):
    path = make(tmp_path, ".gsd")[0]
    content, rng = path.read_bytes(), np.random.default_rng(3)
    refused = 0
    for k in range(200):
        damaged = bytearray(content)
        for at in rng.integers(0, 5000 if k % 2 else len(content), 3):
            damaged[at] = rng.integers(256)
        path.write_bytes(damaged)
        try:
            read_atoms(path)
        except StructureError:
            refused += 1
    assert refused > 20


def hoomd_frame(
    sites, *, names=None, centres=False, masses=None, cell=(20.0, 20.0, 20.0), whole=True
):
    """A frame as HOOMD writes them: waters of types A and B, wrapped, with or without central
    particles and images.

    sites (n, 3, 3), names : of types. masses : of oxygen, hydrogen and of central particles
    """
    import gsd.hoomd

    n = len(sites)
    frame = gsd.hoomd.Frame()
    position = np.concatenate([*([sites.mean(axis=1)] if centres else []), sites.reshape(-1, 3)])
    frame.configuration.box = [*cell, 0, 0, 0]
    frame.particles.N = len(position)
    frame.particles.types = [*(names or ("A", "B")), "centre"]
    frame.particles.typeid = [*([2] * n if centres else []), *([0, 1, 1] * n)]
    first = np.repeat(np.arange(n), 3) if centres else np.repeat(np.arange(0, 3 * n, 3), 3)
    frame.particles.body = np.concatenate([np.arange(n) if centres else [], first])
    if centres:
        frame.particles.moment_inertia = np.array([[1.0, 2.0, 3.0]] * n + [[0.0] * 3] * (3 * n))
    if masses:
        oxygen, hydrogen, whole_mass = masses
        frame.particles.mass = [
            *([whole_mass] * n if centres else []),
            *([oxygen, hydrogen, hydrogen] * n),
        ]
    images = np.floor(position / cell)
    frame.particles.position = position - (images + 0.5) * cell
    if whole:
        frame.particles.image = images.astype(int)
    return frame


@pytest.mark.parametrize("centres", [True, False])
@pytest.mark.parametrize("whole", [True, False])
@pytest.mark.parametrize("named_by", ["types", "atom_types", "masses"])
def test_molecules_of_hoomd(centres, whole, named_by, tmp_path):
    """With and without central particles; types by name, by the scene, or by masses that add up."""
    import gsd.hoomd

    species = load_model("spce")
    rng = np.random.default_rng(8)
    truth = rng.uniform(0, 20, (6, 1, 3)) + 0.0
    rotations = random_rotations(rng, 6)
    sites = truth + np.einsum("nij,sj->nsi", rotations, species.positions_body)
    mass, path = float(species.mass), tmp_path / "a.gsd"
    frame = hoomd_frame(
        sites,
        names=("OW", "HW") if named_by == "types" else None,
        centres=centres,
        whole=whole,
        masses=(15.9994, 1.008, mass) if named_by == "masses" else (1.0, 1.0, mass),
    )
    with gsd.hoomd.open(path, "w") as file:
        file.append(frame)
    atom_types = {"A": "O", "B": "H"} if named_by == "atom_types" else None
    found = read_structure(path, [species], None, True, 0.15, atom_types=atom_types)
    assert found.residual_max < 1e-4
    step = (found.position - truth[:, 0]) / 20
    assert step == pytest.approx(np.round(step), abs=1e-5)
    if named_by == "atom_types":
        by_shape = read_structure(path, [species], None, True, 0.15)
        assert by_shape.notes == (
            "the names of atoms A, B, B are not elements: assigned to spce by shape",
        )
        with pytest.raises(StructureError, match=r"structure.atom_types has no name for type B"):
            read_structure(path, [species], None, True, 0.15, atom_types={"A": "O"})


def test_bodies_of_two_sites_alone(tmp_path):
    """N2 as two particles of one body: neither is a central particle."""
    import gsd.hoomd

    frame = gsd.hoomd.Frame()
    frame.configuration.box = [20, 20, 20, 0, 0, 0]
    frame.particles.N, frame.particles.types, frame.particles.body = 4, ["N"], [0, 0, 2, 2]
    at = np.array([[0, 0, 0.545], [0, 0, -0.545], [5, 5.545, 5], [5, 4.455, 5]])
    frame.particles.position = at
    frame.particles.velocity = [[1, 0, 0], [-1, 0, 0], [2, 0, 1], [2, 0, 1]]
    with gsd.hoomd.open(tmp_path / "a.gsd", "w") as file:
        file.append(frame)
    found = read_structure(tmp_path / "a.gsd", [load_model("nitrogen")], None, True, 0.15)
    assert found.position == pytest.approx(10 + np.array([[0, 0, 0], [5, 5, 5]]), abs=1e-5)
    assert found.velocity == pytest.approx(np.array([[0, 0, 0], [2, 0, 1]]), abs=1e-6)
    spin = np.linalg.norm(found.angular_momentum_body, axis=1)
    assert spin == pytest.approx([2 * 14.0067 * 0.545, 0.0], rel=1e-2, abs=1e-5)


@pytest.mark.parametrize("ending", EVERY_ENDING)
@pytest.mark.usefixtures("reads_here")
def test_sites_without_elements_are_read_from_all_trajectories(ending, tmp_path):
    """Two heavy sites of one mass, and massless charges."""
    system = build(small_scene({"co2_2cljq": 5}, 30.0))
    path = tmp_path / f"old{ending}"
    file = open_trajectory(path, system, 1.0, velocities=False, wrapped=False)
    file.write(system.state, 0.0, 0)
    file.close()
    write_topology(tmp_path / "topology.gro", system, system.state, wrapped=False)
    needs_names = ending in (".xtc", ".trr", ".dcd", ".nc")
    topology = tmp_path / "topology.gro" if needs_names else None
    found = read_structure(path, system.species, None, True, 0.15, topology=topology)
    assert np.abs(found.position - system.state.position).max() < 0.01
    assert read_frames(path, len(system.sites.mass), 10).positions[0] == pytest.approx(
        system.site_positions(system.state, False), abs=0.01
    )
    if ending == ".xyz":  # other programs read it with elements, X for none
        assert ase.io.read(path).get_chemical_symbols() == ["X"] * len(system.sites.mass)


def test_the_data_file_of_an_export_is_read_back_with_its_velocities(tmp_path):
    """Its name must not count as the name of units."""
    scene = small_scene({"tip4p2005": 8}, 20.0, name="unitsmetal")
    system = build(scene)
    export(scene, "lammps", tmp_path / "out", False)
    path = tmp_path / "out" / "data.lammps"
    found = read_structure(path, system.species, None, True, 0.15)
    step = (found.position - system.state.position) / 20
    assert step == pytest.approx(np.round(step), abs=1e-9)
    assert found.velocity == pytest.approx(system.state.velocity, abs=1e-9)
    there = np.linalg.norm(system.state.angular_momentum_body, axis=1)
    assert np.linalg.norm(found.angular_momentum_body, axis=1) == pytest.approx(there, rel=1e-9)


@pytest.mark.parametrize(
    ("name", "at", "others"),
    [
        ("topology.gro", 2e5, "set output.positions"),
        ("topology.pdb", 2e4, "use .gro, output.positions"),
        ("topology.pdb", 2e5, "set output.positions"),
    ],
)
def test_a_topology_that_cannot_hold_positions_names_its_own_key(name, at, others, tmp_path):
    system = build(small_scene({"argon": 2}, 20.0))
    state = system.state.copy()
    state.position[:] += at
    limit = {"gro": "99999.9", "pdb": "9999.99"}[name[-3:]]
    with pytest.raises(
        SimulationError,
        match=rf"beyond the {limit} Å that .{name[-3:]} .output.topology. can hold: {others}",
    ):
        write_topology(tmp_path / name, system, state, wrapped=False)
    write_topology(tmp_path / name, system, state, wrapped=True)


def test_a_trajectory_is_not_a_molecule(tmp_path):
    with pytest.raises(StructureError, match="is a trajectory"):
        read_geometry(make(tmp_path, ".gsd")[0])


def test_a_run_continues_from_a_trajectory(tmp_path):
    """With its velocities; both files are inputs, whose digests and copies are in the folder."""
    first = forty_waters(
        NVT,
        output=FORTY_WATERS["output"]
        | {"trajectory": "trajectory.trr", "topology": "topology.pdb"},
    )
    before = Simulation(Scene.from_dict(first), tmp_path / "old").run()
    again = forty_waters(
        {k: v for k, v in NVT.items() if k not in ("ensemble", "temperature_K")}, box={}
    ) | {
        "molecules": [{"model": "spce"}],
        "structure": {"file": "old/trajectory.trr", "velocities": True},
    }
    del again["start"]
    results = Simulation(Scene.from_dict(again, tmp_path), tmp_path / "new").run()
    assert set(results.summary["input_sha256"]) == {"structure.file", "structure.topology"}
    assert (tmp_path / "new" / "input_structure_trajectory.trr").is_file()
    kept = Scene.read(tmp_path / "new" / "scene.toml")
    assert Path(kept.structure.topology).name == "input_structure.topology_topology.pdb"
    assert np.abs(build(kept).state.velocity - before.state.velocity).max() < 1e-4
    repeated = Simulation(kept).run()
    assert repeated.state.position.tobytes() == results.state.position.tobytes()
    with pytest.raises(SceneError, match=r"structure\.topology"):
        Scene.from_dict(
            again
            | {
                "structure": {
                    "file": "old/trajectory.trr",
                    "topology": "none.gro",
                    "velocities": True,
                }
            },
            tmp_path,
        )


TOY = '''"""A made-up format: a line of JSON with the names of the atoms, and a line for each frame."""

import json
from functools import partial

import numpy as np

from PACKAGE.formats import Atoms, Format, Frame, register


def encoder(system, interval, velocities):
    def encode(frame, k):
        rows = [] if k else [system.sites.name.tolist()]
        rows.append([frame.time, frame.positions.tolist(), frame.cell.tolist(), frame.velocities.tolist(), frame.step])
        return "".join(f"{json.dumps(row)}\\n" for row in rows).encode()

    return encode


class Reader:
    def __init__(self, path):
        names, *self._rows = map(json.loads, path.read_text().splitlines())
        self.count, self.sites = len(self._rows), len(names)

    def frame(self, k):
        time, position, cell, velocity, step = self._rows[k]
        return Frame(time, np.array(position), np.array(cell), np.array(velocity), step=step)

    def close(self):
        pass


def read(path, lines):
    names, *frames = map(json.loads, lines)
    return [partial(atoms_of, names, *frame) for frame in frames]


def atoms_of(names, time, position, cell, velocity, step):
    return Atoms(names, [""] * len(names), [()] * len(names), np.array(position), np.array(velocity), np.array(cell))


register(Format((".toy",), read=read, encoder=encoder, reader=Reader, velocities=True, double=True))
'''


def test_adding_a_format_takes_one_file(tmp_path, monkeypatch):
    """A module in the folder of formats: then runs write it and resume, results read it, and runs
    start from it."""
    (tmp_path / "formats").mkdir()
    (tmp_path / "formats" / "toy.py").write_text(TOY.replace("PACKAGE", "rigidmd"))
    (tmp_path / "scene.toml").write_text(
        TEXT.replace('file = "old.xtc"', 'file = "start.toy"\nframe = 2\nvelocities = true')
    )
    output = {"trajectory": "x.toy", "trajectory_interval_ps": 0.002}
    monkeypatch.setattr(formats, "__path__", [*formats.__path__, str(tmp_path / "formats")])
    try:
        formats.find_modules()
        results = Simulation(
            small_scene({"tip4p2005": 4}, 20.0, output=output), tmp_path / "run"
        ).run()
        times = [frame.time for frame in results.universe().trajectory]
        assert times == pytest.approx(np.arange(len(times)) * 0.002)
        assert len(times) > 2
        last = results.universe().trajectory[-1]
        assert last.positions == pytest.approx(
            results.system.site_positions(results.state), abs=1e-5
        )
        assert results.atoms(1).positions.dtype == float
        shutil.copy(tmp_path / "run" / "x.toy", tmp_path / "start.toy")
        again = build(Scene.read(tmp_path / "scene.toml"))
        assert again.site_velocities(again.state) == pytest.approx(
            results.universe().trajectory[1].velocities, abs=1e-4
        )
    finally:
        formats.BY_EXTENSION.pop(".toy", None)
        sys.modules.pop("rigidmd.formats.toy", None)
    with pytest.raises(
        SceneError, match=r"must end in one of \.dcd \.gsd \.nc \.pdb \.traj \.trr \.xtc \.xyz"
    ):
        small_scene({"tip4p2005": 4}, 20.0, output=output)


@pytest.mark.parametrize("sites", [1, 9, 10])
def test_a_small_frame_of_an_xtc_has_the_bytes_of_gromacs_library(sites, tmp_path):
    """Up to nine sites without compression, by rigidmd itself; more by the library."""
    rng = np.random.default_rng(sites)
    positions, cell = 10 * rng.standard_normal((sites, 3)), 30 * np.eye(3)
    encode = BY_EXTENSION[".xtc"].encoder(None, 1.0, False)
    written = encode(Frame(2.5, positions, cell, None, step=-3), 0)
    with XTCFile(str(tmp_path / "t.xtc"), "w") as file:
        box = (0.1 * cell).astype(np.float32)
        file.write(np.float32(0.1) * positions.astype(np.float32), box, -3, 2.5, 1000.0)
    assert written == (tmp_path / "t.xtc").read_bytes()


@pytest.mark.parametrize("name", ["t.gro", "t.pdb"])
@pytest.mark.parametrize("box", [None, "oblique"])
def test_a_topology_is_read_by_other_programs(name, box, tmp_path):
    """Names, residues, positions, the box and, where the format has them, elements and bonds."""
    cell = {"lengths_A": [20.0, 21.0, 22.0], "angles_deg": [80.0, 95.0, 75.0]}
    system = build(small_scene({"tip4p2005": 4}, None, box=cell))
    state = system.state
    if not box:
        state = state._replace(cell=NO_CELL.copy())
    write_topology(tmp_path / name, system, state, wrapped=False)
    with ignore_warnings():  # of a box of zeros
        u = mda.Universe(str(tmp_path / name))
    assert u.atoms.names.tolist() == system.sites.name.tolist()
    assert u.atoms.resnames.tolist() == system.residue_names[system.sites.molecule].tolist()
    assert u.atoms.resids.tolist() == (1 + system.sites.molecule).tolist()
    assert np.abs(u.atoms.positions - system.site_positions(state)).max() < 6e-3
    if box:
        assert u.dimensions == pytest.approx([20.0, 21.0, 22.0, 80.0, 95.0, 75.0], abs=0.01)
    else:
        assert u.dimensions is None or not u.dimensions[:3].any()
    if name == "t.pdb":
        assert u.atoms.elements.tolist() == ["O", "H", "H", ""] * 4  # MDAnalysis knows no X
        pairs = {tuple(sorted(pair)) for pair in u.bonds.indices.tolist()}
        assert pairs == {(4 * m, 4 * m + h) for m in range(4) for h in (1, 2)}


@pytest.mark.parametrize("edge", [9999.5, 12000.0, 123456.0])
@pytest.mark.parametrize("angles", [90.0, 75.0])
@pytest.mark.parametrize("name", ["t.gro", "t.pdb"])
def test_a_wide_box_is_read_back(name, angles, edge, tmp_path):
    """Its numbers fill their columns; those of a triclinic .gro are negative too."""
    box = {
        "lengths_A": [edge, edge + 100.0, edge + 200.0],
        "angles_deg": [angles, 180 - angles, 90],
    }
    system = build(small_scene({"argon": 2}, None, box=box, forces={"cutoff_A": 8.0}))
    state = system.state
    state.position[:] = [[1.0, 2, 3], [4, 5, 6]]
    write_topology(tmp_path / name, system, state, wrapped=False)
    found = read_atoms(tmp_path / name)
    assert found.position == pytest.approx(state.position, abs=1e-3)
    assert edges_and_angles(found.cell) == pytest.approx(edges_and_angles(state.cell), rel=1e-5)
    assert mda.Universe(str(tmp_path / name)).dimensions[:3] == pytest.approx(
        edges_and_angles(state.cell)[:3], rel=1e-5
    )


@pytest.mark.usefixtures("reads_here")
def test_a_run_in_a_wide_box_continues_from_its_trajectory(tmp_path):
    """A dilute gas: the trajectory has no names, which are in topology.gro next to it."""
    changes = {"forces": {"cutoff_A": 9.0}, "output": {"trajectory_interval_ps": 0.004}}
    scene = small_scene({"argon": 2}, 12000.0, **changes)
    results = Simulation(scene, tmp_path / "run").run()
    found = read_structure(
        tmp_path / "run" / "trajectory.xtc",
        results.system.species,
        None,
        True,
        0.15,
        topology=tmp_path / "run" / "topology.gro",
    )
    assert found.cell == pytest.approx(12000.0 * np.eye(3))
    step = (found.position - results.state.position) / 12000.0
    assert step == pytest.approx(np.rint(step), abs=1e-5)


def test_numbers_beyond_the_columns_of_a_topology():
    sites = 100_001
    names, numbers = ["C1"] * sites, list(range(1, sites + 1))
    system = Topology(
        names, ["C"] * sites, numbers, ["LONGER"] * sites, np.zeros((sites, 3)), None, lambda: PAIRS
    )
    gro = BY_EXTENSION[".gro"].topology(system).splitlines()
    assert gro[1].split() == [str(sites)] and gro[-1].split() == ["0.00000"] * 3
    assert gro[100_001].startswith("    0LONGE   C1    0   0.000")
    pdb = BY_EXTENSION[".pdb"].topology(system).splitlines()
    assert pdb[100_000].startswith("ATOM      0  C1  LONGX   0       0.000")
    bonds = [line for line in pdb if line.startswith("CONECT")]
    assert bonds[:2] == ["CONECT    1    2    3    4    5", "CONECT    1    6"]
    assert not any(line[6:11] == "    0" for line in bonds)


#: Five bonds of the first atom, and one to an atom without a number.
PAIRS = np.array([(0, 1), (0, 2), (0, 3), (0, 4), (0, 5), (1, 99_999)])
