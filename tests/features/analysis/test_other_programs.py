"""Analyses of one run compared with GROMACS and MDAnalysis on the same frames."""

import shutil
import sys

import MDAnalysis
import numpy as np
import pytest
from MDAnalysis.analysis.msd import EinsteinMSD
from MDAnalysis.analysis.rdf import InterRDF
from support.common import ROOT, gmx

from rigidmd import Scene
from rigidmd.assemble.build import build
from rigidmd.features.analysis import registry
from rigidmd.features.analysis.built_in.rotation import total_dipole
from rigidmd.features.analysis.rigid_frames import frames_of_folder
from rigidmd.run.record import read_record
from rigidmd.units import DEBYE

sys.path.insert(0, str(ROOT / "tests" / "benchmarks"))
from peer_engines import gro, top

GROMACS = shutil.which("gmx")
needs_gromacs = pytest.mark.skipif(not GROMACS, reason="GROMACS is not installed")


def test_g_of_r_is_that_of_mdanalysis(water):
    u = MDAnalysis.Universe(str(water / "topology.gro"), str(water / "trajectory.trr"))
    history = frames_of_folder(read_record(water), 0.02)
    first = len(u.trajectory) - len(history)
    assert len(history) == 51
    for a, b, block in (("OW", "OW", (1, 1)), ("OW", "HW", (1, 2)), ("HW", "HW", (2, 2))):
        selected = (u.select_atoms(f"name {name}*") for name in (a, b))
        peer = InterRDF(*selected, nbins=90, range=(0, 9.0), exclusion_block=block).run(start=first)
        found = registry.selected(["rdf"])[0].function(history, a, b, 9.0, 0.1)[f"g {a}-{b}"]
        assert np.abs(found - peer.results.rdf).max() < 1e-3  # a pair at the edge of a bin
        seen = peer.results.count > 0
        pairs = np.abs(found[seen] / peer.results.rdf[seen] - 1) * peer.results.count[seen]
        assert (
            pairs.sum() < 1e-5 * peer.results.count.sum()
        )  # of which a file with single precision moves few


def test_displacements_are_those_of_mdanalysis(water):
    u = MDAnalysis.Universe(str(water / "topology.gro"), str(water / "trajectory.trr"))
    u.add_TopologyAttr(
        "masses", np.tile(build(Scene.read(ROOT / "systems" / "water.toml")).species[0].masses, 216)
    )
    history = frames_of_folder(read_record(water), 0.02)
    first = len(u.trajectory) - len(history)
    centres = np.array([u.atoms.center_of_mass(compound="residues") for _ in u.trajectory[first:]])
    assert np.abs(centres - history.positions).max() < 1e-5
    points = MDAnalysis.Universe.empty(216, trajectory=True)
    points.load_new(history.positions.astype(np.float32), order="fac")
    peer = EinsteinMSD(points, select="all", msd_type="xyz", fft=False).run().results.timeseries
    found = registry.selected(["msd"])[0].function(history)["MSD spce (A^2)"]
    assert found == pytest.approx(peer[: len(found)], abs=1e-8)


@pytest.fixture(scope="module")
def topology(water):
    """A GROMACS run input of the waters, written from our molecules."""
    system = read_record(water).system
    species = system.species[0]
    sites = {
        "position": system.site_positions(system.state).reshape(216, -1, 3),
        "template": species.positions_body,
        "edges": system.state.cell.diagonal(),
        "name": species.site_names,
        "mass": species.masses,
        "charge": species.charges,
        "sigma": np.where(species.epsilon > 0, species.sigma, 1.0),
        "epsilon": species.epsilon / 100,
    }
    folder = water.parent / "gromacs"
    folder.mkdir()
    (folder / "run.gro").write_text(gro(sites, np.zeros_like(sites["position"])))
    (folder / "run.top").write_text(top(sites))
    (folder / "run.mdp").write_text(
        "cutoff-scheme = verlet\nrvdw = 0.9\nrcoulomb = 0.9\ncoulombtype = PME\n"
    )
    gmx(folder, "grompp -f run.mdp -c run.gro -p run.top -o run.tpr -maxwarn 2")
    gmx(folder, "make_ndx -f run.tpr -o run.ndx", text="del 1-20\na OW\na HW1 HW2\nq\n")
    return folder


def xvg(path):
    return np.array(
        [line.split() for line in path.read_text().splitlines() if line[0] not in "#@&"], float
    ).T


@needs_gromacs
def test_g_of_r_is_that_of_gromacs(water, topology):
    history = frames_of_folder(read_record(water), 0.02)
    for a, b in (("OW", "OW"), ("OW", "HW")):
        other = {"OW": "OW", "HW": "HW1_HW2"}
        gmx(
            topology,
            f"rdf -f {water / 'trajectory.trr'} -s run.tpr -n run.ndx -o rdf.xvg "
            f"-ref {other[a]} -sel {other[b]} -bin 0.01 -rmax 0.9 -excl -b 0.0199 "
            "-xvg none",
        )
        r, g = xvg(topology / "rdf.xvg")
        half = registry.selected(["rdf"])[0].function(history, a, b, 9.0, 0.05)[f"g {a}-{b}"]
        shells = np.diff(
            (0.05 * np.arange(181)) ** 3
        )  # its bins have their middles where ours of half the width meet
        found = (half * shells)[1:-1].reshape(-1, 2).sum(axis=1) / shells[1:-1].reshape(-1, 2).sum(
            axis=1
        )
        assert r[1 : 1 + len(found)] == pytest.approx(0.01 * np.arange(1, 90))
        found *= 215 / 216  # it counts the molecule among those that could be there
        assert (
            np.abs(g[1 : 1 + len(found)] - found).max() < 0.0015
        )  # three decimals, and a pair at the edge of a bin
        assert np.abs(g[1 : 1 + len(found)] - found).mean() < 0.0004


@needs_gromacs
def test_displacements_are_those_of_gromacs(water, topology):
    history = frames_of_folder(read_record(water), 0.02)
    gmx(
        topology,
        f"trjconv -f {water / 'trajectory.trr'} -s run.tpr -b 0.0199 -t0 0 -timestep 1 -o slow.trr",
        text="System\n",
    )  # as it does not find times again that are not whole numbers
    gmx(
        topology,
        "msd -f slow.trr -s run.tpr -n run.ndx -o msd.xvg -mol mol.xvg "
        "-trestart 1 -xvg none -sel System",
    )
    value = xvg(topology / "msd.xvg")[1]
    found = registry.selected(["msd"])[0].function(history)["MSD spce (A^2)"]
    assert 100 * value[: len(found)] == pytest.approx(found, rel=1e-5)
    assert found[-1] > 0.01


@needs_gromacs
def test_the_total_dipole_is_that_of_gromacs(water, topology):
    history = frames_of_folder(read_record(water), 0.02)
    gmx(
        topology,
        f"dipoles -f {water / 'trajectory.trr'} -s run.tpr -n run.ndx -o Mtot.xvg "
        "-b 0.0199 -xvg none -temp 300",
        text="System\n",
    )
    _, x, y, z, _ = xvg(topology / "Mtot.xvg")
    own = total_dipole(history) / DEBYE
    assert np.abs(np.array([x, y, z]).T - own).max() < 2e-4
    assert np.abs(own).max() > 10.0
