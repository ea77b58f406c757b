"""Forces: against the slow oracle, against finite differences, and against Newton."""

import json

import numpy as np
import pytest
from support.changed_package import edited, run_with_files
from support.common import built, move, observe, small_scene
from support.reference import Oracle

from rigidmd.assemble.build import build
from rigidmd.compile import Program, kernel
from rigidmd.compile.simd import lane_count
from rigidmd.core.integrators import SCHEMES
from rigidmd.core.state import no_load
from rigidmd.engines.cpu.engine import CpuEngine as Engine
from rigidmd.engines.protocol import NotFiniteError
from rigidmd.errors import SimulationError
from rigidmd.forces.neighbors.clusters import BUILT, LEAD_TIME, clusters_of
from rigidmd.forces.neighbors.lists import (
    BUILDS,
    ENTRIES,
    MAX_NEIGHBORS,
    NEIGHBORS,
    NEIGHBORS_OF_ONE,
    USABLE,
    WINDOW,
)
from rigidmd.forces.neighbors.sites import predict_site
from rigidmd.forces.neighbors.space import cell_of
from rigidmd.forces.neighbors.tree import ahead
from rigidmd.forces.potentials.coulomb import radial, reaction_field
from rigidmd.forces.potentials.lennard_jones import energy_and_force, lennard_jones
from rigidmd.forces.potentials.truncation import (
    SWITCH_FUNCTIONS,
    TRUNCATIONS,
    SwitchCorrection,
    SwitchTerm,
    Unmodified,
)
from rigidmd.forces.terms import WITH_ENERGIES, TermDispatcher
from rigidmd.mechanics.rotation import from_vector
from rigidmd.units import BAR, BOLTZMANN

ENDINGS = ["plain", "shift", "force_shift", "force_switch", "switch", "smooth_switch"]
MIXTURES = [
    ({"spce": 12}, 13.0),
    ({"tip4p2005": 8, "nitrogen": 5, "argon": 4}, 14.0),
    ({"argon": 20}, 12.5),
    ({"spce": 5, "nitrogen": 6}, None),
]


def ended(name):
    """Forces that end at 6 Å in this way, from 4.5 Å on where it has a start."""
    start = {"switch_start_A": 4.5} if name in ("force_switch", "switch") else {}
    return {"cutoff_A": 6.0, "truncation": name} | start


def energies(engine, state):
    return {name: tally.energy for name, tally in engine.evaluate(state)[1].items()}


@pytest.mark.parametrize(
    ("ending", "counts", "edge"),
    [
        pytest.param(
            ending,
            *which,
            id=f"{ending}-{k}",
            marks=[]
            if (k == 1 and ending != "force_shift") or ending == "switch"
            else pytest.mark.soak,
        )
        for ending in ENDINGS
        for k, which in enumerate(MIXTURES)
    ],
)
def test_energies_are_those_of_the_oracle(counts, edge, ending):
    forces = ended(ending) | {"reaction_field_permittivity": 78.5}
    for seed, mixing in enumerate(["lorentz-berthelot", "geometric"]):
        system, engine, state = built(counts, edge, seed, forces=forces | {"mixing": mixing})
        lj, coulomb = Oracle(system).energy(state.position, state.rotation)
        found = energies(engine, state)
        assert found["lennard_jones"] == pytest.approx(lj, rel=1e-11)
        assert found.get("coulomb", 0.0) == pytest.approx(coulomb, rel=1e-10)


def test_energies_without_box_and_cut_off():
    system, engine, state = built({"tip4p2005": 3, "argon": 2}, None)
    lj, coulomb = Oracle(system).energy(state.position, state.rotation)
    assert energies(engine, state) == pytest.approx(
        {"lennard_jones": lj, "coulomb": coulomb}, rel=1e-11
    )
    assert not system.constants


def test_a_box_with_unequal_edges_and_many_cells():
    # 30 Å against a cutoff of 4: cells whose neighbourhood does not meet itself; far outside the
    # box as well
    scene = small_scene(
        {"nitrogen": 60, "argon": 40},
        None,
        box={"lengths_A": [30.0, 10.0, 17.0]},
        forces={"cutoff_A": 4.0},
    )
    system = build(scene)
    engine, state = system.engine(), system.state.copy()
    rng = np.random.default_rng(5)
    state.position[:] += rng.normal(size=state.position.shape)
    expected = Oracle(system).energy(state.position, state.rotation)[0]
    assert energies(engine, state)["lennard_jones"] == pytest.approx(expected, rel=1e-11)
    state.position[:] += rng.integers(-3, 4, state.position.shape) * np.array(system.space)
    assert energies(engine, state)["lennard_jones"] == pytest.approx(expected, rel=1e-9)


BEYOND_HALF = [
    80.0,
    np.degrees(np.arccos(0.50008 * 20 / 24)),
    np.degrees(np.arccos(0.50008 * 20 / 17)),
]  # as printed
SLANTED = [
    [60.0, 60.0, 60.0],
    [70.0, 100.0, 50.0],
    [120.0, 110.0, 95.0],
    [35.0, 60.0, 80.0],
    BEYOND_HALF,
]


@pytest.mark.parametrize("skin", [0.3, 3.0])
@pytest.mark.parametrize("angles", SLANTED)
def test_slanted_boxes(angles, skin):
    """Energies are the oracle's, forces the slope of its energy, and molecules may be whole cells
    away."""
    box = {"lengths_A": [20.0, 17.0, 24.0], "angles_deg": angles}
    forces = ended("force_switch") | {"cutoff_A": 5.2, "skin_A": skin}
    system = build(small_scene({"spce": 20, "nitrogen": 15}, None, box=box, forces=forces))
    engine, state, oracle = system.engine(), system.state.copy(), Oracle(system)
    assert (cell_of(system.space)[1, 0] > 10.0) == (angles is BEYOND_HALF)
    rng = np.random.default_rng(3)
    state.position[:] += rng.normal(size=state.position.shape)
    state.position[:] += rng.integers(-3, 4, state.position.shape) @ cell_of(system.space)
    lj, coulomb = oracle.energy(state.position, state.rotation)
    assert energies(engine, state) == pytest.approx(
        {"lennard_jones": lj, "coulomb": coulomb}, rel=1e-10
    )
    load, h = engine.evaluate(state)[0], 1e-4
    for m, k in ((0, 0), (7, 1), (30, 2)):
        up, down = state.position.copy(), state.position.copy()
        up[m, k] += h
        down[m, k] -= h
        slope = (
            sum(oracle.energy(up, state.rotation)) - sum(oracle.energy(down, state.rotation))
        ) / (2 * h)
        assert load.force[m, k] == pytest.approx(
            -slope, rel=1e-5, abs=1e-7 * np.abs(load.force).max()
        )


@pytest.mark.parametrize("angles", [[90.0, 90.0, 90.0], [70.0, 100.0, 50.0]])
def test_molecules_millions_of_cells_away(angles):
    """The energy to the digits that positions there have; and where boxes can no longer be counted,
    a clear refusal."""
    box = {"lengths_A": [20.0, 17.0, 24.0], "angles_deg": angles}
    system = build(small_scene({"spce": 20}, None, box=box, forces=ended("force_switch")))
    engine, state = system.engine(), system.state.copy()
    expected = sum(energies(engine, state).values())
    away = np.random.default_rng(7).integers(-1, 2, state.position.shape) @ cell_of(system.space)
    for cells, digits in ((1e3, 1e-9), (1e6, 1e-6), (1e8, 1e-4)):
        moved = state.copy()
        moved.position[:] += cells * away
        assert sum(energies(engine, moved).values()) == pytest.approx(expected, rel=digits)
    moved.position[3, 1] = -1e12
    with pytest.raises(
        SimulationError, match=r"molecule 4 is lost: it is 1e\+12 Å from the origin"
    ):
        engine.evaluate(moved)


def test_a_cell_and_the_same_lattice_by_another_have_the_same_energy():
    """A cell that tilts by more than half an edge is reduced."""
    counts, forces = {"spce": 20}, {"cutoff_A": 6.0, "truncation": "shift"}
    leaning = {
        "lengths_A": [13.0, (13.0**2 + 13.0**2) ** 0.5, 13.0],
        "angles_deg": [90.0, 90.0, 45.0],
    }
    cube = build(small_scene(counts, 13.0, forces=forces))
    other = build(small_scene(counts, None, box=leaning, forces=forces))
    assert cell_of(other.space) == pytest.approx(13.0 * np.eye(3))
    found = [energies(s.engine(), cube.state) for s in (cube, other)]
    assert found[1] == pytest.approx(found[0], rel=1e-9)


@pytest.mark.parametrize("ending", ENDINGS)
def test_forces_and_torques_are_the_slope_of_the_energy(ending):
    forces = ended(ending)
    _, engine, state = built({"tip4p2005": 6, "nitrogen": 4, "argon": 3}, 13.0, 1, forces=forces)
    load, _ = engine.evaluate(state)

    def energy(moved):
        return sum(energies(engine, moved).values())

    def slope(move, h):
        up, down = state.copy(), state.copy()
        move(up, h)
        move(down, -h)
        return -(energy(up) - energy(down)) / (2 * h)

    def extrapolated(move, h=2e-4):  # Richardson: the error of the difference falls as h^4
        return (4 * slope(move, h / 2) - slope(move, h)) / 3

    scale = np.abs(load.force).max()
    for m in range(len(state.position)):
        for k in range(3):

            def shift(moved, h, m=m, k=k):
                moved.position[m, k] += h

            def turn(moved, h, m=m, k=k):
                moved.rotation[m] = moved.rotation[m] @ from_vector(h * np.eye(3)[k])

            # `plain` jumps where a pair crosses the cutoff; these starts have none within h of it
            assert load.force[m, k] == pytest.approx(extrapolated(shift), abs=1e-6 * scale)
            assert load.torque_body[m, k] == pytest.approx(extrapolated(turn), abs=1e-6 * scale)


@pytest.mark.parametrize("angles", [None, [70.0, 100.0, 80.0]])
def test_virial_is_the_slope_of_the_energy_with_the_box(angles):
    forces = {"cutoff_A": 6.0, "truncation": "force_switch", "switch_start_A": 4.0}
    box = {"lengths_A": 14.0, "angles_deg": angles} if angles else {"lengths_A": 13.0}
    system = build(small_scene({"spce": 14}, None, box=box, forces=forces))
    engine, state = system.engine(), system.state
    virial = sum(tally.virial for tally in engine.evaluate(state)[1].values())

    def energy(stretch):
        moved = state.copy()
        moved.cell[:] *= stretch
        moved.position[:] *= stretch  # centres of mass only: the molecular virial
        return sum(energies(engine, moved).values())

    h = 1e-5
    assert virial.trace() == pytest.approx(-(energy(1 + h) - energy(1 - h)) / (2 * h), rel=1e-6)


SLANTED = {"lengths_A": [21.0, 22.0, 23.0], "angles_deg": [70.0, 100.0, 80.0]}


@pytest.mark.parametrize(
    ("box", "precision", "digits"),
    [
        pytest.param({"lengths_A": 21.0, "periodic": False}, "double", 1e-9, id="none-double"),
        pytest.param({"lengths_A": 21.0}, "double", 1e-9, id="cubic-double"),
        pytest.param({"lengths_A": 21.0}, "mixed", 2e-6, id="cubic-mixed", marks=pytest.mark.soak),
        pytest.param(SLANTED, "double", 1e-9, id="triclinic-double"),
        pytest.param(SLANTED, "mixed", 2e-6, id="triclinic-mixed", marks=pytest.mark.soak),
    ],
)
def test_virials_are_sums_over_pairs(box, precision, digits):
    """For a list that has served for some steps, of sites far from the origin; by all pairs of
    images."""
    forces = {"cutoff_A": 6.0, "truncation": "shift"}
    system, engine, state = built(
        {"nitrogen": 300}, None, 3, 0.1, box=box, forces=forces, precision=precision
    )
    state.position[:] += [3e5, -2e5, 1e5]
    move(engine, state, SCHEMES["velocity_verlet"], 0.0002, 20)
    virial = engine.evaluate(state)[1]["lennard_jones"].virial
    pairs = engine.workspaces["lennard_jones"].pairs
    assert pairs.counters[BUILDS] == 1 and pairs.clusters.largest_displacement.max() > 0.02
    site, owner = system.site_positions(state), system.sites.molecule
    centre = state.position[owner]
    well, size = system.species[0].epsilon[0], system.species[0].sigma[0]
    periodic = box.get("periodic", True)
    images = np.array(list(np.ndindex(3, 3, 3))) - 1 if periodic else np.zeros((1, 3))
    expected = np.zeros((3, 3))
    for i in range(len(site)):
        origin_vector = site[i] - site[owner != owner[i]]
        centres = centre[i] - centre[owner != owner[i]]
        if periodic:
            edges = np.round(origin_vector @ np.linalg.inv(state.cell))
            origin_vector, centres = (
                origin_vector - edges @ state.cell,
                centres - edges @ state.cell,
            )
        for image in images:
            shift = image @ state.cell if periodic else 0.0
            d, between = origin_vector + shift, centres + shift
            r = np.sqrt((d**2).sum(axis=1))
            near = r < 6.0
            force = _force(well, size, r[near])
            expected += 0.5 * (d[near] * (force / r[near])[:, None]).T @ between[near]
    assert virial == pytest.approx(expected, abs=digits * np.abs(expected).max())


def _force(well, size, r):
    return 24 * well / r * (2 * (size / r) ** 12 - (size / r) ** 6)


def test_newton_and_no_net_torque_in_free_space():
    _, engine, state = built({"spce": 10, "nitrogen": 5, "argon": 5}, None, 3)
    load, _ = engine.evaluate(state)
    scale = np.abs(load.force).sum()
    assert np.abs(load.force.sum(axis=0)).max() < 1e-14 * scale
    torque = np.einsum("nij,nj->ni", state.rotation, load.torque_body).sum(axis=0)
    torque += np.cross(state.position, load.force).sum(axis=0)
    assert np.abs(torque).max() < 1e-14 * scale * np.abs(state.position).max()


@pytest.mark.parametrize("precision", ["double", "mixed"])
def test_a_list_with_little_room_grows_and_misses_nothing(precision):
    _, engine, state = built({"spce": 40}, 18.0, 4, forces={"cutoff_A": 8.0}, precision=precision)
    expected = energies(engine, state)
    cramped = []
    for own in engine.workspaces.values():
        blocks = len(own.pairs.entries)
        pairs = own.pairs._replace(
            entries=np.empty((blocks, 3), np.uint16),
            masked=np.empty((blocks, 1, 2), np.int32),
            neighbors=np.empty((blocks, 2), np.int32),
            origin_vector=np.empty(
                (blocks, 6 if precision == "mixed" else 0), own.pairs.origin_vector.dtype
            ),
        )
        pairs.counters[USABLE] = 0
        cramped.append(
            own._replace(
                pairs=pairs,
                sums=own.sums._replace(forces_behind=own.sums.forces_behind[:, :8].copy()),
            )
        )
    engine._workspaces = tuple(cramped)
    assert energies(engine, state) == expected


def test_sums_that_only_a_passing_moment_needs_are_in_common():
    _, engine, state = built(
        {"spce": 200}, 18.5, 4, forces={"cutoff_A": 8.0}
    )  # this many that there are blocks
    engine.evaluate(state)
    one, two = engine.workspaces.values()
    assert one.sums.forces_behind.size != two.sums.forces_behind.size
    assert np.shares_memory(one.sums.forces_behind, two.sums.forces_behind)
    assert not np.shares_memory(one.sums.forces, two.sums.forces)


@pytest.mark.parametrize("edge", [31.1, None])
def test_lists_begin_with_about_the_room_they_need(edge):
    _, engine, state = built({"spce": 1000 if edge else 300}, edge, 5)
    begun = [own.pairs for own in engine.new_workspaces(state)]
    others = [own.sums.forces_behind.shape[1] for own in engine.new_workspaces(state)]
    engine.evaluate(state)
    for pairs, other, own in zip(begun, others, engine.workspaces.values(), strict=True):
        lanes = 4 * len(own.pairs.clusters.order) // len(own.pairs.clusters.origin)
        needed = own.pairs.needed.max(axis=0)
        for kind, array in ((ENTRIES, pairs.entries), (NEIGHBORS, pairs.neighbors)):
            assert needed[kind] <= 1.1 * array.shape[1] and array.shape[1] < 1.6 * needed[kind] + 16
        if edge:
            window = 3 * lanes * needed[WINDOW]
            assert window <= 1.2 * other and other < 1.6 * window + 16


def test_a_cutoff_within_which_are_too_many_sites_is_refused():
    """Entries have 16 bits. A list as long would take minutes to build."""
    _, engine, state = built({"argon": 10}, 18.0, 4, forces={"cutoff_A": 8.0})
    engine.evaluate(state)
    (own,) = engine.workspaces.values()
    own.pairs.needed[0, NEIGHBORS_OF_ONE] = MAX_NEIGHBORS + 1
    with pytest.raises(
        SimulationError, match="sites are within the cutoff of 8 Å: take a shorter one"
    ):
        own.with_capacity(state.cell)


@kernel(from_python=True)
def _ahead(c, clusters, first, arity):
    return ahead(c, clusters, first, arity)


@pytest.mark.parametrize("clusters", [1, 2, 3, 7, 8, 9, 16, 21])
def test_of_two_clusters_one_is_ahead_of_the_other(clusters):
    """Each pair is then listed once."""
    found = []
    for c in range(clusters):
        for first in range(0, clusters, 4):
            bits = _ahead(c, clusters, first, 4)
            found += [(c, first + k) for k in range(4) if bits >> k & 1 and first + k < clusters]
    once = {tuple(sorted(pair)) for pair in found}
    assert len(found) == len(once) == clusters * (clusters + 1) // 2
    assert all((b - a) % clusters <= clusters // 2 for a, b in found)


def test_blocks_of_lists_grow_in_number_with_the_edge_of_the_box():
    for sites, blocks in ((100, 1), (900, 16), (12_288, 16), (1_000_000, 20), (2_000_000, 25)):
        bounds = clusters_of(sites, np.float64).bounds
        assert len(bounds) == blocks + 1
        assert (
            bounds[0] == 0
            and bounds[-1] * lane_count(np.float64) >= sites
            and (np.diff(bounds) > 0).all()
        )


CHANGED = {
    "squeezed": np.diag([0.99] * 3),
    "sheared": np.array([[1, 0, 0], [0.01, 1, 0], [-0.02, 0.01, 1]]),
}


@pytest.mark.parametrize("change", CHANGED)
@pytest.mark.parametrize("electrostatics", ["reaction_field", "ewald", "pme"])
def test_everything_follows_a_cell_that_changes(electrostatics, change):
    """Between two calls of `advance` the cell changes by a percent: all is as with an engine made
    for the new one."""
    forces = {
        "cutoff_A": 6.0,
        "electrostatics": electrostatics,
        "tail_correction": True,
        "skin_A": 4.0,
    }
    system, engine, state = built({"spce": 60}, 14.0, 7, spread=0.1, forces=forces)
    move(engine, state, SCHEMES["velocity_verlet"], 0.0005, 5)
    state.position[:] = state.position @ CHANGED[change]
    state.cell[:] = state.cell @ CHANGED[change]
    engine.forget()
    kept, fresh = observe(system, engine, state), observe(system, system.engine(), state)
    assert kept.load.force == pytest.approx(
        fresh.load.force, abs=1e-11 * np.abs(fresh.load.force).max()
    )
    assert kept.virial == pytest.approx(fresh.virial, abs=1e-11 * np.abs(fresh.virial).max())
    assert kept.components == pytest.approx(fresh.components, rel=1e-11)
    assert kept.pressure_bar == pytest.approx(fresh.pressure_bar, rel=1e-9)
    other = state.copy()
    move(engine, state, SCHEMES["velocity_verlet"], 0.0005, 5)
    move(system.engine(), other, SCHEMES["velocity_verlet"], 0.0005, 5)
    assert state.position == pytest.approx(other.position, abs=1e-9)


@pytest.mark.parametrize("at", [(0, 0), (2, 2), (1, 0), (2, 1)])
@pytest.mark.parametrize("counts", [{"argon": 60}, {"spce": 60}])
def test_a_box_that_is_no_number_is_told(counts, at):
    _, engine, state = built(counts, 20.0, 3, spread=0.05)
    engine.evaluate(state)
    state.cell[at] = np.nan
    for _ in range(2):
        with pytest.raises(NotFiniteError):
            engine.evaluate(state)


@pytest.mark.parametrize("precision", ["double", pytest.param("mixed", marks=pytest.mark.soak)])
@pytest.mark.parametrize("angles", [[90, 90, 90], [70, 100, 115]])
def test_a_list_serves_while_the_box_changes_little(angles, precision):
    """Pairs across the edges, which move with the images, are those of a new list; of a larger
    change too, again."""
    box = {"lengths_A": [20.0, 21.0, 22.0], "angles_deg": angles}
    counts = {"spce": 150, "nitrogen": 20}
    forces = {"cutoff_A": 7.0}  # of a switched energy: a pair at the cutoff has no force
    system, engine, state = built(
        counts, 20.0, 3, spread=0.1, box=box, forces=forces, precision=precision
    )
    rng = np.random.default_rng(1)
    engine.evaluate(state)
    lists = [own.pairs for own in engine.workspaces.values()]
    assert [own.counters[BUILDS] for own in lists] == [1, 1]
    start, digits = state.copy(), {"double": 1e-10, "mixed": 3e-5}[precision]
    for size in (1e-3, 2e-3, 3e-3, -3e-3, 1e-3, 0.04):
        strain = np.eye(3) + size * np.tril(rng.choice([-1, 1], (3, 3)))
        state.cell[:] = start.cell @ strain
        state.position[:] = start.position @ strain
        load, tallies = engine.evaluate(state)
        expected, theirs = system.engine().evaluate(state)
        scale = np.sqrt(np.mean(expected.force**2))
        assert np.abs(load.force - expected.force).max() < digits * scale * 10
        for name, tally in theirs.items():
            assert tallies[name].virial == pytest.approx(
                tally.virial, abs=digits * np.abs(tally.virial).max()
            )
        assert ([own.counters[BUILDS] for own in lists] == [1, 1]) == (abs(size) < 0.01)
        assert max(own.slack[0] for own in lists) > 0 or abs(size) > 0.01
    for own in lists:
        assert np.array_equal(own.built, state.cell)


def test_a_cell_that_becomes_too_small_for_the_cut_off_stops_in_words():
    _, engine, state = built(
        {"argon": 100}, 14.0, 3, spread=0.1, forces={"cutoff_A": 6.9, "skin_A": 6.0}
    )
    engine.evaluate(state)
    state.cell[:] *= 0.99
    state.position[:] *= 0.99
    engine.evaluate(state)  # a thinner skin serves
    state.cell[:] *= 0.99
    state.position[:] *= 0.99
    with pytest.raises(
        SimulationError, match=r"the box has become too small for the cutoff of 6.9 Å: half its"
    ):
        engine.evaluate(state)


@pytest.mark.parametrize("field", ["position", "velocity", "rotation", "step"])
def test_code_is_not_run_on_arrays_that_it_was_not_compiled_for(field):
    """Five argon atoms without forces and with `position` in Fortran's order once went astray
    without a word."""
    system, _, state = built({"argon": 5} if field != "rotation" else {"spce": 5}, 40.0)
    array = getattr(state, field)
    strange = np.asfortranarray(array) if array.ndim > 1 else array.astype(np.int32)
    engine = Engine(system.model, {})
    with pytest.raises(TypeError, match=f"state.{field} must be a contiguous, writable array of"):
        move(engine, state._replace(**{field: strange}), SCHEMES["velocity_verlet"], 0.01, 10)


def test_an_address_is_held_to_the_type_it_was_compiled_for():
    _, engine, state = built({"argon": 5}, 40.0)
    engine.evaluate(state)
    own = engine.workspaces["lennard_jones"]
    sites = own.sites._replace(first=own.sites.first.astype(np.int64))
    loading = TermDispatcher((own,), WITH_ENERGIES)
    with pytest.raises(TypeError, match="update_pair_list was compiled for task_arguments"):
        loading.bind((own._replace(sites=sites),), state, no_load(state))


WAVY = {
    "name": "wavy",
    "energy": "A*exp(-B*r) - C/r**6 + 0.1*sin(r)*log(r)",
    "truncation": "force_switch",
    "parameters": {"Ar": {"A": 4e5, "B": 3.7, "C": 5e3}, "Kr": {"A": 6e5, "B": 3.6, "C": 6e3}},
}
ALIKE = {
    "one kind": ({"argon": 60}, 20.0, {"truncation": "smooth_switch"}),
    "no box": ({"spce": 20, "argon": 6}, None, {}),
    "charges": ({"spce": 30, "nitrogen": 15}, 16.0, {"truncation": "switch"}),
    "damped": ({"spce": 30}, 16.0, {"electrostatics": "damped_shifted_force"}),
    "a text": ({"argon": 30, "krypton": 30}, 20.0, {"lennard_jones": False, "custom": [WAVY]}),
    "defaults": ({"spce": 30}, 16.0, {"truncation": "shift", "electrostatics": "pme"}),
}


#: The others have types of kernels that no other test has.
SHARED = [
    ("no box", "double"),
    ("defaults", "mixed"),
    ("charges", "double"),
    ("damped", "double"),
    ("a text", "double"),
]


@pytest.mark.parametrize(
    ("name", "precision"),
    [
        pytest.param(name, precision, marks=[] if (name, precision) in SHARED else pytest.mark.soak)
        for name in ALIKE
        for precision in ("mixed", "double")
    ],
)
def test_forces_have_the_same_bits_with_their_energies_and_without(name, precision):
    """A run must not depend on who observations at it, and observations take the energies of its own steps."""
    counts, edge, forces = ALIKE[name]
    forces = forces | ({"cutoff_A": 7.0} if edge else {})
    _, engine, state = built(counts, edge, 3, spread=0.05, forces=forces, precision=precision)
    for _ in range(3):
        move(engine, state, SCHEMES["velocity_verlet"], 1e-3, 4)
        load, _ = engine.evaluate(state)
        assert np.array_equal(load.force, engine.load.force)
        assert np.array_equal(load.torque_body, engine.load.torque_body)


def test_states_of_one_size_are_evaluated_without_binding_arrays_again(monkeypatch):
    system, engine, state = built({"spce": 8, "argon": 4}, 18.5, 1)
    other = state.copy()
    other.position[:] += 0.3 * np.random.default_rng(2).standard_normal(other.position.shape)
    before = state.copy()
    expected = [system.engine().evaluate(each)[0] for each in (state, other)]
    engine.evaluate(state)
    monkeypatch.setattr(Program, "bind", None)
    for each, exact in ((other, expected[1]), (state.copy(), expected[0])):
        load, _ = engine.evaluate(each)
        scale = np.abs(exact.force).max()
        assert load.force == pytest.approx(exact.force, abs=1e-12 * scale)
        assert load.torque_body == pytest.approx(exact.torque_body, abs=1e-12 * scale)
    assert all(np.array_equal(one, kept) for one, kept in zip(state, before, strict=True))


def test_the_list_is_rebuilt_for_moves_and_for_turns():
    system, engine, state = built({"spce": 30}, 16.0, 6, forces={"cutoff_A": 7.0, "skin_A": 0.8})
    oracle = Oracle(system)
    rng = np.random.default_rng(0)
    for step in range(12):
        if step % 2:
            state.rotation[:] = state.rotation @ from_vector(0.25 * rng.standard_normal((30, 3)))
        else:
            state.position[:] += 0.2 * rng.standard_normal(state.position.shape)
        expected = sum(oracle.energy(state.position, state.rotation))
        assert sum(energies(engine, state).values()) == pytest.approx(expected, rel=1e-10)
    builds = [own.pairs.counters[BUILDS] for own in engine.workspaces.values()]
    assert min(builds) > 3


def test_a_list_lasts_until_sites_have_moved_by_half_its_skin():
    """Two groups of four that come into each other's range from outside of the list, each by 0.7 of
    the skin."""
    cutoff, skin = 8.0, 1.6
    system, engine, state = built(
        {"argon": 8}, 40.0, forces={"cutoff_A": cutoff, "skin_A": skin, "truncation": "plain"}
    )
    group = 4.0 * np.array([[0, 0, 0], [0, 1, 0], [0, 0, 1], [0, 1, 1.0]])
    origin_vector = np.array([cutoff + skin + 0.01, 0.0, 0.0])
    state.position[:] = 10.0 + np.vstack([group, group + origin_vector])
    alone = sum(energies(engine, state).values())
    state.position[:4, 0] += 0.7 * skin
    state.position[4:, 0] -= 0.7 * skin
    expected = sum(Oracle(system).energy(state.position, state.rotation))
    assert sum(energies(engine, state).values()) == pytest.approx(expected, rel=1e-12)
    assert abs(expected) > 1.001 * abs(alone)


def test_a_list_for_places_ahead_serves_longer_and_misses_nothing():
    """Forward and back in time."""
    forces = {"cutoff_A": 7.0, "skin_A": 1.2, "truncation": "force_shift"}
    system, engine, state = built({"spce": 150, "nitrogen": 20}, 20.0, 3, spread=0.1, forces=forces)
    other, same = system.engine(), state.copy()
    for n in range(160):
        dt = 0.001 if n < 80 else -0.001
        move(engine, state, SCHEMES["velocity_verlet"], dt, 1)
        for own in other.workspaces.values():
            own.pairs.times[BUILT] = np.nan  # so that it is built for the present positions
        move(other, same, SCHEMES["velocity_verlet"], dt, 1)
        if n % 10 == 9:
            load, expected = engine.evaluate(state)[0], system.engine().evaluate(state)[0]
            assert load.force == pytest.approx(
                expected.force, abs=1e-10 * np.abs(expected.force).max()
            )
    for own in engine.workspaces.values():
        assert own.pairs.times[LEAD_TIME] < 0  # built on the way back
    assert all(own.pairs.times[LEAD_TIME] == 0.0 for own in other.workspaces.values())
    builds = [
        sum(own.pairs.counters[BUILDS] for own in of.workspaces.values()) for of in (engine, other)
    ]
    assert builds[0] < 0.95 * builds[1]


@kernel(from_python=True)
def places_ahead(sites, state, lead, places):
    for i in range(len(places)):
        for k, x in enumerate(predict_site(sites, state, sites.molecule[i], i, lead)):
            places[i, k] = x


def test_places_ahead_are_where_velocities_lead_and_molecules_stay_rigid():
    """Over a short time to second order, and after a rotation of more than a radian."""
    system, _, state = built({"spce": 20, "nitrogen": 10}, 20.0, 3)
    sites = system.terms["coulomb"].sites
    h = 1e-4  # ps

    def at(lead):
        places = np.zeros((len(sites.molecule), 3))
        places_ahead(sites, state, lead, places)
        return places

    velocity = (at(h) - at(-h)) / (2 * h)
    charged = system.of_sites(lambda m: m.charges != 0)
    assert velocity == pytest.approx(
        system.site_velocities(state)[charged], abs=1e-4 * np.abs(velocity).max()
    )
    before, after = at(0.0), at(0.2)
    assert before == pytest.approx(system.site_positions(state)[charged], abs=1e-12)
    rate = np.abs(
        state.angular_momentum_body * system.model.inverse_inertia[system.model.species]
    ).max()
    assert 0.2 * rate > 1.0
    one, two = np.nonzero(np.triu(sites.molecule[:, None] == sites.molecule, 1))
    spans = [np.linalg.norm(places[one] - places[two], axis=1) for places in (before, after)]
    assert spans[1] == pytest.approx(spans[0], abs=1e-12)


@pytest.mark.parametrize("change", ["lately", "long ago", "fast", "unknown"])
def test_a_list_is_built_for_the_present_where_places_ahead_are_too_far(change):
    """Where they are not, bodies rotate by more than 0.3 rad on the way, and sites of a molecule keep
    their distances."""
    forces = {"cutoff_A": 6.0, "skin_A": 4.0}
    system, engine, state = built({"spce": 150}, 20.0, 3, spread=0.1, forces=forces)
    move(engine, state, SCHEMES["velocity_verlet"], 0.001, 1)
    expected = system.engine().evaluate(state)[0]
    for own in engine.workspaces.values():
        own.pairs.counters[USABLE] = 0
        own.pairs.times[BUILT] = -1e9 if change == "long ago" else -0.06
    if change in ("fast", "unknown"):
        state.velocity[17, 1] = state.angular_momentum_body[20, 2] = (
            1e5 if change == "fast" else np.nan
        )
    load = engine.evaluate(state)[0]
    assert load.force == pytest.approx(expected.force, abs=1e-10 * np.abs(expected.force).max())
    assert all(
        (own.pairs.times[LEAD_TIME] != 0.0) == (change == "lately")
        for own in engine.workspaces.values()
    )
    if change == "lately":
        rate = np.abs(
            state.angular_momentum_body * system.model.inverse_inertia[system.model.species]
        ).max()
        assert 0.3 < rate * own.pairs.times[LEAD_TIME] < 1.0


@pytest.mark.parametrize("precision", ["double", "mixed"])
def test_a_list_with_almost_no_skin_is_built_at_every_step(precision):
    """Its sites are where they are to rounding, which is more than the skin."""
    forces = {"cutoff_A": 6.0, "skin_A": 1e-15}
    system, engine, state = built(
        {"spce": 60, "nitrogen": 10}, 20.0, 3, forces=forces, precision=precision
    )
    move(engine, state, SCHEMES["velocity_verlet"], 0.0005, 4)
    expected, digits = (
        system.engine().evaluate(state)[0],
        {"double": 1e-10, "mixed": 1e-5}[precision],
    )
    assert engine.evaluate(state)[0].force == pytest.approx(
        expected.force, abs=digits * np.abs(expected.force).max()
    )
    assert [own.pairs.counters[BUILDS] for own in engine.workspaces.values()] == [5, 5]


def test_the_pressure_of_an_ideal_gas():
    """Molecules beyond each other's reach: P V = N k T_trans, whatever rotates, also where the total
    momentum is zero."""
    system, engine, state = built(
        {"nitrogen": 12}, 200.0, forces={"cutoff_A": 8.0, "truncation": "shift"}
    )
    seen = observe(system, engine, state)
    assert seen.potential == 0.0 and seen.kinetic_rotation > 0.0
    expected = 12 * BOLTZMANN * seen.temperature_translation / state.volume / BAR
    assert seen.pressure_bar == pytest.approx(expected, rel=1e-12)


WALLS = {"axis": "z", "kind": "harmonic", "positions_A": [5.0, 50.0], "stiffness_kJ_mol_A2": 4.0}
KEPT = {"ensemble": "nvt", "temperature_K": 300.0, "duration_ps": 1.0}


@pytest.mark.parametrize(
    ("counts", "stage", "sections", "axes"),
    [
        ({"nitrogen": 5}, KEPT, {}, [1, 1, 1]),
        ({"nitrogen": 5}, {"duration_ps": 1.0}, {}, [1, 1, 1]),
        ({"nitrogen": 5}, KEPT | {"thermostat": "langevin"}, {}, [0, 0, 0]),
        ({"nitrogen": 5}, KEPT | {"thermostat": "hybrid_monte_carlo"}, {}, [0, 0, 0]),
        ({"nitrogen": 1}, KEPT, {}, [1, 1, 1]),
        ({"nitrogen": 5}, KEPT, {"fields": {"walls": [WALLS]}}, [1, 1, 0]),
    ],
)
def test_the_pressure_contains_the_total_momentum_where_it_is_zero(counts, stage, sections, axes):
    """kT/V along each axis along which it is conserved."""
    forces = {"cutoff_A": 8.0, "truncation": "shift"}
    system, engine, state = built(counts, 60.0, forces=forces, stages=[stage], **sections)
    state.velocity[:] -= state.velocity.mean(axis=0)
    seen = observe(system, engine, state, stage=0)
    mass = system.model.mass[system.model.species]
    flux = np.einsum("n,ni,nj->ij", mass, state.velocity, state.velocity)
    several = sum(counts.values()) > 1
    thermal = BOLTZMANN * (seen.temperature_translation if several else seen.temperature)
    expected = (flux + thermal * np.diag(axes)) / state.volume / BAR
    assert thermal > 0
    assert seen.pressure_tensor_bar == pytest.approx(expected, rel=1e-12, abs=1e-12)


def test_the_self_energy_of_the_reaction_field():
    system = build(small_scene({"spce": 4}, 20.0, forces={"truncation": "switch"}))
    field = 0.5 / 9.0**3
    dipole2 = (system.species[0].dipole_debye / 4.803204712570263) ** 2
    assert system.constants["reaction_field_self"] == pytest.approx(
        -4 * field * dipole2 * 138935.457644, rel=1e-9
    )


@kernel(from_python=True)
def pair_forces_at(argon, charges, r2, found):
    for k in range(len(r2)):
        found[k, 0] = energy_and_force(argon, 2e9, 3e6, r2[k])[1]
        found[k, 1] = radial(charges, r2[k])[1]


def switched_potentials(name, start):
    """Lennard-Jones of one and of two kinds, and charges, between the same sites."""
    potentials = [
        lennard_jones(
            np.zeros(1, np.int32), np.full(kinds, 3.4), np.full(kinds, 100.0), 9.0, name, start
        )
        for kinds in (1, 2)
    ]
    potentials = [
        potential._replace(c12=np.full_like(potential.c12, 2e9), c6=np.full_like(potential.c6, 3e6))
        for potential in potentials
    ]
    return *potentials, reaction_field(np.zeros(1), 9.0, 78.5, name, start)


def forces_of_products(argon, charges, r):
    """force/r of energies that a switch multiplies, in NumPy."""
    s, slope = np.array(
        [SWITCH_FUNCTIONS[type(argon.truncation)](argon.truncation, x) for x in r]
    ).T
    of_argon = 2e9 * r**-12 - 3e6 * r**-6, 24e9 * r**-14 - 18e6 * r**-8
    of_charges = 1 / r + charges.field * r**2 + charges.terms[0], r**-3 - 2 * charges.field
    return np.stack([s * w - slope * u / r for u, w in (of_argon, of_charges)], axis=1)


@pytest.mark.parametrize("start", [8.1, 5.0, 0.0])
@pytest.mark.parametrize("name", ["switch", "smooth_switch"])
def test_a_switched_force_is_that_of_the_product(name, start):
    """The potentials add a polynomial in r to the coefficients of their forces; it is exact."""
    one, two, charges = switched_potentials(name, start)
    r = np.linspace(max(start - 1, 3.0), 9.0, 2001)
    expected = forces_of_products(one, charges, r)
    for potential in (one, two):
        found = np.empty((len(r), 2))
        pair_forces_at(
            potential.for_slots(1, np.float64), charges.for_slots(1, np.float64), r**2, found
        )
        limit = (
            1e-13 if name == "switch" else 2e-12
        )  # terms of the smooth one are up to 1e4 times their sum
        assert (np.abs(found - expected) / np.abs(expected).max(axis=0)).max() < limit


@pytest.mark.parametrize("start", [8.1, 7.2, 6.8])
def test_the_correction_of_a_switch_gives_the_force_of_its_product(start):
    """The polynomial in r² that mixed precision adds to the force: here in double precision, and
    how far its terms cancel, which single precision would show."""
    one, _, charges = switched_potentials("switch", start)
    potentials = one.for_slots(1, np.float32), charges.for_slots(1, np.float32)
    corrections = potentials[0].correction, potentials[1].switched
    assert all(isinstance(correction, SwitchCorrection) for correction in corrections)
    shape = Unmodified(9.0)
    plain = (
        one._replace(truncation=shape).for_slots(1, np.float32),
        charges._replace(truncation=shape).for_slots(1, np.float32),
    )
    r = np.linspace(start - 1, 9.0, 2001)
    found, without = np.empty((2, len(r), 2))
    pair_forces_at(*potentials, r**2, found)
    pair_forces_at(*plain, r**2, without)
    expected = forces_of_products(one, charges, r)
    before = r < start
    for k, correction in enumerate(corrections):
        largest = np.abs(found[:, k] - without[:, k]).max()
        assert 4 * np.abs(correction.coefficients).sum() < 200 * largest
        assert (
            np.abs(found[:, k] - expected[:, k]).max() < 3e-7 * np.abs(expected[~before, k]).max()
        )
        assert found[before, k] == pytest.approx(expected[before, k], rel=1e-14)


@pytest.mark.parametrize("name", TRUNCATIONS)
def test_what_a_potential_does_for_its_ending_is_decided_by_the_ending(name):
    """A wide switch has an addend in mixed precision too; a smooth one multiplies the energy there;
    what is not a switch has nothing to add."""
    for start, dtype in ((0.0, np.float32), (8.0, np.float64)):
        one, two, charges = switched_potentials(name, start)
        one, two, charges = (
            one.for_slots(1, dtype),
            two.for_slots(1, dtype),
            charges.for_slots(1, dtype),
        )
        kind = (
            SwitchTerm
            if name == "switch" or (name == "smooth_switch" and dtype == np.float64)
            else tuple
        )
        assert one.correction == ()
        assert {
            type(x)
            for x in (one.addend12, one.addend6, two.addend12, two.addend6, charges.switched)
        } == {kind}


# --- a new pair potential takes two files ---------------------------------------------------------

SOFT = """
from typing import NamedTuple

import numpy as np

from rigidmd.compile import implements
from rigidmd.compile.simd import inverse_square_root
from rigidmd.forces.neighbors import pair_loop
from rigidmd.forces.parts import Interactions
from rigidmd.units import KJ_PER_MOL


class SoftRepulsion(NamedTuple):
    cutoff: float  # Å
    strength: float  # u Å²/ps²

    def for_slots(self, slots, dtype):
        return self


def interactions(parts):
    keys = parts.scene.forces.soft_repulsion
    sites = parts.sites([np.arange(len(m.masses)) for m in parts.species])
    potential = SoftRepulsion(keys.range_A, keys.strength_kJ_mol * KJ_PER_MOL)
    return Interactions({"soft_repulsion": parts.pair_forces(potential, sites)}, {}, notes=("a soft note",))


@implements(pair_loop.pair, SoftRepulsion, inline=True)
def _pair(potential, i, j, r2):
    inverse = inverse_square_root(r2)
    left = 1.0 - r2 * inverse * (1 / potential.cutoff)
    return potential.strength * left * left, (2.0 * potential.strength / potential.cutoff) * left * inverse
"""
SOFT_KEYS = """class SoftRepulsion(Section):
    \"\"\"A soft repulsion of all sites: strength (1 - r/range)².\"\"\"

    strength_kJ_mol: Positive
    \"\"\"Energy at a distance of 0\"\"\"
    range_A: Positive = 5.0
    \"\"\"Where it ends\"\"\"


class Forces(Section):
    \"\"\"Forces between sites of different molecules.\"\"\"

    soft_repulsion: SoftRepulsion | None = None
    \"\"\"A soft repulsion\"\"\"
"""
SOFT_SCENE = """
precision = "double"
[box]
lengths_A = 26.0
[[molecules]]
model = "nitrogen"
count = 90
[forces]
cutoff_A = 9.0
lennard_jones = false
soft_repulsion = { strength_kJ_mol = 3.0 }
[start]
temperature_K = 100.0
[[stages]]
duration_ps = 0.05
[output]
trajectory = false
figures = false
"""
SOFT_SCRIPT = """
import json
from pathlib import Path
import numpy as np
from support.common import shaken
from rigidmd import Scene
from rigidmd.assemble.build import build
from rigidmd.assemble.describe import describe
from rigidmd import Simulation
from rigidmd.errors import SceneError
from rigidmd.scene import schema

def messages(change):
    try:
        Scene.from_dict(data | {"forces": {"soft_repulsion": change}})
    except SceneError as error:
        return error.errors

scene = Scene.read("soft.toml")
data = {"box": {"lengths_A": 26.0}, "molecules": [{"model": "nitrogen", "count": 9}],
        "start": {"temperature_K": 100.0}, "stages": [{"duration_ps": 0.05}]}
system, engine, state = shaken(build(scene), 5)
load, tallies = engine.evaluate(state)
x = system.site_positions(state)
away = x[:, None] - x
away -= 26.0 * np.rint(away / 26.0)
r = np.linalg.norm(away, axis=2)
owner = system.sites.molecule
near = (r < 5.0) & (owner[:, None] != owner)
strength = 300.0
expected = 0.5 * strength * ((1 - r[near] / 5.0) ** 2).sum()
force, error = load.force[:5].copy(), 0.0
for m in range(5):
    for k in range(3):
        found = []
        for step in (-1e-4, 1e-4):
            state.position[m, k] += step
            found.append(sum(tally.energy for tally in engine.evaluate(state)[1].values()))
            state.position[m, k] -= step
        error = max(error, abs(force[m, k] + (found[1] - found[0]) / 2e-4))
ends = []
for threads in (1, 2):
    results = Simulation(Scene.read("soft.toml", {"threads": threads})).run()
    ends.append([getattr(results.state, name).tobytes() for name in ("position", "velocity", "rotation")])
print(json.dumps({
    "energy": tallies["soft_repulsion"].energy, "expected": expected, "force_error": error, "force": abs(force).max(),
    "same_bits": ends[0] == ends[1], "check": describe(scene), "without": describe(Scene.from_dict(data)),
    "schema": list(schema()["$defs"]["SoftRepulsion"]["properties"]),
    "errors": [messages({}), messages({"strength_kJ_mol": 1.0, "range": 3.0})],
}))
"""


def test_adding_a_pair_potential_takes_two_files(tmp_path):
    files = {
        "scene/forces.py": edited(
            "scene/forces.py",
            (
                'class Forces(Section):\n    """Forces between sites of different molecules."""\n',
                SOFT_KEYS,
            ),
            (
                "POTENTIALS = {",
                'POTENTIALS = {"soft_repulsion": ("soft repulsion", "not in [forces]"), ',
            ),
        ),
        "forces/potentials/soft_repulsion.py": SOFT,
    }
    assert len(files) == 2
    (tmp_path / "soft.toml").write_text(SOFT_SCENE)
    found = json.loads(run_with_files(tmp_path, files, SOFT_SCRIPT).splitlines()[-1])
    assert found["energy"] == pytest.approx(found["expected"], rel=1e-12)
    assert found["force_error"] < 1e-6 * found["force"]
    assert found["same_bits"]
    assert "soft repulsion: 180 sites" in found["check"] and "  a soft note\n" in found["check"]
    assert "\n  Lennard-Jones: lennard_jones is false\n" in found["check"]
    assert "\n  soft repulsion: not in [forces]\n" in found["without"]
    assert found["schema"] == ["strength_kJ_mol", "range_A"]
    assert found["errors"][0] == ["forces.soft_repulsion.strength_kJ_mol: is missing"]
    assert "did you mean range_A?" in found["errors"][1][0]
