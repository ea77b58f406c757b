"""The pair loop: sums in common, checks of compiled code."""

import numpy as np
import pytest
from support.common import built, move

from rigidmd.core.integrators import SCHEMES
from rigidmd.core.state import no_load
from rigidmd.engines.cpu.engine import CpuEngine as Engine
from rigidmd.forces.terms import WITH_ENERGIES, TermDispatcher


@pytest.mark.parametrize("field", ["position", "velocity", "rotation", "step"])
def test_code_is_not_run_on_arrays_that_it_was_not_compiled_for(field):
    """Five argon atoms without forces and with `position` in Fortran's order once went astray
    without a word."""
    system, _, state = built({"argon": 5} if field != "rotation" else {"spce": 5}, 40.0)
    array = getattr(state, field)
    strange = np.asfortranarray(array) if array.ndim > 1 else array.astype(np.int32)
    engine = Engine(system.model, {})
    with pytest.raises(TypeError, match=f"state.{field} must be a contiguous, writable array of"):
        move(engine, state._replace(**{field: strange}), SCHEMES["velocity_verlet"], 0.01, 10)


def test_an_address_is_held_to_the_type_it_was_compiled_for():
    _, engine, state = built({"argon": 5}, 40.0)
    engine.evaluate(state)
    own = engine.workspaces["lennard_jones"]
    sites = own.sites._replace(first=own.sites.first.astype(np.int64))
    loading = TermDispatcher((own,), WITH_ENERGIES)
    with pytest.raises(TypeError, match="set_local was compiled for task_arguments"):
        loading.bind((own._replace(sites=sites),), state, no_load(state))
