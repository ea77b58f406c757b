"""What thermostats evolve besides momenta: it outlives a stop."""

import numpy as np
from support.common import small_scene
from support.stops import same_after_stops

from rigidmd.assemble.build import build
from rigidmd.core.state import State
from rigidmd.run.resume import state_from

WATER = {
    "box": {"density_g_cm3": 0.9},
    "molecules": [{"model": "spce", "count": 40}],
    "forces": {"cutoff_A": 5.0, "truncation": "smooth_switch"},
    "start": {"temperature_K": 298.0},
    "output": {"log_interval_ps": 0.013, "trajectory_interval_ps": 0.02, "figures": False},
}
CHAINS = {
    "ensemble": "nvt",
    "temperature_K": 298.0,
    "thermostat": "nose_hoover",
    "thermostat_time_ps": 0.05,
}


def test_chains_go_on_to_the_same_bits_in_double_precision(tmp_path):
    """A short period, so that the chains have swung when the run stops."""
    stage = CHAINS | {"duration_ps": 0.06, "timestep_fs": 1.0}
    same_after_stops(WATER | {"stages": [stage], "precision": "double"}, [17, 41], tmp_path)


def test_a_checkpoint_gives_back_all_of_a_state():
    system = build(small_scene({"spce": 3}, 12.0, forces={"cutoff_A": 5.0}))
    rng = np.random.default_rng(1)
    state = system.state._replace(extra_variables=rng.standard_normal(12))
    for array in (state.position, state.velocity, state.angular_momentum_body, state.energy_ledger):
        array[:] = rng.standard_normal(array.shape)
    found = state_from(
        {name: array.copy() for name, array in zip(State._fields, state, strict=True)}, state
    )
    for name, a, b in zip(state._fields, found, state, strict=True):
        assert a.tobytes() == b.tobytes(), name
