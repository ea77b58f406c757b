"""Stages in the mean box of the stage before them."""

import numpy as np

from rigidmd.core.state import WORK, State
from rigidmd.engines.observables import observe
from rigidmd.engines.samples import Samples, equilibrated
from rigidmd.engines.system import System
from rigidmd.formats.cells import cell_of
from rigidmd.scene.validation import not_none

A3_PER_NM3 = 1000.0


def scale_to_mean_box(system: System, state: State, samples: Samples, k: int) -> None:
    """Scale a state before stage k, in place, if this stage continues in the mean box of the stage
    before.

    The new box has the mean volume, the mean angles and the ratios of the mean edges in the
    equilibrated part of that stage. Centres of mass are scaled with it. Molecules do not rotate,
    and momenta do not change. The change of the energy is added to the energy ledger as work.
    """
    if not k or not system.scene.stages[k].volume:
        return
    steady = equilibrated(samples.of_stage(k - 1), system.scene.stages[k - 1])
    mean = not_none(
        cell_of([float(steady[name].mean()) for name in ("a", "b", "c", "alpha", "beta", "gamma")])
    )
    cell = np.where(state.cell == 0, 0.0, mean)  # right angles stay exact
    cell *= np.cbrt(A3_PER_NM3 * steady["volume"].mean() / np.prod(np.diag(cell)))
    engine = system.engine()
    before = observe(system, engine, state, energy_unit=1.0).potential
    state.position[:] = state.position @ np.tril(np.linalg.solve(state.cell, cell))
    state.cell[:] = cell
    state.energy_ledger[WORK] += observe(system, engine, state, energy_unit=1.0).potential - before
