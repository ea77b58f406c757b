"""Analyses of runs: the command, files, bad input, and other programs on the very same frames."""

import csv
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import MDAnalysis
import numpy as np
import pytest
from conftest import ROOT, small_scene
from MDAnalysis.analysis.msd import EinsteinMSD
from MDAnalysis.analysis.rdf import InterRDF

import rigidmd
from rigidmd import Scene, Simulation, cli
from rigidmd.analyse import registry
from rigidmd.analyse.electric import total_dipole
from rigidmd.analyse.source import of_folder
from rigidmd.assemble.system import build
from rigidmd.errors import OutputError, SceneError
from rigidmd.output.record import read_record
from rigidmd.units import DEBYE

sys.path.insert(0, str(ROOT / "tests" / "benchmarks"))
from peer_engines import gro, top

SHORT = {"stages.0.duration_ps": 0.02, "stages.1.duration_ps": 0.2, "output.trajectory_interval_ps": 0.004,
         "output.trajectory": "trajectory.trr", "output.log_interval_ps": 0.004, "output.figure": False,
         "output.pressure_tensor_interval_ps": 0.004}  # fmt: skip
GROMACS = shutil.which("gmx")
needs_gromacs = pytest.mark.skipif(not GROMACS, reason="GROMACS is not installed")


@pytest.fixture(scope="module")
def water(tmp_path_factory):
    """216 waters, 51 frames of 0.2 ps at constant energy."""
    folder = tmp_path_factory.mktemp("runs") / "water"
    Simulation(Scene.read(ROOT / "systems" / "water.toml", SHORT), folder).run()
    return folder


@pytest.fixture
def copy(water, tmp_path):
    """The run, to be spoilt."""
    return Path(shutil.copytree(water, tmp_path / "run"))


@pytest.fixture
def own():
    """Forgets analyses that a test defines."""
    before = dict(registry.KNOWN)
    yield
    registry.KNOWN.clear()
    registry.KNOWN.update(before)


def said(capsys, *arguments, code=2):
    """What the command says of it: one sentence, without a traceback."""
    assert cli.main(["analyse", *map(str, arguments)]) == code
    found = capsys.readouterr().err.strip()
    assert found.startswith("rigidmd: ") and "\n" not in found and "Traceback" not in found
    return found


def table(path):
    """The columns of a CSV file."""
    with path.open(encoding="utf-8", newline="") as file:
        head, *lines = list(csv.reader(file))
    return {title: np.array([float(line[k] or "nan") for line in lines]) for k, title in enumerate(head)}


def names(folder):
    return sorted(path.name for path in folder.iterdir())


# the command


def test_all_analyses_of_a_run_by_one_command(copy, capsys):
    before = names(copy)
    assert cli.main(["analyse", str(copy)]) == 0
    text = capsys.readouterr().out
    found = json.loads((copy / "analysis.json").read_text())["analyses"]
    assert set(found) == set(registry.ORDER)
    left_out = [name for name, entry in found.items() if not entry["curves"]]
    assert left_out == ["viscosity"]
    assert "viscosity: left out: a viscosity needs 20 ps of the pressure tensor at least; there are 0.2 ps" in text
    files = [name for entry in found.values() for name in entry["files"]]
    assert sorted([*before, "analysis.json", *files]) == names(copy)
    assert set(files) <= set((copy / ".rigidmd-run").read_text().split("\n"))  # which a new run removes
    for entry in found.values():
        for curve in entry["curves"]:
            columns = table(copy / f"{curve['file']}.csv")
            assert all(len(values) > 3 and np.isfinite(values).all() for values in columns.values()), curve
        for value in entry["values"]:
            assert value["value"] is not None or "too short" in value["note"], value
            assert value["value"] is None or value["error"] is not None, value
    assert list(table(copy / "rdf.csv"))[:4] == ["r (A)", "g O-O", "g O-O error", "n O-O"]
    bonds = found["hydrogen_bonds"]["values"][0]
    assert 1.0 < bonds["value"] < 4.5
    assert "D of spce: this run is" in text and "too short for a value" in text
    # once more, of one analysis: the same bits, and the others stay
    kept = {name: (copy / name).read_bytes() for name in [*files, "analysis.json"] if not name.endswith(".png")}
    assert cli.main(["analyse", str(copy), "--only", "rdf, orientation"]) == 0
    assert {name: (copy / name).read_bytes() for name in kept} == kept
    assert cli.main(["analyse", str(copy), "--only", "rdf", "--from", "100fs"]) == 0
    again = json.loads((copy / "analysis.json").read_text())["analyses"]
    assert again["rdf"]["stretch"]["from_ps"] == pytest.approx(0.1, abs=0.003)
    assert again["rdf"] != found["rdf"] and again["spectrum"] == found["spectrum"]
    capsys.readouterr()


def test_the_list_is_that_of_all(capsys):
    with pytest.raises(SystemExit) as ended:
        cli.main(["analyse", "--list"])
    assert ended.value.code == 0
    told = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    assert told == list(registry.ORDER)


def test_results_in_memory_and_from_the_folder_agree(water):
    results = Simulation(Scene.read(ROOT / "systems" / "water.toml", SHORT)).run()
    history = of_folder(read_record(water))
    for name, options, column in (
        ("rdf", {"first": "OW", "second": "HW", "width": 0.2}, "g OW-HW"),
        ("msd", {}, "MSD spce (A^2)"),
        ("orientation", {}, "C2 spce axis 2"),
        ("spectrum", {}, "omega spce axis 1"),
        ("density_profile", {"bins": 5}, "density spce (g/cm3)"),
        ("dielectric", {}, "Mz (D)"),
    ):
        here = getattr(results, name)(**options)[column]
        there = registry.chosen([name])[0].function(history, **options)[column]
        assert here == pytest.approx(there, rel=2e-3, abs=2e-3 * np.abs(there).max()), name
    seen = results._histories[None]
    assert np.array_equal(seen.tensor, history.tensor)
    assert len(seen.tensor) == 51 and seen.interval == pytest.approx(0.004)
    assert np.abs(seen.Q - history.Q).max() < 1e-5
    assert np.abs(seen.L - history.L).max() < 1e-3
    state = results.state
    last = np.abs(seen.positions[-1] - state.position).max(), np.abs(seen.Q[-1] - state.rotation).max()
    assert max(last) < 1e-10
    assert np.abs(seen.L[-1] - state.angular_momentum_body).max() < 1e-9
    tensor = np.array([results[f"pressure_{k}"] for k in ("xx", "yy", "zz", "xy", "xz", "yz")]).T
    assert np.array_equal(history.tensor[1:, 1:], tensor[-50:])


def test_a_viscosity_of_a_run_and_the_diffusion_that_it_corrects(copy):
    """With a tensor made longer by hand."""
    lines = (copy / "pressure_tensor.csv").read_text().splitlines()
    rng = np.random.default_rng(0)
    rows = [",".join(map(repr, [round(0.02 + 0.004 * k, 9), *rng.normal(0, 500, 6).tolist()])) for k in range(10)]
    (copy / "pressure_tensor.csv").write_text("\n".join([lines[0], *rows]) + "\n" + rows[0][:-30])
    history = of_folder(read_record(copy))
    assert history.tensor.shape == (10, 7)  # the line that is cut is left out
    (copy / "pressure_tensor.csv").write_text("\n".join([lines[0], *rows, "0,x,0,0,0,0,0"]))
    with pytest.raises(OutputError, match=r"pressure_tensor.csv holds what is no number"):
        of_folder(read_record(copy))
    (copy / "pressure_tensor.csv").write_text("a,b\n1,2\n")
    with pytest.raises(OutputError, match=r"is no pressure tensor of rigidmd: its columns must be"):
        of_folder(read_record(copy))
    (copy / "pressure_tensor.csv").write_text("")
    with pytest.raises(OutputError, match=r"is no pressure tensor of rigidmd"):
        of_folder(read_record(copy))


# other programs on the very same frames


def test_g_of_r_is_that_of_mdanalysis(water):
    u = MDAnalysis.Universe(str(water / "topology.gro"), str(water / "trajectory.trr"))
    history = of_folder(read_record(water), 0.02)
    first = len(u.trajectory) - len(history)
    assert len(history) == 51
    for a, b, block in (("OW", "OW", (1, 1)), ("OW", "HW", (1, 2)), ("HW", "HW", (2, 2))):
        selected = (u.select_atoms(f"name {name}*") for name in (a, b))
        peer = InterRDF(*selected, nbins=90, range=(0, 9.0), exclusion_block=block).run(start=first)
        found = registry.chosen(["rdf"])[0].function(history, a, b, 9.0, 0.1)[f"g {a}-{b}"]
        pairs = np.abs(found - peer.results.rdf) * peer.results.count.sum() / 90
        print(a, b, np.abs(found - peer.results.rdf).max(), pairs.max())
        assert np.abs(found - peer.results.rdf).max() < 0.005  # a pair at the edge of a bin


def test_displacements_are_those_of_mdanalysis(water):
    u = MDAnalysis.Universe(str(water / "topology.gro"), str(water / "trajectory.trr"))
    u.add_TopologyAttr("masses", np.tile(build(Scene.read(ROOT / "systems" / "water.toml")).species[0].masses, 216))
    history = of_folder(read_record(water), 0.02)
    first = len(u.trajectory) - len(history)
    centres = np.array([u.atoms.center_of_mass(compound="residues") for _ in u.trajectory[first:]])
    print("centres", np.abs(centres - history.positions).max())
    assert np.abs(centres - history.positions).max() < 1e-5
    points = MDAnalysis.Universe.empty(216, trajectory=True)
    points.load_new(history.positions.astype(np.float32), order="fac")
    peer = EinsteinMSD(points, select="all", msd_type="xyz", fft=False).run().results.timeseries
    found = registry.chosen(["msd"])[0].function(history)["MSD spce (A^2)"]
    print("msd", np.abs(found - peer[: len(found)]).max(), found.max())
    assert found == pytest.approx(peer[: len(found)], abs=1e-6)


@pytest.fixture(scope="module")
def topology(water):
    """A GROMACS run input of the waters, written from our own molecules."""
    system = read_record(water).molecules
    species = system.species[0]
    sites = {
        "position": system.site_positions(system.state).reshape(216, -1, 3), "template": species.positions_body,
        "edge": system.state.cell[0, 0], "name": species.site_names, "mass": species.masses, "charge": species.charges,
        "sigma": np.where(species.epsilon > 0, species.sigma, 1.0), "epsilon": species.epsilon / 100,
    }  # fmt: skip
    folder = water.parent / "gromacs"
    folder.mkdir()
    (folder / "run.gro").write_text(gro(sites, np.zeros_like(sites["position"])))
    (folder / "run.top").write_text(top(sites))
    (folder / "run.mdp").write_text("cutoff-scheme = verlet\nrvdw = 0.9\nrcoulomb = 0.9\ncoulombtype = PME\n")
    gmx(folder, "grompp", "-f", "run.mdp", "-c", "run.gro", "-p", "run.top", "-o", "run.tpr", "-maxwarn", "2")
    gmx(folder, "make_ndx", "-f", "run.tpr", "-o", "run.ndx", text="del 1-20\na OW\na HW1 HW2\nq\n")
    return folder


def gmx(folder, *arguments, text=""):
    done = subprocess.run(
        [GROMACS, "-quiet", "-nobackup", *arguments], cwd=folder, input=text, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stdout[-1500:] + done.stderr[-1500:]
    return done.stdout


def xvg(path):
    return np.array([line.split() for line in path.read_text().splitlines() if line[0] not in "#@&"], float).T


@needs_gromacs
def test_g_of_r_is_that_of_gromacs(water, topology):
    history = of_folder(read_record(water), 0.02)
    for a, b in (("OW", "OW"), ("OW", "HW")):
        other = {"OW": "OW", "HW": "HW1_HW2"}
        gmx(topology, "rdf", "-f", str(water / "trajectory.trr"), "-s", "run.tpr", "-n", "run.ndx", "-o", "rdf.xvg",
            "-ref", other[a], "-sel", other[b], "-bin", "0.01", "-rmax", "0.9", "-excl", "-b", "0.0199", "-xvg", "none")  # fmt: skip
        r, g = xvg(topology / "rdf.xvg")
        found = registry.chosen(["rdf"])[0].function(history, a, b, 9.0, 0.1)[f"g {a}-{b}"]
        print(a, b, len(r), r[:3], np.abs(g[: len(found)] - found).max())


@needs_gromacs
def test_displacements_are_those_of_gromacs(water, topology):
    history = of_folder(read_record(water), 0.02)
    gmx(topology, "msd", "-f", str(water / "trajectory.trr"), "-s", "run.tpr", "-n", "run.ndx", "-o", "msd.xvg",
        "-mol", "mol.xvg", "-trestart", "0.004", "-b", "0.0199", "-xvg", "none", "-sel", "System")  # fmt: skip
    time, value = xvg(topology / "msd.xvg")[:2]
    found = registry.chosen(["msd"])[0].function(history)["MSD spce (A^2)"]
    print("msd", time[:4], np.abs(100 * value[: len(found)] - found).max(), found.max())


@needs_gromacs
def test_the_total_dipole_is_that_of_gromacs(water, topology):
    history = of_folder(read_record(water), 0.02)
    gmx(topology, "dipoles", "-f", str(water / "trajectory.trr"), "-s", "run.tpr", "-n", "run.ndx", "-o", "Mtot.xvg",
        "-b", "0.0199", "-xvg", "none", "-temp", "300", text="System\n")  # fmt: skip
    _, x, y, z, _ = xvg(topology / "Mtot.xvg")
    own = total_dipole(history) / DEBYE
    print("dipole", np.abs(np.array([x, y, z]).T - own).max(), np.abs(own).max())
