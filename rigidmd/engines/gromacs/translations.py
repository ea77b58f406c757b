"""What GROMACS can express, and how."""

from math import inf

import numpy as np

from rigidmd.engines.external import SPLIT, Key, Limit, Missing, Translations, moves
from rigidmd.engines.rigid_bodies import SAME, MassPoints, mass_points
from rigidmd.scene.models import Molecule


def gromacs_points(molecule: Molecule) -> MassPoints:
    """The mass points of a molecule. The first of three is the apex of an isosceles triangle, as SETTLE needs it."""
    body = mass_points(molecule)
    if len(body.mass) != 3 or (body.site < 0).all():
        return body
    d = {(i, j): distance for i, j, distance in body.distances}
    fits = d[0, 1] == d[0, 2] and abs(body.mass[1] - body.mass[2]) <= SAME * body.mass[1]
    return body if fits and (np.diff(body.site) == 1).all() else mass_points(molecule, sites=False)


_INTEGRATOR, *_LIMITS = moves("GROMACS", "molecules")

TRANSLATIONS = Translations(
    "GROMACS",
    scene=(
        Key("forces.truncation", {  # vdw-modifier
            "plain": "None", "shift": "Potential-shift", "force_switch": "Force-switch", "switch": "Potential-switch",
        }, matters=lambda view: view.lennard_jones),
        Key("forces.electrostatics", {"none": "Cut-off", "reaction_field": "Reaction-Field", "pme": "PME"},
            matters=lambda view: view.coulomb),
        Key("forces.reaction_field_truncation", {None: "", "plain": "None", "shift": "Potential-shift"}),
        Key("forces.ewald_truncation", {None: "", "plain": "None", "shift": "Potential-shift"}),
    ),
    stage=(
        Key("ensemble", {"nve": "", "nvt": "", "npt": "", "nph": Missing("the export to GROMACS has only npt")}),
        Key("thermostat", {  # integrator and tcoupl
            None: ("md-vv", "no"), "nose_hoover": ("md-vv", "nose-hoover"), "langevin": ("sd", "no"),
            "velocity_rescaling": ("md", "v-rescale"),
            "andersen": Missing("GROMACS' Andersen thermostat does not act on whole molecules"),
        }),
        Key("barostat", {None: "no", "cell_rescaling": "C-rescale"}),
        Key("pressure_coupling", {"isotropic": "isotropic", "semi_isotropic": "semiisotropic"},
            "GROMACS' cell_rescaling has isotropic and semi_isotropic"),
        _INTEGRATOR, Key("rotor", SPLIT, "GROMACS rotates molecules by constrained distances"),
    ),
    limits=(
        Limit("no box or no cutoff: GROMACS computes pairs within a cutoff in a periodic box",
            lambda view: not view.is_periodic or view.system.cutoff == inf),
        Limit("frozen molecules: GROMACS would compute forces between them", lambda view: view.frozen.any()),
        Limit("{}: GROMACS has no rigid bodies whose mass is neither on a line nor in a plane",
            lambda view: ", ".join(m.name for m in view.system.species if len(gromacs_points(m).mass) > 3)),
        Limit("several kinds of planar molecules: GROMACS' SETTLE has one kind of triangle",
            lambda view: sum(len(gromacs_points(m).mass) == 3 for m in view.system.species) > 1),
    ),
    stage_limits=(
        *_LIMITS,
        Limit("thermostat = 'nose_hoover' with a barostat: GROMACS has no cell_rescaling with velocity Verlet",
            lambda stage: stage.has_barostat and stage.thermostat_kind == "nose_hoover"),
        Limit("pressure_bar changes over the stage: GROMACS keeps it constant",
            lambda stage: stage.has_barostat and stage.pressures[0] != stage.pressures[1]),
    ),
)  # fmt: skip
