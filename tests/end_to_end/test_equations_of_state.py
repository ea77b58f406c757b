"""Known averages of liquids and crystals at a pressure: densities, compressibilities, cells, elastic
constants."""

import shutil

import numpy as np
import pytest
from ase.build import bulk
from support.sampling import (
    BAROSTATS,
    DEPTH,
    DIAMETER,
    FEW,
    MANY,
    WARM,
    dumbbells,
    error_of,
    follow,
    told,
)

from rigidmd.run import Every, Simulation
from rigidmd.scene import Scene
from rigidmd.units import BAR, BOLTZMANN, KJ_PER_MOL

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
    pressure = course["pressure"]
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
def test_a_crystal_gives_way_to_a_shear_as_its_elastic_constant_states(tmp_path):
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
