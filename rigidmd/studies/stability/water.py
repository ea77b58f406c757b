"""Stability cases: water from 0 K to 1e5 K, its longest steps, equipartition, the thermostat."""

from collections.abc import Iterator
from functools import cache, partial
from math import hypot, inf, sqrt
from typing import Any

import numpy as np

from rigidmd.core.state import State
from rigidmd.core.statistics import mean_and_error
from rigidmd.run.results import Results
from rigidmd.studies.stability.cases import (
    REFUSED,
    REPORTED,
    RIGHT,
    SCENES,
    SPLIT,
    Trial,
    case,
    complete_scene,
    finish,
    run_scene,
)
from rigidmd.studies.stability.molecules import WATER_FORCES, Tables, bent, molecules_scene
from rigidmd.units import BOLTZMANN, KJ_PER_MOL

WATERS = 64
FREEDOM = 6 * WATERS - 3
#: Integrators of the longest steps.
DIFFERENT = (SPLIT, "velocity_verlet, exact rotor", "srkn_4")


def water(model: str, temperature: float = 298.0) -> Tables:
    """A scene of a box of water."""
    molecule = SCENES["tip4p"] if model == "tip4p" else {"model": model}
    box = {"density_g_cm3": 0.997}
    return molecules_scene([molecule | {"count": WATERS}], box, WATER_FORCES, temperature)


def nvt(temperature: float, time: float) -> dict[str, Any]:
    """The keys of a thermostat. time : fs"""
    return {"ensemble": "nvt", "temperature_K": temperature, "thermostat_time_ps": time / 1000}


def kinetic_energy(temperature: float) -> float:
    """The canonical mean, kJ/mol."""
    return 0.5 * FREEDOM * BOLTZMANN / KJ_PER_MOL * temperature


@cache
def liquid(model: str) -> State:
    """A state of water after 0.5 ps at 298 K, from a lattice."""
    return warm(model, 298.0, 1.0, 500)


def warm(
    model: str, temperature: float, step: float, steps: int = 1000, state: State | None = None
) -> State:
    """Liquid water at a temperature, from a lattice or a state."""
    heat = nvt(temperature, 20 * step)
    scene = complete_scene(water(model), SPLIT, step, steps=steps, thermostat=heat)
    return finish(scene, state).state


def frozen() -> State:
    """Water at rest in a minimum of its energy."""
    stages = {"stages": [{"ensemble": "minimise"}]}
    state = finish(complete_scene(water("spce") | stages), liquid("spce")).state
    state.velocity[:] = 0.0
    state.angular_momentum_body[:] = 0.0
    return state


@case(9, "energy error over kinetic energy (at 1 K, of that at 0 K)", "fs")
def water_steps(quick: bool) -> Iterator[Trial]:
    """Water at 0 K, 10 K, 298 K, 1000 K and 1e5 K: right at a short step, and the longest step that
    is bounded."""
    for temperature in (298.0,) if quick else (0.0, 10.0, 298.0, 1000.0, 1e5):
        # a hundredth of an ångström at thermal speed, but stable for librations
        step = min(0.5, 0.5 * (1000.0 / max(temperature, 1.0)) ** 0.5)
        state = liquid("spce")
        if temperature == 0:
            state = frozen()
        elif temperature != 298:
            state = warm("spce", temperature, step, state=state)
        run = partial(
            run_scene,
            water("spce", 0.0),
            duration=(500 if quick else 1000) * step,
            steps=200,
            state=state,
            scale=kinetic_energy(max(temperature, 1.0)),
        )
        trial = Trial(f"{temperature:g} K", run, step, 0.02, DIFFERENT)
        yield trial
        yield trial.limit()


@case(9, "energy error over kinetic energy", "fs")
def tip4p_steps(quick: bool) -> Iterator[Trial]:
    """TIP4P at 300 K at 0.5 to 12 fs; it is known to become unstable near 10 fs (Davidchack 2010,
    J. Comput. Phys. 229, 9323)."""
    run = partial(
        run_scene,
        water("tip4p", 0.0),
        steps=300 if quick else 1000,
        state=warm("tip4p", 300.0, 1.0, state=liquid("tip4p")),
        scale=kinetic_energy(300.0),
    )
    integrators = (SPLIT,) if quick else DIFFERENT
    for step in (0.5,) if quick else (0.5, 1.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0):
        allowed = 0.02 if step <= 1 else 1.0
        expected = (RIGHT, REPORTED, REFUSED)
        yield Trial(f"{step:g} fs", run, step, allowed, integrators, expected)
    yield Trial("300 K", run, 4.0, integrators=integrators).limit()


@case(14, "T_rot - T_trans, in its standard errors", "fs")
def equipartition(quick: bool) -> Iterator[Trial]:
    """T_trans = T_rot in NVT for linear, symmetric, asymmetric bodies and a mixture with points, at
    two steps."""
    asymmetric, linear = bent(0.5) | {"name": "bent"}, bent(0.0) | {"name": "linear"}
    species = {"asymmetric": asymmetric, "linear": linear, "symmetric": SCENES["ring"]}
    mixture = [molecule | {"count": 12} for molecule in (*species.values(), SCENES["point"])]
    settings = {name: [molecule | {"count": 48}] for name, molecule in species.items()}
    settings = {"mixture": mixture} if quick else settings | {"mixture": mixture}
    steps = 4000 if quick else 10000
    for setting, molecules in settings.items():
        tables = molecules_scene(molecules, {"lengths_A": 16.0}, {"cutoff_A": 8.0}, 400.0)
        run = partial(
            run_scene,
            tables,
            steps=steps,
            samples=steps // 10,
            thermostat=nvt(400.0, 100.0),
            error=temperature_gap,
        )
        for step in (2.0, 8.0):
            yield Trial(f"{setting}, {step:g} fs", run, step, 4.0, [SPLIT])


def temperature_gap(results: Results) -> float:
    """|T_rot - T_trans| in its standard errors, after a fifth of the run."""
    means, errors = [], []
    for motion in ("rotation", "translation"):
        late = len(results["time"]) // 5
        mean, error = mean_and_error(results[f"temperature_{motion}_unbiased"][late:])
        if mean is None or error is None:
            return inf
        means.append(mean)
        errors.append(error)
    return abs(means[0] - means[1]) / hypot(*errors)


@case(6, "kinetic energy, standard errors from the canonical mean", "fs")
def thermostat(quick: bool) -> Iterator[Trial]:
    """The thermostat with dt / tau from 1e-12 to 1e6: little heat when weak, the canonical mean
    when strong."""
    step, steps = 0.5, 200
    for ratio in (1e-12, 1e6) if quick else [10.0**k for k in range(-12, 7, 3)]:
        if is_weak := steps * ratio < 1e-3:
            error = partial(added_heat, ratio)
        else:
            error = distance_from_mean if ratio >= 1 else largest_kinetic_energy
        run = partial(
            run_scene,
            water("spce"),
            steps=steps,
            samples=steps,
            thermostat=nvt(298.0, step / ratio),
            state=liquid("spce"),
            error=error,
        )
        yield Trial(f"dt/tau = {ratio:.0e}", run, step, 1.0 if is_weak else 5.0, [SPLIT])


def added_heat(ratio: float, results: Results) -> float:
    """Heat of a weak thermostat in ten standard deviations of its noise, 2 sqrt(dt/tau / FREEDOM)
    per step."""
    kinetic = results["kinetic"]
    heat = np.abs(results["energy"] - results["conserved"]).max() / kinetic[0]
    return heat / (10 * sqrt(4 * ratio * (len(kinetic) - 1) / FREEDOM))


def largest_kinetic_energy(results: Results) -> float:
    """0 if all kinetic energies are finite."""
    return 0.0 if np.isfinite(results["kinetic"]).all() else inf


def distance_from_mean(results: Results) -> float:
    """Of the mean kinetic energy from the canonical one, in standard errors of independent
    samples."""
    kinetic = results["kinetic"][1:]
    return abs(kinetic.mean() / kinetic_energy(298.0) - 1) / sqrt(2 / FREEDOM / len(kinetic))
