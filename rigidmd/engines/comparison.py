"""Two engines at one state, term by term: they must agree before either is believed."""

from typing import NamedTuple

import numpy as np

from rigidmd.core.state import State
from rigidmd.engines.observables import kinetic_energies, observe
from rigidmd.engines.protocol import Engine
from rigidmd.engines.system import System
from rigidmd.units import KJ_PER_MOL

#: By which sums of plain pairs may part, relative to their size: engines have constants of their own, as 332.06371.
PLAIN = 1e-6
#: Energies of a term that its virial may be, as of 1/r¹²: the energy is the smaller where attraction cancels repulsion.
STEEPEST = 12
#: Estimated errors of an Ewald sum by which forces may part; each engine has one.
ERRORS = 5.0
#: Share of what its error of forces does over 1/alpha that every site may add to the energy of an Ewald sum. Measured:
#: 0.003 (512 SPC/E, PME and PPPM at 1e-5).
SHARE = 0.02


class Line(NamedTuple):
    """One quantity on two engines."""

    name: str
    unit: str
    here: float
    there: float
    apart: float  # how far they part
    allowed: float

    @property
    def agrees(self) -> bool:
        """Whether they part by no more than is explained."""
        return bool(self.apart <= self.allowed)


def compare_at(system: System, state: State, here: Engine, there: Engine) -> list[Line]:
    """Energies by term, forces and torques on bodies, and the virial of two engines at a state."""
    ours, theirs = observe(system, here, state), observe(system, there, state)
    virial = sum(abs(float(tally.virial.trace())) for tally in here.evaluate(state)[1].values())
    every = {**ours.components, **theirs.components}
    kinetic = sum(kinetic_energies(system, state))
    size = sum(abs(ours.components[name]) for name in system.terms if name in ours.components) + kinetic
    size = max(size, virial / STEEPEST)
    force_error = system.force_error or 0.0
    reach = _reach(system)
    sites = system.site_count
    slack = force_error * reach * (SHARE * sites + ERRORS * np.sqrt(sites))
    lines = []
    for name in every:
        a, b = (seen.components.get(name, 0.0) for seen in (ours, theirs))
        allowed = PLAIN * size + (slack if name.startswith("coulomb") else 0.0)
        lines.append(_energy(name.replace("_", " "), a, b, allowed))
    lines.append(_energy("potential energy", ours.potential, theirs.potential, PLAIN * size + slack))
    each = np.sqrt(sites / len(system.model.species)) * ERRORS * force_error
    radius = max(m.radius for m in system.species)
    for name, unit, k, allowed in (("force", "kJ/(mol Å)", 0, each), ("torque", "kJ/mol", 1, each * radius)):
        if len(ours.load[k]):
            lines.append(
                _of_bodies(f"rms {name} on a molecule", unit, ours.load[k], theirs.load[k], allowed, size, system)
            )
    if np.isfinite(ours.pressure_bar) and np.isfinite(theirs.pressure_bar):
        a, b = (float(seen.virial.trace()) for seen in (ours, theirs))
        lines.append(_energy("virial", a, b, PLAIN * max(size, virial) + 3 * slack))
    return lines


def _reach(system: System) -> float:
    """1/alpha of an Ewald sum, Å."""
    alpha = system.scene.forces.ewald_alpha_per_A
    return 1 / alpha if alpha else 0.0


def _energy(name: str, here: float, there: float, allowed: float) -> Line:
    return Line(name, "kJ/mol", *(x / KJ_PER_MOL for x in (here, there, abs(there - here), allowed)))


def _of_bodies(
    name: str, unit: str, here: np.ndarray, there: np.ndarray, allowed: float, size: float, system: System
) -> Line:
    """rms over bodies. They may part relative to it, or where it all but vanishes to the energy of a body."""
    rms = [float(np.sqrt(np.mean(np.sum(x**2, axis=1)))) for x in (here, there, there - here)]
    scale = max(rms[0], size / len(system.model.species) / (system.smallest_diameter if "Å" in unit else 1.0))
    return Line(name, unit, *(x / KJ_PER_MOL for x in (*rms, PLAIN * scale + allowed)))


def in_words(lines: list[Line], there: str) -> str:
    """The lines as a table."""
    wide = max(len(line.name) for line in lines)
    rows = [f"  {'':<{wide}}  {'rigidmd':>20}  {there:>20}  {'apart':>9}  {'allowed':>9}"]
    rows += [
        f"  {line.name:<{wide}}  {line.here:>20.10g}  {line.there:>20.10g}  {line.apart:>9.2g}  {line.allowed:>9.2g}"
        f"  {line.unit}{'' if line.agrees else '   <- parts'}"
        for line in lines
    ]
    return "\n".join(rows)
