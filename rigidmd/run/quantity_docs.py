"""Explanations of values of `rigidmd energy`: of Coulomb energies, virial and pressure."""

from math import inf
from typing import cast

import numpy as np

from rigidmd.engines.system import System
from rigidmd.forces.ewald.interactions import NEUTRAL
from rigidmd.forces.neighbors.pair_loop import PairForces
from rigidmd.forces.potentials.coulomb import ReactionField
from rigidmd.forces.potentials.truncation import Unmodified
from rigidmd.units import BAR


def describe_quantities(system: System) -> dict[str, str]:
    """Name of an energy component, `virial` or `pressure` -> explanation."""
    methods = {"reaction_field": _describe_reaction_field, "ewald": _describe_ewald, "pme": _describe_ewald}
    has = {*system.terms, *system.constants}
    of_charges = methods.get(system.scene.forces.electrostatics, lambda system: {})(system)
    found = {name: text for name, text in of_charges.items() if name in has}
    if system.space.volume < inf:
        found |= _describe_pressure(system)
    return found


def _describe_reaction_field(system: System) -> dict[str, str]:
    if system.cutoff == inf or "coulomb" not in system.terms:
        return {}
    name = system.scene.forces.truncation
    shape = cast(ReactionField, cast(PairForces, system.terms["coulomb"]).potential).truncation
    start = 0.0 if isinstance(shape, Unmodified) else shape.start
    ends = {"plain": "", "shift": ", less its value at the cutoff", "force_shift": ", less its value and slope there"}
    if name in ends:
        how = ends[name]
    elif name == "force_switch":
        how = f", its force switched off from {start:g} Å on"
    else:
        how = f", less its value at the cutoff, times {name} from {start:g} Å on"
    return {
        "coulomb": f"q q (1/r + k r²) up to the cutoff{how}",
        "reaction_field_self": "charges of each molecule in their own reaction field",
    }


def _describe_ewald(system: System) -> dict[str, str]:
    """Explanations of the energies of Ewald sums, which depend on whether the real-space energy is shifted."""
    real, self_energy = "q q erfc(alpha r)/r between molecules", "-alpha/sqrt(pi) q² of each site"
    if system.scene.forces.ewald_truncation == "plain":
        return {"coulomb_real": f"{real}, plain at the cutoff", "coulomb_self": self_energy}
    charged = any(abs(m.charge) > NEUTRAL * np.abs(m.charges).sum() for m in system.species)
    more = (
        ", and -erfc(alpha R)/(2 R) (sum of q)² of each molecule, as energies are shifted; R is the cutoff"
        if charged
        else "; shifted energies add nothing to it, as every molecule is neutral"
    )
    return {"coulomb_real": f"{real}, less its value at the cutoff", "coulomb_self": self_energy + more}


def _describe_pressure(system: System) -> dict[str, str]:
    virial, pressure = "sum of F·R over molecules", "(2 K of translation + virial)/3 V"
    if system.external:
        virial += ", of the forces between molecules; fields, walls and restraints do not contribute"
    if system.tail is not None:
        virial += ", without the tail correction"
        pressure += f", and {system.tail.pressure(system.state.volume) / BAR:.10g} bar of the tail"
    if "coulomb_frozen" in system.constants:
        constant = f"{system.constant_pressure / BAR:.10g} bar"
        pressure += f", and {constant}, which removes the forces between frozen molecules"
    return {"virial": virial, "pressure": pressure}
