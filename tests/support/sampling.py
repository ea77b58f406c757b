"""Runs that sample an ensemble, and errors of what they print."""

import warnings
from typing import NamedTuple

import numpy as np

from rigidmd.engines.system import System
from rigidmd.run import Every, Results, Simulation
from rigidmd.scene import Scene
from support.common import site

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from pymbar import timeseries

MANY, FEW = 4.5, 3.5


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


# Ensembles at two states.

#: Two-centre Lennard-Jones: sigma 3 Å, epsilon 100 K, 20 u a site, L* = 0.67.
DIAMETER, DEPTH = 3.0, 100.0
DUMBBELL = {
    "name": "dumbbell",
    "sites": [
        site(name, 20.0, [0.0, 0.0, z], sigma_A=DIAMETER, epsilon_K=DEPTH)
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


BAROSTATS = {
    "cell_rescaling": {
        "barostat_time_ps": 0.2,
        "barostat_interval_ps": 0.02,
        "compressibility_per_bar": 5e-4,
    },
    "monte_carlo": {"barostat_interval_ps": 0.02, "compressibility_per_bar": 2e-4},
}
