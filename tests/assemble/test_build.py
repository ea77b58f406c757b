"""What a stage of a scene passes to the step: thermostats, barostats, ramps and counts of a mixture
in their units."""

from math import pi

import numba
import numpy as np
import pytest
from support.common import observe, small_scene

from rigidmd.assemble.build import barostat_of, build, thermostat_of
from rigidmd.assemble.build import integrator_of_stage as row
from rigidmd.compile import BoundTask
from rigidmd.core.integrators import REMOVE_MOMENTUM, THERMOSTAT
from rigidmd.core.state import NOW, ORIGIN, REMOVED
from rigidmd.dynamics import barostats, step_rows, thermostats
from rigidmd.dynamics.barostats.cell_rescaling import strain_force
from rigidmd.dynamics.model import draw_momenta, remove_momentum
from rigidmd.dynamics.noise import BAROSTAT
from rigidmd.errors import SceneError

#: In u, Å and ps, from SI: 1 u = 1.66053906660e-27 kg.
KILOGRAM = 1 / 1.66053906660e-27
KELVIN = 1.380649e-23 * KILOGRAM * 1e20 / 1e24  # Boltzmann's constant times 1 K, u Å²/ps²
BAR = 1e5 * KILOGRAM * 1e-10 / 1e24  # u/(Å ps²)
#: 12 molecules: 36 degrees of freedom of translation; 4 x 3 and 5 x 2 of rotation.
COUNTS = {"spce": 4, "nitrogen": 5, "argon": 3}
TRANSLATION, ROTATION = 36, 22
NVT = {"ensemble": "nvt", "temperature_K": [280.0, 310.0], "duration_ps": 0.5, "timestep_fs": 2.0}
NPT = NVT | {"ensemble": "npt", "pressure_bar": [10.0, 500.0], "compressibility_per_bar": 8e-5}
NPH = {
    "ensemble": "nph",
    "pressure_bar": [10.0, 500.0],
    "compressibility_per_bar": 8e-5,
    "duration_ps": 0.5,
    "timestep_fs": 2.0,
}
FORCES = {"cutoff_A": 5.0}


def system_of(*stages, counts=COUNTS, **sections):
    return build(small_scene(counts, 14.0, stages=list(stages), **{"forces": FORCES} | sections))


def ramp(first, last, steps=250):
    return pytest.approx((first, last, steps), rel=1e-9)


TEMPERATURES = ramp(280 * KELVIN, 310 * KELVIN)


# thermostats


def test_langevin_has_the_friction_of_each_motion():
    system = system_of(
        NVT
        | {
            "thermostat": "langevin",
            "friction_translation_per_ps": 2.0,
            "friction_rotation_per_ps": 7.0,
        }
    )
    bath = thermostat_of(system, 0)
    assert (bath.friction_translation, bath.friction_rotation) == (2.0, 7.0)
    assert bath.thermal_energy == TEMPERATURES
    one = thermostat_of(
        system_of(NVT | {"thermostat": "langevin", "friction_translation_per_ps": 2.0}), 0
    )
    assert (one.friction_translation, one.friction_rotation) == (2.0, 2.0)


def test_chains_count_the_degrees_of_freedom_of_their_motion():
    system = system_of(
        NVT | {"thermostat": "nose_hoover", "thermostat_time_ps": 0.3, "nose_hoover_links": 4}
    )
    bath = thermostat_of(system, 0)
    assert (bath.freedom_translation, bath.freedom_rotation) == (TRANSLATION - 3, ROTATION)
    assert (bath.period, bath.links, bath.variables) == (0.3, 4, 16)
    assert bath.thermal_energy == TEMPERATURES


def test_velocity_rescaling_counts_both_motions():
    bath = thermostat_of(system_of(NVT | {"thermostat_time_ps": 0.3}), 0)
    freedom = bath.freedom_translation, bath.freedom_rotation
    assert (bath.time_constant, freedom) == (0.3, (TRANSLATION - 3, ROTATION))
    assert bath.thermal_energy == TEMPERATURES


def test_andersen_has_its_time():
    bath = thermostat_of(system_of(NVT | {"thermostat": "andersen", "thermostat_time_ps": 0.3}), 0)
    assert bath.time_constant == 0.3 and bath.thermal_energy == TEMPERATURES


@pytest.mark.parametrize(
    ("kind", "kept"),
    [
        ("velocity_rescaling", 3),
        ("nose_hoover", 3),
        ("langevin", 0),
        ("andersen", 0),
        ("hybrid_monte_carlo", 0),
    ],
)
def test_temperatures_count_the_total_momentum_where_the_thermostat_changes_it(kind, kept):
    system = system_of(NVT | {"thermostat": kind})
    assert system.freedom_in(0) == (TRANSLATION - kept, ROTATION)


def test_every_thermostat_acts_for_a_whole_step():
    for kind in ("velocity_rescaling", "nose_hoover", "langevin", "andersen"):
        flows = row(system_of(NVT | {"thermostat": kind, "integrator": "velocity_verlet"}), 0).flows
        own = [flow for flow in flows if flow.kind == THERMOSTAT]
        assert sum(flow.fraction / flow.every for flow in own) == pytest.approx(1), kind


def test_stages_have_random_numbers_of_their_own():
    """Steps count on through a run, so that no number is drawn twice; but a run of the second stage
    alone has others."""
    system = system_of(NPT | {"thermostat": "langevin"}, NPT | {"thermostat": "langevin"})
    keys = {
        key for k in (0, 1) for key in (thermostat_of(system, k).key, barostat_of(system, k).key)
    }
    assert len(keys) == 4
    again = system_of(NPT | {"thermostat": "langevin"}, seed=2)
    assert not keys & {thermostat_of(again, 0).key, barostat_of(again, 0).key}


# barostats

MONTE_CARLO = NPT | {"barostat": "monte_carlo"}
PRESSURES = tuple((p * BAR,) * 3 + (0.0,) * 3 for p in (10.0, 500.0))


def pressed(pressure):
    """Assert that a pressure is 10 bar at first and 500 bar in the end, of 250 steps."""
    assert pressure.first == pytest.approx(PRESSURES[0], rel=1e-9)
    assert pressure.last == pytest.approx(PRESSURES[1], rel=1e-9)
    assert pressure.steps == 250


@pytest.mark.parametrize("thermostat", ["velocity_rescaling", "langevin"])
def test_a_monte_carlo_barostat_counts_the_molecules(thermostat):
    """Centres of mass: one for each molecule, whether or not a thermostat keeps the total
    momentum."""
    system = system_of(MONTE_CARLO | {"thermostat": thermostat})
    box = barostat_of(system, 0)
    assert box.molecules == 12.0
    assert box.thermal_energy == TEMPERATURES
    assert box.width == pytest.approx(2 * np.sqrt(310 * KELVIN * 8e-5 / BAR * 14.0**3))
    pressed(box.pressure)


@pytest.mark.parametrize(
    ("thermostat", "at_rest"),
    [
        ("velocity_rescaling", (1.0, 1.0, 1.0)),
        ("nose_hoover", (1.0, 1.0, 1.0)),
        ("langevin", (0.0, 0.0, 0.0)),
        ("andersen", (0.0, 0.0, 0.0)),
    ],
)
def test_cell_rescaling_knows_whether_the_total_momentum_is_kept(thermostat, at_rest):
    """It is what makes N + 1 of N in the law of an ideal gas."""
    box = barostat_of(system_of(NPT | {"thermostat": thermostat, "barostat_time_ps": 0.4}), 0)
    assert box.at_rest == at_rest
    assert box.rate == pytest.approx(8e-5 / BAR / 0.4)
    assert box.coordinate == (0, 0, 0, -1, -1, -1)
    assert box.thermal_energy == TEMPERATURES
    pressed(box.pressure)


def test_a_field_along_one_axis_leaves_the_momentum_of_the_others():
    """Molecules with a net charge take momentum from a field along x; those along y and z keep
    theirs."""
    field = {"fields": {"electric_V_per_nm": [0.1, 0.0, 0.0]}}
    system = system_of(NVT, counts={"na_spce": 4, "argon": 3}, **field)
    assert system.model.keeps_momentum.tolist() == [False, True, True]
    assert system.freedom.translation == 21 - 2


@pytest.mark.parametrize(
    ("coupling", "coordinate"),
    [
        ("semi_isotropic", (0, 0, 1, -1, -1, -1)),
        ("anisotropic", (0, 1, 2, -1, -1, -1)),
        ("flexible", (0, 1, 2, 3, 4, 5)),
    ],
)
def test_a_stress_has_its_components_in_the_order_of_the_strain(coupling, coordinate):
    """A scene lists xx, yy, zz, xy, xz, yz; the strain has (0, 0), (1, 1), (2, 2), (1, 0), (2, 0),
    (2, 1)."""
    given = [1.0, 1.0, 3.0] if coupling == "semi_isotropic" else [1.0, 2.0, 3.0]
    given += [4.0, 5.0, 6.0] if coupling == "flexible" else []
    box = barostat_of(system_of(NPT | {"pressure_coupling": coupling, "pressure_bar": given}), 0)
    assert box.coordinate == coordinate
    assert box.pressure.first[: len(given)] == pytest.approx(np.array(given) * BAR)
    assert box.pressure.first == box.pressure.last
    assert barostats.COMPONENTS == ((0, 0), (1, 1), (2, 2), (1, 0), (2, 0), (2, 1))


def test_a_piston_has_the_period_that_was_requested():
    """1/M of a mass M on the spring 1/(compressibility V): (2 pi/period)² compressibility V."""
    box = barostat_of(system_of(NPH | {"barostat_time_ps": 0.4}), 0)
    assert box.inverse_mass == pytest.approx((2 * pi / 0.4) ** 2 * 8e-5 / BAR * 14.0**3)
    count = sum(COUNTS.values())
    assert box.exponent == pytest.approx(count / (count - 1))  # with the total momentum at rest
    pressed(box.pressure)


def test_moves_of_the_box_come_at_their_interval():
    scheme = row(system_of(NPT | {"barostat_interval_ps": 0.02}), 0)
    moves = [flow for flow in scheme.flows if flow.kind == BAROSTAT]
    assert [flow.every for flow in moves] == [10]
    assert sum(flow.fraction for flow in moves) == pytest.approx(10)


@pytest.mark.parametrize("thermostat", ["velocity_rescaling", "langevin"])
def test_the_total_momentum_is_taken_out_at_its_interval_where_it_is_kept(thermostat):
    own = row(
        system_of(NVT | {"thermostat": thermostat}, run={"remove_momentum_interval_ps": 0.05}), 0
    )
    rests = [flow.every for flow in own.flows if flow.kind == REMOVE_MOMENTUM]
    assert rests == ([25] if thermostat == "velocity_rescaling" else [])


@pytest.mark.parametrize("thermostat", ["velocity_rescaling", "hybrid_monte_carlo"])
def test_an_interval_beyond_the_run_fits_into_64_bits(thermostat):
    """A picosecond has 1e23 steps of 1e-20 fs."""
    stage = NVT | {"thermostat": thermostat, "duration_ps": 4e-23, "timestep_fs": 1e-20}
    if thermostat == "hybrid_monte_carlo":
        with pytest.raises(SceneError, match="a trajectory of hybrid_monte_carlo is more than"):
            system_of(stage)
        return
    rests = [flow.every for flow in row(system_of(stage), 0).flows if flow.kind == REMOVE_MOMENTUM]
    assert rests == [10**12]


# what the step makes of them


def test_a_ramp_is_even_over_the_steps_of_its_stage():
    """At step k of n, counted from the begin of the stage, the pressure is p0 + (p1 - p0) k/n."""
    system = system_of(NPT)
    box, state = barostat_of(system, 0), system.state.copy()
    asked, present = barostats.target_pressure.py_func, thermostats.ramp_value.py_func
    state.step[ORIGIN] = 1000
    for taken in (0, 99, 249):  # the step that is being taken is the next one
        state.step[NOW] = 1000 + taken
        share = (taken + 1) / 250
        for k in range(3):
            assert asked(box.pressure, state, k) == pytest.approx((10 + 490 * share) * BAR)
        assert asked(box.pressure, state, 4) == 0
        assert present(box.thermal_energy, state) == pytest.approx((280 + 30 * share) * KELVIN)


@numba.njit
def _driving(box, model, state, room, k, volume, thermal):
    return strain_force(box, model, state, room, k, volume, thermal)


def test_what_drives_the_cell_follows_a_ramp_of_the_pressure():
    """Between two steps of a ramp only the pressure differs: the drive falls by V dP."""
    system = system_of(NPT)
    box, state = barostat_of(system, 0), system.state.copy()
    room, found = barostats.barostat_workspace(state), []
    for taken in (0, 124, 249):
        state.step[NOW] = taken
        found.append(_driving(box, system.model, state, room, 1, state.volume, 300 * KELVIN))
    rise = 490 * BAR * state.volume / 250
    assert found[0] - found[1] == pytest.approx(124 * rise, rel=1e-9)
    assert found[1] - found[2] == pytest.approx(125 * rise, rel=1e-9)


@numba.njit
def _log_acceptance(box, model, state, room, h):
    return barostats.log_acceptance(box, model, state, room, h)


def test_a_change_of_the_volume_is_accepted_by_the_power_of_the_number_of_molecules():
    """(V'/V)^N exp(-(dU + P dV)/kT)."""
    system = system_of(MONTE_CARLO)
    box, state = barostat_of(system, 0), system.state.copy()
    state.step[NOW] = 249  # 310 K, 500 bar
    room = barostats.barostat_workspace(state)
    room.tally[:, 0] = 250.0, 100.0
    state.cell[:] *= 1.02
    before, after = 14.0**3, (1.02 * 14.0) ** 3
    work = (150.0 + 500 * BAR * (after - before)) / (310 * KELVIN)
    found = _log_acceptance(box, system.model, state, room, 0.01)
    assert found == pytest.approx(12 * np.log(after / before) - work, rel=1e-9)


# momentum


def pushed(system, seed=1):
    """Thermal momenta of a mixture, and a push along each axis."""
    rng, state = np.random.default_rng(seed), system.state.copy()
    mass = system.model.mass[system.model.species]
    state.velocity[:] = rng.standard_normal((len(mass), 3)) / np.sqrt(mass)[:, None] + [
        0.3,
        -0.2,
        0.5,
    ]
    return state, mass


@pytest.mark.parametrize("counts", [COUNTS, {"na_spce": 4, "argon": 3}])
def test_a_mixture_is_brought_to_rest_by_one_velocity_for_all(counts):
    """The common velocity is P/M; its energy P²/2M is accounted for. A field along x leaves what is
    along x."""
    field = {"fields": {"electric_V_per_nm": [0.1, 0.0, 0.0]}} if "na_spce" in counts else {}
    system = system_of(NVT, counts=counts, **field)
    state, mass = pushed(system)
    before = state.velocity.copy()
    momentum = mass @ before
    kept = np.array([not field, True, True])
    BoundTask(step_rows._remove_momentum, (system.model, state))()
    assert (mass @ state.velocity)[kept] == pytest.approx(np.zeros(kept.sum()), abs=1e-12)
    assert before - state.velocity == pytest.approx(
        np.tile(kept * momentum / mass.sum(), (len(mass), 1))
    )
    energies = [0.5 * mass @ (v**2).sum(axis=1) for v in (before, state.velocity)]
    assert state.energy_ledger[REMOVED] == pytest.approx(energies[1] - energies[0])


def test_a_mixture_starts_at_rest_and_at_its_temperature():
    """The momenta of a start sum to zero though masses differ, and no species has more than its
    part by rule."""
    system = system_of(
        NVT, counts={"spce": 40, "nitrogen": 50, "argon": 30}, box={"lengths_A": 40.0}
    )
    state, mass = system.state.copy(), system.model.mass[system.model.species]
    draw_momenta(system.model, state, 300.0, np.random.default_rng(5))
    assert mass @ state.velocity == pytest.approx(np.zeros(3), abs=1e-9)
    freedom = system.freedom
    assert mass @ (state.velocity**2).sum(axis=1) == pytest.approx(
        freedom.translation * 300 * KELVIN
    )
    spin = state.angular_momentum_body**2 * system.model.inverse_inertia[system.model.species]
    assert spin.sum() == pytest.approx(freedom.rotation * 300 * KELVIN)


def test_a_start_has_a_thermal_energy_about_each_axis():
    """<L²/I> = kT about each of three unlike axes and about both of a line; <m v²> = kT of each
    species along each."""
    system = system_of(
        NVT, counts={"spce": 40, "nitrogen": 50, "argon": 30}, box={"lengths_A": 40.0}
    )
    kind, inertia = system.model.species, system.model.inertia[system.model.species]
    over = np.divide(1.0, inertia, out=np.zeros_like(inertia), where=inertia > 0)
    rng, turning, moving = np.random.default_rng(8), [], []
    for _ in range(200):
        state = system.state.copy()
        draw_momenta(system.model, state, 300.0, rng)
        turning.append(state.angular_momentum_body**2 * over)
        moving.append(state.velocity**2 * system.model.mass[kind][:, None])
    for k, axes in enumerate(
        ([1, 1, 1], [0, 1, 1], [0, 0, 0])
    ):  # spce, nitrogen, argon: 6000 values at least
        seen = [
            np.mean(values, axis=0)[kind == k].mean(axis=0) / (300 * KELVIN)
            for values in (turning, moving)
        ]
        assert seen[0] == pytest.approx(np.array(axes), abs=0.07)  # four times sqrt(2/6000)
        assert seen[1] == pytest.approx(np.ones(3), abs=0.07)


def test_a_push_that_is_taken_out_is_the_same_for_all_molecules():
    """`remove_momentum` keeps all relative velocities, and returns the energy that it takes."""
    system = system_of(NVT)
    state, mass = pushed(system)
    before = state.velocity.copy()
    taken = remove_momentum(system.model, state.velocity)
    assert np.ptp(before - state.velocity, axis=0) == pytest.approx(np.zeros(3), abs=1e-12)
    assert mass @ state.velocity == pytest.approx(np.zeros(3), abs=1e-12)
    assert taken == pytest.approx(np.sum((mass @ before) ** 2) / (2 * mass.sum()))


# temperatures and pressures where a thermostat acts, or without the time-step error


def test_temperatures_and_pressures_have_the_corrected_kinetic_energy():
    """2K/(f k) of K + c (sum F²/m), and of K + c (sum n²/I) over the axes that have inertia; the
    pressure tensor of sum m V V + 2 c sum F F/m."""
    system = system_of({"duration_ps": 0.1})
    state, mass = pushed(system)
    rng, dt = np.random.default_rng(3), 0.02
    inertia = system.model.inertia[system.model.species]
    state.angular_momentum_body[:] = rng.standard_normal(inertia.shape) * np.sqrt(
        inertia * 300 * KELVIN
    )
    found, at_ends = (
        observe(system, system.engine(), state, correction=correction)
        for correction in (dt**2 / 12, 0.0)
    )
    over = np.divide(1.0, inertia, out=np.zeros_like(inertia), where=inertia > 0)
    moving = 0.5 * mass @ (state.velocity**2).sum(axis=1)
    turning = 0.5 * (state.angular_momentum_body**2 * over).sum()
    more = dt**2 / 12 * (found.load.force**2 / mass[:, None]).sum()
    more_turning = dt**2 / 12 * (found.load.torque_body**2 * over).sum()
    assert min(more / moving, more_turning / turning) > 1e-4  # what is tested is seen
    f, g = TRANSLATION - 3, ROTATION
    assert at_ends.temperature_translation == pytest.approx(2 * moving / (f * KELVIN))
    assert at_ends.temperature_rotation == pytest.approx(2 * turning / (g * KELVIN))
    # the difference alone, to its own digits
    gained = found.temperature_translation - at_ends.temperature_translation
    gained_turning = found.temperature_rotation - at_ends.temperature_rotation
    assert gained == pytest.approx(2 * more / (f * KELVIN), rel=1e-6)
    assert gained_turning == pytest.approx(2 * more_turning / (g * KELVIN), rel=1e-6)
    both = moving + turning + more + more_turning
    assert found.temperature == pytest.approx(2 * both / ((f + g) * KELVIN))
    assert found.kinetic == at_ends.kinetic and found.conserved == at_ends.conserved
    squares = np.einsum("ni,nj->ij", found.load.force, found.load.force / mass[:, None])
    gained_tensor = found.pressure_tensor - at_ends.pressure_tensor
    expected = dt**2 / 6 * squares + KELVIN * gained * np.eye(3)  # with the momentum at rest
    assert gained_tensor == pytest.approx(expected / state.volume / BAR, rel=1e-6)
