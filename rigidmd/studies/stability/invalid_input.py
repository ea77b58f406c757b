"""Stability cases: invalid molecules, and NaN and infinity in scenes."""

import copy
from collections.abc import Iterator
from math import inf, nan

from rigidmd.studies.stability.cases import (
    EXACT,
    SPLIT,
    body_scene,
    molecules_scene,
    register_case,
    run_invalid,
    run_molecules,
)
from rigidmd.studies.stability.molecules import BOX, FORCES, bent, from_file, pair_of
from rigidmd.studies.stability.outcomes import REFUSED, CaseResult


@register_case(13, error="energy error over kinetic energy", step="fs")
def strange_molecules(result: CaseResult, quick: bool) -> None:
    """Coinciding sites, a straight molecule along a diagonal, no mass, negative mass, mass at one point only."""

    def scene(change) -> dict:
        kind = bent() | {"count": 8}
        change(kind["sites"])
        return molecules_scene([kind], BOX, 1.0, 50, SPLIT, 300.0, None, FORCES)

    def set_position(sites, k, position):
        sites[k]["position_A"] = position

    def set_masses(sites, *values):
        for site, value in zip(sites, values, strict=True):
            site["mass_u"] = value

    changes = {
        "two coinciding sites": lambda s: set_position(s, 1, [-1.0, 0.0, 0.0]),
        "two sites at 1e-9 Å": lambda s: set_position(s, 1, [-1.0, 1e-9, 0.0]),
        "all sites coinciding": lambda s: [set_position(s, k, [0.0, 0.0, 0.0]) for k in range(3)],
        "no mass": lambda s: set_masses(s, 0.0, 0.0, 0.0),
        "negative mass": lambda s: set_masses(s, 12.0, -1.0, 12.0),
        "all mass in one site": lambda s: set_masses(s, 0.0, 12.0, 0.0),
        "massless site off a line of masses": lambda s: set_masses(s, 12.0, 0.0, 12.0),
    }
    for setting, change in changes.items():
        result.add(setting, run_invalid(scene(change)), 0.0, SPLIT, expected=(REFUSED,))

    def slanted(sites):
        for site, k in zip(sites, (-1.0, 0.0, 1.0), strict=True):
            site["position_A"] = [0.1 + 0.3 * k, 0.2 + 0.7 * k, 0.3 - 0.9 * k]

    result.add("a straight molecule given in space", run_molecules(scene(slanted)), 0.05, SPLIT)


def numbers(data, keys: tuple = ()) -> Iterator[tuple]:
    """The path of every number in nested tables and lists."""
    if isinstance(data, dict | list):
        for key, value in data.items() if isinstance(data, dict) else enumerate(data):
            yield from numbers(value, (*keys, key))
    elif isinstance(data, int | float) and not isinstance(data, bool):
        yield keys


def replaced(data: dict, keys: tuple, value) -> dict:
    """A copy with one entry changed."""
    other = copy.deepcopy(data)
    inner = other
    for key in keys[:-1]:
        inner = inner[key]
    inner[keys[-1]] = value
    return other


@register_case(13)
def no_numbers(result: CaseResult, quick: bool) -> None:
    """NaN and infinity in place of every number of a scene of molecules, of a body, and in structures."""
    heat = {"temperature_K": 300.0, "thermostat_time_ps": 0.1}
    molecules = molecules_scene([bent() | {"count": 8}], BOX, 1.0, 10, SPLIT, 300.0, heat, FORCES | {"skin_A": 1.0})
    tables = {
        "body": {"mass_kg": 1.0, "inertia_kg_m2": [1.0, 1.5, 2.0], "pinned": True, "centre_of_mass_m": [0.0, 0.1, 0.2]},
        "start": {"euler_angles_deg": [1.0, 2.0, 3.0], "angular_velocity_body_rad_s": [1.0, 2.0, 3.0]},
        "gravity": {"acceleration_m_s2": [0.0, 0.0, -9.81]},
        "friction": {"viscous_N_m_s": [0.1, 0.1, 0.1], "dry_N_m": [0.1, 0.1, 0.1]},
        "applied": [{"torque_N_m": [0.1, 0.2, 0.3], "from_s": 0.1, "to_s": 0.2}],
    }
    body = body_scene(tables, 0.01, 1.0, EXACT)
    for setting, data in (("molecules", molecules), ("body", body)):
        for keys in numbers(data):
            for value in (nan, inf, -inf):
                outcome = run_invalid(replaced(data, keys, value))
                result.add(
                    f"{setting}, {'.'.join(map(str, keys))} = {value}", outcome, 0.0, setting, expected=(REFUSED,)
                )
    species, state = pair_of(5.0, 0.1)
    file = molecules_scene(species, BOX, 1.0, 10, SPLIT, None, None, FORCES)
    for part in ("position", "velocity", "rotation", "angular_momentum_body"):
        for value in (nan, inf):
            bad = state.copy()
            getattr(bad, part)[1] = value
            result.add(
                f"structure, {part} = {value}", from_file(file, bad, True), 0.0, "structure", expected=(REFUSED,)
            )
