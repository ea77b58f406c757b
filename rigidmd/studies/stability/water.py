"""Stability cases: water from 0 K to 1e5 K, its longest steps, equipartition, the thermostat."""

from functools import cache
from math import hypot, sqrt

import numpy as np

from rigidmd.core.state import State
from rigidmd.core.statistics import mean_and_error
from rigidmd.run.results import Results
from rigidmd.scene.validation import not_none
from rigidmd.studies.stability.cases import (
    QUICK,
    REFUSED,
    REPORTED,
    RIGHT,
    SPLIT,
    CaseResult,
    Outcome,
    longest_step,
    molecules_scene,
    register,
    run_molecules,
    simulate,
)
from rigidmd.studies.stability.molecules import WATER_FORCES, bent
from rigidmd.units import BOLTZMANN, KJ_PER_MOL

WATERS = 64
FREEDOM = 6 * WATERS - 3
#: Steps (fs); the first is nominal.
STEPS = (0.5, 1.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0)
#: TIP4P at 300 K becomes unstable near this step, fs (Davidchack 2010, J. Comput. Phys. 229, 9323).
PUBLISHED = 10.0


@cache
def liquid(model: str) -> State:
    """A state of water after 0.5 ps at 298 K, from a lattice."""
    with np.errstate(all="ignore"):
        return simulate(
            water_scene(model, 1.0, 500, SPLIT, 298.0, weak_thermostat(298.0, 1.0))
        ).state


def weak_thermostat(temperature: float, step: float) -> dict:
    """A thermostat with a time of 20 steps (fs)."""
    return {"temperature_K": float(temperature), "thermostat_time_ps": 20 * step / 1000}


def water_scene(model: str, *settings, **more) -> dict:
    """`molecules_scene` of a box of water. TIP4P of 1983 is not a shipped model."""
    kind = {"name": "tip4p", "sites": TIP4P} if model == "tip4p" else {"model": model}
    return molecules_scene(
        [kind | {"count": WATERS}], {"density_g_cm3": 0.997}, *settings, forces=WATER_FORCES, **more
    )


TIP4P = [
    {
        "name": "OW",
        "element": "O",
        "mass_u": 15.9994,
        "position_A": [0.0] * 3,
        "sigma_A": 3.154,
        "epsilon_K": 78.0,
    },
    {
        "name": "HW1",
        "element": "H",
        "mass_u": 1.008,
        "position_A": [0.756950, 0.585882, 0.0],
        "charge_e": 0.52,
    },
    {
        "name": "HW2",
        "element": "H",
        "mass_u": 1.008,
        "position_A": [-0.756950, 0.585882, 0.0],
        "charge_e": 0.52,
    },
    {"name": "MW", "mass_u": 0.0, "position_A": [0.0, 0.15, 0.0], "charge_e": -1.04},
]


@register(9, error="energy error over kinetic energy (at 1 K, of that at 0 K)", step="fs")
def water_steps(result: CaseResult, quick: bool) -> None:
    """Water at 0 K, 10 K, 298 K, 1000 K and 1e5 K: right at a short step, and the longest step that
    is bounded."""
    for temperature in (298.0,) if quick else (0.0, 10.0, 298.0, 1000.0, 1e5):
        # a hundredth of an ångström at thermal speed, but stable for librations
        step = min(0.5, 0.5 * (1000.0 / max(temperature, 1.0)) ** 0.5)
        state = frozen() if temperature == 0 else warm("spce", temperature, step)
        scale = 0.5 * FREEDOM * BOLTZMANN / KJ_PER_MOL * max(temperature, 1.0)
        for family in QUICK:
            span = (500 if quick else 1000) * step

            def at(h: float, family=family, state=state, scale=scale, span=span) -> Outcome:
                return run_molecules(
                    water_scene("spce", h, max(200, round(span / h)), family, 0.0),
                    state,
                    scale=scale,
                )

            result.add(f"{temperature:g} K", at(step), 0.02, family, step)
            result.limits.append(longest_step(at, step, f"{temperature:g} K", family))


@register(9, error="energy error over kinetic energy", step="fs")
def tip4p_steps(result: CaseResult, quick: bool) -> None:
    """TIP4P at 300 K at 0.5 to 12 fs; according to the literature it is unstable near 10 fs."""
    state = warm("tip4p", 300.0, 1.0)
    scale = 0.5 * FREEDOM * BOLTZMANN / KJ_PER_MOL * 300.0
    for family in (SPLIT,) if quick else QUICK:

        def at(h: float, family=family) -> Outcome:
            return run_molecules(
                water_scene("tip4p", h, 300 if quick else 1000, family, 0.0), state, scale=scale
            )

        for step in STEPS[:1] if quick else STEPS:
            allowed, expected = 0.02 if step <= 1 else 1.0, (RIGHT, REPORTED, REFUSED)
            result.add(f"{step:g} fs", at(step), allowed, family, step, expected)
        limit = longest_step(at, 4.0, "300 K", family)
        result.limits.append(limit)
        published = f"(published for rigid TIP4P: near {PUBLISHED:g} fs)"
        result.notes.append(f"{family}: bounded to {limit.longest:.3g} fs {published}")


def warm(model: str, temperature: float, step: float) -> State:
    """Liquid water at a temperature, reached from 298 K."""
    if temperature == 298.0:
        return liquid(model)
    data = water_scene(model, step, 1000, SPLIT, None, weak_thermostat(temperature, step))
    return simulate(data, liquid(model)).state


def frozen() -> State:
    """Water at rest in a minimum of its energy."""
    minimum = {"ensemble": "minimise"}
    state = simulate(water_scene("spce", 0.5, 20) | {"stages": [minimum]}, liquid("spce")).state
    state.velocity[:] = 0.0
    state.angular_momentum_body[:] = 0.0
    return state


@register(14, error="T_rot - T_trans, in its standard errors", step="fs")
def equipartition(result: CaseResult, quick: bool) -> None:
    """T_trans = T_rot in NVT for linear, symmetric, asymmetric bodies and a mixture with points, at
    two steps."""
    site = {"mass_u": 12.0, "sigma_A": 3.2, "epsilon_K": 80.0}
    corners = [[1.0, 0.0, 0.0], [-0.5, 0.75**0.5, 0.0], [-0.5, -(0.75**0.5), 0.0]]
    ring = [
        site | {"name": f"R{k}", "position_A": p, "charge_e": q}
        for k, (p, q) in enumerate(zip(corners, (0.2, 0.2, -0.4), strict=True))
    ]
    species = {
        "asymmetric": bent(0.5),
        "linear": bent(0.0, "linear"),
        "symmetric": {"name": "ring", "sites": ring},
    }
    points = {"name": "point", "sites": [site | {"name": "P", "position_A": [0.0, 0.0, 0.0]}]}
    mixture = [kind | {"count": 12} for kind in (*species.values(), points)]
    settings = {} if quick else {name: [kind | {"count": 48}] for name, kind in species.items()}
    settings |= {"mixture": mixture}

    def gap(results: Results) -> float:
        late = len(results["time"]) // 5
        series = (results[f"temperature_{motion}"][late:] for motion in ("rotation", "translation"))
        (rotation, its_error), (translation, error) = (
            map(not_none, mean_and_error(values)) for values in series
        )
        return abs(rotation - translation) / hypot(its_error, error)

    for setting, molecules in settings.items():
        for step in (2.0, 8.0):
            steps = 4000 if quick else 10000
            heat = {"temperature_K": 400.0, "thermostat_time_ps": 0.1}
            data = molecules_scene(
                molecules,
                {"lengths_A": 16.0},
                step,
                steps,
                SPLIT,
                400.0,
                heat,
                {"cutoff_A": 8.0},
                samples=steps // 10,
            )
            result.add(f"{setting}, {step:g} fs", run_molecules(data, error=gap), 4.0, SPLIT, step)


@register(6, error="kinetic energy, standard errors from the canonical mean")
def thermostat(result: CaseResult, quick: bool) -> None:
    """The thermostat with dt / tau from 1e-12 to 1e6: little heat when weak, the canonical mean
    when strong."""
    state = liquid("spce")
    for ratio in (1e-12, 1e6) if quick else [10.0**k for k in range(-12, 7, 3)]:
        step, steps = 0.5, 200
        heat = {"temperature_K": 298.0, "thermostat_time_ps": step / 1000 / ratio}
        data = water_scene("spce", step, steps, SPLIT, 298.0, heat, samples=steps)
        weak = steps * ratio < 1e-3

        def error(results, weak=weak, ratio=ratio, steps=steps) -> float:
            kinetic = results["kinetic"]
            heat_added = np.abs(results["energy"] - results["conserved"]).max() / kinetic[0]
            # heat in a step: at most some ten standard deviations of its noise,
            # 2 sqrt(dt/tau / FREEDOM)
            if weak:
                return heat_added / (10 * sqrt(4 * ratio * steps / FREEDOM))
            if ratio < 1:
                return 0.0 if np.isfinite(kinetic).all() else np.inf
            ratio = kinetic[1:].mean() / (0.5 * FREEDOM * 298.0 * 0.008314462618)
            return abs(ratio - 1) / sqrt(2 / FREEDOM / steps)

        result.add(
            f"dt/tau = {ratio:.0e}",
            run_molecules(data, state, error),
            1.0 if weak else 5.0,
            SPLIT,
            step,
        )
