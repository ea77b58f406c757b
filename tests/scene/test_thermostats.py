"""Thermostats and barostats in scenes: errors, and what it takes to add one."""

import sys
import tomllib
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest
from support.common import ROOT, small_scene

import rigidmd
from rigidmd.assemble.stage_description import describe_stage
from rigidmd.compile import implements
from rigidmd.dynamics import barostats
from rigidmd.errors import SceneError
from rigidmd.forces.terms import FORCES_ONLY
from rigidmd.run import Simulation
from rigidmd.scene import ensembles, schema
from rigidmd.scene.ensemble_methods import Barostat, Thermostat


@pytest.mark.parametrize(
    ("stage", "message"),
    [
        (
            "ensemble = 'nvt'\ntemperature_K = 300.0\nthermostat = 'berendsen'",
            "samples no ensemble.*The thermostats are velocity_rescaling, langevin, nose_hoover, andersen, hybrid_monte_carlo$",
        ),
        (
            "ensemble = 'nvt'\ntemperature_K = 300.0\nfriction_translation_per_ps = 1.0",
            "would have no effect with velo",
        ),
        (
            "ensemble = 'nvt'\ntemperature_K = 300.0\nthermostat = 'langevin'\nfriction_translation_per_ps = 0.0",
            "must be greater than 0",
        ),
        (
            "ensemble = 'nvt'\ntemperature_K = 300.0\nthermostat_time_ps = 0.0",
            "must be greater than 0",
        ),
        ("ensemble = 'nvt'", "needs temperature_K"),
        ("temperature_K = 300.0", "would have no effect in an nve stage"),
        ("integrator = 'baoab'", "contains a thermostat"),
        ("ensemble = 'npt'\ntemperature_K = 300.0", "needs pressure_bar"),
        (
            "ensemble = 'npt'\ntemperature_K = 300.0\npressure_bar = [1.0, 1.0, 2.0]",
            "'anisotropic'",
        ),
        (
            "ensemble = 'npt'\ntemperature_K = 300.0\npressure_bar = 1.0\nbarostat = 'berendsen'",
            "samples no",
        ),
        ("ensemble = 'nph'\npressure_bar = 1.0\nintegrator = 'srkn_4'", "made of Verlet steps"),
        (
            "ensemble = 'npt'\ntemperature_K = 300.0\npressure_bar = 1.0\nbarostat_time_ps = 0.0",
            "greater than 0",
        ),
        (
            "ensemble = 'npt'\ntemperature_K = 300.0\npressure_bar = 1.0\nthermostat = 'langevin'\nbarostat = 'monte_carlo'\nbarostat_time_ps = 1.0",
            "barostat_time_ps would have no effect with monte_carlo$",
        ),
        (
            "ensemble = 'npt'\ntemperature_K = 300.0\npressure_bar = 1.0\nnose_hoover_links = 4",
            "nose_hoover_links would have no effect with velocity_rescaling$",
        ),
        (
            "ensemble = 'npt'\ntemperature_K = 300.0\npressure_bar = 1.0\nbarostat = 'monte_carlo'\nbarostat_time_ps = 1.0\nnose_hoover_links = 4",
            "nose_hoover_links, barostat_time_ps would have no effect with velocity_rescaling and monte_carlo$",
        ),
    ],
)
def test_stages_that_cannot_be(stage, message):
    stage = tomllib.loads(stage)
    with pytest.raises(SceneError, match=message):
        small_scene({"argon": 20}, 30.0, stages=[{"duration_ps": 0.01} | stage])


class Braking(NamedTuple):
    """A made-up thermostat that slows all molecules down."""

    time: float


@rigidmd.compiled_thermostat(Braking)
def brake(thermostat, model, state, h, draw):
    factor = np.exp(-h / thermostat.time)
    for m in range(len(state.velocity)):
        for k in range(3):
            before = state.velocity[m, k]
            state.velocity[m, k] *= factor
            state.energy_ledger[0] -= (
                0.5 * model.mass[model.species[m]] * (before**2 - state.velocity[m, k] ** 2)
            )


class Brake(Thermostat):
    name = "braking"
    summary = "a brake"
    source = "nobody 2000"
    on_molecules = True

    def defaults(self, stage):
        return {"thermostat_time_ps": 0.25}


class Swelling(NamedTuple):
    """A made-up barostat with trial moves, all of which are accepted."""

    strain: float
    tail: tuple
    key: tuple

    forces = FORCES_ONLY

    def rows(self, parts, timing):
        return barostats.rows_of_moves(self, parts, timing)


@implements(barostats.propose_strain, Swelling)
def propose_swelling(barostat, model, state, workspace, h, draw):
    for k in range(3):
        workspace.strain[0, k] = barostat.strain
    barostats.set_matrices(workspace)
    return True


@implements(barostats.rescale_velocities, Swelling)
def keep_velocities(barostat, state, workspace):
    return None


@implements(barostats.log_acceptance, Swelling)
def accept_swelling(barostat, model, state, workspace, h):
    return 0.1


class Balloon(Barostat):
    name = "swelling"
    summary = "a balloon"
    source = "nobody 2000"
    shapes = ("isotropic",)

    def defaults(self, stage):
        return {"barostat_interval_ps": 0.01}


def test_adding_a_thermostat_and_a_barostat(monkeypatch):
    """A file of the scene and a file of the flow: all that knows their names follows."""
    stage = {
        "ensemble": "npt",
        "temperature_K": 300.0,
        "pressure_bar": 1.0,
        "duration_ps": 0.02,
        "barostat_interval_ps": 0.01,
    }
    stage |= {"thermostat": "braking", "barostat": "swelling"}
    with pytest.raises(SceneError, match="'braking', must be 'velocity_rescaling', "):
        small_scene({"argon": 20}, 40.0, stages=[stage])
    monkeypatch.setitem(ensembles.THERMOSTATS, "braking", Brake())
    monkeypatch.setitem(ensembles.BAROSTATS, "swelling", Balloon())
    monkeypatch.setitem(
        sys.modules,
        "rigidmd.dynamics.thermostats.braking",
        SimpleNamespace(thermostat=lambda stage, *given: Braking(stage.thermostat_time)),
    )
    monkeypatch.setitem(
        sys.modules,
        "rigidmd.dynamics.barostats.swelling",
        SimpleNamespace(barostat=lambda stage, given: Swelling(0.01, given.tail, given.key)),
    )
    properties = schema()["$defs"]["Stage"]["properties"]
    assert (
        "braking" in properties["thermostat"]["enum"]
        and "swelling" in properties["barostat"]["enum"]
    )
    for wrong, message in (
        (
            {"nose_hoover_links": 4, "barostat_time_ps": 1.0},
            "nose_hoover_links, barostat_time_ps would have no effect with braking and swelling",
        ),
        (
            {"pressure_coupling": "flexible"},
            "'swelling' allows only an isotropic pressure; cell_rescaling allows others",
        ),
        (
            {"ensemble": "nph", "temperature_K": None, "thermostat": None},
            "'swelling' is for npt; nph has piston",
        ),
    ):
        with pytest.raises(SceneError, match=message):
            small_scene(
                {"argon": 20},
                40.0,
                stages=[{k: v for k, v in (stage | wrong).items() if v is not None}],
            )
    scene = rigidmd.with_defaults(
        small_scene({"argon": 20}, 40.0, forces={"lennard_jones": False}, stages=[stage])
    )
    assert (scene.stages[0].thermostat_time_ps, scene.stages[0].barostat_time_ps) == (0.25, None)
    described = " ".join(describe_stage(scene.stages[0]))
    assert (
        "300 K by braking, 0.25 ps, 1 bar by swelling, isotropic, a move every 5 steps" in described
    )
    assert "not the total momentum" in described
    results = Simulation(scene).run()
    assert results["kinetic"][-1] == pytest.approx(
        results["kinetic"][0] * np.exp(-2 * 0.02 / 0.25), rel=1e-9
    )
    assert results["volume"][-1] == pytest.approx(results["volume"][0] * np.exp(2 * 0.03), rel=1e-9)
    assert results["conserved"][-1] == pytest.approx(results["conserved"][0], rel=1e-9)


@pytest.mark.parametrize(
    ("kinds", "folder"),
    [(ensembles.THERMOSTATS, "thermostats"), (ensembles.BAROSTATS, "barostats")],
)
def test_adding_a_thermostat_or_barostat_takes_two_files(kinds, folder):
    """No other file of the core has their names, but for that of langevin."""
    package = ROOT / "rigidmd"
    for path in package.rglob("*.py"):
        where = path.relative_to(package).as_posix()
        others = [
            name
            for name in kinds
            if where not in (f"scene/{folder}/{name}.py", f"dynamics/{folder}/{name}.py")
            and name != "langevin"
        ]
        if not where.startswith("features/"):
            text = path.read_text(encoding="utf-8")
            assert not [name for name in others if f'"{name}"' in text], where
    documents = (package / "docs" / "guides" / "ensembles.md").read_text(encoding="utf-8")
    for name, kind in kinds.items():
        assert f'`"{name}"`' in documents
        assert kind.source.partition(f" {kind.year}")[0].partition(",")[0] in documents
