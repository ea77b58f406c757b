"""Systems for pilot runs and for `rigidmd accuracy`: the start of a scene with every method that
can move it."""

from functools import partial
from math import inf

import numpy as np

from rigidmd.assemble.time_step import error_of_step, precision_for
from rigidmd.core.integrators import FORMULATIONS, SOLVERS, Scheme
from rigidmd.core.state import State
from rigidmd.engines.observables import observe
from rigidmd.engines.protocol import Engine
from rigidmd.engines.system import System
from rigidmd.run.trials import Method, TrialSystem
from rigidmd.units import BOLTZMANN, FEMTOSECOND

#: General ODE solvers for the textbook equations of rotation, for comparison with the engine's
#: schemes.
COMPARATORS = {
    solver if form == "matrix" else f"{solver}_{form}": (solver, form)
    for solver in SOLVERS
    for form in FORMULATIONS
}
#: Why they do not move molecules.
NOT_MOLECULAR = "it is for single bodies"
SPAN_PS = 0.1


def molecular_trial_system(
    system: System, start: State, rotor: str | None, span: float
) -> TrialSystem:
    """Molecules that start at a state and run for `span` ps."""
    state = start.copy()
    state.step[:] = 0
    state.begin_segment(0.0)
    kinetic = observe(system, system.engine(), state, energy_unit=1.0).kinetic
    freedom = max(system.freedom.total, 1)
    thermal = 2 * kinetic / freedom
    mass = system.model.mass[system.model.species]
    boxed = system.space.volume < inf
    conserved = system.model.keeps_momentum

    def engine(scheme: Scheme, timestep_fs: float) -> Engine:
        """With precision = "auto" each trial has the precision of a run with its step."""
        if not system.precision_reason:
            return system.engine()
        error = error_of_step(system.species, thermal / BOLTZMANN, scheme, timestep_fs)
        return system.engine_of(system.terms, precision_for(error))

    def conserved_errors(now: State) -> dict[str, float]:
        """Errors of the conserved components of the total momentum and, with neither box nor
        fields, of the angular momentum, relative to the sums of their sizes."""
        errors = {}
        if conserved.any():
            before, after = (
                mass[:, None] * velocity[:, conserved]
                for velocity in (state.velocity, now.velocity)
            )
            errors["momentum"] = _change(before, after)
        if conserved.all() and not (boxed or system.external):
            errors["L"] = _change(_angular_momenta(state, mass), _angular_momenta(now, mass))
        return errors

    return TrialSystem(
        name=system.scene.name,
        state=state,
        methods={
            name: Method(
                partial(engine, scheme), scheme if scheme.exact_rotor else scheme.with_rotor(rotor)
            )
            for name, scheme in system.scene.schemes.items()
        },
        energy=lambda engine, now: observe(system, engine, now, energy_unit=1.0).conserved,
        energy_unit="kT per degree of freedom",
        energy_note=f", at the {thermal / BOLTZMANN:.3g} K of the start",
        energy_size=freedom * thermal or 1.0,
        kinetic=kinetic or 1.0,
        span=span,
        time_unit="fs",
        time_size=FEMTOSECOND,
        length_unit="Å",
        reference="srkn_6",
        conserved_errors=conserved_errors,
        can_continue=True,
        refused=dict.fromkeys(COMPARATORS, NOT_MOLECULAR),
        freedom=freedom,
        chooses_precision=bool(system.precision_reason),
    )


def _change(before: np.ndarray, after: np.ndarray) -> float:
    """Change of a vector sum over molecules (n, 3), relative to the sum of the lengths."""
    return float(
        np.linalg.norm((after - before).sum(axis=0)) / (np.linalg.norm(before, axis=1).sum() or 1.0)
    )


def _angular_momenta(state: State, mass: np.ndarray) -> np.ndarray:
    """Angular momenta (n, 3) of molecules about the origin, lab frame."""
    momenta = np.cross(state.position, mass[:, None] * state.velocity)
    if len(state.rotation):
        momenta += np.einsum("nij,nj->ni", state.rotation, state.angular_momentum_body)
    return momenta
