"""The table of a step: its rows, in their order, and the steps in which each acts."""

import re

import pytest
from support.common import built

from rigidmd.assemble.build import integrator_of_stage
from rigidmd.core.integrators import SCHEMES
from rigidmd.engines.cpu.program import program_of_step

NVT = {"ensemble": "nvt", "temperature_K": 100.0, "duration_ps": 0.1, "timestep_fs": 1.0}
NPT = NVT | {"ensemble": "npt", "pressure_bar": 1.0, "barostat_interval_ps": 0.012}
VERLET = {"integrator": "velocity_verlet"}
NPH = {"ensemble": "nph", "pressure_bar": 1.0, "duration_ps": 0.1, "timestep_fs": 1.0}
HYBRID = {"thermostat": "hybrid_monte_carlo", "trajectory_steps": 4} | VERLET
ORTHOGONAL = "orthogonality of rotations | 1 of 256 steps"
ENERGIES = "forces, energies and virials"
FIRST = ["forces | first", "kick 0.5 dt, drift 1 dt | first"]
REPEATED = ["kick 0.5 dt, kick 0.5 dt, drift 1 dt | repeated", ORTHOGONAL]
FORCES = ["forces | without energies", f"{ENERGIES} | with energies"]
LAST = "kick 0.5 dt | last"
POWER = "power of the forces | before a sample"
TABLES = {
    "velocity Verlet": (VERLET | {"ensemble": "nve"}, [*FIRST, *REPEATED, *FORCES, LAST]),
    "langevin with cell rescaling": (
        NPT | {"thermostat": "langevin", "barostat": "cell_rescaling"},
        [
            "forces | first",
            POWER,
            "kick 0.5 dt, drift 0.5 dt | first",
            "kick 0.5 dt, kick 0.5 dt, drift 0.5 dt | repeated",
            "thermostat Langevin 1 dt",
            "drift 0.5 dt",
            ORTHOGONAL,
            *FORCES,
            LAST,
            "barostat CellRescaling 12 dt: trial move of the box | last of 12 steps",
            f"{ENERGIES} | last of 12 steps",
            "accept it, or move the box back | last of 12 steps",
        ],
    ),
    "nose_hoover, halved": (
        NVT | VERLET | {"thermostat": "nose_hoover"},
        [
            "thermostat NoseHoover 0.5 dt",
            "forces | first",
            POWER,
            "kick 0.5 dt, drift 1 dt",
            ORTHOGONAL,
            *FORCES,
            "kick 0.5 dt",
            "thermostat NoseHoover 0.5 dt",
        ],
    ),
    "piston": (
        NPH,
        [
            "forces and virials | first",
            "barostat Piston 0.5 dt: kick of the volume",
            "kick 0.5 dt",
            "drift of the volume 0.5 dt",
            "drift 1 dt",
            ORTHOGONAL,
            "drift of the volume 0.5 dt",
            "forces and virials | without energies",
            f"{ENERGIES} | with energies",
            "kick 0.5 dt",
            "barostat Piston 0.5 dt: kick of the volume",
        ],
    ),
    "force gradient": (
        {"ensemble": "nve", "integrator": "chin_4a"},
        [
            "forces | first",
            "kick 0.1667 dt, drift 0.5 dt | first",
            "kick 0.1667 dt, kick 0.1667 dt, drift 0.5 dt | repeated",
            "forces",
            "gradient of the forces, 0.04167 dt²",
            "kick 0.6667 dt, drift 0.5 dt",
            ORTHOGONAL,
            *FORCES,
            "kick 0.1667 dt | last",
        ],
    ),
    "trajectories with Monte Carlo moves of the box": (
        NPT | HYBRID | {"barostat": "monte_carlo"},
        [
            "thermostat HybridMonteCarlo 1 dt | first of 4 steps",
            f"{ENERGIES} | first of 4 steps",
            "start of a trajectory | first of 4 steps",
            *FIRST,
            *REPEATED,
            *FORCES,
            LAST,
            "accept the trajectory, or return to its start | last of 4 steps",
            f"{ENERGIES} | last of 12 steps",
            "barostat VolumeMoves 12 dt: trial move of the box | last of 12 steps",
            f"{ENERGIES} | last of 12 steps",
            "accept it, or move the box back | last of 12 steps",
            "potential energy in the box | last of 12 steps",
        ],
    ),
    "a splitting that begins with a drift": (
        {"ensemble": "nve", "integrator": "position_verlet"},
        ["drift 0.5 dt", "forces", "kick 1 dt, drift 0.5 dt", ORTHOGONAL],
    ),
}


def rows_of(engine, state, scheme):
    rows = program_of_step(engine, state, scheme)
    return [" | ".join(filter(None, (row.text, row.when))) for row in rows]


@pytest.mark.parametrize("name", TABLES)
def test_the_rows_of_a_step(name):
    stage, expected = TABLES[name]
    stage = {"duration_ps": 0.1, "timestep_fs": 1.0} | stage
    run = {"remove_momentum_interval_ps": False}
    forces = {"cutoff_A": 5.0, "electrostatics": "reaction_field"}
    system, engine, state = built({"spce": 4}, 14.0, forces=forces, stages=[stage], run=run)
    assert rows_of(engine, state, integrator_of_stage(system, 0)) == expected


@pytest.mark.parametrize("name", SCHEMES)
def test_kicks_and_drifts_of_a_step_sum_to_one(name):
    """Those of a repeated step; of a single one, which is the first and the last."""
    _, engine, state = built({"argon": 4}, 14.0, forces={"cutoff_A": 5.0})
    rows = rows_of(engine, state, SCHEMES[name])
    for acts in (("first", "last"), ("repeated",)):
        sums = {"kick": 0.0, "drift": 0.0}
        for text, _, when in (row.partition(" | ") for row in rows):
            if when in ("", *acts):
                for kind, fraction in re.findall(r"(kick|drift) (\S+) dt", text):
                    sums[kind] += float(fraction)
        assert list(sums.values()) == pytest.approx([1, 1], abs=2e-3)


def test_points_have_no_row_for_rotations():
    _, engine, state = built({"argon": 4}, 14.0, forces={"cutoff_A": 5.0})
    assert not any("rotations" in row for row in rows_of(engine, state, SCHEMES["srkn_4"]))


def test_the_work_of_a_field_that_oscillates_is_a_row():
    field = {"electric_V_per_nm": [0.0, 0.0, 0.1], "electric_frequency_per_ps": 0.5}
    _, engine, state = built({"spce": 4}, 14.0, forces={"cutoff_A": 5.0}, fields=field)
    rows = rows_of(engine, state, SCHEMES["velocity_verlet"])
    assert rows.count("work of time-dependent fields") == 2
