"""Sampling, judged by a package of others: kinetic energies, ensembles at two states, dipoles
in a field.

`pytest -m soak -rP` with this file prints what was measured, each with its
standard error. Limits are in standard errors: 4.5 where many figures are compared at once, else
3.5.
"""

import contextlib
import io
import re
import warnings
from itertools import product

import numpy as np
import pytest
from scipy import stats
from support.common import site
from support.sampling import (
    BAROSTATS,
    FEW,
    MANY,
    WARM,
    Course,
    dumbbells,
    error_of,
    follow,
    told,
)

from rigidmd.units import BOLTZMANN, KJ_PER_MOL, VOLT_PER_NM

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import physical_validation as pv

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
        site("O", 15.9994),
        site("H1", 1.008, [0.75695, 0.58588, 0.0], 0.5564),
        site("H2", 1.008, [-0.75695, 0.58588, 0.0], 0.5564),
        site("M", 0.0, [0.0, 0.1546, 0.0], -1.1128),
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
