"""What is measured of liquids next to published values. Minutes each: the soak tier."""

import numpy as np
import pytest
from support.common import ROOT

import rigidmd
from rigidmd import Scene, Simulation
from rigidmd.units import GRAM_PER_CM3

pytestmark = pytest.mark.soak

OUTPUT = {"trajectory_interval_ps": 0.1, "pressure_tensor_interval_ps": 0.01, "figures": False}


def liquid(model, count, density, duration, temperature=298.15, **output):
    """Results of a liquid under velocity rescaling, in memory."""
    stage = {
        "ensemble": "nvt",
        "temperature_K": temperature,
        "duration_ps": duration,
        "timestep_fs": 2.0,
        "integrator": "baoab",
        "thermostat": "velocity_rescaling",
    }
    scene = {
        "box": {"density_g_cm3": density},
        "molecules": [{"model": model, "count": count}],
        "forces": {"cutoff_A": 9.0, "electrostatics": "pme", "tail_correction": True},
        "precision": "mixed",
        "start": {"temperature_K": temperature},
        "stages": [stage],
        "output": OUTPUT | output,
    }
    return Simulation(Scene.from_dict(scene)).run()


def near(value, published, slack=0.0):
    """Whether a value is within four errors, and `slack`, of a published one."""
    print(value, "| published:", published)
    return abs(value.value - published) < 4 * value.error + slack


def test_spce_has_the_published_structure_diffusion_rotation_and_viscosity():
    results = liquid("spce", 216, 0.997, 200.0)
    g = rigidmd.analysis.rdf(results, "OW", "OW")
    assert near(g.value("g OW-OW: first peak"), 2.75, slack=0.02)
    assert near(g.value("g OW-OW: height of that peak"), 3.05, slack=0.1)
    D = rigidmd.analysis.diffusion(
        results, viscosity_mPa_s=0.729
    )  # Gonzalez & Abascal 2010, J. Chem. Phys. 132, 096101
    assert near(D.value("D of spce in an infinite box"), 2.8, slack=0.15)
    assert near(rigidmd.analysis.viscosity(results).value(), 0.729)
    times = rigidmd.analysis.orientation(results)
    slow, dipole, fast = (times.value(f"tau2 of spce, axis {k}").value for k in (1, 2, 3))
    assert 1.7 < slow < 2.4 and 1.3 < dipole < 1.9 and 0.9 < fast < 1.4


def test_tip4p2005_diffuses_and_flows_as_published():
    results = liquid("tip4p2005", 216, 0.997, 250.0)
    D = rigidmd.analysis.diffusion(results, viscosity_mPa_s=0.855)  # Gonzalez & Abascal 2010
    assert near(D.value("D of tip4p2005 in an infinite box"), 2.3, slack=0.1)
    assert near(rigidmd.analysis.viscosity(results).value(), 0.855)


def test_spce_has_the_published_dielectric_constant():
    """Twenty minutes: the dipole forgets itself in 10 ps."""
    results = liquid(
        "spce", 216, 0.997, 2000.0, trajectory_interval_ps=0.2, pressure_tensor_interval_ps=False
    )
    assert near(rigidmd.analysis.dielectric(results).value(), 71.0)


def test_nitrogen_diffuses_as_its_correlation_of_velocities_states():
    results = liquid("nitrogen", 256, 0.8, 80.0, temperature=77.0, trajectory_interval_ps=0.02)
    own = rigidmd.analysis.diffusion(results).value("D of nitrogen")
    memory = rigidmd.analysis.spectrum(results)["correlation V nitrogen"]
    mass = results.system.species[0].mass
    kT = 0.831446 * np.mean(results["temperature"])  # u Å²/ps²
    found = 10 * np.trapezoid(memory[: int(3 / 0.02)], dx=0.02) * kT / mass  # 1e-9 m²/s
    print(own, "| by its velocities:", found)
    assert abs(own.value - found) < 0.1 * own.value + 4 * own.error


def test_a_slab_of_water_has_the_published_density_and_surface_tension():
    """NIST SAT-TMMC of TIP4P/2005; Vega & de Miguel 2007, J. Chem. Phys. 126, 154707."""
    scene = Scene.read(
        ROOT / "systems" / "water_slab.toml", {"stages.production.duration_ps": 1000.0}
    )
    results = Simulation(scene).run()
    assert near(rigidmd.analysis.interfaces(results).value("liquid"), 0.9965, slack=0.0015)
    assert near(rigidmd.analysis.surface_tension(results).value(), 69.3, slack=0.9)


def test_argon_coexists_with_its_vapour_as_published():
    """NIST SAT-TMMC, Lennard-Jones with linear-force shift at 3 sigma at a reduced temperature of
    0.8."""
    stage = {"ensemble": "nvt", "integrator": "baoab", "temperature_K": 95.84, "timestep_fs": 10.0}
    scene = {
        "box": {"lengths_A": [34.05, 34.05, 93.0], "vacuum_A": 100.0},
        "molecules": [{"model": "argon", "count": 2000}],
        "forces": {"cutoff_A": 10.215, "truncation": "force_shift"},
        "start": {"temperature_K": 95.84},
        "stages": [stage | {"duration_ps": 400.0}, stage | {"duration_ps": 6000.0}],
        "output": OUTPUT | {"trajectory_interval_ps": 5.0, "pressure_tensor_interval_ps": 0.2},
    }
    results = Simulation(Scene.from_dict(scene)).run()
    found, unit = rigidmd.analysis.interfaces(results), 39.948 / 3.405**3 / GRAM_PER_CM3
    assert near(found.value("liquid"), 0.7294 * unit)
    assert near(found.value("vapour"), 0.0200 * unit)
