"""Sampling, judged by a package of others: kinetic energies, ensembles at two states, known
averages of liquids, dipoles and crystals.

`pytest -m soak -rP tests/end_to_end/test_ensembles.py` prints what was measured, each with its standard error.
Limits are in standard errors: 4.5 where many figures are compared at once, else 3.5.
"""

import contextlib
import io
import re
import shutil
import warnings
from itertools import product
from typing import NamedTuple

import numpy as np
import pytest
from ase.build import bulk
from scipy import stats

from rigidmd.engines.system import System
from rigidmd.run import Every, Results, Simulation
from rigidmd.scene import Scene
from rigidmd.units import BAR, BOLTZMANN, KJ_PER_MOL, VOLT_PER_NM

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import physical_validation as pv
    from pymbar import timeseries

MANY, FEW = 4.5, 3.5

#: Counts, edge of the cube (Å), temperature (K), step (fs).
LIQUIDS = {
    "spce": ({"spce": 32}, 9.9, 300.0, 0.5),
    "tip4p2005": ({"tip4p2005": 32}, 9.9, 300.0, 0.5),
    "nitrogen": ({"nitrogen_trappe": 32}, 12.6, 90.0, 2.0),
    "carbon_dioxide": ({"co2_trappe": 32}, 13.2, 250.0, 1.0),
    "argon": ({"argon": 32}, 11.6, 100.0, 4.0),
    "mixture": ({"argon": 8, "nitrogen_trappe": 8, "co2_trappe": 8, "spce": 8}, 12.0, 300.0, 0.5),
}
#: Each with a time short enough for many independent samples.
THERMOSTATS = {
    "velocity_rescaling": {"thermostat_time_ps": 0.02},
    "langevin": {"friction_translation_per_ps": 10.0},
    "nose_hoover": {"thermostat_time_ps": 0.1},
    "andersen": {"thermostat_time_ps": 0.1},
    "hybrid_monte_carlo": {"trajectory_steps": 20},
}
WARM = {"ensemble": "nvt", "thermostat": "langevin", "friction_translation_per_ps": 10.0}


class Course(NamedTuple):
    """The last stage of a run: f observations at n molecules."""

    system: System
    results: Results
    stage: int
    velocity: np.ndarray  # (f, n, 3) Å/ps
    angular: np.ndarray  # (f, n, 3) angular momentum along principal axes; 0 of points
    sites: np.ndarray  # (f, s, 3) positions, where they were requested
    site_velocities: np.ndarray  # (f, s, 3)

    def __getitem__(self, column: str) -> np.ndarray:
        """A column of the log in this stage."""
        return self.results[column][self.results["stage"] == self.stage]


def follow(scene: dict, interval: float, sites: bool = False, folder=".") -> Course:
    """Run a scene and observation at its last stage every `interval` ps."""
    last = len(scene["stages"]) - 1
    seen: list[tuple] = []

    def look(moment):
        if moment.stage == last and moment.step > 0:
            state = moment.state
            system = simulation.system
            both = (
                (system.site_positions(state), system.site_velocities(state))
                if sites
                else (np.zeros((0, 3)),) * 2
            )
            seen.append((state.velocity.copy(), state.angular_momentum_body.copy(), *both))

    quiet = {
        "threads": 1,
        "output": {"trajectory": False, "figures": False, "log_interval_ps": interval},
    }
    simulation = Simulation(Scene.from_dict(quiet | scene, folder), observers=Every(interval, look))
    results = simulation.run()
    return Course(simulation.system, results, last, *(np.array(x) for x in zip(*seen, strict=True)))


def liquid(name: str, *stages: dict, **sections) -> dict:
    """A scene of one of the liquids."""
    counts, edge, temperature, step = LIQUIDS[name]
    common = {"temperature_K": temperature, "timestep_fs": step}
    return {
        "box": {"lengths_A": edge},
        "molecules": [{"model": model, "count": count} for model, count in counts.items()],
        "forces": {"cutoff_A": 0.48 * edge, "truncation": "smooth_switch"},
        "start": {"temperature_K": temperature},
        "stages": [common | stage for stage in stages],
    } | sections


def error_of(values: np.ndarray) -> float:
    """Standard error of the mean of a series, by pymbar's statistical inefficiency."""
    if np.ptp(values) == 0:
        return 0.0
    return float(
        values.std(ddof=1) * np.sqrt(timeseries.statistical_inefficiency(values) / len(values))
    )


def told(name: str, value: float, error: float, reference: float) -> float:
    """Print a figure; how many standard errors it is from the reference."""
    print(
        f"{name}: {value:.6g} +- {error:.2g}, reference {reference:.6g}, {(value - reference) / error:+.1f} errors"
    )
    return abs(value - reference) / error


UNITS = pv.data.UnitData(
    BOLTZMANN / KJ_PER_MOL, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0
)  # kJ/mol, nm, nm³, K, bar, ps


def kinetic_judged(kinetic: np.ndarray, freedom: float, temperature: float) -> tuple[float, float]:
    """How far mean and width of kinetic energies (kJ/mol) are from those of a temperature, in
    standard errors."""
    parts = int(np.ceil(freedom / 3))
    data = pv.data.SimulationData(
        units=UNITS,
        ensemble=pv.data.EnsembleData("NVT", natoms=parts, volume=1.0, temperature=temperature),
        system=pv.data.SystemData(parts, 3 * parts - freedom, 0.0, 0.0),
        observables=pv.data.ObservableData(kinetic_energy=kinetic),
    )
    return pv.kinetic_energy.distribution(data, verbosity=0, bootstrap_seed=1)


def squares(course: Course, temperature: float) -> dict[str, np.ndarray]:
    """By species and component: each square of a momentum over its mean at a temperature, (f,
    molecules)."""
    model, thermal = course.system.model, BOLTZMANN * temperature
    kind = model.species
    mass = model.mass[kind]
    freedom = course.system.freedom_in(course.stage).translation
    kept = freedom < 3 * len(kind)
    share = (
        1 - mass / mass.sum() if kept else np.ones(len(mass))
    )  # what a conserved total momentum leaves
    found = {}
    for s, species in enumerate(course.system.species):
        own = kind == s
        for k in range(3):
            moving = mass[own] * course.velocity[:, own, k] ** 2 / (thermal * share[own])
            found[f"{species.name} p_{'xyz'[k]}"] = moving
            if model.inertia[s, k] > 0:
                found[f"{species.name} L_{k + 1}"] = course.angular[:, own, k] ** 2 / (
                    thermal * model.inertia[s, k]
                )
    return found


def kinetic_energies(course: Course) -> dict[str, tuple[np.ndarray, float]]:
    """For everything, and of each species: kinetic energies (f,), kJ/mol, and their degrees of
    freedom."""
    model = course.system.model
    kind, freedom = model.species, course.system.freedom_in(course.stage)
    mass = model.mass[kind]
    moving = 0.5 * (mass[:, None] * course.velocity**2).sum(axis=2) / KJ_PER_MOL
    turning = np.zeros_like(moving)
    if course.angular.size:
        turning = 0.5 * (course.angular**2 * model.inverse_inertia[kind]).sum(axis=2) / KJ_PER_MOL
    found = {"all": (moving.sum(axis=1) + turning.sum(axis=1), float(freedom.total))}
    kept = 3 * len(kind) - freedom.translation
    for s, species in enumerate(course.system.species):
        own = kind == s
        count = own.sum()
        left = 3 * count - kept * mass[own].sum() / mass.sum()
        found[f"{species.name} translation"] = (moving[:, own].sum(axis=1), float(left))
        if model.inertia[s].any():
            axes = (model.inertia[s] > 0).sum()
            found[f"{species.name} rotation"] = (turning[:, own].sum(axis=1), float(count * axes))
    assert sum(left for _, left in found.values()) == pytest.approx(2 * freedom.total)
    return found


def equipartition_judged(course: Course, temperature: float) -> float:
    """The worst of what physical_validation finds for translation and rotation, in standard
    errors."""
    system = course.system
    mass = system.sites.mass
    real = mass > 0  # what has no mass has no kinetic energy
    molecule = system.sites.molecule[real]
    first = np.flatnonzero(np.diff(molecule, prepend=-1))
    count = np.bincount(molecule)
    freedom = system.freedom_in(course.stage)
    data = pv.data.SimulationData(
        units=UNITS,
        ensemble=pv.data.EnsembleData(
            "NVT", natoms=len(molecule), volume=1.0, temperature=temperature
        ),
        system=pv.data.SystemData(
            natoms=len(molecule),
            nconstraints=float((3 * count - 6).sum()),
            ndof_reduction_tra=3 * len(count) - freedom.translation,
            ndof_reduction_rot=0,
            mass=mass[real],
            molecule_idx=first,
            nconstraints_per_molecule=3 * count - 6,
        ),
        trajectory=pv.data.TrajectoryData(
            0.1 * course.sites[:, real], 0.1 * course.site_velocities[:, real]
        ),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # rigid molecules have no internal degrees of freedom
        found = pv.kinetic_energy.equipartition(
            data,
            random_divisions=1,
            random_groups=2,
            random_division_seed=3,
            verbosity=0,
            bootstrap_seed=1,
        )
    found = np.array(found)
    assert (
        np.isfinite(found).all(axis=1).sum() == 12
    )  # all, half, other half: total, translation, rotation twice
    return float(np.nanmax(found))


@pytest.mark.parametrize(
    ("name", "thermostat"),
    [
        pytest.param(
            *which, marks=[] if which == ("nitrogen", "velocity_rescaling") else pytest.mark.soak
        )
        for which in product(LIQUIDS, THERMOSTATS)
    ],
)
def test_kinetic_energies_are_those_of_the_temperature(name, thermostat):
    """Distribution of the kinetic energies of translation and rotation of each species, and
    equipartition."""
    *_, temperature, step = LIQUIDS[name]
    nonlinear = name in ("spce", "tip4p2005")
    length = 40.0 * step**0.5
    stage = {"ensemble": "nvt", "thermostat": thermostat} | THERMOSTATS[thermostat]
    scene = liquid(name, WARM | {"duration_ps": 4.0 * step**0.5}, stage | {"duration_ps": length})
    course = follow(scene, 0.1 * step**0.5, sites=nonlinear)
    worst = 0.0
    for part, (kinetic, freedom) in kinetic_energies(course).items():
        own = kinetic_judged(kinetic, freedom, temperature)
        seen = 2 * kinetic / (freedom * BOLTZMANN / KJ_PER_MOL)
        told(f"{name} {thermostat} {part}, K", seen.mean(), error_of(seen), temperature)
        worst = max(worst, *own)
    assert worst < MANY
    for part, values in squares(course, temperature).items():
        over_molecules = values.mean(axis=1)
        assert abs(over_molecules.mean() - 1) < MANY * error_of(over_molecules), part
        assert stats.kstest(values[::10].ravel(), "chi2", args=(1,)).pvalue > 1e-5, part
    if nonlinear:
        assert equipartition_judged(course, temperature) < MANY


# Ensembles at two states.

#: Two-centre Lennard-Jones: sigma 3 Å, epsilon 100 K, 20 u a site, L* = 0.67.
DIAMETER, DEPTH = 3.0, 100.0
DUMBBELL = {
    "name": "dumbbell",
    "sites": [
        {
            "name": name,
            "mass_u": 20.0,
            "sigma_A": DIAMETER,
            "epsilon_K": DEPTH,
            "position_A": [0.0, 0.0, z],
        }
        for name, z in (("A", -0.335 * DIAMETER), ("B", 0.335 * DIAMETER))
    ],
}


def dumbbells(count: int, forces: dict, *stages: dict) -> dict:
    """A scene of dumbbells at 0.458 a sigma³."""
    edge = DIAMETER * (count / 0.458) ** (1 / 3)
    return {
        "box": {"lengths_A": edge},
        "molecules": [DUMBBELL | {"count": count}],
        "forces": forces,
        "start": {"temperature_K": 200.0},
        "stages": list(stages),
    }


def state_data(
    course: Course, temperature: float, pressure: float | None = None
) -> pv.data.SimulationData:
    """A stage at a temperature (K), and at a pressure (bar)."""
    ensemble = (
        {"ensemble": "NVT", "volume": 1.0}
        if pressure is None
        else {"ensemble": "NPT", "pressure": pressure}
    )
    return pv.data.SimulationData(
        units=UNITS,
        ensemble=pv.data.EnsembleData(
            natoms=len(course.system.model.species), temperature=temperature, **ensemble
        ),
        observables=pv.data.ObservableData(
            potential_energy=course["potential"],
            total_energy=course["energy"],
            volume=course["volume"],
        ),
    )


def ensemble_judged(name: str, one, two, **options) -> float:
    """How far slopes of the log ratio of two distributions are from the true ones, in standard
    errors."""
    printed = io.StringIO()
    with warnings.catch_warnings(), contextlib.redirect_stdout(printed):
        warnings.simplefilter("ignore")
        found = pv.ensemble.check(one, two, verbosity=1, **options)
    rows = re.findall(r"^\s+(\S+)\s+\+/-\s+(\S+)\s+\|\s+(\S+)", printed.getvalue(), re.MULTILINE)
    for slope, error, true in rows[
        : len(found)
    ]:  # the same follows as differences of temperature and pressure
        told(f"{name}, slope", float(slope), float(error), float(true))
        assert float(error) < 0.15 * abs(float(true))  # a slope that is not known shows nothing
    return float(np.max(found))


@pytest.mark.soak
@pytest.mark.parametrize("thermostat", THERMOSTATS)
def test_energies_at_two_temperatures(thermostat):
    """ln [p2(U)/p1(U)] has the slope 1/kT1 - 1/kT2."""
    found = []
    for temperature in (190.0, 230.0):
        common = {"temperature_K": temperature, "timestep_fs": 4.0}
        stage = common | {"ensemble": "nvt", "thermostat": thermostat} | THERMOSTATS[thermostat]
        warm = common | WARM | {"duration_ps": 20.0}
        forces = {"cutoff_A": 6.5, "truncation": "smooth_switch"}
        course = follow(dumbbells(50, forces, warm, stage | {"duration_ps": 400.0}), 0.2)
        found.append(state_data(course, temperature))
    assert ensemble_judged(f"{thermostat}, U", *found) < FEW
    assert ensemble_judged(f"{thermostat}, E", *found, total_energy=True) < FEW


@pytest.mark.soak
def test_energies_of_water_at_two_temperatures():
    """The same of SPC/E with a reaction field, langevin."""
    found = []
    for temperature in (280.0, 340.0):
        stage = {"temperature_K": temperature, "timestep_fs": 1.0} | WARM
        scene = liquid("spce", stage | {"duration_ps": 10.0}, stage | {"duration_ps": 450.0})
        found.append(state_data(follow(scene, 0.15), temperature))
    assert ensemble_judged("SPC/E, langevin, U", *found) < FEW


BAROSTATS = {
    "cell_rescaling": {
        "barostat_time_ps": 0.2,
        "barostat_interval_ps": 0.02,
        "compressibility_per_bar": 5e-4,
    },
    "monte_carlo": {"barostat_interval_ps": 0.02, "compressibility_per_bar": 2e-4},
}


@pytest.mark.soak
@pytest.mark.parametrize("barostat", BAROSTATS)
def test_volumes_and_enthalpies_at_two_states(barostat):
    """Slopes (p1 - p2)/kT of V, 1/kT1 - 1/kT2 of the enthalpy, and both together of U and V."""
    found = []
    # Hotter and pressed more, the volume is nearly the value of the first: only so the distributions of
    # both overlap enough.
    for temperature, pressure in (
        (200.0, 1000.0),
        (200.0, 1450.0),
        (240.0, 1000.0),
        (240.0, 1450.0),
    ):
        common = {"temperature_K": temperature, "timestep_fs": 4.0}
        stage = common | {
            "ensemble": "npt",
            "thermostat": "langevin",
            "pressure_bar": pressure,
            "barostat": barostat,
        }
        stage |= THERMOSTATS["langevin"] | BAROSTATS[barostat]
        forces = {"cutoff_A": 6.3, "truncation": "smooth_switch"}
        scene = dumbbells(
            50, forces, stage | {"duration_ps": 20.0}, stage | {"duration_ps": 1200.0}
        )
        course = follow(scene, 0.2)
        tried, accepted = (
            course.results.summary["stages"][-1][f"moves_{what}"] for what in ("tried", "accepted")
        )
        print(f"{barostat}: {accepted / tried:.2f} of the moves accepted")
        found.append(state_data(course, temperature, pressure))
    base, squeezed, warm, both = found
    assert ensemble_judged(f"{barostat}, V", base, squeezed) < FEW
    assert ensemble_judged(f"{barostat}, H", base, warm) < FEW
    assert ensemble_judged(f"{barostat}, U and V", base, both) < FEW


@pytest.mark.soak
def test_fluctuations_of_the_energy_fall_with_the_square_of_the_step():
    """NVE, velocity Verlet, of a mixture: rms fluctuations of the energy at steps that are
    halved."""
    found = []
    for step in (1.0, 0.5, 0.25):
        warm, nve = WARM | {"duration_ps": 3.0}, {"timestep_fs": step, "temperature_K": None}
        # so short that the three are one trajectory
        course = follow(liquid("mixture", warm, nve | {"duration_ps": 0.5}), 0.001)
        observed = pv.data.ObservableData(constant_of_motion=course["energy"])
        found.append(pv.data.SimulationData(units=UNITS, dt=step, observables=observed))
    deviation = pv.integrator.convergence(found)
    print(f"largest deviation from 4 at each halving: {deviation:.3f}")
    assert deviation < 0.1


# A dipole in a field.

#: TIP4P/2005 without its Lennard-Jones site: nothing acts between these molecules.
DIPOLE = {
    "name": "dipole",
    "sites": [
        {"name": "O", "mass_u": 15.9994, "position_A": [0.0, 0.0, 0.0]},
        {"name": "H1", "mass_u": 1.008, "position_A": [0.75695, 0.58588, 0.0], "charge_e": 0.5564},
        {"name": "H2", "mass_u": 1.008, "position_A": [-0.75695, 0.58588, 0.0], "charge_e": 0.5564},
        {"name": "M", "mass_u": 0.0, "position_A": [0.0, 0.1546, 0.0], "charge_e": -1.1128},
    ],
}
MOMENT = 1.1128 * (0.58588 - 0.1546)  # e Å


def orientations(
    thermostat: dict, step: float, duration: float, interval: float, molecules: int
) -> tuple:
    """Mean cosine between dipole and field of 1 V/nm at 300 K, over time; its exact mean; the
    results."""
    direction = np.array([0.6, 0.0, 0.8])
    stage = {"ensemble": "nvt", "temperature_K": 300.0, "timestep_fs": step} | thermostat
    scene = {
        "box": {"lengths_A": 500.0},
        "molecules": [DIPOLE | {"count": molecules}],
        "forces": {"electrostatics": "none"},
        "fields": {"electric_V_per_nm": direction.tolist()},
        "stages": [stage | {"duration_ps": 3.0}, stage | {"duration_ps": duration}],
        "output": {"trajectory": False, "figures": False, "log_interval_ps": 10 * interval},
    }
    course = follow(scene, interval, sites=True)
    sites = course.sites.reshape(len(course.sites), molecules, 4, 3)
    axis = 0.5 * (sites[:, :, 1] + sites[:, :, 2]) - sites[:, :, 0]
    cosine = axis @ direction / np.linalg.norm(axis, axis=2)
    x = MOMENT * VOLT_PER_NM / (BOLTZMANN * 300.0)
    return cosine.mean(axis=1), float(1 / np.tanh(x) - 1 / x), course.results


@pytest.mark.soak
def test_a_dipole_in_a_field():
    """<cos> = coth x - 1/x, x = mu E/kT, to 1e-3; and what a long step adds."""
    friction = {"thermostat": "langevin", "friction_translation_per_ps": 15.0}
    for name, thermostat, step in (
        ("langevin", friction, 2.0),
        ("andersen", {"thermostat": "andersen", "thermostat_time_ps": 0.1}, 2.0),
    ):
        cosine, exact, _ = orientations(thermostat, step, 120.0, 0.2, 2000)
        error = error_of(cosine)
        assert error < 5e-4
        assert told(f"<cos> of a dipole, {name}, {step:g} fs", cosine.mean(), error, exact) < FEW
        assert cosine.mean() == pytest.approx(exact, abs=1e-3)
    cosine, exact, _ = orientations(friction, 20.0, 120.0, 0.2, 2000)
    told("<cos> of a dipole, langevin, 20 fs", cosine.mean(), error_of(cosine), exact)


def test_a_few_dipoles_in_a_field():
    """The same to 1 %, in seconds."""
    cosine, exact, _ = orientations(
        {"thermostat": "langevin", "friction_translation_per_ps": 15.0}, 4.0, 8.0, 0.2, 400
    )
    assert error_of(cosine) < 0.01 * exact
    assert told("<cos>", cosine.mean(), error_of(cosine), exact) < MANY


@pytest.mark.parametrize(
    ("duration", "largest"), [(350.0, 8e-4), pytest.param(3000.0, 3e-4, marks=pytest.mark.soak)]
)
def test_dipoles_at_a_long_step_by_hybrid_monte_carlo(duration, largest):
    """The same at 20 fs, where velocity Verlet with Langevin's thermostat is off by many errors;
    <exp(-dH/kT)> = 1."""
    hybrid = {"thermostat": "hybrid_monte_carlo", "trajectory_steps": 5}
    cosine, exact, results = orientations(hybrid, 20.0, duration, 0.1, 400)
    error = error_of(cosine)
    assert error < largest
    assert told("<cos>, hybrid Monte Carlo, 20 fs", cosine.mean(), error, exact) < FEW
    weight = results["exp_minus_dH"][results["stage"] == 1]
    assert told("<exp(-dH/kT)>", weight.mean(), error_of(weight), 1.0) < MANY
    assert (
        0.4 < results["acceptance"][results["stage"] == 1].mean() < 0.8
    )  # so that the test is of rejections too
    friction = {
        "thermostat": "langevin",
        "friction_translation_per_ps": 15.0,
        "integrator": "velocity_verlet",
    }
    cosine, exact, _ = orientations(friction, 20.0, 100.0, 0.2, 400)
    assert (
        told("<cos>, velocity Verlet with langevin, 20 fs", cosine.mean(), error_of(cosine), exact)
        > 5
    )


# Liquids and crystals at a pressure.

PRESSURE_UNIT = DEPTH * BOLTZMANN / DIAMETER**3 / BAR  # bar
#: From Mecke's equation of state at T* = 2 and p* = 2.013: density, residual energy; what is taken as
#: its own uncertainty.
DENSITY, ENERGY, UNCERTAIN = 0.458, -10.900, (5e-4, 0.01)


def compressed(barostat: str, pressure: float, duration: float) -> tuple:
    """Dumbbells at T* = 2 and a pressure (bar): volume a molecule and residual energy, reduced,
    over time."""
    stage = {
        "ensemble": "npt",
        "temperature_K": 2 * DEPTH,
        "pressure_bar": pressure,
        "barostat": barostat,
        "timestep_fs": 4.0,
        "thermostat": "velocity_rescaling",
    } | BAROSTATS[barostat]
    forces = {"cutoff_A": 11.7, "truncation": "plain", "tail_correction": True}
    course = follow(
        dumbbells(256, forces, stage | {"duration_ps": 15.0}, stage | {"duration_ps": duration}),
        0.1,
    )
    return course["volume"] * 1e3 / DIAMETER**3 / 256, course["potential"] * KJ_PER_MOL / (
        256 * BOLTZMANN * DEPTH
    )


@pytest.mark.soak
def test_a_liquid_has_the_density_and_compressibility_of_its_equation_of_state():
    """Two-centre Lennard-Jones, L* = 0.67, T* = 2, p* = 2.013: density and energy by either
    barostat; <dV²>/(V kT) against -d ln V/dp between two pressures about it."""
    middle, apart = 2.013, 0.4
    found = {
        barostat: compressed(barostat, middle * PRESSURE_UNIT, 250.0) for barostat in BAROSTATS
    }
    for barostat, (volume, energy) in found.items():
        for name, values, reference, own in (
            ("density", 1 / volume, DENSITY, UNCERTAIN[0]),
            ("residual energy", energy, ENERGY, UNCERTAIN[1]),
        ):
            error = error_of(values)
            told(f"two-centre liquid, {barostat}, {name}", values.mean(), error, reference)
            assert error < 0.003 * abs(reference)
            assert abs(values.mean() - reference) < FEW * error + own
    for k, name in enumerate(("volume", "residual energy")):
        one, other = (values[k] for values in found.values())
        error = np.hypot(error_of(one), error_of(other))
        assert (
            told(f"cell_rescaling less monte_carlo, {name}", one.mean() - other.mean(), error, 0.0)
            < FEW
        )
    ends = [
        compressed("cell_rescaling", (middle + sign * apart) * PRESSURE_UNIT, 100.0)[0]
        for sign in (1, -1)
    ]
    slope = -np.log(ends[0].mean() / ends[1].mean()) / (2 * apart)
    error_of_slope = np.hypot(*(error_of(end) / end.mean() for end in ends)) / (2 * apart)
    assert error_of_slope < 0.1 * slope
    for barostat, (volume, _) in found.items():
        value = 256 * volume.var() / (2 * volume.mean())
        error = value * error_of((volume - volume.mean()) ** 2) / volume.var()
        assert error < 0.25 * slope
        assert (
            told(
                f"compressibility by fluctuations, {barostat}",
                value,
                np.hypot(error, error_of_slope),
                slope,
            )
            < FEW
        )


@pytest.mark.soak
def test_a_piston_keeps_the_mean_pressure():
    """nph: over time the pressure is the one requested."""
    warm = WARM | {"temperature_K": 200.0, "timestep_fs": 4.0, "duration_ps": 10.0}
    nph = {"ensemble": "nph", "pressure_bar": 1000.0, "timestep_fs": 2.0, "barostat_time_ps": 0.5}
    forces = {"cutoff_A": 6.3, "truncation": "smooth_switch", "tail_correction": True}
    course = follow(
        dumbbells(50, forces, warm, nph | {"duration_ps": 10.0}, nph | {"duration_ps": 300.0}), 0.05
    )
    pressure = course["pressure_bar"]
    # The piston's swings cancel over whole periods, which a statistical inefficiency of at least 1
    # does not see: means over ten periods each.
    means = pressure[len(pressure) % 100 :].reshape(-1, 100).mean(axis=1)
    error = float(means.std(ddof=1) / np.sqrt(len(means)))
    assert error < 3
    assert told("nph, pressure, bar", pressure.mean(), error, 1000.0) < FEW
    assert np.ptp(course["volume"]) > 0.03 * course["volume"].mean()


#: Argon, 108 atoms at 40 K and 1000 bar.
COLD, PRESSED, SHEAR = 40.0, 1000.0, 250.0


def crystal(folder, *stages: dict, stretched: np.ndarray | None = None) -> dict:
    """A scene of a cubic crystal of 108 argon atoms; `stretched`: its cell (3, 3)."""
    atoms = bulk("Ar", "fcc", a=5.25, cubic=True) * (3, 3, 3)
    if stretched is not None:
        atoms.set_cell(stretched, scale_atoms=True)
    atoms.write(folder / "argon.xyz", format="extxyz")
    common = {
        "timestep_fs": 5.0,
        "temperature_K": COLD,
        "thermostat": "langevin",
        "friction_translation_per_ps": 3.0,
    }
    return {
        "structure": {"file": "argon.xyz"},
        "molecules": [{"model": "argon"}],
        "forces": {"cutoff_A": 7.2, "truncation": "smooth_switch"},
        "start": {"temperature_K": COLD},
        "stages": [common | stage for stage in stages],
    }


def pressed(coupling: str, pressure: object, duration: float) -> tuple[dict, dict]:
    """Two stages at a pressure: to come to it, to observe."""
    stage = {
        "ensemble": "npt",
        "pressure_bar": pressure,
        "pressure_coupling": coupling,
        "barostat_time_ps": 0.3,
        "barostat_interval_ps": 0.025,
        "compressibility_per_bar": 5e-5,
    }
    return stage | {"duration_ps": 15.0}, stage | {"duration_ps": duration}


@pytest.mark.soak
def test_a_crystal_has_the_same_edges_whichever_way_they_move(tmp_path):
    def edges(coupling, duration):
        course = follow(
            crystal(tmp_path, *pressed(coupling, PRESSED, duration)), 0.1, folder=tmp_path
        )
        return [[course[name] for name in names] for names in ("abc", ("alpha", "beta", "gamma"))]

    reference = edges("isotropic", 100.0)[0][0]
    for coupling, duration in (
        ("semi_isotropic", 150.0),
        ("anisotropic", 150.0),
        ("flexible", 150.0),
    ):
        lengths, angles = edges(coupling, duration)
        for name, values in zip("abc", lengths, strict=True):
            error = np.hypot(error_of(values), error_of(reference))
            assert error < 2e-3 * reference.mean()
            assert told(f"{coupling}, {name}, Å", values.mean(), error, reference.mean()) < MANY
        for name, values in zip(("alpha", "beta", "gamma"), angles, strict=True):
            if coupling == "flexible":
                assert told(f"{coupling}, {name}, °", values.mean(), error_of(values), 90.0) < MANY
            else:
                assert values == pytest.approx(90)


@pytest.mark.soak
def test_a_crystal_gives_way_to_a_shear_as_its_elastic_constant_says(tmp_path):
    """Under a pressure xy the cell tilts the other way, by P_xy/C; C from the stress of a cell that
    is held sheared, and from how an unstressed cell fluctuates."""

    def lean(pressure, duration):
        cells = []

        def look(moment):
            if moment.stage == 1:
                cells.append(moment.state.cell.copy())

        scene = {"threads": 1, "output": {"trajectory": False, "figures": False}}
        scene |= crystal(tmp_path, *pressed("flexible", pressure, duration))
        Simulation(Scene.from_dict(scene, tmp_path), observers=Every(0.1, look)).run()
        cells = np.array(cells)
        return (
            cells.mean(axis=0),
            cells[:, 1, 0] / cells[:, 1, 1],
            np.prod(cells[:, range(3), range(3)], axis=1).mean(),
        )

    diagonal = [PRESSED] * 3
    cell, free, volume = lean([*diagonal, 0.0, 0.0, 0.0], 200.0)
    told("lean without shear", free.mean(), error_of(free), 0.0)
    assert abs(free.mean()) < FEW * error_of(free)
    _, sheared, _ = lean([*diagonal, SHEAR, 0.0, 0.0], 200.0)
    strain, error = sheared.mean(), error_of(sheared)
    assert strain < -10 * error  # pressure is minus stress
    # the same crystal, held
    held = np.diag(cell.diagonal())
    held[1, 0] = -0.02 * held[1, 1]
    stage = {"ensemble": "nvt"}
    scene = crystal(
        tmp_path, stage | {"duration_ps": 5.0}, stage | {"duration_ps": 40.0}, stretched=held
    )
    course = follow(scene, 0.1, folder=tmp_path)
    stress = course["pressure_xy"]
    constant, own = stress.mean() / 0.02, error_of(stress) / 0.02
    by_fluctuations = BOLTZMANN * COLD / (volume * free.var()) / BAR
    spread = by_fluctuations * error_of((free - free.mean()) ** 2) / free.var()
    told("C44 by fluctuations, bar", by_fluctuations, spread, constant)
    assert own < 0.05 * constant
    told("lean under shear", strain, np.hypot(error, strain * own / constant), -SHEAR / constant)
    assert -SHEAR / strain == pytest.approx(constant, rel=0.15)
    assert by_fluctuations == pytest.approx(constant, rel=0.15 + FEW * spread / constant)


@pytest.mark.soak
@pytest.mark.parametrize("coupling", ["anisotropic", "flexible"])
def test_ice_keeps_its_cell(coupling, reference, tmp_path):
    """Proton-disordered ice Ih of TIP4P/2005 at 250 K and 1 bar: 0.921 g/cm³ (Abascal & Vega 2005,
    table IV), its three axes in the proportions of the crystal, and its angles right ones."""
    shutil.copy(reference / "structures" / "genice_ice1h_tip4p_seed42.gro", tmp_path / "ice.gro")
    stage = {
        "ensemble": "npt",
        "temperature_K": 250.0,
        "timestep_fs": 2.0,
        "thermostat": "langevin",
        "pressure_bar": 1.0,
        "pressure_coupling": coupling,
        "barostat_time_ps": 0.5,
        "compressibility_per_bar": 1e-5,
    }
    scene = {
        "structure": {"file": "ice.gro"},
        "molecules": [{"model": "tip4p2005"}],
        "forces": {
            "cutoff_A": 7.0,
            "truncation": "shift",
            "tail_correction": True,
            "electrostatics": "pme",
        },
        "precision": "mixed",
        "start": {"temperature_K": 250.0},
        "stages": [stage | {"duration_ps": 10.0}, stage | {"duration_ps": 60.0}],
    }
    course = follow(scene, 0.1, folder=tmp_path)
    begin = np.array([course.results[name][0] for name in "abc"])
    density = course["density"]
    told(f"ice Ih, {coupling}, density, g/cm³", density.mean(), error_of(density), 0.921)
    assert error_of(density) < 0.002
    assert density.mean() == pytest.approx(0.921, rel=0.005)
    edges = np.array([course[name] for name in "abc"])
    growth = edges.mean(axis=1) / begin
    for name, values, whole in zip("abc", edges, begin, strict=True):
        told(
            f"ice Ih, {coupling}, {name}, Å",
            values.mean(),
            error_of(values),
            whole * np.cbrt(growth.prod()),
        )
    assert growth / np.cbrt(growth.prod()) == pytest.approx(np.ones(3), rel=0.01)
    for name in ("alpha", "beta", "gamma"):
        if coupling == "flexible":
            assert (
                told(f"ice Ih, {name}, °", course[name].mean(), error_of(course[name]), 90.0) < MANY
            )
        else:
            assert course[name] == pytest.approx(90)
