"""The engine of a single body that runs compiled code on the CPU."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rigidmd.core.integrators import Scheme
from rigidmd.core.state import Load, State
from rigidmd.dynamics.force_gradient import GradientWorkspace, gradient_workspace
from rigidmd.engines.cpu.compiled import CompiledEngine, Steps
from rigidmd.features.bodies.step_loop import LOADED, Body, FlowArrays, advance_body, flow_arrays
from rigidmd.forces.terms import Setup


class BodyEngine(CompiledEngine[Body, tuple[FlowArrays, GradientWorkspace | None, np.ndarray]]):
    """An engine of a single body, which has no pairs and one thread. For the arguments see
    `CompiledEngine`."""

    def __init__(
        self,
        model: Body,
        terms: dict[str, NamedTuple],
        python_forces: dict[str, Callable] | None = None,
    ):
        setup = Setup(np.zeros((3, 3)), np.float64, skin=0.0, needs_virials=False)
        super().__init__(model, terms, setup, python_forces)

    def _move(
        self, state: State, load: Load, integrator: Scheme, workspaces: tuple, step: Steps
    ) -> bool:
        def bound() -> tuple[FlowArrays, GradientWorkspace | None, np.ndarray]:
            gradient = gradient_workspace(state) if integrator.has_gradient else None
            return flow_arrays(integrator), gradient, np.zeros(2, np.int64)

        flows, gradient, progress = self._bind((integrator, state, load), bound)
        model, (dt, until, _) = self.model_for(integrator), step
        # the load of a kick with gradient still belongs to the positions if it did before
        progress[:] = 0, max(1, progress[LOADED]) if self._last.is_current else 0
        while status := advance_body(
            model, state, load, workspaces, flows, gradient, dt, until, progress
        ):
            workspaces = self._handle_status(status, state)
        # also False after no step, because then no forces were evaluated
        return progress[LOADED] != 0
