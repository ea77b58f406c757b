"""What OpenMM can express, and how."""

from math import inf, sqrt

import numpy as np

from rigidmd.engines.external import SPLIT, Key, Limit, Missing, Translations, moves
from rigidmd.engines.force_field import ForceFieldView
from rigidmd.forces.ewald.errors import charges_in, pme_grid_for, real_error
from rigidmd.forces.ewald.pme import Pme
from rigidmd.forces.neighbors.space import cell_of
from rigidmd.forces.potentials.screened_coulomb import ScreenedCoulomb
from rigidmd.forces.potentials.truncation import TRUNCATIONS
from rigidmd.units import COULOMB

#: Order of OpenMM's splines.
PME_ORDER = 5


def grid_for(view: ForceFieldView, order: int) -> tuple[int, int, int] | None:
    """A grid for splines of an order with the accuracy of the scene's Ewald sum: the grid of the scene if the order of
    its splines is not higher. None if no grid reaches the accuracy."""
    system, law = view.system, view.coulomb
    pme = system.terms.get("coulomb_reciprocal")
    if isinstance(pme, Pme) and pme.order <= order:
        a, b, c = pme.grid
        return a, b, c
    if not isinstance(law, ScreenedCoulomb) or system.space.volume == inf:
        return None
    charges = charges_in(system.species, np.bincount(system.model.species, minlength=len(system.species)))
    real_space = real_error(charges, law.alpha, law.cutoff, system.space.volume)
    error = sqrt(max((system.force_error or 0.0) ** 2 / COULOMB**2 - real_space**2, 0.0))
    found = pme_grid_for(charges, law.alpha, cell_of(system.space), error, order)
    return None if found is None else found[0]


_INTEGRATOR, *_LIMITS = moves("OpenMM", "molecules")
_NO_GRID = f"no grid for OpenMM's splines, of order {PME_ORDER}, reaches the requested accuracy; request a lower one"

TRANSLATIONS = Translations(
    "OpenMM",
    scene=(
        Key("forces.truncation", dict.fromkeys(TRUNCATIONS, "formula"), matters=lambda view: view.is_truncated),
        Key("forces.reaction_field_truncation", dict.fromkeys((None, *TRUNCATIONS), "formula")),
        Key("forces.electrostatics", {
            "none": "", "coulomb": "", "reaction_field": "formula", "damped_shifted_force": "formula", "ewald": "PME",
            "pme": "PME",
        }, matters=lambda view: view.coulomb),
        Key("forces.ewald_truncation", {None: "", "plain": "", "shift": "energy of a step"}),
        Key("run.remove_momentum_interval_ps", {None: "", False: ""},
            "the engine openmm removes no momentum; leave it out"),
    ),
    stage=(
        Key("ensemble", {"nve": "", "nvt": "", "npt": "",
            "nph": Missing("OpenMM has no barostat without a thermostat")}),
        Key("thermostat", {None: "velocity Verlet", "nose_hoover": "NoseHooverIntegrator",
            "langevin": "LangevinMiddleIntegrator"}, "OpenMM has nose_hoover and langevin for constrained molecules"),
        Key("barostat", {None: "", "monte_carlo": "MonteCarloBarostat"},
            "OpenMM moves the box by monte_carlo, which is isotropic in a scene"),
        Key("pressure_coupling", {"isotropic": ""}),
        _INTEGRATOR, Key("rotor", SPLIT, "OpenMM rotates molecules by constrained distances"),
    ),
    limits=(
        Limit("forces.ewald_cutoff_A = {:g}: OpenMM has one cutoff for all forces; leave it out, or take cutoff_A",
            lambda view: view.has_ewald_sum and view.coulomb.cutoff != view.system.cutoff and view.coulomb.cutoff),
        Limit(f"forces.electrostatics = {{!r}}: {_NO_GRID}",
            lambda view: view.has_ewald_sum and grid_for(view, PME_ORDER) is None and view.electrostatics),
        Limit("a barostat with frozen molecules: OpenMM would move them with the box",
            lambda view: view.frozen.any() and view.has_barostat),
    ),
    stage_limits=(
        *_LIMITS,
        Limit("temperature_K or pressure_bar changes over the stage: OpenMM keeps them constant",
            lambda stage: stage.ramps),
    ),
)  # fmt: skip
