"""Comparison of two engines at one state, term by term, for `rigidmd verify` and before runs on external engines."""

from typing import NamedTuple

import numpy as np

from rigidmd.core.state import State
from rigidmd.engines.observables import kinetic_energies, observe
from rigidmd.engines.protocol import Engine
from rigidmd.engines.system import System
from rigidmd.units import KJ_PER_MOL

#: Tolerance of pair sums, relative to their size: engines have slightly different constants, such as 332.06371.
#: Energies of OpenMM in single precision differ by up to 3e-7.
PLAIN = 1e-6
#: Ratio of virial and energy of a 1/r¹² term. The energy may be smaller, where attraction cancels repulsion.
STEEPEST = 12
#: Tolerance of forces with an Ewald sum, in estimated errors. Each engine has such an error.
ERRORS = 5.0
#: Tolerance of the energy of an Ewald sum per site, in (force error)/alpha. Measured: 0.003 (512 SPC/E, 1e-5).
PER_SITE = 0.02


class Comparison(NamedTuple):
    name: str
    unit: str
    here: float
    there: float
    difference: float
    tolerance: float

    @property
    def agrees(self) -> bool:
        return bool(self.difference <= self.tolerance)


def compare_at(system: System, state: State, here: Engine, there: Engine) -> list[Comparison]:
    """Compare energies by term, forces and torques on bodies, and the virial of two engines at a state."""
    ours, theirs = (observe(system, engine, state, energy_unit=1.0) for engine in (here, there))
    virial = sum(abs(float(tally.virial.trace())) for tally in here.evaluate(state)[1].values())

    kinetic = sum(kinetic_energies(system, state))
    size = sum(abs(ours.components[name]) for name in system.terms if name in ours.components) + kinetic
    size = max(size, virial / STEEPEST)
    plain = PLAIN + there.force_tolerance
    force_error, sites, alpha = system.force_error or 0.0, system.site_count, system.scene.forces.ewald_alpha_per_A
    ewald = force_error * (1 / alpha if alpha else 0.0) * (PER_SITE * sites + ERRORS * np.sqrt(sites))
    lines = []
    for name in {**ours.components, **theirs.components}:
        a, b = (seen.components.get(name, 0.0) for seen in (ours, theirs))
        tolerance = PLAIN * size + (ewald if name.startswith("coulomb") else 0.0)
        lines.append(_energy(name.replace("_", " "), a, b, tolerance))
    lines.append(_energy("potential energy", ours.potential, theirs.potential, PLAIN * size + ewald))
    each = np.sqrt(sites / len(system.model.species)) * ERRORS * force_error
    radius = max(m.radius for m in system.species)
    for name, unit, k, tolerance in (("force", "kJ/(mol Å)", 0, each), ("torque", "kJ/mol", 1, each * radius)):
        if len(a := ours.load[k]):
            rms = [float(np.sqrt(np.mean(np.sum(x**2, axis=1)))) for x in (a, theirs.load[k], theirs.load[k] - a)]
            # the tolerance is relative to the rms, or to the energy of a body where it nearly vanishes
            scale = max(rms[0], size / len(system.model.species) / (system.smallest_diameter if k == 0 else 1.0))
            values = (x / KJ_PER_MOL for x in (*rms, plain * scale + tolerance))
            lines.append(Comparison(f"rms {name} on a molecule", unit, *values))
    if np.isfinite(ours.pressure_bar) and np.isfinite(theirs.pressure_bar):
        a, b = (float(seen.virial.trace()) for seen in (ours, theirs))
        lines.append(_energy("virial", a, b, (plain + there.virial_tolerance) * max(size, virial) + 3 * ewald))
    return lines


def _energy(name: str, here: float, there: float, tolerance: float) -> Comparison:
    return Comparison(name, "kJ/mol", *(x / KJ_PER_MOL for x in (here, there, abs(there - here), tolerance)))


def describe_comparison(lines: list[Comparison], there: str) -> str:
    """A table of comparisons; `there` is the name of the other engine."""
    wide = max(len(line.name) for line in lines)
    rows = [f"  {'':<{wide}}  {'rigidmd':>20}  {there:>20}  {'difference':>10}  {'tolerance':>9}"]
    for line in lines:
        values = f"{line.here:>20.10g}  {line.there:>20.10g}  {line.difference:>10.2g}  {line.tolerance:>9.2g}"
        rows.append(f"  {line.name:<{wide}}  {values}  {line.unit}{'' if line.agrees else '   <- differs'}")
    return "\n".join(rows)
