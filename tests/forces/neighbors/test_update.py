"""When lists of neighbours are built: memory, skin, predicted positions, changes of the box."""

import numpy as np
import pytest
from support.common import built, move
from support.reference import Oracle

from rigidmd.compile import kernel
from rigidmd.core.integrators import SCHEMES
from rigidmd.engines.protocol import NotFiniteError
from rigidmd.errors import SimulationError
from rigidmd.forces.neighbors.clusters import BUILT, LEAD_TIME
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
from rigidmd.mechanics.rotation import from_vector


def energies(engine, state):
    return {name: tally.energy for name, tally in engine.evaluate(state)[1].items()}


@pytest.mark.parametrize("precision", ["double", "mixed"])
def test_a_list_with_little_memory_grows_and_misses_nothing(precision):
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


@pytest.mark.parametrize("edge", [31.1, None])
def test_lists_begin_with_about_the_memory_they_need(edge):
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


@pytest.mark.parametrize("at", [(0, 0), (2, 2), (1, 0), (2, 1)])
@pytest.mark.parametrize("counts", [{"argon": 60}, {"spce": 60}])
def test_a_box_that_is_not_a_number_is_reported(counts, at):
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


def test_a_cell_that_becomes_too_small_for_the_cutoff_stops_with_a_message():
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


def test_the_list_is_rebuilt_for_moves_and_for_rotations():
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


def test_a_list_for_positions_ahead_serves_longer_and_misses_nothing():
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


def test_positions_ahead_are_where_velocities_lead_and_molecules_stay_rigid():
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
def test_a_list_is_built_for_the_present_where_positions_ahead_are_too_far(change):
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


@pytest.mark.parametrize("molecule", [0, 5, 299])
def test_a_list_is_built_after_a_state_that_is_not_finite(molecule):
    """The sort of its sites had left numbers of bins, also negative ones, as their slots."""
    _, engine, state = built({"argon": 300}, 25.0, forces={"cutoff_A": 8.0})
    force = engine.evaluate(state)[0].force
    lost = state.copy()
    lost.position[molecule] = np.nan
    for _ in range(2):
        with pytest.raises(NotFiniteError):
            engine.evaluate(lost)
        assert np.array_equal(engine.evaluate(state)[0].force, force)
